# SPDX-License-Identifier: Apache-2.0
"""Figures of E.5: the online mode under faults of every kind, and killed in the middle of a stream."""

from __future__ import annotations

import fcntl
import json
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from _rows import ROOT, Row, row
from online import LOOPS, cut, horizontal_off_m, smoother_for
from ruamel.yaml import YAML

from graphloc.config import effective
from graphloc.eval.simulate import simulate
from graphloc.measurements import CompassHeading, GnssPosition, ImuSample, Measurement, PoseFix

sys.path.append(str(ROOT))
from tests import faults as bad

_SLOW_S = 30.0  # a recovery that is worth a look


@dataclass(frozen=True)
class Faulted:
    """A fault that was fed: what went wrong, if anything, and s from its end until the error was below 3 m."""

    name: str
    seed: int
    crash: str = ""
    complaints: tuple[str, ...] = ()
    recovered_s: float = np.inf


def _fault(job: tuple[str, int]) -> Faulted:
    name, seed = job
    rng = np.random.default_rng([seed, list(bad.FAULTS).index(name), 5])
    run = simulate(replace(LOOPS, duration_s=130.0), seed)
    arrivals, over_ns = bad.FAULTS[name](bad.arrivals_of(run), cut(run, float(rng.uniform(15.0, 30.0))), rng)
    arrivals, smoother, fed = bad.numbered(arrivals), smoother_for(run), bad.Fed()
    enough = next((n for n, a in enumerate(arrivals) if a.true_ns > over_ns + 10 * bad.STEP_NS), len(arrivals))
    try:
        bad.feed(smoother, run, arrivals[:enough], fed)
        if fed.recovered_s(over_ns) < np.inf:
            arrivals = arrivals[:enough]
        bad.feed(smoother, run, arrivals[enough:], fed)
        bad.finish(smoother, fed)
    except Exception:  # noqa: BLE001 - that is what is counted
        return Faulted(name, seed, traceback.format_exc(limit=-1).replace("\n", " "))
    return Faulted(name, seed, "", tuple(bad.complaints(arrivals, fed)), fed.recovered_s(over_ns))


def _worst_m(seed: int) -> float:
    """Of such a run without a fault, from 15 s on."""
    run = simulate(replace(LOOPS, duration_s=130.0), seed)
    return bad.feed(smoother_for(run), run, bad.arrivals_of(run)).worst_m(cut(run, 15.0))


def _line(m: Measurement) -> bytes:
    """What `graphloc stream` reads."""
    said: dict[str, Any] = {"stamp_ns": m.stamp_ns, "sensor": m.sensor}
    if isinstance(m, ImuSample):
        said |= {"type": "imu", "accel_mps2": m.accel_mps2.tolist(), "gyro_radps": m.gyro_radps.tolist()}
    elif isinstance(m, GnssPosition):
        lat, lon, height = m.position
        said |= {
            "type": "gnss",
            "lat_deg": lat,
            "lon_deg": lon,
            "height_m": height,
            "cov_enu_m2": m.cov_enu_m2.tolist(),
        }
    elif isinstance(m, CompassHeading):
        said |= {"type": "heading", "yaw_rad": m.yaw_rad, "sigma_deg": float(np.degrees(m.sigma_rad))}
    elif isinstance(m, PoseFix):
        modes = []
        for mode in m.modes:
            x, y, yaw = mode.value.tolist()
            cov = np.eye(6)
            cov[np.ix_([0, 1, 5], [0, 1, 5])] = mode.cov
            modes.append({"xyz_m": [x, y, 0.0], "rpy_deg": [0.0, 0.0, float(np.degrees(yaw))],
                          "cov_m_rad": cov.tolist(), "probability": mode.probability})  # fmt: skip
        said |= {"type": "pose", "modes": modes}
    return json.dumps(said).encode() + b"\n"


def _stream(folder: Path, lines: Sequence[bytes], kill: bool) -> list[dict[str, Any]]:
    """Feed a `graphloc stream` as fast as it reads; kill it once all is written, or let it end."""
    command = [sys.executable, "-m", "graphloc", "stream"]
    options = ["-c", str(folder / "vessel.yaml"), "--snapshot", str(folder / "snapshot.json")]
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        child = subprocess.Popen([*command, *options], stdin=subprocess.PIPE, stdout=out, stderr=err, bufsize=0)
    assert child.stdin is not None
    fcntl.fcntl(child.stdin, fcntl.F_SETPIPE_SZ, 4096)  # so that it is never far behind
    with child.stdin as pipe:
        for line in lines:
            pipe.write(line)
        if kill:
            child.send_signal(signal.SIGKILL)
    child.wait()
    whole = [line for line in (folder / "out").read_bytes().split(b"\n")[:-1] if line]
    return [json.loads(line) for line in whole]


