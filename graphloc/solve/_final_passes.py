# SPDX-License-Identifier: Apache-2.0
"""The final passes over a whole run, repeated with more noise of the sensors that scatter more than they state."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import gtsam

from graphloc.build import Problem, StartPrior, Thinned, thinned, with_sensor_noise
from graphloc.judge.decide import Stage, Verdicts, weigh
from graphloc.judge.sensor_noise import scattering
from graphloc.recording import Progress
from graphloc.solve._choices import other_choices, take_more_probable
from graphloc.solve._passes import SETTLED_NATS, Settled, cost_without_outliers, expected_cost, settle

MAX_SENSOR_ROUNDS = 2  # most times that the noise of sensors is raised
# Most passes before and after other choices are tried. Before, they need not converge: what still changes then is a
# choice that confirms itself.
_FIRST_PASSES, LAST_PASSES = 6, 15


class RunChoice(NamedTuple):
    """A solution without its graph, which takes gigabytes on a run of hours."""

    problem: Problem
    values: gtsam.Values
    verdicts: Verdicts

    def settled_again(self, prior: StartPrior, progress: Progress) -> SolvedRun:
        """Return the solution with a graph again, settled from here."""
        return SolvedRun(self.problem, settle(*self, prior, progress, LAST_PASSES, SETTLED_NATS))


class SolvedRun(NamedTuple):
    """A run after its final passes, and the problem with the noise that it was solved with."""

    problem: Problem
    settled: Settled

    def misfit(self) -> float:
        """Return the cost over its expectation."""
        return cost_without_outliers(self.settled) / max(expected_cost(self.problem, self.settled.verdicts), 1.0)

    def choice(self) -> RunChoice:
        """Return the solution without its graph."""
        return RunChoice(self.problem, self.settled.values, self.settled.verdicts)


def as_they_scatter(
    problem: Problem, few: Thinned, estimate: gtsam.Values, prior: StartPrior, progress: Progress
) -> SolvedRun:
    """Make the final passes, and repeat them with larger sigmas of the sensors that scatter more than they state.

    See `sensor_noise`.

    Args:
        few: the thinned run. estimate: of the whole run, to start from.
    """
    settled, passes, iterations = _final_passes(problem, few, estimate, prior, progress), 0, 0
    for _ in range(MAX_SENSOR_ROUNDS):
        times = scattering(problem, settled.verdicts)
        if not times:
            break
        passes, iterations = passes + settled.passes, iterations + settled.iterations
        problem, estimate = with_sensor_noise(problem, times), settled.values
        del settled  # and its graph, before the next one is made
        settled = _final_passes(problem, thinned(problem), estimate, prior, progress)
    passes, iterations = passes + settled.passes, iterations + settled.iterations
    return SolvedRun(problem, replace(settled, passes=passes, iterations=iterations))


def _final_passes(
    problem: Problem, few: Thinned, estimate: gtsam.Values, prior: StartPrior, progress: Progress
) -> Settled:
    """Re-choose modes and weights over the whole run until they no longer change, and try other choices.

    A choice confirms itself, because the estimate follows it; another one that is more probable replaces it
    (`_choices`).
    """
    last = len(problem.timeline) - 1
    verdicts = weigh(problem, estimate, first=0, last=last, stage=Stage.FINAL)
    settled = settle(problem, estimate, verdicts, prior, progress, _FIRST_PASSES)
    changed, iterations = False, settled.iterations
    for others, used in other_choices(problem, few, settled, prior):
        changed = take_more_probable(problem, settled, others, prior) or changed
        iterations += used
    if settled.converged and not changed:
        return replace(settled, iterations=iterations)
    values, verdicts, passes = settled.values, settled.verdicts, settled.passes
    del settled  # and its graph, before the next one is made
    again = settle(problem, values, verdicts, prior, progress, LAST_PASSES, SETTLED_NATS)
    return replace(again, iterations=iterations + again.iterations, passes=passes + again.passes)
