# SPDX-License-Identifier: Apache-2.0
"""Lines of quays, piers and shores, drawn by a user or from OpenStreetMap: GeoJSON, in world.

The side of a line on which land is comes from the tags of features (keys as in OpenStreetMap; "no" counts as absent):

- a polygon with the property `graphloc` = "water" or "land": as stated;
- a polygon of land: `building`, `man_made` = pier, quay, breakwater, groyne or jetty, `natural` = land or coastline,
  `place` = island or islet;
- else a polygon of water: `water`, `natural` = water, bay or strait, `landuse` = basin or reservoir, `harbour`,
  `waterway` = riverbank, river, canal, dock or fairway;
- a line `natural` = coastline: land is on its left;
- any other: unknown. Its lines are edges, not shores.

Tags that ogr2ogr packs into one text (`other_tags`) are not read. RFC 7946 requires counter-clockwise outer rings, but
files often differ, so the inside of a ring is computed. A common border of two polygons with land on opposite sides
(water in two parts, a terrace of houses) is no shore, and not visible: it is left out.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from graphloc.errors import InputError
from graphloc.frames import Array, Datum, wrap_angle

_LAND: dict[str, set[str] | None] = {
    "building": None,  # whatever its value
    "man_made": {"pier", "quay", "breakwater", "groyne", "jetty"},
    "natural": {"land", "coastline"},
    "place": {"island", "islet"},
}
_WATER: dict[str, set[str] | None] = {
    "water": None,
    "natural": {"water", "bay", "strait"},
    "landuse": {"basin", "reservoir"},
    "harbour": None,
    "waterway": {"riverbank", "river", "canal", "dock", "fairway"},  # not dam, weir, boatyard, ...
}
_MOST_BYTES = 200_000_000
_FAR_M = 50e3
_HORIZON_M = 1000e3

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class VectorMap:
    """Lines drawn by a user (QGIS) or from OpenStreetMap, in world.

    Attributes:
        segments_m: (S, 2, 2) ends east, north of each straight segment.
        to_land_rad: (S,) direction across the line towards land, from east, counter-clockwise; NaN if unknown.
    """

    segments_m: Array
    to_land_rad: Array

    def around(self, centre_m: Array, half_m: float) -> VectorMap:
        """Return the segments, whole, that may intersect the square of `half_m` around a point (2,) in world.

        An oblique segment whose bounding box intersects the square is returned even if it passes by.
        """
        low, high = self.segments_m.min(axis=1), self.segments_m.max(axis=1)
        near = ((low <= centre_m + half_m) & (high >= centre_m - half_m)).all(axis=1)
        return replace(self, segments_m=self.segments_m[near], to_land_rad=self.to_land_rad[near])


class _Line(NamedTuple):
    """A line of a file: positions (P, 2), x and y as written, P > 1; side of land: 1 left, -1 right, 0 unknown.

    The side of a ring refers to its counter-clockwise direction.
    """

    xy: Array
    land: int
    ring: bool


@dataclass(slots=True)
class _Found:
    lines: list[_Line] = field(default_factory=list)
    points: int = 0


def read_vector(path: Path, datum: Datum) -> VectorMap:
    """Read a GeoJSON file (RFC 7946: longitude, latitude on WGS 84; heights are not used).

    A `crs` member of older GeoJSON is honoured, with x, y as east, north, as GDAL writes them. Lines that are straight
    in the file are taken as straight in world: 500 m east at 57 deg north bend by less than 1 cm. Segments longer than
    50 km, which bend by 70 m, and segments beyond 1000 km from the datum are omitted. Longitudes may be from -180 to
    360.

    Raises:
        InputError: the file cannot be read, is not GeoJSON, has no line, or is farther than 50 km from the datum.
    """
    try:
        document = _document(path)
        found = _Found()
        for where, feature in _features(document):
            try:
                _gather(found, _tags_of(feature), feature.get("geometry"))
            except ValueError as error:
                raise ValueError(f"{where}{error}") from None
        if not found.lines:
            raise ValueError(f"no line or polygon in it ({found.points} points): lines are what is matched")
        p_m, degrees = _in_world(np.vstack([line.xy for line in found.lines]), _crs_of(document), datum)
        drawn = _segments(found, p_m, degrees)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{path}: nested too deep") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    if found.points:
        log.info("%s: %d points left out: they are no lines", path, found.points)
    return drawn


def _document(path: Path) -> Mapping[str, Any]:
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"more than {_MOST_BYTES // 10**6} MB: cut out what is near the run")

    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} in it is no number")

    content = path.read_bytes()
    try:
        document = json.loads(content, parse_constant=refuse)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"not JSON ({error}): export it as GeoJSON") from None
    if isinstance(document, dict) and isinstance(document.get("type"), str):
        return document
    raise ValueError("not GeoJSON (no `type`)")


def _features(document: Mapping[str, Any]) -> Iterable[tuple[str, Mapping[str, Any]]]:
    """Yield each feature, and its name for messages."""
    if document["type"] == "FeatureCollection":
        features = document.get("features")
        if not isinstance(features, list):
            raise ValueError("not GeoJSON (a FeatureCollection without a list of `features`)")
        for k, feature in enumerate(features):
            if not isinstance(feature, dict) or feature.get("type") != "Feature":
                raise ValueError(f"feature {k}: not GeoJSON (no Feature)")
            yield f"feature {k}: ", feature
    elif document["type"] == "Feature":
        yield "", document
    else:
        yield "", {"geometry": document}


def _tags_of(feature: Mapping[str, Any]) -> Mapping[str, str]:
    properties = feature.get("properties")
    given = properties.items() if isinstance(properties, dict) else ()
    return {k: str(v) for k, v in given if v not in (None, False, "", "no")}


def _gather(found: _Found, tags: Mapping[str, str], geometry: Any) -> None:
    """Append the lines of a geometry to `found`; a null geometry has none."""
    if geometry is None:
        return
    kind = geometry.get("type") if isinstance(geometry, dict) else geometry
    try:
        match kind:
            case "GeometryCollection":
                for part in geometry["geometries"]:
                    _gather(found, tags, part)
            case "Point":
                found.points += 1
            case "MultiPoint":
                found.points += len(geometry["coordinates"])
            case "LineString" | "MultiLineString":
                land = _land_of(tags, polygon=False)
                lines = geometry["coordinates"]
                for line in [lines] if kind == "LineString" else lines:
                    xy = _positions(line)
                    found.lines += [_Line(xy, land, ring=False)] if len(xy) > 1 else []
            case "Polygon" | "MultiPolygon":
                land = _land_of(tags, polygon=True)
                polygons = geometry["coordinates"]
                for rings in [polygons] if kind == "Polygon" else polygons:
                    for k, ring in enumerate(rings):
                        xy = _positions(ring)
                        closed = np.vstack([xy, xy[:1]])  # twice closed does no harm
                        found.lines += [_Line(closed, -land if k else land, ring=True)] if len(xy) > 1 else []
            case _:
                raise ValueError(f"not GeoJSON (no geometry is of type {str(kind)[:40]!r})")
    except (TypeError, KeyError):
        raise ValueError(f"not GeoJSON (a {kind} without lists of positions)") from None


def _positions(line: Any) -> Array:
    """Return positions (P, 2), x and y, of a list of coordinates."""
    try:
        pairs = [(x, y) for x, y, *_ in line]
    except ValueError:
        raise ValueError("a position is not two or three numbers") from None
    wrong = [v for pair in pairs for v in pair if type(v) not in (int, float)]
    if wrong:
        raise ValueError(f"coordinates are not numbers ({str(wrong[0])[:40]!r})")
    try:
        xy = np.array(pairs, dtype=float).reshape(-1, 2)
    except OverflowError:
        xy = np.array([[np.inf, np.inf]])
    if not np.isfinite(xy).all():
        raise ValueError("coordinates are not finite")
    return xy


def _land_of(tags: Mapping[str, str], polygon: bool) -> int:
    """Return the side of land: 1 on the left of a line or inside a polygon, -1 on the other side, 0 unknown."""
    drawn = tags.get("graphloc")
    if drawn is not None and drawn not in ("land", "water"):
        raise ValueError(f"the property `graphloc` is {drawn[:40]!r}: water or land")
    if not polygon:
        if drawn is not None:
            raise ValueError("the property `graphloc` on a line, which has no inside: draw a polygon")
        return 1 if tags.get("natural") == "coastline" else 0
    if drawn is not None:
        return 1 if drawn == "land" else -1
    for land, keys in ((1, _LAND), (-1, _WATER)):
        if any(k in tags and (values is None or tags[k] in values) for k, values in keys.items()):
            return land
    return 0


def _crs_of(document: Mapping[str, Any]) -> CRS | None:
    """Return the CRS that an older GeoJSON names; None if it names none."""
    member = document.get("crs")
    if member is None:
        return None
    try:
        crs = CRS.from_user_input(member["properties"]["name"])
        Transformer.from_crs(crs, 4326)
        return crs
    except (ProjError, TypeError, KeyError):
        raise ValueError("its `crs` member names no CRS that is known: export it as WGS 84 (EPSG:4326)") from None


def _in_world(xy: Array, crs: CRS | None, datum: Datum) -> tuple[Array, Array]:
    """Return points (N, 3) in world, and degrees (N, 2) east, north of the datum, of positions (N, 2) as written."""
    to_wgs84 = None if crs is None else Transformer.from_crs(crs, 4326, always_xy=True)

    def placed(x: Array, y: Array) -> tuple[Array, Array] | None:
        longitude, latitude = (x, y) if to_wgs84 is None else to_wgs84.transform(x, y)
        if not ((np.abs(longitude) <= 360.0) & (np.abs(latitude) <= 90.0)).all():
            return None
        # To (-180, 180], so that -180 and 180 are equal to the last bit.
        longitude = np.where(longitude > 180.0, longitude - 360.0, longitude)
        longitude = np.where(longitude <= -180.0, longitude + 360.0, longitude)
        east = (longitude - datum.origin.longitude_deg + 180.0) % 360.0 - 180.0
        p = datum.enu_from_geodetic(latitude, longitude, np.full(len(x), datum.origin.height_m))
        return p, np.column_stack([east, latitude])

    def away(found: tuple[Array, Array] | None) -> float:
        return np.inf if found is None else float(np.linalg.norm(found[0], axis=1).min())

    p = placed(xy[:, 0], xy[:, 1])
    if p is not None and away(p) <= _FAR_M:
        return p
    if away(placed(xy[:, 1], xy[:, 0])) <= _FAR_M:
        raise ValueError("looks like latitude, longitude; GeoJSON wants longitude, latitude (x, y)")
    if p is None:
        what = "are no degrees" if crs is None else f"are beyond {crs.name}"
        raise ValueError(f"coordinates as large as {np.abs(xy).max():.0f} {what}: export it as WGS 84 (EPSG:4326)")
    raise ValueError(f"lies {away(p) / 1000.0:.0f} km from the datum: another file, or another `datum:`")


def _segments(found: _Found, p_m: Array, degrees: Array) -> VectorMap:
    """Return the segments of lines through points, (N, 3) in world and (N, 2) in degrees east, north of the datum."""
    lengths = [len(line.xy) for line in found.lines]
    line = np.repeat(np.arange(len(lengths)), lengths)
    of = line[1:][line[1:] == line[:-1]]
    within = line[1:] == line[:-1]
    # Twice the signed area of a ring, positive if counter-clockwise, about its first point, which saves digits. It is
    # in degrees, since the tangent plane mirrors what is beyond the horizon.
    since = degrees[:-1][within] - degrees[np.cumsum([0, *lengths[:-1]])[of]]
    turn = np.diff(degrees, axis=0)[within]
    area = np.bincount(of, since[:, 0] * turn[:, 1] - since[:, 1] * turn[:, 0], len(lengths))
    ring = np.array([f.ring for f in found.lines])
    left = (np.array([f.land for f in found.lines]) * np.where(ring, np.sign(area), 1.0))[of]
    length_m = np.linalg.norm(np.diff(p_m, axis=0)[within], axis=1)
    away_m = np.linalg.norm(p_m, axis=1)
    useful = (length_m <= _FAR_M) & (np.maximum(away_m[:-1], away_m[1:])[within] <= _HORIZON_M)
    if not useful.all():
        log.info("%d pieces of lines left out: longer than 50 km, or beyond 1000 km", (~useful).sum())
    ends = np.stack([p_m[:-1, :2], p_m[1:, :2]], axis=1)[within]
    step = ends[:, 1] - ends[:, 0]
    useful &= step.any(axis=1)
    if not useful.any():
        raise ValueError("no piece of its lines has a length of up to 50 km: draw them finer, near the run")
    keep = useful & ~_contradicted(ends, left)
    to_land = np.arctan2(step[:, 1], step[:, 0]) + np.where(left == 0.0, np.nan, left * 0.5 * np.pi)
    return VectorMap(ends[keep], wrap_angle(to_land[keep]))


def _contradicted(ends: Array, left: Array) -> NDArray[np.bool_]:
    """Return (S,) which segments (S, 2, 2) occur again with land on the other side; `left` (S,): side, 1, -1 or 0."""
    back = (ends[:, 0, 0] > ends[:, 1, 0]) | ((ends[:, 0, 0] == ends[:, 1, 0]) & (ends[:, 0, 1] > ends[:, 1, 1]))
    forth = np.where(back[:, None, None], ends[:, ::-1], ends).reshape(-1, 4)
    same = np.unique(forth, axis=0, return_inverse=True)[1].ravel()
    side = np.where(back, -left, left)
    return np.asarray(((np.bincount(same, side > 0) > 0) & (np.bincount(same, side < 0) > 0))[same])
