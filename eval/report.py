# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one self-contained page that opens offline."""

from __future__ import annotations

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReportData:
    """What a report shows. `truth_statement` says plainly what the numbers were measured against."""

    title: str
    solution: Solution
    recording: Recording
    config: VesselConfig
    filters: Sequence[FilterResult]
    held: Sequence[GnssPosition]
    levers_m: Levers
    tables: Sequence[Table]
    truth_statement: str


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
<h2>Map</h2><p class="note">East and north of the datum, m. Points: measurements, coloured by final weight; hover for the ledger row.</p>
$map
<h2>Errors and 95 % bounds</h2><p class="note">Blue band: the bound that the estimate states. Orange: degraded; red: dead reckoning or lost.</p>
$errors
<h2>Was my measurement used?</h2><div class="scroll">$ledger</div>
<h2>Residuals</h2><p class="note">Residual of each sensor in its own standard deviations, before the loss, coloured by weight.</p>
$residuals
<h2>Slow states</h2><p class="note">GNSS error, compass offset with 95 % bands; IMU biases.</p>
$slow
<h2>Solver</h2>$stats
<details><summary>Effective configuration</summary><pre>$config</pre></details>
</body></html>
""")


def write_report(path: Path, data: ReportData) -> None:
    """Write the page.

    Raises:
        OutputError: the disk refuses.
    """
    page = _PAGE.substitute(
        title=escape(data.title),
        plotly=get_plotlyjs(),
        verdict=escape(_verdict(data)),
        colour="#009E73" if data.solution.stats.converged else "#D55E00",
        truth=escape(data.truth_statement),
        warnings=_warnings(data),
        tables="".join(f"<h2>{escape(t.title)}</h2>{_table(t)}" for t in data.tables),
        map=_figure(plots.track_map(data.recording, data.solution, data.filters), "map"),
        errors=_figure(
            plots.error_over_time(data.recording, data.solution, data.filters, data.held, data.levers_m), "errors"
        ),
        ledger=_ledger(data.solution),
        residuals=_figure(plots.residuals_over_time(data.solution), "residuals"),
        slow=_figure(plots.slow_over_time(data.solution), "slow"),
        stats=_stats(data.solution),
        config=escape(json.dumps(effective(data.config), indent=1)),
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error


def _figure(figure: go.Figure, name: str) -> str:
    html: str = figure.to_html(
        full_html=False, include_plotlyjs=False, div_id=name, config={"displaylogo": False, "responsive": True}
    )
    return f'<div class="figure">{html}</div>'


def _verdict(data: ReportData) -> str:
    """How good, compared with the filters, and can it be trusted: in two sentences."""
    solution = data.solution
    assert solution.trajectory.cov is not None
    bound = float(np.percentile(bounds_95(solution.trajectory.cov)[:, 0], 95))
    good = np.mean([h.value == "good" for h in solution.health])
    text = f"The estimate states a 95 % bound of {bound:.2f} m or better for 95 % of the run, and calls itself good for {good:.0%}."
    for table in data.tables:
        values = table.as_dict()
        key = next((k for k in ("position_rmse_m", "horizontal_rmse_m") if k in table.columns), None)
        if key is None:
            continue
        ours = values["graphloc"][key]
        others = ", ".join(f"{n} {v[key]:.2f} m" for n, v in values.items() if n != "graphloc" and v[key] is not None)
        text = f"Horizontal RMSE {ours:.2f} m" + (f" (beside it: {others})" if others else "") + ". " + text
        break
    if not solution.stats.converged:
        text += " THE SOLVER DID NOT CONVERGE: do not rely on this run."
    return text


def _warnings(data: ReportData) -> str:
    lines = (*data.recording.warnings, *data.solution.stats.warnings)
    return "<ul>" + "".join(f'<li class="warning">{escape(w)}</li>' for w in lines) + "</ul>" if lines else ""


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(c)}</th>" for c in ("", *table.columns))
    rows = "".join(
        f"<tr><td>{escape(n)}</td>" + "".join(f"<td>{'-' if v is None else f'{v:.3f}'}</td>" for v in vs) + "</tr>"
        for n, vs in table.rows
    )
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return f'<div class="scroll"><table><tr>{head}</tr>{rows}</table></div>{note}'


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


def _stats(solution: Solution) -> str:
    s = solution.stats
    return (
        f"<p>{s.states} states, {s.factors} factors, {s.passes} passes, {s.iterations} iterations; "
        f"{'converged' if s.converged else 'NOT converged'}. Cost {s.cost:.0f}, expected {s.expected_cost:.0f} "
        f"(ratio {s.cost / max(s.expected_cost, 1.0):.2f}; near 1 where the noise is configured right).</p>"
    )
