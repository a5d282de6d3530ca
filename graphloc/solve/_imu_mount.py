# SPDX-License-Identifier: Apache-2.0
"""How far the IMU's axes are from where its mount says, by what a solved run's other sensors say of the body.

With the mount turned by a small rotation m, body axes, the IMU measures what it would if the body were turned as much, while all
other sensors stay: its rows of the linearised run J dx = b, and that of its levelling at the start, become J dx + c m = b, with

    c = J_imu U,   U: m in the attitude of every state

What no change of the states explains, c~ = c - J argmin |J X - c|, carries the information on m:

    (c~'c~ + 1 / s^2) m = c~'b - t / s^2,   s: of the mount, t: by which it is turned already

and the states follow by X m: what is not known of m widens their covariance (a consider parameter, Schmidt 1966). Without it, fixes
of centimetres tell the heading of an IMU to some tenths of a degree, and state that of the vessel to as much.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.sparse import diags_array

from graphloc import keys
from graphloc.build import Problem, StartPrior, with_imu_turned
from graphloc.errors import SolveError
from graphloc.frames import Array, skew
from graphloc.recording import Progress
from graphloc.solve._decide import Stage, Verdicts, weigh
from graphloc.solve._linearised import linearised, normal_solver, root_weights, sparse_rows, with_left_out
from graphloc.solve._passes import Settled, cost_as_configured, settle

_ROUNDS = 3
_MATTERS = 0.5  # sigmas of the mount: less is in the bounds
_MOST = 5.0  # sigmas: what speaks for more is another error, as a lever arm that is wrong by metres


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

    def velocity_covariance(self) -> Array:
        """Return what it adds to the covariance (N, 3, 3) of the velocity, world axes."""
        return np.asarray(self.velocity @ self._beyond() @ self.velocity.transpose(0, 2, 1))

    def _beyond(self) -> Array:
        """Return the mean square (3, 3) of the mount's error against how the run was solved."""
        return np.asarray(self.cov + np.outer(self.turn_rad, self.turn_rad))


def mount_sigma_rad(problem: Problem) -> float:
    """Return how far the mount of the IMU may be off, 1 sigma."""
    return float(problem.config.sensors[problem.imu.sensor].mount_sigma_rad)


def mount_error(
    problem: Problem, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, verdicts: Verdicts, prior: StartPrior
) -> MountError | None:
    """Return what a solved run says of the mount of the IMU; None where it is taken as given.

    Args:
        graph, values, verdicts, prior: of the solution.

    Raises:
        RuntimeError, numpy.linalg.LinAlgError: a state is not determined.
    """
    sigma = mount_sigma_rad(problem)
    if sigma == 0.0:
        return None
    n, nodes = len(problem.timeline), len(problem.timeline.slow_stamps_ns)
    told = follows = _followed(*sparse_rows(graph, values), n, nodes)
    if any(stream.left_out is not None for stream in problem.streams):
        # The graph takes their drift for motion, which would speak for a mount as if it were none.
        rows = linearised(*with_left_out(problem, values), verdicts, prior)
        root = root_weights(rows, -rows.b)
        told = _followed(diags_array(root) @ rows.J, root * rows.b, n, nodes)
    cov = np.asarray(np.linalg.inv(told.left.T @ told.left + np.eye(3) / sigma**2), dtype=np.float64)
    turn = cov @ (told.left.T @ told.b - problem.imu_turn_rad / sigma**2)
    X = follows.states
    if not (np.isfinite(cov).all() and np.isfinite(X).all()):
        raise RuntimeError("not finite")
    # Keys are sorted by letter: velocities and poses come last.
    return MountError(turn, cov, X[-6 * n :].reshape(n, 6, 3), X[-9 * n : -6 * n].reshape(n, 3, 3))


