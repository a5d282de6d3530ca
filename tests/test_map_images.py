# SPDX-License-Identifier: Apache-2.0
"""Images of every kind a user may have lie where they are in world."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from pyproj import CRS

from graphloc.config import AerialConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.aerial import image as image_module
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.layers import find_edges
from graphloc.frontends.aerial.maps import Map
from graphloc.frontends.aerial.scan import Outline
from tests.mapfactory import BRIGHT, DARK, NEW_YORK, SWEDEN, Bytes, around, check, colours, drawn, framed, utm, write

SEEN = Outline(*np.empty((9, 0)))


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
        tmp_path / "bgr.tif",
        lambda g: np.stack([np.full_like(g, 9), g, (0.75 * g).astype(np.uint8), g]),
        photometric="MINISBLACK",
    )
    with rasterio.open(turned, "r+") as f:
        f.colorinterp = [rasterio.enums.ColorInterp[c] for c in ("undefined", "blue", "green", "red")]
    patch = around(turned)
    check(patch)
    check(patch, 0.75 * BRIGHT, 0.75 * DARK, band=1)
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
    """To a contrast of 120 from 36 on. The bright thing is small; a second one of the same colour makes 98 % the bright."""

    def deep(grey: Bytes) -> NDArray[Any]:
        grey[-60:] = BRIGHT
        return np.asarray(colours(grey) * scale).astype(kind)

    path = utm(tmp_path / "a.tif", deep)
    check(around(path), 156, 36)
    known = utm(tmp_path / "b.tif", lambda g: np.where(np.arange(g.shape[1]) > 50, deep(g), -9 if kind != "uint16" else 0).astype(kind), nodata=0 if kind == "uint16" else -9)  # fmt: skip
    check(around(known), 156, 36)  # what is no data does not count


@pytest.mark.parametrize(("brightness", "contrast"), [(0.0, 0.25), (170.0, 0.3), (-20.0, 1.5), (20.0, 0.8), (0.0, 1.0)])
def test_the_edges_found_are_those_of_a_usual_contrast(brightness: float, contrast: float, tmp_path: Path) -> None:
    """A dark, a hazy and a harsh picture have the edges of a good one."""
    rng = np.random.default_rng(1)
    fields = np.kron(rng.choice([20.0, 85.0, 150.0], (12, 12)), np.ones((50, 50)))
    picture = fields + rng.normal(0.0, 2.0, fields.shape)

    def edges(name: str, pixels: Array) -> NDArray[np.bool_]:
        path = utm(
            tmp_path / name,
            lambda g: colours(np.clip(pixels, 0, 255).round().astype(np.uint8)[: g.shape[0], : g.shape[1]]),
        )
        return find_edges(around(path, cell_m=0.25)).where

    usual, found = edges("usual.tif", picture), edges("a.tif", np.asarray(brightness + contrast * picture))
    assert usual.sum() > 1000
    assert (usual != found).sum() < 0.15 * usual.sum()


def test_a_collar_is_no_contrast(tmp_path: Path) -> None:
    """With the black and the white around it a hazy picture had as much as a good one."""
    rng = np.random.default_rng(1)

    def collared(grey: Bytes) -> Bytes:
        hazy = colours((150.0 + 0.3 * grey + rng.normal(0.0, 1.0, grey.shape)).round().astype(np.uint8))
        hazy[:, :, :120], hazy[:, :, -120:] = 0, 255
        return hazy

    seen = around(utm(tmp_path / "a.tif", collared)).pixels[40:200, 40:200].astype(int)
    assert np.ptp(seen) > 100


@pytest.mark.parametrize(("kind", "bright"), [("uint8", 40), ("uint16", 1)])
def test_black_water_is_contrast_where_there_is_no_other(kind: str, bright: int, tmp_path: Path) -> None:
    """Taken for a collar, it left the contrast of the land alone: a dark picture was not stretched, and one of 16 bits lost all."""
    dark = utm(tmp_path / "a.tif", lambda grey: colours((bright * (grey > DARK)).astype(kind)))
    assert np.ptp(around(dark).pixels.astype(int)) > 100


def test_a_harbour_between_the_samples_is_seen_around_the_datum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a large image of the sea, which was stretched like a hazy one."""
    for name, value in {"_SAMPLE_PX": 20, "_SAMPLES": 4, "_AROUND_M": 25.0}.items():
        monkeypatch.setattr(image_module, name, value)

    def sea(grey: Bytes) -> Bytes:
        rows, columns = np.indices(grey.shape) // 5
        return colours(np.where(grey == DARK, DARK + 20 * ((rows + columns) % 2), grey).astype(np.uint8))

    assert around(utm(tmp_path / "a.tif", sea)).pixels.max() == BRIGHT


def test_a_tile_that_cannot_be_read_is_no_matter_elsewhere(tmp_path: Path) -> None:
    path = utm(tmp_path / "a.tif", colours, tiled=True, blockxsize=64, blockysize=64, compress="deflate")
    with rasterio.open(path) as f:
        offset, size = (int(f.get_tag_item(f"BLOCK_{what}_10_10", "TIFF", bidx=1)) for what in ("OFFSET", "SIZE"))
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(bytes(size))
    image = AerialImage(path, Datum(SWEDEN))
    check(image.patch(np.array([15.0, -20.0]), 30.0, 0.25))
    with pytest.raises(InputError, match="a part of it cannot be read"):
        image.patch(np.array([75.0, -80.0]), 10.0, 0.25)


