# SPDX-License-Identifier: Apache-2.0
"""Scene for ray casting on the day of a run: the harbour at its tide, boats, moving docks, the vessel's hull."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from graphloc.errors import ConfigError, InputError
from graphloc.eval.simulate._run import SimulatedRun
from graphloc.eval.simulate.docks import MovingDock
from graphloc.eval.simulate.harbour import Boat, Harbour
from graphloc.eval.simulate.rig import HullConfig
from graphloc.frames import Array

Rays = NDArray[np.float32]
_SEABED_M = -4.0  # height down to which walls of quays reach


class Hit(NamedTuple):
    """First hits of rays.

    Attributes:
        range_m: (N,) in lengths of the ray's direction; inf: no hit, and the other values are undefined.
        surface: (N,) index into `Scene.surfaces`. normal: (N, 3) in world, of either sign.
    """

    range_m: Rays
    surface: NDArray[np.int32]
    normal: Rays


@dataclass(slots=True, eq=False)
class _Part:
    """Objects that move together.

    Attributes:
        rays: Open3D's scene of them. first: index of their first surface in the list of all. dock: which moves them;
            None: they stand still. reach_m: largest distance of a point of them from their origin.
    """

    rays: Any
    first: int
    dock: MovingDock | None = None
    reach_m: float = np.inf


def scene_of(run: SimulatedRun) -> Scene:
    """Build the scene for a run's LiDARs and cameras.

    Raises:
        ConfigError: the run is not in a harbour. InputError: Open3D cannot be loaded.
    """
    if run.harbour is None:
        raise ConfigError("this scenario lies in no harbour: there is nothing to see")
    boats = run.harbour.boats(np.random.default_rng([run.seed, 13]))
    return Scene(run.harbour, boats, run.scenario.tide_m, run.docks, run.rig.hull)


class Scene:
    """A world to cast rays into.

    Attributes:
        surfaces: material of each surface, by index. tide_m: height of the water. docks: the moving docks.
    """

    def __init__(
        self, harbour: Harbour, boats: tuple[Boat, ...], tide_m: float, docks: tuple[MovingDock, ...], hull: HullConfig
    ) -> None:
        try:
            import open3d  # heavy: imported only if rays are cast
        except (ImportError, OSError) as error:
            raise InputError(
                f"open3d, which casts rays for LiDARs and cameras, cannot be loaded ({error}): `make` names the system "
                "libraries that it needs; or simulate with --set lidar_hz=0 --set camera_hz=0"
            ) from None
        self._o3d, self.tide_m, self.docks = open3d, tide_m, docks
        self.surfaces: list[str] = []
        self._own = open3d.t.geometry.RaycastingScene()
        for outline, bottom, top in ((hull.outline, -0.5, hull.top_m), (hull.cabin, 0.0, hull.cabin_top_m)):
            self._prism(self._own, shapely.Polygon(outline), bottom, top)
        self._parts = [self._still(harbour, boats)]
        for (polygon, dock), moving in zip(harbour.docks, docks, strict=True):
            part = self._part(moving)
            at_rest = shapely.affinity.translate(polygon, *-moving.rest_m)
            self._add(part, at_rest, -0.5, dock.top_m, dock.surface)
            part.reach_m = float(np.hypot(np.abs(at_rest.bounds).max() * np.sqrt(2.0), max(dock.top_m, 0.5)))
            self._parts.append(part)

    def _still(self, harbour: Harbour, boats: tuple[Boat, ...]) -> _Part:
        part, tide = self._part(None), self.tide_m
        for polygon, solid in harbour.quays:
            self._add(part, polygon, _SEABED_M, solid.top_m, solid.surface)
        for polygon, solid in harbour.buildings:
            self._add(part, polygon, _SEABED_M, solid.top_m, "building")
        for polygon, solid in harbour.pontoons:
            self._add(part, polygon, tide - 0.3, tide + solid.top_m, solid.surface)
        for at, pole in harbour.poles:
            self._add(part, shapely.Point(at).buffer(pole.radius_m, quad_segs=3), _SEABED_M, pole.top_m, "steel")
        for boat in boats:
            self._add(part, shapely.Polygon(boat.outline), tide - 0.2, tide + 0.11 * boat.length_m, "hull")
            cabin = shapely.Polygon(boat.at + 0.5 * (boat.outline - boat.at))
            self._add(part, cabin, tide, tide + 0.2 * boat.length_m, "cabin")
        return part

    def _part(self, dock: MovingDock | None) -> _Part:
        return _Part(self._o3d.t.geometry.RaycastingScene(), len(self.surfaces), dock)

    def _add(self, part: _Part, polygon: shapely.Polygon, bottom_m: float, top_m: float, surface: str) -> None:
        self._prism(part.rays, polygon, bottom_m, top_m)
        self.surfaces.append(surface)

    def _prism(self, scene: Any, polygon: shapely.Polygon, bottom_m: float, top_m: float) -> None:
        vertices, triangles = extrude(polygon, bottom_m, top_m)
        tensor: Any = self._o3d.core.Tensor
        scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))

    def cast(self, origin_m: Rays, direction: Rays, t_s: float) -> Hit:
        """Return first hits of rays: origin (3,) or (N, 3) m and direction (N, 3) in world, docks as of time t_s."""
        still, *moving = self._parts
        hit = self._cast(still.rays, origin_m, direction)
        found = Hit(
            hit["t_hit"].numpy(), hit["geometry_ids"].numpy().astype(np.int32), hit["primitive_normals"].numpy()
        )
        for part in moving:
            assert part.dock is not None
            p, R = (v[0].astype(np.float32) for v in part.dock.pose(np.array([t_s])))
            (near,) = np.nonzero(_may_meet(origin_m, direction, p, part.reach_m))
            if not len(near):
                continue
            start = (origin_m if origin_m.ndim == 1 else origin_m[near]) - p
            hit = self._cast(part.rays, start @ R, direction[near] @ R)
            away = hit["t_hit"].numpy()
            (first,) = np.nonzero(away < found.range_m[near])
            found.range_m[near[first]] = away[first]
            found.surface[near[first]] = hit["geometry_ids"].numpy()[first].astype(np.int32) + part.first
            found.normal[near[first]] = hit["primitive_normals"].numpy()[first] @ R.T
        return found

    def water_range(self, height_m: Array | float, up: Array | Rays) -> Array:
        """Return the range (N,) of the water, in lengths of the rays' directions; inf: they miss it.

        Args:
            height_m: of the origins of rays in world. up: (N,) third component of their directions.
        """
        return np.where(up < -1e-3, (self.tide_m - height_m) / np.minimum(up, -1e-3), np.inf)

    def own_range_m(self, origin_m: Rays, direction: Rays) -> Rays:
        """Return the range (N,) of the vessel's hull along rays in body; inf: they miss it."""
        return np.asarray(self._cast(self._own, origin_m, direction)["t_hit"].numpy())

    def _cast(self, scene: Any, origin_m: Rays, direction: Rays) -> Any:
        rays = np.empty((len(direction), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origin_m, direction
        return scene.cast_rays(self._o3d.core.Tensor.from_numpy(rays))

    def ranges(
        self, origin_m: Array, direction: Array, R: Array, p_m: Array, t_s: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the range (N,), m, of rays (inf: no hit), and whether they hit water (N,).

        Args:
            origin_m, direction: (N, 3) in body. R, p_m: (N, 3, 3), (N, 3) pose of body in world at each ray's time.
            t_s: time for the docks, the same for all rays, as docks are slow.
        """
        own = self.own_range_m(origin_m.astype(np.float32), direction.astype(np.float32))
        start = p_m + np.einsum("nij,nj->ni", R, origin_m)
        ahead = np.einsum("nij,nj->ni", R, direction)
        world = self.cast(start.astype(np.float32), ahead.astype(np.float32), t_s).range_m
        water = self.water_range(start[:, 2], ahead[:, 2])
        nearest = np.minimum(own, world).astype(float)
        return np.minimum(nearest, water), np.asarray(water < nearest)


def _may_meet(origin_m: Rays, direction: Rays, middle_m: Rays, reach_m: float) -> NDArray[np.bool_]:
    """Return which rays pass within `reach_m` of a point: the others need not be cast."""
    to = middle_m - origin_m
    along = direction @ to if to.ndim == 1 else np.einsum("ni,ni->n", direction, to)
    length2 = np.einsum("ni,ni->n", direction, direction)
    past2 = np.sum(to * to, axis=-1) - np.maximum(along, 0.0) ** 2 / length2
    return np.asarray(past2 <= reach_m**2)


def extrude(polygon: shapely.Polygon, bottom_m: float, top_m: float) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (V, 3) and triangles (T, 3) of a prism: its walls and its top."""
    ring = np.array(polygon.exterior.coords)[:-1]
    n = len(ring)
    walls = np.vstack([np.column_stack([ring, np.full(n, z)]) for z in (bottom_m, top_m)])
    k = np.arange(n)
    following = (k + 1) % n
    sides = np.vstack([np.column_stack([k, following, n + k]), np.column_stack([following, n + following, n + k])])
    caps = [np.array(t.exterior.coords)[:3] for t in shapely.constrained_delaunay_triangles(polygon).geoms]
    top = np.vstack([np.column_stack([cap, np.full(3, top_m)]) for cap in caps])
    return np.vstack([walls, top]), np.vstack([sides, 2 * n + np.arange(3 * len(caps)).reshape(-1, 3)])
