# SPDX-License-Identifier: Apache-2.0
"""LiDARs and cameras of a bag: which topics are to be read, how they are mounted, and why others are left out."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphloc.frames import rotation_from_rpy_deg, rpy_from_rotation
from graphloc.frontends._assess import vec
from graphloc.frontends._contents import Contents, FirstMessage
from graphloc.frontends._reports import MountedTopic, Vec
from graphloc.frontends._tf import WORLD_NAMES
from graphloc.frontends.tags.listed import LISTS
from graphloc.frontends.tags.sightings import INFO, camera_info_topic, is_rectified

# Topics of clouds that were made from other clouds; then of depth cameras and radars.
_DERIVED = re.compile(r"filter|crop|voxel|sampl|ground|cluster|segment|obstacle|register|skew|second", re.IGNORECASE)
_NO_LIDAR = re.compile(r"depth|radar|stereo", re.IGNORECASE)
_LOOKS_AHEAD_DEG = np.array([-90.0, 0.0, -90.0])  # roll, pitch, yaw of an optical frame that looks ahead
_SKY = 0.7  # upward component of an optical axis from which no tag is seen


def lidars_of(bag: Contents) -> tuple[MountedTopic, ...]:
    """Return the topics of clouds; of those in one LiDAR's frame, one is to be read, of those in a world frame none."""
    lidars, body = _mounted(bag, bag.lidars), bag.tree.body()
    first: dict[str, str] = {}
    for lidar in sorted(lidars, key=lambda m: (bool(_DERIVED.search(m.topic)), len(m.topic))):
        if lidar.frame_id not in ("", body):  # clouds of several LiDARs may have been transformed to body
            first.setdefault(lidar.frame_id, lidar.topic)

    def why_not(lidar: MountedTopic) -> str:
        if lidar.frame_id in WORLD_NAMES:
            return f"in the frame '{lidar.frame_id}', where a program placed it: no LiDAR's own axes"
        if _NO_LIDAR.search(lidar.topic):
            return "by its name of no LiDAR; its range and noise are others"
        other = first.get(lidar.frame_id, lidar.topic)
        return (
            ""
            if other == lidar.topic
            else f"in the same frame as {other}: its points would count twice, or it needs a mount of its own"
        )

    return tuple(replace(lidar, left_out=why_not(lidar)) for lidar in lidars)


def cameras_of(bag: Contents) -> tuple[MountedTopic, ...]:
    """Return the topics of images and of tag lists; of topics of one camera, one is to be read.

    Of a camera, images come first, whose noise the detector measures, before those that were resampled, and lists.
    """
    cameras = [_camera(bag, camera) for camera in _mounted(bag, bag.cameras)]
    first: dict[tuple[str, str], str] = {}
    for camera in sorted(cameras, key=lambda c: (c.listed, is_rectified(c.topic))):
        if camera.frame_id and camera.info_topic:
            first.setdefault((camera.frame_id, camera.info_topic), camera.topic)
    used = [first.get((c.frame_id, c.info_topic), c.topic) for c in cameras]
    return tuple(
        c if topic == c.topic else replace(c, left_out=f"the same camera as {topic}, whose tags would count twice")
        for c, topic in zip(cameras, used, strict=True)
    )


def _mounted(bag: Contents, firsts: Mapping[str, FirstMessage]) -> tuple[MountedTopic, ...]:
    body = bag.tree.body()
    return tuple(
        MountedTopic(
            topic=topic,
            frame_id=first.frame,
            tf_frame=first.frame if bag.tree.resolve(body, first.frame) else None,
            latency_s=first.latency_s,
        )
        for topic, first in sorted(firsts.items())
    )


def _camera(bag: Contents, camera: MountedTopic) -> MountedTopic:
    """Add the topic of the CameraInfo, if one can be told, and whether the topic lists tags instead of images.

    It lies beside images. That of a list of tags is the one with its frame, as detectors copy headers; or, of a single
    camera, the only one.
    """
    camera = replace(camera, optical=_optical(bag, camera))
    listed = bool(set(LISTS) & set(bag.topics[camera.topic].msgtypes))
    beside = camera_info_topic(camera.topic)
    if beside in bag.topics and INFO in bag.topics[beside].msgtypes:
        return replace(camera, info_topic=beside, listed=listed)
    alike = [topic for topic, info in bag.infos.items() if info.frame == camera.frame_id]
    found = alike or (list(bag.infos) if len(bag.cameras) == 1 else [])
    if len(found) != 1:
        return replace(camera, listed=listed)
    why = "the one of its frame" if alike else "the only one"
    return replace(camera, info_topic=found[0], info_why=why, listed=listed)


def _optical(bag: Contents, camera: MountedTopic) -> tuple[Vec, Vec] | None:
    """Return the mount of a camera's optical frame if its frame in tf, as `camera_link`, has z up; else None."""
    pose = bag.tree.resolve(bag.tree.body(), camera.tf_frame) if camera.tf_frame else None
    if pose is None or pose[1][2, 2] < _SKY:
        return None
    turned = rpy_from_rotation(pose[1] @ rotation_from_rpy_deg(_LOOKS_AHEAD_DEG))
    return vec(pose[0]), vec(np.degrees(turned))
