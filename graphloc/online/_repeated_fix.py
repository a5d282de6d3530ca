# SPDX-License-Identifier: Apache-2.0
"""A receiver, or its driver, that repeats a fix while the vessel moves, bit for bit or within centimetres.

At rest a receiver may rightly repeat a fix, and some hold their position at low speed. So the vessel must have been
under way by the fixes before, and must still be by the estimate. Or, in hindsight, the position must jump on.

The estimated speed may be wrong. If the heading is off by an angle a, a vessel that has braked from velocity v keeps a
speed of 2 |v| sin(a / 2) in the estimate, but only |v| (1 - cos a) of it along v. So what counts is the estimated
velocity along the fastest one just before; and by the last fixes before the repetition the vessel must not have been
much slower than the estimate.

A receiver that was seen to scatter at rest does not hold its position; where it repeats a fix bit for bit, only the
estimated velocity along the fastest one is asked. For a frozen position that scatters by more than centimetres see
`_frozen_receiver.py`; offline: `graphloc/signals/frozen_receiver.py`.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from graphloc.frames import Array
from graphloc.signals.frozen_receiver import (
    BEFORE_S,
    FEWEST,
    HELD_S,
    REST_S,
    SEEN,
    UNDER_WAY_MPS,
    goes_on,
    speed_of,
    stands,
    under_way,
)
from graphloc.time import NS_PER_S

# Fixes nearer than the first are of one place; so far (m) must the vessel have gone by then, unless a fix equals the
# one before.
_SAME_M, _AWAY_M = 0.2, 1.0
_SIGMAS = 3.0  # sigmas that the estimated speed must exceed
_SHARE = 0.5  # share of the speed before, by the fixes or as estimated, below which the vessel brakes
KEPT = 200  # items, so that memory stays bounded: ten seconds of a receiver at 20 Hz; a choice


class RepeatedFixDetector:
    """The detector of one receiver. It outlives the window; fixes that a rebuild feeds it again are ignored as late.

    Attributes:
        frozen: whether it has repeated one place for seconds (`HELD_S`); so until another place comes.
    """

    def __init__(self) -> None:
        self.frozen = False
        # The last different places: stamp (ns) of the first fix there, place, and the estimated velocity at that stamp.
        self._places: deque[tuple[int, Array, Array]] = deque(maxlen=KEPT)
        self._rest: deque[tuple[int, Array]] = deque(maxlen=KEPT)  # fixes of some seconds, none repeated
        # How often such fixes were at rest: the receiver then scatters there, and does not repeat a position
        self._seen = 0
        self._last: tuple[int, Array] | None = None  # newest fix
        self._equal_ns, self._equal = 0, 0  # stamp of the first of the fixes that equal the newest, and their number
        self._since_ns: int | None = None  # stamp of the first old repetition of the present place; None: there is none
        self._old: deque[tuple[int, int, Array]] = deque(maxlen=KEPT)  # old repetitions: first and last stamp, place

    def note(self, stamp_ns: int, told_m: Array, v_mps: Array, sigma_mps: float) -> int | None:
        """Take in a fix; a late one is ignored.

        Args:
            stamp_ns: of the fix. told_m: (2,) position in world. v_mps: (2,) estimated velocity of the vessel or its
                antenna, in body.
            sigma_mps: of that velocity.

        Returns:
            The stamp (ns) from which the fixes before this one turn out to have been old, because this one jumps on;
            else None.
        """
        last, turned_out = self._last, None
        if last is not None and stamp_ns <= last[0]:
            return None
        self._last = (stamp_ns, np.array(told_m))
        equals = last is not None and np.array_equal(told_m, last[1])
        self._note_rest(stamp_ns, told_m, equals=equals)
        if last is None or not _same(told_m, self._places[-1][1]):
            if last is not None and self._since_ns is None and self._went_on(stamp_ns, told_m, last):
                turned_out = self._equal_ns + 1
                self._old.append((turned_out, *last))
            self._begin(stamp_ns, told_m, v_mps)
        elif self._is_old(stamp_ns, v_mps, sigma_mps, equals=equals):
            if self._since_ns is None:
                self._since_ns = stamp_ns
            else:
                self._old.pop()
            self._old.append((self._since_ns, stamp_ns, self._places[-1][1]))
            self.frozen |= stamp_ns - self._since_ns >= HELD_S * NS_PER_S
        else:
            self._since_ns = None
        self._equal_ns, self._equal = (self._equal_ns, self._equal + 1) if equals else (stamp_ns, 1)
        return turned_out

    def _note_rest(self, stamp_ns: int, told_m: Array, *, equals: bool) -> None:
        if self._seen >= SEEN:
            return
        if equals:
            self._rest.clear()
        self._rest.append((stamp_ns, np.array(told_m)))
        if stamp_ns - self._rest[0][0] < REST_S * NS_PER_S:
            return
        t_s = np.array([(at_ns - self._rest[0][0]) / NS_PER_S for at_ns, _ in self._rest])
        self._seen += stands(t_s, np.array([place for _, place in self._rest]))
        while stamp_ns - self._rest[0][0] > REST_S / 2.0 * NS_PER_S:
            self._rest.popleft()

    def _begin(self, stamp_ns: int, told_m: Array, v_mps: Array) -> None:
        self.frozen, self._since_ns = False, None
        self._places.append((stamp_ns, np.array(told_m), np.array(v_mps)))
        while stamp_ns - self._places[0][0] > BEFORE_S * NS_PER_S:
            self._places.popleft()

    def _is_old(self, stamp_ns: int, v_mps: Array, sigma_mps: float, *, equals: bool) -> bool:
        if self.frozen:
            return True
        fastest = max((v for _, _, v in self._places), key=np.linalg.norm)
        fastest_mps = float(np.linalg.norm(fastest))
        speed_mps = float(v_mps @ fastest) / max(fastest_mps, 1e-9)
        if not equals and speed_mps * (stamp_ns - self._places[-1][0]) < _AWAY_M * NS_PER_S:
            return False
        least_mps = UNDER_WAY_MPS
        if not (equals and self._seen >= SEEN):  # else the receiver does not hold its position at rest
            before_mps = self._speed_before_mps()
            if before_mps is None or self._slowed_down(float(np.linalg.norm(v_mps))):
                return False
            least_mps = max(least_mps, _SHARE * max(before_mps, fastest_mps))
        if speed_mps < least_mps:
            return False
        # While its fixes are left out the speed grows uncertain: that is no evidence of rest.
        return self._since_ns is not None or speed_mps > _SIGMAS * sigma_mps

    def _went_on(self, stamp_ns: int, told_m: Array, last: tuple[int, Array]) -> bool:
        """Return whether the position jumps on after bit-for-bit repetitions, by the rule of `frozen_fixes`."""
        if self._equal < FEWEST or last[0] - self._equal_ns < HELD_S * NS_PER_S:
            return False
        before_mps = 0.0 if self._seen >= SEEN else self._speed_before_mps()
        jump_m = float(np.linalg.norm(told_m - last[1]))
        held_s, silent_s = ((stamp_ns - at_ns) / NS_PER_S for at_ns in (self._equal_ns, last[0]))
        return before_mps is not None and goes_on(jump_m, before_mps, held_s, silent_s)

    def _speed_before_mps(self) -> float | None:
        """Return the speed by the different places up to the repeated one; None: the vessel may have been at rest."""
        t_s = np.array([(at_ns - self._places[0][0]) / NS_PER_S for at_ns, _, _ in self._places])
        return under_way(t_s, np.array([place for _, place, _ in self._places]))

    def _slowed_down(self, estimated_mps: float) -> bool:
        """Return whether the later half of the places is much slower than the estimate, which missed the braking."""
        later = list(self._places)[len(self._places) // 2 :]
        t_s = np.array([(at_ns - later[0][0]) / NS_PER_S for at_ns, _, _ in later])
        return speed_of(t_s, np.array([place for _, place, _ in later]))[0] < _SHARE * estimated_mps

    def is_old(self, stamp_ns: int, told_m: Array) -> bool:
        """Return whether a fix, taken in or late, is an old repetition."""
        return any(a <= stamp_ns <= b and _same(told_m, place) for a, b, place in self._old)


def _same(a_m: Array, b_m: Array) -> bool:
    return float(np.linalg.norm(a_m - b_m)) <= _SAME_M
