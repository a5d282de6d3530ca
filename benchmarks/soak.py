# SPDX-License-Identifier: Apache-2.0
"""The online mode for a day: does an update take longer, or memory grow?

`python benchmarks/soak.py --hours 24 --out docs/pictures/soak.png` writes the picture, and its numbers beside it as CSV.
The run is simulated by another process and read from a file, so that this one holds nothing but the smoother.
"""

from __future__ import annotations

import argparse
import csv
import os
import pickle
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from _rows import Row, row
from scipy.stats import t as student

from graphloc.config import VesselConfig
from graphloc.eval.simulate import Scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.measurements import ImuSample, Measurement
from graphloc.online import OnlineSmoother
from graphloc.time import stamps_of

_WARM_MIN = 10  # minutes that do not count
_BLOCK_MIN = 10  # means of blocks are nearly independent, minutes are not
_MIB = 2.0**20


@dataclass(frozen=True)
class Minute:
    """A minute of the run: time of its updates, what the process holds at its end, its horizontal error.

    `update_cpu_ms` (median) is what the process itself spent: other work on the machine hardly changes it within a day.
    """

    minute: int
    update_cpu_ms: float
    update_p50_ms: float
    update_p99_ms: float
    update_max_ms: float
    memory_mib: float
    factor_slots: int
    rms_m: float


def simulated(hours: float, seed: int, path: Path) -> VesselConfig:
    """Write a run to a file, minute by minute: its measurements, and where the vessel was."""
    run = simulate(replace(Scenario(path="loops", noise="drift"), duration_s=hours * 3600.0), seed)
    imu = run.recording.imu
    assert imu is not None
    stamps = stamps_of(run.recording.measurements)
    edges = np.arange(imu.stamps_ns[0], imu.stamps_ns[-1] + 1, 60 * 10**9)
    with path.open("wb") as stream:
        for edge in edges:
            a, b = np.searchsorted(imu.stamps_ns, [edge, edge + 60 * 10**9])
            c, d = np.searchsorted(stamps, [edge, edge + 60 * 10**9])
            columns = [np.array(v[a:b]) for v in (imu.stamps_ns, imu.accel_mps2, imu.gyro_radps, imu.seqs)]
            others = list(run.recording.measurements[c:d])
            pickle.dump((imu.sensor, columns, others, run.truth.p_world_m[a:b, :2].copy()), stream)
    return run.config


def _minutes(path: Path) -> Iterator[tuple[list[Measurement], Any, Any]]:
    """Read them back: measurements in order, stamps, and where the vessel was then."""
    with path.open("rb") as stream:
        while True:
            try:
                sensor, columns, others, true = pickle.load(stream)
            except EOFError:
                return
            samples = [
                ImuSample(stamp_ns=s, sensor=sensor, seq=q, accel_mps2=a, gyro_radps=w)
                for s, a, w, q in zip(columns[0].tolist(), columns[1], columns[2], columns[3].tolist(), strict=True)
            ]
            yield sorted([*samples, *others], key=lambda m: (m.stamp_ns, m.seq)), columns[0], true


def _resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MIB


