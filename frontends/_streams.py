# SPDX-License-Identifier: Apache-2.0
"""Columns of every topic that `inspect` understands, read in one pass; other topics are only counted."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.errors import in_one_line
from graphloc.frames import Array
from graphloc.frontends import nmea
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._reports import FILTER, WATER, bare_topic
from graphloc.frontends._said import Part, Said, SaidAlong, SaidHeading, SaidInertial, SaidPlace, SaidVelocity
from graphloc.frontends._standard import NMEA_STATUS, gps_fix_velocity_mps, nav_sat_status, nmea_sigmas_m, pose_numbers
from graphloc.frontends._tf import StaticTree
from graphloc.frontends.decode import no_lock
from graphloc.frontends.msgtypes import (
    GPS_FIXES,
    IMU,
    NAV_SAT_FIX,
    NMEA,
    NUMBERS,
    ODOMETRY,
    PLACES,
    PLAIN_TWIST,
    POINT,
    QUATERNION,
    TWIST,
    UNSTAMPED,
    VECTOR,
    stamp_ns_of,
)
from graphloc.frontends.source import TF_MOVING, TF_STATIC, Bag, RawMessage
from graphloc.frontends.vendors import GEOGRAPHIC, VENDORS
from graphloc.ledger import Outcome
from graphloc.time import NS_PER_S

Row = tuple[float, ...]


def _xyz(v: Any) -> tuple[float, float, float]:
    return (v.x, v.y, v.z)


def _velocity_row(v: Any) -> tuple[float, float, float]:
    said = _xyz(v)
    return (np.nan, np.nan, np.nan) if no_lock(said) else said


def _xyzw(q: Any) -> tuple[float, float, float, float]:
    return (q.x, q.y, q.z, q.w)


def _imu_row(m: Any) -> tuple[float, ...]:
    covariances = (m.linear_acceleration_covariance[0], m.angular_velocity_covariance[0], m.orientation_covariance[0])
    return (*_xyz(m.linear_acceleration), *_xyz(m.angular_velocity), *_xyzw(m.orientation), *covariances)


def _fix_row(m: Any) -> tuple[float, ...]:
    c = m.position_covariance
    kind = m.position_covariance_type
    return (m.latitude, m.longitude, m.altitude, nav_sat_status(m.status.status), kind, c[0], c[4], c[8])


def _pose_row(m: Any) -> tuple[float, ...]:
    return (*pose_numbers(m), 0.0, 0.0, 0.0)


def _odometry_row(m: Any) -> tuple[float, ...]:
    return (*_pose_row(m)[:7], *_xyz(m.twist.twist.linear))


ROWS: dict[str, Callable[[Any], tuple[float, ...]]] = {
    IMU: _imu_row,
    NAV_SAT_FIX: _fix_row,
    QUATERNION: lambda m: _xyzw(m.quaternion),
    ODOMETRY: _odometry_row,
    **dict.fromkeys(PLACES, _pose_row),
    TWIST: lambda m: _velocity_row(m.twist.twist.linear),
    PLAIN_TWIST: lambda m: _velocity_row(m.twist.linear),
    VECTOR: lambda m: _velocity_row(m.vector),
    **dict.fromkeys(GPS_FIXES, _fix_row),
    **dict.fromkeys(NUMBERS, lambda m: (m.data,)),
}
# Topics of places that are not measured by a sensor of the craft: goals, origins of filters, other vessels, the truth.
_ELSEWHERE = re.compile(
    r"click|person|obstacle|look_?ahead|origin|home(?![a-z])|set_?point|goal|target|waypoint|cmd|command|desired|contact|aton|anchor|truth|/gt(?![a-z])",
    re.IGNORECASE,
)
_HEADING = re.compile(r"head|hdg|hdt|yaw|compass|azimuth", re.IGNORECASE)  # a topic of bare numbers may be a heading


def _nmea_place(text: str, wanted: str) -> SaidPlace | Rejection:
    said = nmea.fix(text, [wanted])
    if isinstance(said, Rejection):
        return said
    sigmas_m = nmea_sigmas_m(said, (0.0, 0.0))  # only the qualities of RTK imply one
    return SaidPlace(said.latitude_deg, said.longitude_deg, said.height_m, NMEA_STATUS.get(said.quality, 0), *sigmas_m)


def _nmea_heading(text: str, wanted: str) -> SaidHeading | Rejection:
    said = nmea.heading_deg(text, [wanted])
    return said if isinstance(said, Rejection) else SaidHeading(float(np.radians(90.0 - said)))


def _nmea_velocity(text: str, wanted: str) -> SaidVelocity | Rejection:
    said = nmea.velocity_mps(text, [wanted])
    return said if isinstance(said, Rejection) else SaidVelocity((*said, 0.0))


def _nmea_speed(text: str, wanted: str, through: str = "ground") -> SaidVelocity | Rejection:
    said = nmea.log_velocity_mps(text, [wanted], through)
    if isinstance(said, Rejection):
        return said
    ahead, port = (*said, 0.0)[:2]
    return SaidVelocity((ahead, port, 0.0))


# By sentence: the kind of sensor that reads it, and what it says.
SENTENCES: dict[str, tuple[str, Callable[[str, str], Said | Rejection]]] = {
    **dict.fromkeys(nmea.HEADINGS, ("compass", _nmea_heading)),
    "VTG": ("gnss_velocity", _nmea_velocity),
    **dict.fromkeys(nmea.SPEEDS, ("body_velocity", _nmea_speed)),
    **dict.fromkeys(nmea.PLACES, ("gnss", _nmea_place)),
}
_SATELLITES = re.compile("(G[A-Z]|BD)[A-Z]{3}")  # a talker ID that names the satellite systems of a receiver
# Sentences of two talkers that are recorded less than so many steps apart are of the same moment; the largest share of
# such sentences that talkers of one receiver may have.
_BESIDE, _BY_CHANCE = 0.75, 0.2
_DAY_S, _FEWEST_TIMES = 86_400.0, 20
# Least number of velocities in VTG, as a share of those in RMC, from which VTG replaces RMC: some receivers leave VTG
# empty, or say it every other time.
_AS_OFTEN = 0.8
COURSE, HEADING = " (course, speed)", " (heading)"
"""Endings of the names of streams: what RMC, a GPSFix or a maker's message says beside a place."""
# By kind of sensor, of what NMEA and makers' messages say: the message type of the same content, and a row without a value.
_LIKE: dict[str, tuple[str, Row]] = {
    "imu": (IMU, (*[np.nan] * 6, *[0.0] * 4, 0.0, 0.0, -1.0)),
    "gnss": (NAV_SAT_FIX, (np.nan, np.nan, np.nan, -1.0, 0.0, 0.0, 0.0, 0.0)),
    "gnss_velocity": (TWIST, (np.nan, np.nan, np.nan)),
    "compass": (QUATERNION, (0.0, 0.0, np.nan, np.nan)),
    "body_velocity": (TWIST, (np.nan, np.nan, np.nan)),
}


