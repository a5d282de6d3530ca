# SPDX-License-Identifier: Apache-2.0
"""Scans laid on an aerial image: georeference, clouds, layers, posterior, and the way through a bag."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer

from graphloc import app
from graphloc.config import AerialConfig, LidarConfig
from graphloc.errors import InputError
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import find_scenario, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.eval.simulate.harbour import load_harbour
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends._source import RawMessage
from graphloc.frontends.aerial import Match, Matcher, Prior, match_bag, scans
from graphloc.frontends.aerial.cloud import CLOUD, Cloud, decode_cloud, level
from graphloc.frontends.aerial.image import AerialImage, Patch
from graphloc.frontends.aerial.layers import (
    EDGE_BINS,
    SHORE_BINS,
    Weights,
    coarse_patch,
    drawn_layers,
    edge_layer,
    find_edges,
    segment_water,
    shore_layer,
    weighed,
)
from graphloc.frontends.aerial.match import Grid, Mode, modes_of
from graphloc.frontends.aerial.scan import LevelCloud, inside, outline
from graphloc.frontends.aerial.scans import Matched
from graphloc.frontends.aerial.vector import VectorMap
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.trajectory import Trajectory
from tests.commands import called

DATUM = Datum(Geodetic(57.7, 14.5, 30.0))
S = 10**9


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


@pytest.mark.parametrize(
    ("epsg", "pixel", "bands"), [(32633, 0.2, 3), (3857, 0.3, 3), (3006, 0.25, 1), (4326, 2.5e-6, 3)]
)
def test_an_image_lies_in_world_whatever_its_crs(epsg: int, pixel: float, bands: int, tmp_path: Path) -> None:
    """Web Mercator's metre is 1.87 times too long there; UTM's north is 0.4 deg off; degrees are no metres."""
    picture(tmp_path / "a.tif", epsg, pixel, np.array([40.0, -60.0, 60.0, -30.0]), bands)
    patch = AerialImage(tmp_path / "a.tif", DATUM).patch(np.array([30.0, -40.0]), 60.0, 0.25)
    light = np.where(patch.pixels[:, :, 0] > 50, (patch.pixels[:, :, 0] - 38.0) / (180.0 - 38.0), 0.0)
    rows, columns = np.indices(light.shape)
    east, north = patch.west_m + columns * 0.25, patch.north_m - rows * 0.25
    np.testing.assert_allclose([(v * light).sum() / light.sum() for v in (east, north)], [50.0, -45.0], atol=0.03)
    assert light.sum() * 0.25**2 == pytest.approx(20.0 * 30.0, rel=0.02)
    np.testing.assert_allclose(patch.cells(np.array([[patch.west_m, patch.north_m]])), [[0.0, 0.0]], atol=1e-9)


def test_images_that_cannot_be_used_are_one_line(tmp_path: Path) -> None:
    picture(tmp_path / "a.tif", 32633, 0.5, np.array([40.0, -60.0, 60.0, -30.0]))
    with pytest.raises(InputError, match="does not cover 5000 m east"):
        AerialImage(tmp_path / "a.tif", DATUM).patch(np.array([5000.0, 0.0]), 50.0, 0.25)
    cv2.imwrite(str(tmp_path / "plain.png"), np.zeros((50, 50, 3), np.uint8))
    with pytest.raises(InputError, match="has no georeference"):
        AerialImage(tmp_path / "plain.png", DATUM)
    (tmp_path / "text.tif").write_text("no image")
    with pytest.raises(InputError, match="not an image"):
        AerialImage(tmp_path / "text.tif", DATUM)


class Field:
    """A `PointField`."""

    def __init__(self, name: str, offset: int, datatype: int) -> None:
        self.name, self.offset, self.datatype, self.count = name, offset, datatype, 1


class Message:
    """A `PointCloud2` of x, y, z and a time, padded."""

    def __init__(self, points: Array, time: NDArray[Any], name: str, kind: int, big: bool = False) -> None:
        order, code = (">" if big else "<"), {8: "f8", 7: "f4", 6: "u4"}[kind]
        layout = np.dtype({
            "names": ["x", "y", "z", name], "formats": [order + "f4"] * 3 + [order + code], "offsets": [4, 8, 12, 16],
            "itemsize": 28,
        })  # fmt: skip
        rows = np.zeros(len(points), layout)
        for k, axis in enumerate("xyz"):
            rows[axis] = points[:, k]
        rows[name] = time
        self.fields = [Field(a, 4 + 4 * k, 7) for k, a in enumerate("xyz")] + [Field(name, 16, kind)]
        self.height, self.width, self.point_step, self.row_step = 1, len(points), 28, 28 * len(points)
        self.is_bigendian, self.data = big, rows.view(np.uint8).reshape(-1)


@pytest.mark.parametrize(
    ("name", "kind", "unit", "absolute", "big"),
    [("time", 7, 1.0, False, False), ("t", 6, 1e9, False, False), ("timestamp", 8, 1.0, True, True), ("offset_time", 6, 1e6, False, False)],
)  # fmt: skip
def test_clouds_of_many_drivers(name: str, kind: int, unit: float, absolute: bool, big: bool) -> None:
    """Velodyne seconds, Ouster ns, Robosense absolute doubles, Livox-like microseconds; NaN and zeros are no points."""
    stamp = 1_700_000_000 * S
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 0.0], [-4.0, 5.0, -6.0]])
    since = np.array([0.0, 0.01, 0.02, 0.0875])
    time = (since + (stamp * 1e-9 if absolute else 0.0)) * unit
    found = decode_cloud(Message(points, time, name, kind, big), stamp, "one")
    np.testing.assert_allclose(found.points_m, points[[0, 3]])
    np.testing.assert_allclose((found.stamps_ns - stamp) * 1e-9, since[[0, 3]], atol=1e-6)


def test_broken_clouds_say_so() -> None:
    good = Message(np.ones((5, 3)), np.zeros(5), "time", 7)
    good.data = good.data[:-10]
    with pytest.raises(ValueError, match="5 points with 130 bytes"):
        decode_cloud(good, 0, "one")
    good.fields = good.fields[1:]
    with pytest.raises(ValueError, match="without x, y, z"):
        decode_cloud(good, 0, "one")


def test_a_scan_is_straightened_and_levelled() -> None:
    """A wall 20 m north, seen from a vessel that moves, turns and rolls during the scan, by a tilted LiDAR."""
    t = np.linspace(0.0, 1.0, 101)
    roll, yaw = 0.1 * np.sin(6.0 * t), 0.5 + 0.3 * t
    p = np.column_stack([3.0 * t, 1.0 * t, 0.2 * np.sin(3.0 * t)])

    def rotation(r: float, y: float) -> Array:
        cr, sr, cy, sy = np.cos(r), np.sin(r), np.cos(y), np.sin(y)
        return np.asarray(
            np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        )

    R = np.stack([rotation(a, b) for a, b in zip(roll, yaw, strict=True)])
    track = Trajectory(stamps_ns=(t * S).astype(np.int64), p_world_m=p, R_world_body=R)
    mount = (np.array([1.0, 0.5, 2.0]), rotation(0.4, -0.7))
    seen = np.arange(20, 80)
    wall = np.column_stack([np.linspace(-10.0, 10.0, 60), np.full(60, 20.0), np.linspace(0.5, 2.5, 60)])
    in_body = np.einsum("nji,nj->ni", R[seen], wall - p[seen])
    in_lidar = (in_body - mount[0]) @ mount[1]
    cloud = Cloud("one", int(0.2 * S), in_lidar, (t[seen] * S).astype(np.int64))
    found = level([cloud], {"one": mount}, track, int(0.5 * S), waterline_m=-0.3)
    c, s = np.cos(yaw[50]), np.sin(yaw[50])
    back = found.points_m[:, :2] @ np.array([[c, s], [-s, c]]) + p[50, :2]
    np.testing.assert_allclose(back, wall[:, :2], atol=0.03)
    np.testing.assert_allclose(found.points_m[:, 2] - (0.3 - p[50, 2]), wall[:, 2], atol=0.03)
    with pytest.raises(InputError, match="does not cover"):
        level([cloud], {"one": mount}, track, 5 * S, 0.0)


def test_an_outline_holds_faces_and_shores_and_not_the_vessel() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(-25.0, 25.0, 20000)
    wall = np.column_stack([along, np.full(20000, 12.0), rng.uniform(0.35, 1.9, 20000)])
    deck = np.column_stack([rng.uniform(-25.0, 25.0, 5000), rng.uniform(12.0, 20.0, 5000), np.full(5000, 1.9)])
    own = np.column_stack([rng.uniform(-4.0, 4.0, 3000), rng.uniform(-1.0, 1.0, 3000), rng.uniform(0.4, 2.0, 3000)])
    sea = np.column_stack([rng.uniform(-20.0, 20.0, 2000), rng.uniform(-20.0, 10.0, 2000), rng.normal(0.0, 0.05, 2000)])
    points = np.vstack([wall, deck, own, sea])
    hull = np.array([(-5.0, -1.5), (5.0, -1.5), (5.0, 1.5), (-5.0, 1.5)])
    found = outline(LevelCloud(points, np.zeros((len(points), 2))), hull)
    assert np.abs(found.faces_m[:, 1] - 12.0).max() < 0.15
    assert len(found.faces_m) > 150
    assert np.abs(np.sin(found.line_rad)).mean() < 0.1
    np.testing.assert_allclose(found.face_share, 1.0 / np.sqrt(len(found.faces_m)), rtol=0.02)  # one line: a root of it
    assert found.tall.max() == 0.0  # 1.9 m: a boat's height
    assert np.abs(found.shore_m[:, 1] - 12.0).max() < 0.5
    assert np.sin(found.to_land_rad).min() > 0.3
    assert np.quantile(found.water_m[:, 1], 0.99) < 11.0
    assert inside(hull, np.array([(0.0, 0.0), (4.9, 1.4), (5.1, 0.0), (0.0, -1.6)])).tolist() == [
        True,
        True,
        False,
        False,
    ]
    nothing = outline(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), hull)
    assert len(nothing.faces_m) == len(nothing.shore_m) == 0


def test_layers_know_directions() -> None:
    """A bright square on dark water: its edges by direction, its shores by the side that land is on."""
    image = np.full((320, 320, 3), (38, 62, 72), dtype=np.uint8)
    image[80:240, 80:240] = (180, 176, 170)
    fine = Patch(image, np.ones((320, 320), dtype=bool), 0.0, 0.0, 0.125)
    found = find_edges(fine)
    edges = edge_layer(fine, found)
    flat, upright = 0, EDGE_BINS // 2  # east-west; north-south
    assert edges[flat, 39:41, 80].max() > 0.8
    assert edges[upright, 39:41, 80].max() < 0.1
    assert edges[upright, 80, 39:41].max() > 0.8
    coarse = coarse_patch(fine)
    assert coarse.pixels.shape == (160, 160, 3)
    np.testing.assert_allclose([coarse.west_m, coarse.north_m, coarse.cell_m], [0.0625, -0.0625, 0.25])
    free = np.zeros((160, 160), dtype=bool)
    free[5:30, 5:150] = True
    water = segment_water(coarse, free)
    assert water[2:36, 2:158].all()
    assert not water[44:116, 44:116].any()
    shores = shore_layer(fine, found, water)
    north, east = SHORE_BINS // 4, 0  # land lies that way
    assert shores[north, 119:122, 80].max() > 0.8  # south side of the square
    assert shores[north, 40, 80] < 0.2
    assert shores[east, 80, 38:41].max() > 0.8  # its west side
    assert shores[east, 80, 120] < 0.2
    assert not segment_water(coarse, np.zeros_like(free)).any()


@pytest.mark.parametrize("kerb_m", [0.0, 0.375])
def test_a_wall_lies_where_its_edge_is(kerb_m: float) -> None:
    """Water north of a wall at north = -10.0 m, with and without a bright kerb: the layers lie there."""
    cell, n = 0.125, 240
    image = np.full((n, n, 3), (38, 62, 72), dtype=np.uint8)
    image[80:] = (150, 147, 140)  # row 80 begins 80 cells under the top, which is 0.5 cells over the first centre
    image[80 : 80 + round(kerb_m / cell)] = (220, 220, 215)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), dtype=np.uint8)
    fine = Patch(image, np.ones((n, n), dtype=bool), 0.0, -0.5 * cell, cell)
    free = np.zeros((n // 2, n // 2), dtype=bool)
    free[5:20, 5:-5] = True
    found = find_edges(fine)
    coarse = coarse_patch(fine)
    shores = shore_layer(fine, found, segment_water(coarse, free))
    profiles = [shores[SHORE_BINS * 3 // 4, :, 60]]
    if not kerb_m:  # the kerb's other side is an edge as well
        profiles.append(edge_layer(fine, found)[0, :, 60])
    for profile in profiles:
        near = int(profile.argmax()) + np.arange(-3, 4)
        north = coarse.north_m - coarse.cell_m * near
        assert (profile[near] @ north) / profile[near].sum() == pytest.approx(-10.0, abs=0.08)


def test_drawn_lines_are_edges_and_shores() -> None:
    """A line from (5, -10) to (25, -10), land to its south; one that does not say, slanting."""
    fine = Patch(np.zeros((240, 240, 3), np.uint8), np.ones((240, 240), dtype=bool), 0.0, 0.0, 0.125)
    segments = np.array([[(5.0, -10.0), (25.0, -10.0)], [(5.0, -28.0), (20.0, -13.0)]])
    edges, shores = drawn_layers(fine, VectorMap(segments, np.array([-np.pi / 2, np.nan])))
    coarse = coarse_patch(fine)
    column, row = np.rint(coarse.cells(np.array([[15.0, -10.0]]))[0]).astype(int)
    assert edges[0, row, column] > 0.7
    assert edges[EDGE_BINS // 2, row, column] < 0.05
    assert shores[SHORE_BINS * 3 // 4, row, column] > 0.7
    assert shores[SHORE_BINS // 4].max() == 0.0
    column, row = np.rint(coarse.cells(np.array([[12.5, -20.5]]))[0]).astype(int)
    assert edges[EDGE_BINS // 4, row - 1 : row + 2, column].max() > 0.7  # 45 deg
    assert shores[:, row - 3 : row + 4, column - 3 : column + 4].max() == 0.0


def grid(half: int = 20) -> Grid:
    return Grid(
        np.radians(0.5) * np.arange(-8, 9),
        0.25 * np.arange(half, -half - 1, -1, dtype=float),
        0.25 * np.arange(-half, half + 1, dtype=float),
    )


def volume(g: Grid, *peaks: tuple[float, Array, Array]) -> NDArray[np.float32]:
    """Log of a sum of Gaussians: share, mean (east, north, yaw), sigma."""
    h, n, e = np.meshgrid(g.yaw_rad, g.north_m, g.east_m, indexing="ij")
    total = np.full(h.shape, 1e-30)
    for share, mean, sigma in peaks:
        off2 = ((e - mean[0]) / sigma[0]) ** 2 + ((n - mean[1]) / sigma[1]) ** 2 + ((h - mean[2]) / sigma[2]) ** 2
        total += share / np.prod(sigma) * np.exp(-0.5 * off2)
    return np.asarray(np.log(total), dtype=np.float32)


def test_modes_are_those_of_the_posterior() -> None:
    g = grid()
    sigma = np.array([0.4, 0.3, np.radians(0.8)])
    one, two = np.array([1.1, -0.7, 0.01]), np.array([-2.6, 2.0, -0.02])
    (first, second), none = modes_of(volume(g, (0.7, one, sigma), (0.3, two, sigma)), g, -30.0, 0.1)
    np.testing.assert_allclose(first.pose, one, atol=0.03)
    np.testing.assert_allclose(second.pose, two, atol=0.03)
    assert first.probability == pytest.approx(0.9 * 0.7, rel=0.05)
    assert second.probability == pytest.approx(0.9 * 0.3, rel=0.05)
    assert none == pytest.approx(0.1, abs=0.03)
    np.testing.assert_allclose(np.sqrt(np.diagonal(first.cov)), sigma, rtol=0.15)
    # Along a quay nothing holds: a long ellipse.
    (ridge,), _ = modes_of(volume(g, (1.0, np.zeros(3), np.array([50.0, 0.2, np.radians(0.6)]))), g, -30.0, 0.0)
    assert np.sqrt(ridge.cov[0, 0]) > 2.5
    assert np.sqrt(ridge.cov[1, 1]) < 0.3
    # Where nothing stands out over chance there is no mode.
    chance = np.random.default_rng(0).normal(0.0, 0.3, (17, 41, 41)).astype(np.float32)
    found, none = modes_of(chance, g, 5.0, 0.0)
    assert not found
    assert none == pytest.approx(1.0)


def test_a_clean_scene_is_matched_to_a_cell(tmp_path: Path) -> None:
    """A pier with two corners in view, thought to be 1.7 m and 2 deg elsewhere; found to a cell of 0.25 m (C.2)."""
    picture(tmp_path / "a.tif", 32633, 0.2, np.array([-15.0, 10.0, 15.0, 60.0]))
    rng, true = np.random.default_rng(0), np.array([3.0, -4.0, np.radians(40.0)])
    t = rng.uniform(-1.0, 1.0, 30000)
    south = np.column_stack([15.0 * t, np.full(30000, 10.0), rng.uniform(0.0, 1.9, 30000)])
    west = np.column_stack([np.full(9000, -15.0), rng.uniform(10.0, 30.0, 9000), rng.uniform(0.0, 1.9, 9000)])
    sea = np.column_stack([rng.uniform(-40, 40, 3000), rng.uniform(-40, 5, 3000), np.zeros(3000)])
    c, s = np.cos(true[2]), np.sin(true[2])
    points = np.vstack([south, west, sea])
    points[:, :2] = (points[:, :2] - true[:2]) @ np.array([[c, -s], [s, c]])
    matcher = Matcher(AerialConfig(image="a.tif"), tmp_path, DATUM)
    prior = Prior(true + np.array([1.2, -1.2, np.radians(2.0)]), np.array([2.0, 2.0, np.radians(2.0)]))
    found = matcher.match(LevelCloud(points, np.zeros((len(points), 2))), prior)
    assert np.hypot(*(found.modes[0].pose[:2] - true[:2])) < 0.25
    assert abs(np.degrees(found.modes[0].pose[2] - true[2])) < 0.4
    fix = found.fix(5, "aerial")
    assert fix.none_probability == pytest.approx(found.none, abs=1e-6)
    empty = matcher.match(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), prior)
    assert not empty.modes
    assert empty.why_not == "a scan without a point outside the vessel"
    wet = matcher.match(LevelCloud(sea, np.zeros((len(sea), 2))), prior)
    assert wet.why_not == "a scan of water alone"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aerial") / "sim"
    write_bag(simulate(find_scenario("bl1-drift", {"pose_hz": "0", "duration_s": "40"}), 3), folder, ros=2)
    return folder


def test_from_a_bag_to_the_graph(bag: Path, tmp_path: Path) -> None:
    """Scans become matches of the second smoothing; the image's offset is estimated; the ledger adds up."""
    recording, vessel = app.load([bag / "run"], bag / "vessel.yaml")
    scans = app.Scans((bag / "run",), bag)
    run = app.smooth_recording(recording, vessel, scans=scans)
    counts = run.solution.ledger.counts()
    matches = sum(counts["aerial"].values())
    assert 25 <= matches <= 39  # one a second, none where the vessel has moved less than half a metre
    assert counts["aerial"]["used"] > 0.9 * matches
    assert sum(sum(c.values()) for c in counts.values()) == recording.message_count + matches
    assert 1 <= len(run.pictures) <= 3
    assert all(coded[:2] == b"\xff\xd8" and "aerial at " in said for said, coded in run.pictures)  # JPEG
    page = app.write(run, tmp_path / "out", inputs=[], command="", overwrite=False).read_text()
    assert page.count('src="data:image/jpeg;base64,') == len(run.pictures)
    assert [r.reason for r in run.recording.rows if r.topic == "/lidar_1/points"] == ["read by aerial"]
    assert "aerial" in run.solution.slow
    alone = app.smooth_recording(recording, vessel)
    assert recording.truth is not None
    with_it, without = (compare_to_truth(r.solution.trajectory, recording.truth).heading_rmse_deg for r in (run, alone))
    assert with_it < max(without, 0.3)


