# SPDX-License-Identifier: Apache-2.0
"""Decompression with a limit: a chunk of a few kB may be made to expand to more than memory or disk hold.

rosbags decompresses in one call without limit. `limit_unpacking` replaces these functions in its tables.
"""

from __future__ import annotations

import bz2
import io
import os
from collections.abc import Callable
from typing import IO, Any, Literal, Protocol

import lz4.frame  # type: ignore[import-untyped]
from rosbags.rosbag1 import reader as reader1
from rosbags.rosbag2 import reader as reader2
from rosbags.rosbag2 import storage_mcap

MOST_BYTES = 1 << 30
"""Most that a chunk or message may unpack to. Recorders make chunks of about 1 MB; a message is in one piece."""
_MOST_TIMES = 200
"""A whole file may unpack to so many times its size, or to `MOST_BYTES`: recordings shrink 2 to 50 times."""
_MOST_KEPT = 1 << 26  # bytes, 64 MiB; a choice
_zstd = storage_mcap.zstd


class _Decompressor(Protocol):
    """Common interface of the decompressors of bz2, lz4 and zstd."""

    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes | None: ...
    def decompress(self, data: bytes, max_length: int) -> bytes: ...


def unpacked(data: bytes, decompressor: Callable[[], _Decompressor], said: int | None = None) -> bytes:
    """Return the content of compressed frames; `said`: its stated size in bytes, if known.

    Raises:
        ValueError: it is larger than `said` or `MOST_BYTES`, or truncated.
    """
    most = MOST_BYTES if said is None else min(said, MOST_BYTES)
    parts = []
    while data:
        frame = decompressor()
        parts.append(frame.decompress(data, most + 1))
        most -= len(parts[-1])
        if most < 0:
            raise ValueError(f"unpacks to more than it says, or than {MOST_BYTES >> 20} MiB")
        if not frame.eof:
            raise ValueError("compressed data is cut short")
        data = frame.unused_data or b""
    return b"".join(parts)


class _Kept:
    """Decompresses chunks and caches the last ones, up to 64 MiB, compressed and decompressed.

    rosbags caches one. Messages of a ROS 1 bag come in order of recording time; if the clock was set in between, that order
    alternates between chunks, and each would be decompressed once per message.
    """

    def __init__(self, decompressor: Callable[[], _Decompressor]) -> None:
        self._decompressor = decompressor
        self._chunks: dict[bytes, bytes] = {}
        self._size = 0

    def __call__(self, data: bytes) -> bytes:
        found = self._chunks.pop(data, None)
        if found is None:
            found = unpacked(data, self._decompressor)
            self._size += len(data) + len(found)
        self._chunks[data] = found  # the last used is the last to go
        while self._size > _MOST_KEPT:
            first = next(iter(self._chunks))
            self._size -= len(first) + len(self._chunks.pop(first))
        return found


class _Bounded(io.RawIOBase):
    """A compressed file, read only; raises `OSError` at more content than the limit."""

    def __init__(self, file: Any, most: int) -> None:
        self._file, self._left = file, most

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        count = int(self._file.readinto(buffer))
        self._left -= count
        if self._left < 0:
            raise OSError(f"unpacks to more than {_MOST_TIMES} times its size: not read")
        return count

    def close(self) -> None:
        self._file.close()
        super().close()


class _Zstd:
    """Stand-in for the module that rosbags imports under this name."""

    @staticmethod
    def decompress(data: bytes) -> bytes:
        return unpacked(data, _zstd.ZstdDecompressor)

    @staticmethod
    def open(file: IO[bytes], mode: Literal["rb"]) -> _Bounded:
        size = os.fstat(file.fileno()).st_size
        return _Bounded(_zstd.open(file, mode), max(_MOST_TIMES * size, MOST_BYTES))


def _of_chunks(decompressor: Callable[[], _Decompressor]) -> Callable[[bytes, int], bytes]:
    """Decompress an MCAP chunk, which states its size."""
    return lambda data, size: unpacked(data, decompressor, size)


def limit_unpacking() -> None:
    """Make rosbags use the decompressors of this module."""
    lz4_frame: Callable[[], _Decompressor] = lz4.frame.LZ4FrameDecompressor
    reader1.decompressors["bz2"] = _Kept(bz2.BZ2Decompressor)
    reader1.decompressors["lz4"] = _Kept(lz4_frame)
    storage_mcap.DECOMPRESSORS["lz4"] = _of_chunks(lz4_frame)
    storage_mcap.DECOMPRESSORS["zstd"] = _of_chunks(_zstd.ZstdDecompressor)
    reader2.zstd = _Zstd  # type: ignore[assignment]
