# SPDX-License-Identifier: Apache-2.0
"""Figures of the calibration aids: what they find of planted errors, how sure they rightly are, and what they make up.

`python benchmarks/calibration.py [SEEDS]` prints them; `benchmarks/results.py --only F.cal` writes them down.
"""

from __future__ import annotations

import os
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
from smoothing import HUSKY

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.eval.calibrate import PROBE, Calibration
from graphloc.eval.simulate import Scenario, bl_scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.recording import Recording
from graphloc.solve import smooth

# As in the thesis: fixes that drift, four matches of ten false. In the open: turns, and fixes good to 3 cm.
SCENES: dict[str, Scenario] = {
    "drift": bl_scenario(1, "drift"),
    "open": replace(bl_scenario(1, "clean"), path="loops", duration_s=180.0, gnss_sigma_m=0.03),
}
LEVER_M, LATE_S, TURNED_DEG, TIMES = (0.5, -0.3), 0.15, 5.0, 5.0
# By name: keys that must be suggested, and by how much each was made wrong (or its factor, for noise).
PLANTED: dict[str, dict[str, float]] = {
    "none": {},
    "lever": {"sensors.gnss.mount.xyz_m[0]": LEVER_M[0], "sensors.gnss.mount.xyz_m[1]": LEVER_M[1]},
    "gnss late": {"sensors.gnss.time_offset_s": LATE_S},
    "compass late": {"sensors.compass.time_offset_s": LATE_S},
    "compass turned": {"sensors.compass.mount.rpy_deg[2]": TURNED_DEG},
    "imu noise too small": {"sensors.imu.accel_noise_ug_per_sqrt_hz": 1 / TIMES, "sensors.imu.gyro_noise_mdps_per_sqrt_hz": 1 / TIMES},
    "imu noise too large": {"sensors.imu.accel_noise_ug_per_sqrt_hz": TIMES, "sensors.imu.gyro_noise_mdps_per_sqrt_hz": TIMES},
}  # fmt: skip


def changed(config: VesselConfig, sensor: str, **fields: Any) -> VesselConfig:
    block = config.sensors[sensor].model_copy(update=fields)
    return config.with_sensors({sensor: block})


def moved(config: VesselConfig, sensor: str, lever_m: tuple[float, float], yaw_deg: float = 0.0) -> VesselConfig:
    mount = config.sensors[sensor].mount
    xyz, rpy = np.add(mount.xyz_m, [*lever_m, 0.0]), np.add(mount.rpy_deg, [0.0, 0.0, yaw_deg])
    return changed(
        config, sensor, mount=mount.model_copy(update={"xyz_m": tuple(xyz.tolist()), "rpy_deg": tuple(rpy.tolist())})
    )


def late(recording: Recording, sensor: str) -> Recording:
    by_ns = round(LATE_S * 1e9)
    shifted = (replace(m, stamp_ns=m.stamp_ns + by_ns) if m.sensor == sensor else m for m in recording.measurements)
    return replace(recording, measurements=tuple(sorted(shifted, key=lambda m: m.stamp_ns)))


def plant(recording: Recording, config: VesselConfig, fault: str) -> tuple[Recording, VesselConfig]:
    if fault == "lever":
        return recording, moved(config, "gnss", LEVER_M)
    if fault.endswith("late"):
        return late(recording, fault.split()[0]), config
    if fault == "compass turned":
        return recording, moved(config, "compass", (0.0, 0.0), TURNED_DEG)
    return recording, config


def _run(job: tuple[str, str, int]) -> tuple[tuple[str, str, int], dict[str, Any]]:
    scene, fault, seed = job
    scenario = SCENES[scene]
    run = simulate(scenario, seed)
    true = {
        "accel_noise_ug_per_sqrt_hz": scenario.accel_noise_ug_per_sqrt_hz,
        "gyro_noise_mdps_per_sqrt_hz": scenario.gyro_noise_mdps_per_sqrt_hz,
    }
    times = next(iter(PLANTED[fault].values())) if fault.startswith("imu") else 1.0
    config = changed(run.config, "imu", **{key: value * times for key, value in true.items()})
    recording, config = plant(run.recording, config, fault)
    found = app.smooth_recording(recording, config).calibration
    assert found is not None
    return job, judged(found, fault, true)


def judged(found: Calibration, fault: str, true: dict[str, float]) -> dict[str, Any]:
    """Errors in sigmas and in units: of what was planted and found, and of what fits."""
    wanted, suggested = PLANTED[fault], {s.key: s for s in found.suggestions}
    right: dict[str, float] = {}
    for key, by in wanted.items():
        if key in suggested:
            s = suggested[key]
            noise = key.rsplit(".", 1)[-1] in true
            ideal = s.configured / by if noise else s.configured - by
            right[key] = (s.suggested - ideal) / s.sigma
    errors = {k: suggested[k].suggested - (suggested[k].configured / by if "noise" in k else suggested[k].configured - by) for k, by in wanted.items() if k in suggested}  # fmt: skip
    return {
        "found": sorted(right),
        "z": right,
        "error": errors,
        "sigma": {k: suggested[k].sigma for k in right},
        "named": [k for k in wanted if k not in right and any(k in s.action for s in found.suggestions)],
        "made up": sorted(set(suggested) - set(wanted)),
        "fits": {c.key: c.change / c.sigma for c in found.checks if "noise" not in c.key},
    }


