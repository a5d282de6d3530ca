# SPDX-License-Identifier: Apache-2.0
"""The start of a run: candidates for the heading are tried on its first window, which grows until one is left.

Where no sensor measures the heading, the accelerations tell it: turned by the right heading, they give the motion that
the positions show. Linearised about the heading that explains their noise best, and with a prior there, a run is too
sure of it: on a robot that drove straight for 120 s with a noisy IMU it stated 20 deg, 1 sigma, and was 95 deg off, at
a cost that differed by 1.3 from that of the true heading. So the window grows until headings beside the best one cost
clearly more. Where none ever do, the heading is as uncertain as the costs of all headings say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Problem, StartPrior
from graphloc.errors import SolveError
from graphloc.frames import Array, wrap_angle
from graphloc.judge.decide import Stage, cost_of_noise, decisions, weigh
from graphloc.recording import Progress, quiet
from graphloc.solve._grow import grow
from graphloc.solve._passes import expected_cost
from graphloc.solve.alignment import Start, start_pose
from graphloc.solve.stretch import copy_states, dead_reckon, fill_slow, solve_stretch
from graphloc.time import duration_ns

# Starts that cost this much more (log-likelihood) are dropped. While several remain, the window grows up to a length:
# that where sensors tell the heading, or that where only the motion does.
_COST_APART, _LONGEST_S, _LONGEST_UNTOLD_S = 8.0, 60.0, 600.0
_STEP_NS = 15_000_000_000  # longest time that a candidate is dead-reckoned before it is solved again
# From its start up to here, a candidate is solved as a whole at each step. Later steps take what is before them as
# known, and all of it is solved at the end.
_WHOLE_NS = 60_000_000_000
# Time with positions at the end of the first window; longest window that this may make.
_PLACE_S, _LATE_PLACE_S = 5.0, 90.0
# Stages of the first window: name, most rounds, motion (m) below which it ends, whether hypotheses are weighed.
_STAGES = ((Stage.FAR, 8, 0.5, False), (Stage.OPEN, 2, 0.5, False), (Stage.FINAL, 2, 0.5, True))
# Other headings than the best one, which stand for all: angles from it, and how much of the circle each stands for. The
# best one stands for 30 deg.
_OTHERS_RAD = np.radians([-30.0, 30.0, -60.0, 60.0, -120.0, 120.0, 180.0])
_WIDTHS_RAD = np.radians([30.0, 30.0, 45.0, 45.0, 60.0, 60.0, 60.0])
_HELD_RAD = np.radians(3.0)  # 1 sigma that holds a heading
_FREE = 1e4  # 1 sigma, m or rad, of what is not held


class Begun(NamedTuple):
    """The start of a run.

    Attributes:
        values, prior: estimate, and prior on the first state. last: the last state solved.
        iterations: number of those that it took. headings: number of candidates that explain it about equally well.
        heading_var: (last + 1,), rad^2, of each state, from how much other headings cost (at both ends, linear in
            between); 0 where the motion excludes the headings beside the solved one, or a sensor tells it.
        start: what it was aligned to. excess: its cost over what is expected, at least 1.
    """

    values: gtsam.Values
    prior: StartPrior
    last: int
    iterations: int
    headings: int
    heading_var: Array
    start: Start
    excess: float


def solve_start(
    problem: Problem, start: Start, progress: Progress, *, newest: bool = False, window_s: float | None = None
) -> Begun:
    """Try each candidate on the first window; look further while several explain it; keep the cheapest.

    Args:
        newest: whether `heading_var` is asked for at the last state alone; all states then have that.
        window_s: look no further than this, even where several candidates explain it; by default as far as is needed.
    """
    seconds, iterations, until = max(window_s or start.window_s, _placed_s(problem)), 0, 0
    longest_s = window_s or (_LONGEST_UNTOLD_S if start.by_motion else _LONGEST_S)
    candidates = [_candidate(problem, start, yaw) for yaw in start.yaws_rad]
    while True:
        known, until = until, _index_after(problem, seconds)
        alive, used = _extended(problem, candidates, known, until, progress)
        candidates, iterations = _different(alive), iterations + used
        told_apart, last_window = len(candidates) == 1, seconds >= longest_s or until == len(problem.timeline) - 1
        if start.by_motion:
            for candidate in candidates if start.tried else ():
                # A prior about a heading that was only tried is no information: candidates may go where the motion
                # leads.
                candidate.prior = _start_prior(problem, start, _first_yaw(candidate.values))
        best, beside = candidates[0], list[float]()
        asked = start.by_motion and told_apart
        if asked:
            beside = _costs_beside(problem, start, best, until, until)
            told_apart = beside[-1] > _excluded(best)
        if told_apart or last_window:
            heading_var = np.zeros(until + 1)
            if start.by_motion:
                last_var = _var_at(problem, start, best, until, until, beside)
                beside = _costs_beside(problem, start, best, until, 0) if asked and not newest else []
                first_var = last_var if newest else _var_at(problem, start, best, until, 0, beside)
                stamps = problem.timeline.stamps_ns[: until + 1]
                heading_var = np.interp(stamps, stamps[[0, -1]], (first_var, last_var))
            return Begun(best.values, best.prior, until, iterations, len(candidates), heading_var, start, best.excess)
        seconds *= 1.6


def _extended(
    problem: Problem, candidates: Sequence[_Candidate], known: int, until: int, progress: Progress
) -> tuple[list[_Candidate], int]:
    """Extend candidates to state `until`; return those that can be extended, the cheapest first, and the iterations.

    Raises:
        SolveError: there is none.
    """
    alive, iterations, failure = list[_Candidate](), 0, SolveError("the start alignment found no heading to try")
    for n, candidate in enumerate(candidates):
        progress("start", n, len(candidates))
        try:
            iterations += _extend(problem, candidate, known, until)
        except SolveError as caught:
            failure = caught
            continue
        alive.append(candidate)
    if not alive:
        raise failure
    return sorted(alive, key=lambda c: c.cost), iterations


def _placed_s(problem: Problem) -> float:
    """Return how long (s) the first window must be to contain a position measurement; 0 where none comes soon.

    Without one the next window would be dead reckoning with poorly known biases. After 15 s that may be 300 m off, and
    tags cannot be judged by such a prediction.
    """
    stamps = problem.timeline.stamps_ns
    first_ns = [s.measurements[0].stamp_ns for s in problem.streams if s.row.absolute and s.measurements]
    soon_s = float(min(first_ns) - stamps[0]) * 1e-9 + _PLACE_S if first_ns else 0.0
    return soon_s if soon_s <= _LATE_PLACE_S else 0.0


@dataclass(slots=True)
class _Candidate:
    """One candidate for the start.

    Attributes:
        values: its estimate. prior: on the first state. cost: so far, nats. excess: cost over what is expected, at
            least 1.
    """

    values: gtsam.Values
    prior: StartPrior
    cost: float = 0.0
    excess: float = 1.0


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
    """Return the candidates, the cheapest first, that are worth keeping.

    Dropped are those that cost clearly more than the cheapest, or have converged to the heading of a cheaper one.
    """
    kept: list[_Candidate] = []
    for candidate in ranked:
        yaw = _first_yaw(candidate.values)
        apart = all(abs(wrap_angle(yaw - _first_yaw(other.values))) > np.radians(15.0) for other in kept)
        if apart and candidate.cost < ranked[0].cost + _COST_APART + 0.2 * ranked[0].cost:
            kept.append(candidate)
    return kept


def _first_yaw(values: gtsam.Values) -> float:
    return float(values.atPose3(keys.pose(0)).rotation().yaw())


def _excluded(best: _Candidate) -> float:
    """Return the cost above which a heading is excluded."""
    return best.cost + _COST_APART * best.excess


def _costs_beside(problem: Problem, start: Start, best: _Candidate, last: int, at: int) -> list[float]:
    """Return the costs of headings of state `at` beside the best one, up to the first that is not excluded."""
    costs: list[float] = []
    for by_rad in _OTHERS_RAD[:2].tolist():
        costs.append(_held(problem, start, best, last, at, by_rad).cost)
        if costs[-1] <= _excluded(best):
            break
    return costs


def _var_at(problem: Problem, start: Start, best: _Candidate, last: int, at: int, known: Sequence[float]) -> float:
    """Return the variance, rad^2, of the heading of state `at`, from what other headings cost; 0 if those beside it are excluded.

    Args:
        known: of `_costs_beside`; empty where farther headings may cost less than those beside it.
    """
    if known and known[-1] > _excluded(best):
        return 0.0
    others = [_held(problem, start, best, last, at, by_rad).cost for by_rad in _OTHERS_RAD[len(known) :].tolist()]
    cost = np.array([*known, *others])
    weight = _WIDTHS_RAD * np.exp(-np.maximum(cost - best.cost, 0.0) / best.excess)
    return float(weight @ _OTHERS_RAD**2 / (_WIDTHS_RAD[0] + weight.sum()))


def _held(problem: Problem, start: Start, best: _Candidate, last: int, at: int, by_rad: float) -> _Candidate:
    """Return the run solved with the heading of state `at` held at that of `best`, turned by an angle."""
    turn, values = gtsam.Rot3.Yaw(by_rad), copy_states(problem, best.values, 0, last)
    for k in range(last + 1):
        pose = values.atPose3(keys.pose(k))
        values.update(keys.pose(k), gtsam.Pose3(turn.compose(pose.rotation()), pose.translation()))
    middle = values.atPose3(keys.pose(at))
    R = middle.rotation().matrix()
    cov = np.eye(6) * _FREE**2
    cov[:3, :3] = R.T @ np.diag([_FREE, _FREE, _HELD_RAD]) ** 2 @ R
    held = gtsam.PriorFactorPose3(keys.pose(at), middle, gtsam.noiseModel.Gaussian.Covariance(cov))
    free = _start_prior(problem, replace(start, yaw_sigma_rad=_FREE), _first_yaw(values))
    candidate = _Candidate(values, free if start.tried else best.prior)
    try:
        _solve_candidate(problem, candidate, last, held)
    except SolveError:
        candidate.cost = np.inf
    return candidate


def _extend(problem: Problem, candidate: _Candidate, known: int, until: int) -> int:
    """Take a candidate from state `known` to `until`, in place, a step at a time; return the iterations.

    Dead-reckoned at once over a minute, with biases not known yet, it would be kilometres off, where nothing leads
    back. If all steps were solved from its start, a vessel that lies still for ten minutes would take minutes for each
    candidate.
    """
    stamps, iterations = problem.timeline.stamps_ns, 0
    whole = problem.timeline.floor(int(stamps[0]) + _WHOLE_NS)
    while known < until:
        if known >= whole:
            iterations += grow(problem, candidate.values, candidate.prior, known, quiet, last=until)
            return iterations + _solve_candidate(problem, candidate, until)
        start, known = known, min(max(problem.timeline.floor(int(stamps[known]) + _STEP_NS), known + 1), until)
        dead_reckon(problem, candidate.values, start, known)
        iterations += _solve_candidate(problem, candidate, known)
    return iterations


def _solve_candidate(
    problem: Problem, candidate: _Candidate, last: int, held: gtsam.NonlinearFactor | None = None
) -> int:
    """Solve the first window in place; return the iterations.

    Args:
        held: a factor that holds the window near an estimate; None: it is solved with gentle losses first.
    """
    iterations = 0
    for stage, limit, settled_m, hypotheses in _STAGES[0 if held is None else 1 :]:
        for _ in range(limit):
            verdicts = weigh(problem, candidate.values, first=0, last=last, stage=stage, hypotheses=hypotheses)
            decided, jumps = decisions(verdicts), stage is not Stage.FAR
            step = solve_stretch(
                problem, candidate.values, 0, last, candidate.prior, decided, jumps=jumps, tol=1e-4, beside=held
            )
            iterations += step.iterations
            if step.moved_m < settled_m:
                break
    candidate.cost = step.error + cost_of_noise(verdicts)
    candidate.excess = max(1.0, 2.0 * step.error / max(expected_cost(problem, verdicts, last), 1.0))
    return iterations


def _index_after(problem: Problem, seconds: float) -> int:
    stamps = problem.timeline.stamps_ns
    return int(min(np.searchsorted(stamps, stamps[0] + duration_ns(seconds)), len(stamps) - 1))
