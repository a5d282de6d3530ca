# SPDX-License-Identifier: Apache-2.0
"""A receiver whose RTK comes and goes: centimetres while it is there, honest bounds while it is not, and nothing missing."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc import app
from graphloc.config import GnssConfig, SlowErrorConfig, VesselConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.frames import Array, Geodetic
from graphloc.measurements import GnssPosition, Measurement
from graphloc.recording import Recording
from graphloc.solution import Cause, Health, Solution
from graphloc.trajectory import bounds_95
from tests.slowly import with_few_states

RTK_S, OTHER_S, SIGMA_M = 14.0, 16.0, {True: 0.02, False: 1.0}
TRACK = Scenario(path="loops", duration_s=105.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0, pose_hz=0.0)


def fixed(stamps_ns: NDArray[np.int64], first_ns: int) -> Array:
    """(N,) whether there is RTK: it comes and goes, and is there in the end."""
    return np.asarray(((stamps_ns - first_ns) * 1e-9) % (RTK_S + OTHER_S) < RTK_S)


@pytest.fixture(scope="module")
def runs() -> tuple[SimulatedRun, SimulatedRun]:
    """Its fixes as one sensor, with the slow error of the worse ones, and as two; those are off by metres, anew each time."""
    run = simulate(TRACK, 3)
    rng, truth = np.random.default_rng(5), run.truth
    first_ns = int(truth.stamps_ns[0])
    datum, slow_m = app.choose_datum(run.recording, run.config), rng.normal(0.0, 2.0, (4, 2))

    def moved(m: Measurement, *, two: bool) -> Measurement:
        if not isinstance(m, GnssPosition):
            return m
        rtk = bool(fixed(np.array([m.stamp_ns]), first_ns)[0])
        here = [float(np.interp(m.stamp_ns, truth.stamps_ns, axis)) for axis in truth.p_world_m.T]
        noise = np.random.default_rng(m.seq).normal(0.0, 0.01 if rtk else 0.5, 3)
        turn = int((m.stamp_ns - first_ns) * 1e-9 // (RTK_S + OTHER_S))
        off_m = np.zeros(2) if rtk else slow_m[turn]
        lla = datum.geodetic_from_enu(np.array([here]) + noise + np.append(off_m, 0.0))[0]
        name = "gnss_other" if two and not rtk else "gnss"
        return replace(m, sensor=name, position=Geodetic(*lla), cov_enu_m2=SIGMA_M[rtk] ** 2 * np.eye(3))

    metres = SlowErrorConfig(horizontal_sigma_m=2.0, vertical_sigma_m=4.0, time_constant_s=60.0)
    centimetres = SlowErrorConfig(horizontal_sigma_m=0.03, vertical_sigma_m=0.06)
    gnss = run.config.sensors["gnss"]
    gnss = gnss.model_copy(update={"mount": gnss.mount.model_copy(update={"xyz_m": (0.0, 0.0, 0.0)})})

    def made(two: bool, **sensors: GnssConfig) -> SimulatedRun:
        config = with_few_states(run.config.model_copy(update={"sensors": {**run.config.sensors, **sensors}}))
        return replace(run, recording=run.recording.changed(partial(moved, two=two)), config=config)

    one = made(False, gnss=gnss.model_copy(update={"slow_error": metres}))
    two = made(
        True,
        gnss=gnss.model_copy(update={"slow_error": centimetres, "fixes": "rtk"}),
        gnss_other=gnss.model_copy(update={"slow_error": metres, "fixes": "other"}),
    )
    return one, two


def solved(run: SimulatedRun, solve: Callable[[Recording, VesselConfig], app.Run]) -> tuple[Solution, Array, Array]:
    """The solution, the horizontal errors (N,), m, and whether there is RTK (N,), from the fifth second on."""
    solution = solve(run.recording, run.config).solution
    track, truth = solution.trajectory, run.truth
    true = np.column_stack([np.interp(track.stamps_ns, truth.stamps_ns, axis) for axis in truth.p_world_m.T])
    return (
        solution,
        np.hypot(*(track.p_world_m - true)[:, :2].T),
        fixed(track.stamps_ns, int(truth.stamps_ns[0])),
    )


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_two_sensors_know_it_to_centimetres_where_there_is_rtk(
    runs: tuple[SimulatedRun, SimulatedRun], solve: Callable[[Recording, VesselConfig], app.Run]
) -> None:
    (one, _, rtk), (two, off_m, _) = (solved(run, solve) for run in runs)
    bounds_m = [bounds_95(np.asarray(solution.trajectory.cov))[:, 0] for solution in (one, two)]
    assert np.median(bounds_m[0][rtk]) > 2.5  # what the error of all fixes costs
    assert np.median(bounds_m[1][rtk]) < 0.2
    assert np.percentile(off_m[rtk], 90) < 0.05
    assert np.mean(off_m < bounds_m[1]) > 0.95
    assert Cause.SENSORS not in {reason.cause for reason in two.health_reason}
    assert np.mean([health is Health.GOOD for health in two.health]) > 0.9
