# SPDX-License-Identifier: Apache-2.0
"""A receiver that is far off for a while: of two levels that differ by a jump, one is where its error usually stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphloc import app
from graphloc.build import at_level, closing_variance, slow_begin, slow_end, slow_step, standing_cost
from graphloc.config import GnssConfig, VelocityConfig, VesselConfig
from graphloc.eval.drill.failures import script
from graphloc.eval.metrics import TruthMetrics, compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors.gnss import slow
from graphloc.frames import Array
from graphloc.graph import SlowProcess
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, GnssVelocity, Measurement, PoseFix
from graphloc.recording import Recording
from graphloc.replay import replay
from graphloc.time import NS_PER_S
from tests.slowly import with_few_states

PLACE, FIRST = 10_000, 0


def process(*, jumps: bool = True) -> SlowProcess:
    config = GnssConfig.model_validate({"topic": "/fix", "slow_error": {"enabled": True, "jumps": jumps}})
    found = slow(config)
    assert found is not None
    return found


def chain(
    of: SlowProcess, fixes: Array, *, jumps: bool
) -> tuple[gtsam.Values, gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A place that nothing else tells but its height, and a fix a second (N, 3) that is off from it by the slow error; where it begins: the mean."""
    graph, begin = gtsam.NonlinearFactorGraph(), gtsam.Values()
    begin.insert(PLACE, fixes.mean(axis=0))
    waterline = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e6, 1e6, 0.1]))  # else the place goes up with the fixes
    graph.add(gtsam.PriorFactorVector(PLACE, np.zeros(3), waterline))
    n = len(fixes)
    for j, fix in enumerate(fixes):
        begin.insert(j, fix - fixes.mean(axis=0))
        graph.add(gtsam.BetweenFactorVector(PLACE, j, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1e6)))
        graph.add(_off_by(j, fix))
    for factor in slow_begin(of, 0, np.zeros(3), jumps=jumps):
        graph.add(factor)
    for j in range(n - 1):
        for factor in slow_step(of, j, j + 1, 1.0, jumps=jumps):
            graph.add(factor)
    for factor in slow_end(of, n - 1, jumps=jumps):
        graph.add(factor)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(500)
    return gtsam.LevenbergMarquardtOptimizer(graph, begin, parameters).optimize(), graph, begin


def _off_by(j: int, fix: Array) -> gtsam.NonlinearFactor:
    """place + error = fix, to 0.1 m."""
    make = gtsam.JacobianFactor
    linear = make(PLACE, np.eye(3) / 0.1, j, np.eye(3) / 0.1, fix / 0.1, gtsam.noiseModel.Unit.Create(3))
    point = gtsam.Values()
    point.insert(PLACE, np.zeros(3))
    point.insert(j, np.zeros(3))
    return gtsam.LinearContainerFactor(linear, point)


def levels(first_s: int, second_s: int, jump: Sequence[float]) -> Array:
    return np.vstack([np.zeros((first_s, 3)), np.tile(jump, (second_s, 1))])


def test_of_two_levels_the_longer_one_is_the_usual_one() -> None:
    """46 s and 14 s, 11 m apart, nothing else: halfway between is what a Gaussian makes of it."""
    fixes = levels(46, 14, (8.0, -7.6, 0.0))
    with_tails = chain(process(), fixes, jumps=True)[0].atVector(PLACE)
    without = chain(process(), fixes, jumps=False)[0].atVector(PLACE)
    assert np.hypot(*without[:2]) > 4.0
    assert np.hypot(*with_tails[:2]) < 2.5
    assert (
        np.hypot(*chain(process(), levels(14, 46, (8.0, -7.6, 0.0)), jumps=True)[0].atVector(PLACE)[:2] - (8.0, -7.6))
        < 2.5
    )


