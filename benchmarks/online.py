# SPDX-License-Identifier: Apache-2.0
"""Figures of E: the online mode. An error is that of an estimate when it was made."""

from __future__ import annotations

import fcntl
import gc
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import soak
from _rows import ROOT, Row, row
from ruamel.yaml import YAML
from scipy.stats import chi2
from smoothing import hard_start, loss_ns

from graphloc import app
from graphloc.config import effective
from graphloc.errors import SolveError
from graphloc.eval import ekf
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario, harbour_scenarios, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import wrap_angle
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, ImuSample, Measurement, PoseFix
from graphloc.online import OnlineSmoother
from graphloc.replay import replay

sys.path.append(str(ROOT))
from tests import faults as bad
from tests import tagfactory

_LOOPS = Scenario(path="loops", noise="drift")
_HORIZONTAL = slice(0, 2)
_SLOW_S = 30.0  # a recovery that is worth a look
_FALSE_M = 1.5  # from the truth: right matches err by tenths of it
Case = tuple[int, str, int]
Values = dict[str, float]


def _smoother(run: SimulatedRun, lag_s: float = 10.0) -> OnlineSmoother:
    return OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL, mounts=run.recording.mounts, lag_s=lag_s)


def _cut(run: SimulatedRun, length_s: float) -> int:
    return int(run.truth.stamps_ns[0]) + round(length_s * 1e9)


def _off_m(run: SimulatedRun, stamps_ns: Any, p_world_m: Any) -> Any:
    """Horizontal errors (N,) at increasing stamps."""
    true = run.truth.at(np.array(stamps_ns, dtype=np.int64)).p_world_m
    return np.hypot(*(np.asarray(p_world_m) - true).T[_HORIZONTAL])


# E.1: accuracy


def _case(job: Case) -> tuple[Case, Values]:
    run = simulate(bl_scenario(job[0], job[1]), job[2])  # type: ignore[arg-type]
    track = replay(run.recording, run.config).solution.trajectory
    true = run.truth.at(track.stamps_ns)  # filters are compared where there are estimates
    ours = compare_to_truth(track, true)
    assert ours.coverage_95 is not None
    span = (track.stamps_ns[-1] - track.stamps_ns[0]) / (run.truth.stamps_ns[-1] - run.truth.stamps_ns[0])
    datum = app.choose_datum(run.recording, run.config)
    told = ekf.run_all(run.recording, run.config, datum, ekf.BlConfig(loss_ns=loss_ns(run)))
    plain = next(f for f in ekf.run_all(run.recording, run.config, datum) if f.name == "BL EKF")
    return job, {
        "rmse": ours.position_rmse_m, "heading": ours.heading_rmse_deg, "coverage": ours.coverage_95, "span": span,
        **{f.name: compare_to_truth(f.trajectory, true).position_rmse_m for f in told},
        "untold": compare_to_truth(plain.trajectory, true).position_rmse_m,
    }  # fmt: skip


def _without_false(job: Case) -> float:
    """RMSE of the run with its false matches taken out: what the rest can give."""
    run = simulate(bl_scenario(job[0], job[1]), job[2])  # type: ignore[arg-type]
    right = [
        m for m in run.recording.measurements
        if not isinstance(m, PoseFix) or _off_m(run, [m.stamp_ns], [m.modes[0].value])[0] < _FALSE_M
    ]  # fmt: skip
    track = replay(replace(run.recording, measurements=tuple(right)), run.config).solution.trajectory
    return compare_to_truth(track, run.truth.at(track.stamps_ns)).position_rmse_m


def _to_batch(job: Case) -> Any:
    """Distance of each state of a lag as long as the run from the batch's, m."""
    scenario = replace(bl_scenario(job[0], job[1]), duration_s=60.0)  # type: ignore[arg-type]
    run = simulate(scenario, job[2])
    smoother = _smoother(run, lag_s=2.0 * scenario.duration_s)
    for a in bad.arrivals_of(run):
        smoother.feed(a.m)
    window = smoother.window()
    unheard = {
        row.seq for row in smoother.finish() if row.reason == "the run ended before there was a state at its stamp"
    }
    heard = tuple(m for m in run.recording.measurements if m.seq not in unheard)
    batch = app.simulated(replace(run, recording=replace(run.recording, measurements=heard))).solution.trajectory
    assert window is not None
    there = window.stamps_ns[batch.covers(window.stamps_ns)]
    return np.linalg.norm(window.at(there).p_world_m - batch.at(there).p_world_m, axis=1)


