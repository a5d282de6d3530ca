# SPDX-License-Identifier: Apache-2.0
"""What a slow GNSS error that nothing tells from motion does to heading and velocity: in their bounds, and not more than that."""

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import pytest

from graphloc import app, solve
from graphloc.blocks import MountConfig
from graphloc.build import Problem
from graphloc.config import GnssConfig, VesselConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array, Geodetic, wrap_angle
from graphloc.judge.covariances import Unmodelled
from graphloc.measurements import GnssPosition, Measurement
from graphloc.online import OnlineSmoother, _waiting
from graphloc.online._unmodelled import UnmodelledError
from graphloc.recording import Recording
from graphloc.signals.series import rms
from graphloc.solution import Solution
from graphloc.solve import _solution
from graphloc.solve.batch import BatchResult
from graphloc.solve.unmodelled import unmodelled
from graphloc.time import NS_PER_S
from graphloc.trajectory import Trajectory
from tests.faults import arrivals_of, feed, finish
from tests.slowly import with_few_states

CORRELATED_S = 200.0  # of the default configuration


def drifting(
    seed: int, sigma_m: float, compass_hz: float = 0.0, duration_s: float = 60.0
) -> tuple[SimulatedRun, Recording, VesselConfig]:
    """A run of IMU, one receiver and a compass, if any, and its recording and configuration where the fixes drift as that states."""
    scenario = Scenario(
        path="loops", duration_s=duration_s, noise="clean", pose_hz=0.0, compass_hz=compass_hz, imu_hz=50.0, gnss_hz=2.0,
        gnss_sigma_m=0.05,
    )  # fmt: skip
    run = simulate(scenario, seed)
    rng, off_m, last_ns = np.random.default_rng(seed), np.zeros(2), None
    moved: list[Measurement] = []
    for m in run.recording.measurements:
        if isinstance(m, GnssPosition):
            kept = 0.0 if last_ns is None else np.exp(-(m.stamp_ns - last_ns) * 1e-9 / CORRELATED_S)
            off_m = kept * off_m + sigma_m * np.sqrt(1.0 - kept**2) * rng.standard_normal(2)
            last_ns = m.stamp_ns
            latitude, longitude, height = m.position
            east = off_m[0] / (111_300.0 * np.cos(np.radians(latitude)))
            moved.append(replace(m, position=Geodetic(latitude + off_m[1] / 111_300.0, longitude + east, height)))
        else:
            moved.append(m)
    gnss = run.config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    slow_error = gnss.slow_error.model_copy(update={"horizontal_sigma_m": sigma_m})
    sensors = {name: run.config.sensors[name] for name in ("imu", "gnss", "compass") if compass_hz or name != "compass"}
    sensors["gnss"] = gnss.model_copy(update={"slow_error": slow_error})
    return run, replace(run.recording, measurements=tuple(moved)), run.config.model_copy(update={"sensors": sensors})


def squares(solved: Solution, run: SimulatedRun) -> tuple[Array, Array]:
    """Squared errors over their variance, of heading (N,) and of the velocity's two axes (N, 2)."""
    track = solved.trajectory
    inside = (track.stamps_ns >= run.truth.stamps_ns[0]) & (track.stamps_ns <= run.truth.stamps_ns[-1])
    truth = run.truth.at(track.stamps_ns[inside])
    assert track.cov is not None
    assert truth.v_world_mps is not None
    heading = wrap_angle(track.yaw_rad[inside] - truth.yaw_rad) ** 2 / track.cov[inside, 5, 5]
    assert track.v_world_mps is not None
    v_off = (track.v_world_mps[inside] - truth.v_world_mps)[:, :2]
    return heading, v_off**2 / np.diagonal(solved.v_cov[inside], axis1=1, axis2=2)[:, :2]


def test_a_drifting_receiver_is_in_the_bounds_of_heading_and_velocity() -> None:
    """Two draws of the drift that the configuration states: the mean square is that of the covariance, 1."""
    found = []
    for seed in range(2):
        run, recording, config = drifting(seed, 1.0)
        config = with_few_states(config, 1.25)
        found.append(squares(app.smooth_recording(recording, config).solution, run))
    heading, velocity = np.mean([h.mean() for h, _ in found]), np.mean([v.mean() for _, v in found])
    assert 0.3 < heading < 2.2  # of some four degrees of freedom
    assert 0.6 < velocity < 1.2


