# SPDX-License-Identifier: Apache-2.0
"""All sensors pause at once: either nothing was recorded, or the clock of the computer was set forward, and no time passed."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from graphloc import app
from graphloc.config import ImuConfig
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.factors.imu import ROW
from graphloc.frames import Array
from graphloc.inertial import GapMotion
from graphloc.measurements import ImuSeries
from graphloc.signals.pauses import Stamps, common_pauses
from tests.bagfactory import START_NS, Messages
from tests.heldbags import hold_bag, inspect_bag
from tests.slowly import simulate_slowly
from tests.test_inspect import drive

S, G, STEP_NS = 1_000_000_000, 9.81, 400_000_000


def every(period_s: float, begun_s: float = 0.0) -> Array:
    """Times of a minute, s."""
    return np.arange(begun_s, 60.0, period_s)


def later(t_s: Array, by_s: float = 0.4) -> Stamps:
    """Stamps of a clock that is set forward at 30 s."""
    return np.asarray(np.rint((t_s + by_s * (t_s > 30.0)) * S).astype(np.int64))


def without(t_s: Array, lost_s: float = 0.4) -> Stamps:
    """Stamps of what is recorded, but for a while after 30 s."""
    return np.rint(t_s[(t_s <= 30.0) | (t_s > 30.0 + lost_s)] * S).astype(np.int64)


@pytest.mark.parametrize("late_s", [0.0, 0.3, -0.3], ids=["stamped alike", "moved back", "moved on"])
def test_a_clock_that_is_set_forward_is_a_pause_of_all(late_s: float) -> None:
    others = [later(every(1.0, 0.21)) + int(late_s * S), later(every(0.1, 0.03)) + int(late_s * S)]
    ((start, stop),) = common_pauses(later(every(0.01)), others)
    assert (start, stop) == (30 * S, 30 * S + 410_000_000)


@pytest.mark.parametrize("begun_s", [0.21, 0.61], ids=["one is lost", "none is lost"])
def test_what_was_not_recorded_is_none_where_a_slow_sensor_keeps_its_time(begun_s: float) -> None:
    """Fixes of once a second are a second apart, or two; a clock that is set by 0.4 s would leave 1.4."""
    assert common_pauses(without(every(0.01)), [without(every(1.0, begun_s)), without(every(0.1, 0.03))]) == []


def test_what_was_not_recorded_may_be_a_pause_of_all_that_is_fast() -> None:
    assert len(common_pauses(without(every(0.01)), [without(every(0.1, 0.03))])) == 1


def test_where_the_imu_pauses_alone_or_nothing_else_tells_it_is_none() -> None:
    imu, unevenly = later(every(0.01)), np.sort(np.random.default_rng(1).uniform(0.0, 60.0, 60))
    assert common_pauses(imu, [np.rint(every(0.1) * S).astype(np.int64), later(every(0.2))]) == []
    assert common_pauses(imu, []) == []
    assert common_pauses(imu, [later(unevenly)]) == []
    assert common_pauses(np.zeros(0, dtype=np.int64), [imu]) == []
    gone = later(every(0.2))
    assert len(common_pauses(imu, [later(every(0.1)), gone[gone < 20 * S]])) == 1  # a sensor that had long been off


@pytest.mark.parametrize("period_s", [1.0, 5.0])
def test_a_short_pause_of_the_imu_alone_is_none_of_a_sensor_that_comes_rarely(period_s: float) -> None:
    fixes = every(period_s, 0.21)
    assert common_pauses(without(every(0.01), 0.2), [np.rint(fixes * S).astype(np.int64)]) == []
    assert len(common_pauses(later(every(0.01), 0.2), [later(fixes, 0.2)])) == 1


def test_across_a_pause_a_vessel_may_not_have_moved() -> None:
    """0.4 s at 3 m/s along y and 0.2 rad/s: 1.2 m and 0.08 rad, 1 sigma, and a tenth of it across; elsewhere as without."""
    stamps = later(every(0.01))
    n = len(stamps)
    imu = ImuSeries(
        sensor="imu", stamps_ns=stamps, accel_mps2=np.tile([0.0, 0.0, G], (n, 1)), gyro_radps=np.tile([0.0, 0.0, 0.2], (n, 1)), seqs=np.arange(n)
    )  # fmt: skip
    links = ROW.link(imu, ImuConfig(), np.eye(3), G)
    bias = gtsam.imuBias.ConstantBias()
    going = GapMotion(bias, np.array([0.0, 3.0, 0.0]))

    def sigmas(from_s: float, to_s: float) -> Array:
        pim = links.integrate(int(from_s * S), int(to_s * S), bias, going)
        return np.sqrt(np.diag(pim.preintMeasCov()))

    elsewhere, plain = sigmas(20.0, 20.5), links.integrate(30 * S, 30 * S + S // 2, bias, going)
    links.pause(30 * S, 30 * S + STEP_NS)
    paused = links.integrate(30 * S, 30 * S + S // 2, bias, going)
    assert sigmas(20.0, 20.5) == pytest.approx(elsewhere)
    assert paused.deltaPij() == pytest.approx(plain.deltaPij())
    assert sigmas(30.0, 30.5)[2:5] == pytest.approx([0.08, 0.12, 1.2], rel=0.02)
    in_two = np.hypot(sigmas(29.9, 30.1), sigmas(30.1, 30.5))
    assert in_two[2:5] == pytest.approx([0.08, 0.12, 1.2], rel=0.05)
    assert links.gaps() == [(30 * S, 30 * S + STEP_NS)]


def _set_forward(run: SimulatedRun, at_ns: int) -> SimulatedRun:
    """The run by a clock that is set forward; its truth by the one that is not."""
    imu = run.recording.imu
    assert imu is not None
    stamps = imu.stamps_ns + np.where(imu.stamps_ns > at_ns, STEP_NS, 0)
    measured = [replace(m, stamp_ns=m.stamp_ns + STEP_NS * (m.stamp_ns > at_ns)) for m in run.recording.measurements]
    return replace(
        run, recording=replace(run.recording, imu=replace(imu, stamps_ns=stamps), measurements=tuple(measured))
    )


def test_a_clock_that_is_set_moves_no_vessel_and_its_bounds_hold() -> None:
    """It was up to a metre off for seconds, within bounds of 0.2 m."""
    scenario = Scenario(path="loops", noise="clean", duration_s=24.0, pose_hz=0.0, gnss_hz=5.0, gnss_sigma_m=0.02)
    run = simulate_slowly(replace(scenario, gnss_reported_sigma_m=0.02, imu_hz=50.0), 3, 10.0)
    at_ns = int(run.truth.stamps_ns[0]) + 16 * S
    changed = _set_forward(run, at_ns)
    estimated = app.simulated(changed, compare=False)
    track = estimated.solution.trajectory
    assert track.cov is not None
    aside = (track.stamps_ns <= at_ns) | (track.stamps_ns > at_ns + STEP_NS + S // 50)  # beyond the sample after it
    true_m, _ = run.truth.poses_at(track.stamps_ns[aside] - STEP_NS * (track.stamps_ns[aside] > at_ns))
    off_m = np.hypot(*(track.p_world_m[aside] - true_m)[:, :2].T)
    bound_m = 2.448 * np.sqrt(np.linalg.eigvalsh(track.cov[aside, :2, :2])[:, -1])
    assert (off_m < bound_m).all()
    assert off_m.max() < 0.2
    assert any("all sensors pause for 0.42 s" in said for said in estimated.warnings)


def test_inspect_says_that_all_sensors_pause(tmp_path: Path) -> None:
    make = Messages(2)
    items = [
        (topic, at + STEP_NS * (at > START_NS + 20 * S), m, at > START_NS + 20 * S) for topic, at, m in drive(make)
    ]
    for _, _, m, set_on in items:
        if set_on:
            m.header.stamp.nanosec += STEP_NS
            m.header.stamp.sec, m.header.stamp.nanosec = (
                m.header.stamp.sec + m.header.stamp.nanosec // S,
                m.header.stamp.nanosec % S,
            )
    found = inspect_bag(hold_bag(tmp_path / "run", make, [item[:3] for item in items]))
    (said,) = (warning for warning in found.warnings if "all sensors pause" in warning)
    assert "either nothing was recorded meanwhile, or the computer's clock" in said
