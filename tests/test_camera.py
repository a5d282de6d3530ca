# SPDX-License-Identifier: Apache-2.0
"""The simulated camera, its tags and docks: geometry against an independent detector, light against its laws."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pupil_apriltags import Detector
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

from graphloc.blocks import MountConfig
from graphloc.errors import ConfigError
from graphloc.eval.simulate import SimulatedRun, find_scenario, harbour_scenarios, simulate
from graphloc.eval.simulate._lens import digitise, exposure, through_lens
from graphloc.eval.simulate._truth import Motion
from graphloc.eval.simulate.bag import write_bag
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.docks import tag_pose
from graphloc.eval.simulate.harbour import make_harbour
from graphloc.eval.simulate.lidar import scan, world_points
from graphloc.eval.simulate.noise import reported_sigma_m
from graphloc.eval.simulate.rig import CameraConfig, HullConfig, RigConfig, load_rig
from graphloc.eval.simulate.scene import Scene, scene_of
from graphloc.frames import Array
from graphloc.measurements import GnssPosition
from tests.commands import called

LINEAR = np.rint(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)  # undoes the camera's gamma
HALF = 0.206
CORNERS = np.array([(-HALF, HALF, 0.0), (HALF, HALF, 0.0), (HALF, -HALF, 0.0), (-HALF, -HALF, 0.0)])  # tag axes
LOOKING_AHEAD = MountConfig(rpy_deg=(-90.0, 0.0, -90.0))


def docking(condition: str, seed: int = 1, **changes: Any) -> tuple[SimulatedRun, Camera]:
    kind = changes.pop("kind", "fixed")
    run = simulate(replace(harbour_scenarios()[f"dock-{kind}-{condition}"], **changes), seed)
    (name,) = run.rig.cameras
    return run, Camera(name, scene_of(run), run)


@pytest.fixture(scope="module")
def detector() -> Iterator[Detector]:
    made = Detector(families="tag36h11", quad_decimate=1.0)
    yield made
    made.tag_detector_ptr = None  # its destructor frees the families twice, and the heap breaks


def detected(detector: Detector, pixels: NDArray[np.uint8]) -> dict[int, Array]:
    """Corners (4, 2) by id, in `CORNERS`' order; (0, 0) is the middle of the top-left pixel.

    AprilTag 3 counts pixels from their outer corner, and corners from the tag's bottom left, counter-clockwise.
    """
    return {d.tag_id: d.corners[::-1] - 0.5 for d in detector.detect(pixels)}


def seen_from(p: Array, R: Array, K: Array) -> Array:
    """Pinhole projection (4, 2) of a tag's corners."""
    at = p + CORNERS @ R.T
    flat = at @ K.T
    return np.asarray(flat[:, :2] / flat[:, 2:])


def test_tags_stand_where_they_are_to_a_tenth_of_a_pixel(detector: Detector) -> None:
    """B.3: corners by another detector, in linear light, against a pinhole of our own; its position to 0.10 m."""
    run, camera = docking("optimal")
    K = run.rig.cameras["camera"].K
    off, wrong_m, ranges = [], [], []
    for k, t in enumerate(np.arange(40.0, 100.0, 4.0)):
        found = detected(detector, LINEAR[camera.take(float(t), k).pixels])
        for number, (p, R) in camera.tag_poses(float(t)).items():
            if number < 230 and 2.0 < p[2] < 12.0:
                true = seen_from(p, R, K)
                if true.min() < 20.0 or (true > np.array([2188.0, 1222.0])).any():
                    continue
                assert number in found
                off.append(found[number] - true)
                _, turns, places, _ = cv2.solvePnPGeneric(
                    CORNERS, found[number], K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE_SQUARE
                )
                both = [-cv2.Rodrigues(a)[0].T @ b[:, 0] + R.T @ p for a, b in zip(turns, places, strict=True)]
                wrong_m.append(min(np.linalg.norm(e) for e in both))
                ranges.append(np.linalg.norm(p))
    assert len(off) > 25
    assert np.abs(np.mean(off, axis=0)).max() < 0.06  # no corner leans anywhere
    assert np.sqrt(np.mean(np.square(off))) < 0.12
    near = np.array(ranges) < 5.0
    assert near.sum() > 10
    assert np.quantile(np.array(wrong_m)[near], 0.95) < 0.10


