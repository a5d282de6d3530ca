# SPDX-License-Identifier: Apache-2.0
"""Headings against the gyroscope: the other convention, iron, stuck headings; and what must not be said."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc.config import CompassConfig, ImuConfig
from graphloc.errors import InputError
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.frames import Array, wrap_angle
from graphloc.frontends._assess import courses_of_fixes
from graphloc.frontends._run_warnings import _turn_warnings
from graphloc.frontends._turns import (
    Yaws,
    deviation_deg,
    pose_turn_warning,
    refuse_unit,
    scale_warning,
    scattered,
    turn_warnings,
    wander_deg,
    wander_warning,
)
from graphloc.measurements import CompassHeading, GnssPosition, ImuSeries
from graphloc.time import stamps_of
from tests.bagfactory import START_NS, Item, Messages, S
from tests.heldbags import hold_bag, inspect_bag, read_recording
from tests.test_bag_bad_input import accounted, rows_of, vessel


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    """Four minutes of turns, a gyroscope with a bias of 0.5 deg/s."""
    return simulate(
        Scenario(path="loops", duration_s=240.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gyro_bias_radps=0.01), 31
    )


def of(run: SimulatedRun) -> tuple[ImuSeries, list[CompassHeading]]:
    assert run.recording.imu is not None
    return run.recording.imu, run.recording.of(CompassHeading)


def changed(headings: list[CompassHeading], change: Callable[[float], float]) -> list[CompassHeading]:
    return [replace(m, yaw_rad=change(m.yaw_rad)) for m in headings]


def turned(imu: ImuSeries, R: Array) -> ImuSeries:
    return replace(imu, accel_mps2=imu.accel_mps2 @ R.T, gyro_radps=imu.gyro_radps @ R.T)


@pytest.mark.parametrize("offset", [0.0, 2.5])
@pytest.mark.parametrize("axes", ["as it is", "on its back", "on its side"])
def test_good_headings_are_left_alone(offset: float, axes: str, run: SimulatedRun) -> None:
    """Whatever the mount of the IMU, which is not asked, and that of the compass."""
    imu, headings = of(run)
    R = Rotation.from_euler("x", {"as it is": 0.0, "on its back": 180.0, "on its side": 90.0}[axes], degrees=True)
    headings = changed(headings, lambda yaw: yaw + offset)
    assert turn_warnings(turned(imu, R.as_matrix()), "compass", headings, "enu") == []


def test_a_single_heading_in_the_last_block_tells_nothing(run: SimulatedRun) -> None:
    """Blocks are two minutes long: the last heading of a run of exactly two minutes is alone in the second."""
    imu, headings = of(run)
    end_ns = int(imu.stamps_ns[0]) + 120 * S
    first = [m for m in headings if m.stamp_ns < end_ns]
    assert turn_warnings(imu, "compass", [*first, replace(first[-1], stamp_ns=end_ns)], "enu") == []


@pytest.mark.parametrize(("convention", "other"), [("enu", "ned"), ("ned", "enu")])
def test_the_other_convention_is_named(convention: str, other: str, run: SimulatedRun) -> None:
    imu, headings = of(run)
    (line,) = turn_warnings(imu, "compass", changed(headings, lambda yaw: np.pi / 2.0 - yaw), convention)
    assert f"convention: {other}" in line


@pytest.mark.parametrize("against", [False, True])
def test_poses_whose_yaw_turns_the_other_way_are_reported(against: bool, run: SimulatedRun) -> None:
    """As those in north, east, down do; also if every fifth is a false match."""
    imu, headings = of(run)
    yaw = np.array([m.yaw_rad for m in headings])
    yaw = np.pi / 2.0 - yaw if against else yaw
    yaw[::5] = np.random.default_rng(3).uniform(-np.pi, np.pi, len(yaw[::5]))
    lines = pose_turn_warning(imu, "slam", (stamps_of(headings), yaw))
    assert len(lines) == against
    assert all("slam: its yaw turns the other way than imu" in line and "north, east, down" in line for line in lines)


def test_accelerations_of_the_wrong_sign_are_among_the_suspects(run: SimulatedRun) -> None:
    imu, headings = of(run)
    (line,) = turn_warnings(replace(imu, accel_mps2=-imu.accel_mps2), "compass", headings, "enu")
    assert "gravity: inverted" in line


def test_iron_that_turns_with_the_vessel_is_reported(run: SimulatedRun) -> None:
    """10 deg x sin(yaw): 7 deg RMS on headings all around."""
    imu, headings = of(run)
    (line,) = turn_warnings(imu, "compass", changed(headings, lambda yaw: yaw + np.radians(10.0) * np.sin(yaw)), "enu")
    assert "magnetic deviation" in line
    assert turn_warnings(imu, "compass", changed(headings, lambda y: y + np.radians(2.0) * np.sin(y)), "enu") == []


def wandering(
    headings: list[CompassHeading], sigma_deg: float, time_constant_s: float, seed: int = 7
) -> list[CompassHeading]:
    """A first-order Gauss-Markov process on top."""
    rng, error, found, before_ns = np.random.default_rng(seed), 0.0, [], headings[0].stamp_ns - 1000 * S
    for m in headings:
        keep = np.exp(-(m.stamp_ns - before_ns) / S / time_constant_s)
        error = keep * error + np.sqrt(1.0 - keep**2) * np.radians(sigma_deg) * rng.normal()
        before_ns = m.stamp_ns
        found.append(replace(m, yaw_rad=m.yaw_rad + error))
    return found


def test_a_compass_that_wanders_is_told_by_the_gyroscope(run: SimulatedRun) -> None:
    """3 deg that last for 100 s diffuse as 3 sqrt(60 / 100) = 2.3 deg that last for 60 s; a line is taken off, and some of it with that."""
    imu, headings = of(run)
    found = wander_deg(imu, wandering(headings, 3.0, 100.0))
    assert found is not None
    assert 1.2 < found < 3.0
    (line,) = wander_warning(imu, "compass", wandering(headings, 3.0, 100.0), CompassConfig())
    assert f"wanders by {found:.1f} deg" in line
    assert wander_warning(imu, "compass", wandering(headings, 3.0, 100.0), CompassConfig(wander_sigma_deg=2.0)) == []
    calibrated = CompassConfig(mount_offset_sigma_deg=0.0)
    assert wander_warning(imu, "compass", wandering(headings, 3.0, 100.0), calibrated) == [line]


def test_most_of_a_wander_is_told_in_a_short_run(run: SimulatedRun) -> None:
    """What the fitted offset, bias and deviation take of it along was lost: 2.2 deg of 5 were left, and the heading's bounds too small."""
    imu, headings = of(run)
    first_ns = headings[0].stamp_ns
    short = [m for m in headings if m.stamp_ns < first_ns + 150 * S]
    found = [wander_deg(imu, wandering(short, 5.0, 60.0, seed)) for seed in range(12)]
    rms = float(np.sqrt(np.mean(np.square([v for v in found if v is not None]))))
    assert 0.65 * 5.0 < rms < 1.25 * 5.0  # the less of two estimates


