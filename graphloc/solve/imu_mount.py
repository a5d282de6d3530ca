# SPDX-License-Identifier: Apache-2.0
"""How far the IMU's axes are from where its mount says, by what a solved run's other sensors say of the body.

With the mount turned by a small rotation m, body axes, the IMU measures what it would if the body were turned as much,
while all other sensors stay: its rows of the linearised run J dx = b, and that of its levelling at the start, become J
dx + c m = b, with

    c = J_imu U,   U: m in the attitude of every state

and the rows of velocities that are predicted with what it measures (`_swung_by_turn`).
What no change of the states explains, c~ = c - J argmin |J X - c|, carries the information on m:

    (c~'c~ + 1 / s^2) m = c~'b - t / s^2,   s: sigmas of the mount, t: by which it is turned already

and the states follow by X m. So what is not known of m widens their covariance (a consider parameter, Schmidt 1966).
Without that, fixes of centimetres tell the heading of an IMU to some tenths of a degree, and the heading of the vessel
is stated as well.

Of m only the yaw is taken from the run. Roll and pitch show in how an antenna swings about the IMU, but so does its
lever arm, in which decimetres are usual: a height that is 0.4 m wrong became a mount that is tilted by 4 deg, and a
place 0.15 m off.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Problem, StartPrior, Stream, solved_constants, with_imu_turned
from graphloc.errors import SolveError
from graphloc.frames import Array, skew
from graphloc.graph import TIME_OFFSET, antenna_off_m, corrections
from graphloc.judge.decide import Stage, Verdicts, weigh
from graphloc.judge.linearised import Rows, linearised, normal_solver, sparse_rows, with_left_out
from graphloc.recording import Progress
from graphloc.solve._passes import Settled, cost_of_run, settle

# Most rounds of turning the IMU and solving again; they end where what is left is below `_MATTERS`; a choice.
_ROUNDS = 3
# Sigmas of the mount, and of what is known of it, from which it is turned: less is in the bounds.
_MATTERS, _TOLD = 0.5, 1.5
_MOST = 5.0  # most sigmas of the mount that it is turned by: what speaks for more is another error


class MountError(NamedTuple):
    """What a run says of the error of its IMU's mount, beyond how it was solved, and how its N states follow.

    Attributes:
        yaw_rad: most probable turn about the body's z. sigma_rad: of it.
        mean_square: (3,) of the turn about each axis, body axes, rad^2.
        pose: (N, 6, 3) change of each pose (rotation, translation; body axes) per turn.
        velocity: (N, 3, 3) change of each velocity, world axes, per turn.
    """

    yaw_rad: float
    sigma_rad: float
    mean_square: Array
    pose: Array
    velocity: Array

    def pose_covariance(self, R: Array, lever_m: Array) -> Array:
        """Return what the mount adds to the covariances (N, 6, 6) of a point of the body and of the attitude, world.

        Args:
            R: (N, 3, 3) attitudes. lever_m: (3,) the point from the IMU, body axes.
        """
        turned, moved = R @ self.pose[:, :3], R @ (self.pose[:, 3:] - skew(lever_m) @ self.pose[:, :3])
        by = np.concatenate([moved, turned], axis=1)
        return np.asarray((by * self.mean_square) @ by.transpose(0, 2, 1))

    def velocity_covariance(self) -> Array:
        """Return what the mount adds to the covariance (N, 3, 3) of the velocity, world axes."""
        return np.asarray((self.velocity * self.mean_square) @ self.velocity.transpose(0, 2, 1))


def mount_sigma_rad(problem: Problem) -> Array:
    """Return the configured sigma (3,) of the IMU's mount about each axis of the body, rad."""
    return np.asarray(problem.config.sensors[problem.imu.sensor].mount_sigma_rad)


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
    if not sigma.any():
        return None
    n = len(problem.timeline)

    def followed(problem: Problem, values: gtsam.Values) -> _Followed:
        rows = linearised(problem, values, verdicts, prior)
        root, J, b = rows.weighed()
        return _followed(J, b, n, root[:, None] * _swung_by_turn(problem, rows, values, verdicts))

    swung = any(_measures_velocity(stream) for stream in problem.streams)
    told = follows = followed(problem, values) if swung else _followed(*sparse_rows(graph, values), n, np.zeros(3))
    if any(stream.left_out is not None for stream in problem.streams):
        # The graph takes the drift of these for motion, which would speak for a turned mount as if it were true.
        told = followed(*with_left_out(problem, values))
    # In sigmas of the mount, because those of some axes may be 0.
    left = told.left * sigma
    unit = np.linalg.inv(left.T @ left + np.eye(3))
    turned = np.divide(problem.imu_turn_rad, sigma, out=np.zeros(3), where=sigma > 0.0)
    turn, cov = sigma * (unit @ (left.T @ told.b - turned)), unit * np.outer(sigma, sigma)
    X = follows.states
    if not (np.isfinite(cov).all() and np.isfinite(turn).all() and np.isfinite(X).all()):
        raise RuntimeError("not finite")
    yaw, var = float(turn[2]), float(cov[2, 2])
    mean_square = np.array([*sigma[:2] ** 2, var + yaw**2])
    # Keys are sorted by letter: velocities and poses come last.
    return MountError(yaw, var**0.5, mean_square, X[-6 * n :].reshape(n, 6, 3), X[-9 * n : -6 * n].reshape(n, 3, 3))


