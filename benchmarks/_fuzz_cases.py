# SPDX-License-Identifier: Apache-2.0
"""The table of the fuzzer: kinds of cases, what each makes, and through which door it goes."""

from __future__ import annotations

import json
import math
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import _fuzz_messages as on_messages
import numpy as np
import rasterio
from _fuzz_bases import COMPRESSIONS, KINDS, NAV, SEE, Base, Raw, counted, put_bag, put_config, put_files
from _fuzz_files import (
    damage_file,
    damaged,
    hostile_geojson,
    hostile_json,
    hostile_text,
    hostile_tree,
    noise_image,
)
from _fuzz_judge import Found, check_folder, check_recording, check_solution, run_command
from pyproj import Transformer
from rasterio.transform import from_origin
from ruamel.yaml import YAML

from graphloc import app
from graphloc.config import load_config, parse_config
from graphloc.factors import INERTIAL, SENSORS
from graphloc.factors import KINDS as SENSOR_KINDS
from graphloc.frames import Datum, Geodetic
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.vector import read_vector
from graphloc.frontends.inspect import draft_config, inspect_bag, render
from graphloc.online import OnlineSmoother
from graphloc.stream import run as run_stream
from tests.bagfactory import Messages

Rng = np.random.Generator
DATUM = Datum(Geodetic(57.7, 11.7, 36.0))


@dataclass(slots=True)
class Case:
    """A case in its room: `inputs/` is not to be changed, `out/` may be written."""

    rng: Rng
    room: Path
    bases: Mapping[str, Base]
    types: Mapping[int, Messages]

    @property
    def inputs(self) -> Path:
        return self.room / "inputs"


class Kind(NamedTuple):
    """A kind of case: its name, its share, and what it does: makes its inputs, returns what to judge."""

    name: str
    share: float
    make: Callable[[Case], Callable[[], None]]


def _bag_of(case: Case, base: Base, raws: Sequence[Raw]) -> Path:
    kind = KINDS[int(case.rng.integers(len(KINDS)))]
    ways = COMPRESSIONS[kind]
    return put_bag(case.inputs / "run", case.types, raws, kind, ways[int(case.rng.integers(len(ways)))])


def _through(case: Case, bag: Path, config: Path, written: Counter[str] | None, total: int) -> Callable[[], None]:
    """The doors of the command line: most cases are read and inspected, some are solved too."""
    lots = case.rng.random(4)

    def go() -> None:
        if lots[0] < 0.2:
            _inspect(case, bag)
        recording, vessel = app.load([bag], config)
        check_recording(recording, vessel, written, total)
        scans = app.Scans((bag,), config.parent)
        if lots[1] < 0.06:
            run = app.smooth_recording(recording, vessel, scans=scans, compare=bool(lots[3] < 0.2))
        elif lots[1] < 0.09:
            run = app.replay_recording(recording, vessel, scans=scans)
        else:
            return
        check_solution(run.solution, run.recording)
        if lots[2] < 0.5:
            app.write(run, case.room / "out", inputs=[bag], command="fuzz", overwrite=False)
            check_folder(case.room / "out")

    return go


def _inspect(case: Case, bag: Path) -> None:
    """What inspect writes must be JSON, one text, and a vessel.yaml that can be read."""
    found = inspect_bag(bag)
    json.dumps(found.as_dict(), allow_nan=False)
    render(found)
    path = case.room / "vessel.yaml"
    path.write_text(draft_config(found), encoding="utf-8")
    load_config(path, SENSOR_KINDS)


def _base(case: Case, see: float) -> Base:
    base = case.bases[SEE if case.rng.random() < see else NAV]
    put_files(base, case.inputs)
    return base


def _messages(change: Callable[[Sequence[Raw], Messages, Rng], list[Raw]], see: float = 0.1) -> Callable[[Case], Any]:
    def make(case: Case) -> Callable[[], None]:
        base = _base(case, see)
        raws = [r for r in change(base.raws, case.types[2], case.rng) if r.log_ns >= 0]
        bag = _bag_of(case, base, raws)
        written = counted(raws)
        return _through(case, bag, put_config(base.tree, case.inputs / "vessel.yaml"), written, written.total())

    return make


