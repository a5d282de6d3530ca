# SPDX-License-Identifier: Apache-2.0
"""How much wider position and heading get because the measurements that determine them may be false together.

A solved graph is as sure as if its choice of modes were right, and the estimate, which follows that choice, confirms
it. Where errors are independent, neighbouring measurements show whether it is right. Where the errors of a sensor
repeat (matches that take the same moored boats for others), its measurements are right or wrong together, however many
there are. So each is judged by the run without the measurements whose error may be the same. If these are false, the
vessel is where that run has it, or as far off as false measurements are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import special

from graphloc import gauss, keys
from graphloc.build import Decisions, Stream, Thinned, thinned
from graphloc.chi2 import chi2_95
from graphloc.frames import Array, wrap_angle
from graphloc.graph import Attachment, FalseModel, Residual
from graphloc.judge.covariances import world_covariance
from graphloc.judge.decide import Verdict, decisions_on, met, predicted, predicted_by
from graphloc.judge.hypotheses import log_right_and_false
from graphloc.judge.prediction import taken_of
from graphloc.measurements import Measurement
from graphloc.signals.series import interpolated
from graphloc.solution import Graded
from graphloc.solve._choices import without
from graphloc.solve.batch import BatchResult
from graphloc.time import stamps_of

_SLIGHT = 0.005  # probability that is neglected: it widens bounds by 3 % at most
_SAID = 0.05  # probability beyond which a 95 % bound depends on what else is possible
_LONG = 0.1  # share of a run with such a probability, from which a warning says so
_BEYOND = 0.05  # share of the cases that a bound does not hold
_BOUND = -float(special.ndtri(0.5 * _BEYOND))  # half-width of the bound, sigmas
_HALVINGS = 40  # of the interval in which a bound is searched: to 1e-12 of it
# In correlation lengths: half a stretch is left out on either side, beyond which errors correlate by 0.14.
_STRETCH = 4.0
_PLANE = np.array([0, 1, 5])  # x, y and yaw in a covariance
# Which of x, y and yaw an aspect is; a row of moored boats leaves the position open, but not the heading.
_ASPECTS = {"position": slice(0, 2), "heading": slice(2, 3)}


class Doubt(NamedTuple):
    """The probability that the believed measurements of a sensor are false together, in one aspect.

    Attributes:
        stamps_ns: (M,) of its measurements.
        probability: (M,) that the measurements which determine the aspect there are false.
        spread: variance of their error, if they are false, m^2 or rad^2.
    """

    stamps_ns: NDArray[np.int64]
    probability: Array
    spread: float


class _Apart(NamedTuple):
    """What a run says of its states and of a sensor's measurements without those whose error may be the same.

    Attributes:
        planes: (N, 3) x, y and yaw of the states. cov: (N, 3, 3) of `planes`.
        false: by aspect, (M,) probability that each measurement is false.
    """

    planes: Array
    cov: Array
    false: dict[str, Array]


def widen_by_doubt(result: BatchResult, cov: Array) -> list[str]:
    """Widen horizontal position and heading in covariances (N, 6, 6) by the doubt about sensors, in place.

    Args:
        cov: in axes of world.

    Returns:
        Warnings.

    Raises:
        SolveError: without the measurements of a sensor in doubt, the run is not determined.
    """
    if not any(map(_shares_errors, result.problem.streams)):
        return []
    few, warnings, sure = thinned(result.problem), list[str](), None
    values = few.of(result.values)
    decided = decisions_on(few, result.verdicts, values)
    for stream in filter(_shares_errors, few.problem.streams):
        apart = _judged_apart(few, stream, result, values, decided)
        doubts = _doubts_of(stream, result, apart)
        if not any(doubt.probability.max() > _SLIGHT for doubt in doubts.values()):
            continue
        if sure is None:
            known = without(few.problem, values, decided, result.prior, set()).cov
            sure = np.array([_plane_covariance(few, known, values, k) for k in range(len(few.states))])
        off = apart.planes - _planes(few, values)
        off[:, 2] = wrap_angle(off[:, 2])
        stamps_ns, known_ns = result.problem.timeline.stamps_ns, few.problem.timeline.stamps_ns
        off = interpolated(stamps_ns, known_ns, off)
        more = interpolated(stamps_ns, known_ns, (apart.cov - sure).reshape(-1, 9)).reshape(-1, 3, 3)
        for aspect, doubt in doubts.items():
            probability = np.interp(stamps_ns, doubt.stamps_ns, doubt.probability)
            warnings += ambiguity(stream.name, aspect, probability)
            axes = _ASPECTS[aspect]
            there = (slice(None), _PLANE[axes][:, None], _PLANE[axes])
            turn = widening(cov[there], more[:, axes, axes], off[:, axes], doubt.spread, probability)
            # The covariance between position and heading stays: in the other case the arm between them is the same (see
            # `widen_heading`).
            cov[there] = turn @ cov[there] @ turn.transpose(0, 2, 1)
    return warnings


def ambiguity(sensor: str, aspect: str, probability: Array) -> list[str]:
    """Return a warning where bounds depend on what is believed being false, or none.

    Args:
        probability: (N,) that it is false, by state of a run.
    """
    open_still = probability[probability > _SAID]
    if (share := len(open_still) / len(probability)) < _LONG:
        return []
    typical = float(np.median(open_still))
    said = f"{sensor}: the {aspect} that it gives is ambiguous: with a probability of {typical:.0%} its accepted"
    said += f" measurements are wrong together, for {share:.0%} of the run; the bounds include that"
    return [Graded(said, f"{aspect} by {sensor}", typical)]


def _shares_errors(stream: Stream) -> bool:
    """Return whether a sensor's measurements can be false, and some may share the error of the one before them."""
    return stream.row.has_hypotheses and any(model.news < 1.0 for model in _judged(stream)[1])


