# SPDX-License-Identifier: Apache-2.0
"""Sightings of surveyed tags, from the images of a bag or from detections in it, message by message."""

from __future__ import annotations

import os
import re
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from graphloc.config import AprilTagConfig, CameraConfig
from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends._clock import corrected_ns
from graphloc.frontends._mounts import mounts_of, refuse_another
from graphloc.frontends.msgtypes import NO_STAMP, stamp_ns_of
from graphloc.frontends.part import Bags
from graphloc.frontends.source import Bag, RawMessage
from graphloc.frontends.tags.bundles import Seeing, SeenTag, sightings_of
from graphloc.frontends.tags.camera import CameraModel, camera_of
from graphloc.frontends.tags.detect import Detector
from graphloc.frontends.tags.images import grey_image
from graphloc.frontends.tags.listed import LISTS, ListedTag, read_list
from graphloc.measurements import TagSighting, TagView
from graphloc.survey import TagConfig

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
_RECTIFIED = {"rect", "rectified", "undistorted", "undistort"}  # as part of a topic's name
_NO_FOCAL_PX = 1000.0  # focal length that is assumed, for the noise of corners, of lists of poses without a CameraInfo
_OTHER_SIZE = 0.02  # relative difference from which a tag's size in a list contradicts the survey's


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Result of one message.

    Attributes:
        stamp_ns, camera: of the message. sightings: of surveyed tags; may be empty. views: of tags that are not
            surveyed.
        troubles: a line for each part that could not be used. doubtful: a line for each tag that a limit
            (`max_hamming`, `min_margin`) excluded.
    """

    stamp_ns: int
    camera: str
    sightings: tuple[TagSighting, ...] = ()
    views: tuple[TagView, ...] = ()
    troubles: tuple[str, ...] = ()
    doubtful: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Eye:
    """A configured camera.

    Attributes:
        name, topic: its name and topic. listed: whether the topic holds lists of detections instead of images.
        lens: its calibration; None for lists of poses without a CameraInfo. mount: position (3,) and rotation (3, 3).
        mount_frame: frame that places the mount; None: numbers do.
    """

    name: str
    topic: str
    listed: bool
    lens: CameraModel | None
    mount: tuple[Array, Array]
    mount_frame: str | None


@dataclass(slots=True)
class _Raw:
    """Tags in a message: id, family, rays (4, 2), their covariance (8, 8), size, and whether of a fitted pose."""

    tags: list[tuple[int, str, Array, Array, float | None, bool]] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)
    doubtful: list[str] = field(default_factory=list)


def sightings_of_bag(
    bags: Bags, sensor: str, config: AprilTagConfig, body_frame: str, *, warn: Callable[[str], None]
) -> Iterator[Seen]:
    """Yield the result of each image and list of a bag.

    Args:
        bags: see `read_recording`. sensor: its name. config: its block, with the survey. body_frame: in tf.
        warn: called with each damage of the bag.

    Raises:
        InputError: no camera, a missing topic or one of another type, no usable CameraInfo, or a mount without a chain
            of transforms.
    """
    families = sorted({tag.family for tag in config.surveyed.tags}) or ["36h11"]
    few_bits = [tag.id for tag in config.surveyed.tags if tag.family == "16h5"]  # nearly any dark square is in 16h5
    detector = Detector(
        families, max_hamming=config.max_hamming, min_margin=config.min_margin,
        numbers={"16h5": few_bits} if few_bits else None,
    )  # fmt: skip
    with Bag(bags) as bag, ThreadPoolExecutor(_cores()) as pool:
        eyes = _eyes(bag, config, body_frame, warn)
        ahead: deque[Future[Seen]] = deque()
        frames: dict[str, str] = {}
        for raw in bag.messages({eye.topic for eye in eyes.values()}):
            eye = eyes[raw.topic]
            msg = _decoded(bag, raw, eye, frames)
            ahead.append(pool.submit(_look, raw, msg, eye, sensor, config, detector))
            if len(ahead) > 2 * _cores():  # images are large: only a few are held
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
        for line in bag.warnings:
            warn(line)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _eyes(bag: Bag, config: AprilTagConfig, body_frame: str, warn: Callable[[str], None]) -> dict[str, _Eye]:
    """Return the cameras by topic.

    Raises:
        InputError: see `sightings_of_bag`.
    """
    if not config.cameras:
        raise InputError("vessel.yaml: an apriltag sensor needs `cameras`: name, topic and mount of each")
    mounts = mounts_of(bag, {name: c.mount for name, c in config.cameras.items()}, body_frame, "cameras")
    found: dict[str, _Eye] = {}
    for name, camera in config.cameras.items():
        have = bag.topics.get(camera.topic)
        kinds = set(have.msgtypes) & {*IMAGES, *LISTS} if have else set()
        if not kinds:
            fitting = [t.topic for t in bag.topics.values() if set(t.msgtypes) & {*IMAGES, *LISTS}]
            raise InputError(
                f"{bag.name}: cameras.{name}.topic '{camera.topic}' holds no images and no detections; such topics: "
                f"{', '.join(fitting) or 'none'}"
            )
        if camera.topic in found:
            raise InputError(f"vessel.yaml: cameras {found[camera.topic].name} and {name} have the same topic")
        listed = bool(kinds & set(LISTS))
        lens = _lens(bag, name, camera, listed, warn)
        if lens is None and "apriltag_msgs" in "".join(kinds):
            raise InputError(f"{bag.name}: cameras.{name}: its corners are pixels: give its `info_topic`")
        found[camera.topic] = _Eye(name, camera.topic, listed, lens, mounts[name], camera.mount.tf_frame)
    return found


def camera_info_topic(topic: str) -> str:
    """Return the usual topic of the CameraInfo beside a topic of images."""
    return f"{topic.removesuffix('/compressed').rsplit('/', 1)[0]}/camera_info"


def is_rectified(topic: str) -> bool:
    """Return whether a topic of images has distortion removed, by its name (`image_rect_color`, `rect/image`, `image_undistorted`)."""
    return not _RECTIFIED.isdisjoint(re.split(r"[/_]", topic.lower()))


def _lens(bag: Bag, name: str, config: CameraConfig, listed: bool, warn: Callable[[str], None]) -> CameraModel | None:
    """Return the camera's calibration by the first CameraInfo in the whole bag; None of a list without `info_topic`."""
    topic = config.info_topic
    if not topic and listed:
        return None
    topic = topic or camera_info_topic(config.topic)
    where = f"{bag.name}: cameras.{name}: CameraInfo on '{topic}'"
    have = bag.topics.get(topic)
    if have is None or INFO not in have.msgtypes:
        fitting = [t.topic for t in bag.topics.values() if INFO in t.msgtypes]
        raise InputError(f"{where}: there is none; set `info_topic`; such topics: {', '.join(fitting) or 'none'}")
    rectified = config.rectified
    if rectified is None:
        rectified = listed or is_rectified(config.topic)
    first: Any = None
    for raw in bag.messages({topic}, whole=True):
        try:
            msg: Any = bag.decode(raw)
        except Exception:  # noqa: BLE001, S112 - damaged bytes make rosbags raise nearly anything; the next may be whole
            continue
        if first is None:
            first = msg
        elif _differs(first, msg):
            warn(f"{where}: it changes in the run (zoom?); the first one is taken for all images")
            break
    if first is None:
        raise InputError(f"{where}: no message can be read")
    if listed and config.rectified is None and np.any(np.asarray(getattr(first, "D", getattr(first, "d", 0.0)))):
        warn(
            f"{where} has distortion: corners are taken for those of image_rect; if they were found on image_raw, set rectified: false"
        )
    try:
        return camera_of(first, rectified=rectified)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def _differs(one: Any, other: Any) -> bool:
    return any(
        not np.array_equal(np.asarray(getattr(one, key)), np.asarray(getattr(other, key)))
        for key in ("K", "k", "P", "p", "D", "d", "width", "height")
        if hasattr(one, key)
    )


