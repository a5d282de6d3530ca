# SPDX-License-Identifier: Apache-2.0
"""Noise of the IMU: raised where the IMU contradicts the other sensors.

It is also raised to the scatter of its samples, where that makes all measurements together more probable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from graphloc.build import noisier_imu
from graphloc.judge.imu_noise import CONTRADICTION, LARGEST_NOISE_SCALE, LEAST_TIMES, noise_step, scattered, too_quiet
from graphloc.measurements import ImuSeries
from graphloc.online._bias_walk import BiasWalk
from graphloc.online._lag import Lag

_EVERY_S, _MISFITS = 5.0, 2  # how often the fit is checked, and how many checks in a row must fail
_WINDOWS_S = 10.0  # how often a larger noise is tried; less often if the lag is longer
_SURE = 8.0  # log-likelihood that a larger noise must gain


class ImuNoise:
    """Factors on the configured noise densities. They only grow, but for those on the walk of the biases.

    Args:
        adapt: whether the factors may change (`adapt_noise`).

    Attributes:
        scale: factor on all of the noise, at least 1. gyro, accel: further factors on the noise of each.
        walk: factors on the walk of the biases.
        misled: factor by which the last call of `changed` raised the walk, and by which covariances of earlier
            estimates are to be enlarged; 1: it raised none.
    """

    def __init__(self, *, adapt: bool) -> None:
        self.scale, self.gyro, self.accel = 1.0, 1.0, 1.0
        self.walk, self.misled = BiasWalk(), 1.0
        self._adapt = adapt
        self._looked_ns, self._misfits, self._weighed_ns = 0, 0, 0
        # Log-likelihood gained by more noise of both, of the gyroscope, of the accelerometer
        self._gained = np.zeros(3)

    def begin(self, at_ns: int) -> None:
        """Begin with a window that begins at a stamp: it is not checked until it has settled."""
        self._looked_ns, self._misfits, self._weighed_ns = at_ns, 0, at_ns
        self.walk.begin()

    def at_least(self, scale: float, gyro: float, accel: float, *walk: float) -> None:
        """Raise the factors to known ones: those of a start, or of a snapshot."""
        if not self._adapt:
            return
        self.walk.times = np.maximum(self.walk.times, walk or 1.0)
        self.scale, self.gyro, self.accel = max(self.scale, scale), max(self.gyro, gyro), max(self.accel, accel)

    def of(self, sensor: Any) -> Any:
        """Return the configuration of the IMU with its noise and walk raised, but not by `scale`."""
        return noisier_imu(self.walk.of(sensor), self.gyro, self.accel)

    def changed(self, lag: Lag, samples: Callable[[], ImuSeries], *, heading_doubtful: bool = False) -> str:
        """Raise the noise where that is needed, or lower the walk again; return a line on that, or empty.

        Args:
            samples: gives the IMU samples of the window. heading_doubtful: whether the heading may be wrong, which
                bends the biases.
        """
        # Before a relinearisation, the cost of a step includes how far its states have moved since the last one.
        if not self._adapt or not lag.fresh:
            return ""
        self.misled, before = 1.0, self.walk.times.copy()
        if heading_doubtful:
            self.walk.begin()
        said = self.walk.changed(lag, samples) or self._contradicted(lag) or self._too_quiet(lag, samples)
        if said:
            self.misled = max(1.0, float((self.walk.times / before).max()))
        return said

    def _contradicted(self, lag: Lag) -> str:
        """Scale the noise up where the window contradicts the IMU repeatedly, as the batch solver does."""
        at_ns = lag.newest.stamp_ns
        if at_ns - self._looked_ns < _EVERY_S * 1e9:
            return ""
        self._looked_ns = at_ns
        misfit = lag.misfit()
        self._misfits = self._misfits + 1 if misfit > CONTRADICTION else 0
        if self._misfits < _MISFITS or self.scale >= LARGEST_NOISE_SCALE:
            return ""
        self._misfits = 0
        self.scale = min(self.scale * noise_step(misfit), LARGEST_NOISE_SCALE)
        return f"the IMU contradicts the other sensors: its noise is scaled up to {self.scale:.1f} times"

    def _too_quiet(self, lag: Lag, samples: Callable[[], ImuSeries]) -> str:
        """Raise the noise to the scatter of the samples, where the measurements are then more probable.

        See `judge.imu_noise`.

        The IMU's residuals alone do not tell it, as they do offline: in a window of seconds, the prior from earlier
        data takes up most of a misfit.
        """
        at_ns = lag.newest.stamp_ns
        if at_ns - self._weighed_ns < max(_WINDOWS_S, lag.lag_s) * 1e9:  # so that no data count twice
            return ""
        self._weighed_ns = at_ns
        imu = samples()
        sensor = lag.problem.config.sensors[imu.sensor]
        gyro, accel = np.maximum(scattered(imu, self.of(sensor), self.scale), 1.0).tolist()
        if max(gyro, accel) < LEAST_TIMES:
            return ""
        times = ((1.0, 1.0), (gyro, accel), (gyro, 1.0), (1.0, accel))
        try:
            likely = lag.likelihoods(times)
        except RuntimeError:  # the normal equations are singular; the window itself is not affected
            return ""
        if not np.isfinite(likely).all():
            return ""
        # Limited from below: else hours in which more noise was less probable would hide for hours that it is needed
        # now.
        self._gained = np.maximum(self._gained + likely[1:] - likely[0], -_SURE)
        best = int(np.argmax(self._gained))
        if self._gained[best] < _SURE:
            return ""
        self._gained = np.zeros(3)
        gyro, accel = times[1 + best]
        self.gyro, self.accel = self.gyro * gyro, self.accel * accel
        return too_quiet(imu.sensor, sensor, self.of(sensor))
