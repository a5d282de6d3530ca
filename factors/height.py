# SPDX-License-Identifier: Apache-2.0
"""Height prior: a vessel floats.

    z = (p + R l)_up + d^2 / 2 R_earth - t + w,   w ~ N(0, s^2)

p, R: state in world; l: body origin from it; d: horizontal distance from the datum, below whose tangent
plane the sea falls off (2 m at 5 km), taken from the estimate at every pass; t: how far tide and load hold the vessel
above what is configured, a slow state (taken for noise, a tide of 0.2 m is refuted 120 times in two minutes, and bends
what tags on a quay say of the height). Without it a native `GPSFactorArm` whose horizontal sigmas are 1 km wide.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from graphloc.config import HeightConfig
from graphloc.factors._noise import robust
from graphloc.frames import Array, Datum, skew
from graphloc.graph import Attachment, Decision, GraphUpdate, Hint, Residual, Sensor, SlowProcess
from graphloc.linear import Term, linear_update, pose_term
from graphloc.measurements import HeightPrior
from graphloc.time import duration_ns

_WIDE_M = 1e3
_EARTH_M = 6_371_000.0
_TIDE_S = 6.0 * 3600.0


def _fall_m(p_world_m: Array) -> float:
    """How far the ellipsoid lies below the datum's tangent plane."""
    return float(p_world_m[0] ** 2 + p_world_m[1] ** 2) / (2.0 * _EARTH_M)


def residuals(m: HeightPrior, config: HeightConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residual predicted - expected (1,) in m."""
    lever = np.asarray(at.T_state_sensor.translation())
    point = at.T_world_body.transformFrom(lever)
    tide = 0.0 if at.slow_value is None else float(at.slow_value[0])
    raw = np.array([point[2] + _fall_m(point) - tide - m.height_m])

    def jacobian() -> Array:
        up = at.T_world_body.rotation().matrix()[2]
        return np.concatenate([skew(lever) @ up, up])[None, :]

    return (
        Residual(
            raw=raw,
            cov=np.array([[m.sigma_m**2]]),
            jacobian=jacobian,
            slow_jacobian=lambda: -np.eye(1),
            prior=1.0,
            size_m=float(abs(raw[0])),
            size_deg=None,
        ),
    )


def factors(m: HeightPrior, config: HeightConfig, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factor of one height."""
    if at.slow_key is not None:
        (residual,) = residuals(m, config, at)
        terms = [
            pose_term(at, residual.jacobian()),
            Term(at.slow_key, np.array(at.slow_value), -np.eye(1)),
        ]
        return linear_update(residual, terms, decision)
    sigmas = np.array([_WIDE_M, _WIDE_M, m.sigma_m / np.sqrt(decision.weight)])
    model = robust(gtsam.noiseModel.Diagonal.Sigmas(sigmas), decision.kernel)
    lever = np.asarray(at.T_state_sensor.translation())
    target = np.array(at.T_world_body.transformFrom(lever))
    target[2] = m.height_m - _fall_m(target)
    return GraphUpdate(factors=(gtsam.GPSFactorArm(at.pose_key, target, lever, model),))


def ideal(at: Attachment, config: HeightConfig) -> HeightPrior:
    """Return the height that the attachment's estimate would give."""
    point = at.T_world_body.transformFrom(at.T_state_sensor.translation())
    tide = 0.0 if at.slow_value is None else float(at.slow_value[0])
    height_m = float(point[2]) + _fall_m(point) - tide
    return HeightPrior(stamp_ns=0, sensor="height", seq=0, height_m=height_m, sigma_m=config.sigma_m)


def slow(config: HeightConfig) -> SlowProcess | None:
    """Return how far tide and load may hold the vessel above or below the configured height."""
    if config.tide_sigma_m == 0.0:
        return None
    return SlowProcess(
        name="tide and load",
        axes=("up",),
        units=("m",),
        scale=np.ones(1),
        sigma=np.array([config.tide_sigma_m]),
        time_constant_s=np.array([_TIDE_S]),
    )


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
    slow=slow,
    synthetic=synthetic,
)
