# SPDX-License-Identifier: Apache-2.0
"""Judging a velocity by the GNSS track: are its axes east and north, as the graph takes them?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends._assess import sane
from graphloc.frontends._reports import VelocityReport
from graphloc.frontends._streams import Stream
from graphloc.time import NS_PER_S

_CHORD_S = 2.0
_FITS = 0.4  # largest error of an axis convention that fits, as a share of the speed
_AXES = ("east, north, up", "north, east, down", "forward, left, up (body)")


def velocity_report(stream: Stream, stamps_ns: NDArray[np.int64], p_m: Array, tf_frame: str | None) -> VelocityReport:
    """Compare mean velocities with chords of the track.

    Args:
        stream: the twists. stamps_ns: (N,) of the track. p_m: (N, 3) the track, east, north, up.
        tf_frame: the stream's frame, where /tf_static knows it.
    """

    def report(axes: str | None, why: str) -> VelocityReport:
        return VelocityReport(topic=stream.topic, axes=axes, why=why, tf_frame=tf_frame)

    keep = sane(stream)
    keep = keep[np.isfinite(stream.rows[keep]).all(axis=1)] if len(keep) else keep
    chords, mean = _pairs(stream.stamps_ns[keep], stream.rows[keep], stamps_ns, p_m)
    speed = float(np.sqrt((chords**2).sum(axis=1).mean())) if len(chords) else 0.0
    if len(chords) < 10 or speed < 0.5:
        return report(None, "no GNSS track in motion to check it against")
    forward = chords / np.maximum(np.hypot(*chords.T), 1e-9)[:, None]
    along = np.column_stack([forward[:, 0] * mean[:, 0], forward[:, 1] * mean[:, 0]])  # body x laid along the track
    errors = [float(np.sqrt(((v - chords) ** 2).sum(axis=1).mean())) for v in (mean[:, :2], mean[:, 1::-1], along)]
    best = int(np.argmin(errors))
    why = f"differs from the GNSS track by {errors[best]:.2f} m/s RMS, {errors[0]:.2f} m/s as east, north, up"
    return report(_AXES[best] if errors[best] < _FITS * speed else "unknown", why)


def _pairs(stamps_ns: NDArray[np.int64], v: Array, track_ns: NDArray[np.int64], p_m: Array) -> tuple[Array, Array]:
    """Return the track's mean velocities (M, 2) over some seconds, and the twists' (M, 3) over the same."""
    none = np.zeros((0, 2)), np.zeros((0, 3))
    if len(stamps_ns) < 10 or len(track_ns) < 3:
        return none
    t, at = (stamps_ns - stamps_ns[0]) / NS_PER_S, (track_ns - stamps_ns[0]) / NS_PER_S
    inside = (at >= t[0]) & (at <= t[-1])
    at, p_m = at[inside], p_m[inside]
    end = np.searchsorted(at, at + _CHORD_S)
    begin = np.flatnonzero(end < len(at))
    end = end[begin]
    begin, end = (index[at[end] - at[begin] < 2.0 * _CHORD_S] for index in (begin, end))
    if not len(begin):
        return none
    travelled = np.vstack([np.zeros(3), np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t)[:, None], axis=0)])
    there = np.column_stack([np.interp(at, t, travelled[:, k]) for k in range(3)])
    span = (at[end] - at[begin])[:, None]
    return (p_m[end, :2] - p_m[begin, :2]) / span, (there[end] - there[begin]) / span
