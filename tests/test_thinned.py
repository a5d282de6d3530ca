"""A thinned run: that it says of its states what the whole run says, and what is left in it."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np

from graphloc import app, keys
from graphloc.build import Decided, Problem, Thinned, attach, build_graph, make_problem, thinned
from graphloc.eval.simulate import Scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.graph import Decision
from graphloc.solve._marginals import Marginals, marginals
from graphloc.solve._optimize import optimize
from graphloc.solve.stretch import weak_prior


def problem_of(scenario: Scenario, slow_period_s: float = 1.0) -> tuple[Problem, gtsam.Values]:
    """A run of 20 s, and its truth as an estimate."""
    run = simulate(replace(scenario, duration_s=20.0), 3)
    timeline = run.config.timeline.model_copy(update={"slow_period_s": slow_period_s})
    config = run.config.model_copy(update={"timeline": timeline})
    datum = app.choose_datum(run.recording, config)
    problem = make_problem(app.with_synthetic(run.recording, config, datum), config, datum, SENSORS, INERTIAL)
    truth, values = run.truth.at(problem.timeline.stamps_ns), gtsam.Values()
    velocities = truth.v_world_mps
    assert velocities is not None
    for k in range(len(problem.timeline)):
        R = truth.R_world_body[k]
        values.insert(keys.pose(k), gtsam.Pose3(gtsam.Rot3(R), truth.p_world_m[k] + R @ problem.t_body_imu_m))
        values.insert(keys.velocity(k), velocities[k])
    for j in range(len(problem.timeline.slow_stamps_ns)):
        values.insert(keys.bias(j), gtsam.imuBias.ConstantBias())
        for stream in problem.streams:
            if stream.slow is not None:
                values.insert(keys.slow(stream.number, j), np.zeros(len(stream.slow.sigma)))
    return problem, values


@cache
def usual() -> tuple[Problem, gtsam.Values, Thinned]:
    problem, values = problem_of(Scenario(path="loops", noise="drift"))
    return problem, values, thinned(problem)


def solved(problem: Problem, values: gtsam.Values, chosen: dict[int, list[int]]) -> tuple[gtsam.Values, Marginals]:
    """The solution with these measurements, all believed, and its covariances."""
    prior, last = weak_prior(problem, values, 0), len(problem.timeline) - 1
    for _ in range(3):  # where measurements attach follows the estimate
        decided = {
            (s.number, i): Decided(Decision(), attach(problem, s, i, values))
            for s in problem.streams
            for i in chosen[s.number]
        }
        graph, guess = build_graph(problem, values, decided, 0, last, prior, jumps=False)
        values = optimize(graph, guess, 20, 1e-9).values
    return values, marginals(graph, values)


def test_a_thinned_run_says_of_its_states_what_the_whole_one_says_with_the_same_measurements() -> None:
    problem, values, few = usual()
    assert len(few.states) < 0.5 * len(problem.timeline)
    # As thin, each measurement stands for a second of its slow error's walk; alike, they must be as many.
    spaced = tuple(replace(s, apart_s=np.full(len(s.measurements), np.inf)) for s in problem.streams)
    whole, whole_said = solved(
        replace(problem, streams=spaced), values, {number: few.chosen[number].tolist() for number in few.chosen}
    )
    every = {s.number: list(range(len(s.measurements))) for s in few.problem.streams}
    thin, thin_said = solved(few.problem, few.of(values), every)
    for k, at in enumerate(few.states.tolist()):
        one, other = thin.atPose3(keys.pose(k)), whole.atPose3(keys.pose(at))
        apart = other.localCoordinates(one)
        assert np.abs(apart[:3]).max() < np.radians(0.02)
        assert np.abs(apart[3:]).max() < 0.005
        np.testing.assert_allclose(thin.atVector(keys.velocity(k)), whole.atVector(keys.velocity(at)), atol=0.005)
        if k % 5 == 0:
            mine, theirs = thin_said.cov[keys.pose(k)], whole_said.cov[keys.pose(at)]
            np.testing.assert_allclose(np.sqrt(np.diagonal(mine)), np.sqrt(np.diagonal(theirs)), rtol=0.01)


def test_what_lies_between_is_filled_from_the_state_before() -> None:
    problem, values, few = usual()
    chosen = {s.number: list(range(len(s.measurements))) for s in problem.streams}
    whole, _ = solved(problem, values, chosen)
    filled = few.filled(problem, few.of(whole))
    assert set(filled.keys()) == {key for key in whole.keys() if not keys.is_leaf(key)}  # noqa: SIM118 - gtsam.Values
    for k in range(len(problem.timeline)):
        apart = whole.atPose3(keys.pose(k)).localCoordinates(filled.atPose3(keys.pose(k)))
        assert np.abs(apart[3:]).max() < (1e-9 if k in few.states else 0.05)
        assert np.abs(apart[:3]).max() < np.radians(0.2)


def test_a_state_a_second_at_least_and_all_that_measurements_want() -> None:
    problem, _, few = usual()
    assert np.diff(few.problem.timeline.stamps_ns).max() <= 1.1e9
    for stream, thin in zip(problem.streams, few.problem.streams, strict=True):
        nodes = problem.timeline.slow_of[stream.state]
        if not stream.row.has_hypotheses:  # one for each node, the first
            assert few.chosen[stream.number].tolist() == [int(np.argmax(nodes == j)) for j in np.unique(nodes)]
        else:
            assert len(thin.measurements) == len(stream.measurements)
        for i, m in enumerate(thin.measurements):
            at = int(few.chosen[stream.number][i])
            assert m is stream.measurements[at]
            assert few.states[thin.state[i]] == stream.state[at]
            assert thin.gyro_radps[i].tolist() == stream.gyro_radps[at].tolist()
            before = stream.carry[at]
            carried = thin.carry[i]
            assert (before is None) == (carried is None)
            if before is not None and carried is not None:
                assert few.states[carried[0]] == before[0]


def test_slow_nodes_seconds_apart_do_not_make_links_longer() -> None:
    problem, _ = problem_of(Scenario(path="loops", gnss_hz=0.2, compass_hz=0.2, pose_hz=0.2), slow_period_s=5.0)
    few = thinned(problem)
    assert len(few.problem.timeline.slow_stamps_ns) <= 5
    assert np.diff(few.problem.timeline.stamps_ns).max() <= 1.1e9


def test_a_hole_keeps_its_states() -> None:
    problem, _, _ = usual()
    stamps = problem.timeline.stamps_ns
    hole = int(stamps[60]) + 30_000_000, int(stamps[90]) - 20_000_000

    class Holed:
        """The links, with a hole in them."""

        def __getattr__(self, name: str) -> object:
            return getattr(problem.links, name)

        def gaps(self) -> list[tuple[int, int]]:
            return [hole]

    few = thinned(replace(problem, links=Holed()))  # type: ignore[arg-type]
    assert set(range(60, 91)) <= set(few.states.tolist())
