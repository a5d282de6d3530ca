# SPDX-License-Identifier: Apache-2.0
"""An antenna that sits elsewhere than configured, by a distance that is not known: it is estimated, and the bounds include it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from graphloc import app
from graphloc.config import GnssConfig, VelocityConfig
from graphloc.eval.holdout import HoldOut
from graphloc.eval.metrics import Antennas, TruthMetrics, compare_to_held_out
from graphloc.eval.report import Trust, verdict
from graphloc.eval.report._theses import _gnss_error_m
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import gnss, velocity
from graphloc.frames import Array, wrap_angle
from graphloc.graph import PLACE, Attachment, antenna_off_m, corrections
from graphloc.measurements import GnssPosition, Measurement
from graphloc.online._lag import Lag
from graphloc.online._live import LiveStream, ReceiverDetectors
from graphloc.online._receiver_checks import ReceiverChecks, _antenna
from graphloc.replay import replay
from tests.faults import Fed, arrivals_of, feed
from tests.slowly import with_few_states
from tests.test_factors import attachment
from tests.test_late_fixes import SCENARIO, offline, online, solved
from tests.test_online_faults import smoother

GNSS = GnssConfig(kind="gnss", mount_sigma_m=1.0, stamp_sigma_s=0.1)
OFF_M = np.array([0.7, -0.4, 0.3])


@cache
def displaced(
    mount_sigma_m: float, off_m: tuple[float, float, float] = (0.9, -0.6, 1.2), scenario: Scenario = SCENARIO
) -> SimulatedRun:
    """A run with fixes good to 2 cm, whose antenna sits `off_m` from where the configuration has it."""
    run = simulate(scenario, 3)
    block = run.config.sensors["gnss"]
    assert isinstance(block, GnssConfig)
    xyz_m = tuple((np.array(block.mount.xyz_m) - off_m).tolist())
    settings = {
        "mount": block.mount.model_copy(update={"xyz_m": xyz_m}),
        "mount_sigma_m": mount_sigma_m,
        "slow_error": block.slow_error.model_copy(update={"enabled": False}),
    }
    config = run.config.with_sensors({"gnss": block.model_copy(update=settings)})
    return replace(run, config=with_few_states(config, 2.5))


def displacing(at: Attachment, value: Array) -> Attachment:
    return replace(at, constants=((6, value),))


def test_an_antenna_is_where_a_mount_there_has_it() -> None:
    """Its fix and its velocity are those of an antenna that is configured there."""
    for row, config in ((gnss.ROW, GNSS), (velocity.ROW, VelocityConfig(kind="gnss_velocity", mount_sigma_m=1.0))):
        at = attachment(row, config, slow=False)
        value = np.array([0.07, *OFF_M]) if row is gnss.ROW else OFF_M
        lever_m = at.lever_m + at.T_state_sensor.rotation().matrix() @ OFF_M
        mount = type(at.T_state_sensor)(at.T_state_sensor.rotation(), at.T_state_sensor.transformFrom(OFF_M))
        there = replace(at, T_state_sensor=mount, lever_m=lever_m)
        late = np.array([0.07, 0.0, 0.0, 0.0]) if row is gnss.ROW else np.zeros(3)
        m = row.ideal(displacing(at, value), config)
        np.testing.assert_allclose(row.residuals(m, config, displacing(there, late))[0].raw, 0.0, atol=1e-6)


def test_online_a_receiver_is_judged_at_the_antenna_as_estimated() -> None:
    """At the configured place a vessel that turned about a boom's antenna looked like one whose receiver is frozen."""
    at = displacing(attachment(gnss.ROW, GNSS, slow=False), np.array([0.07, *OFF_M]))
    (constant,) = gnss.ROW.constants(GNSS)
    place_m, v_mps = _antenna(cast("LiveStream", SimpleNamespace(constants=(constant,))), at)
    said = gnss.ROW.hint(gnss.ROW.ideal(at, GNSS), 0.0, at.datum)
    np.testing.assert_allclose(place_m, said.p_world_m[:2], atol=1e-6)
    there = replace(at, lever_m=at.lever_m + at.T_state_sensor.rotation().matrix() @ OFF_M)
    np.testing.assert_allclose(v_mps, there.sensor_velocity_mps(), atol=1e-9)
    assert np.linalg.norm(v_mps - at.sensor_velocity_mps()) > 0.05


