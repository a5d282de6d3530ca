"""A vessel seen from a berth, and the berths of a survey."""

from __future__ import annotations

import numpy as np
import pytest

from graphloc.berths import Berth, rates, seen_from
from graphloc.config import AprilTagConfig
from graphloc.factors.apriltag import berths
from graphloc.frames import Array
from graphloc.survey import Survey

STILL = np.zeros((1, 4))


def berth(facing_deg: float, point: tuple[float, float] = (0.0, 0.0), pivot: tuple[float, float] = (0.0, 0.0)) -> Berth:
    return Berth(name="b", point_m=np.array([*point, 1.0]), facing_deg=facing_deg, pivot_m=np.array([*pivot, 0.0]))


def seen(where: Berth, p: tuple[float, float], heading_deg: float, moved: Array = STILL) -> Array:
    yaw = np.array([np.radians(90.0 - heading_deg)])
    value, _ = seen_from(where, np.array([[*p, 0.0]]), yaw, moved)
    return np.asarray(value[0] * [1.0, 1.0, 180.0 / np.pi])


# Facing, place of the body, heading; across, along, angle: by hand. A quay that faces south is looked at from the south,
# looking north: right is east, and bow in is heading 0.
BY_HAND = [
    (180.0, (0.0, -5.0), 0.0, (5.0, 0.0, 0.0)),
    (180.0, (2.0, -5.0), 30.0, (5.0, 2.0, 30.0)),
    (180.0, (2.0, -5.0), 90.0, (5.0, 2.0, 90.0)),  # alongside, bow to the right
    (180.0, (-2.0, 1.0), 270.0, (-1.0, -2.0, -90.0)),  # behind the face
    (0.0, (3.0, 4.0), 180.0, (4.0, -3.0, 0.0)),  # looked at from the north: right is west
    (0.0, (3.0, 4.0), 0.0, (4.0, -3.0, 180.0)),  # stern in
    (90.0, (6.0, 1.0), 270.0, (6.0, 1.0, 0.0)),  # looked at from the east: right is north
    (90.0, (6.0, 1.0), 280.0, (6.0, 1.0, 10.0)),
    (270.0, (-6.0, 1.0), 90.0, (6.0, -1.0, 0.0)),  # looked at from the west: right is south
    (270.0, (-6.0, 1.0), 350.0, (6.0, -1.0, -100.0)),
    (225.0, (-np.sqrt(2.0), -np.sqrt(2.0)), 45.0, (2.0, 0.0, 0.0)),
    (225.0, (0.0, -np.sqrt(2.0)), 60.0, (1.0, 1.0, 15.0)),  # looking north-east, right is south-east
]


@pytest.mark.parametrize(("facing", "p", "heading", "expected"), BY_HAND)
def test_by_hand(facing: float, p: tuple[float, float], heading: float, expected: tuple[float, float, float]) -> None:
    found = seen(berth(facing), p, heading)
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-12)
    assert (found[2] - expected[2] + 180.0) % 360.0 == pytest.approx(180.0)
    assert -180.0 < found[2] <= 180.0
    shifted = seen(berth(facing, (10.0, -20.0)), (p[0] + 10.0, p[1] - 20.0), heading)
    np.testing.assert_allclose(shifted, found, atol=1e-9)


def test_a_berth_that_has_moved_is_nearer() -> None:
    """It faces south and came 0.3 m south, 0.1 m east: 0.3 m less across, and it lies 0.1 m less to the right."""
    found = seen(berth(180.0), (2.0, -5.0), 0.0, np.array([[0.1, -0.3, 9.0, 0.0]]))
    np.testing.assert_allclose(found, [4.7, 1.9, 0.0], atol=1e-12)


def test_a_berth_that_has_turned() -> None:
    """A quarter to port about (0, 10): the face at (0, 0) swings to (10, 10) and looks east; bow in is heading 270."""
    where = berth(180.0, pivot=(0.0, 10.0))
    found = seen(where, (13.0, 11.0), 270.0, np.array([[0.0, 0.0, 0.0, np.pi / 2.0]]))
    np.testing.assert_allclose(found, [3.0, 1.0, 0.0], atol=1e-9)


def test_vessel_and_berth_that_move_together_see_no_motion() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        pivot, p = rng.uniform(-20.0, 20.0, 2), rng.uniform(-30.0, 30.0, 2)
        where = berth(float(rng.uniform(0.0, 360.0)), (3.0, 4.0), (float(pivot[0]), float(pivot[1])))
        heading, turn, shift = rng.uniform(0.0, 360.0), rng.uniform(-1.0, 1.0), rng.normal(0.0, 1.0, 2)
        swing = np.array([(np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn))])
        there = pivot + swing @ (p - pivot) + shift
        before = seen(where, (p[0], p[1]), heading)
        moved = np.array([[*shift, 0.2, turn]])
        after = seen(where, (there[0], there[1]), heading - np.degrees(turn), moved)
        np.testing.assert_allclose(after[:2], before[:2], atol=1e-9)
        assert np.cos(np.radians(after[2] - before[2])) == pytest.approx(1.0)


