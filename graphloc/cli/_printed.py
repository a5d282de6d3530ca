# SPDX-License-Identifier: Apache-2.0
"""What a command prints of a run: its numbers, its verdict, its ledger, as text or JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from graphloc.errors import printable
from graphloc.ledger import Ledger, Outcome
from graphloc.signals.thinning import THINNED

if TYPE_CHECKING:  # these load gtsam and more, which would delay --help
    from graphloc.app import Run
    from graphloc.eval.report import ReportData


def print_run(run: Run, page: Path, as_json: bool) -> None:
    """Print the numbers, verdict, ledger counts and warnings of a run, then the path of its report."""
    from graphloc import app as application

    data = application.report_data(run)
    if as_json:
        typer.echo(json.dumps(_as_json(run, data), indent=2))
    else:
        for line in _as_text(run, data):
            typer.echo(line)
        for warning in data.warnings:
            typer.echo(printable(f"warning: {warning}"), err=True)
        for suggestion in run.calibration.suggestions if run.calibration is not None else ():
            typer.echo(f"calibration: {suggestion}", err=True)
    typer.echo(str(page))


def _as_json(run: Run, data: ReportData) -> dict[str, object]:
    from graphloc.eval import report

    tracks = report.verdict(data).tracks
    result: dict[str, object] = {table.title: table.as_dict() for table in data.tables}
    result |= {
        "verdict": {t.name: {"said": t.trust.said, "why": [r.text for r in t.reasons]} for t in tracks},
        "ledger": run.solution.ledger.counts(),
        "converged": run.solution.stats.converged,
        "warnings": data.warnings,
    }
    if run.calibration is not None:
        result["calibration"] = run.calibration.as_dict()
    return result


def _as_text(run: Run, data: ReportData) -> Iterator[str]:
    from graphloc.eval import report

    yield from (table.as_text() for table in data.tables)
    if not data.tables:
        yield data.truth_statement
    for track in report.verdict(data).tracks:
        yield f"{track.name}: {track.trust.said}. {track.accuracy}"
        yield from (f"  {reason.text}" for reason in track.reasons if reason.trust is not report.Trust.YES)
    yield from counted(run.solution.ledger)


def counted(ledger: Ledger) -> Iterator[str]:
    """Yield a line per sensor (or topic): messages by outcome, those apart that were only too close together, which is no fault."""
    close = {name: n for (name, _, reason), n in ledger.reasons().items() if reason == THINNED}
    for name, counts in ledger.counts().items():
        apart = f" ({close[name]} of them only as too close to the one before)" if name in close else ""
        yield f"  {name}: " + ", ".join(
            f"{n} {outcome}{apart if outcome == Outcome.REJECTED else ''}" for outcome, n in counts.items()
        )
