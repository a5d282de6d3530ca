# SPDX-License-Identifier: Apache-2.0
"""BL's matcher as printed (alg. 2 to 5, eq. 3.16), a baseline.

Edges of the image form a binary image, and so do lines through the scan's stacked points; a particle swarm finds the
rotation at which the best shift of one over the other has most pixels in common. The shift is not limited to a window,
and no other maximum is considered: the filter's 2 m gate (alg. 6) does that. The cloud is level, unlike BL's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.config import AerialConfig
from graphloc.frames import Array, wrap_angle
from graphloc.frontends.aerial.image import AerialImage, Patch
from graphloc.frontends.aerial.match import Mode
from graphloc.frontends.aerial.matcher import Match, Prior
from graphloc.frontends.aerial.scan import LevelCloud, inside, outline

Cells = NDArray[np.int64]

# Printed.
_SIDE_M, _SIDE_PX = 150.0, 940  # 938 x 940 there; ours are square
_NEW_IMAGE_M = 5.0  # the image is kept until the estimate is so far from where it was loaded (section 3.4.2)
_DRY_M = 0.3
_MOST_FREQUENT = 3000  # alg. 3
_MORE_THAN = 15  # alg. 4: a grid cell needs more points
_PARTICLES, _ITERATIONS, _SEARCH_DEG = 10, 6, 5.0
_C1, _C2, _W, _V_MAX_DEG = 2.0, 2.0, 0.4, 1.0  # alpha and dt are 1, and so are not written below
_MOST_POINTS = 288_000  # Nm, eq. 3.32
_YAW_VARIANCE_DEG2 = 10.0  # eq. 3.33

# Ours, for what the print leaves open. It cites Matlab's `edge` [38]: its defaults for Canny. With fixed thresholds, or
# other grids or quantiles, a test of 48 views came out much the same.
_BLUR_PX, _NOT_EDGES, _LOW_SHARE = float(np.sqrt(2.0)), 0.7, 0.4
_GRID_PX = 47  # 7.5 m, a twentieth of the image
_TRIALS, _INLIER_PX = 100, 1.5  # RANSAC
_PADDED_PX = 1920  # at least 2 * 940 - 1, so that no shift wraps round (eq. 2.12), and quick to transform

_NO_OUTLINE = outline(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), None)


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Canny's edges B_w of an image.

    Attributes:
        centre_m: (2,) where it was loaded. patch: the image. spectrum: of B_w, padded, in OpenCV's packing for real
            matrices. empty: there is no edge.
    """

    centre_m: Array
    patch: Patch
    spectrum: NDArray[np.float32]
    empty: bool


