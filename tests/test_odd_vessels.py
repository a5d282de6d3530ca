# SPDX-License-Identifier: Apache-2.0
"""Whole runs from bags of vessels that are unlike the example: odd axes, other sensors, draft to track.

Messages are made here from the simulator's truth, not by the product's own bag writer.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.frames import Array, rpy_from_rotation
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.measurements import GnssPosition
from graphloc.signals.thinning import THINNED
from graphloc.trajectory import Trajectory
from tests.bagfactory import Item, Messages, write_bag
from tests.slowly import with_few_states

ANTENNA_M = np.array([-1.5, 0.3, 2.2789])  # where the simulator has it
FORWARD_RIGHT_DOWN = Rotation.from_euler("x", 180.0, degrees=True)


def antenna_velocity(truth: Trajectory) -> Array:
    """Velocity (N, 3) of the antenna, by differences of its places."""
    places = truth.p_world_m + np.einsum("nij,j->ni", truth.R_world_body, ANTENNA_M)
    return np.asarray(np.gradient(places, (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9, axis=0))


def messages(run: SimulatedRun, make: Messages, *, compass: bool, velocity: bool) -> list[Item]:
    """An IMU with axes forward, right, down; a 1 Hz receiver; heading from north as the IMU's orientation."""
    rng = np.random.default_rng(11)
    imu, truth = run.recording.imu, run.truth
    assert imu is not None
    R_body_imu = Rotation.from_euler("xyz", (2.0, -1.0, 90.0), degrees=True)  # the simulator's
    into_frd = (FORWARD_RIGHT_DOWN.inv() * R_body_imu).as_matrix()
    yaw_ned = np.pi / 2.0 - truth.yaw_rad
    items: list[Item] = []
    for k, stamp in enumerate(imu.stamps_ns.tolist()):
        extra: dict[str, Any] = {}
        if compass:
            half = 0.5 * (yaw_ned[k] + rng.normal(0.0, np.radians(1.0)))
            extra = {
                "orientation": (np.nan, np.nan, np.sin(half), np.cos(half)),
                "orientation_covariance": np.diag([1e6, 1e6, np.radians(1.0) ** 2]).ravel(),
            }
        message = make.imu(stamp, into_frd @ imu.accel_mps2[k], into_frd @ imu.gyro_radps[k], frame="imu", **extra)
        items.append(("/imu", stamp + 2_000_000, message))
    for m in run.recording.measurements:
        if isinstance(m, GnssPosition):
            cov = np.array(m.cov_enu_m2).ravel()
            fix = make.fix(m.stamp_ns, *m.position, covariance=cov, frame="antenna")
            items.append(("/fix", m.stamp_ns + 50_000_000, fix))
    if velocity:
        v = antenna_velocity(truth)
        for k in range(0, len(v), 20):
            stamp, noisy = int(truth.stamps_ns[k]), v[k] + rng.normal(0.0, 0.05, 3)
            twist = make.twist(stamp, noisy, np.diag([0.05**2] * 3 + [0.0] * 3), frame="antenna")
            items.append(("/velocity", stamp + 50_000_000, twist))
    edges: list[tuple[str, str, Any, Any]] = [
        ("base_link", "mast", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)),
        ("mast", "antenna", ANTENNA_M - (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)),
        ("base_link", "imu", (0.5, -0.2, 1.0), FORWARD_RIGHT_DOWN.as_quat()),
    ]
    items.append(("/tf_static", items[0][1], make.transforms(edges)))
    return sorted(items, key=lambda item: item[1])


def world_of(solved: app.Run, run: SimulatedRun) -> Trajectory:
    """The truth in the world of the solution, whose datum is the first fixes'."""
    here, there = app.choose_datum(run.recording, run.config), solved.solution.datum
    latitude, longitude, height = np.transpose(here.geodetic_from_enu(run.truth.p_world_m))
    return Trajectory(
        stamps_ns=run.truth.stamps_ns,
        p_world_m=there.enu_from_geodetic(latitude, longitude, height),
        R_world_body=run.truth.R_world_body,
        v_world_mps=run.truth.v_world_mps,
    )


@pytest.mark.parametrize(("kind", "heading_deg"), [("compass", 1.0), ("gnss_velocity", 4.0)])
def test_from_a_draft_to_a_track(kind: str, heading_deg: float, tmp_path: Path) -> None:
    """`inspect` finds the sensors, and their mounts in /tf_static; nothing edited, the track is right.

    Without a compass the heading comes from one turn of the vessel, seen by velocity and acceleration.
    """
    scenario = Scenario(
        path="turn", duration_s=60.0, imu_hz=50.0, gnss_hz=1.0, compass_hz=0.0, pose_hz=0.0, noise="clean"
    )
    run = simulate(scenario, 21)
    make = Messages(2)
    bag = write_bag(
        tmp_path / "bag",
        make,
        messages(run, make, compass=kind == "compass", velocity=kind == "gnss_velocity"),
        kind="mcap",
    )
    draft = tmp_path / "vessel.yaml"
    draft.write_text(draft_config(inspect_bag(bag)))
    recording, config = app.load([bag], draft)
    config = with_few_states(config, 1.25)
    assert {s.kind for s in config.sensors.values() if s.enabled} == {"imu", "gnss", kind}
    solved = app.smooth_recording(recording, config)
    ours = compare_to_truth(solved.solution.trajectory, world_of(solved, run))
    counts = solved.solution.ledger.counts()[kind]
    thinned = sum(row.reason == THINNED for row in recording.rows)  # of an orientation at 50 Hz
    assert counts["used"] > 0.9 * (sum(counts.values()) - thinned)
    assert solved.solution.stats.converged
    assert ours.position_rmse_m < 0.3
    assert ours.heading_rmse_deg < heading_deg
    roll = np.array([rpy_from_rotation(R) for R in solved.solution.trajectory.R_world_body])[:, 0]
    assert np.degrees(np.abs(roll)).max() < 15.0  # the IMU is upside down, the vessel is not
