"""Docking numbers, each against one worked out by hand."""

import numpy as np
import pytest

from graphloc.berths import Berth, BerthTrack, rates, seen_from
from graphloc.eval.docking import docking_table, tag_range_m
from graphloc.frames import Array
from graphloc.survey import DockConfig, Survey, TagConfig
from graphloc.trajectory import Trajectory

# Two tags on a quay at north 0 whose face looks south, 4 m apart.
QUAY = Survey(
    tags=(
        TagConfig(id=1, size_m=0.4, xyz_m=(-2.0, 0.0, 1.5), facing_deg=180.0),
        TagConfig(id=2, size_m=0.4, xyz_m=(2.0, 0.0, 1.5), facing_deg=180.0),
    )
)


def track(p: Array, heading_deg: Array | float = 0.0, hz: float = 10.0) -> Trajectory:
    """Body at places (N, 2 or 3) from t = 0 on."""
    n = len(p)
    yaw = np.radians(90.0 - np.broadcast_to(heading_deg, n))
    c, s, o = np.cos(yaw), np.sin(yaw), np.zeros(n)
    R = np.array([[c, -s, o], [s, c, o], [o, o, o + 1.0]]).transpose(2, 0, 1)
    return Trajectory(
        stamps_ns=np.rint(np.arange(n) / hz * 1e9).astype(np.int64),
        p_world_m=np.column_stack([p, np.zeros((n, 3 - p.shape[1]))]),
        R_world_body=R,
    )


def test_range_is_horizontal_and_to_the_nearest_tag() -> None:
    one = track(np.array([[-5.0, -4.0, 9.0], [2.0, -3.0, 0.0], [0.0, 0.0, 0.0]]))
    assert tag_range_m(one, QUAY) == pytest.approx([5.0, 3.0, 2.0])
    # Heading north, a camera 1 m ahead is 1 m further north.
    assert tag_range_m(one, QUAY, np.array([1.0, 0.0, 3.0])) == pytest.approx([np.hypot(3.0, 3.0), 2.0, np.sqrt(5.0)])


def test_range_to_a_tag_on_a_dock_at_rest() -> None:
    """The dock's x axis points north, so its tag at (3, 1) of the dock is at (10 - 1, 20 + 3) of world."""
    survey = Survey(
        tags=(TagConfig(id=1, size_m=0.4, frame="pontoon", xyz_m=(3.0, 1.0, 1.0), facing_deg=180.0),),
        docks=(DockConfig(name="pontoon", xyz_m=(10.0, 20.0, 0.0), rpy_deg=(0.0, 0.0, 90.0)),),
    )
    assert tag_range_m(track(np.array([[9.0, 21.0], [13.0, 26.0]])), survey) == pytest.approx([2.0, 5.0])


def _approach() -> Trajectory:
    """Thirty to one metre south of the second tag in 290 steps of 0.1 m, then 60 steps at rest; 10 Hz."""
    north = np.concatenate([-30.0 + 0.1 * np.arange(290), np.full(61, -1.0)])
    return track(np.column_stack([np.full(len(north), 2.0), north]))


def _beside(truth: Trajectory, east_m: Array) -> Trajectory:
    return Trajectory(
        stamps_ns=truth.stamps_ns,
        p_world_m=truth.p_world_m + np.column_stack([east_m, 0.0 * east_m, 0.0 * east_m]),
        R_world_body=truth.R_world_body,
    )


