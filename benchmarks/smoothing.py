# SPDX-License-Identifier: Apache-2.0
"""Figures of A: smoothing of real and simulated runs."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _rows import ROOT, Row, row

from graphloc import app
from graphloc.eval import ekf
from graphloc.eval.holdout import HoldOut
from graphloc.eval.metrics import compare_to_held_out, compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario, simulate
from graphloc.frames import wrap_angle
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.frontends.part import BagPart
from graphloc.measurements import GnssPosition
from graphloc.time import stamps_of
from graphloc.trajectory import Trajectory, bounds_95

HUSKY = ROOT.parent / "shared/data/husky/husky_car_park.bag"
_PARTS_S = (
    (0, 30), (0, 45), (0, 75), (0, 120), (0, 160), (0, 200), (60, 120),
    (120, 45), (120, 90), (180, 60), (180, 120), (240, 60), (240, 120), (300, 60),
)  # begin and length; it drives straight on until 140 s  # fmt: skip


def husky(_pool: ProcessPoolExecutor) -> list[Row]:
    recording, config = app.load([HUSKY], ROOT / "examples/husky/vessel.yaml")
    run = app.smooth_recording(recording, config, hold_out=HoldOut.parse("gaps:8x10"))
    tables = {t.title: t.as_dict()["graphloc"] for t in app.tables(run)}
    held, speed = tables["Against held-out fixes"], tables["Forward speed"]
    return [
        row(
            "A.1",
            "Husky, 8 gaps of 10 s: horizontal RMSE on held-out fixes",
            held["horizontal_rmse_m"],
            "m",
            0.75,
            "<=",
        ),
        row("A.1", "Husky: forward speed less wheels, mean (absolute)", abs(speed["mean_mps"]), "m/s", 0.10, "<="),
        row("A.1", "Husky: forward speed less wheels, std", speed["std_mps"], "m/s", 0.25, "<="),
        *_wheels_fused(),
        *_headings_of_parts(),
    ]


def _wheels_fused() -> list[Row]:
    """As `inspect` drafts it, wheels switched on and off; of held-out fixes how well they are predicted, as the fixes wander by metres."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        vessel = Path(folder) / "vessel.yaml"
        vessel.write_text(draft_config(inspect_bag(HUSKY)), encoding="utf-8")
        without = app.load([HUSKY], vessel, changes={"check_speed_topic": None})
        fused = app.load([HUSKY], vessel, changes={"check_speed_topic": None, "sensors.wheels.enabled": True})
    for text, bound in (("gaps:8x10", 0.75), ("gaps:3x60", 2.5)):
        found = []
        for recording, config in (fused, without):
            run = app.smooth_recording(recording, config, hold_out=HoldOut.parse(text))
            slow = run.solution.slow
            held = compare_to_held_out(
                run.solution.trajectory, run.held, run.solution.datum, app.antennas(run).of(run.solution.name), slow
            )
            found.append(held.horizontal_rmse_m if held.fix_rmse_m is None else held.fix_rmse_m)
        gaps = text.removeprefix("gaps:").replace("x", " gaps of ") + " s"
        rows += [
            row("A.1", f"Husky as drafted, {gaps}, wheels fused: RMSE of predicted fixes", found[0], "m", bound, "<="),
            row("A.1", f"Husky as drafted, {gaps}, without wheels: RMSE of predicted fixes", found[1], "m"),
        ]
    return rows


def _headings_of_parts() -> list[Row]:
    """No sensor tells the heading: in parts of the run it should differ from that of the whole run by no more than they say."""

    def track(bags: Path | BagPart) -> Trajectory:
        recording, config = app.load(bags, ROOT / "examples/husky/vessel.yaml")
        return app.smooth_recording(recording, config).solution.trajectory

    whole, largest, inside = track(HUSKY), 0.0, []
    for begin_s, length_s in _PARTS_S:
        part = track(BagPart((HUSKY,), float(begin_s), float(length_s)))
        assert part.cov is not None
        apart = wrap_angle(part.yaw_rad - np.interp(part.stamps_ns, whole.stamps_ns, np.unwrap(whole.yaw_rad)))
        largest = max(largest, float(np.abs(apart / np.sqrt(part.cov[:, 5, 5])).max()))
        inside.append(np.mean(np.degrees(np.abs(apart)) < bounds_95(part.cov)[:, 2]))
    of = f"Husky, {len(_PARTS_S)} parts of 30 to 200 s, heading from that of the whole run"
    return [
        row("A.1", f"{of}: largest difference / sigma", largest, "", 3.0, "<="),
        row("A.1", f"{of}: inside the 95 % bounds", float(np.mean(inside)), "", 0.9, ">="),
    ]


