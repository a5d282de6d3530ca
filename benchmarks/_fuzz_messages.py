# SPDX-License-Identifier: Apache-2.0
"""Hostile messages: what a driver, a clock or a recorder may do to well-formed ones, and what an attacker would."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from _fuzz_bases import Raw

from tests.bagfactory import Messages

Rng = np.random.Generator
FLOATS = (
    float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324, 0.0, -0.0, 1e20, -1e20, 1e9, -1e9, 1e6, 90.0, 180.0, -1.0,
)  # fmt: skip
INTS = (0, -1, 1, 2, 127, 255, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**63 - 1)
TEXTS = (
    "", "x" * 5000, "../../../etc/passwd", "/dev/zero", "\x00", "{0.__class__}", "%s%n", "!!python/object", "\u202eabc", "\n\n",
    "base_link", "tag36h11", "<script>alert(1)</script>", "; rm -rf x", "$(touch x)", "nan",
)  # fmt: skip


class Leaf(NamedTuple):
    """A value inside of a message: whose, which field, and its name from the top."""

    owner: Any
    name: str
    path: str


def leaves(msg: Any, path: str = "") -> Iterator[Leaf]:
    """All values of a message that are no messages."""
    for field in dataclasses.fields(msg):
        value = getattr(msg, field.name)
        here = f"{path}.{field.name}"
        if dataclasses.is_dataclass(value):
            yield from leaves(value, here)
        elif isinstance(value, list) and value and dataclasses.is_dataclass(value[0]):
            for k, part in enumerate(value[:20]):
                yield from leaves(part, f"{here}[{k}]")
        elif field.name != "__msgtype__":
            yield Leaf(msg, field.name, here)


def pick(rng: Rng, values: Sequence[Any]) -> Any:
    return values[int(rng.integers(len(values)))]


def hostile(rng: Rng, value: Any) -> Any:
    """Something of the same type."""
    if isinstance(value, str):
        return pick(rng, TEXTS)
    if isinstance(value, bool | np.bool_):
        return not value
    if isinstance(value, int | np.integer):
        return pick(rng, INTS) if rng.random() < 0.7 else int(value) + int(rng.integers(-3, 4))
    if isinstance(value, float | np.floating):
        return pick(rng, FLOATS) if rng.random() < 0.8 else float(value) * float(10.0 ** rng.uniform(-9, 9))
    if isinstance(value, np.ndarray):
        return _hostile_array(rng, value)
    return value


def _hostile_array(rng: Rng, value: Any) -> Any:
    changed = value.copy()
    way = rng.integers(6)
    if way == 0:
        return changed[:0]
    if way == 1:
        return changed[: int(rng.integers(len(changed) + 1))]
    if way == 2:
        return np.concatenate([changed, changed])
    if way == 3 and value.dtype.kind == "f":
        changed[:] = pick(rng, FLOATS)
    elif len(changed):
        for k in rng.integers(len(changed), size=int(rng.integers(1, 9))):
            if value.dtype.kind == "f":
                changed[k] = pick(rng, FLOATS)
            else:
                changed[k] = rng.integers(256)
    return changed


def _edited(
    raws: Sequence[Raw], types: Messages, rng: Rng, share: float, topics: Sequence[str], change: Callable[[Any], None]
) -> list[Raw]:
    """Change a share of the messages of some topics; where the result cannot be written, a message stays."""
    out = []
    for raw in raws:
        if raw.topic in topics and rng.random() < share:
            msg = types.store.deserialize_cdr(raw.data, raw.msgtype)
            try:
                change(msg)
                raw = replace(raw, data=bytes(types.store.serialize_cdr(msg, raw.msgtype)))
            except Exception:  # noqa: BLE001, S110 - out of the range of its type
                pass
        out.append(raw)
    return out


def _some_topics(raws: Sequence[Raw], rng: Rng) -> list[str]:
    every = sorted({raw.topic for raw in raws})
    return every if rng.random() < 0.2 else [pick(rng, every)]


def _share(rng: Rng) -> float:
    return float(pick(rng, (0.02, 0.2, 1.0)))


def fields(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """One field of one topic (now and then of all), the same or another hostile value each time."""
    topics = _some_topics(raws, rng)
    which, fixed = int(rng.integers(10**6)), bool(rng.integers(2))
    seed = int(rng.integers(2**32))

    def change(msg: Any) -> None:
        every = [leaf for leaf in leaves(msg) if not leaf.path.startswith(".header.stamp")]
        leaf = every[which % len(every)]
        source = np.random.default_rng(seed) if fixed else rng
        setattr(leaf.owner, leaf.name, hostile(source, getattr(leaf.owner, leaf.name)))

    return _edited(raws, types, rng, _share(rng), topics, change)


def many_fields(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """Several fields at once."""

    def change(msg: Any) -> None:
        every = list(leaves(msg))
        for k in rng.integers(len(every), size=3):
            setattr(every[k].owner, every[k].name, hostile(rng, getattr(every[k].owner, every[k].name)))

    return _edited(raws, types, rng, _share(rng), _some_topics(raws, rng), change)


def stamps(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """Header stamps: zero, negative, 2038, shuffled, equal, backward, another epoch, jitter, with and without log times."""
    way = pick(rng, ("zero", "negative", "last", "nanosec", "equal", "reversed", "epoch", "jitter", "jump", "shuffled"))
    topics = _some_topics(raws, rng)
    stamped = [r for r in raws if r.topic in topics]
    first_s = min((r.log_ns for r in raws), default=0) // 10**9
    pool = rng.permutation(len(stamped)) if stamped else np.zeros(0, dtype=int)
    turn = iter(range(10**9))

    def change(msg: Any) -> None:
        stamp = msg.header.stamp
        k = next(turn)
        if way == "zero":
            stamp.sec = stamp.nanosec = 0
        elif way == "negative":
            stamp.sec = -int(rng.integers(1, 2**31))
        elif way == "last":
            stamp.sec, stamp.nanosec = 2**31 - 1, 999_999_999
        elif way == "nanosec":
            stamp.nanosec = int(rng.integers(2**32))
        elif way == "equal":
            stamp.sec, stamp.nanosec = first_s + 3, 0
        elif way == "reversed":
            stamp.sec = 2 * first_s - stamp.sec + 12
        elif way == "epoch":
            stamp.sec -= first_s
        elif way == "jitter":
            total = stamp.sec * 10**9 + stamp.nanosec + int(rng.normal(0, 10.0 ** rng.uniform(3, 9)))
            stamp.sec, stamp.nanosec = total // 10**9, total % 10**9
        elif way == "jump":
            stamp.sec += int(pick(rng, (-1000, -5, 5, 40, 3600, 10**8)))
        elif len(pool):
            log = stamped[int(pool[k % len(pool)])].log_ns
            stamp.sec, stamp.nanosec = log // 10**9, log % 10**9

    return _edited(raws, types, rng, _share(rng), topics, change)


def order(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """Messages dropped, doubled, recorded in another order or at other times; topics that end or begin midway."""
    way = pick(rng, ("drop", "double", "shuffle", "log", "cut", "late", "few", "same"))
    topics = _some_topics(raws, rng)
    share = _share(rng)
    middle = raws[len(raws) // 2].log_ns
    out: list[Raw] = []
    for raw in raws:
        hit = raw.topic in topics and rng.random() < share
        if not hit or way == "shuffle":
            out.append(raw)
        elif way == "double":
            out += [raw] * int(rng.integers(2, 5))
        elif way == "log":
            out.append(replace(raw, log_ns=int(pick(rng, (0, 1, 2**63 - 2, middle, raw.log_ns - 10**12, 10**18)))))
        elif way == "cut":
            out += [raw] if raw.log_ns < middle else []
        elif way == "late":
            out += [raw] if raw.log_ns >= middle else []
        elif way == "same":
            out.append(replace(raw, data=next(r.data for r in raws if r.topic == raw.topic)))
        elif way == "few":
            out += [raw] if rng.random() < 0.05 else []
    if way == "shuffle":
        logs = rng.permutation([raw.log_ns for raw in raws])
        out = [replace(raw, log_ns=int(log)) for raw, log in zip(raws, logs, strict=True)]
    return sorted(out, key=lambda r: r.log_ns) if rng.random() < 0.7 else out


def payloads(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """Bytes of messages: cut, flipped, empty, those of another topic, lengths that lie."""
    topics, share = _some_topics(raws, rng), _share(rng)
    way = pick(rng, ("cut", "flip", "empty", "other", "length", "noise"))

    def broken(raw: Raw) -> bytes:
        data = bytearray(raw.data)
        at = int(rng.integers(len(data) or 1))
        if way == "cut":
            return bytes(data[:at])
        if way == "flip" and data:
            data[at] ^= 1 << int(rng.integers(8))
            return bytes(data)
        if way == "length":
            at -= at % 4
            data[at : at + 4] = int(pick(rng, (2**32 - 1, 2**31, 2**30, 10**6, 0))).to_bytes(4, "little")
            return bytes(data)
        if way == "other":
            return bytes(pick(rng, raws).data)
        return rng.bytes(int(rng.integers(400))) if way == "noise" else b""

    return [replace(r, data=broken(r)) if r.topic in topics and rng.random() < share else r for r in raws]


def types_of(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """Topics that hold something else, have other names, or swap their messages."""
    every = sorted({raw.topic for raw in raws})
    one, other = pick(rng, every), pick(rng, every)
    way = rng.integers(3)
    if way == 0:
        kind = next(r.msgtype for r in raws if r.topic == other)
        return [replace(r, msgtype=kind) if r.topic == one else r for r in raws]
    if way == 1:
        name = "/" + pick(rng, TEXTS).strip("/").replace("\x00", "0")[:200]
        return [replace(r, topic=name) if r.topic == one else r for r in raws]
    swap = {one: other, other: one}
    return [replace(r, topic=swap.get(r.topic, r.topic)) for r in raws]


def covariances(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """Covariances: huge, tiny, negative, not symmetric, not positive; quaternions of no length."""
    value = pick(rng, (*FLOATS, 1e-12, 1e12))
    way = int(rng.integers(4))

    def change(msg: Any) -> None:
        for leaf in leaves(msg):
            have = getattr(leaf.owner, leaf.name)
            if "covariance" in leaf.name and isinstance(have, np.ndarray) and have.dtype.kind == "f":
                n = round(len(have) ** 0.5)
                made = {0: np.full((n, n), value), 1: np.eye(n) * value, 2: rng.normal(size=(n, n)) * 10.0}.get(way)
                made = have.reshape(n, n) * value if made is None else made
                setattr(leaf.owner, leaf.name, made.ravel())
            if way == 3 and ("orientation" in leaf.path or "quaternion" in leaf.path) and isinstance(have, float):
                setattr(leaf.owner, leaf.name, pick(rng, (0.0, 1.0, float("nan"), 1e-200, 1e200)))

    with np.errstate(all="ignore"):
        return _edited(raws, types, rng, _share(rng), sorted({r.topic for r in raws}), change)


def shapes(raws: Sequence[Raw], types: Messages, rng: Rng) -> list[Raw]:
    """Images and clouds with sizes that lie, points in degenerate places, encodings that are none."""
    topics = [r.topic for r in raws if r.topic.startswith(("/lidar", "/camera"))]

    def change(msg: Any) -> None:
        wanted = {
            "width", "height", "point_step", "row_step", "step", "encoding", "format", "is_bigendian", "data", "offset",
            "datatype", "count", "name", "distortion_model", "d", "k", "p", "binning_x", "x_offset",
        }  # fmt: skip
        every = [leaf for leaf in leaves(msg) if leaf.name in wanted]
        if not every:
            return
        if hasattr(msg, "point_step") and rng.random() < 0.4:
            points = msg.data.reshape(-1, msg.point_step)[:, :12].copy().view("<f4")
            way = rng.integers(5)
            with np.errstate(all="ignore"):
                points[:] = (0.0, np.nan, points[0], points * 1e30, points * [1, 0, 0])[way]
            data = msg.data.reshape(-1, msg.point_step).copy()
            data[:, :12] = points.view(np.uint8)
            msg.data = data.ravel()
            return
        leaf = pick(rng, every)
        setattr(leaf.owner, leaf.name, hostile(rng, getattr(leaf.owner, leaf.name)))

    return _edited(raws, types, rng, _share(rng), sorted(set(topics)), change)
