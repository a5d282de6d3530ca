# SPDX-License-Identifier: Apache-2.0
"""Reading bags: every kind of file gives the same run, and every message is accounted for."""

import runpy
import sqlite3
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from ruamel.yaml import YAML

from graphloc.config import (
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    HeightConfig,
    ImuConfig,
    PoseConfig,
    SensorConfig,
    VelocityConfig,
    VesselConfig,
    load_config,
    parse_config,
)
from graphloc.errors import InputError
from graphloc.frames import Datum
from graphloc.frontends.bag import read_recording
from graphloc.frontends.source import Bag
from graphloc.ledger import Ledger, Outcome
from graphloc.measurements import BodyVelocity, CompassHeading, GnssPosition, GnssVelocity
from graphloc.recording import Recording
from graphloc.signals.thinning import THINNED
from tests.bagfactory import START_NS, Messages, S, still_run, write_bag

KINDS: dict[str, type[SensorConfig]] = {
    "imu": ImuConfig,
    "gnss": GnssConfig,
    "compass": CompassConfig,
    "gnss_velocity": VelocityConfig,
    "body_velocity": BodyVelocityConfig,
    "pose": PoseConfig,
    "height": HeightConfig,
}
HUSKY = Path(__file__).parent.parent.parent / "shared" / "data" / "husky" / "husky_car_park.bag"


def vessel(**sensors: Any) -> VesselConfig:
    """A configuration; `imu` and `gnss` on their usual topics unless said otherwise."""
    extra: dict[str, Any] = {
        k: sensors.pop(k) for k in ("truth_topic", "check_speed_topic", "datum", "body_frame") if k in sensors
    }
    blocks = {"imu": {"topic": "/imu"}, "gnss": {"topic": "/fix"}, **sensors}
    return parse_config({"sensors": {k: v for k, v in blocks.items() if v}, **extra}, KINDS, "test")


def accounted(recording: Recording) -> int:
    """Messages that ended somewhere; the ledger refuses an arrival that ended twice."""
    ledger = Ledger(recording.rows)
    used = [m.seq for m in recording.measurements]
    if recording.imu is not None:
        used += [int(s) for s in recording.imu.seqs]
    assert len(set(used)) == len(used)
    assert not any(s in ledger for s in used)
    return len(used) + len(ledger)


CASES = [
    ("ros1", "", "run.bag"),
    ("ros1", "bz2", "run.bag"),
    ("ros1", "lz4", "run.bag"),
    ("sqlite3", "", "run"),
    ("sqlite3", "file", "run"),
    ("sqlite3", "message", "run"),
    ("mcap", "", "run"),
    ("mcap", "storage", "run"),
    ("mcap", "message", "run"),
]


@pytest.mark.parametrize(("kind", "compression", "name"), CASES)
def test_every_kind_of_bag_gives_the_same_run(tmp_path: Path, kind: str, compression: str, name: str) -> None:
    make = Messages(1 if kind == "ros1" else 2)
    items = still_run(make)
    items += [("/note", START_NS + k * S, make.text("hello")) for k in range(3)]
    path = write_bag(tmp_path / name, make, sorted(items, key=lambda i: i[1]), kind, compression)
    recording = read_recording(path, vessel())
    assert recording.imu is not None
    assert len(recording.imu) == 200
    assert len(recording.measurements) == 20
    assert recording.imu.stamps_ns[0] == START_NS
    assert recording.imu.stamps_ns[-1] == START_NS + 199 * S // 50
    np.testing.assert_allclose(recording.imu.accel_mps2, np.tile([0.0, 0.0, 9.81], (200, 1)))
    fix = recording.measurements[3]
    assert isinstance(fix, GnssPosition)
    assert fix.stamp_ns == START_NS + 30 * S // 50
    assert tuple(fix.position) == (57.7, 11.9, 40.0)
    np.testing.assert_allclose(fix.cov_enu_m2, np.diag([1.0, 1.0, 4.0]))
    assert recording.message_count == accounted(recording) == 223
    (ignored,) = recording.rows
    assert (ignored.outcome, ignored.topic, ignored.count) == (Outcome.IGNORED, "/note", 3)
    assert recording.warnings == ()


