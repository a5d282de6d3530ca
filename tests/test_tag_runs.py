# SPDX-License-Identifier: Apache-2.0
"""Whole docking runs by tags, without images: how good they are, and what is said where survey, clock or mount is wrong.

Corners are true ones with noise (`tests/tagfactory.py`). The vessel goes twice as fast as in `dock-*-optimal`, which makes
a run of 60 s; three tags a metre and a half apart, first seen at 25 m, berth at 2.5 m. GNSS drifts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from graphloc import app
from graphloc.berths import seen_from
from graphloc.eval.simulate import SimulatedRun, find_scenario, simulate
from graphloc.eval.simulate._light import tag_in_world
from graphloc.eval.simulate.scene import scene_of
from graphloc.eval.tag_check import suspect_tags
from graphloc.frames import Array, wrap_angle
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import CompassHeading, GnssPosition, Measurement, TagSighting, TagView
from graphloc.survey import Survey, TagConfig, load_survey
from tests import tagfactory
from tests.slowly import beside_filters, sparsely, with_few_states

S = 1_000_000_000
QUAY = (226, 227, 228)
HZ = 1.0  # of the images
_LESS = {"imu_hz": "50", "gnss_hz": "2", "compass_hz": "2", "lidar_hz": "0", "camera_hz": "0"}

Sightings = list[tuple[TagSighting, int]]
Change = Callable[[Measurement], Measurement | None]


@dataclass(frozen=True)
class Docked:
    """A run that was solved; which mode of each sighting is right; what was said."""

    truth: SimulatedRun
    run: app.Run
    right: dict[int, int]

    @property
    def said(self) -> str:
        return "\n".join([*self.run.recording.warnings, *self.run.solution.stats.warnings])

    @property
    def table(self) -> dict[str, float | None]:
        (found,) = [t for t in app.tables(self.run) if t.title == "Docking"]
        return found.as_dict()["graphloc"]

    def number(self, column: str) -> float:
        value = self.table[column]
        assert value is not None
        return value

    def outcomes(self) -> dict[str, int]:
        return self.run.solution.ledger.counts()["tags"]

    def heading_error_deg(self) -> Array:
        track = self.run.solution.trajectory
        kept = self.truth.truth.covers(track.stamps_ns)
        true = self.truth.truth.at(track.stamps_ns[kept])
        return np.degrees(wrap_angle(track.yaw_rad[kept] - true.yaw_rad))


@cache
def voyage(kind: str, seed: int = 1, lasts_s: float = 47.0, route_s: float = 60.0) -> SimulatedRun:
    """From 47 s on the vessel lies still, which is left out where nothing comes of it: half the time of solving.

    Where it does not matter how fast she goes, she goes twice as fast (`route_s` of 30 s), which is half of it again.
    """
    changes = {**_LESS, "duration_s": f"{lasts_s:g}", "route_s": f"{route_s:g}"}
    return simulate(find_scenario(f"dock-{kind}-optimal", changes), seed)


@cache
def sighted(
    kind: str,
    tag: Callable[[TagConfig], TagConfig | None] | None,
    alone: bool,
    only: tuple[int, ...],
    hidden_s: tuple[float, float],
    lasts_s: float,
    rate_hz: float,
    route_s: float,
) -> tuple[SimulatedRun, list[tuple[TagSighting, int]]]:
    """See `dock`."""
    whole = tagfactory.survey_of

    def surveyed(of: SimulatedRun) -> Survey:
        survey = whole(of)
        kept = [changed for t in survey.tags if (changed := tag(t) if tag else t) is not None]
        return survey.model_copy(update={"tags": tuple(kept)})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tagfactory, "survey_of", surveyed)
        return tagfactory.sighted(
            voyage(kind, lasts_s=lasts_s, route_s=route_s), rate_hz=rate_hz, alone=alone, only=only, hidden_s=hidden_s
        )


def dock(
    kind: str = "fixed",
    *,
    change: Change | None = None,
    tag: Callable[[TagConfig], TagConfig | None] | None = None,
    views: tuple[TagView, ...] = (),
    compare: bool = False,
    alone: bool = False,
    only: tuple[int, ...] = (),
    hidden_s: tuple[float, float] = (0.0, 0.0),
    lasts_s: float = 47.0,
    rate_hz: float = HZ,
    route_s: float = 60.0,
    mount_sigma_deg: float = 1.0,
    states_hz: float = 1.25,
    every: int = 1,
) -> Docked:
    """Solve a run; `change` of each measurement, `tag` of each in the survey (None: without it).

    How good a run at a fixed dock is, is asked of one with twice as many states a second: half of them are enough for what is said of it.
    And every second fix and heading (`every`).
    """
    true = voyage(kind, lasts_s=lasts_s, route_s=route_s)
    seen, numbered = sighted(kind, tag, alone, only, hidden_s, lasts_s, rate_hz, route_s)
    kept = (c for m in seen.recording.measurements if (c := change(m) if change else m) is not None)
    ordered = tuple(sorted(kept, key=lambda m: (m.stamp_ns, m.seq)))
    recording = replace(seen.recording, measurements=ordered, tag_views=views)
    tags = seen.config.sensors["tags"]
    cameras = {name: c.model_copy(update={"mount_sigma_deg": mount_sigma_deg}) for name, c in tags.cameras.items()}
    sensors = seen.config.sensors | {"tags": tags.model_copy(update={"cameras": cameras})}
    config = with_few_states(seen.config.model_copy(update={"sensors": sensors}), rate_hz=states_hz)
    solve = beside_filters if compare else app.simulated
    changed = replace(seen, recording=recording, config=config)
    run = solve(sparsely(changed, every) if every > 1 else changed)
    return Docked(true, run, {m.seq: right for m, right in numbered})


@cache
def alone(compass_off_deg: float = 0.0) -> Docked:
    """A run without its tags: as it goes where all of them are refused."""

    def changed(m: Measurement) -> Measurement | None:
        if isinstance(m, TagSighting):
            return None
        return turned_compass(m, compass_off_deg) if isinstance(m, CompassHeading) else m

    return dock(change=changed, lasts_s=20.0, route_s=30.0)


def said_of_refused(
    *,
    tag: Callable[[TagConfig], TagConfig] | None = None,
    change: Change | None = None,
    compass_off_deg: float = 0.0,
) -> list[str]:
    """What is said of tags or a camera whose sightings a run refuses, all of them."""
    run = alone(compass_off_deg).run
    seen, numbered = sighted("fixed", tag, False, (), (0.0, 0.0), 20.0, HZ, 30.0)
    sightings = [change(m) if change else m for m, _ in numbered]
    recording = replace(run.recording, measurements=(*run.recording.measurements, *(m for m in sightings if m)))
    refused = [
        LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor="tags", topic="", outcome=Outcome.REJECTED, weight=0.0)
        for m, _ in numbered
    ]
    solution = replace(run.solution, ledger=Ledger((*run.solution.ledger, *refused)))
    return suspect_tags(recording, seen.config, solution)


def turned_compass(m: CompassHeading, by_deg: float) -> CompassHeading:
    return replace(m, yaw_rad=m.yaw_rad + np.radians(by_deg))


def without(*kinds: type[Measurement]) -> Change:
    return lambda m: None if isinstance(m, kinds) else m


def late(by_s: float) -> Change:
    return lambda m: replace(m, stamp_ns=m.stamp_ns + round(by_s * S)) if isinstance(m, TagSighting) else m


def off(number: int, shift: tuple[float, float, float]) -> Callable[[TagConfig], TagConfig]:
    def moved(t: TagConfig) -> TagConfig:
        xyz = tuple(float(a + b) for a, b in zip(t.xyz_m, shift, strict=True))
        return t.model_copy(update={"xyz_m": xyz}) if t.id == number else t

    return moved


def sized(size_m: float, *numbers: int) -> Callable[[TagConfig], TagConfig]:
    return lambda t: t.model_copy(update={"size_m": size_m}) if not numbers or t.id in numbers else t


def wrong_modes(docked: Docked) -> float:
    """Share of sightings whose chosen mode lies 2 deg farther from the truth, on a fixed dock, than another one.

    Where the truth is in the middle between both, which of them is the nearer one is as good as drawn.
    """
    of = {m.seq: m for m in docked.run.recording.measurements if isinstance(m, TagSighting)}
    wrong = 0
    for row in docked.run.solution.ledger:
        if row.seq in of and row.mode is not None:
            m = of[row.seq]
            true = docked.truth.truth.at(np.array([m.stamp_ns])).R_world_body[0] @ m.R_body_camera
            away = [tagfactory.degrees_between(mode.R_world_camera, true) for mode in m.modes]
            wrong += away[row.mode] > min(away) + 2.0
    return wrong / len(of)


# what it shows


def unlisted(run: SimulatedRun, number: int, size_m: float, rate_hz: float = HZ) -> tuple[TagView, ...]:
    """Views of one of the quay's tags as one that is in no survey, and of this size."""
    assert run.harbour is not None
    rng, scene, camera = np.random.default_rng(5), scene_of(run), run.rig.cameras["camera"]
    (tag,) = (t for t in run.harbour.config.tags if t.number == number)
    found = []
    times_s = np.arange(0.3 / rate_hz, min(50.0, run.scenario.duration_s - 0.2), 1.0 / rate_hz)
    for t in times_s[times_s > 20.0]:
        p, R, _ = (v[0] for v in run.motion.pose(np.array([t])))
        at, turned = tag_in_world(tag, run.harbour, scene, float(t))
        R_camera = R @ camera.mount.R_body_sensor
        rays = tagfactory.rays_of(
            at + size_m * tagfactory.UNIT @ turned.T, p + R @ camera.mount.t_body_sensor_m, R_camera
        )
        noise = 0.15 / camera.focal_px[0]
        found.append(
            TagView(
                stamp_ns=int(run.truth.stamps_ns[0]) + round(t * S), camera="camera", family="36h11", number=99,
                rays=rays + rng.normal(0.0, noise, (4, 2)), cov=np.eye(8) * noise**2,
                t_body_camera_m=camera.mount.t_body_sensor_m, R_body_camera=camera.mount.R_body_sensor,
            )
        )  # fmt: skip
    return tuple(found)


