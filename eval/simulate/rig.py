# SPDX-License-Identifier: Apache-2.0
"""Equipment of a vessel, from a text file: hull, positions of IMU and antenna, LiDARs and cameras.

Shipped: `rigs/*.yaml`; docs/simulator.md explains the file.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from pydantic import Field, model_validator

from graphloc.blocks import Block, Finite, MountConfig, NonNegative, Positive
from graphloc.eval.simulate._files import load_block
from graphloc.eval.simulate.harbour import RESERVED, Outline
from graphloc.frames import Array

Focal = Annotated[float, Field(gt=1.0, le=1e5)]
_SHIPPED = resources.files("graphloc.eval.simulate") / "rigs"

LIDAR_MAKES: dict[str, dict[str, float]] = {  # BL table 3.1
    "bpearl": {"range_m": 100.0, "lowest_deg": 0.0, "highest_deg": 87.19},
    "helios": {"range_m": 150.0, "lowest_deg": -55.0, "highest_deg": 15.0},
}


class HullConfig(Block):
    """Part of the vessel that its own sensors see; metres in body, heights over the waterline."""

    outline: Outline
    """Corners of the hull, forward and port, m."""
    top_m: Finite
    """Height of its deck, m."""
    cabin: Outline
    """Corners of the cabin, m."""
    cabin_top_m: Finite
    """Height of its roof, m."""


class RigLidar(Block):
    """A turning LiDAR. With a `make`, only what differs from it is written."""

    make: Literal["bpearl", "helios"] | None = None
    """A known make, whose figures are the defaults."""
    mount: MountConfig
    """Pose of the sensor in body; it turns about its own z axis."""
    range_m: Positive
    """Largest range, m."""
    lowest_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    """Elevation of the lowest beam from its x-y plane, deg."""
    highest_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    """Elevation of the highest beam, deg."""
    beams: Annotated[int, Field(ge=1, le=512)] = 32
    """Beams between them."""
    step_deg: Annotated[float, Field(ge=0.02, le=30.0)] = 0.2
    """Between columns, deg."""
    sigma_m: NonNegative = 0.01
    """Noise of a range, m."""
    scan_s: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1
    """Time of a turn, s."""
    drop: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02
    """Share of returns that are lost."""

    @model_validator(mode="before")
    @classmethod
    def _figures_of_the_make(cls, raw: Any) -> Any:
        return {**LIDAR_MAKES.get(str(raw.get("make")), {}), **raw} if isinstance(raw, dict) else raw

    @property
    def T_body_lidar(self) -> Array:
        """Pose of the sensor in body (4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.mount.R_body_sensor, self.mount.t_body_sensor_m
        return T


class RigCamera(Block):
    """A grey camera that exposes its whole image at once. Defaults are Digerud's ZED 2i (D eq. 3.1)."""

    mount: MountConfig
    """Pose of the optical frame (x right, y down, z forward) in body: looking ahead is rpy_deg: [-90, 0, -90]."""
    width_px: Annotated[int, Field(ge=64, le=8192)] = 2208
    """Columns."""
    height_px: Annotated[int, Field(ge=64, le=8192)] = 1242
    """Rows."""
    focal_px: tuple[Focal, Focal] = (1069.38, 1069.38)
    """Focal lengths fx, fy, px."""
    centre_px: tuple[Finite, Finite] = (1103.67, 664.69)
    """Principal point cx, cy, px; (0, 0) is the centre of the top-left pixel."""
    model: Literal["plumb_bob", "rational_polynomial", "equidistant"] = "plumb_bob"
    """Distortion model, as in `sensor_msgs/CameraInfo`."""
    distortion: tuple[Finite, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Its coefficients: 5, 8 or 4."""
    blur_px: NonNegative = 0.75
    """Standard deviation of the lens's blur, px."""
    electrons_per_ms: Positive = 2000.0
    """What a white surface in daylight gives a pixel in a millisecond."""
    full_well: Positive = 10000.0
    """Electrons that make a pixel white at gain 1."""
    read_noise: NonNegative = 6.0
    """Noise of reading a pixel, electrons."""
    longest_ms: Positive = 30.0
    """Longest exposure, ms."""
    highest_gain: Annotated[float, Field(ge=1.0)] = 16.0
    """Highest gain."""

    @model_validator(mode="after")
    def _as_many_as_the_model_has(self) -> RigCamera:
        needed = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}[self.model]
        if len(self.distortion) != needed:
            raise ValueError(f"distortion: {self.model} has {needed} coefficients, not {len(self.distortion)}")
        return self

    @property
    def K(self) -> Array:
        """Camera matrix (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


class RigConfig(Block):
    """A whole rig file."""

    vessel: str
    """Name of the vessel."""
    hull: HullConfig
    """What its own sensors see of it."""
    imu: MountConfig
    """Where the IMU sits."""
    gnss: MountConfig
    """Where the antenna sits."""
    lidars: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")], RigLidar] = Field(default_factory=dict)
    """LiDARs by name; all turn together."""
    cameras: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")], RigCamera] = Field(default_factory=dict)
    """Cameras by name."""

    @model_validator(mode="after")
    def _can_be_built(self) -> RigConfig:
        for key, outline in (("outline", self.hull.outline), ("cabin", self.hull.cabin)):
            polygon = shapely.Polygon(outline)
            if not polygon.is_valid or polygon.area < 1e-3:
                raise ValueError(f"hull.{key}: crosses itself, or has no area")
        names = [*self.lidars, *self.cameras, *(f"{camera}_optical_frame" for camera in self.cameras)]
        taken = [n for k, n in enumerate(names) if n in RESERVED or n in names[:k]]
        if taken:
            raise ValueError(f"'{taken[0]}' cannot name a sensor: it names another frame already")
        return self


@lru_cache(maxsize=8)
def load_rig(name_or_path: str) -> RigConfig:
    """Read a rig, shipped by name or from a file.

    Raises:
        ConfigError: there is none, or it is invalid.
    """
    rig, _ = load_block("rig", name_or_path, _SHIPPED, RigConfig)
    return rig
