# SPDX-License-Identifier: Apache-2.0
"""Assess an IMU: units, gravity, standstill, noise; its mount (`_assess_mount`), corrected by how it turns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import STANDARD_GRAVITY_MPS2, ImuConfig
from graphloc.frames import Array, rotation_from_rpy_deg, rpy_from_rotation, wrap_angle, yaw_from_rotation
from graphloc.frontends import _clock, _order
from graphloc.frontends._assess import MeasuredMotion, attitudes, vec
from graphloc.frontends._assess_mount import (
    ImuEvidence,
    ImuSamples,
    in_place_of,
    levelling,
    measured_mount,
    mount_guess,
    mount_turned,
    mount_yaw,
    tilt_of,
    yawed,
)
from graphloc.frontends._mount_yaw import Felt, yaw_in_craft
from graphloc.frontends._reports import ImuReport
from graphloc.frontends._sanity import (
    HALF,
    NEVER_STILL_RADPS,
    missing_half,
    no_gravity_in_si,
    saturation_warning,
    size_at_ease,
    slow_warning,
)
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends._turns import Yaws, unit_of_turns
from graphloc.frontends.turning import Turning, course_against_turning, left_of_turns
from graphloc.measurements import ImuSeries
from graphloc.signals.frozen_imu import frozen_imu_warning, frozen_samples
from graphloc.signals.imu_spikes import spike_warning, spikes
from graphloc.signals.rates_in_degrees import turns_gravity, without_gravity
from graphloc.signals.series import integral, runs
from graphloc.signals.white_noise import white_noise
from graphloc.time import NS_PER_S

_LEFT_OF_TURNS = 0.5  # largest share of a course's changes that turning about the right axis leaves unexplained
# Angle between gravity, by the mount in tf, and body z, from which the IMU is upside down. No mount is off by 30 deg
# unnoticed, but one may be by 180; a choice.
_UPSIDE_DOWN_DEG = 150.0
# Share of what courses leave unexplained of the IMU's accelerations, below which headings explain them far better; angle up to which a
# mount is a quarter turn.
_FAR_BETTER, _BY_QUARTERS_DEG = 0.8, 12.0
# Least number of quiet seconds in a row at standstill; a craft that only changes between ahead and astern is slow for a
# shorter time than the second.
_QUIET_S, _STANDS_S = 2, 1.5


def samples_of(imu: TopicData) -> tuple[NDArray[np.intp], list[str]]:
    """Return the indices of usable samples, sorted by stamp, and warnings on frozen samples, which are left out."""
    good = np.flatnonzero(~_clock.clock_jumps(imu.stamps_ns, imu.logs_ns))
    keep = good[_order.in_order_or_late(imu.stamps_ns[good])]
    keep = keep[np.argsort(imu.stamps_ns[keep], kind="stable")]
    bad = frozen_samples(imu.stamps_ns[keep], imu.rows[keep, :6] if len(keep) else np.zeros((0, 6)))
    return keep[~bad], frozen_imu_warning(imu.topic, imu.stamps_ns[keep], bad)


def turned_as_headed(
    imu: TopicData, report: ImuReport, evidence: ImuEvidence, headed: Sequence[MeasuredMotion]
) -> ImuReport:
    """Return the report with the mount's yaw by headings, where courses do not tell it.

    Courses do not where a craft goes ahead and astern.

    Args:
        imu, report: an IMU and its report. evidence: see `ImuEvidence`.
        headed: how the craft moved, with the heading.
    """
    if report.mount.yaw_told or not headed:
        return report
    in_body = ImuSamples(imu.frame_id, *_in_body(_series_of(imu, report), report, evidence))
    yaw, sigma, said = mount_yaw(in_body, headed)
    if yaw is None:
        return report
    rpy = yawed(yaw, rotation_from_rpy_deg(np.array(report.mount.rpy_deg)))
    told = f"{report.mount.evidence}; but from there {said}"
    sigma = float(np.hypot(report.mount.yaw_sigma_deg, sigma))  # that of a levelled mount, if the craft listed
    return replace(report, mount=replace(report.mount, rpy_deg=rpy, evidence=told, yaw_told=True, yaw_sigma_deg=sigma))


def turned_as_set(
    imu: TopicData, report: ImuReport, evidence: ImuEvidence, headed: Sequence[MeasuredMotion]
) -> ImuReport:
    """Return the report with a mount by quarter turns, where headings explain what the IMU feels far better than courses.

    Then courses are not where she heads: a current or leeway sets her, or she goes sideways. By these alone the IMU seemed
    turned by as much.

    Args:
        imu, report, evidence: as of `turned_as_headed`. headed: how the craft moved, with the heading by quarter turns.
    """
    if not report.mount.yaw_told or report.mount.tf_frame is not None or not headed:
        return report
    in_body = _in_body(_series_of(imu, report), report, evidence)
    by_course, found = (yaw_in_craft(*in_body, motions) for motions in (evidence.motions, headed))
    if by_course is None or found is None or not found.clear:
        return report
    R = rotation_from_rpy_deg(np.array(report.mount.rpy_deg))
    now_deg = float(np.degrees(yaw_from_rotation(R)))
    quarter = 90.0 * round((now_deg + found.yaw_deg) / 90.0)
    turn_deg = float(np.degrees(wrap_angle(np.radians(quarter - now_deg))))
    explained = 1.0 - found.coherence < _FAR_BETTER * (1.0 - by_course.coherence)
    if not explained or abs(turn_deg - found.yaw_deg) > _BY_QUARTERS_DEG:
        return report
    if abs(turn_deg) < _BY_QUARTERS_DEG and not report.mount.yaw_sigma_deg:
        return report
    sigma_deg = (
        report.mount.yaw_sigma_deg if report.mount.tilt_sigma_deg else 0.0
    )  # that of a craft that perhaps listed
    said = (
        f"{report.mount.evidence}; but {now_deg + found.yaw_deg:z.0f} deg by {found.source} (coherence {found.coherence:.2f}): she is set "
        f"sideways, taken as {now_deg + turn_deg:z.0f}"
    )
    mount = replace(report.mount, rpy_deg=yawed(turn_deg, R), evidence=said, yaw_sigma_deg=sigma_deg)
    return replace(report, mount=mount)


class Inertial(NamedTuple):
    """What an IMU tells: the motion that it feels, in axes of the vessel, and its usable samples, in its own axes."""

    felt: Felt
    series: ImuSeries


def inertial_of(imu: TopicData, report: ImuReport, evidence: ImuEvidence) -> Inertial:
    """Return what an IMU tells, with the mount of its report."""
    series = _series_of(imu, report)
    gravity_mps2 = 0.0 if report.gravity == "removed" else STANDARD_GRAVITY_MPS2
    return Inertial(Felt.of(*_in_body(series, report, evidence), gravity_mps2), series)


def feels_motion(imu: TopicData, report: ImuReport, evidence: ImuEvidence) -> bool:
    """Return whether an IMU turns as the courses do, or clearly feels how the craft moves, whatever its mount's yaw."""
    if _against_courses(imu, report, evidence) > 0:
        return True
    found = yaw_in_craft(*_in_body(_series_of(imu, report), report, evidence), evidence.motions)
    return found is not None and found.clear


