# SPDX-License-Identifier: Apache-2.0
"""Figures of vessels drawn by chance (`_vessels.py`): batch, online and the filters on the same runs.

Its own main measures some seeds one by one, and says which differ from an earlier version's:

    python benchmarks/drawn.py 0 40 --out now.jsonl --before then.jsonl
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _rows import Row, row
from _vessels import DrawnRun, drawn_run
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.errors import GraphlocError
from graphloc.eval import ekf
from graphloc.eval.metrics import compare_to_truth
from graphloc.measurements import NO_HEIGHT_M2, GnssPosition, Measurement, PoseFix
from graphloc.replay import replay
from graphloc.solution import Solution
from graphloc.trajectory import Trajectory

SEEDS = range(1000, 1080)  # none was looked at when a model or a number was chosen, nor those of `VARIED`
Found = dict[str, Any]
Runs = dict[str, DrawnRun]
_TOO_SURE = 6.0  # horizontal NEES: 2 where the covariance is true


def _judged(track: Trajectory, truth: Trajectory) -> Found:
    m = compare_to_truth(track, truth)
    return {
        "rmse_m": m.position_rmse_m, "max_m": m.position_max_m, "heading_deg": m.heading_rmse_deg,
        "nees": m.nees, "coverage": m.coverage_95, "heading_coverage": m.heading_coverage_95,
    }  # fmt: skip


def _tried(solve: Callable[[], Solution], run: DrawnRun) -> Found:
    try:
        solution = solve()
    except GraphlocError as error:
        return {"refused": str(error)}
    return _judged(solution.trajectory, run.truth) | {"warnings": list(solution.stats.warnings)}


def measured(seed: int) -> Found:
    run = drawn_run(seed)
    datum = app.choose_datum(run.recording, run.config)
    return {
        "drawn": run.drawn,
        "batch": _tried(lambda: app.smooth_recording(run.recording, run.config).solution, run),
        "online": _tried(lambda: replay(run.recording, run.config, late_ns=run.late_ns).solution, run),
        **{f.name: _judged(f.trajectory, run.truth) for f in ekf.run_all(run.recording, run.config, datum)},
    }


def _column(found: list[Found], way: str, key: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([f[way][key] for f in found if f.get(way, {}).get(key) is not None], dtype=float)


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    found = list(pool.map(measured, SEEDS))
    label = f"{len(found)} drawn vessels"
    rows = []
    for way in ("batch", "online", "honest EKF", "BL EKF"):
        rmse = _column(found, way, "rmse_m")
        rows += [
            row("F.drawn", f"{label}, {way}: position RMSE, mean", rmse.mean(), "m"),
            row("F.drawn", f"{label}, {way}: position RMSE, median", np.median(rmse), "m"),
            row("F.drawn", f"{label}, {way}: position RMSE, 90 % of runs below", np.percentile(rmse, 90), "m"),
            row("F.drawn", f"{label}, {way}: heading RMSE, median", np.median(_column(found, way, "heading_deg")), "deg"),
        ]  # fmt: skip
        if way in ("batch", "online"):
            nees = _column(found, way, "nees")
            rows += [
                row("F.drawn", f"{label}, {way}: no track", len(found) - len(rmse), "runs"),
                row("F.drawn", f"{label}, {way}: 95 % coverage, mean", _column(found, way, "coverage").mean() * 100, "%"),
                row("F.drawn", f"{label}, {way}: 95 % coverage of the heading, mean", _column(found, way, "heading_coverage").mean() * 100, "%"),
                row("F.drawn", f"{label}, {way}: NEES (2 when true), median", np.median(nees), ""),
                row("F.drawn", f"{label}, {way}: NEES above {_TOO_SURE:g}", np.sum(nees > _TOO_SURE), "runs"),
            ]  # fmt: skip
    for way in ("batch", "online"):
        both = [f for f in found if "rmse_m" in f[way] and "honest EKF" in f]
        better = sum(f[way]["rmse_m"] < f["honest EKF"]["rmse_m"] for f in both)
        rows.append(row("F.drawn", f"{label}: {way} better than the honest EKF, of {len(both)}", better, "runs"))
    return rows


def _by_data_sheet(run: DrawnRun, *, adapt: bool) -> DrawnRun:
    """The vessel, whose IMU is configured by a data sheet: 50 ug and 2 mdeg/s per sqrt(Hz); drawn are 60 to 3000 ug and 3 to 60 mdeg/s."""
    quiet = {"accel_noise_ug_per_sqrt_hz": 50.0, "gyro_noise_mdps_per_sqrt_hz": 2.0, "adapt_noise": adapt}
    return replace(run, config=run.config.with_sensors({"imu": run.config.sensors["imu"].model_copy(update=quiet)}))


def _vibrating(run: DrawnRun) -> DrawnRun:
    """The vessel, whose IMU an engine shakes: 2 m/s^2 and 3 deg/s at some frequency."""
    rng, imu = np.random.default_rng(run.drawn["seed"]), run.recording.imu
    assert imu is not None
    t_s = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    phase = 2.0 * np.pi * (rng.uniform(11.0, 37.0) * t_s[:, None, None] + rng.uniform(size=(2, 3)))
    shake = np.sin(phase) * np.array([[2.0], [0.05]])
    shaken = replace(imu, accel_mps2=imu.accel_mps2 + shake[:, 0], gyro_radps=imu.gyro_radps + shake[:, 1])
    return replace(run, recording=replace(run.recording, imu=shaken))


def _noisy(drawn: DrawnRun) -> Runs:
    """An IMU that is noisier than configured, and one that vibrates."""
    return {
        "as it is": drawn,
        "by data sheet, not adapted": _by_data_sheet(drawn, adapt=False),
        "by data sheet": _by_data_sheet(drawn, adapt=True),
        "vibrating": _vibrating(drawn),
    }


def _both_ways(runs: Runs) -> Found:
    found: Found = {}
    for name, run in runs.items():
        found[f"{name}, batch"] = _tried(lambda run=run: app.smooth_recording(run.recording, run.config).solution, run)
        found[f"{name}, online"] = _tried(
            lambda run=run: replay(run.recording, run.config, late_ns=run.late_ns).solution, run
        )
    return found


def _variants(item: str, label: str, found: list[Found]) -> list[Row]:
    rows = []
    for way in found[0]:
        nees = _column(found, way, "nees")
        rows += [
            row(item, f"{label} {way}: position RMSE, mean", _column(found, way, "rmse_m").mean(), "m"),
            row(item, f"{label} {way}: NEES (2 when true), median", np.median(nees), ""),
            row(item, f"{label} {way}: NEES above {_TOO_SURE:g}", np.sum(nees > _TOO_SURE), "runs"),
        ]
    return rows


def stating(run: DrawnRun, kind: type[Measurement], share: float) -> DrawnRun:
    """The vessel, whose fixes (`GnssPosition`) or matches (`PoseFix`) state only a share of their sigmas."""

    def less(m: Measurement) -> Measurement:
        if isinstance(m, kind) and isinstance(m, GnssPosition):
            return replace(m, cov_enu_m2=np.where(m.cov_enu_m2 < NO_HEIGHT_M2, share**2 * m.cov_enu_m2, m.cov_enu_m2))
        if isinstance(m, kind) and isinstance(m, PoseFix):
            return replace(m, modes=tuple(replace(mode, cov=share**2 * mode.cov) for mode in m.modes))
        return m

    return replace(run, recording=run.recording.changed(less))


def _stated(drawn: DrawnRun) -> Runs:
    """Fixes and matches that state less noise than they have."""
    return {
        "as they are": drawn,
        "of matches a third": stating(drawn, PoseFix, 1 / 3),
        "of matches a tenth": stating(drawn, PoseFix, 0.1),
        "of fixes a tenth": stating(drawn, GnssPosition, 0.1),
    }


def _askew(run: DrawnRun) -> DrawnRun:
    """The vessel, whose IMU is turned against its mount by 1 deg, 1 sigma, about each axis."""
    imu, R = run.recording.imu, run.config.sensors["imu"].mount.R_body_sensor
    assert imu is not None
    turn = Rotation.from_rotvec(np.random.default_rng([run.drawn["seed"], 8]).normal(0.0, np.radians(1.0), 3))
    into = R.T @ turn.as_matrix() @ R  # of rows
    turned = replace(imu, accel_mps2=imu.accel_mps2 @ into, gyro_radps=imu.gyro_radps @ into)
    return replace(run, recording=replace(run.recording, imu=turned))


def _as_given(run: DrawnRun) -> DrawnRun:
    """The vessel, whose IMU's mount is taken as given."""
    imu = run.config.sensors["imu"].model_copy(update={"mount_sigma_deg": 0.0})
    return replace(run, config=run.config.with_sensors({"imu": imu}))