def test_numbers_of_an_approach_by_hand() -> None:
    """Error: 1/100 of the range. In a band of b to a metres 95 % are below b + 0.95 (a - b) hundredths, to the step."""
    truth = _approach()
    estimate = _beside(truth, -0.01 * truth.p_world_m[:, 1])
    sightings = truth.stamps_ns[[140, 50, 200]]  # first at 25 m
    table = docking_table([("a", estimate)], truth, QUAY, sightings).as_dict()["a"]
    for near, far in ((5, 8), (8, 12), (12, 16), (16, 20), (20, 25)):
        assert table[f"position_p95_{near}_to_{far}_m"] == pytest.approx(0.01 * (near + 0.95 * (far - near)), abs=2e-3)
    # Below 5 m: 61 stamps at 1.0 m, 39 at 1.1 to 4.9 m; of 100 numbers the one at 0.95 * 99 = 94.05, that is 4.405 m.
    assert table["position_p95_0_to_5_m"] == pytest.approx(0.04405)
    assert table["berth_p95_m"] == pytest.approx(0.01)
    seen = truth.p_world_m[50:, 1]
    assert table["sighted_rmse_m"] == pytest.approx(0.01 * np.sqrt(np.mean(seen**2)))
    assert (table["lost"], table["wrong_side"], table["dnv_met"], table["matched"]) == (0.0, 0.0, 1.0, 1.0)


def test_nothing_counts_before_the_first_sighting() -> None:
    truth = _approach()
    estimate = _beside(truth, np.where(truth.p_world_m[:, 1] < -10.05, 9.0, 0.02))
    table = docking_table([("a", estimate)], truth, QUAY, truth.stamps_ns[[200]]).as_dict()["a"]  # at 10 m
    assert table["position_p95_12_to_16_m"] is None
    assert table["position_p95_8_to_12_m"] == pytest.approx(0.02)
    assert table["sighted_rmse_m"] == pytest.approx(0.02)
    blind = docking_table([("a", estimate)], truth, QUAY, truth.stamps_ns[:0]).as_dict()["a"]
    assert {k for k, v in blind.items() if v is not None} == {"berth_p95_m", "lost", "wrong_side"}


def test_what_is_not_covered_is_none() -> None:
    truth = _approach()
    far = truth.where(slice(0, 150))  # ends at 15.1 m
    elsewhere = Trajectory(
        stamps_ns=truth.stamps_ns + 10**12, p_world_m=truth.p_world_m, R_world_body=truth.R_world_body
    )
    table = docking_table([("far", far), ("elsewhere", elsewhere)], truth, QUAY, truth.stamps_ns[[50]]).as_dict()
    assert {k for k, v in table["far"].items() if v is not None} == {
        "position_p95_20_to_25_m", "position_p95_16_to_20_m", "position_p95_12_to_16_m", "sighted_rmse_m", "matched"
    }  # fmt: skip
    assert table["far"]["matched"] == pytest.approx(100 / 301)
    assert {k: v for k, v in table["elsewhere"].items() if v is not None} == {"matched": 0.0}


@pytest.mark.parametrize(("good", "met"), [(96, 1.0), (95, 0.0)])
def test_dnv_counts_what_is_missing_as_missed(good: int, met: float) -> None:
    """Within 5 m there are 101 stamps (40 at 5.0 to 1.1 m, 61 at 1 m): 96 are 95.05 %. The rest has no track."""
    truth = _approach()
    first = int(np.flatnonzero(truth.p_world_m[:, 1] > -5.05)[0])
    assert len(truth) - first == 101
    estimate = truth.where(slice(first, first + good))
    table = docking_table([("a", estimate)], truth, QUAY, truth.stamps_ns[[50]]).as_dict()["a"]
    assert table["position_p95_0_to_5_m"] == 0.0
    assert table["dnv_met"] == met


@pytest.mark.parametrize(("off_m", "met"), [(0.099, 1.0), (0.101, 0.0)])
def test_dnv_is_ten_centimetres(off_m: float, met: float) -> None:
    truth = _approach()
    table = docking_table([("a", _beside(truth, np.full(len(truth), off_m)))], truth, QUAY, truth.stamps_ns[:1])
    assert table.as_dict()["a"]["dnv_met"] == met


