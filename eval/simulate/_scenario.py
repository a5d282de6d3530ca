# SPDX-License-Identifier: Apache-2.0
"""Scenarios: what happens in a run; scenarios by name, and changes to them."""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError

from graphloc.errors import ConfigError
from graphloc.eval.simulate.noise import GnssNoise
from graphloc.eval.simulate.weather import WEATHER, Condition

_LONGEST_S = 4.0 * 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What happens in a run. Defaults are BL's sensors and a calm harbour.

    Attributes:
        path: in open water 'entry' (BL case 1), 'turn' (case 2), 'still' (case 3) or 'loops' (any length). In a
            harbour, how the vessel goes along its route: 'dock' comes to rest before the end, 'tour' halts on the way.
        case: BL case whose tables the GNSS noise follows.
        duration_s: length of the run. noise: kind of GNSS error.
        outage_s: (start, stop) without fixes and poses, or None.
        imu_hz, gnss_hz, compass_hz, pose_hz, log_hz: rates; 0 switches a sensor off. The log tells the speed ahead.
        gnss_sigma_m: white noise of each axis, 1 sigma; e / sqrt(2) with BL's e = 0.3 m.
        gnss_reported_sigma_m: sigma that the fixes state, on average; 0: the true one.
        gnss_reported_spread: how far the stated sigmas wander about that: 1 sigma of their logarithm.
        pose_sigma_m, pose_sigma_deg: noise of a right match. false_fraction: share of false matches.
        false_stays: probability that a false match repeats in the next scan.
        pose_modes: number of modes of each match; the false ones lie around the right one.
        gyro_noise_mdps_per_sqrt_hz, accel_noise_ug_per_sqrt_hz: white noise of the IMU.
        gyro_bias_radps, accel_bias_mps2: sizes of the biases, whose directions are random.
        log_sigma_mps: white noise of the log. log_scale_error: share by which it reads too much. log_through: whether
            it measures the speed over ground or through the water.
        current_east_mps, current_north_mps: of the water.
        compass_sigma_deg: white noise of the compass. compass_offset_deg: its constant offset.
        compass_until_s: when the compass falls silent. start_heading_error_deg: error of the start heading that is
            written to the configuration; None: none is written.
        wave_roll_deg, wave_pitch_deg, wave_heave_m: RMS of the waves' motion.
        harbour: name or file of the harbour that the run lies in; empty: open water, `path` alone counts.
        route: of the harbour. route_s: time that the vessel takes for the whole route; a shorter run ends on the way.
        tide_m: height of the water over its mean. rig: name or file of the vessel's equipment.
        lidar_hz, camera_hz: scans of each LiDAR, and images of each camera, per second in the bag.
        camera_raw: whether images are `sensor_msgs/Image`, ten times as large as JPEG. condition: for cameras.
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
    log_hz: float = 0.0
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
    log_sigma_mps: float = 0.05
    log_scale_error: float = 0.02
    log_through: Literal["ground", "water"] = "water"
    current_east_mps: float = 0.3
    current_north_mps: float = -0.2
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


_FIELDS = tuple(f.name for f in dataclasses.fields(Scenario))


def bl_scenario(case: int, noise: GnssNoise) -> Scenario:
    """Return BL's case 1, 2 or 3 with its GNSS noise."""
    path: Literal["entry", "turn", "still"] = ("entry", "turn", "still")[case - 1]
    base = Scenario(path=path, case=case, noise=noise)
    if case == 3:
        return replace(base, duration_s=60.0, wave_roll_deg=4.0, wave_pitch_deg=2.0, wave_heave_m=0.2)
    return base


def harbour_scenarios() -> dict[str, Scenario]:
    """Return the scenarios that lie in a harbour, by name.

    They are BL's three cases with GNSS clean, drifting, jumping or out for a while; docking at a quay and at a floating
    dock in each of Digerud's conditions while GNSS drifts; and a tour of half an hour.
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
        ConfigError: an unknown name or field, or an invalid value.
    """
    known = harbour_scenarios()
    if name not in known:
        raise ConfigError(f"scenario '{name}': unknown{_near(name, known)}; there are: {', '.join(known)}")
    fields = {key: getattr(known[name], key) for key in _FIELDS}
    for key in changes:
        if key not in fields:
            raise ConfigError(f"--set {key}: a scenario has no such field{_near(key, fields)}")
    given: dict[str, object] = dict(changes)
    try:
        if "outage_s" in changes:
            given["outage_s"] = json.loads(f"[{changes['outage_s'].strip('[]()')}]")
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
    """Refuse values that no harbour has.

    Raises:
        ConfigError: a value is impossible; the first one is named.
    """
    numbers = {
        key: value for key in _FIELDS if isinstance(value := getattr(s, key), float) and key != "compass_until_s"
    }
    limits = {key: (-1e6, 1e6) for key in numbers} | {key: (0.0, 200.0) for key in numbers if key.endswith("_hz")}
    limits |= {
        key: (0.0, 1e6) for key in numbers if key.startswith(("wave_", "gnss_sigma", "gnss_rep", "false_", "gyro_b"))
    }
    limits |= {key: (1e-3, 1e6) for key in numbers if key.endswith("per_sqrt_hz") or key.startswith("pose_sigma")}
    limits |= {"false_fraction": (0.0, 1.0), "false_stays": (0.0, 1.0), "tide_m": (-10.0, 10.0), "case": (1, 3)}
    limits |= {"imu_hz": (10.0, 2000.0), "duration_s": (2.0, _LONGEST_S), "route_s": (2.0, _LONGEST_S)}
    limits |= {"pose_modes": (1, 20), "compass_sigma_deg": (1e-3, 90.0), "compass_offset_deg": (-180.0, 180.0)}
    limits |= {"gnss_reported_spread": (0.0, 2.0), "log_sigma_mps": (1e-3, 100.0), "log_scale_error": (-0.5, 0.5)}
    for key, (low, high) in limits.items():
        value = getattr(s, key)
        if not low <= value <= high:
            raise ConfigError(f"--set {key}={value:g}: must be from {low:g} to {high:g}")
        if key.endswith("_hz") and 0.0 < value < 3.0 / s.duration_s:
            raise ConfigError(f"--set {key}={value:g}: fewer than three in {s.duration_s:g} s; 0 switches it off")
    if s.start_heading_error_deg is not None and not np.isfinite(s.start_heading_error_deg):
        raise ConfigError(f"--set start_heading_error_deg={s.start_heading_error_deg:g}: must be a number")


def _in_harbour(base: Scenario, **changes: object) -> Scenario:
    """Return a scenario with LiDARs and tide, and fixes as a receiver reports them.

    Where GNSS errs, the receiver scatters by 5 cm from fix to fix and states BL's 0.3 m. So the largest error of a
    drifting signal is that of BL table 4.1, whose truth was the receiver itself.
    """
    placed = replace(base, lidar_hz=1.0, tide_m=0.2, gnss_reported_spread=0.3, **changes)  # type: ignore[arg-type]
    if placed.noise == "clean":
        return placed
    return replace(placed, gnss_sigma_m=0.05, gnss_reported_sigma_m=base.gnss_sigma_m)
