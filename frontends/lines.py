# SPDX-License-Identifier: Apache-2.0
"""Lines of JSON to measurements (docs/online-stream.md).

What a line says passes the same checks as what the message in a bag says (`decode.measured`), so that a stream and a bag of
one run give equal measurements.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator
from pydantic_core import from_json
from scipy.spatial.transform import Rotation

from graphloc.blocks import Block, Finite, Triple, nearest
from graphloc.config import (
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    ImuConfig,
    PoseConfig,
    VelocityConfig,
    VesselConfig,
)
from graphloc.frames import Array, wrap_angle, yaw_from_heading_deg
from graphloc.frontends._rejections import Rejection, malformed
from graphloc.frontends._said import SaidAlong, SaidHeading, SaidPlace, SaidPose, SaidVelocity
from graphloc.frontends._standard import rotation_of, up_if_told
from graphloc.frontends.decode import Decoded, ImuReading, is_rtk, measured
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import ImuSample, Measurement, PoseFix, PoseMode
from graphloc.time import NS_PER_S, duration_ns

MAX_LINE = 1 << 20
"""Longest line that is read, bytes."""
TOPIC = "(stream)"
"""Topic, in the ledger, of lines that gave no measurement."""
_MAX_REASON = 200
_STATUS = {"none": -1, "fix": 0, "sbas": 1, "gbas": 2}  # sensor_msgs/NavSatStatus
_STAMP_LIMIT_NS = 9 * 10**18  # leaves room for a time offset in 64 bits
_ZERO = (0.0, 0.0, 0.0)


Positive = Annotated[float, Field(gt=0.0, le=1e9)]
Deviations = tuple[Positive, Positive, Positive]
Six = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
Matrix3 = tuple[Triple, Triple, Triple]
Matrix6 = tuple[Six, Six, Six, Six, Six, Six]
_Groups = tuple[tuple[str, ...], ...]


class _At(NamedTuple):
    """Stamp, arrival number and sensor of a measurement."""

    stamp_ns: int
    seq: int
    sensor: str


class _Said(Block, strict=True):
    """Part of a line. Unknown keys, and numbers given as strings or bools, are refused.

    Of each group of keys in `one_of` exactly one is given; of each in `at_most_one_of`, one or none.
    """

    one_of: ClassVar[_Groups] = ()
    at_most_one_of: ClassVar[_Groups] = ()

    @model_validator(mode="after")
    def _no_two_of_a_kind(self) -> Self:
        for keys in (*self.one_of, *self.at_most_one_of):
            given = [key for key in keys if getattr(self, key) is not None]
            if len(given) > 1 or (not given and keys in self.one_of):
                raise ValueError(f"give one of {', '.join(keys)}")
        return self


class _Stamped(_Said):
    """A time, exact: `stamp`, s since 1970 as a decimal string, or `stamp_ns`."""

    stamp: Annotated[str, Field(max_length=20)] | None = None
    stamp_ns: int | None = None

    @model_validator(mode="after")
    def _decimal(self) -> Self:
        if self.stamp is not None and not re.fullmatch(r"[0-9]{1,10}(\.[0-9]{1,9})?", self.stamp):
            raise ValueError("stamp: write s as decimals, at most nine behind the point, as in '1700000000.25'")
        return self

    @property
    def ns(self) -> int | None:
        """The stamp as sent, ns; None if the line has none."""
        if self.stamp is None:
            return self.stamp_ns
        whole, _, rest = self.stamp.partition(".")
        return int(whole) * NS_PER_S + int(rest.ljust(9, "0"))


class _Line(_Stamped):
    """A measurement; `sensor` may be omitted if only one sensor of this kind is enabled."""

    one_of: ClassVar[_Groups] = (("stamp", "stamp_ns"),)
    kind: ClassVar[str]  # kind of the sensor
    sensor: str = ""

    def sensor_in(self, config: VesselConfig) -> str | Rejection:
        """Return the name of the sensor, or why the line is not used."""
        names = [name for name, sensor in config.sensors.items() if sensor.kind == self.kind]
        enabled = list(config.of_kind(self.kind))
        if self.sensor and self.sensor not in names:
            return malformed(
                f"vessel.yaml has no sensor '{self.sensor[:60]}' of kind {self.kind}{nearest(self.sensor[:60], names)}"
            )
        if self.sensor and self.sensor not in enabled:
            return Rejection(Outcome.IGNORED, "switched off in vessel.yaml")
        receivers = list(dict.fromkeys(map(config.receiver_of, enabled)))
        if not self.sensor and len(receivers) != 1:
            return malformed(f"'sensor' is missing: vessel.yaml has {len(enabled)} enabled sensors of kind {self.kind}")
        return self.sensor or receivers[0]


class ImuLine(_Line):
    """Specific force (+g upwards at rest) and angular rate, in the IMU's axes."""

    kind = "imu"
    type: Literal["imu"]
    accel_mps2: Triple
    gyro_radps: Triple

    def measured(self, at: _At, _config: ImuConfig) -> Measurement | Rejection:
        """Return the sample."""
        accel, gyro = np.array(self.accel_mps2), np.array(self.gyro_radps)
        return ImuSample(stamp_ns=at.stamp_ns, sensor=at.sensor, seq=at.seq, accel_mps2=accel, gyro_radps=gyro)


