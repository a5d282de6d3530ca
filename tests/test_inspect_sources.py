# SPDX-License-Identifier: Apache-2.0
"""`inspect` on bags of drivers that say much: what is a velocity, whose output a filter's is, what says the same twice."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import factors
from graphloc.config import (
    AerialConfig,
    CompassConfig,
    GnssConfig,
    ImuConfig,
    VelocityConfig,
    VesselConfig,
    load_config,
    parse_config,
)
from graphloc.errors import InputError, SolveError
from graphloc.frames import Array
from graphloc.frontends.inspect import Inspection, draft_config, render
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition
from graphloc.replay import replay
from tests.bagfactory import START_NS, Item, Messages, S
from tests.heldbags import hold_bag, inspect_bag, read_recording
from tests.makers import said
from tests.test_bag import KINDS
from tests.test_inspect import DATUM, ROLL_90, G, drive, look, rotation_z

WAVE_S, WAVE_RAD = 3.0, 0.03


def boat(make: Messages, yaw_deg: float, scatter_m: float = 0.3) -> list[Item]:
    """At 1.2 m/s in waves, turning to and fro; an IMU at 25 Hz turned by `yaw_deg`, fixes at 5 Hz that scatter by `scatter_m`.

    Waves of 0.03 rad put 0.3 m/s^2 of gravity into the horizontal accelerations; the turns are worth 0.12 m/s^2.
    """
    rng, dt = np.random.default_rng(3), 0.02
    t = np.arange(0.0, 200.0, dt)
    rate = 0.1 * np.sin(2.0 * np.pi * t / 40.0)
    yaw = 0.1 * 40.0 / (2.0 * np.pi) * (1.0 - np.cos(2.0 * np.pi * t / 40.0))
    way = np.cumsum(1.2 * np.exp(1j * yaw)) * dt
    phase = 2.0 * np.pi * t / WAVE_S
    accel = np.column_stack(
        [-9.81 * WAVE_RAD * np.sin(phase + 1.0), 1.2 * rate + 9.81 * WAVE_RAD * np.sin(phase), 0 * t]
    )
    gyro = np.column_stack([0 * t, 0 * t, rate])
    accel += np.array([0.0, 0.0, 9.81]) + rng.normal(0, 0.02, accel.shape)
    gyro += rng.normal(0, 1e-3, gyro.shape)
    places = np.column_stack([way.real, way.imag, 0 * t]) + scatter_m * rng.normal(size=(len(t), 3))
    lla, R = DATUM.geodetic_from_enu(places), rotation_z(yaw_deg)
    items: list[Item] = []
    for k in range(len(t)):
        stamp = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", stamp, make.imu(stamp, R.T @ accel[k], R.T @ gyro[k])))
        if k % 10 == 0:
            items.append(("/fix", stamp, make.fix(stamp, *lla[k])))
    return items


def test_a_second_in_which_a_rolling_vessel_turns_back_is_no_standstill(tmp_path: Path) -> None:
    """What she turned then was taken for the gyroscope's bias, and off the turns by which compasses are judged."""
    make = Messages(2)
    t = np.arange(0.0, 60.0, 0.02)
    roll = 0.05 * np.sin(2.0 * np.pi * t / 5.0)  # rad/s
    items: list[Item] = []
    for k, rate in enumerate(roll.tolist()):
        at = START_NS + k * S // 50
        items.append(("/imu", at, make.imu(at, (0.01 * (k % 3), 0.0, 9.81), (rate, 0.0, 0.01))))
    items.append(("/fix", items[-1][1], make.fix(items[-1][1])))
    found, _, _ = look(tmp_path, items, make)
    assert found.imus[0].still_s == 0.0
    assert found.imus[0].gyro_bias_radps is None


def test_the_second_between_ahead_and_astern_is_no_standstill(tmp_path: Path) -> None:
    """Of two quiet seconds and more the part without speed was left, and what she turned in it was the gyroscope's bias."""
    make, items = Messages(2), []
    t = np.arange(0.0, 60.0, 0.02)
    speed, yaw = 3.03 - 0.1 * t, 0.01 * t
    way = np.cumsum(speed * np.exp(1j * yaw)) * 0.02
    lla = DATUM.geodetic_from_enu(np.column_stack([way.real, way.imag, 0.0 * t]))
    for k in range(len(t)):
        at = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", at, make.imu(at, (-0.1, speed[k] * 0.01, G), (0.001 * (k % 3), 0.0, 0.01))))
        if k % 10 == 0:
            items.append(("/fix", at, make.fix(at, *lla[k])))
            items.append(("/wheel/odom", at, make.odometry(at, v=(speed[k], 0, 0))))
    found, _, _ = look(tmp_path, items, make)
    assert found.imus[0].still_s == 0.0
    assert found.imus[0].gyro_bias_radps is None


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0, -90.0])
def test_fixes_of_a_slow_craft_in_waves_tell_the_yaw_of_its_imu(yaw_deg: float, tmp_path: Path) -> None:
    found, _, _ = look(tmp_path, boat(Messages(2), yaw_deg), Messages(2))
    mount = found.imus[0].mount
    assert "yaw by the motion of /fix" in mount.evidence
    assert abs((mount.rpy_deg[2] - yaw_deg + 180.0) % 360.0 - 180.0) < 0.5


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, -25.0])
def test_a_tilted_imu_on_its_head_looks_ahead_where_no_motion_tells(tilt_deg: float, tmp_path: Path) -> None:
    """As one that is not tilted does; levelled the shortest way, its x was drafted astern."""
    make = Messages(2)
    R = Rotation.from_euler("yx", [tilt_deg, 180.0], degrees=True).as_matrix()
    at = [START_NS + k * S // 50 for k in range(500)]
    items: list[Item] = [
        ("/imu", ns, make.imu(ns, (R.T @ [0.01 * (k % 3), 0.0, 9.81]).tolist())) for k, ns in enumerate(at)
    ]
    items.append(("/fix", at[-1], make.fix(at[-1])))
    _, config, _ = look(tmp_path, items, make)
    np.testing.assert_allclose(config.sensors["imu"].mount.R_body_sensor, R, atol=0.01)


def test_floats_beside_rtk_do_not_hide_the_yaw_of_an_imu(tmp_path: Path) -> None:
    """They wander by metres, as they claim; 0 was drafted of an IMU that looks astern."""
    rng, make = np.random.default_rng(5), Messages(2)
    items = boat(make, 180.0, 0.02)
    fixes = [m for topic, _, m in items if topic == "/fix"]
    wander = np.cumsum(rng.normal(size=(len(fixes), 2)), axis=0) * 2e-5
    for k, m in enumerate(fixes):
        off = wander[k] if k > 0.7 * len(fixes) else (0.0, 0.0)
        m.latitude, m.longitude = m.latitude + off[0], m.longitude + off[1]
        m.position_covariance = np.diag([4.0 if k > 0.7 * len(fixes) else 4e-4] * 3).ravel()
    found, _, _ = look(tmp_path, items, make)
    assert found.imus[0].mount.rpy_deg[2] == pytest.approx(180.0, abs=0.5)


@pytest.mark.parametrize(("seconds", "yaw_deg"), [(60, 0.0), (90, 90.0), (200, 90.0)])
def test_a_yaw_that_is_likely_but_not_clear_is_drafted_by_the_quarter_turn(
    seconds: int, yaw_deg: float, tmp_path: Path
) -> None:
    """Of runs of a minute or so 0 was drafted, and the heading was 90 deg off beside a compass that was right."""
    items = [item for item in boat(Messages(2), 90.0) if item[1] < START_NS + seconds * S]
    found, _, _ = look(tmp_path, items, Messages(2))
    mount = found.imus[0].mount
    assert mount.rpy_deg[2] == yaw_deg
    assert ("not clearly" in mount.evidence) == (seconds == 90)


def test_an_imu_that_sits_askew_is_not_taken_for_straight(tmp_path: Path) -> None:
    """It was snapped to a quarter turn, and 40 deg were lost."""
    found, _, _ = look(tmp_path, drive(Messages(2), rotation_z(40.0)), Messages(2))
    assert found.imus[0].mount.rpy_deg == pytest.approx((0.0, 0.0, 40.0), abs=2.0)


def swaying(make: Messages, yaw_deg: float, sway_m: float) -> list[Item]:
    """At 4 m/s, turning to and fro; waves pitch her while they move her aside, which turns what short windows see of an IMU's yaw."""
    t = np.arange(0.0, 240.0, 0.02)
    turned, wave = 0.6 * np.sin(2.0 * np.pi * t / 60.0), np.sin(2.0 * np.pi * t / 5.0)
    ahead = np.exp(1j * turned)
    way = np.cumsum(4.0 * ahead) * 0.02 + 1j * sway_m * wave * ahead
    felt = np.gradient(np.gradient(way, t), t) / ahead + 9.81 * np.radians(7.0 * sway_m) * wave
    rate, R = np.gradient(turned, t), rotation_z(yaw_deg)
    lla = DATUM.geodetic_from_enu(np.column_stack([way.real, way.imag, 0.0 * t]))
    items: list[Item] = []
    for k in range(len(t)):
        stamp = START_NS + k * S // 50
        accel = R.T @ [felt[k].real, felt[k].imag, 9.81]
        if k % 2 == 0:
            items.append(("/imu", stamp, make.imu(stamp, accel, R.T @ [0.0, 0.0, rate[k]])))
        if k % 10 == 0:
            items.append(("/fix", stamp, make.fix(stamp, *lla[k])))
    return items


@pytest.mark.parametrize(("yaw_deg", "sway_m"), [(40.0, 0.05), (40.0, 0.1), (90.0, 0.05)])
def test_a_yaw_by_the_motion_is_drafted_as_well_as_waves_let_it_be_known(
    yaw_deg: float, sway_m: float, tmp_path: Path
) -> None:
    """3 deg off, the heading left bounds that allowed for 1."""
    make = Messages(2)
    _, config, _ = look(tmp_path, swaying(make, yaw_deg, sway_m), make)
    imu = config.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    off_deg = abs(imu.mount.rpy_deg[2] - yaw_deg)
    if yaw_deg == 90.0:  # a quarter turn is exact
        assert off_deg == 0.0
        assert np.degrees(imu.mount_sigma_rad[2]) < 3.0
    else:
        assert 2.0 < off_deg < 2.0 * np.degrees(imu.mount_sigma_rad[2])
        assert np.degrees(imu.mount_sigma_rad[:2]) == pytest.approx(1.0)


def test_a_yaw_that_windows_of_other_lengths_have_elsewhere_is_not_clear(tmp_path: Path) -> None:
    """It was drafted as -24 deg, and of a vessel that drifted broadside as -44."""
    make = Messages(2)
    found, _, _ = look(tmp_path, swaying(make, 0.0, 0.2), make)
    mount = found.imus[0].mount
    assert mount.rpy_deg[2] == 0.0
    assert "not clearly" in mount.evidence


def crossing(make: Messages, legs_s: float) -> list[Item]:
    """At 2.5 to 3.5 m/s, set by 1.5 m/s to port whichever way she goes, which is every `legs_s` the other way; a true compass."""
    rng, t = np.random.default_rng(1), np.arange(0.0, 240.0, 0.02)
    yaw = 0.3 + 0.1 * np.sin(t / 6.0) + np.pi / 2.0 * (1.0 + np.tanh((t % (2.0 * legs_s) - legs_s) / 3.0))
    over = (3.0 + 0.5 * np.sin(t / 3.0) + 1.5j) * np.exp(1j * yaw)
    felt, rate = np.gradient(over, t) * np.exp(-1j * yaw), np.gradient(yaw, t)
    way = np.cumsum(over) * 0.02
    lla = DATUM.geodetic_from_enu(np.column_stack([way.real, way.imag, 0.0 * t]))
    accel = np.column_stack([felt.real, felt.imag, 9.81 + 0.0 * t]) + 0.05 * rng.normal(size=(len(t), 3))
    items: list[Item] = []
    for k in range(len(t)):
        stamp = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", stamp, make.imu(stamp, accel[k], (0.0, 0.0, rate[k]))))
        if k % 10 == 0:
            items.append(("/fix", stamp, make.fix(stamp, *lla[k])))
            items.append(
                ("/heading", stamp, make.compass(stamp, (0.0, 0.0, np.sin(yaw[k] / 2.0), np.cos(yaw[k] / 2.0))))
            )
    return items


def test_a_course_that_goes_one_way_tells_no_angle_of_imu_or_compass(tmp_path: Path) -> None:
    """In a current across, course and heading differ by 27 deg all along: taken for the mounts of both, it made the heading as wrong, at a bound of 12.

    To and fro, no current does that: then both do sit askew.
    """
    # 230 s: she turns at the end, and goes the other way for 10 s of 240.
    for legs_s, set_sideways in ((1e3, True), (230.0, True), (60.0, False)):
        _, config, text = look(tmp_path / f"{legs_s:.0f}", crossing(Messages(2), legs_s), Messages(2))
        imu, compass = config.sensors["imu"], config.sensors["compass"]
        assert isinstance(imu, ImuConfig)
        assert isinstance(compass, CompassConfig)
        yaw_deg = 0.0 if set_sideways else -27.0
        assert imu.mount.rpy_deg[2] == pytest.approx(yaw_deg, abs=2.0)
        assert compass.mount.rpy_deg[2] == pytest.approx(yaw_deg, abs=2.0)
        assert ("she goes one way, so leeway or a current may set her by that" in text) == set_sideways
        if set_sideways:  # what no course tells is in the bounds
            assert 1.96 * np.degrees(imu.mount_sigma_rad[2]) > 27.0
            assert 1.96 * compass.mount_offset_sigma_deg > 27.0
        else:
            assert np.degrees(imu.mount_sigma_rad[2]) < 5.0


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0])
@pytest.mark.parametrize("drifts", [True, False], ids=["then drifts", "often sideways"])
def test_where_headings_explain_what_the_imu_feels_better_than_courses_she_is_set_sideways(
    drifts: bool, yaw_deg: float, tmp_path: Path
) -> None:
    """In a current across, and later with it, a ferry's IMU and compass seemed 30 deg askew, and the heading was as wrong, called good."""
    make, rng, t = Messages(2), np.random.default_rng(1), np.arange(0.0, 240.0, 0.02)
    speed = np.where(t < 170.0, 3.0, 0.6) if drifts else 1.5 + 1.5 * np.sin(t / 11.0)
    yaw = 0.3 + 0.15 * np.sin(t / 6.0) + (0.0 if drifts else 1.0) * np.sin(t / 25.0)
    over = (speed + 0.5 * np.sin(t / 3.0)) * np.exp(1j * yaw) + 1.5j * np.exp(0.3j)
    felt, rate = np.gradient(over, t) * np.exp(-1j * (yaw + np.radians(yaw_deg))), np.gradient(yaw, t)
    way = np.cumsum(over) * 0.02
    lla = DATUM.geodetic_from_enu(np.column_stack([way.real, way.imag, 0.0 * t]))
    accel = np.column_stack([felt.real, felt.imag, 9.81 + 0.0 * t]) + 0.05 * rng.normal(size=(len(t), 3))
    items: list[Item] = []
    for k in range(len(t)):
        stamp = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", stamp, make.imu(stamp, accel[k], (0.0, 0.0, rate[k]))))
        if k % 10 == 0:
            items.append(("/fix", stamp, make.fix(stamp, *lla[k])))
            items.append(
                ("/heading", stamp, make.compass(stamp, (0.0, 0.0, np.sin(yaw[k] / 2.0), np.cos(yaw[k] / 2.0))))
            )
    _, config, text = look(tmp_path, items, make)
    imu, compass = config.sensors["imu"], config.sensors["compass"]
    assert isinstance(imu, ImuConfig)
    assert isinstance(compass, CompassConfig)
    assert imu.mount.rpy_deg[2] == pytest.approx(yaw_deg)
    assert compass.mount.rpy_deg[2] == 0.0
    assert compass.mount_offset_sigma_deg >= 10.0
    assert imu.mount_sigma_deg == ImuConfig().mount_sigma_deg
    assert "she is set sideways" in text


