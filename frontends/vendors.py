# SPDX-License-Identifier: Apache-2.0
"""Messages of makers' own ROS packages: what each says, as pure functions to plain values, in one table.

A message says one thing or several: a receiver's says a place and a velocity. Velocities and headings of most types are in known axes and
come out as east, north, up; a few drivers write them in north, east, down or in east, north, up, as they are configured: these come out as
they are, and `convention` of the sensor tells. Axes of an IMU or a Doppler log stay its own.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from math import atan2, cos, degrees, isfinite, pi, radians, sin
from typing import Any, NamedTuple, TypeVar

from graphloc.frontends._clock import NO_DATE_NS
from graphloc.frontends._rejections import Rejection, malformed, rejected
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
_DO_NOT_USE = 1e9  # Septentrio's value for 'not told' is -2e10; in axes of ROS its driver turns it
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


def _week_stamp_ns(week: int, tow_ms: int, log_ns: int) -> int:
    """Return the UTC of a GPS week and time of week; of a week that is none, as before a receiver knows it, that by the recording time."""
    told_ns = _GPS_EPOCH_NS + week * _WEEK_NS + tow_ms * 1_000_000
    return gps_stamp_ns(tow_ms, told_ns if told_ns >= NO_DATE_NS else log_ns)


def _xyz(v: Any) -> tuple[float, float, float]:
    return float(v.x), float(v.y), float(v.z)


def _any(msg: Any, *names: str) -> Any:
    """Return the first of some fields that the message has: their names changed with the version of a driver."""
    for name in names:
        if hasattr(msg, name):
            return getattr(msg, name)
    raise AttributeError(f"it has no field {' or '.join(names)}: the message is of another version")


def _known(sigma: float) -> float:
    """Return a sigma, 0 where it is none."""
    return sigma if isfinite(sigma) and sigma > 0.0 else 0.0


def _place(
    place: tuple[float, float, float], status: int, horizontal_m: float, vertical_m: float
) -> SaidPlace | Rejection:
    """Return a fix whose sigmas may be unknown (0, NaN)."""
    if horizontal_m >= _MOST_M:
        return rejected(f"no fix by its accuracy ({horizontal_m:.0f} m)")
    horizontal, vertical = _known(horizontal_m), _known(vertical_m)
    known = horizontal >= _FEWEST_M
    # The height may be worse: of a receiver that holds it, a kilometre.
    return SaidPlace(*place, status, horizontal if known else 0.0, vertical if vertical >= _FEWEST_M else 0.0)


def _filtered(said: _OfAFilter | Rejection, of_a_filter: bool = True) -> _OfAFilter | Rejection:
    return said if isinstance(said, Rejection) else said._replace(filtered=of_a_filter)


def _yaw(q: Any) -> float:
    """Return the direction of the x axis of a quaternion, rad."""
    return atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def _bearing(angle_deg: float, sigma_deg: float) -> SaidHeading | Rejection:
    """Return a true heading, clockwise from north, as a yaw."""
    if not isfinite(angle_deg):
        return rejected("no heading (NaN)")
    return SaidHeading(radians(90.0 - angle_deg), radians(_known(sigma_deg)))


def _angle(angle_deg: float, sigma_deg: float) -> SaidHeading | Rejection:
    """Return a heading as it stands in a message whose axes the driver's configuration tells."""
    if not isfinite(angle_deg) or abs(angle_deg) > _DO_NOT_USE:
        return rejected("no heading")
    return SaidHeading(radians(angle_deg % 360.0), radians(_known(sigma_deg)))


# SBG Systems: Ellipse, Ekinox, Apogee. With `use_enu` its driver writes east, north, up and counter-clockwise from east.

# Of NavSatStatus, by type of solution; PPP converges slowly.
_SBG_STATUS = {1: 0, 2: 0, 3: 1, 4: 1, 5: 1, 6: 2, 7: 2, 8: 1, 9: 1}
_SBG_NONE = {0: "none", 10: "a position that was set, not measured"}
_SBG_CRITICAL, _SBG_SPOOFED = 4, 4
_SBG_PER_MPS2, _SBG_PER_RADPS = 1_048_576.0, (67_108_864.0, 12_304_174.0)  # counts, in either range of the gyroscope
_SBG_COMPUTED = 0x3F  # bits of a status that are 0 of a computed solution


def _sbg_imu_trouble(msg: Any) -> Rejection | None:
    failed = [name for name in ("imu_com", "imu_status") if not getattr(msg.imu_status, name)]
    return rejected(f"the IMU says that it does not work ({', '.join(failed)} false)") if failed else None


