"""What a run says of its own configuration: that it finds what is wrong, knows how well, and makes nothing up."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array

from graphloc import app
from graphloc.config import BodyVelocityConfig, ImuConfig, VelocityConfig, VesselConfig
from graphloc.eval.calibrate import PROBE, Calibration, Check, Suggestion, _check, _suggestion
from graphloc.eval.calibrate._evidence import Evidence, OffsetEstimate
from graphloc.eval.calibrate._imu import imu_noise
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frontends.time_offsets import heading_time_offset
from graphloc.frontends.turning import Turning
from graphloc.judge.imu_noise import imu_misfit
from graphloc.judge.linearised import normal_solver
from graphloc.measurements import GnssVelocity, ImuSeries
from graphloc.offsets import Misfit, Offset, Offsets, joined
from graphloc.signals.imu_scatter import noise_density
from graphloc.solution import Health
from graphloc.solve import smooth
from graphloc.trajectory import bounds_95
from tests.bagfactory import Messages
from tests.heldbags import read_recording
from tests.slowly import simulate_slowly
from tests.test_inspect import drive, look
from tests.test_odd_vessels import antenna_velocity

LEVER_M, LATE_S, TURNED_DEG = (0.6, -0.5), 0.15, 5.0
FINE = Misfit(squares=10.0, freedom=10.0)


def sums(x: Any, y: Any, names: tuple[tuple[str, Offset], ...], blocks: int) -> Offsets:
    """Offsets of a plain regression y = x theta + noise of variance 1, in blocks of 2 s."""
    parts = list(zip(np.array_split(x, blocks), np.array_split(y, blocks), strict=True))
    return Offsets(
        names=names, block_s=2.0, gradient=np.array([a.T @ b for a, b in parts]),
        curvature=np.array([a.T @ a for a, _ in parts]), gyroscope=FINE, accelerometer=FINE, noise_scale=1.0,
    )  # fmt: skip


def test_regression_comes_out_with_its_sigma() -> None:
    """theta = x'y / x'x with variance 1 / x'x: 400 samples of x = 1 give 0.05."""
    rng = np.random.default_rng(1)
    x = np.ones((400, 1))
    y = 0.5 + rng.normal(size=400)
    found = Evidence(sums(x, y, (("gnss", "x"),), 200)).estimates((("gnss", "x"),))["gnss", "x"]
    assert found.value == pytest.approx(y.mean())
    assert found.sigma == pytest.approx(0.05, rel=0.2)
    assert found.drop == pytest.approx(400.0 * y.mean() ** 2)


def test_errors_that_last_widen_the_sigma() -> None:
    """Noise that stays for 10 s (10 samples): 40 values tell as much as 400, so sigma is 1 / sqrt(40)."""
    rng = np.random.default_rng(2)
    y = np.repeat(rng.normal(size=40), 10)
    found = Evidence(sums(np.ones((400, 1)), y, (("gnss", "x"),), 200)).estimates((("gnss", "x"),))["gnss", "x"]
    assert found.sigma == pytest.approx(1.0 / np.sqrt(40.0), rel=0.25)


def test_nothing_is_made_of_noise() -> None:
    rng = np.random.default_rng(3)
    names: tuple[tuple[str, Offset], ...] = (("gnss", "x"), ("gnss", "y"), ("compass", "time"))
    for _ in range(50):
        assert not Evidence(sums(rng.normal(size=(400, 3)), rng.normal(size=400), names, 200)).wrong()


def test_of_two_that_do_the_same_one_is_believed_and_the_other_named() -> None:
    rng = np.random.default_rng(4)
    speed = rng.normal(2.0, 0.01, 400)
    x = np.column_stack([np.ones(400), speed, rng.normal(size=400)])
    names: tuple[tuple[str, Offset], ...] = (("gnss", "x"), ("gnss", "time"), ("gnss", "y"))
    evidence = Evidence(sums(x, 0.8 + rng.normal(size=400), names, 200))
    wrong = evidence.wrong()
    assert len(wrong) == 1
    others = evidence.alternatives(wrong[0], wrong)
    assert {wrong[0], *others} == {("gnss", "x"), ("gnss", "time")}


