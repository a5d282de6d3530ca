# SPDX-License-Identifier: Apache-2.0
"""Other choices of modes and weights than those that the estimate confirms.

A choice confirms itself, because the estimate follows it. Three others are tried here: the most probable chain of
measurements that agree with each other; each stretch judged by a solution without its own measurements; and the
verdicts without the measurements that are believed at either end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from graphloc.build import Decisions, Problem, StartPrior, Thinned, build_graph
from graphloc.graph import Decision
from graphloc.judge.decide import (
    Stage,
    Verdict,
    Verdicts,
    along_best_chains,
    decisions,
    decisions_on,
    log_evidence,
    predicted_by,
    weigh,
)
from graphloc.solve._marginals import Marginals, marginals
from graphloc.solve._passes import SETTLED_M, SETTLED_WEIGHT, Settled, changed
from graphloc.solve.stretch import copy_states, solve_until_written_there, update_states, weak_prior
from graphloc.time import duration_ns

# Length of a stretch whose hypotheses are judged by the rest of the run, and the share of a stretch on either side that
# is left out as well: longer than false answers tend to stay, short enough to dead-reckon through.
_STRETCH_S, _STRETCH_MARGIN = 8.0, 0.5
_SURE = 0.7  # probability from which a hypothesis that is judged by the rest alone is believed
# Surroundings, on either side, in which another choice of hypotheses is tried.
_AROUND_S = 20.0
# Most passes there; they end earlier if choices and places settle. A choice: as many as for a level (`_levels`).
_AROUND_PASSES = 6


def other_choices(
    problem: Problem, few: Thinned, settled: Settled, prior: StartPrior
) -> Iterator[tuple[Verdicts, int]]:
    """Yield each of the three other choices, and the iterations that it took.

    Each is made from `settled` as it is by then: the caller may have taken the choices before.
    """
    yield along_best_chains(problem, settled.values, settled.verdicts), 0
    yield _judged_by_the_rest(few, settled, prior)
    yield _without_its_ends(problem, settled), 0


def _judged_by_the_rest(few: Thinned, settled: Settled, prior: StartPrior) -> tuple[Verdicts, int]:
    """Return verdicts on each stretch's hypotheses by the thinned run without them and their neighbours.

    The iterations are returned, too. A hypothesis that took part in the estimate supports itself, so a wrong choice
    would be confirmed. Every third stretch is judged at once, so three solutions are enough for the whole run.
    """
    problem, values = few.problem, few.of(settled.values)
    start_ns, streams = int(problem.timeline.stamps_ns[0]), {s.number: s for s in problem.streams}
    at_s = {  # time of each hypothesis in the run
        (s.number, i): (m.stamp_ns - start_ns) * 1e-9
        for s in problem.streams
        if s.row.has_hypotheses
        for i, m in enumerate(s.measurements)
    }
    judged, everything, iterations = dict(settled.verdicts), decisions_on(few, settled.verdicts, values), 0
    for third in range(3):
        own = {key for key, t in at_s.items() if int(t / _STRETCH_S) % 3 == third}
        around = {
            key for key, t in at_s.items() if (t / _STRETCH_S - third + _STRETCH_MARGIN) % 3 < 1 + 2 * _STRETCH_MARGIN
        }
        if not own or len(around) == len(at_s):  # nothing to judge, or no measurements to judge it by
            continue
        rest = without(problem, values, everything, prior, around)
        fresh = weigh(
            problem,
            rest.values,
            first=0,
            last=len(problem.timeline) - 1,
            stage=Stage.FINAL,
            covariance=predicted_by(rest.cov),
            only=own,
        )
        for (number, i), verdict in fresh.items():
            key, stream = (number, int(few.chosen[number][i])), streams[number]
            at = judged[key].at  # the attachment in the whole run
            residual = stream.row.residuals(stream.measurements[i], stream.config, at)[verdict.mode]
            judged[key] = _decisive(replace(verdict, at=at, residual=residual))
        iterations += 1
    return judged, iterations


def _without_its_ends(problem: Problem, settled: Settled) -> Verdicts:
    """Return verdicts that reject what is believed at an end of a sensor's data, where others near it are rejected.

    At an end, evidence against a few false measurements that agree comes from one side only.
    """
    others = dict(settled.verdicts)
    for stream in problem.streams:
        if not stream.row.has_hypotheses or not stream.measurements:
            continue
        stamps = [m.stamp_ns for m in stream.measurements]
        for end_ns in (stamps[0], stamps[-1]):
            away_s = {(stream.number, i): abs(stamp - end_ns) * 1e-9 for i, stamp in enumerate(stamps)}
            if all(settled.verdicts[key].weight > 0.5 for key, s in away_s.items() if s <= _AROUND_S):
                continue
            for key, s in away_s.items():
                if s <= _STRETCH_S:
                    others[key] = replace(others[key], decision=None, weight=0.0)
    return others


def without(
    problem: Problem, estimate: gtsam.Values, decided: Decisions, prior: StartPrior, left_out: set[tuple[int, int]]
) -> Marginals:
    """Return what a run without some measurements says, by one full step from an estimate.

    Args:
        decided: decisions on all measurements. left_out: (stream number, measurement index) of those to leave out.
    """
    kept = {key: found for key, found in decided.items() if key not in left_out}
    return marginals(*build_graph(problem, estimate, kept, 0, len(problem.timeline) - 1, prior))


def _decisive(verdict: Verdict) -> Verdict:
    """Return the verdict with its weight rounded to 0 or 1.

    Half a weight for each of several measurements that repeat each other would pull the estimate to them.
    """
    sure = verdict.weight > _SURE
    return replace(verdict, decision=Decision(mode=verdict.mode) if sure else None, weight=float(sure))


def take_more_probable(problem: Problem, settled: Settled, others: Verdicts, prior: StartPrior) -> bool:
    """Take the choices of `others` into `settled`, in place, wherever they are more probable; return whether any were.

    Choices that differ are taken together while they are near in time, and each such group is tried on its own
    surroundings, so that one bad guess does not cost the good ones, and a long run costs no more.
    """
    taken = False
    for group in _groups(problem, settled.verdicts, others):
        states = [_state_of(problem, key) for key in group]
        low, high = min(states), max(states)
        first, last = _index_around(problem, low, -_AROUND_S), _index_around(problem, high, _AROUND_S)
        start = prior if first == 0 else weak_prior(problem, settled.values, first)
        there = _solve_around(problem, settled.values, others, first, last, start, unlike=settled.verdicts)
        if there is None:
            continue
        here = _solve_around(problem, settled.values, settled.verdicts, first, last, start)
        assert here is not None
        if there.cost < here.cost:
            update_states(problem, settled.values, there.values, first, last)
            settled.verdicts.update(there.verdicts)
            taken = True
    return taken


def _groups(problem: Problem, some: Verdicts, others: Verdicts) -> list[list[tuple[int, int]]]:
    """Return the measurements that one set of verdicts believes and the other not, in groups that are near in time."""
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
    return int(np.clip(np.searchsorted(stamps, stamps[k] + duration_ns(seconds)), 0, len(stamps) - 1))


class _Around(NamedTuple):
    """A stretch solved on its own: values, verdicts, and -log of its probability, marginalised over all hypotheses."""

    values: gtsam.Values
    verdicts: Verdicts
    cost: float


def _solve_around(
    problem: Problem,
    values: gtsam.Values,
    verdicts: Verdicts,
    first: int,
    last: int,
    prior: StartPrior,
    unlike: Verdicts | None = None,
) -> _Around | None:
    """Return a stretch solved until its choices no longer change; None where they become those of `unlike`."""
    local = copy_states(problem, values, max(first - 1, 0), min(last + 1, len(problem.timeline) - 1))
    for _ in range(_AROUND_PASSES):
        step = solve_until_written_there(problem, local, first, last, prior, decisions(verdicts), tol=1e-3)
        used, verdicts = verdicts, weigh(problem, local, first=first, last=last, stage=Stage.FINAL)
        if unlike is not None and all(_alike(v, unlike[key]) for key, v in verdicts.items()):
            return None
        if step.moved_m < SETTLED_M and changed(used, verdicts) < SETTLED_WEIGHT:
            break
    numbers = {s.number for s in problem.streams if s.row.has_hypotheses}
    plain = decisions(verdicts, {key for key in verdicts if key[0] in numbers})
    graph, guess = build_graph(problem, local, plain, first, last, prior)
    return _Around(local, verdicts, float(graph.error(guess)) - log_evidence(problem, local, first, last))


def _alike(one: Verdict, other: Verdict) -> bool:
    """Return whether two verdicts both believe the measurement, in the same mode, or both do not believe it."""
    return abs(one.weight - other.weight) < 0.5 and (one.mode == other.mode or one.weight < 0.5)
