# SPDX-License-Identifier: Apache-2.0
"""Figures of drills: errors against the length of an outage, for all failures, and over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphloc.eval.drill.measure import Drilled, Row, Times, summed
from graphloc.eval.drill.plan import TAIL_S, Case
from graphloc.eval.plots import Figure, Line, Mark, Panel, Points, Shaded, Shape, colour_of

_SHOWN_S = 10.0  # time before the failure that is shown of an error over time
_FEWEST_M = 0.05  # lower end of logarithmic axes
_PANEL_PX, _BESIDE_PX = 190, 100


def _range_m(most_m: float) -> tuple[float, float]:
    """Return the common range of an axis in m."""
    return 0.8 * _FEWEST_M, 1.4 * max(most_m, 1.0)


def against_length(drilled: Drilled) -> Figure | None:
    """Return the figure of largest errors against the length of an outage, a panel per kind.

    A cross means that the estimator did not recover.
    """
    rows = summed(drilled.measured)
    families = [
        f for f in dict.fromkeys(r.family for r in rows) if len({r.length_s for r in rows if r.family == f}) > 1
    ]
    if not families:
        return None
    shown = _range_m(max(r.off_m or 1.0 for r in rows))
    panels: list[Panel] = []
    for family in families:
        marks: list[Mark] = []
        for name in reversed(drilled.estimators):  # ours last, on top
            own = sorted(
                (r for r in rows if r.family == family and r.estimator == name and r.off_m is not None),
                key=lambda r: r.length_s,
            )
            length_s = np.array([r.length_s for r in own])
            marks.append(Line(name=name, x=length_s, y=_off_m(own), colour=colour_of(name)))
            marks += _points(own, name, length_s, _off_m(own), size=9.0, listed=False)
        y = "farthest off, m" if not panels else ""
        panels.append(Panel(title=family, y=y, marks=tuple(marks), log_y=True, range_y=shown))
    longest_s = max(r.length_s for r in rows if r.family in families)
    return Figure(
        name="lengths", x="length, s", panels=tuple(panels), height=380, columns=len(panels), range_x=(0.0, 1.05 * longest_s)
    )  # fmt: skip


def _off_m(rows: Sequence[Row]) -> np.ndarray:
    return np.array([max(r.off_m or 0.0, _FEWEST_M) for r in rows])


def _points(rows: Sequence[Row], name: str, x: np.ndarray, y: np.ndarray, size: float, *, listed: bool) -> list[Mark]:
    """Return a circle for each failure, or a cross where the estimator did not recover."""
    never = np.array([bool(r.lost or r.none) for r in rows], dtype=bool)
    shapes: tuple[tuple[Shape, np.ndarray], ...] = (("circle", ~never), ("x", never))
    text = [f"{r.failure}<br>{name}: {r.off_m:.2f} m" for r in rows]
    return [
        Points(
            name=name, x=x[some], y=y[some], colour=colour_of(name), shape=shape, size=size, listed=listed,
            text=[t for t, there in zip(text, some, strict=True) if there],
        )
        for shape, some in shapes
        if some.any()
    ]  # fmt: skip


def all_failures(drilled: Drilled) -> Figure:
    """Return the figure of the largest error in each failure, a mark per estimator.

    A cross means that the estimator did not recover; a hollow mark is its largest error without the failure.
    """
    rows = summed(drilled.measured)
    names = list(dict.fromkeys(r.failure for r in rows))[::-1]
    marks: list[Mark] = []
    for i, name in reversed(list(enumerate(drilled.estimators))):
        own = [r for r in rows if r.estimator == name and r.off_m is not None]
        y = np.array([names.index(r.failure) for r in own]) + 0.16 * (1.5 - i)
        usual_m = np.array([max(r.normal_m or 0.0, _FEWEST_M) for r in own])
        marks.append(
            Points(name=name, x=usual_m, y=y, colour=colour_of(name), shape="circle-open", size=7.0, listed=False)
        )
        marks += _points(own, name, _off_m(own), y, size=10.0, listed=True)
    panel = Panel(title="", y="", marks=tuple(marks), range_y=(-0.6, len(names) - 0.4), ticks_y=tuple(names))
    return Figure(
        name="failures", x="farthest off, m (hollow: undisturbed; cross: never back)", panels=(panel,),
        height=130 + 34 * len(names), log_x=True, range_x=_range_m(max(r.off_m or 1.0 for r in rows)),
    )  # fmt: skip


def over_time(drilled: Drilled) -> Figure:
    """Return the figure of the estimators' errors over time, at the first injection of each failure (shaded)."""
    first: dict[str, tuple[Case, dict[str, Times]]] = {}
    for case, times in drilled.shown:
        first.setdefault(case.failure.name, (case, times))
    shown = _range_m(max(float(np.nanmax(t.off_m, initial=1.0)) for _, times in first.values() for t in times.values()))
    panels: list[Panel] = []
    for name, (case, times) in first.items():
        marks: list[Mark] = [
            Shaded(name="failure", start=0.0, stop=case.failure.length_s, colour="#000000", opacity=0.1)
        ]
        for estimator, t in reversed(times.items()):
            at_s = (t.stamps_ns - case.begin_ns) * 1e-9
            near = (at_s >= -_SHOWN_S) & (at_s <= case.failure.length_s + TAIL_S)
            off_m = np.maximum(t.off_m[near], _FEWEST_M)
            marks.append(
                Line(
                    name=estimator,
                    x=np.asarray(at_s[near], dtype=float),
                    y=off_m,
                    colour=colour_of(estimator),
                    width=1.8,
                )
            )
        y = "m" if len(panels) % 2 == 0 else ""
        panels.append(Panel(title=name, y=y, marks=tuple(marks), log_y=True, range_y=shown))
    return Figure(
        name="time", x="s since the failure begins", panels=tuple(panels), columns=2,
        height=_BESIDE_PX + _PANEL_PX * -(-len(panels) // 2),
    )  # fmt: skip
