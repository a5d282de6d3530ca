# SPDX-License-Identifier: Apache-2.0
"""What fixes and velocities of a receiver share: the delay of its stamps and the place of its antenna."""

from __future__ import annotations

import numpy as np

from graphloc.config import GnssConfig, VelocityConfig
from graphloc.frames import Array
from graphloc.graph import PLACE, TIME_OFFSET, Attachment, Constant

_NOT_OFF = np.zeros(3)


def stamps_and_antenna(config: GnssConfig | VelocityConfig) -> tuple[Constant, ...]:
    """Return the constant of a receiver: delay of its stamps, s, and place of its antenna less that of its mount (3,), m, where unknown.

    The delay is the time of measurement less the stamp.
    """
    unknown: dict[str, float] = {}
    if config.stamp_sigma_s > 0.0:
        unknown[TIME_OFFSET] = config.stamp_sigma_s
    if config.mount_sigma_m > 0.0:
        unknown |= dict.fromkeys(PLACE, config.mount_sigma_m)
    if not unknown:
        return ()
    # One constant holds both: a linear factor of more than three states takes longer to make.
    return (Constant(name="stamps and antenna", sigma=np.array([*unknown.values()]), corrects=tuple(unknown)),)


def late_and_off(at: Attachment, config: GnssConfig | VelocityConfig) -> tuple[float, Array]:
    """Return the estimated delay, s, and the antenna's place less that of its mount (3,), m, its axes; zero where not estimated."""
    if not at.constants:  # there are none, or the configured values are to be examined
        return 0.0, _NOT_OFF
    value, own = at.constants[0][1], at.own_of(0)
    value = value[list(own)] if own else value
    late = float(value[0]) if config.stamp_sigma_s > 0.0 else 0.0
    return late, value[-3:] if config.mount_sigma_m > 0.0 else _NOT_OFF