def _sbg_imu(msg: Any) -> SaidInertial | Rejection:
    return _sbg_imu_trouble(msg) or SaidInertial(_xyz(msg.accel), _xyz(msg.gyro))


def _sbg_imu_short(msg: Any) -> SaidInertial | Rejection:
    if trouble := _sbg_imu_trouble(msg):
        return trouble
    (ax, ay, az), (wx, wy, wz) = _xyz(msg.delta_velocity), _xyz(msg.delta_angle)
    a, w = _SBG_PER_MPS2, _SBG_PER_RADPS[bool(getattr(msg.imu_status, "imu_gyros_use_high_scale", False))]
    return SaidInertial((ax / a, ay / a, az / a), (wx / w, wy / w, wz / w))


def _sbg_where(msg: Any) -> tuple[float, float, float]:
    """Latitude, longitude, deg, and height above the ellipsoid, m."""
    if hasattr(msg, "latitude"):
        place = float(msg.latitude), float(msg.longitude), float(msg.altitude)
    else:  # until 2021, a vector; a version in between wrote longitude first where set to ENU, which nothing tells
        place = _xyz(msg.position)
    return (*place[:2], place[2] + float(msg.undulation))


def _sbg_place(msg: Any) -> SaidPlace | Rejection:
    status, solution = int(msg.status.status), int(msg.status.type)
    if status != 0 or solution not in _SBG_STATUS:
        return rejected(f"no fix (status {status}, type {_SBG_NONE.get(solution, solution)})")
    if int(getattr(msg.status, "ifm", 0)) == _SBG_CRITICAL:
        return rejected("the receiver says that its position is jammed")
    if int(getattr(msg.status, "spoofing", 0)) == _SBG_SPOOFED:
        return rejected("the receiver says that its position is spoofed")
    x, y, z = _xyz(msg.position_accuracy)
    return _place(_sbg_where(msg), _SBG_STATUS[solution], max(x, y), z)


def _sbg_velocity(msg: Any) -> SaidVelocity | Rejection:
    status, solution = int(msg.status.vel_status), int(msg.status.vel_type)
    if status != 0 or solution == 0:
        return rejected(f"no velocity (status {status}, type {solution})")
    x, y, z = _xyz(_any(msg, "velocity_accuracy", "vel_acc"))
    return SaidVelocity(_xyz(_any(msg, "velocity", "vel")), _known(max(x, y)), _known(z))


def _sbg_heading(msg: Any) -> SaidHeading | Rejection:
    if status := int(msg.status) & _SBG_COMPUTED:
        return rejected(f"no heading (status {status})")
    return _angle(float(msg.true_heading), float(msg.true_heading_acc))


def _sbg_filtered_place(msg: Any) -> SaidPlace | Rejection:
    if not msg.status.position_valid:
        return rejected("the filter says that its position is not valid")
    x, y, z = _xyz(msg.position_accuracy)
    return _filtered(_place(_sbg_where(msg), 0, max(x, y), z))


def _sbg_filtered_velocity(msg: Any) -> SaidVelocity | Rejection:
    if not msg.status.velocity_valid:
        return rejected("the filter says that its velocity is not valid")
    x, y, z = _xyz(msg.velocity_accuracy)
    return SaidVelocity(_xyz(msg.velocity), _known(max(x, y)), _known(z), filtered=True)


def _sbg_filtered_heading(msg: Any) -> SaidHeading | Rejection:
    if not msg.status.heading_valid:
        return rejected("the filter says that its heading is not valid")
    if hasattr(msg, "quaternion"):
        yaw = _yaw(msg.quaternion)
    else:
        yaw = float(msg.angle.z)
    return _filtered(_angle(degrees(yaw), degrees(float(msg.accuracy.z))))


# u-blox: `ublox_msgs` with the manual's names of fields in ROS 1, in lower case in ROS 2, `ublox_ubx_msgs` with flags of their own, and
# `gnss_comm`, in units of ROS.

_UBX_FIX_OK, _UBX_DIFFERENTIAL = 1, 2
_UBX_TIME_VALID = 3
_UBX_2D, _UBX_FIXES = 2, (2, 3, 4)
_UBX_VALID, _UBX_MOVING, _UBX_HEADING = 0x05, 0x20, 0x100  # of a relative position; that its base moves; of its heading
_UBX_FIXED = 2  # ambiguities; 1: float


def _ubx_fix(msg: Any) -> tuple[int, bool]:
    """Type of fix, and whether it is good enough."""
    if hasattr(msg, "gps_fix"):
        return int(msg.gps_fix.fix_type), bool(msg.gnss_fix_ok) and not msg.invalid_llh
    if hasattr(msg, "valid_fix"):
        return int(msg.fix_type), bool(msg.valid_fix)
    return int(_any(msg, "fix_type", "fixType")), bool(msg.flags & _UBX_FIX_OK)


