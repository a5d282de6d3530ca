# SPDX-License-Identifier: Apache-2.0
"""Signs of a wrong configuration in a whole run: units, gravity, fixes far from the datum.

They are warned of or refused, never corrected silently.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.config import STANDARD_GRAVITY_MPS2, ImuConfig, VesselConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum, Geodetic, continuous_longitudes
from graphloc.measurements import GnssPosition, ImuSeries, PoseFix
from graphloc.signals.rates_in_degrees import swing_of_degrees, turns_gravity, without_gravity
from graphloc.time import NS_PER_S

FAR_M = 100e3
"""A fix this far from the middle of its run is not believed, unless the fixes in between lead there."""
NEVER_STILL_RADPS = 0.5
"""Median rate that no vessel keeps up for a whole run (29 deg/s)."""
HALF = "half an IMU, and both halves must come in one message (RealSense: unite_imu_method)"
FAR_LEVER_M = 50.0
"""A sensor this far from the origin of body is on a ship, or its mount is not in metres."""
# A single fix is wrong that is so far off those around it, in m, by an acceleration, and in distances between these two: choices
_LONE_M, _LONE_MPS2, _LONE_APART = 10.0, 20.0, 3.0
_FASTEST_MPS = 300.0  # no craft goes as far as `FAR_M` faster than this
_FEWEST = 100  # so many samples are not all 0 by chance
_LEAST_RANGE_MPS2, _LEAST_RANGE_RADPS = 19.0, 1.7  # no IMU has a smaller range (2 g, 100 deg/s)
# Fewer readings at the end of the range may be chance; the band beneath the end (a share of it) must hold no more.
_CUT, _BENEATH = 5, 0.03
# Share of the samples that turn least; the craft is at ease if their rates are below this.
_LEAST_TURNING, _AT_EASE_RADPS = 0.3, 0.3
_LEAST_GRAVITY_MPS2, _MOST_GRAVITY_MPS2 = 8.5, 11.5  # a median acceleration between these may be gravity


def lever_warning(name: str, t_body_sensor_m: Array, tf_frame: str | None) -> list[str]:
    """Return a warning on a sensor so far from the origin of body that a mount in cm or mm is likelier.

    Args:
        name: as in vessel.yaml. t_body_sensor_m: (3,). tf_frame: in /tf_static, if the mount is from there; else None.
    """
    far_m = float(np.linalg.norm(t_body_sensor_m))
    if far_m <= FAR_LEVER_M:
        return []
    by = f"{tf_frame} in /tf_static" if tf_frame else "mount.xyz_m"
    return [f"{name}: by {by} it sits {far_m:.0f} m from the origin of body: metres are meant; right on a ship only"]


def size_at_ease(accel: Array, gyro_radps: Array) -> tuple[float, bool]:
    """Return the median size of accelerations (N, 3) while the craft turns least, and whether it then hardly turns.

    If it hardly turns, the size is gravity's alone: a fast craft in tight circles feels as much again. Rates (N, 3) in
    deg/s are never that small. In a gait or waves, rates are least at one phase of the heave: then the median of all
    samples is nearer to gravity, in m/s^2 or g, and is returned instead.
    """
    rates, sizes = np.linalg.norm(gyro_radps, axis=1), np.linalg.norm(accel, axis=1)
    least = float(np.quantile(rates, _LEAST_TURNING))
    medians = np.maximum([np.median(sizes[rates <= least]), np.median(sizes)], 1e-12)
    off = np.abs(np.log(medians / np.array([[1.0], [STANDARD_GRAVITY_MPS2]]))).min(axis=0)
    return float(medians[int(off.argmin())]), least < _AT_EASE_RADPS


def no_gravity_in_si(size: float, at_ease: bool) -> bool:
    """Return whether accelerations are too small or too large to be gravity in m/s^2.

    Args:
        size: in their unit. at_ease: whether the craft hardly turns, see `size_at_ease`.
    """
    return size < _LEAST_GRAVITY_MPS2 or (size > _MOST_GRAVITY_MPS2 and at_ease)


def imu_warnings(sensor: str, accel_mps2: Array, gyro_radps: Array, config: ImuConfig) -> list[str]:
    """Return warnings on unit, gravity and range of accelerations (N, 3) and rates (N, 3), converted as configured."""
    if len(accel_mps2) < 10:
        return []
    g, at_ease = size_at_ease(accel_mps2, gyro_radps)
    lines = []
    said = f"{sensor}: median acceleration is {g:.2f} m/s^2"
    if config.gravity != "removed" and no_gravity_in_si(g, at_ease):
        if g < 2.0:
            lines.append(f"{said}: looks like gravity was removed by the driver; set gravity: removed")
        else:
            lines.append(f"{said}, not about 9.8: check accel_unit, and the sensor itself")
    elif config.gravity == "removed" and g > 8.0:
        lines.append(f"{said}: looks like gravity is included; set gravity: included")
    return lines + saturation_warning(sensor, accel_mps2, gyro_radps)


def slow_warning(sensor: str, stamps_ns: NDArray[np.int64], config: ImuConfig) -> list[str]:
    """Return a warning on an IMU whose samples, at stamps (N,), are so far apart that each interval is a gap."""
    apart_s = float(np.median(np.diff(stamps_ns))) / NS_PER_S if len(stamps_ns) > 1 else 0.0
    if apart_s <= config.max_gap_s:
        return []
    said = f"{sensor}: its samples come {apart_s:.1f} s apart, more than max_gap_s ({config.max_gap_s:g} s): each interval is a gap"
    return [f"{said}, and nothing tells the motion in it; online it does not start: record the IMU at 50 Hz or more"]


def fast_warning(imu: ImuSeries, config: ImuConfig) -> list[str]:
    """Return a warning if rates are so fast throughout that deg/s are likelier.

    Not if a unit is configured, or if gravity turns as the rates say.
    """
    rate = float(np.median(np.linalg.norm(imu.gyro_radps, axis=1)))
    fast = "gyro_unit" not in config.model_fields_set and rate > NEVER_STILL_RADPS
    if not fast or turns_gravity(imu.stamps_ns, imu.accel_mps2, imu.gyro_radps):
        return []
    return [f"{imu.sensor}: median angular rate is {rate:.2f} rad/s: looks like deg/s; set gyro_unit: deg/s"]


def saturation_warning(sensor: str, accel_mps2: Array, gyro_radps: Array) -> list[str]:
    """Return a warning on the axes of accelerations (N, 3) and rates (N, 3) that saturate.

    Their samples pile up at the largest reading, where the range ends. What lies beyond is lost, and with it the
    velocity and tilt of every knock or wave that is cut off.
    """
    said, cut = [], np.zeros(len(accel_mps2), dtype=bool)
    for name, unit, values, least in (
        ("acceleration", "m/s^2", accel_mps2, _LEAST_RANGE_MPS2),
        ("rate", "rad/s", gyro_radps, _LEAST_RANGE_RADPS),
    ):
        for axis, readings in zip("xyz", values.T, strict=True):
            for signed in (readings, -readings):
                end = float(signed.max(initial=0.0))
                at_end = signed >= end * (1.0 - 1e-6)
                beneath = int(((signed > end * (1.0 - _BENEATH)) & ~at_end).sum())
                if end >= least and max(_CUT, beneath) <= at_end.sum() < 0.5 * len(at_end):
                    said.append(f"{name} {axis} at {'-' if signed is not readings else ''}{end:.4g} {unit}")
                    cut |= at_end
    if not said:
        return []
    which = f"{int(cut.sum())} of {len(cut)} samples are cut off at the end of the range ({', '.join(said)})"
    return [
        f"{sensor}: {which}: velocity and tilt in what they miss are wrong; set a larger range, or mount it where it shakes less"
    ]


def missing_half(accel: Array, gyro: Array) -> str:
    """Return 'rates' or 'accelerations', whichever (N, 3) are all 0, as some drivers publish them; else ''.

    A simulated IMU without noise has zero rates at rest, but then constant accelerations.
    """
    if len(accel) < _FEWEST:
        return ""
    if not accel.any():
        return "accelerations"
    return "rates" if not gyro.any() and (np.diff(accel, axis=0) != 0.0).any(axis=1).mean() > 0.5 else ""


def refuse_half(sensor: str, accel_mps2: Array, gyro_radps: Array, config: ImuConfig) -> None:
    """Refuse accelerations or rates (N, 3) that are all 0, since the solver would believe them.

    Raises:
        InputError: all accelerations or all rates are 0.
    """
    missing = missing_half(accel_mps2, gyro_radps)
    if missing:
        raise InputError(f"{sensor}: all {missing} of {config.topic} are 0: {HALF}; name a topic that holds both")


def refuse_accel_unit(sensor: str, accel_mps2: Array, config: ImuConfig) -> None:
    """Refuse accelerations (N, 3), converted as configured, that are in g instead of m/s^2 or the reverse.

    The solver would run for minutes, and lay the vessel on its side.

    Raises:
        InputError: the accelerations are in the other unit.
    """
    g = float(np.median(np.linalg.norm(accel_mps2, axis=1))) if len(accel_mps2) >= 10 else STANDARD_GRAVITY_MPS2
    in_g = config.accel_unit == "m/s^2" and 0.9 < g < 1.1 and not without_gravity(accel_mps2)
    in_mps2 = config.accel_unit == "g" and 85.0 < g < 115.0
    if config.gravity != "removed" and (in_g or in_mps2):
        raise InputError(
            f"{sensor}: median acceleration is {g:.2f} m/s^2 with accel_unit: {config.accel_unit}: linear_acceleration of "
            f"{config.topic} looks like {'g' if in_g else 'm/s^2'}; set accel_unit: {'g' if in_g else 'm/s^2'} of sensors.{sensor}"
        )


def refuse_degrees(
    sensor: str, stamps_ns: NDArray[np.int64], accel_mps2: Array, gyro_radps: Array, config: ImuConfig
) -> None:
    """Refuse rates (N, 3) in deg/s, with which the solver would run for many minutes (see `swing_of_degrees`).

    Raises:
        InputError: they are.
    """
    if config.gyro_unit != "rad/s":
        return
    if swing := swing_of_degrees(stamps_ns, accel_mps2, gyro_radps):
        raise InputError(
            f"{sensor}: it rolls and pitches by {np.degrees(swing):.0f} deg within 5 s (median of {config.topic}), which no vessel "
            f"does for long: angular_velocity looks like deg/s; set gyro_unit: deg/s of sensors.{sensor}"
        )


def far_fixes_of(stamps_ns: NDArray[np.int64], lla: Array) -> NDArray[np.bool_]:
    """Return (N,) whether positions (N, 3), deg, deg, m, are farther than `FAR_M` from the median of all.

    Not those to which the run leads from there, by no step as far as that, or none faster than any craft. Stamps (N,)
    are in order.
    """
    if len(lla) == 0:
        return np.zeros(0, dtype=bool)
    lon = float(np.median(continuous_longitudes(lla[:, 1])))
    middle = Datum(Geodetic(float(np.median(lla[:, 0])), lon, float(np.median(lla[:, 2]))))
    p_m = middle.enu_from_geodetic(lla[:, 0], lla[:, 1], lla[:, 2])
    away_m = np.linalg.norm(p_m, axis=1)
    far = np.asarray(away_m > FAR_M)
    if not far.any():
        return far
    begin = int(away_m.argmin())
    for way in (range(begin, len(lla)), range(begin, -1, -1)):
        last = begin
        for k in way:
            most_m = max(FAR_M, _FASTEST_MPS * abs(int(stamps_ns[k]) - int(stamps_ns[last])) / NS_PER_S)
            far[k] = far[k] and float(np.linalg.norm(p_m[k] - p_m[last])) > most_m
            last = last if far[k] else k
    return far


def lone_fixes(stamps_ns: NDArray[np.int64], p_m: Array) -> NDArray[np.bool_]:
    """Return (N,) whether a fix lies so far off the line between the ones before and after it that no craft goes there and back.

    Args:
        stamps_ns: (N,), increasing. p_m: (N, 3).
    """
    alone = np.zeros(len(p_m), dtype=bool)
    if len(p_m) < 3:
        return alone
    before_s, after_s = np.diff(stamps_ns)[:-1] / NS_PER_S, np.diff(stamps_ns)[1:] / NS_PER_S
    share = (before_s / np.maximum(before_s + after_s, 1e-9))[:, None]
    off_m = np.linalg.norm(p_m[1:-1] - (1.0 - share) * p_m[:-2] - share * p_m[2:], axis=1)
    apart_m = np.linalg.norm(p_m[2:] - p_m[:-2], axis=1)
    most_m = np.maximum(_LONE_M, 0.5 * _LONE_MPS2 * before_s * after_s)
    alone[1:-1] = off_m > np.maximum(most_m, _LONE_APART * apart_m)
    return alone


def far_fixes(fixes: Sequence[GnssPosition]) -> NDArray[np.bool_]:
    """Return (N,) whether a fix is far from all others, see `far_fixes_of`; they may come in any order."""
    stamps_ns = np.array([f.stamp_ns for f in fixes], dtype=np.int64)
    order, far = np.argsort(stamps_ns, kind="stable"), np.zeros(len(fixes), dtype=bool)
    far[order] = far_fixes_of(stamps_ns[order], np.array([f.position for f in fixes]).reshape(-1, 3)[order])
    return far


def far_pose(pose: PoseFix) -> bool:
    """Return whether no mode of a pose is within `FAR_M` of the origin of world."""
    level = [pose.axes.index(axis) for axis in ("x", "y") if axis in pose.axes]
    return all(float(np.linalg.norm(np.asarray(mode.value)[level])) > FAR_M for mode in pose.modes)


def gnss_warnings(sensor: str, fixes: Sequence[GnssPosition], config: VesselConfig) -> list[str]:
    """Return a warning if the fixes are far from the configured datum, also if swapped coordinates explain it."""
    if config.datum is None or not fixes:
        return []
    datum = Datum(config.datum.geodetic)
    lla = np.array([f.position for f in fixes])
    lla[:, 1] = continuous_longitudes(lla[:, 1])
    lat, lon, height = (float(v) for v in np.median(lla, axis=0))

    def distance_m(a: float, b: float) -> float:
        return float(np.linalg.norm(datum.enu_from_geodetic(np.array([a]), np.array([b]), np.array([height]))))

    far = distance_m(lat, lon)
    if far < FAR_M:
        return []
    swapped = abs(lon) <= 90.0 and distance_m(lon, lat) < FAR_M
    why = "latitude and longitude look swapped" if swapped else "check the datum"
    return [f"{sensor}: the fixes lie {far / 1e3:.0f} km from the datum: {why}"]
