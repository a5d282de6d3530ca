# SPDX-License-Identifier: Apache-2.0
"""Propagation by the IMU: the newest state to a later stamp, and the odometry from state to state."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from graphloc.frames import Array
from graphloc.inertial import GapMotion
from graphloc.online._live import LiveProblem
from graphloc.online._odometry import Odometry
from graphloc.online._states import Newest, propagated_covariance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Propagated:
    """The newest state, or its propagation by the IMU.

    Attributes:
        stamp_ns: of the state. pose, velocity: at the IMU with the body's axes, in world: gtsam.Pose3 and (3,), m/s.
        pose_cov: (6, 6), rotation first, in the body tangent. velocity_cov: (3, 3), in world.
        p_odom_m, R_odom_body: (3,) and (3, 3), pose of the body's origin in odom.
    """

    stamp_ns: int
    pose: gtsam.Pose3
    velocity: Array
    pose_cov: Array
    velocity_cov: Array
    p_odom_m: Array
    R_odom_body: Array


def unpropagated(newest: Newest, odometry: Odometry) -> Propagated:
    """Return the newest state itself."""
    return Propagated(
        stamp_ns=newest.stamp_ns,
        pose=newest.pose,
        velocity=newest.velocity,
        pose_cov=newest.pose_cov,
        velocity_cov=newest.velocity_cov,
        p_odom_m=odometry.p_m,
        R_odom_body=odometry.R,
    )


def propagate(problem: LiveProblem, newest: Newest, odometry: Odometry, stamp_ns: int) -> Propagated:
    """Return the newest state propagated to a later stamp, which may lie after the last IMU sample."""
    pose = newest.pose
    start = gtsam.NavState(pose, newest.velocity)
    pim = problem.links.integrate(newest.stamp_ns, stamp_ns, newest.bias, GapMotion.of(start, newest.bias))
    there = pim.predict(start, newest.bias)
    p_odom, R_odom = odometry.after(*_body_step(problem, pose, there.pose()))
    dt_s, noise = (stamp_ns - newest.stamp_ns) * 1e-9, pim.preintMeasCov()
    pose_cov = propagated_covariance(newest.pose_cov, newest, there.pose().rotation().matrix(), dt_s, noise)
    R = pose.rotation().matrix()  # the noise is in the body's axes at the newest state
    return Propagated(
        stamp_ns=stamp_ns,
        pose=there.pose(),
        velocity=np.asarray(there.velocity()),
        pose_cov=pose_cov,
        velocity_cov=newest.velocity_cov + R @ noise[6:, 6:] @ R.T,
        p_odom_m=p_odom,
        R_odom_body=R_odom,
    )


def advance_odometry(odometry: Odometry, problem: LiveProblem, newest: Newest, until_ns: int) -> None:
    """Propagate the odometry by the IMU to a stamp, from the newest state or the odometry's own, if that is later."""
    links, bias, before_ns = problem.links, newest.bias, newest.stamp_ns
    if until_ns <= odometry.stamp_ns:
        return
    start = gtsam.NavState(newest.pose, newest.velocity)
    if before_ns < odometry.stamp_ns:
        start = links.integrate(before_ns, odometry.stamp_ns, bias, GapMotion.of(start, bias)).predict(start, bias)
        before_ns = odometry.stamp_ns
    pim = links.integrate(before_ns, until_ns, bias, GapMotion.of(start, bias))
    there = pim.predict(start, bias)
    dp, dR = _body_step(problem, start.pose(), there.pose())
    R, noise = start.attitude().matrix(), np.asarray(pim.preintMeasCov())[:6, :6]
    v_cov = R.T @ newest.velocity_cov @ R
    odometry.step(until_ns, (until_ns - before_ns) * 1e-9, dp, dR, there.pose().rotation().matrix(), v_cov, noise)


def _body_step(problem: LiveProblem, a: gtsam.Pose3, b: gtsam.Pose3) -> tuple[Array, Array]:
    """Return the step of the body's origin (3,) and the rotation (3, 3) from pose a to pose b, in the body's axes at a.

    Args:
        a, b: poses at the IMU with the body's axes, in world.
    """
    lever = -problem.t_body_imu_m
    R = a.rotation().matrix()
    dp = R.T @ (b.transformFrom(lever) - a.transformFrom(lever))
    return dp, R.T @ b.rotation().matrix()
