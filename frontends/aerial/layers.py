# SPDX-License-Identifier: Apache-2.0
"""Likelihood layers of edges and water in an aerial image, to which a scan is compared.

A layer is (bins, rows, columns) with values 0 to 1: the proximity to an edge or shore of the bin's direction. Edges
have an undirected orientation (`EDGE_BINS` over 180 deg), shores a direction from water to land (`SHORE_BINS` over 360
deg). Edges are detected on a grid twice as fine: with the blur of a coarse cell, the bright kerb of a quay moves 0.1 m
outwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends.aerial.image import Patch, Pixels
from graphloc.frontends.aerial.vector import VectorMap
from graphloc.signals.series import robust_sigma

Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]
FINE = 2
EDGE_BINS, SHORE_BINS = 8, 12
_EDGE_SIGMA_M, _SHORE_SIGMA_M = 0.25, 0.3
_CANNY = (50.0, 130.0)
_RIM_M = 0.75  # the rim of segmented water is so near to the shore
_LIKE_WATER = 3.0  # a colour within so many sigmas of those of water is water
_MARGIN_M = 0.5  # margin along the border of the image, which is no edge


@dataclass(frozen=True, slots=True)
class Weights:
    """Log-likelihoods of a low and a tall face on an edge, and of a first return on a shore."""

    low: float
    tall: float
    shore: float


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Log-likelihoods in steps of `unit` (whole numbers, 0 to 255).

    Attributes:
        patch: the image on the coarse grid. unit: nats. low, tall: (EDGE_BINS, rows, columns) of low and tall faces.
        shores: (SHORE_BINS, rows, columns) of first returns; None if no water is known.
        drawn: (rows, columns) cells that a user's lines pass through; None without lines.
    """

    patch: Patch
    unit: float
    low: Pixels
    tall: Pixels
    shores: Pixels | None
    drawn: Mask | None = None