def test_what_a_block_alone_tells_is_not_believed() -> None:
    """Jackknife: all there is stands in one block of ten seconds."""
    x = np.zeros((400, 1))
    x[:10] = 10.0
    assert not Evidence(sums(x, 5.0 * x[:, 0], (("gnss", "time"),), 200)).wrong()


def test_what_is_too_small_to_matter_is_no_suggestion() -> None:
    rng = np.random.default_rng(5)
    x = np.full((400, 1), 1e3)
    assert not Evidence(sums(x, 0.03 * x[:, 0] + rng.normal(size=400), (("gnss", "x"),), 200)).wrong()
    assert Evidence(sums(x, 0.3 * x[:, 0] + rng.normal(size=400), (("gnss", "x"),), 200)).wrong()


def test_parts_of_a_run_add_up() -> None:
    rng = np.random.default_rng(6)
    x, y = rng.normal(size=(200, 2)), rng.normal(size=200)
    names: tuple[tuple[str, Offset], ...] = (("gnss", "x"), ("gnss", "y"))
    whole = sums(x, y, names, 20)
    second = sums(x[100:, ::-1], y[100:], names[::-1], 10)  # another order
    both = joined([sums(x[:100], y[:100], names, 10), second])
    assert both.names == names
    np.testing.assert_allclose(both.gradient, whole.gradient)
    np.testing.assert_allclose(both.curvature, whole.curvature)
    assert both.gyroscope.squares == 20.0


def changed(config: VesselConfig, sensor: str, **fields: Any) -> VesselConfig:
    block = config.sensors[sensor].model_copy(update=fields)
    return config.model_copy(update={"sensors": {**config.sensors, sensor: block}})


def calibration_of(recording: Any, config: VesselConfig) -> Calibration:
    found = app.smooth_recording(recording, config).calibration
    assert found is not None
    return found


@pytest.fixture(scope="module")
def simulated() -> SimulatedRun:
    run = simulate_slowly(
        Scenario(
            path="loops",
            duration_s=80.0,
            noise="clean",
            false_fraction=0.0,
            gnss_sigma_m=0.03,
            gnss_hz=5.0,
            compass_hz=5.0,
        ),
        5,
    )
    true = {"accel_noise_ug_per_sqrt_hz": 300.0, "gyro_noise_mdps_per_sqrt_hz": 8.0}  # the scenario's
    config = changed(run.config, "imu", **true)
    white = config.sensors["gnss"].slow_error.model_copy(update={"enabled": False})
    return replace(run, config=changed(config, "gnss", slow_error=white))


@pytest.fixture(scope="module")
def right(simulated: SimulatedRun) -> app.Run:
    return app.simulated(simulated)


def test_a_run_with_nothing_wrong_gets_no_suggestion(right: app.Run) -> None:
    assert right.calibration is not None
    assert right.calibration.suggestions == ()
    keys = {c.key for c in right.calibration.checks}
    assert {
        "sensors.gnss.mount.xyz_m[0]",
        "sensors.compass.time_offset_s",
        "sensors.imu.gyro_noise_mdps_per_sqrt_hz",
    } <= keys
    assert all(abs(c.change) < 4.0 * c.sigma for c in right.calibration.checks if "noise" not in c.key)


def test_all_that_is_wrong_is_found_at_once(simulated: SimulatedRun) -> None:
    """The antenna 0.6 m aft and 0.5 m to port of where it is said to be, and the compass turned by 5 deg in its mount."""
    config = simulated.config
    mount = config.sensors["gnss"].mount
    x, y, z = mount.xyz_m
    moved = mount.model_copy(update={"xyz_m": (x + LEVER_M[0], y + LEVER_M[1], z)})
    turned = config.sensors["compass"].mount.model_copy(update={"rpy_deg": (0.0, 0.0, TURNED_DEG)})
    # A compass that may wander is believed less than the map: then nothing else explains the run as well.
    config = changed(changed(config, "gnss", mount=moved), "compass", mount=turned, wander_sigma_deg=0.0)
    found = {s.key: s for s in calibration_of(simulated.recording, config).suggestions}
    assert set(found) == {
        "sensors.gnss.mount.xyz_m[0]",
        "sensors.gnss.mount.xyz_m[1]",
        "sensors.compass.mount.rpy_deg[2]",
    }
    for key, value in zip(sorted(found), (0.0, x, y), strict=True):
        assert abs(found[key].suggested - value) < 4.0 * found[key].sigma, key
        assert abs(found[key].z) > 4.0
    said = found["sensors.compass.mount.rpy_deg[2]"]
    assert said.suggested == pytest.approx(0.0, abs=1.0)
    assert "cannot tell it from sensors.matcher.mount.rpy_deg[2]" in said.action


