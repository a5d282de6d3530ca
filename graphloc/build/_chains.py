# SPDX-License-Identifier: Apache-2.0
"""Steps of what varies slowly: IMU biases, and the slow errors of sensors.

A slow state is a chain of first-order Gauss-Markov steps, from native factors. Its path measure,
exp(-int x'^2/2q - int x^2/2p) with q = 2 s^2/T, p = 2 s^2 T, and x^2/4s^2 at both ends, is a random walk with a
standing prior at each node: exact as the node period goes to 0, and the steps stay free for a robust loss (a
`JacobianFactor` with the decay in it takes none).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np

from graphloc import keys
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import InertialLink, SlowProcess

# A step of a slow state is believed to be a jump beyond this many sigmas.
JUMP = KernelConfig(kind="cauchy", scale=2.0)
CONSTANT_TAILS = 9.0  # of a constant's prior: squared sigmas that double its variance
_NOTHING = 1e6  # sigmas: a prior that says nothing
CHAIN_END = 2.0  # times its variance: the prior at either end of a slow chain


def bias_step(links: InertialLink, j: int, dt_s: float) -> Any:
    """Return the factor of the bias walk from slow node `j` to the next."""
    model = gtsam.noiseModel.Diagonal.Sigmas(links.bias_steps(dt_s))
    return gtsam.BetweenFactorConstantBias(keys.bias(j), keys.bias(j + 1), gtsam.imuBias.ConstantBias(), model)


def slow_begin(slow: SlowProcess, key: int, known: Array) -> Any:
    """Return the prior of a chain's first node; `known`: its estimate, for the tails of what is constant."""
    constant = ~np.isfinite(slow.time_constant_s)
    # Why tails: see `_add_constants` in `_graph.py`.
    tails = np.sqrt(1.0 + (known / slow.sigma) ** 2 / CONSTANT_TAILS)
    tails[[axis in slow.no_tails for axis in slow.axes]] = 1.0
    ends = slow.sigma * np.where(constant, tails, np.sqrt(CHAIN_END))
    return gtsam.PriorFactorVector(key, np.zeros(len(ends)), gtsam.noiseModel.Diagonal.Sigmas(ends))


def slow_step(slow: SlowProcess, key: int, following: int, dt_s: float, *, jumps: bool = True) -> Iterator[Any]:
    """Yield the factors of the step from one node to the next, `dt_s` later."""
    constant, zero = ~np.isfinite(slow.time_constant_s), np.zeros(len(slow.sigma))
    # A constant still gets a step of 1e-4 of its sigma: one key on every state would make the tree dense.
    step = slow.sigma * np.where(constant, 1e-4, np.sqrt(2.0 * dt_s / slow.time_constant_s))
    model: Any = gtsam.noiseModel.Diagonal.Sigmas(step)
    if slow.jumps and jumps:
        model = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(JUMP.scale), model)
    yield gtsam.BetweenFactorVector(key, following, zero, model)
    if not constant.all():
        standing = slow.sigma * np.where(constant, _NOTHING, np.sqrt(2.0 * slow.time_constant_s / dt_s))
        yield gtsam.PriorFactorVector(following, zero, gtsam.noiseModel.Diagonal.Sigmas(standing))


def slow_end(slow: SlowProcess, key: int) -> Iterator[Any]:
    """Yield what closes a chain at its last node."""
    constant = ~np.isfinite(slow.time_constant_s)
    if not constant.all():
        last = np.where(constant, _NOTHING, np.sqrt(CHAIN_END)) * slow.sigma
        yield gtsam.PriorFactorVector(key, np.zeros(len(last)), gtsam.noiseModel.Diagonal.Sigmas(last))
