# SPDX-License-Identifier: Apache-2.0
"""An undistorted image, tangent to a camera's image at a point, in which the sides of tags are straight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphloc.frames import Array
from graphloc.frontends.tags.camera import CameraModel


@dataclass(frozen=True, slots=True, eq=False)
class Unbowed:
    """A pinhole image that equals the lens's image near a point, the middle, to first order.

    Its points are flat = middle + J (ray - ray of the middle), where J is the lens's d px / d ray at the middle. Near
    the middle they differ from points of the lens's image by fractions of a pixel, and the sharpness is the same.

    Attributes:
        lens: camera and lens. middle_px: (2,) the middle. ray: (1, 2) its ray. J_px: (2, 2) J.
    """

    lens: CameraModel
    middle_px: Array
    ray: Array
    J_px: Array

    def flat(self, px: Array) -> Array:
        """Return the undistorted points (N, 2), px, of points of the camera's image; NaN where these have no ray."""
        return np.asarray(self.middle_px + (self.lens.rays(px) - self.ray) @ self.J_px.T)

    def bowed(self, flat_px: Array) -> Array:
        """Return the points (N, 2), px, of the camera's image, of undistorted points; NaN where the lens has none."""
        return self.lens.project(self._rays(flat_px))

    def slope(self, flat_px: Array) -> Array:
        """Return d bowed / d flat (N, 2, 2)."""
        return np.asarray(self.lens.jacobian(self._rays(flat_px)) @ np.linalg.inv(self.J_px))

    def _rays(self, flat_px: Array) -> Array:
        return np.asarray(self.ray + (flat_px - self.middle_px) @ np.linalg.inv(self.J_px).T)


def unbowed(lens: CameraModel | None, corners_px: Array) -> Unbowed | None:
    """Return the undistorted image at a tag's corners (4, 2); None without distortion, or if a corner has no ray."""
    if lens is None or lens.model == "none":
        return None
    points = np.vstack([corners_px, corners_px.mean(axis=0)])
    rays = lens.rays(points)
    if not np.isfinite(rays).all():
        return None
    return Unbowed(lens, points[4], rays[4:], lens.jacobian(rays[4:])[0])
