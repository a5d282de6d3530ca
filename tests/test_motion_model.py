# SPDX-License-Identifier: Apache-2.0
"""What bounds a track that nothing but the IMU tells: the vessel moves as it usually does."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from unittest.mock import patch

import gtsam
import numpy as np
import pytest

from graphloc import app, keys
from graphloc.build import make_problem
from graphloc.build._usual_motion import UsualMotion, usual_motion
from graphloc.config import TimelineConfig, VesselConfig
from graphloc.eval.simulate import Scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array
from graphloc.measurements import CompassHeading
from graphloc.motion_model import MotionModel, Moving
from graphloc.recording import Recording
from graphloc.replay import replay
from graphloc.solve._passes import expected_cost
from graphloc.timeline import make_timeline
from graphloc.trajectory import Trajectory, bounds_95
from tests.slowly import with_few_states

SECOND = 1_000_000_000


@dataclass(frozen=True)
class Lost:
    """A recording whose end, from a stamp on (ns), has no place in it."""

    recording: Recording
    config: VesselConfig
    truth: Trajectory
    since_ns: int


def taught(v_body_mps: Array) -> MotionModel:
    """Taught with velocities (N, 2), one a second."""
    motion_model = MotionModel()
    for k, v in enumerate(v_body_mps):
        motion_model.learn(k * SECOND, v)
    return motion_model


def wandering(speed_mps: float, change_mps: float, n: int) -> Array:
    """Velocities (n, 2), one a second, of a vessel of that usual speed and change over 10 s along both axes."""
    rng, phi = np.random.default_rng(3), (1.0 - change_mps**2 / (2.0 * speed_mps**2)) ** 0.1
    v = [speed_mps * rng.standard_normal(2)]
    for _ in range(n - 1):
        v.append(phi * v[-1] + speed_mps * np.sqrt(1.0 - phi**2) * rng.standard_normal(2))
    return np.array(v)


def test_the_process_has_what_was_learned_beside_what_any_vessel_may_do() -> None:
    """Its standing variance is that of the speeds, and its change over 10 s that of the changes."""
    v = wandering(4.0, 2.0, 300)
    phi, variance = taught(v).process(np.zeros(2), 10.0)
    standing = variance / (1.0 - phi**2)
    assert standing == pytest.approx(1.0 + (v**2).mean(axis=0), rel=0.1)
    assert 2.0 * standing * (1.0 - phi) == pytest.approx(0.25 + ((v[10:] - v[:-10]) ** 2).mean(axis=0), rel=0.2)


def test_ten_steps_of_a_second_are_one_of_ten() -> None:
    motion_model = taught(wandering(4.0, 2.0, 60))
    (phi, w), (phi_10, w_10) = motion_model.process(np.ones(2), 1.0), motion_model.process(np.ones(2), 10.0)
    assert phi**10 == pytest.approx(phi_10)
    assert sum(w * phi ** (2 * k) for k in range(10)) == pytest.approx(w_10)


def test_a_vessel_is_not_slower_than_it_is_now() -> None:
    """A car that has just been resumed at 15 m/s, with nothing learned, is not braked by a sigma within a minute."""
    v = np.array([15.0, 0.0])
    phi, variance = MotionModel().process(v, 60.0)
    assert ((1.0 - phi) * v <= np.sqrt(variance)).all()


def after_a_second(imu_mps: Array, sigma_mps: float) -> Array:
    """Velocity (2,) in the body after a step, of a vessel at 2 m/s that turns by 0.3 rad, by the IMU and by the motion model together."""
    motion_model, v_a = taught(np.tile([2.0, 0.0], (100, 1))), np.array([2.0, 0.0, 0.0])
    R_a, R_b = np.eye(3), gtsam.Rot3.Yaw(0.3).matrix()
    v_b = R_b @ np.append(imu_mps, 0.0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, v, sigma in ((0, v_a, 1e-3), (1, v_b, sigma_mps)):
        values.insert(key, v)
        graph.add(gtsam.PriorFactorVector(key, v, gtsam.noiseModel.Isotropic.Sigma(3, sigma)))
    for factor in motion_model.step(Moving(0, v_a, R_a), Moving(1, v_b, R_b), 1.0):
        graph.add(factor)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.asarray((R_b.T @ solved.atVector(1))[:2])


def test_a_turn_is_no_change_and_a_creeping_error_is_held_back() -> None:
    assert after_a_second(np.array([2.0, 0.0]), 0.3) == pytest.approx([2.0, 0.0], abs=0.01)
    held = after_a_second(np.array([2.0, 0.3]), 0.3)
    assert 0.05 < held[1] < 0.25


def test_a_vessel_that_stops_is_believed_and_does_not_begin_to_slide() -> None:
    """An IMU that knows a second to 0.1 m/s is believed when that is far from usual; along the other axis nothing changes."""
    stopped = after_a_second(np.array([0.0, 0.0]), 0.1)
    assert stopped[0] == pytest.approx(0.0, abs=0.05)
    assert stopped[1] == pytest.approx(0.0, abs=1e-6)
    assert after_a_second(np.array([0.0, 0.3]), 0.3)[1] == pytest.approx(
        after_a_second(np.array([2.0, 0.3]), 0.3)[1], abs=1e-3
    )


@pytest.fixture(scope="module")
def lost() -> Lost:
    """The last 90 s have compass and IMU alone. For six of them the IMU is silent, too: along which axes it moved there nobody knows."""
    run = simulate(
        replace(Scenario(path="loops", noise="drift"), duration_s=115.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=1.0), 3
    )
    lost_ns = int(run.truth.stamps_ns[0]) + 25 * SECOND
    kept = tuple(m for m in run.recording.measurements if isinstance(m, CompassHeading) or m.stamp_ns < lost_ns)
    imu = run.recording.imu
    assert imu is not None
    imu = imu.where((imu.stamps_ns < lost_ns + 60 * SECOND) | (imu.stamps_ns > lost_ns + 66 * SECOND))
    recording = replace(run.recording, imu=imu, measurements=kept)
    return Lost(recording, with_few_states(run.config, rate_hz=2.5), run.truth, lost_ns)


def assert_drifts_as_a_vessel_can(track: Trajectory, lost: Lost) -> None:
    """As far as a vessel can drift and no farther: from the tilt, the IMU alone would be off by hundreds of metres."""
    assert track.cov is not None
    off_m = np.hypot(*(track.p_world_m - lost.truth.at(track.stamps_ns).p_world_m)[:, :2].T)
    since = track.stamps_ns >= lost.since_ns
    true = lost.truth.at(track.stamps_ns[since]).p_world_m
    way_m = float(np.hypot(*np.diff(true[:, :2], axis=0).T).sum())
    assert off_m[since].max() < 0.3 * way_m
    assert (off_m < bounds_95(track.cov)[:, 0])[since].mean() > 0.9


def test_without_a_place_it_drifts_as_far_as_a_vessel_can_and_no_farther(lost: Lost) -> None:
    steps: list[int] = []
    with patch.object(MotionModel, "step", autospec=True, side_effect=counted(steps)):
        track = replay(lost.recording, lost.config).solution.trajectory
    assert_drifts_as_a_vessel_can(track, lost)
    assert 60 < len(steps) < 95  # while the velocity is unsure: of 90 s, 6 are a hole
    assert np.diff(steps).min() >= 2, "a step a second at most, of states that come at 2.5 Hz"
    assert max(np.diff(steps)) * 0.4 > 6.0, "none in the hole"


def test_offline_too(lost: Lost) -> None:
    assert_drifts_as_a_vessel_can(
        app.smooth_recording(lost.recording, with_few_states(lost.config, 1.25)).solution.trajectory, lost
    )


TIMELINE = make_timeline(0, 60 * SECOND, [], TimelineConfig(rate_hz=2.0))


def where_unaided(aided_s: Iterable[float], hole_s: tuple[float, float] = (0.0, 0.0)) -> UsualMotion | None:
    """A minute to port at 3 m/s, heading 1 rad, measured at some times (s), the IMU silent in between others."""
    values = gtsam.Values()
    for k in range(len(TIMELINE)):
        values.insert(keys.pose(k), gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.zeros(3)))
        values.insert(keys.velocity(k), np.array([-3.0 * np.sin(1.0), 3.0 * np.cos(1.0), 0.0]))
    aided_ns = (np.array(list(aided_s)) * SECOND).astype(np.int64)
    first, last = (int(t * SECOND) for t in hole_s)
    return usual_motion(TIMELINE, values, aided_ns, [(first, last)] if last else [])


def test_offline_steps_are_where_nothing_measures_motion_for_over_ten_seconds() -> None:
    """Between two measurements, before the first and after the last; none in a hole of the IMU."""
    assert where_unaided(np.arange(0.0, 60.0, 9.5)) is None
    between = where_unaided([*range(21), *range(40, 61)])
    assert between is not None
    assert between.nodes == frozenset(range(20, 40))
    ends = where_unaided(range(15, 46), hole_s=(50.0, 53.0))
    assert ends is not None
    assert ends.nodes == frozenset(range(15)) | frozenset(range(45, 60)) - {50, 51, 52}


def test_offline_the_model_is_taught_where_motion_is_measured() -> None:
    found = where_unaided([*range(21), *range(40, 61)])
    assert found is not None
    standing = found.model.process(np.zeros(2), 1e6)[1]
    guess, measured_s = 2.0**2, 20.0 + 20.0
    assert standing[1] == pytest.approx(1.0 + 3.0**2 + (guess - 3.0**2) * 10.0 / (10.0 + measured_s), rel=0.1)
    assert standing[0] == pytest.approx(1.0 + guess * 10.0 / (10.0 + measured_s), rel=0.1)


def test_offline_it_is_taught_although_every_measurement_is_rare() -> None:
    """A car with a fix every 12 s: as if nothing were known of it, it'd be held to 2 m/s. What is longer than usual teaches nothing."""
    found = where_unaided(range(0, 61, 12))
    assert found is not None
    assert found.nodes == frozenset(range(60))
    standing = found.model.process(np.zeros(2), 1e6)[1]
    guess, measured_s = 2.0**2, 60.0
    assert standing[1] == pytest.approx(1.0 + 3.0**2 + (guess - 3.0**2) * 10.0 / (10.0 + measured_s), rel=0.1)
    lost = where_unaided(range(0, 25, 6))
    assert lost is not None
    assert lost.nodes == frozenset(range(24, 60))
    assert lost.model.process(np.zeros(2), 1e6)[1][0] == pytest.approx(1.0 + guess * 10.0 / (10.0 + 24.0), rel=0.1), (
        "36 s are six times the usual interval: there the IMU may have drifted"
    )


