# SPDX-License-Identifier: Apache-2.0
"""Commands that measure how good runs are: compare, summary."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from graphloc.cli._shared import HoldOutOption, JsonOption, OutOption, OverwriteOption, RunOptions, smooth_bags

RunsArgument = Annotated[list[Path], typer.Argument(help="The run folders of `smooth`, `compare` or `replay`.")]


def compare(options: RunOptions, hold_out: HoldOutOption = None) -> None:
    """Smooth a run, run the online mode and the EKFs on the same measurements, and report all of them."""
    from graphloc.errors import ConfigError
    from graphloc.eval.summary import is_run

    finished = next((folder for folder in options.bag if is_run(folder)), None)
    if finished is not None:
        raise ConfigError(
            f"{finished}: is a finished run, not a bag; `graphloc summary` puts finished runs into one table"
        )
    smooth_bags(options, hold_out, compare=True)


def summary(
    runs: RunsArgument,
    out: OutOption,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Put the numbers of finished runs into one table: one row per run, the mean and the worst."""
    from graphloc.eval import summary as summaries

    read = summaries.read_runs(runs)
    page = summaries.write_summary(out, read, overwrite=overwrite)
    found = summaries.metric_tables(read)
    if as_json:
        numbers = {
            f"{t.title}: {t.metric}": {
                name: dict(zip(t.estimates, values, strict=True))
                for name, values in (("mean", t.mean), ("worst", t.worst))
            }
            for t in found
        }
        typer.echo(json.dumps(numbers, indent=2))
    else:
        typer.echo(summaries.as_markdown(read, found))
    typer.echo(str(page))