def _mounted(drawn: DrawnRun) -> Runs:
    """An IMU that sits askew."""
    askew = _askew(drawn)
    return {"as configured": drawn, "askew, taken as given": _as_given(askew), "askew": askew}


def _with_bounds(item: str, label: str, found: list[Found]) -> list[Row]:
    rows = _variants(item, label, found)
    for way in found[0]:
        held = _column(found, way, "heading_coverage").mean() * 100
        rows += [
            row(item, f"{label} {way}: heading RMSE, mean", _column(found, way, "heading_deg").mean(), "deg"),
            row(item, f"{label} {way}: 95 % coverage of the heading, mean", held, "%"),
            row(item, f"{label} {way}: 95 % coverage, mean", _column(found, way, "coverage").mean() * 100, "%"),
        ]  # fmt: skip
    return rows


def displaced(run: DrawnRun, *, sigma_m: float, known: bool = False) -> DrawnRun:
    """The vessel, whose antennas sit off their mounts by 1 m, 1 sigma, along each axis.

    Args:
        sigma_m: what is said to be unknown of that. known: they sit where they are configured.
    """
    off_m = np.zeros(3) if known else np.random.default_rng([run.drawn["seed"], 9]).normal(0.0, 1.0, 3)
    antennas = {}
    for name, sensor in (run.config.of_kind("gnss") | run.config.of_kind("gnss_velocity")).items():
        xyz_m = tuple((np.array(sensor.mount.xyz_m) - off_m).tolist())
        mount = sensor.mount.model_copy(update={"xyz_m": xyz_m})
        antennas[name] = sensor.model_copy(update={"mount": mount, "mount_sigma_m": sigma_m})
    return replace(run, config=run.config.with_sensors(antennas))