def cases(pool: ProcessPoolExecutor, seeds: int = 10, batches: int = 5) -> list[Row]:
    jobs = [(case, noise, seed) for case in (1, 2, 3) for noise in ("drift", "jump") for seed in range(seeds)]
    done = list(pool.map(_case, jobs))
    rows = []
    for case in (1, 2, 3):
        for noise in ("drift", "jump"):
            mine = [values for job, values in done if job[:2] == (case, noise)]
            mean = {name: float(np.mean([v[name] for v in mine])) for name in mine[0]}
            rmse, label = mean["rmse"], f"online, BL case {case}, {noise}, {seeds} seeds"
            rows += [
                row("E.1", f"{label}: position RMSE, mean", rmse, "m", 0.4, "<="),
                row("E.1", f"{label}: position RMSE, worst seed", max(v["rmse"] for v in mine), "m"),
                row("E.1", f"{label}: RMSE of the BL EKF there (told of a signal loss)", mean["BL EKF"], "m"),
                row("E.1", f"{label}: RMSE / that of the BL EKF (told)", rmse / mean["BL EKF"], "ratio", 1 / 3, "<="),
                row(
                    "E.1",
                    f"{label}: RMSE / that of the BL EKF that is told of no loss, as on a vessel",
                    rmse / mean["untold"],
                    "ratio",
                    1 / 3,
                    "<=",
                ),
                row("E.1", f"{label}: RMSE / that of the honest EKF", rmse / mean["honest EKF"], "ratio"),
                row("E.1", f"{label}: heading RMSE", mean["heading"], "deg"),
                row("E.1", f"{label}: 95 % coverage", 100.0 * mean["coverage"], "%"),
                row("E.1", f"{label}: share of the run with estimates", 100.0 * mean["span"], "%"),
            ]
    for case in (1, 2):
        least = list(pool.map(_without_false, [(case, "jump", seed) for seed in range(seeds)]))
        label = f"online, BL case {case}, jump, {seeds} seeds"
        what = "for scale, its false matches taken out by the truth: position RMSE, mean"
        rows.append(row("E.1", f"{label}: {what}", float(np.mean(least)), "m"))
    away = np.concatenate(list(pool.map(_to_batch, [(1, "drift", seed) for seed in range(batches)])))
    label = f"a lag as long as the run against the batch, 60 s, {batches} seeds: distance"
    return [
        *rows,
        row("E.1", f"{label}, 95 %", float(np.quantile(away, 0.95)), "m", 0.02, "<="),
        row("E.1", f"{label}, max", float(away.max()), "m", 0.02, "<="),
    ]


# E.2: time


def _docking() -> SimulatedRun:
    """An approach with tags, their corners as a camera would find them."""
    return tagfactory.sighted(simulate(harbour_scenarios()["dock-fixed-optimal"], 0))[0]


