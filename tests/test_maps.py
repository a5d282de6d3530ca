# SPDX-License-Identifier: Apache-2.0
"""Maps of every kind a user may have lie where they are in world: images, tiles, lines."""

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

from graphloc.config import parse_config
from graphloc.errors import ConfigError, InputError
from graphloc.factors import SENSORS
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.aerial.image import AerialImage, Patch
from graphloc.frontends.aerial.tiles import describe_tiles
from graphloc.frontends.aerial.vector import VectorMap, read_vector

SWEDEN, NEW_YORK = Geodetic(57.7, 14.5, 30.0), Geodetic(40.7, -74.0, -20.0)
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


@pytest.mark.parametrize(
    ("crs", "pixel", "turn_deg", "datum"),
    [
        (32633, 0.2, 30.0, SWEDEN),  # turned
        (4326, 2.5e-6, 0.0, SWEDEN),  # degrees: a pixel is half as wide as high
        (2263, 0.5, 0.0, NEW_YORK),  # US survey feet
        (3857, 0.2, 0.0, SWEDEN),  # metres that are half a metre
        (5845, 0.2, -100.0, SWEDEN),  # with heights
        (32633, 0.06, 0.0, SWEDEN),  # read at half its size
    ],
)
def test_an_image_lies_in_world(crs: int, pixel: float, turn_deg: float, datum: Geodetic, tmp_path: Path) -> None:
    transform, width, height = framed(crs, pixel, datum, turn_deg)
    image = drawn(crs, transform, width, height, datum)
    check(around(write(tmp_path / "a.tif", colours(image), crs=f"EPSG:{crs}", transform=transform), datum=datum))


def test_an_image_of_half_metres_is_averaged_like_one_of_metres(tmp_path: Path) -> None:
    """Stripes finer than the grid are grey: 1.87 units of Web Mercator are 1 m at 57.7 deg."""
    spread = []
    for crs, unit in ((32633, 1.0), (3857, 1.0 / np.cos(np.radians(57.7)))):
        transform, width, height = framed(crs, 0.12 * unit)
        stripes = np.where(np.arange(width) % 4 < 2, 0, 255).astype(np.uint8)
        bands = np.broadcast_to(stripes, (3, height, width))
        patch = around(write(tmp_path / "a.tif", bands, crs=f"EPSG:{crs}", transform=transform), 0.4)
        spread.append(float(patch.pixels.std()))
    assert spread[0] == pytest.approx(spread[1], abs=1.0)
    assert max(spread) < 15.0  # of 127


def test_a_fine_image_is_read_at_a_part_of_its_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = utm(tmp_path / "a.tif", colours, pixel=0.05)
    image, shapes = AerialImage(path, Datum(SWEDEN)), []
    read = AerialImage._read  # noqa: SLF001

    def spy(self: AerialImage, *args: Any) -> Any:
        shapes.append((found := read(self, *args))[1].shape)
        return found

    monkeypatch.setattr(AerialImage, "_read", spy)
    check(image.patch(np.array([15.0, -20.0]), 30.0, 0.5))
    assert max(shapes[0]) < 500  # of 1200: 10 pixels a cell, by 4


def palette(grey: Bytes) -> Bytes:
    return np.where(grey > 0.5 * (DARK + BRIGHT), 7, np.where(grey > DARK, 9, 3)).astype(np.uint8)[None]


def test_pixels_of_every_kind(tmp_path: Path) -> None:
    check(around(utm(tmp_path / "grey.tif", lambda g: g[None])))
    check(around(utm(tmp_path / "two.tif", lambda g: np.stack([g, np.full_like(g, 255)]))))
    turned = utm(
        tmp_path / "bgr.tif", lambda g: np.stack([np.full_like(g, 9), g, 255 - g, g]), photometric="MINISBLACK"
    )
    with rasterio.open(turned, "r+") as f:
        f.colorinterp = [rasterio.enums.ColorInterp[c] for c in ("undefined", "blue", "green", "red")]
    patch = around(turned)
    check(patch)
    check(patch, 255 - BRIGHT, 255 - DARK, band=1)
    with pytest.raises(InputError, match=r"c\.tif: no picture in it"):
        around(utm(tmp_path / "c.tif", lambda g: g[None].astype(np.complex64)))


