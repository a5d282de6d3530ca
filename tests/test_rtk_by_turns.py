# SPDX-License-Identifier: Apache-2.0
"""A receiver whose RTK comes and goes: centimetres while it is there, honest bounds while it is not, and nothing missing."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

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


METRES = SlowErrorConfig(horizontal_sigma_m=2.0, vertical_sigma_m=4.0, time_constant_s=60.0)
CENTIMETRES = SlowErrorConfig(horizontal_sigma_m=0.03, vertical_sigma_m=0.06)


def receiver(
    rtk: Callable[[float], bool], off_m: Callable[[float], tuple[float, float]]
) -> tuple[SimulatedRun, SimulatedRun]:
    """A run whose receiver has RTK at some times, s, and is so far off east and north: as one sensor, with the slow error of fixes without, and as two."""
    run = simulate(TRACK, 3)
    truth, datum = run.truth, app.choose_datum(run.recording, run.config)

    def moved(m: Measurement, *, two: bool) -> Measurement:
        if not isinstance(m, GnssPosition):
            return m
        t = (m.stamp_ns - int(truth.stamps_ns[0])) * 1e-9
        here = [float(np.interp(m.stamp_ns, truth.stamps_ns, axis)) for axis in truth.p_world_m.T]
        noise = np.random.default_rng(m.seq).normal(0.0, 0.01 if rtk(t) else 0.5, 3)
        lla = datum.geodetic_from_enu(np.array([here]) + noise + [*off_m(t), 0.0])[0]
        name = "gnss_other" if two and not rtk(t) else "gnss"
        return replace(m, sensor=name, position=Geodetic(*lla), cov_enu_m2=SIGMA_M[rtk(t)] ** 2 * np.eye(3))

    gnss = run.config.sensors["gnss"]
    gnss = gnss.model_copy(update={"mount": gnss.mount.model_copy(update={"xyz_m": (0.0, 0.0, 0.0)})})

    def made(two: bool, **sensors: GnssConfig) -> SimulatedRun:
        config = with_few_states(run.config.model_copy(update={"sensors": {**run.config.sensors, **sensors}}))
        return replace(run, recording=run.recording.changed(partial(moved, two=two)), config=config)

    one = made(False, gnss=gnss.model_copy(update={"slow_error": METRES}))
    two = made(
        True,
        gnss=gnss.model_copy(update={"slow_error": CENTIMETRES, "fixes": "rtk"}),
        gnss_other=gnss.model_copy(update={"slow_error": METRES, "fixes": "other"}),
    )
    return one, two


def solved(run: SimulatedRun, solve: Callable[[Recording, VesselConfig], app.Run]) -> tuple[Solution, Array, Array]:
    """The solution, the horizontal errors (N,), m, and the times (N,), s, of its states."""
    solution = solve(run.recording, run.config).solution
    track, truth = solution.trajectory, run.truth
    true = np.column_stack([np.interp(track.stamps_ns, truth.stamps_ns, axis) for axis in truth.p_world_m.T])
    off_m = np.hypot(*(track.p_world_m - true)[:, :2].T)
    return solution, off_m, np.asarray((track.stamps_ns - int(truth.stamps_ns[0])) * 1e-9, dtype=float)


def comes_and_goes(t: float) -> bool:
    """RTK, in the end as well."""
    return t % (RTK_S + OTHER_S) < RTK_S


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_two_sensors_know_it_to_centimetres_where_there_is_rtk(
    solve: Callable[[Recording, VesselConfig], app.Run],
) -> None:
    """The other fixes are off by metres, anew each time."""
    slow_m = np.random.default_rng(5).normal(0.0, 2.0, (4, 2)).tolist()
    runs = receiver(comes_and_goes, lambda t: (0.0, 0.0) if comes_and_goes(t) else slow_m[int(t // (RTK_S + OTHER_S))])
    (one, _, t), (two, off_m, _) = (solved(run, solve) for run in runs)
    rtk = np.array([comes_and_goes(at) for at in t])
    bounds_m = [bounds_95(np.asarray(solution.trajectory.cov))[:, 0] for solution in (one, two)]
    assert np.median(bounds_m[0][rtk]) > 2.5  # what the error of all fixes costs
    assert np.median(bounds_m[1][rtk]) < 0.2
    assert np.percentile(off_m[rtk], 90) < 0.05
    assert np.mean(off_m < bounds_m[1]) > 0.95
    assert Cause.SENSORS not in {reason.cause for reason in two.health_reason}
    assert np.mean([health is Health.GOOD for health in two.health]) > 0.9


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_a_wrong_rtk_fix_is_not_followed(solve: Callable[[Recording, VesselConfig], app.Run]) -> None:
    """4 m off for 20 s: the fixes without RTK, which come at other times, were company that hides no jump but also shows none."""
    _, two = receiver(lambda t: t < 70.0, lambda t: (4.0, 0.0) if 30.0 < t < 50.0 else (0.0, 0.0))
    solution, off_m, t = solved(two, solve)
    jumped = (t > 32.0) & (t < 70.0)  # online it is found a second later
    assert np.sqrt(np.mean(off_m[jumped] ** 2)) < 1.0
    assert np.mean(off_m < bounds_95(np.asarray(solution.trajectory.cov))[:, 0]) > 0.9
    assert any("gnss: position jump" in line for line in (*solution.stats.warnings, *solution.stats.events))
