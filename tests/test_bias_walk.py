# SPDX-License-Identifier: Apache-2.0
"""Biases of an IMU that wander by more than configured: one that warms up, or a cheap one."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc import app
from graphloc.config import ImuConfig
from graphloc.config._instruments import STANDARD_GRAVITY_MPS2
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.frames import Array, wrap_angle
from graphloc.judge.bias_walk import MOST_TIMES
from graphloc.online._bias_walk import BiasWalk
from graphloc.online._lag import Lag
from graphloc.online._waiting import Waiting
from graphloc.replay import replay
from graphloc.solution import Solution
from tests.faults import arrivals_of, feed
from tests.slowly import simulate_slowly
from tests.test_online_faults import smoother

SECOND = 1_000_000_000
IMU = ImuConfig.model_validate({"topic": "/imu"})
RUN = Scenario(path="loops", duration_s=90.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0)


def with_gyro_bias(run: SimulatedRun, bias_radps: Array) -> SimulatedRun:
    """The run with this (N, 3) on its gyroscopes."""
    imu = run.recording.imu
    assert imu is not None
    return replace(run, recording=replace(run.recording, imu=replace(imu, gyro_radps=imu.gyro_radps + bias_radps)))


def with_imu(run: SimulatedRun, **settings: object) -> SimulatedRun:
    imu = run.config.sensors["imu"].model_copy(update=settings)
    return replace(run, config=run.config.with_sensors({"imu": imu}))


@pytest.fixture(scope="module")
def cold() -> SimulatedRun:
    return simulate_slowly(RUN, 1, 1.25)


@pytest.fixture(scope="module")
def warm(cold: SimulatedRun) -> SimulatedRun:
    """Its bias settles by 0.3 deg/s in a minute, by fifty times what is configured."""
    imu = cold.recording.imu
    assert imu is not None
    settles = np.radians(0.3) * np.exp(-(imu.stamps_ns - imu.stamps_ns[0]) * 1e-9 / 40.0)
    return with_gyro_bias(cold, settles[:, None] * [0.5, -0.5, 0.7])


def heading(run: SimulatedRun, solution: Solution) -> tuple[float, float]:
    """Largest error of the heading, deg, and the share inside its bounds."""
    track = solution.trajectory
    assert track.cov is not None
    off = np.abs(wrap_angle(track.yaw_rad - run.truth.at(track.stamps_ns).yaw_rad))
    return float(np.degrees(off.max())), float(np.mean(off < 1.96 * np.sqrt(track.cov[:, 5, 5])))


def lines(solution: Solution) -> list[str]:
    return [w for w in solution.stats.warnings if "biases change more" in w or "changes within" in w]


def test_a_gyroscope_that_warms_up_keeps_its_heading(cold: SimulatedRun, warm: SimulatedRun) -> None:
    """Held to its configured walk, its heading is over 2 deg off."""
    steady = smooth_run(cold)
    assert not lines(steady)
    found = smooth_run(warm)
    (said,) = lines(found)
    assert "gyro_bias_instability_deg_per_h is 20, " in said
    off_deg, inside = heading(warm, found)
    assert off_deg < 1.0
    assert inside > 0.9


def test_vibration_is_noise_and_no_walk() -> None:
    """The biases follow noise that is configured too small: of a shaken car they were said to walk by 675 times more, and the heading was 6 deg off."""
    run, shaken_mps2 = simulate_slowly(RUN, 2, 1.25), 1.0
    imu = run.recording.imu
    assert imu is not None
    accel_mps2 = imu.accel_mps2 + np.random.default_rng(3).normal(0.0, shaken_mps2, imu.accel_mps2.shape)
    found = smooth_run(replace(run, recording=replace(run.recording, imu=replace(imu, accel_mps2=accel_mps2))))
    assert not lines(found)
    (said,) = (w for w in found.stats.warnings if "its noise is configured too small" in w)
    taken_ug = float(said.split("accel_noise_ug_per_sqrt_hz is 300, ")[1].split(" ")[0])
    true_ug = shaken_mps2 / np.sqrt(50.0) / STANDARD_GRAVITY_MPS2 * 1e6
    assert 0.5 * true_ug < taken_ug < 1.1 * true_ug


def test_a_walk_that_is_not_to_be_raised_is_said(warm: SimulatedRun) -> None:
    held = with_imu(warm, adapt_noise=False)
    found = smooth_run(held)
    (said,) = lines(found)
    assert "a bias of its gyroscopes changes within 60 s by" in said
    assert float(said.split("set gyro_bias_instability_deg_per_h: ")[1].split(" ")[0]) > 4.0 * 20.0
    assert heading(held, found)[0] > 2.0
    assert not lines(smooth_run(with_imu(held, gyro_bias_instability_deg_per_h=600.0)))


def test_an_imu_that_is_switched_off_comes_back_with_other_biases(cold: SimulatedRun) -> None:
    """3 s without it, half a minute before the end; 0.7 deg/s and 4 mg more. Online such a boat was 97 m off, her antenna 25 m from its mount."""
    imu = cold.recording.imu
    assert imu is not None
    at_s = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    later = (at_s > 58.0)[:, None]
    changed = replace(
        imu,
        accel_mps2=imu.accel_mps2 + later * np.array([0.03, -0.04, 0.02]),
        gyro_radps=imu.gyro_radps + later * np.radians([0.3, -0.3, 0.7]),
    )
    silent = changed.where((at_s <= 55.0) | (at_s >= 58.0))
    run = replace(cold, recording=replace(cold.recording, imu=silent))
    for found in (smooth_run(run), replay(run.recording, run.config).solution):
        assert not lines(found)
        assert heading(run, found)[0] < 3.0
        off = np.linalg.norm(
            (found.trajectory.p_world_m - run.truth.at(found.trajectory.stamps_ns).p_world_m)[:, :2], axis=1
        )
        assert off.max() < 2.0


def smooth_run(run: SimulatedRun) -> Solution:
    return app.smooth_recording(run.recording, run.config).solution


def test_the_walk_is_found_as_it_is(cold: SimulatedRun) -> None:
    """A random walk of twenty times the configured density."""
    times, imu, sensor = 20.0, cold.recording.imu, cold.config.sensors["imu"]
    assert imu is not None
    steps = np.random.default_rng(5).standard_normal((len(imu), 3)) * sensor.gyro_bias_walk_radps * np.sqrt(1.0 / 50.0)
    (said,) = lines(smooth_run(with_gyro_bias(cold, times * np.cumsum(steps, axis=0))))
    assert "accel" not in said
    taken = float(said.split("is 20, ")[1].split(" ")[0]) / sensor.gyro_bias_instability_deg_per_h
    assert 0.5 * times < taken < 2.0 * times


def test_online_the_walk_is_raised_under_way(cold: SimulatedRun, warm: SimulatedRun) -> None:
    steady, found = (replay(run.recording, run.config).solution for run in (cold, warm))
    assert not lines(steady)
    assert "gyro_bias_instability_deg_per_h is 20, " in lines(found)[-1]
    late = found.trajectory.where(found.trajectory.stamps_ns > found.trajectory.stamps_ns[0] + 75 * SECOND)
    off = np.abs(wrap_angle(late.yaw_rad - warm.truth.at(late.stamps_ns).yaw_rad))
    assert (
        np.degrees(off.max()) < 3.0
    )  # 10 without more walk, 6 where what was estimated without it is not believed less


def test_what_a_long_start_found_is_taken(warm: SimulatedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its walk was said to be taken, and was not."""
    begin_ns = int(warm.truth.stamps_ns[0])
    monkeypatch.setattr(Waiting, "due", lambda _self, newest_ns: newest_ns - begin_ns > 86 * SECOND)
    monkeypatch.setattr(BiasWalk, "changed", lambda *_: "")
    online = smoother(warm)
    fed = feed(online, warm, arrivals_of(warm))
    (said,) = [event for event in fed.events if "biases change more" in event]
    tracking = online._tracking  # noqa: SLF001 - the walk is in no output
    assert tracking is not None
    taken = tracking.lag.problem.links.bias_steps(0, SECOND)[3:] / IMU.gyro_bias_walk_radps
    assert taken == pytest.approx(float(said.split("is 20, ")[1].split(" ")[0]) / 20.0, rel=0.01)
    assert taken.min() > 2.0


