# SPDX-License-Identifier: Apache-2.0
"""Takes back what the drift of the only position sensor did to heading and velocity, and to the place without fixes.

Its slow error is left out of the graph (`Stream.left_out`), so fixes count as if their errors were white: hundreds of
them a minute overrule a compass by six of its sigmas, although the drift that bends their track is the likelier reason.
With the error as states the linearised run weighs them as configured. Heading, velocity and the slow states of the
other sensors are taken from there. The antenna stays where the fixes have it, as nothing tells their error from motion;
before the first and after the last fix it moves from there as in the linearised run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Problem, solved_constants
from graphloc.frames import Array
from graphloc.graph import antenna_off_m, corrections
from graphloc.judge.linearised import linearised, normal_solver, with_left_out
from graphloc.solve.batch import BatchResult

_LINEAR_RAD = np.radians(15.0)  # largest turn for which the linearised run holds


def with_drift_taken_back(result: BatchResult) -> BatchResult:
    """Return the result without what a left-out slow error did to it.

    Heading, velocity, slow states and, before the first and after the last fix, place are then as in the linearised run
    with that error as states. Covariances stay as they are. Nothing changes where no error is left out, or where the
    heading would turn by more than the linearised run can tell.

    Raises:
        RuntimeError: a state is not determined.
    """
    problem, values = result.problem, result.values
    followed = next((stream for stream in problem.streams if stream.left_out is not None), None)
    if followed is None:
        return result
    full, there = with_left_out(problem, values)
    rows = linearised(full, there, result.verdicts, result.prior)
    _, J, b = rows.weighed()
    dx = normal_solver(J)(J.T @ b)
    if not np.isfinite(dx).all():
        raise RuntimeError("not finite")
    fixed = [k for s in problem.streams if s.left_out is not None for k in s.state[rows.used(s)].tolist()]
    turned, shifted = np.split(dx[rows.first_pose :].reshape(-1, 6), 2, axis=1)
    if not fixed or np.linalg.norm(turned, axis=1).max() > _LINEAR_RAD:
        return result
    faster = dx[rows.first_velocity : rows.first_pose].reshape(-1, 3)
    moved, antenna = gtsam.Values(values), np.asarray(followed.mount.translation())
    if (elsewhere_m := antenna_off_m(corrections(solved_constants(followed, values), followed.mount))) is not None:
        antenna = antenna + elsewhere_m
    poses = [values.atPose3(keys.pose(k)) for k in range(rows.states)]
    free = [
        gtsam.Pose3(pose.rotation().compose(gtsam.Rot3.Expmap(turn)), pose.transformFrom(shift))
        for pose, turn, shift in zip(poses, turned, shifted, strict=True)
    ]
    off_m = np.array(
        [new.transformFrom(antenna) - old.transformFrom(antenna) for new, old in zip(free, poses, strict=True)]
    )
    off_m -= off_m[np.clip(np.arange(rows.states), min(fixed), max(fixed))]
    for k, (old, new) in enumerate(zip(poses, free, strict=True)):
        place_m = old.transformFrom(antenna) + off_m[k] - new.rotation().rotate(antenna)
        moved.update(keys.pose(k), gtsam.Pose3(new.rotation(), place_m))
        moved.update(keys.velocity(k), values.atVector(keys.velocity(k)) + faster[k])
    for key, change in _slow_states(full, dx[: rows.first_velocity]):
        if values.exists(key):
            moved.update(key, values.atVector(key) + change)
    return replace(result, values=moved)


def _slow_states(problem: Problem, dx: Array) -> Iterator[tuple[int, Array]]:
    """Yield the keys of the slow states and their changes, which come last in dx (columns,)."""
    slow = [(s.number, len(s.slow.sigma)) for s in problem.streams if s.slow is not None]
    nodes = len(problem.timeline.slow_stamps_ns)
    at = len(dx) - sum(width for _, width in slow) * nodes
    for number, width in sorted(slow):
        for j in range(nodes):
            yield keys.slow(number, j), dx[at : at + width]
            at += width