def _killed(seed: int) -> tuple[bool, bool, float, float, float] | None:
    """Whether it resumed, whether the first bound holds, error of the first estimate, largest from 1 s, 10 s on, m."""
    rng = np.random.default_rng([seed, 9])
    run = simulate(replace(LOOPS, duration_s=60.0), seed)
    lines = [(a.true_ns, _line(a.m)) for a in bad.arrivals_of(run)]
    killed_s = float(rng.uniform(12.0, 40.0))
    again_s = killed_s + float(rng.uniform(0.5, 5.0))  # what comes while nobody reads is lost
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with (folder / "vessel.yaml").open("w", encoding="utf-8") as stream:
            YAML(typ="safe", pure=True).dump(effective(run.config), stream)
        _stream(folder, [line for at, line in lines if at < cut(run, killed_s)], kill=True)
        said = _stream(folder, [line for at, line in lines if at >= cut(run, again_s)], kill=False)
    poses = [s for s in said if s["type"] == "estimate"]
    if not poses or said[-1]["type"] != "end":
        return None
    resumed = any(s["type"] == "event" and s["text"].startswith("resumed") for s in said)
    stamps = np.array([s["stamp_ns"] for s in poses])
    off = horizontal_off_m(run, stamps, [s["map"]["xyz_m"] for s in poses])
    after = [float(off[stamps >= cut(run, again_s + wait_s)].max()) for wait_s in (1.0, 10.0)]
    return resumed, bool(off[0] <= poses[0]["bound_95_m"]), float(off[0]), after[0], after[1]


def faults(pool: ProcessPoolExecutor, count: int = 1000, kills: int = 50) -> list[Row]:
    names = list(bad.FAULTS)
    jobs = [(names[n % len(names)], n // len(names)) for n in range(count)]
    done = list(pool.map(_fault, jobs, chunksize=4))
    for d in done:
        if d.crash or d.complaints or d.recovered_s > _SLOW_S:
            what = d.crash or "; ".join(d.complaints) or f"within 3 m after {d.recovered_s:.0f} s"
            print(f"E.5: {d.name}, seed {d.seed}: {what}"[:300])
    survived = [d for d in done if not d.crash]
    runs = sorted({seed for _, seed in jobs})
    astray = sum(m >= 3.0 for m in pool.map(_worst_m, runs))
    took = np.array([d.recovered_s for d in survived if d.recovered_s < np.inf])
    label = f"{count} faults of {len(names)} kinds"
    rows = [
        row("E.5", f"{label}: crashes", count - len(survived), "count", 0, "<="),
        row("E.5", f"{label}: ledgers that do not add up, estimates that are no numbers", sum(bool(d.complaints) for d in survived), "count", 0, "<="),
        row("E.5", f"{label}: of the {len(runs)} runs, over 3 m off at some time without a fault", astray, "runs"),
        row("E.5", f"{label}: never within 3 m again", len(survived) - len(took), "count", 0, "<="),
        row("E.5", f"{label}: from its end until within 3 m, median", float(np.median(took)), "s"),
        row("E.5", f"{label}: from its end until within 3 m, 95 %", float(np.quantile(took, 0.95)), "s"),
        row("E.5", f"{label}: from its end until within 3 m, max", took.max(), "s"),
    ]  # fmt: skip
    if not kills:
        return rows
    ends = list(pool.map(_killed, range(kills)))
    alive = np.array([e for e in ends if e is not None], dtype=float).reshape(-1, 5)
    label = f"stream killed (-9) {kills} times, started again 0.5 to 5 s later"
    rows += [
        row("E.5", f"{label}: resumed from the snapshot", int(alive[:, 0].sum()), "count", kills, ">="),
        row("E.5", f"{label}: no estimate, or no end", kills - len(alive), "count", 0, "<="),
        row("E.5", f"{label}: first estimate within its own 95 %", 100.0 * float(alive[:, 1].mean()), "%"),
    ]
    for column, text in ((2, "error of the first estimate"), (3, "largest error from 1 s on"), (4, "largest error from 10 s on")):  # fmt: skip
        rows.append(row("E.5", f"{label}: {text}, median", float(np.median(alive[:, column])), "m"))
        rows.append(row("E.5", f"{label}: {text}, max", alive[:, column].max(), "m"))
    return rows
