# SPDX-License-Identifier: Apache-2.0
"""Aerial image of a harbour, as cluttered as a real one, written as GeoTIFF in UTM.

Grid north of UTM differs from true north by the meridian convergence, which a reader has to handle. The image is of
another day than the run, with other boats, season and sun, and it is misregistered by `shift_m`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from graphloc.errors import OutputError
from graphloc.eval.simulate.harbour import Boat, Dock, Harbour, Solid
from graphloc.frames import Array, Datum

Image = NDArray[np.uint8]
Canvas = NDArray[np.float32]
Mask = NDArray[np.bool_]
_FINE = 2  # factor by which the image is drawn finer, then averaged: edges of a real image are not steps
# Red, green, blue, and amplitude of the grain of each surface.
_SURFACES = {
    "concrete": ((168, 165, 158), 9.0), "asphalt": ((92, 94, 97), 7.0), "wood": ((139, 115, 88), 10.0),
    "grass": ((96, 116, 70), 14.0), "roof": ((126, 78, 66), 8.0), "stone": ((150, 147, 140), 16.0),
}  # fmt: skip
_WATER, _WATER_NOISE = (38, 62, 72), 6.0
_KERB_M = 0.35
# 1 sigma of the misregistration, east and north: the default of `image_sigma_m`, so that this is true
_SHIFT_SIGMA_M = 0.3


class _Season(NamedTuple):
    """A season.

    Attributes:
        grass, water: colours. boats: share of the boats that are afloat. light: brightness of the image.
    """

    grass: tuple[int, int, int]
    water: tuple[int, int, int]
    boats: float
    light: float


_SEASONS = (
    _Season((96, 116, 70), _WATER, 1.0, 1.0),  # summer
    _Season((128, 118, 76), (46, 60, 62), 0.8, 0.95),  # autumn
    _Season((150, 146, 138), (52, 58, 62), 0.4, 0.85),  # winter: boats ashore, grass under frost
    _Season((104, 122, 60), (34, 66, 70), 0.9, 1.03),  # spring
)


@dataclass(frozen=True, slots=True, eq=False)
class RenderedImage:
    """An image with its georeference.

    Attributes:
        pixels: (rows, columns, 3) uint8, red, green, blue. epsg: of its grid.
        left_m, top_m: grid coordinates of the outer corner of the top-left pixel. pixel_m: size of a pixel.
        shift_m: (2,) east, north: misregistration, from the true position to that in the image.
    """

    pixels: Image
    epsg: int
    left_m: float
    top_m: float
    pixel_m: float
    shift_m: Array

    def write(self, path: Path) -> None:
        """Write a GeoTIFF; it does not contain the shift, as in reality.

        Raises:
            OutputError: the file cannot be written.
        """
        rows, columns, _ = self.pixels.shape
        profile = {
            "driver": "GTiff", "width": columns, "height": rows, "count": 3, "dtype": "uint8", "photometric": "RGB",
            "crs": rasterio.crs.CRS.from_epsg(self.epsg), "compress": "deflate",
            "transform": rasterio.Affine(self.pixel_m, 0.0, self.left_m, 0.0, -self.pixel_m, self.top_m),
        }  # fmt: skip
        try:
            with rasterio.open(path, "w", **profile) as target:
                target.write(np.moveaxis(self.pixels, 2, 0))
        except (OSError, rasterio.errors.RasterioError) as error:
            raise OutputError(f"{path}: cannot be written ({error})") from error


def utm_epsg(datum: Datum) -> int:
    """Return the EPSG code of the UTM zone that a datum lies in."""
    lat, lon, _ = datum.origin
    (found, *_) = query_utm_crs_info(datum_name="WGS 84", area_of_interest=AreaOfInterest(lon, lat, lon, lat))
    return int(found.code)


def grid_from_enu(datum: Datum, epsg: int, p_m: Array) -> Array:
    """Return grid coordinates (N, 2) of points (N, 2) on the datum's plane, m."""
    geodetic = datum.geodetic_from_enu(np.column_stack([p_m, np.zeros(len(p_m))]))
    return np.column_stack(_to_grid(epsg).transform(geodetic[:, 1], geodetic[:, 0]))


@lru_cache(maxsize=8)  # making a transformer takes longer than a thousand transforms
def _to_grid(epsg: int) -> Transformer:
    return Transformer.from_crs(CRS.from_epsg(4326), CRS.from_epsg(epsg), always_xy=True)


