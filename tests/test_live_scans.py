"""Turns of scans from a bag, and their matches one at a time around a track that still grows."""

import pickle
import weakref
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from graphloc import app
from graphloc.blocks import MountConfig
from graphloc.config import AerialConfig, LidarConfig
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends import msgtypes
from graphloc.frontends.aerial import live, match_bag, scans
from graphloc.frontends.aerial.cloud import CLOUD, Cloud, level
from graphloc.frontends.aerial.live import LiveMatcher, Matched
from graphloc.frontends.aerial.match import Mode
from graphloc.frontends.aerial.matcher import Match, Matcher, Prior, Since
from graphloc.frontends.aerial.scan import LevelCloud, inside, outline
from graphloc.frontends.aerial.scans import ScanFeed
from graphloc.frontends.aerial.submap import Turn
from graphloc.frontends.source import Bag, RawMessage, TopicSummary
from graphloc.recording import Mounts
from graphloc.trajectory import Trajectory

S = 10**9
BEGIN = 1_700_000_000 * S
NOTHING = outline(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), None)


# On a simulated run


@dataclass(frozen=True)
class Run:
    """A simulated run with scans, its true track as sure as a smoother would be, and its aerial sensor."""

    folder: Path
    sensor: AerialConfig
    track: Trajectory
    datum: Datum

    def matched(self, sensor: AerialConfig) -> list[Matched]:
        return list(match_bag([self.folder / "run"], sensor, self.folder, "base_link", self.track, self.datum))


@pytest.fixture(scope="module")
def matched(run: Run) -> list[Matched]:
    return run.matched(run.sensor)


@pytest.fixture(scope="module")
def run(launch_bag: Path) -> Run:
    recording, vessel = app.load([launch_bag / "run"], launch_bag / "vessel.yaml")
    truth, sensor = recording.truth, vessel.sensors["aerial"]
    assert truth is not None
    assert isinstance(sensor, AerialConfig)
    cov = np.broadcast_to(np.diag([1.0, 1.0, 0.1, 1e-4, 1e-4, 1e-3]), (len(truth), 6, 6))
    sensor = sensor.model_copy(update={"submap": 3, "submap_s": 0.0, "every_s": 1.0, "every_m": 5.0})
    return Run(launch_bag, sensor, replace(truth, cov=cov), app.choose_datum(recording, vessel))


def part(track: Trajectory, first_ns: float, last_ns: float) -> Trajectory:
    """The poses of a track in a time, each as it is in the whole one."""
    return track.where((track.stamps_ns >= first_ns) & (track.stamps_ns <= last_ns))


