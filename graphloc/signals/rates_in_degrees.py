# SPDX-License-Identifier: Apache-2.0
"""Whether an IMU's rates are in deg/s, by how they roll the vessel and turn gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.frames import Array

_SWING_NS, _NO_SWING_RAD = 5_000_000_000, 1.5
_WHOLE = 0.8  # least share of a window at the end: in a shorter one there is less swing
_STEP_S = 0.2  # longest step over which rates are integrated
_GRAVITY_S, _FEWEST_WINDOWS = 0.4, 10  # duration and least number of windows whose mean acceleration tells where up is
_EXPLAINED = 0.75  # largest share of the motion of gravity's direction that rates in rad/s leave unexplained


def without_gravity(accel: Array) -> bool:
    """Return whether accelerations (N, 3), m/s^2 or g, lack gravity: they are small, without a constant direction."""
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    steady = float(np.linalg.norm(np.median(accel, axis=0)))
    return size < 0.5 or (size < 2.0 and steady < 0.5 * size)


def turns_gravity(stamps_ns: NDArray[np.int64], accel: Array, gyro_radps: Array) -> bool:
    """Return whether rates (N, 3) turn the direction of accelerations (N, 3) as rad/s would; deg/s turn it by far more.

    Gravity keeps its direction in world while the sensor turns. Accelerations also hold the thrust of a craft or a
    hand, so half of the windows may not fit. Rates that are 57 times too large fit in no window. If they turn by more
    than half a turn in a window, nothing is told.
    """
    t = (stamps_ns - stamps_ns[0]) / 1e9
    begins = np.unique((t / _GRAVITY_S).astype(np.int64), return_index=True)[1]
    if len(begins) < _FEWEST_WINDOWS:
        return False
    counts = np.diff(begins, append=len(t))[:, None]
    mean = np.add.reduceat(accel, begins) / counts
    up = mean / np.maximum(np.linalg.norm(mean, axis=1), 1e-9)[:, None]
    steps_s = np.minimum(np.diff(t, prepend=t[0]), _STEP_S)
    turned = np.diff(np.add.reduceat(np.cumsum(gyro_radps * steps_s[:, None], axis=0), begins) / counts, axis=0)
    left = np.linalg.norm(up[1:] - Rotation.from_rotvec(-turned).apply(up[:-1]), axis=1)
    moved = np.linalg.norm(np.diff(up, axis=0), axis=1)
    round_and_round = float(np.median(np.linalg.norm(turned, axis=1))) > np.pi
    return not round_and_round and float(np.median(left)) < _EXPLAINED * float(np.median(moved))


def swing_of_degrees(stamps_ns: NDArray[np.int64], accel_mps2: Array, gyro_radps: Array) -> float:
    """Return by how much rates (N, 3) roll and pitch the vessel within 5 s (median), rad, if they look like deg/s; else 0.

    A small boat in chop has high rates, and a vehicle may pivot fast, but none rolls by a quarter turn all the time.
    What does, as a camera in the hand, turns gravity as its rates say.
    """
    up = np.median(accel_mps2, axis=0) if len(accel_mps2) >= 10 else np.zeros(3)
    size = float(np.linalg.norm(up))
    if size < 0.5 or without_gravity(accel_mps2):
        return 0.0
    level = gyro_radps - np.outer(gyro_radps @ up, up) / size**2
    steps_s = np.minimum(np.diff(stamps_ns, prepend=stamps_ns[0]) * 1e-9, _STEP_S)
    angle = np.cumsum(level * steps_s[:, None], axis=0)
    begins = np.unique((stamps_ns - stamps_ns[0]) // _SWING_NS, return_index=True)[1]
    if len(begins) > 1 and stamps_ns[-1] - stamps_ns[begins[-1]] < _WHOLE * _SWING_NS:
        begins = begins[:-1]  # the rest belongs to the window before
    swings = np.maximum.reduceat(angle, begins) - np.minimum.reduceat(angle, begins)
    swing = float(np.median(np.linalg.norm(swings, axis=1)))
    return swing if swing > _NO_SWING_RAD and not turns_gravity(stamps_ns, accel_mps2, gyro_radps) else 0.0
