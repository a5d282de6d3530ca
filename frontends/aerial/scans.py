# SPDX-License-Identifier: Apache-2.0
"""Scans of a bag: grouped into turns, and matched around a whole track."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from graphloc.config import AerialConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.frontends._clock import corrected_ns
from graphloc.frontends._mounts import mounts_of, refuse_another
from graphloc.frontends.aerial.cloud import CLOUDS, Cloud, decode_cloud
from graphloc.frontends.aerial.live import LiveMatcher, Matched, Pace, outside
from graphloc.frontends.aerial.own import Staying
from graphloc.frontends.aerial.submap import Turn, is_set_back
from graphloc.frontends.msgtypes import NO_STAMP, stamp_ns_of
from graphloc.frontends.part import Bags
from graphloc.frontends.source import Bag
from graphloc.time import NS_PER_S, utc_text
from graphloc.trajectory import Trajectory

log = logging.getLogger(__name__)
_TURN_S = 0.5  # scans of several LiDARs that are farther apart in time are not one turn
_MISSED_S, _SILENT_S = 2.0, 5.0  # silence of a LiDAR after which turns do not wait for it, and which is said


class ScanFeed:
    """Scans of an open bag, grouped into turns, in order of arrival; a damaged scan gives a turn with the reason.

    Attributes:
        mounts: (t (3,) m, R (3, 3)) in body of each LiDAR, by name.

    Raises:
        InputError: no LiDAR, a missing topic, or a mount without a chain of transforms.
    """

    def __init__(self, bag: Bag, config: AerialConfig, body_frame: str) -> None:
        self.mounts = _mounts(bag, config, body_frame)
        self._bag, self._config = bag, config
        self._heard = _Heard(config.lidars)

    @property
    def silences(self) -> list[str]:
        """A warning on each LiDAR that was silent for long in the turns read so far."""
        return self._heard.silences

    def __iter__(self) -> Iterator[Turn]:
        return _turns(self._bag, self._config, self._heard)


def check_scans(bags: Bags, config: AerialConfig, folder: Path, body_frame: str, datum: Datum) -> None:
    """Refuse what `match_bag` would refuse, before there is a track: its arguments but the track."""
    with Bag(bags) as bag:
        LiveMatcher(config, folder, datum, ScanFeed(bag, config, body_frame).mounts)


def match_bag(
    bags: Bags,
    config: AerialConfig,
    folder: Path,
    body_frame: str,
    track: Trajectory,
    datum: Datum,
    *,
    at_ns: int | None = None,
    warn: Callable[[str], None] = log.warning,
) -> Iterator[Matched]:
    """Match the scans of a bag around a track, at the configured interval, or only the one nearest to `at_ns`.

    Args:
        bags: see `read_recording`. config: of the aerial sensor. folder: base of relative paths of maps.
        body_frame: in tf. track: of the body. datum: origin of world.
        at_ns: match the scan nearest to this stamp only. warn: called with each damage of the bag, and with warnings on
            points that stay with the vessel.

    Raises:
        InputError: no LiDAR, a missing topic, a mount without a chain of transforms, or an unusable map.
    """
    with Bag(bags) as bag:
        feed = ScanFeed(bag, config, body_frame)
        matcher = LiveMatcher(config, folder, datum, feed.mounts, around_s=config.around_s)
        turns = iter(feed)
        if config.around_s > 0.0:
            turns = _shown_ahead(feed, matcher, track, config, due_alone=at_ns is None)
        if at_ns is None:
            staying = Staying(config.hull_m or (), (t for t, _ in feed.mounts.values()))
            for answer in (matcher.offer(turn, track, growing=False) for turn in turns):
                if not isinstance(answer, Matched):
                    continue
                if answer.match is not None:
                    staying.take(answer.match.found, answer.match.prior.pose[:2])
                yield answer
            for line in staying.said():
                warn(f"aerial: {line}")
        elif _take_until(at_ns, turns, matcher, track):
            yield matcher.match(track)
        for line in (*bag.warnings, *feed.silences):
            warn(line)


def _shown_ahead(
    feed: Iterable[Turn], matcher: LiveMatcher, track: Trajectory, config: AerialConfig, *, due_alone: bool
) -> Iterator[Turn]:
    """Show each turn to a matcher, and yield it once the turns of the time after it have been shown, too.

    Args:
        due_alone: turns that are not due are not yielded, unless they may be parts of one that is due: full scans take
            much memory.
    """
    waiting, ahead_ns, pace = deque[Turn](), round(config.around_s * NS_PER_S), Pace(config)
    newest_ns: int | None = None
    for turn in feed:
        set_back = newest_ns is not None and is_set_back(turn.stamp_ns, newest_ns)
        while waiting and (set_back or turn.stamp_ns - waiting[0].stamp_ns > ahead_ns):
            yield waiting.popleft()
        matcher.show(turn, track)
        newest_ns = turn.stamp_ns
        unusable = bool(turn.why_not or outside(turn, track))
        if unusable or not due_alone or config.submap > 1 or pace.is_due(turn.stamp_ns, track):
            waiting.append(turn)
    yield from waiting


def _take_until(at_ns: int, turns: Iterable[Turn], matcher: LiveMatcher, track: Trajectory) -> bool:
    """Give the usable turns to a matcher, the one nearest to a time last; return whether there is any."""
    nearest_ns: int | None = None
    for turn in turns:
        if turn.why_not or outside(turn, track):
            continue
        if nearest_ns is not None and abs(turn.stamp_ns - at_ns) > abs(nearest_ns - at_ns):
            break
        matcher.take(turn)
        nearest_ns = turn.stamp_ns
    return nearest_ns is not None


def _mounts(bag: Bag, config: AerialConfig, body_frame: str) -> dict[str, tuple[Array, Array]]:
    if not config.lidars:
        raise InputError("vessel.yaml: an aerial sensor needs `lidars`: name, topic and mount of each")
    for name, lidar in config.lidars.items():
        have = bag.topics.get(lidar.topic)
        if have is None or not set(CLOUDS) & set(have.msgtypes):
            fitting = [t.topic for t in bag.topics.values() if set(CLOUDS) & set(t.msgtypes)]
            raise InputError(
                f"{bag.name}: lidars.{name}.topic '{lidar.topic}' holds no PointCloud2, and no scan of Livox's drivers; such topics: "
                f"{', '.join(fitting) or 'none'}"
            )
    return mounts_of(bag, {name: lidar.mount for name, lidar in config.lidars.items()}, body_frame, "lidars")


class _Heard:
    """When each LiDAR was heard last.

    Args:
        names: of the LiDARs.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names, self._since_ns = tuple(names), dict[str, int]()
        self._newest_ns: int | None = None
        self._longest: dict[str, tuple[int, int]] = {}  # length and begin, ns, of the longest silence
        self._times: Counter[str] = Counter()

    @property
    def silences(self) -> list[str]:
        """A line on each LiDAR that was silent for `_SILENT_S` while another was not."""
        lines = list[str]()
        for name, (length_ns, since_ns) in self._longest.items():
            more = f", and {self._times[name] - 1} times more" if self._times[name] > 1 else ""
            said = f"was silent for {length_ns / NS_PER_S:.0f} s from {utc_text(since_ns)}{more}"
            lines.append(f"aerial: LiDAR {name} {said}: scans of the others were matched without it")
        return lines

    def note(self, name: str, stamp_ns: int) -> None:
        if self._newest_ns is None or abs(stamp_ns - self._newest_ns) > _MISSED_S * NS_PER_S:
            # All were silent, or the clock was set: nothing is known of the time between.
            self.end()
            self._since_ns = dict.fromkeys(self._names, stamp_ns)
        self._count(name, stamp_ns)
        self._newest_ns = self._since_ns[name] = stamp_ns

    def end(self) -> None:
        """Count the silences until now."""
        for name in self._since_ns:
            self._count(name, self._newest_ns or 0)

    def silent(self, name: str, stamp_ns: int) -> bool:
        """Return whether a LiDAR has not been heard for so long that no turn waits for it."""
        return stamp_ns - self._since_ns[name] > _MISSED_S * NS_PER_S

    def _count(self, name: str, until_ns: int) -> None:
        length_ns = until_ns - self._since_ns[name]
        if length_ns > _SILENT_S * NS_PER_S:
            self._times[name] += 1
            self._longest[name] = max(self._longest.get(name, (0, 0)), (length_ns, self._since_ns[name]))


