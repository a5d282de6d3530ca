# SPDX-License-Identifier: Apache-2.0
"""Height prior: a vessel floats.

    z = (p + R l)_up + d^2 / 2 R_earth + w,   w ~ N(0, s^2)

p, R: state in world; l: body origin from it; d: horizontal distance from the datum, below whose tangent
plane the sea falls off (2 m at 5 km), taken from the estimate at every pass. A native `GPSFactorArm`
whose horizontal sigmas are 1 km wide.
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
_EARTH_M = 6_371_000.0


def _fall_m(p_world_m: Array) -> float:
    """How far the ellipsoid lies below the datum's tangent plane."""
    return float(p_world_m[0] ** 2 + p_world_m[1] ** 2) / (2.0 * _EARTH_M)


def residuals(m: HeightPrior, config: HeightConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residual predicted - expected (1,) in m."""
    lever = np.asarray(at.T_state_sensor.translation())
    point = at.T_world_body.transformFrom(lever)
    raw = np.array([point[2] + _fall_m(point) - m.height_m])

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
    target[2] = m.height_m - _fall_m(target)
    return GraphUpdate(factors=(gtsam.GPSFactorArm(at.pose_key, target, lever, model),))


def ideal(at: Attachment, config: HeightConfig) -> HeightPrior:
    """Return the height that the attachment's estimate would give."""
    point = at.T_world_body.transformFrom(at.T_state_sensor.translation())
    height_m = float(point[2]) + _fall_m(point)
    return HeightPrior(stamp_ns=0, sensor="height", seq=0, height_m=height_m, sigma_m=config.sigma_m)


def synthetic(name: str, config: HeightConfig, span_ns: Sequence[int], height_m: float) -> list[HeightPrior]:
    """Return one prior every `period_s` over the span (start, stop), at `height_m` over the datum's."""
    stamps = range(span_ns[0], span_ns[1], duration_ns(config.period_s))
    return [HeightPrior(stamp_ns=s, sensor=name, seq=-1, height_m=height_m, sigma_m=config.sigma_m) for s in stamps]


def hint(m: HeightPrior, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the height."""
    return Hint(p_world_m=np.array([np.nan, np.nan, m.height_m]), p_sigma_m=np.array([np.nan, np.nan, m.sigma_m]))


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
