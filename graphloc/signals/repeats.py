# SPDX-License-Identifier: Apache-2.0
"""Messages that come twice, as through a bridge: they are no new evidence."""

from __future__ import annotations

from collections.abc import Hashable

from graphloc.measurements import BodyVelocity, CompassHeading, GnssPosition, GnssVelocity, PoseFix

REPEATED = "repeated message: same stamp, same value"


class Repeats:
    """Tells which of a sensor's measurements repeat the stamp and the value of an earlier one.

    Args:
        most: how many of the newest are remembered; None: all.
    """

    def __init__(self, most: int | None = None) -> None:
        self._most, self._seen = most, dict[Hashable, None]()

    def forget(self) -> None:
        """Forget all: another clock may show the same stamps again."""
        self._seen.clear()

    def repeats(self, stamp_ns: int, value: object) -> bool:
        """Return whether a measurement repeats an earlier one, and remember it."""
        content = _content(value)
        if content is None:
            return False
        key = (stamp_ns, content)
        if key in self._seen:
            return True
        self._seen[key] = None
        if self._most is not None and len(self._seen) > self._most:
            del self._seen[next(iter(self._seen))]
        return False


def _content(value: object) -> Hashable:
    """Return what a measurement says; None of kinds whose messages are not compared."""
    match value:
        case GnssPosition():
            return value.position
        case CompassHeading():
            return value.yaw_rad
        case GnssVelocity():
            return tuple(value.v_enu_mps)
        case BodyVelocity():
            return tuple(value.value)
        case PoseFix():
            return tuple(value.modes[0].value)
    return None
