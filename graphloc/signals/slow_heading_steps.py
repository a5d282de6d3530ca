# SPDX-License-Identifier: Apache-2.0
"""Steps of a heading that take seconds: beside a crane or under a bridge a compass's error goes by 20 deg, and comes back.

Within seconds no gyroscope's bias goes and comes by degrees a second, so headings that part from a gyroscope that works are the
compass's. The gyroscope works if headings have turned as it does. Their difference must change by more than the craft turns in two of
the five seconds: less may be a delay, a scale, or a deviation that depends on the heading.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from graphloc.frames import Array
from graphloc.signals.series import runs
from graphloc.time import NS_PER_S

_OVER_S = 5.0  # time over which headings are compared
_MEDIAN_S = 2.0  # about the length of their running medians
_LATE_S = 1.0  # time by which compass and gyroscope may be apart; in the last of it what a compass shows may not have come to the gyroscope
_SIGMAS = 5.0  # of the usual change, or of that by the noise of readings, that a step is at least
_USUAL = 0.25  # quantile that tells what is usual: a step may be in most of what is remembered online
_MOST_RAD = np.radians(90.0)  # a larger one is a gyroscope's, of a wrong unit
# Least turn of a gyroscope by which it shows that it works, and by how much headings may deny a quarter of such turns.
_TURN_RAD, _DENIED = np.radians(5.0), 0.25
_SHARE = 0.1  # how far headings have gone where a step begins, and have to go where it ends
_FEWEST = 3  # intervals


def slow_steps(
    stamps_ns: NDArray[np.int64],
    off: Array,
    turned_rad: Array,
    least: Array,
    unknown: NDArray[np.bool_],
    *,
    works: bool,
) -> list[tuple[int, float, int]]:
    """Return the stamps (ns) of the first and last reading of each step, and between them how far headings go.

    Args:
        stamps_ns: (N,), increasing. off: (N,) headings less `turned_rad` (N,), the turn by the gyroscope until each. least: (N - 1,) size
            of a step from which it counts. unknown: (N - 1,) intervals of which nothing is known. works: whether the gyroscope has shown
            before that it works.
    """
    usual_s = float(np.median(np.diff(stamps_ns))) / NS_PER_S
    n, second = _intervals(_OVER_S, usual_s), max(1, round(_LATE_S / usual_s))
    if len(off) < 4 * n:  # what is usual may be a step itself
        return []
    if not (works or shows_turns(stamps_ns, off, turned_rad)):
        return []
    medians = max(_FEWEST, 2 * round(0.5 * _MEDIAN_S / usual_s) + 1)
    smooth = ndimage.median_filter(off, medians, mode="nearest")
    drift = np.median(smooth[n:] - smooth[:-n]) / n * np.arange(len(off))  # by the gyroscope's bias
    smooth, turned = smooth - drift, turned_rad + drift
    padded = np.pad(turned, second, mode="edge")
    late = np.abs(padded[2 * second :] - padded[: len(turned)])  # turn within a second before and after
    change, windows = np.abs(smooth[n:] - smooth[:-n]), np.lib.stride_tricks.sliding_window_view
    # Of a difference of two medians, by that of readings one after the other.
    noise = float(np.median(np.abs(np.diff(off)))) / special.ndtri(0.75) * np.sqrt(0.5 * np.pi / medians)
    parted = change > np.maximum(windows(least, n).max(axis=1), max(at_least(smooth, n), _SIGMAS * noise))
    parted &= change > windows(late, n + 1).max(axis=1)
    parted &= (change < _MOST_RAD) & ~windows(unknown, n).any(axis=1)
    parted[len(parted) - second :] = False
    return [_step(stamps_ns, smooth, first, last - 1 + n) for first, last in runs(parted)]


def at_least(smooth: Array, n: int) -> float:
    """Return the least size of a step beside what headings (N,) usually do within n intervals: in a swell they may swing.

    Args:
        smooth: running medians of headings less turns.
    """
    if len(smooth) <= n:
        return 0.0
    change = smooth[n:] - smooth[:-n]
    usual = np.quantile(np.abs(change - np.median(change)), _USUAL)
    return _SIGMAS * float(usual) / float(special.ndtri(0.5 + 0.5 * _USUAL))


def _step(stamps_ns: NDArray[np.int64], smooth: Array, first: int, last: int) -> tuple[int, float, int]:
    """Return the step from one reading to another, without what is level at either end."""
    way = smooth[first : last + 1]
    gone, left = np.abs(way - way[0]), np.abs(way - way[-1])
    begin = first + int(np.argmax(gone > _SHARE * gone.max()))
    end = last - int(np.argmax(left[::-1] > _SHARE * left.max()))
    return int(stamps_ns[begin]), float(way[np.argmax(gone)] - way[0]), int(stamps_ns[end])


def shows_turns(stamps_ns: NDArray[np.int64], off: Array, turned_rad: Array) -> bool:
    """Return whether a gyroscope has shown that it works: headings turn as it does, but for what a step hides.

    Args:
        stamps_ns, off, turned_rad: as of `slow_steps`.
    """
    n = _intervals(_OVER_S, float(np.median(np.diff(stamps_ns))) / NS_PER_S)
    turns, denied = turned_rad[n:] - turned_rad[:-n], off[n:] - off[:-n]
    turning = np.abs(turns) > _TURN_RAD
    return bool(turning.any() and np.quantile(np.abs(denied[turning] / turns[turning]), _USUAL) < _DENIED)


def _intervals(length_s: float, usual_s: float) -> int:
    return max(_FEWEST, round(length_s / usual_s))
