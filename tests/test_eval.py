"""Simulator, metrics and filters, each against something derived here."""

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.errors import ConfigError
from graphloc.eval import ekf, metrics
from graphloc.eval.holdout import HoldOut
from graphloc.eval.simulate import Scenario, bl_scenario, simulate
from graphloc.eval.simulate._scenario import _motion
from graphloc.measurements import GnssPosition
from graphloc.trajectory import Trajectory


def test_noise_free_imu_integrates_to_the_truth() -> None:
    """Strapdown integration (midpoint) of the noise-free samples over 60 s, at a lever arm."""
    scenario = Scenario(duration_s=60.0)
    motion = _motion(scenario, np.random.default_rng(1))
    lever = np.array([0.5, -0.2, 1.0])
    t = np.arange(0.0, 60.0, 0.005)
    force, rate = motion.inertial(t + 0.0025, lever, 9.80665)  # at the middle of each step
    p0, R0, v0 = motion.pose(np.array([0.0]))
    R = Rotation.from_matrix(R0[0])
    p, v = p0[0] + R0[0] @ lever, v0[0] + R0[0] @ np.cross(motion.body_rate(np.array([0.0]))[0], lever)
    for f, w in zip(force, rate, strict=True):
        half = R * Rotation.from_rotvec(w * 0.0025)
        a = half.apply(f) - np.array([0.0, 0.0, 9.80665])
        p, v, R = p + v * 0.005 + 0.5 * a * 0.005**2, v + a * 0.005, R * Rotation.from_rotvec(w * 0.005)
    pe, Re, _ = motion.pose(np.array([60.0]))
    assert np.linalg.norm(p - (pe[0] + Re[0] @ lever)) < 0.05
    assert (R.inv() * Rotation.from_matrix(Re[0])).magnitude() < 1e-3


@pytest.mark.parametrize(
    ("case", "noise", "rmse", "largest"),
    [(1, "drift", 1.3567, 1.7044), (1, "jump", 2.4596, 14.5443), (3, "jump", 3.6406, 9.9748)],
)
def test_gnss_errors_are_those_of_the_thesis(case: int, noise: str, rmse: float, largest: float) -> None:
    """BL tables 4.1 and 4.2; the maximum is that of a signal without our white noise, so looser."""
    run = simulate(bl_scenario(case, noise), 3)  # type: ignore[arg-type]
    fixes = [m for m in run.recording.measurements if isinstance(m, GnssPosition)]
    datum = app.choose_datum(run.recording, run.config)
    at = run.truth.at(np.array([m.stamp_ns for m in fixes]))
    antenna = at.p_world_m + at.R_world_body @ np.array([-1.5, 0.3, 2.2789])
    error = np.hypot(*(datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T) - antenna)[:, :2].T)
    assert np.sqrt((error**2).mean()) == pytest.approx(rmse, rel=0.1)
    assert error.max() == pytest.approx(largest, rel=0.35 if noise == "drift" else 0.12)


def test_a_seed_is_a_run() -> None:
    first, again, other = (simulate(Scenario(duration_s=5.0), seed).recording for seed in (4, 4, 5))
    assert first.imu is not None
    assert again.imu is not None
    assert other.imu is not None
    assert np.array_equal(first.imu.accel_mps2, again.imu.accel_mps2)
    assert not np.array_equal(first.imu.accel_mps2, other.imu.accel_mps2)


def _pair() -> tuple[Trajectory, Trajectory]:
    rng = np.random.default_rng(0)
    stamps = np.arange(200, dtype=np.int64) * 100_000_000
    R = Rotation.from_euler("z", np.linspace(3.0, 3.4, 200)[:, None]).as_matrix()  # across the wrap
    p = np.cumsum(rng.normal(size=(200, 3)), axis=0)
    truth = Trajectory(stamps_ns=stamps, p_world_m=p, R_world_body=R)
    turned = Rotation.from_euler("z", np.linspace(3.0, 3.4, 200)[:, None] + 0.02).as_matrix()
    cov = np.tile(np.diag([0.25, 0.25, 1.0, 1e-2, 1e-2, 1e-2]), (200, 1, 1))
    noisy = p + rng.normal(size=(200, 3)) * 0.5
    return Trajectory(stamps_ns=stamps, p_world_m=noisy, R_world_body=turned, cov=cov), truth


def test_metrics_agree_with_evo_and_by_hand() -> None:
    estimate, truth = _pair()
    ours = metrics.compare_to_truth(estimate, truth)
    poses = [
        PoseTrajectory3D(
            positions_xyz=t.p_world_m,
            orientations_quat_wxyz=np.roll(Rotation.from_matrix(t.R_world_body).as_quat(), 1, axis=1),
            timestamps=t.stamps_ns * 1e-9,
        )
        for t in (truth, estimate)
    ]
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((poses[0], poses[1]))
    assert ours.error_3d_rmse_m == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.rmse), abs=1e-9)
    assert ours.heading_rmse_deg == pytest.approx(np.degrees(0.02), abs=1e-9)
    assert ours.matched == 1.0
    assert ours.nees == pytest.approx(2.0, abs=0.35)  # drawn from the covariance it states
    assert ours.coverage_95 == pytest.approx(0.95, abs=0.04)


def test_half_a_track_is_half_matched() -> None:
    estimate, truth = _pair()
    half = Trajectory(
        stamps_ns=estimate.stamps_ns[:100], p_world_m=estimate.p_world_m[:100], R_world_body=estimate.R_world_body[:100]
    )
    assert metrics.compare_to_truth(half, truth).matched == 0.5


@pytest.mark.parametrize("text", ["every:1", "gaps:0x10", "gaps:3", "each:2", "gaps:2x0"])
def test_bad_hold_out_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="use every:N"):
        HoldOut.parse(text)


def test_gaps_are_where_they_should_be() -> None:
    run = simulate(Scenario(duration_s=90.0, imu_hz=10.0, noise="clean"), 0)
    _, held = HoldOut.parse("gaps:2x10").split(run.recording)
    t = np.array([m.stamp_ns - run.recording.measurements[0].stamp_ns for m in held]) * 1e-9
    inside = [np.abs(t - c) <= 5.1 for c in (30.0, 60.0)]
    assert (inside[0] | inside[1]).all()
    assert abs(inside[0].sum() - 100) <= 2
    assert abs(inside[1].sum() - 100) <= 2


def test_the_gate_of_the_thesis_drops_what_is_2_m_away() -> None:
    """A filter started 5 m off by a first bad fix rejects true matches; without a gate it takes them."""
    run = simulate(Scenario(duration_s=30.0, noise="clean", false_fraction=0.0), 2)
    datum = app.choose_datum(run.recording, run.config)
    gated = ekf.run_bl(run.recording, run.config, datum, ekf.BlConfig(gate_m=0.05))
    free = ekf.run_bl(run.recording, run.config, datum, ekf.BlConfig(gate_m=1e9))
    count = [sum(r.outcome.value == "rejected" for r in f.ledger) for f in (gated, free)]
    assert count[0] > 15
    assert count[1] == 0
    track = metrics.compare_to_truth(free.trajectory, run.truth)
    assert track.position_rmse_m < 1.0