def _turning_of(imu: TopicData, report: ImuReport, evidence: ImuEvidence) -> Turning:
    """Return the integrated yaw rate of an IMU, with the mount of its report and without its gyro bias, if known."""
    stamps, _, gyro = _in_body(_series_of(imu, report), report, evidence)
    t = (stamps - stamps[0]) / NS_PER_S
    return Turning(int(stamps[0]), t, integral(t, gyro[:, 2]))


def _in_body(series: ImuSeries, report: ImuReport, evidence: ImuEvidence) -> tuple[NDArray[np.int64], Array, Array]:
    """Return stamps (N,), accelerations (N, 3), m/s^2, and rates (N, 3), rad/s, in the axes of the vessel.

    The rates are without the gyro bias, if it is known.
    """
    known = evidence.pose_of(report.mount.tf_frame)
    R = known[1] if known else rotation_from_rpy_deg(np.array(report.mount.rpy_deg))
    unbiased = series.gyro_radps - (report.gyro_bias_radps or (0.0, 0.0, 0.0))
    return series.stamps_ns, series.accel_mps2 @ R.T, unbiased @ R.T


def _series_of(imu: TopicData, report: ImuReport) -> ImuSeries:
    """Return the usable samples of an IMU in SI units, by its report, and in the axes of the sensor."""
    keep, _ = samples_of(imu)
    keep = keep[np.isfinite(imu.rows[keep, :6]).all(axis=1)]
    unit = STANDARD_GRAVITY_MPS2 if report.accel_unit == "g" else 1.0
    return ImuSeries(
        sensor=imu.topic,
        stamps_ns=imu.stamps_ns[keep],
        accel_mps2=imu.rows[keep, :3] * (-unit if report.gravity == "inverted" else unit),
        gyro_radps=imu.rows[keep, 3:6] * (np.pi / 180.0 if report.gyro_unit == "deg/s" else 1.0),
        seqs=keep.astype(np.int64),
    )


