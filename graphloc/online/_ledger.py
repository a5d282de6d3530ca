# SPDX-License-Identifier: Apache-2.0
"""Ledger rows online: each measurement gets exactly one, even where a window is rebuilt."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from graphloc.config import VesselConfig
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import Measurement


class OnlineLedger:
    """Rows that have become final, and which measurements have one: a rebuilt window does not use these again."""

    def __init__(self, config: VesselConfig) -> None:
        self._config = config
        self._rows: list[LedgerRow] = []
        self._settled: set[int] | None = None  # None: there is no window, so nothing can be used again

    def taken(self) -> list[LedgerRow]:
        """Return the rows that were entered since the last call."""
        rows, self._rows = self._rows, []
        return rows

    def begin(self) -> None:
        """Begin a window, or continue with a rebuilt one."""
        self._settled = self._settled or set()

    def close(self) -> None:
        """End the window: no measurement can be used again."""
        self._settled = None

    def has(self, m: Measurement) -> bool:
        """Whether a measurement already has its row."""
        return m.seq in (self._settled or ())

    def forget_but(self, seqs: Collection[int]) -> None:
        """Forget which measurements have a row, except for numbers `seqs`: the others are too old to be used again."""
        if self._settled is not None:
            self._settled.intersection_update(seqs)

    def enter(self, rows: Sequence[LedgerRow]) -> None:
        """Enter rows of measurements that have left the window."""
        self._rows += rows
        if self._settled is not None:
            self._settled.update(row.seq for row in rows)

    def drop(self, m: Measurement, outcome: Outcome, reason: str) -> None:
        """Enter why a measurement is not in the estimate; synthetic measurements (seq < 0) have no row."""
        if m.seq >= 0:
            self.enter([self._row(m, outcome, reason)])

    def used(self, m: Measurement) -> None:
        """Enter an IMU sample as used; it may be used again in a rebuilt window."""
        if m.seq >= 0:
            self._rows.append(self._row(m, Outcome.USED, ""))

    def marked(self) -> tuple[int, set[int] | None]:
        """Return the state of the ledger, for `back_to`."""
        return len(self._rows), None if self._settled is None else set(self._settled)

    def back_to(self, mark: tuple[int, set[int] | None]) -> None:
        """Remove what was entered since `marked`: the rebuild that it came from has failed."""
        length, self._settled = mark
        del self._rows[length:]

    def _row(self, m: Measurement, outcome: Outcome, reason: str) -> LedgerRow:
        sensor = self._config.sensors.get(m.sensor)
        topic = "" if sensor is None else sensor.topic
        return LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic=topic, outcome=outcome, reason=reason)
