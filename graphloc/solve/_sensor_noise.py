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

import numpy as np

from graphloc.build import Judged, Problem
from graphloc.frames import Array
from graphloc.graph import Residual
from graphloc.measurements import Measurement
from graphloc.solve._decide import Verdicts

_PAIRED_S = 10.0  # apart at most: over longer, the error of the estimate changes, too
_FEWEST = 15  # pairs
_FALSE_M = 5.0  # what a sensor without hypotheses errs by where it errs
_FACTORS = np.geomspace(1.0, 20.0, 31)
_SHARES = np.linspace(0.05, 0.95, 10)  # of right pairs
_LEAST_TIMES = 1.5
_SURE = 8.0  # log-likelihood that a factor must gain

Step = tuple[Array, Array, Array]
"""From one residual to the next (k,), its stated covariance (k, k), and that where one of the two is false."""


def scattering(problem: Problem, verdicts: Verdicts) -> dict[str, dict[str, float]]:
    """Return by what factors fixes, poses and matches scatter more than they state, where clearly: by sensor and key of its configuration."""
    found = {}
    for stream in problem.streams:
        judged = [verdicts[stream.number, i].residual for i in range(len(stream.measurements))]
        times = times_stated(steps_of(stream, zip(stream.measurements, judged, strict=True)))
        if times:
            found[stream.name] = times
    return found


def steps_of(stream: Judged, judged: Iterable[tuple[Measurement, Residual]]) -> dict[tuple[str, int], list[Step]]:
    """Return the steps from one residual to the next, by key of the configuration that scales them, and number of axes.

    Args:
        judged: measurements of the stream by stamp, and the residual of each.
    """
    steps: dict[tuple[str, int], list[Step]] = {}
    for (a, before), (b, now) in pairwise(judged):
        if b.stamp_ns - a.stamp_ns > _PAIRED_S * 1e9 or len(before.raw) != len(now.raw):
            continue
        wide = (
            _FALSE_M**2 * np.eye(len(now.raw)) if stream.row.false is None else stream.row.false(b, stream.config).cov
        )
        for key, axes in stream.row.scaled(b).items():
            part = np.ix_(axes, axes)
            step = (now.raw - before.raw)[axes], (before.cov + now.cov)[part], (before.cov + now.cov + wide)[part]
            steps.setdefault((key, len(axes)), []).append(step)
    return steps


def times_stated(steps: Mapping[tuple[str, int], Sequence[Step]]) -> dict[str, float]:
    """Return by key how many times its stated sigma a sensor scatters, where it is clearly more."""
    found = {}
    for (key, width), rows in sorted(steps.items(), key=lambda item: len(item[1])):  # of several widths, that of most
        if width and len(rows) >= _FEWEST:
            found[key] = _likeliest(*(np.array(column) for column in zip(*rows, strict=True)))
    return {key: times for key, times in found.items() if times > _LEAST_TIMES}


def _likeliest(steps: Array, stated: Array, wide: Array) -> float:
    """Return the likeliest factor on the stated sigmas of M steps (M, k), (M, k, k), (M, k, k); 1 where it is not clear."""
    squares, log_root = _squares(steps, stated), 0.5 * np.linalg.slogdet(stated)[1]
    right = -0.5 * squares / _FACTORS[:, None] ** 2 - steps.shape[1] * np.log(_FACTORS)[:, None] - log_root
    other = -0.5 * (_squares(steps, wide) + np.linalg.slogdet(wide)[1])
    shares = _SHARES[:, None, None]
    likely = np.logaddexp(np.log(shares) + right, np.log1p(-shares) + other).sum(axis=2).max(axis=0)
    best = int(np.argmax(likely))
    # Two steps in a row have a residual in common, so each counts half.
    return float(_FACTORS[best]) if 0.5 * (likely[best] - likely[0]) > _SURE else 1.0


def _squares(steps: Array, cov: Array) -> Array:
    return np.asarray(np.einsum("mi,mi->m", steps, np.linalg.solve(cov, steps[:, :, None])[:, :, 0]))
