# SPDX-License-Identifier: Apache-2.0
"""Undistorted image that touches a camera's image at a point; sides of tags are straight in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphloc.frames import Array
from graphloc.frontends.tags.camera import CameraModel


@dataclass(frozen=True, slots=True, eq=False)
class Unbowed:
    """A pinhole image tangent to the lens's image at a point: the same there, to first order.

    Its points, flat = middle + J (ray - ray of the middle), differ by fractions of a pixel from those of the image near the
    middle, at the same sharpness. J is the lens's d px / d ray at the middle.

    Attributes:
        middle_px: (2,) of the image. ray: (1, 2) there. J_px: (2, 2).
    """

    lens: CameraModel
    middle_px: Array
    ray: Array
    J_px: Array

    def flat(self, px: Array) -> Array:
        """Return undistorted points (N, 2), px, of points of the image; NaN where no ray leads to them."""
        return np.asarray(self.middle_px + (self.lens.rays(px) - self.ray) @ self.J_px.T)

    def bowed(self, flat_px: Array) -> Array:
        """Return points (N, 2), px, of the image at undistorted ones; NaN where the lens has none."""
        return self.lens.project(self._rays(flat_px))

    def slope(self, flat_px: Array) -> Array:
        """Return d bowed / d flat (N, 2, 2)."""
        return np.asarray(self.lens.jacobian(self._rays(flat_px)) @ np.linalg.inv(self.J_px))

    def _rays(self, flat_px: Array) -> Array:
        return np.asarray(self.ray + (flat_px - self.middle_px) @ np.linalg.inv(self.J_px).T)


def unbowed(lens: CameraModel | None, corners_px: Array) -> Unbowed | None:
    """Return the undistorted image at a tag's corners (4, 2); None if there is no distortion, or there are no rays."""
    if lens is None or lens.model == "none":
        return None
    points = np.vstack([corners_px, corners_px.mean(axis=0)])
    rays = lens.rays(points)
    if not np.isfinite(rays).all():
        return None
    return Unbowed(lens, points[4], rays[4:], lens.jacobian(rays[4:])[0])
