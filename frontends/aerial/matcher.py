# SPDX-License-Identifier: Apache-2.0
"""One match: layers around the prior, the scan's outline on them, and what the posterior says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphloc.config import AerialConfig
from graphloc.frames import Array, Datum, wrap_angle
from graphloc.frontends.aerial.image import AerialImage, Patch
from graphloc.frontends.aerial.layers import Layer, Layers, edge_layer, segment_water, shore_layer
from graphloc.frontends.aerial.match import Grid, Mode, grid_around, log_likelihood_of, modes_of
from graphloc.frontends.aerial.scan import LevelCloud, Outline, outline
from graphloc.measurements import PoseFix, PoseMode

_CELL_M = 0.25
_TILE_M = 40.0  # a patch serves all priors of one tile
# Log-likelihood of a face on an edge, and of a first return on a shore; by `scan.FEATURES`; docs/decisions/0006.
_FACE_WEIGHTS, _SHORE_WEIGHT = np.array([0.057, 0.0, 0.0, 0.0]), 0.166
_NONE_LOG = -2.0  # that of a pose of which nothing is known
_ALIEN = 0.15  # a scan shows boats that the image does not have, and the reverse
_LEAST_FACES = 30
_MODES = 5


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Where the vessel is thought to be: pose (3,) east, north, yaw, and its sigmas (3,), m and rad."""

    pose: Array
    sigma: Array


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """What a match found.

    Attributes:
        prior: what it started from. found: the scan. layers: what it was laid on. grid, score: log-likelihood
            (H, R, C) over the grid. modes: best first. none: probability that no mode is right.
        why_not: why there is no mode; empty where there is.
    """

    prior: Prior
    found: Outline
    layers: Layers | None = None
    grid: Grid | None = None
    score: Layer | None = None
    modes: tuple[Mode, ...] = ()
    none: float = 1.0
    why_not: str = ""

    def fix(self, stamp_ns: int, sensor: str) -> PoseFix:
        """Return the modes as one measurement."""
        modes = tuple(
            PoseMode(
                value=np.array([m.pose[0], m.pose[1], float(wrap_angle(m.pose[2]))]),
                cov=m.cov,
                probability=m.probability,
            )
            for m in self.modes
        )
        return PoseFix(stamp_ns=stamp_ns, sensor=sensor, seq=0, axes=("x", "y", "yaw"), modes=modes)


class Matcher:
    """Matches scans to one image; layers are made once for each part of it.

    Raises:
        InputError: the image cannot be used.
    """

    def __init__(self, config: AerialConfig, image: Path, datum: Datum) -> None:
        self._config, self._image = config, AerialImage(image, datum)
        self._hull = np.array(config.hull_m, dtype=float) if config.hull_m else None
        self._tile: tuple[int, int] | None = None
        self._layers: Layers | None = None

    def match(self, cloud: LevelCloud, prior: Prior) -> Match:
        """Lay a cloud on the image around a prior.

        Raises:
            InputError: the image does not reach there.
        """
        config = self._config
        found = outline(cloud, self._hull, config.reach_m)
        if len(found.faces_m) < _LEAST_FACES:
            return Match(prior, found, why_not=f"{len(found.faces_m)} places with a vertical face: too few to match")
        layers = self._layers_around(prior, found)
        half_m = float(np.clip(3.0 * prior.sigma[:2].max() + 1.0, 2.0, config.window_m))
        half_deg = float(np.clip(np.degrees(3.0 * prior.sigma[2]) + 0.5, 1.0, config.window_deg))
        grid = grid_around(layers, prior.pose, half_m, half_deg)
        score = log_likelihood_of(found, layers, grid, _FACE_WEIGHTS, _SHORE_WEIGHT)
        modes, none = modes_of(score, grid, _NONE_LOG, _ALIEN, _MODES)
        why_not = "" if modes else "no pose in the window stands out"
        return Match(prior, found, layers, grid, score, tuple(modes), none, why_not)

    def _layers_around(self, prior: Prior, found: Outline) -> Layers:
        tile = (int(prior.pose[0] // _TILE_M), int(prior.pose[1] // _TILE_M))
        if self._layers is None or tile != self._tile:
            middle = (np.array(tile) + 0.5) * _TILE_M
            patch = self._image.patch(middle, self._config.reach_m + _TILE_M + self._config.window_m, _CELL_M)
            water = segment_water(patch, _seen_water(patch, prior, found))
            shores = shore_layer(patch, water) if water.any() else None
            self._tile, self._layers = tile, Layers(patch, edge_layer(patch), shores)
        return self._layers


def _seen_water(patch: Patch, prior: Prior, found: Outline) -> NDArray[np.bool_]:
    """Cells that the scan saw to be water, were the prior right."""
    c, s = np.cos(prior.pose[2]), np.sin(prior.pose[2])
    at = found.water_m @ np.array([[c, s], [-s, c]]) + prior.pose[:2]
    cells = np.rint(patch.cells(at)).astype(int)
    free = np.zeros(patch.inside.shape, dtype=bool)
    cells = cells[((cells >= 0) & (cells < np.array(free.shape)[::-1])).all(axis=1)]
    free[cells[:, 1], cells[:, 0]] = True
    return free
