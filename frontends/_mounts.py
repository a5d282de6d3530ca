# SPDX-License-Identifier: Apache-2.0
"""Mounts of sensors that a block lists (LiDARs, cameras): from the configuration or from `/tf_static`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from graphloc.blocks import MountConfig
from graphloc.frames import Array
from graphloc.frontends._sanity import lever_warning
from graphloc.frontends._tf import StaticTree
from graphloc.frontends.source import TF_MOVING, TF_STATIC, Bag


def mounts_of(
    bag: Bag, mounts: Mapping[str, MountConfig], body_frame: str, block: str
) -> dict[str, tuple[Array, Array]]:
    """Return (t (3,) m, R (3, 3)) in body of each sensor, by name.

    A message of `/tf_static` that cannot be decoded is reported in `bag.warnings`: another one may be intact.

    Args:
        block: name of their list in vessel.yaml, for messages.

    Raises:
        InputError: no chain of transforms connects a sensor with body.
    """
    tree = StaticTree()
    if any(mount.tf_frame for mount in mounts.values()):
        for raw in bag.messages({TF_STATIC, TF_MOVING}):
            if raw.topic == TF_MOVING:
                tree.offer(raw, bag.decode)
                continue
            try:
                msg = bag.decode(raw)
            except Exception:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything
                msg = None
            tree.take(raw.msgtype, msg)
    tree.settle()
    if tree.damage:
        bag.warnings.append(f"{bag.name}: {tree.damage}; {block} have their mounts from the rest")
    found = {
        name: tree.mount(body_frame, mount.tf_frame, f"{bag.name}: {block}.{name}.mount.tf_frame")
        if mount.tf_frame
        else (mount.t_body_sensor_m, mount.R_body_sensor)
        for name, mount in mounts.items()
    }
    for name, (t, _) in found.items():
        bag.warnings += lever_warning(f"{block}.{name}", t, mounts[name].tf_frame)
    return found


def refuse_another(frames: dict[str, str], name: str, msg: Any, mounted: str | None, kind: str) -> None:
    """Refuse a message of another sensor on a topic, since one mount places all messages of a topic.

    Args:
        msg: the message. name: of the sensor. mounted: frame of its mount. kind: 'LiDAR' or 'camera'.
        frames: by sensor, the frame of its messages, updated in place: the first one that a message names, or `mounted`
            once a message names that.

    Raises:
        ValueError: the message names another frame.
    """
    frame = str(getattr(getattr(msg, "header", None), "frame_id", "")).lstrip("/")
    own = frames[name] = frame if frame and frame == mounted else frames.get(name) or frame
    if frame and frame != own:
        raise ValueError(
            f"a message in frame '{frame}' where others are in '{own}': of another {kind}, whose mount is not that of {name}; "
            "record each on a topic of its own"
        )
