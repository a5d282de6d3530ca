# SPDX-License-Identifier: Apache-2.0
"""The scans of a bag, matched one after the other around a track."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphloc.config import AerialConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.frontends._source import Bag
from graphloc.frontends._tf import StaticTree
from graphloc.frontends.aerial.cloud import CLOUD, Cloud, decode_cloud, level
from graphloc.frontends.aerial.matcher import Match, Matcher, Prior
from graphloc.frontends.bag import TF_STATIC
from graphloc.frontends.decode import TF, header_stamp_ns
from graphloc.trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """A match and its stamp; or why there is none."""

    stamp_ns: int
    match: Match | None
    why_not: str


def match_bag(
    paths: Sequence[Path],
    config: AerialConfig,
    image: Path,
    body_frame: str,
    track: Trajectory,
    datum: Datum,
    *,
    at_ns: int | None = None,
) -> Iterator[Matched]:
    """Match the scans of a bag around a track, every `config.every_s`; or the one nearest to `at_ns` alone.

    Raises:
        InputError: no LiDAR, a topic that is not there, a mount that no chain leads to, an image that cannot be used.
    """
    matcher = Matcher(config, image, datum)
    last_ns = -(10**18)
    best: tuple[int, list[Cloud]] | None = None
    with Bag(paths) as bag:
        mounts = _mounts(bag, config, body_frame)
        for clouds in _groups(bag, config):
            stamp_ns = max(c.stamp_ns for c in clouds)
            if at_ns is not None:
                if best is None or abs(stamp_ns - at_ns) < abs(best[0] - at_ns):
                    best = (stamp_ns, clouds)
                elif stamp_ns > at_ns:
                    break
                continue
            if stamp_ns - last_ns < config.every_s * 1e9 - 5e7:
                continue
            last_ns = stamp_ns
            yield _one(matcher, clouds, stamp_ns, mounts, track, config)
        if best is not None:
            yield _one(matcher, best[1], best[0], mounts, track, config)


def _one(
    matcher: Matcher,
    clouds: list[Cloud],
    stamp_ns: int,
    mounts: Mapping[str, tuple[Array, Array]],
    track: Trajectory,
    config: AerialConfig,
) -> Matched:
    at_ns = int(np.median(np.concatenate([c.stamps_ns for c in clouds] + [np.array([stamp_ns])])))
    try:
        cloud = level(clouds, mounts, track, at_ns, config.waterline_m)
        pose = track.at(np.array([at_ns]))
        sigma = np.array([1.0, 1.0, np.radians(2.0)])
        if pose.cov is not None:
            sigma = np.sqrt(np.diagonal(pose.cov[0])[[0, 1, 5]])
        prior = Prior(np.array([*pose.p_world_m[0, :2], pose.yaw_rad[0]]), sigma)
        found = matcher.match(cloud, prior)
    except InputError as error:
        return Matched(at_ns, None, str(error))
    return Matched(at_ns, found, found.why_not)


def _mounts(bag: Bag, config: AerialConfig, body_frame: str) -> dict[str, tuple[Array, Array]]:
    if not config.lidars:
        raise InputError("sensors: an aerial sensor needs lidars: name, topic and mount of each")
    for name, lidar in config.lidars.items():
        have = bag.topics.get(lidar.topic)
        if have is None or CLOUD not in have.msgtypes:
            fitting = [t.topic for t in bag.topics.values() if CLOUD in t.msgtypes]
            raise InputError(
                f"{bag.name}: lidars.{name}.topic '{lidar.topic}' holds no PointCloud2; such topics: "
                f"{', '.join(fitting) or 'none'}"
            )
    tree = StaticTree()
    if any(lidar.mount.tf_frame for lidar in config.lidars.values()):
        for raw in bag.messages({TF_STATIC}):
            if raw.msgtype == TF:
                tree.add(bag.decode(raw))
    return {
        name: tree.mount(body_frame, lidar.mount.tf_frame, f"{bag.name}: lidars.{name}.mount.tf_frame")
        if lidar.mount.tf_frame
        else (lidar.mount.t_body_sensor_m, lidar.mount.R_body_sensor)
        for name, lidar in config.lidars.items()
    }


def _groups(bag: Bag, config: AerialConfig) -> Iterator[list[Cloud]]:
    """Scans that belong together: one of each LiDAR, as they arrive."""
    names = {lidar.topic: name for name, lidar in config.lidars.items()}
    group: dict[str, Cloud] = {}
    for raw in bag.messages(set(names)):
        msg = bag.decode(raw)
        stamp_ns = header_stamp_ns(msg)
        if stamp_ns is None:
            continue
        name = names[raw.topic]
        if name in group:
            yield list(group.values())
            group = {}
        group[name] = decode_cloud(msg, stamp_ns, name)
        if len(group) == len(names):
            yield list(group.values())
            group = {}
    if group:
        yield list(group.values())
