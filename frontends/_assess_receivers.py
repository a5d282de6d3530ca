# SPDX-License-Identifier: Apache-2.0
"""Several receivers on one craft: by how much they wander against each other, and whose height wanders."""

from __future__ import annotations

import math

import numpy as np

from graphloc.frames import Datum, Geodetic
from graphloc.frontends._assess import track
from graphloc.frontends._clock import MOST_LATE_S
from graphloc.frontends._reports import GnssReport
from graphloc.frontends._streams import TopicData
from graphloc.time import NS_PER_S

_FEWEST, _LAG_S = 20, 0.1
_NEVER_NEAR = 0.5  # of the RMS distance; of errors alone the 5 % point is 0.23 of it (Rayleigh)
_RAYLEIGH = (
    1.53  # sigma of an axis over that of the distance, where both errors are as large as the way between the antennas
)
_NORMAL_90 = 3.29  # sigmas from the 5 % point to the 95 % point


def apart_m(first: GnssReport, second: GnssReport, fixes: TopicData, others: TopicData) -> float | None:
    """Return by how much two receivers wander against each other, m, 1 sigma of an axis, their white noise left out; None if nothing tells.

    By the distance between them, which two antennas keep, however the craft turns; one may be stamped later than the other.

    Args:
        first, second: their reports. fixes, others: their streams.
    """
    at, _, rows = track(fixes)
    there, _, other_rows = track(others)
    if not len(at) or not len(there):
        return None
    datum = Datum(Geodetic(*rows[0, :3]))
    p, q = (datum.enu_from_geodetic(*part[:, :3].T)[:, :2] for part in (rows, other_rows))
    t, other_t = (at - at[0]) / NS_PER_S, (there - at[0]) / NS_PER_S
    inside = (t > other_t[0] + MOST_LATE_S) & (t < other_t[-1] - MOST_LATE_S)
    if inside.sum() < _FEWEST:
        return None
    t, p = t[inside], p[inside]

    def variance_m2(lag_s: float) -> float:
        beside = np.column_stack([np.interp(t + lag_s, other_t, q[:, axis]) for axis in (0, 1)])
        apart = np.hypot(*(p - beside).T)
        # Two antennas far from each other are never near each other: then only what their distance varies by is error.
        lever = float(np.percentile(apart, 5)) > _NEVER_NEAR * float(np.sqrt((apart**2).mean()))
        return float(apart.var() if lever else 0.5 * (apart**2).mean())

    variance = min(map(variance_m2, np.arange(-MOST_LATE_S, MOST_LATE_S + 0.5 * _LAG_S, _LAG_S)))
    white = sum(max(r.scatter_m[:2]) ** 2 for r in (first, second) if r.scatter_m)
    return math.sqrt(max(variance - white, 0.0))


def height_wanders_m(gnss: GnssReport) -> float | None:
    """Return how far the height wanders, 1 sigma, m, white noise left out: hills, and what the receiver drifts by; None without."""
    if gnss.scatter_m is None or gnss.without_height == gnss.fixes:
        return None
    return math.sqrt(max((gnss.height_range_m / _NORMAL_90) ** 2 - gnss.scatter_m[2] ** 2, 0.0))


def apart_warning(gnss: GnssReport) -> str:
    """Return a line on a receiver that differs from another one."""
    return (
        f"{gnss.topic} and {gnss.apart_from} wander against each other by {gnss.apart_m:.1f} m (1 sigma of an axis): one of them is worse "
        "than it says; the draft's slow_error covers it; compare runs with either one enabled"
    )
