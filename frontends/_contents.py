# SPDX-License-Identifier: Apache-2.0
"""What `inspect` reads of a bag, before anything is judged."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from graphloc.frontends._assess import as_heading, evenly, on_one_clock, without_drift
from graphloc.frontends._clock import (
    FEWEST_STAMPS,
    GAIN_LIMIT_S,
    ClockStep,
    leaps,
    pace,
    recorder_set,
    steady_logs,
    step,
    usual_latency_s,
    without_leaps,
)
from graphloc.frontends._order import refuse_woven
from graphloc.frontends._reports import bare_topic
from graphloc.frontends._streams import Sentences, read_streams
from graphloc.frontends._tf import Pose, StaticTree
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.aerial.cloud import CLOUDS
from graphloc.frontends.msgtypes import IMU, UNSTAMPED, header_stamp_ns
from graphloc.frontends.part import Bags
from graphloc.frontends.source import Bag, TopicSummary, unopened
from graphloc.frontends.tags.listed import LISTS
from graphloc.frontends.tags.sightings import IMAGES, INFO
from graphloc.signals.pauses import common_pauses, pauses_warning
from graphloc.time import NS_PER_S, seconds_between

_MOST_TRIED = 200  # so many first messages of a topic are tried until one can be decoded


class FirstMessage(NamedTuple):
    """First readable message of a topic: its frame, and recording time minus stamp, s, None if it has no stamp."""

    frame: str
    latency_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """What is read of a bag.

    Attributes:
        source: name of the bag, for messages. topics: by name, from its index.
        streams: by name, with leaps and drift of their clocks corrected. aligned: of these, the ones that have
            messages, on one clock.
        tree: of tf. sentences: what NMEA tells beside the streams.
        lidars, cameras, infos: first messages of clouds, of images and tag lists, and of CameraInfos, by topic.
        warnings: on the bag, tf and the clocks.
    """

    source: str
    topics: Mapping[str, TopicSummary]
    streams: Mapping[str, TopicData]
    aligned: Mapping[str, TopicData]
    tree: StaticTree
    sentences: Sentences
    lidars: Mapping[str, FirstMessage]
    cameras: Mapping[str, FirstMessage]
    infos: Mapping[str, FirstMessage]
    warnings: tuple[str, ...]

    def of_type(self, *msgtypes: str) -> list[TopicData]:
        """Return the aligned streams of some message types."""
        return [stream for stream in self.aligned.values() if stream.msgtype in msgtypes]

    def tf_pose(self, stream: TopicData) -> Pose | None:
        """Return T_body_sensor of a stream; None if tf does not connect its frame with the body."""
        return self.tree.resolve(self.tree.body(), stream.frame_id) if stream.frame_id in self.tree.frames else None

    def tf_frame(self, stream: TopicData) -> str | None:
        """Return the frame of a stream; None if tf does not connect it with the body."""
        return None if self.tf_pose(stream) is None else stream.frame_id


def contents_of(bags: Bags | Bag) -> Contents:
    """Read a bag: its topics, streams, transforms, and the first messages of LiDARs and cameras.

    Args:
        bags: see `read_recording`.

    Raises:
        InputError: the bag cannot be opened, or its parts overlap in time.
    """
    with unopened(bags) as bag:
        bag.refuse_set_back([t.topic for t in bag.topics.values() if IMU in t.msgtypes])
        streams, tree, sentences = read_streams(bag)
        lidars = _firsts_of(bag, _topics_of(bag, CLOUDS))
        cameras = _firsts_of(bag, _pictures(bag))
        infos = _firsts_of(bag, _topics_of(bag, (INFO,))) if cameras else {}
        source, topics, warnings = bag.name, bag.topics, [*bag.warnings, *filter(None, [tree.damage])]
    streams, said_of_recorder = _steadily_recorded(streams)
    streams, said_of_leaps = _without_leaps(streams)
    streams = [evenly(s) if s.msgtype == IMU and len(s) else as_heading(s) for s in without_drift(streams)]
    for stream in streams:
        if stream.msgtype == IMU:
            refuse_woven(stream.topic, stream.stamps_ns, stream.logs_ns, stream.tuples, stream.files)
    steps = _clock_steps(streams)
    said_of_steps = [at.said(topic) for topic, at in steps.items()]
    return Contents(
        source=source, topics=topics, streams={s.topic: s for s in streams},
        aligned={s.topic: s for s in on_one_clock([_as_mostly_set(s, steps) for s in streams if len(s)])},
        tree=tree, sentences=sentences, lidars=lidars, cameras=cameras, infos=infos,
        warnings=(*warnings, *said_of_recorder, *said_of_leaps, *said_of_steps, *_said_of_pauses(streams)),
    )  # fmt: skip


def _topics_of(bag: Bag, msgtypes: Iterable[str]) -> list[str]:
    """Return the topics with messages of some types."""
    kinds = set(msgtypes)
    return [t.topic for t in bag.topics.values() if kinds & set(t.msgtypes) and t.messages]


def _imu_of(streams: Sequence[TopicData]) -> TopicData | None:
    return next((s for s in streams if s.msgtype == IMU and len(s)), None)


def _steadily_recorded(streams: list[TopicData]) -> tuple[list[TopicData], list[str]]:
    """Return the streams with recording times at the pace of the stamps, and as if the recorder's clock had not been set.

    With a warning if they were not.
    """
    streams, said = _at_pace(streams)
    recorder = next((at for s in streams if (at := recorder_set(s.stamps_ns, s.logs_ns))), None)
    if recorder is None:
        return streams, said
    return [s.logged(steady_logs(s.stamps_ns, s.logs_ns)) for s in streams], [*said, recorder.said_of_recorder]


def _at_pace(streams: list[TopicData]) -> tuple[list[TopicData], list[str]]:
    """Return the streams with recording times at the pace of the stamps, as when the bag is read, and a warning."""
    imu = _imu_of(streams)
    stamped = [(s.stamps_ns, s.logs_ns) for s in streams if s.stamped_by_header and s is not imu]
    found = pace((imu.stamps_ns, imu.logs_ns), stamped) if imu and imu.stamped_by_header else None
    if found is None:
        return streams, []
    return [s.logged(found.of_stamps(s.logs_ns)) for s in streams], [found.said]


def _without_leaps(streams: list[TopicData]) -> tuple[list[TopicData], list[str]]:
    """Return the streams without the leaps of their clocks, as when the bag is read, and a warning for each topic."""
    imu = _imu_of(streams)
    if imu is None or leaps(imu.stamps_ns, imu.logs_ns):
        return streams, []
    latency_s = usual_latency_s(imu.stamps_ns, imu.logs_ns)
    right, lines = [], dict[str, str]()
    for stream in streams:
        topic = bare_topic(stream.topic)
        if not stream.recorded:
            stamps_ns, said = without_leaps(stream.stamps_ns, stream.logs_ns, latency_s, topic)
            if said:
                stream = stream.stamped(stamps_ns)
                lines.setdefault(topic, said)
        right.append(stream)
    return right, list(lines.values())


def _said_of_pauses(streams: Sequence[TopicData]) -> list[str]:
    """Return a warning if all streams pause at once."""
    imu = _imu_of(streams)
    if imu is None:
        return []
    said = pauses_warning(common_pauses(np.sort(imu.stamps_ns), (s.stamps_ns for s in streams if s is not imu)))
    return [said] if said else []


def _clock_steps(streams: Sequence[TopicData]) -> dict[str, ClockStep]:
    """Return by topic the step in which its clock was set during the run.

    Empty if all clocks were set alike: then they are one clock, and the step is only a gap.
    """
    stamped = [s for s in streams if len(s) >= FEWEST_STAMPS and not s.recorded and s.msgtype not in UNSTAMPED]
    steps: dict[str, ClockStep | None] = {}
    for stream in stamped:  # of several streams of a topic, some may have messages on one side of the step only
        topic = bare_topic(stream.topic)
        steps[topic] = steps.get(topic) or step(stream.stamps_ns, stream.logs_ns)
    found = {topic: at for topic, at in steps.items() if at is not None}
    sizes = [at.by_s for at in found.values()]
    if not found or (len(found) == len(steps) and max(sizes) - min(sizes) < GAIN_LIMIT_S):
        return {}
    return found


def _as_mostly_set(stream: TopicData, steps: Mapping[str, ClockStep]) -> TopicData:
    """Return the stream with the step of its clock removed: the side with more messages keeps its stamps.

    Otherwise the stream contradicts itself.
    """
    at = steps.get(bare_topic(stream.topic))
    if at is None or stream.recorded:
        return stream
    after = stream.logs_ns >= at.at_ns
    by_ns = round(at.by_s * NS_PER_S)
    return stream.stamped(stream.stamps_ns + np.where(after, 0, by_ns) - (0 if 2 * after.sum() > len(after) else by_ns))


def _pictures(bag: Bag) -> list[str]:
    """Return the topics of images and tag lists, without depth images.

    Of a camera with raw and compressed images, the compressed ones.
    """
    every = _topics_of(bag, (*IMAGES, *LISTS))
    return [t for t in every if f"{t}/compressed" not in every and "depth" not in t.lower()]


def _firsts_of(bag: Bag, topics: Sequence[str]) -> dict[str, FirstMessage]:
    """Return by topic what the header of its first readable message says, if it is among the first 200.

    Each topic is read separately: a topic without any readable message would otherwise cause all others to be unpacked
    to the end of the bag.
    """
    found: dict[str, FirstMessage] = {}
    for topic in topics:
        for raw in islice(bag.messages({topic}), _MOST_TRIED):
            try:
                msg: Any = bag.decode(raw)
                stamp_ns = header_stamp_ns(msg)
                latency_s = None if stamp_ns is None else seconds_between(stamp_ns, raw.log_ns)
                found[topic] = FirstMessage(str(msg.header.frame_id).lstrip("/"), latency_s)
                break
            except Exception:  # noqa: BLE001, S112 - damaged bytes make rosbags raise nearly anything; a later one will do
                continue
    return found
