# SPDX-License-Identifier: Apache-2.0
"""Decoders by (sensor kind, message type): pure functions from message to measurement.

A reader returns what a message says (`_said`), in the project's frames and units, and `measured` makes a measurement of
it: the same checks for all messages of a kind of sensor. An uncertainty is set only if the message has none; floors, scales
and kernels belong to the factors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from math import isfinite, pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from scipy.spatial.transform import Rotation

from graphloc.config import (
    STANDARD_GRAVITY_MPS2,
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    ImuConfig,
    PoseConfig,
    VelocityConfig,
)
from graphloc.errors import ConfigError
from graphloc.extras import added
from graphloc.frames import Array, Geodetic, rpy_from_rotation, wrap_angle
from graphloc.frontends import nmea
from graphloc.frontends._crs import check_metric
from graphloc.frontends._fixes import RTK_SIGMA_M
from graphloc.frontends._rejections import Rejection, ignored, malformed, rejected
from graphloc.frontends._said import (
    Part,
    Said,
    SaidAlong,
    SaidHeading,
    SaidInertial,
    SaidPlace,
    SaidPose,
    SaidVelocity,
)
from graphloc.frontends.vendors import STAMPS, VENDORS
from graphloc.measurements import (
    AXES,
    NO_HEIGHT_M2,
    BodyVelocity,
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    Measurement,
    PoseFix,
    PoseMode,
)
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

_MIN_STATUS = {"any": -2, "fix": 0, "sbas": 1, "gbas": 2}
_STATUS_UNKNOWN = -2
_NO_FIX = "no fix (STATUS_NO_FIX)"
_COVARIANCE_UNKNOWN, _COVARIANCE_KNOWN = 0, 3
NMEA_STATUS = {2: 1, 9: 1, 4: 2, 5: 2}  # quality of GGA (differential, RTK) to NavSatStatus
_RTK_SIGMAS_M = {4: (0.02, 0.04), 5: (0.3, 0.6)}  # by quality (fixed, float): horizontal, vertical; at a dilution of 1
MOST_TURNS = 20  # a heading that is not wrapped counts no more turns
_UNIT_MPS = {"m/s": 1.0, "km/h": nmea.KM_PER_H_MPS, "knots": nmea.KNOT_MPS}
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_NO_CLIMB_MPS2 = 1e6  # variance of a vertical velocity that is not told, m^2/s^2
# No sensor of a vessel measures beyond these limits. Sums and squares of larger finite values may overflow.
_MOST_INERTIAL = 1e4  # in the unit of the bag: 1000 g in m/s^2, 30 turns a second in deg/s
MOST_SPEED_MPS, MOST_DISTANCE_M, _MOST_HEIGHT_M = 1e4, 1e7, 1e5
NO_LOCK_MPS = 32.768
"""Size of the least 16-bit integer, in mm/s, which Doppler logs write without a lock."""
_VARIANCES = (1e-18, 1e12)  # least and largest variance, m^2 and the like: of 1 nm and of 1000 km


class ImuReading(NamedTuple):
    """One inertial sample in axes of the sensor and SI units; `Readings` holds its stamp and arrival number."""

    accel_mps2: tuple[float, float, float]
    gyro_radps: tuple[float, float, float]


Decoded = Measurement | ImuReading | Rejection
# Message, stamp (ns), arrival number, sensor, configuration. Types of message and configuration depend on the row of
# `DECODERS`, hence Any.
Decoder = Callable[[Any, int, int, str, Any], Decoded]
Reader = Callable[[Any, Any], Said | SaidPose | Rejection]
"""From a message and the configuration of the sensor to what the message says."""


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


def covariance_translation_first(values: ArrayLike) -> Array:
    """Return a ROS covariance (36 values, row-major) as (6, 6), in its order.

    The order is x, y, z, then small rotations about fixed axes x, y, z. Every ROS 6x6 enters by this function; the
    factors convert it to GTSAM's order, rotation first, in body.
    """
    return np.asarray(values, dtype=float).reshape(6, 6)


def usable_covariance(cov: Array, default_variances: Array) -> Array:
    """Return `cov` (k, k) with default variances (k,) on axes whose variance is zero, negative or NaN.

    Such an axis loses its correlations. So does an axis whose variance is outside (1 nm)^2 to (1000 km)^2: it is
    clipped. If the matrix is still not positive definite, only its diagonal is kept.
    """
    variance = np.diagonal(cov)
    if all(_VARIANCES[0] <= v <= _VARIANCES[1] for v in variance.tolist()) and np.count_nonzero(cov) == len(cov):
        return np.diag(variance)  # the usual case, nothing to mend: takes a twentieth of the time
    good = np.isfinite(variance) & (variance > 0.0)
    known = good & (variance >= _VARIANCES[0]) & (variance <= _VARIANCES[1])
    # Covariances that make correlations larger than 1 are invalid, and may have any size.
    both = np.outer(known, known) & (np.abs(cov) <= _VARIANCES[1])
    clean = np.where(both, cov, 0.0)
    clean = 0.5 * (clean + clean.T)
    clean[np.diag_indices_from(clean)] = np.where(good, np.clip(variance, *_VARIANCES), default_variances)
    if np.linalg.eigvalsh(clean).min() <= 1e-9 * clean.diagonal().min():
        clean = np.diag(clean.diagonal())
    return clean


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
    if status < _MIN_STATUS[config.min_status]:
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
    return SaidPlace(latitude, longitude, height, _MIN_STATUS["gbas"], covariance=_covariance_of(msg.pose)[:3, :3])


def is_rtk(status: int, cov: Array) -> bool:
    """Return whether a fix is of RTK, by its `NavSatStatus` and its covariance (3, 3), m^2, zeros or NaN if unknown."""
    variance = np.diagonal(cov)[:2]
    known = bool(np.isfinite(variance).all() and (variance > 0.0).all())
    return status >= _MIN_STATUS["gbas"] and known and float(variance.max()) < RTK_SIGMA_M**2


def _heading(orientation: Any, variance: float, config: CompassConfig) -> SaidHeading | Rejection:
    yaw = yaw_of_x_axis(*(float(v) for v in (orientation.x, orientation.y, orientation.z, orientation.w)))
    if isinstance(yaw, Rejection):
        return yaw
    if config.convention == "ned":  # yaw is then the heading: clockwise from north
        yaw = float(wrap_angle(np.pi / 2.0 - yaw))
    told = np.isfinite(variance) and variance > 0.0
    return SaidHeading(yaw, float(np.sqrt(np.clip(variance, *_VARIANCES))) if told else 0.0)


def _heading_quaternion(msg: Any, config: CompassConfig) -> SaidHeading | Rejection:
    return _heading(msg.quaternion, 0.0, config)


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
    said = _in_enu(SaidVelocity(v, covariance=cov), config)
    return said._replace(v_mps=up_if_told(said.v_mps))


def up_if_told(v_mps: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a velocity, east, north, up, whose up is NaN where it is exactly 0.

    So drivers of NMEA leave it in a standard message, with any covariance. A maker's message says what its receiver measured.
    """
    return (*v_mps[:2], v_mps[2] or np.nan)


