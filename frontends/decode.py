# SPDX-License-Identifier: Apache-2.0
"""ROS messages -> measurements. One table; each decoder is pure and knows one message type.

A message that cannot become a measurement raises `Unusable` with the reason; the reader writes it into
the ledger with file, topic and stamp.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.config import STANDARD_GRAVITY_MPS2, CompassConfig, GnssConfig, ImuConfig, PoseConfig, VelocityConfig
from graphloc.frames import Array, Geodetic, rpy_from_rotation, wrap_angle
from graphloc.ledger import Outcome
from graphloc.measurements import (
    AXES,
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    Measurement,
    PoseFix,
    PoseMode,
)

_STATUS = {"fix": 0, "sbas": 1, "gbas": 2}


class Unusable(Exception):
    """A message that gives no measurement, and what the ledger is to say about it."""

    def __init__(self, reason: str, outcome: Outcome = Outcome.MALFORMED) -> None:
        super().__init__(reason)
        self.reason = reason
        self.outcome = outcome


def _vector(v: Any) -> Array:
    return np.array([v.x, v.y, v.z], dtype=float)


def imu_sample(msg: Any, config: ImuConfig) -> tuple[Array, Array]:
    """Return specific force (3,) m/s^2 and rate (3,) rad/s in the sensor's axes."""
    accel, gyro = _vector(msg.linear_acceleration), _vector(msg.angular_velocity)
    if not (np.isfinite(accel).all() and np.isfinite(gyro).all()):
        raise Unusable("NaN or infinite acceleration or rate")
    if config.accel_unit == "g":
        accel = accel * STANDARD_GRAVITY_MPS2
    if config.gyro_unit == "deg/s":
        gyro = np.radians(gyro)
    return accel, gyro


def _covariance(flat: Any, size: int, fallback: Array) -> Array:
    """A row-major covariance, or the fallback (sigmas) where it is NaN, zero, negative or not definite."""
    cov = np.array(flat, dtype=float).reshape(size, size)
    cov = (cov + cov.T) / 2.0
    usable = np.isfinite(cov).all() and (np.diagonal(cov) > 0.0).all() and np.linalg.eigvalsh(cov).min() > 0.0
    return cov if usable else np.diag(np.asarray(fallback) ** 2)


def gnss(msg: Any, stamp_ns: int, seq: int, name: str, config: GnssConfig) -> Measurement:
    """`sensor_msgs/NavSatFix`: status and covariance type are honoured; no fix is no fix."""
    status = int(msg.status.status)
    if status < 0:
        raise Unusable("no fix (STATUS_NO_FIX)", Outcome.REJECTED)
    if status < _STATUS[config.min_status]:
        raise Unusable(f"fix of status {status} is below min_status '{config.min_status}'", Outcome.REJECTED)
    lat, lon, height = float(msg.latitude), float(msg.longitude), float(msg.altitude)
    if not np.isfinite([lat, lon, height]).all():
        raise Unusable("NaN position")
    if abs(lat) > 90.0:
        raise Unusable(f"latitude {lat:.3f} is not on Earth: latitude and longitude look swapped")
    if lat == 0.0 and lon == 0.0:
        raise Unusable("position is exactly 0, 0: the receiver had none", Outcome.REJECTED)
    h, v = config.default_horizontal_sigma_m, config.default_vertical_sigma_m
    fallback = np.array([h, h, v])
    known = int(msg.position_covariance_type) != 0
    cov = _covariance(msg.position_covariance, 3, fallback) if known else np.diag(fallback**2)
    return GnssPosition(stamp_ns=stamp_ns, sensor=name, seq=seq, position=Geodetic(lat, lon, height), cov_enu_m2=cov)


def _yaw(q: Any) -> float:
    values = np.array([q.x, q.y, q.z, q.w], dtype=float)
    if not np.isfinite(values).all():
        # Some compasses fill roll and pitch with NaN, which makes x and y of the quaternion NaN.
        if np.isfinite(values[2:]).all() and np.hypot(*values[2:]) > 1e-6:
            return float(2.0 * np.arctan2(values[2], values[3]))
        raise Unusable("NaN orientation")
    if not 0.5 < np.linalg.norm(values) < 1.5:
        raise Unusable(f"orientation is not a unit quaternion (norm {np.linalg.norm(values):.3f})")
    return float(rpy_from_rotation(Rotation.from_quat(values).as_matrix())[2])