def followed_before(
    problem: Problem, values: gtsam.Values, verdicts: Verdicts, prior: StartPrior, k: int
) -> Array | None:
    """Return how (9, 3) rotation, place and velocity of the IMU at state k, world axes, follow the turn of its mount.

    It is by the data before that state. None where the mount is taken as given. Arguments and errors as of
    `mount_error`.
    """
    if not mount_sigma_rad(problem).any():
        return None
    rows, n = linearised(problem, values, verdicts, prior), len(problem.timeline)
    before = rows.stamps_ns < problem.timeline.stamps_ns[k]
    J, c = rows.weighed().J[before], by_turn(rows.J, n)[before]
    used = abs(J).sum(axis=0) > 0.0
    X = np.zeros((len(used), 3))
    X[used] = -normal_solver(J[:, used])(J[:, used].T @ c)
    if not np.isfinite(X).all():
        raise RuntimeError("not finite")
    R = values.atPose3(keys.pose(k)).rotation().matrix()
    turned, moved = np.split(X[rows.first_pose + 6 * k :][:6], 2)
    return np.vstack([R @ (turned + np.eye(3)), R @ moved, X[rows.first_velocity + 3 * k :][:3]])


class _Followed(NamedTuple):
    """How a linear system follows the turn of the IMU's mount.

    Attributes:
        states: (columns, 3) change of the states. left: (rows, 3) what they leave of the turn in the rows. b: (rows,).
    """

    states: Array
    left: Array
    b: Array


def _followed(J: Any, b: Array, n: int, swung: Array) -> _Followed:
    """Return how a linear system J (rows, columns), b (rows,) of n states follows the turn of the IMU's mount.

    Args:
        swung: (rows, 3) as of `_swung_by_turn`, weighted as J.
    """
    c = by_turn(J, n) + swung
    X = -normal_solver(J)(J.T @ c)
    return _Followed(X, c + J @ X, b)


def _measures_velocity(stream: Stream) -> bool:
    return stream.row.company and not stream.row.absolute