def test_iron_that_turns_with_the_vessel_is_measured(run: SimulatedRun) -> None:
    """B of 12 deg is 12 / sqrt(2) as the size of either of B and C; D gets half of the key's sigma."""
    imu, headings = of(run)

    def iron(size_deg: float, times: float) -> list[CompassHeading]:
        return changed(headings, lambda yaw: yaw + np.radians(size_deg) * np.sin(times * yaw))

    assert deviation_deg(imu, iron(12.0, 1.0)) == pytest.approx(8.5, abs=0.5)
    assert deviation_deg(imu, wandering(iron(12.0, 1.0), 1.5, 20.0)) == pytest.approx(8.5, abs=1.5)
    assert deviation_deg(imu, iron(4.0, 2.0)) == pytest.approx(5.7, abs=0.5)


def test_what_is_no_deviation_is_not_taken_for_it(run: SimulatedRun) -> None:
    """Noise, a wander, the gyro's scale, late stamps; and headings that hardly turn, of which no deviation is told."""
    imu, headings = of(run)
    scaled = replace(imu, gyro_radps=1.02 * imu.gyro_radps)
    late = [replace(m, stamp_ns=m.stamp_ns + S // 2) for m in headings]
    said = [
        (imu, headings),
        (imu, wandering(headings, 3.0, 100.0)),
        (scaled, headings),
        (imu, late),
        (imu, headings[:60]),
    ]
    assert [deviation_deg(samples, yaws) for samples, yaws in said] == [None] * len(said)


@pytest.mark.parametrize(("wander_deg_", "low", "high"), [(0.0, 0.0, 0.5), (3.0, 2.0, 3.6)])
def test_waves_are_no_wander(wander_deg_: float, low: float, high: float) -> None:
    """Roll and pitch of 4 and 3 deg (RMS), 90 deg apart, in groups: the rate about the mean vertical went off by 2 deg in a minute."""
    rng, dt_s = np.random.default_rng(3), 0.04
    t = np.arange(0.0, 600.0, dt_s)
    group = 1.0 + 0.7 * np.sin(t / 23.0) + 0.3 * np.sin(t / 9.0)
    roll, pitch = np.radians(5.5) * group * np.sin(1.2 * t), np.radians(4.0) * group * np.cos(1.2 * t)
    yaw = 2.0 * np.sin(t / 40.0)
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    rate = (R[:-1].inv() * R[1:]).as_rotvec() / dt_s
    imu = ImuSeries(
        sensor="imu", seqs=np.arange(len(t)), stamps_ns=np.round(t * S).astype(np.int64),
        accel_mps2=R.inv().apply([0.0, 0.0, 9.81]), gyro_radps=np.vstack([rate, rate[-1:]]) + np.array([0.002, -0.001, 0.003]),
    )  # fmt: skip
    headings = [
        CompassHeading(stamp_ns=int(imu.stamps_ns[k]), sensor="compass", seq=int(k), sigma_rad=1.0,
                       yaw_rad=float(wrap_angle(yaw[k] + np.radians(0.5) * rng.normal())))
        for k in range(0, len(t), 5)
    ]  # fmt: skip
    found = wander_deg(imu, wandering(headings, wander_deg_, 60.0) if wander_deg_ else headings)
    assert found is not None
    assert low <= found < high
    assert turn_warnings(imu, "compass", headings, "enu") == []


def test_headings_of_one_stamp_are_one_heading(run: SimulatedRun) -> None:
    """A receiver's clock that is set back by whole seconds, as from GPS time to UTC, writes the same stamps again: it ended in a traceback."""
    imu, headings = of(run)
    twice = sorted([*headings, *headings], key=lambda m: m.stamp_ns)
    assert wander_deg(imu, twice) == wander_deg(imu, headings)
    assert turn_warnings(imu, "compass", twice, "enu") == []
    assert not scattered(imu, twice).any()


def test_what_is_no_wander_is_not_taken_for_it(run: SimulatedRun) -> None:
    """Noise, the gyro's bias and scale, iron that turns with the vessel, late stamps, a gyro that warms up by 0.5 deg/s."""
    imu, headings = of(run)
    t = (imu.stamps_ns - imu.stamps_ns[0]) / S
    warms = np.radians(0.5) * np.outer(np.exp(-t / 250.0), [0.0, 0.0, 1.0])
    warming = replace(imu, gyro_radps=imu.gyro_radps + warms)
    late = [replace(m, stamp_ns=m.stamp_ns + S // 2) for m in headings]
    scaled = replace(imu, gyro_radps=1.02 * imu.gyro_radps)
    iron = changed(headings, lambda yaw: yaw + np.radians(3.0) * np.sin(yaw))
    for samples, said in ((imu, headings), (scaled, headings), (warming, headings), (imu, late), (imu, iron)):
        found = wander_deg(samples, said)
        assert found is not None
        assert found < 0.6
        assert wander_warning(samples, "compass", said, CompassConfig()) == []
    assert wander_deg(imu, headings[:60]) is None  # too short a time


def test_frozen_headings_are_reported(run: SimulatedRun) -> None:
    imu, headings = of(run)
    stuck = [m if k % 600 < 300 else replace(m, yaw_rad=headings[k - k % 300].yaw_rad) for k, m in enumerate(headings)]
    (line,) = turn_warnings(imu, "compass", stuck, "enu")
    assert "frozen or late" in line


def test_a_hole_in_the_imu_is_no_turn(run: SimulatedRun) -> None:
    """What the vessel turned while the IMU was silent, the gyroscope does not know."""
    imu, headings = of(run)
    t_s = (imu.stamps_ns - imu.stamps_ns[0]) / 1e9
    keep = (t_s < 70.0) | (t_s > 85.0)
    columns = {name: getattr(imu, name)[keep] for name in ("stamps_ns", "accel_mps2", "gyro_radps", "seqs")}
    cut = replace(imu, **columns)
    assert turn_warnings(cut, "compass", headings, "enu") == []


def test_without_turns_or_gravity_nothing_is_reported(run: SimulatedRun) -> None:
    imu, headings = of(run)
    wrong = changed(headings, lambda yaw: -yaw)
    assert turn_warnings(replace(imu, gyro_radps=0.0 * imu.gyro_radps), "compass", wrong, "enu") == []
    level = replace(imu, accel_mps2=imu.accel_mps2 - np.median(imu.accel_mps2, axis=0))
    assert turn_warnings(level, "compass", wrong, "enu") == []


def imu_config(unit: str) -> ImuConfig:
    return ImuConfig.model_validate({"topic": "/imu", "gyro_unit": unit})


def told_by(run: SimulatedRun, source: str) -> Yaws:
    """Headings of the compass, or courses of the fixes."""
    if source == "compass":
        _, headings = of(run)
        return stamps_of(headings), np.array([m.yaw_rad for m in headings])
    courses = courses_of_fixes(run.recording.of(GnssPosition))
    return courses.stamps_ns, courses.course_rad


@pytest.mark.parametrize("source", ["compass", "gnss"])
@pytest.mark.parametrize(("configured", "told"), [("deg/s", "rad/s"), ("rad/s", "deg/s")])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rates_in_another_unit_are_refused(
    sense: float, configured: str, told: str, source: str, run: SimulatedRun
) -> None:
    """180 / pi times too small, or too large; the compass may count the other way beside. The right unit is left alone."""
    imu, _ = of(run)
    stamps, yaw = told_by(run, source)
    times = np.radians(1.0) if configured == "deg/s" else np.degrees(1.0)
    with pytest.raises(InputError, match=rf"set gyro_unit: {told} of sensors\.imu"):
        refuse_unit(
            replace(imu, gyro_radps=times * imu.gyro_radps), imu_config(configured), {source: (stamps, sense * yaw)}
        )
    refuse_unit(imu, imu_config(configured), {source: (stamps, sense * yaw)})


@pytest.mark.parametrize("times", [0.25, 0.5, 1.0, 1.25, 2.0, 16.0])
def test_rates_in_no_unit_are_said(times: float, run: SimulatedRun) -> None:
    """A gyroscope whose driver takes another range for its own; one that is off by a quarter may be the compass's iron."""
    imu, _ = of(run)
    lines = scale_warning(replace(imu, gyro_radps=times * imu.gyro_radps), "compass", told_by(run, "compass"))
    said = f"{max(times, 1.0 / times):.1f} times {'more' if times > 1.0 else 'less'} than the headings of compass"
    assert [said in line for line in lines] == ([True] if times not in (1.0, 1.25) else [])


@pytest.mark.parametrize(("deviation_deg", "said"), [(15.0, False), (30.0, True)])
def test_a_compass_in_iron_that_looks_like_another_range_is_named(
    deviation_deg: float, said: bool, run: SimulatedRun
) -> None:
    """Of a craft that weaves to either side of where its compass turns least: by half of what it does, in step with the gyroscope."""
    imu, _ = of(run)
    t_s = (imu.stamps_ns - imu.stamps_ns[0]) / S
    by_rad = np.radians(40.0) * np.sin(0.1 * t_s)
    up = np.array([0.0, 0.0, 1.0])
    imu = replace(imu, accel_mps2=np.tile(9.81 * up, (len(t_s), 1)), gyro_radps=np.gradient(by_rad, t_s)[:, None] * up)
    compass = by_rad - np.radians(deviation_deg) * np.sin(by_rad)
    at = np.arange(0, len(t_s), 50)
    headings = [
        CompassHeading(
            stamp_ns=int(imu.stamps_ns[i]), sensor="compass", seq=int(i), yaw_rad=float(compass[i]), sigma_rad=0.02
        )
        for i in at
    ]
    readings: Any = SimpleNamespace(sensor="compass", config=None, values=headings, stamps=lambda: imu.stamps_ns[at])
    config: Any = None  # of mounts, for which only a compass is asked
    lines = _turn_warnings(imu, [readings], {}, config)
    assert ["or off by 20 deg or more in iron" in line for line in lines] == [True] * said


@pytest.mark.parametrize("seed", range(20))
def test_headings_that_wander_say_nothing_of_a_unit(seed: int, run: SimulatedRun) -> None:
    """A craft that goes straight on: the gyroscope has its noise, courses wander by 57 times as much."""
    imu, _ = of(run)  # at 100 Hz
    rng = np.random.default_rng(seed)
    rates = np.cumsum(rng.normal(size=(len(imu), 3)), axis=0)
    rates *= 1e-3 / np.abs(rates).max()
    turned, wander = (np.cumsum(rates[:, 2]) / 100.0)[::100], np.cumsum(rng.normal(size=len(imu) // 100))
    turned = turned[: len(wander)]
    wander *= 57.0 * np.std(turned[12:] - turned[:-12]) / np.std(wander[12:] - wander[:-12])
    stamps = imu.stamps_ns[::100][: len(wander)]
    refuse_unit(replace(imu, gyro_radps=rates), imu_config("deg/s"), {"gnss": (stamps, wander)})


@pytest.mark.parametrize("told", ["compass", "pose", "gnss"])
def test_a_bag_in_another_unit_is_refused(told: str, tmp_path: Path) -> None:
    """100 s at 2 m/s, with turns of 115 deg to and fro, told in rad/s and read as deg/s."""
    make = Messages(2)
    items: list[Item] = []
    east = north = 0.0
    for k in range(5000):
        stamp, yaw = START_NS + k * S // 50, 1.0 - np.cos(0.2 * k / 50.0)
        east, north = east + np.cos(yaw) * 2.0 / 50.0, north + np.sin(yaw) * 2.0 / 50.0
        items.append(("/imu", stamp, make.imu(stamp, accel=(0, 0, 9.8), gyro=(0, 0, 0.2 * np.sin(0.2 * k / 50.0)))))
        if k % 10 == 0:
            q = (0.0, 0.0, np.sin(yaw / 2.0), np.cos(yaw / 2.0))
            items.append(("/compass", stamp, make.compass(stamp, q)))
            items.append(("/pose", stamp, make.pose(stamp, (east, north, 0.0), q)))
            items.append(("/gnss", stamp, make.fix(stamp, north / 111e3, east / 111e3)))
    path = hold_bag(tmp_path / "run", make, items)
    sensors = {"gnss": None, told: {"topic": f"/{told}"}}
    read_recording(path, vessel(**sensors, imu={"topic": "/imu"}))
    with pytest.raises(InputError, match=rf"{told}, in step with them.* set gyro_unit: rad/s of sensors\.imu"):
        read_recording(path, vessel(**sensors, imu={"topic": "/imu", "gyro_unit": "deg/s"}))


def test_a_bag_is_looked_at(tmp_path: object) -> None:
    """0.2 rad/s to port, headings that go to starboard."""
    make = Messages(2)
    items: list[Item] = []
    for k in range(1500):
        stamp = START_NS + k * S // 50
        rate = 0.2 * np.sin(0.2 * k / 50.0)
        items.append(("/imu", stamp, make.imu(stamp, accel=(0, 0, 9.8), gyro=(0, 0, rate))))
        if k % 5 == 0:
            half = -0.5 * (1.0 - np.cos(0.2 * k / 50.0))
            items.append(("/compass", stamp, make.compass(stamp, (0, 0, np.sin(half), np.cos(half)))))
            items.append(("/pose", stamp, make.pose(stamp, (0, 0, 0), (0, 0, np.sin(half), np.cos(half)))))
    path = hold_bag(tmp_path / "run", make, items)  # type: ignore[operator]
    for convention, said in (("enu", 1), ("ned", 0)):
        config = vessel(gnss=None, imu={"topic": "/imu"}, compass={"topic": "/compass", "convention": convention})
        found = [w for w in read_recording(path, config).warnings if "turn the other way" in w]
        assert len(found) == said
    poses = vessel(gnss=None, imu={"topic": "/imu"}, pose={"topic": "/pose"})
    assert sum("its yaw turns the other way" in w for w in read_recording(path, poses).warnings) == 1


@pytest.mark.parametrize("hz", [1, 10])
def test_headings_that_have_nothing_to_do_with_each_other_are_no_headings(hz: int, run: SimulatedRun) -> None:
    """As a course over ground at rest: 20 s of any heading, and a single one later."""
    imu, headings = of(run)
    headings = headings[:: 10 // hz]
    rng = np.random.default_rng(4)
    wild = [m.stamp_ns < headings[0].stamp_ns + 20 * S for m in headings]
    alone = 100 * hz
    wild[alone] = True
    mixed = [replace(m, yaw_rad=rng.uniform(-np.pi, np.pi)) if w else m for m, w in zip(headings, wild, strict=True)]
    mixed[alone] = replace(headings[alone], yaw_rad=headings[alone].yaw_rad + 2.0)
    bad = scattered(imu, mixed)
    assert bad[alone]
    # One of seven lies within 30 deg of any course by chance; at the seam the others are right.
    first = 20 * hz
    assert bad[: first - 2 * hz].mean() > 0.9
    assert not bad[first + 2 * hz :][np.arange(len(bad) - first - 2 * hz) != alone - first - 2 * hz].any()


def test_headings_are_not_scattered_for_a_gyroscope_or_convention_that_is_wrong(run: SimulatedRun) -> None:
    imu, headings = of(run)
    assert not scattered(imu, headings).any()
    assert not scattered(replace(imu, gyro_radps=np.degrees(imu.gyro_radps)), headings).any()
    assert not scattered(imu, changed(headings, lambda yaw: np.pi / 2.0 - yaw)).any()
    assert not scattered(imu, headings[:1]).any()


@pytest.mark.parametrize("gyro_times", [1.0, 0.0, -1.0, float(np.degrees(1.0))])
@pytest.mark.parametrize("hz", [1, 2, 10])
@pytest.mark.parametrize("pivot_degps", [30.0, 45.0])
def test_a_pivot_is_not_scattered_whatever_the_gyroscope_says(pivot_degps: float, hz: int, gyro_times: float) -> None:
    """12 s of pivot, begun and ended within half a second, by headings good to 2 deg: they tell a steady turn themselves."""
    t_s = np.arange(6000) / 100.0
    rate = np.radians(pivot_degps) * np.clip(2.0 * np.minimum(t_s % 30.0 - 10.0, 22.0 - t_s % 30.0), 0.0, 1.0)
    rates = np.column_stack([0.0 * rate, 0.0 * rate, gyro_times * rate])
    stamps_ns = START_NS + np.arange(6000) * (S // 100)
    imu = ImuSeries(
        sensor="imu", stamps_ns=stamps_ns, accel_mps2=np.tile([0.0, 0.0, 9.8], (6000, 1)), gyro_radps=rates, seqs=np.arange(6000)
    )  # fmt: skip
    yaw = np.cumsum(rate) / 100.0 + np.radians(2.0) * np.random.default_rng(8).normal(size=6000)
    headings = [
        CompassHeading(stamp_ns=int(stamps_ns[k]), seq=k, sensor="compass", yaw_rad=yaw[k], sigma_rad=0.03)
        for k in range(0, 6000, 100 // hz)
    ]
    assert not scattered(imu, headings).any()


def test_a_bag_with_scattered_headings_has_rows_for_them(tmp_path: Path) -> None:
    """20 s at rest; the compass, which vessel.yaml names before the IMU, says any heading for half of it."""
    make, rng = Messages(2), np.random.default_rng(6)
    items: list[Item] = []
    for k in range(1000):
        stamp = START_NS + k * S // 50
        items.append(("/imu", stamp, make.imu(stamp, accel=(0, 0, 9.8), gyro=(0.0, 0.0, 1e-4 * rng.normal()))))
        if k % 5 == 0:
            half = rng.uniform(-np.pi, np.pi) if k < 500 else 0.3
            items.append(("/compass", stamp, make.compass(stamp, (0, 0, np.sin(half), np.cos(half)))))
    path = hold_bag(tmp_path / "run", make, items)
    recording = read_recording(
        path, vessel(gnss=None, imu=None, compass={"topic": "/compass"}, gyro={"topic": "/imu", "kind": "imu"})
    )
    assert recording.message_count == accounted(recording)
    rows = rows_of(recording, "compass")
    assert 85 <= len(rows) <= 105
    assert all("differs from most headings" in r.reason for r in rows)
    assert any(f"{len(rows)} messages rejected: differs from" in w for w in recording.warnings)
    (compass,) = inspect_bag(path).compasses
    assert f"; {len(rows)} of 200: differs from most headings" in compass.why
