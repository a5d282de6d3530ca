# SPDX-License-Identifier: Apache-2.0
"""From a state of the window to the `Estimate` that users get."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphloc.estimate import Estimate
from graphloc.frames import Array
from graphloc.judge.covariances import (
    limit_heading,
    widen_heading,
    world_covariance,
)
from graphloc.judge.health import health_of, of_receivers
from graphloc.online._anchor import sound
from graphloc.online._lag import Lag
from graphloc.online._odometry import Odometry
from graphloc.online._propagate import Propagated
from graphloc.online._unmodelled import UnmodelledError
from graphloc.solution import Cause
from graphloc.time import NS_PER_S


def estimate_of(
    now: Propagated,
    lag: Lag,
    odometry: Odometry,
    *,
    agreed_ns: Mapping[str, int],
    absolute: Sequence[str],
    doubt: str,
    heading_off_rad: float,
    heading_var: float,
    guess: bool,
    unmodelled: UnmodelledError | None,
) -> Estimate:
    """Return the `Estimate` of the newest state of a window, or of that state propagated by the IMU.

    Args:
        now: the state. lag: the window. odometry: the `odom` frame.
        agreed_ns: stamp at which each absolute sensor last agreed. absolute: names of all absolute sensors.
        doubt: why the health cannot be good, or empty.
        heading_off_rad: by how much the motion shows the heading to be off; the covariance includes it.
        heading_var: variance of the heading, rad^2, where no sensor measures it, because the window's own is then too
            small; else 0.
        guess: whether the heading is a guess.
        unmodelled: effect of slow errors that are left out, and of the IMU's mount, on the newest state; the
            covariances include it. None: there is no such effect.
    """
    newest, problem = lag.newest, lag.problem
    at_ns, lever = now.stamp_ns, -problem.t_body_imu_m
    R = now.pose.rotation().matrix()
    at, R_body_imu = np.array([at_ns]), problem.R_body_imu
    gyro = problem.links.gyro_at(at)[0] - R_body_imu @ newest.bias.gyroscope()
    white = problem.links.gyro_variance_at(at)[0] * np.eye(3)
    cov, v_cov = _covariances(now, lag, R, unmodelled)
    others_m, others_cov = lag.others
    cov[:3, :3] += others_cov + lag.contradicted
    cov[5, 5] += heading_off_rad**2
    widen_heading(cov, heading_var)
    limit_heading(cov)
    since = {n: max((at_ns - agreed_ns[n]) * 1e-9, 0.0) if n in agreed_ns else np.inf for n in absolute}
    health, reason = health_of(cov, of_receivers(since, problem.config), problem.config.output.good_bound_m, doubt)
    if doubt and reason.text != doubt:
        reason = replace(reason, text=f"{reason}; {doubt}")
    if guess:
        reason = replace(reason, cause=Cause.GUESSED_HEADING)
    return Estimate(
        stamp_ns=at_ns,
        p_world_m=np.asarray(now.pose.transformFrom(lever)) + others_m,
        R_world_body=R,
        v_world_mps=now.velocity + R @ np.cross(gyro, lever),
        cov=cov,
        v_cov=v_cov,
        p_odom_m=np.array(now.p_odom_m),
        R_odom_body=np.array(now.R_odom_body),
        step_cov=odometry.step_cov,
        gyro_radps=gyro,
        gyro_cov=white + R_body_imu @ newest.bias_cov[3:, 3:] @ R_body_imu.T,
        accel_bias_mps2=np.asarray(newest.bias.accelerometer()),
        gyro_bias_radps=np.asarray(newest.bias.gyroscope()),
        health=health,
        reason=reason,
        since_agreed_s=since,
    )


def _covariances(now: Propagated, lag: Lag, R: Array, unmodelled: UnmodelledError | None) -> tuple[Array, Array]:
    """Return the covariances of the pose of the body's origin (6, 6) and of the velocity (3, 3), in axes of world.

    They include the effect of what is left out of the window.

    Args:
        R: (3, 3) attitude. now, lag, unmodelled: as of `estimate_of`.
    """
    lever = -lag.problem.t_body_imu_m
    cov, v_cov = world_covariance(sound(now.pose_cov), R, lever), now.velocity_cov
    if unmodelled is not None:
        ahead_s = (now.stamp_ns - unmodelled.newest.stamp_ns) / NS_PER_S
        cov += unmodelled.pose(R @ lever, ahead_s)
        v_cov = v_cov + unmodelled.velocity
    return cov, v_cov
