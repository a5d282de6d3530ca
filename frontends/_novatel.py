# SPDX-License-Identifier: Apache-2.0
"""Messages of NovAtel.

`novatel_oem7_msgs`, whose statuses are messages of their own; `novatel_msgs`, where they are numbers, without a stamp
of ROS; `novatel_gps_msgs`, where they are the manual's words.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, radians, sin
from typing import Any

from graphloc.frontends._rejections import Rejection, rejected
from graphloc.frontends._said import (
    Part,
    SaidHeading,
    SaidPlace,
    SaidVelocity,
    as_filtered,
    field_of,
    heading_by_bearing,
    place_of,
    sigma_of,
    week_stamp_ns,
)
from graphloc.time import NS_PER_S

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
_OEM7_INS = (51, 52, 53, 54, 55, 56, 73, 74, 79, 80)  # of a filter; BESTPOS and BESTVEL may have them, too
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
    """Return a status or type of solution by its number in the manual; an unknown word is returned as it is."""
    value = field_of(msg, *names)
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
    return as_filtered(_oem7_where(msg, solution), solution in _OEM7_INS)


def _oem7_where(msg: Any, solution: int | str) -> SaidPlace | Rejection:
    # Heights of INSPVA are above the ellipsoid, without an undulation; all others are above sea level.
    lat, lon, height = (float(field_of(msg, *names)) for names in _OEM7_WHERE)
    north, east, up = (_oem7_sigma(msg, *names) for names in _OEM7_WHERE)
    place = lat, lon, height + float(getattr(msg, "undulation", 0.0))
    return place_of(place, _OEM7_STATUS[solution], max(north, east), up)


def _oem7_sigma(msg: Any, *names: str) -> float:
    """Return the sigma of a field; 0 if the message has none, as INSPVA."""
    ends = [f"{name}_{end}" for name in names for end in ("stdev", "sigma", "std")]
    return next((float(getattr(msg, name)) for name in ends if hasattr(msg, name)), 0.0)


def _oem7_velocity(msg: Any) -> SaidVelocity | Rejection:
    solution = _oem7_type(msg)
    if trouble := _oem7_trouble(msg, solution, solution not in _OEM7_NONE):
        return trouble
    speed = float(field_of(msg, "hor_speed", "hor_spd", "horizontal_speed"))
    track = radians(float(field_of(msg, "trk_gnd", "track_ground")))
    up = float(field_of(msg, "ver_speed", "vert_spd", "vertical_speed"))
    return SaidVelocity((speed * sin(track), speed * cos(track), up), filtered=solution in _OEM7_INS)


def _oem7_heading(msg: Any) -> SaidHeading | Rejection:
    solution = _oem7_type(msg)
    if trouble := _oem7_trouble(msg, solution, solution not in _OEM7_NONE):
        return trouble
    if solution not in _OEM7_FIXED:
        return rejected(f"a heading with float ambiguities (type {solution})")
    return heading_by_bearing(float(msg.heading), _oem7_sigma(msg, "heading"))


def _ins_type(msg: Any) -> int | str:
    """Return the type of solution of an INSPVAX; of an INSPVA, which tells none, the lowest one."""
    return _oem7_type(msg) if hasattr(msg, "pos_type") or hasattr(msg, "position_type") else _INS_LEAST


def _ins_trouble(msg: Any) -> Rejection | None:
    """Return why an INSPVAX, or an INSPVA, which tells less, has no solution."""
    settled, solution = _oem7_code(msg, "ins_status", "status", "insstatus"), _ins_type(msg)
    if settled in _INS_SETTLED and solution in _OEM7_STATUS:
        return None
    return rejected(f"no solution (ins_status {settled}, type {_OEM7_NONE.get(solution, solution)})")


def _ins_place(msg: Any) -> SaidPlace | Rejection:
    return as_filtered(_ins_trouble(msg) or _oem7_where(msg, _ins_type(msg)))


def _ins_velocity(msg: Any) -> SaidVelocity | Rejection:
    if trouble := _ins_trouble(msg):
        return trouble
    north, east, up = (sigma_of(_oem7_sigma(msg, f"{way}_velocity")) for way in ("north", "east", "up"))
    # INSPVA of `novatel_msgs` numbers them, in the order of the receiver's log.
    v_east, v_north, v_up = (
        float(field_of(msg, *names))
        for names in (("east_velocity", "vely"), ("north_velocity", "velx"), ("up_velocity", "velz"))
    )
    return SaidVelocity((v_east, v_north, v_up), max(north, east), up, filtered=True)


def _ins_heading(msg: Any) -> SaidHeading | Rejection:
    if trouble := _ins_trouble(msg):
        return trouble
    return as_filtered(heading_by_bearing(float(msg.azimuth), _oem7_sigma(msg, "azimuth")))


def _oem7_stamp_ns(msg: Any, log_ns: int) -> int | None:
    """Return the header's stamp, or in `novatel_msgs` its GPS time, less the age of a velocity."""
    header = msg.header
    if hasattr(header, "stamp"):
        stamp_ns = int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)
    else:  # milliseconds, whatever the name
        tow_ms = field_of(header, "gps_week_seconds", "gps_week_milliseconds", "gpssec")
        stamp_ns = week_stamp_ns(int(field_of(header, "gps_week", "week")), int(tow_ms), log_ns)
    age_s = float(getattr(msg, "latency", 0.0))
    stamp_ns -= round((age_s if 0.0 < age_s < 1.0 else 0.0) * NS_PER_S)
    return stamp_ns if stamp_ns > 0 else None


_PACKAGES = ("novatel_oem7_msgs", "novatel_msgs")
NOVATEL: dict[str, tuple[Part, ...]] = {
    **dict.fromkeys(
        (*(f"{package}/msg/{name}" for package in _PACKAGES for name in ("BESTPOS", "BESTGNSSPOS")), "novatel_gps_msgs/msg/NovatelPosition"),
        (Part("gnss", _oem7_place),),
    ),
    **dict.fromkeys(
        (*(f"{package}/msg/{name}" for package in _PACKAGES for name in ("BESTVEL", "BESTGNSSVEL")), "novatel_gps_msgs/msg/NovatelVelocity"),
        (Part("gnss_velocity", _oem7_velocity),),
    ),
    **dict.fromkeys(("novatel_oem7_msgs/msg/HEADING2", "novatel_gps_msgs/msg/NovatelHeading2"), (Part("compass", _oem7_heading),)),
    **dict.fromkeys(
        ("novatel_oem7_msgs/msg/INSPVAX", "novatel_oem7_msgs/msg/INSPVA", "novatel_msgs/msg/INSPVAX", "novatel_msgs/msg/INSPVA", "novatel_gps_msgs/msg/Inspvax", "novatel_gps_msgs/msg/Inspva"),
        (Part("gnss", _ins_place), Part("gnss_velocity", _ins_velocity), Part("compass", _ins_heading, antennas=False)),
    ),
}  # fmt: skip

NOVATEL_STAMPS: dict[str, Callable[[Any, int], int | None]] = dict.fromkeys(NOVATEL, _oem7_stamp_ns)