class GnssLine(_Line):
    """A fix of the antenna on WGS 84, height above the ellipsoid if known; sigmas or covariance east, north, up."""

    kind = "gnss"
    at_most_one_of = (("sigma_m", "cov_enu_m2"),)
    type: Literal["gnss"]
    lat_deg: Finite
    lon_deg: Finite
    height_m: Finite | None = None
    sigma_m: Deviations | None = None
    cov_enu_m2: Matrix3 | None = None
    status: Literal["none", "fix", "sbas", "gbas"] = "fix"

    def sensor_in(self, config: VesselConfig) -> str | Rejection:
        """Return the name of the sensor; of sensors that take turns at one receiver, the one that reads this fix."""
        named = super().sensor_in(config)
        if isinstance(named, Rejection) or not config.sensors[named].takes_turns:
            return named
        read = "rtk" if is_rtk(_STATUS[self.status], self._cov()) else "other"
        readers = [name for name in config.by_turns(named) if config.sensors[name].fixes == read]
        return readers[0] if len(readers) == 1 else named  # several receivers without a topic: the line tells

    def _cov(self) -> Array:
        return _covariance(self.cov_enu_m2, self.sigma_m or _ZERO)

    def measured(self, at: _At, config: GnssConfig) -> Decoded:
        """Return the fix, or its rejection."""
        height_m = math.nan if self.height_m is None else self.height_m
        said = SaidPlace(self.lat_deg, self.lon_deg, height_m, _STATUS[self.status], covariance=self._cov())
        return measured(said, *at, config)


class HeadingLine(_Line):
    """Compass heading (from true north, clockwise), or yaw (from east, counter-clockwise), of the sensor's x axis."""

    kind = "compass"
    one_of = (("stamp", "stamp_ns"), ("heading_deg", "yaw_rad"))
    type: Literal["heading"]
    heading_deg: Annotated[float, Field(ge=-360.0, le=360.0)] | None = None
    yaw_rad: Annotated[float, Field(ge=-6.2832, le=6.2832)] | None = None
    sigma_deg: Positive | None = None

    def measured(self, at: _At, config: CompassConfig) -> Decoded:
        """Return the heading, with the configured sigma if the line has none or its sigma is not to be used."""
        yaw = wrap_angle(self.yaw_rad) if self.yaw_rad is not None else yaw_from_heading_deg(self.heading_deg or 0.0)
        return measured(SaidHeading(float(yaw), float(np.radians(self.sigma_deg or 0.0))), *at, config)


class VelocityLine(_Line):
    """Velocity of the antenna, east, north, up."""

    kind = "gnss_velocity"
    at_most_one_of = (("sigma_mps", "cov_enu_m2ps2"),)
    type: Literal["velocity"]
    v_enu_mps: Triple
    sigma_mps: Deviations | None = None
    cov_enu_m2ps2: Matrix3 | None = None

    def measured(self, at: _At, config: VelocityConfig) -> Decoded:
        """Return the velocity."""
        cov = _covariance(self.cov_enu_m2ps2, self.sigma_mps or _ZERO)
        return measured(SaidVelocity(up_if_told(self.v_enu_mps), covariance=cov), *at, config)


class BodyVelocityLine(_Line):
    """Velocity along the sensor's axes x, y, z; the configured axes are used."""

    kind = "body_velocity"
    at_most_one_of = (("sigma_mps", "cov_m2ps2"),)
    type: Literal["body_velocity"]
    v_mps: Triple
    sigma_mps: Deviations | None = None
    cov_m2ps2: Matrix3 | None = None

    def measured(self, at: _At, config: BodyVelocityConfig) -> Decoded:
        """Return the velocity."""
        cov = _covariance(self.cov_m2ps2, self.sigma_mps or _ZERO)
        return measured(SaidAlong(self.v_mps, cov), *at, config)


class ModeSaid(_Said):
    """One pose of the sensor in world; covariance of x, y, z (m), then of small rotations about world axes (rad)."""

    at_most_one_of = (("rpy_deg", "quaternion_xyzw"), ("sigma_m", "cov_m_rad"), ("sigma_deg", "cov_m_rad"))
    xyz_m: Triple
    rpy_deg: Triple | None = None
    quaternion_xyzw: tuple[Finite, Finite, Finite, Finite] | None = None
    sigma_m: Deviations | None = None
    sigma_deg: Deviations | None = None
    cov_m_rad: Matrix6 | None = None
    probability: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0

    def said(self) -> SaidPose:
        """Return what the mode says."""
        turn: Sequence[float] = self.quaternion_xyzw or (0.0, 0.0, 0.0, 0.0)  # as drivers without orientation write it
        if self.rpy_deg:
            turn = Rotation.from_euler("xyz", self.rpy_deg, degrees=True).as_quat().tolist()
        cov = _covariance(self.cov_m_rad, (*(self.sigma_m or _ZERO), *np.radians(self.sigma_deg or _ZERO)))
        return SaidPose(np.array(self.xyz_m), rotation_of(turn), cov)


