# SPDX-License-Identifier: Apache-2.0
"""Position jumps of the only position sensor that show in a solution: the track bends, and parts from the fixes on either side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphloc.build import Problem, jumping
from graphloc.position_jumps import allowed_jump_m, jumps_off_track
from graphloc.solve._decide import Verdicts
from graphloc.time import stamps_of


def with_jumps_off_track(problem: Problem, verdicts: Verdicts) -> Problem | None:
    """Return the problem with position jumps that a solution of it shows; None where it shows no more than it has.

    Args:
        verdicts: of the solution, on each measurement.
    """
    absolute = [s for s in problem.streams if s.row.absolute]
    if len(absolute) != 1 or absolute[0].row.false is not None:
        return None
    (stream,) = absolute
    if stream.left_out is None and not len(stream.position_jumps[0]):
        return None  # its error is estimated all the time, or is not to be
    raw = np.array([verdicts[stream.number, i].residual.raw[:2] for i in range(len(stream.measurements))])
    seen = jumps_off_track(
        stamps_of(stream.measurements), -raw.reshape(-1, 2), allowed_m=allowed_jump_m(stream.left_out or stream.slow)
    )
    if not len(seen[0]):
        return None
    told = jumping(stream, *seen)
    return replace(problem, streams=tuple(told if s is stream else s for s in problem.streams))
