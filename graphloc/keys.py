# SPDX-License-Identifier: Apache-2.0
"""The only place that makes keys of the graph.

X pose of body in world (Pose3); V velocity in world (3,); B IMU bias (accelerometer, gyroscope);
S slow state of a sensor, C constant of one (vectors), labelled with the sensor's number; A, L leaves of one
measurement: of a fix, antenna in world and lever arm (Point3); of a sighting of a floating dock, A is the dock's slow state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STATES, NODES, LEAVES = "xv", "bs", "al"  # letters of what there is for each state, slow node and measurement

# GTSAM's layout of `symbol` and `LabeledSymbol`, held by a test: a run asks for keys so often that calls into it show.
_X, _V, _B, _A, _L, _S, _C = (ord(letter) << 56 for letter in "xvbalsc")
_FIRST_LABEL = ord("A")
_MEASUREMENTS_OF_A_SENSOR = 100_000_000  # more than one has in a run: at 200 Hz it would take six days


def pose(k: int) -> int:
    """Key of the pose of state `k`."""
    return _X + k


def is_pose(key: int) -> bool:
    """Whether a key is that of a pose."""
    return key >> 56 == ord("x")


def is_leaf(key: int) -> bool:
    """Whether a key is that of a leaf of one measurement."""
    return chr(key >> 56) in LEAVES


def velocity(k: int) -> int:
    """Key of the velocity of state `k`."""
    return _V + k


def bias(j: int) -> int:
    """Key of the IMU bias of slow node `j`."""
    return _B + j


def slow(sensor_number: int, j: int) -> int:
    """Key of the slow state of a sensor at slow node `j`."""
    return _S + ((_FIRST_LABEL + sensor_number) << 48) + j


def constant(sensor_number: int, k: int) -> int:
    """Key of constant `k` of a sensor."""
    return _C + ((_FIRST_LABEL + sensor_number) << 48) + k


def leaves(sensor_number: int, i: int) -> tuple[int, int]:
    """Keys of the two leaves, A and L, of measurement `i` of a sensor."""
    number = sensor_number * _MEASUREMENTS_OF_A_SENSOR + i
    return _A + number, _L + number


def parts(keys: NDArray[np.uint64]) -> tuple[NDArray[np.str_], NDArray[np.int64]]:
    """Return the letters (N,) and the numbers (N,) of the state, node, constant or measurement of N keys."""
    letter = (keys >> np.uint64(56)).astype(np.uint32).view("U1")
    return letter, (keys & np.uint64((1 << 48) - 1)).astype(np.int64)
