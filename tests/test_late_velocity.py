# SPDX-License-Identifier: Apache-2.0
"""A receiver's velocity that is stamped later than it was measured turns the heading, where that comes from the motion."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from graphloc import app
from graphloc.config import GnssConfig, VelocityConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.report import verdict
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import INERTIAL
from graphloc.factors.velocity import ROW
from graphloc.frames import Array
from graphloc.graph import FeltMotion
from graphloc.measurements import GnssVelocity, ImuSeries
from graphloc.replay import replay
from graphloc.solution import Solution
from tests.bagfactory import Messages
from tests.slowly import with_few_states
from tests.test_factors import attachment
from tests.test_inspect import DATUM, drive, look
from tests.test_odd_vessels import antenna_velocity

LATE_S = 0.2
SCENARIO = Scenario(
    path="turn", duration_s=60.0, noise="clean", pose_hz=0.0, compass_hz=0.0, gnss_hz=1.0, gnss_sigma_m=0.02, imu_hz=50.0
)  # fmt: skip
FELT = FeltMotion(np.array([0.8, -0.5, 9.9]), np.array([0.1, 0.3, -0.2]), np.array([0.0, 0.0, -9.81]))


@cache
def late(stamp_sigma_s: float, late_s: float = LATE_S) -> SimulatedRun:
    """A run through one turn with a velocity good to 5 cm/s, each stamped `late_s` after it was measured; no compass."""
    run, rng = simulate(SCENARIO, 21), np.random.default_rng(5)
    truth, gnss = run.truth, run.config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    v, late_ns = antenna_velocity(truth), round(late_s * 1e9)
    every = range(10, len(truth) - 20, round(0.2e9 / (truth.stamps_ns[1] - truth.stamps_ns[0])))
    told = [
        GnssVelocity(
            stamp_ns=int(truth.stamps_ns[k]) + late_ns, sensor="velocity", seq=10**6 + k,
            v_enu_mps=v[k] + rng.normal(0.0, 0.05, 3), cov_m2ps2=0.05**2 * np.eye(3),
        )
        for k in every
    ]  # fmt: skip
    recording = replace(
        run.recording,
        measurements=tuple(sorted((*run.recording.measurements, *told), key=lambda m: (m.stamp_ns, m.seq))),
    )
    slow = gnss.slow_error.model_copy(update={"horizontal_sigma_m": 0.03, "vertical_sigma_m": 0.06})
    config = run.config.with_sensors(
        {
            "imu": run.config.sensors["imu"].model_copy(update={"mount_sigma_deg": 0.0}),
            "gnss": gnss.model_copy(update={"slow_error": slow}),
            "velocity": VelocityConfig(mount=gnss.mount, stamp_sigma_s=stamp_sigma_s, wander_sigma_mps=0.0),
        }
    )
    return replace(run, recording=recording, config=with_few_states(config, 5.0))


@cache
def solved(stamp_sigma_s: float, late_s: float = LATE_S) -> app.Run:
    return app.simulated(late(stamp_sigma_s, late_s))


@cache
def replayed(stamp_sigma_s: float, late_s: float = LATE_S) -> Solution:
    run = late(stamp_sigma_s, late_s)
    return replay(run.recording, run.config).solution


def test_a_velocity_is_that_of_the_antenna_at_another_time() -> None:
    """On a circle, rolling: where a mast swings, its acceleration is far from that of the hull."""
    config, rate, lever = VelocityConfig(stamp_sigma_s=0.1, wander_sigma_mps=0.0), 0.3, np.array([1.0, -0.5, 8.0])

    def moving(t: float) -> tuple[Array, Array]:
        """Attitude and velocity of a vessel that goes 5 m/s."""
        return rotation(rate * t, 0.05 * np.sin(1.5 * t)), 5.0 * np.array([np.cos(rate * t), np.sin(rate * t), 0.0])

    def antenna_mps(t: float) -> Array:
        turned = (moving(t + 1e-4)[0] - moving(t - 1e-4)[0]) / 2e-4
        return np.asarray(moving(t)[1] + turned @ lever)

    def body_radps(t: float) -> Array:
        R = moving(t)[0]
        w = R.T @ (moving(t + 1e-4)[0] - moving(t - 1e-4)[0]) / 2e-4
        return np.array([w[2, 1], w[0, 2], w[1, 0]])

    t, late_s, g = 2.0, -0.05, np.array([0.0, 0.0, -9.8])
    R, v = moving(t)
    force = R.T @ (5.0 * rate * np.array([-np.sin(rate * t), np.cos(rate * t), 0.0]) - g)
    spin = (body_radps(t + 1e-3) - body_radps(t - 1e-3)) / 2e-3
    at = attachment(ROW, config)
    pose = type(at.T_world_body)(type(at.T_world_body.rotation())(R), np.zeros(3))
    at = replace(
        at, T_world_body=pose, v_world_mps=v, dv_world_mps=np.zeros(3), lever_m=lever, gyro_radps=body_radps(t),
        felt=FeltMotion(force, spin, g), constants=((6, np.array([late_s])),),
    )  # fmt: skip
    m = ROW.ideal(at, config)
    assert isinstance(m, GnssVelocity)
    assert np.linalg.norm(antenna_mps(t + late_s) - antenna_mps(t)) > 0.08
    np.testing.assert_allclose(m.v_enu_mps, antenna_mps(t + late_s), atol=0.004)


def rotation(yaw: float, roll: float) -> Array:
    """Body in world (3, 3)."""
    c, s, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(roll), np.sin(roll)
    about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]]))


@pytest.mark.parametrize("rate_hz", [12.5, 100.0, 400.0])
def test_what_is_felt_is_a_mean_over_waves_of_the_hull(rate_hz: float) -> None:
    """Force and rate go as waves of four seconds do; an engine shakes both thirty times a second. Turned as the IMU is mounted."""
    run = simulate(replace(SCENARIO, duration_s=2.0), 1)
    t = np.arange(0.0, 20.0, 1.0 / rate_hz)
    shaken = np.sin(2.0 * np.pi * 30.0 * t)[:, None] if rate_hz > 100.0 else np.zeros((len(t), 1))
    accel = np.array([0.0, 0.0, 9.8]) + np.sin(1.5 * t)[:, None] * [0.5, 0.2, 1.0] + shaken
    gyro = np.cos(1.5 * t)[:, None] * [0.1, 0.05, 0.02] + 0.05 * shaken
    stamps = (t * 1e9).astype(np.int64)
    imu = ImuSeries(sensor="imu", stamps_ns=stamps, accel_mps2=accel, gyro_radps=gyro, seqs=np.arange(len(t)))
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    links = INERTIAL.link(imu, run.config.sensors["imu"], R, 9.8)
    at = np.linspace(1.0, 18.0, 40)
    force, spin = np.split(links.felt_at((at * 1e9).astype(np.int64)), 2, axis=1)
    expected = np.array([0.0, 0.0, 9.8]) + np.sin(1.5 * at)[:, None] * [0.5, 0.2, 1.0]
    np.testing.assert_allclose(force @ R, expected, atol=0.02)
    np.testing.assert_allclose(spin @ R, -1.5 * np.sin(1.5 * at)[:, None] * [0.1, 0.05, 0.02], atol=0.02)
    alone = np.array([links.felt_at(np.array([round(s * 1e9)]))[0] for s in at])  # as online
    np.testing.assert_allclose(alone, np.hstack([force, spin]), atol=1e-9)
    newest = links.felt_at(stamps[-1:])[0]
    after = links.felt_at(np.array([round(25e9)]))[0]
    np.testing.assert_allclose(after, [*newest[:3], 0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(
        R.T @ after[:3], [0.0, 0.0, 9.8] + np.sin(1.5 * t[-1]) * np.array([0.5, 0.2, 1.0]), atol=0.15
    )


@pytest.mark.parametrize("beyond_s", [0.05, 0.09, 5.0])
def test_what_is_felt_at_the_ends_of_the_data_is_a_mean_too(beyond_s: float) -> None:
    """Where the IMU fell silent 0.05 s before, it was of five samples, then of one: an engine made it rad/s^2 and m/s^2."""
    run = simulate(replace(SCENARIO, duration_s=2.0), 1)
    stamps, rng = np.arange(400) * 10_000_000, np.random.default_rng(4)
    accel, gyro = rng.normal([0.0, 0.0, 9.8], 2.0, (400, 3)), rng.normal(0.0, 0.1, (400, 3))
    for begin in range(0, 400, 40):  # ten recordings, so that none is right by chance
        part = slice(begin, begin + 40)
        imu = ImuSeries(
            sensor="imu", stamps_ns=stamps[part], accel_mps2=accel[part], gyro_radps=gyro[part], seqs=np.arange(40)
        )
        links = INERTIAL.link(imu, run.config.sensors["imu"], np.eye(3), 9.8)
        far_ns = round(beyond_s * 1e9)
        felt = links.felt_at(np.array([imu.stamps_ns[0] - far_ns, imu.stamps_ns[-1] + far_ns]))
        alone = links.felt_at(np.array([imu.stamps_ns[0] - far_ns]))[0]
        np.testing.assert_allclose(felt[0], alone, atol=1e-9)
        assert np.abs(felt[:, :3] - [0.0, 0.0, 9.8]).max() < 2.2
        assert np.abs(felt[:, 3:]).max() < 3.0


@pytest.mark.parametrize("after_s", [-0.05, 0.03, 1.0, 2.0, 2.95, 3.05])
def test_what_is_felt_about_a_gap_is_of_the_nearer_side(after_s: float) -> None:
    """It was a line between two samples, which vibrate: of a velocity that is late, for all of the gap."""
    run = simulate(replace(SCENARIO, duration_s=2.0), 1)
    t, rng = np.append(np.arange(200), np.arange(500, 700)) * 0.01, np.random.default_rng(4)
    accel = np.where(t < 3.0, -1.0, 1.0)[:, None] * [1.0, 0.0, 0.0] + rng.normal([0.0, 0.0, 9.8], 0.1, (400, 3))
    accel[[199, 200]] += 5.0
    stamps = np.round(t * 1e9).astype(np.int64)
    imu = ImuSeries(
        sensor="imu", stamps_ns=stamps, accel_mps2=accel, gyro_radps=np.zeros((400, 3)), seqs=np.arange(400)
    )
    links = INERTIAL.link(imu, run.config.sensors["imu"], np.eye(3), 9.8)
    felt = links.felt_at(stamps[[199]] + round(after_s * 1e9))[0]
    np.testing.assert_allclose(felt, [-1.0 if after_s < 1.5 else 1.0, 0.0, 9.8, 0.0, 0.0, 0.0], atol=0.6)


@pytest.mark.parametrize("mode", ["offline", "online"])
def test_it_is_estimated_and_the_heading_is_right(mode: str) -> None:
    def of(stamp_sigma_s: float) -> Solution:
        return solved(stamp_sigma_s).solution if mode == "offline" else replayed(stamp_sigma_s)

    believed, estimated = (compare_to_truth(of(sigma).trajectory, late(sigma).truth) for sigma in (0.0, 0.1))
    assert estimated.heading_rmse_deg < 0.5 * believed.heading_rmse_deg
    assert believed.heading_coverage_95 is not None
    assert estimated.heading_coverage_95 is not None
    assert believed.heading_coverage_95 < 0.25
    # Online, until the one turn, the heading was by velocities that were believed in time.
    assert estimated.heading_coverage_95 > (0.9 if mode == "offline" else 0.5)
    assert estimated.position_rmse_m < believed.position_rmse_m
    assert estimated.coverage_95 is not None
    assert estimated.coverage_95 > 0.9


def test_the_track_and_the_calibration_say_how_late() -> None:
    assert solved(0.1).solution.time_offsets_s["velocity"] == pytest.approx(-LATE_S, abs=0.04)
    found = solved(0.1).calibration
    assert found is not None
    (line,) = (s for s in found.suggestions if s.key == "sensors.velocity.time_offset_s")
    assert line.suggested == pytest.approx(-LATE_S, abs=0.04)
    assert line.action == "already corrected in the track, by stamp_sigma_s"


def test_the_first_screen_says_that_the_heading_is_off() -> None:

    def said(stamp_sigma_s: float) -> list[str]:
        run = solved(stamp_sigma_s)
        (track,) = verdict(app.report_data(replace(run, recording=replace(run.recording, truth=None)))).tracks
        return [r.text for r in track.reasons if "off where it comes from the motion" in r.text]

    assert len(said(0.0)) == 1
    assert "velocity and the IMU are 0.2" in said(0.0)[0]
    assert said(0.1) == []


@pytest.mark.parametrize("mode", ["offline", "online"])
def test_a_time_far_beyond_its_sigma_is_said(mode: str) -> None:
    found = solved(0.03).solution if mode == "offline" else replayed(0.03)
    said = [w for w in found.stats.warnings if "sigmas from its configured value: add -" in w]
    assert len(said) == 1
    assert "velocity: time_offset_s is " in said[0]


def test_inspect_drafts_that_it_is_not_known(tmp_path: Path) -> None:
    make = Messages(2)
    plain = [item for item in drive(make, seconds=60) if item[0] != "/wheel/odom"]
    fixes = [(at, m) for topic, at, m in plain if topic == "/fix"]
    lla = (np.array([getattr(m, k) for _, m in fixes]) for k in ("latitude", "longitude", "altitude"))
    speeds = np.gradient(DATUM.enu_from_geodetic(*lla), 0.2, axis=0)
    items = [*plain, *(("/vel", at, make.twist(at, v)) for (at, _), v in zip(fixes, speeds, strict=True))]
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    velocity = config.sensors["gnss_velocity"]
    assert isinstance(velocity, VelocityConfig)
    assert velocity.stamp_sigma_s == 0.05


def test_a_velocity_in_time_stays_where_it_is() -> None:
    believed, estimated = (
        compare_to_truth(solved(sigma, 0.0).solution.trajectory, late(sigma, 0.0).truth) for sigma in (0.0, 0.1)
    )
    assert abs(solved(0.1, 0.0).solution.time_offsets_s["velocity"]) < 0.04
    assert estimated.heading_rmse_deg < believed.heading_rmse_deg + 0.2
    assert estimated.position_rmse_m < believed.position_rmse_m + 0.01