def _ubx_status(msg: Any) -> int:
    if hasattr(msg, "carr_soln"):
        return 2 if getattr(msg.carr_soln, "status", msg.carr_soln) else int(msg.diff_soln)
    return 2 if msg.flags >> 6 & 3 else int(bool(msg.flags & _UBX_DIFFERENTIAL))


def _ubx_trouble(msg: Any) -> Rejection | None:
    fix, good = _ubx_fix(msg)
    return None if good and fix in _UBX_FIXES else rejected(f"no fix (fix type {fix}, gnssFixOK {int(good)})")


def _ubx_place(msg: Any) -> SaidPlace | Rejection:
    if trouble := _ubx_trouble(msg):
        return trouble
    place = 1e-7 * msg.lat, 1e-7 * msg.lon, float("nan") if _ubx_fix(msg)[0] == _UBX_2D else 1e-3 * msg.height
    return _place(place, _ubx_status(msg), 1e-3 * _any(msg, "h_acc", "hAcc"), 1e-3 * _any(msg, "v_acc", "vAcc"))


def _ubx_velocity(msg: Any) -> SaidVelocity | Rejection:
    if trouble := _ubx_trouble(msg):
        return trouble
    north, east, down = (
        1e-3 * _any(msg, *names) for names in (("vel_n", "velN"), ("vel_e", "velE"), ("vel_d", "velD"))
    )
    sigma = 1e-3 * _any(msg, "s_acc", "sAcc")
    return SaidVelocity((east, north, -down), _known(sigma), _known(sigma))


def _pvt_place(msg: Any) -> SaidPlace | Rejection:
    if trouble := _ubx_trouble(msg):
        return trouble
    height = float("nan") if _ubx_fix(msg)[0] == _UBX_2D else float(msg.altitude)
    place = float(msg.latitude), float(msg.longitude), height
    return _place(place, _ubx_status(msg), float(msg.h_acc), float(msg.v_acc))


def _pvt_velocity(msg: Any) -> SaidVelocity | Rejection:
    if trouble := _ubx_trouble(msg):
        return trouble
    sigma = _known(float(msg.vel_acc))
    return SaidVelocity((float(msg.vel_e), float(msg.vel_n), -float(msg.vel_d)), sigma, sigma)


def _ubx_heading(msg: Any) -> SaidHeading | Rejection:
    if hasattr(msg, "is_moving"):
        moving, solution = bool(msg.is_moving), int(msg.carr_soln.status)
        valid = bool(msg.gnss_fix_ok and msg.rel_pos_valid and msg.rel_pos_heading_valid)
    else:
        moving, solution = bool(msg.flags & _UBX_MOVING), msg.flags >> 3 & 3
        valid = msg.flags & _UBX_VALID == _UBX_VALID and bool(msg.flags & _UBX_HEADING)
    if not moving:
        return rejected("the base does not move: the direction to it is no heading")
    if not valid:
        return rejected("no heading (relPosHeadingValid 0)")
    if solution != _UBX_FIXED:
        return rejected("a heading with float ambiguities")
    angle, sigma = _any(msg, "rel_pos_heading", "relPosHeading"), _any(msg, "acc_heading", "accHeading")
    return _bearing(1e-5 * angle, 1e-5 * sigma)


def _ubx_stamp_ns(msg: Any, log_ns: int) -> int:
    known = int(getattr(msg, "valid", _UBX_TIME_VALID)) & _UBX_TIME_VALID == _UBX_TIME_VALID
    return gps_stamp_ns(int(_any(msg, "i_tow", "iTOW")), log_ns) if known else log_ns


def _pvt_stamp_ns(msg: Any, log_ns: int) -> int:
    return _week_stamp_ns(int(msg.time.week), round(1000.0 * float(msg.time.tow)), log_ns)


# NovAtel: `novatel_oem7_msgs`, whose statuses are messages of their own; `novatel_msgs`, where they are numbers, without a stamp of ROS;
# `novatel_gps_msgs`, where they are the manual's words.

