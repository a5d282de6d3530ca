# SPDX-License-Identifier: Apache-2.0
"""The application: the one place, beside the CLI, where all rooms meet.

`bag -> frontend -> measurements -> rows -> graph -> solution -> outputs and report`, in that order.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from graphloc import outputs
from graphloc.build import mount_of
from graphloc.config import VesselConfig, load_config
from graphloc.errors import InputError
from graphloc.eval import ekf, holdout, metrics, report
from graphloc.eval.match_picture import Gallery
from graphloc.eval.simulate import SimulatedRun
from graphloc.factors import INERTIAL, KINDS, SENSORS
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.aerial import Match, match_bag
from graphloc.frontends.bag import read_recording
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import GnssPosition, Measurement
from graphloc.recording import Progress, Recording
from graphloc.solution import Solution
from graphloc.solve import smooth

_FAR_M = 200e3


def _quiet(_stage: str, _done: int, _total: int) -> None:
    return None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """A smoothed run and what it is compared with."""

    recording: Recording
    config: VesselConfig
    solution: Solution
    held: tuple[GnssPosition, ...] = ()
    filters: tuple[ekf.FilterResult, ...] = ()
    pictures: tuple[tuple[str, bytes], ...] = ()  # of matches: caption, JPEG


def load(bags: Sequence[Path], config_path: Path, progress: Progress = _quiet) -> tuple[Recording, VesselConfig]:
    """Read a vessel.yaml and the bag that it describes."""
    config = load_config(config_path, KINDS)
    _refuse_world_without_datum(config, str(config_path))
    return read_recording(bags, config, progress), config


def smooth_recording(
    recording: Recording,
    config: VesselConfig,
    *,
    hold_out: holdout.HoldOut | None = None,
    compare: bool = False,
    scans: Scans | None = None,
    progress: Progress = _quiet,
) -> Run:
    """Smooth a recording; hold fixes out and run the filters beside it if asked.

    With `scans` and an aerial sensor the run is smoothed, its scans are matched around that, and it is smoothed again.
    """
    held: tuple[GnssPosition, ...] = ()
    if hold_out is not None:
        recording, held = hold_out.split(recording)
    datum = choose_datum(recording, config)
    recording = with_synthetic(recording, config, datum)
    solution = smooth(recording, config, datum, rows=SENSORS, inertial=INERTIAL, progress=progress)
    gallery = Gallery()
    if scans is not None and config.of_kind("aerial"):
        recording = with_matches(recording, config, datum, solution, scans, progress, gallery)
        solution = smooth(recording, config, datum, rows=SENSORS, inertial=INERTIAL, progress=progress)
    filters: tuple[ekf.FilterResult, ...] = ()
    if compare:
        progress("filters", 0, 1)
        filters = ekf.run_all(recording, config, datum)
        progress("filters", 1, 1)
    run = Run(
        recording=recording, config=config, solution=solution, held=held, filters=filters,
        pictures=tuple(gallery.pictures()),
    )  # fmt: skip
    return _comparable(run)


@dataclass(frozen=True, slots=True)
class Scans:
    """Where scans are matched from: the bags, and the folder that relative image paths count from."""

    bags: tuple[Path, ...]
    folder: Path


def with_matches(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    solution: Solution,
    scans: Scans,
    progress: Progress = _quiet,
    gallery: Gallery | None = None,
) -> Recording:
    """Add the matches of every aerial sensor, made around a solution; a scan that gave none is a row of the ledger.

    Raises:
        InputError: an image or LiDAR that cannot be used.
    """
    measurements, rows, topics = list(recording.measurements), list(recording.rows), dict(recording.topics)
    track, seq = solution.trajectory, recording.message_count
    damage: list[str] = []
    span_s = int((track.stamps_ns[-1] - track.stamps_ns[0]) / 1e9)
    for name, sensor in config.of_kind("aerial").items():
        topics[name] = f"({name})"
        read = {lidar.topic for lidar in sensor.lidars.values()}
        rows = [
            replace(r, reason=f"read by {name}") if r.topic in read and r.outcome is Outcome.IGNORED else r
            for r in rows
        ]
        found = match_bag(scans.bags, sensor, scans.folder, config.body_frame, track, datum, warn=damage.append)
        for item in found:
            if item.match is not None and gallery is not None:
                gallery.offer(item.match, name, (item.stamp_ns - int(track.stamps_ns[0])) / 1e9)
            if item.match is not None and item.match.modes:
                measurements.append(replace(item.match.fix(item.stamp_ns, name, item.news, sensor.axes), seq=seq))
            else:
                rows.append(
                    LedgerRow(
                        seq=seq, stamp_ns=item.stamp_ns, sensor=name, topic=topics[name], outcome=Outcome.REJECTED,
                        reason=item.why_not,
                    )
                )  # fmt: skip
            seq += 1
            progress("matching", min(int((item.stamp_ns - track.stamps_ns[0]) / 1e9), span_s), span_s)
        progress("matching", span_s, span_s)
        damage += _few_matches(name, rows)
    return replace(
        recording,
        measurements=tuple(sorted(measurements, key=lambda m: (m.stamp_ns, m.seq))),
        rows=tuple(rows),
        topics=topics,
        message_count=seq,
        warnings=tuple(dict.fromkeys([*recording.warnings, *damage])),
    )


def _few_matches(sensor: str, rows: Sequence[LedgerRow]) -> list[str]:
    """Say so where most scans of a sensor gave no match."""
    reasons = Counter(row.reason for row in rows if row.sensor == sensor and row.outcome is Outcome.REJECTED)
    if reasons.total() < 5:
        return []
    ((most, count),) = reasons.most_common(1)
    return [f"{sensor}: {reasons.total()} scans gave no match, {count} of them: {most}; `graphloc match` shows one"]


def match_at(
    recording: Recording, config: VesselConfig, scans: Scans, at_s: float, progress: Progress = _quiet
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
    track = smooth(whole, config, datum, rows=SENSORS, inertial=INERTIAL, progress=progress).trajectory
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
    warnings = (*run.recording.warnings, *said)
    return replace(run, recording=replace(run.recording, truth=truth, check_speed=speed, warnings=warnings), held=held)


def levers_m(run: Run) -> dict[str, Array]:
    """Return the antenna of each receiver that fixes were held out of, in body."""
    names = dict.fromkeys(m.sensor for m in run.held)
    return {name: mount_of(name, run.config.sensors[name], run.recording)[0] for name in names}


def simulated(run: SimulatedRun, *, compare: bool = False, progress: Progress = _quiet) -> Run:
    """Smooth a simulated run."""
    return smooth_recording(run.recording, run.config, compare=compare, progress=progress)


def choose_datum(recording: Recording, config: VesselConfig) -> Datum:
    """Return the configured datum, or the median of the first fixes.

    Raises:
        InputError: none is configured, and there is no fix to take one from, or something is given in world.
    """
    if config.datum is not None:
        datum = Datum(config.datum.geodetic)
        _refuse_far_fixes(recording, datum)
        return datum
    _refuse_world_without_datum(config, recording.source)
    fixes = np.array([m.position for m in recording.measurements if isinstance(m, GnssPosition)][:5])
    if not len(fixes):
        raise InputError(f"{recording.source}: {_why_no_fix(recording, config)}")
    # Longitudes about the first one, so that fixes on both sides of the date line stay together.
    fixes[:, 1] = fixes[0, 1] + (fixes[:, 1] - fixes[0, 1] + 180.0) % 360.0 - 180.0
    return Datum(Geodetic(*(float(v) for v in np.median(fixes, axis=0))))


def _refuse_far_fixes(recording: Recording, datum: Datum) -> None:
    """A forgotten minus sign puts the datum on the other side of the world, where nothing can be solved.

    Raises:
        InputError: most fixes lie farther away than any run goes.
    """
    fixes = [m.position for m in recording.measurements if isinstance(m, GnssPosition)]
    if fixes:
        away_m = np.linalg.norm(datum.enu_from_geodetic(*np.array(fixes).T), axis=1)
        if np.median(away_m) > _FAR_M:
            raise InputError(
                f"{recording.source}: its fixes lie {np.median(away_m) / 1e3:.0f} km from `datum:`, near latitude "
                f"{fixes[0].latitude_deg:.4f}, longitude {fixes[0].longitude_deg:.4f}: correct the datum"
            )


def _why_no_fix(recording: Recording, config: VesselConfig) -> str:
    receivers = config.of_kind("gnss")
    if not receivers:
        return "no GNSS sensor to take a datum from; set datum: in vessel.yaml"
    reasons = Counter(f"{row.sensor}: {row.reason}" for row in recording.rows if row.sensor in receivers)
    if not reasons:
        return f"no GNSS fix from {', '.join(receivers)}: the topic holds no message"
    (reason, count), *_ = reasons.most_common(1)
    return f"no usable GNSS fix: {count} messages of {reason}"


def _refuse_world_without_datum(config: VesselConfig, where: str) -> None:
    in_world = [f"sensors.{name}" for row in SENSORS if row.in_world for name in config.of_kind(row.kind)]
    in_world += ["truth_topic"] if config.truth_topic else []
    if in_world and config.datum is None:
        raise InputError(
            f"{where}: {', '.join(in_world)}: places in world, but nothing says where world's origin is; "
            "set datum: (`graphloc inspect` guesses it)"
        )


def with_synthetic(recording: Recording, config: VesselConfig, datum: Datum) -> Recording:
    """Add the measurements that the configuration makes itself (the height prior)."""
    if recording.imu is None or not len(recording.imu):
        return recording
    span = (int(recording.imu.stamps_ns[0]), int(recording.imu.stamps_ns[-1]))
    added: list[Measurement] = []
    for name, sensor in config.sensors.items():
        row = next((r for r in SENSORS if r.kind == sensor.kind), None)
        if row is not None and row.synthetic is not None and sensor.enabled:
            added.extend(row.synthetic(name, sensor, span, _height_m(recording, config, sensor.height_m, datum)))
    if not added:
        return recording
    every = sorted([*recording.measurements, *added], key=lambda m: (m.stamp_ns, m.seq))
    return replace(recording, measurements=tuple(every))


def _height_m(recording: Recording, config: VesselConfig, height_m: float | None, datum: Datum) -> float:
    """Height of the body in world: as configured (ellipsoidal), or the median fix less its antenna's height."""
    if height_m is not None:
        return height_m - datum.origin.height_m
    heights = [
        m.position.height_m - float(mount_of(m.sensor, config.sensors[m.sensor], recording)[0][2])
        for m in recording.measurements
        if isinstance(m, GnssPosition)
    ]
    return float(np.median(heights)) - datum.origin.height_m if heights else 0.0