def test_a_palette_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = utm(tmp_path / "a.tif", palette, photometric="PALETTE")
    with rasterio.open(path, "r+") as f:
        f.write_colormap(1, {3: (DARK, 0, 50, 255), 7: (BRIGHT, 0, 60, 255), 9: (120, 0, 70, 255)})
    patch = around(path)
    check(patch, atol_m=0.04)
    assert set(np.unique(patch.pixels[..., 1])) == {0}
    check(around(path, cell_m=1.0), atol_m=0.1)
    monkeypatch.setattr("graphloc.frontends.aerial.image._PALETTE_PX", 1000)  # a whole map would fill the memory
    with pytest.raises(InputError, match=r"\d+ x \d+ pixels with a palette are too many"):
        around(path)


@pytest.mark.parametrize(("kind", "scale"), [("uint16", 12.0), ("int16", 100.0), ("float32", 0.004)])
def test_deep_pixels_are_stretched(kind: str, scale: float, tmp_path: Path) -> None:
    """The bright thing is 330 of 19600 m^2: a second one of the same colour makes 2 % of it, and 98 % the bright."""

    def deep(grey: Bytes) -> NDArray[Any]:
        grey[-60:] = BRIGHT
        return np.asarray(colours(grey) * scale).astype(kind)

    path = utm(tmp_path / "a.tif", deep)
    check(around(path), 255, 0)
    known = utm(tmp_path / "b.tif", lambda g: np.where(np.arange(g.shape[1]) > 50, deep(g), -9 if kind != "uint16" else 0).astype(kind), nodata=0 if kind == "uint16" else -9)  # fmt: skip
    check(around(known), 255, 0)  # what is no data does not count


