# SPDX-License-Identifier: Apache-2.0
"""The application: the one place, beside the CLI, where all rooms meet.

`bag -> frontend -> measurements -> rows -> graph -> solution -> outputs and report`, in that order.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from graphloc import found_tags, origin, outputs
from graphloc.build import mount_of
from graphloc.config import VesselConfig, load_config
from graphloc.errors import InputError, SolveError
from graphloc.eval import calibrate, ekf, holdout, metrics, report
from graphloc.eval.apart import apart_warnings
from graphloc.eval.digerud import run_digerud
from graphloc.eval.docking import docking_table
from graphloc.eval.match_picture import Gallery
from graphloc.eval.plots import Underlay
from graphloc.eval.posture import posture_warnings
from graphloc.eval.simulate import SimulatedRun
from graphloc.eval.underlay import underlay
from graphloc.factors import INERTIAL, KINDS, SENSORS
from graphloc.frames import Array, Datum
from graphloc.frontends.aerial import Match, match_bag
from graphloc.frontends.bag import read_recording
from graphloc.gather import Scans, with_matches, with_sightings, with_surveys
from graphloc.measurements import GnssPosition, TagSighting
from graphloc.offsets import Probe
from graphloc.recording import Progress, Recording, quiet
from graphloc.replay import Status, replay, silent
from graphloc.solution import Solution
from graphloc.solve import smooth
from graphloc.survey import TagConfig
from graphloc.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """A smoothed run and what it is compared with."""

    recording: Recording
    config: VesselConfig
    solution: Solution
    held: tuple[GnssPosition, ...] = ()
    filters: tuple[ekf.FilterResult, ...] = ()
    online: Solution | None = None  # of the same measurements, beside an offline run that is compared
    pictures: tuple[tuple[str, bytes], ...] = ()  # of matches: caption, JPEG
    tags: tuple[TagConfig, ...] = ()  # that are not surveyed, where the run puts them
    underlay: Underlay | None = None  # the aerial image under the report's map
    calibration: calibrate.Calibration | None = None  # offline

    @property
    def warnings(self) -> tuple[str, ...]:
        """All that was said on the way."""
        return report.said_on_the_way(self.recording, self.solution, self.online)


def configured(config_path: Path, changes: Mapping[str, object] = MappingProxyType({})) -> VesselConfig:
    """Read a vessel.yaml with the surveys that it names, some of its keys changed (`config.with_changes`).

    Raises:
        ConfigError: it or a survey cannot be used.
    """
    config = with_surveys(load_config(config_path, KINDS, changes), config_path.parent)
    origin.refuse_world_without_datum(config, str(config_path), SENSORS)
    return config


def load(
    bags: Sequence[Path],
    config_path: Path,
    progress: Progress = quiet,
    changes: Mapping[str, object] = MappingProxyType({}),
) -> tuple[Recording, VesselConfig]:
    """Read a vessel.yaml, some of its keys changed (`config.with_changes`), and the bag that it describes."""
    config = configured(config_path, changes)
    recording = read_recording(bags, config, progress)
    return with_sightings(recording, config, bags, progress), config


def smooth_recording(
    recording: Recording,
    config: VesselConfig,
    *,
    hold_out: holdout.HoldOut | None = None,
    compare: bool = False,
    scans: Scans | None = None,
    progress: Progress = quiet,
) -> Run:
    """Smooth a recording; hold fixes out and run the filters beside it if asked.

    With `scans` and an aerial sensor the run is smoothed, its scans are matched around that, and it is smoothed again.
    """
    held: tuple[GnssPosition, ...] = ()
    if hold_out is not None:
        recording, held = hold_out.split(recording)
    datum = choose_datum(recording, config)
    recording = with_synthetic(recording, config, datum)
    matched = scans is not None and bool(config.of_kind("aerial"))
    solution = solve(recording, config, datum, probe=None if matched else calibrate.PROBE, progress=progress)
    gallery = Gallery()
    if scans is not None and matched:
        recording = with_matches(recording, config, datum, solution, scans, progress, gallery)
        solution = solve(recording, config, datum, probe=calibrate.PROBE, progress=progress)
    filters: tuple[ekf.FilterResult, ...] = ()
    online, never = None, ""
    if compare:
        filters = _filters(recording, config, datum, progress)
        online, never = _online(recording, config, datum, progress)
    if online is not None:
        beside = ekf.FilterResult(name=online.name, trajectory=online.trajectory, ledger=online.ledger)
        filters = (beside, *filters)
    tags, said = found_tags.about_tags(recording, config, solution)
    said += [*_track_warnings(solution, recording, config), *([never] if never else [])]
    run = Run(
        recording=replace(recording, warnings=(*recording.warnings, *said)), config=config, solution=solution, held=held,
        filters=filters, online=online, pictures=tuple(gallery.pictures()), tags=tags,
        calibration=calibrate.calibrate(recording, config, solution),
    )  # fmt: skip
    return _comparable(_with_underlay(run, scans))


def _with_underlay(run: Run, scans: Scans | None) -> Run:
    """Add the aerial image under the report's map, or the reason why the one that was asked for cannot be had."""
    if scans is None:
        return run
    picture, why_not = underlay(run.config, scans.folder, run.solution.datum, run.solution.trajectory.p_world_m)
    said = (*run.recording.warnings, *([why_not] if why_not else []))
    return replace(run, recording=replace(run.recording, warnings=said), underlay=picture)


