# SPDX-License-Identifier: Apache-2.0
"""Effect of left-out slow errors (`LiveStream.left_out`), and of a wrong IMU mount, on the window's newest state.

Nothing tells a left-out error d from motion, so the estimate follows it: in position by all of d, in heading and
velocity as far as the IMU allows it. While no fixes come, the error of the velocity adds to that of the position. The
newest state is that of a filter, and d is a consider parameter of it (Schmidt 1966). With

- e: error of the newest state that d causes; P: covariance of that state without d;
- F, Q: transition and process noise from one state to the next;
- J: information of all measurements since the last state; J_p: that of the fixes, on the position;
- +: after the step,

    P+ = ((F P F' + Q)^-1 + J)^-1,    e+ = (1 - P+ J) F e + P+ J_p d

If the IMU's mount is turned by m, body axes, the IMU measures the motion of a body turned by U m, and the other sensors
that of the true body. The error against the turned body then obeys e+ + U+ m = (1 - P+ J) F (e + U m) + P+ J U+ m,
which is linear in m.

The state includes the slow errors of the other sensors: a compass whose mount offset is unknown holds a heading for a
while, but does not tell it. P is computed here and not taken from the window. The window is relinearised now and then,
and judges older measurements again; its covariances of two states do not separate that from the measurements between
them. Where the window has the motion model (`graphloc.motion_model`), F and Q include it, without its kernel.

Offline: `graphloc.solve.unmodelled`; `graphloc.solve.imu_mount`, where m is estimated, too. Not handled: late
measurements count as measured at the newest state.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from graphloc import keys
from graphloc.frames import Array, skew
from graphloc.graph import SlowProcess
from graphloc.inertial import GapMotion, InertialLink
from graphloc.judge.covariances import Unmodelled, untold_errors
from graphloc.motion_model import MotionModel
from graphloc.online._anchor import in_world, sound
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._states import Newest, hole_within
from graphloc.time import NS_PER_S

_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
_CORE = 15  # rotation, position, velocity, bias
# Time between updates where only the mount has an effect, to save time: that effect changes over seconds; a choice.
_MOUNT_EVERY_S = 0.5


class BeforeStart(NamedTuple):
    """Effect on the first state of a window by data before the window.

    Attributes:
        slow: of left-out slow errors; None: not known. by_mount: (9, 3) first rows of `UnmodelledError.by_mount`; None:
            not known.
    """

    slow: Unmodelled | None
    by_mount: Array | None


class ErrorSizes(NamedTuple):
    """`cov` and `by_mount` of an `UnmodelledError`."""

    cov: Array
    by_mount: Array

    def fits(self, other: ErrorSizes) -> bool:
        """Return whether all arrays are finite and have the shapes of the other's."""
        same = all(a.shape == b.shape for a, b in zip(self, other, strict=True))
        return same and all(bool(np.isfinite(a).all()) for a in self)


