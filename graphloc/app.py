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
from ruamel.yaml import YAML

from graphloc import origin, outputs
from graphloc.build import mount_of
from graphloc.config import VesselConfig, load_config
from graphloc.errors import InputError, SolveError
from graphloc.eval import calibrate, ekf, holdout, metrics, report
from graphloc.eval.digerud import run_digerud
from graphloc.eval.docking import docking_table
from graphloc.eval.match_picture import Gallery
from graphloc.eval.plots import Underlay
from graphloc.eval.posture import posture_warnings
from graphloc.eval.simulate import SimulatedRun
from graphloc.eval.tag_check import suspect_tags
from graphloc.eval.underlay import underlay
from graphloc.factors import INERTIAL, KINDS, SENSORS
from graphloc.frames import Array, Datum
from graphloc.frontends.aerial import Match, match_bag
from graphloc.frontends.bag import read_recording
from graphloc.frontends.tags.unsurveyed import Riding, estimate_tags, only_beside
from graphloc.gather import Scans, with_matches, with_sightings, with_surveys
from graphloc.measurements import GnssPosition, TagSighting
from graphloc.offsets import Probe
from graphloc.recording import Progress, Recording, quiet
from graphloc.replay import Status, replay, silent
from graphloc.solution import Solution
from graphloc.solve import smooth
from graphloc.survey import WORLD, Survey, TagConfig
from graphloc.trajectory import Trajectory

_FOUND_TAGS = "tags.found.yaml"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """A smoothed run and what it is compared with."""

    recording: Recording
    config: VesselConfig
    solution: Solution
    held: tuple[GnssPosition, ...] = ()
    filters: tuple[ekf.FilterResult, ...] = ()
    pictures: tuple[tuple[str, bytes], ...] = ()  # of matches: caption, JPEG
    tags: tuple[TagConfig, ...] = ()  # that are not surveyed, where the run puts them
    underlay: Underlay | None = None  # the aerial image under the report's map
    calibration: calibrate.Calibration | None = None  # offline


