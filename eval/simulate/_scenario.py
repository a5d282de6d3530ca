# SPDX-License-Identifier: Apache-2.0
"""Scenarios, and the run that comes of one with a seed: truth, measurements, and an honest vessel.yaml."""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from graphloc.config import (
    STANDARD_GRAVITY_MPS2,
    AerialConfig,
    CompassConfig,
    DatumConfig,
    GnssConfig,
    HeightConfig,
    ImuConfig,
    LidarConfig,
    PoseConfig,
    SensorConfig,
    StartConfig,
    VesselConfig,
)
from graphloc.errors import ConfigError
from graphloc.eval.simulate._truth import Motion, Waves, Way, make_motion, make_way_motion
from graphloc.eval.simulate.docks import MovingDock, moving_docks
from graphloc.eval.simulate.harbour import Harbour, load_harbour
from graphloc.eval.simulate.noise import GnssNoise, gnss_error_m, reported_sigma_m
from graphloc.eval.simulate.rig import RigConfig, load_rig
from graphloc.eval.simulate.weather import WEATHER, Condition
from graphloc.frames import Array, Datum, Geodetic, heading_deg_from_yaw, wrap_angle
from graphloc.measurements import CompassHeading, GnssPosition, ImuSeries, Measurement, PoseFix, PoseMode
from graphloc.recording import Recording
from graphloc.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000
DATUM = Geodetic(57.7, 11.7, 36.0)
_CLEAR_M = 0.4  # from the hull to anything solid
_FASTEST_MPS = 15.0
_LONGEST_S = 4.0 * 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What happens in a run. Defaults are BL's sensors and a calm harbour.

    Attributes:
        path: in open water 'entry' (BL case 1), 'turn' (case 2), 'still' (case 3) or 'loops' (any length); in a
            harbour how the vessel goes along its route: 'dock' comes to rest before its end, 'tour' halts on its way.
        case: BL case whose tables the GNSS noise follows.
        duration_s: length of the run. noise: kind of GNSS error.
        outage_s: (start, stop) without fixes and poses, or None.
        imu_hz, gnss_hz, compass_hz, pose_hz: rates; 0 switches a sensor off.
        gnss_sigma_m: white noise of each axis, 1 sigma; e / sqrt(2) with BL's e = 0.3 m.
        gnss_reported_sigma_m: what the fixes claim for it, on average; 0: the truth.
        gnss_reported_spread: how far the claims wander about that: 1 sigma of their logarithm.
        pose_sigma_m, pose_sigma_deg: noise of a true match. false_fraction: share of false ones.
        false_stays: probability that a false match repeats in the next scan.
        pose_modes: modes of each match; the false ones lie around the right one.
        gyro_bias_radps: size of the gyro bias (random direction); accel_bias_mps2: same.
        compass_sigma_deg: white. compass_offset_deg: constant offset of the compass.
        compass_until_s: the compass falls silent then. start_heading_error_deg: error of the start
            heading written to the configuration; None writes none.
        wave_roll_deg, wave_pitch_deg, wave_heave_m: RMS of the waves' motion.
        harbour: name or file of the harbour that the run lies in; empty: open water, `path` alone counts.
        route: of the harbour. route_s: time that the vessel takes for all of it; a shorter run ends on the way. tide_m: water over its mean. lidar_hz, camera_hz: scans of each LiDAR, images of each
            camera a second in the bag. rig: name or file of what the vessel carries. condition: for cameras.
        camera_raw: images as `sensor_msgs/Image`, ten times as large, not as JPEG.
    """

    path: Literal["entry", "turn", "still", "loops", "dock", "tour"] = "entry"
    case: int = 1
    duration_s: float = 120.0
    noise: GnssNoise = "drift"
    outage_s: tuple[float, float] | None = None
    imu_hz: float = 100.0
    gnss_hz: float = 10.0
    compass_hz: float = 10.0
    pose_hz: float = 1.0
    gnss_sigma_m: float = 0.3 / float(np.sqrt(2.0))
    gnss_reported_sigma_m: float = 0.0
    gnss_reported_spread: float = 0.0
    pose_sigma_m: float = 0.2
    pose_sigma_deg: float = 0.5
    false_fraction: float = 0.4
    false_stays: float = 0.5
    pose_modes: int = 1
    gyro_noise_mdps_per_sqrt_hz: float = 8.0
    accel_noise_ug_per_sqrt_hz: float = 300.0
    gyro_bias_radps: float = 0.003
    accel_bias_mps2: float = 0.03
    compass_sigma_deg: float = 1.5 / float(np.sqrt(2.0))
    compass_offset_deg: float = 0.0
    compass_until_s: float = float("inf")
    start_heading_error_deg: float | None = None
    wave_roll_deg: float = 1.5
    wave_pitch_deg: float = 1.0
    wave_heave_m: float = 0.1
    harbour: str = ""
    route: str = "entry"
    route_s: float = 120.0
    tide_m: float = 0.0
    rig: str = "tiara"
    lidar_hz: float = 0.0
    camera_hz: float = 0.0
    camera_raw: bool = False
    condition: Condition = "optimal"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedRun:
    """A run: what the sensors said, the truth, and the vessel.yaml an honest engineer would write."""

    scenario: Scenario
    seed: int
    recording: Recording
    truth: Trajectory
    config: VesselConfig
    motion: Motion
    rig: RigConfig
    harbour: Harbour | None
    docks: tuple[MovingDock, ...]


def bl_scenario(case: int, noise: GnssNoise, *, false_fraction: float = 0.4) -> Scenario:
    """Return BL's case 1, 2 or 3 with its GNSS noise."""
    path: Literal["entry", "turn", "still"] = ("entry", "turn", "still")[case - 1]
    base = Scenario(path=path, case=case, noise=noise, false_fraction=false_fraction)
    if case == 3:
        return replace(base, duration_s=60.0, wave_roll_deg=4.0, wave_pitch_deg=2.0, wave_heave_m=0.2)
    return base


