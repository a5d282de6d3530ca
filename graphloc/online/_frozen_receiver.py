# SPDX-License-Identifier: Apache-2.0
"""A frozen receiver: it repeats one position while the vessel moves on.

Its error then grows at the speed of the vessel. The slow error of a receiver is a model of multipath, which drifts by
decimetres per second or jumps, and does not describe this. It could explain a frozen receiver as a chain of jumps, at
too little cost: within a window of seconds, the estimate would sooner or later follow the receiver, with a false tilt
and false biases.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from graphloc.frames import Array
from graphloc.signals.series import line_fit

WINDOW_S, _FEWEST = 4.0, 4  # length (s) and fewest fixes of the data that a decision is made from
_LEAST_MPS = 0.7  # growth of the error that no multipath reaches
# Share of the vessel's speed at which the error must grow: with late stamps it also grows in a turn, but by less
_SHARE = 0.5
# Sigmas of the fixes' noise by which a receiver that stands may seem to move, and an error to grow; a choice
_SIGMAS = 4.0
_FREEDOM = 4  # fewest degrees of freedom that tell a scatter: those of four fixes
# Largest speed and displacement of a position that stands, by the fixes. If they move otherwise, they may be right and
# the estimate wrong.
_STANDS_MPS, _STANDS_M = 0.3, 0.5
_LONGEST_S = 15.0  # time for which a frozen receiver's disagreement does not count against the estimate
# Time for which it must have moved with the vessel before: else a bad start of the estimate may be the cause
_ALONG_S = 10.0
_LINE = 0.15  # largest residuals of a straight line, as a share of the error's growth; fixes that jump have larger ones


class FrozenReceiverDetector:
    """The detector of one receiver.

    Attributes:
        frozen: whether its position stands while the vessel moves; its fixes are rejected until it moves with the
            vessel again.
        stands_s: time (s) since which it has repeated one position, up to its noise.
    """

    def __init__(self) -> None:
        self.frozen = False
        self.stands_s = -np.inf
        self._stands_m: Array | None = None
        # The position at which it was found to be frozen, and how far from it a fix may lie by noise.
        self._place_m, self._still_m = np.zeros(2), np.inf
        self._seen: deque[tuple[float, Array, Array]] = deque()
        self._frozen_s = 0.0
        self._along_s: float | None = None  # time (s) since which it has moved with the vessel

    def for_long(self, at_s: float) -> bool:
        """Return whether the receiver has been frozen for so long that the estimate may be wrong instead."""
        return self.frozen and at_s - self._frozen_s > _LONGEST_S

    def note(
        self, at_s: float, told_m: Array, estimated_m: Array, sigma_m: float, v_mps: Array, sigma_mps: float
    ) -> None:
        """Take in a fix; a late one is ignored.

        Args:
            at_s: its time. told_m, estimated_m: (2,) position of the antenna in world, measured and estimated.
            sigma_m: of the measured position. v_mps: (2,) estimated velocity of the vessel in world. sigma_mps: of that
                velocity.
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
        late = t > t[-1] - (0.5 if self.frozen else 1.0) * WINDOW_S  # shorter when frozen, to see soon that it moves
        of_vessel_mps = _SHARE * float(np.linalg.norm(v_mps))
        least = max(_LEAST_MPS, of_vessel_mps)
        if self.frozen:  # without its fixes the velocity grows uncertain: that is no evidence that the receiver moves
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
        # Few or noisy fixes do not show whether it stands: it may also move with the vessel.
        if moves_mps < min(_STANDS_MPS + _SIGMAS * noise_mps, max(_STANDS_MPS, of_vessel_mps)):
            self.frozen, self._frozen_s = True, at_s
            self._place_m = told[t > t[-1] - 0.5 * WINDOW_S].mean(axis=0)
            self._still_m = max(_STANDS_M, _SIGMAS * noise_m)
            self._seen.clear()  # their errors were by an estimate that its fixes had pulled along

    def _has_left(self, told: Array) -> bool:
        """Return whether the newest fixes (N, 2) lie away from the position at which the receiver stood.

        This also works where two or three fixes are too few to tell their scatter, and so whether they move.
        """
        return float(np.linalg.norm(told.mean(axis=0) - self._place_m)) > self._still_m

    def _take(self, at_s: float, told_m: Array, estimated_m: Array, sigma_m: float) -> None:
        """Take in a fix and its error, and forget fixes older than the window; arguments as of `note`."""
        still_m = max(_STANDS_M, _SIGMAS * float(np.sqrt(2.0)) * sigma_m)  # of the difference of two positions
        if self._stands_m is None or float(np.linalg.norm(told_m - self._stands_m)) > still_m:
            self.stands_s, self._stands_m = at_s, np.array(told_m)
        self._seen.append((at_s, np.array(told_m), np.array(told_m - estimated_m)))
        while at_s - self._seen[0][0] > 1.25 * WINDOW_S:
            self._seen.popleft()


def _motion(t: Array, places_m: Array, sigma_m: float) -> tuple[float, float, float]:
    """Return how places move.

    Args:
        t: (N,) times, s. places_m: (N, 2). sigma_m: stated noise of a place.

    Returns:
        Speed (m/s), noise of a place (m; the stated one, or the scatter if that is smaller), noise of the speed (m/s).
    """
    line = line_fit(t, places_m)
    # Many receivers state far more noise than they scatter by: with that, any boat would seem to stand.
    noise_m = min(sigma_m, _scatter(line.left))
    return float(np.linalg.norm(line.slope)), noise_m, noise_m * line.sigma


def _scatter(left_m: Array) -> float:
    """Return the noise of places, 1 sigma per axis, by residuals (N, 2), m, about a line; inf if they are too few."""
    freedom = 2 * len(left_m) - 4
    return float(np.sqrt((left_m**2).sum() / freedom)) if freedom >= _FREEDOM else np.inf