def test_online_that_antenna_is_what_a_receiver_is_asked_of() -> None:
    """Both by whether it repeats a fix and by whether it stands."""
    at = displacing(attachment(gnss.ROW, GNSS, slow=False), np.array([0.07, *OFF_M]))
    noted: list[tuple[Any, ...]] = []
    repeats = SimpleNamespace(note=lambda *told: noted.append(told), is_old=lambda *_: False)
    stands = SimpleNamespace(frozen=True, note=lambda *told: noted.append(told), for_long=lambda _: False)
    stream: Any = SimpleNamespace(
        row=gnss.ROW,
        constants=gnss.ROW.constants(GNSS),
        receiver=SimpleNamespace(repeated_fix=repeats),
        frozen_detector=stands,
    )
    newest = SimpleNamespace(velocity=np.full(3, 100.0), velocity_cov=np.eye(3))
    problem: Any = SimpleNamespace(datum=at.datum, timeline=SimpleNamespace(seconds=lambda _: 0.0))
    unused: Any = None
    checks = ReceiverChecks(problem, cast("Any", SimpleNamespace(newest=newest)), unused, unused)
    m = gnss.ROW.ideal(at, GNSS)
    assert "frozen" in checks.reject(stream, m, at, gnss.ROW.residuals(m, GNSS, at)[0])
    (_, _, body_mps, _), (_, _, there_m, *_) = noted
    place_m, v_mps = _antenna(stream, at)
    np.testing.assert_allclose(there_m, place_m)
    np.testing.assert_allclose(body_mps, (at.T_world_body.rotation().matrix().T @ v_mps)[:2])


def yaw_errors_deg(run: SimulatedRun, fed: Fed) -> Array:
    """Errors of each estimate's heading."""
    R = run.truth.at(np.array(fed.true_ns)).R_world_body
    yaw = np.array([np.arctan2(e.R_world_body[1, 0], e.R_world_body[0, 0]) for e in fed.estimates])
    return np.degrees(wrap_angle(yaw - np.arctan2(R[:, 1, 0], R[:, 0, 0])))


@pytest.mark.parametrize("mode", [offline, online])
def test_a_displaced_antenna_is_found_out(mode: Callable[[SimulatedRun], TruthMetrics]) -> None:
    believed, estimated = offline(displaced(0.0)), mode(displaced(1.0))
    assert believed.coverage_95 is not None
    assert estimated.nees is not None
    assert believed.coverage_95 < 0.1
    assert estimated.nees < 2.0  # one error for seconds until it turns: few independent samples
    assert estimated.position_p50_m < 0.2 * believed.position_p50_m


def test_an_antenna_that_sits_as_configured_stays_there() -> None:
    """What a place that is not known costs where it is right: the bounds."""
    believed, estimated = offline(displaced(0.0, (0.0, 0.0, 0.0))), offline(displaced(1.0, (0.0, 0.0, 0.0)))
    assert estimated.position_rmse_m < believed.position_rmse_m + 0.15  # x looks like a turn of the mounts
    assert estimated.coverage_95 is not None
    assert estimated.coverage_95 > 0.9


def test_it_is_told_in_axes_of_the_body() -> None:
    """Found along the antenna's own axes, which tf may have turned."""
    found = solved(displaced(1.0)).solution.antennas_off_m["gnss"]
    np.testing.assert_allclose(found, [0.9, -0.6, 1.2], atol=0.2)
    mount = attachment(gnss.ROW, GNSS).T_state_sensor
    (constant,) = gnss.ROW.constants(GNSS)
    told = corrections([(constant, np.array([0.07, *OFF_M]))], mount)
    assert told["time_offset_s"] == 0.07
    off_m = antenna_off_m(told)
    assert off_m is not None
    np.testing.assert_allclose(off_m, mount.transformFrom(OFF_M) - mount.translation())
    assert antenna_off_m({}) is None
    assert set(PLACE) < set(told)


