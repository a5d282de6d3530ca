# SPDX-License-Identifier: Apache-2.0
"""What the standard messages of ROS, GPSFix and NMEA say (`_said`), in the project's frames and units."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import isfinite, pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from scipy.spatial.transform import Rotation

from graphloc.config import (
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    ImuConfig,
    PoseConfig,
    VelocityConfig,
)
from graphloc.frames import Array, wrap_angle
from graphloc.frontends import nmea
from graphloc.frontends._crs import check_metric
from graphloc.frontends._rejections import Rejection, malformed, rejected
from graphloc.frontends._said import (
    Said,
    SaidAlong,
    SaidHeading,
    SaidInertial,
    SaidPlace,
    SaidPose,
    SaidVelocity,
)
from graphloc.frontends.msgtypes import (
    FIX_TYPES,
    GPS_FIXES,
    IMU,
    NMEA,
    NUMBERS,
    ODOMETRY,
    PLAIN_POSE,
    PLAIN_TWIST,
    POSE,
    POSE_TYPES,
    QUATERNION,
    TWIST,
    VECTOR,
)
from graphloc.measurements import AXES

MIN_STATUS = {"any": -2, "fix": 0, "sbas": 1, "gbas": 2}
_STATUS_UNKNOWN = -2
NO_FIX = "no fix (STATUS_NO_FIX)"
_COVARIANCE_UNKNOWN, _COVARIANCE_KNOWN = 0, 3
NMEA_STATUS = {2: 1, 9: 1, 4: 2, 5: 2}  # quality of GGA (differential, RTK) to NavSatStatus
_RTK_SIGMAS_M = {4: (0.02, 0.04), 5: (0.3, 0.6)}  # by quality (fixed, float): horizontal, vertical; at a dilution of 1
MOST_TURNS = 20  # a heading that is not wrapped counts no more turns
_UNIT_MPS = {"m/s": 1.0, "km/h": nmea.KM_PER_H_MPS, "knots": nmea.KNOT_MPS}
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
VARIANCES = (1e-18, 1e12)  # least and largest variance, m^2 and the like: of 1 nm and of 1000 km

Reader = Callable[[Any, Any], Said | SaidPose | Rejection]
"""From a message and the configuration of the sensor to what the message says."""


def covariance_translation_first(values: ArrayLike) -> Array:
    """Return a ROS covariance (36 values, row-major) as (6, 6), in its order.

    The order is x, y, z, then small rotations about fixed axes x, y, z. Every ROS 6x6 enters by this function; the
    factors convert it to GTSAM's order, rotation first, in body.
    """
    return np.asarray(values, dtype=float).reshape(6, 6)


def yaw_of_x_axis(x: float, y: float, z: float, w: float) -> float | Rejection:
    """Return the direction of a quaternion's x axis, rad, about the vertical axis (up or down) of its frame.

    Drivers that only know a heading write NaN for x and y; then z and w alone give the yaw.
    """
    if np.isfinite(z) and np.isfinite(w) and not (np.isfinite(x) and np.isfinite(y)):
        x = y = 0.0
        scale = float(np.hypot(z, w))
        if scale < 1e-6:
            return malformed("orientation has no yaw (x, y are NaN; z, w are zero)")
        z, w = z / scale, w / scale
    if not np.isfinite([x, y, z, w]).all():
        return malformed("orientation is NaN")
    norm = float(np.sqrt(x * x + y * y + z * z + w * w))
    if abs(norm - 1.0) > 0.1:
        return malformed("orientation is no unit quaternion (all zero: not filled in by the driver)")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    forward, left = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)
    if np.hypot(forward, left) < 0.1:
        return rejected("the compass's x axis points up or down, so it has no heading")
    return float(np.arctan2(left, forward))


def nav_sat_status(status: int) -> int:
    """Return the status of a NavSatFix or GPSFix as in NavSatStatus: differential (18) and WAAS (33) become `sbas`.

    -2 (`STATUS_UNKNOWN`, the default in ROS 2 Jazzy) is what drivers leave that do not fill it in: taken for a fix.
    """
    return {18: 1, 33: 1, _STATUS_UNKNOWN: 0}.get(status, status)


def _imu(msg: Any, _config: ImuConfig) -> SaidInertial | Rejection:
    a, w = msg.linear_acceleration, msg.angular_velocity
    said = SaidInertial((float(a.x), float(a.y), float(a.z)), (float(w.x), float(w.y), float(w.z)))
    for name, values, cov in (
        ("linear_acceleration", said.accel_mps2, msg.linear_acceleration_covariance),
        ("angular_velocity", said.gyro_radps, msg.angular_velocity_covariance),
    ):
        if not any(values) and cov[0] == -1.0:
            return malformed(f"the driver says that {name} is absent ({name}_covariance[0] = -1)")
    return said


def _place(msg: Any, _config: GnssConfig) -> SaidPlace:
    cov = np.asarray(msg.position_covariance, dtype=float).reshape(3, 3)
    kind = int(msg.position_covariance_type)
    if kind == _COVARIANCE_UNKNOWN:
        cov = np.zeros((3, 3))
    elif kind != _COVARIANCE_KNOWN:
        cov = np.diag(np.diagonal(cov))  # 'approximated' and 'diagonal known' promise the diagonal only
    place = float(msg.latitude), float(msg.longitude), float(msg.altitude)
    return SaidPlace(*place, nav_sat_status(int(msg.status.status)), covariance=cov)


def nmea_sigmas_m(fix: nmea.Fix, default_m: tuple[float, float]) -> tuple[float, float]:
    """Return horizontal and vertical sigma of a fix, m: by quality for RTK, else the default; times the dilution."""
    horizontal, vertical = _RTK_SIGMAS_M.get(fix.quality, default_m)
    dilution = min(max(fix.hdop, 1.0), 100.0) if isfinite(fix.hdop) else 1.0
    return dilution * horizontal, dilution * vertical


def _place_nmea(msg: Any, config: GnssConfig) -> SaidPlace | Rejection:
    fix = nmea.fix(nmea.text_of(msg), config.nmea)
    if isinstance(fix, Rejection):
        return fix
    status = NMEA_STATUS.get(fix.quality, 0)
    if status < MIN_STATUS[config.min_status]:
        return rejected(f"quality {fix.quality} is below min_status '{config.min_status}'")
    sigmas_m = nmea_sigmas_m(fix, (config.default_horizontal_sigma_m, config.default_vertical_sigma_m))
    return SaidPlace(fix.latitude_deg, fix.longitude_deg, fix.height_m, status, *sigmas_m)


@lru_cache(maxsize=8)
def _from_grid(grid: str) -> Transformer:
    try:
        crs = CRS.from_user_input(grid)
    except CRSError:
        raise ValueError(f"grid {grid} is not known") from None
    check_metric(f"grid {grid}", crs)
    return Transformer.from_crs(crs, 4326, always_xy=True)


def _place_grid(msg: Any, config: GnssConfig) -> SaidPlace | Rejection:
    """Read the position of a pose in a map grid; its orientation is not used.

    The grid's north is off by a few degrees, by which the covariance is not turned.
    """
    if not config.grid:
        return malformed("a position in a map grid: set grid to its name, e.g. EPSG:32632 for UTM zone 32 north")
    (x, y, height), _ = pose_of(msg)
    longitude, latitude = _from_grid(config.grid).transform(x, y)
    if not np.isfinite([longitude, latitude]).all():
        return malformed(f"its position is not in the grid {config.grid}")
    return SaidPlace(latitude, longitude, height, MIN_STATUS["gbas"], covariance=_covariance_of(msg.pose)[:3, :3])


def _heading(orientation: Any, variance: float, config: CompassConfig) -> SaidHeading | Rejection:
    yaw = yaw_of_x_axis(*(float(v) for v in (orientation.x, orientation.y, orientation.z, orientation.w)))
    if isinstance(yaw, Rejection):
        return yaw
    if config.convention == "ned":  # yaw is then the heading: clockwise from north
        yaw = float(wrap_angle(np.pi / 2.0 - yaw))
    told = np.isfinite(variance) and variance > 0.0
    return SaidHeading(yaw, float(np.sqrt(np.clip(variance, *VARIANCES))) if told else 0.0)


def _heading_quaternion(msg: Any, config: CompassConfig) -> SaidHeading | Rejection:
    return _heading(msg.quaternion, 0.0, config)


def _heading_pose(msg: Any, config: CompassConfig) -> SaidHeading | Rejection:
    """Read the orientation of a pose; its position is not used."""
    variance = float(_covariance_of(msg.pose)[5, 5])
    return _heading(getattr(msg.pose, "pose", msg.pose).orientation, variance, config)


def _heading_imu(msg: Any, config: CompassConfig) -> SaidHeading | Rejection:
    if msg.orientation_covariance[0] == -1.0:
        return rejected("the driver says that the orientation is absent (orientation_covariance[0] = -1)")
    return _heading(msg.orientation, float(msg.orientation_covariance[8]), config)


def _heading_nmea(msg: Any, config: CompassConfig) -> SaidHeading | Rejection:
    heading = nmea.heading_deg(nmea.text_of(msg), config.nmea)
    return heading if isinstance(heading, Rejection) else SaidHeading(float(wrap_angle(np.radians(90.0 - heading))))


def _heading_number(msg: Any, config: CompassConfig) -> SaidHeading | Rejection:
    angle = float(np.radians(msg.data)) if config.unit == "deg" else float(msg.data)
    if not isfinite(angle):
        return malformed("heading is NaN")
    if abs(angle) > MOST_TURNS * 2.0 * pi:
        return malformed(
            f"heading {float(msg.data):g} {config.unit} is beyond {MOST_TURNS} turns: is it in another unit?"
        )
    return SaidHeading(float(wrap_angle(pi / 2.0 - angle if config.convention == "ned" else angle)))


def _twist(msg: Any) -> tuple[tuple[float, float, float], Array]:
    """Return the linear velocity of a message and its covariance (3, 3), zeros if it has none."""
    v = getattr(msg.twist, "twist", msg.twist).linear
    return (v.x, v.y, v.z), _covariance_of(msg.twist)[:3, :3]


def _vector(msg: Any) -> tuple[tuple[float, float, float], Array]:
    """Return the same of a message that is a vector."""
    return (msg.vector.x, msg.vector.y, msg.vector.z), np.zeros((3, 3))


def _velocity(msg: Any, config: VelocityConfig) -> SaidVelocity:
    v, cov = _vector(msg) if hasattr(msg, "vector") else _twist(msg)
    said = in_enu(SaidVelocity(v, covariance=cov), config)
    return said._replace(v_mps=up_if_told(said.v_mps))


def up_if_told(v_mps: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a velocity, east, north, up, whose up is NaN where it is exactly 0.

    So drivers of NMEA leave it in a standard message, with any covariance. A maker's message says what its receiver measured.
    """
    return (*v_mps[:2], v_mps[2] or np.nan)