def _in_enu(said: SaidVelocity, config: VelocityConfig) -> SaidVelocity:
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
        return rejected(_NO_FIX)
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


def no_lock(value: ArrayLike) -> bool:
    """Return whether a velocity holds the value that Doppler logs write if they hear no echo."""
    # With a tolerance for float32, and of either sign, as axes may have been turned.
    return bool((np.abs(np.abs(value) - NO_LOCK_MPS) < 1e-5).any())


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


def _by_maker(part: Part) -> Reader:
    """Return the reader of one part of a maker's message."""

    def read(msg: Any, config: Any) -> Said | Rejection:
        said = part.read(msg)
        if isinstance(said, SaidVelocity) and not part.told:
            return _in_enu(said, config)
        if isinstance(said, SaidHeading):
            turned = not part.told and config.convention == "ned"
            return said._replace(angle_rad=float(wrap_angle(pi / 2.0 - said.angle_rad if turned else said.angle_rad)))
        return said

    return read


# From what a message says to a measurement


def measured(said: Said | SaidPose | Rejection, stamp_ns: int, seq: int, sensor: str, config: Any) -> Decoded:
    """Return the measurement of a sensor by what a message says, or why it is none.

    Args:
        said: in axes of world, of velocities and headings. stamp_ns, seq, sensor, config: as of a decoder.
    """
    of: dict[str, Any] = {"stamp_ns": stamp_ns, "seq": seq, "sensor": sensor}
    match said:
        case Rejection():
            return said
        case SaidInertial():
            return _inertial(said, config)
        case SaidPlace():
            return _fix(said, config, of)
        case SaidVelocity():
            return _over_ground(said, config, of)
        case SaidHeading():
            sigma = (said.sigma_rad if config.use_reported_sigma else 0.0) or float(np.radians(config.sigma_deg))
            return CompassHeading(**of, yaw_rad=said.angle_rad, sigma_rad=sigma)
        case SaidAlong():
            return _along_axes(said, config, of)
        case SaidPose():
            return _pose_fix(said, config, of)


