# SPDX-License-Identifier: Apache-2.0
"""A simulated camera before a tag, and an independent detector to hold it against."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pupil_apriltags import Detector

from graphloc.blocks import MountConfig
from graphloc.eval.simulate import SimulatedRun, find_scenario, harbour_scenarios, simulate
from graphloc.eval.simulate._truth import Motion
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.harbour import make_harbour
from graphloc.eval.simulate.rig import HullConfig, RigCamera, RigConfig, load_rig
from graphloc.eval.simulate.scene import Scene, scene_of
from graphloc.frames import Array

LINEAR = np.rint(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)  # undoes the camera's gamma
HALF = 0.206
CORNERS = np.array([(-HALF, HALF, 0.0), (HALF, HALF, 0.0), (HALF, -HALF, 0.0), (-HALF, -HALF, 0.0)])  # tag axes
LOOKING_AHEAD = MountConfig(rpy_deg=(-90.0, 0.0, -90.0))


@cache
def docking(condition: str, kind: str = "fixed") -> tuple[SimulatedRun, Camera]:
    whole = harbour_scenarios()[f"dock-{kind}-{condition}"]
    run = simulate(replace(whole, imu_hz=10.0, gnss_hz=1.0, compass_hz=1.0, pose_hz=0.0), 1)  # for images alone
    (name,) = run.rig.cameras
    return run, Camera(name, scene_of(run), run)


def detectors() -> Iterator[Detector]:
    """One AprilTag detector, for a fixture."""
    made = Detector(families="tag36h11", quad_decimate=1.0)
    yield made
    made.tag_detector_ptr = None  # its destructor frees the families twice, and the heap breaks


def detected(detector: Detector, pixels: NDArray[np.uint8]) -> dict[int, Array]:
    """Corners (4, 2) by id, in `CORNERS`' order; (0, 0) is the middle of the top-left pixel.

    AprilTag 3 counts pixels from their outer corner, and corners from the tag's bottom left, counter-clockwise.
    """
    return {d.tag_id: d.corners[::-1] - 0.5 for d in detector.detect(pixels)}


def seen_from(p: Array, R: Array, K: Array) -> Array:
    """Pinhole projection (4, 2) of a tag's corners."""
    at = p + CORNERS @ R.T
    flat = at @ K.T
    return np.asarray(flat[:, :2] / flat[:, 2:])


@cache
def _underway(condition: str) -> SimulatedRun:
    still = {"camera_hz": "1", "tide_m": "0", "condition": condition, "duration_s": "4"}
    return simulate(find_scenario("bl3-clean", still), 1)


@contextmanager
def bench(
    tag: dict[str, Any], camera: RigCamera | None = None, condition: str = "optimal", **more: Any
) -> Iterator[tuple[SimulatedRun, Camera]]:
    """A vessel lying still at the origin, bow to the north, before one tag on a wall."""
    harbour = make_harbour(
        {
            "name": "bench", "datum": {"latitude_deg": 57.7, "longitude_deg": 11.7}, "image_m": [-30, -30, 30, 30],
            "quays": [{"outline": [[-20, 20], [20, 20], [20, 25], [-20, 25]], "top_m": 12.0}],
            "routes": {"here": [[0, 0]]}, "tags": [{"number": 5, "facing_deg": 180, **tag}], **more,
        },
        "bench",
    )  # fmt: skip
    run = _underway(condition)
    block = ((-3.0, -1.0), (-2.0, -1.0), (-2.0, 1.0), (-3.0, 1.0))  # the vessel: behind the camera
    hull = HullConfig(outline=block, top_m=0.5, cabin=block, cabin_top_m=1.0)
    rig = RigConfig(
        **{**dict(load_rig("tiara")), "hull": hull, "cameras": {"camera": camera or RigCamera(mount=LOOKING_AHEAD)}}
    )
    run = replace(run, harbour=harbour, docks=(), rig=rig, motion=_Still())
    yield run, Camera("camera", Scene(harbour, (), 0.0, (), rig.hull), run)


class _Still(Motion):
    """At the origin, 2 m up, bow to the north."""

    def __init__(self) -> None:
        pass

    def pose(self, t: Array) -> tuple[Array, Array, Array]:
        R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        n = len(t)
        return np.tile([0.0, 0.0, 2.0], (n, 1)), np.tile(R, (n, 1, 1)), np.zeros((n, 3))
