# SPDX-License-Identifier: Apache-2.0
"""The offline solver: align, grow, then decide over the whole run.

1. Align over a window; try each candidate heading on it and keep the cheapest (`_align`, `_start`).
2. Grow by some seconds at a time, each window solved with a prior from earlier data. Hypotheses that are
   new in a window are judged by the prediction without them, with its covariance (`_grow`). Both on a
   thinned run (`graphloc.build.thinned`). Passes over all of it remove the seams: there they cost a fifth.
3. Passes over the whole run: modes and weights re-chosen until they no longer change (`_passes`).
4. Try other choices that may be more probable (`_choices`), and repeat 3 where there are any. Where that shows position
   jumps of the only position sensor, 1 to 4 are repeated with them (`_jumps`). Where the IMU's mount is clearly off, repeat 3 with it
   turned (`_imu_mount`).
5. Where receivers jump and no other sensor measures position, choose the most probable level (`_levels`).
6. A Bayes tree of the last graph gives the covariances of every state.

Where no sensor measures position or velocity for a while, 3 to 6 have the motion model (`graphloc.motion_model`).
Sensors that scatter more than they state are taken as they scatter, and 3 and 4 repeated.
Where the IMU contradicts the other sensors, or one of heading or velocity disagrees for long, 1 to 4 are tried without such a sensor,
and then with all from there. If the IMU contradicts them still, its noise is scaled up, and 3 and 4 are repeated, beginning with
gentle losses; where that explains little, it is not the IMU, and its noise stays as configured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc.build import (
    Problem,
    StartPrior,
    Stream,
    Thinned,
    bridged,
    thinned,
    with_noise_scale,
    with_sensor_noise,
    with_usual_motion,
    without_sensor,
)
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.recording import Progress, quiet
from graphloc.solve._align import align
from graphloc.solve._choices import other_choices, take_more_probable
from graphloc.solve._decide import AGREES, Stage, Verdicts, agrees, met, weigh
from graphloc.solve._grow import grow
from graphloc.solve._imu_mount import MountError, with_mount_estimated
from graphloc.solve._imu_noise import with_needed_noise
from graphloc.solve._jumps import jumps_in, with_jumps_of, with_jumps_off_track
from graphloc.solve._levels import at_usual_level
from graphloc.solve._optimize import bayes_tree
from graphloc.solve._passes import (
    Settled,
    cost_as_configured,
    cost_without_outliers,
    expected_cost,
    rough_passes,
    settle,
)
from graphloc.solve._sensor_noise import scattering
from graphloc.solve._start import Begun, solve_start

_MAX_NOISE_ROUNDS, _MAX_SENSOR_ROUNDS, _MAX_JUMP_ROUNDS = 4, 2, 2
# Before other choices are tried, passes need not converge: what still changes then is a choice that confirms itself.
_FIRST_PASSES, _LAST_PASSES = 6, 15
# At most: over the thinned run after growing; with each gentle loss, where the IMU's noise has changed.
_SEAM_PASSES, _OPEN_PASSES = 2, 4
CONTRADICTION = 2.5  # cost over its expectation, from which the configured IMU noise is not believed
LARGEST_NOISE_SCALE = 10.0  # no IMU is so many times noisier than configured
# More noise of the IMU explains a misfit if it falls below that, or by this factor; else the noise stays as configured.
_EXPLAINED = 2.0
# Share of a sensor's measurements that disagree, from which the run is tried without it; and below which it tells the heading.
_OFTEN, _MOSTLY = 0.3, 0.7
_SHORTER_S = 10.0, 5.0  # first windows, where the usual one contradicts itself
_CLEARLY = 10.0  # log-likelihood by which a solution must be more probable


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """The solved graph, before it is turned into a `Solution`; `problem` has the noise that it was solved with, `stated` that as configured."""

    problem: Problem
    stated: Problem
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
    levels_cov: Array  # (N, 3, 3) of the positions, m^2, by other levels that may be the usual ones (see `_levels`)
    mount: MountError | None  # what is known of that of the IMU (see `_imu_mount`); None: not reckoned for this graph
    notes: tuple[str, ...]

    def lightened(self) -> BatchResult:
        """Return the same without tree and graph, which take gigabytes on a run of hours."""
        return replace(self, tree=gtsam.ISAM2(), graph=gtsam.NonlinearFactorGraph())


def noise_step(ratio: float) -> float:
    """Return the factor by which the IMU's noise is scaled up at once where the cost is `ratio` times its expectation.

    At most by 3: modes and weights are chosen anew before it is looked at again.
    """
    return float(np.clip(np.sqrt(ratio), 1.5, 3.0))


def solve_batch(
    problem: Problem,
    progress: Progress = quiet,
    *,
    newest: bool = False,
    doubt_imu: bool = False,
    near_rad: float | None = None,
) -> BatchResult:
    """Solve a whole run.

    Args:
        newest: `heading_var` is asked for at the last state alone.
        doubt_imu: whether to look for spans in which the IMU is wrong.
        near_rad: yaw at the start, if the motion alone tells it: the only one that is tried.

    Raises:
        ImuWrong: there are some.
        SolveError: it could not be started, or the linear algebra failed.
    """
    configured = problem
    begun, solved = _first_solution(problem, progress, newest=newest, doubt_imu=doubt_imu, near_rad=near_rad)
    for _ in range(_MAX_SENSOR_ROUNDS):
        if not begun.start.by_motion or solved.misfit() < CONTRADICTION:
            break
        # By the motion alone a start bends everything to fixes that state too little, and the IMU would be called noisier.
        times = scattering(solved.problem, solved.settled.verdicts, denied=True)
        if not times:
            break
        problem = replace(with_sensor_noise(solved.problem, times), usual_motion=None)
        del solved  # and its graph, before the next one is made
        begun, solved = _first_solution(problem, progress, newest=newest, doubt_imu=doubt_imu, near_rad=near_rad)
    for _ in range(0 if newest else _MAX_JUMP_ROUNDS):
        if (jumping := with_jumps_off_track(problem, solved.settled.verdicts)) is None:
            break
        without, count = (begun, solved.choice()), jumps_in(jumping) - jumps_in(problem)
        lowest = _cost(problem, solved.settled.values, begun.prior) - _CLEARLY * count
        del solved  # and its graph, before the next one is made
        try:
            begun, solved = _first_solution(jumping, progress, newest=newest, doubt_imu=doubt_imu, near_rad=near_rad)
            clearly = _cost(jumping, solved.settled.values, begun.prior) < lowest
        except SolveError:
            clearly = False
        if not clearly:
            begun, choice = without
            solved = choice.settled_again(begun.prior, progress)
            break
        problem = jumping
    stated = with_jumps_of(problem, configured)
    mount = None
    if not newest:
        solved, prior, mount = solved.with_mount_estimated(begun.prior, progress)
        begun = begun._replace(prior=prior)
    as_stated, misfit = solved.choice(), solved.misfit()
    passes, iterations = solved.settled.passes, begun.iterations + solved.settled.iterations
    for _ in range(_MAX_NOISE_ROUNDS):
        problem, settled = solved
        ratio, estimate = solved.misfit(), settled.values
        if not problem.config.sensors[problem.imu.sensor].adapt_noise:
            break
        if ratio < CONTRADICTION:
            noisier = with_needed_noise(problem, estimate, settled.verdicts, begun.prior)
        else:
            noisier = with_noise_scale(problem, problem.noise_scale * noise_step(ratio))
        if noisier is None:
            break
        if begun.start.by_motion and ratio < CONTRADICTION:
            # Which headings the motion excludes was found with the smaller noise.
            again = solve_batch(replace(noisier, usual_motion=None), progress, newest=newest)
            return replace(again, stated=with_jumps_of(again.stated, stated))
        problem = bridged(noisier, estimate)
        if ratio >= CONTRADICTION:
            estimate, used, passed = rough_passes(
                problem, estimate, begun.prior, progress, (Stage.FAR, Stage.OPEN), _OPEN_PASSES
            )
            passes, iterations = passes + passed, iterations + used
        del settled, solved  # and their graph, before the next one is made
        solved = _as_they_scatter(problem, thinned(problem), estimate, begun.prior, progress)
        passes, iterations = passes + solved.settled.passes, iterations + solved.settled.iterations
    scaled = solved.problem.noise_scale > as_stated.problem.noise_scale
    if scaled and CONTRADICTION <= solved.misfit() and misfit < _EXPLAINED * solved.misfit():
        del solved
        solved = as_stated.settled_again(begun.prior, progress)
        passes, iterations = passes + solved.settled.passes, iterations + solved.settled.iterations
    problem, last = solved
    problem, settled, prior, levels_cov, passed, used = at_usual_level(
        problem, last, begun.prior, progress, _LAST_PASSES, newest=newest
    )
    passes, iterations = passes + passed, iterations + used
    return BatchResult(
        problem=problem,
        stated=stated,
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
        heading_var=begun.heading_var,
        begun=begun.last,
        headings=begun.headings if begun.start.yaw_sigma_rad < np.pi else 0,
        levels_cov=levels_cov,
        mount=mount if settled.values is as_stated.values else None,
        notes=begun.start.notes,
    )


class _Choice(NamedTuple):
    """A solution without its graph, which takes gigabytes on a run of hours."""

    problem: Problem
    values: gtsam.Values
    verdicts: Verdicts

    def settled_again(self, prior: StartPrior, progress: Progress) -> _Solved:
        return _Solved(self.problem, settle(*self, prior, progress, _LAST_PASSES))


class _Solved(NamedTuple):
    """A run after its final passes, and the problem with the noise that it was solved with."""

    problem: Problem
    settled: Settled

    def misfit(self) -> float:
        """Return the cost over its expectation."""
        return cost_without_outliers(self.settled) / max(expected_cost(self.problem, self.settled.verdicts), 1.0)

    def with_mount_estimated(
        self, prior: StartPrior, progress: Progress
    ) -> tuple[_Solved, StartPrior, MountError | None]:
        """Return it with the mount of the IMU as the other sensors have it, the prior of the start there, and what that says of it."""
        problem, settled, prior, error = with_mount_estimated(*self, prior, progress, _LAST_PASSES)
        if settled is self.settled:
            return self, prior, error
        passes, iterations = (getattr(self.settled, key) + getattr(settled, key) for key in ("passes", "iterations"))
        return _Solved(problem, replace(settled, passes=passes, iterations=iterations)), prior, error

    def choice(self) -> _Choice:
        return _Choice(self.problem, self.settled.values, self.settled.verdicts)


def _first_solution(
    problem: Problem, progress: Progress, *, newest: bool, doubt_imu: bool, near_rad: float | None
) -> tuple[Begun, _Solved]:
    """Solve a run with the IMU's noise as it is.

    Where that contradicts the other sensors, the run is begun without each sensor of heading or velocity, too; else without those of
    them that disagree for long. If all measurements are clearly more probable in such a solution, it is taken: a compass that is wrong
    for most of a run may lead the heading away, where nothing leads back. Not for `newest`, as a start online has no time for it.
    """
    few = thinned(problem)
    begun = whole = _begin(problem, few, progress, newest=newest, doubt_imu=doubt_imu, near_rad=near_rad)
    solved = _from_there(problem, few, begun, progress)
    misfit = solved.misfit()
    doubted = [] if newest else [
        number
        for number, stream in enumerate(problem.streams)
        if stream.row.false is None
        and not stream.row.absolute
        and (misfit >= CONTRADICTION or _off_for_long(_off(stream, solved.settled.verdicts)))
    ]  # fmt: skip
    if not doubted:
        return begun, solved

    lowest, best = _cost(problem, solved.settled.values, begun.prior) - _CLEARLY, (begun, solved.choice())
    iterations, passes = begun.iterations + solved.settled.iterations, solved.settled.passes
    del solved  # and its graph, before the next one is made
    for number in doubted:
        rest = without_sensor(problem, problem.streams[number])
        try:
            begun = _begin(rest, thinned(rest), progress, newest=newest)
        except SolveError:
            continue
        solved = _from_there(problem, few, begun, progress)
        iterations += begun.iterations + solved.settled.iterations
        passes += solved.settled.passes
        if (found := _cost(problem, solved.settled.values, begun.prior)) < lowest:
            if _off(problem.streams[number], solved.settled.verdicts).mean() < _MOSTLY:
                # The sensor tells the heading after all.
                begun = whole._replace(values=begun.values, prior=begun.prior)
            lowest, best = found, (begun, solved.choice())
        del solved
    begun, choice = best
    again = choice.settled_again(begun.prior, progress)
    settled = replace(again.settled, passes=again.settled.passes + passes)
    return begun._replace(iterations=iterations), again._replace(settled=settled)


def _cost(problem: Problem, values: gtsam.Values, prior: StartPrior) -> float:
    """Return -log of how probable a run is (but for a constant), with each sensor's loss as wide as configured."""
    last = len(problem.timeline) - 1
    return cost_as_configured(problem, values, 0, last, prior, judged=last)


