# SPDX-License-Identifier: Apache-2.0
"""Standard ROS messages of a simulated run, of either ROS version."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from graphloc.eval.simulate._lens import Image
from graphloc.eval.simulate.lidar import Scan
from graphloc.eval.simulate.rig import RigCamera
from graphloc.frames import Array
from graphloc.measurements import AXES, BodyVelocity, CompassHeading, GnssPosition, PoseFix
from graphloc.recording import Mounts

TF = "tf2_msgs/msg/TFMessage"
_JPEG_QUALITY = 90


class Messages:
    """Makes messages of one ROS version."""

    def __init__(self, ros: int) -> None:
        self._ros = ros
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        if TF not in self.store.types:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
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

    def _twist(self, v_mps: Array, cov: Array) -> Any:
        """A `TwistWithCovariance` without rates, in the axes of v (3,)."""
        twist = self._t["geometry_msgs/msg/Twist"](linear=self._vector(v_mps), angular=self._vector(np.zeros(3)))
        return self._t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=cov.reshape(36))

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

    def speed(self, m: BodyVelocity) -> Any:
        """A `TwistWithCovarianceStamped` in the sensor's axes."""
        picked, full, v = ["xyz".index(axis) for axis in m.axes], np.zeros((6, 6)), np.zeros(3)
        full[np.ix_(picked, picked)], v[picked] = m.cov, m.value
        return self._t["geometry_msgs/msg/TwistWithCovarianceStamped"](
            header=self._header(m.stamp_ns, "log"), twist=self._twist(v, full)
        )

    def pose(self, m: PoseFix) -> Any:
        mode, cov, values = m.modes[0], np.zeros((6, 6)), np.zeros(6)
        picked = [AXES.index(a) for a in m.axes]
        cov[np.ix_(picked, picked)], values[picked] = mode.cov, mode.value
        pose = self._pose(values[:3], Rotation.from_euler("xyz", values[3:]), cov)
        return self._t["geometry_msgs/msg/PoseWithCovarianceStamped"](header=self._header(m.stamp_ns, "map"), pose=pose)

    def odometry(self, stamp_ns: int, p: Array, R: Array, v: Array, child: str = "base_link") -> Any:
        none = np.zeros((6, 6))
        return self._t["nav_msgs/msg/Odometry"](
            header=self._header(stamp_ns, "map"),
            child_frame_id=child,
            pose=self._pose(p, Rotation.from_matrix(R), none),
            twist=self._twist(R.T @ v, none),
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

    def image(self, stamp_ns: int, frame: str, pixels: Image, raw: bool) -> tuple[str, Any]:
        """A grey image, its type first: `Image`, or `CompressedImage` as `image_transport` makes it."""
        header, (rows, columns) = self._header(stamp_ns, frame), pixels.shape
        if raw:
            kind = "sensor_msgs/msg/Image"
            whole = self._t[kind](
                header=header, height=rows, width=columns, encoding="mono8", is_bigendian=0, step=columns,
                data=pixels.reshape(-1),
            )  # fmt: skip
            return kind, whole
        kind = "sensor_msgs/msg/CompressedImage"
        _, coded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        return kind, self._t[kind](header=header, format="mono8; jpeg compressed ", data=coded.reshape(-1))

    def camera_info(self, stamp_ns: int, frame: str, camera: RigCamera) -> Any:
        kind, K = "sensor_msgs/msg/CameraInfo", camera.K
        given = {
            "D": np.array(camera.distortion), "K": K.reshape(9), "R": np.eye(3).reshape(9),
            "P": np.column_stack([K, np.zeros(3)]).reshape(12),
        }  # fmt: skip
        return self._t[kind](
            header=self._header(stamp_ns, frame), height=camera.height_px, width=camera.width_px,
            distortion_model=camera.model, binning_x=0, binning_y=0,
            roi=self._t["sensor_msgs/msg/RegionOfInterest"](
                x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
            **{name if self._ros == 1 else name.lower(): value for name, value in given.items()},
        )  # fmt: skip

    def mounts(self, stamp_ns: int, mounts: Mounts) -> Any:
        """`/tf_static`: where every sensor sits in body, by frame."""
        stamped = [
            self._t["geometry_msgs/msg/TransformStamped"](
                header=self._header(stamp_ns, "base_link"),
                child_frame_id=name,
                transform=self._t["geometry_msgs/msg/Transform"](
                    translation=self._vector(t), rotation=self._quaternion(Rotation.from_matrix(R))
                ),
            )
            for name, (t, R) in mounts.items()
        ]
        return self._t[TF](transforms=stamped)
