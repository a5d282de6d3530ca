# SPDX-License-Identifier: Apache-2.0
"""When an IMU is wrong, and not the sensors that it contradicts. Where it is: `solve/wrong_imu.py`, `online/_imu_doubt.py`."""

WRONG_IMU = "contradicts the other sensors, which agree with each other"
GROWS = 4.0
"""A residual grows if its square reaches so many times that of the first in a row."""
_MOTION = 3.0  # sigmas of the motion in a gap, at once and for each second


def most_motion(length_s: float) -> float:
    """Return the squared motion that a vessel may make in a gap of the IMU of some length (s).

    It is in sigmas of what is expected there (`factors.imu`).
    """
    return _MOTION**2 * (1.0 + length_s)
