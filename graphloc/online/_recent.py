# SPDX-License-Identifier: Apache-2.0
"""What a lag can be built anew from."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

from graphloc.measurements import ImuSample, Measurement
from graphloc.online._anchor import Anchor
from graphloc.online._lag import Lag

_EVERY_S = 1.0


class Recent:
    """Anchors of the lag, one a second, and all that came since the oldest of them.

    An anchor holds what was known when its state was the newest, so what was measured since can be taken again.
    """

    def __init__(self) -> None:
        self.anchors: deque[Anchor] = deque()
        self._came: list[Measurement] = []
        self._before: ImuSample | None = None  # the last sample before the oldest anchor

    def clear(self) -> None:
        """Forget all."""
        self.anchors.clear()
        self._came, self._before = [], None

    def begin(self, came: Iterable[Measurement]) -> None:
        """A lag has begun with these."""
        self._came = list(came)

    def resume(self, anchor: Anchor, before: ImuSample, came: ImuSample) -> None:
        """A lag goes on from an anchor, the sample at it or before, and the first since."""
        self.anchors = deque([anchor])
        self._before, self._came = before, [came]

    def keep(self, m: Measurement) -> None:
        """Keep what came: where its stamp is does not matter."""
        self._came.append(m)

    def keep_anchor(self, lag: Lag) -> bool:
        """Remember the newest state, if that is due, and forget what came before the oldest; tell whether it was due."""
        at_ns, anchors = lag.newest.stamp_ns, self.anchors
        if anchors and at_ns - anchors[-1].stamp_ns < _EVERY_S * 1e9:
            return False
        anchors.append(lag.anchor())
        while anchors[0].stamp_ns < lag.first_ns:
            anchors.popleft()
        kept = []
        for m in self._came:
            if m.stamp_ns >= anchors[0].stamp_ns:
                kept.append(m)
            elif isinstance(m, ImuSample) and (self._before is None or m.stamp_ns > self._before.stamp_ns):
                self._before = m
        self._came = kept
        return True

    def __iter__(self) -> Iterator[Measurement]:
        """All that came, in the order of arrival."""
        return iter(self._came)

    def others(self) -> list[Measurement]:
        """Return what came that is no sample of the IMU, in the order of arrival."""
        return [m for m in self._came if not isinstance(m, ImuSample)]

    def samples(self) -> list[ImuSample]:
        """Return the IMU's samples, one before the oldest anchor among them, by stamp."""
        found = [m for m in self._came if isinstance(m, ImuSample)]
        return sorted([*([self._before] if self._before else []), *found], key=lambda m: m.stamp_ns)

    def sample_at(self, anchor: Anchor) -> ImuSample | None:
        """Return the last sample at an anchor or before."""
        return next((m for m in reversed(self.samples()) if m.stamp_ns <= anchor.stamp_ns), None)
