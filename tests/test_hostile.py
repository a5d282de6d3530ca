# SPDX-License-Identifier: Apache-2.0
"""Input that is meant to break things, or so damaged that it might: one line or a row of the ledger, and no more memory than
a recording needs. What the fuzzer (benchmarks/fuzz.py) found has its test here."""

from __future__ import annotations

import ast
import bz2
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import storage_mcap

from graphloc.config import load_config, parse_config
from graphloc.errors import ConfigError, InputError
from graphloc.factors import KINDS
from graphloc.frames import Datum, Geodetic
from graphloc.frontends import _unpack
from graphloc.frontends._recover import recover
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import inspect_bag, render
from graphloc.frontends.lines import Trouble, parse
from graphloc.ledger import Outcome
from graphloc.recording import Recording
from graphloc.solve._standstill import _swell
from tests.bagfactory import START_NS, Item, Messages, S, rows_of, still_run, write_bag

MAKE, MAKE1 = Messages(2), Messages(1)
ROOT = Path(__file__).parent.parent
CONFIG: dict[str, Any] = {"sensors": {"imu": {"topic": "/imu"}, "gnss": {"topic": "/fix"}}}
zstd: Any = storage_mcap.zstd


def read(path: Path, **sensors: Any) -> Recording:
    tree = {"sensors": {**CONFIG["sensors"], **sensors}}
    found = read_recording(path, parse_config(tree, KINDS, "test"))
    imu = 0 if found.imu is None else len(found.imu.stamps_ns)
    assert imu + len(found.measurements) + sum(r.count for r in found.rows) == found.message_count
    return found


# numbers that are finite, and larger than anything


@pytest.mark.parametrize("size", [1e308, -1e20, 1e9])
@pytest.mark.parametrize("sensor", ["imu", "gnss", "vel", "pose", "turn"])
def test_what_nothing_measures_is_a_row(tmp_path: Path, sensor: str, size: float) -> None:
    stamp = START_NS + S
    odd: dict[str, Item] = {
        "imu": ("/imu", stamp + 5, MAKE.imu(stamp + 5, accel=(0.0, size, 9.8))),
        "gnss": ("/fix", stamp + 5, MAKE.fix(stamp + 5, height=size)),
        "vel": ("/vel", stamp, MAKE.twist(stamp, (size, 0.0, 0.0))),
        "pose": ("/pose", stamp, MAKE.pose(stamp, (0.0, size, 0.0))),
        "turn": ("/turn", stamp, MAKE.pose(stamp, (0.0, 0.0, 0.0), (size, 0.0, 0.0, 1.0))),
    }
    items = [
        *still_run(MAKE),
        *(odd[n] for n in ("vel", "pose", "turn")),
        *([odd[sensor]] if sensor in ("imu", "gnss") else []),
    ]
    found = read(
        write_bag(tmp_path / "run", MAKE, items),
        vel={"kind": "gnss_velocity", "topic": "/vel"}, pose={"kind": "pose", "topic": "/pose"},
        turn={"kind": "pose", "topic": "/turn"},
    )  # fmt: skip
    (row,) = rows_of(found, sensor)
    assert row.outcome is Outcome.MALFORMED
    assert "beyond" in row.reason or "km from" in row.reason or "no unit quaternion" in row.reason


@pytest.mark.parametrize("size", [1e308, 1e-320])
def test_covariances_of_any_size_can_be_worked_with(tmp_path: Path, size: float) -> None:
    items = [("/fix", START_NS + k * S, MAKE.fix(START_NS + k * S, covariance=np.full(9, size))) for k in range(3)]
    with np.errstate(all="raise"):
        found = read(write_bag(tmp_path / "run", MAKE, [*still_run(MAKE), *items]))
    cov = np.array([m.cov_enu_m2 for m in found.measurements])  # type: ignore[attr-defined]
    assert cov.max() <= 1e12  # a sigma of 1000 km: nothing is known
    assert np.linalg.eigvalsh(cov).min() >= 1e-18