@cache
def with_gaps() -> app.Run:
    run = displaced(1.0)
    return app.smooth_recording(run.recording, run.config, hold_out=HoldOut(gaps=4, gap_s=3.0))


@pytest.mark.parametrize("filtered", [False, True])
def test_held_out_fixes_are_predicted_at_the_antenna_as_each_estimate_has_it(filtered: bool) -> None:
    """A filter that believes the configured place predicts them there."""
    found = with_gaps()
    antennas, name = app.antennas(found), "an EKF" if filtered else found.solution.name
    off = compare_to_held_out(found.solution.trajectory, found.held, found.solution.datum, antennas.of(name))
    assert (off.horizontal_rmse_m < 0.1) is not filtered
    (row,) = (t for t in app.tables(found) if t.title == "Against held-out fixes")
    said = row.as_dict()[found.solution.name]["horizontal_rmse_m"]
    assert said == pytest.approx(off.horizontal_rmse_m) or filtered


def test_online_knows_in_the_end_where_it_has_the_antenna() -> None:
    run = displaced(1.0)
    off_m = replay(run.recording, run.config).solution.antennas_off_m["gnss"]
    np.testing.assert_allclose(off_m, [0.9, -0.6, 1.2], atol=0.3)


def test_calibration_names_it_all_the_same_and_that_the_track_has_it() -> None:
    found = solved(displaced(1.0)).calibration
    assert found is not None
    lines = {s.key: s for s in found.suggestions}
    line, configured = lines["sensors.gnss.mount.xyz_m[0]"], displaced(1.0).config.sensors["gnss"].mount.xyz_m[0]
    assert line.suggested - configured == pytest.approx(0.9, abs=0.3)
    assert line.action.startswith("already corrected in the track, by mount_sigma_m")


def test_a_place_far_beyond_its_sigma_is_said() -> None:
    warnings = app.simulated(displaced(0.2)).solution.stats.warnings
    assert any(w.startswith("gnss: mount.xyz_m[") and "sigmas from its configured value: add +" in w for w in warnings)


def test_what_is_to_be_added_is_in_axes_of_the_body() -> None:
    """With an antenna whose own axes are turned, its x was said to be off where its y is."""
    run = displaced(0.2)
    block = run.config.sensors["gnss"]
    turned = block.model_copy(update={"mount": block.mount.model_copy(update={"rpy_deg": (0.0, 0.0, 90.0)})})
    warnings = app.simulated(replace(run, config=run.config.with_sensors({"gnss": turned}))).solution.stats.warnings
    by_m = {
        w.split("[")[1][0]: float(w.split("add ")[1].split()[0]) for w in warnings if w.startswith("gnss: mount.xyz_m[")
    }
    assert by_m["0"] == pytest.approx(0.9, abs=0.3)
    assert by_m["2"] == pytest.approx(1.2, abs=0.3)


def test_the_error_of_a_receiver_is_told_at_its_antenna() -> None:
    """Against truth, at the configured place, its fixes were as far off as the antenna."""
    run = displaced(1.0)
    ((_, rmse_m, _),) = _gnss_error_m(app.report_data(solved(run)), run.truth)
    assert rmse_m < 0.3


def test_antennas_are_as_configured_for_estimates_that_find_nothing() -> None:
    antennas = Antennas(configured={"gnss": np.ones(3)}, off_m={"graphloc": {"gnss": OFF_M}})
    assert antennas.of("graphloc")["gnss"] == pytest.approx(1.0 + OFF_M)
    assert antennas.of("an EKF")["gnss"] == pytest.approx(np.ones(3))