def weighed(patch: Patch, sources: Sequence[tuple[Layer, Layer | None, Weights]], drawn: Mask | None) -> Layers:
    """Return the layers of several sources, each (edges, shores, weights), combined by the maximum.

    A sum would count twice what two sources show.
    """
    unit = max(max(w.low, w.tall, w.shore) for _, _, w in sources) / 255.0

    def over(parts: Sequence[tuple[Layer, float]]) -> Pixels:
        most = np.zeros(parts[0][0].shape, dtype=np.uint8)
        for layer, weight in parts:
            for values, so_far in zip(layer, most, strict=True):  # bin by bin, which stays in the processor's cache
                np.maximum(so_far, np.rint(values * np.float32(weight / unit)).astype(np.uint8), out=so_far)
        return most

    shores = [(shore, w.shore) for _, shore, w in sources if shore is not None]
    return Layers(
        patch=patch,
        unit=unit,
        low=over([(edge, w.low) for edge, _, w in sources]),
        tall=over([(edge, w.tall) for edge, _, w in sources]),
        shores=over(shores) if shores else None,
        drawn=drawn,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Canny edges on the fine grid: mask (rows, columns), and gradient's direction (N,) at its cells, rad in world."""

    where: Mask
    gradient_rad: Array


def find_edges(fine: Patch) -> Edges:
    """Return the edges of a patch without its margin."""
    grey = cv2.GaussianBlur(cv2.cvtColor(fine.pixels, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    dx, dy = (cv2.Sobel(grey, cv2.CV_16S, *d) for d in ((1, 0), (0, 1)))
    where = (cv2.Canny(dx, dy, *_CANNY, L2gradient=True) > 0) & _well_inside(fine)
    # Rows run south: the gradient points (dx, -dy) in world.
    return Edges(where, np.arctan2(-dy[where].astype(float), dx[where].astype(float)))


def edge_layer(fine: Patch, edges: Edges) -> Layer:
    """Return the layer of edges by the direction of their line in world, bin k around k * 180 / EDGE_BINS deg."""
    rows, columns = np.nonzero(edges.where)
    return _drawn(fine, rows, columns, edges.gradient_rad + 0.5 * np.pi, np.pi, EDGE_BINS, _EDGE_SIGMA_M)


def shore_layer(fine: Patch, edges: Edges, water: Mask) -> Layer:
    """Return the layer of shores by the direction from water to land, bin k around k * 360 / SHORE_BINS deg.

    The shore is the first edge next to water: the mask of water is eroded, then grown up to the edges within `_RIM_M`
    of its rim, or a little beyond the rim where there are none.

    Args:
        fine, edges: patch and edges on the fine grid. water: (rows, columns) of the coarse grid.
    """
    reach = round(_RIM_M / (FINE * fine.cell_m))
    mask, disc = water.astype(np.uint8), _disc(reach)
    open_to_it = _finer(cv2.dilate(mask, disc), edges.where.shape) & ~edges.where
    grown: NDArray[Any] = _finer(cv2.erode(mask, disc), edges.where.shape).astype(np.uint8)
    may: NDArray[Any] = open_to_it.astype(np.uint8)
    for _ in range(2 * FINE * reach):
        grown = cv2.bitwise_and(cv2.dilate(grown, _CROSS), may)
    shore = (grown == 0) & (cv2.dilate(grown, np.ones((3, 3), np.uint8)) > 0) & _well_inside(fine)
    rows, columns = np.nonzero(shore)
    coarse = cv2.resize(grown.astype(np.float32), water.shape[::-1], interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(coarse, (0, 0), 2.0)
    dx, dy = cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)
    at = (np.minimum(rows // FINE, water.shape[0] - 1), np.minimum(columns // FINE, water.shape[1] - 1))
    to_land = np.arctan2(dy[at].astype(float), -dx[at].astype(float))
    return _drawn(fine, rows, columns, to_land, 2.0 * np.pi, SHORE_BINS, _SHORE_SIGMA_M)


def _finer(mask: NDArray[Any], shape: tuple[int, ...]) -> Mask:
    """Return a mask of the coarse grid on the fine one."""
    return np.asarray(cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def drawn_layers(fine: Patch, drawn: VectorMap) -> tuple[Layer, Layer]:
    """Return the edges and shores of a vector layer within a patch."""
    a, b, kept = _clipped(drawn.segments_m, fine)
    angle = np.arctan2(*(b - a).T[::-1])
    count = np.ceil(np.abs(b - a).max(axis=1) / fine.cell_m).astype(np.int64)  # number of pixels of a line
    which = np.repeat(np.arange(len(a)), count)
    t = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    columns, rows = fine.cells(a[which] + t[:, None] * (b - a)[which]).T
    to_land = drawn.to_land_rad[kept][which]
    sided = np.isfinite(to_land)
    return (
        _drawn(fine, rows, columns, angle[which], np.pi, EDGE_BINS, _EDGE_SIGMA_M),
        _drawn(fine, rows[sided], columns[sided], to_land[sided], 2.0 * np.pi, SHORE_BINS, _SHORE_SIGMA_M),
    )


def _clipped(segments_m: Array, fine: Patch) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return both ends (K, 2) of the parts of segments (S, 2, 2) within a patch, and their indices (Liang-Barsky)."""
    a, d = segments_m[:, 0], segments_m[:, 1] - segments_m[:, 0]
    rows, columns = fine.inside.shape
    low = np.array([fine.west_m, fine.north_m - (rows - 1) * fine.cell_m])
    high = np.array([fine.west_m + (columns - 1) * fine.cell_m, fine.north_m])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.stack([(low - a) / d, (high - a) / d])
    t = np.where(d == 0.0, np.where((a >= low) & (a <= high), [[[-np.inf]], [[np.inf]]], np.nan), t)
    begin, end = np.maximum(t.min(axis=0).max(axis=1), 0.0), np.minimum(t.max(axis=0).min(axis=1), 1.0)
    (kept,) = np.nonzero(end > begin)  # NaN, of a segment beside the patch, fails
    return a[kept] + begin[kept, None] * d[kept], a[kept] + end[kept, None] * d[kept], kept


def _well_inside(patch: Patch) -> Mask:
    side = 2 * round(_MARGIN_M / patch.cell_m) + 1
    return np.asarray(cv2.erode(patch.inside.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _drawn(
    fine: Patch, rows: NDArray[Any], columns: NDArray[Any], angle: Array, turn: float, bins: int, sigma_m: float
) -> Layer:  # fmt: skip
    """Return pixels of lines as a layer of the coarse grid: exp(-d^2 / 2 sigma^2) at a distance d from a single line.

    A pixel counts for the two bins next to its angle. It is weighed by length: an oblique line has fewer pixels.

    Args:
        fine: patch of the pixels. rows, columns, angle: (N,) of each pixel; angle in rad. turn: range of angles, rad.
        bins: of the layer. sigma_m: sigma.
    """
    shape = (fine.inside.shape[0] // FINE, fine.inside.shape[1] // FINE)
    along = angle if turn < 6.0 else angle + 0.5 * np.pi
    weight = 1.0 / (FINE * np.maximum(np.abs(np.cos(along)), np.abs(np.sin(along))))
    lower = np.floor(np.mod(angle, turn) * (bins / turn)).astype(np.int64) % bins
    sigma = sigma_m / (FINE * fine.cell_m)
    # Each pixel is shared out between the four nearest cells, so that lines keep their positions to less than a cell.
    at = (np.stack([rows, columns]) - 0.5 * (FINE - 1)) / FINE
    corner = np.floor(at).astype(np.int64)
    part = at - corner
    counts = np.zeros((bins, shape[0] * shape[1]), dtype=np.float32)
    for dr, dc in ((0, 0), (0, 1), (1, 0), (1, 1)):
        r, c = corner[0] + dr, corner[1] + dc
        keep = (r >= 0) & (c >= 0) & (r < shape[0]) & (c < shape[1])
        share = weight * (part[0] if dr else 1.0 - part[0]) * (part[1] if dc else 1.0 - part[1])
        cell = r[keep] * shape[1] + c[keep]
        for which in (lower[keep], (lower[keep] + 1) % bins):
            np.add.at(counts, (which, cell), share[keep].astype(np.float32))
    layer = np.empty((bins, *shape), dtype=np.float32)
    for k in range(bins):
        soft = cv2.GaussianBlur(counts[k].reshape(shape), (0, 0), sigma)
        layer[k] = np.minimum(soft * (np.sqrt(2.0 * np.pi) * sigma), 1.0)
    return layer


def coarse_patch(fine: Patch) -> Patch:
    """Return a patch with cells twice as wide, each the mean of four cells."""
    rows, columns = (n // FINE * FINE for n in fine.inside.shape)
    size = (columns // FINE, rows // FINE)
    off = 0.5 * (FINE - 1) * fine.cell_m
    return Patch(
        np.asarray(cv2.resize(fine.pixels[:rows, :columns], size, interpolation=cv2.INTER_AREA), dtype=np.uint8),
        fine.inside[:rows:FINE, :columns:FINE],
        fine.west_m + off,
        fine.north_m - off,
        FINE * fine.cell_m,
    )


def segment_water(patch: Patch, free: Mask) -> Mask:
    """Return where water is (rows, columns): cells that look like the free water a LiDAR saw, and are connected to it.

    Colours are compared in LAB by robust statistics. A darker lightness counts a fifth, so that water in shadow stays
    water. The blur keeps the rim some decimetres inside the shore.

    Args:
        patch: the image. free: (rows, columns) cells that a LiDAR saw as free water.
    """
    lab: NDArray[np.float32] = cv2.cvtColor(patch.pixels, cv2.COLOR_RGB2LAB).astype(np.float32)
    lab = np.asarray(cv2.GaussianBlur(lab, (0, 0), 1.5), dtype=np.float32)
    seed = free & patch.inside
    if seed.sum() < 50:
        return np.zeros(seed.shape, dtype=bool)
    sample = lab[seed]
    middle = np.median(sample, axis=0)
    spread = robust_sigma(sample - middle) + 1.5
    keep = (np.abs(sample - middle) < 3.0 * spread).all(axis=1)
    cov = np.cov(sample[keep].T) + np.diag([4.0, 1.0, 1.0])
    mean = sample[keep].mean(axis=0).astype(np.float32)
    # In shadow there is less light of the same colour: chroma, of which 128 is OpenCV's 0, falls with lightness.
    dimmed = np.clip(mean[0] / np.maximum(lab[..., 0], 1.0), 1.0, 3.0)
    off = lab - mean
    off[..., 1:] = (lab[..., 1:] - 128.0) * dimmed[..., None] - (mean[1:] - 128.0)
    off[..., 0] = np.where(off[..., 0] < 0.0, off[..., 0] / 5.0, off[..., 0])
    white = off @ np.linalg.cholesky(np.linalg.inv(cov)).astype(np.float32)
    like = ((np.square(white).sum(axis=2) < _LIKE_WATER**2) & patch.inside).astype(np.uint8)
    like = cv2.morphologyEx(cv2.morphologyEx(like, cv2.MORPH_OPEN, _disc(1)), cv2.MORPH_CLOSE, _disc(3))
    _, labels = cv2.connectedComponents(like)
    touched = np.zeros(labels.max() + 1, dtype=bool)
    touched[labels[seed & (like > 0)]] = True
    touched[0] = False
    return np.asarray(touched[labels])


def _disc(radius: int) -> Pixels:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), dtype=np.uint8)


_CROSS = np.asarray(cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), dtype=np.uint8)
