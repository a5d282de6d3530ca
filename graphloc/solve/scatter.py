# SPDX-License-Identifier: Apache-2.0
"""By what factor a sensor's residuals scatter more than it states, at least 1: of a whole stretch at once (online: `online/_scatter.py`).

About 0, the factor includes an error that all residuals share. From one residual to another some seconds later that is left out,
and from three that follow each other also what changes evenly: what is left is white.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.chi2 import chi2_median
from graphloc.frames import Array
from graphloc.time import NS_PER_S

LAGS_S = (2.0, 4.0)
"""Time between the residuals of a pair, from least to most, s: with one fixed time, swell of that period would not show."""
GOLDEN = 0.618
"""Golden ratio: its multiples modulo 1 spread these times evenly."""
WHITE_S = 2.0
"""Within so long three measurements show what is white in them, s."""
SPARE = 4
"""So many more differences than axes are needed for their median."""
_BY_CHANCE = 1.5  # times the stated sigma: so much more may be by chance


def scatter_of(squares: Sequence[float] | Array, dof: int) -> float:
    """Return the factor about 0, from N squares of normalised residuals with so many degrees of freedom.

    Around an estimate that is 100 sigmas off, a loss with a threshold of 1.5 sigmas sees only outliers, and re-weighting converges
    slowly; and where the noise is configured too small, it rejects a good sensor (measured on KITTI: 97 % of the fixes lost,
    23 m off). So the threshold follows the median of the residuals.
    """
    return max(1.0, float(np.sqrt(np.median(squares) / chi2_median(dof)))) if len(squares) else 1.0


def scatter_of_pairs(stamps_ns: NDArray[np.int64], normal: Array) -> float:
    """Return the factor by differences of normalised residuals (N, k) 2 to 4 s apart: an error that they share is no scatter.

    If it were counted, a compass that is 90 deg off for more than half of a window would widen its kernel to 90 deg and turn the run
    (measured). Infinite where there are too few.
    """
    lags_s = np.interp(np.arange(len(stamps_ns)) * GOLDEN % 1.0, (0.0, 1.0), LAGS_S)
    before = np.searchsorted(stamps_ns, stamps_ns - np.rint(1e9 * lags_s).astype(np.int64), side="right") - 1
    (now,) = np.nonzero((before >= 0) & (stamps_ns - stamps_ns[before] < 2e9 * LAGS_S[1]))
    if len(now) < normal.shape[1] + SPARE:
        return np.inf
    return scatter_of(0.5 * ((normal[now] - normal[before[now]]) ** 2).sum(axis=1), normal.shape[1])


def white_scatter(stamps_ns: NDArray[np.int64], normal: Array) -> float:
    """Return the factor by what is white in normalised residuals (N, k), by three at a time that follow each other within seconds.

    In their second difference, an error of the estimate that grows evenly has no part. 1 where there are too few.
    """
    (first,) = np.nonzero(stamps_ns[2:] - stamps_ns[:-2] <= WHITE_S * NS_PER_S)
    if len(first) < normal.shape[1] + SPARE:
        return 1.0
    bent = normal[first] - 2.0 * normal[first + 1] + normal[first + 2]
    return scatter_of((bent**2).sum(axis=1) / 6.0, normal.shape[1])


def noisier_than_stated(white: float) -> float:
    """Return the factor on the stated sigma of a sensor whose residuals scatter `white` times as much from one to the next.

    Otherwise what is noise of this sensor counts against the IMU, whose noise is then scaled up (measured: headings that claim
    0.2 deg and scatter by 2: 81 times, and a heading 42 deg off).
    """
    return max(1.0, white / _BY_CHANCE)
