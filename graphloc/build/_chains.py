# SPDX-License-Identifier: Apache-2.0
"""Factors of slowly varying states: IMU biases, and the slow errors of sensors.

A slow error is a first-order Gauss-Markov process (sigma s, time constant T), built from native factors. The density of
its path, exp(-int x'^2/2q - int x^2/2p) with q = 2 s^2/T, p = 2 s^2 T, and x^2/4s^2 at both ends, is that of a random
walk with a prior about 0 at each node. That is exact as the node period goes to 0, and a robust loss may then be put on
the steps (a `JacobianFactor` that contains the decay takes none) and on the priors. Axes that may stay far off
(`SlowProcess.far`) have priors with tails, w = 1 / (1 + x^2 / (F s)^2), so that of two levels between which the error
jumps one is the usual one, near 0. Once it is known which nodes are at the usual level, only these have a prior
(`at_level`).
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
from graphloc.graph import CONSTANT_TAILS, SlowProcess
from graphloc.inertial import InertialLink
from graphloc.time import NS_PER_S, duration_ns

# Loss of a step: beyond this many sigmas it counts as a jump.
JUMP = KernelConfig(kind="cauchy", scale=2.0)
_FAR = 2.0  # F in the prior of an axis that may stay far off: sigmas beyond which it counts as far off
# Times the sigma of a constant's prior: the sigma of its part whose weight never changes, and twice the widest that the
# whole is made by re-weighting. A vessel of 100 m has its antenna 20 m from where 1 m (1 sigma) was drafted.
_WIDEST = 60.0
# Largest step of an axis that follows a jump, in sigmas. Its size was not measured: with 20 sigmas or more, an online window
# that is rebuilt because of a jump of 100 m needs a second to converge, and is 1 to 13 m off meanwhile.
_FOLLOWS = 5.0
_NOTHING = 1e6  # sigmas of a prior without information
_NO_DRIFT = 100.0  # factor on the time constant of a process that hardly drifts
_SILENT = 3.0  # usual times between measurements, from which a sensor is silent
_SPACED_OVER_S = 4.0  # time over which the spacing is taken: longer than gateways hold messages back
SPACED_BY = 40
"""Most measurements before one that tell how far apart they come (`spacing_s`): two seconds of the fastest that are
used."""
_IN_BOUNDS = 1.5  # sigmas of a slow error: size up to which the bounds include a jump, so that it needs no warning
_CHAIN_END = 2.0  # variance of the prior at either end of a chain, in variances of the process


def bias_step(links: InertialLink, j: int, from_ns: int, to_ns: int) -> Any:
    """Return the random walk factor of the bias from slow node `j`, at `from_ns`, to the next."""
    model = gtsam.noiseModel.Diagonal.Sigmas(links.bias_steps(from_ns, to_ns))
    return gtsam.BetweenFactorConstantBias(keys.bias(j), keys.bias(j + 1), gtsam.imuBias.ConstantBias(), model)


def slow_begin(
    slow: SlowProcess, key: int, known: Array | None, *, jumps: bool = True, far: bool = True
) -> Iterator[Any]:
    """Yield the priors of the first node of a chain.

    Args:
        known: (k,) estimate of that node, by which the priors of constants are re-weighted; None: of these priors only
            the part whose weight never changes (`never_revised`), and `slow_end` yields the other. jumps, far: as in
            `slow_step`.
    """
    constant = slow.constant
    if constant.any():
        tails = np.where(_with_no_tails(slow), 1.0, _WIDEST) if known is None else _tails(slow, known)
        yield _prior(key, slow.sigma * np.where(constant, tails, _NOTHING))
    yield from _standing(slow, key, np.full(len(constant), _CHAIN_END), jumps=jumps, far=far)


def _with_no_tails(slow: SlowProcess) -> NDArray[np.bool_]:
    return np.array([axis in slow.no_tails for axis in slow.axes])


def _tails(slow: SlowProcess, value: Array) -> Array:
    """Return the factors (k,) on the sigmas of constants, re-weighted at a value (k,); why: see `Constant.widened`."""
    return np.where(_with_no_tails(slow), 1.0, np.sqrt(1.0 + (value / slow.sigma) ** 2 / CONSTANT_TAILS))


def revisable(sigma: Array, widened: Array) -> Array:
    """Return the sigmas (k,) of the part of a constant's prior whose weight may still change.

    The prior is two factors: a wide one (`never_revised`), and this one, re-weighted at the estimate; together they are
    as wide as `widened`. Online a prior that was marginalised, or became part of an anchor, keeps the weight that it
    had then. As a single factor it held an antenna that was 20 m from its mount (1 m, 1 sigma) back for good, by the
    weight of the first seconds, when the estimate was still near the mount.

    Args:
        sigma: (k,) of the prior. widened: (k,) of the prior re-weighted at the estimate.
    """
    return np.asarray((np.minimum(widened, 0.5 * _WIDEST * sigma) ** -2 - never_revised(sigma) ** -2) ** -0.5)


def never_revised(sigma: Array) -> Array:
    """Return the sigmas (k,) of the part of a constant's prior whose weight never changes; the other: `revisable`."""
    return _WIDEST * sigma


