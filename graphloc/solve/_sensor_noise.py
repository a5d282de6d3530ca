# SPDX-License-Identifier: Apache-2.0
"""Noise of fixes, poses and matches by how their residuals scatter from one to the next: how many times what they state.

Covariances are often made up, or those of a peak's curvature. Of poses that state too little, right ones are judged false, and those that
happen to lie near the estimate hold it there; of fixes, the noise counts against the IMU. In differences, an error that measurements share
(a drift, an image that is off) has no part; and as some are false, or jump, the factor is that of the likeliest mixture of right pairs
and others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from graphloc.build import Judged, Problem
from graphloc.frames import Array
from graphloc.graph import Residual
from graphloc.measurements import Measurement
from graphloc.solve._decide import Verdicts

_PAIRED_S = 10.0  # apart at most: over longer, the error of the estimate changes, too
_FEWEST = 15  # pairs
_FALSE_M = 5.0  # what a sensor without hypotheses errs by where it errs
_FACTORS = np.geomspace(1.0, 20.0, 16)
# Of right pairs. With fewer, those that err by some metres would be right ones with that noise.
_SHARES = np.linspace(0.15, 0.95, 9)
_ERRORS = (0.5, 1.0)  # of the largest error of a false one: many are smaller
_LEAST_TIMES = 1.4
_SURE = 8.0  # log-likelihood that a factor must gain


class Step(NamedTuple):
    """From one residual to the next, on the axes (k) that one key of the configuration scales.

    Attributes:
        change: (k,). stated: (k, k), its covariance as stated. error: (k, k), covariance of the error of a false one.
    """

    change: Array
    stated: Array
    error: Array


Steps = Mapping[tuple[tuple[str, int], ...], Sequence[tuple[Step, ...]]]
"""By the keys that scale them, each with its number of axes: of each pair of residuals, the step of each key."""


def scattering(problem: Problem, verdicts: Verdicts) -> dict[str, dict[str, float]]:
    """Return by what factors fixes, poses and matches scatter more than they state, where clearly: by sensor and key of its configuration."""
    found = {}
    for stream in problem.streams:
        judged = [verdicts[stream.number, i].residual for i in range(len(stream.measurements))]
        if times := times_stated(steps_of(stream, zip(stream.measurements, judged, strict=True))):
            found[stream.name] = times
    return found


def steps_of(
    stream: Judged, judged: Iterable[tuple[Measurement, Residual]]
) -> dict[tuple[tuple[str, int], ...], list[tuple[Step, ...]]]:
    """Return the steps from one residual to the next (see `Steps`).

    Args:
        judged: measurements of the stream by stamp, and the residual of each.
    """
    steps: dict[tuple[tuple[str, int], ...], list[tuple[Step, ...]]] = {}
    for (a, before), (b, now) in pairwise(judged):
        scaled = {key: axes for key, axes in stream.row.scaled(b).items() if axes}
        if not scaled or b.stamp_ns - a.stamp_ns > _PAIRED_S * 1e9 or len(before.raw) != len(now.raw):
            continue
        change, stated, error = now.raw - before.raw, before.cov + now.cov, _error(stream, b, len(now.raw))
        parts = [(axes, np.ix_(axes, axes)) for axes in scaled.values()]
        step = tuple(Step(change[axes], stated[part], error[part]) for axes, part in parts)
        steps.setdefault(tuple((key, len(axes)) for key, axes in scaled.items()), []).append(step)
    return steps


def _error(stream: Judged, m: Measurement, axes: int) -> Array:
    if stream.row.false is None:
        return _FALSE_M**2 * np.eye(axes)
    return stream.row.false(m, stream.config).cov


def times_stated(steps: Steps) -> dict[str, float]:
    """Return by key how many times its stated sigma a sensor scatters, where it is clearly more."""
    keys, most = max(steps.items(), key=lambda item: len(item[1]), default=((), ()))
    if len(most) < _FEWEST:
        return {}
    times = _likeliest([Step(*map(np.array, zip(*own, strict=True))) for own in zip(*most, strict=True)])
    return {key: by for (key, _), by in zip(keys, times, strict=True) if by > _LEAST_TIMES}


def _likeliest(steps: Sequence[Step]) -> list[float]:
    """Return the likeliest factor on the stated sigmas of M steps, of each key; 1 where it is not clear.

    Keys share which pairs are right: where positions tell false ones, the angles of the others show their noise.

    Args:
        steps: of each key, with one more axis (M) in front.
    """
    right: Array = np.zeros((1, len(steps[0].change)))  # (factors of each key, M)
    other = np.zeros(len(steps[0].change))
    for change, stated, error in steps:
        own = np.array([_log_densities(change, times**2 * stated) for times in _FACTORS])
        right = right[..., None, :] + own
        false = [_log_densities(change, stated + size**2 * error) for size in _ERRORS]
        other = other + np.logaddexp.reduce(false) - np.log(len(_ERRORS))
    right = right[0]
    likely = np.max(
        [np.logaddexp(np.log(share) + right, np.log1p(-share) + other).sum(axis=-1) for share in _SHARES], axis=0
    )
    best = np.unravel_index(int(np.argmax(likely)), likely.shape)
    found = []
    for axis, k in enumerate(best):
        without = (*best[:axis], 0, *best[axis + 1 :])
        # Two steps in a row have a residual in common, so each counts half.
        found.append(float(_FACTORS[k]) if 0.5 * (likely[best] - likely[without]) > _SURE else 1.0)
    return found


def _log_densities(steps: Array, cov: Array) -> Array:
    squares = np.einsum("mi,mi->m", steps, np.linalg.solve(cov, steps[:, :, None])[:, :, 0])
    return np.asarray(-0.5 * (squares + np.linalg.slogdet(cov)[1]))
