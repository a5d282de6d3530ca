# SPDX-License-Identifier: Apache-2.0
"""Health: how far each pose can be trusted, and why not fully."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from typing import Any

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Stream
from graphloc.config import VesselConfig
from graphloc.frames import Array
from graphloc.graph import SlowProcess
from graphloc.solution import LOST_BOUND_M, Cause, Health, HealthReason
from graphloc.trajectory import bounds_95

_LOST_HEADING_DEG = 45.0  # 95 % bound beyond which a heading helps nobody
_DEAD_RECKONING_S, _SILENT_S = 5.0, 10.0
_OFF_MOUNT = 10.0  # sigmas of a compass's offset

FAR_OFF = 3.0
"""Sigmas from its setting beyond which an estimate is said to be far off."""


def late_of(stream: Stream, values: gtsam.Values) -> float | None:
    """Return how much later than stamped a sensor measures, s; None where its slow state does not estimate that."""
    if stream.slow is None or (axis := stream.slow.late) is None:
        return None
    return float(values.atVector(keys.slow(stream.number, 0))[axis])


def why_late(sensor: str) -> str:
    """Return the reason why no pose is good beside a sensor whose stamps are far off."""
    return f"the stamps of {sensor} are far off what stamp_sigma_s allows for"


def why_ahead(sensor: str) -> str:
    """Return the reason why no pose is good beside a sensor whose stamps are of a clock ahead of the IMU's."""
    return f"the stamps of {sensor} are of a clock ahead of the IMU's"


def why_unlikely(sensor: str) -> str:
    """Return the reason why no pose is good beside a sensor that agrees only by an unlikely large slow error."""
    return f"{sensor} agrees only by more than {FAR_OFF:g} sigmas of its slow error: it contradicts the others"


def why_off_mount(sensor: str, slow: SlowProcess | None, value: Array) -> str:
    """Return the reason why no pose is good beside a compass that is far off its mount; empty if it is not.

    Its mount or that of the IMU is wrong, and the heading with the IMU's.

    Args:
        value: (k,) of its slow state, which has its offset.
    """
    if slow is None:
        return ""
    offset = np.array([axis in slow.stepped for axis in slow.axes])
    sigmas = float(np.max(np.abs(value / slow.sigma)[offset], initial=0.0))
    return (
        f"{sensor} is {sigmas:.0f} sigmas off its mount: its mount, or the IMU's, is wrong"
        if sigmas > _OFF_MOUNT
        else ""
    )


def of_receivers(since: Mapping[str, Any], config: VesselConfig) -> dict[str, Any]:
    """Return, by absolute sensor, how long its receiver has not agreed, s, numbers or arrays.

    Sensors that read one receiver by turns count as one.

    Args:
        since: by sensor, how long it has not agreed, s.
    """
    alike = {name: config.by_turns(name) for name in since}
    return {
        name: reduce(np.minimum, (since[other] for other in others if other in since)) for name, others in alike.items()
    }


def health_of(
    cov: Array, away_s: Mapping[str, float], good_bound_m: float, misfit: str = ""
) -> tuple[Health, HealthReason]:
    """Return how far a pose can be trusted, and why not fully.

    Args:
        cov: (6, 6) as in `Trajectory`. away_s: s to where each absolute sensor agrees.
        good_bound_m: `output.good_bound_m`. misfit: what else speaks against the pose.
    """
    bound_m, _, heading_deg = (float(v) for v in bounds_95(cov[None])[0])
    silent = [name for name, s in away_s.items() if s > _SILENT_S]
    if bound_m > LOST_BOUND_M:
        return Health.LOST, HealthReason(f"95 % bound {bound_m:.0f} m, heading {heading_deg:.0f} deg", Cause.BOUND)
    if heading_deg > _LOST_HEADING_DEG:
        said = f"heading unknown: 95 % bound {heading_deg:.0f} deg; that of the position {bound_m:.1f} m"
        return Health.LOST, HealthReason(said, Cause.HEADING)
    if min(away_s.values(), default=np.inf) > _DEAD_RECKONING_S:
        return Health.DEAD_RECKONING, HealthReason("no absolute position agrees", Cause.NO_POSITION)
    if bound_m > good_bound_m:
        return Health.DEGRADED, HealthReason(f"95 % bound {bound_m:.1f} m", Cause.BOUND)
    if silent:
        return Health.DEGRADED, HealthReason(
            f"{', '.join(silent)} missing or not agreeing", Cause.SENSORS, tuple(silent)
        )
    if misfit:
        return Health.DEGRADED, HealthReason(misfit, Cause.CONTRADICTION)
    return Health.GOOD, HealthReason()
