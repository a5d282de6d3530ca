# SPDX-License-Identifier: Apache-2.0
"""Warnings on a run as read: sensors that the IMU's turns and motion contradict, and what sensors do not say."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from graphloc.config import BodyVelocityConfig, CompassConfig, GnssConfig, ImuConfig, VelocityConfig, VesselConfig
from graphloc.frames import Array, rpy_from_rotation, wrap_angle
from graphloc.frontends._assess import MeasuredMotion, courses_of_fixes, motion_of_fixes
from graphloc.frontends._exchanged import exchanged_warnings
from graphloc.frontends._mount_yaw import yaw_in_craft
from graphloc.frontends._reader import either
from graphloc.frontends._readings import Readings
from graphloc.frontends._sanity import fast_warning
from graphloc.frontends._turns import (
    Yaws,
    pose_turn_warning,
    refuse_unit,
    scale_warning,
    turn_warnings,
    wander_warning,
    without_tilt,
)
from graphloc.frontends.decode import Decoded
from graphloc.frontends.msgtypes import UNSTAMPED
from graphloc.frontends.source import TopicSummary
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import BodyVelocity, CompassHeading, GnssPosition, ImuSeries, PoseFix
from graphloc.recording import Mounts


def run_warnings(
    imu: ImuSeries | None,
    sensors: Sequence[Readings],
    rows: Sequence[LedgerRow],
    topics: Mapping[str, TopicSummary],
    mounts: Mounts,
    config: VesselConfig,
) -> list[str]:
    """Return a warning on whatever in a run cannot be right, or is missing.

    Args:
        imu: its samples that are used; None: there are none. sensors: what each sensor says, implausible readings left
            out. rows: ledger rows of what is left out. topics: of the bag. mounts: those from tf.

    Raises:
        InputError: angular rates are in another unit than configured.
    """
    motions = _motions_of_fixes(sensors)
    warnings = list[str]()
    if imu is not None:
        warnings += _unit_warnings(imu, sensors)
        warnings += _turn_warnings(imu, sensors, mounts, config)
        warnings += _mount_warnings(imu, [*motions.values()], mounts, config)
    warnings += _silent(sensors, rows, topics, config)
    warnings += _unstamped(sensors, topics)
    warnings += _heightless(sensors, config)
    warnings += _along_fewer(sensors)
    return warnings + exchanged_warnings(sensors, motions)


def _unit_warnings(imu: ImuSeries, sensors: Sequence[Readings]) -> list[str]:
    """Refuse angular rates in another unit than configured, by headings, poses and courses.

    Returns:
        Where none of these confirms the unit, a warning on rates that are too fast for it.

    Raises:
        InputError: see `refuse_unit`.
    """
    (config,) = (r.config for r in sensors if r.sensor == imu.sensor and isinstance(r.config, ImuConfig))
    yaws: dict[str, Yaws] = {}
    for readings in sensors:
        fixes = readings.of(GnssPosition)
        if own := _yaws_of(readings):
            yaws[f"the headings of {readings.sensor}"] = own
        elif fixes:
            courses = courses_of_fixes(fixes)
            yaws[f"the courses of {readings.sensor}"] = courses.stamps_ns, courses.course_rad
    return [] if refuse_unit(imu, config, yaws) else fast_warning(imu, config)


def _yaws_of(readings: Readings) -> Yaws | None:
    """Return the stamps and yaws of headings or poses; None of a sensor that tells none."""
    yaw = np.array([_yaw_of(v) for v in readings.values])
    known = np.isfinite(yaw)
    return (readings.stamps()[known], yaw[known]) if known.any() else None


def _yaw_of(value: Decoded) -> float:
    """Return the yaw of a heading, or of a pose's likeliest mode; NaN for anything else."""
    if isinstance(value, PoseFix) and "yaw" in value.axes:
        return float(max(value.modes, key=lambda mode: mode.probability).value[value.axes.index("yaw")])
    return value.yaw_rad if isinstance(value, CompassHeading) else float("nan")


def _turn_warnings(imu: ImuSeries, sensors: Sequence[Readings], mounts: Mounts, config: VesselConfig) -> list[str]:
    def rotation(name: str) -> Array:
        return mounts[name][1] if name in mounts else config.sensors[name].mount.R_body_sensor

    lines = []
    for readings in sensors:
        if yaws := _yaws_of(readings):
            lines += scale_warning(imu, readings.sensor, yaws)
        if isinstance(readings.config, CompassConfig):
            headings = without_tilt(imu, rotation(imu.sensor), rotation(readings.sensor), readings.of(CompassHeading))
            lines += turn_warnings(imu, readings.sensor, headings, readings.config.convention)
            lines += wander_warning(imu, readings.sensor, headings, readings.config)
        elif yaws:
            lines += pose_turn_warning(imu, readings.sensor, yaws)
    return lines


def _motions_of_fixes(sensors: Sequence[Readings]) -> dict[str, MeasuredMotion]:
    """Return the motion of each receiver's fixes, as far as these tell one."""
    fixes = {r.sensor: r.of(GnssPosition) for r in sensors}
    return {sensor: m for sensor, own in fixes.items() if (m := motion_of_fixes(sensor, own))}


