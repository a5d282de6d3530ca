# SPDX-License-Identifier: Apache-2.0
"""How fast the error of fixes changes, and how far: by their chords against those of wheels, or of the receiver's own velocity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.config import SlowErrorConfig
from graphloc.frames import Array
from graphloc.frontends._assess import MeasuredMotion, motion_of_places, sane
from graphloc.frontends._reports import Change
from graphloc.frontends._streams import TopicData
from graphloc.signals.series import interpolated, rms, robust_sigma
from graphloc.time import NS_PER_S

SPANS_S = (10.0, 20.0, 40.0, 80.0)
"""Times from one end of a chord to the other, s: one span does not tell a large error that changes slowly from a small, fast one."""
_LEAST_M = 3.0  # of a shorter chord the length is mostly error
_SHORTEST_S = 110.0  # of motion: some ten of the shortest chords that do not overlap
_FEWEST = 3.0  # chords of a span that do not overlap
_SLIP, _DOPPLER = 0.03, 0.01  # of a chord: so much may be the wheels', or a turn's; or the velocity's
_BEYOND = 2.0  # times the variance by default, from which the changes say that it is another error
# What slow errors are before a run shows any: their sigma is as by default, or claimed, within a factor; they change within minutes.
_USUAL_S, _WITHIN, _WITHIN_S = 100.0, 2.5, 3.0
_DEPENDENT = 0.5  # share of the weight that changes over several spans of one run have, as they are made of each other
_SIGMAS = np.geomspace(0.25, 32.0, 78)  # times the sigma by default; one is 1
_DRIFTS_RADPS = np.linspace(-0.02, 0.02, 41)  # of the heading of wheels; a gyroscope's bias at most
_TIMES_S = np.geomspace(5.0, 600.0, 50)


def changes(
    motion: MeasuredMotion, stamps_ns: NDArray[np.int64], p_m: Array, scatter_m: float, *, turned: bool
) -> tuple[Change, ...]:
    """Return by how much the error of fixes changes along the way within each of `SPANS_S`; none where that is not told.

    By a velocity to the east and north: of chords. By wheels: of their lengths, so that no heading is needed; the scale is the median's,
    and their heading may drift steadily. Ways of wheels, or of an integrated velocity, drift little in so short times; and jumps, of which there are few, hardly count.

    Args:
        motion: with a way. stamps_ns: (N,) of the fixes. p_m: (N, 3), east, north, up. scatter_m: noise of each, 1 sigma of an axis.
        turned: whether the way has axes of its own, and a scale: that of wheels.
    """
    if motion.way_m is None or not len(motion.t_s):
        return ()
    at = motion.t_s
    t = (stamps_ns - motion.origin_ns) / NS_PER_S
    inside = (t >= at[0]) & (t <= at[-1])
    if np.count_nonzero(inside) < 2:
        return ()
    t, p = t[inside], p_m[inside, :2]
    moved_m = interpolated(t, at, np.column_stack([motion.way_m.real, motion.way_m.imag]))
    period_s = float(np.median(np.diff(t)))
    if turned:
        moved_m = _steered(t, p, moved_m)
    found, told = [], False
    for span_s in SPANS_S:
        fixed, chord = _chords(t, p, moved_m, span_s)
        moves_s = len(chord) * period_s
        if moves_s + span_s < max(_SHORTEST_S, _FEWEST * span_s):
            continue
        sigma = rms(robust_sigma(_longer(fixed, chord) if turned else fixed - chord))
        told |= sigma >= (_SLIP if turned else _DOPPLER) * float(np.median(np.hypot(*chord.T)))
        seen = (1 if turned else 2) * (moves_s + span_s) / span_s
        found.append(Change(span_s, float(np.sqrt(max(sigma**2 - 2.0 * scatter_m**2, 0.0))), seen))
    return tuple(found) if told else ()


def _chords(t_s: Array, p_m: Array, moved_m: Array, span_s: float) -> tuple[Array, Array]:
    """Return the chords (N, 2) of two ways (K, 2) over so many seconds, not across an outage, of which the latter are no mere error."""
    end = np.searchsorted(t_s, t_s + span_s)
    begin = np.flatnonzero(end < len(t_s))
    begin = begin[t_s[end[begin]] - t_s[begin] < 1.5 * span_s]
    fixed, chord = (way[end[begin]] - way[begin] for way in (p_m, moved_m))
    moved = np.hypot(*chord.T) > _LEAST_M
    return fixed[moved], chord[moved]


def _longer(fixed_m: Array, chord_m: Array) -> Array:
    """Return by how much chords of fixes (N, 2) are longer than those of wheels (N, 2), whose scale is the median's, beyond the median, m."""
    fixed, chord = np.hypot(*fixed_m.T), np.hypot(*chord_m.T)
    off = fixed - np.median(fixed / chord) * chord
    return np.asarray(off - np.median(off))


