# SPDX-License-Identifier: Apache-2.0
"""`inspect` on runs whose answer is known: mounts, units, conventions, and a draft that works as it stands."""

import json
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from graphloc.config import (
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    ImuConfig,
    VesselConfig,
    load_config,
    parse_config,
)
from graphloc.frames import Array, Datum, Geodetic, rotation_from_rpy_deg
from graphloc.frontends._assess import NO_TRACK, ReferenceTrack
from graphloc.frontends._assess_velocity import EITHER, axes_of, velocity_report
from graphloc.frontends._fixes import radians_warning
from graphloc.frontends._reports import BODY_AXES, EAST_AXES
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.inspect import Inspection, draft_config, render
from graphloc.frontends.msgtypes import TWIST
from graphloc.frontends.source import Bag, RawMessage
from graphloc.measurements import CompassHeading, GnssPosition, GnssVelocity
from tests.bagfactory import START_NS, Item, Messages, S, write_bag
from tests.commands import called
from tests.heldbags import hold_bag, inspect_bag, read_recording
from tests.test_bag import HUSKY, KINDS

DATUM = Datum(Geodetic(57.7, 11.9, 40.0))
NORTH_EAST_DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
G = 9.81


def rotation_z(degrees: float) -> Any:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


EASTING, NORTHING = 672816.3225, 6399009.0284  # of DATUM, by the series itself, not by PROJ
ROLL_90 = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # takes the sensor's y to body z


CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # z ahead, x to starboard, y down


def drive(
    make: Messages,
    R_body_sensor: Any = None,
    accel_scale: float = 1.0,
    gyro_scale: float = 1.0,
    status: int = 2,
    sigma_m: float = 0.02,
    seconds: int = 40,
    noise_m: float = 0.0,
    imu_hz: int = 25,
) -> list[Item]:
    """Speed 3 + 1.5 sin(0.4 t) m/s, yaw rate 0.15 sin(0.13 t) + 0.05 rad/s, first 10 s at rest; analytic IMU."""
    R = np.eye(3) if R_body_sensor is None else R_body_sensor
    rng = np.random.default_rng(1)
    dt = 0.02
    t = np.arange(0.0, seconds, dt)
    ramp = np.clip((t - 10.0) / 2.0, 0.0, 1.0)
    speed = ramp * (3.0 + 1.5 * np.sin(0.4 * t))
    rate = ramp * (0.15 * np.sin(0.13 * t) + 0.05)
    yaw = 0.3 + np.concatenate([[0.0], np.cumsum(rate[:-1] * dt)])
    east = np.concatenate([[0.0], np.cumsum((speed * np.cos(yaw))[:-1] * dt)])
    north = np.concatenate([[0.0], np.cumsum((speed * np.sin(yaw))[:-1] * dt)])
    accel = np.column_stack([np.gradient(speed, dt), speed * rate, np.full(len(t), G)]) + rng.normal(
        0, 0.02, (len(t), 3)
    )
    gyro = np.column_stack([0 * t, 0 * t, rate]) + rng.normal(0, 1e-3, (len(t), 3)) + [0.0, 0.0, 0.004]
    lla = DATUM.geodetic_from_enu(np.column_stack([east, north, 0 * t]) + noise_m * rng.normal(size=(len(t), 3)))
    in_sensor = (accel_scale * (accel @ R)).tolist(), (gyro_scale * (gyro @ R)).tolist()
    cov = (sigma_m**2 * np.eye(3)).ravel()
    items: list[Item] = []
    for k, felt in enumerate(zip(*in_sensor, strict=True)):
        stamp = START_NS + k * S // 50
        if k % (50 // imu_hz) == 0:
            items.append(("/imu", stamp, make.imu(stamp, *felt, frame="imu_link")))
        if k % 10 == 0:
            items.append(("/fix", stamp, make.fix(stamp, lla[k][0], lla[k][1], lla[k][2], status, cov)))
            heading = np.pi / 2.0 - yaw[k]
            half = 0.5 * (heading + np.radians(1.0) * rng.normal())
            items.append(("/compass", stamp, make.compass(stamp, (0, 0, np.sin(half), np.cos(half)))))
        if k % 5 == 0:
            items.append(("/wheel/odom", stamp, make.odometry(stamp, v=(speed[k], 0, 0))))
    return items


def look(tmp_path: Path, items: list[Item], make: Messages) -> tuple[Inspection, VesselConfig, str]:
    """Inspect; the draft must load, and the text and the JSON must be made."""
    path = hold_bag(tmp_path / "run", make, items)
    found = inspect_bag(path)
    text = draft_config(found)
    (tmp_path / "vessel.yaml").write_text(text)
    config = load_config(tmp_path / "vessel.yaml", KINDS)
    assert render(found)
    json.loads(json.dumps(found.as_dict(), allow_nan=False))
    return found, config, text


def test_a_bag_held_in_memory_says_what_its_file_says(tmp_path: Path) -> None:
    """As the tests of `inspect` hold theirs."""
    make = Messages(2)
    mounts = [("base_link", "imu_link", (0.1, 0.0, 0.3), (0, 0, 0, 1))]
    items = [("/tf_static", START_NS, make.transforms(mounts)), *drive(make)]
    items += [("/note", at, make.text("hello")) for _, at, _ in items[::100]]
    sensors = {"imu": {"kind": "imu", "topic": "/imu"}, "gnss": {"kind": "gnss", "topic": "/fix"}}
    config = parse_config({"sensors": sensors}, KINDS, "test")
    paths = (
        write_bag(tmp_path / "a" / "run", make, items, "mcap"),
        hold_bag(tmp_path / "b" / "run", make, sorted(items, key=lambda item: -item[1])),
    )
    file, held = (json.dumps(inspect_bag(path).as_dict()).replace(str(path), "") for path in paths)
    assert file == held
    read = [read_recording(path, config) for path in paths]
    assert read[0].rows == read[1].rows
    assert read[0].message_count == read[1].message_count
    for a, b in zip(read[0].measurements, read[1].measurements, strict=True):
        assert isinstance(a, GnssPosition)
        assert isinstance(b, GnssPosition)
        assert (a.stamp_ns, a.seq, a.position) == (b.stamp_ns, b.seq, b.position)
        np.testing.assert_array_equal(a.cov_enu_m2, b.cov_enu_m2)
    assert read[0].imu is not None
    assert read[1].imu is not None
    np.testing.assert_array_equal(read[0].imu.accel_mps2, read[1].imu.accel_mps2)


def test_longitudes_that_are_none_are_no_places(tmp_path: Path) -> None:
    """The first one became the origin, and PROJ refused it with a traceback."""
    make = Messages(2)
    items = [(topic, at, m) for topic, at, m in drive(make, seconds=20) if topic == "/fix"]
    for k, (_, _, m) in enumerate(items):
        m.longitude = -1012.0 if k % 2 == 0 else m.longitude
    found, _, _ = look(tmp_path, items, make)
    assert found.gnss[0].fixes == len(items) // 2


@pytest.mark.parametrize("upright", [True, False], ids=["upright", "gravity on y"])
@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0, -90.0])
def test_mount_from_gravity_and_motion(tmp_path: Path, yaw_deg: float, upright: bool) -> None:
    make = Messages(2)
    R = rotation_z(yaw_deg) @ (np.eye(3) if upright else ROLL_90)
    found, config, _ = look(tmp_path, drive(make, R), make)
    np.testing.assert_allclose(config.sensors["imu"].mount.R_body_sensor, R, atol=1e-6)
    axis = 2 if upright else 1
    assert found.imus[0].gravity_axis[axis] == pytest.approx(1.0, abs=0.01)


def test_an_imu_that_gravity_says_sits_askew_is_drafted_square_and_said_to_be(tmp_path: Path) -> None:
    """Nothing told of 6 deg, by which an antenna 8 m up is 0.8 m off."""
    R = Rotation.from_euler("xyz", [5.0, -3.0, 0.0], degrees=True).as_matrix()
    _, config, text = look(tmp_path, drive(Messages(2), R), Messages(2))
    assert config.sensors["imu"].mount.rpy_deg == (0.0, 0.0, 0.0)
    assert "+z of the sensor, 6 deg off" in text
    said = json.loads(text[text.index("set [") + 4 :].partition("]")[0] + "]")
    assert said == pytest.approx((5.0, -3.0, 0.0), abs=0.3)


def test_a_whole_draft(tmp_path: Path) -> None:
    make = Messages(2)
    found, config, text = look(tmp_path, drive(make, seconds=60), make)
    imu, gnss, compass = found.imus[0], found.gnss[0], found.compasses[0]
    assert imu.gyro_bias_radps == pytest.approx((0.0, 0.0, 0.004), abs=2e-4)
    assert imu.still_s == pytest.approx(10.0, abs=1.5)
    # 0.02 m/s^2 and 1e-3 rad/s per sample at 25 Hz: times sqrt(0.04 s)
    assert imu.accel_noise_ug == pytest.approx(0.02 * np.sqrt(0.04) / 9.80665e-6, rel=0.1)
    assert imu.gyro_noise_mdps == pytest.approx(np.degrees(1e-3) * np.sqrt(0.04) * 1e3, rel=0.1)
    assert gnss.statuses == {"gbas": 300}
    assert config.sensors["gnss"].slow_error.enabled is None
    assert config.sensors["gnss"].slow_error.horizontal_sigma_m == pytest.approx(0.03)
    assert "good_bound_m" not in text
    assert (compass.usable, compass.convention) == (True, "ned")
    assert config.sensors["compass"].convention == "ned"
    assert config.check_speed_topic == "/wheel/odom"
    assert "pose" not in config.sensors
    assert text.count("# guess:") >= 5
    recording = read_recording(tmp_path / "run", config)
    assert recording.warnings == ()
    headings = recording.of(CompassHeading)
    assert np.degrees(headings[0].yaw_rad) == pytest.approx(np.degrees(0.3), abs=4.0)


