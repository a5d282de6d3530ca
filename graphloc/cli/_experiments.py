# SPDX-License-Identifier: Apache-2.0
"""What a run can bear: ablate, drill."""

from __future__ import annotations

import os
from functools import partial
from typing import Annotated

import typer

from graphloc.cli._shared import (
    BagArgument,
    ConfigOption,
    DurationOption,
    HoldOutOption,
    JobsOption,
    JsonOption,
    OutOption,
    OverwriteOption,
    SeedOption,
    StartOption,
    Wanted,
    progress,
)


def ablate(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    start: StartOption = 0.0,
    duration: DurationOption = None,
    hold_out: HoldOutOption = None,
    jobs: JobsOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Smooth a run without each sensor in turn: what each contributes, and whether one contradicts the rest."""
    from graphloc import ablations
    from graphloc.eval import ablation_page as page
    from graphloc.eval.holdout import HoldOut

    held = None if hold_out is None else HoldOut.parse(hold_out)
    wanted = Wanted(
        bag=bag, config=config, out=out, overwrite=overwrite, as_json=as_json, start=start, duration=duration
    )
    wanted.check(page.MARK)
    show = progress()
    recording, vessel, scans = wanted.load(show)
    found = ablations.ablate(
        recording, vessel, scans=scans, hold_out=held, jobs=jobs or os.cpu_count() or 1, progress=show
    )
    said = (*page.said(found), *(grid.as_text() for grid in page.grids(found)))
    wanted.write_page("ablation.html", page.MARK, partial(page.write, found), said)


def drill(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    start: StartOption = 0.0,
    duration: DurationOption = None,
    times: Annotated[int, typer.Option(min=1, help="How often each failure is injected, at different times.")] = 2,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Only failures whose name contains this, e.g. outage; repeat for more."),
    ] = None,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Inject failures (outages, jumps, false matches) into a run: do smoother, online mode and EKFs recover?"""
    from graphloc import drills
    from graphloc.eval.drill import page

    wanted = Wanted(
        bag=bag, config=config, out=out, overwrite=overwrite, as_json=as_json, start=start, duration=duration
    )
    wanted.check(page.MARK)
    show = progress()
    recording, vessel, scans = wanted.load(show)
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
    said = (*page.said(found), *(grid.as_text() for grid in page.brief(found)))
    wanted.write_page("drill.html", page.MARK, partial(page.write, found), said)
