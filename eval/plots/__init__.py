# SPDX-License-Identifier: Apache-2.0
"""Figures of a run as data, and their rendering (`interactive`; `paper`, which has to be imported separately)."""

from graphloc.eval.plots._errors import HEALTH, consistency, coverage, error_over_time, outages
from graphloc.eval.plots._interactive import interactive
from graphloc.eval.plots._map import hover, run_map
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
    Shape,
    Underlay,
    colour_of,
    peaks,
    shown_of,
)
from graphloc.eval.plots._states import berths_over_time, residuals_over_time, slow_over_time

__all__ = [
    "COLOURS",
    "HEALTH",
    "OUTAGE",
    "TRUTH",
    "Band",
    "Figure",
    "Line",
    "Mark",
    "Panel",
    "Points",
    "Shaded",
    "Shape",
    "Underlay",
    "berths_over_time",
    "colour_of",
    "consistency",
    "coverage",
    "error_over_time",
    "hover",
    "interactive",
    "outages",
    "peaks",
    "residuals_over_time",
    "run_map",
    "shown_of",
    "slow_over_time",
]
