# SPDX-License-Identifier: Apache-2.0
"""Figures of sensors that err, offline and online: an IMU that is wrong for seconds or warms up, a compass.

`benchmarks/results.py --only E.imu` (or E.warm, E.iron, A.dev) writes them down.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from _rows import Row, row
from calibration import changed
from online import LOOPS

from graphloc import app
from graphloc.config import SlowErrorConfig
from graphloc.eval.metrics import compare_to_truth, errors
from graphloc.eval.simulate import SimulatedRun, bl_scenario, simulate
from graphloc.frames import Array
from graphloc.measurements import CompassHeading
from graphloc.replay import replay
from graphloc.solution import Solution
from graphloc.trajectory import bounds_95

Found = tuple[float, ...]
Column = tuple[str, str, Callable[[Array], float]]  # of a figure: what it says, its unit, how it is made of all seeds


def _percent(shares: Array) -> float:
    return 100.0 * float(np.mean(shares))


def _both_ways(run: SimulatedRun, figures: Callable[[Solution, SimulatedRun], Found]) -> tuple[Found, Found]:
    """Of the batch, and online."""
    online = replay(run.recording, run.config).solution
    return figures(app.smooth_recording(run.recording, run.config).solution, run), figures(online, run)


def _rows(
    pool: ProcessPoolExecutor,
    item: str,
    solved: Callable[[tuple[Any, int]], tuple[Found, Found]],
    labels: Mapping[Hashable, str],
    seeds: Sequence[int],
    columns: Sequence[Column],
) -> list[Row]:
    """Figures of each case, by its label, over all seeds."""
    jobs = list(product(labels, seeds))
    done = dict(zip(jobs, pool.map(solved, jobs), strict=True))
    return [
        row(item, f"{label}, {way}: {what}", make(np.array([done[case, seed][k][c] for seed in seeds])), unit)
        for case, label in labels.items()
        for k, way in enumerate(("batch", "online"))
        for c, (what, unit, make) in enumerate(columns)
    ]


def _loops(length_s: float, seed: int, err: Callable[[Array, Array, Array], tuple[Array, Array]]) -> SimulatedRun:
    """A run whose accelerations and rates (N, 3), IMU axes, at times (N,), s, become others."""
    run = simulate(replace(LOOPS, duration_s=length_s), seed)
    imu = run.recording.imu
    assert imu is not None
    accel, gyro = err((imu.stamps_ns - imu.stamps_ns[0]) * 1e-9, imu.accel_mps2.copy(), imu.gyro_radps.copy())
    return replace(run, recording=replace(run.recording, imu=replace(imu, accel_mps2=accel, gyro_radps=gyro)))


# E.imu: an IMU that is wrong for five seconds: what is left of the track

_WRONG_S = (40.0, 45.0)
_WRONG_SEEDS = range(50, 54)
_AXES = [1, 0, 2]
# What becomes of the accelerations and rates (N, 3), IMU axes.
IMU_FAULTS: dict[str, Callable[[Array, Array, np.random.Generator], tuple[Array, Array]]] = {
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


def _wrong_figures(solution: Solution, run: SimulatedRun) -> Found:
    """Position RMSE and largest error, m, share of positions inside their 95 % bounds, and whether the IMU was blamed."""
    found = errors(solution.trajectory, run.truth)
    off_m = np.linalg.norm(found.position_m[:, :2], axis=1)
    assert found.estimate.cov is not None
    held = float(np.mean(off_m <= bounds_95(found.estimate.cov)[:, 0]))
    blamed = any("contradicts the other sensors, which agree" in line for line in solution.stats.warnings)
    return float(np.sqrt(np.mean(off_m**2))), float(off_m.max()), held, float(blamed)


def _wrong(job: tuple[str, int], length_s: float = 90.0) -> tuple[Found, Found]:
    fault, seed = job

    def err(at_s: Array, accel: Array, gyro: Array) -> tuple[Array, Array]:
        wrong = (at_s >= _WRONG_S[0]) & (at_s < _WRONG_S[1])
        accel[wrong], gyro[wrong] = IMU_FAULTS[fault](accel[wrong], gyro[wrong], np.random.default_rng([seed, 9]))
        return accel, gyro

    return _both_ways(_loops(length_s, seed, err), _wrong_figures)


def wrong_imu(pool: ProcessPoolExecutor) -> list[Row]:
    columns: tuple[Column, ...] = (
        ("position RMSE, mean", "m", np.mean),
        ("largest error of all", "m", np.max),
        ("inside the 95 % bounds", "%", _percent),
        ("the IMU is blamed", "runs", np.sum),
    )
    labels = {fault: f"IMU for 5 s: {fault}, {len(_WRONG_SEEDS)} seeds" for fault in IMU_FAULTS}
    return _rows(pool, "E.imu", _wrong, labels, _WRONG_SEEDS, columns)


# E.warm: a cheap IMU that warms up: its biases wander by a hundred times what is configured

_SETTLES_S = 120.0
_WARM_SEEDS = range(60, 63)
# How far gyroscopes (deg/s) and accelerometers (m/s^2) settle, together on three axes.
WARMING = ((0.0, 0.0), (0.15, 0.05), (0.5, 0.1), (2.0, 0.2))
_GYRO_AXES, _ACCEL_AXES = np.array([0.4, -0.5, 0.77]), np.array([0.55, -0.37, 0.75])


def _warm_figures(solution: Solution, run: SimulatedRun) -> Found:
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


def _warm(job: tuple[tuple[float, float], int], length_s: float = 200.0) -> tuple[Found, Found]:
    (gyro_dps, accel_mps2), seed = job

    def err(at_s: Array, accel: Array, gyro: Array) -> tuple[Array, Array]:
        left = np.exp(-at_s / _SETTLES_S)[:, None]
        return accel + accel_mps2 * left * _ACCEL_AXES, gyro + np.radians(gyro_dps) * left * _GYRO_AXES

    return _both_ways(_loops(length_s, seed, err), _warm_figures)


def warming_imu(pool: ProcessPoolExecutor) -> list[Row]:
    columns: tuple[Column, ...] = (
        ("position RMSE, mean", "m", np.mean),
        ("heading RMSE, mean", "deg", np.mean),
        ("positions inside the 95 % bounds", "%", _percent),
        ("headings inside the 95 % bounds", "%", _percent),
    )
    labels = {by: f"IMU settles by {by[0]:g} deg/s and {by[1]:g} m/s^2, {len(_WARM_SEEDS)} seeds" for by in WARMING}
    return _rows(pool, "E.warm", _warm, labels, _WARM_SEEDS, columns)


# A.dev: a compass that errs: what its modelled error buys, and what a good compass pays

# What is read for a yaw, rad, at a time, s.
COMPASS_FAULTS: dict[str, Callable[[float, float], float]] = {
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


def _compass_figures(solution: Solution, run: SimulatedRun) -> Found:
    """Position RMSE m, heading RMSE deg, share of headings in their 95 % bounds, share of matches that were not used."""
    ours, counts = compare_to_truth(solution.trajectory, run.truth), solution.ledger.counts()["matcher"]
    held = ours.heading_coverage_95
    assert held is not None
    return ours.position_rmse_m, ours.heading_rmse_deg, held, 1.0 - counts.get("used", 0) / sum(counts.values())


def _compass(job: tuple[tuple[str, str], int]) -> tuple[Found, Found]:
    (fault, model), seed = job
    run = simulate(bl_scenario(2, "drift"), seed)
    read = tuple(
        replace(m, yaw_rad=float(COMPASS_FAULTS[fault](m.yaw_rad, m.stamp_ns * 1e-9)))
        if isinstance(m, CompassHeading)
        else m
        for m in run.recording.measurements
    )
    recording, config = replace(run.recording, measurements=read), changed(run.config, "compass", **MODELS[model])
    return _both_ways(replace(run, recording=recording, config=config), _compass_figures)


def compass(pool: ProcessPoolExecutor, seeds: int = 1) -> list[Row]:
    columns: tuple[Column, ...] = (
        ("position RMSE", "m", np.mean),
        ("heading RMSE", "deg", np.mean),
        ("heading in its 95 % bounds", "%", _percent),
        ("matches not used (40 % are false)", "%", _percent),
    )
    kinds = list(product(COMPASS_FAULTS, MODELS))
    labels = {(f, model): f"compass {f}, {model}, BL case 2, drift, {seeds} seeds" for f, model in kinds}
    return _rows(pool, "A.dev", _compass, labels, range(1, 1 + seeds), columns)


# E.iron: a compass that goes off beside iron, or steps, beside RTK and a drifting receiver

_IRON_SEEDS = range(523, 527)
_IRON_RAD, _IRON_S = np.radians(20.0), 50.0
# What a compass is off at so many seconds after `_IRON_S`, in shares of `_IRON_RAD`.
IRON: dict[str, Callable[[float], float]] = {
    "right": lambda s: 0.0,
    "steps": lambda s: float(s >= 0.0),
    "steps, with a filter of 1 s": lambda s: -np.expm1(-max(s, 0.0)),
    "steps within 5 s": lambda s: float(np.clip(s / 5.0, 0.0, 1.0)),
    "under a bridge": lambda s: np.exp(-0.5 * ((s - 10.0) / 5.0) ** 2),
    "beside a crane for 30 s": lambda s: 0.5 * np.tanh(s / 3.0) - 0.5 * np.tanh((s - 30.0) / 3.0),
}
_RECEIVERS: dict[str, dict[str, Any]] = {"RTK": {"gnss_sigma_m": 0.02, "noise": "clean"}, "drift": {"noise": "drift"}}
_RTK = {"slow_error": SlowErrorConfig(horizontal_sigma_m=0.03, vertical_sigma_m=0.03)}


def _iron_figures(solution: Solution, run: SimulatedRun) -> Found:
    """Heading RMSE and largest error, deg, share of headings in their 95 % bounds, and whether the IMU was blamed."""
    found = errors(solution.trajectory, run.truth)
    ours = compare_to_truth(solution.trajectory, run.truth)
    held = ours.heading_coverage_95
    assert held is not None
    said = "contradicts the other sensors, which agree", "biases change more than configured"
    blamed = any(words in line for words in said for line in solution.stats.warnings)
    return ours.heading_rmse_deg, float(np.degrees(np.abs(found.heading_rad).max())), held, float(blamed)


def _beside_iron(job: tuple[tuple[str, str], int]) -> tuple[Found, Found]:
    (fault, receiver), seed = job
    run = simulate(
        replace(LOOPS, path="entry", duration_s=120.0, pose_hz=0.0, compass_hz=5.0, **_RECEIVERS[receiver]), seed
    )
    begin_ns = int(run.truth.stamps_ns[0])
    read = tuple(
        replace(m, yaw_rad=m.yaw_rad + _IRON_RAD * IRON[fault]((m.stamp_ns - begin_ns) * 1e-9 - _IRON_S))
        if isinstance(m, CompassHeading)
        else m
        for m in run.recording.measurements
    )
    config = changed(run.config, "gnss", **_RTK) if receiver == "RTK" else run.config
    return _both_ways(replace(run, recording=replace(run.recording, measurements=read), config=config), _iron_figures)


def compass_beside_iron(pool: ProcessPoolExecutor) -> list[Row]:
    columns: tuple[Column, ...] = (
        ("heading RMSE", "deg", np.mean),
        ("largest error of the heading of all", "deg", np.max),
        ("heading in its 95 % bounds", "%", _percent),
        ("the IMU is blamed", "runs", np.sum),
    )
    kinds = list(product(IRON, _RECEIVERS))
    labels = {(f, receiver): f"compass {f}, {receiver}, {len(_IRON_SEEDS)} seeds" for f, receiver in kinds}
    return _rows(pool, "E.iron", _beside_iron, labels, _IRON_SEEDS, columns)