@pytest.mark.parametrize(("kind", "suffix"), [("sqlite3", "db3"), ("mcap", "mcap")])
def test_a_bare_file_and_a_folder_without_metadata_open(tmp_path: Path, kind: str, suffix: str) -> None:
    folder = write_bag(tmp_path / "run", make := Messages(2), still_run(make), kind)
    assert len(read_recording(folder / f"run.{suffix}", vessel()).measurements) == 20
    (folder / "metadata.yaml").unlink()
    recording = read_recording(folder, vessel())
    assert len(recording.measurements) == 20
    assert "no metadata.yaml" in recording.warnings[0]


def test_a_bag_without_definitions_is_read_by_the_standard_ones(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "run", make := Messages(2), still_run(make))
    with sqlite3.connect(folder / "run.db3") as db:
        db.execute("DELETE FROM message_definitions")
    db.close()
    assert len(read_recording(folder, vessel()).measurements) == 20


def test_split_ros1_bags(tmp_path: Path) -> None:
    make = Messages(1)
    parts = [
        write_bag(tmp_path / f"run_{k}.bag", make, still_run(make, start_ns=START_NS + 4 * k * S), "ros1")
        for k in range(3)
    ]
    for given in (parts, [parts[2], parts[0], parts[1]], tmp_path):
        recording = read_recording(given, vessel())
        assert recording.imu is not None
        assert len(recording.imu) == 600
        assert (np.diff(recording.imu.stamps_ns) == S // 50).all()
        assert (np.diff(recording.imu.seqs) > 0).all()
        assert recording.message_count == accounted(recording) == 660
        assert recording.warnings == ()


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("ros1", ["run_9.bag", "run_10.bag", "run_11.bag"]),
        ("ros1", ["2023-11-14-22-13-20_0.bag", "2023-11-14-22-13-24_1.bag", "2023-11-14-22-13-28_2.bag"]),
        ("mcap", ["run_0.mcap", "run_1.mcap", "run_2.mcap"]),
        ("sqlite3", ["run_0.db3", "run_1.db3", "run_2.db3"]),
    ],
)
def test_parts_of_a_split_bag_that_are_left_beside_are_said(tmp_path: Path, kind: str, names: list[str]) -> None:
    make, parts = Messages(1 if kind == "ros1" else 2), []
    for k, name in enumerate(names):
        start_ns = START_NS + 4 * k * S
        if kind == "ros1":
            write_bag(tmp_path / name, make, still_run(make, start_ns=start_ns), kind)
        else:
            stem, _, suffix = name.partition(".")
            folder = write_bag(tmp_path / "written" / stem, make, still_run(make, start_ns=start_ns), kind)
            (folder / f"{stem}.{suffix}").rename(tmp_path / name)
        parts.append(tmp_path / name)
    assert read_recording(parts, vessel()).warnings == ()
    assert read_recording(parts[0], vessel()).warnings == (
        f"{parts[0]}: its recording goes on in {names[1]}, which is not read: give all parts of it",
    )
    assert [w.partition(" its ")[2] for w in read_recording(parts[1], vessel()).warnings] == [
        f"recording goes on in {names[2]}, which is not read: give all parts of it",
        f"recording begins in {names[0]}, which is not read: give all parts of it",
    ]


def test_runs_with_numbers_are_no_parts(tmp_path: Path) -> None:
    """Recorded a minute apart; and of one the beginning alone is there."""
    make = Messages(1)
    for k in range(2):
        write_bag(tmp_path / f"run_{k}.bag", make, still_run(make, start_ns=START_NS + 60 * k * S), "ros1")
    (tmp_path / "run_2.bag").write_bytes(b"#ROSBAG V2.0\n")
    assert read_recording(tmp_path / "run_1.bag", vessel()).warnings == ()


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_files_that_metadata_does_not_name_are_reported(tmp_path: Path, kind: str) -> None:
    """Half of a run was left out without a word."""
    make = Messages(2)
    folder = write_bag(tmp_path / "run", make, still_run(make), kind)
    second = write_bag(tmp_path / "next", make, still_run(make, start_ns=START_NS + 4 * S), "mcap")
    (second / "next.mcap").rename(folder / "next.mcap")
    recording = read_recording(folder, vessel())
    assert len(recording.measurements) == 20
    (said,) = recording.warnings
    assert said.startswith(f"{folder}: its metadata.yaml does not name next.mcap")


