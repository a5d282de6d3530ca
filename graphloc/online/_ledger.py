# SPDX-License-Identifier: Apache-2.0
"""The ledger of a run that goes on."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from graphloc.config import VesselConfig
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import Measurement


class OnlineLedger:
    """Rows that have become final, and which measurements have theirs, so that none is taken again when a lag is built anew."""

    def __init__(self, config: VesselConfig) -> None:
        self._config = config
        self._rows: list[LedgerRow] = []
        self._settled: set[int] | None = None  # None: no lag is underway, nothing can be taken again

    def taken(self) -> list[LedgerRow]:
        """Return the rows since this was last asked."""
        rows, self._rows = self._rows, []
        return rows

    def begin(self) -> None:
        """A lag is underway from now on, or still is."""
        self._settled = self._settled or set()

    def close(self) -> None:
        """No lag is underway any more."""
        self._settled = None

    def has(self, m: Measurement) -> bool:
        """Whether a measurement of the lag has its row already."""
        return m.seq in (self._settled or ())

    def forget_but(self, seqs: Collection[int]) -> None:
        """Forget about all but these: they are too old to be taken again."""
        if self._settled is not None:
            self._settled.intersection_update(seqs)

    def enter(self, rows: Sequence[LedgerRow]) -> None:
        """Enter rows of measurements that have left the lag."""
        self._rows += rows
        if self._settled is not None:
            self._settled.update(row.seq for row in rows)

    def drop(self, m: Measurement, outcome: Outcome, reason: str) -> None:
        """Enter why a measurement is not in the estimate; those that something else was made of (seq < 0) have no row."""
        if m.seq >= 0:
            self.enter([self._row(m, outcome, reason)])

    def used(self, m: Measurement) -> None:
        """Enter an IMU sample: it can be taken again, and is in the estimate in any case."""
        if m.seq >= 0:
            self._rows.append(self._row(m, Outcome.USED, ""))

    def marked(self) -> tuple[int, set[int] | None]:
        """Return where the ledger stands, for `back_to`."""
        return len(self._rows), None if self._settled is None else set(self._settled)

    def back_to(self, mark: tuple[int, set[int] | None]) -> None:
        """Strike what was entered since: what it came of has failed."""
        length, self._settled = mark
        del self._rows[length:]

    def _row(self, m: Measurement, outcome: Outcome, reason: str) -> LedgerRow:
        sensor = self._config.sensors.get(m.sensor)
        topic = "" if sensor is None else sensor.topic
        return LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic=topic, outcome=outcome, reason=reason)
