# SPDX-License-Identifier: Apache-2.0
"""Walk of the IMU's biases (offline: `judge/bias_walk.py`).

The walk is raised where a bias changes by more than its covariance and its configured walk allow. It is lowered again
where the biases have changed clearly less for minutes, as when an IMU has warmed up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from scipy.special import chdtr, chdtri

from graphloc.inertial import InertialLink
from graphloc.judge.bias_walk import MOST_TIMES, WALK_KEYS, KnownBias, too_steady, went_too_far
from graphloc.measurements import ImuSeries
from graphloc.online._lag import Lag

_EVERY_S = 10.0  # between two looks at the biases
_RAISED_BY = 6  # looks by which the walk is raised: a minute. A bias that creeps shows only over the whole of it
_LOWERED_BY = 90  # looks by which the walk is lowered: a quarter of an hour
_CLEAR = 4.0  # variances of a bias that its walk over a step must exceed: else its change is noise of the estimate
# Probability of so little change, below which the walk is lowered; too low by chance, it is raised again
_TOO_LITTLE = 1e-5
_AT_MOST = 0.95  # confidence that the biases walk no more than the lowered walk says
_LEAST_LESS = 0.8  # share of the walk above which it is not lowered: the change is not worth building the window anew
# 1 sigma of the heading: above it, corrections of the heading change the accelerometer biases by more than their
# covariance tells.
_HEADING_RAD = 0.1


class BiasWalk:
    """Factors on the configured walk of the biases.

    Attributes:
        times: (2,) factors of accelerometers and of gyroscopes, at least 1.
    """

    def __init__(self) -> None:
        self.times = np.ones(2)
        self.begin()

    def begin(self) -> None:
        """Forget the biases so far: those of a new or rebuilt window come of other data or other weights."""
        self._known: list[KnownBias] = []
        self._since_ns: int | None = None

    def of(self, sensor: Any) -> Any:
        """Return the configuration of the IMU with its walk raised."""
        return sensor.scaled(dict(zip(WALK_KEYS, self.times.tolist(), strict=True)))

    def changed(self, lag: Lag, samples: Callable[[], ImuSeries]) -> str:
        """Raise the walk of accelerometers or gyroscopes where that is needed, and lower it where it no longer is.

        Args:
            samples: gives the IMU samples of the window.

        Returns:
            A line on the change, or empty.
        """
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
        """Raise the walk where the biases have changed by too much; return a line on that, or empty."""
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
        """Lower a raised walk to the most that explains how little biases changed; return a line on that, or empty."""
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
    """Return the largest share of the walk that explains how little biases have changed; None: the whole walk does.

    Args:
        known: the biases of one window, by stamp. k: 0 for accelerometers, 1 for gyroscopes.
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
    """Yield the changes of one bias, the last first, over steps so long that its walk exceeds its variance (`_CLEAR`).

    Yields:
        The stamp (ns) at which the step begins, and the squared change over its expected variance.
    """
    later = known[-1]
    for then in reversed(known[:-1]):
        walk = links.bias_steps(then.stamp_ns, later.stamp_ns)[axis] ** 2
        if walk > _CLEAR * max(then.variance[axis], later.variance[axis]):
            expected = then.variance[axis] + walk - later.variance[axis]
            yield then.stamp_ns, float((later.bias[axis] - then.bias[axis]) ** 2 / expected)
            later = then
