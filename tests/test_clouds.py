# SPDX-License-Identifier: Apache-2.0
"""What drivers write into a `PointCloud2`, and scans that a track covers in part."""

import logging
import tracemalloc
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends.aerial import cloud as module
from graphloc.frontends.aerial.cloud import Cloud, decode_cloud, level
from graphloc.trajectory import Trajectory

S = 10**9
UNIX = 1_700_000_000 * S + 123_456_789
KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}  # sensor_msgs/PointField


@pytest.fixture(autouse=True)
def _not_yet_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_said", set())


def message(time: Any = None, kind: str = "f4", name: str = "time", points: Array | None = None, **changes: Any) -> Any:
    """A cloud of one row whose x counts the points from 1; `changes` are made after."""
    if points is None:
        points = np.ones((8 if time is None else len(time), 3))
        points[:, 0] = 1.0 + np.arange(len(points))
    layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")] + ([] if time is None else [(name, "<" + kind)])
    rows = np.zeros(len(points), layout)
    for k, axis in enumerate("xyz"):
        rows[axis] = points[:, k]
    if time is not None:
        with np.errstate(all="ignore"):
            rows[name] = time
    step = rows.dtype.itemsize
    fields = [SimpleNamespace(name=a, offset=4 * k, datatype=7, count=1) for k, a in enumerate("xyz")]
    if time is not None:
        fields.append(SimpleNamespace(name=name, offset=12, datatype=KINDS[kind], count=1))
    made = {
        "fields": fields, "height": 1, "width": len(points), "point_step": step, "row_step": step * len(points),
        "is_bigendian": False, "data": np.frombuffer(rows.tobytes(), np.uint8),
    }  # fmt: skip
    return SimpleNamespace(**{**made, **changes})


def since_s(msg: Any, stamp_ns: int = UNIX) -> Array:
    """What is found, s since the header, of each point; NaN where it was dropped. Any numpy warning fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = decode_cloud(msg, stamp_ns, "bow")
    assert found.stamps_ns.dtype == np.int64
    assert len(found.stamps_ns) == len(found.points_m)
    out = np.full(msg.width * msg.height, np.nan)
    out[found.points_m[:, 0].astype(int) - 1] = [(int(v) - stamp_ns) / 1e9 for v in found.stamps_ns]
    return out


def turn(first_s: float, last_s: float, count: int = 300) -> Array:
    return np.linspace(first_s, last_s, count)


@pytest.mark.parametrize(
    ("kind", "name", "unit_s", "first_s", "last_s", "count"),
    [
        ("f4", "time", 1.0, 0.0, 0.1, 300),  # Velodyne
        ("f4", "time", 1.0, -0.1, 0.0, 300),  # Velodyne, header of the last packet
        ("f4", "time", 1.0, 0.060, 0.0605, 20),  # few returns, all of one buoy
        ("f4", "time", 1.0, 0.0, 0.95, 5000),  # 1 Hz
        ("f4", "time", 1e-3, 0.0, 0.1, 300),
        ("f4", "time", 1e-6, 0.0, 0.1, 300),
        ("f4", "time", 1e-9, 0.0, 0.1, 300),
        ("f4", "time", 1e-9, 0.0, 0.2, 300),  # the largest is 2e8, as old as 1976 in seconds
        ("f8", "timestamp", 1e-9, 0.0, 0.2, 300),
        ("f8", "time_offset", 1.0, 0.0, 0.05, 300),
        ("u4", "t", 1e-9, 0.0, 0.1, 300),  # Ouster
        ("u4", "t", 1e-9, 0.0, 0.0009, 300),  # a packet of it
        ("u4", "t", 1e-9, 0.060, 0.06001, 20),
        ("u4", "offset_time", 1e-9, 0.0, 0.01, 2000),  # Livox, 100 Hz
        ("u4", "t", 1e-6, 0.0, 0.1, 300),
        ("u4", "t", 1e-6, 0.0, 0.2, 5000),
        ("u4", "t", 1e-3, 0.0, 0.1, 300),
        ("i4", "t", 1e-6, -0.1, 0.0, 300),
        ("u2", "t", 1e-6, 0.0, 0.05, 300),
    ],
)
def test_times_since_the_header(
    kind: str, name: str, unit_s: float, first_s: float, last_s: float, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    true = turn(first_s, last_s, count)
    written = true / unit_s if kind[0] == "f" else np.rint(true / unit_s)
    np.testing.assert_allclose(since_s(message(written, kind, name)), true, atol=max(1e-6, unit_s * 0.51))
    assert not caplog.records


@pytest.mark.parametrize("unit_s", [1.0, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("stamp", [UNIX, 5000 * S, 50 * S])
@pytest.mark.parametrize(("first_s", "last_s"), [(0.0, 0.1), (-0.1, 0.0), (0.0, 0.0009), (0.0, 0.95)])
def test_absolute_times(
    unit_s: float, stamp: int, first_s: float, last_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Hesai, RoboSense (s), Livox (ns) and others; a header on a clock since boot with points on it too."""
    true = turn(first_s, last_s)
    written = (true + stamp * 1e-9) / unit_s
    np.testing.assert_allclose(since_s(message(written, "f8", "timestamp"), stamp), true, atol=1e-6)
    assert not caplog.records


