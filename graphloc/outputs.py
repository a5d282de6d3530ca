# SPDX-License-Identifier: Apache-2.0
"""The run folder: solution.csv, .tum, .mcap, track.geojson, ledger.csv, slow.csv, run.json, effective config.

They are written into a folder of `folders.fresh_folder`, so an interrupted run leaves nothing half-written. Columns and units:
docs/outputs.md.
"""

from __future__ import annotations

import csv
import importlib.metadata
import json
import platform
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from graphloc.berths import BerthTrack
from graphloc.chi2 import SIGMAS_95
from graphloc.config import VesselConfig, effective
from graphloc.frames import Array
from graphloc.ledger import LedgerRow
from graphloc.plain import plain
from graphloc.recording import Span
from graphloc.solution import LOST_BOUND_M, Solution
from graphloc.time import NS_PER_S, seconds_text, utc_text
from graphloc.trajectory import bounds_95

_NO_FIX, _FIX = -1, 0  # of NavSatStatus
MARK = "run.json"  # a folder with this file is ours to replace


def write_run(
    folder: Path,
    solution: Solution,
    config: VesselConfig,
    *,
    inputs: Mapping[str, str],
    command: str,
    metrics: Mapping[str, Any],
    warnings: Sequence[str] = (),
    span: Span | None = None,
) -> None:
    """Write all files of a run but the report into an existing folder.

    Args:
        folder: to write into. solution: what to write. config: written in its effective form, with mounts in numbers.
        inputs: SHA-256 of each input. command: the command line. metrics: tables as plain data.
        warnings: all that the report shows. span: the part of the bag that the run is; None: the whole.
    """
    picked = thinned(solution.trajectory.stamps_ns, config.output.rate_hz)
    _csv(folder / "solution.csv", _solution_columns(solution), _solution_rows(solution, picked))
    _tum(folder / "solution.tum", solution, picked)
    if config.output.bag:
        _bag(folder / "solution_bag", solution, picked, config.body_frame)
    _geojson(folder / "track.geojson", solution, picked)
    _csv(folder / "ledger.csv", _LEDGER_COLUMNS, (_ledger_row(row) for row in solution.ledger))
    _csv(folder / "slow.csv", ("sensor", "name", "utc", "stamp_ns", "axis", "value", "sigma", "unit"), _slow(solution))
    for name, berth in _berth_files(solution).items():
        _csv(folder / name, _BERTH_COLUMNS, _berth_rows(berth))
    with (folder / "vessel.effective.yaml").open("w", encoding="utf-8") as stream:
        YAML(typ="safe", pure=True).dump(effective(config), stream)
    _run_json(folder / MARK, solution, config, inputs, command, metrics, warnings, span)


def thinned(stamps: NDArray[np.int64], rate_hz: float) -> Array:
    """Return the indices of the states to write: at most `rate_hz` per second, and the last one."""
    # States move onto stamps of measurements, by under half a period.
    slot = np.rint((stamps - stamps[0]) * 1e-9 * rate_hz).astype(np.int64)
    picked = np.flatnonzero(np.diff(slot, prepend=-1) > 0)
    return np.unique(np.append(picked, len(stamps) - 1))


def _csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(rows)


def _solution_columns(solution: Solution) -> list[str]:
    fixed = (
        "utc stamp_ns latitude_deg longitude_deg height_m east_m north_m up_m heading_deg roll_deg pitch_deg "
        "v_east_mps v_north_mps v_up_mps bound95_horizontal_m bound95_height_m bound95_heading_deg health health_reason"
    )
    return [*fixed.split(), *(f"since_agreed_{name}_s" for name in solution.since_agreed_s)]


def _solution_rows(solution: Solution, picked: Array) -> Iterator[list[object]]:
    track = solution.trajectory
    assert track.cov is not None
    assert track.v_world_mps is not None
    geodetic = solution.datum.geodetic_from_enu(track.p_world_m[picked])
    rpy = np.degrees(track.rpy_rad[picked])
    heading = solution.datum.true_heading_deg(track.yaw_rad[picked], track.p_world_m[picked])
    bound = bounds_95(track.cov[picked])
    for i, k in enumerate(picked):
        stamp = int(track.stamps_ns[k])
        yield [
            utc_text(stamp),
            stamp,
            *(f"{v:.9f}" for v in geodetic[i, :2]),
            f"{geodetic[i, 2]:.4f}",
            *(f"{v:.4f}" for v in track.p_world_m[k]),
            f"{heading[i]:.4f}",
            *(f"{v:.4f}" for v in rpy[i, :2]),
            *(f"{v:.4f}" for v in track.v_world_mps[k]),
            *(f"{v:.4f}" for v in bound[i]),
            solution.health[k].value,
            solution.health_reason[k].text,
            *(f"{since[k]:.3f}" for since in solution.since_agreed_s.values()),
        ]


