# SPDX-License-Identifier: Apache-2.0
"""Content of a figure, independent of its rendering: `interactive` draws it for the report, `paper` as PNG and SVG.

Colours are those of Okabe and Ito, which colour-blind people can distinguish.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array

COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#E69F00", "#56B4E9")
TRUTH, OUTAGE = "#000000", "#777777"
_TRACKS = dict(zip(("graphloc", "graphloc online", "BL EKF", "honest EKF", "Digerud KF"), COLOURS, strict=False))
MOST = 2000  # most points of a trace: more cannot be seen and make the page heavy

Dash = Literal["solid", "dash", "dot"]
Shape = Literal["circle", "circle-open", "diamond", "square", "x"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Named:
    """Base of marks that are drawn over x (N,); `listed`: whether the legend names the mark."""

    name: str
    x: Array
    colour: str
    listed: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line(_Named):
    """A line through x, y (N,); NaN in y interrupts it."""

    y: Array
    dash: Dash = "solid"
    width: float = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points(_Named):
    """Points x, y (N,) in one colour, or coloured by `weight` (N,) in [0, 1]; `text` (N,) are tooltips."""

    y: Array
    colour: str = TRUTH
    weight: Array | None = None
    text: Sequence[str] = ()
    shape: Shape = "circle"
    size: float = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Band(_Named):
    """The area between `low` and `high` (N,) over x (N,)."""

    low: Array
    high: Array
    opacity: float = 0.18
    listed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Shaded:
    """A stretch of x shaded over the whole height, behind everything."""

    name: str
    start: float
    stop: float
    colour: str
    opacity: float = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Underlay:
    """A picture under a map, north up.

    Attributes:
        jpeg: the picture. west_m, south_m, east_m, north_m: its edges in world.
    """

    jpeg: bytes
    west_m: float
    south_m: float
    east_m: float
    north_m: float


Mark = Line | Points | Band | Shaded


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """One pair of axes.

    Attributes:
        title: above the panel; may be empty. y: label of the y axis. marks: drawn in this order.
        range_y: initial range of the y axis; None: all.
        from_zero: whether the y axis begins at zero. log_y: whether it is logarithmic.
        keyed: whether the lines are named in the title instead of the figure's legend.
        ticks_y: names of 0, 1, 2, ... on the y axis, instead of numbers.
    """

    title: str
    y: str
    marks: tuple[Mark, ...]
    range_y: tuple[float, float] | None = None
    from_zero: bool = False
    log_y: bool = False
    keyed: bool = False
    ticks_y: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Figure:
    """Panels below each other with a common x axis, or in several columns with an x axis each.

    Attributes:
        name: of its files, and in the page. x: label of the x axis. panels: row by row. height: of the figure, px.
        columns: number of panels in a row. log_x: whether the x axes are logarithmic.
        range_x: initial range of the x axes; None: all.
        is_map: whether x and y have the same scale. underlay: picture below the map; None: there is none.
    """

    name: str
    x: str
    panels: tuple[Panel, ...]
    height: int
    columns: int = 1
    log_x: bool = False
    range_x: tuple[float, float] | None = None
    is_map: bool = False
    underlay: Underlay | None = None


def colour_of(name: str) -> str:
    """Return the colour of an estimator's track, the same in every figure."""
    return _TRACKS.get(name, COLOURS[-1])


def thinned(n: int, most: int = MOST) -> NDArray[np.int64]:
    """Return the indices of at most `most` of n items, evenly spaced, with the first and the last."""
    if n <= most:
        return np.arange(n)
    return np.unique(np.linspace(0, n - 1, most).round().astype(np.int64))


def peaks(values: Array, most: int = MOST) -> NDArray[np.int64]:
    """Return the indices of at most `most` of n values, in order: the largest of each section, so that peaks stay."""
    n = len(values)
    if n <= most:
        return np.arange(n)
    edges = np.linspace(0, n, most + 1).round().astype(np.int64)
    largest = np.repeat(np.maximum.reduceat(values, edges[:-1]), np.diff(edges))
    at = np.flatnonzero((values == largest) | np.isnan(values))
    return at[np.searchsorted(at, edges[:-1])]


def shown_of(weight: Array, most: int = MOST) -> NDArray[np.int64]:
    """Return the indices of at most `most` measurements; at least half have a weight below 0.5, if so many do."""
    odd, even = np.flatnonzero(weight < 0.5), np.flatnonzero(weight >= 0.5)
    of_odd = min(len(odd), max(most // 2, most - len(even)))
    return np.sort(np.concatenate([odd[thinned(len(odd), of_odd)], even[thinned(len(even), most - of_odd)]]))
