# SPDX-License-Identifier: Apache-2.0
"""Judging sensors by each other: how a topic arrives, how good the GNSS is, how the craft moved.

Every result is a guess with its evidence in words; `draft_config` writes down the guess and the evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import GnssConfig, SlowErrorConfig
from graphloc.frames import Array, Datum, Geodetic, wrap_angle
from graphloc.frontends import _clock, _order
from graphloc.frontends._fixes import RTK_SIGMA_M, radians_warning, scatter_m, stored, stored_warning, uneven
from graphloc.frontends._reports import GnssReport, PartOfFixes, TopicReport, Vec, of_nmea
from graphloc.frontends._sanity import far_fixes_of, lone_fixes
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.msgtypes import IMU, PLACES, PLAIN_POSE, POSE, QUATERNION, UNSTAMPED
from graphloc.measurements import GnssPosition, world_from_fixes
from graphloc.signals.frozen_receiver import frozen_fixes, frozen_fixes_warning
from graphloc.signals.white_noise import white_noise
from graphloc.time import NS_PER_S, stamps_of

_MOST, _ONE_WAY_RAD = 0.8, np.radians(30.0)  # so many courses lie so near to their mean where they go one way; a choice
_NEARLY_RAD = np.radians(45.0)  # the same, of half of them
_WINDOW_S, _FAST_MPS = 1.0, 2.0
_TURNS = 3  # fewest distinct orientations of poses that turn
_EITHER = 0.01  # least share of RTK fixes, and of others, of a receiver that has RTK by turns
STATUS_NAMES = {-1: "no fix", 0: "fix", 1: "sbas", 2: "gbas"}


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredMotion:
    """How the craft moved, by one source.

    Attributes:
        source: topic or sensor that tells it.
        origin_ns, t_s: a stamp; (N,) times since then, s.
        speed_mps: (N,) speed, m/s; negative astern, where the source knows.
        way_m: (N,) positions, m, east + i north, about any origin, or of wheels in axes of their own; None where the
            source tells the speed only.
        rests: whether the speed is precise enough to tell that the craft stands.
        attitude: N rotations R_world_body; None where the source tells none.
    """

    source: str
    origin_ns: int
    t_s: Array
    speed_mps: Array
    way_m: NDArray[np.complex128] | None = None
    rests: bool = True
    attitude: Rotation | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Courses:
    """Courses over ground (N,), rad from east, counter-clockwise, at stamps (N,), ns, from chords of the GNSS track."""

    stamps_ns: NDArray[np.int64]
    course_rad: Array


def one_way(course_rad: Array) -> bool:
    """Return whether most courses (N,), rad, go one way.

    Then leeway or a current may keep the heading off them by the same all along; of those to several sides the offsets differ.
    """
    if not len(course_rad):
        return False
    off = np.abs(wrap_angle(course_rad - np.angle(np.exp(1j * course_rad).sum())))
    return bool(np.quantile(off, _MOST) < _ONE_WAY_RAD)


def mostly_one_way(course_rad: Array) -> bool:
    """Return whether half of the courses (N,), rad, go nearly one way: then a current may make the median of what is off them."""
    off = np.abs(wrap_angle(course_rad - np.angle(np.exp(1j * course_rad).sum())))
    return len(off) > 0 and bool(np.median(off) < _NEARLY_RAD)


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceTrack:
    """Where the craft was, by its best receiver or by poses in a map grid.

    Attributes:
        stamps_ns, p_m: (N,) stamps; (N, 3) positions, m, east, north, up.
        scatter_m: white noise of the positions, 1 sigma of an axis.
        first: latitude, longitude (deg) and height (m) of their origin; None of poses in a map grid.
    """

    stamps_ns: NDArray[np.int64]
    p_m: Array
    scatter_m: float
    first: Vec | None = None


NO_TRACK = ReferenceTrack(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), 1.0)


def vec(values: ArrayLike) -> Vec:
    """Return three numbers as a tuple."""
    a, b, c = (float(v) for v in np.asarray(values))
    return (a, b, c)


def topic_report(stream: TopicData, count: int) -> TopicReport:
    """Return rates, gaps, stamps and latency of a topic."""
    base = {"topic": stream.topic, "msgtype": stream.msgtype, "count": count}
    stamps, logs = stream.stamps_ns, stream.logs_ns
    if len(stamps) == 0:
        return TopicReport(**base, undecodable=stream.undecodable, broken=stream.broken, no_stamp=stream.no_stamp)  # type: ignore[arg-type]
    steps = np.diff(stamps)
    # Messages out of order leave no gap, and count in the rate: so steps of the sorted stamps. A clock that was set
    # back would interleave two parts.
    ahead = np.diff(stamps if _order.set_backs(stamps) else np.sort(stamps))
    ahead = ahead[ahead > 0] / NS_PER_S
    usual = float(np.median(ahead)) if len(ahead) else None
    latency = np.percentile(logs - stamps, [5, 50, 95]) / NS_PER_S
    return TopicReport(
        **base,  # type: ignore[arg-type]
        undecodable=stream.undecodable,
        broken=stream.broken,
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


def as_heading(stream: TopicData) -> TopicData:
    """Return poses that tell a heading alone as bare orientations: their place never changes, while they turn.

    So some drivers say the heading of two antennas or of a gyrocompass. Any other stream is returned as it is.
    """
    if stream.msgtype not in (POSE, PLAIN_POSE) or not len(stream):
        return stream
    places, quaternions = stream.rows[:, :3], stream.rows[:, 3:7]
    stands = bool(np.isnan(places).all() or not np.ptp(places, axis=0).any())
    if not stands or len(np.unique(quaternions[attitudes(quaternions)], axis=0)) < _TURNS:
        return stream
    rows = quaternions.copy()
    rows.flags.writeable = False
    return replace(stream, msgtype=QUATERNION, _rows=rows)


def attitudes(quaternions: Array) -> NDArray[np.bool_]:
    """Return (N,) which of the quaternions (N, 4) are attitudes: finite, and of about unit norm, as drivers write few digits."""
    size = np.linalg.norm(quaternions, axis=1)
    return np.asarray(np.isfinite(size) & (np.abs(size - 1.0) < 0.1))


def sane(stream: TopicData, finite: slice | None = None) -> NDArray[np.intp]:
    """Return indices of messages with strictly increasing stamps, without clock jumps.

    Args:
        finite: columns of `rows` that must be finite; None: none.
    """
    good = np.flatnonzero(~_clock.clock_jumps(stream.stamps_ns, stream.logs_ns))
    keep = good[_order.longest_increasing(stream.stamps_ns[good])]
    if finite is None or not len(keep):
        return keep
    return keep[np.isfinite(stream.rows[keep, finite]).all(axis=1)]


def without_drift(streams: Sequence[TopicData]) -> list[TopicData]:
    """Return the streams with the drift of their clocks taken off the stamps.

    Drifts are those against the recording times, less that of the steadiest clock, which is believed: what this clock
    gains is the drift of the recorder's. So clocks that gain as much stay as they are.
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
    """Return an IMU's stream, with samples that were stamped in bursts laid out evenly."""
    return imu.stamped(_order.evened(imu.stamps_ns, imu.rows[:, :6]))


