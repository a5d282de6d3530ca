# SPDX-License-Identifier: Apache-2.0
"""From a bag to sightings of tags: images traced in the test, through every kind of message; and what bags have wrong."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import AprilTagConfig, VesselConfig
from graphloc.errors import ConfigError, InputError
from graphloc.frames import Array
from graphloc.frontends.bag import read_recording
from graphloc.frontends.tags import sightings
from graphloc.frontends.tags.sightings import Seen, info_beside, sightings_of_bag
from graphloc.gather import with_sightings, with_surveys
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import TagMode, TagSighting
from graphloc.recording import Recording
from tests.bagfactory import START_NS, Item, Messages, S, still_run, write_bag
from tests.test_bag import accounted, vessel
from tests.test_tag_lists import CORNERS, POSES, listing, maker, with_corners, with_pose

IMAGE, INFO = "/camera/image_raw", "/camera/camera_info"
WIDTH, HEIGHT, FOCAL = 480, 320, 400.0
# Where the tag is (faces south, upright), and where the camera is: south-west of it, looking at it, rolled a little.
TAG = {"id": 7, "size_m": 0.4, "xyz_m": [20.0, 30.0, 1.5], "facing_deg": 180.0, "sigma_m": 0.001, "sigma_deg": 0.01}
FACING = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])  # tag to world: x east, y up, z south
EYE = np.array([18.6, 27.5, 1.2])
LOOKS_AHEAD = [-90.0, 0.0, -90.0]  # of an optical frame in body
MOUNT = {"xyz_m": [2.0, 0.3, 1.1], "rpy_deg": LOOKS_AHEAD}
AHEAD = np.array([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])  # the same as a matrix


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
            ray = (flat - shift) / radial
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
    fine = (np.arange(4) + 0.5) / 4.0 - 0.5
    u, v = np.meshgrid((np.arange(WIDTH)[:, None] + fine).ravel(), (np.arange(HEIGHT)[:, None] + fine).ravel())
    ahead = np.einsum("ij,jnm->inm", eye[1], lens.rays(u, v))
    light = np.full(u.shape, 120.0)
    for number, middle in tags:
        reach = (middle[1] - eye[0][1]) / ahead[1]
        right, up = eye[0][0] + reach * ahead[0] - middle[0], eye[0][2] + reach * ahead[2] - middle[2]
        cell = size_m / 8.0
        column, row = np.floor(right / cell + 5.0).astype(int), np.floor(5.0 - up / cell).astype(int)
        on = (reach > 0.0) & (column >= 0) & (column < 10) & (row >= 0) & (row < 10)
        light[on] = 25.0 + 0.8 * cells(number)[row[on], column[on]]
    mean = light.reshape(HEIGHT, 4, WIDTH, 4).mean(axis=(1, 3))
    noise = np.random.default_rng(1).normal(0.0, 1.0, mean.shape)
    return np.asarray(np.clip(np.rint(mean + noise), 0, 255), dtype=np.uint8)


@pytest.fixture(scope="module")
def shown() -> NDArray[np.uint8]:
    return picture((7, MIDDLE))


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


# what is seen


@pytest.mark.parametrize(("ros", "kind"), [(1, "ros1"), (2, "mcap"), (2, "sqlite3")])
@pytest.mark.parametrize("coding", ["mono8", "bgr8", "jpeg"])
def test_a_sighting_puts_the_camera_where_it_was(
    tmp_path: Path, shown: NDArray[np.uint8], ros: int, kind: str, coding: str
) -> None:
    make = Messages(ros)
    colours = cv2.merge([shown, shown, shown]).astype(np.uint8)
    msg = jpeg(make, shown) if coding == "jpeg" else image(make, shown if coding == "mono8" else colours)
    topic = f"{IMAGE}/compressed" if coding == "jpeg" else IMAGE
    path = bag_of(tmp_path, make, (INFO, info(make)), (topic, msg), kind=kind)
    sighting = only(look(path, tags(("bow", {"topic": topic, "mount": MOUNT}))))
    assert at_the_eye(sighting) is sighting.modes[0]
    assert sighting.modes[0].probability > 0.9
    assert (sighting.numbers, sighting.camera, sighting.frame) == ((7,), "bow", "world")
    np.testing.assert_allclose(sighting.t_body_camera_m, MOUNT["xyz_m"])
    np.testing.assert_allclose(sighting.R_body_camera, AHEAD, atol=1e-12)
    # By hand: the print's top left, 0.2 m west of and above its middle, is the first corner.
    np.testing.assert_allclose(sighting.points_m[0], [19.8, 30.0, 1.7], atol=1e-12)


def test_a_lens_that_bends(tmp_path: Path) -> None:
    """The tag lies off the axis, where k1 = -0.25 moves it by several px."""
    make = Messages(2)
    R = looking(MIDDLE + np.array([-0.9, 0.0, 0.4]), EYE)
    bent = picture((7, MIDDLE), lens=BENT, eye=(EYE, R))
    path = bag_of(tmp_path, make, (INFO, info(make, BENT)), (IMAGE, image(make, bent)))
    at_the_eye(only(look(path)), R=R)
    wrong = bag_of(tmp_path / "plain", make, (INFO, info(make)), (IMAGE, image(make, bent)))
    with pytest.raises(AssertionError):
        at_the_eye(only(look(wrong)), R=R)


@pytest.mark.parametrize("topic", ["/camera/image_rect", "/camera/image_rect_color/compressed", IMAGE])
def test_rectified_images_follow_P(tmp_path: Path, topic: str, shown: NDArray[np.uint8]) -> None:
    """By the topic's name or by `rectified`: K and D are then of another image."""
    make = Messages(2)
    raw = info(make, BENT, K=np.array([333.0, 0.0, 200.0, 0.0, 333.0, 100.0, 0.0, 0.0, 1.0]))
    msg = jpeg(make, shown) if topic.endswith("compressed") else image(make, shown)
    path = bag_of(tmp_path, make, (INFO, raw), (topic, msg))
    camera = {"topic": topic, "mount": MOUNT} | ({"rectified": True} if topic == IMAGE else {})
    at_the_eye(only(look(path, tags(("bow", camera)))))


