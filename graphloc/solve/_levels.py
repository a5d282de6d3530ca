# SPDX-License-Identifier: Apache-2.0
"""Which level of a jumping receiver is the usual one (zero error), where no other sensor measures position.

A run grows from its first level, and no single step of the solver leads to another one. So the levels that the jumps lead to
are compared as candidates: by the size of the errors that would result, and for how long they last, as a jump ends within a
minute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build import Problem, StartPrior, Stream, build_graph, standing_cost
from graphloc.frames import Array
from graphloc.graph import SlowProcess
from graphloc.position_jumps import MEAN_S
from graphloc.recording import Progress
from graphloc.solve._decide import Stage, Verdicts, decisions, weigh
from graphloc.solve._passes import Settled, settle
from graphloc.time import NS_PER_S

_JUMP = 1.0  # sigmas from one node to the next: ten times the drift
_FAR = 2.0  # sigmas: nearer, the error is at its usual level


class AtLevel(NamedTuple):
    """A solution with the most probable level as the usual one, and what it was solved with.

    Attributes:
        others_cov: covariance (3, 3) of the position that the other levels add, m^2, in world.
    """

    problem: Problem
    settled: Settled
    prior: StartPrior
    others_cov: Array


def at_usual_level(problem: Problem, settled: Settled, prior: StartPrior, progress: Progress, most: int) -> AtLevel:
    """Return the solution with the most probable level as the usual one, settled in at most `most` passes.

    It is held there: with tails on either side, a level that is left after a quarter of the run weighs as much as the other.
    """
    as_it_is = AtLevel(problem, settled, prior, np.zeros((3, 3)))
    dt_s = np.diff(problem.timeline.slow_stamps_ns) / NS_PER_S
    streams = [s for s in problem.streams if s.slow is not None and s.slow.far]
    paths = [_path(problem, settled.values, s) for s in streams]
    levels = [level for s, path in zip(streams, paths, strict=True) for level in _levels(s.slow, path)]
    if not levels or _told_otherwise(problem, settled.verdicts):
        return as_it_is
    levels.insert(0, np.zeros(3))

    def cost(one: Callable[[SlowProcess, Array, Array], float], level: Array) -> float:
        return sum(
            one(s.slow, path - level, dt_s) for s, path in zip(streams, paths, strict=True) if s.slow is not None
        )

    costs = np.array([cost(_cost, level) for level in levels])
    usual = levels[int(np.argmin(costs))]
    moved, prior_there = _moved(problem, settled.values, streams, -usual), _prior_moved(prior, -usual)
    last, decided = len(problem.timeline) - 1, decisions(settled.verdicts)
    here, there = (
        float(build_graph(problem, values, decided, 0, last, about)[0].error(values))
        for values, about in ((settled.values, prior), (moved, prior_there))
    )
    rise = there - here - (cost(standing_cost, usual) - cost(standing_cost, levels[0]))
    if rise > costs[0] - costs.min():
        return as_it_is  # another sensor determines the position
    share = np.exp(costs.min() - costs)
    beside = np.array(levels) - usual
    others = np.einsum("n,ni,nj->ij", share / share.sum(), beside, beside)
    problem = replace(problem, streams=tuple(_held(s, streams, paths, usual) for s in problem.streams))
    verdicts = weigh(problem, moved, first=0, last=last, stage=Stage.FINAL)
    return AtLevel(problem, settle(problem, moved, verdicts, prior_there, progress, most), prior_there, others)


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


def _cost(slow: SlowProcess, path: Array, dt_s: Array) -> float:
    """Return the cost (nats) of an error (N, 3): of its size, and of the time that it is far off."""
    return standing_cost(slow, path, dt_s) + float(dt_s @ _away(slow, path)[1:]) / MEAN_S


def _away(slow: SlowProcess, path: Array) -> NDArray[np.bool_]:
    """Return where (N,) an error (N, 3) is far off."""
    far = slow.far_axes
    return np.asarray(np.linalg.norm(path[:, far] / slow.sigma[far], axis=1) > _FAR)


def _held(stream: Stream, streams: list[Stream], paths: list[Array], usual: Array) -> Stream:
    """Return it with the nodes at which its error is at the usual level, if it is one of `streams` and there is any."""
    for one, path in zip(streams, paths, strict=True):
        if one is stream and one.slow is not None and not (away := _away(one.slow, path - usual)).all():
            return replace(stream, usual=~away)
    return stream


def _prior_moved(prior: StartPrior, by_m: Array) -> StartPrior:
    """Return it shifted by (3,), m, in world: its position is that of the first fixes."""
    return replace(prior, pose=gtsam.Pose3(prior.pose.rotation(), prior.pose.translation() + by_m))


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
