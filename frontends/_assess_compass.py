# SPDX-License-Identifier: Apache-2.0
"""Assess a compass: whether an orientation is a heading, in which convention, and its offset from the course."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.frames import Array, rotation_from_rpy_deg, wrap_angle
from graphloc.frontends._assess import Courses, attitudes, one_way, sane
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._reports import CompassReport, MountGuess, two_antennas
from graphloc.frontends._standard import MOST_TURNS, yaw_of_x_axis
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.msgtypes import IMU, NUMBERS, QUATERNION
from graphloc.frontends.turning import Turning, against_turning, follows_turning
from graphloc.signals.series import robust_sigma
from graphloc.time import NS_PER_S

_FEWEST, _FEWEST_COURSES = 10, 20
_TURNS_DEG, _SAME_DEG = 5.0, 0.2  # two topics are one heading if it turns by more than this, and they differ by less
_DELAYS_S = np.arange(-50, 51) / 100.0  # delays that are tried between two topics of one heading
_MOST_COMPARED = 5000  # most headings of a run that are compared
_STRAIGHT_DEG = 20.0  # courses that turn by less tell no convention
_GAP_S, _GAP = 2.0, 3.0  # a gap in headings is longer than this, and than so many times the median interval
_ASKEW_DEG = 15.0  # two antennas lie along the vessel or athwart, within this
# Blocks whose median is taken: waves and short turns average out, and a minute and a half tells a wander; a choice.
_BLOCK_S = 30
_SCATTERS_DEG = 15.0  # scatter of a heading about the course, from which the course is no test of it
_SIDEWAYS_DEG = 45.0  # scatter up to which courses still tell by which quarter turn two antennas are mounted
# Of a vessel that goes ahead and astern: least share of the courses either way; largest share of courses at which it
# changes between them; share from which the way that it mostly goes is ahead, even if the heading says astern.
_EITHER_WAY, _OFTEN, _MOST = 0.15, 0.1, 0.6
_LEVEL_DEG = 3.0  # tilt of an x axis up to which a roll of 10 deg changes its yaw by no more than half a degree
_RELATIVE_DEG = 30.0  # offset from the course, from which the orientation of an IMU has a north of its own


class _Conventions(NamedTuple):
    """Conventions of a heading: by its type, by the gyroscope, and by default of a maker's driver; None if not told."""

    told: str | None
    by_gyro: str | None
    usual: str | None


def compass_report(stream: TopicData, courses: Courses | None, turning: Turning | None) -> CompassReport | None:
    """Return whether an orientation is a heading, and in which convention; None where there is no orientation.

    Args:
        stream: an orientation, IMU or bare number. courses: of the fixes; None without fixes.
        turning: the integrated gyroscope; None without an IMU.
    """
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


def mounted(stream: TopicData, mount: MountGuess) -> TopicData | None:
    """Return an IMU's orientations turned into the axes of the body; None where that changes no yaw, or is not meant.

    Where the mount tilts the sensor's x axis by p, a roll of the craft by r turns that axis by r tan(p), and not the craft.
    Some drivers say the orientation of the craft, whatever the axes of their samples: it is level without the mount.

    Args:
        mount: of the IMU of this topic.
    """
    R = rotation_from_rpy_deg(np.array(mount.rpy_deg))
    if stream.msgtype != IMU or abs(R[2, 0]) < np.sin(np.radians(_LEVEL_DEG)):
        return None
    quaternions = stream.rows[:, 6:10]
    told = attitudes(quaternions)
    told[told] = [not isinstance(yaw_of_x_axis(*q), Rejection) for q in quaternions[told].tolist()]
    if told.sum() < _FEWEST:
        return None
    said = Rotation.from_quat(quaternions[told])
    body = said * Rotation.from_matrix(R.T)
    if np.median(np.abs(body.as_matrix()[:, 2, 2])) < np.median(np.abs(said.as_matrix()[:, 2, 2])):
        return None
    rows = stream.rows.copy()
    rows[:, 6:10] = 0.0  # no orientation
    rows[told, 6:10] = body.as_quat()
    rows.flags.writeable = False
    return replace(stream, _rows=rows)


