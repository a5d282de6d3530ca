# SPDX-License-Identifier: Apache-2.0
"""Columns of every topic that `inspect` understands, read in one pass; other topics are only counted."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.errors import in_one_line
from graphloc.frontends import nmea
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._reports import FILTER, WATER, bare_topic
from graphloc.frontends._rows import LIKE, ROWS, SENTENCES, Row, nmea_speed, nmea_velocity, row_of
from graphloc.frontends._said import Part, SaidAlong
from graphloc.frontends._standard import gps_fix_velocity_mps
from graphloc.frontends._tf import StaticTree
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.msgtypes import (
    GPS_FIXES,
    NAV_SAT_FIX,
    NMEA,
    NUMBERS,
    POINT,
    TWIST,
    UNSTAMPED,
    stamp_ns_of,
)
from graphloc.frontends.source import TF_MOVING, TF_STATIC, Bag, RawMessage
from graphloc.frontends.vendors import GEOGRAPHIC, VENDORS

# Topics of places that are not measured by a sensor of the craft: goals, origins of filters, other vessels, the truth.
_ELSEWHERE = re.compile(
    r"click|person|obstacle|look_?ahead|origin|home(?![a-z])|set_?point|goal|target|waypoint|cmd|command|desired|contact|aton|anchor|truth|/gt(?![a-z])",
    re.IGNORECASE,
)
_HEADING = re.compile(r"head|hdg|hdt|yaw|compass|azimuth", re.IGNORECASE)  # a topic of bare numbers may be a heading
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
                streams[name] = TopicData(name, LIKE[part.kind][0], part=part)
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
    return streams[name], row_of(said, part.kind)


def _sentences(topic: str, msg: Any, streams: dict[str, TopicData]) -> list[tuple[TopicData, Row | None]]:
    """Return the stream, made at first use, and the row of each sentence in a message; None of a damaged sentence."""
    said: list[tuple[TopicData, Row | None]] = []
    text = nmea.text_of(msg)
    for talker, kind in nmea.identities(text):
        if kind in SENTENCES:
            of, read = SENTENCES[kind]
            name = f"{topic} {talker}{kind}"
            stream = streams.setdefault(name, TopicData(name, LIKE[of][0]))
            said.append((stream, row_of(read(text, talker + kind), of)))
        if kind == "RMC" and (row := row_of(nmea_velocity(text, talker + kind), "gnss_velocity")) is not None:
            said.append((streams.setdefault(name + COURSE, TopicData(name + COURSE, TWIST)), row))
        if kind == "VBW" and (row := row_of(nmea_speed(text, talker + kind, "water"), "body_velocity")) is not None:
            said.append((streams.setdefault(name + WATER, TopicData(name + WATER, TWIST)), row))
    return said
