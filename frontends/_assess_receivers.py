# SPDX-License-Identifier: Apache-2.0
"""Several receivers on one craft: by how much they wander against each other, and whose height wanders."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends._assess import track
from graphloc.frontends._clock import MOST_LATE_S
from graphloc.frontends._reports import GnssReport
from graphloc.frontends._streams import TopicData
from graphloc.signals.frozen_receiver import frozen_fixes
from graphloc.signals.series import interpolated
from graphloc.time import NS_PER_S

TWO_CRAFT_M = 50.0
"""By which two receivers wander against each other, from which they may be of two craft."""
_FEWEST, _LAG_S = 20, 0.1
_NEVER_NEAR = 0.5  # of the RMS distance; of errors alone the 5 % point is 0.23 of it (Rayleigh)
_LONGEST_M = 400.0  # of a craft
# Chords of the way that tell the course: how long, and at least how far. How steady (0 to 1) the course of a craft that turns is at most,
# and the line from one receiver to another is at least that does not turn with it.
_CHORD_S, _CHORD_M, _TURNS, _FIXED = 10.0, 10.0, 0.7, 0.95
_GAP = 3.0  # times the usual interval, from which nothing is known of the way in between
_WITHOUT = 0.1  # share of fixes without a height, from which the others tell no range
_NORMAL_90 = 3.29  # sigmas from the 5 % point to the 95 % point


class TwoAntennas(NamedTuple):
    """Of two receivers: by how much they wander against each other, m, 1 sigma of an axis; and how far apart their antennas are at least, m."""

    wander_m: float
    keeps_m: float


def apart(first: GnssReport, second: GnssReport, fixes: TopicData, others: TopicData) -> TwoAntennas | None:
    """Return by how much two receivers wander against each other, their white noise left out, and keep apart; None if nothing tells.

    By the distance between them, which two antennas keep, however the craft turns; one may be stamped later than the other. Of a
    craft that goes straight on a late stamp looks like an antenna further back: hence the least distance that such a stamp leaves.

    Args:
        first, second: their reports. fixes, others: their streams.
    """
    at, rows = _moving(fixes)
    there, other_rows = _moving(others)
    if min(len(at), len(there)) < _FEWEST:
        return None
    datum = Datum(Geodetic(*rows[0, :3]))
    p, q = (datum.enu_from_geodetic(*part[:, :3].T)[:, :2] for part in (rows, other_rows))
    t, other_t = (at - at[0]) / NS_PER_S, (there - at[0]) / NS_PER_S
    inside = _steadily(t, other_t)
    if inside.sum() < _FEWEST:
        return None
    t, p = t[inside], p[inside]

    def varies(lag_s: float) -> tuple[float, float]:
        """Return the variance, m^2, and the distance that they keep, m; 0 where they do not."""
        beside = interpolated(t + lag_s, other_t, q)
        distance = np.hypot(*(p - beside).T)
        # Two antennas far from each other are never near each other: then only what their distance varies by is error.
        near = float(np.percentile(distance, 5))
        lever = near > _NEVER_NEAR * float(np.sqrt((distance**2).mean()))
        return (float(distance.var()), near) if lever else (0.5 * float((distance**2).mean()), 0.0)

    variances, distances = zip(*map(varies, np.arange(-MOST_LATE_S, MOST_LATE_S + 0.5 * _LAG_S, _LAG_S)), strict=True)
    white = sum(max(r.scatter_m[:2]) ** 2 for r in (first, second) if r.scatter_m)
    keeps_m = min(distances)
    if keeps_m > _LONGEST_M or _by_datum(t, p, p - interpolated(t, other_t, q)):
        keeps_m = 0.0
    return TwoAntennas(math.sqrt(max(min(variances) - white, 0.0)), keeps_m)


def _by_datum(t_s: Array, p_m: Array, apart_m: Array) -> bool:
    """Return whether the line (N, 2) from another receiver to p (N, 2) stays as it is while the craft turns: a datum, or a base ashore."""
    then = np.searchsorted(t_s, t_s + _CHORD_S)
    now = np.flatnonzero(then < len(t_s))
    chord = (p_m[then[now]] - p_m[now]) @ np.array([1.0, 1j])
    chord = chord[np.abs(chord) > _CHORD_M]
    # There and back is one direction, as of a ferry with two bows.
    turns = abs((chord**2 / np.abs(chord)).sum()) < _TURNS * np.abs(chord).sum()
    return bool(turns and np.hypot(*apart_m.mean(axis=0)) > _FIXED * np.hypot(*apart_m.T).mean())


def _moving(fixes: TopicData) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (N,) and rows of the good fixes, without those of a frozen receiver: they would count the vessel's way as wander."""
    stamps_ns, p_m, rows = track(fixes)
    good = ~frozen_fixes(stamps_ns, rows[:, :2], p_m[:, :2])
    return stamps_ns[good], rows[good]


def _steadily(t: Array, other_t: Array) -> NDArray[np.bool_]:
    """Return at which times t (N,), late or early by `MOST_LATE_S` at most, a receiver has fixes at other_t (K,) without a gap, s."""
    steps = np.diff(other_t)
    gaps_before = np.concatenate([[0], np.cumsum(steps > _GAP * float(np.median(steps)))])  # each fix
    last = len(other_t) - 1
    first, then = (np.searchsorted(other_t, t + late_s) for late_s in (-MOST_LATE_S, MOST_LATE_S))
    steadily = gaps_before[np.maximum(first - 1, 0)] == gaps_before[np.minimum(then, last)]
    return np.asarray(steadily & (first > 0) & (then <= last))


def height_wanders_m(gnss: GnssReport) -> float | None:
    """Return how far the height wanders, 1 sigma, m, white noise left out: hills, and what the receiver drifts by.

    None where it tells no height, or a constant, as drivers do that fill in a plane.
    """
    if gnss.scatter_m is None or gnss.without_height > _WITHOUT * gnss.fixes or gnss.height_range_m == 0.0:
        return None
    return math.sqrt(max((gnss.height_range_m / _NORMAL_90) ** 2 - gnss.scatter_m[2] ** 2, 0.0))


def apart_warning(gnss: GnssReport) -> str:
    """Return a line on a receiver that differs from another one."""
    said = "one of them is worse than it says; the draft's slow_error covers it; compare runs with either one enabled"
    if gnss.apart_m >= TWO_CRAFT_M:
        said = "they may be of two craft, or one of a base station: see that the one that is enabled is this vessel's"
    return f"{gnss.topic} and {gnss.apart_from} wander against each other by {gnss.apart_m:.1f} m (1 sigma of an axis): {said}"
