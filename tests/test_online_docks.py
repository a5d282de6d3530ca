# SPDX-License-Identifier: Apache-2.0
"""What is seen of a moving dock says where the vessel is beside the dock, and nothing of where both are."""

from dataclasses import replace

import numpy as np
import pytest

from graphloc import app
from graphloc.eval.simulate import SimulatedRun, find_scenario, simulate
from graphloc.frames import Array
from graphloc.replay import replay
from graphloc.trajectory import Trajectory
from tests import tagfactory


def docking() -> SimulatedRun:
    """Without GNSS: place by the dock's tags (which moves by 0.3 m), height by that and the tide."""
    less = {"imu_hz": "50", "gnss_hz": "2", "compass_hz": "4", "lidar_hz": "0", "camera_hz": "0"}
    true = simulate(find_scenario("dock-floating-optimal", {**less, "duration_s": "45", "route_s": "45"}), 1)
    run, _ = tagfactory.sighted(true, rate_hz=4.0)
    kept = tuple(m for m in run.recording.measurements if m.sensor != "gnss")
    return replace(run, recording=replace(run.recording, measurements=kept))


def sigmas_m(track: Trajectory, k: int) -> Array:
    assert track.cov is not None
    return np.asarray(np.sqrt(np.diagonal(track.cov[k])[:3]))


def test_the_last_pose_is_known_as_well_as_to_the_batch_and_no_better() -> None:
    """At the end both know the same."""
    run = docking()
    datum = app.choose_datum(run.recording, run.config)
    recording = app.with_synthetic(run.recording, run.config, datum)
    offline = app.solve(recording, run.config, datum).trajectory
    online = replay(recording, run.config, datum=datum).solution.trajectory
    k = int(np.searchsorted(offline.stamps_ns, online.stamps_ns[-1]))
    assert sigmas_m(online, -1) == pytest.approx(sigmas_m(offline, k), rel=0.05)
    assert (np.abs(online.p_world_m[-1] - offline.p_world_m[k]) < 0.5 * sigmas_m(offline, k)).all()
    assert sigmas_m(online, -1)[2] > 0.3  # a tide and a dock of 0.5 m each