def _off(stream: Stream, verdicts: Verdicts) -> NDArray[np.bool_]:
    """Return which of its measurements disagree."""
    return np.array([verdicts[stream.number, i].weight < AGREES for i in range(len(stream.measurements))])


def _off_for_long(off: NDArray[np.bool_]) -> bool:
    """Whether many measurements disagree, and in a row: as many scattered outliers change twice as often."""
    share = float(off.mean())
    return bool(share > _OFTEN and np.count_nonzero(off[1:] != off[:-1]) < share * (1.0 - share) * len(off))


def _begin(
    problem: Problem,
    few: Thinned,
    progress: Progress,
    *,
    newest: bool,
    doubt_imu: bool = False,
    near_rad: float | None = None,
) -> Begun:
    """Start a run, grow it over the thinned one, and fill in the other states."""
    start = align(problem)
    begun = solve_start(few.problem, start if near_rad is None else start.near(near_rad), progress, newest=newest)
    doubt_start = doubt_imu and begun.excess >= CONTRADICTION
    if doubt_start and (other := _begun_without_a_sensor(problem, few, begun, progress)) is not None:
        begun, doubt_start = other, False
    if doubt_start:
        _doubt_at_once(few.problem, begun.last, progress)
    grown, prior, known, iterations, *_ = begun
    iterations += grow(few.problem, grown, prior, known, progress, doubt_imu=doubt_imu, doubt_start=doubt_start)
    grown, used, _ = rough_passes(few.problem, grown, prior, progress, (Stage.FINAL,), _SEAM_PASSES)
    stamps, few_stamps = problem.timeline.stamps_ns, few.problem.timeline.stamps_ns[: known + 1]
    return begun._replace(
        values=few.filled(problem, grown),
        last=int(few.states[known]),
        iterations=iterations + used,
        heading_var=np.interp(stamps, few_stamps, begun.heading_var),
    )