class PoseLine(_Line):
    """A pose of the sensor in world, with one mode or several; the configured `axes` are used."""

    kind = "pose"
    type: Literal["pose"]
    modes: Annotated[tuple[ModeSaid, ...], Field(min_length=1, max_length=64)]

    def measured(self, at: _At, config: PoseConfig) -> Decoded:
        """Return the pose with its modes, each of which passes the checks of poses; a rejection if one does not."""
        modes: list[PoseMode] = []
        for mode in self.modes:
            fix = measured(mode.said(), *at, config)
            if not isinstance(fix, PoseFix):
                return fix
            modes.append(replace(fix.modes[0], probability=mode.probability))
        return PoseFix(stamp_ns=at.stamp_ns, sensor=at.sensor, seq=at.seq, axes=config.axes, modes=tuple(modes))


class PredictLine(_Stamped):
    """Request for the pose at a stamp, or at the newest IMU sample."""

    at_most_one_of = (("stamp", "stamp_ns"),)
    type: Literal["predict"]


_Any = ImuLine | GnssLine | HeadingLine | VelocityLine | BodyVelocityLine | PoseLine | PredictLine
_LINES: dict[str, type[_Any]] = {
    "imu": ImuLine,
    "gnss": GnssLine,
    "heading": HeadingLine,
    "velocity": VelocityLine,
    "body_velocity": BodyVelocityLine,
    "pose": PoseLine,
    "predict": PredictLine,
}


@dataclass(frozen=True, slots=True)
class Request:
    """Request for the pose at `stamp_ns`; None: at the newest IMU sample."""

    stamp_ns: int | None


@dataclass(frozen=True, slots=True)
class Trouble:
    """A line that gave no measurement, with its ledger row."""

    row: LedgerRow


def parse(line: bytes, number: int, seq: int, config: VesselConfig) -> Measurement | Request | Trouble:
    """Return the measurement, request or trouble in a line; never raises.

    Args:
        line: one JSON object. number: of the line, from 1. seq: arrival number of a measurement.
        config: the sensors; their `time_offset_s` is added to the stamps, as when a bag is read.
    """
    stamp_ns, sensor = 0, ""

    def trouble(why: Rejection) -> Trouble:
        reason = " ".join(why.reason.split())[:_MAX_REASON]
        return Trouble(
            LedgerRow(
                seq=seq, stamp_ns=stamp_ns, sensor=sensor, topic=TOPIC, outcome=why.outcome, reason=reason,
                detail=f"line {number}",
            )
        )  # fmt: skip

    if len(line) > MAX_LINE:
        return trouble(malformed(f"longer than {MAX_LINE} bytes"))
    try:
        raw = from_json(line, allow_inf_nan=False)
    except ValueError as error:
        return trouble(malformed(f"not JSON in UTF-8: {str(error).replace(' line 1 column', ' byte')}"))
    said = raw.get("type") if isinstance(raw, dict) else None
    if not isinstance(said, str) or said not in _LINES:
        return trouble(malformed(f"no JSON object with a known 'type'{nearest(str(said)[:60], list(_LINES))}"))
    if isinstance(raw.get("sensor"), str) and raw["sensor"] in config.sensors:
        sensor = raw["sensor"]
    try:
        message = _LINES[said].model_validate_json(line)
    except ValidationError as error:
        return trouble(malformed(f"{said}: {_first_of(error, _LINES[said])}"))
    if message.ns is not None and not 0 < message.ns < _STAMP_LIMIT_NS:
        return trouble(malformed(f"{said}: the stamp is zero, negative or too large"))
    if isinstance(message, PredictLine):
        return Request(message.ns)
    found = message.sensor_in(config)
    if isinstance(found, Rejection):
        return trouble(found)
    sensor = found
    stamp_ns = (message.ns or 0) + duration_ns(config.sensors[sensor].time_offset_s)
    try:
        with np.errstate(all="ignore"):
            value = message.measured(_At(stamp_ns, seq, sensor), config.sensors[sensor])
    except (ValueError, ArithmeticError) as error:
        value = malformed(f"{said}: {error}")
    assert not isinstance(value, ImuReading)  # a line of an IMU is an `ImuSample`
    return trouble(value) if isinstance(value, Rejection) else value


def _first_of(error: ValidationError, model: type[Block]) -> str:
    """Return the first error of a line in words; a long line may have thousands."""
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"])[:60]
    if first["type"] == "extra_forbidden":
        return f"unknown key '{key}'" + (nearest(key, list(model.model_fields)) if len(first["loc"]) == 1 else "")
    if first["type"] == "missing":
        return f"'{key}' is missing"
    text = first["msg"].removeprefix("Value error, ")
    return f"{key}: {text} (got {str(first['input'])[:40]!r})" if key else text


def _covariance(full: Sequence[Sequence[float]] | None, sigmas: Sequence[float]) -> Array:
    """Return the covariance, if given, or that of the sigmas; zeros mean 'unknown' to the decoders."""
    return np.array(full, dtype=float) if full else np.diag(np.square(sigmas))