@pytest.mark.parametrize(("yaw_deg", "said"), [(0.0, False), (-84.0, True)])
def test_an_imu_that_sits_a_little_askew_is_said(yaw_deg: float, said: bool, tmp_path: Path) -> None:
    """Drafted as a quarter turn, since leeway would look alike, in bounds that hold both: the heading was off by the rest, and no bound included it."""
    make = Messages(2)
    _, config, text = look(tmp_path, drive(make, rotation_z(yaw_deg), seconds=90), make)
    imu = config.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    assert imu.mount.rpy_deg[2] == pytest.approx(90.0 * round(yaw_deg / 90.0))
    assert ("where she is not set sideways, as on wheels, set -84" in text) == said
    if said:
        assert 1.96 * np.degrees(imu.mount_sigma_rad[2]) > 6.0
    else:
        assert imu.mount_sigma_deg == ImuConfig().mount_sigma_deg


@pytest.mark.parametrize(("pitch_deg", "wide"), [(1.0, False), (8.0, True)])
def test_an_imu_that_is_tilted_a_little_is_in_the_bounds(pitch_deg: float, wide: bool, tmp_path: Path) -> None:
    """Drafted level, since the craft may be trimmed as much: roll and pitch were off by that, in bounds of 2 deg."""
    make, c, s = Messages(2), np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    _, config, text = look(tmp_path, drive(make, np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])), make)
    imu = config.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    assert imu.mount.rpy_deg == (0.0, 0.0, 0.0)
    sigmas_deg = np.degrees(imu.mount_sigma_rad)
    assert (1.96 * sigmas_deg[:2] > pitch_deg).all()
    assert (sigmas_deg[0] > 2.0) == wide == ("if the sensor is tilted in the craft" in text)
    assert sigmas_deg[2] == pytest.approx(1.0)


@pytest.mark.parametrize("yaw_deg", [40.0, 180.0])
def test_a_mount_in_tf_static_that_the_motion_denies_is_reported(yaw_deg: float, tmp_path: Path) -> None:
    make = Messages(2)
    transforms = make.transforms([("base_link", "imu_link", (0, 0, 0), (0, 0, 0, 1))])
    items = [("/tf_static", START_NS, transforms), *drive(make, rotation_z(yaw_deg))]
    found, _, text = look(tmp_path, items, make)
    assert found.imus[0].mount.tf_frame == "imu_link"
    assert "but what it feels fits how /wheel/odom moves only turned by " in text


AXES = {"a quarter turn": rotation_z(90.0), "upside down": np.diag([1.0, -1.0, -1.0]), "on its side": ROLL_90}


@pytest.mark.parametrize("axes", AXES)
def test_axes_that_tf_static_does_not_know_are_drafted_as_measured(axes: str, tmp_path: Path) -> None:
    """A driver that publishes in axes of its own, under the frame of the URDF: as drafted, the heading was off by a quarter turn."""
    make = Messages(2)
    transforms = make.transforms([("base_link", "imu_link", (0.3, 0.1, 0.4), (0, 0, 0, 1))])
    _, config, text = look(tmp_path, [("/tf_static", START_NS, transforms), *drive(make, AXES[axes])], make)
    mount = config.sensors["imu"].mount
    assert mount.tf_frame is None
    np.testing.assert_allclose(mount.R_body_sensor, AXES[axes], atol=0.02)
    assert mount.xyz_m == (0.3, 0.1, 0.4)
    assert "guess: not as in tf" in text


@pytest.mark.parametrize(("height_m", "above_m"), [(-0.7, 0.7), (0.7, None)])
@pytest.mark.parametrize("base", [True, False])
def test_antennas_in_a_tf_that_looks_down_are_drafted_above(
    height_m: float, above_m: float | None, base: bool, tmp_path: Path
) -> None:
    """An INS's own axes as the body's: an antenna half a metre to port was drafted to starboard and below, and the track 1 m off."""
    make = Messages(2)
    edges = [("imu_link", "gps", (-0.8, -0.5, height_m), (0, 0, 0, 1))]
    edges += [("base_link", "imu_link", (0.2, 0.1, -0.3), (0, 0, 0, 1))] if base else []
    items = [("/tf_static", START_NS, make.transforms(edges)), *drive(make, AXES["upside down"])]
    fixes = [(at, m) for topic, at, m in items if topic == "/fix"]
    ins = [make.fix(at, m.latitude, m.longitude, m.altitude, frame="imu_link") for at, m in fixes]
    items += [("/ekf/fix", at, m) for (at, _), m in zip(fixes, ins, strict=True)]
    _, config, text = look(tmp_path, items, make)
    gnss, imu = config.sensors["gnss"].mount, config.sensors["imu"].mount
    np.testing.assert_allclose(imu.R_body_sensor, AXES["upside down"], atol=0.02)
    if above_m is None:  # axes of the driver, under the frame of a URDF
        assert gnss.tf_frame == "gps"
        assert imu.xyz_m == ((0.2, 0.1, -0.3) if base else (0.0, 0.0, 0.0))
    else:
        assert gnss.xyz_m == pytest.approx((-0.6, 0.4, 1.0) if base else (-0.8, 0.5, 0.7))
        assert imu.xyz_m == pytest.approx((0.2, -0.1, 0.3) if base else (0.0, 0.0, 0.0))
        assert "whose body looks ahead, to starboard, down" in text


@pytest.mark.parametrize("turned_deg", [0.0, 90.0, -90.0])
def test_a_mount_that_the_fixes_deny_is_reported_when_a_bag_is_read(turned_deg: float, tmp_path: Path) -> None:
    """A compass that tells the right heading leaves the course right: nothing else was said, and the track was metres off."""
    make = Messages(2)
    path = hold_bag(tmp_path / "run", make, drive(make, rotation_z(90.0 + turned_deg), status=0, sigma_m=1.0))
    sensors = {
        "imu": {"kind": "imu", "topic": "/imu", "mount": {"rpy_deg": [0, 0, 90]}},
        "gnss": {"kind": "gnss", "topic": "/fix"},
        "compass": {"kind": "compass", "topic": "/compass", "convention": "ned"},
    }
    said = [
        w
        for w in read_recording(path, parse_config({"sensors": sensors}, KINDS, "test")).warnings
        if "what it feels" in w
    ]
    assert len(said) == (turned_deg != 0.0)
    right = ("0",) if turned_deg < 0.0 else ("180", "-180")  # and not -0
    assert all(any(f"mount.rpy_deg of sensors.imu would be {deg} deg" in w for deg in right) for w in said)


def beside(make: Messages, told: Callable[[int, Array, float], list[tuple[str, Any]]]) -> list[Item]:
    """`drive` without wheels, its IMU turned by 90 deg, and what `told` says at each fix of stamp, velocity in ENU and yaw."""
    items = [item for item in drive(make, rotation_z(90.0)) if item[0] != "/wheel/odom"]
    fixes = [m for topic, _, m in items if topic == "/fix"]
    places = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for m in fixes]).T)
    stamps = np.array([m.header.stamp.sec * S + m.header.stamp.nanosec for m in fixes])
    v = np.gradient(places, (stamps - stamps[0]) * 1e-9, axis=0)
    yaw = np.unwrap(np.arctan2(v[:, 1], v[:, 0]))
    for stamp, speed, angle in zip(stamps.tolist(), v, yaw.tolist(), strict=True):
        items += [(topic, stamp + 1_000_000, m) for topic, m in told(stamp, speed, angle)]
    return sorted(items, key=lambda item: item[1])


def vector(make: Messages, stamp: int, xyz: Any) -> Any:
    return make.t["geometry_msgs/msg/Vector3Stamped"](header=make.header(stamp), vector=make.vector(xyz))


