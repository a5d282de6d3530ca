# SPDX-License-Identifier: Apache-2.0
"""Figures for papers, drawn by matplotlib as PNG and SVG. Import it only if needed: it takes a second to load."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure as Sheet
from matplotlib.patches import Patch

from graphloc.eval.plots._marks import Band, Figure, Line, Panel, Points, Shaded, Underlay

_WIDTH_IN, _PX_PER_IN, _DPI = 7.0, 110.0, 200
_DASHES = {"solid": "-", "dash": "--", "dot": ":"}
_SHAPES = {"circle": "o", "circle-open": "o", "diamond": "D", "square": "s", "x": "x"}
_STYLE: Any = {
    "font.size": 9, "axes.grid": True, "grid.color": "#e5e5e5", "axes.axisbelow": True, "legend.frameon": False,
    "svg.fonttype": "none", "svg.hashsalt": "graphloc",
}  # fmt: skip


def write_figures(figures: Sequence[Figure], folder: Path) -> None:
    """Write each figure as `<name>.png` and `<name>.svg` into an existing folder."""
    for figure in figures:
        with matplotlib.rc_context(_STYLE):
            sheet = drawn(figure)
            sheet.savefig(folder / f"{figure.name}.png", dpi=_DPI)
            sheet.savefig(folder / f"{figure.name}.svg", metadata={"Date": None})


def drawn(figure: Figure) -> Sheet:
    """Return the figure of matplotlib, without opening a window or changing global settings."""
    height_in = _map_height_in(figure.underlay) if figure.is_map else figure.height / _PX_PER_IN
    sheet = Sheet(figsize=(_WIDTH_IN, height_in), layout="constrained")
    FigureCanvasAgg(sheet)
    n, columns = len(figure.panels), figure.columns
    every = sheet.subplots(-(-n // columns), columns, sharex=columns == 1, squeeze=False).ravel()
    for unused in every[n:]:
        unused.remove()
    every = every[:n]
    for number, (axes, panel) in enumerate(zip(every, figure.panels, strict=True)):
        _panel(axes, panel)
        if figure.log_x:
            axes.set_xscale("log")
        if figure.range_x is not None:
            axes.set_xlim(*figure.range_x)
        if number >= n - columns:
            axes.set_xlabel(figure.x)
    if figure.is_map:
        every[0].set_aspect("equal", adjustable="datalim" if figure.underlay is None else "box")
        _under(every[0], figure.underlay)
        if any(isinstance(m, Points) and m.weight is not None for m in figure.panels[0].marks):
            sheet.colorbar(ScalarMappable(Normalize(0, 1), "cividis"), ax=every[0], label="weight", shrink=0.6)
    named: dict[str, Any] = {}
    for axes, panel in zip(every, figure.panels, strict=True):
        if panel.keyed:
            axes.legend(loc="upper right", ncols=3, fontsize=7)
        else:
            named |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    for columns in range(min(len(named), 4), 0, -1):
        legend = sheet.legend(list(named.values()), list(named), loc="outside upper left", ncols=columns)
        if legend.get_window_extent().width <= sheet.bbox.width or columns == 1:
            break
        legend.remove()  # the names of held-out fixes are long
    return sheet


def _map_height_in(picture: Underlay | None) -> float:
    if picture is None:
        return 0.8 * _WIDTH_IN
    return 0.9 + 0.8 * _WIDTH_IN * (picture.north_m - picture.south_m) / (picture.east_m - picture.west_m)


def _panel(axes: Axes, panel: Panel) -> None:
    axes.set_title(panel.title, loc="left", fontsize=9)
    axes.set_ylabel(panel.y)
    if panel.ticks_y:
        axes.set_yticks(range(len(panel.ticks_y)), panel.ticks_y)
    spans: dict[str, Patch] = {}
    for mark in panel.marks:
        if isinstance(mark, Shaded):
            patch = axes.axvspan(mark.start, mark.stop, color=mark.colour, alpha=mark.opacity, lw=0, zorder=0)
            if mark.name not in spans:
                spans[mark.name] = patch
                patch.set_label(mark.name)
            continue
        label = mark.name if mark.listed else "_unlisted"
        if isinstance(mark, Line):
            axes.plot(mark.x, mark.y, color=mark.colour, ls=_DASHES[mark.dash], lw=0.6 * mark.width, label=label)
        elif isinstance(mark, Band):
            axes.fill_between(mark.x, mark.low, mark.high, color=mark.colour, alpha=mark.opacity, lw=0, label=label)
        else:
            _points(axes, mark, label)
    if panel.log_y:
        axes.set_yscale("log")
    if panel.range_y is not None:
        axes.set_ylim(*panel.range_y)
    elif panel.from_zero:
        axes.set_ylim(bottom=0.0)


def _points(axes: Axes, mark: Points, label: str) -> None:
    shape, size = _SHAPES[mark.shape], 0.35 * mark.size**2
    if mark.weight is None:
        points = axes.scatter(
            mark.x, mark.y, s=size, c=mark.colour, marker=shape, label=label, rasterized=len(mark.x) > 500
        )
        if mark.shape == "circle-open":
            points.set_facecolor("none")
            points.set_edgecolor(mark.colour)
    else:
        axes.scatter(
            mark.x, mark.y, s=size, c=mark.weight, cmap="cividis", vmin=0, vmax=1, marker=shape, label=label, lw=0,
            rasterized=len(mark.x) > 500,
        )  # fmt: skip


def _under(axes: Axes, picture: Underlay | None) -> None:
    if picture is None:
        return
    pixels = cv2.imdecode(np.frombuffer(picture.jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    extent = (picture.west_m, picture.east_m, picture.south_m, picture.north_m)
    axes.grid(visible=False)
    axes.imshow(pixels[..., ::-1], extent=extent, alpha=0.9, zorder=-1)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
