# SPDX-License-Identifier: Apache-2.0
"""Assess an IMU: units, gravity, standstill, noise and mount."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import STANDARD_GRAVITY_MPS2, ImuConfig
from graphloc.frames import Array, rotation_from_rpy_deg, rpy_from_rotation, wrap_angle, yaw_from_rotation
from graphloc.frontends import _clock
from graphloc.frontends._assess import Courses, MeasuredMotion, attitudes, vec
from graphloc.frontends._mount_yaw import Felt, yaw_in_craft
from graphloc.frontends._reports import CompassReport, ImuReport, MountGuess, Vec
from graphloc.frontends._sanity import (
    HALF,
    NEVER_STILL_RADPS,
    missing_half,
    no_gravity_in_si,
    saturation_warning,
    size_at_ease,
    slow_warning,
)
from graphloc.frontends._streams import TopicData
from graphloc.frontends._tf import Pose, StaticTree
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
# Least number of quiet seconds in a row at standstill; a craft that only changes between ahead and astern is slow for a
# shorter time than the second.
_QUIET_S, _STANDS_S = 2, 1.5
# Angle between gravity and body z from which a note says so; how near 90 deg gravity or the motion must be off to
# overrule tf; and the coherence that this takes of the motion.
_TILTED_DEG, _QUARTER_DEG, _OVERRULES = 20.0, 20.0, 0.6
_SLIGHTLY_DEG = 3.0  # deviation from a multiple of 90 deg from which it is said
_ASKEW_DEG = 15.0  # deviation from which an IMU sits askew: leeway, or an antenna far ahead, make less
_EITHER = 0.5**0.5  # 1 sigma about one of two angles that are as likely, by how far they are apart
_AHEAD_DEG = 60.0  # yaw within which an unclear motion says that x is ahead rather than astern or aside
_CAMERA = -0.7  # z component of y, levelled, below which the axes are a camera's (y down)
_ON_ITS_HEAD = -0.7  # z component of the upward axis below which a sensor is upside down, however it is tilted


def samples_of(imu: TopicData) -> tuple[NDArray[np.intp], list[str]]:
    """Return the indices of usable samples, sorted by stamp, and warnings on frozen samples, which are left out."""
    good = np.flatnonzero(~_clock.clock_jumps(imu.stamps_ns, imu.logs_ns))
    keep = good[_clock.in_order_or_late(imu.stamps_ns[good])]
    keep = keep[np.argsort(imu.stamps_ns[keep], kind="stable")]
    bad = frozen_samples(imu.stamps_ns[keep], imu.rows[keep, :6] if len(keep) else np.zeros((0, 6)))
    return keep[~bad], frozen_imu_warning(imu.topic, imu.stamps_ns[keep], bad)


class _Samples(NamedTuple):
    """Usable samples of an IMU: frame, stamps (N,), accelerations (N, 3), m/s^2, and angular rates (N, 3), rad/s."""

    frame_id: str
    stamps_ns: NDArray[np.int64]
    accel: Array
    gyro: Array

    def turned(self, R: Array) -> _Samples:
        """Return the samples in other axes, to which R (3, 3) takes."""
        return self._replace(accel=self.accel @ R.T, gyro=self.gyro @ R.T)


@dataclass(frozen=True, slots=True, eq=False)
class ImuEvidence:
    """What an IMU is judged by.

    Attributes:
        motions: how the craft moved, by each source, the most accurate first.
        courses: of the fixes; None without fixes. tree: transforms of /tf_static.
        yaws: by topic, of odometry and poses.
    """

    motions: Sequence[MeasuredMotion]
    courses: Courses | None
    tree: StaticTree
    yaws: Mapping[str, Yaws] = field(default_factory=dict)

    def pose_of(self, frame: str | None) -> Pose | None:
        """Return T_body_frame by tf; None where it does not know the frame."""
        return self.tree.resolve(self.tree.body(), frame) if frame in self.tree.frames else None


def _mount_guess(samples: _Samples, evidence: ImuEvidence) -> MountGuess:
    """Return the IMU's mount in body: from tf, else levelled by gravity and aligned with the motion.

    Some drivers publish in axes of their own, though under the frame of the URDF. Where tf is off by a quarter turn,
    gravity or the motion overrules it. Half a turn about the vertical may be a craft that goes astern, so tf stays.
    """
    motions, pose = evidence.motions, evidence.pose_of(samples.frame_id)
    if pose is None:
        return _measured_mount(samples, motions)
    tilt_deg = _tilt_deg(pose[1], samples.accel)
    if abs(tilt_deg - 90.0) < _QUARTER_DEG:
        return _in_place_of(pose, tilt_deg, _measured_mount(samples, motions))
    note = "" if tilt_deg < _TILTED_DEG else f"; but then gravity is {tilt_deg:.0f} deg off body z: check it"
    if not note and motions:
        in_body = samples.turned(pose[1])
        turned = yaw_in_craft(in_body.stamps_ns, in_body.accel, in_body.gyro, motions)
        if turned is not None and turned.astray:
            if abs(abs(turned.yaw_deg) - 90.0) < _QUARTER_DEG and turned.coherence > _OVERRULES:
                said = f"not as in tf, since {turned.said}: tf is right only if the craft goes sideways throughout"
                return replace(_turned(samples, motions, pose[1], said), xyz_m=vec(pose[0]))
            note = f"; but {turned.said}: check it"
    rpy = vec(np.degrees(rpy_from_rotation(pose[1])))
    return MountGuess(rpy_deg=rpy, tf_frame=samples.frame_id, evidence=f"from tf{note}")


def _measured_mount(samples: _Samples, motions: Sequence[MeasuredMotion]) -> MountGuess:
    """Return the mount whose roll and pitch are by gravity, and whose yaw is by the motion."""
    up = np.median(samples.accel, axis=0)
    size = float(np.linalg.norm(up))
    if size < 0.5 * STANDARD_GRAVITY_MPS2:
        return _turned(samples, motions, np.eye(3), "no gravity to find the level from: taken as level")
    axis = up / size
    snapped = np.zeros(3)
    k = int(np.argmax(np.abs(axis)))
    snapped[k] = np.sign(axis[k])
    aligned = float(axis @ snapped) > np.cos(np.radians(15.0))
    level = _level(snapped if aligned else axis)
    name = f"{'+' if snapped[k] > 0 else '-'}{'xyz'[k]}"
    said = (
        f"gravity is on {name} of the sensor" if aligned else f"gravity is {np.round(axis, 2).tolist()} in the sensor"
    )
    off_deg = float(np.degrees(np.arccos(np.clip(axis @ snapped, -1.0, 1.0))))
    if not aligned or off_deg < _SLIGHTLY_DEG:
        return _turned(samples, motions, level, said)
    mount = _turned(samples, motions, level, f"{said}, {off_deg:.0f} deg off")
    turn = rotation_from_rpy_deg(np.array(mount.rpy_deg)) @ level.T
    roll, pitch, yaw = np.degrees(rpy_from_rotation(turn @ _level(axis))).tolist()
    square = f"drafted in steps of 90 deg: if the sensor is tilted in the craft, rather than the craft itself, set [{roll:.1f}, {pitch:.1f}, {yaw:.1f}]"
    return replace(mount, evidence=f"{mount.evidence}; {square}", tilt_sigma_deg=off_deg * _EITHER)


def _tilt_deg(R_body_imu: Array, accel: Array) -> float:
    """Return the angle of gravity, by accelerations (N, 3) and a mount, to body z, deg; 0 if gravity was removed."""
    up = np.median(accel, axis=0)
    size = float(np.linalg.norm(up))
    return float(np.degrees(np.arccos(np.clip((R_body_imu @ up)[2] / size, -1.0, 1.0)))) if size > 2.0 else 0.0


def _in_place_of(pose: tuple[Array, Array], tilt_deg: float, mount: MountGuess) -> MountGuess:
    """Return a measured mount that replaces the one in tf, of which only the position is kept."""
    why = f"not as in tf, by which gravity is {tilt_deg:.0f} deg off body z; {mount.evidence}"
    return replace(mount, xyz_m=vec(pose[0]), evidence=why)


def _rpy_deg(R: Array) -> Vec:
    """Return roll, pitch and yaw of a rotation (3, 3), deg, rounded to a tenth."""
    return vec(np.round(np.degrees(rpy_from_rotation(R)), 1) + 0.0)  # + 0.0: no -0.0


def _turned(samples: _Samples, motions: Sequence[MeasuredMotion], level: Array, said: str) -> MountGuess:
    """Return the mount of a sensor that is levelled by `level` (3, 3), with its yaw by the motion.

    Args:
        said: evidence of the level, in words.
    """
    yaw, sigma, evidence = _mount_yaw(samples.turned(level), motions)
    told = yaw is not None
    if yaw is None:
        ahead = level[:, 2] if level[2, 1] < _CAMERA else np.array([1.0, 0.0, 0.0])
        yaw = float(np.degrees(np.arctan2(-ahead[1], ahead[0]))) + 0.0
        evidence += f": taken as {yaw:.0f}" + ("" if yaw == 0.0 else ", z ahead and y down as in a camera's axes")
    turn = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
    rpy = _rpy_deg(turn @ level)
    return MountGuess(rpy_deg=rpy, tf_frame=None, evidence=f"{said}; {evidence}", yaw_told=told, yaw_sigma_deg=sigma)


def turned_as_its_heading(imu: ImuReport, compasses: Sequence[CompassReport]) -> ImuReport:
    """Return the report with the mount's yaw by the IMU's own orientation, where nothing else tells it.

    The orientation must be along the course or opposite to it. One a quarter turn off it tells nothing: so are headings
    that count from north, or that are in other axes than the driver names.
    """
    own = next((c for c in compasses if c.topic == imu.topic and (c.ahead or c.backwards)), None)
    if own is None or imu.mount.yaw_told:
        return imu
    R = rotation_from_rpy_deg(np.array(imu.mount.rpy_deg))
    x_deg = float(np.degrees(np.arctan2(R[1, 0], R[0, 0])))
    quarters = round(((180.0 if own.backwards else 0.0) - x_deg) / 90.0) % 4
    if quarters == 0:
        return imu
    turn = Rotation.from_euler("z", 90.0 * quarters, degrees=True).as_matrix()
    rpy = _rpy_deg(turn @ R)
    turned = "half a turn" if quarters == 2 else "a quarter turn"
    said = f"{imu.mount.evidence}, but {turned} off that, as its orientation is {own.offset_deg:+.0f} deg off the GNSS course"
    return replace(imu, mount=replace(imu.mount, rpy_deg=rpy, evidence=said, yaw_told=True))


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
    in_body = _Samples(imu.frame_id, *_in_body(_series_of(imu, report), report, evidence))
    yaw, sigma, said = _mount_yaw(in_body, headed)
    if yaw is None:
        return report
    R = Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ rotation_from_rpy_deg(np.array(report.mount.rpy_deg))
    rpy = _rpy_deg(R)
    told = f"{report.mount.evidence}; but from there {said}"
    return replace(report, mount=replace(report.mount, rpy_deg=rpy, evidence=told, yaw_told=True, yaw_sigma_deg=sigma))


def _level(axis: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes a unit vector to +z.

    Of a sensor upside down, it follows half a turn about x, so that x stays ahead. Near -z the axis of the smallest
    rotation is arbitrary: of a sensor upside down and tilted a little forward, x would point astern.
    """
    turned = np.diag([1.0, -1.0, -1.0]) if axis[2] < _ON_ITS_HEAD else np.eye(3)
    up, z = turned @ axis, np.array([0.0, 0.0, 1.0])
    cross = np.cross(up, z)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-9:
        return turned
    angle = float(np.arctan2(sine, up[2]))
    return np.asarray(Rotation.from_rotvec(angle * cross / sine).as_matrix() @ turned)