def _against_courses(imu: TopicData, report: ImuReport, evidence: ImuEvidence) -> int:
    """Return +1 if the gyro turns as the courses of the fixes do, -1 if opposite, 0 if that is unclear."""
    courses = evidence.courses
    if courses is None or len(courses.stamps_ns) < 20:
        return 0
    turning, course = _turning_of(imu, report, evidence), np.unwrap(courses.course_rad)
    return course_against_turning(turning, courses.stamps_ns, course)


def _turning_axis(imu: TopicData, report: ImuReport, evidence: ImuEvidence) -> Array | None:
    """Return the sensor axis (3,), with its sign, about which it turns as the courses do; None if that is unclear."""
    courses = evidence.courses
    if courses is None or len(courses.stamps_ns) < 20:
        return None
    course, left = np.unwrap(courses.course_rad), []
    axes = np.vstack([np.eye(3), -np.eye(3)])
    for axis in axes:
        mount = replace(report.mount, rpy_deg=vec(np.degrees(rpy_from_rotation(levelling(axis)))))
        turning = _turning_of(imu, replace(report, mount=mount), evidence)
        left.append(left_of_turns(turning, courses.stamps_ns, course))
    return axes[int(np.argmin(left))] if min(left) < _LEFT_OF_TURNS else None


def _righted(report: ImuReport, imu: TopicData, samples: ImuSamples, evidence: ImuEvidence) -> ImuReport:
    """Return the report corrected by how the gyroscope turns beside the courses of the fixes.

    Levelled by accelerations of the wrong sign, a sensor comes out upside down, and its gyroscope turns against the
    courses; with a mount from tf it turns as they do, but gravity points down. If the gyroscope turns against the
    courses with a mount from tf, that mount is wrong. Without gravity, the courses tell which axis is up.
    """
    motions, pose = evidence.motions, evidence.pose_of(report.mount.tf_frame)
    if pose is None and report.gravity == "removed":
        up = _turning_axis(imu, report, evidence)
        if up is None or up[2] > 0.0:
            return report
        name = f"{'+' if up.sum() > 0.0 else '-'}{'xyz'[int(np.abs(up).argmax())]}"
        why = (
            f"its gyro turns about {name} as the courses of the fixes do: taken for up, as there is no gravity to tell"
        )
        return replace(report, mount=mount_turned(samples, motions, levelling(up), why))
    sense = _against_courses(imu, report, evidence)
    if sense == 0:
        return report
    against = "its gyro turns against the courses of the fixes"
    if pose is None and sense < 0:
        why = f"{against}: its accelerations look inverted, its axes are left-handed, or the fixes have latitude and longitude swapped"
        mount = mount_guess(samples._replace(accel=-samples.accel), evidence)
        mount = replace(mount, evidence=f"with accelerations inverted, {mount.evidence}")
        return replace(report, gravity="inverted", mount=mount, why=(*report.why, why))
    if pose is None:
        return report
    up = np.asarray(pose[1]) @ np.median(samples.accel, axis=0)
    upside_down = float(up[2]) < np.cos(np.radians(_UPSIDE_DOWN_DEG)) * float(np.linalg.norm(up))
    if sense < 0 and upside_down and report.gravity == "included":
        mount = in_place_of(pose, tilt_of(pose[1], samples.accel), measured_mount(samples, motions))
        return replace(report, mount=mount, why=(*report.why, f"{against}: the mount in tf is upside down"))
    if sense < 0:
        why = f"{against}: the mount in tf is upside down, or its axes are left-handed; check both"
        return replace(report, why=(*report.why, why))
    if upside_down and report.gravity == "included":
        why = (
            "with the mount in tf its gyro turns as the fixes do, but gravity points down: accelerations look inverted"
        )
        mount = replace(report.mount, evidence="from tf")
        return replace(report, gravity="inverted", mount=mount, why=(*report.why, why))
    return report


