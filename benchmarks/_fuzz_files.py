# SPDX-License-Identifier: Apache-2.0
"""Hostile files: bytes cut and flipped, lengths that lie, texts that want to be more than text."""

from __future__ import annotations

import copy
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _fuzz_messages import FLOATS, TEXTS, Rng, pick

LENGTHS = (0, 1, 2**16, 2**31 - 1, 2**32 - 1, 2**34, 2**40, 2**63 - 1, 2**64 - 1)


def _place(rng: Rng, size: int) -> int:
    """Anywhere, or in the head or tail, where indices and headers are."""
    where = rng.integers(3)
    low, high = ((0, size), (0, min(size, 600)), (max(0, size - 3000), size))[where]
    return int(rng.integers(low, max(high, low + 1)))


def damaged(rng: Rng, content: bytes) -> bytes:
    """Bytes cut, flipped, zeroed, doubled, swapped, or given a length that lies."""
    data = bytearray(content)
    way = pick(rng, ("cut", "flip", "flips", "zero", "insert", "double", "length", "drop", "noise"))
    at = _place(rng, len(data))
    if way == "cut":
        return bytes(data[:at])
    if way in ("flip", "flips"):
        for _ in range(1 if way == "flip" else int(rng.integers(2, 200))):
            data[_place(rng, len(data))] ^= 1 << int(rng.integers(8))
    elif way == "zero":
        size = int(rng.integers(1, 5000))
        data[at : at + size] = bytes(min(size, len(data) - at))
    elif way == "insert":
        data[at:at] = rng.bytes(int(rng.integers(1, 2000)))
    elif way == "double":
        data[at:at] = data[at : at + int(rng.integers(1, 5000))]
    elif way == "length":
        form = pick(rng, ("<Q", "<L", ">L"))
        data[at : at + struct.calcsize(form)] = struct.pack(form, pick(rng, LENGTHS) % 2 ** (8 * struct.calcsize(form)))
    elif way == "drop":
        del data[at : at + int(rng.integers(1, 5000))]
    else:
        size = int(rng.integers(1, 300))
        data[at : at + size] = rng.bytes(size)
    return bytes(data)


def damage_file(rng: Rng, path: Path) -> None:
    """Damage a file in its place; of a folder one of its files."""
    if path.is_dir():
        files = sorted(p for p in path.rglob("*") if p.is_file())
        path = pick(rng, files)
    if path.name == "metadata.yaml":
        path.write_bytes(hostile_text(rng, path.read_text(errors="replace")))
    else:
        path.write_bytes(damaged(rng, path.read_bytes()))


_BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [" + ",".join([f"*{a}"] * 9) + "]\n" for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)
_TAGS = (
    "!!python/object/apply:os.system ['touch escaped']", "!!python/object/new:os.system [touch escaped]", "!!python/name:os.system ''",
    "!!binary aGVsbG8=", "!!set {a, b}", "!mine {a: 1}", "!!timestamp 2001-01-01", "!!omap [a: 1]", "!!float 'x'", "!!int ''",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, "", [], {}, [[]], 0, -1, 1, 10**5000, 2**63, -(2**63), *FLOATS, 1e-9, 1e-300, 1e12, *TEXTS, [1, 2], [1, 2, 3],
    ["x", "y", "z"], {"a": 1}, [0.0] * 10000, "2001-01-01", "0x7f", "1e400", "true", "~", ["x", "x"], -5.5, 1e4, 200.0,
)  # fmt: skip


