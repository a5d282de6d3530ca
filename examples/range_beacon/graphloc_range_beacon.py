# SPDX-License-Identifier: Apache-2.0
"""Range to a beacon on the shore, a sensor that graphloc does not have.

    z = |a - b| + w,   w ~ N(0, s^2),   a = p + R l

p, R: the body at the state, in world; l: the antenna seen from there; b: the beacon, in world. With the direction
u = (a - b) / |a - b| turned into body axes, e = R^T u, a step (theta, rho) of the pose, in body axes, lengthens the
range by (l x e) . theta + e . rho. Close to the beacon, within a few sigmas, the direction means nothing: keep away.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from graphloc.blocks import Positive, Triple
from graphloc.config import SensorConfig
from graphloc.frames import Array, Datum
from graphloc.graph import Attachment, FalseModel, Hint, Residual, Sensor
from graphloc.measurements import Measurement


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BeaconRange(Measurement):
    """Distance from the antenna to the beacon, m."""

    range_m: float


class RangeBeaconConfig(SensorConfig):
    """Range to a beacon at a known place (`sensor_msgs/Range`)."""

    kind: Literal["range_beacon"] = "range_beacon"
    """Which row of the sensor table reads this block."""
    beacon_m: Triple
    """Place of the beacon in world: east, north, up, m."""
    sigma_m: Positive = 0.3
    """Noise of a range, 1 sigma, m."""
    false_fraction: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.05
    """Share of ranges that are expected to be false: by a detour, or of a beacon that was moved."""


def _range_and_direction(at: Attachment, config: RangeBeaconConfig) -> tuple[float, Array]:
    away = at.sensor_m() - np.array(config.beacon_m)
    range_m = float(np.linalg.norm(away))
    return range_m, away / range_m


def residuals(m: BeaconRange, config: RangeBeaconConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residual predicted - measured (1,) in m."""
    range_m, direction = _range_and_direction(at, config)
    in_body = at.T_world_body.rotation().matrix().T @ direction
    jacobian = np.concatenate([np.cross(at.T_state_sensor.translation(), in_body), in_body])[None, :]
    raw = np.array([range_m - m.range_m])
    return (
        Residual(
            raw=raw, cov=np.array([[config.sigma_m**2]]), jacobian=lambda: jacobian, prior=1.0,
            size_m=abs(float(raw[0])), size_deg=None,
        ),
    )  # fmt: skip


def false(m: BeaconRange, config: RangeBeaconConfig) -> FalseModel:
    """A false range is off by some 30 m, and one that follows it errs alike: a moved beacon stays moved."""
    return FalseModel(probability=config.false_fraction, cov=np.array([[30.0**2]]), repeats=0.9)


def ideal(at: Attachment, config: RangeBeaconConfig) -> BeaconRange:
    """Return the range that the attachment's estimate would give."""
    return BeaconRange(stamp_ns=0, sensor="range_beacon", seq=0, range_m=_range_and_direction(at, config)[0])


def hint(m: BeaconRange, mount_yaw_rad: float, datum: Datum) -> Hint:
    """One range tells no place."""
    return Hint()


def decode(msg: Any, stamp_ns: int, seq: int, sensor: str, config: RangeBeaconConfig) -> BeaconRange:
    """Read a `sensor_msgs/Range`; what is raised is the reason in the ledger."""
    if not msg.min_range <= msg.range <= msg.max_range:
        raise ValueError(f"range of {msg.range:g} m is not within {msg.min_range:g} to {msg.max_range:g} m")
    return BeaconRange(stamp_ns=stamp_ns, sensor=sensor, seq=seq, range_m=float(msg.range))


DECODERS = {"sensor_msgs/msg/Range": decode}
ROW = Sensor(
    kind="range_beacon", measurement=BeaconRange, config=RangeBeaconConfig, residuals=residuals, ideal=ideal, hint=hint,
    false=false, company=True, in_world=True,
)  # fmt: skip
