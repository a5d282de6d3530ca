# SPDX-License-Identifier: Apache-2.0
"""Figures of F.5: drills on a simulated run and on Husky; their tables go into docs/drills.md, a picture of each beside it."""

from __future__ import annotations

import os
import re
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from _rows import ROOT, Row, row
from smoothing import HUSKY

from graphloc import app
from graphloc.ablations import ablate
from graphloc.drills import drill
from graphloc.eval.ablation_page import grids as ablation_grids
from graphloc.eval.ablation_page import said as ablation_said
from graphloc.eval.drill import page
from graphloc.eval.drill.measure import Drilled, State, summed
from graphloc.eval.page import Grid
from graphloc.eval.plots import colour_of
from graphloc.eval.simulate import SimulatedRun, harbour_scenarios, simulate

DOC, PICTURES = ROOT / "docs/drills.md", ROOT / "docs/pictures"
SEED, TIMES = 1, 2
_LEAST_M = 0.05
_COMPASS_OFF_DEG = 12.0  # of the run that is ablated: a bad sensor, to be found without truth


def _simulated() -> SimulatedRun:
    return simulate(replace(harbour_scenarios()["bl1-drift"], lidar_hz=0.0), SEED)  # its matches are made up


def _told(stage: str, done: int, total: int) -> None:
    print(f"  {stage}: {done} of {total}", file=sys.stderr, flush=True)


def both(_pool: ProcessPoolExecutor) -> list[Row]:
    jobs = os.cpu_count() or 1
    rows: list[Row] = []
    run = _simulated()
    recording, config = app.load([HUSKY], ROOT / "examples/husky/vessel.yaml")
    for name, label, these in (
        ("bl1-drift", "bl1-drift", (run.recording, run.config)),
        ("husky", "Husky", (recording, config)),
    ):
        drilled = drill(*these, times=TIMES, jobs=jobs, progress=_told)
        rows += rows_of(label, drilled)
        into_doc(name, page.said(drilled), page.grids(drilled))
        picture(drilled, PICTURES / f"drill-{name}.png")
    bad = simulate(replace(run.scenario, compass_offset_deg=_COMPASS_OFF_DEG), SEED)
    found = ablate(replace(bad.recording, truth=None), bad.config, jobs=jobs, progress=_told)
    into_doc("ablation", ablation_said(found), ablation_grids(found))
    return rows


def rows_of(label: str, drilled: Drilled) -> list[Row]:
    found, every = [], summed(drilled.measured)
    against = "" if drilled.truth else " from the undisturbed smoother"
    for name in drilled.estimators:
        own = [m for m in drilled.measured if m.estimator == name]
        start = f"drill, {label}, {name}"
        for r in every:
            if r.estimator == name and r.family in ("GNSS outage", "no place at all") and r.off_m is not None:
                found.append(row("F.5", f"{start}: {r.failure}: farthest off{against}", r.off_m, "m"))
        covered = [m.coverage for m in own if m.coverage is not None]
        found += [
            row("F.5", f"{start}: never back, of {len(own)} drills", sum(m.state in (State.LOST, State.NONE) for m in own), "drills"),
            row("F.5", f"{start}: near again, but outside its own bounds", sum(m.state is State.UNSURE for m in own), "drills"),
            row("F.5", f"{start}: longest until back", max((m.back_s for m in own if m.back_s is not None), default=np.nan), "s"),
            row("F.5", f"{start}: 95 % coverage, mean of all drills", 100.0 * float(np.mean(covered)) if covered else np.nan, "%"),
        ]  # fmt: skip
    return found


def into_doc(name: str, said: list[str], grids: list[Grid]) -> None:
    """Put a table between its marks in docs/drills.md."""
    text, (begin, end) = DOC.read_text(), (f"<!-- {name} -->", f"<!-- end of {name} -->")
    made = "\n\n".join([begin, *said, *(grid.as_markdown().strip() for grid in grids), end])
    new, count = re.subn(f"{re.escape(begin)}.*?{re.escape(end)}", lambda _: made, text, flags=re.DOTALL)
    assert count == 1, f"{DOC}: no place for {name}"
    DOC.write_text(new)


def picture(drilled: Drilled, out: Path) -> None:
    """Farthest off, against the length of outages and in all failures."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    rows = summed(drilled.measured)
    names = list(dict.fromkeys(r.failure for r in rows))[::-1]
    outages = [f for f in ("GNSS outage", "no place at all") if any(r.family == f for r in rows)]
    figure = plt.figure(figsize=(10.5, 1.6 + 0.27 * len(names)), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.9))
    lengths = np.atleast_1d(left.subplots(len(outages), 1, sharex=True))
    every = right.subplots()
    for i, name in enumerate(drilled.estimators):
        own = {r.failure: r for r in rows if r.estimator == name and r.off_m is not None}
        for axes, family in zip(lengths, outages, strict=True):
            curve = sorted((r.length_s, max(r.off_m or 0.0, _LEAST_M)) for r in own.values() if r.family == family)
            axes.plot(*np.array(curve).T, "o-", color=colour_of(name), markersize=4)
            axes.set(yscale="log", title=family, ylabel="farthest off, m")
        y = np.array([names.index(f) for f in own]) + 0.16 * (1.5 - i)
        off = np.array([max(r.off_m or 0.0, _LEAST_M) for r in own.values()])
        lost = np.array([bool(r.lost or r.none) for r in own.values()])
        every.plot(off[~lost], y[~lost], "o", color=colour_of(name), markersize=5, label=name)
        every.plot(off[lost], y[lost], "X", color=colour_of(name), markersize=7)
        usual = [max(r.normal_m or 0.0, _LEAST_M) for r in own.values()]
        every.plot(usual, y, "o", color=colour_of(name), markersize=4, fillstyle="none", alpha=0.5)
    for axis in (*(axes.yaxis for axes in lengths), every.xaxis):
        axis.set_major_formatter("{x:g}")
    lengths[-1].set(xlabel="length, s")
    every.set(xscale="log", xlabel="farthest off, m (hollow: undisturbed; cross: never back)")
    every.set_yticks(range(len(names)), names)
    every.grid(axis="both", alpha=0.25)
    for axes in lengths:
        axes.grid(alpha=0.25)
    right.legend(loc="outside upper center", ncols=4, frameon=False)
    figure.savefig(out, dpi=110)
    plt.close(figure)
