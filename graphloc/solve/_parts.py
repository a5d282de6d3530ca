# SPDX-License-Identifier: Apache-2.0
"""A run with a long IMU gap is solved in parts: cut there, each solved by itself (in legs, if it is long), then joined.

Across a gap of minutes nothing connects the two sides. Solved as one graph, both sides were distorted by the factor
that bridges the gap (120 s: errors of 4.6 m and 30 deg beside it, where 0.1 m is usual).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from graphloc.berths import BerthTrack
from graphloc.errors import SolveError
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.offsets import joined
from graphloc.recording import Recording
from graphloc.solution import Graded, SlowEstimate, Solution, SolveStats
from graphloc.solve._legs import KnownHeading, Solve, seams, solve_legs
from graphloc.time import utc_text
from graphloc.trajectory import Trajectory

_T = TypeVar("_T")


def solve_parts(
    recording: Recording,
    heading: KnownHeading | None,
    bridge_s: float,
    leg_s: float,
    absolute: Collection[str],
    solve: Solve,
) -> Solution:
    """Cut the recording at IMU gaps longer than `bridge_s`, and long parts into legs; solve these and join them.

    Args:
        heading: at the start of the recording, where known; the vessel may have turned in a gap.
        leg_s: about how long legs are at most. absolute: names of the sensors that measure position.

    Raises:
        SolveError: no part could be solved; the error of the first one.
    """
    parts = _cut(recording, bridge_s)
    cuts = [seams(part, leg_s, absolute) for part in parts]
    if cuts == [[]]:
        return solve(recording, heading)
    solutions, rows, failure = list[Solution](), list(recording.rows), None
    warnings, events = list[str](), list[str]()
    for part, where in zip(parts, cuts, strict=True):
        assert part.imu is not None
        start, stop = (utc_text(int(part.imu.stamps_ns[k])) for k in (0, -1))
        try:
            known = heading if part is parts[0] else None
            legs, said, wrong = _in_legs(replace(part, rows=()), known, where, leg_s, solve)
            solutions += legs
            (warnings if wrong else events).extend(said)
            if len(parts) > 1:
                warnings.append(
                    f"{start} to {stop} lies before or after a long IMU gap (imu max_bridge_s): solved as a separate part"
                )
        except SolveError as error:
            failure = failure or error
            warnings.append(f"the part from {start} to {stop} is left out: {error}")
            rows += _refused(part, str(error))
    if not solutions:
        assert failure is not None
        raise failure
    whole = _join(solutions, rows, warnings)
    events = [*dict.fromkeys(event for s in solutions for event in s.stats.events), *events]
    return replace(whole, stats=replace(whole.stats, events=tuple(events)))


def _in_legs(
    part: Recording, heading: KnownHeading | None, where: Collection[int], leg_s: float, solve: Solve
) -> tuple[list[Solution], list[str], bool]:
    """Return the solutions of a part: in legs, cut at the stamps `where`, if it is long.

    It is solved as a whole if a leg cannot be solved by itself. Also returns the lines to report, and whether they are
    warnings.
    """
    if not where:
        return [solve(part, heading)], [], False
    try:
        legs, apart = solve_legs(part, heading, where, leg_s, solve)
    except SolveError as error:
        return [solve(part, heading)], [f"solved in one piece, not in legs: a leg failed ({error})"], False
    said = f"where they meet they differ by at most {apart.m:.2f} m and {apart.deg:.1f} deg"
    said += "" if apart.within else ", more than their bounds allow"
    return legs, [f"solved in {len(legs)} overlapping legs (`timeline.leg_s`): {said}"], not apart.within


def _cut(recording: Recording, bridge_s: float) -> list[Recording]:
    """Return the parts in order; each has the measurements from its first IMU sample up to that of the next part."""
    imu = recording.imu
    if imu is None or len(imu) < 2:
        return [recording]
    first = [0, *(np.flatnonzero(np.diff(imu.stamps_ns) > bridge_s * 1e9) + 1).tolist()]
    if len(first) == 1:
        return [recording]
    starts = imu.stamps_ns[first]
    part_of = np.maximum(np.searchsorted(starts, [m.stamp_ns for m in recording.measurements], side="right") - 1, 0)
    parts = []
    for k, (a, b) in enumerate(zip(first, [*first[1:], len(imu)], strict=True)):
        kept = tuple(m for m, part in zip(recording.measurements, part_of, strict=True) if part == k)
        parts.append(replace(recording, imu=imu.where(slice(a, b)), measurements=kept, rows=()))
    return parts


def _refused(part: Recording, why: str) -> list[LedgerRow]:
    reason = f"its part of the run could not be solved: {why}"
    others = (part.row_of(m, Outcome.REJECTED, reason) for m in part.measurements if m.seq >= 0)
    return [*part.imu_rows(slice(None), Outcome.REJECTED, reason), *others]


def _join(solutions: Sequence[Solution], rows: Sequence[LedgerRow], warnings: Sequence[str]) -> Solution:
    """Return the solutions of all parts, or legs, as one.

    Args:
        rows: ledger rows that are of no solution.
    """
    tracks = [s.trajectory for s in solutions]
    offsets = [s.offsets for s in solutions if s.offsets is not None]
    states = [len(track) for track in tracks]
    return Solution(
        datum=solutions[0].datum,
        trajectory=Trajectory(**_columns(tracks, "stamps_ns", "p_world_m", "R_world_body", "v_world_mps", "cov")),
        **_columns(solutions, "v_cov", "accel_bias_mps2", "gyro_bias_radps", "gyro_radps", "gyro_cov"),
        health=tuple(chain.from_iterable(s.health for s in solutions)),
        health_reason=tuple(chain.from_iterable(s.health_reason for s in solutions)),
        since_agreed_s=_since_agreed(solutions),
        slow={name: _join_slow(own) for name, own in _by_name([s.slow for s in solutions]).items()},
        berths=_join_berths([b for s in solutions for b in s.berths]),
        ledger=Ledger([*rows, *(row for s in solutions for row in s.ledger)]),
        stats=_join_stats([s.stats for s in solutions], warnings),
        offsets=joined(offsets) if offsets else None,
        time_offsets_s={name: float(by) for name, by in mean_of([s.time_offsets_s for s in solutions], states).items()},
        antennas_off_m=mean_of([s.antennas_off_m for s in solutions], states),
    )


def _columns(parts: Sequence[object], *names: str) -> dict[str, Any]:
    """Return the columns of these names, each from all parts that have it, one after another."""
    return {
        name: np.concatenate([column for part in parts if (column := getattr(part, name)) is not None])
        for name in names
    }


def _by_name(parts: Iterable[Mapping[str, _T]]) -> dict[str, list[_T]]:
    """Return, by name, what the parts of a run have under it."""
    found: dict[str, list[_T]] = {}
    for name, own in chain.from_iterable(part.items() for part in parts):
        found.setdefault(name, []).append(own)
    return found


def mean_of(parts: Sequence[Mapping[str, Any]], states: Sequence[int]) -> dict[str, NDArray[np.float64]]:
    """Return, by name, the mean over the parts of a run that have it, each as much as it has states."""
    weighed = _by_name([{name: (own, n) for name, own in part.items()} for part, n in zip(parts, states, strict=True)])
    return {name: np.average([x for x, _ in own], axis=0, weights=[n for _, n in own]) for name, own in weighed.items()}


def _since_agreed(solutions: Sequence[Solution]) -> dict[str, NDArray[np.float64]]:
    """Return, by sensor and state, how long it has not agreed, s; inf in a part in which it does not measure."""
    never = [np.full(len(s.trajectory), np.inf) for s in solutions]
    return {
        name: np.concatenate([s.since_agreed_s.get(name, none) for s, none in zip(solutions, never, strict=True)])
        for name in _by_name([s.since_agreed_s for s in solutions])
    }


def _join_berths(parts: Sequence[BerthTrack]) -> tuple[BerthTrack, ...]:
    alike = _by_name({part.berth.name: part} for part in parts).values()
    return tuple(BerthTrack(berth=own[0].berth, **_columns(own, "stamps_ns", "value", "rate", "cov")) for own in alike)


def _join_slow(parts: Sequence[SlowEstimate]) -> SlowEstimate:
    return replace(parts[0], **_columns(parts, "stamps_ns", "value", "sigma"))


def _join_stats(parts: Sequence[SolveStats], warnings: Sequence[str]) -> SolveStats:
    return SolveStats(
        passes=sum(p.passes for p in parts),
        iterations=sum(p.iterations for p in parts),
        states=sum(p.states for p in parts),
        factors=sum(p.factors for p in parts),
        cost=sum(p.cost for p in parts),
        expected_cost=sum(p.expected_cost for p in parts),
        converged=all(p.converged for p in parts),
        warnings=(*warnings, *_said_once([w for p in parts for w in p.warnings])),
    )


def _said_once(lines: Sequence[str]) -> list[str]:
    """Return the warnings of all parts, each once; of graded ones about one matter, that with the largest figure."""
    worst, parts = dict[str, Graded](), Counter[str]()
    for line in lines:
        if isinstance(line, Graded):
            parts[line.about] += 1
            if line.about not in worst or line.figure > worst[line.about].figure:
                worst[line.about] = line
    said = dict[str, None]()
    for line in lines:
        if not isinstance(line, Graded) or parts[line.about] == 1:
            said[line] = None
        elif line is worst[line.about]:
            said[f"{line} (the worst of {parts[line.about]} parts of the run that show this)"] = None
    return list(said)
