# SPDX-License-Identifier: Apache-2.0
"""A harbour from a text file: its objects, their heights, and those that move with the tide.

Metres east and north of the harbour's datum, heights over mean water. Outlines are polygons; `repeat` places copies of an object.
Shipped: `harbours/*.yaml`; docs/simulator.md explains the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Annotated, Literal

import numpy as np
import shapely
from pydantic import Field
from shapely import affinity, ops
from shapely.validation import explain_validity

from graphloc.blocks import Block, Finite, NonNegative, Positive
from graphloc.config import DatumConfig
from graphloc.errors import ConfigError
from graphloc.eval.simulate._files import load_block, shipped_names, validated
from graphloc.frames import Array, Datum, yaw_from_heading_deg

Metres = Annotated[float, Field(ge=-2e4, le=2e4)]
Point = tuple[Metres, Metres]
Outline = Annotated[tuple[Point, ...], Field(min_length=3)]
Surface = Literal["concrete", "asphalt", "wood", "grass", "roof", "stone"]
RESERVED = frozenset({"world", "map", "odom", "base_link", "imu_link", "gnss", "truth"})  # frames of every bag
_LARGEST_IMAGE_M = 4000.0
_NORTHERNMOST_DEG = 80.0  # beyond, UTM ends
_SHIPPED = resources.files("graphloc.eval.simulate") / "harbours"


class Repeat(Block):
    """Copies beside each other."""

    count: Annotated[int, Field(ge=1, le=200)]
    """How many, the first one included."""
    step_m: Point
    """From one to the next: east, north, m."""


class Solid(Block):
    """Something with an outline and a flat top."""

    outline: Outline
    """Corners, east and north, m; the last one is joined to the first."""
    top_m: Finite
    """Height of the top over mean water (a pontoon: over the water), m."""
    surface: Surface = "concrete"
    """What it looks like."""
    repeat: Repeat | None = None
    """Copies of it."""


class Pole(Block):
    """A mooring pole or a lamp."""

    at: Point
    """Its axis, east and north, m."""
    top_m: Positive = 3.0
    """Height over mean water, m."""
    radius_m: Positive = 0.15
    """Radius, m."""
    repeat: Repeat | None = None
    """Copies of it."""


class Mooring(Block):
    """A place for a boat. Which boats lie there differs between the image and the day of the run."""

    at: Point
    """Middle of the boat, east and north, m."""
    heading_deg: Finite
    """Where its bow points, from true north, clockwise, deg."""
    length_m: Positive = 8.0
    """Length of a usual boat there, m."""
    occupied: Annotated[float, Field(ge=0.0, le=1.0)] = 0.7
    """Share of days on which one lies there."""
    repeat: Repeat | None = None
    """Copies of it."""


class Dock(Block):
    """A floating dock on slack chains: it rises with the tide and wanders about its place at rest."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    """For tags, topics and routes."""
    outline: Outline
    """Corners at rest, east and north, m."""
    top_m: Finite
    """Height of its deck over the water, m."""
    surface: Surface = "concrete"
    """What it looks like."""
    moves_m: NonNegative = 0.3
    """How far it wanders east and north, m."""
    moves_deg: NonNegative = 1.5
    """How far it turns, deg."""
    period_s: Annotated[float, Field(ge=2.0, le=3600.0)] = 25.0
    """Period of its wandering, s."""


class Tag(Block):
    """An AprilTag of the family 36h11 on a plate, 1.21 times as wide as the tag (D 3.2.2)."""

    number: Annotated[int, Field(ge=0, le=586)]
    """Its id."""
    at: Point
    """Its middle, east and north, m; of one on a dock: with the dock at rest."""
    height_m: Finite
    """Of its middle over mean water; of one on a dock: over the water, m."""
    facing_deg: Finite
    """Where its printed face looks, from true north, clockwise, deg."""
    size_m: Positive = 0.412
    """Between the outer corners of the black square, m."""
    dock: str = ""
    """The dock it rides on; empty: it stands still."""


class HarbourConfig(Block):
    """A whole harbour file."""

    name: str
    """For titles."""
    datum: DatumConfig
    """Origin of its metres; the height is that of mean water over the ellipsoid."""
    image_m: tuple[Metres, Metres, Metres, Metres]
    """What the aerial image shows: west, south, east, north edge, m."""
    quays: tuple[Solid, ...] = ()
    """Land, quays and piers: they stand still."""
    buildings: tuple[Solid, ...] = ()
    """Houses and sheds on the quays."""
    pontoons: tuple[Solid, ...] = ()
    """Pontoons between piles: they rise with the tide."""
    docks: tuple[Dock, ...] = ()
    """Floating docks: they rise with the tide and wander."""
    tags: tuple[Tag, ...] = ()
    """AprilTags."""
    poles: tuple[Pole, ...] = ()
    """Poles."""
    berths: tuple[Mooring, ...] = ()
    """Places for boats."""
    routes: dict[str, Annotated[tuple[Point, ...], Field(min_length=1)]] = Field(default_factory=dict)
    """Waypoints of a run, by name; one waypoint: the vessel lies still there."""


@dataclass(frozen=True, slots=True, eq=False)
class Boat:
    """A moored boat: middle (2,) m, yaw rad, length m."""

    at: Array
    yaw_rad: float
    length_m: float

    @property
    def outline(self) -> Array:
        """Corners (7, 2): a transom, sides, a bow."""
        half, beam = 0.5 * self.length_m, 0.16 * self.length_m
        hull = np.array(
            [(-half, -beam), (0.3 * half, -beam), (0.75 * half, -0.6 * beam), (half, 0.0),
             (0.75 * half, 0.6 * beam), (0.3 * half, beam), (-half, beam)]
        )  # fmt: skip
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.asarray(hull @ np.array([[c, s], [-s, c]]) + self.at)


@dataclass(frozen=True, slots=True, eq=False)
class Harbour:
    """A validated harbour, with all copies.

    Attributes:
        config: the file. datum: its datum. quays, buildings, pontoons, docks: (polygon, block) each. poles: (at, block).
    """

    config: HarbourConfig
    datum: Datum
    quays: tuple[tuple[shapely.Polygon, Solid], ...]
    buildings: tuple[tuple[shapely.Polygon, Solid], ...]
    pontoons: tuple[tuple[shapely.Polygon, Solid], ...]
    docks: tuple[tuple[shapely.Polygon, Dock], ...]
    poles: tuple[tuple[Array, Pole], ...]

    def boats(self, rng: np.random.Generator) -> tuple[Boat, ...]:
        """Draw the boats of one day."""
        found = []
        for berth in self.config.berths:
            for shift in _shifts(berth.repeat):
                there, length = rng.uniform() < berth.occupied, berth.length_m * rng.uniform(0.75, 1.15)
                turned = yaw_from_heading_deg(berth.heading_deg) + (np.pi if rng.uniform() < 0.4 else 0.0)
                moved = rng.normal(0.0, [0.3, 0.3, np.radians(1.5)])
                if there:
                    at = np.array(berth.at) + shift + moved[:2]
                    found.append(Boat(at, float(turned + moved[2]), float(length)))
        return tuple(found)

    def waypoints(self, route: str) -> Array:
        """Return the waypoints (N, 2) of a route.

        Raises:
            ConfigError: an unknown name.
        """
        routes = self.config.routes
        if route not in routes:
            raise ConfigError(
                f"harbour '{self.config.name}': no route '{route}'; it has: {', '.join(routes) or 'none'}"
            )
        points = np.array(routes[route], dtype=float)
        step = np.diff(points, axis=0)
        if (np.hypot(*step.T) < 0.5).any():
            raise ConfigError(f"harbour '{self.config.name}': route '{route}' has waypoints less than 0.5 m apart")
        turn = np.abs(np.angle(np.exp(1j * np.diff(np.arctan2(step[:, 1], step[:, 0])))))
        if (turn > np.radians(150.0)).any():
            raise ConfigError(
                f"harbour '{self.config.name}': route '{route}' turns back on itself: a vessel needs a bend"
            )
        return points

    def refuse_collision(self, hulls: Sequence[shapely.Polygon], clear_m: float, route: str) -> None:
        """Refuse a run whose successive hulls come nearer than `clear_m` to a solid object.

        Raises:
            ConfigError: one does; the line names the object and the position.
        """
        solids = [("quay", polygon) for polygon, _ in self.quays]
        solids += [("building", polygon) for polygon, _ in self.buildings]
        solids += [("pontoon", polygon) for polygon, _ in self.pontoons]
        solids += [(f"dock '{dock.name}'", polygon.buffer(dock.moves_m)) for polygon, dock in self.docks]
        solids += [("pole", shapely.Point(at).buffer(pole.radius_m)) for at, pole in self.poles]
        swept = shapely.union_all(hulls)
        for kind, solid in solids:
            away = swept.distance(solid)
            if away < clear_m:
                near, _ = ops.nearest_points(solid, swept)
                raise ConfigError(
                    f"harbour '{self.config.name}': on route '{route}' the hull comes within {away:.1f} m of a {kind}, near "
                    f"({near.x:.1f}, {near.y:.1f}); {clear_m:g} m are needed: move its waypoints"
                )


def _shifts(repeat: Repeat | None) -> Iterator[Array]:
    for k in range(repeat.count if repeat else 1):
        yield k * np.array(repeat.step_m if repeat else (0.0, 0.0))


def _polygon(outline: Outline, where: str) -> shapely.Polygon:
    polygon = shapely.Polygon(outline)
    if not polygon.is_valid or polygon.area < 1e-3:
        why = explain_validity(polygon) if not polygon.is_valid else "it has no area"
        raise ConfigError(f"{where}.outline: not a polygon that can be built ({why})")
    return polygon


def _polygons(kind: str, solids: Sequence[Solid], where: str) -> tuple[tuple[shapely.Polygon, Solid], ...]:
    return tuple(
        (affinity.translate(polygon, *shift), solid)
        for k, solid in enumerate(solids)
        for polygon in [_polygon(solid.outline, f"{where}: {kind}.{k}")]
        for shift in _shifts(solid.repeat)
    )


def make_harbour(raw: Mapping[str, object], where: str) -> Harbour:
    """Validate a harbour.

    Raises:
        ConfigError: one line that names the file, the block and the error.
    """
    return _built(validated(raw, where, HarbourConfig), where)


def _built(config: HarbourConfig, where: str) -> Harbour:
    west, south, east, north = config.image_m
    if not (west < east and south < north):
        raise ConfigError(f"{where}: image_m: west, south, east, north; the image has no area")
    if max(east - west, north - south) > _LARGEST_IMAGE_M:
        raise ConfigError(f"{where}: image_m: more than {_LARGEST_IMAGE_M:g} m across")
    if abs(config.datum.latitude_deg) > _NORTHERNMOST_DEG:
        raise ConfigError(
            f"{where}: datum.latitude_deg: beyond {_NORTHERNMOST_DEG:g} deg there is no UTM zone for the image"
        )
    for k, dock in enumerate(config.docks):
        if dock.name in RESERVED:
            raise ConfigError(f"{where}: docks.{k}.name: '{dock.name}' names another frame already")
    _refuse_doubles("docks", "name", [d.name for d in config.docks], where)
    _refuse_doubles("tags", "number", [t.number for t in config.tags], where)
    for k, tag in enumerate(config.tags):
        if tag.dock and tag.dock not in {d.name for d in config.docks}:
            raise ConfigError(f"{where}: tags.{k}.dock: there is no dock '{tag.dock}'")
    return Harbour(
        config=config,
        datum=Datum(config.datum.geodetic),
        quays=_polygons("quays", config.quays, where),
        buildings=_polygons("buildings", config.buildings, where),
        pontoons=_polygons("pontoons", config.pontoons, where),
        docks=tuple((_polygon(d.outline, f"{where}: docks.{k}"), d) for k, d in enumerate(config.docks)),
        poles=tuple((np.array(p.at) + shift, p) for p in config.poles for shift in _shifts(p.repeat)),
    )


def _refuse_doubles(kind: str, key: str, values: Sequence[object], where: str) -> None:
    for k, value in enumerate(values):
        if value in values[:k]:
            raise ConfigError(f"{where}: {kind}.{k}.{key}: {value} is there twice")


def shipped() -> tuple[str, ...]:
    """Names of the harbours that come with graphloc."""
    return shipped_names(_SHIPPED)


def load_harbour(name_or_path: str) -> Harbour:
    """Read a harbour, shipped by name or from a file.

    Raises:
        ConfigError: there is none, or it is invalid.
    """
    return _of_package(name_or_path) if name_or_path in shipped() else _read(name_or_path)


@cache
def _of_package(name: str) -> Harbour:
    """Return a shipped harbour, read once: a sweep asks for it run after run."""
    return _read(name)


def _read(name_or_path: str) -> Harbour:
    return _built(*load_block("harbour", name_or_path, _SHIPPED, HarbourConfig))