def test_scatter_of_the_fixes(tmp_path: Path) -> None:
    """White noise of 0.4 m shows as such, though the craft turns and changes its speed."""
    make = Messages(2)
    found, _, _ = look(tmp_path, drive(make, noise_m=0.4), make)
    assert found.gnss[0].scatter_m == pytest.approx((0.4, 0.4, 0.4), rel=0.15)


def test_wrong_units_are_found(tmp_path: Path) -> None:
    make = Messages(2)
    _, config, text = look(tmp_path, drive(make, accel_scale=1 / 9.80665, gyro_scale=180 / np.pi), make)
    imu = config.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    assert (imu.accel_unit, imu.gyro_unit, imu.gravity) == ("g", "deg/s", "included")
    assert "looks like g" in text
    assert read_recording(tmp_path / "run", config).warnings == ()


@pytest.mark.parametrize("z_down", [False, True], ids=["z up", "z down"])
def test_accelerations_of_the_wrong_sign_are_found(z_down: bool, tmp_path: Path) -> None:
    """Levelled by them, the sensor would lie on its back and turn against the fixes."""
    make = Messages(2)
    R = np.diag([1.0, -1.0, -1.0]) if z_down else np.eye(3)
    _, config, text = look(tmp_path, drive(make, R, accel_scale=-1.0), make)
    imu = config.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    assert imu.gravity == "inverted"
    np.testing.assert_allclose(imu.mount.R_body_sensor, R, atol=1e-6)
    assert "turns against the courses" in text
    assert config.sensors["compass"].convention == "ned"
    series = read_recording(tmp_path / "run", config).imu
    assert series is not None
    np.testing.assert_allclose(np.median(series.accel_mps2, axis=0) @ R.T, (0.0, 0.0, G), atol=0.5)


def test_a_bow_that_comes_round_against_the_course_turns_no_accelerometer(tmp_path: Path) -> None:
    """Coming alongside, she turns by 95 deg to starboard while her course bends by 20 to port: her IMU was drafted on its back."""
    make, items, rng, rate_hz = Messages(2), [], np.random.default_rng(1), 50
    t = np.arange(0.0, 45.0, 1.0 / rate_hz)
    done = np.clip((t - 18.0) / 15.0, 0.0, 1.0)
    done = done**2 * (3.0 - 2.0 * done)
    course, yaw = np.radians(-90.0 + 20.0 * done), np.radians(-90.0 - 95.0 * done)
    velocity = np.interp(t, [0.0, 15.0, 33.0, 45.0], [4.0, 3.0, 0.6, 0.6]) * np.exp(1j * course)
    place = np.cumsum(velocity) / rate_hz
    felt, turns = np.gradient(velocity, t) * np.exp(-1j * yaw), np.gradient(yaw, t)
    noise = 0.3 * rng.normal(size=(len(t), 3))
    lla = DATUM.geodetic_from_enu(np.column_stack([place.real, place.imag, 0.0 * t]) + noise)
    for k in range(len(t)):
        at = START_NS + k * S // rate_hz
        items.append(("/imu", at, make.imu(at, (felt[k].real, felt[k].imag, G), (0.0, 0.0, turns[k]))))
        if k % 10 == 0:
            items.append(("/compass", at, make.compass(at, (0.0, 0.0, np.sin(0.5 * yaw[k]), np.cos(0.5 * yaw[k])))))
            items.append(("/fix", at, make.fix(at, *lla[k])))
    _, config, text = look(tmp_path, items, make)
    imu, compass = config.sensors["imu"], config.sensors["compass"]
    assert isinstance(imu, ImuConfig)
    assert isinstance(compass, CompassConfig)
    assert (imu.gravity, compass.convention) == ("included", "enu")
    np.testing.assert_allclose(imu.mount.R_body_sensor[:, 2], (0.0, 0.0, 1.0), atol=1e-6)
    assert "turns against" not in text


@pytest.mark.parametrize(
    ("accel", "gyro", "gravity", "words"),
    [
        (1.0, 1.0, "included", ""),
        (-1.0, 1.0, "inverted", "accelerations look inverted"),
        (1.0, -1.0, "included", "left-handed"),
    ],
)
def test_wrong_signs_with_a_known_mount(accel: float, gyro: float, gravity: str, words: str, tmp_path: Path) -> None:
    make = Messages(2)
    edges = [("base_link", "imu_link", (0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))]
    items = [*drive(make, accel_scale=accel, gyro_scale=gyro), ("/tf_static", START_NS, make.transforms(edges))]
    found, config, _ = look(tmp_path, items, make)
    imu = config.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    assert imu.gravity == gravity
    assert imu.mount.tf_frame == "imu_link"
    said = " ".join(found.imus[0].why)
    assert words in said
    assert bool(words) == bool(said)


def test_without_gravity_the_turns_tell_up_from_down(tmp_path: Path) -> None:
    make = Messages(2)
    items = drive(make, np.diag([1.0, -1.0, -1.0]))
    for topic, _, message in items:
        if topic == "/imu":
            message.linear_acceleration.z += G
    found, config, _ = look(tmp_path, items, make)
    assert found.imus[0].gravity == "removed"
    np.testing.assert_allclose(config.sensors["imu"].mount.R_body_sensor, np.diag([1.0, -1.0, -1.0]), atol=1e-6)


@pytest.mark.parametrize("upright", [True, False], ids=["upright", "on its back"])
@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0, -90.0])
def test_without_gravity_the_motion_tells_the_yaw(yaw_deg: float, upright: bool, tmp_path: Path) -> None:
    """It was taken as aligned, whatever the motion said, and the heading was a quarter turn off by the draft."""
    make = Messages(2)
    mount = rotation_z(yaw_deg) @ np.diag([1.0, 1.0, 1.0] if upright else [1.0, -1.0, -1.0])
    items = drive(make, mount)
    for topic, _, message in items:
        if topic == "/imu":
            message.linear_acceleration.z -= G if upright else -G
    found, config, _ = look(tmp_path, items, make)
    assert found.imus[0].gravity == "removed"
    np.testing.assert_allclose(config.sensors["imu"].mount.R_body_sensor, mount, atol=1e-6)


@pytest.mark.parametrize("rpy_deg", [(90.0, 0.0, 0.0), (-90.0, 0.0, 90.0), (0.0, 90.0, 0.0), (180.0, 90.0, 0.0)])
def test_without_gravity_the_turns_tell_which_axis_is_up(rpy_deg: tuple[float, float, float], tmp_path: Path) -> None:
    """A phone on a dashboard stands upright: taken as level, the vessel lay on its side, and the heading was 66 deg off."""
    make = Messages(2)
    mount = rotation_from_rpy_deg(np.array(rpy_deg))
    items = drive(make, mount)
    for topic, _, message in items:
        if topic == "/imu":
            a = message.linear_acceleration
            a.x, a.y, a.z = np.array([a.x, a.y, a.z]) - mount.T @ [0.0, 0.0, G]
    found, config, _ = look(tmp_path, items, make)
    assert found.imus[0].gravity == "removed"
    np.testing.assert_allclose(config.sensors["imu"].mount.R_body_sensor, mount, atol=1e-6)


def test_standard_receiver_gets_a_slow_error(tmp_path: Path) -> None:
    make = Messages(2)
    found, config, text = look(tmp_path, drive(make, status=1, sigma_m=1.2), make)
    assert config.sensors["gnss"].slow_error.enabled is None  # on where a second absolute sensor is
    assert "within 4.9 m, and above output.good_bound_m (2.5 m) they are 'degraded'" in text  # 2 m x 2.45
    assert found.gnss[0].reported_sigma_m == pytest.approx((1.2, 1.2, 1.2))
    assert max(found.gnss[0].scatter_m or (1.0,)) < 0.02  # the data are smooth, whatever they claim


@pytest.mark.parametrize(
    ("offset_deg", "scatter_deg", "usable", "mount_deg", "sigma_deg"),
    [
        (90.0, 2.0, True, 90.0, 1.0),
        (98.0, 2.0, True, 90.0, 8.0),
        (40.0, 2.0, True, 40.0, 5.0),
        (25.0, 12.0, True, 25.0, 11.0),  # of a leeway that varies by 12 deg the mean is not known to 5
        (172.0, 2.0, True, 180.0, 8.0),
        (0.0, 60.0, False, 0.0, 0.0),
    ],
)
def test_imu_orientation_as_compass(
    tmp_path: Path, offset_deg: float, scatter_deg: float, usable: bool, mount_deg: float, sigma_deg: float
) -> None:
    """Constant offset to the course: a mount, known as well as a course is a heading. Wide scatter: left out, and said."""
    make = Messages(2)
    rng = np.random.default_rng(0)
    items: list[Item] = []
    for topic, at, m in drive(make, seconds=120):
        if topic == "/compass":
            yaw = np.pi / 2.0 - 2.0 * np.arctan2(m.quaternion.z, m.quaternion.w)
            half = 0.5 * (yaw + np.radians(offset_deg + scatter_deg * rng.normal()))
            q = (0.0, 0.0, np.sin(half), np.cos(half))
            items.append(("/ahrs", at, make.imu(at, (0, 0, G), orientation=q, orientation_covariance=np.zeros(9))))
        else:
            items.append((topic, at, m))
    found, config, text = look(tmp_path, items, make)
    (report,) = found.compasses
    assert report.usable is usable
    if usable:
        compass = config.sensors["compass"]
        assert isinstance(compass, CompassConfig)
        assert report.convention == "enu"
        assert compass.mount.rpy_deg == pytest.approx((0.0, 0.0, mount_deg), abs=1.0)
        assert compass.mount_offset_sigma_deg == pytest.approx(sigma_deg, abs=1.0)
        assert ("unless the vessel goes astern" in text) is (mount_deg == 180.0)
        assert ("drafted as mounted backwards" in render(found)) is (mount_deg == 180.0)
    else:
        assert "compass" not in config.sensors
        assert "orientation of /ahrs: left out as a compass" in text
    assert not config.sensors["imu_2"].enabled


