# SPDX-License-Identifier: Apache-2.0
"""Measurements that are held while there is no estimate."""

from __future__ import annotations

from bisect import insort

from graphloc.ledger import Outcome
from graphloc.measurements import ImuSample, Measurement
from graphloc.online._ledger import OnlineLedger
from graphloc.online._start import LEAST_S
from graphloc.time import duration_ns

# Least time between two tries to start, and the same as a share of the wait so far
_TRY_EVERY_S, _TRY_AGAIN = 0.5, 0.15
_LONGEST_S, _MOST = 120.0, 50_000  # greatest age and number of the measurements that are held; the oldest are dropped


class Waiting:
    """Measurements in order of stamp.

    Attributes:
        why: what the start waits for, in plain words.
    """

    def __init__(self, ledger: OnlineLedger) -> None:
        self.why = ""
        self._ledger = ledger
        self._held: list[Measurement] = []
        self._tried_ns = 0

    def begin(self, why: str) -> None:
        """Begin to wait, holding nothing."""
        self.why, self._held, self._tried_ns = why, [], 0

    def hold(self, m: Measurement) -> None:
        """Hold a measurement."""
        insort(self._held, m, key=lambda held: held.stamp_ns)
        if len(self._held) > _MOST:
            self._let_go()

    def due(self, newest_ns: int) -> bool:
        """Return whether a start should be tried now; the more data there are to solve, the less often."""
        while newest_ns - self._held[0].stamp_ns > _LONGEST_S * 1e9:
            self._let_go()
        waited_ns = newest_ns - self._held[0].stamp_ns - duration_ns(LEAST_S)
        if newest_ns - self._tried_ns < max(_TRY_EVERY_S * 1e9, _TRY_AGAIN * waited_ns):
            return False
        self._tried_ns = newest_ns
        return True

    def samples(self) -> list[ImuSample]:
        """Return the IMU samples."""
        return [m for m in self._held if isinstance(m, ImuSample)]

    def others(self) -> list[Measurement]:
        """Return all measurements but the IMU samples."""
        return [m for m in self._held if not isinstance(m, ImuSample)]

    def taken(self) -> list[Measurement]:
        """Return all measurements, and hold none any more."""
        held, self._held = self._held, []
        return held

    def refuse(self, reason: str) -> None:
        """Enter all measurements into the ledger as rejected, and hold none any more."""
        for m in self.taken():
            self._ledger.drop(m, Outcome.REJECTED, reason)

    def _let_go(self) -> None:
        self._ledger.drop(self._held.pop(0), Outcome.REJECTED, f"came before the start: waiting for {self.why}")
