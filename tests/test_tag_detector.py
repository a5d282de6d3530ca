# SPDX-License-Identifier: Apache-2.0
"""The tag detector: on tags drawn here under a known homography, and beside AprilTag 3 on simulated approaches."""

import atexit
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pupil_apriltags import Detector as AprilTag3
from scipy.stats import chi2

from graphloc.errors import ConfigError
from graphloc.eval.simulate import harbour_scenarios, simulate
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.scene import scene_of
from graphloc.frames import Array
from graphloc.frontends.tags._decode import read
from graphloc.frontends.tags.camera import CameraModel
from graphloc.frontends.tags.detect import Detector

Image = NDArray[np.uint8]
DICTIONARIES = {
    "16h5": cv2.aruco.DICT_APRILTAG_16h5, "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "36h10": cv2.aruco.DICT_APRILTAG_36h10, "36h11": cv2.aruco.DICT_APRILTAG_36h11,
}  # fmt: skip
FINER = 6  # drawn so many times finer than the image
CORNERS = np.array([(-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), (0.5, -0.5, 0.0), (-0.5, -0.5, 0.0)])  # x right, y up
FOCAL_PX = 800.0


def cells_of(number: int, family: str = "36h11") -> Image:
    """Cells, 1 is white, first row on top, as AprilTag's own images stand: OpenCV's picture on its head."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[family])
    drawn = np.asarray(cv2.aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2), dtype=np.uint8)
    return drawn[::-1, ::-1] // 255


def turned(roll_deg: float = 0.0, tilt_deg: float = 0.0, about_deg: float = 0.0) -> Array:
    """Rotation (3, 3) of a tag in a camera that looks at it, rolled, and tilted about an axis in the image."""
    about = np.radians(about_deg)
    tilt = cv2.Rodrigues(np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(roll_deg)]))[0]
    return np.asarray(tilt @ roll @ np.diag([1.0, -1.0, -1.0]))


def draw(
    cells: Image,
    size: int,
    side_px: float,
    R: Array | None = None,
    *,
    middle: Any = None,
    blur_px: float = 0.7,
    gamma: float = 2.2,
    noise: float = 0.005,
    light: tuple[float, float] = (0.05, 0.8),
    rng: np.random.Generator | None = None,
) -> tuple[Image, Array]:
    """An image (size, size) of a tag with a quiet zone of one cell on a grey wall, and its corners (4, 2), px."""
    rng = np.random.default_rng(7) if rng is None else rng
    p = CORNERS @ (turned() if R is None else R).T + (0.0, 0.0, FOCAL_PX / side_px)
    at = FOCAL_PX * p[:, :2] / p[:, 2:]
    at += (np.full(2, size / 2.0) if middle is None else np.asarray(middle)) - at.mean(axis=0)
    texels = 12
    plate = np.pad(np.kron(cells, np.ones((texels, texels))), texels, constant_values=1.0)
    black, white = light
    plate = np.pad(black + (white - black) * plate, 1, constant_values=0.5 * (black + white)).astype(np.float32)
    n = len(cells)
    ends = texels * np.array([(1, 1), (n + 1, 1), (n + 1, n + 1), (1, n + 1)]) + 0.5
    H = cv2.getPerspectiveTransform(ends.astype(np.float32), ((at + 0.5) * FINER - 0.5).astype(np.float32))
    whole = (size * FINER, size * FINER)
    fine = cv2.warpPerspective(plate, H, whole, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE)
    light_px = cv2.resize(cv2.GaussianBlur(fine, (0, 0), blur_px * FINER), (size, size), interpolation=cv2.INTER_AREA)
    light_px = light_px + noise * np.sqrt(light_px + 0.01) * rng.standard_normal(light_px.shape)
    return np.rint(255.0 * np.clip(light_px, 0.0, 1.0) ** (1.0 / gamma)).astype(np.uint8), at


def bowed(
    lens: CameraModel, number: int, middle: Array, side_px: float, R: Array, size: int = 160
) -> tuple[Image, Array]:
    """An image (size, size) of a tag through a lens: each fine pixel's ray, by OpenCV, meets its plane; and its corners."""
    fisheye = lens.model == "equidistant"
    axes = np.stack(np.meshgrid(*[(np.arange(size * 3) + 0.5) / 3 - 0.5] * 2), axis=-1).reshape(-1, 1, 2)
    points = np.vstack([axes, np.asarray(middle, dtype=float).reshape(1, 1, 2)])
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    undo = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    rays = np.column_stack([undo(points, lens.K, lens.distortion, criteria=until)[:, 0], np.ones(len(points))])
    p = rays[-1] * lens.K[0, 0] / side_px
    to_image: Any = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    still = np.zeros(3)
    at = np.asarray(to_image((CORNERS @ R.T + p)[:, None], still, still, lens.K, lens.distortion)[0]).reshape(4, 2)
    looking, origin = rays[:-1] @ R, p @ R
    hit = origin[2] / looking[:, 2:] * looking - origin
    cells = np.pad(cells_of(number), 1, constant_values=1)
    n = len(cells) - 2
    columns, rows = np.floor((hit[:, 0] + 0.5) * n).astype(int) + 1, np.floor((0.5 - hit[:, 1]) * n).astype(int) + 1
    on = (np.minimum(columns, rows) >= 0) & (np.maximum(columns, rows) < n + 2)
    light = np.full(len(hit), 0.4, dtype=np.float32)
    light[on] = np.where(cells[rows[on], columns[on]] == 1, 0.8, 0.05)
    fine = cv2.GaussianBlur(light.reshape(3 * size, 3 * size), (0, 0), 3 * 0.7)
    light_px = cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)
    light_px = light_px + 0.005 * np.random.default_rng(number).standard_normal(light_px.shape)
    return np.rint(255.0 * np.clip(light_px, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8), at


@lru_cache(maxsize=8)
def april_tag_3(family: str) -> Any:
    made = AprilTag3(families=f"tag{family}", quad_decimate=1.0)
    atexit.register(setattr, made, "tag_detector_ptr", None)  # its destructor frees the families twice
    return made


def by_april_tag_3(image: Image, family: str = "36h11") -> dict[int, Array]:
    """Corners by id in our order: it lists them from the bottom left, counter-clockwise, pixels from their outer corner."""
    return {d.tag_id: d.corners[::-1] - 0.5 for d in april_tag_3(family).detect(image)}


@pytest.mark.parametrize("roll_deg", [0.0, 27.0, 90.0, 180.0, 270.0, 225.0])
def test_corners_come_in_the_order_of_the_tags_axes(roll_deg: float) -> None:
    image, at = draw(cells_of(42), 160, 70.0, turned(roll_deg, 25.0, 40.0))
    (found,) = Detector().detect(image)
    assert (found.number, found.family, found.hamming) == (42, "36h11", 0)
    assert np.abs(found.corners_px - at).max() < 0.08
    assert np.abs(found.corners_px - by_april_tag_3(image)[42]).max() < 0.6


def test_its_loops_are_compiled_for_one_kind_of_image() -> None:
    """An image of a bag may not be written to: compiled for those, and once more for others, the first one took seconds longer."""
    image, _ = draw(cells_of(42), 160, 70.0)
    of_a_bag = image.copy()
    of_a_bag.flags.writeable = False
    assert [d.number for one in (image, of_a_bag) for d in Detector().detect(one)] == [42, 42]
    assert [grey.mutable for grey, *_ in read.signatures] == [False]


@pytest.mark.parametrize("family", ["16h5", "25h9", "36h11"])
def test_each_family_as_april_tag_3_reads_it(family: str) -> None:
    for number in (0, 7, 29):
        image, at = draw(cells_of(number, family), 140, 80.0, turned(10.0, 20.0, 100.0))
        (found,) = Detector((family,)).detect(image)
        assert (found.number, found.family) == (number, family)
        assert np.abs(found.corners_px - at).max() < 0.08
        assert np.abs(by_april_tag_3(image, family)[number] - at).max() < 0.6


def test_family_36h10_is_drawn_the_same_way_by_opencv() -> None:
    """AprilTag 3 does not know it; OpenCV's own reader starts at the bottom right, clockwise."""
    image, at = draw(cells_of(33, "36h10"), 140, 80.0, turned(10.0, 20.0, 100.0))
    (found,) = Detector(("36h11", "36h10")).detect(image)
    assert (found.number, found.family) == (33, "36h10")
    assert np.abs(found.corners_px - at).max() < 0.08
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES["36h10"])
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    assert numbers.ravel().tolist() == [33]
    assert np.abs(np.roll(corners[0][0], 2, axis=0) - found.corners_px).max() < 2.0


