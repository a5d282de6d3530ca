# SPDX-License-Identifier: Apache-2.0
"""How good runs are: compare, summary."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from graphloc.cli._shared import (
    BagArgument,
    ConfigOption,
    DurationOption,
    FiguresOption,
    HoldOutOption,
    JsonOption,
    OutOption,
    OverwriteOption,
    RerunOption,
    StartOption,
    Wanted,
    smooth_bags,
)

RunsArgument = Annotated[list[Path], typer.Argument(help="The run folders of `smooth`, `compare` or `replay`.")]


def compare(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    start: StartOption = 0.0,
    duration: DurationOption = None,
    hold_out: HoldOutOption = None,
    figures: FiguresOption = False,
    rerun: RerunOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Smooth a run, run the online mode and the EKFs on the same measurements, and report all of them."""
    from graphloc.errors import ConfigError
    from graphloc.eval.summary import is_run

    finished = next((folder for folder in bag if is_run(folder)), None)
    if finished is not None:
        raise ConfigError(
            f"{finished}: is a finished run, not a bag; `graphloc summary` puts finished runs into one table"
        )
    wanted = Wanted(
        bag=bag, config=config, out=out, overwrite=overwrite, as_json=as_json, figures=figures, rerun=rerun, start=start, duration=duration
    )  # fmt: skip
    smooth_bags(wanted, hold_out, compare=True)


def summary(
    runs: RunsArgument,
    out: OutOption,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Put the numbers of finished runs into one table: a row per run, the mean and the worst."""
    from graphloc.eval import summary as summaries

    read = summaries.read_runs(runs)
    page = summaries.write_summary(out, read, overwrite=overwrite)
    found = summaries.blocks(read)
    if as_json:
        told = {
            f"{b.title}: {b.metric}": {
                name: dict(zip(b.estimates, values, strict=True))
                for name, values in (("mean", b.mean), ("worst", b.worst))
            }
            for b in found
        }
        typer.echo(json.dumps(told, indent=2))
    else:
        typer.echo(summaries.as_markdown(read, found))
    typer.echo(str(page))
