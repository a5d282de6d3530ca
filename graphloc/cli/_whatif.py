# SPDX-License-Identifier: Apache-2.0
"""What a run can bear: ablate, drill."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from graphloc.cli._shared import (
    BagArgument,
    ConfigOption,
    HoldOutOption,
    JsonOption,
    OutOption,
    OverwriteOption,
    progress,
)

_JobsOption = Annotated[int | None, typer.Option(min=1, help="Processes beside each other; by default one a core.")]


def ablate(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    hold_out: HoldOutOption = None,
    jobs: _JobsOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Smooth a run without each sensor in turn: what each is worth, and whether one contradicts the rest."""
    from graphloc import app as application
    from graphloc import outputs, whatif
    from graphloc.eval import ablation_page as page
    from graphloc.eval.holdout import HoldOut

    held = None if hold_out is None else HoldOut.parse(hold_out)
    outputs.check_folder(out, overwrite=overwrite, mark=page.MARK)
    show = progress()
    recording, vessel = application.load(bag, config, show)
    scans = application.Scans(tuple(bag), config.parent)
    found = whatif.ablate(
        recording, vessel, scans=scans, hold_out=held, jobs=jobs or os.cpu_count() or 1, progress=show
    )
    with outputs.fresh_folder(out, overwrite=overwrite, mark=page.MARK) as fresh:
        page.write(found, fresh, " ".join(sys.argv[1:]))
    if as_json:
        typer.echo((out / page.MARK).read_text(encoding="utf-8"), nl=False)
    else:
        for line in (*page.said(found), *(grid.as_text() for grid in page.grids(found))):
            typer.echo(line)
        typer.echo(str(out / "ablation.html"))


def drill(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    times: Annotated[int, typer.Option(min=1, help="How often each failure strikes, at other times.")] = 2,
    only: Annotated[
        list[str] | None,
        typer.Option("--set", help="Part of the names of the drills wanted, as outage; again for more."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same failures.")] = 0,
    jobs: _JobsOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Strike a run with harbour failures: what smoother, online mode and EKFs make of them."""
    from graphloc import app as application
    from graphloc import drills, outputs
    from graphloc.eval.drill import page

    outputs.check_folder(out, overwrite=overwrite, mark=page.MARK)
    show = progress()
    recording, vessel = application.load(bag, config, show)
    scans = application.Scans(tuple(bag), config.parent)
    found = drills.drill(
        recording,
        vessel,
        scans=scans,
        times=times,
        seed=seed,
        only=only or (),
        jobs=jobs or os.cpu_count() or 1,
        progress=show,
    )
    with outputs.fresh_folder(out, overwrite=overwrite, mark=page.MARK) as fresh:
        page.write(found, fresh, " ".join(sys.argv[1:]))
    if as_json:
        typer.echo((out / page.MARK).read_text(encoding="utf-8"), nl=False)
    else:
        for line in (*page.said(found), *(grid.as_text() for grid in page.brief(found))):
            typer.echo(line)
        typer.echo(str(out / "drill.html"))
