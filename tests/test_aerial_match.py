# SPDX-License-Identifier: Apache-2.0
"""Scans laid on an aerial image: georeference, clouds, layers, posterior."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc.config import AerialConfig
from graphloc.errors import InputError
from graphloc.eval.match_picture import drawn
from graphloc.frames import Array
from graphloc.frontends.aerial import Match, Matcher, Prior
from graphloc.frontends.aerial import matcher as matcher_
from graphloc.frontends.aerial.cloud import Cloud, decode_cloud, level
from graphloc.frontends.aerial.image import AerialImage, Patch
from graphloc.frontends.aerial.layers import (
    EDGE_BINS,
    SHORE_BINS,
    Layers,
    Weights,
    coarse_patch,
    drawn_layers,
    edge_layer,
    find_edges,
    segment_water,
    shore_layer,
    weighed,
)
from graphloc.frontends.aerial.match import Mode, SearchGrid, modes_of
from graphloc.frontends.aerial.matcher import BELIEF, Belief, Since
from graphloc.frontends.aerial.scan import LevelCloud, Outline, inside, outline
from graphloc.frontends.aerial.vector import VectorMap
from graphloc.trajectory import Trajectory
from tests.bagfactory import S
from tests.mapfactory import DATUM, picture


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


def grid(half: int = 20) -> SearchGrid:
    return SearchGrid(
        np.radians(0.5) * np.arange(-8, 9),
        0.25 * np.arange(half, -half - 1, -1, dtype=float),
        0.25 * np.arange(-half, half + 1, dtype=float),
    )


def volume(g: SearchGrid, *peaks: tuple[float, Array, Array]) -> NDArray[np.float32]:
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


@pytest.mark.parametrize("turned_deg", [0.0, 31.0, 118.0])
def test_a_quay_without_an_end_in_view_says_nothing_along_itself(turned_deg: float) -> None:
    """How well the map shows its edge varies along it by some nats: of a canal that made places out of, with sigmas of 1 m, 4 m off."""
    g = grid(26)
    yaw, north, east = np.meshgrid(g.yaw_rad, g.north_m, g.east_m, indexing="ij")
    ahead = np.array([np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))])
    aside = np.array([-ahead[1], ahead[0]])
    along, across = (east * d[0] + north * d[1] for d in (ahead, aside))
    ridge = 25.0 - 0.5 * ((across - 0.4) / 0.25) ** 2 - 0.5 * ((yaw - 0.01) / np.radians(0.6)) ** 2
    uneven = (ridge + 2.5 * np.sin(along / 1.1 + 1.0)).astype(np.float32)
    (mode,), none = modes_of(uneven, g, 5.0, 0.05)
    assert none < 0.1
    assert mode.pose[:2] @ aside == pytest.approx(0.4, abs=0.05)
    assert mode.pose[2] == pytest.approx(0.01, abs=0.002)
    assert np.sqrt(ahead @ mode.cov[:2, :2] @ ahead) > 15.0
    assert np.sqrt(aside @ mode.cov[:2, :2] @ aside) < 0.35
    assert np.sqrt(mode.cov[2, 2]) < np.radians(1.0)
    # What rows of boats show has lines across it: which of them is which the score may tell.
    across_too = modes_of(uneven, g, 5.0, 0.05, normals=np.diag([0.5, 0.5]))[0]
    assert np.sqrt(ahead @ across_too[0].cov[:2, :2] @ ahead) < 5.0
    walls = 0.95 * np.outer(aside, aside) + 0.05 * np.outer(ahead, ahead)  # in body, which heads east
    (mode, *more), _ = modes_of(uneven, g, 5.0, 0.05, normals=walls)
    assert not more
    assert np.sqrt(ahead @ mode.cov[:2, :2] @ ahead) > 15.0
    # Where it ends is a place.
    end = np.maximum(ridge + 15.0 * np.exp(-0.5 * ((along - 1.5) / 0.4) ** 2), 0.0).astype(np.float32)
    (mode, *_), _ = modes_of(end, g, 5.0, 0.05)
    assert mode.pose[:2] @ ahead == pytest.approx(1.5, abs=0.1)
    assert np.sqrt(ahead @ mode.cov[:2, :2] @ ahead) < 0.5


def test_what_chance_makes_of_a_ridge_does_not_grow_beyond_what_was_measured() -> None:
    """A pole on a wall, 13 nats: in a window of 52 m chance was taken to make 18, and no place was left."""
    g = grid(104)
    yaw, north, east = np.meshgrid(g.yaw_rad, g.north_m, g.east_m, indexing="ij")
    wall = 25.0 - 0.5 * (north / 0.25) ** 2 - 0.5 * (yaw / np.radians(0.6)) ** 2
    pole = wall + 13.0 * np.exp(-0.5 * ((east - 3.0) / 0.4) ** 2)
    (mode, *_), _ = modes_of(pole.astype(np.float32), g, 5.0, 0.05, normals=np.diag([0.05, 0.95]))
    assert mode.pose[0] == pytest.approx(3.0, abs=0.1)
    assert np.sqrt(mode.cov[0, 0]) < 1.0


def test_normals_are_those_of_the_lines_in_view() -> None:
    """Of two walls along a canal, to its left and right at 31 deg; then with one across it, and of poles alone."""
    a = np.radians(31.0)
    ahead, aside = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
    t, up = np.meshgrid(np.arange(-40.0, 40.0, 0.1), np.arange(0.4, 1.6, 0.15))

    def seen(*walls: tuple[Array, Array]) -> Array:
        flat = np.vstack([np.column_stack([p + t.reshape(-1, 1) * d, up.ravel()]) for p, d in walls])
        return outline(LevelCloud(flat, np.zeros((len(flat), 2))), None).normals

    banks = [(13.0 * aside, ahead), (-13.0 * aside, ahead)]
    assert np.trace(seen(*banks)) == pytest.approx(1.0)
    assert ahead @ seen(*banks) @ ahead < 0.02
    assert ahead @ seen(*banks, (30.0 * ahead, aside)) @ ahead > 0.15
    poles = [(12.0 * (k - 3.0) * ahead + 5.0 * aside, np.zeros(2)) for k in range(7)]
    np.testing.assert_allclose(seen(*poles), 0.5 * np.eye(2), atol=0.1)


def test_a_wall_beside_the_window_is_no_ridge_of_it() -> None:
    """Its best line lies outside; of a wall that goes out of the window the best place may be at its face."""
    g = grid(26)
    yaw, north, east = np.meshgrid(g.yaw_rad, g.north_m, g.east_m, indexing="ij")
    aside = np.maximum(25.0 - 0.5 * ((north - 7.0) / 0.25) ** 2 - 0.5 * (yaw / np.radians(0.6)) ** 2, 0.0)
    assert not modes_of(aside.astype(np.float32), g, 5.0, 0.05)[0]
    out = np.maximum(25.0 - 0.5 * (north / 0.25) ** 2 - 0.5 * (yaw / np.radians(0.6)) ** 2 + 0.2 * east, 0.0)
    (mode,), _ = modes_of(out.astype(np.float32), g, 5.0, 0.05)
    assert abs(mode.pose[1]) < 0.05


def with_evidence(places: int, turns: int = 1) -> Outline:
    """Places on no common line: each is evidence of 1."""
    none = np.zeros(0)
    shore = np.zeros((places, 2))
    return Outline(
        np.zeros((0, 2)), none, none, none, shore, np.zeros(places), np.ones(places), shore, shore, turns=turns
    )


def test_little_evidence_is_believed_less() -> None:
    belief = Belief(enough=10.0, power=2.0, alike=0.5)
    for evidence, odds in ((10, 1.0), (20, 4.0), (5, 0.25)):
        assert belief.share(with_evidence(evidence)) == pytest.approx(odds / (1.0 + odds))
    assert belief.share(with_evidence(40, turns=16)) == pytest.approx(0.5)  # of one alone 10
    assert belief.share(replace(with_evidence(40, turns=16), own=with_evidence(20))) == pytest.approx(0.8)
    assert belief.share(replace(with_evidence(40, turns=16), own=with_evidence(5))) == pytest.approx(0.5)
    assert belief.share(with_evidence(0)) < 1e-6


@pytest.mark.parametrize(
    ("away_m", "yaw_deg", "east_m"), [(20.0, 0.0, 0.0), (90.0, 0.0, 0.0), (90.0, 45.0, 0.0), (90.0, 0.0, -100.0)]
)
def test_a_picture_shows_what_was_matched_however_far(away_m: float, yaw_deg: float, east_m: float) -> None:
    """Due east of the vessel, which may head elsewhere, and lie 20 m from the edge of what is known."""
    cells, g, yaw = np.zeros((960, 960, 3), np.uint8), grid(2), np.radians(yaw_deg)
    patch = Patch(cells, np.ones((960, 960), dtype=bool), -120.0, 120.0, 0.25)
    layers = Layers(patch, 1.0, cells[None, ..., 0], cells[None, ..., 0], None)
    found = replace(with_evidence(1), shore_m=away_m * np.array([(np.cos(yaw), -np.sin(yaw))]))
    match = Match(Prior(np.array([east_m, 0.0, yaw]), np.ones(3)), found, layers, g, np.zeros((17, 5, 5), np.float32))
    picture_ = drawn(match)
    size, around_m = len(picture_), max(60.0, 1.1 * away_m)
    image = picture_[:, : -(size // 2)]  # beside it: the score
    rows, columns = np.nonzero((image == (80, 255, 80)).all(axis=2))
    assert abs(rows.mean() - 0.5 * size) < 5.0  # north is up
    from_edge_m = min(around_m, 120.0 + east_m) + away_m
    assert columns.mean() == pytest.approx(0.5 * size * from_edge_m / around_m, rel=0.01)


def test_the_heading_may_be_told_where_the_place_is_not() -> None:
    modes = [(0.0, 179.0, 0.4), (4.0, -180.0, 0.3), (8.0, 170.0, 0.2)]
    match = Match(
        Prior(np.zeros(3), np.ones(3)),
        with_evidence(1),
        modes=tuple(Mode(np.array([x, 0.0, np.radians(yaw)]), np.eye(3), p) for x, yaw, p in modes),
    )
    assert match.of_heading == pytest.approx(0.7)
    assert replace(match, modes=()).of_heading == 0.0


def test_modes_are_less_decided_than_they_look() -> None:
    modes = [Mode(np.zeros(3), np.eye(3), p) for p in (0.64, 0.04)]
    assert [m.probability for m in Belief(decided=0.5).less_decided(modes)] == pytest.approx([0.544, 0.136])
    assert Belief().less_decided([]) == []


def test_a_clean_scene_is_matched_to_a_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    # The same evidence of a hundred places is less of it, and told so.
    known, less = found.found, matcher.match(LevelCloud(points, np.zeros((len(points), 2)), turns=100), prior)
    told, told_less = (BELIEF.share(f) for f in (known, less.found))
    assert told_less < 0.3
    assert told > 0.8
    assert (1.0 - less.none) / (1.0 - found.none) == pytest.approx(told_less / told)
    assert len(less.modes) == len(found.modes)
    empty = matcher.match(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), prior)
    assert not empty.modes
    assert empty.why_not == "a scan without a point outside the vessel"
    monkeypatch.setattr(matcher_, "modes_of", lambda *_: ([Mode(true, np.eye(3), p) for p in (0.64, 0.04)], 0.32))
    two = matcher.match(LevelCloud(points, np.zeros((len(points), 2))), prior)
    first, second = (m.probability for m in two.modes)
    assert np.log(first / second) == pytest.approx(BELIEF.decided * np.log(16.0))
    assert first + second == pytest.approx(0.68 * told)
    assert first + second + two.none == pytest.approx(1.0)
    monkeypatch.setattr(matcher_, "modes_of", modes_of)
    monkeypatch.setattr(matcher_, "BELIEF", Belief(enough=1e4))
    assert len(matcher.match(LevelCloud(points, np.zeros((len(points), 2))), prior).modes) == len(found.modes)
    wet = matcher.match(LevelCloud(sea, np.zeros((len(sea), 2))), prior)
    assert wet.why_not == "a scan of water alone"


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


def test_some_axes_of_a_match() -> None:
    mode = Mode(np.array([1.0, 2.0, 0.3]), np.diag([0.1, 0.2, 0.01]), 0.9)
    match = Match(
        Prior(np.zeros(3), np.ones(3)), outline(LevelCloud(np.zeros((0, 3)), np.zeros((0, 2))), None), modes=(mode,)
    )
    fix = match.fix(0, "a", Since(np.log(3.0), 0.0), ("y", "yaw"))  # half of it is independent: tanh(log(3) / 2)
    np.testing.assert_allclose(fix.modes[0].value, [2.0, 0.3])
    np.testing.assert_allclose(fix.modes[0].cov, np.diag([0.4, 0.02]))
    assert fix.news == pytest.approx(0.5)
    assert fix.modes[0].probability == pytest.approx(0.9)
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
