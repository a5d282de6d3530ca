# SPDX-License-Identifier: Apache-2.0
"""`tags.yaml`: where tags are, how well that is known, which docks float, and where the berths are.

Tag axes: x right, y up, z out of the printed face; its place is its middle. A tag stands in world or rides on a dock;
a dock is a frame of its own, whose place at rest the file gives.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from graphloc.blocks import Block, Finite, NonNegative, Positive, Triple, one_line, read_mapping
from graphloc.errors import ConfigError
from graphloc.frames import Array, rotation_from_rpy_deg

WORLD = "world"
Size = Annotated[float, Field(gt=0.0, le=10.0)]  # larger: it was given in mm
Family = Literal["16h5", "25h9", "36h10", "36h11"]


def _family(given: object) -> object:
    """`tag36h11` of the AprilTag library and `DICT_APRILTAG_36h11` of OpenCV mean `36h11`."""
    return re.sub(r"^(dict_)?(apriltag|tag)?[_-]?", "", given.strip().lower()) if isinstance(given, str) else given


class TagConfig(Block):
    """A surveyed tag."""

    id: Annotated[int, Field(ge=0)]
    """Its number in its family."""
    family: Annotated[Family, BeforeValidator(_family)] = "36h11"
    """Its AprilTag family."""
    size_m: Size
    """Side of the black square, outer edge to outer edge (not of the white plate), m. It scales every distance."""
    frame: str = WORLD
    """`world`, or the dock that it is mounted on."""
    xyz_m: Triple
    """Its centre, in `frame`, m; in world: east, north, up from the datum."""
    rpy_deg: Triple | None = None
    """Roll, pitch, yaw of its axes (x right, y up, z out of the print) in `frame`, deg; this or `facing_deg`."""
    facing_deg: Finite | None = None
    """For an upright tag: direction its face looks, from `frame`'s y axis (in world: north), clockwise, deg."""
    sigma_m: NonNegative = 0.02
    """Accuracy of its position, each axis, 1 sigma, m."""
    sigma_deg: NonNegative = 1.0
    """Accuracy of its axes, about each, 1 sigma, deg."""

    @model_validator(mode="after")
    def _one_attitude(self) -> TagConfig:
        if (self.rpy_deg is None) == (self.facing_deg is None):
            raise ValueError(f"tag {self.id} needs rpy_deg or facing_deg, one of them")
        return self

    @property
    def R_frame_tag(self) -> Array:
        """Rotation (3, 3) that takes the tag's axes to its frame's."""
        if self.rpy_deg is not None:
            return rotation_from_rpy_deg(np.array(self.rpy_deg))
        heading = np.radians(float(self.facing_deg or 0.0))
        out, up = np.array([np.sin(heading), np.cos(heading), 0.0]), np.array([0.0, 0.0, 1.0])
        return np.column_stack([np.cross(up, out), up, out])

    @property
    def corners_m(self) -> Array:
        """Corners (4, 3) in its frame: top-left, top-right, bottom-right, bottom-left of the print."""
        half = 0.5 * self.size_m
        square = np.array([(-half, half, 0.0), (half, half, 0.0), (half, -half, 0.0), (-half, -half, 0.0)])
        return np.array(self.xyz_m) + square @ self.R_frame_tag.T


class DockConfig(Block):
    """A floating dock: it rises with the water and moves about its pose at rest."""

    name: Annotated[str, Field(min_length=1)]
    """Name that tags and berths refer to."""
    xyz_m: Triple = (0.0, 0.0, 0.0)
    """Its origin in world at rest, m; it rotates about this point."""
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of its axes in world at rest, deg."""
    moves_m: NonNegative = 0.3
    """Amplitude of its drift east and north, either way, m."""
    moves_deg: NonNegative = 1.5
    """Amplitude of its rotation (yaw), either way, deg."""
    tilts_deg: NonNegative = 1.0
    """Amplitude of roll and pitch in waves, either way, deg."""
    rises_m: NonNegative = 1.0
    """Height above or below `xyz_m` by tide, m."""
    period_s: Positive = 25.0
    """Approximate period of its drift, s."""
    heaves_m: NonNegative = 0.05
    """Amplitude of heave in waves, m."""
    wave_period_s: Positive = 4.0
    """Period of these waves, s; below 4.4 s it makes no difference."""


class BerthConfig(Block):
    """Where a vessel is to lie: a point of the quay's face, and the direction it faces."""

    name: Annotated[str, Field(min_length=1)]
    """Name in the outputs."""
    frame: str = WORLD
    """`world`, or the dock that it belongs to."""
    xyz_m: Triple
    """A point of the quay's face, in `frame`, m."""
    facing_deg: Finite
    """Direction the face looks (towards the water), from `frame`'s y axis (in world: north), clockwise, deg."""


