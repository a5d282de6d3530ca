# SPDX-License-Identifier: Apache-2.0
"""A run of hours is solved in legs: as good as in one, and every message has its row."""

import re
from collections.abc import Sized
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import graphloc.solve
from graphloc import app
from graphloc.build import Problem, make_problem
from graphloc.config import VesselConfig
from graphloc.errors import SolveError
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.frames import heading_deg_from_yaw, wrap_angle
from graphloc.measurements import CompassHeading, GnssPosition, Measurement, PoseFix
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.solve._legs import KnownHeading, _own, overlap_ns, seams, solve_legs
from graphloc.solve._parts import mean_of, solve_parts
from tests.slowly import sparsely

S = 10**9
LEG_S = 45.0
RATE_HZ = 1.25  # of states: an eighth of the usual ones
LOOPS = Scenario(path="loops", duration_s=100.0, noise="drift", imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0)


def in_legs(config: VesselConfig, leg_s: float, rate_hz: float) -> VesselConfig:
    timeline = config.timeline.model_copy(update={"rate_hz": rate_hz, "leg_s": leg_s})
    return config.model_copy(update={"timeline": timeline})


def solved(
    run: SimulatedRun,
    leg_s: float = LEG_S,
    measurements: tuple[Measurement, ...] | None = None,
    rate_hz: float = RATE_HZ,
) -> Solution:
    recording = run.recording
    if measurements is not None:
        recording = replace(recording, measurements=measurements)
    return app.smooth_recording(recording, in_legs(run.config, leg_s, rate_hz)).solution


def begin_ns(run: SimulatedRun) -> int:
    assert run.recording.imu is not None
    return int(run.recording.imu.stamps_ns[0])


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return sparsely(simulate(LOOPS, 3), 2)


@pytest.fixture(scope="module")
def whole(run: SimulatedRun) -> Solution:
    return solved(run, 1000.0)


@pytest.fixture(scope="module")
def legs(run: SimulatedRun) -> Solution:
    return solved(run)


def test_legs_are_as_good_as_the_whole(run: SimulatedRun, whole: Solution, legs: Solution) -> None:
    (said,) = (event for event in legs.stats.events if "legs" in event)
    assert said.startswith("solved in 3 overlapping legs")
    assert legs.stats.warnings == whole.stats.warnings  # nothing is wrong
    assert not [event for event in whole.stats.events if "legs" in event]
    one, several = (compare_to_truth(s.trajectory, run.truth) for s in (whole, legs))
    assert several.matched == pytest.approx(one.matched, abs=1e-3)
    assert several.position_rmse_m < one.position_rmse_m + 0.03
    assert several.heading_rmse_deg < one.heading_rmse_deg + 0.1
    assert several.coverage_95 is not None
    assert several.coverage_95 > 0.85
    common = whole.trajectory.stamps_ns[legs.trajectory.covers(whole.trajectory.stamps_ns)]
    apart = np.linalg.norm(whole.trajectory.at(common).p_world_m - legs.trajectory.at(common).p_world_m, axis=1)
    assert apart.max() < 0.2
    # What is said of the seams is what the track does there: it steps by no more.
    told_m = float(said.rpartition("at most ")[2].split(" m")[0])
    assert told_m < 0.2


def test_every_message_has_one_row_and_every_state_its_values(whole: Solution, legs: Solution) -> None:
    assert [row.seq for row in legs.ledger] == [row.seq for row in whole.ledger]
    assert len(legs.ledger) == len(whole.ledger)
    n = len(legs.trajectory)
    assert abs(n - len(whole.trajectory)) <= 3
    assert legs.stats.states == n
    columns: list[Sized] = [
        legs.v_cov,
        legs.accel_bias_mps2,
        legs.gyro_bias_radps,
        legs.gyro_radps,
        legs.health,
        legs.health_reason,
    ]
    assert {len(c) for c in (*columns, *legs.since_agreed_s.values())} == {n}
    assert np.diff(legs.trajectory.stamps_ns).max() < 1.5 * S / RATE_HZ  # none is missing
    assert legs.slow.keys() == whole.slow.keys()
    for name, slow in legs.slow.items():
        assert (np.diff(slow.stamps_ns) > 0).all()
        assert len(slow.value) == len(slow.stamps_ns) == len(slow.sigma)
        assert len(slow.stamps_ns) == pytest.approx(len(whole.slow[name].stamps_ns), abs=4)


