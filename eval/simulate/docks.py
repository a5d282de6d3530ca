# SPDX-License-Identifier: Apache-2.0
"""Motion of floating docks, and the tags on quays and docks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.eval.simulate._truth import Waves
from graphloc.eval.simulate.harbour import Dock, Harbour, Tag
from graphloc.frames import Array

# RMS heave and tilt of a heavy dock by the harbour's chop, and its period
_HEAVE_M, _TILT_DEG, _CHOP_S = 0.02, 0.2, 4.0
SURVEY_SIGMA_M, SURVEY_SIGMA_DEG = 0.01, 0.3  # errors of a total station, and of a plate mounted on a wall


@dataclass(frozen=True, slots=True, eq=False)
class MovingDock:
    """A dock's true motion.

    Its frame `dock` is parallel to world while it is at rest; its origin is the middle of its outline, at the
    waterline.

    Attributes:
        dock: its block in the harbour file. rest_m: (2,) its place at rest. tide_m: height of the water over its mean.
        waves: of east, north, yaw, heave, roll, pitch.
    """

    dock: Dock
    rest_m: Array
    tide_m: float
    waves: tuple[Waves, ...]

    def pose(self, t: Array) -> tuple[Array, Array]:
        """Return p (N, 3) m and R (N, 3, 3) of dock in world at t (N,) s."""
        east, north, yaw, heave, roll, pitch = (w.at(t) for w in self.waves)
        p = np.column_stack([self.rest_m[0] + east, self.rest_m[1] + north, self.tide_m + heave])
        return p, Rotation.from_euler("xyz", np.column_stack([roll, pitch, yaw])).as_matrix()


def moving_docks(harbour: Harbour, tide_m: float, rng: np.random.Generator) -> tuple[MovingDock, ...]:
    """Draw the motion of a harbour's docks; within four hours each wanders just as far as its block states."""
    t = np.arange(0.0, 4.0 * 3600.0, 0.5)

    def wander(size: float, period_s: float) -> Waves:
        drawn = Waves.jonswap(rng, 1.0, period_s)
        return Waves(drawn.amplitude * size / np.abs(drawn.at(t)).max(), drawn.omega, drawn.phase)

    found = []
    for polygon, dock in harbour.docks:
        far = [dock.moves_m, dock.moves_m, np.radians(dock.moves_deg)]
        chop = [_HEAVE_M, np.radians(_TILT_DEG), np.radians(_TILT_DEG)]
        waves = [wander(size, dock.period_s) for size in far] + [Waves.jonswap(rng, size, _CHOP_S) for size in chop]
        middle = polygon.centroid
        found.append(MovingDock(dock, np.array([middle.x, middle.y]), tide_m, tuple(waves)))
    return tuple(found)


def tag_pose(tag: Tag, harbour: Harbour) -> tuple[Array, Array]:
    """Return position (3,) m and rotation (3, 3) of a tag in world, or in its dock.

    Tag axes: x right, y up, z out of the printed face.
    """
    rest = np.zeros(2)
    if tag.dock:
        (middle,) = (polygon.centroid for polygon, dock in harbour.docks if dock.name == tag.dock)
        rest = np.array([middle.x, middle.y])
    heading = np.radians(tag.facing_deg)
    out = np.array([np.sin(heading), np.cos(heading), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.array([*(np.array(tag.at) - rest), tag.height_m]), np.column_stack([np.cross(up, out), up, out])


def survey(harbour: Harbour, rng: np.random.Generator) -> dict[str, object]:
    """Return the survey of the tags, for `tags.yaml`, with a surveyor's errors."""
    tags = []
    for tag in harbour.config.tags:
        p, R = tag_pose(tag, harbour)
        seen = R @ Rotation.from_rotvec(np.radians(rng.normal(0.0, SURVEY_SIGMA_DEG, 3))).as_matrix()
        rpy = Rotation.from_matrix(seen).as_euler("xyz", degrees=True)
        tags.append({
            "id": tag.number, "family": "36h11", "size_m": tag.size_m, "frame": tag.dock or "world",
            "xyz_m": [round(float(v), 3) for v in p + rng.normal(0.0, SURVEY_SIGMA_M, 3)],
            "rpy_deg": [round(float(v), 2) for v in rpy],
            "sigma_m": SURVEY_SIGMA_M, "sigma_deg": SURVEY_SIGMA_DEG,
        })  # fmt: skip
    docks = [
        {"name": dock.name, "xyz_m": [round(polygon.centroid.x, 3), round(polygon.centroid.y, 3), 0.0],
         "rpy_deg": [0.0, 0.0, 0.0], "moves_m": dock.moves_m, "moves_deg": dock.moves_deg}
        for polygon, dock in harbour.docks
    ]  # fmt: skip
    return {"tags": tags, "docks": docks}
