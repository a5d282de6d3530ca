# SPDX-License-Identifier: Apache-2.0
"""Factors of slowly varying states: IMU biases, and the slow errors of sensors.

A slow error is a first-order Gauss-Markov process (sigma s, time constant T), built from native factors. Its path measure,
exp(-int x'^2/2q - int x^2/2p) with q = 2 s^2/T, p = 2 s^2 T, and x^2/4s^2 at both ends, is a random walk with a prior
about 0 at each node. That is exact as the node period goes to 0, and leaves the steps free for a robust loss (a
`JacobianFactor` that contains the decay takes none); the priors, too: components that may stay far off (`SlowProcess.far`)
have tails, w = 1 / (1 + x^2 / (F s)^2), on all of their part of the measure, so that of two levels one is the usual one. Once it
is known which, only the nodes at that level have a prior (`at_level`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import CONSTANT_TAILS, InertialLink, SlowProcess
from graphloc.time import NS_PER_S, duration_ns

# Loss of a step: beyond this many sigmas it counts as a jump.
JUMP = KernelConfig(kind="cauchy", scale=2.0)
_FAR = 2.0  # F above: sigmas beyond which such a component counts as far off
# Sigmas of the part of a constant's prior that is never weighed otherwise, and half of them the most that it is widened to: a vessel of
# 100 m has its antenna 20 m from where 1 m was drafted.
_WIDEST = 60.0
_NOTHING = 1e6  # sigmas: no information
_NO_DRIFT = 100.0  # times the time constant
_SILENT = 3.0  # times the usual time between measurements
_SPACED_OVER_S = 4.0  # longer than gateways hold messages back
SPACED_BY = 40
"""Measurements up to one, at most, from which it is taken how far apart they come: of the fastest that are used two seconds."""
_CHAIN_END = 2.0  # variances of the process: the prior at either end of a chain


def bias_step(links: InertialLink, j: int, from_ns: int, to_ns: int) -> Any:
    """Return the random walk factor of the bias from slow node `j`, at `from_ns`, to the next."""
    model = gtsam.noiseModel.Diagonal.Sigmas(links.bias_steps(from_ns, to_ns))
    return gtsam.BetweenFactorConstantBias(keys.bias(j), keys.bias(j + 1), gtsam.imuBias.ConstantBias(), model)


def slow_begin(
    slow: SlowProcess, key: int, known: Array | None, *, jumps: bool = True, far: bool = True
) -> Iterator[Any]:
    """Yield the priors of the first node of a chain.

    Args:
        known: (k,) its estimate, which sets the tails of constant components; None: only the part of their prior that is never weighed
            otherwise (see `revisable`); `slow_end` has the other. jumps, far: as in `slow_step`.
    """
    constant = slow.constant
    if constant.any():
        tails = np.where(_with_no_tails(slow), 1.0, _WIDEST) if known is None else _tails(slow, known)
        yield _prior(key, slow.sigma * np.where(constant, tails, _NOTHING))
    yield from _standing(slow, key, np.full(len(constant), _CHAIN_END), jumps=jumps, far=far)


def _with_no_tails(slow: SlowProcess) -> NDArray[np.bool_]:
    return np.array([axis in slow.no_tails for axis in slow.axes])


def _tails(slow: SlowProcess, value: Array) -> Array:
    """Return by how much (k,) the priors of constants are widened at a value (k,); why: see `Constant.widened`."""
    return np.where(_with_no_tails(slow), 1.0, np.sqrt(1.0 + (value / slow.sigma) ** 2 / CONSTANT_TAILS))


def revisable(sigma: Array, widened: Array) -> Array:
    """Return the sigmas (k,) of the part of a constant's prior that a window may yet weigh otherwise; with the other part it is `widened`.

    Online a prior that has become part of what was marginalised, or of an anchor, keeps the weight that it had then: an antenna 20 m from its
    mount (1 m, 1 sigma) was held back for good by what it was taken for in the first seconds, as if to 1 m.

    Args:
        sigma: (k,) of the prior. widened: (k,) the same re-weighted at the estimate.
    """
    return np.asarray((np.minimum(widened, 0.5 * _WIDEST * sigma) ** -2 - never_revised(sigma) ** -2) ** -0.5)


def never_revised(sigma: Array) -> Array:
    """Return the sigmas (k,) of the other part."""
    return _WIDEST * sigma


def slow_step(
    slow: SlowProcess,
    key: int,
    following: int,
    dt_s: float,
    *,
    jumps: bool = True,
    far: bool = True,
    jump_m: float = 0.0,
    expected: Array | None = None,
    anew: bool = False,
) -> Iterator[Any]:
    """Yield the factors of the step to the next node, `dt_s` later.

    Args:
        jumps: whether steps have a robust loss. far: whether components that may stay far off have a prior; else see `at_level`.
        jump_m: size of a position jump seen in this step: it, or the vessel, has moved so far.
        expected: (k,) the step, where it is known besides.
        anew: whether one chain ends here and another begins: all but constants is drawn anew (`SlowProcess.anew_after_s`).
    """
    constant = slow.constant
    # A constant still gets a step of 1e-4 of its sigma: one key on every state would make the tree dense.
    step = slow.sigma * np.where(constant, 1e-4, np.sqrt(2.0 * dt_s / slow.time_constant_s))
    if anew:
        step = np.where(constant, step, slow.sigma * _NOTHING)
    elif jump_m > 0.0:
        step = np.where(slow.far_axes, jump_m, step)
    model: Any = gtsam.noiseModel.Diagonal.Sigmas(step)
    if slow.jumps and jumps and jump_m == 0.0 and not anew:
        model = _with_tails(model, JUMP.scale)
    yield gtsam.BetweenFactorVector(key, following, np.zeros(len(step)) if expected is None else expected, model)
    if anew:
        yield from slow_end(slow, key, jumps=jumps, far=far)
        yield from slow_end(slow, following, jumps=jumps, far=far)
    else:
        yield from _standing(slow, following, 2.0 * slow.time_constant_s / dt_s, jumps=jumps, far=far)


def without_drift(slow: SlowProcess) -> SlowProcess:
    """Return a slow process that hardly moves but where it jumps: nothing tells a drift from motion, but the IMU tells a jump."""
    return replace(slow, time_constant_s=_NO_DRIFT * slow.time_constant_s)


def silent_s(slow: SlowProcess, apart_s: float) -> float:
    """Return after how long without a measurement a slow error is drawn anew, of a sensor whose measurements are usually so far apart, s."""
    return max(slow.anew_after_s, _SILENT * apart_s)


def slow_end(
    slow: SlowProcess, key: int, value: Array | None = None, *, jumps: bool = True, far: bool = True
) -> Iterator[Any]:
    """Yield the priors that close a chain at its last node.

    Args:
        value: (k,) that node, where the prior of constants is here (see `slow_begin`). jumps, far: as in `slow_step`.
    """
    yield from _standing(slow, key, np.full(len(slow.sigma), _CHAIN_END), jumps=jumps, far=far)
    if value is not None and (slow.constant & ~_with_no_tails(slow)).any():
        variance = closing_variance(slow, value)
        yield _prior(key, np.where(slow.constant & np.isfinite(variance), np.sqrt(variance), _NOTHING * slow.sigma))


def at_level(
    slow: SlowProcess,
    names: Sequence[int],
    dt_s: Array,
    usual: NDArray[np.bool_],
    anew: NDArray[np.bool_] | None = None,
) -> Iterator[Any]:
    """Yield the priors of a chain's components that may stay far off, where it is known which nodes are at the usual level.

    These have a Gaussian one, whose chain ends at the first and last of them; the others none, as a jump may lead anywhere.

    Args:
        names: (N,) the keys of the nodes. dt_s: (N - 1,) between them. usual: (N,). anew: (N - 1,) steps at which it is drawn anew.
    """
    held = _usual_information(slow, dt_s, usual, anew)
    for n in np.flatnonzero(usual):
        yield _prior(names[int(n)], slow.sigma * np.where(slow.far_axes, np.sqrt(1.0 / held[n]), _NOTHING))


def spacing_s(stamps_ns: NDArray[np.int64]) -> Array:
    """Return how far apart measurements come (M,), s, each by the mean of the last seconds before it; inf for one alone.

    Not by the one before alone, nor by the median: a gateway may send five fixes within 10 ms, twice a second.

    Args:
        stamps_ns: (M,) in order.
    """
    at = np.arange(len(stamps_ns))
    first = np.maximum(np.searchsorted(stamps_ns, stamps_ns - duration_ns(_SPACED_OVER_S)), at - SPACED_BY)
    mean_s = (stamps_ns - stamps_ns[first]) / NS_PER_S / np.maximum(at - first, 1)
    return np.where(at > first, np.round(mean_s, 3), np.inf)  # rounded: many are then alike, and reckoned once


@lru_cache(maxsize=256)  # many measurements are equally far apart
def walk_between_nodes(slow: SlowProcess, period_s: float, apart_s: float) -> Array:
    """Return the variance (k,) to add to each measurement, because its slow error walks on between two nodes.

    n measurements, h apart, share one node. Whatever their noise, their mean is off by the mean walk since the first, of
    variance q h (n - 1)(2n - 1) / 6n; so each gets n times that. Without it, fixes good to centimetres would determine the
    speed to centimetres per second, although their slow error walks by decimetres.

    Args:
        period_s: of the nodes. apart_s: h.
    """
    n = max(period_s / max(apart_s, 1e-3), 1.0)
    rate = np.where(slow.constant, 0.0, 2.0 * slow.sigma**2 / slow.time_constant_s)
    walk = rate * (period_s / n * (n - 1.0) * (2.0 * n - 1.0) / 6.0)
    walk.setflags(write=False)
    return walk


def closing_variance(slow: SlowProcess, value: Array) -> Array:
    """Return the variance (k,) of the prior that closes a chain, re-weighted at `value` (k,), its last node.

    Of constants that of the revisable part of their prior; inf where there is none.
    """
    far = slow.far_axes
    square = float(((value[far] / slow.sigma[far]) ** 2).sum())
    tails = np.where(far, 1.0 + square / _FAR**2, 1.0)
    own = np.where(_with_no_tails(slow), np.inf, revisable(slow.sigma, slow.sigma * _tails(slow, value)) ** 2)
    return np.where(slow.constant, own, _CHAIN_END * slow.sigma**2 * tails)


def standing_cost(slow: SlowProcess, path: Array, dt_s: Array, anew: NDArray[np.bool_] | None = None) -> float:
    """Return the cost (nats) of the priors of a whole chain, of the components that may stay far off.

    Args:
        path: (N, k) nodes. dt_s: (N - 1,) between them. anew: (N - 1,) steps at which it is drawn anew.
    """
    far = slow.far_axes
    square = ((path[:, far] / slow.sigma[far]) ** 2).sum(axis=1)
    held = _usual_information(slow, dt_s, np.ones(len(path), dtype=bool), anew)
    return float(held @ np.log1p(square / _FAR**2)) * _FAR**2 / 2.0


def _usual_information(
    slow: SlowProcess, dt_s: Array, usual: NDArray[np.bool_], anew: NDArray[np.bool_] | None
) -> Array:
    """Return the information (N,) of the priors about 0 of a chain, each part of which ends at the first and last of its `usual` nodes."""
    steps = dt_s / (2.0 * float(slow.time_constant_s[slow.far_axes].max()))
    begins = np.flatnonzero(np.zeros(len(dt_s)) if anew is None else anew) + 1
    held = np.concatenate([[0.0], steps])
    held[begins] = 0.0
    for part in np.split(np.arange(len(usual)), begins):
        at_usual = part[usual[part]]
        if len(at_usual):
            held[at_usual[0]] += 1.0 / _CHAIN_END
            held[at_usual[-1]] += 1.0 / _CHAIN_END
    return held


def _standing(slow: SlowProcess, key: int, times: Array, *, jumps: bool, far: bool) -> Iterator[Any]:
    """Yield the priors about 0 of a node, with `times` (k,) the variance of the process; constants have none.

    Components that may stay far off have a prior of their own, or none (`far`): a height above another zero must not loosen the
    horizontal ones.
    """
    held, tailed = ~slow.constant & (far | ~slow.far_axes), slow.far_axes & jumps
    for part in (held & ~tailed, held & tailed):
        if part.any():
            tails = _FAR / float(np.sqrt(times[part].max())) if tailed[part].all() else None
            yield _prior(key, slow.sigma * np.where(part, np.sqrt(times), _NOTHING), tails)


def _prior(key: int, sigmas: Array, tails: float | None = None) -> Any:
    """Return a prior at zero; `tails`: sigmas beyond which it has Cauchy tails."""
    model: Any = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), model if tails is None else _with_tails(model, tails))


def _with_tails(model: Any, scale: float) -> Any:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(scale), model)
