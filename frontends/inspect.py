# SPDX-License-Identifier: Apache-2.0
"""`graphloc inspect`: what a bag holds, as a value, as text, and as a first `vessel.yaml`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from graphloc.frames import rotation_from_rpy_deg, rpy_from_rotation
from graphloc.frontends._assess import (
    NO_TRACK,
    MeasuredMotion,
    ReferenceTrack,
    courses_of,
    mostly_one_way,
    motion_of_places,
    sane,
    topic_report,
    track,
    vec,
)
from graphloc.frontends._assess_imu import (
    Inertial,
    feels_motion,
    imu_report,
    inertial_of,
    turned_as_headed,
    turned_as_set,
    yaws_of,
)
from graphloc.frontends._assess_mount import ImuEvidence, turned_as_its_heading
from graphloc.frontends._assess_receivers import TWO_CRAFT_M, apart_warning
from graphloc.frontends._assess_velocity import motion_of_poses, motions_of, odometry_report, velocity_report
from graphloc.frontends._assess_world import in_map_grid, world_of
from graphloc.frontends._compasses import by_quarters, compasses_of, headed, set_sideways, with_own_north
from graphloc.frontends._contents import Contents, contents_of
from graphloc.frontends._draft import draft_config
from graphloc.frontends._inspect_text import render
from graphloc.frontends._log_sides import with_side
from graphloc.frontends._receivers import receiver_of, receivers_of, timed_fixes, timed_velocity, with_wander
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
from graphloc.frontends._tf import Pose
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends._unused import (
    lacking,
    shared_topics,
    unread_lidars,
    unread_tags,
    unused_magnetometers,
    unused_numbers,
    unused_topics,
)
from graphloc.frontends.msgtypes import FIX_TYPES, IMU, PLAIN_TWIST, POSE_TYPES, TWIST, VECTOR
from graphloc.frontends.part import Bags
from graphloc.frontends.source import Bag
from graphloc.frontends.time_offsets import motion_time_offsets
from graphloc.signals.frozen_receiver import frozen_fixes
from graphloc.signals.white_noise import white_noise

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

_AS_NOISY = 1.5  # an IMU is as good as the least noisy one up to so many times its gyro noise
_DOWN = np.diag([1.0, -1.0, -1.0])  # from axes ahead, to starboard, down to axes ahead, to port, up
# Antennas so far below the body in tf say that its z points down; axes with a larger cosine between them are the same.
_BELOW_M, _ALIKE = 0.05, 0.9
_FEWEST = 20  # more places than this make a track
_STAYS = 0.05  # a receiver that roams over less than this share of another one's extent stays where it is


def inspect_bag(bags: Bags | Bag) -> Inspection:
    """Inspect a bag.

    Receivers come first, since the other sensors are judged by the track of the best one. Then come the other topics
    that tell the motion; IMUs, by the motion; headings, by the gyroscope of the best IMU; and how late stamps are, by
    what the best IMU feels.

    Args:
        bags: see `read_recording`.

    Raises:
        InputError: the bag cannot be opened, or its parts overlap in time.
    """
    bag = contents_of(bags)
    gnss = receivers_of(bag)
    if elsewhere := _elsewhere(bag, gnss):
        gnss = receivers_of(bag, elsewhere)
    reference = _best_track(bag, gnss)
    odometry = _odometry_reports(bag, gnss, reference)
    velocities = _velocity_reports(bag, reference)
    motions = _motions(bag, reference, odometry, velocities)
    courses = courses_of(reference) if len(reference.stamps_ns) else None
    posed = {s.topic: yaws for s in bag.of_type(*POSE_TYPES) if (yaws := yaws_of(s.stamps_ns, s.rows[:, 3:7]))}
    evidence = ImuEvidence(motions, courses, bag.tree, posed)
    imus, in_body = _in_axes_up(bag, gnss, _imu_reports(bag, evidence))
    best = _best_imu(bag, imus, evidence)
    compasses = compasses_of(bag, courses, best, imus)
    ranked, compasses = _beside_headings(bag, imus, evidence, compasses)
    turned = [turned_as_its_heading(imu, compasses) for imu in ranked]
    if turned and turned[0] is not imus[0]:
        best = _best_imu(bag, turned, evidence)
    velocities = [(s, with_side(report, s, best.felt if best else None)) for s, report in velocities]
    late = motion_time_offsets(best.felt, bag.aligned[imus[0].topic], motions, bag.aligned) if best else {}
    timed = [timed_fixes(report, late, motions, velocities, bag.streams) for report in gnss]
    together = {receiver_of(report.topic): report.late_s for report in timed if report.late_s}
    if any(c.late_s is None and receiver_of(c.topic) in together for c in compasses):
        compasses = compasses_of(bag, courses, best, imus, together)
    reports = [report for _, report in odometry]
    return Inspection(
        source=bag.source,
        topics=_topic_reports(bag),
        imus=tuple(turned),
        gnss=_with_wander(bag, timed, odometry, velocities, motions),
        compasses=tuple(with_own_north(compass, turned) for compass in compasses),
        odometry=tuple(reports),
        velocities=tuple(timed_velocity(report, late.get(report.topic), together) for _, report in velocities),
        lidars=lidars_of(bag),
        cameras=cameras_of(bag),
        tf_frames=bag.tree.frames,
        body_frame=bag.tree.body(),
        in_body=in_body,
        warnings=(*bag.warnings, *_warnings(bag, gnss, turned, compasses, reports)),
    )


def _elsewhere(bag: Contents, gnss: Sequence[GnssReport]) -> dict[str, str]:
    """Return by topic why receivers are not of this craft.

    Such a receiver is far from another one, or stays where it is; the best IMU does not feel the motion of its fixes,
    but feels that of another receiver.
    """
    farthest_m = max((report.roams_m for report in gnss if not filtered(report.topic)), default=0.0)

    def stays(report: GnssReport) -> bool:
        return report.roams_m < _STAYS * farthest_m and farthest_m >= TWO_CRAFT_M

    if not gnss or not (gnss[0].apart_m >= TWO_CRAFT_M or stays(gnss[0])):
        return {}
    motions = motions_of((), (), bag.of_type(*FIX_TYPES))
    imus = _imu_reports(bag, ImuEvidence(motions, None, bag.tree))

    def felt(report: GnssReport) -> bool:
        reference = _best_track(bag, [report])
        own = [motion for motion in motions if motion.source == report.topic]
        evidence = ImuEvidence(own, courses_of(reference) if len(reference.stamps_ns) else None, bag.tree)
        return bool(imus) and feels_motion(bag.aligned[imus[0].topic], imus[0], evidence)

    unfelt = {report.topic for report in gnss if not felt(report)}
    # A filter's output is made from the IMU, so it moves as the IMU feels, and proves nothing.
    aboard = next((report for report in gnss if report.topic not in unfelt and not filtered(report.topic)), None)
    if aboard is None or aboard is gnss[0]:
        return {}
    why = f"{imus[0].topic} feels how {aboard.topic} moves, and nothing of how this one does: of another craft"
    base = f"while {aboard.topic} goes {aboard.roams_m:.0f} m, as {imus[0].topic} feels: a base station ashore, or a receiver that hangs"
    return {
        report.topic: f"it stays within {report.roams_m:.2f} m {base}" if stays(report) else why
        for report in gnss
        if report.topic in unfelt and (report.apart_m >= TWO_CRAFT_M or stays(report))
    }


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


def _best_track(bag: Contents, gnss: Sequence[GnssReport]) -> ReferenceTrack:
    """Return the track of the first receiver, without frozen fixes.

    Without a receiver it is the track of poses in a map grid; without these, an empty one.
    """
    if not gnss:
        return _grid_track(bag)
    best = gnss[0]
    stamps_ns, p_m, rows = track(bag.aligned[best.topic])
    good = ~frozen_fixes(stamps_ns, rows[:, :2], p_m[:, :2])
    return ReferenceTrack(stamps_ns[good], p_m[good], max(best.scatter_m[:2]) if best.scatter_m else 1.0, best.first)


def _grid_track(bag: Contents) -> ReferenceTrack:
    """Return the track of the first poses in a map grid, about their first position.

    The grid's north is off true north by up to a few degrees.
    """
    for stream in bag.of_type(*POSE_TYPES):
        keep = sane(stream)
        p_m = stream.rows[keep, :3]
        good = np.isfinite(p_m).all(axis=1)
        if in_map_grid(stream) and good.sum() > _FEWEST:
            p_m = p_m[good] - p_m[good][0]
            return ReferenceTrack(stream.stamps_ns[keep][good], p_m, float(white_noise(p_m)[:2].max()))
    return NO_TRACK


def _odometry_reports(
    bag: Contents, gnss: Sequence[GnssReport], reference: ReferenceTrack
) -> list[tuple[TopicData, OdometryReport]]:
    """Report odometry and poses, judged by the reference track and the place of its antenna in tf."""
    frame = gnss[0].tf_frame if gnss else None
    mount = bag.tree.resolve(bag.tree.body(), frame) if frame else None
    antenna_m = None if mount is None else mount[0]
    found = []
    for stream in bag.of_type(*POSE_TYPES):
        world = world_of(stream, reference, antenna_m)
        found.append((stream, odometry_report(stream, reference, world)))
    return found


def _velocity_reports(bag: Contents, reference: ReferenceTrack) -> list[tuple[TopicData, VelocityReport]]:
    return [(s, velocity_report(s, reference, bag.tf_pose(s))) for s in bag.of_type(TWIST, PLAIN_TWIST, VECTOR)]


def _motions(
    bag: Contents,
    reference: ReferenceTrack,
    odometry: Sequence[tuple[TopicData, OdometryReport]],
    velocities: Sequence[tuple[TopicData, VelocityReport]],
) -> list[MeasuredMotion]:
    """Return how the craft moved, by each topic that tells it, the most accurate first.

    Poses are asked only where there is no receiver.
    """
    wheels = [s for s, report in odometry if report.role == "check_speed"]
    motions = motions_of(wheels, velocities, bag.of_type(*FIX_TYPES))
    if reference.first is not None:
        return motions
    in_grid = motion_of_places("the poses in a map grid", reference.stamps_ns, reference.p_m)
    posed = [motion_of_poses(s) for s, report in odometry if report.role == "pose"]
    return motions + [motion for motion in (in_grid, *posed) if motion]


def _imu_reports(bag: Contents, evidence: ImuEvidence) -> list[ImuReport]:
    """Return the reports on the IMUs, the best one first.

    An IMU is better, in this order of importance, if it has rates and accelerations; has gravity in these; feels how
    the craft moves (one that does not turns on its own, as in a stabilised camera); is about as quiet as the quietest
    of its kind so far; has a mount in tf; has a mount whose yaw is known; has less gyro noise.
    """
    imus = [report for s in bag.of_type(IMU) if (report := imu_report(s, evidence))]
    moved = {imu.topic for imu in imus if len(imus) > 1 and feels_motion(bag.aligned[imu.topic], imu, evidence)}

    def kind(imu: ImuReport) -> tuple[bool, bool, bool]:
        return bool(imu.missing), imu.gravity == "removed", imu.topic not in moved

    def key(imu: ImuReport) -> tuple[object, ...]:
        least = min(other.gyro_noise_mdps for other in imus if kind(other) == kind(imu))
        noisy = imu.gyro_noise_mdps > _AS_NOISY * least
        unplaced = imu.mount.tf_frame is None and imu.mount.xyz_m is None
        return kind(imu), noisy, unplaced, not imu.mount.yaw_told, imu.gyro_noise_mdps

    return sorted(imus, key=key)


def _best_imu(bag: Contents, imus: Sequence[ImuReport], evidence: ImuEvidence) -> Inertial | None:
    return inertial_of(bag.aligned[imus[0].topic], imus[0], evidence) if imus else None


def _beside_headings(
    bag: Contents, imus: Sequence[ImuReport], evidence: ImuEvidence, compasses: tuple[CompassReport, ...]
) -> tuple[list[ImuReport], tuple[CompassReport, ...]]:
    """Return the reports with mounts turned by the motion that a compass tells, see `turned_as_headed`, `turned_as_set`.

    The compass is the first usable one that is no IMU's own orientation.
    """

    def moved(compass: CompassReport) -> list[MeasuredMotion]:
        told = (headed(motion, compass, bag.aligned[compass.topic]) for motion in evidence.motions)
        return [motion for motion in told if motion]

    others = [c for c in compasses if c.usable and c.topic not in {imu.topic for imu in imus}]
    along = next((c for c in others if c.offset_deg is not None), None)
    if along is not None:
        told = moved(along)
        imus = [turned_as_headed(bag.aligned[imu.topic], imu, evidence, told) for imu in imus]
    if not others or evidence.courses is None:
        return list(imus), compasses
    if others[0].offset_deg is not None and not mostly_one_way(evidence.courses.course_rad):
        return list(imus), compasses  # a current sets her to either side
    told = moved(by_quarters(others[0]))
    as_set = [turned_as_set(bag.aligned[imu.topic], imu, evidence, told) for imu in imus]
    if all(one is other for one, other in zip(as_set, imus, strict=True)):
        return list(imus), compasses
    return as_set, tuple(set_sideways(c) if c in others else c for c in compasses)


def _in_axes_up(
    bag: Contents, gnss: Sequence[GnssReport], imus: list[ImuReport]
) -> tuple[list[ImuReport], dict[str, tuple[Vec, Vec]]]:
    """Return the reports of IMUs, and the poses of the frames of tf, in a body with axes ahead, to port, up.

    Where the body of tf has such axes already, the reports are returned as they are, and no frames. `_draft` takes the
    mounts of sensors from these frames instead of tf.

    Returns:
        The reports, and by frame its place (m) and rpy (deg) in the body.
    """
    if not _looks_down(bag, imus, gnss):
        return imus, {}
    body, frames = bag.tree.body(), bag.tree.frames
    in_body = {frame: _turned(pose) for frame in frames if (pose := bag.tree.resolve(body, frame))}
    return [_in_turned_body(imu) for imu in imus], in_body


def _looks_down(bag: Contents, imus: Sequence[ImuReport], gnss: Sequence[GnssReport]) -> bool:
    """Return whether the axes of the body of tf are ahead, to starboard, down, as makers of INSs have them.

    The measured mount of the IMU and the places of the antennas must both say so. Where only a driver has such axes,
    under a frame of a URDF, the antennas are above.
    """
    if not imus or imus[0].mount.tf_frame is not None or imus[0].mount.xyz_m is None:
        return False
    own = bag.aligned[imus[0].topic]
    pose = bag.tf_pose(own)
    # A position in the IMU's own frame is the output of an INS, not of an antenna.
    antennas = {g.tf_frame for g in gnss if g.tf_frame not in (None, own.frame_id) and not filtered(g.topic)}
    places = [mount[0] for frame in antennas if frame and (mount := bag.tree.resolve(bag.tree.body(), frame))]
    if pose is None or pose[0][2] > 0.0 or not places or any(place[2] > -_BELOW_M for place in places):
        return False
    turn = rotation_from_rpy_deg(np.array(imus[0].mount.rpy_deg)) @ pose[1].T
    return float(np.diagonal(turn @ _DOWN).min()) > _ALIKE


def _turned(pose: Pose) -> tuple[Vec, Vec]:
    """Return the place (m) and rpy (deg), in axes ahead, to port, up, of a pose in axes ahead, to starboard, down."""
    return vec(_DOWN @ pose[0]), vec(np.degrees(rpy_from_rotation(_DOWN @ pose[1])))


def _in_turned_body(imu: ImuReport) -> ImuReport:
    xyz_m = imu.mount.xyz_m
    return imu if xyz_m is None else replace(imu, mount=replace(imu.mount, xyz_m=vec(_DOWN @ np.array(xyz_m) + 0.0)))


def _with_wander(
    bag: Contents,
    gnss: Sequence[GnssReport],
    odometry: Sequence[tuple[TopicData, OdometryReport]],
    velocities: Sequence[tuple[TopicData, VelocityReport]],
    motions: Sequence[MeasuredMotion],
) -> tuple[GnssReport, ...]:
    """Return the receivers' reports with how fast their error changes, by wheels or velocities over ground.

    Outputs of filters are not asked: they are made from the fixes.
    """
    wheels = [s for s, report in odometry if report.role == "check_speed" and not report.fused]
    doppler = {v.topic for _, v in velocities if v.axes in (EAST_AXES, NORTH_AXES) and not filtered(v.topic)}
    told = [motion for motion in motions if motion.source in doppler]
    return tuple(with_wander(report, bag.aligned[report.topic], wheels, told) for report in gnss)


def _warnings(
    bag: Contents,
    gnss: Sequence[GnssReport],
    imus: Sequence[ImuReport],
    compasses: Sequence[CompassReport],
    odometry: Sequence[OdometryReport],
) -> Iterator[str]:
    """Yield what is wrong with the receivers, what is not used, and what is missing."""
    topics = bag.topics.values()
    usable = {c.topic for c in compasses if c.usable}
    for report in gnss:
        yield from filter(None, (report.stored, report.frozen, report.in_radians))
    if gnss and (gnss[0].differs or gnss[0].apart_m >= TWO_CRAFT_M):
        yield apart_warning(gnss[0])
    used = {g.topic for g in gnss} | {i.topic for i in imus} | usable
    yield from shared_topics(list(bag.streams.values()))
    yield from unused_topics(list(bag.streams.values()), used, sum(t.messages for t in topics))
    yield from lacking(bag, imus, gnss, odometry)
    if not bag.lidars:
        yield from unread_lidars(topics)
    if not bag.cameras:
        yield from unread_tags(topics)
    yield from unused_numbers(t for t in topics if t.topic not in bag.streams)
    if not usable:
        yield from unused_magnetometers(topics)