def test_a_step_is_in_the_graphs_that_have_both_its_states() -> None:
    found = where_unaided(range(31))
    assert found is not None
    values = gtsam.Values()
    for k in range(len(TIMELINE)):
        values.insert(keys.pose(k), gtsam.Pose3())
        values.insert(keys.velocity(k), np.zeros(3))
    state = int(np.searchsorted(TIMELINE.slow_of, 40))
    held = [f.keys() for f in found.factors(TIMELINE, values, range(40, 43), state)]
    pairs = [
        (int(np.searchsorted(TIMELINE.slow_of, j)), int(np.searchsorted(TIMELINE.slow_of, j + 1))) for j in (40, 41)
    ]
    assert held == [[keys.velocity(a), keys.velocity(b)] for a, b in pairs for _axis in range(2)]
    assert (
        len(found.factors(TIMELINE, values, range(40, 43), state + 1)) == 2
    )  # the first node began before the stretch


def test_a_step_is_expected_to_cost_what_its_two_axes_do(lost: Lost) -> None:
    """Those alone whose states are both in the stretch that the cost is of."""
    datum = app.choose_datum(lost.recording, lost.config)
    problem = make_problem(lost.recording, lost.config, datum, SENSORS, INERTIAL)
    last = len(problem.timeline) - 1
    stepped = replace(problem, usual_motion=UsualMotion(MotionModel(), frozenset({5, 6, 7})))
    for until, steps in ((last, 3), (int(np.searchsorted(problem.timeline.slow_of, 7)), 2)):
        more = expected_cost(stepped, {}, until) - expected_cost(problem, {}, until)
        assert more == pytest.approx(2.0 * steps)


def counted(steps: list[int]):  # type: ignore[no-untyped-def]
    real = MotionModel.step

    def step(self: MotionModel, a: Moving, b: Moving, dt_s: float) -> list[object]:
        steps.append(gtsam.Symbol(a.key).index())
        return real(self, a, b, dt_s)

    return step
