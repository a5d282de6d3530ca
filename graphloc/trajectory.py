# SPDX-License-Identifier: Apache-2.0
"""Trajectories of the body in world, and their interpolation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from graphloc.chi2 import SIGMAS_95, chi2_95
from graphloc.frames import Array, rpy_from_rotation, yaw_from_rotation
from graphloc.signals.series import interpolated
from graphloc.time import seconds_since

_MOST_APART_S = 1.0  # most time between two poses with which the trajectory between them counts as known
# Of few states a second each may lie 0.4 periods off its place, on a measurement close by, so that up to 1.8 periods lie between two:
# at most so many times what three quarters do not exceed. The most, as configurations have more than one state in 2 s.
_TIMES, _SLOWEST_S = 2.5, 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses of body in world at increasing stamps.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing.
        p_world_m: (N, 3).
        R_world_body: (N, 3, 3).
        v_world_mps: (N, 3), or None where velocity is not known (then interpolation is linear).
        cov: (N, 6, 6) or None: x, y, z (m) and small rotations (rad), all about the world's axes.
        planar: whether height, roll and pitch are not estimated.
        headed: whether its rotations are known; if not, as of a prism or an antenna that is the truth, they are the identity.
    """

    stamps_ns: NDArray[np.int64]
    p_world_m: Array
    R_world_body: Array
    v_world_mps: Array | None = None
    cov: Array | None = None
    planar: bool = False
    headed: bool = True

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        if n > 1 and (np.diff(self.stamps_ns) <= 0).any():
            raise ValueError("trajectory stamps must increase strictly")
        if self.p_world_m.shape != (n, 3) or self.R_world_body.shape != (n, 3, 3):
            raise ValueError("trajectory columns disagree in length")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def rpy_rad(self) -> Array:
        """Roll, pitch, yaw (N, 3) in rad; yaw from east, counter-clockwise."""
        return rpy_from_rotation(self.R_world_body)

    @property
    def yaw_rad(self) -> Array:
        """Yaw (N,): direction of the body's x axis in the world's horizontal plane."""
        return yaw_from_rotation(self.R_world_body)

    def where(self, kept: NDArray[np.bool_] | slice) -> Trajectory:
        """Return some of its poses; `kept`: (N,) whether each is kept, or a slice."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[kept],
            p_world_m=self.p_world_m[kept],
            R_world_body=self.R_world_body[kept],
            v_world_mps=None if self.v_world_mps is None else self.v_world_mps[kept],
            cov=None if self.cov is None else self.cov[kept],
        )

    def covers(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (M,) whether each stamp lies inside the span and between poses at most a second apart, or some periods of slower ones."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        right = np.clip(np.searchsorted(self.stamps_ns, stamps, side="left"), 1, len(self) - 1)
        gap = (self.stamps_ns[right] - self.stamps_ns[right - 1]) / 1e9
        inside = (stamps >= self.stamps_ns[0]) & (stamps <= self.stamps_ns[-1])
        wide = gap > _MOST_APART_S
        if not (inside & wide).any():
            return np.asarray(inside)
        usual_s = float(np.quantile(np.diff(self.stamps_ns), 0.75)) / 1e9
        return np.asarray(inside & (gap <= np.clip(_TIMES * usual_s, _MOST_APART_S, _SLOWEST_S)))

    def _around(self, stamps: NDArray[np.int64]) -> slice:
        """Return the poses that interpolation at these stamps needs."""
        if not len(stamps):
            return slice(None)
        first = int(np.searchsorted(self.stamps_ns, stamps.min(), side="right")) - 2
        return slice(max(first, 0), int(np.searchsorted(self.stamps_ns, stamps.max(), side="left")) + 2)

    def at(self, stamps_ns: NDArray[np.int64]) -> Trajectory:
        """Return the trajectory at M stamps inside its span: position by cubic Hermite splines, attitude by slerp.

        Velocity is the derivative of the position. Without velocities, position is linear. Covariances are linear between two poses. If that
        of the nearest pose were taken, a place halfway through an outage would have the small covariance of the fix that ends it.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        if len(stamps) and (stamps[0] < self.stamps_ns[0] or stamps[-1] > self.stamps_ns[-1]):
            raise ValueError("stamps outside the trajectory: select with covers() first")
        near = self._around(stamps)  # an interpolator of 20 000 poses costs 18 ms
        origin = int(self.stamps_ns[0])
        t, s = seconds_since(origin, self.stamps_ns[near]), seconds_since(origin, stamps)
        velocity: Array | None = None
        if self.v_world_mps is None:
            position = interpolated(s, t, self.p_world_m[near])
        else:
            spline = CubicHermiteSpline(t, self.p_world_m[near], self.v_world_mps[near])
            position, velocity = spline(s), spline(s, 1)
        rotation = Slerp(t, Rotation.from_matrix(self.R_world_body[near]))(s).as_matrix()
        cov = None
        if self.cov is not None:
            right = np.clip(np.searchsorted(t, s), 1, len(t) - 1)
            share = ((s - t[right - 1]) / np.maximum(t[right] - t[right - 1], 1e-9))[:, None, None]
            cov = (1.0 - share) * self.cov[near][right - 1] + share * self.cov[near][right]
        return Trajectory(
            stamps_ns=stamps,
            p_world_m=position,
            R_world_body=rotation,
            v_world_mps=velocity,
            cov=cov,
            planar=self.planar,
            headed=self.headed,
        )

    def poses_at(self, stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return positions (M, 3) and rotations (M, 3, 3) at M stamps inside its span; these may be in any order, and repeat."""
        moments, index = np.unique(stamps_ns, return_inverse=True)
        there = self.at(moments)
        return there.p_world_m[index], there.R_world_body[index]


def bounds_95(cov: Array) -> Array:
    """95 % bounds (N, 3) of covariances (N, 6, 6) as a `Trajectory` has them: horizontal radius m, height m, heading deg.

    The radius is the semi-major axis of the 95 % ellipse, so the circle holds at least 95 %.
    """
    major = np.linalg.eigvalsh(cov[:, :2, :2])[:, -1]
    return np.column_stack(
        [np.sqrt(chi2_95(2) * major), SIGMAS_95 * np.sqrt(cov[:, 2, 2]), SIGMAS_95 * np.degrees(np.sqrt(cov[:, 5, 5]))]
    )
