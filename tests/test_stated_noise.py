# SPDX-License-Identifier: Apache-2.0
"""Sensors that are noisier than they state: that is not the IMU's fault, unless they are its own samples."""

import re
from collections.abc import Collection
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphloc import app, keys, solve
from graphloc.build import Problem, make_problem
from graphloc.config import VesselConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import SimulatedRun, bl_scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import wrap_angle
from graphloc.judge import imu_noise
from graphloc.judge.decide import Stage, weigh
from graphloc.judge.scatter import noisier_than_stated, white_scatter
from graphloc.measurements import CompassHeading, Measurement, PoseFix
from graphloc.recording import Recording, quiet
from graphloc.replay import replay
from graphloc.signals.imu_scatter import noise_density
from graphloc.solution import Solution
from graphloc.solve._passes import settle
from graphloc.solve._solution import make_solution
from graphloc.solve._start import solve_start
from graphloc.solve.alignment import align
from graphloc.solve.batch import BatchResult
from graphloc.solve.stretch import unwound
from tests.slowly import slowly

SECOND = 1_000_000_000


def white_of(residuals: np.ndarray, rate_hz: float = 10.0) -> float:
    """Of normalised residuals (N, k)."""
    return white_scatter(np.rint(np.arange(len(residuals)) * SECOND / rate_hz).astype(np.int64), residuals)


@pytest.mark.parametrize("k", [1, 3])
def test_what_is_white_is_found_beside_errors_that_grow(k: int) -> None:
    white = np.random.default_rng(3).standard_normal((400, k))
    at_s = np.arange(400)[:, None] / 10.0
    slow = 30.0 * np.sin(2.0 * np.pi * at_s / 20.0) + 5.0 * at_s  # swell, and an estimate that drifts away
    assert white_of(6.0 * white + slow) == pytest.approx(6.0, rel=0.15)
    assert white_of(white + slow) < 1.5
    assert noisier_than_stated(white_of(white + slow)) == 1.0
    assert white_of(6.0 * white, rate_hz=0.5) == 1.0  # too far apart to tell


def noisy_headings(seed: int) -> SimulatedRun:
    """BL case 1, whose compass states 0.2 deg and scatters by 2."""
    run = simulate(replace(bl_scenario(1, "drift"), duration_s=40.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=5.0), seed)
    rng = np.random.default_rng(seed)

    def told(m: Measurement) -> Measurement:
        if not isinstance(m, CompassHeading):
            return m
        return replace(
            m, yaw_rad=float(wrap_angle(m.yaw_rad + rng.normal(0.0, np.radians(2.0)))), sigma_rad=np.radians(0.2)
        )

    recording = run.recording.changed(told)
    return slowly(replace(run, recording=recording), 2.5)


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
def test_headings_that_state_a_tenth_of_their_noise_do_not_make_the_imu_noisy(online: bool) -> None:
    run = noisy_headings(1)
    solved = replay if online else app.smooth_recording
    solution = solved(run.recording, run.config).solution
    found = compare_to_truth(solution.trajectory, run.truth)
    said = (*solution.stats.warnings, *solution.stats.events)
    assert not [line for line in said if "IMU" in line]
    (noisy,) = (line for line in solution.stats.warnings if "scatter more than they state" in line)
    assert "compass: " in noisy
    assert found.heading_rmse_deg < (1.0 if online else 0.5)
    assert found.coverage_95 is not None
    assert found.coverage_95 > 0.85


def test_matches_that_state_a_tenth_of_their_noise_do_not_throw_the_start() -> None:
    """At full weight, false ones among them bent the first window so that the solver went astray: 591 iterations, 1.3 m off."""
    run = simulate(replace(bl_scenario(1, "drift"), duration_s=30.0, pose_hz=4.0, gnss_hz=2.0, compass_hz=0.0), 2)

    def told(m: Measurement) -> Measurement:
        if not isinstance(m, PoseFix):
            return m
        return replace(m, modes=tuple(replace(mode, cov=0.01 * mode.cov) for mode in m.modes))

    recording = run.recording.changed(told)
    run = slowly(replace(run, recording=recording), 1.25)
    solution = app.smooth_recording(run.recording, run.config).solution
    assert compare_to_truth(solution.trajectory, run.truth).position_rmse_m < 0.6
    assert solution.stats.iterations < 200


