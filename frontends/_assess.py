# SPDX-License-Identifier: Apache-2.0
"""Judging sensors by each other: which way an IMU is mounted, what a compass means, how good the GNSS is.

Everything here is a guess with its evidence in words; `draft_config` writes both down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import STANDARD_GRAVITY_MPS2
from graphloc.frames import Array, Datum, Geodetic, rpy_from_rotation, wrap_angle
from graphloc.frontends import _clock
from graphloc.frontends._reports import CompassReport, GnssReport, ImuReport, MountGuess, TopicReport, Vec
from graphloc.frontends._sanity import NEVER_STILL_RADPS, far_fixes_of
from graphloc.frontends._streams import Stream
from graphloc.frontends._tf import StaticTree
from graphloc.frontends.decode import IMU, ODOMETRY, Rejection, yaw_of_x_axis
from graphloc.time import NS_PER_S

STATUS_NAMES = {-1: "no fix", 0: "fix", 1: "sbas", 2: "gbas"}
_WINDOW_S = 1.0
_MIN_COHERENCE = 0.25  # and 4 / sqrt(windows), four times what chance gives


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How the craft moved: times (N,) s since `origin_ns`, speed (N,) m/s (signed where the source knows)."""

    source: str
    origin_ns: int
    t_s: Array
    speed_mps: Array


@dataclass(frozen=True, slots=True, eq=False)
class Courses:
    """Course over ground (rad, from east, counter-clockwise) at some stamps, from chords of the GNSS track."""

    stamps_ns: NDArray[np.int64]
    course_rad: Array


def vec(values: ArrayLike) -> Vec:
    """Return three numbers as a tuple."""
    a, b, c = (float(v) for v in np.asarray(values))
    return (a, b, c)


def topic_report(stream: Stream, count: int) -> TopicReport:
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
        latency_s=vec(latency),
    )


def sane(stream: Stream) -> NDArray[np.intp]:
    """Return indices of messages in order of strictly increasing stamps, without clock jumps."""
    good = np.flatnonzero(~_clock.clock_jumps(stream.stamps_ns, stream.logs_ns))
    return good[_clock.longest_increasing(stream.stamps_ns[good])]


def track(fixes: Stream) -> tuple[NDArray[np.int64], Array, Array]:
    """Return stamps (N,), positions (N, 3) m about the first good fix, and the good fixes' rows."""
    keep = sane(fixes)
    rows = fixes.rows[keep] if len(keep) else np.zeros((0, 8))
    good = np.isfinite(rows[:, :3]).all(axis=1) & (rows[:, 3] >= 0) & (np.abs(rows[:, 0]) <= 90.0)
    good &= (rows[:, 0] != 0.0) | (rows[:, 1] != 0.0)
    keep, rows = keep[good], rows[good]
    near = ~far_fixes_of(rows[:, :3])
    keep, rows = keep[near], rows[near]
    if len(keep) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), rows
    datum = Datum(Geodetic(*rows[0, :3]))
    return fixes.stamps_ns[keep], datum.enu_from_geodetic(rows[:, 0], rows[:, 1], rows[:, 2]), rows


def courses_of(stamps_ns: NDArray[np.int64], p_m: Array, scatter_m: float) -> Courses:
    """Return the direction of chords of the track long enough that its noise does not turn them."""
    reach = max(3.0, 8.0 * scatter_m)
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


