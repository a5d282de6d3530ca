# SPDX-License-Identifier: Apache-2.0
"""Figures of F.6: 100 runs by `graphloc sweep` with 1, 2 and 4 workers: the time, and whether the tables are the same."""

from __future__ import annotations

import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from _rows import Row, row

from graphloc.job import Job
from graphloc.sweep import sweep

_SCENARIOS = ("bl1-drift", "bl1-jump", "bl2-drift", "bl3-jump")
_LENGTH_S = 60


def _numbers(table: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{k: v for k, v in r.items() if k != "took_s"} for r in table]


def _apart(a: dict[str, Any], b: dict[str, Any]) -> float:
    """Largest difference of two rows' numbers, as a share."""
    pairs = [(v, b[k]) for k, v in a.items() if isinstance(v, float) and isinstance(b[k], float)]
    return max((abs(x - y) / max(abs(x), abs(y), 1e-9) for x, y in pairs), default=0.0)


def workers(_pool: ProcessPoolExecutor, seeds: int = 25, counts: tuple[int, ...] = (1, 2, 4)) -> list[Row]:
    """The processes are Dask's, so the pool is left alone."""
    jobs = [
        Job(scenario=name, seed=seed, changes=(("duration_s", str(_LENGTH_S)),))
        for name in _SCENARIOS
        for seed in range(seeds)
    ]
    label, rows, tables, took_s = f"sweep, {len(jobs)} runs of {_LENGTH_S} s", [], [], []
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            tables.append(_numbers(sweep(jobs, Path(folder) / "sweep", workers=count)))
            took_s.append(time.perf_counter() - begun)
        rows.append(row("F.6", f"{label}, {count} workers: time", took_s[-1], "s"))
        rows.append(row("F.6", f"{label}, {count} workers: times as fast as one", took_s[0] / took_s[-1], "ratio"))
    differ = sum(any(other[i] != first for other in tables[1:]) for i, first in enumerate(tables[0]))
    far = max(_apart(first, other[i]) for other in tables[1:] for i, first in enumerate(tables[0]))
    failed = sum(bool(r["error"]) for r in tables[0])
    return [
        *rows,
        row("F.6", f"{label}: rows that differ between numbers of workers", differ, "rows", 0, "<="),
        row("F.6", f"{label}: largest difference between numbers of workers, of the number", far, "ratio"),
        row("F.6", f"{label}: failed", failed, "runs", 0, "<="),
        row("F.6", "sweep: cores of the machine", os.cpu_count() or 0, "cores"),
    ]