_OEM7_STATUS: dict[int | str, int] = {
    **dict.fromkeys((16, 53, 70, 71, 72), 0), **dict.fromkeys((17, 18, 52, 54), 1),
    **dict.fromkeys((68, 69, 73, 74, 77, 78, 79, 80), 1),  # PPP
    **dict.fromkeys((32, 34, 48, 49, 50, 51, 55, 56), 2),
}  # fmt: skip
_OEM7_NONE: dict[int | str, str] = {
    0: "none",
    1: "a position that was set, not measured",
    19: "propagated without observations",
}
_OEM7_FIXED = (48, 49, 50)
_OEM7_INS = (51, 52, 53, 54, 55, 56, 73, 74, 79, 80)  # of a filter; of BESTPOS and BESTVEL too, where that is the best
_INS_SETTLED, _INS_LEAST = (3, 6, 7), 53
_OEM7_WHERE = (("lat", "latitude"), ("lon", "longitude"), ("hgt", "height", "altitude"))
_OEM7_WORDS = {
    "SOL_COMPUTED": 0, "INS_SOLUTION_GOOD": 3, "INS_SOLUTION_FREE": 6, "INS_ALIGNMENT_COMPLETE": 7,
    "NONE": 0, "FIXEDPOS": 1, "DOPPLER_VELOCITY": 8, "SINGLE": 16, "PSRDIFF": 17, "WAAS": 18, "PROPAGATED": 19, "PROPOGATED": 19,
    "L1_FLOAT": 32, "NARROW_FLOAT": 34, "L1_INT": 48, "WIDE_INT": 49, "NARROW_INT": 50, "RTK_DIRECT_INS": 51, "INS_SBAS": 52,
    "INS_PSRSP": 53, "INS_PSRDIFF": 54, "INS_RTKFLOAT": 55, "INS_RTKFIXED": 56, "PPP_CONVERGING": 68, "PPP": 69, "OPERATIONAL": 70,
    "WARNING": 71, "OUT_OF_BOUNDS": 72, "INS_PPP_CONVERGING": 73, "INS_PPP": 74, "PPP_BASIC_CONVERGING": 77, "PPP_BASIC": 78,
    "INS_PPP_BASIC_CONVERGING": 79, "INS_PPP_BASIC": 80,
}  # fmt: skip


def _oem7_code(msg: Any, *names: str) -> int | str:
    """Return a status or a type of solution as the manual numbers it; a word that is none of those above as it stands."""
    value = _any(msg, *names)
    value = getattr(value, "status", getattr(value, "type", value))
    if isinstance(value, str):
        return _OEM7_WORDS.get(value, value)
    if not isinstance(value, int):
        raise TypeError(f"its {' or '.join(names)} is no number: the message is of another version")
    return value


def _oem7_type(msg: Any) -> int | str:
    return _oem7_code(msg, "pos_type", "vel_type", "position_type", "velocity_type")


def _oem7_trouble(msg: Any, solution: int | str, known: bool) -> Rejection | None:
    status = _oem7_code(msg, "sol_status", "solution_status")
    if status == 0 and known:
        return None
    return rejected(f"no solution (status {status}, type {_OEM7_NONE.get(solution, solution)})")


def _oem7_place(msg: Any) -> SaidPlace | Rejection:
    solution = _oem7_type(msg)
    if trouble := _oem7_trouble(msg, solution, solution in _OEM7_STATUS):
        return trouble
    return _filtered(_oem7_where(msg, solution), solution in _OEM7_INS)


def _oem7_where(msg: Any, solution: int | str) -> SaidPlace | Rejection:
    # Heights of INSPVA are above the ellipsoid, and it has no undulation; all others are above the sea.
    lat, lon, height = (float(_any(msg, *names)) for names in _OEM7_WHERE)
    north, east, up = (_oem7_sigma(msg, *names) for names in _OEM7_WHERE)
    place = lat, lon, height + float(getattr(msg, "undulation", 0.0))
    return _place(place, _OEM7_STATUS[solution], max(north, east), up)


def _oem7_sigma(msg: Any, *names: str) -> float:
    """Return the sigma of a field; 0 where the message has none, as INSPVA."""
    ends = [f"{name}_{end}" for name in names for end in ("stdev", "sigma", "std")]
    return next((float(getattr(msg, name)) for name in ends if hasattr(msg, name)), 0.0)


def _oem7_velocity(msg: Any) -> SaidVelocity | Rejection:
    solution = _oem7_type(msg)
    if trouble := _oem7_trouble(msg, solution, solution not in _OEM7_NONE):
        return trouble
    speed = float(_any(msg, "hor_speed", "hor_spd", "horizontal_speed"))
    track = radians(float(_any(msg, "trk_gnd", "track_ground")))
    up = float(_any(msg, "ver_speed", "vert_spd", "vertical_speed"))
    return SaidVelocity((speed * sin(track), speed * cos(track), up), filtered=solution in _OEM7_INS)


def _oem7_heading(msg: Any) -> SaidHeading | Rejection:
    solution = _oem7_type(msg)
    if trouble := _oem7_trouble(msg, solution, solution not in _OEM7_NONE):
        return trouble
    if solution not in _OEM7_FIXED:
        return rejected(f"a heading with float ambiguities (type {solution})")
    return _bearing(float(msg.heading), _oem7_sigma(msg, "heading"))