def test_tags_are_seen_at_25_m_in_good_light_and_not_when_they_glow(detector: Detector) -> None:
    for condition, seen in (("optimal", True), ("illuminated", False)):
        _, camera = docking(condition)
        times = np.arange(20.0, 40.0, 0.1)
        t = float(min(times, key=lambda t: abs(np.linalg.norm(camera.tag_poses(float(t))[227][0]) - 25.5)))
        assert np.linalg.norm(camera.tag_poses(t)[227][0]) > 25.0
        assert ({226, 227, 228} <= set(detected(detector, camera.take(t, 0).pixels))) is seen


@contextmanager
def bench(
    tag: dict[str, Any], camera: CameraConfig | None = None, condition: str = "optimal", **more: Any
) -> Iterator[tuple[SimulatedRun, Camera]]:
    """A vessel lying still at the origin, bow to the north, before one tag on a wall."""
    harbour = make_harbour(
        {
            "name": "bench", "datum": {"latitude_deg": 57.7, "longitude_deg": 11.7}, "image_m": [-30, -30, 30, 30],
            "quays": [{"outline": [[-20, 20], [20, 20], [20, 25], [-20, 25]], "top_m": 12.0}],
            "routes": {"here": [[0, 0]]}, "tags": [{"number": 5, "facing_deg": 180, **tag}], **more,
        },
        "bench",
    )  # fmt: skip
    run = simulate(find_scenario("bl3-clean", {"camera_hz": "1", "tide_m": "0", "condition": condition}), 1)
    block = ((-3.0, -1.0), (-2.0, -1.0), (-2.0, 1.0), (-3.0, 1.0))  # the vessel: behind the camera
    hull = HullConfig(outline=block, top_m=0.5, cabin=block, cabin_top_m=1.0)
    rig = RigConfig(
        **{**dict(load_rig("tiara")), "hull": hull, "cameras": {"camera": camera or CameraConfig(mount=LOOKING_AHEAD)}}
    )
    run = replace(run, harbour=harbour, docks=(), rig=rig, motion=_Still())
    yield run, Camera("camera", Scene(harbour, (), 0.0, (), rig.hull), run)


class _Still(Motion):
    """At the origin, 2 m up, bow to the north."""

    def __init__(self) -> None:
        pass

    def pose(self, t: Array) -> tuple[Array, Array, Array]:
        R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        n = len(t)
        return np.tile([0.0, 0.0, 2.0], (n, 1)), np.tile(R, (n, 1, 1)), np.zeros((n, 3))


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
    camera = CameraConfig(mount=LOOKING_AHEAD, model=model, distortion=distortion)  # type: ignore[arg-type]
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
    camera = CameraConfig(mount=LOOKING_AHEAD, distortion=(-0.3, 0.1, 0.001, 0.001, -0.02))
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
    hidden = [set(detected(detector, wet.take(float(t), k).pixels)) for k, t in enumerate(np.arange(30.0, 100.0, 2.0))]
    assert any(seen < {226, 227, 228} for seen in hidden)
    assert any(seen == {226, 227, 228} for seen in hidden)


def test_exposure_makes_the_mean_grey_and_noise_is_that_of_counts() -> None:
    """A flat field: 0.2 of white; variance of shot noise is its count, read noise adds its square."""
    camera = CameraConfig(mount=LOOKING_AHEAD, width_px=640, height_px=480)
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
    camera = CameraConfig(mount=LOOKING_AHEAD, width_px=256, height_px=256, blur_px=0.0)
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
    run = simulate(find_scenario("bl1-drift", {"rig": rig, "camera_hz": "1"}), 3)
    (name,) = run.rig.cameras
    camera = Camera(name, scene_of(run), run)
    abeam = [
        t
        for t in np.arange(2.0, 110.0, 0.5)
        for p, _ in camera.tag_poses(float(t)).values()
        if 0.2 < p[2] < 0.1 * abs(p[0])
    ]
    assert abeam
    for t in abeam[::4]:
        assert camera.take(float(t), 0).blur_px < 3.0


