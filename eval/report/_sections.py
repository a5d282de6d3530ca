# SPDX-License-Identifier: Apache-2.0
"""Sections of the report that are text, tables and pictures; figures come from `graphloc.eval.plots`."""

from __future__ import annotations

import base64
from html import escape

from graphloc.eval.formatting import number, percent, significant
from graphloc.eval.html import note, table
from graphloc.eval.metrics import Table
from graphloc.eval.plots import HEALTH, OUTAGE
from graphloc.eval.report._data import ReportData
from graphloc.eval.report._track_verdict import Row, Trust, main_table, over_one_time, times
from graphloc.eval.report._verdict import RunVerdict
from graphloc.solution import Solution

_REASONS = 60
_WHOLE = "{name} knows the whole run; the others, at each time, only what came before."
_KNOWS = {
    "graphloc": "Offline, from the whole run (graphloc)",
    "graphloc online": "Online, as known at each time (graphloc online)",
}
_COLOUR = {Trust.YES: "#009E73", Trust.WITH_CARE: "#E69F00", Trust.NO: "#D55E00"}
_CLASS = {Trust.YES: "", Trust.WITH_CARE: "care", Trust.NO: "no"}
# Columns of the first table, shown if a run has them: name, heading, digits.
_KEY = (
    ("position_rmse_m", "RMSE, m", 2), ("horizontal_rmse_m", "RMSE, m", 2), ("position_p95_m", "95 %, m", 2),
    ("horizontal_p95_m", "95 %, m", 2), ("position_max_m", "worst, m", 2), ("horizontal_max_m", "worst, m", 2),
    ("outage_drift_m", "drift in gaps, m", 2), ("fix_rmse_m", "RMSE of predicted fixes, m", 2),
    ("heading_rmse_deg", "heading RMSE, °", 2),
)  # fmt: skip
_SHARES = (("coverage_95", "in 95 % bounds"), ("matched", "covered"))
_WIDE = ("95 %, m", "worst, m", "covered")  # columns that a phone hides


def first_screen(data: ReportData, verdict: RunVerdict) -> str:
    """Return the verdict on each track, the key numbers, what they were measured against, and the reasons."""
    several = len(verdict.tracks) > 1
    boxes, lists = [], []
    for track in verdict.tracks:
        said = track.trust.said
        named = f"{_KNOWS[track.name]}: {said}" if several else said.capitalize()
        boxes.append(
            f'<div class="verdict" style="--trust:{_COLOUR[track.trust]}"><b>{escape(named)}.</b> {escape(track.accuracy)}</div>'
        )
        reasons = "".join(f'<li class="{_CLASS[r.trust]}">{escape(r.text)}</li>' for r in track.reasons)
        head = f"<h3>{escape(track.name)}: why</h3>" if several else ""
        lists.append(f'{head}<ul class="reasons">{reasons}</ul>')
    span = data.recording.span
    part = "" if span is None else f"<p><b>Part of the bag.</b> {escape(str(span))}.</p>"
    return (
        f"{''.join(boxes)}{_key_numbers(data)}{part}"
        f"<p><b>What it is measured against.</b> {escape(data.truth_statement)}</p>{''.join(lists)}"
    )


def _key_numbers(data: ReportData) -> str:
    """Return the main table, and remarks that are needed to read it."""
    found = main_table(data)
    if found is None:
        return ""
    whole, key = found
    ours, names = data.solution.name, [name for name, _ in whole.rows]
    said = "" if data.solution.stats.online or len(names) < 2 else _WHOLE.format(name=ours)
    whys = "".join(note(f"{f.name}: {f.why}.") for f in data.filters if f.why and f.name in names)
    return _key_table(whole, key, ours) + note(said) + whys


def _key_table(whole: Table, key: str, ours: str) -> str:
    """Return the main table, one row per estimate, so that it fits a phone.

    Args:
        whole: the metrics. key: column by which the estimates are compared. ours: name of the estimate to compare with.
    """
    values = whole.as_dict()
    told = {c for c in whole.columns if any(row[c] is not None for row in values.values())}
    first, *columns = [column for column in _KEY if column[0] in told]
    shares = [(c, said) for c, said in _SHARES if c in whole.columns]
    head = ["", first[1], "times ours", *(said for _, said, _ in columns), *(said for _, said in shares)]
    rows = [
        [
            name,
            number(row[first[0]], first[2]),
            "" if name == ours else _ratio(row, values[ours], key),
            *(number(row[c], digits) for c, _, digits in columns),
            *(percent(row[c]) for c, _ in shares),
        ]
        for name, row in values.items()
    ]
    wide = [k for k, said in enumerate(head) if said in _WIDE]
    return table(head, rows, ["ours" if name == ours else "" for name in values], wide=wide, kind="key")


