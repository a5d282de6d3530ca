# SPDX-License-Identifier: Apache-2.0
"""Small bags for tests: messages of both ROS versions, and files of every kind."""

from collections.abc import Iterable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from graphloc.ledger import LedgerRow
from graphloc.recording import Recording

START_NS = 1_700_000_000_000_000_000
S = 1_000_000_000
UP = (0.0, 0.0, 9.81)
_NONE = (0.0,) * 9
# Each statement of a new database waits for the disk, 0.1 s in all: no test asks whether a bag outlives a failure of power.
Sqlite3Writer.SQLITE_SCHEMA = f"PRAGMA synchronous = OFF; {Sqlite3Writer.SQLITE_SCHEMA}"
Item = tuple[str, int, Any]  # topic, recording time, message (or (type, raw bytes))


@cache
def _store(ros: int) -> Typestore:
    """The types of a ROS version; what writes each is compiled once, 30 ms."""
    return get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)


@lru_cache(maxsize=64)
def _constant(values: tuple[float, ...]) -> NDArray[np.float64]:
    """Return an array that messages share: to make it anew took a fifth of the time of making samples of an IMU."""
    made = np.array(values, dtype=float)
    made.setflags(write=False)
    return made


def _numbers(values: ArrayLike) -> NDArray[np.float64]:
    return _constant(values) if isinstance(values, tuple) else np.array(values, dtype=float)


