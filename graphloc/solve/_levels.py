# SPDX-License-Identifier: Apache-2.0
"""Which level of a jumping receiver is the usual one (zero error), where no other sensor measures position.

A run grows from its first level, and no single step of the solver leads to another one. So the levels that the jumps lead to
are compared as candidates: by the size of the errors that would result, and for how long they last, as a jump ends within a
minute.
"""

from __future__ import annotations

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Problem, StartPrior, Stream, standing_cost
from graphloc.frames import Array
from graphloc.graph import SlowProcess
from graphloc.position_jumps import MEAN_S
from graphloc.recording import Progress
from graphloc.solve._decide import Stage, Verdicts, weigh
from graphloc.solve._passes import Settled, settle
from graphloc.time import NS_PER_S

_JUMP = 1.0  # sigmas from one node to the next: ten times the drift
_FAR = 2.0  # sigmas: nearer, the error is at its usual level


def at_usual_level(
    problem: Problem, settled: Settled, prior: StartPrior, progress: Progress, most: int
) -> tuple[Settled, Array]:
    """Return the solution with the most probable level as the usual one, settled in at most `most` passes.

    Also returns the covariance (3, 3) of the position that the other levels add, m^2, in world.
    """
    alone = np.zeros((3, 3))
    streams = [s for s in problem.streams if s.slow is not None and s.slow.far]
    paths = [_path(problem, settled.values, s) for s in streams]
    levels = [level for s, path in zip(streams, paths, strict=True) for level in _levels(s.slow, path)]
    if not levels or _told_otherwise(problem, settled.verdicts):
        return settled, alone
    levels.insert(0, np.zeros(3))
    dt_s = np.diff(problem.timeline.slow_stamps_ns) / NS_PER_S
    cost = np.array([
        sum(_cost(s.slow, path - level, dt_s) for s, path in zip(streams, paths, strict=True)) for level in levels
    ])  # fmt: skip
    usual = int(np.argmin(cost))
    share = np.exp(cost[usual] - cost)
    beside = np.array(levels) - levels[usual]
    others = np.einsum("n,ni,nj->ij", share / share.sum(), beside, beside)
    if usual == 0:
        return settled, others
    values = _moved(problem, settled.values, streams, -levels[usual])
    verdicts = weigh(problem, values, first=0, last=len(problem.timeline) - 1, stage=Stage.FINAL)
    other = settle(problem, values, verdicts, prior, progress, most)
    if _error(other) - _error(settled) > cost[0] - cost[usual]:
        return settled, alone  # another sensor determines the position
    return other, others


def _error(settled: Settled) -> float:
    return float(settled.graph.error(settled.values))


def _told_otherwise(problem: Problem, verdicts: Verdicts) -> bool:
    """Whether a sensor without such an error measures position, too."""
    others = {s.number for s in problem.streams if s.row.absolute and (s.slow is None or not s.slow.far)}
    return any(number in others and v.weight > 0.5 for (number, _), v in verdicts.items())


def _path(problem: Problem, values: gtsam.Values, stream: Stream) -> Array:
    """Return the slow error (N, 3) at the nodes, m."""
    nodes = range(len(problem.timeline.slow_stamps_ns))
    return np.array([values.atVector(keys.slow(stream.number, j)) for j in nodes])


def _levels(slow: SlowProcess | None, path: Array) -> list[Array]:
    """Return the levels (3,), m, of an error (N, 3) between its jumps: each once, without the usual one."""
    assert slow is not None
    held = path * slow.far_axes
    jumps = 1 + np.flatnonzero(np.linalg.norm(np.diff(held / slow.sigma, axis=0), axis=1) > _JUMP)
    found: list[Array] = []
    for part in np.split(held, jumps) if len(jumps) else []:
        level = np.median(part, axis=0)
        if all(np.linalg.norm((level - other) / slow.sigma) > _FAR for other in (np.zeros(3), *found)):
            found.append(level)
    return found


def _cost(slow: SlowProcess | None, path: Array, dt_s: Array) -> float:
    """Return the cost (nats) of an error (N, 3): of its size, and of the time that it is far off."""
    assert slow is not None
    far = slow.far_axes
    away = np.linalg.norm(path[:, far] / slow.sigma[far], axis=1) > _FAR
    return standing_cost(slow, path, dt_s) + float(dt_s @ away[1:]) / MEAN_S


def _moved(problem: Problem, values: gtsam.Values, streams: list[Stream], by_m: Array) -> gtsam.Values:
    """Return the run shifted by (3,), m, in world, and the slow errors of these streams shifted to match."""
    moved = gtsam.Values(values)
    for k in range(len(problem.timeline)):
        pose = values.atPose3(keys.pose(k))
        moved.update(keys.pose(k), gtsam.Pose3(pose.rotation(), pose.translation() + by_m))
    for stream in streams:
        for j in range(len(problem.timeline.slow_stamps_ns)):
            key = keys.slow(stream.number, j)
            moved.update(key, values.atVector(key) + by_m)
    return moved