@pytest.mark.parametrize(
    ("true", "estimate", "lost", "wrong"),
    [
        ((3.5, -2.0), (0.5, -2.0), 1.0, 1.0),  # mirrored about the tag at east 2
        ((3.5, -2.0), (2.1, -2.0), 0.0, 0.0),  # as far off as it may be on the right side
        ((2.4, -2.0), (1.3, -2.0), 0.0, 1.0),
        ((2.4, -2.0), (1.5, -2.0), 0.0, 0.0),  # on the other side, but 0.9 m off
        ((2.4, -2.0), (2.4, 0.5), 1.0, 1.0),  # through the quay
        ((2.4, -0.4), (2.4, 0.4), 0.0, 0.0),
        ((2.4, -2.0), (2.4, -3.9), 0.0, 0.0),
        ((2.4, -2.0), (2.4, -4.1), 1.0, None),  # in front and to the right, and yet of no use: no 0 that reads as good
        ((2.4, -2.0), (22.0, -22.0), 1.0, None),
        ((-3.5, -2.0), (-0.5, -2.0), 1.0, 1.0),  # about the other tag
    ],
)
def test_lost_and_wrong_side(
    true: tuple[float, float], estimate: tuple[float, float], lost: float, wrong: float | None
) -> None:
    truth = track(np.tile(true, (100, 1)))
    other = track(np.vstack([np.tile(true, (40, 1)), np.tile(estimate, (60, 1))]))
    row = docking_table([("a", other)], truth, QUAY, truth.stamps_ns[:1]).as_dict()["a"]
    assert (row["lost"], row["wrong_side"]) == (lost, wrong)


def test_table_is_like_the_others() -> None:
    truth = _approach()
    table = docking_table([("graphloc", truth), ("none", truth.where(slice(0, 3)))], truth, QUAY, truth.stamps_ns[[50]])
    assert [name for name, _ in table.rows] == ["graphloc", "none"]
    assert all(len(values) == len(table.columns) for _, values in table.rows)
    assert "berth_p95_m" in table.as_text()
    assert "DNV" in table.note


def _berth(point_m: tuple[float, float, float], facing_deg: float, pivot_m: Array | None = None) -> Berth:
    pivot = np.array([7.0, -3.0, 0.0]) if pivot_m is None else pivot_m  # of no account while nothing turns
    return Berth(name="berth", point_m=np.array(point_m), facing_deg=facing_deg, pivot_m=pivot)


def _relative(body: Trajectory, berth: Berth, moved: Array | None = None) -> BerthTrack:
    """The body from the berth; its dock (N, 4) moved, or at rest."""
    value, _ = seen_from(berth, body.p_world_m, body.yaw_rad, np.zeros((len(body), 4)) if moved is None else moved)
    t = (body.stamps_ns - body.stamps_ns[0]) * 1e-9
    return BerthTrack(berth=berth, stamps_ns=body.stamps_ns, value=value, rate=rates(value, t))


def _shown(seen: BerthTrack) -> tuple[Array, Array, Array]:
    """Across m, along m, angle deg."""
    return seen.value[:, 0], seen.value[:, 1], np.degrees(seen.value[:, 2])


