# SPDX-License-Identifier: Apache-2.0
"""When a heading that no sensor measured is a guess, and when no longer: measured, or confirmed by the motion."""

from __future__ import annotations

from collections import deque

from graphloc.estimate import Event
from graphloc.online._heading_check import HeadingCheck
from graphloc.online._start import LEAST_S
from graphloc.online._unmeasured_heading import UnmeasuredHeading
from graphloc.time import duration_ns

_FEWEST, _KEPT = 3, 1000  # fewest measurements of the heading that end a guess; most that are remembered


class HeadingGuess:
    """Measurements of the heading since a window began without one, and whether users were told that it is a guess."""

    def __init__(self) -> None:
        self._measured_ns: deque[int] = deque(maxlen=_KEPT)
        self._said = False

    def note(self, stamp_ns: int) -> None:
        """Note that a sensor has measured the heading."""
        self._measured_ns.append(stamp_ns)

    def measured(self, first_ns: int, newest_ns: int) -> bool:
        """Return whether sensors have measured the heading in a window, for as long as a start takes.

        Args:
            first_ns, newest_ns: stamps of the window's ends.
        """
        told_ns = [at_ns for at_ns in self._measured_ns if at_ns >= first_ns]
        return len(told_ns) >= _FEWEST and newest_ns - min(told_ns) >= duration_ns(LEAST_S)

    def follow(
        self, known: UnmeasuredHeading, check: HeadingCheck, first_ns: int, newest_ns: int
    ) -> tuple[UnmeasuredHeading | None, list[Event]]:
        """Return how far the heading may be off by now, and new events.

        The first is None once sensors measure the heading or the motion confirms it.

        Args:
            known: how far it might be off before. check: what the motion says of it. first_ns, newest_ns: ends of the
                window.
        """
        known = known.narrowed(check.looked_ns, check.within_rad)
        why, said = known.doubt(newest_ns), self._said
        if check.confirmed or (not why and self.measured(first_ns, newest_ns)):
            self._said = False
            confirmed = Event("the motion confirms the heading: it is no longer a guess", warns=False)
            return None, [confirmed] if said and check.confirmed else []
        self._said = said or bool(why)
        return known, [Event(why, heading_guessed=True)] if why and not said else []
