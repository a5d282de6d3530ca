# SPDX-License-Identifier: Apache-2.0
"""From a bag to a run: read, smoothed or replayed, its scans matched, the filters beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from graphloc import found_tags, origin
from graphloc.app._run import Run, made_comparable
from graphloc.config import VesselConfig, load_config
from graphloc.errors import InputError, SolveError
from graphloc.eval import calibrate, ekf, holdout
from graphloc.eval.digerud import run_digerud
from graphloc.eval.gnss_check import GnssOffset, gnss_offsets
from graphloc.eval.late_check import late_doubts
from graphloc.eval.mount_check import MountDoubt, mount_doubts
from graphloc.eval.simulate import SimulatedRun
from graphloc.eval.tag_check import suspect_tags
from graphloc.eval.underlay import underlay
from graphloc.factors import INERTIAL, KINDS, SENSORS
from graphloc.frames import Datum
from graphloc.frontends.aerial import Match, check_scans, match_bag
from graphloc.frontends.bag import read_recording
from graphloc.frontends.part import Bags
from graphloc.frontends.tum import read_tum
from graphloc.gather import Matches, Scans, with_matches, with_sightings, with_surveys
from graphloc.measurements import GnssPosition, TagSighting
from graphloc.offsets import Probe
from graphloc.online import OnlineSmoother
from graphloc.recording import Mounts, Progress, Recording, quiet
from graphloc.replay import Status, replay, silent
from graphloc.signals.frozen_receiver import without_frozen_fixes
from graphloc.solution import Solution
from graphloc.solve import smooth
from graphloc.time import NS_PER_S, duration_ns
from graphloc.trajectory import Trajectory

_MOST_GROWN = 8  # times that scans are matched around what those within reach lead to: each carries it on for some 20 s
_TRUTH_BEYOND_S = 60.0  # to either side of a part of a bag
_GAINS = 0.9  # of those beyond reach, that may be left for it to be worth its time
_FEWEST_MATCHES = 5  # used, without which a track is no better to match around than the one before


def configured(config_path: Path | str, changes: Mapping[str, object] = MappingProxyType({})) -> VesselConfig:
    """Read a vessel.yaml with the surveys that it names, some of its keys changed (`config.with_changes`).

    Raises:
        ConfigError: it or a survey cannot be used.
    """
    config_path = Path(config_path)
    config = with_surveys(load_config(config_path, KINDS, changes), config_path.parent)
    origin.refuse_world_without_datum(config, str(config_path), SENSORS)
    return config


def load(
    bags: Bags,
    config_path: Path | str,
    progress: Progress = quiet,
    changes: Mapping[str, object] = MappingProxyType({}),
) -> tuple[Recording, VesselConfig]:
    """Read a vessel.yaml, some of its keys changed (`config.with_changes`), and the bag, or the part of it, that it describes."""
    config = configured(config_path, changes)
    truth = truth_of_file(config_path, config)
    recording = read_recording(bags, config, progress)
    if truth is not None:
        recording = replace(recording, truth=_of_the_part(truth, recording))
    return with_sightings(recording, config, bags, progress), config


def truth_of_file(config_path: Path | str, config: VesselConfig) -> Trajectory | None:
    """Return the truth that a file holds; None if the configuration names none."""
    if not config.truth_file:
        return None
    return read_tum(Path(config_path).parent / config.truth_file, config.truth_time_offset_s)


def _of_the_part(truth: Trajectory, recording: Recording) -> Trajectory:
    """Return the truth of the part of a bag that was read, and a minute more, as its clock may be another one."""
    if recording.span is None or recording.imu is None or not len(recording.imu):
        return truth
    first_ns, last_ns = recording.imu.stamps_ns[[0, -1]] + np.array([-1, 1]) * duration_ns(_TRUTH_BEYOND_S)
    inside = (truth.stamps_ns >= first_ns) & (truth.stamps_ns <= last_ns)
    return truth.where(inside) if inside.sum() > 1 else truth


def online_smoother(
    config: VesselConfig,
    *,
    mounts: Mounts = MappingProxyType({}),
    datum: Datum | None = None,
    lag_s: float = 10.0,
    snapshot: Path | str | None = None,
) -> OnlineSmoother:
    """Return the online mode for all kinds of sensors that graphloc knows.

    Args:
        config, mounts, datum, lag_s, snapshot: as of `OnlineSmoother`. mounts: `Recording.mounts`, where they come from /tf_static.

    Raises:
        InputError: a mount is missing, or the origin of something that is given in world.
    """
    path = None if snapshot is None else Path(snapshot)
    return OnlineSmoother(
        config, rows=SENSORS, inertial=INERTIAL, mounts=mounts, datum=datum, lag_s=lag_s, snapshot=path
    )


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

    With `scans` and an aerial sensor the run is smoothed, its scans are matched around that, and it is smoothed again. Where the
    first track left more open than the search windows hold, and some matches are used all the same, scans are matched once more, around
    the second.
    """
    held: tuple[GnssPosition, ...] = ()
    if hold_out is not None:
        recording, held = hold_out.split(recording)
        held = holdout.telling(held, config)
    datum = choose_datum(recording, config)
    recording = with_synthetic(recording, config, datum)
    matched = scans is not None and bool(config.of_kind("aerial"))
    if scans is not None:  # not after the minutes of the first solution
        for sensor in config.of_kind("aerial").values():
            check_scans(scans.bags, sensor, scans.folder, config.body_frame, datum)
    solution = solve(recording, config, datum, probe=None if matched else calibrate.PROBE, progress=progress)
    pictures: tuple[tuple[str, bytes], ...] = ()
    if scans is not None and matched:
        found, solution = _matched(recording, config, datum, solution, scans, progress)
        recording, pictures = found.recording, found.pictures
    filters: tuple[ekf.FilterResult, ...] = ()
    online, never = None, ""
    if compare:
        filters = _filters(recording, config, datum, progress)
        online, never = _online(recording, config, datum, solution, progress)
    if online is not None:
        beside = ekf.FilterResult(name=online.name, trajectory=online.trajectory, ledger=online.ledger)
        filters = (beside, *filters)
    tags, said = found_tags.about_tags(recording, config, solution)
    mounts, offsets = _track_warnings(solution, recording, config)
    far_off = (offset.doubt for offset in offsets if offset.doubt)
    calibration = calibrate.calibrate(recording, config, solution)
    late = late_doubts(solution, config, calibration)
    for doubt in (*recording.clock_doubts[:1], *(d.seen for d in mounts[:1]), *far_off, *late):
        solution = solution.doubted(doubt)
    said += [*map(str, mounts), *map(str, offsets), *([never] if never else [])]
    run = Run(
        recording=replace(recording, warnings=(*recording.warnings, *said)), config=config, solution=solution,
        held=_when_measured(held, solution),
        filters=filters, online=online, pictures=pictures, tags=tags,
        calibration=calibration,
    )  # fmt: skip
    return made_comparable(_with_underlay(run, scans))


