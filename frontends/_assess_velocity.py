# SPDX-License-Identifier: Apache-2.0
"""Assess velocities by the GNSS track: in which axes they are, and which source tells the vessel's motion best."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.frames import Array, rotation_from_rpy_deg, rpy_from_rotation
from graphloc.frontends._assess import MeasuredMotion, ReferenceTrack, attitudes, motion_of_places, sane, track, vec
from graphloc.frontends._assess_world import World
from graphloc.frontends._reports import (
    BODY_AXES,
    EAST_AXES,
    NORTH_AXES,
    MountGuess,
    OdometryReport,
    VelocityReport,
    filtered,
    of_log,
    through_water,
)
from graphloc.frontends._tf import Pose
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.msgtypes import ODOMETRY, POINT, VECTOR
from graphloc.signals.series import integral, interpolated
from graphloc.time import NS_PER_S

# Durations of chords: a craft turns little in the short one; over the long one fixes wander by less than the craft
# goes.
_CHORD_S, _LONG_CHORD_S = 2.0, 10.0
# Of a craft that goes east or west: least correlation of y with the speed north, from which y is north; least RMS of
# the speed north over that of the differences along the course, from which the speed north is no wander of the fixes.
_FOLLOWS, _NO_WANDER = 0.5, 3.0
_JUMP = 0.03  # share of chords that are left out: where fixes jump, they fit no axes
_FITS = 0.4  # largest RMS difference of axes that fit, as a share of the speed
_AXES = (EAST_AXES, NORTH_AXES, BODY_AXES)
_INS = re.compile(r"(^|[/_])(o?ins|oxts|inspvax?|span)([/_]|$)", re.IGNORECASE)
EITHER = f"{EAST_AXES}, or {BODY_AXES}"
_OF_GNSS = re.compile(r"gps|gnss|fix|ublox|novatel|septentrio|antenna|enu", re.IGNORECASE)
_OF_LOG = re.compile(r"dvl|doppler|wheel|speed_?log", re.IGNORECASE)
_FEWEST = 20  # least number of velocities or fixes, two to twenty seconds: of fewer, axes are chance; a choice
_FAR_WORSE = 5.0  # fixes that claim over so many times the median sigma are left out
_ASTERN, _MOVES_MPS = 0.95, 0.3  # if so large a share of the larger speeds is astern, the sign looks wrong
_ALONG = 0.9  # cosine between x of a log and of the body: if it is less, the log's y tells speed ahead, too
_REVERSED = "it goes astern nearly all the time: its sign looks wrong, and is taken for reversed"


def axes_of(stream: TopicData, reference: ReferenceTrack, R_body_sensor: Array | None = None) -> tuple[str | None, str]:
    """Return the axes in which the velocities of a stream fit chords of a track, and the evidence in words.

    The axes are None if the data do not show them, 'unknown' if no axes fit, `EITHER` if two do.

    Args:
        stream: has velocities in its last three columns. reference: the track.
        R_body_sensor: (3, 3), if the axes of the sensor are turned in the body.
    """
    R = np.eye(3) if R_body_sensor is None else R_body_sensor
    axes, why = _axes_by(stream, reference, _CHORD_S, R)
    if axes == "unknown":
        over, why_over = _axes_by(stream, reference, _LONG_CHORD_S, R)
        if over in (EAST_AXES, NORTH_AXES):
            return over, f"{why_over}, over {_LONG_CHORD_S:.0f} s: the fixes wander"
    return axes, why


def _axes_by(
    stream: TopicData, reference: ReferenceTrack, chord_s: float, R_body_sensor: Array
) -> tuple[str | None, str]:
    """Return the same as `axes_of`, by chords of one duration."""
    keep = sane(stream, np.s_[-3:])
    v = stream.rows[keep, -3:] if len(keep) else np.zeros((0, 3))
    chords, mean = _pairs(stream.stamps_ns[keep], v, reference, chord_s)
    noise = 2.0 * reference.scatter_m / chord_s  # of the mean velocity of a chord, in both axes together, m/s
    forward = chords / np.maximum(np.hypot(*chords.T), 1e-9)[:, None]
    # The speed along body x, laid along the chord whichever its sign: a craft may go astern.
    in_body = mean @ R_body_sensor.T
    along = forward * np.abs(in_body[:, :1])
    squared = np.array([((v - chords) ** 2).sum(axis=1) for v in (mean[:, :2], mean[:, 1::-1], along)])
    # Where the fixes jump, no axes fit; a few such chords would dominate the RMS.
    least = squared.min(axis=0)
    kept = least <= np.quantile(least, 1.0 - _JUMP) if len(least) else np.zeros(0, dtype=bool)
    chords, in_body, squared = chords[kept], in_body[kept], squared[:, kept]
    speed = _less(float(np.sqrt((chords**2).sum(axis=1).mean())), noise) if len(chords) else 0.0
    if len(chords) < 10 or speed < 0.5:
        return None, "no GNSS track in motion to check it against"
    if noise > speed:
        return (
            None,
            f"the fixes scatter by {reference.scatter_m:.1f} m, too much to check it against them at {speed:.1f} m/s",
        )
    # A speed laid along the chords differs from them along their direction only: half of the noise's power.
    parts = (1.0, 1.0, 0.5**0.5)
    errors = [_less(float(np.sqrt(own.mean())), part * noise) for own, part in zip(squared, parts, strict=True)]
    best = int(np.argmin(errors))
    if _AXES[best] == BODY_AXES and errors[0] < _FITS * speed:
        own = _east_or_ahead(chords, in_body)
        if own is None:
            said = "the craft goes east or west throughout, where a speed ahead looks like a velocity to the east"
            return EITHER, f"{said}: either differs by {errors[0]:.2f} m/s RMS from the GNSS track beyond its noise"
        best = _AXES.index(own)
    why = f"differs from the GNSS track by {errors[best]:.2f} m/s RMS beyond the fixes' noise, {errors[0]:.2f} m/s as east, north, up"
    return (_AXES[best] if errors[best] < _FITS * speed else "unknown"), why


def _east_or_ahead(chords: Array, mean: Array) -> str | None:
    """Return which axes velocities have that fit as east, north and as body axes, of a craft that goes east or west.

    It is told by whether their y is the speed north; None if that is unclear. The errors of the two fits do not tell:
    only east, north counts the wander of the fixes across the course. Where the craft went north by more than the fixes
    wander, y is as large: a log's leeway follows it as well.

    Args:
        chords: (N, 2), m/s. mean: (N, 3), m/s, means of the stream over the same times.
    """
    north, y, along = chords[:, 1], mean[:, 1], np.abs(mean[:, 0]) - np.hypot(*chords.T)
    together, square = float(y @ north), float(north @ north)
    went = square > _NO_WANDER**2 * float(along @ along)
    if together > _FOLLOWS * max(float(y @ y), float(np.sqrt((y @ y) * square)), square if went else 0.0):
        return EAST_AXES
    return BODY_AXES if went else None


def _less(rms: float, noise: float) -> float:
    """Return an RMS from which the power of a noise is taken off."""
    return float(np.sqrt(max(rms**2 - noise**2, 0.0)))


def velocity_report(stream: TopicData, reference: ReferenceTrack, pose: Pose | None) -> VelocityReport:
    """Return the report of a twist or vector: its axes, and of a Doppler log also its mount.

    The axes are tried as turned by tf, if tf knows the frame; if these do not fit, as they are.

    Args:
        stream, reference: see `axes_of`. pose: T_body_sensor by tf; None if tf does not connect its frame with the
            body.
    """
    log = _of_doppler_log(stream)
    R_body_sensor = None if log or pose is None else pose[1]
    axes, why = axes_of(stream, reference, R_body_sensor)
    if axes == "unknown" and R_body_sensor is not None:  # its axes are not those of its frame in tf
        R_body_sensor = None
        axes, why = axes_of(stream, reference)
    axes, why = _axes_by_kind(stream, axes, why)
    turned = axes == BODY_AXES and R_body_sensor is not None and abs(float(R_body_sensor[0, 0])) < _ALONG
    rows = stream.rows[sane(stream)]
    reverse = axes == BODY_AXES and pose is None and len(rows) > 0 and _astern(rows[:, -3])
    return VelocityReport(
        topic=stream.topic,
        msgtype=stream.msgtype,
        axes=axes,
        why=f"{why}; {_REVERSED}" if reverse else why,
        frame_id=stream.frame_id,
        tf_frame=None if pose is None else stream.frame_id,
        reverse=reverse,
        mount=_mount_of_log(stream.frame_id, pose, reverse) if log else None,
        sideways=(of_log(stream.topic) or turned) and bool(np.nan_to_num(rows[:, -2]).any()),
        rpy_deg=vec(np.degrees(rpy_from_rotation(R_body_sensor)))
        if axes == BODY_AXES and R_body_sensor is not None
        else None,
    )


def _of_doppler_log(stream: TopicData) -> bool:
    return stream.part is not None and stream.part.kind == "body_velocity"


def _axes_by_kind(stream: TopicData, axes: str | None, why: str) -> tuple[str | None, str]:
    """Return the axes of a velocity, and why, by its type, names or sentence; where these tell nothing, by the track.

    Args:
        axes, why: by the track, see `axes_of`.
    """
    part, names = stream.part, f"{stream.topic} {stream.frame_id}"
    if _of_doppler_log(stream):
        axes, why = BODY_AXES, f"a Doppler log's, by its type; {why}"
    elif part is not None and part.told:
        axes, why = EAST_AXES, f"known by its type; {why}"
    elif part is not None and axes not in (EAST_AXES, NORTH_AXES):
        axes, why = NORTH_AXES, f"as its driver writes it by default; {why}"
    elif axes == EITHER:
        axes = EAST_AXES if _OF_GNSS.search(names) else BODY_AXES
        why = f"by the names of its topic and frame; {why}"
    elif axes is None and _OF_LOG.search(names):
        axes, why = BODY_AXES, f"by the names of its topic and frame; {why}"
    if of_log(stream.topic) or through_water(stream.topic):
        past = "through the water" if through_water(stream.topic) else "over ground by a log"
        axes, why = BODY_AXES, f"a speed {past}; {why}"
    return axes, why


def _mount_of_log(frame: str, pose: Pose | None, reverse: bool) -> MountGuess:
    """Return the mount of a Doppler log, whose z is down though drivers may name a frame of tf whose z is up.

    Args:
        frame: of its messages. pose: T_body_frame by tf; None if unknown. reverse: its speeds are astern throughout.
    """
    if pose is None:
        down = (180.0, 0.0, 180.0 if reverse else 0.0)
        return MountGuess(rpy_deg=down, tf_frame=None, evidence="x ahead, y to starboard, z down")
    p_m, R = pose
    if R[2, 2] < 0.0:
        return MountGuess(rpy_deg=vec(np.degrees(rpy_from_rotation(R))), tf_frame=frame, evidence="from tf")
    rpy = vec(np.degrees(rpy_from_rotation(R @ np.diag([1.0, -1.0, -1.0]))))
    said = f"by tf '{frame}' has z up: turned about x, as the messages have z down"
    return MountGuess(rpy_deg=rpy, tf_frame=None, evidence=said, xyz_m=vec(p_m))


def _astern(forward_mps: Array) -> bool:
    """Return whether speeds (N,) along the vessel, m/s, are negative nearly whenever it moves."""
    moves = np.abs(forward_mps) > _MOVES_MPS
    return bool(moves.sum() >= _FEWEST and (forward_mps[moves] < 0.0).mean() > _ASTERN)


def odometry_report(stream: TopicData, reference: ReferenceTrack, world: World) -> OdometryReport:
    """Return the likely role of an odometry or pose topic, by its name and whether it reports the speed of the vessel.

    Args:
        stream: odometry or poses. reference: see `axes_of`. world: its frame, by `world_of`.
    """
    rows = stream.rows[sane(stream)]
    speed = float(np.nanmax(np.abs(rows[:, 7]))) if len(rows) and np.isfinite(rows[:, 7]).any() else 0.0
    name, reverse, fused = stream.topic.lower(), False, _fused(stream.topic, world)
    truth = stream.msgtype != POINT and any(word in name for word in ("truth", "groundtruth", "/gt"))
    if truth:
        role, why = "truth", "its name says so"
    elif stream.msgtype != ODOMETRY or speed <= 0.05:
        role, why = "pose", "it reports poses and no speed"
    else:
        axes, fit = axes_of(stream, reference)
        whose = f"{fused}, no check by other means" if fused else "looks like wheel odometry"
        role, why = "check_speed", f"it reports forward speeds up to {speed:.1f} m/s: {whose}"
        reverse = _astern(rows[:, 7])
        why = f"{why}; {_REVERSED}" if reverse else why
        if axes not in (None, BODY_AXES, EITHER):
            role, why = "pose", f"its speeds are not along the craft: {fit}"
    if not world.pose and role != "check_speed":
        role, why = "other", "not a pose about a datum that the vessel could have"
    return OdometryReport(
        topic=stream.topic,
        msgtype=stream.msgtype,
        frame_id=stream.frame_id,
        role=role,
        max_speed_mps=speed,
        why=why,
        origin=world.origin,
        world=world.why,
        grid=world.grid and not truth,
        reverse=reverse,
        fused=bool(fused),
    )


def _fused(topic: str, world: World) -> str:
    """Return why an odometry is the output of a filter or an INS; '' if nothing says so."""
    if filtered(topic):
        return "a filter's output by its name"
    if _INS.search(topic):
        return "an INS's output by its name"
    if world.grid or world.centred or world.ned or world.origin is not None:
        known = {"a map grid": world.grid, "earth-centred": world.centred, "north, east, down": world.ned}
        frame = next((frame for frame, is_it in known.items() if is_it), "east-north-up about the fixes")
        return f"an INS's or a filter's output, as its frame is {frame}, which wheel odometry cannot know"
    return ""


def motions_of(
    wheels: Sequence[TopicData], twists: Sequence[tuple[TopicData, VelocityReport]], fixes: Sequence[TopicData]
) -> list[MeasuredMotion]:
    """Return the motion of the vessel by wheels, velocities and fixes, the most accurate source of speed first.

    A Doppler log whose mount is not in tf may be mounted at 45 deg, so it is asked only where nothing else tells.

    Args:
        wheels: odometry that reports the speed along the vessel. fixes: of receivers.
        twists: velocities and their reports. One that fits the track in no axes is left out: a `Vector3Stamped` may
            hold anything.
    """
    logs: list[MeasuredMotion] = []
    found = [m for s in wheels if (m := _told(s, BODY_AXES)) and float(np.ptp(m.speed_mps)) > 0.2]
    for stream, report in twists:
        motion = _motion_of(stream, report)
        if motion is not None:
            (logs if report.mount is not None and report.tf_frame is None else found).append(motion)
    ways = [(s, *_as_good_as_most(*track(s))) for s in fixes]
    return found + [m for s, at, p in ways if (m := motion_of_places(s.topic, at, p))] or logs


def _motion_of(stream: TopicData, report: VelocityReport) -> MeasuredMotion | None:
    """Return the motion by a velocity over ground; None where its axes are not known, or the craft hardly moves."""
    known = report.axes in (EAST_AXES, NORTH_AXES) if stream.msgtype == VECTOR else report.axes != "unknown"
    if not known or through_water(stream.topic):
        return None
    log = report.mount if report.tf_frame is not None else None
    rpy_deg = report.rpy_deg if log is None else log.rpy_deg
    R = None if rpy_deg is None else rotation_from_rpy_deg(np.array(rpy_deg))
    motion = _told(stream, report.axes or EAST_AXES, R)
    fast = motion is not None and float(np.percentile(np.abs(motion.speed_mps), 90)) > 0.5
    return motion if fast else None


def motion_of_poses(poses: TopicData) -> MeasuredMotion | None:
    """Return the motion that poses tell, with the attitude if they have one; None of too few poses."""
    keep = sane(poses, np.s_[:3])
    q = poses.rows[keep, 3:7]
    whole = attitudes(q)
    told = bool(whole.mean() > 0.5) if len(whole) else False
    keep = keep[whole] if told else keep
    motion = motion_of_places(poses.topic, poses.stamps_ns[keep], poses.rows[keep, :3])
    if motion is None or not told:
        return motion
    return replace(motion, attitude=Rotation.from_quat(q[whole]))


def _as_good_as_most(stamps_ns: NDArray[np.int64], p_m: Array, rows: Array) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (N,) and positions (N, 3) of the fixes that do not claim to be far worse than most.

    RTK floats among fixed solutions would hide the motion.
    """
    claimed = np.sqrt(np.maximum(rows[:, 5:7].max(axis=1, initial=0.0), 0.0))
    usual = float(np.median(claimed)) if len(claimed) else 0.0
    good = claimed <= _FAR_WORSE * usual if np.isfinite(usual) and usual > 0.0 else np.ones(len(claimed), dtype=bool)
    return stamps_ns[good], p_m[good]