def _mount_yaw(levelled: _Samples, motions: Sequence[MeasuredMotion]) -> tuple[float | None, float, str]:
    """Return the yaw of a levelled IMU by the motion, its sigma, and the evidence in words.

    Returns:
        The yaw, deg: a multiple of 90 unless the motion clearly contradicts it; None where nothing tells it. Its 1
        sigma, deg, if it may be no multiple of 90; else 0. The evidence.
    """
    if not motions:
        return None, 0.0, "no motion to find its yaw from"
    found = yaw_in_craft(levelled.stamps_ns, levelled.accel, levelled.gyro, motions)
    if found is None:
        return None, 0.0, "too little motion to find its yaw from"
    quarter = 90.0 * round(found.yaw_deg / 90.0)
    stays = found.hints and abs(found.yaw_deg) < _AHEAD_DEG
    if not found.clear and (found.likely or stays):
        yaw = float(np.degrees(wrap_angle(np.radians(quarter)))) + 0.0 if found.likely else 0.0
        said = f"yaw by the motion of {found.source}: {found.yaw_deg:z.0f} deg, but not clearly (coherence {found.coherence:.2f})"
        return yaw, 0.0, f"{said}: taken as {yaw:.0f}"
    if not found.clear:
        return None, 0.0, f"motion of {found.source} does not show its yaw (coherence {found.coherence:.2f})"
    off_deg = abs(found.yaw_deg - quarter)
    turned = off_deg > max(_ASKEW_DEG, 4.0 * found.sigma_deg)
    askew = turned and not found.one_way
    yaw = float(np.degrees(wrap_angle(np.radians(round(found.yaw_deg) if askew else quarter)))) + 0.0
    said = f"yaw by the motion of {found.source}: {found.yaw_deg:z.0f} deg (coherence {found.coherence:.2f})"
    if turned and found.one_way:
        said += (
            f", taken as {yaw:.0f}: she goes one way, so leeway or a current may set her by that; where she is not set sideways, as "
            f"on wheels, set {found.yaw_deg:.0f}"
        )
        return yaw, off_deg * _EITHER, said
    if not askew and off_deg > max(_SLIGHTLY_DEG, 4.0 * found.sigma_deg):
        said += f", taken as {yaw:.0f}, since leeway makes a few degrees: where she is not set sideways, as on wheels, set {found.yaw_deg:.0f}"
        return yaw, off_deg * _EITHER, said
    return yaw, found.error_deg if askew else 0.0, said


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
        mount = replace(report.mount, rpy_deg=vec(np.degrees(rpy_from_rotation(_level(axis)))))
        turning = _turning_of(imu, replace(report, mount=mount), evidence)
        left.append(left_of_turns(turning, courses.stamps_ns, course))
    return axes[int(np.argmin(left))] if min(left) < _LEFT_OF_TURNS else None


