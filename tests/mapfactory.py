# SPDX-License-Identifier: Apache-2.0
"""Maps made in the test, by the ECEF and GDAL alone: one bright square in world, as an image, tiles or lines."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer

from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.aerial.image import AerialImage, Patch
from graphloc.frontends.aerial.vector import VectorMap, read_vector

SWEDEN, NEW_YORK = Geodetic(57.7, 14.5, 30.0), Geodetic(40.7, -74.0, -20.0)
DATUM = Datum(SWEDEN)
SQUARE = np.array([10.0, -30.0, 25.0, -8.0])  # west, south, east, north of one bright thing in world, m
DARK, BRIGHT = 40, 200
HALF_MERCATOR = np.pi * 6378137.0
Bytes = NDArray[np.uint8]


def lon_lat(p_m: Array, datum: Geodetic) -> Array:
    """Longitude, latitude (N, 2) of points (N, 2) east, north at the datum's height: by the ECEF, not by `Datum`."""
    lat, lon = np.radians(datum.latitude_deg), np.radians(datum.longitude_deg)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    to_ecef = Transformer.from_crs(4979, 4978, always_xy=True)
    origin = np.array(to_ecef.transform(datum.longitude_deg, datum.latitude_deg, datum.height_m))
    p = origin + p_m[:, :1] * east + p_m[:, 1:] * north
    return np.column_stack(to_ecef.transform(p[:, 0], p[:, 1], p[:, 2], direction="INVERSE")[:2])


def in_crs(p_m: Array, crs: Any, datum: Geodetic) -> Array:
    return np.column_stack(Transformer.from_crs(4326, crs, always_xy=True).transform(*lon_lat(p_m, datum).T))


def drawn(crs: Any, transform: rasterio.Affine, width: int, height: int, datum: Geodetic = SWEDEN) -> Bytes:
    """An image of the bright thing: each pixel by 8 x 8 points of it; its edges are straight to less than 1 mm."""
    w, s, e, n = SQUARE
    corners = in_crs(np.array([(w, s), (e, s), (e, n), (w, n)]), crs, datum)
    t = transform
    corners = np.linalg.solve([[t.a, t.b], [t.d, t.e]], corners.T - [[t.c], [t.f]]).T
    u0, v0 = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
    u1, v1 = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 1, [width, height])
    image = np.full((height, width), DARK, dtype=np.uint8)
    if u1 <= u0 or v1 <= v0:
        return image
    v, u = np.mgrid[v0:v1:0.125, u0:u1:0.125] + 0.0625
    sides = [
        (b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0])
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    covered = np.logical_and.reduce([x > 0 for x in sides]) | np.logical_and.reduce([x < 0 for x in sides])
    share = covered.reshape(v1 - v0, 8, u1 - u0, 8).mean(axis=(1, 3))
    image[v0:v1, u0:u1] = np.rint(DARK + share * (BRIGHT - DARK))
    return image


def framed(crs: Any, pixel: float, datum: Geodetic = SWEDEN, turn_deg: float = 0.0) -> tuple[rasterio.Affine, int, int]:
    """A transform with pixels of that size in the unit of the CRS, turned; width and height: 70 m around the middle."""
    middle = in_crs(np.array([(15.0, -20.0)]), crs, datum)[0]
    per_m = np.abs(in_crs(np.array([(16.0, -20.0), (15.0, -19.0)]), crs, datum) - middle).max(axis=0)
    width, height = (int(140.0 * s / pixel) for s in per_m)
    c, s = pixel * np.cos(np.radians(turn_deg)), pixel * np.sin(np.radians(turn_deg))
    rows = np.array([(c, s), (s, -c)])
    corner = middle - rows @ (0.5 * width, 0.5 * height)
    return rasterio.Affine(*rows[0], corner[0], *rows[1], corner[1]), width, height


def write(path: Path, bands: NDArray[Any], **profile: Any) -> Path:
    """Bands (B, rows, columns) as a file."""
    count, height, width = bands.shape
    wanted = {"driver": "GTiff", "width": width, "height": height, "count": count, "dtype": bands.dtype, **profile}
    with rasterio.open(path, "w", **wanted) as f:
        f.write(bands)
    return path


def utm(path: Path, bands: Callable[[Bytes], NDArray[Any]], pixel: float = 0.2, **profile: Any) -> Path:
    transform, width, height = framed(32633, pixel)
    return write(path, bands(drawn(32633, transform, width, height)), crs="EPSG:32633", transform=transform, **profile)


def colours(grey: Bytes) -> Bytes:
    return np.stack([grey, grey, grey])


def check(patch: Patch, bright: float = BRIGHT, dark: float = DARK, atol_m: float = 0.02, band: int = 0) -> None:
    """The bright thing has its place and its size."""
    rows, columns = np.indices(patch.inside.shape)
    east, north = patch.west_m + columns * patch.cell_m, patch.north_m - rows * patch.cell_m
    w, s, e, n = SQUARE
    near = (east > w - 3.0) & (east < e + 3.0) & (north > s - 3.0) & (north < n + 3.0)
    assert patch.inside[near].all()
    light = (patch.pixels[..., band] - float(dark)) / (bright - dark)
    light = np.where(near & (light > 0.05), light, 0.0)  # JPEG rings
    found = [(v * light).sum() / light.sum() for v in (east, north)]
    np.testing.assert_allclose(found, [0.5 * (w + e), 0.5 * (s + n)], atol=atol_m)
    assert light.sum() * patch.cell_m**2 == pytest.approx((e - w) * (n - s), rel=0.01)


def around(path: Path, cell_m: float = 0.25, datum: Geodetic = SWEDEN) -> Patch:
    return AerialImage(path, Datum(datum)).patch(np.array([15.0, -20.0]), 30.0, cell_m)


