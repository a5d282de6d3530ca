# SPDX-License-Identifier: Apache-2.0
"""The run without each sensor in turn: what each contributes, and which contradicts the others."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.errors import GraphlocError, InputError, in_one_line
from graphloc.eval.ablation import Ablated, Effect, Off, Vote, effect, off, suspects
from graphloc.eval.consistency import contradiction, fit
from graphloc.eval.holdout import HoldOut
from graphloc.eval.metrics import NoCommonTimeError
from graphloc.eval.parallel import run_jobs
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Datum
from graphloc.recording import Progress, Recording, quiet
from graphloc.solution import Solution

log = logging.getLogger(__name__)
_OPEN = "the remaining sensors do not determine position, height and heading over the whole run"
_ONLY = "no other sensor tells the position"
_VOTED = 3  # most suspects that are left out two by two, too


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Job:
    """A run without some of its sensors."""

    recording: Recording
    config: VesselConfig
    datum: Datum
    without: tuple[str, ...]


def ablate(
    recording: Recording,
    config: VesselConfig,
    *,
    scans: app.Scans | None = None,
    hold_out: HoldOut | None = None,
    jobs: int = 1,
    progress: Progress = quiet,
) -> Ablated:
    """Smooth a run without each sensor in turn.

    A sensor is left out as if it were switched off: slow errors that only it could tell from motion are then not estimated. If
    several sensors contradict the rest, the run is also smoothed without each two of them.

    Args:
        hold_out: fixes to predict, where there is no truth. jobs: number of parallel processes.

    Raises:
        InputError: no sensor has measurements.
    """
    run = app.smooth_recording(recording, config, hold_out=hold_out, scans=scans, progress=progress)
    names = _with_measurements(run)
    if not names:
        raise InputError(f"{recording.source}: no sensor beside the IMU has measurements: nothing to leave out")
    solved = _solve(run, [(name,) for name in names], jobs, "without each sensor", progress)
    over_time: dict[str, Off] = {}
    effects = [_effect(run, name, names, solved[(name,)], over_time) for name in ("", *names)]
    doubted = suspects(effects[1:])[:_VOTED]
    pairs = list(combinations(doubted, 2))
    without_both = _solve(run, pairs, jobs, "without two suspects", progress) if pairs else {}
    imu = next((n for n, s in config.sensors.items() if s.kind == INERTIAL.kind and s.enabled), "imu")
    carries = "every state depends on it: it gives the motion between all other measurements"
    return Ablated(
        source=recording.source,
        vessel=config.vessel,
        basis="truth" if run.recording.truth is not None else "held" if run.held else "full",
        begin_ns=int(run.solution.trajectory.stamps_ns[0]),
        full=effects[0],
        effects=(*effects[1:], Effect(without=imu, measurements=_samples(recording), fits={}, why_not=carries)),
        over_time=over_time,
        votes=tuple(_vote(run, *pair, without_both[pair]) for pair in pairs),
        matched=tuple(n for n in names if n in config.of_kind("aerial")),
        warnings=(*run.recording.warnings, *run.solution.stats.warnings),
    )


def _samples(recording: Recording) -> int:
    return 0 if recording.imu is None else len(recording.imu)


def _with_measurements(run: app.Run) -> list[str]:
    measured = {m.sensor for m in run.recording.measurements}
    return [name for name, sensor in run.config.sensors.items() if sensor.enabled and name in measured]


def _solve(
    run: app.Run, without: Sequence[tuple[str, ...]], workers: int, stage: str, progress: Progress
) -> dict[tuple[str, ...], Solution | str]:
    """Return the solution without some sensors, or why there is none."""
    jobs = [
        _Job(recording=run.recording, config=run.config, datum=run.solution.datum, without=names) for names in without
    ]
    done = dict(run_jobs(_smoothed, jobs, workers, stage, progress))
    return {names: done[k] for k, names in enumerate(without)} | {("",): run.solution}


def _smoothed(job: _Job) -> Solution | str:
    """Solve a run without some sensors; any error becomes a row that says why."""
    off = {name: job.config.sensors[name].model_copy(update={"enabled": False}) for name in job.without}
    config = job.config.with_sensors(off)
    try:
        return app.solve(job.recording, config, job.datum)
    except Exception as error:  # noqa: BLE001 - what is left may be anything; the other runs go on
        log.info("without %s: %s", ", ".join(job.without), in_one_line(error))
        left = (row.of(s) for row in SENSORS for s in config.of_kind(row.kind).values())
        if not any(row.absolute for row in left):
            return _ONLY
        if isinstance(error, GraphlocError) and error.__cause__ is None:
            return str(error)  # in the user's words; what wraps another's error has the solver's
        return _OPEN


def _effect(run: app.Run, name: str, names: list[str], solved: Solution | str, over_time: dict[str, Off]) -> Effect:
    count = sum(m.sensor == name and m.seq >= 0 for m in run.recording.measurements)  # not what the configuration makes
    if isinstance(solved, str):
        return Effect(without=name, measurements=count, fits={}, why_not=solved)
    try:
        away = off(
            solved,
            run.solution,
            run.recording.truth,
            run.held,
            app.antennas(replace(run, solution=solved)).of(solved.name),
        )
    except NoCommonTimeError as error:
        return Effect(without=name, measurements=count, fits={}, why_not=str(error))
    if name or run.recording.truth is not None or run.held:
        over_time[name] = away
    contradicts = contradiction(solved, run.recording, run.config, name, SENSORS) if name else None
    fits: Mapping[str, float | None] = {other: fit(solved, other) for other in names if other != name}
    return effect(name, count, solved, run.solution, away, contradicts, fits)


def _vote(run: app.Run, one: str, other: str, solved: Solution | str) -> Vote:
    if isinstance(solved, str):
        return Vote(one=one, other=other, one_off=None, other_off=None)
    by = [contradiction(solved, run.recording, run.config, name, SENSORS) for name in (one, other)]
    first, second = (None if found is None else found.sigmas for found in by)
    return Vote(one=one, other=other, one_off=first, other_off=second)
