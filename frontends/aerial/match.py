# SPDX-License-Identifier: Apache-2.0
"""Posterior of the pose over a window, by comparing a scan's outline with the layers of a map, and its modes."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from graphloc.frames import Array
from graphloc.frontends._compiled import compiled
from graphloc.frontends.aerial.image import Pixels
from graphloc.frontends.aerial.layers import Layer, Layers
from graphloc.frontends.aerial.scan import Outline

STEP_DEG = 0.5
_LEAST_SHARE = 0.01  # least share of the posterior that a mode must have
_NARROW, _FINER = 5, 5  # a mode of fewer cells across is interpolated on a grid so much finer
_FLOOR = np.array([0.05, 0.05, np.radians(0.1)])  # least sigmas, m and rad: no image tells more
# A ridge through the whole window that falls by less than so many nats, times the root of its length in m, tells
# nothing along itself. It was measured up to this length; for longer windows the limit stays.
_CHANCE, _MEASURED_M = 2.5, 13.0
_UNTOLD_M = 20.0  # 1 sigma along a ridge: a smaller one would be told by the window, match after match
_ACROSS_M = 0.6  # half width of a ridge
_RIDGE_STEP_DEG = 3.0
# Largest share of a scan's lines across a ridge, if this is of parallel walls; of rows of boats it is 0.33 and more.
_PARALLEL = 0.3
_NOTHING = 1e-9  # least mass, relative to the best pose's, of a piece of a ridge: avoids a division by 0
# TBB, Numba's first choice, warns on stderr if an old version of it is installed.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # type: ignore[attr-defined]


@dataclass(frozen=True, slots=True, eq=False)
class SearchGrid:
    """Candidate poses: yaw (H,) rad, north (R,) m and east (C,) m, in world."""

    yaw_rad: Array
    north_m: Array
    east_m: Array


def grid_around(layers: Layers, prior: Array, half_m: float, half_deg: float) -> SearchGrid:
    """Return the candidates around a pose (3,), east, north, yaw, on the cells of the layers."""
    patch = layers.patch
    column, row = np.rint(patch.cells(prior[None, :2])[0]).astype(int)
    k = np.arange(-int(np.ceil(half_m / patch.cell_m)), int(np.ceil(half_m / patch.cell_m)) + 1)
    h = np.arange(-int(np.ceil(half_deg / STEP_DEG)), int(np.ceil(half_deg / STEP_DEG)) + 1)
    return SearchGrid(
        prior[2] + np.radians(STEP_DEG) * h,
        patch.north_m - (row + k) * patch.cell_m,
        patch.west_m + (column + k) * patch.cell_m,
    )


@compiled(parallel=True, fastmath=True)
def _laid(layer, p_m, angle, weight, yaw, col0, row0, cell_m, turn, rows, columns):  # type: ignore[no-untyped-def]
    """Return the sum over points of weight times layer, for each yaw, row and column of the grid: (H, rows, columns).

    A point is assigned to one of the cells around it by a low-discrepancy sequence. With rounding, all points of a wall
    along the grid would be off by an equal part of a cell.
    """
    bins, height, width = layer.shape
    out = np.zeros((len(yaw), rows, columns), dtype=np.float32)
    for h in numba.prange(len(yaw)):
        c, s = np.cos(yaw[h]), np.sin(yaw[h])
        for i in range(len(p_m)):
            x, y = c * p_m[i, 0] - s * p_m[i, 1], s * p_m[i, 0] + c * p_m[i, 1]
            u = col0 + int(np.floor(x / cell_m + (0.7548776662 * i) % 1.0))
            v = row0 + int(np.floor(-y / cell_m + (0.5698402910 * i) % 1.0))
            if u < 0 or v < 0 or u + columns > width or v + rows > height:
                continue
            k = int(np.rint((angle[i] + yaw[h]) % turn / turn * bins)) % bins
            for r in range(rows):
                for q in range(columns):
                    out[h, r, q] += weight[i] * layer[k, v + r, u + q]
    return out


def log_likelihood_of(found: Outline, layers: Layers, grid: SearchGrid) -> Layer:
    """Return the log-likelihood of each pose of the grid (H, R, C).

    The sum over lines grows with their number, but so do chance and common errors (boats at other berths than in the
    image), so it is divided by the root of the amount of evidence.
    """
    patch = layers.patch
    col0, row0 = np.rint(patch.cells(np.array([[grid.east_m[0], grid.north_m[0]]]))[0]).astype(int)
    scale = 10.0 / np.sqrt(max(found.evidence, 1.0)) * layers.unit

    def lay(layer: Pixels, p_m: Array, angle: Array, weight: Array, turn: float) -> Layer:
        some = weight > 0.0
        return np.asarray(
            _laid(layer, p_m[some], angle[some], (scale * weight[some]).astype(np.float32), grid.yaw_rad, col0, row0,
                  patch.cell_m, turn, len(grid.north_m), len(grid.east_m))
        )  # fmt: skip

    score = lay(layers.low, found.faces_m, found.line_rad, found.face_share * (1.0 - found.tall), np.pi)
    score += lay(layers.tall, found.faces_m, found.line_rad, found.face_share * found.tall, np.pi)
    if layers.shores is not None:
        score += lay(layers.shores, found.shore_m, found.to_land_rad, found.shore_share, 2.0 * np.pi)
    return score


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """A pose (3,): east, north, yaw; its covariance (3, 3) in m and rad; and its probability."""

    pose: Array
    cov: Array
    probability: float


def modes_of(
    log_likelihood: NDArray[np.float32],
    grid: SearchGrid,
    none_log: float,
    alien: float,
    most: int = 5,
    normals: Array | None = None,
) -> tuple[list[Mode], float]:
    """Return the modes of a posterior (H, R, C), best first, and the probability that none is right.

    A ridge that goes straight through the window and hardly falls is one mode, if the lines of the scan go along it as
    well (a quay without an end in view). Its covariance leaves the position along the ridge open: the score varies
    along a wall with the completeness of the map's edges, which tells no position.

    Args:
        log_likelihood, grid: of the poses.
        none_log: log-likelihood of a pose at which the scan fits by chance, relative to the mean of all poses.
        alien: probability that the scan shows something that the image does not, whatever the score.
        most: largest number of modes. normals: (2, 2), see `Outline`; None: no line of the scan lies across a ridge.
    """
    top = float(log_likelihood.max())
    mass = np.exp(log_likelihood.astype(float) - top)
    none = float(np.exp(none_log + log_likelihood.mean() - top)) * mass.size
    total = mass.sum() + none
    peaks = (ndimage.maximum_filter(log_likelihood, 3) == log_likelihood) & (log_likelihood > top - 9.0)
    free = np.ones(mass.shape, dtype=bool)
    profile = ndimage.maximum_filter(log_likelihood.max(axis=0), 3)
    cell_m = abs(float(grid.east_m[1] - grid.east_m[0]))
    found: list[Mode] = []
    spots = np.argwhere(peaks)
    for spot in spots[np.argsort(-log_likelihood[tuple(spots.T)])]:
        if not free[tuple(spot)]:
            continue
        if len(found) == most or mass[free].sum() < _LEAST_SHARE * total:
            break
        height = log_likelihood[tuple(spot)]
        labels, _ = ndimage.label(free & (log_likelihood > height - 4.5))
        part = labels == labels[tuple(spot)]
        along = _open_along(profile, spot[1:], float(height), cell_m)
        if along is not None and normals is not None:
            across = _told(along, normals, float(grid.yaw_rad[spot[0]]))
            along = None if across > _PARALLEL else along
        if along is not None:
            part |= free & _beside(along, spot[1:], mass.shape[1:], cell_m)
        free &= ~part
        share = float(mass[part].sum() / total) * (1.0 - alien)
        cells = np.nonzero(part)
        if share < _LEAST_SHARE or _cut_off(spot, cells, mass.shape):
            continue
        if along is None:
            mean, cov = _moments(log_likelihood, cells, mass, grid)
        else:
            mean, cov = _moments_across(cells, mass, grid, along, cell_m)
        found.append(Mode(mean, cov + np.diag(_FLOOR**2), share))
    return sorted(found, key=lambda m: -m.probability), 1.0 - sum(m.probability for m in found)


def _open_along(profile: NDArray[np.float32], spot: NDArray[np.int64], height: float, cell_m: float) -> Array | None:
    """Return the direction (2,) of a straight ridge through a peak from border to border; None if there is none.

    Args:
        profile: (R, C) highest log-likelihood of any yaw in a cell and its neighbours.
        spot: (2,) row and column of the peak. height: its log-likelihood. cell_m: size of a cell.

    Returns:
        Components along rows and columns.
    """
    size = np.array(profile.shape)
    angle = np.radians(np.arange(0.0, 180.0, _RIDGE_STEP_DEG))
    along = np.column_stack([np.sin(angle), np.cos(angle)])
    steps = np.arange(-int(np.hypot(*size)), int(np.hypot(*size)) + 1)
    at = np.rint(spot + steps[:, None] * along[:, None]).astype(np.int64)
    within = ((at >= 0) & (at < size)).all(axis=2)
    at = np.clip(at, 0, size - 1)
    lowest = np.where(within, profile[at[..., 0], at[..., 1]], np.inf).min(axis=1)
    long = within.sum(axis=1)  # a peak near a corner has short lines
    falls = np.where(long >= 0.9 * size.min(), height - lowest, np.inf)
    best = int(np.argmin(falls))
    return along[best] if falls[best] < _CHANCE * np.sqrt(min(long[best] * cell_m, _MEASURED_M)) else None


def _told(along: Array, normals: Array, yaw_rad: float) -> float:
    """Return the share of a scan's lines that tell the position along a direction (2,), rows and columns, at a yaw."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    ahead = np.array([c * along[1] - s * along[0], -s * along[1] - c * along[0]])  # in body; rows run south
    return float(ahead @ normals @ ahead)


