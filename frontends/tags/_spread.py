# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of a single tag's pose beyond the curvature at its minimum.

Seen frontally, a tag's tilt shows as 1 - cos, to second order. The likelihood of a tilt then has two flat wells that
merge, and the distance changes with it along a curve. Here the likelihood is summed over a grid of tilts, with the
other parameters (position, rotation about the normal) optimised at each. The result is the second moment about the
minimum, over the tilts nearer to it than to another minimum.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.frames import Array

_POINTS = 15  # points along a side of the grid
_REACH = 3.5  # half the side of the grid, in sigmas of the curvature's covariance
_STEEPEST_RAD = float(np.radians(70.0))
_ROUNDS = 3
_NEAREST = 0.05  # least share of the tag's distance that a step may leave


def spread(
    corners_m: Array, rays: Array, whiten: Array, R: Array, t_m: Array, curvature: Array, others: Sequence[Array]
) -> tuple[Array, float]:
    """Return the second moment (6, 6) of a tag's pose about a minimum, and the log evidence of the minimum.

    The pose is the position of the tag's middle in camera, then the rotation about the camera's axes.

    Args:
        corners_m: (4, 3) in world. rays: (4, 2). whiten: (8, 8), makes the rays' errors unit and uncorrelated.
        R, t_m: pose of world in camera at the minimum. curvature: (6, 6) covariance by the curvature at the minimum.
        others: attitudes (3, 3) at the other minima.
    """
    there = corners_m @ R.T + t_m
    middle, arms = there.mean(axis=0), there - there.mean(axis=0)
    axes = np.linalg.svd(arms)[2]  # two in the tag's plane, then its normal
    tilt = axes[:2] @ curvature[3:, 3:] @ axes[:2].T
    variance, along = np.linalg.eigh(tilt)
    reach = np.minimum(_REACH * np.sqrt(np.maximum(variance, 1e-12)), _STEEPEST_RAD)
    a, b = np.meshgrid(*(r * np.linspace(-1.0, 1.0, _POINTS) for r in reach))
    w = np.column_stack([a.ravel(), b.ravel()]) @ along.T @ axes[:2]  # (G, 3) tilts about camera's axes
    turned = Rotation.from_rotvec(w).as_matrix()
    tilted = np.einsum("gij,nj->gni", turned, arms)
    normal = turned @ axes[2]
    rest = np.zeros((len(w), 4))  # shift, rotation about the normal
    for _ in range(_ROUNDS):
        r, J = _linear(tilted, normal, middle, rest, rays, whiten)
        A = J.transpose(0, 2, 1) @ J
        step = -np.linalg.solve(A, (J.transpose(0, 2, 1) @ r[:, :, None]))[:, :, 0]
        depth = middle[2] + rest[:, 2]
        rest = rest + step * np.minimum(1.0, (1.0 - _NEAREST) * depth / np.maximum(np.abs(step[:, 2]), 1e-12))[:, None]
    r, J = _linear(tilted, normal, middle, rest, rays, whiten)
    A = J.transpose(0, 2, 1) @ J
    log = -0.5 * np.einsum("gi,gi->g", r, r) - 0.5 * np.linalg.slogdet(A)[1]
    attitude = turned @ R
    own = np.trace(turned, axis1=1, axis2=2)  # the larger, the nearer
    for other in others:
        log = np.where(own >= np.einsum("gij,ij->g", attitude, other), log, -np.inf)
    share = np.exp(log - log.max())
    evidence = float(log.max() + np.log(share.sum() * np.prod(reach)))
    share /= share.sum()
    e = np.hstack([rest[:, :3], w + rest[:, 3:] * normal])
    basis = np.zeros((len(w), 6, 4))
    basis[:, :3, :3], basis[:, 3:, 3] = np.eye(3), normal
    inner = basis @ np.linalg.inv(A) @ basis.transpose(0, 2, 1)
    return np.asarray(np.einsum("g,gi,gj->ij", share, e, e) + np.einsum("g,gij->ij", share, inner)), evidence


def _linear(
    tilted: Array, normal: Array, middle: Array, rest: Array, rays: Array, whiten: Array
) -> tuple[Array, Array]:
    """Return whitened errors (G, 8) of tilted corners (G, 4, 3), and their Jacobian (G, 8, 4) by `rest`."""
    spun = tilted + rest[:, 3, None, None] * np.cross(normal[:, None, :], tilted)
    there = middle + rest[:, None, :3] + spun
    z = np.maximum(there[:, :, 2:], 0.01)
    flat = there[:, :, :2] / z
    projected = np.zeros((*flat.shape, 3))
    projected[:, :, 0, 0] = projected[:, :, 1, 1] = 1.0 / z[:, :, 0]
    projected[:, :, :, 2] = -flat / z
    by_turn = np.einsum("gnij,gnj->gni", projected, np.cross(normal[:, None, :], spun))
    J = np.concatenate([projected, by_turn[..., None]], axis=3).reshape(len(rest), -1, 4)
    return (flat - rays).reshape(len(rest), -1) @ whiten.T, whiten @ J
