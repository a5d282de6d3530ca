# SPDX-License-Identifier: Apache-2.0
"""Which of the newest measurements of a sensor are right: all choices, with their probabilities.

The choice that is in the graph confirms itself: two false matches that agree pull the estimate towards themselves. But
near the estimate the graph is linear. So the joint covariance gives the estimate without any of these measurements, the
estimate with any other choice of them, and the probability of each choice. The most probable choice is then tried in
the graph; the spread of the others is added to the covariance of the position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from graphloc.build import Judged
from graphloc.frames import Array
from graphloc.graph import Residual
from graphloc.judge.hypotheses import log_false_again, log_right_and_false
from graphloc.judge.prediction import taken_of

_MOST, _LEAST = 16, 12.0  # choices that are kept; log probability (nats) below the best at which one is dropped
# Smallest eigenvalue of the information that remains when measurements are removed, as a share of their own. Their
# factors were linearised a moment ago at another pose, so the difference may come out negative by a hundredth or so.
_LOOSEST = 1e-3
# With a smaller eigenvalue, it is known how uncertain the estimate is along that direction without the measurements,
# but not where it lies: a residual of 3 cm would move it by 30 m.
_TELLS = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """One choice of modes.

    Attributes:
        log: log of its probability. modes: mode that is right, of each of N measurements; None: the measurement is
            false.
        step: (d,) from the present estimate to that of this choice: position first (m, world), then each residual.
        cov: (d, d), covariance of the estimate of this choice, in the same order.
    """

    log: float
    modes: tuple[int | None, ...]
    step: Array
    cov: Array


def choices(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    cov: Array,
    held: Sequence[tuple[int, float] | None],
) -> tuple[list[Choice], bool]:
    """Return the choices among N measurements of a stream, the most probable first, and whether they are unplaced.

    Unplaced means: along some direction the covariances of the choices are known, but their means are not (see
    `_TELLS`).

    Args:
        indices: of the measurements. residuals: N tuples, one residual per mode.
        cov: (d, d), joint covariance of the position and all residuals, from the graph as it is.
        held: mode and weight with which each measurement is in the graph; None: it is not.
    """
    _, models = taken_of(stream, indices)
    ends = np.cumsum([0, *(len(found[0].raw) for found in residuals)])
    at = [slice(a, b) for a, b in pairwise(ends + len(cov) - ends[-1])]
    step, loose, unplaced = _without(residuals, cov, held, at)
    found = [Choice(0.0, (), step, loose)]
    for n, model in enumerate(models):
        repeats = model.repeats if n else 0.0
        grown = []
        for c in found:
            seen, P = tuple(replace(r, raw=r.raw + c.step[at[n]]) for r in residuals[n]), c.cov[at[n], at[n]]
            for mode, r in enumerate(seen):
                gain = np.linalg.solve(r.cov + P, c.cov[at[n]]).T
                step, cov = c.step - gain @ r.raw, c.cov - gain @ c.cov[at[n]]
                nis = r.nis(P)  # not scaled by `news`: it says whether the measurements agree, not how well modes look
                log_right = model.news * (r.log_density(P) + 0.5 * nis) - 0.5 * nis
                grown.append(Choice(c.log + log_right, (*c.modes, mode), step, cov))
            log = log_right_and_false(seen, P, model)[1]
            if n and c.modes[-1] is None and repeats > 0.0 and len(seen[0].raw) == len(residuals[n - 1][0].raw):
                before = tuple(replace(r, raw=r.raw + c.step[at[n - 1]]) for r in residuals[n - 1])
                cross = c.cov[at[n - 1], at[n]]
                walked = P + c.cov[at[n - 1], at[n - 1]] - cross - cross.T
                again = log_false_again(model, before, seen, walked)
                log = float(np.logaddexp(np.log1p(-repeats) + log, again))
            grown.append(Choice(c.log + model.news * log, (*c.modes, None), c.step, c.cov))
        grown.sort(key=lambda c: -c.log)
        found = [c for c in grown[:_MOST] if c.log > grown[0].log - _LEAST]
    total = float(np.logaddexp.reduce([c.log for c in found]))
    return [replace(c, log=c.log - total) for c in found], unplaced


def _without(
    residuals: Sequence[tuple[Residual, ...]], cov: Array, held: Sequence[tuple[int, float] | None], at: list[slice]
) -> tuple[Array, Array, bool]:
    """Return the estimate after removing all of the measurements from the graph.

    Returns:
        Its step and covariance as in `Choice`, and whether it is unplaced (see `choices`).
    """
    there = [(n, *h) for n, h in enumerate(held) if h is not None]
    if not there:
        return np.zeros(len(cov)), cov, False
    rows = np.concatenate([np.arange(len(cov))[at[n]] for n, _, _ in there])
    raw = np.concatenate([residuals[n][mode].raw for n, mode, _ in there])
    root = block_diag(*(np.linalg.cholesky(residuals[n][mode].cov / weight) for n, mode, weight in there))
    # Whitened by the measurements' noise; `values` are the eigenvalues of the information that is left, as a share of
    # theirs.
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(np.eye(len(rows)) - inverse @ cov[np.ix_(rows, rows)] @ inverse.T)
    told = values > _TELLS
    by_root = cov[:, rows] @ inverse.T @ vectors
    step = by_root * np.where(told, 1.0 / np.maximum(values, _TELLS), 0.0) @ (vectors.T @ inverse @ raw)
    return step, cov + by_root / np.maximum(values, _LOOSEST) @ by_root.T, not told.all()
