# SPDX-License-Identifier: Apache-2.0
"""LiDAR scans of a bag: motion-compensated by the vessel's track, and levelled."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends._livox import LIVOX
from graphloc.frontends.aerial.scan import LevelCloud
from graphloc.recording import Mounts
from graphloc.trajectory import Trajectory

log = logging.getLogger(__name__)

CLOUD = "sensor_msgs/msg/PointCloud2"
CLOUDS = (CLOUD, *LIVOX)
_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField
_TIME_FIELDS = ("time", "t", "timestamp", "offset_time", "time_offset", "time_stamp")
_TIME_LIKE = re.compile(r"time|stamp|(^|_)t(s|_?ns|_?us)?$", re.IGNORECASE)  # what another driver may name them
_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_USUAL_UNIT_S = {"f4": 1.0, "u4": 1e-9}  # since the header: Velodyne's seconds; Ouster's and Livox's nanoseconds
_LONGEST_S = 1.0  # longest time from header to point: scans come at 1 Hz or faster
_SHORTEST_TURN_S = 0.008  # the fastest LiDARs give 100 clouds a second
_PACKET_POINTS = 4096  # most points of a packet (128 beams x 16 columns, both returns)
_SHORTEST_PACKET_S = 0.25e-3  # least duration of a packet; Velodyne's, with both returns, lasts 0.5 ms
_LONGEST_SMALL_S = 0.5  # a small cloud whose times are longer may as well be a packet in a smaller unit
_BIN_NS = 2_000_000  # one pose per 2 ms suffices: 2 cm at 10 m/s
_NEWEST_NS = 10**9
_CHUNK = 1 << 15  # points at a time: their rotations (2 MB) stay in the cache
_said: set[tuple[str, str]] = set()  # warnings that were given: thousands of scans of a bag may have one fault


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A scan as recorded: LiDAR, header's stamp, points (N, 3), m, in the LiDAR's axes, and their stamps (N,), ns."""

    lidar: str
    stamp_ns: int
    points_m: Array
    stamps_ns: NDArray[np.int64]

    def where(self, mask: NDArray[np.bool_]) -> Cloud:
        """Return the cloud with the points of a mask (N,) only."""
        return self if mask.all() else replace(self, points_m=self.points_m[mask], stamps_ns=self.stamps_ns[mask])


def decode_cloud(msg: Any, stamp_ns: int, lidar: str) -> Cloud:
    """Return the finite points of a `PointCloud2`, each with its time if a field has it.

    Times may be s, ms, us or ns, since the header's stamp or absolute, on its clock or another (`_since_header_s`).
    Points with a time more than 1 s from the header's, or not finite, are dropped, since a clamped time would misplace
    them. If no interpretation of the times makes sense, all points get the header's stamp, with one warning. Of fields
    with equal names the first counts (as in PCL).

    Args:
        msg: the message. stamp_ns: of its header. lidar: name.

    Raises:
        ValueError: no x, y, z, a field of unknown type or outside the point, or fewer bytes than stated.
    """
    layout = _layout(msg)
    count = msg.width * msg.height
    points = _rows(msg, count).view(layout)
    with np.errstate(all="ignore"):  # signalling NaNs
        x, y, z = (points[n].astype(float) for n in "xyz")
    # Drivers fill gaps with NaN or zeros. Column by column: numpy takes ten times as long along a short axis.
    keep = np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((abs(x) > 1e-3) | (abs(y) > 1e-3) | (abs(z) > 1e-3))
    xyz = np.column_stack([v[keep] for v in (x, y, z)])
    timed = next((n for n in layout.names or () if n in _TIME_FIELDS), None)
    if timed is None and (unknown := [field.name for field in msg.fields if _TIME_LIKE.search(field.name)]):
        _warn_once(
            lidar,
            f"its points have no field of times that is known ({', '.join(_TIME_FIELDS)}), but {', '.join(unknown)}; all are taken to be "
            "at the header's stamp",
        )
    if timed is None or not len(xyz):
        return Cloud(lidar, stamp_ns, xyz, np.full(len(xyz), stamp_ns, dtype=np.int64))
    since_s = _since_header_s(points[timed][keep], stamp_ns, count, lidar)
    near = np.abs(since_s) <= _LONGEST_S  # false where NaN
    if not near.all():
        xyz, since_s = xyz[near], since_s[near]
    return Cloud(lidar, stamp_ns, xyz, stamp_ns + np.rint(since_s * 1e9).astype(np.int64))


