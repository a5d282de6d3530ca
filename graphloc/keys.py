# SPDX-License-Identifier: Apache-2.0
"""The only place that makes keys of the graph.

X pose of body in world (Pose3); V velocity in world (3,); B IMU bias (accelerometer, gyroscope);
S slow state of a sensor, C constant of one (vectors), labelled with the sensor's number; A, L leaves of one
measurement.
"""

from __future__ import annotations

import gtsam


def pose(k: int) -> int:
    """Key of the pose of state `k`."""
    return int(gtsam.symbol("x", k))


def velocity(k: int) -> int:
    """Key of the velocity of state `k`."""
    return int(gtsam.symbol("v", k))


def bias(j: int) -> int:
    """Key of the IMU bias of slow node `j`."""
    return int(gtsam.symbol("b", j))


def slow(sensor_number: int, j: int) -> int:
    """Key of the slow state of a sensor at slow node `j`."""
    return int(gtsam.LabeledSymbol(ord("s"), ord("A") + sensor_number, j).key())


def constant(sensor_number: int, k: int) -> int:
    """Key of constant `k` of a sensor."""
    return int(gtsam.LabeledSymbol(ord("c"), ord("A") + sensor_number, k).key())


def leaves(seq: int) -> tuple[int, int]:
    """Keys of the two leaves (antenna in world, lever arm) of measurement number `seq`."""
    return int(gtsam.symbol("a", seq)), int(gtsam.symbol("l", seq))
