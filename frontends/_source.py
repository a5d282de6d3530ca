# SPDX-License-Identifier: Apache-2.0
"""Recorded bags as one stream of raw messages: ROS 1, ROS 2 sqlite3 and MCAP, split and compressed.

This stands on the readers of rosbags and not on its `AnyReader`, because that one registers every
type of the bag (one bad definition on a topic nobody asked for makes the whole bag unreadable), and
because a folder whose metadata or last file is damaged can still be read file by file.
"""

from __future__ import annotations

import heapq
import logging
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.interfaces.typing import Typesdict
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from graphloc.errors import InputError
from graphloc.frontends._clock import refuse_set_back
from graphloc.frontends._part import BagPart, Bags, recording_times
from graphloc.frontends._recover import Recovered, as_ros2, recover
from graphloc.frontends._unpack import limit_unpacking
from graphloc.recording import Span
from graphloc.time import duration_ns, seconds_between, utc_text

log = logging.getLogger(__name__)
limit_unpacking()
LATEST_NS = 2**62 - 1
"""The last time that is worked with (year 2116): a difference of differences still fits 64 bits."""
TF_STATIC = "/tf_static"
HINTS = {
    ".bag": "try `rosbag reindex`",
    ".mcap": "try `mcap recover`",
    ".db3": "try `sqlite3 FILE .recover` and `ros2 bag reindex`",
    "": "try `ros2 bag reindex`",
}


