# SPDX-License-Identifier: Apache-2.0
"""Detections that bags hold already: through bags of every kind, corners against a print whose corners are known."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from pupil_apriltags import Detector
from scipy.spatial.transform import Rotation

from graphloc.config import AprilTagConfig, load_config
from graphloc.factors import KINDS
from graphloc.frames import Array
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.frontends.source import Bag
from graphloc.frontends.tags.listed import LISTS, ListedTag, read_list
from tests.bagfactory import START_NS, Messages, still_run, write_bag
from tests.tagimages import image, info

CORNERS, POSES = "apriltag_msgs/msg/AprilTagDetectionArray", "apriltag_ros/msg/AprilTagDetectionArray"
# As christianrauch/apriltag_msgs and AprilRobotics/apriltag_ros have them.
DEFINITIONS = {
    CORNERS: {
        "apriltag_msgs/msg/Point": "float64 x\nfloat64 y",
        "apriltag_msgs/msg/AprilTagDetection": "string family\nint32 id\nint32 hamming\nfloat32 goodness\n"
        "float32 decision_margin\nPoint centre\nPoint[4] corners\nfloat64[9] homography",
        CORNERS: "std_msgs/Header header\nAprilTagDetection[] detections",
    },
    POSES: {
        "apriltag_ros/msg/AprilTagDetection": "int32[] id\nfloat64[] size\n"
        "geometry_msgs/PoseWithCovarianceStamped pose",
        POSES: "std_msgs/Header header\nAprilTagDetection[] detections",
    },
}
AWAY = (1.0, 0.0, 0.0, 0.0)  # half a turn about x: a tag whose print faces the camera, upright


def maker(msgtype: str) -> Messages:
    make = Messages(1 if msgtype == POSES else 2)
    for name, text in DEFINITIONS[msgtype].items():
        make.register(text, name)
    return make


def with_corners(make: Messages, corners: Array, **changes: Any) -> Any:
    """An `AprilTagDetection`; corners (4, 2) as AprilTag gives them."""
    point, detection = (make.t[f"apriltag_msgs/msg/{n}"] for n in ("Point", "AprilTagDetection"))
    given: dict[str, Any] = {"family": "tag36h11", "id": 7, "hamming": 1, "decision_margin": 61.5} | changes
    return detection(
        goodness=0.0, centre=point(x=0.0, y=0.0), corners=[point(x=float(x), y=float(y)) for x, y in corners],
        homography=np.eye(3).ravel(), **given,
    )  # fmt: skip


def with_pose(
    make: Messages, xyz: tuple[float, ...], xyzw: tuple[float, ...] = AWAY, ids: Any = (7,), sizes: Any = (0.4,)
) -> Any:
    return make.t["apriltag_ros/msg/AprilTagDetection"](
        id=np.array(ids, dtype=np.int32), size=np.array(sizes, dtype=float), pose=make.pose(START_NS, xyz, xyzw)
    )


def listing(make: Messages, msgtype: str, *entries: Any) -> Any:
    return make.t[msgtype](header=make.header(START_NS), detections=list(entries))


def only(found: tuple[list[ListedTag], list[str]]) -> ListedTag:
    (tag,), unusable = found
    assert not unusable
    return tag


def rays_of(tag: ListedTag) -> Array:
    assert tag.rays is not None
    assert tag.corners_px is None
    return tag.rays


def px_of(tag: ListedTag) -> Array:
    assert tag.corners_px is not None
    assert tag.rays is None
    return tag.corners_px


def why_not(found: tuple[list[ListedTag], list[str]]) -> str:
    tags, (line,) = found
    assert not tags
    assert "\n" not in line
    return line


# A tag 20 px wide, upright: bottom left, bottom right, top right, top left, from the outer corner of the first pixel.
UPRIGHT = np.array([(10.0, 30.0), (30.0, 30.0), (30.0, 10.0), (10.0, 10.0)])


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_corners_through_a_bag(tmp_path: Path, kind: str) -> None:
    make = maker(CORNERS)
    msg = listing(make, CORNERS, with_corners(make, UPRIGHT), with_corners(make, UPRIGHT + 50.0, id=9))
    with Bag(write_bag(tmp_path / "bag", make, [("/detections", START_NS, msg)], kind)) as bag:
        (raw,) = bag.messages(["/detections"])
        tags, unusable = read_list(bag.decode(raw), raw.msgtype)
        assert not bag.warnings
    assert raw.msgtype in LISTS
    assert ([t.number for t in tags], unusable) == ([7, 9], [])
    assert (tags[0].family, tags[0].hamming, tags[0].margin, tags[0].size_m) == ("tag36h11", 1, 61.5, None)
    np.testing.assert_array_equal(px_of(tags[0]), [(9.5, 9.5), (29.5, 9.5), (29.5, 29.5), (9.5, 29.5)])


def test_poses_through_a_ros1_bag(tmp_path: Path) -> None:
    """A tag of 0.4 m, 2 m ahead, 0.1 m to the right and 0.3 m below, upright: corners at (0.1 -+ 0.2) / 2, and so on."""
    make = maker(POSES)
    msg = listing(make, POSES, with_pose(make, (0.1, 0.3, 2.0)))
    with Bag(write_bag(tmp_path / "bag.bag", make, [("/tag_detections", START_NS, msg)], "ros1")) as bag:
        (raw,) = bag.messages(["/tag_detections"])
        tag = only(read_list(bag.decode(raw), raw.msgtype))
        assert not bag.warnings
    assert raw.msgtype in LISTS
    assert (tag.number, tag.family, tag.hamming, tag.margin, tag.size_m) == (7, "", None, None, 0.4)
    np.testing.assert_allclose(rays_of(tag), [(-0.05, 0.05), (0.15, 0.05), (0.15, 0.25), (-0.05, 0.25)], atol=1e-15)


def test_a_turned_tag_has_its_own_top_left() -> None:
    """By hand: the print turned 90 deg clockwise, as the camera sees it, has its top left at the top right."""
    make = maker(POSES)
    turned = Rotation.from_quat(AWAY) * Rotation.from_euler("z", -90, degrees=True)  # z out of the print
    tag = only(read_list(listing(make, POSES, with_pose(make, (0.0, 0.0, 2.0), tuple(turned.as_quat()))), POSES))
    np.testing.assert_allclose(rays_of(tag), [(0.1, -0.1), (0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1)], atol=1e-12)
    # Then swung by 30 deg about the camera's y axis: what was at x = 0.2 comes to x = 0.173 and 0.1 m nearer.
    swung = Rotation.from_euler("y", 30, degrees=True) * turned
    tag = only(read_list(listing(make, POSES, with_pose(make, (0.0, 0.0, 2.0), tuple(swung.as_quat()))), POSES))
    x, y = 0.2 * np.cos(np.pi / 6.0) * np.array([1.0, 1.0, -1.0, -1.0]), 0.2 * np.array([-1.0, 1.0, 1.0, -1.0])
    z = np.array([1.9, 1.9, 2.1, 2.1])
    np.testing.assert_allclose(rays_of(tag), np.column_stack([x / z, y / z]), atol=1e-12)


def test_the_print_is_upright_as_its_family_publishes_it() -> None:
    """Number 0 of 36h11 is 0xd5d628584, row by row from the top left (AprilRobotics/apriltag, tag36h11.c of 2018)."""
    bits = [[int(b) for b in row] for row in ("110101", "011101", "011000", "101000", "010110", "000100")]
    assert int("".join(str(b) for row in bits for b in row), 2) == 0xD5D628584
    np.testing.assert_array_equal(printed(0)[1:-1, 1:-1] > 127, np.array(bits, dtype=bool))


def printed(number: int) -> Any:
    """Cells (8, 8) of a tag as AprilTag prints it; OpenCV has the family upside down."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return np.rot90(cv2.aruco.generateImageMarker(family, number, 8), 2)


