# SPDX-License-Identifier: Apache-2.0
"""A sensor's clock that is set by whole seconds in mid-run: a receiver learns of leap seconds, or goes from UTC to GPS time.

Its next fixes seem to come from the future, or long after; used at their stamps they are seconds of motion off.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from statistics import median

from graphloc.measurements import Measurement
from graphloc.time import GPS_AHEAD_S, NS_PER_S, utc_text

_REMEMBERED, _FEWEST = 20, 10  # measurements that tell how their stamps and arrival usually are
_IN_A_ROW = 5  # measurements after a leap that tell it: an outlying stamp is one
_SEEMS_S, _WHOLE_S = 0.5, 0.1  # by which it seems to be one, and may be off whole seconds, as some messages take longer
_SLOWEST_S = 1.2  # between arrivals: of slower sensors the first ones held back would leave the window meanwhile
_UNEVEN = 0.5  # of the usual time between arrivals: a message that waited, or an IMU that stalled, is no leap
_STEADY = 0.75  # of those before, that came alike
_AT_ONCE_S = 0.75  # between two messages, at the least: where they wait longer and longer each does by `_UNEVEN` of `_SLOWEST_S` at most
_FUTURE_S = 3.0  # ahead of the IMU, all the time: no message is that much faster


@dataclass(frozen=True, slots=True)
class PutRight:
    """What can be used now that a measurement has come.

    Attributes:
        found: measurements, put right. said: what is to be said, or nothing.
        earlier_off_ns: by how much all stamps before these were ahead, as has turned out by now.
    """

    found: list[Measurement]
    said: str = ""
    earlier_off_ns: int = 0


class SensorClock:
    """Puts right the stamps of one sensor as they arrive, by those of the IMU.

    A leap is one that comes while both arrive as evenly as before, and that is the same for some measurements in a row, which are held
    back so long. An IMU whose clock is set does not go on evenly. (Offline the times of recording tell it: `frontends/_clock.py`.)
    Of the stamps before and after, those nearer to the IMU's are right, as offline: a receiver that learns of leap seconds begins with wrong
    ones.

    Attributes:
        set_ns: by how much the clock has been set so far; it is taken off each stamp.
    """

    def __init__(self) -> None:
        self.set_ns = 0
        self._ahead_ns: deque[int] = deque(maxlen=_REMEMBERED)  # of the IMU's newest sample, when they came
        self._apart_ns: deque[int] = deque(maxlen=_REMEMBERED)  # time of the IMU between arrivals
        self._imu_ns = 0  # newest sample at the last arrival
        self._held: list[tuple[Measurement, int]] = []  # each with its leap, ns
        self._said = False

    def right(self, m: Measurement) -> Measurement:
        """Return a measurement with its stamp put right by what is known so far."""
        return replace(m, stamp_ns=m.stamp_ns - self.set_ns) if self.set_ns else m

    def take(self, m: Measurement, imu_ns: int) -> PutRight:
        """Take in a measurement that has arrived; `imu_ns`: stamp of the newest IMU sample by then."""
        m = self.right(m)
        ahead_ns, apart_ns, self._imu_ns = m.stamp_ns - imu_ns, imu_ns - self._imu_ns, imu_ns
        if len(self._ahead_ns) < _FEWEST:
            found = self._learn(m, ahead_ns, apart_ns)
            return self._as_they_come(m) or PutRight(found, self._from_the_future(m.sensor))
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
        """Return what is held back, as it came."""
        held, self._held = self._held, []
        return [m for m, _ in held]

    def _learn(self, m: Measurement, ahead_ns: int, apart_ns: int) -> list[Measurement]:
        self._ahead_ns.append(ahead_ns)
        self._apart_ns.append(apart_ns)
        return [m]

    def _as_they_come(self, m: Measurement) -> PutRight | None:
        """Put stamps right no more where they are nearer to the IMU's as they come: the clock was set again while the sensor was silent."""
        usual_ns = median(self._ahead_ns)
        if len(self._ahead_ns) < _FEWEST or _wrong(usual_ns + self.set_ns) >= _wrong(usual_ns):
            return None
        m, self.set_ns = replace(m, stamp_ns=m.stamp_ns + self.set_ns), 0
        said = f"{m.sensor}: its clock was set again, unseen: its stamps are used as they come from {utc_text(m.stamp_ns)} on"
        return PutRight([*self._begin_anew(), m], said)

    def _from_the_future(self, sensor: str) -> str:
        """Return what is to be said, once, where all stamps are ahead of the IMU's while it goes on."""
        least_s, goes_on = min(self._ahead_ns) / NS_PER_S, median(self._apart_ns) > 0
        if self._said or len(self._ahead_ns) < _FEWEST or least_s < _FUTURE_S or not goes_on:
            return ""
        self._said = True
        return f"{sensor}: its stamps are {least_s:.1f} s ahead of the IMU's: of another clock? (time_offset_s)"

    def _begin_anew(self) -> list[Measurement]:
        self._ahead_ns.clear()
        self._apart_ns.clear()
        return self.left()

    def _decide(self) -> PutRight:
        """Return what is held back, put right where it is by whole seconds."""
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
        return PutRight(found, f"{said}: its stamps are put right by that from there on")


def _wrong(ahead: float) -> float:
    """Return how far stamps are off the IMU's; twice as far where they are ahead of it: a message may come late, but hardly early."""
    return max(-ahead, 2.0 * ahead)
