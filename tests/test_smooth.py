"""The offline solver on simulated runs, where truth exists; and the whole path through a bag."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.errors import InputError, SolveError
from graphloc.eval.holdout import HoldOut
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, bl_scenario
from graphloc.measurements import GnssPosition, PoseFix
from graphloc.recording import Recording
from graphloc.time import stamps_of, utc_text
from tests.slowly import beside_filters, simulate_slowly, sparsely

SHORT = Scenario(duration_s=40.0, noise="drift", imu_hz=50.0, gnss_hz=5.0, compass_hz=5.0)


@pytest.fixture(scope="module")
def short() -> app.Run:
    return beside_filters(sparsely(simulate_slowly(SHORT, 5), 2))


def test_smoother_beats_the_filter_and_its_covariance_holds(short: app.Run) -> None:
    truth = short.recording.truth
    assert truth is not None
    ours = compare_to_truth(short.solution.trajectory, truth)
    filters = {f.name: compare_to_truth(f.trajectory, truth) for f in short.filters}
    assert ours.position_rmse_m < 0.35
    assert ours.position_rmse_m < filters["BL EKF"].position_rmse_m / 3.0
    assert ours.heading_rmse_deg < 0.5
    assert ours.coverage_95 is not None
    assert ours.coverage_95 > 0.7
    assert short.solution.stats.converged


def test_ledger_has_one_row_for_each_message(short: app.Run) -> None:
    ledger = short.solution.ledger
    assert len(ledger) == short.recording.message_count
    assert len({row.seq for row in ledger}) == short.recording.message_count


def test_a_row_is_used_from_half_a_weight_on(short: app.Run) -> None:
    weighed = [row for row in short.solution.ledger if row.weight is not None]
    assert {row.outcome.value for row in weighed} == {"used", "down_weighted", "rejected"}
    for row in weighed:
        assert row.weight is not None
        assert (row.outcome.value == "used") == (row.weight >= 0.5)


def test_false_matches_are_found(short: app.Run) -> None:
    """A match is false where it lies over 1 m from the truth; the ledger must say the same of nearly all."""
    truth = short.recording.truth
    assert truth is not None
    weights = {row.seq: row.weight or 0.0 for row in short.solution.ledger}
    right = wrong = 0
    for m in short.recording.measurements:
        if isinstance(m, PoseFix):
            at = truth.at(np.array([m.stamp_ns]))
            false = np.hypot(*(m.modes[0].value[:2] - at.p_world_m[0, :2])) > 1.0
            right += (weights[m.seq] < 0.5) == false
            wrong += (weights[m.seq] < 0.5) != false
    assert wrong <= 2
    assert right >= 35


def test_the_gnss_error_is_found_with_its_sign(short: app.Run) -> None:
    """The slow state, as written, is what must be subtracted from the fixes: metres of drift, known to decimetres."""
    truth, datum = short.recording.truth, short.solution.datum
    assert truth is not None
    fixes = short.recording.of(GnssPosition)
    at = truth.at(stamps_of(fixes))
    antenna = at.p_world_m + at.R_world_body @ np.array([-1.5, 0.3, 2.2789])
    error = datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T) - antenna
    slow = short.solution.slow["gnss"]
    estimated = np.column_stack([np.interp(at.stamps_ns, slow.stamps_ns, slow.value[:, k]) for k in range(2)])
    assert np.sqrt((error[:, :2] ** 2).mean()) > 0.5
    assert np.sqrt(((estimated - error[:, :2]) ** 2).mean()) < 0.35  # 0.21 m of it is each fix's white noise


def test_how_fast_it_turns_is_as_uncertain_as_said(short: app.Run) -> None:
    """8 mdeg/s/sqrt(Hz) at 50 Hz is 0.06 deg/s, and less between two samples; the bias is known to less."""
    solution, truth = short.solution, short.recording.truth
    assert truth is not None
    track = solution.trajectory.where(slice(2, -2))
    R = [truth.at(track.stamps_ns + half_ns).R_world_body for half_ns in (-10_000_000, 10_000_000)]
    true_radps = Rotation.from_matrix(np.swapaxes(R[0], 1, 2) @ R[1]).as_rotvec() / 0.02
    off, cov = solution.gyro_radps[2:-2] - true_radps, solution.gyro_cov[2:-2]
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov), off).mean()
    assert 1.2 < nees < 3.6
    assert short.config.sensors["imu"].gyro_noise_mdps_per_sqrt_hz == 8.0
    white = np.radians(0.008) ** 2 * 50.0
    assert (np.linalg.eigvalsh(cov)[:, 0] > white).all()  # the bias's is added


def test_modes_are_chosen() -> None:
    """Three modes a match, one right: the ledger's choice is the right one."""
    run = sparsely(simulate_slowly(replace(SHORT, pose_modes=3, false_fraction=0.0, noise="clean"), 2))
    solved = app.simulated(run)
    rows = {row.seq: row for row in solved.solution.ledger}
    chosen = []
    for m in run.recording.measurements:
        if isinstance(m, PoseFix):
            true = run.truth.at(np.array([m.stamp_ns])).p_world_m[0, :2]
            nearest = int(np.argmin([np.hypot(*(mode.value[:2] - true)) for mode in m.modes]))
            chosen.append(rows[m.seq].mode == nearest)
    assert np.mean(chosen) >= 0.97


def test_bad_start_is_not_lost() -> None:
    """Gyro bias of 0.05 rad/s and a start heading 15 deg off."""
    scenario = replace(SHORT, noise="clean", gyro_bias_radps=0.05, start_heading_error_deg=15.0)
    run = sparsely(simulate_slowly(scenario, 1))
    ours = compare_to_truth(app.simulated(run).solution.trajectory, run.truth)
    assert ours.heading_max_deg < 1.5
    assert ours.position_rmse_m < 0.5