def test_a_window_that_is_built_anew_forgets_what_was_known(
    cold: SimulatedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What data told that are weighed otherwise now, or are left out, is no measure of how far a bias goes."""
    begin_ns, whole, begun, again = int(cold.truth.stamps_ns[0]), Lag.commit, BiasWalk.begin, list[int]()

    def counted(self: BiasWalk) -> None:
        again.append(1)
        begun(self)

    def fails(_self: Lag, **_options: bool) -> None:
        monkeypatch.setattr(Lag, "commit", whole)
        monkeypatch.setattr(BiasWalk, "begin", counted)
        raise RuntimeError("planted")

    online, came = smoother(cold), arrivals_of(cold)
    feed(online, cold, [a for a in came if a.m.stamp_ns - begin_ns < 9 * SECOND])
    monkeypatch.setattr(Lag, "commit", fails)
    fed = feed(online, cold, [a for a in came if 9 * SECOND <= a.m.stamp_ns - begin_ns < 11 * SECOND])
    assert any("rebuilt" in event for event in fed.events)
    assert again == [1]


# A Kalman filter of six biases, each measured once a second


def filtered(walk: BiasWalk, times: Array, seconds: int, rng: Any) -> list[str]:
    """What is said of an estimate of biases (6,) that walk `times` as much as configured, filtered as if with the walk that is taken."""
    true, b, P = np.zeros(6), np.zeros(6), np.full(6, 1e-6)
    configured = np.array([IMU.accel_bias_walk_mps2] * 3 + [IMU.gyro_bias_walk_radps] * 3)
    measured, said = 3.0 * configured, []
    config = SimpleNamespace(sensors={"imu": IMU})
    for k in range(seconds):
        taken = configured * np.repeat(walk.times, 3)
        true = true + times * configured * rng.standard_normal(6)
        gain = (P + taken**2) / (P + taken**2 + measured**2)
        b = b + gain * (true + measured * rng.standard_normal(6) - b)
        P = (1.0 - gain) * (P + taken**2)
        newest = SimpleNamespace(
            stamp_ns=k * SECOND, pose=gtsam.Pose3(), pose_cov=np.eye(6) * 1e-4, bias_cov=np.diag(P),
            bias=gtsam.imuBias.ConstantBias(b[:3], b[3:]),
        )  # fmt: skip
        links = SimpleNamespace(bias_steps=lambda a, b, taken=taken: taken * np.sqrt((b - a) / SECOND))
        lag: Any = SimpleNamespace(newest=newest, problem=SimpleNamespace(links=links, config=config))
        if line := walk.changed(lag, lambda: SimpleNamespace(sensor="imu")):  # type: ignore[arg-type,return-value]
            said.append(line)
            walk.begin()
    return said


def test_a_walk_as_configured_is_never_raised() -> None:
    """Three hours of six biases."""
    walk = BiasWalk()
    assert not filtered(walk, np.ones(6), 3 * 3600, np.random.default_rng(1))


def test_a_walk_that_is_needed_no_more_is_lowered() -> None:
    """To what the biases go at most, and never below what is configured; those of accelerometers still go that far."""
    walk, times = BiasWalk(), np.repeat([10.0, 1.0], 3)
    walk.times[:] = 10.0
    said = filtered(walk, times, 1800, np.random.default_rng(4))
    assert said
    assert all("change less than before: gyro_bias_instability_deg_per_h is 20, " in line for line in said)
    assert walk.times[0] == 10.0
    assert 1.0 <= walk.times[1] < 1.5


@pytest.mark.parametrize("part", [0, 1])
def test_the_walk_is_raised_to_what_it_is(part: int) -> None:
    walk, rng, times = BiasWalk(), np.random.default_rng(2), np.ones(6)
    times[3 * part : 3 * part + 3] = 20.0
    (said, *_) = filtered(walk, times, 600, rng)
    assert ("gyro" in said) == (part == 1)
    assert 8.0 < walk.times[part] < 60.0
    assert walk.times[1 - part] < 1.5


def test_at_its_most_it_is_raised_no_more() -> None:
    """Each line has the window rebuilt: every twenty seconds, for nothing."""
    walk = BiasWalk()
    walk.times[:] = MOST_TIMES
    assert not filtered(walk, np.full(6, 3000.0), 120, np.random.default_rng(3))
    assert (walk.times == MOST_TIMES).all()


def test_where_the_heading_is_hardly_known_nothing_is_told() -> None:
    """It turns the biases of the accelerometers with it."""
    walk, links = BiasWalk(), SimpleNamespace(bias_steps=lambda _from_ns, _to_ns: np.full(6, 1e-5))
    for k in range(10):
        newest = SimpleNamespace(
            stamp_ns=10 * k * SECOND, pose=gtsam.Pose3(), pose_cov=np.diag([1e-4, 1e-4, 0.1, 1.0, 1.0, 1.0]),
            bias=gtsam.imuBias.ConstantBias(np.full(3, float(k)), np.zeros(3)), bias_cov=np.eye(6) * 1e-8,
        )  # fmt: skip
        lag: Any = SimpleNamespace(newest=newest, problem=SimpleNamespace(links=links))
        assert not walk.changed(lag, lambda: pytest.fail("asked for samples"))
