# SPDX-License-Identifier: Apache-2.0
"""Make docs/pictures: LiDAR scans at the true pose over the aerial image, a match, a tag approach."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from _scenes import samples, scratch

from graphloc.eval.match_picture import drawn
from graphloc.eval.simulate import harbour_scenarios, simulate
from graphloc.eval.simulate.aerial import grid_from_enu, render
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.lidar import scan, world_points
from graphloc.eval.simulate.scene import scene_of
from graphloc.eval.simulate.weather import WEATHER
from graphloc.frontends.aerial import Matcher

FOLDER = Path(__file__).parent.parent / "docs/pictures"
SEED = 1


def overlay(scenario: str, at_s: float, out: Path) -> None:
    run = simulate(harbour_scenarios()[scenario], SEED)
    assert run.harbour is not None
    image = render(run.harbour, run.seed)
    rng, scene = np.random.default_rng([run.seed, 14]), scene_of(run)
    canvas = np.ascontiguousarray(image.pixels[:, :, ::-1])
    for name, lidar in run.rig.lidars.items():
        points = world_points(scan(name, lidar, scene, run.motion, at_s, rng), lidar, run.motion)
        points = points[points[:, 2] > run.scenario.tide_m + 0.3]
        grid = grid_from_enu(run.harbour.datum, image.epsg, points[:, :2])
        columns = np.rint((grid[:, 0] - image.left_m) / image.pixel_m - 0.5).astype(int)
        rows = np.rint((image.top_m - grid[:, 1]) / image.pixel_m - 0.5).astype(int)
        for column, row in zip(columns, rows, strict=True):
            cv2.circle(canvas, (int(column), int(row)), 1, (30, 30, 255), -1)
    cv2.imwrite(str(out), cv2.resize(canvas, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def conditions(at_s: float, out: Path) -> None:
    pictures = []
    for condition in WEATHER:
        run = simulate(harbour_scenarios()[f"dock-fixed-{condition}"], SEED)
        pixels = Camera("camera", scene_of(run), run).take(at_s, round(at_s * 5)).pixels
        small = cv2.resize(pixels, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        cv2.putText(small, condition, (12, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2, cv2.LINE_AA)
        pictures.append(small)
    cv2.imwrite(str(out), np.vstack([np.hstack(pictures[k : k + 2]) for k in (0, 2, 4)]))


def match(scene: str, view: int, out: Path) -> None:
    folder = scratch()
    sample = samples(scene, SEED, folder)[view]
    config = sample.config.model_copy(update={"image": sample.image.name})
    picture = drawn(Matcher(config, folder, sample.datum).match(sample.clouds[0], sample.prior))
    cv2.imwrite(str(out), cv2.resize(picture, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))


def main() -> None:
    overlay("bl1-drift", 60.0, FOLDER / "marina.jpg")
    overlay("bl2-drift", 70.0, FOLDER / "basin.jpg")
    match("crowded", 4, FOLDER / "match.jpg")
    conditions(56.0, FOLDER / "conditions.jpg")


if __name__ == "__main__":
    main()