def render(harbour: Harbour, seed: int, pixel_m: float = 0.16) -> RenderedImage:
    """Take the image of a harbour; day, sun, boats and misregistration are drawn from `seed`."""
    rng = np.random.default_rng([seed, 11])
    west, south, east, north = harbour.config.image_m
    epsg = utm_epsg(harbour.datum)
    corners = grid_from_enu(harbour.datum, epsg, np.array([(west, south), (west, north), (east, south), (east, north)]))
    left, top = float(np.floor(corners[:, 0].min())), float(np.ceil(corners[:, 1].max()))
    columns, rows = (int(np.ceil(v / pixel_m)) for v in (corners[:, 0].max() - left, top - corners[:, 1].min()))
    shift = rng.normal(0.0, _SHIFT_SIGMA_M, 2)
    season = _SEASONS[rng.integers(len(_SEASONS))]
    pen = _Pen(
        rng, harbour.datum, epsg, left, top, pixel_m / _FINE, (rows * _FINE, columns * _FINE), shift, season.water
    )  # fmt: skip
    _draw(pen, harbour, season, rng)
    fine = _averaged(pen.canvas)
    soft = cv2.GaussianBlur(fine, (0, 0), rng.uniform(0.5, 0.9))
    noisy = soft * season.light * rng.uniform(0.9, 1.08) + rng.normal(0.0, 3.0, soft.shape)
    coded = cv2.imencode(".jpg", np.clip(noisy, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 82])[1]
    pixels = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)
    return RenderedImage(pixels, epsg, left, top, pixel_m, shift)


def _averaged(canvas: Canvas) -> Canvas:
    """Return the means of a canvas's blocks of `_FINE` by `_FINE` pixels.

    It equals `mean` over two axes bit for bit, in a fifth of the time.
    """
    total = np.zeros_like(canvas[::_FINE, ::_FINE])
    for row in range(_FINE):
        for column in range(_FINE):
            total += canvas[row::_FINE, column::_FINE]
    return total / np.float32(_FINE**2)


