# SPDX-License-Identifier: Apache-2.0
"""Judging sensors by each other: how a topic arrives, how good the GNSS is, what a compass means.

Everything here is a guess with its evidence in words; `draft_config` writes both down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graphloc.config import GnssConfig
from graphloc.frames import Array, Datum, Geodetic, wrap_angle
from graphloc.frontends import _clock
from graphloc.frontends._fixes import RTK_SIGMA_M, scatter_m, stored, stored_warning
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._reports import CompassReport, GnssReport, TopicReport, Vec, two_antennas
from graphloc.frontends._sanity import far_fixes_of
from graphloc.frontends._streams import TopicData
from graphloc.frontends._turns import without_line
from graphloc.frontends.decode import IMU, MOST_TURNS, NUMBERS, PLAIN_POSE, POSE, QUATERNION, UNSTAMPED, yaw_of_x_axis
from graphloc.frozen_receiver import frozen_fixes, frozen_fixes_warning
from graphloc.measurements import GnssPosition, world_from_fixes
from graphloc.time import NS_PER_S

_TURNS_DEG, _SAME_DEG = 5.0, 0.2
_WINDOW_S, _FAST_MPS = 1.0, 2.0
_BLOCK_S = 30
_SCATTERS_DEG = 15.0  # of a heading about the course, from which the course is no test of it
_RELATIVE_DEG = 30.0  # off the course, from which an IMU's orientation has a north of its own
_STEADY_S = 120.0  # within it a gyro's bias and a compass's offset are steady
_FOLLOWS_DEG, _FOLLOWS = 8.0, 3.0  # most RMS of what a heading and the gyroscope differ by; turns over that
STATUS_NAMES = {-1: "no fix", 0: "fix", 1: "sbas", 2: "gbas"}


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredMotion:
    """How the craft moved: times (N,) s since `origin_ns`, speed (N,) m/s (signed where the source knows).

    `way_m`: (N,) its places, m, east + i north, about any origin; None where the source tells the speed only.
    `rests`: whether its speed is precise enough to tell that the craft stands.
    """

    source: str
    origin_ns: int
    t_s: Array
    speed_mps: Array
    way_m: NDArray[np.complex128] | None = None
    rests: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Courses:
    """Course over ground (rad, from east, counter-clockwise) at some stamps, from chords of the GNSS track."""

    stamps_ns: NDArray[np.int64]
    course_rad: Array


def vec(values: ArrayLike) -> Vec:
    """Return three numbers as a tuple."""
    a, b, c = (float(v) for v in np.asarray(values))
    return (a, b, c)


def summed(t_s: Array, values: NDArray[Any]) -> NDArray[Any]:
    """Return the running integral (N,) of values (N,) over times (N,), by trapezia; real or complex."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])


def topic_report(stream: TopicData, count: int) -> TopicReport:
    """Return rates, gaps, stamps and latency of a topic."""
    base = {"topic": stream.topic, "msgtype": stream.msgtype, "count": count}
    stamps, logs = stream.stamps_ns, stream.logs_ns
    if len(stamps) == 0:
        return TopicReport(**base, undecodable=stream.undecodable, no_stamp=stream.no_stamp)  # type: ignore[arg-type]
    steps = np.diff(stamps)
    ahead = steps[steps > 0] / NS_PER_S
    usual = float(np.median(ahead)) if len(ahead) else None
    latency = np.percentile(logs - stamps, [5, 50, 95]) / NS_PER_S
    return TopicReport(
        **base,  # type: ignore[arg-type]
        undecodable=stream.undecodable,
        frame_id=stream.frame_id,
        start_ns=int(stamps.min()),
        span_s=float(stamps.max() - stamps.min()) / NS_PER_S,
        rate_hz=1.0 / usual if usual else None,
        gaps=int((ahead > max(5.0 * usual, 0.1)).sum()) if usual else None,
        max_gap_s=float(ahead.max()) if len(ahead) else None,
        repeated=int((steps == 0).sum()),
        backward=int((steps < 0).sum()),
        no_stamp=stream.no_stamp,
        recorded=stream.recorded,
        latency_s=vec(latency),
        drift_ppm=stream.drift_ppm,
    )