def test_one_match_is_drawn(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["match", str(bag / "run"), "-c", str(bag / "vessel.yaml"), "--at", "20", "-o", str(tmp_path / "m.png")]
    for code, said in ((0, "none of them"), (2, "exists already")):
        assert called(monkeypatch, *arguments) == code
        streams = capsys.readouterr()
        assert said in streams.out + streams.err
    drawn = np.asarray(cv2.imread(str(tmp_path / "m.png")))
    assert min(drawn.shape[:2]) > 500
    assert (np.abs(drawn.astype(int) - (60, 60, 255)).max(axis=2) < 3).sum() > 500  # its faces


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"lidars": {}}, "needs `lidars`"),
        ({"lidars": {"a": {"topic": "/imu/data"}}}, "holds no PointCloud2; such topics: /lidar_1/points"),
        ({"lidars": {"a": {"topic": "/lidar_1/points", "mount": {"tf_frame": "nowhere"}}}}, "no chain from 'base_link' to 'nowhere'"),
        ({"image": "none.tif"}, "not an image"),
    ],
)  # fmt: skip
def test_a_matcher_that_cannot_work_is_one_line(changes: dict[str, Any], said: str, bag: Path) -> None:
    recording, vessel = app.load([bag / "run"], bag / "vessel.yaml")
    sensor = AerialConfig.model_validate({**vessel.sensors["aerial"].model_dump(), **changes})
    vessel = vessel.model_copy(update={"sensors": {**vessel.sensors, "aerial": sensor}})
    with pytest.raises(InputError) as caught:
        app.smooth_recording(recording, vessel, scans=app.Scans((bag / "run",), bag))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_image_of_elsewhere_leaves_rows_in_the_ledger(bag: Path, tmp_path: Path) -> None:
    picture(tmp_path / "far.tif", 32633, 0.5, np.array([40.0, -60.0, 60.0, -30.0]))
    recording, vessel = app.load([bag / "run"], bag / "vessel.yaml")
    sensor = vessel.sensors["aerial"].model_copy(update={"image": str(tmp_path / "far.tif")})
    vessel = vessel.model_copy(update={"sensors": {**vessel.sensors, "aerial": sensor}})
    short = replace(recording, truth=None)
    run = app.smooth_recording(short, vessel, scans=app.Scans((bag / "run",), bag))
    assert set(run.solution.ledger.counts()["aerial"]) == {"rejected"}
    assert run.solution.ledger.counts()["aerial"]["rejected"] > 25
    assert any("does not cover" in row.reason for row in run.solution.ledger if row.sensor == "aerial")