def slow_step(
    slow: SlowProcess,
    key: int,
    following: int,
    dt_s: float,
    *,
    jumps: bool = True,
    far: bool = True,
    jump: float = 0.0,
    expected: Array | None = None,
    anew: bool = False,
) -> Iterator[Any]:
    """Yield the factors of the step to the next node, `dt_s` later.

    Args:
        jumps: whether steps that may be jumps have a robust loss. far: whether axes that may stay far off have a prior
            here; if not, `at_level` yields it.
        jump: size (m, rad) of a jump of positions or a step of headings seen in this step: the error, or the vessel, has
            moved so far. 0: none.
        expected: (k,) mean of the step, where a jump was measured; None: 0.
        anew: whether the error is drawn anew: all axes but constants are then independent of what they were
            (`SlowProcess.anew_after_s`), so that one chain ends here and another begins.
    """
    constant = slow.constant
    # A constant still gets a step of 1e-4 of its sigma: one key on every state would make the tree dense.
    step = slow.sigma * np.where(constant, 1e-4, np.sqrt(2.0 * dt_s / slow.time_constant_s))
    if anew:
        step = np.where(constant, step, slow.sigma * _NOTHING)
    elif jump > 0.0:
        follows = np.array([axis in slow.follows for axis in slow.axes])
        step = np.where(slow.jump_axes, np.where(follows, np.minimum(jump, _FOLLOWS * slow.sigma), jump), step)
    model: Any = gtsam.noiseModel.Diagonal.Sigmas(step)
    if slow.jumps and jumps and jump == 0.0 and not anew:
        model = _with_tails(model, JUMP.scale)
    yield gtsam.BetweenFactorVector(key, following, np.zeros(len(step)) if expected is None else expected, model)
    if anew:
        yield from slow_end(slow, key, jumps=jumps, far=far)
        yield from slow_end(slow, following, jumps=jumps, far=far)
    else:
        yield from _standing(slow, following, 2.0 * slow.time_constant_s / dt_s, jumps=jumps, far=far)


def after_step(slow: SlowProcess, key: int, value: Array) -> Iterator[Any]:
    """Yield the prior of the constants that a step has moved, re-weighted at a value (k,): many come back from where they went."""
    moved = slow.jump_axes & slow.constant & ~_with_no_tails(slow)
    if moved.any():
        yield _prior(key, np.where(moved, slow.sigma * _tails(slow, value), _NOTHING * slow.sigma))


def without_drift(slow: SlowProcess) -> SlowProcess:
    """Return a slow process that hardly moves but where it jumps.

    Nothing tells a drift from motion, but the IMU tells a jump.
    """
    return replace(slow, time_constant_s=_NO_DRIFT * slow.time_constant_s)


