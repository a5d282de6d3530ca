"""The optimiser: full steps, where they fail, and the thread with the deep stack."""

from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc import keys
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.solve import _on_deep_stack, _passes
from graphloc.solve._marginals import marginals
from graphloc.solve._optimize import full_step, optimize
from graphloc.solve.stretch import moved


def loop(heading_sigma_rad: float) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A straight track of 30 poses by odometry with both ends measured, and a start 2 rad off in heading."""
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    odometry = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.01, 0.01]))
    ends = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, heading_sigma_rad]))
    for k in range(30):
        guess.insert(k, gtsam.Pose2(k * np.cos(2.0), k * np.sin(2.0), 2.0))
        if k:
            graph.add(gtsam.BetweenFactorPose2(k - 1, k, gtsam.Pose2(1.0, 0.0, 0.0), odometry))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(0.0, 0.0, 0.0), ends))
    graph.add(gtsam.PriorFactorPose2(29, gtsam.Pose2(29.0, 0.0, 0.0), ends))
    return graph, guess


def test_comes_down_from_a_start_two_radians_off() -> None:
    graph, guess = loop(10.0)
    found = optimize(graph, guess, 20)
    assert found.error < 1e-3 < graph.error(guess)
    assert found.error == pytest.approx(graph.error(found.values))
    assert abs(found.values.atPose2(15).theta()) < 0.01


def test_a_pass_whose_one_step_leads_uphill_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was left there: of a run with a hole in its IMU a hundred times the cost, and taken for the IMU's noise.

    By e(x) = atan(x) the step from 2 leads to -3.5, and steps of a method that looks at the cost to 0; that from 1 to -0.6, and is enough.
    """

    def off(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        x = float(values.atVector(0)[0])
        if jacobians is not None:
            jacobians[0] = np.array([[1.0 / (1.0 + x * x)]])
        return np.array([np.arctan(x)])

    graph, found = gtsam.NonlinearFactorGraph(), []
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, 0.01), [0], off))
    for begin in (2.0, 1.0):
        guess = gtsam.Values()
        guess.insert(0, np.array([begin]))
        built = (graph, guess)
        monkeypatch.setattr(_passes, "build_graph", lambda *_, built=built, **__: built)
        monkeypatch.setattr(_passes, "moved", lambda *_: 0.0)
        problem: Any = SimpleNamespace(timeline=[0])
        found.append(float(_passes.refine_run(problem, guess, {}, problem).values.atVector(0)[0]))
    assert found == [pytest.approx(0.0, abs=0.01), pytest.approx(1.0 - np.pi / 2.0)]


def test_never_returns_what_is_worse_than_the_guess() -> None:
    graph, guess = loop(0.1)
    for limit in (1, 2, 3):
        assert optimize(graph, guess, limit).error <= graph.error(guess)


def test_a_state_that_nothing_holds_is_reported() -> None:
    graph, guess = loop(1.0)
    guess.insert(99, gtsam.Pose2())
    graph.add(gtsam.BetweenFactorPose2(99, 100, gtsam.Pose2(), gtsam.noiseModel.Unit.Create(3)))
    guess.insert(100, gtsam.Pose2())
    with pytest.raises(SolveError, match=r"the solver failed: .* undetermined") as error:
        full_step(graph, guess)
    assert not any(word in str(error.value).lower() for word in ("variable", "gtsam", "exception"))  # its own words


def test_a_fault_of_ours_is_not_put_on_the_data() -> None:
    """A graph that asks for a state which nobody has guessed."""
    graph, guess = loop(1.0)
    graph.add(gtsam.BetweenFactorPose2(0, 99, gtsam.Pose2(), gtsam.noiseModel.Unit.Create(3)))
    for solve in (lambda: full_step(graph, guess), lambda: marginals(graph, guess)):
        with pytest.raises(SolveError, match=r": a fault in graphloc, not in the data; .* RuntimeError: .*99") as error:
            solve()
        assert not any(word in str(error.value) for word in ("undetermined", "measurements", "inspect"))


def test_full_step_solves_a_linear_problem_and_gives_its_covariance() -> None:
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorVector(0, np.array([1.0, 2.0]), gtsam.noiseModel.Isotropic.Sigma(2, 0.5)))
    graph.add(gtsam.PriorFactorVector(0, np.array([3.0, 2.0]), gtsam.noiseModel.Isotropic.Sigma(2, 0.5)))
    guess.insert(0, np.array([100.0, -50.0]))
    values, promised = full_step(graph, guess)
    np.testing.assert_allclose(values.atVector(0), [2.0, 2.0], atol=1e-9)
    assert promised == pytest.approx(graph.error(guess) - graph.error(values))
    np.testing.assert_allclose(marginals(graph, guess).cov[0], np.eye(2) * 0.125, atol=1e-12)


def test_a_step_that_came_out_as_promised_is_the_last() -> None:
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorVector(0, np.array([1.0, 2.0]), gtsam.noiseModel.Isotropic.Sigma(2, 0.5)))
    guess.insert(0, np.array([100.0, -50.0]))
    linear = optimize(graph, guess, 20)
    assert linear.iterations == 1
    np.testing.assert_allclose(linear.values.atVector(0), [1.0, 2.0], atol=1e-9)
    # A fix 4 sigmas off under a loss: the weight that the first step is made with is not the one where it ends.
    loss = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    )
    graph.add(gtsam.PriorFactorVector(0, np.array([3.0, 2.0]), loss))
    bent = optimize(graph, guess, 20)
    assert bent.iterations > 2
    for way in (-0.02, 0.02):
        near = gtsam.Values()
        near.insert(0, bent.values.atVector(0) + np.array([way, 0.0]))
        assert graph.error(near) > bent.error


def test_moved_counts_a_radian_as_ten_metres() -> None:
    old, new = gtsam.Values(), gtsam.Values()
    for k, (turn, way) in enumerate([(0.0, 0.2), (0.05, 0.3), (-0.04, 0.0)]):
        pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 3.0), np.array([1.0, 2.0, 3.0]))
        old.insert(keys.pose(k), pose)
        new.insert(keys.pose(k), pose.compose(gtsam.Pose3(gtsam.Rot3.Rz(turn), np.array([0.0, way, 0.0]))))
    assert moved(old, new) == pytest.approx(0.3 + 10.0 * 0.05)


def test_deep_stack_hands_on_results_and_errors() -> None:
    assert _on_deep_stack(lambda: 42) == 42

    def fails() -> int:
        raise SolveError("as it is")

    with pytest.raises(SolveError, match="as it is"):
        _on_deep_stack(fails)