def _matched(
    recording: Recording, config: VesselConfig, datum: Datum, alone: Solution, scans: Scans, progress: Progress
) -> tuple[Matches, Solution]:
    """Match scans around a solution without matches, and solve with them; once more where that leaves much open, if some are used.

    Scans that are matched together with others are once more matched in any case, alone at first: others are placed by the track, and so
    they inherit the bends of one without matches.
    """
    single = _matched_alone(config)
    first = with_matches(recording, single, datum, alone, scans, progress)
    found = _grown(first, recording, single, datum, scans, progress)
    solution = solve(found.recording, config, datum, probe=calibrate.PROBE, progress=progress)
    if single is not config or (found.cut_off and _matches_used(solution, config) >= _FEWEST_MATCHES):
        found = with_matches(recording, config, datum, solution, scans, progress)
        solution = solve(found.recording, config, datum, probe=calibrate.PROBE, progress=progress)
    warnings = (*found.recording.warnings, *first.turned, *first.late)
    doubts = (*found.recording.clock_doubts, *first.late)
    return found._replace(recording=replace(found.recording, warnings=warnings, clock_doubts=doubts)), solution


def _grown(
    found: Matches, recording: Recording, config: VesselConfig, datum: Datum, scans: Scans, progress: Progress
) -> Matches:
    """Return matches around a track that has grown from those within reach, while more come into reach.

    Where a solution leaves more open than windows hold (GNSS is gone), the right place may lie outside, and among fingers and boats another
    one looks like it. So it is solved with the matches within reach, scans are matched around that, and so on.
    """
    for _ in range(_MOST_GROWN if found.cut_off else 0):
        if not found.beyond:
            break
        solution = solve(found.within_reach, config, datum, progress=progress)
        if _matches_used(solution, config) < _FEWEST_MATCHES:
            break
        again = with_matches(recording, config, datum, solution, scans, progress)
        if len(again.beyond) > _GAINS * len(found.beyond):
            break
        found = again
    return found


def _matches_used(solution: Solution, config: VesselConfig) -> int:
    return sum(map(solution.ledger.used, config.of_kind("aerial")))


def _matched_alone(config: VesselConfig) -> VesselConfig:
    """Return a configuration in which no scan is matched together with others; the same one if none is."""
    together = {name: sensor for name, sensor in config.of_kind("aerial").items() if sensor.around_s > 0.0}
    alone = {name: sensor.model_copy(update={"submap_s": 0.0}) for name, sensor in together.items()}
    return config.model_copy(update={"sensors": config.sensors | alone}) if alone else config


def _when_measured(held: Sequence[GnssPosition], solution: Solution) -> tuple[GnssPosition, ...]:
    """Return fixes at the stamps at which they were measured, where a run estimates how late they are stamped.

    At the stamps as they are, a track that follows late fixes would agree with them, and the right one would not.
    """
    late_ns = {name: round(offset_s * NS_PER_S) for name, offset_s in solution.time_offsets_s.items()}
    restamped = (replace(m, stamp_ns=m.stamp_ns + late_ns.get(m.sensor, 0)) for m in held)
    return tuple(sorted(restamped, key=lambda m: m.stamp_ns))


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
    his = run_digerud(recording, config)
    filters += (his,) if his is not None else ()
    progress("filters", 1, 1)
    return filters