def test_an_image_depends_on_its_time_alone() -> None:
    _, one = docking("droplet")
    _, other = docking("droplet")
    one.take(30.0, 150)
    assert np.array_equal(one.take(60.0, 300).pixels, other.take(60.0, 300).pixels)
    assert not np.array_equal(one.take(60.0, 300).pixels, docking("droplet", seed=2)[1].take(60.0, 300).pixels)


def test_a_dock_wanders_as_far_as_it_says_and_its_tags_ride_on_it() -> None:
    run, camera = docking("optimal", kind="floating")
    (dock,) = run.docks
    p, R = dock.pose(np.linspace(0.0, 120.0, 2401))
    assert (np.abs(p[:, :2] - dock.rest_m).max(axis=0) <= 0.3).all()
    assert np.abs(p[:, :2] - dock.rest_m).max() > 0.15
    yaw = np.degrees(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    assert 0.5 < np.abs(yaw).max() <= 1.5
    assert p[:, 2].mean() == pytest.approx(run.scenario.tide_m, abs=0.01)
    t = 33.0
    at, turned = (v[0] for v in dock.pose(np.array([t])))
    where, looks = camera.pose(t)
    expected = at + turned @ np.array([-1.4, -2.0, 0.8])  # tag 230 from the middle of the dock at (140, 86)
    np.testing.assert_allclose(where + looks @ camera.tag_poses(t)[230][0], expected, atol=1e-9)


def test_lidars_meet_the_dock_where_it_is() -> None:
    """Points on its south face, in its own axes at that time, lie 2 m from its middle."""
    run, _ = docking("optimal", kind="floating")
    (dock,) = run.docks
    times = np.arange(5.0, 110.0, 1.0)
    away = np.hypot(*(dock.pose(times)[0][:, :2] - dock.rest_m).T)
    t = float(times[int(np.argmax(away))])
    scene, rng = scene_of(run), np.random.default_rng(0)
    points = np.vstack([
        world_points(scan(name, lidar, scene, run.motion, t, rng), lidar, run.motion)
        for name, lidar in run.rig.lidars.items()
    ])  # fmt: skip
    at, turned = (v[0] for v in dock.pose(np.array([t + 0.05])))
    in_dock = (points - at) @ turned
    face = (
        (np.abs(in_dock[:, 1] + 2.0) < 0.5)
        & (np.abs(in_dock[:, 0]) < 11.5)
        & (in_dock[:, 2] > 0.2)
        & (in_dock[:, 2] < 1.2)
    )
    assert face.sum() > 30
    assert np.abs(in_dock[face, 1] + 2.0).mean() < 0.02
    assert away.max() > 0.1  # at rest this would not tell


def test_the_recording_holds_images_as_drivers_write_them(tmp_path: Path, detector: Detector) -> None:
    """ROS 1 and 2, JPEG and raw: image and `CameraInfo` of one stamp, the mount, the survey near the truth."""
    for ros, raw in ((2, False), (1, True)):
        run = simulate(
            replace(
                harbour_scenarios()["dock-floating-optimal"],
                duration_s=40.0,
                lidar_hz=0.0,
                camera_hz=0.1,
                camera_raw=raw,
            ),
            3,
        )
        folder = tmp_path / f"{ros}"
        bag, _ = write_bag(run, folder, ros=ros)
        topic = "/camera/image_raw" if raw else "/camera/image_raw/compressed"
        with AnyReader([bag]) as reader:
            read: list[tuple[str, int, Any]] = [
                (c.topic, log, reader.deserialize(m, c.msgtype)) for c, log, m in reader.messages()
            ]
        images: list[Any] = [m for name, _, m in read if name == topic]
        infos: list[Any] = [m for name, _, m in read if name == "/camera/camera_info"]
        assert len(images) == len(infos) == 3
        for image, info in zip(images, infos, strict=True):
            assert (image.header.stamp.sec, image.header.stamp.nanosec) == (
                info.header.stamp.sec,
                info.header.stamp.nanosec,
            )
            assert image.header.frame_id == info.header.frame_id == "camera_optical_frame"
            K = info.K if ros == 1 else info.k
            np.testing.assert_allclose(K, [1069.38, 0, 1103.67, 0, 1069.38, 664.69, 0, 0, 1])
            assert (info.width, info.height, info.distortion_model) == (2208, 1242, "plumb_bob")
        last = images[-1]
        if raw:
            pixels = np.frombuffer(last.data.tobytes(), np.uint8).reshape(last.height, last.step)
        else:
            pixels = np.asarray(cv2.imdecode(last.data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
        assert pixels.shape == (1242, 2208)
        assert {230, 231, 232} <= set(detected(detector, pixels))
        mounts = {t.child_frame_id: t.transform for name, _, m in read if name == "/tf_static" for t in m.transforms}
        q = mounts["camera_optical_frame"].rotation
        x, y, z, w = q.x, q.y, q.z, q.w
        ahead = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])  # third column
        np.testing.assert_allclose(ahead, [np.cos(np.radians(3)), 0.0, -np.sin(np.radians(3))], atol=1e-6)
        docks: list[Any] = [m for name, _, m in read if name == "/truth/north_dock"]
        at, _ = run.docks[0].pose(np.array([10.0]))
        where = docks[200].pose.pose.position
        np.testing.assert_allclose([where.x, where.y, where.z], at[0], atol=1e-6)
    survey = YAML(typ="safe").load((folder / "tags.yaml").read_text())
    truth = json.loads((folder / "truth.json").read_text())["tags"]
    assert [t["id"] for t in survey["tags"]] == [226, 227, 228, 230, 231, 232]
    off = np.array([np.array(t["xyz_m"]) - truth[str(t["id"])]["xyz_m"] for t in survey["tags"]])
    assert 0.003 < off.std() < 0.02
    assert {t["frame"] for t in survey["tags"]} == {"world", "north_dock"}
    assert run.harbour is not None
    p, R = tag_pose(run.harbour.config.tags[0], run.harbour)
    np.testing.assert_allclose(p, [70.6, 96.0, 1.5])
    np.testing.assert_allclose(R, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)  # faces south: x east, y up


def quaternion_matrix(q: Any) -> Array:
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def test_corners_are_where_the_bag_alone_says(tmp_path: Path, detector: Detector) -> None:
    """Survey, `/tf_static`, `/truth`, `/truth/<dock>`, K and D, put together by hand: the chain that a user goes.

    Odd on purpose: two cameras, yawed, tilted and distorting; tags that face 135 and 225 deg; a tide; a turned dock.
    """
    harbour = {
        "name": "odd", "datum": {"latitude_deg": 57.7, "longitude_deg": 11.7}, "image_m": [-60, -60, 60, 60],
        "quays": [{"outline": [[-16, 10], [-10, 16], [-10, 24], [-24, 24], [-24, 10]], "top_m": 3.5}],
        "docks": [{"name": "raft", "outline": [[12, 7], [16, 11], [13, 14], [9, 10]], "top_m": 2.0, "moves_deg": 8, "period_s": 6}],
        "pontoons": [{"outline": [[-1, 30], [1, 30], [1, 31], [-1, 31]], "top_m": 0.5}],
        "tags": [
            {"number": 3, "at": [-13, 13], "height_m": 2.2, "facing_deg": 135, "size_m": 0.9},
            {"number": 4, "at": [10.5, 8.5], "height_m": 1.0, "facing_deg": 225, "size_m": 0.8, "dock": "raft"},
        ],
        "routes": {"entry": [[0, -12], [0, -2]]},
    }  # fmt: skip
    yaml = YAML(typ="safe", pure=True)
    rig = yaml.load((Path(__file__).parent.parent / "eval/simulate/rigs/launch.yaml").read_text())
    lens = {"width_px": 1600, "height_px": 1200, "focal_px": [620, 640], "centre_px": [812, 590]}
    bent = [-0.05, 0.01, 0.002, -0.003, 0.001]
    rig["cameras"] = {
        name: {"mount": {"xyz_m": [0.5, y, 1.5], "rpy_deg": [-95, 3, yaw]}, "distortion": bent, **lens}
        for name, y, yaw in (("port", 0.6, -30), ("starboard", -0.6, -150))
    }
    for name, block in (("harbour", harbour), ("rig", rig)):
        with (tmp_path / f"{name}.yaml").open("w") as stream:
            yaml.dump(block, stream)
    changes = {
        "harbour": str(tmp_path / "harbour.yaml"), "rig": str(tmp_path / "rig.yaml"), "camera_hz": "2", "lidar_hz": "0.3",
        "tide_m": "0.6", "duration_s": "12", "route_s": "12",
    }  # fmt: skip
    run = replace(simulate(find_scenario("bl1-clean", changes), 2))
    bag, _ = write_bag(run, tmp_path / "out", ros=2)
    with AnyReader([bag]) as reader:
        read: list[tuple[str, int, Any]] = [
            (c.topic, log, reader.deserialize(m, c.msgtype)) for c, log, m in reader.messages()
        ]
        (latched,) = (c for c in reader.connections if c.topic == "/tf_static")
    assert "TRANSIENT_LOCAL" in str(latched.ext)
    tf = {t.child_frame_id: t.transform for name, _, m in read if name == "/tf_static" for t in m.transforms}
    assert {"mast", "port_optical_frame", "starboard_optical_frame"} <= set(tf)
    assert all(log >= stamp_of(m) for name, log, m in read if name != "/tf_static")

    def pose(topic: str, stamp: int) -> tuple[Array, Array]:
        """Of the two around a stamp, linear between."""
        all_of_it = [m for name, _, m in read if name == topic]
        k = int(np.searchsorted([stamp_of(m) for m in all_of_it], stamp))
        a, b = all_of_it[k - 1], all_of_it[k]
        share = (stamp - stamp_of(a)) / (stamp_of(b) - stamp_of(a))
        ps = [np.array([m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z]) for m in (a, b)]
        Rs = [quaternion_matrix(m.pose.pose.orientation) for m in (a, b)]
        u, _, v = np.linalg.svd((1 - share) * Rs[0] + share * Rs[1])
        return (1 - share) * ps[0] + share * ps[1], u @ v

    survey = {t["id"]: t for t in yaml.load((tmp_path / "out/tags.yaml").read_text())["tags"]}
    assert {k: (t["size_m"], t["frame"]) for k, t in survey.items()} == {3: (0.9, "world"), 4: (0.8, "raft")}
    assert {m.child_frame_id for name, _, m in read if name == "/truth/raft"} == {"raft"}
    off: dict[int, list[float]] = {3: [], 4: []}
    for name in ("port", "starboard"):
        infos = {stamp_of(m): m for topic, _, m in read if topic == f"/{name}/camera_info"}
        images = [m for topic, _, m in read if topic == f"/{name}/image_raw/compressed"]
        mount = tf[f"{name}_optical_frame"]
        t_bc = np.array([mount.translation.x, mount.translation.y, mount.translation.z])
        R_bc = quaternion_matrix(mount.rotation)
        for image in images[2:-2]:
            info = infos[stamp_of(image)]
            assert image.format.startswith("mono8; jpeg")
            assert info.distortion_model == "plumb_bob"
            np.testing.assert_allclose(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))
            k1, k2, p1, p2, k3 = info.d
            p_wb, R_wb = pose("/truth", stamp_of(image))
            pixels = np.asarray(cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
            for number, corners in detected(detector, LINEAR[pixels]).items():
                tag = survey[number]
                roll, pitch, yaw = np.radians(tag["rpy_deg"])
                turn = [
                    np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]),
                    np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]),
                    np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]),
                ]
                in_frame = CORNERS * tag["size_m"] / 0.412 @ (turn[2] @ turn[1] @ turn[0]).T + tag["xyz_m"]
                if tag["frame"] != "world":
                    p_wd, R_wd = pose(f"/truth/{tag['frame']}", stamp_of(image))
                    in_frame = in_frame @ R_wd.T + p_wd
                at = ((in_frame - p_wb) @ R_wb - t_bc) @ R_bc
                x, y = at[:, 0] / at[:, 2], at[:, 1] / at[:, 2]
                r2 = x**2 + y**2
                radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
                u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
                v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
                expected = np.column_stack([u, v]) @ info.k.reshape(3, 3)[:2, :2].T + info.k.reshape(3, 3)[:2, 2]
                off[number].append(float(np.abs(corners - expected).max()))
    assert min(len(o) for o in off.values()) > 10
    # A surveyor's 1 cm at 9 m is 0.7 px, and it can be three times that; a wrong link in the chain is tens.
    assert np.mean([v for o in off.values() for v in o]) < 1.0
    assert max(max(o) for o in off.values()) < 2.2
    docks = yaml.load((tmp_path / "out/tags.yaml").read_text())["docks"]
    assert docks[0]["xyz_m"] == [12.5, 10.5, 0.0]
    truth = json.loads((tmp_path / "out/truth.json").read_text())["tags"]["3"]
    # Faces south-east, seen from there: right is north-east.
    np.testing.assert_allclose(
        np.array(truth["R"]) * np.sqrt(2.0), [[1, 0, 1], [1, 0, -1], [0, np.sqrt(2.0), 0]], atol=1e-9
    )
    clouds = [m for name, _, m in read if name == "/mast/points"]
    fields = {f.name: f for f in clouds[0].fields}
    rows = clouds[0].data.reshape(-1, clouds[0].point_step)
    for field, kind in (("time", "<f4"), ("ring", "<u2")):
        begin = fields[field].offset
        column = np.ascontiguousarray(rows[:, begin : begin + np.dtype(kind).itemsize]).view(kind)
        assert len(np.unique(column)) > 10
        assert column.max() < {"time": 0.1, "ring": 32}[field]