@pytest.fixture(scope="module")
def fixed() -> Docked:
    return dock(compare=True, views=unlisted(voyage("fixed"), 228, 0.3), states_hz=2.5)


@pytest.fixture(scope="module")
def floating() -> Docked:
    return dock("floating", views=unlisted(voyage("floating"), 232, 0.3, 2.0), rate_hz=2.0)


@pytest.fixture(scope="module")
def fixed_turned() -> Docked:
    """The configured mount of the camera is 3 deg off."""
    about = Rotation.from_euler("z", 3.0, degrees=True).as_matrix()
    views = unlisted(voyage("fixed"), 228, 0.3)
    turned_views = tuple(replace(v, R_body_camera=about @ v.R_body_camera) for v in views)
    return dock(change=turned(3.0), views=turned_views, states_hz=2.5)


@pytest.fixture(scope="module")
def late_run() -> Docked:
    return dock(change=late(0.2), lasts_s=24.0, rate_hz=2.0, route_s=30.0, states_hz=2.5, every=2)


def test_a_fixed_dock(fixed: Docked) -> None:
    """D.1: 95 % within 0.10 m nearer than 8 m, RMSE 0.25 m from the first sighting on; GNSS alone is metres off."""
    assert all(fixed.number(f"position_p95_{band}_m") < 0.06 for band in ("0_to_5", "5_to_8"))
    assert fixed.number("sighted_rmse_m") < 0.08
    assert fixed.number("dnv_met") == 1.0
    assert fixed.outcomes() == {"used": len(fixed.right)}
    assert "disagree" not in fixed.said
    assert "stamps are" not in fixed.said