def test_stamps_gaps_and_latency(tmp_path: Path) -> None:
    """10 Hz for 10 s with one hole of 1 s, one repeated, one backward and one zero stamp, 30 ms late."""
    make = Messages(2)
    stamps = [START_NS + k * S // 10 for k in range(100) if not 50 <= k < 59]
    logs = [t + 30_000_000 for t in stamps]
    stamps[20] = stamps[19]
    stamps[30] = stamps[29] - 1
    items = [("/imu", log_ns, make.imu(t)) for t, log_ns in zip(stamps, logs, strict=True)]
    items.append(("/imu", START_NS + 11 * S, make.imu(0)))
    items.append(("/camera", START_NS + 12 * S, ("sensor_msgs/msg/Image", b"\0")))
    found, _, _ = look(tmp_path, items, make)
    imu = next(t for t in found.topics if t.topic == "/imu")
    assert (imu.count, imu.repeated, imu.backward, imu.no_stamp, imu.gaps) == (92, 1, 1, 1, 1)
    assert imu.rate_hz == pytest.approx(10.0)
    assert imu.max_gap_s == pytest.approx(1.0)
    assert imu.span_s == pytest.approx(9.9)
    assert imu.latency_s is not None
    assert imu.latency_s[1] == pytest.approx(0.030)
    camera = next(t for t in found.topics if t.topic == "/camera")
    assert (camera.count, camera.rate_hz) == (1, None)


def test_what_is_nan_is_counted_and_what_has_no_stamp_is_not_late(tmp_path: Path) -> None:
    make = Messages(2)
    items = drive(make)
    nan, still = float("nan"), (0.0, 0.0, G)
    for k in range(3):
        items.append(("/fix", START_NS + (11 + k) * S + 1, make.fix(START_NS + (11 + k) * S + 1, nan, nan, nan)))
    items.append(("/imu", START_NS + 12 * S + 1, make.imu(START_NS + 12 * S + 1, (nan, 0.0, G), still)))
    items += [("/heading", START_NS + k * S // 10, make.t["std_msgs/msg/Float64"](data=0.1)) for k in range(100)]
    found, _, _ = look(tmp_path, items, make)
    assert (found.imus[0].unfinite, found.gnss[0].without_place) == (1, 3)
    text = render(found)
    assert "1 messages hold an acceleration or a rate that is NaN" in text
    assert "3 fixes lie at 0, 0, are NaN" in text
    (line,) = [line for line in text.splitlines() if line.startswith("/heading  ")]
    assert line.split()[-1] == "-"


def test_an_imu_whose_samples_come_out_of_order_is_assessed_in_order(tmp_path: Path) -> None:
    """It had a fifth of its rate, gaps, and half as much noise again: what came late was left out, as if smooth did so."""
    make, rng = Messages(2), np.random.default_rng(2)
    items = drive(make, seconds=20, imu_hz=50)
    mixed = [(topic, at + (int(rng.integers(S // 5)) if topic == "/imu" else 0), m) for topic, at, m in items]
    inspected = [
        look(tmp_path / name, sorted(own, key=lambda item: item[1]), make)[0]
        for name, own in (("in order", items), ("mixed", mixed))
    ]
    whole, imu = (next(t for t in found.topics if t.topic == "/imu") for found in inspected)
    assert (imu.backward or 0) > 300
    assert (imu.gaps, imu.rate_hz, imu.max_gap_s) == (0, whole.rate_hz, whole.max_gap_s)
    assert inspected[1].imus[0].accel_noise_ug == pytest.approx(inspected[0].imus[0].accel_noise_ug, rel=0.02)
    assert inspected[1].imus[0].still_s == pytest.approx(inspected[0].imus[0].still_s, abs=0.1)


def test_the_place_of_a_vessel_that_lies_still_is_no_mount(tmp_path: Path) -> None:
    """Of frames with a namespace the world was taken for the body, and the antenna's lever arm was the way from the world's origin."""
    make, level = Messages(2), (0, 0, 0, 1)
    edges = [
        ("usv/map", "usv/odom", (5, 5, 0), level), ("usv/odom", "usv/hull", (1, 2, 0), level),
        ("usv/hull", "gps", (1, 2, 3), level), ("usv/hull", "imu_link", (0, 0, 1), level),
    ]  # fmt: skip
    items = [*(("/tf", START_NS + k, make.transforms(edges)) for k in range(2)), *drive(make, seconds=10)]
    _, config, _ = look(tmp_path, items, make)
    assert config.body_frame == "usv/hull"
    np.testing.assert_allclose(read_recording(tmp_path / "run", config).mounts["gnss"][0], [1.0, 2.0, 3.0])


def test_an_antenna_of_which_nothing_tells_where_it_sits_is_estimated(tmp_path: Path) -> None:
    """Taken to sit at the IMU, it was 'good' with bounds of 0.1 m, and metres off."""
    make = Messages(2)
    found, config, _ = look(tmp_path, drive(make, seconds=30), make)
    assert config.of_kind("gnss")["gnss"].mount_sigma_m == 1.0
    assert "drafted at 0, 0, 0, and estimated with the run (mount_sigma_m)" in render(found)


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])  # on the latter repeated: static_transform_publisher of ROS 1
def test_tf_static_beats_guessing(topic: str, tmp_path: Path) -> None:
    make = Messages(2)
    half = np.sqrt(0.5)
    edges = [("base_link", "imu_link", (0, 0, 1), (0, 0, half, half)), ("base_link", "gps", (1, 2, 3), (0, 0, 0, 1))]
    repeated = [(topic, START_NS + k, make.transforms(edges)) for k in range(2)]
    items = [*repeated, *drive(make, rotation_z(90.0), seconds=30)]
    found, config, _ = look(tmp_path, items, make)
    assert found.imus[0].mount.tf_frame == config.sensors["imu"].mount.tf_frame == "imu_link"
    recording = read_recording(tmp_path / "run", config)
    np.testing.assert_allclose(recording.mounts["gnss"][0], [1, 2, 3])
    assert config.of_kind("gnss")["gnss"].mount_sigma_m == 0.0
    np.testing.assert_allclose(recording.mounts["imu"][1], rotation_z(90.0), atol=1e-9)


def velocities(make: Messages, axes: str, frame: str = "sensor") -> tuple[list[Item], Array]:
    """Velocities of the antenna of `drive` along some axes, and in its axes of world (N, 3)."""
    fixes = [(topic, at, m) for topic, at, m in drive(make, sigma_m=0.02) if topic == "/fix"]
    places = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for _, _, m in fixes]).T)
    stamps = np.array([m.header.stamp.sec * S + m.header.stamp.nanosec for _, _, m in fixes])
    v, items = np.gradient(places, (stamps - stamps[0]) * 1e-9, axis=0), list[Item]()
    for stamp, (east, north, up) in zip(stamps.tolist(), v, strict=True):
        told = {"enu": (east, north, up), "ned": (north, east, -up), "body": (np.hypot(east, north), 0.0, up)}[axes]
        items.append(("/vel", stamp + 1_000_000, make.twist(stamp, told, frame=frame)))
    return items, v


@pytest.mark.parametrize(("frame", "antenna"), [("gps", "gnss"), ("dvl", "")])
def test_a_velocity_in_the_frame_of_the_fixes_is_of_their_antenna(frame: str, antenna: str, tmp_path: Path) -> None:
    """Another one may be of an INS, that sits elsewhere."""
    make = Messages(2)
    items = [*drive(make), *velocities(make, "enu", frame)[0]]
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    block = config.sensors["gnss_velocity"]
    assert (block.antenna, block.mount_sigma_m) == (antenna, 1.0)


def test_velocities_and_fixes_in_a_frame_of_the_world_tell_no_antenna(tmp_path: Path) -> None:
    make = Messages(2)
    items = [*drive(make), *velocities(make, "enu", "map")[0]]
    for topic, _, m in items:
        if topic == "/fix":
            m.header.frame_id = "map"
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.sensors["gnss_velocity"].antenna == ""


@pytest.mark.parametrize(
    ("axes", "said", "enabled"),
    [("enu", "east, north, up", True), ("ned", "north, east, down", True), ("body", "forward, left, up", False)],
)
def test_axes_of_a_velocity(axes: str, said: str, enabled: bool, tmp_path: Path) -> None:
    """The axes of a velocity are found out by the track; one along the body is another kind of sensor, and off to begin with."""
    make = Messages(2)
    items, v = velocities(make, axes)
    found, config, _ = look(tmp_path, sorted([*drive(make), *items], key=lambda item: item[1]), make)
    assert (found.velocities[0].axes or "").startswith(said)
    assert config.sensors["body_velocity" if axes == "body" else "gnss_velocity"].enabled is enabled
    if enabled:
        recording = read_recording(tmp_path / "run", config)
        read = [m.v_enu_mps for m in recording.of(GnssVelocity)]
        np.testing.assert_allclose(read, v)


def test_the_arrays_of_a_stream_are_made_once_and_anew_after_a_message() -> None:
    stream = TopicData("/vel", TWIST)
    for k in (0, 1, 2):  # without a stamp, the first one is dropped
        stream.add(k * S, k * S + 1, (float(k), 1e13, 0.0), "run")
        assert (len(stream.rows), len(stream.stamps_ns), len(stream.logs_ns)) == (k + 1, k + 1, k + 1)
    stream.settle()
    assert stream.rows is stream.later(S).rows
    np.testing.assert_array_equal(stream.rows, [(1.0, np.nan, 0.0), (2.0, np.nan, 0.0)])
    assert stream.stamps_ns.tolist() == [S, 2 * S]
    assert stream.logs_ns.tolist() == [S + 1, 2 * S + 1]
    assert stream.later(S).stamps_ns.tolist() == [2 * S, 3 * S]
    assert stream.stamped(stream.stamps_ns + 5).stamps_ns.tolist() == [S + 5, 2 * S + 5]
    assert stream.logged(stream.logs_ns + 5).logs_ns.tolist() == [S + 6, 2 * S + 6]


@pytest.mark.parametrize(("scatter_m", "axes"), [(0.8, "east, north, up"), (6.0, None)])
def test_a_velocity_is_judged_without_the_noise_of_the_fixes(scatter_m: float, axes: str | None) -> None:
    """1.5 m/s told exactly, beside fixes once a second: places 0.8 m off make chords of 2 s 0.8 m/s wrong, the velocity not."""
    t, rng = np.arange(300.0), np.random.default_rng(2)
    way = 60.0 * np.column_stack([np.sin(t / 40.0), np.cos(t / 40.0), np.zeros(len(t))])
    stamps = START_NS + (t * S).astype(np.int64)
    stream = TopicData("/vel", TWIST)
    for stamp, velocity in zip(stamps.tolist(), np.gradient(way, 1.0, axis=0).tolist(), strict=True):
        stream.add(stamp, stamp, tuple(velocity), "run.db3")
    told, why = axes_of(stream, ReferenceTrack(stamps, way + rng.normal(0.0, scatter_m, way.shape), scatter_m))
    assert (told or "").startswith(axes or "")
    assert (told is None) == (axes is None), why


@pytest.mark.parametrize("jump_m", [0.0, 15.0])
def test_a_jump_of_the_fixes_hides_no_wheels(jump_m: float) -> None:
    """15 m for 20 s: two chords of 7 m/s, beside 1 m/s, and wheels were taken for a pose whose 'speeds are not along the craft'."""
    t, yaw = np.arange(300.0), 0.05 * np.arange(300.0)
    way = np.cumsum(np.column_stack([np.cos(yaw), np.sin(yaw), 0.0 * t]), axis=0)
    way[(t >= 100.0) & (t < 120.0), :2] += jump_m * np.array([0.6, 0.8])
    stream = TopicData("/odom", TWIST, "link")
    for stamp in (START_NS + (t * S).astype(np.int64)).tolist():
        stream.add(stamp, stamp, (1.0, 0.0, 0.0), "run.db3")
    assert axes_of(stream, ReferenceTrack(stream.stamps_ns, way, 0.1))[0] == BODY_AXES


@pytest.mark.parametrize(
    ("topic", "frame", "axes"),
    [("/dvl/twist", "link", BODY_AXES), ("/vel", "dvl_link", BODY_AXES), ("/vel", "link", None)],
)
def test_without_a_track_names_tell_a_speed_along_the_vessel(topic: str, frame: str, axes: str | None) -> None:
    """Beneath the water there are no fixes: a Doppler log was taken for a velocity to the east and north."""
    stream = TopicData(topic, TWIST, frame)
    for k in range(100):
        stream.add(START_NS + k * S, START_NS + k * S, (1.0 + 0.01 * (k % 7), 0.0, 0.0), "run.db3")
    assert velocity_report(stream, NO_TRACK, None).axes == axes


@pytest.mark.parametrize(
    ("course_deg", "ahead", "axes"),
    [
        (10.0, False, EAST_AXES),
        (190.0, False, EAST_AXES),
        (30.0, True, BODY_AXES),
        (0.0, False, EITHER),
        (0.0, True, EITHER),
    ],
)
def test_a_way_east_tells_a_velocity_to_the_east_from_a_speed_ahead_if_at_all(
    course_deg: float, ahead: bool, axes: str
) -> None:
    """Fixes that wander across the way were no evidence against a speed ahead: a receiver's velocity was taken for one, and left out."""
    t, rng = np.arange(300.0), np.random.default_rng(2)
    speed, course = 8.0 + 2.0 * np.sin(t / 10.0), np.radians(course_deg)
    way = np.cumsum(speed)[:, None] * [np.cos(course), np.sin(course), 0.0]
    wanders = 3.0 * np.column_stack([np.sin(t / 17.0), np.cos(t / 13.0), 0.0 * t])
    stream = TopicData("/vel", TWIST, "base_link")
    for stamp, v in zip((START_NS + (t * S).astype(np.int64)).tolist(), speed.tolist(), strict=True):
        said = (v, 0.0) if ahead else (v * np.cos(course), v * np.sin(course))
        stream.add(stamp, stamp, (*(said + 0.05 * rng.normal(size=2)), 0.0), "run.db3")
    fixes = ReferenceTrack(stream.stamps_ns, way + wanders, 0.1)
    told, why = axes_of(stream, fixes)
    assert told == axes, why
    report = velocity_report(stream, fixes, None)
    assert report.axes == (BODY_AXES if axes == EITHER else axes)
    stream.frame_id = "gps_antenna"
    report = velocity_report(stream, fixes, None)
    assert report.axes == (EAST_AXES if axes == EITHER else axes)


def test_a_log_that_makes_leeway_on_a_way_west_is_no_velocity_to_the_east() -> None:
    """A log of the wrong sign: its speed ahead is that to the east, and its leeway goes with the speed to the north, a third as large."""
    t = np.arange(80.0)
    speed, course = 3.0 + np.sin(t / 8.0), np.radians(190.0)
    leeway = np.radians(3.0)
    way = np.cumsum(speed)[:, None] * [np.cos(course), np.sin(course), 0.0]
    stream = TopicData("/vel", TWIST, "link")
    for stamp, v in zip((START_NS + (t * S).astype(np.int64)).tolist(), speed.tolist(), strict=True):
        stream.add(stamp, stamp, (-v * np.cos(leeway), -v * np.sin(leeway), 0.0), "run.db3")
    told, why = axes_of(stream, ReferenceTrack(stream.stamps_ns, way, 0.01))
    assert told == BODY_AXES, why


@pytest.mark.parametrize(("topic", "knows_east"), [("/ins/odometry", False), ("/odometry", True), ("/odom", False)])
def test_odometry_of_an_ins_is_no_wheels(topic: str, knows_east: bool, tmp_path: Path) -> None:
    """By its name, or as it knows where east is, it holds the fixes already: it was drafted as wheels to switch on."""
    make = Messages(2)
    items = [item for item in drive(make, sigma_m=0.8, status=1, seconds=80)]
    told = [(stamp, m) for name, stamp, m in items if name == "/fix"]
    enu = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for _, m in told]).T)
    for k, (name, stamp, m) in enumerate(items):
        if name == "/wheel/odom":
            p = [float(np.interp(stamp, [at for at, _ in told], enu[:, axis])) for axis in (0, 1)]
            m.pose.pose.position.x, m.pose.pose.position.y = p if knows_east else (p[1], -p[0])
            items[k] = (topic, stamp, m)
    found, config, text = look(tmp_path, items, make)
    fused = topic != "/odom"
    assert found.odometry[0].fused == fused
    assert ("wheels" in config.sensors) == (not fused)
    assert ("an INS's" in text) == fused
    assert config.check_speed_topic == topic


