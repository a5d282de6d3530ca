# SPDX-License-Identifier: Apache-2.0
"""A heading that the motion contradicts is said under way; a craft that goes astern is not."""

from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.signal import lfilter

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario, simulate
from graphloc.factors import gnss, imu
from graphloc.frames import Geodetic, rpy_from_rotation, wrap_angle
from graphloc.measurements import CompassHeading, GnssPosition
from graphloc.online import _heading_check
from graphloc.online._frozen_receiver import FrozenReceiverDetector
from graphloc.online._heading_check import HeadingCheck, _lever_m, first_of
from graphloc.online._live import ReceiverDetectors
from graphloc.recording import Recording
from graphloc.replay import Replayed, replay
from graphloc.solution import Health
from tests.slowly import sparsely, with_few_states

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    scenario = replace(bl_scenario(1, "clean"), duration_s=66.0, pose_hz=0.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=5.0)
    return sparsely(simulate(scenario, 4), 2)


def replayed(recording: Recording, config: VesselConfig) -> Replayed:
    return replay(recording, with_few_states(config, rate_hz=2.5))


def read_as(recording: Recording, sense: float, off_deg: float) -> Recording:
    """A compass whose yaw is counted the other way (-1), from elsewhere."""
    turned = tuple(
        replace(m, yaw_rad=float(wrap_angle(sense * m.yaw_rad + np.radians(off_deg))))
        if isinstance(m, CompassHeading)
        else m
        for m in recording.measurements
    )
    return replace(recording, measurements=turned)


def astern(config: VesselConfig) -> VesselConfig:
    """The same craft, its bow taken for its stern: it goes astern all the way, and all of it agrees."""
    sensors: dict[str, Any] = dict(config.sensors)
    for name in ("imu", "gnss", "compass"):
        (x, y, z), (roll, pitch, yaw) = sensors[name].mount.xyz_m, sensors[name].mount.rpy_deg
        mount = sensors[name].mount.model_copy(update={"xyz_m": (-x, -y, z), "rpy_deg": (roll, pitch, yaw + 180.0)})
        sensors[name] = sensors[name].model_copy(update={"mount": mount})
    return config.model_copy(update={"sensors": sensors})


@pytest.mark.parametrize(("sense", "off_deg"), [(1.0, 90.0), (-1.0, 90.0)])
def test_a_compass_in_other_axes_is_reported_under_way(sense: float, off_deg: float, run: SimulatedRun) -> None:
    """By how much it is off is told as well, as the truth has it."""
    found = replayed(read_as(run.recording, sense, off_deg), run.config)
    (event,) = (line for line in found.solution.stats.events if "the heading is off by about" in line)
    said = [e for e in found.estimates if "the heading is off by about" in e.reason.text]
    assert said
    assert all(e.health is not Health.GOOD for e in said)
    yaw = np.arctan2(said[0].R_world_body[1, 0], said[0].R_world_body[0, 0])
    off = wrap_angle(yaw - run.truth.at(np.array([said[0].stamp_ns])).yaw_rad[0])
    told = float(event.split("off by about ")[1].split(" deg")[0])
    assert wrap_angle(np.radians(told) - off) == pytest.approx(0.0, abs=np.radians(20.0))
    assert all(
        e.heading_bound_95_rad > abs(off) for e in said
    )  # it was known to be wrong, with a bound of some degrees
    assert any("the heading is off by about" in line for line in found.solution.stats.warnings)


def test_nothing_is_reported_of_a_craft_that_goes_astern(run: SimulatedRun) -> None:
    found = replayed(run.recording, astern(run.config))
    track = found.solution.trajectory
    turned = wrap_angle(track.yaw_rad - run.truth.at(track.stamps_ns).yaw_rad - np.pi)
    assert np.median(np.abs(turned)) < np.radians(3.0)
    assert not any("heading is off" in line for line in found.solution.stats.events)