def test_two_cameras_share_the_sun_and_no_noise() -> None:
    run = simulate(find_scenario("dock-fixed-counterlight", {}), 1)
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
    camera = CameraConfig(mount=LOOKING_AHEAD, width_px=640, height_px=480)
    noise = np.random.default_rng(1).standard_normal((480, 640), dtype=np.float32)
    ms, gain = 30.0, 16.0
    electrons = 60.0
    field = np.full((480, 640), electrons / (ms * camera.electrons_per_ms), dtype=np.float32)
    level = (digitise(field, camera, (ms, gain), noise) / 255.0) ** 2.2 * camera.full_well / gain
    assert level.std() == pytest.approx(np.sqrt(electrons + camera.read_noise**2), rel=0.02)


def test_a_point_of_light_is_blurred_and_veiled() -> None:
    """Its core is a Gaussian of the lens; stray light takes 4.5 % of it, times its weather, and loses none."""
    camera = CameraConfig(mount=LOOKING_AHEAD, width_px=1600, height_px=1600, blur_px=1.5)
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
        camera = CameraConfig(mount=MountConfig(xyz_m=(-5.0, 0.0, -0.5), rpy_deg=(-90.0, 0.0, -90.0)))
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


def test_fixes_claim_what_is_right_on_average_only() -> None:
    claimed = reported_sigma_m(np.random.default_rng(2), np.arange(0.0, 120.0, 0.1), 0.2, 0.3)
    assert np.sqrt((claimed**2).mean()) == pytest.approx(0.2)
    assert 0.12 < np.log(claimed).std() < 0.5
    assert abs(np.log(claimed[1:] / claimed[:-1])).max() < 0.2  # it wanders, it does not flicker
    run = simulate(harbour_scenarios()["bl1-clean"], 3)
    fixes = [m for m in run.recording.measurements if isinstance(m, GnssPosition)]
    at = run.truth.at(np.array([m.stamp_ns for m in fixes]))
    antenna = at.p_world_m + at.R_world_body @ run.rig.gnss.t_body_sensor_m
    assert run.harbour is not None
    error = run.harbour.datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T) - antenna
    told = np.array([m.cov_enu_m2[0, 0] for m in fixes])
    assert np.ptp(told) > 0.01
    assert (error[:, :2] ** 2).mean() == pytest.approx(told.mean(), rel=0.1)


