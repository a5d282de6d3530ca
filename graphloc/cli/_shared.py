# SPDX-License-Identifier: Apache-2.0
"""What commands share: options, progress, how a run is told."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphloc.errors import GraphlocError

if TYPE_CHECKING:  # heavy: they wait until a command runs
    from graphloc.app import Run, Scans
    from graphloc.config import VesselConfig
    from graphloc.frontends._part import BagPart
    from graphloc.recording import Recording


class Stopped(GraphlocError):
    """Ctrl-C, and what became of the work so far."""


BagArgument = Annotated[list[Path], typer.Argument(help="A ROS 1 or ROS 2 bag; give all files of a split one.")]
StartOption = Annotated[
    float, typer.Option("--start", help="Skip this many seconds at the start of the bag (recording time).")
]
DurationOption = Annotated[
    float | None, typer.Option("--duration", help="Use only this many seconds of the bag; default: to its end.")
]
ConfigOption = Annotated[Path, typer.Option("--config", "-c", help="The vessel.yaml.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")]
HoldOutOption = Annotated[
    str | None, typer.Option("--hold-out", help="Withhold GNSS fixes and predict them: every:N or gaps:COUNTxSECONDS.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output.")]
FiguresOption = Annotated[bool, typer.Option("--figures", help="Also write the figures as PNG and SVG.")]
RerunOption = Annotated[
    Path | None, typer.Option("--rerun", help="Also write the run for the rerun viewer: out.rrd (docs/rerun.md).")
]
LagOption = Annotated[
    float, typer.Option("--lag", min=1.0, help="Length of the sliding window, s; a measurement may come this late.")
]
JobsOption = Annotated[int | None, typer.Option("--jobs", min=1, help="Parallel processes; default: one per core.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Random seed: the same seed gives the same run.")]
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


def print_run(run: Run, page: Path, as_json: bool, rerun: Path | None = None) -> None:
    from graphloc import app as application
    from graphloc.eval import report

    data = application.report_data(run)
    found, warnings = data.tables, data.warnings
    if as_json:
        numbers = {t.title: t.as_dict() for t in found}
        verdicts = {
            t.name: {"said": t.trust.said, "why": [r.text for r in t.reasons]} for t in report.verdict(data).tracks
        }
        told: dict[str, object] = {
            "verdict": verdicts,
            "ledger": run.solution.ledger.counts(),
            "converged": run.solution.stats.converged,
            "warnings": warnings,
        }
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


def write_rerun(path: Path | None, run: Run, bags: BagPart, config: Path) -> None:
    from graphloc.eval import rerun_log

    if path is not None:
        told = (run.solution, run.recording, run.config, run.filters)
        rerun_log.write_rerun(path, *told, bags=bags, folder=config.parent)


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What a command is to read and write: as its options have it."""

    bag: list[Path]
    config: Path
    out: Path
    overwrite: bool
    as_json: bool
    figures: bool = False
    rerun: Path | None = None
    start: float = 0.0
    duration: float | None = None

    @property
    def part(self) -> BagPart:
        """The bag, or the part of it that is wanted."""
        from graphloc.frontends._part import BagPart

        return BagPart(tuple(self.bag), self.start, self.duration)

    def check(self, mark: str = "") -> None:
        """Refuse before the work what could not be written after it; `mark`: the file by which a folder is known as ours."""
        from graphloc import outputs

        outputs.check_folder(self.out, overwrite=self.overwrite, mark=mark or outputs.MARK)
        check_rerun(self.rerun, self.overwrite)

    def load(self, show: Callable[[str, int, int], None]) -> tuple[Recording, VesselConfig, Scans]:
        """Read the bag and its vessel.yaml; of a part of the bag say which it is."""
        from graphloc import app as application

        recording, vessel = application.load(self.part, self.config, show)
        if recording.span is not None:
            typer.echo(f"{', '.join(str(p) for p in self.bag)}: {recording.span}", err=True)
        return recording, vessel, application.Scans(self.part, self.config.parent)

    def write(self, run: Run) -> None:
        """Write the run folder, and tell of it."""
        from graphloc import app as application

        command = " ".join(sys.argv[1:])
        page = application.write(
            run, self.out, inputs=self.bag, command=command, overwrite=self.overwrite, figures=self.figures
        )
        write_rerun(self.rerun, run, self.part, self.config)
        print_run(run, page, self.as_json, self.rerun)

    def write_page(self, page: str, mark: str, write: Callable[[Path, str], None], said: Sequence[str]) -> None:
        """Write a folder with a page, and tell of it: its `mark`, which is JSON, or the lines `said`."""
        from graphloc import outputs

        with outputs.fresh_folder(self.out, overwrite=self.overwrite, mark=mark) as fresh:
            write(fresh, " ".join(sys.argv[1:]))
        if self.as_json:
            typer.echo((self.out / mark).read_text(encoding="utf-8"), nl=False)
        else:
            for line in said:
                typer.echo(line)
            typer.echo(str(self.out / page))


def smooth_bags(wanted: Wanted, hold_out: str | None = None, *, compare: bool) -> None:
    from graphloc import app as application
    from graphloc.eval.holdout import HoldOut

    held = None if hold_out is None else HoldOut.parse(hold_out)
    wanted.check()
    show = progress()
    recording, vessel, scans = wanted.load(show)
    run = application.smooth_recording(recording, vessel, hold_out=held, compare=compare, scans=scans, progress=show)
    wanted.write(run)