def _begun_without_a_sensor(problem: Problem, few: Thinned, begun: Begun, progress: Progress) -> Begun | None:
    """Return the start without one of the sensors of heading or velocity, if it contradicts itself no longer and is clearly more probable."""

    def cost(values: gtsam.Values, prior: StartPrior, last: int) -> float:
        return cost_as_configured(few.problem, values, 0, last, prior, judged=last)

    lowest, best, iterations = -_CLEARLY, None, begun.iterations
    for stream in few.problem.streams:
        if stream.row.absolute or stream.row.false is not None or not stream.measurements:
            continue
        whole = next(s for s in problem.streams if s.number == stream.number)
        rest, window_s = without_sensor(few.problem, stream), problem.config.start.window_s
        try:
            other = solve_start(rest, align(without_sensor(problem, whole)), progress, newest=True, window_s=window_s)
        except SolveError:
            continue
        iterations += other.iterations
        last = min(begun.last, other.last)
        higher = cost(other.values, other.prior, last) - cost(begun.values, begun.prior, last)
        if other.excess < CONTRADICTION and higher < lowest:
            lowest, best = higher, (stream, other)
    if best is None:
        return None
    stream, other = best
    _, residuals = met(few.problem, stream, stream.between(0, other.last), other.values)
    agree = np.mean([any(agrees(stream, residual) for residual in found) for found in residuals])
    # Where it tells the heading after all, no other one is in doubt.
    heading_var = np.zeros(other.last + 1) if agree > 1.0 - _MOSTLY else other.heading_var
    return begun._replace(
        values=other.values, prior=other.prior, last=other.last, iterations=iterations, heading_var=heading_var
    )