def tiled(zoom: int, datum: Geodetic = SWEDEN) -> dict[tuple[int, int], Bytes]:
    """Tiles of 256 pixels (rows, columns, 3) around the bright thing, by column and row from the top."""
    unit = 2.0 * HALF_MERCATOR / 2**zoom
    far = in_crs(np.array([(-30.0, -65.0), (60.0, 25.0)]), 3857, datum)
    x0, x1 = ((far[:, 0] + HALF_MERCATOR) // unit).astype(int)
    y1, y0 = ((HALF_MERCATOR - far[:, 1]) // unit).astype(int)
    tiles = {}
    for x in range(x0, x1 + 1):
        for y in range(y0, y1 + 1):
            transform = rasterio.Affine(
                unit / 256, 0, x * unit - HALF_MERCATOR, 0, -unit / 256, HALF_MERCATOR - y * unit
            )
            tiles[x, y] = np.moveaxis(colours(drawn(3857, transform, 256, 256, datum)), 0, 2)
    return tiles


def lay(folder: Path, zoom: int, tiles: dict[tuple[int, int], Bytes], kind: str, tms: bool = False) -> Path:
    for (x, y), tile in tiles.items():
        path = folder / str(zoom) / str(x) / f"{2**zoom - 1 - y if tms else y}.{kind}"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), tile)
    return folder


def tile_at(east: float, north: float, zoom: int) -> tuple[int, int]:
    (x, y), unit = in_crs(np.array([(east, north)]), 3857, SWEDEN)[0], 2.0 * HALF_MERCATOR / 2**zoom
    return int((x + HALF_MERCATOR) // unit), int((HALF_MERCATOR - y) // unit)


def mbtiles(path: Path, zoom: int, tiles: dict[tuple[int, int], Bytes], kind: str, **more: str) -> Path:
    """As of the MBTiles specification 1.3: rows count from below."""
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE metadata (name text, value text)")
        db.execute("CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob)")
        for name, value in {"name": "a", "format": kind, "minzoom": str(zoom), "maxzoom": str(zoom), **more}.items():
            db.execute("INSERT INTO metadata VALUES (?, ?)", (name, value))
        for (x, y), tile in tiles.items():
            data = cv2.imencode(f".{kind}", tile)[1].tobytes()
            db.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (zoom, x, 2**zoom - 1 - y, data))
    db.close()
    return path


def degrees(corners: Any, turned: bool = False) -> list[list[float]]:
    """Positions as GeoJSON has them, at the 57th parallel; `turned`: the ring the other way round."""
    found = lon_lat(np.array(corners, dtype=float), SWEDEN)
    return [[float(x), float(y)] for x, y in (found[::-1] if turned else found)]


def feature(kind: str, coordinates: Any, **tags: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": tags, "geometry": {"type": kind, "coordinates": coordinates}}


def saved(path: Path, *features: Any, **members: Any) -> Path:
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **members}))
    return path


def read(path: Path) -> VectorMap:
    return read_vector(path, Datum(SWEDEN))


def picture(path: Path, epsg: int, pixel: float, square_m: Array, bands: int = 3) -> None:
    """Dark water with one bright rectangle: west, south, east, north edges in world, m; north up in the CRS."""
    to_grid = Transformer.from_crs(4326, epsg, always_xy=True)

    def grid(p: Array) -> Array:
        geodetic = DATUM.geodetic_from_enu(np.column_stack([p, np.zeros(len(p))]))
        return np.column_stack(to_grid.transform(geodetic[:, 1], geodetic[:, 0]))

    far = grid(np.array([(-150.0, -150.0), (150.0, 150.0), (-150.0, 150.0), (150.0, -150.0)]))
    left, top = far[:, 0].min(), far[:, 1].max()
    shape = (int((top - far[:, 1].min()) / pixel), int((far[:, 0].max() - left) / pixel))
    image = np.full((*shape, 3), (38, 62, 72), dtype=np.uint8)
    image = np.clip(image + np.random.default_rng(1).normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
    w, s, e, n = square_m
    corners = grid(np.array([(w, s), (e, s), (e, n), (w, n)]))
    # Each pixel by 5 x 5 points of it that lie in the rectangle or not.
    low = np.floor([(corners[:, 0].min() - left) / pixel, (top - corners[:, 1].max()) / pixel]).astype(int) - 2
    high = np.ceil([(corners[:, 0].max() - left) / pixel, (top - corners[:, 1].min()) / pixel]).astype(int) + 2
    v, u = np.mgrid[low[1] : high[1] : 0.2, low[0] : high[0] : 0.2] + 0.1
    lon, lat = Transformer.from_crs(epsg, 4326, always_xy=True).transform(
        left + u.ravel() * pixel, top - v.ravel() * pixel
    )
    p = DATUM.enu_from_geodetic(np.asarray(lat), np.asarray(lon), np.full(u.size, 30.0))
    covered = (p[:, 0] > w) & (p[:, 0] < e) & (p[:, 1] > s) & (p[:, 1] < n)
    share = covered.reshape(high[1] - low[1], 5, high[0] - low[0], 5).mean(axis=(1, 3))[..., None]
    part = image[low[1] : high[1], low[0] : high[0]]
    part[:] = np.rint(part * (1.0 - share) + share * (180, 176, 170))
    profile = {"driver": "GTiff", "width": shape[1], "height": shape[0], "count": bands, "dtype": "uint8"}
    with rasterio.open(
        path, "w", crs=f"EPSG:{epsg}", transform=rasterio.Affine(pixel, 0, left, 0, -pixel, top), **profile
    ) as f:
        f.write(np.moveaxis(image, 2, 0)[:bands])
