# SPDX-License-Identifier: Apache-2.0
"""A stretch of the run, solved on its own: states first..last of the estimate, changed in place."""

from __future__ import annotations

from typing import Any, NamedTuple

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import (
    Decided,
    Decisions,
    Made,
    Past,
    Problem,
    StartPrior,
    attach,
    build_graph,
    every_constant,
    nav_state,
    state_keys,
)
from graphloc.frames import Array
from graphloc.solve._optimize import optimize

_MOVED_M, _MOST_TIMES = 0.3, 4  # motion from which factors are linearised again, and how often at most


class StretchStep(NamedTuple):
    """One optimisation of a window.

    Attributes:
        values: the result. graph: the graph that it comes from. made: range of the factors of each measurement in the
            graph.
        iterations: number of those that it took. error: final one, nats. moved_m: how far any pose moved.
    """

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    made: Made
    iterations: int
    error: float
    moved_m: float


def solve_stretch(
    problem: Problem,
    values: gtsam.Values,
    first: int,
    last: int,
    prior: StartPrior | Past,
    decided: Decisions,
    *,
    jumps: bool = True,
    tol: float = 3e-3,
    beside: Any = None,
) -> StretchStep:
    """Optimise states first..last in place, roughly: the passes over the whole run do the rest.

    Args:
        decided: decisions on the measurements. prior, jumps: as of `build_graph`. tol: as of `optimize`.
        beside: a factor (gtsam.NonlinearFactor) that is no part of the run; None: there is none.
    """
    made: Made = {}
    graph, guess = build_graph(problem, values, decided, first, last, prior, jumps=jumps, made=made)
    if beside is not None:
        graph.add(beside)
    solved = optimize(graph, guess, 15, tol)
    moved_m = moved(guess, solved.values)
    update_states(problem, values, solved.values, first, last)
    return StretchStep(solved.values, graph, made, solved.iterations, solved.error, moved_m)


def solve_until_written_there(
    problem: Problem,
    values: gtsam.Values,
    first: int,
    last: int,
    prior: StartPrior | Past,
    decided: Decisions,
    *,
    tol: float = 3e-3,
) -> StretchStep:
    """Repeat `solve_stretch` while the solution moves away from where its factors were linearised.

    Factors of sensors with hypotheses are linear about the estimate. Linearised a metre away, a right sighting leaves
    the solution tenths of a metre off, and judged there it looks false.
    """
    begin, iterations = values.extract(state_keys(problem, first, last)), 0
    for _ in range(_MOST_TIMES):
        step = solve_stretch(problem, values, first, last, prior, decided, tol=tol)
        iterations += step.iterations
        if step.moved_m < _MOVED_M:
            break
        decided = _written_anew(problem, values, first, last, decided)
    return step._replace(iterations=iterations, moved_m=moved(begin, step.values))


def _written_anew(problem: Problem, values: gtsam.Values, first: int, last: int, decided: Decisions) -> Decisions:
    """Return the decisions of a stretch, those of sensors with hypotheses attached at the present estimate."""
    written = dict(decided)
    for stream in problem.streams:
        if stream.row.has_hypotheses:
            for i in stream.between(first, last):
                if (found := decided.get((stream.number, i))) is not None:
                    written[stream.number, i] = Decided(found.decision, attach(problem, stream, i, values))
    return written


def moved(old: gtsam.Values, new: gtsam.Values) -> float:
    """Return how far any pose moved, m (1 rad counts as 10 m)."""
    # Where measurements contradict each other grossly, the first steps may be huge: an overflow to infinity is
    # intended.
    with np.errstate(over="ignore"):
        apart = gtsam.utilities.extractPose3(new) - gtsam.utilities.extractPose3(old)  # (poses, 9 of R and 3)
        # Two rotations by an angle a apart differ by 2 sqrt(2) sin(a / 2), squares of all nine summed.
        angle = 2.0 * np.arcsin(np.minimum(np.linalg.norm(apart[:, :9], axis=1) / np.sqrt(8.0), 1.0))
        return float((np.linalg.norm(apart[:, 9:], axis=1) + 10.0 * angle).max())


def update_states(problem: Problem, values: gtsam.Values, new: gtsam.Values, first: int, last: int) -> None:
    """Write the states first..last of `new` into `values` (in place: a copy each would be quadratic)."""
    values.update(new.extract(state_keys(problem, first, last)))
    for key in every_constant(problem.streams):
        if new.exists(key):
            values.insert_or_assign(key, new.atVector(key))


