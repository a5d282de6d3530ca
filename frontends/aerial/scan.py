# SPDX-License-Identifier: Apache-2.0
"""Edges in a scan: vertical faces with their direction, and the limits of free water.

Points are in the frame `level`: origin and yaw of body, horizontal x-y plane, heights over the waterline.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graphloc.frames import Array

_CELL_M = 0.25
_DRY_M = 0.3  # lower points are water (BL)
_BOAT_M = 2.0  # boats are so high, or up to a metre higher
_SHORE_M = 2.5  # lower returns are of what bounds the water
_NEAR_M = 1.25  # largest distance of neighbours on a line
_SAME_LINE_RAD, _SAME_LINE_M = np.radians(15.0), 0.3
_SECTORS = 360
_NO_LINE = 0.6  # points with a larger weight are on a line of fewer than three points


@dataclass(frozen=True, slots=True, eq=False)
class LevelCloud:
    """Points of one or more scans in `level`.

    Attributes:
        points_m: (N, 3). origin_m: (N, 2) origin of the ray to each point.
        now: number of points, the first ones, that are of the scan itself and not of other turns; None: all.
        turns: number of turns, seen from different positions.
    """

    points_m: Array
    origin_m: Array
    now: int | None = None
    turns: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Features of a scan for the matcher.

    Attributes:
        faces_m: (M, 2) cells of vertical faces. line_rad: (M,) direction of the line through each. tall: (M,) from 0 of
            a face as high as a boat to 1 of one a metre higher. face_share: (M,) weight of each.
        shore_m: (K, 2) first returns: nearest objects behind water. to_land_rad: (K,) direction away from the sensor.
        shore_share: (K,) weight of each. water_m: (L, 2) points seen as free water.
        columns_m: (J, 2) where anything rises out of the water in the scan itself. lowest_m: height over the waterline
            below which a twentieth of its points lies; NaN without points.
        turns: number of turns, seen from different positions. own: outline of the scan itself; None: this is it.
        normals: (2, 2) weighted mean of n n^T, trace 1, over the normals n of the lines through faces and first
            returns, in `level`: d^T normals d is the share of the lines that tell the position along a direction d. A
            point without a line tells it in both directions alike.
    """

    faces_m: Array
    line_rad: Array
    tall: Array
    face_share: Array
    shore_m: Array
    to_land_rad: Array
    shore_share: Array
    water_m: Array
    columns_m: Array
    lowest_m: float = float("nan")
    turns: int = 1
    own: Outline | None = None
    normals: Array = field(default_factory=lambda: 0.5 * np.eye(2))

    @property
    def evidence(self) -> float:
        """Equivalent number of independent faces and first returns."""
        return float(self.face_share.sum() + self.shore_share.sum())


def outline(cloud: LevelCloud, hull: NDArray[np.float64] | None, reach_m: float = 100.0) -> Outline:
    """Return the outline of a cloud, up to a distance `reach_m`.

    Points within `hull` (K, 2), a closed polygon in body, are of the vessel itself, and left out.
    """
    p, away = cloud.points_m, np.hypot(*cloud.points_m[:, :2].T)
    keep = (away < reach_m) & np.isfinite(p[:, 2])  # a distance of NaN fails the comparison
    if hull is not None:
        keep &= ~inside(hull, p[:, :2])
    now = np.arange(len(p)) < (len(p) if cloud.now is None else cloud.now)
    keep &= (keep & now).any()  # a scan without points of its own tells nothing new
    chosen = np.flatnonzero(keep)
    now, p, origin = now[chosen], p.take(chosen, axis=0), cloud.origin_m.take(chosen, axis=0)
    own = None if now.all() else outline(LevelCloud(p[now], origin[now]), None, reach_m)
    dry = p[:, 2] > _DRY_M
    cells, low, high, count = _columns(p[dry])
    # A vertical face is hit at several heights; a roof or a quay's deck, seen at a grazing angle, is not.
    face = (high - low > 0.25) & (count >= 3)
    at = cells[face]
    direction, share = _lines(at, _NEAR_M)
    shore, to_land = _first_returns(p[dry], origin[dry])
    shore_line, shore_share = _lines(shore, 2.0 * _NEAR_M)
    return Outline(
        faces_m=at,
        line_rad=direction,
        tall=np.clip(high[face] - _BOAT_M, 0.0, 1.0),
        face_share=share,
        shore_m=shore,
        to_land_rad=to_land,
        shore_share=shore_share,
        water_m=_free_water(shore, p[~dry]),
        columns_m=own.columns_m if own else cells,
        lowest_m=float(np.quantile(p[now, 2], 0.05)) if now.any() else float("nan"),
        turns=cloud.turns,
        own=own,
        normals=_normals(np.append(direction, shore_line), np.append(share, shore_share)),
    )


