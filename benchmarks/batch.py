# SPDX-License-Identifier: Apache-2.0
"""Figures of F.3: a whole run at once, measurements given. Its own main solves one run in a process of its own."""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import resource
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from _kernel import kernel_s
from _rows import Row, row

from graphloc import app
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate

_RUNS = (("2 min", 120.0, 3), ("20 min", 1200.0, 1), ("2 h", 7200.0, 1))
Solved = dict[str, Any]


def loops(length_s: float) -> SimulatedRun:
    """IMU, GNSS, compass, poses and the height prior; nothing of them is in a bag."""
    return simulate(Scenario(path="loops", noise="drift", duration_s=length_s), 0)


def peak_mib() -> float:
    """Largest memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def solved(length_s: float, times: int = 1) -> Solved:
    """What came of a run, and the middle time of some, s: on the wall, and of the processor."""
    run = loops(length_s)
    gc.freeze()  # as the commands do
    before, took = peak_mib(), []
    for _ in range(times):
        begin, began = time.perf_counter(), time.process_time()
        done = app.simulated(run)
        took.append((time.perf_counter() - begin, time.process_time() - began))
    wall_s, processor_s = np.median(took, axis=0).tolist()
    stats, imu = done.solution.stats, run.recording.imu
    assert imu is not None
    return {
        "wall_s": wall_s, "processor_s": processor_s, "peak_mib": peak_mib(), "before_mib": before,
        "states": stats.states, "factors": stats.factors, "iterations": stats.iterations, "passes": stats.passes,
        "measurements": len(run.recording.measurements), "samples": len(imu),
        "ledger": sum(1 for _ in done.solution.ledger), "converged": stats.converged, "kernel_s": kernel_s(),
    }  # fmt: skip


def alone(length_s: float, times: int = 1) -> Solved:
    """The same in a fresh process, whose memory is of this run alone."""
    call = [sys.executable, __file__, str(length_s), "--times", str(times)]
    found: Solved = json.loads(subprocess.run(call, check=True, capture_output=True, text=True).stdout)
    return found


def exponent(shorter: float, longer: float, times_as_long: float) -> float:
    """Of growth: 1 is linear."""
    return float(np.log(longer / shorter) / np.log(times_as_long))


def figures(_pool: ProcessPoolExecutor) -> list[Row]:
    """One after another: the longest takes 7 GiB."""
    rows, found = [], {}
    for name, length_s, times in _RUNS:
        found[name] = one = alone(length_s, times)
        label = f"batch, {name}, measurements given"
        bound = (50.0, ">=") if name == "2 min" else (None, "info")
        rows += [
            row("F.3", f"{label}: times faster than real time", length_s / one["wall_s"], "x", *bound),
            row("F.3", f"{label}: the run by time of the processor (one core)", length_s / one["processor_s"], "x"),
            row("F.3", f"{label}: poses", one["states"], "count"),
            row("F.3", f"{label}: factors", one["factors"], "count"),
            row("F.3", f"{label}: solver iterations", one["iterations"], "count"),
            row("F.3", f"{label}: largest memory of the process", one["peak_mib"], "MiB"),
            row("F.3", f"{label}: memory that solving took", one["peak_mib"] - one["before_mib"], "MiB"),
        ]
    for (shorter, short_s, _), (longer, long_s, _) in itertools.pairwise(_RUNS):
        ratio = long_s / short_s
        for what, unit in (
            ("processor_s", "time of the processor"),
            ("iterations", "iterations"),
            ("factors", "factors"),
        ):
            grown = exponent(found[shorter][what], found[longer][what], ratio)
            rows.append(row("F.3", f"batch, from {shorter} to {longer}: exponent of growth, {unit} (1: linear)", grown, "power"))  # fmt: skip
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("length_s", type=float)
    parser.add_argument("--times", type=int, default=1)
    arguments = parser.parse_args()
    print(json.dumps(solved(arguments.length_s, arguments.times)))