def _heading(yaw: float, sigma: float, stamp_ns: int, seq: int, name: str, config: CompassConfig) -> Measurement:
    if config.convention == "ned":
        yaw = np.pi / 2.0 - yaw
    return CompassHeading(stamp_ns=stamp_ns, sensor=name, seq=seq, yaw_rad=float(wrap_angle(yaw)), sigma_rad=sigma)


def compass_quaternion(msg: Any, stamp_ns: int, seq: int, name: str, config: CompassConfig) -> Measurement:
    """`geometry_msgs/QuaternionStamped`."""
    return _heading(_yaw(msg.quaternion), float(np.radians(config.sigma_deg)), stamp_ns, seq, name, config)


def compass_imu(msg: Any, stamp_ns: int, seq: int, name: str, config: CompassConfig) -> Measurement:
    """The orientation of a `sensor_msgs/Imu`."""
    if msg.orientation_covariance[0] == -1.0:
        raise Unusable("the message says that it has no orientation (covariance[0] = -1)", Outcome.REJECTED)
    variance = float(msg.orientation_covariance[8])
    sigma = float(np.radians(config.sigma_deg))
    if config.use_reported_sigma and np.isfinite(variance) and variance > 0.0:
        sigma = float(np.sqrt(variance))
    return _heading(_yaw(msg.orientation), sigma, stamp_ns, seq, name, config)


def velocity(msg: Any, stamp_ns: int, seq: int, name: str, config: VelocityConfig) -> Measurement:
    """`geometry_msgs/TwistWithCovarianceStamped`, linear part, ENU."""
    v = _vector(msg.twist.twist.linear)
    if not np.isfinite(v).all():
        raise Unusable("NaN velocity")
    cov = np.array(msg.twist.covariance, dtype=float).reshape(6, 6)[:3, :3]
    fallback = np.full(3, config.default_sigma_mps)
    return GnssVelocity(
        stamp_ns=stamp_ns, sensor=name, seq=seq, v_world_mps=v, cov_m2ps2=_covariance(cov.ravel(), 3, fallback)
    )


def pose_translation_first(msg: Any, stamp_ns: int, seq: int, name: str, config: PoseConfig) -> Measurement:
    """`PoseWithCovarianceStamped` or `Odometry`: ROS covariance, x y z, then rotations about fixed axes."""
    position, q = _vector(msg.pose.pose.position), msg.pose.pose.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w], dtype=float)
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise Unusable("NaN pose")
    if not 0.5 < np.linalg.norm(quaternion) < 1.5:
        raise Unusable(f"orientation is not a unit quaternion (norm {np.linalg.norm(quaternion):.3f})")
    values = np.concatenate([position, rpy_from_rotation(Rotation.from_quat(quaternion).as_matrix())])
    picked = [AXES.index(a) for a in config.axes]
    sigmas = np.array([config.default_sigma_m] * 3 + [np.radians(config.default_sigma_deg)] * 3)[picked]
    cov = np.array(msg.pose.covariance, dtype=float).reshape(6, 6)[np.ix_(picked, picked)]
    mode = PoseMode(value=values[picked], cov=_covariance(cov.ravel(), len(picked), sigmas))
    return PoseFix(stamp_ns=stamp_ns, sensor=name, seq=seq, axes=config.axes, modes=(mode,))


Decoder = Callable[[Any, int, int, str, Any], Measurement]
DECODERS: dict[tuple[str, str], Decoder] = {
    ("gnss", "sensor_msgs/msg/NavSatFix"): gnss,
    ("compass", "geometry_msgs/msg/QuaternionStamped"): compass_quaternion,
    ("compass", "sensor_msgs/msg/Imu"): compass_imu,
    ("gnss_velocity", "geometry_msgs/msg/TwistWithCovarianceStamped"): velocity,
    ("pose", "geometry_msgs/msg/PoseWithCovarianceStamped"): pose_translation_first,
    ("pose", "nav_msgs/msg/Odometry"): pose_translation_first,
}
SUPPORTED: dict[str, tuple[str, ...]] = {
    "imu": ("sensor_msgs/msg/Imu",),
    **{kind: tuple(t for k, t in DECODERS if k == kind) for kind, _ in DECODERS},
}
