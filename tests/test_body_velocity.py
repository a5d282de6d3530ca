"""Velocity along the vessel: what messages say, what the factor makes of it, and what it is worth while GNSS is silent."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.blocks import MountConfig
from graphloc.config import BodyVelocityConfig, load_config, parse_config
from graphloc.eval import ekf
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.factors import KINDS
from graphloc.factors.body_velocity import residuals
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends._readings import Readings
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._run_warnings import _along_fewer
from graphloc.frontends.bag import read_recording
from graphloc.frontends.decode import DECODERS
from graphloc.frontends.lines import Trouble, parse
from graphloc.frontends.msgtypes import NUMBERS, VECTOR
from graphloc.graph import Attachment
from graphloc.ledger import Outcome
from graphloc.measurements import BodyVelocity, GnssPosition
from graphloc.recording import Recording
from graphloc.replay import replay
from graphloc.signals.thinning import THINNED
from tests.bagfactory import START_NS, Messages
from tests.slowly import simulate_slowly

MAKE = Messages(2)
KNOT_MPS = 1852.0 / 3600.0
LOOPS_OVER_GROUND = Scenario(
    path="loops", imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0, pose_hz=0.0, log_through="ground",
)  # fmt: skip


def decode(msg: Any, config: BodyVelocityConfig, msgtype: str = "") -> Any:
    return DECODERS["body_velocity", msgtype or msg.__msgtype__](msg, START_NS, 5, "log", config)


def configured(**keys: Any) -> BodyVelocityConfig:
    return BodyVelocityConfig.model_validate({"kind": "body_velocity", **keys})


def test_axes_are_picked_in_the_order_of_the_sensor() -> None:
    cov = np.diag([0.04, 0.09, 0.16, 1.0, 1.0, 1.0])
    cov[0, 2] = cov[2, 0] = 0.03
    m = decode(MAKE.twist(START_NS, (1, 2, 3), cov), configured(axes=["z", "x"]))
    assert isinstance(m, BodyVelocity)
    assert m.axes == ("x", "z")
    np.testing.assert_array_equal(m.value, [1, 3])
    np.testing.assert_allclose(m.cov, [[0.04, 0.03], [0.03, 0.16]])
    own = decode(MAKE.twist(START_NS, (1, 2, 3), cov), configured(use_reported_sigma=False, sigma_mps=0.5))
    np.testing.assert_allclose(own.cov, [[0.25]])


def test_the_twist_of_an_odometry_is_read_not_its_pose() -> None:
    odometry = MAKE.odometry(START_NS, (7, 8, 9), (0, 0, 0, 1))
    odometry.twist.twist.linear.x = 1.25
    m = decode(odometry, configured())
    assert (m.axes, m.value.tolist()) == (("x",), [1.25])


@pytest.mark.parametrize(("unit", "mps"), [("m/s", 4.0), ("km/h", 4.0 / 3.6), ("knots", 4.0 * KNOT_MPS)])
def test_a_number_is_a_speed_ahead_in_its_unit(unit: str, mps: float) -> None:
    m = decode(SimpleNamespace(data=4.0), configured(unit=unit, axes=["x", "y"]), NUMBERS[0])
    assert m.axes == ("x",)  # it does not say that there is no drift
    assert m.value[0] == pytest.approx(mps)


def test_a_speed_log_in_knots_or_kilometres() -> None:
    def sentence(body: str) -> SimpleNamespace:
        total = 0
        for letter in body:
            total ^= ord(letter)
        return SimpleNamespace(sentence=f"${body}*{total:02X}")

    msgtype = "nmea_msgs/msg/Sentence"
    assert decode(sentence("VWVHW,,T,,M,05.20,N,09.63,K"), configured(), msgtype).value[0] == pytest.approx(
        5.2 * KNOT_MPS
    )
    assert decode(sentence("VWVHW,,T,,M,,N,09.00,K"), configured(), msgtype).value[0] == pytest.approx(2.5)
    for body, why in (("VWVHW,,T,,M,,N,,K", "no speed"), ("GPVTG,1.0,T,,M,1.0,N,1.9,K,A", "not among")):
        found = decode(sentence(body), configured(), msgtype)
        assert isinstance(found, Rejection)
        assert why in found.reason


def test_what_is_no_velocity_is_refused() -> None:
    vector = SimpleNamespace(vector=SimpleNamespace(x=np.nan, y=0.0, z=0.0))
    assert decode(vector, configured(), VECTOR).outcome is Outcome.MALFORMED
    assert decode(vector, configured(axes=["y"]), VECTOR).value.tolist() == [0.0]  # x is not asked for
    sideways = decode(SimpleNamespace(data=1.0), configured(axes=["y"]), NUMBERS[0])
    assert sideways.outcome is Outcome.REJECTED
    assert "along x alone" in sideways.reason


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("said", [-32.768, float(np.float32(-32.768))])
def test_a_doppler_log_that_hears_no_echo_is_rejected(said: float, axis: int) -> None:
    """It writes the least integer of 16 bits, in mm/s; as a speed that drew a boat away, and `inspect` took it for no velocity of hers."""
    v = np.array([1.0, 0.2, 0.0])
    assert decode(MAKE.twist(START_NS, v.tolist()), configured(axes=["x", "y", "z"])).value.tolist() == v.tolist()
    v[axis] = said
    lost = decode(MAKE.twist(START_NS, v.tolist()), configured(axes=["x", "y", "z"]))
    assert lost.outcome is Outcome.REJECTED
    assert "no lock" in lost.reason


def test_a_line_of_a_stream_says_the_same() -> None:
    config = parse_config({"sensors": {"dvl": {"kind": "body_velocity", "axes": ["x", "y"]}}}, KINDS, "test")
    line = {"type": "body_velocity", "stamp": "5", "v_mps": [1.0, -0.5, 9.0], "sigma_mps": [0.1, 0.2, 0.3]}
    m = parse(json.dumps(line).encode(), 1, 0, config)
    assert isinstance(m, BodyVelocity)
    assert (m.sensor, m.axes, m.value.tolist()) == ("dvl", ("x", "y"), [1.0, -0.5])
    np.testing.assert_allclose(m.cov, np.diag([0.01, 0.04]))
    assert isinstance(parse(json.dumps({**line, "v_mps": [1.0]}).encode(), 1, 0, config), Trouble)


def test_a_residual_by_hand() -> None:
    """Heading north at 2 m/s over ground, in a current of 0.5 m/s to the north, turning left by 0.1 rad/s, log 3 m ahead, 4 % too much.

    Through the water 1.5 m/s ahead; the turn moves the log by 0.3 m/s to port.
    """
    at = Attachment(
        pose_key=1, velocity_key=2, slow_key=3, leaf_keys=(4, 5), T_world_body=gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2), np.zeros(3)),
        v_world_mps=np.array([0.0, 2.0, 0.0]), T_state_sensor=gtsam.Pose3(gtsam.Rot3(), np.array([3.0, 0.0, 0.0])),
        carried_m=np.zeros(3), dv_world_mps=np.zeros(3), gyro_radps=np.array([0.0, 0.0, 0.1]), lever_m=np.array([3.0, 0.0, 0.0]),
        slow_value=np.array([0.04, 0.0, 0.5]), datum=Datum(Geodetic(59.3, 18.1, 20.0)),
    )  # fmt: skip
    m = BodyVelocity(stamp_ns=0, sensor="log", seq=0, axes=("x", "y"), value=np.array([1.0, 0.1]), cov=np.eye(2) * 0.01)
    (found,) = residuals(m, configured(axes=["x", "y"], through="water"), at)
    np.testing.assert_allclose(found.raw, [1.04 * 1.5 - 1.0, 1.04 * 0.3 - 0.1])
    np.testing.assert_allclose(found.velocity_jacobian() @ [0.0, 1.0, 0.0], [1.04, 0.0], atol=1e-12)  # type: ignore[misc]


def silent(seed: int, log_hz: float) -> SimulatedRun:
    """Twenty seconds of loops, then 30 s without fixes and matches. Sensors and states at low rates: a quarter of the time."""
    scenario = Scenario(
        path="loops", noise="drift", duration_s=51.0, outage_s=(20.0, 50.0), log_hz=log_hz,
        imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0,
    )  # fmt: skip
    return simulate_slowly(scenario, seed, rate_hz=1.25)


def test_a_log_holds_the_track_while_gnss_is_silent() -> None:
    """Causal, through water that flows at 0.3, -0.2 m/s with a log that reads 2 % too much: neither is told."""
    largest: dict[float, list[float]] = {0.0: [], 5.0: []}
    squares: list[float] = []
    for seed in (11,):
        for hz, found in largest.items():
            run = silent(seed, hz)
            track = replay(run.recording, run.config).solution.trajectory
            begin, end = (int(run.truth.stamps_ns[0]) + round(t * 1e9) for t in (20.0, 50.0))
            inside = (track.stamps_ns > begin) & (track.stamps_ns < end)
            off = (track.p_world_m - run.truth.at(track.stamps_ns).p_world_m)[inside, :2]
            assert track.cov is not None
            nis = np.einsum("ni,ni->n", off, np.linalg.solve(track.cov[inside, :2, :2], off[:, :, None])[:, :, 0])
            if hz:
                squares.append(float(nis.mean()))
            found.append(float(np.hypot(*off.T).max()))
    assert np.mean(squares) < 3.0  # of two axes
    assert np.mean(largest[5.0]) < 0.75 * np.mean(largest[0.0])


def test_the_batch_finds_the_current() -> None:
    run = silent(10, 5.0)
    solution = app.simulated(run).solution
    log = solution.slow["log"]
    away = (log.value[-1] - [2.0, 0.3, -0.2]) / log.sigma[-1]
    assert np.abs(away).max() < 3.0
    assert log.sigma[-1][1:].max() < 0.3  # of 0.5 to begin with
    used = [row for row in solution.ledger if row.sensor == "log"]
    assert len(used) == sum(isinstance(m, BodyVelocity) for m in run.recording.measurements)
    assert sum(row.outcome is Outcome.USED for row in used) > 0.9 * len(used)


def test_online_what_is_faster_than_it_errs_anew_is_thinned() -> None:
    """At 50 Hz every third is used; the others have a row, and no factor."""
    scenario = replace(LOOPS_OVER_GROUND, duration_s=20.0, log_hz=50.0)
    run = simulate_slowly(scenario, 3)
    said = [m for m in run.recording.measurements if isinstance(m, BodyVelocity)]
    rows = list(replay(run.recording, run.config).solution.ledger)
    assert len(said) > 900
    assert {row.seq for row in rows if row.reason == THINNED} == {m.seq for n, m in enumerate(said) if n % 3}


def on_wheels(run: SimulatedRun, off_m: float, turned_deg: float) -> Recording:
    """Return what wheels say that sit so far ahead of where they are taken to be, and are turned; by differences of true positions."""
    truth, rng = run.truth, np.random.default_rng(8)
    place = truth.p_world_m + truth.R_world_body @ np.array([off_m, 0.0, 0.0])
    t_s = 1e-9 * (truth.stamps_ns - truth.stamps_ns[0])
    turned = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    along = np.einsum("nji,nj->ni", truth.R_world_body @ turned, np.gradient(place, t_s, axis=0))

    def rolled(m: Any) -> Any:
        if not isinstance(m, BodyVelocity):
            return m
        k = min(int(np.searchsorted(truth.stamps_ns, m.stamp_ns)), len(along) - 1)
        return replace(m, axes=("x", "y"), value=along[k, :2] + rng.normal(0.0, 0.05, 2), cov=0.05**2 * np.eye(2))

    return run.recording.changed(rolled)


def test_the_batch_finds_where_wheels_sit_and_how_they_are_turned() -> None:
    """A place 1.2 m abaft of where it is taken to be and turned by 2 deg."""
    scenario = replace(LOOPS_OVER_GROUND, duration_s=120.0, log_hz=5.0)
    run = simulate_slowly(scenario, 3)
    block = configured(topic="/log", axes=["x", "y"], mount_sigma_m=1.5, mount_sigma_deg=2.0)
    config = run.config.model_copy(update={"sensors": {**run.config.sensors, "log": block}})
    found = app.simulated(replace(run, recording=on_wheels(run, -1.2, 2.0), config=config), compare=False).solution
    slow = found.slow["log"]
    assert slow.axes == ("scale", "mount x", "mount y", "mount z", "yaw")
    away = (slow.value[-1] - [0.0, -1.2, 0.0, 0.0, 2.0]) / slow.sigma[-1]
    assert np.abs(away).max() < 3.0
    assert slow.sigma[-1][1] < 0.3  # m, of 1.5 to begin with
    assert slow.sigma[-1][4] < 1.0  # deg, of 2


def test_the_better_filter_is_told_that_the_mount_of_wheels_is_not_known() -> None:
    """As the graph is: else the comparison flatters the graph (6.7 m beside 2.4 m)."""
    scenario = replace(LOOPS_OVER_GROUND, duration_s=90.0, log_hz=5.0)
    run = simulate_slowly(scenario, 7)
    recording = on_wheels(run, -3.0, 4.0)

    def rmse_and_nees(**unknown: float) -> Array:
        config = run.config.with_sensors({"log": configured(topic="/log", axes=["x", "y"], **unknown)})
        track = ekf.run_honest(recording, config, app.choose_datum(recording, config)).trajectory
        numbers = compare_to_truth(track, run.truth)
        return np.array([numbers.position_rmse_m, numbers.nees])

    untold = rmse_and_nees()
    assert (rmse_and_nees(mount_sigma_m=1.5, mount_sigma_deg=2.0) < [0.7, 0.5] * untold).all()
    assert rmse_and_nees(mount_sigma_m=1.5)[1] < untold[1]
    assert rmse_and_nees(mount_sigma_deg=2.0)[1] < untold[1]


@pytest.mark.parametrize(("factor", "cure"), [(3.6, "check its unit"), (-1.0, "turn its mount by 180 deg")])
def test_a_wrong_unit_or_sign_is_named(factor: float, cure: str) -> None:
    """Kilometres an hour, read as metres a second; and wheels that count backwards."""
    scenario = replace(LOOPS_OVER_GROUND, duration_s=60.0, log_hz=2.0)
    run = simulate_slowly(scenario, 3)

    def otherwise(m: Any) -> Any:
        return replace(m, value=factor * m.value) if isinstance(m, BodyVelocity) else m

    recording = run.recording.changed(otherwise)
    found = app.simulated(replace(run, recording=recording), compare=False).solution
    (line,) = (said for said in found.stats.warnings if said.startswith("log: its speed error"))
    times = re.search(rf"it reads (-?[\d.]+) times the speed: {cure}", line)
    assert times
    assert float(times[1]) == pytest.approx(factor, rel=0.1)
    assert ("mount" in line) == (factor < 0.0)


def test_wheels_that_are_turned_are_said_to_be_so() -> None:
    """By 3.6 deg, of a mount that is good to 1 deg, beside a compass that is good to 1 deg."""
    scenario = replace(LOOPS_OVER_GROUND, duration_s=60.0, log_hz=2.0)
    run = simulate_slowly(scenario, 3)
    turned = np.radians(3.6)

    def rolled(m: Any) -> Any:
        if not isinstance(m, BodyVelocity):
            return m
        value = m.value[0] * np.array([np.cos(turned), -np.sin(turned)])
        return replace(m, axes=("x", "y"), value=value, cov=0.05**2 * np.eye(2))

    block = configured(topic="/log", axes=["x", "y"], mount_sigma_deg=1.0)
    config = run.config.model_copy(update={"sensors": {**run.config.sensors, "log": block}})
    found = app.simulated(replace(run, recording=run.recording.changed(rolled), config=config), compare=False).solution
    assert any(line.startswith("log: its velocities are turned by +") for line in found.stats.warnings)


def test_axes_that_its_messages_do_not_tell_are_named() -> None:
    values = [decode(SimpleNamespace(data=4.0), configured(axes=["x", "y"]), NUMBERS[0])]
    for axes, said in ((["x", "y"], ["not y of its axes"]), (["x"], [])):
        readings = SimpleNamespace(sensor="wheels", config=configured(axes=axes), values=values)
        lines = _along_fewer([cast("Readings", readings)])
        assert len(lines) == len(said)
        assert all(text in line for text, line in zip(said, lines, strict=True))


def test_the_better_filter_takes_it_and_the_thesis_says_why_not() -> None:
    run = simulate(
        Scenario(path="loops", noise="drift", duration_s=60.0, outage_s=(20.0, 58.0), log_hz=5.0, log_through="ground"),
        4,
    )
    datum = app.choose_datum(run.recording, run.config)
    told = {f.name: f for f in ekf.run_all(run.recording, run.config, datum)}
    without = run.recording.where(lambda m: not isinstance(m, BodyVelocity))
    alone = {f.name: f for f in ekf.run_all(without, run.config, datum)}
    honest, dead_reckoned = (
        compare_to_truth(f["honest EKF"].trajectory, run.truth).position_rmse_m for f in (told, alone)
    )
    assert honest < 0.6 * dead_reckoned
    rows = [row for row in told["BL EKF"].ledger if row.sensor == "log"]
    assert rows
    assert all(row.reason == "BL's filter has no velocity" for row in rows)


def test_a_current_is_no_speed_over_ground_to_the_better_filter() -> None:
    """It has no state for a current of 0.8 m/s, so it must not be surer for the log than it is right."""
    scenario = Scenario(
        path="loops", noise="drift", duration_s=90.0, log_hz=5.0, current_east_mps=0.8, current_north_mps=0.0
    )
    run = simulate(scenario, 5)
    datum = app.choose_datum(run.recording, run.config)
    without = run.recording.where(lambda m: not isinstance(m, BodyVelocity))
    told, alone = (
        compare_to_truth(f.trajectory, run.truth)
        for recording in (run.recording, without)
        for f in ekf.run_all(recording, run.config, datum)
        if f.name == "honest EKF"
    )
    assert told.position_rmse_m < 1.2 * alone.position_rmse_m
    assert told.nees is not None
    assert told.nees < 4.0


def test_a_log_that_is_turned_on_its_mount_is_read_along_its_own_axes_by_the_filter() -> None:
    """Mounted a quarter turn to port, its y axis points astern: minus the speed ahead."""
    run = simulate(
        Scenario(path="loops", noise="drift", duration_s=40.0, outage_s=(20.0, 38.0), log_hz=5.0, log_through="ground"),
        4,
    )
    turned = run.config.sensors["log"].model_copy(
        update={"mount": MountConfig(rpy_deg=(0.0, 0.0, 90.0)), "axes": ("y",)}
    )
    config = run.config.model_copy(update={"sensors": {**run.config.sensors, "log": turned}})
    measurements = tuple(
        replace(m, axes=("y",), value=-m.value) if isinstance(m, BodyVelocity) else m
        for m in run.recording.measurements
    )
    datum = app.choose_datum(run.recording, run.config)
    one = ekf.run_all(run.recording, run.config, datum)
    other = ekf.run_all(replace(run.recording, measurements=measurements), config, datum)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a.trajectory.p_world_m, b.trajectory.p_world_m, atol=1e-6)


def test_a_simulated_log_comes_back_from_its_bag(tmp_path: Path) -> None:
    run = simulate(Scenario(path="loops", duration_s=4.0, log_hz=5.0, lidar_hz=0.0), 2)
    bag, vessel = write_bag(run, tmp_path / "run", ros=2)
    recording = read_recording(bag, load_config(vessel, KINDS))
    mine, theirs = (
        [m for m in measurements if isinstance(m, BodyVelocity)]
        for measurements in (recording.measurements, run.recording.measurements)
    )
    assert len(mine) == len(theirs) > 15
    for a, b in zip(mine, theirs, strict=True):
        assert (a.stamp_ns, a.axes) == (b.stamp_ns, b.axes)
        np.testing.assert_allclose(a.value, b.value, atol=1e-12)
    assert any(isinstance(m, GnssPosition) for m in recording.measurements)