@pytest.fixture(scope="module")
def detector() -> Iterator[Detector]:
    made = Detector(families="tag36h11", quad_decimate=1.0)
    yield made
    made.tag_detector_ptr = None  # its destructor frees the families twice, and the heap breaks


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 90.0, 135.0, 180.0, 270.0, 300.0])
def test_corners_are_those_of_the_print(detector: Detector, turn_deg: float) -> None:
    """From the print to the message: top left first and clockwise, and (0, 0) the middle of a pixel.

    AprilTag itself errs by up to 0.2 px at sharp edges along the rows, outwards and inwards.
    """
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    square = 70.0 * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])  # of the print, y down
    upright = square @ np.array([[c, s], [-s, c]])
    true = upright / (1.0 + 0.0015 * upright[:, :1]) + (161.3, 118.7)  # seen somewhat from the side
    cell, fine = 16, 8
    rim = np.pad(np.kron(printed(7), np.ones((cell, cell), dtype=np.uint8)), 3 * cell, constant_values=255)
    low, high = 3 * cell - 0.5, 11 * cell - 0.5  # a pixel's middle is a whole number, its rim half a pixel off
    there = np.array([(low, low), (high, low), (high, high), (low, high)], dtype=np.float32)
    H = cv2.getPerspectiveTransform(there, (fine * (true + 0.5) - 0.5).astype(np.float32))
    large = cv2.warpPerspective(rim, H, (320 * fine, 240 * fine), flags=cv2.INTER_LINEAR, borderValue=255)
    (seen,) = detector.detect(cv2.resize(large, (320, 240), interpolation=cv2.INTER_AREA))
    make = maker(CORNERS)
    entry = with_corners(
        make, seen.corners, id=seen.tag_id, hamming=seen.hamming, decision_margin=seen.decision_margin,
        family=seen.tag_family.decode(),
    )  # fmt: skip
    tag = only(read_list(listing(make, CORNERS, entry), CORNERS))
    assert (tag.number, tag.family, tag.hamming) == (7, "tag36h11", 0)
    off = px_of(tag) - true
    assert np.abs(off).max() < 0.25
    assert np.abs(off.mean(axis=0)).max() < 0.1