def aerial(bag: Path, **changes: Any) -> tuple[AerialConfig, Trajectory]:
    """The aerial sensor of the bag, changed, and the true track, as sure as a smoother would be."""
    recording, vessel = app.load([bag / "run"], bag / "vessel.yaml")
    truth = recording.truth
    assert truth is not None
    cov = np.broadcast_to(np.diag([1.0, 1.0, 0.1, 1e-4, 1e-4, 1e-3]), (len(truth), 6, 6))
    sensor = AerialConfig.model_validate({**vessel.sensors["aerial"].model_dump(), **changes})
    return sensor, replace(truth, cov=cov)


def matched(bag: Path, track: Trajectory, sensor: AerialConfig, **more: Any) -> list[Matched]:
    datum = app.choose_datum(*app.load([bag / "run"], bag / "vessel.yaml"))
    return list(match_bag([bag / "run"], sensor, bag, "base_link", track, datum, **more))


def test_matches_are_spent_where_they_inform(bag: Path) -> None:
    sensor, track = aerial(bag, every_m=6.0, still_s=1000.0)
    stamps = np.array([m.stamp_ns for m in matched(bag, track, sensor)])
    way = np.diff(track.at(stamps).p_world_m[:, :2], axis=0)
    assert 4 <= len(stamps) < 15
    assert np.hypot(*way.T).min() > 5.0  # from the end of a scan, stamped at its middle
    # The same scans, were the vessel lying still.
    moored = replace(track, p_world_m=np.zeros_like(track.p_world_m) + track.p_world_m[0])
    assert [len(matched(bag, moored, aerial(bag, every_m=6.0, still_s=s)[0])) for s in (10.0, 1000.0)] == [4, 1]


