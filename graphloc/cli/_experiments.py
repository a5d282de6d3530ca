# SPDX-License-Identifier: Apache-2.0
"""Commands that solve changed copies of a run: ablate, drill."""

from __future__ import annotations

import os
from functools import partial
from typing import Annotated

import typer

from graphloc.cli._progress import progress
from graphloc.cli._shared import FolderOptions, HoldOutOption, JobsOption, SeedOption


def ablate(options: FolderOptions, hold_out: HoldOutOption = None, jobs: JobsOption = None) -> None:
    """Smooth a run without each sensor in turn, to see what each contributes and whether one contradicts the rest."""
    from graphloc import ablations
    from graphloc.eval import ablation_page as page
    from graphloc.eval.holdout import HoldOut

    held = None if hold_out is None else HoldOut.parse(hold_out)
    options.check(page.MARK)
    show = progress()
    recording, vessel, scans = options.load(show)
    found = ablations.ablate(
        recording, vessel, scans=scans, hold_out=held, jobs=jobs or os.cpu_count() or 1, progress=show
    )
    said = (*page.said(found), *(grid.as_text() for grid in page.grids(found)))
    options.write_page("ablation.html", page.MARK, partial(page.write, found), said)


def drill(
    options: FolderOptions,
    times: Annotated[int, typer.Option(min=1, help="How often each failure is injected, at different times.")] = 2,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Only failures whose name contains this, e.g. outage; repeat for more."),
    ] = None,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
) -> None:
    """Inject failures (outages, jumps, false matches) into a run, to see whether smoother, online mode and EKFs recover."""
    from graphloc import drills
    from graphloc.eval.drill import page

    options.check(page.MARK)
    show = progress()
    recording, vessel, scans = options.load(show)
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
    options.write_page("drill.html", page.MARK, partial(page.write, found), said)
