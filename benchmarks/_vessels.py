# SPDX-License-Identifier: Apache-2.0
"""Vessels drawn by chance: how they move, what they carry, what goes wrong. No number of the product was fitted to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from graphloc.blocks import MountConfig
from graphloc.config import (
    CompassConfig,
    DatumConfig,
    GnssConfig,
    HeightConfig,
    ImuConfig,
    PoseConfig,
    VelocityConfig,
    VesselConfig,
)
from graphloc.eval.simulate import Scenario
from graphloc.eval.simulate._readings import imu_series, stamps, times
from graphloc.eval.simulate._truth import Motion, Waves, make_motion
from graphloc.frames import Array, Datum, Geodetic, wrap_angle
from graphloc.measurements import CompassHeading, GnssPosition, GnssVelocity, Measurement, PoseFix, PoseMode
from graphloc.recording import Recording
from graphloc.trajectory import Trajectory

_ORIGIN = Geodetic(57.7, 11.7, 36.0)
_PATHS = {
    "wander": 0.3,
    "stops": 0.2,
    "still_then_go": 0.1,
    "circles": 0.1,
    "zigzag": 0.1,
    "straight": 0.1,
    "astern": 0.1,
}
_GNSS = {"clean": 0.2, "drift": 0.35, "jump": 0.2, "drift_jump": 0.25}


@dataclass(frozen=True)
class DrawnRun:
    """A run of a drawn vessel; `late_ns` is by how much a message comes late (by seq), `drawn` what chance chose."""

    recording: Recording
    config: VesselConfig
    truth: Trajectory
    late_ns: dict[int, int]
    drawn: dict[str, Any]


@dataclass
class _Yard:
    """A vessel while it is built; each instrument takes its draws from `rng` in turn."""

    rng: np.random.Generator
    duration_s: float
    motion: Motion
    datum: Datum
    drawn: dict[str, Any]
    sensors: dict[str, Any] = field(default_factory=dict)
    measurements: list[Measurement] = field(default_factory=list)

    def between(self, low: float, high: float) -> float:
        """Uniform in the logarithm: for what spans decades."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def chance(self, p: float) -> bool:
        return bool(self.rng.uniform() < p)

    def mount(self, far_m: float, turns: bool = True) -> MountConfig:
        turned = Rotation.random(random_state=self.rng) if turns and self.chance(0.5) else Rotation.identity()
        xyz = self.rng.uniform(-far_m, far_m, 3) * [1.0, 0.5, 0.5]
        return MountConfig(xyz_m=_floats(xyz), rpy_deg=_floats(turned.as_euler("xyz", degrees=True)))

    def heard(self, t: Array, name: str, p: float = 0.5) -> NDArray[np.bool_]:
        """False where the sensor is out, once or twice with probability `p`."""
        keep, outages = np.ones(len(t), dtype=bool), []
        if self.chance(p):
            for _ in range(self.rng.integers(1, 3)):
                begin = self.rng.uniform(0.0, self.duration_s)
                end = begin + self.between(3.0, min(60.0, self.duration_s / 3.0))
                outages.append([round(begin), round(end)])
                keep &= ~((t >= begin) & (t < end))
        self.drawn[f"{name}_out"] = outages
        return keep


def _floats(values: Array) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)


def gauss_markov(rng: np.random.Generator, t: Array, sigma: float, tau_s: float, axes: int) -> Array:
    """A first-order Gauss-Markov process (N, axes)."""
    x = np.zeros((len(t), axes))
    x[0] = rng.normal(0.0, sigma, axes)
    for i, dt in enumerate(np.diff(t), 1):
        kept = np.exp(-dt / tau_s)
        x[i] = kept * x[i - 1] + rng.normal(0.0, sigma * np.sqrt(1.0 - kept**2), axes)
    return x


