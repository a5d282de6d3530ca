# SPDX-License-Identifier: Apache-2.0
"""Inputs of the EKFs: the IMU in steps, measurements with their mounts, the start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphloc.build import mount_of
from graphloc.config import VesselConfig
from graphloc.errors import SolveError
from graphloc.frames import Array, Datum, skew, yaw_from_rotation
from graphloc.measurements import (
    BodyVelocity,
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    Measurement,
    PoseFix,
    PoseMode,
    TagSighting,
    world_from_fixes,
)
from graphloc.recording import Recording
from graphloc.signals.series import integral, interpolated
from graphloc.survey import Survey
from graphloc.time import NS_PER_S, seconds_since


@dataclass(frozen=True, slots=True)
class Interval:
    """Mean IMU data between two filter steps, in body axes.

    Attributes:
        stop_ns: stamp of the second step. rate: yaw rate, rad/s. silent: whether the data were missing.
    """

    stop_ns: int
    accel: Array  # (2,) surge, sway, m/s^2, with the share of gravity that tilt adds
    leak: Array  # (2,) mean of `accel` over the last 20 s: a planar filter knows no tilt, and takes this for its share
    rate: float
    silent: bool


@dataclass(frozen=True, slots=True)
class MountedMeasurement:
    """A measurement with the mount of its sensor in body: lever arm (3,), m, and yaw, rad."""

    m: Measurement
    lever: Array
    mount_yaw: float


def intervals_of(recording: Recording, config: VesselConfig, rate_hz: float) -> list[Interval]:
    imu = recording.imu
    if imu is None:
        raise SolveError(f"{recording.source}: no IMU data for the filter")
    imu_config = config.sensors[imu.sensor]
    _, R = mount_of(imu.sensor, imu_config, recording.mounts)
    samples = np.hstack([imu.accel_mps2 @ R.T, imu.gyro_radps @ R.T])
    t = seconds_since(int(imu.stamps_ns[0]), imu.stamps_ns)
    edges = np.arange(0.0, t[-1], 1.0 / rate_hz)
    total = integral(t, samples)
    there = interpolated(edges, t, total)
    mean = np.diff(there, axis=0) * rate_hz
    count = np.arange(1, len(mean) + 1)
    width = np.minimum(count, round(20.0 * rate_hz))
    leak = (there[count, :2] - there[count - width, :2]) * rate_hz / width[:, None]
    right = np.clip(np.searchsorted(t, edges[1:]), 1, len(t) - 1)
    silent = t[right] - t[right - 1] > imu_config.max_gap_s
    stops = imu.stamps_ns[0] + np.rint(edges[1:] * NS_PER_S).astype(np.int64)
    return [
        Interval(int(stop), m[:2], g, float(m[5]), bool(hole))
        for stop, m, g, hole in zip(stops, mean, leak, silent, strict=True)
    ]


def measurements_of(recording: Recording, config: VesselConfig) -> list[MountedMeasurement]:
    measured = []
    for m in recording.measurements:
        sensor = config.sensors.get(m.sensor)
        if isinstance(m, TagSighting) and sensor:
            m = as_pose(m, sensor.surveyed)
        if isinstance(m, BodyVelocity) and not {"x", "y"} & set(m.axes):
            continue  # vertical only: the filters are planar
        planar = GnssPosition | GnssVelocity | BodyVelocity | CompassHeading | PoseFix
        if isinstance(m, planar) and sensor and sensor.enabled:
            t, R = mount_of(m.sensor, sensor, recording.mounts)
            measured.append(MountedMeasurement(m, t, float(yaw_from_rotation(R))))
    return measured


def as_pose(m: TagSighting, survey: Survey) -> PoseFix:
    """Return the planar poses of body that a sighting of tags gives, likeliest first.

    With t from body to the tags' middle c, the position of body is c - t; its covariance includes the errors of the
    attitude, and for tags on a dock the dock's configured motion.
    """
    modes, dock = [], survey.dock(m.frame)
    for mode in m.modes:
        R = mode.R_world_camera @ m.R_body_camera.T
        arm = R @ m.t_body_camera_m + m.points_m.mean(axis=0) - mode.p_world_camera_m  # from the body to the tags
        J = np.zeros((3, 6))
        J[:2, :3] = -mode.R_world_camera[:2]
        J[:2, 3:], J[2, 3:] = (skew(arm) @ mode.R_world_camera)[:2], mode.R_world_camera[2]
        cov = J @ mode.cov @ J.T + np.diag([1e-4, 1e-4, 1e-6])
        if dock is not None:
            cov += np.diag([dock.moves_m**2 / 4.0] * 2 + [np.radians(dock.moves_deg) ** 2 / 4.0])
        p = mode.p_world_camera_m - R @ m.t_body_camera_m
        yaw = float(yaw_from_rotation(R))
        modes.append(PoseMode(value=np.array([p[0], p[1], yaw]), cov=cov, probability=mode.probability))
    return PoseFix(stamp_ns=m.stamp_ns, sensor=m.sensor, seq=m.seq, axes=("x", "y", "yaw"), modes=tuple(modes))


def starts_at_truth(recording: Recording) -> bool:
    """Return whether the truth holds the pose at which a filter starts."""
    truth, imu = recording.truth, recording.imu
    return truth is not None and truth.headed and imu is not None and bool(truth.covers(imu.stamps_ns[:1]).all())


def start_of(measured: list[MountedMeasurement], recording: Recording, datum: Datum) -> Array:
    """Return the first five states (5,) as BL chooses them: the true pose, else by the first fixes and heading."""
    if starts_at_truth(recording):
        assert recording.truth is not None
        assert recording.imu is not None
        there = recording.truth.at(recording.imu.stamps_ns[:1])
        v = there.R_world_body[0].T @ there.v_world_mps[0] if there.v_world_mps is not None else np.zeros(3)
        return np.array([*there.p_world_m[0, :2], v[0], v[1], there.yaw_rad[0]])
    fixes = [e.m for e in measured if isinstance(e.m, GnssPosition)]
    poses = [e.m for e in measured if isinstance(e.m, PoseFix) and e.m.axes[:2] == ("x", "y")]
    heading = next((e for e in measured if isinstance(e.m, CompassHeading)), None)
    track = world_from_fixes(fixes, datum)[:, :2] if fixes else np.zeros((1, 2))
    p = track[0] if fixes or not poses else poses[0].modes[0].value[:2]
    psi = 0.0
    if heading is not None:
        assert isinstance(heading.m, CompassHeading)
        psi = heading.m.yaw_rad - heading.mount_yaw + float(datum.convergence_rad(p))
    else:
        far = np.flatnonzero(np.hypot(*(track - track[0]).T) > 5.0)
        if len(far):
            psi = float(np.arctan2(*(track[far[0]] - track[0])[::-1]))
    v = _first_velocity(fixes, track)
    c, s = np.cos(psi), np.sin(psi)
    return np.array([*p, c * v[0] + s * v[1], -s * v[0] + c * v[1], psi])


def _first_velocity(fixes: list[GnssPosition], track: Array) -> Array:
    """Return the velocity (2,), m/s, by the slope of the first 5 s of fixes."""
    t = np.array([(f.stamp_ns - fixes[0].stamp_ns) / NS_PER_S for f in fixes[:100]])
    soon = t < 5.0
    if soon.sum() < 3 or np.ptp(t[soon]) < 1.0:
        return np.zeros(2)
    return np.array([np.polyfit(t[soon], track[:100][soon, k], 1)[0] for k in range(2)])
