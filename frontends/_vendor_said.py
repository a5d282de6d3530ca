# SPDX-License-Identifier: Apache-2.0
"""What makers' messages say, as plain values, and what several makers have alike: sigmas, headings, GPS time."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from math import atan2, isfinite, radians
from typing import Any, NamedTuple, TypeVar

from graphloc.frontends._clock import NO_DATE_NS
from graphloc.frontends._rejections import Rejection, rejected
from graphloc.time import NS_PER_S


class SaidInertial(NamedTuple):
    """Specific force, m/s^2, and angular rate, rad/s, in the axes of the sensor."""

    accel_mps2: tuple[float, float, float]
    gyro_radps: tuple[float, float, float]


class SaidPlace(NamedTuple):
    """A fix: degrees and height above the ellipsoid, m (NaN: not measured); status as in `NavSatStatus`.

    horizontal_m, vertical_m: sigmas of each axis; 0: not told. filtered: whether a filter made it of several sensors, as of what follows.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    status: int
    horizontal_m: float = 0.0
    vertical_m: float = 0.0
    filtered: bool = False


class SaidVelocity(NamedTuple):
    """A velocity over ground, m/s, and sigmas, horizontal and vertical; 0: not told."""

    v_mps: tuple[float, float, float]
    horizontal_mps: float = 0.0
    vertical_mps: float = 0.0
    filtered: bool = False


class SaidHeading(NamedTuple):
    """A direction, rad, and its sigma; 0: not told."""

    angle_rad: float
    sigma_rad: float = 0.0
    filtered: bool = False


class SaidAlong(NamedTuple):
    """A velocity along the axes of the sensor, m/s, its covariance, row by row (0: not told), and through what: ground, water, or not told."""

    v_mps: tuple[float, float, float]
    covariance: tuple[float, ...]
    through: str = ""


Said = SaidInertial | SaidPlace | SaidVelocity | SaidHeading | SaidAlong
_OfAFilter = TypeVar("_OfAFilter", SaidPlace, SaidVelocity, SaidHeading)


class Part(NamedTuple):
    """One of the things that a type of message says.

    Attributes:
        kind: the kind of sensor that reads it. read: takes the message. told: whether its axes are known by the type; else `convention`
            tells them, and `usual` is that of a driver that is left as it comes. antennas: whether a heading is one of GNSS, not of a filter.
        through: whether each message says if its velocity is over ground or through the water.
    """

    kind: str
    read: Callable[[Any], Said | Rejection]
    told: bool = True
    antennas: bool = True
    usual: str = "ned"
    through: bool = False


_FEWEST_M, _MOST_M = 1e-4, 1e3  # sigmas of a fix that are believed; a receiver that knows its place no better has none
DO_NOT_USE = 1e9  # Septentrio's value for 'not told' is -2e10; in axes of ROS its driver turns it
_WEEK_NS = 7 * 86_400 * NS_PER_S
_GPS_EPOCH_NS = 315_964_800 * NS_PER_S  # 1980-01-06
# GPS time minus UTC, s, from a date on. None was announced after 2017.
_LEAPS = tuple(
    (int(datetime(year, month, 1, tzinfo=UTC).timestamp()) * NS_PER_S, leap_s)
    for year, month, leap_s in ((2017, 1, 18), (2015, 7, 17), (2012, 7, 16), (1980, 1, 15))
)


def gps_stamp_ns(tow_ms: int, log_ns: int) -> int:
    """Return the UTC of a GPS time of week, in the week that is nearest to the recording time; the latter where that has no date."""
    if log_ns < NO_DATE_NS:
        return log_ns
    leap_ns = next(leap_s for since_ns, leap_s in _LEAPS if log_ns >= since_ns) * NS_PER_S
    since_ns = tow_ms * 1_000_000 - leap_ns + _GPS_EPOCH_NS
    return since_ns + round((log_ns - since_ns) / _WEEK_NS) * _WEEK_NS


def week_stamp_ns(week: int, tow_ms: int, log_ns: int) -> int:
    """Return the UTC of a GPS week and time of week; of a week that is none, as before a receiver knows it, that by the recording time."""
    told_ns = _GPS_EPOCH_NS + week * _WEEK_NS + tow_ms * 1_000_000
    return gps_stamp_ns(tow_ms, told_ns if told_ns >= NO_DATE_NS else log_ns)


def xyz_of(v: Any) -> tuple[float, float, float]:
    return float(v.x), float(v.y), float(v.z)


def field_of(msg: Any, *names: str) -> Any:
    """Return the first of some fields that the message has: their names changed with the version of a driver."""
    for name in names:
        if hasattr(msg, name):
            return getattr(msg, name)
    raise AttributeError(f"it has no field {' or '.join(names)}: the message is of another version")


def sigma_of(sigma: float) -> float:
    """Return a sigma, 0 where it is none."""
    return sigma if isfinite(sigma) and sigma > 0.0 else 0.0


def place_of(
    place: tuple[float, float, float], status: int, horizontal_m: float, vertical_m: float
) -> SaidPlace | Rejection:
    """Return a fix whose sigmas may be unknown (0, NaN)."""
    if horizontal_m >= _MOST_M:
        return rejected(f"no fix by its accuracy ({horizontal_m:.0f} m)")
    horizontal, vertical = sigma_of(horizontal_m), sigma_of(vertical_m)
    known = horizontal >= _FEWEST_M
    # The height may be worse: of a receiver that holds it, a kilometre.
    return SaidPlace(*place, status, horizontal if known else 0.0, vertical if vertical >= _FEWEST_M else 0.0)


def as_filtered(said: _OfAFilter | Rejection, of_a_filter: bool = True) -> _OfAFilter | Rejection:
    return said if isinstance(said, Rejection) else said._replace(filtered=of_a_filter)


def yaw_of(q: Any) -> float:
    """Return the direction of the x axis of a quaternion, rad."""
    return atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def heading_by_bearing(angle_deg: float, sigma_deg: float) -> SaidHeading | Rejection:
    """Return a true heading, clockwise from north, as a yaw."""
    if not isfinite(angle_deg):
        return rejected("no heading (NaN)")
    return SaidHeading(radians(90.0 - angle_deg), radians(sigma_of(sigma_deg)))


def heading_as_told(angle_deg: float, sigma_deg: float) -> SaidHeading | Rejection:
    """Return a heading as it stands in a message whose axes the driver's configuration tells."""
    if not isfinite(angle_deg) or abs(angle_deg) > DO_NOT_USE:
        return rejected("no heading")
    return SaidHeading(radians(angle_deg % 360.0), radians(sigma_of(sigma_deg)))