def test_while_far_off_fixes_keep_their_weight_and_matches_weigh_as_they_scatter() -> None:
    """At the weight of what they are off by, fixes did not lead back from dead reckoning (drawn vessel 409: 1110 m off)."""
    run = slowly(simulate(replace(bl_scenario(1, "drift"), duration_s=20.0), 1))
    datum = app.choose_datum(run.recording, run.config)
    whole = app.with_synthetic(run.recording, run.config, datum)
    problem = make_problem(whole, app.seen_frames(run.config, whole), datum, SENSORS, INERTIAL)
    values, _, last, *_ = solve_start(problem, align(problem), lambda *_: None)
    for k in range(last + 1):
        pose = values.atPose3(keys.pose(k))
        values.update(keys.pose(k), gtsam.Pose3(pose.rotation(), pose.translation() + np.array([300.0, 0.0, 0.0])))
    verdicts = weigh(problem, values, first=0, last=last, stage=Stage.FAR, hypotheses=False)
    weights = {
        s.name: [v.decision.weight for (n, _), v in verdicts.items() if n == s.number and v.decision is not None]
        for s in problem.streams
    }
    assert set(weights["gnss"]) == {1.0}
    assert weights["matcher"]
    assert max(weights["matcher"]) < 1e-3


def shaken(seed: int, duration_s: float = 24.0) -> SimulatedRun:
    """BL's case 1 with good matches, a noisy IMU, and little else."""
    scenario = replace(
        bl_scenario(1, "drift"), false_fraction=0.0, duration_s=duration_s, pose_hz=4.0, pose_sigma_m=0.05,
        gnss_hz=2.0, compass_hz=2.0, accel_noise_ug_per_sqrt_hz=2000.0, gyro_noise_mdps_per_sqrt_hz=40.0,
    )  # fmt: skip
    return slowly(simulate(scenario, seed), 2.5)


def by_data_sheet(run: SimulatedRun, **changed: object) -> VesselConfig:
    """The noise of the IMU's data sheet, which knows no engine."""
    quiet = {"accel_noise_ug_per_sqrt_hz": 60.0, "gyro_noise_mdps_per_sqrt_hz": 4.0}
    imu = run.config.sensors["imu"].model_copy(update={**quiet, **changed})
    return run.config.with_sensors({"imu": imu})


def test_an_imu_that_is_noisier_than_its_data_sheet_is_believed_less() -> None:
    """As good as with the right noise; or, where it must not adapt, off by many of the stated sigmas."""
    run = shaken(2)
    as_told = app.smooth_recording(run.recording, by_data_sheet(run, adapt_noise=False)).solution
    adapted = app.smooth_recording(run.recording, by_data_sheet(run)).solution
    right = app.smooth_recording(run.recording, run.config).solution
    told, found, best = (compare_to_truth(s.trajectory, run.truth) for s in (as_told, adapted, right))
    assert told.nees is not None
    assert found.nees is not None
    assert told.nees > 10.0  # or there is nothing to mend
    assert found.nees < 4.0
    assert found.position_rmse_m < 1.2 * best.position_rmse_m
    (said,) = (w for w in adapted.stats.warnings if "its noise is configured too small" in w)
    taken = re.findall(r"([0-9.e+]+) is taken", said)
    assert 600.0 < float(taken[0]) < 2300.0
    assert 25.0 < float(taken[1]) < 46.0
    assert not [w for s in (as_told, right) for w in s.stats.warnings if "too small" in w]


