# SPDX-License-Identifier: Apache-2.0
"""Scans laid on an aerial image, through a bag: matches, ledger, what cannot work."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio

from graphloc import app
from graphloc.app import _estimate
from graphloc.config import AerialConfig, LidarConfig, VesselConfig
from graphloc.errors import InputError
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate.harbour import load_harbour
from graphloc.frames import Array, Datum, rotation_from_rpy_deg
from graphloc.frontends.aerial import Match, Prior, live, match_bag, matcher, scans
from graphloc.frontends.aerial.cloud import CLOUD, Cloud
from graphloc.frontends.aerial.match import Mode
from graphloc.frontends.aerial.matcher import Since
from graphloc.frontends.aerial.scan import LevelCloud, outline
from graphloc.frontends.aerial.scans import Matched
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.frontends.part import BagPart
from graphloc.frontends.source import RawMessage
from graphloc.gather import _matches, with_matches
from graphloc.gather._matches import Matches, few_matches, turned_heading
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.time import stamps_of
from graphloc.trajectory import Trajectory
from tests.bagfactory import S
from tests.commands import called
from tests.mapfactory import picture


@pytest.fixture
def bag(scanned_bag: Path) -> Path:
    return scanned_bag


@cache
def eight_seconds(bag: Path) -> tuple[BagPart, Recording, VesselConfig]:
    part = BagPart((bag / "run",), 6.0, 8.0)
    return part, *app.load(part, bag / "vessel.yaml")


@pytest.mark.usefixtures("map_alone")
def test_from_a_bag_to_the_graph(bag: Path, tmp_path: Path) -> None:
    """Scans become matches of the second smoothing; the image's offset is estimated; the ledger adds up."""
    part, recording, vessel = eight_seconds(bag)
    run = app.smooth_recording(recording, vessel, scans=app.Scans(part, bag))
    counts = run.solution.ledger.counts()
    matches = sum(counts["aerial"].values())
    assert 4 <= matches <= 8  # one a second, none where the vessel has moved less than half a metre
    assert counts["aerial"]["used"] > 0.9 * matches
    assert sum(sum(c.values()) for c in counts.values()) == recording.message_count + matches
    assert 1 <= len(run.pictures) <= 3
    assert all(coded[:2] == b"\xff\xd8" and "aerial at " in said for said, coded in run.pictures)  # JPEG
    page = app.write(run, tmp_path / "out", inputs=[], command="", overwrite=False).read_text()
    assert page.count('src="data:image/jpeg;base64,') == len(run.pictures)
    assert [r.reason for r in run.recording.rows if r.topic == "/lidar_1/points"] == ["read by aerial"]
    assert "aerial" in run.solution.slow
    alone = app.solve(recording, vessel, app.choose_datum(recording, vessel))
    truth = recording.truth
    assert truth is not None
    with_it, without = (compare_to_truth(s.trajectory, truth).heading_rmse_deg for s in (run.solution, alone))
    assert with_it < max(without, 0.3)