def in_enu(said: SaidVelocity, config: VelocityConfig) -> SaidVelocity:
    """Return a velocity in the configured axes in east, north, up."""
    if config.convention == "enu":
        return said
    north, east, down = said.v_mps
    cov = None if said.covariance is None else _ENU_FROM_NED @ said.covariance @ _ENU_FROM_NED.T
    return said._replace(v_mps=(east, north, -down), covariance=cov)


def _velocity_nmea(msg: Any, config: VelocityConfig) -> SaidVelocity | Rejection:
    v = nmea.velocity_mps(nmea.text_of(msg), config.nmea)
    return v if isinstance(v, Rejection) else SaidVelocity((*v, np.nan))


def gps_fix_velocity_mps(msg: Any) -> tuple[float, float, float] | Rejection:
    """Return the velocity over ground of a GPSFix, east, north, up, m/s, by its speed, track and climb.

    The track is clockwise from true north. Up is NaN if the climb is exactly 0: no receiver measures that, but drivers
    of NMEA leave it so. The errors in the message are not used: drivers disagree on their meaning.
    """
    if nav_sat_status(int(msg.status.status)) < 0:
        return rejected(NO_FIX)
    speed, track, climb = float(msg.speed), float(msg.track), float(msg.climb)
    if not isfinite(speed) or (speed > nmea.SLOW_MPS and not isfinite(track)):
        return rejected(f"no {'track' if isfinite(speed) else 'speed'}")
    if not isfinite(track):
        return 0.0, 0.0, climb or np.nan
    angle = np.radians(track)
    return float(speed * np.sin(angle)), float(speed * np.cos(angle)), climb or np.nan


