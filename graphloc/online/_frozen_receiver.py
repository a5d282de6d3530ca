# SPDX-License-Identifier: Apache-2.0
"""A receiver that hangs: it says the same place while the vessel goes on.

What its places are off by then grows as fast as the vessel goes, second after second. Multipath drifts by decimetres a second,
and jumps; so no such error is right, but as a chain of jumps it is cheaper than it should be: in a window of seconds the estimate
would sooner or later follow, by a tilt and a bias that were never there.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from graphloc.frames import Array

WINDOW_S, _FEWEST = 4.0, 4  # fixes, over so long at least
_LEAST_MPS = 0.7  # no multipath drifts so fast
_SHARE = 0.5  # of the vessel's speed: a late stamp parts in a turn, too, by less
_SIGMAS = 4.0
_STANDS_MPS, _STANDS_M = 0.3, 0.5  # that it says: one that moves otherwise may be right, and the estimate wrong
_LONGEST_S = 15.0  # that it is passed over in silence
_ALONG_S = 10.0  # it has moved along for: before, it may be the estimate that starts wrong
_LINE = 0.15  # of the way that they part by: fixes that jump lie farther off a line


class FrozenReceiverDetector:
    """Of one receiver.

    Attributes:
        frozen: it stands while the vessel goes; its places are not believed until it moves along again.
        stands_s: since when it says the same place, but for its noise.
    """

    def __init__(self) -> None:
        self.frozen = False
        self.stands_s = -np.inf
        self._stands_m: Array | None = None
        self._seen: deque[tuple[float, Array, Array]] = deque()
        self._frozen_s = 0.0
        self._along_s: float | None = None  # since when it has moved along

    def for_long(self, at_s: float) -> bool:
        """Whether it has parted for so long that the estimate may be wrong instead."""
        return self.frozen and at_s - self._frozen_s > _LONGEST_S

    def note(
        self, at_s: float, told_m: Array, estimated_m: Array, sigma_m: float, v_mps: Array, sigma_mps: float
    ) -> None:
        """Take in a fix; one that is late is passed over.

        Args:
            told_m, estimated_m: (2,) place of the antenna. sigma_m: of the place told. v_mps: (2,) velocity of the vessel.
            sigma_mps: of that velocity.
        """
        if self._seen and at_s <= self._seen[-1][0]:
            return
        still_m = max(_STANDS_M, _SIGMAS * float(np.sqrt(2.0)) * sigma_m)  # of two places
        if self._stands_m is None or float(np.linalg.norm(told_m - self._stands_m)) > still_m:
            self.stands_s, self._stands_m = at_s, np.array(told_m)
        self._seen.append((at_s, np.array(told_m), np.array(told_m - estimated_m)))
        while at_s - self._seen[0][0] > 1.25 * WINDOW_S:
            self._seen.popleft()
        t = np.array([s for s, _, _ in self._seen])
        if len(t) < _FEWEST or t[-1] - t[0] < WINDOW_S:
            return
        told, off = (np.array([row[k] for row in self._seen]) for k in (1, 2))
        parts, steady = _slope(t, off)
        left = off - off.mean(axis=0) - np.outer(t - t.mean(), parts)
        rms, speed = float(np.sqrt((left**2).sum(axis=1).mean())), float(np.linalg.norm(parts))
        late = t > t[-1] - (0.5 if self.frozen else 1.0) * WINDOW_S  # it moves along: to be seen soon
        moves, noise = _slope(t[late], told[late])
        stands = float(np.linalg.norm(moves)) < _STANDS_MPS + _SIGMAS * sigma_m * noise
        least = max(_LEAST_MPS, _SHARE * float(np.linalg.norm(v_mps)))
        if self.frozen:  # that the velocity is known ever less without it does not make it move
            self.frozen = stands and speed > 0.5 * least
            return
        least = max(least, _SIGMAS * float(np.hypot(max(sigma_m, rms) * steady, sigma_mps)))
        if self._along_s is None and speed < 0.5 * least:
            self._along_s = at_s
        along = self._along_s is not None and at_s - self._along_s > _ALONG_S
        # Few fixes, or noisy ones, tell one that stands from none: it may as well move as the vessel does.
        stands &= float(np.linalg.norm(moves)) < max(_STANDS_MPS, _SHARE * float(np.linalg.norm(v_mps)))
        self.frozen = along and stands and speed > least and rms < _LINE * speed * float(t[-1] - t[0])
        if self.frozen:  # without it the estimate is another one
            self._frozen_s = at_s
            self._seen.clear()


def _slope(t: Array, places_m: Array) -> tuple[Array, float]:
    """Velocity (2,) of places (N, 2), and its sigma for each metre of their noise."""
    dt = t - t.mean()
    square = max(float(dt @ dt), 1e-9)
    return dt @ (places_m - places_m.mean(axis=0)) / square, 1.0 / float(np.sqrt(square))