def _inertial(said: SaidInertial, config: ImuConfig) -> ImuReading | Rejection:
    """Return a sample in SI units, converted from the configured units and sign of gravity."""
    accel, gyro = said
    if not all(map(isfinite, (*accel, *gyro))):
        return malformed("acceleration or angular rate is NaN")
    if max(map(abs, (*accel, *gyro))) > _MOST_INERTIAL:
        return malformed(f"acceleration or angular rate is beyond {_MOST_INERTIAL:g}, which nothing measures")
    k = STANDARD_GRAVITY_MPS2 if config.accel_unit == "g" else 1.0
    k = -k if config.gravity == "inverted" else k
    r = pi / 180.0 if config.gyro_unit == "deg/s" else 1.0
    return ImuReading((k * accel[0], k * accel[1], k * accel[2]), (r * gyro[0], r * gyro[1], r * gyro[2]))


def _fix(said: SaidPlace, config: GnssConfig, of: Mapping[str, Any]) -> Decoded:
    lat, lon, height = said[:3]
    if said.status < 0 and config.min_status != "any":
        return rejected(_NO_FIX)
    if said.status < _MIN_STATUS[config.min_status]:
        return rejected(f"fix status {said.status} is below min_status '{config.min_status}'")
    if not np.isfinite([lat, lon]).all():
        return malformed("latitude or longitude is NaN")
    planar = bool(np.isnan(height))  # NavSatFix: 'set to NaN if no altitude is available'
    if planar:
        height = 0.0
    if not abs(height) <= _MOST_HEIGHT_M:
        return malformed(f"height is beyond {_MOST_HEIGHT_M / 1e3:g} km")
    if lat == 0.0 and lon == 0.0:
        return rejected("position 0, 0: the receiver had none")
    if abs(lat) > 90.0:
        swapped = abs(lat) <= 360.0 and abs(lon) <= 90.0
        return malformed("latitude is beyond 90 deg" + (": latitude and longitude look swapped" if swapped else ""))
    if not -180.0 <= lon <= 360.0:
        return malformed("longitude is beyond 180 deg")
    cov = _covariance(said.covariance, said.horizontal_m, said.vertical_m)
    default = np.array([config.default_horizontal_sigma_m] * 2 + [config.default_vertical_sigma_m]) ** 2
    if planar:
        cov[2, :] = cov[:, 2] = 0.0  # the message gives no height, so its claim on one does not count
        default[2] = NO_HEIGHT_M2
    if config.takes_turns:
        rtk = is_rtk(said.status, cov)
        if rtk != (config.fixes == "rtk"):
            return ignored(
                f"{'of RTK' if rtk else 'without RTK'}, by its status and what it states, and fixes is {config.fixes}"
            )
    return GnssPosition(**of, position=Geodetic(lat, lon, height), cov_enu_m2=usable_covariance(cov, default))


def _covariance(told: Array | None, horizontal: float, vertical: float) -> Array:
    """Return a covariance (3, 3), east, north, up, as it is told, or else by sigmas; one of its own to change."""
    return np.diag([horizontal, horizontal, vertical]) ** 2 if told is None else np.array(told)


def _over_ground(said: SaidVelocity, config: VelocityConfig, of: Mapping[str, Any]) -> Decoded:
    """Return a velocity over ground, horizontal where its up is NaN."""
    value, cov = np.array(said.v_mps, dtype=float), _covariance(said.covariance, said.horizontal_mps, said.vertical_mps)
    default = np.full(3, config.default_sigma_mps**2)
    if np.isnan(value[2]):
        value[2], default[2] = 0.0, _NO_CLIMB_MPS2
        cov[2], cov[:, 2] = 0.0, 0.0
    if trouble := _no_velocity(value):
        return trouble
    return GnssVelocity(**of, v_enu_mps=value, cov_m2ps2=usable_covariance(cov, default))


def _no_velocity(value: Array) -> Rejection | None:
    if not np.isfinite(value).all():
        return malformed("velocity is NaN")
    if np.abs(value).max() > MOST_SPEED_MPS:
        return malformed(f"velocity is beyond {MOST_SPEED_MPS:g} m/s")
    return None


