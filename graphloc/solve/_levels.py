# SPDX-License-Identifier: Apache-2.0
"""Which level of a jumping receiver is the usual one (zero error), where no other sensor measures position.

A run grows from its first level, and no single step of the solver leads to another one. So the levels that the jumps
lead to are compared as candidates: by the size of the errors that would result, and by how long these last, because a
jump ends within a minute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build import Problem, StartPrior, Stream, build_graph, jumping, standing_cost
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import SlowProcess
from graphloc.judge.decide import Stage, Verdicts, decisions, weigh
from graphloc.recording import Progress
from graphloc.signals.position_jumps import MEAN_S
from graphloc.solve._passes import Settled, cost_of_run, settle
from graphloc.time import NS_PER_S, stamps_of

_JUMP = 1.0  # least step from one node to the next that counts as a jump, sigmas: ten times the drift
_FAR = 2.0  # sigmas: an error that is nearer is at its usual level
# Most outages, levels after each, and passes for each: every level is another solution of the whole run.
_MOST_OUTAGES, _MOST_LEVELS, _TRIAL_PASSES = 4, 3, 6
# Shortest outage: after less, dead reckoning is a metre off at most (E.dark), and bends nothing; a choice.
OUTAGE_S = 10.0
COMES_BACK_OFF = 6.0  # nats: price of a receiver that comes back off after an outage


class AtLevel(NamedTuple):
    """A solution with the most probable level as the usual one, and what it was solved with.

    Attributes:
        others_cov: (N, 3, 3) covariance that the other levels add to the position of each state, m^2, in world.
        passes, iterations: number of those that it took.
    """

    problem: Problem
    settled: Settled
    prior: StartPrior
    others_cov: Array
    passes: int
    iterations: int


class _Case(NamedTuple):
    """A solution; its streams are the receivers whose error may stay far off."""

    problem: Problem
    settled: Settled

    @property
    def streams(self) -> list[Stream]:
        return [s for s in self.problem.streams if s.slow is not None and s.slow.far]

    def paths(self) -> list[Array]:
        """Return, by stream, the slow error (N, 3) at the nodes, m."""
        nodes = range(len(self.problem.timeline.slow_stamps_ns))
        return [np.array([self.settled.values.atVector(keys.slow(s.number, j)) for j in nodes]) for s in self.streams]

    def levels(self, span: _Span | None = None) -> list[Array]:
        """Return the levels (3,), m, of the errors, in a span if one is given: each once, without the usual one."""
        stamps_ns, nodes, of = self.problem.timeline.slow_stamps_ns, slice(None), None
        if span is not None:
            first = 0 if span.from_ns is None else int(np.searchsorted(stamps_ns, span.from_ns))
            last = None if span.until_ns is None else int(np.searchsorted(stamps_ns, span.until_ns))
            nodes, of = slice(first, last), span.of
        pairs = zip(self.streams, self.paths(), strict=True)
        return [level for s, path in pairs if of in (None, s.number) for level in _levels(s.slow, path[nodes])]

    def cost(self, one: Callable[[SlowProcess, Array, Array, NDArray[np.bool_]], float], level: Array) -> float:
        """Return the cost (nats) of the errors if a level were the usual one.

        Args:
            one: cost of one error, a function of process, path (N, 3), times between nodes, and `anew`. level: (3,), m.
        """
        dt_s = np.diff(self.problem.timeline.slow_stamps_ns) / NS_PER_S
        pairs = zip(self.streams, self.paths(), strict=True)
        steps = range(len(dt_s))
        return sum(one(s.slow, path - level, dt_s, np.isin(steps, s.anew)) for s, path in pairs if s.slow is not None)

    def places(self) -> Array:
        """Return the position (N, 3) of the states, m."""
        states = range(len(self.problem.timeline))
        return np.array([self.settled.values.atPose3(keys.pose(k)).translation() for k in states])


def at_usual_level(
    problem: Problem, settled: Settled, prior: StartPrior, progress: Progress, most: int, *, newest: bool
) -> AtLevel:
    """Return the solution with the most probable level as the usual one, settled in at most `most` passes.

    The error is held at that level: with tails on either side, a level that is left after a quarter of the run weighs
    as much as the other one.

    Args:
        newest: whether only the last state is asked for, and soon.
    """
    case, others, passes, iterations = _Case(problem, settled), np.zeros((len(problem.timeline), 3, 3)), 0, 0
    if not case.levels() or _told_otherwise(problem, settled.verdicts):
        return AtLevel(problem, settled, prior, others, 0, 0)
    for span in () if newest else [*_outages(case), *_drawn_anew(case)]:
        case, beside, tried = _after_outage(case, span, prior, progress)
        others += beside
        passes, iterations = passes + tried[0], iterations + tried[1]
    levels = [np.zeros(3), *case.levels()]
    costs = np.array([case.cost(_cost, level) for level in levels])
    usual = levels[int(np.argmin(costs))]
    problem, settled = case
    moved, prior_there = _moved(case, -usual), _prior_moved(prior, -usual)
    last, decided = len(problem.timeline) - 1, decisions(settled.verdicts)
    here, there = (
        float(build_graph(problem, values, decided, 0, last, about)[0].error(values))
        for values, about in ((settled.values, prior), (moved, prior_there))
    )
    rise = there - here - (case.cost(standing_cost, usual) - case.cost(standing_cost, levels[0]))
    as_it_is = AtLevel(problem, settled, prior, others, passes, iterations)
    if rise > costs[0] - costs.min():
        return as_it_is  # another sensor determines the position
    share = np.exp(costs.min() - costs)
    beside = np.array(levels) - usual
    others = others + np.einsum("n,ni,nj->ij", share / share.sum(), beside, beside)
    problem = replace(problem, streams=tuple(_with_usual(s, case, usual) for s in problem.streams))
    verdicts = weigh(problem, moved, first=0, last=last, stage=Stage.FINAL)
    try:
        held = settle(problem, moved, verdicts, prior_there, progress, most)
    except SolveError:
        return as_it_is
    return AtLevel(problem, held, prior_there, others, passes + held.passes, iterations + held.iterations)


class _Span(NamedTuple):
    """An outage, and where the levels of slow errors beside it are looked for (stamps, ns).

    Attributes:
        gap_ns: of the last fix before the outage, and of the first after it.
        from_ns, until_ns: where levels are looked for; None: from the begin of the run, or to its end. For an outage of
            all receivers these are the parts before and after it, for one of a single receiver the part after it.
        of: number of the stream whose error is drawn anew in the outage; None: an outage of all receivers, whose errors
            go on.
        back_ns: the next gap in which that stream's error is drawn anew, so that the level ends; None: there is none
            before the end of the run, or the errors go on.
        anew: slow nodes after which that stream's error is drawn anew: in `gap_ns` and, if there is one, in `back_ns`.
    """

    gap_ns: tuple[int, int]
    from_ns: int | None
    until_ns: int | None
    of: int | None = None
    back_ns: tuple[int, int] | None = None
    anew: tuple[int, ...] = ()


def _outages(case: _Case) -> list[_Span]:
    """Return the longest outages in which none of the receivers tells the position."""
    stamps_ns = np.sort([m.stamp_ns for s in case.streams for m in s.measurements])
    gaps_ns = np.diff(stamps_ns)
    longest = np.sort(np.argsort(gaps_ns)[-_MOST_OUTAGES:])
    found = [(int(stamps_ns[n]), int(stamps_ns[n + 1])) for n in longest if gaps_ns[n] > OUTAGE_S * NS_PER_S]
    begins, ends = [begin for begin, _ in found], [end for _, end in found]
    return [_Span(*one) for one in zip(found, [None, *ends[:-1]], [*begins[1:], None], strict=True)] if found else []


def _drawn_anew(case: _Case) -> list[_Span]:
    """Return the longest outages in which an error is drawn anew, of those that are followed by a part with a jump."""
    found: list[_Span] = []
    for stream in case.streams:
        stamps_ns = stamps_of(stream.measurements)
        back = np.searchsorted(case.problem.timeline.slow_of[stream.state], stream.anew, side="right")
        gaps: list[tuple[int, int] | None] = [(int(stamps_ns[n - 1]), int(stamps_ns[n])) for n in back]
        for k, (gap_ns, next_ns) in enumerate(pairwise([*gaps, None])):
            assert gap_ns is not None
            anew = tuple(stream.anew[k : k + 2].tolist())
            found.append(_Span(gap_ns, gap_ns[1], next_ns and next_ns[0], of=stream.number, back_ns=next_ns, anew=anew))
    found = [span for span in found if case.levels(span)]
    longest = sorted(found, key=lambda span: span.gap_ns[1] - span.gap_ns[0])[-_MOST_OUTAGES:]
    return sorted(longest, key=lambda span: span.gap_ns)


def _after_outage(
    case: _Case, span: _Span, prior: StartPrior, progress: Progress
) -> tuple[_Case, Array, tuple[int, int]]:
    """Return the most probable solution with what follows an outage at another level, or as it is.

    In the outage dead reckoning bends, so a receiver may have come back with an error, or without the one that it had.

    Returns:
        The solution, the covariance (N, 3, 3) that the other ones add, and the passes and iterations of all of them.
    """
    best, costs, places, passes, iterations = case, [_total(case, prior)], [case.places()], 0, 0
    for level in case.levels(span)[:_MOST_LEVELS]:
        back, problem = (np.array([span.gap_ns[1]]), np.array([np.linalg.norm(level)])), case.problem
        if span.of is None:
            streams = (jumping(s, *back) if s in case.streams else s for s in case.problem.streams)
            problem = replace(case.problem, streams=tuple(streams))
        moved = _moved(case, -level, span)
        verdicts = weigh(problem, moved, first=0, last=len(problem.timeline) - 1, stage=Stage.FINAL)
        try:
            other = _Case(problem, settle(problem, moved, verdicts, prior, progress, _TRIAL_PASSES))
        except SolveError:
            continue
        passes, iterations = passes + other.settled.passes, iterations + other.settled.iterations
        cost = (0.0 if span.of is not None else COMES_BACK_OFF) + _total(other, prior)
        if cost < min(costs):
            best = other
        costs.append(cost)
        places.append(other.places())
    share = np.exp(min(costs) - np.array(costs))
    beside = np.array(places) - places[int(np.argmin(costs))]
    return best, np.einsum("c,cni,cnj->nij", share / share.sum(), beside, beside), (passes, iterations)


def _total(case: _Case, prior: StartPrior) -> float:
    """Return the cost (nats) of all measurements, and of the time that a receiver is far off."""
    return cost_of_run(case.problem, case.settled.values, prior) + case.cost(_away_cost, np.zeros(3))


def _told_otherwise(problem: Problem, verdicts: Verdicts) -> bool:
    """Return whether a sensor whose error cannot stay far off measures position, too."""
    others = {s.number for s in problem.streams if s.row.absolute and (s.slow is None or not s.slow.far)}
    return any(number in others and v.weight > 0.5 for (number, _), v in verdicts.items())


def _levels(slow: SlowProcess | None, path: Array) -> list[Array]:
    """Return the levels (3,), m, of an error (N, 3) between its jumps.

    Each is there once, the one held longest first, without the usual level.
    """
    assert slow is not None
    held = path * slow.far_axes
    jumps = 1 + np.flatnonzero(np.linalg.norm(np.diff(held / slow.sigma, axis=0), axis=1) > _JUMP)
    found: list[Array] = []
    for part in sorted(np.split(held, jumps), key=len, reverse=True) if len(jumps) else []:
        level = np.median(part, axis=0)
        if all(np.linalg.norm((level - other) / slow.sigma) > _FAR for other in (np.zeros(3), *found)):
            found.append(level)
    return found


def _cost(slow: SlowProcess, path: Array, dt_s: Array, anew: NDArray[np.bool_]) -> float:
    """Return the cost (nats) of an error (N, 3): of its size, and of the time that it is far off."""
    return standing_cost(slow, path, dt_s, anew) + _away_cost(slow, path, dt_s, anew)


def _away_cost(slow: SlowProcess, path: Array, dt_s: Array, _anew: NDArray[np.bool_]) -> float:
    return float(dt_s @ _away(slow, path)[1:]) / MEAN_S


def _away(slow: SlowProcess, path: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the nodes at which an error (N, 3) is far off."""
    far = slow.far_axes
    return np.asarray(np.linalg.norm(path[:, far] / slow.sigma[far], axis=1) > _FAR)