def with_drift_as_state(config: VesselConfig) -> VesselConfig:
    gnss = config.sensors["gnss"]
    slow_error = gnss.slow_error.model_copy(update={"enabled": True, "jumps": False})
    return config.with_sensors({"gnss": gnss.model_copy(update={"slow_error": slow_error})})


def both_ways(recording: Recording, config: VesselConfig) -> tuple[Solution, Solution]:
    """A run solved once: with the drift taken back, and as the fixes were followed."""
    found: list[Solution] = []

    def twice(problem: Problem, recording: Recording, result: BatchResult, _stepped: Collection[str]) -> Solution:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_solution, "with_drift_taken_back", lambda result: result)
            found.append(_solution.make_solution(problem, recording, result))
        return _solution.make_solution(problem, recording, result)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solve, "make_solution", twice)
        taken_back = app.smooth_recording(recording, config).solution
    (followed,) = found
    return taken_back, followed


def test_a_drift_does_not_turn_the_heading_against_the_compass() -> None:
    """As good as with the drift as a state, which the antenna's place does not have: it follows the fixes."""
    run, recording, config = drifting(1, 2.0, compass_hz=5.0)
    config = with_few_states(config, 1.0)
    full, lever_m = with_drift_as_state(config), config.sensors["gnss"].mount.t_body_sensor_m

    def off_deg(track: Trajectory) -> Array:
        return np.degrees(wrap_angle(track.yaw_rad - run.truth.at(track.stamps_ns).yaw_rad))

    taken_back, followed = (solution.trajectory for solution in both_ways(recording, config))
    as_state = app.smooth_recording(recording, full).solution.trajectory
    inside = slice(5, -5)  # the truth begins and ends with the run
    assert rms(off_deg(followed)[inside]) > 2.0 * rms(off_deg(taken_back)[inside])
    assert np.abs(off_deg(taken_back) - off_deg(as_state))[inside].max() < 0.2
    antenna = [track.p_world_m + track.R_world_body @ lever_m for track in (taken_back, followed)]
    assert np.abs(antenna[0] - antenna[1]).max() < 1e-6


def test_in_an_outage_at_the_end_the_antenna_moves_as_with_the_drift_as_a_state() -> None:
    """And before the first fix. It went on with a velocity that followed the drift, which was in no bound."""
    run, recording, config = drifting(1, 2.0, compass_hz=5.0)
    begin_ns, end_ns = (int(run.truth.stamps_ns[0]) + round(s * NS_PER_S) for s in (20.0, 40.0))
    kept = [m for m in recording.measurements if not isinstance(m, GnssPosition) or begin_ns <= m.stamp_ns <= end_ns]
    recording = replace(recording, measurements=tuple(kept))
    config = with_few_states(config, 2.0)
    full, lever_m = with_drift_as_state(config), config.sensors["gnss"].mount.t_body_sensor_m

    def moved_m(solution: Solution) -> Array:
        """How far the antenna is from where the fixes begin, and end, before and after."""
        track = solution.trajectory
        antenna = track.p_world_m + track.R_world_body @ lever_m
        first, last = np.flatnonzero((track.stamps_ns >= begin_ns) & (track.stamps_ns <= end_ns))[[0, -1]]
        return np.concatenate([antenna[: first + 1] - antenna[first], antenna[last:] - antenna[last]])[:, :2]

    taken_back, followed = (moved_m(solution) for solution in both_ways(recording, config))
    as_state = moved_m(app.smooth_recording(recording, full).solution)
    assert rms(followed - as_state) > 4.0 * rms(taken_back - as_state)


