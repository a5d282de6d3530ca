# SPDX-License-Identifier: Apache-2.0
"""A part of a bag: the same run as from a bag that was recorded for that long only, and no message lost on the way."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapReader

from graphloc import app
from graphloc.cli._shared import BagOptions
from graphloc.errors import InputError
from graphloc.eval.simulate import Scenario
from graphloc.eval.simulate.bag import write_bag as write_simulated
from graphloc.frontends.bag import read_recording
from graphloc.frontends.part import BagPart
from graphloc.frontends.source import Bag, RawMessage
from graphloc.frontends.tags.sightings import sightings_of_bag
from graphloc.ledger import Outcome
from graphloc.recording import Recording, quiet
from tests.bagfactory import START_NS, Item, Messages, S, damage_last_chunk, still_run, write_bag
from tests.commands import called
from tests.slowly import simulate_slowly
from tests.tagimages import IMAGE, INFO, MIDDLE, image, info, picture, tags
from tests.test_bag import accounted, vessel

FIRST_NS = START_NS  # of the bags below: the transforms, 10 ms before the first sample
ON_GPS = {"topic": "/fix", "mount": {"tf_frame": "gps"}}


def run_of(make: Messages) -> list[Item]:
    """10 s at rest, its transforms at the very beginning, a note each second, and bytes that are no message at 1 and 9 s."""
    static = make.transforms([("base_link", "gps", (1, 2, 3), (0, 0, 0, 1))])
    junk: list[Item] = [("/imu", START_NS + at * S + 1, ("sensor_msgs/msg/Imu", b"\x01")) for at in (1, 9)]
    notes: list[Item] = [("/note", START_NS + k * S, make.text("hello")) for k in range(10)]
    return sorted([("/tf_static", FIRST_NS, static), *still_run(make, 10.0), *junk, *notes], key=lambda item: item[1])


def within(items: list[Item], start_s: float, end_s: float) -> list[Item]:
    """What a recorder that ran from then to then would have: the transforms come to whoever asks, whenever."""
    start_ns, end_ns = (FIRST_NS + round(at * S) for at in (start_s, end_s))
    return [i for i in items if i[0] == "/tf_static" or start_ns <= i[1] < end_ns]


def without_chunks(path: Path) -> Path:
    """The same MCAP file as some recorders write it: each message by itself, no index."""
    magic, content, records = b"\x89MCAP0\r\n", path.read_bytes(), []

    def unpack(data: bytes) -> None:
        at = 0
        while at < len(data):
            op, size = struct.unpack_from("<BQ", data, at)
            body, whole = data[at + 9 : at + 9 + size], data[at : at + 9 + size]
            at += 9 + size
            if op == 0x06:  # a chunk: times, size, checksum, compression, records
                (name,) = struct.unpack_from("<I", body, 28)
                assert not name
                unpack(body[40:])
            elif op == 0x0F:  # the end of the data
                return
            elif op in (0x01, 0x03, 0x04, 0x05):
                records.append(whole)

    unpack(content[len(magic) : -len(magic)])
    footer = struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)
    path.write_bytes(magic + b"".join(records) + footer + magic)
    return path


def told(recording: Recording) -> tuple[Any, ...]:
    """All that a recording says, but the names of files."""
    imu = recording.imu
    assert imu is not None
    rows = [(r.seq, r.stamp_ns, r.sensor, r.topic, r.outcome, r.count, r.reason) for r in recording.rows]
    measured = [(m.seq, m.stamp_ns, m.sensor, str(m)) for m in recording.measurements]
    mounts = {name: (t.tolist(), R.tolist()) for name, (t, R) in recording.mounts.items()}
    samples = (imu.stamps_ns.tolist(), imu.seqs.tolist(), imu.accel_mps2.tolist(), imu.gyro_radps.tolist())
    return samples, measured, rows, mounts, recording.warnings, recording.message_count


CASES = [
    ("ros1", "", ".bag"), ("ros1", "lz4", ".bag"), ("sqlite3", "", ""), ("sqlite3", "", ".db3"), ("sqlite3", "file", ""),
    ("sqlite3", "message", ""), ("mcap", "", ""), ("mcap", "", ".mcap"), ("mcap", "storage", ""), ("mcap", "no chunks", ".mcap"),
]  # fmt: skip


def written(folder: Path, items: list[Item], make: Messages, kind: str, compression: str, suffix: str) -> Path:
    """Write a bag; return it as a user would name it: folder or file."""
    folder.mkdir()
    if kind == "ros1":
        return write_bag(folder / "run.bag", make, items, kind, compression)
    path = write_bag(folder / "run", make, items, kind, "" if compression == "no chunks" else compression)
    path = path / f"run{suffix}" if suffix else path
    return without_chunks(path) if compression == "no chunks" else path


@pytest.mark.parametrize(("kind", "compression", "suffix"), CASES)
def test_a_part_is_what_a_bag_of_that_part_would_be(tmp_path: Path, kind: str, compression: str, suffix: str) -> None:
    make = Messages(1 if kind == "ros1" else 2)
    items = run_of(make)
    whole = written(tmp_path / "whole", items, make, kind, compression, suffix)
    for start_s, duration_s in ((3.01, 4.0), (0.0, 5.5), (6.5, None)):
        end_s = 99.0 if duration_s is None else start_s + duration_s
        expected = within(items, start_s, end_s)
        only = written(tmp_path / f"only{start_s}", expected, make, kind, compression, suffix)
        recording = read_recording(BagPart((whole,), start_s, duration_s), vessel(gnss=ON_GPS))
        assert told(recording) == told(read_recording(only, vessel(gnss=ON_GPS)))
        assert recording.message_count == len(expected) == accounted(recording)
        assert recording.span is not None
        for topic in ("/imu", "/fix"):
            inside = sum(i[0] == topic for i in expected)
            assert recording.span.messages[topic] == inside
            assert recording.span.left_out[topic] == sum(i[0] == topic for i in items) - inside
    assert read_recording(BagPart((whole,)), vessel()).span is None


def test_the_ends_are_those_of_recording_times(tmp_path: Path) -> None:
    """Stamps are 10 ms older: a sample recorded just as the part begins is in it, one just as it ends is not."""
    make = Messages(2)
    path = write_bag(tmp_path / "run", make, run_of(make), "mcap")
    recording = read_recording(BagPart((path,), 2.01, 3.0), vessel())  # a sample each 20 ms, from 10 ms on
    assert recording.imu is not None
    assert recording.imu.stamps_ns[0] == START_NS + 2 * S
    assert recording.imu.stamps_ns[-1] == START_NS + 5 * S - S // 50


def decoded_from_now_on(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Recording times of what is decoded; they come in while it is."""
    times: list[int] = []
    decode = Bag.decode

    def watched(bag: Bag, raw: RawMessage) -> object:
        times.append(raw.log_ns)
        return decode(bag, raw)

    monkeypatch.setattr(Bag, "decode", watched)
    return times


