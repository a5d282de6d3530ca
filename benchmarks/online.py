# SPDX-License-Identifier: Apache-2.0
"""Figures of E: the online mode. An error is that of an estimate when it was made."""

from __future__ import annotations

import gc
import itertools
import os
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import soak
from _rows import ROOT, Row, row
from scipy.stats import chi2
from smoothing import hard_start, loss_ns

from graphloc import app
from graphloc.errors import SolveError
from graphloc.eval import ekf
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario, harbour_scenarios, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import wrap_angle
from graphloc.ledger import Outcome
from graphloc.measurements import ImuSample, PoseFix
from graphloc.online import OnlineSmoother
from graphloc.replay import replay

sys.path.append(str(ROOT))
from tests import faults as bad
from tests import tagfactory

LOOPS = Scenario(path="loops", noise="drift")
_HORIZONTAL = slice(0, 2)
_FALSE_M = 1.5  # from the truth: right matches err by tenths of it
Case = tuple[int, str, int]
Values = dict[str, float]


def smoother_for(run: SimulatedRun, lag_s: float = 10.0) -> OnlineSmoother:
    return OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL, mounts=run.recording.mounts, lag_s=lag_s)


def cut(run: SimulatedRun, length_s: float) -> int:
    return int(run.truth.stamps_ns[0]) + round(length_s * 1e9)


def horizontal_off_m(run: SimulatedRun, stamps_ns: Any, p_world_m: Any) -> Any:
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
        if not isinstance(m, PoseFix) or horizontal_off_m(run, [m.stamp_ns], [m.modes[0].value])[0] < _FALSE_M
    ]  # fmt: skip
    track = replay(replace(run.recording, measurements=tuple(right)), run.config).solution.trajectory
    return compare_to_truth(track, run.truth.at(track.stamps_ns)).position_rmse_m


def _to_batch(job: Case) -> Any:
    """Distance of each state of a lag as long as the run from the batch's, m."""
    scenario = replace(bl_scenario(job[0], job[1]), duration_s=60.0)  # type: ignore[arg-type]
    run = simulate(scenario, job[2])
    smoother = smoother_for(run, lag_s=2.0 * scenario.duration_s)
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
    last = off_deg[track.stamps_ns >= cut(run, 50.0)]
    off_m = horizontal_off_m(run, track.stamps_ns[:1], track.p_world_m[:1])
    waited_s = (first - int(run.truth.stamps_ns[0])) * 1e-9
    return waited_s, float(off_m[0]), float(off_deg[0]), float(last.max()) if len(last) else np.inf


def _outage(job: tuple[float, int]) -> tuple[float, float]:
    """Error 10 s after an outage, m."""
    length, seed = job
    end = 60.0 + length
    run = simulate(replace(LOOPS, duration_s=end + 12.0, outage_s=(60.0, end)), seed)
    track = replay(run.recording, run.config).solution.trajectory
    n = int(np.searchsorted(track.stamps_ns, cut(run, end + 10.0), side="right")) - 1
    return length, float(horizontal_off_m(run, track.stamps_ns[n : n + 1], track.p_world_m[n : n + 1])[0])


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
    smoother = smoother_for(run)
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
    silent_ns = cut(run, 57.0)  # so that all has arrived at the end
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
    outage = [replace(LOOPS, duration_s=72.0 + length, outage_s=(60.0, 60.0 + length)) for length in (20.0, 60.0)]
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
