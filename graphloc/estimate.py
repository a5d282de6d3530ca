# SPDX-License-Identifier: Apache-2.0
"""What the online mode returns: an estimate of the newest state, and events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphloc.frames import Array, yaw_from_rotation
from graphloc.solution import Health, HealthReason
from graphloc.trajectory import bounds_95


class Event(NamedTuple):
    """Something that happened during the run.

    Attributes:
        text: a line. warns: whether a reader must see it, because it makes the track or a sensor doubtful.
        heading_guessed: whether the heading is a guess from here on; it is one as long as the estimates' health says so
            (`Cause.GUESSED_HEADING`).
    """

    text: str
    warns: bool = True
    heading_guessed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """The body at one time, by what was known then, in the two frames `map` and `odom` of REP 105.

    Attributes:
        stamp_ns: sensor time.
        p_world_m, R_world_body, v_world_mps: (3,), (3, 3), (3,) pose and velocity in `map` (world): corrected, so they may jump.
        cov: (6, 6) x, y, z (m) and small rotations (rad) about the world's axes. v_cov: (3, 3) of the velocity.
        p_odom_m, R_odom_body: (3,), (3, 3) pose in `odom`: smooth and never corrected, so it drifts.
        step_cov: (6, 6) of the step in `odom` since the estimate before, axes as of `cov`.
        gyro_radps: (3,) rate of the body, body axes, bias removed. gyro_cov: (3, 3) of it, rad^2/s^2.
        accel_bias_mps2, gyro_bias_radps: (3,) in IMU axes.
        health, reason: how far it can be trusted, and why not fully.
        since_agreed_s: s since each absolute sensor last agreed; inf: never.
    """

    stamp_ns: int
    p_world_m: Array
    R_world_body: Array
    v_world_mps: Array
    cov: Array
    v_cov: Array
    p_odom_m: Array
    R_odom_body: Array
    step_cov: Array
    gyro_radps: Array
    gyro_cov: Array
    accel_bias_mps2: Array
    gyro_bias_radps: Array
    health: Health
    reason: HealthReason
    since_agreed_s: Mapping[str, float]

    @property
    def yaw_rad(self) -> float:
        """Yaw: from east, counter-clockwise."""
        return float(yaw_from_rotation(self.R_world_body))

    @property
    def map_from_odom(self) -> tuple[Array, Array]:
        """Translation (3,) and rotation (3, 3) of `odom` in `map`."""
        R = self.R_world_body @ self.R_odom_body.T
        return self.p_world_m - R @ self.p_odom_m, R

    @property
    def bound_95_m(self) -> float:
        """Radius of a circle that holds the horizontal position with at least 95 %: semi-major axis of the 95 % ellipse."""
        return float(bounds_95(self.cov[None])[0, 0])

    @property
    def heading_bound_95_rad(self) -> float:
        """Half width of the interval that holds the heading with 95 %."""
        return float(np.radians(bounds_95(self.cov[None])[0, 2]))