def _ins_type(msg: Any) -> int | str:
    """Return the type of solution of an INSPVAX; of an INSPVA, which tells none, the least."""
    return _oem7_type(msg) if hasattr(msg, "pos_type") or hasattr(msg, "position_type") else _INS_LEAST


def _ins_trouble(msg: Any) -> Rejection | None:
    """Return why an INSPVAX, or an INSPVA, which holds less, is no solution."""
    settled, solution = _oem7_code(msg, "ins_status", "status", "insstatus"), _ins_type(msg)
    if settled in _INS_SETTLED and solution in _OEM7_STATUS:
        return None
    return rejected(f"no solution (ins_status {settled}, type {_OEM7_NONE.get(solution, solution)})")


def _ins_place(msg: Any) -> SaidPlace | Rejection:
    return _filtered(_ins_trouble(msg) or _oem7_where(msg, _ins_type(msg)))


def _ins_velocity(msg: Any) -> SaidVelocity | Rejection:
    if trouble := _ins_trouble(msg):
        return trouble
    north, east, up = (_known(_oem7_sigma(msg, f"{way}_velocity")) for way in ("north", "east", "up"))
    # INSPVA of `novatel_msgs` numbers them, in the order of the receiver's log.
    v_east, v_north, v_up = (
        float(_any(msg, *names))
        for names in (("east_velocity", "vely"), ("north_velocity", "velx"), ("up_velocity", "velz"))
    )
    return SaidVelocity((v_east, v_north, v_up), max(north, east), up, filtered=True)


def _ins_heading(msg: Any) -> SaidHeading | Rejection:
    if trouble := _ins_trouble(msg):
        return trouble
    return _filtered(_bearing(float(msg.azimuth), _oem7_sigma(msg, "azimuth")))


def _oem7_stamp_ns(msg: Any, log_ns: int) -> int | None:
    """Return the header's stamp, or in `novatel_msgs` its GPS time, less the age of a velocity."""
    header = msg.header
    if hasattr(header, "stamp"):
        stamp_ns = int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)
    else:  # milliseconds, for all their names
        tow_ms = _any(header, "gps_week_seconds", "gps_week_milliseconds", "gpssec")
        stamp_ns = _week_stamp_ns(int(_any(header, "gps_week", "week")), int(tow_ms), log_ns)
    age_s = float(getattr(msg, "latency", 0.0))
    stamp_ns -= round((age_s if 0.0 < age_s < 1.0 else 0.0) * NS_PER_S)
    return stamp_ns if stamp_ns > 0 else None


# Septentrio.

_SBF_STATUS = {1: 0, 2: 1, 4: 2, 5: 2, 6: 1, 7: 0, 8: 0, 10: 1}  # of a moving base the place is as good as the base's
_SBF_NONE = {0: "none", 3: "a position that was set, not measured"}
_SBF_MODE, _SBF_2D, _SBF_UNKNOWN = 0x0F, 0x80, 65535
_SBF_FIXED = (2, 4)
_SBF_BASELINE = 3  # bits of an attitude's error: of the first baseline


def _sbf_trouble(msg: Any) -> Rejection | None:
    return _sbf_without("no fix", int(msg.mode), int(msg.error))


def _sbf_without(what: str, mode: int, error: int) -> Rejection | None:
    mode &= _SBF_MODE
    if error == 0 and mode in _SBF_STATUS:
        return None
    return rejected(f"{what} (error {error}, mode {_SBF_NONE.get(mode, mode)})")


def _sbf_place(msg: Any) -> SaidPlace | Rejection:
    if trouble := _sbf_trouble(msg):
        return trouble
    height = float("nan") if int(msg.mode) & _SBF_2D else float(msg.height)
    # Twice the RMS of the horizontal distance, and two sigmas of the height, in cm.
    horizontal, vertical = (
        0.0 if int(cm) == _SBF_UNKNOWN else 0.005 * float(cm) for cm in (msg.h_accuracy, msg.v_accuracy)
    )
    place = degrees(float(msg.latitude)), degrees(float(msg.longitude)), height
    return _place(place, _SBF_STATUS[int(msg.mode) & _SBF_MODE], horizontal / 2.0**0.5, vertical)


def _sbf_velocity(msg: Any) -> SaidVelocity | Rejection:
    said = _sbf_trouble(msg) or _sbf_up(msg)
    return said if isinstance(said, Rejection) else SaidVelocity(said)


