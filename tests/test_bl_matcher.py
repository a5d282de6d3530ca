# SPDX-License-Identifier: Apache-2.0
"""BL's own matcher (alg. 2 to 5), the baseline of ours, on scenes whose answer is known."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from graphloc.config import AerialConfig
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.aerial import Match, Prior, bl
from graphloc.frontends.aerial.bl import BLMatcher, _line, _swarm
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.scan import LevelCloud

DATUM = Datum(Geodetic(57.7, 14.5, 0.0))
PIXEL_M = 150.0 / 940.0
HALF_M, TIFF_M = 110.0, 0.2
PIERS = ((-15.0, 10.0, 15.0, 60.0), (22.0, 28.0, 47.0, 40.0), (-40.0, -55.0, -28.0, -20.0))  # west, south, east, north
HULL = ((-5.0, -1.5), (5.0, -1.5), (5.0, 1.5), (-5.0, 1.5))
TRUE = np.array([3.0, -4.0, np.radians(40.0)])


def picture(path: Path, boxes: tuple[tuple[float, ...], ...], noise: float = 3.0) -> AerialImage:
    """Bright boxes on dark water, on a grid that is world itself: transverse Mercator through the datum."""
    n = round(2.0 * HALF_M / TIFF_M)
    at = (np.arange(n) + 0.5) * TIFF_M - HALF_M
    east, north = np.meshgrid(at, -at)
    grey = 50.0 + np.random.default_rng(1).normal(0.0, noise, (n, n))
    for w, s, e, top in boxes:
        grey[(east > w) & (east < e) & (north > s) & (north < top)] += 120.0
    crs = "+proj=tmerc +lat_0=57.7 +lon_0=14.5 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m"
    place = rasterio.Affine(TIFF_M, 0.0, -HALF_M, 0.0, -TIFF_M, HALF_M)
    profile = {"driver": "GTiff", "width": n, "height": n, "count": 3, "dtype": "uint8", "crs": crs, "transform": place}
    with rasterio.open(path, "w", **profile) as f:
        f.write(np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[None], 3, axis=0))
    return AerialImage(path, DATUM)


def walls(boxes: tuple[tuple[float, ...], ...], per_m: float = 120.0, sigma_m: float = 0.01) -> Array:
    """Points on the walls of boxes, in world, 0.4 to 1.9 m above the water."""
    rng = np.random.default_rng(2)
    found = []
    for w, s, e, n in boxes:
        for a, b in (((w, s), (e, s)), ((e, s), (e, n)), ((e, n), (w, n)), ((w, n), (w, s))):
            count = int(per_m * np.hypot(b[0] - a[0], b[1] - a[1]))
            on_it = np.array(a) + rng.random((count, 1)) * (np.array(b) - np.array(a))
            found.append(np.column_stack([on_it + rng.normal(0.0, sigma_m, on_it.shape), rng.uniform(0.4, 1.9, count)]))
    return np.vstack(found)


def cloud(points: Array) -> LevelCloud:
    return LevelCloud(points, np.zeros((len(points), 2)))


def seen_from(pose: Array, world: Array) -> Array:
    """Points in level: forward and port are the parts of the offset along and left of the yaw."""
    d = world[:, :2] - pose[:2]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.column_stack([d[:, 0] * c + d[:, 1] * s, -d[:, 0] * s + d[:, 1] * c, world[:, 2]])


def prior(pose: Array, east: float = 0.0, north: float = 0.0, yaw_deg: float = 0.0) -> Prior:
    return Prior(pose + np.array([east, north, np.radians(yaw_deg)]), np.array([2.0, 2.0, np.radians(2.0)]))


def off(found: Match, pose: Array) -> tuple[float, float]:
    """Distance, m, and turn, deg, of the mode from a pose."""
    (mode,) = found.modes
    turn = np.degrees(np.angle(np.exp(1j * (mode.pose[2] - pose[2]))))
    return float(np.hypot(*(mode.pose[:2] - pose[:2]))), float(abs(turn))


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> AerialImage:
    return picture(tmp_path_factory.mktemp("bl") / "a.tif", PIERS)


@pytest.fixture
def few_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what the swarm does not bear on: three turns near the prior's are tried, not sixty."""

    def look(objective: Callable[[float], float], rng: np.random.Generator) -> float:
        return float(min(rng.uniform(-0.3, 0.3, 3), key=objective))

    monkeypatch.setattr(bl, "_swarm", look)


def every_half_degree(objective: Callable[[float], float], _rng: np.random.Generator) -> float:
    """For the signs: the turns of a swarm at rest, a quarter as many as it looks at."""
    return float(min(np.arange(-4.0, 4.1, 0.5), key=objective))


