# SPDX-License-Identifier: Apache-2.0
"""From the start alignment to an estimate of the whole run, a window at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Past, Problem, StartPrior
from graphloc.errors import SolveError
from graphloc.frames import wrap_angle
from graphloc.recording import Progress
from graphloc.solve._align import Start, start_pose
from graphloc.solve._decide import PredictedCovariance, Verdicts, decisions, predicted_covariance, weigh
from graphloc.solve._optimize import bayes_tree
from graphloc.solve._stretch import (
    StretchStep,
    dead_reckon,
    fill_slow,
    past_at,
    solve_stretch,
    solve_until_written_there,
)

_CHUNK_S, _OVERLAP_S = 15.0, 5.0
_SETTLED_M = 0.5
_MAX_FAR_ROUNDS, _FAR_SETTLED_M = 8, 2.0
# Starts that cost this much more (log-likelihood) are dropped; while several remain, the window grows.
_COST_APART, _LONGEST_START_S = 8.0, 60.0
_PLACE_S, _LATE_PLACE_S = 5.0, 90.0  # of positions in the first window; latest time of the first one
# Stages of the first window: name, most rounds, motion in m that ends it, whether hypotheses are weighed.
_START_STAGES = (("far", 8, 0.5, False), ("open", 2, 0.5, False), ("final", 2, 0.5, True))


class Begun(NamedTuple):
    """The start of a run: values, prior, the last state solved, iterations, and how many headings explain it."""

    values: gtsam.Values
    prior: StartPrior
    last: int
    iterations: int
    headings: int


def solve_start(problem: Problem, start: Start, progress: Progress) -> Begun:
    """Try each candidate on the first window; look further while several explain it; keep the cheapest."""
    seconds, iterations, until = max(start.window_s, _placed_s(problem)), 0, 0
    candidates = [_candidate(problem, start, yaw) for yaw in start.yaws_rad]
    failure: SolveError | None = None
    while True:
        known, until = until, _index_after(problem, seconds)
        alive = []
        for n, candidate in enumerate(candidates):
            progress("start", n, len(candidates))
            try:
                dead_reckon(problem, candidate.values, known, until)
                used, candidate.cost = _solve_candidate(problem, candidate, until)
            except SolveError as caught:
                failure = caught
                continue
            iterations += used
            alive.append(candidate)
        if not alive:
            raise failure or SolveError("the start alignment found no heading to try")
        alive.sort(key=lambda c: c.cost)
        candidates = _different(alive)
        if len(candidates) == 1 or seconds >= _LONGEST_START_S or until == len(problem.timeline) - 1:
            return Begun(candidates[0].values, candidates[0].prior, until, iterations, len(candidates))
        seconds *= 1.6


def _placed_s(problem: Problem) -> float:
    """Return how long (s) the first window must be to contain a position measurement; 0 where none comes soon.

    Without one the next window would be dead reckoning with poorly known biases: after 15 s it may be 300 m off, and tags cannot be
    judged by such a prediction.
    """
    stamps = problem.timeline.stamps_ns
    first_ns = [s.measurements[0].stamp_ns for s in problem.streams if s.row.absolute and s.measurements]
    soon_s = float(min(first_ns) - stamps[0]) * 1e-9 + _PLACE_S if first_ns else 0.0
    return soon_s if soon_s <= _LATE_PLACE_S else 0.0


@dataclass(slots=True)
class _Candidate:
    """One start: its estimate, prior and cost so far."""

    values: gtsam.Values
    prior: StartPrior
    cost: float = 0.0


def _candidate(problem: Problem, start: Start, yaw: float) -> _Candidate:
    prior, values = _start_prior(problem, start, yaw), gtsam.Values()
    values.insert(keys.pose(0), prior.pose)
    values.insert(keys.velocity(0), prior.velocity)
    fill_slow(problem, values, 0, prior.bias, {})
    return _Candidate(values, prior)


def _start_prior(problem: Problem, start: Start, yaw: float) -> StartPrior:
    pose = start_pose(start, yaw)
    R = pose.rotation().matrix()
    world_rotation = np.diag([start.tilt_sigma_rad, start.tilt_sigma_rad, start.yaw_sigma_rad]) ** 2
    cov = np.zeros((6, 6))
    cov[:3, :3] = R.T @ world_rotation @ R
    cov[3:, 3:] = R.T @ np.diag(start.p_sigma_m**2) @ R
    sigmas = problem.links.bias_sigmas()
    bias_cov = np.diag(np.concatenate([sigmas[:3], start.gyro_bias_sigma_radps]) ** 2)
    return StartPrior(
        pose=pose,
        pose_cov=cov,
        velocity=start.v_world_mps,
        velocity_cov=np.diag(start.v_sigma_mps**2),
        bias=gtsam.imuBias.ConstantBias(np.zeros(3), start.gyro_bias_radps),
        bias_cov=bias_cov,
        level=start.level,
    )


def _different(ranked: list[_Candidate]) -> list[_Candidate]:
    """Drop candidates that cost clearly more than the cheapest, or have converged to the heading of a cheaper one."""
    kept: list[_Candidate] = []
    for candidate in ranked:
        yaw = candidate.values.atPose3(keys.pose(0)).rotation().yaw()
        apart = all(
            abs(wrap_angle(yaw - other.values.atPose3(keys.pose(0)).rotation().yaw())) > np.radians(15.0)
            for other in kept
        )
        if apart and candidate.cost < ranked[0].cost + _COST_APART + 0.2 * ranked[0].cost:
            kept.append(candidate)
    return kept


def _solve_candidate(problem: Problem, candidate: _Candidate, last: int) -> tuple[int, float]:
    """Solve the first window in place, gently first; return iterations and final error."""
    iterations, error = 0, 0.0
    for stage, limit, settled_m, hypotheses in _START_STAGES:
        for _ in range(limit):
            verdicts = weigh(problem, candidate.values, first=0, last=last, stage=stage, hypotheses=hypotheses)
            decided, jumps = decisions(verdicts), stage != "far"
            step = solve_stretch(problem, candidate.values, 0, last, candidate.prior, decided, jumps=jumps, tol=1e-4)
            iterations, error = iterations + step.iterations, step.error
            if step.moved_m < settled_m:
                break
    return iterations, error


def _index_after(problem: Problem, seconds: float) -> int:
    stamps = problem.timeline.stamps_ns
    return int(min(np.searchsorted(stamps, stamps[0] + int(seconds * 1e9)), len(stamps) - 1))


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
) -> int:
    """Take the estimate of states 0..known to the end of the run, a chunk at a time, in place.

    Args:
        chunk_s, overlap_s: how far a step goes, and how far back its window reaches.
        watch: called with the last state of each window and the decisions in it, as known at that time.
    """
    stamps, slow_of, end = problem.timeline.stamps_ns, problem.timeline.slow_of, len(problem.timeline) - 1
    prior: StartPrior | Past = start
    verdicts = weigh(problem, estimate, first=0, last=known, stage="final")
    step = solve_stretch(problem, estimate, 0, known, prior, decisions(verdicts))
    iterations, first = step.iterations, 0
    while known < end:
        until = int(min(np.searchsorted(stamps, stamps[known] + int(chunk_s * 1e9)), end))
        back = problem.timeline.floor(int(stamps[known]) - int(overlap_s * 1e9))
        start_of_window = int(np.searchsorted(slow_of, slow_of[back]))
        if start_of_window > first and slow_of[start_of_window] < slow_of[known]:
            prior = past_at(problem, step, start_of_window)
            first = start_of_window
        dead_reckon(problem, estimate, known, until)
        used, step, verdicts = _solve_grown(problem, estimate, first, known, until, prior)
        watch(until, verdicts)
        iterations, known = iterations + used, until
        progress("growing", known, end)
    return iterations


def _solve_grown(
    problem: Problem, values: gtsam.Values, first: int, known: int, last: int, prior: StartPrior | Past
) -> tuple[int, StretchStep, Verdicts]:
    """Solve a window whose states after `known` are new, in place; return iterations, the last step and its verdicts.

    New hypotheses are judged only after the other measurements have given an estimate with its covariance: with false matches in it, a
    window solved with Huber losses alone is off by many of its own sigmas (0.01 rad/s of gyro bias, 300 m after 20 s of dead
    reckoning).
    """
    fresh = {(s.number, i) for s in problem.streams if s.row.false is not None for i in s.between(known + 1, last)}
    iterations = 0
    for stage in ("final", *["far"] * _MAX_FAR_ROUNDS, "final"):
        verdicts = weigh(problem, values, first=first, last=last, stage=stage)
        step = solve_stretch(problem, values, first, last, prior, decisions(verdicts, fresh), jumps=stage != "far")
        iterations += step.iterations
        if step.moved_m < _FAR_SETTLED_M:
            break
    if not fresh:
        return iterations, step, verdicts
    predicted = predicted_covariance(bayes_tree(step.graph, step.values))
    covariance: PredictedCovariance = lambda k, key: predicted(k, key) if k > known else None
    for _ in range(2):
        verdicts = weigh(problem, values, first=first, last=last, stage="final", covariance=covariance)
        step = solve_until_written_there(problem, values, first, last, prior, decisions(verdicts))
        iterations += step.iterations
        covariance = lambda _state, _key: None
        if step.moved_m < _SETTLED_M:
            break
    return iterations, step, verdicts
