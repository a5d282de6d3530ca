# SPDX-License-Identifier: Apache-2.0
"""Selection of a part of a bag by recording times."""

from __future__ import annotations

import math
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from graphloc.errors import InputError

Times = Iterator[tuple[str, NDArray[np.int64]]]
_MCAP_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries: time and offset, 8 bytes each


@dataclass(frozen=True, slots=True)
class BagPart:
    """Bags, and the part of them that is used, by recording times as in `rosbag play`.

    Attributes:
        paths: of one recording. start_s: of the part, since the earliest message of all files.
        duration_s: of the part; None: to the end.

    Raises:
        InputError: invalid times.
    """

    paths: tuple[Path, ...]
    start_s: float = 0.0
    duration_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_s < math.inf:
            raise InputError(f"--start {self.start_s:g}: give seconds from the beginning of the bag, 0 or more")
        if self.duration_s is not None and not 0.0 < self.duration_s < math.inf:
            raise InputError(f"--duration {self.duration_s:g}: give how many seconds of the bag to take, more than 0")

    @property
    def whole(self) -> bool:
        """Whether it is the whole bag."""
        return self.start_s == 0.0 and self.duration_s is None


Bags = Path | str | Sequence[Path | str] | BagPart
"""A .bag, .mcap or .db3 file, the folder of a ROS 2 bag, several of one kind (split bags), or a part of them."""


def recording_times(reader: Reader1 | Reader2, only: str | None = None) -> Times:
    """Yield topics (or `only` one) and recording times (N,) ns of their messages, in chunks, from a file's index.

    They come in the order of the file, which differs from that of time where a clock was set back; nothing is decompressed.
    An MCAP file without chunks has no index and is read through. Raises whatever rosbags raises on damaged bytes.
    """
    if isinstance(reader, Reader1):
        for c in _only(reader.connections, only):
            entries = sorted(reader.indexes[c.id], key=lambda entry: (entry.chunk_pos, entry.offset))
            yield c.topic, np.array([entry.time for entry in entries], dtype=np.int64)
        return
    for storage in reader.storage.storages if isinstance(reader.storage, DirectoryReader) else [reader.storage]:
        if isinstance(storage, Sqlite3Reader):
            yield from _times_sqlite3(storage, only)
        elif isinstance(storage, McapReader):
            yield from _times_mcap(storage, only)


def _only(connections: Iterable[Connection], topic: str | None) -> list[Connection]:
    return [c for c in connections if topic in (None, c.topic)]


def _times_sqlite3(storage: Sqlite3Reader, only: str | None) -> Times:
    assert storage.dbconn is not None
    for c in _only(storage.connections, only):
        rows: Any = storage.dbconn.execute("SELECT timestamp FROM messages WHERE topic_id = ? ORDER BY id", (c.id,))
        yield c.topic, np.array([time for (time,) in rows], dtype=np.int64)


def _times_mcap(storage: McapReader, only: str | None) -> Times:
    assert storage.bio is not None
    topics = {c.id: c.topic for c in _only(storage.connections, only)}
    if not storage.chunks:
        found: dict[str, list[int]] = defaultdict(list)
        for c, time, _ in storage.messages_scan(_only(storage.connections, only)):
            found[c.topic].append(time)
        yield from ((topic, _signed(np.array(times, dtype=np.uint64))) for topic, times in found.items())
        return
    for chunk in sorted(storage.chunks, key=lambda chunk: chunk.chunk_start_offset):
        for channel, offset in chunk.message_index_offsets.items():
            if channel not in topics:
                continue
            storage.bio.seek(offset)
            *_, size = _MCAP_INDEX.unpack(storage.bio.read(_MCAP_INDEX.size))
            if size > chunk.message_index_length:
                raise ValueError(f"an index of {size} bytes in {chunk.message_index_length}")
            entries = np.frombuffer(storage.bio.read(size), dtype="<u8").reshape(-1, 2)
            yield topics[channel], _signed(entries[:, 0])


def _signed(times: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return times as signed integers; times that no clock shows remain far in the future."""
    return np.minimum(times, np.uint64(2**63 - 1)).astype(np.int64)