def test_a_level_that_is_known_holds_its_nodes_alone() -> None:
    """Information about 0 of a chain of 6 s, at its usual level from 2 to 4 s: 1/2 of the process at either end of it, dt/2T in between."""
    of, n = process(), 7
    usual = np.array([False, False, True, True, True, False, False])
    graph, at = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for j in range(n):
        at.insert(j, np.zeros(3))
    priors = [*slow_begin(of, 0, np.zeros(3), far=False), *slow_end(of, n - 1, far=False)]
    steps = [slow_step(of, j, j + 1, 1.0, far=False) for j in range(n - 1)]
    for factor in [*priors, *(f for step in steps for f in step), *at_level(of, range(n), np.ones(n - 1), usual)]:
        graph.add(factor)
    held = np.zeros((n, 3))
    for k in range(graph.size()):
        if len(names := graph.at(k).keys()) == 1:
            held[names[0]] += np.diagonal(graph.at(k).linearize(at).information())[:3]
    held *= of.sigma**2
    walk = 1.0 / (2.0 * of.time_constant_s[0])
    np.testing.assert_allclose(held[:, 0], [0.0, 0.0, 0.5 + walk, walk, 0.5 + walk, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(held[:, 1], held[:, 0], atol=1e-9)
    np.testing.assert_allclose(held[:, 2], [0.5, *[walk] * 5, 0.5 + walk], atol=1e-9)  # up does not stay far off


@pytest.mark.parametrize("far", [True, False])
def test_where_an_error_is_drawn_anew_one_chain_ends_and_another_begins(far: bool) -> None:
    """7 s, drawn anew after the third: as much information about 0, and on each other, as two chains have, and the cost of both."""
    of, apart = process(), 3
    usual, value = np.ones(7, dtype=bool), np.array([20.0, -7.0, 3.0])

    def held(parts: Sequence[range]) -> Array:
        graph, at = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for part in parts:
            for factor in [*slow_begin(of, part[0], np.zeros(3), far=far), *slow_end(of, part[-1], far=far)]:
                graph.add(factor)
            anew = np.array([j == apart for j in part[:-1]])
            for j, other in zip(part[:-1], anew, strict=True):
                for factor in slow_step(of, j, j + 1, 1.0, far=far, anew=bool(other)):
                    graph.add(factor)
            if not far:
                names = usual[part.start : part.stop]
                for factor in at_level(of, part, np.ones(len(part) - 1), names, anew):
                    graph.add(factor)
        for j in range(7):
            at.insert(j, value)
        return np.asarray(graph.linearize(at).hessian()[0])

    two = (range(apart + 1), range(apart + 1, 7))
    np.testing.assert_allclose(held([range(7)]), held(two), atol=1e-9)
    path = np.tile(value, (7, 1))
    costs = [standing_cost(of, path[part.start : part.stop], np.ones(len(part) - 1)) for part in two]
    whole = standing_cost(of, path, np.ones(6), np.arange(6) == apart)
    assert whole == pytest.approx(sum(costs))
    assert standing_cost(of, path, np.ones(6)) < 0.7 * whole


def test_a_height_far_off_does_not_set_the_place_free() -> None:
    """Fixes above another zero, 40 m: east and north are known as well as ever."""
    told = []
    for up in (0.0, 40.0):
        solved, graph, _ = chain(process(), levels(30, 30, (1.0, 1.0, 0.0)) + np.array([0.0, 0.0, up]), jumps=True)
        told.append(gtsam.Marginals(graph, solved).marginalCovariance(PLACE)[:2, :2])
    np.testing.assert_allclose(told[1], told[0], rtol=1e-3)


@pytest.mark.parametrize("value", [(0.0, 0.0, 0.0), (1.0, -2.0, 3.0), (12.0, 5.0, -40.0)])
def test_what_closes_a_chain_is_taken_out_as_it_weighs(value: tuple[float, float, float]) -> None:
    """`closing_variance` is one over the information of `slow_end`, linearised where the chain ends."""
    at, of = gtsam.Values(), process()
    at.insert(FIRST, np.array(value))
    graph = gtsam.NonlinearFactorGraph()
    for factor in slow_end(of, FIRST):
        graph.add(factor)
    information = graph.linearize(at).hessian()[0]
    np.testing.assert_allclose(np.diagonal(information), 1.0 / closing_variance(of, np.array(value)), rtol=1e-6)


def jumped(
    begin_s: float, end_s: float, seed: int, length_s: float = 60.0, gnss_hz: float = 2.0
) -> tuple[SimulatedRun, Recording, VesselConfig]:
    """Fixes, compass and velocities (0.1 m/s); the fixes 11 m off for a while."""
    run = simulate(
        Scenario(path="loops", duration_s=length_s, noise="clean", imu_hz=50.0, gnss_hz=gnss_hz, compass_hz=1.0), seed
    )
    imu, truth, rng = run.recording.imu, run.truth, np.random.default_rng(seed)
    assert imu is not None
    kept: list[Measurement] = []
    for m in run.recording.measurements:
        t_s = (m.stamp_ns - imu.stamps_ns[0]) * 1e-9
        if isinstance(m, GnssPosition):
            if begin_s < t_s < end_s:
                north = m.position.latitude_deg + 11.0 / 111_300.0
                m = replace(m, position=m.position._replace(latitude_deg=north))
            kept.append(m)
            lever = run.config.sensors["gnss"].mount.t_body_sensor_m
            there = truth.at(np.array([m.stamp_ns - 10_000_000, m.stamp_ns + 10_000_000]))
            moved = np.diff(there.p_world_m + there.R_world_body @ lever, axis=0)[0] / 0.02
            kept.append(
                GnssVelocity(stamp_ns=m.stamp_ns, sensor="velocity", seq=-1, cov_m2ps2=np.eye(3) * 0.01,
                             v_enu_mps=moved + rng.normal(0.0, 0.1, 3))
            )  # fmt: skip
        elif not isinstance(m, PoseFix):
            kept.append(m)
    ordered = sorted(kept, key=lambda m: (m.stamp_ns, m.sensor))
    measurements = tuple(replace(m, seq=len(imu) + i) for i, m in enumerate(ordered))
    velocity = VelocityConfig(topic="/velocity", mount=run.config.sensors["gnss"].mount)
    sensors = {n: s for n, s in run.config.sensors.items() if n != "matcher"} | {"velocity": velocity}
    recording = replace(run.recording, measurements=measurements, message_count=len(imu) + len(measurements))
    return run, recording, with_few_states(run.config.model_copy(update={"sensors": sensors}), rate_hz=1.25)


@pytest.mark.parametrize(("begin_s", "end_s", "online"), [(24.0, 40.0, True), (24.0, 40.0, False), (15.0, 29.0, True)])
def test_fixes_and_velocities_do_not_follow_a_jump(begin_s: float, end_s: float, online: bool) -> None:
    """At the end of the run, where nothing says that it ends, and in its middle."""
    run, recording, config = jumped(begin_s, end_s, 3, length_s=40.0)
    found = (replay if online else app.smooth_recording)(recording, config).solution
    off = compare_to_truth(found.trajectory, run.truth)
    assert off.position_rmse_m < 2.5
    assert off.coverage_95 is not None
    assert off.coverage_95 > 0.95


def test_a_driver_that_hangs_says_nothing_new() -> None:
    """It repeats positions and velocities for 30 s, and goes on near where it hung: the track followed the velocities, 80 to 110 m off."""
    run, recording, config = jumped(0.0, 0.0, 4, length_s=54.0, gnss_hz=4.0)
    assert recording.imu is not None
    begin_ns = int(recording.imu.stamps_ns[0]) + 15 * NS_PER_S
    hangs = next(f for f in script(recording)[0] if f.name == "GNSS frozen, 30 s").on(recording, begin_ns, 0).recording
    for found, most_m in (
        (app.smooth_recording(hangs, config).solution, 1.5),
        (replay(hangs, config).solution, 15.0),  # of dead reckoning
    ):
        off: TruthMetrics = compare_to_truth(found.trajectory, run.truth)
        assert off.position_max_m < most_m
        assert off.coverage_95 is not None
        assert off.coverage_95 > 0.95
        hung = [row for row in found.ledger if begin_ns + NS_PER_S < row.stamp_ns < begin_ns + 29 * NS_PER_S]
        said = {(row.sensor, row.outcome) for row in hung if row.sensor in ("gnss", "velocity")}
        assert said == {("gnss", Outcome.REJECTED), ("velocity", Outcome.REJECTED)}
        assert sorted(row.seq for row in found.ledger) == list(range(hangs.message_count))


@pytest.mark.parametrize(("end_s", "right"), [(14.0, True), (35.0, False)])
def test_a_run_that_begins_in_a_jump(end_s: float, right: bool) -> None:
    """The level that is held longest is no jump, wherever the run begins; where that is the wrong one, the bounds allow for it."""
    run, recording, config = jumped(0.0, end_s, 3)
    found = app.smooth_recording(recording, config).solution
    off = compare_to_truth(found.trajectory, run.truth)
    assert off.coverage_95 is not None
    assert off.coverage_95 > 0.95
    assert (off.position_rmse_m < 2.5) is right
    assert any("held longest" in w for w in found.stats.warnings)


def test_online_the_end_of_a_jump_is_not_taken_for_one_for_ever() -> None:
    """It begins in a jump of 20 s: a minute after that it begins anew, where the fixes are since."""
    run, recording, config = jumped(0.0, 20.0, 3, length_s=100.0, gnss_hz=1.0)
    track = replay(recording, config).solution.trajectory
    off_m = np.hypot(*(track.p_world_m - run.truth.at(track.stamps_ns).p_world_m)[:, :2].T)
    late = track.stamps_ns > run.truth.stamps_ns[0] + int(90e9)
    assert off_m[~late].max() > 8.0
    assert off_m[late].max() < 2.5
