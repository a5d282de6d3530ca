# SPDX-License-Identifier: Apache-2.0
"""Truncated files (power failure, disk full): read as far as they are intact, without a copy.

A bag's index comes last, so a truncated file has none. `recover` scans the intact records of the file and presents it
to rosbags as head + intact records + a new end. sqlite3 files do not need this: sqlite3 has a tool of its own
(`.recover`).
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from rosbags.rosbag1.reader import Header, ReaderError, RecordType, decompressors, read_uint32


class Recovered:
    """A damaged file as rosbags should see it: patched head, intact records, new tail.

    Attributes:
        path: the file on disk.
        whole_bytes: its length up to the end of the last intact record; file_bytes: its length.
    """

    def __init__(self, path: Path, head: bytes, whole_bytes: int, tail: bytes) -> None:
        self.path, self.whole_bytes = path, whole_bytes
        self.file_bytes = path.stat().st_size
        self._head, self._tail = head, tail

    @property
    def stem(self) -> str:
        """As `Path.stem`."""
        return self.path.stem

    @property
    def suffix(self) -> str:
        """As `Path.suffix`."""
        return self.path.suffix

    def __str__(self) -> str:
        return str(self.path)

    def exists(self) -> bool:
        """As `Path.exists`."""
        return self.path.exists()

    def is_dir(self) -> bool:
        """As `Path.is_dir`."""
        return False

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """As `Path.stat`."""
        return self.path.stat(follow_symlinks=follow_symlinks)

    def read_text(self, encoding: str | None = None) -> str:
        """As `Path.read_text`; a bag is no text."""
        raise OSError(f"{self.path} is not a text file (asked in {encoding})")

    def __truediv__(self, key: object) -> Recovered:
        raise OSError(f"{self.path} is not a folder, so it holds no {key}")

    def open(self, *_args: Any, **_kwargs: Any) -> BinaryIO:
        """As `Path.open('rb')`."""
        return io.BufferedReader(_View(self.path, self._head, self.whole_bytes, self._tail))


class _View(io.RawIOBase):
    """Read-only concatenation of `head`, file[len(head):stop] and `tail`."""

    def __init__(self, path: Path, head: bytes, stop: int, tail: bytes) -> None:
        self._file = path.open("rb")
        self._head, self._stop, self._tail = head, stop, tail
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._stop + len(self._tail)}[whence]
        self._at = max(0, start + offset)
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        size = len(buffer)
        if self._at < len(self._head):
            data = self._head[self._at : self._at + size]
        elif self._at < self._stop:
            self._file.seek(self._at)
            data = self._file.read(min(size, self._stop - self._at))
        else:
            data = self._tail[self._at - self._stop : self._at - self._stop + size]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


def suffix_of(path: Path) -> str:
    """Return the suffix of a bag's format; a ROS 1 recorder that was cut off leaves `.bag.active`."""
    return ".bag" if path.name.endswith(".bag.active") else path.suffix


def recover(path: Path) -> Recovered | None:
    """Return a view of the intact part of a damaged file; None if nothing of it is readable."""
    repair = {".bag": _recover_ros1, ".mcap": _recover_mcap}.get(suffix_of(path))
    if repair is None:
        return None
    try:
        return repair(path)
    except Exception:  # noqa: BLE001 - damaged bytes make rosbags and the decompressors raise nearly anything
        return None


_MCAP_MAGIC = b"\x89MCAP0\r\n"
_MCAP_HEADER_BYTES = 1 << 16  # most bytes of a header record, which holds two words
_MCAP_FOOTER, _MCAP_MESSAGE, _MCAP_CHUNK, _MCAP_DATA_END = 0x02, 0x05, 0x06, 0x0F


