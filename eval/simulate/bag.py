# SPDX-License-Identifier: Apache-2.0
"""Write a simulated run as a recording: a bag of standard messages, its vessel.yaml, image and survey."""

from __future__ import annotations

import dataclasses
import heapq
import json
import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from ruamel.yaml import YAML
from threadpoolctl import threadpool_limits

from graphloc.config import effective
from graphloc.eval.simulate._messages import TF, Messages
from graphloc.eval.simulate._run import SimulatedRun
from graphloc.eval.simulate.aerial import render
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.docks import survey, tag_pose
from graphloc.eval.simulate.lidar import scan
from graphloc.eval.simulate.rig import RigCamera, RigLidar
from graphloc.eval.simulate.scene import Scene, scene_of
from graphloc.folders import fresh_folder
from graphloc.measurements import BodyVelocity, CompassHeading, GnssPosition, PoseFix
from graphloc.recording import Progress, quiet

_LATENCY_NS = {
    "/imu/data": 2_000_000,
    "/gnss/fix": 60_000_000,
    "/gnss/heading": 60_000_000,
    "/matcher/pose": 400_000_000,
}
_DRIVER_NS = 30_000_000  # latency of a LiDAR's driver, from the end of a turn
_IMAGE_LATENCY_NS = 80_000_000
_TRUTH_HZ = 20.0
_ALWAYS = QosTime(2147483647, 4294967295)
_LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, _ALWAYS, _ALWAYS, QosLiveliness.AUTOMATIC,
    _ALWAYS, False,
)  # fmt: skip
_CONFIG, _AERIAL, _TAGS, TRUTH = "vessel.yaml", "aerial.tif", "tags.yaml", "truth.json"


class _Item(NamedTuple):
    """A message: stamp of its recording, topic, type and content."""

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
    progress: Progress = quiet,
) -> tuple[Path, Path]:
    """Write `run` into `folder`; return the paths of the bag and of its vessel.yaml.

    Header stamps are the sensors'; log stamps are later by each sensor's latency. A pose message holds one mode, the
    first. A run in a harbour gets its aerial image and the survey of its tags, and scans and images if the scenario has
    them. Scans and images are rendered while the bag is written, a few at a time, so memory does not grow with the run.

    Raises:
        OutputError: the folder exists, or cannot be written.
    """
    with fresh_folder(folder, overwrite=overwrite, mark=TRUTH) as fresh:
        bag = _write(run, fresh, ros, storage, progress)
    return folder / bag, folder / _CONFIG


