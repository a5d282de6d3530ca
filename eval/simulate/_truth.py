# SPDX-License-Identifier: Apache-2.0
"""True motion: a planar path by profiles of speed and yaw rate, with waves and heel added.

Velocity is a spline, position its integral and acceleration its derivative; attitude is analytic. So truth and inertial
data agree to the accuracy of the arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PPoly
from scipy.spatial.transform import Rotation

from graphloc.frames import Array
from graphloc.signals.series import integral

_STEP_S = 0.02  # between knots of the velocity spline
_WAVES = 12  # sinusoids that make up a sea


@dataclass(frozen=True, slots=True)
class Waves:
    """Sums of sinusoids: amplitude (K,), angular frequency (K,), phase (K,)."""

    amplitude: Array
    omega: Array
    phase: Array

    def at(self, t: Array, derivative: int = 0) -> Array:
        """Return the sum (N,) at t (N,), or its derivative."""
        angle = np.outer(t, self.omega) + self.phase + derivative * np.pi / 2.0
        return np.asarray(np.sin(angle) @ (self.amplitude * self.omega**derivative))

    @staticmethod
    def jonswap(rng: np.random.Generator, rms: float, peak_s: float) -> Waves:
        """Draw waves whose sum has standard deviation `rms` and a JONSWAP spectrum (gamma 3.3) with period `peak_s`."""
        peak = 2.0 * np.pi / peak_s
        omega = peak * np.sort(rng.uniform(0.6, 2.2, _WAVES))
        width = np.where(omega <= peak, 0.07, 0.09)
        bump = 3.3 ** np.exp(-((omega / peak - 1.0) ** 2) / (2.0 * width**2))
        power = omega**-5.0 * np.exp(-1.25 * (peak / omega) ** 4) * bump
        amplitude = np.sqrt(power / power.sum()) * rms * np.sqrt(2.0)
        return Waves(amplitude, omega, rng.uniform(0.0, 2.0 * np.pi, _WAVES))


@dataclass(frozen=True, slots=True)
class Motion:
    """The true motion, as functions of the time t (s)."""

    velocity: CubicSpline
    position: PPoly
    yaw: PPoly
    yaw_rate: CubicSpline
    roll: Waves
    pitch: Waves
    heave: Waves
    lean_per_mps2: float
    speed: CubicSpline
    tide_m: float

    def attitude(self, t: Array) -> tuple[Array, Array]:
        """Return roll, pitch and yaw (N, 3), rad, and their rates (N, 3), rad/s."""
        lean = -self.lean_per_mps2 * self.speed(t) * self.yaw_rate(t)
        lean_rate = -self.lean_per_mps2 * (self.speed(t, 1) * self.yaw_rate(t) + self.speed(t) * self.yaw_rate(t, 1))
        rpy = np.column_stack([self.roll.at(t) + lean, self.pitch.at(t), self.yaw(t)])
        rates = np.column_stack([self.roll.at(t, 1) + lean_rate, self.pitch.at(t, 1), self.yaw_rate(t)])
        return rpy, rates

    def pose(self, t: Array) -> tuple[Array, Array, Array]:
        """Return p (N, 3) m, R (N, 3, 3) and v (N, 3) m/s of body in world."""
        rpy, _ = self.attitude(t)
        p = np.column_stack([self.position(t), self.heave.at(t) + self.tide_m])
        v = np.column_stack([self.velocity(t), self.heave.at(t, 1)])
        return p, Rotation.from_euler("xyz", rpy).as_matrix(), v

    def body_rate(self, t: Array) -> Array:
        """Return the angular rate (N, 3) in body axes, rad/s."""
        rpy, d = self.attitude(t)
        sr, cr = np.sin(rpy[:, 0]), np.cos(rpy[:, 0])
        sp, cp = np.sin(rpy[:, 1]), np.cos(rpy[:, 1])
        return np.column_stack(
            [d[:, 0] - d[:, 2] * sp, d[:, 1] * cr + d[:, 2] * sr * cp, -d[:, 1] * sr + d[:, 2] * cr * cp]
        )

    def inertial(self, t: Array, lever_m: Array, gravity_mps2: float) -> tuple[Array, Array]:
        """Return specific force at the point `lever_m` of body, and angular rate, (N, 3) each, in body axes."""
        _, R, _ = self.pose(t)
        a = np.column_stack([self.velocity(t, 1), self.heave.at(t, 2)])
        a[:, 2] += gravity_mps2
        w = self.body_rate(t)
        alpha = (self.body_rate(t + 1e-4) - self.body_rate(t - 1e-4)) / 2e-4
        at_lever = np.cross(alpha, lever_m) + np.cross(w, np.cross(w, lever_m))
        return np.einsum("nji,nj->ni", R, a) + at_lever, w


def make_motion(
    duration_s: float,
    speed_mps: Callable[[Array], Array],
    yaw_rate_radps: Callable[[Array], Array],
    yaw0_rad: float,
    sway_mps: Callable[[Array], Array],
    waves: tuple[Waves, Waves, Waves],
    lean_per_mps2: float,
    start_m: tuple[float, float] = (0.0, 0.0),
    tide_m: float = 0.0,
) -> Motion:
    """Build the motion from profiles over [0, duration]."""
    t = np.arange(-1.0, duration_s + 1.0 + _STEP_S, _STEP_S)
    yaw_rate = CubicSpline(t, yaw_rate_radps(t))
    whole = yaw_rate.antiderivative()
    offset = yaw0_rad - float(whole(0.0))
    yaw = PPoly(whole.c.copy(), whole.x)
    yaw.c[-1] += offset
    psi, surge, sway = yaw(t), speed_mps(t), sway_mps(t)
    v = np.column_stack([surge * np.cos(psi) - sway * np.sin(psi), surge * np.sin(psi) + sway * np.cos(psi)])
    velocity = CubicSpline(t, v)
    position = velocity.antiderivative()
    position.c[-1] += np.array(start_m) - position(0.0)
    roll, pitch, heave = waves
    return Motion(
        velocity=velocity,
        position=position,
        yaw=yaw,
        yaw_rate=yaw_rate,
        roll=roll,
        pitch=pitch,
        heave=heave,
        lean_per_mps2=lean_per_mps2,
        speed=CubicSpline(t, surge),
        tide_m=tide_m,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A smooth path through waypoints: heading (rad) as a function of the length (m) from its start."""

    length_m: float
    heading: CubicSpline
    start_m: tuple[float, float]

    @staticmethod
    def through(waypoints_m: Array) -> Way:
        """Return the path through two waypoints (N, 2) or more."""
        chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(waypoints_m, axis=0).T))])
        curve = CubicSpline(chord, waypoints_m, bc_type="natural")
        along = np.linspace(0.0, chord[-1], max(20, int(chord[-1] / 0.25)))
        track = curve(along)
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))])
        tangent = curve(along, 1)
        heading = CubicSpline(length, np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])))
        return Way(float(length[-1]), heading, (float(track[0, 0]), float(track[0, 1])))