def silent_s(slow: SlowProcess, apart_s: float) -> float:
    """Return the silence, s, after which a sensor's slow error is drawn anew.

    Args:
        apart_s: usual time between the sensor's measurements, s.
    """
    return max(slow.anew_after_s, _SILENT * apart_s)


def slow_end(
    slow: SlowProcess, key: int, value: Array | None = None, *, jumps: bool = True, far: bool = True
) -> Iterator[Any]:
    """Yield the priors that close a chain at its last node.

    Args:
        value: (k,) estimate of that node, if the chain began without one (see `slow_begin`): the part of the constants'
            priors whose weight may change is then yielded here. jumps, far: as in `slow_step`.
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
    """Yield the priors of a chain's axes that may stay far off, where it is known which nodes are at the usual level.

    Nodes at the usual level have a Gaussian prior, as of a chain that begins at the first and ends at the last of them.
    The others have none, because a jump may lead anywhere.

    Args:
        names: (N,) keys of the nodes. dt_s: (N - 1,) times between them. usual: (N,) which are at the usual level.
        anew: (N - 1,) steps at which the error is drawn anew; None: none.
    """
    held = _usual_information(slow, dt_s, usual, anew)
    for n in np.flatnonzero(usual):
        yield _prior(names[int(n)], slow.sigma * np.where(slow.far_axes, np.sqrt(1.0 / held[n]), _NOTHING))


def spacing_s(stamps_ns: NDArray[np.int64]) -> Array:
    """Return the mean time (M,), s, between measurements in the seconds before each; inf for one with none before it.

    The time since the one before, or the median, would not do: a gateway may send five fixes within 10 ms, twice a
    second.

    Args:
        stamps_ns: (M,) in order.
    """
    at = np.arange(len(stamps_ns))
    first = np.maximum(np.searchsorted(stamps_ns, stamps_ns - duration_ns(_SPACED_OVER_S)), at - SPACED_BY)
    mean_s = (stamps_ns - stamps_ns[first]) / NS_PER_S / np.maximum(at - first, 1)
    return np.where(at > first, np.round(mean_s, 3), np.inf)  # rounded: equal ones are computed once


@lru_cache(maxsize=256)  # many measurements are equally far apart
def walk_between_nodes(slow: SlowProcess, period_s: float, apart_s: float) -> Array:
    """Return the variance (k,) to add to each measurement, because its slow error walks on between two nodes.

    n measurements, h apart, share one node. Whatever their noise, their mean is off by the mean walk since the first,
    of variance q h (n - 1)(2n - 1) / 6n; so each gets n times that. Without it, fixes good to centimetres would
    determine the speed to centimetres per second, although their slow error walks by decimetres.

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
    """Return the cost (nats) of a whole chain's priors, of the axes that may stay far off.

    Args:
        path: (N, k) estimates of the nodes. dt_s: (N - 1,) times between them. anew: (N - 1,) steps at which the error
            is drawn anew.
    """
    far = slow.far_axes
    square = ((path[:, far] / slow.sigma[far]) ** 2).sum(axis=1)
    held = _usual_information(slow, dt_s, np.ones(len(path), dtype=bool), anew)
    return float(held @ np.log1p(square / _FAR**2)) * _FAR**2 / 2.0


def _usual_information(
    slow: SlowProcess, dt_s: Array, usual: NDArray[np.bool_], anew: NDArray[np.bool_] | None
) -> Array:
    """Return the information (N,), in 1 / sigma^2, of a chain's priors about 0.

    Each part of the chain between steps of `anew` begins and ends at a `usual` node.
    """
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
    """Yield the priors about 0 of a node; their variances are `times` (k,) those of the process.

    Constants have none here. Axes that may stay far off have a prior of their own, or none (`far`). In one prior with
    the others, a height above another zero would loosen the horizontal axes.
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


def allowed_jump_m(slow: SlowProcess | None) -> float:
    """Return the size (m) up to which the bounds include a jump.

    Args:
        slow: the slow error (east, north, ...) of a receiver, estimated or added to the bounds; None: it has none.
    """
    return 0.0 if slow is None else float(_IN_BOUNDS * slow.sigma[:2].max())