def _write(run: SimulatedRun, folder: Path, ros: int, storage: str, progress: Progress) -> str:
    """Fill a folder; return the name of the bag in it."""
    config = run.config
    if run.harbour is not None:
        config = config.model_copy(update={"output": config.output.model_copy(update={"map_image": _AERIAL})})
    with (folder / _CONFIG).open("w", encoding="utf-8") as stream:
        YAML(typ="safe", pure=True).dump(effective(config, defaults=False), stream)
    _beside(run, folder)
    make = Messages(ros)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    serialize = make.store.serialize_ros1 if ros == 1 else make.store.serialize_cdr
    start, whole_s = _start_ns(run), round(run.scenario.duration_s)
    bag = folder / ("run.bag" if ros == 1 else "run")
    writing = Writer1(bag) if ros == 1 else Writer2(bag, version=9, storage_plugin=plugin)
    # BLAS's own threads spin on our small products: without them, images take half the time.
    with threadpool_limits(1, user_api="blas"), writing as writer:
        connections: dict[str, Any] = {}
        done_s = 0
        for item in heapq.merge(_small(run, make), *_seen(run, make), key=lambda item: item.log_ns):
            if item.topic not in connections:
                connections[item.topic] = _connect(writer, item, make)
            writer.write(connections[item.topic], item.log_ns, serialize(item.message, item.kind))
            if (item.log_ns - start) // 10**9 > done_s:
                done_s = min((item.log_ns - start) // 10**9, whole_s)
                progress("writing the bag", done_s, whole_s)
    return bag.name


def _connect(writer: Writer1 | Writer2, item: _Item, make: Messages) -> Any:
    """Announce a topic. Mounts are latched, as drivers publish them, so that late subscribers get them."""
    latched = item.topic == "/tf_static"
    if isinstance(writer, Writer1):
        return writer.add_connection(item.topic, item.kind, typestore=make.store, latching=1 if latched else None)
    return writer.add_connection(
        item.topic, item.kind, typestore=make.store, offered_qos_profiles=[_LATCHED] if latched else []
    )


def _start_ns(run: SimulatedRun) -> int:
    return int(run.truth.stamps_ns[0])


def _beside(run: SimulatedRun, folder: Path) -> None:
    """Write the aerial image, the survey of the tags, and truth that only a simulator has."""
    secret: dict[str, Any] = {
        "seed": run.seed,
        "scenario": {k: v for k, v in dataclasses.asdict(run.scenario).items() if v != float("inf")},
    }
    if run.harbour is not None:
        image = render(run.harbour, run.seed)
        image.write(folder / _AERIAL)
        secret["image_shows_things_east_north_m"] = [round(float(v), 4) for v in image.shift_m]
        tags = run.harbour.config.tags
        secret["tags"] = {
            tag.number: {"frame": tag.dock or "world", "xyz_m": p.tolist(), "R": R.round(12).tolist()}
            for tag in tags
            for p, R in [tag_pose(tag, run.harbour)]
        }
        if tags:
            with (folder / _TAGS).open("w", encoding="utf-8") as stream:
                YAML(typ="safe", pure=True).dump(survey(run.harbour, np.random.default_rng([run.seed, 23])), stream)
    (folder / TRUTH).write_text(json.dumps(secret, indent=1) + "\n", encoding="utf-8")


def _seen(run: SimulatedRun, make: Messages) -> list[Iterator[_Item]]:
    """Return iterators over scans and images, if the run has any."""
    lidars, cameras = _lidars(run), _cameras(run)
    if not (lidars or cameras):
        return []
    scene = scene_of(run)
    found = [_images(run, make, scene, name) for name in cameras]
    return [_clouds(run, make, scene), *found] if lidars else found


def _lidars(run: SimulatedRun) -> dict[str, RigLidar]:
    """Return the LiDARs whose scans are in the bag."""
    return run.rig.lidars if run.harbour is not None and run.scenario.lidar_hz > 0.0 else {}


def _cameras(run: SimulatedRun) -> dict[str, RigCamera]:
    """Return the cameras whose images are in the bag."""
    return run.rig.cameras if run.harbour is not None and run.scenario.camera_hz > 0.0 else {}


def _clouds(run: SimulatedRun, make: Messages, scene: Scene) -> Iterator[_Item]:
    """Yield LiDAR scans in order; all LiDARs turn together."""
    rng = np.random.default_rng([run.seed, 14])
    for k in range(int((run.scenario.duration_s - 0.2) * run.scenario.lidar_hz)):
        t = k / run.scenario.lidar_hz
        stamp = _start_ns(run) + round(t * 1e9)
        for name, lidar in run.rig.lidars.items():
            cloud = make.cloud(stamp, scan(name, lidar, scene, run.motion, t, rng))
            yield _Item(
                stamp + round(lidar.scan_s * 1e9) + _DRIVER_NS, f"/{name}/points", "sensor_msgs/msg/PointCloud2", cloud
            )


def _images(run: SimulatedRun, make: Messages, scene: Scene, name: str) -> Iterator[_Item]:
    """Yield a camera's images in order, each with its `CameraInfo`; some are rendered ahead, one per core."""
    s, config, frame = run.scenario, run.rig.cameras[name], f"{name}_optical_frame"
    camera = Camera(name, scene, run)

    def take(k: int) -> list[_Item]:
        t = (k + 0.3) / s.camera_hz
        stamp = _start_ns(run) + round(t * 1e9)
        log_ns = stamp + _IMAGE_LATENCY_NS
        kind, image = make.image(stamp, frame, camera.take(t, k).pixels, s.camera_raw)
        topic = f"/{name}/image_raw" if s.camera_raw else f"/{name}/image_raw/compressed"
        info = make.camera_info(stamp, frame, config)
        return [
            _Item(log_ns, topic, kind, image),
            _Item(log_ns, f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", info),
        ]

    workers = len(os.sched_getaffinity(0))
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[Future[list[_Item]]] = deque()
        for k in range(int((s.duration_s - 0.2) * s.camera_hz)):
            ahead.append(pool.submit(take, k))
            if len(ahead) > 2 * workers:
                yield from ahead.popleft().result()
        while ahead:
            yield from ahead.popleft().result()


def _small(run: SimulatedRun, make: Messages) -> list[_Item]:
    """Return all messages but scans and images, by recording time."""
    items: list[_Item] = [_Item(_start_ns(run), "/tf_static", TF, make.mounts(_start_ns(run), _mounts(run)))]

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
        elif isinstance(m, BodyVelocity):
            add(m.stamp_ns, "/log/velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", make.speed(m))
        elif isinstance(m, PoseFix):
            add(m.stamp_ns, "/matcher/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", make.pose(m))
    return sorted([*items, *_truth(run, make)], key=lambda item: item.log_ns)


def _truth(run: SimulatedRun, make: Messages) -> Iterator[_Item]:
    """Yield the true poses of the vessel and of each dock, as odometry."""
    t = np.arange(round(run.scenario.duration_s * _TRUTH_HZ)) / _TRUTH_HZ
    stamps = (_start_ns(run) + np.rint(t * 1e9).astype(np.int64)).tolist()
    for stamp, p, R, v in zip(stamps, *run.motion.pose(t), strict=True):
        yield _Item(stamp, "/truth", "nav_msgs/msg/Odometry", make.odometry(stamp, p, R, v))
    for dock in run.docks:
        at, turned = dock.pose(t)
        for stamp, p, R, v in zip(stamps, at, turned, np.gradient(at, 1.0 / _TRUTH_HZ, axis=0), strict=True):
            message = make.odometry(stamp, p, R, v, child=dock.dock.name)
            yield _Item(stamp, f"/truth/{dock.dock.name}", "nav_msgs/msg/Odometry", message)


def _mounts(run: SimulatedRun) -> dict[str, Any]:
    """Return the mount in body of each sensor whose messages are in the bag, by frame."""
    found = {"imu_link": run.rig.imu, "gnss": run.rig.gnss}
    found |= {name: lidar.mount for name, lidar in _lidars(run).items()}
    found |= {f"{name}_optical_frame": camera.mount for name, camera in _cameras(run).items()}
    return {frame: (mount.t_body_sensor_m, mount.R_body_sensor) for frame, mount in found.items()}
