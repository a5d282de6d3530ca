# SPDX-License-Identifier: Apache-2.0
"""`graphloc inspect`: what a bag holds, as a value, as text, and as a first `vessel.yaml`."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.config import GnssConfig
from graphloc.frames import Array, rotation_from_rpy_deg, rpy_from_rotation, wrap_angle
from graphloc.frontends._assess import (
    Courses,
    MeasuredMotion,
    courses_of,
    gnss_report,
    motion_of_places,
    sane,
    topic_report,
    track,
    vec,
)
from graphloc.frontends._assess_compass import compass_report, headings, says_the_same
from graphloc.frontends._assess_imu import felt_of, imu_report, series_of, turned_as_its_heading
from graphloc.frontends._assess_receivers import apart, apart_warning, height_wanders_m
from graphloc.frontends._assess_velocity import motion_of_poses, motions_of, odometry_report, velocity_report
from graphloc.frontends._assess_wander import changes, way_of
from graphloc.frontends._assess_world import in_map_grid, world_of
from graphloc.frontends._clock import usual_latency_s
from graphloc.frontends._contents import Contents, contents_of
from graphloc.frontends._draft import draft_config
from graphloc.frontends._inspect_text import render
from graphloc.frontends._reports import (
    EAST_AXES,
    FILTER,
    NORTH_AXES,
    CompassReport,
    GnssReport,
    ImuReport,
    Inspection,
    MountGuess,
    OdometryReport,
    TopicReport,
    Vec,
    VelocityReport,
    filtered,
)
from graphloc.frontends._scanners import cameras_of, lidars_of
from graphloc.frontends._streams import TopicData
from graphloc.frontends._tf import Pose
from graphloc.frontends._turns import SCATTERED, scattered, wander_deg
from graphloc.frontends._unused import unread_lidars, unread_tags, unused_magnetometers, unused_numbers, unused_topics
from graphloc.frontends.decode import (
    GPS_FIXES,
    IMU,
    NAV_SAT_FIX,
    NMEA,
    NUMBERS,
    PLAIN_TWIST,
    POSE_TYPES,
    QUATERNION,
    TWIST,
    VECTOR,
)
from graphloc.frontends.part import Bags
from graphloc.frontends.source import Bag
from graphloc.frontends.time_offsets import MotionOffset, heading_time_offset, later_than, motion_time_offset
from graphloc.frontends.turning import Turning
from graphloc.measurements import CompassHeading
from graphloc.signals.frozen_receiver import frozen_fixes
from graphloc.signals.white_noise import white_noise
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
_KNOWN = re.compile(r"(sensor|geometry|nav|tf2|std|diagnostic|rosgraph|rcl|visualization)_?\w*_?msgs?/|rcl_interfaces/")
_AS_NOISY = 1.5  # gyro noise, times that of the least noisy IMU, up to which one is as good
_DOWN = np.diag([1.0, -1.0, -1.0])  # to axes ahead, to port, up from such ahead, to starboard, down
_BELOW_M, _ALIKE = 0.05, 0.9  # antennas in tf, from which its z points down; cosine between axes taken for the same
_MOST_NAMED = 6
_FAR_BEYOND = 3.0  # times as far as another one's height wanders
_SAME_M = 0.05  # by which two topics of one receiver wander against each other at most
_SAME_WAY_S = 0.1  # within which messages of one device are recorded after their stamps
_FEWEST = 20  # places of a track
# Of the run, from which a receiver is there throughout; of the fixes, from which it says as much as another.
_COVERS = 0.8


_Late = Mapping[str, tuple[float, float] | None]  # by receiver, as `GnssReport.late_s`
_NONE: _Late = {}


class _Track(NamedTuple):
    """Track of the best receiver: stamps (N,), positions (N, 3) m about the first fix, their noise (m, 1 sigma), first fix."""

    stamps_ns: NDArray[np.int64]
    p_m: Array
    scatter_m: float
    first: Vec | None


def inspect_bag(bags: Bags | Bag) -> Inspection:
    """Inspect a bag.

    Receivers come first, since the other sensors are judged by the track of the best one.

    Args:
        bags: as for `read_recording`.

    Raises:
        InputError: the bag cannot be opened, or its parts overlap in time.
    """
    bag = contents_of(bags)
    tree, body = bag.tree, bag.tree.body()
    gnss = _gnss_reports(bag)
    reference = _best_track(bag, gnss)
    odometry = _odometry_reports(bag, gnss, reference)
    velocities = [
        (s, velocity_report(s, reference.stamps_ns, reference.p_m, bag.tf_pose(s), reference.scatter_m))
        for s in bag.of_type(TWIST, PLAIN_TWIST, VECTOR)
    ]
    wheels = [s for s, report in odometry if report.role == "check_speed"]
    rolling = [s for s, report in odometry if report.role == "check_speed" and not report.fused]
    motions = motions_of(wheels, velocities, bag.of_type(*_FIXES))
    if not gnss and (motion := motion_of_places("the poses in a map grid", reference.stamps_ns, reference.p_m)):
        motions.append(motion)
    if not gnss:
        motions += [m for s, report in odometry if report.role == "pose" and (m := motion_of_poses(s))]
    known = len(reference.stamps_ns) > 0
    courses = courses_of(reference.stamps_ns, reference.p_m, reference.scatter_m) if known else None
    imus = [report for s in bag.of_type(IMU) if (report := imu_report(s, motions, courses, tree, body))]
    imus = _best_first(imus)
    down = _looks_down(bag, imus, gnss)
    imus = [_in_turned_body(imu) for imu in imus] if down else imus
    felt = felt_of(bag.aligned[imus[0].topic], imus[0], tree, body) if imus else None
    compasses = _compass_reports(bag, imus, felt.turning if felt else None, courses)
    taken, imus = imus, [turned_as_its_heading(imu, compasses) for imu in imus]
    if imus and imus[0] is not taken[0]:
        felt = felt_of(bag.aligned[imus[0].topic], imus[0], tree, body)
    late = {motion.source: motion_time_offset(felt, motion) for motion in motions} if felt else {}
    used = {g.topic for g in gnss} | {i.topic for i in imus} | {c.topic for c in compasses if c.usable}
    reports = [report for _, report in odometry]
    doppler = {v.topic for _, v in velocities if v.axes in (EAST_AXES, NORTH_AXES) and not filtered(v.topic)}
    own = [motion for motion in motions if motion.source in doppler]
    timed = [_timed_fixes(report, late, motions, velocities, bag.streams) for report in gnss]
    together = {_receiver(report.topic): report.late_s for report in timed if report.late_s}
    if felt and any(c.late_s is None and _receiver(c.topic) in together for c in compasses):
        compasses = _compass_reports(bag, imus, felt.turning, courses, together)
    return Inspection(
        source=bag.source,
        topics=_topic_reports(bag),
        imus=tuple(imus),
        gnss=tuple(_beside_motion(report, bag, rolling, own) for report in timed),
        compasses=compasses,
        odometry=tuple(reports),
        velocities=tuple(_timed_velocity(report, late.get(report.topic), together) for _, report in velocities),
        lidars=lidars_of(bag),
        cameras=cameras_of(bag),
        tf_frames=tree.frames,
        body_frame=body,
        in_body={frame: _turned(pose) for frame in tree.frames if (pose := tree.resolve(body, frame))} if down else {},
        warnings=(
            *bag.warnings,
            *(said for report in gnss for said in (report.stored, report.frozen, report.in_radians) if said),
            *(apart_warning(report) for report in gnss[:1] if report.differs),
            *unused_topics(list(bag.streams.values()), used, sum(t.messages for t in bag.topics.values())),
            *_lacking(bag, imus, gnss, reports),
            *([] if bag.lidars else unread_lidars(bag.topics.values())),
            *([] if bag.cameras else unread_tags(bag.topics.values())),
            *unused_numbers(t for t in bag.topics.values() if t.topic not in bag.streams),
            *([] if any(c.usable for c in compasses) else unused_magnetometers(bag.topics.values())),
        ),
    )


def _topic_reports(bag: Contents) -> tuple[TopicReport, ...]:
    """Report every topic of the bag, then every NMEA sentence."""
    streams = {name.removesuffix(FILTER): stream for name, stream in bag.streams.items()}
    topics = [
        replace(topic_report(streams[t.topic], t.messages), topic=t.topic, msgtype=t.msgtypes[0])
        if t.topic in streams
        else TopicReport(
            topic=t.topic,
            msgtype=" or ".join(t.msgtypes),
            count=t.messages,
            unread=dict(bag.sentences.unread.get(t.topic, Counter()).most_common()),
        )
        for t in bag.topics.values()
    ]
    sentences = (
        replace(topic_report(s, len(s)), after_s=bag.sentences.spread_s(name))
        for name, s in streams.items()
        if name not in bag.topics
    )
    return (*topics, *sentences)


def _gnss_reports(bag: Contents) -> list[GnssReport]:
    """Report the receivers, the best one first."""
    found = [r for s in bag.of_type(*_FIXES) if (r := gnss_report(bag.streams[s.topic], bag.tf_frame(s)))]
    longest_s = max((r.spans_s for r in found), default=0.0)
    rivals = [r for r in found if r.spans_s >= _COVERS * longest_s and not filtered(r.topic)]
    most = max((r.fixes for r in rivals), default=0)
    level_m = min((m for r in rivals if (m := height_wanders_m(r)) is not None), default=0.0)
    heights_m = {_receiver(r.topic): m for r in found if (m := height_wanders_m(r)) is not None}
    claimed = any(r.reported_sigma_m for r in rivals)
    found.sort(
        key=lambda r: (
            filtered(r.topic),
            r.spans_s < _COVERS * longest_s,
            r.slow_error,
            _octave(r, heights_m.get(_receiver(r.topic)), level_m if r in rivals else math.inf, claimed=claimed),
            r.fixes < _COVERS * most,
            r.without_height == r.fixes,
            -r.fixes,
            r.without_height,
        )
    )
    return [_beside_others(report, rivals, bag) for report in found]


def _receiver(topic: str) -> str:
    """Return the receiver of a stream: its topic; of NMEA the talker on it, whose sentences tell one position, with a height or without."""
    name, _, sentence = topic.partition(" ")
    return name if sentence[:1] in ("", "(") else f"{name} {sentence[:2]}"


def _octave(gnss: GnssReport, wanders_m: float | None, level_m: float, *, claimed: bool) -> int:
    """Return how large the fixes' error is by what they claim, or scatter or drift by, in powers of two: closer ones are taken for equal.

    Args:
        wanders_m: by how much the receiver's height wanders, 1 sigma; None where it tells none.
        level_m: by how much the heights of that receiver wander whose heights wander least, 1 sigma. All ride on one craft: what others
            wander by far beyond it is their drift, and the horizontal one is half of the vertical. Up to that it may be hills, which
            receivers smooth.
        claimed: whether one of the receivers claims anything; where none does, their heights alone compare them.
    """
    drift_m = 0.5 * wanders_m if wanders_m is not None and wanders_m > _FAR_BEYOND * level_m else 0.0
    if gnss.reported_sigma_m:
        taken_m = max(gnss.reported_sigma_m[:2])
    elif gnss.rtk_sigma_m:
        taken_m = gnss.rtk_sigma_m[0]
    elif claimed or wanders_m is None:
        taken_m = GnssConfig().default_horizontal_sigma_m
    else:
        taken_m = 0.5 * wanders_m
    return round(math.log2(max(taken_m, *(gnss.scatter_m or ())[:2], drift_m, 1e-3)))


def _beside_others(gnss: GnssReport, rivals: Sequence[GnssReport], bag: Contents) -> GnssReport:
    """Return the report with by how much it and the other receiver that it agrees with best wander against each other, and how far off others sit."""
    beside = {
        other.topic: found
        for other in rivals
        if other.topic != gnss.topic
        and (found := apart(gnss, other, bag.aligned[gnss.topic], bag.aligned[other.topic])) is not None
    }
    gnss = replace(gnss, keeps_m=max((found.keeps_m for found in beside.values()), default=0.0))
    wander = {topic: found.wander_m for topic, found in beside.items() if found.wander_m > _SAME_M}
    nearest = min(wander, key=lambda topic: wander[topic], default="")
    return replace(gnss, apart_m=wander[nearest], apart_from=nearest) if nearest else gnss


def _odometry_reports(
    bag: Contents, gnss: Sequence[GnssReport], reference: _Track
) -> list[tuple[TopicData, OdometryReport]]:
    frame = gnss[0].tf_frame if gnss else None
    mount = bag.tree.resolve(bag.tree.body(), frame) if frame else None
    antenna_m = None if mount is None else mount[0]
    found = []
    for stream in bag.of_type(*POSE_TYPES):
        world = world_of(stream, reference.stamps_ns, reference.p_m, reference.first, antenna_m)
        found.append((stream, odometry_report(stream, reference.stamps_ns, reference.p_m, world, reference.scatter_m)))
    return found


def _compass_reports(
    bag: Contents, imus: Sequence[ImuReport], turning: Turning | None, courses: Courses | None, together: _Late = _NONE
) -> tuple[CompassReport, ...]:
    """Report every orientation that may be a heading, by how the best IMU turned; see `_without_echoes` for their order.

    Args:
        together: how late the stamps of a receiver's fixes are, by receiver.
    """
    candidates = bag.of_type(QUATERNION, IMU, *NUMBERS)
    timed = (_timed_compass(s, courses, turning, together.get(_receiver(s.topic))) for s in candidates)
    found = _without_echoes([pair for pair in timed if pair])
    best = (imus[0], bag.aligned[imus[0].topic]) if imus else None
    return tuple(_beside_gyro(report, stream, best) for report, stream in found)


def _timed_compass(
    stream: TopicData, courses: Courses | None, turning: Turning | None, fixes_late_s: tuple[float, float] | None
) -> tuple[CompassReport, TopicData] | None:
    """Report an orientation, its stamps corrected by what the gyroscope shows, and return it so; None where it is no heading.

    Where that shows nothing, by how late the fixes of the same messages are, unless the gyroscope then denies it.
    """
    report = compass_report(stream, courses, turning)
    if report is None or turning is None or not report.usable:
        return None if report is None else (report, stream)
    stamps, angle = headings(stream)
    angle = angle if report.convention == "enu" else -angle
    own_s = heading_time_offset(turning, stamps, angle)
    late_s = own_s or fixes_late_s
    if late_s is None:
        return report, stream
    by_ns = round(late_s[0] * NS_PER_S)
    if own_s is None and heading_time_offset(turning, stamps + by_ns, angle) is not None:
        return report, stream
    timed = stream.later(by_ns)
    again = compass_report(timed, courses, turning)
    if again is None or not again.usable:
        return report, stream
    return replace(again, late_s=late_s, late_with_fixes=own_s is None), timed


def _timed_velocity(report: VelocityReport, late: MotionOffset | None, together: _Late) -> VelocityReport:
    """Return the report with how late its stamps are: by its motion; where that is not clear, by the fixes of the same messages, unless it denies them."""
    fixes_late_s = together.get(_receiver(report.topic))
    if _clearly(late) or fixes_late_s is None or (late and late.denies(MotionOffset(*fixes_late_s, clear=True))):
        return replace(report, late_s=_clearly(late))
    return replace(report, late_s=fixes_late_s, late_with_fixes=True)


def _best_first(imus: Sequence[ImuReport]) -> list[ImuReport]:
    """Return whole IMUs with gravity in them first, the least noisy ones first; of those about as noisy, one whose mount tf or the motion tells."""

    def kind(imu: ImuReport) -> tuple[bool, bool]:
        return bool(imu.missing), imu.gravity == "removed"

    def key(imu: ImuReport) -> tuple[object, ...]:
        least = min(other.gyro_noise_mdps for other in imus if kind(other) == kind(imu))
        noisy = imu.gyro_noise_mdps > _AS_NOISY * least
        unplaced = imu.mount.tf_frame is None and imu.mount.xyz_m is None
        return kind(imu), noisy, unplaced, not imu.mount.yaw_told, imu.gyro_noise_mdps

    return sorted(imus, key=key)


def _lacking(
    bag: Contents, imus: Sequence[ImuReport], gnss: Sequence[GnssReport], odometry: Sequence[OdometryReport]
) -> list[str]:
    """Say which required sensors are missing, and then also which topics have an unsupported type: they may be it."""
    lines = []
    poses = [report.topic for report in odometry if report.role == "pose"]
    if poses and not (gnss or bag.cameras or any(report.grid for report in odometry)):
        said = f"nothing but poses tells the place ({', '.join(poses)}), and the draft has them switched off"
        lines.append(
            f"{said}: set enabled: true{' of the one that is of this vessel' if len(poses) > 1 else ''}, and datum: where their origin lies (any place will do for a track in their own frame)"
        )
    if not any(not imu.missing for imu in imus):
        lines.append("no whole IMU in it: smooth, replay and compare need one (sensor_msgs/Imu, 50 Hz or more)")
    if not (gnss or bag.cameras or any(report.role == "pose" or report.grid for report in odometry)):
        around = " (scans are matched around a track, which they cannot begin)" if bag.lidars else ""
        said = "nothing in it tells the place: no GNSS fix that can be used, no pose, no camera for tags"
        lines.append(f"{said}; smooth, replay and compare need one: record it, too{around}")
    read = {
        *(name.partition(" ")[0] for name in bag.streams),
        *bag.lidars,
        *bag.cameras,
    }  # of NMEA a stream is a sentence
    others = [
        t
        for t in bag.topics.values()
        if t.topic not in read and t.msgtypes[0] not in NMEA and not _KNOWN.match(t.msgtypes[0])
    ]
    if lines and others:
        named = ", ".join(f"{t.topic} ({' or '.join(t.msgtypes).replace('/msg/', '/')})" for t in others[:_MOST_NAMED])
        lines.append(f"of no type that is read here: {named}{', ...' if len(others) > _MOST_NAMED else ''}")
    return lines


def _without_echoes(compasses: Sequence[tuple[CompassReport, TopicData]]) -> list[tuple[CompassReport, TopicData]]:
    """Return the compasses, those of types without a stamp, and of filters, last; one that repeats another names it in `like`."""
    distinct: list[tuple[CompassReport, TopicData]] = []
    found = []
    for report, stream in sorted(compasses, key=lambda pair: (filtered(pair[0].topic), pair[1].msgtype in NUMBERS)):
        for other, other_stream in distinct if report.usable else ():
            if says_the_same(other_stream, stream, mirrored=report.convention != other.convention):
                report = replace(report, like=other.topic)
                break
        else:
            distinct += [(report, stream)] if report.usable else []
        found.append((report, stream))
    return found


def _beside_gyro(report: CompassReport, stream: TopicData, best: tuple[ImuReport, TopicData] | None) -> CompassReport:
    """Add the wander and the number of scattered headings, both relative to the gyroscope of the best IMU."""
    if best is None or not report.usable:
        return report
    imu, samples = best
    series = series_of(samples, imu)
    stamps, angle = headings(stream)
    yaw = angle if report.convention == "enu" else np.pi / 2.0 - angle
    measured = [
        CompassHeading(stamp_ns=int(s), sensor=stream.topic, seq=0, yaw_rad=float(y), sigma_rad=1.0)
        for s, y in zip(stamps, wrap_angle(yaw), strict=True)
    ]
    report = replace(report, wander_deg=wander_deg(series, measured))
    bad = int(scattered(series, measured).sum())
    return replace(report, why=f"{report.why}; {bad} of {len(measured)}: {SCATTERED}") if bad else report


def _timed_fixes(
    gnss: GnssReport,
    late: Mapping[str, MotionOffset | None],
    motions: Sequence[MeasuredMotion],
    velocities: Sequence[tuple[TopicData, VelocityReport]],
    streams: Mapping[str, TopicData],
) -> GnssReport:
    """Return the report with how late the fixes' stamps are: by the fixes, or by a velocity over ground that tells it better.

    A receiver measures both at once. One that is recorded at another time after its stamps is taken for another device. Plotters
    average course and speed over seconds, and not the place: a velocity that shows the same motion later than the fixes tells nothing of
    them.
    """
    by_topic = {motion.source: motion for motion in motions}
    own_late = late.get(gnss.topic)
    candidates = {gnss.topic: own_late}
    fixes = streams[gnss.topic]
    latency_s = usual_latency_s(fixes.stamps_ns, fixes.logs_ns)
    for stream, report in velocities:
        own = streams[stream.topic]
        same = (
            abs(usual_latency_s(own.stamps_ns, own.logs_ns) - latency_s) < _SAME_WAY_S
            and own.recorded == fixes.recorded
        )
        if report.axes in (EAST_AXES, NORTH_AXES) and same and not filtered(stream.topic):
            said = late.get(stream.topic)
            denied = own_late is not None and said is not None and own_late.denies(said)
            if said and not denied and said.is_of(by_topic.get(gnss.topic), by_topic[stream.topic]):
                candidates[stream.topic] = said
    known = {topic: found for topic, found in candidates.items() if found is not None and found.clear}
    by = min(known, key=lambda topic: known[topic].sigma_s, default="")
    hinted = own_late if own_late is not None and own_late.hinted and not known else None
    return replace(
        gnss, late_s=_clearly(known.get(by)), late_by=by, hinted_s=(hinted.value_s, hinted.sigma_s) if hinted else None
    )


def _beside_motion(
    gnss: GnssReport, bag: Contents, wheels: Sequence[TopicData], velocities: Sequence[MeasuredMotion]
) -> GnssReport:
    """Return the report with how fast the fixes' error changes, by the first wheels, or velocity, that is no filter's output.

    A receiver's velocity is by Doppler, on which multipath has little effect.
    """
    rolled = way_of(wheels[0]) if wheels else None
    stamps, p_m, _ = track(bag.aligned[gnss.topic])
    scatter_m = max(gnss.scatter_m[:2]) if gnss.scatter_m else 0.0
    fixes = motion_of_places(gnss.topic, stamps, p_m)
    known = [(rolled, "the wheels")] if rolled else []
    if rolled is None and fixes is not None:
        known = [(_at_the_time_of(fixes, m), m.source) for m in velocities]
    for motion, name in known:
        if wander := changes(motion, stamps, p_m, scatter_m, turned=motion is rolled):
            return replace(gnss, wander=wander, wander_by=name)
    return gnss


def _at_the_time_of(fixes: MeasuredMotion, velocity: MeasuredMotion) -> MeasuredMotion:
    """Return a velocity's motion with what it shows later than the fixes taken off its times: else braking looks like an error of these."""
    later = later_than(fixes, velocity)
    return replace(velocity, t_s=velocity.t_s - later[0]) if later else velocity