@dataclass(slots=True, eq=False)
class UnmodelledError:
    """Effect of the left-out slow errors of r receivers, and of the IMU's mount, on the newest state.

    Attributes:
        left_out: processes of the left-out slow errors, by receiver. estimated: of the slow errors in the window, by
            sensor.
        cov: (n + 3 r, n + 3 r) covariance of e (rotation, position, velocity in axes of world; bias; estimated slow
            errors) and of the left-out slow errors (east, north, up each).
        by_mount: (n, 3) derivative of e + U m by the turn m of the IMU's mount, body axes. mount_sigma_rad: (3,) 1 sigma
            of m.
        newest: the newest state. P: (n, n), its covariance without these effects, in the order and axes of e.
    """

    left_out: Mapping[str, SlowProcess]
    estimated: Mapping[str, SlowProcess]
    cov: Array
    by_mount: Array
    mount_sigma_rad: Array
    newest: Newest
    P: Array

    @classmethod
    def at(
        cls, problem: LiveProblem, newest: Newest, P: Array, begun: BeforeStart | None, last: ErrorSizes | None
    ) -> UnmodelledError | None:
        """Return the effect on a window's first state, whose position is off by the whole of each left-out error.

        None where no error is left out and the IMU's mount is known exactly.

        Args:
            problem: of the window. newest, P: first state, and its covariance without these effects.
            begun: effect of data before the window; None: none.
            last: sizes at the end of the window before, taken over if their shapes fit these streams; None: there are
                none.
        """
        streams = problem.streams
        left_out = untold_errors(list(streams.values()))
        mount_sigma_rad = problem.imu_mount_sigma_rad
        if not left_out and not mount_sigma_rad.any():
            return None
        estimated = {stream.name: slow for stream, slow in estimated_beside(streams)}
        n, m = len(P), len(left_out)
        of_errors = np.vstack([np.zeros((n, 3 * m)), np.eye(3 * m)])
        of_errors[_POSITION] = np.tile(np.eye(3), m)
        sigma = np.concatenate([np.zeros(0), *(slow.sigma for slow in left_out.values())])
        cov = of_errors @ np.diag(sigma**2) @ of_errors.T
        # If the heading is off, so is the estimated offset of a compass that agrees with it.
        turned = np.vstack([np.eye(3), np.linalg.solve(P[_ROTATION, _ROTATION], P[_ROTATION, _CORE:]).T])
        rows = np.r_[_ROTATION, _CORE:n]
        R = newest.pose.rotation().matrix()
        by_mount = np.zeros((n, 3))
        # At the first data the IMU levels itself, so roll and pitch follow m; sensors tell the heading of the body
        by_mount[2] = R[2]
        if begun is not None and begun.slow is not None:
            cov[np.ix_(rows, rows)] += turned @ begun.slow.rotation @ turned.T
            cov[_VELOCITY, _VELOCITY] += begun.slow.velocity
        if begun is not None and begun.by_mount is not None:
            by_mount[:9] = begun.by_mount
            by_mount[_CORE:] = turned[3:] @ (begun.by_mount[_ROTATION] - R)
        sizes = ErrorSizes(cov, by_mount)
        if last is not None and last.fits(sizes):
            sizes = last
        return cls(left_out, estimated, *sizes, mount_sigma_rad, newest, P)

    @property
    def sizes(self) -> ErrorSizes:
        """The sizes that a window which replaces this one takes over."""
        return ErrorSizes(self.cov, self.by_mount)

    def due(self, stamp_ns: int) -> bool:
        """Return whether the effect must be brought up to a stamp; that of the mount alone changes slowly."""
        return bool(self.left_out) or stamp_ns - self.newest.stamp_ns >= _MOUNT_EVERY_S * NS_PER_S

    def advance(
        self, newest: Newest, links: InertialLink, told: Mapping[str, Array], motion_model: MotionModel
    ) -> None:
        """Follow the window to its newest state; nothing changes if that is not newer than the last (a rebuild).

        Args:
            newest: the newest state. links: preintegration of the IMU. motion_model: of the vessel.
            told: by sensor, information of its measurements since the last state: (9, 9) on rotation, position,
                velocity of the state, in axes of world; if its slow error is estimated, (9 + k, 9 + k) with that.

        Raises:
            ArithmeticError: the result is not finite. numpy.linalg.LinAlgError, RuntimeError: there is no result.
                Nothing has changed then.
        """
        if newest.stamp_ns <= self.newest.stamp_ns:
            return
        dt_s, n = (newest.stamp_ns - self.newest.stamp_ns) * 1e-9, len(self.P)
        F, Q = np.eye(n), np.zeros((n, n))
        F[:_CORE, :_CORE], Q[:_CORE, :_CORE] = _step(self.newest, newest, links)
        F[_CORE:, _CORE:], Q[_CORE:, _CORE:] = _walks(self.estimated.values(), dt_s)
        predicted, J = sound(F @ self.P @ F.T + Q), np.zeros((n, n))
        if newest.unsure and not hole_within(links, self.newest.stamp_ns, newest.stamp_ns):
            F, predicted = _by_motion_model(motion_model, self.newest, newest, self.P, F, Q)
        first = dict(
            zip(self.estimated, _CORE + np.cumsum([0, *(len(s.sigma) for s in self.estimated.values())]), strict=False)
        )
        for name, information in told.items():
            begin = first.get(name, _CORE)
            rows = np.r_[0:9, begin : begin + len(information) - 9]
            J[np.ix_(rows, rows)] += information
        kept = np.linalg.inv(np.eye(n) + predicted @ J)  # 1 - P+ J
        P = sound(kept @ predicted)
        by_mount = kept @ (F @ self.by_mount) + (np.eye(n) - kept)[:, _ROTATION] @ newest.pose.rotation().matrix()
        # The errors move on first, and the state then follows them.
        decay, walk = _walks(self.left_out.values(), dt_s)
        on = np.zeros_like(self.cov)
        on[:n, :n], on[n:, n:] = kept @ F, decay
        cov = on @ self.cov @ on.T
        cov[n:, n:] += walk
        follow = np.eye(len(cov))
        follow[:n, n:] = np.hstack(
            [np.zeros((n, 0)), *(P[:, :9] @ told[name][:9, _POSITION] for name in self.left_out)]
        )
        cov = follow @ cov @ follow.T
        if not (np.isfinite(P).all() and np.isfinite(cov).all() and np.isfinite(by_mount).all()):
            raise ArithmeticError("what slow errors do to the newest state is not finite")
        self.newest, self.P, self.cov, self.by_mount = newest, P, 0.5 * (cov + cov.T), by_mount

    def pose(self, lever_m: Array, ahead_s: float = 0.0) -> Array:
        """Return the covariance (6, 6) to add to that of a point of the body and of the attitude, in axes of world.

        The variance of the position is at least the standing one of the left-out errors. That also covers a height that
        was taken once from the fixes, although it counts as measured here.

        Args:
            lever_m: (3,) from the IMU to the point, axes of world. ahead_s: for how long the newest state is propagated
                by the IMU.
        """
        of_point = np.zeros((6, 9))
        of_point[:3, _ROTATION], of_point[:3, _POSITION], of_point[:3, _VELOCITY] = (
            -skew(lever_m),
            np.eye(3),
            ahead_s * np.eye(3),
        )
        of_point[3:, _ROTATION] = np.eye(3)
        cov = of_point @ self.cov[:9, :9] @ of_point.T
        standing = sum((slow.sigma**2 for slow in self.left_out.values()), np.zeros(3))
        cov[:3, :3] += np.diag(np.maximum(standing - np.diagonal(cov)[:3], 0.0))
        turned = self.by_mount[_ROTATION] - self.newest.pose.rotation().matrix()
        by = np.vstack([self.by_mount[_POSITION] - skew(lever_m) @ turned, turned]) * self.mount_sigma_rad
        return np.asarray(cov + by @ by.T)

    @property
    def velocity(self) -> Array:
        """Covariance (3, 3), m^2/s^2, to add to that of the velocity."""
        by = self.by_mount[_VELOCITY] * self.mount_sigma_rad
        return np.asarray(self.cov[_VELOCITY, _VELOCITY] + by @ by.T)


