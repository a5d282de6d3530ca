# SPDX-License-Identifier: Apache-2.0
"""Figures of D.4: tags alone against their true poses."""

from __future__ import annotations

import itertools
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from _rows import Row, row
from docking import Job, jobs_of, scenario_of
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from graphloc.eval.simulate import simulate
from graphloc.eval.simulate._light import tag_in_world
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.scene import scene_of
from graphloc.frontends.tags.bundles import Seeing, SeenTag, sightings_of
from graphloc.frontends.tags.detect import Detector
from graphloc.survey import Survey, TagConfig

_ALONE_M, _ALONE_BANDS_M = (2.0, 20.0), (2.0, 5.0, 8.0, 12.0, 16.0, 20.0)
_STEP_S = 0.5  # between two views


@dataclass(frozen=True)
class Alone:
    """A tag alone against its true pose: range, errors (6,) of the nearer mode, its covariance, corner errors in px."""

    range_m: float
    error: Any
    cov: Any
    corners_px: Any


def alone(job: Job) -> list[Alone]:
    """Each tag of an approach alone, its true place given, in images as a bag has them (JPEG)."""
    cv2.setNumThreads(1)
    run = simulate(scenario_of(job), job[2])
    config = run.rig.cameras["camera"]
    scene = scene_of(run)
    camera, detector = Camera("camera", scene, run), Detector()
    assert run.harbour is not None
    tags = {tag.number: tag for tag in run.harbour.config.tags}
    found = []
    for k, t in enumerate(np.arange(16.0, run.scenario.duration_s - 0.3, _STEP_S)):
        p, R = camera.pose(float(t))
        there = camera.tag_poses(float(t))
        if min(float(np.linalg.norm(at)) for at, _ in there.values()) > _ALONE_M[1]:
            continue
        _, coded = cv2.imencode(".jpg", camera.take(float(t), k).pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])
        for seen in detector.detect(np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)):
            tag = tags.get(seen.number)
            if tag is None:
                continue
            at, turned = tag_in_world(tag, run.harbour, scene, float(t))
            roll, pitch, yaw = Rotation.from_matrix(turned).as_euler("xyz", degrees=True)
            surveyed = TagConfig(
                id=tag.number,
                size_m=tag.size_m,
                xyz_m=tuple(at),
                rpy_deg=(roll, pitch, yaw),
                sigma_m=0.0,
                sigma_deg=0.0,
            )
            rays = (seen.corners_px - np.array(config.centre_px)) / np.array(config.focal_px)
            cov = seen.cov_px2 / config.focal_px[0] ** 2
            survey = Survey(tags=(surveyed,))
            seeing = Seeing(0, "tags", "camera", np.zeros(3), np.eye(3))
            sightings, _ = sightings_of([SeenTag(surveyed, rays, cov)], survey, seeing)
            if not sightings:
                continue
            modes = sightings[0].modes
            right = int(np.argmin([np.linalg.norm(np.asarray(m.R_world_camera) - R) for m in modes]))
            mode = modes[right]
            middle = surveyed.corners_m.mean(axis=0)
            shift = (middle - p) @ R - (middle - mode.p_world_camera_m) @ mode.R_world_camera
            turn = Rotation.from_matrix(mode.R_world_camera.T @ R).as_rotvec()
            flat = (surveyed.corners_m - p) @ R
            px = flat[:, :2] / flat[:, 2:] * np.array(config.focal_px) + np.array(config.centre_px)
            found.append(
                Alone(
                    float(np.linalg.norm(at - p)),
                    np.concatenate([shift, turn]),
                    np.asarray(mode.cov),
                    seen.corners_px - px,
                )
            )
    return found


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    """Are the covariances of single tags honest, and do corners lie where they should?"""
    found = [a for part in pool.map(alone, jobs_of("fixed", "optimal")) for a in part]
    rows = []
    for low, high in itertools.pairwise(_ALONE_BANDS_M):
        there = [a for a in found if low <= a.range_m < high]
        if not there:
            continue
        nees = np.array([float(a.error @ np.linalg.solve(a.cov, a.error)) for a in there])
        label = f"single tags, optimal, {low:g}-{high:g} m"
        bound = _mean_bound(len(nees))
        rows.append(
            row("D.4", f"{label}: NEES / 6 (95 % bound of so many: {bound:.2f})", nees.mean() / 6.0, "", bound, "<=")
        )
        rows.append(
            row("D.4", f"{label}: within the 95 % region", (nees < chi2.ppf(0.95, 6)).mean(), "share", 0.93, ">=")
        )
        shrunk = np.mean([_outward(a.corners_px) for a in there])
        rows.append(row("D.4", f"{label}: corners off from the middle outwards, mean", shrunk, "px"))
        off = np.sqrt(np.mean([np.mean(a.corners_px**2) for a in there]))
        rows.append(row("D.4", f"{label}: corners off, RMS of an axis", off, "px"))
    return rows


def _mean_bound(count: int) -> float:
    """Upper end of the 95 % interval of the mean of `count` values of chi-square 6, over 6."""
    return float(chi2.ppf(0.975, 6 * count) / (6 * count))


def _outward(off_px: Any) -> float:
    """Mean way of the four corners (top-left, top-right, bottom-right, bottom-left) away from the middle, each axis."""
    return float((off_px * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])).mean())
