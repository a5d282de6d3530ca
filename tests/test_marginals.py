"""Covariances of all variables of a graph at once, against the inverse of its information as a whole."""

from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc import app, keys
from graphloc.build import make_problem
from graphloc.errors import SolveError
from graphloc.eval.simulate import Scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array
from graphloc.solve._marginals import marginals
from graphloc.solve.batch import solve_batch

STEPS, DT_S = 80, 0.1


def track() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Places and velocities along a line, with a drift of each ten steps; 1 km off and to 0.1 mm from one to the next."""
    graph, values, one = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.eye(1)

    def add(sigma: float, target: float, *terms: tuple[int, Array]) -> None:
        whitened: list[Any] = [part for key, jacobian in terms for part in (key, jacobian / sigma)]
        unit = gtsam.noiseModel.Unit.Create(1)
        make: Any = gtsam.JacobianFactor  # the stubs know one overload per number of states
        graph.add(gtsam.LinearContainerFactor(make(*whitened, np.array([target]) / sigma, unit)))

    for k in range(STEPS):
        values.insert(keys.pose(k), np.zeros(1))
        values.insert(keys.velocity(k), np.zeros(1))
        if k % 10 == 0:
            values.insert(keys.bias(k // 10), np.zeros(2))
            add(1.0, 0.3, (keys.bias(k // 10), np.array([[1.0, 2.0]])))
            add(2.0, 0.1, (keys.bias(k // 10), np.array([[-1.0, 1.0]])))
    add(1e3, 0.0, (keys.pose(0), one))
    add(1.0, 0.5, (keys.pose(STEPS - 1), one), (keys.bias(0), np.ones((1, 2))))
    for k in range(1, STEPS):
        before, now, drift = keys.velocity(k - 1), keys.velocity(k), keys.bias((k - 1) // 10)
        add(1e-4, 0.0, (keys.pose(k), one), (keys.pose(k - 1), -one), (before, -DT_S * one))
        add(1e-2, 0.1, (now, one), (before, -one), (drift, np.array([[DT_S, 0.0]])))
        add(10.0, 1.0, (keys.pose(k), one), (drift, np.array([[0.0, 1.0]])))
    return graph, values


def test_values_and_covariances_are_those_of_the_whole_system() -> None:
    graph, values = track()
    order = [key for key, dim in values.dims().items() for _ in range(dim)]
    own = {key: [n for n, of in enumerate(order) if of == key] for key in order}
    ordering = gtsam.Ordering()
    for key in own:
        ordering.push_back(key)
    J, b = graph.linearize(values).jacobian(ordering)
    solution = np.linalg.lstsq(J, b, rcond=None)[0]
    R = np.linalg.inv(np.linalg.qr(J)[1])
    whole = R @ R.T
    pairs = [(keys.pose(3), keys.bias(7)), (keys.bias(0), keys.velocity(70)), (keys.pose(10), keys.velocity(10))]
    found = marginals(graph, values, pairs)
    assert set(found.cov) == set(own)
    for key, n in own.items():
        np.testing.assert_allclose(found.values.atVector(key), solution[n], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.cov[key], whole[np.ix_(n, n)], rtol=1e-6)
    assert list(found.joint) == pairs
    for pair in pairs:
        both = own[pair[0]] + own[pair[1]]
        sigma = np.sqrt(np.diagonal(whole)[both])
        np.testing.assert_allclose(
            found.joint[pair] / np.outer(sigma, sigma), whole[np.ix_(both, both)] / np.outer(sigma, sigma), atol=1e-6
        )
    apart = marginals(graph, values).cov
    for key in own:
        np.testing.assert_allclose(apart[key], found.cov[key], rtol=1e-6)


def test_covariances_of_a_run_are_those_that_gtsam_finds_one_by_one() -> None:
    """Ten states share a slow error: where the next one begins, what is not symmetric to the last bit grows a hundredfold."""
    run = simulate(Scenario(path="loops", noise="drift", duration_s=20.0), 301)
    datum = app.choose_datum(run.recording, run.config)
    recording = app.with_synthetic(run.recording, run.config, datum)
    result = solve_batch(make_problem(recording, run.config, datum, SENSORS, INERTIAL))
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    tree = gtsam.ISAM2(params)
    tree.update(result.graph, result.values)
    assert len(result.cov) > 400
    for key, cov in result.cov.items():
        sigma = np.sqrt(np.diagonal(cov))
        np.testing.assert_allclose(
            tree.marginalCovariance(key) / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-6
        )


def test_what_nothing_determines_is_no_covariance() -> None:
    """Of a variable of two, of which one component is measured: the other was known exactly."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(keys.velocity(0), np.zeros(2))
    measured = gtsam.JacobianFactor(
        keys.velocity(0), np.array([[1.0, 0.0], [0.0, 0.0]]), np.zeros(2), gtsam.noiseModel.Unit.Create(2)
    )
    graph.add(gtsam.LinearContainerFactor(measured, values))
    with pytest.raises(SolveError, match="the covariance could not be computed"):
        marginals(graph, values)