def test_no_data_is_said_in_many_ways(tmp_path: Path) -> None:
    def holed(grey: Bytes) -> Bytes:
        grey[:, :300] = 0  # 60 of 140 m: 10 m west of the middle
        return grey

    def alpha(grey: Bytes) -> Bytes:
        return np.stack([grey, grey, grey, np.where(holed(grey) > 0, 255, 0).astype(np.uint8)])

    ways = {
        "alpha": utm(tmp_path / "alpha.tif", alpha, photometric="RGB", alpha="YES"),
        "nodata": utm(tmp_path / "nodata.tif", lambda g: colours(holed(g)), nodata=0),
        "mask": utm(tmp_path / "mask.tif", colours),
        "fine": utm(tmp_path / "fine.tif", lambda g: colours(holed(g)), nodata=0),
    }
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(ways["mask"], "r+") as f:
        mask = np.full(f.shape, 255, np.uint8)
        mask[:, :300] = 0
        f.write_mask(mask)
    for name, path in ways.items():
        for cell in (0.25, 1.0):
            patch = around(path, cell)
            east = patch.west_m + np.arange(patch.inside.shape[1]) * cell
            ok = patch.inside[len(patch.inside) // 2]
            assert not ok[east < 4.0].any(), name
            assert ok[east > 6.0].all(), name
        blue = utm(tmp_path / "blue.tif", lambda g: np.stack([g, g, np.zeros_like(g)]), nodata=0)
        assert around(blue).inside.all()  # no blue is a colour
    with pytest.raises(InputError, match="does not cover -40 m east"):
        AerialImage(ways["alpha"], Datum(SWEDEN)).patch(np.array([-40.0, -20.0]), 10.0, 0.25)


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


@pytest.mark.parametrize(("kind", "tms"), [("png", False), ("jpg", False), ("webp", False), ("png", True)])
def test_a_folder_of_tiles(kind: str, tms: bool, tmp_path: Path) -> None:
    tiles = tiled(19)
    folder = lay(tmp_path / "tiles & 20 % é", 19, tiles, kind, tms)
    lay(folder, 18, {(0, 0): np.zeros((256, 256, 3), np.uint8)}, kind)
    (folder / "tilemapresource.xml").write_text("<TileMap/>")
    patch = around(folder)
    check(patch, atol_m=0.03)
    assert patch.inside.all()
    assert not list(Path.cwd().glob("gdalwmscache"))


def test_missing_tiles_are_no_data(tmp_path: Path) -> None:
    tiles = tiled(20)
    gone, empty = tile_at(-15.0, -20.0, 20), tile_at(15.0, 15.0, 20)
    unit = 2.0 * HALF_MERCATOR / 2**20
    folder = lay(tmp_path, 20, {k: v for k, v in tiles.items() if k != gone}, "png")
    (folder / f"20/{empty[0]}/{empty[1]}.png").write_bytes(b"")
    patch = AerialImage(folder, Datum(SWEDEN)).patch(np.array([15.0, -20.0]), 40.0, 0.25)
    rows, columns = np.indices(patch.inside.shape)
    p = np.column_stack([(patch.west_m + columns * 0.25).ravel(), (patch.north_m - rows * 0.25).ravel()])
    grid = in_crs(p, 3857, SWEDEN)
    at = np.column_stack([(grid[:, 0] + HALF_MERCATOR) // unit, (HALF_MERCATOR - grid[:, 1]) // unit])
    has = np.array([tuple(k) in tiles.keys() - {gone, empty} for k in at.astype(int)]).reshape(patch.inside.shape)
    assert (has == patch.inside).mean() > 0.998  # but for cells on a border
    assert not has.all()
    check(patch, atol_m=0.03)
    with pytest.raises(InputError, match="does not cover 3000 m east"):
        AerialImage(folder, Datum(SWEDEN)).patch(np.array([3000.0, -20.0]), 40.0, 0.25)
    broken = next(p for p in folder.glob("20/*/*.png") if p.stat().st_size)
    broken.write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"(a part of it cannot be read|not an image).*") as said:
        AerialImage(folder, Datum(SWEDEN)).patch(np.array([15.0, -20.0]), 60.0, 0.25)
    assert broken.name in str(said.value)
    assert "\n" not in str(said.value)


def test_a_coarse_grid_reads_the_tiles_of_a_level_above(tmp_path: Path) -> None:
    """With the level below it away as well: GDAL would look for its tiles were it told of them."""
    tiles = tiled(21)
    lay(lay(tmp_path, 21, tiles, "png"), 20, tiled(20), "png")
    patch = around(tmp_path, 0.5)
    check(patch, atol_m=0.05)
    lay(tmp_path, 20, {k: np.full_like(v, 90) for k, v in tiled(20).items()}, "png")
    assert np.median(around(tmp_path, 0.5).pixels) == 90  # 0.04 m a pixel
    assert np.median(around(tmp_path, 0.1).pixels) == DARK


def test_folders_that_are_no_tiles_are_one_line(tmp_path: Path) -> None:
    datum = Datum(SWEDEN)
    with pytest.raises(InputError, match="no tiles in it: a folder of tiles has z/x/y"):
        AerialImage(tmp_path, datum)
    tiles = dict([next(iter(tiled(19).items()))])
    ((x, y),) = tiles
    turned = lay(tmp_path / "arcgis", 19, {(y, x): tiles[x, y]}, "png")
    with pytest.raises(InputError, match=r"km off, with rows from the top as from below.*z/y/x\?"):
        AerialImage(turned, datum)
    both = lay(lay(tmp_path / "both", 19, tiles, "png"), 19, {(x, y + 1): tiles[x, y]}, "jpg")
    with pytest.raises(InputError, match="tiles of several kinds"):
        AerialImage(both, datum)
    assert "<YOrigin>top<" in describe_tiles(lay(tmp_path / "top", 19, tiles, "png"), datum)
    (tmp_path / "deep/23/5").mkdir(parents=True)
    with pytest.raises(InputError, match="no tiles in it"):
        AerialImage(tmp_path / "deep", datum)


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


@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_an_mbtiles_file(kind: str, tmp_path: Path) -> None:
    tiles = tiled(19)
    gone = tile_at(-40.0, -20.0, 19)
    (west, south), (east, north) = lon_lat(np.array([(-60.0, -100.0), (90.0, 60.0)]), SWEDEN)
    for name, more in (("bounds", {"bounds": f"{west},{south},{east},{north}"}), ("none", {})):
        path = mbtiles(tmp_path / f"{name}.mbtiles", 19, {k: v for k, v in tiles.items() if k != gone}, kind, **more)
        patch = around(path)
        check(patch, atol_m=0.03)
        assert 0.6 < AerialImage(path, Datum(SWEDEN)).patch(np.array([15.0, -20.0]), 45.0, 0.25).inside.mean() < 0.9


def test_images_without_a_place_say_what_to_do(tmp_path: Path) -> None:
    transform, width, height = framed(32633, 0.5)
    bands = colours(drawn(32633, transform, width, height))
    gcps = [
        rasterio.control.GroundControlPoint(r, c, 14.5 + c * 1e-5, 57.7 - r * 1e-5) for r, c in ((0, 0), (0, 9), (9, 0))
    ]

    def said(path: Path) -> str:
        with pytest.raises(InputError) as error:
            AerialImage(path, Datum(SWEDEN))
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)
        return str(error.value)

    bare = pytest.warns(rasterio.errors.NotGeoreferencedWarning)
    with bare:
        path = write(tmp_path / "crs.tif", bands, crs="EPSG:32633")
    assert "a CRS but no transform" in said(path)
    with bare:
        path = write(tmp_path / "plain.tif", bands)
    assert "has no georeference" in said(path)
    with bare:
        world = write(tmp_path / "world.png", bands, driver="PNG")
    assert "gdalwarp -t_srs" in said(write(tmp_path / "gcp.tif", bands, gcps=gcps, crs="EPSG:4326"))
    (tmp_path / "world.png.aux.xml").unlink(missing_ok=True)
    (tmp_path / "world.pgw").write_text("\n".join(str(transform[k]) for k in (0, 3, 1, 4, 2, 5)))
    assert "gdal_translate -a_srs EPSG:<its code> world.png" in said(world)
    local = 'LOCAL_CS["site",UNIT["metre",1]]'
    assert "its CRS cannot be used" in said(write(tmp_path / "local.tif", bands, crs=local, transform=transform))
    assert "not an image" in said(tmp_path / "absent.tif")


def test_a_loose_tie_to_wgs_84_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """NAD 83 is tied to WGS 84 to 4 m by EPSG's best; SWEREF 99 to 1 m."""
    for crs, pixel, datum, words in ((2263, 0.5, NEW_YORK, 1), (3006, 0.2, SWEDEN, 0)):
        caplog.clear()
        transform, width, height = framed(crs, pixel, datum)
        write(tmp_path / "a.tif", colours(np.zeros((height, width), np.uint8)), crs=f"EPSG:{crs}", transform=transform)
        AerialImage(tmp_path / "a.tif", Datum(datum))
        assert len(caplog.records) == words


BLOCK = [(0.0, 0.0), (60.0, 0.0), (60.0, 40.0), (0.0, 40.0), (0.0, 0.0)]  # counter-clockwise
POND = [(20.0, 10.0), (40.0, 10.0), (40.0, 30.0), (20.0, 30.0), (20.0, 10.0)]


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


def lands(found: VectorMap, inside: Callable[[Array], NDArray[np.bool_]]) -> set[bool]:
    """Whether a step to land from the middle of each segment leads into a shape."""
    step = 0.5 * np.column_stack([np.cos(found.to_land_rad), np.sin(found.to_land_rad)])
    return set(inside(found.segments_m.mean(axis=1) + step).tolist())


def in_block(p: Array) -> NDArray[np.bool_]:
    return np.asarray(((p > 0.0) & (p < [60.0, 40.0])).all(axis=1))


def in_pond(p: Array) -> NDArray[np.bool_]:
    return np.asarray(((p > [20.0, 10.0]) & (p < [40.0, 30.0])).all(axis=1))


def test_lines_lie_in_world(tmp_path: Path) -> None:
    far = [(-400.0, 300.0), (90.0, -250.0), (120.0, -250.0)]
    geometries: list[tuple[str, Any]] = [
        ("LineString", degrees(far)),
        ("LineString", [[*p, 99.0] for p in degrees(far)]),
        ("MultiLineString", [degrees(far)]),
    ]
    for kind, coordinates in geometries:
        bare = {"type": kind, "coordinates": coordinates}
        whole = {"type": "GeometryCollection", "geometries": [bare, {"type": "Point", "coordinates": [0, 0]}]}
        for k, document in enumerate((bare, feature(kind, coordinates), whole)):
            (tmp_path / "a.json").write_text(json.dumps(document), encoding="utf-8-sig")
            found = read(tmp_path / "a.json")
            np.testing.assert_allclose(found.segments_m, [far[:2], far[1:]], atol=1e-6)
            assert np.isnan(found.to_land_rad).all()
            assert found.points_left == (1 if k == 2 else 0)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("tags", "land"),
    [
        ({"graphloc": "land"}, True),
        ({"graphloc": "water", "building": "yes"}, False),
        ({"building": "warehouse"}, True),
        ({"man_made": "pier", "harbour": "yes"}, True),
        ({"man_made": "jetty", "building": "no"}, True),
        ({"natural": "coastline"}, True),
        ({"place": "islet"}, True),
        ({"natural": "water", "building": None}, False),
        ({"water": "harbour"}, False),
        ({"waterway": "dock"}, False),
        ({"landuse": "basin"}, False),
        ({"waterway": "dam"}, None),
        ({"man_made": "crane", "harbour": "no"}, None),
        ({}, None),
    ],
)
def test_which_side_of_a_polygon_is_land(tags: dict[str, Any], land: bool | None, turned: bool, tmp_path: Path) -> None:
    """Whichever way its rings run; of the hole the other side."""
    rings = [degrees(BLOCK, turned), degrees(POND, turned)]
    for kind, coordinates in (("Polygon", rings), ("MultiPolygon", [rings])):
        found = read(saved(tmp_path / "a.json", feature(kind, coordinates, **tags)))
        assert len(found.segments_m) == 8
        if land is None:
            assert np.isnan(found.to_land_rad).all()
        else:
            rim, hole = (VectorMap(found.segments_m[k], found.to_land_rad[k]) for k in (slice(0, 4), slice(4, 8)))
            assert lands(rim, in_block) == {land}
            assert lands(hole, in_pond) == {not land}


