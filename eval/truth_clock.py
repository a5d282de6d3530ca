# SPDX-License-Identifier: Apache-2.0
"""Warn of a truth whose clock is not the track's: GPS time is 18 s ahead of UTC, and a total station has a clock of its own.

Truth and track are of one vessel, so their velocities v, u are alike at the right shift s of the truth's stamps. It is where

    D(s) = mean over the time that both know of |u(t) - v(t - s)|^2

is least. Velocities do not depend on the datum. Each shift is judged over the time in common that it leaves, so clocks that share no
time are compared as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphloc.eval.formatting import number
from graphloc.frames import Array
from graphloc.signals.series import interpolated
from graphloc.time import NS_PER_S, seconds_since
from graphloc.trajectory import Trajectory

_STEP_S = 0.2  # of the shifts that are tried; between two steps by a parabola
_LONGEST_S = 2e5  # of a track, beyond which the correlation takes too much memory
_COMMON_S, _COMMON = 30.0, 0.5  # least time in common, s; as a share of the shorter of the two
_ALIKE = 0.1  # share of the velocity's variance that may be left where the two are taken for one motion
_WORSE = 4.0  # times that D is larger as stamped than at the right shift
_WHOLE_S = 0.15  # from a whole number of seconds, by which clocks differ that tell GPS time, TAI or another zone's
_LEAST_S = 0.5  # shifts below are said by no line: so late a sensor of the track may be
_LATENCY_S = (
    5.0  # so late no sensor is: a larger shift is of a clock; and two shifts that are farther apart are different ones
)


class ClockApart(NamedTuple):
    """A truth on another clock.

    Attributes:
        add_s: what its stamps lack. left_mps: RMS difference of the velocities then.
        stamped_mps: the same as stamped; None if the two share no time then.
    """

    add_s: float
    left_mps: float
    stamped_mps: float | None

    @property
    def of_clock(self) -> bool:
        """Whether no latency of a sensor makes it."""
        return abs(self.add_s) > _LATENCY_S

    def said(self, topic: str, configured_s: float) -> str:
        """Return a line for users.

        Args:
            topic: of the truth. configured_s: its `truth_time_offset_s`.
        """
        put_s = configured_s + self.add_s
        cause = "if its clock is the wrong one (GPS time is 18 s ahead of UTC), set"
        if not self.of_clock:
            cause = (
                "a sensor of the track is stamped late (`time_offset_s` of gnss), or it is on another clock: then set"
            )
        whole = f"{put_s:.0f}" if abs(put_s - round(put_s)) < _WHOLE_S else f"{put_s:.2f}"
        stamped = "" if self.stamped_mps is None else f", {number(self.stamped_mps)} m/s as stamped"
        return (
            f"{topic}: the truth moves as the track does {abs(self.add_s):.2f} s {'earlier' if self.add_s < 0 else 'later'} (then their "
            f"velocities differ by {number(self.left_mps)} m/s RMS{stamped}), so the errors against it say little: {cause} truth_time_offset_s: {whole}"
        )


def clock_apart(track: Trajectory, truth: Trajectory) -> ClockApart | None:
    """Return how far a truth's clock is off the track's; None if it is not, or the motion does not show it."""
    seen = _velocities(track), _velocities(truth)
    if seen[0] is None or seen[1] is None:
        return None
    (u, known_u), (v, known_v) = seen[0], seen[1]
    common = np.rint(_correlated(known_u, known_v))  # number of steps, by shift
    enough = common * _STEP_S >= max(_COMMON_S, _COMMON * _STEP_S * min(known_u.sum(), known_v.sum()))
    if not enough.any():
        return None
    n = np.maximum(common, 1.0)
    mean_square = _correlated((u**2).sum(axis=1), known_v) / n
    product = sum(_correlated(u[:, k], v[:, k]) for k in range(2)) / n
    differ = np.maximum(mean_square + _correlated(known_u, (v**2).sum(axis=1)) / n - 2.0 * product, 1e-6)
    varies = mean_square - sum((_correlated(u[:, k], known_v) / n) ** 2 for k in range(2))
    best = int(np.argmin(np.where(enough, differ, np.inf)))
    add_s = (int(track.stamps_ns[0]) - int(truth.stamps_ns[0])) / NS_PER_S + (best - (len(v) - 1)) * _STEP_S
    add_s += _STEP_S * _between(differ[best - 1 : best + 2])
    stamped = best - round(add_s / _STEP_S)
    shared = 0 <= stamped < len(n) and bool(common[stamped] * _STEP_S >= 1.0)
    fits = shared and differ[stamped] < _WORSE * differ[best]
    # Of a motion that repeats itself, as rounds or a lawnmower's legs, several shifts are as good.
    others = enough & (np.abs(np.arange(len(differ)) - best) * _STEP_S > _LATENCY_S)
    if others.any() and differ[others].min() < _WORSE * differ[best]:
        return None
    if abs(add_s) < _LEAST_S or differ[best] > _ALIKE * varies[best] or fits:
        return None
    return ClockApart(add_s, float(np.sqrt(differ[best])), float(np.sqrt(differ[stamped])) if shared else None)


def _correlated(a: Array, b: Array) -> Array:
    """Return sum_k a[k + n] b[k] of two series (N,), (M,), by n from 1 - M to N - 1. That of SciPy takes over a second to import."""
    shifts = len(a) + len(b) - 1
    return np.asarray(np.fft.irfft(np.fft.rfft(a, shifts) * np.fft.rfft(b[::-1], shifts), shifts))


def _velocities(track: Trajectory) -> tuple[Array, Array] | None:
    """Return the horizontal velocity (N, 2), m/s, at even steps from the first pose on, and where it is known (N,): 1, else 0 and 0 m/s."""
    if track.v_world_mps is None or len(track) < 2:
        return None
    span_s = (int(track.stamps_ns[-1]) - int(track.stamps_ns[0])) / NS_PER_S
    if span_s > _LONGEST_S:
        return None
    t = np.arange(0.0, span_s, _STEP_S)
    known = track.covers(int(track.stamps_ns[0]) + np.rint(t * NS_PER_S).astype(np.int64)).astype(float)
    v = interpolated(t, seconds_since(int(track.stamps_ns[0]), track.stamps_ns), track.v_world_mps[:, :2])
    return v * known[:, None], known


def _between(three: Array) -> float:
    """Return where a parabola through three values, one step apart, is least: steps from the middle one, half a one at most."""
    if len(three) < 3:
        return 0.0
    bend = float(three[0] - 2.0 * three[1] + three[2])
    return float(np.clip(0.5 * (three[0] - three[2]) / bend, -0.5, 0.5)) if bend > 0.0 else 0.0
