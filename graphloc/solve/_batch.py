# SPDX-License-Identifier: Apache-2.0
"""The offline solver: align, grow, then decide over the whole run.

1. Align over a window; try each candidate heading on it and keep the cheapest (`_align`, `_start`).
2. Grow by some seconds at a time, each window solved with a prior from earlier data. Hypotheses that are
   new in a window are judged by the prediction without them, with its covariance (`_grow`). Both on a
   thinned run (`graphloc.build.thinned`). Passes over all of it remove the seams: there they cost a fifth.
3. Passes over the whole run: modes and weights re-chosen until they no longer change (`_passes`).
4. Try other choices that may be more probable (`_choices`), and repeat 3 where there are any.
5. Where receivers jump and no other sensor measures position, choose the most probable level (`_levels`).
6. A Bayes tree of the last graph gives the covariances of every state.

Where no sensor measures position or velocity for a while, 3 to 6 have the motion model (`graphloc.motion_model`).
Sensors that scatter more than they state are taken as they scatter, and 3 and 4 repeated.
Where the IMU contradicts the other sensors, its noise is scaled up, and 3 and 4 are repeated, beginning with gentle losses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from graphloc.build import (
    Problem,
    StartPrior,
    Thinned,
    bridged,
    thinned,
    with_noise_scale,
    with_sensor_noise,
    with_usual_motion,
)
from graphloc.frames import Array
from graphloc.recording import Progress, quiet
from graphloc.solve._align import align
from graphloc.solve._choices import other_choices, take_more_probable
from graphloc.solve._decide import Stage, Verdicts, weigh
from graphloc.solve._grow import grow
from graphloc.solve._imu_noise import with_needed_noise
from graphloc.solve._levels import at_usual_level
from graphloc.solve._optimize import bayes_tree
from graphloc.solve._passes import Settled, cost_without_outliers, expected_cost, rough_passes, settle
from graphloc.solve._sensor_noise import scattering
from graphloc.solve._start import solve_start

_MAX_NOISE_ROUNDS, _MAX_SENSOR_ROUNDS = 5, 2
# Before other choices are tried, passes need not converge: what still changes then is a choice that confirms itself.
_FIRST_PASSES, _LAST_PASSES = 6, 15
# At most: over the thinned run after growing; with each gentle loss, where the IMU's noise has changed.
_SEAM_PASSES, _OPEN_PASSES = 2, 4
CONTRADICTION = 2.5  # cost over its expectation, from which the configured IMU noise is not believed
LARGEST_NOISE_SCALE = 10.0  # no IMU is so many times noisier than configured


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """The solved graph, before it is turned into a `Solution`; `problem` has the IMU noise that it was solved with."""

    problem: Problem
    values: gtsam.Values
    verdicts: Verdicts
    tree: Any
    graph: gtsam.NonlinearFactorGraph
    passes: int
    iterations: int
    cost: float  # 2 x that of the graph, without outliers
    converged: bool
    noise_scale: float
    prior: StartPrior
    headings: int  # number of candidates that explain the start about equally well; 0: nothing tells the heading there
    heading_var: Array  # (N,) rad^2 of each state, by headings that the motion does not exclude (see `_start`)
    begun: int  # last state of the first window: what comes later is not in `heading_var`
    levels_cov: Array  # (3, 3) of the position, m^2, by other levels that may be the usual ones (see `_levels`)
    notes: tuple[str, ...]

    def lightened(self) -> BatchResult:
        """Return the same without tree and graph, which take gigabytes on a run of hours."""
        return replace(self, tree=gtsam.ISAM2(), graph=gtsam.NonlinearFactorGraph())


def noise_step(ratio: float) -> float:
    """Return the factor by which the IMU's noise is scaled up at once where the cost is `ratio` times its expectation.

    At most by 3: modes and weights are chosen anew before it is looked at again.
    """
    return float(np.clip(np.sqrt(ratio), 1.5, 3.0))


def solve_batch(problem: Problem, progress: Progress = quiet, *, newest: bool = False) -> BatchResult:
    """Solve a whole run.

    Args:
        newest: `heading_var` is asked for at the last state alone.

    Raises:
        SolveError: it could not be started, or the linear algebra failed.
    """
    start, few = align(problem), thinned(problem)
    grown, prior, known, iterations, headings, few_var = solve_start(few.problem, start, progress, newest=newest)
    heading_var = np.interp(problem.timeline.stamps_ns, few.problem.timeline.stamps_ns[: known + 1], few_var)
    begun = int(few.states[known])
    iterations += grow(few.problem, grown, prior, known, progress)
    grown, used, _ = rough_passes(few.problem, grown, prior, progress, (Stage.FINAL,), _SEAM_PASSES)
    iterations += used
    passes, estimate = 0, few.filled(problem, grown)
    if problem.links.gaps():
        problem = bridged(problem, estimate)
    problem = with_usual_motion(problem, estimate)
    if problem.usual_motion is not None or problem.links.gaps():
        few = thinned(problem)
    for attempt in range(_MAX_NOISE_ROUNDS):
        problem, few, settled = _as_they_scatter(problem, few, estimate, prior, progress)
        passes, iterations, estimate = passes + settled.passes, iterations + settled.iterations, settled.values
        ratio = cost_without_outliers(settled) / max(expected_cost(problem, settled.verdicts), 1.0)
        if attempt == _MAX_NOISE_ROUNDS - 1 or not problem.config.sensors[problem.imu.sensor].adapt_noise:
            break
        if ratio < CONTRADICTION:
            noisier = with_needed_noise(problem, estimate, settled.verdicts, prior)
        else:
            noisier = with_noise_scale(problem, problem.noise_scale * noise_step(ratio))
        if noisier is None:
            break
        if start.by_motion and ratio < CONTRADICTION:
            # Which headings the motion excludes was found with the smaller noise.
            return solve_batch(replace(noisier, usual_motion=None), progress, newest=newest)
        problem = bridged(noisier, estimate)
        few = thinned(problem)
        if ratio >= CONTRADICTION:
            estimate, used, passed = rough_passes(
                problem, estimate, prior, progress, (Stage.FAR, Stage.OPEN), _OPEN_PASSES
            )
            passes, iterations = passes + passed, iterations + used
    settled, levels_cov = at_usual_level(problem, settled, prior, progress, _LAST_PASSES)
    if settled.values is not estimate:
        passes, iterations = passes + settled.passes, iterations + settled.iterations
    return BatchResult(
        problem=problem,
        values=settled.values,
        verdicts=settled.verdicts,
        tree=bayes_tree(settled.graph, settled.values),
        graph=settled.graph,
        passes=passes,
        iterations=iterations,
        cost=cost_without_outliers(settled),
        converged=settled.converged,
        noise_scale=problem.noise_scale,
        prior=prior,
        heading_var=heading_var,
        begun=begun,
        headings=headings if start.yaw_sigma_rad < np.pi else 0,
        levels_cov=levels_cov,
        notes=start.notes,
    )


def _as_they_scatter(
    problem: Problem, few: Thinned, estimate: gtsam.Values, prior: StartPrior, progress: Progress
) -> tuple[Problem, Thinned, Settled]:
    """Make the final passes, again with larger sigmas of the sensors that scatter more than they state (see `_sensor_noise`).

    Returns:
        The problem with these, its thinned run, and the solution.
    """
    passes = iterations = 0
    for more in range(_MAX_SENSOR_ROUNDS, -1, -1):
        settled = _final_passes(problem, few, estimate, prior, progress)
        passes, iterations, estimate = passes + settled.passes, iterations + settled.iterations, settled.values
        if not more or not (times := scattering(problem, settled.verdicts)):
            break
        problem = with_sensor_noise(problem, times)
        few = thinned(problem)
    return problem, few, replace(settled, passes=passes, iterations=iterations)


def _final_passes(
    problem: Problem, few: Thinned, estimate: gtsam.Values, prior: StartPrior, progress: Progress
) -> Settled:
    """Re-choose modes and weights over the whole run until they no longer change, and try other choices (see `_choices`).

    A choice confirms itself, because the estimate follows it; another one that is more probable replaces it.
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
    again = settle(problem, values, verdicts, prior, progress, _LAST_PASSES)
    return replace(again, iterations=iterations + again.iterations, passes=passes + again.passes)