class Messages:
    """Makes messages of one ROS version; the stamp is the header's, ns."""

    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.store = _store(ros)
        self.t = self.store.types

    def register(self, definition: str, msgtype: str) -> None:
        """Add a type, for these messages alone."""
        if self.store is _store(self.ros):
            self.store = _store.__wrapped__(self.ros)
            self.t = self.store.types
        self.store.register(get_types_from_msg(definition, msgtype))

    def header(self, stamp_ns: int, frame: str = "sensor") -> Any:
        stamp = self.t["builtin_interfaces/msg/Time"](sec=stamp_ns // S, nanosec=stamp_ns % S)
        extra = {"seq": 0} if self.ros == 1 else {}
        return self.t["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)

    def vector(self, xyz: Sequence[float]) -> Any:
        x, y, z = xyz
        return self.t["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=float(z))

    def quat(self, xyzw: Sequence[float]) -> Any:
        x, y, z, w = xyzw
        return self.t["geometry_msgs/msg/Quaternion"](x=float(x), y=float(y), z=float(z), w=float(w))

    def imu(
        self,
        stamp_ns: int,
        accel: Sequence[float] = UP,
        gyro: Sequence[float] = (0.0, 0.0, 0.0),
        orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        orientation_covariance: ArrayLike = (-1.0, 0, 0, 0, 0, 0, 0, 0, 0),
        frame: str = "sensor",
    ) -> Any:
        return self.t["sensor_msgs/msg/Imu"](
            header=self.header(stamp_ns, frame),
            orientation=self.quat(orientation),
            orientation_covariance=_numbers(orientation_covariance),
            angular_velocity=self.vector(gyro),
            angular_velocity_covariance=_constant(_NONE),
            linear_acceleration=self.vector(accel),
            linear_acceleration_covariance=_constant(_NONE),
        )

    def fix(
        self,
        stamp_ns: int,
        lat: float = 57.7,
        lon: float = 11.9,
        height: float = 40.0,
        status: int = 0,
        covariance: ArrayLike = (1.0, 0, 0, 0, 1.0, 0, 0, 0, 4.0),
        covariance_type: int = 2,
        frame: str = "gps",
    ) -> Any:
        return self.t["sensor_msgs/msg/NavSatFix"](
            header=self.header(stamp_ns, frame),
            status=self.t["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
            latitude=float(lat),
            longitude=float(lon),
            altitude=float(height),
            position_covariance=_numbers(covariance),
            position_covariance_type=covariance_type,
        )

    def compass(self, stamp_ns: int, xyzw: Sequence[float]) -> Any:
        return self.t["geometry_msgs/msg/QuaternionStamped"](header=self.header(stamp_ns), quaternion=self.quat(xyzw))

    def _pose(self, xyz: Sequence[float], xyzw: Sequence[float], covariance: Any) -> Any:
        x, y, z = (float(v) for v in xyz)
        pose = self.t["geometry_msgs/msg/Pose"](
            position=self.t["geometry_msgs/msg/Point"](x=x, y=y, z=z), orientation=self.quat(xyzw)
        )
        cov = np.zeros(36) if covariance is None else np.array(covariance, dtype=float).ravel()
        return self.t["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=cov)

    def pose(
        self, stamp_ns: int, xyz: Sequence[float], xyzw: Sequence[float] = (0, 0, 0, 1), covariance: Any = None
    ) -> Any:
        return self.t["geometry_msgs/msg/PoseWithCovarianceStamped"](
            header=self.header(stamp_ns), pose=self._pose(xyz, xyzw, covariance)
        )

    def transform(self, stamp_ns: int, xyz: Sequence[float], xyzw: Sequence[float] = (0, 0, 0, 1)) -> Any:
        transform = self.t["geometry_msgs/msg/Transform"](translation=self.vector(xyz), rotation=self.quat(xyzw))
        return self.t["geometry_msgs/msg/TransformStamped"](
            header=self.header(stamp_ns, "hall"), child_frame_id="craft", transform=transform
        )

    def point(self, stamp_ns: int, xyz: Sequence[float]) -> Any:
        x, y, z = (float(v) for v in xyz)
        point = self.t["geometry_msgs/msg/Point"](x=x, y=y, z=z)
        return self.t["geometry_msgs/msg/PointStamped"](header=self.header(stamp_ns, "hall"), point=point)

    def _twist(self, v: Sequence[float], covariance: Any) -> Any:
        twist = self.t["geometry_msgs/msg/Twist"](linear=self.vector(v), angular=self.vector((0, 0, 0)))
        cov = np.zeros(36) if covariance is None else np.array(covariance, dtype=float).ravel()
        return self.t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=cov)

    def twist(self, stamp_ns: int, v: Sequence[float], covariance: Any = None, frame: str = "sensor") -> Any:
        return self.t["geometry_msgs/msg/TwistWithCovarianceStamped"](
            header=self.header(stamp_ns, frame), twist=self._twist(v, covariance)
        )

    def odometry(
        self,
        stamp_ns: int,
        xyz: Sequence[float] = (0, 0, 0),
        xyzw: Sequence[float] = (0, 0, 0, 1),
        v: Sequence[float] = (0, 0, 0),
    ) -> Any:
        return self.t["nav_msgs/msg/Odometry"](
            header=self.header(stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=self._pose(xyz, xyzw, None),
            twist=self._twist(v, None),
        )

    def transforms(self, edges: Iterable[tuple[str, str, Sequence[float], Sequence[float]]]) -> Any:
        """`tf2_msgs/TFMessage` of (parent, child, xyz, xyzw)."""
        if "tf2_msgs/msg/TFMessage" not in self.t:
            self.register("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
        stamped = [
            self.t["geometry_msgs/msg/TransformStamped"](
                header=self.header(START_NS, parent),
                child_frame_id=child,
                transform=self.t["geometry_msgs/msg/Transform"](translation=self.vector(p), rotation=self.quat(q)),
            )
            for parent, child, p, q in edges
        ]
        return self.t["tf2_msgs/msg/TFMessage"](transforms=stamped)

    def text(self, words: str) -> Any:
        return self.t["std_msgs/msg/String"](data=words)


def write_bag(path: Path, make: Messages, items: Iterable[Item], kind: str = "sqlite3", compression: str = "") -> Path:
    """Write a bag; `kind` is 'ros1', 'sqlite3' or 'mcap'; compression as the format knows it."""
    store = make.store
    connections: dict[str, Any] = {}
    writer: Any
    if kind == "ros1":
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if compression:
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    with writer:
        for topic, log_ns, msg in items:
            msgtype = msg[0] if isinstance(msg, tuple) else msg.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            data = msg[1] if isinstance(msg, tuple) else serialize(msg, msgtype)
            writer.write(connections[topic], log_ns, data)
    return path


def still_run(make: Messages, seconds: float = 4.0, start_ns: int = START_NS) -> list[Item]:
    """A craft at rest: /imu at 50 Hz, /fix at 5 Hz, recorded 10 ms after their stamps."""
    items: list[Item] = []
    for k in range(round(seconds * 50)):
        stamp = start_ns + k * S // 50
        items.append(("/imu", stamp + 10_000_000, make.imu(stamp)))
        if k % 10 == 0:
            items.append(("/fix", stamp + 10_000_000, make.fix(stamp)))
    return items


def rows_of(recording: Recording, sensor: str) -> list[LedgerRow]:
    """Ledger rows of what gave no measurement of a sensor."""
    return [row for row in recording.rows if row.sensor == sensor]


def damage_last_chunk(path: Path) -> None:
    """Overwrite some bytes of a ROS 1 bag in lz4, in its last chunk; its index stays whole."""
    data = bytearray(path.read_bytes())
    at = data.rindex(b"compression=lz4") + 60
    data[at : at + 200] = bytes(200)
    path.write_bytes(bytes(data))