def test_comes_back_after_an_outage() -> None:
    scenario = replace(bl_scenario(1, "clean"), duration_s=80.0, outage_s=(25.0, 55.0))
    run = sparsely(simulate_slowly(scenario, 3))
    track = app.simulated(run).solution.trajectory
    at = np.array([run.truth.stamps_ns[6500]])
    error = np.hypot(*(track.at(at).p_world_m - run.truth.at(at).p_world_m)[0, :2])
    assert error < 1.0


def test_rotated_world_gives_the_rotated_estimate() -> None:
    """Turning every measurement about the datum by 90 deg turns the estimate: no axis is special."""
    run = simulate_slowly(replace(SHORT, duration_s=20.0, gnss_hz=0.0, compass_hz=0.0, false_fraction=0.0), 4)
    plain = app.simulated(run).solution.trajectory

    def turned(m: PoseFix) -> PoseFix:
        x, y, yaw = m.modes[0].value
        mode = replace(m.modes[0], value=np.array([-y, x, yaw + np.pi / 2.0]))
        return replace(m, modes=(mode,))

    measurements = tuple(turned(m) if isinstance(m, PoseFix) else m for m in run.recording.measurements)
    other = app.smooth_recording(replace(run.recording, measurements=measurements), run.config).solution.trajectory
    expected = np.column_stack([-plain.p_world_m[:, 1], plain.p_world_m[:, 0], plain.p_world_m[:, 2]])
    assert np.abs(other.p_world_m - expected).max() < 0.02


@pytest.mark.parametrize("again", [False, True])
def test_imu_gap_is_bridged_and_said(again: bool) -> None:
    run = sparsely(simulate_slowly(replace(SHORT, noise="clean", duration_s=30.0), 6))
    imu = run.recording.imu
    assert imu is not None
    t = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    keep = ((t < 18.0) | (t > 20.0)) & ~(again & (t > 10.0) & (t < 11.0))
    solved = app.smooth_recording(replace(run.recording, imu=imu.where(keep)), run.config)
    (said,) = [w for w in solved.solution.stats.warnings if "IMU gap" in w]
    first = utc_text(int(imu.stamps_ns[t <= (10.0 if again else 17.999)][-1]))
    which = f"2 IMU gaps of up to 2.0 s, the first at {first}" if again else f"IMU gap of 2.0 s at {first}"
    assert said == f"{which}: bridged with unknown motion"
    assert compare_to_truth(solved.solution.trajectory, run.truth).position_rmse_m < 0.6


def test_no_imu_and_no_position_are_one_clear_line() -> None:
    run = simulate_slowly(replace(SHORT, duration_s=10.0), 0)
    with pytest.raises(SolveError, match="no IMU data"):
        app.smooth_recording(replace(run.recording, imu=None), run.config)
    with pytest.raises(SolveError, match="no position"):
        app.smooth_recording(replace(run.recording, measurements=()), run.config)
    with pytest.raises(InputError, match="no GNSS sensor to take a datum from"):
        app.choose_datum(Recording(source="x", imu=None, measurements=()), VesselConfig())


def test_held_out_fixes_are_counted_and_predicted() -> None:
    run = simulate_slowly(replace(SHORT, noise="clean", duration_s=30.0), 8)
    solved = app.smooth_recording(run.recording, run.config, hold_out=HoldOut.parse("every:3"))
    counts = solved.solution.ledger.counts()["gnss"]
    assert counts["held_out"] == len(solved.held) == 150 // 3
    assert len(solved.solution.ledger) == run.recording.message_count
    table = app.tables(solved)[1].as_dict()["graphloc"]
    assert table["horizontal_rmse_m"] is not None
    assert table["horizontal_rmse_m"] < 0.5


@pytest.mark.usefixtures("map_alone")
def test_run_folder(short: app.Run, tmp_path: Path) -> None:
    report = app.write(short, tmp_path / "run", inputs=[], command="test", overwrite=False)
    folder = report.parent
    assert sorted(p.name for p in folder.iterdir()) == [
        "calibration.json", "ledger.csv", "report.html", "run.json", "slow.csv", "solution.csv", "solution.tum", "solution_bag",
        "track.geojson", "vessel.effective.yaml",
    ]  # fmt: skip
    with (folder / "ledger.csv").open() as stream:
        assert sum(int(row["count"]) for row in csv.DictReader(stream)) == short.recording.message_count
    with (folder / "solution.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    track = short.solution.trajectory
    k = list(track.stamps_ns).index(int(rows[80]["stamp_ns"]))
    forward = track.R_world_body[k] @ np.array([1.0, 0.0, 0.0])
    # From true north there, clockwise; the datum's lies elsewhere.
    apart = track.p_world_m[k, 0] / 6393446.0 * np.tan(np.radians(float(rows[80]["latitude_deg"])))
    heading = np.degrees(np.arctan2(forward[0], forward[1]) + apart) % 360.0
    assert float(rows[80]["heading_deg"]) == pytest.approx(heading, abs=1e-4)
    tum = np.loadtxt(folder / "solution.tum")
    assert np.allclose(tum[80, 1:4], track.p_world_m[k], atol=1e-8)
    line = json.loads((folder / "track.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    assert line[0][0] == pytest.approx(11.7, abs=0.01)  # longitude first
    html = (folder / "report.html").read_text()
    assert 'src="http' not in html
    assert "BL EKF" in html
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