@pytest.mark.parametrize(("mount_sigma_m", "said"), [(0.0, True), (1.0, False)])
def test_the_report_doubts_an_origin_that_is_taken_for_the_antenna(mount_sigma_m: float, said: bool) -> None:
    run = displaced(mount_sigma_m)
    block = run.config.sensors["gnss"]
    at_origin = block.model_copy(update={"mount": block.mount.model_copy(update={"xyz_m": (0.0, 0.0, 0.0)})})
    without = replace(run.recording, truth=None)
    data = app.report_data(replace(solved(run), recording=without, config=run.config.with_sensors({"gnss": at_origin})))
    texts = [reason.text for track in verdict(data).tracks for reason in track.reasons]
    assert any("antenna of gnss" in text for text in texts) is said


@pytest.mark.parametrize("still", [True, False])
def test_the_report_says_that_bounds_hang_on_the_guess_of_an_antenna(*, still: bool) -> None:
    """A ship whose antenna sits 10 m from the IMU was 10.8 m off throughout, at a bound of 5.7 m, and nothing was said offline."""
    scenario = (
        replace(SCENARIO, path="still", duration_s=30.0, wave_roll_deg=0.2, wave_pitch_deg=0.2) if still else SCENARIO
    )
    run = displaced(0.5, scenario=scenario)
    data = app.report_data(replace(solved(run), recording=replace(run.recording, truth=None)))
    (track,) = verdict(data).tracks
    said = [r for r in track.reasons if "hardly shows where the antenna of gnss sits" in r.text]
    assert [r.trust for r in said] == [Trust.WITH_CARE] * still
    assert all("within 0.98 m of mount.xyz_m" in r.text for r in said)
    sure = data.config.sensors["gnss"].model_copy(update={"mount_sigma_m": 0.02})  # beside bounds of decimetres
    (track,) = verdict(replace(data, config=data.config.with_sensors({"gnss": sure}))).tracks
    assert not any("hardly shows" in r.text for r in track.reasons)


def test_a_vessel_that_lies_still_is_no_surer_of_its_place_after_restarts(tmp_path: Path) -> None:
    """Where nothing new is told, position and antenna are known together only; apart, each restart would tell them again."""
    lying = replace(SCENARIO, path="still", duration_s=24.0, wave_roll_deg=0.2, wave_pitch_deg=0.2, wave_heave_m=0.02)
    run = displaced(1.0, scenario=lying)
    came, path = arrivals_of(run), tmp_path / "snapshot.json"
    whole = feed(smoother(run), run, came).estimates[-1]
    for part in np.array_split(np.arange(len(came)), 4):
        fed = feed(smoother(run, snapshot=path), run, came[part[0] : part[-1] + 1])
    assert any(event.startswith("resumed from a snapshot") for event in fed.events)
    assert fed.estimates[-1].bound_95_m > 0.8 * whole.bound_95_m


def test_a_vessel_that_lies_still_is_no_surer_of_its_place_after_outages() -> None:
    """The antenna's place left the window in each, and was told again after it: fewer fixes made the bound smaller."""
    lying = replace(SCENARIO, path="still", duration_s=27.0, wave_roll_deg=0.2, wave_pitch_deg=0.2, wave_heave_m=0.02)
    run = displaced(1.0, scenario=lying)
    begin_ns = int(run.truth.stamps_ns[0])

    def lost(m: Measurement) -> bool:
        return isinstance(m, GnssPosition) and any(t < (m.stamp_ns - begin_ns) * 1e-9 < t + 5.0 for t in (8, 14, 20))

    heard = replace(run.recording, measurements=tuple(m for m in run.recording.measurements if not lost(m)))
    cut = replace(run, recording=heard)
    whole, with_outages = (
        feed(smoother(of, lag_s=2.0), of, arrivals_of(of)).estimates[-1].bound_95_m for of in (run, cut)
    )
    assert with_outages > whole


