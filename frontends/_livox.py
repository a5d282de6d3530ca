# SPDX-License-Identifier: Apache-2.0
"""Scans in the messages of Livox's drivers, read from the bytes.

An object for each of 20 000 points would take a hundred times as long.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from graphloc.time import NS_PER_S

LIVOX = tuple(
    f"{package}/msg/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)  # fmt: skip
"""Message types of drivers of the first and second generation, and of the first one's for ROS 2: all of one layout."""

_POINT = (("offset_time", "u4", 6), *((axis, "f4", 7) for axis in "xyz"), ("reflectivity", "u1", 2), ("tag", "u1", 2), ("line", "u1", 2))  # fmt: skip
_POINT_BYTES = 19
_PADDED = 3  # most bytes of padding behind a message in CDR
# Bits of a tag that say noise: by position, by intensity, and by distortion of near returns; for the Mid-360, low
# confidence because of glue between objects, or of rain. The other two bits are the number of a return or, for the
# Mid-360, a confidence: without the model they tell nothing.
_NOISE = 0xCF
_SAME_CLOCK_NS = NS_PER_S


def livox_cloud(data: bytes, *, ros1: bool) -> object:
    """Return a `CustomMsg` as the `PointCloud2` that says the same, without the points whose tag says noise.

    Its stamp is the time of the first point (`timebase`), where that and the header's are on one clock: then the
    header's may be that of the end of the scan. The field `offset_time` counts from there, ns.

    Raises:
        ValueError: another number of points than stated, or of bytes than that number takes.
    """
    try:
        header, timebase_ns, stated, count, begin, order = _head(data, ros1=ros1)
    except (struct.error, IndexError, UnicodeDecodeError):
        raise ValueError(f"a scan cut off in its head, after {len(data)} bytes") from None
    step = _POINT_BYTES if ros1 else _POINT_BYTES + 1  # CDR aligns each point to four bytes
    needed, have = max(step * count - (not ros1), 0), len(data) - begin
    if not needed <= have <= needed + (0 if ros1 else _PADDED + 1):
        raise ValueError(f"a scan of {count} points with {have} bytes")
    if stated != count:
        raise ValueError(f"a scan of {count} points whose point_num is {stated}")
    layout = np.dtype({
        "names": [name for name, _, _ in _POINT], "formats": [order + form for _, form, _ in _POINT],
        "offsets": [*range(0, 16, 4), 16, 17, 18], "itemsize": step,
    })  # fmt: skip
    raw = data[begin : begin + step * count]
    points = np.frombuffer(raw.ljust(step * count, b"\0"), dtype=layout)
    points = points[points["tag"] & _NOISE == 0]
    return _as_cloud(points, *header, timebase_ns)


def _head(data: bytes, *, ros1: bool) -> tuple[tuple[int, str], int, int, int, int, str]:
    """Return what is before the points.

    Returns:
        The header's stamp, ns, and frame; timebase, ns; point_num; the number of points; the index of their first byte;
        the byte order.
    """
    order = "<" if ros1 or data[1] & 1 else ">"
    sec, nanosec, length = struct.unpack_from(f"{order}iII", data, 4)
    at = 16 + length
    frame = data[16:at].rstrip(b"\0").decode()
    if not ros1:
        at += (4 - at) % 8  # aligned to eight bytes, from behind the first four
    timebase_ns, stated = struct.unpack_from(f"{order}QI", data, at)
    (count,) = struct.unpack_from(f"{order}I", data, at + 16)  # after lidar_id and three bytes that are reserved
    return (sec * NS_PER_S + nanosec, frame), timebase_ns, stated, count, at + 20, order


def _as_cloud(points: np.ndarray[Any, Any], stamp_ns: int, frame: str, timebase_ns: int) -> object:
    if stamp_ns > 0 and abs(timebase_ns - stamp_ns) <= _SAME_CLOCK_NS:
        stamp_ns = timebase_ns
    make = _standard()
    layout = points.dtype
    stamp = make["builtin_interfaces/msg/Time"](sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S)
    return make["sensor_msgs/msg/PointCloud2"](
        header=make["std_msgs/msg/Header"](stamp=stamp, frame_id=frame),
        fields=[
            make["sensor_msgs/msg/PointField"](name=name, offset=(layout.fields or {})[name][1], datatype=kind, count=1)
            for name, _, kind in _POINT
        ],
        height=1, width=len(points), point_step=layout.itemsize, row_step=layout.itemsize * len(points),
        is_bigendian=layout["x"].byteorder == ">", data=np.frombuffer(points.tobytes(), np.uint8), is_dense=False,
    )  # fmt: skip


@lru_cache(maxsize=1)
def _standard() -> Any:
    return get_typestore(Stores.LATEST).types