def test_one_match_is_drawn(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["match", str(bag / "run"), "-c", str(bag / "vessel.yaml"), "--at", "10", "-o", str(tmp_path / "m.png")]
    for code, said in ((0, "none of them"), (2, "exists already")):
        assert called(monkeypatch, *arguments) == code
        streams = capsys.readouterr()
        assert said in streams.out + streams.err
    drawn = np.asarray(cv2.imread(str(tmp_path / "m.png")))
    assert min(drawn.shape[:2]) > 500
    assert (np.abs(drawn.astype(int) - (60, 60, 255)).max(axis=2) < 3).sum() > 500  # its faces


def test_one_match_is_of_one_scan(bag: Path) -> None:
    """Others, placed by a track of fixes that jump, drew each boat twice, and the best mode was over a metre off with a probability of 0.9."""
    recording, vessel = loaded(bag)
    assert vessel.sensors["aerial"].around_s > 0.0
    match, _ = app.match_at(recording, vessel, app.Scans((bag / "run",), bag), 10.0, lambda *_: None)
    assert match.found.turns == 1
    assert match.found.own is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"lidars": {}}, "needs `lidars`"),
        ({"lidars": {"a": {"topic": "/imu/data"}}}, "holds no PointCloud2, and no scan of Livox's drivers; such topics: /lidar_1/points"),
        ({"lidars": {"a": {"topic": "/lidar_1/points", "mount": {"tf_frame": "nowhere"}}}}, "no chain from 'base_link' to 'nowhere'"),
        ({"image": "none.tif"}, "not an image"),
    ],
)  # fmt: skip
def test_a_matcher_that_cannot_work_is_one_line(
    changes: dict[str, Any], said: str, bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was said after the first solution, which of a run of hours takes minutes."""
    monkeypatch.setattr(_estimate, "solve", lambda *_, **__: pytest.fail("solved before it was said"))
    recording, vessel = loaded(bag)
    sensor = AerialConfig.model_validate({**vessel.sensors["aerial"].model_dump(), **changes})
    vessel = vessel.model_copy(update={"sensors": {**vessel.sensors, "aerial": sensor}})
    for work in (
        lambda: app.smooth_recording(recording, vessel, scans=app.Scans((bag / "run",), bag)),
        lambda: app.match_at(recording, vessel, app.Scans((bag / "run",), bag), 10.0, lambda *_: None),
    ):
        with pytest.raises(InputError) as caught:
            work()
        assert said in str(caught.value)
        assert "\n" not in str(caught.value)


def test_an_image_of_elsewhere_leaves_rows_in_the_ledger(bag: Path, tmp_path: Path) -> None:
    picture(tmp_path / "far.tif", 32633, 0.5, np.array([40.0, -60.0, 60.0, -30.0]))
    part, recording, vessel = eight_seconds(bag)
    sensor = vessel.sensors["aerial"].model_copy(update={"image": str(tmp_path / "far.tif"), "submap_s": 0.0})
    vessel = vessel.model_copy(update={"sensors": {**vessel.sensors, "aerial": sensor}})
    short = replace(recording, truth=None)
    run = app.smooth_recording(short, vessel, scans=app.Scans(part, bag))
    assert set(run.solution.ledger.counts()["aerial"]) == {"rejected"}
    assert run.solution.ledger.counts()["aerial"]["rejected"] >= 4
    assert all("does not cover" in row.reason for row in run.solution.ledger if row.sensor == "aerial")


@cache
def loaded(bag: Path) -> tuple[Recording, VesselConfig]:
    return app.load([bag / "run"], bag / "vessel.yaml")


def aerial(bag: Path, **changes: Any) -> tuple[AerialConfig, Trajectory]:
    """The aerial sensor of the bag, changed, and the true track, as sure as a smoother would be."""
    recording, vessel = loaded(bag)
    truth = recording.truth
    assert truth is not None
    cov = np.broadcast_to(np.diag([1.0, 1.0, 0.1, 1e-4, 1e-4, 1e-3]), (len(truth), 6, 6))
    sensor = AerialConfig.model_validate({**vessel.sensors["aerial"].model_dump(), **changes})
    return sensor, replace(truth, cov=cov)


def matching(bag: Path, track: Trajectory, sensor: AerialConfig, **more: Any) -> Iterator[Matched]:
    datum = app.choose_datum(*loaded(bag))
    return match_bag([bag / "run"], sensor, bag, "base_link", track, datum, **more)


def matched(bag: Path, track: Trajectory, sensor: AerialConfig, **more: Any) -> list[Matched]:
    return list(matching(bag, track, sensor, **more))


@cache
def matched_alone(bag: Path, at_s: int = 10, **changes: Any) -> tuple[Match, Array]:
    """One match at the true pose, and what that was: place (2,) m."""
    sensor, track = aerial(bag, **changes)
    (item,) = matched(bag, track, sensor, at_ns=int(track.stamps_ns[0]) + at_s * S)
    assert item.match is not None
    return item.match, track.at(np.array([item.stamp_ns])).p_world_m[0, :2]


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what a match does not bear on: a matcher that finds every scan where the prior has it, on no map."""

    class Found:
        def match(self, cloud: LevelCloud, prior: Prior) -> Match:
            return Match(prior, outline(cloud, None), modes=(Mode(prior.pose, np.diag([0.04, 0.09, 1e-4]), 1.0),))

    monkeypatch.setattr(live, "_matcher", lambda *_: Found())


@pytest.mark.usefixtures("unseen")
def test_matches_are_spent_where_they_inform(bag: Path) -> None:
    sensor, track = aerial(bag, every_m=4.0, still_s=1000.0)
    stamps = stamps_of(matched(bag, track, sensor))
    way = np.diff(track.at(stamps).p_world_m[:, :2], axis=0)
    assert 4 <= len(stamps) < 12
    assert np.hypot(*way.T).min() > 3.0  # from the end of a scan, stamped at its middle
    # The same scans, were the vessel lying still.
    moored = replace(track, p_world_m=np.zeros_like(track.p_world_m) + track.p_world_m[0])
    assert [len(matched(bag, moored, aerial(bag, every_m=4.0, still_s=s)[0])) for s in (6.0, 1000.0)] == [3, 1]


@pytest.mark.parametrize(("window", "cut_off"), [({}, False), ({"window_m": 1.9}, True), ({"window_deg": 3.5}, True)])
def test_a_window_that_two_sigmas_exceed_is_told(window: dict[str, float], cut_off: bool, bag: Path) -> None:
    """The prior is good to 1 m and 1.8 deg."""
    assert matched_alone(bag, **window)[0].cut_off is cut_off


@pytest.mark.parametrize(("few", "cut_off"), [(2, False), (3, True)])
def test_a_tenth_of_the_windows_may_be_too_small(
    few: int, cut_off: bool, bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    match, _ = matched_alone(bag)
    found = [Matched(k * S, replace(match, cut_off=k < few), "") for k in range(20)]
    monkeypatch.setattr(_matches, "match_bag", lambda *_, **__: found)
    recording, vessel = loaded(bag)
    datum = app.choose_datum(recording, vessel)
    solution = app.solve(recording, vessel, datum)
    assert with_matches(recording, vessel, datum, solution, app.Scans((bag / "run",), bag)).cut_off is cut_off


@pytest.mark.parametrize(
    ("turn_deg", "sigma_deg", "count", "said"),
    [(-10.0, 4.0, 5, True), (-10.0, 4.0, 4, False), (-10.0, 5.5, 5, False), (-50.0, 15.0, 5, False)],
)
def test_a_heading_that_matches_turn_is_said_where_another_sensor_told_it(
    turn_deg: float, sigma_deg: float, count: int, said: bool
) -> None:
    """One false match among them changes nothing."""
    turns = [(np.radians(turn_deg), np.radians(sigma_deg))] * (count - 1) + [(0.0, np.radians(sigma_deg))]
    lines = turned_heading("aerial", turns)
    assert len(lines) == said
    assert all(f"turn the heading by {turn_deg:.1f} deg" in line and "to 4.0 deg (1 sigma)" in line for line in lines)


@pytest.mark.parametrize(
    ("cut_off", "fewest", "submap_s", "matcher", "again"),
    [
        (False, 0, 0.0, "posterior", False),
        (True, 0, 0.0, "posterior", True),
        (True, 1, 0.0, "posterior", False),
        (False, 1, 15.0, "posterior", True),
        (False, 1, 15.0, "bl", False),  # matches single scans anyway
    ],
)
def test_where_windows_were_too_small_scans_are_matched_around_the_second_track(
    cut_off: bool, fewest: int, submap_s: float, matcher: str, again: bool, bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a compass the heading is open by tens of degrees: of a window of 5, most scans stayed refused. Where none is used, too.

    Scans that are matched together are matched alone first, around a track that no match has straightened.
    """
    recording, vessel = loaded(bag)
    together = vessel.sensors["aerial"].model_copy(update={"submap_s": submap_s, "matcher": matcher})
    vessel = vessel.model_copy(update={"sensors": vessel.sensors | {"aerial": together}})
    lengths_s = []
    assert recording.imu is not None
    until_ns = int(recording.imu.stamps_ns[0]) + 5 * S
    imu = recording.imu.where(recording.imu.stamps_ns < until_ns)
    fixes = tuple(m for m in recording.measurements if m.sensor == "gnss" and m.stamp_ns < until_ns)
    short, around = replace(recording, measurements=fixes, imu=imu), list[Solution]()

    def faked(given: Recording, config: VesselConfig, _datum: Datum, solution: Solution, *_: object) -> Matches:
        assert sum(m.sensor == "gnss" for m in given.measurements) == len(fixes)  # whatever was found before
        around.append(solution)
        lengths_s.append(config.sensors["aerial"].submap_s)
        return Matches(replace(given, measurements=fixes[: 10 + len(around)]), cut_off, [f"turned, {len(around)}"])

    monkeypatch.setattr(_estimate, "with_matches", faked)
    monkeypatch.setattr(_estimate, "_FEWEST_MATCHES", fewest)
    run = app.smooth_recording(short, vessel, scans=app.Scans((bag / "run",), bag))
    used = [len([row for row in s.ledger if row.sensor == "gnss"]) for s in (*around, run.solution)]
    assert used == ([len(fixes), 11, 12] if again else [len(fixes), 11])
    assert lengths_s[-1:] == [submap_s]
    assert lengths_s[:-1] == ([0.0] if again else [])
    assert [w for w in run.recording.warnings if "turned" in w] == [
        "turned, 1"
    ]  # the second track has the first matches


@pytest.mark.parametrize(
    ("beyond", "grown"),
    [
        ((6, 3, 0), [4, 8]),  # until all are within reach
        ((6, 3, 3), [4, 8]),  # or nothing is gained
        ((6, 6), [4]),
        ((0,), []),
    ],
)
def test_a_track_without_gnss_is_grown_from_matches_within_reach(
    beyond: tuple[int, ...], grown: list[int], bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """80 s without GNSS among fingers 10 m apart, offline: 20 m off, as of far scans only the next finger was in the window; online 0.4 m."""
    recording, vessel = loaded(bag)
    alone = vessel.sensors["aerial"].model_copy(update={"submap_s": 0.0})
    vessel = vessel.model_copy(update={"sensors": vessel.sensors | {"aerial": alone}})
    assert recording.imu is not None
    until_ns = int(recording.imu.stamps_ns[0]) + 5 * S
    imu = recording.imu.where(recording.imu.stamps_ns < until_ns)
    fixes = tuple(m for m in recording.measurements if m.sensor == "gnss" and m.stamp_ns < until_ns)
    short, rounds, around = replace(recording, measurements=fixes, imu=imu), iter(beyond), list[Solution]()

    def faked(given: Recording, _config: VesselConfig, _datum: Datum, solution: Solution, *_: object) -> Matches:
        around.append(solution)
        found, left = fixes[: 9 + len(around)], next(rounds, 0)
        return Matches(
            replace(given, measurements=found), left > 0, [], (), frozenset(m.seq for m in found[len(found) - left :])
        )

    monkeypatch.setattr(_estimate, "with_matches", faked)
    monkeypatch.setattr(_estimate, "_matches_used", lambda *_: 5)
    app.smooth_recording(short, vessel, scans=app.Scans((bag / "run",), bag))
    used = [len([row for row in s.ledger if row.sensor == "gnss"]) for s in around]
    assert used[: 1 + len(grown)] == [len(fixes), *grown]


def test_scans_are_laid_together(bag: Path) -> None:
    """Five scans of a moving vessel, or one and those of the seconds before, show more places than one, and at the same pose."""
    one, *several = (matched_alone(bag, submap=n, submap_s=s)[0] for n, s in ((1, 0.0), (5, 0.0), (1, 15.0)))
    for more in several:
        assert len(more.found.faces_m) > 1.15 * len(one.found.faces_m)
        off = more.modes[0].pose - one.modes[0].pose
        assert np.hypot(*off[:2]) < 0.3
        assert np.degrees(abs(off[2])) < 0.5


@pytest.mark.usefixtures("unseen")
def test_bl_gets_single_scans(bag: Path) -> None:
    bl, one, more = (
        matched(bag, track, sensor, at_ns=int(track.stamps_ns[0]) + 3 * S)[0].match
        for sensor, track in (aerial(bag, **c) for c in ({"matcher": "bl"}, {"submap_s": 0.0}, {}))
    )
    assert bl is not None
    assert one is not None
    assert more is not None
    assert len(bl.found.faces_m) == len(one.found.faces_m) < len(more.found.faces_m)


def test_lines_alone_and_bl_can_be_matched_to(bag: Path, tmp_path: Path) -> None:
    """What stands still in the harbour, drawn as GeoJSON, without an image; and BL's matcher on the image."""
    harbour = load_harbour("marina")
    features = []
    for kind, tag in (("quays", "quay"), ("pontoons", "pier"), ("buildings", "pier")):
        for polygon, _ in getattr(harbour, kind):
            ring = np.array(polygon.exterior.coords)
            geodetic = harbour.datum.geodetic_from_enu(np.column_stack([ring, np.zeros(len(ring))]))
            shape = {"type": "Polygon", "coordinates": [geodetic[:, [1, 0]].tolist()]}
            features.append({"type": "Feature", "properties": {"man_made": tag}, "geometry": shape})
    (tmp_path / "quays.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    shift = np.array(json.loads((bag / "truth.json").read_text())["image_shows_things_east_north_m"])
    for changes, off in (
        ({"image": "", "vector": str(tmp_path / "quays.geojson")}, np.zeros(2)),
        ({"matcher": "bl"}, shift),
    ):
        match, true = matched_alone(bag, **changes)
        assert np.hypot(*(match.modes[0].pose[:2] - true - off)) < 0.25


def test_a_hull_that_was_left_out_is_named(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Her own points were the first returns, and no line said so. The simulator's hull is 14.3 m by 4.2 m."""
    monkeypatch.setattr(matcher, "_LEAST_PLACES", 10**9)  # what stays is told of scans that are not matched as well
    for hull_m, expected in ((None, 0), ((), 1)):
        said: list[str] = []
        changes = {} if hull_m is None else {"hull_m": hull_m}
        sensor, track = aerial(bag, every_m=0.0, submap_s=0.0, **changes)  # of each scan it is looked at alone, anyway
        list(matching(bag, track, sensor, warn=said.append))
        assert len(said) == expected
    box = np.array(json.loads(said[0].partition("at least hull_m: ")[2]))
    assert (box >= (-7.5, -2.6)).all()
    assert (box <= (7.8, 2.6)).all()
    assert (np.ptp(box, axis=0) > (10.0, 3.0)).all()  # as far as her LiDARs see her


@pytest.mark.parametrize(("matched", "doubted"), [(0, ""), (5, "; the 5 others may well be false"), (20, "")])
def test_few_matches_among_many_scans_are_doubted(matched: int, doubted: str) -> None:
    """A LiDAR upside down in the configuration: 5 of 49 scans matched, all false, and drew the track 5 m along."""
    (line,) = few_matches("aerial", Counter({"no pose in the window stands out": 33, "too few to match": 11}), matched)
    assert line.startswith("aerial: 44 scans gave no match, 33 of them: no pose in the window stands out")
    assert line.endswith(f"`graphloc match` shows one{doubted}")


def test_few_matches_after_a_way_over_open_water_are_not_doubted() -> None:
    """A scan of water alone speaks against nothing: most of a voyage that ends in a harbour has no other ones."""
    (line,) = few_matches("aerial", Counter({"a scan of water alone": 90, "no pose in the window stands out": 10}), 20)
    assert line.endswith("`graphloc match` shows one")


@pytest.mark.usefixtures("unseen")
def test_a_broken_scan_is_a_row_of_the_ledger(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, count = scans.decode_cloud, iter(range(10**6))

    def sometimes(msg: Any, stamp_ns: int, lidar: str) -> Cloud:
        if next(count) == 52:
            raise ValueError("a cloud of 5 points with 3 bytes")
        return whole(msg, stamp_ns, lidar)

    monkeypatch.setattr(scans, "decode_cloud", sometimes)
    sensor, track = aerial(bag, every_m=30.0)
    said = [m.why_not for m in matched(bag, track, sensor) if m.match is None]
    assert len(said) == 1
    assert "points: a cloud of 5 points with 3 bytes" in said[0]


def test_an_image_of_water_alone_gives_nothing(bag: Path, tmp_path: Path) -> None:
    with rasterio.open(bag / "aerial.tif") as source:
        profile, shape = source.profile, source.read().shape
    noise = np.random.default_rng(0).normal(0.0, 3.0, shape)
    with rasterio.open(tmp_path / "sea.tif", "w", **profile) as target:
        target.write(np.clip(np.array([38, 62, 72])[:, None, None] + noise, 0, 255).astype(np.uint8))
    sensor, track = aerial(bag, image=str(tmp_path / "sea.tif"))
    found = matched(bag, track, sensor, at_ns=int(track.stamps_ns[0]) + 10 * S)
    assert found
    assert {m.why_not for m in found} == {"no pose in the window stands out"}


def test_a_sensor_without_a_map_is_one_line(bag: Path) -> None:
    sensor, track = aerial(bag, image="")
    with pytest.raises(InputError, match="needs an `image`, a `vector` layer, or both"):
        matched(bag, track, sensor)
    sensor, track = aerial(bag, image="", vector="x.geojson", matcher="bl")
    with pytest.raises(InputError, match="matcher: bl needs an `image`"):
        matched(bag, track, sensor)


def test_inspect_drafts_the_lidars(bag: Path, tmp_path: Path) -> None:
    """The draft works as it stands: the LiDARs with the mounts that /tf_static knows, switched off for want of a map."""
    found = inspect_bag(bag / "run")
    assert [(x.topic, x.tf_frame) for x in found.lidars] == [(f"/lidar_{k}/points", f"lidar_{k}") for k in range(1, 6)]
    (tmp_path / "vessel.yaml").write_text(draft_config(found))
    _, vessel = app.load([bag / "run"], tmp_path / "vessel.yaml")
    sensor = vessel.sensors["aerial"]
    assert not sensor.enabled
    assert [(x.topic, x.mount.tf_frame) for x in sensor.lidars.values()] == [
        (x.topic, x.tf_frame) for x in found.lidars
    ]


@pytest.mark.usefixtures("unseen")
def test_matches_near_each_other_tell_less(bag: Path) -> None:
    """Errors are alike over the distance to what is in view, 15 m at least."""
    sensor, track = aerial(bag, every_m=0.0, every_s=3.0)
    found = [m for m in matched(bag, track, sensor) if m.match is not None and m.match.modes]
    assert found[0].since is None
    for before, item in pairwise(found):
        assert before.match is not None
        assert item.match is not None
        assert item.since is not None
        way_m = np.hypot(*(item.match.prior.pose - before.match.prior.pose)[:2])
        seen_m = np.median(np.hypot(*np.vstack([item.match.found.faces_m, item.match.found.shore_m]).T))
        assert item.since.way == pytest.approx(way_m / max(15.0, seen_m), rel=1e-6)
        assert item.since.waited_s == pytest.approx((item.stamp_ns - before.stamp_ns) * 1e-9)


def test_what_is_independent_of_the_match_before() -> None:
    """Of a first-order Markov process along the way a next one tells (1 - r) / (1 + r) of a mean, r = exp(-way), also of which mode
    is right; r = exp(-waited / carried) if inertial sensors forget sooner: 0.1 m in 5 s, with the square of time, 0.5 deg in 60 s."""
    turn = rotation_from_rpy_deg(np.array([0.0, 0.0, 30.0]))
    cov = turn @ np.diag([0.4**2, 0.05**2, np.radians(1.0) ** 2]) @ turn.T
    modes = (Mode(np.zeros(3), cov, 0.6), Mode(np.ones(3), cov, 0.15))
    nothing = outline(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), None)
    match = Match(Prior(np.zeros(3), np.ones(3)), nothing, modes=modes, none=0.25)
    first, near, far = (match.fix(0, "a", since) for since in (None, Since(0.1, 4.0), Since(2.0, 4.0)))
    np.testing.assert_allclose(first.modes[0].cov, cov)
    assert [m.probability for m in first.modes] == pytest.approx([0.6, 0.15])
    for fix, ways in ((near, (0.4, 0.8, 0.1)), (far, (2.0, 2.0, 2.0))):  # 4 s of 10 s, 5 s and 120 s
        told = (1.0 - np.exp(-np.array(ways))) / (1.0 + np.exp(-np.array(ways)))
        np.testing.assert_allclose(turn.T @ fix.modes[0].cov @ turn, turn.T @ cov @ turn / told, atol=1e-9)
    for fix, way in ((near, 0.1), (far, 2.0)):
        r = np.exp(-way)
        assert fix.news == pytest.approx((1.0 - r) / (1.0 + r))
        assert fix.none_probability == pytest.approx(0.25)
        assert fix.modes[0].probability / fix.modes[1].probability == pytest.approx(4.0**fix.news)
    again = match.fix(0, "a", Since(0.0, 0.0))  # a scan under the stamp of the one before, at rest
    assert again.news == 0.0
    assert np.linalg.eigvalsh(again.modes[0].cov).min() > 1e3 * np.linalg.eigvalsh(cov).max()


def test_lines_elsewhere_change_nothing(bag: Path, tmp_path: Path) -> None:
    """One drawn line 130 m away: the image is matched as if it were not there."""
    datum = Datum(load_harbour("marina").config.datum.geodetic)
    ends = datum.geodetic_from_enu(np.array([(-20.0, 130.0, 0.0), (0.0, 130.0, 0.0)]))
    line = {"type": "LineString", "coordinates": ends[:, [1, 0]].tolist()}
    (tmp_path / "line.geojson").write_text(json.dumps(line))
    poses = [
        matched_alone(bag, submap=5, **v)[0].modes[0].pose for v in ({}, {"vector": str(tmp_path / "line.geojson")})
    ]
    # Layers are kept in 255 parts of the largest weight, which is another one with lines.
    np.testing.assert_allclose(poses[0][:2], poses[1][:2], atol=0.03)


def test_a_prior_that_misses_gives_no_sure_match(bag: Path) -> None:
    """8 and 20 m beside the truth, and said to be off by 10 m: the window may miss, so nothing in it is sure."""
    sensor, track = aerial(bag, every_m=20.0)
    for off in (8.0, 20.0):
        moved = replace(
            track, p_world_m=track.p_world_m + np.array([0.6 * off, 0.8 * off, 0.0]), cov=100.0 * np.asarray(track.cov)
        )  # fmt: skip
        claims = [1.0 - m.match.none for m in matched(bag, moved, sensor) if m.match]
        assert max(claims, default=0.0) < 0.6
    claims = [1.0 - m.match.none for m in matched(bag, track, sensor) if m.match]
    assert min(claims) > 0.8


@pytest.mark.usefixtures("unseen")
def test_one_stamp_of_the_future_costs_one_match(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, count = scans.decode_cloud, iter(range(10**6))

    def sometimes(msg: Any, stamp_ns: int, lidar: str) -> Cloud:
        return whole(msg, stamp_ns + (3600 * S if next(count) == 52 else 0), lidar)

    lidars = {name: lidar for name, lidar in aerial(bag)[0].lidars.items() if name in ("lidar_3", "lidar_4")}
    sensor, track = aerial(bag, every_m=0.0, still_s=0.5, lidars=lidars)
    usual = len(matched(bag, track, sensor))
    monkeypatch.setattr(scans, "decode_cloud", sometimes)
    found = matched(bag, track, sensor)
    (lost,) = [m.why_not for m in found if m.match is None]
    assert "outside of the track" in lost
    assert "lidar_3 +36" in lost
    assert len(found) - 1 >= usual - 1


@pytest.mark.usefixtures("unseen")
def test_lidar_clocks_can_be_set_right(bag: Path) -> None:
    sensor, track = aerial(bag)
    later, _ = aerial(bag, time_offset_s=0.25)
    stamps, moved = (next(matching(bag, track, s)).stamp_ns for s in (sensor, later))
    assert moved - stamps == 250_000_000


def test_turns_of_lidars_at_different_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    """One at 3 Hz, one at 1 Hz that falls silent: a turn as soon as there is one of each, else what there is."""
    fast = [(k / 3.0, "fast") for k in range(15)]
    slow = [(k + 0.1, "slow") for k in range(3)]

    class Heap:
        def messages(self, _topics: set[str]) -> list[RawMessage]:
            return [RawMessage(f"/{n}", CLOUD, b"", int(t * S), "") for t, n in sorted(fast + slow)]  # type: ignore[arg-type]

        def decode(self, raw: RawMessage) -> RawMessage:
            return raw

    monkeypatch.setattr(scans, "stamp_ns_of", lambda raw, _type, log_ns, **_: log_ns)
    monkeypatch.setattr(
        scans, "decode_cloud",
        lambda raw, stamp, name: Cloud(name, stamp, np.ones((1, 3)), np.array([stamp], dtype=np.int64)),
    )  # fmt: skip
    config = AerialConfig(lidars={n: LidarConfig(topic=f"/{n}") for n in ("fast", "slow")})
    turns = list(scans._turns(Heap(), config, scans._Heard(config.lidars)))  # type: ignore[arg-type]  # noqa: SLF001
    together = [t for t in turns if len(t.clouds) == 2]
    assert len(together) == 3
    assert max(abs(t.clouds[0].stamp_ns - t.clouds[1].stamp_ns) for t in together) < 0.4 * S
    assert [t.stamp_ns > 3.5 * S for t in turns if len(t.clouds) == 1].count(True) >= 2  # the other one goes on alone
