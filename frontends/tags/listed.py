# SPDX-License-Identifier: Apache-2.0
"""AprilTags that another program detected, from messages in the bag: corners in the image, or the pose of each tag."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from graphloc.frames import Array
from graphloc.frontends._standard import pose_of

_NEAREST_M = 0.01
# Corners of a tag of size 2: top left, top right, bottom right, bottom left; x right, y up, z out of the print.
_SQUARE = np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)])


@dataclass(frozen=True, slots=True, eq=False)
class ListedTag:
    """A detection. Corners are in the order of the print: top left, top right, bottom right, bottom left.

    Attributes:
        number: id. family: such as 'tag36h11'; '' if not stated.
        hamming: number of corrected bits. margin: AprilTag's decision margin, grey levels. None if not stated.
        size_m: edge length configured in the detecting program; None if not stated.
        corners_px: (4, 2) px, (0, 0) is the centre of the top-left pixel, in the image that was searched (usually
            `image_rect`); None if `rays` is given.
        rays: (4, 2), x/z and y/z in the optical frame, of the corners of a fitted pose; None if `corners_px` is given.
            They have no residual, so they do not show which of the two planar poses fits better.
    """

    number: int
    family: str
    hamming: int | None
    margin: float | None
    size_m: float | None
    corners_px: Array | None
    rays: Array | None


def read_list(msg: Any, msgtype: str) -> tuple[list[ListedTag], list[str]]:
    """Return the tags of a list of detections, and a line for each entry that cannot be used.

    Args:
        msg: the list. msgtype: one of `LISTS`.
    """
    reader = _READERS[msgtype]
    tags, unusable = [], []
    for entry in msg.detections:
        try:
            tags.append(reader(entry))
        except ValueError as error:
            unusable.append(str(error))
        except (AttributeError, TypeError) as error:  # bags bring their own definitions, under whatever name
            unusable.append(f"a detection unlike those of {msgtype} ({error})")
    return tags, unusable


def _with_corners(entry: Any) -> ListedTag:
    """Read an `apriltag_msgs/AprilTagDetection`, the output of AprilTag 3.

    AprilTag counts corners from the print's bottom left, counter-clockwise, and px from the outer corner of the
    top-left pixel. Messages of 2018 hold the corners as eight numbers.
    """
    corners = [(c.x, c.y) if hasattr(c, "x") else c for c in entry.corners]
    corners_px = np.array(corners, dtype=float).reshape(4, 2)[::-1] - 0.5
    if not np.isfinite(corners_px).all():
        raise ValueError(f"tag {entry.id}: its corners are not finite")
    along = np.roll(corners_px, -1, axis=0) - corners_px
    following = np.roll(along, -1, axis=0)
    turns = along[:, 0] * following[:, 1] - along[:, 1] * following[:, 0]
    if not (turns > 0.0).all():  # clockwise in the image, as y is down
        raise ValueError(f"tag {entry.id}: its corners are no quadrilateral in AprilTag's order (counter-clockwise)")
    margin = float(entry.decision_margin)
    return ListedTag(
        int(entry.id), _family(str(entry.family)), int(entry.hamming), margin if isfinite(margin) else None, None,
        corners_px, None,
    )  # fmt: skip


def _family(name: str) -> str:
    """Return AprilTag's own name of a family, 'tag36h11' for `apriltag_detector`'s 'tf36h11'."""
    known = re.fullmatch(r"(?:tf|tag)?((?:Standard|Circle|Custom)?\d+h\d+)", name)
    return f"tag{known[1]}" if known else name


def _with_pose(entry: Any) -> ListedTag:
    """Read an `apriltag_ros/AprilTagDetection` of ROS 1: the pose of a tag in the optical frame, from its four corners.

    `apriltag_ros` takes AprilTag's px for OpenCV's: its rays are half a pixel, 0.5 px / focal length, too far right and
    down. The message has no focal length to correct that.
    """
    numbers = [int(n) for n in entry.id]
    if len(numbers) != 1 or len(entry.size) != 1:
        if len(numbers) > 1:
            raise ValueError(f"tag bundle {', '.join(map(str, numbers))}: use single tags or raw images")
        raise ValueError(f"a detection with {len(numbers)} ids and {len(entry.size)} sizes")
    number, size_m = numbers[0], float(entry.size[0])
    if not (isfinite(size_m) and size_m > 0.0):
        raise ValueError(f"tag {number}: its size is {size_m:g} m")
    p, R = pose_of(entry.pose)
    if R is None or not np.isfinite(p).all():
        raise ValueError(f"tag {number}: its pose is not finite, or its quaternion not of unit length")
    corners = p + 0.5 * size_m * _SQUARE @ R.T
    if corners[:, 2].min() < _NEAREST_M:
        raise ValueError(f"tag {number}: it lies behind the camera, {p[2]:.2f} m along the optical axis")
    if R[:, 2] @ p >= 0.0:
        raise ValueError(f"tag {number}: it is seen from behind (its z axis is to point out of the print)")
    return ListedTag(number, "", None, None, size_m, None, corners[:, :2] / corners[:, 2:])


_READERS: dict[str, Callable[[Any], ListedTag]] = {
    "apriltag_msgs/msg/AprilTagDetectionArray": _with_corners,
    "apriltag_ros/msg/AprilTagDetectionArray": _with_pose,
}
LISTS: tuple[str, ...] = tuple(_READERS)
