# SPDX-License-Identifier: Apache-2.0
"""Figures of B: the simulator against the theses."""

from __future__ import annotations

import atexit
import itertools
import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from _rows import Row, row
from scipy.spatial import cKDTree

from graphloc import app
from graphloc.eval.simulate import harbour_scenarios, simulate
from graphloc.eval.simulate.aerial import grid_from_enu, render
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.lidar import scan, world_points
from graphloc.eval.simulate.scene import scene_of
from graphloc.measurements import GnssPosition
from graphloc.time import stamps_of

# BL tables 4.1 and 4.2: RMSE and largest error of the GNSS signal, m.
_BL_SIGNALS = {
    "bl1-drift": (1.3567, 1.7044), "bl1-jump": (2.4596, 14.5443), "bl2-drift": (1.3658, 1.7044),
    "bl2-jump": (2.4428, 14.5115), "bl3-drift": (1.2847, 1.5985), "bl3-jump": (3.6406, 9.9748),
}  # fmt: skip


def _signal(job: tuple[str, int]) -> tuple[float, float]:
    run = simulate(harbour_scenarios()[job[0]], job[1])
    fixes = run.recording.of(GnssPosition)
    at = run.truth.at(stamps_of(fixes))
    antenna = at.p_world_m + at.R_world_body @ run.config.sensors["gnss"].mount.t_body_sensor_m
    datum = app.choose_datum(run.recording, run.config)
    error = np.hypot(*(datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T) - antenna)[:, :2].T)
    return float(np.sqrt((error**2).mean())), float(error.max())


def signals(pool: ProcessPoolExecutor, seeds: int = 10) -> list[Row]:
    rows = []
    for name, (rmse_m, largest_m) in _BL_SIGNALS.items():
        rmse, largest = np.mean(list(pool.map(_signal, [(name, seed) for seed in range(seeds)])), axis=0)
        label = f"{name}, {seeds} seeds: GNSS signal against BL's table"
        rows.append(row("B.1", f"{label}: RMSE off by", 100.0 * abs(rmse / rmse_m - 1.0), "%", 10.0, "<="))
        rows.append(
            row("B.1", f"{label}: largest error off by", 100.0 * abs(largest / largest_m - 1.0), "%", 10.0, "<=")
        )
    return rows


def _edge_distance(job: tuple[str, int]) -> float:
    """Mean distance (m) from wall points of all LiDARs at the true pose to the next edge of the image (B.2)."""
    name, seed = job
    run = simulate(harbour_scenarios()[name], seed)
    assert run.harbour is not None
    rng, scene, t = np.random.default_rng([seed, 14]), scene_of(run), 0.45 * run.scenario.duration_s
    points = np.vstack([
        world_points(scan(lidar, config, scene, run.motion, t, rng), config, run.motion)
        for lidar, config in run.rig.lidars.items()
    ])  # fmt: skip
    solids = [polygon for group in (run.harbour.quays, run.harbour.pontoons) for polygon, _ in group]
    rims = np.vstack([np.array(shapely.segmentize(p.exterior, 0.05).coords) for p in solids])
    on_a_wall = (points[:, 2] > run.scenario.tide_m + 0.2) & (cKDTree(rims).query(points[:, :2])[0] < 0.05)
    image = render(run.harbour, seed)
    edges = cv2.Canny(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), 60, 160)
    away = cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5) * image.pixel_m
    grid = grid_from_enu(run.harbour.datum, image.epsg, points[on_a_wall, :2] + image.shift_m)
    column = np.rint((grid[:, 0] - image.left_m) / image.pixel_m - 0.5).astype(int)
    row_ = np.rint((image.top_m - grid[:, 1]) / image.pixel_m - 0.5).astype(int)
    inside = (row_ >= 0) & (row_ < away.shape[0]) & (column >= 0) & (column < away.shape[1])
    return float(away[row_[inside], column[inside]].mean())


def overlays(pool: ProcessPoolExecutor, seeds: int = 10) -> list[Row]:
    rows = []
    for name, harbour in (("bl1-clean", "marina"), ("bl2-clean", "basin")):
        found = list(pool.map(_edge_distance, [(name, seed) for seed in range(seeds)]))
        label = f"{harbour}, {seeds} seeds: wall points to the next Canny edge"
        rows.append(row("B.2", f"{label}: mean", np.mean(found), "m"))
        rows.append(row("B.2", f"{label}: worst seed", max(found), "m"))
    return rows


BANDS_M = (2.0, 5.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0)
# Digerud's figures 4.4 to 4.12 and table 4.13: farthest sighting, and what he says of the ambiguity.
DIGERUD: dict[str, tuple[str, str]] = {
    "optimal": ("28 m", "minimal"), "fog": ("22 m", "few"), "counterlight": ("25 m", "significant"),
    "droplet": ("16 m", "not said"), "darkness": ("12-16 m", "few"), "illuminated": ("none", "none"),
}  # fmt: skip
Sighting = tuple[float, bool, bool, float]  # range (m), seen, flipped, error of the right pose (m)