def test_land_is_left_of_a_coastline(tmp_path: Path) -> None:
    """And of no other line; an open ring is closed, a ring without an area has no side."""
    east = degrees([(0.0, 0.0), (50.0, 0.0), (50.0, 30.0)])
    found = read(saved(tmp_path / "a.json", feature("LineString", east, natural="coastline")))
    np.testing.assert_allclose(np.sin(found.to_land_rad), [1.0, 0.0], atol=1e-5)
    assert np.cos(found.to_land_rad[1]) < 0.0
    found = read(saved(tmp_path / "a.json", feature("LineString", east, man_made="pier")))
    assert np.isnan(found.to_land_rad).all()
    found = read(saved(tmp_path / "a.json", feature("Polygon", [degrees(BLOCK[:4])], natural="water")))
    assert len(found.segments_m) == 4
    assert lands(found, in_block) == {False}
    flat = feature("Polygon", [degrees([(0.0, 0.0), (9.0, 0.0), (0.0, 0.0)])], natural="water")
    assert np.isnan(read(saved(tmp_path / "a.json", flat)).to_land_rad).all()


def test_where_two_waters_meet_is_no_shore(tmp_path: Path) -> None:
    """But where water meets a pier is one."""
    west, east = degrees(BLOCK), degrees([(60.0, 0.0), (90.0, 0.0), (90.0, 40.0), (60.0, 40.0), (60.0, 0.0)])
    two = [feature("Polygon", [west], natural="water"), feature("Polygon", [east], natural="water")]
    assert len(read(saved(tmp_path / "a.json", *two)).segments_m) == 6
    two[1]["properties"] = {"man_made": "pier"}
    found = read(saved(tmp_path / "a.json", *two))
    assert len(found.segments_m) == 8
    common = np.abs(found.segments_m[..., 0] - 60.0).max(axis=1) < 0.01
    np.testing.assert_allclose(found.to_land_rad[common], [0.0, 0.0], atol=1e-3)


