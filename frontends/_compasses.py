# SPDX-License-Identifier: Apache-2.0
"""Headings of a bag beside the gyroscope of its best IMU: how late they are, how they wander, which repeat another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.frames import Array, wrap_angle
from graphloc.frontends._assess import Courses, MeasuredMotion
from graphloc.frontends._assess_compass import compass_report, headings, in_enu, mounted, says_the_same
from graphloc.frontends._assess_imu import Inertial
from graphloc.frontends._contents import Contents
from graphloc.frontends._receivers import Late, receiver_of
from graphloc.frontends._reports import CompassReport, ImuReport, filtered
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends._turns import SCATTERED, deviation_deg, scattered, wander_deg
from graphloc.frontends.msgtypes import IMU, NUMBERS, QUATERNION
from graphloc.frontends.time_offsets import heading_time_offset
from graphloc.frontends.turning import Turning, against_turning
from graphloc.measurements import CompassHeading
from graphloc.signals.series import runs
from graphloc.time import NS_PER_S

_NONE: Late = {}
_FEWEST = 20  # least number of positions
_NO_HEADING_DEG = 20.0  # wander within a minute from which the motion tells the heading better; a choice
_HELD_RAD = np.radians(5.0)  # a compass that repeats its heading while the craft turns by more is held
_OWN_NORTH_DEG = 20.0  # offset from a multiple of 90 deg that is more than declination and leeway in most places


class _Heading(NamedTuple):
    """An orientation that may be a heading: its report, and its stream with the stamps to which the report refers."""

    report: CompassReport
    stream: TopicData

    def same_as(self, other: _Heading) -> bool:
        mirrored = self.report.convention != other.report.convention
        return says_the_same(self.stream, other.stream, mirrored=mirrored)


def compasses_of(
    bag: Contents,
    courses: Courses | None,
    best: Inertial | None,
    imus: Sequence[ImuReport],
    together: Late = _NONE,
) -> tuple[CompassReport, ...]:
    """Report every orientation that may be a heading, in the order of `_without_echoes`.

    Args:
        bag: what was read. courses: of the fixes; None without fixes. best: the best IMU; None without an IMU.
        imus: their reports, with the mounts of those that say an orientation.
        together: how late fixes are, by receiver, for headings of the same messages.
    """
    turning = None if best is None else best.felt.turning
    mounts = {imu.topic: imu.mount for imu in imus}
    turned = {}
    candidates = []
    for stream in bag.of_type(QUATERNION, IMU, *NUMBERS):
        mount = mounts.get(stream.topic)
        in_body = mounted(stream, mount) if mount else None
        if in_body is not None:
            turned[stream.topic] = mount
        candidates.append(in_body or stream)
    timed = (_timed(s, courses, turning, together.get(receiver_of(s.topic))) for s in candidates)
    found = _without_echoes([heading for heading in timed if heading])
    reports = (_beside_gyro(heading, best) if best else heading.report for heading in found)
    return tuple(replace(report, mount=turned.get(report.topic)) for report in reports)


def _timed(
    stream: TopicData, courses: Courses | None, turning: Turning | None, fixes_late_s: tuple[float, float] | None
) -> _Heading | None:
    """Report an orientation with its stamps corrected by the gyroscope; None if it is none.

    If the gyroscope shows no delay, stamps are corrected by the delay of the fixes of the same messages, unless the
    gyroscope then shows one.
    """
    report = compass_report(stream, courses, turning)
    if report is None:
        return None
    as_stamped = _Heading(report, stream)
    if turning is None or not report.usable:
        return as_stamped
    stamps, angle = headings(stream)
    angle = angle if report.convention == "enu" else -angle
    own_s = heading_time_offset(turning, stamps, angle)
    late_s = own_s or fixes_late_s
    if late_s is None:
        return as_stamped
    by_ns = round(late_s[0] * NS_PER_S)
    if own_s is None and heading_time_offset(turning, stamps + by_ns, angle) is not None:
        return as_stamped
    timed = stream.later(by_ns)
    again = compass_report(timed, courses, turning)
    if again is None or not again.usable:
        return as_stamped
    return _Heading(replace(again, late_s=late_s, late_with_fixes=own_s is None), timed)


def _without_echoes(compasses: Sequence[_Heading]) -> list[_Heading]:
    """Return the headings; one that repeats an earlier one names it in `like`.

    Types without a stamp come last but for filters' outputs.
    """
    distinct: list[_Heading] = []
    found = []
    for report, stream in sorted(compasses, key=lambda h: (filtered(h.report.topic), h.stream.msgtype in NUMBERS)):
        heading = _Heading(report, stream)
        like = next((h.report.topic for h in distinct if h.same_as(heading)), "") if report.usable else ""
        if report.usable and not like:
            distinct.append(heading)
        found.append(_Heading(replace(report, like=like), stream))
    return found


def _beside_gyro(heading: _Heading, best: Inertial) -> CompassReport:
    """Return the report with wander, deviation and the number of scattered headings, beside the gyroscope of the best IMU.

    A heading that wanders too far, though on the whole it turns as the gyroscope does, is a course over ground: it
    follows the vessel sideways, and is arbitrary at rest. A compass that hangs for a while is still a heading.
    """
    report, stream = heading
    if not report.usable:
        return report
    stamps, angle = headings(stream)
    measured = [
        CompassHeading(stamp_ns=int(s), sensor=stream.topic, seq=0, yaw_rad=float(y), sigma_rad=1.0)
        for s, y in zip(stamps, wrap_angle(in_enu(angle, report.convention)), strict=True)
    ]
    bad, wander = scattered(best.series, measured), wander_deg(best.series, measured)
    report = replace(report, wander_deg=wander, deviation_deg=deviation_deg(best.series, measured))
    left_out = bad | _held(best.felt.turning, stamps, angle)
    most = [m for m, off in zip(measured, left_out, strict=True) if not off]
    steady_deg = min(wander or 0.0, wander_deg(best.series, most) or 0.0)
    if steady_deg > _NO_HEADING_DEG and against_turning(best.felt.turning, stamps, angle):
        why = f"it wanders by {steady_deg:.0f} deg (1 sigma) beside the integrated gyro, as a course over ground does, which is no heading"
        return replace(report, usable=False, why=why)
    return replace(report, why=f"{report.why}; {bad.sum()} of {len(measured)}: {SCATTERED}") if bad.any() else report


def _held(turning: Turning, stamps_ns: NDArray[np.int64], angle: Array) -> NDArray[np.bool_]:
    """Return (N,) which headings repeat the preceding one while the craft turns.

    Args:
        turning: the integrated gyroscope. stamps_ns, angle: (N,), rad.
    """
    turned = np.interp((stamps_ns - turning.origin_ns) / NS_PER_S, turning.t_s, turning.turned_rad)
    held = np.append(False, np.diff(angle) == 0.0)
    for first, after in runs(held):
        held[first:after] &= np.ptp(turned[first - 1 : after]) > _HELD_RAD
    return held


def with_own_north(compass: CompassReport, imus: Sequence[ImuReport]) -> CompassReport:
    """Return the report with `drifts`, if it is an IMU's own orientation that counts from where it was switched on.

    So does one without a magnetometer. An orientation that knows north is off the course by the yaw of the IMU's mount,
    up to a multiple of 90 deg, as it may count from east or north.
    """
    own = next((imu for imu in imus if imu.topic == compass.topic), None)
    if own is None or not compass.usable or compass.offset_deg is None or compass.two_antennas:
        return compass
    x_deg = own.mount.rpy_deg[2] if own.mount.yaw_told and compass.mount is None else 0.0
    off_deg = compass.offset_deg - x_deg
    return replace(compass, drifts=abs(off_deg - 90.0 * round(off_deg / 90.0)) > _OWN_NORTH_DEG)


def by_quarters(compass: CompassReport) -> CompassReport:
    """Return the report of a compass that is mounted along or athwart the craft, whatever the courses say."""
    return replace(compass, offset_deg=90.0 * round((compass.offset_deg or 0.0) / 90.0))


def set_sideways(compass: CompassReport) -> CompassReport:
    """Return the report of a compass whose offset from the courses is a current's or leeway's."""
    quarter_deg = by_quarters(compass).offset_deg or None
    why = f"{compass.why}; by what the IMU feels she is set sideways"
    return replace(compass, offset_deg=quarter_deg, leeway_deg=None, why=why)


def headed(motion: MeasuredMotion, compass: CompassReport, stream: TopicData) -> MeasuredMotion | None:
    """Return a motion with the attitude by a compass as it is drafted, while it has headings; None of few positions.

    Courses tell the heading only of a craft that goes ahead, not of a ferry with two bows.
    """
    late_ns = round(compass.late_s[0] * NS_PER_S) if compass.late_s else 0
    stamps, angle = headings(stream)
    yaw = in_enu(angle, compass.convention) - np.radians(compass.turned_deg)
    t_s = (stamps + late_ns - motion.origin_ns) / NS_PER_S
    inside = (motion.t_s >= t_s[0]) & (motion.t_s <= t_s[-1])
    if motion.way_m is None or inside.sum() < _FEWEST:
        return None
    at_s = motion.t_s[inside]
    attitude = Rotation.from_euler("z", np.interp(at_s, t_s, yaw)[:, None])
    kept = {"t_s": at_s, "speed_mps": motion.speed_mps[inside], "way_m": motion.way_m[inside]}
    return replace(motion, source=f"{motion.source} beside the heading of {compass.topic}", attitude=attitude, **kept)
