# SPDX-License-Identifier: Apache-2.0
"""What messages say, as plain values, and what several makers' messages share: sigmas, headings, GPS time."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from math import atan2, isfinite, radians
from typing import Any, NamedTuple, TypeVar

from numpy.typing import ArrayLike

from graphloc.frames import Array
from graphloc.frontends._clock import NO_DATE_NS
from graphloc.frontends._rejections import Rejection, rejected
from graphloc.time import NS_PER_S


class SaidInertial(NamedTuple):
    """Specific force, m/s^2, and angular rate, rad/s, in the axes of the sensor."""

    accel_mps2: tuple[float, float, float]
    gyro_radps: tuple[float, float, float]


class SaidPlace(NamedTuple):
    """A fix.

    Attributes:
        latitude_deg, longitude_deg, height_m: position, height above the ellipsoid, NaN if not measured.
        status: as in `NavSatStatus`. horizontal_m, vertical_m: sigma of an axis; 0 if not told.
        filtered: whether a filter made it from several sensors.
        covariance: (3, 3), m^2, east, north, up, zeros if not told; None: the sigmas tell it.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    status: int
    horizontal_m: float = 0.0
    vertical_m: float = 0.0
    filtered: bool = False
    covariance: Array | None = None


class SaidVelocity(NamedTuple):
    """A velocity over ground, horizontal where its up is NaN; and its uncertainty, as of `SaidPlace`."""

    v_mps: tuple[float, float, float]
    horizontal_mps: float = 0.0
    vertical_mps: float = 0.0
    filtered: bool = False
    covariance: Array | None = None


class SaidHeading(NamedTuple):
    """A heading or yaw, its sigma (0 if not told), and whether a filter made it."""

    angle_rad: float
    sigma_rad: float = 0.0
    filtered: bool = False


class SaidAlong(NamedTuple):
    """A velocity along the axes of the sensor.

    Attributes:
        v_mps, covariance: velocity along x, or x and y, or all; its covariance, row by row, zeros if not told.
        through: 'ground' or 'water'; '' if not told.
    """

    v_mps: tuple[float, ...]
    covariance: ArrayLike
    through: str = ""


class SaidPose(NamedTuple):
    """A position (3,), a rotation (3, 3), None if not told, and the covariance of both (6, 6), translation first."""

    position_m: Array
    rotation: Array | None
    covariance: Array


Said = SaidInertial | SaidPlace | SaidVelocity | SaidHeading | SaidAlong
_OfAFilter = TypeVar("_OfAFilter", SaidPlace, SaidVelocity, SaidHeading)


class Part(NamedTuple):
    """One of the things that a type of message says.

    Attributes:
        kind: kind of sensor that reads it. read: returns it from a message, or why there is none.
        told: whether the type fixes its axes; else `convention` of the sensor tells them.
        antennas: whether a heading is by two GNSS antennas, not by a filter.
        usual: convention of the driver by default. through: whether each message says if its velocity is over ground or
            through the water.
    """

    kind: str
    read: Callable[[Any], Said | Rejection]
    told: bool = True
    antennas: bool = True
    usual: str = "ned"
    through: bool = False


_FEWEST_M, _MOST_M = 1e-4, 1e3  # a smaller sigma of a fix is unknown; with a larger one there is no fix
DO_NOT_USE = 1e9  # larger values mean 'not told': Septentrio has -2e10, whose sign its driver may turn
_WEEK_NS = 7 * 86_400 * NS_PER_S
_GPS_EPOCH_NS = 315_964_800 * NS_PER_S  # 1980-01-06
# From a date on, GPS time minus UTC, s. No leap second was announced after 2017.
_LEAPS = tuple(
    (int(datetime(year, month, 1, tzinfo=UTC).timestamp()) * NS_PER_S, leap_s)
    for year, month, leap_s in ((2017, 1, 18), (2015, 7, 17), (2012, 7, 16), (1980, 1, 15))
)


def gps_stamp_ns(tow_ms: int, log_ns: int) -> int:
    """Return the UTC of a GPS time of week, in the week that is nearest to the recording time.

    If the recording time has no date, the recording time itself.
    """
    if log_ns < NO_DATE_NS:
        return log_ns
    leap_ns = next(leap_s for since_ns, leap_s in _LEAPS if log_ns >= since_ns) * NS_PER_S
    since_ns = tow_ms * 1_000_000 - leap_ns + _GPS_EPOCH_NS
    return since_ns + round((log_ns - since_ns) / _WEEK_NS) * _WEEK_NS


def week_stamp_ns(week: int, tow_ms: int, log_ns: int) -> int:
    """Return the UTC of a GPS week and time of week.

    If the week is invalid, as before a receiver knows it, it is the one nearest to the recording time.
    """
    told_ns = _GPS_EPOCH_NS + week * _WEEK_NS + tow_ms * 1_000_000
    return gps_stamp_ns(tow_ms, told_ns if told_ns >= NO_DATE_NS else log_ns)


def xyz_of(v: Any) -> tuple[float, float, float]:
    return float(v.x), float(v.y), float(v.z)


def field_of(msg: Any, *names: str) -> Any:
    """Return the first of several fields that a message has: names changed with versions of the driver."""
    for name in names:
        if hasattr(msg, name):
            return getattr(msg, name)
    raise AttributeError(f"it has no field {' or '.join(names)}: the message is of another version")


def sigma_of(sigma: float) -> float:
    """Return a sigma; 0 if it is not finite or not positive."""
    return sigma if isfinite(sigma) and sigma > 0.0 else 0.0


def place_of(
    place: tuple[float, float, float], status: int, horizontal_m: float, vertical_m: float
) -> SaidPlace | Rejection:
    """Return a fix whose sigmas may be unknown (0, NaN); a rejection if the horizontal one is as large as of no fix."""
    if horizontal_m >= _MOST_M:
        return rejected(f"no fix by its accuracy ({horizontal_m:.0f} m)")
    horizontal, vertical = sigma_of(horizontal_m), sigma_of(vertical_m)
    known = horizontal >= _FEWEST_M
    # The vertical sigma may be larger: a receiver that holds its height says a kilometre.
    return SaidPlace(*place, status, horizontal if known else 0.0, vertical if vertical >= _FEWEST_M else 0.0)


def as_filtered(said: _OfAFilter | Rejection, of_a_filter: bool = True) -> _OfAFilter | Rejection:
    return said if isinstance(said, Rejection) else said._replace(filtered=of_a_filter)


def yaw_of(q: Any) -> float:
    """Return the direction of the x axis of a quaternion, rad."""
    return atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def heading_by_bearing(angle_deg: float, sigma_deg: float) -> SaidHeading | Rejection:
    """Return a true heading, clockwise from north, as a yaw from east, counter-clockwise."""
    if not isfinite(angle_deg):
        return rejected("no heading (NaN)")
    return SaidHeading(radians(90.0 - angle_deg), radians(sigma_of(sigma_deg)))


def heading_as_told(angle_deg: float, sigma_deg: float) -> SaidHeading | Rejection:
    """Return a heading as a message says it whose axes depend on the driver's configuration."""
    if not isfinite(angle_deg) or abs(angle_deg) > DO_NOT_USE:
        return rejected("no heading")
    return SaidHeading(radians(angle_deg % 360.0), radians(sigma_of(sigma_deg)))
