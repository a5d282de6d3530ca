# SPDX-License-Identifier: Apache-2.0
"""How good it is, and what it can bear: compare."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from graphloc.cli._shared import (
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

_BagsOrRuns = Annotated[
    list[Path], typer.Argument(help="A bag (all files of a split one), or the folders of finished runs.")
]
_ConfigIfBag = Annotated[
    Path | None, typer.Option("--config", "-c", help="The vessel.yaml of a bag; run folders need none.")
]


def compare(
    bag: _BagsOrRuns,
    out: OutOption,
    config: _ConfigIfBag = None,
    start: StartOption = 0.0,
    duration: DurationOption = None,
    hold_out: HoldOutOption = None,
    figures: FiguresOption = False,
    rerun: RerunOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Smooth a run, run the online mode and the EKFs on the same measurements, and report all of them.

    Given folders of finished runs instead of a bag: put their numbers into one summary.
    """
    from graphloc.errors import ConfigError
    from graphloc.eval.summary import is_run

    runs = [folder for folder in bag if is_run(folder)]
    if not runs:
        if config is None:
            raise ConfigError(f"{bag[0]}: a bag needs its vessel.yaml: give --config")
        wanted = Wanted(
            bag=bag, config=config, out=out, overwrite=overwrite, as_json=as_json, figures=figures, rerun=rerun, start=start, duration=duration
        )  # fmt: skip
        smooth_bags(wanted, hold_out, compare=True)
        return
    other = next((path for path in bag if path not in runs), None)
    if other is not None:
        raise ConfigError(
            f"{other}: is not the folder of a finished run, and {runs[0]} is: give either bags or run folders"
        )
    if figures or start or any(given is not None for given in (config, hold_out, rerun, duration)):
        raise ConfigError(
            f"{runs[0]}: is a finished run: --config, --start, --duration, --hold-out, --figures and --rerun are for bags"
        )
    _summarise(runs, out, overwrite=overwrite, as_json=as_json)


def _summarise(folders: list[Path], out: Path, *, overwrite: bool, as_json: bool) -> None:
    from graphloc.eval import summary

    runs = summary.read_runs(folders)
    page = summary.write_summary(out, runs, overwrite=overwrite)
    found = summary.blocks(runs)
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
        typer.echo(summary.as_markdown(runs, found))
    typer.echo(str(page))
