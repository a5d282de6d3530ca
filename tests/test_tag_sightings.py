# SPDX-License-Identifier: Apache-2.0
"""From a bag to sightings of tags: images traced in the test, through every kind of message."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import AprilTagConfig, VesselConfig
from graphloc.errors import InputError
from graphloc.frontends.tags import sightings
from graphloc.frontends.tags.sightings import camera_info_topic, sightings_of_bag
from graphloc.gather import with_surveys
from graphloc.ledger import Outcome
from graphloc.measurements import TagSighting
from tests.bagfactory import START_NS, Messages, S, rows_of
from tests.tagfactory import AHEAD, FACES_SOUTH
from tests.tagimages import (
    BENT,
    EYE,
    FOCAL,
    HEIGHT,
    IMAGE,
    INFO,
    MIDDLE,
    MOUNT,
    R_EYE,
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
    looking,
    only,
    picture,
    recorded,
    tags,
)
from tests.test_bag import accounted
from tests.test_tag_lists import CORNERS, POSES, listing, maker, with_corners, with_pose


@pytest.fixture(scope="module")
def shown() -> NDArray[np.uint8]:
    return picture((7, MIDDLE))


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
    recorded = only(look(path, tags(stamps="recorded"))).stamp_ns
    assert recorded != stamp_ns
    (tmp_path / "never").mkdir()
    never = bag_of(tmp_path / "never", make, (INFO, info(make)), (IMAGE, image(make, shown, 0)))
    assert only(look(never, tags(stamps="recorded"))).stamp_ns == recorded


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
    R, t = R_EYE.T @ FACES_SOUTH, R_EYE.T @ (MIDDLE - EYE)
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
    seen = recording.of(TagSighting)
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


def test_images_that_cannot_be_used_are_no_tags_that_are_missing(tmp_path: Path) -> None:
    """Of another size than their CameraInfo's, ids and family are not what to check; without a tag they are."""
    make, shown = Messages(2), picture((7, MIDDLE))
    plain = np.full((HEIGHT, WIDTH), 90, dtype=np.uint8)
    none = "tags: none of 2 images or detection messages shows a tag of the survey: "
    for name, pixels, why in (
        ("cut", shown[:100], "the reason follows"),
        ("plain", plain, "check ids and family there"),
    ):
        (tmp_path / name).mkdir()
        msgs = [(INFO, info(make)), *((IMAGE, image(make, pixels, START_NS + k * S)) for k in (1, 2))]
        recording, _ = recorded(tmp_path / name, make, tags(), *msgs)
        assert [line for line in recording.warnings if line.startswith(none)] == [f"{none}{why}"]


@pytest.mark.parametrize(("misread", "warned"), [(1, False), (2, False), (3, True), (4, True)])
def test_a_limit_that_refuses_is_reported_where_it_refuses_most(tmp_path: Path, misread: int, warned: bool) -> None:
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
    assert said == ([f"tags: {misread} of 4 images with tags have a rejected detection, most often: {why}"] * warned)


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
        assert line.startswith(f"tags: {why}: measure a tag")
        assert "size_m times 0.80 would agree" in line
    assert recording.message_count == accounted(recording)


def test_a_sensor_that_is_switched_off_reads_nothing(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
    make = Messages(2)
    recording, said = recorded(tmp_path, make, tags(enabled=False), (IMAGE, image(make, shown)))  # and no CameraInfo
    assert not said
    assert not any(isinstance(m, TagSighting) for m in recording.measurements)
    assert recording.message_count == 551 == accounted(recording)


def test_a_topic_without_messages_is_reported(tmp_path: Path, shown: NDArray[np.uint8]) -> None:
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

    def watched(*given: Any) -> Any:
        msg = whole(*given)
        alive.append(weakref.ref(msg.data))
        return msg

    monkeypatch.setattr(sightings, "_decoded", watched)
    monkeypatch.setattr(sightings, "_cores", lambda: 1)
    blank = image(make, np.full((HEIGHT, WIDTH), 90, dtype=np.uint8))
    path = bag_of(tmp_path, make, (INFO, info(make)), *[(IMAGE, blank)] * 10, (IMAGE, image(make, shown)))
    kept, most = [], 0
    gc.freeze()  # what other tests keep alive need not be looked through for each image
    for seen in sightings_of_bag([path], "tags", tags(), "base_link", warn=lambda _: None):
        kept.append(seen)
        gc.collect()
        most = max(most, sum(ref() is not None for ref in alive))
    gc.unfreeze()
    assert len(alive) == len(kept) == 11
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
    assert camera_info_topic(topic) == beside
