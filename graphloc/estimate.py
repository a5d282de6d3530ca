# SPDX-License-Identifier: Apache-2.0
"""A pose now: what the online mode hands out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphloc.frames import Array, yaw_from_rotation
from graphloc.solution import Health, HealthReason
from graphloc.trajectory import bounds_95


class Event(NamedTuple):
    """What happened under way.

    Attributes:
        text: a line. warns: it makes the track, or a sensor, doubtful, so that a reader must see it.
        heading_guessed: from here on the heading is a guess, for as long as that is the cause of estimates' health.
    """

    text: str
    warns: bool = True
    heading_guessed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """The body at one time, by what was known then, in two frames as REP 105 has them.

    Attributes:
        stamp_ns: sensor time.
        p_world_m, R_world_body, v_world_mps: (3,), (3, 3), (3,) in `map`: corrected, so it may jump.
        cov: (6, 6) x, y, z (m) and small rotations (rad) about the world's axes. v_cov: (3, 3) of the velocity.
        p_odom_m, R_odom_body: (3,), (3, 3) in `odom`: smooth, never corrected, so it drifts.
        step_cov: (6, 6) of the odometry's step since the estimate before, as `cov`.
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
        """Radius that holds the horizontal position with 95 %: the long axis of its ellipse."""
        return float(bounds_95(self.cov[None])[0, 0])

    @property
    def heading_bound_95_rad(self) -> float:
        """What holds the heading with 95 %."""
        return float(np.radians(bounds_95(self.cov[None])[0, 2]))
