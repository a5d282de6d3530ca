# SPDX-License-Identifier: Apache-2.0
"""A truth from elsewhere: of an antenna or a prism, without a heading, of a part of the run, or by a logger that ran for longer."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.app._run import made_comparable
from graphloc.drills import _without_a_truth_of_a_part
from graphloc.eval.ekf import run_honest
from graphloc.eval.metrics import TrackErrors, compare_to_truth
from graphloc.eval.report import Trust, verdict
from graphloc.eval.report._one_cause import one_cause
from graphloc.eval.simulate import Scenario
from graphloc.frames import Array
from graphloc.frontends._references import Reference, true_trajectory
from graphloc.frontends.tum import read_tum
from graphloc.trajectory import Trajectory
from tests.slowly import beside_filters, simulate_slowly

START_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def run() -> app.Run:
    return beside_filters(simulate_slowly(Scenario(duration_s=20.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 417))


def truth_of(run: app.Run) -> Trajectory:
    assert run.recording.truth is not None
    return run.recording.truth


def with_truth(run: app.Run, truth: Trajectory) -> app.Run:
    return made_comparable(replace(run, recording=replace(run.recording, truth=truth, warnings=())))


def longer(truth: Trajectory, by_s: float) -> Trajectory:
    """A truth, and the vessel at rest at either end of it, a pose each 0.1 s."""
    step, n = 100_000_000, round(by_s * 10.0)
    before, after = truth.stamps_ns[0] - step * np.arange(n, 0, -1), truth.stamps_ns[-1] + step * np.arange(1, n + 1)
    ends = np.r_[np.zeros(n, int), np.arange(len(truth)), np.full(n, len(truth) - 1)]
    stamps = np.r_[before, truth.stamps_ns, after]
    v = np.zeros((len(stamps), 3))
    return Trajectory(
        stamps_ns=stamps, p_world_m=truth.p_world_m[ends], R_world_body=truth.R_world_body[ends], v_world_mps=v
    )


def test_a_logger_that_ran_for_longer_than_the_run_does_not_count_against_the_track(run: app.Run) -> None:
    """'It covers only 58 % of what it is compared with; the filters may cover more': use with care, of a track without a gap."""
    alone, beside = (with_truth(run, t) for t in (truth_of(run), longer(truth_of(run), 300.0)))
    assert app.tables(beside)[0].as_dict()["graphloc"]["matched"] == pytest.approx(1.0, abs=0.02)
    assert app.tables(beside)[0].rows[0][1] == pytest.approx(app.tables(alone)[0].rows[0][1])
    assert "covers only" not in str(verdict(app.report_data(beside)))


def test_of_what_part_the_truth_is_is_said(run: app.Run) -> None:
    truth = truth_of(run)
    part = truth.where(truth.stamps_ns < truth.stamps_ns[0] + 8_000_000_000)
    assert " over 8 s of the run's 20 s;" in app.truth_statement(with_truth(run, part))
    assert " over 20 s;" in app.truth_statement(run)
    assert app.tables(with_truth(run, part))[0].note.endswith("not aligned; the truth covers 8 s of the run's 20 s")
    assert app.tables(run)[0].note.endswith("not aligned")
    gap = truth.where(abs(truth.stamps_ns - truth.stamps_ns[0] - 10_000_000_000) > 4_000_000_000)
    assert " over 12 s of the run's 20 s;" in app.truth_statement(with_truth(run, gap))
    slow = truth.where(slice(None, None, 250))  # each 5 s
    assert " over 15 s of" in app.truth_statement(with_truth(run, slow))


def positions_of(truth: Trajectory) -> Trajectory:
    return replace(truth, R_world_body=np.tile(np.eye(3), (len(truth), 1, 1)), headed=False)


def test_of_a_truth_without_a_heading_only_positions_are_compared(run: app.Run) -> None:
    """Its quaternions are 0 0 0 1: the heading seemed 49 degrees off, and the EKFs were started on a heading of due east."""
    beside = with_truth(run, positions_of(truth_of(run)))
    row, whole = (app.tables(r)[0].as_dict()["graphloc"] for r in (beside, with_truth(run, truth_of(run))))
    assert {key for key in row if row[key] is None} == {"heading_rmse_deg", "heading_max_deg", "heading_coverage_95"}
    assert {k: v for k, v in row.items() if v is not None} == {k: whole[k] for k in row if row[k] is not None}
    assert "heading bounds" not in str(verdict(app.report_data(beside)))
    said = app.truth_statement(beside)
    assert "positions without a heading" in said
    assert "started" not in said
    recording = replace(run.recording, truth=positions_of(truth_of(run)))
    filtered = run_honest(recording, run.config, run.solution.datum).trajectory
    off_deg = np.degrees(filtered.yaw_rad[0] - truth_of(run).yaw_rad[0])
    assert abs((off_deg + 180.0) % 360.0 - 180.0) < 10.0  # by the compass
    app.report_data(beside)


def test_quaternions_that_never_turn_or_are_none_are_no_heading(tmp_path: Path) -> None:
    def topic(*quaternions: tuple[float, float, float, float]) -> Trajectory | None:
        poses = [
            SimpleNamespace(
                pose=SimpleNamespace(
                    position=SimpleNamespace(x=float(k), y=0.0, z=0.0),
                    orientation=SimpleNamespace(**dict(zip("xyzw", q, strict=True))),
                )
            )
            for k, q in enumerate(quaternions)
        ]
        stamps = [START_NS + k * 10**9 for k in range(len(poses))]
        item = Reference("/prism", "", count=len(poses), stamps_ns=stamps, logs_ns=stamps, messages=poses)
        return true_trajectory(item, 0.0, [])

    for q in ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0)):
        found = topic(q, q, q)
        assert found is not None
        assert not found.headed
        assert len(found) == 3
    found = topic((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.6, 0.8))
    assert found is not None
    assert found.headed
    for words, headed in (("0 0 0 1", False), ("0 0 0.6 0.8", True)):
        (tmp_path / "t.tum").write_text(f"1700000000 0 0 0 {words}\n1700000001 1 0 0 {words}\n")
        assert read_tum(tmp_path / "t.tum").headed is headed


def track_of(turning: bool) -> Trajectory:
    t = np.arange(0.0, 60.0, 0.1)
    yaw = 0.3 + (0.1 * t if turning else 0.0 * t)
    v = 2.0 * (1.0 + 0.5 * np.sin(t / 4.0)) if turning else np.full(len(t), 2.0)
    velocity = np.column_stack([v * np.cos(yaw), v * np.sin(yaw), np.zeros(len(t))])
    return Trajectory(
        stamps_ns=START_NS + np.rint(t * 1e9).astype(np.int64),
        p_world_m=np.cumsum(velocity * 0.1, axis=0),
        R_world_body=Rotation.from_euler("z", yaw[:, None]).as_matrix(),
        v_world_mps=velocity,
    )


def found_for(track: Trajectory, off_m: Array) -> TrackErrors:
    return TrackErrors(
        stamps_ns=track.stamps_ns, position_m=np.column_stack([off_m, np.zeros(len(track))]), covered=1.0,
        heading_rad=np.zeros(len(track)), estimate=track,
    )  # fmt: skip


def test_an_error_with_one_cause_is_named_by_it() -> None:
    """A prism 4 m ahead and 1 m to starboard; a clock 0.3 s late, at truth_time_offset_s 5; 2 m east of the datum. By hand."""
    track = track_of(turning=True)
    assert track.v_world_mps is not None
    prism = -track.R_world_body[:, :2, :2] @ np.array([4.0, -1.0])
    said = one_cause(found_for(track, prism), 0.0)
    assert said.startswith(
        ". All but 0.00 m (RMS) of its error turns with the vessel: the truth is 4.00 m ahead and 1.00 m to starboard "
    )
    said = one_cause(found_for(track, 0.3 * track.v_world_mps[:, :2]), 5.0)
    assert said.startswith(
        ". All but 0.00 m (RMS) of its error goes with the velocity: the truth is stamped 0.30 s late (then set truth_"
    )
    assert "truth_time_offset_s: 4.70)" in said
    said = one_cause(found_for(track, np.tile([2.0, 0.0], (len(track), 1))), 0.0)
    assert said.startswith(". All but 0.00 m (RMS) of its error stays the same, 2.00 m east ")
    assert "; or all but" not in said
    assert one_cause(found_for(track, np.random.default_rng(0).normal(size=(len(track), 2))), 0.0) == ""


def test_on_a_straight_course_every_cause_is_named() -> None:
    track = track_of(turning=False)
    assert track.v_world_mps is not None
    said = one_cause(found_for(track, 0.3 * track.v_world_mps[:, :2]), 0.0)
    assert len(re.findall(r"[Aa]ll but 0\.00 m \(RMS\) of its error (?:stays|turns|goes)", said)) == 3


def test_a_truth_elsewhere_on_the_vessel_is_said_in_the_verdict(run: app.Run) -> None:
    truth = truth_of(run)
    ahead = replace(truth, p_world_m=truth.p_world_m + truth.R_world_body @ np.array([6.0, 0.0, 0.0]))
    beside = with_truth(run, ahead)
    assert compare_to_truth(run.solution.trajectory, ahead).position_rmse_m == pytest.approx(6.0, abs=0.5)
    why = " ".join(reason.text for reason in verdict(app.report_data(beside)).tracks[0].reasons)
    assert re.search(r"turns with the vessel: the truth is [56]\.\d\d m ahead", why)


def test_headings_that_differ_by_a_constant_are_not_called_chance(run: app.Run) -> None:
    """A frame that counts from where the vessel began: 32 degrees throughout, in bounds of 0.2, was 'too small, or chance'."""
    truth = truth_of(run)
    turned = replace(truth, R_world_body=Rotation.from_euler("z", 0.5).as_matrix() @ truth.R_world_body)
    why = " ".join(r.text for r in verdict(app.report_data(with_truth(run, turned))).tracks[0].reasons)
    assert re.search(r"held the truth for 0 % of the time; off by 2[89]\.\d+ deg .* stays the same, to starboard", why)
    assert "chance" not in why


def test_a_track_that_nothing_measured_is_not_vouched_for(run: app.Run) -> None:
    """A truth of the first seconds only, before the online track begins: it was 'can be trusted. Its accuracy was not measured.'"""
    truth = truth_of(run)
    early = truth.where(truth.stamps_ns < truth.stamps_ns[0] + 3_000_000_000)
    late = replace(run.solution, stats=replace(run.solution.stats, online=True, warnings=()))
    data = replace(app.report_data(with_truth(run, early)), online=late)
    online = verdict(replace(data, solution=run.solution)).tracks[1]
    assert online.accuracy == "Its accuracy was not measured."
    assert any(
        r.trust is Trust.WITH_CARE and r.text.startswith("Its accuracy was not measured: it shares no time")
        for r in online.reasons
    )


def test_a_truth_of_a_part_judges_no_drill(run: app.Run) -> None:
    """Of drills beyond it every estimator was 'none' or 'never back'."""
    truth = truth_of(run)
    part = truth.where(truth.stamps_ns < truth.stamps_ns[0] + 12_000_000_000)
    left = _without_a_truth_of_a_part(with_truth(run, part)).recording
    assert left.truth is None
    assert re.search(r"the truth covers (59|60|61) % of the run", left.warnings[-1])
    assert _without_a_truth_of_a_part(run) is run
