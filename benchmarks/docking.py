# SPDX-License-Identifier: Apache-2.0
"""Figures of D: docking by tags, from bags with images."""

from __future__ import annotations

import itertools
import pickle
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from _rows import Row, row

from graphloc import app
from graphloc.berths import seen_from
from graphloc.build import make_problem, thinned
from graphloc.config import VesselConfig
from graphloc.eval import digerud, ekf
from graphloc.eval.docking import tag_range_m
from graphloc.eval.simulate import SimulatedRun, harbour_scenarios, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.factors import INERTIAL, SENSORS
from graphloc.judge.decide import Verdicts
from graphloc.measurements import GnssPosition, TagSighting
from graphloc.recording import Recording
from graphloc.solve import smooth
from graphloc.solve._grow import grow
from graphloc.solve._start import solve_start
from graphloc.solve.alignment import align
from graphloc.time import stamps_of

SEEDS = {"illuminated": range(2)}  # of a condition
OTHER_SEEDS = range(10)  # a run takes two minutes of a core
CONDITIONS = ("optimal", "fog", "counterlight", "droplet", "darkness", "illuminated")
CAMERA_HZ = 3.0
_DIGERUD_SAW_M = {"optimal": 28.0, "fog": 22.0, "counterlight": 25.0, "droplet": 16.0, "darkness": 16.0}
_CUT_M, _HIDDEN_S = 20.0, 5.0
_STEP_S, _LAG_S = 1.0, 9.0  # of what one knew at the time
Job = tuple[str, str, int]  # fixed or floating, condition, seed


@dataclass(frozen=True)
class Docked:
    """A run that was solved.

    Attributes (all arrays at the states from the first sighting on):
        range_m: from the camera to the nearest tag. off_m: horizontal error in world. berth_m: the same, seen from the
            berth. offline, online: share of sightings with the wrong mode. sightings: their number.
        first_m: range of the first sighting. wrong_side: whether it ends more than 1 m off.
        digerud_m: errors of his filter at its stamps, sightings as far off as he had them. digerud_lost: more than 2 m off
            at the end. ekf_m: RMSE of the honest EKF.
    """

    range_m: Any
    off_m: Any
    berth_m: Any
    held: Any
    berth_nees: Any
    offline: float
    online: float
    sightings: int
    first_m: float
    wrong_side: bool
    digerud_lost: bool | None
    digerud_m: Any
    ekf_m: float


def scenario_of(job: Job) -> Any:
    kind, condition, _ = job
    return replace(harbour_scenarios()[f"dock-{kind}-{condition}"], lidar_hz=0.0, camera_hz=CAMERA_HZ)


def read(job: Job, keep: Path | None = None) -> tuple[SimulatedRun, Recording, VesselConfig]:
    """Write the bag of a run, and read it as a user does; `keep`: a folder of readings made before."""
    cv2.setNumThreads(1)
    run = simulate(scenario_of(job), job[2])
    kept = None if keep is None else keep / ("-".join(map(str, job)) + ".pickle")
    if kept is not None and kept.exists():
        recording, config = pickle.loads(kept.read_bytes())  # our own, of a moment ago
        return run, recording, config
    with tempfile.TemporaryDirectory() as folder:
        bag, config_path = write_bag(run, Path(folder) / "run", ros=2)
        recording, config = app.load([bag], config_path)
    if kept is not None:
        kept.write_bytes(pickle.dumps((recording, config)))
    return run, recording, config


def true_mode(run: SimulatedRun, m: TagSighting) -> int:
    """The mode nearest to the camera's true attitude, seen from the tags' frame."""
    t = (m.stamp_ns - int(run.truth.stamps_ns[0])) * 1e-9
    _, R, _ = (v[0] for v in run.motion.pose(np.array([t])))
    R_world_camera = R @ m.R_body_camera
    for dock in run.docks:
        if dock.dock.name == m.frame:
            R_world_camera = dock.pose(np.array([t]))[1][0].T @ R_world_camera
    return int(np.argmin([np.linalg.norm(np.asarray(mode.R_world_camera) - R_world_camera) for mode in m.modes]))


