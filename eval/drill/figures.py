# SPDX-License-Identifier: Apache-2.0
"""Figures of drills: against the length of an outage, of all failures, over time."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from graphloc.eval.drill.measure import Drilled, Times, summed
from graphloc.eval.drill.plan import TAIL_S, Case
from graphloc.eval.plots import COLOURS

# As the report has them, whatever the order of the tables here.
_COLOUR = dict(zip(("graphloc", "graphloc online", "BL EKF", "honest EKF"), COLOURS, strict=False))
_SHOWN_S = 10.0  # of an error over time, before the failure
_FEWEST_M = 0.05  # lower end of logarithmic axes


def _layout(figure: go.Figure, height: int) -> go.Figure:
    figure.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 60, "r": 15, "t": 50, "b": 50},
        legend={"orientation": "h", "y": 1.0, "yref": "container", "yanchor": "top", "x": 0},
        font={"size": 13},
    )
    return figure


def _logarithmic(most: float) -> dict[str, object]:
    """An axis of m, the same wherever it is used."""
    ticks = [0.1, 1.0, 10.0, 100.0, 1000.0, 10000.0]
    span = [float(np.log10(0.8 * _FEWEST_M)), float(np.log10(1.4 * max(most, 1.0)))]
    return {"type": "log", "tickvals": ticks, "ticktext": [f"{t:g}" for t in ticks], "range": span}


def against_length(drilled: Drilled) -> go.Figure | None:
    """Farthest off against the length of an outage, a panel for each kind."""
    rows = summed(drilled.measured)
    families = [
        f for f in dict.fromkeys(r.family for r in rows) if len({r.length_s for r in rows if r.family == f}) > 1
    ]
    if not families:
        return None
    figure = make_subplots(rows=1, cols=len(families), subplot_titles=families, shared_yaxes=True)
    for name in drilled.estimators:
        for col, family in enumerate(families, start=1):
            own = sorted(
                (r for r in rows if r.family == family and r.estimator == name and r.off_m is not None),
                key=lambda r: r.length_s,
            )
            figure.add_scatter(
                x=[r.length_s for r in own],
                y=[max(r.off_m or 0.0, _FEWEST_M) for r in own],
                mode="lines+markers",
                line={"color": _COLOUR[name]},
                marker={"symbol": ["x" if r.lost or r.none else "circle" for r in own], "size": 9},
                name=name,
                legendgroup=name,
                showlegend=col == 1,
                row=1,
                col=col,
            )
    figure.update_xaxes(title="length, s", rangemode="tozero")
    figure.update_yaxes(_logarithmic(max(r.off_m or 1.0 for r in rows)))
    figure.update_yaxes(title="farthest off, m", col=1)
    return _layout(figure, 380)


def all_failures(drilled: Drilled) -> go.Figure:
    """Farthest off in each failure: a mark an estimator, a cross where it never came back; hollow: undisturbed."""
    rows = summed(drilled.measured)
    names = list(dict.fromkeys(r.failure for r in rows))[::-1]
    figure = go.Figure()
    for i, name in enumerate(drilled.estimators):
        own = {r.failure: r for r in rows if r.estimator == name and r.off_m is not None}
        shift = 0.16 * (1.5 - i)
        y = [names.index(f) + shift for f in own]
        figure.add_scatter(
            x=[max(r.normal_m or 0.0, _FEWEST_M) for r in own.values()],
            y=y,
            mode="markers",
            marker={"color": _COLOUR[name], "symbol": "circle-open", "size": 7},
            showlegend=False,
            hoverinfo="skip",
        )
        figure.add_scatter(
            x=[max(r.off_m or 0.0, _FEWEST_M) for r in own.values()],
            y=y,
            mode="markers",
            marker={
                "color": _COLOUR[name],
                "size": 10,
                "symbol": ["x" if r.lost or r.none else "circle" for r in own.values()],
            },
            text=[f"{r.failure}<br>{name}: {r.off_m:.2f} m" for r in own.values()],
            hoverinfo="text",
            name=name,
        )
    figure.update_xaxes(_logarithmic(max(r.off_m or 1.0 for r in rows)))
    figure.update_xaxes(title="farthest off, m (hollow: undisturbed; cross: never back)")
    figure.update_yaxes(tickvals=list(range(len(names))), ticktext=names, range=[-0.6, len(names) - 0.4])
    return _layout(figure, 130 + 34 * len(names))


def over_time(drilled: Drilled) -> go.Figure:
    """How far off each estimator is over time: the first time of each failure, which is shaded."""
    first: dict[str, tuple[Case, dict[str, Times]]] = {}
    for case, times in drilled.shown:
        first.setdefault(case.failure.name, (case, times))
    columns, count = 2, len(first)
    lines = -(-count // columns)
    figure = make_subplots(
        rows=lines,
        cols=columns,
        subplot_titles=list(first),
        vertical_spacing=0.32 / max(lines, 1),
        horizontal_spacing=0.07,
    )
    for n, (case, times) in enumerate(first.values()):
        place = {"row": n // columns + 1, "col": n % columns + 1}
        for name, t in times.items():
            at_s = (t.stamps_ns - case.begin_ns) * 1e-9
            near = (at_s >= -_SHOWN_S) & (at_s <= case.failure.length_s + TAIL_S)
            figure.add_scatter(
                x=np.round(at_s[near], 1),
                y=np.round(np.maximum(t.off_m[near], _FEWEST_M), 3),
                line={"color": _COLOUR[name], "width": 1.8},
                name=name,
                legendgroup=name,
                showlegend=n == 0,
                **place,
            )
        figure.add_vrect(x0=0.0, x1=case.failure.length_s, fillcolor="rgba(0,0,0,0.10)", line_width=0, **place)
    most_m = max(float(np.nanmax(t.off_m, initial=1.0)) for _, times in first.values() for t in times.values())
    figure.update_yaxes(_logarithmic(most_m))
    figure.update_yaxes(title="m", col=1)
    figure.update_xaxes(title="s since the failure begins", row=lines)
    return _layout(figure, 100 + 190 * lines)
