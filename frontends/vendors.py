# SPDX-License-Identifier: Apache-2.0
"""Messages of makers' own ROS packages: one table of pure functions from message to plain values.

Makers with few types of message are read in this module. A message says one thing or several: a receiver's says a place
and a velocity. Velocities and headings of most types are in known axes, and come out east, north, up. A few drivers
write north, east, down or east, north, up, as they are configured: these values come out as they are, and `convention`
of the sensor tells the axes. The axes of an IMU or a Doppler log stay its own.
"""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, pi
from typing import Any

from graphloc.frontends._novatel import NOVATEL, NOVATEL_STAMPS
from graphloc.frontends._rejections import Rejection, malformed, rejected
from graphloc.frontends._said import (
    Part,
    SaidAlong,
    SaidHeading,
    SaidInertial,
    SaidPlace,
    SaidVelocity,
    as_filtered,
    heading_by_bearing,
    place_of,
    sigma_of,
    xyz_of,
    yaw_of,
)
from graphloc.frontends._sbg import SBG
from graphloc.frontends._septentrio import SEPTENTRIO
from graphloc.frontends._ublox import UBLOX, UBLOX_STAMPS

# KAIST's complex urban data set: its player makes these messages from GGA and GST. Older ones have a dilution, no
# sigmas.

_VRS_STATUS = {1: 0, 2: 1, 3: 0, 4: 2, 5: 2, 9: 1}  # quality of GGA to NavSatStatus


def _vrs_place(msg: Any) -> SaidPlace | Rejection:
    quality = int(msg.fix_state)
    if quality not in _VRS_STATUS:
        return rejected(f"no fix (fix_state {quality})")
    north, east, up = (float(getattr(msg, f"{name}_std", 0.0)) for name in ("lat", "lon", "altitude"))
    place = float(msg.latitude), float(msg.longitude), float(msg.altitude)
    return place_of(place, _VRS_STATUS[quality], max(north, east), up)


# PX4: its times are microseconds since boot, or of the computer's clock if its agent synchronises them.

_PX4_STATUS = {2: 0, 3: 0, 4: 1, 5: 2, 6: 2}
_PX4_2D, _PX4_NO_ACCEL = 2, 0x7FFFFFFF
_LATEST_US = 4 * 10**15  # year 2096: as nanoseconds it fits 64 bits


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
    return place_of(place, _PX4_STATUS[fix], float(msg.eph), float(msg.epv))


def _px4_velocity(msg: Any) -> SaidVelocity | Rejection:
    if int(msg.fix_type) not in _PX4_STATUS or not msg.vel_ned_valid:
        return rejected("no velocity (vel_ned_valid false, or no fix)")
    sigma = sigma_of(float(msg.s_variance_m_s))  # a sigma, despite its name
    return SaidVelocity((float(msg.vel_e_m_s), float(msg.vel_n_m_s), -float(msg.vel_d_m_s)), sigma, sigma)


def _px4_heading(msg: Any) -> SaidHeading | Rejection:
    sigma = float(getattr(msg, "heading_accuracy", 0.0))
    return heading_by_bearing(degrees(float(msg.heading)), degrees(sigma) if sigma < pi else 0.0)


def _px4_stamp_ns(msg: Any, _log_ns: int) -> int | None:
    at_us, sampled_us = int(msg.timestamp), int(getattr(msg, "timestamp_sample", 0))
    if 0 <= at_us - sampled_us < 1_000_000:
        at_us = sampled_us
    return 1000 * at_us if 0 < at_us < _LATEST_US else None


# Doppler logs: axes x ahead, y to starboard, z down, in which direction they are mounted.

_DVL_THROUGH = {1: "ground", 2: "water"}
_DVL_BEAMS = 3  # least number of beams for a velocity


def _waterlinked_along(msg: Any) -> SaidAlong | Rejection:
    if not msg.velocity_valid:
        return rejected("no velocity (velocity_valid false: no lock on the bottom)")
    covariance = tuple(float(v) for v in getattr(msg, "covariance", ()))  # of newer versions
    if len(covariance) != 9:
        fom = sigma_of(float(msg.fom)) ** 2  # the figure of merit is a sigma
        covariance = (fom, 0.0, 0.0, 0.0, fom, 0.0, 0.0, 0.0, fom)
    return SaidAlong(xyz_of(msg.velocity), covariance)


