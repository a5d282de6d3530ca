# SPDX-License-Identifier: Apache-2.0
"""Messages that come twice, as through a bridge: they are no new evidence."""

from __future__ import annotations

from collections.abc import Hashable

from graphloc.measurements import BodyVelocity, CompassHeading, GnssPosition, GnssVelocity, PoseFix

REPEATED = "repeated message: same stamp, same value"
_REMEMBERED = 1000  # messages; what is repeated later comes too late to be used, too


class Repeats:
    """Tells which of a sensor's measurements repeat the stamp and the value of an earlier one."""

    def __init__(self) -> None:
        self._seen: dict[Hashable, None] = {}

    def repeats(self, stamp_ns: int, value: object) -> bool:
        """Return whether a measurement repeats an earlier one, and remember it."""
        content = _content(value)
        if content is None:
            return False
        key = (stamp_ns, content)
        if key in self._seen:
            return True
        self._seen[key] = None
        if len(self._seen) > _REMEMBERED:
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