def _row_of(said: Said | Rejection, kind: str) -> Row | None:
    """Return the row of what a sentence or a maker's message says to a kind of sensor; None if it is damaged."""
    match said:
        case Rejection():
            return None if said.outcome is Outcome.MALFORMED else _LIKE[kind][1]
        case SaidInertial():
            return (*said.accel_mps2, *said.gyro_radps, *_LIKE["imu"][1][6:])
        case SaidPlace():
            h, v = said.horizontal_m**2, said.vertical_m**2
            return (*said[:3], said.status, 2.0 * (h > 0.0), h, h, v)
        case SaidVelocity():
            return said.v_mps
        case SaidHeading():
            return (0.0, 0.0, float(np.sin(said.angle_rad / 2.0)), float(np.cos(said.angle_rad / 2.0)))
        case SaidAlong():
            ahead, starboard, down = said.v_mps
            return (ahead, -starboard, -down)  # to port, up


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


@dataclass(frozen=True, slots=True)
class Sentences:
    """What NMEA tells beside the streams.

    Attributes:
        unread: by topic, the number of sentences that nothing reads, by their name.
        after_s: by stream ('TOPIC GPGGA'), of each place: its stamp, or its recording time where it has no stamp, less
            the time of day in the sentence, s, within half a day.
    """

    unread: dict[str, Counter[str]] = field(default_factory=dict)
    after_s: dict[str, list[float]] = field(default_factory=dict)

    def take(self, topic: str, text: str, places: Sequence[str], at_ns: int) -> None:
        """Take in a message.

        Args:
            topic, text: its topic and sentences. places: the streams to which it gave a place.
            at_ns: its stamp, or its recording time where it has none.
        """
        self.unread.setdefault(topic, Counter()).update(nmea.unread(text))
        for stream in places:
            after_s = at_ns * 1e-9 - nmea.time_of_day_s(text, stream.partition(" ")[2])
            if np.isfinite(after_s):
                self.after_s.setdefault(stream, []).append(float(_within_half_a_day(after_s)))

    def spread_s(self, stream: str) -> tuple[float, float, float] | None:
        """Return the 5 %, 50 % and 95 % points of a stream's `after_s`, over all talkers; None of too few sentences."""
        topic, _, said = stream.partition(" ")
        told = [t for sentence in said.split("+") for t in self.after_s.get(f"{topic} {sentence}", ())]
        if len(told) < _FEWEST_TIMES:
            return None
        about = np.median(told)  # percentiles about the median: times of day wrap at half a day
        low, middle, high = np.percentile(_within_half_a_day(np.array(told) - about), [5.0, 50.0, 95.0])
        return float(about + low), float(about + middle), float(about + high)


