# SPDX-License-Identifier: Apache-2.0
"""Mounts from `/tf_static`: the chain of transforms from body to a sensor's frame."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends._source import TF_STATIC
from graphloc.frontends.decode import TF, is_unit

# Names of the body frame, likeliest first.
_WORLD_NAMES = ("map", "odom", "world", "earth", "utm")
_BODY_NAMES = ("base_link", "base_footprint", "body", "base", "vessel", "vehicle", "boat")

_FARTHEST_M = 1e4

Pose = tuple[Array, Array]  # t (3,), R (3, 3): T_parent_child


class StaticTree:
    """Static transforms by frame, searched in both directions.

    Attributes:
        broken: messages that could not be used: another one may be intact.
    """

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, Pose]] = {}
        self._children: set[str] = set()
        self._unusable: set[str] = set()
        self.broken = 0

    def take(self, msgtype: str, msg: Any) -> None:
        """Take a message of `/tf_static`; None if it could not be decoded. Other types are ignored."""
        whole = msg is not None
        if whole and msgtype == TF:
            try:
                self.add(msg)
            except Exception:  # noqa: BLE001 - by the bag's own definition anything may stand in it
                whole = False
        self.broken += not whole

    @property
    def damage(self) -> str:
        """A line on messages that could not be used; empty if there are none."""
        return f"{TF_STATIC}: messages that cannot be decoded: {self.broken}" if self.broken else ""

    def add(self, msg: Any) -> None:
        """Add the transforms of a `tf2_msgs/TFMessage`; a later one replaces an earlier one of the same frames."""
        for stamped in msg.transforms:
            parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            t, q = stamped.transform.translation, stamped.transform.rotation
            quaternion, p = np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
            if not (is_unit(quaternion) and (np.abs(p) < _FARTHEST_M).all()):
                self._unusable.add(child)
                continue
            R = np.asarray(Rotation.from_quat(quaternion).as_matrix())
            self._children.add(child)
            self._edges.setdefault(parent, {})[child] = (p, R)
            self._edges.setdefault(child, {})[parent] = (-R.T @ p, R.T)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames."""
        return tuple(sorted(self._edges))

    def body(self) -> str:
        """Return the body frame: by its usual names, else the root of most frames, else `base_link`."""
        roots = [f for f in self._edges if f not in self._children and f not in _WORLD_NAMES]
        roots.sort(key=lambda root: -sum(self.resolve(root, frame) is not None for frame in self._edges))
        return next((name for name in (*_BODY_NAMES, *roots) if name in self._edges), _BODY_NAMES[0])

    def resolve(self, body: str, sensor: str) -> Pose | None:
        """Return T_body_sensor along the shortest chain; None if there is none."""
        body, sensor = body.lstrip("/"), sensor.lstrip("/")
        found: dict[str, Pose] = {body: (np.zeros(3), np.eye(3))}
        queue = deque([body])
        while queue and sensor not in found:
            frame = queue.popleft()
            p, R = found[frame]
            for child, (t, C) in self._edges.get(frame, {}).items():
                if child not in found:
                    found[child] = (p + R @ t, R @ C)
                    queue.append(child)
        return found.get(sensor)

    def mount(self, body: str, sensor: str, where: str) -> Pose:
        """Return T_body_sensor.

        Raises:
            InputError: no chain connects the frames; the line lists those that exist.
        """
        pose = self.resolve(body, sensor)
        if pose is None:
            known = ", ".join(self.frames) or "none"
            if self._unusable:
                known += (
                    f"; without a pose, as NaN or no unit quaternion stands there: {', '.join(sorted(self._unusable))}"
                )
            if self.broken:
                known += f"; messages that cannot be decoded: {self.broken}"  # one may have held what is missing
            raise InputError(
                f"{where}: no chain from '{body}' to '{sensor}' in /tf_static (frames there: {known}); "
                "set body_frame and mount.tf_frame to such names, or give mount.xyz_m and mount.rpy_deg"
            )
        return pose
