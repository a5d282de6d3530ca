# SPDX-License-Identifier: Apache-2.0
"""Assess a compass: whether an orientation is a heading, in which convention, and how far off the course."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, wrap_angle
from graphloc.frontends._assess import Courses, sane
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._reports import CompassReport, two_antennas
from graphloc.frontends._streams import TopicData
from graphloc.frontends.decode import IMU, MOST_TURNS, NUMBERS, QUATERNION, yaw_of_x_axis
from graphloc.frontends.turning import Turning, against_turning, follows_turning
from graphloc.signals.series import robust_sigma
from graphloc.time import NS_PER_S

_FEWEST, _FEWEST_COURSES = 10, 20
_TURNS_DEG, _SAME_DEG = 5.0, 0.2  # how much two headings must turn, and may differ by, to be one
_DELAYS_S = np.arange(-50, 51) / 100.0  # of one heading against another that is the same
_MOST_COMPARED = 5000  # headings of a long run
_GAP_S, _GAP = 2.0, 3.0  # between two headings, at least, and times what is usual: none came meanwhile
_STRAIGHT_DEG = 20.0  # courses that turn by less tell no convention
_ASKEW_DEG = 15.0  # antennas are mounted along a vessel or athwart, to this
_BLOCK_S = 30  # of which the middle is taken: waves and short turns average out, and a minute and a half tells a wander; a choice
_SCATTERS_DEG = 15.0  # of a heading about the course, from which the course is no test of it
_SIDEWAYS_DEG = 45.0  # to which scatter courses still tell by which quarter turn two antennas are mounted
# Of a vessel that goes ahead and astern: least share of the courses either way; how often it turns back; share of the way it goes mostly.
_EITHER_WAY, _OFTEN, _MOST = 0.15, 0.1, 0.6
_RELATIVE_DEG = 30.0  # off the course, from which an IMU's orientation has a north of its own


class _Conventions(NamedTuple):
    """What tells the convention of a heading: its type, the gyroscope, and what the maker's driver comes with; None where it does not."""

    told: str | None
    by_gyro: str | None
    usual: str | None


def compass_report(stream: TopicData, courses: Courses | None, turning: Turning | None) -> CompassReport | None:
    """Return whether an orientation is a heading, and in which convention; None where there is none."""
    keep = sane(stream)
    if len(keep) < _FEWEST or _left_out(stream, stream.rows[keep]):
        return None
    stamps_ns, angle = headings(stream)
    part = stream.part
    report = CompassReport(
        topic=stream.topic,
        msgtype=stream.msgtype,
        usable=False,
        convention="enu" if part is None or part.told else part.usual,
        offset_deg=None,
        scatter_deg=None,
        samples=0,
        why="its messages give no yaw",
        unit=unit_of(stream),
        two_antennas=_of_two_antennas(stream, stream.rows[keep]),
    )
    if len(stamps_ns) < _FEWEST:
        return report
    known = _Conventions(
        told="enu" if part is not None and part.told else None,
        by_gyro={1: "enu", -1: "ned"}.get(against_turning(turning, stamps_ns, angle)),
        usual=None if part is None else part.usual,
    )
    heard = _heard(courses, stamps_ns)
    if heard is None or len(heard.stamps_ns) < _FEWEST_COURSES:
        return _without_courses(report, known, heard)
    fit = _beside_courses(stamps_ns, angle, heard, known)
    judged = fit.good or known.by_gyro is None
    follows = not judged and follows_turning(turning, stamps_ns, in_enu(angle, fit.convention))
    return _by_courses(report, known, fit, heard, follows=follows)


def _without_courses(report: CompassReport, known: _Conventions, heard: Courses | None) -> CompassReport:
    """Return the report of a heading at whose times there are no courses, or few: a topic of bare orientations is meant as a compass."""
    why = "no GNSS course in motion to check it against"
    if heard is not None and not len(heard.stamps_ns) and report.msgtype in NUMBERS:
        why = "no GNSS course in motion at the times it was recorded (it has no stamp)"
    elif known.by_gyro and not known.told:
        why += ", convention from the gyro"
    convention = known.told or known.by_gyro or report.convention
    return replace(report, usable=report.msgtype == QUATERNION, convention=convention, why=why)


