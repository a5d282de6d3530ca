# SPDX-License-Identifier: Apache-2.0
"""The ledger: every message that arrived ends in exactly one row, and rows add up to the recording."""

from __future__ import annotations

import enum
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from graphloc.errors import GraphlocError

NOT_ASKED_FOR = "its sensor is switched off or not in the configuration"
RECORDED_AT = ", recorded at "  # in a reason, before the time at which its message was recorded


class Outcome(enum.StrEnum):
    """What became of a message."""

    USED = "used"
    DOWN_WEIGHTED = "down_weighted"  # final weight below 0.5
    REJECTED = "rejected"  # well-formed, but not believed; reason says why
    HELD_OUT = "held_out"  # kept out of the graph to test it
    LATE = "late"
    MALFORMED = "malformed"  # reason says file, topic, stamp
    READ = "read"  # by a front-end (images, scans), or beside the sensors (truth, mounts); reason says for what
    IGNORED = "ignored"  # no sensor of the configuration asks for this topic or type


@dataclass(frozen=True, slots=True, kw_only=True)
class LedgerRow:
    """One message (or, for topics that are ignored or read beside the sensors, `count` messages).

    Attributes:
        seq: arrival number; -1 for a row that stands for a whole topic.
        stamp_ns: sensor stamp (0 if it could not be read).
        sensor: configured name, '' if none.
        topic: topic in the bag, or '(simulated)', '(config)', '(stream)'.
        outcome: what became of it.
        weight: final weight in [0, 1]; None where it has no meaning.
        mode: index of the chosen mode; None for sensors without modes.
        mode_probability: posterior probability of that mode.
        mode_settled: pass over the whole run from which on this mode was the chosen one; 0: before the first.
        residual_m, residual_deg: size of the final residual in physical units.
        nis: squared residual normalised by the measurement's own covariance.
        dof: number of measured axes.
        reason: why it was not used fully.
        detail: what else a reader wants to know of it, e.g. the camera and the tags of a sighting.
        count: messages that this row stands for.
    """

    seq: int
    stamp_ns: int
    sensor: str
    topic: str
    outcome: Outcome
    weight: float | None = None
    mode: int | None = None
    mode_probability: float | None = None
    mode_settled: int | None = None
    residual_m: float | None = None
    residual_deg: float | None = None
    nis: float | None = None
    dof: int | None = None
    reason: str = ""
    detail: str = ""
    count: int = 1

    @property
    def common_reason(self) -> str:
        """The reason without the time at which the message was recorded, so that equal reasons are equal texts."""
        return self.reason.partition(RECORDED_AT)[0]


class Ledger:
    """Rows by arrival number. A second row for one arrival is an error in graphloc, not in the data."""

    def __init__(self, rows: Iterable[LedgerRow] = ()) -> None:
        self._rows: dict[int, LedgerRow] = {}
        self._topics: list[LedgerRow] = []
        for row in rows:
            self.add(row)

    def add(self, row: LedgerRow) -> None:
        """Add a row; `seq` must be new unless it is -1."""
        if row.seq < 0:
            self._topics.append(row)
            return
        if row.seq in self._rows:
            raise GraphlocError(f"ledger: arrival {row.seq} of {row.topic} was entered twice")
        self._rows[row.seq] = row

    def __iter__(self) -> Iterator[LedgerRow]:
        yield from (self._rows[seq] for seq in sorted(self._rows))
        yield from self._topics

    def __len__(self) -> int:
        return sum(row.count for row in self)

    def __contains__(self, seq: int) -> bool:
        return seq in self._rows

    def counts(self) -> dict[str, dict[str, int]]:
        """Return messages per sensor (or topic, where none) and outcome."""
        table: dict[str, Counter[str]] = {}
        for row in self:
            table.setdefault(row.sensor or row.topic, Counter())[row.outcome.value] += row.count
        return {name: dict(sorted(counter.items())) for name, counter in sorted(table.items())}

    def used(self, sensor: str) -> int:
        """Return how many messages of a sensor were used."""
        return self.counts().get(sensor, {}).get(Outcome.USED.value, 0)

    def reasons(self) -> dict[tuple[str, str, str], int]:
        """Return messages per (sensor or topic, outcome, reason) for rows that carry a reason."""
        counter: Counter[tuple[str, str, str]] = Counter()
        for row in self:
            if row.reason:
                counter[(row.sensor or row.topic, row.outcome.value, row.reason)] += row.count
        return dict(sorted(counter.items()))
