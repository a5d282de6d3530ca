# SPDX-License-Identifier: Apache-2.0
"""Messages of u-blox.

`ublox_msgs` with the manual's names of fields in ROS 1, in lower case in ROS 2, `ublox_ubx_msgs` with flags of their
own, and `gnss_comm`, in units of ROS.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from graphloc.frontends._rejections import Rejection, rejected
from graphloc.frontends._said import (
    Part,
    SaidHeading,
    SaidPlace,
    SaidVelocity,
    field_of,
    gps_stamp_ns,
    heading_by_bearing,
    place_of,
    sigma_of,
    week_stamp_ns,
)

_UBX_FIX_OK, _UBX_DIFFERENTIAL = 1, 2
_UBX_TIME_VALID = 3
_UBX_2D, _UBX_FIXES = 2, (2, 3, 4)
_UBX_VALID, _UBX_MOVING, _UBX_HEADING = 0x05, 0x20, 0x100  # of a relative position; that its base moves; of its heading
_UBX_FIXED = 2  # fixed ambiguities; 1: float


def _ubx_fix(msg: Any) -> tuple[int, bool]:
    """Return the type of fix, and whether it is valid."""
    if hasattr(msg, "gps_fix"):
        return int(msg.gps_fix.fix_type), bool(msg.gnss_fix_ok) and not msg.invalid_llh
    if hasattr(msg, "valid_fix"):
        return int(msg.fix_type), bool(msg.valid_fix)
    return int(field_of(msg, "fix_type", "fixType")), bool(msg.flags & _UBX_FIX_OK)


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
    return place_of(
        place, _ubx_status(msg), 1e-3 * field_of(msg, "h_acc", "hAcc"), 1e-3 * field_of(msg, "v_acc", "vAcc")
    )


def _ubx_velocity(msg: Any) -> SaidVelocity | Rejection:
    if trouble := _ubx_trouble(msg):
        return trouble
    north, east, down = (
        1e-3 * field_of(msg, *names) for names in (("vel_n", "velN"), ("vel_e", "velE"), ("vel_d", "velD"))
    )
    sigma = 1e-3 * field_of(msg, "s_acc", "sAcc")
    return SaidVelocity((east, north, -down), sigma_of(sigma), sigma_of(sigma))


def _pvt_place(msg: Any) -> SaidPlace | Rejection:
    if trouble := _ubx_trouble(msg):
        return trouble
    height = float("nan") if _ubx_fix(msg)[0] == _UBX_2D else float(msg.altitude)
    place = float(msg.latitude), float(msg.longitude), height
    return place_of(place, _ubx_status(msg), float(msg.h_acc), float(msg.v_acc))


def _pvt_velocity(msg: Any) -> SaidVelocity | Rejection:
    if trouble := _ubx_trouble(msg):
        return trouble
    sigma = sigma_of(float(msg.vel_acc))
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
    angle, sigma = field_of(msg, "rel_pos_heading", "relPosHeading"), field_of(msg, "acc_heading", "accHeading")
    return heading_by_bearing(1e-5 * angle, 1e-5 * sigma)


def _ubx_stamp_ns(msg: Any, log_ns: int) -> int:
    known = int(getattr(msg, "valid", _UBX_TIME_VALID)) & _UBX_TIME_VALID == _UBX_TIME_VALID
    return gps_stamp_ns(int(field_of(msg, "i_tow", "iTOW")), log_ns) if known else log_ns


def _pvt_stamp_ns(msg: Any, log_ns: int) -> int:
    return week_stamp_ns(int(msg.time.week), round(1000.0 * float(msg.time.tow)), log_ns)


UBLOX: dict[str, tuple[Part, ...]] = {
    **dict.fromkeys(
        ("ublox_msgs/msg/NavPVT", "ublox_msgs/msg/NavPVT7", "ublox_ubx_msgs/msg/UBXNavPVT"), (Part("gnss", _ubx_place), Part("gnss_velocity", _ubx_velocity)),
    ),
    **dict.fromkeys(
        ("gnss_comm/msg/GnssPVTSolnMsg", "gnss_comm_msgs/msg/GnssPVTSolnMsg"), (Part("gnss", _pvt_place), Part("gnss_velocity", _pvt_velocity)),
    ),
    **dict.fromkeys(("ublox_msgs/msg/NavRELPOSNED9", "ublox_ubx_msgs/msg/UBXNavRelPosNED"), (Part("compass", _ubx_heading),)),
}  # fmt: skip

UBLOX_STAMPS: dict[str, Callable[[Any, int], int | None]] = {
    **dict.fromkeys([t for t in UBLOX if t.startswith("ublox_msgs/")], _ubx_stamp_ns),
    **dict.fromkeys([t for t in UBLOX if t.startswith("gnss_comm")], _pvt_stamp_ns),
}