def harbour_scenarios() -> dict[str, Scenario]:
    """Return the scenarios that lie in a harbour, by name.

    BL's three cases under each kind of GNSS trouble; docking at a quay and at a floating dock in each of Digerud's
    conditions while GNSS drifts; and half an hour through all of it.
    """
    found = {}
    for case, (harbour, route) in {1: ("marina", "entry"), 2: ("basin", "turn"), 3: ("marina", "still")}.items():
        for name, noise in (("clean", "clean"), ("drift", "drift"), ("jump", "jump"), ("outage", "drift")):
            base = bl_scenario(case, noise)  # type: ignore[arg-type]
            outage = (0.4 * base.duration_s, 0.6 * base.duration_s) if name == "outage" else None
            found[f"bl{case}-{name}"] = _in_harbour(base, harbour=harbour, route=route, outage_s=outage)
    docking = replace(bl_scenario(1, "drift"), path="dock", pose_hz=0.0, camera_hz=5.0, wave_heave_m=0.05)
    for kind in ("fixed", "floating"):
        for condition in WEATHER:
            found[f"dock-{kind}-{condition}"] = _in_harbour(
                docking, harbour="marina", route=f"dock_{kind}", condition=condition
            )
    long = replace(bl_scenario(1, "varied"), path="tour", duration_s=1800.0, route_s=1800.0, camera_hz=1.0)
    found["long"] = _in_harbour(long, harbour="marina", route="long", outage_s=(990.0, 1050.0), condition="fog")
    return found


def find_scenario(name: str, changes: Mapping[str, str]) -> Scenario:
    """Return a scenario by name, with some of its fields changed.

    Raises:
        ConfigError: there is none of that name, no such field, or a value that it cannot have.
    """
    known = harbour_scenarios()
    if name not in known:
        raise ConfigError(f"scenario '{name}': unknown{_near(name, known)}; there are: {', '.join(known)}")
    fields = {f.name: getattr(known[name], f.name) for f in dataclasses.fields(Scenario)}
    for key in changes:
        if key not in fields:
            raise ConfigError(f"--set {key}: a scenario has no such field{_near(key, fields)}")
    spans = {key: f"[{value.strip('[]()')}]" for key, value in changes.items() if key == "outage_s"}
    try:
        given = {**changes, **{key: json.loads(value) for key, value in spans.items()}}
        changed = TypeAdapter(Scenario).validate_python({**fields, **given})
    except json.JSONDecodeError:
        raise ConfigError(
            f"--set outage_s={changes['outage_s']}: write its begin and end, as in outage_s=30,50"
        ) from None
    except ValidationError as error:
        (first, *_) = error.errors()
        raise ConfigError(f"--set {first['loc'][0]}={changes.get(str(first['loc'][0]), '')}: {first['msg']}") from None
    _refuse_nonsense(changed)
    return changed