def _clearly(offset: MotionOffset | None) -> tuple[float, float] | None:
    """Return an offset that is clear, s, and its sigma."""
    return (offset.value_s, offset.sigma_s) if offset is not None and offset.clear else None


def _looks_down(bag: Contents, imus: Sequence[ImuReport], gnss: Sequence[GnssReport]) -> bool:
    """Return whether the body of tf has its axes ahead, to starboard, down, as makers of INSs have: x and z of the IMU and the antennas say so.

    A driver with such axes of its own, under the frame of a URDF, has its antennas above.
    """
    if not imus or imus[0].mount.tf_frame is not None or imus[0].mount.xyz_m is None:
        return False
    own = bag.aligned[imus[0].topic]
    pose = bag.tf_pose(own)
    # What an INS says of its own place is no antenna.
    antennas = {g.tf_frame for g in gnss if g.tf_frame not in (None, own.frame_id) and not filtered(g.topic)}
    places = [mount[0] for frame in antennas if frame and (mount := bag.tree.resolve(bag.tree.body(), frame))]
    if pose is None or pose[0][2] > 0.0 or not places or any(place[2] > -_BELOW_M for place in places):
        return False
    turn = rotation_from_rpy_deg(np.array(imus[0].mount.rpy_deg)) @ pose[1].T
    return float(np.diagonal(turn @ _DOWN).min()) > _ALIKE


