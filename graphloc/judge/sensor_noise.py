# SPDX-License-Identifier: Apache-2.0
"""Noise of fixes, poses and matches by how their residuals change from one to the next: the factor on what they state.

Covariances are often made up, or those of a peak's curvature. If poses state too little, right ones are judged false,
and those that happen to lie near the estimate hold it there; if fixes do, their noise counts against the IMU.
Differences do not contain an error that measurements share (a drift, an image that is off). As some measurements are
false, or jump, the factor is that of the most likely mixture of right pairs and others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from graphloc.build import Judged, Problem
from graphloc.frames import Array
from graphloc.graph import Residual
from graphloc.judge.decide import Verdicts
from graphloc.measurements import Measurement

_PAIRED_S = 10.0  # longest time between the two of a pair: over longer, the error of the estimate changes, too
_FEWEST, _MOST = 15, 2000  # pairs: with fewer, nothing is said; more are not used
_FALSE_M = 5.0  # sigma of an error that is not noise, of a sensor without hypotheses
_FACTORS = np.geomspace(1.0, 20.0, 16)
# Shares of right pairs. If there could be fewer, those that err by their noise could all be false by little, and no
# noise would show.
_SHARES = np.linspace(0.3, 0.95, 8)
_ERRORS = (0.2, 0.4, 0.8, 1.6, 3.2)  # sizes of a false one's error, in times of what is expected
_ANY_SIZE = 0.1  # share of the false pairs that err by any of these sizes, not by the most likely one
# The first of `_FACTORS` above 1, 1.22, is taken as 1: stated sigmas are rarely better known; a choice.
_LEAST_TIMES = 1.4
_SURE = 8.0  # log-likelihood that another factor must gain
# The same where the IMU contradicts the sensors: half a minute of fixes tells no more, and else the IMU would be
# blamed.
_SURE_IF_DENIED = 0.0


class Step(NamedTuple):
    """The change from one residual to the next, on the axes (k) that one key of the configuration scales.

    Attributes:
        key: of the configuration. change: (k,) of the residual. stated: (k, k), covariance of `change` as stated.
        error: (k, k), covariance of the error of a false measurement.
    """

    key: str
    change: Array
    stated: Array
    error: Array


Pair = tuple[Step, ...]
"""Two residuals in a row: their steps, one for each key."""


def scattering(problem: Problem, verdicts: Verdicts, *, denied: bool = False) -> dict[str, dict[str, float]]:
    """Return by what factors fixes, poses and matches clearly scatter more than stated, by sensor and key.

    Args:
        verdicts: on all measurements.
        denied: whether the IMU contradicts the sensors, so that either is noisier than configured.
    """
    found = {}
    for stream in problem.streams:
        judged = [verdicts[stream.number, i].residual for i in range(len(stream.measurements))]
        pairs = pairs_of(stream, zip(stream.measurements, judged, strict=True))
        if times := times_stated(pairs, sure=_SURE_IF_DENIED if denied else _SURE):
            found[stream.name] = times
    return found


def pairs_of(stream: Judged, judged: Iterable[tuple[Measurement, Residual]]) -> list[Pair]:
    """Return the pairs of residuals in a row.

    Args:
        judged: measurements of the stream by stamp, and the residual of each.
    """
    pairs = []
    for (a, before), (b, now) in pairwise(judged):
        scaled = {key: axes for key, axes in stream.row.scaled(b).items() if axes}
        if not scaled or b.stamp_ns - a.stamp_ns > _PAIRED_S * 1e9 or len(before.raw) != len(now.raw):
            continue
        change, error = now.raw - before.raw, _error(stream, b, len(now.raw))
        stated = before.white_cov + now.white_cov
        parts = [(key, axes, np.ix_(axes, axes)) for key, axes in scaled.items()]
        pairs.append(tuple(Step(key, change[axes], stated[part], error[part]) for key, axes, part in parts))
    return pairs


def _error(stream: Judged, m: Measurement, axes: int) -> Array:
    if stream.row.false is None:
        return _FALSE_M**2 * np.eye(axes)
    return stream.row.false(m, stream.config).cov


def times_stated(
    pairs: Iterable[Pair], now: Mapping[str, float] | None = None, *, sure: float = _SURE
) -> dict[str, float]:
    """Return, by key, how many times its stated sigma a sensor scatters, where that is clearly more.

    Args:
        now: factors that are taken at present; they stay unless others are clearly more likely.
        sure: log-likelihood that others must gain.
    """
    alike: dict[tuple[tuple[str, int], ...], list[Pair]] = {}  # by what they have: height or not, heading or not
    for pair in pairs:
        alike.setdefault(tuple((step.key, len(step.change)) for step in pair), []).append(pair)
    kinds, most = max(alike.items(), key=lambda item: len(item[1]), default=((), []))
    now = now or {}
    if len(most) < _FEWEST:
        return dict(now)
    some = most[:: -(-len(most) // _MOST)]
    keys = [key for key, _ in kinds]
    parts = [
        [np.array(part) for part in zip(*(step[1:] for step in own), strict=True)] for own in zip(*some, strict=True)
    ]
    times = dict(zip(keys, _likeliest(parts, [now.get(key, 1.0) for key in keys], sure), strict=True))
    return {key: by for key, by in {**now, **times}.items() if by > 1.0}


def _likeliest(steps: Sequence[Sequence[Array]], now: Sequence[float], sure: float) -> list[float]:
    """Return, for each key, the most likely factor on the stated sigmas of M steps, or the present one.

    The latter if no other is clearly more likely. Keys share which pairs are right: where positions tell false ones,
    the angles of the others show their noise. By how much most of the others err is what explains them best if the
    right ones err as stated, so that errors which are merely of another size do not look like noise.

    Args:
        steps: of each key, its changes, stated covariances and errors (see `Step`), each with one more axis (M) in
            front.
        now: present factor of each key. sure: log-likelihood that another must gain.
    """
    right, other = np.zeros((1, len(steps[0][0]))), np.zeros(len(steps[0][0]))  # (factors of each key, M), (M,)
    tried = [_factors(times) for times in now]
    for (change, stated, error), factors in zip(steps, tried, strict=True):
        own = np.array([_log_densities(change, times**2 * stated) for times in factors])
        false = [_log_densities(change, stated + size**2 * error) for size in _ERRORS]
        right = right[..., None, :] + own
        best = max(false, key=lambda wide: float(_log_likelihoods(own[0], wide)))
        any_size = np.logaddexp.reduce(false) - np.log(len(false))
        other = other + np.logaddexp(np.log1p(-_ANY_SIZE) + best, np.log(_ANY_SIZE) + any_size)
    likely = _log_likelihoods(right[0], other)
    at = tuple(int(k) for k in np.unravel_index(int(np.argmax(likely)), likely.shape))
    found = []
    for axis, (k, times, factors) in enumerate(zip(at, now, tried, strict=True)):
        as_now = (*at[:axis], int(np.argmin(np.abs(np.log(factors / times)))), *at[axis + 1 :])
        # Two steps in a row have a residual in common, so each counts half.
        clear = 0.5 * (likely[at] - likely[as_now]) > sure
        found.append(times if not clear else float(factors[k]) if factors[k] > _LEAST_TIMES else 1.0)
    return found


def _factors(now: float) -> Array:
    """Return the factors that are tried, at a constant ratio, from 1 up to 20 times the present one."""
    more = int(np.ceil(np.log(now) / np.log(_FACTORS[1])))
    return np.asarray(_FACTORS[1] ** np.arange(len(_FACTORS) + more))


def _log_likelihoods(right: Array, other: Array) -> Array:
    """Return the log-likelihoods (...) of M pairs, with the most likely share of right ones.

    Args:
        right, other: log densities of right pairs (..., M), and of others (M,).
    """
    mixed = [np.logaddexp(np.log(share) + right, np.log1p(-share) + other).sum(axis=-1) for share in _SHARES]
    return np.asarray(np.max(mixed, axis=0))


def _log_densities(steps: Array, cov: Array) -> Array:
    squares = np.einsum("mi,mi->m", steps, np.linalg.solve(cov, steps[:, :, None])[:, :, 0])
    return np.asarray(-0.5 * (squares + np.linalg.slogdet(cov)[1]))
