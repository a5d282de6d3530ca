"""Drills: what each failure changes and what it leaves, and what is measured of it, by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphloc.drills import _or_why_not, _started_there, as_it_comes, drill
from graphloc.eval.drill import Case, DrillWindow, Failure, Times, cut, figures, judge, page, schedule, script
from graphloc.eval.drill.measure import Drilled, Measured, State, compared, summed
from graphloc.eval.drill.plan import judged_until, windows
from graphloc.eval.plots import Line, Points, colour_of
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.frames import Array, rotation_from_rpy_deg
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, ImuSample, Measurement, PoseFix, TagMode, TagSighting
from graphloc.recording import Recording
from graphloc.replay import arrivals
from graphloc.trajectory import Trajectory
from tests.commands import called
from tests.slowly import simulate_slowly

S = 1_000_000_000
BEGIN_S = 30.0


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate(Scenario(duration_s=120.0, imu_hz=20.0, gnss_hz=2.0, compass_hz=2.0), 5)


@pytest.fixture(scope="module")
def recording(run: SimulatedRun) -> Recording:
    made = run.recording
    at_ns = [m.stamp_ns for m in made.of(PoseFix)]
    tags = [sighting(stamp, 1_000_000 + k) for k, stamp in enumerate(at_ns)]
    every = tuple(sorted([*made.measurements, *tags], key=lambda m: (m.stamp_ns, m.seq)))
    return replace(made, measurements=every, message_count=1_000_000 + len(tags))


def sighting(stamp_ns: int, seq: int) -> TagSighting:
    modes = tuple(
        TagMode(p_world_camera_m=np.full(3, place), R_world_camera=np.eye(3), cov=np.eye(6), probability=p)
        for place, p in ((1.0, 0.8), (2.0, 0.2))
    )
    return TagSighting(
        stamp_ns=stamp_ns, sensor="tags", seq=seq, camera="c", frame="world", numbers=(1,), families=("tag36h11",),
        points_m=np.zeros((4, 3)), pivot_m=np.zeros(3), rays=np.zeros((4, 2)), cov=np.eye(8), t_body_camera_m=np.zeros(3),
        R_body_camera=np.eye(3), modes=modes,
    )  # fmt: skip


def begin_ns(recording: Recording) -> int:
    assert recording.imu is not None
    return int(recording.imu.stamps_ns[0]) + round(BEGIN_S * S)


def named(recording: Recording, name: str) -> Failure:
    return next(f for f in script(recording)[0] if f.name == name)


def struck(recording: Recording, name: str, seed: int = 0) -> Recording:
    return named(recording, name).on(recording, begin_ns(recording), seed).recording


def pairs(recording: Recording, after: Recording) -> list[tuple[Measurement, Measurement]]:
    """What a failure changed, before and after."""
    assert len(recording.measurements) == len(after.measurements)
    both = zip(recording.measurements, after.measurements, strict=True)
    return [(a, b) for a, b in both if a is not b]


def moved_m(a: Measurement, b: Measurement) -> Array:
    """Metres east and north between two fixes, with the radii of the ellipsoid at their latitude."""
    assert isinstance(a, GnssPosition)
    assert isinstance(b, GnssPosition)
    lat, semi_major, e2 = np.radians(a.position.latitude_deg), 6378137.0, 0.00669438
    root = 1.0 - e2 * np.sin(lat) ** 2
    north = semi_major * (1.0 - e2) / root**1.5 * np.radians(b.position.latitude_deg - a.position.latitude_deg)
    east = semi_major / np.sqrt(root) * np.cos(lat) * np.radians(b.position.longitude_deg - a.position.longitude_deg)
    return np.array([east, north])


def test_an_outage_takes_these_sensors_then_and_nothing_else(recording: Recording) -> None:
    begin = begin_ns(recording)
    for name, kinds, length_s in (
        ("GNSS outage, 30 s", GnssPosition, 30),
        ("no place at all, 10 s", GnssPosition | PoseFix | TagSighting, 10),
        ("compass silent, 60 s", CompassHeading, 60),
    ):
        after = struck(recording, name)
        gone = [m for m in recording.measurements if isinstance(m, kinds) and 0 <= m.stamp_ns - begin < length_s * S]
        assert len(gone) >= 20
        assert after.measurements == tuple(m for m in recording.measurements if m not in gone)
        rows = after.rows[len(recording.rows) :]
        assert sorted(r.seq for r in rows) == sorted(m.seq for m in gone)  # nothing is silently lost
        assert {r.outcome for r in rows} == {Outcome.HELD_OUT}
        assert after.imu is recording.imu


def test_a_hole_in_the_imu_is_as_long_as_asked(recording: Recording) -> None:
    after = struck(recording, "IMU gap, 5 s")
    assert recording.imu is not None
    assert after.imu is not None
    steps = np.diff(after.imu.stamps_ns) / S
    assert np.sort(steps)[-2:] == pytest.approx([0.05, 5.05])  # 20 Hz
    assert (
        after.imu.stamps_ns[np.argmax(steps)] < begin_ns(recording) <= after.imu.stamps_ns[np.argmax(steps)] + S // 20
    )
    assert len(after.imu) + len(after.rows) == len(recording.imu) + len(recording.rows)


def test_a_jump_moves_fixes_by_ten_metres_and_not_their_height(recording: Recording) -> None:
    changed = pairs(recording, struck(recording, "GNSS jump of 10 m, 10 s"))
    assert len(changed) == 20
    offsets = np.array([moved_m(a, b) for a, b in changed])
    assert np.hypot(*offsets.T) == pytest.approx(np.full(20, 10.0), rel=1e-3)
    assert np.ptp(offsets, axis=0) == pytest.approx([0.0, 0.0], abs=1e-3)
    heights = [b.position.height_m - a.position.height_m for a, b in changed]  # type: ignore[attr-defined]
    assert np.abs(heights).max() < 1e-3


def test_a_frozen_receiver_repeats_what_it_said_last_under_new_stamps(recording: Recording) -> None:
    hangs = struck(recording, "GNSS frozen, 30 s")
    before, after = (r.of(GnssPosition) for r in (recording, hangs))
    assert [(m.stamp_ns, m.seq) for m in after] == [(m.stamp_ns, m.seq) for m in before]
    begin = begin_ns(recording)
    during = np.array([begin <= m.stamp_ns < begin + 30 * S for m in before])
    last = before[int(np.argmax(during)) - 1]
    assert {m.position for m, now in zip(after, during, strict=True) if now} == {last.position}
    assert all(a.position == b.position for a, b, now in zip(after, before, during, strict=True) if not now)


def test_a_drift_grows_and_fades(recording: Recording) -> None:
    changed = pairs(recording, struck(recording, "GNSS drift of 3 m, 60 s"))
    size = np.hypot(*np.array([moved_m(a, b) for a, b in changed]).T)
    assert len(size) == 120
    assert size[0] < 0.5
    assert size[-1] < 0.5
    assert 2.3 < np.sqrt((size**2).mean()) < 3.0  # 3 m, less what fades
    assert np.abs(np.diff(size)).max() < 0.7  # no jump


def test_a_compass_is_off_by_fifteen_degrees(recording: Recording) -> None:
    changed = pairs(recording, struck(recording, "compass off by 15 deg, 30 s"))
    off = [np.degrees(b.yaw_rad - a.yaw_rad + np.pi) % 360.0 - 180.0 for a, b in changed]  # type: ignore[attr-defined]
    assert len(off) == 60
    assert np.abs(off) == pytest.approx(np.full(60, 15.0))
    assert np.ptp(off) < 1e-9


def test_false_matches_lie_elsewhere_or_all_alike(recording: Recording) -> None:
    alike = pairs(recording, struck(recording, "all matches false alike, 20 s"))
    offsets = np.array([b.modes[0].value - a.modes[0].value for a, b in alike])  # type: ignore[attr-defined]
    assert len(alike) == 20
    assert np.ptp(offsets, axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert np.hypot(offsets[0, 0], offsets[0, 1]) == pytest.approx(4.0)
    several = [pairs(recording, struck(recording, "70 % of matches false, 30 s", seed)) for seed in range(10)]
    assert np.mean([len(s) for s in several]) == pytest.approx(21.0, abs=2.5)  # 70 % of 30
    size = [np.hypot(*(b.modes[0].value - a.modes[0].value)[:2]) for s in several for a, b in s]  # type: ignore[attr-defined]
    assert min(size) >= 1.5
    assert max(size) <= 5.0
    assert np.ptp(size) > 2.0


def test_flipped_tags_prefer_the_other_pose(recording: Recording) -> None:
    changed = pairs(recording, struck(recording, "tags flipped, 20 s"))
    assert len(changed) == 20
    for _, after in changed:
        assert isinstance(after, TagSighting)
        best = max(after.modes, key=lambda mode: mode.probability)
        assert (best.p_world_camera_m[0], best.probability) == (2.0, 0.8)


def test_a_seed_is_a_failure(recording: Recording) -> None:
    def jumped(seed: int) -> list[Array]:
        return [moved_m(a, b) for a, b in pairs(recording, struck(recording, "GNSS jump of 10 m, 10 s", seed))]

    assert np.array_equal(jumped(1), jumped(1))
    assert not np.allclose(jumped(1), jumped(2), atol=0.5)


def test_late_matches_come_late_and_say_when_they_are_of(recording: Recording) -> None:
    begin, failure = begin_ns(recording), named(recording, "matches late by 2 s, 30 s")
    late = failure.on(recording, begin, 0)
    assert late.recording is recording
    own = {
        m.seq
        for m in recording.measurements
        if isinstance(m, PoseFix | TagSighting) and 0 <= m.stamp_ns - begin < 30 * S
    }
    assert set(late.late_ns) == own
    newest_ns, seen = 0, []
    for m in arrivals(recording, late.late_ns):
        seen.append(m.seq)
        newest_ns = m.stamp_ns if isinstance(m, ImuSample) else newest_ns
        if m.seq in own:
            assert 2 * S <= newest_ns - m.stamp_ns < 2.1 * S
    assert sorted(seen) == sorted(m.seq for m in arrivals(recording))
    filtered = as_it_comes(recording, late.late_ns)  # a filter that knows no delay takes it for one of now
    stamps = {m.seq: m.stamp_ns for m in recording.measurements}
    assert {m.stamp_ns - stamps[m.seq] for m in filtered.measurements if m.seq in own} == {2 * S}
    assert [m.stamp_ns for m in filtered.measurements] == sorted(m.stamp_ns for m in filtered.measurements)


def test_only_what_the_sensors_permit_is_drilled(recording: Recording) -> None:
    fixes = tuple(recording.of(GnssPosition))
    found, left = script(replace(recording, measurements=fixes))
    assert {f.family for f in found} == {
        "GNSS outage",
        "GNSS drift of 3 m",
        "GNSS jump of 10 m",
        "GNSS frozen",
        "IMU gap",
    }
    said = dict(left)
    assert "no compass" in said["compass silent"]
    assert "no tags" in said["tags flipped"]
    assert "a single sensor measures position" in said["no place at all"]
    assert not script(recording)[1]


def straight(length_s: float, off_m: Callable[[Array], Array], sigma_m: float = 0.2) -> Trajectory:
    t = np.arange(0.0, length_s + 0.05, 0.1)
    cov = np.tile(np.diag([sigma_m**2] * 3 + [1e-4] * 3), (len(t), 1, 1))
    p = np.column_stack([2.0 * t, off_m(t), 0.0 * t])
    return Trajectory(stamps_ns=np.rint(t * S).astype(np.int64), p_world_m=p, R_world_body=np.tile(np.eye(3), (len(t), 1, 1)), cov=cov)  # fmt: skip


def judged(off_m: Callable[[Array], Array], sigma_m: float = 0.2, normal: Trajectory | None = None) -> Measured:
    """A failure from 30 s to 40 s of 100 s."""
    window, truth = DrillWindow(begin_ns=0, end_ns=100 * S, whole=True), straight(100.0, lambda t: 0.0 * t)
    failure = Failure(name="f", family="f", length_s=10.0, strike=lambda *_: pytest.fail("not struck"))
    case = Case(failure=failure, window=0, begin_ns=30 * S, seed=0)

    def times(track: Trajectory) -> Times:
        return compared(track, truth, window, sure=True)

    usual = times(normal or straight(100.0, lambda t: 0.0 * t + 0.1))
    return judge(case, "e", times(straight(100.0, off_m, sigma_m)), usual, 0)


def test_distance_coverage_and_time_until_back_by_hand() -> None:
    """5 m off from 30 s on, until 52 s; 0.1 m else. Judged from 30 s to 65 s: off for 22 of 35 s; back 12 s after 40 s."""
    found = judged(lambda t: np.where((t >= 29.95) & (t < 51.95), 5.0, 0.1))
    assert found.state is State.BACK
    assert found.off_m == pytest.approx(5.0, abs=1e-6)
    assert found.normal_m == pytest.approx(0.1)
    assert found.back_s == pytest.approx(12.0, abs=0.25)
    assert found.coverage == pytest.approx(1.0 - 22.0 / 35.0, abs=0.01)
    assert found.normal_coverage == 1.0
    assert found.begin_s == 30.0


def test_locked_out_and_unsure_are_told_apart() -> None:
    stays = judged(lambda t: np.where(t >= 29.95, 3.0, 0.1))
    assert (stays.state, stays.back_s) == (State.LOST, None)
    unsure = judged(lambda t: np.where((t >= 29.95) & (t < 39.95), 5.0, 0.5), sigma_m=0.05)  # 0.5 m are 10 sigmas
    assert (unsure.state, unsure.back_s) == (State.UNSURE, None)
    flicker = judged(lambda t: np.where((t >= 29.95) & (t % 4.0 < 1.0), 5.0, 0.1))  # never near for 5 s on end
    assert flicker.state is State.LOST


def test_an_estimator_that_gives_nothing_is_reported() -> None:
    window, truth = DrillWindow(begin_ns=0, end_ns=100 * S, whole=True), straight(100.0, lambda t: 0.0 * t)
    failure = Failure(name="f", family="f", length_s=10.0, strike=lambda *_: pytest.fail("not struck"))
    nothing = compared(None, truth, window, sure=True)
    found = judge(Case(failure=failure, window=0, begin_ns=30 * S, seed=0), "e", nothing, nothing, 0, "never started")
    assert (found.state, found.off_m, found.coverage, found.missing, found.why) == (
        State.NONE, None, None, 1.0, "never started",
    )  # fmt: skip
    (row,) = summed([found])
    assert (row.none, row.lost) == (1, 0)
    drilled = Drilled(
        source="x", vessel="v", truth=True, bound_m=1.0, measured=(found,), shown=(), left=(), windows=(window,)
    )  # fmt: skip
    assert "| f | e | never started |" in page.grids(drilled)[1].as_markdown()
    assert page.grids(replace(drilled, measured=(replace(found, why=""),)))[1:] == []


def test_a_filter_that_a_failure_broke_ends_no_drill() -> None:
    def broken() -> Trajectory:
        np.linalg.inv(np.zeros((2, 2)))
        raise AssertionError

    assert _or_why_not(broken) == (None, "Singular matrix")


def test_headings_are_apart_by_the_shorter_way() -> None:
    """175 deg beside -175 deg."""
    window, track = DrillWindow(begin_ns=0, end_ns=10 * S, whole=True), straight(10.0, lambda t: 0.0 * t)

    def turned(deg: float) -> Trajectory:
        R = rotation_from_rpy_deg(np.array([0.0, 0.0, deg]))
        return replace(track, R_world_body=np.tile(R, (len(track), 1, 1)))

    found = compared(turned(175.0), turned(-175.0), window, sure=True)
    np.testing.assert_allclose(found.off_deg, 10.0, atol=1e-6)


def test_near_is_what_it_has_undisturbed_from_the_failure_on() -> None:
    """4 m off while it settles, before the failure, makes 3 m off after it no more usual."""
    settling = straight(100.0, lambda t: np.where(t < 29.95, 4.0, 0.1))
    assert judged(lambda t: np.where(t >= 29.95, 3.0, 0.1), normal=settling).state is State.LOST
    poor = straight(100.0, lambda t: 0.0 * t + 2.5)
    assert judged(lambda t: 0.0 * t + 3.0, sigma_m=2.0, normal=poor).state is State.BACK  # 3 < 1.5 * 2.5


def test_only_a_window_without_a_compass_is_told_its_heading(run: SimulatedRun, recording: Recording) -> None:
    imu = recording.imu
    assert imu is not None
    begin = int(imu.stamps_ns[len(imu) // 2])
    whole = DrillWindow(begin_ns=begin, end_ns=begin + 10 * S, whole=True)
    blind = recording.where(lambda m: not isinstance(m, CompassHeading))
    given = run.config.start.heading_deg
    part = replace(whole, whole=False)
    assert _started_there(run.config, blind, whole, run.truth).start.heading_deg == given
    assert _started_there(run.config, recording, part, run.truth).start.heading_deg == given
    told = _started_there(run.config, blind, part, run.truth).start.heading_deg
    yaw = run.truth.at(np.array([begin])).yaw_rad[0]
    assert told is not None
    assert np.cos(np.radians(90.0 - told) - yaw) == pytest.approx(1.0)  # clockwise from north
    assert np.sin(np.radians(90.0 - told) - yaw) == pytest.approx(0.0, abs=1e-9)


def test_the_reference_is_only_as_good_as_its_own_bound() -> None:
    """0.6 m off with 0.2 m and 0.2 m: 0.6^2 / (0.2^2 + 0.2^2) = 4.5 < 5.99 < 0.6^2 / 0.2^2."""
    window, reference = DrillWindow(begin_ns=0, end_ns=20 * S, whole=True), straight(20.0, lambda t: 0.0 * t)
    track = straight(20.0, lambda t: 0.0 * t + 0.6)
    assert compared(track, reference, window, sure=False).held.all()
    assert not compared(track, reference, window, sure=True).held.any()


def test_the_worst_of_the_times_counts() -> None:
    one, other = judged(lambda t: np.where((t >= 29.95) & (t < 44.95), 2.0, 0.1)), judged(lambda t: 0.0 * t + 3.0)
    (row,) = summed([one, other])
    assert (row.times, row.lost) == (2, 1)
    assert row.off_m == pytest.approx(3.0)
    assert row.back_s == pytest.approx(5.0, abs=0.25)


def test_failures_strike_where_they_fit(recording: Recording) -> None:
    assert recording.imu is not None
    first, last = int(recording.imu.stamps_ns[0]), int(recording.imu.stamps_ns[-1])
    failures = script(recording)[0]
    parts = windows(recording, 120.0, 3)
    assert parts == (DrillWindow(begin_ns=first, end_ns=last, whole=True),)
    cases, left = schedule(failures, parts, [first + 20 * S], 3, 0)
    ((name, why),) = left
    assert name == "GNSS outage, 120 s"
    assert why.endswith(f"{np.ceil(30 + 120 + 25 - (last - first) / S):.0f} s too short")
    for case in cases:
        assert case.begin_ns >= first + 30 * S  # 10 s after the online mode's first pose
        assert case.end_ns <= last - 25 * S
    jumps = [c.begin_ns for c in cases if c.failure.family.startswith("GNSS jump")]
    assert len(set(jumps)) == 3
    assert min(np.diff(jumps)) > 15 * S


def test_a_long_recording_is_cut(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graphloc.eval.drill.plan.WHOLE_S", 60.0)
    monkeypatch.setattr("graphloc.eval.drill.plan.WINDOW_LEAD_S", 10.0)
    monkeypatch.setattr("graphloc.eval.drill.plan.WINDOW_TAIL_S", 10.0)
    parts = windows(recording, 20.0, 2)
    assert [p.end_ns - p.begin_ns for p in parts] == [40 * S, 40 * S]
    case = Case(
        failure=named(recording, "GNSS jump of 10 m, 10 s"), window=0, begin_ns=parts[0].begin_ns + 10 * S, seed=0
    )
    assert judged_until(case, parts[0]).end_ns == parts[0].begin_ns + 30 * S  # 10 s of failure, 10 s behind it
    piece = cut(recording, parts[1])
    assert piece.imu is not None
    for stamps in (piece.imu.stamps_ns, [m.stamp_ns for m in piece.measurements]):
        assert parts[1].begin_ns <= min(stamps)
        assert max(stamps) <= parts[1].end_ns
        assert max(stamps) - min(stamps) > 38 * S


@pytest.fixture(scope="module")
def drilled() -> tuple[SimulatedRun, Drilled]:
    scenario = Scenario(duration_s=27.0, imu_hz=50.0, gnss_hz=1.0, compass_hz=1.0, noise="clean", false_fraction=0.0)
    run = simulate_slowly(scenario, 2)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("LEAD_S", "TAIL_S"):
            patch.setattr(f"graphloc.eval.drill.plan.{name}", 8.0)
        return run, drill(run.recording, run.config, times=1, only=["gap, 1", "late by 2"])


def test_a_drill_from_recording_to_page(drilled: tuple[SimulatedRun, Drilled], tmp_path: Path) -> None:
    _, found = drilled
    assert {m.failure for m in found.measured} == {"IMU gap, 1 s"}
    assert {name for name, _ in found.left} == {"matches late by 2 s, 30 s"}  # nothing that was not asked for
    by = {m.estimator: m for m in found.measured}
    assert list(by) == ["graphloc", "graphloc online", "honest EKF", "BL EKF"]
    assert by["graphloc"].off_m is not None
    assert by["graphloc"].off_m < 0.5
    assert by["graphloc online"].state is State.BACK
    page.write(found, tmp_path, "drill")
    html = (tmp_path / "drill.html").read_text()
    assert "IMU gap, 1 s" in html
    assert "Reference: truth" in html
    assert "http://" not in html.split("</script>")[-1]
    told = json.loads((tmp_path / "drill.json").read_text())
    assert {r["estimator"] for r in told["rows"]} == set(by)
    assert len((tmp_path / "drill.csv").read_text().splitlines()) == 1 + len(by)
    assert "| IMU gap, 1 s |" in (tmp_path / "drill.md").read_text()
    # As of a truth in GPS time: against that no estimator comes back, and only drill.json said why.
    page.write(replace(found, warnings=("/truth: on another clock",)), tmp_path, "drill")
    for name in ("drill.html", "drill.md"):
        assert "Warning: /truth: on another clock" in (tmp_path / name).read_text()


def test_an_estimator_has_the_colour_that_it_has_in_the_report(drilled: tuple[SimulatedRun, Drilled]) -> None:
    _, found = drilled
    for figure in (figures.all_failures(found), figures.over_time(found)):
        marks = [m for panel in figure.panels for m in panel.marks]
        colours = {m.name: m.colour for m in marks if isinstance(m, Line | Points)}
        assert all(colours[name] == colour_of(name) for name in found.estimators)


def test_the_command_prints_its_table_and_replaces_nothing_unasked(
    drilled: tuple[SimulatedRun, Drilled],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run, found = drilled
    asked: dict[str, object] = {}

    def drill_instead(*_: object, **options: object) -> Drilled:
        asked.update(options)
        return found

    monkeypatch.setattr("graphloc.app.load", lambda *_: (run.recording, run.config))
    out = tmp_path / "out"
    arguments = ["drill", "my.bag", "-c", "vessel.yaml", "-o", str(out), "--only", "gap", "--times", "3"]
    with monkeypatch.context() as patch:
        patch.setattr("graphloc.drills.drill", drill_instead)
        assert called(patch, *arguments) == 0
    assert (asked["only"], asked["times"]) == (["gap"], 3)
    printed = capsys.readouterr().out
    assert "IMU gap, 1 s" in printed
    assert printed.rstrip().endswith("drill.html")
    for changed, said in (
        (arguments, "--overwrite"),
        ([*arguments[:5], str(out / "x"), "--only", "meteor"], "no such drill"),
    ):
        assert called(monkeypatch, *changed) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert said in line
    assert not (out / "x").exists()
