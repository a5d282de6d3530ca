# SPDX-License-Identifier: Apache-2.0
"""A frozen receiver: it repeats one position while the vessel moves on.

Its error then grows at the speed of the vessel. Multipath drifts by decimetres per second, or jumps, so a slow error is no
model of it; but explained as a chain of jumps it costs too little: within a window of seconds the estimate would sooner or
later follow, by a false tilt and bias.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from graphloc.frames import Array
from graphloc.signals.series import line_fit

WINDOW_S, _FEWEST = 4.0, 4  # seconds and fixes that a decision is made from
_LEAST_MPS = 0.7  # no multipath drifts so fast
_SHARE = 0.5  # of the vessel's speed: with late stamps the error also grows in a turn, but by less
_SIGMAS = 4.0  # of its own noise: so far a receiver that stands may seem to move, and an error to grow; a choice
_FREEDOM = 4  # degrees of it, at least, that a scatter is told by: four fixes
# Measured by the receiver: if it moves in another way, it may be right and the estimate wrong.
_STANDS_MPS, _STANDS_M = 0.3, 0.5
_LONGEST_S = 15.0  # for which its disagreement does not count against the estimate
_ALONG_S = 10.0  # that it must have moved with the vessel before: else a bad start of the estimate may be the cause
_LINE = 0.15  # of the growth of the error: residuals of a straight line; fixes that jump have larger ones


class FrozenReceiverDetector:
    """The detector of one receiver.

    Attributes:
        frozen: its position stands while the vessel moves; its fixes are rejected until it moves with the vessel again.
        stands_s: time (s) since which it has repeated one position, but for its noise.
    """

    def __init__(self) -> None:
        self.frozen = False
        self.stands_s = -np.inf
        self._stands_m: Array | None = None
        # Where it stood when it was found to be frozen, and how far that is noise.
        self._place_m, self._still_m = np.zeros(2), np.inf
        self._seen: deque[tuple[float, Array, Array]] = deque()
        self._frozen_s = 0.0
        self._along_s: float | None = None  # since when it has moved along

    def for_long(self, at_s: float) -> bool:
        """Whether it has been frozen for so long that the estimate may be wrong instead."""
        return self.frozen and at_s - self._frozen_s > _LONGEST_S

    def note(
        self, at_s: float, told_m: Array, estimated_m: Array, sigma_m: float, v_mps: Array, sigma_mps: float
    ) -> None:
        """Take in a fix; one that is late is ignored.

        Args:
            at_s: its time. told_m, estimated_m: (2,) position of the antenna in world, measured and estimated.
            sigma_m: of the measured one. v_mps: (2,) estimated velocity of the vessel in world. sigma_mps: of that velocity.
        """
        if self._seen and at_s <= self._seen[-1][0]:
            return
        self._take(at_s, told_m, estimated_m, sigma_m)
        t = np.array([s for s, _, _ in self._seen])
        if len(t) < _FEWEST or t[-1] - t[0] < WINDOW_S:
            return
        told, off = (np.array([row[k] for row in self._seen]) for k in (1, 2))
        growth = line_fit(t, off)
        rms, speed = float(np.sqrt((growth.left**2).sum(axis=1).mean())), float(np.linalg.norm(growth.slope))
        late = t > t[-1] - (0.5 if self.frozen else 1.0) * WINDOW_S  # shorter when frozen, so that motion is seen soon
        of_vessel_mps = _SHARE * float(np.linalg.norm(v_mps))
        least = max(_LEAST_MPS, of_vessel_mps)
        if self.frozen:  # the growing uncertainty of the velocity without it is no evidence that it moves
            moves_mps, _, noise_mps = _motion(t[late], told[late], sigma_m)
            stands = moves_mps < _STANDS_MPS + _SIGMAS * noise_mps
            self.frozen = stands and speed > 0.5 * least and not self._has_left(told[late])
            return
        least = max(least, _SIGMAS * float(np.hypot(max(sigma_m, rms) * growth.sigma, sigma_mps)))
        if self._along_s is None and speed < 0.5 * least:
            self._along_s = at_s
        along = self._along_s is not None and at_s - self._along_s > _ALONG_S
        if not (along and speed > least and rms < _LINE * speed * float(t[-1] - t[0])):
            return
        moves_mps, noise_m, noise_mps = _motion(t[late], told[late], sigma_m)
        # Few or noisy fixes do not show whether it stands: it may as well move as the vessel does.
        if moves_mps < min(_STANDS_MPS + _SIGMAS * noise_mps, max(_STANDS_MPS, of_vessel_mps)):
            self.frozen, self._frozen_s = True, at_s
            self._place_m = told[t > t[-1] - 0.5 * WINDOW_S].mean(axis=0)
            self._still_m = max(_STANDS_M, _SIGMAS * noise_m)
            self._seen.clear()  # without its fixes the estimate changes

    def _has_left(self, told: Array) -> bool:
        """Whether the newest of its fixes (N, 2) are no repetitions of the position that it stood at.

        Two or three of them do not tell how much they scatter, nor then whether they move.
        """
        return float(np.linalg.norm(told.mean(axis=0) - self._place_m)) > self._still_m

    def _take(self, at_s: float, told_m: Array, estimated_m: Array, sigma_m: float) -> None:
        """Take in a fix and its error (arguments as of `note`), and forget those before the window."""
        still_m = max(_STANDS_M, _SIGMAS * float(np.sqrt(2.0)) * sigma_m)  # of the difference of two positions
        if self._stands_m is None or float(np.linalg.norm(told_m - self._stands_m)) > still_m:
            self.stands_s, self._stands_m = at_s, np.array(told_m)
        self._seen.append((at_s, np.array(told_m), np.array(told_m - estimated_m)))
        while at_s - self._seen[0][0] > 1.25 * WINDOW_S:
            self._seen.popleft()


def _motion(t: Array, places_m: Array, sigma_m: float) -> tuple[float, float, float]:
    """Speed of places (N, 2), m, at times (N,), s; the noise of a place (m), of which `sigma_m` is claimed; and that of the speed."""
    line = line_fit(t, places_m)
    noise_m = min(
        sigma_m, _scatter(line.left)
    )  # many claim far more than they scatter by: by that any boat would seem to stand
    return float(np.linalg.norm(line.slope)), noise_m, noise_m * line.sigma


def _scatter(left_m: Array) -> float:
    """Noise of places by their residuals (N, 2), m, about a straight line, 1 sigma of an axis; inf where too few tell it."""
    freedom = 2 * len(left_m) - 4
    return float(np.sqrt((left_m**2).sum() / freedom)) if freedom >= _FREEDOM else np.inf
