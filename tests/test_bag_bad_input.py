# SPDX-License-Identifier: Apache-2.0
"""Issue item A.7 at the reading level: each kind of bad input ends in a ledger row, a warning, or one clear line."""

import struct
from collections import Counter
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from scipy.spatial.transform import Rotation

from graphloc.errors import InputError
from graphloc.frontends._clock import steady_logs
from graphloc.frontends._order import longest_increasing
from graphloc.frontends._sanity import far_fixes_of, turns_gravity
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, PoseFix
from graphloc.recording import Recording
from graphloc.time import utc_text
from tests.bagfactory import START_NS, Item, Messages, S, damage_last_chunk, rows_of, still_run, write_bag
from tests.test_bag import accounted, vessel

MAKE = Messages(2)
LATER_NS = 10_000_000


def read(tmp_path: Path, items: list[Item], kind: str = "mcap", **sensors: Any) -> Recording:
    """Write, read, and hold the sum."""
    ordered = sorted(items, key=lambda i: i[1])
    recording = read_recording(write_bag(tmp_path / "run", MAKE, ordered, kind), vessel(**sensors))
    assert recording.message_count == accounted(recording)
    return recording


def one_line(error: pytest.ExceptionInfo[InputError], *words: str) -> None:
    text = str(error.value)
    assert "\n" not in text
    for word in words:
        assert word in text


# truncated bag


def test_no_bag(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / "nowhere.bag", vessel())
    one_line(error, "nowhere.bag", "no such file")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / "notes.txt", vessel())
    one_line(error, "notes.txt", "not a bag")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / "empty", vessel())
    one_line(error, "empty", "metadata.yaml")


def test_a_folder_of_ours_that_is_no_bag_says_which_is_meant(tmp_path: Path) -> None:
    (tmp_path / "sim" / "run").mkdir(parents=True)
    (tmp_path / "sim" / "run" / "metadata.yaml").write_text("")
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / "sim", vessel())
    one_line(error, "sim: has no metadata.yaml", f"a bag lies in it: {tmp_path / 'sim' / 'run'}")
    (tmp_path / "sim" / "solution_bag").mkdir()
    (tmp_path / "sim" / "solution_bag" / "metadata.yaml").write_text("")
    (tmp_path / "sim" / "run.json").write_text("{}")
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / "sim", vessel())
    one_line(error, "sim: has no metadata.yaml", "folder of a finished run")


