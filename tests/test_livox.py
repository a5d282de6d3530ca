# SPDX-License-Identifier: Apache-2.0
"""Scans in the messages of Livox's drivers, written by rosbags by their definition: read without it, and fast."""

import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphloc.config import AerialConfig
from graphloc.frames import Array
from graphloc.frontends._livox import LIVOX, livox_cloud
from graphloc.frontends.aerial.cloud import decode_cloud
from graphloc.frontends.aerial.scans import ScanFeed
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.frontends.source import Bag
from tests.bagfactory import START_NS, Item, Messages, S, write_bag

MS = 1_000_000
DRIVER2 = "livox_ros_driver2/msg/CustomMsg"


def message(
    make: Messages,
    msgtype: str = DRIVER2,
    xyz: Any = ((1.0, 2.0, 3.0), (-4.0, 5.0, -6.0)),
    since_ns: Any = (0, 99 * MS),
    tags: Any = 0,
    **changes: Any,
) -> Any:
    """A scan stamped at the beginning; `changes` replace fields."""
    point = msgtype.replace("Msg", "Point")
    if msgtype not in make.t:
        make.register(
            "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
            f"{'=' * 80}\nMSG: {point.replace('/msg', '')}\n"
            "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n",
            msgtype,
        )  # fmt: skip
    points = [
        make.t[point](offset_time=int(t), x=float(x), y=float(y), z=float(z), reflectivity=7, tag=int(tag), line=1)
        for (x, y, z), t, tag in zip(xyz, since_ns, np.broadcast_to(tags, len(xyz)), strict=True)
    ]
    given = {
        "header": make.header(START_NS, "livox_frame"),
        "timebase": START_NS,
        "point_num": len(points),
        "points": points,
    }
    return make.t[msgtype](**{"lidar_id": 3, "rsvd": np.zeros(3, np.uint8), **given, **changes})  # fmt: skip


def raw(make: Messages, msg: Any) -> bytes:
    write = make.store.serialize_ros1 if make.ros == 1 else make.store.serialize_cdr
    return bytes(write(msg, msg.__msgtype__))


def read(make: Messages, msg: Any) -> tuple[Array, list[int]]:
    """Return the points, and their times since START_NS, ns."""
    cloud: Any = livox_cloud(raw(make, msg), ros1=make.ros == 1)
    stamp_ns = cloud.header.stamp.sec * S + cloud.header.stamp.nanosec
    found = decode_cloud(cloud, stamp_ns, "bow")
    return found.points_m, (found.stamps_ns - START_NS).tolist()


@pytest.mark.parametrize("msgtype", LIVOX)
@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_scan_of_a_bag_has_the_time_of_each_point(kind: str, msgtype: str, tmp_path: Path) -> None:
    """In sqlite3 as Humble writes it no definition is in the bag."""
    make = Messages(1 if kind == "ros1" else 2)
    scan = message(make, msgtype)
    path = write_bag(tmp_path / f"run{'.bag' * (kind == 'ros1')}", make, [("/livox/lidar", START_NS + S, scan)], kind)
    config = AerialConfig(lidars={"bow": {"topic": "/livox/lidar"}}, image="none.tif")  # type: ignore[dict-item]
    with Bag(path) as bag:
        (turn,) = ScanFeed(bag, config, "base_link")
    (cloud,) = turn.clouds
    np.testing.assert_array_equal(cloud.points_m, [[1.0, 2.0, 3.0], [-4.0, 5.0, -6.0]])
    assert (cloud.stamps_ns - START_NS).tolist() == [0, 99 * MS]


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("frame", ["", "l", "livox", "livox_fr", "a/long/name/of/a/frame"])
def test_any_length_of_a_frame_aligns(ros: int, frame: str) -> None:
    make = Messages(ros)
    msg = message(make, header=make.header(START_NS, frame))
    points, since = read(make, msg)
    np.testing.assert_array_equal(points[:, 0], [1.0, -4.0])
    assert since == [0, 99 * MS]
    cloud: Any = livox_cloud(raw(make, msg), ros1=ros == 1)
    assert cloud.header.frame_id == frame