def test_an_antenna_of_unknown_place_stays_where_it_is_found() -> None:
    """It was held where it is configured, so the one found moved as the heading was turned back."""
    _, recording, config = drifting(1, 2.0, compass_hz=5.0)
    gnss = config.sensors["gnss"]
    lever_m = gnss.mount.t_body_sensor_m - [2.0, 1.0, 0.0]
    elsewhere = {"mount": MountConfig(xyz_m=tuple(lever_m)), "mount_sigma_m": 2.0}
    config = with_few_states(config.with_sensors({"gnss": gnss.model_copy(update=elsewhere)}), 1.0)
    antenna, heading = [], []
    for solution in both_ways(recording, config):
        track = solution.trajectory
        antenna.append(track.p_world_m + track.R_world_body @ (lever_m + solution.antennas_off_m["gnss"]))
        heading.append(track.yaw_rad)
    assert np.abs(heading[0] - heading[1]).max() > np.radians(0.3)
    assert np.abs(antenna[0] - antenna[1]).max() < 1e-6


def test_online_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it, the mean squares are 1.8 and 3; linear in the heading, it is rather too wide than too narrow (of some four degrees of freedom)."""
    monkeypatch.setattr(_waiting, "_TRY_EVERY_S", 15.3)  # each try solves all that there is
    monkeypatch.setattr(_waiting, "_TRY_AGAIN", 0.0)
    found = []
    for seed in range(2):
        run, recording, config = drifting(seed, 0.5)
        found.append(squares(app.replay_recording(recording, with_few_states(config)).solution, run))
    heading, velocity = np.mean([h.mean() for h, _ in found]), np.mean([v.mean() for _, v in found])
    assert 0.1 < heading < 1.0
    assert 0.3 < velocity < 1.1


def test_what_a_drift_did_to_the_velocity_is_in_the_bounds_of_a_place_without_fixes() -> None:
    """Of the place only the size of the drift was, also half a minute later: mean squares of 2.8 and 3.9. Without the motion model the latter is 0.1."""
    found = []
    for seed in range(2):
        run, recording, config = drifting(seed, 2.0, compass_hz=5.0, duration_s=90.0)
        begin_ns = run.truth.stamps_ns[0]
        kept = [m for m in recording.measurements if m.sensor != "gnss" or m.stamp_ns - begin_ns < 35 * NS_PER_S]
        config = with_few_states(config, 1.25)
        track = app.replay_recording(replace(recording, measurements=tuple(kept)), config).solution.trajectory
        assert track.cov is not None
        since_s = (track.stamps_ns - begin_ns) / NS_PER_S - 35.0
        inside = (track.stamps_ns <= run.truth.stamps_ns[-1]) & (since_s > 15.0)
        off_m = (track.p_world_m[inside] - run.truth.at(track.stamps_ns[inside]).p_world_m)[:, :2]
        squares_off = off_m**2 / np.diagonal(track.cov[inside], axis1=1, axis2=2)[:, :2]
        found.append([squares_off[since_s[inside] < 30.0].mean(), squares_off[since_s[inside] > 40.0].mean()])
    soon, later = np.mean(found, axis=0)
    assert 0.1 < soon < 1.0
    assert 0.15 < later < 1.0


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_a_drift_of_the_height_turns_nothing_where_the_height_is_known(solve: Callable[..., app.Run]) -> None:
    """It was taken to tilt the vessel about its antenna: 0.5 m/s by 5 m, and a bound twice as wide 17 s after the last fix."""
    run, recording, config = drifting(0, 0.1, compass_hz=5.0, duration_s=30.0)
    config = with_few_states(config.with_sensors({"height": run.config.sensors["height"]}))
    end_ns = run.truth.stamps_ns[0] + 15 * NS_PER_S
    kept = [m for m in recording.measurements if m.sensor != "gnss" or m.stamp_ns < end_ns]
    recording, covs = replace(recording, measurements=tuple(kept)), []
    for sigma_m in (1.0, 5.0):
        gnss = config.sensors["gnss"]
        slow_error = gnss.slow_error.model_copy(update={"vertical_sigma_m": sigma_m})
        changed = config.with_sensors({"gnss": gnss.model_copy(update={"slow_error": slow_error})})
        track = solve(recording, changed).solution.trajectory
        assert track.cov is not None
        covs.append(np.diagonal(track.cov, axis1=1, axis2=2)[::5])
    np.testing.assert_allclose(covs[1], covs[0], rtol=0.05)


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_a_drift_of_the_height_moves_nothing_where_the_height_is_known(solve: Callable[..., app.Run]) -> None:
    """A hundred fixes that agree to 5 cm, 3 m too high, outvoted a waterline that is good to half a metre."""
    run, recording, config = drifting(0, 0.0, compass_hz=5.0, duration_s=30.0)
    height = run.config.sensors["height"]
    config = with_few_states(config.with_sensors({"height": height}))
    raised = [
        replace(m, position=m.position._replace(height_m=m.position.height_m + 3.0))
        if isinstance(m, GnssPosition)
        else m
        for m in recording.measurements
    ]
    run_of_it = solve(replace(recording, measurements=tuple(raised)), config)
    assert sum("its heights are not used" in line for line in run_of_it.solution.stats.warnings) == 1
    track = run_of_it.solution.trajectory
    off_m = track.p_world_m[:, 2] - run.truth.at(track.stamps_ns).p_world_m[:, 2]
    assert track.cov is not None
    sigma_m = np.sqrt(track.cov[:, 2, 2])
    assert np.abs(off_m / sigma_m).max() < 2.0
    assert sigma_m.max() < 1.2 * np.hypot(height.sigma_m, height.offset_sigma_m)


def with_compass() -> tuple[SimulatedRun, VesselConfig]:
    """A run of 30 s, of IMU, one receiver and a compass whose mount may be off by a degree."""
    scenario = Scenario(
        path="loops", duration_s=30.0, noise="clean", pose_hz=0.0, compass_hz=5.0, imu_hz=50.0, gnss_hz=2.0, gnss_sigma_m=0.05
    )  # fmt: skip
    run = simulate(scenario, 1)
    sensors = {name: run.config.sensors[name] for name in ("imu", "gnss", "compass")}
    return run, with_few_states(run.config.model_copy(update={"sensors": sensors}))


def test_a_compass_with_an_offset_does_not_hold_the_heading_online() -> None:
    """At the end of a run both modes have used the same. A compass without offset would say 0.03 deg, not two."""
    run, config = with_compass()
    whole, live = (
        made(run.recording, config).solution.trajectory.cov for made in (app.smooth_recording, app.replay_recording)
    )
    assert whole is not None
    assert live is not None
    assert np.sqrt(live[-1, 5, 5] / whole[-1, 5, 5]) == pytest.approx(1.0, abs=0.3)


def test_a_bound_that_cannot_be_computed_costs_no_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """The window would be rebuilt, fail again, and restart without end."""
    run, config = with_compass()

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("singular matrix")

    monkeypatch.setattr(UnmodelledError, "advance", fail)
    smoother = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL)
    fed = finish(smoother, feed(smoother, run, arrivals_of(run)))
    assert not [event for event in fed.events if "restart" in event or "rebuilt" in event]
    assert fed.worst_m() < 1.0


def test_a_receiver_whose_fixes_are_all_rejected_adds_nothing() -> None:
    """Then the heading comes from the matches alone; an empty table was indexed."""
    scenario = Scenario(path="loops", duration_s=20.0, noise="clean", pose_hz=1.0, imu_hz=50.0, gnss_hz=2.0)
    run = simulate(scenario, 1)
    found: list[BatchResult] = []

    def keep(result: BatchResult) -> Unmodelled | None:
        found.append(result)
        return None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_solution, "unmodelled", keep)
        app.smooth_recording(run.recording, run.config)
    (result,) = found
    gnss = next(s for s in result.problem.streams if s.name == "gnss")
    alone = replace(gnss, slow=None, left_out=gnss.slow)
    silent = {k: replace(v, decision=None) if k[0] == gnss.number else v for k, v in result.verdicts.items()}
    streams = tuple(alone if s.name == "gnss" else s for s in result.problem.streams)
    more = unmodelled(replace(result, problem=replace(result.problem, streams=streams), verdicts=silent))
    assert more is not None
    assert not more.rotation.any()
    assert not more.velocity.any()
