# SPDX-License-Identifier: Apache-2.0
"""An IMU that is askew in its mount: found offline where other sensors tell, and in the bounds of both modes where they do not."""

from collections.abc import Collection
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphloc import app, gauss, solve
from graphloc.build import Problem
from graphloc.config import KernelConfig, VesselConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.frames import wrap_angle
from graphloc.graph import FeltMotion
from graphloc.judge.linearised import linearised
from graphloc.recording import Recording
from graphloc.replay import replay
from graphloc.solution import Solution
from graphloc.solve._solution import make_solution
from graphloc.solve.batch import BatchResult
from graphloc.solve.imu_mount import MountError, _swung_by_turn, mount_error
from tests.slowly import simulate_slowly, slowly
from tests.test_late_velocity import late

ASKEW_DEG = (0.0, 0.0, 3.0)


def changed(config: VesselConfig, name: str, **keys: object) -> VesselConfig:
    return config.with_sensors({name: config.sensors[name].model_copy(update=keys)})


def loops(gnss_sigma_m: float) -> SimulatedRun:
    """Half a minute of turns with fixes and a compass; small changes do not change the weights of any."""
    scenario = Scenario(
        path="loops", duration_s=35.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gnss_hz=5.0, gnss_sigma_m=gnss_sigma_m, compass_hz=5.0
    )  # fmt: skip
    run = simulate_slowly(scenario, 3, 5.0)
    white = run.config.sensors["gnss"].slow_error.model_copy(update={"enabled": False})
    linear = KernelConfig(kind="none")
    config = changed(changed(run.config, "gnss", slow_error=white, kernel=linear), "compass", kernel=linear)
    return replace(run, config=config)


@pytest.fixture(scope="module")
def simulated() -> SimulatedRun:
    """Fixes good to centimetres."""
    return loops(0.02)


def askew(run: SimulatedRun, turn_deg: tuple[float, float, float] = ASKEW_DEG) -> SimulatedRun:
    """The run, as recorded by an IMU that is turned against its mount by that rotation, body axes."""
    imu = run.recording.imu
    assert imu is not None
    R = run.config.sensors["imu"].mount.R_body_sensor
    # R_body_imu = Exp(turn) R, so what it measures is R' Exp(turn)' R times what it would.
    turn = gtsam.Rot3.Expmap(np.radians(turn_deg)).matrix()
    into = (R.T @ turn.T @ R).T
    turned = replace(imu, accel_mps2=imu.accel_mps2 @ into, gyro_radps=imu.gyro_radps @ into)
    return replace(run, recording=replace(run.recording, imu=turned))


def gnss_compass(run: SimulatedRun) -> SimulatedRun:
    """The run with a compass that was calibrated, without deviation or wander; its noise is simulated to 1 deg."""
    exact = {"mount_offset_sigma_deg": 0.0, "deviation_sigma_deg": 0.0, "wander_sigma_deg": 0.0}
    return replace(run, config=changed(run.config, "compass", **exact))


def taken_as_given(run: SimulatedRun) -> SimulatedRun:
    return replace(run, config=changed(run.config, "imu", mount_sigma_deg=0.0))


def smoothed(run: SimulatedRun) -> Solution:
    return app.smooth_recording(run.recording, run.config).solution


def with_result(run: SimulatedRun) -> tuple[Solution, BatchResult]:
    found: list[BatchResult] = []

    def keep(problem: Problem, recording: Recording, result: BatchResult, stepped: Collection[str]) -> Solution:
        found.append(result)
        return make_solution(problem, recording, result, stepped)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solve, "make_solution", keep)
        return smoothed(run), found[0]


def error_of(result: BatchResult) -> MountError:
    found = mount_error(result.problem, result.graph, result.values, result.verdicts, result.prior)
    assert found is not None
    return found


def test_a_heading_of_known_mount_tells_the_yaw_of_the_imu(simulated: SimulatedRun) -> None:
    run = gnss_compass(askew(simulated))
    solution, result = with_result(run)
    error = error_of(result)
    turn_deg, sigma_deg = np.degrees([result.problem.imu_turn_rad[2] + error.yaw_rad, error.sigma_rad])
    assert abs(turn_deg - ASKEW_DEG[2]) < 3.0 * sigma_deg
    assert sigma_deg < 0.6
    assert not result.problem.imu_turn_rad[:2].any()
    assert any("taken as turned" in line for line in solution.stats.events)
    assert any("turn its mount" in line for line in solution.stats.warnings)
    given = smoothed(taken_as_given(run))
    assert not any("turn its mount" in line for line in given.stats.warnings)
    ours, theirs = (compare_to_truth(s.trajectory, run.truth).position_max_m for s in (solution, given))
    assert ours < 0.9 * theirs


def test_one_that_sits_as_configured_is_left_there(simulated: SimulatedRun) -> None:
    solution, result = with_result(gnss_compass(simulated))
    assert not result.problem.imu_turn_rad.any()
    assert not any("turn its mount" in line for line in solution.stats.warnings)


def test_a_turn_that_no_mount_has_is_not_made(simulated: SimulatedRun) -> None:
    solution, result = with_result(gnss_compass(askew(simulated, (0.0, 0.0, 12.0))))
    assert not result.problem.imu_turn_rad.any()
    assert any("turn its mount" in line and "stays as configured" in line for line in solution.stats.warnings)


def test_fixes_alone_do_not_tell_it() -> None:
    """They tell the heading of the IMU, not of the vessel; good to 0.2 m, not how the antenna lies from it either."""
    run = loops(0.2)
    fixes = tuple(m for m in run.recording.measurements if m.sensor == "gnss")
    _, result = with_result(replace(run, recording=replace(run.recording, measurements=fixes)))
    error = error_of(result)
    assert error.sigma_rad == pytest.approx(np.radians(1.0), rel=0.05)
    level, heading = error.pose[:, :2, :2], error.pose[:, 2, 2]
    assert np.abs(level + np.eye(2)).max() < 0.05
    assert -1.6 < heading.min() < heading.max() < -0.3  # the lever arm holds some of it


