# SPDX-License-Identifier: Apache-2.0
"""What the slow errors that are left out of the window (`LiveStream.left_out`) do to its newest state.

Nothing tells such an error d from motion, so the estimate follows it: in position by all of it, in heading and velocity by as
much as the IMU lets it. Its covariance is that of a consider parameter (Schmidt 1966) of the filter that the newest state is:
with F, Q from one state to the next, J the information of all measurements since and J_p that of the fixes on the position,

    P+ = ((F P F' + Q)^-1 + J)^-1,    e+ = (1 - P+ J) F e + P+ J_p d

The state has the slow errors of the other sensors with it: a compass whose mount offset is unknown holds a heading for a while,
but does not tell it. P is computed here, not taken from the window: that is linearised anew now and then, and judges older
measurements again, which its covariances of two states do not tell from what was measured between them. Offline:
`graphloc.solve._unmodelled`. Not handled: what comes late counts as measured at the newest state; the motion model
(after 100 s without fixes the errors are up to 15 % larger for it).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from graphloc import keys
from graphloc.frames import Array
from graphloc.graph import Going, InertialLink, SlowProcess
from graphloc.online._anchor import in_world, sound
from graphloc.online._live import LiveStream
from graphloc.online._states import Newest
from graphloc.solve._unmodelled import Unmodelled

_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
_CORE = 15  # rotation, position, velocity, bias


@dataclass(slots=True, eq=False)
class UnmodelledError:
    """What the left-out errors of some receivers do to the newest state.

    Attributes:
        left_out: their processes, by receiver. estimated: those of the slow errors that the window estimates, by sensor.
        cov: (n + 3 m, n + 3 m) of e (rotation, position, velocity in axes of world; bias; slow errors that are estimated) and of the m
            errors (east, north, up).
        newest: the state that it is of. P: (n, n), covariance of that state without the errors, axes as of e.
    """

    left_out: Mapping[str, SlowProcess]
    estimated: Mapping[str, SlowProcess]
    cov: Array
    newest: Newest
    P: Array

    @classmethod
    def at(
        cls, streams: Mapping[str, LiveStream], newest: Newest, P: Array, attitude: Unmodelled | None, cov: Array | None
    ) -> UnmodelledError | None:
        """Return that of the first state of a window, where the position is off by all of the errors; None where no stream leaves any out.

        Args:
            newest, P: that state. attitude: what the errors have done to attitude and velocity before it; None: nothing.
            cov: `cov` as it was last, taken where it has the size for these streams; None: not known.
        """
        left_out = {name: stream.left_out for name, stream in streams.items() if stream.left_out is not None}
        if not left_out:
            return None
        estimated = {stream.name: slow for stream, slow in estimated_beside(streams)}
        n, m = len(P), len(left_out)
        of_errors = np.vstack([np.zeros((n, 3 * m)), np.eye(3 * m)])
        of_errors[_POSITION] = np.hstack([np.eye(3)] * m)
        begun = of_errors @ np.diag(np.concatenate([s.sigma**2 for s in left_out.values()])) @ of_errors.T
        if attitude is not None:
            # Beside a heading that is off, the offset of a compass that agrees with it is off too.
            turned = np.vstack([np.eye(3), np.linalg.solve(P[_ROTATION, _ROTATION], P[_ROTATION, _CORE:]).T])
            rows = np.r_[_ROTATION, _CORE:n]
            begun[np.ix_(rows, rows)] += turned @ attitude.rotation @ turned.T
            begun[_VELOCITY, _VELOCITY] += attitude.velocity
        if cov is None or cov.shape != begun.shape or not np.isfinite(cov).all():
            cov = begun
        return cls(left_out, estimated, cov, newest, P)

    def advance(self, newest: Newest, links: InertialLink, told: Mapping[str, Array]) -> None:
        """Follow the window to its newest state; nothing where that is not newer than the last (a window that was rebuilt).

        Args:
            told: by sensor, information of what it measured since the last state: (9, 9) on rotation, position, velocity of the state,
                in axes of world; where its slow error is estimated, (9 + k, 9 + k) with that.

        Raises:
            ArithmeticError: the result is not finite. numpy.linalg.LinAlgError, RuntimeError: there is none. Nothing has changed then.
        """
        if newest.stamp_ns <= self.newest.stamp_ns:
            return
        dt_s, n = (newest.stamp_ns - self.newest.stamp_ns) * 1e-9, len(self.P)
        F, Q = np.eye(n), np.zeros((n, n))
        F[:_CORE, :_CORE], Q[:_CORE, :_CORE] = _step(self.newest, newest, links)
        F[_CORE:, _CORE:], Q[_CORE:, _CORE:] = _walks(self.estimated.values(), dt_s)
        predicted, J = sound(F @ self.P @ F.T + Q), np.zeros((n, n))
        first = dict(
            zip(self.estimated, _CORE + np.cumsum([0, *(len(s.sigma) for s in self.estimated.values())]), strict=False)
        )
        for name, information in told.items():
            begin = first.get(name, _CORE)
            rows = np.r_[0:9, begin : begin + len(information) - 9]
            J[np.ix_(rows, rows)] += information
        kept = np.linalg.inv(np.eye(n) + predicted @ J)  # 1 - P+ J
        P = sound(kept @ predicted)
        # The errors move on first, and the state then follows them.
        decay, walk = _walks(self.left_out.values(), dt_s)
        on = np.zeros_like(self.cov)
        on[:n, :n], on[n:, n:] = kept @ F, decay
        cov = on @ self.cov @ on.T
        cov[n:, n:] += walk
        follow = np.eye(len(cov))
        follow[:n, n:] = np.hstack([P[:, :9] @ told[name][:9, _POSITION] for name in self.left_out])
        cov = follow @ cov @ follow.T
        if not (np.isfinite(P).all() and np.isfinite(cov).all()):
            raise ArithmeticError("what slow errors do to the newest state is not finite")
        self.newest, self.P, self.cov = newest, P, 0.5 * (cov + cov.T)

    @property
    def rotation(self) -> Array:
        """Covariance (3, 3) that comes on top of the rotation's, rad^2, in axes of world."""
        return self.cov[_ROTATION, _ROTATION]

    @property
    def velocity(self) -> Array:
        """Likewise of the velocity (3, 3), m^2/s^2."""
        return self.cov[_VELOCITY, _VELOCITY]


