# SPDX-License-Identifier: Apache-2.0
"""LiDAR scans from a bag, each point moved to one time by the vessel's own motion, levelled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends.aerial.scan import LevelCloud
from graphloc.trajectory import Trajectory

CLOUD = "sensor_msgs/msg/PointCloud2"
_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField
_TIME_FIELDS = ("time", "t", "timestamp", "offset_time", "time_offset", "time_stamp")
_LONGEST_TURN_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A scan as recorded: points (N, 3) m in the LiDAR's axes, the stamp of each (N,) ns, and that of its header."""

    lidar: str
    stamp_ns: int
    points_m: Array
    stamps_ns: NDArray[np.int64]


def decode_cloud(msg: Any, stamp_ns: int, lidar: str) -> Cloud:
    """Return the finite points of a `PointCloud2`.

    The time of each point is read where a field has it: seconds or nanoseconds since the header's stamp, or absolute.

    Raises:
        ValueError: no x, y, z, or fewer bytes than it says.
    """
    order = ">" if msg.is_bigendian else "<"
    fields = {f.name: f for f in msg.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"a cloud without x, y, z (it has: {', '.join(fields) or 'no field'})")
    count = msg.width * msg.height
    raw = np.asarray(msg.data, dtype=np.uint8)
    if len(raw) < msg.row_step * msg.height or msg.point_step * msg.width > msg.row_step:
        raise ValueError(f"a cloud of {count} points with {len(raw)} bytes")
    rows = raw[: msg.row_step * msg.height].reshape(msg.height, msg.row_step)[:, : msg.point_step * msg.width]
    wanted = [n for n in ("x", "y", "z", *_TIME_FIELDS) if n in fields]
    layout = np.dtype({
        "names": wanted, "formats": [order + _FORMATS[fields[n].datatype] for n in wanted],
        "offsets": [fields[n].offset for n in wanted], "itemsize": msg.point_step,
    })  # fmt: skip
    points = np.ascontiguousarray(rows).reshape(-1).view(layout)
    xyz = np.column_stack([points[n].astype(float) for n in "xyz"])
    keep = np.isfinite(xyz).all(axis=1) & (np.abs(xyz).max(axis=1) > 1e-3)  # drivers fill gaps with NaN or zeros
    stamps = np.full(count, stamp_ns, dtype=np.int64)
    timed = next((n for n in wanted if n in _TIME_FIELDS), None)
    if timed is not None:
        stamps = stamp_ns + _since_stamp_ns(points[timed], stamp_ns)
    return Cloud(lidar, stamp_ns, xyz[keep], stamps[keep])


def _since_stamp_ns(time: Any, stamp_ns: int) -> NDArray[np.int64]:
    """What a driver's time field says, as ns since the header's stamp: its unit by its size."""
    whole = time.dtype.kind in "iu"
    value = time.astype(float)
    size = float(np.nanmax(np.abs(value))) if len(value) else 0.0
    if size > 1e17:  # absolute, ns
        return np.asarray(time.astype(np.int64) - stamp_ns)
    if size > 1e8 and not whole:  # absolute, s
        return np.asarray(np.rint((value - stamp_ns * 1e-9) * 1e9), dtype=np.int64)
    for unit_ns in (1, 1000) if whole else (10**9, 10**6, 1000, 1):
        if size * unit_ns <= _LONGEST_TURN_S * 1e9:
            if whole and size * unit_ns < 1e6 and unit_ns == 1:
                continue  # a turn of less than a millisecond: these are microseconds
            return np.asarray(np.nan_to_num(value * unit_ns), dtype=np.int64)
    return np.zeros(len(value), dtype=np.int64)


def level(
    clouds: list[Cloud], mounts: Mapping[str, tuple[Array, Array]], track: Trajectory, at_ns: int, waterline_m: float
) -> LevelCloud:
    """Return the points of clouds in `level` at a time: each from where the track says its LiDAR then was.

    Args:
        mounts: T_body_lidar by name. waterline_m: height of the waterline in body.

    Raises:
        InputError: the track does not cover them.
    """
    stamps = np.concatenate([c.stamps_ns for c in clouds] + [np.array([at_ns])])
    coarse, back = np.unique(stamps // 2_000_000, return_inverse=True)  # every 2 ms is often enough
    times = np.clip(coarse * 2_000_000 + 1_000_000, stamps.min(), stamps.max())
    if not track.covers(times).all():
        raise InputError(f"the track does not cover the scans at {at_ns}")
    poses = track.at(times)
    p0, yaw = poses.p_world_m[back[-1]], float(poses.yaw_rad[back[-1]])
    c, s = np.cos(yaw), np.sin(yaw)
    to_level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    up = p0 + np.array([0.0, 0.0, waterline_m])
    points, origins, begin = [], [], 0
    for cloud in clouds:
        which = back[begin : begin + len(cloud.stamps_ns)]
        begin += len(cloud.stamps_ns)
        t, R = mounts[cloud.lidar]
        Rs, ps = poses.R_world_body[which], poses.p_world_m[which]
        in_world = ps + np.einsum("nij,nj->ni", Rs, cloud.points_m @ R.T + t)
        points.append((in_world - up) @ to_level.T)
        origins.append(((ps + Rs @ t - up) @ to_level.T)[:, :2])
    return LevelCloud(np.vstack(points), np.vstack(origins))