def test_a_truth_that_is_nowhere_is_left_out(tmp_path: Path) -> None:
    stamps = [START_NS + k * S // 2 for k in range(8)]
    items = [("/truth", t, MAKE.odometry(t, xyz=(1e300 if k == 3 else k, 0, 0))) for k, t in enumerate(stamps)]
    tree = {**CONFIG, "truth_topic": "/truth"}
    path = write_bag(tmp_path / "run", MAKE, [*still_run(MAKE), *items])
    found = read_recording(path, parse_config(tree, KINDS, "test"))
    assert found.truth is not None
    assert len(found.truth.stamps_ns) == 7
    assert np.abs(found.truth.p_world_m).max() == 7.0


# times


def test_stamps_before_time_and_behind_the_end_of_it(tmp_path: Path) -> None:
    items = still_run(MAKE)
    items.append(("/imu", START_NS + S, MAKE.imu(-5 * S)))
    (row,) = rows_of(read(write_bag(tmp_path / "run", MAKE, items)), "imu")
    assert row.outcome is Outcome.MALFORMED
    assert "zero or negative" in row.reason
    late = read(write_bag(tmp_path / "late", MAKE, still_run(MAKE)), imu={"topic": "/imu", "time_offset_s": 4e9})
    assert {row.reason.split(", ")[0] for row in rows_of(late, "imu")} == {"late: no time with time_offset_s on it"}
    with pytest.raises(ConfigError, match="time_offset_s"):
        parse_config({"sensors": {"imu": {"topic": "/imu", "time_offset_s": 1e300}}}, KINDS, "test")


def test_recording_times_at_the_end_of_time(tmp_path: Path) -> None:
    items = [(topic, 2**63 - 2 if k % 7 == 0 else log, m) for k, (topic, log, m) in enumerate(still_run(MAKE))]
    path = write_bag(tmp_path / "run", MAKE, items)
    found = read(path)
    assert found.imu is not None
    assert sum("clock jump" in r.reason for r in found.rows) == pytest.approx(len(items) / 7, abs=2)
    inspect_bag(path)


# bags


def test_topics_that_are_no_names(tmp_path: Path) -> None:
    """sqlite3 holds any type in any column, and damaged pages give what was never written."""
    for column, value in (("name", b"/fix"), ("type", 5)):
        folder = write_bag(tmp_path / column, MAKE, still_run(MAKE))
        (file,) = folder.glob("*.db3")
        with sqlite3.connect(file) as base:
            base.execute(f"UPDATE topics SET {column} = ? WHERE name = '/fix'", (value,))
        base.close()
        for path in (file, folder):
            try:
                read(path)
            except InputError as error:
                assert "\n" not in str(error)  # noqa: PT017


def test_damaged_chunks_of_a_bag_without_index(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run.bag", MAKE1, still_run(MAKE1), "ros1", "lz4")
    content = bytearray(path.read_bytes())
    at = content.index(b"\x04\x22\x4d\x18")  # an LZ4 frame
    content[at + 20 : at + 60] = bytes(40)
    path.write_bytes(content[: len(content) - 200])
    assert recover(path) is None
    with pytest.raises(InputError, match="rosbag reindex"):
        read(path)


def test_chunks_are_not_unpacked_once_for_each_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where recording times are out of order, the messages by time go back and forth between chunks."""
    items = still_run(MAKE1, seconds=40.0)
    logs = np.random.default_rng(0).permutation([log for _, log, _ in items]).tolist()
    shuffled = [(topic, log, m) for (topic, _, m), log in zip(items, logs, strict=True)]
    path = write_bag(tmp_path / "run.bag", MAKE1, shuffled, "ros1", "bz2")
    made = []
    genuine = _unpack.unpacked

    def counting(data: bytes, decompressor: Any, said: int | None = None) -> bytes:
        made.append(len(data))
        return genuine(data, decompressor, said)

    monkeypatch.setattr(_unpack, "unpacked", counting)
    assert read(path).message_count == len(items)
    assert 0 < len(made) <= 5  # of 0.8 MB each


# what would fill memory or disk


@pytest.mark.parametrize(
    ("pack", "decompressor"),
    [(bz2.compress, bz2.BZ2Decompressor), (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor), (zstd.compress, zstd.ZstdDecompressor)],
)  # fmt: skip
def test_unpacking_ends(pack: Callable[[bytes], bytes], decompressor: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    packed = pack(bytes(5 << 20))
    assert len(packed) < 1 << 16
    assert _unpack.unpacked(packed + pack(b"more"), decompressor) == bytes(5 << 20) + b"more"  # frames in a row
    with pytest.raises(ValueError, match="more than"):
        _unpack.unpacked(packed, decompressor, 1 << 20)
    with pytest.raises(ValueError, match="cut short"):
        _unpack.unpacked(packed[:-10], decompressor)
    monkeypatch.setattr(_unpack, "MOST_BYTES", 1 << 20)
    with pytest.raises(ValueError, match="more than"):
        _unpack.unpacked(packed, decompressor)


@pytest.mark.parametrize(
    ("kind", "way"),
    [("ros1", "bz2"), ("ros1", "lz4"), ("mcap", "storage"), ("sqlite3", "message"), ("sqlite3", "file")],
)
def test_bombs_in_bags(tmp_path: Path, kind: str, way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A message that unpacks to more than is believed costs itself, and what is packed with it."""
    make = MAKE1 if kind == "ros1" else MAKE
    bomb = ("/imu", START_NS + 3 * S, ("sensor_msgs/msg/Imu", bytes(30 << 20)))
    path = write_bag(tmp_path / ("run.bag" if kind == "ros1" else "run"), make, [*still_run(make), bomb], kind, way)
    assert read(path).imu is not None
    monkeypatch.setattr(_unpack, "MOST_BYTES", 1 << 20)
    monkeypatch.setattr(_unpack, "_MOST_TIMES", 5)
    _unpack.limit_unpacking()  # without the chunks that are kept
    try:
        found = read(path)
    except InputError as error:
        assert "unpacks to more than" in str(error)  # noqa: PT017
    else:
        assert any("unpacks to more than" in w for w in found.warnings)


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_lengths_that_lie(tmp_path: Path, kind: str) -> None:
    """Any eight bytes of a bag become 2^40 or more: one line, a warning, or nothing at all."""
    make = MAKE1 if kind == "ros1" else MAKE
    path = write_bag(tmp_path / ("run.bag" if kind == "ros1" else "run"), make, still_run(make, 1.0), kind)
    file = path if kind == "ros1" else next(path.glob("*.mcap"))
    content = file.read_bytes()
    for at in np.random.default_rng(0).integers(len(content), size=12).tolist():
        for length in (b"\xff" * 8, (2**40).to_bytes(8, "little")):
            file.write_bytes(content[:at] + length + content[at + 8 :])
            try:
                read(file)
            except InputError as error:
                assert "\n" not in str(error)  # noqa: PT017


# settings


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB + "sensors: {imu: {topic: *j}}", "more than 300000 values"),
        ("sensors: &s\n  imu: {topic: *s}", "more than 300000 values"),
        ("sensors: !!python/object/apply:os.system ['touch escaped']", "not valid YAML"),
        ("sensors: !!python/name:os.system ''", "not valid YAML"),
        ("vessel: !!int ''", "not valid YAML"),
        ("vessel: !!binary aGVsbG8=", "write the value alone"),
        ("vessel: !mine x", "write the value alone"),
        ("a: " + "[" * 100 + "]" * 100, "not valid YAML: nested deeper than 100"),
        ("vessel: " + "x" * 10_000_001, "larger than 10 MB"),
        ("vessel: " + "1" * 6000, "not valid YAML"),
        ("timeline: {rate_hz: 0x" + "f" * 9000 + "}", "vessel.yaml"),
        ("sensors: {imu: {" + ", ".join(f"k{n}: 1" for n in range(30)) + "}}", "and 22 more"),
    ],
)
def test_settings_that_are_meant_to_harm(
    tmp_path: Path, text: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "vessel.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(words)) as caught:
        load_config(path, KINDS)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 4000
    assert [p.name for p in tmp_path.iterdir()] == ["vessel.yaml"]


def test_an_anchor_that_is_there_twice_is_no_word_on_the_screen(tmp_path: Path) -> None:
    """ruamel.yaml warns of it; warnings are errors in these tests."""
    path = tmp_path / "vessel.yaml"
    path.write_text("sensors:\n  imu: {topic: &t /imu}\n  gnss: {topic: &t /fix}\n")
    assert load_config(path, KINDS).sensors["gnss"].topic == "/fix"
    folder = write_bag(tmp_path / "run", MAKE, still_run(MAKE, 1.0))
    metadata = folder / "metadata.yaml"
    metadata.write_text("a: &a 1\nb: &a 2\n" + metadata.read_text())
    assert read(folder).message_count == 55


def test_aliases_are_no_crime(tmp_path: Path) -> None:
    path = tmp_path / "vessel.yaml"
    path.write_text("sensors:\n  imu: {topic: /imu, mount: &m {xyz_m: [1, 2, 3]}}\n  gnss: {topic: /fix, mount: *m}\n")
    assert load_config(path, KINDS).sensors["gnss"].mount.xyz_m == (1.0, 2.0, 3.0)


def test_a_line_with_a_number_of_any_length() -> None:
    config = parse_config(CONFIG, KINDS, "test")
    for where in ('"stamp_ns":%s', '"stamp":"1","lat_deg":%s', '"stamp":%s', '"stamp":"1","accel_mps2":[%s,0,0]'):
        line = '{"type":"gnss",' + where % ("1" + "0" * 5000) + "}"
        found = parse(line.encode(), 1, 0, config)
        assert isinstance(found, Trouble)
        assert len(found.row.reason) <= 200


def test_transforms_without_a_pose(tmp_path: Path) -> None:
    turned = (0.0, 0.0, 0.0, 1.0)
    nan = float("nan")
    edges = [("base_link", "imu_link", (1, 2, 3), turned), ("base_link", "gps", (nan, 0, 0), turned),
             ("base_link", "other", (0, 0, 0), (0, 0, 0, 0))]  # fmt: skip
    items = [("/tf_static", START_NS, MAKE.transforms(edges)), *still_run(MAKE)]
    path = write_bag(tmp_path / "run", MAKE, items)
    found = read(path, imu={"topic": "/imu", "mount": {"tf_frame": "imu_link"}})
    np.testing.assert_allclose(found.mounts["imu"][0], [1, 2, 3])
    with pytest.raises(InputError, match="without a pose, as NaN or no unit quaternion stands there: gps, other"):
        read(path, gnss={"topic": "/fix", "mount": {"tf_frame": "gps"}})
    inspect_bag(path)


# what is not there: nothing of a file is ever run


def _calls(tree: ast.Module) -> list[tuple[int, str, ast.Call]]:
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return [(node.lineno, ast.unparse(node.func), node) for node in calls]


FORBIDDEN = re.compile(
    r"(builtins\.)?(eval|exec|compile|__import__)$|os\.(system|popen|exec\w*|spawn\w*)$|(c?[pP]ickle|marshal|shelve|dill|joblib)\."
    r"|yaml\.(load|unsafe_load|full_load)$|pty\.|.*\.read_pickle$|.*\.fromfile$"
)


def offences(source: str) -> list[str]:
    """Calls and imports that would run what a file says."""
    tree = ast.parse(source)
    found = [f"{line}: {name}" for line, name, _ in _calls(tree) if FORBIDDEN.match(name)]
    for line, name, call in _calls(tree):
        given = {k.arg: k.value for k in call.keywords}
        for key in ("shell", "allow_pickle"):
            value = given.get(key)
            if value is not None and not (isinstance(value, ast.Constant) and value.value is False):
                found.append(f"{line}: {name}({key}=...)")
        if name.endswith("YAML") and (
            not isinstance(kind := given.get("typ"), ast.Constant) or kind.value not in ("safe", "rt")
        ):
            found.append(f"{line}: YAML without typ='safe'")
        if name.endswith(("np.load", "numpy.load")) and "allow_pickle" not in given:
            found.append(f"{line}: {name} without allow_pickle=False")
    modules = {"pickle", "cPickle", "marshal", "shelve", "dill", "joblib", "cloudpickle", "yaml", "code", "pty"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            continue
        found += [f"{node.lineno}: import {n}" for n in names if n.split(".")[0] in modules]
    return found


@pytest.mark.parametrize(
    "source",
    [
        "import pickle", "from marshal import loads", "import yaml", "eval(text)", "exec(text)", "import os\nos.system('x')",
        "subprocess.run('x', shell=True)", "np.load(path)", "np.load(path, allow_pickle=True)", "YAML()", "YAML(typ='unsafe')",
        "os.popen('x')", "compile(text, '', 'exec')", "pandas.read_pickle(path)",
    ],
)  # fmt: skip
def test_the_guard_sees(source: str) -> None:
    assert offences(source)


def test_nothing_of_a_file_is_run() -> None:
    for room in ("graphloc", "factors", "frontends", "eval"):
        for path in sorted((ROOT / room).rglob("*.py")):
            assert offences(path.read_text(encoding="utf-8")) == [], path


def test_an_error_is_one_line_whatever_names_hold(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config({"sensors": {"a\n\x1b[2Jb" + "c" * 9000: {"kind": "\u2028"}}}, KINDS, "vessel.yaml")
    text = str(caught.value)
    assert text.isprintable()
    assert text.startswith("vessel.yaml: sensors.a ")
    assert len(text) < 1600


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_what_inspect_prints_drives_no_terminal(tmp_path: Path, kind: str) -> None:
    make = Messages(1 if kind == "ros1" else 2)
    items = [(topic.replace("imu", "imu\x1b[2J"), stamp_ns, msg) for topic, stamp_ns, msg in still_run(make)]
    path = write_bag(tmp_path / ("run.bag" if kind == "ros1" else "run"), make, items, kind)
    text = render(inspect_bag(path))
    assert "/imu [2J" in text
    assert all(line.isprintable() for line in text.splitlines())


def test_a_sequence_of_nothing_is_no_memory(tmp_path: Path) -> None:
    """In ROS 1 a message without fields takes no bytes: four bytes may announce 2^32 of them."""
    definition = "Nothing[] many\n" + "=" * 80 + "\nMSG: sensor_msgs/Nothing\n"
    path = tmp_path / "run.bag"
    with Writer1(path) as writer:
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", msgdef=definition, md5sum="0" * 32)
        fix = writer.add_connection("/fix", "sensor_msgs/msg/NavSatFix", typestore=MAKE1.store)
        for k in range(3):
            writer.write(imu, START_NS + k, b"\xff\xff\xff\x0f")
            message = MAKE1.store.serialize_ros1(MAKE1.fix(START_NS + k * S), "sensor_msgs/msg/NavSatFix")
            writer.write(fix, START_NS + k * S, message)
    found = read(path)
    assert [row.outcome for row in rows_of(found, "imu")] == [Outcome.MALFORMED] * 3
    assert "cannot be decoded" in rows_of(found, "imu")[0].reason


@pytest.mark.parametrize(
    "definition",
    ['string A="""\nimport os\nos.system(\'touch escaped\')\n"""', "uint8 __class__", "string B='); open('escaped', 'w')#", "uint8 x\nuint8 class"],
)  # fmt: skip
def test_definitions_are_no_programs(tmp_path: Path, definition: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """rosbags makes Python of definitions: nothing but names and numbers may get into it."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run.bag"
    with Writer1(path) as writer:
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", msgdef=definition, md5sum="0" * 32)
        fix = writer.add_connection("/fix", "sensor_msgs/msg/NavSatFix", typestore=MAKE1.store)
        writer.write(imu, START_NS, bytes(64))
        writer.write(fix, START_NS, MAKE1.store.serialize_ros1(MAKE1.fix(START_NS), "sensor_msgs/msg/NavSatFix"))
    assert [row.outcome for row in rows_of(read(path), "imu")] == [Outcome.MALFORMED]
    assert [p.name for p in tmp_path.iterdir()] == ["run.bag"]


def test_a_tile_that_says_it_is_huge(tmp_path: Path) -> None:
    """A PNG of 100 bytes with 30000 x 30000 pixels in its header: GDAL would unpack each such tile of a window, for minutes."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">L", len(body)) + name + body + struct.pack(">L", zlib.crc32(name + body))

    head = struct.pack(">LLBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    tile = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    path = tmp_path / "a.mbtiles"
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        about = {"name": "a", "format": "png", "minzoom": "17", "maxzoom": "17"}
        base.executemany("INSERT INTO metadata VALUES (?, ?)", about.items())
        base.execute("INSERT INTO tiles VALUES (17, 69795, 91390, ?)", (tile,))
    base.close()
    with pytest.raises(InputError, match="30000 pixels a side"):
        AerialImage(path, Datum(Geodetic(57.7, 11.7, 0.0)))


def test_a_gap_in_a_quiet_start_is_no_division_by_zero() -> None:
    """Half a second of samples, two without, one of samples: blocks of half a second in between hold none."""
    t = np.r_[np.arange(0.0, 0.5, 0.02), np.arange(2.5, 3.5, 0.02)]
    swell = _swell(t, np.ones((len(t), 3)))
    np.testing.assert_allclose(swell, 0.0, atol=1e-12)