def test_a_bag_is_matched_as_written_out(run: Run, matched: list[Matched]) -> None:
    """The same numbers, bit for bit, as when turns are gone through in one loop around the whole track."""
    matcher, last, before = Matcher(run.sensor, run.folder, run.datum), None, None
    window: list[Turn] = []
    expected: list[tuple[int, Any, Since | None]] = []
    hull_m = np.array(run.sensor.hull_m, dtype=float)
    with Bag([run.folder / "run"]) as bag:
        feed = ScanFeed(bag, run.sensor, "base_link")
        for turn in feed:
            window = [*window, turn][-3:]
            here = run.track.at(np.array([turn.stamp_ns])).p_world_m[0]
            if last is not None:
                waited_s, way_m = (turn.stamp_ns - last[0]) * 1e-9, np.hypot(*(here - last[1])[:2])
                if waited_s < 0.95 or (way_m < 5.0 and waited_s < 10.0):
                    continue
            last = (turn.stamp_ns, here)
            stamps = np.sort(np.concatenate([*(c.stamps_ns for c in turn.clouds), [turn.stamp_ns]]))
            at_ns = int(stamps[len(stamps) // 2])
            clouds = [
                c.where(~inside(hull_m, (c.points_m @ feed.mounts[c.lidar][1].T + feed.mounts[c.lidar][0])[:, :2]))
                for t in window
                for c in t.clouds
            ]
            pose = run.track.at(np.array([at_ns]))
            prior = Prior(
                np.array([*pose.p_world_m[0, :2], pose.yaw_rad[0]]), np.sqrt(np.array([1.0, 1.0, 1e-3]))
            )  # as `run` has it
            found = matcher.match(level(clouds, feed.mounts, run.track, at_ns, run.sensor.waterline_m), prior)
            since = None
            if before is not None:
                seen_m = np.median(np.hypot(*np.vstack([found.found.faces_m, found.found.shore_m]).T))
                way_m = np.hypot(*(prior.pose[:2] - before[1]))
                since = Since(way_m / max(run.sensor.alike_m, seen_m), (at_ns - before[0]) / 1e9)
            before = (at_ns, prior.pose[:2])
            expected.append((at_ns, found, since))
    assert 4 <= len(expected) <= 12
    assert [m.stamp_ns for m in matched] == [at_ns for at_ns, _, _ in expected]
    assert [m.since for m in matched] == [since for _, _, since in expected]
    for item, (_, found, _) in zip(matched, expected, strict=True):
        assert item.match is not None
        assert item.match.modes
        assert item.match.none == found.none
        np.testing.assert_array_equal(item.match.score, found.score)
        np.testing.assert_array_equal([m.pose for m in item.match.modes], [m.pose for m in found.modes])
        np.testing.assert_array_equal([m.cov for m in item.match.modes], [m.cov for m in found.modes])


def test_live_as_offline_where_the_tracks_are_the_same(run: Run, matched: list[Matched]) -> None:
    """A window of 6 s that follows 20 ms behind each turn's arrival, and a worker thread that matches."""
    got, waits = [], 0
    with Bag([run.folder / "run"]) as bag, ThreadPoolExecutor(1) as pool:
        feed = ScanFeed(bag, run.sensor, "base_link")
        matcher = LiveMatcher(run.sensor, run.folder, run.datum, feed.mounts)
        for turn in feed:
            # Drivers are a few ms late, as here the track is not: scans are complete, and the track is not there yet.
            now_ns, answer = turn.arrival_ns - S // 20, None
            while (
                answer := pool.submit(matcher.offer, turn, part(run.track, now_ns - 6 * S, now_ns)).result()
            ) == "wait":
                waits, now_ns = waits + 1, now_ns + S // 20
            if answer is not None:
                got.append(answer)
    assert [m.stamp_ns for m in got] == [m.stamp_ns for m in matched]
    assert waits > 10  # turns that are not due wait as well
    for item, other in zip(got, matched, strict=True):
        assert item.match is not None
        assert other.match is not None
        # Seconds since another begin of the track: places differ by their rounding.
        assert [item.since and asdict(item.since)] == [other.since and pytest.approx(asdict(other.since), rel=1e-6)]
        assert len(item.match.found.faces_m) == pytest.approx(len(other.match.found.faces_m), abs=2)
        assert len(item.match.modes) == len(other.match.modes)
        for mode, same in zip(item.match.modes, other.match.modes, strict=True):
            np.testing.assert_allclose(mode.pose, same.pose, atol=1e-3)
            np.testing.assert_allclose(mode.cov, same.cov, rtol=1e-2, atol=1e-6)


def test_offline_no_scan_waits(run: Run) -> None:
    """A track that ends 0.1 s before a scan will not grow: that scan and all after it are refused."""
    end_ns = int(run.track.stamps_ns[0]) + 99 * S // 10
    short = replace(run, track=part(run.track, run.track.stamps_ns[0], end_ns))
    with Bag([run.folder / "run"]) as bag:
        after = [t.stamp_ns for t in ScanFeed(bag, run.sensor, "base_link") if t.stamp_ns > end_ns]
    assert end_ns < after[0] < end_ns + S // 5
    found = short.matched(run.sensor.model_copy(update={"every_s": 100.0}))
    assert [m.stamp_ns for m in found[1:]] == after
    assert all("outside of the track" in m.why_not for m in found[1:])


def test_what_a_worker_gets_and_gives_can_be_sent(run: Run) -> None:
    with Bag([run.folder / "run"]) as bag:
        feed = ScanFeed(bag, run.sensor, "base_link")
        turn = next(iter(feed))
        given = (run.sensor, run.folder, run.datum, feed.mounts)
    *made_from, turn, track = pickle.loads(pickle.dumps((*given, turn, run.track)))
    answer = pickle.loads(pickle.dumps(LiveMatcher(*made_from).offer(turn, track)))
    assert isinstance(answer, Matched)
    assert answer.match is not None
    assert answer.match.modes


# On turns made by hand


class Seen:
    """A matcher that finds every scan where the prior has it, and keeps what it was shown."""

    def __init__(self) -> None:
        self.numbers: list[list[int]] = []

    def match(self, cloud: LevelCloud, prior: Prior) -> Match:
        self.numbers.append(sorted(np.rint(cloud.points_m[:, 2]).astype(int).tolist()))
        return Match(prior, NOTHING, modes=(Mode(prior.pose, np.eye(3), 1.0),))


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Seen:
    matcher = Seen()
    monkeypatch.setattr(live, "_matcher", lambda *_: matcher)
    return matcher


@dataclass(frozen=True)
class Feed:
    """Turns of a bag, with the mounts of its LiDARs."""

    mounts: Mounts
    turns: Sequence[Turn]
    silences: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[Turn]:
        return iter(self.turns)


def live_matcher(**changes: Any) -> LiveMatcher:
    datum = Datum(Geodetic(57.7, 14.5, 30.0))
    return LiveMatcher(AerialConfig(**changes), Path(), datum, {"top": (np.zeros(3), np.eye(3))})


def turn_at(t_s: float, number: int = 0, first_s: float = 0.0, last_s: float = 0.0) -> Turn:
    """Two points at that height above the vessel, seen so long after the header."""
    stamps = BEGIN + np.rint((t_s + np.array([first_s, last_s])) * 1e9).astype(np.int64)
    stamp_ns = BEGIN + round(t_s * 1e9)
    points = np.array([(5.0, 0.0, number)] * 2)
    return Turn(stamp_ns, int(stamps[-1]), (Cloud("top", stamp_ns, points, stamps),))


def track_of(first_s: float, last_s: float, speed_mps: float = 1.0) -> Trajectory:
    """Eastwards from the origin at time 0, level."""
    t = np.arange(round(first_s * 100), round(last_s * 100) + 1) / 100.0
    return Trajectory(
        stamps_ns=BEGIN + np.rint(t * 1e9).astype(np.int64),
        p_world_m=np.column_stack([speed_mps * t, 0.0 * t, 0.0 * t]),
        R_world_body=np.broadcast_to(np.eye(3), (len(t), 3, 3)),
    )


def since_s(item: Matched | Literal["wait"] | None) -> float | None:
    return round((item.stamp_ns - BEGIN) / 1e9, 3) if isinstance(item, Matched) and item.match is not None else None


@pytest.mark.parametrize(
    ("speed_mps", "rules", "due"),
    [
        (1.0, {"every_s": 2.0, "every_m": 0.5}, [0.0, 2.0, 4.0, 6.0, 8.0]),
        (1.0, {"every_s": 0.1, "every_m": 2.9}, [0.0, 3.0, 6.0, 9.0]),
        (0.1, {"every_s": 2.0, "every_m": 2.0, "still_s": 5.0}, [0.0, 5.0]),
    ],
)
def test_matches_are_as_frequent_as_is_asked(
    speed_mps: float, rules: dict[str, float], due: list[float], seen: Seen
) -> None:
    matcher = live_matcher(**rules)
    stamps_s = np.arange(0.0, 10.0, 0.5)
    answers = [matcher.offer(turn_at(t), track_of(t - 4.0, t + 0.1, speed_mps)) for t in stamps_s]
    assert [since_s(a) for a in answers if a is not None] == due
    assert len(seen.numbers) == len(due)
    # A clock that is set back begins anew.
    assert since_s(matcher.offer(turn_at(-60.0), track_of(-64.0, -59.0, speed_mps))) == -60.0


def test_matches_tell_what_the_one_before_has_not(seen: Seen) -> None:
    matcher = live_matcher(every_s=1.0, alike_m=15.0)
    first, second = (matcher.offer(turn_at(t), track_of(t - 4.0, t + 0.1, 6.0)) for t in (0.0, 2.0))
    assert isinstance(first, Matched)
    assert isinstance(second, Matched)
    assert first.since is None
    assert second.since == Since(12.0 / 15.0, 2.0)


def test_what_falls_out_of_the_window_leaves_the_submap(seen: Seen) -> None:
    """Turns of each second, of which a track of 3.05 s covers three, and of one more the latter of its points."""
    matcher = live_matcher(submap=8, every_s=2.0)
    for number in range(10):
        turn = turn_at(number, number, first_s=-0.1)
        answer = matcher.offer(turn, track_of(number - 3.05, number))
        assert (answer is None) == (number % 2 == 1)
        assert number % 2 == 1 or since_s(answer) == number
    assert seen.numbers == [
        [0, 0], [0, 0, 1, 1, 2, 2], [1, 2, 2, 3, 3, 4, 4], [3, 4, 4, 5, 5, 6, 6], [5, 6, 6, 7, 7, 8, 8],
    ]  # fmt: skip


def test_a_submap_is_no_longer_than_asked(seen: Seen) -> None:
    matcher = live_matcher(submap=2, every_s=2.0)
    for number in range(5):
        matcher.offer(turn_at(number, number), track_of(number - 3.5, number))
    assert seen.numbers == [[0, 0], [1, 1, 2, 2], [3, 3, 4, 4]]


def matched_turns(
    monkeypatch: pytest.MonkeyPatch, turns: Sequence[Turn], speed_mps: float, at_ns: int | None = None, **config: Any
) -> list[Matched]:
    """Match turns made by hand as those of a bag are, every second."""
    feed = Feed({"top": (np.zeros(3), np.eye(3))}, turns)
    monkeypatch.setattr(scans, "Bag", lambda *_: nullcontext(SimpleNamespace(warnings=[])))
    monkeypatch.setattr(scans, "ScanFeed", lambda *_: feed)
    sensor = AerialConfig(every_s=1.0, every_m=0.0, **config)
    track, datum = track_of(-64.0, 6.0, speed_mps), Datum(Geodetic(57.7, 14.5, 30.0))
    found = list(match_bag([Path()], sensor, Path(), "base_link", track, datum, at_ns=at_ns))
    assert found
    return found


@pytest.mark.parametrize(
    ("config", "speed_mps", "expected"),
    [
        ({"submap_s": 4.0}, 1.0, ["012", "0123", "01234", "12345", "2345", "345"]),
        ({"submap_s": 4.0, "submap": 4}, 1.0, ["012", "0123", "01234", "012345", "12345", "2345"]),
        # What she passes slowly, or at rest, she sees the same again.
        ({"submap_s": 60.0}, 0.2, ["03", "013", "023", "03", "034", "035"]),
        ({"submap_s": 60.0}, 0.0, ["0", "01", "02", "03", "04", "05"]),
        ({"submap_s": 4.0, "matcher": "bl"}, 1.0, ["0", "1", "2", "3", "4", "5"]),  # as printed
        ({"submap_s": 0.0}, 1.0, ["0", "1", "2", "3", "4", "5"]),
        ({}, 1.0, ["012345"] * 6),  # 7.5 s around
    ],
    ids=["apart", "scans together", "slow", "at rest", "bl", "alone", "by default"],
)
def test_what_is_seen_from_elsewhere_before_and_after_is_matched_as_well(
    config: dict[str, Any], speed_mps: float, expected: list[str], seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = [turn_at(number, number) for number in range(6)]
    matched_turns(monkeypatch, turns, speed_mps, **config)
    assert ["".join(map(str, sorted(set(numbers)))) for numbers in seen.numbers] == expected
    seen.numbers.clear()
    matched_turns(monkeypatch, turns, speed_mps, BEGIN + 22 * S // 10, **config)
    assert ["".join(map(str, sorted(set(numbers)))) for numbers in seen.numbers] == expected[2:3]


class Counted(Sequence[Turn]):
    """Turns that a bag would read one after the other, ten a second; `alive` tells how many of their points are still in memory."""

    def __init__(self, count: int) -> None:
        self._count, self._points = count, list[weakref.ref[Array]]()

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Turn]:
        for number in range(self._count):
            turn = turn_at(0.1 * number, number)
            self._points.append(weakref.ref(turn.clouds[0].points_m))
            yield turn

    def __getitem__(self, _: Any) -> Any:
        raise NotImplementedError

    @property
    def alive(self) -> int:
        return sum(points() is not None for points in self._points)


def test_only_scans_that_are_due_wait_for_those_after_them(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten scans a second, of which one is matched, with those of 2 s after it: two wait, not twenty."""
    turns, alive = Counted(60), list[int]()
    match = LiveMatcher.match

    def counted(matcher: LiveMatcher, track: Trajectory) -> Matched:
        alive.append(turns.alive)
        return match(matcher, track)

    monkeypatch.setattr(LiveMatcher, "match", counted)
    matched_turns(monkeypatch, turns, 1.0, submap_s=4.0)
    assert [max(numbers) for numbers in seen.numbers] == [20, 30, 40, 50, 55, 55]
    assert max(alive) <= 12  # with what is kept, of 0.5 m


def test_a_scan_between_those_that_are_due_is_matched_if_asked_for(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    matched_turns(monkeypatch, Counted(60), 1.0, BEGIN + 24 * S // 10, submap_s=1.0)
    assert [sorted(set(numbers)) for numbers in seen.numbers] == [[20, 24, 25]]


def test_parts_of_a_turn_that_are_not_due_are_matched_with_it(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three parts of now, and of 0.5 s before and after."""
    matched_turns(monkeypatch, Counted(50), 1.0, submap_s=1.0, submap=3)
    assert sorted(set(seen.numbers[2])) == [13, 14, 15, 18, 19, 20, 23, 24, 25]


def test_scans_outside_of_the_track_are_told_due_or_not(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends at 6 s."""
    found = matched_turns(monkeypatch, Counted(65), 1.0, submap_s=4.0)
    assert [since_s(m) for m in found if m.match is not None] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert ["outside of the track" in m.why_not for m in found[7:]] == [True] * 4


@pytest.mark.parametrize("damaged", [False, True])
def test_scans_of_two_clocks_are_not_matched_together(
    damaged: bool, seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A damaged scan between them, whose time is that of its arrival, is no turn of theirs."""
    between = [Turn(BEGIN + 900 * S, BEGIN + 900 * S, (), "damaged")] if damaged else []
    turns = [*(turn_at(t, t) for t in (0, 1, 2)), *between, *(turn_at(t, 60 + t) for t in (-60, -59))]
    found = matched_turns(monkeypatch, turns, 1.0, submap_s=4.0)
    assert [sorted(set(numbers)) for numbers in seen.numbers] == [[0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1], [0, 1]]
    assert [m.why_not for m in found if m.match is None] == ["damaged"] * damaged


def test_a_clock_that_is_set_back_is_seen_by_scans_that_are_not_due(
    seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From 0.9 s, of a scan that is not matched, to -0.5 s."""
    turns = [turn_at(t, number) for t, number in ((0.0, 0), (0.9, 1), (-0.5, 60), (0.6, 61))]
    matched_turns(monkeypatch, turns, 1.0, submap_s=4.0)
    assert [sorted(set(numbers)) for numbers in seen.numbers] == [[0, 1], [60, 61], [60, 61]]


@pytest.mark.parametrize("ends_s", [0.0, 0.05], ids=["after its last point", "at its begin"])
def test_a_turn_waits_for_the_track(ends_s: float, seen: Seen) -> None:
    """By its last point, 0.1 s after its header; and told to wait, it has changed nothing."""
    matcher, turn = live_matcher(submap=3), turn_at(5.0, 7, last_s=0.1)
    for end_s in (4.8, 4.95, 5.0 + ends_s):
        assert matcher.offer(turn, track_of(0.0, end_s)) == "wait"
    assert not seen.numbers
    assert since_s(matcher.offer(turn, track_of(0.0, 5.1))) == 5.0
    assert seen.numbers == [[7, 7]]
    # Waiting for no more: with those points that the track covers.
    assert since_s(matcher.offer(turn_at(9.0, 8, last_s=0.1), track_of(8.0, 9.05), growing=False)) == 9.0
    assert seen.numbers[1:] == [[8]]


@pytest.mark.parametrize(
    ("track", "growing"),
    [
        (track_of(0.0, 4.6), True),  # farther ahead than an IMU is late
        (track_of(0.0, 4.9), False),
        (track_of(5.5, 9.0), True),
        (track_of(5.5, 9.0), False),
    ],
)
def test_a_turn_outside_for_good_says_so(track: Trajectory, growing: bool, seen: Seen) -> None:
    matcher = live_matcher(submap=3)
    answer = matcher.offer(turn_at(5.0), track, growing=growing)
    assert isinstance(answer, Matched)
    assert answer.match is None
    assert answer.stamp_ns == BEGIN + 5 * S
    assert "outside of the track" in answer.why_not
    assert "top" in answer.why_not
    # It is no part of the next one's submap, and the next one is due at once.
    assert since_s(matcher.offer(turn_at(5.2, 3), track_of(0.0, 6.0))) == 5.2
    assert seen.numbers == [[3, 3]]


# What the bag gives


class Heap:
    """A bag of clouds: (LiDAR, header s, arrival s); a header that is not a number is a damaged message."""

    name = "heap"

    def __init__(self, *messages: tuple[str, float, float]) -> None:
        self._messages = messages
        self.warnings: list[str] = []
        self.topics = {f"/{n}": TopicSummary(f"/{n}", (CLOUD,), 1) for n in ("one", "two")}

    def messages(self, _topics: set[str]) -> Iterator[RawMessage]:
        for name, t, arrival_s in self._messages:
            yield RawMessage(f"/{name}", CLOUD, "", BEGIN + round(arrival_s * 1e9), repr(t).encode())

    def decode(self, raw: RawMessage) -> float:
        return float(raw.data)


def turns_of(
    monkeypatch: pytest.MonkeyPatch,
    *messages: tuple[str, float, float],
    stamps: Literal["header", "recorded"] = "header",
    mounted: str | None = None,
    silences: list[str] | None = None,
    lidars: tuple[str, ...] = ("one", "two"),
) -> list[Turn]:
    def decode_cloud(_: float, stamp_ns: int, name: str) -> Cloud:
        return Cloud(name, stamp_ns, np.ones((1, 3)), np.array([stamp_ns], dtype=np.int64))

    def header_stamp_ns(t: float) -> int | None:
        return None if np.isnan(t) else BEGIN + round(t * 1e9)

    monkeypatch.setattr(msgtypes, "header_stamp_ns", header_stamp_ns)
    monkeypatch.setattr(scans, "decode_cloud", decode_cloud)
    mount = MountConfig(tf_frame=mounted) if mounted else MountConfig()
    config = AerialConfig(lidars={n: LidarConfig(topic=f"/{n}", mount=mount) for n in lidars}, stamps=stamps)
    monkeypatch.setattr(scans, "mounts_of", lambda *_: {})
    feed = ScanFeed(Heap(*messages), config, "base_link")  # type: ignore[arg-type]
    found = list(feed)
    if silences is not None:
        silences += feed.silences
    return found


def test_turns_arrive_with_the_message_that_ends_them(monkeypatch: pytest.MonkeyPatch) -> None:
    found = turns_of(
        monkeypatch,
        ("one", 1.0, 1.1), ("two", 1.02, 1.3),  # both
        ("one", 2.0, 2.1), ("one", 3.0, 3.1), ("two", 3.0, 3.2),  # a newer one of the same, then both
        ("one", 4.0, 4.1), ("two", 5.0, 5.1),  # each alone: the first is known to be so when the second comes
        ("two", 5.2, 5.3),
    )  # fmt: skip
    at = [[(c.lidar, (c.stamp_ns - BEGIN) / 1e9) for c in t.clouds] for t in found]
    assert at == [[("one", 1.0), ("two", 1.02)], [("one", 3.0), ("two", 3.0)], [("one", 4.0)], [("two", 5.2)]]
    assert [(t.arrival_ns - BEGIN) / 1e9 for t in found] == [1.3, 3.2, 5.1, 5.3]
    assert [(t.stamp_ns - BEGIN) / 1e9 for t in found] == [1.02, 3.0, 4.0, 5.2]


def test_no_turn_waits_for_a_lidar_that_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 3 to 12 s, and from 14 s on: newer scans of the other one took each other's places, and none was matched until it came back."""
    silences, times = list[str](), np.arange(0.0, 20.0, 0.1).round(1).tolist()
    found = turns_of(
        monkeypatch,
        *((name, t + 0.01 * n, t + 0.02)
          for t in times for n, name in enumerate(("one", "two")) if name == "one" or t < 3.0 or 12.0 <= t < 14.0),
        silences=silences,
    )  # fmt: skip
    alone = [(t.stamp_ns - BEGIN) / 1e9 for t in found if len(t.clouds) == 1]
    both = [(t.stamp_ns - BEGIN) / 1e9 for t in found if len(t.clouds) == 2]
    assert len(both) == pytest.approx(50, abs=3)  # as soon as it is back
    assert min(alone) < 5.2
    assert np.diff([t for t in alone if t < 12.0]).max() < 0.15
    (line,) = silences
    assert line.startswith("aerial: LiDAR two was silent for 9 s from ")
    assert ", and 1 times more: " in line


@pytest.mark.parametrize("lidars", [("one",), ("one", "two")])
def test_a_lidar_is_not_silent_alone_where_all_are_or_one_stamp_is_wrong(
    monkeypatch: pytest.MonkeyPatch, lidars: tuple[str, ...]
) -> None:
    """All for 20 s, as in a recording that paused; one scan a day ahead made each silent for a day."""
    silences, times = list[str](), np.append(np.arange(0.0, 5.0, 0.1), np.arange(25.0, 30.0, 0.1)).round(1).tolist()
    scans_then = [(name, t + 0.01 * n, t + 0.02) for t in times for n, name in enumerate(lidars)]
    scans_then[40] = ("one", 86400.0, scans_then[40][2])
    turns_of(monkeypatch, *scans_then, silences=silences, lidars=lidars)
    assert not silences


def test_scans_without_stamps_are_of_when_they_were_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    (turn,) = turns_of(monkeypatch, ("one", np.nan, 1.1), ("two", np.nan, 1.14), stamps="recorded")
    assert [c.stamp_ns - BEGIN for c in turn.clouds] == [1_100_000_000, 1_140_000_000]


@pytest.mark.parametrize("mounted", [None, "left", "right", "mast"])
def test_two_lidars_on_one_topic_are_not_placed_by_one_mount(
    mounted: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mount's frame tells which is meant, the first scan where it does not; scans that name none may be its own."""
    frames = {1.0: "/left", 2.0: "right", 3.0: "left", 4.0: "", 5.0: "right"}

    class Framed(float):
        @property
        def header(self) -> SimpleNamespace:
            return SimpleNamespace(frame_id=frames[float(self)])

    monkeypatch.setattr(Heap, "decode", lambda _, raw: Framed(raw.data))
    found = turns_of(monkeypatch, *(("one", t, t + 0.1) for t in frames), mounted=mounted)
    other, own = ("left", "right") if mounted == "right" else ("right", "left")
    refused = [t for t in found if not t.clouds]
    assert len(refused) == (1 if mounted == "right" else 2)  # its first scan is not known to be another's
    said = f"/one: a message in frame '{other}' where others are in '{own}': of another LiDAR, whose mount is not that of one"
    assert {t.why_not for t in refused} == {f"{said}; record each on a topic of its own"}


def test_a_damaged_scan_is_answered_at_once(monkeypatch: pytest.MonkeyPatch, seen: Seen) -> None:
    """It needs no track, and the scans beside it still make a turn; turns stay in order of arrival."""
    found = turns_of(
        monkeypatch, ("one", 1.0, 1.1), ("two", np.nan, 1.2), ("two", 1.1, 1.3), ("one", 9.0, 9.1), ("two", np.nan, 9.2)
    )
    assert [(t.arrival_ns - BEGIN) / 1e9 for t in found] == [1.2, 1.3, 9.2, 9.2]
    assert [bool(t.why_not) for t in found] == [True, False, True, False]
    matcher = live_matcher(every_s=1.0)
    answer = matcher.offer(found[0], track_of(-5.0, 0.5))
    assert isinstance(answer, Matched)
    assert (answer.stamp_ns, answer.match, answer.why_not) == (
        BEGIN + 12 * S // 10, None, "/two: its header has no stamp: `stamps: recorded` of that sensor takes the recording time instead"
    )  # fmt: skip
    assert not seen.numbers