def _sbf_up(msg: Any) -> tuple[float, float, float] | Rejection:
    """Return a velocity east, north, up, m/s."""
    v = float(msg.ve), float(msg.vn), float(msg.vu)
    return rejected("no velocity") if max(map(abs, v)) > _DO_NOT_USE else v


def _sbf_heading(msg: Any) -> SaidHeading | Rejection:
    mode, error = int(msg.mode), int(msg.error) & _SBF_BASELINE
    if mode == 0 or error:
        return rejected(f"no heading (error {error}, mode {mode})")
    if mode not in _SBF_FIXED:
        return rejected("a heading with float ambiguities")
    return _angle(float(msg.heading), 0.0)


def _sbf_ins_trouble(msg: Any) -> Rejection | None:
    return _sbf_without("no GNSS in it", int(msg.gnss_mode), int(msg.error))


def _sbf_ins_place(msg: Any) -> SaidPlace | Rejection:
    if trouble := _sbf_ins_trouble(msg):
        return trouble
    place = degrees(float(msg.latitude)), degrees(float(msg.longitude)), float(msg.height)
    horizontal = max(float(msg.latitude_std_dev), float(msg.longitude_std_dev))
    return _filtered(_place(place, _SBF_STATUS[int(msg.gnss_mode) & _SBF_MODE], horizontal, float(msg.height_std_dev)))


def _sbf_ins_velocity(msg: Any) -> SaidVelocity | Rejection:
    said = _sbf_ins_trouble(msg) or _sbf_up(msg)
    if isinstance(said, Rejection):
        return said
    sigmas = _known(max(float(msg.ve_std_dev), float(msg.vn_std_dev))), _known(float(msg.vu_std_dev))
    return SaidVelocity(said, *sigmas, filtered=True)


def _sbf_ins_heading(msg: Any) -> SaidHeading | Rejection:
    return _filtered(_sbf_ins_trouble(msg) or _angle(float(msg.heading), float(msg.heading_std_dev)))


# The complex urban data set of KAIST: what its player makes of GGA and GST. Older messages have a dilution for the sigmas.

_VRS_STATUS = {1: 0, 2: 1, 3: 0, 4: 2, 5: 2, 9: 1}  # of NavSatStatus, by quality of GGA


def _vrs_place(msg: Any) -> SaidPlace | Rejection:
    quality = int(msg.fix_state)
    if quality not in _VRS_STATUS:
        return rejected(f"no fix (fix_state {quality})")
    north, east, up = (float(getattr(msg, f"{name}_std", 0.0)) for name in ("lat", "lon", "altitude"))
    place = float(msg.latitude), float(msg.longitude), float(msg.altitude)
    return _place(place, _VRS_STATUS[quality], max(north, east), up)


# PX4: microseconds since boot, or of the computer's clock where its agent synchronises them.

_PX4_STATUS = {2: 0, 3: 0, 4: 1, 5: 2, 6: 2}
_PX4_2D, _PX4_NO_ACCEL = 2, 0x7FFFFFFF
_LATEST_US = 4 * 10**15  # year 2096: nanoseconds in 64 bits


def _px4_imu(msg: Any) -> SaidInertial | Rejection:
    if int(msg.accelerometer_timestamp_relative) == _PX4_NO_ACCEL:
        return malformed("the autopilot says that the acceleration is absent")
    (ax, ay, az), (wx, wy, wz) = msg.accelerometer_m_s2, msg.gyro_rad
    return SaidInertial((float(ax), float(ay), float(az)), (float(wx), float(wy), float(wz)))


def _px4_place(msg: Any) -> SaidPlace | Rejection:
    fix = int(msg.fix_type)
    if fix not in _PX4_STATUS:
        return rejected(f"no fix (fix type {fix})")
    if hasattr(msg, "latitude_deg"):
        place = float(msg.latitude_deg), float(msg.longitude_deg), float(msg.altitude_ellipsoid_m)
    else:
        place = 1e-7 * msg.lat, 1e-7 * msg.lon, 1e-3 * msg.alt_ellipsoid
    if fix == _PX4_2D:
        place = (*place[:2], float("nan"))
    return _place(place, _PX4_STATUS[fix], float(msg.eph), float(msg.epv))


def _px4_velocity(msg: Any) -> SaidVelocity | Rejection:
    if int(msg.fix_type) not in _PX4_STATUS or not msg.vel_ned_valid:
        return rejected("no velocity (vel_ned_valid false, or no fix)")
    sigma = _known(float(msg.s_variance_m_s))  # a sigma, for all its name
    return SaidVelocity((float(msg.vel_e_m_s), float(msg.vel_n_m_s), -float(msg.vel_d_m_s)), sigma, sigma)