def test_no_time_is_missing_at_a_seam_of_legs_that_are_not_in_step(run: SimulatedRun, whole: Solution) -> None:
    """The last state before it and the first one after it were nearly two intervals apart."""
    stamps = whole.trajectory.stamps_ns
    longest, k = int(np.diff(stamps).max()), len(stamps) // 2
    out_of_step = int(0.7 * (stamps[k + 1] - stamps[k]))
    shifts = iter([0, out_of_step])

    def solve(part: Recording, _heading: KnownHeading | None) -> Solution:
        assert part.imu is not None
        first, last = (int(ns) for ns in part.imu.stamps_ns[[0, -1]])
        leg = _own(whole, first, last, last, None)
        track = replace(leg.trajectory, stamps_ns=leg.trajectory.stamps_ns + next(shifts))
        return replace(leg, trajectory=track)

    legs, _ = solve_legs(run.recording, None, [int(stamps[k]) + out_of_step + 1], LEG_S, solve)
    apart = np.diff(np.concatenate([leg.trajectory.stamps_ns for leg in legs]))
    assert (apart > 0).all()
    assert apart.max() <= longest


def test_seams_keep_away_from_an_outage(run: SimulatedRun) -> None:
    recording, first = run.recording, begin_ns(run)
    absolute = {m.sensor for m in recording.measurements if not isinstance(m, CompassHeading)}
    assert seams(recording, 1000.0, absolute) == []
    usual = seams(recording, LEG_S, absolute)
    assert [s - first for s in usual] == pytest.approx([100 * S / 3, 200 * S / 3], abs=S)
    gone = (usual[0] - 14 * S, usual[0] + 10 * S)
    kept = tuple(m for m in recording.measurements if m.sensor not in absolute or not gone[0] < m.stamp_ns < gone[1])
    away = seams(replace(recording, measurements=kept), LEG_S, absolute)
    assert usual[0] + 3 * S < away[0] < usual[0] + 5 * S  # as far as it is looked for: a tenth of a leg
    assert away[1] == usual[1]


