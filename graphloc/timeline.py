# SPDX-License-Identifier: Apache-2.0
"""Where the states stand in time.

States come at about `rate_hz`; each moves onto a measurement's stamp where one is near, rarest sensor
first, so that few measurements have to be carried. Slow nodes (IMU bias, slow sensor errors) come at
`slow_period_s`; each state belongs to one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphloc.config import TimelineConfig
from graphloc.measurements import Measurement
from graphloc.time import duration_ns

_SNAP = 0.4  # share of a period by which a state moves at most, so that two neighbours never meet


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Stamps of the states and of the slow nodes.

    Attributes:
        stamps_ns: (N,) of the states. slow_of: (N,) slow node of each state. slow_stamps_ns: (M,) of the slow nodes.
    """

    stamps_ns: NDArray[np.int64]
    slow_of: NDArray[np.int64]
    slow_stamps_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def nearest(self, stamp_ns: int) -> int:
        """Return the state nearest to a stamp."""
        right = min(max(int(np.searchsorted(self.stamps_ns, stamp_ns)), 1), len(self) - 1)
        left = right - 1
        return left if stamp_ns - self.stamps_ns[left] <= self.stamps_ns[right] - stamp_ns else right

    def floor(self, stamp_ns: int) -> int:
        """Return the last state at or before a stamp; the first state, if the stamp is before all."""
        return max(int(np.searchsorted(self.stamps_ns, stamp_ns, side="right")) - 1, 0)


def make_timeline(start_ns: int, stop_ns: int, measurements: Sequence[Measurement], config: TimelineConfig) -> Timeline:
    """Lay states over [start_ns, stop_ns]."""
    period = duration_ns(1.0 / config.rate_hz)
    count = max(2, int((stop_ns - start_ns) // period) + 1)
    grid = start_ns + period * np.arange(count, dtype=np.int64)
    stamps = grid.copy()
    taken = np.zeros(count, dtype=bool)
    taken[0] = taken[-1] = True
    rates = Counter(m.sensor for m in measurements)
    for sensor in sorted(rates, key=lambda name: (rates[name], name)):
        at = np.array([m.stamp_ns for m in measurements if m.sensor == sensor], dtype=np.int64)
        node = np.rint((at - start_ns) / period).astype(np.int64)
        near = (node >= 0) & (node < count)
        at, node = at[near], node[near]
        close = np.abs(at - grid[node]) <= _SNAP * period
        for stamp, k in zip(at[close], node[close], strict=True):
            if not taken[k]:
                stamps[k], taken[k] = stamp, True
    slow_period = duration_ns(config.slow_period_s)
    slow_of = np.asarray((stamps - start_ns) // slow_period, dtype=np.int64)
    _, slow_of = np.unique(slow_of, return_inverse=True)  # no node without a state
    first = np.searchsorted(slow_of, np.arange(slow_of[-1] + 1))
    return Timeline(stamps, np.asarray(slow_of, dtype=np.int64), stamps[first])
