# SPDX-License-Identifier: Apache-2.0
"""Passes over the whole run: with given decisions, or until modes and weights no longer change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam

from graphloc.build import Made, Past, Problem, StartPrior, build_graph, cost_of_constants
from graphloc.judge.decide import Stage, Verdicts, decisions, log_evidence, met, weigh
from graphloc.recording import Progress
from graphloc.solve._optimize import full_step, optimize
from graphloc.solve.stretch import moved, unwound

SETTLED_M, SETTLED_WEIGHT = 0.03, 0.1
SETTLED_NATS = 0.1
"""A step that changes the cost by less moves nothing by more than half a sigma. A heading that nothing tells turns by
degrees at each step."""
# Of the thinned run: the passes over the whole one begin there and go on to `SETTLED_M`; a choice.
_ROUGHLY_SETTLED_M = 0.5
_UPHILL = 1.1  # times the cost before: above it a single step has failed
_OUTLIER = 0.1  # weight under its own kernel below which a measurement is an outlier


@dataclass(frozen=True, slots=True)
class Optimised:
    """One optimisation of the whole run.

    Attributes:
        values: the result. graph: the graph that it comes from. made: range of the factors of each measurement in the
            graph.
        iterations: number of those that it took. moved_m: how far any pose moved.
        changed_nats: by how much a single step changed the cost, or should have by the linear model, whichever is more;
            inf: it was not a single step.
    """

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    made: Made
    iterations: int
    moved_m: float
    changed_nats: float = float("inf")

    def settled(self, nats: float) -> bool:
        """Return whether it moved the track by little, or changed the cost by less than `nats`."""
        return self.moved_m < SETTLED_M or self.changed_nats < nats


def optimise_run(
    problem: Problem, estimate: gtsam.Values, verdicts: Verdicts, prior: StartPrior, *, jumps: bool = True
) -> Optimised:
    """Optimise the whole run with the given decisions."""
    last, made = len(problem.timeline) - 1, Made()
    graph, guess = build_graph(problem, estimate, decisions(verdicts), 0, last, prior, jumps=jumps, made=made)
    return _iterated(graph, guess, made)


def _iterated(graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, made: Made) -> Optimised:
    solved = optimize(graph, guess, 12, 1e-3)
    return Optimised(solved.values, graph, made, solved.iterations, moved(guess, solved.values))


def refine_run(problem: Problem, estimate: gtsam.Values, verdicts: Verdicts, prior: StartPrior) -> Optimised:
    """Take one step over the whole run; iterate only if it raises the cost more than a step near the minimum may."""
    last, made = len(problem.timeline) - 1, Made()
    graph, guess = build_graph(problem, estimate, decisions(verdicts), 0, last, prior, made=made)
    values, promised = full_step(graph, guess)
    before, after = float(graph.error(guess)), float(graph.error(values))
    if not after < _UPHILL * before + 1.0:
        return _iterated(graph, guess, made)
    return Optimised(values, graph, made, 1, moved(guess, values), max(promised, abs(before - after)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Settled:
    """A solution of the whole run.

    Attributes:
        graph: of the last step. made: as in `Optimised`. verdicts: by `values`.
        passes, iterations: number of those that it took. converged: whether the last step hardly changed it.
    """

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    made: Made
    verdicts: Verdicts
    passes: int
    iterations: int
    converged: bool


def settle(
    problem: Problem,
    estimate: gtsam.Values,
    verdicts: Verdicts,
    prior: StartPrior,
    progress: Progress,
    most: int,
    nats: float = 0.0,
) -> Settled:
    """Run passes until modes, weights and the track no longer change.

    Args:
        most: most passes. nats: passes end also where a step changes the cost by less, wherever the track goes.
    """
    last, iterations = len(problem.timeline) - 1, 0
    done: Optimised | None = None
    for n in range(most):
        done = None  # frees its graph before the next one is made: gigabytes on a run of hours
        # The first pass removes the seams between windows; after it one step per pass is enough.
        done = (optimise_run if n == 0 else refine_run)(problem, estimate, verdicts, prior)
        estimate, iterations = unwound(problem, done.values), iterations + done.iterations
        used, verdicts = verdicts, weigh(problem, estimate, first=0, last=last, stage=Stage.FINAL)
        _date(verdicts, used, n + 1)
        progress("final passes", n + 1, most)
        if estimate is done.values and n > 0 and done.settled(nats) and changed(used, verdicts) < SETTLED_WEIGHT:
            break
    assert done is not None
    return Settled(
        values=done.values,
        graph=done.graph,
        made=done.made,
        verdicts=verdicts,
        passes=n + 1,
        iterations=iterations,
        converged=done.moved_m < 3 * SETTLED_M or done.settled(nats),
    )


def _date(verdicts: Verdicts, before: Verdicts, n: int) -> None:
    """Note in `verdicts`, in place, since which pass each mode is unchanged: since this one, `n`, if it changed now."""
    for key, verdict in verdicts.items():
        old = before[key]
        settled = old.settled if old.mode == verdict.mode else n
        if settled:
            verdicts[key] = replace(verdict, settled=settled)


def changed(before: Verdicts, after: Verdicts) -> float:
    """Return the largest change of any weight."""
    return max((abs(v.weight - before[key].weight) for key, v in after.items()), default=0.0)


def rough_passes(
    problem: Problem,
    estimate: gtsam.Values,
    prior: StartPrior,
    progress: Progress,
    stages: Sequence[Stage],
    most: int,
) -> tuple[gtsam.Values, int, int]:
    """Solve the whole run with the losses of each stage, until the estimate hardly moves.

    The graph is rebuilt for each pass, as attachments depend on the estimate.

    Returns:
        The values, iterations, and passes, at most `most` for each stage.
    """
    last = len(problem.timeline) - 1
    passes = iterations = 0
    for stage in stages:
        for n in range(most):
            verdicts = weigh(problem, estimate, first=0, last=last, stage=stage)
            done = optimise_run(problem, estimate, verdicts, prior, jumps=stage is not Stage.FAR)
            estimate = unwound(problem, done.values)
            passes, iterations = passes + 1, iterations + done.iterations
            progress(f"{stage} passes", n + 1, most)
            if done.moved_m < _ROUGHLY_SETTLED_M:
                break
    return estimate, iterations, passes


def cost_without_outliers(settled: Settled) -> float:
    """Return twice the cost, without that of outliers (by the sensor's own kernel).

    The kernel width follows the median of the sensor's residuals, so outliers are few and far off: no noise of another
    sensor explains them.
    """
    outliers = [
        settled.graph.at(factor).error(settled.values)
        for key, v in settled.verdicts.items()
        if v.weight < _OUTLIER and v.decision is not None and v.decision.kernel is not None
        for factor in settled.made[key]
    ]
    return 2.0 * (float(settled.graph.error(settled.values)) - float(sum(outliers)))


def expected_cost(problem: Problem, verdicts: Verdicts, last: int = -1) -> float:
    """Return the degrees of freedom of the weighted problem up to state `last`: the expectation of twice its cost."""
    slow_of = problem.timeline.slow_of
    n, m = len(slow_of[:last]) + 1, int(slow_of[last]) + 1
    expected = sum(v.expected_cost for v in verdicts.values())
    expected += 9.0 * (n - 1) + 6.0 * (m - 1) + 15.0 - 9.0 * n - 6.0 * m
    if problem.usual_motion is not None:
        expected += 2.0 * sum(j < m - 1 for j in problem.usual_motion.nodes)
    for stream in problem.streams:
        if stream.slow is not None:
            expected += m * int((~stream.slow.constant).sum())  # a constant has as many rows as nodes
    return expected


def cost_as_configured(
    problem: Problem, values: gtsam.Values, first: int, last: int, prior: StartPrior | Past, *, judged: int
) -> float:
    """Return -log of the probability of states first..last, with each sensor's loss as wide as configured.

    It is known up to an additive constant. Unlike the cost of the graph of these states, it does not fall where a loss
    is widened because the residuals around an estimate scatter.

    Args:
        judged: the last state whose measurements of sensors with hypotheses count.
    """
    graph, guess = build_graph(problem, values, {}, first, last, prior)
    cost = float(graph.error(guess)) - log_evidence(problem, values, first, judged)
    # A `Past` has the priors of the constants that it knows.
    cost += cost_of_constants(problem, values, prior.known if isinstance(prior, Past) else ())
    for stream in problem.streams:
        if not stream.row.has_hypotheses:
            _, residuals = met(problem, stream, stream.between(first, last), values)
            cost += sum(min(stream.config.kernel.loss(r.nis(), len(r.raw)) for r in found) for found in residuals)
    return cost


def cost_of_run(problem: Problem, values: gtsam.Values, prior: StartPrior) -> float:
    """Return `cost_as_configured` of all states."""
    last = len(problem.timeline) - 1
    return cost_as_configured(problem, values, 0, last, prior, judged=last)
