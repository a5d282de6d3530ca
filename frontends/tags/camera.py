# SPDX-License-Identifier: Apache-2.0
"""Cameras: from image points to rays in the optical frame and back, by `sensor_msgs/CameraInfo`.

A ray is (x/z, y/z) in the optical frame (x right, y down, z forward); image points are px, (0, 0) is the centre of the
top-left pixel. The lens d, from rays to rays, is one of OpenCV's models:

    px = K[:2, :2] d(ray) + K[:2, 2].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array

# Models of `sensor_msgs/distortion_models.hpp`, with the numbers of coefficients that OpenCV takes.
_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
_ALIASES = {"fisheye": "equidistant", "kannala_brandt4": "equidistant"}
_WIDEST_RAD = np.radians(89.9)  # x/z grows beyond all bounds at 90 deg
_CLOSE = 1e-9  # tolerance of a ray: 1e-6 px at a focal length of 1000 px
_STEPS = 20  # most of Newton's steps; three or four are usual


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """A camera and its lens.

    Attributes:
        width_px, height_px: of its images; 0 if unknown.
        K: (3, 3), from rays that the lens has distorted to px.
        model: 'plumb_bob', 'rational_polynomial', 'equidistant' or 'none'.
        distortion: the model's coefficients (n,) in OpenCV's order.
    """

    width_px: int
    height_px: int
    K: Array
    model: str
    distortion: Array

    def rays(self, corners_px: Array) -> Array:
        """Return the rays (N, 2) of image points (N, 2), with distortion removed.

        A model may fold: k1 = -0.5 maps rays beyond 0.82 back inwards. Of several rays of one point, the one within the
        fold is returned. NaN where a point has no ray: outside the image of a lens that folds, close to the fold, and
        from 89.9 deg off the axis on.
        """
        flat = (corners_px - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        if self.model == "none" or not len(flat):
            return np.asarray(flat)
        radii, seen = _radii(self.model, tuple(self.distortion))
        away = np.linalg.norm(flat, axis=1, keepdims=True)
        found = flat * np.interp(away, seen, radii) / np.maximum(away, 1e-12)
        with np.errstate(all="ignore"):  # points without a ray may take steps to anywhere
            for _ in range(_STEPS):
                there, slope = self._through_lens(found)
                miss = flat - there
                good = (np.abs(miss) < _CLOSE).all(axis=1)
                if good.all():
                    break
                (a, b), (c, d) = slope.transpose(1, 2, 0)
                x, y = miss.T
                found = found + np.column_stack([d * x - b * y, a * y - c * x]) / (a * d - b * c)[:, None]
            found[~(good & self._within(found, slope))] = np.nan
        return np.asarray(found)

    def project(self, rays: Array) -> Array:
        """Return the image points (N, 2), px, of rays (N, 2); NaN where `rays` would not return the ray again."""
        if self.model == "none" or not len(rays):
            flat = rays
        else:
            flat, slope = self._through_lens(rays)
            flat[~self._within(rays, slope)] = np.nan
        return np.asarray(flat @ self.K[:2, :2].T + self.K[:2, 2])

    def jacobian(self, rays: Array) -> Array:
        """Return d px / d ray (N, 2, 2) at rays (N, 2), so that cov_px = J cov_rays J^T."""
        if self.model == "none" or not len(rays):
            return np.tile(self.K[:2, :2], (len(rays), 1, 1))
        return np.asarray(self.K[:2, :2] @ self._through_lens(rays)[1])

    def check_size(self, width_px: int, height_px: int) -> None:
        """Raise a `ValueError` if an image does not have the size of the camera's images, where that is known."""
        if not self.width_px or not self.height_px or (width_px, height_px) == (self.width_px, self.height_px):
            return
        hint = ""
        if width_px * self.height_px == height_px * self.width_px:
            hint = f": it is for the image {'before' if width_px < self.width_px else 'after'} resizing"
        raise ValueError(
            f"an image of {width_px} x {height_px} px with a CameraInfo for {self.width_px} x {self.height_px} px{hint}"
        )

    def _through_lens(self, rays: Array) -> tuple[Array, Array]:
        return _distorted(self.model, self.distortion, rays)

    def _within(self, rays: Array, slope: Array) -> NDArray[np.bool_]:
        """Return (N,) whether the lens's model can be inverted at rays (N, 2), that is within its fold."""
        radii, _ = _radii(self.model, tuple(self.distortion))
        return np.asarray((np.linalg.norm(rays, axis=1) <= radii[-1]) & (np.linalg.det(slope) > 0.0))