def on_one_clock(streams: Sequence[TopicData]) -> list[TopicData]:
    """Return the streams on one clock: that of the first IMU or, if it tells no date, the first clock that does.

    Streams that lie seconds or years apart cannot be judged by each other. By how much a clock differs is told by the
    recording times; below a limit its stamps stay. The limit of places is wider: a pose takes time to match.

    Args:
        streams: with one message each at least.
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
        limit = _clock.JUMP_LIMIT_S if stream.msgtype in PLACES else _clock.EPOCH_LIMIT_S
        found.append(stream.later(round(behind * NS_PER_S)) if abs(behind) > limit else stream)
    return found


def track(fixes: TopicData) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the stamps (N,) of good fixes, their positions (N, 3), m, about the first one, and their rows.

    Left out are fixes of a stored position, fixes far from all others, and single ones far from those around them. A fix without a height has the median height
    of the others, or 0 if none has one.
    """
    keep, rows = _placed(fixes)
    there = ~stored(fixes.stamps_ns[keep], rows[:, :3])
    keep, rows = keep[there], rows[there]
    near = ~far_fixes_of(fixes.stamps_ns[keep], rows[:, :3])
    keep, rows = keep[near], rows[near]
    if len(keep) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), rows
    datum = Datum(Geodetic(*rows[0, :3]))
    stamps_ns, p_m = fixes.stamps_ns[keep], datum.enu_from_geodetic(rows[:, 0], rows[:, 1], rows[:, 2])
    near = ~lone_fixes(stamps_ns, p_m)
    return stamps_ns[near], p_m[near], rows[near]


