# SPDX-License-Identifier: Apache-2.0
"""Open bags with rosbags: files, folders, and the readable part of damaged ones."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.storage_mcap import McapReader

from graphloc.errors import InputError
from graphloc.frontends._recover import Recovered, as_ros2, recover, suffix_of
from graphloc.frontends._unpack import limit_unpacking

log = logging.getLogger(__name__)
limit_unpacking()
_PART = re.compile(r"_(\d{1,6})$")  # at the end of a stem: number of a part of a split bag
_GOES_ON_S = 2.0  # within which a recorder has opened the next part
_MOST_LOOKED_AT = 20  # files whose number would fit
_SUFFIXES = (".bag", ".mcap", ".db3")
HINTS = {
    ".bag": "try `rosbag reindex`",
    ".mcap": "try `mcap recover`",
    ".db3": "try `sqlite3 FILE .recover` and `ros2 bag reindex`",
    "": "try `ros2 bag reindex`",
}
_LFS = b"version https://git-lfs"  # begins the file that stands for another one in a checkout without Git LFS


class Opened(NamedTuple):
    """An open file or folder, and its reader."""

    path: Path
    reader: Reader1 | Reader2

    def messages(
        self, wanted: list[Connection], start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Return messages recorded in [start_ns, end_ns): connection, time (ns), bytes.

        MCAP without an index is read in the order of the file, which may differ from that of time.
        """
        if isinstance(self.reader, Reader2) and isinstance(self.reader.storage, McapReader):
            storage = self.reader.storage
            read = storage.messages if storage.chunks else storage.messages_scan
            return read(wanted, start_ns, end_ns)
        return self.reader.messages(wanted, start_ns, end_ns)


class BagOpener:
    """Opens paths one after another.

    Args:
        stack: closes the readers. warnings: gets a line for each damaged file that could be read in part.

    Attributes:
        opened: in order. broken: why others could not be opened.
    """

    def __init__(self, stack: ExitStack, warnings: list[str]) -> None:
        self._stack, self.warnings = stack, warnings
        self.opened: list[Opened] = []
        self.broken: list[str] = []

    def open(self, path: Path) -> None:
        """Open a file or a folder, or the readable part of it."""
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        if path.is_dir():
            self._open_folder(path)
        elif suffix_of(path) in _SUFFIXES:
            self._try(path, Reader1 if suffix_of(path) == ".bag" else Reader2)
        else:
            raise InputError(f"{path}: not a bag: expected .bag, .mcap, .db3, or the folder of a ROS 2 bag")

    def _open_folder(self, path: Path) -> None:
        if (path / "metadata.yaml").exists():
            if self._try(path, Reader2):
                if left := _not_named(path):
                    self.warnings.append(
                        f"{path}: its metadata.yaml does not name {', '.join(left)}, so what is in there is not read "
                        f"({HINTS['']}, or give the files one by one)"
                    )
                return
            reason = self.broken.pop()
        else:
            reason = f"{path}: has no metadata.yaml"
        files = sorted(p for p in path.iterdir() if suffix_of(p) in _SUFFIXES)
        before = len(self.opened)
        for file in files:
            self.open(file)
        if len(self.opened) > before:
            if suffix_of(files[0]) != ".bag":
                self.warnings.append(f"{reason}; its files were read one by one ({HINTS['']})")
        else:
            self.broken.append(f"{reason}; and no readable .bag, .mcap or .db3 file lies in it ({_instead(path)})")

    def _try(self, path: Path, kind: type[Reader1 | Reader2]) -> bool:
        """Open with rosbags; a truncated file is opened again as far as it is intact."""
        try:
            view = as_ros2(path) if path.is_file() else None
            reader = _open_reader(kind, view or path)
        except Exception as error:  # noqa: BLE001 - rosbags lets struct, assertion, sqlite and codec errors through
            reason = f"{path}: cannot be read ({text_of(error)}); {_hint(path)}"
            repaired = recover(path) if path.is_file() else None
            if repaired is None or not self._try_recovered(path, kind, repaired):
                # Only now: the summary alone may be damaged.
                others = isinstance(error, KeyError) and path.suffix == ".mcap"
                self.broken.append(_of_others(path, str(error)) if others else reason)
                return False
            self.warnings.append(
                f"{path}: damaged or cut short ({text_of(error)}): read up to byte {repaired.whole_bytes} "
                f"of {repaired.file_bytes}; {HINTS[suffix_of(path)]} to repair it"
            )
            return True
        self._append(path, reader)
        return True

    def _append(self, path: Path, reader: Reader1 | Reader2) -> None:
        self._stack.callback(reader.close)
        self.opened.append(Opened(path, reader))

    def _try_recovered(self, path: Path, kind: type[Reader1 | Reader2], repaired: Recovered) -> bool:
        try:
            reader = _open_reader(kind, repaired)
        except Exception as error:  # noqa: BLE001 - as above
            log.debug("%s: recovery failed: %s", path, error)
            return False
        self._append(path, reader)
        return True


