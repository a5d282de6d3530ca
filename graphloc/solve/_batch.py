# SPDX-License-Identifier: Apache-2.0
"""The offline solver: align, grow, open the graph to everything, then decide.

1. Align over a window; try each candidate heading on it and keep the cheapest.
2. Grow: 20 s more at a time, solved with the last 5 s and a prior from what was before.
3. Open passes over the whole run: Cauchy everywhere, so that nothing is locked out.
4. Mixture passes: modes and weights re-chosen, first with the predicted covariance, then without it.
5. Covariances of every state from a Bayes tree with QR.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Problem, StartPrior, build_graph, nav_state, with_noise_scale
from graphloc.errors import SolveError
from graphloc.frames import Array, wrap_angle
from graphloc.solve._align import Start, align, start_pose
from graphloc.solve._decide import Verdict, decisions, pose_covariance, weigh
from graphloc.solve._lm import bayes_tree, optimize

_CHUNK_S, _OVERLAP_S = 8.0, 10.0
_MAX_OPEN_PASSES, _MAX_MIXTURE_PASSES, _MAX_NOISE_ROUNDS = 4, 6, 5
_CONTRADICTION = 2.5  # times its expectation: a cost from which the IMU noise is not believed
_SETTLED_M, _SETTLED_WEIGHT = 0.01, 0.05
_WINDOW_SETTLED_M = 0.5
# Starts that cost this much more (log-likelihood) are dropped; while others live, the window grows.
_COST_APART, _LONGEST_START_S = 8.0, 60.0
# Stages of a window: name, most rounds, motion in m that ends it. A grown window starts near the truth.
_Stages = tuple[tuple[str, int, float], ...]
_START_STAGES: _Stages = (("far", 8, 0.5), ("open", 2, 0.5), ("mixture", 2, 0.5))
_GROW_STAGES: _Stages = (("far", 8, 2.0), ("mixture", 2, 0.5))

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """The solved graph, before it is turned into a `Solution`."""

    values: gtsam.Values
    verdicts: dict[tuple[int, int], Verdict]
    tree: Any
    graph: gtsam.NonlinearFactorGraph
    passes: int
    iterations: int
    converged: bool
    noise_scale: float
    notes: tuple[str, ...]


def solve_batch(problem: Problem, progress: Progress = lambda *_: None) -> BatchResult:
    """Solve a whole run.

    Raises:
        SolveError: it could not be started, or the linear algebra failed.
    """
    start = align(problem)
    last = len(problem.timeline) - 1
    estimate, prior, known, iterations = _start_window(problem, start, progress)
    iterations += _grow(problem, estimate, prior, known, progress)
    passes, converged = 0, False
    verdicts: dict[tuple[int, int], Verdict] = {}
    grown = gtsam.Values(estimate)
    for attempt in range(_MAX_NOISE_ROUNDS):
        estimate, verdicts, tree, graph, passed, used = _open_passes(problem, grown, prior, progress)
        passes, iterations = passes + passed, iterations + used
        ratio = 2.0 * float(graph.error(estimate)) / max(expected_cost(problem, verdicts), 1.0)
        adapt = getattr(problem.config.sensors[problem.imu.sensor], "adapt_noise", False)
        if not adapt or ratio < _CONTRADICTION or attempt == _MAX_NOISE_ROUNDS - 1:
            break
        problem = with_noise_scale(problem, problem.noise_scale * float(np.clip(np.sqrt(ratio), 1.5, 3.0)))
    # Mixture passes: the predicted covariance is added in the first only.
    weights = np.array([v.weight for v in verdicts.values()])
    for n in range(_MAX_MIXTURE_PASSES):
        inflation = pose_covariance(tree) if n == 0 else None
        verdicts = weigh(problem, estimate, inflation, first=0, last=last, stage="mixture")
        estimate, used, moved, _, graph = _pass(problem, estimate, verdicts, prior, tree_wanted=False)
        passes, iterations = passes + 1, iterations + used
        fresh = np.array([v.weight for v in verdicts.values()])
        changed = float(np.abs(fresh - weights).max(initial=0.0))
        weights = fresh
        progress("mixture passes", n + 1, _MAX_MIXTURE_PASSES)
        if n > 0 and moved < _SETTLED_M and changed < _SETTLED_WEIGHT:
            converged = True
            break
    if moved < 5 * _SETTLED_M:
        converged = True
    progress("covariances", 0, 1)
    verdicts = weigh(problem, estimate, None, first=0, last=last, stage="mixture")
    graph, guess = build_graph(problem, estimate, decisions(verdicts), 0, last, prior)
    tree = bayes_tree(graph, guess)
    progress("covariances", 1, 1)
    return BatchResult(
        values=guess,
        verdicts=verdicts,
        tree=tree,
        graph=graph,
        passes=passes,
        iterations=iterations,
        converged=converged,
        noise_scale=problem.noise_scale,
        notes=start.notes,
    )


def _open_passes(
    problem: Problem, estimate: gtsam.Values, prior: StartPrior, progress: Progress
) -> tuple[gtsam.Values, dict[tuple[int, int], Verdict], Any, gtsam.NonlinearFactorGraph, int, int]:
    """Solve the whole run with gentle losses. Carries and anchors depend on the estimate: build anew until it stands."""
    last = len(problem.timeline) - 1
    passes = iterations = 0
    for stage in ("far", "open"):
        for n in range(_MAX_OPEN_PASSES):
            verdicts = weigh(problem, estimate, None, first=0, last=last, stage=stage)
            wanted = stage == "open"
            estimate, used, moved, tree, graph = _pass(
                problem, estimate, verdicts, prior, tree_wanted=wanted, jumps=stage != "far"
            )
            passes, iterations = passes + 1, iterations + used
            progress(f"{stage} passes", n + 1, _MAX_OPEN_PASSES)
            if moved < _WINDOW_SETTLED_M:
                break
    return estimate, verdicts, tree, graph, passes, iterations


def expected_cost(problem: Problem, verdicts: dict[tuple[int, int], Verdict]) -> float:
    """Degrees of freedom of the weighted problem: what 2 x its cost is expected to be."""
    n, m = len(problem.timeline), len(problem.timeline.slow_stamps_ns)
    expected = sum(len(v.residual.raw) * v.weight for v in verdicts.values())
    expected += 9.0 * (n - 1) + 6.0 * (m - 1) + 15.0 - 9.0 * n - 6.0 * m
    for stream in problem.streams:
        if stream.slow is not None:
            k, constant = len(stream.slow.sigma), not np.isfinite(stream.slow.time_constant_s)
            expected += k * (m - 1) * (1 if constant else 2) + k - k * m
    return expected


def _pass(
    problem: Problem,
    estimate: gtsam.Values,
    verdicts: dict[tuple[int, int], Verdict],
    prior: StartPrior,
    *,
    tree_wanted: bool,
    jumps: bool = True,
) -> tuple[gtsam.Values, int, float, Any, gtsam.NonlinearFactorGraph]:
    last = len(problem.timeline) - 1
    graph, guess = build_graph(problem, estimate, decisions(verdicts), 0, last, prior, jumps=jumps)
    solved = optimize(graph, guess, 12)
    moved = _moved(guess, solved.values, 0, last)
    tree = bayes_tree(graph, solved.values) if tree_wanted else None
    return solved.values, solved.iterations, moved, tree, graph


def _index_after(problem: Problem, seconds: float) -> int:
    stamps = problem.timeline.stamps_ns
    return int(min(np.searchsorted(stamps, stamps[0] + int(seconds * 1e9)), len(stamps) - 1))


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
    )


@dataclass(slots=True)
class _Candidate:
    """One start: its estimate, prior and cost so far."""

    values: gtsam.Values
    prior: StartPrior
    cost: float = 0.0


def _start_window(problem: Problem, start: Start, progress: Progress) -> tuple[gtsam.Values, StartPrior, int, int]:
    """Try each candidate on the first window; look further while several explain it; keep the cheapest.

    Returns values, prior, the last state solved, and iterations.
    """
    seconds, iterations, until = start.window_s, 0, 0
    candidates = [_candidate(problem, start, yaw) for yaw in start.yaws_rad]
    failure: SolveError | None = None
    while True:
        known, until = until, _index_after(problem, seconds)
        alive = []
        for n, candidate in enumerate(candidates):
            progress("start", n, len(candidates))
            try:
                _extend(problem, candidate.values, known, until)
                used, candidate.cost = _solve_window(
                    problem, candidate.values, 0, until, candidate.prior, _START_STAGES
                )
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
            return candidates[0].values, candidates[0].prior, until, iterations
        seconds *= 1.6


def _different(ranked: list[_Candidate]) -> list[_Candidate]:
    """Drop what is clearly dearer than the cheapest, and what has come to the same heading as a cheaper one."""
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


def _candidate(problem: Problem, start: Start, yaw: float) -> _Candidate:
    prior, values = _start_prior(problem, start, yaw), gtsam.Values()
    values.insert(keys.pose(0), prior.pose)
    values.insert(keys.velocity(0), prior.velocity)
    _fill_slow(problem, values, 0, prior.bias, {})
    return _Candidate(values, prior)


def _fill_slow(problem: Problem, values: gtsam.Values, j: int, bias: Any, slow: dict[int, Array]) -> None:
    values.insert(keys.bias(j), bias)
    for stream in problem.streams:
        if stream.slow is not None:
            values.insert(keys.slow(stream.number, j), slow.get(stream.number, np.zeros(len(stream.slow.sigma))))


def _extend(problem: Problem, values: gtsam.Values, known: int, until: int) -> None:
    """Dead-reckon from state `known` to `until`."""
    for k in range(known, until):
        j, following = (int(problem.timeline.slow_of[i]) for i in (k, k + 1))
        bias = values.atConstantBias(keys.bias(j))
        state = problem.preintegrated[k].predict(nav_state(values, k), bias)
        values.insert(keys.pose(k + 1), state.pose())
        values.insert(keys.velocity(k + 1), np.asarray(state.velocity()))
        if following != j:
            slow = {
                s.number: np.atleast_1d(values.atVector(keys.slow(s.number, j)))
                for s in problem.streams
                if s.slow is not None
            }
            _fill_slow(problem, values, following, bias, slow)


def _solve_window(
    problem: Problem, values: gtsam.Values, first: int, last: int, prior: StartPrior, stages: _Stages
) -> tuple[int, float]:
    """Solve states first..last in place; return iterations and final error.

    With false matches in it, a window solved under Huber alone is off by many of its own sigmas (0.01 rad/s
    of gyro bias, 300 m after 20 s of dead reckoning), so each window goes through all the stages.
    """
    iterations, error = 0, 0.0
    for stage, limit, settled_m in stages:
        for _ in range(limit):
            verdicts = weigh(problem, values, None, first=first, last=last, stage=stage)
            graph, guess = build_graph(problem, values, decisions(verdicts), first, last, prior, jumps=stage != "far")
            solved = optimize(graph, guess, 15)
            iterations += solved.iterations
            moved = _moved(guess, solved.values, first, last)
            _update(problem, values, solved.values, first, last)
            error = solved.error
            if moved < settled_m:
                break
    return iterations, error


def _moved(old: gtsam.Values, new: gtsam.Values, first: int, last: int) -> float:
    """How far any pose moved, m (1 rad counts as 10 m)."""
    steps = (old.atPose3(keys.pose(k)).localCoordinates(new.atPose3(keys.pose(k))) for k in range(first, last + 1))
    return max(float(np.linalg.norm(s[3:]) + 10.0 * np.linalg.norm(s[:3])) for s in steps)


def _update(problem: Problem, values: gtsam.Values, new: gtsam.Values, first: int, last: int) -> None:
    """Write the states first..last of `new` into `values` (in place: a copy each would be quadratic)."""
    for k in range(first, last + 1):
        values.update(keys.pose(k), new.atPose3(keys.pose(k)))
        values.update(keys.velocity(k), new.atVector(keys.velocity(k)))
    for j in range(int(problem.timeline.slow_of[first]), int(problem.timeline.slow_of[last]) + 1):
        values.update(keys.bias(j), new.atConstantBias(keys.bias(j)))
        for stream in problem.streams:
            if stream.slow is not None:
                key = keys.slow(stream.number, j)
                values.update(key, np.atleast_1d(new.atVector(key)))


def _grow(problem: Problem, estimate: gtsam.Values, prior: StartPrior, known: int, progress: Progress) -> int:
    """Take the estimate of states 0..known to the end of the run, a chunk at a time, in place."""
    stamps, end = problem.timeline.stamps_ns, len(problem.timeline) - 1
    iterations, first = 0, 0
    while known < end:
        until = int(min(np.searchsorted(stamps, stamps[known] + int(_CHUNK_S * 1e9)), end))
        start_of_window = int(np.searchsorted(stamps, stamps[known] - int(_OVERLAP_S * 1e9)))
        if start_of_window > first:
            verdicts = weigh(problem, estimate, None, first=first, last=known, stage="mixture")
            graph, guess = build_graph(problem, estimate, decisions(verdicts), first, known, prior)
            prior = _prior_at(problem, bayes_tree(graph, guess), guess, start_of_window)
            first = start_of_window
        _extend(problem, estimate, known, until)
        used, _ = _solve_window(problem, estimate, first, until, prior, _GROW_STAGES)
        iterations += used
        known = until
        progress("growing", known, end)
    return iterations


def _prior_at(problem: Problem, tree: Any, values: gtsam.Values, k: int) -> StartPrior:
    """The marginals at state `k` as a prior; cross terms are left out, which only loosens it."""
    j = int(problem.timeline.slow_of[k])
    cov = {key: np.asarray(tree.marginalCovariance(key)) for key in (keys.pose(k), keys.velocity(k), keys.bias(j))}
    slow = {}
    for stream in problem.streams:
        if stream.slow is not None:
            key = keys.slow(stream.number, j)
            slow[stream.number] = (np.atleast_1d(values.atVector(key)), np.asarray(tree.marginalCovariance(key)))
    return StartPrior(
        pose=values.atPose3(keys.pose(k)),
        pose_cov=cov[keys.pose(k)],
        velocity=values.atVector(keys.velocity(k)),
        velocity_cov=cov[keys.velocity(k)],
        bias=values.atConstantBias(keys.bias(j)),
        bias_cov=cov[keys.bias(j)],
        slow=slow,
    )
