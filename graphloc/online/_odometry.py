# SPDX-License-Identifier: Apache-2.0
"""The `odom` frame of REP 105: IMU steps added up and never corrected, so that the pose in it never jumps.

A step is the propagation of the newest state by the IMU, with velocity and bias as estimated then. Corrections in world
change the next step, not the last pose. Roll and pitch are pulled slowly towards those in world, which do not drift; by
the gyroscope alone they would.
"""

from __future__ import annotations

import gtsam
import numpy as np

from graphloc.frames import Array

_LEAN_S = 5.0  # time constant with which roll and pitch in odom follow those in world; a choice
_LEAN_RAD = 2e-3  # largest such correction in a step, so that the pose does not jump
_FLOOR = np.diag([1e-6] * 3 + [1e-8] * 3)  # smallest covariance of a step: errors of the integration itself; m^2, rad^2


class Odometry:
    """Pose of the body in `odom`, and the stamp that it has reached: after a rebuild, no stretch counts twice.

    Attributes:
        stamp_ns: of the pose. p_m: (3,), m, in odom. R: (3, 3) body -> odom.
        step_cov: (6, 6) of the motion since `begin`: position (m), then rotation (rad), axes of odom.
    """

    def __init__(self, stamp_ns: int, p_m: Array, R: Array) -> None:
        self.stamp_ns, self.p_m, self.R = stamp_ns, np.array(p_m), np.array(R)
        self.step_cov = np.array(_FLOOR)

    def begin(self) -> None:
        """Start a new sum for `step_cov`: the motion from here to the next estimate."""
        self.step_cov = np.array(_FLOOR)

    def after(self, dp_body_m: Array, dR: Array) -> tuple[Array, Array]:
        """Return the pose (3,), (3, 3) after a step, which is given in the axes of the body before it."""
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
        """Add a step.

        Args:
            until_ns: stamp of its end. dt_s: its duration. dp_body_m, dR: (3,), (3, 3) as of `after`.
            R_world_body: (3, 3) attitude in world after it. v_cov_body: (3, 3) covariance of the velocity before it,
                body axes.
            noise: (6, 6) covariance by the IMU's noise over it: rotation, then position, body axes.
        """
        cov = np.array(_FLOOR)
        cov[:3, :3] += self.R @ (dt_s**2 * v_cov_body + noise[3:, 3:]) @ self.R.T
        cov[3:, 3:] += self.R @ noise[:3, :3] @ self.R.T
        self.p_m, R = self.after(dp_body_m, dR)
        up = R @ R_world_body[2]  # world's up by the estimate, in axes of odom; it should be the z axis
        # up x z written out: `np.cross` takes as long as all else here.
        lean = np.array([up[1], -up[0], 0.0]) * min(dt_s / _LEAN_S, 1.0)
        size = float(np.linalg.norm(lean))
        lean *= min(1.0, _LEAN_RAD / size) if size > 0.0 else 1.0
        R = gtsam.Rot3.Expmap(lean).matrix() @ R
        # Newton's step to the nearest rotation: rounding adds up over a day of steps.
        self.R = R @ (1.5 * np.eye(3) - 0.5 * R.T @ R)
        cov[3:, 3:] += size**2 * 0.1 * np.eye(3)
        self.stamp_ns, self.step_cov = until_ns, self.step_cov + cov
