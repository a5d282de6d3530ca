# SPDX-License-Identifier: Apache-2.0
"""Solvers. They receive the table of sensors as an argument and know rows only by their interface."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from graphloc.build import make_problem
from graphloc.config import VesselConfig
from graphloc.frames import Datum
from graphloc.graph import InertialRow, Sensor
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.solve._batch import solve_batch
from graphloc.solve._solution import make_solution

__all__ = ["smooth"]


def smooth(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    *,
    rows: Sequence[Sensor],
    inertial: InertialRow,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Solution:
    """Smooth a whole run offline.

    Args:
        recording: what was measured. config: the vessel. datum: origin of world.
        rows, inertial: the table of sensors (`graphloc.factors`).
        progress: called with stage, done, total; an exception raised in it cancels cleanly.

    Raises:
        SolveError: the run cannot be started or solved; the text says why.
    """
    problem = make_problem(recording, config, datum, rows, inertial)
    return make_solution(problem, recording, solve_batch(problem, progress))