def _ratio(theirs: Row, ours: Row, key: str) -> str:
    value, mine = theirs[key], ours[key]
    return times(value, mine) if mine and value is not None and over_one_time(theirs, ours) else ""


def warnings_list(data: ReportData) -> str:
    """Return the list of warnings; empty if there are none."""
    items = "".join(f'<li class="warning">{escape(line)}</li>' for line in data.warnings)
    return f'<h2 id="warnings">Warnings</h2><ul class="warnings">{items}</ul>' if items else ""


def numbers(given: Table) -> str:
    """Return a whole table with a column per estimate, so that it fits a phone."""
    head = ["", *(name for name, _ in given.rows)]
    rows = [[column, *map(number, values)] for column, values in given.told()]
    return f"<h3>{escape(given.title)}</h3>{table(head, rows)}{note(given.note)}"


def shades() -> str:
    """Return the legend of the shaded periods on a time axis."""
    said = {"no GNSS fix": OUTAGE, **{health.value.replace("_", " "): colour for health, colour in HEALTH.items()}}
    keys = "".join(f'<i style="background:{colour}55"></i>{name}' for name, colour in said.items())
    return f'<p class="note shades">Shades:{keys}. Blue: the bound that the estimate states.</p>'


def ledger(solution: Solution) -> str:
    """Return how many messages of each sensor had each outcome, and the most frequent reasons."""
    counts = solution.ledger.counts()
    outcomes = sorted({o for c in counts.values() for o in c})
    head = ["", *(o.replace("_", " ") for o in outcomes)]
    rows = [[name, *(str(c.get(o, 0)) for o in outcomes)] for name, c in counts.items()]
    whole = list(solution.ledger.reasons().items())
    why = [[name, outcome.replace("_", " "), str(n), reason] for (name, outcome, reason), n in whole[:_REASONS]]
    more = f" {len(whole) - _REASONS} more reasons are in it." if len(whole) > _REASONS else ""
    said = note(f"{len(solution.ledger)} messages in all; ledger.csv has a row for each.{more}")
    return table(head, rows) + said + (table(["", "", "messages", "why"], why, text=(3,)) if why else "")


def matches(data: ReportData) -> str:
    """Return the pictures of matches."""
    if not data.pictures:
        return ""
    said = (
        "Scan on the map: faces red, first returns green, where the best mode has them. Arrows and ellipses (95 %): modes; "
        "light blue: the prior. Right: the score of each place, at its best heading."
    )
    shown = "".join(
        f'<p>{escape(caption)}</p><img alt="{escape(caption)}" '
        f'src="data:image/jpeg;base64,{base64.b64encode(coded).decode()}">'
        for caption, coded in data.pictures
    )
    return note(said) + shown


def calibration(data: ReportData) -> str:
    """Return the table of calibration checks and suggestions; empty if there are none."""
    found = data.calibration
    if found is None or not found.checks + found.suggestions:
        return ""
    wrong = "".join(f'<li class="warning">{escape(str(s))}</li>' for s in found.suggestions)
    rows = "".join(
        f"<tr><td>{escape(c.key)}</td><td>{significant(c.configured)}</td><td>{'-' if c.change < 0 else '+'}{significant(abs(c.change))}</td>"
        f"<td>{significant(c.sigma, 2)} {escape(c.unit)}"
        f"</td><td>{escape(c.said)}</td></tr>"
        for c in found.checks
    )
    head = "<tr><th>setting</th><th>configured</th><th>change</th><th>1 sigma</th><th>meaning</th></tr>"
    return (
        note("What the run shows about lever arms, mounts, time stamps and IMU noise. None of it was applied.")
        + (f"<ul>{wrong}</ul>" if wrong else "")
        + f'<div class="scroll"><table class="reason">{head}{rows}</table></div>'
    )


def solver(solution: Solution) -> str:
    """Return the solver's statistics and events."""
    s = solution.stats
    events = "<ul>" + "".join(f"<li>{escape(event)}</li>" for event in s.events) + "</ul>" if s.events else ""
    if s.online:
        return f"<p>Online: {s.states} poses, each as it was known at that time.</p>{events}"
    return (
        f"<p>{s.states} states, {s.factors} factors, {s.passes} passes, {s.iterations} iterations; "
        f"{'converged' if s.converged else 'NOT converged'}. Cost {s.cost:.0f}, expected {s.expected_cost:.0f} "
        f"(ratio {s.cost / max(s.expected_cost, 1.0):.2f}; near 1 where the noise is configured correctly, below 1 where it is configured too large).</p>{events}"
    )
