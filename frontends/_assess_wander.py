# SPDX-License-Identifier: Apache-2.0
"""How fast and how far the error of fixes changes: chords of fixes against those of wheels or of a velocity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.config import SlowErrorConfig
from graphloc.frames import Array
from graphloc.frontends._assess import MeasuredMotion, motion_of_places, sane
from graphloc.frontends._reports import Change
from graphloc.frontends._topic_data import TopicData
from graphloc.signals.series import interpolated, rms, robust_sigma
from graphloc.time import NS_PER_S

SPANS_S = (10.0, 20.0, 40.0, 80.0)
"""Durations of chords, s: one duration does not tell a large error that changes slowly from a small, fast one."""
_LEAST_M = 3.0  # the length of a shorter chord is mostly error
_SHORTEST_S = 110.0  # least duration of motion: some ten of the shortest chords that do not overlap
_FEWEST = 3.0  # least number of chords of a span that do not overlap
_SLIP, _DOPPLER = 0.03, 0.01  # shares of a chord that may be errors of wheels, or a turn; of a velocity
_BEYOND = 2.0  # times the default's variance: below, changes do not say that the error is another one
# Prior of slow errors: median of the correlation time; 1 sigma, as factors, of their sigma about the default or claimed
# one, and of the correlation time.
_USUAL_S, _WITHIN, _WITHIN_S = 100.0, 2.5, 3.0
_DEPENDENT = 0.5  # weight of changes over several spans of one run: they are sums of each other
_SIGMAS = np.geomspace(0.25, 32.0, 78)  # times the default sigma; one of them is 1
_DRIFTS_RADPS = np.linspace(-0.02, 0.02, 41)  # of the heading of wheels: up to the bias of a poor gyroscope
_TIMES_S = np.geomspace(5.0, 600.0, 50)


def changes(
    motion: MeasuredMotion, stamps_ns: NDArray[np.int64], p_m: Array, scatter_m: float, *, turned: bool
) -> tuple[Change, ...]:
    """Return by how much the error of fixes changes within each of `SPANS_S`; empty where that is not told.

    Chords of the fixes are compared with those of a way that drifts little in so short a time. A velocity to the east
    and north is compared as a vector. Of wheels only the lengths of chords are compared, so that no heading is needed;
    their scale is the median ratio, and a steady drift of their heading is removed. Jumps are few, and hardly count.

    Args:
        motion: has a way. stamps_ns, p_m: (N,), and (N, 3), m, east, north, up, of the fixes.
        scatter_m: white noise of a fix, 1 sigma of an axis.
        turned: whether the way has axes and a scale of its own, as that of wheels.
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
    """Return the chords (N, 2) of two ways (K, 2) over so many seconds, none across an outage.

    Chords of which the second way says that they are short are left out: their length is mostly error.
    """
    end = np.searchsorted(t_s, t_s + span_s)
    begin = np.flatnonzero(end < len(t_s))
    begin = begin[t_s[end[begin]] - t_s[begin] < 1.5 * span_s]
    fixed, chord = (way[end[begin]] - way[begin] for way in (p_m, moved_m))
    moved = np.hypot(*chord.T) > _LEAST_M
    return fixed[moved], chord[moved]


def _longer(fixed_m: Array, chord_m: Array) -> Array:
    """Return (N,) by how much chords of fixes (N, 2) exceed scaled chords of wheels (N, 2), less the median, m.

    The scale is the median ratio of their lengths.
    """
    fixed, chord = np.hypot(*fixed_m.T), np.hypot(*chord_m.T)
    off = fixed - np.median(fixed / chord) * chord
    return np.asarray(off - np.median(off))


def _steered(t_s: Array, p_m: Array, moved_m: Array) -> Array:
    """Return the way of wheels (N, 2), m, without the steady drift of its heading.

    The drift is the one without which the lengths of its chords fit those of the fixes best. A drift of 0.2 deg/s turns
    a way by 16 deg in 80 s: if the craft turned meanwhile, chords of 500 m are tens of metres off.
    """
    steps = np.diff(moved_m @ np.array([1.0, 1j]), prepend=0.0)
    some = np.s_[:: max(1, round(1.0 / max(float(np.median(np.diff(t_s))), 1e-3)))]  # one a second tells as much

    def way_m(drift_radps: float) -> Array:
        z = np.cumsum(steps * np.exp(-1j * drift_radps * (t_s - t_s[0])))
        return np.column_stack([z.real, z.imag])

    def misfit(drift_radps: float) -> float:
        own_m = way_m(drift_radps)[some]
        chords = [(span_s, *_chords(t_s[some], p_m[some], own_m, span_s)) for span_s in SPANS_S]
        # The change of a wandering error grows with the root of the span.
        return float(sum(robust_sigma(_longer(a, b)) / np.sqrt(span_s) for span_s, a, b in chords if len(a)))

    return way_m(min(_DRIFTS_RADPS, key=lambda drift: (misfit(drift), abs(drift))))


def slow_error_by(wander: Sequence[Change], sigma_m: float) -> tuple[float, float] | None:
    """Return sigma (m) and correlation time (s) of the Gauss-Markov error that explains changes.

    None where the changes are those of the default error, or less. Changes over the longest spans are few, and an error
    that lasts for longer is not seen at all. So the posterior mean, of logarithms, is taken over a grid: each pair of
    sigma and time is weighed by its likelihood and its prior. The sigma is at least the default's, since no change
    shows an error that is constant.

    Args:
        wander: by `changes`. sigma_m: usual or claimed sigma, the median of the prior.
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
    """Return the geometric mean of values, weighed by exp(-cost), cost in nats."""
    return float(np.exp(np.average(np.log(values), weights=np.exp(cost.min() - cost))))


def _variance(sigma_m: Array | float, time_s: Array | float, span_s: Array) -> Array:
    """Return the variance of the change of a Gauss-Markov process within spans: 2 sigma^2 (1 - exp(-span / time))."""
    return np.asarray(-2.0 * sigma_m**2 * np.expm1(-span_s / time_s))


def way_of(wheels: TopicData) -> MeasuredMotion | None:
    """Return the motion by the positions of an odometry; None of too few."""
    keep = sane(wheels, np.s_[:2])
    return motion_of_places(wheels.topic, wheels.stamps_ns[keep], wheels.rows[keep, :2]) if len(keep) else None