def copy_states(problem: Problem, values: gtsam.Values, first: int, last: int) -> gtsam.Values:
    """Return the values of states first..last, of their slow states, and of constants."""
    constants = [key for key in every_constant(problem.streams) if values.exists(key)]
    return values.extract(state_keys(problem, first, last) + constants)


def unwound(problem: Problem, values: gtsam.Values) -> gtsam.Values:
    """Return the values of a run with the yaws of its sensors' mounts within half a turn; the same object if they are.

    While the heading is searched such a yaw may go round by whole turns, which nothing measures; its prior then hardly
    leads back.
    """
    found = values
    for stream in problem.streams:
        slow = stream.slow
        if slow is None or (yaw := slow.mount_yaw) is None:
            continue
        names = [keys.slow(stream.number, j) for j in range(len(problem.timeline.slow_stamps_ns))]
        turns = np.round(values.atVector(names[0])[yaw] / (2.0 * np.pi))
        if turns:
            found = gtsam.Values(found) if found is values else found
            for key in names:
                found.update(key, found.atVector(key) - 2.0 * np.pi * turns * np.eye(len(slow.axes))[yaw])
    return found


def slow_at(problem: Problem, values: gtsam.Values, j: int) -> dict[int, Array]:
    """Return the slow errors at slow node j, by number of their stream."""
    return {s.number: values.atVector(keys.slow(s.number, j)) for s in problem.streams if s.slow is not None}


def fill_slow(problem: Problem, values: gtsam.Values, j: int, bias: Any, slow: dict[int, Array]) -> None:
    """Set the bias and the slow errors at slow node j.

    Args:
        slow: slow errors by stream number; those of other streams are set to 0.
    """
    values.insert_or_assign(keys.bias(j), bias)
    for stream in problem.streams:
        if stream.slow is not None:
            values.insert_or_assign(
                keys.slow(stream.number, j), slow.get(stream.number, np.zeros(len(stream.slow.sigma)))
            )


def dead_reckon(problem: Problem, values: gtsam.Values, known: int, until: int) -> None:
    """Dead-reckon from state `known` to `until`, in place; what was there is replaced."""
    for k in range(known, until):
        j, following = (int(problem.timeline.slow_of[i]) for i in (k, k + 1))
        bias = values.atConstantBias(keys.bias(j))
        state = problem.preintegrated[k].predict(nav_state(values, k), bias)
        values.insert_or_assign(keys.pose(k + 1), state.pose())
        values.insert_or_assign(keys.velocity(k + 1), np.asarray(state.velocity()))
        if following != j:
            fill_slow(problem, values, following, bias, slow_at(problem, values, j))


def weak_prior(problem: Problem, values: gtsam.Values, k: int) -> StartPrior:
    """Return a wide prior on state `k`, which only keeps a stretch determined."""
    j = int(problem.timeline.slow_of[k])
    slow = slow_at(problem, values, j)
    return StartPrior(
        pose=values.atPose3(keys.pose(k)),
        pose_cov=np.diag([0.05**2] * 3 + [1.0] * 3),
        velocity=values.atVector(keys.velocity(k)),
        velocity_cov=np.eye(3) * 0.5**2,
        bias=values.atConstantBias(keys.bias(j)),
        bias_cov=np.diag([0.05**2] * 3 + [0.002**2] * 3),
        slow={s.number: (slow[s.number], np.diag(s.slow.sigma**2)) for s in problem.streams if s.slow is not None},
    )


def past_at(problem: Problem, step: StretchStep, k: int) -> Past:
    """Return the joint prior of a solved stretch on state `k`, the first of its slow node, by the data before it.

    Measurements from that state on are left out: the next stretch has them, and they would count twice.
    """
    names = np.array(list(step.values.keys()), dtype=np.uint64)
    letter, index = keys.parts(names)
    state, node = (np.isin(letter, list(kind)) for kind in (keys.STATES, keys.NODES))
    at = np.where(state, index - k, np.where(node, index - int(problem.timeline.slow_of[k]), -1))
    after, known = set(names[at > 0].tolist()), names[(at == 0) | (letter == "c")].tolist()
    state_of = {s.number: s.state for s in problem.streams}
    measured_after = {n for (number, i), found in step.made.items() if state_of[number][i] >= k for n in found}
    before = gtsam.NonlinearFactorGraph()
    for n in range(step.graph.size()):
        if n not in measured_after and after.isdisjoint((factor := step.graph.at(n)).keys()):
            before.add(factor)
    linear = before.linearize(step.values).marginal(known, gtsam.EliminateQR)
    return Past(factors=gtsam.LinearContainerFactor.ConvertLinearGraph(linear, step.values), known=frozenset(known))
