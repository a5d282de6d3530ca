# SPDX-License-Identifier: Apache-2.0
"""Compass heading with mount offset, magnetic deviation, and a slow error.

    z = y + A + B sin(h) + C cos(h) + D sin(2h) + E cos(2h) + e + w,   w ~ N(0, s^2)
    y = yaw(R_world_body R_body_sensor) - c,   h = 90 deg - y: heading of the sensor's own x axis, clockwise from north

c: meridian convergence at the estimated place: by how much north there lies counter-clockwise of the datum's north
(`Datum.convergence_rad`). A: mount offset. B to E: deviation by the vessel's iron, as in navigation (A. Smith's coefficients; east is
positive); A to E are constants of the run. e: wander, a first-order Gauss-Markov process, by a crane or a quay of sheet piles that
the vessel passes, or by the compass's own filter. If deviation or wander of some degrees are taken for white noise, ten readings per
second seem certain: the heading is wrong by half of them, and true aerial matches are rejected.

yaw(R) = atan2(R10, R00); its derivative by theta in R <- R Exp(theta): `_yaw_jacobian`. GTSAM has no factor of yaw and offset, so
this one is linearised at every pass (`graphloc.linear`), online without the slope of the deviation (`_slope`). Yaw is nearly linear in a
correction: at 3 deg of roll and pitch, one of 5 deg is wrong by 0.02 deg. Not handled: pitch near +-90 deg.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from graphloc.config import CompassConfig
from graphloc.frames import Array, Datum, skew, wrap_angle
from graphloc.graph import Attachment, Hint, Residual, Sensor, SlowProcess
from graphloc.measurements import CompassHeading

_FLOOR_RAD = np.radians(0.05)  # no compass is better, whatever it says
_DEVIATION = ("B", "C", "D", "E")
_CALIBRATED_DEG = 0.1  # sigma of a mount that was calibrated: it may still be turned by a step, as beside iron
_SHARES = (1.0, 1.0, 0.5, 0.5)  # B and C come of permanent magnetism; D and E, of soft iron, are smaller


def _sigmas(config: CompassConfig) -> Array:
    """Return stationary sigmas (6,), rad, of A to E and of the wander; 0 for those that are not modelled."""
    return _sigmas_of(config.mount_offset_sigma_deg, config.deviation_sigma_deg, config.wander_sigma_deg)


@lru_cache
def _sigmas_of(mount_deg: float, deviation_deg: float, wander_deg: float) -> Array:
    sigmas = np.radians([max(mount_deg, _CALIBRATED_DEG), *(deviation_deg * share for share in _SHARES), wander_deg])
    sigmas.setflags(write=False)
    return sigmas


def _yaw_jacobian(R: Array, x_body: Array, x_world: Array) -> Array:
    """Return the derivative (6,) of yaw(R Exp(theta) R_state_sensor) by the body tangent (theta, rho).

    Args:
        R: (3, 3) body in world. x_body, x_world: (3,) x axis of the sensor, in body and in world.
    """
    # d(R Exp(theta) x) / d theta = -R [x]_x: for a row r of R the cross product x x r. yaw = atan2(y, x).
    horizontal = x_world[0] ** 2 + x_world[1] ** 2
    jacobian = np.zeros(6)
    jacobian[:3] = skew(x_body) @ ((x_world[0] * R[1] - x_world[1] * R[0]) / horizontal)
    return jacobian


def _axis(at: Attachment) -> tuple[Array, Array, Array]:
    """Return the attitude R_world_body (3, 3), and the sensor's x axis (3,) in body and in world."""
    R, x_body = at.T_world_body.rotation().matrix(), at.T_state_sensor.rotation().matrix()[:, 0]
    return R, x_body, R @ x_body


def _yaw(at: Attachment, x_world: Array) -> float:
    """Return y, rad, of the module's docstring; `x_world`: (3,) x axis of the sensor in world."""
    return math.atan2(x_world[1], x_world[0]) - float(at.datum.convergence_rad(at.body_m))