def estimated_beside(streams: Mapping[str, LiveStream]) -> list[tuple[LiveStream, SlowProcess]]:
    """Return the streams whose slow errors are estimated and not left out, and these."""
    return [(s, s.slow) for s in streams.values() if s.slow is not None and s.left_out is None]


def _walks(processes: Iterable[SlowProcess], dt_s: float) -> tuple[Array, Array]:
    """Return what is left of slow errors after a time, and the covariance that has come to them."""
    steps = [process.after(dt_s) for process in processes]
    kept, walk = (np.concatenate([np.zeros(0), *(step[n] for step in steps)]) for n in (0, 1))
    return np.diag(kept), np.diag(walk)


def _step(before: Newest, newest: Newest, links: InertialLink) -> tuple[Array, Array]:
    """Return F and Q (15, 15), in axes of world, from one state to the next, by the IMU."""
    start = gtsam.NavState(before.pose, before.velocity)
    pim = links.integrate(before.stamp_ns, newest.stamp_ns, gtsam.imuBias.ConstantBias(), Going.of(start, before.bias))
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
    Q[9:, 9:] = np.diag(links.bias_steps((newest.stamp_ns - before.stamp_ns) * 1e-9) ** 2)
    turn, back = in_world(there.pose()), in_world(before.pose)
    return turn @ F @ back.T, turn @ Q @ turn.T
