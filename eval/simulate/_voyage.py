# SPDX-License-Identifier: Apache-2.0
"""Motion of the vessel: in open water, or along a harbour's route without collisions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import shapely

from graphloc.errors import ConfigError
from graphloc.eval.simulate._scenario import Scenario
from graphloc.eval.simulate._truth import Motion, Waves, Way, make_motion, make_way_motion
from graphloc.eval.simulate.harbour import Harbour
from graphloc.eval.simulate.rig import RigConfig
from graphloc.frames import Array

_CLEAR_M = 0.4  # least distance from the hull to anything solid
_LEAN_PER_MPS2 = 0.03  # rad of roll per m/s^2 across the vessel, in a turn
_FASTEST_MPS = 15.0


def _ramp(t: Array, at: float, width: float) -> Array:
    return np.asarray(0.5 * (1.0 + np.tanh((t - at) / width)))


def open_motion(s: Scenario, rng: np.random.Generator) -> Motion:
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
        s.duration_s, speed, rate, rng.uniform(-np.pi, np.pi), sway.at if not still else zero, waves, _LEAN_PER_MPS2
    )


def _waves(s: Scenario, rng: np.random.Generator) -> tuple[Waves, tuple[Waves, Waves, Waves]]:
    """Draw the sway, and the waves' roll, pitch and heave."""
    sway = Waves.jonswap(rng, 0.05, 12.0)
    return sway, (
        Waves.jonswap(rng, np.radians(s.wave_roll_deg), 4.0),
        Waves.jonswap(rng, np.radians(s.wave_pitch_deg), 4.5),
        Waves.jonswap(rng, s.wave_heave_m, 5.0),
    )


def harbour_motion(s: Scenario, harbour: Harbour, rig: RigConfig, rng: np.random.Generator) -> Motion:
    """Return the motion along the route from end to end, or swaying about the only waypoint of the route.

    Raises:
        ConfigError: the route collides with something.
    """
    points = harbour.waypoints(s.route)
    sway, waves = _waves(s, rng)
    if len(points) == 1:
        wobble, yaw0 = Waves.jonswap(rng, 0.02, 25.0), float(rng.uniform(-np.pi, np.pi))
        start = (float(points[0, 0]), float(points[0, 1]))
        motion = make_motion(
            s.duration_s,
            speed_mps=wobble.at,
            yaw_rate_radps=lambda t: 0.3 * wobble.at(t),
            yaw0_rad=yaw0,
            sway_mps=np.zeros_like,
            waves=waves,
            lean_per_mps2=_LEAN_PER_MPS2,
            start_m=start,
            tide_m=s.tide_m,
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
    swing = Waves(*np.zeros((3, 1)))
    if s.path in ("dock", "tour"):
        swing = Waves.jonswap(rng, np.radians(1.0), 15.0)  # no helmsman holds a course exactly
        shape = _docking if s.path == "dock" else _touring
        slowing = lambda t: shape(t / s.route_s)
    motion = make_way_motion(s.route_s, way, slowing, sway.at, waves, _LEAN_PER_MPS2, s.tide_m, swing)
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
    """Return the speed, up to scale, of a vessel that slows steadily and lies still for the last sixth of the time."""
    left = 1.0 - share / 0.83
    return 0.5 * (left + np.sqrt(left**2 + 0.001))


def _touring(share: Array) -> Array:
    """Return the speed, up to scale, of a tour: a stop of a twentieth of the time, and docking at the end."""
    halt = _ramp(share, 0.62, 0.004) - _ramp(share, 0.67, 0.004)
    return (1.0 - halt) * _docking(np.clip((share - 0.85) / 0.15, 0.0, None))