def _track_warnings(
    solution: Solution, recording: Recording, config: VesselConfig
) -> tuple[list[MountDoubt], list[GnssOffset]]:
    """What a solved track, offline or online, tells of the configuration: of how the craft lies and goes, and of its sensors."""
    track = solution.trajectory
    offsets = gnss_offsets(track, solution.datum, recording, config, solution.antennas_off_m)
    return mount_doubts(track, recording, config), offsets


def _online(
    recording: Recording, config: VesselConfig, datum: Datum, offline: Solution, progress: Progress
) -> tuple[Solution | None, str]:
    """Return what the online mode makes of it, or why it made nothing; its events are timed as the report of both is: by the offline track."""
    begin_ns = int(offline.trajectory.stamps_ns[0])
    status = lambda at_s, whole_s, *_: progress("online", int(at_s), int(whole_s))
    try:
        return replay(recording, config, datum=datum, begin_ns=begin_ns, status=status).solution, ""
    except SolveError as error:
        return None, f"graphloc online is not compared: {error}"


def replay_recording(
    recording: Recording,
    config: VesselConfig,
    *,
    scans: Scans | None = None,
    speed: float | None = None,
    lag_s: float = 10.0,
    status: Status = silent,
) -> Run:
    """Run a recording through the online mode (see `graphloc.replay`)."""
    replayed = replay(recording, config, scans=scans, speed=speed, lag_s=lag_s, stoppable=True, status=status)
    recording, solution = replayed.recording, replayed.solution
    mounts, offsets = _track_warnings(solution, recording, config)
    if recording.clock_doubts:
        solution = solution.doubted(recording.clock_doubts[0])
    said = [*suspect_tags(recording, config, solution), *map(str, mounts), *map(str, offsets)]
    run = Run(recording=replace(recording, warnings=(*recording.warnings, *said)), config=config, solution=solution)
    return made_comparable(_with_underlay(run, scans))


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
    receivers = {name: config.receiver_of(name) for name in config.sensors}
    recording, said = without_frozen_fixes(recording, datum, receivers)
    solution = smooth(recording, config, datum, rows=SENSORS, inertial=INERTIAL, probe=probe, progress=progress)
    return replace(solution, stats=replace(solution.stats, warnings=(*solution.stats.warnings, *said)))


def seen_frames(config: VesselConfig, recording: Recording) -> VesselConfig:
    """Return the configuration whose surveys hold what was seen in the run: other frames need no states."""
    seen = {(m.sensor, m.frame) for m in recording.of(TagSighting)}
    cut = {
        name: sensor.model_copy(update={"survey": sensor.surveyed.of({f for s, f in seen if s == name})})
        for name, sensor in config.of_kind("apriltag").items()
    }
    return config.with_sensors(cut)


def match_at(
    recording: Recording, config: VesselConfig, scans: Scans, at_s: float, progress: Progress
) -> tuple[Match, int]:
    """Match the scan nearest to a time (s since the first IMU sample) around the run smoothed without matches.

    It is matched alone, as in the first pass of a run: placed by a track without matches, others would smear it where GNSS drifts or jumps.

    Returns:
        The match, and its stamp (ns).

    Raises:
        InputError: no aerial sensor is switched on, or it cannot work there.
    """
    if not config.of_kind("aerial"):
        raise InputError("no sensor of kind aerial is enabled: set `enabled: true` in its block")
    (sensor, *_) = _matched_alone(config).of_kind("aerial").values()
    datum = choose_datum(recording, config)
    check_scans(scans.bags, sensor, scans.folder, config.body_frame, datum)
    whole = with_synthetic(recording, config, datum)
    track = solve(whole, config, datum, progress=progress).trajectory
    span_s = (int(track.stamps_ns[-1]) - int(track.stamps_ns[0])) / 1e9
    if not 0.0 <= at_s <= span_s:
        raise InputError(f"{recording.source}: --at {at_s:g}: the run is from 0 to {span_s:.1f} s")
    at_ns = int(track.stamps_ns[0]) + duration_ns(at_s)
    found = match_bag(scans.bags, sensor, scans.folder, config.body_frame, track, datum, at_ns=at_ns)
    item = next(found, None)
    if item is None or item.match is None:
        raise InputError(
            f"{recording.source}: no match at {at_s:g} s: {item.why_not if item else 'no scan in the bag'}"
        )
    return item.match, item.stamp_ns


def simulated(run: SimulatedRun, *, compare: bool = False) -> Run:
    """Smooth a simulated run."""
    return smooth_recording(run.recording, run.config, compare=compare)


def choose_datum(recording: Recording, config: VesselConfig) -> Datum:
    """Return the configured datum, or the median of the first fixes (see `origin.choose_datum`)."""
    return origin.choose_datum(recording, config, SENSORS)


def with_synthetic(recording: Recording, config: VesselConfig, datum: Datum) -> Recording:
    """Add the measurements that the configuration makes itself (the height prior)."""
    return origin.with_synthetic(recording, config, datum, SENSORS)
