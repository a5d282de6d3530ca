# SPDX-License-Identifier: Apache-2.0
"""A motion model of the vessel: bounds the drift of the estimate while nothing but the IMU measures motion.

Along each horizontal axis of the body the velocity is modelled as an Ornstein-Uhlenbeck process about 0:

    b' v_b = phi a' v_a + w,   phi = exp(-dt / tau),   w ~ N(0, s^2 (1 - phi^2)),   2 s^2 (1 - exp(-10 s / tau)) = d^2

v_a, v_b: velocities in world, dt apart; a, b: the axis in world at both times, rotated by the IMU; s: usual speed along the
axis; d: usual change over 10 s. Both are learned while the velocity is known, and added to what any vessel may do. Over a
second the IMU is far more accurate than this model. But the IMU's errors accumulate, above all by those of the tilt, while a vessel's
speed is limited, and its mean acceleration over a minute is small. The filters of the theses use that, too, when they subtract the
mean acceleration.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from graphloc import keys
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import Decision, Residual
from graphloc.linear import Term, linear_update

UNSURE_MPS = 0.2  # sigma of the velocity, above which the model is applied, and below which it is learned
# Speed, and its change within a time, that any vessel may have beyond what was learned.
_SPEED_MPS, _CHANGE_MPS, _OVER_S = 1.0, 0.5, 10.0
_GUESS = (2.0, 1.0)  # m/s: usual speed and change before anything is learned; counts as 10 s of data
_QUICKEST = 0.95  # share of the velocity that may be forgotten within 10 s
_KERNEL = KernelConfig(kind="cauchy", scale=2.0)  # casting off or stopping is unusual: there the IMU prevails


class Moving(NamedTuple):
    """A velocity state as it is estimated: key, velocity (3,) in world, attitude (3, 3) of the body in world."""

    key: int
    v_mps: Array
    R: Array

    @classmethod
    def of(cls, values: Any, k: int) -> Moving:
        """Return the velocity state `k` of some values (gtsam.Values)."""
        key = keys.velocity(k)
        return cls(key, np.asarray(values.atVector(key)), values.atPose3(keys.pose(k)).rotation().matrix())


class MotionModel:
    """Usual speeds and changes of speed along the body's horizontal axes, forward first.

    Args:
        remembered_s: time over which they are averaged, s.
    """

    def __init__(self, remembered_s: float = 300.0) -> None:
        self._remembered_s = remembered_s
        self._speed, self._change = np.full(2, _GUESS[0] ** 2), np.full(2, _GUESS[1] ** 2)  # mean squares
        self._speed_s = self._change_s = _OVER_S  # of data so far
        self._recent: list[tuple[int, Array]] = []

    def learn(self, stamp_ns: int, v_body_mps: Array) -> None:
        """Take in a well-known velocity (2,), forward and left, about once per second."""
        self._recent = [r for r in self._recent if 0 < stamp_ns - r[0] < 1.5e9 * _OVER_S]
        if self._recent:
            dt_s = (stamp_ns - self._recent[-1][0]) * 1e-9
            self._speed_s = min(self._speed_s + dt_s, self._remembered_s)
            self._speed += dt_s / self._speed_s * (v_body_mps**2 - self._speed)
            if before := [v for stamp, v in self._recent if stamp_ns - stamp >= _OVER_S * 1e9]:
                self._change_s = min(self._change_s + dt_s, self._remembered_s)
                self._change += dt_s / self._change_s * ((v_body_mps - before[-1]) ** 2 - self._change)
        self._recent.append((stamp_ns, v_body_mps))

    def process(self, v_body_mps: Array, dt_s: float) -> tuple[Array, Array]:
        """Return phi (2,) and the variances of w (2,), m^2/s^2, over dt_s, for a present velocity v_body_mps (2,)."""
        speed = _SPEED_MPS**2 + np.maximum(self._speed, v_body_mps**2)
        forgotten = np.minimum((_CHANGE_MPS**2 + self._change) / (2.0 * speed), _QUICKEST)
        phi = (1.0 - forgotten) ** (dt_s / _OVER_S)
        return phi, speed * (1.0 - phi**2)

    def step(self, a: Moving, b: Moving, dt_s: float) -> list[Any]:
        """Return the factors of a step from a to b, dt_s later: one per axis, so that stopping along one loosens nothing along the other."""
        phi, variance = self.process((a.R.T @ a.v_mps)[:2], dt_s)
        factors: list[Any] = []
        for axis in range(2):
            J_a, J_b = -phi[axis] * a.R[:, axis][None], b.R[:, axis][None]
            residual = Residual(
                raw=J_a @ a.v_mps + J_b @ b.v_mps,
                cov=variance[axis].reshape(1, 1),
                jacobian=lambda: np.zeros((1, 6)),  # how the axes turned is left to the IMU
            )
            terms = [Term(a.key, a.v_mps, J_a), Term(b.key, b.v_mps, J_b)]
            factors += linear_update(residual, terms, Decision(kernel=_KERNEL)).factors
        return factors