@pytest.mark.parametrize(("noise", "used"), [(1.1, "/imu"), (2.0, "/camera/imu")])
def test_of_imus_about_as_noisy_one_whose_mount_is_known_is_used(noise: float, used: str, tmp_path: Path) -> None:
    """A camera's, of which no tf tells where it sits, was taken where its gyroscope was less noisy by a hundredth."""
    make, rng = Messages(2), np.random.default_rng(5)
    items = [("/tf_static", START_NS, make.transforms([("base_link", "imu_link", (0, 0, 1), (0, 0, 0, 1))]))]
    for k in range(2000):
        stamp, gyro = START_NS + k * S // 50, 1e-3 * rng.normal(size=(2, 3)) * [[noise], [1.0]]
        items.append(("/imu", stamp, make.imu(stamp, (0.0, 0.0, G), gyro[0].tolist(), frame="imu_link")))
        items.append(("/camera/imu", stamp, make.imu(stamp, (0.0, -G, 0.0), gyro[1].tolist(), frame="camera_imu")))
    _, config, _ = look(tmp_path, items, make)
    assert config.sensors["imu"].topic == used
    assert not config.sensors["imu_2"].enabled


@pytest.mark.parametrize("body", ["vessel", "hull"])
def test_body_frame_by_its_name_or_as_the_root(body: str, tmp_path: Path) -> None:
    make = Messages(2)
    edges = [("map", body, (9, 9, 9), (0, 0, 0, 1)), (body, "imu_link", (0, 0, 1), (0, 0, 0, 1))]
    edges += [(body, "gps", (1, 2, 3), (0, 0, 0, 1))]
    if body == "hull":
        edges = edges[1:]
    items = [("/tf_static", START_NS, make.transforms(edges)), *drive(make, seconds=30)]
    _, config, _ = look(tmp_path, items, make)
    assert config.body_frame == body
    np.testing.assert_allclose(read_recording(tmp_path / "run", config).mounts["gnss"][0], [1, 2, 3])


