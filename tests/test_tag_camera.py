# SPDX-License-Identifier: Apache-2.0
"""Cameras of `CameraInfo`: projection against formulae of our own, ROI and binning by hand, lenses that fold."""

from typing import Any

import numpy as np
import pytest

from graphloc.frames import Array
from graphloc.frontends.tags.camera import CameraModel, camera_of
from graphloc.frontends.tags.sightings import is_rectified
from tests.bagfactory import START_NS, Messages

K = (620.0, 0.0, 655.5, 0.0, 610.0, 340.25, 0.0, 0.0, 1.0)
P = (600.0, 0.0, 640.0, -72.0, 0.0, 590.0, 350.0, 0.0, 0.0, 0.0, 1.0, 0.0)
LENSES: dict[str, tuple[str, tuple[float, ...]]] = {
    "plumb_bob, 4": ("plumb_bob", (-0.17, 0.026, 0.0006, -0.0004)),
    "plumb_bob, 5": ("plumb_bob", (-0.28, 0.09, 0.002, -0.003, -0.011)),
    "rational, 8": ("rational_polynomial", (0.6, 0.05, 0.001, -0.002, 0.001, 0.9, 0.15, 0.004)),
    "rational, 12": ("rational_polynomial", (0.6, 0.05, 0.001, -0.002, 0.001, 0.9, 0.15, 0.004, 2e-3, 1e-3, -3e-3, 5e-4)),
    "rational, 14": (
        "rational_polynomial", (0.6, 0.05, 1e-3, -2e-3, 1e-3, 0.9, 0.15, 0.004, 2e-3, 1e-3, -3e-3, 5e-4, 0.02, -0.03),
    ),
    "equidistant": ("equidistant", (-0.02, 0.004, -0.003, 0.0005)),
    "fisheye": ("fisheye", (0.03, -0.01, 0.002, -0.0003)),
    "none": ("plumb_bob", ()),
}  # fmt: skip


def info(ros: int = 2, **changes: Any) -> Any:
    """A `CameraInfo` of 1280 x 720 px; K, D, P, roi = (x, y, width, height) and the others by ROS 1's names."""
    make = Messages(ros)
    given = {"K": K, "D": (), "R": np.eye(3).ravel(), "P": P} | {k: v for k, v in changes.items() if k in "KDP"}
    x, y, width, height = changes.pop("roi", (0, 0, 0, 0))
    plain: dict[str, Any] = {
        "width": 1280,
        "height": 720,
        "distortion_model": "plumb_bob",
        "binning_x": 0,
        "binning_y": 0,
    }
    return make.t["sensor_msgs/msg/CameraInfo"](
        header=make.header(START_NS),
        roi=make.t["sensor_msgs/msg/RegionOfInterest"](
            x_offset=x, y_offset=y, width=width, height=height, do_rectify=False
        ),
        **{n if ros == 1 else n.lower(): np.array(v, dtype=float) for n, v in given.items()},
        **plain | {k: v for k, v in changes.items() if k not in "KDP"},
    )


def camera(lens: str = "none", **changes: Any) -> CameraModel:
    model, coefficients = LENSES[lens]
    return camera_of(info(distortion_model=model, D=coefficients, **changes), rectified=False)


def through_lens(lens: str, rays: Array) -> Array:
    """OpenCV's documented models, written out."""
    model, given = LENSES[lens]
    x, y = rays.T
    r2 = x**2 + y**2
    if model in ("equidistant", "fisheye"):
        theta = np.arctan(np.sqrt(r2))
        k = [1.0, *given]
        bent = sum(k[i] * theta ** (2 * i + 1) for i in range(5))
        return np.asarray(rays * (bent / np.maximum(np.sqrt(r2), 1e-15))[:, None])
    every = [*given, *[0.0] * (14 - len(given))]
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = every
    radial = (1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1.0 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2) + s1 * r2 + s2 * r2**2
    v = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y + s3 * r2 + s4 * r2**2
    (cx, sx), (cy, sy) = ((np.cos(t), np.sin(t)) for t in (tau_x, tau_y))
    R = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    flatten = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]])
    tilted = np.column_stack([u, v, np.ones(len(u))]) @ (flatten @ R).T
    return np.asarray(tilted[:, :2] / tilted[:, 2:])


def by_hand(lens: str, rays: Array) -> Array:
    return np.asarray(through_lens(lens, rays) * (K[0], K[4]) + (K[2], K[5]))