def _beside(along: Array, spot: NDArray[np.int64], shape: tuple[int, ...], cell_m: float) -> NDArray[np.bool_]:
    """Return which cells (R, C) are within `_ACROSS_M` of a line through a peak."""
    row, column = np.indices(shape)
    return np.asarray(
        np.abs((row - spot[0]) * along[1] - (column - spot[1]) * along[0]) * cell_m <= _ACROSS_M + 0.5 * cell_m
    )


def _moments_across(
    part: tuple[NDArray[np.int64], ...], mass: Array, grid: SearchGrid, along: Array, cell_m: float
) -> tuple[Array, Array]:
    """Return mean (3,) and covariance (3, 3) of a ridge, all pieces of its length weighed alike, and open along it."""
    values = np.column_stack([grid.east_m[part[2]], grid.north_m[part[1]], grid.yaw_rad[part[0]]])
    direction = np.array([along[1], -along[0]])  # rows run south
    piece = np.rint((values[:, :2] @ direction) / cell_m).astype(np.int64)
    piece -= piece.min()
    w = mass[part] / np.maximum(np.bincount(piece, mass[part]), _NOTHING)[piece]
    w /= w.sum()
    mean = w @ values
    cov = (values - mean).T @ (w[:, None] * (values - mean))
    ridge = cov[:, :2] @ direction
    ridge /= ridge[:2] @ direction  # with the heading, which may change along the ridge
    return mean, cov + _UNTOLD_M**2 * np.outer(ridge, ridge)