def test_a_mount_that_was_set_as_told_is_not_corrected_twice(tmp_path: Path) -> None:
    """What a snapshot knows of the antenna's place is of the mount before: resumed with it, the track was 1 m off, 'good', bound 0.3 m."""
    run, path = displaced(1.0), tmp_path / "snapshot.json"
    measured = replace(run, config=displaced(1.0, (0.0, 0.0, 0.0)).config)
    came = arrivals_of(run)
    half = len(came) // 2
    feed(smoother(run, snapshot=path), run, came[:half])
    resumed = feed(smoother(measured, snapshot=path), measured, came[half:])
    assert any(e.startswith("resumed from a snapshot") for e in resumed.events)
    assert resumed.errors_m[-1] < 0.3


def test_a_compass_that_was_set_as_told_is_not_corrected_twice(tmp_path: Path) -> None:
    """Its offset is a slow state, known from the mount before: resumed with it, the heading was 18 deg off, and 4 deg after 20 s."""
    right = displaced(0.0, (0.0, 0.0, 0.0))
    compass = right.config.sensors["compass"]
    turned = {"mount": compass.mount.model_copy(update={"rpy_deg": (0.0, 0.0, 20.0)}), "mount_offset_sigma_deg": 20.0}
    wrong = replace(right, config=right.config.with_sensors({"compass": compass.model_copy(update=turned)}))
    came, path = arrivals_of(right), tmp_path / "snapshot.json"
    half = len(came) // 2
    feed(smoother(wrong, snapshot=path), wrong, came[:half])
    resumed = feed(smoother(right, snapshot=path), right, came[half:])
    assert any(e.startswith("resumed from a snapshot") for e in resumed.events)
    assert np.abs(yaw_errors_deg(right, resumed)).max() < 5.0


def test_the_report_says_what_online_bounds_include_of_an_estimated_place() -> None:
    run = displaced(1.0)
    found = solved(run)
    online = replace(found.solution, stats=replace(found.solution.stats, online=True))
    data = app.report_data(replace(found, recording=replace(run.recording, truth=None), online=online))
    offline_said, online_said = (
        [
            reason.trust
            for reason in track.reasons
            if "the bounds of the online track include to first order" in reason.text
        ]
        for track in verdict(data).tracks
    )
    assert (offline_said, online_said) == ([], [Trust.WITH_CARE])


def test_a_snapshot_of_other_constants_is_not_used(tmp_path: Path) -> None:
    """Resumed with the delay of the stamps unknown, too: three numbers are no estimate of four."""
    run, path = displaced(1.0), tmp_path / "snapshot.json"
    came = arrivals_of(run)
    half = len(came) // 2
    feed(smoother(run, snapshot=path), run, came[:half])
    gnss_late = run.config.sensors["gnss"].model_copy(update={"stamp_sigma_s": 0.1})
    for config, used in ((run.config, True), (run.config.with_sensors({"gnss": gnss_late}), False)):
        copy = tmp_path / f"{used}.json"
        copy.write_bytes(path.read_bytes())
        other = replace(run, config=config)
        said = feed(smoother(other, snapshot=copy), other, came[half:][: len(came) // 40]).events
        assert any(e.startswith("resumed from a snapshot") for e in said) is used
        assert any("of another size" in e and e.endswith("starts without it") for e in said) is not used


def test_online_an_antenna_is_named_again_once_it_proves_twice_as_far_off() -> None:
    """What turns tell of it grows with them."""
    stream = SimpleNamespace(receiver=ReceiverDetectors())
    by = {PLACE[0]: 0.0}
    lag = SimpleNamespace(
        problem=SimpleNamespace(streams={"gnss": stream}),
        fresh=True,
        _constants=SimpleNamespace(far_off=lambda _: [(key, value, f"add {value}") for key, value in by.items()]),
        _states=SimpleNamespace(late_far_off=lambda _: []),
    )
    said: list[str] = []
    for value in (-3.0, -3.5, -5.9, -6.1, -12.0, -14.2, -3.0):
        by[PLACE[0]] = value
        said += Lag.setting_warnings(cast("Lag", lag))
    assert said == ["add -3.0", "add -6.1", "add -14.2"]
