# SPDX-License-Identifier: Apache-2.0
"""Velocity along the axes of the sensor: wheels, a Doppler log, a speed log.

    z = (1 + s) S u + w,   u = Q^T (R^T (v + dv - c) + omega x (l + M o)),   Q = M Rz(psi),   w ~ N(0, C)

v: velocity of body in world at the state; dv: its change until the measurement, by the IMU; c: the water's current, east and
north, a first-order Gauss-Markov process (over ground: none); R: body in world; omega: body rate from the gyroscope, bias
removed; l, M: configured mount of the sensor in body; S: selects the measured axes. Constants of the run, estimated where they are not
known: s: scale error; o: place of the sensor less l, axes of M (of wheels: of the point that does not slip sideways); psi: yaw of
the sensor beyond M. With a = R^T (v + dv - c), the derivatives of u are Q^T R^T by v, -Q^T R^T by c, and Q^T [a]_x by the body tangent
theta in R <- R Exp(theta). Where u is along x the row of x is zero there, so only y tells the heading, to first order. Not handled:
slip of wheels, other than as outliers; scales that differ between axes.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc.config import BodyVelocityConfig
from graphloc.factors._noise import with_floors
from graphloc.frames import Array, Datum, skew
from graphloc.graph import Attachment, Hint, Residual, Sensor, SlowProcess
from graphloc.measurements import BodyVelocity

_CURRENT, _OFF, _TURNED = slice(1, 3), slice(3, 6), 6  # rows of a slow state that has all, after the scale error
_Z = skew(np.array([0.0, 0.0, 1.0]))


def _there(config: BodyVelocityConfig) -> NDArray[np.bool_]:
    """Return which of scale error, current east and north, three axes of its place, and its yaw are in the slow state (7,)."""
    water, place = config.through == "water", config.mount_sigma_m > 0.0
    return np.array([config.scale_sigma > 0.0, *[water] * 2, *[place] * 3, config.mount_sigma_deg > 0.0])


def _slow_value(at: Attachment, config: BodyVelocityConfig) -> Array:
    """Return (7,) scale error s, current c, m/s (2), place o, m (3), and yaw psi, rad; zero where they are not modelled."""
    full = np.zeros(7)
    if at.slow_value is not None:
        full[_there(config)] = at.slow_value
    return full


def _moving(at: Attachment, config: BodyVelocityConfig) -> tuple[Array, Array, Array]:
    """Return u (3,), a (3,) and Q (3, 3), as in the module's docstring."""
    value = _slow_value(at, config)
    current = np.append(value[_CURRENT], 0.0)
    along = at.T_world_body.rotation().matrix().T @ (at.v_world_mps + at.dv_world_mps - current)
    M = at.T_state_sensor.rotation().matrix()
    turned = value[_TURNED]
    Q = M if turned == 0.0 else M @ gtsam.Rot3.Rz(turned).matrix()
    return Q.T @ (along + at.swing_mps(value[_OFF])), along, Q


def residuals(m: BodyVelocity, config: BodyVelocityConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (k,), m/s, in the sensor's axes."""
    u, along, Q = _moving(at, config)
    picked = ["xyz".index(axis) for axis in m.axes]
    scale = 1.0 + float(_slow_value(at, config)[0])

    def by_velocity() -> Array:
        return np.asarray(scale * (at.T_world_body.rotation().matrix() @ Q).T[picked])

    def by_pose() -> Array:
        return np.hstack([scale * (Q.T @ skew(along))[picked], np.zeros((len(picked), 3))])

    def by_slow() -> Array:
        by_place = Q.T @ skew(at.gyro_radps) @ at.T_state_sensor.rotation().matrix()
        moved = scale * np.column_stack([by_place, -_Z @ u])[picked]
        return np.hstack([u[picked][:, None], -by_velocity()[:, :2], moved])[:, _there(config)]

    return (
        Residual(
            raw=scale * u[picked] - m.value,
            cov=with_floors(m.cov, config.min_sigma_mps**2),
            jacobian=by_pose,
            slow_jacobian=by_slow,
            velocity_jacobian=by_velocity,
        ),
    )


def slow(config: BodyVelocityConfig) -> SlowProcess | None:
    """Return the process of scale error, current, place and yaw, as configured; None if none is modelled."""
    there = _there(config)
    if not there.any():
        return None
    names = ["scale", "current east", "current north", "mount x", "mount y", "mount z", "yaw"]
    turned_rad = np.radians(config.mount_sigma_deg)
    sigma = [config.scale_sigma, *[config.current_sigma_mps] * 2, *[config.mount_sigma_m] * 3, turned_rad]
    return SlowProcess(
        name="speed error",
        axes=tuple(np.array(names)[there].tolist()),
        units=tuple(np.array(["%", *["m/s"] * 2, *["m"] * 3, "deg"])[there].tolist()),
        scale=np.array([100.0, *[1.0] * 5, 180.0 / np.pi])[there],
        sigma=np.array(sigma)[there],
        time_constant_s=np.array([np.inf, *[config.current_time_constant_s] * 2, *[np.inf] * 4])[there],
    )


def ideal(at: Attachment, config: BodyVelocityConfig) -> BodyVelocity:
    """Return the noise-free velocity at the attachment's state."""
    u, _, _ = _moving(at, config)
    value = (1.0 + _slow_value(at, config)[0]) * u[["xyz".index(axis) for axis in config.axes]]
    return BodyVelocity(
        stamp_ns=0, sensor="body_velocity", seq=0, axes=config.axes, value=value, cov=np.eye(len(value)) * 0.01
    )


def hint(m: BodyVelocity, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return nothing: without a heading, it gives no velocity in world."""
    return Hint()


ROW = Sensor(
    kind="body_velocity",
    measurement=BodyVelocity,
    config=BodyVelocityConfig,
    residuals=residuals,
    ideal=ideal,
    hint=hint,
    slow=slow,
    company=True,
    along_body=True,
)
