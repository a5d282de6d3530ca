# SPDX-License-Identifier: Apache-2.0
"""The verdict answers for the online track as for the offline one; and when an estimate was less than good."""

from dataclasses import replace

import numpy as np
import pytest

from graphloc import app
from graphloc.config import AerialConfig, AprilTagConfig, BodyVelocityConfig
from graphloc.eval.calibrate import Calibration, Check, Suggestion
from graphloc.eval.ekf import FilterResult
from graphloc.eval.late_check import _late_velocity
from graphloc.eval.metrics import Antennas, Table
from graphloc.eval.report import ReportData, Trust, durations_s, stretches, verdict
from graphloc.eval.report._health import cure, section
from graphloc.eval.report._sections import _key_numbers
from graphloc.eval.report._track_verdict import main_table
from graphloc.eval.simulate import Scenario, simulate
from graphloc.judge.health import health_of
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import GnssPosition
from graphloc.signals.frozen_receiver import FROZEN_FIX
from graphloc.solution import Cause, Health, HealthReason, Solution
from graphloc.trajectory import Trajectory


@pytest.fixture(scope="module")
def data() -> ReportData:
    """A run whose offline and online tracks are the truth, with 1 m of sigma, and no filter beside them."""
    found = app.report_data(
        app.simulated(simulate(Scenario(duration_s=20.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3), compare=True)
    )
    truth, online = found.recording.truth, found.online
    assert truth is not None
    assert online is not None

    def perfect(solution: Solution) -> Solution:
        stamps = solution.trajectory.stamps_ns[truth.covers(solution.trajectory.stamps_ns)]
        track = replace(truth.at(stamps), cov=np.tile(np.eye(6), (len(stamps), 1, 1)))
        n = len(stamps)
        good = replace(solution, trajectory=track, health=(Health.GOOD,) * n, health_reason=(HealthReason(),) * n)
        return replace(good, stats=replace(solution.stats, warnings=(), converged=True))

    recording = replace(found.recording, warnings=())
    return replace(
        found, recording=recording, solution=perfect(found.solution), online=perfect(online), filters=(),
        tables=table(0.95, 2.0),
    )  # fmt: skip


def table(covered: float, nees: float) -> tuple[Table, ...]:
    """Numbers against truth, those of the online mode as given."""
    columns = ("position_rmse_m", "position_max_m", "coverage_95", "nees")
    return (
        Table("Against truth", columns, (("graphloc", (0.1, 0.2, 0.95, 2.0)), ("graphloc online", (0.24, 0.9, covered, nees)))),
    )  # fmt: skip


def moved(track: Trajectory, share: float, by_m: float) -> Trajectory:
    """Shift the first share of a track to the east; its covariance says 1 m."""
    p = track.p_world_m.copy()
    p[: round(share * len(p)), 0] += by_m
    return replace(track, p_world_m=p, v_world_mps=None)


@pytest.mark.parametrize(
    ("share", "enabled", "topic", "said"),
    [
        (0.5, False, "/dvl", True),
        (0.02, False, "/dvl", False),
        (0.5, True, "/dvl", False),
        (0.5, False, "/other", False),  # the bag has none
    ],
)
def test_a_recorded_speed_that_is_switched_off_is_named_where_fixes_fail(
    data: ReportData, share: float, *, enabled: bool, topic: str, said: bool
) -> None:
    """A robot under water was lost for 66 % of a run online, its Doppler log drafted as switched off, and nothing said so."""
    n = len(data.solution.health)
    dark = round(share * n)
    health = (Health.DEAD_RECKONING,) * dark + (Health.GOOD,) * (n - dark)
    row = LedgerRow(seq=-1, stamp_ns=0, sensor="", topic="/dvl", outcome=Outcome.IGNORED, count=1750)
    solution = replace(data.solution, health=health, ledger=Ledger([*data.solution.ledger, row]))
    log = BodyVelocityConfig(kind="body_velocity", topic=topic, enabled=enabled)
    config = data.config.model_copy(update={"sensors": {**data.config.sensors, "log": log}})
    offline, _ = verdict(replace(data, solution=solution, config=config)).tracks
    assert any("set sensors.log.enabled" in r.text for r in offline.reasons) is said


@pytest.mark.parametrize(
    ("sensor", "late_s", "said"),
    [("gnss", 0.9, True), ("gnss", 0.3, False), ("compass", 0.9, False)],  # a compass tells no place
)
def test_stamps_that_the_bounds_know_nothing_of_are_reported(
    data: ReportData, sensor: str, late_s: float, *, said: bool
) -> None:
    found = Suggestion(
        sensor=sensor, key=f"sensors.{sensor}.time_offset_s", unit="s", configured=0.1, suggested=0.1 - late_s, sigma=0.01, z=-30.0,
        evidence="", action="",
    )  # fmt: skip
    track = data.solution.trajectory
    going = replace(track, v_world_mps=np.tile([0.0, 4.0, 0.0], (len(track), 1)))  # bounds: 2.45 m of 1 m sigma
    solution = replace(data.solution, trajectory=going)
    (offline, _) = verdict(replace(data, solution=solution, calibration=Calibration(suggestions=(found,)))).tracks
    assert offline.trust is (Trust.WITH_CARE if said else Trust.YES)
    assert any(f"up to {4.0 * late_s:.2f} m behind or ahead" in r.text for r in offline.reasons) == said


def test_a_track_of_one_state_is_turned_by_no_velocity(data: ReportData) -> None:
    """It has no acceleration, and was a traceback instead of a report."""
    track = data.solution.trajectory
    one = replace(track.at(track.stamps_ns[:1]), cov=np.eye(6)[None])
    assert not list(_late_velocity("velocity", 0.1, replace(data.solution, trajectory=one)))


def antenna_at(data: ReportData, x_m: float, *, change_m: float = 0.0, sigma_m: float = 0.0) -> tuple[Trust, list[str]]:
    """What is said of a run without truth (bounds: 2.45 m) whose antenna is configured at x; a change that is suggested, or its sigma."""
    mount = data.config.sensors["gnss"].mount.model_copy(update={"xyz_m": (x_m, 0.0, 2.0)})
    sensors = {**data.config.sensors, "gnss": data.config.sensors["gnss"].model_copy(update={"mount": mount})}
    keys = [f"sensors.gnss.mount.xyz_m[{axis}]" for axis in (0, 1)]
    found = [
        Suggestion(
            sensor="gnss", key=key, unit="m", configured=x_m, suggested=x_m + change_m, sigma=0.1, z=30.0, evidence="", action=""
        )
        for key in keys
        if change_m
    ]  # fmt: skip
    checks = [Check(key=key, unit="m", configured=x_m, change=0.0, sigma=sigma_m, said="") for key in keys if sigma_m]
    calibration = Calibration(suggestions=tuple(found), checks=tuple(checks))
    (track, _) = verdict(
        replace(
            data, config=data.config.model_copy(update={"sensors": sensors}), recording=replace(data.recording, truth=None),
            calibration=calibration,
        )
    ).tracks  # fmt: skip
    return track.trust, [r.text for r in track.reasons if "antenna" in r.text]


def test_an_antenna_that_is_elsewhere_or_was_left_at_the_guess_is_said(data: ReportData) -> None:
    assert antenna_at(data, 1.5) == (Trust.YES, [])  # measured
    trust, (text,) = antenna_at(data, 1.5, change_m=3.0)
    assert trust is Trust.WITH_CARE
    assert "looks 4.24 m away from where mount.xyz_m has it" in text
    assert antenna_at(data, 1.5, change_m=0.3)[0] is Trust.YES  # within the bounds
    trust, (text,) = antenna_at(data, 0.0, sigma_m=0.4)  # 1.96 x 0.4 x sqrt(2)
    assert trust is Trust.YES
    assert "taken to be at the vessel's origin" in text
    assert "this run knows it to 1.1 m (95 %)" in text
    assert antenna_at(data, 0.0, sigma_m=1.0)[0] is Trust.WITH_CARE
    trust, (text,) = antenna_at(data, 0.0)
    assert trust is Trust.WITH_CARE
    assert "nothing here checks that" in text


@pytest.mark.parametrize(
    ("mount", "said"), [({}, True), ({"xyz_m": (0.0, 0.0, 2.4)}, False), ({"tf_frame": "bow"}, False)], ids=["left", "given", "tf"]
)  # fmt: skip
@pytest.mark.parametrize("key", ["cameras", "lidars"])
def test_a_camera_or_lidar_that_was_left_at_the_guess_is_said(
    data: ReportData, key: str, mount: dict[str, object], *, said: bool
) -> None:
    """The track was off by where the camera sits, 2.5 m, with bounds of 0.1 m, and nothing was said."""
    block = {"bow": {"topic": "/bow", "mount": mount}}
    sensor = (AprilTagConfig if key == "cameras" else AerialConfig).model_validate({key: block})
    config = data.config.model_copy(update={"sensors": {**data.config.sensors, "quay": sensor}})
    used = LedgerRow(seq=10**9, stamp_ns=0, sensor="quay", topic="", outcome=Outcome.USED)
    solution = replace(data.solution, ledger=Ledger([*data.solution.ledger, used]))
    recording = replace(data.recording, truth=None)
    (track, _) = verdict(replace(data, config=config, recording=recording, solution=solution)).tracks
    assert any(f"at the vessel's origin: {key}.bow of quay" in r.text for r in track.reasons) == said
    (track, _) = verdict(replace(data, config=config, recording=recording)).tracks
    assert not any("cameras" in r.text or "lidars" in r.text for r in track.reasons)  # nothing of it is used


def test_what_makes_all_poses_doubtful_is_said_first(data: ReportData) -> None:
    """Of an IMU turned by 90 deg, and of a receiver alone, the verdict was the same."""
    doubted = data.solution.doubted("the vessel is tilted by 179 deg for most of the run")
    (offline, _) = verdict(replace(data, solution=doubted)).tracks
    assert offline.reasons[0].text == "No bound includes this: the vessel is tilted by 179 deg for most of the run."
    assert offline.reasons[0].trust is Trust.WITH_CARE


def test_a_table_without_any_value_is_no_main_table(data: ReportData) -> None:
    """The report could not be written."""
    empty = Table("Against held-out fixes", ("horizontal_rmse_m",), (("graphloc", (None,)), ("BL EKF", (None,))))
    assert _key_numbers(replace(data, tables=(empty,))) == ""
    (told,) = table(0.95, 2.0)
    assert main_table(replace(data, tables=(empty, told))) == (told, "position_rmse_m")


@pytest.mark.parametrize(
    ("covered", "nees", "expected"),
    [(0.95, 2.0, Trust.YES), (0.75, 2.0, Trust.WITH_CARE), (0.9, 5.5, Trust.WITH_CARE), (0.3, 20.0, Trust.NO)],
)
def test_the_online_track_is_judged_by_its_own_numbers(
    data: ReportData, covered: float, nees: float, expected: Trust
) -> None:
    said = verdict(replace(data, tables=table(covered, nees)))
    offline, online = said.tracks
    assert (offline.name, online.name) == ("graphloc", "graphloc online")
    assert offline.trust is Trust.YES
    assert online.trust is said.trust is expected
    assert online.accuracy == "Horizontal RMSE 0.24 m, worst 0.90 m."  # not beside the offline one, which knows more
    assert any(
        f"held the truth for {100 * covered:.0f} %" in r.text and f"NEES {nees:.1f}" in r.text for r in online.reasons
    )


@pytest.mark.parametrize(("covered", "expected"), [(0.9, Trust.YES), (0.6, Trust.WITH_CARE)])
def test_headings_are_judged_with_their_size(data: ReportData, covered: float, expected: Trust) -> None:
    """Sigma 1 rad: a bound of 1.96 rad, 112.3 deg; beside it the error that it should have held."""
    columns = ("position_rmse_m", "heading_rmse_deg", "heading_max_deg", "heading_coverage_95")
    rows = tuple((name, (0.1, 1.25, 2.5, covered)) for name in ("graphloc", "graphloc online"))
    (offline, _) = verdict(replace(data, tables=(Table("Against truth", columns, rows),))).tracks
    (found,) = (r for r in offline.reasons if "heading bounds" in r.text)
    assert found.trust is expected
    assert found.text.startswith(
        f"Its heading bounds (112.30 deg, median) held the truth for {100 * covered:.0f} % of the time; "
        "off by 1.25 deg (RMS), 2.50 at most"
    )


@pytest.mark.parametrize(("share", "expected"), [(0.02, Trust.YES), (0.2, Trust.WITH_CARE), (0.7, Trust.NO)])
def test_without_truth_online_is_held_against_offline(data: ReportData, share: float, expected: Trust) -> None:
    """3 m off with 1 m of sigma is outside the 95 % region, whose radius is 2.45 m; elsewhere it is on the offline track."""
    assert data.online is not None
    online = replace(data.online, trajectory=moved(data.online.trajectory, share, 3.0))
    said = verdict(
        replace(data, recording=replace(data.recording, truth=None), online=online, tables=(held_table(),))
    ).tracks[1]
    assert said.trust is expected
    assert said.accuracy == "Horizontal RMSE 0.20 m at held-out fixes."
    (text,) = (r.text for r in said.reasons if "from the offline track" in r.text)
    assert float(text.split()[2]) == pytest.approx(3.0 * np.sqrt(share), rel=0.1)  # RMS of 3 m over that share
    assert "3.00 m at most" in text
    assert ("too small" in text) == (expected is not Trust.YES)


def held_table() -> Table:
    rows = (("graphloc", (0.1,)), ("graphloc online", (0.2,)))
    return Table("Against held-out fixes", ("horizontal_rmse_m",), rows)


def test_a_filter_that_is_nearer_is_reported(data: ReportData) -> None:
    """A filter that is 0.1 m off beside tracks that are 0 and 0.2 m off: nearer than one of them."""
    assert data.online is not None
    track = data.solution.trajectory
    filtered = FilterResult(name="some EKF", trajectory=moved(track, 1.0, 0.1), ledger=Ledger())
    online = replace(data.online, trajectory=moved(data.online.trajectory, 1.0, 0.2))
    offline, judged = verdict(replace(data, filters=(filtered,), online=online)).tracks
    assert not any("more accurate" in r.text for r in offline.reasons)
    (found,) = (r for r in judged.reasons if "more accurate" in r.text)
    assert found.trust is Trust.WITH_CARE
    assert found.text.startswith("some EKF is more accurate: RMSE 0.10 m, worst 0.10 m, against 0.20 m, worst 0.20 m")


def test_when_it_was_less_than_good(data: ReportData) -> None:
    """States at 10 Hz: dead reckoning from 2 s, numbers in its reason changing, good again from 5 s, degraded to the end."""
    stamps = np.arange(0, 10_000_000_000, 100_000_000, dtype=np.int64)
    n = len(stamps)
    track = Trajectory(stamps_ns=stamps, p_world_m=np.zeros((n, 3)), R_world_body=np.tile(np.eye(3), (n, 1, 1)))
    health = [Health.GOOD] * n
    why = [HealthReason()] * n
    for k in range(20, 50):
        health[k], why[k] = Health.DEAD_RECKONING, HealthReason(f"no position for {k / 10:.1f} s", Cause.NO_POSITION)
    for k in range(80, n):
        health[k], why[k] = (
            Health.DEGRADED,
            HealthReason("compass missing or not agreeing", Cause.SENSORS, ("compass",)),
        )
    solution = replace(data.solution, trajectory=track, health=tuple(health), health_reason=tuple(why))
    first, second = stretches(solution, 0)
    assert first.health is Health.DEAD_RECKONING
    assert (first.begin_s, first.end_s) == pytest.approx((2.0, 5.0))
    assert first.reason.text == "no position for 2.0 s"
    assert second.health is Health.DEGRADED
    assert (second.begin_s, second.end_s) == pytest.approx((8.0, 9.9))
    lasting = durations_s(solution)
    assert lasting[Health.DEAD_RECKONING] == pytest.approx(3.0)
    assert lasting[Health.GOOD] == pytest.approx(5.0)
    page = section([solution], 0)
    assert "<td>1</td><td>3.0 s</td><td>2 to 5</td>" in page
    assert "good for 50 % (5.0 s), degraded for 20 % (1.9 s), dead reckoning for 30 % (3.0 s)" in page
    for k in range(60, 70):
        health[k], why[k] = Health.DEAD_RECKONING, HealthReason("no position for 9 s", Cause.NO_POSITION)
    page = section([replace(solution, health=tuple(health), health_reason=tuple(why))], 0)
    assert "<td>2</td><td>4.0 s</td><td>2 to 5</td>" in page  # the same reason but for its number: one row
    assert section([data.solution], 0) == ""  # all good
    hole = np.concatenate([stamps[:50], stamps[50:] + 60_000_000_000])
    with_hole = replace(solution, trajectory=replace(track, stamps_ns=hole))
    assert durations_s(with_hole)[Health.DEAD_RECKONING] == pytest.approx(2.9)  # a minute without an estimate is none


def test_what_would_end_it_is_reported_of_the_cause() -> None:
    known, lost, turned = np.eye(6) * 1e-4, np.eye(6) * 200.0, np.diag([1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1.0])
    away = {"compass": 20.0, "gnss": 12.0, "match": 1.0}
    assert cure(*health_of(known, away, 2.5)).startswith("compass, gnss agreeing again")
    assert cure(*health_of(lost, {"gnss": 1.0}, 2.5)) == "a fix, match or tag that agrees"
    health, why = health_of(turned, {"gnss": 1.0}, 2.5)
    assert (health, why.text) == (Health.LOST, "heading unknown: 95 % bound 112 deg; that of the position 0.2 m")
    assert cure(health, why).startswith("a compass, ")
    assert "fix" in cure(*health_of(known, {"gnss": 6.0}, 2.5))
    assert "second position sensor" in cure(*health_of(np.diag([4.0, 4.0, 1.0, 1e-4, 1e-4, 1e-4]), {"gnss": 1.0}, 2.5))
    assert "warnings" in cure(*health_of(known, {"gnss": 1.0}, 2.5, "the measurements contradict each other"))
    assert "start.heading_deg" in cure(Health.LOST, HealthReason("in whatever words", Cause.GUESSED_HEADING))


@pytest.mark.parametrize(
    ("good_bound_m", "health"), [(2.5, Health.DEGRADED), (4.8, Health.DEGRADED), (4.95, Health.GOOD)]
)
def test_how_wide_a_bound_is_good_is_configured(good_bound_m: float, health: Health) -> None:
    """2 m (1 sigma) each way are 4.9 m with 95 %."""
    cov = np.diag([4.0, 4.0, 1.0, 1e-4, 1e-4, 1e-4])
    assert health_of(cov, {"gnss": 1.0}, good_bound_m)[0] is health


@pytest.mark.parametrize(
    ("off_m", "share", "trust"), [(30.0, 1.0, Trust.NO), (30.0, 0.4, Trust.YES), (12.0, 1.0, Trust.YES)]
)
def test_a_track_that_most_fixes_contradict_is_not_relied_on(
    data: ReportData, off_m: float, share: float, trust: Trust
) -> None:
    """30 m for 40 % of the run is a jump; 12 m all the time may be a harbour's."""
    solution = replace(data.solution, trajectory=moved(data.solution.trajectory, share, off_m))
    (offline, _) = verdict(replace(data, solution=solution)).tracks
    assert offline.trust is trust
    said = [r.text for r in offline.reasons if r.text.startswith("Half of the fixes of gnss are ")]
    assert len(said) == (trust is Trust.NO)
    assert all(float(line.split()[7]) == pytest.approx(off_m, abs=2.0) for line in said)


def test_what_a_frozen_receiver_repeats_contradicts_nothing(data: ReportData) -> None:
    fixes = [m for m in data.recording.measurements if m.sensor == "gnss"]
    solution = replace(data.solution, trajectory=moved(data.solution.trajectory, 0.6, 30.0))
    repeated = {m.seq for m in fixes[: len(fixes) * 2 // 3]}
    rows = [
        replace(r, reason=FROZEN_FIX, outcome=Outcome.REJECTED) if r.seq in repeated else r for r in solution.ledger
    ]
    for ledger, trust in ((solution.ledger, Trust.NO), (Ledger(rows), Trust.YES)):
        found = verdict(replace(data, solution=replace(solution, ledger=ledger))).tracks[0]
        assert found.trust is trust


@pytest.mark.parametrize(
    ("others", "trust"), [(("gnss", "matcher"), Trust.WITH_CARE), (("gnss",), Trust.NO), (("matcher",), Trust.NO)]
)
def test_a_receiver_that_two_sensors_contradict_is_wrong_and_the_track_is_not(
    others: tuple[str, ...], trust: Trust, data: ReportData
) -> None:
    """One of them a receiver: a survey or an image that is off would contradict that as well."""
    fixes = [m for m in data.recording.measurements if isinstance(m, GnssPosition)]
    off = [
        replace(m, sensor="gnss_2", position=m.position._replace(latitude_deg=m.position.latitude_deg + 4e-4))
        for m in fixes
    ]
    known = {name: sensor for name, sensor in data.config.sensors.items() if name in ("imu", *others)}
    config = data.config.model_copy(update={"sensors": {**known, "gnss_2": data.config.sensors["gnss"]}})
    antennas = Antennas(configured=dict.fromkeys(("gnss", "gnss_2"), data.antennas.configured["gnss"]))
    recording = replace(data.recording, measurements=(*data.recording.measurements, *off))
    found = verdict(replace(data, config=config, antennas=antennas, recording=recording)).tracks[0]
    assert found.trust is trust
    assert [r.trust for r in found.reasons if "fixes of gnss_2" in r.text] == [trust]
