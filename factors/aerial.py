# SPDX-License-Identifier: Apache-2.0
"""Matches of LiDAR scans to an aerial image, with several modes; the image itself is off by some decimetres.

    z = (x, y, yaw)(T_world_body) + (d, 0) + w,   w ~ N(0, C) of the mode,   d (2,): misregistration of the image

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


def _shown_off(axes: tuple[str, ...]) -> Array:
    """Return d residual / d misregistration (k, 2)."""
    return np.array([[float(a == "x"), float(a == "y")] for a in axes])


def residuals(m: PoseFix, config: AerialConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (k,), m and rad, for each mode."""
    plain = pose.residuals(m, config, at)
    if at.slow_value is None:
        return plain
    shown = _shown_off(m.axes)
    moved, flat = shown @ at.slow_value, [k for k, a in enumerate(m.axes) if a in ("x", "y")]
    return tuple(
        replace(
            r,
            raw=r.raw + moved,
            slow_jacobian=lambda: shown,
            size_m=float(np.linalg.norm((r.raw + moved)[flat])) if flat else None,
        )
        for r in plain
    )


def factors(m: PoseFix, config: AerialConfig, at: Attachment, decision: Decision) -> GraphUpdate | None:
    """Return the native factor of the chosen mode; None where the image may be off."""
    return pose.factors(m, config, at, decision) if at.slow_key is None else None


def slow(config: AerialConfig) -> SlowProcess | None:
    """Return the image's misregistration."""
    if config.image_sigma_m == 0.0:
        return None
    return SlowProcess(
        name="image offset",
        axes=("east", "north"),
        units=("m", "m"),
        scale=np.ones(2),
        sigma=np.full(2, config.image_sigma_m),
        time_constant_s=np.full(2, np.inf),
    )


def ideal(at: Attachment, config: AerialConfig) -> PoseFix:
    """Return the noise-free match at the attachment's state."""
    found = pose.ideal(at, config)
    moved = np.zeros(len(config.axes)) if at.slow_value is None else _shown_off(config.axes) @ at.slow_value
    mode = PoseMode(value=found.modes[0].value + moved, cov=found.modes[0].cov)
    return replace(found, sensor="aerial", modes=(mode,))


ROW = replace(
    pose.ROW, kind="aerial", config=AerialConfig, residuals=residuals, factors=factors, ideal=ideal, slow=slow
)
