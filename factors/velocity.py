# SPDX-License-Identifier: Apache-2.0
"""GNSS velocity of the antenna.

    z = v + dv + R (omega x (l + o)) + w,   w ~ N(0, C)

v: velocity of body in world at the state; dv: its change until the measurement, by the IMU; omega: body rate from the gyroscope,
bias removed; l: antenna in body; o: how far from there it sits, a constant of the run, where that is not known. d z / d v = I,
d z / d theta = -R [omega x (l + o)]_x. The lever-arm term carries information: in waves it shows the heading. With R fixed at the
estimate in it, passes converged slowly (not after 6). dv and omega are taken from the estimate at every pass; dv within half a period
of the states turns by 9 mm/s for 1 deg of attitude.
"""

from __future__ import annotations

import numpy as np

from graphloc.config import VelocityConfig
from graphloc.factors._noise import with_floors
from graphloc.frames import Array, Datum, skew
from graphloc.graph import PLACE, Attachment, Constant, Hint, Residual, Sensor
from graphloc.measurements import GnssVelocity


def _off_m(at: Attachment) -> Array | None:
    """Return o (3,), m, in the antenna's axes; None where it is not estimated."""
    return at.constants[0][1] if at.constants else None


def _attitude_jacobian(at: Attachment) -> Array:
    """Return the derivative (3, 6) of R Exp(theta) (omega x l) by the body tangent (theta, rho)."""
    swing = skew(at.swing_mps(_off_m(at)))
    return np.hstack([-at.T_world_body.rotation().matrix() @ swing, np.zeros((3, 3))])


def _by_constants(at: Attachment) -> tuple[Array, ...]:
    """Return the derivative (3, 3) of the velocity by o, where that is estimated."""
    if not at.constants:
        return ()
    R = at.T_world_body.rotation().matrix()
    return (R @ skew(at.gyro_radps) @ at.T_state_sensor.rotation().matrix(),)


def residuals(m: GnssVelocity, config: VelocityConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (3,), m/s, in world."""
    raw = at.sensor_velocity_mps(_off_m(at)) - m.v_world_mps
    return (
        Residual(
            raw=raw,
            cov=with_floors(m.cov_m2ps2, config.min_sigma_mps**2),
            jacobian=lambda: _attitude_jacobian(at),
            velocity_jacobian=lambda: np.eye(3),
            constant_jacobians=lambda: _by_constants(at),
            prior=1.0,
            size_m=None,
            size_deg=None,
        ),
    )


def constants(config: VelocityConfig) -> tuple[Constant, ...]:
    """Return how far off the antenna is, m, where that is not known."""
    if config.mount_sigma_m == 0.0:
        return ()
    return (Constant(name="antenna", sigma=np.full(3, config.mount_sigma_m), corrects=PLACE),)


def ideal(at: Attachment, config: VelocityConfig) -> GnssVelocity:
    """Return the noise-free velocity at the attachment's state."""
    return GnssVelocity(
        stamp_ns=0,
        sensor="gnss_velocity",
        seq=0,
        v_world_mps=at.sensor_velocity_mps(_off_m(at)),
        cov_m2ps2=np.eye(3) * 0.01,
    )


def hint(m: GnssVelocity, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the velocity of the antenna."""
    return Hint(v_world_mps=m.v_world_mps)


ROW = Sensor(
    kind="gnss_velocity",
    measurement=GnssVelocity,
    config=VelocityConfig,
    residuals=residuals,
    ideal=ideal,
    hint=hint,
    constants=constants,
    company=True,
)
