# SPDX-License-Identifier: Apache-2.0
"""Decisions on each measurement, given an estimate: mode, weight, kernel.

Sensors without hypotheses keep their kernel. Sensors with hypotheses are weighed as a mixture: each mode has a density,
and so has 'false'. The weight is the posterior probability that the chosen mode is right. Where the estimate is a
prediction (without the measurement), its covariance is added to the measurement's, so that a state that has drifted
through an outage does not reject the right measurements.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from scipy.linalg import block_diag

from graphloc import keys
from graphloc.build import Decided, Decisions, Estimates, Judged, Problem, Sited, Stream, Thinned, attach
from graphloc.chi2 import chi2_95
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, Residual, SlowProcess
from graphloc.judge.best_chain import best_chain
from graphloc.judge.hypotheses import log_evidence_of, sequence_of
from graphloc.judge.prediction import Prediction, predict_residuals, prediction_of
from graphloc.judge.scatter import noisier_than_stated, scatter_of, scatter_of_pairs, white_scatter


class Stage(enum.StrEnum):
    """How far off the estimate may be, and so how gentle the kernels of all sensors that have one."""

    FAR = "far"  # tens of metres: Huber at most; it is convex, so such a start still pulls in
    OPEN = "open"  # metres: Cauchy at most; it forgets outliers better and still lets the truth back in
    FINAL = "final"  # each sensor's own kernel


_GENTLEST = {
    Stage.FAR: KernelConfig(kind="huber", scale=1.5),
    Stage.OPEN: KernelConfig(kind="cauchy", scale=1.5),
    Stage.FINAL: None,
}
_CONVEXITY = ("none", "huber", "cauchy", "geman_mcclure", "tukey")
_WIDEST = 1e9  # sigmas of the widest kernel: 100 km off where 0.1 mm is stated
CREDIBLE = 6.0  # sigmas of a slow error: a sensor that agrees only by a larger one does not really agree
AGREES = 0.5  # a weight from which a measurement counts as used, and its sensor as agreeing
NEGLIGIBLE = 1e-3  # a weight below this leaves the measurement out of the graph

# (state, key) -> covariance of the key's value as predicted for that state; None: it is not predicted.
PredictedCovariance = Callable[[int, int], Array | None]


@dataclass(frozen=True, slots=True)
class Verdict:
    """A decision, and what it was based on.

    Attributes:
        decision: None leaves the measurement out. mode: the chosen one, even if the measurement is left out.
        weight: posterior probability that the mode is right (or the kernel's weight).
        mode_probability: of the chosen mode among the modes.
        residual: of the chosen mode, at the attachment `at`.
        settled: pass over the whole run from which on this mode was the chosen one.
        reason: why it was left out, where it was not judged by itself.
    """

    decision: Decision | None
    weight: float
    mode_probability: float
    residual: Residual
    mode: int
    at: Attachment
    settled: int = 0
    reason: str = ""

    @classmethod
    def false(cls, residual: Residual, at: Attachment, reason: str = "") -> Verdict:
        """Return the verdict that leaves a measurement out, as false or as not judged yet."""
        return cls(None, 0.0, 1.0, residual, 0, at, reason=reason)

    @property
    def expected_cost(self) -> float:
        """Expectation of the weighted squared residual."""
        expected = self.residual.expected_nis
        return (len(self.residual.raw) if expected is None else expected) * self.weight


def far_sigmas(slow: SlowProcess | None, at: Attachment) -> float:
    """Return the size, in sigmas, of a sensor's slow error on the axes that may stay far off; 0 where it has none."""
    if slow is None or at.slow_value is None:
        return 0.0
    return float(np.linalg.norm(at.slow_value[slow.far_axes] / slow.sigma[slow.far_axes]))


# By (stream number, measurement index).
Verdicts = dict[tuple[int, int], Verdict]


def predicted(
    found: tuple[Residual, ...], at: Attachment, k: int, covariance: PredictedCovariance
) -> Prediction | None:
    """Return the prediction of a measurement's residual; None where the estimate already contains the measurement.

    Args:
        found: its residuals, one for each mode. at: its attachment, to state `k`.
    """
    P = covariance(k, at.pose_key)
    if P is None or (V := covariance(k, keys.velocity(k))) is None:
        return None
    slow = None if at.slow_key is None else covariance(k, at.slow_key)
    return prediction_of(found[0], at, P if slow is None else block_diag(P, slow), V)


def weigh(
    problem: Problem,
    values: gtsam.Values,
    *,
    first: int,
    last: int,
    stage: Stage,
    covariance: PredictedCovariance = lambda _state, _key: None,
    hypotheses: bool = True,
    only: Container[tuple[int, int]] | None = None,
) -> Verdicts:
    """Decide on the measurements of states first..last.

    Args:
        problem: the run. values: current estimate.
        first: first state. last: last state, inclusive.
        stage: how far off the estimate may be.
        covariance: (state, key) -> covariance of the key's prediction (a pose's in the body tangent), or None.
        hypotheses: whether sensors that can be false are weighed by their hypotheses; else by the stage's kernel, on
            the nearest mode.
        only: decide on these alone, all of sensors with hypotheses.
    """
    verdicts: Verdicts = {}
    for stream in problem.streams:
        several = stream.row.has_hypotheses
        if only is not None and not several:
            continue
        indices = [i for i in stream.between(first, last) if only is None or (stream.number, i) in only]
        if not indices:
            continue
        attached, residuals = met(problem, stream, indices, values)
        if several and hypotheses:
            predictions = [
                predicted(r, at, int(stream.state[i]), covariance)
                for i, at, r in zip(indices, attached, residuals, strict=True)
            ]
            found = by_hypotheses(stream, indices, attached, residuals, predictions)
        else:
            found = _by_kernel(stream, indices, attached, residuals, stage)
        verdicts.update({(stream.number, i): v for i, v in zip(indices, found, strict=True)})
    return verdicts


def residuals_at(problem: Sited, stream: Judged, i: int, values: Estimates) -> tuple[Attachment, tuple[Residual, ...]]:
    """Return the attachment of a measurement at the present estimate, and its residuals there, one for each mode."""
    at = attach(problem, stream, i, values)
    return at, stream.row.residuals(stream.measurements[i], stream.config, at)


def _by_kernel(
    stream: Stream, indices: list[int], attached: list[Attachment], residuals: list[tuple[Residual, ...]], stage: Stage
) -> list[Verdict]:
    """Return the verdicts by the sensor's own kernel, or by the stage's where that is gentler."""
    nis = _nis([r for found in residuals for r in found])
    starts = np.cumsum([0, *(len(found) for found in residuals)])
    mode = [int(np.argmin(nis[a:b])) for a, b in pairwise(starts)]
    best = [float(nis[a + m]) for a, m in zip(starts, mode, strict=False)]
    own, limit = stream.config.kernel, _GENTLEST[stage] or stream.config.kernel
    gentle = _CONVEXITY.index(own.kind) <= _CONVEXITY.index(limit.kind)
    # The norm of k whitened residuals is about sqrt(k): the threshold is larger by that.
    dof = len(residuals[0][0].raw)
    times, white = scatter_of(best, dof), 1.0
    if times > 1.0 and not stream.row.absolute:  # an error that positions share may be the estimate's
        stamps_ns = np.array([stream.measurements[i].stamp_ns for i in indices])
        normal = np.array([found[m].normalised() for m, found in zip(mode, residuals, strict=True)])
        times = min(times, scatter_of_pairs(stamps_ns, normal))
        white = min(times, white_scatter(stamps_ns, normal))
    # Around an estimate that is metres off, right matches are many sigmas away. At full weight, right and false ones
    # bend the motion until the solver diverges; weighted by how far they are off, the other sensors hold it together.
    # Fixes keep their weight, as they lead back; and so do measurements that share an error (a mount), which has to
    # give way.
    by_scatter = stage is Stage.FAR and stream.row.has_hypotheses and not stream.constants
    noisier = times if by_scatter else noisier_than_stated(white)
    scale = min(own.scale * times / noisier * float(np.sqrt(dof)), _WIDEST)
    kernel = KernelConfig(kind=own.kind if gentle else limit.kind, scale=scale)
    decided = {m: Decision(mode=m, weight=noisier**-2, kernel=kernel) for m in set(mode)}
    return [
        Verdict(decided[m], kernel.weight(n / noisier**2), 1.0, found[m], m, at)
        for m, n, found, at in zip(mode, best, residuals, attached, strict=True)
    ]


def _nis(residuals: list[Residual]) -> Array:
    """Return the squared normalised residuals, in one call where they have the same shape."""
    if len({len(r.raw) for r in residuals}) > 1:
        return np.array([r.nis() for r in residuals])
    raw = np.array([r.raw for r in residuals])
    return np.asarray(np.einsum("ni,ni->n", raw, np.linalg.solve([r.cov for r in residuals], raw[:, :, None])[:, :, 0]))


def cost_of_noise(verdicts: Verdicts) -> float:
    """Return the cost of taking noise as larger than stated, -log of its density.

    Without this cost, noise would explain any heading.
    """
    found = [(v.decision.weight, len(v.residual.raw)) for v in verdicts.values() if v.decision and v.decision.kernel]
    return float(sum(-0.5 * dof * np.log(weight) for weight, dof in found))


def by_hypotheses(
    stream: Judged,
    indices: list[int],
    attached: list[Attachment],
    residuals: list[tuple[Residual, ...]],
    predictions: list[Prediction | None],
) -> list[Verdict]:
    """Judge measurements of a sensor with hypotheses as a sequence (see `sequence_of`).

    Two measurements that contradict each other, both in the graph, pull a loose prediction to where neither is right.
    So of the measurements that are judged by a prediction, only the most probable chain of those that agree is
    believed.
    """
    new = {n: prediction for n, prediction in enumerate(predictions) if prediction is not None}
    chain: list[int | None] = [None] * len(residuals)
    if new:
        chosen = best_chain(stream, [indices[n] for n in new], [residuals[n] for n in new], list(new.values()))
        for n, mode in zip(new, chosen, strict=True):
            chain[n] = mode
    conditioned = predict_residuals(stream, indices, residuals, predictions, chain)
    posterior = sequence_of(stream, indices, residuals, predictions, conditioned).posterior()
    verdicts = []
    for n, (modes, cov, _) in enumerate(conditioned):
        logs = np.array([r.log_density(cov) for r in modes])
        on = chain[n]
        mode, weight = int(np.argmax(logs)) if on is None else on, float(posterior[n])
        share = float(np.exp(logs[mode] - np.logaddexp.reduce(logs)))
        weight *= 1.0 if stream.row.one_likelihood else share
        kept = Decision(mode=mode, weight=weight) if weight > NEGLIGIBLE else None
        verdicts.append(Verdict(kept, weight, share, residuals[n][mode], mode, attached[n]))
    return verdicts


def agrees(stream: Stream, residual: Residual) -> bool:
    """Return whether a residual agrees by the loss of its sensor, as wide as configured.

    For a sensor with hypotheses: whether it is within the 95 % quantile of chi-square.
    """
    nis, dof = residual.nis(), len(residual.raw)
    if stream.row.has_hypotheses:
        return nis < chi2_95(dof)
    return stream.config.kernel.weight(nis / dof) >= AGREES


def met(
    problem: Problem, stream: Stream, indices: Iterable[int], values: gtsam.Values
) -> tuple[list[Attachment], list[tuple[Residual, ...]]]:
    """Return the attachments of measurements of a stream at an estimate, and the residuals of their modes there."""
    met = [residuals_at(problem, stream, i, values) for i in indices]
    return [at for at, _ in met], [found for _, found in met]


def log_evidence(problem: Problem, values: gtsam.Values, first: int, last: int) -> float:
    """Return the log probability of the measurements of states first..last around an estimate.

    Those of sensors with hypotheses count, marginalised over all hypotheses.
    """
    total = 0.0
    for stream in problem.streams:
        if stream.row.has_hypotheses:
            indices = stream.between(first, last)
            residuals = [residuals_at(problem, stream, i, values)[1] for i in indices]
            total += log_evidence_of(stream, indices, residuals)
    return total


def along_best_chains(problem: Problem, values: gtsam.Values, verdicts: Verdicts) -> Verdicts:
    """Return the verdicts that believe each sensor's most probable chain, however far from the estimate."""
    changed = dict(verdicts)
    for stream in problem.streams:
        if not stream.row.has_hypotheses:
            continue
        every = range(len(stream.measurements))
        attached, residuals = met(problem, stream, every, values)
        chain = best_chain(stream, every, residuals)
        changed |= {(stream.number, i): v for i, v in enumerate(believing(chain, residuals, attached))}
    return changed


def believing(
    modes: Sequence[int | None], residuals: Sequence[tuple[Residual, ...]], attached: Sequence[Attachment]
) -> list[Verdict]:
    """Return the verdicts on N measurements that believe exactly these modes; None: the measurement is false."""
    return [
        Verdict.false(found[0], at) if mode is None else Verdict(Decision(mode=mode), 1.0, 1.0, found[mode], mode, at)
        for mode, found, at in zip(modes, residuals, attached, strict=True)
    ]


def decisions(verdicts: Verdicts, without: Container[tuple[int, int]] = ()) -> Decisions:
    """Return the decisions of verdicts for the graph builder, but for the measurements in `without`."""
    return {
        key: None if v.decision is None or key in without else Decided(v.decision, v.at, v.residual)
        for key, v in verdicts.items()
    }


def decisions_on(few: Thinned, verdicts: Verdicts, values: gtsam.Values) -> Decisions:
    """Return the decisions on the measurements of a thinned run, from verdicts on the whole one."""
    return {
        (stream.number, i): Decided(decision, attach(few.problem, stream, i, values))
        for stream in few.problem.streams
        for i, whole in enumerate(few.chosen[stream.number].tolist())
        if (decision := verdicts[stream.number, whole].decision) is not None
    }


def predicted_by(cov: Mapping[int, Array]) -> PredictedCovariance:
    """Return a `PredictedCovariance` by the covariances of a run without the measurements that are judged."""
    return lambda _state, key: cov[key]
