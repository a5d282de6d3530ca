# SPDX-License-Identifier: Apache-2.0
"""The one table of sensors. A new sensor is its measurement, its config, its file here, and one entry."""

from graphloc.config import SensorConfig
from graphloc.factors import aerial, apriltag, compass, gnss, height, imu, pose, velocity
from graphloc.graph import Sensor

INERTIAL = imu.ROW
SENSORS: tuple[Sensor, ...] = (gnss.ROW, compass.ROW, velocity.ROW, pose.ROW, aerial.ROW, apriltag.ROW, height.ROW)
KINDS: dict[str, type[SensorConfig]] = {INERTIAL.kind: INERTIAL.config, **{row.kind: row.config for row in SENSORS}}

__all__ = ["INERTIAL", "KINDS", "SENSORS"]