def _steered(t_s: Array, p_m: Array, moved_m: Array) -> Array:
    """Return the way of wheels (N, 2) without the steady drift of its heading: that without which its chords are most as long as the fixes'.

    A drift of 0.2 deg/s turns a way by 16 deg in 80 s: where the craft turned meanwhile, chords of 500 m are then tens of metres off.
    """
    steps = np.diff(moved_m @ np.array([1.0, 1j]), prepend=0.0)
    some = np.s_[:: max(1, round(1.0 / max(float(np.median(np.diff(t_s))), 1e-3)))]  # one a second tells as much

    def way_m(drift_radps: float) -> Array:
        z = np.cumsum(steps * np.exp(-1j * drift_radps * (t_s - t_s[0])))
        return np.column_stack([z.real, z.imag])

    def misfit(drift_radps: float) -> float:
        own_m = way_m(drift_radps)[some]
        chords = [(span_s, *_chords(t_s[some], p_m[some], own_m, span_s)) for span_s in SPANS_S]
        # A wandering error changes with the root of the span.
        return float(sum(robust_sigma(_longer(a, b)) / np.sqrt(span_s) for span_s, a, b in chords if len(a)))

    return way_m(min(_DRIFTS_RADPS, key=lambda drift: (misfit(drift), abs(drift))))


def slow_error_by(wander: Sequence[Change], sigma_m: float) -> tuple[float, float] | None:
    """Return sigma (m) and correlation time (s) of a Gauss-Markov error that changes so; None where it changes as by default, or less.

    Changes over the longest spans are few, and what lasts for longer is not seen at all: so each pair is weighed by how well it explains
    what is seen, and by how usual it is, and their mean is taken (of the logarithms). The sigma is at least that by default, as what
    does not change shows in no change.

    Args:
        wander: by `changes`. sigma_m: that is usual, or claimed.
    """
    if not wander:
        return None
    default = SlowErrorConfig()
    span, seen = (np.array([getattr(change, key) for change in wander]) for key in ("span_s", "seen"))
    variance = np.array([max(change.m, 0.1) ** 2 for change in wander])
    if (variance < _BEYOND * _variance(sigma_m, default.time_constant_s, span)).all():
        return None
    sigma, time_s = np.meshgrid(default.horizontal_sigma_m * _SIGMAS, _TIMES_S)
    expected = _variance(sigma[..., None], time_s[..., None], span)
    cost = (
        0.5 * (np.log(sigma / sigma_m) / np.log(_WITHIN)) ** 2
        + 0.5 * (np.log(time_s / _USUAL_S) / np.log(_WITHIN_S)) ** 2
    )
    cost += 0.5 * _DEPENDENT * (np.log(expected) + variance / expected) @ seen
    mean_m, mean_s = _mean(sigma, cost), _mean(time_s, cost)
    if mean_m < default.horizontal_sigma_m:
        least = np.abs(sigma - default.horizontal_sigma_m) < 1e-6
        return default.horizontal_sigma_m, _mean(time_s[least], cost[least])
    return mean_m, mean_s


def _mean(values: Array, cost: Array) -> float:
    """Return the mean of positive values, by their logarithms, each weighed by its cost (nats)."""
    return float(np.exp(np.average(np.log(values), weights=np.exp(cost.min() - cost))))


def _variance(sigma_m: Array | float, time_s: Array | float, span_s: Array) -> Array:
    """Return the variance by which a Gauss-Markov process changes within some spans."""
    return np.asarray(-2.0 * sigma_m**2 * np.expm1(-span_s / time_s))


def way_of(wheels: TopicData) -> MeasuredMotion | None:
    """Return the motion by the poses of an odometry itself; None of few."""
    keep = sane(wheels, np.s_[:2])
    return motion_of_places(wheels.topic, wheels.stamps_ns[keep], wheels.rows[keep, :2]) if len(keep) else None