def measured(hours: float, seed: int = 0) -> Iterator[Minute]:
    """Run it; one thing at a time, on two cores."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:2]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as other:
            config = other.submit(simulated, hours, seed, path).result()
        smoother = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL)
        for n, (messages, stamps, true) in enumerate(_minutes(path)):
            took_ms, cpu_ms, squared = [], [], []
            for m in messages:
                begin, cpu = time.perf_counter(), time.process_time()
                estimate = smoother.feed(m)
                if estimate is not None:
                    cpu_ms.append(1e3 * (time.process_time() - cpu))
                    took_ms.append(1e3 * (time.perf_counter() - begin))
                    off = estimate.p_world_m[:2] - true[min(np.searchsorted(stamps, estimate.stamp_ns), len(true) - 1)]
                    squared.append(float(off @ off))
                smoother.rows()
            if took_ms:
                p50, p99, longest = np.quantile(took_ms, [0.5, 0.99, 1.0]).tolist()
                slots, rms_m = smoother.factor_slots, float(np.sqrt(np.mean(squared)))
                yield Minute(n, float(np.median(cpu_ms)), p50, p99, longest, _resident_mib(), slots, rms_m)


def kept(hours: float, table: Path, seed: int = 0) -> list[Minute]:
    """Run it and read it back from the table, minute by minute: it is the memory of this process that is measured."""
    with table.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, [f.name for f in fields(Minute)])
        writer.writeheader()
        for m in measured(hours, seed):
            writer.writerow({k: round(v, 3) for k, v in asdict(m).items()})
            stream.flush()  # hours are not lost where it is cut
    with table.open(encoding="utf-8") as stream:
        lines = [{k: float(v) for k, v in line.items()} for line in csv.DictReader(stream)]
    return [Minute(**{**m, "minute": int(m["minute"]), "factor_slots": int(m["factor_slots"])}) for m in lines]  # type: ignore[arg-type]


def slope(minutes: Sequence[Minute], name: str) -> tuple[float, float]:
    """Growth per hour, and what holds it with 95 % to either side.

    By least squares on means of blocks; the interval is widened for what these still have in common with the next.
    """
    values = np.array([getattr(m, name) for m in minutes if m.minute >= _WARM_MIN])
    at_h = np.array([m.minute for m in minutes if m.minute >= _WARM_MIN]) / 60.0
    count = len(values) // _BLOCK_MIN
    if count < 4:
        return float("nan"), float("nan")
    x, y = (v[: count * _BLOCK_MIN].reshape(count, _BLOCK_MIN).mean(axis=1) for v in (at_h, values))
    x = x - x.mean()
    growth = float(x @ y / (x @ x))
    rest = y - y.mean() - growth * x
    power = float(rest @ rest)
    alike = float(np.clip(rest[1:] @ rest[:-1] / power, 0.0, 0.9)) if power > 0.0 else 0.0
    error = np.sqrt(power / (count - 2) / (x @ x) * (1.0 + alike) / (1.0 - alike))
    return growth, float(student.ppf(0.975, count - 2) * error)


def rows_of(minutes: Sequence[Minute], hours: float) -> list[Row]:
    """The figures; a slope is only said where there are four blocks."""
    steady = [m for m in minutes if m.minute >= _WARM_MIN] or list(minutes)
    rows = []
    item = "E.2" if hours < 24.0 else "E.day"
    told = (
        ("update_cpu_ms", "CPU time of an update (median of each minute)", "ms"),
        ("memory_mib", "resident memory", "MiB"),
    )
    for name, text, unit in told:
        growth, half = slope(minutes, name)
        label = f"{hours:g} h online: {text}"
        rows.append(row(item, f"{label}, mean after 10 min", float(np.mean([getattr(m, name) for m in steady])), unit))
        if np.isfinite(growth):
            rows += [
                row(item, f"{label}, growth", growth, f"{unit}/h"),
                row(item, f"{label}, 95 % of the growth, +-", half, f"{unit}/h"),
                row(item, f"{label}: 0 lies in the interval (1: yes)", abs(growth) <= half, "yes", 1, ">="),
            ]
    hour = min(60, len(steady) // 2)
    first, last = (max(m.factor_slots for m in part) for part in (steady[:hour], steady[-hour:]))
    return [
        *rows,
        row(item, f"{hours:g} h online: places for factors, most in the last hour / most in the first", last / first, "ratio"),
        row(item, f"{hours:g} h online: longest update after 10 min", max(m.update_max_ms for m in steady), "ms"),
        row(item, f"{hours:g} h online: position RMSE", float(np.sqrt(np.mean([m.rms_m**2 for m in steady]))), "m"),
    ]  # fmt: skip


def figures(hours: float) -> list[Row]:
    """For results.py."""
    with tempfile.TemporaryDirectory() as folder:
        return rows_of(kept(hours, Path(folder) / "minutes.csv"), hours)


def day(pool: ProcessPoolExecutor) -> list[Row]:
    """For results.py: 24 h, with the picture."""
    return pool.submit(_pictured, 24.0, 0, Path(__file__).parents[1] / "docs/pictures/soak.png").result()


def _pictured(hours: float, seed: int, out: Path) -> list[Row]:
    minutes = kept(hours, out.with_suffix(".csv"), seed)
    draw(minutes, out)
    return rows_of(minutes, hours)


def draw(minutes: Sequence[Minute], out: Path) -> None:
    """Three strips over the hours."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    at_h = [m.minute / 60.0 for m in minutes]
    figure, strips = plt.subplots(3, 1, sharex=True, figsize=(9.0, 6.0), layout="constrained")
    for name, label in (("update_p99_ms", "99 %"), ("update_p50_ms", "median")):
        strips[0].plot(at_h, [getattr(m, name) for m in minutes], linewidth=0.8, label=label)
    strips[0].legend(loc="upper right")
    for strip, name in ((strips[1], "memory_mib"), (strips[2], "factor_slots")):
        strip.plot(at_h, [getattr(m, name) for m in minutes], linewidth=0.8)
    for strip, text in zip(strips, ("update, ms", "memory, MiB", "places for factors"), strict=True):
        strip.set_ylabel(text)
        strip.set_ylim(0.0, 1.1 * strip.dataLim.y1)
        strip.grid(alpha=0.3)
    strips[2].set_xlabel("h")
    figure.savefig(out, dpi=100)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("soak.png"))
    arguments = parser.parse_args()
    for figure in _pictured(arguments.hours, arguments.seed, arguments.out):
        print(figure["name"], figure["value"], figure["unit"])


if __name__ == "__main__":
    main()
