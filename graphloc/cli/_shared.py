# SPDX-License-Identifier: Apache-2.0
"""What commands share: options, progress, how a run is told."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from graphloc.errors import GraphlocError


class Stopped(GraphlocError):
    """Ctrl-C, and what became of the work so far."""


BagArgument = Annotated[list[Path], typer.Argument(help="A ROS 1 or ROS 2 bag; several for the parts of a split one.")]
ConfigOption = Annotated[Path, typer.Option("--config", "-c", help="The vessel.yaml.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")]
HoldOutOption = Annotated[
    str | None, typer.Option("--hold-out", help="Keep fixes out and predict them: every:N, or gaps:COUNTxSECONDS.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what is there already.")]
FiguresOption = Annotated[bool, typer.Option("--figures", help="Write the figures as PNG and SVG, too.")]
RerunOption = Annotated[
    Path | None, typer.Option("--rerun", help="Write the run for the rerun viewer, too: out.rrd (docs/rerun.md).")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")]


def progress() -> Callable[[str, int, int], None]:
    """A progress bar on stderr, on a terminal only."""
    from tqdm import tqdm

    state: dict[str, tqdm[None]] = {}

    def show(stage: str, done: int, total: int) -> None:
        for name in [n for n in state if n != stage]:
            state.pop(name).close()
        if stage not in state:
            state[stage] = tqdm(total=total, desc=stage, disable=None, file=sys.stderr, leave=False)
        state[stage].n = done
        state[stage].refresh()
        if done >= total:
            state.pop(stage).close()

    return show


def status_line() -> Callable[[float, float, object, str], None]:
    """A live line on stderr, on a terminal only."""
    import time

    from graphloc.estimate import Estimate

    shown_s, live = 0.0, sys.stderr.isatty()
    begun = time.monotonic()

    def show(at_s: float, whole_s: float, estimate: object, waiting: str) -> None:
        nonlocal shown_s
        if not live or (time.monotonic() - shown_s < 0.2 and at_s < whole_s - 0.2):
            return
        shown_s = time.monotonic()
        text = f"{at_s:7.1f} of {whole_s:.0f} s, {at_s / max(shown_s - begun, 1e-3):.1f} x: "
        if isinstance(estimate, Estimate):
            since = ", ".join(f"{name} {s:.1f} s" for name, s in estimate.since_agreed_s.items())
            text += f"{estimate.health}, within {estimate.bound_95_m:.2f} m; agreed: {since}"
        else:
            text += f"waiting for {waiting}"
        sys.stderr.write(f"\r\033[K{text[:118]}")
        sys.stderr.flush()

    return show


def print_run(run: object, page: Path, as_json: bool, rerun: Path | None = None) -> None:
    from graphloc import app as application
    from graphloc.eval import report

    assert isinstance(run, application.Run)
    data = application.report_data(run)
    found, warnings = data.tables, data.warnings
    if as_json:
        numbers = {t.title: t.as_dict() for t in found}
        told = {"ledger": run.solution.ledger.counts(), "converged": run.solution.stats.converged, "warnings": warnings}
        if run.calibration is not None:
            told["calibration"] = run.calibration.as_dict()
        typer.echo(json.dumps({**numbers, **told}, indent=2))
    else:
        if not found:
            typer.echo(application.truth_statement(run))
        for table in found:
            typer.echo(table.as_text())
        for track in report.verdict(data).tracks:
            typer.echo(f"{track.name}: {track.trust.said}. {track.accuracy}")
            for reason in track.reasons:
                if reason.trust is not report.Trust.YES:
                    typer.echo(f"  {reason.text}")
        for name, counts in run.solution.ledger.counts().items():
            typer.echo(f"  {name}: " + ", ".join(f"{n} {outcome}" for outcome, n in counts.items()))
        for warning in warnings:
            typer.echo(f"warning: {warning}", err=True)
        for suggestion in run.calibration.suggestions if run.calibration is not None else ():
            typer.echo(f"calibration: {suggestion}", err=True)
    typer.echo(str(page))
    if rerun is not None:
        typer.echo(str(rerun))


def check_rerun(path: Path | None, overwrite: bool) -> None:
    """Say before the run is solved what would be said after."""
    from graphloc.errors import OutputError
    from graphloc.eval.rerun_log import make_folder
    from graphloc.extras import need
    from graphloc.outputs import check_writable

    if path is None:
        return
    need("rerun", "rerun")
    if path.is_dir() or (path.exists() and not overwrite):
        raise OutputError(f"{path}: exists already; give another --rerun, or --overwrite")
    make_folder(path)
    check_writable(path)


def write_rerun(path: Path | None, run: object, bag: list[Path], config: Path) -> None:
    from graphloc import app as application
    from graphloc.eval import rerun_log

    if path is not None:
        assert isinstance(run, application.Run)
        told = (run.solution, run.recording, run.config, run.filters)
        rerun_log.write_rerun(path, *told, bags=bag, folder=config.parent)


def smooth_bags(
    bag: list[Path],
    config: Path,
    out: Path,
    hold_out: str | None,
    overwrite: bool,
    as_json: bool,
    compare: bool,
    figures: bool = False,
    rerun: Path | None = None,
) -> None:
    from graphloc import app as application
    from graphloc import outputs
    from graphloc.eval.holdout import HoldOut

    held = None if hold_out is None else HoldOut.parse(hold_out)
    outputs.check_folder(out, overwrite=overwrite)
    check_rerun(rerun, overwrite)
    show = progress()
    recording, vessel = application.load(bag, config, show)
    scans = application.Scans(tuple(bag), config.parent)
    run = application.smooth_recording(recording, vessel, hold_out=held, compare=compare, scans=scans, progress=show)
    command = " ".join(sys.argv[1:])
    report = application.write(run, out, inputs=bag, command=command, overwrite=overwrite, figures=figures)
    write_rerun(rerun, run, bag, config)
    print_run(run, report, as_json, rerun)