def _filters(
    recording: Recording, config: VesselConfig, datum: Datum, progress: Progress
) -> tuple[ekf.FilterResult, ...]:
    progress("filters", 0, 1)
    filters = ekf.run_all(recording, config, datum)
    his = run_digerud(recording, config, datum)
    filters += (his,) if his is not None else ()
    progress("filters", 1, 1)
    return filters


def _track_warnings(solution: Solution, recording: Recording, config: VesselConfig) -> list[str]:
    """What a solved track, offline or online, tells of the configuration."""
    track = solution.trajectory
    return posture_warnings(track, recording, config) + apart_warnings(track, solution.datum, recording, config)


def _online(
    recording: Recording, config: VesselConfig, datum: Datum, progress: Progress
) -> tuple[Solution | None, str]:
    """Return what the online mode makes of it, or why it made nothing."""
    status = lambda at_s, whole_s, *_: progress("online", int(at_s), int(whole_s))
    try:
        return replay(recording, config, datum=datum, status=status).solution, ""
    except SolveError as error:
        return None, f"graphloc online is not compared: {error}"


def replay_recording(
    recording: Recording,
    config: VesselConfig,
    *,
    scans: Scans | None = None,
    rate: float | None = None,
    lag_s: float = 10.0,
    status: Status = silent,
) -> Run:
    """Run a recording through the online mode (see `graphloc.replay`)."""
    replayed = replay(recording, config, scans=scans, rate=rate, lag_s=lag_s, stoppable=True, status=status)
    recording, solution = replayed.recording, replayed.solution
    said = _track_warnings(solution, recording, config)
    run = Run(recording=replace(recording, warnings=(*recording.warnings, *said)), config=config, solution=solution)
    return _comparable(_with_underlay(run, scans))


def solve(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    *,
    probe: Probe | None = None,
    progress: Progress = quiet,
) -> Solution:
    """Smooth what is in a recording as it is: nothing is matched, held out or compared.

    Args:
        datum: origin of world. probe: what to ask of offsets (see `eval.calibrate`).

    Raises:
        SolveError: it cannot be started or solved.
    """
    config = seen_frames(config, recording)
    return smooth(recording, config, datum, rows=SENSORS, inertial=INERTIAL, probe=probe, progress=progress)


def seen_frames(config: VesselConfig, recording: Recording) -> VesselConfig:
    """Return the configuration whose surveys hold what was seen in the run: other frames need no states."""
    seen = {(m.sensor, m.frame) for m in recording.measurements if isinstance(m, TagSighting)}
    cut = {
        name: sensor.model_copy(update={"survey": sensor.surveyed.of({f for s, f in seen if s == name})})
        for name, sensor in config.of_kind("apriltag").items()
    }
    return config.model_copy(update={"sensors": {**config.sensors, **cut}})


