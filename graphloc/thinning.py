# SPDX-License-Identifier: Apache-2.0
"""Measurements that come faster than their sensor errs anew: they cost time and memory, and tell nothing new."""

from __future__ import annotations

LEAST_APART_NS = 45_000_000
"""Between two fixes, velocities or headings of a sensor that are used: 20 a second stay, though steps between their stamps are up to 5 ms short."""
THINNED = "less than 0.05 s after the one before: what it errs lasts longer, so that it tells nothing new"


class Thinning:
    """Of one sensor's measurements, in order of arrival, those that follow the one before within less than `apart_ns` are too many.

    What is not in order of its stamps stays.
    """

    def __init__(self, apart_ns: int) -> None:
        self._apart_ns = apart_ns
        self._last_ns: int | None = None

    def drops(self, stamp_ns: int) -> bool:
        """Return whether a measurement is too many; if not, the next is held against it."""
        if self._last_ns is not None and 0 < stamp_ns - self._last_ns < self._apart_ns:
            return True
        self._last_ns = stamp_ns
        return False