def _righted(report: ImuReport, imu: TopicData, samples: _Samples, evidence: ImuEvidence) -> ImuReport:
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
        return replace(report, mount=_turned(samples, motions, _level(up), why))
    sense = _against_courses(imu, report, evidence)
    if sense == 0:
        return report
    against = "its gyro turns against the courses of the fixes"
    if pose is None and sense < 0:
        why = f"{against}: its accelerations look inverted, or its axes are left-handed; or the fixes have latitude and longitude swapped"
        mount = _mount_guess(samples._replace(accel=-samples.accel), evidence)
        mount = replace(mount, evidence=f"with accelerations inverted, {mount.evidence}")
        return replace(report, gravity="inverted", mount=mount, why=(*report.why, why))
    if pose is None:
        return report
    up = np.asarray(pose[1]) @ np.median(samples.accel, axis=0)
    upside_down = float(up[2]) < np.cos(np.radians(_UPSIDE_DOWN_DEG)) * float(np.linalg.norm(up))
    if sense < 0 and upside_down and report.gravity == "included":
        mount = _in_place_of(pose, _tilt_deg(pose[1], samples.accel), _measured_mount(samples, motions))
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

    samples = _Samples(imu.frame_id, stamps, accel, gyro)
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
        mount=_mount_guess(samples, evidence),
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
