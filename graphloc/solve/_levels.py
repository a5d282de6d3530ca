# SPDX-License-Identifier: Apache-2.0
"""Which level of a jumping receiver is the usual one (zero error), where no other sensor measures position.

A run grows from its first level, and no single step of the solver leads to another one. So the levels that the jumps lead to
are compared as candidates: by the size of the errors that would result, and for how long they last, as a jump ends within a
minute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build import Problem, StartPrior, Stream, build_graph, standing_cost
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import SlowProcess
from graphloc.position_jumps import MEAN_S
from graphloc.recording import Progress
from graphloc.solve._decide import Stage, Verdicts, decisions, weigh
from graphloc.solve._passes import Settled, settle
from graphloc.time import NS_PER_S

_JUMP = 1.0  # sigmas from one node to the next: ten times the drift
_FAR = 2.0  # sigmas: nearer, the error is at its usual level
_OUTAGE_S, _MOST_OUTAGES, _MOST_LEVELS = 10.0, 4, 3  # each level after each outage is another solution of the whole run
_COMES_BACK_OFF = 2.0  # nats: of a receiver that does after an outage


class AtLevel(NamedTuple):
    """A solution with the most probable level as the usual one, and what it was solved with.

    Attributes:
        others_cov: covariance (N, 3, 3) of the position of each state that the other levels add, m^2, in world.
    """

    problem: Problem
    settled: Settled
    prior: StartPrior
    others_cov: Array


class _Case(NamedTuple):
    """A solution, the receivers whose error may be far off in it, and the passes and iterations of those it was compared with."""

    problem: Problem
    settled: Settled
    passes: int = 0
    iterations: int = 0

    @property
    def streams(self) -> list[Stream]:
        return [s for s in self.problem.streams if s.slow is not None and s.slow.far]

    def paths(self) -> list[Array]:
        """Return of each stream the slow error (N, 3) at the nodes, m."""
        nodes = range(len(self.problem.timeline.slow_stamps_ns))
        return [np.array([self.settled.values.atVector(keys.slow(s.number, j)) for j in nodes]) for s in self.streams]

    def levels(self, from_ns: int | None = None, until_ns: int | None = None) -> list[Array]:
        """Return the levels (3,), m, of the errors, of a span: each once, without the usual one."""
        stamps_ns = self.problem.timeline.slow_stamps_ns
        first, last = np.searchsorted(stamps_ns, [from_ns or stamps_ns[0], until_ns or stamps_ns[-1] + 1])
        pairs = zip(self.streams, self.paths(), strict=True)
        return [level for s, path in pairs for level in _levels(s.slow, path[first:last])]

    def cost(self, one: Callable[[SlowProcess, Array, Array], float], level: Array) -> float:
        """Return the cost (nats) of the errors if this level were the usual one, by a function of process, path and time between nodes."""
        dt_s = np.diff(self.problem.timeline.slow_stamps_ns) / NS_PER_S
        pairs = zip(self.streams, self.paths(), strict=True)
        return sum(one(s.slow, path - level, dt_s) for s, path in pairs if s.slow is not None)

    def places(self) -> Array:
        """Return the position (N, 3) of the states, m."""
        states = range(len(self.problem.timeline))
        return np.array([self.settled.values.atPose3(keys.pose(k)).translation() for k in states])


def at_usual_level(problem: Problem, settled: Settled, prior: StartPrior, progress: Progress, most: int) -> AtLevel:
    """Return the solution with the most probable level as the usual one, settled in at most `most` passes.

    It is held there: with tails on either side, a level that is left after a quarter of the run weighs as much as the other.
    """
    case, others = _Case(problem, settled), np.zeros((len(problem.timeline), 3, 3))
    if not case.levels() or _told_otherwise(problem, settled.verdicts):
        return AtLevel(problem, settled, prior, others)
    outages = _outages(case)
    for n, gap_ns in enumerate(outages):
        next_ns = outages[n + 1][0] if n + 1 < len(outages) else None
        case, beside = _after_outage(case, gap_ns, next_ns, prior, progress, most)
        others += beside
    levels = [np.zeros(3), *case.levels()]
    costs = np.array([case.cost(_cost, level) for level in levels])
    usual = levels[int(np.argmin(costs))]
    problem, settled, *_ = case
    moved, prior_there = _moved(case, -usual), _prior_moved(prior, -usual)
    last, decided = len(problem.timeline) - 1, decisions(settled.verdicts)
    here, there = (
        float(build_graph(problem, values, decided, 0, last, about)[0].error(values))
        for values, about in ((settled.values, prior), (moved, prior_there))
    )
    rise = there - here - (case.cost(standing_cost, usual) - case.cost(standing_cost, levels[0]))
    if rise > costs[0] - costs.min():
        return AtLevel(problem, settled, prior, others)  # another sensor determines the position
    share = np.exp(costs.min() - costs)
    beside = np.array(levels) - usual
    others += np.einsum("n,ni,nj->ij", share / share.sum(), beside, beside)
    problem = replace(problem, streams=tuple(_held(s, case, usual) for s in problem.streams))
    verdicts = weigh(problem, moved, first=0, last=last, stage=Stage.FINAL)
    held = settle(problem, moved, verdicts, prior_there, progress, most)
    held = replace(held, passes=held.passes + case.passes, iterations=held.iterations + case.iterations)
    return AtLevel(problem, held, prior_there, others)


def _outages(case: _Case) -> list[tuple[int, int]]:
    """Return where (from the last fix to the next one, ns) none of the receivers tells the position for long; the longest ones."""
    stamps_ns = np.sort([m.stamp_ns for s in case.streams for m in s.measurements])
    gaps_ns = np.diff(stamps_ns)
    longest = np.sort(np.argsort(gaps_ns)[-_MOST_OUTAGES:])
    return [(int(stamps_ns[n]), int(stamps_ns[n + 1])) for n in longest if gaps_ns[n] > _OUTAGE_S * NS_PER_S]


def _after_outage(
    case: _Case, gap_ns: tuple[int, int], next_ns: int | None, prior: StartPrior, progress: Progress, most: int
) -> tuple[_Case, Array]:
    """Return the most probable solution with what follows an outage at another level, and the covariance (N, 3, 3) that the others add.

    There dead reckoning bends, so the receiver may have come back with an error, which is over when it jumps.

    Args:
        next_ns: when the next outage begins.
    """
    best, costs, places, passes, iterations = case, [_total(case)], [case.places()], case.passes, case.iterations
    for level in case.levels(gap_ns[1], next_ns)[:_MOST_LEVELS]:
        size_m = float(np.linalg.norm(level))
        streams = (_jumping(s, gap_ns[1], size_m) if s in case.streams else s for s in case.problem.streams)
        problem = replace(case.problem, streams=tuple(streams))
        moved = _moved(case, -level, gap_ns)
        verdicts = weigh(problem, moved, first=0, last=len(problem.timeline) - 1, stage=Stage.FINAL)
        try:
            other = _Case(problem, settle(problem, moved, verdicts, prior, progress, most))
        except SolveError:
            continue
        passes, iterations = passes + other.settled.passes, iterations + other.settled.iterations
        cost = _COMES_BACK_OFF + _total(other)
        if cost < min(costs):
            best = other
        costs.append(cost)
        places.append(other.places())
    share = np.exp(min(costs) - np.array(costs))
    beside = np.array(places) - places[int(np.argmin(costs))]
    best = best._replace(passes=passes, iterations=iterations)
    return best, np.einsum("c,cni,cnj->nij", share / share.sum(), beside, beside)


def _total(case: _Case) -> float:
    """Return the cost (nats) of all measurements, and of the time that a receiver is far off."""
    return float(case.settled.graph.error(case.settled.values)) + case.cost(_away_cost, np.zeros(3))


def _jumping(stream: Stream, at_ns: int, size_m: float) -> Stream:
    """Return it with one more position jump."""
    stamps_ns, sizes_m = stream.position_jumps
    n = int(np.searchsorted(stamps_ns, at_ns))
    return replace(stream, position_jumps=(np.insert(stamps_ns, n, at_ns), np.insert(sizes_m, n, size_m)))


def _told_otherwise(problem: Problem, verdicts: Verdicts) -> bool:
    """Whether a sensor without such an error measures position, too."""
    others = {s.number for s in problem.streams if s.row.absolute and (s.slow is None or not s.slow.far)}
    return any(number in others and v.weight > 0.5 for (number, _), v in verdicts.items())


def _levels(slow: SlowProcess | None, path: Array) -> list[Array]:
    """Return the levels (3,), m, of an error (N, 3) between its jumps: each once, without the usual one."""
    assert slow is not None
    held = path * slow.far_axes
    jumps = 1 + np.flatnonzero(np.linalg.norm(np.diff(held / slow.sigma, axis=0), axis=1) > _JUMP)
    found: list[Array] = []
    for part in np.split(held, jumps) if len(jumps) else []:
        level = np.median(part, axis=0)
        if all(np.linalg.norm((level - other) / slow.sigma) > _FAR for other in (np.zeros(3), *found)):
            found.append(level)
    return found


def _cost(slow: SlowProcess, path: Array, dt_s: Array) -> float:
    """Return the cost (nats) of an error (N, 3): of its size, and of the time that it is far off."""
    return standing_cost(slow, path, dt_s) + _away_cost(slow, path, dt_s)


def _away_cost(slow: SlowProcess, path: Array, dt_s: Array) -> float:
    return float(dt_s @ _away(slow, path)[1:]) / MEAN_S


def _away(slow: SlowProcess, path: Array) -> NDArray[np.bool_]:
    """Return where (N,) an error (N, 3) is far off."""
    far = slow.far_axes
    return np.asarray(np.linalg.norm(path[:, far] / slow.sigma[far], axis=1) > _FAR)


def _held(stream: Stream, case: _Case, usual: Array) -> Stream:
    """Return it with the nodes at which its error is at the usual level, if it has one that may be far off and there is any."""
    for one, path in zip(case.streams, case.paths(), strict=True):
        if one is stream and one.slow is not None and not (away := _away(one.slow, path - usual)).all():
            return replace(stream, usual=~away)
    return stream


def _prior_moved(prior: StartPrior, by_m: Array) -> StartPrior:
    """Return it shifted by (3,), m, in world: its position is that of the first fixes."""
    return replace(prior, pose=gtsam.Pose3(prior.pose.rotation(), prior.pose.translation() + by_m))


def _moved(case: _Case, by_m: Array, gap_ns: tuple[int, int] | None = None) -> gtsam.Values:
    """Return the run shifted by (3,), m, in world, and the slow errors of the receivers to match; what follows a gap, if it is given."""
    moved, timeline = gtsam.Values(case.settled.values), case.problem.timeline

    def shifts(stamps_ns: NDArray[np.int64]) -> Array:
        share = np.ones(len(stamps_ns)) if gap_ns is None else np.interp(stamps_ns, gap_ns, (0.0, 1.0))
        return np.outer(share, by_m)

    for k, shift in enumerate(shifts(timeline.stamps_ns)):
        pose = moved.atPose3(keys.pose(k))
        moved.update(keys.pose(k), gtsam.Pose3(pose.rotation(), pose.translation() + shift))
    for stream in case.streams:
        for j, shift in enumerate(shifts(timeline.slow_stamps_ns)):
            key = keys.slow(stream.number, j)
            moved.update(key, moved.atVector(key) + shift)
    return moved
