# SPDX-License-Identifier: Apache-2.0
"""Figures of errors over time, and of the consistency of the bounds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from graphloc.chi2 import chi2_below
from graphloc.eval.ekf import FilterResult, named_tracks
from graphloc.eval.metrics import Antennas, errors, held_out_errors, squared_over_covariance
from graphloc.eval.plots._marks import (
    COLOURS,
    OUTAGE,
    TRUTH,
    Band,
    Figure,
    Line,
    Mark,
    Panel,
    Points,
    Shaded,
    colour_of,
    peaks,
    thinned,
)
from graphloc.frames import Array
from graphloc.measurements import GnssPosition
from graphloc.recording import Recording
from graphloc.solution import Health, Solution
from graphloc.time import seconds_since
from graphloc.trajectory import Trajectory, bounds_95

HEALTH = {Health.DEGRADED: COLOURS[4], Health.DEAD_RECKONING: COLOURS[1], Health.LOST: "#780000"}
# Of the second largest error: factor beyond which the largest is cut off, and factor up to which the figure then shows.
_LOST, _SHOWN = 4.0, 1.2
_OUTAGE_S, _OUTAGE_STEPS = 3.0, 5.0
_SPANS = 300  # shades in a figure, the longest ones
_SHARES = np.array([0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99])


def _named(solution: Solution, filters: Sequence[FilterResult]) -> list[tuple[str, Trajectory, str]]:
    return [(name, track, colour_of(name)) for name, track in named_tracks(solution, filters)]


def error_over_time(
    recording: Recording,
    solution: Solution,
    filters: Sequence[FilterResult],
    held: Sequence[GnssPosition],
    antennas: Antennas,
) -> Figure:
    """Return the figure of errors of position and heading over time, with 95 % bounds, outages and health.

    Errors are against truth, else at held-out fixes (position only); without these, only the bounds are shown.
    """
    start = int(solution.trajectory.stamps_ns[0])
    shades = tuple(spans(recording, solution))
    position: list[Mark] = [*shades, _bound(solution, 0, listed=True)]
    heading: list[Mark] = [*shades, _bound(solution, 2, listed=False)]
    largest_m: dict[str, float] = {}
    for who, estimate, colour in reversed(_named(solution, filters)):  # ours last, on top
        if recording.truth is not None:
            off = errors(estimate, recording.truth)
            size = off.horizontal_m
            width = 2.0 if who == solution.name else 1.3
            both = [(position, size), (heading, np.degrees(np.abs(off.heading_rad)))]
            for marks, value in both if recording.truth.headed else both[:1]:
                at = peaks(value)
                s = seconds_since(start, off.stamps_ns[at])
                marks.append(Line(name=who, x=s, y=value[at], colour=colour, width=width))
        elif held:
            fixes = held_out_errors(estimate, held, solution.datum, antennas.of(who))
            size = fixes.horizontal_m
            at = peaks(size)
            where = seconds_since(start, fixes.stamps_ns[at])
            position.append(Points(name=f"{who}, held-out", x=where, y=size[at], colour=colour))
        else:
            continue
        largest_m[who] = float(size.max())
    title, limit = _zoomed(largest_m) if largest_m else ("position, 95 % bound", None)
    panels = (
        Panel(title=title, y="m", marks=tuple(position), from_zero=True, range_y=limit),
        Panel(title="heading error" if recording.truth and recording.truth.headed else "heading, 95 % bound", y="deg", marks=tuple(heading), from_zero=True),
    )  # fmt: skip
    return Figure(name="errors", x="time, s", panels=panels, height=540)


def _bound(solution: Solution, column: int, *, listed: bool) -> Band:
    """Return the band of a 95 % bound of the solution: a `column` of `bounds_95`."""
    track = solution.trajectory
    assert track.cov is not None
    some = thinned(len(track))
    t = seconds_since(int(track.stamps_ns[0]), track.stamps_ns[some])
    high = bounds_95(track.cov[some])[:, column]
    name, colour = f"95 % bound of {solution.name}", colour_of(solution.name)
    return Band(name=name, x=t, low=np.zeros(len(t)), high=high, colour=colour, listed=listed)


def _zoomed(largest_m: Mapping[str, float]) -> tuple[str, tuple[float, float] | None]:
    """Return title and range of the position error: a lost estimate must not flatten the curves of the others."""
    *_, second, first = [0.0, 0.0, *sorted(largest_m.values())]
    if not first > _LOST * second > 0.0:
        return "position error", None
    beyond = max(largest_m, key=lambda name: largest_m[name])
    return f"position error; {beyond} is beyond, to {first:.1f} m", (0.0, _SHOWN * second)


def spans(recording: Recording, solution: Solution) -> Iterator[Shaded]:
    """Yield the periods without fixes, and those in which health was not good; if too many, the longest."""
    start, found = int(solution.trajectory.stamps_ns[0]), []
    for a, b in outages(recording):
        found.append(Shaded(name="no GNSS fix", start=(a - start) / 1e9, stop=(b - start) / 1e9, colour=OUTAGE))
    t = seconds_since(start, solution.trajectory.stamps_ns)
    for health, group in groupby(range(len(t)), key=lambda k: solution.health[k]):
        inside = list(group)
        if health in HEALTH:
            stop = float(t[min(inside[-1] + 1, len(t) - 1)])
            said = health.value.replace("_", " ")
            found.append(Shaded(name=said, start=float(t[inside[0]]), stop=stop, colour=HEALTH[health]))
    longest = sorted(found, key=lambda s: s.start - s.stop)[:_SPANS]
    yield from sorted(longest, key=lambda s: s.start)


def outages(recording: Recording) -> list[tuple[int, int]]:
    """Return begin and end (stamps, ns) of periods without a GNSS position for 3 s and five usual intervals.

    The time before the first and after the last position counts, too, as far as there are IMU data.
    """
    stamps = np.unique([m.stamp_ns for m in recording.of(GnssPosition)])
    if len(stamps) < 3:
        return []
    usual_ns = float(np.median(np.diff(stamps)))
    if recording.imu is not None:
        stamps = np.unique([*stamps, *recording.imu.stamps_ns[[0, -1]]])
    longer = np.flatnonzero(np.diff(stamps) > max(_OUTAGE_S * 1e9, _OUTAGE_STEPS * usual_ns))
    return [(int(stamps[k]), int(stamps[k + 1])) for k in longer]


def consistency(recording: Recording, solution: Solution, filters: Sequence[FilterResult]) -> Figure | None:
    """Return the figure of the NEES of the horizontal position over time, with its 95 % band; None without truth."""
    if recording.truth is None:
        return None
    start = int(solution.trajectory.stamps_ns[0])
    low, high = chi2_below(0.025, 2), chi2_below(0.975, 2)
    marks: list[Mark] = []
    ends, highest = [], 10.0
    for name, estimate, colour in reversed(_named(solution, filters)):
        found = _nees(estimate, recording.truth)
        if found is not None:
            stamps, nees = found
            at = peaks(nees)
            t = seconds_since(start, stamps[at])
            ends += [float(t[0]), float(t[-1])]
            highest = max(highest, float(nees.max()))
            marks.append(Line(name=name, x=t, y=np.maximum(nees[at], 1e-3), colour=colour, width=1.0))
    if not marks:
        return None
    x = np.array([min(ends), max(ends)])
    band = Band(
        name="95 % of an honest one", x=x, low=np.full(2, low), high=np.full(2, high), colour="#000000", listed=True
    )
    mean = Line(name="its mean, 2", x=x, y=np.full(2, 2.0), colour=TRUTH, dash="dot", width=1.0)
    panel = Panel(title="NEES, horizontal", y="", marks=(band, *marks, mean), log_y=True, range_y=(1e-2, 2.0 * highest))
    return Figure(name="nees", x="time, s", panels=(panel,), height=340)


def coverage(recording: Recording, solution: Solution, filters: Sequence[FilterResult]) -> Figure | None:
    """Return the figure of how often the p % region held the truth, for all p; if honest, on the diagonal."""
    if recording.truth is None:
        return None
    wanted = 100.0 * _SHARES
    marks: list[Mark] = [Line(name="honest", x=wanted, y=wanted, colour=TRUTH, dash="dot", width=1.0)]
    for name, estimate, colour in reversed(_named(solution, filters)):
        found = _nees(estimate, recording.truth)
        if found is not None:
            held = np.array([100.0 * float(np.mean(found[1] <= chi2_below(share, 2))) for share in _SHARES])
            marks.append(Line(name=name, x=wanted, y=held, colour=colour))
    panel = Panel(title="coverage, horizontal", y="% of the time inside", marks=tuple(marks), range_y=(0.0, 101.0))
    return Figure(name="coverage", x="stated region, %", panels=(panel,), height=380)


def _nees(estimate: Trajectory, truth: Trajectory) -> tuple[NDArray[np.int64], Array] | None:
    off = errors(estimate, truth)
    cov = off.estimate.cov
    return None if cov is None else (off.stamps_ns, squared_over_covariance(off.position_m, cov))
