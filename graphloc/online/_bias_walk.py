# SPDX-License-Identifier: Apache-2.0
"""Walk of the IMU's biases: raised where they go farther than they were known and may have walked since (offline: `solve/bias_walk.py`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from graphloc.measurements import ImuSeries
from graphloc.online._lag import Lag
from graphloc.solve.bias_walk import KEYS, MOST_TIMES, KnownBias, too_steady, went_too_far

_EVERY_S = 10.0
_KEPT = 6  # of these: a minute; a bias that creeps shows after the longest
# 1 sigma: from which the heading turns the biases of accelerometers with it, by more than their covariance tells.
_HEADING_RAD = 0.1


class BiasWalk:
    """Factors on the configured walk of the biases; they only grow.

    Attributes:
        times: (2,) of accelerometers and of gyroscopes.
    """

    def __init__(self) -> None:
        self.times = np.ones(2)
        self.begin()

    def begin(self) -> None:
        """A window has begun, or was built anew: what was known before is not by the same data, nor as they are weighed now."""
        self._known: list[KnownBias] = []
        self._since_ns: int | None = None

    def of(self, sensor: Any) -> Any:
        """Return the configuration of the IMU with its walk raised."""
        return sensor.scaled(dict(zip(KEYS, self.times.tolist(), strict=True)))

    def raised(self, lag: Lag, samples: Callable[[], ImuSeries]) -> str:
        """Raise the walk of accelerometers or gyroscopes where that is needed; return a line on that, or empty."""
        newest, known = lag.newest, self._known
        R = newest.pose.rotation().matrix()
        if (R @ newest.pose_cov[:3, :3] @ R.T)[2, 2] > _HEADING_RAD**2:
            self.begin()
            return ""
        if self._since_ns is None:
            self._since_ns = newest.stamp_ns
        if newest.stamp_ns - (known[-1].stamp_ns if known else self._since_ns) >= _EVERY_S * 1e9:
            now = KnownBias(newest.stamp_ns, newest.bias.vector(), np.diagonal(newest.bias_cov))
            self._known = [*known[-_KEPT:], now]
            return self._told(lag, now, samples) if known else ""
        return ""

    def _told(self, lag: Lag, now: KnownBias, samples: Callable[[], ImuSeries]) -> str:
        """Raise the walk where how far the biases have gone since tells it, and return a line on that; or empty."""
        found = went_too_far(self._known[:-1], now, lag.problem.links, lasting=True)
        if found is None:
            return ""
        k, times = found
        if self.times[k] >= MOST_TIMES:
            return ""
        self.times[k] = min(self.times[k] * times, MOST_TIMES)
        name = samples().sensor
        imu = lag.problem.config.sensors[name]
        return too_steady(name, imu, self.of(imu))
