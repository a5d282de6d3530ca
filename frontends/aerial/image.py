# SPDX-License-Identifier: Apache-2.0
"""An aerial image on the grid of world: read through its CRS, part by part.

Grid north is not true north and a map's metre is not always a metre, so no affine map is assumed between the image and
world: the image is sampled point by point (on a net of 8 m, linear between, which is off by less than a millimetre).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from graphloc.errors import InputError
from graphloc.frames import Array, Datum

Pixels = NDArray[np.uint8]
_NET_M = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A part of an image, north up, on the grid of world.

    Attributes:
        pixels: (rows, columns, 3) uint8, red, green, blue. inside: (rows, columns) where the image has data.
        west_m, north_m: of the centre of the top-left cell, in world. cell_m: size of a cell.
    """

    pixels: Pixels
    inside: NDArray[np.bool_]
    west_m: float
    north_m: float
    cell_m: float

    def cells(self, p_m: Array) -> Array:
        """Return column and row (N, 2), fractional, of points (N, 2) east, north in world."""
        return np.column_stack([p_m[:, 0] - self.west_m, self.north_m - p_m[:, 1]]) / self.cell_m


class AerialImage:
    """A georeferenced image that GDAL reads: GeoTIFF, MBTiles, VRT, ...

    Raises:
        InputError: it cannot be read, or has no georeference.
    """

    def __init__(self, path: Path, datum: Datum) -> None:
        self._path, self._datum = path, datum
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # said below, as an error
                self._source: Any = rasterio.open(path)
        except rasterio.errors.RasterioError as error:
            raise InputError(f"{path}: not an image that GDAL can read ({error})") from None
        if self._source.crs is None or self._source.transform.is_identity:
            raise InputError(
                f"{path}: has no georeference (a CRS and a transform): export it as GeoTIFF, or set them with gdal_translate"
            )
        try:
            crs = CRS.from_wkt(self._source.crs.to_wkt())
        except CRSError as error:
            raise InputError(f"{path}: its CRS cannot be used ({error})") from None
        self._to_image = Transformer.from_crs(CRS.from_epsg(4326), crs, always_xy=True)

    def _pixels_of(self, p_m: Array) -> Array:
        """Image column and row (N, 2), 0 at the centre of the top-left pixel, of points (N, 2) in world."""
        geodetic = self._datum.geodetic_from_enu(np.column_stack([p_m, np.zeros(len(p_m))]))
        x, y = self._to_image.transform(geodetic[:, 1], geodetic[:, 0])
        back = ~self._source.transform
        return np.column_stack([back.a * x + back.b * y + back.c, back.d * x + back.e * y + back.f]) - 0.5

    def patch(self, centre_m: Array, half_m: float, cell_m: float) -> Patch:
        """Return the square of `half_m` around a point (2,) in world.

        Raises:
            InputError: the image does not reach there.
        """
        n = int(np.ceil(2.0 * half_m / cell_m))
        west, north = centre_m[0] - half_m + 0.5 * cell_m, centre_m[1] + half_m - 0.5 * cell_m
        knots = np.linspace(0.0, n - 1.0, max(2, int(np.ceil(n * cell_m / _NET_M)) + 1))
        columns, rows = np.meshgrid(knots, knots)
        net = self._pixels_of(np.column_stack([west + columns.ravel() * cell_m, north - rows.ravel() * cell_m]))
        # Linear between knots, by a product: cv2.remap would round to a 32nd of their distance, 0.25 m.
        at = np.arange(n) * (len(knots) - 1) / (n - 1)
        between = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(len(knots))))
        column, row = (between @ net[:, k].reshape(len(knots), -1) @ between.T for k in (0, 1))
        low = np.floor([column.min() - 2.0, row.min() - 2.0]).astype(int)
        high = np.ceil([column.max() + 3.0, row.max() + 3.0]).astype(int)
        low, high = np.maximum(low, 0), np.minimum(high, [self._source.width, self._source.height])
        if (high - low < 2).any():
            raise InputError(
                f"{self._path}: does not cover {centre_m[0]:.0f} m east, {centre_m[1]:.0f} m north of the datum: another image, "
                "or another `datum:`"
            )
        window = rasterio.windows.Window(low[0], low[1], *(high - low))
        bands = self._source.read(window=window, masked=True)
        colours = bands[:3] if len(bands) >= 3 else np.ma.repeat(bands[:1], 3, axis=0)
        image: Any = np.ascontiguousarray(np.moveaxis(colours.filled(0), 0, 2)).astype(np.uint8)
        has: Any = (~np.ma.getmaskarray(colours).any(axis=0)).astype(np.uint8)
        finer = cell_m / abs(self._source.transform.a * _metres(self._source.crs))
        if finer > 1.5:  # the grid is coarser than the image: average, do not pick
            image = cv2.GaussianBlur(image, (0, 0), 0.4 * finer)
        map_u, map_v = (column - low[0]).astype(np.float32), (row - low[1]).astype(np.float32)
        pixels = cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR)
        covered = cv2.remap(has, map_u, map_v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return Patch(np.asarray(pixels, dtype=np.uint8), np.asarray(covered > 0), float(west), float(north), cell_m)


def _metres(crs: Any) -> float:
    """Metres of a CRS's unit, roughly."""
    return 111_000.0 if crs.is_geographic else float(crs.linear_units_factor[1])