def test_scans_are_laid_together(bag: Path) -> None:
    """Five scans of a moving vessel show more places than one, and at the same pose."""
    poses, faces = [], []
    for submap in (1, 5):
        sensor, track = aerial(bag, submap=submap)
        at_ns = int(track.stamps_ns[0]) + 25 * S
        (item,) = matched(bag, track, sensor, at_ns=at_ns)
        assert item.match is not None
        poses.append(item.match.modes[0].pose)
        faces.append(len(item.match.found.faces_m))
    assert faces[1] > 1.15 * faces[0]
    assert np.hypot(*(poses[1] - poses[0])[:2]) < 0.3
    assert np.degrees(abs(poses[1][2] - poses[0][2])) < 0.5


def test_lines_alone_and_bl_can_be_matched_to(bag: Path, tmp_path: Path) -> None:
    """What stands still in the harbour, drawn as GeoJSON, without an image; and BL's matcher on the image."""
    harbour = load_harbour("marina")
    features = []
    for kind, tag in (("quays", "quay"), ("pontoons", "pier"), ("buildings", "pier")):
        for polygon, _ in getattr(harbour, kind):
            ring = np.array(polygon.exterior.coords)
            geodetic = harbour.datum.geodetic_from_enu(np.column_stack([ring, np.zeros(len(ring))]))
            shape = {"type": "Polygon", "coordinates": [geodetic[:, [1, 0]].tolist()]}
            features.append({"type": "Feature", "properties": {"man_made": tag}, "geometry": shape})
    (tmp_path / "quays.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    shift = np.array(json.loads((bag / "truth.json").read_text())["image_shows_things_east_north_m"])
    for changes, off in (
        ({"image": "", "vector": str(tmp_path / "quays.geojson")}, np.zeros(2)),
        ({"matcher": "bl"}, shift),
    ):
        sensor, track = aerial(bag, **changes)
        (item,) = matched(bag, track, sensor, at_ns=int(track.stamps_ns[0]) + 10 * S)
        assert item.match is not None
        true = track.at(np.array([item.stamp_ns])).p_world_m[0, :2] + off
        assert np.hypot(*(item.match.modes[0].pose[:2] - true)) < 0.25


def test_a_broken_scan_is_a_row_of_the_ledger(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, count = scans.decode_cloud, iter(range(10**6))

    def sometimes(msg: Any, stamp_ns: int, lidar: str) -> Cloud:
        if next(count) == 52:
            raise ValueError("a cloud of 5 points with 3 bytes")
        return whole(msg, stamp_ns, lidar)

    monkeypatch.setattr(scans, "decode_cloud", sometimes)
    sensor, track = aerial(bag, every_m=30.0)
    said = [m.why_not for m in matched(bag, track, sensor) if m.match is None]
    assert len(said) == 1
    assert "points: a cloud of 5 points with 3 bytes" in said[0]


def test_an_image_of_water_alone_gives_nothing(bag: Path, tmp_path: Path) -> None:
    with rasterio.open(bag / "aerial.tif") as source:
        profile, shape = source.profile, source.read().shape
    noise = np.random.default_rng(0).normal(0.0, 3.0, shape)
    with rasterio.open(tmp_path / "sea.tif", "w", **profile) as target:
        target.write(np.clip(np.array([38, 62, 72])[:, None, None] + noise, 0, 255).astype(np.uint8))
    sensor, track = aerial(bag, image=str(tmp_path / "sea.tif"), every_m=30.0)
    found = matched(bag, track, sensor)
    assert found
    assert {m.why_not for m in found} == {"no pose in the window stands out"}


def test_a_sensor_without_a_map_is_one_line(bag: Path) -> None:
    sensor, track = aerial(bag, image="")
    with pytest.raises(InputError, match="needs an `image`, a `vector` layer, or both"):
        matched(bag, track, sensor)
    sensor, track = aerial(bag, image="", vector="x.geojson", matcher="bl")
    with pytest.raises(InputError, match="matcher: bl needs an `image`"):
        matched(bag, track, sensor)


def test_inspect_drafts_the_lidars(bag: Path, tmp_path: Path) -> None:
    """The draft works as it stands: the LiDARs with the mounts that /tf_static knows, switched off for want of a map."""
    found = inspect_bag(bag / "run")
    assert [(x.topic, x.tf_frame) for x in found.lidars] == [(f"/lidar_{k}/points", f"lidar_{k}") for k in range(1, 6)]
    (tmp_path / "vessel.yaml").write_text(draft_config(found))
    _, vessel = app.load([bag / "run"], tmp_path / "vessel.yaml")
    sensor = vessel.sensors["aerial"]
    assert not sensor.enabled
    assert [(x.topic, x.mount.tf_frame) for x in sensor.lidars.values()] == [
        (x.topic, x.tf_frame) for x in found.lidars
    ]


def test_matches_near_each_other_tell_less(bag: Path) -> None:
    """Of a first-order Markov process along the way, r = exp(-way / 15 m), a next one tells (1 - r) / (1 + r) of a mean;
    of a place that inertial sensors carry for 5 s, of a heading for 60 s."""
    sensor, track = aerial(bag, every_m=0.0, every_s=3.0)
    found = [m for m in matched(bag, track, sensor) if m.match is not None and m.match.modes]
    at = np.array([m.match.prior.pose[:2] for m in found if m.match is not None])
    way = np.hypot(*np.diff(at, axis=0).T) / 15.0
    waited_s = np.diff([m.stamp_ns for m in found]) * 1e-9
    for axis, carried_s in ((0, 5.0), (1, 5.0), (2, 60.0)):
        r = np.exp(-np.maximum(way, waited_s / carried_s))
        np.testing.assert_allclose([m.news[axis] for m in found], [1.0, *((1.0 - r) / (1.0 + r))], rtol=1e-6)
    first, second = found[0].match, found[1].match
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(first.fix(0, "a", found[0].news).modes[0].cov, first.modes[0].cov)
    np.testing.assert_allclose(
        np.diagonal(second.fix(0, "a", found[1].news).modes[0].cov) * found[1].news, np.diagonal(second.modes[0].cov)
    )


def test_lines_elsewhere_change_nothing(bag: Path, tmp_path: Path) -> None:
    """One drawn line 130 m away: the image is matched as if it were not there."""
    datum = Datum(load_harbour("marina").config.datum.geodetic)
    ends = datum.geodetic_from_enu(np.array([(-20.0, 130.0, 0.0), (0.0, 130.0, 0.0)]))
    line = {"type": "LineString", "coordinates": ends[:, [1, 0]].tolist()}
    (tmp_path / "line.geojson").write_text(json.dumps(line))
    poses = []
    for vector in ("", str(tmp_path / "line.geojson")):
        sensor, track = aerial(bag, vector=vector)
        (item,) = matched(bag, track, sensor, at_ns=int(track.stamps_ns[0]) + 20 * S)
        assert item.match is not None
        poses.append(item.match.modes[0].pose)
    # Layers are kept in 255 parts of the largest weight, which is another one with lines.
    np.testing.assert_allclose(poses[0][:2], poses[1][:2], atol=0.03)


def test_a_prior_that_misses_is_not_followed(bag: Path) -> None:
    """8 and 20 m beside the truth, and said to be off by 10 m: the window may miss, so nothing in it is sure."""
    sensor, track = aerial(bag, every_m=6.0)
    for off in (8.0, 20.0):
        moved = replace(
            track, p_world_m=track.p_world_m + np.array([0.6 * off, 0.8 * off, 0.0]), cov=100.0 * np.asarray(track.cov)
        )  # fmt: skip
        claims = [m.match.modes[0].probability for m in matched(bag, moved, sensor) if m.match and m.match.modes]
        assert max(claims, default=0.0) < 0.6
    claims = [m.match.modes[0].probability for m in matched(bag, track, sensor) if m.match and m.match.modes]
    assert min(claims) > 0.8


def test_a_slope_at_the_windows_edge_is_no_mode() -> None:
    """The top lies 0.7 m beyond the edge at 5 m: what is in view of it is no pose. A ridge that runs out is one."""
    g = grid()
    sigma = np.array([0.3, 0.3, np.radians(0.8)])
    found, none = modes_of(volume(g, (1.0, np.array([5.7, 0.0, 0.0]), sigma)), g, -30.0, 0.1)
    assert not found
    assert none == pytest.approx(1.0)
    (ridge,), _ = modes_of(volume(g, (1.0, np.array([9.0, 0.02, 0.0]), np.array([20.0, 0.2, 0.01]))), g, -30.0, 0.0)
    assert np.sqrt(ridge.cov[0, 0]) > 2.5
    assert ridge.pose[1] == pytest.approx(0.02, abs=0.03)  # between cells where it is narrow


def test_one_stamp_of_the_future_costs_one_match(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, count = scans.decode_cloud, iter(range(10**6))

    def sometimes(msg: Any, stamp_ns: int, lidar: str) -> Cloud:
        return whole(msg, stamp_ns + (3600 * S if next(count) == 52 else 0), lidar)

    sensor, track = aerial(bag, every_m=0.0, still_s=0.5)
    usual = len(matched(bag, track, sensor))
    monkeypatch.setattr(scans, "decode_cloud", sometimes)
    found = matched(bag, track, sensor)
    (lost,) = [m.why_not for m in found if m.match is None]
    assert "outside of the track" in lost
    assert "lidar_3 +36" in lost
    assert len(found) - 1 >= usual - 1


def test_lidar_clocks_can_be_set_right(bag: Path) -> None:
    sensor, track = aerial(bag, every_m=6.0)
    later, _ = aerial(bag, every_m=6.0, time_offset_s=0.25)
    stamps, moved = (next(iter(matched(bag, track, s))).stamp_ns for s in (sensor, later))
    assert moved - stamps == 250_000_000


def test_turns_of_lidars_at_different_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    """One at 3 Hz, one at 1 Hz that falls silent: a turn as soon as there is one of each, else what there is."""
    fast = [(k / 3.0, "fast") for k in range(15)]
    slow = [(k + 0.1, "slow") for k in range(3)]

    class Heap:
        def messages(self, _topics: set[str]) -> list[RawMessage]:
            return [RawMessage(f"/{n}", CLOUD, b"", int(t * S), "") for t, n in sorted(fast + slow)]  # type: ignore[arg-type]

        def decode(self, raw: RawMessage) -> RawMessage:
            return raw

    monkeypatch.setattr(scans, "header_stamp_ns", lambda raw: raw.log_ns)
    monkeypatch.setattr(
        scans, "decode_cloud",
        lambda raw, stamp, name: Cloud(name, stamp, np.ones((1, 3)), np.array([stamp], dtype=np.int64)),
    )  # fmt: skip
    config = AerialConfig(lidars={n: LidarConfig(topic=f"/{n}") for n in ("fast", "slow")})
    turns = list(scans._turns(Heap(), config))  # type: ignore[arg-type]  # noqa: SLF001
    together = [t for t in turns if len(t.clouds) == 2]
    assert len(together) == 3
    assert max(abs(t.clouds[0].stamp_ns - t.clouds[1].stamp_ns) for t in together) < 0.4 * S
    assert turns[-1].stamp_ns > 4.5 * S  # the other one goes on alone


def test_some_axes_of_a_match() -> None:
    mode = Mode(np.array([1.0, 2.0, 0.3]), np.diag([0.1, 0.2, 0.01]), 0.9)
    match = Match(
        Prior(np.zeros(3), np.ones(3)), outline(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), None), modes=(mode,)
    )
    fix = match.fix(0, "a", (1.0, 0.5, 0.25), ("y", "yaw"))
    np.testing.assert_allclose(fix.modes[0].value, [2.0, 0.3])
    np.testing.assert_allclose(fix.modes[0].cov, np.diag([0.4, 0.04]))
    assert fix.axes == ("y", "yaw")


def test_sources_are_laid_over_each_other() -> None:
    """Where two show an edge the larger counts, not the sum; each by its own weight."""
    patch = Patch(np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), dtype=bool), 0.0, 0.0, 0.25)
    one, two = np.zeros((2, EDGE_BINS, 4, 4), dtype=np.float32)
    one[0, 0], two[0, 0, :2] = 1.0, 0.5
    layers = weighed(patch, [(one, None, Weights(0.8, 0.5, 1.0)), (two, None, Weights(0.7, 2.0, 1.0))], None)
    np.testing.assert_allclose(layers.unit * layers.low[0, 0], [0.8, 0.8, 0.8, 0.8], atol=0.5 * layers.unit)
    np.testing.assert_allclose(layers.unit * layers.tall[0, 0], [1.0, 1.0, 0.5, 0.5], atol=0.5 * layers.unit)
    assert layers.shores is None