def _px4_heading(msg: Any) -> SaidHeading | Rejection:
    sigma = float(getattr(msg, "heading_accuracy", 0.0))
    return _bearing(degrees(float(msg.heading)), degrees(sigma) if sigma < pi else 0.0)


def _px4_stamp_ns(msg: Any, _log_ns: int) -> int | None:
    at_us, sampled_us = int(msg.timestamp), int(getattr(msg, "timestamp_sample", 0))
    if 0 <= at_us - sampled_us < 1_000_000:
        at_us = sampled_us
    return 1000 * at_us if 0 < at_us < _LATEST_US else None


# Doppler logs: x ahead, y to starboard, z down, where they point.

_DVL_THROUGH = {1: "ground", 2: "water"}
_DVL_BEAMS = 3  # that a velocity takes


def _waterlinked_along(msg: Any) -> SaidAlong | Rejection:
    if not msg.velocity_valid:
        return rejected("no velocity (velocity_valid false: no lock on the bottom)")
    covariance = tuple(float(v) for v in getattr(msg, "covariance", ()))  # of newer versions
    if len(covariance) != 9:
        fom = _known(float(msg.fom)) ** 2  # the figure of merit is a sigma
        covariance = (fom, 0.0, 0.0, 0.0, fom, 0.0, 0.0, 0.0, fom)
    return SaidAlong(_xyz(msg.velocity), covariance)


def _dvl_along(msg: Any) -> SaidAlong | Rejection:
    v, beams = _xyz(msg.velocity), int(msg.num_good_beams)
    # Drivers of instruments that tell a velocity alone fill in neither beams nor flags.
    if 0 < beams < _DVL_BEAMS or not (msg.beam_velocities_valid or any(v)):
        return rejected(f"no velocity ({beams} good beams)")
    return SaidAlong(v, tuple(float(c) for c in msg.velocity_covar), _DVL_THROUGH.get(int(msg.velocity_mode), ""))


# geographic_msgs: poses are what a filter says, points are not told. Axes are east, north, up, heights above the ellipsoid.


def _geo_point(msg: Any) -> SaidPlace | Rejection:
    p = msg.position
    return SaidPlace(float(p.latitude), float(p.longitude), float(p.altitude), 0)


def _geo_covariance(msg: Any) -> tuple[Any, tuple[float, float, float]]:
    """Return the pose, and variances, horizontal, vertical and of the yaw; 0: not told."""
    if not hasattr(msg.pose, "covariance"):
        return msg.pose, (0.0, 0.0, 0.0)
    if len(msg.pose.covariance) != 36:
        raise ValueError(f"a covariance of {len(msg.pose.covariance)} values")
    one, other, up, _, _, yaw = (float(c) for c in msg.pose.covariance[::7])  # north or east first, as drivers like
    return msg.pose.pose, (max(one, other), up, yaw)


def _geo_place(msg: Any) -> SaidPlace | Rejection:
    pose, variances = _geo_covariance(msg)
    p = pose.position
    place = float(p.latitude), float(p.longitude), float(p.altitude)
    return _filtered(_place(place, 0, *(_known(v) ** 0.5 for v in variances[:2])))


def _geo_heading(msg: Any) -> SaidHeading | Rejection:
    pose, variances = _geo_covariance(msg)
    q = pose.orientation
    x, y, z, w = (float(v) for v in (q.x, q.y, q.z, q.w))
    if x == y == z == 0.0:
        return rejected("no orientation: zero, or as drivers leave it that know none")
    if not abs(x * x + y * y + z * z + w * w - 1.0) < 0.1:
        return malformed("orientation is NaN or no unit quaternion")
    return SaidHeading(_yaw(q), _known(variances[2]) ** 0.5, filtered=True)