def test_what_is_around_a_place(tmp_path: Path) -> None:
    lines = [[(-900.0, 1.0), (900.0, 1.0)], [(20.0, 0.0), (20.0, 5.0)], [(60.0, 0.0), (61.0, 0.0)]]
    found = read(saved(tmp_path / "a.json", *(feature("LineString", degrees(line)) for line in lines)))
    near = found.around(np.array([0.0, 10.0]), 30.0)  # the first has both its ends outside
    np.testing.assert_allclose(near.segments_m, lines[:2], atol=1e-6)
    assert len(near.to_land_rad) == 2
    assert len(found.around(np.array([0.0, 9000.0]), 30.0).around(np.array([0.0, 0.0]), 1.0).segments_m) == 0


def test_a_crs_of_the_older_geojson_is_honoured(tmp_path: Path) -> None:
    line = np.array([(-20.0, 30.0), (90.0, -25.0)])
    for name, xy in (
        ("urn:ogc:def:crs:EPSG::3006", in_crs(line, 3006, SWEDEN)),
        ("urn:ogc:def:crs:OGC:1.3:CRS84", lon_lat(line, SWEDEN)),
        ("urn:ogc:def:crs:EPSG::4326", lon_lat(line, SWEDEN)),
    ):
        crs = {"type": "name", "properties": {"name": name}}
        found = read(saved(tmp_path / "a.json", feature("LineString", xy.tolist()), crs=crs))
        np.testing.assert_allclose(found.segments_m, [line], atol=1e-3)


