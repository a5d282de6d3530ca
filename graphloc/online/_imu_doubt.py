# SPDX-License-Identifier: Apache-2.0
"""Is the IMU wrong: a wrong unit, a loose plug, a saturated axis? Sensors then deny the estimate together.

A single sensor that disagrees is itself in doubt, and its kernel takes its weight. Two that begin to disagree within
seconds of each other have one thing in common: the motion by the IMU since the state that they agreed with. So the
samples since then are tried as an IMU gap (`Tracking.doubt_imu`). They are left out if the sensors agree without them,
by a motion that a vessel may have made.

The samples that follow are left out for half a second at first, and on for as long as their rates turn otherwise than
the estimate does without them. Samples that are wrong in another way (of an accelerometer) are used again, and denied
again; they are then left out for twice as long, each time. So an IMU that stays wrong costs a rebuild every few
seconds, and one that is right again is missed for seconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.inertial import GAP_TOLD_S, GAP_TURN_RADPS
from graphloc.judge.wrong_imu import GROWS
from graphloc.time import duration_ns

# Fewest sensors that deny; fewest measurements in a row of each that do, and of one sensor at least.
_SENSORS, _FEWEST, _MANY = 2, 2, 5
# Measurements before the denials that are remembered; share of them that must have agreed (with Cauchy at 1.5 sigmas,
# 0.87 do).
_KEPT, _RIGHT = 50, 0.7
_AT_ONCE_S = 2.5  # longest time since the first denial: later on, a gap explains a jump of the fixes as well
_BEFORE_S = 0.3  # the wrong samples begin so long before the first denial
_AGAIN_S = 1.0  # time before the next trial, after one that explained nothing
_HOLD_S = (0.5, 4.0)  # for how long samples are left out: at first, and at most
_QUIET_S = 10.0  # time after the last gap, without another, after which the IMU counts as right again
_TURNED = 3.0  # sigmas of the turn in a gap


class Denials:
    """Which sensors deny the estimate: their newest measurements disagreed on arrival, though earlier ones agreed."""

    def __init__(self) -> None:
        self._in_a_row: dict[str, list[int]] = {}
        self._sizes: dict[str, tuple[float, float]] = {}  # squared residuals of the first and the last of a row
        self._agreed: dict[str, deque[bool]] = {}  # whether measurements before the row agreed

    def note(self, sensor: str, stamp_ns: int, size: float, *, agrees: bool, outlier: bool) -> None:
        """Note how a measurement was judged.

        Args:
            size: its squared residual, in sigmas^2. agrees: whether it agrees with the estimate.
            outlier: whether its sensor denies any estimate now and then, so that only its last denials count.
        """
        stamps = self._in_a_row.setdefault(sensor, [])
        before = self._agreed.setdefault(sensor, deque(maxlen=_KEPT))
        if outlier:
            stamps.append(stamp_ns)
            del stamps[: len(stamps) if agrees else -_FEWEST]
        elif agrees:
            before.extend([False] * len(stamps) + [True])
            stamps.clear()
        else:
            self._sizes[sensor] = (self._sizes[sensor][0] if stamps else size, size)
            if len(stamps) < _MANY:
                stamps.append(stamp_ns)

    def at_once(self, now_ns: int) -> Mapping[str, int]:
        """Return the stamp (ns) of the first denial of each sensor that began to deny a moment ago.

        Empty, if that may be chance.

        Sensors that often disagreed before do not count: a compass of the wrong sense denies a right gyroscope half of
        the time, and the fixes then deny the result. Residuals that do not grow are a jump, as of the heading and the
        place of one receiver together; those of a wrong IMU grow.
        """
        begun = {
            name: stamps
            for name, stamps in self._in_a_row.items()
            if len(stamps) >= _FEWEST and now_ns - min(stamps) < _AT_ONCE_S * 1e9
        }
        if len(begun) < _SENSORS or max(map(len, begun.values())) < _MANY:
            return {}
        if any(sum(agreed) < _RIGHT * len(agreed) for agreed in map(self._agreed.__getitem__, begun)):
            return {}
        if not any(last > GROWS * first for first, last in (self._sizes[n] for n in begun if n in self._sizes)):
            return {}
        return {name: min(stamps) for name, stamps in begun.items()}


class ImuDoubt:
    """Which samples of the IMU are left out.

    Attributes:
        gaps: (a, b) stamps (ns), in order: samples with a < stamp <= b are left out.
        underway: whether the IMU does not count as right again yet, so that another gap may follow.
    """

    def __init__(self) -> None:
        self.gaps: list[tuple[int, int]] = []
        self.underway = False
        self._hold_s, self._tried_ns = _HOLD_S[0], 0

    def suspected(self, denied: Mapping[str, int], now_ns: int) -> int | None:
        """Return since when (stamp, ns) the samples are to be tried as a gap; None: nothing is to be tried.

        Args:
            denied: `Denials.at_once`.
        """
        if not denied or self.leaves_out(now_ns) or now_ns - self._tried_ns < _AGAIN_S * 1e9:
            return None
        self._tried_ns = now_ns
        since_ns, over_ns = min(denied.values()) - duration_ns(_BEFORE_S), self._over_ns()
        # If the IMU is still wrong, it is so from the first sample after the last gap on.
        return over_ns if 0 <= since_ns - over_ns < _AT_ONCE_S * 1e9 else since_ns

    def leave_out(self, since_ns: int, now_ns: int) -> None:
        """Leave out the samples since a stamp (ns), and those that come for a while after now."""
        self._hold_s = min(2.0 * self._hold_s, _HOLD_S[1]) if self.underway else _HOLD_S[0]
        self.underway = True
        if self.gaps and since_ns <= self._over_ns():
            since_ns, _ = self.gaps.pop()
        self.gaps.append((since_ns, now_ns + duration_ns(self._hold_s)))
        self._tried_ns = 0

    def go_on(self) -> None:
        """Lengthen the last gap: the samples at its end were wrong, or too few to tell."""
        since_ns, until_ns = self.gaps[-1]
        self.gaps[-1] = since_ns, until_ns + duration_ns(_HOLD_S[0])

    def ended(self, now_ns: int) -> bool:
        """Return, once, that the samples have been right for so long that the IMU counts as right again."""
        ended = self.underway and now_ns - self._over_ns() > _QUIET_S * 1e9
        self.underway = self.underway and not ended
        return ended

    def leaves_out(self, stamp_ns: int) -> bool:
        """Return whether a sample is left out."""
        return any(a < stamp_ns <= b for a, b in self.gaps)

    def forget(self, before_ns: int) -> None:
        """Forget gaps that ended before a stamp. The last is kept, because the next may continue it."""
        self.gaps = [gap for gap in self.gaps[:-1] if gap[1] >= before_ns] + self.gaps[-1:]

    def over(self, stamp_ns: int) -> bool:
        """Return whether a sample comes after the last gap."""
        return stamp_ns > self._over_ns()

    def told_by(self, first_ns: int) -> list[tuple[int, int]]:
        """Return the spans before the gaps that reach beyond a stamp: their samples tell the motion within the gaps."""
        return [(a - duration_ns(GAP_TOLD_S), a) for a, b in self.gaps if b >= first_ns]

    def _over_ns(self) -> int:
        return self.gaps[-1][1] if self.gaps else 0


def turns_otherwise(stamps_ns: NDArray[np.int64], rates_radps: Array, R: Array) -> bool:
    """Return whether angular rates turn otherwise than an estimate made without them, by more than a vessel may.

    Args:
        stamps_ns: (N,). rates_radps: (N, 3), body axes. R: (3, 3), rotation of the body from the first stamp to the
            last, by the estimate.
    """
    told = gtsam.Rot3()
    for rate, dt_s in zip(rates_radps, np.diff(stamps_ns) * 1e-9, strict=False):
        told = told.compose(gtsam.Rot3.Expmap(rate * dt_s))
    off_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(told.inverse().compose(gtsam.Rot3(R)))))
    return off_rad > float(_TURNED * GAP_TURN_RADPS * np.sqrt((stamps_ns[-1] - stamps_ns[0]) * 1e-9))