def match_at(
    recording: Recording, config: VesselConfig, scans: Scans, at_s: float, progress: Progress = quiet
) -> tuple[Match, int]:
    """Match the scan nearest to a time (s since the first IMU sample) around the run smoothed without matches.

    Returns:
        The match, and its stamp (ns).

    Raises:
        InputError: no aerial sensor is switched on, or it cannot work there.
    """
    sensors = config.of_kind("aerial")
    if not sensors:
        raise InputError("no sensor of kind aerial is enabled: set `enabled: true` in its block")
    (sensor, *_) = sensors.values()
    datum = choose_datum(recording, config)
    whole = with_synthetic(recording, config, datum)
    track = solve(whole, config, datum, progress=progress).trajectory
    span_s = (int(track.stamps_ns[-1]) - int(track.stamps_ns[0])) / 1e9
    if not 0.0 <= at_s <= span_s:
        raise InputError(f"{recording.source}: --at {at_s:g}: the run is from 0 to {span_s:.1f} s")
    at_ns = int(track.stamps_ns[0]) + round(at_s * 1e9)
    found = match_bag(scans.bags, sensor, scans.folder, config.body_frame, track, datum, at_ns=at_ns)
    item = next(found, None)
    if item is None or item.match is None:
        raise InputError(
            f"{recording.source}: no match at {at_s:g} s: {item.why_not if item else 'no scan in the bag'}"
        )
    return item.match, item.stamp_ns


def _comparable(run: Run) -> Run:
    """Drop what shares no time with the track, and say so."""
    truth, speed, held, track = run.recording.truth, run.recording.check_speed, run.held, run.solution.trajectory
    said: list[str] = []

    def comparable(compare: Callable[..., object], *arguments: object) -> bool:
        try:
            compare(*arguments)
        except metrics.NoCommonTimeError as error:
            said.append(str(error))
            return False
        return True

    if truth is not None and not comparable(metrics.errors, track, truth):
        truth = None
    if speed is not None and not comparable(metrics.compare_speed, track, speed):
        speed = None
    if held and not comparable(metrics.held_out_errors, track, held, run.solution.datum, levers_m(run)):
        held = ()

    def fits(filtered: ekf.FilterResult) -> bool:
        return (truth is None or comparable(metrics.errors, filtered.trajectory, truth)) and (
            not held
            or comparable(metrics.held_out_errors, filtered.trajectory, held, run.solution.datum, levers_m(run))
        )

    filters = tuple(f for f in run.filters if fits(f))
    online = run.online
    if online is not None and not comparable(metrics.errors, online.trajectory, track):
        online = None
    recording = replace(run.recording, truth=truth, check_speed=speed, warnings=(*run.recording.warnings, *said))
    return replace(run, recording=recording, held=held, filters=filters, online=online)


def levers_m(run: Run) -> dict[str, Array]:
    """Return the antenna of each receiver that fixes were held out of, in body."""
    names = dict.fromkeys(m.sensor for m in run.held)
    return {name: mount_of(name, run.config.sensors[name], run.recording.mounts)[0] for name in names}


def simulated(run: SimulatedRun, *, compare: bool = False, progress: Progress = quiet) -> Run:
    """Smooth a simulated run."""
    return smooth_recording(run.recording, run.config, compare=compare, progress=progress)


def choose_datum(recording: Recording, config: VesselConfig) -> Datum:
    """Return the configured datum, or the median of the first fixes (see `origin.choose_datum`)."""
    return origin.choose_datum(recording, config, SENSORS)


def with_synthetic(recording: Recording, config: VesselConfig, datum: Datum) -> Recording:
    """Add the measurements that the configuration makes itself (the height prior)."""
    return origin.with_synthetic(recording, config, datum, SENSORS)


def tables(run: Run) -> tuple[metrics.Table, ...]:
    """Return the numbers of a run: against truth, held-out fixes, and the speed check."""
    found: list[metrics.Table] = []
    estimates = [(run.solution.name, run.solution.trajectory), *((f.name, f.trajectory) for f in run.filters)]
    if run.recording.truth is not None:
        found.append(metrics.truth_table(estimates, run.recording.truth))
        found += _docking_tables(run, estimates, run.recording.truth)
    if run.held:
        found.append(metrics.held_out_table(estimates, run.held, run.solution.datum, levers_m(run)))
    if run.recording.check_speed is not None:
        found.append(metrics.speed_table(estimates, run.recording.check_speed))
    whys = [f"{f.name}: {f.why}." for f in run.filters if f.why]
    return (replace(found[0], note="\n".join([found[0].note, *whys])), *found[1:]) if found else ()


