# SPDX-License-Identifier: Apache-2.0
"""Covariances in the axes of world, and errors of a position that they do not contain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from graphloc.frames import Array, skew
from graphloc.graph import SlowProcess

ANY_HEADING_RAD = float(np.pi / np.sqrt(3.0))
"""1 sigma of a heading of which nothing is known."""


def world_covariance(cov_body: Any, R: Array, lever_m: Array) -> Array:
    """Return a body-tangent covariance (rotation first) as that of x, y, z, rotation, all about the world's axes.

    It is for the point `lever_m` (body axes) from the state. Only the blocks are rotated: the full adjoint would mix
    yaw times distance from the datum into position.
    """
    turn = to_world(R, lever_m)
    return np.asarray(turn @ np.asarray(cov_body) @ turn.T)


def to_world(R: Array, lever_m: Array) -> Array:
    """Return d (place of a point, rotation; world's axes) / d body tangent (6, 6)."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = -R @ skew(lever_m)
    turn[:3, 3:], turn[3:, :3] = R, R
    return turn


def limit_heading(cov: Array) -> None:
    """Scale the heading in covariances (..., 6, 6), in axes of world, to at most that of an unknown heading.

    Linearised, a heading that is hardly known is stated as uncertain by many turns.
    """
    share = np.minimum(1.0, ANY_HEADING_RAD / np.sqrt(cov[..., 5, 5]))[..., None]
    cov[..., 5, :] *= share
    cov[..., :, 5] *= share


def widen_heading(cov: Array, heading_var: Array | float) -> None:
    """Raise the variance of the heading in covariances (..., 6, 6), in axes of world, to at least `heading_var`, rad^2.

    What measures position (an antenna) stays where it is, and the body turns about it. The arm between the two follows
    from the covariance of position and heading. Turned by tens of degrees, the body moves along the arm as well as
    across.

    Args:
        heading_var: (...), rad^2.
    """
    more = np.maximum(heading_var - cov[..., 5, 5], 0.0)
    across = cov[..., :2, 5] / cov[..., 5, 5, None]  # d position / d heading, m
    along = np.stack([-across[..., 1], across[..., 0]], axis=-1)
    shares = (0.5 * (1.0 - np.exp(-2.0 * more)), 1.5 - 2.0 * np.exp(-0.5 * more) + 0.5 * np.exp(-2.0 * more))
    for arm, share in zip((across, along), shares, strict=True):  # means of sin^2 and (1 - cos)^2
        cov[..., :2, :2] += share[..., None, None] * arm[..., :, None] * arm[..., None, :]
    cov[..., 5, 5] += more


class Unmodelled(NamedTuple):
    """Covariances to add, (N, 3, 3) each, in world axes.

    Attributes:
        rotation: rad^2. velocity: m^2/s^2.
    """

    rotation: Array
    velocity: Array


def untold_errors(streams: Sequence[Any]) -> dict[str, SlowProcess]:
    """Return, by sensor, the slow errors (east, north, up) that nothing can tell from motion.

    Up is 0 for a sensor whose heights are not used (`Stream.without_height`).
    """
    return {
        s.name: replace(s.left_out, sigma=s.left_out.sigma * [1.0, 1.0, not s.without_height])
        for s in streams
        if s.left_out is not None
    }


def unmodelled_covariance(streams: Sequence[Any]) -> Array:
    """Return the covariance (3, 3) of the position from slow errors that nothing can tell from motion."""
    return sum((np.diag(slow.sigma**2) for slow in untold_errors(streams).values()), np.zeros((3, 3)))
