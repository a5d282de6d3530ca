# SPDX-License-Identifier: Apache-2.0
"""Tracks that no craft makes are said: sideways all the way, upside down; and none else."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.eval.mount_check import mount_doubts
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.solution import Health
from graphloc.trajectory import Trajectory
from tests.slowly import simulate_slowly

QUICK = Scenario(
    path="loops",
    duration_s=60.0,
    noise="clean",
    pose_hz=0.0,
    imu_hz=50.0,
    gnss_hz=2.0,
    compass_hz=2.0,
    gnss_sigma_m=0.1,
)


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate_slowly(QUICK, 77)


def turned(track: Trajectory, axis: str, degrees: float, heading_sigma_deg: float = 1.0) -> Trajectory:
    """The track of a body that is turned in the craft."""
    cov = np.tile(np.eye(6) * np.radians(heading_sigma_deg) ** 2, (len(track), 1, 1))
    R = track.R_world_body @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return replace(track, R_world_body=R, cov=cov)


@pytest.mark.parametrize("degrees", [-120.0, 70.0, 180.0])
def test_the_mount_that_would_fit_is_named(degrees: float, run: SimulatedRun) -> None:
    """The simulator's IMU is mounted at a yaw of 90 deg of a body that is turned by b in the craft: at 90 + b of that."""
    (line,) = map(str, mount_doubts(turned(run.truth, "z", degrees), run.recording, run.config))
    named = re.search(r"imu.mount.rpy_deg\[2\] should be about (-?\d+) instead of 90", line)
    assert named
    assert (float(named[1]) - (90.0 + degrees) + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=10.0)


@pytest.mark.parametrize(("degrees", "sigma_deg"), [(0.0, 1.0), (30.0, 1.0), (90.0, 15.0)])
def test_nothing_is_reported_of(degrees: float, sigma_deg: float, run: SimulatedRun) -> None:
    """A craft that goes ahead, one that leads by a current, and a heading that is not claimed to be known."""
    assert mount_doubts(turned(run.truth, "z", degrees, sigma_deg), run.recording, run.config) == []


@pytest.mark.parametrize(("axis", "degrees"), [("x", 180.0), ("y", 90.0)])
def test_a_craft_on_its_back_or_end_is_reported(axis: str, degrees: float, run: SimulatedRun) -> None:
    said = mount_doubts(turned(run.truth, axis, degrees), run.recording, run.config)
    named = re.search(r"tilted by (\d+) deg", said[0].seen)
    assert named
    assert float(named[1]) == pytest.approx(degrees, abs=3.0)


def test_a_heading_that_spins_blames_no_mount_by_number(run: SimulatedRun) -> None:
    spin = Rotation.from_euler("z", np.linspace(0.0, 40.0, len(run.truth))[:, None]).as_matrix()
    track = replace(turned(run.truth, "z", 0.0), R_world_body=run.truth.R_world_body @ spin)
    (line,) = map(str, mount_doubts(track, run.recording, run.config))
    assert "the heading is wrong" in line
    assert "instead of" not in line


def slowed(run: SimulatedRun, speed_mps: float) -> Trajectory:
    """The track on its back to front, at another speed."""
    v = np.asarray(run.truth.v_world_mps)
    return replace(
        turned(run.truth, "z", 180.0), v_world_mps=speed_mps * v / np.maximum(np.linalg.norm(v, axis=1), 1e-6)[:, None]
    )


def test_a_robot_that_seems_to_go_astern_is_reported(run: SimulatedRun) -> None:
    """At 0.8 m/s nothing was judged: the heading of one was 179 deg off, 'known' to 10 deg, and no word."""
    (line,) = map(str, mount_doubts(slowed(run, 0.8), run.recording, run.config))
    assert "made above 0.3 m/s" in line
    assert "instead of 90" in line


def test_a_slow_vessel_that_a_current_sets_is_not_reported(run: SimulatedRun) -> None:
    """The same way in the world wherever she heads; or she lies across it all the while."""
    track = slowed(run, 0.8)
    east = np.tile([0.8, 0.0, 0.0], (len(track), 1))
    across = np.tile(Rotation.from_euler("z", 90.0, degrees=True).as_matrix(), (len(track), 1, 1))
    for set_so in (replace(track, v_world_mps=east), replace(track, v_world_mps=east, R_world_body=across)):
        assert mount_doubts(set_so, run.recording, run.config) == []


def test_a_track_that_lies_still_says_nothing(run: SimulatedRun) -> None:
    still = replace(turned(run.truth, "z", 180.0), v_world_mps=0.1 * np.asarray(run.truth.v_world_mps))
    assert mount_doubts(still, run.recording, run.config) == []


@pytest.mark.parametrize(
    ("compass_sigma_deg", "said"), [(1.0, "sigmas off its mount"), (40.0, "the course is more than 45 deg off")]
)
def test_an_imu_turned_in_the_file_is_reported_in_the_report(
    compass_sigma_deg: float, said: str, run: SimulatedRun
) -> None:
    """No sensor speaks against it but the compass, whose offset is blamed; the course names the mount."""
    imu: Any = run.config.sensors["imu"]
    gnss: Any = run.config.sensors["gnss"]
    trusted = gnss.model_copy(update={"slow_error": gnss.slow_error.model_copy(update={"enabled": False})})
    compass: Any = run.config.sensors["compass"]
    loose = compass.model_copy(update={"mount_offset_sigma_deg": compass_sigma_deg})
    usual = run.config.model_copy(update={"sensors": {**run.config.sensors, "gnss": trusted, "compass": loose}})
    wrong = imu.model_copy(update={"mount": imu.mount.model_copy(update={"rpy_deg": (2.0, -1.0, 0.0)})})
    config = usual.model_copy(update={"sensors": {**usual.sensors, "imu": wrong}})
    found, right = (app.smooth_recording(run.recording, c) for c in (config, usual))
    assert any("unless the vessel goes sideways" in line for line in found.recording.warnings)
    assert Health.GOOD not in found.solution.health
    assert any(said in why.text for why in found.solution.health_reason)
    assert right.recording.warnings == run.recording.warnings
    assert Health.GOOD in right.solution.health
