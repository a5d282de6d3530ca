# SPDX-License-Identifier: Apache-2.0
"""Recorded bags as one stream of raw messages: ROS 1, ROS 2 sqlite3 and MCAP, split and compressed.

This uses the readers of rosbags but not its `AnyReader`. That registers every type of the bag, so one bad definition on
an unused topic makes the whole bag unreadable; and a folder whose metadata or last file is damaged can still be read
file by file.
"""

from __future__ import annotations

import heapq
import logging
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1

from graphloc.errors import InputError
from graphloc.frontends._open import HINTS, BagOpener, Opened, left_beside, text_of
from graphloc.frontends._order import refuse_set_back
from graphloc.frontends._recover import suffix_of
from graphloc.frontends._types import MessageTypes
from graphloc.frontends.part import BagPart, Bags, recording_times
from graphloc.recording import Span
from graphloc.time import duration_ns, seconds_between, utc_text

log = logging.getLogger(__name__)
LATEST_NS = 2**62 - 1
"""Latest time that is allowed (year 2116): a difference of differences still fits 64 bits."""
TF_STATIC, TF_MOVING = "/tf_static", "/tf"


class RawMessage(NamedTuple):
    """A message as recorded, not decoded; `elapsed_ns`: time since the first message of the bag was recorded."""

    topic: str
    msgtype: str
    file: str
    log_ns: int
    data: bytes
    elapsed_ns: int = 0


class TopicSummary(NamedTuple):
    """What the index of a bag, or of the selected part, states about a topic."""

    topic: str
    msgtypes: tuple[str, ...]
    messages: int


