# SPDX-License-Identifier: Apache-2.0
"""Simulated runs with cameras: docks, what the bag holds, and rigs of a user's own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pupil_apriltags import Detector
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

from graphloc.eval.simulate import find_scenario, harbour_scenarios, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.eval.simulate.docks import tag_pose
from graphloc.eval.simulate.lidar import scan, world_points
from graphloc.eval.simulate.noise import reported_sigma_m
from graphloc.eval.simulate.scene import scene_of
from graphloc.frames import Array
from graphloc.measurements import GnssPosition
from graphloc.time import stamps_of
from tests.camerabench import CORNERS, LINEAR, detected, detectors, docking
from tests.commands import called

pytestmark = pytest.mark.usefixtures("coarse_image")


@pytest.fixture(scope="module")
def detector() -> Iterator[Detector]:
    yield from detectors()


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
                imu_hz=20.0,
                lidar_hz=0.0,
                camera_hz=0.06,
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
        assert len(images) == len(infos) == 2
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
        "harbour": str(tmp_path / "harbour.yaml"), "rig": str(tmp_path / "rig.yaml"), "camera_hz": "1", "lidar_hz": "0.3",
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
    assert min(len(o) for o in off.values()) > 6
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


def test_fixes_claim_what_is_right_on_average_only() -> None:
    claimed = reported_sigma_m(np.random.default_rng(2), np.arange(0.0, 120.0, 0.1), 0.2, 0.3)
    assert np.sqrt((claimed**2).mean()) == pytest.approx(0.2)
    assert 0.12 < np.log(claimed).std() < 0.5
    assert abs(np.log(claimed[1:] / claimed[:-1])).max() < 0.2  # it wanders, it does not flicker
    run = simulate(harbour_scenarios()["bl1-clean"], 3)
    fixes = run.recording.of(GnssPosition)
    at = run.truth.at(stamps_of(fixes))
    antenna = at.p_world_m + at.R_world_body @ run.rig.gnss.t_body_sensor_m
    assert run.harbour is not None
    error = run.harbour.datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T) - antenna
    told = np.array([m.cov_enu_m2[0, 0] for m in fixes])
    assert np.ptp(told) > 0.01
    assert (error[:, :2] ** 2).mean() == pytest.approx(told.mean(), rel=0.1)


def test_the_long_run_has_all_of_it() -> None:
    run = simulate(replace(harbour_scenarios()["long"], imu_hz=10.0, compass_hz=0.0, pose_hz=0.0), 1)
    fixes = run.recording.of(GnssPosition)[:-1]  # truth ends before
    stamps = stamps_of(fixes)
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
    arguments = ["dock-fixed-optimal", "--rig", "launch", "--set", "duration_s=6", "--set", "camera_hz=0.5"]
    assert called(monkeypatch, "simulate", *arguments, "-o", tmp_path / "out") == 0
    with AnyReader([Path(capsys.readouterr().out.split("\n")[0])]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts["/mast/points"] == 5
    assert counts["/bow/image_raw/compressed"] == counts["/bow/camera_info"] == 2
    assert "/matcher/pose" not in counts
    vessel = YAML(typ="safe").load((tmp_path / "out/vessel.yaml").read_text())
    assert vessel["sensors"]["imu"]["mount"]["rpy_deg"] == [180.0, 0.0, 0.0]
    matcher = vessel["sensors"]["aerial"]
    assert (matcher["kind"], matcher.get("enabled", True), matcher["image"]) == ("aerial", True, "aerial.tif")
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