def _swung_by_turn(problem: Problem, rows: Rows, values: gtsam.Values, verdicts: Verdicts) -> Array:
    """Return the part (rows, 3) of c in the rows of velocities.

    The velocity of an antenna or log at l is predicted from that of the body with what the IMU measures, R (w x l), and
    if it is late, with R (f + w' x l + w x (w x l)); w, w' and f turn with the mount. Without that, these rows would
    hold the heading of the body.
    """
    c = np.zeros((len(rows.b), 3))
    for stream in filter(_measures_velocity, problem.streams):
        corrected, used = corrections(solved_constants(stream, values), stream.mount), rows.used(stream)
        off_m, late_s = antenna_off_m(corrected), corrected.get(TIME_OFFSET, 0.0)
        if not used:
            continue
        shift = np.zeros((len(used), 9, 3))
        for by, i in zip(shift, used, strict=True):
            at = verdicts[stream.number, i].at
            arm, w = skew(at.lever_m if off_m is None else at.lever_m + off_m), skew(at.gyro_radps)
            turned = arm @ w
            if late_s and (felt := at.felt) is not None:
                swing = skew(-arm @ at.gyro_radps) @ w + w @ arm @ w
                turned += late_s * (arm @ skew(felt.spin_radps2) + swing - skew(felt.force_mps2))
            by[6:] = at.T_world_body.rotation().matrix() @ turned
        c += rows.moved(stream, used, shift)
    return c


def by_turn(J: Any, n: int) -> Array:
    """Return c (rows, 3) of the module's text.

    In J (rows, columns), the factors of the IMU between the n states come first, and the poses last. Of the other
    factors, the levelling alone has both an attitude and a bias.
    """
    U = np.zeros((J.shape[1], 3))
    U[-6 * n :].reshape(n, 6, 3)[:, :3] = np.eye(3)
    c, links = np.asarray(J @ U), 9 * (n - 1)
    biases = np.flatnonzero(abs(J[:links, : -9 * n]).sum(axis=0))  # columns in its rows besides poses and velocities
    levelling = np.asarray(abs(J[links:, biases]).sum(axis=1)).ravel() > 0.0
    c[links:][~levelling] = 0.0
    return c


def with_mount_estimated(
    problem: Problem, settled: Settled, prior: StartPrior, progress: Progress, most: int
) -> tuple[Problem, Settled, StartPrior, MountError | None]:
    """Turn the mount of the IMU to its most probable yaw, and settle the run again.

    Args:
        most: most passes to settle it.

    Returns:
        The problem, its solution and prior, all unchanged where the mount is near; and the error of the mount by that
            solution, None where the mount is taken as given, or not determined.
    """
    last, sigma = len(problem.timeline) - 1, float(mount_sigma_rad(problem)[2])

    def cost(problem: Problem, settled: Settled, prior: StartPrior) -> float:
        return 0.5 * (float(problem.imu_turn_rad[2]) / sigma) ** 2 + cost_of_run(problem, settled.values, prior)

    def found(problem: Problem, settled: Settled, prior: StartPrior) -> MountError | None:
        try:
            return mount_error(problem, settled.graph, settled.values, settled.verdicts, prior)
        except (RuntimeError, np.linalg.LinAlgError, MemoryError):
            return None

    error, lowest = found(problem, settled, prior), np.inf
    for _ in range(_ROUNDS):
        if error is None or abs(error.yaw_rad) <= max(_MATTERS * sigma, _TOLD * error.sigma_rad):
            break
        turn = np.array([0.0, 0.0, error.yaw_rad])
        if abs(problem.imu_turn_rad + turn).max() > _MOST * sigma:
            break
        if np.isinf(lowest):
            lowest = cost(problem, settled, prior)
        turned, prior_there = with_imu_turned(problem, settled.values, turn), prior.with_imu_turned(turn)
        verdicts = weigh(turned, settled.values, first=0, last=last, stage=Stage.FINAL)
        try:
            again = settle(turned, settled.values, verdicts, prior_there, progress, most)
        except (SolveError, MemoryError):
            break
        if not (now := cost(turned, again, prior_there)) < lowest:
            break
        problem, settled, prior, lowest = turned, again, prior_there, now
        error = found(problem, settled, prior)
    return problem, settled, prior, error
