# SPDX-License-Identifier: Apache-2.0
"""The honest EKF with the slow error of the fixes as states: how much of what the graph gains over it is that model, and not the graph?"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor

import numpy as np
from _rows import Row, row

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.eval.ekf import run_honest
from graphloc.eval.ekf._honest import _DT_S, _HonestEkf
from graphloc.eval.ekf._inputs import Interval
from graphloc.eval.ekf._planar import run_filter
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import bl_scenario, simulate
from graphloc.frames import Array
from graphloc.measurements import GnssPosition, Measurement
from graphloc.recording import Recording

_SLOW = slice(6, 8)


class SlowEkf(_HonestEkf):
    """State: that of the honest EKF, and what fixes are off to the east and north (m), Gauss-Markov as configured for the graph."""

    def __init__(self, recording: Recording, config: VesselConfig) -> None:
        super().__init__(recording, config)
        error = config.sensors["gnss"].slow_error
        self._off_m2 = error.horizontal_sigma_m**2 * np.eye(2)
        self._kept = float(np.exp(-_DT_S / error.time_constant_s))

    def start(self, x: Array) -> tuple[Array, Array]:
        x, known = super().start(x)
        P = np.zeros((8, 8))
        P[:6, :6], P[_SLOW, _SLOW] = known, self._off_m2
        P[:2, :2] += self._off_m2  # the place is that of the first fix
        P[:2, _SLOW] = P[_SLOW, :2] = -self._off_m2
        return np.append(x, [0.0, 0.0]), P

    def predict(self, x: Array, P: Array, step: Interval) -> tuple[Array, Array]:
        moved, own, noise = self.moved(x[:6], step)
        F, Q = self._kept * np.eye(8), np.zeros((8, 8))
        F[:6, :6], Q[:6, :6], Q[_SLOW, _SLOW] = own, noise, (1.0 - self._kept**2) * self._off_m2
        return np.append(moved, self._kept * x[_SLOW]), F @ P @ F.T + Q

    def _slow(self, m: Measurement, size: int) -> Array:
        return np.zeros((size, size)) if isinstance(m, GnssPosition) else super()._slow(m, size)


def _with_error(m: Measurement, x: Array, r: Array, H: Array) -> tuple[Array, Array]:
    """Return innovation and H of a measurement: fixes show the two states, too."""
    if isinstance(m, GnssPosition):
        H[:, _SLOW], r = np.eye(2), r - x[_SLOW]
    return r, H


def _both(job: tuple[int, str, int]) -> tuple[float, float, float]:
    """Return the RMSE of the honest EKF and of this one, and how often the truth is in its bounds."""
    case, noise, seed = job
    run = simulate(bl_scenario(case, noise), seed)  # type: ignore[arg-type]
    datum = app.choose_datum(run.recording, run.config)
    honest = compare_to_truth(run_honest(run.recording, run.config, datum).trajectory, run.truth)
    ekf = SlowEkf(run.recording, run.config)
    found = run_filter(ekf, run.recording, run.config, datum, _with_error)
    slow = compare_to_truth(found.trajectory, run.truth)
    assert slow.coverage_95 is not None
    return honest.position_rmse_m, slow.position_rmse_m, slow.coverage_95


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    """Means over ten seeds of each of BL's cases."""
    jobs = [(case, noise, seed) for case in (1, 2, 3) for noise in ("drift", "jump") for seed in range(10)]
    found = dict(zip(jobs, pool.map(_both, jobs), strict=True))
    rows = []
    for case, noise in dict.fromkeys((case, noise) for case, noise, _ in jobs):
        honest, slow, inside = np.mean([found[case, noise, seed] for seed in range(10)], axis=0)
        label = f"BL case {case}, {noise}, 10 seeds"
        rows += [
            row("E.ekf", f"{label}: RMSE of the honest EKF", honest, "m"),
            row("E.ekf", f"{label}: of the honest EKF with the error of the fixes as states", slow, "m"),
            row("E.ekf", f"{label}: its truth inside the 95 % bounds", inside, "share"),
        ]
    return rows
