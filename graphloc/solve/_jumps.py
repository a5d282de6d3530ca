# SPDX-License-Identifier: Apache-2.0
"""Position jumps of the only position sensor that show in a solution: the track bends, and leaves the fixes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphloc.build import Problem, allowed_jump_m, jumping
from graphloc.judge.decide import Verdicts
from graphloc.signals.position_jumps import jumps_off_track
from graphloc.time import stamps_of


def jumps_in(problem: Problem) -> int:
    """Return the number of position jumps in a problem."""
    return sum(len(stream.position_jumps[0]) for stream in problem.streams)


def with_jumps_off_track(problem: Problem, verdicts: Verdicts) -> Problem | None:
    """Return the problem with the position jumps that a solution of it shows; None if it shows no new one.

    Args:
        verdicts: of the solution, on each measurement.
    """
    absolute = [s for s in problem.streams if s.row.absolute]
    if len(absolute) != 1 or absolute[0].row.has_hypotheses:
        return None
    (stream,) = absolute
    known_ns, _ = stream.position_jumps
    if stream.left_out is None and (stream.slow is None or not len(known_ns)):
        return None  # its slow error is switched off, or is estimated anyway
    raw = np.array([verdicts[stream.number, i].residual.raw[:2] for i in range(len(stream.measurements))])
    at_ns, size_m = jumps_off_track(
        stamps_of(stream.measurements), -raw.reshape(-1, 2), allowed_m=allowed_jump_m(stream.left_out or stream.slow)
    )
    new = ~np.isin(at_ns, known_ns)  # where one is known already, another solution would be the same
    if not new.any():
        return None
    told = jumping(stream, at_ns[new], size_m[new])
    return replace(problem, streams=tuple(told if s is stream else s for s in problem.streams))


def with_jumps_of(solved: Problem, problem: Problem) -> Problem:
    """Return a problem with the position jumps of a solved one, and with the slow errors that these make states."""
    if solved is problem:
        return problem
    jumps = ((s.slow, s.left_out, s.position_jumps) for s in solved.streams)
    streams = (
        replace(stream, slow=slow, left_out=left_out, position_jumps=found)
        for stream, (slow, left_out, found) in zip(problem.streams, jumps, strict=True)
    )
    return replace(problem, streams=tuple(streams))