def _distorted(model: str, distortion: Array, rays: Array) -> tuple[Array, Array]:
    """Return d(ray) (N, 2) and its derivative (N, 2, 2).

    At z = 1 a shift of the ray equals a translation of the camera, for which OpenCV gives the derivative.
    """
    points = np.column_stack([rays, np.ones(len(rays))])[:, None]
    still, plain = np.zeros(3), np.eye(3)
    if model == "equidistant":
        flat, J = cv2.fisheye.projectPoints(points, still, still, plain, distortion)  # J: f, c, k, turn, translation
        first = 11
    else:
        flat, J = cv2.projectPoints(points, still, still, plain, distortion)  # J: turn, translation, f, c, k
        first = 3
    slope = np.asarray(J, dtype=float)[:, first : first + 2]
    return np.asarray(flat, dtype=float).reshape(-1, 2), slope.reshape(-1, 2, 2)


@lru_cache(maxsize=64)
def _radii(model: str, distortion: tuple[float, ...]) -> tuple[Array, Array]:
    """Return the lengths of rays (n,), ascending, and of the distorted rays (n,), up to the fold of the model.

    They are of the radial part only, without tangential terms, prism and tilt.
    """
    round_only = np.array(distortion)
    if model != "equidistant":
        round_only[2:4] = round_only[8:] = 0.0
    radii = np.tan(np.linspace(0.0, _WIDEST_RAD, 2000))
    seen = _distorted(model, round_only, np.column_stack([radii, np.zeros(len(radii))]))[0][:, 0]
    falling = np.flatnonzero(~(np.diff(seen) > 0.0))
    count = falling[0] + 1 if len(falling) else len(radii)
    return radii[:count], seen[:count]


def camera_of(msg: Any, *, rectified: bool) -> CameraModel:
    """Return the camera of a `sensor_msgs/CameraInfo` of ROS 1 or 2.

    Region of interest and binning are applied: a pixel of the image is the mean of `binning` pixels of the region. This
    shifts its centre by a fraction of a pixel, which `image_geometry` omits.

    Args:
        msg: the message.
        rectified: whether the images are `image_rect`: then P is their matrix, and they have no distortion. Rays are in
            the axes of the rectified image, which for a stereo camera are rotated by R from its optical frame.

    Raises:
        ValueError: the message has no calibration, or an unknown lens model.
    """
    K = _matrix(msg, rectified=rectified)
    model, distortion = ("none", np.empty(0)) if rectified else _lens(msg)
    roi = msg.roi
    offset = np.array([roi.x_offset, roi.y_offset])
    binning = np.array([msg.binning_x or 1, msg.binning_y or 1])  # 0 means 1
    to_image = np.diag([*(1.0 / binning), 1.0])
    to_image[:2, 2] = (0.5 - offset) / binning - 0.5
    whole = np.maximum(np.array([msg.width, msg.height]) - offset, 0)
    width, height = np.where([roi.width, roi.height], [roi.width, roi.height], whole) // binning
    return CameraModel(int(width), int(height), to_image @ K, model, distortion)


def _matrix(msg: Any, *, rectified: bool) -> Array:
    name = "P" if rectified else "K"
    values = _field(msg, name).reshape(3, -1)[:, :3]
    if not values.any():
        raise ValueError(f"a CameraInfo whose {name} is all zeros: the camera is not calibrated")
    if not np.isfinite(values).all():
        raise ValueError(f"a CameraInfo whose {name} is not finite")
    if values[0, 0] <= 0.0 or values[1, 1] <= 0.0:
        raise ValueError(f"a CameraInfo whose focal lengths in {name} are {values[0, 0]:g} and {values[1, 1]:g} px")
    if values[1, 0] != 0.0 or (values[2] != (0.0, 0.0, 1.0)).any():
        raise ValueError(f"a CameraInfo whose {name} is no camera matrix: [fx, s, cx; 0, fy, cy; 0, 0, 1]")
    return values


def _lens(msg: Any) -> tuple[str, Array]:
    """Return model and coefficients (n,). Zero coefficients mean no distortion, except for an equidistant lens."""
    named = str(msg.distortion_model)
    model = _ALIASES.get(named.strip().lower(), named.strip().lower())
    coefficients = _field(msg, "D")
    if not np.isfinite(coefficients).all():
        raise ValueError("a CameraInfo whose D is not finite")
    if model not in (*_COUNTS, "", "none"):
        raise ValueError(f"a CameraInfo with the unknown distortion model '{named}' (known: {', '.join(_COUNTS)})")
    if model != "equidistant" and not coefficients.any():
        return "none", np.empty(0)
    if model not in _COUNTS:
        raise ValueError(f"a CameraInfo with {len(coefficients)} distortion coefficients but no distortion model")
    if len(coefficients) not in _COUNTS[model]:
        expected = " or ".join(map(str, _COUNTS[model]))
        raise ValueError(f"a CameraInfo with {len(coefficients)} coefficients for {model}, which has {expected}")
    return model, coefficients


def _field(msg: Any, name: str) -> Array:
    """Return the values of a field that ROS 1 spells K and ROS 2 k."""
    return np.array(getattr(msg, name.lower() if hasattr(msg, name.lower()) else name), dtype=float).ravel()