def _with_usual(stream: Stream, case: _Case, usual: Array) -> Stream:
    """Return a stream with a mask of the nodes at which its error is at the usual level.

    It is unchanged if its error cannot stay far off, or never is at that level.
    """
    for one, path in zip(case.streams, case.paths(), strict=True):
        if one is stream and one.slow is not None and not (away := _away(one.slow, path - usual)).all():
            return replace(stream, usual=~away)
    return stream


def _prior_moved(prior: StartPrior, by_m: Array) -> StartPrior:
    """Return a prior shifted by (3,), m, in world, because its position is that of the first fixes."""
    return replace(prior, pose=gtsam.Pose3(prior.pose.rotation(), prior.pose.translation() + by_m))


def _moved(case: _Case, by_m: Array, span: _Span | None = None) -> gtsam.Values:
    """Return the values of a run shifted by (3,), m, in world, and the slow errors of its receivers to match.

    Args:
        span: the outage after which the run is shifted; None: all of it is.
    """
    moved, timeline = gtsam.Values(case.settled.values), case.problem.timeline

    def shifts(stamps_ns: NDArray[np.int64]) -> Array:
        if span is None:
            return np.tile(by_m, (len(stamps_ns), 1))
        back_ns = span.back_ns or ()
        return np.outer(np.interp(stamps_ns, [*span.gap_ns, *back_ns], [0.0, 1.0, 1.0, 0.0][: 2 + len(back_ns)]), by_m)

    for k, shift in enumerate(shifts(timeline.stamps_ns)):
        pose = moved.atPose3(keys.pose(k))
        moved.update(keys.pose(k), gtsam.Pose3(pose.rotation(), pose.translation() + shift))
    for stream in case.streams:
        own = shifts(timeline.slow_stamps_ns)
        if span is not None and stream.number == span.of:
            # It steps where it is drawn anew: bent as the track is, it would step by some sigmas at each node across
            # the outage, which looks like as many jumps.
            own = np.outer(np.searchsorted(span.anew, np.arange(len(own))) == 1, by_m)
        for j, shift in enumerate(own):
            key = keys.slow(stream.number, j)
            moved.update(key, moved.atVector(key) + shift)
    return moved