def _bytes(case: Case) -> Callable[[], None]:
    base = _base(case, 0.05)
    bag = _bag_of(case, base, base.raws)
    for _ in range(int(case.rng.integers(1, 3))):
        damage_file(case.rng, bag)
    return _through(case, bag, put_config(base.tree, case.inputs / "vessel.yaml"), None, len(base.raws))


def _put_hostile(case: Case, tree: Mapping[str, Any], path: Path) -> None:
    try:
        put_config(hostile_tree(case.rng, tree), path)
    except Exception:  # noqa: BLE001 - what YAML cannot say
        put_config(tree, path)


def _config_tree(case: Case) -> Callable[[], None]:
    base = _base(case, 0.25)
    path = case.inputs / "vessel.yaml"
    _put_hostile(case, base.tree, path)
    return _through(case, _bag_of(case, base, base.raws), path, None, 0)


def _config_text(case: Case) -> Callable[[], None]:
    base = _base(case, 0.25)
    path = case.inputs / ("tags.yaml" if base.folder.name == SEE and case.rng.random() < 0.5 else "vessel.yaml")
    put_config(base.tree, case.inputs / "vessel.yaml")
    path.write_bytes(hostile_text(case.rng, path.read_text()))
    return _through(case, _bag_of(case, base, base.raws), case.inputs / "vessel.yaml", None, 0)


def _survey_tree(case: Case) -> Callable[[], None]:
    base = case.bases[SEE]
    put_files(base, case.inputs)
    tree = YAML(typ="safe", pure=True).load((base.folder / "tags.yaml").read_text())
    _put_hostile(case, tree, case.inputs / "tags.yaml")
    return _through(case, _bag_of(case, base, base.raws), put_config(base.tree, case.inputs / "vessel.yaml"), None, 0)


def _geojson(case: Case) -> Callable[[], None]:
    path = case.inputs / "lines.geojson"
    path.write_bytes(hostile_geojson(case.rng))

    def go() -> None:
        drawn = read_vector(path, DATUM)
        if not np.isfinite(drawn.segments_m).all():
            raise Found("nonfinite", "segments")

    return go


def _patch(path: Path) -> None:
    patch = AerialImage(path, DATUM).patch(np.zeros(2), 40.0, 0.5)
    if patch.pixels.shape != (160, 160, 3):
        raise Found("crash", f"a patch of {patch.pixels.shape}")


def _geotiff(case: Case) -> Callable[[], None]:
    path = case.inputs / "image.tif"
    rng = case.rng
    dtype = ("uint8", "uint16", "float32")[int(rng.integers(3))]
    ways = ({}, {"compress": "deflate"}, {"compress": "lzw"}, {"tiled": True, "blockxsize": 64, "blockysize": 64})
    east, north = Transformer.from_crs(4326, 32632, always_xy=True).transform(11.7, 57.7)
    with rasterio.open(
        path, "w", driver="GTiff", width=400, height=400, count=3, dtype=dtype, crs="EPSG:32632",
        transform=from_origin(east - 100.0, north + 100.0, 0.5, 0.5), **ways[int(rng.integers(len(ways)))],
    ) as out:  # fmt: skip
        out.write(noise_image(rng).astype(dtype))
    for _ in range(int(rng.integers(0, 3))):
        path.write_bytes(damaged(rng, path.read_bytes()))
    return lambda: _patch(path)