@pytest.mark.parametrize(
    ("axes", "moved_m", "said"),
    [
        (np.eye(3), (700.0, -300.0, -20.0), ""),
        (rotation_z(90.0), (0.0, 0.0, 0.0), "not east-north-up"),
        (NORTH_EAST_DOWN, (0.0, 0.0, 0.0), "looks like north, east, down"),
    ],
    ids=["east, north, up", "turned", "north, east, down"],
)
def test_where_the_frame_of_the_truth_lies(
    axes: Array, moved_m: tuple[float, float, float], said: str, tmp_path: Path
) -> None:
    """Truth in a frame whose origin is not the first fix: the draft's datum is that origin, by geodesy done here."""
    found = not said
    make, items = Messages(2), drive(Messages(2))
    for _, log_ns, fix in [item for item in items if item[0] == "/fix"]:
        enu = DATUM.enu_from_geodetic(*np.array([[fix.latitude], [fix.longitude], [fix.altitude]]))[0]
        stamp = fix.header.stamp.sec * S + fix.header.stamp.nanosec
        items.append(("/truth", log_ns, make.odometry(stamp, axes @ (enu - moved_m))))
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert (config.truth_topic == "/truth") is found
    assert (config.datum is not None) is found
    if config.datum is not None:
        metres_a_degree = np.pi / 180.0 * 6_371_000.0
        at = config.datum.geodetic
        assert (at.latitude_deg - 57.7) * metres_a_degree == pytest.approx(moved_m[1], abs=3.0)
        east = (at.longitude_deg - 11.9) * metres_a_degree * np.cos(np.radians(57.7))
        assert east == pytest.approx(moved_m[0], rel=0.01)
        assert at.height_m == pytest.approx(20.0, abs=0.5)
    else:
        assert said in text


@pytest.mark.parametrize("convention", ["enu", "ned"])
def test_a_moored_compass_is_judged_by_the_gyro(convention: str, tmp_path: Path) -> None:
    """No course to compare with: the heading swings with the gyro, or against it."""
    make, items = Messages(2), []
    for k in range(3000):
        stamp, t = START_NS + k * S // 50, k / 50.0
        yaw, rate = 0.3 + 0.15 * np.sin(0.4 * t), 0.06 * np.cos(0.4 * t)
        items.append(("/imu", stamp, make.imu(stamp, (0.0, 0.0, G), (0.0, 0.0, rate + 0.004))))
        if k % 5 == 0:
            angle = 0.5 * (yaw if convention == "enu" else np.pi / 2.0 - yaw)
            items.append(("/compass", stamp, make.compass(stamp, (0, 0, np.sin(angle), np.cos(angle)))))
    _, config, text = look(tmp_path, items, make)
    assert config.sensors["compass"].convention == convention
    assert config.sensors["compass"].mount_offset_sigma_deg == 10.0  # declination may be in it, and nothing here tells
    assert "from the gyro" in text


def test_a_map_grid_is_no_world(tmp_path: Path) -> None:
    """Truth in UTM, 6400 km north of the equator: no datum is guessed from it."""
    make, items = Messages(2), drive(Messages(2))
    for _, log_ns, fix in [item for item in items if item[0] == "/fix"]:
        enu = DATUM.enu_from_geodetic(*np.array([[fix.latitude], [fix.longitude], [fix.altitude]]))[0]
        stamp = fix.header.stamp.sec * S + fix.header.stamp.nanosec
        items.append(("/truth", log_ns, make.odometry(stamp, (enu[0] + 674_000.0, enu[1] + 6_399_000.0, 40.0))))
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.datum is None
    assert config.truth_topic is None
    assert "looks like a map grid (UTM)" in text


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0])
def test_places_in_a_map_grid_alone_are_fixes_once_the_grid_is_named(yaw_deg: float, tmp_path: Path) -> None:
    """A receiver's driver that publishes UTM and no fix. 57.7 N 11.9 E in zone 32, by Krueger's series to n^4."""
    make = Messages(2)
    driven = drive(make, R_body_sensor=rotation_z(yaw_deg))
    items = [item for item in driven if item[0] in ("/imu", "/compass")]
    for _, log_ns, fix in [item for item in driven if item[0] == "/fix"]:
        enu = DATUM.enu_from_geodetic(*np.array([[fix.latitude], [fix.longitude], [fix.altitude]]))[0]
        stamp = fix.header.stamp.sec * S + fix.header.stamp.nanosec
        items.append(("/gps/odom", log_ns, make.odometry(stamp, (enu[0] + EASTING, enu[1] + NORTHING, 40.0))))
    found, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert not config.of_kind("pose")
    assert not any("nothing in it tells the place" in w for w in found.warnings)
    assert found.imus[0].mount.rpy_deg[2] == yaw_deg
    nowhere = read_recording(tmp_path / "run", config)
    assert any("gnss: none of the 200 messages" in w and "set grid to its name" in w for w in nowhere.warnings)
    (tmp_path / "vessel.yaml").write_text(text.replace("grid: ''", "grid: EPSG:32632"))
    placed = read_recording(tmp_path / "run", load_config(tmp_path / "vessel.yaml", KINDS))
    first = placed.of(GnssPosition)[0]
    assert first.position.latitude_deg == pytest.approx(57.7, abs=1e-8)
    assert first.position.longitude_deg == pytest.approx(11.9, abs=1e-8)
    assert first.position.height_m == 40.0


def test_another_body_is_no_truth(tmp_path: Path) -> None:
    """Odometry of something that all but stays where it is, while the craft drives; and of a pressure sensor, which tells depth alone."""
    make, items = Messages(2), drive(Messages(2))
    for k, (_, log_ns, fix) in enumerate([item for item in items if item[0] == "/fix"]):
        stamp = fix.header.stamp.sec * S + fix.header.stamp.nanosec
        items.append(("/truth/dock", log_ns, make.odometry(stamp, (140.0 + 0.3 * np.sin(0.1 * k), 86.0, 0.0))))
        items.append(("/depth", log_ns, make.odometry(stamp, (0.0, 0.0, -2.0 - np.sin(0.1 * k)))))
    found, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.truth_topic is None
    assert config.datum is None
    assert "# /truth/dock: left out, it moves by" in text
    assert "# /depth: left out, its x and y stay the same while z ranges over 2.0 m" in text
    assert "read it as kind pose with axes: [z]" in text
    assert "/truth/dock: left out" in render(found)
    assert "truth_topic" not in render(found)


def test_the_antenna_is_taken_off_the_datum(tmp_path: Path) -> None:
    """An antenna 30 m aft, known to /tf_static, on a craft that heads one way: the datum must not lie 30 m off."""
    make, aft = Messages(2), (-30.0, 2.0, 8.0)
    half = np.sqrt(0.5)  # heading north: a quarter turn to port from east
    items: list[Item] = [("/tf_static", START_NS, make.transforms([("base_link", "gps", aft, (0, 0, 0, 1))]))]
    R = rotation_z(90.0)
    for k in range(600):
        stamp = START_NS + k * S // 10
        p = (0.0, 0.5 * k, 0.0)
        lla = DATUM.geodetic_from_enu(np.array(p) + R @ np.array(aft))[0]
        cov = (0.0004, 0, 0, 0, 0.0004, 0, 0, 0, 0.001)
        items.append(("/fix", stamp, make.fix(stamp, lla[0], lla[1], lla[2], status=2, covariance=cov)))
        items.append(("/truth", stamp, make.odometry(stamp, p, (0, 0, half, half))))
    _, config, _ = look(tmp_path, items, make)
    assert config.datum is not None
    away = DATUM.enu_from_geodetic(*np.array(config.datum.geodetic)[:, None])[0]
    assert np.linalg.norm(away) < 0.3


def test_a_plain_velocity_tells_the_yaw_of_the_imu(tmp_path: Path) -> None:
    """`TwistStamped`, as NMEA drivers write it, and no wheels: the mount is found by it."""
    make = Messages(2)
    items = [item for item in drive(make, rotation_z(90.0)) if item[0] != "/wheel/odom"]
    fixes = [m for topic, _, m in items if topic == "/fix"]
    places = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for m in fixes]).T)
    stamps = np.array([m.header.stamp.sec * S + m.header.stamp.nanosec for m in fixes])
    v = np.gradient(places, (stamps - stamps[0]) * 1e-9, axis=0)
    plain = make.t["geometry_msgs/msg/TwistStamped"]
    for stamp, speed in zip(stamps.tolist(), v, strict=True):
        twist = make.t["geometry_msgs/msg/Twist"](linear=make.vector(speed), angular=make.vector((0, 0, 0)))
        items.append(("/vel", stamp + 1_000_000, plain(header=make.header(stamp), twist=twist)))
    found, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert found.imus[0].mount.rpy_deg == pytest.approx((0.0, 0.0, 90.0), abs=0.5)
    assert config.sensors["gnss_velocity"].enabled
    recording = read_recording(tmp_path / "run", config)
    told = [m.v_enu_mps for m in recording.of(GnssVelocity)]
    np.testing.assert_allclose(told, v)


