# SPDX-License-Identifier: Apache-2.0
"""Drills: harbour failures injected into a recording, for the smoother, the online mode and the EKFs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.errors import ConfigError, InputError, SolveError
from graphloc.eval import ekf
from graphloc.eval.drill import Case, DrillWindow, Failure, Measured, Struck, Times, cut, judge, schedule, script
from graphloc.eval.drill.measure import Drilled, compared
from graphloc.eval.drill.plan import judged_until, windows
from graphloc.eval.formatting import percent
from graphloc.eval.parallel import run_jobs
from graphloc.frames import Datum, heading_deg_from_yaw
from graphloc.measurements import CompassHeading
from graphloc.recording import Progress, Recording, quiet
from graphloc.replay import replay
from graphloc.trajectory import Trajectory, bounds_95

_KNOWN = 0.95  # least share of a run that a truth covers, for drills to be judged by it; a choice
ESTIMATORS = ("graphloc", "graphloc online", "honest EKF", "BL EKF")
Tracks = dict[str, tuple[Trajectory | None, str]]
"""By estimator, its track, or why there is none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Job:
    """Task of a worker: a window of the recording, the configuration to start there, and the failure or None."""

    part: Recording
    config: VesselConfig
    datum: Datum
    window: int
    case: Case | None


def drill(
    recording: Recording,
    config: VesselConfig,
    *,
    scans: app.Scans | None = None,
    times: int = 2,
    seed: int = 0,
    only: Sequence[str] = (),
    jobs: int = 1,
    progress: Progress = quiet,
) -> Drilled:
    """Inject failures into a recording, and measure the errors of each estimator.

    Scans are matched once, around the undisturbed run; these matches are the measurements of every drill.

    Args:
        times: how often each failure is injected. only: parts of the names of failures to inject; empty: all.
        jobs: parallel processes.

    Raises:
        ConfigError: `only` matches none. InputError: no failure fits the recording.
    """
    _refuse_unknown(recording, only)
    run = _without_a_truth_of_a_part(app.smooth_recording(recording, config, scans=scans, progress=progress))
    failures, left = script(run.recording, config)
    failures = _wanted(failures, only)
    parts = windows(run.recording, max(f.length_s for f in failures), times)
    bench = _Bench(run, parts, jobs, progress)
    cases, too_long = schedule(failures, parts, bench.ready_ns(), times, seed)
    if not cases:
        raise InputError(f"{recording.source}: no failure fits: {'; '.join(f'{n}: {why}' for n, why in too_long[:2])}")
    shown, measured = bench.drill(cases)
    return Drilled(
        source=recording.source,
        vessel=config.vessel,
        truth=run.recording.truth is not None,
        bound_m=_typical_bound_m(run.solution.trajectory),
        measured=tuple(measured),
        shown=tuple(zip(cases, shown, strict=True)),
        left=tuple((name, why) for name, why in (*left, *too_long) if _asked_for(name, only)),
        windows=parts,
        warnings=run.recording.warnings,
    )


def _without_a_truth_of_a_part(run: app.Run) -> app.Run:
    """Drop a truth that does not cover nearly all of a run, and say so: no drill beyond it could be judged."""
    truth = run.recording.truth
    if truth is None or (known := float(truth.covers(run.solution.trajectory.stamps_ns).mean())) >= _KNOWN:
        return run
    said = f"the truth covers {percent(known)} of the run, too little for drills: the undisturbed offline solution is the reference"
    return replace(run, recording=replace(run.recording, truth=None, warnings=(*run.recording.warnings, said)))


class _Bench:
    """Windows of a run, and the undisturbed tracks in them.

    Args:
        run: its track is the reference where there is no truth. parts: the windows. jobs: parallel processes.
    """

    def __init__(self, run: app.Run, parts: Sequence[DrillWindow], jobs: int, progress: Progress) -> None:
        self._run, self._parts, self._processes, self._progress = run, parts, jobs, progress
        self._pieces = [cut(run.recording, part) for part in parts]
        track = run.solution.trajectory
        self._configs = [_started_there(run.config, run.recording, part, track) for part in parts]
        undisturbed = [self._job(k, None) for k in range(len(parts))]
        normal = dict(run_jobs(_tracks, undisturbed, jobs, "undisturbed", progress))
        self._normal = [normal[k] for k in range(len(parts))]

    def ready_ns(self) -> list[int]:
        """Return the stamp of the first online pose in each window."""
        return [_first_ns(tracks, part) for tracks, part in zip(self._normal, self._parts, strict=True)]

    def drill(self, cases: Sequence[Case]) -> tuple[list[dict[str, Times]], list[Measured]]:
        """Return the errors over time of each estimator in each case, and the figures drawn from them."""
        recording, whole = self._run.recording, self._parts[0].whole
        origin_ns = self._parts[0].begin_ns if whole else int(_stamps(recording)[0])
        usual = [self._errors(tracks, k) for k, tracks in enumerate(self._normal)]
        shown: dict[int, dict[str, Times]] = {}
        measured: dict[int, list[Measured]] = {}
        jobs = [self._job(case.window, case) for case in cases]
        for number, disturbed in run_jobs(_tracks, jobs, self._processes, "drills", self._progress):
            case = cases[number]
            tracks = {**self._normal[case.window], **disturbed}
            errors = shown[number] = self._errors(tracks, case.window)
            measured[number] = [
                judge(case, name, errors[name], usual[case.window][name], origin_ns, tracks[name][1])
                for name in ESTIMATORS
            ]
        every = range(len(cases))
        return [shown[k] for k in every], [m for k in every for m in measured[k]]

    def _job(self, window: int, case: Case | None) -> _Job:
        piece = self._pieces[window]
        part = piece if case is None else cut(piece, judged_until(case, self._parts[window]))
        datum = self._run.solution.datum
        return _Job(part=part, config=self._configs[window], datum=datum, window=window, case=case)

    def _errors(self, tracks: Tracks, window: int) -> dict[str, Times]:
        truth = self._run.recording.truth
        reference, sure = truth or self._run.solution.trajectory, truth is not None
        return {name: compared(t, reference, self._parts[window], sure=sure) for name, (t, _) in tracks.items()}


