# SPDX-License-Identifier: Apache-2.0
"""By what factor (1 or more) a sensor's residuals scatter more than stated, over a stretch (online: `online/_scatter`).

About zero, the factor includes an error that all residuals share. Differences of residuals some seconds apart leave
that out, and second differences of three that follow each other also leave out what changes evenly: what is left is
white.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.chi2 import chi2_median
from graphloc.frames import Array
from graphloc.time import NS_PER_S

LAGS_S = (2.0, 4.0)
"""Least and most time between the residuals of a pair, s: with one fixed time, swell of that period would not show."""
GOLDEN = 0.618
"""Golden ratio: its multiples modulo 1 spread the times between pairs evenly."""
WHITE_S = 2.0
"""Longest time, s, over which three measurements show what is white in them."""
SPARE = 4
"""So many more differences than axes are needed for the median of the differences."""
_BY_CHANCE = 1.5  # times the stated sigma: scatter up to here may be by chance


def scatter_of(squares: Sequence[float] | Array, dof: int) -> float:
    """Return the factor about zero.

    Around an estimate that is 100 sigmas off, a loss with a threshold of 1.5 sigmas sees only outliers, and
    re-weighting converges slowly; and where the noise is configured too small, it rejects a good sensor (measured on
    KITTI: 97 % of the fixes lost, 23 m off). So the threshold follows the median of the residuals.

    Args:
        squares: N squares of normalised residuals. dof: degrees of freedom of each.
    """
    return max(1.0, float(np.sqrt(np.median(squares) / chi2_median(dof)))) if len(squares) else 1.0


def scatter_of_pairs(stamps_ns: NDArray[np.int64], normal: Array) -> float:
    """Return the factor by differences of normalised residuals (N, k) 2 to 4 s apart; infinite if these are too few.

    An error that the residuals share is no scatter. If it were counted, a compass that is 90 deg off for more than half
    of a window would widen its kernel to 90 deg and turn the run (measured).
    """
    lags_s = np.interp(np.arange(len(stamps_ns)) * GOLDEN % 1.0, (0.0, 1.0), LAGS_S)
    before = np.searchsorted(stamps_ns, stamps_ns - np.rint(1e9 * lags_s).astype(np.int64), side="right") - 1
    (now,) = np.nonzero((before >= 0) & (stamps_ns - stamps_ns[before] < 2e9 * LAGS_S[1]))
    if len(now) < normal.shape[1] + SPARE:
        return np.inf
    return scatter_of(0.5 * ((normal[now] - normal[before[now]]) ** 2).sum(axis=1), normal.shape[1])


def white_scatter(stamps_ns: NDArray[np.int64], normal: Array) -> float:
    """Return the factor by what is white in normalised residuals (N, k); 1 where they are too few.

    It is taken from the second differences of three that follow each other within seconds: an error of the estimate
    that grows evenly has no part in them.
    """
    (first,) = np.nonzero(stamps_ns[2:] - stamps_ns[:-2] <= WHITE_S * NS_PER_S)
    if len(first) < normal.shape[1] + SPARE:
        return 1.0
    bent = normal[first] - 2.0 * normal[first + 1] + normal[first + 2]
    return scatter_of((bent**2).sum(axis=1) / 6.0, normal.shape[1])


def noisier_than_stated(white: float) -> float:
    """Return the factor on the stated sigma of a sensor whose white scatter is `white` times what it states.

    If it were not raised, the noise of this sensor would count against the IMU, whose noise is then scaled up
    (measured: headings that claim 0.2 deg and scatter by 2: 81 times, and a heading 42 deg off).
    """
    return max(1.0, white / _BY_CHANCE)