def _placed(fixes: TopicData) -> tuple[NDArray[np.intp], Array]:
    """Return indices and rows of the fixes that state a place; missing heights are filled in, see `track`."""
    keep = sane(fixes)
    rows = fixes.rows[keep] if len(keep) else np.zeros((0, 8))
    good = (
        np.isfinite(rows[:, :2]).all(axis=1) & ~np.isinf(rows[:, 2]) & (rows[:, 3] >= 0) & (np.abs(rows[:, 0]) <= 90.0)
    )
    good &= ((rows[:, 0] != 0.0) | (rows[:, 1] != 0.0)) & (rows[:, 1] >= -180.0) & (rows[:, 1] <= 360.0)
    keep, rows = keep[good], rows[good]
    flat = np.isnan(rows[:, 2])
    rows[flat, 2] = 0.0 if flat.all() else np.median(rows[~flat, 2])
    return keep, rows


def courses_of(way: ReferenceTrack) -> Courses:
    """Return the directions of chords of the track that are so long that its noise hardly turns them."""
    stamps_ns, p_m = way.stamps_ns, way.p_m
    reach = max(3.0, 8.0 * way.scatter_m)
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
    """Return the courses of one receiver's fixes, given in any order; empty of fewer than twenty fixes."""
    fixes = sorted(fixes, key=lambda m: m.stamp_ns)
    if len(fixes) < 20:
        return Courses(np.zeros(0, dtype=np.int64), np.zeros(0))
    p = world_from_fixes(fixes, Datum(fixes[0].position))[:, :2]
    return courses_of(ReferenceTrack(stamps_of(fixes), p, float(white_noise(p).max())))


def motion_of_fixes(source: str, fixes: Sequence[GnssPosition]) -> MeasuredMotion | None:
    """Return the motion of one receiver's fixes, given in any order; None of fewer than twenty fixes."""
    if len(fixes) < 20:
        return None
    moments = {m.stamp_ns: m for m in fixes}
    ordered = [moments[stamp_ns] for stamp_ns in sorted(moments)]
    p = world_from_fixes(ordered, Datum(ordered[0].position))
    return motion_of_places(source, stamps_of(ordered), p)


def motion_of_places(source: str, stamps_ns: NDArray[np.int64], p_m: Array) -> MeasuredMotion | None:
    """Return the motion that positions (N, 3), m, tell; None of fewer than twenty.

    Of a slow craft the noise of the positions hides whether it stands (`rests`).
    """
    t = (stamps_ns - stamps_ns[0]) / NS_PER_S if len(stamps_ns) else np.zeros(0)
    step = max(1, round(_WINDOW_S / float(np.median(np.diff(t))))) if len(t) > 1 else 1
    if len(t) < max(20, step + 2):
        return None
    v = (p_m[step:, :2] - p_m[:-step, :2]) / (t[step:] - t[:-step])[:, None]
    speed = np.interp(t, (t[step:] + t[:-step]) / 2.0, np.hypot(v[:, 0], v[:, 1]))
    fast = float(np.percentile(speed, 90)) > _FAST_MPS
    return MeasuredMotion(source, int(stamps_ns[0]), t, speed, p_m[:, 0] + 1j * p_m[:, 1], rests=fast)