def test_online_an_imu_that_is_noisier_than_its_data_sheet_is_believed_less() -> None:
    """Twenty seconds after the start: what the window holds is more probable with the noise that the samples have."""
    run = shaken(1, 38.0)
    solved = [replay(run.recording, by_data_sheet(run, adapt_noise=adapt)).solution for adapt in (False, True)]
    late_ns = run.truth.stamps_ns[0] + 25 * SECOND
    nees = []
    for solution in solved:
        track = solution.trajectory
        k = np.flatnonzero(track.stamps_ns > late_ns)
        assert track.cov is not None
        off = (track.p_world_m[k] - run.truth.at(track.stamps_ns[k]).p_world_m)[:, :2]
        nees.append(np.mean([e @ np.linalg.solve(P[:2, :2], e) for e, P in zip(off, track.cov[k], strict=True)]))
    assert nees[0] > 10.0  # or there is nothing to mend
    assert nees[1] < 5.0
    told = [[line for line in s.stats.events if "its noise is configured too small" in line] for s in solved]
    assert list(map(len, told)) == [0, 1]
    assert float(re.findall(r"([0-9.e+]+) is taken", told[1][0])[-1]) == pytest.approx(40.0, rel=0.15)


def test_vibration_that_does_not_go_on_into_the_motion_is_no_noise() -> None:
    """Its samples scatter by 60 times what is configured."""
    run = slowly(simulate(replace(bl_scenario(1, "drift"), false_fraction=0.0, duration_s=30.0), 1))
    imu = run.recording.imu
    assert imu is not None
    t = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    shake = 2.0 * np.sin(2.0 * np.pi * 23.0 * t[:, None] + np.array([0.0, 1.0, 2.0]))
    recording = replace(run.recording, imu=replace(imu, accel_mps2=imu.accel_mps2 + shake))
    solution = app.smooth_recording(recording, run.config).solution
    assert noise_density(imu.stamps_ns, shake)[0] > 30.0 * run.config.sensors["imu"].accel_noise_mps2
    assert not [w for w in solution.stats.warnings if "too small" in w or "IMU" in w]
    assert compare_to_truth(solution.trajectory, run.truth).position_rmse_m < 0.3


def test_where_normal_equations_do_not_tell_the_noise_the_solution_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(_: object) -> None:
        raise RuntimeError("Factor is exactly singular")

    run = shaken(1, 10.0)
    monkeypatch.setattr(imu_noise, "normal_solver", singular)
    solution = app.smooth_recording(run.recording, by_data_sheet(run)).solution
    assert not [w for w in solution.stats.warnings if "too small" in w]


def test_a_compass_that_went_round_by_whole_turns_comes_back() -> None:
    """Nothing tells these turns, and a prior that has the tails of a mount hardly leads back: fixes that state a tenth left it at 1059 deg."""
    run = simulate(replace(bl_scenario(1, "clean"), duration_s=20.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3)
    run, found = slowly(run, 2.5), list[BatchResult]()

    def keep(problem: Problem, recording: Recording, result: BatchResult, stepped: Collection[str]) -> Solution:
        found.append(result)
        return make_solution(problem, recording, result, stepped)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solve, "make_solution", keep)
        app.smooth_recording(run.recording, run.config)
    (result,) = found
    problem, values = result.problem, gtsam.Values(result.values)
    (compass,) = (stream for stream in problem.streams if stream.name == "compass")
    names = [keys.slow(compass.number, j) for j in range(len(problem.timeline.slow_stamps_ns))]
    assert compass.slow is not None
    there = np.array(compass.slow.axes) == "yaw"
    for name in names:
        values.update(name, values.atVector(name) + 6.0 * np.pi * there)
    assert unwound(problem, result.values) is result.values
    verdicts = weigh(problem, values, first=0, last=len(problem.timeline) - 1, stage=Stage.FINAL)
    settled = settle(problem, values, verdicts, result.prior, quiet, 6)
    for name in names:
        assert settled.values.atVector(name) == pytest.approx(result.values.atVector(name), abs=1e-3)
    assert settled.graph.error(settled.values) < 1.01 * result.graph.error(result.values)