def _motion(rng: np.random.Generator, duration_s: float, drawn: dict[str, Any]) -> Motion:
    top = drawn["speed"] = float(np.exp(rng.uniform(np.log(0.3), np.log(12.0))))
    path = drawn["path"] = str(rng.choice(list(_PATHS), p=list(_PATHS.values())))
    n = max(4, int(duration_s / 8.0) + 4)
    knots = np.linspace(-2.0, duration_s + 2.0, n)
    fastest = min(0.35, 2.0 / top)
    speed, rate = top * rng.uniform(0.3, 1.0, n), rng.normal(0.0, 0.4 * fastest, n)
    if path == "stops":
        speed *= rng.uniform(size=n) < 0.6
    elif path == "still_then_go":
        speed[: n // 3] = rate[: n // 3] = 0.0
    elif path == "circles":
        rate[:] = rng.choice([-1, 1]) * rng.uniform(0.3, 0.8) * fastest
    elif path == "zigzag":
        rate = fastest * 0.8 * np.where(np.arange(n) % 2, 1.0, -1.0)
    elif path == "straight":
        rate *= 0.02
    elif path == "astern":
        speed *= np.where(rng.uniform(size=n) < 0.5, -0.4, 1.0)
    step = min(1.0, top / 4.0) * (knots[1] - knots[0])
    for i in range(1, n):
        speed[i] = np.clip(speed[i], speed[i - 1] - step, speed[i - 1] + step)

    def smooth(values: Array) -> Callable[[Array], Array]:
        through = PchipInterpolator(knots, values)
        return lambda t: np.mean(
            [through(np.clip(t + o, -2.0, duration_s + 2.0)) for o in np.linspace(-1.0, 1.0, 11)], axis=0
        )

    sway = Waves.jonswap(rng, rng.uniform(0.0, 0.15), 12.0)
    roll, pitch, heave = rng.uniform(0.2, 5.0), rng.uniform(0.2, 3.0), rng.uniform(0.02, 0.3)
    drawn |= {"roll": float(roll), "pitch": float(pitch), "heave": float(heave)}
    waves = (
        Waves.jonswap(rng, np.radians(roll), rng.uniform(3.0, 6.0)),
        Waves.jonswap(rng, np.radians(pitch), rng.uniform(3.0, 6.0)),
        Waves.jonswap(rng, heave, rng.uniform(3.5, 7.0)),
    )
    heading = rng.uniform(-np.pi, np.pi)
    return make_motion(duration_s, smooth(speed), smooth(rate), heading, sway.at, waves, float(rng.uniform(0.0, 0.05)))


def _gnss_error(yard: _Yard, t: Array, name: str) -> tuple[Array, float]:
    """Errors (N, 3), m, and the standard deviation of their white part."""
    rng = yard.rng
    kind = str(rng.choice(list(_GNSS), p=list(_GNSS.values())))
    white = yard.between(0.03, 1.0)
    error = rng.normal(0.0, white, (len(t), 3)) * [1.0, 1.0, 2.0]
    said: dict[str, Any] = {"kind": kind, "white": white}
    if "drift" in kind:
        said |= {"sigma": float(rng.uniform(0.4, 2.2)), "tau": float(rng.uniform(60.0, 400.0))}
        error += gauss_markov(rng, t, said["sigma"], said["tau"], 3) * [1.0, 1.0, 1.5]
    if "jump" in kind:
        said["jumps"] = []
        for _ in range(rng.integers(1, 4)):
            at, lasts, size = rng.uniform(0.0, t[-1]), rng.uniform(2.0, 40.0), rng.uniform(2.0, 15.0)
            angle = rng.uniform(-np.pi, np.pi)
            said["jumps"].append([round(at), round(lasts), round(size, 1)])
            error[(t >= at) & (t < at + lasts), :2] += size * np.array([np.cos(angle), np.sin(angle)])
    yard.drawn[name] = said
    return error, white


def _receiver(yard: _Yard, name: str, delay_s: float) -> None:
    rate_hz = yard.drawn[f"{name}_hz"] = yard.between(0.2, 10.0)
    t = times(yard.duration_s - 0.2, rate_hz) + delay_s
    mount = yard.mount(5.0, turns=False)
    yard.sensors[name] = GnssConfig(topic=f"/{name}", mount=mount)
    error, white = _gnss_error(yard, t, name)
    p, R, _ = yard.motion.pose(t)
    geodetic = yard.datum.geodetic_from_enu(p + R @ mount.t_body_sensor_m + error)
    keep = yard.heard(t, name)
    flat = yard.drawn[f"{name}_flat"] = yard.chance(0.15)
    cov = np.diag([white**2, white**2, 1e12 if flat else 4.0 * white**2])
    yard.measurements += [
        GnssPosition(stamp_ns=int(n), sensor=name, seq=0, position=Geodetic(*g), cov_enu_m2=cov)
        for n, g in zip(stamps(t[keep]), geodetic[keep], strict=True)
    ]


def _velocities(yard: _Yard, sigma_mps: float = 0.08) -> None:
    t = times(yard.duration_s - 0.2, 5.0) + 0.02
    mount = yard.sensors["gnss"].mount
    yard.sensors["velocity"] = VelocityConfig(topic="/velocity", mount=mount)
    (p0, R0, _), (p1, R1, _) = yard.motion.pose(t - 1e-3), yard.motion.pose(t + 1e-3)
    v = (p1 + R1 @ mount.t_body_sensor_m - p0 - R0 @ mount.t_body_sensor_m) / 2e-3
    v = v + yard.rng.normal(0.0, sigma_mps, v.shape)
    cov = sigma_mps**2 * np.eye(3)
    yard.measurements += [
        GnssVelocity(stamp_ns=int(n), sensor="velocity", seq=0, v_enu_mps=x, cov_m2ps2=cov)
        for n, x in zip(stamps(t), v, strict=True)
    ]


def _compass(yard: _Yard) -> None:
    rng = yard.rng
    rate_hz, sigma_deg = yard.between(1.0, 20.0), float(rng.uniform(0.3, 3.0))
    t = times(yard.duration_s - 0.2, rate_hz) + 0.007
    _, R, _ = yard.motion.pose(t)
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    heading = np.pi / 2.0 - yaw
    A, B, C = np.radians(rng.normal(0.0, [1.0, 1.2, 1.2]))
    yaw = yaw + A + B * np.sin(heading) + C * np.cos(heading)
    yaw = yaw + gauss_markov(rng, t, np.radians(0.4), 60.0, 1)[:, 0] + rng.normal(0.0, np.radians(sigma_deg), len(t))
    keep = yard.heard(t, "compass", 0.2)
    yard.drawn |= {"compass_hz": rate_hz, "compass_sigma": sigma_deg, "deviation": list(np.degrees([A, B, C]))}
    yard.sensors["compass"] = CompassConfig(topic="/compass", sigma_deg=sigma_deg)
    yard.measurements += [
        CompassHeading(stamp_ns=int(n), sensor="compass", seq=0, yaw_rad=float(wrap_angle(y)), sigma_rad=np.radians(sigma_deg))
        for n, y in zip(stamps(t[keep]), yaw[keep], strict=True)
    ]  # fmt: skip


def _false(yard: _Yard, t: Array, fraction: float) -> NDArray[np.bool_]:
    """Which matches are false: each by itself, or for seconds on end."""
    rng = yard.rng
    length_s = yard.drawn["cluster_s"] = float(rng.choice([0.0, 3.0, 8.0]))
    if length_s == 0.0:
        return np.asarray(rng.uniform(size=len(t)) < fraction)
    false, now = np.zeros(len(t), dtype=bool), 0.0
    while now < yard.duration_s and fraction > 0.0:
        now += rng.exponential(length_s * (1.0 - fraction) / max(fraction, 0.02))
        lasts = rng.uniform(0.5, 1.5) * length_s
        false |= (t >= now) & (t < now + lasts)
        now += lasts
    return false


def _matches(yard: _Yard) -> None:
    rng, drawn, T = yard.rng, yard.drawn, yard.duration_s
    rate_hz, sigma_m, sigma_deg = yard.between(0.2, 5.0), yard.between(0.05, 0.6), float(rng.uniform(0.2, 2.0))
    full = yard.chance(0.2)
    axes: tuple[Any, ...] = ("x", "y", "z", "roll", "pitch", "yaw") if full else ("x", "y", "yaw")
    if yard.chance(0.15) and not full:
        axes = ("x", "y")
    fraction = float(rng.choice([0.0, rng.uniform(0.0, 0.5)], p=[0.2, 0.8]))
    stays = float(rng.choice([0.0, 0.5, 0.8]))
    begin = rng.uniform(0.0, 0.6 * T) if yard.chance(0.25) else 0.0
    end = rng.uniform(begin + 0.2 * T, T) if yard.chance(0.25) else T
    t = times(T - 0.2, rate_hz) + 0.111
    t = t[(t >= begin) & (t <= end)]
    keep = yard.heard(t, "matches", 0.25)
    false = _false(yard, t, fraction)
    mount = yard.mount(3.0, turns=False) if yard.chance(0.3) else MountConfig()
    yard.sensors["aerial"] = PoseConfig(topic="/aerial", axes=axes, mount=mount)
    p, R, _ = yard.motion.pose(t)
    p = p + R @ mount.t_body_sensor_m
    off, sigma_rad = np.zeros(3), np.radians(sigma_deg)
    sigmas = {k: sigma_m if k in "xyz" else sigma_rad for k in axes}
    for i, n in enumerate(stamps(t)):
        if false[i] and not (i and false[i - 1] and yard.chance(stays)):
            size, angle = rng.uniform(1.5, 5.0), rng.uniform(0.0, 2.0 * np.pi)
            off = np.array([size * np.cos(angle), size * np.sin(angle), np.radians(rng.uniform(-5.0, 5.0))])
        turned = Rotation.from_rotvec(rng.normal(0.0, sigma_rad, 3)) * Rotation.from_matrix(R[i])
        roll, pitch, yaw = turned.as_euler("xyz")
        x, y, z = p[i] + rng.normal(0.0, sigma_m, 3)
        dx, dy, dyaw = off if false[i] else np.zeros(3)
        value = {"x": x + dx, "y": y + dy, "z": z, "roll": roll, "pitch": pitch, "yaw": float(wrap_angle(yaw + dyaw))}
        mode = PoseMode(value=np.array([value[k] for k in axes]), cov=np.diag([sigmas[k] ** 2 for k in axes]))
        if keep[i]:
            yard.measurements.append(PoseFix(stamp_ns=int(n), sensor="aerial", seq=0, axes=axes, modes=(mode,)))
    drawn |= {
        "matches": len(t), "false_matches": int(false.sum()), "match_hz": rate_hz, "match_sigma": [sigma_m, sigma_deg],
        "axes": list(axes), "matched": [round(begin), round(end)],
    }  # fmt: skip


def drawn_run(seed: int) -> DrawnRun:
    """A vessel of 0.3 to 12 m/s, one to five minutes, with an IMU and a receiver, and chance's choice of the rest."""
    rng = np.random.default_rng([seed, 4711])
    drawn: dict[str, Any] = {"seed": seed}
    duration_s = drawn["duration_s"] = float(rng.choice([60, 60, 90, 90, 120, 120, 180, 300]))
    yard = _Yard(rng, duration_s, _motion(rng, duration_s, drawn), Datum(_ORIGIN), drawn)
    noise = Scenario(
        path="loops", duration_s=duration_s, imu_hz=float(np.round(yard.between(25.0, 400.0))),
        accel_noise_ug_per_sqrt_hz=yard.between(60.0, 3000.0), gyro_noise_mdps_per_sqrt_hz=yard.between(3.0, 60.0),
        gyro_bias_radps=float(abs(rng.normal(0.0, 0.02))), accel_bias_mps2=float(abs(rng.normal(0.0, 0.06))),
    )  # fmt: skip
    mount, t = yard.mount(4.0), times(duration_s, noise.imu_hz)
    imu = imu_series(noise, yard.motion, yard.datum, t, (mount.t_body_sensor_m, mount.R_body_sensor), rng)
    densities = {k: getattr(noise, k) for k in ("accel_noise_ug_per_sqrt_hz", "gyro_noise_mdps_per_sqrt_hz")}
    drawn |= {"imu_hz": noise.imu_hz, **densities, "biases": [noise.gyro_bias_radps, noise.accel_bias_mps2]}
    yard.sensors["imu"] = ImuConfig(topic="/imu", mount=mount, **densities)
    if yard.chance(0.85):
        yard.sensors["height"] = HeightConfig(height_m=_ORIGIN.height_m)
    second = yard.chance(0.2)
    _receiver(yard, "gnss", 0.013)
    if second:
        _receiver(yard, "gnss2", 0.063)
    if yard.chance(0.15):
        _velocities(yard)
    if yard.chance(0.75):
        _compass(yard)
    if yard.chance(0.75):
        _matches(yard)
    measurements = sorted(yard.measurements, key=lambda m: (m.stamp_ns, m.sensor))
    measurements = [replace(m, seq=len(imu) + i) for i, m in enumerate(measurements)]
    lag_s = {k: float(rng.choice([0.0, rng.uniform(0.0, 0.3)])) for k in yard.sensors}
    if "aerial" in lag_s:
        lag_s["aerial"] = float(rng.choice([0.0, rng.uniform(0.0, 2.5)]))
    late_ns = {m.seq: int(1e9 * lag_s[m.sensor]) for m in measurements if lag_s[m.sensor] > 0.0}
    drawn["late_s"] = {k: v for k, v in lag_s.items() if v > 0.0 and k not in ("imu", "height")}
    p, R, v = yard.motion.pose(t)
    truth = Trajectory(stamps_ns=stamps(t), p_world_m=p, R_world_body=R, v_world_mps=v)
    datum = DatumConfig(
        latitude_deg=_ORIGIN.latitude_deg, longitude_deg=_ORIGIN.longitude_deg, height_m=_ORIGIN.height_m
    )
    recording = Recording(
        source="(drawn)", imu=imu, measurements=tuple(measurements), message_count=len(imu) + len(measurements),
        topics={k: s.topic for k, s in yard.sensors.items()}, truth=truth,
    )  # fmt: skip
    config = VesselConfig(vessel="drawn", datum=datum, sensors=yard.sensors, truth_topic="/truth")
    return DrawnRun(recording, config, truth, late_ns, drawn)