def test_stamps_and_their_offset(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """The stamp is the header's, not the recording's; a positive offset moves it to later, as for all sensors."""
    make = Messages(2)
    stamp_ns = START_NS + 123_456_789
    path = bag_of(tmp_path, make, (INFO, info(make)), (IMAGE, image(make, shown, stamp_ns)))
    assert only(look(path)).stamp_ns == stamp_ns
    (seen,), _ = look(path, tags(time_offset_s=-0.25))
    assert seen.stamp_ns == seen.sightings[0].stamp_ns == stamp_ns - 250_000_000


def test_a_mount_by_tf(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """hull -> mast -> optical frame: by hand, the mast is turned to port, and the camera on it looks over port."""
    make = Messages(2)
    port = Rotation.from_euler("z", 90, degrees=True).as_quat().tolist()
    optical = Rotation.from_matrix(AHEAD).as_quat().tolist()
    tree = make.transforms([("hull", "mast", (1.0, 2.0, 3.0), port), ("mast", "eye_optical", (0.5, 0.0, 0.2), optical)])
    path = bag_of(tmp_path, make, ("/tf_static", tree), (INFO, info(make)), (IMAGE, image(make, shown)))
    config = tags(("bow", {"topic": IMAGE, "mount": {"tf_frame": "eye_optical"}}))
    sighting = only(look(path, config, "hull"))
    np.testing.assert_allclose(sighting.t_body_camera_m, [1.0, 2.5, 3.2], atol=1e-9)
    np.testing.assert_allclose(sighting.R_body_camera[:, 2], [0.0, 1.0, 0.0], atol=1e-9)  # z looks to port
    np.testing.assert_allclose(sighting.R_body_camera[:, 1], [0.0, 0.0, -1.0], atol=1e-9)  # y looks down
    at_the_eye(sighting)
    broken = tags(("bow", {"topic": IMAGE, "mount": {"tf_frame": "nowhere"}}))
    with pytest.raises(InputError, match=r"run: cameras.bow.mount.tf_frame: .*'hull' to 'nowhere'"):
        look(path, broken, "hull")


def test_two_cameras_in_one_sensor(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """Each with its lens, its mount, its name."""
    make = Messages(2)
    aside = EYE + np.array([2.5, 0.2, 0.3])
    R = looking(MIDDLE, aside, -3.0)
    longer = Lens(K=(500.0, 230.0, 160.0))
    other = picture((7, MIDDLE), lens=longer, eye=(aside, R))
    path = bag_of(
        tmp_path, make, (INFO, info(make)), ("/left/info", info(make, longer)), (IMAGE, image(make, shown)),
        ("/left/image_raw", image(make, other, START_NS + 5)),
    )  # fmt: skip
    left = {"topic": "/left/image_raw", "info_topic": "/left/info", "mount": MOUNT | {"xyz_m": [2.0, 0.7, 1.1]}}
    found, said = look(path, tags(("bow", {"topic": IMAGE, "mount": MOUNT}), ("left", left)))
    assert not said
    by_name = {seen.camera: seen.sightings[0] for seen in found}
    at_the_eye(by_name["bow"])
    at_the_eye(by_name["left"], aside, R)
    assert [by_name[n].t_body_camera_m[1] for n in ("bow", "left")] == [0.3, 0.7]


def test_tags_of_one_image_are_one_sighting(tmp_path: Path) -> None:
    """And there is one pose then."""
    make = Messages(2)
    second = MIDDLE + np.array([0.7, 0.0, 0.1])
    path = bag_of(tmp_path, make, (INFO, info(make)), (IMAGE, image(make, picture((7, MIDDLE), (12, second)))))
    sighting = only(look(path, tags(survey=(TAG, TAG | {"id": 12, "xyz_m": second.tolist()}))))
    assert sighting.numbers == (7, 12)
    assert len(sighting.modes) == 1
    at_the_eye(sighting, off_m=0.02, off_deg=0.4)


def corners_seen(middle: Array = MIDDLE) -> Array:
    """Corners (4, 2) px of the tag in the image: top left, top right, bottom right, bottom left of the print."""
    f, cx, cy = PLAIN.K
    square = 0.2 * np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)])
    there = (middle + square @ FACING.T - EYE) @ R_EYE
    return np.asarray(f * there[:, :2] / there[:, 2:] + [cx, cy])


