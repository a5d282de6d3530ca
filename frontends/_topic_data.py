# SPDX-License-Identifier: Apache-2.0
"""Columns of one topic, as `inspect` reads it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends._said import Part
from graphloc.time import NS_PER_S

_MOST = 1e12  # no measurement in SI units, geodetic or of a map grid is larger


@dataclass(slots=True)
class TopicData:
    """Columns of one topic: stamps and recording times (N,) ns, and a row of numbers per message, by type (see `ROWS`).

    Arrays are made once, and cannot be written to.

    Attributes:
        topic: name of the stream, for a plain topic that of the topic. msgtype: the type, or that of the same content.
        frame_id: the first one that is not empty. frames: how many messages name each frame_id.
        undecodable: number of messages that cannot be decoded. broken: why, of the first one.
        no_stamp: number of messages that were dropped because they have no stamp.
        recorded: whether the stamps are recording times, because the headers hold none, or whole seconds only.
        drift_ppm: by how much the clock ran fast; what it gained has been taken off the stamps.
        part: which part of a maker's message it is; None of other messages.
        filtered: how many of a maker's messages say that a filter made them.
        tuples: the rows as they were added. files: the file of each message.
        elapsed: (N,) ns from the beginning of the bag until a message was recorded.
    """

    topic: str
    msgtype: str
    frame_id: str = ""
    undecodable: int = 0
    broken: str = ""
    no_stamp: int = 0
    recorded: bool = False
    drift_ppm: float = 0.0
    part: Part | None = None
    filtered: int = 0
    frames: Counter[str] = field(default_factory=Counter)
    _stamps: list[int] = field(default_factory=list)
    _logs: list[int] = field(default_factory=list)
    tuples: list[tuple[float, ...]] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    elapsed: list[int] = field(default_factory=list)
    # Arrays made from the lists, once each; copies of a stream share the rows.
    _rows: Array | None = field(default=None, compare=False)
    _made: dict[str, NDArray[np.int64]] = field(default_factory=dict, init=False, compare=False)

    def add(self, stamp_ns: int, log_ns: int, row: tuple[float, ...], file: str, elapsed_ns: int = 0) -> None:
        """Append a message."""
        if self._made or self._rows is not None:
            self._anew()
        self.files.append(file)
        self.elapsed.append(elapsed_ns)
        self._stamps.append(stamp_ns)
        self._logs.append(log_ns)
        self.tuples.append(row)

    def _anew(self) -> None:
        """Forget the arrays that were made from the lists."""
        self._rows = None
        self._made.clear()

    @classmethod
    def joined(cls, topic: str, parts: Sequence[TopicData]) -> TopicData:
        """Return several streams of one type as one, with messages in the order of recording."""
        whole = cls(topic, parts[0].msgtype, parts[0].frame_id, sum(p.undecodable for p in parts))
        whole.frames = sum((p.frames for p in parts), Counter())
        messages = (message for p in parts for message in zip(*p.columns(), strict=True))
        for message in sorted(messages, key=lambda message: message[1]):
            whole.add(*message)
        return whole

    def columns(self) -> tuple[list[Any], ...]:
        """Return what there is of each message: stamps, recording times, rows, files, times since the beginning."""
        return self._stamps, self._logs, self.tuples, self.files, self.elapsed

    def settle(self) -> None:
        """Drop messages without a stamp, in place; where stamps do not tell the time, use recording times.

        They do not if all are equal, or if they are whole seconds, see `_in_whole_seconds`.
        """
        stamps = self.stamps_ns
        if len(stamps) > 1 and (bool((stamps == stamps[0]).all()) or self._in_whole_seconds()):
            self.recorded, self._stamps = True, list(self._logs)
            self._anew()
            return
        there = (stamps != 0).tolist()
        self.no_stamp = there.count(False)
        if not self.no_stamp:
            return
        for column in self.columns():
            column[:] = list(compress(column, there))
        self._anew()

    def _in_whole_seconds(self) -> bool:
        """Return whether stamps are whole seconds though several measurements a second were recorded, one by one.

        Not so of a receiver that measures once a second, whose driver repeats each measurement with its stamp.
        """
        if (self.stamps_ns % NS_PER_S).any():
            return False
        told = {(stamp_ns, repr(row)) for stamp_ns, row in zip(self._stamps, self.tuples, strict=True)}
        return 4 * len(set(self._stamps)) < 3 * min(len(told), len(set(self._logs)))

    def later(self, by_ns: int) -> TopicData:
        """Return the stream with `by_ns` added to its stamps."""
        return replace(self, _stamps=[stamp_ns + by_ns for stamp_ns in self._stamps])

    def logged(self, logs_ns: NDArray[np.int64]) -> TopicData:
        """Return the stream with other recording times (N,), its stamps where headers hold none."""
        logs = logs_ns.tolist()
        return replace(self, _logs=logs, _stamps=self._stamps if self.stamped_by_header else logs)

    @property
    def stamped_by_header(self) -> bool:
        """Whether the stamps are not the recording times."""
        return self._stamps != self._logs

    def stamped(self, stamps_ns: NDArray[np.int64]) -> TopicData:
        """Return the stream with other stamps (N,)."""
        return replace(self, _stamps=stamps_ns.tolist())

    def without_drift(self, ppm: float) -> TopicData:
        """Return the stream with the gain of a clock that runs fast by `ppm` taken off its stamps."""
        gained = np.rint(1e-6 * ppm * np.array(self.elapsed, dtype=float)).astype(np.int64)
        return replace(self, _stamps=(self.stamps_ns - gained).tolist(), drift_ppm=ppm)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Header stamps in order of arrival."""
        return self._array("stamps", self._stamps)

    @property
    def logs_ns(self) -> NDArray[np.int64]:
        """Recording times in order of arrival."""
        return self._array("logs", self._logs)

    def _array(self, name: str, column: list[int]) -> NDArray[np.int64]:
        if name not in self._made:
            self._made[name] = np.array(column, dtype=np.int64)
            self._made[name].flags.writeable = False
        return self._made[name]

    @property
    def rows(self) -> Array:
        """Values (N, k); NaN for values too large to be measurements, whose squares would overflow."""
        if self._rows is None:
            self._rows = np.array(self.tuples, dtype=float)
            self._rows[np.abs(self._rows) > _MOST] = np.nan
            self._rows.flags.writeable = False
        return self._rows

    def __len__(self) -> int:
        return len(self._stamps)
