# SPDX-License-Identifier: Apache-2.0
"""Figures of a compass that errs: what its modelled error buys the batch and the online mode, and what a good compass pays.

`benchmarks/results.py --only A.dev` writes them down.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
from _rows import Row, row
from calibration import changed

from graphloc import app
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import SimulatedRun, bl_scenario, simulate
from graphloc.measurements import CompassHeading
from graphloc.replay import replay
from graphloc.solution import Solution

# What is read for a yaw, rad, at a time, s.
FAULTS: dict[str, Callable[[float, float], float]] = {
    "good": lambda yaw, t: yaw,
    "deviates by 4 deg": lambda yaw, t: yaw + np.radians(4.0) * np.sin(yaw),
    "deviates by 10 deg": lambda yaw, t: yaw + np.radians(10.0) * np.sin(yaw),
    "wanders by 5 deg in a minute": lambda yaw, t: yaw + np.radians(5.0) * np.sin(2.0 * np.pi * t / 60.0),
    "40 deg off its mount": lambda yaw, t: yaw + np.radians(40.0),
    "mirrored": lambda yaw, t: -yaw,
}
MODELS: dict[str, dict[str, float]] = {
    "offset alone": {"deviation_sigma_deg": 0.0, "wander_sigma_deg": 0.0},
    "with deviation and wander": {},
}
Job = tuple[str, str, int]
Found = tuple[float, float, float, float]


def _figures(solution: Solution, run: SimulatedRun) -> Found:
    """Position RMSE m, heading RMSE deg, share of headings in their 95 % bounds, share of matches that were not used."""
    ours, counts = compare_to_truth(solution.trajectory, run.truth), solution.ledger.counts()["matcher"]
    held = ours.heading_coverage_95
    assert held is not None
    return ours.position_rmse_m, ours.heading_rmse_deg, held, 1.0 - counts.get("used", 0) / sum(counts.values())


def _solved(job: Job) -> tuple[Found, Found]:
    """Of the batch, and online."""
    fault, model, seed = job
    run = simulate(bl_scenario(2, "drift"), seed)
    read = tuple(
        replace(m, yaw_rad=float(FAULTS[fault](m.yaw_rad, m.stamp_ns * 1e-9))) if isinstance(m, CompassHeading) else m
        for m in run.recording.measurements
    )
    run = replace(
        run,
        recording=replace(run.recording, measurements=read),
        config=changed(run.config, "compass", **MODELS[model]),
    )
    online = replay(run.recording, run.config).solution
    return _figures(app.simulated(run).solution, run), _figures(online, run)


def figures(pool: ProcessPoolExecutor, seeds: int = 1) -> list[Row]:
    kinds = list(product(FAULTS, MODELS))
    jobs: list[Job] = [(*kind, seed) for kind in kinds for seed in range(1, 1 + seeds)]
    done = dict(zip(jobs, pool.map(_solved, jobs), strict=True))
    rows = []
    for fault, model in kinds:
        found = np.array([done[(fault, model, seed)] for seed in range(1, 1 + seeds)]).mean(axis=0)
        for way, (off_m, off_deg, held, unused) in zip(("batch", "online"), found, strict=True):
            label = f"compass {fault}, {model}, BL case 2, drift, {seeds} seeds, {way}"
            rows += [
                row("A.dev", f"{label}: position RMSE", off_m, "m"),
                row("A.dev", f"{label}: heading RMSE", off_deg, "deg"),
                row("A.dev", f"{label}: heading in its 95 % bounds", 100.0 * held, "%"),
                row("A.dev", f"{label}: matches not used (40 % are false)", 100.0 * unused, "%"),
            ]
    return rows