class Bag:
    """An open recording, used as a context manager.

    Attributes:
        name: its path(s), for messages.
        warnings: problems of the files; grows while messages are read.
        ros1: whether messages are in ROS 1 serialisation.
        span: the part of the bag that is read, with its topics; None: the whole bag.
    """

    def __init__(self, bags: Bags) -> None:
        self._part = bags if isinstance(bags, BagPart) else _whole(bags)
        self.paths = self._part.paths
        self.name = ", ".join(str(p) for p in self.paths)
        self.warnings: list[str] = []
        self._stack = ExitStack()
        self._opened: list[Opened] = []
        self._within: tuple[int | None, int | None] = (None, None)  # ns, as rosbags takes it: the end is not in it
        self._inside: Counter[str] = Counter()
        self.span: Span | None = None

    def __enter__(self) -> Self:
        if not self.paths:
            raise InputError("no bag given")
        opener = BagOpener(self._stack, self.warnings)
        try:
            for path in self.paths:
                opener.open(path)
        except BaseException:
            self._stack.close()
            raise
        if not opener.opened:
            self._stack.close()
            raise InputError("; ".join(opener.broken))
        self._opened = opener.opened
        self.warnings += [*opener.broken, *left_beside(opener.opened)]
        self.ros1 = isinstance(self._opened[0].reader, Reader1)
        if any(isinstance(o.reader, Reader1) != self.ros1 for o in self._opened):
            self._stack.close()
            raise InputError(f"{self.name}: ROS 1 and ROS 2 bags cannot be read as one run; give one kind")
        connections = (c for o in self._opened for c in o.reader.connections)
        self._types = MessageTypes(self.name, connections, self.warnings, ros1=self.ros1)
        if not self._part.whole:
            try:
                self._cut()
            except BaseException:
                self._stack.close()
                raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _cut(self) -> None:
        """Set the limits of the part, and the number of messages of each topic in it."""
        times: dict[str, list[NDArray[np.int64]]] = {}
        for opened in self._opened:
            for topic, recorded in self._times(opened):
                times.setdefault(topic, []).append(np.clip(recorded, 0, LATEST_NS))
        by_topic = {topic: np.concatenate(pieces) for topic, pieces in times.items()}
        stamps = np.concatenate([np.empty(0, dtype=np.int64), *by_topic.values()])
        if not len(stamps):
            raise InputError(f"{self.name}: no message is in it, so no part of it can be taken")
        first_ns, last_ns = int(stamps.min()), int(stamps.max())
        start_s, duration_s, bag_s = self._part.start_s, self._part.duration_s, seconds_between(first_ns, last_ns)
        if start_s > bag_s:
            raise InputError(
                f"{self.name}: --start {start_s:g}: the bag is {bag_s:.1f} s long, from {utc_text(first_ns)} to "
                f"{utc_text(last_ns)}"
            )
        start_ns, end_ns = first_ns + duration_ns(start_s), last_ns + 1
        if duration_s is not None and duration_s <= bag_s:
            end_ns = min(start_ns + duration_ns(duration_s), end_ns)
        self._within = (start_ns if start_s else None, None if end_ns > last_ns else end_ns)
        for topic, recorded in by_topic.items():
            self._inside[topic] = int(np.count_nonzero((recorded >= start_ns) & (recorded < end_ns)))
        self.span = Span(
            start_s=start_s, end_s=seconds_between(first_ns, min(end_ns, last_ns)), bag_s=bag_s,
            start_ns=start_ns, end_ns=end_ns,
            messages=dict(self._inside), left_out={t: len(r) - self._inside[t] for t, r in by_topic.items()},
        )  # fmt: skip

    def _times(self, opened: Opened) -> list[tuple[str, NDArray[np.int64]]]:
        """Return topics and recording times of a file by its index; if that is damaged, by all readable messages."""
        try:
            return list(recording_times(opened.reader))
        except Exception as error:  # noqa: BLE001 - as below
            self.warnings.append(
                f"{opened.path}: its index is damaged ({text_of(error)}): its messages were counted instead"
            )
        found: list[tuple[str, NDArray[np.int64]]] = []
        with suppress(Exception):  # where it ends is said when its messages are read
            for connection, log_ns, _ in opened.messages(opened.reader.connections, None, None):
                found.append((connection.topic, np.array([min(max(log_ns, 0), LATEST_NS)])))
        return found

    @property
    def topics(self) -> dict[str, TopicSummary]:
        """Topics by name, with their types and the number of messages by the index, in the selected part."""
        found: dict[str, TopicSummary] = {}
        for opened in self._opened:
            for c in opened.reader.connections:
                have = found.get(c.topic, TopicSummary(c.topic, (), 0))
                types = have.msgtypes if c.msgtype in have.msgtypes else (*have.msgtypes, c.msgtype)
                found[c.topic] = TopicSummary(c.topic, types, have.messages + c.msgcount)
        if self.span is not None:
            found = {topic: t._replace(messages=self._inside[topic]) for topic, t in found.items()}
        return dict(sorted(found.items()))

    def messages(self, topics: Collection[str], *, whole: bool = False) -> Iterator[RawMessage]:
        """Yield the raw messages of some topics in order of arrival; others are never decompressed.

        Of a part of a bag, first all of /tf_static is yielded, which drivers send only once, then what was recorded in
        the part. Damage in the middle of a file ends the file, with a line in `warnings`.

        Args:
            topics: names. whole: read the whole bag, for messages that are sent once or do not change.
        """
        if self.span is None or whole:
            yield from self._merged(topics, (None, None))
            return
        yield from self._merged({TF_STATIC} & set(topics), (None, None))
        yield from self._merged(set(topics) - {TF_STATIC}, self._within)

    def _merged(self, topics: Collection[str], within: tuple[int | None, int | None]) -> Iterator[RawMessage]:
        streams = []
        for opened in self._opened:
            wanted = [c for c in opened.reader.connections if c.topic in topics]
            if wanted:
                streams.append(self._until_damage(opened, wanted, within))
        yield from heapq.merge(*streams, key=lambda m: m.log_ns)

    def _until_damage(
        self, opened: Opened, wanted: list[Connection], within: tuple[int | None, int | None]
    ) -> Iterator[RawMessage]:
        read, began_ns = 0, min(max(o.reader.start_time, 0) for o in self._opened)
        try:
            for connection, log_ns, data in opened.messages(wanted, *within):
                read += 1
                at_ns = min(max(log_ns, 0), LATEST_NS)
                elapsed_ns = at_ns - began_ns
                yield RawMessage(connection.topic, connection.msgtype, opened.path.name, at_ns, data, elapsed_ns)
        except Exception as error:  # noqa: BLE001 - as above
            self.warnings.append(
                f"{opened.path}: damaged after {read} messages ({text_of(error)}): the rest was not read; "
                f"{HINTS.get(suffix_of(opened.path), HINTS[''])}"
            )

    def refuse_set_back(self, topics: Collection[str]) -> None:
        """Refuse the bag, or the part, if the recorder's clock was set back while these topics were written.

        Raises:
            InputError: the clock was set back.
        """
        start_ns, end_ns = self._within
        for opened in self._opened:
            for topic in topics:
                try:
                    pieces = [np.clip(times, 0, LATEST_NS) for _, times in recording_times(opened.reader, topic)]
                except Exception as error:  # noqa: BLE001 - as above; what is damaged is said when it is read
                    log.debug("%s: no recording times: %s", opened.path, error)
                    continue
                times = np.concatenate([np.empty(0, dtype=np.int64), *pieces])
                inside = (times >= (start_ns or 0)) & (times < (LATEST_NS + 1 if end_ns is None else end_ns))
                refuse_set_back(topic, str(opened.path), times[inside])

    def decode(self, message: RawMessage) -> object:
        """Return the deserialised message. Raises whatever rosbags raises on damaged bytes."""
        return self._types.decode(message.data, message.msgtype)


def unopened(bags: Bags | Bag) -> Bag:
    """Return the recording at some paths, not opened yet; a `Bag` is returned as it is."""
    return bags if isinstance(bags, Bag) else Bag(bags)


def _whole(paths: Path | str | Sequence[Path | str]) -> BagPart:
    return BagPart((Path(paths),) if isinstance(paths, str | Path) else tuple(Path(p) for p in paths))
