# SPDX-License-Identifier: Apache-2.0
"""Numbers as text, and labels of the metrics."""

from __future__ import annotations

import numpy as np

LABELS = {
    "position_rmse_m": "horizontal error, RMSE, m",
    "position_p95_m": "horizontal error, 95 %, m",
    "position_max_m": "horizontal error, largest, m",
    "heading_rmse_deg": "heading error, RMSE, degrees",
    "coverage_95": "share of the time in which the 95 % region holds the truth",
    "horizontal_rmse_m": "horizontal error at held-out fixes, RMSE, m",
    "horizontal_max_m": "horizontal error at held-out fixes, largest, m",
    "outage_drift_m": "largest error in a gap, RMS over the gaps, m",
    "sighted_rmse_m": "horizontal error from the first sighting on, RMSE, m",
    "berth_p95_m": "horizontal error in the last 5 s, 95 %, m",
    "lost": "lost at the end: 1 yes, 0 no",
    "wrong_side": "on the wrong side of a tag at the end: 1 yes, 0 no",
    "dnv_met": "0.10 m at 95 % within 5 m of the tags: 1 yes, 0 no",
    "mean_mps": "forward speed minus the measured one (not fused), mean, m/s",
    "std_mps": "forward speed minus the measured one (not fused), standard deviation, m/s",
}
"""Labels of the metrics; docs/outputs.md explains them."""


def significant(value: float, digits: int = 3) -> str:
    """Return a number with `digits` significant digits, and never as a power of ten: 9231 is 9230."""
    return np.format_float_positional(float(f"{value:.{digits}g}"), trim="-")


def percent(share: float | None) -> str:
    """Return a share as a whole percentage; a dash where there is none."""
    return "-" if share is None else f"{100.0 * share:.0f} %"


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for a table; a dash where there is none."""
    return "-" if value is None or np.isnan(value) else str(value) if isinstance(value, int) else f"{value:.{digits}f}"
