# SPDX-License-Identifier: Apache-2.0
"""Anchors and measurements that the window can be rebuilt from."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

from graphloc.measurements import ImuSample, Measurement
from graphloc.online._anchor import Anchor
from graphloc.online._lag import Lag

_EVERY_S = 1.0  # between two anchors: as long as a page of the window (`_live`)


class Recent:
    """Anchors of the window, one per second, and all measurements that arrived since the oldest anchor.

    An anchor is the estimate of a state as it was when that state was the newest. So measurements with later stamps can
    be used again without counting twice.
    """

    def __init__(self) -> None:
        self.anchors: deque[Anchor] = deque()
        self._came: list[Measurement] = []
        self._before: ImuSample | None = None  # the last sample before the oldest anchor

    def begin(self, anchor: Anchor, came: Iterable[Measurement], before: ImuSample | None = None) -> None:
        """Begin anew, with a window that begins at an anchor.

        Args:
            came: its measurements. before: the last IMU sample at the anchor or before it, if it is not among these.
        """
        self.anchors = deque([anchor])
        self._before, self._came = before, list(came)

    def keep(self, m: Measurement) -> None:
        """Keep a measurement, whatever its stamp."""
        self._came.append(m)

    def keep_anchor(self, lag: Lag, keep_ns: Sequence[tuple[int, int]] = (), since_ns: int | None = None) -> bool:
        """Keep the newest state as an anchor if one is due, and forget measurements older than the oldest anchor.

        Args:
            lag: the window. keep_ns: spans (stamps) whose IMU samples are kept, however old.
            since_ns: stamp from which everything is kept, even if the oldest anchor is newer; None: from the oldest
                anchor on.

        Returns:
            Whether an anchor was due.
        """
        at_ns, anchors = lag.newest.stamp_ns, self.anchors
        if anchors and at_ns - anchors[-1].stamp_ns < _EVERY_S * 1e9:
            return False
        anchors.append(lag.anchor())
        while anchors[0].stamp_ns < lag.first_ns:
            anchors.popleft()
        kept, first_ns = [], anchors[0].stamp_ns if since_ns is None else min(since_ns, anchors[0].stamp_ns)
        for m in self._came:
            if m.stamp_ns >= first_ns or (isinstance(m, ImuSample) and any(a <= m.stamp_ns <= b for a, b in keep_ns)):
                kept.append(m)
            elif isinstance(m, ImuSample) and (self._before is None or m.stamp_ns > self._before.stamp_ns):
                self._before = m
        self._came = kept
        return True

    def forget_anchors(self, since_ns: int) -> None:
        """Forget the anchors from a stamp on, which have turned out to be wrong; the oldest anchor is always kept."""
        while len(self.anchors) > 1 and self.anchors[-1].stamp_ns >= since_ns:
            self.anchors.pop()

    def forget(self, measurements: Iterable[Measurement]) -> None:
        """Forget measurements that are not to be used again."""
        out = {id(m) for m in measurements}  # not by arrival number, which is -1 for several
        self._came = [m for m in self._came if id(m) not in out]

    def leave_out(self, after_ns: int) -> list[ImuSample]:
        """Take out the IMU samples after a stamp and return them."""
        out = [m for m in self._came if isinstance(m, ImuSample) and m.stamp_ns > after_ns]
        self._came = [m for m in self._came if not isinstance(m, ImuSample) or m.stamp_ns <= after_ns]
        return out

    def __iter__(self) -> Iterator[Measurement]:
        """All measurements, in order of arrival."""
        return iter(self._came)

    def others(self) -> list[Measurement]:
        """Return all measurements but the IMU samples, in order of arrival."""
        return [m for m in self._came if not isinstance(m, ImuSample)]

    def samples(self) -> list[ImuSample]:
        """Return the IMU samples by stamp, with the last one before the oldest anchor."""
        found = [m for m in self._came if isinstance(m, ImuSample)]
        return sorted([*([self._before] if self._before else []), *found], key=lambda m: m.stamp_ns)

    def sample_at(self, anchor: Anchor) -> ImuSample | None:
        """Return the last IMU sample at or before an anchor."""
        return next((m for m in reversed(self.samples()) if m.stamp_ns <= anchor.stamp_ns), None)