def _read(at: Attachment, config: CompassConfig, yaw: float) -> tuple[float, Array]:
    """Return the predicted reading, rad, and its derivative by the slow state (k,)."""
    if at.slow_value is None:
        return yaw, np.zeros(0)
    s, c = math.sin(yaw), math.cos(yaw)
    terms = np.array([1.0, c, s, 2.0 * s * c, s * s - c * c, 1.0])[_sigmas(config) > 0.0]
    return yaw + float(terms @ at.slow_value), terms


def _slope(at: Attachment, config: CompassConfig, yaw: float) -> float:
    """Return the derivative of the reading by yaw: 1 and that of the deviation.

    Online it is 1. Readings tell no heading beyond what is known of A: a heading that is off by as much as A, with B to E
    turned by that, reads the same. Derivatives that are taken at one estimate of B to E and kept while these change
    contradict each other in that direction, and together they seem to tell the heading (see `online._constants`): of a
    compass with a mount good to 10 deg and a deviation of 8.5 deg to 2 deg, from 10 s on, where the vessel goes straight.
    """
    if at.slow_value is None or at.T_solver is not None:
        return 1.0
    s, c = math.sin(yaw), math.cos(yaw)
    slopes = np.array([0.0, -s, c, 2.0 * (c * c - s * s), 4.0 * s * c, 0.0])[_sigmas(config) > 0.0]
    return 1.0 + float(slopes @ at.slow_value)


def residuals(m: CompassHeading, config: CompassConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (1,), rad."""
    R, x_body, x = _axis(at)
    yaw = _yaw(at, x)
    read, terms = _read(at, config, yaw)
    raw = np.array([math.remainder(read - m.yaw_rad, math.tau)])
    sigma = max(m.sigma_rad, _FLOOR_RAD)
    return (
        Residual(
            raw=raw,
            cov=np.array([[sigma**2]]),
            jacobian=lambda: _slope(at, config, yaw) * _yaw_jacobian(R, x_body, x)[None, :],
            slow_jacobian=lambda: terms[None, :],
            size_deg=abs(math.degrees(raw[0])),
        ),
    )


def slow(config: CompassConfig) -> SlowProcess:
    """Return the process of mount offset, deviation and wander, as configured."""
    sigma, time_constant_s = _sigmas(config), np.array([np.inf] * 5 + [config.wander_time_constant_s])
    there = sigma > 0.0
    return SlowProcess(
        name="compass offset",
        axes=tuple(np.array(["yaw", *_DEVIATION, "wander"])[there].tolist()),
        units=("deg",) * int(there.sum()),
        scale=np.full(int(there.sum()), 180.0 / np.pi),
        sigma=sigma[there],
        time_constant_s=time_constant_s[there],
        no_tails=_DEVIATION if config.mount_offset_sigma_deg > 0.0 else ("yaw", *_DEVIATION),
        # Iron that is moved on board, or a wrong fix of a GNSS compass, adds a constant.
        stepped=("yaw",),
    )


def ideal(at: Attachment, config: CompassConfig) -> CompassHeading:
    """Return the noise-free heading at the attachment's state."""
    _, _, x = _axis(at)
    yaw = float(wrap_angle(np.array(_read(at, config, _yaw(at, x))[0])))
    return CompassHeading(stamp_ns=0, sensor="compass", seq=0, yaw_rad=yaw, sigma_rad=np.radians(config.sigma_deg))


def hint(m: CompassHeading, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the heading of body."""
    return Hint(yaw_rad=m.yaw_rad - mount_yaw_rad, yaw_sigma_rad=m.sigma_rad)


ROW = Sensor(
    kind="compass",
    measurement=CompassHeading,
    config=CompassConfig,
    residuals=residuals,
    ideal=ideal,
    hint=hint,
    slow=slow,
)