def test_jacobian_is_the_numeric_one() -> None:
    rng = np.random.default_rng(1)
    where = berth(200.0, (3.0, 4.0), (-7.0, 9.0))
    for _ in range(20):
        x = np.concatenate([rng.uniform(-20.0, 20.0, 2), rng.uniform(-3.0, 3.0, 1), rng.normal(0.0, 0.5, 4)])

        def at(v: Array) -> tuple[Array, Array]:
            return seen_from(where, np.array([[v[0], v[1], 0.0]]), v[2:3], v[None, 3:])

        J = at(x)[1][0]
        for k in range(7):
            step = np.zeros(7)
            step[k] = 1e-6
            change = at(x + step)[0][0] - at(x - step)[0][0]
            change[2] = (change[2] + np.pi) % (2.0 * np.pi) - np.pi
            np.testing.assert_allclose(change / 2e-6, J[:, k], atol=1e-6)


def test_rates_across_the_wrap_and_of_a_single_stamp() -> None:
    t = np.array([0.0, 0.5, 1.0, 2.0])
    angle = (np.pi - 0.1 + 0.2 * t + np.pi) % (2.0 * np.pi) - np.pi
    value = np.column_stack([10.0 - 0.4 * t, 2.0 * t, angle])
    np.testing.assert_allclose(rates(value, t), np.tile([-0.4, 2.0, 0.2], (4, 1)), atol=1e-9)
    np.testing.assert_array_equal(rates(value[:1], t[:1]), np.zeros((1, 3)))


def surveyed(
    tags: list[tuple[str, list[float], float]], docks: list[object] | None = None, berths: list[object] | None = None
) -> AprilTagConfig:
    listed = [
        {"id": k, "size_m": 0.4, "frame": frame, "xyz_m": xyz, "facing_deg": facing}
        for k, (frame, xyz, facing) in enumerate(tags)
    ]
    return AprilTagConfig(survey=Survey.model_validate({"tags": listed, "docks": docks or [], "berths": berths or []}))


def test_a_frames_tags_make_a_berth() -> None:
    config = surveyed([("world", [0.0, 10.0, 1.0], 170.0), ("world", [4.0, 10.0, 2.0], 190.0)])
    (found,) = berths(config)
    assert (found.name, found.moves) == ("quay", None)
    np.testing.assert_allclose(found.point_m, [2.0, 10.0, 1.5])
    assert found.facing_deg % 360.0 == pytest.approx(180.0)


def test_a_docks_berth_is_turned_with_it() -> None:
    """The dock's axes are turned a quarter to port: what faces its y axis faces west, 3 m along its x is 3 m north."""
    dock = {"name": "pier", "xyz_m": [10.0, 20.0, 0.5], "rpy_deg": [0.0, 0.0, 90.0]}
    config = surveyed([("world", [0.0, 0.0, 1.0], 90.0), ("pier", [3.0, 0.0, 1.0], 0.0)], [dock])
    quay, pier = berths(config)
    assert (quay.name, quay.moves, pier.name, pier.moves) == ("quay", None, "pier", 0)
    np.testing.assert_allclose(pier.point_m, [10.0, 23.0, 1.5])
    assert pier.facing_deg % 360.0 == pytest.approx(270.0)
    np.testing.assert_allclose(pier.pivot_m, [10.0, 20.0, 0.5])


@pytest.mark.parametrize("facing", [(0.0, 180.0), (0.0, 120.0, 240.0), (0.0, 130.0)])
def test_tags_that_look_different_ways_make_no_berth(facing: tuple[float, ...]) -> None:
    assert berths(surveyed([("world", [0.0, float(k), 1.0], f) for k, f in enumerate(facing)])) == ()


def test_a_tag_that_looks_up_makes_no_berth() -> None:
    tag = {"id": 0, "size_m": 0.4, "xyz_m": [0, 0, 0], "rpy_deg": [0, 0, 0]}
    assert berths(AprilTagConfig(survey=Survey.model_validate({"tags": [tag]}))) == ()


def test_listed_berths_are_the_only_ones() -> None:
    dock = {"name": "pier", "xyz_m": [10.0, 20.0, 0.0], "rpy_deg": [0.0, 0.0, 90.0]}
    listed: list[object] = [{"name": "inner", "frame": "pier", "xyz_m": [0.0, 2.0, 0.3], "facing_deg": 90.0}]
    config = surveyed([("world", [0.0, 0.0, 1.0], 90.0), ("pier", [3.0, 0.0, 1.0], 0.0)], [dock], listed)
    (found,) = berths(config)
    assert (found.name, found.moves) == ("inner", 0)
    np.testing.assert_allclose(found.point_m, [8.0, 20.0, 0.3], atol=1e-9)  # 2 m along its y: 2 m west
    assert found.facing_deg % 360.0 == pytest.approx(0.0, abs=1e-9)  # along its x: north


def test_a_frame_that_was_not_seen_takes_its_listed_berth_with_it() -> None:
    """... and leaves none in its place: the quay's tags do not make one because the pier's was cut off."""
    listed: list[object] = [{"name": "inner", "frame": "pier", "xyz_m": [0.0, 0.0, 0.0], "facing_deg": 90.0}]
    config = surveyed([("world", [0.0, 0.0, 1.0], 90.0), ("pier", [3.0, 0.0, 1.0], 0.0)], [{"name": "pier"}], listed)
    cut = config.model_copy(update={"survey": config.surveyed.of({"world"})})
    assert berths(cut) == ()


def test_no_tags_no_berths() -> None:
    assert berths(AprilTagConfig()) == ()