def gnss_report(fixes: Stream, tf_frame: str | None) -> GnssReport | None:
    """Return status, spread and a guess on slow errors; None where there is no fix at all."""
    stamps, p, rows = track(fixes)
    if len(stamps) == 0:
        return None
    status, counts = np.unique(fixes.rows[:, 3].astype(int), return_counts=True)
    known = (rows[:, 4] > 0) & np.isfinite(rows[:, 5:8]).all(axis=1) & (rows[:, 5:8] > 0.0).all(axis=1)
    sigma = np.sqrt(np.median(rows[known, 5:8], axis=0)) if known.any() else None
    # Third differences remove position, velocity and acceleration; those of white noise have 20 x its variance.
    scatter = 1.4826 * np.median(np.abs(np.diff(p, n=3, axis=0)), axis=0) / np.sqrt(20.0) if len(p) > 10 else None
    chords = np.diff(p[:: max(1, len(p) // 400), :2], axis=0)
    precise = sigma is not None and float(sigma[:2].max()) < 0.1 and float(np.median(rows[:, 3])) >= 2.0
    if precise:
        why = "status gbas (RTK) and a reported sigma below 0.1 m"
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
        height_range_m=float(np.subtract(*np.percentile(p[:, 2], [95, 5]))),
        extent_m=(float(np.ptp(p[:, 0])), float(np.ptp(p[:, 1]))),
        travelled_m=float(np.hypot(chords[:, 0], chords[:, 1]).sum()),
        first=vec(rows[0, :3]),
        slow_error=not precise,
        why=why,
        tf_frame=tf_frame,
    )


def motion_of(odometry: list[Stream], fixes: list[Stream]) -> Motion | None:
    """Return the speed of the craft from wheels, or else from fixes that are precise enough."""
    for stream in odometry:
        keep = sane(stream)
        if stream.msgtype == ODOMETRY and len(keep) > 20:
            speed = stream.rows[keep, 7]
            if np.isfinite(speed).all() and float(np.ptp(speed)) > 0.2:
                t = (stream.stamps_ns[keep] - stream.stamps_ns[keep[0]]) / NS_PER_S
                return Motion(stream.topic, int(stream.stamps_ns[keep[0]]), t, speed)
    for stream in fixes:
        stamps, p, _ = track(stream)
        if len(stamps) > 20:
            t = (stamps - stamps[0]) / NS_PER_S
            lag = max(1, round(_WINDOW_S / float(np.median(np.diff(t)))))
            v = (p[lag:, :2] - p[:-lag, :2]) / (t[lag:] - t[:-lag])[:, None]
            speed = np.hypot(v[:, 0], v[:, 1])
            if float(np.percentile(speed, 90)) > 2.0:
                return Motion(stream.topic, int(stamps[0]), (t[lag:] + t[:-lag]) / 2.0, speed)
    return None


def mount_guess(
    imu: Stream, accel: Array, gyro: Array, motion: Motion | None, tree: StaticTree, body: str
) -> MountGuess:
    """Return how an IMU sits in the body: from /tf_static, else levelled by gravity and turned by motion.

    Levelled, with unknown yaw psi, the horizontal acceleration as complex number a = ax + i ay meets that of
    the craft, m = dv/dt + i v w_z, as m = exp(i psi) a. So psi = arg sum(conj(a) m), and
    |sum| / sqrt(sum |a|^2 sum |m|^2) says how far the data support it. Snapped to quarter turns.

    Args:
        accel: (N, 3) m/s^2; gyro: (N, 3) rad/s, of the `sane` samples.
    """
    up = np.median(accel, axis=0)
    size = float(np.linalg.norm(up))
    pose = tree.resolve(body, imu.frame_id) if imu.frame_id in tree.frames else None
    if pose is not None:
        rpy = vec(np.degrees(rpy_from_rotation(pose[1])))
        tilt = float(np.degrees(np.arccos(np.clip((pose[1] @ up)[2] / max(size, 1e-9), -1.0, 1.0))))
        note = "" if size < 2.0 or tilt < 20.0 else f", BUT gravity is then {tilt:.0f} deg off body z: check"
        return MountGuess(rpy_deg=rpy, tf_frame=imu.frame_id, evidence=f"/tf_static knows it{note}")
    if size < 0.5 * STANDARD_GRAVITY_MPS2:
        return MountGuess(rpy_deg=(0.0, 0.0, 0.0), tf_frame=None, evidence="no gravity to level by: taken as aligned")
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
    yaw, evidence = _mount_yaw(imu, accel @ level.T, gyro @ level.T, motion)
    turn = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
    rpy = vec(np.round(np.degrees(rpy_from_rotation(turn @ level)), 1) + 0.0)
    return MountGuess(rpy_deg=rpy, tf_frame=None, evidence=f"{said}; {evidence}")


def _level(axis: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes a unit vector to +z (half a turn about x for -z)."""
    z = np.array([0.0, 0.0, 1.0])
    cross = np.cross(axis, z)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-9:
        return np.diag([1.0, 1.0, 1.0]) if axis[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    angle = float(np.arctan2(sine, axis[2]))
    return np.asarray(Rotation.from_rotvec(angle * cross / sine).as_matrix())


def _mount_yaw(imu: Stream, accel: Array, gyro: Array, motion: Motion | None) -> tuple[float, str]:
    """Return the quarter turn (deg) that fits the motion, and the evidence; `accel`, `gyro` are levelled."""
    if motion is None:
        return 0.0, "no motion to tell its yaw by: taken as 0"
    t = (imu.stamps_ns[sane(imu)] - motion.origin_ns) / NS_PER_S
    edges = np.arange(max(t[0], motion.t_s[0]), min(t[-1], motion.t_s[-1]), _WINDOW_S)
    if len(edges) < 20:
        return 0.0, "too little motion to tell its yaw by: taken as 0"

    def mean(columns: Array) -> Array:
        """Mean over each window, from the running integral."""
        total = np.concatenate([[0.0], np.cumsum(0.5 * (columns[1:] + columns[:-1]) * np.diff(t))])
        return np.asarray(np.diff(np.interp(edges, t, total)) / _WINDOW_S)

    v = np.interp(edges, motion.t_s, motion.speed_mps)
    m = np.diff(v) / _WINDOW_S + 1j * 0.5 * (v[1:] + v[:-1]) * mean(gyro[:, 2])
    a = mean(accel[:, 0]) + 1j * mean(accel[:, 1])
    a, m = a - np.median(a.real) - 1j * np.median(a.imag), m - m.mean()
    power = float(np.sqrt((np.abs(a) ** 2).sum() * (np.abs(m) ** 2).sum()))
    product = complex((np.conj(a) * m).sum())
    coherence = abs(product) / power if power > 0.0 else 0.0
    psi = float(np.degrees(np.angle(product)))
    if coherence < max(_MIN_COHERENCE, 4.0 / float(np.sqrt(len(a)))):
        return 0.0, f"motion of {motion.source} does not tell its yaw (coherence {coherence:.2f}): taken as 0"
    quarter = float(wrap_angle(np.radians(90.0 * round(psi / 90.0))))
    return float(
        np.degrees(quarter)
    ), f"yaw by the motion of {motion.source}: {psi:.0f} deg (coherence {coherence:.2f})"


def imu_report(imu: Stream, motion: Motion | None, tree: StaticTree, body: str) -> ImuReport | None:
    """Return units, gravity, standstill, noise and mount of an IMU."""
    keep = sane(imu)
    rows = imu.rows[keep] if len(keep) else np.zeros((0, 13))
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(rows[:, :6]).all(axis=1))
    if finite.sum() < 20:
        return None
    stamps = imu.stamps_ns[keep]
    accel, gyro = np.where(finite[:, None], rows[:, :3], 0.0), np.where(finite[:, None], rows[:, 3:6], 0.0)
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    rate = float(np.median(np.linalg.norm(gyro, axis=1)))
    why = []
    accel_unit = "g" if 0.9 < size < 1.1 else "m/s^2"
    gravity = "removed" if size < 0.5 else "included"
    gyro_unit = "deg/s" if rate > NEVER_STILL_RADPS else "rad/s"
    if accel_unit == "g":
        why.append(f"median acceleration is {size:.2f}: looks like g")
    if gravity == "removed":
        why.append(f"median acceleration is {size:.2f}: looks like gravity was removed by the driver")
    if accel_unit == "m/s^2" and gravity == "included" and not 8.5 < size < 11.5:
        why.append(f"median acceleration is {size:.2f}: neither m/s^2 nor g with gravity; check the sensor")
    if gyro_unit == "deg/s":
        why.append(f"median rate is {rate:.2f}: too much for rad/s, looks like deg/s")
    accel = accel * (STANDARD_GRAVITY_MPS2 if accel_unit == "g" else 1.0)
    gyro = gyro * (np.pi / 180.0 if gyro_unit == "deg/s" else 1.0)
    up = np.median(accel, axis=0)
    still = _standstill(stamps, accel, gyro, motion)
    root_dt = float(np.sqrt(np.median(np.diff(stamps)) / NS_PER_S))
    quiet = still.sum() > 20

    def density(columns: Array) -> float:
        steps = np.diff(columns[still], axis=0)  # of the axis in the middle: one bad axis does not speak for all
        return float(1.4826 * np.median(np.median(np.abs(steps), axis=0)) / np.sqrt(2.0)) * root_dt

    def reported(column: int, unit: float) -> float | None:
        variance = float(np.median(rows[:, column]))
        return float(np.sqrt(variance)) * root_dt / unit if np.isfinite(variance) and variance > 0.0 else None

    ug, mdps = 1e-6 * STANDARD_GRAVITY_MPS2, np.radians(1e-3)
    return ImuReport(
        topic=imu.topic,
        gravity_size=size,
        gravity_axis=vec(up / max(float(np.linalg.norm(up)), 1e-9)),
        accel_unit=accel_unit,
        gyro_unit=gyro_unit,
        gravity=gravity,
        why=tuple(why),
        still_s=float(still.sum()) * root_dt**2,
        gyro_bias_radps=vec(gyro[still].mean(axis=0)) if quiet else None,
        accel_noise_ug=density(accel) / ug if quiet else None,
        gyro_noise_mdps=density(gyro) / mdps if quiet else None,
        reported_accel_ug=reported(10, ug),
        reported_gyro_mdps=reported(11, mdps),
        mount=mount_guess(imu, accel, gyro, motion, tree, body),
    )


def _standstill(stamps: NDArray[np.int64], accel: Array, gyro: Array, motion: Motion | None) -> NDArray[np.bool_]:
    """Return (N,) whether a sample lies in a quiet second (and the speed, where known, is zero)."""
    second = (stamps - stamps[0]) // NS_PER_S
    still = np.zeros(len(stamps), dtype=bool)
    for s in np.unique(second):
        part = second == s
        quiet = float(gyro[part].std(axis=0).max()) < 0.03 and float(accel[part].std(axis=0).max()) < 0.2
        still[part] = quiet and float(np.abs(gyro[part].mean(axis=0)).max()) < 0.02
    if motion is not None:
        t = (stamps - motion.origin_ns) / NS_PER_S
        still[np.abs(np.interp(t, motion.t_s, motion.speed_mps)) > 0.05] = False
    return still


def compass_report(stream: Stream, courses: Courses | None) -> CompassReport | None:
    """Return whether an orientation is a heading, and in which convention; None where there is none."""
    keep = sane(stream)
    if len(keep) < 10:
        return None
    rows = stream.rows[keep]
    quaternions = rows[:, 6:10] if stream.msgtype == IMU else rows[:, :4]
    if stream.msgtype == IMU and (float(np.median(rows[:, 12])) == -1.0 or len(np.unique(quaternions, axis=0)) < 3):
        return None
    yaw = [yaw_of_x_axis(*(float(v) for v in q)) for q in quaternions]
    good = np.array([not isinstance(y, Rejection) for y in yaw])
    plain = {"topic": stream.topic, "msgtype": stream.msgtype}
    if good.sum() < 10:
        why = "its quaternions give no yaw"
        return CompassReport(
            **plain, usable=False, convention="enu", offset_deg=None, scatter_deg=None, samples=0, why=why
        )
    angle = np.unwrap(np.array([y for y in yaw if not isinstance(y, Rejection)]))
    named = stream.msgtype != IMU  # a topic of bare headings is meant as a compass
    if courses is None or len(courses.stamps_ns) < 20:
        why = "no GNSS course in motion to check it by"
        return CompassReport(
            **plain, usable=named, convention="enu", offset_deg=None, scatter_deg=None, samples=0, why=why
        )
    origin = int(stream.stamps_ns[keep[0]])
    measured = np.interp(
        (courses.stamps_ns - origin) / NS_PER_S, (stream.stamps_ns[keep][good] - origin) / NS_PER_S, angle
    )
    fits = {}
    for convention, value in (("enu", measured), ("ned", np.pi / 2.0 - measured)):
        mean = complex(np.exp(1j * (value - courses.course_rad)).mean())
        scatter = float(np.degrees(np.sqrt(-2.0 * np.log(max(abs(mean), 1e-9)))))
        fits[convention] = (float(np.degrees(np.angle(mean))), scatter)
    turned = float(np.degrees(np.sqrt(max(0.0, -2.0 * np.log(max(abs(np.exp(1j * courses.course_rad).mean()), 1e-9))))))
    if turned < 20.0:  # on a straight both conventions fit with some offset: the smaller offset is likelier
        convention = min(fits, key=lambda c: abs(fits[c][0]))
    else:
        convention = min(fits, key=lambda c: fits[c][1])
    offset, scatter = fits[convention]
    usable = scatter < 15.0
    why = f"yaw minus GNSS course: {offset:+.0f} deg, scatter {scatter:.0f} deg over {len(measured)} courses"
    if not usable:
        why += ": only relative, or disturbed"
    elif turned < 20.0:
        why += ", on a nearly straight track: the convention is not certain"
    return CompassReport(
        **plain,
        usable=usable,
        convention=convention,
        offset_deg=offset,
        scatter_deg=scatter,
        samples=len(measured),
        why=why,
    )
