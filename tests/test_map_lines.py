# SPDX-License-Identifier: Apache-2.0
"""Drawn lines lie where they are in world, with their land on the right side."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends.aerial.vector import VectorMap
from tests.mapfactory import SWEDEN, degrees, feature, in_crs, lon_lat, read, saved

BLOCK = [(0.0, 0.0), (60.0, 0.0), (60.0, 40.0), (0.0, 40.0), (0.0, 0.0)]  # counter-clockwise
POND = [(20.0, 10.0), (40.0, 10.0), (40.0, 30.0), (20.0, 30.0), (20.0, 10.0)]


def lands(found: VectorMap, inside: Callable[[Array], NDArray[np.bool_]]) -> set[bool]:
    """Whether a step to land from the middle of each segment leads into a shape."""
    step = 0.5 * np.column_stack([np.cos(found.to_land_rad), np.sin(found.to_land_rad)])
    return set(inside(found.segments_m.mean(axis=1) + step).tolist())


def in_block(p: Array) -> NDArray[np.bool_]:
    return np.asarray(((p > 0.0) & (p < [60.0, 40.0])).all(axis=1))


def in_pond(p: Array) -> NDArray[np.bool_]:
    return np.asarray(((p > [20.0, 10.0]) & (p < [40.0, 30.0])).all(axis=1))


def test_lines_lie_in_world(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
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
            assert ["1 points left out" in text for text in caplog.messages] == [True] * (k == 2)
            caplog.clear()


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