def test_a_clock_ahead_gets_an_offset(tmp_path: Path) -> None:
    """GPS time in the header, 37 s ahead, recorded at the right time."""
    make, items = Messages(2), []
    for topic, log_ns, message in drive(make, seconds=30):
        if topic == "/fix":
            message.header.stamp.sec += 37
        items.append((topic, log_ns, message))
    _, config, _ = look(tmp_path, items, make)
    assert config.sensors["gnss"].time_offset_s == pytest.approx(-37.0, abs=0.1)


@pytest.mark.parametrize("fault", ["jumps", "frozen"])
def test_fixes_that_err_for_a_while_leave_no_compass_out(fault: str, tmp_path: Path) -> None:
    """15 m off now and then, or a quarter of the run at one place: most courses still tell what the compass is."""
    make, held = Messages(2), None
    items = drive(make, seconds=120, noise_m=0.5)
    for topic, log_ns, message in items:
        t = (log_ns - START_NS) / S
        if topic == "/fix":
            if fault == "jumps" and t % 12.0 > 8.0:
                message.latitude += 15.0 / 111e3
            elif fault == "frozen" and 50.0 < t < 80.0:
                held = held or message
                message.latitude, message.longitude = held.latitude, held.longitude
    found, config, _ = look(tmp_path, items, make)
    (compass,) = found.compasses
    assert compass.usable
    assert abs(compass.offset_deg or 0.0) < 5.0
    assert "compass" in config.sensors


