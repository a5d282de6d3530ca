# SPDX-License-Identifier: Apache-2.0
"""Table of a sweep: rows of a run, `table.parquet`, and `summary.md` with mean and worst of each case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from graphloc.errors import OutputError
from graphloc.eval import markdown
from graphloc.eval.metrics import Table
from graphloc.extras import need
from graphloc.solution import Health, Solution

Row = Mapping[str, Any]

_PREFIX = {"Against truth": "", "Against held-out fixes": "held_out_", "Forward speed": "speed_"}
# Columns of the summary: name, title, digits, and which end is the worst.
_SHOWN = (
    ("position_rmse_m", "position RMSE, m", 3, max),
    ("position_max_m", "largest error, m", 2, max),
    ("heading_rmse_deg", "heading RMSE, deg", 2, max),
    ("coverage_95", "inside the 95 % bound", 3, min),
    ("held_out_horizontal_rmse_m", "held-out fixes, RMSE, m", 3, max),
    ("held_out_horizontal_max_m", "held-out fixes, largest, m", 2, max),
    ("speed_std_mps", "forward speed, std, m/s", 3, max),
)
_FAILURES = 20  # most failed runs that the summary names


def rows_of(solution: Solution, tables: Sequence[Table], warnings: int) -> list[dict[str, Any]]:
    """Return a row per estimate, with its numbers as columns; the row of the solution also has the solver's statistics.

    Args:
        solution: of the run. tables: of the run, with a row per estimate. warnings: their number, without the solver's.
    """
    found: dict[str, dict[str, Any]] = {}
    for table in tables:
        prefix = _PREFIX.get(table.title, table.title.lower().replace(":", "").replace(" ", "_") + "_")
        for name, values in table.as_dict().items():
            found.setdefault(name, {"estimate": name, "error": ""}).update({prefix + k: v for k, v in values.items()})
    counts = solution.ledger.counts()
    found[solution.name] |= {
        "good": sum(h is Health.GOOD for h in solution.health) / len(solution.health),
        "converged": solution.stats.converged,
        "iterations": solution.stats.iterations,
        "messages": len(solution.ledger),
        "used": sum(n for outcomes in counts.values() for outcome, n in outcomes.items() if outcome == "used"),
        "warnings": warnings + len(solution.stats.warnings),
    }
    return list(found.values())


def write(table: Sequence[Row], folder: Path) -> None:
    """Write the table and its summary.

    Raises:
        OutputError: a file cannot be written.
    """
    pyarrow, parquet = need("pyarrow", "sweep"), need("pyarrow.parquet", "sweep")
    names = list(dict.fromkeys(name for row in table for name in row))
    columns = {name: _column([row.get(name) for row in table]) for name in names}
    try:
        parquet.write_table(pyarrow.table(columns), folder / "table.parquet")
        (folder / "summary.md").write_text(summary(table), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror})") from None


def _column(values: list[Any]) -> list[Any]:
    """Return a column as numbers if all of its values are such: parameters come as text."""
    try:
        return [float(v) if isinstance(v, str) else v for v in values]
    except ValueError:
        return values


def summary(table: Sequence[Row]) -> str:
    """Return the table as Markdown: mean and worst of each case and estimate, then the runs that failed."""
    failed = [row for row in table if row["error"]]
    runs = len({row["run"] for row in table})
    shown = [item for item in _SHOWN if any(row.get(item[0]) is not None for row in table)]
    lines = [
        "# Sweep",
        "",
        f"{runs} run{'s' * (runs != 1)}, {len(failed)} failed. In each cell: mean, worst (seed of the worst).",
        "",
        markdown.row(["case", "estimate", "runs", *(title for _, title, _, _ in shown)]),
        "|---|---|---|" + "---|" * len(shown),
    ]
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in table:
        if not row["error"]:
            groups.setdefault((row["case"], row["estimate"]), []).append(row)
    for (case, estimate), rows in groups.items():
        cells = [_cell(rows, column, digits, worst) for column, _, digits, worst in shown]
        lines.append(markdown.row([case, estimate, str(len(rows)), *cells]))
    if failed:
        lines += ["", "Failed:", ""]
        lines += [
            f"- {row['case']}{_seed(row, ', seed ')}: {row['error'].removeprefix(row['case'] + ': ')}"
            for row in failed[:_FAILURES]
        ]
        lines += [f"- and {len(failed) - _FAILURES} more"] if len(failed) > _FAILURES else []
    return "\n".join([*lines, ""])


def _cell(rows: Sequence[Row], column: str, digits: int, worst: Any) -> str:
    having = [row for row in rows if row.get(column) is not None]
    if not having:
        return "-"
    mean = sum(row[column] for row in having) / len(having)
    end = worst(having, key=lambda row: row[column])
    return f"{mean:.{digits}f}, {end[column]:.{digits}f}{_seed(end, ' (', ')')}"


def _seed(row: Row, before: str, after: str = "") -> str:
    return f"{before}{row['seed']}{after}" if row.get("seed") is not None else ""