def test_what_is_left_out_is_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Messages(1)
    path = write_bag(tmp_path / "run.bag", make, run_of(make), "ros1")
    times = decoded_from_now_on(monkeypatch)
    read_recording(BagPart((path,), 4.0, 2.0), vessel())
    assert len(times) == 2 * (50 + 5)
    assert START_NS + 4 * S <= min(times) <= max(times) < START_NS + 6 * S


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_parts_of_a_split_bag_begin_with_the_earliest(tmp_path: Path, kind: str) -> None:
    make = Messages(1 if kind == "ros1" else 2)
    files = tuple(
        write_bag(tmp_path / f"{k}.bag", make, still_run(make, start_ns=START_NS + 4 * k * S), kind) for k in range(3)
    )
    for given in (files, files[::-1]):
        recording = read_recording(BagPart(given, 3.0, 6.0), vessel())  # of 4 s each: the end of one to that of all
        assert recording.imu is not None
        assert recording.imu.stamps_ns.tolist() == [START_NS + 3 * S + k * S // 50 for k in range(300)]
        assert recording.message_count == accounted(recording) == 330
        assert recording.warnings == ()
        assert recording.span is not None
        assert recording.span.left_out == {"/imu": 300, "/fix": 30}


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_part_of_what_is_whole_of_a_cut_file(tmp_path: Path, kind: str) -> None:
    make = Messages(1 if kind == "ros1" else 2)
    path = write_bag(tmp_path / ("run.bag" if kind == "ros1" else "run"), make, still_run(make, 240.0), kind)
    content = (path if kind == "ros1" else path / "run.mcap").read_bytes()
    cut = tmp_path / f"cut.{'bag' if kind == 'ros1' else 'mcap'}"
    cut.write_bytes(content[: 7 * len(content) // 10])
    recording = read_recording(BagPart((cut,), 20.0, 40.0), vessel())
    assert recording.imu is not None
    assert len(recording.imu) == 2000
    assert recording.message_count == accounted(recording) == 2200
    assert any("cut short" in line for line in recording.warnings)


def test_damage_in_the_part_is_counted(tmp_path: Path) -> None:
    """The index announces what lies in the part; what cannot be read of it is malformed, not left out."""
    make = Messages(1)
    path = write_bag(tmp_path / "run.bag", make, still_run(make, 120.0), "ros1", "lz4")
    damage_last_chunk(path)
    recording = read_recording(BagPart((path,), 10.0), vessel())
    assert recording.imu is not None
    lost = {row.topic: row.count for row in recording.rows if row.outcome is Outcome.MALFORMED}
    assert lost["/imu"] == 50 * 110 - len(recording.imu) > 0
    assert recording.message_count == accounted(recording) == 55 * 110


@pytest.mark.parametrize("more", [7, 16])
def test_a_damaged_index_is_done_without(tmp_path: Path, more: int) -> None:
    """The index of one chunk says that it is longer than there is room for; chunks and messages are whole."""
    make = Messages(2)
    path = write_bag(tmp_path / "run", make, run_of(make), "mcap") / "run.mcap"
    content = bytearray(path.read_bytes())
    with Reader(path) as reader:
        assert isinstance(reader.storage, McapReader)
        chunk = reader.storage.chunks[0]
        at, size = min(chunk.message_index_offsets.values()), chunk.message_index_length // 16 * 16 + more
    content[at + 11 : at + 15] = struct.pack("<I", size)
    path.write_bytes(content)
    recording = read_recording(BagPart((path,), 4.0, 2.0), vessel())
    assert recording.imu is not None
    assert len(recording.imu) == 100
    assert recording.message_count == accounted(recording) == 112  # with ten fixes and two notes
    assert recording.span is not None
    assert recording.span.left_out == {"/imu": 402, "/fix": 40}
    (line,) = recording.warnings
    assert "run.mcap: its index is damaged" in line


def test_lens_and_mount_of_a_camera_are_those_of_the_beginning(tmp_path: Path) -> None:
    """CameraInfo and transforms come once, at the start; the tag is seen in the part, and before."""
    make = Messages(2)
    shown = picture((7, MIDDLE))
    mounted = tags(cameras={"bow": {"topic": IMAGE, "mount": {"tf_frame": "lens"}}})
    static = make.transforms([("base_link", "lens", (1, 0, 0), (0, 0, 0, 1))])
    items: list[Item] = [("/tf_static", START_NS, static), (INFO, START_NS, info(make))]
    items += [(IMAGE, START_NS + k * S, image(make, shown)) for k in range(1, 6)]
    path = write_bag(tmp_path / "run", make, items, "mcap")
    seen = list(sightings_of_bag(BagPart((path,), 2.5, 2.0), "tags", mounted, "base_link", warn=pytest.fail))
    assert [len(each.sightings) for each in seen] == [1, 1]
    assert seen[0].sightings[0].t_body_camera_m.tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("start_s", "duration_s", "said"),
    [
        (-1.0, None, "--start -1: "), (float("nan"), None, "--start nan: "), (float("inf"), None, "--start inf: "),
        (0.0, 0.0, "--duration 0: "), (0.0, -2.0, "--duration -2: "), (0.0, float("nan"), "--duration nan: "),
        (0.0, float("inf"), "--duration inf: "), (6.0001, 1e-12, "run: no message of a topic that vessel.yaml names"),
        (500.0, None, "run: --start 500: the bag is 10.0 s long, from 2023-"), (1e300, None, "the bag is 10.0 s long"),
        (3.0001, 0.001, "run: no message of a topic that vessel.yaml names"),
    ],
)  # fmt: skip
def test_a_part_that_is_none_is_one_line(
    start_s: float, duration_s: float | None, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    make = Messages(2)
    path = write_bag(tmp_path / "run", make, run_of(make), "mcap")
    config = tmp_path / "vessel.yaml"
    config.write_text("sensors: {imu: {kind: imu, topic: /imu}, gnss: {kind: gnss, topic: /fix}}")
    more = [] if duration_s is None else ["--duration", duration_s]
    code = called(monkeypatch, "smooth", path, "-c", config, "-o", tmp_path / "out", "--start", start_s, *more)
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert code == 2
    assert said in line
    assert not (tmp_path / "out").exists()


def test_a_bag_without_messages_has_no_part(tmp_path: Path) -> None:
    make = Messages(2)
    path = write_bag(tmp_path / "run", make, [], "mcap")
    with pytest.raises(InputError, match="no message is in it"):
        read_recording(BagPart((path,), 1.0), vessel())


def copied(source: Path, target: Path, keep: Callable[[str, int], bool]) -> Path:
    """Copy the messages of a ROS 2 bag that `keep`, asked by topic and recording time, wants."""
    with AnyReader([source]) as reader, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        made = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=reader.typestore) for c in reader.connections}
        for connection, log_ns, data in reader.messages():
            if keep(connection.topic, log_ns):
                writer.write(made[connection.id], log_ns, data)
    return target


def first_of(path: Path) -> int:
    with AnyReader([path]) as reader:
        return reader.start_time


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_simulated(
        simulate_slowly(Scenario(duration_s=10.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3),
        tmp_path_factory.mktemp("part") / "bag",
        ros=2,
    )


@pytest.mark.usefixtures("map_alone")
def test_smooth_and_replay_a_part(
    simulated: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both give the track of a bag of that part, to the last digit, and their folders say which part it was."""
    bag, config = simulated
    begin_ns = first_of(bag)
    only = copied(bag, tmp_path / "only", lambda _, at: begin_ns + 3 * S <= at < begin_ns + 9 * S)
    for command in ("smooth", "replay"):
        part, cut = tmp_path / f"{command}-part", tmp_path / f"{command}-only"
        assert called(monkeypatch, command, bag, "-c", config, "-o", part, "--start", 3, "--duration", 6) == 0
        (line,) = (said for said in capsys.readouterr().err.splitlines() if said.startswith(str(bag)))
        assert called(monkeypatch, command, only, "-c", config, "-o", cut) == 0
        assert "part of" not in capsys.readouterr().err
        for name in ("solution.csv", "ledger.csv", "slow.csv"):
            assert (part / name).read_bytes() == (cut / name).read_bytes(), name
        run, other = (json.loads((folder / "run.json").read_text()) for folder in (part, cut))
        assert other["part"] is None
        assert (run["part"]["start_s"], run["part"]["end_s"]) == (3.0, 9.0)
        inside, left_out = run["part"]["messages"]["/imu/data"], run["part"]["left_out"]["/imu/data"]
        assert inside == sum(other["ledger"]["imu"].values())
        assert f"{sum(run['part']['messages'].values())} of " in line
        with AnyReader([bag]) as reader:
            assert inside + left_out == reader.topics["/imu/data"].msgcount
        assert run["warnings"] == other["warnings"]
        page = (part / "report.html").read_text()
        assert "3.0 s to 9.0 s of 10." in page
        assert "run, 3 s to 9 s</h1>" in page


def test_finished_runs_have_no_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    for option in (("--start", 1), ("--duration", 1)):
        assert called(monkeypatch, "summary", tmp_path / "run", "-o", tmp_path / "out", *option) == 2
        assert option[0] in capsys.readouterr().err


def test_scans_of_a_part_are_matched_and_no_others(launch_bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag, config = launch_bag / "run", launch_bag / "vessel.yaml"
    begin_ns = first_of(bag)
    options = BagOptions(bag=[bag], config=config, start=4.0, duration=5.0)
    recording, loaded, where = options.load(quiet)
    scans = [row for row in recording.rows if row.topic.startswith("/mast")]
    with AnyReader([bag]) as reader:
        inside = [
            log for c, log, _ in reader.messages()
            if c.topic.startswith("/mast") and begin_ns + 4 * S <= log < begin_ns + 9 * S
        ]  # fmt: skip
    assert sum(row.count for row in scans) == len(inside)
    decoded = decoded_from_now_on(monkeypatch)
    run = app.smooth_recording(recording, loaded, scans=where)
    assert decoded[: len(inside)] == inside
    assert set(decoded) == set(inside)  # once, or twice where the first track leaves much open
    assert len(inside) == 10
    stamps = [m.stamp_ns for m in run.recording.measurements if m.sensor == "aerial"]
    assert len(stamps) >= 3
    assert begin_ns + 3.5 * S < min(stamps) <= max(stamps) < begin_ns + 9 * S
    counts = run.solution.ledger.counts()
    assert sum(sum(c.values()) for c in counts.values()) == run.recording.message_count
    assert np.isfinite(run.solution.trajectory.p_world_m).all()
