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
from graphloc.frontends._topic_data import TopicData
from graphloc.signals.frozen_receiver import frozen_fixes
from graphloc.signals.series import interpolated
from graphloc.time import NS_PER_S

TWO_CRAFT_M = 50.0
"""Two receivers that wander against each other by so much, 1 sigma of an axis, may be of two craft."""
_FEWEST, _LAG_S = 20, 0.1
# Two antennas keep a distance if its 5 % point is over this share of its RMS; of errors alone it is 0.23 (Rayleigh).
_NEVER_NEAR = 0.5
_LONGEST_M = 400.0  # longest craft
# Chords of the way that tell the course: their duration, and least length. Steadiness (0 to 1, length of the mean
# direction): the largest of the course of a craft that turns, and the least of a line that does not turn with the
# craft.
_CHORD_S, _CHORD_M, _TURNS, _FIXED = 10.0, 10.0, 0.7, 0.95
_GAP = 3.0  # times the median interval: a longer one is a gap, in which the way is not known
_WITHOUT = 0.1  # share of fixes without a height from which the other heights tell no range
_NORMAL_90 = 3.29  # sigmas of a normal distribution from the 5 % point to the 95 % point


class TwoAntennas(NamedTuple):
    """Two receivers: their wander against each other, m, 1 sigma of an axis, and the least distance of antennas, m."""

    wander_m: float
    keeps_m: float


def apart(first: GnssReport, second: GnssReport, fixes: TopicData, others: TopicData) -> TwoAntennas | None:
    """Return the wander of two receivers against each other, without white noise, and the least distance they keep.

    Both are told by the distance between the receivers' positions, which two antennas keep however the craft turns. The
    stamps of one receiver may be late, so several lags are tried. On a straight course a late stamp looks like an
    antenna further back: hence the least distance over all lags.

    Args:
        first, second: reports of the two receivers. fixes, others: their streams.

    Returns:
        None if too few fixes overlap. The distance is 0 where the antennas keep none, where it is too long for a
        craft, or where the line between them does not turn with the craft.
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
        """Return the variance of an axis, m^2, and the distance that the antennas keep, m; 0 if they keep none."""
        beside = interpolated(t + lag_s, other_t, q)
        distance = np.hypot(*(p - beside).T)
        # Two antennas that are far apart never come near each other: then only the variation of the distance is error.
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
    """Return whether the vector between two receivers does not turn with the craft: datums differ, or one is ashore.

    Args:
        t_s, p_m: (N,) times and (N, 2) positions of one receiver. apart_m: (N, 2) from the other receiver to it.
    """
    then = np.searchsorted(t_s, t_s + _CHORD_S)
    now = np.flatnonzero(then < len(t_s))
    chord = (p_m[then[now]] - p_m[now]) @ np.array([1.0, 1j])
    chord = chord[np.abs(chord) > _CHORD_M]
    # Opposite courses count as one direction: a ferry with two bows does not turn.
    turns = abs((chord**2 / np.abs(chord)).sum()) < _TURNS * np.abs(chord).sum()
    return bool(turns and np.hypot(*apart_m.mean(axis=0)) > _FIXED * np.hypot(*apart_m.T).mean())


def _moving(fixes: TopicData) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (N,) and rows of the good fixes that are not frozen: of frozen ones the way would seem a wander."""
    stamps_ns, p_m, rows = track(fixes)
    good = ~frozen_fixes(stamps_ns, rows[:, :2], p_m[:, :2])
    return stamps_ns[good], rows[good]


def _steadily(t: Array, other_t: Array) -> NDArray[np.bool_]:
    """Return (N,) at which times t (N,), s, a receiver has fixes, at other_t (K,), s, without a gap near by.

    Near by is within `MOST_LATE_S` to either side.
    """
    steps = np.diff(other_t)
    gaps_before = np.concatenate([[0], np.cumsum(steps > _GAP * float(np.median(steps)))])  # (K,) gaps before each fix
    last = len(other_t) - 1
    first, then = (np.searchsorted(other_t, t + late_s) for late_s in (-MOST_LATE_S, MOST_LATE_S))
    steadily = gaps_before[np.maximum(first - 1, 0)] == gaps_before[np.minimum(then, last)]
    return np.asarray(steadily & (first > 0) & (then <= last))


def height_wanders_m(gnss: GnssReport) -> float | None:
    """Return how far the height wanders, 1 sigma, m, without white noise: by hills, and by the drift of the receiver.

    None where over a tenth of the fixes have no height, or all have the same one, as drivers fill it in.
    """
    if gnss.scatter_m is None or gnss.without_height > _WITHOUT * gnss.fixes or gnss.height_range_m == 0.0:
        return None
    return math.sqrt(max((gnss.height_range_m / _NORMAL_90) ** 2 - gnss.scatter_m[2] ** 2, 0.0))


def apart_warning(gnss: GnssReport) -> str:
    """Return a warning on a receiver that wanders against another one."""
    said = "one of them is worse than it says; the draft's slow_error covers it; compare runs with either one enabled"
    if gnss.apart_m >= TWO_CRAFT_M:
        said = "they may be of two craft, or one of a base station: see that the one that is enabled is this vessel's"
    return f"{gnss.topic} and {gnss.apart_from} wander against each other by {gnss.apart_m:.1f} m (1 sigma of an axis): {said}"
