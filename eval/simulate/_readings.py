# SPDX-License-Identifier: Apache-2.0
"""Measurements of a motion by IMU, receiver, compass, speed log and an ideal matcher."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphloc.config import STANDARD_GRAVITY_MPS2, ImuConfig
from graphloc.eval.simulate._scenario import Scenario
from graphloc.eval.simulate._truth import Motion
from graphloc.eval.simulate.noise import gnss_error_m, reported_sigma_m
from graphloc.frames import Array, Datum, Geodetic, wrap_angle, yaw_from_rotation
from graphloc.measurements import (
    BodyVelocity,
    CompassHeading,
    GnssPosition,
    ImuSeries,
    Measurement,
    PoseFix,
    PoseMode,
)

START_NS = 1_700_000_000_000_000_000


def times(duration_s: float, rate_hz: float) -> Array:
    return np.arange(round(duration_s * rate_hz)) / rate_hz


def stamps(t: Array) -> NDArray[np.int64]:
    return START_NS + np.rint(t * 1e9).astype(np.int64)


def imu_series(
    s: Scenario, motion: Motion, datum: Datum, t: Array, mount: tuple[Array, Array], rng: np.random.Generator
) -> ImuSeries:
    force, rate = motion.inertial(t, mount[0], datum.gravity_mps2)
    defaults = ImuConfig()
    root = np.sqrt(s.imu_hz)

    def bias(size: float, walk: float) -> Array:
        direction = rng.normal(size=3)
        steps = rng.normal(0.0, walk / root, (len(t), 3))
        return size * direction / np.linalg.norm(direction) + np.cumsum(steps, axis=0)

    gyro_noise = np.radians(s.gyro_noise_mdps_per_sqrt_hz * 1e-3) * root
    accel_noise = s.accel_noise_ug_per_sqrt_hz * 1e-6 * STANDARD_GRAVITY_MPS2 * root
    gyro = rate @ mount[1] + bias(s.gyro_bias_radps, defaults.gyro_bias_walk_radps)
    accel = force @ mount[1] + bias(s.accel_bias_mps2, defaults.accel_bias_walk_mps2)
    return ImuSeries(
        sensor="imu",
        stamps_ns=stamps(t),
        accel_mps2=accel + rng.normal(0.0, accel_noise, (len(t), 3)),
        gyro_radps=gyro + rng.normal(0.0, gyro_noise, (len(t), 3)),
        seqs=np.arange(len(t)),
    )


def _silent(s: Scenario, t: Array) -> NDArray[np.bool_]:
    if s.outage_s is None:
        return np.zeros(len(t), dtype=bool)
    return np.asarray((t >= s.outage_s[0]) & (t < s.outage_s[1]))


def gnss_fixes(s: Scenario, motion: Motion, datum: Datum, lever: Array, rng: np.random.Generator) -> list[Measurement]:
    if s.gnss_hz == 0.0:
        return []
    t = times(s.duration_s - 0.05, s.gnss_hz) + 0.013  # not in step with the IMU
    p, R, _ = motion.pose(t)
    fixes = p + R @ lever + gnss_error_m(rng, t, s.noise, s.case, s.gnss_sigma_m)
    geodetic = datum.geodetic_from_enu(fixes)
    claimed = s.gnss_reported_sigma_m or s.gnss_sigma_m
    sigmas = np.full(len(t), claimed)
    if s.gnss_reported_spread > 0.0:
        sigmas = reported_sigma_m(rng, t, claimed, s.gnss_reported_spread)
    shape = np.diag([1.0, 1.0, 4.0])
    return [
        GnssPosition(stamp_ns=int(n), sensor="gnss", seq=0, position=Geodetic(*g), cov_enu_m2=sigma**2 * shape)
        for n, g, sigma, silent in zip(stamps(t), geodetic, sigmas, _silent(s, t), strict=True)
        if not silent
    ]


def compass_headings(s: Scenario, motion: Motion, rng: np.random.Generator) -> list[Measurement]:
    if s.compass_hz == 0.0:
        return []
    t = times(s.duration_s - 0.05, s.compass_hz) + 0.013
    sigma = np.radians(s.compass_sigma_deg)
    _, R, _ = motion.pose(t)
    yaw = yaw_from_rotation(R) + np.radians(s.compass_offset_deg) + rng.normal(0.0, sigma, len(t))
    return [
        CompassHeading(stamp_ns=int(n), sensor="compass", seq=0, yaw_rad=float(wrap_angle(y)), sigma_rad=sigma)
        for n, y, at in zip(stamps(t), yaw, t, strict=True)
        if at < s.compass_until_s
    ]


def log_speeds(s: Scenario, motion: Motion, rng: np.random.Generator) -> list[Measurement]:
    """Return the forward speed of body's origin, over ground or through the water."""
    if s.log_hz == 0.0:
        return []
    t = times(s.duration_s - 0.05, s.log_hz) + 0.029
    _, R, v = motion.pose(t)
    if s.log_through == "water":
        v = v - np.array([s.current_east_mps, s.current_north_mps, 0.0])
    ahead = (1.0 + s.log_scale_error) * np.einsum("ni,ni->n", R[:, :, 0], v) + rng.normal(0.0, s.log_sigma_mps, len(t))
    cov = np.array([[s.log_sigma_mps**2]])
    return [
        BodyVelocity(stamp_ns=int(n), sensor="log", seq=0, axes=("x",), value=np.array([u]), cov=cov)
        for n, u in zip(stamps(t), ahead, strict=True)
    ]


def made_up_matches(s: Scenario, motion: Motion, rng: np.random.Generator) -> list[Measurement]:
    """Return matches of the body pose; false ones are in BL's window, 1.5 to 5 m and up to 5 deg away."""
    if s.pose_hz == 0.0:
        return []
    t = times(s.duration_s - 0.5, s.pose_hz) + 0.437
    p, R, _ = motion.pose(t)
    yaw = yaw_from_rotation(R)
    sigmas = np.array([s.pose_sigma_m, s.pose_sigma_m, np.radians(s.pose_sigma_deg)])
    false = rng.uniform(size=len(t)) < s.false_fraction
    offset = np.zeros(3)
    out: list[Measurement] = []
    for i, (n, silent) in enumerate(zip(stamps(t), _silent(s, t), strict=True)):
        repeats = i > 0 and false[i - 1] and rng.uniform() < s.false_stays
        fresh = _false_offset(rng)
        offset = offset if repeats else fresh
        right = np.array([*p[i, :2], yaw[i]]) + rng.normal(0.0, sigmas)
        around = [_false_offset(rng) for _ in range(s.pose_modes - 1)]
        centre = right + (offset if false[i] else 0.0)
        values = [centre, *(right + o for o in around)]
        order = rng.permutation(len(values))
        modes = tuple(
            PoseMode(
                value=np.array([values[k][0], values[k][1], float(wrap_angle(values[k][2]))]),
                cov=np.diag(sigmas**2),
                probability=1.0 / len(values),
            )
            for k in order
        )
        if not silent:
            out.append(PoseFix(stamp_ns=int(n), sensor="matcher", seq=0, axes=("x", "y", "yaw"), modes=modes))
    return out


def _false_offset(rng: np.random.Generator) -> Array:
    size, angle = rng.uniform(1.5, 5.0), rng.uniform(0.0, 2.0 * np.pi)
    return np.array([size * np.cos(angle), size * np.sin(angle), np.radians(rng.uniform(-5.0, 5.0))])
