# SPDX-License-Identifier: Apache-2.0
"""An aerial image resampled on the grid of world, part by part.

GDAL reads it: a file, an MBTiles, or a folder of tiles (`tiles.py`), with any kind of pixels. Grid north is not true
north, and a map's metre is not always a metre, so no affine transformation between image and world is assumed: points
are transformed one by one, on a net of 8 m, and interpolated linearly, with errors below a millimetre.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import ProjError
from rasterio.enums import ColorInterp, Resampling

from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.frontends._crs import ties_near, warn_of_loose_tie
from graphloc.frontends.aerial.tiles import describe_tiles

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]
_NET_M = 8.0
_SAMPLES, _SAMPLE_PX, _AROUND_M = 8, 128, 500.0
_MISSED = 2.0  # times as much contrast around the datum as anywhere in the samples of the whole: these have missed the harbour
_GREY = np.array([0.299, 0.587, 0.114])  # of red, green and blue, as edges are found in
_ENDS = [2.0, 98.0]  # percentiles
_NOTHING = 10.0  # contrast of 8 bits below which there is nothing to see but a few small things
# Contrasts between which the edges found are much the same, and one amid them; what becomes of the darkest (2 %) of an image that is
# stretched. The brightest (98 %) then leave room for roofs that are brighter still.
_CONTRASTS, _CONTRAST, _DARKEST = (80.0, 165.0), 120.0, 36.0
_WKT_CHARS = 100_000
_PALETTE_PX = 300_000_000  # most pixels that are read at once of an image with a palette, which cannot be read coarser

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A part of an image, north up, on the grid of world.

    Attributes:
        pixels: (rows, columns, 3) uint8, red, green, blue. inside: (rows, columns) where the image has data.
        west_m, north_m: of the centre of the top-left cell, in world. cell_m: size of a cell.
    """

    pixels: Pixels
    inside: Mask
    west_m: float
    north_m: float
    cell_m: float

    def cells(self, p_m: Array) -> Array:
        """Return column and row (N, 2), fractional, of points (N, 2) east, north in world, m."""
        return np.column_stack([p_m[:, 0] - self.west_m, self.north_m - p_m[:, 1]]) / self.cell_m


