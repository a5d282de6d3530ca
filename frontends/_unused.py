# SPDX-License-Identifier: Apache-2.0
"""Warnings of `inspect`: sensors that a bag lacks, topics that are not used, with reasons, and shared topics."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Sequence

import numpy as np

from graphloc.frontends._assess import sane
from graphloc.frontends._assess_imu import samples_of
from graphloc.frontends._contents import Contents
from graphloc.frontends._reader import either
from graphloc.frontends._reports import GnssReport, ImuReport, OdometryReport, bare_topic
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.msgtypes import FIX_TYPES, IMU, NMEA, NUMBERS, QUATERNION, TWIST
from graphloc.frontends.source import TopicSummary

_KNOWN = re.compile(r"(sensor|geometry|nav|tf2|std|diagnostic|rosgraph|rcl|visualization)_?\w*_?msgs?/|rcl_interfaces/")
_MOST_NAMED = 6
_OF_A_SENSOR = (IMU, *FIX_TYPES, TWIST, QUATERNION)
_SHARE = 0.05  # least share of a topic's messages that name a frame for it to count
_MAGNETIC = "sensor_msgs/msg/MagneticField"
# Types of packets and clouds of makers, and of scans of a plane; then of lists of tags other than `LISTS`.
_LIDAR = re.compile(r"LaserScan|livox|velodyne|ouster|pandar|hesai|rslidar|robosense|lidar", re.IGNORECASE)
_TAGS = re.compile(r"april|aruco|fiducial|CompressedVideo|FFMPEGPacket|theora", re.IGNORECASE)
_SPEED = re.compile(r"speed|stw|sog|knots|kts|velocity|paddle|impeller|(?<![a-z])(kn|km_?h|kmph|mps)$", re.IGNORECASE)


def lacking(
    bag: Contents, imus: Sequence[ImuReport], gnss: Sequence[GnssReport], odometry: Sequence[OdometryReport]
) -> list[str]:
    """Return warnings on required sensors that are missing, and then on topics of unsupported types: maybe these."""
    poses = [report.topic for report in odometry if report.role == "pose"]
    placed = gnss or bag.cameras or any(report.grid for report in odometry)
    lines = []
    if poses and not placed:
        said = f"nothing but poses tells the place ({', '.join(poses)}), and the draft has them switched off"
        which = " of the one that is of this vessel" if len(poses) > 1 else ""
        lines.append(
            f"{said}: set enabled: true{which}, and datum: where their origin lies (any place will do for a track in their own frame)"
        )
    if all(imu.missing for imu in imus):
        lines.append("no whole IMU in it: smooth, replay and compare need one (sensor_msgs/Imu, 50 Hz or more)")
    if not poses and not placed:
        around = " (scans are matched around a track, which they cannot begin)" if bag.lidars else ""
        said = "nothing in it tells the place: no GNSS fix that can be used, no pose, no camera for tags"
        lines.append(f"{said}; smooth, replay and compare need one: record it, too{around}")
    return [*lines, *_of_other_types(bag)] if lines else []


def _of_other_types(bag: Contents) -> list[str]:
    """Return a warning on the topics of types that are neither read nor known for something else."""
    read = {
        *(bare_topic(name) for name in bag.streams),
        *bag.lidars,
        *bag.cameras,
    }  # of NMEA a stream is a sentence
    others = [
        f"{t.topic} ({' or '.join(t.msgtypes).replace('/msg/', '/')})"
        for t in bag.topics.values()
        if t.topic not in read and t.msgtypes[0] not in NMEA and not _KNOWN.match(t.msgtypes[0])
    ]
    more = ", ..." if len(others) > _MOST_NAMED else ""
    return [f"of no type that is read here: {', '.join(others[:_MOST_NAMED])}{more}"] if others else []


def unused_topics(streams: Sequence[TopicData], used: Container[str], messages: int) -> list[str]:
    """Return a line on each IMU and GNSS topic that is not used, with the reason: else it would seem to be missing.

    Args:
        messages: how many the bag holds, of any type.
    """
    lines = (
        []
        if any(len(s) or s.undecodable or s.no_stamp for s in streams)
        else ["the bag holds no message of a known type, or no sentence of NMEA that is read"]
        if messages
        else ["the bag holds no message at all"]
    )
    for stream in streams:
        if stream.topic in used or stream.msgtype not in (IMU, *FIX_TYPES):
            continue
        total = len(stream) + stream.undecodable + stream.no_stamp
        why = _why_unused(stream)
        lines.append(
            f"{stream.topic}: nothing of its {total} messages can be used: {why}"
            if total
            else f"{stream.topic}: not a message on it"
        )
    return lines


def shared_topics(streams: Sequence[TopicData]) -> list[str]:
    """Return a warning on each topic that several sensors share, by the frames that its messages name."""
    lines = {}
    for stream in streams:
        # Poses name the frame in which they are, not the sensor's.
        if stream.msgtype not in _OF_A_SENSOR:
            continue
        topic = bare_topic(stream.topic)
        said = {frame: n for frame, n in stream.frames.most_common() if frame and n > _SHARE * stream.frames.total()}
        if len(said) > 1:
            names = ", ".join(f"{frame} {n}" for frame, n in said.items())
            lines[topic] = (
                f"{topic}: its messages name several frames ({names}): they are of several sensors, and taken for those of one; let each driver "
                "write to a topic of its own"
            )
    return list(lines.values())


def unused_magnetometers(topics: Iterable[TopicSummary]) -> list[str]:
    """Return a line on each magnetometer of a bag without a compass: how it can become a compass."""
    return [
        f"{t.topic}: a magnetic field is not read, and nothing else tells the heading but the motion; a filter such as "
        "imu_filter_madgwick makes an orientation of it, which is read as a compass"
        for t in topics
        if _MAGNETIC in t.msgtypes and t.messages
    ]


def unread_lidars(topics: Iterable[TopicSummary]) -> list[str]:
    """Return a line on each topic with scans in an unread type, of a bag without readable scans."""
    return _unread(
        topics, _LIDAR, "scans are read as sensor_msgs/PointCloud2, which its driver, or a converter, makes of it"
    )


def unread_tags(topics: Iterable[TopicSummary]) -> list[str]:
    """Return a line on each topic with tags or video in an unread type, of a bag without images or known lists."""
    images = "tags are found in images (sensor_msgs/Image, CompressedImage)"
    return _unread(topics, _TAGS, f"{images}, or read as apriltag_msgs/AprilTagDetectionArray")


def _unread(topics: Iterable[TopicSummary], kinds: re.Pattern[str], how: str) -> list[str]:
    """Return a line on each topic whose type matches a pattern; `how`: in which form its content would be read."""
    return [
        f"{t.topic}: {either(t.msgtypes)} is not read; {how}"
        for t in topics
        if t.messages and any(kinds.search(kind) for kind in t.msgtypes)
    ]


def unused_numbers(topics: Iterable[TopicSummary]) -> list[str]:
    """Return a line on each topic of numbers that, by its name, may be a speed.

    The unit is not in the bag, so no sensor is drafted.
    """
    return [
        f"{t.topic}: its numbers look like a speed by their name; where it is one along the vessel, a sensor of kind body_velocity "
        "reads it (unit: m/s, km/h or knots; through: water for a speed log)"
        for t in topics
        if set(t.msgtypes) <= set(NUMBERS) and t.messages and _SPEED.search(t.topic)
    ]


def _why_unused(stream: TopicData) -> str:
    rows = stream.rows[sane(stream)] if len(stream) else np.zeros((0, 8))
    if stream.msgtype == IMU and len(rows) and not rows[:, :6].any():
        return "they hold neither accelerations nor rates, an orientation at most"
    if stream.msgtype == IMU and len(rows) and (frozen := samples_of(stream)[1]):
        return frozen[0].removeprefix(f"{stream.topic}: ")
    counts = {
        "cannot be decoded": stream.undecodable,
        "have no stamp": stream.no_stamp,
        "have a stamp that repeats, runs backwards or is far from the recording time": len(stream) - len(rows),
    }
    if stream.msgtype in FIX_TYPES:
        fix = rows[:, 3] >= 0
        beyond = int((fix & (np.abs(rows[:, 0]) > 90.0)).sum())
        placed = rows[~fix, :2]
        moves = bool(
            len(placed) > 1 and np.isfinite(placed).all() and placed.all() and np.ptp(placed, axis=0).min() > 0.0
        )
        though = ", though their places change: if the driver leaves the status out, `min_status: any` uses them"
        counts |= {
            f"say 'no fix'{though if moves else ''}": int((~fix).sum()),
            "have a latitude beyond 90 deg": beyond,
            "lie at 0, 0, are NaN or beyond 180 deg": int(fix.sum()) - beyond,
        }
    else:
        finite = int(np.isfinite(rows[:, :6]).all(axis=1).sum())
        broken = " or say that the IMU does not work" if stream.part else ""
        counts |= {f"hold an acceleration or a rate that is NaN{broken}": len(rows) - finite, "are too few": finite}
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count)