def figures(pool: ProcessPoolExecutor, seeds: int = 20) -> list[Row]:
    """Every figure of F.cal."""
    jobs = [
        (scene, fault, s)
        for scene in SCENES
        for fault in PLANTED
        for s in range(seeds if fault == "none" else seeds // 2)
    ]
    done = dict(pool.map(_run, jobs))
    rows = []
    for scene in SCENES:
        free = [d for (sc, fault, _), d in done.items() if sc == scene and fault == "none"]
        z = np.array([v for d in free for v in d["fits"].values()])
        made_up = sum(bool(d["made up"]) for d in free)
        rows += [
            row("F.cal", f"{scene}, nothing wrong: runs of {len(free)} with a suggestion", made_up, "runs", 1, "<="),
            row("F.cal", f"{scene}, nothing wrong: RMS of changes / sigma", float(np.sqrt((z**2).mean())), "ratio"),
            row("F.cal", f"{scene}, nothing wrong: zero change inside 95 %", 100 * float((np.abs(z) < 1.96).mean()), "%", 90, ">="),
        ]  # fmt: skip
        for fault, wanted in list(PLANTED.items())[1:]:
            own = [d for (sc, f, _), d in done.items() if sc == scene and f == fault]
            rows += _of_fault(scene, fault, wanted, own)
    return [*rows, *_cost(), *_real()]


def _of_fault(scene: str, fault: str, wanted: dict[str, float], own: list[dict[str, Any]]) -> list[Row]:
    label, whole = f"{scene}, {fault}", len(own)
    rows = [
        row("F.cal", f"{label}: runs of {whole} with a suggestion of something else", sum(bool(d["made up"]) for d in own), "runs")
    ]  # fmt: skip
    for key in wanted:
        short = key.removeprefix("sensors.")
        hits = [d for d in own if key in d["found"]]
        either = sum(key in d["found"] or key in d["named"] for d in own)
        bound: tuple[Any, ...] = (whole, ">=") if scene == "open" else ()
        rows.append(row("F.cal", f"{label}: {short} suggested, of {whole} runs", len(hits), "runs", *bound))
        if either > len(hits):
            rows.append(row("F.cal", f"{label}: {short} suggested or named as alternative", either, "runs"))
        if hits:
            z = np.array([d["z"][key] for d in hits])
            error = float(np.median([abs(d["error"][key]) for d in hits]))
            sigma = float(np.median([d["sigma"][key] for d in hits]))
            rows += [
                row("F.cal", f"{label}: {short}, error, median", error, ""),
                row("F.cal", f"{label}: {short}, stated sigma, median", sigma, ""),
                row("F.cal", f"{label}: {short}, RMS of error / sigma", float(np.sqrt((z**2).mean())), "ratio"),
                row("F.cal", f"{label}: {short}, truth inside 95 %", 100 * float((np.abs(z) < 1.96).mean()), "%"),
            ]
    return rows


def _cost() -> list[Row]:
    """Processor time of smoothing with and without, in turn."""
    run, seconds = simulate(SCENES["drift"], 0), {True: 0.0, False: 0.0}
    datum = app.choose_datum(run.recording, run.config)
    recording = app.with_synthetic(run.recording, run.config, datum)
    for asked in (False, True) * 4:
        begun = time.process_time()
        smooth(recording, run.config, datum, rows=SENSORS, inertial=INERTIAL, probe=PROBE if asked else None)
        seconds[asked] += time.process_time() - begun
    share = 100.0 * (seconds[True] / seconds[False] - 1.0)
    return [row("F.cal", "what it adds to smoothing 2 min", share, "%", 10, "<=")]


def _real() -> list[Row]:
    """KITTI with planted errors against KITTI without; Husky as it is."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "kitti"
        subprocess.run([sys.executable, str(ROOT / "examples/kitti/make_bag.py"), str(bag)], check=True)
        recording, config = app.load([bag], ROOT / "examples/kitti/vessel.yaml")
    rows, base = [], _values(recording, config)
    stamp = "sensors.gnss.time_offset_s"
    rows.append(row("F.cal", "KITTI as it is: gnss.time_offset_s that it suggests", base[stamp][0], "s"))
    rows.append(row("F.cal", "KITTI as it is: its sigma", base[stamp][1], "s"))
    for fault in ("lever", "gnss late"):
        there = _values(*plant(recording, config, fault))
        for key, by in PLANTED[fault].items():
            short = key.removeprefix("sensors.")
            # The lever is part of the configured value: what comes out must stay. A stamp's shift comes on top.
            off = there[key][0] - base[key][0] + (by if fault == "gnss late" else 0.0)
            rows.append(
                row(
                    "F.cal",
                    f"KITTI, {fault}: {short} less that without, as it should be",
                    off,
                    "s" if key.endswith("_s") else "m",
                )
            )
            rows.append(row("F.cal", f"KITTI, {fault}: {short}, suggested", float(there[key][2]), "yes", 1, ">="))
    if HUSKY.exists():
        found = app.smooth_recording(*app.load([HUSKY], ROOT / "examples/husky/vessel.yaml")).calibration
        assert found is not None
        rows.append(row("F.cal", "Husky as it is: suggestions", len(found.suggestions), "", 0, "<="))
    return rows


def _values(recording: Recording, config: VesselConfig) -> dict[str, tuple[float, float, bool]]:
    """What the run makes of each setting: value, sigma, and whether it is suggested."""
    found = app.smooth_recording(recording, config).calibration
    assert found is not None
    fits = {c.key: (c.configured + c.change, c.sigma, False) for c in found.checks}
    return fits | {s.key: (s.suggested, s.sigma, True) for s in found.suggestions}


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    with ProcessPoolExecutor(int(os.environ.get("JOBS", os.cpu_count() or 2))) as pool:
        for figure in figures(pool, seeds):
            print(f"{figure['name']}: {figure['value']:g} {figure['unit']}")


if __name__ == "__main__":
    main()