def _by_courses(
    report: CompassReport, known: _Conventions, fit: _Fit, courses: Courses, *, follows: bool
) -> CompassReport:
    """Return the report of a heading beside the courses of the fixes.

    Courses tell headings of a vessel that goes ahead; of one that is set sideways only the gyroscope tells whether it is one. But
    an IMU's own orientation follows the gyroscope wherever north is. Two antennas know north, and an Imu of an orientation alone is
    taken for such; athwart, they are a quarter turn off. Another heading that is a quarter turn off courses to either side is of a vessel that
    swings, as at anchor, rather than of one mounted athwart that goes ahead and astern.

    Args:
        follows: whether it turns as the gyroscope does, though not with the courses.
    """
    quarter = report.two_antennas and fit.scatter_deg < _SIDEWAYS_DEG and abs(abs(fit.offset_deg) - 90.0) < _ASKEW_DEG
    knows_north = report.msgtype != IMU or abs(fit.offset_deg) < _RELATIVE_DEG or quarter
    swings = bool(fit.astern) and abs(abs(fit.offset_deg) - 90.0) < _SIDEWAYS_DEG and not report.two_antennas
    sideways = knows_north and (follows or (fit.good and swings and report.msgtype != IMU))
    report = replace(
        report,
        usable=fit.good or sideways,
        convention=fit.convention,
        scatter_deg=fit.scatter_deg,
        samples=len(fit.apart_rad),
        why=_why(fit, known, sideways=sideways),
    )
    if sideways and not quarter:  # no course tells how it is mounted
        return report
    leeway_deg = _wanders_deg(courses.stamps_ns, _ahead(fit.apart_rad, np.radians(fit.offset_deg)))
    return replace(report, offset_deg=fit.offset_deg, leeway_deg=leeway_deg)


def _of_two_antennas(stream: TopicData, rows: Array) -> bool:
    """Return whether a heading is one of GNSS. Drivers of receivers with two antennas fill an Imu with the orientation alone."""
    if stream.part is not None:
        return stream.part.antennas
    return not rows[:, :6].any() if stream.msgtype == IMU else two_antennas(stream.topic)


def _left_out(stream: TopicData, rows: Array) -> bool:
    """Return whether an Imu says that it has no orientation, or always the same one."""
    if stream.msgtype != IMU:
        return False
    return float(np.median(rows[:, 12])) == -1.0 or len(np.unique(_quaternions(stream, rows), axis=0)) < 3


def _heard(courses: Courses | None, stamps_ns: NDArray[np.int64]) -> Courses | None:
    """Return the courses at whose times headings, at stamps (N,), came: not before, after or in a gap of them."""
    if courses is None:
        return None
    after = np.searchsorted(stamps_ns, courses.stamps_ns)
    apart_ns = np.diff(stamps_ns)
    longest_ns = max(_GAP_S * NS_PER_S, _GAP * float(np.median(apart_ns)))
    within = np.append(np.append(False, apart_ns <= longest_ns), False)[after]
    return Courses(courses.stamps_ns[within], courses.course_rad[within])


def in_enu(angle: Array, convention: str) -> Array:
    """Return headings (N,), rad, as yaw from east, counter-clockwise."""
    return angle if convention == "enu" else np.pi / 2.0 - angle


class _Fit(NamedTuple):
    """A heading beside the courses of the fixes.

    Attributes:
        offset_deg, scatter_deg: heading minus course: its middle, and 1 sigma about it. apart_rad: (M,) the same, of each course.
        astern: share of the courses on which the vessel goes astern, where it goes either way; else 0.
        straight: whether the courses turn too little to tell the convention.
    """

    convention: str
    offset_deg: float
    scatter_deg: float
    astern: float
    apart_rad: Array
    straight: bool

    @property
    def good(self) -> bool:
        """Whether it is a heading by that."""
        return self.scatter_deg < _SCATTERS_DEG


def _beside_courses(stamps_ns: NDArray[np.int64], angle: Array, courses: Courses, known: _Conventions) -> _Fit:
    """Return how a heading fits the courses, in the convention that its type or the gyroscope tells, or that fits best.

    Args:
        stamps_ns, angle: (N,) ns; (N,) rad, unwrapped.
    """
    origin = stamps_ns[0]
    measured = np.interp((courses.stamps_ns - origin) / NS_PER_S, (stamps_ns - origin) / NS_PER_S, angle)
    apart = {convention: in_enu(measured, convention) - courses.course_rad for convention in ("enu", "ned")}
    fits = {convention: _beside_either_way(off) for convention, off in apart.items()}
    turned = float(np.degrees(np.sqrt(max(0.0, -2.0 * np.log(max(abs(np.exp(1j * courses.course_rad).mean()), 1e-9))))))
    straight = turned < _STRAIGHT_DEG

    def unlikely(convention: str) -> tuple[float, ...]:
        offset_deg, scatter_deg, _ = fits[convention]
        if not straight:
            return (scatter_deg,)
        # On a straight both conventions fit with some offset: the smaller offset is likelier, of two antennas one of quarter turns.
        if known.usual is None:
            return (abs(offset_deg),)
        askew = abs((offset_deg + 45.0) % 90.0 - 45.0) > _ASKEW_DEG
        return askew, round(abs(offset_deg) / 90.0), convention != known.usual

    convention = known.told or known.by_gyro or min(fits, key=unlikely)
    return _Fit(convention, *fits[convention], apart[convention], straight)