@pytest.mark.parametrize(("said", "family"), [
    ("tag36h11", "tag36h11"), ("tf36h11", "tag36h11"), ("36h11", "tag36h11"), ("tfStandard41h12", "tagStandard41h12"),
    ("tagCircle21h7", "tagCircle21h7"), ("", ""), ("ours", "ours"),
])  # fmt: skip
def test_one_name_for_a_family(said: str, family: str) -> None:
    make = maker(CORNERS)
    assert only(read_list(listing(make, CORNERS, with_corners(make, UPRIGHT, family=said)), CORNERS)).family == family


def test_other_versions_of_the_messages() -> None:
    """Fields that came later are passed over; corners of 2018 were eight numbers."""
    old = SimpleNamespace(
        id=3, family="36h11", hamming=0, decision_margin=float("nan"), corners=UPRIGHT.ravel(), pose="of later years"
    )
    tag = only(read_list(SimpleNamespace(detections=[old]), CORNERS))
    assert (tag.number, tag.margin) == (3, None)
    np.testing.assert_array_equal(px_of(tag)[0], (9.5, 9.5))


@pytest.mark.parametrize("msgtype", LISTS)
def test_a_type_that_only_has_the_name(msgtype: str) -> None:
    """A fork's own definition, that the bag brings along: a line, and no end of the run."""
    entry = SimpleNamespace(id=3, corners=UPRIGHT.ravel(), size=0.4)
    assert why_not(read_list(SimpleNamespace(detections=[entry]), msgtype)).startswith(
        f"a detection unlike those of {msgtype} ("
    )


@pytest.mark.parametrize(("corners", "says"), [
    (np.full((4, 2), np.nan), "tag 7: its corners are not finite"),
    (UPRIGHT[::-1], "tag 7: its corners are no quadrilateral in AprilTag's order (counter-clockwise)"),
    (UPRIGHT[[0, 2, 1, 3]], "tag 7: its corners are no quadrilateral"),
    (np.zeros((4, 2)), "tag 7: its corners are no quadrilateral"),
    (np.array([(10.0, 30.0), (30.0, 30.0), (12.0, 28.0), (10.0, 10.0)]), "tag 7: its corners are no quadrilateral"),
])  # fmt: skip
def test_corners_that_no_tag_has(corners: Array, says: str) -> None:
    make = maker(CORNERS)
    assert why_not(read_list(listing(make, CORNERS, with_corners(make, corners)), CORNERS)).startswith(says)