@pytest.mark.parametrize("blur_px", [0.4, 0.8, 1.3])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_no_gamma_and_no_blur_moves_a_corner(gamma: float, blur_px: float) -> None:
    """Found at half of what encoded levels say, corners would sit 0.1 to 0.4 px inside at gamma 2.2."""
    outwards = []
    for k in range(8):
        image, at = draw(cells_of(k), 90, 40.0, turned(11.0 * k, 30.0, 77.0 * k), gamma=gamma, blur_px=blur_px)
        (found,) = Detector().detect(image)
        away = at - at.mean(axis=0)
        off = found.corners_px - at
        assert np.abs(off).max() < 0.15
        outwards.append((off * away).sum(axis=1) / np.linalg.norm(away, axis=1))
    assert abs(np.mean(outwards)) < 0.02


def test_sharpened_and_compressed_by_a_camera() -> None:
    for k in range(6):
        image, at = draw(cells_of(k), 120, 50.0, turned(31.0 * k, 30.0, 50.0 * k))
        sharp = cv2.addWeighted(image, 1.6, cv2.GaussianBlur(image, (0, 0), 1.0), -0.6, 0.0)
        sent = cv2.imencode(".jpg", sharp, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
        received = np.asarray(cv2.imdecode(sent, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        (found,) = Detector().detect(received)
        assert np.abs(found.corners_px - at).max() < 0.15


# What lies 250 px beside and above the middle of a 1440 x 1080 image, and 300 px below it to the left.
LENSES = [
    CameraModel(160, 160, np.array([[820.0, 0.0, -150.0], [0.0, 821.0, -150.0], [0.0, 0.0, 1.0]]), "plumb_bob",
         np.array([-0.17, 0.03, 4e-4, -3e-4, 0.0])),
    CameraModel(160, 160, np.array([[800.0, 0.0, 400.0], [0.0, 800.0, -200.0], [0.0, 0.0, 1.0]]), "plumb_bob",
         np.array([-0.3, 0.08, 0.0, 0.0, 0.0])),
    CameraModel(160, 160, np.array([[500.0, 0.0, -150.0], [0.0, 500.0, -150.0], [0.0, 0.0, 1.0]]), "equidistant",
         np.array([-0.02, 0.003, 0.0, 0.0])),
]  # fmt: skip


@pytest.mark.parametrize("lens", LENSES, ids=["launch", "strong", "fisheye"])
def test_a_lens_bows_the_sides_of_a_tag(lens: CameraModel) -> None:
    """The middle of a side is off the line between its corners by half a pixel and more; corners stay points of the image."""
    without, nees = [], []
    for k in range(3):
        image, at = bowed(lens, k, np.array([77.0, 78.0]) + 2.1 * k, 95.0, turned(31.0 * k, 10.0, 70.0 * k))
        (plain,), (found,) = Detector().detect(image), Detector().detect(image, lens)
        assert found.number == k
        off = (found.corners_px - at).ravel()
        assert np.abs(off).max() < 0.08
        assert found.margin >= plain.margin - 0.5
        nees.append(off @ np.linalg.solve(found.cov_px2, off))
        without.append(np.abs(plain.corners_px - at).max())
    assert np.mean(nees) < 14.0  # of 8
    assert np.median(without) > 0.2


def test_a_lens_without_distortion_changes_nothing() -> None:
    image, _ = draw(cells_of(8), 160, 60.0)
    plain = CameraModel(160, 160, np.diag([FOCAL_PX, FOCAL_PX, 1.0]), "none", np.empty(0))
    for ours, theirs in zip(Detector().detect(image, plain), Detector().detect(image), strict=True):
        assert np.array_equal(ours.corners_px, theirs.corners_px)
        assert np.array_equal(ours.cov_px2, theirs.cov_px2)


def test_upright_edges_of_a_tall_tag_are_not_missed() -> None:
    """Of every fifth column all were as far from an edge: 0.1 px and more off."""
    off = []
    for k in range(6):
        image, at = draw(cells_of(k), 380, 300.0, middle=(190.0 + k / 6.0, 190.2), blur_px=0.4, noise=0.01)
        (found,) = Detector().detect(image)
        off.append(found.corners_px - at)
    assert np.sqrt(np.mean(np.square(off))) < 0.02


def test_a_taller_tag_is_known_more_closely() -> None:
    """More edges in the same noise: sqrt(80 / 30) times as close. From a tenth of its pixels it would not be."""
    rng = np.random.default_rng(5)
    rms = []
    for side_px in (30.0, 80.0):
        off = []
        for k in range(16):
            R = turned(rng.uniform(0, 360), 20.0, rng.uniform(0, 360))
            image, at = draw(cells_of(k), int(1.8 * side_px), side_px, R, noise=0.15, blur_px=0.8, rng=rng)
            off += [found.corners_px - at for found in Detector().detect(image)]
        assert len(off) > 12
        rms.append(np.sqrt(np.mean(np.square(off))))
    assert rms[1] < 0.85 * rms[0]


def test_covariance_is_that_of_the_errors() -> None:
    """e' C^-1 e of 8 errors: 8 on average and below its 95 % point 95 times of 100; more noise, less is known."""
    rng = np.random.default_rng(3)
    middle = {}
    for noise, least in ((0.03, 1.5), (0.12, 3.5)):  # without much noise, what is allowed for the lens is too much
        nees, variance = [], []
        for k in range(36):
            R = turned(rng.uniform(0, 360), rng.uniform(0, 45), rng.uniform(0, 360))
            image, at = draw(
                cells_of(k), 90, rng.uniform(20, 45), R, middle=rng.uniform(40, 50, 2), noise=noise, rng=rng,
                gamma=rng.uniform(1.0, 2.4), blur_px=rng.uniform(0.5, 0.9),
            )  # fmt: skip
            for found in Detector().detect(image):
                off = (found.corners_px - at).ravel()
                nees.append(off @ np.linalg.solve(found.cov_px2, off))
                variance.append(np.trace(found.cov_px2) / 8.0)
        assert len(nees) > 30
        assert least < np.mean(nees) < 9.0
        assert np.mean(np.array(nees) < chi2.ppf(0.95, 8)) > 0.9
        middle[noise] = np.median(variance)
    assert middle[0.12] > 4.0 * middle[0.03]  # 16, but for what does not come from noise


def test_bits_are_corrected_up_to_the_limit() -> None:
    for wrong in range(4):
        cells = cells_of(100).copy()
        cells.ravel()[[10, 13, 29][:wrong]] ^= 1
        image, _ = draw(cells, 120, 60.0)
        for limit in range(4):
            found = Detector(max_hamming=limit).detect(image)
            assert [d.hamming for d in found] == ([wrong] if wrong <= limit else [])


def test_margin_is_that_of_april_tag_3_and_has_a_limit() -> None:
    for light in ((0.05, 0.8), (0.25, 0.36)):
        image, _ = draw(cells_of(3), 160, 120.0, light=light)
        (found,), (theirs,) = Detector().detect(image), april_tag_3("36h11").detect(image)
        assert found.margin == pytest.approx(theirs.decision_margin, rel=0.15)
        assert Detector(min_margin=found.margin - 0.1).detect(image)
        assert not Detector(min_margin=found.margin + 0.1).detect(image)


def test_only_the_numbers_that_are_asked_for() -> None:
    image, _ = draw(cells_of(77), 120, 60.0)
    assert [d.number for d in Detector(numbers={"36h11": [5, 77]}).detect(image)] == [77]
    assert not Detector(numbers={"36h11": [n for n in range(587) if n != 77]}).detect(image)
    assert not Detector(("25h9",)).detect(image)
    assert not Detector(numbers={"36h11": []}).detect(image)
    assert not Detector(()).detect(image)


def test_unknown_family_or_number_is_one_clear_line() -> None:
    with pytest.raises(ConfigError, match="tag family '52h13' is not known: use one of 16h5, 25h9, 36h10, 36h11"):
        Detector(("36h11", "52h13"))
    with pytest.raises(ConfigError, match=r"tag family 25h9 has numbers 0 to 34, not 35"):
        Detector(("25h9",), numbers={"25h9": [3, 35]})


@pytest.mark.parametrize("shape", [(0, 0), (0, 100), (1, 1), (8, 8), (9, 300), (200, 300)])
@pytest.mark.parametrize("level", [0, 100, 255])
def test_nothing_in_images_without_anything(shape: tuple[int, int], level: int) -> None:
    assert Detector().detect(np.full(shape, level, dtype=np.uint8)) == []


def test_nothing_in_noise_and_among_squares() -> None:
    rng = np.random.default_rng(11)
    noise = rng.integers(0, 256, (400, 600), dtype=np.uint8)
    squares = np.kron(rng.integers(0, 2, (50, 75)) * 255, np.ones((8, 8))).astype(np.uint8)
    for image in (noise, squares):
        assert Detector().detect(image) == []
        assert Detector().detect(np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), dtype=np.uint8)) == []


def test_small_tags_and_large_ones_and_those_without_a_quiet_zone() -> None:
    small = []
    for k in range(12):  # 1.5 px to a cell: nearly always
        image, at = draw(cells_of(k), 60, 12.0, turned(7.0 * k, 5.0), middle=(30.0 + k / 12.0, 30.3), blur_px=0.4)
        seen = Detector().detect(image)
        assert [d.number for d in seen] in ([], [k])
        assert all(np.abs(d.corners_px - at).max() < 0.15 for d in seen)
        small += seen
        assert not Detector(min_side_px=20.0).detect(image)
    assert len(small) >= 8
    image, at = draw(cells_of(9), 620, 560.0, turned(1.0, 3.0), blur_px=1.0)
    (found,) = Detector().detect(image)
    assert np.abs(found.corners_px - at).max() < 0.2
    (found,) = Detector().detect(draw(cells_of(9), 200, 80.0, middle=(42.0, 100.0))[0])  # its quiet zone is cut
    assert np.abs(found.corners_px - found.corners_px.mean(axis=0)).max() == pytest.approx(40.0, abs=0.2)


def test_two_tags_of_one_number_are_two() -> None:
    image, at = draw(cells_of(8), 160, 60.0)
    found = Detector().detect(np.hstack([image, image]))
    assert [d.number for d in found] == [8, 8]
    assert np.abs(found[0].corners_px - at).max() < 0.1
    assert np.abs(found[1].corners_px - at - (160.0, 0.0)).max() < 0.1


def test_a_view_of_an_image_is_read_like_a_copy() -> None:
    image, at = draw(cells_of(8), 160, 60.0)
    wide = np.repeat(image, 2, axis=1)[:, ::2]
    assert not wide.flags.c_contiguous
    assert np.abs(Detector().detect(wide)[0].corners_px - at).max() < 0.1


@pytest.mark.parametrize(
    ("condition", "off_px"), [("optimal", 0.06), ("fog", 0.15), ("counterlight", 0.12), ("darkness", 0.3)]
)
def test_sees_what_april_tag_3_sees_and_more_closely(condition: str, off_px: float) -> None:
    """On simulated approaches, with the corners' true places from a pinhole of our own."""
    run = simulate(replace(harbour_scenarios()[f"dock-fixed-{condition}"], imu_hz=10.0), 3)
    camera, K = Camera("camera", scene_of(run), run), run.rig.cameras["camera"].K
    ours_off, theirs_off, nees = [], [], []
    for k, t in enumerate((46.0, 72.0)):
        image = camera.take(t, k).pixels
        ours = {d.number: d for d in Detector().detect(image)}
        theirs = by_april_tag_3(image)
        assert set(theirs) <= set(ours)
        for number, found in ours.items():
            p, R = camera.tag_poses(t)[number]  # no other ids than those that are there
            flat = (p + 0.412 * CORNERS @ R.T) @ K.T
            off = (found.corners_px - flat[:, :2] / flat[:, 2:]).ravel()
            ours_off.append(off)
            nees.append(off @ np.linalg.solve(found.cov_px2, off))
            if number in theirs:
                theirs_off.append((theirs[number] - flat[:, :2] / flat[:, 2:]).ravel())
    assert len(ours_off) >= 5
    rmse = [np.sqrt(np.mean(np.square(off))) for off in (ours_off, theirs_off)]
    assert rmse[0] < min(off_px, 0.6 * rmse[1])
    assert 2.0 < np.mean(nees) < 14.0  # of 5 or 6: their mean scatters by 1.7
