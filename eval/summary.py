# SPDX-License-Identifier: Apache-2.0
"""Summary of several finished runs: each run, mean and worst, as HTML, Markdown and CSV."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path
from urllib.parse import quote

from graphloc.errors import InputError
from graphloc.eval import html, markdown
from graphloc.eval.formatting import LABELS, number
from graphloc.folders import fresh_folder
from graphloc.outputs import MARK

SUMMARY = "summary.csv"  # a folder with this file was written here, and may be replaced
_MOST_BYTES = 50_000_000  # largest run.json that is read; that of twelve hours has some kB
# Numbers that are shown of each table; of other tables the first four. summary.csv has all.
_SHOWN = {
    "Against truth": ("position_rmse_m", "position_max_m", "heading_rmse_deg", "coverage_95"),
    "Against held-out fixes": ("horizontal_rmse_m", "horizontal_max_m", "outage_drift_m"),
    "Docking": ("sighted_rmse_m", "berth_p95_m", "lost", "wrong_side", "dnv_met"),
    "Forward speed": ("mean_mps", "std_mps"),
}
_LOWEST_IS_WORST = ("coverage_95", "heading_coverage_95", "matched", "dnv_met", "fixes")

Numbers = Mapping[str, Mapping[str, Mapping[str, float | None]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedRun:
    """Content of a run folder.

    Attributes:
        name: shortest unique path of the folder. folder: its path. tables: title -> estimate -> number -> value.
        warnings: of the run. converged: whether the solver did.
    """

    name: str
    folder: Path
    tables: Numbers
    warnings: tuple[str, ...]
    converged: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricTable:
    """One number (`metric`) of all runs: a row per run, a column per estimate; then mean and worst."""

    title: str
    metric: str
    estimates: tuple[str, ...]
    rows: tuple[tuple[str, tuple[float | None, ...]], ...]
    mean: tuple[float | None, ...]
    worst: tuple[float | None, ...]


def is_run(folder: Path) -> bool:
    """Return whether a folder is a finished run."""
    return (folder / MARK).is_file()


def read_runs(folders: Sequence[Path]) -> tuple[FinishedRun, ...]:
    """Read run folders.

    Raises:
        InputError: a folder is given twice, is not a run, or its run.json cannot be read.
    """
    whole = [folder.resolve() for folder in folders]
    twice = next((folder for k, folder in enumerate(whole) if folder in whole[:k]), None)
    if twice is not None:
        raise InputError(f"{twice}: given twice, so it would count twice")
    other = next((folder for folder in folders if not is_run(folder)), None)
    if other is not None:
        within = any(other.glob(f"*/{MARK}"))
        raise InputError(
            f"{other}: is not the folder of a finished run: it has no {MARK}{f'; those in it have: {other}/*' * within}"
        )
    short = [folder.name for folder in whole]
    names = [name if short.count(name) == 1 else str(folder) for name, folder in zip(short, folders, strict=True)]
    return tuple(_read(folder, name) for folder, name in zip(folders, names, strict=True))


def _read(folder: Path, name: str) -> FinishedRun:
    path = folder / MARK
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError("it is too large")
        run = json.loads(path.read_text(encoding="utf-8"))
        tables = {
            str(title): {
                str(estimate): {str(k): _number(v) for k, v in values.items()} for estimate, values in rows.items()
            }
            for title, rows in run["metrics"].items()
        }
        converged, warnings = bool(run["stats"]["converged"]), tuple(map(str, run["warnings"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        said = error.strerror if isinstance(error, OSError) else str(error)[:80]
        raise InputError(f"{path}: is not that of a run ({said}); make the run again") from None
    return FinishedRun(name=name, folder=folder, tables=tables, warnings=warnings, converged=converged)


def _number(value: object) -> float | None:
    """Return a value as a number; integers stay integers."""
    return value if value is None or type(value) is int else float(value)  # type: ignore[arg-type]


def metric_tables(runs: Sequence[FinishedRun], *, shown_only: bool = True) -> list[MetricTable]:
    """Return each number of each table that a run has; `shown_only`: only the main ones."""
    found = []
    for title in dict.fromkeys(t for run in runs for t in run.tables):
        having = [run for run in runs if title in run.tables]
        metrics = list(dict.fromkeys(m for run in having for row in run.tables[title].values() for m in row))
        shown = _shown(title, metrics) if shown_only else metrics
        found += [_metric_table(title, metric, having) for metric in shown]
    return found


def _metric_table(title: str, metric: str, having: Sequence[FinishedRun]) -> MetricTable:
    """Return the table of one number over runs; `having`: the runs whose tables of that title have the number."""
    estimates = tuple(dict.fromkeys(e for run in having for e in run.tables[title]))
    rows = tuple((run.name, tuple(run.tables[title].get(e, {}).get(metric) for e in estimates)) for run in having)
    columns = [[v for v in column if v is not None] for column in zip(*(v for _, v in rows), strict=True)]
    return MetricTable(
        title=title, metric=metric, estimates=estimates, rows=rows,
        mean=tuple(sum(c) / len(c) if c else None for c in columns),
        worst=tuple(_worst(metric, c) for c in columns),
    )  # fmt: skip


def _shown(title: str, metrics: Sequence[str]) -> Sequence[str]:
    return [m for m in _SHOWN[title] if m in metrics] if title in _SHOWN else metrics[:4]


def _worst(metric: str, values: Sequence[float]) -> float | None:
    if not values:
        return None
    return min(values) if metric in _LOWEST_IS_WORST else max(values, key=abs)


def write_summary(folder: Path, runs: Sequence[FinishedRun], *, overwrite: bool) -> Path:
    """Write `summary.html`, `.md` and `.csv` into a folder; return the path of the page.

    Raises:
        OutputError: the folder exists and may not be replaced, or cannot be written.
    """
    found = metric_tables(runs)
    with fresh_folder(folder, overwrite=overwrite, mark=SUMMARY) as fresh:
        with (fresh / SUMMARY).open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(("run", "table", "number", "estimate", "value"))
            writer.writerows(_csv_rows(runs))
        (fresh / "summary.md").write_text(as_markdown(runs, found), encoding="utf-8")
        (fresh / "summary.html").write_text(_page(runs, found, folder), encoding="utf-8")
    return folder / "summary.html"


def _csv_rows(runs: Sequence[FinishedRun]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of summary.csv: all numbers of all runs; mean and worst as runs whose names no folder has."""
    for table in metric_tables(runs, shown_only=False):
        for run, values in (*table.rows, ("(mean)", table.mean), ("(worst)", table.worst)):
            for estimate, value in zip(table.estimates, values, strict=True):
                if value is not None:
                    yield run, table.title, table.metric, estimate, f"{value:.6g}"


