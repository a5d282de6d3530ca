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


class Agreement:
    """Of absolute sensors with the estimate.

    Attributes:
        agreed_ns: of each, the stamp of the last measurement that agreed.
    """

    def __init__(self, timeline: LiveTimeline) -> None:
        self._timeline = timeline
        self.agreed_ns: dict[str, int] = {}
        self._refused: list[int] = []  # stamps of absolute measurements since the last that agreed: the first few

    def note(self, stream: LiveStream, m: Measurement, verdict: Verdict | None) -> None:
        """Remember how a measurement was judged; None: it was refused unjudged."""
        if not stream.row.absolute:
            return
        if verdict is not None and verdict.weight >= AGREES and _credible(stream, verdict.at):
            self.agreed_ns[stream.name] = max(m.stamp_ns, self.agreed_ns.get(stream.name, m.stamp_ns))
            self._refused = [stamp for stamp in self._refused if stamp > m.stamp_ns]
        elif len(self._refused) < _FEW:
            self._refused.append(m.stamp_ns)

    def forget_refused(self) -> None:
        """Of what disagreed, a receiver is known to be wrong: nothing says any more that it is elsewhere."""
        self._refused = []

    def marked(self) -> tuple[dict[str, int], list[int]]:
        """Return what is remembered, for `back_to`."""
        return dict(self.agreed_ns), list(self._refused)

    def back_to(self, mark: tuple[dict[str, int], list[int]]) -> None:
        """Forget what was noted since: it agreed with what has been given up."""
        self.agreed_ns, self._refused = mark

    def refused_s(self, now_ns: int) -> float:
        """For how long absolute sensors have said, more than a few times, that it is elsewhere, and none that it is here."""
        if len(self._refused) < _FEW:
            return 0.0
        return self._timeline.seconds(now_ns) - self._timeline.seconds(self._refused[0])


def _credible(stream: LiveStream, at: Attachment) -> bool:
    """Whether a sensor agrees by an error that it may have."""
    if stream.slow is None or at.slow_value is None:
        return True
    return bool((np.abs(at.slow_value) <= _CREDIBLE * stream.slow.sigma).all())
