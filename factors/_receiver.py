# SPDX-License-Identifier: Apache-2.0
"""What fixes and velocities of a receiver share: the delay of its stamps and the place of its antenna."""

from __future__ import annotations

import numpy as np

from graphloc.graph import PLACE, TIME_OFFSET, Constant


def stamps_and_antenna(stamp_sigma_s: float, mount_sigma_m: float) -> tuple[Constant, ...]:
    """Return how much later than stamped a receiver measures, s, and how far off its antenna is (3,), m, each where its sigma is not 0."""
    unknown: dict[str, float] = {}
    if stamp_sigma_s > 0.0:
        unknown[TIME_OFFSET] = stamp_sigma_s
    if mount_sigma_m > 0.0:
        unknown |= dict.fromkeys(PLACE, mount_sigma_m)
    if not unknown:
        return ()
    # One of all: a linear factor has three states at most.
    return (Constant(name="stamps and antenna", sigma=np.array([*unknown.values()]), corrects=tuple(unknown)),)