def _lines(table: MetricTable) -> list[tuple[str, ...]]:
    """Return the rows of a table as text; the last one has the ratio of each estimate to the first."""
    rows = [*table.rows, ("mean of the runs", table.mean), ("worst of the runs", table.worst)]
    whole = all(v is None or isinstance(v, int) for _, values in table.rows for v in values)
    digits = 1 if whole else 3  # of counts, a mean needs one
    lines = [(name, *(number(v, digits) for v in values)) for name, values in rows]
    if len(table.estimates) > 1 and table.metric.endswith(("_m", "_deg", "std_mps")):
        over = (_over_first([values for _, values in table.rows], k) for k in range(1, len(table.estimates)))
        ratios = ("-" if ratio is None else f"{ratio:.1f} x" for ratio in over)
        lines.append((f"times the mean of {table.estimates[0]}", "", *ratios))
    return lines


def _words(metric: str) -> str:
    return f"{LABELS[metric]} ({metric})" if metric in LABELS else metric


def _over_first(rows: Sequence[Sequence[float | None]], k: int) -> float | None:
    """Return the ratio of the means of column k and of the first column, over the runs that have both values."""
    both = [(a, b) for row in rows if (a := row[0]) is not None and (b := row[k]) is not None]
    mine = sum(a for a, _ in both)
    return sum(b for _, b in both) / mine if mine else None


def as_markdown(runs: Sequence[FinishedRun], found: Sequence[MetricTable]) -> str:
    """Return the summary as Markdown."""
    text = [f"# {_title(runs)}", "", *_remarks(runs), ""]
    for table in found:
        head = ["", *table.estimates]
        text += [f"## {table.title}: {_words(table.metric)}", ""]
        text += [markdown.row(head), "|---|" + "---:|" * len(table.estimates)]
        text += [markdown.row(line) for line in _lines(table)]
        text.append("")
    return "\n".join(text)


def _title(runs: Sequence[FinishedRun]) -> str:
    return f"{len(runs)} run{'s' * (len(runs) != 1)}"


def _remarks(runs: Sequence[FinishedRun]) -> list[str]:
    """Return remarks on runs, each once with the names of its runs: most warnings of a vessel come with every run."""
    of: dict[str, list[str]] = {}
    for run in runs:
        unsettled, alone = not run.converged, not run.tables
        said = ["the solver did not converge"] * unsettled + ["nothing to compare it with"] * alone
        for line in dict.fromkeys([*said, *(f"warning: {line}" for line in run.warnings)]):
            of.setdefault(line, []).append(run.name)
    return [f"- {', '.join(names)}: {line}" for line, names in of.items()]


def _page(runs: Sequence[FinishedRun], found: Sequence[MetricTable], folder: Path) -> str:
    links = " ".join(
        f'<a href="{quote(Path(os.path.relpath(run.folder / "report.html", folder)).as_posix())}">{escape(run.name)}</a>'
        for run in runs
    )
    remarks = "".join(f'<li class="warning">{escape(line[2:])}</li>' for line in _remarks(runs))
    body = [f'<ul class="warnings">{remarks}</ul>'] if remarks else []
    for title, group in groupby(found, key=lambda b: b.title):
        body.append(f"<h2>{escape(title)}</h2>")
        for table in group:
            lines = _lines(table)
            classes = [""] * len(table.rows) + ["part ours", "ours"]
            head = ("", *table.estimates)
            body.append(f"<h3>{escape(_words(table.metric))}</h3>{html.table(head, lines, classes)}")
    note = html.note(
        "Mean and worst are over the runs that have the number; summary.csv has every number of every run."
    )
    return html.page(_title(runs), f"<h1>{_title(runs)}</h1><nav>{links}</nav>{note}{''.join(body)}")