def _dvl_along(msg: Any) -> SaidAlong | Rejection:
    v, beams = xyz_of(msg.velocity), int(msg.num_good_beams)
    # Drivers of instruments that only tell a velocity fill in neither beams nor flags.
    if 0 < beams < _DVL_BEAMS or not (msg.beam_velocities_valid or any(v)):
        return rejected(f"no velocity ({beams} good beams)")
    return SaidAlong(v, tuple(float(c) for c in msg.velocity_covar), _DVL_THROUGH.get(int(msg.velocity_mode), ""))


# geographic_msgs: poses are taken for a filter's output, points are not. Axes are east, north, up, heights ellipsoidal.


def _geo_point(msg: Any) -> SaidPlace | Rejection:
    p = msg.position
    return SaidPlace(float(p.latitude), float(p.longitude), float(p.altitude), 0)


def _geo_covariance(msg: Any) -> tuple[Any, tuple[float, float, float]]:
    """Return the pose, and its horizontal, vertical and yaw variances, 0 if not told."""
    if not hasattr(msg.pose, "covariance"):
        return msg.pose, (0.0, 0.0, 0.0)
    if len(msg.pose.covariance) != 36:
        raise ValueError(f"a covariance of {len(msg.pose.covariance)} values")
    one, other, up, _, _, yaw = (float(c) for c in msg.pose.covariance[::7])  # north or east first, by driver
    return msg.pose.pose, (max(one, other), up, yaw)


def _geo_place(msg: Any) -> SaidPlace | Rejection:
    pose, variances = _geo_covariance(msg)
    p = pose.position
    place = float(p.latitude), float(p.longitude), float(p.altitude)
    return as_filtered(place_of(place, 0, *(sigma_of(v) ** 0.5 for v in variances[:2])))


def _geo_heading(msg: Any) -> SaidHeading | Rejection:
    pose, variances = _geo_covariance(msg)
    q = pose.orientation
    x, y, z, w = (float(v) for v in (q.x, q.y, q.z, q.w))
    if x == y == z == 0.0:
        return rejected("no orientation: zero, or as drivers leave it that know none")
    if not abs(x * x + y * y + z * z + w * w - 1.0) < 0.1:
        return malformed("orientation is NaN or no unit quaternion")
    return SaidHeading(yaw_of(q), sigma_of(variances[2]) ** 0.5, filtered=True)


GEOGRAPHIC = tuple(f"geographic_msgs/msg/{name}Stamped" for name in ("GeoPoint", "GeoPose", "GeoPoseWithCovariance"))
_GPS = (Part("gnss", _px4_place), Part("gnss_velocity", _px4_velocity), Part("compass", _px4_heading))
VENDORS: dict[str, tuple[Part, ...]] = {
    **SBG,
    **UBLOX,
    **NOVATEL,
    "irp_sen_msgs/msg/vrs": (Part("gnss", _vrs_place),),
    **SEPTENTRIO,
    "px4_msgs/msg/SensorCombined": (Part("imu", _px4_imu),),
    **dict.fromkeys(("px4_msgs/msg/SensorGps", "px4_msgs/msg/VehicleGpsPosition"), _GPS),
    GEOGRAPHIC[0]: (Part("gnss", _geo_point),),
    **dict.fromkeys(GEOGRAPHIC[1:], (Part("gnss", _geo_place), Part("compass", _geo_heading, antennas=False))),
    **dict.fromkeys(("dvl_msgs/msg/DVL", "waterlinked_a50_ros_driver/msg/DVL"), (Part("body_velocity", _waterlinked_along),)),
    **dict.fromkeys(("marine_acoustic_msgs/msg/Dvl", "acoustic_msgs/msg/Dvl"), (Part("body_velocity", _dvl_along, through=True),)),
}  # fmt: skip
"""By type of message: its parts; the first one gives the stream that is named as the topic."""

STAMPS: dict[str, Callable[[Any, int], int | None]] = {
    **UBLOX_STAMPS,
    **NOVATEL_STAMPS,
    **dict.fromkeys([t for t in VENDORS if t.startswith("px4_msgs/")], _px4_stamp_ns),
}
"""By type of message without a header's stamp: from message and recording time (ns) to stamp (ns)."""