def test_axes_of_the_mount_have_sigmas_of_their_own(simulated: SimulatedRun) -> None:
    """What a heading of known mount tells of the yaw is the same; a sigma of 0 leaves an axis as it is, in the bounds, too."""
    _, result = with_result(gnss_compass(askew(simulated)))

    def of(*sigmas_deg: float) -> MountError:
        config = changed(result.problem.config, "imu", mount_sigma_deg=sigmas_deg)
        return error_of(replace(result, problem=replace(result.problem, config=config)))

    level, wide, known = of(0.0, 0.0, 1.0), of(2.0, 0.5, 1.0), of(2.0, 0.5, 0.0)
    assert np.degrees(np.sqrt(wide.mean_square[:2])) == pytest.approx([2.0, 0.5])
    assert not level.mean_square[:2].any()
    assert (known.yaw_rad, known.sigma_rad, known.mean_square[2]) == (0.0, 0.0, 0.0)
    assert level.sigma_rad == pytest.approx(wide.sigma_rad, rel=0.2)
    R, up = np.eye(3)[None].repeat(len(level.pose), axis=0), np.array([0.0, 0.0, 5.0])
    narrow, broad = (error.pose_covariance(R, up)[:, 3:5, 3:5] for error in (level, wide))
    assert narrow.max() < 0.01 * np.trace(broad, axis1=1, axis2=2).min()


def test_what_velocities_are_predicted_by_turns_with_the_mount() -> None:
    """Their rows, by residuals of readings that are turned. A lever arm in waves, and a delay, seemed to tell the mount's yaw to 1.7 deg."""
    run = late(0.05)
    _, result = with_result(run)
    problem, verdicts = result.problem, result.verdicts
    rows = linearised(problem, result.values, verdicts, result.prior)
    found = _swung_by_turn(problem, rows, result.values, verdicts)
    (stream,) = (s for s in problem.streams if s.name == "velocity")
    used = rows.used(stream)
    assert len(used) > 100
    off, sizes = [], []
    for i in used[::7]:
        m, at, decision = stream.measurements[i], verdicts[stream.number, i].at, verdicts[stream.number, i].decision
        assert at.felt is not None
        assert decision is not None
        (plain,) = stream.row.residuals(m, stream.config, at)
        for axis in np.eye(3):
            R = gtsam.Rot3.Expmap(1e-4 * axis).matrix()
            felt = FeltMotion(R @ at.felt.force_mps2, R @ at.felt.spin_radps2, at.felt.gravity_mps2)
            (turned,) = stream.row.residuals(m, stream.config, replace(at, gyro_radps=R @ at.gyro_radps, felt=felt))
            by = np.sqrt(decision.weight) * gauss.whitening(plain.cov) @ (turned.raw - plain.raw) / 1e-4
            span = rows.made[stream.number, i]
            own = slice(rows.starts[span.start], rows.starts[span.stop])
            off.append(np.abs(found[own] @ axis - by).max())
            sizes.append(np.abs(by).max())
    assert max(sizes) > 1.0
    assert max(off) < 1e-3 * max(sizes)


def test_states_follow_the_mount_as_reckoned(simulated: SimulatedRun) -> None:
    """By solving again with an IMU that is turned the other way, taken as given."""
    turn = np.radians([0.05, -0.08, 0.1])
    (before, result), (after, _) = (
        with_result(taken_as_given(r)) for r in (simulated, askew(simulated, tuple(-np.degrees(turn))))
    )
    by = error_of(replace(result, problem=replace(result.problem, config=simulated.config)))
    track, R = before.trajectory, before.trajectory.R_world_body
    turned, moved = (np.einsum("nij,njk,k->ni", R, by.pose[:, part], turn) for part in (slice(3), slice(3, 6)))
    places = moved + np.cross(turned, R @ -result.problem.t_body_imu_m)
    for what, reckoned in (
        (after.trajectory.p_world_m - track.p_world_m, places),
        (wrap_angle(after.trajectory.yaw_rad - track.yaw_rad), turned[:, 2]),
    ):
        assert np.abs(what - reckoned).max() < 0.1 * np.abs(reckoned).max()


def test_online_the_newest_state_follows_the_mount_as_its_bounds_say(simulated: SimulatedRun) -> None:
    """Turned by a bit of its sigma about each axis in turn, the IMU moves place, heading and velocity by as much of what they are widened by."""
    share = 0.2
    simulated, sigmas_deg = slowly(simulated), (0.5, 1.0, 2.0)
    unsure = replace(simulated, config=changed(simulated.config, "imu", mount_sigma_deg=sigmas_deg))
    as_given, widened = (replay(r.recording, r.config).solution for r in (taken_as_given(simulated), unsure))
    track = as_given.trajectory
    moved = []
    for axis in np.diag(sigmas_deg):
        run = taken_as_given(askew(simulated, tuple(share * axis)))
        other = replay(run.recording, run.config).solution.trajectory
        off = other.p_world_m[-1] - track.p_world_m[-1], wrap_angle(other.yaw_rad - track.yaw_rad)[-1:]
        moved.append(np.concatenate(off) / share)
    assert track.cov is not None
    assert widened.trajectory.cov is not None
    rows = [0, 1, 2, 5]
    added = (widened.trajectory.cov[-1] - track.cov[-1])[rows, rows]
    by_turns = (np.array(moved) ** 2).sum(axis=0)
    assert np.sqrt(added) == pytest.approx(np.sqrt(by_turns), rel=0.1)