def kitti(_pool: ProcessPoolExecutor) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "kitti"
        subprocess.run([sys.executable, str(ROOT / "examples/kitti/make_bag.py"), str(bag)], check=True)
        recording, config = app.load([bag], ROOT / "examples/kitti/vessel.yaml")
    rows = []
    for name, text, bound in (("every 2nd fix", "every:2", 0.2), ("ten gaps of 10 s", "gaps:10x10", 0.6)):
        run = app.smooth_recording(recording, config, hold_out=HoldOut.parse(text))
        held = compare_to_held_out(run.solution.trajectory, run.held, run.solution.datum, {"gnss": np.zeros(3)})
        rows.append(row("A.2", f"KITTI, {name} held out: 3D RMSE", held.error_3d_rmse_m, "m", bound, "<="))
    return rows


def loss_ns(run: SimulatedRun) -> tuple[int, int] | None:
    """Stamps of the simulated signal loss: BL raised a2 by hand while it lasted, so their filter is told."""
    fixes = run.recording.of(GnssPosition)
    stamps = stamps_of(fixes)
    datum = app.choose_datum(run.recording, run.config)
    away = datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T) - run.truth.at(stamps).p_world_m
    lost = stamps[np.hypot(away[:, 0], away[:, 1]) > 6.0]
    return (int(lost[0]), int(lost[-1]) + 1) if len(lost) else None


def _bl(job: tuple[int, str, int]) -> tuple[tuple[int, str, int], dict[str, float | None], dict[str, float]]:
    run = simulate(bl_scenario(job[0], job[1]), job[2])  # type: ignore[arg-type]
    solved = app.simulated(run)
    ours = compare_to_truth(solved.solution.trajectory, run.truth)
    datum = app.choose_datum(run.recording, run.config)
    beside = ekf.run_all(run.recording, run.config, datum, ekf.BlConfig(loss_ns=loss_ns(run)))
    filters = {f.name: compare_to_truth(f.trajectory, run.truth).position_rmse_m for f in beside}
    return job, {"rmse": ours.position_rmse_m, "heading": ours.heading_rmse_deg, "coverage": ours.coverage_95}, filters


def bl_cases(pool: ProcessPoolExecutor, seeds: int = 10) -> list[Row]:
    jobs = [(case, noise, seed) for case in (1, 2, 3) for noise in ("drift", "jump") for seed in range(seeds)]
    done = list(pool.map(_bl, jobs))
    rows = []
    for case in (1, 2, 3):
        for noise in ("drift", "jump"):
            mine = [d for d in done if d[0][:2] == (case, noise)]
            label = f"BL case {case}, {noise}, {seeds} seeds"
            rmse = float(np.mean([d[1]["rmse"] for d in mine]))
            worst = float(np.max([d[1]["rmse"] for d in mine]))
            bl, honest = (float(np.mean([d[2][n] for d in mine])) for n in ("BL EKF", "honest EKF"))
            heading = float(np.mean([d[1]["heading"] for d in mine]))
            coverage = 100.0 * float(np.mean([d[1]["coverage"] for d in mine]))
            rows += [
                row("A.3", f"{label}: position RMSE, mean", rmse, "m", 0.2, "<="),
                row("A.3", f"{label}: position RMSE, worst seed", worst, "m"),
                row("A.3", f"{label}: position RMSE of the BL EKF (told of a signal loss)", bl, "m"),
                row("A.3", f"{label}: RMSE / that of the BL EKF", rmse / bl, "ratio", 0.2, "<="),
                row("A.3", f"{label}: RMSE / that of the honest EKF", rmse / honest, "ratio"),
                row("A.3", f"{label}: heading RMSE", heading, "deg", 0.3, "<="),
                row("A.3", f"{label}: 95 % coverage", coverage, "%", 90.0, ">="),
                row("A.3", f"{label}: 95 % coverage, not too wide", coverage, "%", 99.0, "<="),
            ]
    return rows