def test_a_floating_dock(floating: Docked) -> None:
    """D.5: seen from the berth 95 % within 0.10 m nearer than 5 m, and with bounds that hold; in world as good as GNSS."""
    off_m, squared, range_m = at_berth(floating)
    assert np.percentile(off_m[range_m < 5.0], 95) < 0.05
    assert np.percentile(off_m[range_m < 20.0], 95) < 0.30
    assert 0.2 < squared[range_m < 25.0].mean() / 3.0 < 2.5
    assert floating.number("berth_p95_m") < 0.5
    assert floating.outcomes() == {"used": len(floating.right)}


def at_berth(docked: Docked) -> tuple[Array, Array, Array]:
    """Horizontal error, NEES (3 degrees), and distance of the camera (N,), of what is seen from the only berth."""
    (track,) = docked.run.solution.berths
    assert track.cov is not None
    stamps = track.stamps_ns
    kept = docked.truth.truth.covers(stamps)
    true = docked.truth.truth.at(stamps[kept])
    t = (stamps[kept] - docked.truth.truth.stamps_ns[0]) * 1e-9
    moved = np.zeros((len(t), 4))
    for of in docked.truth.docks:
        if of.dock.name == track.berth.name:
            p, R = of.pose(t)
            moved = np.column_stack([p[:, :2] - of.rest_m, p[:, 2], np.arctan2(R[:, 1, 0], R[:, 0, 0])])
    value, _ = seen_from(track.berth, true.p_world_m, true.yaw_rad, moved)
    error = track.value[kept] - value
    error[:, 2] = wrap_angle(error[:, 2])
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.cov[kept]), error)
    bow = true.p_world_m + true.R_world_body @ docked.truth.rig.cameras["camera"].mount.t_body_sensor_m
    range_m = np.linalg.norm((bow - track.berth.point_m)[:, :2], axis=1)
    return np.hypot(error[:, 0], error[:, 1]), squared, range_m


