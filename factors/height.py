# SPDX-License-Identifier: Apache-2.0
"""Height prior: a vessel floats.

    z = (p + R l)_up + w,   w ~ N(0, s^2)

p, R: state in world; l: body origin from it. A native `GPSFactorArm` whose horizontal sigmas are 1 km wide.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from graphloc.config import HeightConfig
from graphloc.factors._noise import robust
from graphloc.frames import Array, Datum
from graphloc.graph import Attachment, Decision, GraphUpdate, Hint, Residual, Sensor
from graphloc.measurements import HeightPrior
from graphloc.time import duration_ns

_WIDE_M = 1e3


def residuals(m: HeightPrior, config: HeightConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residual predicted - expected (1,) in m."""
    lever = np.asarray(at.T_state_sensor.translation())
    raw = np.array([at.T_world_body.transformFrom(lever)[2] - m.z_world_m])

    def jacobian() -> Array:
        up = at.T_world_body.rotation().matrix()[2]
        return np.concatenate([np.cross(lever, up), up])[None, :]

    return (
        Residual(
            raw=raw,
            cov=np.array([[m.sigma_m**2]]),
            jacobian=jacobian,
            prior=1.0,
            size_m=float(abs(raw[0])),
            size_deg=None,
        ),
    )


def factors(m: HeightPrior, config: HeightConfig, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factor of one height."""
    sigmas = np.array([_WIDE_M, _WIDE_M, m.sigma_m / np.sqrt(decision.weight)])
    model = robust(gtsam.noiseModel.Diagonal.Sigmas(sigmas), decision.kernel)
    lever = np.asarray(at.T_state_sensor.translation())
    target = np.array(at.T_world_body.transformFrom(lever))
    target[2] = m.z_world_m
    return GraphUpdate(factors=(gtsam.GPSFactorArm(at.pose_key, target, lever, model),))


def ideal(at: Attachment, config: HeightConfig) -> HeightPrior:
    """Return the height that the attachment's estimate would give."""
    z = float(at.T_world_body.transformFrom(at.T_state_sensor.translation())[2])
    return HeightPrior(stamp_ns=0, sensor="height", seq=0, z_world_m=z, sigma_m=config.sigma_m)


def synthetic(name: str, config: HeightConfig, span_ns: Sequence[int], z_world_m: float) -> list[HeightPrior]:
    """Return one prior every `period_s` over the span (start, stop), at height `z_world_m`."""
    stamps = range(span_ns[0], span_ns[1], duration_ns(config.period_s))
    return [HeightPrior(stamp_ns=s, sensor=name, seq=-1, z_world_m=z_world_m, sigma_m=config.sigma_m) for s in stamps]


def hint(m: HeightPrior, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the height."""
    return Hint(p_world_m=np.array([np.nan, np.nan, m.z_world_m]), p_sigma_m=np.array([np.nan, np.nan, m.sigma_m]))


ROW = Sensor(
    kind="height",
    measurement=HeightPrior,
    config=HeightConfig,
    residuals=residuals,
    factors=factors,
    ideal=ideal,
    hint=hint,
    synthetic=synthetic,
)
