# SPDX-License-Identifier: Apache-2.0
"""Figures of a minute without any position: how far each estimator drifts. A compass and the IMU stay.

`benchmarks/results.py --only E.dark` writes them down.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
from _rows import Row, row

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.eval import ekf
from graphloc.eval.simulate import find_scenario, simulate
from graphloc.frames import Array
from graphloc.measurements import GnssPosition, PoseFix
from graphloc.recording import Recording
from graphloc.trajectory import Trajectory, bounds_95

_CASES, _SEEDS = ("bl1-drift", "bl2-drift"), range(60, 64)
_OUTAGE_S, _SOON_S, _AFTER_S = 60.0, 30.0, 2.0  # one begins soon after the start, one ends shortly before the end
_AT_S = (10.0, 30.0, 59.8)  # into it
Found = tuple[list[float], float]  # errors at these times, m; share inside the 95 % bounds
_ESTIMATORS: dict[str, Callable[[Recording, VesselConfig], Trajectory]] = {
    "batch": lambda recording, config: app.smooth_recording(recording, config).solution.trajectory,
    "online": lambda recording, config: app.replay_recording(recording, config).solution.trajectory,
    "honest EKF": lambda recording, config: (
        ekf.run_honest(recording, config, app.choose_datum(recording, config)).trajectory
    ),
    "BL EKF": lambda recording, config: ekf.run_bl(recording, config, app.choose_datum(recording, config)).trajectory,
}


def _found(track: Trajectory, truth: Trajectory, begin_ns: int) -> Found:
    assert track.cov is not None
    at_s = (track.stamps_ns - begin_ns) * 1e-9
    out = (at_s >= 0.0) & (at_s < _OUTAGE_S)
    off_m = np.linalg.norm((track.p_world_m[out] - truth.at(track.stamps_ns[out]).p_world_m)[:, :2], axis=1)
    newest = [int(np.searchsorted(at_s[out], t, side="right")) - 1 for t in _AT_S]
    return off_m[newest].tolist(), float(np.mean(off_m <= bounds_95(track.cov[out])[:, 0]))


def _outage(job: tuple[str, int, bool]) -> dict[str, Found]:
    """One outage of one run: what each estimator makes of it."""
    case, seed, soon = job
    run = simulate(find_scenario(case, {}), seed)
    first_ns, last_ns = run.truth.stamps_ns[[0, -1]]
    begin_ns = int(first_ns + _SOON_S * 1e9 if soon else last_ns - (_OUTAGE_S + _AFTER_S) * 1e9)
    end_ns = begin_ns + int(_OUTAGE_S * 1e9)
    left = tuple(
        m
        for m in run.recording.measurements
        if not (isinstance(m, GnssPosition | PoseFix) and begin_ns <= m.stamp_ns < end_ns)
    )
    recording = replace(run.recording, measurements=left)
    return {name: _found(track(recording, run.config), run.truth, begin_ns) for name, track in _ESTIMATORS.items()}


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    jobs = list(product(_CASES, _SEEDS, (True, False)))
    done, rows = list(pool.map(_outage, jobs)), list[Row]()
    for name in _ESTIMATORS:
        off_m: Array = np.array([found[name][0] for found in done])
        label = f"no position for a minute, {len(jobs)} outages, {name}"
        for at_s, column in zip(_AT_S, off_m.T, strict=True):
            rows.append(row("E.dark", f"{label}: off after {at_s:.0f} s, RMS", float(np.sqrt(np.mean(column**2))), "m"))
        rows.append(row("E.dark", f"{label}: largest at its end", off_m[:, -1].max(), "m"))
        rows.append(
            row("E.dark", f"{label}: inside the 95 % bounds", 100.0 * np.mean([found[name][1] for found in done]), "%")
        )
    return rows