@pytest.mark.parametrize(
    ("true", "east", "north", "yaw_deg", "look"),
    [
        (TRUE, 1.7, -2.3, 3.0, _swarm),
        (np.array([-8.0, -12.0, np.radians(-110.0)]), -3.1, 1.4, -4.0, every_half_degree),
        (np.array([5.0, -6.0, np.radians(181.0)]), 2.0, 2.0, 2.5, every_half_degree),  # said as -179 deg
    ],
)
def test_a_known_pose_is_found(
    true: Array,
    east: float,
    north: float,
    yaw_deg: float,
    look: Any,
    image: AerialImage,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both signs of all three; to two pixels and half a degree: Canny's edge is a pixel wide, and so is a line.

    Not of every seed: with 0 the swarm misses the first one by 12 m, which is what BL has a gate for.
    """
    monkeypatch.setattr(bl, "_swarm", look)
    start = prior(true, east, north, yaw_deg)
    found = BLMatcher(AerialConfig(), image, seed=1).match(cloud(seen_from(true, walls(PIERS))), start)
    away_m, turn_deg = off(found, true)
    assert away_m < 2.0 * PIXEL_M
    assert turn_deg < 0.5
    (mode,) = found.modes
    assert mode.probability == 1.0
    assert found.none == 0.0
    assert not found.why_not
    assert -np.pi < mode.pose[2] <= np.pi
    steps = (mode.pose[:2] - start.pose[:2]) / PIXEL_M  # no sub-pixel peak
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert found.fix(5, "aerial").none_probability == 0.0


@pytest.mark.usefixtures("few_looks")
def test_covariance_is_that_of_equation_3_33(image: AerialImage) -> None:
    """By the count of all points, water included: 288000 / (10 * 20000 + 1) = 1.44 m; 10 deg^2 is (3.162 deg)^2."""
    dry = seen_from(TRUE, walls(PIERS, per_m=10.0))
    wet = np.random.default_rng(0).uniform(-30.0, 30.0, (20000 - len(dry), 3)) * [1.0, 1.0, 0.0]
    found = BLMatcher(AerialConfig(), image).match(cloud(np.vstack([dry, wet])), prior(TRUE))
    expected = [1.44 - 7.2e-6, 1.44 - 7.2e-6, np.radians(np.sqrt(10.0))]
    np.testing.assert_allclose(found.modes[0].cov, np.diag(np.square(expected)), rtol=1e-6)


@pytest.mark.usefixtures("few_looks")
def test_a_seed_is_an_answer(image: AerialImage) -> None:
    at, start = cloud(seen_from(TRUE, walls(PIERS))), prior(TRUE, 1.0, 1.0)
    first, again, other = (BLMatcher(AerialConfig(), image, seed=s).match(at, start).modes[0].pose for s in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert first[2] != other[2]  # by chance they never look at the same angles


@pytest.mark.usefixtures("few_looks")
def test_own_points_and_water_are_not_seen(image: AerialImage) -> None:
    """More of both than of walls, so dense that they would be the most frequent; the answer is the same to a bit."""
    rng = np.random.default_rng(3)
    own = rng.uniform((-4.9, -1.4, 0.35), (4.9, 1.4, 2.0), (60000, 3))
    wet = np.column_stack([rng.choice([20.0, -25.0], 60000), rng.uniform(-30.0, 30.0, 60000), np.full(60000, 0.29)])
    clean = seen_from(TRUE, walls(PIERS))
    start = prior(TRUE, -1.5, 2.0)
    config = AerialConfig(hull_m=HULL)
    everything = np.vstack([clean, own, wet, np.full((10, 3), [np.nan, 9.0, 1.0])])
    alone, among = (BLMatcher(config, image).match(cloud(p), start).modes[0].pose for p in (clean, everything))
    np.testing.assert_array_equal(alone, among)


def one_line(pixels: int) -> LevelCloud:
    """A line of so many pixels, in one cell of the grid wherever its borders are a multiple of 47 from the corner."""
    at = (np.arange(pixels) + 1.0) * PIXEL_M  # the prior is at the corner of pixel 470 = 10 * 47
    return cloud(np.column_stack([at + 0.5 * PIXEL_M, np.full(pixels, 0.5 * PIXEL_M), np.full(pixels, 1.0)]))


@pytest.mark.usefixtures("few_looks")
def test_nothing_to_match_says_why(image: AerialImage, tmp_path: Path) -> None:
    matcher, start = BLMatcher(AerialConfig(), image), prior(np.zeros(3))
    wall = seen_from(np.zeros(3), walls(PIERS))
    low, high = wall.copy(), wall.copy()
    low[:, 2], high[:, 2] = 0.29, 0.31
    nothing = cloud(np.zeros((0, 3)))
    for empty in (
        nothing,
        cloud(np.full((50, 3), np.nan)),
        cloud(low),
        cloud(wall + np.array([200.0, 0.0, 0.0])),
        one_line(15),
    ):
        found = matcher.match(empty, start)
        assert not found.modes
        assert found.none == 1.0
        assert "dry points" in found.why_not
    assert matcher.match(cloud(high), start).modes
    assert matcher.match(one_line(16), start).modes
    dull = picture(tmp_path / "dull.tif", (), noise=0.0)
    found = BLMatcher(AerialConfig(), dull).match(cloud(wall), start)
    assert found.why_not == "the image has no edge around the prior"
    assert not found.modes


@pytest.mark.usefixtures("few_looks")
def test_the_shift_has_no_bound_and_does_not_wrap(tmp_path: Path) -> None:
    """A hut 56 m west, seen 56 m east: 112 m apart, which would be 38 m the other way on an image that wraps."""
    hut = (-64.0, -6.0, -48.0, 5.0)
    image = picture(tmp_path / "hut.tif", (hut,))
    seen = walls((hut,)) + np.array([112.0, 0.0, 0.0])
    found = BLMatcher(AerialConfig(), image).match(cloud(seen), prior(np.zeros(3)))
    np.testing.assert_allclose(found.modes[0].pose[:2], [-112.0, 0.0], atol=1.0)


@pytest.mark.usefixtures("few_looks")
def test_only_the_most_frequent_places_count(image: AerialImage) -> None:
    """Fuzzy walls fill 3000 pixels, several points in each; 30 000 others, one point in each, change nothing."""
    fuzzy = walls(PIERS, per_m=400.0, sigma_m=0.15)
    east, north = np.meshgrid(-60.0 + PIXEL_M * np.arange(90), 5.0 + PIXEL_M * np.arange(340))
    grass = np.column_stack([east.ravel(), north.ravel(), np.full(east.size, 1.0)])
    at = np.array([3.0, -4.0, 0.0])
    clouds = [cloud(seen_from(at, p)) for p in (fuzzy, np.vstack([grass, fuzzy]))]
    alone, among = (BLMatcher(AerialConfig(), image, seed=1).match(c, prior(at)).modes[0].pose for c in clouds)
    np.testing.assert_array_equal(alone, among)


@pytest.mark.usefixtures("few_looks")
def test_an_image_is_kept_for_5_m(image: AerialImage, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a scan is laid where the prior is, not where the image was loaded."""
    loaded: list[tuple[float, float, float, float]] = []
    real = AerialImage.patch

    def patch(self: AerialImage, centre_m: Array, half_m: float, cell_m: float) -> Any:
        loaded.append((*centre_m.tolist(), half_m, cell_m))
        return real(self, centre_m, half_m, cell_m)

    monkeypatch.setattr(AerialImage, "patch", patch)
    matcher = BLMatcher(AerialConfig(), image)
    for north in (0.0, -4.9, -5.1, -0.2):
        true = TRUE + np.array([0.0, north, 0.0])
        away_m, _ = off(matcher.match(cloud(seen_from(true, walls(PIERS))), prior(true)), true)
        assert away_m < 2.0 * PIXEL_M
    np.testing.assert_allclose(loaded, [(3.0, -4.0, 75.0, PIXEL_M), (3.0, -9.1, 75.0, PIXEL_M)], atol=1e-9)


def test_a_line_is_fitted_past_outliers() -> None:
    """30 pixels of y = 10 + x / 3, and 20 far from it: its pixels from end to end, none of the others."""
    x = np.arange(30)
    on_it = np.column_stack([x, np.rint(10.0 + x / 3.0)]).astype(np.int64)
    rng = np.random.default_rng(0)
    stray = np.column_stack([rng.integers(0, 30, 20), rng.integers(26, 46, 20)])
    found = _line(np.vstack([stray, on_it]), rng)
    assert np.abs(found[:, 1] - (10.0 + found[:, 0] / 3.0)).max() < 1.0
    assert (found[:, 0].min(), found[:, 0].max()) == (0, 29)
    assert np.abs(np.diff(found, axis=0)).max() == 1  # no hole


def test_the_swarm_is_that_of_algorithm_1() -> None:
    """10 particles, 6 times; none moves by more than 1 deg at once; it ends near the least of what it may reach."""
    for seed in range(20):
        seen: list[float] = []

        def objective(deg: float, seen: list[float] = seen) -> float:
            seen.append(deg)
            return (deg - 2.3) ** 2

        found = _swarm(objective, np.random.default_rng(seed))
        paths = np.reshape(seen, (6, 10))
        assert found == _swarm(lambda deg: (deg - 2.3) ** 2, np.random.default_rng(seed))
        assert np.abs(paths[0]).max() <= 5.0
        assert np.ptp(paths[0]) > 4.0
        assert np.abs(np.diff(paths, axis=0)).max() == pytest.approx(1.0)
        assert abs(found - 2.3) == np.abs(np.array(seen) - 2.3).min()
        assert abs(found - 2.3) < 0.6
        assert np.abs(paths[-1] - 2.3).mean() < 0.7 * np.abs(paths[0] - 2.3).mean()
