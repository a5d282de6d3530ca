# SPDX-License-Identifier: Apache-2.0
"""A smoothed run, and what it can be compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from graphloc.build import mount_of
from graphloc.config import VesselConfig
from graphloc.eval import calibrate, ekf, metrics, report
from graphloc.eval.plots import Underlay
from graphloc.eval.truth_clock import clock_apart
from graphloc.measurements import GnssPosition
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.survey import TagConfig
from graphloc.time import stamps_of
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
        return report.all_warnings(self.recording, self.solution, self.online)


def made_comparable(run: Run) -> Run:
    """Drop what shares no time with the track, and say so; say so, too, of a truth whose clock is another one."""
    truth, speed, held, track = run.recording.truth, run.recording.check_speed, run.held, run.solution.trajectory
    said: list[str] = []
    apart = None if truth is None else clock_apart(track, truth)
    if apart is not None:
        said.append(apart.said(run.config.truth or "truth", run.config.truth_time_offset_s))

    def comparable(compare: Callable[..., object], *arguments: object) -> bool:
        try:
            compare(*arguments)
        except metrics.NoCommonTimeError as error:
            said.append(str(error))
            return False
        return True

    if truth is not None and not (apart is not None and apart.of_clock):  # else the report shows it by all of the truth
        truth = _during(run.recording, truth)
    if truth is not None and not comparable(metrics.common_stamps, track, truth):
        truth = None
    if speed is not None and not comparable(metrics.compare_speed, track, speed):
        speed = None
    if held and not comparable(metrics.held_out_errors, track, held, run.solution.datum, antennas(run).configured):
        held = ()

    def fits(filtered: ekf.FilterResult) -> bool:
        if truth is not None and not filtered.trajectory.covers(truth.stamps_ns).any():
            said.append(
                f"{filtered.name}: not compared, as it begins after the last pose of the truth or ends before the first"
            )
            return False
        return not held or comparable(
            metrics.held_out_errors, filtered.trajectory, held, run.solution.datum, antennas(run).configured
        )

    filters = tuple(f for f in run.filters if fits(f))
    online = run.online
    if online is not None and not comparable(metrics.common_stamps, online.trajectory, track):
        online = None
    recording = replace(run.recording, truth=truth, check_speed=speed, warnings=(*run.recording.warnings, *said))
    return replace(run, recording=recording, held=held, filters=filters, online=online)


def _during(recording: Recording, truth: Trajectory) -> Trajectory:
    """Return the part of a truth that is of a run, with a pose on either side, to interpolate; the whole if none is.

    A logger that ran for longer does not make the track miss a part.
    """
    assert recording.imu is not None  # it was solved
    stamps = np.concatenate([recording.imu.stamps_ns, stamps_of(recording.measurements)])
    before = int(np.searchsorted(truth.stamps_ns, stamps.min(), side="right")) - 1
    after = int(np.searchsorted(truth.stamps_ns, stamps.max(), side="left"))
    during = truth.where(slice(max(before, 0), after + 1))
    return during if len(during) > 1 else truth


def antennas(run: Run) -> metrics.Antennas:
    """Return where the antennas of the receivers are in body."""
    receivers = run.config.of_kind("gnss")
    solutions = [run.solution] if run.online is None else [run.solution, run.online]
    return metrics.Antennas(
        configured={name: mount_of(name, sensor, run.recording.mounts)[0] for name, sensor in receivers.items()},
        off_m={solution.name: solution.antennas_off_m for solution in solutions},
    )
