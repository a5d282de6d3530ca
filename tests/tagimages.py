# SPDX-License-Identifier: Apache-2.0
"""A tag drawn into images, and what a camera's bag holds: messages of every kind, with one view of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import AprilTagConfig
from graphloc.frames import Array
from graphloc.frontends.bag import read_recording
from graphloc.frontends.tags.sightings import Seen, sightings_of_bag
from graphloc.gather import with_sightings
from graphloc.measurements import TagMode, TagSighting
from graphloc.recording import Recording
from tests.bagfactory import START_NS, Item, Messages, S, still_run, write_bag
from tests.tagfactory import FACES_SOUTH
from tests.test_bag import vessel

IMAGE, INFO = "/camera/image_raw", "/camera/camera_info"
WIDTH, HEIGHT, FOCAL = 480, 320, 400.0
# Where the tag is (faces south, upright), and where the camera is: south-west of it, looking at it, rolled a little.
TAG = {"id": 7, "size_m": 0.4, "xyz_m": [20.0, 30.0, 1.5], "facing_deg": 180.0, "sigma_m": 0.001, "sigma_deg": 0.01}
EYE = np.array([18.6, 27.5, 1.2])
LOOKS_AHEAD = [-90.0, 0.0, -90.0]  # of an optical frame in body: `AHEAD`
MOUNT = {"xyz_m": [2.0, 0.3, 1.1], "rpy_deg": LOOKS_AHEAD}


def looking(at: Array, from_m: Array, roll_deg: float = 0.0) -> Array:
    """Axes (x right, y down, z forward) in world of a camera that looks at a point."""
    z = (at - from_m) / np.linalg.norm(at - from_m)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z]) @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()


MIDDLE = np.array(TAG["xyz_m"])
R_EYE = looking(MIDDLE + np.array([0.15, 0.0, 0.1]), EYE, 4.0)


@dataclass(frozen=True)
class Lens:
    """A camera: K, and the distortion of plumb_bob, which is inverted here by trying again and again."""

    K: tuple[float, float, float] = (FOCAL, 243.0, 156.5)
    D: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def rays(self, u: Array, v: Array) -> Array:
        f, cx, cy = self.K
        flat = np.stack([(u - cx) / f, (v - cy) / f])
        k1, k2, p1, p2, k3 = self.D
        ray = flat.copy()
        for _ in range(30):
            x, y = ray
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            shift = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])
            last, ray = ray, (flat - shift) / radial
            if np.abs(ray - last).max() < 1e-12:
                break
        return np.stack([*ray, np.ones_like(u)])


PLAIN, BENT = Lens(), Lens(D=(-0.25, 0.08, 0.002, -0.001, 0.0))


def cells(number: int) -> NDArray[np.uint8]:
    """Cells (10, 10) of a tag on its white plate, first row on top; OpenCV has the family upside down."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    printed = np.rot90(cv2.aruco.generateImageMarker(family, number, 8), 2)
    return np.pad(printed, 1, constant_values=255)


def picture(
    *tags: tuple[int, Array], lens: Lens = PLAIN, eye: tuple[Array, Array] = (EYE, R_EYE), size_m: float = 0.4
) -> NDArray[np.uint8]:
    """Tags (number, middle in world) that face south on a grey ground, every pixel the mean of sixteen rays."""
    light = np.full((4 * HEIGHT, 4 * WIDTH), 120.0)
    for number, middle in tags:
        rows, columns = _about_plate(middle, lens, eye, size_m)
        u, v = np.meshgrid(
            (np.arange(4 * WIDTH)[columns] + 0.5) / 4.0 - 0.5, (np.arange(4 * HEIGHT)[rows] + 0.5) / 4.0 - 0.5
        )
        ahead = np.einsum("ij,jnm->inm", eye[1], lens.rays(u, v))
        reach = (middle[1] - eye[0][1]) / ahead[1]
        right, up = eye[0][0] + reach * ahead[0] - middle[0], eye[0][2] + reach * ahead[2] - middle[2]
        cell = size_m / 8.0
        column, row = np.floor(right / cell + 5.0).astype(int), np.floor(5.0 - up / cell).astype(int)
        on = (reach > 0.0) & (column >= 0) & (column < 10) & (row >= 0) & (row < 10)
        light[rows, columns][on] = 25.0 + 0.8 * cells(number)[row[on], column[on]]
    mean = light.reshape(HEIGHT, 4, WIDTH, 4).mean(axis=(1, 3))
    noise = np.random.default_rng(1).normal(0.0, 1.0, mean.shape)
    return np.asarray(np.clip(np.rint(mean + noise), 0, 255), dtype=np.uint8)


def _about_plate(middle: Array, lens: Lens, eye: tuple[Array, Array], size_m: float) -> tuple[slice, slice]:
    """Rows and columns of quarter pixels about a tag's plate, and 30 px more for what the lens bends; all rays take 0.5 s."""
    plate = middle + size_m / 8.0 * 5.0 * np.array(
        [(-1.0, 0.0, 1.0), (1.0, 0.0, 1.0), (1.0, 0.0, -1.0), (-1.0, 0.0, -1.0)]
    )
    there = (plate - eye[0]) @ eye[1]
    assert (there[:, 2] > 0.0).all()
    f, *centre = lens.K
    px = f * there[:, :2] / there[:, 2:] + centre
    low, high = (4.0 * (px.min(axis=0) - 30.0)).astype(int), (4.0 * (px.max(axis=0) + 30.0)).astype(int)
    (left, top), (right, bottom) = np.maximum(low, 0), np.maximum(high, 0)
    return slice(top, bottom), slice(left, right)


