# SPDX-License-Identifier: Apache-2.0
"""What fixes and velocities of a receiver share: the delay of its stamps and the place of its antenna."""

from __future__ import annotations

import numpy as np

from graphloc.config import GnssConfig, VelocityConfig
from graphloc.frames import Array
from graphloc.graph import PLACE, TIME_OFFSET, Attachment, Constant

_NOT_OFF = np.zeros(3)


def stamps_and_antenna(config: GnssConfig | VelocityConfig) -> tuple[Constant, ...]:
    """Return how much later than stamped a receiver measures, s, and how far off its antenna is (3,), m, as far as that is not known."""
    unknown: dict[str, float] = {}
    if config.stamp_sigma_s > 0.0:
        unknown[TIME_OFFSET] = config.stamp_sigma_s
    if config.mount_sigma_m > 0.0:
        unknown |= dict.fromkeys(PLACE, config.mount_sigma_m)
    if not unknown:
        return ()
    # One of all: a linear factor of more than three states takes longer to make.
    return (Constant(name="stamps and antenna", sigma=np.array([*unknown.values()]), corrects=tuple(unknown)),)


def late_and_off(at: Attachment, config: GnssConfig | VelocityConfig) -> tuple[float, Array]:
    """Return the estimates of both, s and m, the latter in the antenna's axes; zero where they are not estimated."""
    if not at.constants:  # of a sensor with none, or taken as configured to examine that
        return 0.0, _NOT_OFF
    value, own = at.constants[0][1], at.own_of(0)
    value = value[list(own)] if own else value
    late = float(value[0]) if config.stamp_sigma_s > 0.0 else 0.0
    return late, value[-3:] if config.mount_sigma_m > 0.0 else _NOT_OFF