def make_way_motion(
    duration_s: float,
    way: Way,
    slowing: Callable[[Array], Array],
    sway_mps: Callable[[Array], Array],
    waves: tuple[Waves, Waves, Waves],
    lean_per_mps2: float,
    tide_m: float,
    swing: Waves,
) -> Motion:
    """Build the motion along a path, from end to end in the given time.

    Args:
        slowing: shape of the speed over time. swing: rad, by which the bow swings about the direction of the path.
    """
    t = np.arange(-1.0, duration_s + 1.0 + _STEP_S, _STEP_S)
    shape = slowing(t)
    travelled = integral(t, shape)
    scale = way.length_m / travelled[-1]
    speed, at = CubicSpline(t, scale * shape), CubicSpline(t, scale * travelled)
    before = float(at(0.0))
    first = float(way.heading(0.0))
    return make_motion(
        duration_s,
        speed_mps=speed,
        yaw_rate_radps=lambda s: way.heading(at(s), 1) * speed(s) + swing.at(s, 1),
        yaw0_rad=float(way.heading(before) + swing.at(np.zeros(1))[0]),
        sway_mps=sway_mps,
        waves=waves,
        lean_per_mps2=lean_per_mps2,
        start_m=(way.start_m[0] + before * float(np.cos(first)), way.start_m[1] + before * float(np.sin(first))),
        tide_m=tide_m,
    )
