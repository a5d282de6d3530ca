# SPDX-License-Identifier: Apache-2.0
"""Right or false: the measurements of one sensor that can be false, as a sequence.

A false measurement's error is drawn anew, or repeats that of the false one before it. So right and false
form a chain of two states, and forward-backward gives each posterior exactly: without the repeats, six
scans that take the same wrong boat for the right one outweigh IMU and GNSS together.

That is local: around an estimate. `best_chain` is global: an estimate in the wrong place still has the
right shape, so the residuals of the right measurements lie along one slowly moving offset from it. Where the
estimate is a prediction, loose enough to believe two measurements that contradict each other, it tells which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphloc.build import Judged
from graphloc.frames import Array
from graphloc.graph import FalseModel, Residual

# How fast the offset of an estimate in the wrong place may move: a random walk of this share of a false
# error's size in a second (0.1 m of 5 m).
_OFFSET_WALK = 0.02
_PREDICTED_S = 60.0  # in which the error of a prediction becomes another one
_LOOK_BACK = 64  # candidates for the right one before


@dataclass(frozen=True, slots=True)
class FalseSequence:
    """Log of prior x density of N measurements in turn.

    Attributes:
        right: (N,) of any mode being right. fresh, repeated: (N,) of all being false, after a right one and
            after a false one.
    """

    right: Array
    fresh: Array
    repeated: Array

    def posterior(self) -> Array:
        """Probability (N,) that a mode is right."""
        ahead = self._ahead()
        back = np.zeros_like(ahead)
        for n in range(len(back) - 2, -1, -1):
            r, f = self.right[n + 1] + back[n + 1, 0], back[n + 1, 1]
            back[n] = np.logaddexp(r, self.fresh[n + 1] + f), np.logaddexp(r, self.repeated[n + 1] + f)
        both = ahead + back
        return np.asarray(np.exp(both[:, 0] - np.logaddexp(both[:, 0], both[:, 1])))

    def log_evidence(self) -> float:
        """Log probability of the whole sequence."""
        return float(np.logaddexp(*self._ahead()[-1])) if len(self.right) else 0.0

    def _ahead(self) -> Array:
        ahead = np.zeros((len(self.right), 2))
        for n in range(len(ahead)):
            r, f = ahead[n - 1] if n else (0.0, -np.inf)
            ahead[n] = (
                self.right[n] + np.logaddexp(r, f),
                np.logaddexp(r + self.fresh[n], f + self.repeated[n]),
            )
        return ahead


def sequence_of(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    predicted: Sequence[Array | None],
) -> FalseSequence:
    """Return the sequence of a stream's measurements.

    Args:
        stream: the sensor; its row has a false model. indices: N of its measurements.
        residuals: N tuples, one residual for each mode.
        predicted: N covariances of the prediction, or None where the measurement took part in it.
    """
    assert stream.row.false is not None
    models = [stream.row.false(stream.measurements[i], stream.config) for i in indices]
    right = [
        np.logaddexp.reduce([r.log_density(P) for r in found]) for found, P in zip(residuals, predicted, strict=True)
    ]
    fresh = [_log_false(*args) for args in zip(residuals, models, predicted, strict=True)]
    repeated = fresh[:1]
    for n in range(1, len(models)):
        model = models[n]
        again = np.log(max(model.repeats * model.probability, 1e-12)) + _log_repeat(residuals[n - 1], residuals[n])
        repeated.append(float(np.logaddexp(np.log1p(-model.repeats) + fresh[n], again)))
    return FalseSequence(np.array(right), np.array(fresh), np.array(repeated))


def _log_gauss(raw: Array, cov: Array) -> float:
    logdet = np.linalg.slogdet(2.0 * np.pi * cov)[1]
    return float(-0.5 * (raw @ np.linalg.solve(cov, raw) + logdet))


def _log_false(found: tuple[Residual, ...], model: FalseModel, P: Array | None) -> float:
    """Log of P(false) x density, over the modes. The prediction's covariance widens it as it does the right one's."""
    around = model.cov if P is None else model.cov + P
    share = np.log([r.prior for r in found]) - np.log(sum(r.prior for r in found))
    logs = share + np.array([_log_gauss(r.raw, r.cov + around) for r in found])
    return float(np.log(model.probability) + np.logaddexp.reduce(logs))


def _log_repeat(before: tuple[Residual, ...], now: tuple[Residual, ...], walked: Array | float = 0.0) -> float:
    """Log density of seeing the error of one measurement again in the next, over pairs of modes.

    `walked`: covariance (k, k) of what the estimate's own error has moved in between.
    """
    if len(before[0].raw) != len(now[0].raw):
        return -np.inf
    total = np.log(sum(r.prior for r in before) * sum(r.prior for r in now))
    logs = [np.log(a.prior * b.prior) + _log_gauss(a.raw - b.raw, a.cov + b.cov + walked) for a in before for b in now]
    return float(np.logaddexp.reduce(logs) - total)


def best_chain(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    predicted: Sequence[Array] | None = None,
) -> list[int | None]:
    """Return which mode of each of N measurements of a stream is right on the most probable chain; None: none is.

    The longest path: nodes are modes taken for right, and an edge gains what its end gains over being false,
    less what the offset moves from one to the next. False ones between that repeat each other gain too.

    Args:
        predicted: N covariances of the prediction, which bounds where a chain begins; None: it may lie anywhere.
    """
    assert stream.row.false is not None
    taken = [stream.measurements[i] for i in indices]
    models = [stream.row.false(m, stream.config) for m in taken]
    dof, count = len(residuals[0][0].raw), len(residuals)
    if any(len(found[0].raw) != dof for found in residuals):
        return [None] * count
    nothing = np.array(
        [np.log(m.probability) - 0.5 * (np.linalg.slogdet(2.0 * np.pi * m.cov)[1] + dof) for m in models]
    )
    stamps = np.array([m.stamp_ns for m in taken]) * 1e-9
    walk = _OFFSET_WALK**2 * np.array([m.cov for m in models])  # in a second
    if predicted is not None:
        walk = walk + 2.0 * np.array(predicted) / _PREDICTED_S
    again = np.zeros(count)
    for n in range(1, count):
        repeats = models[n].repeats
        walked = (stamps[n] - stamps[n - 1]) * walk[n]
        same = np.log(max(repeats * models[n].probability, 1e-12))
        same += _log_repeat(residuals[n - 1], residuals[n], walked)
        again[n] = max(0.0, float(np.logaddexp(np.log1p(-repeats), same - nothing[n])))
    gained = np.concatenate([[0.0], np.cumsum(again)])  # by false ones that repeat, up to and without n
    node = [(n, mode) for n, found in enumerate(residuals) for mode in range(len(found))]
    at = np.array([n for n, _ in node])
    raw = np.array([residuals[n][mode].raw for n, mode in node])
    cov = np.array([residuals[n][mode].cov for n, mode in node])
    alone = np.log([residuals[n][mode].prior for n, mode in node]) - nothing[at]
    score, before = np.zeros(len(node)), np.full(len(node), -1)
    for k, n in enumerate(at):
        if predicted is None:
            nis, begun = float(dof), cov[k] + models[n].cov
        else:
            begun = cov[k] + predicted[n]
            nis = float(raw[k] @ np.linalg.solve(begun, raw[k]))
        score[k] = alone[k] + gained[n] - 0.5 * (np.linalg.slogdet(2.0 * np.pi * begun)[1] + nis)
        lo, hi = np.searchsorted(at, [n - _LOOK_BACK, n])
        if lo == hi:
            continue
        walked = (stamps[n] - stamps[at[lo:hi]])[:, None, None] * walk[n]
        spread, step = cov[lo:hi] + cov[k] + walked, raw[lo:hi] - raw[k]
        off = np.einsum("ni,ni->n", step, np.linalg.solve(spread, step[:, :, None])[:, :, 0])
        path = score[lo:hi] + alone[k] - 0.5 * (off + np.linalg.slogdet(2.0 * np.pi * spread)[1])
        path += np.maximum(gained[n] - gained[np.minimum(at[lo:hi] + 2, n)], 0.0)
        best = int(np.argmax(path))
        if path[best] > score[k]:
            score[k], before[k] = path[best], lo + best
    ends = score + np.maximum(gained[count] - gained[np.minimum(at + 2, count)], 0.0)
    chosen: list[int | None] = [None] * count
    k = int(np.argmax(ends))
    while k >= 0:
        n, mode = node[k]
        chosen[n] = mode
        k = int(before[k])
    return chosen