def _recover_mcap(path: Path) -> Recovered | None:
    """Cut after the last intact record of the data section; a footer without summary makes rosbags scan."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            return None
        whole, filled = file.tell(), False
        while len(start := file.read(9)) == 9:
            op, length = struct.unpack("<BQ", start)
            if op == _MCAP_DATA_END or file.tell() + length > size:
                break
            whole = file.seek(length, io.SEEK_CUR)
            filled |= op in (_MCAP_MESSAGE, _MCAP_CHUNK)
    footer = struct.pack("<BQQQI", _MCAP_FOOTER, 20, 0, 0, 0) + _MCAP_MAGIC
    return Recovered(path, _ros2_head(path), whole, footer) if filled else None


def as_ros2(path: Path) -> Recovered | None:
    """Return a view of an MCAP file of another profile with profile `ros2`; None if it has that, or is not MCAP.

    rosbags reads no other profile, but tools that merge or filter files leave it empty without changing the messages.
    """
    head = _ros2_head(path) if path.suffix == ".mcap" else b""
    return Recovered(path, head, path.stat().st_size, b"") if head else None


def _ros2_head(path: Path) -> bytes:
    """Return the first record of an MCAP file with profile `ros2`, at unchanged length; empty if that is its profile."""
    with path.open("rb") as file:
        start = file.read(len(_MCAP_MAGIC) + 9)
        if not start.startswith(_MCAP_MAGIC) or len(start) < len(_MCAP_MAGIC) + 9:
            return b""
        (length,) = struct.unpack("<Q", start[-8:])
        ros2 = struct.pack("<I", 4) + b"ros2"
        if not len(ros2) <= length < _MCAP_HEADER_BYTES or file.read(len(ros2)) == ros2:
            return b""
    return start + ros2.ljust(length, b"\0")  # the rest, the name of the writing library, is not read


class _Chunk(NamedTuple):
    position: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]


def _recover_ros1(path: Path) -> Recovered | None:
    """Rebuild the index (connections and chunk infos) of the intact chunks, like `rosbag reindex`.

    A chunk is intact if the index records that follow it are there too.
    """
    connections: dict[int, bytes] = {}
    with path.open("rb") as file:
        magic = file.readline()
        Header.read(file, RecordType.BAGHEADER)
        file.seek(read_uint32(file), io.SEEK_CUR)
        head_bytes = whole = file.tell()
        chunks: list[_Chunk] = []
        for chunk in _intact_chunks(file, path.stat().st_size, connections):
            chunks.append(chunk)
            whole = file.tell()
    known = {conn for chunk in chunks for conn in chunk.counts}
    if not chunks or not known <= set(connections):
        return None
    head = _ros1_head(magic, head_bytes, whole, len(known), len(chunks))
    tail = b"".join(connections[c] for c in sorted(known)) + b"".join(_ros1_chunk_info(c) for c in chunks)
    return Recovered(path, head, whole, tail)


def _intact_chunks(file: BinaryIO, size: int, connections: dict[int, bytes]) -> Iterator[_Chunk]:
    """Yield the intact chunks of a file of `size` bytes, each once it has been read; collect their connections."""
    position, needed, counts, times = 0, set[int](), dict[int, int](), list[int]()
    while (at := file.tell()) < size:
        try:
            header = Header.read(file)
            length = read_uint32(file)
        except ReaderError:
            return
        if file.tell() + length > size:
            return
        op = header.get_uint8("op")
        if op == RecordType.CHUNK:
            position, counts, times = at, {}, []
            data = decompressors[header.get_string("compression")](file.read(length))
            needed = _read_chunk(data, connections)
        elif op == RecordType.IDXDATA:
            conn = header.get_uint32("conn")
            entries = struct.unpack(f"<{3 * (length // 12)}L", file.read(length))
            counts[conn] = len(entries) // 3
            times += [s * 10**9 + ns for s, ns in zip(entries[::3], entries[1::3], strict=True)]
            if set(counts) == needed:
                yield _Chunk(position, min(times), max(times), counts)
        else:
            return  # the index, which is written last: all chunks have been read


def _read_chunk(data: bytes, connections: dict[int, bytes]) -> set[int]:
    """Collect the raw connection records of a chunk; return which connections have messages in it."""
    chunk = io.BytesIO(data)
    used = set()
    while (at := chunk.tell()) < len(data):
        header = Header.read(chunk)
        stop = chunk.seek(read_uint32(chunk), io.SEEK_CUR)
        conn = header.get_uint32("conn")
        if header.get_uint8("op") == RecordType.CONNECTION:
            connections[conn] = data[at:stop]
        else:
            used.add(conn)
    return used


def _ros1_header(**fields: bytes) -> bytes:
    """Return a record header, preceded by its length."""
    body = b"".join(struct.pack("<L", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in fields.items())
    return struct.pack("<L", len(body)) + body


def _ros1_head(magic: bytes, head_bytes: int, index_pos: int, connections: int, chunks: int) -> bytes:
    """Return the first bytes of the file, at their length, with the bag header pointing to the new index."""
    head = magic + _ros1_header(
        op=bytes([RecordType.BAGHEADER]),
        index_pos=struct.pack("<Q", index_pos),
        conn_count=struct.pack("<L", connections),
        chunk_count=struct.pack("<L", chunks),
    )
    padding = head_bytes - len(head) - 4
    return head + struct.pack("<L", padding) + b" " * padding


def _ros1_chunk_info(chunk: _Chunk) -> bytes:
    def time(stamp_ns: int) -> bytes:
        return struct.pack("<LL", *divmod(stamp_ns, 10**9))

    header = _ros1_header(
        op=bytes([RecordType.CHUNK_INFO]),
        ver=struct.pack("<L", 1),
        chunk_pos=struct.pack("<Q", chunk.position),
        start_time=time(chunk.start_ns),
        end_time=time(chunk.end_ns),
        count=struct.pack("<L", len(chunk.counts)),
    )
    data = b"".join(struct.pack("<LL", conn, count) for conn, count in chunk.counts.items())
    return header + struct.pack("<L", len(data)) + data