def imu_report(imu: TopicData, evidence: ImuEvidence) -> ImuReport | None:
    """Return units, gravity, standstill, noise and mount of an IMU; None if it has fewer than 20 finite samples."""
    keep, frozen = samples_of(imu)
    rows = imu.rows[keep] if len(keep) else np.zeros((0, 13))
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(rows[:, :6]).all(axis=1))
    if finite.sum() < 20:
        return None
    stamps = imu.stamps_ns[keep]
    accel, gyro = np.where(finite[:, None], rows[:, :3], 0.0), np.where(finite[:, None], rows[:, 3:6], 0.0)
    missing = missing_half(accel, gyro)
    units = _units_of(
        ImuSeries(sensor=imu.topic, stamps_ns=stamps, accel_mps2=accel, gyro_radps=gyro, seqs=np.arange(len(stamps))),
        _yaws_beside(stamps, rows[:, 6:10], evidence),
    )
    accel = accel * (STANDARD_GRAVITY_MPS2 if units.accel == "g" else 1.0)
    gyro = gyro * (np.pi / 180.0 if units.gyro == "deg/s" else 1.0)
    spiked = spike_warning(imu.topic, stamps, spikes(stamps, np.hstack([accel, gyro])))
    cut = saturation_warning(imu.topic, accel[finite], gyro[finite])
    up = np.median(accel, axis=0)
    still = _standstill(stamps, accel, gyro, next((m for m in evidence.motions if m.rests), None))
    root_dt = float(np.sqrt(np.median(np.diff(stamps)) / NS_PER_S))
    quiet = still.sum() > 20

    def reported(column: int, unit: float) -> float | None:
        variance = float(np.median(rows[:, column]))
        return float(np.sqrt(variance)) * root_dt / unit if np.isfinite(variance) and variance > 0.0 else None

    samples = ImuSamples(imu.frame_id, stamps, accel, gyro)
    ug, mdps = 1e-6 * STANDARD_GRAVITY_MPS2, np.radians(1e-3)
    report = ImuReport(
        topic=imu.topic,
        gravity_size=units.gravity_size,
        gravity_axis=vec(up / max(float(np.linalg.norm(up)), 1e-9)),
        accel_unit=units.accel,
        gyro_unit=units.gyro,
        gravity=units.gravity,
        why=(
            *frozen,
            *slow_warning(imu.topic, stamps, ImuConfig()),
            *spiked,
            *cut,
            *([f"all its {missing} are 0: {HALF}"] if missing else []),
            *units.why,
        ),
        still_s=float(still.sum()) * root_dt**2,
        gyro_bias_radps=vec(gyro[still].mean(axis=0)) if quiet else None,
        accel_noise_ug=float(white_noise(accel).max()) * root_dt / ug,
        gyro_noise_mdps=float(white_noise(gyro).max()) * root_dt / mdps,
        reported_accel_ug=reported(10, ug),
        reported_gyro_mdps=reported(11, mdps),
        mount=mount_guess(samples, evidence),
        fast=units.fast,
        missing=missing,
        unfinite=int((~finite).sum()),
    )
    return _righted(report, imu, samples, evidence)


class _Units(NamedTuple):
    """Units of accelerations and rates, 'included' or 'removed' gravity, the median acceleration, and the evidence.

    `fast`: whether rates are large for rad/s, which they are by how the craft turns. See `ImuReport`.
    """

    accel: str
    gyro: str
    gravity: str
    gravity_size: float
    fast: bool
    why: tuple[str, ...]


def _yaws_beside(stamps: NDArray[np.int64], orientation: Array, evidence: ImuEvidence) -> dict[str, Yaws]:
    """Return the yaws that an IMU's turns are compared with, by a name for the evidence.

    Args:
        stamps, orientation: (N,), and (N, 4) of the IMU itself, if it has any. evidence: has poses and courses.
    """
    own = yaws_of(stamps, orientation)
    found = {"its own orientation does": own} if own else {}
    found |= {f"the poses of {topic} do": yaws for topic, yaws in evidence.yaws.items()}
    if (courses := evidence.courses) is not None:
        found["the courses of the fixes do"] = courses.stamps_ns, courses.course_rad
    return found