def _along_axes(said: SaidAlong, config: BodyVelocityConfig, of: Mapping[str, Any]) -> Decoded:
    """Return the velocity along the configured axes of the sensor."""
    if said.through not in ("", config.through):
        return ignored(f"its velocity is through the {said.through}, and through is {config.through}")
    axes = tuple(axis for axis in "xyz"[: len(said.v_mps)] if axis in config.axes)
    if not axes:
        return rejected(f"it tells the speed along x alone, and axes is [{', '.join(config.axes)}]")
    picked = ["xyz".index(axis) for axis in axes]
    value = np.array(said.v_mps, dtype=float)[picked]
    if trouble := _no_velocity(value):
        return trouble
    if no_lock(value):
        return rejected(f"it has no lock: a Doppler log's {NO_LOCK_MPS:g} m/s say so")
    cov = np.zeros((len(axes), len(axes)))
    if config.use_reported_sigma:
        cov = np.reshape(said.covariance, (len(said.v_mps), -1))[np.ix_(picked, picked)]
    usable = usable_covariance(cov, np.full(len(axes), config.sigma_mps**2))
    return BodyVelocity(**of, axes=axes, value=value, cov=usable)


def _pose_fix(said: SaidPose, config: PoseConfig, of: Mapping[str, Any]) -> Decoded:
    picked = [AXES.index(a) for a in config.axes]
    if said.rotation is None and max(picked) > 2:
        return malformed("orientation is NaN or no unit quaternion")
    angles = np.zeros(3) if said.rotation is None else rpy_from_rotation(said.rotation)
    value = np.concatenate([said.position_m, angles])[picked]
    if not np.isfinite(value).all():
        return malformed("position is NaN")
    if np.abs(value).max() > MOST_DISTANCE_M:
        return malformed(f"position is over {MOST_DISTANCE_M / 1e3:g} km from the datum")
    default = np.array([config.default_sigma_m] * 3 + [np.radians(config.default_sigma_deg)] * 3) ** 2
    mode = PoseMode(value=value, cov=usable_covariance(said.covariance[np.ix_(picked, picked)], default[picked]))
    return PoseFix(**of, axes=config.axes, modes=(mode,))


def _decoder(read: Reader) -> Decoder:
    def decoder(msg: Any, stamp_ns: int, seq: int, sensor: str, config: Any) -> Decoded:
        return measured(read(msg, config), stamp_ns, seq, sensor, config)

    return decoder


_READERS: dict[tuple[str, str], Reader] = {
    ("imu", IMU): _imu,
    **{("gnss", msgtype): _place for msgtype in FIX_TYPES},
    **{("gnss", msgtype): _place_nmea for msgtype in NMEA},
    **{("gnss", msgtype): _place_grid for msgtype in (ODOMETRY, POSE, PLAIN_POSE)},
    ("compass", QUATERNION): _heading_quaternion,
    ("compass", IMU): _heading_imu,
    **{("compass", msgtype): _heading_nmea for msgtype in NMEA},
    **{("compass", msgtype): _heading_number for msgtype in NUMBERS},
    **{("gnss_velocity", msgtype): _velocity for msgtype in (TWIST, PLAIN_TWIST, VECTOR)},
    **{("gnss_velocity", msgtype): _velocity_gps_fix for msgtype in GPS_FIXES},
    **{("gnss_velocity", msgtype): _velocity_nmea for msgtype in NMEA},
    **{("body_velocity", msgtype): _along for msgtype in (ODOMETRY, TWIST, PLAIN_TWIST, VECTOR)},
    **{("body_velocity", msgtype): _along_nmea for msgtype in NMEA},
    **{("body_velocity", msgtype): _along_number for msgtype in NUMBERS},
    **{("pose", msgtype): _pose for msgtype in POSE_TYPES},
    **{(part.kind, msgtype): _by_maker(part) for msgtype, parts in VENDORS.items() for part in parts},
}
DECODERS: dict[tuple[str, str], Decoder] = {of: _decoder(read) for of, read in _READERS.items()}


DECODERS_GROUP = (
    "graphloc.decoders"  # group of entry points: each is named as a kind, and loads {message type: decoder}
)


def decoder_of(kind: str, msgtype: str) -> Decoder | None:
    """Return the decoder of a message type for a kind of sensor, ours or an entry point's; None if there is none."""
    return DECODERS.get((kind, msgtype)) or _theirs(kind).get(msgtype)


def supported_types(kind: str) -> tuple[str, ...]:
    """Return the message types that a kind of sensor is read from; empty if the kind reads no topic."""
    return (*(msgtype for have, msgtype in DECODERS if have == kind), *_theirs(kind))


def _theirs(kind: str) -> Mapping[str, Decoder]:
    """Return what installed packages add to a kind.

    Raises:
        ConfigError: an entry is not a table of decoders.
    """
    table = added(DECODERS_GROUP).get(kind, {})
    if not isinstance(table, Mapping):
        raise ConfigError(
            f"{DECODERS_GROUP}: '{kind}': is a {type(table).__name__}, no dict of message types and decoders: mend or uninstall the package that adds it"
        )
    return table