# How tags are looked for: AprilTag 3 with its defaults on the image as it comes, as Digerud did; and with every pixel
# in linear light, which removes what the camera's gamma does to edges.
WAYS = {"defaults": (2.0, False), "full": (1.0, True)}


@lru_cache(maxsize=2)
def _detector(decimate: float) -> Any:
    from pupil_apriltags import Detector

    made = Detector(families="tag36h11", quad_decimate=decimate)
    atexit.register(setattr, made, "tag_detector_ptr", None)  # its destructor frees the families twice
    return made


def _sightings(job: tuple[str, int]) -> dict[str, list[Sighting]]:
    """Tags of an approach, by way of looking; OpenCV's IPPE gives each its two poses."""
    condition, seed = job
    cv2.setNumThreads(1)
    run = simulate(harbour_scenarios()[f"dock-fixed-{condition}"], seed)
    config = run.rig.cameras["camera"]
    camera = Camera("camera", scene_of(run), run)
    linear = np.rint(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)
    half = 0.5 * 0.412
    corners = np.array([(-half, half, 0.0), (half, half, 0.0), (half, -half, 0.0), (-half, -half, 0.0)])
    found: dict[str, list[Sighting]] = {way: [] for way in WAYS}
    for k, t in enumerate(np.arange(16.0, 100.0, 1.0)):
        pixels = camera.take(t, k).pixels
        in_view = {}
        for number, (p, R) in camera.tag_poses(float(t)).items():
            flat = (p + corners @ R.T) @ config.K.T
            at = flat[:, :2] / flat[:, 2:]
            if (
                number <= 228
                and p[2] > 1.0
                and at.min() > 10
                and (at < (config.width_px - 10, config.height_px - 10)).all()
            ):
                in_view[number] = (p, R)
        for way, (decimate, linearise) in WAYS.items():
            detections = _detector(decimate).detect(linear[pixels] if linearise else pixels)
            seen = {d.tag_id: d.corners[::-1] - 0.5 for d in detections}
            for number, (p, R) in in_view.items():
                away = float(np.linalg.norm(p))
                if number not in seen:
                    found[way].append((away, False, False, 0.0))
                    continue
                _, turns, places, misfit = cv2.solvePnPGeneric(
                    corners, seen[number], config.K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE_SQUARE
                )
                both = zip(turns, places, strict=True)
                off = [float(np.linalg.norm(R.T @ p - cv2.Rodrigues(a)[0].T @ b[:, 0])) for a, b in both]
                flipped = len(off) > 1 and int(np.argmin(misfit.ravel())) != int(np.argmin(off))
                found[way].append((away, True, flipped, min(off)))
    return found


def tags(pool: ProcessPoolExecutor, seeds: int = 6) -> list[Row]:
    rows = []
    for condition in DIGERUD:
        parts = list(pool.map(_sightings, [(condition, seed) for seed in range(seeds)]))
        for way in WAYS:
            sightings = [sighting for part in parts for sighting in part[way]]
            rows += _tag_rows(f"tags, {condition}, {way}", sightings)
    return rows


def _tag_rows(label: str, sightings: list[Sighting]) -> list[Row]:
    optimal = label == "tags, optimal, full"
    bound = (25.0, ">=") if optimal else ()
    farthest = max((away for away, seen, _, _ in sightings if seen), default=0.0)
    rows = [row("B.3", f"{label}: farthest sighting", farthest, "m", *bound)]
    for low, high in itertools.pairwise(BANDS_M):
        there = [s for s in sightings if low <= s[0] < high]
        seen = [s for s in there if s[1]]
        bound = (0.9, ">=") if optimal and low in (20.0, 25.0) else ()
        rows.append(row("B.3", f"{label}, {low:g}-{high:g} m: seen", len(seen) / max(len(there), 1), "share", *bound))
        if seen:
            rows.append(row("B.3", f"{label}, {low:g}-{high:g} m: flipped", np.mean([s[2] for s in seen]), "share"))
            bound = (0.10, "<=") if optimal and low == 2.0 else ()
            error = float(np.quantile([s[3] for s in seen], 0.95))
            rows.append(row("B.3", f"{label}, {low:g}-{high:g} m: error of the right pose, 95 %", error, "m", *bound))
    return rows


def making(_pool: ProcessPoolExecutor) -> list[Row]:
    """A whole recording, as a user makes it, on two cores."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:2]))
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "graphloc", "simulate", "dock-fixed-optimal", "-o", f"{folder}/sim"]
        begin = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        took = time.perf_counter() - begin
        size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file())
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0**2
    return [
        row("B.4", "2 min run, five LiDARs at 1 Hz, camera at 5 Hz: time to make", took, "s", 90.0, "<="),
        row("B.4", "2 min run, five LiDARs at 1 Hz, camera at 5 Hz: largest memory", peak, "GiB", 2.0, "<="),
        row("B.4", "2 min run, five LiDARs at 1 Hz, camera at 5 Hz: size of the recording", size / 2**20, "MiB"),
    ]
