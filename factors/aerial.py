# SPDX-License-Identifier: Apache-2.0
"""Matches of LiDAR scans to an aerial image, with several modes; the image itself is off by some decimetres, the mounts by a degree.

    z = (x, y, yaw)(T_world_body) + d + w,   w ~ N(0, C) of the mode,   d (3,): misregistration of the image, yaw of the mounts

d is constant over the run. The modes are those of `pose`; with d the factor has two states, and is relinearised at every pass
(`graphloc.linear`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphloc.config import AerialConfig
from graphloc.factors import pose
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, GraphUpdate, Residual, SlowProcess
from graphloc.measurements import PoseFix, PoseMode

_AXES = ("x", "y", "yaw")


def _off_sigma(config: AerialConfig) -> Array:
    """Return the sigmas (3,) of what all matches are off by: east and north, m, and yaw, rad."""
    yaw_rad = float(np.radians(config.mount_sigma_deg)) if "yaw" in config.axes else 0.0
    return np.array([config.image_sigma_m, config.image_sigma_m, yaw_rad])


def _shown_off(axes: tuple[str, ...], config: AerialConfig) -> Array:
    """Return d residual / d state (k, number of its axes)."""
    return np.array([[float(a == own) for own in _AXES] for a in axes])[:, _off_sigma(config) > 0.0]


def residuals(m: PoseFix, config: AerialConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (k,), m and rad, for each mode."""
    plain = pose.residuals(m, config, at)
    if at.slow_value is None:
        return plain
    shown = _shown_off(m.axes, config)
    moved, flat = shown @ at.slow_value, [k for k, a in enumerate(m.axes) if a in ("x", "y")]
    turned = [k for k, a in enumerate(m.axes) if a == "yaw"]
    return tuple(
        replace(
            r,
            raw=r.raw + moved,
            slow_jacobian=lambda: shown,
            size_m=float(np.linalg.norm((r.raw + moved)[flat])) if flat else None,
            size_deg=float(np.degrees(np.linalg.norm((r.raw + moved)[turned]))) if turned else None,
        )
        for r in plain
    )


def factors(m: PoseFix, config: AerialConfig, at: Attachment, decision: Decision) -> GraphUpdate | None:
    """Return the native factor of the chosen mode; None where image or mounts may be off."""
    return pose.factors(m, config, at, decision) if at.slow_key is None else None


def slow(config: AerialConfig) -> SlowProcess | None:
    """Return the image's misregistration and the yaw of the mounts."""
    sigma = _off_sigma(config)
    there = sigma > 0.0
    if not there.any():
        return None
    return SlowProcess(
        name="image offset",
        axes=tuple(np.array(["east", "north", "yaw"])[there].tolist()),
        units=tuple(np.array(["m", "m", "deg"])[there].tolist()),
        scale=np.array([1.0, 1.0, 180.0 / np.pi])[there],
        sigma=sigma[there],
        time_constant_s=np.full(int(there.sum()), np.inf),
    )


def ideal(at: Attachment, config: AerialConfig) -> PoseFix:
    """Return the noise-free match at the attachment's state."""
    found = pose.ideal(at, config)
    moved = np.zeros(len(config.axes)) if at.slow_value is None else _shown_off(config.axes, config) @ at.slow_value
    mode = PoseMode(value=found.modes[0].value + moved, cov=found.modes[0].cov)
    return replace(found, sensor="aerial", modes=(mode,))


ROW = replace(
    pose.ROW, kind="aerial", config=AerialConfig, residuals=residuals, factors=factors, ideal=ideal, slow=slow
)
