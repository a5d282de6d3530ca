# SPDX-License-Identifier: Apache-2.0
"""Points that stay with the vessel: her deck, and what only looks so."""

import numpy as np
import pytest

from graphloc.frames import Array
from graphloc.frontends.aerial.own import Staying
from graphloc.frontends.aerial.scan import LevelCloud, outline

MAST = np.array([-0.5, 0.0, 2.0])
DECK = np.array([(x, y, 1.0) for x in np.arange(-2.9, 3.0, 0.2) for y in (-1.2, 0.1, 1.3)])
QUAY = np.array([(x, 6.1, z) for x in np.arange(-20.0, 20.0, 0.2) for z in (0.5, 1.5)])  # that she goes along
HULL = np.array([(-3.2, -1.6), (3.2, -1.6), (3.2, 1.6), (-3.2, 1.6)])


def said(way_m: float, own: Array, hull: Array | None = None) -> list[str]:
    """What is said after 20 scans along a way, of posts 7 m apart on either side, and points in body."""
    staying = Staying([] if hull is None else [(x, y) for x, y in hull.tolist()], [MAST])
    for east in np.linspace(0.0, way_m, 20):
        posts = np.array([(7.0 * k - east, side, z) for k in range(-9, 9) for side in (-9.0, 2.1) for z in (0.5, 1.2)])
        points = np.vstack([own, posts])
        staying.take(outline(LevelCloud(points, np.tile(MAST[:2], (len(points), 1))), hull), np.array([east, 5.0]))
    return staying.said()


def test_the_vessel_herself_is_told_from_a_quay_that_she_goes_along() -> None:
    """Her cells of 0.5 m reach from -3 to 3 and from -1.5 to 1.5; the posts within her length pass by."""
    (line,) = said(40.0, np.vstack([DECK, QUAY]))
    assert line.startswith("hull_m is empty, and in 20 scans points stay with the vessel")
    assert line.endswith("at least hull_m: [[-3, -1.5], [3, -1.5], [3, 1.5], [-3, 1.5]]")


def test_points_under_the_water_tell_a_wrong_waterline() -> None:
    """Of a mast 2 m up whose mount was left at 0: water at -2 m. Waves, and mirror images of walls in calm water, are none."""
    water = np.array(
        [(x, y, 0.04 * np.sin(x + k)) for k, y in enumerate((-6.0, 5.0)) for x in np.arange(-9.0, 9.0, 0.05)]
    )
    mirrored = QUAY[: len(water) // 30] * (1.0, 1.0, -1.0) - (0.0, 0.0, 1.0)
    assert not said(0.0, np.vstack([DECK, water, mirrored]), HULL)
    (line,) = said(0.0, np.vstack([DECK, water, QUAY]) - (0.0, 0.0, 2.0), HULL)
    assert line.startswith("points lie 2.0 m under the water and deeper: waterline_m, or the height of a LiDAR's mount")


@pytest.mark.parametrize("way_m", [0.0, 15.0])
def test_nothing_is_known_of_a_vessel_that_hardly_moves(way_m: float) -> None:
    assert not said(way_m, DECK)


def test_what_stays_outside_of_the_hull() -> None:
    """Nothing of hers; water overhead, as a LiDAR has it that hangs upside down in the configuration alone."""
    assert not said(40.0, np.vstack([DECK, QUAY]), HULL)
    angle = np.linspace(0.0, 2.0 * np.pi, 90)
    ring = np.column_stack([4.0 * np.cos(angle) - 0.5, 4.0 * np.sin(angle), np.full(90, 4.0)])
    (line,) = said(40.0, np.vstack([DECK, ring]), HULL)
    assert "points outside hull_m stay with the vessel" in line
    assert "spray or rain" in line
    assert "upside down" in line


@pytest.mark.parametrize("hull", [None, HULL], ids=["no hull", "hull"])
def test_a_wall_close_by_may_be_what_stays(hull: Array | None) -> None:
    """Of a lock: it holds points in each place beside her in every scan, as she does."""
    wall = np.array([(x, 2.5, z) for x in np.arange(-20.0, 20.0, 0.2) for z in (0.5, 1.0)])
    (line,) = said(40.0, np.vstack([DECK, wall]), hull)
    assert "a wall that she went along" in line
