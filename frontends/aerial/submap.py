# SPDX-License-Identifier: Apache-2.0
"""The scans that are matched together: one, and scans from other places in the seconds before and after it.

One scan among moored boats shows a few of their sides, which look like the boats of the next berths. A longer piece of
the row, with its gaps and the quay at its end, is unique.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from graphloc.config import AerialConfig
from graphloc.frames import Array
from graphloc.frontends.aerial.cloud import Cloud
from graphloc.frontends.aerial.scan import inside
from graphloc.recording import Mounts
from graphloc.time import NS_PER_S

# Least distance and time between turns that are kept: nearer ones show the same; of a fast vessel two a second suffice.
_APART_M, _APART_NS = 0.5, NS_PER_S // 2
_LATE_NS = NS_PER_S  # scans that arrive out of order are not later than this
_MOST_POINTS = 20_000  # most points of another turn
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """One scan of each LiDAR, or the reason why one of them cannot be used.

    Attributes:
        stamp_ns: of the newest scan; of a message without a stamp, its arrival.
        arrival_ns: arrival of the message that completed the turn: its last, or the first of the next one if a LiDAR is
            missing. Turns come in this order.
        clouds: the scans. why_not: why the turn cannot be used; '' if it can.
    """

    stamp_ns: int
    arrival_ns: int
    clouds: tuple[Cloud, ...]
    why_not: str = ""

    @property
    def last_ns(self) -> int:
        """Stamp of the last point, or of the newest scan if that is later: headers may tell the beginning of a scan."""
        return max([self.stamp_ns, *(int(c.stamps_ns.max()) for c in self.clouds if len(c.stamps_ns))])


def is_set_back(stamp_ns: int, before_ns: int) -> bool:
    """Return whether a stamp is so far before an earlier one that the clock was set back, rather than the scan late."""
    return stamp_ns < before_ns - _LATE_NS


class Submap:
    """Turns that are matched together.

    Args:
        config: of the aerial sensor. mounts: (t (3,) m, R (3, 3)) in body of each LiDAR, by name.
        around_s: largest difference in time of turns that are matched with the newest one.
    """

    def __init__(self, config: AerialConfig, mounts: Mounts, around_s: float) -> None:
        self._mounts, self._around_ns = mounts, round(around_s * NS_PER_S)
        self._hull = np.array(config.hull_m, dtype=float) if config.hull_m else None
        self._newest: deque[Turn] = deque(maxlen=config.submap)
        self._shown: deque[Turn] = deque(maxlen=config.submap)
        self._kept: deque[tuple[Array, int, list[Cloud]]] = deque()  # position and stamp of a turn, and its clouds

    def show(self, turn: Turn, place_m: Array) -> None:
        """Keep a turn, seen from a position (2,) in world, m, for other turns; it may be ahead of the newest turn."""
        self._shown.append(turn)
        # After a clock was set back, kept turns would be placed elsewhere on the track.
        if self._kept and is_set_back(turn.stamp_ns, self._kept[-1][1]):
            self._kept.clear()
        if self._is_apart(turn.stamp_ns, place_m):
            kept_ns = self._kept[-1][1] if self._kept else -1
            clouds = _thinned([c for t in self._shown if t.stamp_ns > kept_ns for c in t.clouds])
            self._kept.append((place_m, turn.stamp_ns, [self._of_others(c) for c in clouds]))

    def take(self, turn: Turn) -> None:
        """Make a turn the newest one."""
        self._newest.append(turn)
        while self._kept and self._kept[0][1] < turn.stamp_ns - self._around_ns:
            self._kept.popleft()

    @property
    def newest(self) -> Turn:
        """The last turn that was taken."""
        return self._newest[-1]

    def clouds(self) -> tuple[list[Cloud], list[list[Cloud]]]:
        """Return the clouds of the newest turns, and those of each kept turn that is near in time and has points.

        The vessel's own points are left out here, in the axes of body: where she heels, her mast is not above her hull.
        """
        now = [self._of_others(c) for turn in self._newest for c in turn.clouds]
        held, at_ns = {(c.lidar, c.stamp_ns) for c in now}, self.newest.stamp_ns
        near = [clouds for _, stamp_ns, clouds in self._kept if abs(stamp_ns - at_ns) <= self._around_ns]
        others = [[c for c in clouds if len(c.points_m) and (c.lidar, c.stamp_ns) not in held] for clouds in near]
        return now, [clouds for clouds in others if clouds]

    def _is_apart(self, stamp_ns: int, place_m: Array) -> bool:
        if not self._kept:
            return True
        there_m, then_ns, _ = self._kept[-1]
        return stamp_ns - then_ns >= _APART_NS and float(np.hypot(*(place_m - there_m))) >= _APART_M

    def _of_others(self, cloud: Cloud) -> Cloud:
        """Return a cloud without the vessel herself; in other turns, she would lie along her way."""
        if self._hull is None:
            return cloud
        t, R = self._mounts[cloud.lidar]
        return cloud.where(~inside(self._hull, (cloud.points_m @ R.T + t)[:, :2]))


def _thinned(clouds: list[Cloud]) -> list[Cloud]:
    """Return clouds with about `_MOST_POINTS` points in all, if they have more."""
    share = _MOST_POINTS / max(sum(len(c.points_m) for c in clouds), 1)
    # A low-discrepancy sequence: every n-th point may be of one beam.
    return [c.where((_GOLDEN * np.arange(len(c.points_m))) % 1.0 < share) for c in clouds]
