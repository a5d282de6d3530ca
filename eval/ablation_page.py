# SPDX-License-Identifier: Apache-2.0
"""Result of an ablation as a page, Markdown and CSV."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from graphloc.eval.ablation import CONTRADICTS, Ablated, Effect, Vote, suspects
from graphloc.eval.formatting import percent
from graphloc.eval.html import drawing
from graphloc.eval.page import Cell, Grid, write_csv, write_markdown, write_page
from graphloc.eval.plots import COLOURS, TRUTH, Figure, Line, Mark, Panel, Points, peaks
from graphloc.time import seconds_since

MARK = "ablation.json"  # a folder with this file was written here, and may be replaced
_BETTER = 0.9  # ratio of the error without a sensor to that with it, below which the run is better without
# Distance of a suspect from a solution without two suspects, in sigmas and times the other's, from which it is blamed.
_LEANS, _LEANS_TIMES = 1.3, 3.0
_LEAST_M = 1e-3  # lower end of a logarithmic axis
_DIFFERENT_M = 0.02  # smaller differences are not mentioned

_BASIS = {
    "truth": "Errors are against truth, which was not fused.",
    "held": "No truth: errors are at GNSS fixes held out of all runs; they include the fixes' own noise.",
    "full": "No truth and no held-out fixes: distances are from the run with all sensors, which does not measure accuracy. "
    "The growth of the 95 % bounds shows what a sensor contributes; --hold-out every:5 would measure it.",
}


def said(ablated: Ablated) -> list[str]:
    """Return the result in sentences."""
    lines = _contradictions(ablated) or [
        f"No sensor contradicts the others: each is within {CONTRADICTS:g} sigmas of the run without it."
    ]
    lines += [_bought(e, ablated) for e in ablated.effects]
    lines.append(_BASIS[ablated.basis])
    if ablated.matched:
        lines.append(
            f"{', '.join(ablated.matched)}: its matches were made around the run with all sensors, in each run."
        )
    return [*lines, *(f"Warning: {text}" for text in ablated.warnings)]


def _bought(e: Effect, ablated: Ablated) -> str:
    full = ablated.full
    if e.why_not:
        return f"{e.without} cannot be left out: {e.why_not}"
    assert e.rmse_m is not None
    assert e.worst_m is not None
    bounds = f"95 % bound {e.bound_m:.2f} m instead of {full.bound_m:.2f} m"
    gone = f"; {percent(e.missing)} of the track is missing" if e.missing is not None and e.missing > 0.01 else ""
    if ablated.basis == "full" or full.rmse_m is None:
        return f"Without {e.without}: up to {e.worst_m:.2f} m from the run with all, at {e.worst_at_s:.0f} s; {bounds}{gone}."
    how = ""
    if e.rmse_m < _BETTER * full.rmse_m and full.rmse_m - e.rmse_m > _DIFFERENT_M:
        how = " BETTER:"
    elif abs(e.rmse_m - full.rmse_m) < _DIFFERENT_M:
        how = " hardly any difference:"
    return (
        f"Without {e.without}:{how} {e.worst_m:.2f} m at worst, at {e.worst_at_s:.0f} s ({full.worst_m:.2f} m with all); RMSE "
        f"{e.rmse_m:.2f} m instead of {full.rmse_m:.2f} m; {bounds}{gone}."
    )


def _contradictions(ablated: Ablated) -> list[str]:
    by, names = {e.without: e for e in ablated.effects}, suspects(ablated.effects)
    lines = [
        f"CONTRADICTION: {name} is typically {by[name].contradiction:.1f} sigmas from the run without it{_apart(by[name])}. Look at its mount, "
        "sign, frame, clock and noise"
        + ("." if len(names) == 1 else ", or at those of what it contradicts.")
        for name in names
    ]  # fmt: skip
    for vote in ablated.votes:
        lines.append(_verdict(vote))
    return lines


def _apart(e: Effect) -> str:
    sizes = [f"{v:.{d}f} {unit}" for v, unit, d in ((e.apart_m, "m", 2), (e.apart_deg, "deg", 1)) if v is not None]
    return f" ({', '.join(sizes)})" if sizes else ""


def _verdict(vote: Vote) -> str:
    offs = {vote.one: vote.one_off, vote.other: vote.other_off}
    if vote.one_off is None or vote.other_off is None:
        return f"Without both {vote.one} and {vote.other} there is no track: nothing tells which of them is wrong."
    distances = " and ".join(f"{n} by {v:.1f} sigmas" for n, v in offs.items())
    start = f"Without both {vote.one} and {vote.other}, what is left contradicts {distances}: "
    bad = [n for n, v in offs.items() if v is not None and v > CONTRADICTS]
    if len(bad) == 1:
        return f"{start}{bad[0]} is the likelier culprit."
    if bad:
        return start + "both are suspect, or what is left is."
    least, most = sorted(offs, key=lambda n: offs[n] or 0.0)
    if (offs[most] or 0.0) > max(_LEANS, _LEANS_TIMES * (offs[least] or 0.0)):
        return start + f"it leans against {most}."
    return start + "it cannot tell which is wrong."


def grids(ablated: Ablated) -> list[Grid]:
    """Return the table of contributions, and that of how the sensors fit each other."""
    every = (ablated.full, *ablated.effects)
    held = ablated.basis == "held"
    rows = tuple(_row(e) for e in every)
    bought = Grid(
        title="Without each sensor",
        head=(
            "without", "measurements", "RMSE", "worst", "at", "heading RMSE", "95 % bound", "heading bound", "cost / expected",
            "contradiction",
        ),
        rows=rows,
        note=(
            f"{_BASIS[ablated.basis]}{' The antenna is compared, so headings are not.' if held else ''} Bounds: the solution's own, "
            "median. Contradiction: how far the sensor's measurements are from the run without it, in sigmas of both together; "
            f"1 or less if all is well, above {CONTRADICTS:g} something is wrong with it or with the others. A bad "
            "sensor: without it errors or the cost fall. No count: its measurements come from the configuration."
        ),
    )  # fmt: skip
    names = [e.without for e in ablated.effects if any(other.fits.get(e.without) for other in every)]
    fits = tuple(
        (Cell(text=f"without {e.without}" if e.without else "with all"), *(_fit(e, name) for name in names))
        for e in every
        if not e.why_not
    )
    note = (
        "Median residual of a sensor's used measurements, in its own sigmas: 1 where its noise is configured right. A fit that "
        "improves when another sensor is left out points at that one."
    )
    return [bought, Grid(title="How well each sensor fits", head=("", *names), rows=fits, note=note)]


def _fit(e: Effect, name: str) -> Cell:
    value = e.fits.get(name)
    return Cell(text="-" if value is None or name == e.without else f"{value:.2f}")


def _number(value: float | None, unit: str, digits: int = 2) -> Cell:
    return Cell(text="-" if value is None else f"{value:.{digits}f}{unit}")


def _count(e: Effect) -> Cell:
    """Return the number of measurements as text; a sensor whose measurements the configuration makes has none."""
    return Cell(text=str(e.measurements) if e.measurements else "-")


def _row(e: Effect) -> tuple[Cell, ...]:
    bad = "bad" if (e.contradiction or 0.0) > CONTRADICTS else ""
    name = e.without if e.without else "(with all)"
    if e.why_not:
        return (
            Cell(text=f"{name} (cannot be left out)", mark="doubt"), _count(e), *[Cell(text="-")] * 8
        )  # fmt: skip
    return (
        Cell(text=name),
        _count(e),
        _number(e.rmse_m, " m"),
        _number(e.worst_m, " m"),
        _number(e.worst_at_s, " s", 0),
        _number(e.heading_rmse_deg, " deg"),
        _number(e.bound_m, " m"),
        _number(e.bound_deg, " deg"),
        _number(e.cost_ratio, ""),
        Cell(text=_number(e.contradiction, "").text, mark=bad),
    )


def over_time(ablated: Ablated) -> Figure:
    """Return the figure of distances over time since the track's begin, a line for each left-out sensor."""
    marks: list[Mark] = []
    for k, (name, away) in enumerate(ablated.over_time.items()):
        step = peaks(away.off_m)
        said, colour = f"without {name}" if name else "with all", COLOURS[(k - 1) % len(COLOURS)] if name else TRUTH
        x, y = seconds_since(ablated.begin_ns, away.stamps_ns[step]), np.maximum(away.off_m[step], _LEAST_M)
        if ablated.basis == "held":
            marks.append(Points(name=said, x=x, y=y, colour=colour))
        else:
            marks.append(Line(name=said, x=x, y=y, colour=colour, width=1.8))
    y_said = "distance, m" if ablated.basis == "full" else "error, m"
    panel = Panel(title="", y=y_said, marks=tuple(reversed(marks)), log_y=True)
    return Figure(name="time", x="time, s", panels=(panel,), height=420)


def write(ablated: Ablated, folder: Path, command: str) -> None:
    """Write ablation.html, .md, .csv and .json into an existing folder."""
    title = f"What each sensor bought: {ablated.vessel}, {Path(ablated.source).name}"
    lines, tables = said(ablated), grids(ablated)
    parts = [tables[0].as_html()]
    if ablated.over_time:  # empty if there is one sensor: then no run without it can be drawn
        parts += ["<h2>Over time</h2>", drawing(over_time(ablated))]
    parts.append(tables[1].as_html())
    write_page(folder / "ablation.html", title, lines, parts)
    write_markdown(folder / "ablation.md", title, lines, tables)
    every = [asdict(e) for e in (ablated.full, *ablated.effects)]
    flat = [{k: v for k, v in e.items() if k != "fits"} for e in every]
    write_csv(folder / "ablation.csv", flat)
    content = {"command": command, "basis": ablated.basis, "said": lines, "runs": every,
               "votes": [asdict(v) for v in ablated.votes], "warnings": ablated.warnings}  # fmt: skip
    (folder / MARK).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
