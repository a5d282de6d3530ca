# SPDX-License-Identifier: Apache-2.0
"""Lay simulated LiDAR scans, at the true pose, over the aerial image: pictures for docs/simulator.md."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from graphloc.eval.simulate import harbour_scenarios, simulate
from graphloc.eval.simulate.aerial import grid_from_enu, render
from graphloc.eval.simulate.lidar import Scene, bl_lidars, scan, world_points


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenario", choices=sorted(harbour_scenarios()))
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--at", type=float, default=60.0, help="time in the run, s")
    arguments = parser.parse_args()
    run = simulate(harbour_scenarios()[arguments.scenario], arguments.seed)
    assert run.harbour is not None
    image = render(run.harbour, run.seed)
    rng = np.random.default_rng([run.seed, 13])
    scene = Scene(run.harbour, run.harbour.boats(rng), run.scenario.tide_m)
    canvas = np.ascontiguousarray(image.pixels[:, :, ::-1])
    for lidar in bl_lidars():
        points = world_points(scan(lidar, scene, run.motion, arguments.at, rng), lidar, run.motion)
        points = points[points[:, 2] > run.scenario.tide_m + 0.3]
        grid = grid_from_enu(run.harbour.datum, image.epsg, points[:, :2])
        columns = np.rint((grid[:, 0] - image.left_m) / image.pixel_m - 0.5).astype(int)
        rows = np.rint((image.top_m - grid[:, 1]) / image.pixel_m - 0.5).astype(int)
        for column, row in zip(columns, rows, strict=True):
            cv2.circle(canvas, (int(column), int(row)), 1, (30, 30, 255), -1)
    cv2.imwrite(str(arguments.out), cv2.resize(canvas, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    main()
