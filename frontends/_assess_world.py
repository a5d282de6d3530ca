# SPDX-License-Identifier: Apache-2.0
"""Judging poses by the GNSS track: is their frame east-north-up, and where is its origin?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends._assess import sane, vec
from graphloc.frontends._reports import Vec
from graphloc.frontends._streams import Stream
from graphloc.time import NS_PER_S

_EXTENT_M = 20.0  # a shorter way does not tell directions
_TURNED_DEG = 3.0
_APART_M, _APART = 5.0, 0.02  # largest distance that still fits: metres, share of the extent


def origin_of(poses: Stream, stamps_ns: NDArray[np.int64], p_m: Array, first_fix: Vec | None) -> tuple[Vec | None, str]:
    """Return latitude, longitude, height of the origin of the poses' frame, and the evidence in words.

    None where the frame is not east-north-up, or nothing tells.

    Args:
        poses: odometry or poses. stamps_ns: (N,) of the fixes. p_m: (N, 3) m about `first_fix`, ENU.
    """
    keep = sane(poses)
    keep = keep[np.isfinite(poses.rows[keep, :3]).all(axis=1)] if len(keep) else keep
    if first_fix is None or len(keep) < 10 or len(stamps_ns) < 10:
        return None, "no GNSS track to place its frame by"
    at, q = poses.stamps_ns[keep], poses.rows[keep, :3]
    inside = (stamps_ns >= at[0]) & (stamps_ns <= at[-1])
    t, there = (at - at[0]) / NS_PER_S, (stamps_ns[inside] - at[0]) / NS_PER_S
    p, q = p_m[inside], np.column_stack([np.interp(there, t, q[:, k]) for k in range(3)])
    extent = float(np.hypot(*np.ptp(p[:, :2], axis=0))) if len(p) else 0.0
    if len(p) < 10 or extent < _EXTENT_M:
        return None, f"the GNSS track is too short ({extent:.0f} m) to place its frame by"
    # As complex numbers about their means, p = exp(i turned) q where the frames differ by a turn.
    a, b = (v[:, 0] - v[:, 0].mean() + 1j * (v[:, 1] - v[:, 1].mean()) for v in (q, p))
    turned = float(np.degrees(np.angle(np.vdot(a, b))))
    offset = np.median(p - q, axis=0)
    apart = float(np.median(np.hypot(*(p - q - offset)[:, :2].T)))
    if abs(turned) > _TURNED_DEG or apart > max(_APART_M, _APART * extent):
        return None, f"its frame is not east-north-up: turned by {turned:+.0f} deg, {apart:.1f} m apart from the fixes"
    place = Datum(Geodetic(*first_fix)).geodetic_from_enu(offset[None, :])[0]
    return vec(place), f"fits the fixes to {apart:.1f} m; the antenna's place on the craft is still in it"
