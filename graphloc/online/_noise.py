# SPDX-License-Identifier: Apache-2.0
"""How much noisier the IMU is taken for than it is configured."""

from __future__ import annotations

import numpy as np

from graphloc.online._lag import Lag
from graphloc.solve._batch import CONTRADICTION, LARGEST_NOISE_SCALE

_EVERY_S, _MISFITS = 5.0, 2  # how often the fit is looked at, and how often in turn it must be bad


class ImuNoise:
    """Asked of a lag that is to be solved about every 0.1 s; `scale` only grows.

    Args:
        adapt: whether it may grow (`adapt_noise`).
    """

    def __init__(self, *, adapt: bool) -> None:
        self.scale = 1.0
        self._adapt = adapt
        self._looked_ns, self._misfits = 0, 0

    def begin(self, at_ns: int) -> None:
        """A lag has begun, and what has just begun has not settled."""
        self._looked_ns, self._misfits = at_ns, 0

    def contradicted(self, lag: Lag) -> str:
        """Take the IMU for noisier where the lag contradicts it time and again, as the batch does; what to say of it."""
        at_ns = lag.newest.stamp_ns
        if at_ns - self._looked_ns < _EVERY_S * 1e9 or not self._adapt:
            return ""
        if not lag.fresh:  # steps cost what estimates have moved since they were linearised, up to a second ago
            return ""
        self._looked_ns = at_ns
        misfit = lag.misfit()
        self._misfits = self._misfits + 1 if misfit > CONTRADICTION else 0
        if self._misfits < _MISFITS or self.scale >= LARGEST_NOISE_SCALE:
            return ""
        self._misfits = 0
        self.scale = min(self.scale * float(np.clip(np.sqrt(misfit), 1.5, 3.0)), LARGEST_NOISE_SCALE)
        return f"the IMU contradicts the other sensors: its noise is scaled up to {self.scale:.1f} times"
