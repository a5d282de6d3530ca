# SPDX-License-Identifier: Apache-2.0
"""A receiver's velocity whose error lasts for seconds carries a vessel off while there are no fixes, and its bounds say by how much."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from graphloc import app
from graphloc.config import GnssConfig, VelocityConfig
from graphloc.eval.simulate import Scenario, simulate
from graphloc.measurements import GnssPosition, GnssVelocity
from graphloc.time import NS_PER_S
from tests.slowly import with_few_states
from tests.test_odd_vessels import antenna_velocity

SIGMA_MPS, TAU_S, OUT_S = 0.03, 20.0, 30.0


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_the_bound_of_an_outage_grows_as_the_velocity_wanders(solve: Callable[..., app.Run]) -> None:
    """A velocity 3 cm/s off throughout, after fixes that have told its error: by t it is taken to have faded by exp(-t / tau)."""
    scenario = Scenario(
        path="turn", duration_s=20.0 + OUT_S, noise="clean", pose_hz=0.0, compass_hz=5.0, gnss_hz=2.0, gnss_sigma_m=0.02, imu_hz=50.0
    )  # fmt: skip
    run = simulate(scenario, 21)
    truth, gnss = run.truth, run.config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    out_ns = int(truth.stamps_ns[0]) + 20 * NS_PER_S
    v = antenna_velocity(truth) + np.array([SIGMA_MPS, 0.0, 0.0])
    every = range(10, len(truth) - 2, round(0.2e9 / (truth.stamps_ns[1] - truth.stamps_ns[0])))
    told = [
        GnssVelocity(stamp_ns=int(truth.stamps_ns[k]), sensor="velocity", seq=10**6 + k, v_enu_mps=v[k], cov_m2ps2=0.03**2 * np.eye(3))
        for k in every
    ]  # fmt: skip
    kept = [m for m in run.recording.measurements if not isinstance(m, GnssPosition) or m.stamp_ns < out_ns]
    recording = replace(run.recording, measurements=tuple(sorted((*kept, *told), key=lambda m: (m.stamp_ns, m.seq))))
    rtk = gnss.slow_error.model_copy(update={"horizontal_sigma_m": 0.03, "vertical_sigma_m": 0.06})
    velocity = VelocityConfig(mount=gnss.mount, wander_sigma_mps=SIGMA_MPS, wander_time_constant_s=TAU_S)
    config = run.config.with_sensors({"gnss": gnss.model_copy(update={"slow_error": rtk}), "velocity": velocity})
    track = solve(recording, with_few_states(config, 5.0)).solution.trajectory
    assert track.cov is not None
    end = int(np.searchsorted(track.stamps_ns, truth.stamps_ns[-1])) - 2
    t_s = (track.stamps_ns[end] - out_ns) / NS_PER_S
    kept_share = np.exp(-t_s / TAU_S)
    # Of an error that is known at first: the variance of its integral over t_s.
    grown_m = SIGMA_MPS * np.sqrt(2 * TAU_S * t_s - TAU_S**2 * (3.0 - 4.0 * kept_share + kept_share**2))
    off_m = track.p_world_m[end] - truth.at(track.stamps_ns[end : end + 1]).p_world_m[0]
    sigma_m = np.sqrt(np.diagonal(track.cov[end])[:2])
    assert abs(off_m[0]) > 0.2
    assert abs(off_m[0]) < 2.0 * sigma_m[0]
    np.testing.assert_allclose(sigma_m, grown_m, rtol=0.25)
