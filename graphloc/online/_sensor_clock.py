# SPDX-License-Identifier: Apache-2.0
"""A sensor's clock that is set by whole seconds in mid-run: by leap seconds, or from UTC to GPS time.

By their stamps, its next fixes seem to come from the future, or very late; used at these stamps, they are off by
seconds of motion.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from statistics import median

from graphloc.measurements import Measurement
from graphloc.time import GPS_AHEAD_S, NS_PER_S, utc_text

_REMEMBERED, _FEWEST = 20, 10  # most and fewest measurements that tell how their stamps and arrivals usually are
_IN_A_ROW = 5  # measurements that must show a leap; an outlying stamp is a single one
# Size from which it may be a leap; how far off whole seconds, as some messages take longer
_SEEMS_S, _WHOLE_S = 0.5, 0.1
# Longest usual time between arrivals: of a slower sensor, the first that are held back would leave the window
_SLOWEST_S = 1.2
# Share of the usual time between arrivals by which one may differ: a late message or a stalled IMU is no leap
_UNEVEN = 0.5
_STEADY = 0.75  # share of the measurements before that must have come with the usual delay
# Least change of the delay from one message to the next: where messages wait longer and longer, each waits at most
# `_UNEVEN` of `_SLOWEST_S` longer than the one before.
_AT_ONCE_S = 0.75
_STEADILY_S = 1.0  # what was held up on its way catches up with the IMU by more
_FUTURE_S = 3.0  # ahead of the IMU all the time: no message is so much faster


@dataclass(frozen=True, slots=True)
class PutRight:
    """The measurements that can be used once a measurement has arrived.

    Attributes:
        found: the measurements, stamps corrected. said: a line for users, or empty.
        earlier_off_ns: by how much the stamps of all measurements before these turn out to have been ahead.
    """

    found: list[Measurement]
    said: str = ""
    earlier_off_ns: int = 0


class SensorClock:
    """Corrects the stamps of one sensor as they arrive, by the stamps of the IMU.

    The clock was set if the stamps leap while sensor and IMU arrive as evenly as before, by the same amount for some
    measurements in a row; these are held back until then. If the IMU's clock is set, the IMU does not go on evenly.
    (Offline, the times of recording tell a leap: `frontends/_clock.py`.) The stamps before or after the leap are right,
    whichever are nearer to the IMU's, as offline: the stamps of a receiver that has yet to learn of leap seconds are
    wrong before it.

    Attributes:
        set_ns: by how much the clock has been set so far; it is subtracted from each stamp.
        ahead: whether the stamps are far ahead of the IMU's, so that all measurements are used at wrong times. (Stamps far behind
            are too late for any use.)
    """

    def __init__(self) -> None:
        self.set_ns, self.ahead = 0, False
        self._ahead_ns: deque[int] = deque(maxlen=_REMEMBERED)  # stamps less that of the newest IMU sample at arrival
        self._apart_ns: deque[int] = deque(maxlen=_REMEMBERED)  # time between arrivals, by the IMU's stamps
        self._imu_ns = 0  # stamp of the newest IMU sample at the last arrival
        self._held: list[tuple[Measurement, int]] = []  # held back, each with the size of its leap, ns
        self._said = False

    def right(self, m: Measurement) -> Measurement:
        """Return a measurement with its stamp corrected by `set_ns`."""
        return replace(m, stamp_ns=m.stamp_ns - self.set_ns) if self.set_ns else m

    def take(self, m: Measurement, imu_ns: int, lag_s: float = 10.0) -> PutRight:
        """Take in a measurement that has arrived.

        Args:
            imu_ns: stamp of the newest IMU sample by then. lag_s: what is older cannot be used.
        """
        m = self.right(m)
        ahead_ns, apart_ns, self._imu_ns = m.stamp_ns - imu_ns, imu_ns - self._imu_ns, imu_ns
        if len(self._ahead_ns) < _FEWEST:
            found = self._learn(m, ahead_ns, apart_ns)
            return self._as_they_come(m) or PutRight(found, self._of_another_clock(m.sensor, lag_s))
        before_ns = median(self._ahead_ns)
        by_ns = ahead_ns - round(before_ns)
        if abs(by_ns) < _SEEMS_S * NS_PER_S and not self._held:
            return PutRight(self._learn(m, ahead_ns, apart_ns))
        usual_ns, whole_ns = median(self._apart_ns), _WHOLE_S * NS_PER_S
        even = 0 < usual_ns <= _SLOWEST_S * NS_PER_S and abs(apart_ns - usual_ns) <= max(_UNEVEN * usual_ns, whole_ns)
        near = sum(abs(each_ns - before_ns) <= whole_ns for each_ns in self._ahead_ns)
        steady = near >= _STEADY * len(self._ahead_ns)
        at_once = abs(ahead_ns - self._ahead_ns[-1]) >= _AT_ONCE_S * NS_PER_S
        alike = not self._held or abs(by_ns - self._held[0][1]) <= _SEEMS_S * NS_PER_S
        if not (even and steady and at_once and alike):
            return PutRight([*self._begin_anew(), m])
        self._held.append((m, by_ns))
        return self._decide() if len(self._held) == _IN_A_ROW else PutRight([])

    def left(self) -> list[Measurement]:
        """Return the measurements that are held back, their leap not corrected, and hold none any more."""
        held, self._held = self._held, []
        return [m for m, _ in held]

    def _learn(self, m: Measurement, ahead_ns: int, apart_ns: int) -> list[Measurement]:
        self._ahead_ns.append(ahead_ns)
        self._apart_ns.append(apart_ns)
        return [m]

    def _as_they_come(self, m: Measurement) -> PutRight | None:
        """Correct stamps no more if they are nearer to the IMU's as they come: the clock was set again in a silence.

        Returns:
            What can be used then; None: the stamps are still to be corrected.
        """
        usual_ns = median(self._ahead_ns)
        if len(self._ahead_ns) < _FEWEST or _wrong(usual_ns + self.set_ns) >= _wrong(usual_ns):
            return None
        m, self.set_ns = replace(m, stamp_ns=m.stamp_ns + self.set_ns), 0
        said = f"{m.sensor}: its clock was set again, unnoticed: its stamps are used as they come from {utc_text(m.stamp_ns)} on"
        return PutRight([*self._begin_anew(), m], said)

    def _of_another_clock(self, sensor: str, lag_s: float) -> str:
        """Return a line for users, once, if all stamps are ahead of the IMU's, or far behind, while the IMU goes on; else empty."""
        least_s, most_s = min(self._ahead_ns) / NS_PER_S, max(self._ahead_ns) / NS_PER_S
        caught_up_s, goes_on = (self._ahead_ns[-1] - self._ahead_ns[0]) / NS_PER_S, median(self._apart_ns) > 0
        off = least_s >= _FUTURE_S or (most_s <= -lag_s and caught_up_s < _STEADILY_S)
        found = len(self._ahead_ns) >= _FEWEST and off and goes_on
        self.ahead = found and least_s > 0.0
        if self._said or not found:
            return ""
        self._said = True
        by = f"{least_s:.1f} s ahead of" if least_s > 0.0 else f"{-most_s:.1f} s behind"
        return f"{sensor}: its stamps are {by} the IMU's: of another clock? (time_offset_s)"

    def _begin_anew(self) -> list[Measurement]:
        self._ahead_ns.clear()
        self._apart_ns.clear()
        self.ahead = False
        return self.left()

    def _decide(self) -> PutRight:
        """Return the measurements that were held back; their stamps are corrected if they leapt by whole seconds."""
        by_s, usual_s = median(by_ns for _, by_ns in self._held) / NS_PER_S, median(self._ahead_ns) / NS_PER_S
        whole_s = round(by_s)
        if not whole_s or abs(by_s - whole_s) > _WHOLE_S:
            return PutRight(self._begin_anew())
        if _wrong(usual_s + by_s) < _wrong(usual_s):
            found = self._begin_anew()
            said = (
                f"{found[0].sensor}: its stamps were {abs(usual_s):.1f} s {'ahead of' if usual_s > 0 else 'behind'} the IMU's "
                f"until {utc_text(found[0].stamp_ns)}, then its clock was set by {whole_s:+d} s: they are used as they come"
            )
            return PutRight(found, said, -whole_s * NS_PER_S)
        self.set_ns += whole_s * NS_PER_S
        found = [replace(m, stamp_ns=m.stamp_ns - whole_s * NS_PER_S) for m in self.left()]
        said = f"{found[0].sensor}: its clock was set {'forward' if whole_s > 0 else 'back'} by {abs(whole_s)} s at {utc_text(found[0].stamp_ns)}"
        if abs(whole_s) == GPS_AHEAD_S:
            said += f", as from {'UTC to GPS time' if whole_s > 0 else 'GPS time to UTC'}"
        return PutRight(found, f"{said}: its stamps are corrected by that from then on")


def _wrong(ahead: float) -> float:
    """Return how wrong stamps are: distance from the IMU's, doubled if ahead: messages come late, but hardly early."""
    return max(-ahead, 2.0 * ahead)
