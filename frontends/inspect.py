# SPDX-License-Identifier: Apache-2.0
"""`graphloc inspect`: what a bag holds, as a value, as text, and as a first `vessel.yaml`."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.config import STANDARD_GRAVITY_MPS2
from graphloc.frames import Array, wrap_angle
from graphloc.frontends._assess import (
    Turning,
    compass_report,
    courses_of,
    gnss_report,
    headings,
    on_one_clock,
    says_the_same,
    topic_report,
    track,
)
from graphloc.frontends._assess_imu import felt_of, imu_report, samples_of, turning_of
from graphloc.frontends._assess_velocity import motions_of, odometry_report, velocity_report
from graphloc.frontends._assess_world import world_of
from graphloc.frontends._clock import refuse_woven, usual_latency_s
from graphloc.frontends._draft import draft_config
from graphloc.frontends._inspect_text import render
from graphloc.frontends._lag import lag, lag_of_way
from graphloc.frontends._reports import (
    EAST_AXES,
    NORTH_AXES,
    CompassReport,
    GnssReport,
    ImuReport,
    Inspection,
    MountedTopic,
    MountGuess,
    OdometryReport,
    TopicReport,
    Vec,
    VelocityReport,
    filtered,
)
from graphloc.frontends._source import Bag, TopicSummary
from graphloc.frontends._streams import Stream, read_streams
from graphloc.frontends._tf import StaticTree
from graphloc.frontends._turns import SCATTERED, scattered, wander_deg
from graphloc.frontends._unused import unused_topics
from graphloc.frontends.aerial.cloud import CLOUD
from graphloc.frontends.decode import (
    GPS_FIXES,
    IMU,
    NAV_SAT_FIX,
    NUMBERS,
    ODOMETRY,
    PLAIN_POSE,
    PLAIN_TWIST,
    POSE,
    QUATERNION,
    TWIST,
    VECTOR,
)
from graphloc.frontends.tags.listed import LISTS
from graphloc.frontends.tags.sightings import IMAGES, INFO, camera_info_topic
from graphloc.frozen_receiver import frozen_fixes
from graphloc.measurements import CompassHeading, ImuSeries
from graphloc.time import NS_PER_S

__all__ = [
    "CompassReport",
    "GnssReport",
    "ImuReport",
    "Inspection",
    "MountGuess",
    "OdometryReport",
    "TopicReport",
    "VelocityReport",
    "draft_config",
    "inspect_bag",
    "render",
]

_FIXES = (NAV_SAT_FIX, *GPS_FIXES)
_MOST_TRIED = 200  # messages of a topic that cannot be decoded
_KNOWN = re.compile(r"(sensor|geometry|nav|tf2|std|diagnostic|rosgraph|rcl|visualization)_?\w*_?msgs?/|rcl_interfaces/")
_MOST_NAMED = 6
_SAME_WAY_S = 0.1  # within which messages of one device are recorded after their stamps
_COVERS = 0.8  # of the run, from which a receiver is there throughout


def inspect_bag(paths: Path | str | Sequence[Path | str]) -> Inspection:
    """Look at a whole bag.

    Args:
        paths: as for `read_recording`.

    Raises:
        InputError: the bag cannot be opened, or its parts lie over each other.
    """
    with Bag(paths) as bag:
        topics = bag.topics
        bag.refuse_set_back([t.topic for t in topics.values() if IMU in t.msgtypes])
        streams, tree = read_streams(bag)
        clouds = _frames_of(bag, [t.topic for t in topics.values() if CLOUD in t.msgtypes and t.messages])
        images = _frames_of(bag, _pictures(bag))
        source, warnings = bag.name, (*bag.warnings, *([tree.damage] if tree.damage else []))
    for stream in streams:
        if stream.msgtype == IMU:
            refuse_woven(stream.topic, stream.stamps_ns, stream.logs_ns, stream.tuples, stream.files)
    by_topic = {s.topic: s for s in streams}
    filled = on_one_clock([s for s in streams if len(s)])
    heard = {s.topic: s for s in filled}
    fixes = [s for s in filled if s.msgtype in _FIXES]
    poses = [s for s in filled if s.msgtype in (ODOMETRY, POSE, PLAIN_POSE)]
    body = tree.body()
    # The best first: what they say is what the others are judged by.
    found_gnss = [g for s in fixes if (g := gnss_report(by_topic[s.topic], _known(s, tree, body)))]
    longest_s = max((g.spans_s for g in found_gnss), default=0.0)
    found_gnss.sort(
        key=lambda g: (filtered(g.topic), g.slow_error or g.spans_s < _COVERS * longest_s, -g.fixes, g.without_height)
    )
    stamps, p_m, scatter_m, first = _best_track(heard, found_gnss)
    frame = found_gnss[0].tf_frame if found_gnss else None
    mount = tree.resolve(body, frame) if frame else None
    antenna = None if mount is None else mount[0]
    courses = courses_of(stamps, p_m, scatter_m) if found_gnss else None
    told = [(s, odometry_report(s, stamps, p_m, world_of(s, stamps, p_m, first, antenna), scatter_m)) for s in poses]
    twists = [
        (s, velocity_report(s, stamps, p_m, _known(s, tree, body), scatter_m))
        for s in filled
        if s.msgtype in (TWIST, PLAIN_TWIST, VECTOR)
    ]
    motions = motions_of([s for s, report in told if report.role == "check_speed"], twists, fixes)
    found_imus = [i for s in filled if s.msgtype == IMU and (i := imu_report(s, motions, courses, tree, body))]
    found_imus.sort(key=lambda i: (bool(i.missing), i.gravity == "removed", i.gyro_noise_mdps))
    turning = turning_of(heard[found_imus[0].topic], found_imus[0], tree, body) if found_imus else None
    felt = felt_of(heard[found_imus[0].topic], found_imus[0], tree, body) if found_imus else None
    late = {m.source: lag_of_way(felt, m) for m in motions} if felt else {}
    candidates = [s for s in filled if s.msgtype in (QUATERNION, IMU, *NUMBERS)]
    found_compasses = _without_echoes([(c, s) for s in candidates if (c := compass_report(s, courses, turning))])
    used = (
        {g.topic for g in found_gnss}
        | {i.topic for i in found_imus}
        | {c.topic for c, _ in found_compasses if c.usable}
    )
    return Inspection(
        source=source,
        topics=tuple(
            topic_report(by_topic[t.topic], t.messages)
            if t.topic in by_topic
            else TopicReport(topic=t.topic, msgtype=" or ".join(t.msgtypes), count=t.messages)
            for t in topics.values()
        )
        + tuple(topic_report(s, len(s)) for s in streams if s.topic not in topics),
        imus=tuple(found_imus),
        gnss=tuple(_late(g, late, twists, by_topic) for g in found_gnss),
        compasses=tuple(
            _asked_together(_timed(c, s, by_topic[s.topic], turning), s, [(i, heard[i.topic]) for i in found_imus])
            for c, s in found_compasses
        ),
        odometry=tuple(report for _, report in told),
        velocities=tuple(replace(report, late_s=late.get(report.topic)) for _, report in twists),
        lidars=_mounted(clouds, tree, body),
        cameras=tuple(
            replace(camera, listed=bool(set(LISTS) & set(topics[camera.topic].msgtypes)))
            for camera in _mounted(images, tree, body, {t.topic for t in topics.values() if INFO in t.msgtypes})
        ),
        tf_frames=tree.frames,
        body_frame=body,
        warnings=(
            *warnings,
            *(g.frozen for g in found_gnss if g.frozen),
            *unused_topics(streams, used),
            *_lacking(found_imus, found_gnss, [report for _, report in told], bool(clouds or images), topics, by_topic),
        ),
    )


def _lacking(
    imus: Sequence[ImuReport],
    gnss: Sequence[GnssReport],
    odometry: Sequence[OdometryReport],
    sees: bool,
    topics: Mapping[str, TopicSummary],
    read: Container[str],
) -> list[str]:
    """Say what no run can do without, and which topics are of no type that is read: it may be there."""
    lines = []
    if not any(not imu.missing for imu in imus):
        lines.append("no whole IMU in it: smooth, replay and compare need one")
    if not gnss and not sees and not any(report.role == "pose" for report in odometry):
        lines.append("nothing in it tells the place: no GNSS fix that can be used, no pose")
    others = [t for t in topics.values() if t.topic not in read and not _KNOWN.match(t.msgtypes[0])]
    if lines and others:
        named = ", ".join(f"{t.topic} ({' or '.join(t.msgtypes).replace('/msg/', '/')})" for t in others[:_MOST_NAMED])
        lines.append(f"of no type that is read here: {named}{', ...' if len(others) > _MOST_NAMED else ''}")
    return lines


def _without_echoes(compasses: Sequence[tuple[CompassReport, Stream]]) -> list[tuple[CompassReport, Stream]]:
    """The compasses, those that have no stamp last; of those that say what one before them says, what that is."""
    own: list[tuple[CompassReport, Stream]] = []
    found = []
    for report, stream in sorted(compasses, key=lambda pair: pair[1].msgtype in NUMBERS):
        for other, heard in own if report.usable else ():
            if says_the_same(heard, stream, mirrored=report.convention != other.convention):
                report = replace(report, like=other.topic)
                break
        else:
            own += [(report, stream)] if report.usable else []
        found.append((report, stream))
    return found


def _timed(report: CompassReport, stream: Stream, told: Stream, turning: Turning | None) -> CompassReport:
    """The report, with what the gyroscope says of the stamps, as they were told."""
    if turning is None or not report.usable:
        return report
    stamps, angle = headings(stream)
    found = lag(turning, stamps, angle if report.convention == "enu" else -angle)
    if found is None:
        return report
    value, sigma = found
    value += float(stream.stamps_ns[0] - told.stamps_ns[0]) / NS_PER_S
    return replace(report, why=f"{report.why}; by the gyro, time_offset_s should be {value:.3f} +- {sigma:.3f}")


def _asked_together(report: CompassReport, stream: Stream, imus: Sequence[tuple[ImuReport, Stream]]) -> CompassReport:
    """The report, with what the gyroscope of the best IMU says: how far it wanders, how many readings are none of a heading."""
    if not imus or not report.usable:
        return report
    imu, samples = imus[0]
    keep = samples_of(samples)[0]
    keep = keep[np.isfinite(samples.rows[keep, :6]).all(axis=1)]
    rows = samples.rows[keep]
    unit = STANDARD_GRAVITY_MPS2 if imu.accel_unit == "g" else 1.0
    series = ImuSeries(
        sensor=imu.topic,
        stamps_ns=samples.stamps_ns[keep],
        accel_mps2=rows[:, :3] * (-unit if imu.gravity == "inverted" else unit),
        gyro_radps=np.radians(rows[:, 3:6]) if imu.gyro_unit == "deg/s" else rows[:, 3:6],
        seqs=keep.astype(np.int64),
    )
    stamps, angle = headings(stream)
    yaw = angle if report.convention == "enu" else np.pi / 2.0 - angle
    said = [
        CompassHeading(stamp_ns=int(s), sensor=stream.topic, seq=0, yaw_rad=float(y), sigma_rad=1.0)
        for s, y in zip(stamps, wrap_angle(yaw), strict=True)
    ]
    report = replace(report, wander_deg=wander_deg(series, said))
    bad = int(scattered(series, said).sum())
    return replace(report, why=f"{report.why}; {bad} of {len(said)}: {SCATTERED}") if bad else report


def _late(
    gnss: GnssReport,
    late: Mapping[str, tuple[float, float] | None],
    twists: Sequence[tuple[Stream, VelocityReport]],
    by_topic: Mapping[str, Stream],
) -> GnssReport:
    """The report, with how late its stamps are: by its own places, or by a velocity over ground where that tells it better.

    A receiver measures both at once. One that is recorded at another time after its stamps is taken for another device.
    """
    told = {gnss.topic: late.get(gnss.topic)}
    fixes = by_topic[gnss.topic]
    way_s = usual_latency_s(fixes.stamps_ns, fixes.logs_ns)
    for stream, report in twists:
        own = by_topic[stream.topic]
        same = abs(usual_latency_s(own.stamps_ns, own.logs_ns) - way_s) < _SAME_WAY_S and own.recorded == fixes.recorded
        if report.axes in (EAST_AXES, NORTH_AXES) and same and not filtered(stream.topic):
            told[stream.topic] = late.get(stream.topic)
    known = {topic: found for topic, found in told.items() if found is not None}
    by = min(known, key=lambda topic: known[topic][1], default="")
    return replace(gnss, late_s=known.get(by), late_by=by)


def _mounted(
    frames: Mapping[str, str], tree: StaticTree, body: str, infos: Container[str] = ()
) -> tuple[MountedTopic, ...]:
    found = []
    for topic, frame in sorted(frames.items()):
        beside = camera_info_topic(topic)
        tf_frame = frame if tree.resolve(body, frame) else None
        info = beside if beside in infos else ""
        found.append(MountedTopic(topic=topic, frame_id=frame, tf_frame=tf_frame, info_topic=info))
    return tuple(found)


def _pictures(bag: Bag) -> list[str]:
    """Topics that tags may be seen in: of one camera the compressed images, where there are two kinds; no depth."""
    kinds = (*IMAGES, *LISTS)
    every = [t.topic for t in bag.topics.values() if set(kinds) & set(t.msgtypes) and t.messages]
    return [t for t in every if f"{t}/compressed" not in every and "depth" not in t.lower()]


def _frames_of(bag: Bag, topics: Sequence[str]) -> dict[str, str]:
    """The frame of the first readable message of each topic, if that is among the first 200.

    Each topic is read by itself, so that one without messages, or with none that is readable, does not unpack those of
    the others to the end of the bag.
    """
    found: dict[str, str] = {}
    for topic in topics:
        for raw in islice(bag.messages({topic}), _MOST_TRIED):
            try:
                msg: Any = bag.decode(raw)
                found[topic] = str(msg.header.frame_id)
                break
            except Exception:  # noqa: BLE001, S112 - damaged bytes make rosbags raise nearly anything; a later one will do
                continue
    return found


def _known(stream: Stream, tree: StaticTree, body: str) -> str | None:
    """Return the stream's frame where /tf_static leads to it from the body."""
    return stream.frame_id if tree.resolve(body, stream.frame_id) and stream.frame_id in tree.frames else None


def _best_track(
    by_topic: dict[str, Stream], gnss: Sequence[GnssReport]
) -> tuple[NDArray[np.int64], Array, float, Vec | None]:
    """Return stamps, places about the first fix (m), scatter (m) and first fix of the best receiver, without frozen fixes."""
    if not gnss:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), 1.0, None
    best = gnss[0]
    stamps, p, rows = track(by_topic[best.topic])
    good = ~frozen_fixes(stamps, rows[:, :2], p[:, :2])
    return stamps[good], p[good], max(best.scatter_m[:2]) if best.scatter_m else 1.0, best.first
