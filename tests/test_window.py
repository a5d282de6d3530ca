# SPDX-License-Identifier: Apache-2.0
"""The lag's graph against GTSAM's own fixed lag, which orders otherwise: the same estimates, the same covariances."""

from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc import keys
from graphloc.frames import Array
from graphloc.online._window import Window

LAG_S, STEPS, HZ = 3.0, 80, 5
STEP = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.01, 0.02, 0.1, 0.1, 0.05]))
PLACE = gtsam.noiseModel.Isotropic.Sigma(3, 0.3)
LEVER, EXACT = np.array([0.5, 0.1, 1.0]), gtsam.noiseModel.Isotropic.Sigma(3, 0.005)
FIRST = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.2, 0.5, 0.5, 0.5]))
OFFSET = keys.constant(0, 0)  # of the receiver, in every fix
Staged = tuple[list[Any], dict[int, Any], float]


def drive(seed: int) -> list[Staged]:
    """A turning vessel with an antenna: of each step its factors, what is new, and when that leaves with."""
    rng, true, steps = np.random.default_rng(seed), gtsam.Pose3(), []
    moved = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.02, 0.0), np.array([0.4, 0.0, 0.0]))
    guess = true
    for k in range(STEPS):
        if k:
            true = true.compose(moved)
            told = moved.retract(rng.normal(0.0, STEP.sigmas()))
            guess = guess.compose(told)
            factors: list[Any] = [gtsam.BetweenFactorPose3(keys.pose(k - 1), keys.pose(k), told, STEP)]
        else:
            factors = [gtsam.PriorFactorPose3(keys.pose(0), true, FIRST)]
        antenna, lever = keys.leaves(0, k)
        fix = true.transformFrom(LEVER) + rng.normal(0.0, 0.3, 3)
        new = {keys.pose(k): guess, antenna: fix, lever: LEVER}
        if k == 0:
            factors.append(gtsam.PriorFactorPoint3(OFFSET, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.2)))
            new[OFFSET] = np.zeros(3)
        factors += [
            gtsam.PriorFactorPoint3(lever, LEVER, EXACT),
            gtsam.ReferenceFrameFactorPoint3Pose3(lever, keys.pose(k), antenna, EXACT),
            gtsam.BetweenFactorPoint3(antenna, OFFSET, -fix, PLACE),
        ]
        steps.append((factors, new, float(np.ceil(k / HZ))))
    return steps


def gtsams_own(steps: list[Staged]) -> tuple[gtsam.Pose3, Array]:
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    params.setFactorization("QR")
    params.relinearizeSkip = 1
    params.setRelinearizeThreshold(0.02)
    smoother = gtsam.IncrementalFixedLagSmoother(LAG_S, params)
    for factors, new, t_s in steps:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in factors:
            graph.add(factor)
        for key, value in new.items():
            values.insert(key, value)
        smoother.update(graph, values, dict.fromkeys([*new, OFFSET], t_s))
    last = keys.pose(len(steps) - 1)
    turn = smoother.calculateEstimate().atPose3(last).rotation().matrix().T @ (
        smoother.getLinearizationPoint().atPose3(last).rotation().matrix()
    )
    whole = np.kron(np.eye(2), turn)
    return smoother.calculateEstimate().atPose3(last), whole @ smoother.marginalCovariance(last) @ whole.T


def ours(steps: list[Staged]) -> Window:
    window = Window(LAG_S)
    for factors, new, t_s in steps:
        for key, value in new.items():
            window.guess(key, value, t_s)
        window.touch(OFFSET, t_s)
        window.add(factors)
        window.relinearise()
        window.commit()
    return window


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_window_agrees_with_gtsams_fixed_lag_smoother(seed: int) -> None:
    steps = drive(seed)
    pose, cov = gtsams_own(steps)
    window, last = ours(steps), keys.pose(STEPS - 1)
    assert (
        np.abs(pose.localCoordinates(window.values.atPose3(last))).max() < 2e-3
    )  # 1 of 100 sigmas: linearised elsewhere
    np.testing.assert_allclose(np.sqrt(np.diag(window.covariance([last]))), np.sqrt(np.diag(cov)), rtol=0.02)


