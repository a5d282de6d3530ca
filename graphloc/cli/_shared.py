# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and what these commands do alike."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graphloc.cli._printed import print_run
from graphloc.cli._progress import progress
from graphloc.errors import GraphlocError

if TYPE_CHECKING:  # these load gtsam and more, which would delay --help
    from graphloc.app import Run, Scans
    from graphloc.config import VesselConfig
    from graphloc.frontends.part import BagPart
    from graphloc.recording import Progress, Recording


class Stopped(GraphlocError):
    """Ctrl-C was pressed; the message says what is kept of the work so far."""


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
    str | None,
    typer.Option(
        "--hold-out",
        help="Withhold GNSS fixes and predict them: every:N, or gaps:COUNTxSECONDS (GNSS velocities in the gaps are withheld, too).",
    ),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output.")]
FiguresOption = Annotated[bool, typer.Option("--figures", help="Also write the figures as PNG and SVG.")]
RerunOption = Annotated[
    Path | None, typer.Option("--rerun", help="Also write the run for the rerun viewer: out.rrd (docs/rerun.md).")
]
LagOption = Annotated[
    float, typer.Option("--lag", min=1.0, help="Length of the sliding window, s; measurements may arrive this late.")
]
JobsOption = Annotated[int | None, typer.Option("--jobs", min=1, help="Parallel processes; default: one per core.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Random seed: the same seed gives the same run.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")]


def _check_rerun(path: Path, overwrite: bool) -> None:
    """Refuse a rerun recording that could not be written, before the run is solved."""
    from graphloc.errors import OutputError
    from graphloc.eval.rerun_log import make_folder
    from graphloc.extras import need
    from graphloc.folders import check_writable

    need("rerun", "rerun")
    if path.is_dir() or (path.exists() and not overwrite):
        raise OutputError(f"{path}: exists already; give another --rerun, or --overwrite")
    make_folder(path)
    check_writable(path)


@dataclass(frozen=True, slots=True, kw_only=True)
class BagOptions:
    """Options of every command that reads a bag."""

    bag: BagArgument
    config: ConfigOption
    start: StartOption = 0.0
    duration: DurationOption = None

    @property
    def part(self) -> BagPart:
        """The bag, or the part of it between --start and --duration."""
        from graphloc.frontends.part import BagPart

        return BagPart(tuple(self.bag), self.start, self.duration)

    def load(self, show: Progress) -> tuple[Recording, VesselConfig, Scans]:
        """Read the bag and its vessel.yaml; of a part of the bag, print which it is."""
        from graphloc import app as application

        recording, vessel = application.load(self.part, self.config, show)
        if recording.span is not None:
            typer.echo(f"{', '.join(str(p) for p in self.bag)}: {recording.span}", err=True)
        gc.freeze()  # as in `graphloc.stream`: what is loaded stays
        return recording, vessel, application.Scans(self.part, self.config.parent)


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderOptions(BagOptions):
    """Options of every command that reads a bag and writes a folder with a page."""

    out: OutOption
    overwrite: OverwriteOption = False
    as_json: JsonOption = False

    def check(self, mark: str) -> None:
        """Refuse an output folder that could not be written, before the work begins.

        Args:
            mark: name of the file that shows that a folder was written by this command, so that it may be replaced.

        Raises:
            OutputError: it exists, or the disk refuses.
        """
        from graphloc.folders import check_folder

        check_folder(self.out, overwrite=self.overwrite, mark=mark)

    def write_page(self, page: str, mark: str, write: Callable[[Path, str], None], summary: Sequence[str]) -> None:
        """Write the folder and print a summary of it.

        Args:
            page: name of the page. mark: as for `check`; it holds JSON, which is printed for --json.
            write: fills a folder, given the command line. summary: lines to print otherwise.
        """
        from graphloc.folders import fresh_folder

        with fresh_folder(self.out, overwrite=self.overwrite, mark=mark) as fresh:
            write(fresh, " ".join(sys.argv[1:]))
        if self.as_json:
            typer.echo((self.out / mark).read_text(encoding="utf-8"), nl=False)
        else:
            for line in (*summary, str(self.out / page)):
                typer.echo(line)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions(FolderOptions):
    """Options of every command that reads a bag and writes a run folder."""

    figures: FiguresOption = False
    rerun: RerunOption = None

    def check_outputs(self) -> Sequence[Path]:
        """Refuse outputs that could not be written, before the run is solved; return what the run is made of.

        Raises:
            OutputError: one exists, or the disk refuses. ExtraError: rerun is not installed. ConfigError: vessel.yaml cannot be used.
        """
        from graphloc import app as application
        from graphloc import outputs

        self.check(outputs.MARK)
        if self.rerun is not None:
            _check_rerun(self.rerun, self.overwrite)
        return application.inputs_of(self.bag, self.config)

    def write(self, run: Run, inputs: Sequence[Path]) -> None:
        """Write the run folder and the rerun recording, and print a summary of the run; `inputs`: what it is made of."""
        from graphloc import app as application
        from graphloc.eval import rerun_log

        command = " ".join(sys.argv[1:])
        page = application.write(
            run,
            self.out,
            inputs=inputs,
            command=command,
            overwrite=self.overwrite,
            figures=self.figures,
        )
        if self.rerun is not None:
            rerun_log.write_rerun(
                self.rerun, run.solution, run.recording, run.config, run.filters, bags=self.part, folder=self.config.parent
            )  # fmt: skip
        print_run(run, page, self.as_json)
        if self.rerun is not None:
            typer.echo(str(self.rerun))


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that takes the fields of its dataclass parameters one by one, as typer needs them."""
    groups: dict[str, Any] = {}
    parameters: list[Parameter] = []
    for name, parameter in signature(command, eval_str=True).parameters.items():
        group = parameter.annotation
        if isinstance(group, type) and is_dataclass(group):
            groups[name] = group
            parameters += signature(group, eval_str=True).parameters.values()
        else:
            parameters.append(parameter.replace(kind=Parameter.KEYWORD_ONLY))

    @wraps(command)
    def flat(**values: Any) -> None:
        made = {name: group(**{f.name: values.pop(f.name) for f in fields(group)}) for name, group in groups.items()}
        command(**made, **values)

    flat.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    return flat


def smooth_bags(options: RunOptions, hold_out: str | None = None, *, compare: bool) -> None:
    """Smooth a bag and write its run folder.

    Args:
        hold_out: as `HoldOut.parse` reads it. compare: also run the online mode and the EKFs.
    """
    from graphloc import app as application
    from graphloc.eval.holdout import HoldOut

    held = None if hold_out is None else HoldOut.parse(hold_out)
    inputs = options.check_outputs()
    show = progress()
    recording, vessel, scans = options.load(show)
    run = application.smooth_recording(recording, vessel, hold_out=held, compare=compare, scans=scans, progress=show)
    options.write(run, inputs)