def _at_the_time(recording: Recording, config: VesselConfig) -> dict[int, int]:
    """Mode of each sighting by what was known within a second of it: a window of 10 s, a second at a time."""
    datum = app.choose_datum(recording, config)
    whole = app.with_synthetic(recording, config, datum)
    problem = make_problem(whole, app.seen_frames(config, whole), datum, SENSORS, INERTIAL)
    few, chosen = thinned(problem).problem, dict[int, int]()

    def watch(_last: int, verdicts: Verdicts) -> None:
        for stream in few.streams:
            for i, m in enumerate(stream.measurements):
                verdict = verdicts.get((stream.number, i))
                if isinstance(m, TagSighting) and verdict is not None:
                    chosen.setdefault(m.seq, verdict.mode)

    values, prior, known, *_ = solve_start(few, align(problem), lambda *_: None)
    grow(few, values, prior, known, lambda *_: None, chunk_s=_STEP_S, overlap_s=_LAG_S, watch=watch)
    return chosen


def _seen_as_far_as_he(run: SimulatedRun, config: VesselConfig, seen: Sequence[TagSighting], condition: str) -> int:
    """Stamp from which the camera is as near as Digerud's detector first saw a tag: farther off, his filter had none."""
    stamps = np.unique(stamps_of(seen))
    lever = run.rig.cameras["camera"].mount.t_body_sensor_m
    away = tag_range_m(run.truth.at(stamps), config.sensors["tags"].surveyed, lever)
    return int(stamps[np.flatnonzero(away <= _DIGERUD_SAW_M.get(condition, np.inf))[0]]) if len(stamps) else 0


def _moved(run: SimulatedRun, name: str, t: Any) -> Any:
    moved = np.zeros((len(t), 4))
    for dock in run.docks:
        if dock.dock.name == name:
            at, turned = dock.pose(t)
            moved[:, :2], moved[:, 2] = at[:, :2] - dock.rest_m, at[:, 2]
            moved[:, 3] = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    return moved


def solve(run: SimulatedRun, recording: Recording, config: VesselConfig, job: Job) -> Docked | None:
    """Solve a run in all ways; None where no tag is seen."""
    seen = recording.of(TagSighting)
    if not seen:
        return None
    datum = app.choose_datum(recording, config)
    whole = app.with_synthetic(recording, config, datum)
    solution = smooth(whole, app.seen_frames(config, whole), datum, rows=SENSORS, inertial=INERTIAL)
    survey, lever = config.sensors["tags"].surveyed, run.rig.cameras["camera"].mount.t_body_sensor_m
    track = solution.trajectory
    true = run.truth.at(track.stamps_ns)
    picked = track.stamps_ns >= seen[0].stamp_ns
    range_m = tag_range_m(true, survey, lever)[picked]
    off = (track.p_world_m - true.p_world_m)[picked, :2]
    name = "quay" if job[0] == "fixed" else "north_dock"
    (berth,) = [b for b in solution.berths if b.berth.name == name]
    near = berth.stamps_ns >= seen[0].stamp_ns
    there = run.truth.at(berth.stamps_ns[near])
    t = (there.stamps_ns - run.truth.stamps_ns[0]) * 1e-9
    value, _ = seen_from(berth.berth, there.p_world_m, there.yaw_rad, _moved(run, name, t))
    error = berth.value[near] - value
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    assert berth.cov is not None
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(berth.cov[near]), error)
    berth_range = tag_range_m(there, survey, lever)
    right = {m.seq: true_mode(run, m) for m in seen}
    final = {r.seq: r.mode for r in solution.ledger if r.sensor == "tags" and r.mode is not None}
    then = _at_the_time(recording, config)
    near_ns = _seen_as_far_as_he(run, config, seen, job[1])
    his = tuple(m for m in whole.measurements if not isinstance(m, TagSighting) or m.stamp_ns >= near_ns)
    kf = digerud.run_digerud(replace(whole, measurements=his), config)
    honest = ekf.run_honest(whole, config, datum).trajectory
    at_end = track.stamps_ns[picked] > track.stamps_ns[-1] - 5_000_000_000
    there_ekf = honest.at(np.clip(track.stamps_ns[picked], honest.stamps_ns[0], honest.stamps_ns[-1]))
    lost, kf_m = None, None
    if kf is not None:
        lost = digerud.losses(kf, run.truth).at_end
        kf_true = run.truth.at(kf.trajectory.stamps_ns).p_world_m
        kf_m = np.hypot(*(kf.trajectory.p_world_m - kf_true)[:, :2].T)
    return Docked(
        range_m=range_m,
        off_m=np.hypot(*off.T),
        berth_m=(berth_range, np.hypot(*error[:, :2].T)),
        held=float((np.einsum("ni,nij,nj->n", off, np.linalg.inv(track.cov[picked][:, :2, :2]), off) < 5.991).mean())
        if track.cov is not None
        else 0.0,
        berth_nees=nees,
        offline=float(np.mean([final.get(seq) != mode for seq, mode in right.items()])),
        online=float(np.mean([then.get(seq) != mode for seq, mode in right.items()])),
        sightings=len(seen),
        first_m=float(range_m[0]),
        wrong_side=bool(np.median(np.hypot(*off.T)[at_end]) > 1.0),
        digerud_lost=lost,
        digerud_m=kf_m,
        ekf_m=float(np.sqrt(((there_ekf.p_world_m - true.p_world_m[picked])[:, :2] ** 2).sum(axis=1).mean())),
    )