def test_bounds_at_the_berth_hold(fixed: Docked) -> None:
    off_m, squared, range_m = at_berth(fixed)
    near = range_m < 25.0
    assert 0.2 < squared[near].mean() / 3.0 < 2.5
    assert (squared[near] < chi2.ppf(0.95, 3)).mean() > 0.8
    assert np.percentile(off_m[range_m < 5.0], 95) < 0.05


@pytest.mark.usefixtures("map_alone")
def test_a_tag_that_is_not_surveyed_is_found(fixed: Docked, tmp_path: Path) -> None:
    """One of 0.3 m where tag 228 hangs; it is written with the others, and the file is a survey."""
    app.write(fixed.run, tmp_path / "out", inputs=[], command="", overwrite=False)
    found = load_survey(tmp_path / "out" / "tags.found.yaml")
    tags = {tag.id: tag for tag in found.tags}
    assert {*QUAY, 99} <= set(tags)
    np.testing.assert_allclose(tags[99].xyz_m, [73.4, 96.0, 1.5], atol=0.05)
    assert tags[99].size_m == pytest.approx(0.3, rel=0.02)
    assert "tag 99: not in the survey; its estimated pose is in tags.found.yaml" in fixed.said


def test_a_tag_that_is_not_surveyed_rides_on_the_dock_beside_whose_tags_it_is_seen(floating: Docked) -> None:
    """In world it would be where the dock was, on the mean, in half a minute: the next run finds it elsewhere."""
    (tag,) = floating.run.tags
    (true,) = (t for t in tagfactory.survey_of(floating.truth).tags if t.id == 232)
    assert tag.frame == true.frame == "north_dock"
    np.testing.assert_allclose(tag.xyz_m, true.xyz_m, atol=0.06)
    assert tagfactory.degrees_between(tag.R_frame_tag, true.R_frame_tag) < 2.0
    assert "tag 99: not in the survey; seen only beside tags of north_dock, so placed on that dock in " in floating.said


def test_the_filter_of_digerud_stands_beside_it(fixed: Docked) -> None:
    (table,) = [t for t in app.tables(fixed.run) if t.title == "Docking"]
    (his,) = [row for name, row in table.as_dict().items() if "Digerud" in name]
    matched = his["matched"]
    assert matched is not None
    assert matched > 0.9
    assert (his["sighted_rmse_m"] or 0.0) > fixed.number("sighted_rmse_m")