def _turns(bag: Bag, config: AerialConfig, heard: _Heard) -> Iterator[Turn]:
    """Yield turns: the newest scan of each LiDAR, once there is one of each within `_TURN_S`.

    If a LiDAR is missing, or slower than that, the others form a turn without it.

    Args:
        heard: is told of each scan.
    """
    names = {lidar.topic: name for name, lidar in config.lidars.items()}
    frames: dict[str, str] = {}
    turn: dict[str, Cloud] = {}
    now_ns = 0

    def whole() -> Turn:
        return Turn(max(c.stamp_ns for c in turn.values()), now_ns, tuple(turn.values()))

    for raw in bag.messages(set(names)):
        name, now_ns = names[raw.topic], raw.log_ns
        try:
            msg = bag.decode(raw)
            stamp_ns = stamp_ns_of(msg, raw.msgtype, raw.log_ns, recorded=config.stamps == "recorded")
            if stamp_ns is None:
                raise ValueError(f"its header has no stamp: {NO_STAMP}")
            refuse_another(frames, name, msg, config.lidars[name].mount.tf_frame, "LiDAR")
            cloud = decode_cloud(msg, stamp_ns, name)
        except Exception as error:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything
            said = str(error) if isinstance(error, ValueError) else f"cannot be decoded ({type(error).__name__})"
            yield Turn(now_ns, now_ns, (), f"{raw.topic}: {said}")
            continue
        offset_ns = corrected_ns(cloud.stamp_ns, config, raw.elapsed_ns) - cloud.stamp_ns
        cloud = replace(cloud, stamp_ns=cloud.stamp_ns + offset_ns, stamps_ns=cloud.stamps_ns + offset_ns)
        heard.note(name, cloud.stamp_ns)
        missing = [n for n in names.values() if n not in turn]
        # Else newer scans of the others would take the places of the older ones without end.
        alone = name in turn and missing and all(heard.silent(n, cloud.stamp_ns) for n in missing)
        if alone or any(abs(cloud.stamp_ns - c.stamp_ns) > _TURN_S * 1e9 for n, c in turn.items() if n != name):
            yield whole()
            turn = {}
        turn[name] = cloud
        if len(turn) == len(names):
            yield whole()
            turn = {}
    if turn:
        yield whole()
    heard.end()