def yaws_of(stamps: NDArray[np.int64], quaternions: Array) -> Yaws | None:
    """Return the stamps and yaws of unit quaternions (N, 4), at stamps (N,); None where half of them are invalid."""
    whole = attitudes(quaternions)
    if not len(whole) or whole.mean() <= 0.5:
        return None
    return stamps[whole], yaw_from_rotation(np.asarray(Rotation.from_quat(quaternions[whole]).as_matrix()))


def _units_of(imu: ImuSeries, beside: Mapping[str, Yaws]) -> _Units:
    """Return the likely units of samples.

    The unit of rates is the one in which they turn as `beside` does; where that is not clear, it is judged by their
    size. Size alone would take the rad/s of a robot that pivots, whose gravity does not turn, for deg/s.

    Args:
        imu: samples as they are told, in any unit. beside: of `_yaws_beside`.
    """
    stamps, accel, gyro = imu.stamps_ns, imu.accel_mps2, imu.gyro_radps
    size, at_ease = size_at_ease(accel, gyro)
    rate = float(np.median(np.linalg.norm(gyro, axis=1)))
    gravity = "removed" if without_gravity(accel) else "included"
    accel_unit = "g" if gravity == "included" and 0.9 < size < 1.1 else "m/s^2"
    si = replace(imu, accel_mps2=accel * (STANDARD_GRAVITY_MPS2 if accel_unit == "g" else 1.0))
    told = ((unit, by) for by, yaws in beside.items() if (unit := unit_of_turns(si, yaws)))
    turns, as_turns = next(told, (None, ""))
    fast = rate > NEVER_STILL_RADPS and not turns_gravity(stamps, accel, gyro)
    gyro_unit = turns or ("deg/s" if fast else "rad/s")
    why = []
    if accel_unit == "g":
        why.append(f"median acceleration is {size:.2f}: looks like g")
    if gravity == "removed":
        why.append(f"median acceleration is {size:.2f}: looks like gravity was removed by the driver")
    if accel_unit == "m/s^2" and gravity == "included" and no_gravity_in_si(size, at_ease):
        why.append(f"median acceleration is {size:.2f}: neither m/s^2 nor g with gravity; check the sensor")
    if turns == "deg/s":
        why.append(f"it turns as {as_turns} in deg/s")
    elif fast and turns:
        why.append(f"median rate is {rate:.2f}, but it turns as {as_turns} in rad/s")
    elif fast:
        why.append(f"median rate is {rate:.2f}: too much for rad/s, looks like deg/s")
    return _Units(accel_unit, gyro_unit, gravity, size, fast and gyro_unit == "rad/s", tuple(why))


def _standstill(
    stamps: NDArray[np.int64], accel: Array, gyro: Array, motion: MeasuredMotion | None
) -> NDArray[np.bool_]:
    """Return (N,) whether a sample is in several quiet seconds in a row, at a speed of zero if the speed is known.

    A rolling vessel is quiet for a second at each end of a roll, and one that changes from ahead to astern has no speed
    for a moment. Their rates then are no bias.
    """
    second = (stamps - stamps[0]) // NS_PER_S
    quiet = np.zeros(int(second[-1]) + 1, dtype=bool)
    moves = np.zeros(len(stamps), dtype=bool)
    if motion is not None:
        speed = np.interp((stamps - motion.origin_ns) / NS_PER_S, motion.t_s, motion.speed_mps)
        moves = np.abs(speed) > 0.05
        for first, after in runs(~moves):
            turns_back = 0 < first and after < len(speed) and speed[first - 1] * speed[after] < 0.0
            moves[first:after] = turns_back and stamps[after] - stamps[first - 1] < _STANDS_S * NS_PER_S
    for s in np.unique(second):
        part = second == s
        calm = float(gyro[part].std(axis=0).max()) < 0.03 and float(accel[part].std(axis=0).max()) < 0.2
        quiet[s] = calm and float(np.abs(gyro[part].mean(axis=0)).max()) < 0.02
    for first, after in runs(quiet):
        quiet[first:after] &= after - first >= _QUIET_S
    return np.asarray(quiet[second] & ~moves)