def test_gnss_is_cut_and_the_tags_are_hidden() -> None:
    """D.3: no fix from 20 m on, no tag for 5 s on the way in; 0.15 m at the berth."""
    start = int(voyage("fixed").truth.stamps_ns[0])
    cut = dock(
        change=lambda m: None if isinstance(m, GnssPosition) and m.stamp_ns > start + 17 * S else m,
        hidden_s=(28.0, 33.0),
    )
    assert cut.number("berth_p95_m") < 0.10
    assert cut.number("wrong_side") == 0.0


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_tags_that_are_first_seen_near_the_berth_are_believed(kind: str) -> None:
    """GNSS has drifted by a metre and more till then: linear about a place that far off, right sightings look false."""
    fast = simulate(find_scenario(f"dock-{kind}-optimal", {**_LESS, "duration_s": "25", "route_s": "25"}), 1)
    run, _ = tagfactory.sighted(fast, rate_hz=4.0, hidden_s=(0.0, 15.0))
    found = app.smooth_recording(run.recording, with_few_states(run.config)).solution
    assert set(found.ledger.counts()["tags"]) == {"used"}
    track = found.trajectory
    off_m = np.hypot(*(track.p_world_m - run.truth.at(track.stamps_ns).p_world_m)[:, :2].T)
    assert off_m[track.stamps_ns > track.stamps_ns[0] + 16 * S].max() < 0.4


def test_a_single_tag_without_a_compass() -> None:
    """Its modes are the only heading there is: it is right from the beginning to the end."""
    docked = dock(change=without(CompassHeading), only=(227,))
    assert np.abs(docked.heading_error_deg()).max() < 2.0
    assert wrong_modes(docked) <= 0.005
    assert docked.number("berth_p95_m") < 0.15


# what is wrong is said


def test_a_tag_that_stands_elsewhere_is_named() -> None:
    """Half a metre east of its place, 50 of its sigmas."""
    docked = dock(tag=off(227, (0.5, 0.0, 0.0)), lasts_s=40.0, rate_hz=1.0, states_hz=2.5, every=2)
    assert "tags: tag 227: " in docked.said
    assert "tag 227: the tags beside it, which agree, show it -0.5 m east" in docked.said
    assert docked.number("position_p95_0_to_5_m") < 0.08


def test_a_tag_that_misleads_the_run_is_named() -> None:
    """Half a metre north, in depth, at the end of the row: far off that looks as if all were turned by 13 deg.

    Who is to blame shows in images from near; the tails of its prior let it go. With a Gaussian one: 0.5 m at the berth.
    """
    docked = dock(tag=off(226, (0.0, 0.5, 0.0)), states_hz=2.5, every=2)
    assert "tags: tag 226: the tags beside it, which agree, show it " in docked.said
    assert "-0.5 m north" in docked.said.split("tag 226: ")[1].splitlines()[0]
    assert docked.number("position_p95_0_to_5_m") < 0.12


def test_tags_that_face_the_other_way_in_the_survey_are_named() -> None:
    """`facing_deg` as the direction in which one looks at them: their sightings were laid to a camera that looks elsewhere."""

    def turned(tag: TagConfig) -> TagConfig:
        assert tag.rpy_deg is not None
        roll, pitch, yaw = tag.rpy_deg
        return tag.model_copy(update={"rpy_deg": (roll, pitch, yaw + 180.0)})

    said = dock(tag=turned, lasts_s=17.0, route_s=30.0, every=2).said
    assert "tag 226, tag 227, tag 228: by the fixes they are seen from behind" in said
    assert "off its mount:" not in said


def test_tags_whose_faces_are_given_in_another_convention_are_named() -> None:
    """`facing_deg` counted from east, a quarter turn off: it was said that the camera looks elsewhere."""

    def turned(tag: TagConfig) -> TagConfig:
        heading = float(np.degrees(np.arctan2(*tag.R_frame_tag[:2, 2])))
        return tag.model_copy(update={"rpy_deg": None, "facing_deg": heading + 90.0})

    said = said_of_refused(tag=turned)
    lines = [line for line in said if "it stands where the survey says, and faces" in line]
    assert [line.split(":")[1].strip() for line in lines] == ["tag 226", "tag 227", "tag 228"]
    for line in lines:
        right, told = (float(part.split()[-1]) for part in line.split(" would do")[0].split(" instead of "))
        assert (told - right) % 360.0 == pytest.approx(90.0, abs=5.0)
    assert not any("off its mount:" in line for line in said)


