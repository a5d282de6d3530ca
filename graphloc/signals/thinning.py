# SPDX-License-Identifier: Apache-2.0
"""Measurements that come faster than their errors decorrelate: they cost time and memory, and add no information."""

from __future__ import annotations

from collections import deque

from graphloc.time import NS_PER_S

LEAST_APART_NS = 45_000_000
"""Between two fixes, velocities or headings of a fast sensor that are used: 20 a second stay, though steps between their stamps are up to 5 ms short."""
THINNED = f"less than {LEAST_APART_NS / 1e6:.0f} ms after the one before: its error is correlated for longer than this, so it adds no information"
_RATE_OVER_NS = (
    2 * NS_PER_S
)  # what comes in bursts is no fast sensor: the rate is that over longer than a burst; a choice


class Thinning:
    """Of a sensor that is faster than one measurement per `apart_ns`, those that follow the one before within less are too many.

    How fast it is shows in two seconds; until then it may be. What is not in order of its stamps stays. So do bursts of a slower
    sensor, as through a gateway: stamped on arrival, the first of a burst is the latest of all.
    """

    def __init__(self, apart_ns: int) -> None:
        self._apart_ns = apart_ns
        self._last_ns: int | None = None  # of those that are used
        self._begin_ns = 0
        self._recent_ns = deque[int]()

    def drops(self, stamp_ns: int) -> bool:
        """Return whether a measurement is too many; if not, the next is held against it."""
        close = self._last_ns is not None and 0 < stamp_ns - self._last_ns < self._apart_ns
        if self._is_fast(stamp_ns) and close:
            return True
        self._last_ns = stamp_ns
        return False

    def _is_fast(self, stamp_ns: int) -> bool:
        """Whether the sensor is too fast, with a measurement that is now counted."""
        recent = self._recent_ns
        if not recent or stamp_ns < recent[-1]:
            recent.clear()
            self._begin_ns = stamp_ns
        recent.append(stamp_ns)
        while recent[0] <= stamp_ns - _RATE_OVER_NS:
            recent.popleft()
        return stamp_ns - self._begin_ns < _RATE_OVER_NS or len(recent) * self._apart_ns > _RATE_OVER_NS
