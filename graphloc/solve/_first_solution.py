# SPDX-License-Identifier: Apache-2.0
"""The first solution of a run: begun, grown and settled with the IMU's noise as it is, without a misleading sensor."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc.build import Problem, StartPrior, Stream, Thinned, bridged, thinned, with_usual_motion, without_sensor
from graphloc.errors import SolveError
from graphloc.judge.decide import AGREES, Stage, Verdicts, agrees, met
from graphloc.judge.imu_noise import CONTRADICTION
from graphloc.recording import Progress
from graphloc.solve._final_passes import SolvedRun, as_they_scatter
from graphloc.solve._grow import grow
from graphloc.solve._passes import cost_as_configured, cost_of_run, rough_passes
from graphloc.solve._start import Begun, solve_start
from graphloc.solve.alignment import align

# Most passes over the thinned run after growing.
_SEAM_PASSES = 2
# Share of a sensor's measurements that disagree: from the first on, the run is tried without it; below the second, it
# tells the heading.
_OFTEN, _MOSTLY = 0.3, 0.7
_SHORTER_S = 10.0, 5.0  # lengths of first windows, where the usual one contradicts itself
CLEARLY = 10.0
"""Log-likelihood by which a solution must be more probable than another one to take its place."""


def first_solution(
    problem: Problem, progress: Progress, *, newest: bool, doubt_imu: bool, near_rad: float | None
) -> tuple[Begun, SolvedRun]:
    """Solve a run with the IMU's noise as it is; arguments and errors as of `solve_batch`.

    If the IMU contradicts the other sensors by the solution's cost, the run is begun also without each sensor of
    heading or velocity in turn; else without those of them that disagree for long. Each such start is settled with all
    sensors. If all measurements are clearly more probable in such a solution, it is taken: a compass that is wrong for
    most of a run may lead the heading away, where nothing leads back. This is not done for `newest`, as a start online
    has no time for it.
    """
    few = thinned(problem)
    begun = whole = _begin(problem, few, progress, newest=newest, doubt_imu=doubt_imu, near_rad=near_rad)
    solved = _from_there(problem, few, begun, progress)
    doubted = [] if newest else _doubted(problem, solved)
    if not doubted:
        return begun, solved

    lowest, best = cost_of_run(problem, solved.settled.values, begun.prior) - CLEARLY, (begun, solved.choice())
    iterations, passes = begun.iterations + solved.settled.iterations, solved.settled.passes
    del solved  # and its graph, before the next one is made
    for stream in doubted:
        rest = without_sensor(problem, stream)
        try:
            begun = _begin(rest, thinned(rest), progress, newest=newest)
        except SolveError:
            continue
        solved = _from_there(problem, few, begun, progress)
        iterations += begun.iterations + solved.settled.iterations
        passes += solved.settled.passes
        if (found := cost_of_run(problem, solved.settled.values, begun.prior)) < lowest:
            if _off(stream, solved.settled.verdicts).mean() < _MOSTLY:
                # The sensor tells the heading after all.
                begun = whole._replace(values=begun.values, prior=begun.prior)
            lowest, best = found, (begun, solved.choice())
        del solved
    begun, choice = best
    again = choice.settled_again(begun.prior, progress)
    settled = replace(again.settled, passes=again.settled.passes + passes)
    return begun._replace(iterations=iterations), again._replace(settled=settled)


def _doubted(problem: Problem, solved: SolvedRun) -> list[Stream]:
    """Return the sensors of heading or velocity that may have led a solution astray."""
    contradicted, verdicts = solved.misfit() >= CONTRADICTION, solved.settled.verdicts
    return [
        stream
        for stream in problem.streams
        if not stream.row.has_hypotheses
        and not stream.row.absolute
        and (contradicted or _off_for_long(_off(stream, verdicts)))
    ]


def _off(stream: Stream, verdicts: Verdicts) -> NDArray[np.bool_]:
    """Return a mask of the measurements of a sensor that disagree."""
    return np.array([verdicts[stream.number, i].weight < AGREES for i in range(len(stream.measurements))])


def _off_for_long(off: NDArray[np.bool_]) -> bool:
    """Return whether many measurements disagree, and in a row.

    If as many outliers were scattered, agreement would change twice as often as the limit.
    """
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
    """Start a run, grow it on the thinned one, and fill in the other states.

    Args:
        few: the thinned run. Others as of `solve_batch`.
    """
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
    """Return the best start without a sensor of heading or velocity; None if none is good enough.

    It must no longer contradict itself, and be clearly more probable.
    """

    def cost(values: gtsam.Values, prior: StartPrior, last: int) -> float:
        return cost_as_configured(few.problem, values, 0, last, prior, judged=last)

    lowest, best, iterations = -CLEARLY, None, begun.iterations
    for stream in few.problem.streams:
        if stream.row.absolute or stream.row.has_hypotheses or not stream.measurements:
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
    # If the sensor tells the heading after all, no other heading is possible.
    heading_var = np.zeros(other.last + 1) if agree > 1.0 - _MOSTLY else other.heading_var
    return begun._replace(
        values=other.values, prior=other.prior, last=other.last, iterations=iterations, heading_var=heading_var
    )


def _doubt_at_once(problem: Problem, last: int, progress: Progress) -> None:
    """Look for an IMU that is wrong in the first window, until state `last`.

    It spoils all that is aligned and solved there, so the run is begun with less of that window, and grown from there.

    Raises:
        ImuWrong: the IMU is wrong there.
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


def _from_there(problem: Problem, few: Thinned, begun: Begun, progress: Progress) -> SolvedRun:
    """Make the final passes from a grown run, with IMU gaps bridged and the motion model by its estimate."""
    if problem.links.gaps():
        problem = bridged(problem, begun.values)
    problem = with_usual_motion(problem, begun.values)
    if problem.usual_motion is not None or problem.links.gaps():
        few = thinned(problem)
    return as_they_scatter(problem, few, begun.values, begun.prior, progress)