def test_fixes_that_are_late_are_found(simulated: SimulatedRun) -> None:
    late = tuple(
        replace(m, stamp_ns=m.stamp_ns + round(LATE_S * 1e9)) if m.sensor == "gnss" else m
        for m in simulated.recording.measurements
    )
    recording = replace(simulated.recording, measurements=tuple(sorted(late, key=lambda m: m.stamp_ns)))
    run = app.smooth_recording(recording, simulated.config)
    assert run.calibration is not None
    (only,) = run.calibration.suggestions
    assert only.key == "sensors.gnss.time_offset_s"
    track, true = run.solution.trajectory, simulated.truth.at(run.solution.trajectory.stamps_ns)
    assert track.cov is not None
    behind_m = np.linalg.norm((track.p_world_m - true.p_world_m)[:, :2], axis=1)
    assert (behind_m > bounds_95(track.cov)[:, 0]).mean() > 0.5, "the bounds do not know it"
    assert Health.GOOD not in run.solution.health
    assert [why for why in run.solution.doubts if "gnss and the IMU are 0.1" in why]
    assert abs(only.suggested + LATE_S) < 4.0 * only.sigma
    assert only.sigma < 0.03


def test_an_antenna_that_tells_its_velocity_too_is_found(simulated: SimulatedRun) -> None:
    """Both are configured 0.6 and -0.5 m off, as of one antenna: each bears the other out, and the IMU alone contradicts."""
    rng, truth, gnss = np.random.default_rng(3), simulated.truth, simulated.config.sensors["gnss"]
    v = antenna_velocity(truth)
    every = range(10, len(truth) - 10, max(1, round(0.2e9 / (truth.stamps_ns[1] - truth.stamps_ns[0]))))
    told = [
        GnssVelocity(
            stamp_ns=int(truth.stamps_ns[k]), sensor="velocity", seq=10**6 + k, v_enu_mps=v[k] + rng.normal(0.0, 0.05, 3),
            cov_m2ps2=0.05**2 * np.eye(3),
        )
        for k in every
    ]  # fmt: skip
    off = gnss.mount.model_copy(update={"xyz_m": tuple(gnss.mount.xyz_m + np.array([*LEVER_M, 0.0]))})
    config = changed(simulated.config, "gnss", mount=off)
    config = config.model_copy(update={"sensors": {**config.sensors, "velocity": VelocityConfig(mount=off)}})
    measurements = sorted((*simulated.recording.measurements, *told), key=lambda m: m.stamp_ns)
    recording = replace(simulated.recording, measurements=tuple(measurements))
    found = {s.key: s for s in calibration_of(recording, config).suggestions}
    for axis, right_m in enumerate(gnss.mount.xyz_m[:2]):
        said = found[f"sensors.gnss.mount.xyz_m[{axis}]"]
        assert abs(said.suggested - right_m) < 4.0 * said.sigma, said.key
        assert said.sigma < 0.1
        assert "also of velocity, taken for the same antenna" in said.action


def test_wheels_that_are_late_are_found(tmp_path: Path) -> None:
    """A speed that goes up and down by 0.6 m/s^2, stamped 0.15 s late by the wheels alone."""
    make, items = Messages(2), []
    for topic, at, msg in drive(Messages(2)):
        if topic == "/wheel/odom":
            msg.header = make.header(at + round(LATE_S * 1e9))
        items.append((topic, at, msg))
    _, config, _ = look(tmp_path, items, make)
    wheels = BodyVelocityConfig(topic="/wheel/odom")
    config = config.model_copy(update={"sensors": {**config.sensors, "wheels": wheels}})
    found = {s.key: s for s in calibration_of(read_recording(tmp_path / "run", config), config).suggestions}
    late = found["sensors.wheels.time_offset_s"]
    assert abs(late.suggested + LATE_S) < 4.0 * late.sigma
    assert late.sigma < 0.03