# Types outside of rosbags' stores; bags of ROS 2 Humble and older in sqlite3 carry no definitions.
_OTHER_TYPES = {
    "apriltag_msgs/msg/AprilTagDetectionArray": f"""std_msgs/Header header
AprilTagDetection[] detections
{"=" * 80}
MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
Point centre
Point[4] corners
float64[9] homography
{"=" * 80}
MSG: apriltag_msgs/Point
float64 x
float64 y
""",
    "nmea_msgs/msg/Sentence": "std_msgs/Header header\nstring sentence\n",
    **{
        f"{package}/msg/GPSFix": f"""std_msgs/Header header
GPSStatus status
float64 latitude
float64 longitude
float64 altitude
float64 track
float64 speed
float64 climb
float64 pitch
float64 roll
float64 dip
float64 time
float64 gdop
float64 pdop
float64 hdop
float64 vdop
float64 tdop
float64 err
float64 err_horz
float64 err_vert
float64 err_track
float64 err_speed
float64 err_climb
float64 err_time
float64 err_pitch
float64 err_roll
float64 err_dip
float64[9] position_covariance
uint8 position_covariance_type
{"=" * 80}
MSG: {package}/GPSStatus
std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
        for package in ("gps_msgs", "gps_common")
    },
}


class RawMessage(NamedTuple):
    """A message as recorded: nothing is decoded yet."""

    topic: str
    msgtype: str
    file: str
    log_ns: int
    data: bytes


class TopicSummary(NamedTuple):
    """What the bag's index says about a topic: of a part of a bag, how many messages lie in that."""

    topic: str
    msgtypes: tuple[str, ...]
    messages: int


class _Opened(NamedTuple):
    path: Path
    reader: Reader1 | Reader2


class Bag:
    """An open recording. Use as a context manager.

    Attributes:
        name: its path(s), for messages.
        warnings: what was wrong with the files; grows while messages are read.
        ros1: whether messages are in ROS 1 serialisation.
        span: which part of the bag is read, with its topics; None: the whole bag.
    """

    def __init__(self, bags: Bags) -> None:
        self._part = bags if isinstance(bags, BagPart) else _whole(bags)
        self.paths = self._part.paths
        self.name = ", ".join(str(p) for p in self.paths)
        self.warnings: list[str] = []
        self._stack = ExitStack()
        self._opened: list[_Opened] = []
        self._broken: list[str] = []
        self._stores: dict[str, Typestore] = {}
        self._within: tuple[int | None, int | None] = (None, None)  # ns, as rosbags takes it: the end is not in it
        self._inside: Counter[str] = Counter()
        self.span: Span | None = None

    def __enter__(self) -> Self:
        if not self.paths:
            raise InputError("no bag given")
        try:
            for path in self.paths:
                self._open(path)
        except BaseException:
            self._stack.close()
            raise
        if not self._opened:
            self._stack.close()
            raise InputError("; ".join(self._broken))
        self.warnings.extend(self._broken)
        self.ros1 = isinstance(self._opened[0].reader, Reader1)
        if any(isinstance(o.reader, Reader1) != self.ros1 for o in self._opened):
            self._stack.close()
            raise InputError(f"{self.name}: ROS 1 and ROS 2 bags cannot be read as one run; give one kind")
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
        """Find out where the part lies, and how many messages of each topic lie in it."""
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

    def _times(self, opened: _Opened) -> list[tuple[str, NDArray[np.int64]]]:
        """Topics and recording times of a file, from its index; where that is damaged, from as much as can be read."""
        try:
            return list(recording_times(opened.reader))
        except Exception as error:  # noqa: BLE001 - as below
            self.warnings.append(
                f"{opened.path}: its index is damaged ({_text(error)}): its messages were counted instead"
            )
        found: list[tuple[str, NDArray[np.int64]]] = []
        with suppress(Exception):  # where it ends is said when its messages are read
            for connection, log_ns, _ in _stream(opened, opened.reader.connections, None, None):
                found.append((connection.topic, np.array([min(max(log_ns, 0), LATEST_NS)])))
        return found

    def _open(self, path: Path) -> None:
        """Open a file, or a folder, or what is readable of it."""
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        if path.is_dir():
            self._open_folder(path)
        elif path.suffix in (".bag", ".mcap", ".db3"):
            self._try(path, Reader1 if path.suffix == ".bag" else Reader2)
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
            reason = self._broken.pop()
        else:
            reason = f"{path}: has no metadata.yaml"
        files = sorted(p for p in path.iterdir() if p.suffix in (".bag", ".mcap", ".db3"))
        before = len(self._opened)
        for file in files:
            self._open(file)
        if len(self._opened) > before:
            if files[0].suffix != ".bag":
                self.warnings.append(f"{reason}; its files were read one by one ({HINTS['']})")
        else:
            self._broken.append(f"{reason}; and no readable .bag, .mcap or .db3 file lies in it ({_instead(path)})")

    def _try(self, path: Path, kind: type[Reader1 | Reader2]) -> bool:
        """Open with rosbags; a file that is cut short is opened again as far as it is whole."""
        try:
            view = as_ros2(path) if path.is_file() else None
            reader = _open_reader(kind, view or path)
        except Exception as error:  # noqa: BLE001 - rosbags lets struct, assertion, sqlite and codec errors through
            reason = f"{path}: cannot be read ({_text(error)}); {HINTS.get(path.suffix, HINTS[''])}"
            repaired = recover(path) if path.is_file() else None
            if repaired is None or not self._try_recovered(path, kind, repaired):
                # Only now: the summary alone may be damaged.
                others = isinstance(error, KeyError) and path.suffix == ".mcap"
                self._broken.append(_of_others(path, str(error)) if others else reason)
                return False
            self.warnings.append(
                f"{path}: damaged or cut short ({_text(error)}): read up to byte {repaired.whole_bytes} "
                f"of {repaired.file_bytes}; {HINTS[path.suffix]} to repair it"
            )
            return True
        self._append(path, reader)
        return True

    def _append(self, path: Path, reader: Reader1 | Reader2) -> None:
        self._stack.callback(reader.close)
        self._opened.append(_Opened(path, reader))

    def _try_recovered(self, path: Path, kind: type[Reader1 | Reader2], repaired: Recovered) -> bool:
        try:
            reader = _open_reader(kind, repaired)
        except Exception as error:  # noqa: BLE001 - as above
            log.debug("%s: recovery failed: %s", path, error)
            return False
        self._append(path, reader)
        return True

    @property
    def topics(self) -> dict[str, TopicSummary]:
        """Topics by name, with their types and the number of messages that the index announces, of a part in that."""
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
        """Yield the raw messages of some topics in order of arrival; others are never unpacked.

        Of a part of a bag those that were recorded in it, after all of /tf_static, which drivers send but once.
        A file that turns out damaged midway ends there, with a line in `warnings`.

        Args:
            whole: of the whole bag: for what is sent once, or stays as it is.
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
        self, opened: _Opened, wanted: list[Connection], within: tuple[int | None, int | None]
    ) -> Iterator[RawMessage]:
        read = 0
        try:
            for connection, log_ns, data in _stream(opened, wanted, *within):
                read += 1
                at_ns = min(max(log_ns, 0), LATEST_NS)
                yield RawMessage(connection.topic, connection.msgtype, opened.path.name, at_ns, data)
        except Exception as error:  # noqa: BLE001 - as above
            self.warnings.append(
                f"{opened.path}: damaged after {read} messages ({_text(error)}): the rest was not read; "
                f"{HINTS.get(opened.path.suffix, HINTS[''])}"
            )

    def refuse_set_back(self, topics: Collection[str]) -> None:
        """Refuse the bag, or the part of it, where the recorder's clock was set back while these topics were written.

        Raises:
            InputError: it was.
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
        """Return the deserialised message. Raises whatever rosbags raises on bad bytes."""
        if message.msgtype not in self._stores:
            self._stores[message.msgtype] = self._store_of(message.msgtype)
        store = self._stores[message.msgtype]
        store.max_sequence_length = len(message.data) or 1  # of what takes no bytes there could be 2^32
        decode = store.deserialize_ros1 if self.ros1 else store.deserialize_cdr
        return decode(message.data, message.msgtype)

    def _store_of(self, msgtype: str) -> Typestore:
        """Return the type's definition from the bag where it carries one; the standard one elsewhere."""
        definitions = (c.msgdef for o in self._opened for c in o.reader.connections if c.msgtype == msgtype)
        for definition in definitions:
            if definition.format == MessageDefinitionFormat.NONE:
                continue
            try:
                return _defined(definition.format, definition.data, msgtype)
            except Exception as error:  # noqa: BLE001 - a definition may be any text
                self.warnings.append(
                    f"{self.name}: its definition of {msgtype} cannot be read ({_text(error)}); the standard one is used"
                )
            break
        store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.LATEST)
        if msgtype in _OTHER_TYPES:
            store.register(get_types_from_msg(_OTHER_TYPES[msgtype], msgtype))
        return store


def _whole(paths: Path | str | Sequence[Path | str]) -> BagPart:
    return BagPart((Path(paths),) if isinstance(paths, str | Path) else tuple(Path(p) for p in paths))


def _not_named(folder: Path) -> list[str]:
    """Files of a folder that its metadata.yaml does not name: of a recorder that died, say, or copied there."""
    named = (folder / "metadata.yaml").read_text(encoding="utf-8", errors="replace")
    return sorted(p.name for p in folder.iterdir() if p.suffix in (".mcap", ".db3") and p.name not in named)


def _instead(folder: Path) -> str:
    """Say what may have been meant by a folder that is no bag: one of graphloc's own, or one level up."""
    if (folder / "run.json").exists():
        return "it is the folder of a finished run: give the bag, which its run.json names"
    inside = sorted(p.name for p in folder.iterdir() if (p / "metadata.yaml").exists())
    return f"a bag lies in it: {folder / inside[0]}" if inside else HINTS[""]


def _open_reader(kind: type[Reader1 | Reader2], path: Path | Recovered) -> Reader1 | Reader2:
    """Open with rosbags, and look at what it says of its topics: sqlite3 gives back whatever bytes were damaged to."""
    reader = kind(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what a YAML reader thinks of metadata.yaml
        reader.open()
    for c in reader.connections:
        if not (isinstance(c.topic, str) and isinstance(c.msgtype, str) and isinstance(c.msgcount, int)):
            reader.close()
            raise TypeError("its list of topics is damaged")
    return reader


@lru_cache(maxsize=64)  # a run opens its bag several times, and rosbags writes a program for each type
def _defined(form: MessageDefinitionFormat, text: str, msgtype: str) -> Typestore:
    parse = get_types_from_msg if form == MessageDefinitionFormat.MSG else _types_from_idl
    store = get_typestore(Stores.EMPTY)
    store.register(parse(text, msgtype))
    return store


def _types_from_idl(text: str, _msgtype: str) -> Typesdict:
    """Parse the concatenated IDL files of an MCAP schema."""
    separator = "=" * 80 + "\n"
    parts = text.split(separator) if text.startswith(f"{separator}IDL: ") else [text]
    types: Typesdict = {}
    for part in filter(None, parts):
        types.update(get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part))
    return types


def _stream(
    opened: _Opened, wanted: list[Connection], start_ns: int | None, end_ns: int | None
) -> Iterator[tuple[Connection, int, bytes]]:
    """Messages of a file that were recorded from `start_ns` to before `end_ns`. MCAP without an index is taken in the order of the file, which need not be that of time."""
    if isinstance(opened.reader, Reader2) and isinstance(opened.reader.storage, McapReader):
        storage = opened.reader.storage
        read = storage.messages if storage.chunks else storage.messages_scan
        return read(wanted, start_ns, end_ns)
    return opened.reader.messages(wanted, start_ns, end_ns)


def _of_others(path: Path, encoding: str) -> str:
    """What is said of an MCAP file with a schema in an encoding that rosbags does not know."""
    if "ros1" in encoding:
        return f"{path}: holds messages of ROS 1, which are read from a .bag only: give the one that it was made of"
    return f"{path}: holds messages that are not ROS 2's ({encoding}): write its ROS topics to a file of their own (`mcap filter`)"


def _text(error: BaseException) -> str:
    return " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