def _tum(path: Path, solution: Solution, picked: Array) -> None:
    track = solution.trajectory
    quaternions = Rotation.from_matrix(track.R_world_body[picked]).as_quat()
    with path.open("w", encoding="ascii") as stream:
        for k, q in zip(picked, quaternions, strict=True):
            values = " ".join(f"{v:.9f}" for v in (*track.p_world_m[k], *q))
            stream.write(f"{seconds_text(int(track.stamps_ns[k]))} {values}\n")


def _bag(path: Path, solution: Solution, picked: Array, body_frame: str) -> None:
    """A ROS 2 bag (MCAP): nav_msgs/Odometry, map -> body, and NavSatFix for map panels."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    track = solution.trajectory
    assert track.cov is not None
    assert track.v_world_mps is not None
    geodetic = solution.datum.geodetic_from_enu(track.p_world_m[picked])
    quaternions = Rotation.from_matrix(track.R_world_body[picked]).as_quat()
    bounds_m = bounds_95(track.cov)[:, 0]
    point, vector, quaternion = (t[f"geometry_msgs/msg/{n}"] for n in ("Point", "Vector3", "Quaternion"))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        odometry = writer.add_connection("/graphloc/odometry", "nav_msgs/msg/Odometry", typestore=store)
        fix = writer.add_connection("/graphloc/fix", "sensor_msgs/msg/NavSatFix", typestore=store)
        for i, k in enumerate(picked):
            stamp = int(track.stamps_ns[k])
            R = track.R_world_body[k]
            time = t["builtin_interfaces/msg/Time"](sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S)
            twist_cov = np.zeros((6, 6))
            twist_cov[:3, :3], twist_cov[3:, 3:] = R.T @ solution.v_cov[k] @ R, solution.gyro_cov[k]
            message = t["nav_msgs/msg/Odometry"](
                header=t["std_msgs/msg/Header"](stamp=time, frame_id="map"),
                child_frame_id=body_frame,
                pose=t["geometry_msgs/msg/PoseWithCovariance"](
                    pose=t["geometry_msgs/msg/Pose"](
                        position=point(*map(float, track.p_world_m[k])),
                        orientation=quaternion(*map(float, quaternions[i])),
                    ),
                    covariance=np.ascontiguousarray(track.cov[k]).reshape(36),
                ),
                twist=t["geometry_msgs/msg/TwistWithCovariance"](
                    twist=t["geometry_msgs/msg/Twist"](
                        linear=vector(*map(float, R.T @ track.v_world_mps[k])),
                        angular=vector(*map(float, solution.gyro_radps[k])),
                    ),
                    covariance=twist_cov.reshape(36),
                ),
            )
            writer.write(odometry, stamp, store.serialize_cdr(message, "nav_msgs/msg/Odometry"))
            status = t["sensor_msgs/msg/NavSatStatus"](
                status=_NO_FIX if bounds_m[k] > LOST_BOUND_M else _FIX, service=1
            )
            position = t["sensor_msgs/msg/NavSatFix"](
                header=t["std_msgs/msg/Header"](stamp=time, frame_id=body_frame),
                status=status,
                latitude=float(geodetic[i, 0]),
                longitude=float(geodetic[i, 1]),
                altitude=float(geodetic[i, 2]),
                position_covariance=np.ascontiguousarray(track.cov[k][:3, :3]).reshape(9),
                position_covariance_type=3,
            )
            writer.write(fix, stamp, store.serialize_cdr(position, "sensor_msgs/msg/NavSatFix"))


def _geojson(path: Path, solution: Solution, picked: Array) -> None:
    """RFC 7946: the track as a line, longitude first; as several where it crosses the date line."""
    geodetic = solution.datum.geodetic_from_enu(solution.trajectory.p_world_m[picked])
    cut = _cut(geodetic[:, [1, 0, 2]])
    lines = [[[round(lon, 9), round(lat, 9), round(h, 3)] for lon, lat, h in part.tolist()] for part in cut]
    one = len(lines) == 1
    stamps = solution.trajectory.stamps_ns
    properties = {
        "name": "graphloc",
        "start": utc_text(int(stamps[0])),
        "end": utc_text(int(stamps[-1])),
        "stroke": "#0072B2",
    }
    feature = {
        "type": "Feature",
        "geometry": {
            "type": "LineString" if one else "MultiLineString",
            "coordinates": lines[0] if one else lines,
        },
        "properties": properties,
    }
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")


def _cut(places: Array) -> list[Array]:
    """Longitudes, latitudes and heights (N, 3) in parts that end and begin on the date line (RFC 7946, 3.1.9)."""
    parts, begin, first = [], places[:0], 0
    for k in np.flatnonzero(np.abs(np.diff(places[:, 0])) > 180.0).tolist():
        side = float(np.copysign(180.0, places[k, 0]))
        step = places[k + 1] - places[k] + [2.0 * side, 0.0, 0.0]
        met = places[k] + step * ((side - places[k, 0]) / step[0] if step[0] else 0.0)
        parts.append(np.vstack([begin, places[first : k + 1], met]))
        begin, first = met[None] * [0.0, 1.0, 1.0] - [side, 0.0, 0.0], k + 1
    return [*parts, np.vstack([begin, places[first:]])]


_LEDGER_COLUMNS = ["utc", *(f.name for f in fields(LedgerRow))]


def _ledger_row(row: LedgerRow) -> list[object]:
    values = [getattr(row, f.name) for f in fields(LedgerRow)]
    text = [f"{v:.4f}" if isinstance(v, float) else "" if v is None else v for v in values]
    return [utc_text(row.stamp_ns) if row.stamp_ns else "", *text]


def _slow(solution: Solution) -> Iterator[list[object]]:
    for sensor, slow in solution.slow.items():
        for stamp, value, sigma in zip(slow.stamps_ns.tolist(), slow.value, slow.sigma, strict=True):
            for axis, v, s, unit in zip(slow.axes, value, sigma, slow.units, strict=True):
                yield [sensor, slow.name, utc_text(stamp), stamp, axis, f"{v:.4f}", f"{s:.4f}", unit]


_BERTH_COLUMNS = (
    "utc", "stamp_ns", "across_m", "along_m", "angle_deg", "across_mps", "along_mps", "turn_degps", "bound95_across_m",
    "bound95_along_m", "bound95_angle_deg",
)  # fmt: skip


def _berth_files(solution: Solution) -> dict[str, BerthTrack]:
    """Return the file names of the berths; characters that a file system may refuse become dashes."""
    files: dict[str, BerthTrack] = {}
    for berth in solution.berths:
        name = re.sub(r"[^\w-]+", "-", berth.berth.name)
        twice = sum(file.startswith((f"berth_{name}.", f"berth_{name}~")) for file in files)
        files[f"berth_{name}{f'~{twice + 1}' if twice else ''}.csv"] = berth
    return files


def _berth_rows(track: BerthTrack) -> Iterator[list[object]]:
    assert track.cov is not None
    bound = SIGMAS_95 * np.sqrt(np.diagonal(track.cov, axis1=1, axis2=2))
    to_deg = np.array([1.0, 1.0, 180.0 / np.pi])
    columns = np.hstack([track.value * to_deg, track.rate * to_deg, bound * to_deg])
    for stamp, row in zip(track.stamps_ns.tolist(), columns, strict=True):
        yield [utc_text(stamp), stamp, *(f"{v:.4f}" for v in row)]


def _run_json(
    path: Path,
    solution: Solution,
    config: VesselConfig,
    inputs: Mapping[str, str],
    command: str,
    metrics: Mapping[str, Any],
    warnings: Sequence[str],
    span: Span | None,
) -> None:
    names = ("graphloc", "gtsam", "numpy", "scipy", "rosbags", "pyproj")
    run = {
        "command": command,
        "inputs_sha256": dict(inputs),
        "part": None if span is None else asdict(span),
        "versions": {"python": platform.python_version(), **{n: importlib.metadata.version(n) for n in names}},
        "datum": solution.datum.origin._asdict(),
        "stats": asdict(solution.stats),
        "warnings": list(warnings),
        "ledger": solution.ledger.counts(),
        "ledger_total": len(solution.ledger),
        "metrics": dict(metrics),
        "config": effective(config),
    }
    path.write_text(json.dumps(plain(run), indent=2), encoding="utf-8")
