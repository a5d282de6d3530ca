# SPDX-License-Identifier: Apache-2.0
"""Warnings on points that stay with the vessel from scan to scan, and on points under the water.

Points that stay are of the vessel herself, where `hull_m` does not contain her. They are the first returns in their
direction, and hide what could be matched: without `hull_m` no scan of a launch with a LiDAR on its mast matched, and
the reason given was that no pose stands out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graphloc.frames import Array
from graphloc.frontends.aerial.scan import Outline

_CELL_M = 0.5
_AWAY_M = 25.0  # points farther from the origin of body are not counted: half the length of a large vessel
_FEWEST_SCANS = 10
_MOVED_M = 20.0  # before the vessel has moved so far, what stands still seems to stay with her
# Least share of the scans in which a cell that stays has a point: of a launch 39 of 70 cells, all others 0.7 at most.
_STAYS = 0.8
# Largest distance of the vessel's nearest cell to a LiDAR or a corner of the hull; a quay that she goes along stays as
# well, but is farther off.
_CLOSE_M = 3.0
_GAP_M = 1.5
_WALL = "a wall that she went along all the time"  # of a lock or canal, if it is that close
_FEWEST_CELLS = 8
_UNDER_M = 1.0  # nothing so deep is hit, apart from waves, tilts and mirror images of walls in calm water


class Staying:
    """Counts in how many scans each place of the vessel's surroundings holds a point above the water.

    Args:
        hull_m: corners [forward, port] of the hull in body, m; may be empty. lidars_m: (t (3,) m) of the LiDARs in
            body.
    """

    def __init__(self, hull_m: Sequence[tuple[float, float]], lidars_m: Iterable[Array]) -> None:
        self._hull = len(hull_m) > 0
        self._known_m = np.array([*hull_m, *(t[:2] for t in lidars_m)]).reshape(-1, 2)
        self._held: Counter[tuple[int, int]] = Counter()
        self._places: list[Array] = []
        self._lowest_m: list[float] = []

    def take(self, found: Outline, place_m: Array) -> None:
        """Count a scan's points outside the hull; `place_m`: (2,) position of the vessel in world."""
        near = found.columns_m[np.hypot(*found.columns_m.T) < _AWAY_M]
        self._held.update({(int(x), int(y)) for x, y in np.unique(np.floor(near / _CELL_M), axis=0)})
        self._places.append(place_m)
        self._lowest_m += [found.lowest_m] if np.isfinite(found.lowest_m) else []

    def said(self) -> list[str]:
        """Return warnings on points under the water, and on points that stay with the vessel."""
        return [*self._under_water(), *self._staying()]

    def _under_water(self) -> list[str]:
        lowest_m = float(np.median(self._lowest_m)) if len(self._lowest_m) >= _FEWEST_SCANS else 0.0
        if lowest_m > -_UNDER_M:
            return []
        wrong = "waterline_m, or the height of a LiDAR's mount, is wrong by about that"
        return [f"points lie {-lowest_m:.1f} m under the water and deeper: {wrong}"]

    def _staying(self) -> list[str]:
        """Return a warning that names the rectangle of points that stay with the vessel, if there are such points."""
        scans = len(self._places)
        if scans < _FEWEST_SCANS or np.ptp(self._places, axis=0).max() < _MOVED_M:
            return []
        cells = np.array([cell for cell, count in self._held.items() if count >= _STAYS * scans], dtype=float)
        own = self._hanging_together((cells.reshape(-1, 2) + 0.5) * _CELL_M)
        if len(own) < _FEWEST_CELLS:
            return []
        (x0, y0), (x1, y1) = own.min(axis=0) - 0.5 * _CELL_M, own.max(axis=0) + 0.5 * _CELL_M
        box = f"[[{x0:g}, {y0:g}], [{x1:g}, {y0:g}], [{x1:g}, {y1:g}], [{x0:g}, {y1:g}]]"
        seen = f"in {scans} scans points"
        if not self._hull:
            return [
                f"hull_m is empty, and {seen} stay with the vessel: herself, unless {_WALL}; give her outline, at least hull_m: {box}"
            ]
        water = "spray or rain, water, by a waterline_m that is too low or a LiDAR's mount upside down"
        return [f"{seen} outside hull_m stay with the vessel, within {box}: herself, {water}, or {_WALL}"]

    def _hanging_together(self, cells_m: Array) -> Array:
        """Return the cells (N, 2) that are connected with cells close to a LiDAR or a corner of the hull."""
        if not len(cells_m):
            return cells_m
        tree = cKDTree(cells_m)
        _, part = connected_components(tree.sparse_distance_matrix(tree, _GAP_M), directed=False)
        away_m, _ = cKDTree(self._known_m).query(cells_m)
        return np.asarray(cells_m[np.isin(part, part[away_m < _CLOSE_M])])