@pytest.mark.parametrize(
    ("name", "told"), [("point_time", True), ("Timestamp", True), ("t_us", True), ("ring", False), ("intensity", False)]
)
def test_a_field_that_looks_like_times_but_is_none_known_is_said(
    name: str, told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """A scan of 0.1 s that is not corrected for motion is off by a metre at 10 m/s."""
    assert not since_s(message(turn(0.0, 0.1), "f4", name)).any()
    assert [name in r.getMessage() and "no field of times that is known" in r.getMessage() for r in caplog.records] == [
        True
    ] * told


@pytest.mark.parametrize("unit_s", [1.0, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("clock_s", [UNIX * 1e-9 + 37.0, UNIX * 1e-9 - 37.0, 5000.0, 50_000.0, 10.0, 90.0])
def test_another_clock_gives_differences_alone(unit_s: float, clock_s: float, caplog: pytest.LogCaptureFixture) -> None:
    """TAI is 37 s ahead of UTC; boot clocks are young. The first point is at the header's stamp, to the 1 % cut."""
    true = turn(0.0, 0.1)
    found = since_s(message((true + clock_s) / unit_s, "f8", "timestamp"))
    np.testing.assert_allclose(found, true, atol=0.0015)
    np.testing.assert_allclose(np.diff(found), np.diff(true), atol=1e-6)
    assert ["another clock" in r.getMessage() for r in caplog.records] == [True]


@pytest.mark.parametrize(
    ("written", "kind"),
    [
        (turn(0.0, 2.0), "f4"),  # s; in ms it were a packet
        (turn(0.0, 2.0), "f8"),
        (turn(0.0, 0.9), "f4"),  # a packet in ms, or a turn of few points in s
        (turn(0.0, 0.9), "f8"),
        (np.full(300, np.nan), "f4"),
        (np.full(300, np.inf), "f8"),
        (np.full(300, 1e300), "f8"),
        (np.full(300, UNIX / S), "f4"),  # all one number: float32 has 128 s between two
        (np.full(300, UNIX // S), "u4"),  # whole seconds
        (turn(-1e300, 1e300), "f8"),
    ],
)
def test_times_without_sense_are_the_headers(written: Array, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(3):
        np.testing.assert_array_equal(since_s(message(written, kind)), np.zeros(300))
    decode_cloud(message(written, kind), UNIX, "stern")
    assert [r.levelno for r in caplog.records] == [logging.WARNING] * 2
    assert [r.getMessage().split(":")[0] for r in caplog.records] == ["LiDAR bow", "LiDAR stern"]


def test_a_field_that_is_never_filled_needs_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    np.testing.assert_array_equal(since_s(message(np.zeros(300))), np.zeros(300))
    np.testing.assert_array_equal(since_s(message()), np.zeros(8))
    assert not caplog.records


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan, 1e20, -1e20, 1e300, 0.0])
@pytest.mark.parametrize(("offset_s", "unit_s"), [(UNIX / S, 1.0), (UNIX / S, 1e-9), (0.0, 1e-6)])
def test_one_bad_time_costs_its_own_point_alone(bad: float, offset_s: float, unit_s: float) -> None:
    true = turn(0.01, 0.1)
    written = (true + offset_s) / unit_s
    written[17] = bad
    found = since_s(message(written, "f8", "timestamp"))
    keep = np.arange(300) != 17
    np.testing.assert_allclose(found[keep], true[keep], atol=1e-6)
    assert found[17] == 0.0 if bad == offset_s == 0.0 else np.isnan(found[17])


def test_gaps_have_no_say_in_the_unit() -> None:
    """Points that a driver fills up with zeros or NaN have any time."""
    true = turn(0.01, 0.1)
    points = np.ones((300, 3))
    points[:, 0] += np.arange(300)
    points[:200] = 0.0
    points[100:200, 1] = np.nan
    written = np.where(np.arange(300) < 200, 1e12, true)
    np.testing.assert_allclose(since_s(message(written, "f8", points=points))[200:], true[200:], atol=1e-6)


def test_any_bytes_give_stamps_within_a_second() -> None:
    rng = np.random.default_rng(3)
    for kind in KINDS:
        for count in (1, 2, 9, 10, 200):
            raw = rng.integers(0, 256, count * int(kind[1]), dtype=np.uint8).view(kind)
            for stamp in (UNIX, 0, S, 2**31 * S):
                found = since_s(message(raw, kind), stamp)
                assert (np.isnan(found) | (np.abs(found) <= 1.0)).all()


def test_a_signalling_nan_is_a_gap() -> None:
    msg = message(turn(0.0, 0.1, 8))
    data = msg.data.copy()
    data.view("<u4").reshape(8, 4)[2, 1] = 0x7FA00000
    msg.data = data
    np.testing.assert_array_equal(np.isnan(since_s(msg)), np.arange(8) == 2)


def field(msg: Any, name: str) -> Any:
    return next(f for f in msg.fields if f.name == name)


@pytest.mark.parametrize("datatype", [0, 9, 255])
@pytest.mark.parametrize("name", ["y", "time"])
def test_an_unknown_datatype_is_named(name: str, datatype: int) -> None:
    msg = message(turn(0.0, 0.1))
    field(msg, name).datatype = datatype
    with pytest.raises(ValueError, match=f"^a cloud whose field '{name}' has the unknown datatype {datatype}$"):
        decode_cloud(msg, UNIX, "bow")


def test_fields_outside_of_the_point_are_named() -> None:
    msg = message(turn(0.0, 0.1, 8))
    field(msg, "time").offset = 13
    with pytest.raises(
        ValueError, match=r"^a cloud whose field 'time' at byte 13 lies outside its points of 16 bytes$"
    ):
        decode_cloud(msg, UNIX, "bow")
    with pytest.raises(ValueError, match=r"^a cloud whose field 'x' at byte 0 lies outside its points of 0 bytes$"):
        decode_cloud(message(point_step=0, row_step=0), UNIX, "bow")


def test_of_fields_with_one_name_the_first_counts() -> None:
    msg = message()
    msg.fields.append(SimpleNamespace(name="x", offset=4, datatype=7, count=1))
    np.testing.assert_array_equal(decode_cloud(msg, UNIX, "bow").points_m[:, 0], np.arange(1.0, 9.0))


@pytest.mark.parametrize("row_step", [0, 7, 12 * 4, 12 * 8, 2**32 - 1])
def test_a_wrong_row_step_does_no_harm_without_padding(row_step: int) -> None:
    found = decode_cloud(message(height=2, width=4, row_step=row_step), UNIX, "bow")
    np.testing.assert_array_equal(found.points_m[:, 0], np.arange(1.0, 9.0))


def test_padded_rows_and_bytes_that_are_missing() -> None:
    plain = message().data.reshape(2, 48)
    padded = np.hstack([plain, np.full((2, 5), 255, np.uint8)]).reshape(-1)
    found = decode_cloud(message(height=2, width=4, row_step=53, data=padded), UNIX, "bow")
    np.testing.assert_array_equal(found.points_m[:, 0], np.arange(1.0, 9.0))
    for row_step in (0, 48, 53):
        with pytest.raises(ValueError, match=r"^a cloud of 8 points with 95 bytes$"):
            decode_cloud(message(height=2, width=4, row_step=row_step, data=padded[:95]), UNIX, "bow")
    assert len(decode_cloud(message(width=0, row_step=0, data=padded[:0]), UNIX, "bow").points_m) == 0


def track(first_s: float, last_s: float, hz: float = 10.0, gap_s: tuple[float, float] = (0.0, 0.0)) -> Trajectory:
    """East at 2 m/s, turning left at 0.5 rad/s."""
    t = np.arange(round(first_s * hz), round(last_s * hz) + 1) / hz
    t = t[(t <= gap_s[0]) | (t >= gap_s[1])]
    R = Rotation.from_euler("Z", 0.5 * t[:, None]).as_matrix()
    p = np.column_stack([2.0 * t, np.zeros((len(t), 2))])
    return Trajectory(stamps_ns=np.rint(t * S).astype(np.int64), p_world_m=p, R_world_body=R.reshape(-1, 3, 3))


def seen_at(lidar: str, times_s: Array) -> Cloud:
    """Of a LiDAR at the body's origin: a point 7 m to the north of the vessel, and as many m up as the time is s."""
    north = np.column_stack([7.0 * np.sin(0.5 * times_s), 7.0 * np.cos(0.5 * times_s), times_s])
    stamps: NDArray[np.int64] = np.rint(times_s * S).astype(np.int64)
    return Cloud(lidar, int(stamps[0]), north, stamps)


MOUNTS = {name: (np.zeros(3), np.eye(3)) for name in ("bow", "stern")}


def expect_level(found: Any, at_s: float, times_s: Array) -> None:
    """The vessel was at 2 t east: from that at `at_s`, the points lie 2 (t - at) east and 7 m north, turned by yaw."""
    c, s = np.cos(0.5 * at_s), np.sin(0.5 * at_s)
    east_north = np.column_stack([2.0 * (times_s - at_s), np.full(len(times_s), 7.0)])
    to_body = np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(found.points_m[:, :2], east_north @ to_body.T, atol=0.01)
    np.testing.assert_allclose(found.points_m[:, 2], times_s, atol=1e-9)
    np.testing.assert_allclose(found.origin_m, (east_north - [0.0, 7.0]) @ to_body.T, atol=0.01)


def test_what_the_track_does_not_cover_is_left_out() -> None:
    """An old turn before it, one that begins before it, one in a gap, and the newest that ends after it."""
    spans = [(1.0, 1.1), (1.95, 2.05), (4.0, 4.1), (5.95, 6.05)]
    clouds = [seen_at("bow" if k % 2 else "stern", turn(a, b, 51)) for k, (a, b) in enumerate(spans)]
    found = level(clouds, MOUNTS, track(2.0, 6.0, gap_s=(3.0, 5.0)), 6 * S, 0.0)
    every = np.concatenate([turn(a, b, 51) for a, b in spans])
    expect_level(found, 6.0, every[((every >= 2.0) & (every <= 3.0)) | ((every >= 5.0) & (every <= 6.0))])


def test_a_long_track_and_a_wild_stamp_cost_nothing() -> None:
    """A LiDAR on a boot clock beside one on UTC: its points are outside, 50 years of 2 ms are no table."""
    base = track(0.0, 6.0)
    late = Trajectory(stamps_ns=base.stamps_ns + UNIX, p_world_m=base.p_world_m, R_world_body=base.R_world_body)
    good = seen_at("bow", turn(3.0, 3.1, 51))
    good = Cloud("bow", good.stamp_ns + UNIX, good.points_m, good.stamps_ns + UNIX)
    found = level([seen_at("stern", turn(3.0, 3.1, 51)), good], MOUNTS, late, UNIX + 3 * S, 0.0)
    expect_level(found, 3.0, turn(3.0, 3.1, 51))


@pytest.mark.parametrize(
    ("spans", "at_s", "said"),
    [
        ([(3605.95, 3606.05)], 3606.0, "bow: the scan lies 3600.0 s after the end of the track"),
        ([(3606.0, 3606.1), (3606.0, 3606.1)], 3606.0, "bow, stern: the scan lies 3600.0 s after"),
        ([(0.5, 0.6)], 0.55, "bow: the scan lies 1.4 s before the start of the track"),
        ([(4.0, 4.1)], 4.05, "bow: the scan lies in a gap of 2.0 s of the track"),
        ([(2.5, 2.6), (6.2, 6.3)], 6.0, "stern: the scan lies 0.2 s after the end of the track"),  # an old turn is not enough
        ([(2.5, 2.6), (4.9, 4.95)], 5.0, "stern: the scan lies in a gap of 2.0 s"),
    ],
)  # fmt: skip
def test_a_newest_turn_without_track_says_how_far(spans: list[tuple[float, float]], at_s: float, said: str) -> None:
    clouds = [seen_at(name, turn(a, b, 51)) for name, (a, b) in zip(("bow", "stern"), spans, strict=False)]
    with pytest.raises(InputError, match=f"^the track does not cover the scan of {said}"):
        level(clouds, MOUNTS, track(2.0, 6.0, gap_s=(3.0, 5.0)), round(at_s * S), 0.0)


def test_one_of_two_lidars_is_enough_and_none_is_no_error() -> None:
    clouds = [seen_at("bow", turn(6.1, 6.2, 51)), seen_at("stern", turn(5.9, 6.0, 51))]
    expect_level(level(clouds, MOUNTS, track(2.0, 6.0), 6 * S, 0.0), 6.0, turn(5.9, 6.0, 51))
    empty = Cloud("bow", 6 * S, np.zeros((0, 3)), np.zeros(0, np.int64))
    assert level([empty], MOUNTS, track(2.0, 6.0), 6 * S, 0.0).points_m.shape == (0, 3)
    assert level([], MOUNTS, track(2.0, 6.0), 6 * S, 0.0).origin_m.shape == (0, 2)


def test_many_points_take_no_rotation_each() -> None:
    """A rotation each is 72 bytes a point; points and origins are 40, and the numbers on the way there 24 or so."""
    count = 300_000
    big = seen_at("bow", turn(3.0, 3.2, count))
    tracemalloc.start()
    found = level([big], MOUNTS, track(2.0, 6.0), 3 * S, 0.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expect_level(found, 3.0, turn(3.0, 3.2, count))
    assert peak < 100 * count