def _docking_tables(
    run: Run, estimates: Sequence[tuple[str, Trajectory]], truth: Trajectory
) -> Iterator[metrics.Table]:
    """A table for each tag sensor that saw a tag."""
    sensors = run.config.of_kind("apriltag")
    for name, sensor in sensors.items():
        seen = [m for m in run.recording.measurements if isinstance(m, TagSighting) and m.sensor == name]
        if seen:
            stamps = np.array([m.stamp_ns for m in seen], dtype=np.int64)
            table = docking_table(estimates, truth, sensor.surveyed, stamps, seen[0].t_body_camera_m)
            yield replace(table, title=table.title if len(sensors) == 1 else f"{table.title}: {name}")


def truth_statement(run: Run) -> str:
    """Say plainly what the numbers were measured against."""
    if run.recording.truth is not None:
        truth = run.recording.truth
        span_s = (int(truth.stamps_ns[-1]) - int(truth.stamps_ns[0])) / 1e9
        named = run.config.truth_topic or "given with the recording"
        imu = run.recording.imu
        begun = bool(run.filters) and imu is not None and bool(truth.covers(imu.stamps_ns[:1]).all())
        started = " The EKFs are started at it, as BL started theirs; graphloc is not." if begun else ""
        return f"Truth: {named}, {len(truth)} poses over {span_s:.0f} s; it was not fused.{started}"
    if run.held:
        return (
            f"No truth. {len(run.held)} GNSS fixes were kept out of the estimate and predicted; their own noise is part "
            "of the error. The track in this folder lacks them: for the best track run again without --hold-out."
        )
    return (
        "No truth and no held-out fixes: nothing here measures accuracy. `graphloc compare --hold-out gaps:8x10` does."
    )


def report_data(run: Run, command: str = "") -> report.ReportData:
    """Return what the report of a run shows."""
    return report.ReportData(
        title=f"{run.config.vessel}: {Path(run.recording.source).name}",
        solution=run.solution,
        recording=run.recording,
        config=run.config,
        filters=run.filters,
        held=run.held,
        levers_m=levers_m(run),
        tables=tables(run),
        truth_statement=truth_statement(run),
        pictures=run.pictures,
        underlay=run.underlay,
        calibration=run.calibration,
        online=run.online,
        command=command,
    )


def write(
    run: Run, folder: Path, *, inputs: Sequence[Path], command: str, overwrite: bool, figures: bool = False
) -> Path:
    """Write the run folder with its report, and its figures as PNG and SVG if asked; return the report's path."""
    data = report_data(run, command)
    with outputs.fresh_folder(folder, overwrite=overwrite) as fresh:
        outputs.write_run(
            fresh,
            run.solution,
            run.config,
            inputs={str(p): sha256(p) for p in inputs},
            command=command,
            metrics={t.title: t.as_dict() for t in data.tables},
            warnings=run.warnings,
        )
        if run.tags:
            found_tags.write(fresh / found_tags.FILE, run.tags, run.config)
        if run.calibration is not None:
            text = json.dumps(run.calibration.as_dict(), indent=1)
            (fresh / "calibration.json").write_text(text + "\n", encoding="utf-8")
        report.write_report(fresh / "report.html", data)
        if figures:
            from graphloc.eval.plots.paper import write_figures

            (fresh / "figures").mkdir()
            write_figures(tuple(report.figures(data).values()), fresh / "figures")
    return folder / "report.html"


def sha256(path: Path) -> str:
    """Return the hash of a file, or of all files of a folder in name order."""
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


__all__ = [
    "Run",
    "Scans",
    "choose_datum",
    "configured",
    "load",
    "match_at",
    "replay_recording",
    "report_data",
    "seen_frames",
    "sha256",
    "simulated",
    "smooth_recording",
    "solve",
    "tables",
    "truth_statement",
    "with_matches",
    "with_sightings",
    "with_surveys",
    "with_synthetic",
    "write",
]
