# SPDX-License-Identifier: Apache-2.0
"""Walk of the IMU's biases: raised where they go farther than they were known and may have walked since (offline: `solve/bias_walk.py`).

Lowered again where they have gone clearly less far for minutes: an IMU that warms up is warm some time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from scipy.special import chdtr, chdtri

from graphloc.inertial import InertialLink
from graphloc.measurements import ImuSeries
from graphloc.online._lag import Lag
from graphloc.solve.bias_walk import MOST_TIMES, WALK_KEYS, KnownBias, too_steady, went_too_far

_EVERY_S = 10.0
_RAISED_BY = 6  # of these: a minute; a bias that creeps shows after the longest
_LOWERED_BY = 90  # of these: a quarter of an hour
_CLEAR = 4.0  # variances of a bias that its walk must exceed: else how it goes is what the filter makes of noise
_TOO_LITTLE = 1e-5  # probability; lowered too far by chance it is raised again
_AT_MOST = 0.95  # confidence that the bias walks no more than what is taken then
_LEAST_LESS = 0.8  # of the walk; a smaller change is not worth a window that is built anew
# 1 sigma: from which the heading turns the biases of accelerometers with it, by more than their covariance tells.
_HEADING_RAD = 0.1


class BiasWalk:
    """Factors on the configured walk of the biases, at least 1.

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
        return sensor.scaled(dict(zip(WALK_KEYS, self.times.tolist(), strict=True)))

    def changed(self, lag: Lag, samples: Callable[[], ImuSeries]) -> str:
        """Raise the walk of accelerometers or gyroscopes where that is needed, lower it where it is no more; return a line on that, or empty."""
        newest = lag.newest
        R = newest.pose.rotation().matrix()
        if (R @ newest.pose_cov[:3, :3] @ R.T)[2, 2] > _HEADING_RAD**2:
            self.begin()
            return ""
        if self._since_ns is None:
            self._since_ns = newest.stamp_ns
        if newest.stamp_ns - (self._known[-1].stamp_ns if self._known else self._since_ns) < _EVERY_S * 1e9:
            return ""
        now = KnownBias(newest.stamp_ns, newest.bias.vector(), np.diagonal(newest.bias_cov))
        self._known = [*self._known[-_LOWERED_BY:], now]
        return self._raised(lag, samples) or self._lowered(lag, samples)

    def _raised(self, lag: Lag, samples: Callable[[], ImuSeries]) -> str:
        """Raise the walk where how far the biases have gone tells it, and return a line on that; or empty."""
        *before, now = self._known[-_RAISED_BY - 1 :]
        found = went_too_far(before, now, lag.problem.links, lasting=True)
        if found is None:
            return ""
        k, times = found
        if self.times[k] >= MOST_TIMES:
            return ""
        self.times[k] = min(self.times[k] * times, MOST_TIMES)
        name = samples().sensor
        imu = lag.problem.config.sensors[name]
        return too_steady(name, imu, self.of(imu))

    def _lowered(self, lag: Lag, samples: Callable[[], ImuSeries]) -> str:
        """Lower a raised walk to what the biases have gone at most, and return a line on that; or empty."""
        for k in np.flatnonzero(self.times > 1.0).tolist():
            share = walks_less(self._known, lag.problem.links, k)
            less = 1.0 if share is None else max(share, 1.0 / self.times[k])
            if less > _LEAST_LESS:
                continue
            self.times[k] = max(self.times[k] * less, 1.0)
            name = samples().sensor
            imu = lag.problem.config.sensors[name]
            return f"{name}: its biases change less than before: {WALK_KEYS[k]} is {getattr(imu, WALK_KEYS[k]):.3g}, {getattr(self.of(imu), WALK_KEYS[k]):.3g} is taken"
        return ""


def walks_less(known: Sequence[KnownBias], links: InertialLink, k: int) -> float | None:
    """Return what share of the walk explains, at most, how little biases have gone of late (0: of accelerometers, 1: of gyroscopes); None: none is told.

    Args:
        known: of one estimate, by stamp.
    """
    steps = sorted((step for axis in range(3 * k, 3 * k + 3) for step in _steps(known, links, axis)), reverse=True)
    squares = np.cumsum([square for _, square in steps])
    freedom = np.arange(1, len(steps) + 1)
    likely = chdtr(freedom, squares)
    if not (likely < _TOO_LITTLE).any():
        return None
    n = int(np.argmin(likely))
    return float(np.sqrt(squares[n] / chdtri(freedom[n], _AT_MOST)))


def _steps(known: Sequence[KnownBias], links: InertialLink, axis: int) -> Iterator[tuple[int, float]]:
    """Yield, from the last, by how much one bias went in steps that its walk rules: since when, and the square by what it should."""
    later = known[-1]
    for then in reversed(known[:-1]):
        walk = links.bias_steps(then.stamp_ns, later.stamp_ns)[axis] ** 2
        if walk > _CLEAR * max(then.variance[axis], later.variance[axis]):
            expected = then.variance[axis] + walk - later.variance[axis]
            yield then.stamp_ns, float((later.bias[axis] - then.bias[axis]) ** 2 / expected)
            later = then