def _decoded(bag: Bag, raw: RawMessage, eye: _Eye, frames: dict[str, str]) -> Any:
    """Return the message, or the error that decoding raises, or that says that another camera made it.

    Args:
        frames: see `refuse_another`.
    """
    try:
        msg = bag.decode(raw)
        refuse_another(frames, eye.name, msg, eye.mount_frame, "camera")
        return msg
    except Exception as error:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything
        return error


def _look(raw: RawMessage, msg: Any, eye: _Eye, sensor: str, config: AprilTagConfig, detector: Detector) -> Seen:
    """Return the result of a message."""
    try:
        if isinstance(msg, Exception):
            raise msg
        stamp_ns = stamp_ns_of(msg, raw.msgtype, raw.log_ns, recorded=config.stamps == "recorded")
        if stamp_ns is None:
            raise ValueError(f"its header has no stamp: {NO_STAMP}")
        stamp_ns = corrected_ns(stamp_ns, config, raw.elapsed_ns)
        shown = _listed(msg, raw.msgtype, eye, config) if eye.listed else _detected(msg, raw.msgtype, eye, detector)
    except Exception as error:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything
        said = str(error) if isinstance(error, ValueError) else f"cannot be decoded ({type(error).__name__})"
        return Seen(raw.log_ns, eye.name, troubles=(f"{raw.topic}: {' '.join(said.split())[:200]}",))
    return _sorted_out(shown, stamp_ns, eye, sensor, config)


