# SPDX-License-Identifier: Apache-2.0
"""The most probable chain of right measurements of a sensor, however far from the estimate.

An estimate in the wrong place still has the right shape, so the residuals of the right measurements share one slowly
changing offset. Where the estimate is a prediction so loose that two measurements that contradict each other both fit,
the chain decides between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.build import Judged
from graphloc.frames import Array
from graphloc.graph import FalseModel, Residual
from graphloc.judge.hypotheses import log_false_again
from graphloc.judge.prediction import Prediction, carried, kept_of, moved, taken_of, walk_of
from graphloc.time import stamps_of

_LOOK_BACK = 64  # measurements before one, among which the right one before it is looked for


def best_chain(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    predictions: Sequence[Prediction] | None = None,
) -> list[int | None]:
    """Return which mode of each of N measurements is right on the most probable chain; None: the measurement is false.

    The chain is a longest path, whose nodes are modes taken for right. An edge gains the log likelihood ratio (right
    over false) of the node at its end, predicted from the node at its begin, times the share that is news beside the
    measurement before. False measurements in between that repeat each other add to the gain.

    Args:
        indices: N of the measurements of a stream. residuals: N tuples, one residual for each mode.
        predictions: N, which limit where a chain may begin; None: it may begin anywhere.
    """
    taken, models = taken_of(stream, indices)
    dof, count = len(residuals[0][0].raw), len(residuals)
    if any(len(found[0].raw) != dof for found in residuals):
        return [None] * count
    nothing = np.array(
        [np.log(m.probability) - 0.5 * (np.linalg.slogdet(2.0 * np.pi * m.cov)[1] + dof) for m in models]
    )
    stamps = np.asarray(stamps_of(taken) * 1e-9, dtype=np.float64)
    walk = np.array([walk_of(m) for m in models])
    gained = _gained_by_repeats(models, residuals, predictions, nothing, stamps, walk)
    nodes = _nodes(residuals, predictions, nothing)
    at, size = nodes.at, len(nodes.at)
    score, before = np.zeros(size), np.full(size, -1)
    for k, n in enumerate(at):
        score[k] = _begun(nodes, k, models[n], float(gained[n]))
        lo, hi = np.searchsorted(at, [n - _LOOK_BACK, n])
        if lo == hi:
            continue
        ages_s = stamps[n] - stamps[at[lo:hi]]
        path = score[lo:hi] + _followed(nodes, k, slice(lo, hi), ages_s, models[n].news, walk[n])
        path += np.maximum(gained[n] - gained[np.minimum(at[lo:hi] + 2, n)], 0.0)
        best = int(np.argmax(path))
        if path[best] > score[k]:
            score[k], before[k] = path[best], lo + best
    ends = score + np.maximum(gained[count] - gained[np.minimum(at + 2, count)], 0.0)
    chosen: list[int | None] = [None] * count
    for k in _backwards(int(np.argmax(ends)), before):
        chosen[at[k]] = int(nodes.mode[k])
    return chosen


class _Nodes(NamedTuple):
    """The K modes of all measurements, each of which may be on the chain.

    Attributes:
        at: (K,) number of its measurement. mode: (K,) which of its modes.
        raw: (K, k) residual. cov: (K, k, k) of the measurement.
        alone: (K,) log of its prior over the density of a false measurement by itself.
        roots: (K, k, m), lasts_s: (K,) of its prediction (see `Prediction`); None: nothing is predicted.
    """

    at: NDArray[np.int64]
    mode: NDArray[np.int64]
    raw: Array
    cov: Array
    alone: Array
    roots: Array | None
    lasts_s: Array | None


def _nodes(
    residuals: Sequence[tuple[Residual, ...]], predictions: Sequence[Prediction] | None, nothing: Array
) -> _Nodes:
    """Return the nodes; arguments as of `best_chain` and `_gained_by_repeats`."""
    modes = [residual for found in residuals for residual in found]
    at = np.repeat(np.arange(len(residuals)), [len(found) for found in residuals])
    return _Nodes(
        at=at,
        mode=np.concatenate([np.arange(len(found)) for found in residuals]),
        raw=np.array([r.raw for r in modes]),
        cov=np.array([r.cov for r in modes]),
        alone=np.log([r.prior for r in modes]) - nothing[at],
        roots=None if predictions is None else np.array([p.root for p in predictions])[at],
        lasts_s=None if predictions is None else np.array([p.lasts_s for p in predictions])[at],
    )


def _begun(nodes: _Nodes, k: int, model: FalseModel, gained: float) -> float:
    """Return the log likelihood ratio of a chain that begins at node k.

    Args:
        gained: by false measurements before it.
    """
    raw, cov = nodes.raw[k], nodes.cov[k]
    if nodes.roots is None:
        nis, begun = float(len(raw)), cov + model.cov
    else:
        begun = cov + nodes.roots[k] @ nodes.roots[k].T
        nis = float(raw @ np.linalg.solve(begun, raw))
    return float(gained + model.news * (nodes.alone[k] - 0.5 * np.linalg.slogdet(2.0 * np.pi * begun)[1]) - 0.5 * nis)


def _followed(nodes: _Nodes, k: int, back: slice, ages_s: Array, news: float, walk: Array) -> Array:
    """Return the log likelihood ratio (J,) that node k adds to chains that end at each of J nodes before it.

    Args:
        back: the J nodes. ages_s: (J,) time since each. news: of the measurement. walk: (k, k), see `walk_of`.
    """
    raw, cov = nodes.raw[k], nodes.cov[k]
    expected, left = nodes.raw[back], nodes.cov[back]
    if nodes.roots is not None and nodes.lasts_s is not None:
        kept = kept_of(nodes.lasts_s[back], nodes.lasts_s[k], ages_s)
        expected, left = carried(expected, left, nodes.roots[back], nodes.roots[k], kept)
    spread, step = left + cov + ages_s[:, None, None] * walk, expected - raw
    off = np.einsum("ni,ni->n", step, np.linalg.solve(spread, step[:, :, None])[:, :, 0])
    return np.asarray(news * (nodes.alone[k] - 0.5 * (off + np.linalg.slogdet(2.0 * np.pi * spread)[1])))


def _backwards(k: int, before: NDArray[np.int64]) -> Iterator[int]:
    """Yield the nodes of a path from its last, k, to its first.

    Args:
        before: (K,) the node before each on its best path; -1: it is the first.
    """
    while k >= 0:
        yield k
        k = int(before[k])


def _gained_by_repeats(
    models: Sequence[FalseModel],
    residuals: Sequence[tuple[Residual, ...]],
    predictions: Sequence[Prediction] | None,
    nothing: Array,
    stamps_s: Array,
    walk: Array,
) -> Array:
    """Return the log likelihood (N + 1,) gained by false measurements that repeat the one before them.

    It is summed over the measurements before each, and over all N.

    Args:
        nothing: (N,) log of prior x density of a false one by itself. walk: (N, k, k) as of `walk_of`.
    """
    again = np.zeros(len(models))
    for n in range(1, len(models)):
        age_s = stamps_s[n] - stamps_s[n - 1]
        walked = walk[n] * age_s + (0.0 if predictions is None else moved(predictions[n - 1], predictions[n], age_s))
        same = log_false_again(models[n], residuals[n - 1], residuals[n], walked)
        again[n] = models[n].news * max(0.0, float(np.logaddexp(np.log1p(-models[n].repeats), same - nothing[n])))
    return np.concatenate([[0.0], np.cumsum(again)])
