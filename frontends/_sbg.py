# SPDX-License-Identifier: Apache-2.0
"""Messages of SBG Systems: Ellipse, Ekinox, Apogee.

With `use_enu` its driver writes velocities east, north, up, and yaw counter-clockwise from east.
"""

from __future__ import annotations

from math import degrees
from typing import Any

from graphloc.frontends._rejections import Rejection, rejected
from graphloc.frontends._said import (
    Part,
    SaidHeading,
    SaidInertial,
    SaidPlace,
    SaidVelocity,
    as_filtered,
    field_of,
    heading_as_told,
    place_of,
    sigma_of,
    xyz_of,
    yaw_of,
)

# Type of solution to NavSatStatus; PPP converges slowly, so it is no RTK.
_SBG_STATUS = {1: 0, 2: 0, 3: 1, 4: 1, 5: 1, 6: 2, 7: 2, 8: 1, 9: 1}
_SBG_NONE = {0: "none", 10: "a position that was set, not measured"}
_SBG_CRITICAL, _SBG_SPOOFED = 4, 4
_SBG_PER_MPS2, _SBG_PER_RADPS = 1_048_576.0, (67_108_864.0, 12_304_174.0)  # counts, in either range of the gyroscope
_SBG_COMPUTED = 0x3F  # bits of a status that are 0 if the solution was computed


def _sbg_imu_trouble(msg: Any) -> Rejection | None:
    failed = [name for name in ("imu_com", "imu_status") if not getattr(msg.imu_status, name)]
    return rejected(f"the IMU says that it does not work ({', '.join(failed)} false)") if failed else None


def _sbg_imu(msg: Any) -> SaidInertial | Rejection:
    return _sbg_imu_trouble(msg) or SaidInertial(xyz_of(msg.accel), xyz_of(msg.gyro))


def _sbg_imu_short(msg: Any) -> SaidInertial | Rejection:
    if trouble := _sbg_imu_trouble(msg):
        return trouble
    (ax, ay, az), (wx, wy, wz) = xyz_of(msg.delta_velocity), xyz_of(msg.delta_angle)
    a, w = _SBG_PER_MPS2, _SBG_PER_RADPS[bool(getattr(msg.imu_status, "imu_gyros_use_high_scale", False))]
    return SaidInertial((ax / a, ay / a, az / a), (wx / w, wy / w, wz / w))


def _sbg_where(msg: Any) -> tuple[float, float, float]:
    """Return latitude and longitude, deg, and height above the ellipsoid, m."""
    if hasattr(msg, "latitude"):
        place = float(msg.latitude), float(msg.longitude), float(msg.altitude)
    else:  # until 2021, a vector; a version in between wrote longitude first where set to ENU, which nothing tells
        place = xyz_of(msg.position)
    return (*place[:2], place[2] + float(msg.undulation))


def _sbg_place(msg: Any) -> SaidPlace | Rejection:
    status, solution = int(msg.status.status), int(msg.status.type)
    if status != 0 or solution not in _SBG_STATUS:
        return rejected(f"no fix (status {status}, type {_SBG_NONE.get(solution, solution)})")
    if int(getattr(msg.status, "ifm", 0)) == _SBG_CRITICAL:
        return rejected("the receiver says that its position is jammed")
    if int(getattr(msg.status, "spoofing", 0)) == _SBG_SPOOFED:
        return rejected("the receiver says that its position is spoofed")
    x, y, z = xyz_of(msg.position_accuracy)
    return place_of(_sbg_where(msg), _SBG_STATUS[solution], max(x, y), z)


def _sbg_velocity(msg: Any) -> SaidVelocity | Rejection:
    status, solution = int(msg.status.vel_status), int(msg.status.vel_type)
    if status != 0 or solution == 0:
        return rejected(f"no velocity (status {status}, type {solution})")
    x, y, z = xyz_of(field_of(msg, "velocity_accuracy", "vel_acc"))
    return SaidVelocity(xyz_of(field_of(msg, "velocity", "vel")), sigma_of(max(x, y)), sigma_of(z))


def _sbg_heading(msg: Any) -> SaidHeading | Rejection:
    if status := int(msg.status) & _SBG_COMPUTED:
        return rejected(f"no heading (status {status})")
    return heading_as_told(float(msg.true_heading), float(msg.true_heading_acc))


def _sbg_filtered_place(msg: Any) -> SaidPlace | Rejection:
    if not msg.status.position_valid:
        return rejected("the filter says that its position is not valid")
    x, y, z = xyz_of(msg.position_accuracy)
    return as_filtered(place_of(_sbg_where(msg), 0, max(x, y), z))


def _sbg_filtered_velocity(msg: Any) -> SaidVelocity | Rejection:
    if not msg.status.velocity_valid:
        return rejected("the filter says that its velocity is not valid")
    x, y, z = xyz_of(msg.velocity_accuracy)
    return SaidVelocity(xyz_of(msg.velocity), sigma_of(max(x, y)), sigma_of(z), filtered=True)


def _sbg_filtered_heading(msg: Any) -> SaidHeading | Rejection:
    if not msg.status.heading_valid:
        return rejected("the filter says that its heading is not valid")
    if hasattr(msg, "quaternion"):
        yaw = yaw_of(msg.quaternion)
    else:
        yaw = float(msg.angle.z)
    return as_filtered(heading_as_told(degrees(yaw), degrees(float(msg.accuracy.z))))


SBG: dict[str, tuple[Part, ...]] = {
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
}  # fmt: skip
