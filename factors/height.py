# SPDX-License-Identifier: Apache-2.0
"""Height prior: a vessel floats.

    z = (p + R l)_up + d^2 / 2 R_earth - t + w,   w ~ N(0, s^2)

p, R: state in world; l: body origin seen from the state; d: horizontal distance from the datum, taken from the estimate at every
pass, as the sea falls below the datum's tangent plane (2 m at 5 km); t: a slow state: rise of the vessel by tide and load, and the error
of the configured height, or of the fixes' median that stands for it. Modelled as noise, a tide of 0.2 m is contradicted 120 times in
two minutes, and biases the height that tags on a quay give. Without t: a native `GPSFactorArm` whose horizontal sigmas are 1 km.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from graphloc.config import HeightConfig
from graphloc.factors._noise import robust
from graphloc.frames import EARTH_M, Array, Datum, skew
from graphloc.graph import Attachment, Decision, GraphUpdate, Hint, Residual, Sensor, SlowProcess
from graphloc.measurements import HeightPrior
from graphloc.time import duration_ns

_WIDE_M = 1e3
_TIDE_S = 6.0 * 3600.0


def _fall_m(p_world_m: Array) -> float:
    """Return how far the ellipsoid lies below the datum's tangent plane."""
    return float(p_world_m[0] ** 2 + p_world_m[1] ** 2) / (2.0 * EARTH_M)


def residuals(m: HeightPrior, config: HeightConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - expected (1,), m."""
    point = at.sensor_m()
    tide = 0.0 if at.slow_value is None else float(at.slow_value[0])
    raw = np.array([point[2] + _fall_m(point) - tide - m.height_m])

    def jacobian() -> Array:
        up, lever = at.T_world_body.rotation().matrix()[2], np.asarray(at.T_state_sensor.translation())
        return np.concatenate([skew(lever) @ up, up])[None, :]

    return (
        Residual(
            raw=raw,
            cov=np.array([[m.sigma_m**2]]),
            jacobian=jacobian,
            slow_jacobian=lambda: -np.eye(1),
            size_m=float(abs(raw[0])),
        ),
    )


def factors(m: HeightPrior, config: HeightConfig, at: Attachment, decision: Decision) -> GraphUpdate | None:
    """Return the native factor of one height; None where there is a tide."""
    if at.slow_key is not None:
        return None
    sigmas = np.array([_WIDE_M, _WIDE_M, m.sigma_m / np.sqrt(decision.weight)])
    model = robust(gtsam.noiseModel.Diagonal.Sigmas(sigmas), decision.kernel)
    lever = np.asarray(at.T_state_sensor.translation())
    target = at.sensor_m()
    target[2] = m.height_m - _fall_m(target)
    target -= at.carried_m
    return GraphUpdate(factors=(gtsam.GPSFactorArm(at.pose_key, target, lever, model),))


def ideal(at: Attachment, config: HeightConfig) -> HeightPrior:
    """Return the noise-free height at the attachment's state."""
    point = at.sensor_m()
    tide = 0.0 if at.slow_value is None else float(at.slow_value[0])
    height_m = float(point[2]) + _fall_m(point) - tide
    return HeightPrior(stamp_ns=0, sensor="height", seq=0, height_m=height_m, sigma_m=config.sigma_m)


def slow(config: HeightConfig) -> SlowProcess | None:
    """Return the process of tide, load and the error of the configured height (t); None if it is not modelled."""
    if config.offset_sigma_m == 0.0:
        return None
    return SlowProcess(
        name="tide and load",
        axes=("up",),
        units=("m",),
        scale=np.ones(1),
        sigma=np.array([config.offset_sigma_m]),
        time_constant_s=np.array([_TIDE_S]),
    )


def synthetic(name: str, config: HeightConfig, span_ns: Sequence[int], height_m: float) -> list[HeightPrior]:
    """Return a prior every `period_s` over a span.

    Args:
        span_ns: (start, stop). height_m: height of the body origin over the datum's.
    """
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