def _velocity_gps_fix(msg: Any, _config: VelocityConfig) -> SaidVelocity | Rejection:
    v = gps_fix_velocity_mps(msg)
    return v if isinstance(v, Rejection) else SaidVelocity(v)


def _along(msg: Any, _config: BodyVelocityConfig) -> SaidAlong:
    return SaidAlong(*(_vector(msg) if hasattr(msg, "vector") else _twist(msg)))


def _along_number(msg: Any, config: BodyVelocityConfig) -> SaidAlong:
    return SaidAlong((float(msg.data) * _UNIT_MPS[config.unit],), np.zeros((1, 1)))


def _along_nmea(msg: Any, config: BodyVelocityConfig) -> SaidAlong | Rejection:
    v = nmea.log_velocity_mps(nmea.text_of(msg), config.nmea, config.through)
    return v if isinstance(v, Rejection) else SaidAlong(v, np.zeros((len(v), len(v))))


def is_unit(quaternion: Array) -> bool:
    """Return whether a quaternion (4,) has about unit norm: drivers write few digits."""
    return bool((np.abs(quaternion) < 2.0).all()) and abs(float(np.linalg.norm(quaternion)) - 1.0) < 0.1


def rotation_of(quaternion: ArrayLike) -> Array | None:
    """Return the rotation (3, 3) of a quaternion (4,); None of an invalid one."""
    quaternion = np.asarray(quaternion, dtype=float)
    return np.asarray(Rotation.from_quat(quaternion).as_matrix()) if is_unit(quaternion) else None


