# SPDX-License-Identifier: Apache-2.0
"""What a front-end computes from several messages becomes measurements of a recording, and rows of its ledger."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import Measurement
from graphloc.recording import Recording


class Gathering:
    """A recording that gains measurements: each, and each thing that gave none, is a row of the ledger."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._measurements, self.rows = list(recording.measurements), list(recording.rows)
        self._topics, self._seq = dict(recording.topics), recording.message_count
        self.said: list[str] = []

    def sensor(self, name: str, read: Mapping[str, str]) -> None:
        """A sensor that gathers, and what its topics, which no decoder reads, are read for."""
        self._topics[name] = f"({name})"
        self.rows = [
            replace(
                r,
                outcome=Outcome.READ,
                reason=read[r.topic] if r.outcome is Outcome.IGNORED else f"{r.reason}; {read[r.topic]}",
            )
            if r.topic in read and r.outcome in (Outcome.IGNORED, Outcome.READ)
            else r
            for r in self.rows
        ]

    def take(self, measurement: Measurement) -> Measurement:
        """Number a measurement, and keep it."""
        numbered = replace(measurement, seq=self._seq)
        self._measurements.append(numbered)
        self._seq += 1
        return numbered

    def refuse(self, sensor: str, stamp_ns: int, why: str) -> None:
        """Enter what gave no measurement."""
        self.rows.append(
            LedgerRow(
                seq=self._seq, stamp_ns=stamp_ns, sensor=sensor, topic=f"({sensor})", outcome=Outcome.REJECTED, reason=why
            )
        )  # fmt: skip
        self._seq += 1

    def refused(self, sensor: str) -> Counter[str]:
        """Why, and how often."""
        return Counter(row.reason for row in self.rows if row.sensor == sensor and row.outcome is Outcome.REJECTED)

    def recording(self) -> Recording:
        """Return the recording with all that it gained."""
        return replace(
            self._recording,
            measurements=tuple(sorted(self._measurements, key=lambda m: (m.stamp_ns, m.seq))),
            rows=tuple(self.rows),
            topics=self._topics,
            message_count=self._seq,
            warnings=tuple(dict.fromkeys([*self._recording.warnings, *self.said])),
        )