def _mount_warnings(
    imu: ImuSeries, motions: Sequence[MeasuredMotion], mounts: Mounts, config: VesselConfig
) -> list[str]:
    """Return a warning if the motion of the fixes says that the IMU's mount has a wrong yaw.

    No heading sensor would contradict a wrong mount.
    """
    mount = config.sensors[imu.sensor].mount
    R = mounts[imu.sensor][1] if imu.sensor in mounts else mount.R_body_sensor
    found = (
        yaw_in_craft(imu.stamps_ns, imu.accel_mps2 @ R.T, imu.gyro_radps @ R.T, motions) if len(imu.stamps_ns) else None
    )
    if found is None or not found.astray:
        return []
    wanted = float(np.degrees(wrap_angle(rpy_from_rotation(R)[2] + np.radians(found.yaw_deg))))
    key = f"mount of {mount.tf_frame} in /tf_static" if mount.tf_frame else f"mount.rpy_deg of sensors.{imu.sensor}"
    said = f"{imu.sensor}: {found.said}: by that the yaw in {key} would be {wanted:z.0f}"
    return [f"{said} deg; it is right as it is only of a craft that goes astern or sideways"]


def _unstamped(sensors: Sequence[Readings], topics: Mapping[str, TopicSummary]) -> list[str]:
    """Return a warning for each sensor whose recording times are used as stamps without a correction or a sigma."""
    lines = []
    for r in sensors:
        types = topics[r.config.topic].msgtypes
        unstamped = set(types) & set(UNSTAMPED)
        receiver = r.config if isinstance(r.config, GnssConfig | VelocityConfig) else None
        estimated = receiver is not None and receiver.stamp_sigma_s > 0.0
        if (unstamped or r.config.stamps == "recorded") and r.config.time_offset_s == 0.0 and not estimated:
            why = f"{either(types)} has no stamp" if unstamped else "stamps: recorded"
            lines.append(
                f"{r.sensor}: {why}: recording times are used, which are late by as long as a message takes (a receiver's often "
                "0.1 s and more); no bound includes that: set time_offset_s (negative)"
                + (", or stamp_sigma_s" if receiver is not None else "")
            )
    return lines


def _heightless(sensors: Sequence[Readings], config: VesselConfig) -> list[str]:
    """Return a warning if only poses without z tell the position: the height is then left to the accelerometer.

    Of fixes without a height, `_fixes.height_warning` warns.
    """
    poses = {**config.of_kind("pose"), **config.of_kind("aerial")}
    kinds = {sensor.kind for sensor in config.sensors.values() if sensor.enabled}
    telling = kinds - {"imu", "compass", "gnss", "gnss_velocity", "body_velocity", "pose", "aerial"}
    fixes = any(isinstance(value, GnssPosition) for readings in sensors for value in readings.values)
    if not poses or telling or fixes or any("z" in pose.axes for pose in poses.values()):
        return []
    axes = ", ".join(f"{name} ({', '.join(pose.axes)})" for name, pose in poses.items())
    said = (
        f"nothing tells the height: {axes}; the track's height is a guess that drifts away by tens of metres a minute"
    )
    return [
        f"{said}: enable a sensor of kind height (a vessel that floats), or put z among the axes of poses whose height is right"
    ]


def _along_fewer(sensors: Sequence[Readings]) -> list[str]:
    """Return a warning for each speed sensor whose messages lack a configured axis.

    A bare number and VHW tell the speed ahead, and nothing of the drift sideways.
    """
    lines = []
    for readings in sensors:
        if isinstance(readings.config, BodyVelocityConfig) and readings.values:
            told = {axis for value in readings.values if isinstance(value, BodyVelocity) for axis in value.axes}
            if missing := [axis for axis in readings.config.axes if axis not in told]:
                lines.append(
                    f"{readings.sensor}: its messages tell {' and '.join(sorted(told))} alone, not {' and '.join(missing)} of its axes: "
                    "wheels that do not slip sideways are fused as such from a Twist or an Odometry"
                )
    return lines


def _silent(
    sensors: Sequence[Readings], rows: Sequence[LedgerRow], topics: Mapping[str, TopicSummary], config: VesselConfig
) -> list[str]:
    """Return a warning for each sensor without a reading, with the main reason.

    Of sensors that take turns at one receiver, it is enough that one has readings.
    """
    lines = []
    heard = {config.receiver_of(r.sensor) for r in sensors if r.values}
    for readings in (r for r in sensors if config.receiver_of(r.sensor) not in heard):
        own = [r for r in rows if r.sensor == readings.sensor]
        # Most sentences on an NMEA line are for other sensors, which is no reason.
        reasons = Counter(r.reason for r in own if r.outcome is not Outcome.IGNORED) or Counter(r.reason for r in own)
        why = f", mostly: {reasons.most_common(1)[0][0]}" if reasons else ""
        count = topics[readings.config.topic].messages
        lines.append(f"{readings.sensor}: none of the {count} messages on {readings.config.topic} could be used{why}")
    return lines