def _layout(msg: Any) -> np.dtype[Any]:
    """Return the fields of a point that are read, coordinates first."""
    fields: dict[str, Any] = {}
    for field in msg.fields:
        fields.setdefault(field.name, field)
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"a cloud without x, y, z (it has: {', '.join(fields) or 'no field'})")
    wanted = [fields[n] for n in ("x", "y", "z", *_TIME_FIELDS) if n in fields]
    for field in wanted:
        if field.datatype not in _FORMATS:
            raise ValueError(f"a cloud whose field '{field.name}' has the unknown datatype {field.datatype}")
        if field.offset + int(_FORMATS[field.datatype][1]) > msg.point_step:
            raise ValueError(
                f"a cloud whose field '{field.name}' at byte {field.offset} lies outside its points of "
                f"{msg.point_step} bytes"
            )
    order = ">" if msg.is_bigendian else "<"
    return np.dtype({
        "names": [f.name for f in wanted], "formats": [order + _FORMATS[f.datatype] for f in wanted],
        "offsets": [f.offset for f in wanted], "itemsize": msg.point_step,
    })  # fmt: skip


def _rows(msg: Any, count: int) -> NDArray[np.uint8]:
    """Return the bytes of all points, one after the other."""
    raw = np.asarray(msg.data, dtype=np.uint8).reshape(-1)
    if len(raw) == msg.point_step * count:  # no padding, whatever row_step says: some drivers leave it 0 or wrong
        return np.ascontiguousarray(raw)
    if len(raw) < msg.row_step * msg.height or msg.point_step * msg.width > msg.row_step:
        raise ValueError(f"a cloud of {count} points with {len(raw)} bytes")
    rows = raw[: msg.row_step * msg.height].reshape(msg.height, msg.row_step)[:, : msg.point_step * msg.width]
    return np.ascontiguousarray(rows).reshape(-1)


def _since_header_s(time: NDArray[Any], stamp_ns: int, count: int, lidar: str) -> Array:
    """Return a driver's time field in s since the header's stamp; 0 if no interpretation makes sense.

    Taken is the first interpretation that fits all values but 1 % at each end:

    1. Since the header, in the usual unit of the field's type, if the latest is within a scan or a packet.
    2. Absolute, in the unit that makes it about as large as the header's stamp. If the two differ by more than 1 s (TAI
       is 37 s ahead of UTC), as in 4.
    3. Since the header, in another unit, if that gives the duration of a scan. The duration of a packet does not count:
       it equals a slow scan in a unit 1000 times smaller; and the header's stamp is right to within a packet.
    4. Absolute on another clock, such as time since boot, in the unit that gives the duration of a scan. Only
       differences are used: the first point is at the header's stamp, as for Ouster, Hesai and Livox (and in
       `LaserScan`, and by Autoware's rules). For RoboSense, whose headers are of the last point, this is wrong by one
       turn.

    Args:
        time: (N,) values of the field. stamp_ns: of the header. count: number of points. lidar: name, for warnings.
    """
    with np.errstate(all="ignore"):  # signalling NaNs; 1e308 in ns
        value = time.astype(float)
        finite = value if np.isfinite(value).all() else value[np.isfinite(value)]
        if not len(finite):
            return _at_header(value, lidar, "not finite")
        low, high = _ends(finite)
        spread, furthest = high - low, max(abs(low), abs(high))
        if furthest == 0.0:
            return np.zeros(len(value))  # the driver does not fill the field
        step = 1.0 if time.dtype.kind in "iu" else float(np.spacing(time.dtype.newbyteorder("=").type(furthest)))
        units = [u for u in _UNITS_S if step * u <= 1e-3]  # whole seconds, or an epoch in float32, are no point times
        longest = _LONGEST_S if count > _PACKET_POINTS else _LONGEST_SMALL_S
        usual = _USUAL_UNIT_S.get(time.dtype.str[1:])
        shortest = _SHORTEST_TURN_S if count > _PACKET_POINTS else _SHORTEST_PACKET_S
        if usual in units and shortest <= furthest * usual <= longest:
            return value * usual
        for unit in units:
            if _is_epoch(low * unit, high * unit, stamp_ns * 1e-9):
                since = (value - stamp_ns * 1e-9 / unit) * unit
                if abs(0.5 * (low + high) * unit - stamp_ns * 1e-9) <= _LONGEST_S:
                    return np.asarray(since)
                return _anchored(value, low, unit, lidar)
        for unit in units:
            # Times since the header begin or end near it: the spread of a short turn long after boot is too small.
            if _SHORTEST_TURN_S <= furthest * unit <= longest and spread >= 0.1 * furthest:
                return value * unit
        for unit in units:
            if _SHORTEST_TURN_S <= spread * unit <= longest:
                return _anchored(value, low, unit, lidar)
    return _at_header(value, lidar, "of no known unit")


