# SPDX-License-Identifier: Apache-2.0
"""The map to which scans are matched: an image, a user's lines, or both. Layers are computed once for each tile."""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphloc.config import AerialConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.frontends.aerial.image import AerialImage, Patch
from graphloc.frontends.aerial.layers import (
    FINE,
    Layer,
    Layers,
    Weights,
    coarse_patch,
    drawn_layers,
    edge_layer,
    find_edges,
    segment_water,
    shore_layer,
    weighed,
)
from graphloc.frontends.aerial.scan import Outline
from graphloc.frontends.aerial.vector import VectorMap, read_vector

log = logging.getLogger(__name__)

_CELL_M = 0.25
_TILE_M = 100.0  # a patch serves all priors of one tile
_KEPT = 4  # patches that are kept, about 50 MB each
_ON_IT = 0.7  # a line passes through cells with a larger value of its layer
_TRIES = 3  # a disk may have failed
_MORE_WATER = 2.0  # times as much water as the last time, with which shores are looked for again where none were found

# Fitted by benchmarks/tune_matcher.py on harbours drawn by chance; docs/decisions/0006. On an image a tall face may be
# on a shadow as well; on a drawn line it is a house, since no boat is as tall.
ON_IMAGE, ON_LINES = Weights(low=0.88, tall=0.50, shore=1.70), Weights(low=0.74, tall=2.60, shore=1.74)


class Map:
    """Layers of `image` and `vector` of an aerial sensor, part by part.

    Args:
        config: of the aerial sensor. folder: base of relative paths. datum: origin of world.
        on_image, on_lines: weights of edges of the image and of lines, given to fit them; default: the fitted ones.

    Raises:
        InputError: neither is given, or one cannot be used.
    """

    def __init__(
        self, config: AerialConfig, folder: Path, datum: Datum, on_image: Weights = ON_IMAGE, on_lines: Weights = ON_LINES
    ) -> None:  # fmt: skip
        if not config.image and not config.vector:
            raise InputError("vessel.yaml: an aerial sensor needs an `image`, a `vector` layer, or both")
        self._image = AerialImage(folder / config.image, datum) if config.image else None
        self._drawn = read_vector(folder / config.vector, datum) if config.vector else None
        if self._drawn is not None and self._image is None and not np.isfinite(self._drawn.to_land_rad).any():
            log.warning(
                "%s: none of its lines says on which side land is (docs/aerial.md), so they are no shores",
                config.vector,
            )
        self._half_m = config.reach_m + 0.5 * _TILE_M + config.window_m
        self._weights = (on_image, on_lines)
        self._kept: dict[tuple[int, int], Layers] = {}
        self._beyond: dict[tuple[int, int], str] = {}  # why a tile has no layers; each scan in it asks
        self._failed: Counter[tuple[int, int]] = Counter()
        self._water: dict[tuple[int, int], int] = {}  # cells of water in the scan by which a tile was made

    def around(self, pose: Array, found: Outline) -> Layers:
        """Return the layers around a pose (3,); water is where the image looks like the water that a scan saw there.

        Raises:
            InputError: the map does not cover it.
        """
        tile = (int(pose[0] // _TILE_M), int(pose[1] // _TILE_M))
        if tile in self._beyond:
            raise InputError(self._beyond[tile])
        layers = self._kept.pop(tile, None)
        if layers is None or (layers.shores is None and self._shows_more_water(tile, found)):
            try:
                layers = self._made((np.array(tile) + 0.5) * _TILE_M, pose, found)
            except InputError as error:
                self._failed[tile] += 1
                if self._failed[tile] >= _TRIES:
                    self._beyond[tile] = str(error)
                raise
            self._water[tile] = len(found.water_m)
        while len(self._kept) >= _KEPT:
            self._kept.pop(next(iter(self._kept)))
        self._kept[tile] = layers  # at the end: the least recently used is dropped first
        return layers

    def _shows_more_water(self, tile: tuple[int, int], found: Outline) -> bool:
        """Whether a scan may show a shore of the image where the one by which the tile was made did not.

        A first scan among boats, or in a dry dock, shows no water. Making a tile takes seconds, so not each scan does it.
        """
        return self._image is not None and len(found.water_m) > _MORE_WATER * self._water[tile]

    def _made(self, middle_m: Array, pose: Array, found: Outline) -> Layers:
        cell = _CELL_M / FINE
        fine = (
            _blank(middle_m, self._half_m, cell)
            if self._image is None
            else self._image.patch(middle_m, self._half_m, cell)
        )
        coarse = coarse_patch(fine)
        sources: list[tuple[Layer, Layer | None, Weights]] = []
        drawn = None
        if self._image is not None:
            edges = find_edges(fine)
            water = segment_water(coarse, _seen_water(coarse, pose, found))
            shores = shore_layer(fine, edges, water) if water.any() else None
            sources.append((edge_layer(fine, edges), shores, self._weights[0]))
        if self._drawn is not None:
            lines, shores = drawn_layers(fine, self._near(self._drawn, middle_m))
            sources.append((lines, shores, self._weights[1]))
            drawn = lines.max(axis=0) > _ON_IT
        return weighed(coarse, sources, drawn)

    def _near(self, drawn: VectorMap, middle_m: Array) -> VectorMap:
        near = drawn.around(middle_m, self._half_m)
        if self._image is None and not len(near.segments_m):
            raise InputError(
                f"the vector layer has no line around {middle_m[0]:.0f} m east, {middle_m[1]:.0f} m north of the datum"
            )
        return near


def _blank(middle_m: Array, half_m: float, cell_m: float) -> Patch:
    """Return a patch without data."""
    n = int(np.ceil(2.0 * half_m / cell_m))
    corner = half_m - 0.5 * cell_m
    return Patch(
        np.zeros((n, n, 3), dtype=np.uint8), np.ones((n, n), dtype=bool), middle_m[0] - corner, middle_m[1] + corner, cell_m
    )  # fmt: skip


def _seen_water(patch: Patch, pose: Array, found: Outline) -> NDArray[np.bool_]:
    """Return the cells (rows, columns) that the scan saw as water, if the pose is right."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    at = found.water_m @ np.array([[c, s], [-s, c]]) + pose[:2]
    cells = np.rint(patch.cells(at)).astype(int)
    free = np.zeros(patch.inside.shape, dtype=bool)
    cells = cells[((cells >= 0) & (cells < np.array(free.shape)[::-1])).all(axis=1)]
    free[cells[:, 1], cells[:, 0]] = True
    return free
