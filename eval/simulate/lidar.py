# SPDX-License-Identifier: Apache-2.0
"""LiDARs in a harbour: BL's five by default, ray-cast with Open3D.

Each column of a scan is taken at its own time, from where the vessel then is. Range noise, drop-outs, the
vessel's own hull, and water, of which little comes back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from graphloc.errors import InputError
from graphloc.eval.simulate.harbour import Boat, Harbour
from graphloc.frames import Array

if TYPE_CHECKING:
    from graphloc.eval.simulate._truth import Motion

_SEABED_M = -4.0  # walls of quays reach down to here
_HULL = ((-7.0, -2.1), (3.0, -2.1), (5.8, -1.2), (7.3, 0.0), (5.8, 1.2), (3.0, 2.1), (-7.0, 2.1))
_HULL_TOP_M, _CABIN, _CABIN_TOP_M = 0.35, ((-2.8, -1.2), (1.8, -1.2), (1.8, 1.2), (-2.8, 1.2)), 2.2


@dataclass(frozen=True, slots=True)
class LidarModel:
    """What a make of LiDAR does (BL table 3.1).

    Attributes:
        range_m: largest range. lowest_deg, highest_deg: elevation of the outer beams from the sensor's x-y plane.
        beams: beams between them. step_deg: between columns. sigma_m: range noise. scan_s: time of a turn.
        drop: share of returns that are lost.
    """

    range_m: float
    lowest_deg: float
    highest_deg: float
    beams: int = 32
    step_deg: float = 0.2
    sigma_m: float = 0.01
    scan_s: float = 0.1
    drop: float = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Lidar:
    """A LiDAR on the vessel: its name, make, and T_body_lidar (4, 4)."""

    name: str
    model: LidarModel
    T_body_lidar: Array


BPEARL = LidarModel(range_m=100.0, lowest_deg=0.0, highest_deg=87.19)
HELIOS = LidarModel(range_m=150.0, lowest_deg=-55.0, highest_deg=15.0)
_BL_MOUNTS = (  # BL appendix A: rows of T_body_lidar, rounded there to four digits
    (BPEARL, (0.0008, -0.0002, -1.0, -7.17), (-0.001, -1.0, 0.0002, 0.48), (-1.0, 0.001, -0.0008, 0.396)),
    (BPEARL, (0.2202, -0.9699, 0.1039, 3.7887), (-0.8345, -0.2425, -0.4948, -1.8122), (0.5051, 0.0222, -0.8628, 1.0779)),
    (BPEARL, (0.2393, 0.9662, 0.0957, 3.5665), (0.7856, -0.2506, 0.5657, 1.8901), (0.5706, -0.0602, -0.819, 1.0172)),
    (HELIOS, (-0.022, -0.9977, 0.0648, -3.2191), (0.9727, -0.0064, 0.232, 1.4394), (-0.231, 0.0681, 0.9706, 2.391)),
    (HELIOS, (0.0004, 0.9995, 0.0311, -3.1667), (-0.9838, 0.006, -0.1791, -1.4083), (-0.1792, -0.0305, 0.9833, 2.3929)),
)  # fmt: skip


def orthonormal(R: Array) -> Array:
    """Return the rotation next to a matrix (3, 3): printed ones are rounded."""
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def bl_lidars() -> tuple[Lidar, ...]:
    """Return BL's five LiDARs."""
    found = []
    for k, (model, *rows) in enumerate(_BL_MOUNTS):
        T = np.vstack([np.array(rows), (0.0, 0.0, 0.0, 1.0)])
        T[:3, :3] = orthonormal(T[:3, :3])
        found.append(Lidar(f"lidar_{k + 1}", model, T))
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One turn of one LiDAR.

    Attributes:
        lidar: its name. t_s: time of the first column. points_m: (N, 3) in the sensor's axes, each at its own
            time. dt_s: (N,) of it since `t_s`. ring: (N,) beam. intensity: (N,), 0 to 255.
    """

    lidar: str
    t_s: float
    points_m: Array
    dt_s: Array
    ring: NDArray[np.int64]
    intensity: Array


class Scene:
    """What LiDARs meet on the day of the run: the harbour at its tide, that day's boats, the own hull."""

    def __init__(self, harbour: Harbour, boats: tuple[Boat, ...], tide_m: float) -> None:
        try:
            import open3d  # heavy: only who casts rays pays for it
        except (ImportError, OSError) as error:
            raise InputError(
                f"open3d, which casts the LiDARs' rays, cannot be loaded ({error}): `make` names the system libraries "
                "that it needs; or simulate with --no-lidar"
            ) from None
        self._o3d, self._tide_m = open3d, tide_m
        self._world, self._own = open3d.t.geometry.RaycastingScene(), open3d.t.geometry.RaycastingScene()
        for polygon, solid in (*harbour.quays, *harbour.buildings):
            self._add(self._world, polygon, _SEABED_M, solid.top_m)
        for polygon, solid in harbour.pontoons:
            self._add(self._world, polygon, tide_m - 0.3, tide_m + solid.top_m)
        for at, pole in harbour.poles:
            self._add(self._world, shapely.Point(at).buffer(pole.radius_m, quad_segs=3), _SEABED_M, pole.top_m)
        for boat in boats:
            hull = shapely.Polygon(boat.outline)
            self._add(self._world, hull, tide_m - 0.2, tide_m + 0.11 * boat.length_m)
            cabin = shapely.Polygon(boat.at + 0.5 * (boat.outline - boat.at))
            self._add(self._world, cabin, tide_m, tide_m + 0.2 * boat.length_m)
        self._add(self._own, shapely.Polygon(_HULL), -0.5, _HULL_TOP_M)
        self._add(self._own, shapely.Polygon(_CABIN), 0.0, _CABIN_TOP_M)

    def _add(self, scene: Any, polygon: shapely.Polygon, bottom_m: float, top_m: float) -> None:
        vertices, triangles = extrude(polygon, bottom_m, top_m)
        tensor: Any = self._o3d.core.Tensor
        scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))

    def ranges(self, origin_m: Array, direction: Array, R: Array, p_m: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return range (N,) m of rays, inf where nothing is met, and whether it is water (N,).

        Args:
            origin_m, direction: (N, 3) in body. R: (N, 3, 3), p_m: (N, 3): the body in world at each ray's time.
        """
        own = self._cast(self._own, origin_m, direction)
        start = p_m + np.einsum("nij,nj->ni", R, origin_m)
        ahead = np.einsum("nij,nj->ni", R, direction)
        world = self._cast(self._world, start, ahead)
        down = np.minimum(ahead[:, 2], -1e-6)
        water = np.where(ahead[:, 2] < -1e-3, (self._tide_m - start[:, 2]) / down, np.inf)
        nearest = np.minimum(own, world)
        return np.minimum(nearest, water), np.asarray(water < nearest)

    def _cast(self, scene: Any, origin_m: Array, direction: Array) -> Array:
        tensor: Any = self._o3d.core.Tensor
        hit = scene.cast_rays(tensor(np.hstack([origin_m, direction]).astype(np.float32)))["t_hit"]
        return np.asarray(hit.numpy(), dtype=float)


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


def scan(lidar: Lidar, scene: Scene, motion: Motion, t_s: float, rng: np.random.Generator) -> Scan:
    """Take one turn of a LiDAR that begins at `t_s`."""
    model = lidar.model
    azimuth = np.radians(np.arange(0.0, 360.0, model.step_deg))
    elevation = np.radians(np.linspace(model.lowest_deg, model.highest_deg, model.beams))
    dt = azimuth / (2.0 * np.pi) * model.scan_s
    p, R, _ = motion.pose(t_s + dt)
    columns = np.repeat(np.arange(len(azimuth)), model.beams)
    beams = np.tile(np.arange(model.beams), len(azimuth))
    around, up = azimuth[columns], elevation[beams]
    ray = np.column_stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    T = lidar.T_body_lidar
    in_body = ray @ T[:3, :3].T
    away, water = scene.ranges(np.broadcast_to(T[:3, 3], in_body.shape), in_body, R[columns], p[columns])
    # Flat water throws the light away; what comes back does so from near and steep.
    steep = np.abs(np.einsum("nj,nj->n", R[columns][:, 2], in_body))
    comes_back = rng.uniform(size=len(away)) > np.where(water, 1.0 - 0.3 * steep**2 * np.exp(-away / 12.0), model.drop)
    there = (away > 0.2) & (away < model.range_m) & comes_back
    away = away[there] + rng.normal(0.0, model.sigma_m, int(there.sum()))
    bright = np.where(water[there], 8.0, 90.0) * np.exp(-away / 80.0) * rng.uniform(0.6, 1.4, len(away))
    return Scan(
        lidar=lidar.name,
        t_s=t_s,
        points_m=ray[there] * away[:, None],
        dt_s=dt[columns[there]],
        ring=beams[there],
        intensity=np.clip(bright, 0.0, 255.0),
    )


def world_points(scan: Scan, lidar: Lidar, motion: Motion) -> Array:
    """Return the points (N, 3) of a scan in world, each from where the vessel truly was at its time."""
    p, R, _ = motion.pose(scan.t_s + scan.dt_s)
    T = lidar.T_body_lidar
    return np.asarray(p + np.einsum("nij,nj->ni", R, scan.points_m @ T[:3, :3].T + T[:3, 3]))
