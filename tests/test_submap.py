"""What was seen from other places before a scan, matched together with it."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.config import AerialConfig
from graphloc.frames import Array
from graphloc.frontends.aerial.cloud import Cloud, level
from graphloc.frontends.aerial.scan import LevelCloud, outline
from graphloc.frontends.aerial.submap import Submap, Turn
from graphloc.trajectory import Trajectory

S = 10**9
AROUND_S = 15.0
AT_MOST_M = 3.0 * 1.1e-3  # at 3 m/s: poses are those of the middle of 2 ms
HULL_M = ((6.0, 2.0), (-6.0, 2.0), (-6.0, -2.0), (6.0, -2.0))
MOUNT = {"bow": (np.array([5.0, 0.0, 1.0]), np.diag([-1.0, -1.0, 1.0]))}  # looks astern


def turn_of(t_s: float, points_m: Array) -> Turn:
    stamp_ns = round(t_s * S)
    stamps_ns = np.full(len(points_m), stamp_ns, dtype=np.int64)
    return Turn(stamp_ns, stamp_ns, (Cloud("bow", stamp_ns, points_m, stamps_ns),))


def give(submap: Submap, turn: Turn, place_m: Array) -> None:
    submap.show(turn, place_m)
    submap.take(turn)


def ahead(length_s: int, speed_mps: float) -> Trajectory:
    t = np.arange(length_s + 1)
    place_m = np.column_stack([speed_mps * t, 0.0 * t, 0.0 * t])
    return Trajectory(stamps_ns=t * S, p_world_m=place_m, R_world_body=np.broadcast_to(np.eye(3), (len(t), 3, 3)))


def test_the_vessel_herself_does_not_trail_behind() -> None:
    """Her cabin, and a wall 20 m to port, which stays where it is while she passes."""
    cabin_m = np.array([(3.0, 1.0, 0.5), (9.0, -1.0, 0.5)])  # x of -2 and 4 in body
    submap = Submap(AerialConfig(hull_m=HULL_M), MOUNT, AROUND_S)
    for t in range(4):
        wall_m = np.array([(5.0 + 3.0 * t, -20.0, z) for z in (0.0, 1.0, 2.0)])  # at the origin of world
        give(submap, turn_of(t, np.vstack([cabin_m, wall_m])), np.array([3.0 * t, 0.0]))
    now, others = submap.clouds()
    seen = level(now, MOUNT, ahead(3, 3.0), 3 * S, 0.0, others)
    assert [len(c.points_m) for c in now] == [3]
    assert (seen.now, seen.turns) == (3, 4)
    assert outline(seen, None).turns == 4
    of_two_lidars = [[*clouds, *clouds] for clouds in others]
    assert level(now, MOUNT, ahead(3, 3.0), 3 * S, 0.0, of_two_lidars).turns == 4
    np.testing.assert_allclose(seen.points_m[:, :2], np.broadcast_to([-9.0, 20.0], (12, 2)), atol=AT_MOST_M)
    np.testing.assert_allclose(
        np.unique(seen.origin_m, axis=0), [(x, 0.0) for x in (-4.0, -1.0, 2.0, 5.0)], atol=AT_MOST_M
    )
    # A scan of the vessel alone is not matched by what was seen before.
    blind = outline(replace(seen, points_m=seen.points_m[3:], origin_m=seen.origin_m[3:], now=0), None)
    assert not len(blind.faces_m) + len(blind.shore_m) + len(blind.water_m)
    # What stays with the vessel is looked for in the scan itself, not in what another one showed.
    more_m = np.vstack([seen.points_m, (-9.0, 22.0, 1.0)])
    found = outline(replace(seen, points_m=more_m, origin_m=np.vstack([seen.origin_m, (0.0, 0.0)])), None)
    assert len(found.columns_m) == 1
    assert len(found.shore_m) == 2
    deep_m = more_m.copy()
    deep_m[3:, 2] = -9.0
    assert outline(replace(seen, points_m=deep_m, origin_m=np.zeros((13, 2))), None).lowest_m > 0.0


def test_a_mast_is_the_vessels_also_where_she_heels() -> None:
    """By 25 deg, the top of a mast of 12 m is 5 m beside a hull of 2 m; a post on the quay stays."""
    heel = Rotation.from_euler("x", 25.0, degrees=True).as_matrix()
    t, R = MOUNT["bow"]
    mast_m = np.array([(0.0, 0.0, z) for z in (2.0, 6.0, 12.0)])
    post_m = np.array([(1.0, 8.0, z) for z in (1.0, 2.0, 3.0)]) @ heel  # upright in world
    submap = Submap(AerialConfig(hull_m=HULL_M), MOUNT, AROUND_S)
    give(submap, turn_of(1, (np.vstack([mast_m, post_m]) - t) @ R), np.zeros(2))
    track = replace(ahead(2, 0.0), R_world_body=np.broadcast_to(heel, (3, 3, 3)))
    seen = level(submap.clouds()[0], MOUNT, track, S, 0.0)
    np.testing.assert_allclose(seen.points_m[:, :2], [(1.0, 8.0)] * 3, atol=1e-9)


def test_where_nothing_but_the_vessel_was_seen_is_no_place_of_others() -> None:
    cabin_m, wall_m = np.array([(3.0, 1.0, 0.5)]), np.array([(5.0, -20.0, 0.0)])
    submap = Submap(AerialConfig(hull_m=HULL_M), MOUNT, AROUND_S)
    for t, seen_m in enumerate((wall_m, cabin_m, np.zeros((0, 3)), wall_m)):
        give(submap, turn_of(t, seen_m), np.array([3.0 * t, 0.0]))
    assert stamps_s(submap) == [0]


def test_the_outline_of_the_scan_itself_is_beside_that_of_all() -> None:
    posts_m = np.array([(x, y, z) for x, y in ((10.0, 1.0), (1.0, 30.0)) for z in (0.5, 1.0, 1.5)])
    found = outline(LevelCloud(posts_m, np.zeros((6, 2)), now=3, turns=2), None)
    np.testing.assert_allclose(found.faces_m, [(1.0, 30.0), (10.0, 1.0)])
    assert found.own is not None
    np.testing.assert_allclose(found.own.faces_m, [(10.0, 1.0)])
    assert found.own.evidence == 2.0  # a face, and a first return
    assert found.evidence == 4.0
    assert found.own.own is None


def test_dense_scans_of_before_are_thinned() -> None:
    """To a constant number, and not to some of the beams, which take turns in a cloud."""
    rng = np.random.default_rng(1)
    dense_m = rng.uniform(-50.0, 50.0, (128_000, 3))
    dense_m[:, 2] = np.arange(128_000) % 64
    submap = Submap(AerialConfig(), MOUNT, AROUND_S)
    for t in range(3):
        give(submap, turn_of(t, dense_m), np.array([3.0 * t, 0.0]))
    now, others = submap.clouds()
    assert [len(c.points_m) for c in now] == [128_000]
    for (cloud,) in others:
        assert abs(len(cloud.points_m) - 20_000) < 100
        assert len(cloud.stamps_ns) == len(cloud.points_m)
        per_beam = np.bincount(cloud.points_m[:, 2].astype(int), minlength=64)
        assert per_beam.min() > 0.8 * per_beam.max()


def stamps_s(submap: Submap) -> list[float]:
    return [c.stamp_ns / S for (c,) in submap.clouds()[1]]


def test_a_clock_that_is_set_back_begins_anew() -> None:
    """By less than what is kept, too; not by a scan that arrives late."""
    submap = Submap(AerialConfig(), MOUNT, AROUND_S)
    for t in range(20, 31):
        give(submap, turn_of(t, np.ones((1, 3))), np.array([3.0 * t, 0.0]))
    assert stamps_s(submap) == list(range(20, 30))
    give(submap, turn_of(29, np.ones((1, 3))), np.array([87.0, 0.0]))
    assert stamps_s(submap) == [*range(20, 29), 30]
    for t in (24, 25):
        give(submap, turn_of(t, np.ones((1, 3))), np.array([3.0 * t, 0.0]))
    assert stamps_s(submap) == [24]


def test_of_a_fast_vessel_two_scans_a_second_are_kept() -> None:
    submap = Submap(AerialConfig(), MOUNT, AROUND_S)
    for t in np.arange(0.0, 17.1, 0.1):
        give(submap, turn_of(t, np.ones((1, 3))), np.array([10.0 * t, 0.0]))
    assert stamps_s(submap) == list(np.arange(2.0, 17.0, 0.5))
