# SPDX-License-Identifier: Apache-2.0
"""What a fuzzer starts from: two short simulated runs as raw messages, and bags of every kind made of them."""

from __future__ import annotations

import shutil
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _rows import ROOT
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML

from graphloc.eval.simulate import find_scenario, simulate
from graphloc.eval.simulate.bag import write_bag as write_simulated

sys.path.append(str(ROOT))
from tests.bagfactory import Messages, write_bag

NAV, SEE = "nav", "see"
KINDS = ("mcap", "sqlite3", "ros1")
_LATEST_NS = {"mcap": 2**64 - 1, "sqlite3": 2**63 - 1, "ros1": 2**32 * 10**9 - 1}  # that a format can write
COMPRESSIONS = {"mcap": ("", "storage"), "sqlite3": ("", "message", "file"), "ros1": ("", "bz2", "lz4")}
_FEW = {"imu_hz": "25", "gnss_hz": "2", "compass_hz": "2"}
_LIDAR, _POINTS = "/lidar_1/points", 3000
_CLOUD = "sensor_msgs/msg/PointCloud2"


@dataclass(frozen=True, slots=True)
class Raw:
    """A message as recorded, in ROS 2's serialisation."""

    topic: str
    log_ns: int
    msgtype: str
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """A run: its messages, its vessel.yaml as a tree, and the folder with the files that it names."""

    folder: Path
    raws: tuple[Raw, ...]
    tree: Mapping[str, Any]


def stores() -> dict[int, Messages]:
    """Types of both ROS versions."""
    made = {1: Messages(1), 2: Messages(2)}
    for messages in made.values():
        messages.transforms([])
    return made


def bases(folder: Path) -> dict[str, Base]:
    """Make, or read again, the runs in a folder: 8 s along a quay, and 8 s with one LiDAR and a camera."""
    wanted = {
        NAV: ("bl1-drift", {"lidar_hz": "0", "duration_s": "8", **_FEW}),
        SEE: ("dock-fixed-optimal", {"duration_s": "8", "lidar_hz": "0.4", "camera_hz": "0.5", **_FEW}),
    }
    found = {}
    for name, (scenario, changes) in wanted.items():
        if not (folder / name / "vessel.yaml").exists():
            write_simulated(simulate(find_scenario(scenario, changes), 0), folder / name, ros=2, overwrite=True)
        found[name] = _base(folder / name)
    return found


def _base(folder: Path) -> Base:
    messages = Messages(2)
    raws = []
    with Reader(folder / "run") as reader:
        for connection, log_ns, data in reader.messages():
            if connection.msgtype == _CLOUD and connection.topic != _LIDAR:
                continue
            body = _thinned(messages, data) if connection.msgtype == _CLOUD else bytes(data)
            raws.append(Raw(connection.topic, log_ns, connection.msgtype, body))
    tree = YAML(typ="safe", pure=True).load((folder / "vessel.yaml").read_text())
    aerial = tree["sensors"].get("aerial", {})
    if aerial.get("lidars"):
        aerial |= {"lidars": {"one": aerial["lidars"]["lidar_1"]}, "every_s": 2.0}
    return Base(folder, tuple(raws), tree)


def _thinned(messages: Messages, data: bytes) -> bytes:
    msg = messages.store.deserialize_cdr(data, _CLOUD)
    points = msg.data.reshape(-1, msg.point_step)
    kept = points[:: max(1, len(points) // _POINTS)]
    msg.width, msg.height, msg.row_step, msg.data = len(kept), 1, kept.size, np.ascontiguousarray(kept).ravel()
    return bytes(messages.store.serialize_cdr(msg, _CLOUD))


def put_bag(path: Path, types: Mapping[int, Messages], raws: Iterable[Raw], kind: str, compression: str) -> Path:
    """Write messages as a bag; returns its path."""
    make = types[1 if kind == "ros1" else 2]
    convert = make.store.cdr_to_ros1 if kind == "ros1" else None
    items = []
    for raw in raws:
        try:
            data = bytes(convert(raw.data, raw.msgtype)) if convert else raw.data
        except Exception:  # noqa: BLE001 - bytes that are no message stay what they are
            data = raw.data
        items.append((raw.topic, min(raw.log_ns, _LATEST_NS[kind]), (raw.msgtype, data)))
    return write_bag(path.with_suffix(".bag") if kind == "ros1" else path, make, items, kind, compression)


def counted(raws: Iterable[Raw]) -> Counter[str]:
    """Messages of each topic."""
    return Counter(raw.topic for raw in raws)


def put_files(base: Base, room: Path) -> None:
    """Copy what a vessel.yaml names."""
    for name in ("aerial.tif", "tags.yaml"):
        if (base.folder / name).exists():
            shutil.copyfile(base.folder / name, room / name)


def put_config(tree: Mapping[str, Any], path: Path) -> Path:
    """Write a vessel.yaml."""
    with path.open("w", encoding="utf-8") as stream:
        YAML(typ="safe", pure=True).dump(dict(tree), stream)
    return path