def test_a_list_of_corners(tmp_path: Path) -> None:
    """AprilTag counts from the bottom left, counter-clockwise, and has the first pixel's middle at (0.5, 0.5)."""
    make = maker(CORNERS)
    msg = listing(make, CORNERS, with_corners(make, corners_seen()[::-1] + 0.5))
    path = bag_of(tmp_path, make, (INFO, info(make, BENT)), ("/detections", msg))
    block = {"topic": "/detections", "info_topic": INFO, "mount": MOUNT}
    (line,) = look(path, tags(("bow", block)))[1]  # nothing says which image it was, and it matters
    assert "rectified: false" in line
    sighting = only(look(path, tags(("bow", block | {"rectified": True}))))
    at_the_eye(sighting, off_m=1e-6, off_deg=1e-4)
    sigma = np.sqrt(np.diagonal(sighting.cov)) * FOCAL  # the survey's share is little
    np.testing.assert_allclose(sigma, 0.5, rtol=0.1)


@pytest.mark.parametrize("with_info", [True, False])
def test_a_list_of_poses(tmp_path: Path, with_info: bool) -> None:
    """ROS 1's: a pose of half a pixel too far right and down, which only a CameraInfo lets undo. Both poses are equal."""
    make = maker(POSES)
    off = 0.5 / FOCAL if with_info else 0.0
    R, t = R_EYE.T @ FACING, R_EYE.T @ (MIDDLE - EYE)
    quat = Rotation.from_matrix(R).as_quat()
    msg = listing(make, POSES, with_pose(make, tuple(t + off * np.array([t[2], t[2], 0.0])), tuple(quat)))
    path = bag_of(tmp_path, make, (INFO, info(make)), ("/tag_detections", msg))
    camera = {"topic": "/tag_detections", "mount": MOUNT} | ({"info_topic": INFO} if with_info else {})
    sighting = only(look(path, tags(("bow", camera))))
    at_the_eye(sighting, off_m=0.02, off_deg=0.6)
    assert len(sighting.modes) == 2
    assert min(mode.probability for mode in sighting.modes) > 0.2


