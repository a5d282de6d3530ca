# SPDX-License-Identifier: Apache-2.0
"""What every file of settings is made of: blocks that know their keys, numbers with limits, one line for what is wrong."""

from __future__ import annotations

import difflib
import reprlib
import warnings
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLWarning
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent

from graphloc.errors import ConfigError
from graphloc.frames import Array, rotation_from_rpy_deg, rpy_from_rotation

_LEAST, _MOST = 1e-12, 1e12  # limits of any length, angle or time, so that its square and inverse are finite, too


def _not_tiny(given: float) -> float:
    if 0.0 < given < _LEAST:
        raise ValueError(f"smaller than {_LEAST:g}")
    return given


Positive = Annotated[float, Field(gt=0.0, le=_MOST, allow_inf_nan=False), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0.0, le=_MOST, allow_inf_nan=False), AfterValidator(_not_tiny)]
Finite = Annotated[float, Field(ge=-_MOST, le=_MOST, allow_inf_nan=False)]
Triple = tuple[Finite, Finite, Finite]


_LONG = 40  # characters
_MOST_SAID = 8  # errors that are listed of one file
_MOST_BYTES, _MOST_VALUES = 10_000_000, 300_000  # a survey of 10 000 tags has 2 MB and 100 000 values
_DEEPEST = 100
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, _LONG, _LONG


class Block(BaseModel):
    """A block of the configuration: unknown keys are errors, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class MountConfig(Block):
    """Pose of the sensor in body (x forward, y port, z up)."""

    xyz_m: Triple = (0.0, 0.0, 0.0)
    """Sensor origin in body, m."""
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the sensor in body, deg; R = Rz(yaw) Ry(pitch) Rx(roll)."""
    tf_frame: str | None = None
    """Take the mount from `/tf_static` instead, or from `/tf` where it never changes: name of the sensor's frame there."""

    @property
    def t_body_sensor_m(self) -> Array:
        """Sensor origin in body (3,), m."""
        return np.array(self.xyz_m)

    @property
    def R_body_sensor(self) -> Array:
        """Rotation (3, 3) that takes sensor coordinates to body."""
        return rotation_from_rpy_deg(np.array(self.rpy_deg))

    @classmethod
    def of_pose(cls, t_body_sensor_m: Array, R_body_sensor: Array) -> MountConfig:
        """Return the mount in numbers, without a frame of /tf_static."""
        xyz_m, rpy_deg = t_body_sensor_m, np.round(np.degrees(rpy_from_rotation(R_body_sensor)), 9) + 0.0  # no -0.0
        return cls(xyz_m=tuple(xyz_m.tolist()), rpy_deg=tuple(rpy_deg.tolist()))


_IN_YAML = {  # what pydantic says in terms of Python
    "tuple_type": "a list in brackets is wanted",
    "list_type": "a list in brackets is wanted",
    "dict_type": "a block of keys is wanted",
    "model_type": "a block of keys is wanted",
    "string_type": "a text is wanted",
}


def nearest(key: str, known: list[str]) -> str:
    """Return the end of a message on a wrong key: the known key that may be meant, and all known ones, if they are few."""
    close = difflib.get_close_matches(key, known, n=len(known) or 1, cutoff=0.4)
    best = max(
        close, key=lambda name: (difflib.SequenceMatcher(None, name, key).ratio(), name[:1] == key[:1]), default=""
    )
    near = f"; did you mean '{best}'?" if best else ""
    return near + (f"; known here: {', '.join(sorted(known))}" if not close or len(known) <= 10 else "")


def _fields_at(model: type[BaseModel], path: list[str]) -> list[str]:
    """Names of the fields of the block that `path` leads to."""
    for name in path:
        field = model.model_fields.get(name)
        if field is None:  # an entry of a list or mapping of blocks
            continue
        inner = [field.annotation, *getattr(field.annotation, "__args__", ())]
        blocks = [a for a in inner if isinstance(a, type) and issubclass(a, BaseModel)]
        if not blocks:
            return []
        model = blocks[0]
    return list(model.model_fields)