def _antennas(drawn: DrawnRun) -> Runs:
    """Antennas that sit a metre or two from where they are configured."""
    return {
        "as configured": drawn,
        "as configured, estimated": displaced(drawn, sigma_m=1.0, known=True),
        "elsewhere, taken as given": displaced(drawn, sigma_m=0.0),
        "elsewhere, estimated": displaced(drawn, sigma_m=1.0),
    }


def lone(run: DrawnRun) -> DrawnRun | None:
    """The vessel with a receiver's fixes and a compass alone, beside the IMU; None where it has no compass."""
    kept = ("imu", "height", "gnss", "compass")
    sensors = {name: sensor for name, sensor in run.config.sensors.items() if sensor.kind in kept}
    if not any(sensor.kind == "compass" for sensor in sensors.values()):
        return None
    left = tuple(m for m in run.recording.measurements if m.sensor in sensors)
    config = run.config.model_copy(update={"sensors": sensors})
    return replace(run, recording=replace(run.recording, measurements=left), config=config)


def _lone(drawn: DrawnRun) -> Runs:
    """What most vessels have: one receiver and a compass, and nothing that tells its drift and jumps from motion."""
    run = lone(drawn)
    return {} if run is None else {"compass": run}


# By item: what is changed, its seeds, what becomes of a vessel, and how the figures of it are made.
VARIED: dict[str, tuple[str, range, Callable[[DrawnRun], Runs], Callable[[str, str, list[Found]], list[Row]]]] = {
    "F.mount": ("IMU's mount", range(1140, 1156), _mounted, _with_bounds),
    "F.antenna": ("antenna", range(1160, 1176), _antennas, _with_bounds),
    "F.alone": ("one receiver and a", range(1180, 1230), _lone, _with_bounds),
    "F.noise": ("IMU noise", range(1100, 1116), _noisy, _variants),
    "F.stated": ("stated sigmas", range(1120, 1136), _stated, _variants),
}


def _varied(item: str, seed: int) -> Found:
    _, _, vary, _ = VARIED[item]
    return _both_ways(vary(drawn_run(seed)))


def varied(item: str, pool: ProcessPoolExecutor) -> list[Row]:
    """Figures of vessels that are changed."""
    what, seeds, _, rows = VARIED[item]
    found = [one for one in pool.map(partial(_varied, item), seeds) if one]
    return rows(item, f"{len(found)} drawn vessels, {what}", found)


def _line(found: Found, before: Found | None) -> str:
    said = [f"{found['drawn']['seed']:5}"]
    for way in ("batch", "online", "honest EKF"):
        now, then = found.get(way, {}), (before or {}).get(way, {})
        if "rmse_m" not in now:
            said.append(f"{way}: {now.get('refused', 'none')}")
            continue
        was = f" ({then['rmse_m']:.2f} m, {then['nees'] or 0:.1f})" if "rmse_m" in then and way != "honest EKF" else ""
        said.append(f"{way} {now['rmse_m']:.2f} m, NEES {now['nees'] or 0:.1f}{was}")
    return " | ".join(said)


def _differs(found: Found, before: Found) -> bool:
    for way in ("batch", "online"):
        now, then = found[way].get("rmse_m", np.inf), before[way].get("rmse_m", np.inf)
        if now != then and abs(now - then) > max(0.05, 0.08 * then):
            return True
    return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int)
    parser.add_argument("end", type=int)
    parser.add_argument("--out", type=Path, help="a line of JSON for each run")
    parser.add_argument("--before", type=Path, help="an earlier --out: only runs that differ are shown")
    asked = parser.parse_args()
    lines = asked.before.read_text().splitlines() if asked.before else []
    before = {f["drawn"]["seed"]: f for f in map(json.loads, lines)}
    done = []
    for seed in range(asked.first, asked.end):
        found = measured(seed)
        done.append(found)
        then = before.get(seed)
        if then is None or _differs(found, then):
            print(_line(found, then), flush=True)
        if asked.out:
            with asked.out.open("a") as stream:
                stream.write(json.dumps(found) + "\n")
    same = [f for f in done if not before or f["drawn"]["seed"] in before]
    for name, some in (("before", [before[f["drawn"]["seed"]] for f in same] if before else []), ("now", same)):
        for way in ("batch", "online") if some else ():
            rmse, nees = _column(some, way, "rmse_m"), _column(some, way, "nees")
            print(
                f"{way}, {name}: {len(rmse)} runs, RMSE mean {rmse.mean():.3f} median {np.median(rmse):.3f} m, "
                f"NEES median {np.median(nees):.2f}, above {_TOO_SURE:g} in {np.sum(nees > _TOO_SURE)}, "
                f"coverage {_column(some, way, 'coverage').mean():.3f}"
            )


if __name__ == "__main__":
    main()
