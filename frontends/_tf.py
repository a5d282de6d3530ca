# SPDX-License-Identifier: Apache-2.0
"""Mounts from `/tf_static`: the chain of transforms from body to a sensor's frame.

Transforms of `/tf` that never change count as well: ROS 1's `static_transform_publisher` of the package `tf` repeats
its transforms there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends._standard import is_unit
from graphloc.frontends.msgtypes import TF
from graphloc.frontends.source import TF_MOVING, TF_STATIC, RawMessage

# Names of the body frame, likeliest first.
WORLD_NAMES = ("map", "odom", "world", "earth", "utm", "camera_init")  # the last by LOAM
_BODY_NAMES = ("base_link", "base_footprint", "body", "base", "vessel", "vehicle", "boat")

_FARTHEST_M = 1e4  # no vessel is so long: a longer transform is damaged, or of a map
_OLD_TF = "tf/msg/tfMessage"  # of ROS 1 before tf2
_DENSE = 1000  # messages of /tf that are all read; after n times as many, one in n is: an hour may hold a million
_GOLDEN = 0.6180339887498949  # its multiples pick messages evenly, in whatever order frames are published
_SAME = 1e-6  # m, and of a rotation matrix: repeated transforms are equal to nearly the last digit

Pose = tuple[Array, Array]  # t (3,), R (3, 3): T_parent_child


class StaticTree:
    """Static transforms by frame, searched in both directions.

    Attributes:
        broken: number of messages that could not be used; another message may be intact.
    """

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, Pose]] = {}
        self._children: set[str] = set()
        self._unusable: set[str] = set()
        self._repeated: dict[str, tuple[str, Pose, int]] = {}  # of /tf, by child: parent, pose, how often
        self._moving: set[str] = set()
        self._offered = 0
        self.broken = 0

    def take(self, msgtype: str, msg: Any) -> None:
        """Take a message of `/tf_static`; None if it could not be decoded. Other types are ignored."""
        whole = msg is not None
        if whole and msgtype in (TF, _OLD_TF):
            try:
                self.add(msg)
            except Exception:  # noqa: BLE001 - by the bag's own definition anything may stand in it
                whole = False
        self.broken += not whole

    def offer(self, raw: RawMessage, decode: Callable[[RawMessage], object]) -> None:
        """Take a message of `/tf`, or skip it if there are very many. One that cannot be decoded is repeated anyway."""
        due = self._offered * _GOLDEN % 1.0 < _DENSE / max(_DENSE, self._offered)
        self._offered += 1
        if not due or raw.msgtype not in (TF, _OLD_TF):
            return
        try:
            found = list(self._poses(decode(raw)))
        except Exception:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything
            return
        for parent, child, pose in found:
            if child not in self._moving and pose is not None:
                self._compare(parent, child, pose)

    def _compare(self, parent: str, child: str, pose: Pose) -> None:
        """Count a transform of /tf that equals the one before; a transform that changes is no mount."""
        before, same, count = self._repeated.get(child, (parent, pose, 0))
        if before != parent or max(np.abs(x - y).max() for x, y in zip(same, pose, strict=True)) > _SAME:
            self._moving.add(child)
            del self._repeated[child]
        else:
            self._repeated[child] = (parent, same, count + 1)

    def settle(self) -> None:
        """Add the transforms that `/tf` repeats and `/tf_static` lacks, once all of `/tf` was offered.

        Transforms from world frames are left out: of a vessel that lies still, they are repeated as well.
        """
        for child, (parent, pose, count) in self._repeated.items():
            if count > 1 and child not in self._children and parent.rpartition("/")[2] not in WORLD_NAMES:
                self._join(parent, child, pose)

    @property
    def damage(self) -> str:
        """A warning on messages that could not be used; '' if there are none."""
        return f"{TF_STATIC}: messages that cannot be decoded: {self.broken}" if self.broken else ""

    def add(self, msg: Any) -> None:
        """Add the transforms of a `tf2_msgs/TFMessage`; a later one replaces an earlier one between two frames."""
        for parent, child, pose in self._poses(msg):
            if pose is None:
                self._unusable.add(child)
            else:
                self._join(parent, child, pose)

    def _join(self, parent: str, child: str, pose: Pose) -> None:
        p, R = pose
        self._children.add(child)
        self._edges.setdefault(parent, {})[child] = pose
        self._edges.setdefault(child, {})[parent] = (-R.T @ p, R.T)

    @staticmethod
    def _poses(msg: Any) -> Iterator[tuple[str, str, Pose | None]]:
        """Yield parent, child and T_parent_child of each transform; None if it is no valid pose."""
        for stamped in msg.transforms:
            parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            t, q = stamped.transform.translation, stamped.transform.rotation
            quaternion, p = np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
            usable = is_unit(quaternion) and (np.abs(p) < _FARTHEST_M).all()
            yield parent, child, (p, np.asarray(Rotation.from_quat(quaternion).as_matrix())) if usable else None

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames."""
        return tuple(sorted(self._edges))

    def body(self) -> str:
        """Return the body frame: by its usual names, else the root of most frames, else `base_link`."""
        roots = [f for f in self._edges if f not in self._children and f not in WORLD_NAMES]
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
            if self._moving:
                known += f"; changing on {TF_MOVING}: {', '.join(sorted(self._moving))}"
            if self.broken:
                known += f"; messages that cannot be decoded: {self.broken}"  # one may have held what is missing
            raise InputError(
                f"{where}: no chain from '{body}' to '{sensor}' in /tf_static (frames there: {known}); "
                "set body_frame and mount.tf_frame to such names, or give mount.xyz_m and mount.rpy_deg"
            )
        return pose