def load(
    bags: Sequence[Path],
    config_path: Path,
    progress: Progress = quiet,
    changes: Mapping[str, object] = MappingProxyType({}),
) -> tuple[Recording, VesselConfig]:
    """Read a vessel.yaml, some of its keys changed (`config.with_changes`), and the bag that it describes."""
    config = with_surveys(load_config(config_path, KINDS, changes), config_path.parent)
    origin.refuse_world_without_datum(config, str(config_path), SENSORS)
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
    solution = _solved(recording, config, datum, progress, None if matched else calibrate.PROBE)
    gallery = Gallery()
    if scans is not None and matched:
        recording = with_matches(recording, config, datum, solution, scans, progress, gallery)
        solution = _solved(recording, config, datum, progress, calibrate.PROBE)
    filters: tuple[ekf.FilterResult, ...] = ()
    if compare:
        filters = _causal(recording, config, datum, progress)
    tags, said = _about_tags(recording, config, solution)
    said += posture_warnings(solution.trajectory, recording, config)
    run = Run(
        recording=replace(recording, warnings=(*recording.warnings, *said)), config=config, solution=solution, held=held,
        filters=filters, pictures=tuple(gallery.pictures()), tags=tags,
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


def _causal(
    recording: Recording, config: VesselConfig, datum: Datum, progress: Progress
) -> tuple[ekf.FilterResult, ...]:
    """What can be had at the time: the online mode, and the filters."""
    progress("filters", 0, 1)
    filters = ekf.run_all(recording, config, datum)
    his = run_digerud(recording, config, datum)
    filters += (his,) if his is not None else ()
    progress("filters", 1, 1)
    status = lambda at_s, whole_s, *_: progress("online", int(at_s), int(whole_s))
    try:
        online = replay(recording, config, datum=datum, status=status).solution
    except SolveError:
        return filters  # what it waited for is what `graphloc replay` says
    return (ekf.FilterResult(name="graphloc online", trajectory=online.trajectory, ledger=online.ledger), *filters)


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
    run = Run(recording=replayed.recording, config=config, solution=replayed.solution)
    return _comparable(_with_underlay(run, scans))


def _about_tags(
    recording: Recording, config: VesselConfig, solution: Solution
) -> tuple[tuple[TagConfig, ...], list[str]]:
    """Return tags that the run tells the place of, and what it says against the survey."""
    said = suspect_tags(recording, config, solution)
    if not recording.tag_views:
        return (), said
    surveys = {name: sensor.surveyed for name, sensor in config.of_kind("apriltag").items()}
    size_m = next((s.other_size_m for s in surveys.values() if s.other_size_m), None)
    riding = _riding(recording, surveys, solution)
    found, left = estimate_tags(recording.tag_views, solution.trajectory, size_m, riding)
    every = Survey.model_construct(tags=(*found, *(tag for s in surveys.values() for tag in s.tags)))
    for frame in sorted({tag.frame for tag in found}):
        names = ", ".join(every.called(tag.family, tag.id) for tag in found if tag.frame == frame)
        where = (
            "where the run puts it is" if frame == WORLD else f"seen only beside tags of {frame}, as if it rode on that"
        )
        said.append(f"{names}: not in the survey; {where} in {_FOUND_TAGS}")
    return tuple(found), [*said, *left]


def _riding(recording: Recording, surveys: Mapping[str, Survey], solution: Solution) -> dict[tuple[str, int], Riding]:
    """How the docks moved that tags which are not surveyed seem to ride on."""
    seen = [m for m in recording.measurements if isinstance(m, TagSighting)]
    found = {}
    for tag, (sensor, frame) in only_beside(recording.tag_views, seen).items():
        dock, slow = surveys[sensor].dock(frame), solution.slow[sensor]
        assert dock is not None  # sightings are of a frame of the survey
        first = slow.axes.index(f"{frame} east")
        moved = slow.value[:, first : first + 6] * np.repeat([1.0, np.pi / 180.0], 3)
        found[tag] = Riding(dock, slow.stamps_ns, moved)
    return found


def _solved(
    recording: Recording, config: VesselConfig, datum: Datum, progress: Progress, probe: Probe | None = None
) -> Solution:
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
    track = _solved(whole, config, datum, progress).trajectory
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
    recording = replace(run.recording, truth=truth, check_speed=speed, warnings=(*run.recording.warnings, *said))
    return replace(run, recording=recording, held=held, filters=filters)


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
    return tuple(found)


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
            warnings=(*run.recording.warnings, *run.solution.stats.warnings),
        )
        if run.tags:
            _write_tags(run, fresh / _FOUND_TAGS)
        if run.calibration is not None:
            text = json.dumps(run.calibration.as_dict(), indent=1)
            (fresh / "calibration.json").write_text(text + "\n", encoding="utf-8")
        report.write_report(fresh / "report.html", data)
        if figures:
            from graphloc.eval.plots.paper import write_figures

            (fresh / "figures").mkdir()
            write_figures(tuple(report.figures(data).values()), fresh / "figures")
    return folder / "report.html"


def _write_tags(run: Run, path: Path) -> None:
    """Write the surveys with the tags that were found, as one survey that can be read again."""
    surveys = [sensor.surveyed for sensor in run.config.of_kind("apriltag").values()]
    tags = {(tag.family, tag.id): tag for tag in (*run.tags, *(tag for s in surveys for tag in s.tags))}
    docks = {dock.name: dock for s in surveys for dock in s.docks}
    whole = Survey(
        tags=tuple(tags.values()), docks=tuple(docks.values()), berths=tuple(b for s in surveys for b in s.berths)
    )
    with path.open("w", encoding="utf-8") as stream:
        YAML(typ="safe", pure=True).dump(whole.model_dump(mode="json", exclude_none=True), stream)


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
    "load",
    "match_at",
    "replay_recording",
    "report_data",
    "seen_frames",
    "sha256",
    "simulated",
    "smooth_recording",
    "tables",
    "truth_statement",
    "with_matches",
    "with_sightings",
    "with_surveys",
    "with_synthetic",
    "write",
]