def _without_courses(report: CompassReport, known: _Conventions, heard: Courses | None) -> CompassReport:
    """Return the report of a heading at whose times there are no courses, or too few.

    Only a topic of bare orientations is usable without courses: it is meant as a compass.
    """
    why = "no GNSS course in motion to check it against"
    if heard is not None and not len(heard.stamps_ns) and report.msgtype in NUMBERS:
        why = "no GNSS course in motion at the times it was recorded (it has no stamp)"
    elif known.by_gyro and not known.told:
        why += ", convention from the gyro"
    convention = known.told or known.by_gyro or report.convention
    usable = report.msgtype == QUATERNION
    if not usable:
        why += f"; if it counts from north, as of a magnetometer or two antennas, add a sensor of kind: compass, topic: {report.topic}"
    return replace(report, usable=usable, convention=convention, why=why)


def _by_courses(
    report: CompassReport, known: _Conventions, fit: _Fit, courses: Courses, *, follows: bool
) -> CompassReport:
    """Return the report of a heading that was compared with the courses of the fixes.

    Courses confirm the heading of a vessel that goes ahead. Where a vessel is set sideways, only the gyroscope can
    confirm it, though not that of an IMU: its orientation follows the gyroscope wherever its north is. Two antennas
    know north; an Imu message with an orientation alone is taken for two antennas. Mounted athwart, they are a quarter
    turn off. Another heading that is a quarter turn off the courses, to either side, is of a vessel that swings, as at
    anchor, rather than of a compass mounted athwart on a vessel that goes ahead and astern.

    Args:
        report: as it is without courses. known: its conventions. fit, courses: of `_beside_courses`.
        follows: whether the heading turns as the gyroscope does, though not as the courses do.
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
        one_way=one_way(courses.course_rad),
        samples=len(fit.apart_rad),
        why=_why(fit, known, sideways=sideways),
    )
    if sideways and not quarter:  # no course tells how the compass is mounted
        return report
    leeway_deg = _wanders_deg(courses.stamps_ns, _ahead(fit.apart_rad, np.radians(fit.offset_deg)))
    return replace(report, offset_deg=fit.offset_deg, leeway_deg=leeway_deg)


def _of_two_antennas(stream: TopicData, rows: Array) -> bool:
    """Return whether a heading is from two GNSS antennas.

    Drivers of such receivers send an Imu message with the orientation alone.
    """
    if stream.part is not None:
        return stream.part.antennas
    return not rows[:, :6].any() if stream.msgtype == IMU else two_antennas(stream.topic)


def _left_out(stream: TopicData, rows: Array) -> bool:
    """Return whether an IMU says that it has no orientation, or has the same one always."""
    if stream.msgtype != IMU:
        return False
    return float(np.median(rows[:, 12])) == -1.0 or len(np.unique(_quaternions(stream, rows), axis=0)) < 3


def _heard(courses: Courses | None, stamps_ns: NDArray[np.int64]) -> Courses | None:
    """Return the courses at whose times there are headings, at stamps (N,), rather than a gap; None without courses."""
    if courses is None:
        return None
    after = np.searchsorted(stamps_ns, courses.stamps_ns)
    apart_ns = np.diff(stamps_ns)
    longest_ns = max(_GAP_S * NS_PER_S, _GAP * float(np.median(apart_ns)))
    within = np.append(np.append(False, apart_ns <= longest_ns), False)[after]
    return Courses(courses.stamps_ns[within], courses.course_rad[within])


def in_enu(angle: Array, convention: str) -> Array:
    """Return headings (N,), rad, in a convention ('enu' or 'ned') as yaw from east, counter-clockwise."""
    return angle if convention == "enu" else np.pi / 2.0 - angle


class _Fit(NamedTuple):
    """A heading beside the courses of the fixes.

    Attributes:
        convention: the one in which the heading was compared.
        offset_deg, scatter_deg: median of heading minus course, and 1 sigma about it.
        astern: share of the courses on which the vessel goes astern, where it goes ahead and astern; else 0.
        apart_rad: (M,) heading minus course, at each course.
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
        """Whether the courses confirm the heading."""
        return self.scatter_deg < _SCATTERS_DEG