def left_beside(opened: Sequence[Opened]) -> list[str]:
    """Return a line for each file of a split bag that lies beside the part after or before it, which is not read.

    By its number and its recording times: `run_1.bag` and `run_2.bag` may be two runs.
    """
    lines, read = [], {o.path.resolve() for o in opened}
    read |= {file for folder in list(read) if folder.is_dir() for file in folder.iterdir()}
    for path, reader in opened:
        number = _PART.search(path.stem)
        if path.is_dir() or number is None or not reader.message_count:
            continue
        for step, how in ((1, "goes on in"), (-1, "begins in")):
            named = sorted(path.resolve().parent.glob(f"*_{int(number[1]) + step}{path.suffix}"))
            for other in [file for file in named if file not in read][:_MOST_LOOKED_AT]:
                if _meets(reader, other, step):
                    lines.append(f"{path}: its recording {how} {other.name}, which is not read: give all parts of it")
    return lines


def _meets(reader: Reader1 | Reader2, other: Path, step: int) -> bool:
    """Return whether another file was recorded right after this one (step 1), or right before it (-1)."""
    try:
        with closing(_open_reader(type(reader), as_ros2(other) or other)) as beside:
            gap_ns = beside.start_time - reader.end_time if step > 0 else reader.start_time - beside.end_time
            return bool(beside.message_count and abs(gap_ns) <= _GOES_ON_S * 1e9)
    except Exception as error:  # noqa: BLE001 - as `BagOpener` does
        log.debug("%s: not looked at: %s", other, error)
        return False


def _not_named(folder: Path) -> list[str]:
    """Return the files of a folder that its metadata.yaml does not name, such as those of a recorder that crashed."""
    named = (folder / "metadata.yaml").read_text(encoding="utf-8", errors="replace")
    return sorted(p.name for p in folder.iterdir() if p.suffix in (".mcap", ".db3") and p.name not in named)


def _hint(path: Path) -> str:
    """Return what to do about a file that cannot be read."""
    with suppress(OSError), path.open("rb") as file:  # not of a folder, nor of a file that may not be read
        if file.read(len(_LFS)) == _LFS:
            return "it is a pointer of Git LFS, not the file itself: `git lfs pull` fetches that"
    return HINTS.get(suffix_of(path), HINTS[""])


def _instead(folder: Path) -> str:
    """Suggest what to give instead of a folder that is not a bag: a run folder's bag, or a bag inside it."""
    if (folder / "run.json").exists():
        return "it is the folder of a finished run: give the bag, which its run.json names"
    inside = sorted(p.name for p in folder.iterdir() if (p / "metadata.yaml").exists())
    return f"a bag lies in it: {folder / inside[0]}" if inside else HINTS[""]


def _open_reader(kind: type[Reader1 | Reader2], path: Path | Recovered) -> Reader1 | Reader2:
    """Open with rosbags and check the topics: sqlite3 returns damaged bytes as they are."""
    reader = kind(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what a YAML reader thinks of metadata.yaml
        reader.open()
    for c in reader.connections:
        if not (isinstance(c.topic, str) and isinstance(c.msgtype, str) and isinstance(c.msgcount, int)):
            reader.close()
            raise TypeError("its list of topics is damaged")
    return reader


def _of_others(path: Path, encoding: str) -> str:
    """Return the message on an MCAP file with a schema encoding that rosbags does not know."""
    if "ros1" in encoding:
        return f"{path}: holds messages of ROS 1, which are read from a .bag only: give the one that it was made of"
    return f"{path}: holds messages that are not ROS 2's ({encoding}): write its ROS topics to a file of their own (`mcap filter`)"


def text_of(error: BaseException) -> str:
    """Return an error of any library as one short line."""
    return " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