def test_a_heading_that_no_sensor_tells_is_handed_on(run: SimulatedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a vessel that only its way tells: in the first seconds of a leg it might be any."""
    asked: list[float | None] = []

    def noted(part: Recording, config: VesselConfig, *rest: Any) -> Problem:
        asked.append(config.start.heading_deg)
        return make_problem(part, config, *rest)

    monkeypatch.setattr(graphloc.solve, "make_problem", noted)
    fixes = tuple(run.recording.of(GnssPosition))
    solved(run, 60.0, fixes, rate_hz=0.625)
    where = seams(replace(run.recording, measurements=fixes), 60.0, {"gnss"})
    assert asked[0] is None
    for seam, heading_deg in zip(where, asked[1:], strict=True):
        true = run.truth.at(np.array([seam - overlap_ns(60.0)]))
        assert heading_deg == pytest.approx(float(heading_deg_from_yaw(true.yaw_rad)[0]), abs=6.0)


@pytest.mark.parametrize(("sigma_deg", "handed_on"), [(4.0, True), (12.0, False)])
def test_a_heading_is_handed_on_as_well_as_it_is_known(
    run: SimulatedRun, whole: Solution, sigma_deg: float, *, handed_on: bool
) -> None:
    """Not as well as the one at the start was configured; and twice the variance, since both legs have the data of the overlap."""
    asked, known = list[KnownHeading | None](), KnownHeading(12.0, 3.0)
    assert whole.trajectory.cov is not None
    cov = whole.trajectory.cov.copy()
    cov[:, 5, 5] = np.radians(sigma_deg) ** 2
    sure = replace(whole, trajectory=replace(whole.trajectory, cov=cov))

    def solve(part: Recording, heading: KnownHeading | None) -> Solution:
        asked.append(heading)
        assert part.imu is not None
        first, last = (int(ns) for ns in part.imu.stamps_ns[[0, -1]])
        return _own(sure, first, last, last, None)

    solve_legs(run.recording, known, [begin_ns(run) + 50 * S], LEG_S, solve)
    assert asked[0] == known
    if handed_on:
        assert asked[1] is not None
        assert asked[1].sigma_deg == pytest.approx(np.sqrt(2.0) * sigma_deg)
    else:
        assert asked[1] is None


def test_the_heading_at_the_start_is_none_after_a_gap(run: SimulatedRun) -> None:
    """A vessel that lay moored after one was 45 deg off at a bound of 30: the heading of the run's start was taken for that of each part."""
    assert run.recording.imu is not None
    t = (run.recording.imu.stamps_ns - begin_ns(run)) * 1e-9
    paused = replace(run.recording, imu=run.recording.imu.where((t < 30.0) | (t > 60.0)))
    asked, known = list[KnownHeading | None](), KnownHeading(12.0, 3.0)

    def solve(_part: Recording, heading: KnownHeading | None) -> Solution:
        asked.append(heading)
        raise SolveError("only asked")

    with pytest.raises(SolveError, match="only asked"):
        solve_parts(paused, known, 20.0, 1800.0, {"gnss"}, solve)
    assert asked == [known, None]
    config = run.config.with_start_heading(*known)
    assert (config.start.heading_deg, config.start.heading_sigma_deg) == known
    assert config.with_start_heading(None).start.heading_sigma_deg == known.sigma_deg


def test_a_leg_without_a_place_is_no_reason_to_fail() -> None:
    run = simulate(replace(LOOPS, duration_s=60.0), 3)
    first = begin_ns(run)
    early = tuple(m for m in run.recording.measurements if isinstance(m, CompassHeading) or m.stamp_ns < first + 20 * S)
    found = solved(run, 30.0, early, rate_hz=0.625)
    (said,) = found.stats.events
    assert "solved in one piece, not in legs: a leg failed" in said
    assert "no position" in said
    assert found.trajectory.stamps_ns[-1] > first + 55 * S


def test_a_sensor_that_fell_silent_was_heard_in_the_leg_before(run: SimulatedRun) -> None:
    first = begin_ns(run)
    quiet = tuple(m for m in run.recording.measurements if not isinstance(m, PoseFix) or m.stamp_ns < first + 30 * S)
    found = solved(run, measurements=quiet, rate_hz=0.625)
    name = next(m.sensor for m in run.recording.of(PoseFix))
    seconds = (found.trajectory.stamps_ns - first) * 1e-9
    since = found.since_agreed_s[name][seconds > 35.0]
    assert np.isfinite(since).all()
    heard = seconds[seconds > 35.0] - since
    assert np.ptp(heard) < 0.1
    assert 20.0 < heard[0] < 30.1


def test_legs_that_lie_apart_are_a_warning(run: SimulatedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the second leg all places are 5 m off, to the metre known: the track would step there, and say nothing."""
    solve, count = graphloc.solve.make_solution, [0]

    def shifted(*args: Any) -> Solution:
        count[0] += 1
        found = solve(*args)
        off_m = np.array([5.0 * (count[0] == 2), 0.0, 0.0])
        return replace(found, trajectory=replace(found.trajectory, p_world_m=found.trajectory.p_world_m + off_m))

    monkeypatch.setattr(graphloc.solve, "make_solution", shifted)
    few = tuple(m for m in run.recording.measurements if not isinstance(m, CompassHeading) or m.seq % 4 == 0)
    found = solved(run, measurements=few)
    (said,) = [w for w in found.stats.warnings if "overlapping legs" in w]
    assert float(said.rpartition("at most ")[2].split(" m")[0]) == pytest.approx(5.0, abs=0.3)
    assert "more than their bounds allow" in said
    assert found.stats.events == ()


def test_legs_overlap_by_a_minute_to_each_side_and_less_where_they_are_short() -> None:
    assert overlap_ns(1800.0) == 60 * S
    assert overlap_ns(60.0) == 12 * S


def test_turning_where_legs_meet_is_no_jump(legs: Solution) -> None:
    yaw = np.unwrap(legs.trajectory.yaw_rad)
    dt = np.diff(legs.trajectory.stamps_ns) * 1e-9
    rate = legs.gyro_radps[:-1, 2]
    assert np.abs(wrap_angle(np.diff(yaw) - rate * dt)).max() < np.radians(2.0)


def test_a_figure_that_each_leg_finds_anew_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an IMU configured with a tenth of its noise: the line of the leg that needs most, not one of each leg."""
    noisy: dict[str, Any] = {"accel_noise_ug_per_sqrt_hz": 2000.0, "gyro_noise_mdps_per_sqrt_hz": 40.0}
    run = simulate(replace(LOOPS, duration_s=60.0, pose_hz=2.0, pose_sigma_m=0.05, false_fraction=0.0, **noisy), 1)
    make, lines = graphloc.solve.make_solution, list[str]()

    def noted(*args: Any) -> Solution:
        found = make(*args)
        lines.extend(w for w in found.stats.warnings if "configured too small" in w)
        return found

    def times(line: str) -> float:
        return max(float(to) / float(of) for of, to in re.findall(r"is ([0-9.e+]+), ([0-9.e+]+) is taken", line))

    monkeypatch.setattr(graphloc.solve, "make_solution", noted)
    imu = run.config.sensors["imu"].model_copy(update={name: 0.1 * value for name, value in noisy.items()})
    found = solved(replace(run, config=run.config.with_sensors({"imu": imu})), 30.0, rate_hz=0.625)
    assert len(set(lines)) == 2  # or there is nothing to join
    (said,) = (w for w in found.stats.warnings if "configured too small" in w)
    assert said == f"{max(lines, key=times)} (the worst of 2 parts of the run that show this)"


def test_what_parts_estimate_of_a_sensor_counts_by_their_length() -> None:
    """5 s after a gap had counted as half an hour before it."""
    half_an_hour = {"gnss": np.array([0.4, 0.0, 1.0]), "log": 0.2}
    found = mean_of([half_an_hour, {"gnss": np.array([0.0, 0.0, 0.0])}], [900, 100])
    np.testing.assert_allclose(found["gnss"], [0.36, 0.0, 0.9])
    assert float(found["log"]) == pytest.approx(0.2)