def test_tags_whose_faces_are_all_a_little_off_are_named_beside_the_mount() -> None:
    """By 25 deg: no other convention, but no mount of the camera either, by which it was said that it looks 10 deg elsewhere.

    Where the run is bent instead (20 deg, or by an image a second), compass and tags are named as off, and what they have in common is not.
    """

    def turned(tag: TagConfig) -> TagConfig:
        heading = float(np.degrees(np.arctan2(*tag.R_frame_tag[:2, 2])))
        return tag.model_copy(update={"rpy_deg": None, "facing_deg": heading - 25.0})

    (line,) = (line for line in said_of_refused(tag=turned) if "off its mount:" in line)
    other = line.split("they all face ")[1]
    assert float(other.split()[0]) == pytest.approx(25.0, abs=3.0)
    assert " clockwise than the survey says" in other


@pytest.mark.parametrize("swung_deg", [10.0, -10.0, 40.0, -40.0])
def test_a_face_is_turned_by_more_than_a_heading_may_be_off(swung_deg: float, fixed: Docked) -> None:
    """A track that swings about the quay, its heading with it, shows each tag turned by as much: 10 deg are no other convention."""
    solved = fixed.run.solution
    (tag,) = (t for t in tagfactory.survey_of(fixed.truth).tags if t.id == 227)
    about, swing = np.array(tag.xyz_m), Rotation.from_euler("z", swung_deg, degrees=True).as_matrix()
    track = solved.trajectory
    swung = replace(
        track, p_world_m=(track.p_world_m - about) @ swing.T + about, R_world_body=swing @ track.R_world_body
    )
    refused = Ledger(replace(row, weight=0.0) if row.sensor == "tags" else row for row in solved.ledger)
    lines = suspect_tags(
        fixed.run.recording, fixed.run.config, replace(solved, trajectory=swung, ledger=refused, slow={})
    )
    faces = [line for line in lines if "it stands where the survey says, and faces" in line]
    assert [line.split(":")[1].strip() for line in faces] == (
        ["tag 226", "tag 227", "tag 228"] if abs(swung_deg) > 30 else []
    )
    assert all(abs(float(line.split("faces ")[1].split()[0]) - abs(swung_deg)) < 4.0 for line in faces)


def test_a_quay_that_is_off_is_not_taken_for_tags_that_face_the_other_way() -> None:
    """By 13 m towards the water, seen at the berth alone: by the fixes the vessel is behind it, about as far as it looks."""

    def moved(tag: TagConfig) -> TagConfig:
        assert tag.rpy_deg is not None
        assert tag.xyz_m is not None
        out = Rotation.from_euler("ZYX", tag.rpy_deg[::-1], degrees=True).as_matrix()[:, 2]
        return tag.model_copy(update={"xyz_m": tuple(np.array(tag.xyz_m) + 13.0 * out)})

    first_ns = int(voyage("fixed", lasts_s=60.0).truth.stamps_ns[0])
    near = lambda m: m if not isinstance(m, TagSighting) or m.stamp_ns > first_ns + 40 * S else None
    said = dock(tag=moved, change=near, lasts_s=60.0).said
    assert "gnss has a constant offset of 14" in said
    assert "from behind" not in said