def plain_twist(make: Messages, stamp: int, v: Any) -> Any:
    twist = make.t["geometry_msgs/msg/Twist"](linear=make.vector(v), angular=make.vector((0, 0, 0)))
    return make.t["geometry_msgs/msg/TwistStamped"](header=make.header(stamp), twist=twist)


def seen(
    tmp_path: Path, told: Callable[[Messages, int, Array, float], list[tuple[str, Any]]]
) -> tuple[Inspection, VesselConfig, str]:
    make = Messages(2)
    return look(tmp_path, beside(make, lambda *what: told(make, *what)), make)


def test_a_vector_that_is_no_velocity_is_neither_fused_nor_the_motion(tmp_path: Path) -> None:
    """Drivers of Xsens and of the UM7 say magnetic field, angles and more as `Vector3Stamped`."""

    def told(make: Messages, stamp: int, v: Array, yaw: float) -> list[tuple[str, Any]]:
        field = 2.0 * np.array([np.cos(1.0 - yaw), np.sin(1.0 - yaw), 0.0])
        return [("/imu/mag", vector(make, stamp, field)), ("/velocity", vector(make, stamp, v))]

    found, config, text = seen(tmp_path, told)
    assert found.imus[0].mount.rpy_deg == pytest.approx((0.0, 0.0, 90.0), abs=0.5)
    assert [s.topic for s in config.of_kind("gnss_velocity").values()] == ["/velocity"]
    assert config.sensors["gnss_velocity"].enabled
    assert "# /imu/mag: left out" in text


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("topic", ["/wheel/odom", "/vehicle/twist"])
def test_wheels_that_go_astern_throughout_do_not_turn_the_imu(topic: str, sign: float, tmp_path: Path) -> None:
    """A wrong sign of the driver: by it the IMU was drafted backwards, and the heading was off by 180 deg."""
    make, items = Messages(2), []
    for name, at, m in drive(Messages(2), rotation_z(90.0)):
        if name == "/wheel/odom":
            m.twist.twist.linear.x *= sign
        wheels = name == "/wheel/odom" and topic == "/vehicle/twist"
        said = plain_twist(make, at, (m.twist.twist.linear.x, 0.0, 0.0)) if wheels else m
        items.append((topic if wheels else name, at, said))
    found, config, text = look(tmp_path, items, make)
    assert f"yaw by the motion of {topic}" in found.imus[0].mount.evidence
    assert found.imus[0].mount.rpy_deg == pytest.approx((0.0, 0.0, 90.0), abs=0.5)
    assert ("goes astern nearly all the time" in text) == (sign < 0.0)
    (along,) = [sensor for sensor in config.sensors.values() if sensor.kind == "body_velocity"]
    axes = ("x", "y") if topic == "/wheel/odom" else ("x",)
    assert (along.topic, along.axes, along.enabled) == (topic, axes, False)
    assert along.mount.rpy_deg[2] == (0.0 if sign > 0.0 else 180.0)


def test_a_vector_that_nothing_tells_to_be_a_velocity_is_not_fused(tmp_path: Path) -> None:
    make = Messages(2)
    items = [item for item in drive(make, seconds=9) if item[0] != "/wheel/odom"]  # at rest
    items += [("/imu/mag", at, vector(make, at, (0.3, 0.1, -0.8))) for topic, at, _ in items if topic == "/fix"]
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert not config.sensors["gnss_velocity"].enabled


def test_a_filter_is_no_receiver_and_counts_no_second_time(tmp_path: Path) -> None:
    """MAVROS: what the autopilot's filter makes of receiver and IMU comes more often, and its velocity beside the receiver's."""

    make = Messages(2)

    def told(stamp: int, v: Array, yaw: float) -> list[tuple[str, Any]]:
        return [
            (topic, plain_twist(make, stamp, v))
            for topic in ("/mavros/local_position/velocity_local", "/mavros/raw/gps_vel")
        ]

    items = beside(make, told)
    often = []
    for topic, at, m in items:
        if topic == "/fix":
            for more in (0, 50_000_000):
                later = make.fix(at + more, m.latitude, m.longitude, m.altitude)
                often.append(("/mavros/global_position/global", at + more, later))
    _, config, text = look(tmp_path, sorted([*items, *often], key=lambda item: item[1]), make)
    used = {s.topic for s in config.sensors.values() if s.enabled and s.kind in ("gnss", "gnss_velocity")}
    assert used == {"/fix", "/mavros/raw/gps_vel"}
    assert "a filter's output" in text


def test_odometry_in_east_and_north_is_no_speed_along_the_craft(tmp_path: Path) -> None:
    """MAVROS `global_position/local`: its twist is that of the world, whatever nav_msgs says."""

    def told(make: Messages, stamp: int, v: Array, yaw: float) -> list[tuple[str, Any]]:
        return [("/local", make.odometry(stamp, v=v.tolist()))]

    found, config, _ = seen(tmp_path, told)
    assert found.odometry[0].role == "other"  # no pose either: it says 0, 0 throughout
    assert config.check_speed_topic is None
    assert found.imus[0].mount.rpy_deg == pytest.approx((0.0, 0.0, 90.0), abs=0.5)


def test_wheels_check_the_speed_rather_than_a_filter_that_had_the_fixes(tmp_path: Path) -> None:
    """`/ekf/odometry_map` comes before `/wheel/odom` by its name, and was said to look like wheel odometry."""
    make = Messages(2)
    items = drive(make)
    items += [("/ekf/odometry_map", at, m) for topic, at, m in items if topic == "/wheel/odom"]
    found, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.check_speed_topic == "/wheel/odom"
    why = {item.topic: item.why for item in found.odometry}
    assert "looks like wheel odometry" in why["/wheel/odom"]
    assert "a filter's output" in why["/ekf/odometry_map"]
    text = render(found)
    assert not config.sensors["wheels"].enabled
    assert "/wheel/odom: drafted as check_speed_topic, and as a sensor that is switched off" in text
    assert text.count("switched off") == 1  # what holds the fixes already is none to switch on


@pytest.mark.parametrize(("noise_deg", "both"), [(0.0, False), (1.0, True)], ids=["the same", "another device"])
def test_a_heading_that_is_reported_twice_counts_once(noise_deg: float, both: bool, tmp_path: Path) -> None:
    """MAVROS says its heading in `imu/data` and, clockwise from north and without a stamp, in `compass_hdg`."""
    rng = np.random.default_rng(1)

    def told(make: Messages, stamp: int, v: Array, yaw: float) -> list[tuple[str, Any]]:
        own = yaw + np.radians(noise_deg) * rng.normal()
        heading = make.t["std_msgs/msg/Float64"](data=float((90.0 - np.degrees(own)) % 360.0))
        attitude = make.compass(stamp, (0.0, 0.0, np.sin(yaw / 2.0), np.cos(yaw / 2.0)))
        return [("/attitude", attitude), ("/hdg", heading)]

    _, config, text = seen(tmp_path, told)
    used = {s.topic for s in config.of_kind("compass").values() if s.enabled}
    assert used == {"/compass", "/attitude", *(["/hdg"] if both else [])}
    assert ("it repeats /attitude" in text) is not both


@pytest.mark.parametrize("late_s", [0.07, 0.3])
def test_a_heading_that_is_reported_twice_counts_once_however_late(late_s: float, tmp_path: Path) -> None:
    """`compass_hdg` has no stamp, and its recording time is late: in a turn it seemed another device's by some degrees."""
    make = Messages(2)
    rng = np.random.default_rng(1)
    items: list[Item] = []
    for item in drive(make, seconds=60):
        items.append(item)
        if item[0] == "/compass":
            q = item[2].quaternion
            heading = float(np.degrees(2.0 * np.arctan2(q.z, q.w)) % 360.0)  # of `drive`: clockwise from north
            at = item[1] + round((late_s + 0.004 * abs(rng.normal())) * S)
            items.append(("/hdg", at, make.t["std_msgs/msg/Float64"](data=heading)))
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert {s.topic for s in config.of_kind("compass").values() if s.enabled} == {"/compass"}
    assert "it repeats /compass" in text


@pytest.mark.parametrize("late_s", [0.4, 1.0])
@pytest.mark.parametrize("own_clock_s", [0.0, 3600.0], ids=["one clock", "a clock of its own"])
def test_a_late_compass_is_drafted_with_its_time_offset(late_s: float, own_clock_s: float, tmp_path: Path) -> None:
    """It was said in a comment only, and as drafted the heading was wrong by what the craft turned meanwhile."""
    make = Messages(2)
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 90.0, 0.02)
    rate = 0.25 * np.sin(0.5 * t) + 0.15 * np.sin(1.3 * t)
    yaw = np.concatenate([[0.0], np.cumsum(rate[:-1]) * 0.02])
    way = np.cumsum(3.0 * np.exp(1j * yaw)) * 0.02
    lla = DATUM.geodetic_from_enu(np.column_stack([way.real, way.imag, 0 * t]))
    items: list[Item] = []
    for k in range(len(t)):
        at = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", at, make.imu(at, (0.0, 3.0 * rate[k], G), (0.0, 0.0, rate[k] + 1e-3 * rng.normal()))))
        if k % 10 == 0:
            half = 0.5 * (yaw[k] + np.radians(0.5) * rng.normal())
            late = at + round(late_s * S)
            compass = make.compass(late - round(own_clock_s * S), (0.0, 0.0, np.sin(half), np.cos(half)))
            items += [("/fix", at, make.fix(at, *lla[k])), ("/compass", late, compass)]
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    compass = config.sensors["compass"]
    assert compass.time_offset_s == pytest.approx(own_clock_s - late_s, abs=0.02)
    assert "its turns fit the gyro's" in text
    # Late, it seemed to wander by degrees.
    assert compass.wander_sigma_deg == CompassConfig().wander_sigma_deg


def two_receivers(
    make: Messages, error_m: Callable[[Array, Array], Array], *, claims_m: float, height: bool
) -> list[Item]:
    """`drive` with fixes that scatter by 0.3 m and claim 1 m, and another receiver's, off by `error_m`, (N, 3) of times and yaws (N,)."""
    items, rng = drive(make, status=0, sigma_m=1.0, seconds=120, noise_m=0.3), np.random.default_rng(4)
    fixes = [(at, m) for topic, at, m in items if topic == "/fix"]
    yaw = np.pi / 2.0 - np.array(
        [2.0 * np.arctan2(m.quaternion.z, m.quaternion.w) for t, _, m in items if t == "/compass"]
    )
    t = np.array([(at - START_NS) / S for at, _ in fixes])
    places = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for _, m in fixes]).T)
    lla = DATUM.geodetic_from_enu(places + error_m(t, yaw) + 0.3 * rng.normal(size=places.shape))
    for (at, _), (lat, lon, up) in zip(fixes, lla, strict=True):
        cov = (claims_m**2 * np.eye(3)).ravel()
        items.append(("/cheap/fix", at, make.fix(at, lat, lon, up if height else np.nan, 0, cov)))
    return sorted(items, key=lambda item: item[1])