def _within_half_a_day(seconds: Any) -> Any:
    """Return times (...), s, less whole days."""
    return np.remainder(seconds + _DAY_S / 2.0, _DAY_S) - _DAY_S / 2.0


def read_streams(bag: Bag) -> tuple[list[TopicData], StaticTree, Sentences]:
    """Read all topics of the types in `ROWS` and `VENDORS`, the static transforms, and what NMEA tells beside these.

    An NMEA topic gives a stream per sentence and talker, of the message type with the same content, named 'TOPIC
    GPGGA'; of a receiver that changes its talker ID, 'TOPIC GPGGA+GNGGA'. RMC and a GPSFix give a second stream, of
    velocities, named 'TOPIC GPRMC (course, speed)', where they hold any and no VTG on the line tells them. VBW gives
    one stream over ground and one through water. A maker's message gives a stream for each of its parts, of the message
    type with the same content. A Doppler log's velocities through water are a stream named 'TOPIC (through water)'; a
    stream that is mostly the output of a filter is named 'TOPIC (of a filter)'.
    """
    streams, tree = _empty_streams(bag), StaticTree()
    sentences = _fill(streams, tree, bag)
    tree.settle()
    _join_talkers(streams)
    for name in _of_no_use(streams):
        del streams[name]
    for stream in streams.values():
        stream.settle()
    return [_named_as_filters(stream) for stream in streams.values()], tree, sentences


def _empty_streams(bag: Bag) -> dict[str, TopicData]:
    """Return empty streams, by name, of the topics whose type and name allow one.

    Streams of NMEA sentences are added when a sentence comes first.
    """
    streams = {
        t.topic: TopicData(t.topic, t.msgtypes[0])
        for t in bag.topics.values()
        if len(t.msgtypes) == 1
        and t.msgtypes[0] in ROWS
        and (t.msgtypes[0] not in NUMBERS or _HEADING.search(t.topic))
        and not (t.msgtypes[0] == POINT and _ELSEWHERE.search(t.topic))
    }
    for t in bag.topics.values():
        if (
            len(t.msgtypes) == 1
            and t.msgtypes[0] in VENDORS
            and not (t.msgtypes[0] in GEOGRAPHIC and _ELSEWHERE.search(t.topic))
        ):
            for name, part in _parts(t.topic, t.msgtypes[0]):
                streams[name] = TopicData(name, _LIKE[part.kind][0], part=part)
    return streams


def _fill(streams: dict[str, TopicData], tree: StaticTree, bag: Bag) -> Sentences:
    """Read the messages of a bag into `streams` and `tree`, in place; return what NMEA tells beside the streams."""
    sentences = Sentences()
    mixed = {t.topic for t in bag.topics.values() if len(t.msgtypes) == 1 and t.msgtypes[0] in NMEA}
    wanted = set(streams) | mixed | ({TF_STATIC, TF_MOVING} & set(bag.topics))
    for raw in bag.messages(wanted) if wanted else ():
        if raw.topic == TF_MOVING:
            tree.offer(raw, bag.decode)
            continue
        msg: Any = None
        try:
            msg = bag.decode(raw)
            said = _sentences(raw.topic, msg, streams) if raw.topic in mixed else _plain(raw, msg, streams)
            if raw.topic in mixed:
                at_ns = stamp_ns_of(msg, raw.msgtype, raw.log_ns) or raw.log_ns
                sentences.take(raw.topic, nmea.text_of(msg), _places(said), at_ns)
        except Exception as error:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything; counted
            said = [(streams[raw.topic], None)] if raw.topic in streams else []
            for stream, _ in said:
                stream.broken = stream.broken or _why_broken(error, msg)
        if raw.topic == TF_STATIC:
            tree.take(raw.msgtype, msg)
        for stream, row in said:
            _add(stream, row, raw, msg)
    return sentences