def test_nothing_is_reported_of_a_gyroscope_with_a_bias() -> None:
    """By 0.02 rad/s about the vertical, as cheap ones have, on its back: carried on raw, it turned what is felt by 28 deg."""
    scenario = replace(bl_scenario(1, "clean"), duration_s=70.0, pose_hz=0.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=5.0)
    run = sparsely(simulate(scenario, 4), 2)
    imu = run.recording.imu
    assert imu is not None
    biased, config = replace(imu, gyro_radps=imu.gyro_radps + np.array([0.0, 0.0, 0.02])), run.config
    back = np.diag([1.0, -1.0, -1.0])
    biased = replace(biased, accel_mps2=biased.accel_mps2 @ back, gyro_radps=biased.gyro_radps @ back)
    of_imu = config.sensors["imu"]
    roll, pitch, yaw = rpy_from_rotation(of_imu.mount.R_body_sensor @ back) * 180.0 / np.pi
    mount = of_imu.mount.model_copy(update={"rpy_deg": (roll, pitch, yaw)})
    config = config.model_copy(update={"sensors": config.sensors | {"imu": of_imu.model_copy(update={"mount": mount})}})
    found = replayed(replace(run.recording, imu=biased), config)
    assert not any("heading is off" in line for line in found.solution.stats.events)
    track = found.solution.trajectory
    off = np.degrees(np.abs(wrap_angle(track.yaw_rad - run.truth.at(track.stamps_ns).yaw_rad)))
    assert np.quantile(off, 0.95) < 5.0


@pytest.fixture(scope="module")
def at_two_hertz() -> SimulatedRun:
    scenario = replace(bl_scenario(1, "clean"), duration_s=70.0, pose_hz=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=0.0)
    return simulate(scenario, 4)