def _took_s(docking: bool) -> tuple[float, Any]:
    """In a process of its own, since threads that are there already would keep all cores: the start, the updates."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:2]))
    run = _docking() if docking else simulate(bl_scenario(1, "drift"), 0)
    gc.freeze()  # as `graphloc stream` and `graphloc replay` do
    took = replay(run.recording, run.config).update_s
    return float(took[0]), took[1:]


def latency(pool: ProcessPoolExecutor, times: int = 3, soak_hours: float = 2.0) -> list[Row]:
    """On two cores, one thing at a time; each figure is the middle of three runs."""
    rows = []
    for docking, name in ((False, "BL case 1, 120 s"), (True, "docking by tags, 120 s")):
        done = [pool.submit(_took_s, docking).result() for _ in range(times)]
        label = f"{name}, 10 states/s on two cores: an update"
        for text, q, bound in (("median", 0.5, 5.0), ("99 %", 0.99, 20.0), ("max", 1.0, 100.0)):
            took_ms = float(np.median([1e3 * np.quantile(updates, q) for _, updates in done]))
            rows.append(row("E.2", f"{label}, {text}", took_ms, "ms", bound, "<="))
        start_ms = 1e3 * float(np.median([start for start, _ in done]))
        rows.append(row("E.2", f"{name}, on two cores: the start, no update", start_ms, "ms"))
    if soak_hours:
        rows += pool.submit(soak.figures, soak_hours).result()
    return rows


# E.3: starts, outages


def _start(seed: int) -> tuple[float, float, float, float] | None:
    """S to the first estimate, its errors in m and deg, the largest in deg at the end."""
    run = hard_start(seed)
    try:
        found = replay(run.recording, run.config)
    except SolveError:
        return None
    track, first = found.solution.trajectory, found.estimates[0].stamp_ns
    off_deg = np.degrees(np.abs(wrap_angle(track.yaw_rad - run.truth.at(track.stamps_ns).yaw_rad)))
    last = off_deg[track.stamps_ns >= _cut(run, 50.0)]
    off_m = _off_m(run, track.stamps_ns[:1], track.p_world_m[:1])
    waited_s = (first - int(run.truth.stamps_ns[0])) * 1e-9
    return waited_s, float(off_m[0]), float(off_deg[0]), float(last.max()) if len(last) else np.inf


def _outage(job: tuple[float, int]) -> tuple[float, float]:
    """Error 10 s after an outage, m."""
    length, seed = job
    end = 60.0 + length
    run = simulate(replace(_LOOPS, duration_s=end + 12.0, outage_s=(60.0, end)), seed)
    track = replay(run.recording, run.config).solution.trajectory
    n = int(np.searchsorted(track.stamps_ns, _cut(run, end + 10.0), side="right")) - 1
    return length, float(_off_m(run, track.stamps_ns[n : n + 1], track.p_world_m[n : n + 1])[0])


def starts(pool: ProcessPoolExecutor, seeds: int = 20) -> list[Row]:
    done = list(pool.map(_start, range(seeds)))
    began = [d for d in done if d is not None]
    waited, off_m, off_deg, last_deg = np.array(began).reshape(-1, 4).T
    label = "online, bad starts (as A.4)"
    rows = [
        row("E.3", f"{label}: runs lost of {seeds} (over 1 deg in the last 10 s)", seeds - int((last_deg <= 1.0).sum()), "runs", 0, "<="),
        row("E.3", f"{label}: largest heading error in the last 10 s of any run", last_deg.max(), "deg"),
    ]  # fmt: skip
    for name, values, unit in (
        ("first message to first estimate", waited, "s"),
        ("position error of the first estimate", off_m, "m"),
        ("heading error of the first estimate", off_deg, "deg"),
    ):
        rows.append(row("E.3", f"{label}: {name}, median", float(np.median(values)), unit))
        rows.append(row("E.3", f"{label}: {name}, max", values.max(), unit))
    lengths = (20.0, 60.0, 120.0)
    outages = list(pool.map(_outage, [(length, seed) for length in lengths for seed in range(seeds)]))
    for length in lengths:
        off = [d[1] for d in outages if d[0] == length]
        label = f"online, GNSS and matches out for {length:.0f} s"
        back = sum(o <= 1.0 for o in off)
        rows.append(row("E.3", f"{label}: within 1 m 10 s after, of {seeds}", back, "runs", seeds, ">="))
        rows.append(row("E.3", f"{label}: largest error 10 s after", max(off), "m"))
    return rows


# E.4: out of order


def _fed(run: SimulatedRun, arrivals: bad.Arrivals) -> tuple[Any, int, int]:
    """Where the vessel is at the last stamp (inf: not known), messages without their one row, and those not taken."""
    smoother = _smoother(run)
    rows = []
    for a in arrivals:
        smoother.feed(a.m)
        rows += smoother.rows()
    pose = smoother.predict(int(run.truth.stamps_ns[-1]))
    rows += smoother.finish()
    count = Counter(r.seq for r in rows)
    wrong = sum(count[a.m.seq] != 1 for a in arrivals) + len(count.keys() - {a.m.seq for a in arrivals})
    place = np.full(3, np.inf) if pose is None else pose.p_world_m
    return place, wrong, sum(r.outcome in (Outcome.LATE, Outcome.REJECTED) and "judged" not in r.reason for r in rows)


def _shuffled(seed: int) -> list[tuple[float, int, int]]:
    """With the IMU in order, and delayed too: m from the pose in order; as above."""
    run = simulate(replace(bl_scenario(1, "drift"), duration_s=60.0), seed)
    silent_ns = _cut(run, 57.0)  # so that all has arrived at the end
    ordered = [a for a in bad.arrivals_of(run) if isinstance(a.m, ImuSample) or a.true_ns < silent_ns]
    place, *_ = _fed(run, ordered)
    assert np.isfinite(place).all()
    found = []
    for imu in (False, True):
        late, wrong, unused = _fed(run, bad.delayed(ordered, np.random.default_rng([seed, 4]), 2.0, imu=imu))
        found.append((float(np.linalg.norm(late - place)), wrong, unused))
    return found


def shuffled(pool: ProcessPoolExecutor, seeds: int = 5) -> list[Row]:
    done = list(pool.map(_shuffled, range(seeds)))
    rows = []
    for which, name in enumerate(("each message but the IMU's", "each message, the IMU's too,")):
        mine = [d[which] for d in done]
        label = f"{name} 0 to 2 s late, {seeds} runs of 60 s"
        rows += [
            row("E.4", f"{label}: final pose from that in order, max", max(d[0] for d in mine), "m", 0.01, "<="),
            row("E.4", f"{label}: messages without their one row", sum(d[1] for d in mine), "count", 0, "<="),
            row("E.4", f"{label}: late or not taken", sum(d[2] for d in mine), "count"),
        ]
    return rows


# E.5: faults, kills


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
    run = simulate(replace(_LOOPS, duration_s=130.0), seed)
    arrivals, over_ns = bad.FAULTS[name](bad.arrivals_of(run), _cut(run, float(rng.uniform(15.0, 30.0))), rng)
    arrivals, smoother, fed = bad.numbered(arrivals), _smoother(run), bad.Fed()
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
    run = simulate(replace(_LOOPS, duration_s=130.0), seed)
    return bad.feed(_smoother(run), run, bad.arrivals_of(run)).worst_m(_cut(run, 15.0))


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
    run = simulate(replace(_LOOPS, duration_s=60.0), seed)
    lines = [(a.true_ns, _line(a.m)) for a in bad.arrivals_of(run)]
    killed_s = float(rng.uniform(12.0, 40.0))
    again_s = killed_s + float(rng.uniform(0.5, 5.0))  # what comes while nobody reads is lost
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with (folder / "vessel.yaml").open("w", encoding="utf-8") as stream:
            YAML(typ="safe", pure=True).dump(effective(run.config), stream)
        _stream(folder, [line for at, line in lines if at < _cut(run, killed_s)], kill=True)
        said = _stream(folder, [line for at, line in lines if at >= _cut(run, again_s)], kill=False)
    poses = [s for s in said if s["type"] == "estimate"]
    if not poses or said[-1]["type"] != "end":
        return None
    resumed = any(s["type"] == "event" and s["text"].startswith("resumed") for s in said)
    stamps = np.array([s["stamp_ns"] for s in poses])
    off = _off_m(run, stamps, [s["map"]["xyz_m"] for s in poses])
    after = [float(off[stamps >= _cut(run, again_s + wait_s)].max()) for wait_s in (1.0, 10.0)]
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


# E.6: odom


def _steps(job: tuple[Scenario, int]) -> Any:
    """Of each step (N, 2): squared error of odom over its own covariance, and by how much map jumped, m."""
    run = simulate(*job)
    found: list[tuple[float, float]] = []
    estimates = replay(run.recording, run.config).estimates
    for a, b in itertools.pairwise(estimates):
        if b.stamp_ns <= a.stamp_ns:
            continue
        true = run.truth.at(np.array([a.stamp_ns, b.stamp_ns]))
        moved = a.R_odom_body @ true.R_world_body[0].T @ (true.p_world_m[1] - true.p_world_m[0])
        off = b.p_odom_m - a.p_odom_m - moved
        t, R = a.map_from_odom
        jump = b.p_world_m - (t + R @ b.p_odom_m)
        found.append((float(off @ np.linalg.solve(b.step_cov[:3, :3], off)), float(np.hypot(*jump[_HORIZONTAL]))))
    return np.array(found)


def odometry(pool: ProcessPoolExecutor, seeds: int = 3) -> list[Row]:
    outage = [replace(_LOOPS, duration_s=72.0 + length, outage_s=(60.0, 60.0 + length)) for length in (20.0, 60.0)]
    cases = [bl_scenario(case, noise) for case in (1, 2, 3) for noise in ("drift", "jump")]
    rows = []
    for name, scenarios in (("BL's cases", cases), ("outages of 20 and 60 s", outage)):
        parts = pool.map(_steps, [(scenario, seed) for scenario in scenarios for seed in range(seeds)])
        squared, jumps = np.concatenate(list(parts)).T
        label = f"odom, {name}, {seeds} seeds each"
        within = 100.0 * float((squared <= chi2.ppf(0.99, 3)).mean())
        rows += [
            row("E.6", f"{label}: steps within their own 99 %", within, "%", 99.0, ">="),
            row("E.6", f"{label}: largest error of a step", float(np.sqrt(squared.max())), "sigma"),
            row("E.6", f"{label}: for scale, largest jump of map", jumps.max(), "m"),
        ]
    return rows
