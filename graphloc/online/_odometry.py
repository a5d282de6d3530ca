# SPDX-License-Identifier: Apache-2.0
"""The `odom` frame of REP 105: what the IMU says of each step, never corrected, so that it never jumps.

A step is where the IMU carries the newest state, with its velocity and bias as they are known then. What the
map's corrections change is the next step, not the last pose. Roll and pitch lean towards the map's, slowly: they
are known for good, and left to themselves would wander with the gyroscope.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.frames import Array

_LEAN_S = 5.0
_LEAN_RAD = 2e-3  # at most, in a step: no jump
_FLOOR = np.diag([1e-6] * 3 + [1e-8] * 3)  # of a step: what integrating samples leaves over


class Odometry:
    """Pose of the body in `odom`, and how far in time it has been carried: no stretch counts twice, whatever is built anew."""

    def __init__(self, stamp_ns: int, p_m: Array, R: Array) -> None:
        self.stamp_ns, self.p_m, self.R = stamp_ns, np.array(p_m), np.array(R)
        self.step_cov = np.array(_FLOOR)

    def begin(self) -> None:
        """From here on steps count towards the next estimate."""
        self.step_cov = np.array(_FLOOR)

    def after(self, dp_body_m: Array, dR: Array) -> tuple[Array, Array]:
        """Return the pose a step later; the step in the axes of the body before it."""
        return self.p_m + self.R @ dp_body_m, self.R @ dR

    def step(
        self,
        until_ns: int,
        dt_s: float,
        dp_body_m: Array,
        dR: Array,
        R_world_body: Array,
        v_cov_body: Array,
        noise: Array,
    ) -> None:
        """Go a step on.

        Args:
            until_ns: its end. dt_s: how long it took. dp_body_m, dR: as above. R_world_body: the map's attitude after it.
            v_cov_body: (3, 3) of the velocity before it. noise: (6, 6) of the IMU over it: rotation, place, body axes.
        """
        cov = np.array(_FLOOR)
        cov[:3, :3] += self.R @ (dt_s**2 * v_cov_body + noise[3:, 3:]) @ self.R.T
        cov[3:, 3:] += self.R @ noise[:3, :3] @ self.R.T
        self.p_m, R = self.after(dp_body_m, dR)
        up = R @ R_world_body[2]  # where the map says that up is; both frames have it along z
        lean = np.cross(up, np.array([0.0, 0.0, 1.0])) * min(dt_s / _LEAN_S, 1.0)
        size = float(np.linalg.norm(lean))
        lean *= min(1.0, _LEAN_RAD / size) if size > 0.0 else 1.0
        self.R = np.asarray(Rotation.from_rotvec(lean).as_matrix() @ R)
        self.R = np.asarray(Rotation.from_matrix(self.R).as_matrix())  # a rotation still, after a day of steps
        cov[3:, 3:] += size**2 * 0.1 * np.eye(3)
        self.stamp_ns, self.step_cov = until_ns, self.step_cov + cov