def test_what_is_older_than_the_lag_leaves_by_the_second_and_nothing_else() -> None:
    window, now_s = ours(drive(0)), float(np.ceil((STEPS - 1) / HZ))
    stay = [k for k in range(STEPS) if np.ceil(k / HZ) >= now_s - LAG_S]
    assert [k for k in range(STEPS) if window.is_committed(keys.pose(k))] == stay
    assert [k for k in range(STEPS) if window.values.exists(keys.pose(k))] == stay


def test_a_leaf_whose_factors_are_taken_out_can_be_put_in_again() -> None:
    """The solver forgets it with its last factor: told to order what it does not know, it fails."""
    steps, window = drive(0), Window(LAG_S)
    for k, (factors, new, t_s) in enumerate(steps):
        for key, value in new.items():
            window.guess(key, value, t_s)
        window.touch(OFFSET, t_s)
        window.add(factors[:-3])
        held = window.add(factors[-3:])
        window.commit()
        if k % HZ == 1:
            antenna, lever = keys.leaves(0, k)
            assert window.remove(held)
            window.relinearise()
            window.commit()
            assert not window.values.exists(antenna)
            assert not window.remove(held)
            for key in (antenna, lever):
                window.guess(key, new[key], t_s)
            again = window.add(factors[-3:])
            window.settle(2)
            assert window.is_committed(antenna)
            assert window.remove(again)
    pose, _ = gtsams_own(steps)
    assert np.linalg.norm(window.values.atPose3(keys.pose(STEPS - 1)).translation() - pose.translation()) < 0.5


def test_where_the_solver_will_relinearise_is_known_before() -> None:
    """Factors are written in tangents that the next commit is the first to have."""
    window, moved = Window(LAG_S), 0
    for factors, new, t_s in drive(1):
        for key, value in new.items():
            window.guess(key, value, t_s)
        window.touch(OFFSET, t_s)
        window.add(factors)
        window.commit()
        poses = [k for k in range(STEPS) if window.is_committed(keys.pose(k))]
        before = [window.linearised_at(keys.pose(k)) for k in poses]
        window.relinearise()
        told = [window.linearised_at(keys.pose(k)) for k in poses]
        window.commit()
        for k, was, at in zip(poses, before, told, strict=True):
            assert window.linearised_at(keys.pose(k)).equals(at, 1e-9)
            moved += not was.equals(at, 1e-9)
    assert moved > 20


def test_a_step_from_the_oldest_pose_costs_what_it_costs_the_solver() -> None:
    """Places come that lie aside and turned: as dear as to a graph that forgets nothing. The solver holds the oldest pose as it was."""
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setAccelerometerCovariance(1e-6 * np.eye(3))
    params.setGyroscopeCovariance(1e-8 * np.eye(3))
    params.setIntegrationCovariance(1e-10 * np.eye(3))
    pim = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias())
    for _ in range(20):
        pim.integrateMeasurement(np.array([0.0, 0.0, 9.81]), np.array([0.0, 0.0, 0.02]), 1.0 / HZ / 20.0)
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.01, 0.3, 1.0, 1.0, 0.5]))
    sure = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05]))
    bias, at = keys.bias(0), gtsam.NavState(gtsam.Pose3(), np.array([1.0, 0.0, 0.0]))
    window, whole, guess = Window(LAG_S), gtsam.NonlinearFactorGraph(), gtsam.Values()

    def add(*factors: Any) -> None:
        window.add(factors)
        for factor in factors:
            whole.add(factor)

    for k in range(STEPS):
        at = pim.predict(at, gtsam.imuBias.ConstantBias()) if k else at
        for key, value in ((keys.pose(k), at.pose()), (keys.velocity(k), at.velocity())):
            window.guess(key, value, float(np.ceil(k / HZ)))
            guess.insert(key, value)
        if k:
            add(gtsam.ImuFactor(keys.pose(k - 1), keys.velocity(k - 1), keys.pose(k), keys.velocity(k), bias, pim))
        else:
            window.guess(bias, gtsam.imuBias.ConstantBias(), 0.0)
            guess.insert(bias, gtsam.imuBias.ConstantBias())
            exact, slow = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6), gtsam.noiseModel.Isotropic.Sigma(3, 0.5)
            add(
                gtsam.PriorFactorConstantBias(bias, gtsam.imuBias.ConstantBias(), exact),
                gtsam.PriorFactorPose3(keys.pose(0), at.pose(), loose),
                gtsam.PriorFactorVector(keys.velocity(0), at.velocity(), slow),
            )
        window.touch(bias, float(np.ceil(k / HZ)))
        window.commit()
    aside = gtsam.Pose3(gtsam.Rot3.Yaw(0.1), np.array([0.0, 1.0, 0.0]))
    before = window.error()
    add(
        *(
            gtsam.PriorFactorPose3(keys.pose(k), guess.atPose3(keys.pose(k)).compose(aside), sure)
            for k in range(STEPS - 15, STEPS)
        )
    )
    window.settle(5)
    cost = whole.error(gtsam.LevenbergMarquardtOptimizer(whole, guess).optimize())
    assert window.error() - before == pytest.approx(cost, abs=0.5)