@pytest.mark.parametrize(("kind", "suffix"), [("sqlite3", "db3"), ("mcap", "mcap")])
def test_split_ros2_bag(tmp_path: Path, kind: str, suffix: str) -> None:
    make = Messages(2)
    folder = write_bag(tmp_path / "run", make, still_run(make), kind)
    second = write_bag(tmp_path / "next", make, still_run(make, start_ns=START_NS + 4 * S), kind)
    (second / f"next.{suffix}").rename(folder / f"next.{suffix}")
    yaml = YAML(typ="safe")
    metadata = yaml.load(folder / "metadata.yaml")
    information = metadata["rosbag2_bagfile_information"]
    information["relative_file_paths"] = [f"run.{suffix}", f"next.{suffix}"]
    information["message_count"] *= 2
    for topic in information["topics_with_message_count"]:
        topic["message_count"] *= 2
    yaml.dump(metadata, folder / "metadata.yaml")
    recording = read_recording(folder, vessel())
    assert recording.imu is not None
    assert len(recording.imu) == 400
    assert recording.message_count == accounted(recording) == 440
    assert recording.warnings == ()


def test_image_topics_are_never_unpacked(tmp_path: Path) -> None:
    """Bytes that are no image at all do no harm, so nobody looked at them."""
    make = Messages(2)
    items = still_run(make)
    items += [("/camera", START_NS + k * S, ("sensor_msgs/msg/Image", b"\0\1\2")) for k in range(4)]
    path = write_bag(tmp_path / "run", make, sorted(items, key=lambda i: i[1]), "mcap")
    recording = read_recording(path, vessel())
    assert [(r.topic, r.count, r.outcome) for r in recording.rows] == [("/camera", 4, Outcome.IGNORED)]
    with Bag(path) as bag:
        assert {m.topic for m in bag.messages({"/fix"})} == {"/fix"}