def _png(width: int, height: int, rows: bytes) -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">L", len(body)) + name + body + struct.pack(">L", zlib.crc32(name + body))

    head = struct.pack(">LLBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def _tile(rng: Rng) -> bytes:
    size = int((256, 512, 1, 30000)[int(rng.choice(4, p=(0.9, 0.04, 0.03, 0.03)))])
    rows = bytes(size * (3 * size + 1)) if size < 1000 else b""
    good = _png(size, size, rows)
    return damaged(rng, good) if rng.random() < 0.15 else good


def _tile_at(zoom: int) -> tuple[int, int]:
    n = 2**zoom
    latitude = math.radians(57.7)
    return int((11.7 / 360.0 + 0.5) * n), int((0.5 - math.asinh(math.tan(latitude)) / (2.0 * math.pi)) * n)


def _mbtiles(case: Case) -> Callable[[], None]:
    path, rng = case.inputs / "tiles.mbtiles", case.rng
    zoom = 17
    x, y = _tile_at(zoom)
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        base.executemany(
            "INSERT INTO metadata VALUES (?, ?)",
            [("format", "png"), ("name", "x"), ("minzoom", str(zoom)), ("maxzoom", str(zoom))],
        )
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                base.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (zoom, x + dx, 2**zoom - 1 - y - dy, _tile(rng)))
    base.close()
    if rng.random() < 0.5:
        path.write_bytes(damaged(rng, path.read_bytes()))
    return lambda: _patch(path)


def _tiles(case: Case) -> Callable[[], None]:
    zoom = int(case.rng.integers(16, 19))
    x, y = _tile_at(zoom)
    root = case.inputs / "tiles"
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            path = root / str(zoom) / str(x + dx) / f"{y + dy}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(_tile(case.rng))
    return lambda: _patch(root)


def _lines_of(base: Base, types: Messages) -> list[dict[str, Any]]:
    """A run as lines of a stream."""
    lines: list[dict[str, Any]] = []
    for raw in base.raws:
        if raw.msgtype not in ("sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"):
            continue
        msg = types.store.deserialize_cdr(raw.data, raw.msgtype)
        line: dict[str, Any] = {"stamp": f"{msg.header.stamp.sec}.{msg.header.stamp.nanosec:09d}"}
        if raw.msgtype.endswith("Imu"):
            a, w = msg.linear_acceleration, msg.angular_velocity
            line |= {"type": "imu", "accel_mps2": [a.x, a.y, a.z], "gyro_radps": [w.x, w.y, w.z]}
        else:
            line |= {
                "type": "gnss",
                "lat_deg": msg.latitude,
                "lon_deg": msg.longitude,
                "height_m": msg.altitude,
                "sigma_m": [1.0, 1.0, 2.0],
            }
            heading = {"type": "heading", "stamp": line["stamp"], "heading_deg": 90.0, "sigma_deg": 2.0}
            pose = {
                "type": "pose",
                "stamp": line["stamp"],
                "modes": [{"xyz_m": [1.0, 2.0, 0.0], "rpy_deg": [0.0, 0.0, 0.0], "probability": 0.5}],
            }
            lines += [heading, pose]
        lines.append(line)
    return lines


_STREAM = {"imu": {}, "gnss": {}, "compass": {}, "match": {"kind": "pose", "axes": ["x", "y", "yaw"]}}


def _stream(case: Case) -> Callable[[], None]:
    rng = case.rng
    lines = _lines_of(case.bases[NAV], case.types[2])
    if rng.random() < 0.3:
        lines = [
            lines[k] for k in np.argsort(np.arange(len(lines)) + rng.normal(0, 10.0 ** rng.uniform(-1, 3), len(lines)))
        ]
    share = float((0.01, 0.1, 0.7)[int(rng.integers(3))])
    said = [hostile_json(rng, line) if rng.random() < share else json.dumps(line).encode() for line in lines]
    sensors = {name: {"topic": f"/{name}", **block} for name, block in _STREAM.items()}
    vessel = parse_config(
        {"datum": {"latitude_deg": 57.7, "longitude_deg": 11.7}, "sensors": sensors}, SENSOR_KINDS, "stream"
    )

    def go() -> None:
        smoother = OnlineSmoother(vessel, rows=SENSORS, inertial=INERTIAL)
        out = StringIO()
        run_stream([line + b"\n" for line in said], out, smoother, vessel, ledger=True)
        _check_stream(out.getvalue(), said)

    return go