def _near(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {near[0]}?" if near else ""


def _refuse_nonsense(s: Scenario) -> None:
    """Refuse numbers that no harbour has.

    Raises:
        ConfigError: the first of them.
    """
    numbers = {
        key: value for key in _fields(s) if isinstance(value := getattr(s, key), float) and key != "compass_until_s"
    }
    limits = {key: (-1e6, 1e6) for key in numbers} | {key: (0.0, 200.0) for key in numbers if key.endswith("_hz")}
    limits |= {
        key: (0.0, 1e6) for key in numbers if key.startswith(("wave_", "gnss_sigma", "gnss_rep", "false_", "gyro_b"))
    }
    limits |= {key: (1e-3, 1e6) for key in numbers if key.endswith("per_sqrt_hz") or key.startswith("pose_sigma")}
    limits |= {"false_fraction": (0.0, 1.0), "false_stays": (0.0, 1.0), "tide_m": (-10.0, 10.0), "case": (1, 3)}
    limits |= {"imu_hz": (10.0, 2000.0), "duration_s": (2.0, _LONGEST_S), "route_s": (2.0, _LONGEST_S)}
    limits |= {"pose_modes": (1, 20), "compass_sigma_deg": (1e-3, 90.0), "compass_offset_deg": (-180.0, 180.0)}
    limits |= {"gnss_reported_spread": (0.0, 2.0)}
    for key, (low, high) in limits.items():
        value = getattr(s, key)
        if not low <= value <= high:
            raise ConfigError(f"--set {key}={value:g}: must be from {low:g} to {high:g}")
        if key.endswith("_hz") and 0.0 < value < 3.0 / s.duration_s:
            raise ConfigError(f"--set {key}={value:g}: fewer than three in {s.duration_s:g} s; 0 switches it off")
    if s.start_heading_error_deg is not None and not np.isfinite(s.start_heading_error_deg):
        raise ConfigError(f"--set start_heading_error_deg={s.start_heading_error_deg:g}: must be a number")


def _fields(s: Scenario) -> tuple[str, ...]:
    """Names of a scenario's fields."""
    return tuple(f.name for f in dataclasses.fields(s))


def _in_harbour(base: Scenario, **changes: object) -> Scenario:
    """A scenario with LiDARs, on the tide, its fixes as a receiver reports them.

    Where GNSS errs, the receiver scatters by 5 cm from fix to fix and claims BL's 0.3 m. So the largest error of a
    drifting signal is that of BL table 4.1, whose truth was the receiver itself.
    """
    placed = replace(base, lidar_hz=1.0, tide_m=0.2, gnss_reported_spread=0.3, **changes)  # type: ignore[arg-type]
    if placed.noise == "clean":
        return placed
    return replace(placed, gnss_sigma_m=0.05, gnss_reported_sigma_m=base.gnss_sigma_m)


def simulate(scenario: Scenario, seed: int) -> SimulatedRun:
    """Run a scenario. Deterministic for a seed."""
    rng = np.random.default_rng([seed, 7])
    harbour = load_harbour(scenario.harbour) if scenario.harbour else None
    rig = load_rig(scenario.rig)
    slow = [name for name, lidar in rig.lidars.items() if lidar.scan_s * scenario.lidar_hz > 1.0]
    if slow:
        raise ConfigError(
            f"lidar_hz={scenario.lidar_hz:g}: {slow[0]} takes {rig.lidars[slow[0]].scan_s:g} s for a turn"
        )
    motion = _motion(scenario, rng) if harbour is None else _harbour_motion(scenario, harbour, rig, rng)
    datum = Datum(DATUM) if harbour is None else harbour.datum
    config = _config(scenario, rig, motion, datum)
    t = _times(scenario.duration_s, scenario.imu_hz)
    imu = _imu(scenario, motion, datum, t, (rig.imu.t_body_sensor_m, rig.imu.R_body_sensor), rng)
    drafts: list[Measurement] = []
    drafts += _gnss(scenario, motion, datum, rig.gnss.t_body_sensor_m, rng)
    drafts += _compass(scenario, motion, rng)
    drafts += _poses(scenario, motion, rng)
    drafts.sort(key=lambda m: (m.stamp_ns, m.sensor))
    measurements = tuple(replace(m, seq=len(imu) + i) for i, m in enumerate(drafts))
    p, R, v = motion.pose(t)
    truth = Trajectory(stamps_ns=_stamps(t), p_world_m=p, R_world_body=R, v_world_mps=v)
    recording = Recording(
        source="(simulated)",
        imu=imu,
        measurements=measurements,
        message_count=len(imu) + len(measurements),
        topics={name: sensor.topic for name, sensor in config.sensors.items()},
        truth=truth,
    )
    docks = () if harbour is None else moving_docks(harbour, scenario.tide_m, np.random.default_rng([seed, 19]))
    return SimulatedRun(
        scenario=scenario, seed=seed, recording=recording, truth=truth, config=config, motion=motion, rig=rig,
        harbour=harbour, docks=docks,
    )  # fmt: skip


def _times(duration_s: float, rate_hz: float) -> Array:
    return np.arange(round(duration_s * rate_hz)) / rate_hz


def _stamps(t: Array) -> NDArray[np.int64]:
    return START_NS + np.rint(t * 1e9).astype(np.int64)


def _ramp(t: Array, at: float, width: float) -> Array:
    return np.asarray(0.5 * (1.0 + np.tanh((t - at) / width)))


def _motion(s: Scenario, rng: np.random.Generator) -> Motion:
    cruise = rng.uniform(2.0, 3.5)
    wobble = Waves.jonswap(rng, 0.02, 25.0)
    turn_at, sign = rng.uniform(0.4, 0.6) * s.duration_s, rng.choice([-1.0, 1.0])
    zero: Callable[[Array], Array] = np.zeros_like
    speed: Callable[[Array], Array]
    rate: Callable[[Array], Array]
    if s.path == "still":
        speed, rate = (lambda t: Waves.at(wobble, t)), (lambda t: 0.3 * Waves.at(wobble, t))
    elif s.path == "turn":
        total, width = np.radians(rng.uniform(80.0, 110.0)), 4.0
        speed = lambda t: cruise * (1.0 - 0.4 * _ramp(t, turn_at, 8.0))
        rate = lambda t: total / (2.0 * width) / np.cosh((t - turn_at) / width) ** 2 + Waves.at(wobble, t)
    elif s.path == "entry":
        speed = lambda t: cruise * (1.0 - 0.6 * _ramp(t, 0.75 * s.duration_s, 10.0))
        bend = np.radians(rng.uniform(15.0, 40.0))
        rate = lambda t: sign * bend / 16.0 / np.cosh((t - turn_at) / 8.0) ** 2 + Waves.at(wobble, t)
    else:
        slow = Waves.jonswap(rng, 0.08, 60.0)
        speed = lambda t: cruise * (0.75 + 0.25 * np.sin(2.0 * np.pi * t / 90.0))
        rate = lambda t: sign * 0.05 + Waves.at(slow, t)
    sway, waves = _waves(s, rng)
    still = s.path == "still"
    return make_motion(
        s.duration_s, speed, rate, rng.uniform(-np.pi, np.pi), sway.at if not still else zero, waves, 0.03
    )


def _waves(s: Scenario, rng: np.random.Generator) -> tuple[Waves, tuple[Waves, Waves, Waves]]:
    """Draw the sway, and the waves' roll, pitch and heave."""
    sway = Waves.jonswap(rng, 0.05, 12.0)
    return sway, (
        Waves.jonswap(rng, np.radians(s.wave_roll_deg), 4.0),
        Waves.jonswap(rng, np.radians(s.wave_pitch_deg), 4.5),
        Waves.jonswap(rng, s.wave_heave_m, 5.0),
    )


def _harbour_motion(s: Scenario, harbour: Harbour, rig: RigConfig, rng: np.random.Generator) -> Motion:
    """Along the route from end to end, slower towards its end; or swaying about its only waypoint.

    Raises:
        ConfigError: the route runs into something.
    """
    points = harbour.waypoints(s.route)
    sway, waves = _waves(s, rng)
    if len(points) == 1:
        wobble, yaw0 = Waves.jonswap(rng, 0.02, 25.0), float(rng.uniform(-np.pi, np.pi))
        start = (float(points[0, 0]), float(points[0, 1]))
        motion = make_motion(
            s.duration_s, wobble.at, lambda t: 0.3 * wobble.at(t), yaw0, np.zeros_like, waves, 0.03, start, s.tide_m
        )
    elif s.duration_s > s.route_s:
        raise ConfigError(
            f"duration_s={s.duration_s:g}: the vessel is at the end of route '{s.route}' after route_s={s.route_s:g}: "
            "set both, to go slower"
        )
    else:
        motion = _way_motion(s, Way.through(points), sway, waves, rng)
    _refuse_collision(s, harbour, rig, motion)
    return motion


def _way_motion(
    s: Scenario, way: Way, sway: Waves, waves: tuple[Waves, Waves, Waves], rng: np.random.Generator
) -> Motion:
    slowing: Callable[[Array], Array] = lambda t: 1.0 - 0.5 * _ramp(t, 0.8 * s.route_s, 8.0)
    swing = None
    if s.path in ("dock", "tour"):
        swing = Waves.jonswap(rng, np.radians(1.0), 15.0)  # no helmsman holds a course to a hair
        shape = _docking if s.path == "dock" else _touring
        slowing = lambda t: shape(t / s.route_s)
    motion = make_way_motion(s.route_s, way, slowing, sway.at, waves, 0.03, s.tide_m, swing)
    fastest = float(np.abs(motion.speed(np.arange(0.0, s.duration_s, 0.5))).max())
    if fastest > _FASTEST_MPS:
        raise ConfigError(
            f"route_s={s.route_s:g}: the vessel would do {fastest:.0f} m/s on route '{s.route}', {way.length_m:.0f} m long; "
            "to see only its beginning, set duration_s alone"
        )
    return motion


def _refuse_collision(s: Scenario, harbour: Harbour, rig: RigConfig, motion: Motion) -> None:
    p, R, _ = motion.pose(np.arange(0.0, s.duration_s, 0.5))
    hull = np.array(rig.hull.outline)
    hulls = shapely.polygons(p[:, None, :2] + np.einsum("nij,kj->nki", R[:, :2, :2], hull))
    harbour.refuse_collision(hulls, _CLEAR_M, s.route)


def _docking(share: Array) -> Array:
    """Speed's shape of a vessel that slows steadily and lies still for the last sixth of its time."""
    left = 1.0 - share / 0.83
    return 0.5 * (left + np.sqrt(left**2 + 0.001))


def _touring(share: Array) -> Array:
    """Speed's shape of a tour: a halt of a twentieth of its time amid it, and docking at its end."""
    halt = _ramp(share, 0.62, 0.004) - _ramp(share, 0.67, 0.004)
    return (1.0 - halt) * _docking(np.clip((share - 0.85) / 0.15, 0.0, None))


def _config(s: Scenario, rig: RigConfig, motion: Motion, datum: Datum) -> VesselConfig:
    start = StartConfig()
    if s.start_heading_error_deg is not None:
        true = float(heading_deg_from_yaw(motion.yaw(0.0)))
        start = StartConfig(heading_deg=(true + s.start_heading_error_deg) % 360.0)
    sensors: dict[str, SensorConfig] = {
        "imu": ImuConfig(
            topic="/imu/data",
            mount=rig.imu,
            gyro_noise_mdps_per_sqrt_hz=s.gyro_noise_mdps_per_sqrt_hz,
            accel_noise_ug_per_sqrt_hz=s.accel_noise_ug_per_sqrt_hz,
        ),
        "height": HeightConfig(height_m=datum.origin.height_m),
    }
    if s.gnss_hz > 0.0:
        sensors["gnss"] = GnssConfig(topic="/gnss/fix", mount=rig.gnss)
    if s.compass_hz > 0.0:
        sensors["compass"] = CompassConfig(topic="/gnss/heading", sigma_deg=s.compass_sigma_deg)
    if s.pose_hz > 0.0:
        sensors["aerial"] = PoseConfig(topic="/aerial/pose", axes=("x", "y", "yaw"))
    elif s.harbour and s.lidar_hz > 0.0 and rig.lidars:
        sensors["aerial"] = _matcher(rig)
    return VesselConfig(
        vessel=rig.vessel,
        datum=DatumConfig(
            latitude_deg=datum.origin.latitude_deg,
            longitude_deg=datum.origin.longitude_deg,
            height_m=datum.origin.height_m,
        ),
        sensors=sensors,
        truth_topic="/truth",
        start=start,
    )


def _matcher(rig: RigConfig) -> AerialConfig:
    """What matches the rig's scans to the image; the hull with a hand's breadth around it."""
    hull = shapely.Polygon(rig.hull.outline).buffer(0.3, join_style="mitre")
    return AerialConfig(
        enabled=False,  # still worse than none between moored boats
        image="aerial.tif",
        hull_m=tuple((round(x, 2), round(y, 2)) for x, y in hull.exterior.coords[:-1]),
        lidars={name: LidarConfig(topic=f"/{name}/points", mount=lidar.mount) for name, lidar in rig.lidars.items()},
    )


def _imu(
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
        stamps_ns=_stamps(t),
        accel_mps2=accel + rng.normal(0.0, accel_noise, (len(t), 3)),
        gyro_radps=gyro + rng.normal(0.0, gyro_noise, (len(t), 3)),
        seqs=np.arange(len(t)),
    )


def _silent(s: Scenario, t: Array) -> NDArray[np.bool_]:
    if s.outage_s is None:
        return np.zeros(len(t), dtype=bool)
    return np.asarray((t >= s.outage_s[0]) & (t < s.outage_s[1]))


def _gnss(s: Scenario, motion: Motion, datum: Datum, lever: Array, rng: np.random.Generator) -> list[Measurement]:
    if s.gnss_hz == 0.0:
        return []
    t = _times(s.duration_s - 0.05, s.gnss_hz) + 0.013  # not in step with the IMU
    p, R, _ = motion.pose(t)
    fixes = p + R @ lever + gnss_error_m(rng, t, s.noise, s.case, s.gnss_sigma_m)
    geodetic = datum.geodetic_from_enu(fixes)
    claimed = s.gnss_reported_sigma_m or s.gnss_sigma_m
    told = np.full(len(t), claimed)
    if s.gnss_reported_spread > 0.0:
        told = reported_sigma_m(rng, t, claimed, s.gnss_reported_spread)
    shape = np.diag([1.0, 1.0, 4.0])
    return [
        GnssPosition(stamp_ns=int(n), sensor="gnss", seq=0, position=Geodetic(*g), cov_enu_m2=sigma**2 * shape)
        for n, g, sigma, silent in zip(_stamps(t), geodetic, told, _silent(s, t), strict=True)
        if not silent
    ]


def _compass(s: Scenario, motion: Motion, rng: np.random.Generator) -> list[Measurement]:
    if s.compass_hz == 0.0:
        return []
    t = _times(s.duration_s - 0.05, s.compass_hz) + 0.013
    sigma = np.radians(s.compass_sigma_deg)
    _, R, _ = motion.pose(t)
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0]) + np.radians(s.compass_offset_deg) + rng.normal(0.0, sigma, len(t))
    return [
        CompassHeading(stamp_ns=int(n), sensor="compass", seq=0, yaw_rad=float(wrap_angle(y)), sigma_rad=sigma)
        for n, y, at in zip(_stamps(t), yaw, t, strict=True)
        if at < s.compass_until_s
    ]


def _poses(s: Scenario, motion: Motion, rng: np.random.Generator) -> list[Measurement]:
    """Matches of the body pose; the false ones lie in BL's window, 1.5 to 5 m and up to 5 deg away."""
    if s.pose_hz == 0.0:
        return []
    t = _times(s.duration_s - 0.5, s.pose_hz) + 0.437
    p, R, _ = motion.pose(t)
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    sigmas = np.array([s.pose_sigma_m, s.pose_sigma_m, np.radians(s.pose_sigma_deg)])
    false = rng.uniform(size=len(t)) < s.false_fraction
    offset = np.zeros(3)
    out: list[Measurement] = []
    for i, (n, silent) in enumerate(zip(_stamps(t), _silent(s, t), strict=True)):
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
            out.append(PoseFix(stamp_ns=int(n), sensor="aerial", seq=0, axes=("x", "y", "yaw"), modes=modes))
    return out


def _false_offset(rng: np.random.Generator) -> Array:
    size, angle = rng.uniform(1.5, 5.0), rng.uniform(0.0, 2.0 * np.pi)
    return np.array([size * np.cos(angle), size * np.sin(angle), np.radians(rng.uniform(-5.0, 5.0))])