def sane(stream: TopicData) -> NDArray[np.intp]:
    """Return indices of messages in order of strictly increasing stamps, without clock jumps."""
    good = np.flatnonzero(~_clock.clock_jumps(stream.stamps_ns, stream.logs_ns))
    return good[_clock.longest_increasing(stream.stamps_ns[good])]


def without_drift(streams: Sequence[TopicData]) -> list[TopicData]:
    """Return streams whose clocks do not drift against each other, by the recording times: the steadiest clock is believed.

    Clocks that gain as much as that one are left as they are: then it is the recorder's that drifts.
    """
    ppm = {s.topic: 0.0 if s.recorded else _clock.gain(s.stamps_ns, s.logs_ns).drift_ppm for s in streams}
    told = [s for s in streams if len(s) >= _clock.FEWEST_STAMPS and not s.recorded and s.msgtype not in UNSTAMPED]
    clocks = [ppm[s.topic] for s in told]
    steadiest = min(clocks, key=abs, default=0.0)
    found = []
    for stream in streams:
        span_s = float(np.ptp(stream.logs_ns)) / NS_PER_S if len(stream) else 0.0
        apart_s = 1e-6 * (ppm[stream.topic] - steadiest) * span_s
        drifts = ppm[stream.topic] and abs(apart_s) > _clock.GAIN_LIMIT_S
        found.append(stream.without_drift(ppm[stream.topic] - steadiest) if drifts else stream)
    return found


def evenly(imu: TopicData) -> TopicData:
    """Return an IMU's stream, samples that were stamped in bursts laid out evenly."""
    return imu.stamped(_clock.evened(imu.stamps_ns, imu.rows[:, :6]))


def on_one_clock(streams: Sequence[TopicData]) -> list[TopicData]:
    """Return streams with messages, each on the clock of the first IMU where its own is another one, by the recording times.

    Where that tells no date, on the first clock that does.

    One cannot be judged by another that lies seconds or years away. A pose may well come late: it takes time to match.
    """
    clocks = {
        s.topic: _clock.Clock(int(s.stamps_ns.min()), _clock.usual_latency_s(s.stamps_ns, s.logs_ns)) for s in streams
    }
    imu = next((clocks[s.topic] for s in streams if s.msgtype == IMU), None)
    if imu is None:
        return list(streams)
    own = [clocks[s.topic] for s in streams if not s.recorded and s.msgtype not in UNSTAMPED]
    reference = _clock.reference_of(imu, own)
    found = []
    for stream in streams:
        behind = _clock.behind_s(clocks[stream.topic], imu, reference)
        limit = _clock.JUMP_LIMIT_S if stream.msgtype in (POSE, PLAIN_POSE) else _clock.EPOCH_LIMIT_S
        found.append(stream.later(round(behind * NS_PER_S)) if abs(behind) > limit else stream)
    return found


def track(fixes: TopicData) -> tuple[NDArray[np.int64], Array, Array]:
    """Return stamps (N,), positions (N, 3) m about the first good fix, and the good fixes' rows (not those of a stored position).

    Fixes without a height lie as high as most of the others, or at 0.
    """
    keep, rows = _placed(fixes)
    there = ~stored(fixes.stamps_ns[keep], rows[:, :3])
    keep, rows = keep[there], rows[there]
    near = ~far_fixes_of(rows[:, :3])
    keep, rows = keep[near], rows[near]
    if len(keep) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), rows
    datum = Datum(Geodetic(*rows[0, :3]))
    return fixes.stamps_ns[keep], datum.enu_from_geodetic(rows[:, 0], rows[:, 1], rows[:, 2]), rows


def _placed(fixes: TopicData) -> tuple[NDArray[np.intp], Array]:
    """Return indices and rows of the fixes that state a place, each with a height."""
    keep = sane(fixes)
    rows = fixes.rows[keep] if len(keep) else np.zeros((0, 8))
    good = (
        np.isfinite(rows[:, :2]).all(axis=1) & ~np.isinf(rows[:, 2]) & (rows[:, 3] >= 0) & (np.abs(rows[:, 0]) <= 90.0)
    )
    good &= (rows[:, 0] != 0.0) | (rows[:, 1] != 0.0)
    keep, rows = keep[good], rows[good]
    flat = np.isnan(rows[:, 2])
    rows[flat, 2] = 0.0 if flat.all() else np.median(rows[~flat, 2])
    return keep, rows