def _judged(stream: Stream) -> tuple[list[Measurement], list[FalseModel]]:
    """Return all measurements of a sensor, and the model of each one's error if it is false."""
    return taken_of(stream, range(len(stream.measurements)))


def parts_of(news: Array) -> Array:
    """Return how far along the run (M,) each measurement is, in stretches.

    The errors of two that are half a stretch apart count as independent.

    Args:
        news: (M,) as of `FalseModel`.
    """
    way = -np.log(np.maximum(_kept(news), np.exp(-_STRETCH)))
    way[:1] = 0.0
    return np.asarray(np.cumsum(way) / _STRETCH)


def _kept(news: Array) -> Array:
    """Return the correlation (M,) of the error of each measurement with that of the one before it."""
    return (1.0 - news) / (1.0 + news)


def _judged_apart(
    few: Thinned, stream: Stream, result: BatchResult, values: gtsam.Values, decided: Decisions
) -> _Apart:
    """Return what the run says without the measurements of a sensor whose error may be the same.

    Every third stretch is judged at once, without itself and the nearer halves of its neighbours, so three solutions
    are enough for the whole run.

    Args:
        few: the thinned run. values, decided: its estimate and decisions.
    """
    states, (_, models) = range(len(few.states)), _judged(stream)
    along = parts_of(np.array([model.news for model in models]))
    verdicts = [result.verdicts[stream.number, i] for i in range(len(models))]
    third_of = along.astype(int) % 3
    third_of_state = np.interp(few.problem.timeline.stamps_ns, stamps_of(stream.measurements), along).astype(int) % 3
    planes, cov = np.zeros((len(states), 3)), np.zeros((len(states), 3, 3))
    false = {aspect: np.zeros(len(models)) for aspect in _ASPECTS}
    for third in np.unique([*third_of, *third_of_state]).tolist():
        around = np.flatnonzero((along - third + 0.5) % 3.0 < 2.0)
        rest = without(few.problem, values, decided, result.prior, {(stream.number, i) for i in around.tolist()})
        own = np.flatnonzero(third_of_state == third)
        planes[own] = _planes(few, rest.values)[own]
        cov[own] = [_plane_covariance(few, rest.cov, rest.values, k) for k in own.tolist()]
        covariance, mine = predicted_by(rest.cov), np.flatnonzero(third_of == third).tolist()
        for n, at, found in zip(mine, *met(few.problem, stream, mine, rest.values), strict=True):
            prediction, mode = predicted(found, at, int(stream.state[n]), covariance), verdicts[n].mode
            P, by_plane = None if prediction is None else prediction.cov, _by_plane(found[mode], at)
            for aspect, axes in _ASPECTS.items():
                false[aspect][n] = probability_false(found, P, models[n], mode, by_plane, axes)
    return _Apart(planes, cov, false)