@pytest.mark.parametrize(("hanging", "whole"), [((226, 227, 228), False), ((227,), True)], ids=["all", "one"])
def test_tags_that_hang_upside_down_are_named(hanging: tuple[int, ...], *, whole: bool) -> None:
    """In a whole run, and where it refuses all. As those printed from OpenCV do: of eight warnings none said so, of the camera that it looks 117 deg elsewhere."""

    def turned(tag: TagConfig) -> TagConfig:
        if tag.id not in hanging:
            return tag
        heading = float(np.degrees(np.arctan2(*tag.R_frame_tag[:2, 2])))  # of its face
        told = tag.model_copy(update={"rpy_deg": (-90.0, 0.0, -heading), "facing_deg": None})
        half_turn = Rotation.from_matrix(tag.R_frame_tag.T @ told.R_frame_tag).as_rotvec(degrees=True)
        np.testing.assert_allclose(np.abs(half_turn), (0.0, 0.0, 180.0), atol=1.0)  # plates hang askew by that
        return told

    said = (
        dock(tag=turned, lasts_s=20.0, route_s=30.0, every=2).said.splitlines()
        if whole
        else said_of_refused(tag=turned)
    )
    (line,) = [line for line in said if "upside down" in line]
    assert line.startswith(f"tags: {', '.join(f'tag {number}' for number in hanging)}: upside down")
    assert "rpy_deg: [-90, 0, -F]" in line
    assert not any("off its mount:" in line for line in said)


def test_a_survey_of_heights_above_the_geoid_is_named() -> None:
    """25 m below the ellipsoid; where the compass is off by 10 deg, it was said that the camera looks 8 deg elsewhere."""
    lower = lambda t: t.model_copy(update={"xyz_m": (t.xyz_m[0], t.xyz_m[1], t.xyz_m[2] - 25.0)})
    said = said_of_refused(tag=lower, compass_off_deg=10.0)
    (line,) = [line for line in said if "its tags all put the vessel" in line]
    assert "heights above the geoid" in line
    up_m = float(line.split(" m above")[0].split()[-1])
    assert up_m == pytest.approx(-25.0, abs=2.0)
    assert not any("off its mount:" in line for line in said)


def test_one_tag_of_another_size_is_named() -> None:
    """0.162 m, the default of a well-known example, where 0.412 m hangs; one id in two families is two tags.

    226 of 36h11, and beside it 226 of 25h9, whose size is wrong: who is meant is said, and the other one is not.
    """

    def renamed(m: Measurement) -> Measurement:
        if not isinstance(m, TagSighting):
            return m
        return replace(m, numbers=tuple(226 if n == 227 else n for n in m.numbers))

    wrong = {"family": "25h9", "size_m": 0.162}
    docked = dock(
        tag=lambda t: t.model_copy(update=wrong) if t.id == 227 else t,
        change=renamed,
        lasts_s=60.0,
        states_hz=2.5,
        every=2,
    )
    (line,) = [line for line in docked.said.splitlines() if "size_m " in line]
    assert line.startswith("tags: tag 226 (25h9): ")
    assert float(line.split("size_m ")[1].split()[0]) == pytest.approx(0.412, rel=0.02)
    assert "tag 226 (36h11)" not in docked.said
    assert docked.number("sighted_rmse_m") < 0.08


def test_a_size_that_is_wrong_for_all_is_named() -> None:
    """The run follows some of them, and is metres off: what is said of sizes does not come of it, but of the images."""
    docked = dock(tag=sized(0.162), lasts_s=20.0, route_s=30.0, every=2)
    assert suggested_m(docked.said.splitlines()) == {number: pytest.approx(0.412, rel=0.02) for number in QUAY}


def test_the_size_of_a_tag_that_is_alone_is_named() -> None:
    """All of its sightings are refused, and the run goes where GNSS says, 1.4 m off: that does not matter to a size."""
    docked = dock(tag=sized(0.162), only=(227,), lasts_s=30.0, rate_hz=2.0, route_s=30.0)
    assert suggested_m(docked.said.splitlines()) == {227: pytest.approx(0.412, rel=0.02)}


def suggested_m(said: list[str]) -> dict[int, float]:
    """Sizes that warnings suggest, by tag."""
    found = {}
    for line in said:
        if "size_m " in line:
            found[int(line.split("tag ")[1].split(":")[0])] = float(line.split("size_m ")[1].split()[0])
    return found