class Survey(Block):
    """A whole `tags.yaml`."""

    grid: Annotated[str, Field(pattern=r"^(EPSG:\d{4,6})?$")] = ""
    """Map grid of all places in world, e.g. `EPSG:32632` for UTM zone 32 north: `xyz_m` are then easting, northing and height above the
    ellipsoid, m, and directions count from grid north. Empty: east, north, up from the datum, and true north."""
    tags: tuple[TagConfig, ...] = ()
    """The tags; ids are unique within a family."""
    docks: tuple[DockConfig, ...] = ()
    """The floating docks."""
    other_size_m: Size | None = None
    """Size of tags that are not listed, m; empty: it is estimated with their position."""
    berths: tuple[BerthConfig, ...] = ()
    """Berths; without any, each frame's tags make one, with its face through them."""

    @model_validator(mode="after")
    def _adds_up(self) -> Survey:
        twice = [f"{family} {number}" for (family, number), n in self._numbers().items() if n > 1]
        if twice:
            raise ValueError(f"tag {twice[0]} is there twice: ids must be unique, or a sighting has two places")
        names = Counter(dock.name for dock in self.docks)
        if WORLD in names or any(n > 1 for n in names.values()):
            raise ValueError("docks need names of their own, and none may be called 'world'")
        berths = Counter(berth.name for berth in self.berths)
        if any(n > 1 for n in berths.values()):
            raise ValueError(f"berth {berths.most_common(1)[0][0]} is there twice: outputs would mix the two")
        frames = {f"tag {tag.id}": tag.frame for tag in self.tags} | {f"berth {b.name}": b.frame for b in self.berths}
        for what, frame in frames.items():
            if frame != WORLD and frame not in names:
                raise ValueError(
                    f"{what}: frame '{frame}' is neither 'world' nor one of the docks ({', '.join(names) or 'there are none'})"
                )
        return self

    def _numbers(self) -> Counter[tuple[str, int]]:
        return Counter((tag.family, tag.id) for tag in self.tags)

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames that have tags: world first, then docks in the order of the file."""
        have = {tag.frame for tag in self.tags}
        return tuple(name for name in (WORLD, *(dock.name for dock in self.docks)) if name in have)

    def of(self, frames: Collection[str]) -> Survey:
        """Return the part of it that is in some frames; berths stay, or one that lists others would get its own."""
        tags = tuple(tag for tag in self.tags if tag.frame in frames)
        docks = tuple(dock for dock in self.docks if dock.name in frames)
        return self.model_copy(update={"tags": tags, "docks": docks})

    def called(self, family: str, number: int) -> str:
        """Return what messages call a tag: by its id, and by its family where the survey has several."""
        several = len({tag.family for tag in self.tags}) > 1
        return f"tag {number} ({family})" if several else f"tag {number}"

    def dock(self, frame: str) -> DockConfig | None:
        """Return the dock of a name; None for world."""
        return next((dock for dock in self.docks if dock.name == frame), None)

    def rest(self, frame: str) -> tuple[Array, Array]:
        """Return position (3,) m and rotation (3, 3) in world of a frame at rest."""
        dock = self.dock(frame)
        if dock is None:
            return np.zeros(3), np.eye(3)
        return np.array(dock.xyz_m), rotation_from_rpy_deg(np.array(dock.rpy_deg))


def load_survey(path: Path) -> Survey:
    """Read and validate a `tags.yaml`.

    Raises:
        ConfigError: one line that names the file, and what is wrong with it.
    """
    raw = read_mapping(path, ": `survey:` of the apriltag sensor names it")
    try:
        return Survey.model_validate(dict(raw))
    except ValidationError as error:
        raise ConfigError(one_line(error, Survey, str(path), "")) from None