def one_line(error: ValidationError, model: type[BaseModel], where: str, prefix: str) -> str:
    """Return what is wrong with a block, in one line: bad keys with their nearest neighbours, bad values."""
    lines = []
    counts = _wrong_counts(error)
    for item in error.errors()[:_MOST_SAID]:
        path = [str(p) for p in item["loc"]]
        if item["type"] == "missing" and isinstance(item["loc"][-1], int):
            path = path[:-1]  # the list, of which an item is missing
        name = ".".join([*([prefix] if prefix else []), *path])
        if item["type"] == "extra_forbidden":
            lines.append(f"unknown key '{name}'{nearest(path[-1], _fields_at(model, path[:-1]))}")
        else:
            text = counts.get(tuple(path)) or _IN_YAML.get(item["type"]) or item["msg"].removeprefix("Value error, ")
            whole_block = isinstance(item["input"], Mapping) and not item["type"].endswith("_type")
            got = "" if whole_block else f" (got {_short(item['input'])})"
            lines.append(f"{name + ': ' if name else ''}{text}{got}")
    lines = list(dict.fromkeys(lines))
    if error.error_count() > _MOST_SAID:
        lines.append(f"and {error.error_count() - _MOST_SAID} more")
    return f"{where}: " + " ".join("; ".join(lines).split())


def _wrong_counts(error: ValidationError) -> dict[tuple[str, ...], str]:
    """Return by key of a list with too few or too many values how many are wanted, in words."""
    wanted = dict[tuple[str, ...], int]()
    for item in error.errors():
        *way, last = item["loc"] or ("",)
        if item["type"] == "missing" and isinstance(last, int):
            key = tuple(map(str, way))
            wanted[key] = max(wanted.get(key, 0), last + 1)
        elif item["type"] == "too_long":
            wanted[tuple(map(str, item["loc"]))] = int(item["ctx"]["max_length"])
    return {key: f"{count} values are wanted" for key, count in wanted.items()}


def _short(given: object) -> str:
    """Return a value as it was written, or only its kind where it is long, so that the rest of the line is read."""
    if isinstance(given, Mapping):
        return "a mapping"
    if isinstance(given, list | tuple):  # whose whole text may be larger than memory: aliases
        text = _SHORT.repr(given)
        return text if len(text) <= _LONG and "..." not in text else "a list"
    try:
        text = repr(given[:_LONG] if isinstance(given, str) else given)
    except ValueError:
        return "a number of thousands of digits"
    return text if len(text) <= _LONG else f"{text[: _LONG - 3]}..."


def _trouble(error: Exception) -> str:
    """Return what is wrong with a file of YAML, in one line: its parser quotes the lines that it means, too."""
    mark = getattr(error, "problem_mark", None)
    if mark is None:
        return " ".join(str(error).split())
    begun, context = getattr(error, "context_mark", None), getattr(error, "context", None)
    since = "" if context is None or begun is None else f" ({context} that begins in line {begun.line + 1})"
    return f"line {mark.line + 1}, column {mark.column + 1}: {getattr(error, 'problem', '')}{since}"


def read_mapping(path: Path | Traversable, cure: str = "") -> Mapping[str, Any]:
    """Read a file of YAML 1.2 (no tags) whose top level is a mapping; an empty one gives an empty mapping.

    At most 10 MB, 100 levels and 300 000 values are read, an alias counting as all that it stands for.

    Args:
        path: the file. cure: what to do where it cannot be read, for the message.

    Raises:
        ConfigError: it cannot be read, or its top level is no mapping.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(_MOST_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}){cure}") from None
    if len(content) > _MOST_BYTES:
        raise ConfigError(f"{path}: larger than {_MOST_BYTES // 10**6} MB: not a file of settings")
    try:
        raw = _loaded(content.decode("utf-8"))
    except Exception as error:  # noqa: BLE001 - besides its own errors ruamel.yaml lets those of int() and such through
        raise ConfigError(f"{path}: not valid YAML: {_trouble(error)[:200]}") from None
    if _values_in(raw, {}) > _MOST_VALUES:
        raise ConfigError(f"{path}: more than {_MOST_VALUES} values, each alias (*) counted as what it stands for")
    if raw is None:
        raw = {}
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{path}: the top level must be a mapping")
    return raw


def _loaded(text: str) -> Any:
    reader = YAML(typ="safe", pure=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", YAMLWarning)  # that an anchor is there twice
        depth = 0
        for event in reader.parse(text):
            depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
            if depth > _DEEPEST:  # what is nested deeper takes the square of its length to read
                raise ValueError(f"nested deeper than {_DEEPEST}")
            if getattr(event, "tag", None) is not None:
                raise ValueError(f"a tag ({event.tag}): write the value alone")
        return reader.load(text)


def _values_in(node: object, known: dict[int, int]) -> int:
    """Return how many values a tree has with aliases written out; a node that several aliases share is walked through once."""
    if not isinstance(node, Mapping | list):
        return 1
    if id(node) not in known:
        known[id(node)] = 1 + _MOST_VALUES  # of one that holds itself
        parts = node.values() if isinstance(node, Mapping) else node
        known[id(node)] = 1 + sum(_values_in(part, known) for part in parts)
    return known[id(node)]
