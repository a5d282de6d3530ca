# SPDX-License-Identifier: Apache-2.0
"""Health of an estimate over time: how long it was in each state, why, and what would end that."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from graphloc.eval.formatting import percent
from graphloc.eval.html import note, table
from graphloc.frames import Array
from graphloc.solution import Cause, Health, HealthReason, Solution
from graphloc.time import seconds_since

_MOST = 12  # most reasons in a table
_STEP_S = 1.0  # longest time between two poses; in a longer gap there was no estimate (as in `Trajectory.covers`)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A period of constant health: begin and end, in s since the origin of times, and the reason at its begin."""

    health: Health
    reason: HealthReason
    begin_s: float
    end_s: float


def _lasting_s(solution: Solution) -> Array:
    """Return for how long each pose is valid (N,), s: until the next one, but not across a gap."""
    t = seconds_since(int(solution.trajectory.stamps_ns[0]), solution.trajectory.stamps_ns)
    step = np.diff(t, append=t[-1])
    return np.asarray(np.where(step <= _STEP_S, step, 0.0))


def durations_s(solution: Solution) -> dict[Health, float]:
    """Return the time in each state of health that occurs, s."""
    lasting = _lasting_s(solution)
    called = np.array([h.value for h in solution.health])
    return {health: float(lasting[called == health.value].sum()) for health in Health if health.value in called}


def shares(solution: Solution) -> dict[Health, float]:
    """Return the share of poses in each state of health that occurs."""
    return {h: solution.health.count(h) / len(solution.health) for h in Health if h in solution.health}


def stretches(solution: Solution, begin_ns: int) -> list[Stretch]:
    """Return the periods in which health was not good; neighbours whose reasons differ only in numbers are joined.

    Args:
        begin_ns: origin of the times.
    """
    t = seconds_since(begin_ns, solution.trajectory.stamps_ns)
    ends = t + _lasting_s(solution)

    def kind(k: int) -> tuple[Health, str]:
        return solution.health[k], _masked(solution.health_reason[k].text)

    found = []
    for (health, _), group in groupby(range(len(t)), key=kind):
        inside = list(group)
        if health is not Health.GOOD:
            first, last = inside[0], inside[-1]
            reason = solution.health_reason[first]
            found.append(Stretch(health=health, reason=reason, begin_s=float(t[first]), end_s=float(ends[last])))
    return found


def said_of(solution: Solution) -> str:
    """Return the states of health with shares and durations, as 'good for 80 % (64 s), degraded for 20 % (16 s)'."""
    lasting = durations_s(solution)
    parts = [f"{_words(h)} for {percent(share)} ({_seconds(lasting[h])})" for h, share in shares(solution).items()]
    return ", ".join(parts)


def cure(health: Health, reason: HealthReason) -> str:
    """Return what would end a state of health that is not good."""
    if reason.cause is Cause.GUESSED_HEADING:
        return "a heading sensor (compass, dual antenna), wheels or a log (body_velocity), or start.heading_deg"
    if reason.cause is Cause.HEADING:
        return "a compass, wheels or a log (body_velocity), or, while fixes, matches or tags agree, turns and changes of speed"
    if health in (Health.LOST, Health.DEAD_RECKONING):
        return "a fix, match or tag that agrees"
    if reason.cause is Cause.SENSORS:
        return f"{', '.join(reason.sensors)} agreeing again; the ledger says what became of its measurements"
    if reason.cause is Cause.BOUND:
        return (
            "a better fix, or a second position sensor (match, tag); where a wider bound will do, output.good_bound_m"
        )
    return "agreement again; where the warnings name a noise, a mount or stamps, correcting that"


def section(solutions: Sequence[Solution], begin_ns: int) -> str:
    """Return the reasons for which each solution was not good as HTML tables, longest first; empty if all were good.

    Args:
        begin_ns: origin of the times.
    """
    parts = []
    for solution in solutions:
        alike: dict[tuple[Health, str], list[Stretch]] = {}
        for stretch in stretches(solution, begin_ns):
            alike.setdefault((stretch.health, _masked(stretch.reason.text)), []).append(stretch)
        whole = sorted(alike.values(), key=lambda same: -sum(s.end_s - s.begin_s for s in same))
        rows = []
        for same in whole[:_MOST]:
            longest = max(same, key=lambda s: s.end_s - s.begin_s)
            total_s = sum(s.end_s - s.begin_s for s in same)
            rows.append(
                [_words(longest.health), str(len(same)), _seconds(total_s), f"{longest.begin_s:.0f} to {longest.end_s:.0f}",
                 longest.reason.text, cure(longest.health, longest.reason)]
            )  # fmt: skip
        if rows:
            left = f"{len(whole) - _MOST} more reasons are in solution.csv." if len(whole) > _MOST else ""
            head = ("", "times", "in all", "longest, s (from, to)", "why", "what ends it")
            parts.append(f"<h3>{solution.name}: {said_of(solution)}</h3>{table(head, rows, text=(4, 5))}{note(left)}")
    return "".join(parts)


def _masked(text: str) -> str:
    """Return a text with its numbers masked."""
    return re.sub(r"\d[\d.]*", "#", text)


def _words(health: Health) -> str:
    return health.value.replace("_", " ")


def _seconds(value: float) -> str:
    return f"{value:.0f} s" if value >= 9.95 else f"{value:.1f} s"