def estimated_beside(streams: Mapping[str, LiveStream]) -> list[tuple[LiveStream, SlowProcess]]:
    """Return the streams whose slow errors are estimated and not left out, each with its slow error."""
    return [(s, s.slow) for s in streams.values() if s.slow is not None and s.left_out is None]


def _walks(processes: Iterable[SlowProcess], dt_s: float) -> tuple[Array, Array]:
    """Return the transition matrix (k, k) of slow errors over a time, and the covariance (k, k) of their walk."""
    steps = [process.after(dt_s) for process in processes]
    kept, walk = (np.concatenate([np.zeros(0), *(step[n] for step in steps)]) for n in (0, 1))
    return np.diag(kept), np.diag(walk)


def _by_motion_model(
    model: MotionModel, before: Newest, newest: Newest, P: Array, F: Array, Q: Array
) -> tuple[Array, Array]:
    """Return F and the predicted covariance (n, n) if the motion model constrains the velocity, too.

    It acts as a measurement of b' v_b - phi a' v_a, with the variance of w (see `graphloc.motion_model`).
    """
    a, b = (state.pose.rotation().matrix()[:, :2].T for state in (before, newest))
    phi, variance = model.process(a @ before.velocity, (newest.stamp_ns - before.stamp_ns) / NS_PER_S)
    later = np.zeros((2, len(P)))
    later[:, _VELOCITY] = b
    by_before = later @ F
    by_before[:, _VELOCITY] -= phi[:, None] * a
    shared = F @ P @ by_before.T + Q @ later.T  # covariance of the newest state and what is measured
    S = by_before @ P @ by_before.T + later @ Q @ later.T + np.diag(variance)
    gain = np.linalg.solve(S, shared.T).T
    return F - gain @ by_before, sound(F @ P @ F.T + Q - gain @ shared.T)


def _step(before: Newest, newest: Newest, links: InertialLink) -> tuple[Array, Array]:
    """Return F and Q (15, 15), in axes of world, from one state to the next by the IMU."""
    start = gtsam.NavState(before.pose, before.velocity)
    pim = links.integrate(
        before.stamp_ns, newest.stamp_ns, gtsam.imuBias.ConstantBias(), GapMotion.of(start, before.bias)
    )
    there, values = pim.predict(start, before.bias), gtsam.Values()
    for k, state in enumerate((start, there)):
        values.insert(keys.pose(k), state.pose())
        values.insert(keys.velocity(k), np.asarray(state.velocity()))
    values.insert(keys.bias(0), before.bias)
    order = gtsam.Ordering()
    for key in (keys.pose(0), keys.velocity(0), keys.bias(0), keys.pose(1), keys.velocity(1)):
        order.push_back(key)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(links.factor(0, 0, pim))
    J, _ = graph.linearize(values).jacobian(order)
    to_there = np.linalg.inv(J[:, 15:])
    F, Q = np.eye(15), np.zeros((15, 15))
    F[:9] = -to_there @ J[:, :15]
    Q[:9, :9] = to_there @ to_there.T
    Q[9:, 9:] = np.diag(links.bias_steps(before.stamp_ns, newest.stamp_ns) ** 2)
    turn, back = in_world(there.pose()), in_world(before.pose)
    return turn @ F @ back.T, turn @ Q @ turn.T