def whole_image() -> Array:
    u, v = np.meshgrid(np.linspace(-0.5, 1279.5, 33), np.linspace(-0.5, 719.5, 19))
    return np.column_stack([u.ravel(), v.ravel()])


@pytest.mark.parametrize("lens", LENSES)
def test_the_whole_image_both_ways(lens: str) -> None:
    """The formulae at the rays give back every pixel, and so does `project`; then from rays to px."""
    taken, px = camera(lens), whole_image()
    rays = taken.rays(px)
    np.testing.assert_allclose(by_hand(lens, rays), px, atol=1e-5)
    np.testing.assert_allclose(taken.project(rays), px, atol=1e-5)
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.5, 0.5, 7))
    known = np.column_stack([x.ravel(), y.ravel()])
    np.testing.assert_allclose(taken.project(known), by_hand(lens, known), atol=1e-9)
    np.testing.assert_allclose(taken.rays(by_hand(lens, known)), known, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_jacobian_is_that_of_the_formulae(lens: str) -> None:
    rays, step = np.array([(0.0, 0.0), (0.3, -0.2), (-0.7, 0.4), (0.02, 0.5)]), 1e-6
    numeric = np.stack(
        [(by_hand(lens, rays + d) - by_hand(lens, rays - d)) / (2.0 * step) for d in step * np.eye(2)], axis=2
    )
    if LENSES[lens][0] in ("equidistant", "fisheye"):
        numeric[0] = np.diag([K[0], K[4]])  # our formula divides by zero there; the lens is plain on its axis
    np.testing.assert_allclose(camera(lens).jacobian(rays), numeric, atol=1e-4)


def folding(model: str, *coefficients: float) -> CameraModel:
    return CameraModel(0, 0, np.eye(3), model, np.array(coefficients))


def test_a_folding_lens_says_nan_and_never_the_wrong_ray() -> None:
    """k1 = -0.5: r - r^3 / 2 rises to 0.5443 at r = 0.8165; 0.5 is reached at r = 0.6180 (and at 1, beyond the fold)."""
    lens = folding("plumb_bob", -0.5, 0.0, 0.0, 0.0, 0.0)
    turns = np.linspace(0.0, 2.0 * np.pi, 7)
    around = np.column_stack([np.cos(turns), np.sin(turns)])
    np.testing.assert_allclose(lens.rays(0.5 * around), 0.5 * (np.sqrt(5.0) - 1.0) * around, atol=1e-8)
    near = lens.rays(0.544 * around)
    assert (np.linalg.norm(near, axis=1) < 0.8165).all()
    np.testing.assert_allclose(near * (1.0 - 0.5 * (near**2).sum(axis=1, keepdims=True)), 0.544 * around, atol=1e-8)
    for beyond in (0.5444, 0.6, 2.0, 1e6):
        assert np.isnan(lens.rays(beyond * around)).all()
    assert np.isnan(lens.project(np.array([(0.82, 0.0), (1.0, 0.0)]))).all()
    np.testing.assert_allclose(lens.project(np.array([(0.81, 0.0)])), [(0.81 - 0.5 * 0.81**3, 0.0)])
    mixed = lens.rays(np.array([(0.3, 0.1), (0.9, 0.9), (np.nan, 0.0)]))
    assert np.isfinite(mixed[0]).all()
    assert np.isnan(mixed[1:]).all()


def test_a_lens_that_folds_twice() -> None:
    """r - 0.6 r^3 + 0.12 r^5 falls between r = 0.858 and 1.505 only: the ray at 2.2 is beyond, though unique."""
    lens = folding("plumb_bob", -0.6, 0.12, 0.0, 0.0)
    seen = 2.2 - 0.6 * 2.2**3 + 0.12 * 2.2**5
    assert np.isnan(lens.rays(np.array([(seen, 0.0), (0.0, -seen)]))).all()
    assert np.isnan(lens.project(np.array([(2.2, 0.0), (1.2, 0.0)]))).all()


def test_a_lens_that_folds_off_its_axis() -> None:
    """Tangential terms alone. With p1, on x = 0, y + 3 p1 y^2 turns at y = -2/3 for p1 = 1/4; with p2 what is seen along
    x turns at 1.67 for p2 = -0.1, and (0, 2) is none the worse: it is seen at (4 p2, 2).
    """
    lens = folding("plumb_bob", 0.0, 0.0, 0.25, 0.0)
    np.testing.assert_allclose(lens.rays(np.array([(0.0, -0.32)])), [(0.0, (np.sqrt(0.04) - 1.0) / 1.5)], atol=1e-8)
    np.testing.assert_array_equal(np.isnan(lens.project(np.array([(0.0, -0.66), (0.0, -0.67)]))[:, 1]), [False, True])
    assert np.isnan(lens.rays(np.array([(0.0, -0.34)]))).all()
    wide = folding("plumb_bob", 0.0, 0.0, 0.0, -0.1)
    np.testing.assert_allclose(wide.project(np.array([(0.0, 2.0)])), [(-0.4, 2.0)])
    np.testing.assert_allclose(wide.rays(np.array([(-0.4, 2.0)])), [(0.0, 2.0)], atol=1e-8)


def test_equidistant_up_to_the_horizon() -> None:
    """A plain fisheye sees an angle of theta off its axis at theta: 89 deg has a ray, 89.95 and 100 deg have none."""
    lens = folding("equidistant", 0.0, 0.0, 0.0, 0.0)
    angles = np.radians([1.0, 45.0, 80.0, 89.0])
    rays = lens.rays(np.column_stack([angles, np.zeros(4)]))
    np.testing.assert_allclose(np.arctan(rays[:, 0]), angles, atol=1e-8)
    beyond = np.radians([89.95, 90.05, 100.0, 180.0])
    assert np.isnan(lens.rays(np.column_stack([np.zeros(4), beyond]))).all()
    # theta - 0.2 theta^3 rises up to theta = sqrt(1 / 0.6) = 1.291, where it is 0.861.
    bent = folding("equidistant", -0.2, 0.0, 0.0, 0.0)
    inside, outside = bent.rays(np.array([(0.86, 0.0), (0.862, 0.0)]))
    assert np.arctan(inside[0]) < 1.291
    assert np.isnan(outside).all()


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/cam/image_rect_color/compressed", True),
        ("/cam/rect/image_color", True),
        ("/cam/image_undistorted", True),
        ("/cam/image_rect/ffmpeg", True),
        ("/cam/image_raw", False),
        ("/cam/image_direct", False),
        ("/image_corrected", False),
    ],
)
def test_a_topic_says_by_its_name_whether_its_images_are_rectified(topic: str, *, rectified: bool) -> None:
    assert is_rectified(topic) is rectified