@pytest.mark.parametrize("ros", [1, 2])
def test_noise_by_its_tag_and_gaps_are_no_points(ros: int) -> None:
    """Any bit of confidence, in the lowest four or of near distortion; the number of a return says nothing against it."""
    tags = [0x00, 0x10, 0x20, 0x30, 0x01, 0x02, 0x04, 0x08, 0x40, 0x1F, 0x00, 0x00]
    xyz = np.column_stack([1.0 + np.arange(12.0), np.ones((12, 2))])
    xyz[10], xyz[11] = 0.0, np.nan
    make = Messages(ros)
    points, _ = read(make, message(make, xyz=xyz, since_ns=np.arange(12) * 9 * MS, tags=tags))
    np.testing.assert_array_equal(points[:, 0], [1.0, 2.0, 3.0, 4.0])


@pytest.mark.parametrize(
    ("header_ns", "begin_ns"),
    [
        (START_NS + 104 * MS, START_NS),  # stamped when it was complete
        (START_NS - 300, START_NS),  # rounded to a double
        (START_NS, START_NS),
        (START_NS + 2 * S, START_NS + 2 * S),  # of another clock
        (0, 0),  # no stamp stays none
    ],
)
def test_the_time_base_is_when_it_began(header_ns: int, begin_ns: int) -> None:
    make = Messages(2)
    cloud: Any = livox_cloud(raw(make, message(make, header=make.header(header_ns))), ros1=False)
    assert cloud.header.stamp.sec * S + cloud.header.stamp.nanosec == begin_ns


@pytest.mark.parametrize("ros", [1, 2])
def test_a_damaged_scan_is_one_line(ros: int) -> None:
    make = Messages(ros)
    good = raw(make, message(make))
    for cut in range(len(good)):
        with pytest.raises(ValueError, match=r"^a scan (cut off in its head|of 2 points with)"):
            livox_cloud(good[:cut], ros1=ros == 1)
    with pytest.raises(ValueError, match=r"^a scan of 2 points with"):
        livox_cloud(good + bytes(19), ros1=ros == 1)
    with pytest.raises(ValueError, match=r"^a scan of 2 points whose point_num is 3$"):
        livox_cloud(raw(make, message(make, point_num=3)), ros1=ros == 1)
    assert len(read(make, message(make, xyz=(), since_ns=()))[0]) == 0
    rng = np.random.default_rng(4)
    for _ in range(300):
        data = bytearray(good)
        data[rng.integers(len(data))] = rng.integers(256)
        try:
            livox_cloud(bytes(data), ros1=ros == 1)
        except ValueError as error:
            assert str(error).startswith("a scan ")  # noqa: PT017


def test_a_scan_whose_number_is_wrong_is_a_turn_with_the_reason(tmp_path: Path) -> None:
    make = Messages(2)
    bad = message(make, point_num=3)
    path = write_bag(tmp_path / "run", make, [("/livox/lidar", START_NS + S, bad)], "mcap")
    config = AerialConfig(lidars={"bow": {"topic": "/livox/lidar"}}, image="none.tif")  # type: ignore[dict-item]
    with Bag(path) as bag:
        (turn,) = ScanFeed(bag, config, "base_link")
    assert turn.why_not == "/livox/lidar: a scan of 2 points whose point_num is 3"


def test_it_is_drafted_as_a_lidar(tmp_path: Path) -> None:
    make = Messages(1)
    items: list[Item] = [("/imu", START_NS + k * S // 50, make.imu(START_NS + k * S // 50)) for k in range(100)]
    items.append(("/livox/lidar", START_NS + 2 * S, message(make, "livox_ros_driver/msg/CustomMsg")))
    found = inspect_bag(write_bag(tmp_path / "run.bag", make, items, "ros1"))
    assert re.search(r"kind: aerial\n(.*\n)*.*topic: /livox/lidar\n.*where 'livox_frame' sits", draft_config(found))
    assert not [w for w in found.warnings if "livox" in w]


def test_twenty_thousand_points_take_milliseconds() -> None:
    """An object each, as rosbags would make, takes a hundred times as long."""
    make = Messages(2)
    step = 20
    head = raw(make, message(make))[: -(2 * step - 1)]
    count = 20_000
    number = count.to_bytes(4, "little")
    data = head[:-12] + number + head[-8:-4] + number + bytes(step * count - 1)
    took = []
    for _ in range(5):
        began = time.perf_counter()
        livox_cloud(data, ros1=False)
        took.append(time.perf_counter() - began)
    assert min(took) < 0.01
