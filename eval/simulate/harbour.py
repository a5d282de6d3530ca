# SPDX-License-Identifier: Apache-2.0
"""A harbour from a text file: what stands where, how high, and what moves with the tide.

Metres east and north of the harbour's datum, heights over mean water. Outlines are polygons; `repeat`
sets copies of a thing beside each other. Shipped: `harbours/*.yaml`; docs/simulator.md explains the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import shapely
from pydantic import Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from shapely import affinity, ops
from shapely.validation import explain_validity

from graphloc.config import Block, DatumConfig, Finite, Positive, one_line
from graphloc.errors import ConfigError
from graphloc.frames import Array, Datum, yaw_from_heading_deg

Point = tuple[Finite, Finite]
Outline = Annotated[tuple[Point, ...], Field(min_length=3)]
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
    surface: Literal["concrete", "asphalt", "wood", "grass", "roof", "stone"] = "concrete"
    """What it looks like from above."""
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


class Berth(Block):
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


class HarbourConfig(Block):
    """A whole harbour file."""

    name: str
    """For titles."""
    datum: DatumConfig
    """Origin of its metres; the height is that of mean water over the ellipsoid."""
    image_m: tuple[Finite, Finite, Finite, Finite]
    """What the aerial image shows: west, south, east, north edge, m."""
    quays: tuple[Solid, ...] = ()
    """Land, quays and piers: they stand still."""
    buildings: tuple[Solid, ...] = ()
    """Houses and sheds on the quays."""
    pontoons: tuple[Solid, ...] = ()
    """Floating docks: they rise with the tide."""
    poles: tuple[Pole, ...] = ()
    """Poles."""
    berths: tuple[Berth, ...] = ()
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
    """A harbour that was checked, its copies spelt out.

    Attributes:
        config: the file. datum: its datum. quays, buildings, pontoons: (polygon, block) each. poles: (at, block).
    """

    config: HarbourConfig
    datum: Datum
    quays: tuple[tuple[shapely.Polygon, Solid], ...]
    buildings: tuple[tuple[shapely.Polygon, Solid], ...]
    pontoons: tuple[tuple[shapely.Polygon, Solid], ...]
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
            ConfigError: there is none of that name.
        """
        routes = self.config.routes
        if route not in routes:
            raise ConfigError(
                f"harbour '{self.config.name}': no route '{route}'; it has: {', '.join(routes) or 'none'}"
            )
        return np.array(routes[route], dtype=float)

    def refuse_collision(self, track: Array, clear_m: float, route: str) -> None:
        """Refuse a track (N, 2) that comes nearer than `clear_m` to a quay, a pontoon or a pole.

        Raises:
            ConfigError: it does; the line says to what, and where.
        """
        way = shapely.LineString(track) if len(track) > 1 else shapely.Point(track[0])
        solids = [("quay", polygon) for polygon, _ in self.quays] + [
            ("pontoon", polygon) for polygon, _ in self.pontoons
        ]
        solids += [("pole", shapely.Point(at)) for at, _ in self.poles]
        for kind, solid in solids:
            away = way.distance(solid)
            if away < clear_m:
                near, _ = ops.nearest_points(way, solid)
                raise ConfigError(
                    f"harbour '{self.config.name}': route '{route}' comes within {away:.1f} m of a {kind}, near "
                    f"({near.x:.1f}, {near.y:.1f}); {clear_m:g} m are needed: move its waypoints"
                )


def _shifts(repeat: Repeat | None) -> Iterator[Array]:
    for k in range(repeat.count if repeat else 1):
        yield k * np.array(repeat.step_m if repeat else (0.0, 0.0))


def _polygons(kind: str, solids: Sequence[Solid], where: str) -> tuple[tuple[shapely.Polygon, Solid], ...]:
    found = []
    for k, solid in enumerate(solids):
        polygon = shapely.Polygon(solid.outline)
        if not polygon.is_valid or polygon.area < 1e-3:
            why = explain_validity(polygon) if not polygon.is_valid else "it has no area"
            raise ConfigError(f"{where}: {kind}.{k}.outline: not a polygon that can be built ({why})")
        for shift in _shifts(solid.repeat):
            found.append((affinity.translate(polygon, *shift), solid))
    return tuple(found)


def make_harbour(raw: Mapping[str, object], where: str) -> Harbour:
    """Validate a harbour.

    Raises:
        ConfigError: one line that names the file, the block and what is wrong with it.
    """
    try:
        config = HarbourConfig.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(one_line(error, HarbourConfig, where, "")) from None
    west, south, east, north = config.image_m
    if not (west < east and south < north):
        raise ConfigError(f"{where}: image_m: west, south, east, north; the image has no area")
    return Harbour(
        config=config,
        datum=Datum(config.datum.geodetic),
        quays=_polygons("quays", config.quays, where),
        buildings=_polygons("buildings", config.buildings, where),
        pontoons=_polygons("pontoons", config.pontoons, where),
        poles=tuple((np.array(p.at) + shift, p) for p in config.poles for shift in _shifts(p.repeat)),
    )


def shipped() -> tuple[str, ...]:
    """Names of the harbours that come with graphloc."""
    return tuple(
        sorted(entry.name.removesuffix(".yaml") for entry in _SHIPPED.iterdir() if entry.name.endswith(".yaml"))
    )


def load_harbour(name_or_path: str) -> Harbour:
    """Read a harbour: one that is shipped, by name, or a file.

    Raises:
        ConfigError: there is none, or it cannot be used.
    """
    if name_or_path in shipped():
        text, where = (_SHIPPED / f"{name_or_path}.yaml").read_text(encoding="utf-8"), f"{name_or_path}.yaml"
    else:
        path = Path(name_or_path)
        if not path.exists():
            raise ConfigError(
                f"harbour '{name_or_path}': no such file, and none of the shipped ones: {', '.join(shipped())}"
            )
        text, where = path.read_text(encoding="utf-8"), str(path)
    try:
        raw = YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise ConfigError(f"{where}: not valid YAML: {' '.join(str(error).split())[:200]}") from None
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{where}: the top level must be a mapping")
    return make_harbour(raw, where)
