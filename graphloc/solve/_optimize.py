# SPDX-License-Identifier: Apache-2.0
"""GTSAM's optimiser, with settings that are stable with chains of slow biases."""

from __future__ import annotations

from typing import NamedTuple

import gtsam

from graphloc.errors import not_solved

_ABSOLUTE_TOL = 1e-3  # nats of the cost: decisions depend on whole ones; a choice
_AS_PROMISED = 0.1  # share of the tolerance within which a step agrees with the linear model
_HOPELESS = 1e6  # times the initial cost: full steps do not recover from there


class Optimized(NamedTuple):
    """Result of one optimisation.

    Attributes:
        values: the best that were found. iterations: number of those that it took. error: half of the weighted squares.
    """

    values: gtsam.Values
    iterations: int
    error: float


def optimize(
    graph: gtsam.NonlinearFactorGraph,
    guess: gtsam.Values,
    max_iterations: int,
    relative_tol: float = 1e-4,
) -> Optimized:
    """Minimise with Gauss-Newton, and with Levenberg-Marquardt where that does not reduce the cost.

    Full steps: from a start some degrees and metres off, the first one overshoots (cost x 60) and the second converges;
    a method that accepts no increase of the cost takes many short steps instead (measured: 3 against 48 iterations,
    docs/decisions). QR: with Cholesky the solver stops early, not converged, on slow biases.

    Args:
        relative_tol: of the error. Iterations end where a step reduces it by less, or where the reduction equals that
            of the linear model to a tenth of this: then no nonlinearity is left that another step could correct.

    Raises:
        SolveError: the linear algebra failed (an undetermined state, or a value that is not finite).
    """
    stepper = _stepper(graph, guess)
    initial = last = float(stepper.error())
    values, best, lowest, used = guess, guess, initial, 0
    try:
        while used < max_iterations:
            linear = stepper.iterate()
            following, error, used = _of(stepper), float(stepper.error()), used + 1
            if not error < _HOPELESS * (initial + 1.0):  # also if it is NaN
                break
            if error < lowest:
                best, lowest = following, error
            enough = relative_tol * error + _ABSOLUTE_TOL
            if abs(last - error) <= enough:
                break
            promised = _promised(linear, values, following)
            if abs(last - error - promised) <= _AS_PROMISED * enough:
                break
            values, last = following, error
            del linear  # before the next one is made
    except RuntimeError:
        pass  # a full step led to where states are undetermined: the damped method stays near the start
    if lowest < initial or (used == 1 and abs(lowest - initial) <= relative_tol * initial + _ABSOLUTE_TOL):
        return Optimized(best, used, lowest)
    return _levenberg_marquardt(graph, guess, max_iterations, relative_tol, used)


def _stepper(graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values) -> gtsam.GaussNewtonOptimizer:
    """Return an optimiser that takes full steps.

    `eliminateMultifrontal` with QR would call back into Python for each clique, a fifth of its time.
    """
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    return gtsam.GaussNewtonOptimizer(graph, guess, params)


def _promised(linear: gtsam.GaussianFactorGraph, values: gtsam.Values, following: gtsam.Values) -> float:
    """Return by how much a step lowers the cost of the linear model, nats: half its squared length in sigmas."""
    return float(linear.error(values.zeroVectors()) - linear.error(values.localCoordinates(following)))


def _of(stepper: gtsam.GaussNewtonOptimizer) -> gtsam.Values:
    """Return a copy of the optimiser's values: what `values` returns refers to memory that the next step frees."""
    return gtsam.Values(stepper.values())


def _levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, max_iterations: int, relative_tol: float, used: int
) -> Optimized:
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(relative_tol)
    params.setAbsoluteErrorTol(_ABSOLUTE_TOL)
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, guess, params)
        values = optimizer.optimize()
    except RuntimeError as error:
        raise not_solved("the solver failed", error) from error
    return Optimized(values, used + optimizer.iterations(), optimizer.error())


def full_step(graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values) -> tuple[gtsam.Values, float]:
    """Return the values after one full step from near the solution, and by how much it should lower the cost, nats.

    The latter is by the linear model.

    Raises:
        SolveError: a state is not determined.
    """
    try:
        stepper = _stepper(graph, guess)
        linear = stepper.iterate()
        values = _of(stepper)
        return values, _promised(linear, guess, values)
    except RuntimeError as error:
        raise not_solved("the solver failed", error) from error