def _detected(msg: Any, msgtype: str, eye: _Eye, detector: Detector) -> _Raw:
    grey = grey_image(msg, msgtype)
    assert eye.lens is not None
    eye.lens.check_size(grey.shape[1], grey.shape[0])
    found = _Raw()
    for d in detector.detect(grey, eye.lens):
        _add(found, eye.lens, d.number, d.family, d.corners_px, d.cov_px2, None)
    return found


def _add(
    found: _Raw, lens: CameraModel, number: int, family: str, px: Array, cov_px2: Array, size_m: float | None
) -> None:
    rays = lens.rays(px)
    if not np.isfinite(rays).all():
        found.troubles.append(f"tag {number} lies where the lens model cannot be inverted")
        return
    back = np.linalg.inv(block_diag(*lens.jacobian(rays)))
    found.tags.append((number, family, rays, back @ cov_px2 @ back.T, size_m, False))


def _listed(msg: Any, msgtype: str, eye: _Eye, config: AprilTagConfig) -> _Raw:
    tags, troubles = read_list(msg, msgtype)
    found = _Raw(troubles=troubles)
    noise_px2 = np.eye(8) * config.corner_sigma_px**2
    for tag in tags:
        why_not = _refused(tag, config)
        if why_not:
            found.doubtful.append(why_not)
        elif tag.corners_px is not None and eye.lens is not None:
            _add(found, eye.lens, tag.number, tag.family, tag.corners_px, noise_px2, tag.size_m)
        elif tag.rays is not None:
            # ROS 1's apriltag_ros takes AprilTag's px, in which pixels have their centres at 0.5, for OpenCV's.
            focal_px = np.full(2, _NO_FOCAL_PX) if eye.lens is None else np.diagonal(eye.lens.K)[:2]
            shifted = tag.rays - (0.0 if eye.lens is None else 0.5 / focal_px)
            found.tags.append((tag.number, tag.family, shifted, noise_px2 / float(focal_px[0]) ** 2, tag.size_m, True))
    return found


def _refused(tag: ListedTag, config: AprilTagConfig) -> str:
    if tag.hamming is not None and tag.hamming > config.max_hamming:
        return f"tag {tag.number}: {tag.hamming} bits read wrong, more than max_hamming"
    if tag.margin is not None and tag.margin < config.min_margin:
        return f"tag {tag.number}: decision margin {tag.margin:.0f} is below min_margin"
    return ""


def _sorted_out(shown: _Raw, stamp_ns: int, eye: _Eye, sensor: str, config: AprilTagConfig) -> Seen:
    """Return the result of a message: sightings of surveyed tags, views of others, and lines on unused tags."""
    survey, troubles = config.surveyed, list(shown.troubles)
    counts = Counter((number, family) for number, family, *_ in shown.tags)
    seen: list[SeenTag] = []
    views: list[TagView] = []
    for number, said, rays, cov, size_m, fitted in shown.tags:
        family = said.removeprefix("tag")
        tag = _in_survey(survey.tags, number, family)
        if counts[(number, said)] > 1:
            troubles.append(f"tag {number} is seen twice in one image: which one is meant cannot be told")
        elif tag is None:
            troubles.append(f"tag {number} ({family or 'family not said'}) is not in the survey")
            views.append(
                TagView(
                    stamp_ns=stamp_ns, camera=eye.name, family=family, number=number, rays=rays, cov=cov,
                    t_body_camera_m=eye.mount[0], R_body_camera=eye.mount[1],
                )
            )  # fmt: skip
        elif size_m is not None and abs(size_m / tag.size_m - 1.0) > _OTHER_SIZE:
            troubles.append(
                f"tag {number}: its detector took it for {size_m:g} m wide, the survey for {tag.size_m:g} m: correct one"
            )
        else:
            seen.append(SeenTag(tag, rays, cov, fitted))
    px = 1.0 / (_NO_FOCAL_PX if eye.lens is None else float(eye.lens.K[0, 0]))
    seeing = Seeing(stamp_ns, sensor, eye.name, *eye.mount, floor=config.min_corner_sigma_px * px, px=px)
    sightings, lost = sightings_of(seen, survey, seeing)
    troubles += [f"tag {number}: no pose explains its corners" for number in lost]
    lines = (tuple(dict.fromkeys(each)) for each in (troubles, shown.doubtful))
    return Seen(stamp_ns, eye.name, tuple(sightings), tuple(views), *lines)


def _in_survey(tags: Sequence[TagConfig], number: int, family: str) -> TagConfig | None:
    """Return the tag of the survey; if no family is stated, the only one with this id; else None."""
    fitting = [tag for tag in tags if tag.id == number and family in ("", tag.family)]
    return fitting[0] if len(fitting) == 1 else None


__all__ = ["IMAGES", "INFO", "Seen", "camera_info_topic", "is_rectified", "sightings_of_bag"]
