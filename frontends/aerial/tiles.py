# SPDX-License-Identifier: Apache-2.0
"""A folder of Web Mercator tiles as one image, by GDAL's tile reader.

GDAL reads the tiles that a window needs, treats a missing file as no data, and converts grey, palette, RGB and RGBA
tiles to RGBA (driver WMS, service TMS, docs: gdal.org/drivers/raster/wms.html). It does not access the network.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import rasterio

from graphloc.errors import InputError
from graphloc.frames import Datum

_HALF_M = 20037508.342789244  # Web Mercator is a square of twice that: pi * 6378137
_KINDS = {".png", ".jpg", ".jpeg", ".webp"}
_SHEETS = {".tif", ".tiff", ".jp2", ".jpg", ".jpeg", ".png", ".ecw", ".vrt"}  # as agencies cut an image of a town
_NUMBER = re.compile("0|[1-9][0-9]*")
_DEEPEST = 22  # 2^22 tiles of 256 pixels fill GDAL's 2^31 columns nearly; a pixel is 2 cm at 57 deg
_FAR_M = 100e3
_WANTED = "a folder of tiles has z/x/y.png (or jpg, jpeg, webp), Web Mercator, as QGIS and gdal2tiles write them"


def describe_tiles(folder: Path, datum: Datum) -> str:
    """Return GDAL's description (XML, to be opened like a file) of a folder of tiles z/x/y.png, jpg, webp.

    The image is the deepest zoom level (22 at most); the levels above it, up to a gap, are its overviews. Rows count
    from the top (XYZ) or from below (TMS): whichever places the tiles nearer to the datum. If both are equal, which
    takes a datum within about a tile of the equator or tiles of both hemispheres, XYZ.

    Raises:
        InputError: no such tiles, a part of such a folder, several kinds of files, a folder that cannot be listed, or
            tiles more than 100 km from the datum by XYZ and by TMS.
    """
    try:
        return _described(folder, datum)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: cannot be listed ({error.strerror})") from None


def _described(folder: Path, datum: Datum) -> str:
    levels = {z: p for z, p in _folders(folder).items() if z <= _DEEPEST}
    zoom = max(levels, default=0)
    n: int = 2**zoom
    columns = {x: p for x, p in _folders(levels[zoom]).items() if x < n} if levels else {}
    if not columns:
        if sheets := _sheets_of(folder):
            raise InputError(f"{folder}: {sheets}")
        raise InputError(f"{folder}: {_part_of(folder) or 'no tiles in it'}: {_WANTED}")
    across, down = _tile_of(datum, zoom)

    def columns_off(x: int) -> float:
        return abs((x + 0.5 - across + 0.5 * n) % n - 0.5 * n)  # the last column is beside the first

    column = min(columns, key=columns_off)
    found = _tiles(columns[column])
    tiles = {int(p.stem): p for p in found if int(p.stem) < n}
    if not tiles:
        raise InputError(f"{columns[column]}: no tiles in it: {_WANTED}")
    kinds = sorted({p.suffix for p in found})
    if len(kinds) > 1:
        raise InputError(
            f"{columns[column]}: tiles of several kinds ({', '.join(kinds)}): make them one, or an MBTiles file"
        )
    rows = np.array(sorted(tiles))
    from_top, from_below = (float(np.abs(r + 0.5 - down).min()) for r in (rows, n - 1 - rows))
    tile_m = 2.0 * _HALF_M / n * np.cos(np.radians(datum.origin.latitude_deg))
    away_m = tile_m * float(np.hypot(columns_off(column), min(from_top, from_below)))
    if away_m > max(_FAR_M, 2.0 * tile_m):
        raise InputError(
            f"{folder}: the tile nearest to the datum is {away_m / 1000.0:.0f} km off, with rows from the top as from below: "
            f"another `datum:`, or not z/x/y (z/y/x?): {_WANTED}"
        )
    first = tiles[int(rows[0])]
    overviews = next(k for k in range(zoom + 1) if zoom - k - 1 not in levels)
    return _xml(folder, first, zoom, overviews, "top" if from_top <= from_below else "bottom")


def _xml(folder: Path, tile: Path, zoom: int, overviews: int, rows_from: str) -> str:
    """Return GDAL's description of the folder; `tile`: one of its tiles, for their size."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(tile) as opened:
                width, height = opened.width, opened.height
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{tile}: not an image that GDAL can read ({error})") from None
    # as_uri: GDAL wants blanks etc. quoted. 404: no file. 200: an empty file, which some tools write.
    return (
        f'<GDAL_WMS><Service name="TMS"><ServerUrl>{folder.resolve().as_uri()}/${{z}}/${{x}}/${{y}}{tile.suffix}</ServerUrl>'
        f"</Service><DataWindow><UpperLeftX>{-_HALF_M!r}</UpperLeftX><UpperLeftY>{_HALF_M!r}</UpperLeftY>"
        f"<LowerRightX>{_HALF_M!r}</LowerRightX><LowerRightY>{-_HALF_M!r}</LowerRightY><TileLevel>{zoom}</TileLevel>"
        f"<TileCountX>1</TileCountX><TileCountY>1</TileCountY>"
        f"<YOrigin>{rows_from}</YOrigin></DataWindow><Projection>EPSG:3857</Projection>"
        f"<BlockSizeX>{width}</BlockSizeX><BlockSizeY>{height}</BlockSizeY><BandsCount>4</BandsCount>"
        f"<OverviewCount>{overviews}</OverviewCount><ZeroBlockHttpCodes>404,200</ZeroBlockHttpCodes></GDAL_WMS>"
    )


def _folders(folder: Path) -> dict[int, Path]:
    """Return the subfolders named by a number as GDAL writes it (16, not 016), by number."""
    return {int(p.name): p for p in folder.iterdir() if _NUMBER.fullmatch(p.name) and p.is_dir()}


def _tiles(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if _NUMBER.fullmatch(p.stem) and p.suffix.lower() in _KINDS]


def _part_of(folder: Path) -> str:
    """Return which part of a set of tiles a folder is, and what to name instead; empty if it is not a part of one."""
    here = folder.resolve()
    if _tiles(here):
        return f"one column of a level of tiles; name the folder above both, {here.parent.parent}"
    if any(_tiles(p) for p in _folders(here).values()):
        return f"one level of tiles; name the folder above it, {here.parent}"
    return ""


def _sheets_of(folder: Path) -> str:
    """Return what to do with a folder of images that are no tiles; empty if it holds none."""
    sheets = sorted(p for p in folder.iterdir() if p.suffix.lower() in _SHEETS and not _NUMBER.fullmatch(p.stem))
    if not sheets:
        return ""
    if len(sheets) == 1:
        return f"a folder, with one image in it: name {sheets[0].name} itself"
    return (
        f"a folder of {len(sheets)} images, such as {sheets[0].name}: make them one, "
        f"gdalbuildvrt all.vrt *{sheets[0].suffix}, and name all.vrt"
    )


def _tile_of(datum: Datum, zoom: int) -> tuple[float, float]:
    """Return column and row of the datum among the tiles of a level, from the top left, fractional."""
    latitude = np.radians(np.clip(datum.origin.latitude_deg, -85.0, 85.0))
    down = 0.5 - np.arcsinh(np.tan(latitude)) / (2.0 * np.pi)
    return (datum.origin.longitude_deg / 360.0 + 0.5) % 1.0 * 2**zoom, float(down) * 2**zoom