@pytest.mark.parametrize(("times", "needed"), [(1.0, 1.0), (5.0, 0.2)])
def test_imu_noise_that_is_configured_too_large_is_seen(times: float, needed: float) -> None:
    """Links x + e with e of variance 1, said to be of variance times^2, beside measurements of x that are exact: what the
    links leave is all freedom, and says that e is 1 / times of what is configured."""
    rng, n = np.random.default_rng(8), 40
    e = rng.normal(size=9 * n)
    J = csr_array(np.vstack([np.eye(9 * n) / times, np.eye(9 * n) * 100.0]))
    b = np.concatenate([e / times, np.zeros(9 * n)])
    solve = normal_solver(J)
    found = imu_misfit(J, np.ones(len(b)), b, (J, b - J @ solve(J.T @ b), solve), n)
    for misfit, share in zip(found, (3, 6), strict=True):
        assert misfit.freedom == pytest.approx(share * n, rel=0.01)
        assert misfit.needed == pytest.approx(needed, rel=0.2 if times > 1.0 else 1e-9)
        assert abs(misfit.needed - needed) < 4.0 * misfit.sigma


def test_nothing_is_looked_at_unasked(right: app.Run) -> None:
    short = simulate_slowly(Scenario(duration_s=12.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 1)
    datum = app.choose_datum(short.recording, short.config)
    recording = app.with_synthetic(short.recording, short.config, datum)
    plain = smooth(recording, short.config, datum, rows=SENSORS, inertial=INERTIAL)
    assert plain.offsets is None
    asked = smooth(recording, short.config, datum, rows=SENSORS, inertial=INERTIAL, probe=PROBE)
    assert asked.offsets is not None
    assert ("gnss", "x") in asked.offsets.names
    np.testing.assert_array_equal(asked.trajectory.p_world_m, plain.trajectory.p_world_m)


def test_a_solution_stands_where_nothing_can_be_said_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("Factor is exactly singular")

    monkeypatch.setattr("graphloc.solve.offsets_of", fail)
    run = app.simulated(simulate_slowly(Scenario(duration_s=12.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 1))
    assert any(
        "calibration could not be examined: Factor is exactly singular" in w for w in run.solution.stats.warnings
    )
    assert run.calibration is not None
    assert not any("mount" in c.key for c in run.calibration.checks)


def white(sigma: float, n: int = 20_000, step: float = 0.0) -> ImuSeries:
    """100 Hz of a motion and white noise: a density of sigma / sqrt(100) per sqrt(Hz); rounded to `step`."""
    rng, t = np.random.default_rng(7), np.arange(n) / 100.0
    motion = np.sin(0.5 * t)[:, None] * np.array([1.0, 2.0, 0.5])
    values = motion + rng.normal(0.0, sigma, (n, 3))
    values = np.round(values / step) * step if step else values
    return ImuSeries(
        sensor="imu", stamps_ns=(t * 1e9).astype(np.int64), accel_mps2=values, gyro_radps=values, seqs=np.arange(n)
    )


def test_density_of_samples() -> None:
    imu = white(0.05)
    value, sigma = noise_density(imu.stamps_ns, imu.accel_mps2)
    assert value == pytest.approx(0.005, rel=0.05)
    assert abs(value - 0.005) < 4.0 * sigma
    coarse = white(1e-6, step=0.1)  # what rounding scatters: step / sqrt(12)
    value, _ = noise_density(coarse.stamps_ns, coarse.accel_mps2)
    assert value >= 0.1 / np.sqrt(12.0) / 10.0 * 0.99


@pytest.mark.parametrize(
    ("times", "needed", "scale", "suggested"),
    [
        (0.2, 1.0, 1.0, True),
        (1.0, 1.0, 1.0, False),
        (5.0, 1.0, 1.0, False),
        (5.0, 0.2, 1.0, True),
        (5.0, 0.2, 2.0, False),
    ],
)
def test_noise_is_judged_by_samples_and_by_the_run(times: float, needed: float, scale: float, suggested: bool) -> None:
    """Too small: the samples say so. Too large: only where the run says so too, and was not solved with more yet."""
    imu, rate = white(0.05), float(np.degrees(0.005) * 1e3)  # mdeg/s/sqrt(Hz)
    config = ImuConfig(
        gyro_noise_mdps_per_sqrt_hz=rate * times, accel_noise_ug_per_sqrt_hz=0.005 / 9.80665 * 1e6 * times
    )
    misfit = Misfit(squares=2.0, freedom=40.0, needed=needed, sigma=0.02)
    offsets = Offsets(
        names=(), block_s=2.0, gradient=np.zeros((1, 0)), curvature=np.zeros((1, 0, 0)), gyroscope=misfit,
        accelerometer=misfit, noise_scale=scale,
    )  # fmt: skip
    found = list(imu_noise(imu, config, offsets))
    assert [isinstance(f, Suggestion) for f in found] == [suggested] * 2
    if suggested and isinstance(found[1], Suggestion):
        assert found[1].suggested == pytest.approx(rate, rel=0.1)


@pytest.mark.usefixtures("map_alone")
def test_it_is_written_and_shown(right: app.Run, tmp_path: Path) -> None:
    wrong = Suggestion(
        sensor="gnss", key="sensors.gnss.mount.xyz_m[0]", unit="m", configured=1.0, suggested=1.5, sigma=0.05, z=10.0,
        evidence="it <fits>", action="measure it",
    )  # fmt: skip
    check = Check(key="sensors.gnss.mount.xyz_m[1]", unit="m", configured=0.0, change=0.01, sigma=0.02, said="fits")
    run = replace(right, calibration=Calibration(suggestions=(wrong,), checks=(check,)))
    report = app.write(run, tmp_path / "run", inputs=[], command="test", overwrite=False)
    page = report.read_text(encoding="utf-8")
    assert "sensors.gnss.mount.xyz_m[0]: 1.5 +- 0.05 m instead of 1: it &lt;fits&gt;; measure it" in page
    assert "sensors.gnss.mount.xyz_m[1]" in page
    told = json.loads((tmp_path / "run/calibration.json").read_text(encoding="utf-8"))
    assert told["suggestions"][0]["suggested"] == 1.5
    assert told["checks"][0]["sigma"] == 0.02


def test_a_turned_heading_may_be_a_turned_imu(right: app.Run) -> None:
    """An IMU 12 deg askew was said to be a compass of -11 deg: set so, the heading stayed wrong, and nothing told any more."""
    found = OffsetEstimate(value=float(np.radians(-10.8)), sigma=0.017, drop=100.0)
    said = _suggestion(("compass", "yaw"), found, {}, right.recording, right.config)
    assert said.suggested == pytest.approx(-10.8)
    assert said.action == "measure it, then set it; or sensors.imu.mount.rpy_deg[2] is off, the other way"
    assert "imu" not in _suggestion(("gnss", "x"), found, {}, right.recording, right.config).action


def test_an_antenna_elsewhere_may_be_an_imu_elsewhere(right: app.Run) -> None:
    """Of an IMU 3 m ahead whose place was left at 0, an antenna that was right was said to be 3 m off: set so, the origin is the IMU."""
    found = OffsetEstimate(value=-3.0, sigma=0.08, drop=100.0)
    imu = right.config.sensors["imu"]
    for xyz_m, said in (((0.0, 0.0, 0.0), True), ((3.0, 0.0, 0.0), False)):
        moved = imu.model_copy(update={"mount": imu.mount.model_copy(update={"xyz_m": xyz_m})})
        config = right.config.model_copy(update={"sensors": {**right.config.sensors, "imu": moved}})
        action = _suggestion(("gnss", "x"), found, {}, right.recording, config).action
        assert ("measure sensors.imu.mount.xyz_m, too, unless the 0 there is measured" in action) is said


def test_an_offset_of_three_and_a_half_sigmas_does_not_fit(right: app.Run) -> None:
    """It read 'fits, within 0.019 s'."""
    said = [
        _check(
            ("gnss", "time"), OffsetEstimate(value=off_s, sigma=0.0097, drop=6.0), right.recording, right.config
        ).said
        for off_s in (0.034, -0.034, 0.01)
    ]
    assert said == [
        "off by 0.034 s, 3.5 sigmas: doubtful", "off by -0.034 s, 3.5 sigmas: doubtful", "fits, within 0.019 s (95 %)",
    ]  # fmt: skip


LATE_FIXES: tuple[str, Offset] = ("gnss", "time")


def test_an_offset_that_a_run_shows_though_not_well_is_not_said_to_be_unseen(right: app.Run) -> None:
    """Of scans 0.5 s late a run told -0.4 +- 0.12 s, and read 'this run does not show it'; what the track has taken of it is beside it."""
    off, name = OffsetEstimate(value=-0.4, sigma=0.12, drop=11.0), LATE_FIXES
    assert _check(name, off, right.recording, right.config).said == "off by -0.4 s, 3.3 sigmas: doubtful"
    told = _check(name, off, right.recording, right.config, -0.1).said
    assert told == "off by -0.4 s, 3.3 sigmas: doubtful; -0.40 s by itself, -0.10 s in the track (stamp_sigma_s)"
    unseen = _check(name, OffsetEstimate(value=-0.3, sigma=0.12, drop=6.0), right.recording, right.config).said
    assert unseen.startswith("this run does not show it (1 sigma 0.12 s)")


def test_of_a_delay_that_the_track_has_in_part_the_rest_is_asked_for(right: app.Run) -> None:
    gnss = right.config.sensors["gnss"].model_copy(update={"stamp_sigma_s": 0.05})
    config, off = right.config.with_sensors({"gnss": gnss}), OffsetEstimate(value=-0.4, sigma=0.05, drop=64.0)
    for taken_s, action in (
        (-0.38, "already corrected in the track, by stamp_sigma_s"),
        (None, "already corrected in the track, by stamp_sigma_s"),
        (
            -0.2,
            "the track has only -0.2 s of it corrected, as far as stamp_sigma_s lets it (a warning may name that); measure it, then set it",
        ),
    ):
        assert _suggestion(("gnss", "time"), off, {}, right.recording, config, taken_s).action == action


def test_a_clock_years_away_is_reported_to_milliseconds() -> None:
    """It read '-1.75e+09 s instead of -1.75e+09'."""
    clock = Suggestion(
        sensor="compass", key="time_offset_s", unit="s", configured=-1749999862.753, suggested=-1749999862.8016, sigma=0.00923,
        z=5.3, evidence="it fits", action="measure it",
    )  # fmt: skip
    assert str(clock).startswith("time_offset_s: -1749999862.802 +- 0.00923 s instead of -1749999862.753")


def headings(late_s: float, seed: int) -> tuple[Turning, Any, Any]:
    """A craft that swings about, its compass off, disturbed by its own heading, and read `late_s` after its stamps."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 120.0, 0.01)

    def heading(at: Any) -> Any:
        return 0.8 * np.sin(0.4 * at) + 0.3 * np.sin(1.3 * at)

    turned = heading(t) + 0.002 * t  # a gyro's bias
    at = np.arange(2.0, 118.0, 0.1)
    true = heading(at + late_s)
    read = 0.1 + true + 0.05 * np.sin(true) + rng.normal(0.0, 0.02, len(at))
    return Turning(0, t, turned), (at * 1e9).astype(np.int64), read


def test_headings_with_wrong_stamps_are_seen_in_the_bag() -> None:
    found = heading_time_offset(*headings(-0.15, 1))
    assert found is not None
    assert found[0] == pytest.approx(-0.15, abs=0.012)  # 5 % by what iron does to the compass
    assert found[1] < 0.02
    assert all(heading_time_offset(*headings(0.0, seed)) is None for seed in range(20))


def test_headings_that_wander_are_seldom_late() -> None:
    """In a minute, three or four blocks agreed by chance: one compass in ten that wanders was drafted as late, by 0.1 s and more."""
    late = 0
    for seed in range(120):
        rng, t = np.random.default_rng(seed), np.arange(0.0, 65.0, 0.02)
        turned = 0.02 * np.cumsum(np.interp(t, np.arange(0.0, 120.0, 5.0), 0.15 * rng.uniform(-1.0, 1.0, 24)))
        at, read = t[::5], turned[::5] + np.radians(0.1) * np.cumsum(rng.normal(size=len(t[::5])))
        late += heading_time_offset(Turning(0, t, turned), (at * 1e9).astype(np.int64), read) is not None
    assert late <= 6