def test_the_long_run_has_all_of_it() -> None:
    run = simulate(harbour_scenarios()["long"], 1)
    fixes = [m for m in run.recording.measurements if isinstance(m, GnssPosition)]
    stamps = np.array([m.stamp_ns for m in fixes])
    t = (stamps - run.truth.stamps_ns[0]) * 1e-9
    at = run.truth.at(stamps)
    antenna = at.p_world_m + at.R_world_body @ run.rig.gnss.t_body_sensor_m
    assert run.harbour is not None
    error = np.hypot(
        *(run.harbour.datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T) - antenna)[:, :2].T
    )
    assert error[t < 350.0].max() < 0.5
    assert 1.0 < error[(t > 500.0) & (t < 700.0)].mean() < 2.0
    assert 9.0 < error[(t > 780.0) & (t < 960.0)].max() < 11.5
    assert not ((t > 990.5) & (t < 1049.5)).any()
    speed = np.linalg.norm(run.motion.pose(np.arange(0.0, 1800.0))[2][:, :2], axis=1)
    assert speed[1130:1195].max() < 0.25  # it halts
    assert speed[400:1000].mean() > 0.5
    assert np.hypot(*(run.truth.p_world_m[-1, :2] - [71.7, 86.6])) < 1.5  # and docks
    assert speed[-60:].max() < 0.25


