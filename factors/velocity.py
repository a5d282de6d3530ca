# SPDX-License-Identifier: Apache-2.0
"""GNSS velocity of the antenna.

    z = v + dv + R (omega x l) + w,   w ~ N(0, C)

v: velocity of body in world at the state; dv: what the IMU says it gains until the measurement; omega:
body rate from the gyroscope, bias removed; l: antenna in body. R and omega are taken from the current
estimate (re-anchored every pass), so a native `PriorFactorVector` on v serves: at 15 deg/s and 3 m of
lever, 1 deg of attitude error costs 14 mm/s.
"""

from __future__ import annotations

import gtsam
import numpy as np

from graphloc.config import VelocityConfig
from graphloc.factors._noise import noise_model, with_floors
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, GraphUpdate, Residual, Sensor
from graphloc.measurements import GnssVelocity


def _added_mps(at: Attachment) -> Array:
    swing = at.T_world_body.rotation().matrix() @ np.cross(at.gyro_radps, at.lever_m)
    return np.asarray(at.dv_world_mps + swing)


def residuals(m: GnssVelocity, config: VelocityConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residual predicted - measured (3,) in m/s, world axes."""
    raw = at.v_world_mps + _added_mps(at) - m.v_world_mps
    return (
        Residual(
            raw=raw,
            cov=with_floors(m.cov_m2ps2, config.min_sigma_mps**2),
            jacobian=lambda: np.zeros((3, 6)),
            prior=1.0,
            size_m=None,
            size_deg=None,
        ),
    )


def factors(m: GnssVelocity, config: VelocityConfig, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factor of one velocity."""
    model = noise_model(with_floors(m.cov_m2ps2, config.min_sigma_mps**2), decision)
    return GraphUpdate(factors=(gtsam.PriorFactorVector(at.velocity_key, m.v_world_mps - _added_mps(at), model),))


def ideal(at: Attachment, config: VelocityConfig) -> GnssVelocity:
    """Return the velocity that the attachment's estimate would give."""
    v = at.v_world_mps + _added_mps(at)
    return GnssVelocity(stamp_ns=0, sensor="gnss_velocity", seq=0, v_world_mps=v, cov_m2ps2=np.eye(3) * 0.01)


ROW = Sensor(
    kind="gnss_velocity",
    measurement=GnssVelocity,
    config=VelocityConfig,
    residuals=residuals,
    factors=factors,
    ideal=ideal,
)
