# SPDX-License-Identifier: Apache-2.0
"""Which of the last measurements of a sensor are right, all ways to choose them weighed against each other.

One choice is in the graph, and what it says of itself confirms it: two false matches that agree move the estimate to
themselves. But about the estimate the graph is linear, so what it says without any of them follows from the joint covariance
(they are taken out), and what it would say with others, and how probable these are. The most probable
choice is worth a try; what the others leave is a covariance of the place.
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
from graphloc.solve._foreseen import taken_of
from graphloc.solve._hypotheses import log_repeat, log_right_and_false

_MOST, _LEAST = 16, 12.0  # choices that are followed; nats below the most probable one
# What else tells of a measurement is known by at least such a share of what itself does. Its factor was linearised a moment ago,
# at another place: to a hundredth or so, taken out again it may leave less than nothing, and then nothing is as loose as one likes.
_LOOSEST = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """One way to choose.

    Attributes:
        log: of its probability. modes: of N measurements, which is right; None: none is.
        step: (d,) from the estimate to what is expected then: rows of the place first, then of each residual. cov: (d, d) of that.
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
) -> list[Choice]:
    """Return ways to choose among N measurements of a stream, the most probable first.

    Args:
        residuals: N tuples of modes. cov: of the place and all residuals at the estimate, of the graph as it is.
        held: N modes and weights with which they are in it, or None.
    """
    _, models = taken_of(stream, indices)
    ends = np.cumsum([0, *(len(found[0].raw) for found in residuals)])
    at = [slice(a, b) for a, b in pairwise(ends + len(cov) - ends[-1])]
    found = [Choice(0.0, (), *_without(residuals, cov, held, at))]
    for n, model in enumerate(models):
        repeats = model.repeats if n else 0.0
        grown = []
        for c in found:
            seen, P = tuple(replace(r, raw=r.raw + c.step[at[n]]) for r in residuals[n]), c.cov[at[n], at[n]]
            for mode, r in enumerate(seen):
                gain = np.linalg.solve(r.cov + P, c.cov[at[n]]).T
                step, cov = c.step - gain @ r.raw, c.cov - gain @ c.cov[at[n]]
                grown.append(Choice(c.log + r.log_density(P), (*c.modes, mode), step, cov))
            log = log_right_and_false(seen, P, model)[1]
            if n and c.modes[-1] is None and repeats > 0.0 and len(seen[0].raw) == len(residuals[n - 1][0].raw):
                before = tuple(replace(r, raw=r.raw + c.step[at[n - 1]]) for r in residuals[n - 1])
                cross = c.cov[at[n - 1], at[n]]
                walked = P + c.cov[at[n - 1], at[n - 1]] - cross - cross.T
                again = np.log(repeats * model.probability) + log_repeat(before, seen, walked)
                log = float(np.logaddexp(np.log1p(-repeats) + log, again))
            grown.append(Choice(c.log + log, (*c.modes, None), c.step, c.cov))
        grown.sort(key=lambda c: -c.log)
        found = [c for c in grown[:_MOST] if c.log > grown[0].log - _LEAST]
    total = float(np.logaddexp.reduce([c.log for c in found]))
    return [replace(c, log=c.log - total) for c in found]


def _without(
    residuals: Sequence[tuple[Residual, ...]], cov: Array, held: Sequence[tuple[int, float] | None], at: list[slice]
) -> tuple[Array, Array]:
    """Step and covariance, as in `Choice`, with none of the measurements in the graph."""
    there = [(n, *h) for n, h in enumerate(held) if h is not None]
    if not there:
        return np.zeros(len(cov)), cov
    rows = np.concatenate([np.arange(len(cov))[at[n]] for n, _, _ in there])
    raw = np.concatenate([residuals[n][mode].raw for n, mode, _ in there])
    root = block_diag(*(np.linalg.cholesky(residuals[n][mode].cov / weight) for n, mode, weight in there))
    # What is left of their covariance by what else there is.
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(np.eye(len(rows)) - inverse @ cov[np.ix_(rows, rows)] @ inverse.T)
    left = inverse.T @ vectors / np.maximum(values, _LOOSEST) @ vectors.T @ inverse
    gain = cov[:, rows] @ left
    return gain @ raw, cov + gain @ cov[rows]
