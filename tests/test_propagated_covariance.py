# SPDX-License-Identifier: Apache-2.0
"""A covariance carried on from the newest state: for predictions of a pose, and for judging measurements across a gap."""

from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np

from graphloc.frames import Array
from graphloc.online._propagate import propagate
from graphloc.online._states import Newest, propagated_covariance

DT_S, STEP = 1.7, 1e-6


def spread(rng: np.random.Generator, n: int) -> Array:
    root = rng.normal(size=(n, n))
    return np.asarray(root @ root.T)


def test_a_covariance_is_carried_on_as_errors_are() -> None:
    """Errors of pose, slow state and velocity, each for itself, through R dR and p + v dt: by differences."""
    rng = np.random.default_rng(2)
    here = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.3, -0.5, 2.0])), np.array([20.0, -7.0, 1.0]))
    turned, v = gtsam.Rot3.Expmap(np.array([0.4, 0.1, -1.1])), np.array([3.0, 1.0, -0.2])

    def there(pose: gtsam.Pose3, velocity: Array) -> gtsam.Pose3:
        return gtsam.Pose3(pose.rotation().compose(turned), pose.translation() + DT_S * velocity)

    def after(errors: Array) -> Array:
        """Of pose (6), slow state (2) and velocity (3): those of pose and slow state later."""
        moved = there(here.compose(gtsam.Pose3.Expmap(errors[:6])), v + errors[8:])
        return np.concatenate([gtsam.Pose3.Logmap(there(here, v).between(moved)), errors[6:8]])

    J = np.column_stack([(after(STEP * e) - after(-STEP * e)) / (2.0 * STEP) for e in np.eye(11)])
    P, velocity_cov, noise = spread(rng, 8), spread(rng, 3), spread(rng, 9)
    both = np.zeros((11, 11))
    both[:8, :8], both[8:, 8:] = P, velocity_cov
    expected = J @ both @ J.T
    expected[:6, :6] += noise[:6, :6]
    newest = Newest(
        number=0, stamp_ns=0, pose=here, velocity=v, bias=gtsam.imuBias.ConstantBias(), pose_cov=P[:6, :6],
        velocity_cov=velocity_cov, bias_cov=np.zeros((6, 6)),
    )  # fmt: skip
    R = there(here, v).rotation().matrix()
    np.testing.assert_allclose(propagated_covariance(P, newest, R, DT_S, noise), expected, atol=1e-6)
    np.testing.assert_allclose(propagated_covariance(P[:6, :6], newest, R, DT_S, noise), expected[:6, :6], atol=1e-6)


def test_the_noise_of_the_accelerometer_is_in_the_axes_of_the_body() -> None:
    """A craft that lies on its side, with an accelerometer that is noisy along body z alone: across the world's axes, not up."""
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setAccelerometerCovariance(np.diag([1e-8, 1e-8, 1e-2]))
    pim = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias())
    on_side = gtsam.Rot3.Roll(np.pi / 2)
    for _ in range(100):
        pim.integrateMeasurement(on_side.unrotate(np.array([0.0, 0.0, 9.81])), np.zeros(3), 0.01)
    newest = Newest(
        number=0, stamp_ns=0, pose=gtsam.Pose3(on_side, np.zeros(3)), velocity=np.zeros(3), bias=gtsam.imuBias.ConstantBias(),
        pose_cov=np.zeros((6, 6)), velocity_cov=np.zeros((3, 3)), bias_cov=np.zeros((6, 6)),
    )  # fmt: skip
    problem: Any = SimpleNamespace(links=SimpleNamespace(integrate=lambda *_: pim), t_body_imu_m=np.zeros(3))
    odometry: Any = SimpleNamespace(after=lambda *_: (np.zeros(3), np.eye(3)))
    variances = np.diag(propagate(problem, newest, odometry, 10**9).velocity_cov)
    assert variances[1] > 100.0 * variances[2]
