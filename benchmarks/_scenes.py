# SPDX-License-Identifier: Apache-2.0
"""Scans with an image and a prior that is off: what the matcher's figures are measured on, and its weights fitted on."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from _worlds import write_world

from graphloc.config import AerialConfig
from graphloc.eval.simulate import SimulatedRun, harbour_scenarios, simulate
from graphloc.eval.simulate.aerial import render
from graphloc.eval.simulate.harbour import Harbour
from graphloc.eval.simulate.lidar import scan, world_points
from graphloc.eval.simulate.scene import scene_of
from graphloc.frames import Array, Datum
from graphloc.frontends.aerial.matcher import Prior
from graphloc.frontends.aerial.scan import LevelCloud
from graphloc.trajectory import Trajectory

# Scenes that figures are of: harbour and route. Prior and search: as in the issue.
SCENES = {
    "case 1": ("marina", "entry"), "case 1, turn": ("marina", "turn"), "case 2": ("basin", "turn"),
    "case 2, entry": ("basin", "entry"), "crowded": ("crowded", "entry"), "crowded, turn": ("crowded", "turn"),
}  # fmt: skip
OFF_M, OFF_DEG = 5.0, 4.0
WINDOW_M, WINDOW_DEG = 6.5, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One view.

    Attributes:
        clouds: of the newest scan and those before it, all in the frame `level` of the newest.
        true: pose (3,) east, north, yaw at which the scan fits the image. prior: what the matcher is told.
        image, datum: where the image lies. vector: the GeoJSON of what stands still. config: an aerial sensor's.
    """

    clouds: tuple[LevelCloud, ...]
    true: Array
    prior: Prior
    image: Path
    vector: Path
    datum: Datum
    config: AerialConfig


def samples(scene: str, seed: int, folder: Path, count: int = 8, scans: int = 1) -> list[Sample]:
    """Draw views along a run of a scene; 'world' is one that `_worlds` draws by the seed."""
    cv2.setNumThreads(1)
    if scene == "world":
        harbour, route = str(write_world(seed, folder)), "way"
    else:
        harbour, route = SCENES[scene]
    run = simulate(replace(harbour_scenarios()["bl1-clean"], harbour=harbour, route=route, pose_hz=0.0), seed)
    assert run.harbour is not None
    image = render(run.harbour, seed)
    stem = folder / f"{scene.replace(', ', '_').replace(' ', '')}_{seed}"
    image.write(stem.with_suffix(".tif"))
    stem.with_suffix(".geojson").write_text(json.dumps(_drawn_map(run.harbour, image.shift_m)))
    built = scene_of(run)
    rng = np.random.default_rng([seed, 99])
    sensor = run.config.sensors["aerial"].model_copy(update={"window_m": WINDOW_M, "window_deg": WINDOW_DEG})
    found = []
    for t in np.linspace(14.0, run.scenario.duration_s - 8.0, count) + rng.uniform(-2.0, 2.0, count):
        clouds, true = _views(run, built, float(t), scans, rng)
        true[:2] += image.shift_m
        off = np.array([*rng.uniform(-OFF_M, OFF_M, 2), np.radians(rng.uniform(-OFF_DEG, OFF_DEG))])
        wide = np.array([0.5 * OFF_M, 0.5 * OFF_M, np.radians(0.5 * OFF_DEG)])  # so off as that is 2 sigma
        found.append(
            Sample(clouds, true, Prior(true + off, wide), stem.with_suffix(".tif"),
                   stem.with_suffix(".geojson"), run.harbour.datum, sensor)
        )  # fmt: skip
    return found


def _drawn_map(harbour: Harbour, shift_m: Array) -> dict[str, Any]:
    """What a user would draw on the image: what stands still, as GeoJSON."""
    features = []
    tags = {"quays": {"man_made": "quay"}, "pontoons": {"man_made": "pier"}, "buildings": {"building": "yes"}}
    for kind, tag in tags.items():
        for polygon, _ in getattr(harbour, kind):
            ring = np.array(polygon.exterior.coords) + shift_m
            geodetic = harbour.datum.geodetic_from_enu(np.column_stack([ring, np.zeros(len(ring))]))
            shape = {"type": "Polygon", "coordinates": [geodetic[:, [1, 0]].tolist()]}
            features.append({"type": "Feature", "properties": tag, "geometry": shape})
    return {"type": "FeatureCollection", "features": features}


def _views(
    run: SimulatedRun, built: object, t_s: float, scans: int, rng: np.random.Generator
) -> tuple[tuple[LevelCloud, ...], Array]:
    """Scans a second apart in the level frame of the newest; their relative motion as a smoother knows it."""
    (p,), (R,), _ = run.motion.pose(np.array([t_s]))
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    to_level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    up = np.array([p[0], p[1], run.scenario.tide_m])
    tilt = np.radians(rng.normal(0.0, 0.2, 2))  # what roll and pitch are wrong by
    found = []
    for k in range(scans):
        points, origins = [], []
        for name, lidar in run.rig.lidars.items():
            taken = scan(name, lidar, built, run.motion, t_s - k, rng)  # type: ignore[arg-type]
            at = (world_points(taken, lidar, run.motion) - up) @ to_level.T
            p_k, R_k, _ = run.motion.pose(taken.t_s + taken.dt_s)
            origin = (p_k + R_k @ lidar.T_body_lidar[:3, 3] - up) @ to_level.T
            moved = np.append(rng.normal(0.0, 0.02, 2), 0.0) * k  # 2 cm and 0.02 deg each second
            turn = np.radians(rng.normal(0.0, 0.02)) * k
            T = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
            at, origin = at @ T.T + moved, origin @ T.T + moved
            at[:, 2] += at[:, :2] @ tilt
            points.append(at)
            origins.append(origin[:, :2])
        found.append(LevelCloud(np.vstack(points), np.vstack(origins)))
    return tuple(found), np.array([p[0], p[1], yaw])


def as_shown(truth: Trajectory, folder: Path) -> Trajectory:
    """Return where the image of a simulated run, which is off as a whole, shows the vessel."""
    shift = json.loads((folder / "truth.json").read_text())["image_shows_things_east_north_m"]
    return replace(truth, p_world_m=truth.p_world_m + np.array([*shift, 0.0]))


def together(clouds: tuple[LevelCloud, ...]) -> LevelCloud:
    """One cloud of several."""
    return LevelCloud(np.vstack([c.points_m for c in clouds]), np.vstack([c.origin_m for c in clouds]))


def scratch() -> Path:
    return Path(tempfile.mkdtemp(prefix="graphloc-scenes-"))
