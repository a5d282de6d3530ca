# SPDX-License-Identifier: Apache-2.0
"""How fast the error of fixes changes: by the lengths of their chords against those of wheels, or of the receiver's own velocity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends._assess import MeasuredMotion, motion_of_places, sane
from graphloc.frontends._streams import TopicData
from graphloc.series import interpolated, robust_sigma
from graphloc.time import NS_PER_S

WANDER_S = 10.0
"""Time from one end of a chord to the other, s."""
_LEAST_M = 3.0  # of a shorter chord the length is mostly error
_SHORTEST_S = 100.0  # of motion: ten chords that do not overlap
_SLIP = 0.03  # of a chord: so much may be the wheels', or a turn's


def wander_m(motion: MeasuredMotion, stamps_ns: NDArray[np.int64], p_m: Array, scatter_m: float) -> float | None:
    """Return by how much the error of fixes changes along the way in `WANDER_S`, m, 1 sigma; None where that is not told.

    Of lengths, so that no heading is needed: of the way of wheels, or of an integrated velocity, which drift little in so short a time.
    Their scale is the median's; and jumps, of which there are few, hardly count.

    Args:
        motion: with a way. stamps_ns: (N,) of the fixes. p_m: (N, 3), east, north, up. scatter_m: noise of each, 1 sigma of an axis.
    """
    if motion.way_m is None or not len(motion.t_s):
        return None
    at = motion.t_s
    t = (stamps_ns - motion.origin_ns) / NS_PER_S
    inside = (t >= at[0]) & (t <= at[-1])
    if np.count_nonzero(inside) < 2:
        return None
    t, p = t[inside], p_m[inside, :2]
    moved_m = interpolated(t, at, np.column_stack([motion.way_m.real, motion.way_m.imag]))
    end = np.searchsorted(t, t + WANDER_S)
    begin = np.flatnonzero(end < len(t))
    begin = begin[t[end[begin]] - t[begin] < 1.5 * WANDER_S]  # not across an outage
    end = end[begin]
    fixed, chord = (np.hypot(*(way[end] - way[begin]).T) for way in (p, moved_m))
    moved = chord > _LEAST_M
    if np.count_nonzero(moved) * float(np.median(np.diff(t))) < _SHORTEST_S:
        return None
    fixed, chord = fixed[moved], chord[moved]
    off = fixed - np.median(fixed / chord) * chord
    sigma = float(robust_sigma(off - np.median(off)))
    if sigma < _SLIP * float(np.median(chord)):
        return None
    return float(np.sqrt(max(sigma**2 - 2.0 * scatter_m**2, 0.0)))


def way_of(wheels: TopicData) -> MeasuredMotion | None:
    """Return the motion by the poses of an odometry itself; None of few."""
    keep = sane(wheels, np.s_[:2])
    return motion_of_places(wheels.topic, wheels.stamps_ns[keep], wheels.rows[keep, :2]) if len(keep) else None
