# SPDX-License-Identifier: Apache-2.0
"""Result of drills as a page, Markdown and CSV."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from graphloc.eval.drill.figures import against_length, all_failures, over_time
from graphloc.eval.drill.measure import HELD, HOLDS_S, NEAR_M, NORMAL_TIMES, Drilled, Row, State, summed
from graphloc.eval.drill.plan import TAIL_S, WINDOW_TAIL_S
from graphloc.eval.html import drawing
from graphloc.eval.page import Cell, Grid, write_csv, write_markdown, write_page

MARK = "drill.json"  # a folder with this file was written here, and may be replaced


def said(drilled: Drilled) -> list[str]:
    """Return the result in sentences: the worst outage, lock-outs, and the reference."""
    rows = summed(drilled.measured)
    lines = [" ".join(_headline(drilled, rows))]
    if drilled.truth:
        lines.append("Reference: truth, which no estimator sees; the EKFs are started at it, as in the thesis.")
    else:
        lines.append(
            "Reference: the undisturbed offline solution, as no truth covers the run. It shares its fixes with everything that is "
            f"judged, and its own 95 % bound is {drilled.bound_m:.1f} m (median): smaller differences mean "
            "little, its covariance is added when coverage is judged, and 'graphloc' is nearest to it by construction."
        )
    if not drilled.windows[0].whole:
        seconds = (drilled.windows[0].end_ns - drilled.windows[0].begin_ns) / 1e9
        lines.append(
            f"The recording is long: each failure was drilled in {len(drilled.windows)} windows of {seconds:.0f} s. Without "
            "a heading sensor, a window starts with the heading that the undisturbed run had there."
        )
    return [*lines, *(f"Warning: {text}" for text in drilled.warnings)]


def _headline(drilled: Drilled, rows: Sequence[Row]) -> list[str]:
    found = []
    outages = [r for r in rows if r.family in ("no place at all", "GNSS outage")]
    if outages:
        family = "no place at all" if any(r.family == "no place at all" for r in outages) else "GNSS outage"
        longest = max(r.length_s for r in outages if r.family == family)
        offs = ", ".join(
            f"{r.estimator} {_m(r.off_m)}" for r in outages if r.family == family and r.length_s == longest
        )
        found.append(f"{family[0].upper()}{family[1:]} for {longest:g} s, farthest off: {offs}.")
    trials = len({(m.failure, m.begin_s) for m in drilled.measured})
    never = _counted(drilled, State.LOST, State.NONE)
    found.append(f"Of {trials} drills: never back {never or 'none'}; near again, but outside its own 95 % bounds ")
    found[-1] += f"{_counted(drilled, State.UNSURE) or 'none'}."
    return found


def _counted(drilled: Drilled, *states: State) -> str:
    counts = {n: sum(m.state in states for m in drilled.measured if m.estimator == n) for n in drilled.estimators}
    return ", ".join(f"{name} {n}" for name, n in counts.items() if n)


def _m(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} m" if value < 10.0 else f"{value:.0f} m"


def _cell(row: Row) -> Cell:
    if row.none == row.times:
        return Cell(text="no estimate", mark="bad")
    text = f"{_m(row.off_m)} ({_m(row.normal_m)})"
    if row.family.startswith("compass") and row.off_deg is not None and row.normal_deg is not None:
        text += f", {row.off_deg:.1f} deg ({row.normal_deg:.1f})"
    ends = []
    if row.lost or row.none:
        ends.append(f"NEVER BACK {row.lost + row.none} of {row.times}")
    if row.unsure:
        ends.append(f"near, outside its bounds {row.unsure} of {row.times}")
    if row.back_s is not None:
        ends.append(f"back {row.back_s:.0f} s")
    covered = "-" if row.coverage is None else f"{100.0 * row.coverage:.0f} %"
    mark = "bad" if row.lost or row.none else "doubt" if row.unsure or (row.coverage or 0.0) < 0.8 else ""
    return Cell(text=f"{text}; {'; '.join(ends)}; {covered}", mark=mark)


def _short(row: Row) -> Cell:
    if row.none == row.times:
        return Cell(text="no estimate")
    back = "" if row.back_s is None else f", {row.back_s:.0f} s"
    never = f", NEVER BACK {row.lost + row.none} of {row.times}" if row.lost or row.none else ""
    return Cell(text=f"{_m(row.off_m)}{back}{never}{' *' if row.unsure else ''}")


def _rows(drilled: Drilled, cell_of: Callable[[Row], Cell]) -> tuple[tuple[Cell, ...], ...]:
    """Return a row for each failure: its name, and a cell for each estimator."""
    by = {(r.failure, r.estimator): r for r in summed(drilled.measured)}
    names = dict.fromkeys(m.failure for m in drilled.measured)
    return tuple((Cell(text=n), *(cell_of(by[n, e]) for e in drilled.estimators)) for n in names)


def brief(drilled: Drilled) -> list[Grid]:
    """Return the tables for a terminal: largest error, and time to recover (a star: outside the estimator's bounds)."""
    rows = _rows(drilled, _short)
    title = "Farthest off, s until back (*: near, but outside its own 95 % bounds)"
    return [Grid(title=title, head=("failure", *drilled.estimators), rows=rows), *grids(drilled)[1:]]


def grids(drilled: Drilled) -> list[Grid]:
    """Return the table of failures, and a table of failures that were not injected."""
    times = max(r.times for r in summed(drilled.measured))
    table = Grid(
        title=f"Drills, each at {times} time{'s' if times > 1 else ''}",
        head=("failure", *drilled.estimators),
        rows=_rows(drilled, _cell),
        note=(
            f"A cell: largest horizontal distance from the reference until {TAIL_S:g} s after the failure, worst of the times "
            "(in brackets: the same estimator undisturbed); how long after the failure's end it was back; share of "
            f"that time in which its 95 % region held the reference. Back: for {HOLDS_S:g} s within {NEAR_M:g} m, or within "
            f"{NORMAL_TIMES:g} times its undisturbed 95th percentile, and {100 * HELD:.0f} % of that time inside its "
            "own bound. 'Near, outside its bounds': as near, but overconfident. 'Never back': not near "
            f"again in {WINDOW_TAIL_S:g} s, or before the recording ends. The BL EKF is not told of signal losses here."
        ),
    )
    found = [table]
    why = dict.fromkeys((m.failure, m.estimator, m.why) for m in drilled.measured if m.why)
    if why:
        rows = tuple(tuple(Cell(text=text) for text in line) for line in why)
        found.append(Grid(title="No estimate", head=("failure", "estimator", "why"), rows=rows))
    if drilled.left:
        left = tuple((Cell(text=name), Cell(text=why_not)) for name, why_not in drilled.left)
        found.append(Grid(title="Not drilled", head=("failure", "why not"), rows=left))
    return found


def write(drilled: Drilled, folder: Path, command: str) -> None:
    """Write drill.html, drill.md, drill.csv and drill.json into an existing folder."""
    title = f"Drills: {drilled.vessel}, {Path(drilled.source).name}"
    lines, tables = said(drilled), grids(drilled)
    lengths = against_length(drilled)
    parts = [tables[0].as_html()]
    if lengths is not None:
        parts += ["<h2>Outages by length</h2>", drawing(lengths)]
    parts += ["<h2>All failures</h2>", drawing(all_failures(drilled))]
    parts += [
        "<h2>Over time</h2><p class='note'>Horizontal distance from the reference; grey: the failure; its first time.</p>",
        drawing(over_time(drilled)),
    ]
    parts += [grid.as_html() for grid in tables[1:]]
    write_page(folder / "drill.html", title, lines, parts)
    write_markdown(folder / "drill.md", title, lines, tables)
    write_csv(folder / "drill.csv", [asdict(m) for m in drilled.measured])
    content = {
        "command": command,
        "said": lines,
        "truth": drilled.truth,
        "rows": [asdict(r) for r in summed(drilled.measured)],
        "left": dict(drilled.left),
        "warnings": drilled.warnings,
    }
    (folder / MARK).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
