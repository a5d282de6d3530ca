# SPDX-License-Identifier: Apache-2.0
"""Matching of scans, one turn at a time, around a track that may still grow; used offline and online."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from graphloc.config import AerialConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.frontends.aerial.bl import BLMatcher
from graphloc.frontends.aerial.cloud import level
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.matcher import Match, Matcher, Prior, Since
from graphloc.frontends.aerial.submap import Submap, Turn
from graphloc.recording import Mounts
from graphloc.time import NS_PER_S, stamps_of
from graphloc.trajectory import Trajectory

_JITTER_S = 0.05  # jitter of stamps
_AHEAD_NS = 300_000_000  # an IMU's messages are no later than this; a stamp farther ahead is of another clock


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """A match and its stamp, or the reason why there is none.

    Attributes:
        stamp_ns, match: None: there is none. why_not: reason; '' if there is a mode.
        since: distance and time from the match before; None: there is none.
    """

    stamp_ns: int
    match: Match | None
    why_not: str
    since: Since | None = None


class Pace:
    """Which turns are due, at the configured interval."""

    def __init__(self, config: AerialConfig) -> None:
        self._config = config
        self._last: tuple[Array, int] | None = None  # position and stamp of the last turn that was due

    def is_due(self, stamp_ns: int, track: Trajectory) -> bool:
        """Return whether a turn is due; if it is, the interval to the next one starts with it."""
        config, here = self._config, track.at(np.array([stamp_ns])).p_world_m[0, :2]
        if self._last is not None:
            moved_m = float(np.hypot(*(here - self._last[0])))
            waited_s = (stamp_ns - self._last[1]) / 1e9
            too_soon = waited_s < config.every_s - _JITTER_S or (moved_m < config.every_m and waited_s < config.still_s)
            if waited_s >= 0.0 and too_soon:  # after a clock was set back, the next turn is due
                return False
        self._last = (here, stamp_ns)
        return True


class LiveMatcher:
    """Matches turns as they come, at the configured interval.

    It may be called by one thread at a time. It holds open files, so another process makes a matcher of its own: the
    arguments, turns and tracks can be pickled. So can results, but a `Match` holds the map around it (some 50 MB): send
    its `fix`. Do not fork: numba's OpenMP threads do not survive that.

    Args:
        config: of the aerial sensor. folder: base of relative paths of maps. datum: origin of world.
        mounts: (t (3,) m, R (3, 3)) in body of each LiDAR, by name.
        around_s: largest difference in time of turns that were shown and the turn with which they are matched.

    Raises:
        InputError: a map cannot be used.
    """

    def __init__(
        self, config: AerialConfig, folder: Path, datum: Datum, mounts: Mounts, *, around_s: float = 0.0
    ) -> None:
        self._config, self._mounts = config, mounts
        self._matcher = _matcher(config, folder, datum)
        self._submap = Submap(config, mounts, around_s)
        self._pace = Pace(config)
        self._before: tuple[Array, int] | None = None  # position and stamp of the last match that had a mode

    def offer(self, turn: Turn, track: Trajectory, *, growing: bool = True) -> Matched | Literal["wait"] | None:
        """Match a turn if it is due. Turns are offered in order; after "wait" the same turn is offered again.

        Args:
            turn: to match. track: body in world around the turn, two poses or more. The submap is placed by this track
                alone, without parts that it no longer covers.
            growing: whether the track will extend further; otherwise nothing waits.

        Returns:
            A match, or why there is none, if the turn is damaged or outside the track for good. None: it is not due.
            "wait": the track ends slightly before the turn; nothing has changed.
        """
        if turn.why_not:
            return Matched(turn.stamp_ns, None, turn.why_not)
        end_ns = int(track.stamps_ns[-1])
        if growing and turn.stamp_ns <= end_ns + _AHEAD_NS and turn.last_ns > end_ns:
            return "wait"
        if why_not := outside(turn, track):
            return Matched(turn.stamp_ns, None, why_not)
        self.take(turn)
        if not self._pace.is_due(turn.stamp_ns, track):
            return None
        item = self.match(track)
        if item.match is not None and item.match.modes:
            here = (item.match.prior.pose[:2], item.stamp_ns)
            if self._before is not None and self._config.alike_m > 0.0:
                way_m = float(np.hypot(*(here[0] - self._before[0])))
                alike_m = max(self._config.alike_m, item.match.distance_m)
                item = replace(item, since=Since(way_m / alike_m, abs(here[1] - self._before[1]) / NS_PER_S))
            self._before = here
        return item

    def show(self, turn: Turn, track: Trajectory) -> None:
        """Show a turn, if it can be used, with which other turns may be matched; it need not have been offered yet."""
        if not turn.why_not and not outside(turn, track):
            self._submap.show(turn, track.at(np.array([turn.stamp_ns])).p_world_m[0, :2])

    def take(self, turn: Turn) -> None:
        """Make a turn, which a track covers, the newest one."""
        self._submap.take(turn)

    def match(self, track: Trajectory) -> Matched:
        """Match the newest turn, together with others that were shown, whether due or not."""
        newest, config = self._submap.newest, self._config
        stamps = np.sort(np.concatenate([c.stamps_ns for c in newest.clouds] + [np.array([newest.stamp_ns])]))
        at_ns = int(stamps[len(stamps) // 2])  # numpy's median would go through floats
        try:
            now, others = self._submap.clouds()
            cloud = level(now, self._mounts, track, at_ns, config.waterline_m, others)
            pose = track.at(np.array([at_ns]))
            sigma = np.array([1.0, 1.0, np.radians(2.0)])
            if pose.cov is not None:
                sigma = np.sqrt(np.diagonal(pose.cov[0])[[0, 1, 5]])
            prior = Prior(np.array([*pose.p_world_m[0, :2], pose.yaw_rad[0]]), sigma)
            found = self._matcher.match(cloud, prior)
        except InputError as error:
            return Matched(at_ns, None, str(error))
        return Matched(at_ns, found, found.why_not)


def outside(turn: Turn, track: Trajectory) -> str:
    """Return a line on the scans of a turn if any is outside a track; '' if none is."""
    stamps = stamps_of(turn.clouds)
    if track.covers(stamps).all():
        return ""
    off_s = (stamps - track.stamps_ns[0]) / 1e9
    names = ", ".join(f"{c.lidar} {t:+.1f} s" for c, t in zip(turn.clouds, off_s, strict=True))
    return f"scans outside of the track, from its begin: {names}"


def _matcher(config: AerialConfig, folder: Path, datum: Datum) -> Matcher | BLMatcher:
    if config.matcher == "posterior":
        return Matcher(config, folder, datum)
    if not config.image:
        raise InputError("vessel.yaml: an aerial sensor with matcher: bl needs an `image`")
    return BLMatcher(config, AerialImage(folder / config.image, datum), config.seed)
