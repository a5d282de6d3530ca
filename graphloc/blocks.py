# SPDX-License-Identifier: Apache-2.0
"""What every file of settings is made of: blocks that know their keys, numbers with limits, one line for what is wrong."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from graphloc.errors import ConfigError
from graphloc.frames import Array, rotation_from_rpy_deg

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Triple = tuple[Finite, Finite, Finite]


_LONG = 40  # characters


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
    """Take the mount from `/tf_static` instead: name of the sensor's frame there."""

    @property
    def t_body_sensor_m(self) -> Array:
        """Sensor origin in body (3,), m."""
        return np.array(self.xyz_m)

    @property
    def R_body_sensor(self) -> Array:
        """Rotation (3, 3) that takes sensor coordinates to body."""
        return rotation_from_rpy_deg(np.array(self.rpy_deg))


def nearest(key: str, known: list[str]) -> str:
    """Return the known key that is meant by a wrong one, as the end of a message; and all of them, if they are few."""
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.4)
    near = f"; did you mean '{close[0]}'?" if close else ""
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
    for item in error.errors():
        path = [str(p) for p in item["loc"]]
        name = ".".join([*([prefix] if prefix else []), *path])
        if item["type"] == "extra_forbidden":
            lines.append(f"unknown key '{name}'{nearest(path[-1], _fields_at(model, path[:-1]))}")
        else:
            text = item["msg"].removeprefix("Value error, ")
            whole_block = isinstance(item["input"], Mapping) and not item["type"].endswith("_type")
            got = "" if whole_block else f" (got {_short(item['input'])})"
            lines.append(f"{name + ': ' if name else ''}{text}{got}")
    return f"{where}: " + "; ".join(lines)


def _short(given: object) -> str:
    """What somebody wrote, or what kind of thing that is where it is long: the rest of the line is what they must read."""
    text = repr(given)
    if isinstance(given, Mapping):
        return "a mapping"
    if len(text) <= _LONG:
        return text
    return "a list" if isinstance(given, list) else f"{text[: _LONG - 3]}..."


def read_mapping(path: Path | Traversable, cure: str = "") -> Mapping[str, Any]:
    """Read a file of YAML 1.2 (no tags) whose top level is a mapping; an empty one gives an empty mapping.

    Args:
        path: the file. cure: what to do where it cannot be read, for the message.

    Raises:
        ConfigError: it cannot be read, or is something else.
    """
    try:
        raw = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}){cure}") from None
    except (YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())[:200]}") from None
    if raw is None:
        raw = {}
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{path}: the top level must be a mapping")
    return raw