def _doubts_of(stream: Stream, result: BatchResult, apart: _Apart) -> dict[str, Doubt]:
    """Return the doubt about a sensor, for each aspect that its believed measurements determine."""
    measured, models = _judged(stream)
    verdicts = [result.verdicts[stream.number, i] for i in range(len(measured))]
    by_planes, stamps_ns = [_by_plane(v.residual, v.at) for v in verdicts], stamps_of(measured)
    doubts = {
        aspect: doubt_of(stamps_ns, apart.false[aspect], models, verdicts, [J[:, axes] for J in by_planes])
        for aspect, axes in _ASPECTS.items()
    }
    return {aspect: doubt for aspect, doubt in doubts.items() if doubt is not None}


def _by_plane(residual: Residual, at: Attachment) -> Array:
    """Return the Jacobian (k, 3) of a residual by x, y and yaw of the body in world."""
    J, back = residual.jacobian(), at.T_world_body.rotation().matrix().T
    return np.column_stack([J[:, 3:] @ back[:, :2], J[:, :3] @ back[:, 2]])


def probability_false(
    modes: tuple[Residual, ...], P: Array | None, model: FalseModel, chosen: int, by_plane: Array, axes: slice
) -> float:
    """Return the probability that neither the chosen mode of a measurement nor one at the same place is right.

    Args:
        modes: residuals at a prediction of covariance P (k, k). chosen: which of them. by_plane: as of `_by_plane`.
        axes: those of x, y and yaw in which a mode is at the same place, if the noise of both explains the distance.
    """
    right, here = np.array([r.log_density(P) for r in modes]), modes[chosen]
    alike = []
    for r in modes:
        whiten = gauss.whitening(r.cov + here.cov)
        back = np.linalg.pinv(whiten @ by_plane)[axes]
        off = back @ whiten @ (r.raw - here.raw)
        alike.append(off @ np.linalg.pinv(back @ back.T) @ off < chi2_95(len(off)))
    every = np.logaddexp(*log_right_and_false(modes, P, model))
    return float(-np.expm1(np.logaddexp.reduce(right[np.array(alike)]) - every))


def doubt_of(
    stamps_ns: NDArray[np.int64],
    false: Array,
    models: Sequence[FalseModel],
    verdicts: Sequence[Verdict],
    by_aspect: Sequence[Array],
) -> Doubt | None:
    """Return the doubt about M measurements of a sensor; None if no believed one says anything of the aspect.

    Its probability is the mean of `false` (M,), the probability of each, over measurements whose error is likely the
    same, each weighted by its information on the aspect. A measurement whose error is independent of the one before and
    of the one after counts as right: these confirm it, or not.

    Args:
        by_aspect: Jacobians (k, 2) by the position, 1/m, or (k, 1) by the heading.
    """
    news = np.array([model.news for model in models])
    weight = np.array([v.weight if v.decision is not None else 0.0 for v in verdicts])
    says = weight * np.array([_information(J, v.residual.cov) for J, v in zip(by_aspect, verdicts, strict=True)])
    if not says.any():
        return None
    kept = _kept(news)
    # The first measurement of a place is all news, and weighs most; still, those after it may be false with it.
    shared = 1.0 - np.minimum(news, np.append(news[1:], 1.0))
    around = np.maximum(_summed(says, kept), np.finfo(float).tiny)
    probability = _summed(says * false * shared, kept) / around
    spread = max(1.0 / i for J, model in zip(by_aspect, models, strict=True) if (i := _information(J, model.cov)) > 0.0)
    return Doubt(stamps_ns, probability, spread)


