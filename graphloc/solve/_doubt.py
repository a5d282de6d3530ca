# SPDX-License-Identifier: Apache-2.0
"""What it adds to the covariance of a position that the measurements which determine it may be false together.

A solved graph is as sure as if its choice of modes were right, and the estimate that follows it confirms it. Where errors are
independent, neighbours show whether it is. Where those of a sensor repeat (matches that take the same moored boats for others), its
measurements are right or wrong together, however many there are. So each is judged by the run without its sensor. If they are false,
the vessel is where that run has it, or as far off as false ones are.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import special

from graphloc import gauss, keys
from graphloc.build import Stream, Thinned, thinned
from graphloc.chi2 import chi2_95
from graphloc.frames import Array
from graphloc.graph import FalseModel, Residual
from graphloc.series import interpolated
from graphloc.solution import Graded
from graphloc.solve._batch import BatchResult
from graphloc.solve._choices import Rest, without
from graphloc.solve._covariances import world_covariance
from graphloc.solve._decide import Verdict, decisions_on, met, predicted, predicted_covariance
from graphloc.solve._hypotheses import log_right_and_false
from graphloc.time import stamps_of

_SLIGHT = 0.005  # a probability that widens bounds by 3 % at most
_SAID = 0.05  # beyond this one a bound that holds for 95 % depends on what else is possible
_BEYOND = 0.05  # share of the cases that a bound leaves out
_BOUND = -float(special.ndtri(0.5 * _BEYOND))  # sigmas
_HALVINGS = 40


class Doubt(NamedTuple):
    """How far those of a sensor's measurements that are believed may be false together.

    Attributes:
        stamps_ns: (M,) of its measurements. probability: (M,) that the ones which determine the position there are false.
        spread_m2: variance of their error, if they are.
    """

    stamps_ns: NDArray[np.int64]
    probability: Array
    spread_m2: float


def widen_by_doubt(result: BatchResult, cov: Array) -> list[str]:
    """Widen the horizontal position in covariances (N, 6, 6), in axes of world and in place, by what is left open; return warnings.

    Raises:
        SolveError: what the run knows without the sensors in doubt is not determined.
    """
    streams = [s for s in result.problem.streams if _shares_errors(s)]
    if not streams:
        return []
    few = thinned(result.problem)
    values = few.of(result.values)
    decided = decisions_on(few, result.verdicts, values)
    numbers = {s.number for s in streams}
    rest = without(few.problem, values, decided, result.prior, {key for key in decided if key[0] in numbers})
    thin = {s.number: s for s in few.problem.streams}
    doubts = {s.name: doubt for s in streams if (doubt := _doubt_of(few, thin[s.number], result, rest)) is not None}
    if max((float(doubt.probability.max()) for doubt in doubts.values()), default=0.0) < _SLIGHT:
        return []
    stamps_ns, sure = result.problem.timeline.stamps_ns, np.ones(len(cov))
    warnings = list[str]()
    for name, doubt in doubts.items():
        probability = np.interp(stamps_ns, doubt.stamps_ns, doubt.probability)
        sure *= 1.0 - probability
        if (typical := float(np.median(probability))) > _SAID:
            said = f"{name}: what it shows is ambiguous: with a probability of {typical:.0%} the poses that are believed are false"
            said += " together; the bounds of position include that"
            warnings.append(Graded(said, f"ambiguity of {name}", typical))
    known_ns, more = few.problem.timeline.stamps_ns, _horizontal_covariances(few, rest)
    off_m = interpolated(stamps_ns, known_ns, _horizontal(few, rest.values) - _horizontal(few, values))
    del rest  # and its tree, before the next one is made
    more -= _horizontal_covariances(few, without(few.problem, values, decided, result.prior, set()))
    turn = widening(
        cov[:, :2, :2],
        interpolated(stamps_ns, known_ns, more.reshape(-1, 4)).reshape(-1, 2, 2),
        off_m,
        max(doubt.spread_m2 for doubt in doubts.values()),
        1.0 - sure,
    )
    # What position and heading have in common stays: in the other case the arm between them is the same (see `widen_heading`).
    cov[:, :2, :2] = turn @ cov[:, :2, :2] @ turn.transpose(0, 2, 1)
    return warnings


def _models(stream: Stream) -> list[FalseModel]:
    assert stream.row.false is not None
    return [stream.row.false(m, stream.config) for m in stream.measurements]


def _shares_errors(stream: Stream) -> bool:
    """Whether a sensor's measurements can be false, and some are by the error of the one before them."""
    return stream.row.false is not None and any(model.news < 1.0 for model in _models(stream))


def _doubt_of(few: Thinned, stream: Stream, result: BatchResult, rest: Rest) -> Doubt | None:
    """Return the doubt about a sensor of the thinned run, which has all its measurements; None where none says a position."""
    covariance = predicted_covariance(rest.tree)
    attached, residuals = met(few.problem, stream, range(len(stream.measurements)), rest.values)
    verdicts = [result.verdicts[stream.number, i] for i in range(len(attached))]
    models, false = _models(stream), np.zeros(len(attached))
    for n, (at, found, model, verdict) in enumerate(zip(attached, residuals, models, verdicts, strict=True)):
        prediction = predicted(found, at, int(stream.state[n]), covariance)
        false[n] = probability_false(found, None if prediction is None else prediction.cov, model, verdict.mode)
    return doubt_of(stamps_of(stream.measurements), false, models, verdicts)