@pytest.mark.parametrize(
    ("topic", "behind_s"), [("/fix", -18), ("/fix", -3600), ("/imu", START_NS // S - 100)], ids=["leap", "zone", "boot"]
)
def test_sensors_on_other_clocks_are_judged_by_each_other(topic: str, behind_s: int, tmp_path: Path) -> None:
    """Without wheels: fixes tell the yaw of the IMU, and whether a compass is one, as on the same clock."""
    make, items = Messages(2), []
    for name, log_ns, message in drive(make, rotation_z(90.0), seconds=120):
        if name == topic:
            message.header.stamp.sec -= behind_s
        if name != "/wheel/odom":
            items.append((name, log_ns, message))
    found, config, _ = look(tmp_path, items, make)
    assert found.imus[0].mount.rpy_deg == pytest.approx((0.0, 0.0, 90.0), abs=0.5)
    (compass,) = found.compasses
    assert (compass.usable, compass.convention) == (True, "ned")
    assert compass.samples > 100
    offset_s = behind_s if topic == "/fix" else -behind_s
    gnss, imu = (config.sensors[name].time_offset_s for name in ("gnss", "imu"))
    assert gnss - imu == pytest.approx(offset_s, abs=0.1)
    (said,) = [line for line in render(found).splitlines() if "its clock is" in line]
    assert said.startswith(f"{topic}: its clock is {abs(behind_s)}.0 s {'ahead of' if behind_s < 0 else 'behind'} ")
    assert ("GPS time" in said) == (behind_s == -18)


@pytest.mark.parametrize("astern_s", [30, 120])
def test_a_compass_of_a_craft_that_goes_ahead_and_astern_is_mounted_as_is_likelier(
    astern_s: int, tmp_path: Path
) -> None:
    """Half of the time astern, it was 'a relative or a disturbed heading', or mounted backwards; astern throughout, only the craft tells."""
    make, items = Messages(2), []
    for name, at, m in drive(make, seconds=120):
        since_s = (at - START_NS) / S
        if name == "/compass" and (since_s - 12.0) % 80.0 < astern_s:
            m = make.compass(
                at, (Rotation.from_rotvec([0.0, 0.0, np.pi]) * Rotation.from_quat(xyzw(m))).as_quat().tolist()
            )
        if name != "/wheel/odom" and (name != "/compass" or since_s % 30.0 > 10.0):
            items.append((name, at, m))
    found, config, _ = look(tmp_path, items, make)
    (compass,) = found.compasses
    assert compass.usable
    assert compass.backwards == (astern_s == 120)
    assert ("of them astern" in compass.why) == (astern_s == 30)
    assert compass.scatter_deg is not None
    assert compass.scatter_deg < 5.0
    assert abs(config.sensors["compass"].mount.rpy_deg[2]) == (180.0 if astern_s == 120 else 0.0)


def xyzw(m: Any) -> tuple[float, float, float, float]:
    return m.quaternion.x, m.quaternion.y, m.quaternion.z, m.quaternion.w


@pytest.mark.parametrize("topic", ["/mag", "/gps/heading"])
@pytest.mark.parametrize("swing_deg", [0.0, 6.0])
def test_a_compass_is_drafted_as_far_as_it_wanders(topic: str, swing_deg: float, tmp_path: Path) -> None:
    """One that swings to and fro in 80 s was drafted as good to half a degree; what wanders so far is no receiver's, whatever its name."""
    make = Messages(2)
    items: list[Item] = []
    for name, at, m in drive(make, seconds=150):
        if name == "/compass":
            error = np.radians(swing_deg) * np.sin(2.0 * np.pi * (at - START_NS) / (80 * S))
            half = np.arctan2(m.quaternion.z, m.quaternion.w) + error / 2.0
            items.append((topic, at, make.compass(at, (0, 0, np.sin(half), np.cos(half)))))
        else:
            items.append((name, at, m))
    _, config, text = look(tmp_path, items, make)
    compass = config.sensors["compass"]
    assert isinstance(compass, CompassConfig)
    gnss = topic == "/gps/heading" and not swing_deg
    assert compass.deviation_sigma_deg == (0.0 if gnss else 1.5)
    assert ("as it wanders beside the gyro" in text) is (swing_deg > 0.0)
    if swing_deg:
        assert 2.0 < compass.wander_sigma_deg < 8.0
    else:
        assert compass.wander_sigma_deg == (0.2 if gnss else 0.5)


@pytest.mark.parametrize(
    ("covariance", "place", "alone"), [(False, "none", True), (True, "none", True), (False, "moves", False)]
)
def test_poses_that_stay_at_one_place_while_they_turn_are_a_heading(
    covariance: bool, place: str, alone: bool, tmp_path: Path
) -> None:
    """The heading of two antennas, sent as a PoseStamped, was left out as 'not a pose of this vessel'."""
    make = Messages(2)
    items: list[Item] = []
    for name, at, m in drive(make, seconds=60):
        if name == "/compass":
            q, east = m.quaternion, (at - START_NS) / S if place == "moves" else 0.0
            cov = np.diag([0.0] * 5 + [1e-4]).ravel() if covariance else None
            items.append(("/gps/heading", at, make.pose(at, (east, 0, 0), (q.x, q.y, q.z, q.w), cov)))
        else:
            items.append((name, at, m))
    _, config, text = look(tmp_path, items, make)
    assert ("compass" in config.sensors) is alone
    if alone:
        assert "left out" not in text
        compass = config.sensors["compass"]
        assert isinstance(compass, CompassConfig)
        assert (compass.topic, compass.convention) == ("/gps/heading", "ned")
        recording = read_recording(tmp_path / "run", config)
        said = recording.of(CompassHeading)
        assert len(said) > 100
        assert {round(float(np.degrees(m.sigma_rad)), 2) for m in said} == {0.57 if covariance else compass.sigma_deg}


@pytest.mark.parametrize("iron_deg", [0.0, 12.0])
def test_a_compass_is_drafted_with_the_deviation_that_the_gyroscope_shows(iron_deg: float, tmp_path: Path) -> None:
    """12 deg x sin(heading) was drafted as 1.5 deg; online the heading was then 16 deg off while it stated 8."""
    make = Messages(2)
    items: list[Item] = []
    for name, at, m in drive(make, seconds=240):
        if name == "/compass":
            half = np.arctan2(m.quaternion.z, m.quaternion.w)
            half += np.radians(iron_deg) * np.cos(2.0 * half) / 2.0
            items.append((name, at, make.compass(at, (0, 0, np.sin(half), np.cos(half)))))
        else:
            items.append((name, at, m))
    _, config, text = look(tmp_path, items, make)
    compass = config.sensors["compass"]
    assert isinstance(compass, CompassConfig)
    assert ("varies with the heading beside the gyro" in text) is (iron_deg > 0.0)
    assert compass.deviation_sigma_deg == pytest.approx(iron_deg / np.sqrt(2.0) or 1.5, abs=1.0 if iron_deg else 0.0)


@pytest.mark.parametrize(("moves", "usable"), [(True, True), (False, False)])
def test_a_heading_receiver_that_publishes_an_imu_message_is_not_frozen(
    moves: bool, usable: bool, tmp_path: Path
) -> None:
    """Two antennas: their driver fills the orientation of an Imu alone. It was a compass, and nothing of it could be used."""
    make = Messages(2)
    items: list[Item] = []
    for topic, at, m in drive(make, seconds=120 if moves else 10):
        if topic == "/compass":
            yaw = np.pi / 2.0 - 2.0 * np.arctan2(m.quaternion.z, m.quaternion.w)
            q = (0.0, 0.0, np.sin(yaw / 2.0), np.cos(yaw / 2.0))
            items.append(("/heading", at, make.imu(at, (0, 0, 0), orientation=q, orientation_covariance=np.zeros(9))))
        else:
            items.append((topic, at, m))
    found, config, _ = look(tmp_path, items, make)
    assert ("compass" in config.sensors) is usable
    if usable:
        compass = config.sensors["compass"]
        assert isinstance(compass, CompassConfig)
        # Iron does nothing to two antennas, and a receiver knows how good it is.
        assert (compass.deviation_sigma_deg, compass.wander_sigma_deg, compass.use_reported_sigma) == (0.0, 0.2, True)
    said = [w for w in found.warnings if w.startswith("/heading")]
    assert not any("frozen" in w for w in said)
    assert len(said) == (0 if usable else 1)
    assert all("neither accelerations nor rates" in w for w in said)


@pytest.mark.parametrize(
    ("status", "lat", "said"),
    [(-1, 0.0, "say 'no fix'"), (0, 0.0, "lie at 0, 0"), (0, 57.7e7, "have a latitude beyond 90 deg")],
)
def test_topics_that_give_nothing_are_reported(status: int, lat: float, said: str, tmp_path: Path) -> None:
    make = Messages(2)
    items: list[Item] = [
        ("/fix", START_NS + k * S, make.fix(START_NS + k * S, lat, 0.0, status=status)) for k in range(20)
    ]
    found, config, _ = look(tmp_path, items, make)
    assert "gnss" not in config.sensors
    assert any("/fix" in w and said in w for w in found.warnings)
    assert "nothing of its 20 messages" in render(found)


@pytest.mark.parametrize(
    ("step", "said"), [(1e-6, True), (0.0, False)], ids=["a driver without status", "the last place known"]
)
def test_places_that_change_without_a_fix_are_told_of(step: float, said: bool, tmp_path: Path) -> None:
    make = Messages(2)
    at = [START_NS + k * S for k in range(20)]
    items: list[Item] = [
        ("/fix", t, make.fix(t, 57.7 + step * k, 11.9 - step * k, status=-1)) for k, t in enumerate(at)
    ]
    found, _, _ = look(tmp_path, items, make)
    assert (
        any("20 say 'no fix', though their places change: " in w and "`min_status: any`" in w for w in found.warnings)
        is said
    )


def test_a_bag_that_no_sensor_can_be_made_of_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It ended well, with a vessel.yaml that has no sensors; what NaN was counted as was left to guess."""
    make = Messages(2)
    nan = (float("nan"),) * 3
    items: list[Item] = []
    for k in range(30):
        at = START_NS + k * S
        items += [("/imu", at, make.imu(at, nan)), ("/fix", at, make.fix(0, status=-1)), ("/note", at, make.text("a"))]
    where, draft = write_bag(tmp_path / "run", make, items, "mcap"), tmp_path / "vessel.yaml"
    assert called(monkeypatch, "inspect", where, "-o", draft) == 2
    assert not draft.exists()
    (line,) = capsys.readouterr().err.splitlines()
    assert "no usable sensor in it" in line
    assert "/imu: nothing of its 30 messages can be used: 30 hold an acceleration or a rate that is NaN" in line
    assert "/fix: nothing of its 30 messages can be used: 30 say 'no fix'" in line


def test_a_receiver_without_a_message_and_damaged_transforms_are_reported(tmp_path: Path) -> None:
    make = Messages(2)
    with Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/fix", make.fix(START_NS).__msgtype__, typestore=make.store)
        static = writer.add_connection("/tf_static", "tf2_msgs/msg/TFMessage", typestore=make.store)
        whole = make.transforms([("base_link", "gps", (1, 2, 0), (0, 0, 0, 1))])
        for data in (b"\1", make.store.serialize_cdr(whole, whole.__msgtype__)):
            writer.write(static, START_NS, data)
    found = inspect_bag(tmp_path / "run")
    assert found.tf_frames == ("base_link", "gps")
    assert "/tf_static: messages that cannot be decoded: 1" in found.warnings
    assert any(w == "/fix: not a message on it" for w in found.warnings)


@pytest.mark.parametrize("frame", ["map grid", "earth-centred", "north, east, down"])
def test_an_ins_that_tells_its_speed_is_no_wheels(frame: str, tmp_path: Path) -> None:
    """In UTM without a fix it is the receiver, and then checks no speed, which `smooth` refused; otherwise it is none."""
    make = Messages(2)
    driven = drive(make)
    items = [item for item in driven if item[0] in ("/imu", "/compass") or (item[0] == "/fix" and frame != "map grid")]
    rolled = [(at_ns, m.twist.twist.linear.x) for topic, at_ns, m in driven if topic == "/wheel/odom"]
    at_ns, speeds = (np.array(v, dtype=float) for v in zip(*rolled, strict=True))
    for _, log_ns, fix in [item for item in driven if item[0] == "/fix"]:
        lla = np.array([fix.latitude]), np.array([fix.longitude]), np.array([fix.altitude])
        enu = DATUM.enu_from_geodetic(*lla)[0]
        off_m = {"map grid": (EASTING, NORTHING, 0.0), "earth-centred": (3.3e6, 0.7e6, 5.4e6)}.get(
            frame, (0.0, 0.0, 0.0)
        )
        place_m = enu[[1, 0, 2]] * (1.0, 1.0, -1.0) if frame == "north, east, down" else enu + off_m
        stamp = fix.header.stamp.sec * S + fix.header.stamp.nanosec
        v = (float(np.interp(stamp, at_ns, speeds)), 0.0, 0.0)
        items.append(("/applanix/pose", log_ns, make.odometry(stamp, place_m.tolist(), v=v)))
    found, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    (item,) = found.odometry
    assert item.fused
    assert (
        f"its frame is {'a map grid' if frame == 'map grid' else frame}, which wheel odometry cannot know" in item.why
    )
    assert "wheels" not in config.sensors
    assert "truth_topic if" not in text  # compared as east, north, up, it would be off by as much as its frame
    if frame == "map grid":
        assert "as an INS or a filter does" in text
        assert "not fused" not in text
        (tmp_path / "vessel.yaml").write_text(text.replace("grid: ''", "grid: EPSG:32632"))
        assert (
            len(read_recording(tmp_path / "run", load_config(tmp_path / "vessel.yaml", KINDS)).of(GnssPosition)) > 100
        )


def oriented(driven: list[Item], R_ahead_sensor: Array) -> list[Item]:
    """Return the fixes and the IMU of a drive, which tells its own orientation, turned so from axes ahead, to port, up."""
    headings = [(at, m.quaternion) for topic, at, m in driven if topic == "/compass"]
    stamps = np.array([at for at, _ in headings])
    yaws = np.pi / 2.0 - np.unwrap([2.0 * np.arctan2(q.z, q.w) for _, q in headings])  # of headings from north
    items = [item for item in driven if item[0] in ("/fix", "/imu")]
    for _, at, m in (item for item in items if item[0] == "/imu"):
        yaw = Rotation.from_euler("z", float(np.interp(at, stamps, yaws))).as_matrix()
        q = m.orientation
        q.x, q.y, q.z, q.w = Rotation.from_matrix(yaw @ R_ahead_sensor).as_quat().tolist()
        m.orientation_covariance = np.array([0.01, *m.orientation_covariance[1:]])
    return sorted(items, key=lambda item: item[1])


def test_an_imu_far_askew_may_be_a_craft_that_lists(tmp_path: Path) -> None:
    """Gravity alone tells no list from a tilt: a list of 12 deg made the heading 4 deg off, and its bound was 2."""
    pitched = Rotation.from_euler("y", -45.0, degrees=True)
    listing = Rotation.from_euler("x", 12.0, degrees=True)
    _, config, text = look(tmp_path, drive(Messages(2), (listing * pitched).as_matrix()), Messages(2))
    imu = config.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    off = Rotation.from_matrix(imu.mount.R_body_sensor @ pitched.as_matrix().T).as_euler(
        "zyx"
    )  # of the level that craft has
    roll, pitch, yaw = imu.mount_sigma_rad
    assert abs(off[2]) < 3.0 * roll
    assert pitch == roll
    assert abs(off[0]) < 3.0 * yaw
    assert yaw >= roll * np.tan(np.radians(22.5))
    assert "if the craft listed" in text


@pytest.mark.parametrize(("tilt_deg", "yaw_deg"), [(-45.0, 90.0), (-70.0, 0.0)])
def test_an_orientation_whose_x_axis_is_tilted_has_the_mount_of_its_imu(
    tilt_deg: float, yaw_deg: float, tmp_path: Path
) -> None:
    """A roll r turns an x axis that is tilted by p by r tan(p): with a yaw alone as the mount, headings were 9 deg off."""
    R = rotation_z(yaw_deg) @ Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix()
    items = oriented(drive(Messages(2), R, seconds=120), np.eye(3))
    start_ns, level = items[0][1], {}
    for _, at, m in (item for item in items if item[0] == "/imu"):
        q, a, w = m.orientation, m.linear_acceleration, m.angular_velocity
        level[at] = yaw = Rotation.from_quat([q.x, q.y, q.z, q.w])
        angle, rate = 0.15 * np.sin((at - start_ns) / S), 0.15 * np.cos((at - start_ns) / S)
        roll = Rotation.from_rotvec([angle, 0.0, 0.0])
        a.x, a.y, a.z = R.T @ roll.inv().apply(R @ [a.x, a.y, a.z])
        w.x, w.y, w.z = R.T @ (np.array([rate, 0.0, 0.0]) + roll.inv().apply(R @ [w.x, w.y, w.z]))
        q.x, q.y, q.z, q.w = (yaw * roll * Rotation.from_matrix(R)).as_quat().tolist()
    _, config, _ = look(tmp_path, items, Messages(2))
    imu, compass = config.sensors["imu"], config.sensors["compass"]
    np.testing.assert_allclose(imu.mount.R_body_sensor, R, atol=0.02)
    np.testing.assert_allclose(compass.mount.R_body_sensor, R, atol=0.02)
    recording = read_recording(tmp_path / "run", config)
    assert not [line for line in recording.warnings if "headings differ" in line]
    off = []
    for m in recording.of(CompassHeading)[::10]:
        angle = 0.15 * np.sin((m.stamp_ns - start_ns) / S)
        x = (level[m.stamp_ns] * Rotation.from_rotvec([angle, 0.0, 0.0])).apply(compass.mount.R_body_sensor[:, 0])
        off.append(np.arctan2(x[1], x[0]) - m.yaw_rad)
    assert np.degrees(np.abs((np.array(off) + np.pi) % (2.0 * np.pi) - np.pi)).max() < 4.0


@pytest.mark.parametrize("turned", [True, False], ids=["half a turn", "a quarter turn"])
def test_an_imu_that_no_motion_turns_is_turned_as_its_own_heading(turned: bool, tmp_path: Path) -> None:
    """Hand-held, by a gait that hides what turns feel like: taken as ahead, the solved heading was 177 deg off."""
    make, rng = Messages(2), np.random.default_rng(2)
    items = oriented(drive(make, R_body_sensor=rotation_z(180.0)), rotation_z(180.0 if turned else 90.0))
    for m in (m for topic, _, m in items if topic == "/imu"):
        m.linear_acceleration.x, m.linear_acceleration.y = rng.normal(size=2)
    found, config, text = look(tmp_path, items, make)
    assert "does not show its yaw" in found.imus[0].mount.evidence
    assert config.sensors["imu"].mount.rpy_deg == (0.0, 0.0, 180.0 if turned else 0.0)
    assert ("as its orientation is" in text) is turned


def test_an_imu_whose_motion_hints_at_its_mount_is_not_turned_by_its_own_heading(tmp_path: Path) -> None:
    """Ahead, as what it feels says in spite of an engine, and its heading is half a turn off: it was turned, and the heading with it."""
    make, rng = Messages(2), np.random.default_rng(2)
    items = oriented(drive(make), rotation_z(180.0))
    for m in (m for topic, _, m in items if topic == "/imu"):
        felt, shaken = m.linear_acceleration, rng.normal(0.0, 8.0, 2)
        felt.x, felt.y = felt.x + shaken[0], felt.y + shaken[1]
    found, config, _ = look(tmp_path, items, make)
    assert "but not clearly" in found.imus[0].mount.evidence
    assert config.sensors["imu"].mount.rpy_deg[2] == 0.0


def test_fixes_in_rad_are_named(tmp_path: Path) -> None:
    """A converter that forgot the unit: a track of metres, which nothing said."""
    make, items = Messages(2), []
    for topic, at, m in drive(make):
        if topic == "/fix":
            m.latitude, m.longitude = float(np.radians(m.latitude)), float(np.radians(m.longitude))
        items.append((topic, at, m))
    found, config, _ = look(tmp_path, items, make)
    (line,) = (w for w in found.warnings if "writes rad (57.7" in w)
    assert line.startswith("/fix: all fixes lie near 1.0070")
    assert any("gnss: all fixes lie near" in w for w in read_recording(tmp_path / "run", config).warnings)
    for origin in ((0.0, 0.0), (1.2, 5.0), (57.7, 0.3)):  # a simulator, Sao Tome, Norfolk Sea
        assert radians_warning("gnss", np.array([[*origin, 0.0]])) == []


def test_an_imu_whose_y_is_down_looks_along_z_where_nothing_tells(tmp_path: Path) -> None:
    """The axes of a camera: taken with x ahead, the heading was a quarter turn off."""
    make = Messages(2)
    items = [item for item in drive(make, R_body_sensor=CAMERA) if item[0] == "/imu"]
    _, config, text = look(tmp_path, items, make)
    assert config.sensors["imu"].mount.rpy_deg == (-90.0, 0.0, -90.0)
    assert "as in a camera's axes" in text


@pytest.mark.parametrize("astern", [False, True], ids=["x ahead", "x astern"])
def test_an_imu_on_its_side_whose_heading_tells_its_x_is_no_camera(astern: bool, tmp_path: Path) -> None:
    """Its y is down as in a camera's axes; drafted so, the heading was a quarter turn off, though its own orientation told where x is."""
    make, rng = Messages(2), np.random.default_rng(2)
    mount = rotation_z(180.0 if astern else 0.0) @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    items = oriented(drive(make, R_body_sensor=mount), mount)
    for m in (m for topic, _, m in items if topic == "/imu"):
        m.linear_acceleration.x, m.linear_acceleration.z = rng.normal(size=2)
    found, config, _ = look(tmp_path, items, make)
    assert "does not show its yaw" in found.imus[0].mount.evidence
    np.testing.assert_allclose(config.sensors["imu"].mount.R_body_sensor, mount, atol=1e-6)


def test_truth_poses_and_empty_bags(tmp_path: Path) -> None:
    make = Messages(2)
    items: list[Item] = []
    for k in range(30):
        t = START_NS + k * S // 10
        items.append(("/ground_truth/odom", t, make.odometry(t, v=(1, 0, 0))))
        items.append(("/match", t, make.pose(t, (1, 2, 3))))
    _, config, text = look(tmp_path, items, make)
    assert config.truth_topic is None  # no fix says where its frame lies
    assert config.check_speed_topic is None
    assert not config.sensors["pose"].enabled
    (tmp_path / "vessel.yaml").write_text(text.replace("  # slow_error:", "  slow_error:"))
    assert load_config(tmp_path / "vessel.yaml", KINDS).sensors["pose"].slow_error.sigma_m > 0.0
    (tmp_path / "b").mkdir()
    _, config, text = look(tmp_path / "b", [("/note", START_NS, make.text("hello"))], make)
    assert config.sensors == {}
    assert "nothing in this bag" in text
    assert any("no message of a known type" in w for w in inspect_bag(tmp_path / "b" / "run").warnings)
    assert "the bag holds no message at all" in inspect_bag(hold_bag(tmp_path / "none", make, [])).warnings


@pytest.mark.skipif(not HUSKY.exists(), reason="the Husky recording is not here")
def test_husky(tmp_path: Path) -> None:
    """The mount that was established by hand: roll 90, pitch 0, yaw -90 deg, gravity on +y."""
    found = inspect_bag(HUSKY)
    (tmp_path / "vessel.yaml").write_text(draft_config(found))
    config = load_config(tmp_path / "vessel.yaml", KINDS)
    imu = found.imus[0]
    assert config.sensors["imu"].mount.rpy_deg == (90.0, 0.0, -90.0)
    assert imu.gravity_axis[1] > 0.99
    assert imu.still_s == pytest.approx(336 / 30, abs=2.0)
    assert max(np.abs(imu.gyro_bias_radps or (1.0,))) < 4e-4
    assert found.gnss[0].statuses == {"sbas": 989}
    assert found.gnss[0].height_range_m > 30.0
    assert config.check_speed_topic == "/husky_velocity_controller/odom"
    receiver, wheels = config.sensors["gnss"], config.sensors["wheels"]
    assert isinstance(wheels, BodyVelocityConfig)
    assert wheels.axes == ("x", "y")
    assert isinstance(receiver, GnssConfig)
    # Against the wheels the fixes go back by 2 m at 54 s, and 5 m to the side from 30 to 40 s.
    assert 10.0 < receiver.slow_error.time_constant_s < 80.0
    assert "compass" not in config.sensors  # its yaw drifts by tens of degrees against the course
    recording = read_recording(HUSKY, config)
    assert recording.message_count == 11865 + 989 + 3952


def test_clouds_are_read_until_their_frame_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not to the end for a topic that has none, nor for one that cannot be decoded."""
    make, kind = Messages(2), "sensor_msgs/msg/PointCloud2"
    types = make.store.types
    clouds = {
        frame: types[kind](
            header=make.header(START_NS, frame), height=1, width=0, fields=[], is_bigendian=False, point_step=12,
            row_step=0, data=np.zeros(0, np.uint8), is_dense=True,
        )
        for frame in ("bow", "late")
    }  # fmt: skip
    with Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        bow, late, broken, _ = (
            writer.add_connection(topic, kind, typestore=make.store)
            for topic in ("/bow", "/late", "/broken", "/silent")
        )
        for k in range(300):
            writer.write(bow, START_NS + k, make.store.serialize_cdr(clouds["bow"], kind))
            writer.write(broken, START_NS + k, b"junk")
        writer.write(late, START_NS + 300, make.store.serialize_cdr(clouds["late"], kind))
    read: Counter[str] = Counter()
    messages = Bag.messages

    def spy(self: Bag, topics: Collection[str]) -> Iterator[RawMessage]:
        for raw in messages(self, topics):
            read[raw.topic] += 1
            yield raw

    monkeypatch.setattr(Bag, "messages", spy)
    found = inspect_bag(tmp_path / "run")
    assert [(x.topic, x.frame_id) for x in found.lidars] == [("/bow", "bow"), ("/late", "late")]
    assert read == {"/bow": 1, "/late": 1, "/broken": 200}
