# SPDX-License-Identifier: Apache-2.0
"""Make docs/pictures: LiDAR scans at the true pose over the aerial image, a match, a tag approach, reports.

`python benchmarks/pictures.py report` makes those of the reports alone; they need Chromium.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from _scenes import samples, scratch
from PIL import Image

from graphloc import app
from graphloc.eval.match_picture import drawn
from graphloc.eval.simulate import Scenario, harbour_scenarios, simulate
from graphloc.eval.simulate.aerial import grid_from_enu, render
from graphloc.eval.simulate.bag import write_bag
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


def conditions(out: Path) -> None:
    at_s = 56.0
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


def report(name: str, scenario: Scenario, out: Path) -> None:
    """The first screens of the report of `graphloc compare` on a simulated bag."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    assert chromium, "no Chromium on PATH"
    with tempfile.TemporaryDirectory() as scratch_folder:
        folder = Path(scratch_folder)
        bag, config_path = write_bag(simulate(scenario, 0), folder / name, ros=2)
        recording, config = app.load([bag], config_path)
        scans = app.Scans((bag,), config_path.parent)
        run = app.smooth_recording(recording, config, compare=True, scans=scans)
        page = app.write(
            run,
            folder / "run",
            inputs=(),
            command=f"compare {name}/run -c {name}/vessel.yaml -o runs/{name}",
            overwrite=True,
        )
        shot = folder / "shot.png"
        options = (
            "--headless",
            "--no-sandbox",
            "--hide-scrollbars",
            "--virtual-time-budget=8000",
            "--window-size=1150,1750",
        )
        subprocess.run(
            [chromium, *options, f"--user-data-dir={folder / 'chromium'}", f"--screenshot={shot}", page.as_uri()],
            check=True, capture_output=True,
        )  # fmt: skip
        with Image.open(shot) as picture:
            small = picture.convert("RGB").resize((920, 1400), Image.Resampling.LANCZOS)
            colours = small.quantize(256, kmeans=4)
            small.quantize(palette=colours, dither=Image.Dither.FLOYDSTEINBERG).save(out, optimize=True)


def reports() -> None:
    every = harbour_scenarios()
    report(
        "bl1-drift", replace(every["bl1-drift"], lidar_hz=0.0), FOLDER / "report-bl1-drift.png"
    )  # as `graphloc demo`
    report("dock-fixed-optimal", every["dock-fixed-optimal"], FOLDER / "report-docking.png")


def main() -> None:
    if sys.argv[1:] == ["report"]:
        reports()
        return
    overlay("bl1-drift", 60.0, FOLDER / "marina.jpg")
    overlay("bl2-drift", 70.0, FOLDER / "basin.jpg")
    match("crowded", 4, FOLDER / "match.jpg")
    conditions(FOLDER / "conditions.jpg")
    reports()


if __name__ == "__main__":
    main()