def _beside_courses(stamps_ns: NDArray[np.int64], angle: Array, courses: Courses, known: _Conventions) -> _Fit:
    """Return how a heading fits the courses, in the convention that its type or the gyroscope tells, or that fits best.

    Args:
        stamps_ns, angle: (N,) stamps; (N,) headings as the messages say them, rad, unwrapped.
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
        # On a straight track both conventions fit with some offset. The smaller one is likelier; of a driver that has a
        # usual convention, one near a multiple of 90 deg, then the smaller multiple, then the usual convention.
        if known.usual is None:
            return (abs(offset_deg),)
        askew = abs((offset_deg + 45.0) % 90.0 - 45.0) > _ASKEW_DEG
        return askew, round(abs(offset_deg) / 90.0), convention != known.usual

    convention = known.told or known.by_gyro or min(fits, key=unlikely)
    return _Fit(convention, *fits[convention], apart[convention], straight)


def _beside_either_way(apart: Array) -> tuple[float, float, float]:
    """Return the median of heading minus course, its scatter (1 sigma), and the share of courses that go astern.

    A vessel that goes ahead and astern, for a while each, has two medians, half a turn apart. The one of clearly more
    courses is the offset of the heading; if neither has clearly more, the one nearer to 0.

    Args:
        apart: (N,) heading minus course, rad.

    Returns:
        Median and scatter, deg; the share, 0 where the vessel goes one way.
    """
    offset_deg, scatter_deg = _middle_deg(apart)
    twice_deg, twice_scatter_deg = _middle_deg(2.0 * apart)
    bow_deg = 0.5 * twice_deg  # that of the two medians within 90 deg of 0
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
    """Return the likely unit of a stream of bare numbers that are headings; None of another type of stream."""
    if stream.msgtype not in NUMBERS:
        return None
    known = np.abs(stream.rows[np.isfinite(stream.rows)])
    # The 95 % point, not the largest: a driver may say -999 while it has no heading.
    return "rad" if len(known) and float(np.percentile(known, 95)) < 2.0 * np.pi + 0.1 else "deg"


def _quaternions(stream: TopicData, rows: Array) -> Array:
    if unit := unit_of(stream):
        angle = np.radians(rows[:, 0]) if unit == "deg" else rows[:, 0]
        half = np.where(np.abs(angle) <= MOST_TURNS * 2.0 * np.pi, angle, np.nan) / 2.0
        return np.column_stack([0.0 * half, 0.0 * half, np.sin(half), np.cos(half)])
    return rows[:, 6:10] if stream.msgtype == IMU else rows[:, :4]


def headings(stream: TopicData) -> tuple[NDArray[np.int64], Array]:
    """Return the stamps (N,) and unwrapped yaws (N,), rad, of messages that say one, in their own convention."""
    keep = sane(stream)
    yaw = [yaw_of_x_axis(*(float(v) for v in q)) for q in _quaternions(stream, stream.rows[keep])]
    good = np.array([not isinstance(y, Rejection) for y in yaw], dtype=bool)
    return stream.stamps_ns[keep][good], np.unwrap(np.array([y for y in yaw if not isinstance(y, Rejection)]))


def says_the_same(first: TopicData, second: TopicData, *, mirrored: bool) -> bool:
    """Return whether two topics hold one heading, but for an offset and a delay.

    Two devices never agree so closely while the craft turns. Messages of a type without a stamp are late by their way
    to the recorder, and a driver may stamp messages by its own clock.

    Args:
        mirrored: whether one topic is clockwise and the other counter-clockwise.
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
    """Return a robust mean and standard deviation, deg, of angles (N,), rad: fixes may jump or be frozen."""
    mean = float(np.angle(np.exp(1j * angle).mean()))
    middle = mean + float(np.median(wrap_angle(angle - mean)))
    scatter = float(robust_sigma(wrap_angle(angle - middle)))
    return float(np.degrees(wrap_angle(middle))), float(np.degrees(scatter))


def _ahead(apart: Array, usual: float) -> Array:
    """Return headings minus courses (N,), rad, as if the craft had gone ahead where it goes astern.

    It goes astern where the difference is over 90 deg off `usual`, rad.
    """
    return usual + wrap_angle(2.0 * (apart - usual)) / 2.0


def _wanders_deg(stamps_ns: NDArray[np.int64], angle: Array) -> float | None:
    """Return how far medians of blocks of angles (N,), rad, differ, 1 sigma, deg; None of fewer than three blocks."""
    block = (stamps_ns - stamps_ns[0]) // (_BLOCK_S * NS_PER_S)
    own = [angle[block == k] for k in np.unique(block)]
    middles = np.radians([_middle_deg(part)[0] for part in own if len(part) >= 5])
    if len(middles) < 3:
        return None
    return float(np.degrees(np.std(wrap_angle(middles - middles[0]), ddof=1)))