def test_another_rig_sees_with_its_own_eyes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["dock-fixed-optimal", "--rig", "launch", "--set", "duration_s=12", "--set", "camera_hz=0.5"]
    assert called(monkeypatch, "simulate", *arguments, "-o", tmp_path / "out") == 0
    with AnyReader([Path(capsys.readouterr().out.split("\n")[0])]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts["/mast/points"] == 11
    assert counts["/bow/image_raw/compressed"] == counts["/bow/camera_info"] == 5
    assert "/aerial/pose" not in counts
    vessel = YAML(typ="safe").load((tmp_path / "out/vessel.yaml").read_text())
    assert vessel["sensors"]["imu"]["mount"]["rpy_deg"] == [180.0, 0.0, 0.0]
    matcher = vessel["sensors"]["aerial"]
    assert (matcher["kind"], matcher["enabled"], matcher["image"]) == ("aerial", True, "aerial.tif")
    assert matcher["lidars"]["mast"]["topic"] == "/mast/points"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"cameras": {"c": {"mount": {}, "model": "equidistant"}}}, "equidistant has 4 coefficients, not 5"),
        ({"cameras": {"c": {"mount": {}, "focal": 1}}}, "unknown key 'cameras.c.focal'"),
        ({"lidars": {"l": {"mount": {}}}}, "lidars.l.range_m: Field required"),
        ({"lidars": {"gnss": {"make": "helios", "mount": {}}}}, "'gnss' cannot name a sensor"),
        ({"lidars": {"l": {"make": "velodyne", "mount": {}}}}, "'bpearl' or 'helios'"),
        ({"lidars": {"Top Lidar": {"make": "helios", "mount": {}}}}, "lidars.Top Lidar"),
    ],
)
def test_a_bad_rig_is_one_line(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    text = (Path(__file__).parent.parent / "eval/simulate/rigs/launch.yaml").read_text()
    yaml = YAML(typ="safe", pure=True)
    with (tmp_path / "rig.yaml").open("w") as stream:
        yaml.dump({**yaml.load(text), **change}, stream)
    with pytest.raises(Exception, match=r"rig\.yaml") as caught:
        simulate(find_scenario("bl1-clean", {"rig": str(tmp_path / "rig.yaml")}), 1)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
