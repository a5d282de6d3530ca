# SPDX-License-Identifier: Apache-2.0
"""What an aerial image says about edges and water, as likelihood layers that a scan is laid on.

A layer is (bins, rows, columns), values 0 to 1: how near a cell is to something of that direction. Edges have a
direction without sense (`EDGE_BINS` over 180 deg); shores have one with sense, from water to land (`SHORE_BINS` over
360 deg).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.frontends.aerial.image import Patch, Pixels

Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]
EDGE_BINS, SHORE_BINS = 8, 12
_EDGE_SIGMA_M, _SHORE_SIGMA_M = 0.35, 0.6
_CANNY = (50.0, 130.0)


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Layers of a patch: edges, shores (none where no water is known)."""

    patch: Patch
    edges: Layer
    shores: Layer | None


def _near(where: Mask, sigma_m: float, cell_m: float) -> Layer:
    """exp(-d^2 / 2 sigma^2) of the distance to the next marked cell."""
    if not where.any():
        return np.zeros(where.shape, dtype=np.float32)
    away = cv2.distanceTransform((~where).astype(np.uint8), cv2.DIST_L2, 5) * cell_m
    return np.asarray(np.exp(-0.5 * (away / sigma_m) ** 2), dtype=np.float32)


def edge_layer(patch: Patch) -> Layer:
    """Return edges by the direction of their line, world axes, bin k around k * 180 / EDGE_BINS deg."""
    grey = cv2.GaussianBlur(cv2.cvtColor(patch.pixels, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    dx, dy = (cv2.Sobel(grey, cv2.CV_16S, *d) for d in ((1, 0), (0, 1)))
    edges = cv2.Canny(dx, dy, *_CANNY, L2gradient=True) > 0
    edges &= cv2.erode(patch.inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    # Rows run south: the gradient points (dx, -dy) in world; the line lies across it.
    line = np.arctan2(-dy.astype(np.float32), dx.astype(np.float32)) + 0.5 * np.pi
    return _by_direction(edges, np.mod(line, np.pi), np.pi, EDGE_BINS, _EDGE_SIGMA_M, patch.cell_m)


def shore_layer(patch: Patch, water: Mask) -> Layer:
    """Return shores by the direction from water to land, bin k around k * 360 / SHORE_BINS deg."""
    soft = cv2.GaussianBlur(water.astype(np.float32), (0, 0), 2.0)
    dx, dy = cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)
    shore = ~water & (cv2.dilate(water.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)  # the watershed's own line
    shore &= cv2.erode(patch.inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    to_land = np.mod(np.arctan2(dy, -dx), 2.0 * np.pi)
    return _by_direction(shore, to_land, 2.0 * np.pi, SHORE_BINS, _SHORE_SIGMA_M, patch.cell_m)


def _by_direction(
    where: Mask, angle: NDArray[np.float32], turn: float, bins: int, sigma_m: float, cell_m: float
) -> Layer:
    """A layer of marked cells by their angle; each counts for the bins on both sides of it."""
    at = angle * (bins / turn)
    lower = np.floor(at).astype(int) % bins
    return np.stack([
        _near(where & ((lower == k) | ((lower + 1) % bins == k)), sigma_m, cell_m) for k in range(bins)
    ])  # fmt: skip


def segment_water(patch: Patch, free: Mask, limit: float = 3.0) -> Mask:
    """Return where water is (rows, columns): like the cells that a LiDAR saw to be free water, and joined to them.

    Colour statistics in LAB, robust; darker counts a fifth, so that shadowed water stays water.
    """
    lab: NDArray[np.float32] = cv2.cvtColor(patch.pixels, cv2.COLOR_RGB2LAB).astype(np.float32)
    lab = np.asarray(cv2.GaussianBlur(lab, (0, 0), 1.5), dtype=np.float32)
    seed = free & patch.inside
    if seed.sum() < 50:
        return np.zeros(seed.shape, dtype=bool)
    sample = lab[seed]
    middle = np.median(sample, axis=0)
    spread = 1.4826 * np.median(np.abs(sample - middle), axis=0) + 1.5
    keep = (np.abs(sample - middle) < 3.0 * spread).all(axis=1)
    cov = np.cov(sample[keep].T) + np.diag([4.0, 1.0, 1.0])
    mean = sample[keep].mean(axis=0)
    # In a shadow there is less light of the same colour: chroma (OpenCV's is 128 more) falls with lightness.
    dimmed = np.clip(mean[0] / np.maximum(lab[..., 0], 1.0), 1.0, 3.0)
    off = lab - mean
    off[..., 1:] = (lab[..., 1:] - 128.0) * dimmed[..., None] - (mean[1:] - 128.0)
    off[..., 0] = np.where(off[..., 0] < 0.0, off[..., 0] / 5.0, off[..., 0])
    far2 = np.einsum("ijk,kl,ijl->ij", off, np.linalg.inv(cov), off)
    like = ((far2 < limit**2) & patch.inside).astype(np.uint8)
    like = cv2.morphologyEx(cv2.morphologyEx(like, cv2.MORPH_OPEN, _disc(1)), cv2.MORPH_CLOSE, _disc(3))
    _, labels = cv2.connectedComponents(like)
    touched = np.unique(labels[seed & (like > 0)])
    return _snapped(patch, np.isin(labels, touched[touched > 0]))


def _snapped(patch: Patch, water: Mask) -> Mask:
    """Move the rim of a mask to the edge of the image that it is near: blur has moved it inwards."""
    sure = cv2.erode(water.astype(np.uint8), _disc(1)) > 0
    other = cv2.dilate(water.astype(np.uint8), _disc(4)) == 0
    other |= (cv2.dilate(water.astype(np.uint8), _disc(2)) == 0) & ~_thin(water)
    markers = np.zeros(water.shape, dtype=np.int32)
    markers[sure], markers[other] = 1, 2
    cv2.watershed(patch.pixels, markers)
    return np.asarray((markers == 1) & patch.inside)


def _thin(water: Mask) -> Mask:
    """Land that is narrower than 2 m or so: all of it is near the rim."""
    land = (~water).astype(np.uint8)
    return np.asarray((land > 0) & (cv2.morphologyEx(land, cv2.MORPH_OPEN, _disc(6)) == 0))


def _disc(radius: int) -> Pixels:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), dtype=np.uint8)