def pose_of(msg: Any) -> tuple[Array, Array | None]:
    """Return the position (3,) and rotation (3, 3) of a message of `POSE_TYPES`.

    The rotation is None if the message has no quaternion, or an invalid one.
    """
    numbers = pose_numbers(msg)
    return np.array(numbers[:3]), rotation_of(numbers[3:])


def pose_numbers(msg: Any) -> tuple[float, ...]:
    """Return x, y, z, and the quaternion's x, y, z, w, of a message of `POSE_TYPES`; NaN if it has no orientation."""
    if hasattr(msg, "transform"):
        p, q = msg.transform.translation, msg.transform.rotation
    elif hasattr(msg, "point"):
        return float(msg.point.x), float(msg.point.y), float(msg.point.z), *(np.nan,) * 4
    else:
        pose = getattr(msg.pose, "pose", msg.pose)
        p, q = pose.position, pose.orientation
    return float(p.x), float(p.y), float(p.z), float(q.x), float(q.y), float(q.z), float(q.w)


def _pose(msg: Any, config: PoseConfig) -> SaidPose | Rejection:
    if hasattr(msg, "point") and any(AXES.index(a) > 2 for a in config.axes):
        return malformed("a point has no orientation: set axes: [x, y, z]")
    return SaidPose(*pose_of(msg), _covariance_of(getattr(msg, "pose", None)))


def _covariance_of(part: Any) -> Array:
    """Return the covariance (6, 6), translation first, of a part of a message; zeros if it has none."""
    told = getattr(part, "covariance", None)
    return np.zeros((6, 6)) if told is None else covariance_translation_first(told)


STANDARD: dict[tuple[str, str], Reader] = {
    ("imu", IMU): _imu,
    **{("gnss", msgtype): _place for msgtype in FIX_TYPES},
    **{("gnss", msgtype): _place_nmea for msgtype in NMEA},
    **{("gnss", msgtype): _place_grid for msgtype in (ODOMETRY, POSE, PLAIN_POSE)},
    ("compass", QUATERNION): _heading_quaternion,
    ("compass", IMU): _heading_imu,
    **{("compass", msgtype): _heading_pose for msgtype in (POSE, PLAIN_POSE)},
    **{("compass", msgtype): _heading_nmea for msgtype in NMEA},
    **{("compass", msgtype): _heading_number for msgtype in NUMBERS},
    **{("gnss_velocity", msgtype): _velocity for msgtype in (TWIST, PLAIN_TWIST, VECTOR)},
    **{("gnss_velocity", msgtype): _velocity_gps_fix for msgtype in GPS_FIXES},
    **{("gnss_velocity", msgtype): _velocity_nmea for msgtype in NMEA},
    **{("body_velocity", msgtype): _along for msgtype in (ODOMETRY, TWIST, PLAIN_TWIST, VECTOR)},
    **{("body_velocity", msgtype): _along_nmea for msgtype in NMEA},
    **{("body_velocity", msgtype): _along_number for msgtype in NUMBERS},
    **{("pose", msgtype): _pose for msgtype in POSE_TYPES},
}
"""Readers by (sensor kind, message type)."""