def test_memory_does_not_grow_with_image_topics(tmp_path: Path) -> None:
    make = Messages(2)
    items: list[Any] = still_run(make)
    items += [("/camera", START_NS + k * S // 20, ("sensor_msgs/msg/Image", bytes(1_000_000))) for k in range(64)]
    path = write_bag(tmp_path / "run", make, sorted(items, key=lambda i: i[1]), "mcap")
    tracemalloc.start()
    try:
        read_recording(path, vessel())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 16_000_000  # 64 MB of images lie in between; a chunk of the file is a few MB


def test_an_unknown_type_on_another_topic_is_counted(tmp_path: Path) -> None:
    make = Messages(2)
    make.register("float64 depth\n", "boat_msgs/msg/Sonar")
    sonar = make.store.types["boat_msgs/msg/Sonar"]
    items = still_run(make) + [("/sonar", START_NS + 5 * S + k, sonar(depth=3.0)) for k in range(7)]
    recording = read_recording(write_bag(tmp_path / "run", make, items), vessel())
    (row,) = recording.rows
    assert (row.topic, row.count) == ("/sonar", 7)
    assert "boat_msgs/Sonar" in row.reason
    assert recording.message_count == accounted(recording)


def test_units_offsets_and_disabled_sensors(tmp_path: Path) -> None:
    make = Messages(2)
    items = [
        ("/imu", START_NS + k * S // 50, make.imu(START_NS + k * S // 50, accel=(0, 0, 1.0), gyro=(0, 0, 180.0)))
        for k in range(100)
    ]
    path = write_bag(tmp_path / "run", make, items)
    block = {"topic": "/imu", "accel_unit": "g", "gyro_unit": "deg/s", "time_offset_s": -0.25}
    recording = read_recording(path, vessel(imu=block, gnss={"topic": "/not/there", "enabled": False}))
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.accel_mps2[0], [0.0, 0.0, 9.80665])
    np.testing.assert_allclose(recording.imu.gyro_radps[0], [0.0, 0.0, np.pi])
    assert recording.imu.stamps_ns[0] == START_NS - S // 4


def test_one_topic_for_two_sensors_counts_for_each(tmp_path: Path) -> None:
    """The orientation of an IMU as compass: yaw 30 deg, variance 4e-4."""
    make = Messages(2)
    half = np.radians(15.0)
    cov = np.diag([1.0, 1.0, 4e-4]).ravel()
    stamps = [START_NS + k * S // 50 for k in range(60)]
    items = [
        ("/imu", s, make.imu(s, orientation=(0, 0, np.sin(half), np.cos(half)), orientation_covariance=cov))
        for s in stamps
    ]
    path = write_bag(tmp_path / "run", make, items)
    recording = read_recording(path, vessel(gnss=None, compass={"topic": "/imu"}))
    assert recording.imu is not None
    assert len(recording.imu) == 60
    assert len(recording.measurements) == 20  # every third, 0.06 s apart: each tells what those between would
    assert len(recording.rows) == 40
    heading = recording.measurements[0]
    assert isinstance(heading, CompassHeading)
    assert heading.yaw_rad == pytest.approx(np.radians(30.0))
    assert heading.sigma_rad == pytest.approx(0.02)
    assert recording.message_count == accounted(recording) == 120


def test_truth_and_check_speed_are_read_and_never_fused(tmp_path: Path) -> None:
    make = Messages(2)
    items = still_run(make)
    for k in range(40):
        t = START_NS + k * S // 10
        items.append(("/truth", t, make.odometry(t, xyz=(k, 2 * k, 0), xyzw=(0, 0, np.sqrt(0.5), np.sqrt(0.5)))))
        items.append(("/wheels", t, make.odometry(t, v=(0.1 * k, 0, 0))))
    path = write_bag(tmp_path / "run", make, sorted(items, key=lambda i: i[1]))
    recording = read_recording(path, vessel(truth_topic="/truth", check_speed_topic="/wheels"))
    assert recording.truth is not None
    assert recording.check_speed is not None
    np.testing.assert_allclose(recording.truth.p_world_m[7], [7, 14, 0])
    np.testing.assert_allclose(recording.truth.yaw_rad, np.pi / 2)
    np.testing.assert_allclose(recording.check_speed.speed_mps, 0.1 * np.arange(40))
    assert {(r.topic, r.count, r.reason) for r in recording.rows} == {
        ("/truth", 40, "truth, never fused"),
        ("/wheels", 40, "check, never fused"),
    }
    assert recording.message_count == accounted(recording)
    assert len(recording.measurements) == 20


def test_mounts_follow_the_chain_of_tf_static(tmp_path: Path) -> None:
    """base_link -> mast (1 m forward, turned 90 deg left) -> gps (2 m along the mast's x): body (1, 2, 0)."""
    make = Messages(2)
    turn = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    edges = [("base_link", "mast", (1, 0, 0), turn), ("mast", "gps", (2, 0, 0), (0, 0, 0, 1))]
    items = [("/tf_static", START_NS, make.transforms(edges)), *still_run(make)]
    path = write_bag(tmp_path / "run", make, items)
    recording = read_recording(path, vessel(gnss={"topic": "/fix", "mount": {"tf_frame": "gps"}}))
    t, R = recording.mounts["gnss"]
    np.testing.assert_allclose(t, [1.0, 2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert recording.message_count == accounted(recording) == 221
    with pytest.raises(InputError, match=r"gnss\.mount\.tf_frame: no chain from 'base_link' to 'lidar'.*gps, mast"):
        read_recording(path, vessel(gnss={"topic": "/fix", "mount": {"tf_frame": "lidar"}}))


def test_the_body_may_hang_below_another_frame(tmp_path: Path) -> None:
    """base_link at (2, 0, 0.5) in the footprint, turned 90 deg left; gps at (1, 0, 2): 1 m to port of the body."""
    make = Messages(2)
    turn = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    edges = [("footprint", "base_link", (2, 0, 0.5), turn), ("footprint", "gps", (1, 0, 2), (0, 0, 0, 1))]
    path = write_bag(tmp_path / "run", make, [("/tf_static", START_NS, make.transforms(edges)), *still_run(make)])
    t, R = read_recording(path, vessel(gnss={"topic": "/fix", "mount": {"tf_frame": "gps"}})).mounts["gnss"]
    np.testing.assert_allclose(t, [0.0, 1.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], atol=1e-12)


def test_mounts_that_tf_repeats(tmp_path: Path) -> None:
    """ROS 1's publisher of the package `tf` repeats fixed transforms on /tf; among them one that turns, and the vessel's own.

    3000 messages each, so that not all are read. What /tf_static says of `mast` counts, whatever /tf repeats.
    """
    make, half = Messages(2), np.sqrt(0.5)
    items = still_run(make, seconds=10.0)
    fixed = ("base_link", "gps", (1.0, 2.0, 3.0), (0.0, 0.0, half, half))
    for k in range(3000):
        at = START_NS + k * S // 300
        turn = (0.0, 0.0, np.sin(1e-4 * k), np.cos(1e-4 * k))
        items += [
            ("/tf", at, make.transforms([("odom", "base_link", (0.01 * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))])),
            ("/tf", at + 1, make.transforms([fixed, ("base_link", "mast", (9.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))])),
            ("/tf", at + 2, make.transforms([("base_link", "radar", (0.0, 0.0, 4.0), turn)])),
        ]
    static = make.transforms([("base_link", "mast", (4.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))])
    path = write_bag(tmp_path / "run", make, [("/tf_static", START_NS, static), *sorted(items, key=lambda i: i[1])])

    def read(frame: str) -> Recording:
        return read_recording(path, vessel(gnss={"topic": "/fix", "mount": {"tf_frame": frame}}))

    recording = read("gps")
    t, R = recording.mounts["gnss"]
    np.testing.assert_allclose(t, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert ("/tf", 9000, "read for mounts") in {(r.topic, r.count, r.reason) for r in recording.rows}
    assert recording.message_count == accounted(recording)
    np.testing.assert_allclose(read("mast").mounts["gnss"][0], [4.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"no chain from 'base_link' to 'radar'.*; changing on /tf: base_link, radar"):
        read("radar")


@pytest.mark.parametrize("twist", [(0.0, -1.0, 0.0), (0.0, 0.0, 0.0)], ids=["in body", "left at zero"])
def test_velocity_of_the_truth(tmp_path: Path, twist: tuple[float, float, float]) -> None:
    """East at 1 m/s with the bow north: to starboard, so -y in body."""
    make = Messages(2)
    items = [
        ("/truth", t, make.odometry(t, xyz=(k / 10, 0, 0), xyzw=(0, 0, np.sqrt(0.5), np.sqrt(0.5)), v=twist))
        for k, t in enumerate(START_NS + k * S // 10 for k in range(30))
    ]
    recording = read_recording(
        write_bag(tmp_path / "run", make, items), vessel(imu=None, gnss=None, truth_topic="/truth")
    )
    assert recording.truth is not None
    assert recording.truth.v_world_mps is not None
    np.testing.assert_allclose(recording.truth.v_world_mps, np.tile([1.0, 0.0, 0.0], (30, 1)), atol=1e-6)


def test_progress_counts_the_messages_that_are_read(tmp_path: Path) -> None:
    calls: list[tuple[str, int, int]] = []
    path = write_bag(tmp_path / "run", make := Messages(2), still_run(make))
    read_recording(path, vessel(), lambda stage, done, total: calls.append((stage, done, total)))
    assert calls[-1] == ("reading", 220, 220)


@pytest.mark.skipif(not HUSKY.exists(), reason="the Husky recording is not here")
def test_husky() -> None:
    imu = {"topic": "/imu/data"}
    config = vessel(imu=imu, gnss={"topic": "/fix"}, check_speed_topic="/husky_velocity_controller/odom")
    recording = read_recording(HUSKY, config)
    assert recording.imu is not None
    assert recording.check_speed is not None
    assert (len(recording.imu), len(recording.measurements), len(recording.check_speed.stamps_ns)) == (11865, 989, 3952)
    x, y, z = np.median(recording.imu.accel_mps2, axis=0)
    assert y == pytest.approx(9.8, abs=0.1)
    assert abs(x) < 0.5
    assert abs(z) < 0.5
    assert recording.message_count == accounted(recording) == 11865 + 989 + 3952
    assert recording.warnings == ()


@pytest.mark.parametrize("flags", [[], ["--mcap"]], ids=["sqlite3", "mcap"])
def test_kitti_example(tmp_path: Path, flags: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The script's bag holds gtsam's files: all rows but the first IMU one, local metres to 1 mm."""
    example = Path(__file__).parent.parent / "examples" / "kitti"
    monkeypatch.setattr(sys, "argv", ["make_bag.py", str(tmp_path / "bag"), *flags])
    runpy.run_path(str(example / "make_bag.py"), run_name="__main__")
    config = load_config(example / "vessel.yaml", KINDS)
    recording = read_recording(tmp_path / "bag", config)
    assert recording.imu is not None
    assert config.datum is not None
    assert (len(recording.imu), len(recording.measurements), recording.warnings) == (46967, 470, ())
    fixes = [m.position for m in recording.of(GnssPosition)]
    enu = Datum(config.datum.geodetic).enu_from_geodetic(*np.array(fixes).T)
    example = gtsam.findExampleDataFile("KittiGps_converted.txt")  # type: ignore[no-untyped-call]
    expected = np.loadtxt(example, skiprows=1, delimiter=",")
    np.testing.assert_allclose(enu, expected[:, 1:4], atol=1e-3)
    np.testing.assert_allclose(np.diff([m.stamp_ns for m in recording.measurements]) / S, np.diff(expected[:, 0]))


@pytest.mark.parametrize(("rate_hz", "read"), [(10, 40), (20, 80), (400, 89)])
def test_headings_that_come_faster_than_a_compass_errs_are_thinned(rate_hz: int, read: int, tmp_path: Path) -> None:
    """An IMU's orientation at 500 Hz took four times the memory of all else, for nothing. At 400 Hz every 18th of 1600 is read."""
    make = Messages(2)
    quiet = np.zeros(9)
    items = still_run(make)
    for k in range(4 * rate_hz):
        at = START_NS + k * S // rate_hz
        items.append(("/ahrs", at, make.imu(at, orientation_covariance=quiet)))
    path = write_bag(tmp_path / "run", make, sorted(items, key=lambda item: item[1]))
    recording = read_recording(path, vessel(imu={"topic": "/imu"}, gnss={"topic": "/fix"}, compass={"topic": "/ahrs"}))
    assert sum(isinstance(m, CompassHeading) for m in recording.measurements) == read
    assert sum(row.reason.startswith("less than 45 ms") for row in recording.rows) == 4 * rate_hz - read
    assert accounted(recording) == recording.message_count


@pytest.mark.parametrize(
    ("kind", "measured"), [("body_velocity", BodyVelocity), ("gnss_velocity", GnssVelocity), ("gnss", GnssPosition)]
)
def test_what_is_faster_than_it_errs_anew_is_thinned(
    kind: str, measured: type[BodyVelocity | GnssVelocity | GnssPosition], tmp_path: Path
) -> None:
    """Wheels, or another filter's output, at 100 Hz would each be a factor of the graph: every fifth is used, and the others have rows."""
    make, items = Messages(2), []
    for k in range(300):
        at_ns = START_NS + k * S // 100
        said = make.fix(at_ns, 57.7 + 1e-7 * k) if kind == "gnss" else make.twist(at_ns, (1.0, 0.0, 0.0))
        items += [("/imu", at_ns, make.imu(at_ns)), ("/fast", at_ns, said)]
    bag = write_bag(tmp_path / "run", make, items, "mcap")
    recording = read_recording(bag, vessel(gnss=None, fast={"kind": kind, "topic": "/fast"}))
    assert [m.stamp_ns for m in recording.of(measured)] == [START_NS + k * S // 20 for k in range(60)]
    reasons = [(row.outcome, row.reason) for row in recording.rows if row.sensor == "fast"]
    assert reasons == 240 * [(Outcome.REJECTED, THINNED)]


@pytest.mark.parametrize("burst", [2, 5])
def test_fixes_of_a_slow_receiver_that_are_stamped_in_bursts_are_not_thinned(burst: int, tmp_path: Path) -> None:
    """10 a second, through a gateway: the first of each burst, the latest of all, was used alone, and a run of fives was 1.2 m off, not 0.6."""
    make, items = Messages(2), []
    for k in range(100):
        at_ns = START_NS + k * S // 10
        came_ns = START_NS + (k // burst + 1) * burst * S // 10 + (k % burst) * S // 1000
        items += [("/imu", at_ns, make.imu(at_ns)), ("/fix", came_ns, make.fix(came_ns, 57.7 + 1e-6 * k))]
    recording = read_recording(write_bag(tmp_path / "run", make, items, "mcap"), vessel())
    used = [m.stamp_ns for m in recording.of(GnssPosition)]
    assert sum(stamp_ns > START_NS + 3 * S for stamp_ns in used) >= 70  # until then it may be a fast one