@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize("ros", [1, 2])
def test_region_and_binning(ros: int, rectified: bool) -> None:
    """2 x 4 pixels of a region from (100, 40) on make one: its pixel (0, 0) has its middle at (100.5, 41.5)."""
    msg = info(ros, roi=(100, 40, 602, 400), binning_x=2, binning_y=4)
    taken, focal = camera_of(msg, rectified=rectified), (600.0, 590.0) if rectified else (620.0, 610.0)
    middle = (640.0, 350.0) if rectified else (655.5, 340.25)
    expected = [((100.5 - middle[0]) / focal[0], (41.5 - middle[1]) / focal[1])]
    np.testing.assert_allclose(taken.rays(np.array([(0.0, 0.0)])), expected)
    # (10, 20) there is 10 x 2 and 20 x 4 px on
    expected = [((120.5 - middle[0]) / focal[0], (121.5 - middle[1]) / focal[1])]
    np.testing.assert_allclose(taken.rays(np.array([(10.0, 20.0)])), expected)
    np.testing.assert_allclose(taken.project(np.array(expected)), [(10.0, 20.0)])
    assert (taken.width_px, taken.height_px) == (301, 100)


def test_region_without_a_size_and_binning_without_a_region() -> None:
    whole = camera_of(info(binning_x=2, binning_y=2), rectified=False)
    assert (whole.width_px, whole.height_px) == (640, 360)
    rest = camera_of(info(roi=(80, 20, 0, 0)), rectified=False)
    assert (rest.width_px, rest.height_px) == (1200, 700)
    np.testing.assert_allclose(rest.rays(np.array([(575.5, 320.25)])), [(0.0, 0.0)], atol=1e-15)