def _why_broken(error: Exception, msg: Any) -> str:
    """Return why a message cannot be decoded.

    Args:
        msg: the message, unpacked by its definition in the bag; None where its bytes do not fit this definition.
    """
    if msg is None:
        return f"its bytes do not fit its definition ({type(error).__name__})"
    return f"by its definition in the bag it is another version than is read here: {in_one_line(error)}"


def _places(said: Sequence[tuple[TopicData, Row | None]]) -> list[str]:
    """Return the names of the streams to which a message gave a place."""
    return [s.topic for s, row in said if s.msgtype == NAV_SAT_FIX and row is not None and np.isfinite(row[:2]).all()]


def _add(stream: TopicData, row: Row | None, raw: RawMessage, msg: Any) -> None:
    """Add the row of a message to a stream; None: the message could not be decoded."""
    if row is None:
        stream.undecodable += 1
        return
    stamp_ns = stamp_ns_of(msg, raw.msgtype, raw.log_ns)
    if raw.msgtype not in UNSTAMPED:
        header = getattr(msg, "header", None)
        frame_id = str(getattr(header, "frame_id", "")).lstrip("/")
        stream.frame_id = stream.frame_id or frame_id
        stream.frames[frame_id] += 1
    stream.add(stamp_ns or 0, raw.log_ns, row, raw.file, raw.elapsed_ns)


def _of_no_use(streams: Mapping[str, TopicData]) -> list[str]:
    """Return the names of streams that say nothing, or what other streams say as well.

    Of a Doppler log's streams over ground and through water, at least one stays.
    """
    told = {name for name, stream in streams.items() if np.isfinite(stream.rows).any()}
    return [
        name
        for name, stream in streams.items()
        if (name.endswith((COURSE, HEADING)) and _told_elsewhere(stream, streams))
        or (name + WATER in told and name not in told)
        or (name.endswith(WATER) and name not in told)
    ]


def _named_as_filters(stream: TopicData) -> TopicData:
    """Return the stream, with a name that says so if at least half of its complete rows are a filter's output."""
    if not (stream.filtered and len(stream)) or 2 * stream.filtered < np.isfinite(stream.rows).all(axis=1).sum():
        return stream
    return replace(stream, topic=stream.topic + FILTER)


def _join_talkers(streams: dict[str, TopicData]) -> None:
    """Join streams of one sentence, in place, whose talkers take turns.

    A receiver that uses GPS alone has the talker ID GP, and GN once it uses other satellites. So two talkers of one
    receiver never say the same sentence within a step of each other; talkers of two receivers nearly always do.
    """
    alike: dict[tuple[str, str], list[TopicData]] = {}
    for name, stream in streams.items():
        line, _, said = name.partition(" ")
        if _SATELLITES.match(said):
            alike.setdefault((line, said[2:]), []).append(stream)
    for (line, said), several in alike.items():
        if len(several) < 2 or not _take_turns([s.logs_ns for s in several]):
            continue
        sentence = said.removesuffix(COURSE)
        talkers = "+".join(s.topic.removeprefix(f"{line} ")[:2] + sentence for s in several)
        joined = f"{line} {talkers}{said.removeprefix(sentence)}"
        place = list(streams).index(several[0].topic)
        for stream in several:
            del streams[stream.topic]
        rest = list(streams.items())
        streams.clear()
        streams.update([*rest[:place], (joined, TopicData.joined(joined, several)), *rest[place:]])