def _whole(job: Job, keep: Path | None = None) -> tuple[Docked | None, Docked | None]:
    """A run as it is; and, in a droplet's weather at the quay, without fixes and tags for a while (D.3)."""
    run, recording, config = read(job, keep)
    cut = _cut(run, recording, config, job) if job[:2] == ("fixed", "droplet") else None
    return solve(run, recording, config, job), cut


def _cut(run: SimulatedRun, recording: Recording, config: VesselConfig, job: Job) -> Docked | None:
    """No fix from 20 m before the berth on; and no tag for 5 s in the middle of what is left."""
    lever = run.rig.cameras["camera"].mount.t_body_sensor_m
    away = tag_range_m(run.truth, config.sensors["tags"].surveyed, lever)
    near = run.truth.stamps_ns[np.flatnonzero(away < _CUT_M)[0]]
    still = run.truth.stamps_ns[np.flatnonzero(away < away.min() + 0.5)[0]]
    begin = (int(near) + int(still)) // 2
    hidden = (begin, begin + round(_HIDDEN_S * 1e9))
    kept = tuple(
        m
        for m in recording.measurements
        if not (isinstance(m, GnssPosition) and m.stamp_ns >= near)
        and not (isinstance(m, TagSighting) and hidden[0] <= m.stamp_ns < hidden[1])
    )
    return solve(run, replace(recording, measurements=kept), config, job)


def jobs_of(kind: str, condition: str) -> list[Job]:
    return [(kind, condition, seed) for seed in SEEDS.get(condition, OTHER_SEEDS)]


def _p95(parts: Sequence[Any]) -> float:
    values = np.concatenate(parts) if len(parts) else np.zeros(0)
    return float(np.quantile(values, 0.95)) if len(values) else float("nan")


