# SPDX-License-Identifier: Apache-2.0
"""GNSS velocity of the antenna.

    z = L' (v + dv + R (omega x (l + o)) + a tau) + d + w,   w ~ N(0, C + W),   d: first-order Gauss-Markov per axis
    a = R (f + alpha x (l + o) + omega x (omega x (l + o))) + g

L: rotation from east, north, up where the vessel is to world (`Datum.local_axes`); v: velocity of body in world at the state; dv: its
change until the measurement, by the IMU; omega: body rate from the gyroscope, bias removed; l: configured place of the antenna in body;
a: its acceleration, by the specific force f and the angular acceleration alpha; W: what d walks between its nodes
(`Attachment.slow_walk`). Constants of the run, estimated where they are not known: o: place of the antenna less l; tau: time of
measurement less the stamp (negative: the stamp is late). The slow state holds n = -d, as that of `gnss`.

d z / d v = L',  d z / d theta = -L' R [omega x (l + o) + (f + ...) tau]_x. The lever-arm term carries information: in waves it shows
the heading. With R in it fixed at the estimate, passes converged slowly (not after 6). dv and omega are taken from the estimate at every
pass; within half a period of the states, dv turns by 9 mm/s for 1 deg of attitude. Not handled: change of a within tau.
"""

from __future__ import annotations

import numpy as np

from graphloc.config import VelocityConfig
from graphloc.factors._noise import walked, with_floors
from graphloc.factors._receiver import late_and_off, stamps_and_antenna
from graphloc.frames import Array, Datum, skew
from graphloc.graph import Attachment, Hint, Residual, Sensor, SlowProcess
from graphloc.measurements import GnssVelocity


def _to_local(at: Attachment) -> Array:
    """L' (3, 3)."""
    return at.datum.local_axes(at.body_m).T


def _predicted_mps(at: Attachment, config: VelocityConfig, to_local: Array) -> Array:
    """Return the predicted velocity (3,), without white noise: east, north, up."""
    late, off = late_and_off(at, config)
    v = at.sensor_velocity_mps(off)
    if late:
        v = v + at.sensor_acceleration_mps2(off) * late
    v = to_local @ v
    return v if at.slow_value is None else v - at.slow_value


def _attitude_jacobian(at: Attachment, config: VelocityConfig, to_local: Array) -> Array:
    """Return d z / d (body tangent of the state's pose: theta, rho), (3, 6)."""
    late, off = late_and_off(at, config)
    turned = at.swing_mps(off) + (at.pushed_mps2(off) * late if late else 0.0)
    return np.hstack([-to_local @ at.T_world_body.rotation().matrix() @ skew(turned), np.zeros((3, 3))])


def _by_constants(at: Attachment, config: VelocityConfig, to_local: Array) -> tuple[Array, ...]:
    """Return the derivative (3, k) of the velocity by tau and o, as far as they are estimated."""
    if not at.constants:
        return ()
    late, off = late_and_off(at, config)
    columns = [at.sensor_acceleration_mps2(off)[:, None]] if config.stamp_sigma_s > 0.0 else []
    if config.mount_sigma_m > 0.0:
        swing = skew(at.gyro_radps)
        if late and at.felt is not None:
            swing = swing + late * (skew(at.felt.spin_radps2) + swing @ swing)
        columns.append(at.R_by_constants @ swing @ at.T_state_sensor.rotation().matrix())
    return (to_local @ np.hstack(columns),) if columns else ()


def residuals(m: GnssVelocity, config: VelocityConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (3,), m/s: east, north, up."""
    to_local = _to_local(at)
    plain = Residual(
        raw=_predicted_mps(at, config, to_local) - m.v_enu_mps,
        cov=with_floors(m.cov_m2ps2, config.min_sigma_mps**2),
        jacobian=lambda: _attitude_jacobian(at, config, to_local),
        velocity_jacobian=lambda: to_local,
        slow_jacobian=lambda: -np.eye(3),
        constant_jacobians=lambda: _by_constants(at, config, to_local),
    )
    return (plain if at.slow_walk is None else walked(plain, at.walked()),)


def slow(config: VelocityConfig) -> SlowProcess | None:
    """Return the process of the velocity error that lasts for seconds (d); None if none is modelled."""
    if config.wander_sigma_mps == 0.0:
        return None
    return SlowProcess(
        name="GNSS velocity error",
        axes=("east", "north", "up"),
        units=("m/s", "m/s", "m/s"),
        scale=np.full(3, -1.0),
        sigma=np.full(3, config.wander_sigma_mps),
        time_constant_s=np.full(3, config.wander_time_constant_s),
    )


def ideal(at: Attachment, config: VelocityConfig) -> GnssVelocity:
    """Return the noise-free velocity at the attachment's state."""
    return GnssVelocity(
        stamp_ns=0,
        sensor="gnss_velocity",
        seq=0,
        v_enu_mps=_predicted_mps(at, config, _to_local(at)),
        cov_m2ps2=np.eye(3) * 0.01,
    )


def hint(m: GnssVelocity, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the velocity of the antenna."""
    return Hint(v_world_mps=m.v_enu_mps)


ROW = Sensor(
    kind="gnss_velocity",
    measurement=GnssVelocity,
    config=VelocityConfig,
    residuals=residuals,
    ideal=ideal,
    hint=hint,
    slow=slow,
    constants=stamps_and_antenna,
    company=True,
)
