# SPDX-License-Identifier: Apache-2.0
"""Interactive figures in the report, drawn by plotly."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from graphloc.eval.plots._marks import Band, Figure, Line, Mark, Panel, Points, Shaded
from graphloc.frames import Array

_GAP_PX, _ABOVE_PX, _LEGEND_PX, _BELOW_PX = 42, 26, 38, 46
_TICKS_PX, _BESIDE = 22, 0.07  # room for ticks between panels; share of the width between columns
_WEIGHTS = {"colorscale": "Cividis", "cmin": 0, "cmax": 1}


def interactive(figure: Figure) -> go.Figure:
    """Return the figure for plotly; names in the legend switch lines on and off."""
    n, columns = len(figure.panels), figure.columns
    named = any(not isinstance(m, Shaded) and m.listed and not p.keyed for p in figure.panels for m in p.marks)
    above_px = _ABOVE_PX + _LEGEND_PX * named
    drawn = _empty(figure, above_px)
    listed: set[str] = set()
    shades: list[dict[str, Any]] = []
    for number, panel in enumerate(figure.panels):
        place = {"row": number // columns + 1, "col": number % columns + 1}
        for mark in panel.marks:
            if isinstance(mark, Shaded):
                shades.append(_shade(mark, number + 1))
                continue
            trace = _trace(mark)
            in_legend = mark.listed and not panel.keyed and mark.name not in listed
            trace.update(legendgroup=mark.name, showlegend=in_legend)
            listed |= {mark.name} if in_legend else set()
            drawn.add_trace(trace, **place)
        drawn.update_yaxes(**_y_axis(panel), **place)
        if number >= n - columns:  # the last of its column
            drawn.update_xaxes(title=figure.x, **place)
    if figure.log_x:
        drawn.update_xaxes(type="log", dtick=1)
    if figure.range_x is not None:
        drawn.update_xaxes(range=list(np.log10(figure.range_x)) if figure.log_x else list(figure.range_x))
    drawn.update_layout(
        template="plotly_white", shapes=shades, height=figure.height, font={"size": 12}, hoverlabel={"align": "left"},
        margin={"l": 52, "r": 12, "t": above_px, "b": _BELOW_PX},
        legend={"orientation": "h", "y": 1, "yref": "container", "yanchor": "top", "x": 0, "traceorder": "reversed"},
    )  # fmt: skip
    drawn.update_annotations(font_size=13, **({"x": 0, "xanchor": "left"} if columns == 1 else {}))
    if figure.is_map:
        _as_map(drawn, figure)
    return drawn


def _empty(figure: Figure, above_px: int) -> go.Figure:
    """Return the axes of all panels, `above_px` below the top."""
    n, columns = len(figure.panels), figure.columns
    rows = -(-n // columns)
    gap_px = _GAP_PX + (_TICKS_PX if columns > 1 else 0)  # in columns, each panel has its own x axis
    return make_subplots(
        rows=rows, cols=columns, shared_xaxes=columns == 1, subplot_titles=[_title(p) for p in figure.panels],
        vertical_spacing=min(gap_px / max(figure.height - above_px - _BELOW_PX, 1), 0.9 / rows),
        horizontal_spacing=_BESIDE if columns > 1 else None,
        specs=[[{} if row * columns + col < n else None for col in range(columns)] for row in range(rows)],
    )  # fmt: skip


def _y_axis(panel: Panel) -> dict[str, Any]:
    axis: dict[str, Any] = {"title": {"text": panel.y, "standoff": 4}}
    if panel.from_zero:
        axis["rangemode"] = "tozero"
    if panel.log_y:
        axis |= {"type": "log", "dtick": 1}
    if panel.range_y is not None:
        axis["range"] = list(np.log10(panel.range_y)) if panel.log_y else list(panel.range_y)
    if panel.ticks_y:
        axis |= {"tickvals": list(range(len(panel.ticks_y))), "ticktext": list(panel.ticks_y)}
    return axis


def _shade(span: Shaded, number: int) -> dict[str, Any]:
    """Return a rectangle over the height of a panel as plain data: to add them one by one would take seconds."""
    axis = str(number) if number > 1 else ""
    return {
        "type": "rect", "xref": f"x{axis}", "yref": f"y{axis} domain", "x0": span.start, "x1": span.stop, "y0": 0, "y1": 1,
        "fillcolor": span.colour, "opacity": span.opacity, "line": {"width": 0}, "layer": "below",
    }  # fmt: skip


def _title(panel: Panel) -> str:
    """Return the title of a panel; if the panel has its own key, with the names of its lines in their colours."""
    names = [f'<span style="color:{m.colour}">{m.name}</span>' for m in panel.marks if isinstance(m, Line)]
    return f"{panel.title} ({', '.join(names)})" if panel.keyed else panel.title


def _light(values: Array) -> NDArray[np.float32]:
    """Return values in single precision, which halves the size of the page."""
    return np.asarray(values, dtype=np.float32)


def _trace(mark: Mark) -> Any:
    assert not isinstance(mark, Shaded)
    x = _light(mark.x)
    if isinstance(mark, Line):
        line = {"color": mark.colour, "dash": mark.dash, "width": mark.width}
        return go.Scatter(x=x, y=_light(mark.y), mode="lines", line=line, name=mark.name)
    if isinstance(mark, Band):
        return go.Scatter(
            x=np.concatenate([x, x[::-1]]), y=np.concatenate([_light(mark.high), _light(mark.low)[::-1]]),
            fill="toself", mode="none", fillcolor=mark.colour, opacity=mark.opacity, hoverinfo="skip", name=mark.name,
        )  # fmt: skip
    assert isinstance(mark, Points)
    marker: dict[str, Any] = {"size": mark.size, "symbol": mark.shape, "color": mark.colour}
    if mark.weight is not None:
        marker |= {"color": np.round(mark.weight, 2).astype(np.float32), **_WEIGHTS, "opacity": 0.8}
    hover = {"text": list(mark.text), "hoverinfo": "text"} if len(mark.text) else {}
    return go.Scatter(x=x, y=_light(mark.y), mode="markers", marker=marker, name=mark.name, **hover)


def _as_map(drawn: go.Figure, figure: Figure) -> None:
    drawn.update_yaxes(scaleanchor="x", scaleratio=1, zeroline=False)
    drawn.update_xaxes(zeroline=False)
    weighed = [t for t in drawn.data if t.mode == "markers" and t.marker.cmax is not None]
    if weighed:
        weighed[0].marker.update(showscale=True, colorbar={"title": "weight", "thickness": 10, "len": 0.6, "x": 1.0})
    picture = figure.underlay
    if picture is None:
        return
    drawn.add_layout_image(
        source=f"data:image/jpeg;base64,{base64.b64encode(picture.jpeg).decode()}", xref="x", yref="y", layer="below",
        x=picture.west_m, y=picture.north_m, sizex=picture.east_m - picture.west_m,
        sizey=picture.north_m - picture.south_m, sizing="stretch", opacity=0.9,
    )  # fmt: skip
    drawn.update_xaxes(range=[picture.west_m, picture.east_m], showgrid=False, constrain="domain")
    drawn.update_yaxes(range=[picture.south_m, picture.north_m], showgrid=False, constrain="domain")