# Of a quay that looks south, east is right and south is the water; one that looks east has north on its right.
@pytest.mark.parametrize(
    ("p", "heading_deg", "facing_deg", "across_m", "along_m", "angle_deg"),
    [
        ((103.0, 48.0), 0.0, 180.0, 2.0, 3.0, 0.0),
        ((97.0, 48.0), 30.0, 180.0, 2.0, -3.0, 30.0),
        ((97.0, 52.0), 90.0, 180.0, -2.0, -3.0, 90.0),
        ((103.0, 52.0), 180.0, 180.0, -2.0, 3.0, 180.0),
        ((103.0, 48.0), 270.0, 180.0, 2.0, 3.0, -90.0),
        ((103.0, 48.0), 270.0, 90.0, 3.0, -2.0, 0.0),
        ((103.0, 52.0), 0.0, 90.0, 3.0, 2.0, 90.0),
        ((97.0, 52.0), 95.0, 90.0, -3.0, 2.0, -175.0),
        ((97.0, 48.0), 180.0, 0.0, -2.0, 3.0, 0.0),
        ((97.0, 48.0), 10.0, 270.0, 3.0, 2.0, -80.0),
        ((100.0 - np.sqrt(2.0), 50.0 - np.sqrt(2.0)), 45.0, 225.0, 2.0, 0.0, 0.0),
        ((100.0 + np.sqrt(2.0), 50.0 - np.sqrt(2.0)), 44.0, 225.0, 0.0, 2.0, -1.0),
    ],
)
def test_at_a_berth_by_hand(
    p: tuple[float, float], heading_deg: float, facing_deg: float, across_m: float, along_m: float, angle_deg: float
) -> None:
    here = _relative(track(np.tile(p, (2, 1)), heading_deg), _berth((100.0, 50.0, 1.0), facing_deg))
    across, along, angle = _shown(here)
    assert across == pytest.approx(across_m)
    assert along == pytest.approx(along_m)
    assert angle == pytest.approx(angle_deg)
    assert here.rate == pytest.approx(np.zeros((2, 3)))


def test_rates() -> None:
    """North at 0.3 m/s and east at 0.1: the quay that looks south comes nearer, and right is east. Steps of any length."""
    t = np.array([0.0, 0.1, 0.3, 0.35, 1.0])
    moving = track(np.column_stack([0.1 * t, -5.0 + 0.3 * t]))
    uneven = Trajectory(
        stamps_ns=np.rint(t * 1e9).astype(np.int64), p_world_m=moving.p_world_m, R_world_body=moving.R_world_body
    )
    here = _relative(uneven, _berth((0.0, 0.0, 0.0), 180.0))
    assert here.rate == pytest.approx(np.tile([-0.3, 0.1, 0.0], (5, 1)))
    assert here.value[:, 0] == pytest.approx(5.0 - 0.3 * t)


def test_a_dock_that_moves_takes_its_berth_along() -> None:
    """A body that rides with the dock stays where it is at the berth, whatever the dock does."""
    t = np.arange(0.0, 20.0, 0.1)
    offset = np.column_stack([0.3 * np.sin(t / 4.0), 0.2 * np.cos(t / 3.0), 0.1 * np.sin(t)])
    yaw = 0.3 * np.sin(t / 5.0)
    pivot = np.array([10.0, 20.0, 0.0])
    dock = np.column_stack([offset, yaw])
    arm = np.array([3.0, -4.0])  # of the body from the pivot, at rest
    c, s = np.cos(yaw), np.sin(yaw)
    p = pivot[:2] + offset[:, :2] + np.column_stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]])
    body = track(p, 20.0 - np.degrees(yaw))  # heading is clockwise, yaw is not
    berth = _berth((10.0, 19.0, 0.0), 180.0, pivot)
    here = _relative(body, berth, dock)
    assert here.value == pytest.approx(np.tile([3.0, 3.0, np.radians(20.0)], (200, 1)))
    assert here.rate == pytest.approx(np.zeros((200, 3)), abs=1e-9)
    assert np.ptp(_relative(body, berth).value[:, 0]) > 0.3


def test_a_dock_by_hand() -> None:
    """The dock is 1 m east and turned by 90 deg: its face, south at rest, looks east, a metre east of the pivot.

    The body is 3 m east of the pivot at rest: 1 m from the face. Its right, east at rest, is north; the body is 2 m up it.
    """
    moved = np.tile([1.0, 0.0, 0.0, np.pi / 2.0], (2, 1))
    body = track(np.tile([3.0, 2.0], (2, 1)), 270.0)
    across, along, angle = _shown(_relative(body, _berth((0.0, -1.0, 0.0), 180.0, np.zeros(3)), moved))
    assert (across[0], along[0], angle[0]) == pytest.approx((1.0, 2.0, 0.0))
