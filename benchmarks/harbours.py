# SPDX-License-Identifier: Apache-2.0
"""Runs through harbours drawn by chance, each from its bag: does the matcher mislead the track where nobody has looked?"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numba
import numpy as np
from _rows import Row, row
from _scenes import as_shown
from _worlds import write_world

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, harbour_scenarios, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.trajectory import Trajectory

_SEEDS = range(340, 352)  # a yardstick: nothing is tuned on them
_FAR_M = 2.0
_TOGETHER_S = 15.0


class _Track(NamedTuple):
    """Position RMSE from where the image shows the vessel, m; share of the time in which the 95 % region holds the truth."""

    off_m: float
    held: float


def _drawn(seed: int, folder: Path) -> Scenario:
    """Draw a harbour and what a vessel has there: a large one with five LiDARs or a launch with one, GNSS trouble, compass or none."""
    rng = np.random.default_rng([seed, 77])
    return replace(
        harbour_scenarios()["bl1-drift"],
        harbour=str(write_world(seed, folder)), route="way", pose_hz=0.0, noise=str(rng.choice(["drift", "jump", "clean", "varied"])),
        rig=str(rng.choice(["tiara", "launch"])), compass_hz=10.0 if rng.uniform() < 0.6 else 0.0,
        outage_s=(48.0, 72.0) if rng.uniform() < 0.4 else None, tide_m=float(rng.uniform(-0.5, 0.5)),
    )  # fmt: skip


def with_matches(config: VesselConfig, submap_s: float = 0.0) -> VesselConfig:
    """Switch the LiDARs on, with the search window of a draft."""
    given = config.sensors["aerial"].model_dump(exclude={"window_m", "window_deg"})
    given |= {"enabled": True, "submap_s": submap_s}
    return config.model_copy(update={"sensors": config.sensors | {"aerial": type(config.sensors["aerial"])(**given)}})


def recorded(seed: int, scratch: Path) -> tuple[Path, Recording, VesselConfig, Trajectory]:
    """Write the bag of a drawn run; return its folder, what is in it, its configuration, and where the image shows the vessel."""
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    folder = scratch / "sim"
    write_bag(simulate(_drawn(seed, scratch), seed), folder, ros=2)
    recording, config = app.load([folder / "run"], folder / "vessel.yaml")
    assert recording.truth is not None
    return folder, recording, config, as_shown(recording.truth, folder)


def _run(seed: int) -> tuple[_Track, ...]:
    """Smoothed without matches, with them, and with those of scans that are matched together; and online."""
    with tempfile.TemporaryDirectory() as scratch_:
        folder, recording, config, shown = recorded(seed, Path(scratch_))
        single, scans = with_matches(config), app.Scans((folder / "run",), folder)
        truth = recording.truth
        assert truth is not None

        def track(solution: Solution) -> _Track:
            held = compare_to_truth(solution.trajectory, truth).coverage_95
            return _Track(compare_to_truth(solution.trajectory, shown).position_rmse_m, float(held or 0.0))

        return (
            track(app.smooth_recording(recording, single).solution),
            track(app.smooth_recording(recording, single, scans=scans).solution),
            track(app.smooth_recording(recording, with_matches(config, _TOGETHER_S), scans=scans).solution),
            track(app.replay_recording(recording, single, scans=scans).solution),
        )


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    found = list(pool.map(_run, _SEEDS))
    rows = []
    names = ("GNSS alone, offline", "offline, submap_s 0", "offline", "online")
    for name, tracks in zip(names, zip(*found, strict=True), strict=True):
        label = f"{len(tracks)} drawn harbours, {name}"
        off_m = np.array([t.off_m for t in tracks])
        rows.append(
            row("C.drawn", f"{label}: position RMSE from where the image shows it, median", np.median(off_m), "m")
        )
        rows.append(row("C.drawn", f"{label}: position RMSE from where the image shows it, mean", off_m.mean(), "m"))
        rows.append(
            row("C.drawn", f"{label}: inside the 95 % bounds, mean", 100.0 * np.mean([t.held for t in tracks]), "%")
        )
        rows.append(row("C.drawn", f"{label}: runs over {_FAR_M:g} m off", int((off_m > _FAR_M).sum()), "runs"))
    return rows
