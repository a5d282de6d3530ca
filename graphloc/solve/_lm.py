# SPDX-License-Identifier: Apache-2.0
"""GTSAM's optimiser and covariances, with the settings that survive bias chains."""

from __future__ import annotations

from typing import Any, NamedTuple

import gtsam

from graphloc.errors import SolveError


class Optimized(NamedTuple):
    """Result of one optimisation: values, iterations, final error (half of the weighted squares)."""

    values: gtsam.Values
    iterations: int
    error: float


def optimize(graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, max_iterations: int) -> Optimized:
    """Minimise with Levenberg-Marquardt. QR: Cholesky stops early and unconverged on slow biases.

    Raises:
        SolveError: the linear algebra failed (a state that nothing holds, or a value that is not finite).
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(1e-4)
    params.setAbsoluteErrorTol(1e-3)
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, guess, params)
        values = optimizer.optimize()
    except RuntimeError as error:
        raise SolveError(f"the solver failed: {' '.join(str(error).split())[:200]}") from error
    return Optimized(values, optimizer.iterations(), optimizer.error())


def bayes_tree(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Any:
    """Return an ISAM2 that holds the graph linearised at `values`, for covariances (`Marginals` has no QR).

    Raises:
        SolveError: a state is not determined.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    tree = gtsam.ISAM2(params)
    try:
        tree.update(graph, values)
    except RuntimeError as error:
        raise SolveError(f"the covariance could not be computed: {' '.join(str(error).split())[:200]}") from error
    return tree