def courses_of(stamps_ns: NDArray[np.int64], p_m: Array, noise_m: float) -> Courses:
    """Return the direction of chords of the track long enough that its noise does not turn them."""
    reach = max(3.0, 8.0 * noise_m)
    at, course = [], []
    j = 0
    for i in range(len(stamps_ns)):
        j = max(j, i + 1)
        while j < len(stamps_ns) and np.hypot(*(p_m[j, :2] - p_m[i, :2])) < reach:
            j += 1
        if j == len(stamps_ns):
            break
        if stamps_ns[j] - stamps_ns[i] <= 10 * NS_PER_S:
            d = p_m[j] - p_m[i]
            at.append((int(stamps_ns[i]) + int(stamps_ns[j])) // 2)
            course.append(float(np.arctan2(d[1], d[0])))
    return Courses(np.array(at, dtype=np.int64), np.array(course))


def courses_of_fixes(fixes: Sequence[GnssPosition]) -> Courses:
    """Return the courses of one receiver's fixes, in any order; none of fewer than twenty."""
    fixes = sorted(fixes, key=lambda m: m.stamp_ns)
    if len(fixes) < 20:
        return Courses(np.zeros(0, dtype=np.int64), np.zeros(0))
    p = world_from_fixes(fixes, Datum(fixes[0].position))[:, :2]
    return courses_of(np.array([m.stamp_ns for m in fixes], dtype=np.int64), p, float(white_noise_m(p).max()))


def motion_of_fixes(source: str, fixes: Sequence[GnssPosition]) -> MeasuredMotion | None:
    """Return the motion of one receiver's fixes, in any order; None of fewer than twenty."""
    if len(fixes) < 20:
        return None
    moments = {m.stamp_ns: m for m in fixes}
    ordered = [moments[stamp_ns] for stamp_ns in sorted(moments)]
    p = world_from_fixes(ordered, Datum(ordered[0].position))
    return motion_of_places(source, np.array([m.stamp_ns for m in ordered], dtype=np.int64), p)


def motion_of_places(source: str, stamps_ns: NDArray[np.int64], p_m: Array) -> MeasuredMotion | None:
    """Return the motion that places (N, 3), m, tell: of a slow craft, their noise hides whether it stands; None of few."""
    t = (stamps_ns - stamps_ns[0]) / NS_PER_S if len(stamps_ns) else np.zeros(0)
    step = max(1, round(_WINDOW_S / float(np.median(np.diff(t))))) if len(t) > 1 else 1
    if len(t) < max(20, step + 2):
        return None
    v = (p_m[step:, :2] - p_m[:-step, :2]) / (t[step:] - t[:-step])[:, None]
    speed = np.interp(t, (t[step:] + t[:-step]) / 2.0, np.hypot(v[:, 0], v[:, 1]))
    fast = float(np.percentile(speed, 90)) > _FAST_MPS
    return MeasuredMotion(source, int(stamps_ns[0]), t, speed, p_m[:, 0] + 1j * p_m[:, 1], rests=fast)


def white_noise_m(p_m: Array) -> Array:
    """Return the white noise of each axis of places (N, k), m."""
    # Third differences remove position, velocity and acceleration; those of white noise have 20 x its variance.
    return np.asarray(1.4826 * np.median(np.abs(np.diff(p_m, n=3, axis=0)), axis=0) / np.sqrt(20.0))


def gnss_report(fixes: TopicData, tf_frame: str | None) -> GnssReport | None:
    """Return status, spread and a guess on slow errors; None where there is no fix at all."""
    stamps, p, rows = track(fixes)
    if len(stamps) == 0:
        return None
    status, counts = np.unique(fixes.rows[:, 3].astype(int), return_counts=True)
    known = (rows[:, 4] > 0) & np.isfinite(rows[:, 5:8]).all(axis=1) & (rows[:, 5:8] > 0.0).all(axis=1)
    sigma = np.sqrt(np.median(rows[known, 5:8], axis=0)) if known.any() else None
    sigmas = np.where(
        known, np.sqrt(np.where(known, rows[:, 5:7].max(axis=1), 0.0)), GnssConfig().default_horizontal_sigma_m
    )
    worst_m = float(np.percentile(sigmas, 95)) if known.any() else 0.0
    every, places = _placed(fixes)
    old = stored(fixes.stamps_ns[every], places[:, :3])
    bad = frozen_fixes(stamps, rows[:, :2], p[:, :2])
    own = p[~bad]
    scatter = white_noise_m(own) if len(own) > 10 else None
    chords = np.diff(p[:: max(1, len(p) // 400), :2], axis=0)
    precise = sigma is not None and float(sigma[:2].max()) < RTK_SIGMA_M and float(np.median(rows[:, 3])) >= 2.0
    if precise:
        told = "quality 4 (RTK, fixed)," if " " in fixes.topic else "status gbas (RTK) and a reported"
        why = f"{told} sigma below {RTK_SIGMA_M:g} m"
    elif sigma is None:
        why = "no covariance is reported"
    else:
        why = f"status {STATUS_NAMES.get(int(np.median(rows[:, 3])), '?')}, reported sigma {sigma[:2].max():.2f} m"
    return GnssReport(
        topic=fixes.topic,
        fixes=len(stamps),
        statuses={STATUS_NAMES.get(int(s), str(s)): int(c) for s, c in zip(status, counts, strict=True)},
        known_covariance=float(known.mean()),
        reported_sigma_m=None if sigma is None else vec(sigma),
        scatter_m=None if scatter is None else vec(scatter),
        height_range_m=float(np.subtract(*np.percentile(rows[:, 2], [95, 5]))),
        extent_m=(float(np.ptp(p[:, 0])), float(np.ptp(p[:, 1]))),
        travelled_m=float(np.hypot(chords[:, 0], chords[:, 1]).sum()),
        first=vec(rows[0, :3]),
        without_height=int(np.isnan(fixes.rows[np.isfinite(fixes.rows[:, :2]).all(axis=1), 2]).sum()),
        white_m=scatter_m(stamps[~bad], own[:, :2]),
        spans_s=float(stamps[-1] - stamps[0]) / NS_PER_S,
        frozen="".join(frozen_fixes_warning(fixes.topic, stamps, bad)),
        stored="".join(stored_warning(fixes.topic, places[:, :3], old)),
        slow_error=not precise,
        why=why,
        sigma_p95_m=worst_m,
        tf_frame=tf_frame,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """How the craft turned: times (N,) s since `origin_ns`, and the integral (N,) of its rate about up, rad."""

    origin_ns: int
    t_s: Array
    turned_rad: Array


def against_turning(
    turning: Turning | None, at_ns: NDArray[np.int64], angle: Array, over_s: float = 2.0, clear: float = 0.5
) -> int:
    """Return +1 where an angle grows as the craft turns to port, -1 where it falls, 0 where nothing tells.

    Args:
        at_ns: (N,), increasing. angle: (N,) rad, unwrapped. over_s: time over which changes are compared: a gyro's bias
            must be small beside them, and the angle's noise average out. clear: correlation that is believed.
    """
    at, own, turned = _beside(turning, at_ns, angle)
    if len(at) < 20:
        return 0
    step = max(1, round(over_s / max(float(np.median(np.diff(at))), 1e-3)))
    a, b = (v[step:] - v[:-step] for v in (own, turned))
    power = float(np.sqrt((a**2).sum() * (b**2).sum()))
    together = float((a * b).sum()) / power if power > 0.0 else 0.0
    return int(np.sign(together)) if abs(together) > clear else 0


def follows_turning(turning: Turning | None, at_ns: NDArray[np.int64], yaw: Array) -> bool:
    """Return whether a heading turns as the gyroscope does, by far more than the two differ.

    In blocks of two minutes, a straight line removed from each: the bias of the gyroscope, and what a heading is off by throughout.

    Args:
        at_ns: (N,), increasing. yaw: (N,) rad, unwrapped, positive to port.
    """
    at, own, turned = _beside(turning, at_ns, yaw)
    apart, turns = [], []
    blocks = (at - at[:1]) // _STEADY_S
    for block in (blocks == k for k in np.unique(blocks)):
        if block.sum() >= 20:
            apart.append(without_line((own - turned)[block], at[block]))
            turns.append(without_line(turned[block], at[block]))
    if not apart:
        return False
    off_deg, turns_deg = (float(np.degrees(np.sqrt(np.mean(np.concatenate(part) ** 2)))) for part in (apart, turns))
    return off_deg < min(_FOLLOWS_DEG, turns_deg / _FOLLOWS)


def _beside(turning: Turning | None, at_ns: NDArray[np.int64], angle: Array) -> tuple[Array, Array, Array]:
    """Return times (M,), s, of the angles that lie within a turning, these (M,) and the turning (M,) there; empty without one."""
    if turning is None:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    at = (at_ns - turning.origin_ns) / NS_PER_S
    inside = (at > turning.t_s[0]) & (at < turning.t_s[-1])
    return at[inside], angle[inside], np.interp(at[inside], turning.t_s, turning.turned_rad)


def unit_of(stream: TopicData) -> str | None:
    """Return the unit of a stream of bare numbers, if they are headings; None where it is none."""
    if stream.msgtype not in NUMBERS:
        return None
    known = np.abs(stream.rows[np.isfinite(stream.rows)])
    # Not the largest: a driver may say -999 while it knows none.
    return "rad" if len(known) and float(np.percentile(known, 95)) < 2.0 * np.pi + 0.1 else "deg"


def _quaternions(stream: TopicData, rows: Array) -> Array:
    if unit := unit_of(stream):
        angle = np.radians(rows[:, 0]) if unit == "deg" else rows[:, 0]
        half = np.where(np.abs(angle) <= MOST_TURNS * 2.0 * np.pi, angle, np.nan) / 2.0
        return np.column_stack([0.0 * half, 0.0 * half, np.sin(half), np.cos(half)])
    return rows[:, 6:10] if stream.msgtype == IMU else rows[:, :4]


def headings(stream: TopicData) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (N,) and unwrapped yaw (N,), rad, as the messages say it, of those that say one."""
    keep = sane(stream)
    yaw = [yaw_of_x_axis(*(float(v) for v in q)) for q in _quaternions(stream, stream.rows[keep])]
    good = np.array([not isinstance(y, Rejection) for y in yaw], dtype=bool)
    return stream.stamps_ns[keep][good], np.unwrap(np.array([y for y in yaw if not isinstance(y, Rejection)]))


def says_the_same(first: TopicData, second: TopicData, *, mirrored: bool) -> bool:
    """Return whether two headings are one, but for an offset: two devices never agree so closely while the craft turns.

    Args:
        mirrored: whether one of them grows as the other falls.
    """
    (at, a), (there, b) = headings(first), headings(second)
    if len(at) < 10:
        return False
    inside = (there >= at[0]) & (there <= at[-1])
    there, b = there[inside], b[inside]
    if len(there) < 10:
        return False
    a = np.interp((there - at[0]) / NS_PER_S, (at - at[0]) / NS_PER_S, a)
    turns, apart = (_middle_deg(v)[1] for v in (b, a + b if mirrored else a - b))
    return turns > _TURNS_DEG and apart < _SAME_DEG


def _middle_deg(angle: Array) -> tuple[float, float]:
    """Return a robust mean and standard deviation of angles (N,), deg: fixes may jump or be frozen."""
    mean = float(np.angle(np.exp(1j * angle).mean()))
    middle = mean + float(np.median(wrap_angle(angle - mean)))
    scatter = 1.4826 * float(np.median(np.abs(wrap_angle(angle - middle))))
    return float(np.degrees(wrap_angle(middle))), float(np.degrees(scatter))


def _wanders_deg(stamps_ns: NDArray[np.int64], angle: Array) -> float | None:
    """Return how far the middle of angles (N,), rad, differs from block to block, 1 sigma, deg; None of fewer than three."""
    block = (stamps_ns - stamps_ns[0]) // (_BLOCK_S * NS_PER_S)
    own = [angle[block == k] for k in np.unique(block)]
    middles = np.radians([_middle_deg(part)[0] for part in own if len(part) >= 5])
    if len(middles) < 3:
        return None
    return float(np.degrees(np.std(wrap_angle(middles - middles[0]), ddof=1)))


def compass_report(stream: TopicData, courses: Courses | None, turning: Turning | None) -> CompassReport | None:
    """Return whether an orientation is a heading, and in which convention; None where there is none."""
    keep = sane(stream)
    if len(keep) < 10:
        return None
    rows = stream.rows[keep]
    quaternions = _quaternions(stream, rows)
    if stream.msgtype == IMU and (float(np.median(rows[:, 12])) == -1.0 or len(np.unique(quaternions, axis=0)) < 3):
        return None
    yaw = [yaw_of_x_axis(*(float(v) for v in q)) for q in quaternions]
    good = np.array([not isinstance(y, Rejection) for y in yaw])
    # Drivers of receivers with two antennas fill an Imu with the orientation alone.
    gnss = not rows[:, :6].any() if stream.msgtype == IMU else two_antennas(stream.topic)
    plain: dict[str, Any] = {
        "topic": stream.topic,
        "msgtype": stream.msgtype,
        "unit": unit_of(stream),
        "two_antennas": gnss,
    }
    if good.sum() < 10:
        why = "its messages give no yaw"
        return CompassReport(
            **plain, usable=False, convention="enu", offset_deg=None, scatter_deg=None, samples=0, why=why
        )
    angle = np.unwrap(np.array([y for y in yaw if not isinstance(y, Rejection)]))
    named = stream.msgtype == QUATERNION  # a topic of bare orientations is meant as a compass
    sense = against_turning(turning, stream.stamps_ns[keep][good], angle)
    by_gyro = {1: "enu", -1: "ned"}.get(sense)
    spoke_ns = stream.stamps_ns[keep][good]
    heard = 0 if courses is None else int(np.searchsorted(courses.stamps_ns, spoke_ns[[0, -1]]) @ [-1, 1])
    if courses is None or heard < 20:
        why = "no GNSS course in motion to check it against" + (", convention from the gyro" if by_gyro else "")
        if courses is not None and not heard and stream.msgtype in NUMBERS:
            why = "no GNSS course in motion at the times it was recorded (it has no stamp)"
        return CompassReport(
            **plain, usable=named, convention=by_gyro or "enu", offset_deg=None, scatter_deg=None, samples=0, why=why
        )
    origin = int(stream.stamps_ns[keep[0]])
    measured = np.interp(
        (courses.stamps_ns - origin) / NS_PER_S, (stream.stamps_ns[keep][good] - origin) / NS_PER_S, angle
    )
    fits = {}
    for convention, value in (("enu", measured), ("ned", np.pi / 2.0 - measured)):
        fits[convention] = _middle_deg(value - courses.course_rad)
    turned = float(np.degrees(np.sqrt(max(0.0, -2.0 * np.log(max(abs(np.exp(1j * courses.course_rad).mean()), 1e-9))))))
    if by_gyro:
        convention = by_gyro
    elif turned < 20.0:  # on a straight both conventions fit with some offset: the smaller offset is likelier
        convention = min(fits, key=lambda c: abs(fits[c][0]))
    else:
        convention = min(fits, key=lambda c: fits[c][1])
    offset, scatter = fits[convention]
    apart = (measured if convention == "enu" else np.pi / 2.0 - measured) - courses.course_rad
    # Courses tell headings of a vessel that goes ahead; of one that is set sideways only the gyroscope tells whether it is one. But
    # an IMU's own orientation follows the gyroscope wherever north is.
    fits_course = bool(scatter < _SCATTERS_DEG)
    sideways = (
        not fits_course
        and by_gyro is not None
        and (stream.msgtype != IMU or abs(offset) < _RELATIVE_DEG)
        and follows_turning(turning, spoke_ns, angle if convention == "enu" else np.pi / 2.0 - angle)
    )
    usable = fits_course or sideways
    why = f"yaw minus GNSS course: {offset:+.0f} deg, scatter {scatter:.0f} deg over {len(measured)} courses"
    if sideways:
        why += ": a vessel that often goes sideways, since it turns as the gyro does"
    elif not usable:
        why += ": a relative or a disturbed heading, or a vessel that often goes sideways"
    elif by_gyro:
        why += "; convention from the gyro"
    elif turned < 20.0:
        why += ", on a nearly straight track: the convention is not certain"
    return CompassReport(
        **plain,
        usable=usable,
        convention=convention,
        offset_deg=None if sideways else offset,
        scatter_deg=scatter,
        leeway_deg=None if sideways else _wanders_deg(courses.stamps_ns, apart),
        samples=len(measured),
        why=why,
    )