def _by_turns(
    stamps_ns: NDArray[np.int64],
    p_m: Array,
    rows: Array,
    known: NDArray[np.bool_],
    sigmas_m: Array,
    fixed: NDArray[np.bool_],
) -> tuple[PartOfFixes, PartOfFixes] | None:
    """Return summaries of the RTK fixes and of the others; None where nearly all fixes are of one of these kinds.

    Args:
        stamps_ns, p_m, rows: (N,), (N, 3) m and (N, 8) of the fixes.
        known: (N,) whether a fix states its noise. sigmas_m: (N,) its horizontal sigma, stated or by default.
        fixed: (N,) whether a fix is of RTK.
    """
    if not _EITHER <= fixed.mean() <= 1.0 - _EITHER:
        return None

    def part(of: NDArray[np.bool_]) -> PartOfFixes:
        told = of & known
        # The slow error of an RTK float is as large as its claimed sigma. Without RTK, claims are of the white noise,
        # or too small, so the default is taken.
        default_m = SlowErrorConfig().horizontal_sigma_m
        slow_m = np.where(rows[of, 3] >= 2.0, np.minimum(sigmas_m[of], default_m), default_m)
        return PartOfFixes(
            share=float(of.mean()),
            sigma_m=vec(np.sqrt(np.median(rows[told, 5:8], axis=0))) if told.any() else None,
            white_m=scatter_m(stamps_ns[of], p_m[of, :2]),
            slow_m=float(np.percentile(slow_m, 95)),
        )

    return part(fixed), part(~fixed)


def gnss_report(fixes: TopicData, tf_frame: str | None) -> GnssReport | None:
    """Return status, spread and a guess on slow errors of a receiver's fixes; None where there is no good fix."""
    stamps, p, rows = track(fixes)
    if len(stamps) == 0:
        return None
    status, counts = np.unique(fixes.rows[:, 3].astype(int), return_counts=True)
    known = (rows[:, 4] > 0) & np.isfinite(rows[:, 5:8]).all(axis=1) & (rows[:, 5:8] > 0.0).all(axis=1)
    sigma = np.sqrt(np.median(rows[known, 5:8], axis=0)) if known.any() else None
    sigmas = np.where(
        known, np.sqrt(np.where(known, rows[:, 5:7].max(axis=1), 0.0)), GnssConfig().default_horizontal_sigma_m
    )
    fixed = known & (sigmas < RTK_SIGMA_M) & (rows[:, 3] >= 2.0)
    every, places = _placed(fixes)
    old = stored(fixes.stamps_ns[every], places[:, :3])
    bad = frozen_fixes(stamps, rows[:, :2], p[:, :2])
    own = p[~bad]
    scatter = white_noise(own) if len(own) > 10 else None
    chords = np.diff(p[:: max(1, len(p) // 400), :2], axis=0)
    precise = sigma is not None and float(sigma[:2].max()) < RTK_SIGMA_M and float(np.median(rows[:, 3])) >= 2.0
    if precise:
        told = "quality 4 (RTK, fixed)," if of_nmea(fixes.topic) else "status gbas (RTK) and a reported"
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
        roams_m=float(np.hypot(*np.subtract(*np.percentile(p[:, :2], [90, 10], axis=0)))),
        first=vec(rows[0, :3]),
        without_place=int((fixes.rows[sane(fixes), 3] >= 0).sum()) - len(every),
        outliers=len(every) - int(old.sum()) - len(stamps),
        without_height=int(np.isnan(fixes.rows[every[np.isin(fixes.stamps_ns[every], stamps)], 2]).sum()),
        white_m=scatter_m(stamps[~bad], own[:, :2]),
        uneven=uneven(stamps[~bad], own),
        spans_s=float(stamps[-1] - stamps[0]) / NS_PER_S,
        frozen="".join(frozen_fixes_warning(fixes.topic, stamps, bad)),
        stored="".join(stored_warning(fixes.topic, places[:, :3], old)),
        in_radians="".join(radians_warning(fixes.topic, rows[:, :3])),
        slow_error=not precise,
        by_turns=_by_turns(stamps[~bad], own, rows[~bad], known[~bad], sigmas[~bad], fixed[~bad]),
        why=why,
        frame_id=fixes.frame_id,
        tf_frame=tf_frame,
    )