class BLMatcher:
    """Matches scans to one image as BL does.

    One seed gives the same answers to the same sequence of calls; the swarm's random numbers and the loaded image carry
    over from call to call, as in a run. Of the configuration it uses the hull alone: BL has no window, and no reach but
    that of the image.

    Args:
        config: of an aerial sensor. image: to be matched to. seed: of RANSAC and the swarm.
    """

    def __init__(self, config: AerialConfig, image: AerialImage, seed: int = 0) -> None:
        self._image, self._rng = image, np.random.default_rng(seed)
        self._hull = np.array(config.hull_m, dtype=float) if config.hull_m else None
        self._edges: _Edges | None = None

    def match(self, cloud: LevelCloud, prior: Prior) -> Match:
        """Match a cloud by BL alg. 5, from the prior's pose; the prior's sigmas are not used.

        Returns:
            One mode, of probability 1, at a whole pixel from the prior; or none, and `why_not`. Its covariance is
            R_lidar of eq. 3.33 without a3, which is the filter's: ((Nm / (10 Nk + 1))^2 m^2 twice, 10 deg^2 as rad^2),
            where Nk counts all points of the cloud. `found` is empty: BL's lines are no outline.

        Raises:
            InputError: the image does not cover the prior.
        """
        edges = self._edges_around(prior.pose[:2])
        points = cloud.points_m[np.isfinite(cloud.points_m).all(axis=1)]
        lines_m = self._lines(points, edges.patch, prior.pose)
        if not len(lines_m):
            return Match(prior, _NO_OUTLINE, why_not=f"no part of the image has more than {_MORE_THAN} dry points")
        if edges.empty:
            return Match(prior, _NO_OUTLINE, why_not="the image has no edge around the prior")

        def turned(deg: float) -> Array:
            return np.asarray(prior.pose + np.array([0.0, 0.0, np.radians(deg)]))

        def objective(deg: float) -> float:  # eq. 3.16
            return -float(_correlation(_laid(lines_m, edges.patch, turned(deg)), edges).max())

        pose = turned(_swarm(objective, self._rng))
        pose[:2] += _best_shift_m(_correlation(_laid(lines_m, edges.patch, pose), edges), edges.patch.cell_m)
        pose[2] = float(wrap_angle(pose[2]))
        variance_m2 = (_MOST_POINTS / (10.0 * len(points) + 1.0)) ** 2
        cov = np.diag([variance_m2, variance_m2, _YAW_VARIANCE_DEG2 * np.radians(1.0) ** 2])
        return Match(prior, _NO_OUTLINE, modes=(Mode(pose, cov, 1.0),), none=0.0)

    def _edges_around(self, at_m: Array) -> _Edges:
        if self._edges is None or np.hypot(*(at_m - self._edges.centre_m)) > _NEW_IMAGE_M:
            patch = self._image.patch(at_m, 0.5 * _SIDE_M, _SIDE_M / _SIDE_PX)
            edges = _canny(patch)
            padded = np.pad(edges.astype(np.float32), (0, _PADDED_PX - _SIDE_PX))
            self._edges = _Edges(at_m.copy(), patch, np.asarray(cv2.dft(padded), dtype=np.float32), not edges.any())
        return self._edges

    def _lines(self, points_m: Array, patch: Patch, pose: Array) -> Array:
        """Return X_reduced (M, 2) in level, m, of points (N, 3): selected, most frequent, on lines (section 3.3.4)."""
        keep = points_m[:, 2] >= _DRY_M
        if self._hull is not None:
            keep &= ~inside(self._hull, points_m[:, :2])
        cells = _most_frequent(_laid(points_m[keep, :2], patch, pose))
        _, group = np.unique(cells // _GRID_PX, axis=0, return_inverse=True)
        parts = [cells[group == k] for k in range(group.max(initial=-1) + 1)]
        drawn = [_line(part, self._rng) for part in parts if len(part) > _MORE_THAN]
        if not drawn:
            return np.zeros((0, 2))
        on_lines = np.unique(np.vstack(drawn), axis=0)
        world = np.array([patch.west_m, patch.north_m]) + patch.cell_m * on_lines * np.array([1.0, -1.0])
        return np.asarray((world - pose[:2]) @ _turn(pose[2]))


def _turn(yaw: float) -> Array:
    """Return R (2, 2) of eq. 3.14, from level to the axes of world."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s], [s, c]])


def _laid(points_m: Array, patch: Patch, pose: Array) -> Cells:
    """Return column and row (K, 2), on the image, of points (N, 2) in level, seen from a pose (3,) (eq. 3.13)."""
    cells = np.rint(patch.cells(points_m @ _turn(pose[2]).T + pose[:2])).astype(np.int64)
    return np.asarray(cells[((cells >= 0) & (cells < _SIDE_PX)).all(axis=1)])


def _canny(patch: Patch) -> NDArray[np.bool_]:
    """Return the edges B_w (rows, columns) of the grey image, with thresholds from its gradients as in Matlab."""
    # Times 16: gradients become integers, and a faint one must not be rounded to 0.
    grey = 16.0 * cv2.cvtColor(patch.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    soft = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
    dx, dy = (np.rint(cv2.Sobel(soft, cv2.CV_32F, *d, ksize=1)).astype(np.int16) for d in ((1, 0), (0, 1)))
    steep = np.hypot(dx.astype(np.float32), dy.astype(np.float32))
    count, limits = np.histogram(steep, 64, (0.0, max(float(steep.max()), 1.0)))
    high = float(limits[1:][np.cumsum(count) > _NOT_EDGES * steep.size][0])
    edges = cv2.Canny(dx, dy, _LOW_SHARE * high, high, L2gradient=True) > 0
    # BL's images have no rim; where ours ends, the step to black is no edge.
    return np.asarray(edges & (cv2.erode(patch.inside.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0))


def _most_frequent(cells: Cells) -> Cells:
    """Return the most frequent of pairs (N, 2) as (K, 2) (BL alg. 3); among equals, the first in Matlab's order."""
    pairs, count = np.unique(cells, axis=0, return_counts=True)
    return np.asarray(pairs[np.argsort(-count, kind="stable")[:_MOST_FREQUENT]])


def _line(cells: Cells, rng: np.random.Generator) -> Cells:
    """Return the pixels (L, 2) of the line through pixels (K, 2): RANSAC, then least squares of the inliers."""
    first = rng.integers(len(cells), size=_TRIALS)
    second = (first + rng.integers(1, len(cells), size=_TRIALS)) % len(cells)
    along = (cells[second] - cells[first]).astype(float)
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    away = np.abs(across @ cells.T - (across * cells[first]).sum(axis=1)[:, None])
    fits = away < _INLIER_PX
    inliers = cells[fits[fits.sum(axis=1).argmax()]]
    middle = inliers.mean(axis=0)
    along = np.linalg.svd(inliers - middle, full_matrices=False)[2][0]
    ends = (inliers - middle) @ along
    steps = int(np.ceil(np.ptp(ends) * np.abs(along).max())) + 1
    return np.asarray(np.rint(middle + np.linspace(ends.min(), ends.max(), steps)[:, None] * along), dtype=np.int64)


def _swarm(objective: Callable[[float], float], rng: np.random.Generator) -> float:
    """Return the rotation, deg, with the lowest objective in BL alg. 1; as printed, particles may leave +-5 deg."""
    x = rng.uniform(-_SEARCH_DEG, _SEARCH_DEG, _PARTICLES)
    v = rng.uniform(-_SEARCH_DEG, _SEARCH_DEG, _PARTICLES)
    own, own_f = x.copy(), np.full(_PARTICLES, np.inf)
    swarm, swarm_f = 0.0, np.inf
    for _ in range(_ITERATIONS):
        f = np.array([objective(float(deg)) for deg in x])
        better = f < own_f
        own[better], own_f[better] = x[better], f[better]
        if f.min() < swarm_f:
            swarm, swarm_f = float(x[f.argmin()]), float(f.min())
        q, r = rng.random((2, _PARTICLES))
        v = np.clip(_W * v + _C1 * q * (own - x) + _C2 * r * (swarm - x), -_V_MAX_DEG, _V_MAX_DEG)
        x = x + v
    return swarm


def _correlation(cells: Cells, edges: _Edges) -> NDArray[np.float32]:
    """Return C of eq. 2.17: element (o, l) counts the pixels (K, 2) on edges if shifted o rows down, l columns right.

    Indices beyond the image's side are negative shifts. Counts are rounded to integers, so that rounding errors do not
    decide between equals.
    """
    lit = np.zeros((_PADDED_PX, _PADDED_PX), dtype=np.float32)
    lit[cells[:, 1], cells[:, 0]] = 1.0
    product = cv2.mulSpectrums(edges.spectrum, cv2.dft(lit), 0, conjB=True)
    shared = cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_REAL_OUTPUT | cv2.DFT_SCALE)
    return np.asarray(np.rint(shared), dtype=np.float32)


def _best_shift_m(shared: NDArray[np.float32], cell_m: float) -> Array:
    """Return the shift (2,), m, east and north, of the highest count.

    Among equals it is the smallest one: our choice, since the filter's gate passes no other.
    """
    shifts = np.argwhere(shared == shared.max())
    shifts = np.where(shifts < _SIDE_PX, shifts, shifts - _PADDED_PX)
    down, right = shifts[np.hypot(*shifts.T).argmin()]
    return np.array([right, -down]) * cell_m