def hard_start(seed: int) -> SimulatedRun:
    """A minute that begins with a gyro bias of 1 to 3 deg/s and a heading 5 to 15 deg off; one in four has no compass."""
    rng = np.random.default_rng(seed)
    scenario = replace(
        bl_scenario(1 + seed % 2, "drift"), duration_s=60.0, gyro_bias_radps=float(rng.uniform(0.02, 0.05)),
        start_heading_error_deg=float(rng.choice([-1, 1]) * rng.uniform(5.0, 15.0)), compass_until_s=0.0 if seed % 4 == 3 else 1e9,
    )  # fmt: skip
    return simulate(scenario, seed)


def _start(seed: int) -> tuple[bool, float, float]:
    run = hard_start(seed)
    solved = app.simulated(run).solution
    ratio = solved.stats.cost / max(solved.stats.expected_cost, 1.0)
    heading = compare_to_truth(solved.trajectory, run.truth).heading_max_deg
    return heading <= 1.0 and 0.3 < ratio < 2.0, heading, ratio


def starts(pool: ProcessPoolExecutor) -> list[Row]:
    done = list(pool.map(_start, range(20)))
    return [
        row("A.4", "bad starts (gyro bias to 0.05 rad/s, heading to 15 deg): runs lost of 20", sum(not d[0] for d in done), "runs", 0, "<="),
        row("A.4", "bad starts: largest heading error of any run", max(d[1] for d in done), "deg"),
        row("A.4", "bad starts: largest cost / expectation", max(d[2] for d in done), "ratio"),
    ]  # fmt: skip


def _outage(job: tuple[float, int]) -> tuple[float, bool, bool, bool]:
    length, seed = job
    begin = 60.0
    scenario = replace(
        Scenario(path="loops", noise="drift"), duration_s=begin + length + 40.0, outage_s=(begin, begin + length)
    )
    run = simulate(scenario, seed)
    solved = app.simulated(run, compare=True)
    at = run.truth.stamps_ns[round((begin + length + 10.0) * 100.0)] * np.ones(1, dtype=np.int64)
    true = run.truth.at(at).p_world_m[0, :2]

    def back(track: Any) -> bool:
        return bool(np.hypot(*(track.at(at).p_world_m[0, :2] - true)) <= 1.0)

    return (length, back(solved.solution.trajectory), *(back(f.trajectory) for f in solved.filters))  # type: ignore[return-value]


def outages(pool: ProcessPoolExecutor) -> list[Row]:
    done = list(pool.map(_outage, [(length, seed) for length in (20.0, 60.0, 120.0) for seed in range(20)]))
    rows = []
    for length in (20.0, 60.0, 120.0):
        mine = [d for d in done if d[0] == length]
        label = f"GNSS and matches out for {length:.0f} s: within 1 m 10 s after, of 20"
        rows.append(row("A.5", label, sum(d[1] for d in mine), "runs", 20, ">="))
        rows.append(row("A.5", f"{label}: BL EKF", sum(d[2] for d in mine), "runs"))
        rows.append(row("A.5", f"{label}: honest EKF", sum(d[3] for d in mine), "runs"))
    return rows


def speed(_pool: ProcessPoolExecutor) -> list[Row]:
    """On two cores; the 2 min run three times, the middle one counts."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:2]))
    rows, per_second = [], {}
    for name, seconds in (("2 min", 120.0), ("20 min", 1200.0), ("2 h", 7200.0)):
        path = "entry" if seconds == 120.0 else "loops"
        run = simulate(Scenario(path=path, noise="drift", duration_s=seconds), 0)  # type: ignore[arg-type]
        times = []
        for _ in range(3 if seconds == 120.0 else 1):
            begin = time.perf_counter()
            solved = app.simulated(run)
            times.append(time.perf_counter() - begin)
        took = sorted(times)[len(times) // 2]
        per_second[name] = took / seconds
        bound = (30.0, ">=") if name == "2 min" else (None, "info")
        rows.append(
            row("A.6", f"{name} run with covariances: times faster than real time", seconds / took, "x", *bound)
        )
        rows.append(row("A.6", f"{name} run: solver iterations", solved.solution.stats.iterations, "count"))
        ours = compare_to_truth(solved.solution.trajectory, run.truth)
        rows.append(row("A.6", f"{name} run: position RMSE", ours.position_rmse_m, "m"))
    growth = per_second["2 h"] / per_second["20 min"]
    rows.append(row("A.6", "time per second of run, 2 h against 20 min", growth, "ratio", 1.3, "<="))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0**2
    rows.append(row("A.6", "largest memory of the process after the 2 h run", peak, "GiB"))
    return rows
