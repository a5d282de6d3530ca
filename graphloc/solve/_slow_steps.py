# SPDX-License-Identifier: Apache-2.0
"""Where headings part from the gyroscope within seconds, is the compass off, or is the IMU wrong? The run is solved both ways.

Online the compass is taken to be off: the other sensors then deny an IMU that is wrong (`online/_imu_doubt.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphloc.build import Problem
from graphloc.errors import SolveError
from graphloc.recording import Recording
from graphloc.solve._passes import cost_of_run
from graphloc.solve.batch import BatchResult

_OF_A_STEP = 10.0  # log-likelihood: price of each slow step


class Solved(NamedTuple):
    """A solved run.

    Attributes:
        recording: without the samples of a wrong IMU. result: of it. said: warnings. price: of the samples left out, nats.
    """

    recording: Recording
    result: BatchResult
    said: tuple[str, ...]
    price: float

    @property
    def cost(self) -> float:
        """How improbable the run is, nats, as configured."""
        steps = sum(not step.at_once for stream in self.result.stated.streams for step in stream.heading_steps)
        return cost_of_run(self.result.stated, self.result.values, self.result.prior) + self.price + _OF_A_STEP * steps


def has_slow_steps(problem: Problem) -> bool:
    """Return whether the headings of a compass take seconds to step."""
    return any(not step.at_once for stream in problem.streams for step in stream.heading_steps)


def without_slow_steps(problem: Problem) -> Problem:
    """Return a problem in which compasses step at once, or not at all."""
    return replace(
        problem,
        streams=tuple(
            replace(stream, heading_steps=tuple(step for step in stream.heading_steps if step.at_once))
            for stream in problem.streams
        ),
    )


def likelier(solve: Callable[[bool], Solved]) -> Solved:
    """Return the run as solved with slow steps, or without, whichever is more probable; one that converged goes before one that did not.

    Args:
        solve: solves the run; whether with slow steps.

    Raises:
        SolveError: it can be solved neither way.
    """
    found, failed = list[Solved](), list[SolveError]()
    for slow_steps in (True, False):
        try:
            found.append(solve(slow_steps))
        except SolveError as error:
            failed.append(error)
    if not found:
        raise failed[0]
    return min(found, key=lambda solved: (not solved.result.converged, np.nan_to_num(solved.cost, nan=np.inf)))