OK = degrees([(0.0, 0.0), (10.0, 0.0)])
SWAPPED = [p[::-1] for p in OK]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"{", "not JSON"),
        (b"\xff\xfe\x00", "not JSON"),
        (b"[1, 2]", "not GeoJSON"),
        (b'{"type": "Topology"}', "not GeoJSON .*'Topology'"),
        (b'{"type": "FeatureCollection"}', "without a list of `features`"),
        (b'{"type": "FeatureCollection", "features": [3]}', "feature 0: not GeoJSON"),
        (b'{"type": "FeatureCollection", "features": []}', r"no line or polygon in it \(0 points\)"),
        (b'{"type": "MultiPoint", "coordinates": [[14, 57], [15, 57]]}', r"no line or polygon in it \(2 points\)"),
        (b'{"type": "LineString", "coordinates": [[NaN, 57], [15, 57]]}', "NaN in it is no number"),
        (b'{"type": "LineString", "coordinates": [[1e999, 57], [15, 57]]}', "not finite"),
        (b'{"type": "LineString", "coordinates": [[1' + b"0" * 400 + b", 57], [15, 57]]}", "not finite"),
        (b'{"type": "LineString", "coordinates": [["14", 57], [15, 57]]}', "coordinates are not numbers .'14'"),
        (b'{"type": "LineString", "coordinates": [[null, 57], [15, 57]]}', "coordinates are not numbers .'None'"),
        (b'{"type": "LineString", "coordinates": [[14], [15]]}', "a position is not two or three numbers"),
        (b'{"type": "LineString", "coordinates": [14, 57]}', "a LineString without lists of positions"),
        (b'{"type": "LineString"}', "a LineString without lists of positions"),
        (b'{"type": "Polygon", "coordinates": [[14, 57], [15, 57]]}', "a Polygon without lists of positions"),
        (b"[" * 100_000, "nested too deep"),
        (b'{"type":"GeometryCollection","geometries":[' * 400 + b"]}" * 400, "nested too deep|no line"),
        (feature("LineString", SWAPPED), "looks like latitude, longitude; GeoJSON wants longitude, latitude"),
        (feature("LineString", [[120.0, 5.0], [121.0, 5.0]]), r"lies \d{4,5} km from the datum"),
        (feature("LineString", [[14.5, 58.7], [14.5, 58.71]]), "lies 111 km from the datum"),
        (feature("LineString", [[470198.0, 6395420.0], [470199.0, 6395420.0]]), "6395420 are no degrees"),
        (feature("Polygon", [OK], graphloc="sea"), "`graphloc` is 'sea': water or land"),
        (feature("LineString", OK, graphloc="land"), "has no inside"),
        ({**feature("LineString", OK), "crs": {"type": "name", "properties": {"name": "site"}}}, "its `crs` member"),
        ({**feature("LineString", OK), "crs": {"type": "link"}}, "its `crs` member"),
    ],
)
def test_lines_that_cannot_be_used_are_one_line(content: bytes | dict[str, Any], why: str, tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with pytest.raises(InputError, match=why) as said:
        read(path)
    assert str(said.value).startswith(f"{path}: ")
    assert "\n" not in str(said.value)
    assert len(str(said.value)) < len(str(path)) + 200


def test_files_that_cannot_be_read_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.json: No such file"):
        read(tmp_path / "a.json")
    with pytest.raises(InputError, match="Is a directory"):
        read(tmp_path)
    with pytest.raises(InputError, match="feature 1: coordinates are not numbers"):
        read(saved(tmp_path / "a.json", feature("LineString", OK), feature("LineString", [["x", 1], [2, 3]])))
    with (tmp_path / "a.json").open("wb") as f:
        f.truncate(200_000_001)
    with pytest.raises(InputError, match="more than 200 MB"):
        read(tmp_path / "a.json")


def test_a_part_of_a_folder_of_tiles_says_what_to_name(tmp_path: Path) -> None:
    """A level of few tiles has columns that read like levels."""
    for zoom, tiles in ((19, tiled(19)), (4, {(8, 4): np.zeros((256, 256, 3), np.uint8)})):
        folder = lay(tmp_path / f"tiles {zoom}", zoom, tiles, "png")
        for part, what in ((f"{zoom}", "one level"), (f"{zoom}/{next(iter(tiles))[0]}", "one column")):
            with pytest.raises(InputError) as said:
                AerialImage(folder / part, Datum(SWEDEN))
            assert str(said.value).startswith(f"{folder / part}: {what} of ")
            assert f", {folder}: a folder of tiles has z/x/y" in str(said.value)


def test_what_else_lies_among_tiles_does_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """But a level 019 is none: GDAL would ask for 19."""
    folder = lay(tmp_path / "tiles", 19, tiled(19), "png")
    column = next((folder / "19").iterdir())
    (folder / "20").write_text("a plain file")
    (folder / "21.d").mkdir()
    (folder / "019").mkdir()
    (folder / "19/12.json").write_text("{}")
    for k in range(1, 20):
        (folder / f"19/{tile_at(0.0, 0.0, 19)[0] + k * 2**19}").mkdir()  # no such columns
    (column / "3.json").write_text("{}")
    check(around(folder), atol_m=0.03)
    (folder / "19").rename(folder / "0019")
    with pytest.raises(InputError, match="no tiles in it"):
        around(folder)

    def refuse(self: Path) -> Any:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(InputError, match=r"tiles: cannot be listed \(Permission denied\)"):
        around(folder)


def test_a_path_that_is_none_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="File name too long"):
        AerialImage(tmp_path / ("x" * 300), Datum(SWEDEN))


