# SPDX-License-Identifier: Apache-2.0
"""Right or false: the measurements of one sensor with hypotheses, as a hidden Markov chain.

The error of a false measurement is drawn independently, or repeats that of the false one before it. So right and false
form a chain with two states, and forward-backward gives the posteriors. Without the repeats, six scans that take the
same wrong boat for the right one would outweigh IMU and GNSS together. If measurements are judged by a prediction, each
state is split in two, before and after the first right one: only after it is the prediction conditioned on it
(`predict_residuals`).

This is local, around an estimate; `best_chain` is global.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphloc import gauss
from graphloc.build import Judged
from graphloc.frames import Array
from graphloc.graph import FalseModel, Residual
from graphloc.judge.prediction import PredictedResidual, Prediction, moved, taken_of


@dataclass(frozen=True, slots=True)
class FalseSequence:
    """Logs of prior x density of N measurements in order.

    Of each (2, N), [0] holds before and [1] after the first right one of those that are judged by a prediction.

    Attributes:
        right: (2, N) that any mode is right.
        fresh, repeated: (2, N) that all modes are false, after a right measurement and after a false one.
        new: (N,) whether a measurement is judged by a prediction.
        news: (N,) share of the evidence of each that is independent of the one before it.
    """

    right: Array
    fresh: Array
    repeated: Array
    new: NDArray[np.bool_]
    news: Array

    def posterior(self) -> Array:
        """Return the probability (N,) that a mode of each measurement is right."""
        ahead = self._ahead()
        back = np.zeros_like(ahead)
        for n in range(len(back) - 2, -1, -1):
            r, f = back[n + 1]
            r = self.right[:, n + 1] + (r[1] if self.new[n + 1] else r)
            back[n] = (
                np.logaddexp(r, self.fresh[:, n + 1] + f),
                np.logaddexp(r, self.repeated[:, n + 1] + f),
            )
        both = np.logaddexp.reduce(ahead + back, axis=2)
        return np.asarray(np.exp(both[:, 0] - np.logaddexp(both[:, 0], both[:, 1])))

    def log_evidence(self) -> float:
        """Return the log probability of the whole sequence, each measurement counted by its share of news."""
        so_far = np.logaddexp.reduce(self._ahead(), axis=(1, 2))
        return float(self.news @ np.diff(so_far, prepend=0.0))

    def _ahead(self) -> Array:
        """Return the log probabilities of the forward pass (N, right or false, before or after)."""
        ahead = np.full((len(self.new), 2, 2), -np.inf)
        r, f = np.array([0.0, -np.inf]), np.full(2, -np.inf)
        for n, new in enumerate(self.new):
            right = self.right[:, n] + np.logaddexp(r, f)
            f = np.logaddexp(r + self.fresh[:, n], f + self.repeated[:, n])
            r = np.array([-np.inf, np.logaddexp(right[0], right[1])]) if new else right
            ahead[n] = r, f
        return ahead


def sequence_of(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    predictions: Sequence[Prediction | None],
    conditioned: Sequence[PredictedResidual],
) -> FalseSequence:
    """Return the sequence of a stream's measurements.

    Args:
        stream: the sensor; its row has a false model. indices: N of its measurements.
        residuals: N tuples, one residual for each mode.
        predictions: N; None for a measurement that took part in the estimate.
        conditioned: the residuals, predicted given a chain.
    """
    taken, models = taken_of(stream, indices)
    densities = np.zeros((2, 2, len(models)))  # right or false, before or after
    for n, (found, prediction, seen, model) in enumerate(zip(residuals, predictions, conditioned, models, strict=True)):
        P = None if prediction is None else prediction.cov
        densities[:, 0, n] = densities[:, 1, n] = log_right_and_false(found, P, model)
        if seen.modes is not found:
            densities[:, 1, n] = log_right_and_false(seen.modes, seen.cov, model)
        if not seen.possible:
            densities[0, :, n] = -np.inf
    right, fresh = densities
    repeated = fresh.copy()
    for n in range(1, len(models)):
        model = models[n]
        walked = moved(predictions[n - 1], predictions[n], (taken[n].stamp_ns - taken[n - 1].stamp_ns) * 1e-9)
        again = log_false_again(model, residuals[n - 1], residuals[n], walked)
        repeated[:, n] = np.logaddexp(np.log1p(-model.repeats) + fresh[:, n], again)
    new = np.array([prediction is not None for prediction in predictions])
    return FalseSequence(right, fresh, repeated, new, np.array([m.news for m in models]))


def log_evidence_of(stream: Judged, indices: Sequence[int], residuals: Sequence[tuple[Residual, ...]]) -> float:
    """Return the log probability of measurements that took part in the estimate, marginalised over all hypotheses."""
    seen = [PredictedResidual(found, None) for found in residuals]
    return sequence_of(stream, indices, residuals, [None] * len(seen), seen).log_evidence()


def log_right_and_false(modes: tuple[Residual, ...], P: Array | None, model: FalseModel) -> tuple[float, float]:
    """Return the logs of prior x density that any mode is right, and that all are false.

    Args:
        P: (k, k) covariance of the prediction, by which both densities are widened; None: there is none.
    """
    right = np.logaddexp.reduce([r.log_density(P) for r in modes])
    around = model.cov if P is None else model.cov + P
    share = np.log([r.prior for r in modes]) - np.log(sum(r.prior for r in modes))
    logs = share + np.array([gauss.log_density(r.raw, r.cov + around) for r in modes])
    return float(right), float(np.log(model.probability) + np.logaddexp.reduce(logs))


def log_false_again(
    model: FalseModel, before: tuple[Residual, ...], now: tuple[Residual, ...], walked: Array | float
) -> float:
    """Return the log of prior x density that a measurement is false by the error of the one before it.

    Args:
        walked: as of `_log_repeat`.
    """
    return float(np.log(max(model.repeats * model.probability, 1e-12))) + _log_repeat(before, now, walked)


def _log_repeat(before: tuple[Residual, ...], now: tuple[Residual, ...], walked: Array | float) -> float:
    """Return the log density that the error of one measurement repeats in the next, over pairs of modes.

    Args:
        walked: (k, k) covariance of how much the error of the estimate has changed in between.
    """
    if len(before[0].raw) != len(now[0].raw):
        return -np.inf
    total = np.log(sum(r.prior for r in before) * sum(r.prior for r in now))
    logs = [
        np.log(a.prior * b.prior) + gauss.log_density(a.raw - b.raw, a.cov + b.cov + walked)
        for a in before
        for b in now
    ]
    return float(np.logaddexp.reduce(logs) - total)
