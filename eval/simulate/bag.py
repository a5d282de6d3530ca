# SPDX-License-Identifier: Apache-2.0
"""Write a simulated run as a bag of standard messages, with its vessel.yaml beside it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from graphloc.config import effective
from graphloc.errors import OutputError
from graphloc.eval.simulate._scenario import SimulatedRun
from graphloc.frames import Array
from graphloc.measurements import AXES, CompassHeading, GnssPosition, PoseFix

_LATENCY_NS = {
    "/imu/data": 2_000_000,
    "/gnss/fix": 60_000_000,
    "/gnss/heading": 60_000_000,
    "/aerial/pose": 400_000_000,
}


def write_bag(
    run: SimulatedRun, folder: Path, *, ros: int, storage: str = "mcap", overwrite: bool = False
) -> tuple[Path, Path]:
    """Write `run` into `folder`; return the paths of the bag and of its vessel.yaml.

    Header stamps are the sensors'; log stamps come later by each sensor's latency. A pose message holds
    one mode: the first.
    """
    bag, config = folder / ("run.bag" if ros == 1 else "run"), folder / "vessel.yaml"
    if folder.exists():
        if not (overwrite and config.exists()):
            raise OutputError(f"{folder}: exists already")
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    messages = sorted(_messages(run, store, ros), key=lambda m: m[0])
    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer1(bag) if ros == 1 else Writer2(bag, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for log_ns, topic, kind, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], log_ns, serialize(message, kind))
    with config.open("w", encoding="utf-8") as stream:
        YAML(typ="safe", pure=True).dump(effective(run.config), stream)
    return bag, config


def _messages(run: SimulatedRun, store: Any, ros: int) -> list[tuple[int, str, str, Any]]:
    t = store.types

    def header(stamp_ns: int, frame: str) -> Any:
        time = t["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return t["std_msgs/msg/Header"](**({"seq": 0} if ros == 1 else {}), stamp=time, frame_id=frame)

    vector, point, quaternion = (t[f"geometry_msgs/msg/{n}"] for n in ("Vector3", "Point", "Quaternion"))

    def pose(p: Array, R: Any, cov: Array) -> Any:
        inner = t["geometry_msgs/msg/Pose"](
            position=point(*map(float, p)), orientation=quaternion(*map(float, R.as_quat()))
        )
        return t["geometry_msgs/msg/PoseWithCovariance"](pose=inner, covariance=cov.reshape(36))

    out: list[tuple[int, str, str, Any]] = []

    def add(stamp: int, topic: str, kind: str, message: Any) -> None:
        out.append((stamp + _LATENCY_NS.get(topic, 0), topic, kind, message))

    imu, zero9 = run.recording.imu, np.zeros(9)
    assert imu is not None
    unknown = np.array([-1.0] + [0.0] * 8)
    for stamp, accel, gyro in zip(imu.stamps_ns.tolist(), imu.accel_mps2, imu.gyro_radps, strict=True):
        sample = t["sensor_msgs/msg/Imu"](
            header=header(stamp, "imu_link"),
            orientation=quaternion(0.0, 0.0, 0.0, 1.0),
            orientation_covariance=unknown,
            angular_velocity=vector(*map(float, gyro)),
            angular_velocity_covariance=zero9,
            linear_acceleration=vector(*map(float, accel)),
            linear_acceleration_covariance=zero9,
        )
        add(stamp, "/imu/data", "sensor_msgs/msg/Imu", sample)
    for m in run.recording.measurements:
        if isinstance(m, GnssPosition):
            fix = t["sensor_msgs/msg/NavSatFix"](
                header=header(m.stamp_ns, "gnss"),
                status=t["sensor_msgs/msg/NavSatStatus"](status=1, service=1),
                latitude=m.position.latitude_deg,
                longitude=m.position.longitude_deg,
                altitude=m.position.height_m,
                position_covariance=np.array(m.cov_enu_m2).reshape(9),
                position_covariance_type=2,
            )
            add(m.stamp_ns, "/gnss/fix", "sensor_msgs/msg/NavSatFix", fix)
        elif isinstance(m, CompassHeading):
            q = Rotation.from_euler("z", m.yaw_rad).as_quat()
            heading = t["geometry_msgs/msg/QuaternionStamped"](
                header=header(m.stamp_ns, "gnss"), quaternion=quaternion(*map(float, q))
            )
            add(m.stamp_ns, "/gnss/heading", "geometry_msgs/msg/QuaternionStamped", heading)
        elif isinstance(m, PoseFix):
            mode, cov = m.modes[0], np.zeros((6, 6))
            picked = [AXES.index(a) for a in m.axes]
            cov[np.ix_(picked, picked)] = mode.cov
            values = np.zeros(6)
            values[picked] = mode.value
            stamped = t["geometry_msgs/msg/PoseWithCovarianceStamped"](
                header=header(m.stamp_ns, "map"), pose=pose(values[:3], Rotation.from_euler("xyz", values[3:]), cov)
            )
            add(m.stamp_ns, "/aerial/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", stamped)
    truth, zero36 = run.truth, np.zeros((6, 6))
    assert truth.v_world_mps is not None
    for stamp, p, R, v in zip(
        truth.stamps_ns[::5].tolist(),
        truth.p_world_m[::5],
        truth.R_world_body[::5],
        truth.v_world_mps[::5],
        strict=True,
    ):
        twist = t["geometry_msgs/msg/Twist"](linear=vector(*map(float, R.T @ v)), angular=vector(0.0, 0.0, 0.0))
        odometry = t["nav_msgs/msg/Odometry"](
            header=header(stamp, "map"),
            child_frame_id="base_link",
            pose=pose(p, Rotation.from_matrix(R), zero36),
            twist=t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=zero36.reshape(36)),
        )
        add(stamp, "/truth", "nav_msgs/msg/Odometry", odometry)
    return out