def probability_false(modes: tuple[Residual, ...], P: Array | None, model: FalseModel, chosen: int) -> float:
    """Return the probability that neither the chosen mode of a measurement nor one at the same place is right.

    Args:
        modes: residuals at a prediction of covariance P (k, k).
    """
    right = np.array([r.log_density(P) for r in modes])
    here = modes[chosen]
    limit = chi2_95(len(here.raw))  # beyond, the noise of both does not explain the distance
    alike = np.array([gauss.square(r.raw - here.raw, r.cov + here.cov) < limit for r in modes])
    every = np.logaddexp(*log_right_and_false(modes, P, model))
    return float(-np.expm1(np.logaddexp.reduce(right[alike]) - every))


def doubt_of(
    stamps_ns: NDArray[np.int64], false: Array, models: list[FalseModel], verdicts: list[Verdict]
) -> Doubt | None:
    """Return the doubt about M measurements of a sensor; None where none of the believed ones says a position.

    It is the mean of `false` (M,), the probability of each, over those whose error is likely the same, each counted by what it
    says of the position. What is news to the measurement before and to the one after is confirmed, or not, by them.
    """
    news = np.array([model.news for model in models])
    weight = np.array([v.weight if v.decision is not None else 0.0 for v in verdicts])
    says = weight * np.array([_information(v, v.residual.cov) for v in verdicts])
    if not says.any():
        return None
    kept = (1.0 - news) / (1.0 + news)  # correlation with the measurement before
    # The first one is all news, and weighs most: those after it may be false with it.
    shared = 1.0 - np.minimum(news, np.append(news[1:], 1.0))
    around = np.maximum(_summed(says, kept), np.finfo(float).tiny)
    probability = _summed(says * false * shared, kept) / around
    spread = max(1.0 / i for v, model in zip(verdicts, models, strict=True) if (i := _information(v, model.cov)) > 0.0)
    return Doubt(stamps_ns, probability, spread)


def _information(verdict: Verdict, cov: Array) -> float:
    """Return what a residual with a covariance (k, k) says of the position along the axis that it knows best, 1/m^2."""
    return float(np.linalg.norm(gauss.whitening(cov) @ verdict.residual.jacobian()[:, 3:6], 2) ** 2)


def _summed(values: Array, kept: Array) -> Array:
    """Return for each of M values the sum over all, weighted by their correlations: products of `kept` (M,) between neighbours."""
    ahead, back = values.copy(), values.copy()
    for n in range(1, len(values)):
        ahead[n] += kept[n] * ahead[n - 1]
        back[-n - 1] += kept[-n] * back[-n]
    return np.asarray(ahead + back - values)


def _horizontal(few: Thinned, values: gtsam.Values) -> Array:
    """Return the horizontal position (N, 2) of the body in a thinned run, m."""
    lever_m = -few.problem.t_body_imu_m
    poses = [values.atPose3(keys.pose(k)) for k in range(len(few.states))]
    return np.array([pose.transformFrom(lever_m)[:2] for pose in poses])


def _horizontal_covariances(few: Thinned, solved: Rest) -> Array:
    """Return the covariance (N, 2, 2) of that, m^2."""
    lever_m, found = -few.problem.t_body_imu_m, []
    for k in map(keys.pose, range(len(few.states))):
        R = solved.values.atPose3(k).rotation().matrix()
        found.append(world_covariance(solved.tree.marginalCovariance(k), R, lever_m)[:2, :2])
    return np.array(found)


def widening(cov: Array, more: Array, off_m: Array, spread_m2: float, probability: Array) -> Array:
    """Return the maps (N, 2, 2) that widen covariances (N, 2, 2), m^2, so that bounds of 95 % hold in both cases together, per axis.

    Args:
        more: (N, 2, 2) by how much the covariance is larger in the other case. off_m: (N, 2) how far off its mean is. Both are limited
            by `spread_m2`, the variance of the distance between the two cases. probability: (N,) of the other case.
    """
    eye = np.eye(2)
    size, axes = np.linalg.eigh(more)
    other = cov + (axes * np.maximum(size, 0.0)[:, None]) @ axes.transpose(0, 2, 1)
    near = cov + spread_m2 * eye
    share = near @ np.linalg.inv(near + other)  # of the other case, between it and what is near the first one
    other = share @ other
    root = np.linalg.cholesky(cov)
    back = np.linalg.inv(root)
    times, axes = np.linalg.eigh(back @ (0.5 * (other + other.transpose(0, 2, 1))) @ back.transpose(0, 2, 1))
    off = axes.transpose(0, 2, 1) @ back @ share @ off_m[:, :, None]
    scale = _scale(np.sqrt(np.maximum(times, 1.0)), np.abs(off[:, :, 0]), probability[:, None])
    return np.asarray(root @ (axes * scale[:, None]) @ axes.transpose(0, 2, 1) @ back)


def _scale(times: Array, off: Array, probability: Array) -> Array:
    """Return by how much a sigma of 1 is to be raised so that 95 % of a mixture are within its bounds.

    Args:
        times: (N, 2) sigma of the other normal, at least 1. off: (N, 2) its mean, 0 or more. probability: (N, 1) of that one.
    """
    low, high = np.ones_like(times), times + off / _BOUND
    for _ in range(_HALVINGS):
        tried = 0.5 * (low + high)
        bound = _BOUND * tried
        other = special.ndtr((off - bound) / times) + special.ndtr((-off - bound) / times)
        beyond = (1.0 - probability) * 2.0 * special.ndtr(-bound) + probability * other
        low, high = np.where(beyond > _BEYOND, tried, low), np.where(beyond > _BEYOND, high, tried)
    return np.asarray(high)
