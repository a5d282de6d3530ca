# SPDX-License-Identifier: Apache-2.0
"""Figures of an IMU that is wrong for five seconds: what is left of the track, offline and online.

`benchmarks/results.py --only E.imu` writes them down.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
from _rows import Row, row
from online import LOOPS

from graphloc import app
from graphloc.eval.metrics import errors
from graphloc.eval.simulate import SimulatedRun, simulate
from graphloc.frames import Array
from graphloc.replay import replay
from graphloc.solution import Solution
from graphloc.trajectory import bounds_95

_LENGTH_S, _WRONG_S = 90.0, (40.0, 45.0)
_SEEDS = range(50, 54)
_AXES = [1, 0, 2]
Samples = tuple[Array, Array]
# What becomes of the accelerations and rates (N, 3), IMU axes.
FAULTS: dict[str, Callable[[Array, Array, np.random.Generator], Samples]] = {
    "right": lambda accel, gyro, rng: (accel, gyro),
    "rates in deg/s": lambda accel, gyro, rng: (accel, np.degrees(gyro)),
    "accelerations in g": lambda accel, gyro, rng: (accel / 9.81, gyro),
    "axes swapped": lambda accel, gyro, rng: (accel[:, _AXES], gyro[:, _AXES] * [1.0, 1.0, -1.0]),
    "yaw rate off by 10 deg/s": lambda accel, gyro, rng: (accel, gyro + np.radians([0.0, 0.0, 10.0])),
    "no rates": lambda accel, gyro, rng: (accel, rng.normal(0.0, 1e-3, gyro.shape)),
    "noise of 5 m/s^2 and 0.5 rad/s": lambda accel, gyro, rng: (
        accel + rng.normal(0.0, 5.0, accel.shape),
        gyro + rng.normal(0.0, 0.5, gyro.shape),
    ),
}


def _with_fault(run: SimulatedRun, fault: str, seed: int) -> SimulatedRun:
    imu = run.recording.imu
    assert imu is not None
    at_s = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    wrong = (at_s >= _WRONG_S[0]) & (at_s < _WRONG_S[1])
    accel, gyro = imu.accel_mps2.copy(), imu.gyro_radps.copy()
    accel[wrong], gyro[wrong] = FAULTS[fault](accel[wrong], gyro[wrong], np.random.default_rng([seed, 9]))
    return replace(run, recording=replace(run.recording, imu=replace(imu, accel_mps2=accel, gyro_radps=gyro)))


def _figures(solution: Solution, run: SimulatedRun) -> tuple[float, float, float, float]:
    """Position RMSE and largest error, m, share of positions inside their 95 % bounds, and whether the IMU was blamed."""
    found = errors(solution.trajectory, run.truth)
    off_m = np.linalg.norm(found.position_m[:, :2], axis=1)
    assert found.estimate.cov is not None
    held = float(np.mean(off_m <= bounds_95(found.estimate.cov)[:, 0]))
    blamed = any("contradicts the other sensors, which agree" in line for line in solution.stats.warnings)
    return float(np.sqrt(np.mean(off_m**2))), float(off_m.max()), held, float(blamed)


def _solved(job: tuple[str, int]) -> tuple[tuple[float, float, float, float], tuple[float, float, float, float]]:
    """Of the batch, and online."""
    fault, seed = job
    run = _with_fault(simulate(replace(LOOPS, duration_s=_LENGTH_S), seed), fault, seed)
    online = replay(run.recording, run.config).solution
    return _figures(app.smooth_recording(run.recording, run.config).solution, run), _figures(online, run)


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    jobs = list(product(FAULTS, _SEEDS))
    done = dict(zip(jobs, pool.map(_solved, jobs), strict=True))
    rows = []
    for fault in FAULTS:
        by_way = np.array([done[fault, seed] for seed in _SEEDS]).transpose(1, 0, 2)
        for way, found in zip(("batch", "online"), by_way, strict=True):
            label = f"IMU for 5 s: {fault}, {len(_SEEDS)} seeds, {way}"
            rows += [
                row("E.imu", f"{label}: position RMSE, mean", found[:, 0].mean(), "m"),
                row("E.imu", f"{label}: largest error of all", found[:, 1].max(), "m"),
                row("E.imu", f"{label}: inside the 95 % bounds", 100.0 * found[:, 2].mean(), "%"),
                row("E.imu", f"{label}: the IMU is blamed", found[:, 3].sum(), "runs"),
            ]
    return rows