def inside(polygon: NDArray[np.float64], points_m: Array) -> NDArray[np.bool_]:
    """Return which points (N, 2) are within a polygon (K, 2)."""
    (west, south), (east, north) = polygon.min(axis=0), polygon.max(axis=0)
    u, v = points_m[:, 0], points_m[:, 1]
    within = (u >= west) & (u <= east) & (v >= south) & (v <= north)  # excludes most points
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = u[within, None], v[within, None]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = (b[:, 0] - a[:, 0]) * (y - a[:, 1]) / (b[:, 1] - a[:, 1]) + a[:, 0]
    within[within] = (spans & (x < crossing)).sum(axis=1) % 2 == 1
    return np.asarray(within)


def _columns(p: Array) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Return points (N, 3) as columns over cells: mean position (M, 2), lowest and highest z (M,), count (M,)."""
    if not len(p):
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64)
    column, row = np.floor(p[:, :2].T / _CELL_M).astype(np.int64)
    key = column * 1_000_003 + row
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    begin = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    count = np.diff(begin, append=len(p))
    total = np.column_stack([np.add.reduceat(p[:, k].take(order), begin) for k in (0, 1)])
    z = p[:, 2].take(order)
    return total / count[:, None], np.minimum.reduceat(z, begin), np.maximum.reduceat(z, begin), count


def _lines(at: Array, near_m: float) -> tuple[Array, Array]:
    """Return the direction (M,), rad, of the line through each point (M, 2) and its neighbours, and its weight (M,).

    The weight is 1 / sqrt(number of points on the line): points of one wall are right or wrong together, so a wall of a
    hundred points tells more than a boat's side of nine, but not eleven times as much.
    """
    if len(at) < 2:
        return np.zeros(len(at)), np.ones(len(at))
    pairs = cKDTree(at).query_pairs(near_m, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    d = at[j] - at[i]
    xx, xy, yy = (np.bincount(i, v, len(at)) for v in (d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2))
    direction = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    turned = np.abs(np.mod(direction[i] - direction[j] + 0.5 * np.pi, np.pi) - 0.5 * np.pi)
    aside = np.abs(d[:, 1] * np.cos(direction[i]) - d[:, 0] * np.sin(direction[i]))
    on_it = (turned < _SAME_LINE_RAD) & (aside < _SAME_LINE_M)
    joined = coo_matrix((np.ones(int(on_it.sum())), (i[on_it], j[on_it])), shape=(len(at), len(at)))
    _, line = connected_components(joined, directed=False)
    return np.asarray(direction), np.asarray(1.0 / np.sqrt(np.bincount(line)[line]))


def _normals(line_rad: Array, share: Array) -> Array:
    """Return `Outline.normals` of points, by the directions of their lines (N,) and their weights (N,)."""
    if not len(share):
        return 0.5 * np.eye(2)
    x, y = np.where(share > _NO_LINE, np.sqrt(0.5), [-np.sin(line_rad), np.cos(line_rad)])
    xy = np.where(share > _NO_LINE, 0.0, x * y)
    return np.asarray(np.array([[share @ x**2, share @ xy], [share @ xy, share @ y**2]]) / share.sum())


def _first_returns(p: Array, origin: Array) -> tuple[Array, Array]:
    """Return the nearest point (K, 2) of each sector that rises out of the water, and its ray's direction (K,), rad."""
    near = np.flatnonzero(p[:, 2] < _SHORE_M)
    d = p.take(near, axis=0)[:, :2]
    away, angle = np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0])
    sector = np.floor((angle + np.pi) / (2.0 * np.pi) * _SECTORS).astype(int) % _SECTORS
    nearest = np.full(_SECTORS, np.inf)
    np.minimum.at(nearest, sector, away)
    found = np.flatnonzero(away == nearest[sector])
    first = found[np.unique(sector[found], return_index=True)[1]]
    ray = d[first] - origin[near[first]]
    return d[first], np.arctan2(ray[:, 1], ray[:, 0])


def _free_water(shore: Array, wet: Array) -> Array:
    """Return points (L, 2) of water: returns from it, and points between the vessel and the first objects."""
    between = [shore * s for s in (0.3, 0.5, 0.7)]
    return np.vstack([wet[:, :2], *[b[np.hypot(*b.T) > 8.0] for b in between]])
