# SPDX-License-Identifier: Apache-2.0
"""What the slow errors that are left out of the window (`LiveStream.left_out`) do to its newest state.

Nothing tells such an error d from motion, so the estimate follows it: in position by all of it, in heading and velocity by as
much as the IMU lets it. Its covariance is that of a consider parameter (Schmidt 1966) of the filter that the newest state is:
with F, Q from one state to the next, J the information of all measurements since and J_p that of the fixes on the position,

    P+ = ((F P F' + Q)^-1 + J)^-1,    e+ = (1 - P+ J) F e + P+ J_p d

P is computed here, not taken from the window: that is linearised anew now and then, and judges older measurements again, which
its covariances of two states do not tell from what was measured between them. Offline: `graphloc.solve._unmodelled`. Not
handled: what comes late counts as measured at the newest state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import block_diag

from graphloc import keys
from graphloc.frames import Array
from graphloc.graph import Going, InertialLink, SlowProcess
from graphloc.online._anchor import sound
from graphloc.online._live import LiveStream
from graphloc.online._states import Newest, in_world
from graphloc.solve._unmodelled import Unmodelled

_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)


@dataclass(slots=True, eq=False)
class UnmodelledError:
    """What the left-out errors of some receivers do to the newest state.

    Attributes:
        slow: their processes, by receiver.
        cov: (15 + 3 m, 15 + 3 m) of e (rotation, position, velocity in axes of world; bias) and of the m errors (east, north, up).
        newest: the state that it is of. P: (15, 15), covariance of that state without the errors, axes as of e.
    """

    slow: Mapping[str, SlowProcess]
    cov: Array
    newest: Newest
    P: Array

    @classmethod
    def of_start(
        cls, streams: Mapping[str, LiveStream], newest: Newest, P: Array, attitude: Unmodelled | None
    ) -> UnmodelledError | None:
        """Return that of a start, where the position is off by all of the errors; None where no stream leaves any out.

        Args:
            newest, P: the first state of the window. attitude: what the errors have done to attitude and velocity before it;
                None: nothing.
        """
        slow = _left_out(streams)
        if not slow:
            return None
        size = 3 * len(slow)
        of_errors = np.vstack(
            [np.zeros((3, size)), np.hstack([np.eye(3)] * len(slow)), np.zeros((9, size)), np.eye(size)]
        )
        cov = of_errors @ np.diag(np.concatenate([s.sigma**2 for s in slow.values()])) @ of_errors.T
        if attitude is not None:
            cov[_ROTATION, _ROTATION] += attitude.rotation
            cov[_VELOCITY, _VELOCITY] += attitude.velocity
        return cls(slow, cov, newest, P)

    @classmethod
    def resumed(
        cls, streams: Mapping[str, LiveStream], newest: Newest, P: Array, cov: Array | None
    ) -> UnmodelledError | None:
        """Return that of a snapshot, where it is of the same receivers; else that of a start."""
        begun = cls.of_start(streams, newest, P, None)
        if begun is not None and cov is not None and cov.shape == begun.cov.shape:
            begun.cov = cov
        return begun

    def advance(self, newest: Newest, links: InertialLink, told: Mapping[str, Array]) -> None:
        """Follow the window to its newest state; nothing where that is not newer than the last (a window that was rebuilt).

        Args:
            told: by sensor, information (9, 9) of what it measured since the last state: on rotation, position, velocity of the
                state, in axes of world.
        """
        if newest.stamp_ns <= self.newest.stamp_ns:
            return
        dt_s = (newest.stamp_ns - self.newest.stamp_ns) * 1e-9
        F, Q = _step(self.newest, newest, links)
        predicted, J = sound(F @ self.P @ F.T + Q), np.zeros((15, 15))
        J[:9, :9] = sum(told.values(), np.zeros((9, 9)))
        left = np.linalg.inv(np.eye(15) + predicted @ J)  # 1 - P+ J
        self.newest, self.P = newest, sound(left @ predicted)
        followed = np.hstack([self.P[:, :9] @ told[name][:, _POSITION] for name in self.slow])
        decay = np.exp(-dt_s / np.concatenate([s.time_constant_s for s in self.slow.values()]))
        sigma = np.concatenate([s.sigma for s in self.slow.values()])
        # The errors move on first, and the state then follows them.
        on = block_diag(left @ F, np.diag(decay))
        cov = on @ self.cov @ on.T
        cov[15:, 15:] += np.diag(sigma**2 * (1.0 - decay**2))
        follow = np.eye(len(cov))
        follow[:15, 15:] = followed
        self.cov = follow @ cov @ follow.T

    @property
    def rotation(self) -> Array:
        """Covariance (3, 3) that comes on top of the rotation's, rad^2, in axes of world."""
        return self.cov[_ROTATION, _ROTATION]

    @property
    def position(self) -> Array:
        """Likewise of the position (3, 3), m^2."""
        return self.cov[_POSITION, _POSITION]

    @property
    def velocity(self) -> Array:
        """Likewise of the velocity (3, 3), m^2/s^2."""
        return self.cov[_VELOCITY, _VELOCITY]


def _left_out(streams: Mapping[str, LiveStream]) -> dict[str, SlowProcess]:
    return {name: stream.left_out for name, stream in streams.items() if stream.left_out is not None}


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
