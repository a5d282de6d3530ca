# SPDX-License-Identifier: Apache-2.0
"""A load of fixed size, in the same process as what is timed: times divided by its own say less of the machine."""

from __future__ import annotations

import time

import gtsam
import numpy as np

_POSES, _SOLVES = 300, 2000


def kernel_s() -> float:
    """The shortest of five: a chain of poses solved by GTSAM with QR, and small linear solves in numpy."""
    took = []
    for _ in range(5):
        begin = time.process_time()
        _chain()
        _solves()
        took.append(time.process_time() - begin)
    return min(took)


def _chain() -> None:
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    step = gtsam.Pose3(gtsam.Rot3.Ypr(0.02, 0.0, 0.0), np.array([1.0, 0.0, 0.0]))
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise))
    for k in range(_POSES):
        guess.insert(k, gtsam.Pose3(gtsam.Rot3.Ypr(0.02 * k, 0.0, 0.0), np.array([float(k), 0.1 * k, 0.0])))
        if k:
            graph.add(gtsam.BetweenFactorPose3(k - 1, k, step, noise))
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    optimizer = gtsam.GaussNewtonOptimizer(graph, guess, params)
    for _ in range(3):
        optimizer.iterate()


def _solves() -> None:
    matrix = np.eye(3) + 0.1
    for k in range(_SOLVES):
        np.linalg.solve(matrix, np.full(3, float(k)))