def _check_stream(text: str, said: Sequence[bytes]) -> None:
    """Each line is JSON; the counts and the ledger have each line that is no blank one and no question, once."""

    def refuse(constant: str) -> float:
        raise Found("nonfinite", f"{constant} in a line of the stream")

    answers = [json.loads(line, parse_constant=refuse) for line in text.splitlines()]
    seqs = [row["seq"] for a in answers if a["type"] == "ledger" for row in a["rows"] if row["topic"] != "(config)"]
    asked = sum(a["type"] in ("waiting", "estimate") and "line" in a for a in answers)
    wanted = sum(bool(line.strip()) for line in said) - asked
    real = [seq for seq in seqs if seq >= 0]
    if len(set(real)) != len(real) or len(real) != wanted:
        raise Found("ledger", f"{len(set(real))} rows, {len(real) - len(set(real))} twice, of {wanted} lines")


def _command(case: Case) -> Callable[[], None]:
    """The command line itself, in a process of its own: its exit code, and what it says."""
    rng = case.rng
    base = _base(case, 0.1)
    raws = list(base.raws)
    config = put_config(base.tree, case.inputs / "vessel.yaml")
    change = (on_messages.fields, on_messages.stamps, on_messages.order, on_messages.payloads)[int(rng.integers(4))]
    way = int(rng.integers(4))
    bag = _bag_of(case, base, change(raws, case.types[2], rng) if way == 0 else raws)
    if way == 1:
        damage_file(rng, bag)
    elif way == 2:
        config.write_bytes(hostile_text(rng, config.read_text()))
    elif way == 3:
        _put_hostile(case, base.tree, config)
    verb = ("smooth", "compare", "replay", "inspect", "inspect")[int(rng.integers(5))]
    options = ["-o", "out.yaml"] if verb == "inspect" else ["-c", str(config), "-o", str(case.room / "out")]
    arguments = [verb, str(bag), *options, *(["--json"] if rng.random() < 0.3 else [])]

    def go() -> None:
        code, said = run_command(arguments, case.room)
        lines = said.splitlines()
        if code not in (0, 2) or "Traceback" in said or "Warning:" in said:
            raise Found("crash", f"graphloc {verb}: exit code {code}: {said[-1000:]}")
        if code == 2 and (len(lines) != 1 or not lines[0].startswith("graphloc: ")):
            raise Found("message", f"graphloc {verb}: {said[-600:]}")

    return go


TABLE = (
    Kind("bytes of bags", 0.30, _bytes),
    Kind("fields of messages", 0.12, _messages(on_messages.fields, 0.2)),
    Kind("several fields", 0.05, _messages(on_messages.many_fields, 0.2)),
    Kind("stamps", 0.08, _messages(on_messages.stamps)),
    Kind("order, loss, doubles", 0.08, _messages(on_messages.order)),
    Kind("payloads", 0.06, _messages(on_messages.payloads)),
    Kind("types and names", 0.03, _messages(on_messages.types_of)),
    Kind("covariances", 0.03, _messages(on_messages.covariances)),
    Kind("images and clouds", 0.05, _messages(on_messages.shapes, 1.0)),
    Kind("vessel.yaml: values", 0.08, _config_tree),
    Kind("vessel.yaml, tags.yaml: text", 0.05, _config_text),
    Kind("tags.yaml: values", 0.01, _survey_tree),
    Kind("GeoJSON", 0.02, _geojson),
    Kind("GeoTIFF", 0.01, _geotiff),
    Kind("MBTiles", 0.01, _mbtiles),
    Kind("folder of tiles", 0.005, _tiles),
    Kind("lines of a stream", 0.02, _stream),
    Kind("command line", 0.03, _command),
)


def warm_up(case: Case) -> None:
    """Go through every door once with good inputs."""
    for name in (NAV, SEE):
        base = case.bases[name]
        put_files(base, case.inputs)
        bag = put_bag(case.inputs / name, case.types, base.raws, "mcap", "")
        config = put_config(base.tree, case.inputs / "vessel.yaml")
        recording, vessel = app.load([bag], config)
        check_recording(recording, vessel, counted(base.raws), len(base.raws))
        run = app.smooth_recording(recording, vessel, scans=app.Scans((bag,), config.parent), compare=True)
        check_solution(run.solution, run.recording)
        app.write(run, case.room / f"out-{name}", inputs=[bag], command="fuzz", overwrite=True)
        check_folder(case.room / f"out-{name}")
        _inspect(case, bag)
