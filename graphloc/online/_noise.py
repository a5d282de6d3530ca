# SPDX-License-Identifier: Apache-2.0
"""Scale of the IMU noise: raised where the IMU contradicts the other sensors."""

from __future__ import annotations

from graphloc.online._lag import Lag
from graphloc.solve._batch import CONTRADICTION, LARGEST_NOISE_SCALE, noise_step

_EVERY_S, _MISFITS = 5.0, 2  # how often the fit is checked, and how many checks in a row must fail


class ImuNoise:
    """Factor on the configured noise densities; it only grows.

    Args:
        adapt: whether it may grow (`adapt_noise`).

    Attributes:
        scale: at least 1.
    """

    def __init__(self, *, adapt: bool) -> None:
        self.scale = 1.0
        self._adapt = adapt
        self._looked_ns, self._misfits = 0, 0

    def begin(self, at_ns: int) -> None:
        """A window has begun at a stamp: it is not checked until it has settled."""
        self._looked_ns, self._misfits = at_ns, 0

    def contradicted(self, lag: Lag) -> str:
        """Raise the scale where the window contradicts the IMU repeatedly, as the batch solver does; return a line on that, or empty."""
        at_ns = lag.newest.stamp_ns
        if at_ns - self._looked_ns < _EVERY_S * 1e9 or not self._adapt:
            return ""
        if not lag.fresh:  # until relinearised, the cost of a step includes how far its states have moved since
            return ""
        self._looked_ns = at_ns
        misfit = lag.misfit()
        self._misfits = self._misfits + 1 if misfit > CONTRADICTION else 0
        if self._misfits < _MISFITS or self.scale >= LARGEST_NOISE_SCALE:
            return ""
        self._misfits = 0
        self.scale = min(self.scale * noise_step(misfit), LARGEST_NOISE_SCALE)
        return f"the IMU contradicts the other sensors: its noise is scaled up to {self.scale:.1f} times"