def _ends(value: Array) -> tuple[float, float]:
    """Return the smallest and largest value, without 1 % at each end, which may be outliers, of ten values or more."""
    cut = -(-len(value) // 100) if len(value) >= 10 else 0
    ordered = np.partition(value, (cut, len(value) - 1 - cut))
    return float(ordered[cut]), float(ordered[len(value) - 1 - cut])


def _is_epoch(low_s: float, high_s: float, stamp_s: float) -> bool:
    """Return whether times are as large as a stamp, within half of it.

    Not of stamps near zero, where times since the header look the same.
    """
    return (
        stamp_s > 4.0 * _LONGEST_S
        and high_s - low_s <= _LONGEST_S
        and abs(0.5 * (low_s + high_s) - stamp_s) <= 0.5 * stamp_s
    )


def _anchored(value: Array, low: float, unit: float, lidar: str) -> Array:
    _warn_once(lidar, "the times of its points are on another clock; the first point is taken to be at the header's")
    return np.asarray((value - low) * unit)


def _at_header(value: Array, lidar: str, why: str) -> Array:
    _warn_once(lidar, f"the times of its points are {why}; all are taken to be at the header's")
    return np.zeros(len(value))


def _warn_once(lidar: str, text: str) -> None:
    if (lidar, text) not in _said:
        _said.add((lidar, text))
        log.warning("LiDAR %s: %s", lidar, text)


def level(
    clouds: list[Cloud],
    mounts: Mounts,
    track: Trajectory,
    at_ns: int,
    waterline_m: float,
    others: Sequence[Sequence[Cloud]] = (),
) -> LevelCloud:
    """Return the points of clouds in `level` at a time, with each LiDAR placed by the track at the time of the point.

    Points that the track does not cover are omitted. For all others,
    p_level = R_level_world (p_world_body + R_world_body (R_body_lidar p_lidar + t_body_lidar) - p_world_level),
    with the pose of the body at the middle of the 2 ms that contain the point.

    Args:
        clouds: of the newest turns. mounts: T_body_lidar by name. track: of the body. at_ns: time of `level`.
        waterline_m: height of the waterline in body. others: clouds of each other turn.

    Raises:
        InputError: the track does not cover `at_ns`, or no point of the clouds that are stamped within 1 s of it.
    """
    newest = [k for k, c in enumerate(clouds) if abs(c.stamp_ns - at_ns) <= _NEWEST_NS]
    names = ", ".join(dict.fromkeys(c.lidar for c in ([clouds[k] for k in newest] or clouds))) or "no LiDAR"
    if not track.covers(np.array([at_ns])).all():
        raise InputError(f"the track does not cover the scan of {names}: {_outside(track, at_ns)}")
    kept, times, rows, here = _covered([*clouds, *(c for turn in others for c in turn)], track, at_ns)
    had = [clouds[k].stamps_ns for k in newest if len(clouds[k].stamps_ns)]
    if had and not any(len(kept[k].stamps_ns) for k in newest):
        raise InputError(
            f"the track does not cover the scan of {names}: {_outside(track, int(np.median(np.concatenate(had))))}"
        )
    poses = track.at(times)
    yaw = float(poses.yaw_rad[here])
    c, s = np.cos(yaw), np.sin(yaw)
    to_level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    up = poses.p_world_m[here] + np.array([0.0, 0.0, waterline_m])
    points, origins = np.empty((sum(len(r) for r in rows), 3)), []
    begin = 0
    for cloud, row in zip(kept, rows, strict=True):
        t, R = mounts[cloud.lidar]
        origin = (poses.p_world_m + poses.R_world_body @ t - up) @ to_level.T
        _move(cloud.points_m, to_level @ poses.R_world_body @ R, origin, row, points[begin : begin + len(row)])
        origins.append(origin[:, :2].take(row, axis=0))
        begin += len(row)
    return LevelCloud(
        points,
        np.vstack([*origins, np.empty((0, 2))]),
        now=sum(len(c.stamps_ns) for c in kept[: len(clouds)]),
        turns=1 + len(others),
    )


def _covered(
    clouds: Sequence[Cloud], track: Trajectory, at_ns: int
) -> tuple[list[Cloud], NDArray[np.int64], list[NDArray[np.int64]], int]:
    """Return the points that a track covers, and when they were seen, to 2 ms.

    Returns:
        The clouds with these points only; the distinct times (T,), ns; for each cloud, the index of each point's time;
        the index of `at_ns`.
    """
    kept = [_during(c, track) for c in clouds]
    bins, rows = _shared_bins([*(c.stamps_ns // _BIN_NS for c in kept), np.array([at_ns // _BIN_NS])])
    times = np.clip(bins * _BIN_NS + _BIN_NS // 2, track.stamps_ns[0], track.stamps_ns[-1])
    covered = track.covers(times)
    covered[rows[-1]] = True
    if not covered.all():  # a gap of the track
        kept = [c.where(covered[r]) for c, r in zip(kept, rows[:-1], strict=True)]
        renumbered = np.cumsum(covered) - 1
        rows = [renumbered[r[covered[r]]] for r in rows]
        times = times[covered]
    return kept, times, rows[:-1], int(rows[-1][0])


def _move(points: Array, R: Array, t: Array, row: NDArray[np.int64], out: Array) -> None:
    """Write R[row] points + t[row] into out (N, 3), in chunks: a rotation matrix per point takes 72 bytes."""
    for k in range(0, len(points), _CHUNK):
        part = slice(k, k + _CHUNK)
        np.einsum("nij,nj->ni", R.take(row[part], axis=0), points[part], out=out[part])
        out[part] += t.take(row[part], axis=0)


def _during(cloud: Cloud, track: Trajectory) -> Cloud:
    return cloud.where((cloud.stamps_ns >= track.stamps_ns[0]) & (cloud.stamps_ns <= track.stamps_ns[-1]))


def _shared_bins(numbers: list[NDArray[np.int64]]) -> tuple[NDArray[np.int64], list[NDArray[np.int64]]]:
    """Return the distinct numbers of several arrays, ascending, and for each array the indices of its values in them.

    It is like `np.unique` without sorting. The numbers are within a track, so a table of their range is small.
    """
    some = [n for n in numbers if len(n)]
    first, last = min(int(n.min()) for n in some), max(int(n.max()) for n in some)
    seen = np.zeros(last - first + 1, dtype=bool)
    for n in some:
        seen[n - first] = True
    place = np.cumsum(seen) - 1
    return np.flatnonzero(seen) + first, [place[n - first] for n in numbers]


def _outside(track: Trajectory, stamp_ns: int) -> str:
    first, last = int(track.stamps_ns[0]), int(track.stamps_ns[-1])
    if stamp_ns > last:
        return f"the scan lies {(stamp_ns - last) / 1e9:.1f} s after the end of the track"
    if stamp_ns < first:
        return f"the scan lies {(first - stamp_ns) / 1e9:.1f} s before the start of the track"
    right = int(np.clip(np.searchsorted(track.stamps_ns, stamp_ns), 1, len(track) - 1))
    gap_s = int(track.stamps_ns[right] - track.stamps_ns[right - 1]) / 1e9
    return f"the scan lies in a gap of {gap_s:.1f} s of the track"
