# SPDX-License-Identifier: Apache-2.0
"""Figures of a cheap IMU that warms up: its biases wander by a hundred times what is configured.

`benchmarks/results.py --only E.warm` writes them down.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
from _rows import Row, row
from online import LOOPS

from graphloc import app
from graphloc.eval.metrics import errors
from graphloc.eval.simulate import SimulatedRun, simulate
from graphloc.replay import replay
from graphloc.solution import Solution
from graphloc.trajectory import bounds_95

_LENGTH_S, _SETTLES_S = 200.0, 120.0
_SEEDS = range(60, 63)
# How far gyroscopes (deg/s) and accelerometers (m/s^2) settle, together on three axes.
WARMING = ((0.0, 0.0), (0.15, 0.05), (0.5, 0.1), (2.0, 0.2))
_GYRO_AXES, _ACCEL_AXES = np.array([0.4, -0.5, 0.77]), np.array([0.55, -0.37, 0.75])


def _warming(run: SimulatedRun, gyro_dps: float, accel_mps2: float) -> SimulatedRun:
    imu = run.recording.imu
    assert imu is not None
    left = np.exp(-(imu.stamps_ns - imu.stamps_ns[0]) * 1e-9 / _SETTLES_S)[:, None]
    accel = imu.accel_mps2 + accel_mps2 * left * _ACCEL_AXES
    gyro = imu.gyro_radps + np.radians(gyro_dps) * left * _GYRO_AXES
    return replace(run, recording=replace(run.recording, imu=replace(imu, accel_mps2=accel, gyro_radps=gyro)))


def _figures(solution: Solution, run: SimulatedRun) -> tuple[float, float, float, float]:
    """Position RMSE, m, heading RMSE, deg, and the shares of both inside their 95 % bounds."""
    found = errors(solution.trajectory, run.truth)
    off_m, off_rad = np.linalg.norm(found.position_m[:, :2], axis=1), np.abs(found.heading_rad)
    assert found.estimate.cov is not None
    bounds = bounds_95(found.estimate.cov)
    return (
        float(np.sqrt(np.mean(off_m**2))),
        float(np.degrees(np.sqrt(np.mean(off_rad**2)))),
        float(np.mean(off_m <= bounds[:, 0])),
        float(np.mean(np.degrees(off_rad) <= bounds[:, 2])),
    )


def _solved(job: tuple[tuple[float, float], int]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Of the batch, and online."""
    by, seed = job
    run = _warming(simulate(replace(LOOPS, duration_s=_LENGTH_S), seed), *by)
    online = replay(run.recording, run.config).solution
    return _figures(app.smooth_recording(run.recording, run.config).solution, run), _figures(online, run)


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    jobs = list(product(WARMING, _SEEDS))
    done = dict(zip(jobs, pool.map(_solved, jobs), strict=True))
    rows = []
    for gyro_dps, accel_mps2 in WARMING:
        by_way = np.array([done[(gyro_dps, accel_mps2), seed] for seed in _SEEDS]).transpose(1, 0, 2)
        for way, found in zip(("batch", "online"), by_way, strict=True):
            label = f"IMU settles by {gyro_dps:g} deg/s and {accel_mps2:g} m/s^2, {len(_SEEDS)} seeds, {way}"
            rows += [
                row("E.warm", f"{label}: position RMSE, mean", found[:, 0].mean(), "m"),
                row("E.warm", f"{label}: heading RMSE, mean", found[:, 1].mean(), "deg"),
                row("E.warm", f"{label}: positions inside the 95 % bounds", 100.0 * found[:, 2].mean(), "%"),
                row("E.warm", f"{label}: headings inside the 95 % bounds", 100.0 * found[:, 3].mean(), "%"),
            ]
    return rows
