"""Stretches of a run at a floating dock: ends between two nodes of its motion, and what is handed on to the next one."""

from functools import cache

import gtsam
import numpy as np

from graphloc import app, keys
from graphloc.build import Problem, StartPrior, build_graph, make_problem, state_keys, thinned
from graphloc.eval.simulate import find_scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array
from graphloc.judge.decide import Stage, decisions, weigh
from graphloc.judge.linearised import sparse_rows
from graphloc.solve._grow import grow
from graphloc.solve._marginals import marginals
from graphloc.solve._start import solve_start
from graphloc.solve.alignment import align
from graphloc.solve.imu_mount import by_turn
from graphloc.solve.stretch import past_at, solve_stretch, weak_prior
from tests import tagfactory


@cache
def grown() -> tuple[Problem, gtsam.Values, StartPrior]:
    less = {"imu_hz": "50", "gnss_hz": "2", "compass_hz": "4", "lidar_hz": "0", "camera_hz": "0"}
    true = simulate(find_scenario("dock-floating-optimal", {**less, "duration_s": "30", "route_s": "30"}), 1)
    run, _ = tagfactory.sighted(true, rate_hz=3.0)
    datum = app.choose_datum(run.recording, run.config)
    whole = app.with_synthetic(run.recording, run.config, datum)
    problem = make_problem(whole, app.seen_frames(run.config, whole), datum, SENSORS, INERTIAL)
    few = thinned(problem)
    values, prior, known, *_ = solve_start(few.problem, align(problem), lambda *_: None)
    grow(few.problem, values, prior, known, lambda *_: None)
    return problem, few.filled(problem, values), prior


def test_a_stretch_may_end_anywhere() -> None:
    problem, values, _ = grown()
    last = len(problem.timeline) - 1
    seen = next(s for s in problem.streams if s.name == "tags")
    for stop in (int(k) for k in seen.state[len(seen.state) // 2 :][:6]):
        first = stop - 60
        verdicts = weigh(problem, values, first=first, last=stop, stage=Stage.FINAL)
        assert any(v.at.slow_next is not None for key, v in verdicts.items() if key[0] == seen.number)
        start = weak_prior(problem, values, first)
        step = solve_stretch(problem, gtsam.Values(values), first, stop, start, decisions(verdicts))
        assert step.moved_m < 2.0  # as far as the weak prior lets it
    assert stop < last


def test_the_past_says_of_a_state_what_the_whole_stretch_says_without_what_comes_after() -> None:
    """Gaussian sums are exact: past and later measurements together are the whole, for each state and for sums of them."""
    problem, values, _ = grown()
    slow_of, last = problem.timeline.slow_of, len(problem.timeline) - 1
    first, stop = 60, last - 40
    verdicts = weigh(problem, values, first=first, last=stop, stage=Stage.FINAL)
    prior = weak_prior(problem, values, first)
    here = gtsam.Values(values)
    for _ in range(6):  # until the tails of the constants' priors stand
        step = solve_stretch(problem, here, first, stop, prior, decisions(verdicts), tol=1e-9)
    whole = marginals(step.graph, step.values)
    for k in (int(np.searchsorted(slow_of, slow_of[at])) for at in (first + 20, first + 60, stop - 30)):
        past = past_at(problem, step, k)
        rest, at = build_graph(problem, step.values, decisions(verdicts), k, stop, past)
        assert sum(chr(key >> 56) == "c" for key in past.known) == 3  # each tag's place in the survey
        at.update(step.values.extract([key for key in list(at.keys()) if keys.is_leaf(key)]))
        later = marginals(rest, at)
        np.testing.assert_allclose(
            [later.values.atPose3(keys.pose(n)).translation() for n in (k, stop)],
            [step.values.atPose3(keys.pose(n)).translation() for n in (k, stop)],
            atol=1e-3,
        )
        for key in [*state_keys(problem, k, k + 3), *state_keys(problem, stop, stop), *past.known]:
            np.testing.assert_allclose(later.cov[key], whole.cov[key], rtol=1e-3, atol=1e-9)
        # A place and what GNSS is off there (place less fix) are hardly known apart; together they are.
        gnss = next(s for s in problem.streams if s.name == "gnss")
        joint = _joint(past.factors, step.values, [keys.pose(k), keys.slow(gnss.number, int(slow_of[k]))])
        turn = step.values.atPose3(keys.pose(k)).rotation().matrix()
        place, off, both = turn @ joint[3:6, 3:6] @ turn.T, joint[6:, 6:], turn @ joint[3:6, 6:]
        fix = place + off - both - both.T
        assert np.trace(fix[:2, :2]) < 0.5 * np.trace((place + off)[:2, :2])
        assert joint[3, 3] > 1.1 * whole.cov[keys.pose(k)][3, 3]  # what comes later is not in it


def _joint(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, names: list[int]) -> Array:
    """The covariance of some keys of a graph, pose first, by inverting its information."""
    linear = graph.linearize(values)
    others = [key for key in linear.keyVector() if key not in names]
    jacobian, _ = linear.jacobian(gtsam.Ordering(names + others))
    size = 6 + sum(len(np.atleast_1d(values.atVector(key))) for key in names[1:])
    return np.asarray(np.linalg.inv(jacobian.T @ jacobian)[:size, :size])


def test_sightings_do_not_turn_with_the_mount_of_the_imu() -> None:
    """Beside the IMU's links, of nine rows each, only its levelling does; leaves come before biases in the columns."""
    problem, values, prior = grown()
    last = len(problem.timeline) - 1
    assert prior.level is not None
    verdicts = weigh(problem, values, first=0, last=last, stage=Stage.FINAL)
    graph, guess = build_graph(problem, values, decisions(verdicts), 0, last, prior)
    assert sum(keys.is_leaf(int(key)) for key in np.array(list(guess.keys()), dtype=np.uint64)) > 20
    J, _ = sparse_rows(graph, guess)
    turned = np.flatnonzero(by_turn(J, last + 1).any(axis=1))
    assert (turned >= 9 * last).sum() == 2
