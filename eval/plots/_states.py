# SPDX-License-Identifier: Apache-2.0
"""Estimated states beside the track, and residuals of each sensor."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.chi2 import SIGMAS_95
from graphloc.eval.formatting import percent
from graphloc.eval.plots._map import hover
from graphloc.eval.plots._marks import COLOURS, Band, Figure, Line, Mark, Panel, Points, shown_of, thinned
from graphloc.frames import Array
from graphloc.ledger import LedgerRow
from graphloc.solution import SlowEstimate, Solution
from graphloc.time import seconds_since, stamps_of

_PANEL_PX, _BESIDE_PX = 170, 120
_SEEN_SIGMAS = 8.0  # residuals that are shown at first; a double click shows all


def _stacked(name: str, panels: Sequence[Panel]) -> Figure:
    return Figure(name=name, x="time, s", panels=tuple(panels), height=_BESIDE_PX + _PANEL_PX * len(panels))


def berths_over_time(solution: Solution) -> Figure | None:
    """Return the figure of the vessel relative to each berth (across, along, angle), 95 % bands; None: near none."""
    start, panels = int(solution.trajectory.stamps_ns[0]), []
    for track in solution.berths:
        assert track.cov is not None
        scale = np.array([1.0, 1.0, 180.0 / np.pi])
        sigma = scale * np.sqrt(np.diagonal(track.cov, axis1=1, axis2=2))
        value = scale * track.value
        for title, unit, axes in (("across and along", "m", (0, 1)), ("angle", "deg", (2,))):
            names = tuple(("across", "along", "angle")[k] for k in axes)
            marks = _banded(start, track.stamps_ns, value[:, axes], sigma[:, axes], names, first_colour=axes[0])
            panels.append(Panel(title=f"{track.berth.name}: {title}", y=unit, marks=marks, keyed=True))
    return _stacked("berths", panels) if panels else None


def _banded(
    start: int,
    stamps: NDArray[np.int64],
    value: Array,
    sigma: Array | None,
    names: Sequence[str],
    first_colour: int = 0,
) -> tuple[Mark, ...]:
    """Return a line for each column of `value` (N, k), with its 95 % band if sigma is known."""
    some, marks = thinned(len(stamps)), list[Mark]()
    t = seconds_since(start, stamps[some])
    for k, name in enumerate(names):
        colour, v = COLOURS[first_colour + k], value[some, k]
        if sigma is not None:
            wide = SIGMAS_95 * sigma[some, k]
            marks.append(Band(name=name, x=t, low=v - wide, high=v + wide, colour=colour))
        marks.append(Line(name=name, x=t, y=v, colour=colour))
    return tuple(marks)


def residuals_over_time(solution: Solution) -> Figure | None:
    """Return the residuals of each sensor in its own sigmas, coloured by weight; None if there are none."""
    by_sensor: defaultdict[str, list[LedgerRow]] = defaultdict(list)
    for row in solution.ledger:
        if row.seq >= 0 and row.nis is not None and row.dof:
            by_sensor[row.sensor].append(row)
    start, panels = int(solution.trajectory.stamps_ns[0]), []
    for sensor, rows in by_sensor.items():
        rows.sort(key=lambda r: r.stamp_ns)
        weight = np.array([1.0 if r.weight is None else r.weight for r in rows])
        some = shown_of(weight, most=1200)
        shown = [rows[k] for k in some]
        sigmas = np.array([np.sqrt((r.nis or 0.0) / (r.dof or 1)) for r in shown])
        points = Points(
            name=sensor, x=seconds_since(start, stamps_of(shown)), y=sigmas, weight=weight[some],
            text=[hover(r) for r in shown], size=4.0, listed=False,
        )  # fmt: skip
        far = float(sigmas.max()) > _SEEN_SIGMAS
        said = f"{sensor}: {percent(float(np.mean(weight < 0.5)))} down-weighted or rejected" + (
            ", some beyond" if far else ""
        )
        limit = (0.0, _SEEN_SIGMAS) if far else None
        panels.append(Panel(title=said, y="sigmas", marks=(points,), from_zero=True, range_y=limit))
    return _stacked("residuals", panels) if panels else None


def slow_over_time(solution: Solution) -> Figure:
    """Return the figure of slow errors (of fixes, poses, compass, image, ...) with 95 % bands, and of IMU biases."""
    start = int(solution.trajectory.stamps_ns[0])
    panels = [panel for sensor, estimate in solution.slow.items() for panel in _slow_panels(start, sensor, estimate)]
    stamps, axes = solution.trajectory.stamps_ns, ("x", "y", "z")
    for title, unit, value in (
        ("gyro bias", "deg/s", np.degrees(solution.gyro_bias_radps)),
        ("accelerometer bias", "m/s²", solution.accel_bias_mps2),
    ):
        panels.append(Panel(title=title, y=unit, marks=_banded(start, stamps, value, None, axes), keyed=True))
    return _stacked("slow", panels)


def _slow_panels(start: int, sensor: str, e: SlowEstimate) -> list[Panel]:
    """Return the panels of a sensor's slow error: one for each unit and at most three axes."""
    panels = []
    for unit in dict.fromkeys(e.units):
        every = [k for k, u in enumerate(e.units) if u == unit]
        for n in range(0, len(every), 3):
            some = every[n : n + 3]
            names = tuple(e.axes[k] for k in some)
            marks = _banded(start, e.stamps_ns, e.value[:, some], e.sigma[:, some], names)
            panels.append(Panel(title=f"{sensor}: {e.name}", y=unit, marks=marks, keyed=True))
    return panels