class AerialImage:
    """A georeferenced image.

    - A file that GDAL reads: GeoTIFF, JPEG 2000, VRT, PNG with world file and CRS (.prj), ..., of any CRS, rotated or
    not. - An MBTiles file with jpg, png or webp tiles: its deepest zoom level. - A folder of tiles z/x/y.png, jpg or
    webp: its deepest zoom level, see `tiles.describe_tiles`.

    One band is grey; a palette is expanded; of more bands, the ones named red, green, blue are taken, else the first
    three. An image of unusual contrast (hazy, dark, harsh, of more than 8 bits) is stretched, all bands alike, as the edges
    found depend on it (`_stretch`). There is no data where an alpha band, a mask or a nodata value says so, and where a
    tile is missing. What is partly transparent has data: near infrared may be labelled alpha.

    Raises:
        InputError: the image cannot be read, or has no georeference.
    """

    def __init__(self, path: Path, datum: Datum) -> None:
        self._path, self._datum = path, datum
        self._source = source = _opened(path, datum)
        wkt = source.crs.to_wkt() if source.crs is not None else _beside(path)
        why_not = _why_not(source, path, has_crs=bool(wkt))
        if why_not:
            raise InputError(f"{path}: {why_not}")
        self._to_image = _tie(path, wkt, datum)
        bands = {c: k for k, c in zip(source.indexes, source.colorinterp, strict=True)}
        named = [bands.get(c, 0) for c in (ColorInterp.red, ColorInterp.green, ColorInterp.blue)]
        self._bands = named if all(named) else [1, 2, 3] if source.count >= 3 else [1]
        self._palette = _palette_of(source) if ColorInterp.palette in bands else None
        self._darkest, self._brightest = (0.0, 255.0) if self._palette is not None else self._stretch()

    def patch(self, centre_m: Array, half_m: float, cell_m: float) -> Patch:
        """Return the square with half side `half_m` around a point (2,) in world, in cells of `cell_m`.

        Raises:
            InputError: the image does not cover the square, has no data in it, or cannot be read there.
        """
        n = int(np.ceil(2.0 * half_m / cell_m))
        west, north = centre_m[0] - half_m + 0.5 * cell_m, centre_m[1] + half_m - 0.5 * cell_m
        elsewhere = InputError(
            f"{self._path}: does not cover {centre_m[0]:.0f} m east, {centre_m[1]:.0f} m north of the datum: another image, "
            "or another `datum:`"
        )
        uv = self._pixels_of_grid(west, north, n, cell_m)
        lowest, highest = uv.min(axis=(1, 2)), uv.max(axis=(1, 2))
        if not np.isfinite([lowest, highest]).all():  # beyond where the CRS is defined
            raise elsewhere
        eastward = np.hypot(*np.diff(uv[:, ::n], axis=2))  # steps along the first row
        if eastward.max() > 2.0 * np.median(eastward):
            raise InputError(
                f"{self._path}: the date line of its CRS runs through it {centre_m[0]:.0f} m east, {centre_m[1]:.0f} m "
                "north of the datum: gdalwarp it to the UTM zone there"
            )
        # Pixels per cell along u and v, by the ground: units of the CRS may be feet, degrees, or half metres.
        finer = np.hypot((uv[:, :, -1] - uv[:, :, 0]).mean(axis=1), (uv[:, -1] - uv[:, 0]).mean(axis=1)) / (n - 1)
        shrink = 2 ** max(0, int(np.log2(0.5 * finer.min())))  # read two pixels per cell or more, but not hundreds
        if self._palette is not None:
            shrink = 1  # indices of a palette cannot be averaged, and the nearest pixel is half a pixel off
        size = np.array([self._source.width, self._source.height])
        low = np.clip(shrink * np.floor(lowest / shrink - 2.0), 0, size).astype(int)
        high = np.clip(shrink * np.ceil(highest / shrink + 3.0), 0, size).astype(int)
        if (high - low < 2).any():
            raise elsewhere
        if self._palette is not None and int(np.prod(high - low, dtype=np.int64)) > _PALETTE_PX:
            raise InputError(
                f"{self._path}: {' x '.join(map(str, high - low))} pixels with a palette are too many to read at once: "
                "gdal_translate -expand rgb"
            )
        image, has = self._read(low, high - low, shrink)
        scale = np.array(has.shape[::-1]) / (high - low)
        if (finer * scale).max() > 1.5:  # the grid is coarser than the pixels that were read: average these
            image = cv2.GaussianBlur(image, (0, 0), sigmaX=0.4 * finer[0] * scale[0], sigmaY=0.4 * finer[1] * scale[1])
        uv *= scale[:, None, None]  # in place: to allocate more such arrays takes longer than to fill them
        uv += ((0.5 - low) * scale - 0.5)[:, None, None]
        at = uv.astype(np.float32)
        pixels = cv2.remap(image, at[0], at[1], cv2.INTER_LINEAR)
        covered = cv2.remap(has, at[0], at[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
        if not covered.any():
            raise elsewhere
        return Patch(np.asarray(pixels, dtype=np.uint8), np.asarray(covered), float(west), float(north), cell_m)

    def _pixels_of(self, p_m: Array) -> Array:
        """Return image column and row (N, 2), 0 at the centre of the top-left pixel, of points (N, 2) in world, m."""
        geodetic = self._datum.geodetic_from_enu(np.column_stack([p_m, np.zeros(len(p_m))]))
        x, y = self._to_image.transform(geodetic[:, 1], geodetic[:, 0])
        back = ~self._source.transform
        return np.column_stack([back.a * x + back.b * y + back.c, back.d * x + back.e * y + back.f]) - 0.5

    def _pixels_of_grid(self, west: float, north: float, n: int, cell_m: float) -> Array:
        """Return image column and row (2, n, n) of a grid in world."""
        net_m = max(_NET_M, 2.0 * cell_m)  # a patch of kilometres needs no net finer than its cells
        knots = np.linspace(0.0, n - 1.0, max(2, int(np.ceil(n * cell_m / net_m)) + 1))
        columns, rows = np.meshgrid(knots, knots)
        net = self._pixels_of(np.column_stack([west + columns.ravel() * cell_m, north - rows.ravel() * cell_m]))
        # Linear interpolation by a matrix product: cv2.remap would round to 1/32 of a knot's distance, 0.25 m.
        at = np.arange(n) * (len(knots) - 1) / (n - 1)
        between = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(len(knots))))
        uv = np.empty((2, n, n))
        for k in (0, 1):
            np.matmul(between @ net[:, k].reshape(len(knots), -1), between.T, out=uv[k])
        return uv

    def _read(self, low: NDArray[np.int_], size: NDArray[np.int_], shrink: int) -> tuple[Any, Any]:
        """Return colours (rows, columns, 3) uint8 of a window, reduced by a factor, and the mask of data, uint8."""
        columns, rows = (-(-int(s) // shrink) for s in size)
        window = rasterio.windows.Window(*low, *size)
        how = Resampling.nearest if shrink == 1 else Resampling.average
        try:
            bands = self._source.read(
                self._bands, window=window, out_shape=(len(self._bands), rows, columns), resampling=how
            )
            has = (self._source.dataset_mask(window=window, out_shape=(rows, columns)) > 0).astype(np.uint8)
        except rasterio.errors.RasterioError as error:
            raise InputError(f"{self._path}: a part of it cannot be read ({_line(error)})") from None
        if self._palette is not None:
            colours = self._palette[bands[0]]
            return np.ascontiguousarray(colours[..., :3]), has * (colours[..., 3] > 0)
        if (self._darkest, self._brightest) != (0.0, 255.0) or bands.dtype != np.uint8:
            has *= np.isfinite(bands).all(axis=0)
            bright = (np.nan_to_num(bands.astype(np.float32)) - self._darkest) / (self._brightest - self._darkest)
            bands = np.rint(255.0 * np.clip(bright, 0.0, 1.0)).astype(np.uint8)
        return np.ascontiguousarray(np.moveaxis(np.broadcast_to(bands, (3, rows, columns)), 0, 2)), has

    def _stretch(self) -> tuple[float, float]:
        """Return the values that become 0 and 255.

        Contrast is the range from the 2 % to the 98 % point where there is most to see: elsewhere may be water alone. An image
        of 8 bits keeps its own, unless it is unusual.
        """
        darkest, brightest = self._span()
        contrast = brightest - darkest
        usual = _CONTRASTS[0] <= contrast <= _CONTRASTS[1]
        if self._source.dtypes[0] == "uint8" and (usual or contrast < _NOTHING):
            return 0.0, 255.0
        step = contrast / _CONTRAST
        return darkest - _DARKEST * step, darkest + (255.0 - _DARKEST) * step

    def _span(self, *, collars: bool = False) -> tuple[float, float]:
        """Return the 2 % and 98 % points, in grey, where there is most to see: in samples all over the image, or around the datum.

        A large image may show so much of sea or forest that none of its samples hits the harbour.

        Args:
            collars: whether black and white count. They do where there is nothing else to see: water may be black.
        """
        over, around = self._samples()
        # By row, as some formats are read from the top: else each sample would be.
        values = {
            corner: self._grey_at(*corner, collars=collars)
            for corner in sorted({*over, *around}, key=lambda corner: corner[::-1])
        }
        spans = [_span_of([values[corner] for corner in corners]) for corners in (over, around)]
        contrast, near = (brightest - darkest for darkest, brightest in spans)
        if max(contrast, near) < _NOTHING and not collars and np.issubdtype(self._source.dtypes[0], np.integer):
            return self._span(collars=True)
        return spans[1] if near > _MISSED * contrast else spans[0]

    def _samples(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Return the corners (column, row) of samples all over the image, and of as many around the datum."""
        size = np.array([self._source.width, self._source.height])
        corners = _AROUND_M * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        around = np.nan_to_num(self._pixels_of(corners), nan=0.0, posinf=0.0, neginf=0.0)
        spans = (np.zeros(2), size), (np.clip(around.min(axis=0), 0, size), np.clip(around.max(axis=0), 0, size))
        found = list[list[tuple[int, int]]]()
        for low, high in spans:
            steps = np.maximum(high - low - _SAMPLE_PX, 0.0) / (_SAMPLES - 1)
            each = (np.minimum(low + steps * np.array(k), size - 1).astype(int) for k in np.ndindex(_SAMPLES, _SAMPLES))
            found.append([(int(column), int(row)) for column, row in each])
        return found[0], found[1]

    def _grey_at(self, column: int, row: int, *, collars: bool) -> Array:
        """Return the grey values (N,) of the pixels of a sample that have data; none if it cannot be read.

        A patch says that, where it matters. Black and white are a collar, or nothing to see, unless `collars` count.
        """
        size = np.minimum(_SAMPLE_PX, [self._source.width - column, self._source.height - row]).tolist()
        window = rasterio.windows.Window(column, row, *size)
        try:
            bands = self._source.read(self._bands, window=window)
            known = self._source.dataset_mask(window=window) > 0
        except rasterio.errors.RasterioError:
            return np.zeros(0)
        known &= np.isfinite(bands).all(axis=0)
        if not collars and np.issubdtype(bands.dtype, np.integer):
            known &= ~(np.isin(bands[0], [0, np.iinfo(bands.dtype).max]) & (bands == bands[0]).all(axis=0))
        values = bands[:, known].astype(np.float64)
        return np.asarray(_GREY @ values if len(values) == 3 else values[0])


def _span_of(samples: Sequence[Array]) -> tuple[float, float]:
    """Return the 2 % and 98 % points of the quarter of the samples that have the widest range."""
    found = sorted((v for v in samples if len(v)), key=lambda values: float(np.ptp(np.percentile(values, _ENDS))))
    most = found[3 * len(found) // 4 :]
    darkest, brightest = np.percentile(np.concatenate(most), _ENDS) if most else (0.0, 1.0)
    return float(darkest), float(max(brightest, darkest + 1e-9))


def _opened(path: Path, datum: Datum) -> Any:
    """Return an image file, or a folder of tiles, as opened by GDAL.

    Raises:
        InputError: it cannot be opened.
    """
    try:
        folder = path.is_dir()
    except OSError as error:  # such as no permission, a name that is too long
        raise InputError(f"{path}: {error.strerror}") from None
    name = describe_tiles(path, datum) if folder else path
    # An MBTiles cut at its stated bounds is off by up to half a pixel (seen with GDAL 3.10: 5 cm, of pixels of 16 cm).
    options = {"USE_BOUNDS": "NO"} if path.suffix.lower() == ".mbtiles" else {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # said by `_why_not`, as an error
            return rasterio.open(name, **options)
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{path}: not an image that GDAL can read ({_line(error)})") from None


def _tie(path: Path, wkt: str, datum: Datum) -> Any:
    """Return the best transformation, near the datum, from longitude and latitude (WGS 84) to the CRS of an image.

    Raises:
        InputError: there is none.
    """
    try:
        crs = CRS.from_wkt(wkt)
        ties = ties_near(datum, 4326, crs)
    except ProjError as error:
        raise InputError(f"{path}: its CRS cannot be used ({_line(error)})") from None
    if not ties:
        raise InputError(
            f"{path}: its CRS ({crs.name}) is tied to no place on Earth: gdal_translate -a_srs EPSG:<code>"
        )
    warn_of_loose_tie(f"{path}: its CRS", crs, ties[0].accuracy)
    return ties[0]


def _palette_of(source: Any) -> Pixels:
    """Return red, green, blue, alpha (256 or more, 4) by index; indices without a colour have no data."""
    colours = np.zeros((65536 if source.dtypes[0] == "uint16" else 256, 4), dtype=np.uint8)
    for number, colour in source.colormap(1).items():
        colours[number] = colour
    return colours


def _beside(path: Path) -> str:
    """Return the CRS (WKT) in the .prj beside an image, which agencies add to a world file; '' if there is none."""
    try:
        return path.with_suffix(".prj").read_text(encoding="utf-8")[:_WKT_CHARS]
    except (OSError, ValueError):
        return ""


def _why_not(source: Any, path: Path, *, has_crs: bool) -> str:
    """Return why an image cannot be used, by its bands or georeference; empty if it can."""
    sizes = {n for shape in source.block_shapes for n in shape} if source.driver in ("MBTiles", "WMS") else set()
    if any(not 64 <= n <= 4096 for n in sizes):  # a tile of 1 kB may say that it has 30000 x 30000 pixels
        return f"its tiles have {max(sizes)} pixels a side: 64 to 4096 are read"
    kinds = {str(d) for d in source.dtypes}
    if not kinds or any("complex" in k for k in kinds):
        return "no picture in it: name one raster layer, with gdal_translate, as GeoTIFF"
    placed = not source.transform.is_identity
    if placed and not has_crs:
        return (
            f"has no CRS, only a transform (a world file?): gdal_translate -a_srs EPSG:<its code> {path.name} out.tif"
        )
    if not placed and (source.gcps[0] or source.rpcs):
        return f"is placed by control points, which is no georeference yet: gdalwarp -t_srs EPSG:<code> {path.name} out.tif"
    if not placed and source.crs is not None:
        return (
            "has a CRS but no transform: put its world file beside it, "
            f"or gdal_translate -a_ullr <left top right bottom> {path.name} out.tif"
        )
    if not placed:
        return "has no georeference (a CRS and a transform): export it as GeoTIFF, or set them with gdal_translate"
    return ""


def _line(error: Exception) -> str:
    """Return the first line of GDAL's first message, which causes the others."""
    return " ".join(str(error.__cause__ or error).splitlines()[:1])