def drift(t: Array, _yaw: Array) -> Array:
    """Of 4 m, 1 sigma of a horizontal axis, that changes within 20 s; 8 m in height."""
    rng, keep = np.random.default_rng(6), np.exp(-float(t[1] - t[0]) / 20.0)
    error = np.zeros((len(t), 3))
    for k in range(1, len(t)):
        error[k] = keep * error[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal(size=3)
    return np.asarray(error / error.std(axis=0) * [4.0, 4.0, 8.0])


def test_the_fix_of_a_base_ashore_is_not_the_vessels(tmp_path: Path) -> None:
    """Of a centimetre, and that of the vessel of 0.3 m: it was taken for the receiver, its antenna for 55 m off the mount, and the vessel stood still."""
    make = Messages(2)
    items = drive(make, status=0, sigma_m=0.5, seconds=60, noise_m=0.3)
    for k in range(60):
        at = START_NS + k * S
        items.append(
            ("/base/fix", at, make.fix(at, 58.001, 11.002, 44.0 + 1e-4 * (k % 7), 2, 1e-4 * np.eye(3).ravel()))
        )
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert [s.topic for s in config.of_kind("gnss").values() if s.enabled] == ["/fix"]
    assert {s.mount_sigma_m for s in config.of_kind("gnss").values()} == {1.0}
    assert "a base station ashore" in text


def test_a_receiver_of_which_single_fixes_are_wrong_is_this_crafts(tmp_path: Path) -> None:
    """Each 30th is 3 km off: the IMU felt nothing of how it moved, so it was of another craft, and a receiver of metres was used."""
    make = Messages(2)
    items = drive(make, status=2, sigma_m=0.01, seconds=60)
    cheap = [m for topic, _, m in drive(make, status=0, sigma_m=0.5, seconds=60, noise_m=0.3) if topic == "/fix"]
    own = [(at, m) for topic, at, m in items if topic == "/fix"]
    items += [("/cheap/fix", at, m) for (at, _), m in zip(own, cheap, strict=True)]
    for _, m in own[15::30]:
        m.latitude += 0.027
    found, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert "of another craft" not in text
    assert f"{len(own[15::30])} fixes lie so far off the others that no craft goes there" in render(found)
    assert [s.topic for s in config.of_kind("gnss").values() if s.enabled] == ["/fix"]


@pytest.mark.parametrize("moored", [False, True])
def test_the_receiver_of_another_craft_is_not_the_vessels(moored: bool, tmp_path: Path) -> None:
    """A target's RTK, better than the own receiver, was taken for it. Where the IMU feels neither, as of a vessel that lies moored, a line says so."""
    make = Messages(2)
    items = drive(make, status=0, sigma_m=0.5, seconds=60, noise_m=0.3)
    for k in range(300):
        at, a = START_NS + k * S // 5, 0.03 * k
        lat, lon, up = DATUM.geodetic_from_enu(np.array([[300.0 * np.sin(a), 300.0 * np.cos(0.7 * a), 0.0]]))[0]
        items.append(("/target/fix", at, make.fix(at, lat, lon, up, 2, 1e-4 * np.eye(3).ravel())))
    if moored:
        place = next(m for topic, _, m in items if topic == "/fix")
        for topic, at, m in items:
            if topic == "/fix":
                m.latitude, m.longitude = place.latitude + 1e-6 * (at // S % 7), place.longitude
            elif topic == "/imu":
                m.linear_acceleration.x = m.linear_acceleration.y = m.angular_velocity.z = 1e-3 * (at // 10**7 % 5)
    found, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert any("two craft" in line for line in found.warnings) == moored
    assert ("of another craft" in text) == (not moored)
    assert moored or [s.topic for s in config.of_kind("gnss").values() if s.enabled] == ["/fix"]


@pytest.mark.parametrize("shared", [True, False])
def test_sensors_that_share_a_topic_are_named(shared: bool, tmp_path: Path) -> None:
    """Of antennas 20 m apart the track was, online, 5 m off, and inside its bounds 80 % of the time, without a line on the cause."""
    make = Messages(2)
    items = drive(make, status=0, sigma_m=0.5, seconds=30)
    for k, m in enumerate(m for topic, _, m in items if topic == "/fix"):
        m.header.frame_id = "stern" if shared and k % 2 else "bow"
    found, _, _ = look(tmp_path, items, make)
    assert any("/fix: its messages name several frames (bow" in line for line in found.warnings) == shared


def to_and_fro(make: Messages, turned_deg: float = 0.0, topic: str = "/compass", off_deg: float = 0.0) -> list[Item]:
    """A craft that goes along one line of hers and back for 90 s, with an IMU turned in her, and a heading off that line."""
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 90.0, 0.02)
    speed, rate = 3.0 * np.sin(0.25 * t), 0.06 * np.sin(0.1 * t)
    yaw = 0.4 + np.cumsum(rate) * 0.02
    east, north = (np.cumsum(speed * f(yaw)) * 0.02 for f in (np.cos, np.sin))
    R = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    accel = np.column_stack([np.gradient(speed, 0.02), speed * rate, np.full(len(t), G)]) + rng.normal(
        0.0, 0.05, (len(t), 3)
    )
    lla = DATUM.geodetic_from_enu(np.column_stack([east, north, 0.0 * t]) + rng.normal(0.0, 0.1, (len(t), 3)))
    items: list[Item] = []
    for k, felt in enumerate((accel @ R).tolist()):
        at = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", at, make.imu(at, felt, (0.0, 0.0, rate[k] + 1e-3 * rng.normal()))))
        if k % 10 == 0:
            half = (yaw[k] + np.radians(off_deg)) / 2.0
            items.append(("/fix", at, make.fix(at, lla[k][0], lla[k][1], lla[k][2], 0, 0.25 * np.eye(3).ravel())))
            items.append((topic, at, make.compass(at, (0.0, 0.0, np.sin(half), np.cos(half)))))
    return items


@pytest.mark.parametrize("turned_deg", [0.0, 90.0, 180.0])
def test_a_compass_tells_how_the_imu_of_a_ferry_with_two_bows_is_turned(turned_deg: float, tmp_path: Path) -> None:
    """It goes astern for half of the time, where its course is no heading: the mount was taken as not turned, and the heading 88 deg off."""
    make = Messages(2)
    _, config, _ = look(tmp_path, to_and_fro(make, turned_deg), make)
    assert config.sensors["imu"].mount.rpy_deg == pytest.approx((0.0, 0.0, turned_deg))


@pytest.mark.parametrize(("topic", "mount_deg"), [("/compass", 0.0), ("/gps/heading", 90.0)])
def test_a_craft_that_swings_to_either_side_has_no_compass_athwart(
    topic: str, mount_deg: float, tmp_path: Path
) -> None:
    """At anchor a compass was taken for mounted athwart, and the heading 90 deg off, out of its bounds; two antennas may be."""
    make = Messages(2)
    _, config, _ = look(tmp_path, to_and_fro(make, topic=topic, off_deg=90.0), make)
    compass = config.sensors["compass"]
    assert isinstance(compass, CompassConfig)
    assert compass.mount.rpy_deg[2] == mount_deg
    assert mount_deg or compass.mount_offset_sigma_deg >= 10.0


def test_the_imu_of_a_stabilised_camera_is_not_the_vessels(tmp_path: Path) -> None:
    """It is less noisy, pans by itself, and feels nothing of the way of the craft: it was taken for the IMU, and the compass for one that wanders by 130 deg."""
    make, rng = Messages(2), np.random.default_rng(5)
    items = drive(make, seconds=60)
    for k in range(60 * 50):
        at, (up, noise) = START_NS + k * S // 50, 1e-4 * rng.normal(size=(2, 3))
        up[2] += G
        noise[2] += 0.5 * np.sin(0.02 * k)  # it pans
        items.append(("/camera/imu", at, make.imu(at, up.tolist(), noise.tolist(), frame="camera")))
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.sensors["imu"].topic == "/imu"


def test_a_course_over_ground_is_no_heading(tmp_path: Path) -> None:
    """Of a vessel that is set about by a current: drafted as a compass that wanders by 43 deg, it drew the heading 34 deg off, online, out of its bounds."""
    make = Messages(2)
    items = drive(make, status=0, sigma_m=0.5, seconds=150, noise_m=0.1)
    fixes = [(at, m) for topic, at, m in items if topic == "/fix"]
    t = np.array([(at - START_NS) / S for at, _ in fixes])
    set_m = 15.0 * np.column_stack([np.sin(t / 8.0), np.cos(t / 11.0), 0.0 * t])
    p = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for _, m in fixes]).T) + set_m
    items = [item for item in items if item[0] not in ("/fix", "/compass", "/wheel/odom")]
    step = np.gradient(p, axis=0)
    for (at, m), (lat, lon, up), (east, north, _) in zip(fixes, DATUM.geodetic_from_enu(p), step, strict=True):
        half = np.arctan2(north, east) / 2.0
        items.append(("/fix", at, make.fix(at, lat, lon, up, 0, m.position_covariance)))
        items.append(("/gps/heading", at, make.compass(at, (0.0, 0.0, np.sin(half), np.cos(half)))))
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert not config.of_kind("compass")
    assert "as a course over ground does" in text


def test_a_compass_that_hangs_for_a_while_is_one(tmp_path: Path) -> None:
    """Meanwhile the craft turns away from what it says, as from a course over ground."""
    make, held = Messages(2), None
    items = drive(make, status=0, sigma_m=0.5, seconds=120)
    for topic, at, m in items:
        if topic == "/compass" and 45.0 < (at - START_NS) / S < 65.0:
            held = held or m.quaternion
            m.quaternion = held
    _, config, _ = look(tmp_path, items, make)
    assert "compass" in config.sensors


