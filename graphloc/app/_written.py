# SPDX-License-Identifier: Apache-2.0
"""What is said of a run: its tables, its report, its folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from graphloc import found_tags, outputs
from graphloc.app._run import Run, antennas
from graphloc.config import load_config
from graphloc.eval import metrics, report
from graphloc.eval.docking import docking_table
from graphloc.eval.ekf import named_tracks, starts_at_truth
from graphloc.eval.holdout import suggested
from graphloc.factors import KINDS
from graphloc.folders import fresh_folder
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, TagSighting
from graphloc.time import stamps_of
from graphloc.trajectory import Trajectory

_NEARLY_ALL = 0.95  # share of a run from which a truth is said to be of all of it; a choice


def tables(run: Run) -> tuple[metrics.Table, ...]:
    """Return the numbers of a run: against truth, held-out fixes, and the speed check."""
    found: list[metrics.Table] = []
    estimates = named_tracks(run.solution, run.filters)
    if run.recording.truth is not None:
        table, lasts = (
            metrics.truth_table(estimates, run.recording.truth),
            _lasts(run.recording.truth, run.solution.trajectory),
        )
        part = f"; the truth covers {lasts}" if "of the run" in lasts else ""
        found.append(replace(table, note=table.note + part))
        found += _docking_tables(run, estimates, run.recording.truth)
    if run.held:
        slow = {s.name: s.slow for s in (run.solution, run.online) if s is not None}
        found.append(metrics.held_out_table(estimates, run.held, run.solution.datum, antennas(run), slow))
    if (check := run.recording.check_speed) is not None:
        off = (n for n, s in run.config.sensors.items() if s.kind == "body_velocity" and s.topic == check.topic)
        found.append(metrics.speed_table(estimates, check, next(off, "")))
    whys = [f"{f.name}: {f.why}." for f in run.filters if f.why]
    return (replace(found[0], note="\n".join([found[0].note, *whys])), *found[1:]) if found else ()


def _docking_tables(
    run: Run, estimates: Sequence[tuple[str, Trajectory]], truth: Trajectory
) -> Iterator[metrics.Table]:
    """A table for each tag sensor that saw a tag."""
    sensors = run.config.of_kind("apriltag")
    for name, sensor in sensors.items():
        seen = run.recording.of(TagSighting, name)
        if seen:
            stamps = stamps_of(seen)
            table = docking_table(estimates, truth, sensor.surveyed, stamps, seen[0].t_body_camera_m)
            yield replace(table, title=table.title if len(sensors) == 1 else f"{table.title}: {name}")


def truth_statement(run: Run) -> str:
    """Say plainly what the numbers were measured against."""
    if run.recording.truth is not None:
        truth = run.recording.truth
        named = run.config.truth or "given with the recording"
        begun = bool(run.filters) and starts_at_truth(run.recording)
        started = " The EKFs start from it, as BL's did; graphloc does not." if begun else ""
        poses = "poses" if truth.headed else "positions without a heading"
        return f"Truth: {named}, {len(truth)} {poses} over {_lasts(truth, run.solution.trajectory)}; it was not fused.{started}"
    if run.held:
        sensors = [row.sensor for row in run.recording.rows if row.outcome is Outcome.HELD_OUT]
        velocities = sum(name in run.config.of_kind("gnss_velocity") for name in sensors)
        left = len(sensors) - velocities - len(run.held)
        beside = (
            f" Another {left} without RTK were kept out as well; they tell less, as they are off by more."
            if left
            else ""
        )
        if velocities:
            beside += f" The {velocities} GNSS velocities in the gaps were kept out, too, as in an outage."
        shared = not {fix.sensor for fix in run.held} <= set(run.solution.slow)
        drift = (
            ", a drift that they share with the fixes around them is not: no other sensor tells it" if shared else ""
        )
        return (
            f"No truth. {len(run.held)} GNSS fixes were kept out of the estimate and predicted; their own noise is part "
            f"of the error{drift}.{beside} The track in this folder lacks them: for the best track run again without --hold-out."
        )
    none = "No truth" if not run.config.truth else f"No truth ({run.config.truth} cannot be used: see the warnings)"
    said = f"{none} and no held-out fixes: nothing here measures accuracy"
    by = suggested(run.recording.of(GnssPosition))
    return (
        f"{said}. `graphloc compare --hold-out {by}` does." if by else f"{said}; a `truth_topic` or `truth_file` would."
    )


def _lasts(truth: Trajectory, track: Trajectory) -> str:
    """Say for how long a truth is known, gaps left out, and of how long a run if that is less than nearly all of it."""
    steps_s = np.diff(truth.stamps_ns) / 1e9
    known_s = float(steps_s[steps_s <= max(2.5 * float(np.median(steps_s)), 1.0)].sum())
    run_s = float(track.stamps_ns[-1] - track.stamps_ns[0]) / 1e9
    return f"{known_s:.0f} s" + ("" if known_s > _NEARLY_ALL * run_s else f" of the run's {run_s:.0f} s")


def _titled(vessel: str, source: str) -> str:
    """Return what a report is headed with; `inspect` names a vessel after its bag, and one name is enough then."""
    bag = source.partition(", ")[0]
    return source if vessel in (bag, Path(bag).stem) else f"{vessel}: {source}"


def report_data(run: Run, command: str = "") -> report.ReportData:
    """Return what the report of a run shows."""
    return report.ReportData(
        title=_titled(run.config.vessel, Path(run.recording.source).name),
        solution=run.solution,
        recording=run.recording,
        config=run.config,
        filters=run.filters,
        held=run.held,
        antennas=antennas(run),
        tables=tables(run),
        truth_statement=truth_statement(run),
        pictures=run.pictures,
        underlay=run.underlay,
        calibration=run.calibration,
        online=run.online,
        command=command,
    )


def write(
    run: Run,
    folder: Path | str,
    *,
    inputs: Sequence[Path] = (),
    command: str = "",
    overwrite: bool = False,
    figures: bool = False,
) -> Path:
    """Write the run folder with its report, and its figures as PNG and SVG if asked; return the report's path.

    Args:
        inputs: files whose SHA-256 goes into `run.json`. command: what made the run, for `run.json` and the report.
        overwrite: replace the folder of an earlier run.

    Raises:
        OutputError: it is there already, or cannot be written.
    """
    folder = Path(folder)
    data, hashes = report_data(run, command), {str(p): sha256(p) for p in inputs}
    with fresh_folder(folder, overwrite=overwrite, mark=outputs.MARK) as fresh:
        outputs.write_run(
            fresh,
            run.solution,
            run.config.with_mounts(run.recording.mounts),
            inputs=hashes,
            command=command,
            metrics={t.title: t.as_dict() for t in data.tables},
            warnings=run.warnings,
            span=run.recording.span,
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


def inputs_of(
    bags: Sequence[Path], config_path: Path, changes: Mapping[str, object] = MappingProxyType({})
) -> tuple[Path, ...]:
    """Return what a run is made of: bags, vessel.yaml, and the files that it names (images, surveys, truth).

    Args:
        changes: of keys of vessel.yaml, as of `configured`.
    """
    named = load_config(config_path, KINDS, changes).files
    return *bags, config_path, *(config_path.parent / file for file in named)


def sha256(path: Path) -> str:
    """Return the hash of a file, or of all files of a folder in name order; of what cannot be read, why."""
    if not path.exists():
        return "no such file"
    digest = hashlib.sha256()
    try:
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        for file in files:
            with file.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    except OSError as error:
        return f"cannot be read ({error.strerror or error})"
    return digest.hexdigest()
