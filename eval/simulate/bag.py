# SPDX-License-Identifier: Apache-2.0
"""Write a simulated run as a recording: a bag of standard messages, its vessel.yaml, and the aerial image."""

from __future__ import annotations

import heapq
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from graphloc.config import effective
from graphloc.errors import OutputError
from graphloc.eval.simulate._scenario import SimulatedRun
from graphloc.frames import Array
from graphloc.measurements import AXES, CompassHeading, GnssPosition, PoseFix
from graphloc.recording import Progress

if TYPE_CHECKING:
    from graphloc.eval.simulate.lidar import Scan

_LATENCY_NS = {
    "/imu/data": 2_000_000,
    "/gnss/fix": 60_000_000,
    "/gnss/heading": 60_000_000,
    "/aerial/pose": 400_000_000,
}
_CLOUD_LATENCY_NS = 130_000_000  # a turn, and the driver
_TF = "tf2_msgs/msg/TFMessage"
_IMAGE, _TRUTH = "aerial.tif", "truth.json"


class _Item(NamedTuple):
    """A message and when it was recorded."""

    log_ns: int
    topic: str
    kind: str
    message: Any


def write_bag(
    run: SimulatedRun,
    folder: Path,
    *,
    ros: int,
    storage: str = "mcap",
    overwrite: bool = False,
    progress: Progress = lambda *_: None,
) -> tuple[Path, Path]:
    """Write `run` into `folder`; return the paths of the bag and of its vessel.yaml.

    Header stamps are the sensors'; log stamps come later by each sensor's latency. A pose message holds
    one mode: the first. A run in a harbour gets its aerial image, and LiDAR scans where the scenario has
    them; they are cast while the bag is written, one at a time, so memory does not grow with the run.

    Raises:
        OutputError: the folder exists, or the disk refuses.
    """
    bag, config = folder / ("run.bag" if ros == 1 else "run"), folder / "vessel.yaml"
    if folder.exists():
        if not (overwrite and config.exists()):
            raise OutputError(f"{folder}: exists already")
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    make = _Messages(ros)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    serialize = make.store.serialize_ros1 if ros == 1 else make.store.serialize_cdr
    start, whole_s = int(run.truth.stamps_ns[0]), round(run.scenario.duration_s)
    with Writer1(bag) if ros == 1 else Writer2(bag, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        done_s = 0
        for item in heapq.merge(_small(run, make), _clouds(run, make), key=lambda item: item.log_ns):
            if item.topic not in connections:
                connections[item.topic] = writer.add_connection(item.topic, item.kind, typestore=make.store)
            writer.write(connections[item.topic], item.log_ns, serialize(item.message, item.kind))
            if (item.log_ns - start) // 10**9 > done_s:
                done_s = min((item.log_ns - start) // 10**9, whole_s)
                progress("writing the bag", done_s, whole_s)
    with config.open("w", encoding="utf-8") as stream:
        YAML(typ="safe", pure=True).dump(effective(run.config), stream)
    if run.harbour is not None:
        _image(run, folder)
    return bag, config


def _image(run: SimulatedRun, folder: Path) -> None:
    """The aerial image, and beside it what only a simulator knows."""
    from graphloc.eval.simulate.aerial import render

    assert run.harbour is not None
    image = render(run.harbour, run.seed)
    image.write(folder / _IMAGE)
    secret = {
        "harbour": run.harbour.config.name,
        "seed": run.seed,
        "tide_m": run.scenario.tide_m,
        "image_shows_things_east_north_m": [round(float(v), 4) for v in image.shift_m],
    }
    (folder / _TRUTH).write_text(json.dumps(secret, indent=1) + "\n", encoding="utf-8")


def _clouds(run: SimulatedRun, make: _Messages) -> Iterator[_Item]:
    """LiDAR scans in turn; all LiDARs turn together."""
    if run.harbour is None or run.scenario.lidar_hz <= 0.0:
        return
    from graphloc.eval.simulate.lidar import Scene, bl_lidars, scan

    rng = np.random.default_rng([run.seed, 13])
    scene, lidars = Scene(run.harbour, run.harbour.boats(rng), run.scenario.tide_m), bl_lidars()
    start = int(run.truth.stamps_ns[0])
    for k in range(int((run.scenario.duration_s - 0.2) * run.scenario.lidar_hz)):
        t = k / run.scenario.lidar_hz
        for lidar in lidars:
            found = scan(lidar, scene, run.motion, t, rng)
            stamp = start + round(t * 1e9)
            log_ns = stamp + _CLOUD_LATENCY_NS
            yield _Item(log_ns, f"/{lidar.name}/points", "sensor_msgs/msg/PointCloud2", make.cloud(stamp, found))


def _small(run: SimulatedRun, make: _Messages) -> list[_Item]:
    """All other messages, by the time of their recording."""
    items: list[_Item] = [_Item(int(run.truth.stamps_ns[0]), "/tf_static", _TF, make.mounts(run))]

    def add(stamp: int, topic: str, kind: str, message: Any) -> None:
        items.append(_Item(stamp + _LATENCY_NS.get(topic, 0), topic, kind, message))

    imu = run.recording.imu
    assert imu is not None
    for stamp, accel, gyro in zip(imu.stamps_ns.tolist(), imu.accel_mps2, imu.gyro_radps, strict=True):
        add(stamp, "/imu/data", "sensor_msgs/msg/Imu", make.imu(stamp, accel, gyro))
    for m in run.recording.measurements:
        if isinstance(m, GnssPosition):
            add(m.stamp_ns, "/gnss/fix", "sensor_msgs/msg/NavSatFix", make.fix(m))
        elif isinstance(m, CompassHeading):
            add(m.stamp_ns, "/gnss/heading", "geometry_msgs/msg/QuaternionStamped", make.heading(m))
        elif isinstance(m, PoseFix):
            add(m.stamp_ns, "/aerial/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", make.pose(m))
    truth = run.truth
    assert truth.v_world_mps is not None
    every = slice(None, None, 5)
    columns = (
        truth.stamps_ns[every].tolist(),
        truth.p_world_m[every],
        truth.R_world_body[every],
        truth.v_world_mps[every],
    )
    for stamp, p, R, v in zip(*columns, strict=True):
        add(stamp, "/truth", "nav_msgs/msg/Odometry", make.odometry(stamp, p, R, v))
    return sorted(items, key=lambda item: item.log_ns)


class _Messages:
    """Makes messages of one ROS version."""

    def __init__(self, ros: int) -> None:
        self._ros = ros
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        if _TF not in self.store.types:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))
        self._t = self.store.types

    def _header(self, stamp_ns: int, frame: str) -> Any:
        time = self._t["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        extra = {"seq": 0} if self._ros == 1 else {}
        return self._t["std_msgs/msg/Header"](**extra, stamp=time, frame_id=frame)

    def _vector(self, v: Array) -> Any:
        return self._t["geometry_msgs/msg/Vector3"](*map(float, v))

    def _quaternion(self, R: Rotation) -> Any:
        return self._t["geometry_msgs/msg/Quaternion"](*map(float, R.as_quat()))

    def _pose(self, p: Array, R: Rotation, cov: Array) -> Any:
        place = self._t["geometry_msgs/msg/Point"](*map(float, p))
        inner = self._t["geometry_msgs/msg/Pose"](position=place, orientation=self._quaternion(R))
        return self._t["geometry_msgs/msg/PoseWithCovariance"](pose=inner, covariance=cov.reshape(36))

    def imu(self, stamp_ns: int, accel: Array, gyro: Array) -> Any:
        return self._t["sensor_msgs/msg/Imu"](
            header=self._header(stamp_ns, "imu_link"),
            orientation=self._t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            orientation_covariance=np.array([-1.0] + [0.0] * 8),
            angular_velocity=self._vector(gyro),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(accel),
            linear_acceleration_covariance=np.zeros(9),
        )

    def fix(self, m: GnssPosition) -> Any:
        return self._t["sensor_msgs/msg/NavSatFix"](
            header=self._header(m.stamp_ns, "gnss"),
            status=self._t["sensor_msgs/msg/NavSatStatus"](status=1, service=1),
            latitude=m.position.latitude_deg,
            longitude=m.position.longitude_deg,
            altitude=m.position.height_m,
            position_covariance=np.array(m.cov_enu_m2).reshape(9),
            position_covariance_type=2,
        )

    def heading(self, m: CompassHeading) -> Any:
        quaternion = self._quaternion(Rotation.from_euler("z", m.yaw_rad))
        return self._t["geometry_msgs/msg/QuaternionStamped"](
            header=self._header(m.stamp_ns, "gnss"), quaternion=quaternion
        )

    def pose(self, m: PoseFix) -> Any:
        mode, cov, values = m.modes[0], np.zeros((6, 6)), np.zeros(6)
        picked = [AXES.index(a) for a in m.axes]
        cov[np.ix_(picked, picked)], values[picked] = mode.cov, mode.value
        pose = self._pose(values[:3], Rotation.from_euler("xyz", values[3:]), cov)
        return self._t["geometry_msgs/msg/PoseWithCovarianceStamped"](header=self._header(m.stamp_ns, "map"), pose=pose)

    def odometry(self, stamp_ns: int, p: Array, R: Array, v: Array) -> Any:
        none = np.zeros((6, 6))
        twist = self._t["geometry_msgs/msg/Twist"](linear=self._vector(R.T @ v), angular=self._vector(np.zeros(3)))
        return self._t["nav_msgs/msg/Odometry"](
            header=self._header(stamp_ns, "map"),
            child_frame_id="base_link",
            pose=self._pose(p, Rotation.from_matrix(R), none),
            twist=self._t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=none.reshape(36)),
        )

    def cloud(self, stamp_ns: int, scan: Scan) -> Any:
        """A `PointCloud2`: x, y, z (m), intensity, ring, and time since the header's stamp (s)."""
        layout = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2"), ("time", "f4")]
        points = np.zeros(len(scan.points_m), dtype=np.dtype([(n, f"<{k}") for n, k in layout]))
        for k, name in enumerate("xyz"):
            points[name] = scan.points_m[:, k]
        points["intensity"], points["ring"], points["time"] = scan.intensity, scan.ring, scan.dt_s
        field = self._t["sensor_msgs/msg/PointField"]
        kinds = {"f4": 7, "u2": 4}  # PointField.FLOAT32, UINT16
        offsets = {name: points.dtype.fields[name][1] for name, _ in layout} if points.dtype.fields else {}
        return self._t["sensor_msgs/msg/PointCloud2"](
            header=self._header(stamp_ns, scan.lidar),
            height=1,
            width=len(points),
            fields=[field(name=n, offset=offsets[n], datatype=kinds[k], count=1) for n, k in layout],
            is_bigendian=False,
            point_step=points.dtype.itemsize,
            row_step=points.nbytes,
            data=points.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def mounts(self, run: SimulatedRun) -> Any:
        """`/tf_static`: where every sensor sits."""
        frames = {"imu_link": run.config.sensors["imu"].mount, "gnss": run.config.sensors["gnss"].mount}
        poses = {name: (mount.t_body_sensor_m, mount.R_body_sensor) for name, mount in frames.items()}
        if run.harbour is not None and run.scenario.lidar_hz > 0.0:
            from graphloc.eval.simulate.lidar import bl_lidars

            poses |= {lidar.name: (lidar.T_body_lidar[:3, 3], lidar.T_body_lidar[:3, :3]) for lidar in bl_lidars()}
        stamp = int(run.truth.stamps_ns[0])
        stamped = [
            self._t["geometry_msgs/msg/TransformStamped"](
                header=self._header(stamp, "base_link"),
                child_frame_id=name,
                transform=self._t["geometry_msgs/msg/Transform"](
                    translation=self._vector(t), rotation=self._quaternion(Rotation.from_matrix(R))
                ),
            )
            for name, (t, R) in poses.items()
        ]
        return self._t[_TF](transforms=stamped)