def hostile_text(rng: Rng, text: str) -> bytes:
    """YAML or JSON as text: tags, bombs, deep nesting, other encodings, lines lost, doubled and cut."""
    lines = text.splitlines()
    way = rng.integers(12)
    k = int(rng.integers(len(lines) or 1))
    if way == 0:
        key = lines[k].split(":")[0]
        lines[k] = f"{key}: {pick(rng, _TAGS)}"
    elif way == 1:
        return (_BOMB + "\n".join([*lines, "sensors: *j"])).encode()
    elif way == 2:
        depth = int(pick(rng, (50, 1000, 20000)))
        opened, closed = pick(rng, (("[", "]"), ("{a: ", "}")))
        lines.append("deep: " + opened * depth + closed * depth)
    elif way == 3:
        return pick(rng, (b"\xff\xfe", b"\xef\xbb\xbf", b"\x00", b"\x80\x81")) + text.encode()
    elif way == 4:
        return text.encode(str(pick(rng, ("utf-16", "utf-32"))))
    elif way == 5:
        del lines[k]
    elif way == 6:
        lines.insert(k, lines[k])
    elif way == 7:
        lines[k] = lines[k].replace("  ", "\t")
    elif way == 8:
        return text[: int(rng.integers(len(text)))].encode()
    elif way == 9:
        return damaged(rng, text.encode())
    elif way == 10:
        lines[k] = (
            lines[k].split(":")[0]
            + ": "
            + pick(rng, ("1e400", ".nan", "-.inf", "1" * 6000, "0o777", "*none", "&x", "@", "`", "%"))
        )
    else:
        lines.append("<<: {a: 1}\n? [1, 2]\n: 3\n... \n--- \nb: 2")
    return "\n".join(lines).encode()


def hostile_tree(rng: Rng, tree: Mapping[str, Any]) -> dict[str, Any]:
    """A tree with one to three values replaced, keys dropped, renamed, moved or added."""
    changed = copy.deepcopy(dict(tree))
    for _ in range(int(rng.integers(1, 4))):
        node: Any = changed
        while True:
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = pick(rng, keys)
            if isinstance(node[key], dict | list) and node[key] and rng.random() < 0.85:
                node = node[key]
                continue
            _change(rng, node, key)
            break
    return changed


def _change(rng: Rng, node: Any, key: Any) -> None:
    way = rng.integers(10)
    if way == 0 and isinstance(node, dict):
        del node[key]
    elif way == 1 and isinstance(node, dict):
        node[pick(rng, (*TEXTS[:8], f"{key}s", str(key).upper(), "kind", "topic"))] = node.pop(key)
    elif way == 2 and isinstance(node, dict):
        node[pick(rng, ("unknown", f"{key}_m", "sensors", "enabled", "kernel"))] = pick(rng, VALUES)
    elif way in (3, 4) and isinstance(node[key], float) and not isinstance(node[key], bool):
        node[key] = node[key] * float(10.0 ** rng.integers(-12, 13)) * float(pick(rng, (1, 1, -1)))
    else:
        node[key] = copy.deepcopy(pick(rng, VALUES))


def hostile_json(rng: Rng, line: Mapping[str, Any]) -> bytes:
    """A line of a stream: values replaced, keys renamed, text damaged."""
    if rng.random() < 0.7:
        return _as_json(hostile_tree(rng, line)).encode()
    return damaged(rng, json.dumps(line).encode()).replace(b"\n", b" ")


def _as_json(tree: Any) -> str:
    """JSON with numbers of any length, which Python does not write by itself."""
    return json.dumps(_spelled(tree)).replace('"<huge>"', "1" + "0" * 5000)


def _spelled(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {k: _spelled(v) for k, v in tree.items()}
    if isinstance(tree, list):
        return [_spelled(v) for v in tree]
    return "<huge>" if isinstance(tree, int) and abs(tree) > 10**4000 else tree


GEOJSON: dict[str, Any] = {
    "type": "FeatureCollection",
    "features": [
        {"type": "Feature", "properties": {"natural": "coastline"}, "geometry": {"type": "LineString", "coordinates": [[11.7, 57.7], [11.701, 57.7], [11.702, 57.701]]}},
        {"type": "Feature", "properties": {"graphloc": "water"}, "geometry": {"type": "Polygon", "coordinates": [[[11.7, 57.7], [11.71, 57.7], [11.71, 57.71], [11.7, 57.7]]]}},
        {"type": "Feature", "properties": None, "geometry": {"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": [11.7, 57.7]}]}},
    ],
}  # fmt: skip


def hostile_geojson(rng: Rng) -> bytes:
    if rng.random() < 0.7:
        return _as_json(hostile_tree(rng, GEOJSON)).encode()
    return hostile_text(rng, json.dumps(GEOJSON, indent=1))


def noise_image(rng: Rng) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return rng.integers(0, 256, (3, 400, 400), dtype=np.uint8)