@pytest.mark.parametrize(("given", "says"), [
    ({"xyz": (0.0, 0.0, 2.0), "sizes": (0.0,)}, "tag 7: its size is 0 m"),
    ({"xyz": (0.0, 0.0, 2.0), "sizes": (-0.4,)}, "tag 7: its size is -0.4 m"),
    ({"xyz": (0.0, 0.0, 2.0), "sizes": (np.nan,)}, "tag 7: its size is nan m"),
    ({"xyz": (0.0, 0.0, 2.0), "sizes": (np.inf,)}, "tag 7: its size is inf m"),
    ({"xyz": (0.0, np.nan, 2.0)}, "tag 7: its pose is not finite"),
    ({"xyz": (0.0, 0.0, 2.0), "xyzw": (0.0, 0.0, 0.0, 0.0)}, "tag 7: its pose is not finite, or its quaternion not"),
    ({"xyz": (0.0, 0.0, 2.0), "xyzw": (np.nan, 0.0, 0.0, 1.0)}, "tag 7: its pose is not finite"),
    ({"xyz": (0.0, 0.0, 2.0), "xyzw": (1.2, 0.0, 0.0, 0.0)}, "tag 7: its pose is not finite, or its quaternion not"),
    ({"xyz": (0.0, 0.0, -2.0)}, "tag 7: it lies behind the camera, -2.00 m along the optical axis"),
    ({"xyz": (0.0, 0.0, 0.0)}, "tag 7: it lies behind the camera"),
    # One corner beside the camera: turned about y so that its right edge comes 0.2 m nearer.
    ({"xyz": (0.0, 0.0, 0.1), "xyzw": (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)}, "tag 7: it lies behind the camera"),
    ({"xyz": (0.0, 0.0, 2.0), "xyzw": (0.0, 0.0, 0.0, 1.0)}, "tag 7: it is seen from behind"),
    ({"xyz": (0.0, 0.0, 2.0), "ids": (1, 2, 3), "sizes": (0.1, 0.1, 0.1)},
     "tag bundle 1, 2, 3: use single tags or raw images"),
    ({"xyz": (0.0, 0.0, 2.0), "sizes": ()}, "a detection with 1 ids and 0 sizes"),
    ({"xyz": (0.0, 0.0, 2.0), "ids": (), "sizes": ()}, "a detection with 0 ids and 0 sizes"),
])  # fmt: skip
def test_poses_that_no_tag_has(given: dict[str, Any], says: str) -> None:
    make = maker(POSES)
    assert why_not(read_list(listing(make, POSES, with_pose(make, **given)), POSES)).startswith(says)


def test_a_bad_entry_spoils_no_other() -> None:
    make = maker(POSES)
    entries = [
        with_pose(make, (0.0, 0.0, 2.0)), with_pose(make, (0.0, 0.0, -2.0), ids=(8,)),
        with_pose(make, (0.0, 0.0, 3.0), tuple(1.003 * np.array(AWAY)), ids=(9,)),  # a quaternion in single precision
    ]  # fmt: skip
    tags, unusable = read_list(listing(make, POSES, *entries), POSES)
    assert [t.number for t in tags] == [7, 9]
    assert [line.split(":")[0] for line in unusable] == ["tag 8"]
    np.testing.assert_allclose(np.abs(rays_of(tags[1])), 0.2 / 3.0)  # the length of a quaternion is not one of the tag
    assert read_list(listing(make, POSES), POSES) == ([], [])


def test_a_draft_allows_for_the_edges_of_another_detector(tmp_path: Path) -> None:
    """AprilTag 3 on images as a camera gives them: 0.2 m off, and 55 % of the time within its bounds of 95 %."""
    make = maker(CORNERS)
    items = [*still_run(make), ("/detections", START_NS, listing(make, CORNERS, with_corners(make, np.eye(4, 2))))]
    draft = draft_config(inspect_bag(write_bag(tmp_path / "lists", make, items)))
    assert "    edge_sigma_px: 0.3  # guess" in draft
    (tmp_path / "vessel.yaml").write_text(draft)
    tags = load_config(tmp_path / "vessel.yaml", KINDS).sensors["tags"]
    assert isinstance(tags, AprilTagConfig)
    assert tags.edge_sigma_px == 0.3