@pytest.mark.parametrize("ros", [1, 2])
def test_both_ros_versions_rectified_or_not(ros: int) -> None:
    msg = info(ros, D=LENSES["plumb_bob, 5"][1])
    raw = camera_of(msg, rectified=False)
    assert (raw.width_px, raw.height_px, raw.model) == (1280, 720, "plumb_bob")
    np.testing.assert_array_equal(raw.K, np.reshape(K, (3, 3)))
    np.testing.assert_array_equal(raw.distortion, LENSES["plumb_bob, 5"][1])
    rectified = camera_of(msg, rectified=True)
    assert (rectified.model, len(rectified.distortion)) == ("none", 0)
    np.testing.assert_array_equal(rectified.K, [[600.0, 0.0, 640.0], [0.0, 590.0, 350.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(("named", "coefficients", "model"), [
    ("", (), "none"), ("", (0.0,) * 5, "none"), ("none", (), "none"), ("plumb_bob", (), "none"),
    ("plumb_bob", (0.0,) * 5, "none"), ("rational_polynomial", (), "none"), ("Equidistant", (0.0,) * 4, "equidistant"),
    ("kannala_brandt4", (0.1, 0.0, 0.0, 0.0), "equidistant"), ("fisheye", (0.1, 0.0, 0.0, 0.0), "equidistant"),
])  # fmt: skip
def test_names_of_models(named: str, coefficients: tuple[float, ...], model: str) -> None:
    """No coefficients are no distortion, but for a fisheye: that without coefficients is still one."""
    assert camera_of(info(distortion_model=named, D=coefficients), rectified=False).model == model


def changed(values: tuple[float, ...], **at: float) -> tuple[float, ...]:
    return tuple(at.get(f"_{i}", v) for i, v in enumerate(values))


@pytest.mark.parametrize(("changes", "rectified", "says"), [
    ({"K": (0.0,) * 9}, False, "K is all zeros: the camera is not calibrated"),
    ({"P": (0.0,) * 12}, True, "P is all zeros: the camera is not calibrated"),
    ({"K": changed(K, _2=np.nan)}, False, "K is not finite"),
    ({"P": changed(P, _0=np.inf)}, True, "P is not finite"),
    ({"K": changed(K, _0=-620.0)}, False, "focal lengths in K are -620 and 610 px"),
    ({"K": changed(K, _4=0.0)}, False, "focal lengths in K are 620 and 0 px"),
    ({"K": changed(K, _3=2.0)}, False, "K is no camera matrix"),
    ({"K": changed(K, _8=0.0)}, False, "K is no camera matrix"),
    ({"D": (0.1, np.nan, 0.0, 0.0, 0.0)}, False, "D is not finite"),
    ({"D": (0.1, 0.0, 0.0)}, False, "3 coefficients for plumb_bob, which has 4 or 5"),
    ({"D": (0.1,) * 5, "distortion_model": "rational_polynomial"}, False, "5 coefficients for rational_polynomial"),
    ({"D": (), "distortion_model": "equidistant"}, False, "0 coefficients for equidistant, which has 4"),
    ({"D": (0.1,) * 5, "distortion_model": ""}, False, "5 distortion coefficients but no distortion model"),
    ({"D": (0.1,) * 5, "distortion_model": "mei"}, False,
     r"unknown distortion model 'mei' \(known: plumb_bob, rational_polynomial, equidistant\)"),
])  # fmt: skip
def test_what_calibrates_no_camera(changes: dict[str, Any], rectified: bool, says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        camera_of(info(**changes), rectified=rectified)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 120
    camera_of(info(**changes), rectified=not rectified)  # the other matrix, and no lens, are not looked at


def test_a_skewed_matrix_is_one() -> None:
    taken = camera_of(info(K=changed(K, _1=5.0)), rectified=False)
    np.testing.assert_allclose(taken.project(np.array([(0.1, 0.2)])), [(62.0 + 1.0 + 655.5, 122.0 + 340.25)])
    np.testing.assert_allclose(taken.rays(np.array([(718.5, 462.25)])), [(0.1, 0.2)])


def test_images_of_another_size() -> None:
    taken = camera_of(info(), rectified=False)
    taken.check_size(1280, 720)
    with pytest.raises(ValueError, match=r"640 x 360 px .* for 1280 x 720 px: it is for the image before resizing"):
        taken.check_size(640, 360)
    with pytest.raises(ValueError, match=r"1920 x 1080 px .* for 1280 x 720 px: it is for the image after resizing"):
        taken.check_size(1920, 1080)
    with pytest.raises(ValueError, match=r"an image of 1280 x 960 px with a CameraInfo for 1280 x 720 px$"):
        taken.check_size(1280, 960)
    camera_of(info(width=0, height=0), rectified=False).check_size(640, 360)
    camera_of(info(width=0, height=0, roi=(8, 8, 0, 0), binning_x=2), rectified=False).check_size(640, 360)


def test_no_points() -> None:
    for lens in LENSES:
        taken, none = camera(lens), np.empty((0, 2))
        assert taken.rays(none).shape == taken.project(none).shape == (0, 2)
        assert taken.jacobian(none).shape == (0, 2, 2)
