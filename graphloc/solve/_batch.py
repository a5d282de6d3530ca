# SPDX-License-Identifier: Apache-2.0
"""The offline solver: align, grow, then decide about the whole run.

1. Align over a window; try each candidate heading on it and keep the cheapest.
2. Grow, some seconds at a time, each window solved with a prior from what was before. Hypotheses that
   are new in a window are judged by the prediction without them, with its covariance.
3. Judge each stretch's hypotheses once more, by the whole run without that stretch.
4. Passes over the whole run: modes and weights re-chosen until they stand.
5. Covariances of every state from a Bayes tree with QR.

An inertial sensor that contradicts the rest gets more noise, and 3 to 4 are done again.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Decisions, Problem, StartPrior, build_graph, nav_state, with_noise_scale
from graphloc.errors import SolveError
from graphloc.frames import Array, wrap_angle
from graphloc.graph import Decision
from graphloc.solve._align import Start, align, start_pose
from graphloc.solve._decide import (
    PoseCovariance,
    Verdict,
    Verdicts,
    along_best_chains,
    decisions,
    log_evidence,
    pose_covariance,
    thinned,
    weigh,
)
from graphloc.solve._optimize import bayes_tree, full_step, optimize

_CHUNK_S, _OVERLAP_S = 15.0, 5.0
_MAX_OPEN_PASSES, _MAX_FINAL_PASSES, _MAX_NOISE_ROUNDS = 4, 6, 5
_CONTRADICTION = 2.5  # times its expectation: a cost from which the IMU noise is not believed
_SETTLED_M, _SETTLED_WEIGHT = 0.03, 0.1
_WINDOW_SETTLED_M = 0.5
_MAX_GROW_ROUNDS, _GROWN_SETTLED_M = 8, 2.0
# A stretch whose hypotheses are judged by the rest of the run: longer than false answers tend to stay,
# short enough to dead-reckon through.
_STRETCH_S, _STRETCH_MARGIN = 8.0, 0.5
_SURE = 0.7  # a hypothesis judged by the rest alone is believed from here on
# Surroundings on which another choice of hypotheses is tried.
_AROUND_S = 10.0
# Starts that cost this much more (log-likelihood) are dropped; while others live, the window grows.
_COST_APART, _LONGEST_START_S = 8.0, 60.0
# Stages of the first window: name, most rounds, motion in m that ends it, whether hypotheses are weighed.
_START_STAGES = (("far", 8, 0.5, False), ("open", 2, 0.5, False), ("final", 2, 0.5, True))

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """The solved graph, before it is turned into a `Solution`."""

    values: gtsam.Values
    verdicts: Verdicts
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
    grown, prior, known, iterations = _start_window(problem, start, progress)
    iterations += _grow(problem, grown, prior, known, progress)
    passes, estimate, ratio = 0, grown, 1.0
    for attempt in range(_MAX_NOISE_ROUNDS):
        if attempt > 0:
            problem = with_noise_scale(problem, problem.noise_scale * float(np.clip(np.sqrt(ratio), 1.5, 3.0)))
            estimate, used, passed = _open_passes(problem, estimate, prior, progress)
            passes, iterations = passes + passed, iterations + used
        settled = _final_passes(problem, estimate, prior, progress)
        passes, iterations, estimate = passes + settled.passes, iterations + settled.iterations, settled.values
        ratio = 2.0 * float(settled.graph.error(estimate)) / max(expected_cost(problem, settled.verdicts), 1.0)
        if ratio < _CONTRADICTION or not problem.config.sensors[problem.imu.sensor].adapt_noise:
            break
    return BatchResult(
        values=estimate,
        verdicts=settled.verdicts,
        tree=settled.tree,
        graph=settled.graph,
        passes=passes,
        iterations=iterations,
        converged=settled.converged,
        noise_scale=problem.noise_scale,
        notes=start.notes,
    )


def _open_passes(
    problem: Problem, estimate: gtsam.Values, prior: StartPrior, progress: Progress
) -> tuple[gtsam.Values, int, int]:
    """Solve the whole run with gentle losses. Carries and anchors depend on the estimate: build anew until it stands."""
    last = len(problem.timeline) - 1
    passes = iterations = 0
    for stage in ("far", "open"):
        for n in range(_MAX_OPEN_PASSES):
            verdicts = weigh(problem, estimate, first=0, last=last, stage=stage)
            done = _pass(problem, estimate, verdicts, prior, jumps=stage != "far")
            estimate = done.values
            passes, iterations = passes + 1, iterations + done.iterations
            progress(f"{stage} passes", n + 1, _MAX_OPEN_PASSES)
            if done.moved_m < _WINDOW_SETTLED_M:
                break
    return estimate, iterations, passes


@dataclass(frozen=True, slots=True, kw_only=True)
class _Settled:
    """A solution of the whole run; `tree` holds `graph` linearised within the last step of `values`."""

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    tree: Any
    verdicts: Verdicts
    passes: int
    iterations: int
    converged: bool


def _final_passes(problem: Problem, estimate: gtsam.Values, prior: StartPrior, progress: Progress) -> _Settled:
    """Re-choose modes and weights over the whole run until they stand, and look for better choices.

    Choices confirm themselves: the estimate follows them. So two others are tried: the most probable chain of
    measurements that agree with each other, and what the run says of each stretch without its own. Where one
    of these is more probable, it is taken.
    """
    last = len(problem.timeline) - 1
    settled = _settle(problem, estimate, weigh(problem, estimate, first=0, last=last, stage="final"), prior, progress)
    changed, iterations = False, settled.iterations
    for other in (_along_best_chains, _judged_by_the_rest):
        others, used = other(problem, settled, prior)
        changed = _take_more_probable(problem, settled, others, prior) or changed
        iterations += used
    if not changed:
        return replace(settled, iterations=iterations)
    again = _settle(problem, settled.values, settled.verdicts, prior, progress)
    return replace(again, iterations=iterations + again.iterations, passes=settled.passes + again.passes)


def _changed(before: Verdicts, after: Verdicts) -> float:
    """The largest change of any weight."""
    return max((abs(v.weight - before[key].weight) for key, v in after.items()), default=0.0)


def _take_more_probable(problem: Problem, settled: _Settled, others: Verdicts, prior: StartPrior) -> bool:
    """Take the choices of `others` into `settled`, in place, wherever they are more probable; tell whether any were.

    Choices that differ are taken together while they are near in time, and each such group is tried on its
    own surroundings, so that one bad guess does not cost the good ones, and a long run costs no more.
    """
    taken = False
    for group in _groups(problem, settled.verdicts, others):
        states = [_state_of(problem, key) for key in group]
        low, high = min(states), max(states)
        first, last = _index_around(problem, low, -_AROUND_S), _index_around(problem, high, _AROUND_S)
        start = prior if first == 0 else _weak_prior(problem, settled.values, first)
        here = _solve_around(problem, settled.values, settled.verdicts, first, last, start)
        there = _solve_around(problem, settled.values, others, first, last, start)
        if there.cost < here.cost:
            _update(problem, settled.values, there.values, first, last)
            settled.verdicts.update(there.verdicts)
            taken = True
    return taken


def _groups(problem: Problem, some: Verdicts, others: Verdicts) -> list[list[tuple[int, int]]]:
    """Measurements that are believed in the one and not in the other, split where they are far apart in time."""
    stamps = problem.timeline.stamps_ns
    differ = sorted(
        (key for key, v in some.items() if abs(others[key].weight - v.weight) > 0.5),
        key=lambda key: _state_of(problem, key),
    )
    groups: list[list[tuple[int, int]]] = []
    for key in differ:
        near = groups and stamps[_state_of(problem, key)] - stamps[_state_of(problem, groups[-1][-1])] < 2e9 * _AROUND_S
        if near:
            groups[-1].append(key)
        else:
            groups.append([key])
    return groups


def _state_of(problem: Problem, key: tuple[int, int]) -> int:
    return int(next(s for s in problem.streams if s.number == key[0]).state[key[1]])


def _index_around(problem: Problem, k: int, seconds: float) -> int:
    stamps = problem.timeline.stamps_ns
    return int(np.clip(np.searchsorted(stamps, stamps[k] + int(seconds * 1e9)), 0, len(stamps) - 1))


class _Around(NamedTuple):
    """A stretch solved on its own: values, verdicts, and -log of its probability, all hypotheses summed over."""

    values: gtsam.Values
    verdicts: Verdicts
    cost: float


def _solve_around(
    problem: Problem, values: gtsam.Values, verdicts: Verdicts, first: int, last: int, prior: StartPrior
) -> _Around:
    local = _copy(problem, values, max(first - 1, 0), min(last + 1, len(problem.timeline) - 1))
    for _ in range(_MAX_FINAL_PASSES):
        step = _solve_window(problem, local, first, last, prior, decisions(verdicts), tol=1e-3)
        used, verdicts = verdicts, weigh(problem, local, first=first, last=last, stage="final")
        if step.moved_m < _SETTLED_M and _changed(used, verdicts) < _SETTLED_WEIGHT:
            break
    numbers = {s.number for s in problem.streams if s.row.false is not None}
    plain = decisions(verdicts, {key for key in verdicts if key[0] in numbers})
    graph, guess = build_graph(problem, local, plain, first, last, prior)
    return _Around(local, verdicts, float(graph.error(guess)) - log_evidence(problem, local, first, last))


def _copy(problem: Problem, values: gtsam.Values, first: int, last: int) -> gtsam.Values:
    """The states first..last and their slow states."""
    copy = gtsam.Values()
    for k in range(first, last + 1):
        copy.insert(keys.pose(k), values.atPose3(keys.pose(k)))
        copy.insert(keys.velocity(k), values.atVector(keys.velocity(k)))
    for j in range(int(problem.timeline.slow_of[first]), int(problem.timeline.slow_of[last]) + 1):
        _fill_slow(problem, copy, j, values.atConstantBias(keys.bias(j)), _slow_at(problem, values, j))
    return copy


def _slow_at(problem: Problem, values: gtsam.Values, j: int) -> dict[int, Array]:
    return {
        s.number: np.atleast_1d(values.atVector(keys.slow(s.number, j))) for s in problem.streams if s.slow is not None
    }


def _weak_prior(problem: Problem, values: gtsam.Values, k: int) -> StartPrior:
    """A prior on state `k` that only keeps a stretch determined; what the stretch measures outweighs it."""
    j = int(problem.timeline.slow_of[k])
    slow = _slow_at(problem, values, j)
    return StartPrior(
        pose=values.atPose3(keys.pose(k)),
        pose_cov=np.diag([0.05**2] * 3 + [1.0] * 3),
        velocity=values.atVector(keys.velocity(k)),
        velocity_cov=np.eye(3) * 0.5**2,
        bias=values.atConstantBias(keys.bias(j)),
        bias_cov=np.diag([0.05**2] * 3 + [0.002**2] * 3),
        slow={s.number: (slow[s.number], np.diag(s.slow.sigma**2)) for s in problem.streams if s.slow is not None},
    )


def _along_best_chains(problem: Problem, settled: _Settled, prior: StartPrior) -> tuple[Verdicts, int]:
    return along_best_chains(problem, settled.values, settled.verdicts), 0


def _settle(
    problem: Problem,
    estimate: gtsam.Values,
    verdicts: Verdicts,
    prior: StartPrior,
    progress: Progress,
) -> _Settled:
    """Passes until modes and weights stand."""
    last, iterations = len(problem.timeline) - 1, 0
    for n in range(_MAX_FINAL_PASSES):
        # The first pass takes out the seams of the windows; from then on one step at a time is enough.
        done = (_pass if n == 0 else _refine)(problem, estimate, verdicts, prior)
        estimate, iterations = done.values, iterations + done.iterations
        used, verdicts = verdicts, weigh(problem, estimate, first=0, last=last, stage="final")
        progress("final passes", n + 1, _MAX_FINAL_PASSES)
        if n > 0 and done.moved_m < _SETTLED_M and _changed(used, verdicts) < _SETTLED_WEIGHT:
            break
    return _Settled(
        values=estimate,
        graph=done.graph,
        tree=done.tree,
        verdicts=verdicts,
        passes=n + 1,
        iterations=iterations,
        converged=done.moved_m < 3 * _SETTLED_M,
    )


def _judged_by_the_rest(problem: Problem, settled: _Settled, prior: StartPrior) -> tuple[Verdicts, int]:
    """Weigh each stretch's hypotheses by the solution of the run without them and their neighbours.

    Hypotheses that took part in the estimate speak for themselves, and a wrong choice confirms itself. Every
    third stretch is judged at once, so three solutions do for the whole run.
    """
    last, start_ns = len(problem.timeline) - 1, int(problem.timeline.stamps_ns[0])
    judged, iterations = dict(settled.verdicts), 0
    at_s = {  # time of each hypothesis in the run
        (s.number, i): (m.stamp_ns - start_ns) * 1e-9
        for s in problem.streams
        if s.row.false is not None
        for i, m in enumerate(s.measurements)
    }
    everything = thinned(problem, judged)
    for third in range(3):
        own = {key for key, t in at_s.items() if int(t / _STRETCH_S) % 3 == third}
        around = {
            key for key, t in at_s.items() if (t / _STRETCH_S - third + _STRETCH_MARGIN) % 3 < 1 + 2 * _STRETCH_MARGIN
        }
        if not own or len(around) == len(at_s):  # nothing to judge, or nothing to judge it by
            continue
        rest = _refine(problem, settled.values, everything, prior, without=around)
        fresh = weigh(
            problem,
            rest.values,
            first=0,
            last=last,
            stage="final",
            covariance=pose_covariance(rest.tree),
            only=own,
        )
        judged.update({key: _decisive(v) for key, v in fresh.items()})
        iterations += rest.iterations
    return judged, iterations


def _decisive(verdict: Verdict) -> Verdict:
    """All or nothing: half a belief in each of several that repeat each other is enough to bend the estimate to them."""
    sure = verdict.weight > _SURE
    return replace(verdict, decision=Decision(mode=verdict.mode) if sure else None, weight=float(sure))


def expected_cost(problem: Problem, verdicts: Verdicts) -> float:
    """Degrees of freedom of the weighted problem: what 2 x its cost is expected to be."""
    n, m = len(problem.timeline), len(problem.timeline.slow_stamps_ns)
    expected = sum(len(v.residual.raw) * v.weight for v in verdicts.values())
    expected += 9.0 * (n - 1) + 6.0 * (m - 1) + 15.0 - 9.0 * n - 6.0 * m
    for stream in problem.streams:
        if stream.slow is not None:
            k, constant = len(stream.slow.sigma), not np.isfinite(stream.slow.time_constant_s)
            expected += k * (m - 1) * (1 if constant else 2) + k - k * m
    return expected


@dataclass(frozen=True, slots=True)
class _Step:
    """One optimisation of the whole run: what came out, and how far any pose moved."""

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    iterations: int
    moved_m: float
    tree: Any = None


def _pass(
    problem: Problem, estimate: gtsam.Values, verdicts: Verdicts, prior: StartPrior, *, jumps: bool = True
) -> _Step:
    """Optimise the whole run with the given decisions."""
    last = len(problem.timeline) - 1
    graph, guess = build_graph(problem, estimate, decisions(verdicts), 0, last, prior, jumps=jumps)
    solved = optimize(graph, guess, 12, 1e-3)
    return _Step(solved.values, graph, solved.iterations, _moved(guess, solved.values, 0, last))


def _refine(
    problem: Problem,
    estimate: gtsam.Values,
    verdicts: Verdicts,
    prior: StartPrior,
    *,
    without: Container[tuple[int, int]] = (),
) -> _Step:
    """One step of the whole run, with the tree that gives its covariances; `without` is left out."""
    last = len(problem.timeline) - 1
    graph, guess = build_graph(problem, estimate, decisions(verdicts, without), 0, last, prior)
    values, tree = full_step(graph, guess)
    return _Step(values, graph, 1, _moved(guess, values, 0, last), tree)


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
                used, candidate.cost = _solve_start(problem, candidate, until)
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
            _fill_slow(problem, values, following, bias, _slow_at(problem, values, j))


def _solve_start(problem: Problem, candidate: _Candidate, last: int) -> tuple[int, float]:
    """Solve the first window in place, gently first; return iterations and final error."""
    iterations, error = 0, 0.0
    for stage, limit, settled_m, hypotheses in _START_STAGES:
        for _ in range(limit):
            verdicts = weigh(
                problem, candidate.values, first=0, last=last, stage=stage, hypotheses=hypotheses, sparse=True
            )
            decided, jumps = decisions(verdicts), stage != "far"
            step = _solve_window(problem, candidate.values, 0, last, candidate.prior, decided, jumps=jumps, tol=1e-4)
            iterations, error = iterations + step.iterations, step.error
            if step.moved_m < settled_m:
                break
    return iterations, error


class _WindowStep(NamedTuple):
    """One optimisation of a window: what came out, iterations, final error, how far any pose moved."""

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    iterations: int
    error: float
    moved_m: float


def _solve_window(
    problem: Problem,
    values: gtsam.Values,
    first: int,
    last: int,
    prior: StartPrior,
    decided: Decisions,
    *,
    jumps: bool = True,
    tol: float = 3e-3,
) -> _WindowStep:
    """Optimise states first..last in place, roughly: what it leaves, the passes over the whole run take up."""
    graph, guess = build_graph(problem, values, decided, first, last, prior, jumps=jumps)
    solved = optimize(graph, guess, 15, tol)
    moved = _moved(guess, solved.values, first, last)
    _update(problem, values, solved.values, first, last)
    return _WindowStep(solved.values, graph, solved.iterations, solved.error, moved)


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
    verdicts = weigh(problem, estimate, first=0, last=known, stage="final", sparse=True)
    step = _solve_window(problem, estimate, 0, known, prior, decisions(verdicts))
    iterations, first = step.iterations, 0
    while known < end:
        until = int(min(np.searchsorted(stamps, stamps[known] + int(_CHUNK_S * 1e9)), end))
        start_of_window = int(np.searchsorted(stamps, stamps[known] - int(_OVERLAP_S * 1e9)))
        if start_of_window > first:
            prior = _prior_at(problem, step, start_of_window)
            first = start_of_window
        _extend(problem, estimate, known, until)
        used, step = _solve_grown(problem, estimate, first, known, until, prior)
        iterations, known = iterations + used, until
        progress("growing", known, end)
    return iterations


def _solve_grown(
    problem: Problem, values: gtsam.Values, first: int, known: int, last: int, prior: StartPrior
) -> tuple[int, _WindowStep]:
    """Solve a window whose states after `known` are new, in place; return iterations and the last step.

    New hypotheses wait until the rest has said where the vessel is, and how well it knows: with false matches
    in it, a window solved under Huber alone is off by many of its own sigmas (0.01 rad/s of gyro bias, 300 m
    after 20 s of dead reckoning).
    """
    fresh = {(s.number, i) for s in problem.streams if s.row.false is not None for i in s.between(known + 1, last)}
    iterations = 0
    for stage in ("final", *["far"] * _MAX_GROW_ROUNDS, "final"):
        verdicts = weigh(problem, values, first=first, last=last, stage=stage, sparse=True)
        step = _solve_window(problem, values, first, last, prior, decisions(verdicts, fresh), jumps=stage != "far")
        iterations += step.iterations
        if step.moved_m < _GROWN_SETTLED_M:
            break
    if not fresh:
        return iterations, step
    predicted = pose_covariance(bayes_tree(step.graph, step.values))
    covariance: PoseCovariance = lambda k: predicted(k) if k > known else None
    for _ in range(2):
        verdicts = weigh(problem, values, first=first, last=last, stage="final", covariance=covariance, sparse=True)
        step = _solve_window(problem, values, first, last, prior, decisions(verdicts))
        iterations += step.iterations
        covariance = lambda _state: None
        if step.moved_m < _WINDOW_SETTLED_M:
            break
    return iterations, step


def _prior_at(problem: Problem, step: _WindowStep, k: int) -> StartPrior:
    """The marginals at state `k` as a prior; cross terms are left out, which only loosens it."""
    tree, values = bayes_tree(step.graph, step.values), step.values
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
