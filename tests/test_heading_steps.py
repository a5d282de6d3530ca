# SPDX-License-Identifier: Apache-2.0
"""A compass that reads 20 deg more from mid-run on, as by iron that is moved on board, does not take the heading along."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from graphloc import app
from graphloc.config import GnssConfig
from graphloc.eval.simulate import Scenario, simulate
from graphloc.frames import wrap_angle
from graphloc.measurements import CompassHeading
from graphloc.replay import replay

AT_S = 45.0


@pytest.mark.parametrize("online", [False, True])
def test_heading_stays(online: bool) -> None:
    rates: dict[str, Any] = {"imu_hz": 50.0, "gnss_hz": 5.0, "compass_hz": 5.0, "pose_hz": 0.0, "gnss_sigma_m": 0.02}
    run = simulate(Scenario(path="loops", duration_s=90.0, noise="clean", **rates), seed=523)
    begin_ns = int(run.truth.stamps_ns[0])

    def turned(m: Any) -> Any:
        late = isinstance(m, CompassHeading) and m.stamp_ns - begin_ns > AT_S * 1e9
        return replace(m, yaw_rad=float(m.yaw_rad + np.radians(20.0))) if late else m

    recording = replace(run.recording, measurements=tuple(map(turned, run.recording.measurements)))
    gnss = GnssConfig.model_validate(
        run.config.sensors["gnss"].model_dump() | {"slow_error": {"horizontal_sigma_m": 0.03, "vertical_sigma_m": 0.03}}
    )
    config = run.config.model_copy(update={"sensors": {**run.config.sensors, "gnss": gnss}})
    track = (replay(recording, config) if online else app.smooth_recording(recording, config)).solution.trajectory
    seen = run.truth.covers(track.stamps_ns) & (track.stamps_ns - begin_ns > 20e9)
    off = wrap_angle(track.yaw_rad[seen] - run.truth.at(track.stamps_ns[seen]).yaw_rad)
    assert np.degrees(np.sqrt(np.mean(off**2))) < 1.5
    assert track.cov is not None
    assert np.mean(np.abs(off) < 2.58 * np.sqrt(track.cov[seen, 5, 5])) > 0.95