def test_a_compass_that_is_mounted_askew_is_named() -> None:
    """By 10 deg: the tags tell the heading all the same."""

    docked = dock(change=lambda m: turned_compass(m, 10.0) if isinstance(m, CompassHeading) else m)
    assert np.abs(docked.heading_error_deg()).max() < 1.5
    assert "compass: its compass offset is estimated" in docked.said
    assert "check its mount" in docked.said
    assert docked.number("berth_p95_m") < 0.2


def test_a_camera_whose_clock_is_late_is_named(late_run: Docked) -> None:
    """By 0.2 s, in which waves turn the vessel by half a degree: 40 sigmas of a corner."""
    assert "of its measurements disagree with the rest" in late_run.said
    (line,) = (line for line in late_run.said.splitlines() if "tags: camera camera: its stamps are " in line)
    assert "s too late by how the vessel rolls" in line
    assert float(line.split("time_offset_s ")[1].split()[0]) == pytest.approx(-0.2, abs=0.02)
    assert late_run.outcomes().get("used", 0) < 0.1 * len(late_run.right)


def turned(by_deg: float, axis: str = "z") -> Change:
    """The configured mount, and with it nothing of what is seen, is turned about an axis of the body."""
    about = Rotation.from_euler(axis, by_deg, degrees=True).as_matrix()
    return lambda m: replace(m, R_body_camera=about @ m.R_body_camera) if isinstance(m, TagSighting) else m


@pytest.mark.parametrize(("kind", "costs_m"), [("fixed", 0.02), ("floating", 0.10)])
def test_a_camera_whose_mount_is_measured_by_hand_serves_as_well(
    kind: str, costs_m: float, fixed: Docked, floating: Docked, fixed_turned: Docked
) -> None:
    """By 3 deg it is off; that was 1.8 m at the berth, where every sighting was refused, and 2.7 deg of heading."""
    right = {"fixed": fixed, "floating": floating}[kind]
    docked = fixed_turned if kind == "fixed" else dock(kind, change=turned(3.0), rate_hz=2.0)
    assert docked.outcomes() == right.outcomes()
    assert docked.number("berth_p95_m") < right.number("berth_p95_m") + costs_m
    assert docked.number("berth_p95_m") < 0.25  # at the dock 0.38 m while waves could not lift it, exact mount or not
    assert np.abs(docked.heading_error_deg()).max() < 1.5
    mount = docked.run.solution.slow["tags"]
    yaw = mount.axes.index("camera mount yaw")
    assert abs(mount.value[-1, yaw] + 3.0) < min(3.0 * mount.sigma[-1, yaw], 0.9)


def test_a_tag_is_found_by_the_mount_that_the_run_has_found(fixed_turned: Docked) -> None:
    """By the configured one, 3 deg off, it was 0.3 m beside its place, stated to 0.05 m."""
    (tag,) = fixed_turned.run.tags
    np.testing.assert_allclose(tag.xyz_m, [73.4, 96.0, 1.5], atol=0.08)


@pytest.mark.parametrize("sigma_deg", [1.0, 0.0])
def test_a_camera_whose_mount_is_turned_is_named(sigma_deg: float) -> None:
    """It looks ahead, and the configuration has it look to port: what it truly is, is said, whether estimated or refused."""
    if sigma_deg:
        docked = dock(change=turned(90.0), lasts_s=20.0, route_s=30.0, mount_sigma_deg=sigma_deg)
        assert docked.outcomes()["used"] > 0.9 * len(docked.right)
        assert "tags: its camera's mount or clock is estimated" in docked.said
        lines = docked.said.splitlines()
    else:
        lines = said_of_refused(change=turned(90.0))
    (line,) = [text for text in lines if "off its mount" in text]
    assert "camera camera" in line
    # No better than the heading is, which the compass alone tells: to its deviation.
    assert float(line.split(" deg off its mount")[0].split()[-1]) == pytest.approx(90.0, abs=2.0)
    found = [float(a) for a in line.split("rpy_deg [")[1].split("]")[0].split(",")]
    true = voyage("fixed").rig.cameras["camera"].mount.R_body_sensor
    said = Rotation.from_euler("xyz", found, degrees=True).as_matrix()
    assert np.degrees(Rotation.from_matrix(true.T @ said).magnitude()) < 5.0