def _turned(pose: Pose) -> tuple[Vec, Vec]:
    """Return a place (m) and rpy (deg) ahead, to port, up of a pose in axes ahead, to starboard, down."""
    return vec(_DOWN @ pose[0]), vec(np.degrees(rpy_from_rotation(_DOWN @ pose[1])))


def _in_turned_body(imu: ImuReport) -> ImuReport:
    """Return the report with the place of the IMU ahead, to port, up; `_draft` turns what is drafted from tf."""
    xyz_m = imu.mount.xyz_m
    return imu if xyz_m is None else replace(imu, mount=replace(imu.mount, xyz_m=vec(_DOWN @ np.array(xyz_m) + 0.0)))


def _best_track(bag: Contents, gnss: Sequence[GnssReport]) -> _Track:
    """Return the track of the first receiver, without frozen fixes; without one, that of poses in a map grid; else an empty one."""
    if not gnss:
        return _grid_track(bag)
    best = gnss[0]
    stamps_ns, p_m, rows = track(bag.aligned[best.topic])
    good = ~frozen_fixes(stamps_ns, rows[:, :2], p_m[:, :2])
    return _Track(stamps_ns[good], p_m[good], max(best.scatter_m[:2]) if best.scatter_m else 1.0, best.first)


def _grid_track(bag: Contents) -> _Track:
    """Return the first track in a map grid, about its first position; the grid's north is off by a few degrees."""
    for stream in bag.of_type(*POSE_TYPES):
        keep = sane(stream)
        p_m = stream.rows[keep, :3]
        good = np.isfinite(p_m).all(axis=1)
        if in_map_grid(stream) and good.sum() > _FEWEST:
            p_m = p_m[good] - p_m[good][0]
            return _Track(stream.stamps_ns[keep][good], p_m, float(white_noise(p_m)[:2].max()), None)
    return _Track(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), 1.0, None)
