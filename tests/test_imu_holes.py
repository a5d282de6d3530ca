# SPDX-License-Identifier: Apache-2.0
"""What is made of a hole in the IMU's data: a vessel goes on as it did, upright; where to, nobody knows."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from graphloc import app, keys
from graphloc.build import Problem, bridged, make_problem
from graphloc.config import ImuConfig
from graphloc.eval.simulate import Scenario
from graphloc.factors import INERTIAL, SENSORS
from graphloc.factors.imu import ROW
from graphloc.frames import Array
from graphloc.inertial import GapMotion, InertialLink
from graphloc.measurements import ImuSeries, Measurement
from tests.faults import arrivals_of, feed, numbered
from tests.slowly import simulate_slowly
from tests.test_online_faults import smoother

G = 9.81
RATE_HZ, S = 100, 1_000_000_000
UPRIGHT = np.eye(3)
BIAS = gtsam.imuBias.ConstantBias()


def imu_of(gyro: Array, accel: Array, silent_s: tuple[float, float], R_body_imu: Array) -> ImuSeries:
    """Samples (N, 3) in body axes at 100 Hz as an IMU with this mount says them, but for those in a span."""
    t_s = np.arange(len(gyro)) / RATE_HZ
    kept = (t_s <= silent_s[0]) | (t_s >= silent_s[1])
    return ImuSeries(
        sensor="imu",
        stamps_ns=np.round(t_s[kept] * S).astype(np.int64),
        accel_mps2=(accel @ R_body_imu)[kept],
        gyro_radps=(gyro @ R_body_imu)[kept],
        seqs=np.arange(int(kept.sum())),
    )


def across(imu: ImuSeries, from_s: float, to_s: float, R_body_imu: Array = UPRIGHT) -> tuple[gtsam.NavState, Array]:
    """The state that a span makes of one that goes level at 3 m/s along x, and the covariance (9, 9) of the step."""
    pim = ROW.link(imu, ImuConfig(), R_body_imu, G).integrate(int(from_s * S), int(to_s * S), BIAS)
    start = gtsam.NavState(gtsam.Pose3(), np.array([3.0, 0.0, 0.0]))
    return pim.predict(start, BIAS), np.asarray(pim.preintMeasCov())


def level(n: int) -> tuple[Array, Array]:
    """Rates and forces (n, 3) of a vessel that goes straight and level."""
    return np.zeros((n, 3)), np.tile([0.0, 0.0, G], (n, 1))


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (np.pi / 2, 0.0, 0.4), (np.pi, 0.0, 0.0)])
def test_how_far_a_hole_leads_is_unknown_as_said(rpy: tuple[float, float, float]) -> None:
    """1 m/s^2 and 0.2 rad/s that are white: sigma_v = a sqrt(T), sigma_p = a sqrt(T^3 / 3); roll and pitch stay within 0.2 rad."""
    R = gtsam.Rot3.RzRyRx(*rpy).matrix()
    gyro, accel = level(4000)
    there, cov = across(imu_of(gyro, accel, (15.0, 28.0), R), 15.0, 28.0, R)
    sigmas = np.sqrt(np.diag(cov))
    assert sigmas[:2] == pytest.approx([0.2, 0.2], rel=0.05)
    assert sigmas[2] == pytest.approx(0.2 * np.sqrt(13.0), rel=0.05)
    assert sigmas[3:6] == pytest.approx(np.full(3, np.sqrt(13.0**3 / 3.0)), rel=0.02)
    assert sigmas[6:] == pytest.approx(np.full(3, np.sqrt(13.0)), rel=0.02)
    assert there.position() == pytest.approx(np.array([39.0, 0.0, 0.0]), abs=1e-6)


def test_how_fast_it_turns_is_known_to_a_sample_and_not_in_a_hole() -> None:
    """20 mdeg/s/sqrt(Hz) at 100 Hz is 0.2 deg/s of white noise; of 0.2 rad/s/sqrt(Hz) that are forgotten within a second 0.2 rad/s."""
    links = ROW.link(imu_of(*level(4000), (15.0, 28.0), UPRIGHT), ImuConfig(), UPRIGHT, G, 1.5)
    at_ns = np.array([5.0, 15.0, 15.01, 20.0, 28.0, 30.005, 40.3, 42.0]) * S
    sigma_radps = np.sqrt(links.gyro_variance_at(at_ns.astype(np.int64)))
    white, unknown = 1.5 * np.radians(0.2), 0.2
    assert sigma_radps == pytest.approx([white, white, unknown, unknown, white, white, white, unknown], rel=1e-6)


def test_a_wave_is_not_carried_on() -> None:
    """A hole begins and ends while it rolls at 0.1 rad/s and is pushed by 0.5 m/s^2, of waves of 4 s."""
    t_s = np.arange(4000) / RATE_HZ
    gyro, accel = level(len(t_s))
    gyro[:, 0] = 0.1 * np.cos(2 * np.pi * (t_s - 15.0) / 4.0)
    accel[:, 1] += 0.5 * np.cos(2 * np.pi * (t_s - 15.0) / 4.0)
    there, _ = across(imu_of(gyro, accel, (15.0, 27.0), UPRIGHT), 15.0, 27.0)
    # Each side is forgotten within a second: 0.1 rad/s x 1 s of roll, 0.5 m/s from either, of which one is there for 12 s
    assert abs(there.attitude().roll()) < 0.25
    assert np.linalg.norm(there.velocity() - [3.0, 0.0, 0.0]) < 1.1
    assert abs(there.position()[1]) < 0.5 * 12.0 + 1.0


def test_a_turn_and_a_bias_go_on() -> None:
    """Rates that have been there for seconds: 13 s later it points where they lead, of two sides from the one to the other."""
    gyro, accel = level(4000)
    gyro += [0.004, -0.003, 0.05]
    there, _ = across(imu_of(gyro, accel, (15.0, 28.0), UPRIGHT), 15.0, 28.0)
    turned = gtsam.Rot3.Expmap(13.0 * gyro[0])
    assert gtsam.Rot3.Logmap(turned.between(there.attitude())) == pytest.approx(np.zeros(3), abs=1e-3)
    gyro[2700:, 2] = -0.03
    there, _ = across(imu_of(gyro, accel, (15.0, 28.0), UPRIGHT), 15.0, 28.0)
    assert there.attitude().yaw() == pytest.approx(13.0 * 0.01, abs=0.01)
    new = imu_of(gyro[:2820], accel[:2820], (15.0, 28.0), UPRIGHT)  # online: what comes after has just begun
    there, _ = across(new, 15.0, 28.0)
    assert there.attitude().yaw() == pytest.approx(13.0 * 0.05 - 0.08, abs=0.02)


def test_of_a_short_hole_gravity_is_known() -> None:
    """At rest in a swell (10 deg, 4 s), 0.6 s missing within 1.6 s: roll and force belong together, so it stays."""
    t_s = np.arange(4000) / RATE_HZ
    gyro, accel = level(len(t_s))
    roll = np.radians(10.0) * np.sin(2 * np.pi * (t_s - 15.0) / 4.0)
    gyro[:, 0] = np.gradient(roll, t_s)
    accel[:, 1:] = G * np.column_stack([np.sin(roll), np.cos(roll)])
    there, _ = across(imu_of(gyro, accel, (15.5, 16.1), UPRIGHT), 15.0, 16.6)
    assert np.linalg.norm(there.velocity() - [3.0, 0.0, 0.0]) < 0.5


def test_a_bias_that_is_known_is_taken_off_once() -> None:
    """The mean that holds a vessel up holds the bias as well."""
    gyro, accel = level(4000)
    known = gtsam.imuBias.ConstantBias(np.array([0.2, 0.0, 0.0]), np.zeros(3))
    imu = imu_of(gyro, accel + np.array([0.2, 0.0, 0.0]), (15.0, 28.0), UPRIGHT)
    start = gtsam.NavState(gtsam.Pose3(), np.array([3.0, 0.0, 0.0]))
    for about in (known, BIAS):  # as an answer is given, and as a link is laid
        pim = ROW.link(imu, ImuConfig(), UPRIGHT, G).integrate(15 * S, 28 * S, about, GapMotion.of(start, known))
        there = pim.predict(start, known)
        assert there.velocity() == pytest.approx(np.array([3.0, 0.0, 0.0]), abs=1e-6)
        assert there.position() == pytest.approx(np.array([39.0, 0.0, 0.0]), abs=1e-5)


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (np.pi / 2, 0.0, 0.4)])
@pytest.mark.parametrize("from_s", [15.0, 14.9])
def test_who_turns_goes_round(rpy: tuple[float, float, float], from_s: float) -> None:
    """A vessel goes where it points: 13 s at 3 m/s and 0.2 rad/s are 2.6 rad of a circle of 15 m, by a gyroscope with a bias."""
    R = gtsam.Rot3.RzRyRx(*rpy).matrix()
    gyro, accel = level(4000)
    gyro[:, 2], accel[:, 1] = 0.2, 0.6
    known = gtsam.imuBias.ConstantBias(R.T @ [0.1, 0.2, -0.1], R.T @ [0.01, -0.02, 0.015])
    imu = imu_of(gyro + R @ known.gyroscope(), accel + R @ known.accelerometer(), (15.0, 28.0), R)
    start = gtsam.NavState(gtsam.Pose3(gtsam.Rot3.Yaw(0.7), np.zeros(3)), gtsam.Rot3.Yaw(0.7).rotate([3.0, 0.0, 0.0]))
    pim = ROW.link(imu, ImuConfig(), R, G).integrate(int(from_s * S), 28 * S, BIAS, GapMotion.of(start, known))
    turned = 0.2 * (28.0 - from_s)
    round_it = gtsam.Rot3.Yaw(0.7).rotate(15.0 * np.array([np.sin(turned), 1.0 - np.cos(turned), 0.0]))
    there = pim.predict(start, known)
    # In steps of 0.1 s the force turns half a step late: by 0.01 rad, of what it adds to going straight.
    late = 1.02 * 0.01
    straight, onwards = (28.0 - from_s) * start.velocity(), gtsam.Rot3.Yaw(0.7 + turned).rotate([3.0, 0.0, 0.0])
    assert np.linalg.norm(there.position() - round_it) < late * np.linalg.norm(round_it - straight)
    assert np.linalg.norm(there.velocity() - onwards) < late * np.linalg.norm(onwards - start.velocity())


def test_once_a_run_is_solved_its_links_lead_on_as_it_went() -> None:
    """They are laid before anything is known: a bias of 0.3 m/s^2 is taken off twice then, and a turn leaves the velocity behind."""
    run = simulate_slowly(replace(Scenario(path="loops", noise="clean"), duration_s=45.0), seed=2)
    imu, truth = run.recording.imu, run.truth
    assert imu is not None
    t_s = (imu.stamps_ns - imu.stamps_ns[0]) / S
    heard = (t_s <= 20.0) | (t_s >= 33.0)
    columns = {name: getattr(imu, name)[heard] for name in ("stamps_ns", "accel_mps2", "gyro_radps", "seqs")}
    columns["accel_mps2"] = columns["accel_mps2"] + [0.3, 0.0, 0.0]
    recording = replace(run.recording, imu=replace(imu, **columns))
    problem = make_problem(recording, run.config, app.choose_datum(recording, run.config), SENSORS, INERTIAL)
    first, last = (problem.timeline.floor(int(imu.stamps_ns[0]) + at_s * S) for at_s in (20, 33))
    there = truth.at(problem.timeline.stamps_ns[[first]])
    assert there.v_world_mps is not None
    begun = gtsam.NavState(gtsam.Pose3(gtsam.Rot3(there.R_world_body[0]), there.p_world_m[0]), there.v_world_mps[0])
    bias = gtsam.imuBias.ConstantBias(np.array([0.3, 0.0, 0.0]), np.zeros(3))
    values = gtsam.Values()
    values.insert(keys.pose(first), begun.pose())
    values.insert(keys.velocity(first), begun.velocity())
    values.insert(keys.bias(int(problem.timeline.slow_of[first])), bias)

    def sideways_mps(made: Problem) -> float:
        state = begun
        for k in range(first, last):
            state = made.preintegrated[k].predict(state, bias)
        return float(np.linalg.norm((state.bodyVelocity() - begun.bodyVelocity())[:2]))

    # What it turned at either side is forgotten within a second, in which the heading gets ahead of the velocity.
    assert sideways_mps(problem) > 1.5
    assert sideways_mps(bridged(problem, values)) < 0.6


def test_across_a_short_hole_it_goes_as_on_both_sides() -> None:
    """A turn that grows from 0.6 to 0.9 rad/s in 0.6 s: as good as straight between both; the seconds around have 0.5 rad/s."""
    t_s = np.arange(3000) / RATE_HZ
    gyro, accel = level(len(t_s))
    gyro[:, 2] = np.clip(0.5 * (t_s - 15.0), 0.0, 1.0)
    there, _ = across(imu_of(gyro, accel, (16.2, 16.8), UPRIGHT), 16.2, 16.8)
    assert there.attitude().yaw() == pytest.approx(0.45, abs=0.01)


def test_two_samples_that_are_far_apart_are_no_mean() -> None:
    """6 s between two samples of which one says 0.3 rad/s; the other side of the hole has ten seconds of none."""
    gyro, accel = level(4000)
    gyro[:1000, 2] = 0.3
    imu = imu_of(gyro, accel, (15.0, 28.0), UPRIGHT)
    t_s = imu.stamps_ns / S
    alone = (t_s >= 28.0) | np.isin(imu.stamps_ns, [9 * S, 15 * S])
    columns = {name: getattr(imu, name)[alone] for name in ("stamps_ns", "accel_mps2", "gyro_radps", "seqs")}
    there, _ = across(replace(imu, **columns), 15.0, 28.0)
    assert there.attitude().yaw() == pytest.approx(0.0, abs=1e-6)


def test_after_the_last_sample_it_is_a_hole_as_well() -> None:
    """What it rolled by then is forgotten within a second, and how unsure it is grows; less than a hole is as the sample says."""
    gyro, accel = level(2000)
    gyro[-20:, 0] = 0.1
    imu = imu_of(gyro, accel, (99.0, 99.0), UPRIGHT)
    end_s = float(imu.stamps_ns[-1]) / S
    near, near_cov = across(imu, end_s, end_s + 0.4)
    far, far_cov = across(imu, end_s, end_s + 8.0)
    assert near.attitude().roll() == pytest.approx(0.04, rel=0.01)
    assert far.attitude().roll() == pytest.approx(0.1, abs=0.03)
    assert np.sqrt(near_cov[3, 3]) < 0.02
    assert np.sqrt(far_cov[3, 3]) == pytest.approx(np.sqrt(8.0**3 / 3.0), rel=0.02)


@pytest.mark.parametrize("calls", [1, 13, 130])
@pytest.mark.parametrize("begun_s", [0.0, -0.05])
def test_one_silence_tilts_by_one_bound(calls: int, begun_s: float) -> None:
    """0.2 rad of roll and pitch in 13 s after the last sample, in however many steps they are asked for."""
    imu = imu_of(*level(2000), (99.0, 99.0), UPRIGHT)
    end_s = float(imu.stamps_ns[-1]) / S
    asked = end_s + np.linspace(begun_s, 13.0, calls + 1)
    variance = np.sum([np.diag(across(imu, a, b)[1])[:3] for a, b in pairwise(asked)], axis=0)
    # Asked for often, half a second goes by as the last sample says: of the fading density, exp(-0.5) is left.
    assert np.all(np.sqrt(variance[:2]) < 0.202)
    assert np.all(np.sqrt(variance[:2]) > 0.2 * np.exp(-0.25) - 0.002)
    assert np.sqrt(variance[2]) == pytest.approx(0.2 * np.sqrt(13.0), rel=0.03)


def test_online_it_is_back_at_once_after_a_silence_of_everything() -> None:
    """As where a cable or a switch goes: no sensor for 13 s. Tried with the hole interpolated across, it was 60 m off for 16 s."""
    scenario = Scenario(path="loops", noise="drift", duration_s=42.0, imu_hz=50.0, gnss_hz=4.0, compass_hz=2.0)
    run = simulate_slowly(scenario, 1, 5.0)
    begin_ns = int(run.truth.stamps_ns[0]) + 26 * S
    over_ns = begin_ns + 13 * S
    left = [a for a in arrivals_of(run) if not (begin_ns <= a.true_ns < over_ns and isinstance(a.m, Measurement))]
    fed = feed(smoother(run), run, numbered(left))
    assert fed.recovered_s(over_ns) < 1.0
    assert not [event for event in fed.events if "restarts" in event or "rebuilt" in event]


@pytest.mark.parametrize("silent_s", [1.5, 3.0])
def test_after_a_silence_the_biases_may_be_others(silent_s: float) -> None:
    """A quarter of what they are when it is switched on, 10 mg and 2 deg/s, beside their walk; as much in parts, and where samples come one by one."""
    still = np.zeros((20 * RATE_HZ, 3))
    whole = imu_of(still, np.tile([0.0, 0.0, G], (len(still), 1)), (10.0, 10.0 + silent_s), UPRIGHT)
    links = ROW.link(whole, ImuConfig(), UPRIGHT, G)
    grown = ROW.link(whole.where(slice(5 * RATE_HZ)), ImuConfig(), UPRIGHT, G)
    for k in range(5 * RATE_HZ, len(whole)):
        grown.extend(whole.stamps_ns[k : k + 1], np.hstack([whole.accel_mps2, whole.gyro_radps])[k : k + 1])

    def variance(link: InertialLink, from_s: float, to_s: float) -> Array:
        return link.bias_steps(int(from_s * S), int(to_s * S)) ** 2

    walk = variance(links, 4.0, 9.0)
    another = np.array([0.0025 * 9.80665] * 3 + [np.radians(0.5)] * 3) ** 2
    expected = walk + another * (silent_s > 2.0)
    for link in (links, grown):
        assert variance(link, 9.0, 14.0) == pytest.approx(expected, rel=1e-6)
        assert variance(link, 9.0, 11.0) + variance(link, 11.0, 14.0) == pytest.approx(expected, rel=1e-6)
        link.forget(18 * S)  # the window has passed it, but how far a bias has gone in a minute is still asked
        assert variance(link, 9.0, 14.0) == pytest.approx(expected, rel=1e-6)
    links.pause(10 * S, int((10.0 + silent_s) * S))  # of all sensors: the recorder's
    assert variance(links, 9.0, 14.0) == pytest.approx(walk, rel=1e-6)


def test_only_a_silence_makes_other_biases() -> None:
    """Not samples that came and were left out, nor late ones; a pause of all sensors for as long as a power cycle takes does."""
    still = np.zeros((40 * RATE_HZ, 3))
    whole = imu_of(still, np.tile([0.0, 0.0, G], (len(still), 1)), (0.0, 0.0), UPRIGHT)
    rows = np.hstack([whole.accel_mps2, whole.gyro_radps])
    missing = (whole.stamps_ns > 10 * S) & (whole.stamps_ns < 30 * S)

    def gone(link: InertialLink) -> float:
        return float(link.bias_steps(9 * S, 31 * S)[5] / link.bias_steps(9 * S, 10 * S)[5])

    late, silent, thinned = (ROW.link(whole.where(~missing), ImuConfig(), UPRIGHT, G) for _ in range(3))
    only_walk, another = gone(ROW.link(whole, ImuConfig(), UPRIGHT, G)), gone(silent)
    assert only_walk == pytest.approx(np.sqrt(22.0))
    assert another > 10.0 * only_walk
    late.extend(whole.stamps_ns[missing], rows[missing])
    thinned.leave_out(10 * S, 30 * S - 1)  # as where a window is rebuilt without them
    out = ROW.link(whole.where(whole.stamps_ns < 30 * S), ImuConfig(), UPRIGHT, G)
    out.leave_out(10 * S, 30 * S - 1)
    out.extend(whole.stamps_ns[whole.stamps_ns >= 30 * S], rows[whole.stamps_ns >= 30 * S])
    assert [gone(link) for link in (late, thinned, out)] == pytest.approx([only_walk] * 3)
    silent.pause(10 * S, 30 * S)
    assert gone(silent) == pytest.approx(another)