@pytest.mark.parametrize(
    ("name", "hint"), [("a.bag", "rosbag reindex"), ("a.mcap", "mcap recover"), ("a.db3", "ros2 bag reindex")]
)
@pytest.mark.parametrize("content", [b"", b"this is no bag", b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"])
def test_nothing_readable_names_the_tool_that_repairs(tmp_path: Path, name: str, hint: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / name, vessel())
    one_line(error, name, hint)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_a_pointer_of_git_lfs_is_named(tmp_path: Path, name: str) -> None:
    """No tool that repairs bags helps there."""
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / name, vessel())
    one_line(error, name, "it is a pointer of Git LFS, not the file itself: `git lfs pull` fetches that")


@cache
def whole_file(kind: str, compression: str) -> bytes:
    """A bag of two and a half minutes: long enough for several chunks."""
    make = Messages(1 if kind == "ros1" else 2)
    with TemporaryDirectory() as folder:
        target = Path(folder) / ("run.bag" if kind == "ros1" else "run")
        path = write_bag(target, make, still_run(make, 150.0), kind, compression)
        return (path if kind == "ros1" else path / "run.mcap").read_bytes()


@pytest.mark.parametrize(
    ("kind", "compression"), [("ros1", ""), ("ros1", "lz4"), ("ros1", "bz2"), ("mcap", ""), ("mcap", "storage")]
)
@pytest.mark.parametrize("share", [0.45, 0.7, 0.97])
def test_truncated_bag_gives_what_is_whole(tmp_path: Path, kind: str, compression: str, share: float) -> None:
    """What is read is the beginning of the run, with every message in it, and a line that says so."""
    whole, suffix = whole_file(kind, compression), "bag" if kind == "ros1" else "mcap"
    cut = tmp_path / f"cut.{suffix}"
    cut.write_bytes(whole[: int(share * len(whole))])
    recording = read_recording(cut, vessel())
    assert recording.imu is not None
    n = len(recording.imu)
    assert 1000 < n <= 7500
    np.testing.assert_array_equal(recording.imu.stamps_ns, START_NS + np.arange(n) * (S // 50))
    assert len(recording.measurements) == pytest.approx(n / 10, abs=1)
    assert recording.message_count == accounted(recording)
    (line,) = recording.warnings
    assert "cut.bag: damaged or cut short" in line or "cut.mcap: damaged or cut short" in line
    assert f"of {int(share * len(whole))}" in line
    assert ("rosbag reindex" if kind == "ros1" else "mcap recover") in line


@pytest.mark.parametrize("given", ["run.bag.active", "."])
def test_what_a_recorder_leaves_that_was_cut_off_is_read(given: str, tmp_path: Path) -> None:
    """A file, or the folder that it lies in. Its header tells of no index yet, and nothing but chunks follows."""
    whole = whole_file("ros1", "")
    at = whole.index(b"index_pos=") + len(b"index_pos=")
    left = whole[:at] + bytes(8) + whole[at + 8 : int(0.7 * len(whole))]
    (tmp_path / "run.bag.active").write_bytes(left)
    recording = read_recording(tmp_path / given, vessel())
    assert recording.imu is not None
    n = len(recording.imu)
    assert 1000 < n <= 7500
    np.testing.assert_array_equal(recording.imu.stamps_ns, START_NS + np.arange(n) * (S // 50))
    assert any(
        "run.bag.active: damaged or cut short" in line and "rosbag reindex" in line for line in recording.warnings
    )


@pytest.mark.parametrize(("cut", "warned"), [(0, False), (3000, True)])
def test_an_mcap_file_that_a_tool_has_merged_is_read(cut: int, warned: bool, tmp_path: Path) -> None:
    """Its profile is empty; the messages are those of ROS 2."""
    whole = whole_file("mcap", "")
    head, said = len(b"\x89MCAP0\r\n") + 9, b"\x04\0\0\0ros2"
    assert whole[head : head + len(said)] == said
    merged = tmp_path / "merged.mcap"  # as long: what wrote it has a name that is four letters longer
    (named,) = struct.unpack("<I", whole[head + 8 : head + 12])
    library = whole[head + 12 : head + 12 + named]
    data = whole[:head] + bytes(4) + struct.pack("<I", named + 4) + library + b"more" + whole[head + 12 + named :]
    merged.write_bytes(data[: len(data) - cut])
    recording = read_recording(merged, vessel())
    (tmp_path / "same.mcap").write_bytes(whole[: len(data) - cut])
    assert len(recording.measurements) == len(read_recording(tmp_path / "same.mcap", vessel()).measurements) > 0
    assert any("cut short" in w for w in recording.warnings) == warned


@pytest.mark.parametrize(
    ("encoding", "says"), [(b"ros1msg", "give the one that it was made of"), (b"flatbuf", "mcap filter")]
)
def test_an_mcap_file_of_others_is_refused_with_the_cause(encoding: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "others.mcap"
    path.write_bytes(whole_file("mcap", "").replace(b"ros2msg", encoding))
    with pytest.raises(InputError) as error:
        read_recording(path, vessel())
    one_line(error, path.name, says)


def test_an_mcap_file_whose_summary_is_damaged_is_no_file_of_others(tmp_path: Path) -> None:
    """A bit of an encoding's name, which stands there twice: what the data section says counts."""
    data = bytearray(whole_file("mcap", ""))
    data[data.rindex(b"ros2msg")] ^= 1
    path = tmp_path / "bit.mcap"
    path.write_bytes(data)
    recording = read_recording(path, vessel())
    assert recording.imu is not None
    assert len(recording.imu) == 7500
    (line,) = recording.warnings
    assert "bit.mcap: damaged or cut short" in line


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_truncated_before_the_first_message(tmp_path: Path, kind: str) -> None:
    make = Messages(1 if kind == "ros1" else 2)
    name = "run.bag" if kind == "ros1" else "run"
    path = write_bag(tmp_path / name, make, still_run(make), kind)
    whole = (path if kind == "ros1" else path / "run.mcap").read_bytes()
    cut = tmp_path / ("cut.bag" if kind == "ros1" else "cut.mcap")
    for share in (0.1, 0.5):
        cut.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError) as error:
            read_recording(cut, vessel())
        one_line(error, cut.name, "rosbag reindex" if kind == "ros1" else "mcap recover")


def test_truncated_sqlite_is_one_line(tmp_path: Path) -> None:
    whole = (write_bag(tmp_path / "run", MAKE, still_run(MAKE)) / "run.db3").read_bytes()
    (tmp_path / "cut.db3").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / "cut.db3", vessel())
    one_line(error, "cut.db3", "ros2 bag reindex")


def test_one_truncated_file_of_a_split_bag(tmp_path: Path) -> None:
    """The folder's other files are read whole."""
    make = Messages(2)
    folder = write_bag(tmp_path / "run", make, still_run(make, 60.0), "mcap")
    more = write_bag(tmp_path / "more", make, still_run(make, 60.0, START_NS + 60 * S), "mcap")
    data = (more / "more.mcap").read_bytes()
    (folder / "run_1.mcap").write_bytes(data[: int(0.97 * len(data))])
    (folder / "metadata.yaml").unlink()
    recording = read_recording(folder, vessel())
    assert recording.imu is not None
    assert 3000 < len(recording.imu) < 6000
    assert any("run_1.mcap: damaged or cut short" in w for w in recording.warnings)
    assert recording.message_count == accounted(recording)


def test_damage_in_the_middle_keeps_what_came_before(tmp_path: Path) -> None:
    """A chunk whose bytes are wrong; the index, at the end, is whole and announces all messages."""
    make = Messages(1)
    path = write_bag(tmp_path / "run.bag", make, still_run(make, 120.0), "ros1", "lz4")
    damage_last_chunk(path)
    recording = read_recording(path, vessel())
    assert recording.imu is not None
    assert 100 < len(recording.imu) < 6000
    assert any("damaged after" in w for w in recording.warnings)
    lost = {r.topic: r.count for r in recording.rows if r.outcome is Outcome.MALFORMED}
    assert lost["/imu"] == 6000 - len(recording.imu)
    assert recording.message_count == accounted(recording) == 6600


# missing topic, wrong and unknown types


def test_missing_topic_names_the_nearest(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run", MAKE, still_run(MAKE))
    with pytest.raises(InputError) as error:
        read_recording(path, vessel(gnss={"topic": "/fixx"}))
    one_line(error, str(path), "sensors.gnss.topic", "'/fixx'", "nearest: /fix")
    with pytest.raises(InputError) as error:
        read_recording(path, vessel(gnss={"topic": ""}))
    one_line(error, "sensors.gnss.topic", "fitting type: /fix")
    with pytest.raises(InputError) as error:
        read_recording(path, vessel(check_speed_topic="/odom"))
    one_line(error, "check_speed_topic", "/odom", "no topic holds nav_msgs/Odometry")


def test_wrong_type_names_both(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run", MAKE, still_run(MAKE))
    with pytest.raises(InputError) as error:
        read_recording(path, vessel(gnss={"topic": "/imu"}))
    one_line(error, "'/imu' holds sensor_msgs/Imu", "must hold sensor_msgs/NavSatFix", "fitting type: /fix")


def test_bytes_that_are_no_message(tmp_path: Path) -> None:
    items = [*still_run(MAKE), ("/fix", START_NS + S, ("sensor_msgs/msg/NavSatFix", b"\0\1\0\0short"))]
    recording = read(tmp_path, items)
    (row,) = rows_of(recording, "gnss")
    assert row.outcome is Outcome.MALFORMED
    assert row.topic == "/fix"
    assert "run" in row.reason
    assert "2023-11-14T22:13:21" in row.reason  # START_NS + 1 s
    assert len(recording.measurements) == 20


# values


def test_a_definition_of_transforms_that_is_damaged(tmp_path: Path) -> None:
    """The bytes of a field's name were hit: the message is read, and its transform is not in it."""
    make = Messages(1)
    static = make.transforms([("base_link", "gps", (1, 2, 0), (0, 0, 0, 1))])
    path = write_bag(tmp_path / "run.bag", make, [("/tf_static", START_NS, static), *still_run(make)], "ros1")
    content = path.read_bytes()
    assert b"Transform transform" in content
    path.write_bytes(content.replace(b"Transform transform", b"Transform trXnsform"))
    with pytest.raises(InputError, match=r"gnss\.mount\.tf_frame: no chain from 'base_link' to 'gps'"):
        read_recording(path, vessel(gnss={"topic": "/fix", "mount": {"tf_frame": "gps"}}))
    recording = read_recording(path, vessel())
    assert recording.message_count == accounted(recording) == 221


def test_a_definition_of_transforms_that_says_something_else(tmp_path: Path) -> None:
    """By the bag's own definition `transforms` is a number: such messages are counted as damaged, and all else is read."""
    make, path = Messages(1), tmp_path / "run.bag"
    with Writer(path) as writer:
        static = writer.add_connection(
            "/tf_static", "tf2_msgs/msg/TFMessage", msgdef="int32 transforms", md5sum="0" * 32
        )
        writer.write(static, START_NS, bytes(4))
        topics: dict[str, Any] = {}
        for topic, at_ns, msg in still_run(make):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, msg.__msgtype__, typestore=make.store)
            writer.write(topics[topic], at_ns, make.store.serialize_ros1(msg, msg.__msgtype__))
    assert "/tf_static: messages that cannot be decoded: 1" in inspect_bag(path).warnings
    with pytest.raises(InputError, match=r"no chain from 'base_link' to 'gps'.*cannot be decoded: 1"):
        read_recording(path, vessel(gnss={"topic": "/fix", "mount": {"tf_frame": "gps"}}))


def test_nan_and_zero_covariance(tmp_path: Path) -> None:
    items = still_run(MAKE)
    stamp = START_NS + 5 * S
    items.append(("/fix", stamp, MAKE.fix(stamp, covariance=np.full(9, np.nan))))
    items.append(("/fix", stamp + S, MAKE.fix(stamp + S, covariance=np.zeros(9))))
    recording = read(tmp_path, items)
    assert rows_of(recording, "gnss") == []
    for fix in recording.measurements[-2:]:
        assert isinstance(fix, GnssPosition)
        np.testing.assert_allclose(fix.cov_enu_m2, np.diag([1.5**2, 1.5**2, 4.0**2]))


def test_nan_values(tmp_path: Path) -> None:
    items = still_run(MAKE)
    stamp = START_NS + 5 * S
    items.append(("/imu", stamp, MAKE.imu(stamp, accel=(0, np.nan, 9.8))))
    items.append(("/fix", stamp, MAKE.fix(stamp, lat=np.nan)))
    recording = read(tmp_path, items)
    for sensor in ("imu", "gnss"):
        (row,) = rows_of(recording, sensor)
        assert (row.outcome, row.stamp_ns) == (Outcome.MALFORMED, stamp)
        assert "NaN" in row.reason
        assert "run" in row.reason


def test_no_fix_is_no_fix(tmp_path: Path) -> None:
    stamps = [START_NS + k * S // 5 for k in range(10)]
    items = [("/fix", t, MAKE.fix(t, status=-1 if k < 4 else 0)) for k, t in enumerate(stamps)]
    recording = read(tmp_path, items, imu=None)
    assert len(recording.measurements) == 6
    assert [r.outcome for r in rows_of(recording, "gnss")] == [Outcome.REJECTED] * 4


def test_a_sensor_that_gives_nothing_is_reported(tmp_path: Path) -> None:
    items = [("/fix", START_NS + k * S, MAKE.fix(START_NS + k * S, status=-1)) for k in range(5)]
    recording = read(tmp_path, items, imu=None)
    assert any("gnss: none of the 5 messages on /fix" in w and "NO_FIX" in w for w in recording.warnings)


def test_poses_on_a_map_grid(tmp_path: Path) -> None:
    """UTM northings: the solver was at it for two minutes, and failed. Without fixes any plane will do."""
    make = Messages(2)
    items: list[Item] = []
    for k in range(40):
        stamp = START_NS + k * S
        items += [("/fix", stamp, make.fix(stamp)), ("/pose", stamp, make.pose(stamp, (672_000.0, 6_398_000.0, 40.0)))]
    items.append(("/pose", START_NS + 40 * S, make.pose(START_NS + 40 * S, (3.0, 4.0, 40.0))))
    path = write_bag(tmp_path / "run", make, items, "mcap")
    recording = read_recording(path, vessel(imu=None, gnss={"topic": "/fix"}, pose={"topic": "/pose"}))
    assert Counter(row.outcome for row in rows_of(recording, "pose")) == {Outcome.REJECTED: 40}
    assert sum(isinstance(m, PoseFix) for m in recording.measurements) == 1
    assert any("pose: 40 messages rejected" in w and "map grid (UTM)" in w for w in recording.warnings)
    alone = read_recording(path, vessel(imu=None, gnss=None, pose={"topic": "/pose"}))
    assert sum(isinstance(m, PoseFix) for m in alone.measurements) == 41


def test_fixes_at_null_island_and_far_away(tmp_path: Path) -> None:
    items = still_run(MAKE)
    for k, (lat, lon) in enumerate([(0.0, 0.0), (59.7, 11.9)]):
        stamp = START_NS + (5 + k) * S
        items.append(("/fix", stamp, MAKE.fix(stamp, lat=lat, lon=lon)))
    recording = read(tmp_path, items)
    null, far = rows_of(recording, "gnss")
    assert null.outcome is far.outcome is Outcome.REJECTED
    assert "0, 0" in null.reason
    assert "100 km" in far.reason
    assert len(recording.measurements) == 20


def test_a_run_may_lead_far_away() -> None:
    """3 h at 30 m/s: of 324 km the first and the last hour were over 100 km from the middle, and lost. A ferry lands 300 km on after a pause."""
    t_s = np.r_[0.0:10_800.0:10.0, 16_000.0:17_000.0:10.0]
    km = np.where(t_s < 10_800.0, 0.03 * t_s, 624.0)
    lla = np.column_stack([50.0 + km / 111.2, np.full(len(km), 10.0), np.full(len(km), 40.0)])
    astray = np.zeros(len(km), dtype=bool)
    astray[[0, 1, 2, 500, 1100]] = True  # a receiver that begins elsewhere, single fixes, and one beside the berth
    lla[astray, 1] = 14.0
    assert (far_fixes_of((t_s * 1e9).astype(np.int64), lla) == astray).all()


def test_compass_with_nan_roll_and_pitch(tmp_path: Path) -> None:
    nan = float("nan")
    stamps = [START_NS + k * S for k in range(4)]
    quats = [(nan, nan, 0.0, 1.0), (nan, nan, nan, nan), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)), (nan, nan, 1.0, 0.0)]
    items = [("/heading", t, MAKE.compass(t, q)) for t, q in zip(stamps, quats, strict=True)]
    recording = read(tmp_path, items, imu=None, gnss=None, compass={"topic": "/heading"})
    yaws = [m.yaw_rad for m in recording.of(CompassHeading)]
    np.testing.assert_allclose(np.abs(yaws), [0.0, np.pi / 2, np.pi])
    (row,) = rows_of(recording, "compass")
    assert (row.outcome, row.stamp_ns) == (Outcome.MALFORMED, stamps[1])


# stamps


def test_zero_stamps(tmp_path: Path) -> None:
    recording = read(tmp_path, [*still_run(MAKE), ("/imu", START_NS + S // 3, MAKE.imu(0))])
    (row,) = rows_of(recording, "imu")
    assert (row.outcome, row.stamp_ns) == (Outcome.MALFORMED, 0)
    assert "header stamp is zero" in row.reason


def test_repeated_and_backward_imu_stamps(tmp_path: Path) -> None:
    items = still_run(MAKE)
    repeated, backward = START_NS + S, START_NS + 2 * S
    items.append(("/imu", repeated + LATER_NS + 1, MAKE.imu(repeated)))
    items.append(("/imu", backward + LATER_NS + 1, MAKE.imu(backward - S // 2)))
    recording = read(tmp_path, items)
    assert recording.imu is not None
    assert len(recording.imu) == 200
    assert sorted(r.stamp_ns for r in rows_of(recording, "imu")) == [repeated, backward - S // 2]
    assert all(r.outcome is Outcome.REJECTED and "repeated or backward" in r.reason for r in rows_of(recording, "imu"))
    assert any("2 messages rejected" in w for w in recording.warnings)
    (second,) = (r.seq for r in rows_of(recording, "imu") if r.stamp_ns == repeated)
    (first,) = recording.imu.seqs[recording.imu.stamps_ns == repeated]
    assert first < second  # of repeated stamps the first arrival stays


def test_imu_samples_that_come_late_are_sorted_in(tmp_path: Path) -> None:
    """One in ten comes 50 ms late, one twice; of another clock, between two samples, one is none of the run's."""
    items: list[Item] = []
    for k in range(200):
        stamp = START_NS + k * S // 50
        way_ns = S // 20 if k % 10 == 3 else 0
        items.append(("/imu", stamp + LATER_NS + way_ns, MAKE.imu(stamp, gyro=(1e-6 * k, 0.0, 0.0))))
    twice, between = START_NS + 13 * S // 50, START_NS + 61 * S // 100
    items.append(("/imu", twice + LATER_NS + S, MAKE.imu(twice)))
    items.append(("/imu", between + LATER_NS + S, MAKE.imu(between)))
    recording = read_recording(write_bag(tmp_path / "run", MAKE, items), vessel(gnss=None))
    assert recording.imu is not None
    np.testing.assert_array_equal(recording.imu.stamps_ns, START_NS + np.arange(200) * S // 50)
    np.testing.assert_allclose(recording.imu.gyro_radps[:, 0], 1e-6 * np.arange(200), atol=1e-12)
    assert (np.diff(recording.imu.seqs) < 0).sum() == 20  # numbered as they arrived
    assert sorted(r.stamp_ns for r in rows_of(recording, "imu")) == [twice, between]


def test_samples_that_come_after_later_ones_at_the_very_start_are_sorted_in(tmp_path: Path) -> None:
    """They were rejected, and the fix at their time with them."""
    items = still_run(MAKE)
    first = [i for i, (topic, _, _) in enumerate(items) if topic == "/imu"][:2]
    for i in first:
        items[i] = (items[i][0], items[i][1] + S // 10, items[i][2])
    items.append(("/imu", START_NS + S, MAKE.imu(START_NS - 5 * S)))  # of before the run
    recording = read(tmp_path, items)
    assert recording.imu is not None
    assert (len(recording.imu), len(recording.measurements)) == (200, 20)
    assert int(recording.imu.stamps_ns[0]) == START_NS


def test_one_stamp_that_ran_ahead_costs_one_sample(tmp_path: Path) -> None:
    """Keeping each sample that is later than the last kept one would lose three seconds here."""
    items = still_run(MAKE)
    items.append(("/imu", START_NS + S + LATER_NS + 1, MAKE.imu(START_NS + 4 * S)))
    recording = read(tmp_path, items)
    assert recording.imu is not None
    assert len(recording.imu) == 200
    assert [r.stamp_ns for r in rows_of(recording, "imu")] == [START_NS + 4 * S]


def test_the_longest_increasing_run_is_kept() -> None:
    """Against all subsets of short random sequences."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        stamps = rng.integers(0, 8, size=rng.integers(1, 9))
        keep = longest_increasing(stamps)
        assert (np.diff(stamps[keep]) > 0).all()
        subsets = (np.array([m >> i & 1 for i in range(len(stamps))], dtype=bool) for m in range(1, 2 ** len(stamps)))
        assert keep.sum() == max(s.sum() for s in subsets if (np.diff(stamps[s]) > 0).all())


def test_repeated_fixes_are_no_new_evidence_but_two_at_one_stamp_are(tmp_path: Path) -> None:
    items = still_run(MAKE)
    items.append(("/fix", START_NS + LATER_NS + 1, MAKE.fix(START_NS)))  # the same again
    items.append(("/fix", START_NS + LATER_NS + 2, MAKE.fix(START_NS, lat=57.70001)))  # another one
    recording = read(tmp_path, items)
    (row,) = rows_of(recording, "gnss")
    assert "repeated message" in row.reason
    assert [m.stamp_ns for m in recording.measurements[:3]] == [START_NS, START_NS, START_NS + S // 5]
    assert recording.measurements[0].seq < recording.measurements[1].seq


@pytest.mark.parametrize("jump_s", [3600, -3600, 400_000_000, -1_600_000_000])
def test_clock_jump_of_single_stamps(tmp_path: Path, jump_s: int) -> None:
    items = still_run(MAKE)
    for topic, make in (("/imu", MAKE.imu), ("/fix", MAKE.fix)):
        items.append((topic, START_NS + S + 1, make(START_NS + S + jump_s * S)))
    recording = read(tmp_path, items)
    for sensor in ("imu", "gnss"):
        (row,) = rows_of(recording, sensor)
        assert (row.outcome, row.stamp_ns) == (Outcome.REJECTED, START_NS + S + jump_s * S)
        assert "clock jump" in row.reason
    assert recording.imu is not None
    assert len(recording.imu) == 200
    assert len(recording.measurements) == 20


def test_the_computer_clock_is_set_during_the_run(tmp_path: Path) -> None:
    """Two seconds in 1970, then four in the present: the longer part is the run, the rest is said."""
    items = still_run(MAKE, seconds=2.0, start_ns=100 * S) + still_run(MAKE)
    recording = read(tmp_path, items)
    assert recording.imu is not None
    assert (len(recording.imu), len(recording.measurements)) == (200, 20)
    assert len(rows_of(recording, "imu")) == 100
    assert all("busiest part" in r.reason for r in recording.rows)
    assert any("imu: 100 messages rejected" in w for w in recording.warnings)


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_recorder_whose_clock_is_set_loses_nothing(share: float, tmp_path: Path) -> None:
    """Stamps of the lesser part were 'clock jumps'; of two equal parts, all were. What is late for a while, and one wrong stamp, are not."""
    items = [(topic, at - (3600 * S if at < START_NS + share * 4 * S else 0), m) for topic, at, m in still_run(MAKE)]
    items.append(("/imu", START_NS + 3 * S + 1, MAKE.imu(START_NS + 3 * S + 500 * S)))
    recording = read(tmp_path, items)
    assert recording.imu is not None
    assert (len(recording.imu), len(recording.measurements)) == (200, 20)
    assert [r.reason.partition(":")[0] for r in rows_of(recording, "imu")] == ["clock jump"]
    assert [w.partition(" at ")[0] for w in recording.warnings if "recorder" in w] == [
        "the recorder's clock was set by +3600 s"
    ]
    assert not any("time_offset_s" in w for w in recording.warnings)
    stamps_ns = np.arange(0, 400 * S, S)
    stalled_ns = np.where((stamps_ns > 100 * S) & (stamps_ns < 200 * S), 200 * S, stamps_ns)
    assert steady_logs(stamps_ns, stalled_ns) is stalled_ns
    found = inspect_bag(tmp_path / "run")
    assert found.gnss[0].fixes == 20
    assert sum("the recorder's clock was set by +3600 s" in w for w in found.warnings) == 1
    assert [abs(t.latency_s[0]) < 0.1 for t in found.topics if t.latency_s] == [True, True]
    assert "time_offset_s" not in draft_config(found)


@pytest.mark.parametrize(("by_s", "sigma_s", "doubted"), [(0.4, 0.05, True), (0.4, 0.25, False), (0.12, 0.05, False)])
def test_a_clock_that_ntp_sets_by_less_than_a_second_leaves_no_pose_good(
    by_s: float, sigma_s: float, doubted: bool, tmp_path: Path
) -> None:
    """It stamps and records the IMU's samples; the receiver has a clock of its own. All was called good, 1 m off at 4 m/s, and when was not said."""
    set_ns = START_NS + 20 * S
    items = [
        (
            topic,
            at + int(by_s * S) * (at >= set_ns),
            MAKE.imu(at + int(by_s * S)) if topic == "/imu" and at >= set_ns else m,
        )
        for topic, at, m in still_run(MAKE, seconds=40.0)
    ]
    recording = read(tmp_path, items, gnss={"topic": "/fix", "stamp_sigma_s": sigma_s})
    (line,) = (w for w in recording.warnings if "no time_offset_s holds throughout" in w)
    assert line.startswith("gnss: its clock loses ")
    assert f"all of it at {utc_text(set_ns)[:19]}" in line
    assert "use the part on one side (--start, --duration)" in line
    assert recording.clock_doubts == ((line,) if doubted else ())


def test_a_sensor_in_another_epoch_is_reported_and_not_fixed(tmp_path: Path) -> None:
    """GPS time without leap seconds: 18 s ahead of UTC."""
    items = []
    for topic, log_ns, msg in still_run(MAKE):
        items.append((topic, log_ns, MAKE.fix(log_ns - LATER_NS + 18 * S) if topic == "/fix" else msg))
    recording = read(tmp_path, items)
    assert recording.measurements[0].stamp_ns == START_NS + 18 * S
    (line,) = recording.warnings
    assert "gnss: its clock is 18.000 s ahead of that of imu" in line
    assert "set its time_offset_s to -18.000 (" in line
    path = tmp_path / "run"
    assert read_recording(path, vessel(gnss={"topic": "/fix", "time_offset_s": -18.0})).warnings == ()
    (line,) = read_recording(path, vessel(gnss={"topic": "/fix", "time_offset_s": -50.0})).warnings
    assert "gnss: its clock is 32.000 s behind" in line
    assert "set its time_offset_s to -18.000 instead of -50 (" in line


@pytest.mark.parametrize(("late_s", "warns"), [(1.3, False), (2.0, False), (5.0, True)])
def test_stamps_that_are_set_earlier_are_no_clock_that_is_behind(late_s: float, warns: bool, tmp_path: Path) -> None:
    """A receiver that filters its velocity stamps it 1.3 s late, a radio link 2 s, as `inspect` drafted; the advice was to undo that."""
    items = still_run(MAKE)
    recording = read(tmp_path, items, gnss={"topic": "/fix", "time_offset_s": -late_s})
    assert any("its clock is" in w for w in recording.warnings) == warns


def test_an_imu_whose_stamps_are_set_far_off_is_said(tmp_path: Path) -> None:
    """A typing error of 5 s in the IMU's offset moves it away from all others: these were taken to be as meant."""
    recording = read(tmp_path, still_run(MAKE), imu={"topic": "/imu", "time_offset_s": 5.0})
    assert any("gnss: its clock is 5.000 s behind that of imu" in w for w in recording.warnings)


@pytest.mark.parametrize(("xyz_m", "far"), [([1.5, 0.0, 0.8], ""), ([150.0, 0.0, 80.0], "170 m")])
def test_a_mount_in_centimetres_is_said(tmp_path: Path, xyz_m: list[float], far: str) -> None:
    recording = read(tmp_path, still_run(MAKE), gnss={"topic": "/fix", "mount": {"xyz_m": xyz_m}})
    assert [w for w in recording.warnings if "mount.xyz_m" in w] == [
        f"gnss: by mount.xyz_m it sits {far} from the origin of body: metres are meant; right on a ship only"
    ] * bool(far)


# units, gravity, swapped axes


@pytest.mark.parametrize(
    ("accel", "gyro", "block", "words"),
    [
        ((0.01, 0, 0.02), (0, 0, 0), {}, "gravity: removed"),
        ((0, 0, 9.8), (0, 0, 0), {"gravity": "removed"}, "gravity: included"),
        ((0, 0, 9.8), (0.1, -0.1, 5.0), {}, "gyro_unit: deg/s"),  # it may pivot
        ((0, 0, 4.0), (0, 0, 0), {}, "not about 9.8"),
        ((0, 9.8, 9.8), (0, 0, 0.1), {}, "not about 9.8"),
        ((0, 9.8, 9.8), (0, 0, 0.4), {}, ""),  # tight circles at 25 m/s
        ((0, 0, 9.8), (0, 0, 0.2), {}, ""),
        ((0, 0, 1.0), (0, 0, 0), {"accel_unit": "g"}, ""),
        ((0.01, 0, 0.02), (0, 0, 0), {"gravity": "removed"}, ""),
    ],
)
def test_wrong_units_and_gravity(tmp_path: Path, accel: Any, gyro: Any, block: dict[str, str], words: str) -> None:
    recording = read(tmp_path, constant_imu(accel, gyro), gnss=None, imu={"topic": "/imu", **block})
    if words:
        (line,) = recording.warnings
        assert words in line
    else:
        assert recording.warnings == ()


@pytest.mark.parametrize("unit", ["m/s^2", "g"])
def test_a_gait_is_no_wrong_unit(unit: str, tmp_path: Path) -> None:
    """The body turns least at one phase of each step: the median there, 7 m/s^2, was said to be no gravity."""
    items: list[Item] = []
    for k in range(500):
        t, step = START_NS + k * S // 50, np.sin(2.0 * np.pi * 1.9 * k / 50.0)
        felt = (9.8 + 3.5 * step) / (9.8 if unit == "g" else 1.0)
        items.append(("/imu", t, MAKE.imu(t, accel=(0.0, 0.0, felt), gyro=(0.0, 0.0, 0.2 * (1.0 + step)))))
    assert read(tmp_path, items, gnss=None, imu={"topic": "/imu", "accel_unit": unit}).warnings == ()


def constant_imu(accel: Any, gyro: Any) -> list[Item]:
    items: list[Item] = []
    for k in range(100):  # its last bits vary, as those of a sensor that is not frozen
        t = START_NS + k * S // 50
        items.append(("/imu", t, MAKE.imu(t, accel=accel, gyro=(gyro[0], gyro[1], gyro[2] + 1e-6 * (k % 2)))))
    return items


@pytest.mark.parametrize(("size", "said", "unit"), [(1.0, "m/s^2", "g"), (9.8, "g", "m/s^2")])
def test_accelerations_in_another_unit_are_refused(size: float, said: str, unit: str, tmp_path: Path) -> None:
    """Solved as they are, they took 80 s for a run of 150 s, and laid the vessel on its side."""
    with pytest.raises(InputError) as error:
        read(tmp_path, constant_imu((0, 0, size), (0, 0, 0)), gnss=None, imu={"topic": "/imu", "accel_unit": said})
    one_line(error, f"looks like {unit}; set accel_unit: {unit} of sensors.imu")


@pytest.mark.parametrize("up", [(0.0, 0.0, 9.8), (0.0, -9.8, 0.0), (0.0, 0.0, 1.0)])
def test_rates_in_degrees_are_refused_at_once(tmp_path: Path, up: tuple[float, float, float]) -> None:
    """Rolling by 1 deg at 0.25 Hz: 1.6 deg/s at most, which is no rate in rad/s; about the vertical it may turn as it likes."""
    unit = "m/s^2" if np.linalg.norm(up) > 5.0 else "g"
    for scale, name in ((1.0, "rad"), (57.3, "deg")):
        items: list[Item] = []
        for k in range(500):
            t, rate = START_NS + k * S // 50, scale * 0.027 * np.cos(1.57 * k / 50)
            turn = scale * 0.6 * np.array(up) / np.linalg.norm(up)
            items.append(("/imu", t, MAKE.imu(t, accel=up, gyro=turn + rate * np.array([1.0, 0.0, 0.0]))))
        path = write_bag(tmp_path / name, MAKE, items, "mcap")
        if name == "rad":
            assert read_recording(path, vessel(gnss=None, imu={"topic": "/imu", "accel_unit": unit})).imu is not None
            continue
        with pytest.raises(InputError) as error:
            read_recording(path, vessel(gnss=None))
        one_line(error, "looks like deg/s", "set gyro_unit: deg/s of sensors.imu")
        right = {"topic": "/imu", "accel_unit": unit, "gyro_unit": "deg/s"}
        assert read_recording(path, vessel(gnss=None, imu=right)).imu is not None


def carried(scale: float) -> list[Item]:
    """An IMU that is tilted by up to a radian about all axes within seconds: a camera in the hand, a craft in aerobatics."""
    rng, items, hz = np.random.default_rng(5), list[Item](), 100
    t = np.arange(1500) / hz
    rates = np.column_stack([1.9 * np.sin(2.1 * t + 1.0), 1.7 * np.sin(1.3 * t), 1.5 * np.cos(1.7 * t)])
    attitude = Rotation.identity()
    for k, rate in enumerate(rates):
        at, felt = START_NS + k * S // hz, attitude.inv().apply([0.0, 0.0, 9.81])
        items.append(("/imu", at, MAKE.imu(at, (felt + rng.normal(0, 1.0, 3)).tolist(), (scale * rate).tolist())))
        attitude = attitude * Rotation.from_rotvec(rate / hz)
    return items


@pytest.mark.parametrize("refused", [False, True], ids=["rad/s", "deg/s"])
def test_fast_rates_that_turn_gravity_as_they_say_are_in_radians(refused: bool, tmp_path: Path) -> None:
    """A camera in the hand was refused, and `inspect` drafted deg/s for it."""
    path = write_bag(tmp_path / "run", MAKE, carried(180.0 / np.pi if refused else 1.0), "mcap")
    assert inspect_bag(path).imus[0].gyro_unit == ("deg/s" if refused else "rad/s")
    with pytest.raises(InputError, match="looks like deg/s") if refused else nullcontext():
        recording = read_recording(path, vessel(gnss=None))
        assert not any("deg/s" in w for w in recording.warnings)


def test_what_tumbles_in_degrees_is_not_in_radians_by_chance() -> None:
    """Rates 57 times the size turn gravity anywhere: of few windows, one craft in twenty fitted."""
    hz, seconds, fitted = 25, 6, 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        rates = 4.0 * np.sin(
            np.arange(hz * seconds)[:, None] / hz * rng.uniform(0.5, 2.0, 3) + rng.uniform(0.0, 6.0, 3)
        )
        attitude, felt = Rotation.identity(), []
        for rate in rates:
            felt.append(attitude.inv().apply([0.0, 0.0, 9.81]) + rng.normal(0.0, 0.5, 3))
            attitude = attitude * Rotation.from_rotvec(rate / hz)
        stamps = np.arange(len(rates)) * S // hz
        fitted += turns_gravity(stamps, np.array(felt), np.degrees(rates))
        assert turns_gravity(stamps, np.array(felt), rates)
    assert fitted == 0


def test_a_small_boat_in_chop_is_not_refused(tmp_path: Path) -> None:
    """Rolling by 14 deg every 1.5 s: 1 rad/s, but not far."""
    items: list[Item] = []
    for k in range(500):
        rate = 0.244 * 4.19 * np.cos(4.19 * k / 50)
        items.append(("/imu", START_NS + k * S // 50, MAKE.imu(START_NS + k * S // 50, gyro=(rate, 0.0, 0.0))))
    assert read_recording(write_bag(tmp_path / "chop", MAKE, items, "mcap"), vessel(gnss=None)).imu is not None


def test_swapped_latitude_and_longitude(tmp_path: Path) -> None:
    """Beyond 90 deg it shows in the message; elsewhere the datum tells."""
    stamps = [START_NS + k * S for k in range(10)]
    items = [("/fix", t, MAKE.fix(t, lat=151.2, lon=-33.9)) for t in stamps]
    recording = read(tmp_path, items, imu=None)
    assert all(r.outcome is Outcome.MALFORMED and "swapped" in r.reason for r in rows_of(recording, "gnss"))
    assert len(rows_of(recording, "gnss")) == 10
    other = tmp_path / "second"
    items = [("/fix", t, MAKE.fix(t, lat=11.9, lon=57.7)) for t in stamps]
    datum = {"latitude_deg": 57.7, "longitude_deg": 11.9}
    warnings = read(other, items, imu=None, datum=datum).warnings
    assert any("latitude and longitude look swapped" in w for w in warnings)


@pytest.mark.parametrize(
    ("sensors", "said"),
    [
        ({}, True),
        ({"pose": {"topic": "/pose", "axes": ["x", "y", "z", "yaw"]}}, False),
        ({"height": {"sigma_m": 0.3}}, False),
        ({"gnss": {"topic": "/fix"}}, False),
    ],
    ids=["nothing", "poses with z", "height", "fixes"],
)
def test_a_height_that_nothing_tells_is_reported(sensors: dict[str, Any], said: bool, tmp_path: Path) -> None:
    """Of poses x, y and yaw are used: a minute of such a run was 90 m high, with 'did not converge' for a reason."""
    make = Messages(2)
    items = still_run(make)
    items += [("/pose", stamp, make.pose(stamp, (0.0, 0.0, 0.0))) for stamp in (START_NS + S, START_NS + 2 * S)]
    bag = write_bag(tmp_path / "run", make, sorted(items, key=lambda item: item[1]))
    config = vessel(**{"gnss": None, "pose": {"topic": "/pose"}, **sensors})
    lines = [w for w in read_recording(bag, config).warnings if "nothing tells the height" in w]
    assert len(lines) == said
    assert all("pose (x, y, yaw)" in line and "kind height" in line for line in lines)


def test_a_bag_of_poses_alone_is_drafted_with_their_height(tmp_path: Path) -> None:
    make = Messages(2)
    items = [item for item in still_run(make) if item[0] != "/fix"]
    items += [
        ("/pose", stamp, make.pose(stamp, (0.01 * k, 0.0, 0.0))) for k in range(30) if (stamp := START_NS + k * S // 10)
    ]
    bag = write_bag(tmp_path / "run", make, sorted(items, key=lambda item: item[1]))
    assert "axes: [x, y, z, yaw]" in draft_config(inspect_bag(bag))