def followed_before(
    problem: Problem, values: gtsam.Values, verdicts: Verdicts, prior: StartPrior, k: int
) -> Array | None:
    """Return by how much (9, 3) rotation, place and velocity of the IMU at state k, axes of world, follow the turn by the data before it.

    None where the mount is taken as given. Arguments and errors as of `mount_error`.
    """
    if mount_sigma_rad(problem) == 0.0:
        return None
    rows, n = linearised(problem, values, verdicts, prior), len(problem.timeline)
    before = rows.stamps_ns < problem.timeline.stamps_ns[k]
    J, c = diags_array(root_weights(rows, -rows.b)) @ rows.J, _by_turn(rows.J, n, len(problem.timeline.slow_stamps_ns))
    J, c = J[before], c[before]
    used = abs(J).sum(axis=0) > 0.0
    X = np.zeros((len(used), 3))
    X[used] = -normal_solver(J[:, used])(J[:, used].T @ c)
    if not np.isfinite(X).all():
        raise RuntimeError("not finite")
    R = values.atPose3(keys.pose(k)).rotation().matrix()
    turned, moved = np.split(X[rows.first_pose + 6 * k :][:6], 2)
    return np.vstack([R @ (turned + np.eye(3)), R @ moved, X[rows.first_velocity + 3 * k :][:3]])


class _Followed(NamedTuple):
    """How the states (columns, 3) of a linear system follow the turn, what is left in its rows (rows, 3), and these rows' b."""

    states: Array
    left: Array
    b: Array


def _followed(J: Any, b: Array, n: int, nodes: int) -> _Followed:
    """Return how the states follow, n of them with so many slow nodes."""
    c = _by_turn(J, n, nodes)
    X = -normal_solver(J)(J.T @ c)
    return _Followed(X, c + J @ X, b)


def _by_turn(J: Any, n: int, nodes: int) -> Array:
    """Return c (rows, 3). The factors of the IMU between the n states come first in J (rows, columns).

    Biases come first in the columns, and poses last, as keys are sorted by letter.
    """
    U = np.zeros((J.shape[1], 3))
    U[-6 * n :].reshape(n, 6, 3)[:, :3] = np.eye(3)
    c = np.asarray(J @ U)
    levelled = abs(J[9 * (n - 1) :, : 6 * nodes]).sum(axis=1) > 0.0  # no other factor has an attitude and a bias
    c[9 * (n - 1) :][~np.asarray(levelled).ravel()] = 0.0
    return c


def with_mount_estimated(
    problem: Problem, settled: Settled, prior: StartPrior, progress: Progress, most: int
) -> tuple[Problem, Settled, StartPrior, MountError | None]:
    """Return the problem with the mount of its IMU as is most probable, settled in at most `most` passes; as they are if that is near.

    And what that says of the mount; None where it is taken as given, or not determined.
    """
    last, sigma = len(problem.timeline) - 1, mount_sigma_rad(problem)

    def cost(problem: Problem, settled: Settled, prior: StartPrior) -> float:
        off = problem.imu_turn_rad / sigma
        return 0.5 * float(off @ off) + cost_as_configured(problem, settled.values, 0, last, prior, judged=last)

    def found(problem: Problem, settled: Settled, prior: StartPrior) -> MountError | None:
        try:
            return mount_error(problem, settled.graph, settled.values, settled.verdicts, prior)
        except (RuntimeError, np.linalg.LinAlgError):
            return None

    error, lowest = found(problem, settled, prior), np.inf
    as_configured = problem, settled, prior, error
    for _ in range(_ROUNDS):
        if error is None or np.abs(error.turn_rad).max() < _MATTERS * sigma:
            break
        if np.abs(problem.imu_turn_rad + error.turn_rad).max() > _MOST * sigma:
            return as_configured
        if np.isinf(lowest):
            lowest = cost(problem, settled, prior)
        turned, prior_there = (
            with_imu_turned(problem, settled.values, error.turn_rad),
            prior.with_imu_turned(error.turn_rad),
        )
        verdicts = weigh(turned, settled.values, first=0, last=last, stage=Stage.FINAL)
        try:
            again = settle(turned, settled.values, verdicts, prior_there, progress, most)
        except SolveError:
            break
        if not (now := cost(turned, again, prior_there)) < lowest:
            break
        problem, settled, prior, lowest = turned, again, prior_there, now
        error = found(problem, settled, prior)
    return problem, settled, prior, error