def image(make: Messages, pixels: NDArray[np.uint8], stamp_ns: int = START_NS, **changes: Any) -> Any:
    """A `sensor_msgs/Image`, mono8 or bgr8 by the number of dimensions."""
    wide = pixels.shape[1] * (1 if pixels.ndim == 2 else 3)
    given: dict[str, Any] = {
        "height": pixels.shape[0], "width": pixels.shape[1], "encoding": "mono8" if pixels.ndim == 2 else "bgr8",
        "is_bigendian": 0, "step": wide, "data": pixels.reshape(-1),
    } | changes  # fmt: skip
    return make.t["sensor_msgs/msg/Image"](header=make.header(stamp_ns, "camera"), **given)


def jpeg(make: Messages, pixels: NDArray[np.uint8], stamp_ns: int = START_NS, keep: float = 1.0) -> Any:
    _, coded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])
    data = coded.reshape(-1)[: int(keep * coded.size)]
    return make.t["sensor_msgs/msg/CompressedImage"](
        header=make.header(stamp_ns, "camera"), format="mono8; jpeg compressed", data=data
    )


def info(make: Messages, lens: Lens = PLAIN, **changes: Any) -> Any:
    """Its CameraInfo; changes by the names of ROS 2, K, D, R and P excepted."""
    f, cx, cy = lens.K
    K = np.array([f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0])
    given: dict[str, Any] = {
        "height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0,
        "D": np.array(lens.D), "K": K, "R": np.eye(3).ravel(), "P": np.insert(K, [3, 6, 9], 0.0),
        "roi": make.t["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    } | changes  # fmt: skip
    named = {(k if make.ros == 1 else k.lower()): v for k, v in given.items()}
    return make.t["sensor_msgs/msg/CameraInfo"](header=make.header(START_NS, "camera"), **named)


def tags(
    *cameras: tuple[str, dict[str, Any]], survey: Sequence[dict[str, Any]] = (TAG,), **keys: Any
) -> AprilTagConfig:
    """A sensor with cameras (name, block); without any, the usual one."""
    blocks = cameras or (("bow", {"topic": IMAGE, "mount": MOUNT}),)
    return AprilTagConfig.model_validate({"survey": {"tags": list(survey)}, "cameras": dict(blocks)} | keys)


def look(
    path: Path, config: AprilTagConfig | None = None, body_frame: str = "base_link"
) -> tuple[list[Seen], list[str]]:
    said: list[str] = []
    found = list(sightings_of_bag([path], "tags", tags() if config is None else config, body_frame, warn=said.append))
    return found, said


def bag_of(folder: Path, make: Messages, *items: tuple[str, Any], kind: str = "") -> Path:
    """Messages a second apart, in this order."""
    kind = kind or ("ros1" if make.ros == 1 else "mcap")
    placed: list[Item] = [(topic, START_NS + k * S, msg) for k, (topic, msg) in enumerate(items)]
    return write_bag(folder / ("run.bag" if kind == "ros1" else "run"), make, placed, kind)


def only(found: tuple[list[Seen], list[str]]) -> TagSighting:
    (seen,), said = found
    assert (seen.troubles, said) == ((), [])
    (sighting,) = seen.sightings
    return sighting


def at_the_eye(
    sighting: TagSighting, p: Array = EYE, R: Array = R_EYE, off_m: float = 0.03, off_deg: float = 1.0
) -> TagMode:
    """Hold a sighting against where the camera was; return its mode that is right."""
    there = (sighting.points_m - p) @ R
    px = FOCAL * (sighting.rays - there[:, :2] / there[:, 2:])
    assert np.abs(px).max() < 0.25
    turned = [Rotation.from_matrix(m.R_world_camera @ R.T).magnitude() for m in sighting.modes]
    right = sighting.modes[int(np.argmin(turned))]
    assert np.degrees(min(turned)) < off_deg
    assert np.linalg.norm(right.p_world_camera_m - p) < off_m
    return right


def corners_seen(middle: Array = MIDDLE) -> Array:
    """Corners (4, 2) px of the tag in the image: top left, top right, bottom right, bottom left of the print."""
    f, cx, cy = PLAIN.K
    square = 0.2 * np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)])
    there = (middle + square @ FACES_SOUTH.T - EYE) @ R_EYE
    return np.asarray(f * there[:, :2] / there[:, 2:] + [cx, cy])


def replace_data(msg: Any, data: bytes) -> Any:
    return replace(msg, data=np.frombuffer(data, dtype=np.uint8))


# in a recording


def recorded(
    folder: Path, make: Messages, config: AprilTagConfig, *items: tuple[str, Any]
) -> tuple[Recording, list[tuple[str, int, int]]]:
    """A craft at rest for 10 s, and messages a second apart."""
    placed: list[Item] = [(topic, START_NS + k * S + S // 3, msg) for k, (topic, msg) in enumerate(items)]
    path = write_bag(folder / "run", make, sorted([*still_run(make, 10.0), *placed], key=lambda i: i[1]), "mcap")
    plain = vessel(datum={"latitude_deg": 57.7, "longitude_deg": 11.9})
    whole = plain.model_copy(update={"sensors": {**plain.sensors, "tags": config}})
    said: list[tuple[str, int, int]] = []
    found = with_sightings(read_recording(path, whole), whole, [path], lambda *of: said.append(of))
    return found, said
