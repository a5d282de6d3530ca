# SPDX-License-Identifier: Apache-2.0
"""Tiles, in folders and MBTiles, lie where they are in world; what else lies among them does no harm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphloc.errors import InputError
from graphloc.frames import Datum, Geodetic
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.tiles import describe_tiles
from graphloc.frontends.aerial.vector import read_vector
from tests.mapfactory import (
    DARK,
    HALF_MERCATOR,
    NEW_YORK,
    SWEDEN,
    around,
    check,
    colours,
    drawn,
    feature,
    framed,
    in_crs,
    lay,
    lon_lat,
    mbtiles,
    saved,
    tile_at,
    tiled,
    write,
)


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


def test_a_part_of_a_folder_of_tiles_says_what_to_name(tmp_path: Path) -> None:
    """A level of few tiles has columns that read like levels."""
    for zoom, tiles in ((19, tiled(19)), (4, {(8, 4): np.zeros((256, 256, 3), np.uint8)})):
        folder = lay(tmp_path / f"tiles {zoom}", zoom, tiles, "png")
        for part, what in ((f"{zoom}", "one level"), (f"{zoom}/{next(iter(tiles))[0]}", "one column")):
            with pytest.raises(InputError) as said:
                AerialImage(folder / part, Datum(SWEDEN))
            assert str(said.value).startswith(f"{folder / part}: {what} of ")
            assert f", {folder}: a folder of tiles has z/x/y" in str(said.value)


def test_a_folder_of_sheets_says_how_to_make_them_one(tmp_path: Path) -> None:
    """Agencies cut an image of a town into sheets, each with a georeference of its own."""
    for name in ("dop10_2.tif", "dop10_1.tif", "dop10_1.tfw", "readme.txt"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"folder of 2 images, such as dop10_1.tif: .* gdalbuildvrt all.vrt \*.tif"):
        AerialImage(tmp_path, Datum(SWEDEN))
    (tmp_path / "dop10_2.tif").unlink()
    with pytest.raises(InputError, match=r"one image in it: name dop10_1.tif itself$"):
        AerialImage(tmp_path, Datum(SWEDEN))


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