def _take_turns(logs_ns: Sequence[NDArray[np.int64]]) -> bool:
    """Return whether talkers take turns rather than speak at the same time.

    Args:
        logs_ns: (N,) recording times of each talker's sentences, in order.
    """
    steps = [float(np.median(np.diff(own))) for own in logs_ns if len(own) > 2]
    if not steps or min(steps) == 0.0:  # recorded in bursts, or to the second: nothing tells who spoke when
        return False
    for k, own in enumerate(logs_ns):
        others = np.sort(np.concatenate([*logs_ns[:k], *logs_ns[k + 1 :]]))
        if not len(own) or len(own) > len(others):
            continue
        after = np.clip(np.searchsorted(others, own), 1, max(len(others) - 1, 1))
        nearest = np.minimum(np.abs(own - others[after - 1]), np.abs(own - others[np.minimum(after, len(others) - 1)]))
        if float((nearest < _BESIDE * min(steps)).mean()) > _BY_CHANCE:
            return False
    return True


def _told_elsewhere(stream: TopicData, streams: Mapping[str, TopicData]) -> bool:
    """Return whether what is said beside a place is nothing, or is said by VTG on the same line about as often."""
    line, least = bare_topic(stream.topic), _AS_OFTEN * _told(stream)
    vtg = any(name.startswith(f"{line} ") and name.endswith("VTG") and _told(s) >= least for name, s in streams.items())
    return vtg or not np.nan_to_num(stream.rows).any()


def _told(stream: TopicData) -> int:
    """Return the number of messages of a stream without NaN."""
    return int(np.isfinite(stream.rows).all(axis=-1).sum()) if len(stream) else 0


def _plain(raw: RawMessage, msg: Any, streams: dict[str, TopicData]) -> list[tuple[TopicData, Row | None]]:
    if raw.topic not in streams:
        return []
    if raw.msgtype in VENDORS:
        return [_said_of(part, msg, name, streams) for name, part in _parts(raw.topic, raw.msgtype)]
    said: list[tuple[TopicData, Row | None]] = [(streams[raw.topic], ROWS[raw.msgtype](msg))]
    if raw.msgtype in GPS_FIXES:
        v, name = gps_fix_velocity_mps(msg), raw.topic + COURSE
        row = (np.nan, np.nan, np.nan) if isinstance(v, Rejection) else (*v[:2], v[2] if np.isfinite(v[2]) else 0.0)
        said.append((streams.setdefault(name, TopicData(name, TWIST)), row))
    return said


def _parts(topic: str, msgtype: str) -> list[tuple[str, Part]]:
    """Return the parts of a maker's messages with the names of their streams; the first one is named as the topic."""
    beside = {"gnss_velocity": COURSE, "compass": HEADING}
    return [(topic + beside[part.kind] if k else topic, part) for k, part in enumerate(VENDORS[msgtype])]


def _said_of(part: Part, msg: Any, name: str, streams: dict[str, TopicData]) -> tuple[TopicData, Row | None]:
    """Return the stream and the row of one part of a maker's message, the row None if the message is damaged.

    Velocities through water have a stream of their own.
    """
    said = part.read(msg)
    if isinstance(said, SaidAlong) and said.through == "water":
        name += WATER
        streams.setdefault(name, TopicData(name, TWIST, part=part))
    streams[name].filtered += getattr(said, "filtered", False)
    return streams[name], _row_of(said, part.kind)


def _sentences(topic: str, msg: Any, streams: dict[str, TopicData]) -> list[tuple[TopicData, Row | None]]:
    """Return the stream, made at first use, and the row of each sentence in a message; None of a damaged sentence."""
    said: list[tuple[TopicData, Row | None]] = []
    text = nmea.text_of(msg)
    for talker, kind in nmea.identities(text):
        if kind in SENTENCES:
            of, read = SENTENCES[kind]
            name = f"{topic} {talker}{kind}"
            stream = streams.setdefault(name, TopicData(name, _LIKE[of][0]))
            said.append((stream, _row_of(read(text, talker + kind), of)))
        if kind == "RMC" and (row := _row_of(_nmea_velocity(text, talker + kind), "gnss_velocity")) is not None:
            said.append((streams.setdefault(name + COURSE, TopicData(name + COURSE, TWIST)), row))
        if kind == "VBW" and (row := _row_of(_nmea_speed(text, talker + kind, "water"), "body_velocity")) is not None:
            said.append((streams.setdefault(name + WATER, TopicData(name + WATER, TWIST)), row))
    return said