def test_a_tag_that_is_not_surveyed_is_a_view(tmp_path: Path) -> None:
    make = Messages(2)
    second = MIDDLE + np.array([0.7, 0.0, 0.1])
    path = bag_of(tmp_path, make, (INFO, info(make)), (IMAGE, image(make, picture((7, MIDDLE), (12, second)))))
    (seen,), _ = look(path)
    at_the_eye(seen.sightings[0])
    assert seen.sightings[0].numbers == (7,)
    assert seen.troubles == ("tag 12 (36h11) is not in the survey",)
    (view,) = seen.views
    assert (view.number, view.family, view.stamp_ns) == (12, "36h11", START_NS)
    there = (second + np.array([-0.2, 0.0, 0.2]) - EYE) @ R_EYE
    np.testing.assert_allclose(view.rays[0], there[:2] / there[2], atol=0.3 / FOCAL)


def test_without_any_survey_all_tags_are_views(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """An empty file of tags is one to be written: what is seen goes to `tags.found.yaml`."""
    make = Messages(2)
    path = bag_of(tmp_path, make, (INFO, info(make)), (IMAGE, image(make, shown)))
    (tmp_path / "tags.yaml").write_text("")
    config = VesselConfig(sensors={"tags": tags(survey=()).model_copy(update={"survey": "tags.yaml"})})
    (seen,), _ = look(path, with_surveys(config, tmp_path).of_kind("apriltag")["tags"])
    assert not seen.sightings
    assert [view.number for view in seen.views] == [7]


# what bags have wrong: one line


def refused(path: Path, config: AprilTagConfig | None = None) -> str:
    with pytest.raises(InputError) as error:
        look(path, config)
    text = str(error.value)
    assert "\n" not in text
    return text


def test_no_camera_info(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    path = bag_of(tmp_path, make, (IMAGE, image(make, shown)))
    said = refused(path)
    assert said == f"{path}: cameras.bow: CameraInfo on '{INFO}': there is none; set `info_topic`; such topics: none"
    elsewhere = bag_of(tmp_path / "b", make, (IMAGE, image(make, shown)), ("/odd/info", info(make)))
    assert refused(elsewhere).endswith("set `info_topic`; such topics: /odd/info")
    of_another_type = bag_of(tmp_path / "c", make, (IMAGE, image(make, shown)), (INFO, make.text("f = 400")))
    assert "there is none" in refused(of_another_type)


WRONG_INFO: list[tuple[dict[str, Any], str]] = [
    ({"K": np.zeros(9)}, "K is all zeros: the camera is not calibrated"),
    ({"K": np.full(9, np.nan)}, "K is not finite"),
    ({"distortion_model": "omnidirectional"}, "unknown distortion model 'omnidirectional' (known: plumb_bob"),
    (
        {"distortion_model": "", "D": np.array([0.1, 0.0, 0.0, 0.0])},
        "4 distortion coefficients but no distortion model",
    ),
    ({"D": np.array([0.1, 0.2])}, "2 coefficients for plumb_bob, which has 4 or 5"),
]


@pytest.mark.parametrize(("changes", "why"), WRONG_INFO)
def test_a_camera_info_that_calibrates_nothing(
    tmp_path: Path, shown: NDArray[np.uint8], changes: dict[str, Any], why: str
) -> None:
    make = Messages(2)
    path = bag_of(tmp_path, make, (INFO, info(make, **changes)), (IMAGE, image(make, shown)))
    said = refused(path)
    assert said.startswith(f"{path}: cameras.bow: CameraInfo on '{INFO}': ")
    assert why in said


def test_a_camera_info_that_cannot_be_read(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """The first that can be is taken; none is one line."""
    make = Messages(2)
    broken = ("sensor_msgs/msg/CameraInfo", b"\x00\x01\x00\x00")
    path = bag_of(tmp_path, make, (INFO, broken), (INFO, info(make)), (IMAGE, image(make, shown)))
    at_the_eye(only(look(path)))
    path = bag_of(tmp_path / "all", make, (INFO, broken), (IMAGE, image(make, shown)))
    assert refused(path).endswith("no message can be read")


def test_a_camera_info_that_changes(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    zoomed = info(make, Lens(K=(800.0, 243.0, 156.5)))
    path = bag_of(tmp_path, make, (INFO, info(make)), (INFO, info(make)), (IMAGE, image(make, shown)), (INFO, zoomed))
    (seen,), (said,) = look(path)
    at_the_eye(seen.sightings[0])
    assert said.startswith(f"{path}: cameras.bow: CameraInfo on '{INFO}': it changes in the run")


def test_topics_that_are_none(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    path = bag_of(tmp_path, make, (INFO, info(make)), (IMAGE, image(make, shown)), ("/said", make.text("hello")))
    for topic in ("/camera/image", "/said"):
        said = refused(path, tags(("bow", {"topic": topic, "mount": MOUNT})))
        assert said == f"{path}: cameras.bow.topic '{topic}' holds no images and no detections; such topics: {IMAGE}"
    bare = bag_of(tmp_path / "bare", make, ("/said", make.text("hello")))
    assert refused(bare).endswith("such topics: none")


def test_no_cameras_and_one_topic_twice(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    path = bag_of(tmp_path, make, (INFO, info(make)), (IMAGE, image(make, shown)))
    without = AprilTagConfig.model_validate({"survey": {"tags": [TAG]}})
    assert "needs `cameras`: name, topic and mount of each" in refused(path, without)
    twice = tags(("bow", {"topic": IMAGE, "mount": MOUNT}), ("port", {"topic": IMAGE, "mount": MOUNT}))
    assert "cameras bow and port have the same topic" in refused(path, twice)


def test_corners_without_a_lens(tmp_path: Path) -> None:
    make = maker(CORNERS)
    path = bag_of(tmp_path, make, ("/detections", listing(make, CORNERS, with_corners(make, corners_seen()[::-1]))))
    said = refused(path, tags(("bow", {"topic": "/detections", "mount": MOUNT})))
    assert said == f"{path}: cameras.bow: its corners are pixels: give its `info_topic`"


SURVEYS = [
    (None, "cannot be read"),
    ("tags: [", "not valid YAML"),
    ("- a\n- b\n", "the top level must be a mapping"),
    ("tags: [{id: 7, xyz_m: [0, 0, 0], facing_deg: 0}]", "size_m"),
    ("tags: [{id: 7, size_m: 412, xyz_m: [0, 0, 0], facing_deg: 0}]", "size_m"),
    ("tags: [{id: 7, size_m: 0.4, xyz_m: [0, 0, 0]}]", "needs rpy_deg or facing_deg"),
    ("tags: [{id: 7, size: 0.4, xyz_m: [0, 0, 0], facing_deg: 0}]", "did you mean 'size_m'"),
]


@pytest.mark.parametrize(("text", "why"), SURVEYS)
def test_a_survey_that_is_missing_or_broken(tmp_path: Path, text: str | None, why: str) -> None:
    if text is not None:
        (tmp_path / "tags.yaml").write_text(text)
    config = VesselConfig(sensors={"tags": AprilTagConfig(survey="tags.yaml")})
    with pytest.raises(ConfigError) as error:
        with_surveys(config, tmp_path)
    assert str(tmp_path / "tags.yaml") in str(error.value)
    assert why in str(error.value)
    assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match=r"sensors.tags.survey: name the tags.yaml"):
        with_surveys(VesselConfig(sensors={"tags": AprilTagConfig()}), tmp_path)


# what bags have wrong: a row of the ledger


def test_images_that_cannot_be_used(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """Each is one trouble, that names the topic; the image after them is seen all the same."""
    make = Messages(2)
    small = cv2.resize(shown, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(np.uint8)
    none = np.zeros((0, 0), dtype=np.uint8)
    wrong: list[tuple[Any, str]] = [
        (image(make, small), f"an image of {WIDTH // 2} x {HEIGHT // 2} px with a CameraInfo for {WIDTH} x {HEIGHT} px: it is for"),
        (image(make, shown, encoding="32FC1"), "encoding '32FC1' is not known"),
        (image(make, none), "an image of 0 x 0 pixels"),
        (image(make, shown, data=np.zeros(0, dtype=np.uint8)), "0 bytes of data where"),
        (image(make, shown, 0), "its header has no stamp"),
        (("sensor_msgs/msg/Image", b"\x00\x01\x00\x00\x07"), "cannot be decoded ("),
    ]  # fmt: skip
    msgs = [(IMAGE, msg) for msg, _ in wrong]
    path = bag_of(tmp_path, make, (INFO, info(make)), *msgs, (IMAGE, image(make, shown)))
    found, said = look(path)
    assert not said
    for seen, (_, why) in zip(found, wrong, strict=False):
        assert not seen.sightings
        (trouble,) = seen.troubles
        assert trouble.startswith(f"{IMAGE}: {why}"), trouble
    at_the_eye(found[len(wrong)].sightings[0])


def test_jpegs_that_cannot_be_used(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    topic = f"{IMAGE}/compressed"
    depth = replace_data(jpeg(make, shown), b"\x00" * 12 + b"RVL")
    msgs = [jpeg(make, shown, keep=0.0), jpeg(make, shown, keep=0.002), depth, jpeg(make, shown)]
    path = bag_of(tmp_path, make, (INFO, info(make)), *((topic, m) for m in msgs))
    found, _ = look(path, tags(("bow", {"topic": topic, "mount": MOUNT})))
    assert [len(seen.troubles) for seen in found] == [1, 1, 1, 0]
    assert all("compressed data" in seen.troubles[0] for seen in found[:3])
    at_the_eye(found[3].sightings[0])


def replace_data(msg: Any, data: bytes) -> Any:
    return replace(msg, data=np.frombuffer(data, dtype=np.uint8))


def test_two_tags_of_one_id(tmp_path: Path) -> None:
    make = Messages(2)
    both = picture((7, MIDDLE), (7, MIDDLE + np.array([0.8, 0.0, 0.0])), (12, MIDDLE + np.array([-0.55, 0.0, 0.0])))
    path = bag_of(tmp_path, make, (INFO, info(make)), (IMAGE, image(make, both)))
    survey = (TAG, TAG | {"id": 12, "xyz_m": [19.45, 30.0, 1.5]})
    (seen,), _ = look(path, tags(survey=survey))
    assert seen.troubles == ("tag 7 is seen twice in one image: which one is meant cannot be told",)
    assert [s.numbers for s in seen.sightings] == [(12,)]
    at_the_eye(seen.sightings[0])


def test_detections_that_cannot_be_used(tmp_path: Path) -> None:
    make = maker(CORNERS)
    px = corners_seen()[::-1] + 0.5
    nan = px.copy()
    nan[2, 0] = np.nan
    wrong: list[tuple[Any, str]] = [
        (with_corners(make, px, hamming=2), "tag 7: 2 bits read wrong, more than max_hamming"),
        (with_corners(make, px, decision_margin=1.0), "tag 7: decision margin 1 is below min_margin"),
        (with_corners(make, px, id=8), "tag 8 (36h11) is not in the survey"),
        (with_corners(make, px, family="tag25h9"), "tag 7 (25h9) is not in the survey"),
        (with_corners(make, nan), "tag 7: its corners are not finite"),
        (with_corners(make, px[::-1]), "tag 7: its corners are no quadrilateral in AprilTag's order"),
    ]
    msgs = [("/detections", listing(make, CORNERS, entry)) for entry, _ in wrong]
    path = bag_of(tmp_path, make, (INFO, info(make)), *msgs)
    found, _ = look(path, tags(("bow", {"topic": "/detections", "info_topic": INFO, "mount": MOUNT})))
    assert [seen.sightings for seen in found] == [()] * len(wrong)
    for k, (seen, (_, why)) in enumerate(zip(found, wrong, strict=True)):
        (line,) = seen.doubtful if k < 2 else seen.troubles
        assert why in line
        assert len(seen.troubles) + len(seen.doubtful) == 1
    loose, _ = look(path, tags(("bow", {"topic": "/detections", "info_topic": INFO, "mount": MOUNT}), max_hamming=2))
    at_the_eye(loose[0].sightings[0])


def test_poses_that_cannot_be_used(tmp_path: Path) -> None:
    """Among them a size that is left at another tag's: then its place is off by the same factor, and nobody sees it."""
    make = maker(POSES)
    wrong: list[tuple[Any, str]] = [
        (with_pose(make, (0.0, 0.0, 3.0), sizes=(0.162,)), "tag 7: its detector took it for 0.162 m wide, the survey for 0.4 m"),
        (with_pose(make, (0.0, float("nan"), 3.0)), "tag 7: its pose is not finite"),
        (with_pose(make, (0.0, 0.0, -3.0)), "tag 7: it lies behind the camera"),
        (with_pose(make, (0.0, 0.0, 3.0), ids=(7, 8), sizes=(0.4, 0.4)), "tag bundle 7, 8"),
        (with_pose(make, (0.0, 0.0, 3.0), sizes=(float("nan"),)), "tag 7: its size is nan m"),
    ]  # fmt: skip
    msgs = [("/tag_detections", listing(make, POSES, entry)) for entry, _ in wrong]
    found, _ = look(bag_of(tmp_path, make, *msgs), tags(("bow", {"topic": "/tag_detections", "mount": MOUNT})))
    assert [seen.sightings for seen in found] == [()] * len(wrong)
    for seen, (_, why) in zip(found, wrong, strict=True):
        assert len(seen.troubles) == 1
        assert why in seen.troubles[0]


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


def rows_of(recording: Recording, sensor: str) -> list[LedgerRow]:
    return [row for row in recording.rows if row.sensor == sensor]


def test_the_ledger_adds_up(tmp_path: Path) -> None:
    """Six messages: two sightings each of two; one tag that is not known; one empty; one of another size; one broken."""
    make = Messages(2)
    second, third = MIDDLE + np.array([0.7, 0.0, 0.0]), MIDDLE + np.array([-0.55, 0.0, 0.0])
    dock = {"name": "pier", "xyz_m": second.tolist()}
    on_dock = TAG | {"id": 12, "frame": "pier", "xyz_m": [0.0, 0.0, 0.0]}
    config = AprilTagConfig.model_validate(
        {"survey": {"tags": [TAG, on_dock], "docks": [dock]}, "cameras": {"bow": {"topic": IMAGE, "mount": MOUNT}}}
    )
    both, unknown = picture((7, MIDDLE), (12, second)), picture((3, third))
    msgs = [
        image(make, both, START_NS + S), image(make, both, START_NS + 2 * S), image(make, unknown, START_NS + 3 * S),
        image(make, np.full((HEIGHT, WIDTH), 90, dtype=np.uint8), START_NS + 4 * S),
        image(make, both[:100], START_NS + 5 * S), image(make, both, 0),
    ]  # fmt: skip
    recording, said = recorded(tmp_path, make, config, (INFO, info(make)), *((IMAGE, m) for m in msgs))
    # 500 IMU samples, 50 fixes, 1 CameraInfo, 6 images; 4 sightings, 3 troubles.
    assert recording.message_count == 500 + 50 + 1 + 6 + 4 + 3
    assert recording.message_count == accounted(recording)
    seen = [m for m in recording.measurements if isinstance(m, TagSighting)]
    assert [(m.frame, m.numbers) for m in seen] == [("world", (7,)), ("pier", (12,))] * 2
    assert [row.outcome for row in rows_of(recording, "tags")] == [Outcome.REJECTED] * 3
    assert [row.reason.split(":")[0] for row in rows_of(recording, "tags")] == [
        "tag 3 (36h11) is not in the survey", IMAGE, IMAGE
    ]  # fmt: skip
    (topic,) = [row for row in recording.rows if row.topic == IMAGE]
    assert (topic.count, topic.outcome, topic.reason) == (
        6, Outcome.READ, "read by tags; 4 of 6 show no tag that can be used"
    )  # fmt: skip
    assert [view.number for view in recording.tag_views] == [3]
    assert "tags: tag 3 (36h11) is not in the survey (1 times)" in recording.warnings
    assert said == [("looking for tags", k, 6) for k in range(1, 7)]
    assert recording.topics["tags"] == "(tags)"
    assert [m.stamp_ns for m in recording.measurements] == sorted(m.stamp_ns for m in recording.measurements)


@pytest.mark.parametrize(("misread", "warned"), [(1, False), (2, False), (3, True), (4, True)])
def test_a_limit_that_refuses_is_said_where_it_refuses_most(tmp_path: Path, misread: int, warned: bool) -> None:
    """Of four lists with a tag, and two without: that a tag is misread now and then is what the limit is there for."""
    make = maker(CORNERS)
    px = corners_seen()[::-1] + 0.5
    entries = [[with_corners(make, px, hamming=2 if k < misread else 0)] for k in range(4)] + [[], []]
    msgs = [("/detections", listing(make, CORNERS, *e)) for e in entries]
    config = tags(("bow", {"topic": "/detections", "info_topic": INFO, "mount": MOUNT}))
    recording, _ = recorded(tmp_path, make, config, (INFO, info(make)), *msgs)
    why = "tag 7: 2 bits read wrong, more than max_hamming"
    assert [row.reason for row in rows_of(recording, "tags")] == [why] * misread
    said = [line for line in recording.warnings if "bits read wrong" in line]
    assert said == ([f"tags: {misread} of 4 images with tags show one that is refused, most often: {why}"] * warned)


@pytest.mark.parametrize("size_m", [0.4, 0.5])
def test_sizes_that_cannot_be_are_refused(tmp_path: Path, size_m: float) -> None:
    """White margins were measured, too: nine lists of two tags, whose distance tells; the tenth, of one, goes with them."""
    make = maker(CORNERS)
    second = MIDDLE + np.array([0.7, 0.0, 0.1])
    one = with_corners(make, corners_seen()[::-1] + 0.5)
    both = [one, with_corners(make, corners_seen(second)[::-1] + 0.5, id=12)]
    lists = [
        make.t[CORNERS](header=make.header(START_NS + k * S), detections=both if k < 10 else [one])
        for k in range(1, 11)
    ]
    msgs = [("/detections", entries) for entries in lists]
    wide = TAG | {"size_m": size_m}
    block = {"topic": "/detections", "info_topic": INFO, "mount": MOUNT}
    config = tags(("bow", block), survey=(wide, wide | {"id": 12, "xyz_m": second.tolist()}))
    recording, _ = recorded(tmp_path, make, config, (INFO, info(make)), *msgs)
    said = [line for line in recording.warnings if "spacing" in line]
    reasons = {row.reason for row in rows_of(recording, "tags")}
    used = sum(isinstance(m, TagSighting) for m in recording.measurements)
    if size_m == TAG["size_m"]:
        assert (said, reasons, used) == ([], set(), 10)
    else:
        why = "sizes in tags.yaml disagree with the spacing of the tags by 25 %"
        assert reasons == {why}
        assert used == 0
        (line,) = said
        assert line.startswith(f"tags: {why}: measure one")
        assert "size_m times 0.80 would do" in line
    assert recording.message_count == accounted(recording)


def test_a_sensor_that_is_switched_off_reads_nothing(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    recording, said = recorded(tmp_path, make, tags(enabled=False), (IMAGE, image(make, shown)))  # and no CameraInfo
    assert not said
    assert not any(isinstance(m, TagSighting) for m in recording.measurements)
    assert recording.message_count == 551 == accounted(recording)


def test_a_topic_without_messages_is_said(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """A camera that was announced, and never sent: else the run looks as if no tag had been in view."""
    make = Messages(2)
    blank = np.full((HEIGHT, WIDTH), 90, dtype=np.uint8)
    recording, _ = recorded(tmp_path, make, tags(), (INFO, info(make)), (IMAGE, image(make, blank)))
    assert any("tags" in said and "none of 1" in said for said in recording.warnings)


def test_images_are_not_kept(tmp_path: Path, shown: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch) -> None:
    """As many of them live as are being looked at, however long the run is."""
    make = Messages(2)
    alive: list[weakref.ref[Any]] = []
    whole = sightings._decoded  # noqa: SLF001 - what is decoded is what must not pile up

    def watched(bag: Any, raw: Any) -> Any:
        msg = whole(bag, raw)
        alive.append(weakref.ref(msg.data))
        return msg

    monkeypatch.setattr(sightings, "_decoded", watched)
    monkeypatch.setattr(sightings, "_cores", lambda: 1)
    blank = image(make, np.full((HEIGHT, WIDTH), 90, dtype=np.uint8))
    path = bag_of(tmp_path, make, (INFO, info(make)), *[(IMAGE, blank)] * 20, (IMAGE, image(make, shown)))
    kept, most = [], 0
    for seen in sightings_of_bag([path], "tags", tags(), "base_link", warn=lambda _: None):
        kept.append(seen)
        gc.collect()
        most = max(most, sum(ref() is not None for ref in alive))
    assert len(alive) == len(kept) == 21
    assert most <= 4
    assert kept[-1].sightings


@pytest.mark.parametrize(
    ("topic", "beside"),
    [
        ("/camera/image_raw", "/camera/camera_info"),
        ("/camera/image_raw/compressed", "/camera/camera_info"),
        ("/zed/left/image_rect_color", "/zed/left/camera_info"),
        ("/image", "/camera_info"),
    ],
)
def test_where_a_camera_info_lies_by_custom(topic: str, beside: str) -> None:
    assert info_beside(topic) == beside
