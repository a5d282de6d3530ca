# SPDX-License-Identifier: Apache-2.0
"""The message types that are read by name, and the stamp of a message."""

from __future__ import annotations

from typing import Any

from graphloc.frontends.vendors import STAMPS
from graphloc.time import NS_PER_S

IMU = "sensor_msgs/msg/Imu"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
PLAIN_TWIST = "geometry_msgs/msg/TwistStamped"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
PLAIN_POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"  # of motion capture
POINT = "geometry_msgs/msg/PointStamped"  # of a total station, or UWB
PLACES = (POSE, PLAIN_POSE, TRANSFORM, POINT)
POSE_TYPES = (ODOMETRY, *PLACES)
TRUE_TYPES = tuple(t for t in POSE_TYPES if t != POINT)
GPS_FIXES = ("gps_msgs/msg/GPSFix", "gps_common/msg/GPSFix")
FIX_TYPES = (NAV_SAT_FIX, *GPS_FIXES)
NUMBERS = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")
_STRING = "std_msgs/msg/String"
NMEA = ("nmea_msgs/msg/Sentence", _STRING)
UNSTAMPED = (*NUMBERS, _STRING)
TF = "tf2_msgs/msg/TFMessage"
NO_STAMP = "`stamps: recorded` of that sensor takes the recording time instead"


def header_stamp_ns(msg: Any) -> int | None:
    """Return the stamp of a message's header, ns; None if it has none, or a zero or negative one."""
    stamp = getattr(getattr(msg, "header", None), "stamp", None)
    if stamp is None:
        return None
    stamp_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
    return stamp_ns if stamp_ns > 0 else None


def stamp_ns_of(msg: Any, msgtype: str, log_ns: int, *, recorded: bool = False) -> int | None:
    """Return the stamp of a message, ns: that of its header, or the time that a maker's message without a header says.

    It is the recording time if the type has no stamp, or if `recorded`. None if the stamp is zero, negative or
    unusable.
    """
    if recorded or msgtype in UNSTAMPED:
        return log_ns
    try:
        return STAMPS[msgtype](msg, log_ns) if msgtype in STAMPS else header_stamp_ns(msg)
    except (AttributeError, TypeError, ValueError, OverflowError):
        # Another version of a maker's message, or fields of other types.
        return None
