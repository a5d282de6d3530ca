# SPDX-License-Identifier: Apache-2.0
"""A receiver or driver that hangs, repeating a velocity bit for bit (offline: `signals/frozen_receiver.py`)."""

from __future__ import annotations

from collections import deque

import numpy as np

from graphloc.frames import Array
from graphloc.online._repeated_fix import KEPT
from graphloc.signals.frozen_receiver import MANY, MOSTLY, REST_MPS

_RUNS = 20  # different velocities after which it is known whether they are rounded


class RepeatedVelocityDetector:
    """The detector of one receiver. It outlives the window; what a rebuild feeds it again is ignored as late."""

    def __init__(self) -> None:
        self._last: tuple[int, Array] | None = None
        # Stamp of the first of the velocities that equal the newest, and their number
        self._begin_ns, self._equal = 0, 0
        self._runs = self._singles = 0  # number of runs of equal velocities; number of runs of length 1
        # Old repetitions: first and last stamp (ns), velocity
        self._old: deque[tuple[int, int, Array]] = deque(maxlen=KEPT)

    def note(self, stamp_ns: int, v_mps: Array) -> None:
        """Take in a velocity (3,), m/s in world; a late one is ignored."""
        if self._last is not None and stamp_ns <= self._last[0]:
            return
        if self._last is None or not np.array_equal(v_mps, self._last[1]):
            self._runs += 1
            self._singles += self._equal == 1
            self._begin_ns, self._equal = stamp_ns, 0
        self._last, self._equal = (stamp_ns, np.array(v_mps)), self._equal + 1
        rounded = self._runs < _RUNS or self._singles < MOSTLY * (self._runs - 1)
        if self._equal >= MANY and not rounded and float(np.linalg.norm(v_mps)) > REST_MPS:
            if self._equal > MANY:
                self._old.pop()
            self._old.append((self._begin_ns + 1, *self._last))

    def is_old(self, stamp_ns: int, v_mps: Array) -> bool:
        """Return whether a velocity, taken in or late, is an old repetition."""
        return any(a <= stamp_ns <= b and np.array_equal(v_mps, v) for a, b, v in self._old)
