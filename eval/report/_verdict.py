# SPDX-License-Identifier: Apache-2.0
"""How good a run is, compared with the filters, and whether it can be trusted."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from graphloc.eval.metrics import Table
from graphloc.eval.report._data import ReportData
from graphloc.trajectory import bounds_95

# Shares of the run: called good, covered by the 95 % bounds, compared at all; below, a reader has to look closer.
_MOSTLY, _COVERED, _NOT_COVERED, _MATCHED, _STARTED = 0.5, 0.85, 0.5, 0.95, 0.8
_FAR_OFF = 3.0  # cost over its expectation; `degraded` from there on


class Trust(enum.StrEnum):
    """How far the report says that a run can be relied on; the value is its colour."""

    YES = "#009E73"
    WITH_CARE = "#E69F00"
    NO = "#D55E00"

    @property
    def said(self) -> str:
        """In words."""
        return {Trust.YES: "can be trusted", Trust.WITH_CARE: "use with care", Trust.NO: "do not rely on it"}[self]


_ORDER = (Trust.YES, Trust.WITH_CARE, Trust.NO)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reason:
    """A sentence, and how far it alone lets a run be trusted."""

    trust: Trust
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What a report says first.

    Attributes:
        accuracy: how good, in a sentence; says so where nothing measures it.
        reasons: why to trust it, and why not.
    """

    accuracy: str
    reasons: tuple[Reason, ...]

    @property
    def trust(self) -> Trust:
        """That of the worst reason."""
        return max((r.trust for r in self.reasons), key=_ORDER.index, default=Trust.YES)


def verdict(data: ReportData) -> Verdict:
    """Say how good a run is, compared with the filters, and whether it can be trusted."""
    return Verdict(accuracy=_accuracy(data), reasons=(*_bounds(data), *_compared(data), *_solved(data)))


def _bounds(data: ReportData) -> list[Reason]:
    """What the estimate says of itself, and whether that was so."""
    solution = data.solution
    assert solution.trajectory.cov is not None
    bound = float(np.percentile(bounds_95(solution.trajectory.cov)[:, 0], 95))
    good = float(np.mean([h.value == "good" for h in solution.health]))
    said = [
        Reason(
            trust=Trust.WITH_CARE if good < _MOSTLY else Trust.YES,
            text=f"It states a 95 % bound of {bound:.2f} m or better for 95 % of the run, and calls itself good for {good:.0%}.",
        )
    ]
    covered, headed = ours(data, "coverage_95"), ours(data, "heading_coverage_95")
    if covered is not None:
        trust = Trust.NO if covered < _NOT_COVERED else Trust.WITH_CARE if covered < _COVERED else Trust.YES
        why = ". The bounds are far too small: a mount, the datum or a noise is wrong" if trust is Trust.NO else ""
        said.append(Reason(trust=trust, text=f"Its 95 % bounds held the truth for {covered:.0%} of the time{why}."))
    if headed is not None:
        trust = Trust.WITH_CARE if headed < _COVERED else Trust.YES
        said.append(Reason(trust=trust, text=f"Its heading bounds held the truth for {headed:.0%} of the time."))
    return said


def _compared(data: ReportData) -> list[Reason]:
    """What there was to hold it against."""
    if main_table(data) is None:
        text = "Nothing here measures how far off it is: there is neither truth nor a fix that was kept out."
        return [Reason(trust=Trust.WITH_CARE, text=text)]
    matched = ours(data, "matched")
    if matched is None or matched >= _MATCHED:
        return []
    if data.solution.stats.online and matched >= _STARTED:
        text = f"It covers {matched:.0%} of what it is compared with: it begins when place and heading can be told."
        return [Reason(trust=Trust.YES, text=text)]
    text = f"It covers only {matched:.0%} of what it is compared with; the filters may cover more."
    return [Reason(trust=Trust.WITH_CARE, text=text)]


def _solved(data: ReportData) -> list[Reason]:
    """How the solver fared, and what was said on the way."""
    stats, said = data.solution.stats, []
    if stats.online:
        said.append(Reason(trust=Trust.YES, text="Online: each pose is as it was known at its time."))
    elif not stats.converged:
        said.append(Reason(trust=Trust.NO, text="The solver did not converge: do not rely on this run."))
    else:
        ratio = stats.cost / max(stats.expected_cost, 1.0)
        trust = Trust.WITH_CARE if ratio > _FAR_OFF else Trust.YES
        text = (
            f"The solver converged; the measurements disagree with it {ratio:.2f} times as much as they say they may."
        )
        said.append(Reason(trust=trust, text=text))
    warnings = len(data.recording.warnings) + len(stats.warnings)
    if warnings:
        text = f"There {'are' if warnings > 1 else 'is'} {warnings} warning{'s' if warnings > 1 else ''}, below."
        said.append(Reason(trust=Trust.WITH_CARE, text=text))
    return said


def ours(data: ReportData, column: str) -> float | None:
    """The graph's number in the first table that has such a column."""
    return next((t.as_dict()[data.solution.name][column] for t in data.tables if column in t.columns), None)


def main_table(data: ReportData) -> tuple[Table, str] | None:
    """The table that says how far off the estimates are, and its column that says it shortest."""
    for table in data.tables:
        key = next((k for k in ("position_rmse_m", "horizontal_rmse_m") if k in table.columns), None)
        if key is not None:
            return table, key
    return None


def _accuracy(data: ReportData) -> str:
    found = main_table(data)
    if found is None:
        return "How good it is cannot be said."
    table, key = found
    values = {name: row[key] for name, row in table.as_dict().items() if row[key] is not None}
    mine = values.pop(data.solution.name, None)
    if mine is None:
        return "How good it is cannot be said."
    said = f"Horizontal RMSE {mine:.2f} m"
    beside = ", ".join(f"{name} {value:.2f} m{_times(value, mine)}" for name, value in values.items())
    return f"{said}; beside it: {beside}." if beside else f"{said}."


def _times(value: float | None, mine: float) -> str:
    return f" ({times(value, mine)})" if value is not None and mine > 0.0 else ""


def times(value: float, mine: float) -> str:
    """Say how many times as large as ours a number is."""
    ratio = value / mine
    return f"{ratio:.0f} x" if ratio >= 9.95 else f"{ratio:.1f} x" if ratio >= 0.095 else f"{ratio:.2f} x"