def test_no_data_is_reported_in_many_ways(tmp_path: Path) -> None:
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
        infrared = utm(tmp_path / "infrared.tif", lambda g: np.stack([g, g, g, g // 8]), photometric="RGB", alpha="YES")
        assert around(infrared).inside.all()  # it is no alpha, though it is labelled so
        blue = utm(tmp_path / "blue.tif", lambda g: np.stack([g, g, np.zeros_like(g)]), nodata=0)
        assert around(blue).inside.all()  # no blue is a colour
    with pytest.raises(InputError, match="does not cover -40 m east"):
        AerialImage(ways["alpha"], Datum(SWEDEN)).patch(np.array([-40.0, -20.0]), 10.0, 0.25)


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
    assert "its CRS (site) is tied to no place on Earth" in said(
        write(tmp_path / "local.tif", bands, crs=local, transform=transform)
    )
    assert "not an image" in said(tmp_path / "absent.tif")


def test_the_crs_may_lie_beside_a_world_file(tmp_path: Path) -> None:
    """A .prj in ESRI's dialect, as agencies deliver it with .jgw: the image lies where its GeoTIFF does."""
    transform, width, height = framed(32633, 0.5)
    bands = colours(drawn(32633, transform, width, height))
    whole = write(tmp_path / "whole.tif", bands, crs="EPSG:32633", transform=transform)
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        world = write(tmp_path / "world.png", bands, driver="PNG")
    (tmp_path / "world.png.aux.xml").unlink(missing_ok=True)
    corner = transform @ rasterio.Affine.translation(0.5, 0.5)  # a world file counts from the middle of a pixel
    (tmp_path / "world.pgw").write_text("\n".join(str(corner[k]) for k in (0, 3, 1, 4, 2, 5)))
    (tmp_path / "world.prj").write_text(CRS.from_epsg(32633).to_wkt("WKT1_ESRI"))
    assert (around(world).pixels == around(whole).pixels).all()
    (tmp_path / "world.prj").write_text("WGS 84, zone 33")
    with pytest.raises(InputError, match="its CRS cannot be used"):
        AerialImage(world, Datum(SWEDEN))


def test_a_loose_tie_to_wgs_84_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """NAD 83 is tied to WGS 84 to 4 m by EPSG's best; SWEREF 99 to 1 m."""
    for crs, pixel, datum, words in ((2263, 0.5, NEW_YORK, 1), (3006, 0.2, SWEDEN, 0)):
        caplog.clear()
        transform, width, height = framed(crs, pixel, datum)
        write(tmp_path / "a.tif", colours(np.zeros((height, width), np.uint8)), crs=f"EPSG:{crs}", transform=transform)
        AerialImage(tmp_path / "a.tif", Datum(datum))
        assert len(caplog.records) == words


def test_a_path_that_is_none_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="File name too long"):
        AerialImage(tmp_path / ("x" * 300), Datum(SWEDEN))


@pytest.mark.parametrize(("failures", "asked"), [(2, 3), (9, 3)])
def test_a_tile_that_fails_is_asked_for_three_times(
    failures: int, asked: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network's disk may answer the next scan; what lies beyond the image says so without being read each time."""
    utm(tmp_path / "a.tif", colours)
    chart, calls = Map(AerialConfig(image="a.tif"), tmp_path, Datum(SWEDEN)), []
    layers: Any = SimpleNamespace(shores=True)

    def fails_at_first(*_: Any) -> Any:
        calls.append(1)
        if len(calls) <= failures:
            raise InputError("a.tif: a part of it cannot be read")
        return layers

    monkeypatch.setattr(Map, "_made", fails_at_first)
    for n in range(5):
        if n < failures:
            with pytest.raises(InputError, match=r"a\.tif: a part of it cannot be read"):
                chart.around(np.zeros(3), SEEN)
        else:
            assert chart.around(np.zeros(3), SEEN) is layers
    assert len(calls) == asked


@pytest.mark.parametrize("image", [True, False])
def test_a_tile_without_shores_is_made_anew_by_a_scan_of_more_water(
    image: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many scans saw none before, as among boats; not by each scan, and lines do not change."""
    utm(tmp_path / "a.tif", colours)
    east, north = SWEDEN.longitude_deg, SWEDEN.latitude_deg
    line = {"type": "LineString", "coordinates": [[east, north], [east + 1e-4, north]]}
    (tmp_path / "a.geojson").write_text(json.dumps(line))
    source = AerialConfig(image="a.tif") if image else AerialConfig(vector="a.geojson")
    chart, made = Map(source, tmp_path, Datum(SWEDEN)), []

    def by_water(_self: Map, _middle: Array, _pose: Array, found: Outline) -> Any:
        made.append(len(found.water_m))
        return SimpleNamespace(shores=True if len(found.water_m) >= 50 else None)

    monkeypatch.setattr(Map, "_made", by_water)
    for water in (0, 0, 0, 0, 5, 6, 5, 3, 40, 60, 79, 90, 500):
        chart.around(np.zeros(3), replace(SEEN, water_m=np.zeros((water, 2))))
    assert made == ([0, 5, 40, 90] if image else [0])