def tables(run: Run) -> tuple[metrics.Table, ...]:
    """Return the numbers of a run: against truth, held-out fixes, and the speed check."""
    found: list[metrics.Table] = []
    estimates = [("graphloc", run.solution.trajectory), *((f.name, f.trajectory) for f in run.filters)]
    if run.recording.truth is not None:
        found.append(metrics.truth_table(estimates, run.recording.truth))
    if run.held:
        found.append(metrics.held_out_table(estimates, run.held, run.solution.datum, levers_m(run)))
    if run.recording.check_speed is not None:
        found.append(metrics.speed_table(estimates, run.recording.check_speed))
    return tuple(found)


def truth_statement(run: Run) -> str:
    """Say plainly what the numbers were measured against."""
    if run.recording.truth is not None:
        return "Truth: " + (run.config.truth_topic or "given with the recording") + "; it was not fused."
    if run.held:
        return (
            f"No truth. {len(run.held)} GNSS fixes were kept out of the estimate and predicted; their own noise is part "
            "of the error. The track in this folder lacks them: for the best track run again without --hold-out."
        )
    return "No truth and no held-out fixes: nothing here measures accuracy. Try --hold-out every:5."


def write(run: Run, folder: Path, *, inputs: Sequence[Path], command: str, overwrite: bool) -> Path:
    """Write the run folder with its report; return the report's path."""
    found = tables(run)
    with outputs.fresh_folder(folder, overwrite=overwrite) as fresh:
        outputs.write_run(
            fresh,
            run.solution,
            run.config,
            inputs={str(p): sha256(p) for p in inputs},
            command=command,
            metrics={t.title: t.as_dict() for t in found},
        )
        report.write_report(
            fresh / "report.html",
            report.ReportData(
                title=f"{run.config.vessel}: {Path(run.recording.source).name}",
                solution=run.solution,
                recording=run.recording,
                config=run.config,
                filters=run.filters,
                held=run.held,
                levers_m=levers_m(run),
                tables=found,
                truth_statement=truth_statement(run),
                pictures=run.pictures,
            ),
        )
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
    "load",
    "match_at",
    "sha256",
    "simulated",
    "smooth_recording",
    "tables",
    "truth_statement",
    "with_matches",
    "with_synthetic",
    "write",
]
