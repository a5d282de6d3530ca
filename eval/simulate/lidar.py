# SPDX-License-Identifier: Apache-2.0
"""LiDARs in a harbour, ray-cast with Open3D.

Each column of a scan is taken at its own time and vessel pose. Modelled are range noise, drop-outs, the vessel's own
hull, and water, which returns little.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from graphloc.eval.simulate._truth import Motion
from graphloc.eval.simulate.rig import RigLidar
from graphloc.eval.simulate.scene import Scene
from graphloc.frames import Array


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One turn of one LiDAR.

    Attributes:
        lidar: its name. t_s: time of the first column. points_m: (N, 3) in the sensor's axes at the time of each point.
        dt_s: (N,) that time, since `t_s`. ring: (N,) beam. intensity: (N,), 0 to 255.
    """

    lidar: str
    t_s: float
    points_m: Array
    dt_s: Array
    ring: NDArray[np.int64]
    intensity: Array


def scan(name: str, lidar: RigLidar, scene: Scene, motion: Motion, t_s: float, rng: np.random.Generator) -> Scan:
    """Take one turn of a LiDAR that begins at `t_s`."""
    azimuth, columns, beams, ray = _rays(lidar.step_deg, lidar.lowest_deg, lidar.highest_deg, lidar.beams)
    dt = azimuth / (2.0 * np.pi) * lidar.scan_s
    p, R, _ = motion.pose(t_s + dt)
    T = lidar.T_body_lidar
    in_body = ray @ T[:3, :3].T
    origin = np.broadcast_to(T[:3, 3], in_body.shape)
    turned = R[columns]
    away, water = scene.ranges(origin, in_body, turned, p[columns], t_s + 0.5 * lidar.scan_s)
    # Flat water reflects the light away from the sensor; only near and steep rays return.
    steep = np.abs(np.einsum("nj,nj->n", turned[:, 2], in_body))
    comes_back = rng.uniform(size=len(away)) > np.where(water, 1.0 - 0.3 * steep**2 * np.exp(-away / 12.0), lidar.drop)
    there = (away > 0.2) & (away < lidar.range_m) & comes_back
    away = away[there] + rng.normal(0.0, lidar.sigma_m, int(there.sum()))
    bright = np.where(water[there], 8.0, 90.0) * np.exp(-away / 80.0) * rng.uniform(0.6, 1.4, len(away))
    return Scan(
        lidar=name,
        t_s=t_s,
        points_m=ray[there] * away[:, None],
        dt_s=dt[columns[there]],
        ring=beams[there],
        intensity=np.clip(bright, 0.0, 255.0),
    )


@lru_cache(maxsize=8)
def _rays(
    step_deg: float, lowest_deg: float, highest_deg: float, beams: int
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], Array]:
    """Return azimuth (C,) rad of each column; column (N,), beam (N,) and direction (N, 3) of each ray of a turn."""
    azimuth = np.radians(np.arange(0.0, 360.0, step_deg))
    elevation = np.radians(np.linspace(lowest_deg, highest_deg, beams))
    column = np.repeat(np.arange(len(azimuth)), beams)
    beam = np.tile(np.arange(beams), len(azimuth))
    around, up = azimuth[column], elevation[beam]
    ray = np.column_stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    for made in (azimuth, column, beam, ray):
        made.setflags(write=False)
    return azimuth, column, beam, ray


def world_points(scan: Scan, lidar: RigLidar, motion: Motion) -> Array:
    """Return the points (N, 3) of a scan in world, each by the true pose of the vessel at its time."""
    p, R, _ = motion.pose(scan.t_s + scan.dt_s)
    T = lidar.T_body_lidar
    return np.asarray(p + np.einsum("nij,nj->ni", R, scan.points_m @ T[:3, :3].T + T[:3, 3]))
