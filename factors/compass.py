# SPDX-License-Identifier: Apache-2.0
"""Compass heading with a mount offset.

    z = yaw(R_world_body R_body_sensor) + o + w,   w ~ N(0, s^2),   o: constant offset of the mount

yaw(R) = atan2(R10, R00). With R <- R Exp(theta): d yaw / d theta = -(row 2 of R) . (x-hat cross-terms),
worked out in `_yaw_jacobian`. GTSAM has no native factor with yaw and offset in one, so this one is
linearised anew at every pass (`_linear`): yaw is nearly linear in the correction (0.02 deg at 3 deg
of roll and pitch and 5 deg of correction). Not handled: pitch near +-90 deg.
"""

from __future__ import annotations

import math

import numpy as np

from graphloc.config import CompassConfig
from graphloc.frames import Array, Datum, skew, wrap_angle
from graphloc.graph import Attachment, Decision, GraphUpdate, Hint, Residual, Sensor, SlowProcess
from graphloc.linear import Term, linear_update, pose_term
from graphloc.measurements import CompassHeading

_FLOOR_RAD = np.radians(0.05)  # no compass is better, whatever it says


def _yaw_jacobian(R: Array, x_body: Array, x_world: Array) -> Array:
    """Derivative (6,) of yaw(R Exp(theta) R_state_sensor) by the body tangent (theta, rho); x_*: the sensor's x axis."""
    # d(R Exp(theta) x)/d theta = -R [x]_x, of which a row r of R gives x x r; yaw = atan2(y, x)
    horizontal = x_world[0] ** 2 + x_world[1] ** 2
    jacobian = np.zeros(6)
    jacobian[:3] = skew(x_body) @ ((x_world[0] * R[1] - x_world[1] * R[0]) / horizontal)
    return jacobian


def _axis(at: Attachment) -> tuple[Array, Array, Array]:
    """The attitude (3, 3), and the sensor's x axis in body and in world."""
    R, x_body = at.T_world_body.rotation().matrix(), at.T_state_sensor.rotation().matrix()[:, 0]
    return R, x_body, R @ x_body


def residuals(m: CompassHeading, config: CompassConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residual predicted - measured (1,) in rad."""
    R, x_body, x = _axis(at)
    offset = 0.0 if at.slow_value is None else float(at.slow_value[0])
    raw = np.array([math.remainder(math.atan2(x[1], x[0]) + offset - m.yaw_rad, math.tau)])
    sigma = max(m.sigma_rad, _FLOOR_RAD)
    return (
        Residual(
            raw=raw,
            cov=np.array([[sigma**2]]),
            jacobian=lambda: _yaw_jacobian(R, x_body, x)[None, :],
            slow_jacobian=lambda: np.eye(1),
            prior=1.0,
            size_m=None,
            size_deg=abs(math.degrees(raw[0])),
        ),
    )


def factors(m: CompassHeading, config: CompassConfig, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factor of one heading."""
    residual = residuals(m, config, at)[0]
    terms = [pose_term(at, residual.jacobian())]
    if at.slow_key is not None:
        terms.append(Term(at.slow_key, np.array(at.slow_value), np.eye(1)))
    return linear_update(residual, terms, decision)


def slow(config: CompassConfig) -> SlowProcess | None:
    """Return the mount offset that the configuration asks for."""
    if config.mount_offset_sigma_deg == 0.0:
        return None
    return SlowProcess(
        name="compass offset",
        axes=("yaw",),
        units=("deg",),
        scale=np.array([180.0 / np.pi]),
        sigma=np.radians([config.mount_offset_sigma_deg]),
        time_constant_s=np.array([np.inf]),
    )


def ideal(at: Attachment, config: CompassConfig) -> CompassHeading:
    """Return the heading that the attachment's estimate would give."""
    _, _, x = _axis(at)
    offset = 0.0 if at.slow_value is None else float(at.slow_value[0])
    yaw = float(wrap_angle(np.arctan2(x[1], x[0]) + offset))
    return CompassHeading(stamp_ns=0, sensor="compass", seq=0, yaw_rad=yaw, sigma_rad=np.radians(config.sigma_deg))


def hint(m: CompassHeading, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the body's heading."""
    return Hint(yaw_rad=m.yaw_rad - mount_yaw_rad, yaw_sigma_rad=m.sigma_rad)


ROW = Sensor(
    kind="compass",
    measurement=CompassHeading,
    config=CompassConfig,
    residuals=residuals,
    factors=factors,
    ideal=ideal,
    hint=hint,
    slow=slow,
)