def _told(stream: TopicData, axes: str, R_body_sensor: Array | None = None) -> MeasuredMotion | None:
    """Return the motion by a stream of velocities in some axes; None of too few.

    Args:
        R_body_sensor: (3, 3), if the axes of the sensor are turned in the body.
    """
    keep = sane(stream, np.s_[-3:-1])
    if len(keep) <= _FEWEST:
        return None
    v = stream.rows[keep, -3:]
    v = v if R_body_sensor is None else v @ R_body_sensor.T
    origin = int(stream.stamps_ns[keep[0]])
    t = (stream.stamps_ns[keep] - origin) / NS_PER_S
    if axes == BODY_AXES:
        return MeasuredMotion(stream.topic, origin, t, -v[:, 0] if _astern(v[:, 0]) else v[:, 0])
    east, north = (v[:, 1], v[:, 0]) if axes == NORTH_AXES else (v[:, 0], v[:, 1])
    return MeasuredMotion(stream.topic, origin, t, np.hypot(east, north), integral(t, east + 1j * north))


def _pairs(stamps_ns: NDArray[np.int64], v: Array, reference: ReferenceTrack, chord_s: float) -> tuple[Array, Array]:
    """Return the mean velocities (M, 2) of a track over chords, and those (M, 3) of a stream over the same times, m/s.

    Args:
        stamps_ns, v: (N,) and (N, 3), m/s, of the stream. chord_s: duration of a chord, at least.
    """
    none = np.zeros((0, 2)), np.zeros((0, 3))
    if len(stamps_ns) < 10 or len(reference.stamps_ns) < 3:
        return none
    t, at = (stamps_ns - stamps_ns[0]) / NS_PER_S, (reference.stamps_ns - stamps_ns[0]) / NS_PER_S
    inside = (at >= t[0]) & (at <= t[-1])
    at, p_m = at[inside], reference.p_m[inside]
    end = np.searchsorted(at, at + chord_s)
    begin = np.flatnonzero(end < len(at))
    end = end[begin]
    begin, end = (index[at[end] - at[begin] < 2.0 * chord_s] for index in (begin, end))
    if not len(begin):
        return none
    there = interpolated(at, t, integral(t, v))
    span = (at[end] - at[begin])[:, None]
    return (p_m[end, :2] - p_m[begin, :2]) / span, (there[end] - there[begin]) / span
