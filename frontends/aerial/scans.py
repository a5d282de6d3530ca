# SPDX-License-Identifier: Apache-2.0
"""The scans of a bag, matched one after the other around a track."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from graphloc.config import AerialConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.frontends._mounts import mounts_of
from graphloc.frontends._source import Bag
from graphloc.frontends.aerial.bl import BLMatcher
from graphloc.frontends.aerial.cloud import CLOUD, Cloud, decode_cloud, level
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.matcher import Match, Matcher, Prior
from graphloc.frontends.decode import header_stamp_ns
from graphloc.time import duration_ns
from graphloc.trajectory import Trajectory

log = logging.getLogger(__name__)
_JITTER_S = 0.05  # stamps are not a clock
_TURN_S = 0.5  # scans of several LiDARs farther apart than this are not one
_CARRIED_S = (5.0, 60.0)  # how long inertial sensors carry a place, and a heading, to a match's accuracy


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """A match and its stamp; or why there is none.

    Attributes:
        news: (3,) shares of its east, north and yaw that the match before has not told (`AerialConfig.alike_m`).
    """

    stamp_ns: int
    match: Match | None
    why_not: str
    news: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """One scan of each LiDAR; or why one of them cannot be used."""

    stamp_ns: int
    clouds: list[Cloud]
    why_not: str = ""


def match_bag(
    paths: Sequence[Path],
    config: AerialConfig,
    folder: Path,
    body_frame: str,
    track: Trajectory,
    datum: Datum,
    *,
    at_ns: int | None = None,
    warn: Callable[[str], None] = log.warning,
) -> Iterator[Matched]:
    """Match the scans of a bag around a track, as often as the configuration says; or the one nearest to `at_ns` alone.

    Args:
        folder: relative paths of maps count from there. warn: is told what is damaged in the bag.

    Raises:
        InputError: no LiDAR, a topic that is not there, a mount that no chain leads to, a map that cannot be used.
    """
    with Bag(paths) as bag:
        mounts = _mounts(bag, config, body_frame)
        matcher = _matcher(config, folder, datum)
        before: tuple[Array, int] | None = None
        for turns in _submaps(bag, config, track, at_ns):
            if turns[-1].why_not:
                yield Matched(turns[-1].stamp_ns, None, turns[-1].why_not)
                continue
            item = _one(matcher, turns, mounts, track, config)
            if item.match is not None and item.match.modes:
                here = (item.match.prior.pose[:2], item.stamp_ns)
                item = replace(item, news=_news(before, here, config.alike_m))
                before = here
            yield item
        for line in bag.warnings:
            warn(line)


def _news(before: tuple[Array, int] | None, here: tuple[Array, int], alike_m: float) -> tuple[float, float, float]:
    """What a match adds to a mean, were errors a first-order Markov process along the way: (1 - r) / (1 + r).

    The mean is over what inertial sensors carry: what was known of a place is forgotten sooner than a heading.
    """
    if before is None or alike_m == 0.0:
        return (1.0, 1.0, 1.0)
    way = float(np.hypot(*(here[0] - before[0]))) / alike_m
    waited_s = abs(here[1] - before[1]) / 1e9
    place, heading = (float(np.tanh(0.5 * max(way, waited_s / carried_s))) for carried_s in _CARRIED_S)
    return (place, place, heading)


def _matcher(config: AerialConfig, folder: Path, datum: Datum) -> Matcher | BLMatcher:
    if config.matcher == "posterior":
        return Matcher(config, folder, datum)
    if not config.image:
        raise InputError("vessel.yaml: an aerial sensor with matcher: bl needs an `image`")
    return BLMatcher(config, AerialImage(folder / config.image, datum), config.seed)


def _submaps(bag: Bag, config: AerialConfig, track: Trajectory, at_ns: int | None) -> Iterator[list[_Turn]]:
    """The turns that are matched, each with those before it that are laid together with it; newest last."""
    if at_ns is not None:
        whole = (turns for turns in _windows(bag, config, track) if not turns[-1].why_not)
        nearest = next(whole, None)
        for turns in whole:
            if nearest is None or abs(turns[-1].stamp_ns - at_ns) > abs(nearest[-1].stamp_ns - at_ns):
                break
            nearest = turns
        if nearest is not None:
            yield nearest
        return
    last: tuple[int, Array] | None = None
    for turns in _windows(bag, config, track):
        stamp_ns = turns[-1].stamp_ns
        if turns[-1].why_not:
            yield turns
            continue
        here = track.at(np.array([stamp_ns])).p_world_m[0]
        if last is not None:
            waited_s, moved_m = (stamp_ns - last[0]) / 1e9, float(np.hypot(*(here - last[1])[:2]))
            too_soon = waited_s < config.every_s - _JITTER_S or (moved_m < config.every_m and waited_s < config.still_s)
            if waited_s >= 0.0 and too_soon:  # a clock that was set back begins anew
                continue
        last = (stamp_ns, here)
        yield turns


def _windows(bag: Bag, config: AerialConfig, track: Trajectory) -> Iterator[list[_Turn]]:
    """Each turn with those before it; alone if it cannot be used."""
    window: deque[_Turn] = deque(maxlen=config.submap)
    for turn in _turns(bag, config):
        stamps = np.array([c.stamp_ns for c in turn.clouds], dtype=np.int64)
        if turn.why_not:
            yield [turn]
        elif not track.covers(stamps).all():
            off_s = (stamps - track.stamps_ns[0]) / 1e9
            names = ", ".join(f"{c.lidar} {t:+.1f} s" for c, t in zip(turn.clouds, off_s, strict=True))
            yield [_Turn(turn.stamp_ns, [], f"scans outside of the track, from its begin: {names}")]
        else:
            window.append(turn)
            yield list(window)


def _one(
    matcher: Matcher | BLMatcher,
    turns: list[_Turn],
    mounts: Mapping[str, tuple[Array, Array]],
    track: Trajectory,
    config: AerialConfig,
) -> Matched:
    newest = turns[-1]
    stamps = np.sort(np.concatenate([c.stamps_ns for c in newest.clouds] + [np.array([newest.stamp_ns])]))
    at_ns = int(stamps[len(stamps) // 2])  # not a median, which goes through floats
    try:
        cloud = level([c for turn in turns for c in turn.clouds], mounts, track, at_ns, config.waterline_m)
        pose = track.at(np.array([at_ns]))
        sigma = np.array([1.0, 1.0, np.radians(2.0)])
        if pose.cov is not None:
            sigma = np.sqrt(np.diagonal(pose.cov[0])[[0, 1, 5]])
        prior = Prior(np.array([*pose.p_world_m[0, :2], pose.yaw_rad[0]]), sigma)
        found = matcher.match(cloud, prior)
    except InputError as error:
        return Matched(at_ns, None, str(error))
    return Matched(at_ns, found, found.why_not)


def _mounts(bag: Bag, config: AerialConfig, body_frame: str) -> dict[str, tuple[Array, Array]]:
    if not config.lidars:
        raise InputError("vessel.yaml: an aerial sensor needs `lidars`: name, topic and mount of each")
    for name, lidar in config.lidars.items():
        have = bag.topics.get(lidar.topic)
        if have is None or CLOUD not in have.msgtypes:
            fitting = [t.topic for t in bag.topics.values() if CLOUD in t.msgtypes]
            raise InputError(
                f"{bag.name}: lidars.{name}.topic '{lidar.topic}' holds no PointCloud2; such topics: "
                f"{', '.join(fitting) or 'none'}"
            )
    return mounts_of(bag, {name: lidar.mount for name, lidar in config.lidars.items()}, body_frame, "lidars")


def _turns(bag: Bag, config: AerialConfig) -> Iterator[_Turn]:
    """Scans that belong together: the newest of each LiDAR, as soon as there is one of each within `_TURN_S`.

    Where one is silent, or comes less often than that, the others go without it.
    """
    names = {lidar.topic: name for name, lidar in config.lidars.items()}
    offset_ns = duration_ns(config.time_offset_s)
    turn: dict[str, Cloud] = {}

    def whole() -> _Turn:
        return _Turn(max(c.stamp_ns for c in turn.values()), list(turn.values()))

    for raw in bag.messages(set(names)):
        name = names[raw.topic]
        try:
            msg = bag.decode(raw)
            stamp_ns = header_stamp_ns(msg)
            if stamp_ns is None:
                raise ValueError("its header has no stamp")
            cloud = decode_cloud(msg, stamp_ns, name)
        except Exception as error:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything
            said = str(error) if isinstance(error, ValueError) else f"cannot be decoded ({type(error).__name__})"
            yield _Turn(raw.log_ns, [], f"{raw.topic}: {said}")
            continue
        cloud = replace(cloud, stamp_ns=cloud.stamp_ns + offset_ns, stamps_ns=cloud.stamps_ns + offset_ns)
        if any(abs(cloud.stamp_ns - c.stamp_ns) > _TURN_S * 1e9 for n, c in turn.items() if n != name):
            yield whole()
            turn = {}
        turn[name] = cloud
        if len(turn) == len(names):
            yield whole()
            turn = {}
    if turn:
        yield whole()
