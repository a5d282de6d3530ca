# SPDX-License-Identifier: Apache-2.0
"""Whether what measures place agrees with the estimate: when each sensor last did, and for how long none has."""

from __future__ import annotations

import numpy as np

from graphloc.graph import Attachment
from graphloc.measurements import Measurement
from graphloc.online._live import LiveStream, LiveTimeline
from graphloc.solve._decide import Verdict
from graphloc.solve._solution import AGREES

_CREDIBLE = 6.0  # sigmas of a slow error: beyond, a sensor that agrees does so by an error that it does not have
_FEW = 8  # measurements of absolute sensors in a row that disagree: not yet a sign
_LOST_S = 15.0  # of disagreement, until the estimate is
_STRAINED_S, _DENIES = 60.0, 3  # if all agree, but by such an error; what of a sensor in a row disagrees in spite of it


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

    def note(self, stream: LiveStream, m: Measurement, verdict: Verdict | None) -> None:
        """Remember how a measurement was judged; None: it was refused unjudged."""
        if not stream.row.absolute:
            return
        agrees = verdict is not None and verdict.weight >= AGREES
        self._denied[stream.name] = 0 if agrees else self._denied.get(stream.name, 0) + 1
        if verdict is not None and agrees and _credible(stream, verdict.at):
            self.agreed_ns[stream.name] = max(m.stamp_ns, self.agreed_ns.get(stream.name, m.stamp_ns))
            self._refused = [stamp for stamp in self._refused if stamp > m.stamp_ns]
            self._denied.clear()
            return
        if len(self._refused) < _FEW:
            self._refused.append(m.stamp_ns)

    def forget_refused(self) -> None:
        """Of what disagreed, a receiver is known to be wrong: nothing says any more that it is elsewhere."""
        self._refused = []
        self._denied.clear()

    def marked(self) -> tuple[dict[str, int], list[int], dict[str, int]]:
        """Return what is remembered, for `back_to`."""
        return dict(self.agreed_ns), list(self._refused), dict(self._denied)

    def back_to(self, mark: tuple[dict[str, int], list[int], dict[str, int]]) -> None:
        """Forget what was noted since: it agreed with what has been given up."""
        self.agreed_ns, self._refused, self._denied = mark

    def lost_s(self, now_ns: int) -> float:
        """For how long absolute sensors have said that the estimate is elsewhere, and none that it is here; 0: not for so long that it is lost.

        A jump of a receiver's error to 20 m ends within a minute, and till then the estimate is right.
        """
        if len(self._refused) < _FEW:
            return 0.0
        seconds = self._timeline.seconds
        for_s = seconds(now_ns) - seconds(self._refused[0])
        denied = any(in_a_row >= _DENIES for in_a_row in self._denied.values())
        return for_s if for_s > (_LOST_S if denied else _STRAINED_S) else 0.0


def _credible(stream: LiveStream, at: Attachment) -> bool:
    """Whether a sensor agrees by an error that it may have."""
    if stream.slow is None or at.slow_value is None:
        return True
    return bool((np.abs(at.slow_value) <= _CREDIBLE * stream.slow.sigma).all())