def _doubt_at_once(problem: Problem, last: int, progress: Progress) -> None:
    """Look for an IMU that is wrong in the first window, until state `last`: it spoils all that is aligned and solved there.

    So the run is begun with less of it, and grown from there.

    Raises:
        ImuWrong: it is.
    """
    config = problem.config
    for window_s in _SHORTER_S:
        start = config.start.model_copy(update={"window_s": window_s})
        shorter = replace(problem, config=config.model_copy(update={"start": start}))
        try:
            values, prior, known, *_ = solve_start(shorter, align(shorter), progress, newest=True, window_s=window_s)
            grow(problem, values, prior, known, progress, doubt_imu=True, last=last)
        except SolveError:
            continue


def _from_there(problem: Problem, few: Thinned, begun: Begun, progress: Progress) -> _Solved:
    """Make the final passes from a grown run."""
    if problem.links.gaps():
        problem = bridged(problem, begun.values)
    problem = with_usual_motion(problem, begun.values)
    if problem.usual_motion is not None or problem.links.gaps():
        few = thinned(problem)
    return _as_they_scatter(problem, few, begun.values, begun.prior, progress)


def _as_they_scatter(
    problem: Problem, few: Thinned, estimate: gtsam.Values, prior: StartPrior, progress: Progress
) -> _Solved:
    """Make the final passes, again with larger sigmas of the sensors that scatter more than they state (see `_sensor_noise`)."""
    passes = iterations = 0
    for more in range(_MAX_SENSOR_ROUNDS, -1, -1):
        settled = _final_passes(problem, few, estimate, prior, progress)
        passes, iterations, estimate = passes + settled.passes, iterations + settled.iterations, settled.values
        if not more or not (times := scattering(problem, settled.verdicts)):
            break
        problem = with_sensor_noise(problem, times)
        few = thinned(problem)
    return _Solved(problem, replace(settled, passes=passes, iterations=iterations))


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
