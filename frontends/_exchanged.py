# SPDX-License-Identifier: Apache-2.0
"""Velocities with east and north exchanged, by the motion of the fixes.

Read in the wrong `convention`, they draw the track kilometres away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from graphloc.config import VelocityConfig
from graphloc.frontends._assess import MeasuredMotion
from graphloc.frontends._readings import Readings
from graphloc.measurements import GnssVelocity
from graphloc.signals.series import interpolated
from graphloc.time import NS_PER_S, stamps_of

_HALF_S = 1.0  # half the duration of a chord
_FEWEST = 20  # least number of chords under way
_MOVES_MPS = 0.5  # least speed of a chord: below it, fixes of 0.3 m tell no direction in two seconds; a choice
_CLEARLY = 0.3  # exchanged, velocities must differ by less than this share of the difference as read


def exchanged_warnings(sensors: Sequence[Readings], motions: Mapping[str, MeasuredMotion]) -> list[str]:
    """Return a warning on each velocity that fits the motion of the fixes only with east and north exchanged.

    Args:
        sensors: what was read. motions: of the fixes of each receiver; the one with most fixes is taken.
    """
    if not motions:
        return []
    name, motion = max(motions.items(), key=lambda item: len(item[1].t_s))
    lines = []
    for r in sensors:
        own = r.of(GnssVelocity)
        if isinstance(r.config, VelocityConfig) and own and (off := _apart_mps(motion, own)) is not None:
            as_read, exchanged = off
            if exchanged < _CLEARLY * as_read:
                other = "enu" if r.config.convention == "ned" else "ned"
                lines.append(
                    f"{r.sensor}: its velocities differ from the motion of {name} by {as_read:.1f} m/s, with east and north exchanged by "
                    f"{exchanged:.1f}: set convention: {other}"
                )
    return lines


def _apart_mps(motion: MeasuredMotion, velocities: Sequence[GnssVelocity]) -> tuple[float, float] | None:
    """Return the median differences of velocities from chords of a way, m/s, as read and exchanged.

    None of a craft that hardly moves.
    """
    assert motion.way_m is not None
    t = (stamps_of(velocities) - motion.origin_ns) / NS_PER_S
    v = np.array([m.v_enu_mps[:2] for m in velocities])
    inside = (t > motion.t_s[0] + _HALF_S) & (t < motion.t_s[-1] - _HALF_S)
    t, v = t[inside], v[inside]
    way = np.column_stack([motion.way_m.real, motion.way_m.imag])
    chord = (interpolated(t + _HALF_S, motion.t_s, way) - interpolated(t - _HALF_S, motion.t_s, way)) / (2.0 * _HALF_S)
    moves = np.hypot(*chord.T) > _MOVES_MPS
    if np.count_nonzero(moves) < _FEWEST:
        return None
    as_read, exchanged = (float(np.median(np.hypot(*(a - chord)[moves].T))) for a in (v, v[:, ::-1]))
    return as_read, exchanged
