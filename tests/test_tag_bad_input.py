# SPDX-License-Identifier: Apache-2.0
"""What bags with cameras have wrong: one line, or a row of the ledger."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc.config import AprilTagConfig, VesselConfig
from graphloc.errors import ConfigError, InputError
from graphloc.gather import with_surveys
from tests.bagfactory import Messages
from tests.tagimages import (
    HEIGHT,
    IMAGE,
    INFO,
    MIDDLE,
    MOUNT,
    TAG,
    WIDTH,
    Lens,
    at_the_eye,
    bag_of,
    corners_seen,
    image,
    info,
    jpeg,
    look,
    only,
    picture,
    replace_data,
    tags,
)
from tests.test_tag_lists import CORNERS, POSES, listing, maker, with_corners, with_pose


@pytest.fixture(scope="module")
def shown() -> NDArray[np.uint8]:
    return picture((7, MIDDLE))


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


def test_transforms_that_cannot_be_read_are_done_without_and_told(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    static, junk = (
        make.transforms([("base_link", "lens", (1, 0, 0), (0, 0, 0, 1))]),
        ("tf2_msgs/msg/TFMessage", b"\x01"),
    )
    mounted = tags(cameras={"bow": {"topic": IMAGE, "mount": {"tf_frame": "lens"}}})
    shot = ((INFO, info(make)), (IMAGE, image(make, shown)))
    (seen,), (said,) = look(bag_of(tmp_path, make, ("/tf_static", static), ("/tf_static", junk), *shot), mounted)
    assert seen.sightings[0].t_body_camera_m.tolist() == [1.0, 0.0, 0.0]
    assert said.endswith("/tf_static: messages that cannot be decoded: 1; cameras have their mounts from the rest")
    (tmp_path / "none").mkdir()
    said = refused(bag_of(tmp_path / "none", make, ("/tf_static", static), ("/tf_static", junk), *shot),
                   tags(cameras={"bow": {"topic": IMAGE, "mount": {"tf_frame": "mast"}}}))  # fmt: skip
    assert "cameras.bow.mount.tf_frame: no chain from 'base_link' to 'mast'" in said
    assert "(frames there: base_link, lens; messages that cannot be decoded: 1)" in said


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


def test_two_cameras_on_one_topic_are_not_placed_by_one_mount(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    """The first image tells which is meant, as the mount names no frame."""
    make = Messages(2)

    def framed(frame: str) -> Any:
        msg = image(make, shown)
        msg.header.frame_id = frame
        return IMAGE, msg

    path = bag_of(tmp_path, make, (INFO, info(make)), *map(framed, ("/bow", "port", "bow", "")))
    found, _ = look(path)
    assert [len(seen.sightings) for seen in found] == [1, 0, 1, 1]
    (said,) = found[1].troubles
    assert said == (
        f"{IMAGE}: a message in frame 'port' where others are in 'bow': of another camera, whose mount is not that of bow; "
        "record each on a topic of its own"
    )


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
