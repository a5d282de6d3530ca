# SPDX-License-Identifier: Apache-2.0
"""How far the IMU's axes are from where its mount says, by what a solved run's other sensors say of the body.

With the mount turned by a small rotation m, body axes, the IMU measures what it would if the body were turned as much, while all
other sensors stay: its rows of the linearised run J dx = b become J dx + c m = b, with

    c = J_imu U,   U: m in the attitude of every state

What no change of the states explains, c~ = c - J argmin |J X - c|, carries the information on m:

    (c~'c~ + 1 / s^2) m = c~'b - t / s^2,   s: of the mount, t: by which it is turned already

and the states follow by X m: what is not known of m widens their covariance (a consider parameter, Schmidt 1966). Without it, fixes
of centimetres tell the heading of an IMU to some tenths of a degree, and state that of the vessel to as much.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from graphloc.build import CONSTANT_TAILS, Problem, StartPrior, with_imu_turned
from graphloc.errors import SolveError
from graphloc.frames import Array, skew
from graphloc.recording import Progress
from graphloc.solve._decide import Stage, weigh
from graphloc.solve._linearised import normal_solver, sparse_rows
from graphloc.solve._passes import Settled, cost_as_configured, settle

_ROUNDS = 3
_MATTERS = 0.5  # sigmas of the mount: less is in the bounds


class MountError(NamedTuple):
    """What a run says of the mount of its IMU, beyond how it was solved, and how its N states follow.

    Attributes:
        turn_rad: (3,) most probable turn, body axes. cov: (3, 3) of it, rad^2.
        pose: (N, 6, 3) change of each pose (rotation, translation; body axes) per turn. velocity: (N, 3, 3) the same, world axes.
    """

    turn_rad: Array
    cov: Array
    pose: Array
    velocity: Array

    def pose_covariance(self, R: Array, lever_m: Array) -> Array:
        """Return what it adds to the covariance (N, 6, 6) of the place of a point of the body, and of the attitude, in axes of world.

        Args:
            R: (N, 3, 3) attitudes. lever_m: (3,) the point from the IMU, body axes.
        """
        turned, moved = R @ self.pose[:, :3], R @ (self.pose[:, 3:] - skew(lever_m) @ self.pose[:, :3])
        by = np.concatenate([moved, turned], axis=1)
        return np.asarray(by @ self._beyond() @ by.transpose(0, 2, 1))

    def in_world(self, R: Array, k: int) -> Array:
        """Return the change (9, 3) of rotation, place and velocity of state k per turn, in axes of world; R: (3, 3) its attitude."""
        return np.vstack([R @ self.pose[k, :3], R @ self.pose[k, 3:], self.velocity[k]])

    def velocity_covariance(self) -> Array:
        """Return what it adds to the covariance (N, 3, 3) of the velocity, world axes."""
        return np.asarray(self.velocity @ self._beyond() @ self.velocity.transpose(0, 2, 1))

    def _beyond(self) -> Array:
        """Return the mean square (3, 3) of the mount's error against how the run was solved."""
        return np.asarray(self.cov + np.outer(self.turn_rad, self.turn_rad))


def mount_sigma_rad(problem: Problem) -> float:
    """Return how far the mount of the IMU may be off, 1 sigma."""
    return float(problem.config.sensors[problem.imu.sensor].mount_sigma_rad)


def mount_error(problem: Problem, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> MountError | None:
    """Return what a solved graph says of the mount of the IMU; None where it is taken as given.

    Raises:
        RuntimeError, numpy.linalg.LinAlgError: a state is not determined.
    """
    sigma = mount_sigma_rad(problem)
    if sigma == 0.0:
        return None
    n = len(problem.timeline)
    J, b = sparse_rows(graph, values)
    first_pose = J.shape[1] - 6 * n  # keys are sorted by letter: poses come last, before them velocities
    U = np.zeros((J.shape[1], 3))
    U[first_pose:].reshape(n, 6, 3)[:, :3] = np.eye(3)
    c = J @ U
    c[9 * (n - 1) :] = 0.0  # factors of the IMU come first
    solve = normal_solver(J)
    X = -solve(J.T @ c)
    left = c + J @ X
    var = sigma**2 * (1.0 + (problem.imu_turn_rad / sigma) ** 2 / CONSTANT_TAILS)
    cov = np.linalg.inv(left.T @ left + np.diag(1.0 / var))
    turn = cov @ (left.T @ b - problem.imu_turn_rad / var)
    if not (np.isfinite(cov).all() and np.isfinite(X).all()):
        raise RuntimeError("not finite")
    return MountError(turn, cov, X[first_pose:].reshape(n, 6, 3), X[first_pose - 3 * n : first_pose].reshape(n, 3, 3))


def with_mount_estimated(
    problem: Problem, settled: Settled, prior: StartPrior, progress: Progress, most: int
) -> tuple[Problem, Settled, MountError | None]:
    """Return the problem with the mount of its IMU as is most probable, settled in at most `most` passes; as they are if that is near.

    And what that says of the mount; None where it is taken as given, or not determined.
    """
    last = len(problem.timeline) - 1

    def cost(problem: Problem, settled: Settled) -> float:
        squares = float(((problem.imu_turn_rad / mount_sigma_rad(problem)) ** 2).sum())
        off = 0.5 * CONSTANT_TAILS * float(np.log1p(squares / CONSTANT_TAILS))
        return off + cost_as_configured(problem, settled.values, 0, last, prior, judged=last)

    def found(problem: Problem, settled: Settled) -> MountError | None:
        try:
            return mount_error(problem, settled.graph, settled.values)
        except (RuntimeError, np.linalg.LinAlgError):
            return None

    error, lowest = found(problem, settled), np.inf
    for _ in range(_ROUNDS):
        if error is None or float(np.abs(error.turn_rad).max()) < _MATTERS * mount_sigma_rad(problem):
            break
        if np.isinf(lowest):
            lowest = cost(problem, settled)
        turned = with_imu_turned(problem, settled.values, error.turn_rad)
        verdicts = weigh(turned, settled.values, first=0, last=last, stage=Stage.FINAL)
        try:
            again = settle(turned, settled.values, verdicts, prior, progress, most)
        except SolveError:
            break
        if not (now := cost(turned, again)) < lowest:
            break
        problem, settled, lowest = turned, again, now
        error = found(problem, settled)
    return problem, settled, error