def test_a_draft_finds_the_camera_info_of_a_list(tmp_path: Path) -> None:
    """It lies beside images; a list has it under any name: that with its frame, or of a single camera the only one.

    A list beside the images that it was made of is left out: each tag would count twice.
    """
    make = maker(CORNERS)

    def of(msg: Any, frame: str) -> Any:
        return replace(msg, header=make.header(START_NS, frame))

    def drafted(name: str, *some: tuple[str, Any]) -> str:
        items = [*still_run(make), *((topic, START_NS, msg) for topic, msg in some)]
        return draft_config(inspect_bag(write_bag(tmp_path / name, make, items)))

    listed = ("/detections", of(listing(make, CORNERS, with_corners(make, np.eye(4, 2))), "/left"))
    left, right = ("/left/info", of(info(make), "left")), ("/right/camera_info", of(info(make), "right"))
    assert "info_topic: /left/info  # guess: the one of its frame" in drafted("frame", listed, right, left)
    assert "info_topic: /right/camera_info  # guess: the only one" in drafted("one", listed, right)
    assert "info_topic: ''  # guess" in drafted("none", listed)
    shot = ("/left/image_raw", of(image(make, np.zeros((8, 8), np.uint8)), "left"))
    both = drafted("both", listed, left, right, shot)
    assert "  # /detections: left out; the same camera as /left/image_raw" in both
    assert "edge_sigma_px" not in both
    (tmp_path / "vessel.yaml").write_text(both)
    tags = load_config(tmp_path / "vessel.yaml", KINDS).sensors["tags"]
    assert isinstance(tags, AprilTagConfig)
    assert [(c.topic, c.info_topic) for c in tags.cameras.values()] == [("/left/image_raw", "/left/info")]
    two = drafted("two", listed, right, ("/right/image_raw", of(shot[1], "right")))
    assert "info_topic: ''  # guess" in two  # it is the other camera's


def test_a_draft_finds_the_optical_frame_of_a_camera_link(tmp_path: Path) -> None:
    """Drivers stamp images with a frame that has x ahead and z up: as an optical frame it would look at the sky.

    Here it is turned 90 deg to port and 10 deg down: (1, 0, 0) of the link, z of the optical frame, is (0, cos, -sin) in body.
    """
    make = maker(CORNERS)
    q = Rotation.from_euler("ZYX", [90.0, 10.0, 0.0], degrees=True)
    for name, turn in (("link", q), ("optical", q * Rotation.from_euler("ZYX", [-90.0, 0.0, -90.0], degrees=True))):
        static = make.transforms([("base_link", "camera", (1.0, 2.0, 3.0), turn.as_quat().tolist())])
        items = [
            ("/tf_static", START_NS, static),
            *((t, START_NS, m(make)) for t, m in (("/c/camera_info", info), ("/c/image", blank))),
        ]
        (tmp_path / f"{name}.yaml").write_text(
            draft_config(inspect_bag(write_bag(tmp_path / name, make, [*items, *still_run(make)])))
        )
        tags = load_config(tmp_path / f"{name}.yaml", KINDS).sensors["tags"]
        assert isinstance(tags, AprilTagConfig)
        mount = tags.cameras["camera"].mount
        assert mount.tf_frame == ("camera" if name == "optical" else None)
        if name == "link":
            np.testing.assert_allclose(mount.t_body_sensor_m, [1.0, 2.0, 3.0])
            ahead = [0.0, np.cos(np.radians(10.0)), -np.sin(np.radians(10.0))]
            np.testing.assert_allclose(mount.R_body_sensor[:, 2], ahead, atol=1e-9)
            np.testing.assert_allclose(mount.R_body_sensor[:, 0], [1.0, 0.0, 0.0], atol=1e-9)  # to the right of it


def blank(make: Messages) -> Any:
    return image(make, np.zeros((8, 8), np.uint8))
