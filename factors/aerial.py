# SPDX-License-Identifier: Apache-2.0
"""Matches of LiDAR scans to an aerial image, with several modes, and the errors that all of them share.

    z = (x, y, yaw)(T_world_body) + u tau + d + w,   w ~ N(0, C) of the mode

d (3,): misregistration of the image, some decimetres, and yaw error of the mounts, about a degree; u: rate of x, y and yaw; tau: time
at which a scan was taken less its stamp, about 0.05 s (negative: the stamp is late). d and tau are constant over the run. The modes are
those of `pose`. With d or tau the factor has two states, and is linearised at every pass (`graphloc.linear`). Not handled: change of
u within tau; what a delayed match tells of the velocity.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphloc.config import AerialConfig
from graphloc.factors import pose
from graphloc.frames import Array, skew
from graphloc.graph import LATE, Attachment, Residual, SlowProcess
from graphloc.measurements import PoseFix

_AXES = ("x", "y", "yaw")


def _off_sigma(config: AerialConfig) -> Array:
    """Return the sigmas (4,) of the errors that all matches share: east and north, m, yaw, rad, delay of the stamps, s."""
    yaw_rad = float(np.radians(config.mount_sigma_deg)) if "yaw" in config.axes else 0.0
    return np.array([config.image_sigma_m, config.image_sigma_m, yaw_rad, config.stamp_sigma_s])


def _shown_off(axes: tuple[str, ...], config: AerialConfig, at: Attachment) -> Array:
    """Return d residual / d state (k, number of its axes)."""
    moves = np.append(at.sensor_velocity_mps()[:2], (at.T_world_body.rotation().matrix() @ at.gyro_radps)[2])
    every = np.column_stack([np.eye(3), moves])[_picked(axes)]
    return np.asarray(every[:, _off_sigma(config) > 0.0])


def _picked(axes: tuple[str, ...]) -> list[int]:
    return [_AXES.index(a) for a in axes]


def _by_turning(axes: tuple[str, ...], config: AerialConfig, at: Attachment) -> Array:
    """Return d (u tau) / d (body tangent of the state's pose), (k, 6)."""
    found = np.zeros((3, 6))
    if at.slow_value is not None and config.stamp_sigma_s > 0.0:
        late_s, R = float(at.slow_value[-1]), at.T_world_body.rotation().matrix()
        found[:2, :3] = (-R @ skew(late_s * at.swing_mps()))[:2]
        found[2, :3] = (-R @ skew(late_s * at.gyro_radps))[2]
    return found[_picked(axes)]


def residuals(m: PoseFix, config: AerialConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (k,), m and rad, for each mode."""
    plain = pose.without_slow(m, config, at)
    if at.slow_value is None:
        return plain
    shown, by_pose = _shown_off(m.axes, config, at), plain[0].jacobian() + _by_turning(m.axes, config, at)
    return tuple(pose.with_slow(r, m.axes, at.slow_value, shown, by_pose) for r in plain)


def slow(config: AerialConfig) -> SlowProcess | None:
    """Return the image's misregistration, the yaw of the mounts and the delay of the stamps."""
    sigma = _off_sigma(config)
    there = sigma > 0.0
    if not there.any():
        return None
    return SlowProcess(
        name="image offset",
        axes=tuple(np.array(["east", "north", "yaw", LATE])[there].tolist()),
        units=tuple(np.array(["m", "m", "deg", "s"])[there].tolist()),
        scale=np.array([1.0, 1.0, 180.0 / np.pi, 1.0])[there],
        sigma=sigma[there],
        time_constant_s=np.full(int(there.sum()), np.inf),
    )


def ideal(at: Attachment, config: AerialConfig) -> PoseFix:
    """Return the noise-free match at the attachment's state."""
    found = replace(pose.ideal_without_slow(at, config), sensor="aerial")
    return found if at.slow_value is None else pose.moved(found, _shown_off(config.axes, config, at) @ at.slow_value)


ROW = replace(pose.ROW, kind="aerial", config=AerialConfig, residuals=residuals, ideal=ideal, slow=slow)