def said_of(
    run: SimulatedRun,
    jump_s: tuple[float, float],
    turned_rad: float,
    before_ns: int = 0,
    late_ns: int = 0,
    hangs_s: tuple[float, float] = (0.0, 0.0),
    other_until_s: float = 0.0,
    receivers: int = 1,
) -> list[str]:
    """What is said of an estimate that is right but for its heading, where the fixes are 8 m further east for a while.

    `before_ns`: stamp of a state before, by a clock that was then set back. `late_ns`: by how much the fixes are stamped late. `hangs_s`: when
    the receiver repeats a fix. `other_until_s`: until when another sensor has the fixes, of the same receiver or of another.
    """
    datum, of_imu = app.choose_datum(run.recording, run.config), run.config.sensors["imu"].mount
    assert run.recording.imu is not None
    links = imu.ROW.link(
        run.recording.imu,
        run.config.sensors["imu"],
        of_imu.R_body_sensor,
        datum.gravity_mps2,
    )
    lever = run.config.sensors["gnss"].mount.t_body_sensor_m - of_imu.t_body_sensor_m
    antenna = run.config.sensors["gnss"].model_copy(update={"stamp_sigma_s": 0.05 if late_ns else 0.0})
    receiver = ReceiverDetectors()
    stream = SimpleNamespace(
        row=gnss.ROW, config=antenna, mount=gtsam.Pose3(gtsam.Rot3(), lever), receiver=receiver, frozen_detector=FrozenReceiverDetector()
    )  # fmt: skip
    by_turns = SimpleNamespace(receiver_of=lambda name: name if receivers > 1 else "gnss")
    problem = SimpleNamespace(
        streams={"gnss": stream, "other": stream}, config=by_turns, datum=datum, links=links, R_body_imu=of_imu.R_body_sensor,
        t_body_imu_m=of_imu.t_body_sensor_m,
    )  # fmt: skip
    begin_ns = int(run.truth.stamps_ns[0])
    waiting = deque(replace(m, stamp_ns=m.stamp_ns + late_ns) for m in run.recording.of(GnssPosition))
    check, said, last = HeadingCheck(), list[str](), waiting[0]
    if before_ns:
        at_once: Any = SimpleNamespace(stamp_ns=before_ns)
        check.look(SimpleNamespace(first_ns=before_ns - SECOND // 5, problem=problem, newest=at_once))  # type: ignore[arg-type]
    stamps_ns = range(begin_ns + SECOND // 5, begin_ns + 69 * SECOND, SECOND // 5)
    at = run.truth.at(np.array(stamps_ns))
    assert at.v_world_mps is not None
    for stamp_ns, R, place_m, v_mps in zip(stamps_ns, at.R_world_body, at.p_world_m, at.v_world_mps, strict=True):
        pose = gtsam.Pose3(gtsam.Rot3.Yaw(turned_rad).compose(gtsam.Rot3(R)), place_m)
        newest = SimpleNamespace(
            stamp_ns=stamp_ns, pose=pose, pose_cov=1e-4 * np.eye(6), bias=gtsam.imuBias.ConstantBias()
        )
        lag: Any = SimpleNamespace(first_ns=begin_ns, problem=problem, newest=newest, antennas_off_m=dict)
        while waiting and waiting[0].stamp_ns <= stamp_ns:
            m = waiting.popleft()
            if jump_s[0] <= (m.stamp_ns - begin_ns) / SECOND < jump_s[1]:
                lat, lon, height = m.position
                m = replace(m, position=Geodetic(lat, lon + 8.0 / (111_320.0 * np.cos(np.radians(lat))), height))
            since_s = (m.stamp_ns - begin_ns) / SECOND
            if hangs_s[0] <= since_s < hangs_s[1]:
                m = replace(m, position=last.position)
            last = m
            if since_s < other_until_s:
                m = replace(m, sensor="other")
            hint = gnss.ROW.hint(m, 0.0, datum)
            receiver.repeated_fix.note(m.stamp_ns, hint.p_world_m[:2], (R.T @ v_mps)[:2], 0.1)
            check.note(m, lag)
        if check.look(lag):
            said.append(check.said)
    return said


@pytest.mark.parametrize("jump_s", [(0.0, 0.0), (46.0, 70.0), (54.0, 70.0)], ids=["none", "amid", "later"])
def test_fixes_that_jump_neither_hide_a_wrong_heading_nor_make_one(
    jump_s: tuple[float, float], at_two_hertz: SimulatedRun
) -> None:
    assert len(said_of(at_two_hertz, jump_s, np.radians(70.0))) == 1
    assert said_of(at_two_hertz, jump_s, 0.0) == []


@pytest.fixture(scope="module")
def in_loops() -> SimulatedRun:
    """Turns of 14 deg/s."""
    loops = Scenario(
        path="loops", duration_s=70.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=0.0
    )
    return simulate(loops, 4)


def test_a_receiver_that_hangs_neither_hides_a_wrong_heading_nor_makes_one(
    at_two_hertz: SimulatedRun, in_loops: SimulatedRun
) -> None:
    """Its fixes had been rejected, and yet counted here: on a boat a heading right to 0.3 deg was said to be off by 171 deg."""
    assert len(said_of(at_two_hertz, (0.0, 0.0), np.radians(70.0), hangs_s=(10.0, 25.0))) == 1
    assert said_of(in_loops, (0.0, 0.0), 0.0, hangs_s=(30.0, 45.0)) == []


@pytest.mark.parametrize(("receivers", "other_until_s"), [(1, 35.0), (2, 15.0)], ids=["by turns", "the other dies"])
def test_the_fixes_of_another_sensor_count_where_it_reads_the_receiver_or_has_more(
    receivers: int, other_until_s: float, at_two_hertz: SimulatedRun
) -> None:
    """The first sensor that was heard was the only one for good: a receiver that finds RTK after 25 s was never checked again."""
    found = [
        said_of(at_two_hertz, (0.0, 0.0), off_rad, other_until_s=other_until_s, receivers=receivers)
        for off_rad in (np.radians(70.0), 0.0)
    ]
    assert [len(said) for said in found] == [1, 0]


def test_fixes_that_are_late_make_no_wrong_heading(in_loops: SimulatedRun) -> None:
    """In turns of 14 deg/s a delay of a second added as much to a heading that was 10 deg off, or hid one that was 30 deg off."""
    assert said_of(in_loops, (0.0, 0.0), np.radians(10.0), late_ns=SECOND) == []
    assert len(said_of(in_loops, (0.0, 0.0), np.radians(70.0), late_ns=SECOND)) == 1


def test_a_wrong_heading_is_not_laid_to_fixes_that_are_later_than_stamps_are(in_loops: SimulatedRun) -> None:
    """Fixes that are on time and may be late by about a second, not by any time, which would leave 24 deg unsure in turns."""
    assert len(said_of(in_loops, (0.0, 0.0), np.radians(24.0), late_ns=1)) == 1


def test_a_wrong_heading_is_found_after_the_clock_was_set_back(at_two_hertz: SimulatedRun) -> None:
    an_hour_ahead_ns = int(at_two_hertz.truth.stamps_ns[0]) + 3600 * SECOND
    assert len(said_of(at_two_hertz, (0.0, 0.0), np.radians(70.0), an_hour_ahead_ns)) == 1


def test_the_fit_of_the_first_unknown_holds_also_where_it_hardly_shows() -> None:
    """By the inverse of the information; and where it is nearly as the others, which that inverse cannot tell from being one of them."""
    rng = np.random.default_rng(4)
    design, observed = (rng.normal(size=(2, *size)).T @ [1.0, 1j] for size in ((3, 40), (40,)))
    priors, sigma = np.array([0.1, 20.0]), 0.3
    information = design.conj().T @ design / sigma**2 + np.diag([0.0, *priors**-2.0])
    expected = np.linalg.solve(information, design.conj().T @ observed / sigma**2)[0]
    fit = first_of(design, observed, sigma, priors)
    assert fit is not None
    assert fit.rho == pytest.approx(expected)
    assert fit.sigma == pytest.approx(np.sqrt(np.linalg.inv(information)[0, 0].real))
    apart, *others = np.linalg.qr(design)[0].T
    faint = first_of(np.column_stack([others[0] + 1e-9 * apart, *others]), observed, sigma, np.full(2, 1e12))
    assert faint is not None
    assert faint.rho * 1e-9 == pytest.approx(apart.conj() @ observed, rel=1e-5)
    assert faint.sigma * 1e-9 == pytest.approx(sigma, rel=1e-5)
    assert first_of(design * [0.0, 1.0, 1.0], observed, sigma, priors) is None


def test_an_antenna_swings_about_the_imu_by_its_distance_from_there() -> None:
    """3 m by its mount, which is from the IMU, and 1 m more as the run has found; not less by where the IMU is."""
    stream = SimpleNamespace(mount=gtsam.Pose3(gtsam.Rot3(), np.array([3.0, 0.0, 0.0])))
    problem = SimpleNamespace(streams={"gnss": stream}, t_body_imu_m=np.array([5.0, 0.0, 0.0]))
    lag: Any = SimpleNamespace(problem=problem, antennas_off_m=lambda: {"gnss": np.array([1.0, 0.0, 0.0])})
    np.testing.assert_allclose(_lever_m(lag, "gnss"), [4.0, 0.0, 0.0])


@pytest.mark.parametrize("alike", [0.0, 0.5, 0.9])
def test_residuals_that_last_count_as_fewer(alike: float) -> None:
    """As many as make the mean of independent ones scatter as theirs do; else a vibrating IMU made the heading 46 deg off, 'known' to 9."""
    rng, n = np.random.default_rng(1), 200
    noise = rng.normal(size=(2000, n)) + 1j * rng.normal(size=(2000, n))
    drawn = lfilter([np.sqrt(1.0 - alike**2)], [1.0, -alike], noise, axis=1)[:, n // 4 :]
    scatter = float(np.mean(np.abs(drawn.mean(axis=1)) ** 2) / np.mean(np.abs(drawn) ** 2))
    counted = float(np.median([_heading_check._independent(one) for one in drawn]))  # noqa: SLF001
    assert counted == pytest.approx(1.0 / scatter, rel=0.15)