class _Pen:
    """Draws world outlines on a canvas (rows, columns, 3) of floats."""

    def __init__(
        self, rng: np.random.Generator, datum: Datum, epsg: int, left: float, top: float, pixel_m: float,
        shape: tuple[int, int], shift_m: Array, water: tuple[int, int, int],
    ) -> None:  # fmt: skip
        self._rng, self._datum, self._epsg = rng, datum, epsg
        self._left, self._top, self.pixel_m, self._shift = left, top, pixel_m, shift_m
        self.canvas: Canvas = np.empty((*shape, 3), dtype=np.float32)
        self.canvas[:] = water
        self.mottle(self.canvas, np.ones(shape, dtype=bool), _WATER_NOISE, (0.4, 2.0, 9.0))

    def pixels(self, p_m: Array) -> NDArray[np.int32]:
        """Return canvas pixels (N, 2) of points (N, 2) in world."""
        grid = grid_from_enu(self._datum, self._epsg, np.asarray(p_m, dtype=float) + self._shift)
        return np.rint(np.column_stack([grid[:, 0] - self._left, self._top - grid[:, 1]]) / self.pixel_m - 0.5).astype(
            np.int32
        )

    def window(self, outlines_m: Array) -> tuple[Canvas, Mask]:
        """Return the part of the canvas around outlines (K, N, 2), a view, and which of its pixels lie inside one."""
        corners = [self.pixels(outline) for outline in outlines_m]
        low = np.clip(np.min([c.min(axis=0) for c in corners], axis=0) - 1, 0, None)
        high = np.max([c.max(axis=0) for c in corners], axis=0) + 2
        part = self.canvas[low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
        filled = np.zeros(part.shape[:2], dtype=np.uint8)
        for corner in corners if filled.size else []:
            cv2.fillPoly(filled, [corner - low.astype(np.int32)], 1)
        return part, np.asarray(filled, dtype=np.bool_)

    def fill(self, outline_m: Array, colour: tuple[float, float, float], noise: float) -> tuple[Canvas, Mask]:
        """Paint an outline; return its part of the canvas and which pixels of it were painted."""
        part, inside = self.window(np.asarray(outline_m)[None])
        part[inside] = np.array(colour) + self._rng.normal(0.0, 4.0)
        self.mottle(part, inside, noise, (0.3, 1.5, 6.0))
        return part, inside

    def line(self, a: Array, b: Array, colour: tuple[float, float, float], width_m: float) -> None:
        """Paint a line."""
        p, q = self.pixels(np.array([a, b]))
        cv2.line(self.canvas, p.tolist(), q.tolist(), colour, max(1, round(width_m / self.pixel_m)), cv2.LINE_AA)

    def disc(self, at: Array, radius_m: float, colour: tuple[float, float, float]) -> None:
        """Paint a disc."""
        (p,) = self.pixels(np.array([at]))
        cv2.circle(self.canvas, p.tolist(), max(1, round(radius_m / self.pixel_m)), colour, -1, cv2.LINE_AA)

    def shade(self, outline_m: Array, by: Array, depth: float) -> None:
        """Darken the shadow of an outline; `by`: (2,) m from the outline to the shadow of its top."""
        part, dark = self.window(np.asarray(outline_m) + np.linspace(0.0, 1.0, 12)[:, None, None] * by)
        part[dark] *= depth

    def mottle(self, part: Canvas, inside: Mask, noise: float, sizes_m: tuple[float, ...]) -> None:
        """Lay grain of several sizes over some pixels of a part of the canvas, in place."""
        rows, columns = part.shape[:2]
        if not inside.any():
            return
        whole = inside.all()  # as for water: then no pixels have to be selected and written back
        painted = part if whole else part[inside]
        for size in sizes_m:
            step = max(1, round(size / self.pixel_m / 2))
            coarse = self._rng.normal(0.0, noise, (rows // step + 2, columns // step + 2)).astype(np.float32)
            grain = cv2.resize(coarse, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)[:rows, :columns]
            share = (grain if whole else grain[inside]) / len(sizes_m)
            for channel in range(3):  # all channels at once, three in the innermost loop, take twice as long
                painted[..., channel] += share
        if not whole:
            part[inside] = painted


def _draw(pen: _Pen, harbour: Harbour, season: _Season, rng: np.random.Generator) -> None:
    azimuth, slant = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.5, 1.4)
    sun = slant * np.array([np.cos(azimuth), np.sin(azimuth)])  # a shadow's tip, per metre of height
    depth = float(rng.uniform(0.45, 0.65))
    ground: list[tuple[shapely.Polygon, Solid | Dock]] = [*harbour.quays, *harbour.pontoons]
    for polygon, dock in harbour.docks:  # each where it lay on the day of the image
        moved = shapely.affinity.rotate(polygon, rng.uniform(-dock.moves_deg, dock.moves_deg))
        ground.append((shapely.affinity.translate(moved, *rng.uniform(-dock.moves_m, dock.moves_m, 2)), dock))
    for polygon, solid in ground:
        pen.shade(np.array(polygon.exterior.coords), sun * solid.top_m, depth)
    for polygon, solid in ground:
        outline = np.array(polygon.exterior.coords)
        colour, noise = _SURFACES[solid.surface]
        part, inside = pen.fill(outline, season.grass if solid.surface == "grass" else colour, noise)
        around = part[~inside].copy()
        _joints_and_cars(pen, polygon, solid.surface, rng)
        part[~inside] = around  # joints and cars end at the outline
        kerb = polygon.buffer(-0.5 * _KERB_M, join_style="mitre")  # its outer side is the wall's face
        for part_of_it in shapely.get_parts(kerb):
            for a, b in pairwise(np.array(part_of_it.exterior.coords)):
                pen.line(a, b, (196, 193, 184), _KERB_M)
    for boat in harbour.boats(rng):
        if rng.uniform() < season.boats:
            _boat(pen, boat, sun, depth, rng)
    for polygon, solid in harbour.buildings:
        outline = np.array(polygon.exterior.coords)
        pen.shade(outline, sun * solid.top_m * 0.6, depth)
        pen.fill(outline, *_SURFACES[solid.surface])
        middle = outline[:-1].mean(axis=0)
        pen.line(0.5 * (outline[0] + outline[1]), middle, (90, 60, 52), 0.3)  # the ridge
        pen.line(middle, 0.5 * (outline[2] + outline[3]), (90, 60, 52), 0.3)
    for at, pole in harbour.poles:
        pen.line(at, at + sun * pole.top_m * 0.6, (60, 66, 70), 2.0 * pole.radius_m)
        pen.disc(at, max(pole.radius_m, 0.2), (190, 185, 170))


def _joints_and_cars(pen: _Pen, polygon: shapely.Polygon, surface: str, rng: np.random.Generator) -> None:
    """Draw joints of slabs, planks, cars: clutter for edge detectors."""
    low, high = np.array(polygon.bounds[:2]), np.array(polygon.bounds[2:])
    size, inner = high - low, polygon.buffer(-2.6)
    if surface == "wood":
        along = int(np.argmax(size))
        for s in np.arange(low[along], high[along], 0.6):
            a, b = low.copy(), high.copy()
            a[along] = b[along] = s
            pen.line(a, b, (112, 92, 70), 0.08)
    elif surface != "grass":
        for s in np.arange(low[0] + 4.0, high[0] - 1.0, rng.uniform(5.0, 8.0)):
            pen.line(np.array([s, low[1]]), np.array([s, high[1]]), (138, 136, 130), 0.1)
        for _ in range(int(size.prod() / 260.0)):  # cars and crates
            at, turned = low + rng.uniform(size=2) * size, rng.choice([0.0, np.pi / 2.0]) + rng.normal(0.0, 0.05)
            if not inner.contains(shapely.Point(at)):
                continue
            c, s = np.cos(turned), np.sin(turned)
            car = np.array([(-2.2, -0.9), (2.2, -0.9), (2.2, 0.9), (-2.2, 0.9)]) @ np.array([[c, s], [-s, c]]) + at
            grey = float(rng.uniform(30.0, 235.0))
            pen.fill(car, (grey, grey * rng.uniform(0.85, 1.0), grey * rng.uniform(0.8, 1.0)), 3.0)


def _boat(pen: _Pen, boat: Boat, sun: Array, depth: float, rng: np.random.Generator) -> None:
    outline = boat.outline
    pen.shade(outline, sun * 1.0, depth)
    white = float(rng.uniform(200.0, 242.0))
    pen.fill(outline, (white, white, white * 0.97), 3.0)
    inner = boat.at + 0.55 * (outline - boat.at)
    pen.fill(inner, tuple(rng.uniform(60.0, 190.0, 3)), 4.0)
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        pen.line(a, b, (110, 110, 112), 0.1)
