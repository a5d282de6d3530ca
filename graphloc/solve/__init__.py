# SPDX-License-Identifier: Apache-2.0
"""Solvers. They receive the table of sensors as an argument and know rows only by their interface."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from graphloc.build import Problem, make_problem, rows_of
from graphloc.config import VesselConfig
from graphloc.frames import Datum
from graphloc.graph import Sensor
from graphloc.inertial import InertialRow
from graphloc.offsets import Probe
from graphloc.recording import Progress, Recording, quiet
from graphloc.solution import Solution
from graphloc.solve._legs import KnownHeading
from graphloc.solve._memory import give_back_memory
from graphloc.solve._offsets import offsets_of
from graphloc.solve._parts import solve_parts
from graphloc.solve._slow_steps import Solved, has_slow_steps, likelier, without_slow_steps
from graphloc.solve._solution import make_solution
from graphloc.solve.batch import BatchResult, solve_batch
from graphloc.solve.wrong_imu import ImuWrong, left_out

__all__ = ["smooth"]

_T = TypeVar("_T")
_MOST_TIMES = 2  # most searches for spans in which the IMU is wrong, each without the spans found before
_STACK_BYTES = 1 << 29  # address space, not memory: pages are taken when touched


def smooth(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    *,
    rows: Sequence[Sensor],
    inertial: InertialRow,
    probe: Probe | None = None,
    progress: Progress = quiet,
) -> Solution:
    """Smooth a whole run offline.

    Args:
        recording: what was measured. config: the vessel. datum: origin of world.
        rows, inertial: the table of sensors (`graphloc.factors`).
        probe: offsets of sensors to examine (`Solution.offsets`); by default none.
        progress: called with stage, done, total; an exception raised in it cancels cleanly.

    Raises:
        SolveError: the run cannot be started or solved; the text says why.
    """
    stepped = set[str]()  # compasses, in what is solved so far: in later legs they are off their mounts

    def solve(part: Recording, heading: KnownHeading | None) -> Solution:
        begun = config.with_start_heading(None) if heading is None else config.with_start_heading(*heading)

        def made(left: Recording) -> Problem:
            return make_problem(left, begun, datum, rows, inertial)

        whole = made(part)

        def solved(slow_steps: bool = True) -> Solved:
            return _without_wrong_imu(part, whole, made, progress, slow_steps=slow_steps)

        left, result, said, _ = likelier(solved) if has_slow_steps(whole) else solved()
        solution = make_solution(result.stated, left, result, stepped)
        stepped.update(stream.name for stream in result.stated.streams if stream.heading_steps)
        solution = replace(solution, stats=replace(solution.stats, warnings=(*said, *solution.stats.warnings)))
        if probe is None:
            return solution
        result = result.lightened()  # the offsets take a graph of their own
        give_back_memory()
        return _with_offsets(solution, result, probe)

    imu = config.of_kind(inertial.kind).values()
    bridge_s = min((sensor.max_bridge_s for sensor in imu), default=np.inf)
    absolute = {name for name, row in rows_of(config, rows).items() if row.absolute}
    leg_s, start = config.timeline.leg_s, config.start
    heading = None if start.heading_deg is None else KnownHeading(start.heading_deg, start.heading_sigma_deg)
    return _on_deep_stack(lambda: solve_parts(recording, heading, bridge_s, leg_s, absolute, solve))


def _without_wrong_imu(
    part: Recording, whole: Problem, made: Callable[[Recording], Problem], progress: Progress, *, slow_steps: bool
) -> Solved:
    """Solve a part of a run, again and again without the spans in which its IMU turns out to be wrong.

    Args:
        whole: the problem of all of the part. made: makes that of what is left of it.
        slow_steps: whether compasses may have parted from the gyroscope within seconds.
    """
    left, problem, said, price = part, whole, list[str](), 0.0
    for tried in range(_MOST_TIMES + 1):
        taken = problem if slow_steps else without_slow_steps(problem)
        try:
            result = solve_batch(taken, progress, doubt_imu=tried < _MOST_TIMES)
            break
        except ImuWrong as wrong:
            price += wrong.price(problem)
            left, why = left_out(left, wrong.spans)
            problem = made(left)
            said.append(why)
    return Solved(left, result, tuple(said), price)


def _with_offsets(solution: Solution, result: BatchResult, probe: Probe) -> Solution:
    """Return the solution with what the run says of its sensors' offsets; where that fails, with a warning instead."""
    try:
        return replace(solution, offsets=offsets_of(result, probe))
    except (RuntimeError, np.linalg.LinAlgError, MemoryError) as error:
        said = f"the calibration could not be examined: {' '.join(str(error).split())[:100]}"
        return replace(solution, stats=replace(solution.stats, warnings=(*solution.stats.warnings, said)))


def _on_deep_stack(work: Callable[[], _T]) -> _T:
    """Return what `work` returns, called in a thread with a deep stack.

    GTSAM recurses along the run, and two hours overflow the usual 8 MiB.
    """
    done: list[_T] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            done.append(work())
        except BaseException as error:  # noqa: BLE001 - handed to the caller, whatever it is
            failed.append(error)

    usual = threading.stack_size(_STACK_BYTES)
    thread = threading.Thread(target=run, name="graphloc solver", daemon=True)
    try:
        thread.start()
    finally:
        threading.stack_size(usual)
    thread.join()
    if failed:
        raise failed[0]
    return done[0]