def docking(pool: ProcessPoolExecutor) -> list[Row]:
    """D.1, D.2, D.3, D.5: whole runs in every condition."""
    rows: list[Row] = []
    kinds = list(itertools.product(("fixed", "floating"), CONDITIONS))
    jobs = [job for kind, condition in kinds for job in jobs_of(kind, condition)]
    by_job, failed = {}, []
    for job, future in {job: pool.submit(_whole, job) for job in jobs}.items():
        try:
            by_job[job] = future.result()
        except Exception as error:  # noqa: BLE001 - a figure of its own: the other runs of an hour are kept
            print(*job, repr(error), flush=True)
            failed.append(job)
    rows.append(row("D.2", f"runs of {len(jobs)} that end in an exception", len(failed), "runs", 0, "<="))
    for kind, condition in kinds:
        done = [by_job[job] for job in jobs_of(kind, condition) if job in by_job]
        found, cut = [whole for whole, _ in done], [part for _, part in done if part is not None]
        runs = [r for r in found if r is not None]
        rows += _cut_rows(cut) if cut else []
        label = f"dock-{kind}-{condition}, {len(found)} seeds"
        rows.append(row("D.2", f"{label}: runs in which a tag is seen", len(runs), "runs"))
        if not runs:
            continue
        if (kind, condition) == ("fixed", "optimal"):
            rows.append(
                row(
                    "D.1",
                    f"{label}: error within 8 m, 95 %",
                    _p95([r.off_m[r.range_m < 8.0] for r in runs]),
                    "m",
                    0.10,
                    "<=",
                )
            )
            rmse = float(np.sqrt(np.mean(np.concatenate([r.off_m for r in runs]) ** 2)))
            rows.append(row("D.1", f"{label}: RMSE from the first sighting on", rmse, "m", 0.25, "<="))
            rows.append(
                row("D.1", f"{label}: range of the first sighting, mean", np.mean([r.first_m for r in runs]), "m")
            )
            rows.append(
                row("D.1", f"{label}: true place within the 95 % bound", np.mean([r.held for r in runs]), "share")
            )
        if (kind, condition) == ("floating", "optimal"):
            near = _p95([r.berth_m[1][r.berth_m[0] < 5.0] for r in runs])
            rows.append(row("D.5", f"{label}: seen from the berth, within 5 m, 95 %", near, "m", 0.10, "<="))
            nees = np.mean(np.concatenate([r.berth_nees for r in runs])) / 3.0
            rows.append(row("D.5", f"{label}: NEES / 3 of across, along, angle", nees, ""))
        rows += _in_condition(label, kind, runs)
    return rows


def _in_condition(label: str, kind: str, runs: list[Docked]) -> list[Row]:
    """What D.2 asks of every condition, with the filters beside it."""
    lost = [r for r in runs if r.digerud_lost is not None]
    sightings = sum(r.sightings for r in runs)
    offline = sum(r.offline * r.sightings for r in runs) / sightings
    online = sum(r.online * r.sightings for r in runs) / sightings
    end = [r.berth_m[1][-50:] for r in runs] if kind == "floating" else [r.off_m[-50:] for r in runs]
    return [
        row("D.2", f"{label}: runs that end on the wrong side", sum(r.wrong_side for r in runs), "runs", 0, "<="),
        row("D.2", f"{label}: wrong modes, whole run", 100.0 * offline, "%", 0.5, "<="),
        row("D.2", f"{label}: wrong modes, as known at the time", 100.0 * online, "%", 2.0, "<="),
        row("D.2", f"{label}: sightings", sightings, ""),
        row("D.2", f"{label}: error at the berth, 95 %", _p95(end), "m"),
        row("D.2", f"{label}: Digerud's filter lost at the end", sum(bool(r.digerud_lost) for r in lost), "runs"),
        row("D.2", f"{label}: Digerud's filter, 95 % of errors", _p95([r.digerud_m for r in lost]), "m"),
        row("D.2", f"{label}: honest EKF, RMSE from the first sighting on", np.mean([r.ekf_m for r in runs]), "m"),
    ]


def _cut_rows(runs: list[Docked]) -> list[Row]:
    label = f"dock-fixed-droplet, {len(runs)} seeds, no fix from 20 m on, no tag for 5 s"
    at_berth = _p95([r.off_m[-50:] for r in runs])
    return [
        row("D.3", f"{label}: error at the berth, 95 %", at_berth, "m", 0.15, "<="),
        row("D.3", f"{label}: error from the first sighting on, 95 %", _p95([r.off_m for r in runs]), "m"),
    ]