@pytest.mark.parametrize("clock", [True, False], ids=["a clock behind", "a radio"])
def test_fixes_that_take_seconds_are_told_from_a_clock_that_is_behind(clock: bool, tmp_path: Path) -> None:
    """Both are recorded 2.5 s after their stamps; by radio, put right by that, a track was 5 m off at 10 m/s, and inside its bounds 60 % of the time."""
    make, items = Messages(2), []
    for topic, at, m in drive(make, status=0, sigma_m=0.5, seconds=120, noise_m=0.1):
        if topic == "/fix" and clock:
            m.header = make.header(at - 2 * S - S // 2, "gps")
        if topic != "/wheel/odom":
            items.append((topic, at + (5 * S // 2 if topic == "/fix" and not clock else 0), m))
    found, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.sensors["gnss"].time_offset_s == pytest.approx(2.5 if clock else 0.0, abs=0.1)
    assert ("its messages take as long" in render(found)) == (not clock)


@pytest.mark.parametrize(("zero_deg", "drifts"), [(124.0, True), (90.0, False), (12.0, False)])
def test_the_yaw_of_an_imu_without_a_north_drifts(zero_deg: float, *, drifts: bool, tmp_path: Path) -> None:
    """It counts from where it was switched on: taken for a compass, its drift of 8 deg in 200 s left a third of the headings outside their bounds."""
    make = Messages(2)
    items = drive(make, status=0, sigma_m=0.5, seconds=60)
    yaws = [(at, 2.0 * np.arctan2(m.quaternion.z, m.quaternion.w)) for topic, at, m in items if topic == "/compass"]
    at_ns, yaw = np.array([at for at, _ in yaws]), np.unwrap([y for _, y in yaws])
    for topic, at, m in items:
        if topic == "/imu":
            half = (np.pi / 2.0 - np.interp(at, at_ns, yaw) - np.radians(zero_deg)) / 2.0
            m.orientation, m.orientation_covariance = (
                make.quat((0.0, 0.0, np.sin(half), np.cos(half))),
                np.eye(3).ravel(),
            )
    _, config, _ = look(tmp_path, [item for item in items if item[0] != "/compass"], make)
    compass = config.sensors["compass"]
    assert isinstance(compass, CompassConfig)
    assert (compass.wander_sigma_deg >= 5.0) == drifts


def test_of_two_receivers_the_one_whose_height_drifts_is_not_used(tmp_path: Path) -> None:
    """It claimed half of what the other did, was used, and its drift of 4 m went into the track without a word."""
    make = Messages(2)
    _, config, _ = look(tmp_path, two_receivers(make, drift, claims_m=0.5, height=True), make)
    assert [s.topic for s in config.of_kind("gnss").values() if s.enabled] == ["/fix"]


@pytest.mark.parametrize(("status", "hilly"), [(2, False), (2, True), (0, False)], ids=["RTK", "RTK, hills", "heights"])
def test_of_receivers_that_claim_nothing_the_better_one_is_used_though_it_loses_fixes(
    status: int, hilly: bool, tmp_path: Path
) -> None:
    """Equal by what they claim, the one with most fixes was used: it drifted by 2 m beside RTK with gaps (NCLT's bags)."""
    make, unknown = Messages(2), np.zeros(9)
    items = two_receivers(make, lambda t, yaw: 0.5 * drift(t, yaw), claims_m=1.0, height=True)
    kept = []
    for k, (topic, at, m) in enumerate(drive(make, seconds=120, noise_m=0.02)):
        if topic == "/fix" and (at - START_NS) // S % 30 < 18 and k % 5 == 0:
            kept.append(("/fix", at, make.fix(at, m.latitude, m.longitude, m.altitude, status, unknown)))
    for topic, at, m in items:
        if topic == "/cheap/fix":
            kept.append((topic, at, make.fix(at, m.latitude, m.longitude, m.altitude, 0, unknown)))
        elif topic != "/fix":
            kept.append((topic, at, m))
    for topic, at, m in kept:
        if hilly and topic.endswith("/fix"):
            m.altitude += 20.0 * np.sin((at - START_NS) / S / 15.0)
    _, config, _ = look(tmp_path, sorted(kept, key=lambda item: item[1]), make)
    assert [s.topic for s in config.of_kind("gnss").values() if s.enabled] == ["/fix"]


def test_what_two_receivers_differ_by_is_in_the_slow_error(tmp_path: Path) -> None:
    """Without its height nothing tells which of the two drifts."""
    make = Messages(2)
    found, config, _ = look(tmp_path, two_receivers(make, drift, claims_m=0.5, height=False), make)
    (used,) = [s for s in config.of_kind("gnss").values() if s.enabled]
    assert used.topic == "/cheap/fix"
    assert used.slow_error.horizontal_sigma_m == pytest.approx(4.0, rel=0.35)
    assert any("wander against each other" in line for line in found.warnings)


def test_two_antennas_on_a_ship_do_not_wander_against_each_other(tmp_path: Path) -> None:
    """30 m apart, the way from one to the other turns with her."""
    make = Messages(2)
    antenna = lambda _t, yaw: 30.0 * np.column_stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw])
    found, config, _ = look(tmp_path, two_receivers(make, antenna, claims_m=1.0, height=True), make)
    assert not any("wander against each other" in line for line in found.warnings)
    assert {s.slow_error.horizontal_sigma_m for s in config.of_kind("gnss").values()} == {2.0}
    # Neither antenna's place was taken to be off by more than a metre: the track was up to 20 m off, in bounds of 5 m.
    assert all(10.0 < s.mount_sigma_m < 16.0 for s in config.of_kind("gnss").values())


@pytest.mark.parametrize("ashore", [False, True], ids=["another datum", "a base"])
def test_what_does_not_turn_with_the_craft_is_no_other_antenna(ashore: bool, tmp_path: Path) -> None:
    """80 m to the north throughout, or a base 1 km away: antennas were taken to be off by 37 and by 438 m."""
    make = Messages(2)
    items = two_receivers(
        make, lambda t, _yaw: np.column_stack([0.0 * t, 80.0 + 0.0 * t, 0.0 * t]), claims_m=1.0, height=True
    )
    other = [message for topic, _, message in items if topic == "/cheap/fix"]
    latitude, longitude = other[0].latitude + 1000.0 / 111e3, other[0].longitude
    for message in other if ashore else []:
        message.latitude, message.longitude = latitude, longitude
    _, config, _ = look(tmp_path, items, make)
    assert {s.mount_sigma_m for s in config.of_kind("gnss").values()} == {1.0}


def test_a_late_receiver_of_one_antenna_tells_no_distance(tmp_path: Path) -> None:
    """Straight on, at 10 m/s, it looks like an antenna 4 m further back."""
    make = Messages(2)
    items = two_receivers(make, lambda t, _yaw: np.zeros((len(t), 3)), claims_m=1.0, height=True)
    for topic, log_ns, message in items:
        if topic in ("/fix", "/cheap/fix"):
            at_ns = log_ns + (400_000_000 if topic == "/cheap/fix" else 0)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(at_ns, S)
            message.latitude = 58.0 + 10.0 * (log_ns - START_NS) / S / 111e3
            message.longitude = 11.0
    _, config, _ = look(tmp_path, items, make)
    assert {s.mount_sigma_m for s in config.of_kind("gnss").values()} == {1.0}


@pytest.mark.parametrize(("claims_m", "scatter_m", "slow_m"), [(6.0, 0.3, 6.0), (6.0, 6.0, 2.0), (1.0, 0.1, 2.0)])
def test_what_fixes_claim_and_do_not_scatter_by_is_slow(
    claims_m: float, scatter_m: float, slow_m: float, tmp_path: Path
) -> None:
    """A receiver that claims 6 m and says a smooth way had bounds of 2 m; one whose fixes scatter by what they claim, or that claims less, keeps these."""
    make = Messages(2)
    items = [
        item
        for item in drive(make, seconds=60, status=0, sigma_m=claims_m, noise_m=scatter_m)
        if item[0] != "/wheel/odom"
    ]
    _, config, text = look(tmp_path, items, make)
    receiver = config.sensors["gnss"]
    assert isinstance(receiver, GnssConfig)
    assert receiver.slow_error.horizontal_sigma_m == pytest.approx(slow_m)
    assert ("most of the error that they claim is slow" in text) == (slow_m > 2.0)


@pytest.mark.parametrize("silent", ["/fix", "/cheap/fix"])
def test_a_gap_of_one_receiver_is_no_wander(silent: str, tmp_path: Path) -> None:
    """The way that the other one went meanwhile was taken for it: metres of slow error were drafted for receivers that agree."""
    make = Messages(2)
    items = two_receivers(make, lambda t, _yaw: np.zeros((len(t), 3)), claims_m=1.0, height=True)
    kept = [item for item in items if item[0] != silent or not 40 * S < item[1] - START_NS < 80 * S]
    found, config, _ = look(tmp_path, kept, make)
    assert not any("wander against each other" in line for line in found.warnings)
    assert {s.slow_error.horizontal_sigma_m for s in config.of_kind("gnss").values()} == {2.0}


@pytest.mark.parametrize("held", ["/fix", "/cheap/fix"])
def test_a_receiver_that_freezes_for_a_while_is_no_wander(held: str, tmp_path: Path) -> None:
    """Its fixes are rejected; the way that the other one went meanwhile made a slow error of tens of metres of them."""
    make, last = Messages(2), None
    items = two_receivers(make, lambda t, _yaw: np.zeros((len(t), 3)), claims_m=1.0, height=True)
    for topic, log_ns, message in items:
        if topic == held and 40 * S < log_ns - START_NS < 60 * S:
            last = last or message
            message.latitude, message.longitude = last.latitude, last.longitude
    found, config, _ = look(tmp_path, items, make)
    assert any(held in line and "frozen receiver" in line for line in found.warnings)
    assert not any("wander against each other" in line for line in found.warnings)
    assert {s.slow_error.horizontal_sigma_m for s in config.of_kind("gnss").values()} == {2.0}


@pytest.mark.parametrize("keeps", [1.0, 0.985], ids=["a constant", "smoothed"])
def test_hills_that_another_receiver_does_not_show_are_no_drift(keeps: float, tmp_path: Path) -> None:
    """Of a driver that fills in 0, or a filter over 13 s: the better receiver's hills were taken for its drift, and it was switched off."""
    make = Messages(2)
    items = two_receivers(make, lambda t, _yaw: np.zeros((len(t), 3)), claims_m=2.0, height=True)
    height = 0.0
    for topic, at, m in items:
        hill = 20.0 * np.sin((at - START_NS) / S / 15.0)
        if topic == "/fix":
            m.altitude += hill
        elif topic == "/cheap/fix":
            height = keeps * height + (1.0 - keeps) * hill
            m.altitude = height
    _, config, _ = look(tmp_path, items, make)
    assert [s.topic for s in config.of_kind("gnss").values() if s.enabled] == ["/fix"]


def test_a_covariance_that_is_a_placeholder_is_told_from_one(tmp_path: Path) -> None:
    """Drivers that know none write 99999 m^2: such fixes would tell next to nothing."""
    _, config, _ = look(tmp_path, drive(Messages(2), status=0, sigma_m=316.0), Messages(2))
    gnss = config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    assert gnss.sigma_scale * 316.0 == pytest.approx(gnss.default_horizontal_sigma_m, rel=0.02)


def halves(make: Messages) -> list[Item]:
    """`drive`, and beside its IMU the two topics of a RealSense: accelerations without rates, rates without accelerations."""
    items = drive(make)
    for _, at, m in [item for item in items if item[0] == "/imu"]:
        a, w = m.linear_acceleration, m.angular_velocity
        items.append(("/camera/accel/sample", at, make.imu(at, (a.x, a.y, a.z), (0, 0, 0))))
        items.append(("/camera/gyro/sample", at, make.imu(at, (0, 0, 0), (w.x, w.y, w.z))))
    return sorted(items, key=lambda item: item[1])


def test_half_an_imu_is_not_taken_for_one(tmp_path: Path) -> None:
    """Without noise in its rates it was the one with least of it, and drafted."""
    make = Messages(2)
    found, config, _ = look(tmp_path, halves(make), make)
    assert [s.topic for s in config.of_kind("imu").values() if s.enabled] == ["/imu"]
    assert {i.topic: i.missing for i in found.imus} == {
        "/imu": "",
        "/camera/accel/sample": "rates",
        "/camera/gyro/sample": "accelerations",
    }


@pytest.mark.parametrize(("topic", "said"), [("accel", "all rates"), ("gyro", "all accelerations")])
def test_half_an_imu_is_refused_when_a_bag_is_read(topic: str, said: str, tmp_path: Path) -> None:
    make = Messages(2)
    path = hold_bag(tmp_path / "run", make, halves(make))
    sensors = {"imu": {"kind": "imu", "topic": f"/camera/{topic}/sample"}, "gnss": {"kind": "gnss", "topic": "/fix"}}
    with pytest.raises(InputError, match=f"{said} of /camera/{topic}/sample are 0"):
        read_recording(path, parse_config({"sensors": sensors}, KINDS, "test"))


def test_an_imu_with_gravity_is_taken_before_one_without(tmp_path: Path) -> None:
    make = Messages(2)
    items = drive(make)
    for _, at, m in [item for item in items if item[0] == "/imu"]:
        a, w = m.linear_acceleration, m.angular_velocity
        items.append(("/a/linear", at, make.imu(at, (a.x, a.y, a.z - G), (w.x, w.y, w.z))))
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert [s.topic for s in config.of_kind("imu").values() if s.enabled] == ["/imu"]


@pytest.mark.parametrize(("lasts_s", "used"), [(60.0, "/rtk"), (30.0, "/fix")])
def test_rtk_is_taken_before_a_receiver_that_says_more(lasts_s: float, used: str, tmp_path: Path) -> None:
    """Five fixes a second that are good to a metre are less than one that is good to a centimetre, if that is there throughout."""
    make = Messages(2)
    items = drive(make, status=0, sigma_m=1.0)
    for _, at, m in [item for item in items if item[0] == "/fix"][::5]:
        if at < START_NS + lasts_s * S:
            cov = (1e-4 * np.eye(3)).ravel()
            items.append(("/rtk", at, make.fix(at, m.latitude, m.longitude, m.altitude, 2, cov)))
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert [s.topic for s in config.of_kind("gnss").values() if s.enabled] == [used]


@pytest.mark.parametrize("floats", [0.0, 0.03, 0.3, 0.97])
def test_rtk_that_is_float_at_times_is_two_sensors(floats: float, tmp_path: Path) -> None:
    """With the error of a float for all of them, the track was metres off where fixes were good to a centimetre; with that of RTK, floats
    that were 0.4 m off were in the bounds for 70 % of the time. Each fix is used once.
    """
    make = Messages(2)
    items, wanted = list[Item](), list[int]()
    for n, (topic, at, m) in enumerate(drive(make, sigma_m=0.01, status=2)):
        if topic == "/fix" and (n * 0.618) % 1.0 < floats:
            m = make.fix(at, m.latitude, m.longitude, m.altitude, 2, (0.25 * np.eye(3)).ravel())
            wanted.append(at)
        items.append((topic, at, m))
    _, config, _ = look(tmp_path, items, make)
    found = config.of_kind("gnss")
    assert {name: (g.fixes, g.topic, g.slow_error.horizontal_sigma_m) for name, g in found.items()} == (
        {"gnss": ("rtk", "/fix", 0.03), "gnss_other": ("other", "/fix", 0.5)}
        if floats
        else {"gnss": ("any", "/fix", 0.03)}
    )
    assert [config.by_turns(name) for name in found] == (
        [["gnss", "gnss_other"], ["gnss_other", "gnss"]] if floats else [["gnss"]]
    )
    recording = read_recording(tmp_path / "run", config)
    used = {name: [m.stamp_ns for m in recording.of(GnssPosition) if m.sensor == name] for name in found}
    assert used.get("gnss_other", []) == wanted
    fixes = [at for topic, at, _ in items if topic == "/fix"]
    assert sorted(at for stamps in used.values() for at in stamps) == fixes
    left = Counter((row.sensor, row.outcome) for row in recording.rows if row.sensor in found)
    assert left == Counter({(name, Outcome.IGNORED): len(fixes) - len(used[name]) for name in found} if floats else {})


@pytest.mark.parametrize("rtk", [True, False])
def test_a_run_without_loss_of_rtk_misses_no_sensor(rtk: bool, tmp_path: Path) -> None:
    """Nor does one without any: 'none of the messages could be used' made a good track one to use with care."""
    make = Messages(2)
    items = drive(make, sigma_m=0.01 if rtk else 0.5, status=2)
    _, config, _ = look(tmp_path, items, make)
    gnss = config.sensors["gnss"]
    turns = {name: gnss.model_copy(update={"fixes": name}) for name in ("rtk", "other")}
    config = config.model_copy(update={"sensors": {"imu": config.sensors["imu"], **turns}})
    assert not [line for line in read_recording(tmp_path / "run", config).warnings if "could be used" in line]
    alone = config.with_sensors({"rtk" if rtk else "other": turns["rtk"].model_copy(update={"enabled": False})})
    assert any("could be used" in line for line in read_recording(tmp_path / "run", alone).warnings)


@pytest.mark.parametrize("claims_m", [0.05, 500.0])
def test_what_a_receiver_claims_without_rtk_is_nothing_to_its_rtk(claims_m: float, tmp_path: Path) -> None:
    """Centimetres without RTK were taken for RTK; a placeholder for the others' sigma scaled that of RTK."""
    make = Messages(2)
    items = list[Item]()
    for topic, at, m in drive(make, sigma_m=0.02, status=2, seconds=180):
        rtk = (at - START_NS) / S % 60.0 >= 57.0
        if topic == "/fix" and not rtk:
            m = make.fix(at, m.latitude, m.longitude, m.altitude, 0, (claims_m**2 * np.eye(3)).ravel())
        items.append((topic, at, m))
    _, config, _ = look(tmp_path, items, make)
    rtk, other = config.sensors["gnss"], config.sensors["gnss_other"]
    assert (rtk.fixes, rtk.sigma_scale, rtk.slow_error.horizontal_sigma_m) == ("rtk", 1.0, 0.03)
    assert (other.fixes, other.slow_error.horizontal_sigma_m) == ("other", 2.0)
    assert other.sigma_scale == (1.0 if claims_m < 1.0 else pytest.approx(1.5 / 500.0, rel=0.05))
    recording = read_recording(tmp_path / "run", config)
    assert Counter(m.sensor for m in recording.of(GnssPosition)) == {"gnss": 45, "gnss_other": 855}
    assert not [line for line in recording.warnings if "bursts" in line]


@pytest.mark.parametrize(("claims_m", "used"), [(1.2, "/fix"), (0.4, "/second")])
def test_a_receiver_that_claims_more_accuracy_is_taken_before_one_that_says_more(
    claims_m: float, used: str, tmp_path: Path
) -> None:
    """Of equally accurate ones, within a factor of two, the one that says more."""
    make = Messages(2)
    items = drive(make, status=0, sigma_m=1.0)
    for _, at, m in [item for item in items if item[0] == "/fix"][::2]:
        cov = (claims_m**2 * np.eye(3)).ravel()
        items.append(("/second", at, make.fix(at, m.latitude, m.longitude, m.altitude, 0, cov)))
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert [s.topic for s in config.of_kind("gnss").values() if s.enabled] == [used]


@pytest.mark.parametrize("scanned", [False, True])
def test_what_no_run_can_do_without_is_reported(scanned: bool, tmp_path: Path) -> None:
    """A draft of an IMU alone was all that came of a bag whose places are in messages of another kind; of scans beside it nothing was said."""
    make = Messages(2)
    make.register("float64 latitude\nfloat64 longitude", "foxglove_msgs/msg/LocationFix")
    items = [item for item in drive(make, seconds=10) if item[0] == "/imu"]
    place = make.t["foxglove_msgs/msg/LocationFix"](latitude=57.7, longitude=11.9)
    cloud = make.t["sensor_msgs/msg/PointCloud2"](
        header=make.header(START_NS, "lidar"), height=1, width=0, fields=[], is_bigendian=False, point_step=12, row_step=0,
        data=np.zeros(0, np.uint8), is_dense=True,
    )  # fmt: skip
    scans = [("/scans", items[-1][1], cloud)] if scanned else []
    found = inspect_bag(hold_bag(tmp_path / "run", make, [*items, *scans, ("/location", items[-1][1], place)]))
    said = " | ".join(found.warnings)
    assert "nothing in it tells the place" in said
    assert "smooth, replay and compare need one: record it, too" in said
    assert ("scans are matched around a track" in said) is scanned
    assert "/location (foxglove_msgs/LocationFix)" in said
    assert "IMU" not in said


@pytest.mark.parametrize(
    ("topic", "said"),
    [
        ("/speed_log", True), ("/paddle_wheel_kn", True), ("/own/kmh", True), ("/wheel/v_mps", True),
        ("/battery_voltage", False), ("/engine/rpm", False), ("/skn", False), ("/known", False),
    ],
)  # fmt: skip
def test_numbers_that_may_be_a_speed_are_said_to_be_one(topic: str, said: bool, tmp_path: Path) -> None:
    """Nothing of such a topic was in the text or in the draft."""
    make = Messages(2)
    number = make.t["std_msgs/msg/Float64"]
    more = [(topic, START_NS + k * S // 5, number(data=3.0)) for k in range(200)]
    found, _, _ = look(tmp_path, sorted([*drive(make), *more], key=lambda item: item[1]), make)
    assert [topic in w and "kind body_velocity" in w for w in found.warnings] == [True] * said


@pytest.mark.parametrize("compass", [True, False])
def test_a_magnetometer_alone_is_said_to_be_no_compass(compass: bool, tmp_path: Path) -> None:
    make = Messages(2)
    items = [item for item in drive(make, seconds=30) if compass or item[0] != "/compass"]
    magnetic = make.t["sensor_msgs/msg/MagneticField"]
    field = magnetic(make.header(START_NS), make.vector((0.0, 15e-6, -48e-6)), np.zeros(9))
    found, _, _ = look(tmp_path, [*items, ("/mag", items[-1][1], field)], make)
    assert any(w.startswith("/mag: a magnetic field is not read") for w in found.warnings) != compass


@pytest.mark.parametrize("leeway_deg", [0.0, 6.0])
def test_a_course_that_wanders_about_the_heading_tells_no_compass_to_a_degree(
    leeway_deg: float, tmp_path: Path
) -> None:
    """Of a craft that is set sideways now and then; its mean offset was 2 deg, and taken for all that could be wrong."""
    make = Messages(2)
    items = [item for item in drive(make, seconds=200) if item[0] != "/compass"]
    for k, (_, at, m) in enumerate([item for item in drive(make, seconds=200) if item[0] == "/compass"]):
        own = 2.0 * np.arctan2(m.quaternion.z, m.quaternion.w) + np.radians(leeway_deg) * np.sin(
            2.0 * np.pi * k / 5.0 / 90.0
        )
        items.append(("/compass", at, make.compass(at, (0.0, 0.0, np.sin(own / 2.0), np.cos(own / 2.0)))))
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    compass = config.sensors["compass"]
    assert isinstance(compass, CompassConfig)
    # A sine of 6 deg, the mean taken over each third of its period: 6 sinc(1/3) / sqrt(2) = 3.5 deg.
    assert compass.mount_offset_sigma_deg == (pytest.approx(3.5, abs=1.0) if leeway_deg else 1.0)
    assert ("its offset to the GNSS course wanders" in text) == bool(leeway_deg)


def test_a_craft_that_goes_astern_for_a_while_has_no_worse_compass(tmp_path: Path) -> None:
    """Half a minute astern of four was an offset that wanders by 69 deg: so much was drafted for the compass, which then told nothing."""
    make, items = Messages(2), []
    rng, rate_hz = np.random.default_rng(1), 20
    t = np.arange(0.0, 180.0, 1.0 / rate_hz)
    rate = 0.06 * np.sign(np.sin(2.0 * np.pi * t / 40.0))
    yaw = np.cumsum(rate) / rate_hz
    speed = np.where((t > 120.0) & (t < 150.0), -1.5, 1.5)
    way = np.cumsum(speed * np.exp(1j * yaw)) / rate_hz
    accel = np.gradient(speed, t) + 1j * speed * rate
    lla = DATUM.geodetic_from_enu(np.column_stack([way.real, way.imag, 0.0 * t]))
    for k in range(len(t)):
        at = START_NS + k * S // rate_hz
        felt, turns = (accel[k].real, accel[k].imag, G), (0.0, 0.0, rate[k])
        items.append(("/imu", at, make.imu(at, rng.normal(felt, 0.01).tolist(), rng.normal(turns, 1e-3).tolist())))
        if k % 5 == 0:
            items.append(("/compass", at, make.compass(at, (0.0, 0.0, np.sin(0.5 * yaw[k]), np.cos(0.5 * yaw[k])))))
            items.append(("/fix", at, make.fix(at, *lla[k])))
    _, config, _ = look(tmp_path, items, make)
    compass = config.sensors["compass"]
    assert isinstance(compass, CompassConfig)
    assert compass.mount_offset_sigma_deg < 5.0


@pytest.mark.parametrize("turns", [True, False])
def test_a_compass_of_a_vessel_that_goes_sideways_is_one_if_it_turns_as_the_gyro_does(
    turns: bool, tmp_path: Path
) -> None:
    """Set by wind up to 40 deg off her course, she had no compass; a heading that is off by as much while she does not turn is none."""
    make, crab_rad, per_s = Messages(2), np.radians(40.0), 2.0 * np.pi / 90.0
    items = [item for item in drive(make, seconds=200) if item[0] not in ("/compass", "/imu")]
    for topic, at, m in drive(make, seconds=200):
        t = (at - START_NS) / S
        if topic == "/compass":  # clockwise from north
            own = 2.0 * np.arctan2(m.quaternion.z, m.quaternion.w) - crab_rad * np.sin(per_s * t)
            items.append((topic, at, make.compass(at, (0.0, 0.0, np.sin(own / 2.0), np.cos(own / 2.0)))))
        elif topic == "/imu":
            a, w = m.linear_acceleration, m.angular_velocity
            rate = crab_rad * per_s * np.cos(per_s * t) if turns else 0.0
            items.append((topic, at, make.imu(at, (a.x, a.y, a.z), (w.x, w.y, w.z + rate))))
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert bool(config.of_kind("compass")) == turns
    assert ("often goes sideways, since it turns as the gyro does" in text) == turns
    if turns:  # no course tells how it is mounted
        compass = config.sensors["compass"]
        assert isinstance(compass, CompassConfig)
        assert compass.convention == "ned"
        assert compass.mount_offset_sigma_deg == pytest.approx(10.0)


def test_two_antennas_athwart_that_are_silent_in_turns_are_a_compass_beside_a_course_that_wanders(
    tmp_path: Path,
) -> None:
    """An Imu of an orientation alone, at 1 Hz, a quarter turn off, of a vessel that is set sideways: taken for a relative heading."""
    make, crab_rad, per_s = Messages(2), np.radians(22.0), 2.0 * np.pi / 50.0
    items: list[Item] = []
    for topic, at, m in drive(make, seconds=200):
        t = (at - START_NS) / S
        if topic == "/compass" and (at - START_NS) % S == 0 and not 60.0 < t < 110.0:
            own = 2.0 * np.arctan2(m.quaternion.z, m.quaternion.w) - crab_rad * np.sin(per_s * t)
            athwart = np.pi / 2.0 - own - np.pi / 2.0  # east, north, up; the drive's own is clockwise from north
            heading = make.imu(at, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            heading.orientation.x, heading.orientation.y = 0.0, 0.0
            heading.orientation.z, heading.orientation.w = np.sin(athwart / 2.0), np.cos(athwart / 2.0)
            heading.orientation_covariance = np.zeros(9)
            items.append(("/rover/navheading", at, heading))
        elif topic == "/imu":
            a, w = m.linear_acceleration, m.angular_velocity
            rate = crab_rad * per_s * np.cos(per_s * t)
            items.append((topic, at, make.imu(at, (a.x, a.y, a.z), (w.x, w.y, w.z + rate))))
        elif topic != "/compass":
            items.append((topic, at, m))
    _, config, text = look(tmp_path, items, make)
    (compass,) = config.of_kind("compass").values()
    assert isinstance(compass, CompassConfig)
    assert compass.enabled
    assert compass.convention == "enu"
    assert compass.mount.rpy_deg[2] == pytest.approx(-90.0)
    assert "often goes sideways, since it turns as the gyro does" in text


@pytest.mark.parametrize("scale", [1.0, 180.0 / np.pi], ids=["rad/s", "deg/s"])
def test_the_unit_of_a_robot_that_trots_is_told_by_its_turns(scale: float, tmp_path: Path) -> None:
    """It swings twice a second at 0.5 rad/s, and each step shakes it: deg/s were drafted, and then refused, as it turned 54 times less than the courses."""
    make, rng = Messages(2), np.random.default_rng(1)
    items = drive(make, gyro_scale=scale, seconds=120)
    for topic, at, m in items:
        if topic == "/imu":
            phase = 4.0 * np.pi * (at - START_NS) / S
            m.angular_velocity.x += scale * 0.6 * np.sin(phase)
            m.angular_velocity.y += scale * 0.6 * np.cos(phase)
            for axis in "xyz":
                setattr(m.linear_acceleration, axis, getattr(m.linear_acceleration, axis) + 4.0 * rng.normal())
    _, config, text = look(tmp_path, items, make)
    assert isinstance(config.sensors["imu"], ImuConfig)
    assert config.sensors["imu"].gyro_unit == ("rad/s" if scale == 1.0 else "deg/s")
    assert ("it turns as the courses of the fixes do in deg/s" in text) == (scale != 1.0)
    assert not [w for w in read_recording(tmp_path / "run", config).warnings if "looks like deg/s" in w]


@pytest.mark.parametrize("told_by", ["odometry", "itself"])
@pytest.mark.parametrize("scale", [1.0, 180.0 / np.pi], ids=["rad/s", "deg/s"])
def test_the_unit_of_a_robot_that_pivots_is_told_by_its_attitude(scale: float, told_by: str, tmp_path: Path) -> None:
    """At 1.2 rad/s and level: gravity does not turn, and courses are no headings. deg/s were drafted, and the heading was 108 deg off."""
    make, rate = Messages(2), 1.2
    items = []
    for topic, at, m in drive(make, gyro_scale=scale, seconds=60):
        t = (at - START_NS) / S
        yaw = 10.0 * (rate / 2.0) * np.sin(t / 5.0) + rate * t
        spun = Rotation.from_euler("z", yaw).as_quat().tolist()
        if topic == "/imu":
            v = m.angular_velocity
            own = (spun, np.zeros(9)) if told_by == "itself" else ()
            gyro = (v.x, v.y, scale * (rate * np.cos(t / 5.0) + rate))
            items.append((topic, at, make.imu(at, (0.0, 0.0, G), gyro, *own)))
        elif topic == "/fix":
            items.append((topic, at, make.fix(at, 57.7, 11.9, 40.0)))
        elif topic == "/wheel/odom" and told_by == "odometry":
            items.append((topic, at, make.odometry(at, (0, 0, 0), spun)))
    found, config, _ = look(tmp_path, items, make)
    assert found.imus[0].gyro_unit == ("rad/s" if scale == 1.0 else "deg/s")
    assert not [w for w in read_recording(tmp_path / "run", config).warnings if "looks like deg/s" in w]
    silent = config.sensors["imu"].model_copy(update={"gyro_unit": "rad/s"})
    silent.__pydantic_fields_set__.discard("gyro_unit")
    warned = (
        read_recording(tmp_path / "run", config.with_sensors({"imu": silent})).warnings
        if scale == 1.0
        else ("looks like deg/s",)
    )
    assert any("looks like deg/s" in w for w in warned)


@pytest.mark.parametrize("every", [1, 25])
def test_an_imu_that_is_too_slow_is_said(every: int, tmp_path: Path) -> None:
    """A logger that keeps one message a second: offline the antenna was 31 m from its mount, online it waited for IMU data, with no word why."""
    make = Messages(2)
    plain = drive(make, seconds=60)
    imu = [item for item in plain if item[0] == "/imu"][::every]
    items = sorted([*imu, *(item for item in plain if item[0] != "/imu")], key=lambda item: item[1])
    found, config, _ = look(tmp_path, items, make)
    said = "its samples come 1.0 s apart, more than max_gap_s (0.5 s): each interval is a gap"
    assert (said in render(found)) == (every == 25)
    recording = read_recording(tmp_path / "run", config)
    assert [said in w for w in recording.warnings if "apart" in w] == [True] * (every == 25)
    if every == 25:
        with pytest.raises(
            SolveError, match=r"waiting for 5 s of IMU data, whose samples come 1\.0 s apart, more than"
        ):
            replay(recording, config)


def stamped_late(make: Messages, late_s: float, *, seconds: int, noise_m: float) -> list[Item]:
    """A drive without wheels, whose fixes are stamped so much later than they were measured."""
    items = [
        item
        for item in drive(make, seconds=seconds, noise_m=noise_m, status=0, sigma_m=1.0)
        if item[0] != "/wheel/odom"
    ]
    late_ns = round(late_s * S)
    for k, (topic, at, m) in enumerate(items):
        if topic == "/fix":
            later = make.fix(at + late_ns, m.latitude, m.longitude, m.altitude, 0, np.eye(3).ravel())
            items[k] = (topic, at + late_ns, later)
    return sorted(items, key=lambda item: item[1])


@pytest.mark.parametrize("late_s", [0.0, 0.4, -0.4])
def test_fixes_that_are_stamped_late_get_an_offset(late_s: float, tmp_path: Path) -> None:
    """Drivers of serial lines stamp when they hear. The IMU tells it where the craft brakes, whatever the antenna's lever."""
    make = Messages(2)
    items = stamped_late(make, late_s, seconds=120, noise_m=0.05)
    _, config, _ = look(tmp_path, items, make)
    assert config.sensors["gnss"].time_offset_s == pytest.approx(-late_s, abs=0.1)
    assert (config.sensors["gnss"].time_offset_s != 0.0) == (late_s != 0.0)
    assert isinstance(config.sensors["gnss"], GnssConfig)
    assert config.sensors["gnss"].stamp_sigma_s >= 0.05  # what is left is estimated with the run


@pytest.mark.parametrize("stamped", [(), ("/imu", "/fix"), ("/imu",)], ids=["copied", "stamped", "as NMEA"])
def test_fixes_are_not_measured_after_they_were_recorded(stamped: tuple[str, ...], tmp_path: Path) -> None:
    """Of a sailing boat that tacked, what she felt as she heeled drafted +1.74 +- 0.12 s for sentences that came 0.14 s after they were measured."""
    make = Messages(2)
    items = stamped_late(make, -1.5, seconds=120, noise_m=0.05)
    came = sorted(((topic, at + (topic in stamped) * S // 50, m) for topic, at, m in items), key=lambda item: item[1])
    _, config, _ = look(tmp_path, came, make)
    assert config.sensors["gnss"].time_offset_s == pytest.approx(0.0 if stamped else 1.5, abs=0.1)


def in_a_hall(make: Messages, yaw_deg: float, of: Callable[[int, list[float], list[float]], Any]) -> list[Item]:
    """A multirotor that leans into its accelerations for 60 s, so that it feels none along its deck; its IMU's x looks up.

    Args:
        yaw_deg: of the IMU, once level. of: the message of where it is, of its stamp, place and attitude (x, y, z, w).
    """
    t = np.arange(0.0, 60.0, 0.02)
    place = np.column_stack([1.5 * np.sin(0.9 * t), np.sin(1.3 * t + 1.0), 1.0 + 0.2 * np.sin(0.5 * t)])
    accel = np.gradient(np.gradient(place, t, axis=0), t, axis=0)
    yaw = 1.5 * np.sin(0.3 * t)
    ahead = np.cos(yaw) * accel[:, 0] + np.sin(yaw) * accel[:, 1]
    left = -np.sin(yaw) * accel[:, 0] + np.cos(yaw) * accel[:, 1]
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, np.arctan(ahead / G), -np.arctan(left / G)]))
    rate = np.vstack([(R[:-1].inv() * R[1:]).as_rotvec() / 0.02, np.zeros(3)])
    accel[:, 2] += G
    felt = R.inv().apply(accel) + np.random.default_rng(1).normal(0.0, 0.05, (len(t), 3))
    x_up = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    M = rotation_z(yaw_deg) @ x_up
    items: list[Item] = []
    for k in range(len(t)):
        at = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", at, make.imu(at, M.T @ felt[k], M.T @ rate[k])))
        if k % 2 == 0:
            items.append(("/hall/craft", at, of(at, place[k].tolist(), R[k].as_quat().tolist())))
    return items


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0])
def test_motion_capture_alone_tells_the_place_and_how_the_imu_sits(yaw_deg: float, tmp_path: Path) -> None:
    """Its messages were not read, `inspect` said that nothing told the place, and took the IMU's yaw as 0: no run could be solved."""
    make = Messages(2)
    found, config, text = look(tmp_path, in_a_hall(make, yaw_deg, make.transform), make)
    turn = Rotation.from_euler("xyz", config.sensors["imu"].mount.rpy_deg, degrees=True).as_matrix()
    x_up = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(turn, rotation_z(yaw_deg) @ x_up, atol=1e-9)
    (said_of_poses,) = [w for w in found.warnings if "nothing but poses tells the place" in w]
    assert "/hall/craft" in said_of_poses
    assert "set enabled: true, and datum:" in said_of_poses
    told = text.replace("enabled: false  # guess: true if its frame", "enabled: true  #")
    told = told.replace(
        "# datum: {latitude_deg: , longitude_deg: ,", "datum: {latitude_deg: 58.0, longitude_deg: 12.0,"
    )
    (tmp_path / "told.yaml").write_text(told)
    sensor = load_config(tmp_path / "told.yaml", KINDS).sensors["pose"]
    assert sensor.enabled
    assert sensor.axes == ("x", "y", "z", "yaw")


def test_points_alone_tell_the_place_without_a_heading(tmp_path: Path) -> None:
    make = Messages(2)
    found, config, _ = look(tmp_path, in_a_hall(make, 0.0, lambda at, p, _: make.point(at, p)), make)
    assert any("nothing but poses tells the place" in w for w in found.warnings)
    assert config.sensors["pose"].axes == ("x", "y", "z")


@pytest.mark.parametrize("heading", ["late, hardly turning", "in time, turning"])
def test_a_heading_of_late_messages_is_as_late_as_the_place_in_them(heading: str, tmp_path: Path) -> None:
    """One message has one stamp: the place had got its offset, and the heading beside it, whose slow turns tell nothing, had not."""
    make, rng, late_s = Messages(2), np.random.default_rng(1), 0.4
    turning = heading == "in time, turning"
    t = np.arange(0.0, 150.0, 0.02)
    speed = 3.0 + 1.5 * np.sin(0.4 * t)
    rate = 0.25 * np.sin(0.5 * t) if turning else 0.01 * np.sin(0.05 * t)
    yaw = np.concatenate([[0.3], 0.3 + np.cumsum(rate[:-1]) * 0.02])
    way = np.cumsum(speed * np.exp(1j * yaw)) * 0.02
    lla = DATUM.geodetic_from_enu(np.column_stack([way.real, way.imag, 0 * t]))
    accel = np.column_stack([0.6 * np.cos(0.4 * t), speed * rate, np.full(len(t), G)])
    items: list[Item] = []
    for k in range(len(t)):
        at = START_NS + k * S // 50
        if k % 2 == 0:
            items.append(("/imu", at, make.imu(at, accel[k], (0.0, 0.0, rate[k] + 1e-3 * rng.normal()))))
        if k % 10 == 0:
            late = at + round(late_s * S)
            told = yaw[min(k + round(50 * late_s), len(t) - 1) if turning else k] + np.radians(1.0) * rng.normal()
            pose = {
                "position": dict(zip(("latitude", "longitude", "altitude"), lla[k], strict=True)),
                "orientation": make.quat((0.0, 0.0, np.sin(0.5 * told), np.cos(0.5 * told))),
            }
            msg = said(make, "geographic_msgs/msg/GeoPoseStamped", header=make.header(late), pose=pose)
            items.append(("/geopose", late, msg))
    found, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.sensors["gnss"].time_offset_s == pytest.approx(-late_s, abs=0.1)
    compass = config.sensors["compass"]
    if turning:  # the gyroscope denies it
        assert compass.time_offset_s == pytest.approx(0.0, abs=0.03)
        return
    assert compass.time_offset_s == config.sensors["gnss"].time_offset_s
    assert "fits the motion of the fixes in the same messages" in text
    assert "fits the motion of the fixes in the same messages" in render(found)


@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_fixes_that_may_be_stamped_late_are_given_as_much_to_find(late_s: float, tmp_path: Path) -> None:
    """In a minute the IMU tells 0.2 s by three sigmas, no more: no offset is drafted, and a sigma of 0.05 s would not reach so far."""
    make = Messages(2)
    items = stamped_late(make, late_s, seconds=60, noise_m=0.1)
    found, config, text = look(tmp_path, items, make)
    gnss = config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    assert gnss.time_offset_s == 0.0
    assert found.gnss[0].late_s is None
    if late_s == 0.0:
        assert gnss.stamp_sigma_s == 0.05
        return
    assert gnss.stamp_sigma_s == pytest.approx(late_s, abs=0.1)
    assert "what the IMU feels hints at -0." in text


@pytest.mark.parametrize(("late_s", "way_s", "noise_m"), [(0.4, 0.02, 1.0), (0.4, 0.4, 1.0), (0.8, 0.02, 1.5)])
def test_a_velocity_of_the_receiver_tells_how_late_its_noisy_fixes_are(
    late_s: float, way_s: float, noise_m: float, tmp_path: Path
) -> None:
    """Both are stamped late. One that is recorded much later after its stamps is taken for another device's."""
    make, late_ns, rng = Messages(2), round(late_s * S), np.random.default_rng(4)
    plain = [item for item in drive(make, seconds=120, status=0, sigma_m=1.0) if item[0] in ("/imu", "/fix")]
    fixes = [m for topic, _, m in plain if topic == "/fix"]
    stamps = np.array([at for topic, at, _ in plain if topic == "/fix"])
    places = DATUM.enu_from_geodetic(
        *(np.array([getattr(m, k) for m in fixes]) for k in ("latitude", "longitude", "altitude"))
    )
    speeds = np.gradient(places, 0.2, axis=0) + 0.05 * rng.normal(size=places.shape)
    lla = DATUM.geodetic_from_enu(places + noise_m * rng.normal(size=places.shape))
    items = [item for item in plain if item[0] == "/imu"]
    for at, place, v in zip((stamps + late_ns).tolist(), lla, speeds, strict=True):
        items.append(("/fix", at, make.fix(at, place[0], place[1], place[2], 0, np.eye(3).ravel())))
        items.append(("/vel", at + round(way_s * S), make.twist(at, v)))
    found, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    told = way_s < 0.1
    assert (found.gnss[0].late_by == "/vel") == told
    assert config.sensors["gnss"].time_offset_s == pytest.approx(-late_s * told, abs=0.06)
    assert ("the motion of /vel, taken for the same receiver's, -0." in text) == told


@pytest.mark.parametrize(("over_s", "noise_m"), [(2.0, 0.05), (2.0, 0.2), (1.0, 0.05), (1.0, 0.5), (0.0, 0.05)])
def test_a_velocity_that_is_filtered_tells_nothing_of_the_fixes(over_s: float, noise_m: float, tmp_path: Path) -> None:
    """Plotters average course and speed over seconds, and the place not at all: their fixes were drafted as late as their velocities."""
    make = Messages(2)
    plain = [
        item for item in drive(make, seconds=120, noise_m=noise_m, status=0, sigma_m=1.0) if item[0] != "/wheel/odom"
    ]
    exact = [m for topic, _, m in drive(make, seconds=120) if topic == "/fix"]
    stamps = [at for topic, at, _ in plain if topic == "/fix"]
    places = DATUM.enu_from_geodetic(
        *(np.array([getattr(m, k) for m in exact]) for k in ("latitude", "longitude", "altitude"))
    )
    speeds = np.gradient(places, 0.2, axis=0)
    many = round(over_s * 5) + 1
    averaged = np.array([speeds[max(k - many + 1, 0) : k + 1].mean(axis=0) for k in range(len(speeds))])
    items = [*plain, *(("/vel", at, make.twist(at, v)) for at, v in zip(stamps, averaged, strict=True))]
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    assert config.sensors["gnss"].time_offset_s == 0.0
    assert config.sensors["gnss_velocity"].time_offset_s == pytest.approx(-over_s / 2.0, abs=0.15)
    assert ("so late, it is filtered" in text) == (over_s > 1.2)
    assert config.sensors["gnss_velocity"].min_sigma_mps == (
        1.0 if over_s > 1.2 else VelocityConfig(topic="/vel").min_sigma_mps
    )


def test_fixes_that_are_none_make_no_receiver_without_heights(tmp_path: Path) -> None:
    """Before its first fix a receiver may say a place without a height: its heights were not said, though all fixes have one."""
    make, items = Messages(2), list[Item]()
    for k in range(100):
        at, none = START_NS + k * S, k < 60
        items.append(("/fix", at, make.fix(at, lat=57.7 + 1e-5 * k, height=np.nan if none else 40.0, status=-none)))
    found, _, _ = look(tmp_path, items, make)
    assert found.gnss[0].without_height == 0
    assert ", 40.0 m" in render(found)


@pytest.mark.parametrize("beside", [False, True])
def test_far_fewer_fixes_are_no_better_beside_a_filter(beside: bool, tmp_path: Path) -> None:
    """A filter says the place at any rate: beside it, all receivers had few fixes, and heights alone told the best one."""
    make, items = Messages(2), list[Item]()
    for k in range(1000):
        at, lat = START_NS + k * S // 20, 57.7 + 1e-6 * k
        if k % 2 == 0:
            items.append(("/flat", at, make.fix(at, lat=lat, height=np.nan)))
        if k % 20 == 0:
            items.append(("/high", at, make.fix(at, lat=lat)))
        if beside:
            items.append(("/gps/filtered", at, make.fix(at, lat=lat)))
    found, _, _ = look(tmp_path, items, make)
    assert found.gnss[0].topic == "/flat"


@pytest.mark.parametrize(
    ("msgtype", "said"),
    [
        ("velodyne_msgs/msg/VelodyneScan", "velodyne_msgs/VelodyneScan is not read; scans are read as sensor_msgs/PointCloud2"),
        ("isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray", "is not read; tags are found in images"),
    ],
)  # fmt: skip
def test_scans_and_tags_in_other_types_are_named(msgtype: str, said: str, tmp_path: Path) -> None:
    """Nothing was said of them in a bag with an IMU and fixes: their sensors would seem to be missing."""
    make = Messages(2)
    make.register("std_msgs/Header header\nuint8[] data", msgtype)
    packet = make.t[msgtype](header=make.header(START_NS), data=np.zeros(4, np.uint8))
    found, _, _ = look(tmp_path, [*drive(make, seconds=20), ("/odd", START_NS + 20 * S, packet)], make)
    assert [w for w in found.warnings if w.startswith("/odd: ") and said in w]


def cloud(make: Messages, stamp_ns: int, frame: str) -> Any:
    """An empty `PointCloud2`."""
    return make.t["sensor_msgs/msg/PointCloud2"](
        header=make.header(stamp_ns, frame), height=1, width=0, fields=[], is_bigendian=False, point_step=12, row_step=0,
        data=np.zeros(0, np.uint8), is_dense=True,
    )  # fmt: skip


def aerial_of(tmp_path: Path, items: list[Item], make: Messages) -> tuple[Inspection, str, AerialConfig]:
    """Inspection, draft, and its aerial block."""
    found = inspect_bag(hold_bag(tmp_path / "run", make, sorted(items, key=lambda item: item[1])))
    text = draft_config(found)
    (tmp_path / "vessel.yaml").write_text(text)
    aerial = load_config(tmp_path / "vessel.yaml", factors.KINDS).sensors["aerial"]
    assert isinstance(aerial, AerialConfig)
    return found, text, aerial


def test_clouds_that_are_no_scans_of_their_own_are_left_out(tmp_path: Path) -> None:
    """What was made of a scan counts it twice; what a program placed in the world is in no LiDAR's axes."""
    make, drafted = Messages(2), {"/bow": "bow", "/stern/points": "stern", "/left": "base_link", "/right": "base_link"}
    others = {
        "/bow/filtered": "bow",
        "/stern/points_raw": "stern",
        "/cloud_registered": "camera_init",
        "/camera/depth/points": "d",
    }
    items = [(topic, START_NS + S, cloud(make, START_NS + S, frame)) for topic, frame in (drafted | others).items()]
    found, text, aerial = aerial_of(tmp_path, [*drive(make, seconds=20), *items], make)
    assert sorted(lidar.topic for lidar in aerial.lidars.values()) == ["/bow", "/left", "/right", "/stern/points"]
    assert "# /bow/filtered: left out; in the same frame as /bow" in text
    assert "# /cloud_registered: left out; in the frame 'camera_init'" in text
    assert "# /camera/depth/points: left out; by its name of no LiDAR" in text
    assert "/bow/filtered: 1 scans; left out" in render(found)


@pytest.mark.parametrize(("rate_hz", "submap"), [(20, 1), (80, 8)])
def test_clouds_that_are_parts_of_turns_are_put_together(rate_hz: int, submap: int, tmp_path: Path) -> None:
    """A driver that publishes each packet: alone, they are 'a scan of water alone' or 'too few to match'."""
    make = Messages(2)
    stamps = [START_NS + k * S // rate_hz for k in range(20 * rate_hz)]
    items = [*drive(make, seconds=20), *(("/points", t + 1, cloud(make, t, "mast")) for t in stamps)]
    assert aerial_of(tmp_path, items, make)[2].submap == submap