def _information(J: Array, cov: Array) -> float:
    """Return the information of a residual of covariance (k, k) on the axis that it knows best, by Jacobian (k, d)."""
    return float(np.linalg.norm(gauss.whitening(cov) @ J, 2) ** 2)


def _summed(values: Array, kept: Array) -> Array:
    """Return, for each of M values, the sum of all, weighted by their correlations with it.

    Args:
        kept: (M,) correlation of each with the one before; that of two others is the product in between.
    """
    ahead, back = values.copy(), values.copy()
    for n in range(1, len(values)):
        ahead[n] += kept[n] * ahead[n - 1]
        back[-n - 1] += kept[-n] * back[-n]
    return np.asarray(ahead + back - values)


def _planes(few: Thinned, values: gtsam.Values) -> Array:
    """Return x, y and yaw (N, 3) of the body in the states of a thinned run."""
    lever_m = -few.problem.t_body_imu_m
    poses = [values.atPose3(keys.pose(k)) for k in range(len(few.states))]
    return np.array([[*pose.transformFrom(lever_m)[:2], pose.rotation().yaw()] for pose in poses])


def _plane_covariance(few: Thinned, known: Mapping[int, Array], values: gtsam.Values, k: int) -> Array:
    """Return the covariance (3, 3) of x, y and yaw of the body in state k."""
    R = values.atPose3(keys.pose(k)).rotation().matrix()
    found = world_covariance(known[keys.pose(k)], R, -few.problem.t_body_imu_m)
    return np.asarray(found[np.ix_(_PLANE, _PLANE)])


def widening(cov: Array, more: Array, off: Array, spread: float, probability: Array) -> Array:
    """Return the maps (N, d, d) that widen covariances (N, d, d), per axis, so that 95 % bounds hold for a mixture.

    The mixture is of the run as solved and of the other case, in which believed measurements are false.

    Args:
        cov: (N, d, d) as solved. more: (N, d, d) by how much the covariance is larger in the other case.
        off: (N, d) by how much its mean is off. Both are limited by `spread`, the variance of the distance between the
            cases.
        probability: (N,) of the other case.
    """
    eye = np.eye(cov.shape[1])
    size, axes = np.linalg.eigh(more)
    other = cov + (axes * np.maximum(size, 0.0)[:, None]) @ axes.transpose(0, 2, 1)
    near = cov + spread * eye
    share = near @ np.linalg.inv(near + other)  # gain that pulls the other case near to the first one
    other = share @ other
    root = np.linalg.cholesky(cov)
    back = np.linalg.inv(root)
    times, axes = np.linalg.eigh(back @ (0.5 * (other + other.transpose(0, 2, 1))) @ back.transpose(0, 2, 1))
    off = axes.transpose(0, 2, 1) @ back @ share @ off[:, :, None]
    scale = _scale(np.sqrt(np.maximum(times, 1.0)), np.abs(off[:, :, 0]), probability[:, None])
    return np.asarray(root @ (axes * scale[:, None]) @ axes.transpose(0, 2, 1) @ back)


def _scale(times: Array, off: Array, probability: Array) -> Array:
    """Return the factor on a sigma of 1 at which 95 % of a mixture of two normal distributions are within the bounds.

    Args:
        times: (N, d) sigma of the other one, at least 1. off: (N, d) its mean, 0 or more. probability: (N, 1) of it.
    """
    low, high = np.ones_like(times), times + off / _BOUND
    for _ in range(_HALVINGS):
        tried = 0.5 * (low + high)
        bound = _BOUND * tried
        other = special.ndtr((off - bound) / times) + special.ndtr((-off - bound) / times)
        beyond = (1.0 - probability) * 2.0 * special.ndtr(-bound) + probability * other
        low, high = np.where(beyond > _BEYOND, tried, low), np.where(beyond > _BEYOND, high, tried)
    return np.asarray(high)