def _cut_off(spot: NDArray[np.int64], cells: tuple[NDArray[np.int64], ...], shape: tuple[int, ...]) -> bool:
    """Return whether a peak is only the slope of a maximum outside: it is at the border of the window, and narrow."""
    return any(at in (0, n - 1) and np.ptp(axis) < _NARROW for at, axis, n in zip(spot, cells, shape, strict=True))


def _moments(
    log_likelihood: NDArray[np.float32], part: tuple[NDArray[np.int64], ...], mass: Array, grid: SearchGrid
) -> tuple[Array, Array]:
    """Return mean (3,) and covariance (3, 3) of a part of the posterior, interpolated along axes with few cells."""
    low, high = (np.array([f(axis) for axis in part]) for f in (np.min, np.max))
    narrow = high - low < _NARROW
    cells = np.stack(part).astype(float)
    w = mass[part]
    if narrow.any():
        low, high = np.maximum(low - narrow, 0), np.minimum(high + narrow, np.array(mass.shape) - 1)
        box = log_likelihood[tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))]
        finer = _FINER if narrow.all() else _FINER - 2  # a long part has cells enough
        steps = [
            np.linspace(0.0, n - 1.0, (n - 1) * (finer if k else 1) + 1) for n, k in zip(box.shape, narrow, strict=True)
        ]
        cells = np.stack(np.meshgrid(*steps, indexing="ij")).reshape(3, -1)
        between = ndimage.map_coordinates(box, cells, order=2, mode="nearest").astype(float)
        w = np.exp(between - between.max()) * (between > between.max() - 9.0)
        cells += low[:, None]
    axes = (grid.east_m, grid.north_m, grid.yaw_rad)
    values = np.column_stack(
        [np.interp(at, np.arange(len(axis)), axis) for at, axis in zip(cells[::-1], axes, strict=True)]
    )
    w = w / w.sum()
    mean = w @ values
    return mean, (values - mean).T @ (w[:, None] * (values - mean))