def test_a_datum_may_count_longitudes_to_360(tmp_path: Path) -> None:
    """74 deg west is 286 deg: an image in a CRS, tiles, and lines lie where they do with -74."""
    west, east = NEW_YORK, NEW_YORK._replace(longitude_deg=NEW_YORK.longitude_deg + 360.0)
    transform, width, height = framed(2263, 0.5, west)
    image = drawn(2263, transform, width, height, west)
    path = write(tmp_path / "a.tif", colours(image), crs="EPSG:2263", transform=transform)
    check(around(path, datum=east))
    check(around(lay(tmp_path / "tiles", 19, tiled(19, west), "png"), datum=east), atol_m=0.03)
    line = [(-20.0, 30.0), (90.0, -25.0)]
    at = lon_lat(np.array(line), west)
    for written in (at, np.add(at, [360.0, 0.0])):
        path = saved(tmp_path / "a.json", feature("LineString", written.tolist()))
        for datum in (west, east):
            np.testing.assert_allclose(read_vector(path, Datum(datum)).segments_m, [line], atol=1e-6)


def test_tiles_and_lines_at_the_date_line(tmp_path: Path) -> None:
    """The last column is beside the first, and water cut in two at 180 deg is one water."""
    fiji = Geodetic(-16.8, -179.999, 30.0)
    tiles = tiled(16, fiji._replace(longitude_deg=179.999))
    assert f"{2**16 - 1}/" in str(next(lay(tmp_path / "tiles", 16, tiles, "png").glob("16/*/*.png")))
    assert "<YOrigin>top<" in describe_tiles(tmp_path / "tiles", Datum(fiji))

    with pytest.raises(InputError, match=r"the date line of its CRS runs through it -100 m east, 0 m north"):
        AerialImage(tmp_path / "tiles", Datum(fiji)).patch(np.array([-100.0, 0.0]), 40.0, 0.25)

    def water(west: float, east: float) -> dict[str, Any]:
        ring = [[west, -16.8], [east, -16.8], [east, -16.79], [west, -16.79], [west, -16.8]]
        return feature("Polygon", [ring], natural="water")

    for name, halves in (("cut", [water(179.99, 180.0), water(-180.0, -179.99)]), ("whole", [water(179.99, 180.01)])):
        found = read_vector(saved(tmp_path / "a.json", *halves), Datum(fiji))
        shores = found.segments_m[np.abs(found.segments_m[:, 0, 0] - found.segments_m[:, 1, 0]) < 1.0]
        # A hundredth of a degree is 1066 m of this parallel; the datum is a thousandth east of the line.
        np.testing.assert_allclose(sorted(shores[:, 0, 0]), [-1172.6, 959.4], atol=1.0, err_msg=name)
        to_land = np.cos(found.to_land_rad[np.abs(np.cos(found.to_land_rad)) > 0.5])
        np.testing.assert_allclose(sorted(to_land), [-1.0, 1.0], atol=1e-3)