def _refuse_unknown(recording: Recording, only: Sequence[str]) -> None:
    """Refuse an unknown name before the run is smoothed."""
    found, left = script(recording)
    names = [*(f.name for f in found), *(name for name, _ in left)]
    for part in only:
        if not any(_asked_for(name, [part]) for name in names):
            families = ", ".join(dict.fromkeys([*(f.family for f in found), *(name for name, _ in left)]))
            raise ConfigError(f"--only {part}: no such drill; there are: {families}")


def _asked_for(name: str, only: Sequence[str]) -> bool:
    return not only or any(part.lower() in name.lower() for part in only)


def _wanted(failures: Sequence[Failure], only: Sequence[str]) -> tuple[Failure, ...]:
    found = tuple(f for f in failures if _asked_for(f.name, only))
    if not found:
        names = ", ".join(dict.fromkeys(f.family for f in failures))
        raise ConfigError(f"--only {', '.join(only)}: the recording does not permit it; it permits: {names}")
    return found


def _stamps(recording: Recording) -> np.ndarray:
    assert recording.imu is not None  # it was smoothed
    return recording.imu.stamps_ns


def _first_ns(tracks: Tracks, part: DrillWindow) -> int:
    online, _ = tracks["graphloc online"]
    return part.begin_ns if online is None else int(online.stamps_ns[0])


def _typical_bound_m(track: Trajectory) -> float:
    assert track.cov is not None
    return float(np.median(bounds_95(track.cov)[:, 0]))


def _started_there(config: VesselConfig, recording: Recording, part: DrillWindow, track: Trajectory) -> VesselConfig:
    """Return the configuration for a window. Without a heading sensor it starts with the heading that the run has there."""
    told = any(isinstance(m, CompassHeading) for m in recording.measurements)
    at = np.array([max(part.begin_ns, int(track.stamps_ns[0]))])
    if part.whole or told or not track.covers(at)[0]:
        return config
    heading_deg = float(heading_deg_from_yaw(track.at(at).yaw_rad)[0])
    return config.with_start_heading(heading_deg)


def _tracks(job: _Job) -> Tracks:
    """Run every estimator on a window, with or without a failure."""
    struck = Struck(recording=job.part)
    if job.case is not None:
        struck = job.case.failure.on(job.part, job.case.begin_ns, job.case.seed)
    recording, late_ns = struck.recording, struck.late_ns
    tracks: Tracks = {}
    if job.case is None or recording is not job.part:  # the smoother does not see that something came late
        tracks["graphloc"] = _or_why_not(lambda: app.solve(recording, job.config, job.datum).trajectory)
    tracks["graphloc online"] = _or_why_not(
        lambda: replay(recording, job.config, datum=job.datum, late_ns=late_ns).solution.trajectory
    )
    known = as_it_comes(recording, late_ns)
    tracks["honest EKF"] = _or_why_not(lambda: ekf.run_honest(known, job.config, job.datum).trajectory)
    tracks["BL EKF"] = _or_why_not(lambda: ekf.run_bl(known, job.config, job.datum).trajectory)
    return tracks


def _or_why_not(solve: Callable[[], Trajectory]) -> tuple[Trajectory | None, str]:
    try:
        return solve(), ""
    except (SolveError, InputError, np.linalg.LinAlgError) as error:  # a filter that a failure broke is a result, too
        return None, str(error)


def as_it_comes(recording: Recording, late_ns: Mapping[int, int]) -> Recording:
    """Return the recording as filters get it, which do not model delays: late measurements are stamped with their arrival."""
    if not late_ns:
        return recording
    moved = [replace(m, stamp_ns=m.stamp_ns + late_ns.get(m.seq, 0)) for m in recording.measurements]
    return replace(recording, measurements=tuple(sorted(moved, key=lambda m: (m.stamp_ns, m.seq))))
