# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one self-contained page that opens offline."""

from __future__ import annotations

import base64
import enum
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from graphloc.config import VesselConfig, effective
from graphloc.errors import OutputError
from graphloc.eval import plots
from graphloc.eval.ekf import FilterResult
from graphloc.eval.metrics import Levers, Table
from graphloc.measurements import GnssPosition
from graphloc.outputs import bounds_95
from graphloc.recording import Recording
from graphloc.solution import Solution

# Shares of the run: called good, covered by the 95 % bounds, compared at all; below, a reader has to look closer.
_MOSTLY, _COVERED, _NOT_COVERED, _MATCHED, _STARTED = 0.5, 0.85, 0.5, 0.95, 0.8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReportData:
    """What a report shows.

    Attributes:
        truth_statement: says plainly what the numbers were measured against. pictures: captions and JPEGs of matches.
    """

    title: str
    solution: Solution
    recording: Recording
    config: VesselConfig
    filters: Sequence[FilterResult]
    held: Sequence[GnssPosition]
    levers_m: Levers
    tables: Sequence[Table]
    truth_statement: str
    pictures: Sequence[tuple[str, bytes]] = ()


_PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,"><title>$title</title>
<style>
body{font:16px/1.45 system-ui,sans-serif;color:#111;background:#fff;max-width:1150px;margin:0 auto;padding:1rem}
h1{font-size:1.5rem;margin:.2rem 0}h2{font-size:1.15rem;margin:1.6rem 0 .4rem;border-bottom:1px solid #ccc}
.verdict{font-size:1.1rem;padding:.6rem .8rem;border-left:6px solid $colour;background:#f5f5f5}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.88rem;margin:.4rem 0}
th,td{padding:.25rem .6rem;text-align:right;border-bottom:1px solid #ddd;white-space:nowrap}
th:first-child,td:first-child{text-align:left}.reason td{white-space:normal;text-align:left}
.note{color:#444;font-size:.9rem}pre{overflow-x:auto;background:#f5f5f5;padding:.6rem;font-size:.8rem}
li.warning{color:#8a3b00}@media print{.figure{break-inside:avoid}details{display:none}}
</style><script>$plotly</script></head><body>
<h1>$title</h1><p class="verdict">$verdict</p><p>$truth</p>
$warnings
$tables
<h2>Map</h2><p class="note">East and north of the datum, m. Points: measurements, coloured by final weight; hover for the ledger row. Drag to zoom, double-click to go back.</p>
$map
<h2>Errors and 95 % bounds</h2><p class="note">Blue band: the bound that the estimate states. Orange: degraded; red: dead reckoning or lost.</p>
$errors
$berths
<h2>Was my measurement used?</h2><div class="scroll">$ledger</div>
<h2>Residuals</h2><p class="note">Residual of each sensor in its own standard deviations, before the loss, coloured by weight.</p>
$residuals
<h2>Slow states</h2><p class="note">GNSS error, compass offset with 95 % bands; IMU biases.</p>
$slow
$matches
<h2>Solver</h2>$stats
<details><summary>Effective configuration</summary><pre>$config</pre></details>
</body></html>
""")


def write_report(path: Path, data: ReportData) -> None:
    """Write the page.

    Raises:
        OutputError: the disk refuses.
    """
    trust, text = verdict(data)
    page = _PAGE.substitute(
        title=escape(data.title),
        plotly=get_plotlyjs(),
        verdict=escape(text),
        colour=trust.value,
        truth=escape(data.truth_statement),
        warnings=_warnings(data),
        tables="".join(f"<h2>{escape(t.title)}</h2>{_table(t)}" for t in data.tables),
        map=_figure(plots.track_map(data.recording, data.solution, data.filters), "map"),
        errors=_figure(
            plots.error_over_time(data.recording, data.solution, data.filters, data.held, data.levers_m), "errors"
        ),
        berths=_berths(data.solution),
        ledger=_ledger(data.solution),
        residuals=_figure(plots.residuals_over_time(data.solution), "residuals"),
        slow=_figure(plots.slow_over_time(data.solution), "slow"),
        matches=_matches(data.pictures),
        stats=_stats(data.solution),
        config=escape(json.dumps(effective(data.config), indent=1)),
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error


def _figure(figure: go.Figure, name: str) -> str:
    html: str = figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=name,
        config={"displaylogo": False, "responsive": True, "displayModeBar": False},
    )
    return f'<div class="figure">{html}</div>'


class Trust(enum.StrEnum):
    """How far the report says that a run can be relied on; the value is its colour."""

    YES = "#009E73"
    WITH_CARE = "#E69F00"
    NO = "#D55E00"


def verdict(data: ReportData) -> tuple[Trust, str]:
    """Say how good a run is, compared with the filters, and whether it can be trusted, in a few sentences."""
    solution = data.solution
    assert solution.trajectory.cov is not None
    bound = float(np.percentile(bounds_95(solution.trajectory.cov)[:, 0], 95))
    good = float(np.mean([h.value == "good" for h in solution.health]))
    said = ["Online: each pose as it was known at its time."] if solution.stats.online else []
    said += [_accuracy(data)] if data.tables else []
    said.append(
        f"It states a 95 % bound of {bound:.2f} m or better for 95 % of the run, and calls itself good for {good:.0%}."
    )
    covered, matched, headed = (_ours(data, c) for c in ("coverage_95", "matched", "heading_coverage_95"))
    trust = Trust.YES
    if covered is not None:
        said.append(f"Its 95 % bounds held the truth for {covered:.0%} of the time.")
    if matched is not None and _MATCHED > matched >= _STARTED and solution.stats.online:
        said.append(
            f"It covers {matched:.0%} of what it is compared with: it begins when place and heading can be told."
        )
    elif matched is not None and matched < _MATCHED:
        trust = Trust.WITH_CARE
        said.append(f"IT COVERS ONLY {matched:.0%} of what it is compared with; the filters may cover more.")
    if headed is not None and headed < _COVERED:
        trust = Trust.WITH_CARE
        said.append(f"Its heading bounds held the truth for {headed:.0%} of the time.")
    warnings = len(data.recording.warnings) + len(solution.stats.warnings)
    if warnings:
        said.append(f"Read the {warnings} warning{'s' if warnings > 1 else ''} below.")
    if warnings or good < _MOSTLY or (covered is not None and covered < _COVERED):
        trust = Trust.WITH_CARE
    if covered is not None and covered < _NOT_COVERED:
        trust, said = Trust.NO, [*said, "The bounds are far too small: a mount, the datum or a noise is wrong."]
    if not solution.stats.converged:
        trust, said = Trust.NO, [*said, "THE SOLVER DID NOT CONVERGE: do not rely on this run."]
    return trust, " ".join(said)


def _ours(data: ReportData, column: str) -> float | None:
    """The graph's number in the first table that has such a column."""
    return next((t.as_dict()[data.solution.name][column] for t in data.tables if column in t.columns), None)


def _accuracy(data: ReportData) -> str:
    ours = data.solution.name
    for table in data.tables:
        key = next((k for k in ("position_rmse_m", "horizontal_rmse_m") if k in table.columns), None)
        if key is not None:
            values = table.as_dict()
            others = ", ".join(f"{n} {v[key]:.2f} m" for n, v in values.items() if n != ours and v[key] is not None)
            return f"Horizontal RMSE {values[ours][key]:.2f} m" + (f" (beside it: {others})." if others else ".")
    return ""


def _warnings(data: ReportData) -> str:
    lines = (*data.recording.warnings, *data.solution.stats.warnings)
    return "<ul>" + "".join(f'<li class="warning">{escape(w)}</li>' for w in lines) + "</ul>" if lines else ""


def _table(table: Table) -> str:
    """Estimates as columns, numbers as rows: it fits a phone."""
    head = "".join(f"<th>{escape(name)}</th>" for name, _ in table.rows)
    rows = "".join(
        f"<tr><td>{escape(column)}</td>"
        + "".join(f"<td>{'-' if values[k] is None else f'{values[k]:.3f}'}</td>" for _, values in table.rows)
        + "</tr>"
        for k, column in enumerate(table.columns)
    )
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return f'<div class="scroll"><table><tr><th></th>{head}</tr>{rows}</table></div>{note}'


def _ledger(solution: Solution) -> str:
    counts = solution.ledger.counts()
    outcomes = sorted({o for c in counts.values() for o in c})
    head = "".join(f"<th>{escape(o)}</th>" for o in ("", *outcomes))
    rows = "".join(
        f"<tr><td>{escape(n)}</td>" + "".join(f"<td>{c.get(o, 0)}</td>" for o in outcomes) + "</tr>"
        for n, c in counts.items()
    )
    reasons = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(outcome)}</td><td>{count}</td><td>{escape(reason)}</td></tr>"
        for (name, outcome, reason), count in list(solution.ledger.reasons().items())[:60]
    )
    return (
        f"<table><tr>{head}</tr>{rows}</table><p class='note'>{len(solution.ledger)} messages in all; "
        f"ledger.csv has a row for each.</p><table class='reason'>{reasons}</table>"
    )


def _berths(solution: Solution) -> str:
    if not solution.berths:
        return ""
    note = (
        "Across: from the quay's face to the vessel's origin; along: to the right for who looks at the quay from the water; "
        "angle of the bow from straight in. Bands: 95 %. berth_*.csv has the numbers, and the rates."
    )
    return (
        f'<h2>Seen from the berth</h2><p class="note">{note}</p>{_figure(plots.berths_over_time(solution), "berths")}'
    )


def _matches(pictures: Sequence[tuple[str, bytes]]) -> str:
    if not pictures:
        return ""
    note = (
        "Scan on the map: faces red, first returns green, where the best mode has them. Arrows and ellipses (95 %): modes; "
        "light blue: the prior. Right: the score of each place, at its best heading."
    )
    shown = "".join(
        f'<p>{escape(said)}</p><img style="max-width:100%" alt="{escape(said)}" '
        f'src="data:image/jpeg;base64,{base64.b64encode(coded).decode()}">'
        for said, coded in pictures
    )
    return f'<h2>Matches</h2><p class="note">{note}</p>{shown}'


def _stats(solution: Solution) -> str:
    s = solution.stats
    if s.online:
        events = "".join(f"<li>{escape(event)}</li>" for event in s.events)
        return f"<p>Online: {s.states} poses, each as it was known at its time.</p><ul>{events}</ul>"
    return (
        f"<p>{s.states} states, {s.factors} factors, {s.passes} passes, {s.iterations} iterations; "
        f"{'converged' if s.converged else 'NOT converged'}. Cost {s.cost:.0f}, expected {s.expected_cost:.0f} "
        f"(ratio {s.cost / max(s.expected_cost, 1.0):.2f}; near 1 where the noise is configured right).</p>"
    )