GEOGRAPHIC = tuple(f"geographic_msgs/msg/{name}Stamped" for name in ("GeoPoint", "GeoPose", "GeoPoseWithCovariance"))
_GPS = (Part("gnss", _px4_place), Part("gnss_velocity", _px4_velocity), Part("compass", _px4_heading))
_NOVATEL = ("novatel_oem7_msgs", "novatel_msgs")
VENDORS: dict[str, tuple[Part, ...]] = {
    "sbg_driver/msg/SbgImuData": (Part("imu", _sbg_imu),),
    "sbg_driver/msg/SbgImuShort": (Part("imu", _sbg_imu_short),),
    "sbg_driver/msg/SbgGpsPos": (Part("gnss", _sbg_place),),
    "sbg_driver/msg/SbgGpsVel": (Part("gnss_velocity", _sbg_velocity, told=False),),
    "sbg_driver/msg/SbgGpsHdt": (Part("compass", _sbg_heading, told=False),),
    "sbg_driver/msg/SbgEkfNav": (
        Part("gnss", _sbg_filtered_place), Part("gnss_velocity", _sbg_filtered_velocity, told=False),
    ),
    **dict.fromkeys(
        ("sbg_driver/msg/SbgEkfEuler", "sbg_driver/msg/SbgEkfQuat"),
        (Part("compass", _sbg_filtered_heading, told=False, antennas=False),),
    ),
    **dict.fromkeys(
        ("ublox_msgs/msg/NavPVT", "ublox_msgs/msg/NavPVT7", "ublox_ubx_msgs/msg/UBXNavPVT"), (Part("gnss", _ubx_place), Part("gnss_velocity", _ubx_velocity)),
    ),
    **dict.fromkeys(
        ("gnss_comm/msg/GnssPVTSolnMsg", "gnss_comm_msgs/msg/GnssPVTSolnMsg"), (Part("gnss", _pvt_place), Part("gnss_velocity", _pvt_velocity)),
    ),
    **dict.fromkeys(("ublox_msgs/msg/NavRELPOSNED9", "ublox_ubx_msgs/msg/UBXNavRelPosNED"), (Part("compass", _ubx_heading),)),
    **dict.fromkeys(
        (*(f"{package}/msg/{name}" for package in _NOVATEL for name in ("BESTPOS", "BESTGNSSPOS")), "novatel_gps_msgs/msg/NovatelPosition"),
        (Part("gnss", _oem7_place),),
    ),
    **dict.fromkeys(
        (*(f"{package}/msg/{name}" for package in _NOVATEL for name in ("BESTVEL", "BESTGNSSVEL")), "novatel_gps_msgs/msg/NovatelVelocity"),
        (Part("gnss_velocity", _oem7_velocity),),
    ),
    **dict.fromkeys(("novatel_oem7_msgs/msg/HEADING2", "novatel_gps_msgs/msg/NovatelHeading2"), (Part("compass", _oem7_heading),)),
    **dict.fromkeys(
        ("novatel_oem7_msgs/msg/INSPVAX", "novatel_oem7_msgs/msg/INSPVA", "novatel_msgs/msg/INSPVAX", "novatel_msgs/msg/INSPVA", "novatel_gps_msgs/msg/Inspvax", "novatel_gps_msgs/msg/Inspva"),
        (Part("gnss", _ins_place), Part("gnss_velocity", _ins_velocity), Part("compass", _ins_heading, antennas=False)),
    ),
    "irp_sen_msgs/msg/vrs": (Part("gnss", _vrs_place),),
    "septentrio_gnss_driver/msg/INSNavGeod": (
        Part("gnss", _sbf_ins_place), Part("gnss_velocity", _sbf_ins_velocity),
        Part("compass", _sbf_ins_heading, told=False, antennas=False, usual="enu"),
    ),
    "septentrio_gnss_driver/msg/PVTGeodetic": (Part("gnss", _sbf_place), Part("gnss_velocity", _sbf_velocity)),
    "septentrio_gnss_driver/msg/AttEuler": (Part("compass", _sbf_heading, told=False, usual="enu"),),
    "px4_msgs/msg/SensorCombined": (Part("imu", _px4_imu),),
    **dict.fromkeys(("px4_msgs/msg/SensorGps", "px4_msgs/msg/VehicleGpsPosition"), _GPS),
    GEOGRAPHIC[0]: (Part("gnss", _geo_point),),
    **dict.fromkeys(GEOGRAPHIC[1:], (Part("gnss", _geo_place), Part("compass", _geo_heading, antennas=False))),
    **dict.fromkeys(("dvl_msgs/msg/DVL", "waterlinked_a50_ros_driver/msg/DVL"), (Part("body_velocity", _waterlinked_along),)),
    **dict.fromkeys(("marine_acoustic_msgs/msg/Dvl", "acoustic_msgs/msg/Dvl"), (Part("body_velocity", _dvl_along, through=True),)),
}  # fmt: skip
"""By type of message: what it says, the first thing first."""

STAMPS: dict[str, Callable[[Any, int], int | None]] = {
    **dict.fromkeys([t for t in VENDORS if t.startswith("ublox_msgs/")], _ubx_stamp_ns),
    **dict.fromkeys([t for t in VENDORS if t.startswith("px4_msgs/")], _px4_stamp_ns),
    **dict.fromkeys([t for t in VENDORS if t.startswith("novatel_")], _oem7_stamp_ns),
    **dict.fromkeys([t for t in VENDORS if t.startswith("gnss_comm")], _pvt_stamp_ns),
}
"""Of types whose stamp is not that of a header: from message and recording time, ns."""
