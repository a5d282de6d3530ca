# SPDX-License-Identifier: Apache-2.0
"""Measurements that come faster than their errors decorrelate: they cost time and memory, and add no information."""

from __future__ import annotations

from collections import deque

from graphloc.time import NS_PER_S

LEAST_APART_NS = 45_000_000
"""Least time between two fixes, velocities or headings of a fast sensor that are used. 20 a second stay, although the
steps between their stamps are up to 5 ms short."""
THINNED = f"less than {LEAST_APART_NS / 1e6:.0f} ms after the one before: its error is correlated for longer than this, so it adds no information"
# Time over which a sensor's rate is taken, longer than a burst: a sensor that sends bursts is not fast; a choice.
_RATE_OVER_NS = 2 * NS_PER_S


class Thinning:
    """Drops what a sensor measures within `apart_ns` after its last used measurement, if it is faster than that.

    How fast the sensor is shows in two seconds; until then it counts as fast. Measurements out of the order of their
    stamps stay. So do bursts of a slower sensor, as through a gateway: stamped on arrival, the first of a burst is the
    most delayed, and thinning would keep just that.
    """

    def __init__(self, apart_ns: int) -> None:
        self._apart_ns = apart_ns
        self._last_ns: int | None = None  # of the last measurement that was used
        self._begin_ns = 0
        self._recent_ns = deque[int]()

    def drops(self, stamp_ns: int) -> bool:
        """Return whether a measurement is to be dropped; if not, the next ones are compared with it."""
        close = self._last_ns is not None and 0 < stamp_ns - self._last_ns < self._apart_ns
        if self._is_fast(stamp_ns) and close:
            return True
        self._last_ns = stamp_ns
        return False

    def _is_fast(self, stamp_ns: int) -> bool:
        """Count a measurement; return whether the sensor is faster than one per `apart_ns`."""
        recent = self._recent_ns
        if not recent or stamp_ns < recent[-1]:
            recent.clear()
            self._begin_ns = stamp_ns
        recent.append(stamp_ns)
        while recent[0] <= stamp_ns - _RATE_OVER_NS:
            recent.popleft()
        return stamp_ns - self._begin_ns < _RATE_OVER_NS or len(recent) * self._apart_ns > _RATE_OVER_NS
