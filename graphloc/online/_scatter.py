# SPDX-License-Identifier: Apache-2.0
"""By what factor a sensor's residuals scatter more than it states, as they arrive (offline: `judge/scatter.py`)."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque

import numpy as np

from graphloc.chi2 import chi2_median
from graphloc.frames import Array
from graphloc.judge.scatter import GOLDEN, LAGS_S, SPARE, WHITE_S, noisier_than_stated
from graphloc.time import NS_PER_S

_REMEMBERED = 300  # residuals that are remembered; as many pairs and second differences of them
_FEWEST_BENT = 20  # second differences of residuals from which white noise is judged


class _Median:
    """The median of the last values, kept sorted: to sort them anew for each value took a twentieth of an update."""

    def __init__(self) -> None:
        self._came: deque[float] = deque()
        self._sorted: list[float] = []

    def __len__(self) -> int:
        return len(self._came)

    def append(self, value: float) -> None:
        """Take in a value; the oldest is forgotten where there are enough."""
        if len(self._came) == _REMEMBERED:
            del self._sorted[bisect_left(self._sorted, self._came.popleft())]
        self._came.append(value)
        insort(self._sorted, value)

    def value(self) -> float:
        middle = len(self._sorted) // 2
        return 0.5 * (self._sorted[middle] + self._sorted[-1 - middle])


class Scatter:
    """By what factor a sensor's residuals scatter more than configured: about 0, or about each other if that is less.

    An error that residuals share is no noise. With the scatter about 0 alone, a compass that was 15 deg off beside a
    crane was believed after 15 s, because half of the remembered residuals were that large. With the scatter about each
    other alone, one third of outliers would make half of all pairs wide. The two residuals of a pair are 2 to 4 s
    apart, evenly distributed: with one fixed distance, swell of that period would not show.

    Args:
        jumps: whether the shared error is estimated as a slow error that may jump. Then only the scatter about 0
            counts, because residuals share a jump until the slow error follows it.

    Attributes:
        times: the factor, at least 1. noisier: factor on the stated sigma (see `noisier_than_stated`), at most `times`.
        said: whether `noisier` has been reported.
    """

    def __init__(self, *, jumps: bool = False) -> None:
        self.times = self.noisier = 1.0
        self.said = False
        self._jumps = jumps
        self._recent: deque[tuple[int, Array]] = deque()
        self._noted = 0
        self._squares, self._pairs, self._bent = _Median(), _Median(), _Median()

    def note(self, stamp_ns: int, residual: Array) -> None:
        """Take in a residual (k,), normalised to unit covariance."""
        self._squares.append(float(residual @ residual))
        self._noted += 1
        before, lag_ns = None, float(np.interp(self._noted * GOLDEN % 1.0, (0.0, 1.0), LAGS_S)) * 1e9
        for stamp, other in self._recent:
            if stamp_ns - stamp < lag_ns:
                break
            before = other
        while len(self._recent) > 1 and stamp_ns - self._recent[1][0] >= LAGS_S[1] * 1e9:
            self._recent.popleft()
        self._recent.append((stamp_ns, residual))
        if len(self._recent) > 2 and stamp_ns - self._recent[-3][0] <= WHITE_S * NS_PER_S:
            bent = residual - 2.0 * self._recent[-2][1] + self._recent[-3][1]
            self._bent.append(float(bent @ bent) / 6.0)
        if before is not None:
            self._pairs.append(0.5 * float((residual - before) @ (residual - before)))
        if len(self._pairs) >= len(residual) + SPARE:
            about, usual = self._squares.value(), chi2_median(len(residual))
            least = about if self._jumps else min(about, self._pairs.value())
            self.times = max(1.0, float(np.sqrt(least / usual)))
            if len(self._bent) >= _FEWEST_BENT:
                white = float(np.sqrt(self._bent.value() / usual))
                self.noisier = noisier_than_stated(min(self.times, white))
