# SPDX-License-Identifier: Apache-2.0
"""From the start to an estimate of the whole run, a window at a time."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence

import gtsam
import numpy as np

from graphloc.build import Past, Problem, StartPrior, without_imu
from graphloc.judge.bias_walk import WALK_KEYS, BiasWanders, KnownBias, known_bias, went_too_far
from graphloc.judge.decide import PredictedCovariance, Stage, Verdicts, agrees, decisions, predicted_by, weigh
from graphloc.recording import Progress
from graphloc.solve._marginals import marginals
from graphloc.solve._passes import cost_as_configured
from graphloc.solve.stretch import (
    StretchStep,
    copy_states,
    dead_reckon,
    past_at,
    solve_stretch,
    solve_until_written_there,
    update_states,
)
from graphloc.solve.wrong_imu import GrownWindow, ImuWrong, wrong_span
from graphloc.time import duration_ns

_CHUNK_S, _OVERLAP_S = 15.0, 5.0
# Motion below which the rounds end; coarse, to save some: passes over the whole run follow, which end at
# `_passes.SETTLED_M`; a choice.
_SETTLED_M = 0.5
_MAX_ROUNDS, _MAX_FAR_ROUNDS, _FAR_SETTLED_M = 2, 8, 2.0
_MOSTLY = 0.7  # share of a sensor's measurements that must agree; by the usual kernel 87 % of right ones do


def grow(
    problem: Problem,
    estimate: gtsam.Values,
    start: StartPrior,
    known: int,
    progress: Progress,
    *,
    chunk_s: float = _CHUNK_S,
    overlap_s: float = _OVERLAP_S,
    watch: Callable[[int, Verdicts], None] = lambda _last, _verdicts: None,
    doubt_imu: bool = False,
    doubt_start: bool = True,
    last: int | None = None,
) -> int:
    """Extend the estimate of states 0..known to state `last`, a chunk at a time, in place; return the iterations.

    Args:
        start: prior on state 0.
        chunk_s, overlap_s: how far a step goes, and how far back its window reaches.
        watch: called with the last state of each window and the verdicts in it, as known at that time.
        doubt_imu: whether to look for spans in which the IMU is wrong. doubt_start: whether to look in states 0..known,
            too.
        last: None: of the run.

    Raises:
        ImuWrong: there are such spans.
        BiasWanders: the IMU is not wrong, but its biases wander farther than configured.
    """
    stamps, slow_of = problem.timeline.stamps_ns, problem.timeline.slow_of
    end = len(problem.timeline) - 1 if last is None else last
    prior: StartPrior | Past = start
    verdicts = weigh(problem, estimate, first=0, last=known, stage=Stage.FINAL)
    step = solve_stretch(problem, estimate, 0, known, prior, decisions(verdicts))
    iterations, first, pasts = step.iterations, 0, list[tuple[int, Past]]()
    window = GrownWindow(problem, estimate, 0, 0, known, prior)
    if doubt_imu and doubt_start and (found := _without_imu(window, gtsam.Values())) is not None:
        problem, step, verdicts, more = found
        iterations += more
    while known < end:
        until = int(min(np.searchsorted(stamps, stamps[known] + duration_ns(chunk_s)), end))
        back = problem.timeline.floor(int(stamps[known]) - duration_ns(overlap_s))
        start_of_window = int(np.searchsorted(slow_of, slow_of[back]))
        if start_of_window > first and slow_of[start_of_window] < slow_of[known]:
            prior = past_at(problem, step, start_of_window)
            first = start_of_window
            pasts.append((first, prior))
        before = copy_states(problem, estimate, first, known)
        dead_reckon(problem, estimate, known, until)
        window = GrownWindow(problem, estimate, first, known, until, prior)
        used, step, verdicts = _solve_grown(window)
        if doubt_imu and (found := _without_imu(window, before)) is not None:
            if (wanders := _wanders(problem, estimate, start, pasts)) is not None:
                raise wanders
            problem, step, verdicts, more = found
            used += more
        watch(until, verdicts)
        iterations, known = iterations + used, until
        progress("growing", known, end)
    if doubt_imu and problem.left_out:
        raise ImuWrong(problem.left_out)
    return iterations


def _without_imu(window: GrownWindow, before: gtsam.Values) -> tuple[Problem, StretchStep, Verdicts, int] | None:
    """Look for a span of a solved window in which the IMU is wrong, and solve the window without it, in place.

    Args:
        before: as of `wrong_span`.

    Returns:
        The problem without the IMU there, the last step, its verdicts, and the iterations; None: the IMU is not wrong.
    """
    span = wrong_span(window, before, lambda rest: _solve_grown(window._replace(problem=rest)))
    if span is None:
        return None
    rest = without_imu(window.problem, window.values, *span)
    iterations, step, verdicts = _solve_grown(window._replace(problem=rest))
    return rest, step, verdicts, iterations


def _wanders(
    problem: Problem, values: gtsam.Values, start: StartPrior, before: Sequence[tuple[int, Past]]
) -> BiasWanders | None:
    """Return how many times farther than configured the biases wander, as an error to raise; None: they do not.

    What is known of them at some states, each by the data before it, is compared. None also where the noise of the IMU
    is not to be adapted (`adapt_noise`).

    Args:
        start: prior on the first state. before: states, and all data before each.
    """
    if not problem.config.sensors[problem.imu.sensor].adapt_noise:
        return None
    begin_ns = int(problem.timeline.stamps_ns[0])
    known = [KnownBias(begin_ns, start.bias.vector(), np.diagonal(start.bias_cov))]
    try:
        known += [known_bias(problem, values, k, past) for k, past in before]
    except np.linalg.LinAlgError:  # the data before one of the states do not determine them
        return None
    found = [w for n, now in enumerate(known) if (w := went_too_far(known[:n], now, problem.links)) is not None]
    return BiasWanders({WALK_KEYS[k]: times for k, times in found[-1:]}) if found else None


def _solve_grown(window: GrownWindow) -> tuple[int, StretchStep, Verdicts]:
    """Solve a window, in place; return iterations, the last step and its verdicts.

    New hypotheses are judged only after the other measurements have given an estimate with its covariance: with false
    matches in it, a window solved with Huber losses alone is off by many of its own sigmas (0.01 rad/s of gyro bias,
    300 m after 20 s of dead reckoning).
    """
    problem, values, first, known, last, prior = window
    fresh = _fresh(problem, known, last)
    step, verdicts, iterations = _solve_without(window, fresh)
    if not fresh:
        return iterations, step, verdicts
    predicted = predicted_by(marginals(step.graph, step.values).cov)
    covariance: PredictedCovariance = lambda k, key: predicted(k, key) if k > known else None
    for _ in range(2):
        verdicts = weigh(problem, values, first=first, last=last, stage=Stage.FINAL, covariance=covariance)
        step = solve_until_written_there(problem, values, first, last, prior, decisions(verdicts))
        iterations += step.iterations
        covariance = lambda _state, _key: None
        if step.moved_m < _SETTLED_M:
            break
    return iterations, step, verdicts


def _fresh(problem: Problem, known: int, last: int) -> set[tuple[int, int]]:
    """Return the measurements of sensors with hypotheses that are new in a window."""
    return {(s.number, i) for s in problem.streams if s.row.has_hypotheses for i in s.between(known + 1, last)}


def _solve_without(window: GrownWindow, fresh: Container[tuple[int, int]]) -> tuple[StretchStep, Verdicts, int]:
    """Solve a window without its new hypotheses, in place; return the step, its verdicts, and the iterations.

    If the solution moves far, and sensors still disagree with it, gentle losses may have to lead back. But these also
    follow a sensor that is wrong: a compass that is 90 deg off for the whole window bends the gyroscope's bias. So of
    the solutions before and after gentle losses, the least costly stays.
    """
    problem, values, first, known, last, prior = window

    def solved(stage: Stage) -> tuple[StretchStep, Verdicts]:
        verdicts = weigh(problem, values, first=first, last=last, stage=stage)
        decided, jumps = decisions(verdicts, fresh), stage is not Stage.FAR
        return solve_stretch(problem, values, first, last, prior, decided, jumps=jumps), verdicts

    def cost() -> float:
        return cost_as_configured(problem, values, first, last, prior, judged=known)

    step, verdicts = solved(Stage.FINAL)
    iterations = step.iterations
    if step.moved_m < _FAR_SETTLED_M:
        return step, verdicts, iterations
    begin, found = copy_states(problem, values, first, last), list[tuple[float, StretchStep, Verdicts]]()
    for _ in range(_MAX_ROUNDS):
        step, verdicts = solved(Stage.FINAL)
        iterations += step.iterations
        found.append((cost(), step, verdicts))
        if step.moved_m < _FAR_SETTLED_M:
            break
    if step.moved_m < _FAR_SETTLED_M and _agree(problem, verdicts):
        return step, verdicts, iterations
    update_states(problem, values, begin, first, last)
    for _ in range(_MAX_FAR_ROUNDS):
        step, _ = solved(Stage.FAR)
        iterations += step.iterations
        if step.moved_m < _FAR_SETTLED_M:
            break
    step, verdicts = solved(Stage.FINAL)
    iterations += step.iterations
    found.append((cost(), step, verdicts))
    _, step, verdicts = min(found, key=lambda f: f[0])
    update_states(problem, values, step.values, first, last)
    return step, verdicts, iterations


def _agree(problem: Problem, verdicts: Verdicts) -> bool:
    """Return whether most measurements of each sensor without hypotheses agree, by its loss as wide as configured."""
    by_loss = {stream.number: stream for stream in problem.streams if not stream.row.has_hypotheses}
    agree: dict[int, list[bool]] = {number: [] for number in by_loss}
    for (number, _), verdict in verdicts.items():
        if (stream := by_loss.get(number)) is not None:
            agree[number].append(agrees(stream, verdict.residual))
    judged = [found for found in agree.values() if found]
    return bool(judged) and all(np.mean(found) >= _MOSTLY for found in judged)