def _beside_either_way(apart: Array) -> tuple[float, float, float]:
    """Return by how much a heading is off courses (N,), rad: middle and 1 sigma, deg, and on what share of them the vessel goes astern.

    One that goes ahead and astern, for a while each, has two middles, half a turn apart: that of most courses is how the heading is
    mounted, or, where neither is, that nearer to the bow.
    """
    offset_deg, scatter_deg = _middle_deg(apart)
    twice_deg, twice_scatter_deg = _middle_deg(2.0 * apart)
    bow_deg = 0.5 * twice_deg  # within 90 deg of it
    over = np.abs(wrap_angle(apart - np.radians(bow_deg))) > np.pi / 2.0
    share = float(over.mean())
    leaps = float((over[1:] != over[:-1]).mean()) if len(over) > 1 else 0.0
    if 0.5 * twice_scatter_deg > _SCATTERS_DEG or leaps > _OFTEN or not _EITHER_WAY < share < 1.0 - _EITHER_WAY:
        return offset_deg, scatter_deg, 0.0
    if share > (_MOST if abs(bow_deg) < _SIDEWAYS_DEG else 0.5):
        return float(np.degrees(wrap_angle(np.radians(bow_deg + 180.0)))), 0.5 * twice_scatter_deg, 1.0 - share
    return bow_deg, 0.5 * twice_scatter_deg, share


def _why(fit: _Fit, known: _Conventions, *, sideways: bool) -> str:
    why = f"yaw minus GNSS course: {fit.offset_deg:+.0f} deg, scatter {fit.scatter_deg:.0f} deg over {len(fit.apart_rad)} courses"
    if fit.astern:
        why += f", {100.0 * fit.astern:.0f} % of them astern"
    if sideways:
        return f"{why}: a vessel that often goes sideways, since it turns as the gyro does"
    if not fit.good:
        return f"{why}: a relative or a disturbed heading, or a vessel that often goes sideways"
    if known.told:
        return f"{why}; convention known by its type"
    if known.by_gyro:
        return f"{why}; convention from the gyro"
    return f"{why}, on a nearly straight track: the convention is not certain" if fit.straight else why


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
    """Return whether two headings are one, but for an offset and a delay: two devices never agree so closely while the craft turns.

    One of a type without a stamp is late by as long as its messages take, and a driver may stamp what it sends on its own.

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
    few = slice(None, None, max(1, len(there) // _MOST_COMPARED))
    t, at_s, b = (there[few] - at[0]) / NS_PER_S, (at - at[0]) / NS_PER_S, b[few]

    def apart_deg(late_s: float) -> float:
        beside = np.interp(t - late_s, at_s, a)
        return _middle_deg(beside + b if mirrored else beside - b)[1]

    return _middle_deg(b)[1] > _TURNS_DEG and min(map(apart_deg, _DELAYS_S)) < _SAME_DEG


def _middle_deg(angle: Array) -> tuple[float, float]:
    """Return a robust mean and standard deviation of angles (N,), deg: fixes may jump or be frozen."""
    mean = float(np.angle(np.exp(1j * angle).mean()))
    middle = mean + float(np.median(wrap_angle(angle - mean)))
    scatter = float(robust_sigma(wrap_angle(angle - middle)))
    return float(np.degrees(wrap_angle(middle))), float(np.degrees(scatter))


def _ahead(apart: Array, usual: float) -> Array:
    """Return headings minus courses (N,), rad, as if the craft went ahead where it goes astern: there it is over 90 deg off `usual`."""
    return usual + wrap_angle(2.0 * (apart - usual)) / 2.0


def _wanders_deg(stamps_ns: NDArray[np.int64], angle: Array) -> float | None:
    """Return how far the middle of angles (N,), rad, differs from block to block, 1 sigma, deg; None of fewer than three."""
    block = (stamps_ns - stamps_ns[0]) // (_BLOCK_S * NS_PER_S)
    own = [angle[block == k] for k in np.unique(block)]
    middles = np.radians([_middle_deg(part)[0] for part in own if len(part) >= 5])
    if len(middles) < 3:
        return None
    return float(np.degrees(np.std(wrap_angle(middles - middles[0]), ddof=1)))
