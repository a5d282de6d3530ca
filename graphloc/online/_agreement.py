# SPDX-License-Identifier: Apache-2.0
"""Whether what measures place agrees with the estimate: when each sensor last did, and for how long none has."""

from __future__ import annotations

import numpy as np

from graphloc.graph import Attachment
from graphloc.measurements import Measurement
from graphloc.online._live import LiveStream, LiveTimeline
from graphloc.solve._decide import AGREES, Verdict

_CREDIBLE = 6.0  # sigmas of a slow error: beyond, a sensor that agrees does so by an error that it does not have
_USUAL = 3.0  # sigmas of one that jumps: beyond, what it jumped from may be the wrong level
_FEW = 8  # measurements of absolute sensors in a row that disagree: not yet a sign
_LOST_S, _DENIES = 15.0, 3  # of disagreement, until the estimate is; what of a sensor in a row disagrees
_JUMPED_S = (60.0, 200.0)  # a jump lasts no longer than that; while another level has been held for long


class Agreement:
    """Of absolute sensors with the estimate.

    Attributes:
        agreed_ns: of each, the stamp of the last measurement that agreed.
    """

    def __init__(self, timeline: LiveTimeline) -> None:
        self._timeline = timeline
        self.agreed_ns: dict[str, int] = {}
        self._refused: list[int] = []  # stamps of absolute measurements since the last that agreed: the first few
        self._denied: dict[str, int] = {}  # by sensor: how many in a row disagreed, by whatever error it may have
        self._usual_ns: tuple[int, int] | None = None  # from when to when one was where it usually is
        self._jumped_ns: int | None = None  # since when all that agree do so by a jump

    def note(self, stream: LiveStream, m: Measurement, verdict: Verdict | None) -> None:
        """Remember how a measurement was judged; None: it was refused unjudged."""
        if not stream.row.absolute:
            return
        agrees = verdict is not None and verdict.weight >= AGREES
        self._denied[stream.name] = 0 if agrees else self._denied.get(stream.name, 0) + 1
        if verdict is not None and agrees:
            self._note_level(m.stamp_ns, usual=_jumped(stream, verdict.at) <= _USUAL)
        if verdict is not None and agrees and _credible(stream, verdict.at):
            self.agreed_ns[stream.name] = max(m.stamp_ns, self.agreed_ns.get(stream.name, m.stamp_ns))
            self._refused = [stamp for stamp in self._refused if stamp > m.stamp_ns]
            self._denied.clear()
            return
        if len(self._refused) < _FEW:
            self._refused.append(m.stamp_ns)

    def _note_level(self, stamp_ns: int, *, usual: bool) -> None:
        if usual:
            self._usual_ns = (self._usual_ns or (stamp_ns, stamp_ns))[0], stamp_ns
            self._jumped_ns = None
        elif self._jumped_ns is None:
            self._jumped_ns = stamp_ns

    def forget_refused(self) -> None:
        """Of what disagreed, a receiver is known to be wrong: nothing says any more that it is elsewhere."""
        self._refused = []
        self._denied.clear()
        self._jumped_ns = None

    def marked(self) -> _Mark:
        """Return what is remembered, for `back_to`."""
        return dict(self.agreed_ns), list(self._refused), dict(self._denied), self._usual_ns, self._jumped_ns

    def back_to(self, mark: _Mark) -> None:
        """Forget what was noted since: it agreed with what has been given up."""
        self.agreed_ns, self._refused, self._denied, self._usual_ns, self._jumped_ns = mark

    def lost_s(self, now_ns: int) -> float:
        """For how long absolute sensors have said that the estimate is elsewhere, and none that it is here; 0: not for so long that it is lost.

        Where all agree, but by an error that has jumped, the estimate is right as long as a jump lasts; and the longer, the
        longer they stood at the level before it.
        """
        seconds = self._timeline.seconds
        if len(self._refused) >= _FEW and any(in_a_row >= _DENIES for in_a_row in self._denied.values()):
            denied_s = seconds(now_ns) - seconds(self._refused[0])
            if denied_s > _LOST_S:
                return denied_s
        if self._jumped_ns is None:
            return 0.0
        begin, end = (seconds(ns) for ns in self._usual_ns or (self._jumped_ns, self._jumped_ns))
        jumped_s = seconds(now_ns) - seconds(self._jumped_ns)
        return jumped_s if jumped_s > float(np.clip(end - begin, *_JUMPED_S)) else 0.0


_Mark = tuple[dict[str, int], list[int], dict[str, int], tuple[int, int] | None, int | None]


def _credible(stream: LiveStream, at: Attachment) -> bool:
    """Whether a sensor agrees by an error that it may have."""
    if stream.slow is None or at.slow_value is None:
        return True
    return bool((np.abs(at.slow_value) <= _CREDIBLE * stream.slow.sigma).all())


def _jumped(stream: LiveStream, at: Attachment) -> float:
    """By how many sigmas a sensor agrees that may stand far off; 0 for any other."""
    if stream.slow is None or at.slow_value is None:
        return 0.0
    far = [axis in stream.slow.far for axis in stream.slow.axes]
    return float(np.linalg.norm(at.slow_value[far] / stream.slow.sigma[far]))
