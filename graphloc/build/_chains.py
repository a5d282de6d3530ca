# SPDX-License-Identifier: Apache-2.0
"""Steps of what varies slowly: IMU biases, and the slow errors of sensors.

A slow state is a chain of first-order Gauss-Markov steps, from native factors. Its path measure,
exp(-int x'^2/2q - int x^2/2p) with q = 2 s^2/T, p = 2 s^2 T, and x^2/4s^2 at both ends, is a random walk with a
standing prior at each node: exact as the node period goes to 0, and the steps stay free for a robust loss (a
`JacobianFactor` with the decay in it takes none). So do the priors: what may stand far off (`SlowProcess.far`) has
tails, w = 1 / (1 + x^2 / (F s)^2) on all of its part of the measure, so that of two levels one is the usual one.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import InertialLink, SlowProcess

# A step of a slow state is believed to be a jump beyond this many sigmas.
JUMP = KernelConfig(kind="cauchy", scale=2.0)
_FAR = 2.0  # sigmas from which on an error that may stand far off is believed to
CONSTANT_TAILS = 9.0  # of a constant's prior: squared sigmas that double its variance
_NOTHING = 1e6  # sigmas: a prior that says nothing
_CHAIN_END = 2.0  # times its variance: the prior at either end of a slow chain


def bias_step(links: InertialLink, j: int, dt_s: float) -> Any:
    """Return the factor of the bias walk from slow node `j` to the next."""
    model = gtsam.noiseModel.Diagonal.Sigmas(links.bias_steps(dt_s))
    return gtsam.BetweenFactorConstantBias(keys.bias(j), keys.bias(j + 1), gtsam.imuBias.ConstantBias(), model)


def slow_begin(slow: SlowProcess, key: int, known: Array, *, jumps: bool = True) -> Iterator[Any]:
    """Yield the priors of a chain's first node; `known`: its estimate, for the tails of what is constant."""
    constant = ~np.isfinite(slow.time_constant_s)
    if constant.any():
        # Why tails: see `_add_constants` in `_graph.py`.
        tails = np.sqrt(1.0 + (known / slow.sigma) ** 2 / CONSTANT_TAILS)
        tails[[axis in slow.no_tails for axis in slow.axes]] = 1.0
        yield _prior(key, slow.sigma * np.where(constant, tails, _NOTHING))
    yield from _standing(slow, key, np.full(len(constant), _CHAIN_END), jumps=jumps)


def slow_step(
    slow: SlowProcess, key: int, following: int, dt_s: float, *, jumps: bool = True, jump_m: float = 0.0
) -> Iterator[Any]:
    """Yield the factors of the step from one node to the next, `dt_s` later; `jump_m`: it has leapt by so much, or something else has."""
    constant = ~np.isfinite(slow.time_constant_s)
    # A constant still gets a step of 1e-4 of its sigma: one key on every state would make the tree dense.
    step = slow.sigma * np.where(constant, 1e-4, np.sqrt(2.0 * dt_s / slow.time_constant_s))
    if jump_m > 0.0:
        step = np.where(_far(slow), jump_m, step)
    model: Any = gtsam.noiseModel.Diagonal.Sigmas(step)
    if slow.jumps and jumps and jump_m == 0.0:
        model = _with_tails(model, JUMP.scale)
    yield gtsam.BetweenFactorVector(key, following, np.zeros(len(step)), model)
    yield from _standing(slow, following, 2.0 * slow.time_constant_s / dt_s, jumps=jumps)


def slow_end(slow: SlowProcess, key: int, *, jumps: bool = True) -> Iterator[Any]:
    """Yield what closes a chain at its last node."""
    yield from _standing(slow, key, np.full(len(slow.sigma), _CHAIN_END), jumps=jumps)


def walk_between_nodes(slow: SlowProcess, period_s: float, apart_s: float) -> Array:
    """Variance (k,) that each measurement's share is of what a slow state walks between its nodes, where it is held.

    n of them, h apart, at one node: their mean is off by what the state has walked since the first in the mean, of variance q h (n - 1)
    (2n - 1) / 6n, whatever their noise. So each has n times that. Without, fixes good to centimetres know the speed to
    centimetres a second, by a slow error that walks decimetres.

    Args:
        period_s: of the nodes. apart_s: h.
    """
    n = max(period_s / max(apart_s, 1e-3), 1.0)
    return np.asarray(_walk_rate(slow) * (period_s / n * (n - 1.0) * (2.0 * n - 1.0) / 6.0))


@lru_cache(maxsize=64)
def _walk_rate(slow: SlowProcess) -> Array:
    """Variance (k,) that a process gains in a second."""
    return np.where(np.isfinite(slow.time_constant_s), 2.0 * slow.sigma**2 / slow.time_constant_s, 0.0)


def closing_variance(slow: SlowProcess, value: Array) -> Array:
    """Variance (k,) of what closes a chain, as it weighs where its last node is `value`; inf for constants."""
    far = _far(slow)
    square = float(((value[far] / slow.sigma[far]) ** 2).sum())
    tails = np.where(far, 1.0 + square / _FAR**2, 1.0)
    return np.where(np.isfinite(slow.time_constant_s), _CHAIN_END * slow.sigma**2 * tails, np.inf)


def standing_cost(slow: SlowProcess, path: Array, dt_s: Array) -> float:
    """What a whole chain costs, in nats, by where it stands; of what may stand far off alone.

    Args:
        path: (N, k) nodes. dt_s: (N - 1,) between them.
    """
    far = _far(slow)
    square = ((path[:, far] / slow.sigma[far]) ** 2).sum(axis=1)
    held = np.concatenate([[1.0 / _CHAIN_END], dt_s / (2.0 * float(slow.time_constant_s[far].max()))])
    held[-1] += 1.0 / _CHAIN_END
    return float(held @ np.log1p(square / _FAR**2)) * _FAR**2 / 2.0


def _standing(slow: SlowProcess, key: int, times: Array, *, jumps: bool) -> Iterator[Any]:
    """Yield the priors that hold a node where the process stands, `times` (k,) its variance; constants are not held.

    What may stand far off has a prior of its own: heights above another zero must not set places free.
    """
    held, far = np.isfinite(slow.time_constant_s), _far(slow) & jumps
    for part in (held & ~far, held & far):
        if part.any():
            tails = _FAR / float(np.sqrt(times[part].max())) if far[part].all() else None
            yield _prior(key, slow.sigma * np.where(part, np.sqrt(times), _NOTHING), tails)


def _far(slow: SlowProcess) -> NDArray[np.bool_]:
    return np.array([axis in slow.far for axis in slow.axes])


def _prior(key: int, sigmas: Array, tails: float | None = None) -> Any:
    """Return a prior at zero; `tails`: sigmas from which on it has those of Cauchy's."""
    model: Any = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), model if tails is None else _with_tails(model, tails))


def _with_tails(model: Any, scale: float) -> Any:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(scale), model)
