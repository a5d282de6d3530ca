# SPDX-License-Identifier: Apache-2.0
"""Walk of the IMU's biases: raised where they go farther than they were known and may have walked since (offline: `solve/bias_walk.py`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc

from graphloc.frames import Array
from graphloc.measurements import ImuSeries
from graphloc.online._lag import Lag
from graphloc.solve.bias_walk import KEYS, MOST_TIMES, too_steady

_EVERY_S = 10.0
_KEPT = 6  # of these: a minute; a bias that creeps shows after the longest
_UNLIKELY = 1e-5
_HEADING_RAD = (
    0.1  # sigma: from which it turns the biases of accelerometers with it, by more than their covariance tells
)
_MOST_STEP, _LEAST_STEP = 10.0, 1.3  # what is known is too sure as well, so more is not believed at once
_LEAST_SHARE = 0.1  # of the walk, that a bias may go though nothing measures it: rounding


class _Known(NamedTuple):
    """Biases (6,), accelerometers first, and their variances (6,), at a stamp."""

    stamp_ns: int
    bias: Array
    variance: Array


class BiasWalk:
    """Factors on the configured walk of the biases; they only grow.

    An estimate that is as good as it says goes, from b with covariance P to b' with P', by N(0, P + Q - P'), Q: the walk in between.

    Attributes:
        times: (2,) of accelerometers and of gyroscopes.
    """

    def __init__(self) -> None:
        self.times = np.ones(2)
        self.begin()

    def begin(self) -> None:
        """A window has begun: what its biases do is no walk until they have settled."""
        self._known: list[_Known] = []

    def of(self, sensor: Any) -> Any:
        """Return the configuration of the IMU with its walk raised."""
        return sensor.scaled(dict(zip(KEYS, self.times.tolist(), strict=True)))

    def raised(self, lag: Lag, samples: Callable[[], ImuSeries]) -> str:
        """Raise the walk of accelerometers or gyroscopes where that is needed; return a line on that, or empty."""
        newest, known = lag.newest, self._known
        R = newest.pose.rotation().matrix()
        if (R @ newest.pose_cov[:3, :3] @ R.T)[2, 2] > _HEADING_RAD**2:
            self.begin()
        elif not known or newest.stamp_ns - known[-1].stamp_ns >= _EVERY_S * 1e9:
            now = _Known(newest.stamp_ns, newest.bias.vector(), np.diagonal(newest.bias_cov))
            self._known = [*known[-_KEPT:], now]
            return self._told(lag, now, samples) if known else ""
        return ""

    def _told(self, lag: Lag, now: _Known, samples: Callable[[], ImuSeries]) -> str:
        """Raise the walk where how far the biases have gone since tells it, and return a line on that; or empty."""
        gone = []
        for then in self._known[:-1]:
            walk = lag.problem.links.bias_steps((now.stamp_ns - then.stamp_ns) * 1e-9) ** 2
            each = np.array([(now.bias - then.bias) ** 2, then.variance - now.variance, walk])
            gone += [(k, each[:, part]) for k, part in enumerate((slice(3), slice(3, 6)))]
        # Those that wander bend the others: the least likely are they.
        k, least = min(gone, key=lambda found: _likely(found[1]))
        times = min(_needed(least), MOST_TIMES / self.times[k])
        if _likely(least) > _UNLIKELY or times < _LEAST_STEP:
            return ""
        self.times[k] *= times
        name = samples().sensor
        imu = lag.problem.config.sensors[name]
        return too_steady(name, imu, self.of(imu))


def _squares(gone: Array, times: float) -> float:
    """Return the sum of the squares by which three biases went, by their variance with so many times the walk.

    Args:
        gone: (3, 3), of each axis the square, P - P' and Q as in `BiasWalk`.
    """
    squares, known, walk = gone
    return float((squares / np.maximum(known + times**2 * walk, _LEAST_SHARE * walk)).sum())


def _likely(gone: Array) -> float:
    """Return how likely it is that they went as far as they did, or farther; `gone` as of `_squares`."""
    return float(chdtrc(gone.shape[1], _squares(gone, 1.0)))


def _needed(gone: Array) -> float:
    """Return how many times the walk explains it, at most `_MOST_STEP`; `gone` as of `_squares`."""

    def beyond(times: float) -> float:
        return _squares(gone, times) - float(gone.shape[1])

    if beyond(1.0) < 0.0:
        return 1.0
    if beyond(_MOST_STEP) > 0.0:
        return _MOST_STEP
    found: float = brentq(beyond, 1.0, _MOST_STEP)
    return found