def test_lines_across_a_part_of_the_earth(tmp_path: Path) -> None:
    """What is far off is left out, and does not turn the sides of what is near."""
    corner = [14.5, 57.7]
    huge = [corner, [60.0, 57.7], [60.0, 70.0], [14.5, 70.0], corner]
    with pytest.raises(InputError, match="no piece of its lines has a length of up to 50 km"):
        read(saved(tmp_path / "a.json", feature("Polygon", [huge])))
    # The sea south of a shore of 1 km, to beyond the pole: in a plane that point would lie north.
    near = lon_lat(np.array([(0.0, 0.0), (1000.0, 0.0)]), SWEDEN).tolist()
    far = [[-166.5, -50.0]]
    antipode = [[-165.5, -57.7], [-165.4999, -57.7], [-165.4999, -57.6999]]
    sea = feature("Polygon", [[near[0], near[1], *far]], natural="water")
    found = read(saved(tmp_path / "a.json", sea, feature("LineString", antipode)))
    np.testing.assert_allclose(found.segments_m, [[(0.0, 0.0), (1000.0, 0.0)]], atol=1e-6)
    assert np.sin(found.to_land_rad) == pytest.approx(1.0, abs=1e-3)


def test_features_without_a_place_or_tags_are_passed_over(tmp_path: Path) -> None:
    line = {"type": "LineString", "coordinates": OK}
    bare: list[dict[str, Any]] = [{"type": "Feature", "geometry": None}, {"type": "Feature", "geometry": line}]
    bare += [{"type": "Feature"}, {"type": "Feature", "properties": None, "geometry": line}]
    assert len(read(saved(tmp_path / "a.json", *bare)).segments_m) == 2


KINDS = {row.kind: row.config for row in SENSORS}
LIDARS = {"bow": {"topic": "/a"}, "mast": {"topic": "/b"}}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"reach_m": 301}, r"sensors.aerial.reach_m: .*less than or equal to 300"),
        ({"window_m": 51}, r"sensors.aerial.window_m: .*less than or equal to 50"),
        ({"window_deg": 31}, r"sensors.aerial.window_deg: .*less than or equal to 30"),
        ({"lidars": {**LIDARS, "aft": {"topic": "/a"}}}, "lidars: bow and aft have the same topic, /a"),
        ({"hull_m": [[5, 0]]}, "hull_m: an outline has three corners or more"),
        ({"hull_m": [[5, 1], [5, -1]]}, "hull_m: an outline has three corners or more"),
        ({"hull_m": [[5, 1], [-5, -1], [5, -1], [-5, 1]]}, "hull_m: .* make no outline: Self-intersection"),
        ({"hull_m": [[5, 1], [4, 1], [3, 1]]}, "hull_m: .* make no outline"),
        ({"mount": {"xyz_m": [1, 0, 0]}}, "mount: not used here.*set it for each of `lidars`"),
        ({"mount": {"tf_frame": "lidar"}}, "mount: not used here"),
        ({"topic": "/points"}, "topic: not used here"),
    ],
)
def test_an_aerial_block_that_cannot_be_meant_is_one_line(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why) as said:
        parse_config({"sensors": {"aerial": {"lidars": LIDARS, **changes}}}, KINDS, "vessel.yaml")
    assert "\n" not in str(said.value)
    assert "sensors.aerial." in str(said.value)


def test_an_aerial_block_at_its_bounds_is_read() -> None:
    block = {"reach_m": 300, "window_m": 50, "window_deg": 30, "topic": "", "mount": {}, "lidars": LIDARS}
    for hull in ([], [[5, 1], [-5, 1], [0, 0], [-5, -1], [5, -1]], [[5, 1], [-5, 1], [5, -1], [5, 1]]):
        config = parse_config({"sensors": {"aerial": {**block, "hull_m": hull}}}, KINDS, "vessel.yaml")
        assert len(config.sensors["aerial"].hull_m) == len(hull)
