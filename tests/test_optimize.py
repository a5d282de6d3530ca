"""The optimiser: full steps, where they fail, and the thread with the deep stack."""

import gtsam
import numpy as np
import pytest

from graphloc.errors import SolveError
from graphloc.solve import _on_deep_stack
from graphloc.solve._optimize import bayes_tree, full_step, optimize


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


def test_never_returns_what_is_worse_than_the_guess() -> None:
    graph, guess = loop(0.1)
    for limit in (1, 2, 3):
        assert optimize(graph, guess, limit).error <= graph.error(guess)


def test_a_state_that_nothing_holds_is_said() -> None:
    graph, guess = loop(1.0)
    guess.insert(99, gtsam.Pose2())
    graph.add(gtsam.BetweenFactorPose2(99, 100, gtsam.Pose2(), gtsam.noiseModel.Unit.Create(3)))
    guess.insert(100, gtsam.Pose2())
    with pytest.raises(SolveError, match="variable 99"):
        full_step(graph, guess)


def test_full_step_solves_a_linear_problem_and_gives_its_covariance() -> None:
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorVector(0, np.array([1.0, 2.0]), gtsam.noiseModel.Isotropic.Sigma(2, 0.5)))
    graph.add(gtsam.PriorFactorVector(0, np.array([3.0, 2.0]), gtsam.noiseModel.Isotropic.Sigma(2, 0.5)))
    guess.insert(0, np.array([100.0, -50.0]))
    np.testing.assert_allclose(full_step(graph, guess).atVector(0), [2.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(bayes_tree(graph, guess).marginalCovariance(0), np.eye(2) * 0.125, atol=1e-12)


def test_deep_stack_hands_on_results_and_errors() -> None:
    assert _on_deep_stack(lambda: 42) == 42

    def fails() -> int:
        raise SolveError("as it is")

    with pytest.raises(SolveError, match="as it is"):
        _on_deep_stack(fails)
