# SPDX-License-Identifier: Apache-2.0
"""The simulated camera: geometry against an independent detector, light against its laws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pupil_apriltags import Detector
from threadpoolctl import threadpool_limits

from graphloc.blocks import MountConfig
from graphloc.errors import ConfigError
from graphloc.eval.simulate import SimulatedRun, find_scenario, simulate
from graphloc.eval.simulate._lens import digitise, exposure, through_lens
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.rig import RigCamera
from graphloc.eval.simulate.scene import scene_of
from tests.camerabench import CORNERS, LINEAR, LOOKING_AHEAD, bench, detected, detectors, docking, seen_from


@pytest.fixture(scope="module", autouse=True)
def one_blas_thread() -> Iterator[None]:
    """As `write_bag` has it: threads of BLAS spin on thin products, and images would cost twice."""
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="module")
def detector() -> Iterator[Detector]:
    yield from detectors()


def halved(run: SimulatedRun) -> Camera:
    """The camera of a run with a quarter of its pixels, for what does not hang on them."""
    ((name, whole),) = run.rig.cameras.items()
    half = whole.model_copy(
        update={
            "width_px": whole.width_px // 2, "height_px": whole.height_px // 2,
            "focal_px": tuple(0.5 * f for f in whole.focal_px), "centre_px": tuple(0.5 * c for c in whole.centre_px),
        }
    )  # fmt: skip
    run = replace(run, rig=run.rig.model_copy(update={"cameras": {name: half}}))
    return Camera(name, scene_of(run), run)


def test_tags_stand_where_they_are_to_a_tenth_of_a_pixel(detector: Detector) -> None:
    """B.3: corners by another detector, in linear light, against a pinhole of our own; its position to 0.10 m."""
    run, camera = docking("optimal")
    K = run.rig.cameras["camera"].K
    off, wrong_m, ranges = [], [], []
    for k, t in enumerate(np.arange(40.0, 100.0, 7.0)):
        near = {n: pose for n, pose in camera.tag_poses(float(t)).items() if n < 230 and 2.0 < pose[0][2] < 12.0}
        true = {n: seen_from(*pose, K) for n, pose in near.items()}
        whole = [n for n, px in true.items() if px.min() >= 20.0 and (px <= np.array([2188.0, 1222.0])).all()]
        if not whole:
            continue
        found = detected(detector, LINEAR[camera.take(float(t), k).pixels])
        for number in whole:
            assert number in found
            off.append(found[number] - true[number])
            _, turns, places, _ = cv2.solvePnPGeneric(
                CORNERS, found[number], K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE_SQUARE
            )
            p, R = near[number]
            both = [-cv2.Rodrigues(a)[0].T @ b[:, 0] + R.T @ p for a, b in zip(turns, places, strict=True)]
            wrong_m.append(min(np.linalg.norm(e) for e in both))
            ranges.append(np.linalg.norm(p))
    assert len(off) > 14
    assert np.abs(np.mean(off, axis=0)).max() < 0.06  # no corner leans anywhere
    assert np.sqrt(np.mean(np.square(off))) < 0.12
    close = np.array(ranges) < 5.0
    assert close.sum() > 5
    assert np.quantile(np.array(wrong_m)[close], 0.95) < 0.10


def test_tags_are_seen_at_25_m_in_good_light_and_not_when_they_glow(detector: Detector) -> None:
    for condition, seen in (("optimal", True), ("illuminated", False)):
        _, camera = docking(condition)
        times = np.arange(20.0, 40.0, 0.1)
        t = float(min(times, key=lambda t: abs(np.linalg.norm(camera.tag_poses(float(t))[227][0]) - 25.5)))
        assert np.linalg.norm(camera.tag_poses(t)[227][0]) > 25.0
        assert ({226, 227, 228} <= set(detected(detector, camera.take(t, 0).pixels))) is seen


def test_a_tag_stands_upright_and_not_mirrored(detector: Detector) -> None:
    """By hand: 20 m ahead, 1 m to the east (right) and 1 m up; then its axes: x right, y up, z to the camera."""
    with bench({"at": [1.0, 20.0], "height_m": 3.0, "size_m": 1.0}) as (run, camera):
        p, R = camera.tag_poses(0.0)[5]
        np.testing.assert_allclose(p, [1.0, -1.0, 20.0], atol=1e-9)  # optical: right, down, ahead
        np.testing.assert_allclose(R, np.diag([1.0, -1.0, -1.0]), atol=1e-9)
        pixels = camera.take(0.0, 0).pixels
        K = run.rig.cameras["camera"].K
        f, (cx, cy) = K[0, 0], K[:2, 2]
        (corners, ids, _) = cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        ).detectMarkers(pixels)
        assert ids.ravel().tolist() == [5]
        # OpenCV starts at the bottom right of AprilTag's own print, clockwise; unrefined, its corners are whole pixels.
        expected = np.array([(0.5, -1.5), (1.5, -1.5), (1.5, -0.5), (0.5, -0.5)]) / 20.0 * f + (cx, cy)
        np.testing.assert_allclose(np.roll(corners[0][0], 2, axis=0), expected, atol=3.0)
        np.testing.assert_allclose(detected(detector, LINEAR[pixels])[5], expected, atol=0.2)


@pytest.mark.parametrize("in_the_way", ["pole", "nothing"])
def test_what_stands_before_a_tag_hides_it(in_the_way: str, detector: Detector) -> None:
    poles = [{"at": [1.0, 10.0], "top_m": 5.0, "radius_m": 0.4}] if in_the_way == "pole" else []
    with bench({"at": [2.0, 20.0], "height_m": 3.0, "size_m": 1.0}, poles=poles) as (_, camera):
        assert (5 in detected(detector, camera.take(0.0, 0).pixels)) is (in_the_way == "nothing")


def test_a_tag_is_not_seen_from_behind(detector: Detector) -> None:
    with bench({"at": [1.0, 15.0], "height_m": 3.0, "size_m": 1.0, "facing_deg": 0}) as (_, camera):
        assert not detected(detector, camera.take(0.0, 0).pixels)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", (-0.17, 0.03, 0.0004, -0.0003, 0.0)),
        ("rational_polynomial", (0.1, 0.02, 0.001, -0.001, 0.01, 0.3, 0.02, 0.01)),
        ("equidistant", (-0.01, 0.005, 0.0, 0.0)),
    ],
)
def test_lenses_distort_as_their_model_says(model: str, distortion: tuple[float, ...], detector: Detector) -> None:
    """Corners of a tag off the axis, by the published formulae, hand-coded here."""
    camera = RigCamera(mount=LOOKING_AHEAD, model=model, distortion=distortion)  # type: ignore[arg-type]
    with bench({"at": [8.0, 15.0], "height_m": 5.0, "size_m": 0.8}, camera) as (_, taker):  # larger, its edges bend
        found = detected(detector, LINEAR[taker.take(0.0, 0).pixels])[5]
        corners = np.array([(-0.4, 0.4), (0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)])
        x, y = (8.0 + corners[:, 0]) / 15.0, -(3.0 + corners[:, 1]) / 15.0
        r = np.hypot(x, y)
        if model == "equidistant":
            theta, (k1, k2, k3, k4) = np.arctan(r), distortion
            scale = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / r
            u, v = scale * x, scale * y
        else:
            k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, 0.0, 0.0, 0.0)[:8]
            radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
            u = x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
            v = y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
        expected = np.column_stack([u, v]) * camera.focal_px + camera.centre_px
        np.testing.assert_allclose(found, expected, atol=0.3)
        pinhole = np.column_stack([x, y]) * camera.focal_px + camera.centre_px
        assert np.abs(pinhole - expected).max() > 5.0  # it would show


def test_a_lens_that_folds_is_refused() -> None:
    """Past the radius where its polynomial turns round, no ray leads to a pixel."""
    camera = RigCamera(mount=LOOKING_AHEAD, distortion=(-0.3, 0.1, 0.001, 0.001, -0.02))
    with pytest.raises(ConfigError, match="distortion"), bench({"at": [0.0, 15.0], "height_m": 3.0}, camera):
        pass


def test_fog_takes_contrast_as_koschmieder_says() -> None:
    """Between 5 m and 15 m, white less black falls by exp(-beta 10 m), of a sky that stays as bright."""
    kept = {}
    for away in (5.0, 15.0):
        quay = [{"outline": [[-20, away], [20, away], [20, 25], [-20, 25]], "top_m": 6.0}]
        with bench({"at": [0.0, away], "height_m": 2.0, "size_m": 1.6}, condition="fog", quays=quay) as (run, camera):
            picture = camera.radiance(0.0)
            p, R = camera.tag_poses(0.0)[5]
            corners = seen_from(p, R * 1.6 / 0.412, run.rig.cameras["camera"].K)
            middle, top = corners.mean(axis=0), corners[:2].mean(axis=0)
            (rim, border) = (middle + (top - middle) * s for s in (1.11, 0.88))
            kept[away] = picture[round(rim[1]), round(rim[0])] - picture[round(border[1]), round(border[0])]
    assert kept[15.0] / kept[5.0] == pytest.approx(np.exp(-0.1 * 10.0), rel=0.02)


def test_darkness_costs_light_and_gains_noise_and_drops_hide(detector: Detector) -> None:
    shots = {condition: docking(condition)[1].take(60.0, 3) for condition in ("optimal", "darkness", "counterlight")}
    assert shots["optimal"].exposure_ms < 5.0
    assert (shots["darkness"].exposure_ms, shots["darkness"].gain) == (30.0, 16.0)
    assert shots["darkness"].blur_px > 3.0 * shots["optimal"].blur_px

    def grain(pixels: NDArray[np.uint8]) -> float:
        part = pixels[900:1200, 300:1900].astype(float)
        return float((part - cv2.GaussianBlur(part, (0, 0), 2.0)).std())

    assert grain(shots["darkness"].pixels) > 3.0 * grain(shots["optimal"].pixels)
    burnt = {name: (shot.pixels > 250).mean() for name, shot in shots.items()}
    assert burnt["counterlight"] > 5.0 * burnt["optimal"] + 0.005  # the sun, and its glitter on the water
    _, wet = docking("droplet")
    hidden: set[frozenset[int]] = set()
    for k, t in enumerate(np.arange(38.0, 100.0, 4.0), 4):  # drops come and go: until one hid a tag, and none did
        hidden.add(frozenset(detected(detector, wet.take(float(t), k).pixels)))
        if {226, 227, 228} in hidden and len(hidden) > 1:
            break
    assert {226, 227, 228} in hidden
    assert any(seen < {226, 227, 228} for seen in hidden)


def test_exposure_makes_the_mean_grey_and_noise_is_that_of_counts() -> None:
    """A flat field: 0.2 of white; variance of shot noise is its count, read noise adds its square."""
    camera = RigCamera(mount=LOOKING_AHEAD, width_px=640, height_px=480)
    field = np.full((480, 640), 0.5, dtype=np.float32)
    ms, gain = exposure(field, camera)
    assert gain == 1.0
    assert 0.5 * ms * camera.electrons_per_ms / camera.full_well == pytest.approx(0.2, rel=1e-3)
    noise = np.random.default_rng(1).standard_normal((480, 640), dtype=np.float32)
    level = (digitise(field, camera, (ms, gain), noise) / 255.0) ** 2.2 * camera.full_well
    assert level.mean() == pytest.approx(2000.0, rel=0.01)
    assert level.std() == pytest.approx(np.sqrt(2000.0 + camera.read_noise**2), rel=0.1)


def test_motion_smears_by_its_length() -> None:
    """A point becomes a streak: its variance along the motion is L^2 / 12 (and little more, from the grid)."""
    camera = RigCamera(mount=LOOKING_AHEAD, width_px=256, height_px=256, blur_px=0.0)
    field = np.zeros((256, 256), dtype=np.float32)
    field[128, 128] = 1.0
    for motion in (np.array([6.0, 0.0]), np.array([3.0, -4.0])):
        smeared = through_lens(field, camera, 0.0, (), 0.0, motion).astype(float)
        v, u = np.mgrid[:256, :256] - 128.0
        ahead = (u * motion[0] + v * motion[1]) / np.hypot(*motion)
        assert smeared.sum() == pytest.approx(1.0, abs=1e-5)
        assert (smeared * u).sum() == pytest.approx(0.0, abs=0.02)
        assert (smeared * v).sum() == pytest.approx(0.0, abs=0.02)
        length2 = float(motion @ motion)
        assert (smeared * ahead**2).sum() == pytest.approx(length2 / 12.0, abs=0.3)


@pytest.mark.parametrize("rig", ["tiara", "launch"])
def test_what_is_beside_the_view_neither_smears_nor_shows(rig: str) -> None:
    """A tag abeam, level with the lens: its projection is nonsense, and with distortion anything at all."""
    run = simulate(find_scenario("bl1-drift", {"rig": rig, "camera_hz": "1", "imu_hz": "10"}), 3)
    camera = halved(run)
    abeam = [
        t
        for t in np.arange(2.0, 110.0, 0.5)
        for p, _ in camera.tag_poses(float(t)).values()
        if 0.2 < p[2] < 0.1 * abs(p[0])
    ]
    assert abeam
    for t in abeam[::8]:
        assert camera.take(float(t), 0).blur_px < 1.5


def test_an_image_depends_on_its_time_alone() -> None:
    run, another = (simulate(find_scenario("dock-fixed-droplet", {"imu_hz": "10"}), seed) for seed in (1, 2))
    one = halved(run)
    one.take(30.0, 150)
    seen = one.take(60.0, 300).pixels
    assert np.array_equal(seen, halved(run).take(60.0, 300).pixels)
    assert not np.array_equal(seen, halved(another).take(60.0, 300).pixels)


def test_two_cameras_share_the_sun_and_no_noise() -> None:
    run = simulate(find_scenario("dock-fixed-counterlight", {"imu_hz": "10"}), 1)
    mount = run.rig.cameras["camera"]
    twins = {"a": mount, "b": mount.model_copy(update={"width_px": 1000})}
    run = replace(run, rig=run.rig.model_copy(update={"cameras": {**twins, "c": mount}}))
    a, b, c = (Camera(name, scene_of(run), run) for name in ("a", "b", "c"))
    one, other = (camera.take(60.0, 0).pixels.astype(float) for camera in (a, c))
    fine, coarse = (one - other)[900:], one[900:] - cv2.GaussianBlur(one[900:], (0, 0), 1.0)
    assert fine.std() > 0.5 * coarse.std()  # the same noise would cancel
    np.testing.assert_allclose(
        a.radiance(60.0)[300:900:7, 200:990:7], b.radiance(60.0)[300:900:7, 200:990:7], rtol=0.02
    )


def test_a_dark_field_has_its_read_noise() -> None:
    camera = RigCamera(mount=LOOKING_AHEAD, width_px=640, height_px=480)
    noise = np.random.default_rng(1).standard_normal((480, 640), dtype=np.float32)
    ms, gain = 30.0, 16.0
    electrons = 60.0
    field = np.full((480, 640), electrons / (ms * camera.electrons_per_ms), dtype=np.float32)
    level = (digitise(field, camera, (ms, gain), noise) / 255.0) ** 2.2 * camera.full_well / gain
    assert level.std() == pytest.approx(np.sqrt(electrons + camera.read_noise**2), rel=0.02)


def test_a_point_of_light_is_blurred_and_veiled() -> None:
    """Its core is a Gaussian of the lens; stray light takes 4.5 % of it, times its weather, and loses none."""
    camera = RigCamera(mount=LOOKING_AHEAD, width_px=1600, height_px=1600, blur_px=1.5)
    field = np.zeros((1600, 1600), dtype=np.float32)
    field[800, 800] = 1.0
    for times in (1.0, 4.0):
        seen = through_lens(field, camera, times, (), 0.0, np.zeros(2)).astype(float)
        core = seen[792:809, 792:809]
        # Of the nearest halo, 6 px wide, erf(8.5 / 6 / sqrt(2))^2 = 0.71 lies within as well.
        assert core.sum() == pytest.approx(1.0 - 0.045 * times + 0.71 * 0.02 * times, abs=0.002 * times)
        _, u = np.mgrid[-8:9, -8:9]
        floor = seen[780, 780]
        spread = ((core - floor) * u**2).sum() / (core - floor).sum()
        assert times > 1.0 or spread == pytest.approx(1.5**2, rel=0.15)  # else the halo bears on it
        assert seen.sum() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("way", ["own cabin", "water", "behind another tag"])
def test_tags_are_hidden_by(way: str, detector: Detector) -> None:
    tags: dict[str, Any] = {"at": [0.0, 20.0], "height_m": 3.0, "size_m": 1.0}
    more: dict[str, Any] = {}
    camera = None
    if way == "own cabin":  # from behind it
        camera = RigCamera(mount=MountConfig(xyz_m=(-5.0, 0.0, -0.5), rpy_deg=(-90.0, 0.0, -90.0)))
    elif way == "water":
        tags["height_m"] = -1.0
    else:
        more["tags"] = [
            {"number": 6, "facing_deg": 180, "at": [0.0, 12.0], "height_m": 2.6, "size_m": 1.0},
            {"number": 5, "facing_deg": 180, **tags},
        ]
    with bench(tags, camera, **more) as (_, taker):
        seen = detected(detector, taker.take(0.0, 0).pixels)
        assert 5 not in seen
        assert (6 in seen) is (way == "behind another tag")