def test_errors_connected_to_nothing_else_are_relinearised() -> None:
    """The solver then orders these two alone, and what comes last among two is no third group."""
    window = ours(drive(0))
    window.settle(5)
    slow, own = (keys.slow(1, 0), keys.slow(1, 1)), gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    for key in slow:
        window.guess(key, np.ones(1), float(np.ceil((STEPS - 1) / HZ)))
    window.add([gtsam.PriorFactorVector(slow[0], np.zeros(1), own), gtsam.BetweenFactorVector(*slow, np.zeros(1), own)])
    window.commit()
    assert window.relinearise()
    window.commit()
    np.testing.assert_allclose([window.values.atVector(key) for key in slow], 0.0, atol=1e-9)


def _underway(window: Window, k: int, pim: gtsam.PreintegratedImuMeasurements) -> None:
    """Stage state k of a vessel at rest, which has a bias each second."""
    t_s, j = float(np.ceil(k / HZ)), k // HZ
    window.guess(keys.pose(k), gtsam.Pose3(), t_s)
    window.guess(keys.velocity(k), np.zeros(3), t_s)
    if k % HZ == 0:
        window.guess(keys.bias(j), gtsam.imuBias.ConstantBias(), t_s)
        tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
        window.add([gtsam.PriorFactorConstantBias(keys.bias(j), gtsam.imuBias.ConstantBias(), tight)])
    window.touch(keys.bias(j), t_s)
    if k == 0:
        window.add([gtsam.PriorFactorPose3(keys.pose(0), gtsam.Pose3(), FIRST),
                    gtsam.PriorFactorVector(keys.velocity(0), np.zeros(3), PLACE)])  # fmt: skip
    else:
        before = keys.pose(k - 1), keys.velocity(k - 1)
        window.add([gtsam.ImuFactor(*before, keys.pose(k), keys.velocity(k), keys.bias((k - 1) // HZ), pim)])


def test_where_all_fixes_are_written_anew_the_tree_stays_as_sparse() -> None:
    """Left to iSAM2, all that the new factors have would be eliminated last, after the velocities and biases between."""
    pim = gtsam.PreintegratedImuMeasurements(gtsam.PreintegrationParams.MakeSharedU(9.81))
    for _ in range(4):
        pim.integrateMeasurement(np.array([0.0, 0.0, 9.81]), np.zeros(3), 0.25 / HZ)
    window, held = Window(10.0), []
    fix = [gtsam.GPSFactorArm(keys.pose(k), LEVER, LEVER, PLACE) for k in range(6 * HZ)]
    for k in range(len(fix)):
        _underway(window, k, pim)
        held.append(window.add([fix[k]]))
        window.commit()
    tree = window._solver  # noqa: SLF001 - how full it is shows in time alone
    sparse = tree.treeNnz()
    for k, fixes in enumerate(held):
        assert window.remove(fixes)
        window.add([fix[k]])
    window.commit()
    assert tree.treeNnz() < 1.5 * sparse
