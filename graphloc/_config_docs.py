# SPDX-License-Identifier: Apache-2.0
"""Render docs/configuration.md from the configuration's own definitions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from graphloc.blocks import MountConfig
from graphloc.config import (
    CameraConfig,
    DatumConfig,
    KernelConfig,
    LidarConfig,
    OutputConfig,
    PoseSlowErrorConfig,
    SensorConfig,
    SlowErrorConfig,
    StartConfig,
    TimelineConfig,
    VesselConfig,
)
from graphloc.survey import BerthConfig, DockConfig, Survey, TagConfig

_BLOCKS = (
    DatumConfig, TimelineConfig, StartConfig, OutputConfig, MountConfig, KernelConfig, SlowErrorConfig, PoseSlowErrorConfig, LidarConfig,
    CameraConfig,
)  # fmt: skip

_NAMES: Mapping[type[BaseModel], str] = {
    SlowErrorConfig: "`slow_error` of kind `gnss`",
    PoseSlowErrorConfig: "`slow_error` of kind `pose`",
}

_HEAD = (
    "Made by `graphloc config --docs`. An unknown key is an error that names the nearest known one. Each key of `sensors` "
    "is a name of your choice; its `kind` selects the table below."
)
_EXAMPLE = """```yaml
vessel: my launch
datum: {latitude_deg: 57.7, longitude_deg: 11.7, height_m: 36.0}
sensors:
  imu: {kind: imu, topic: /imu/data, mount: {rpy_deg: [180, 0, 0]}}
  gnss: {kind: gnss, topic: /gnss/fix, mount: {xyz_m: [-1.5, 0.3, 2.3]}, slow_error: {time_constant_s: 100}}
  compass: {kind: compass, topic: /gnss/heading, kernel: {kind: huber}}
  height: {kind: height}
```"""


def render(kinds: Mapping[str, type[SensorConfig]]) -> str:
    """Return the reference of all keys as Markdown."""
    parts = [
        "# Configuration: `vessel.yaml`",
        "",
        _HEAD,
        "",
        _EXAMPLE,
        "",
        "## Top level",
        _table(VesselConfig),
    ]
    for block in _BLOCKS:
        parts += [f"## Block {_NAMES.get(block, f'`{_key(block)}`')}", _doc(block), "", _table(block)]
    for kind, config in kinds.items():
        parts += [f"## Sensor kind `{kind}`", _doc(config), "", _table(config)]
    parts += ["# The survey: `tags.yaml`", "", _table(Survey)]
    for entry in (TagConfig, DockConfig, BerthConfig):
        parts += [f"## Entry of `{entry.__name__.removesuffix('Config').lower()}s`", _doc(entry), "", _table(entry)]
    return "\n".join(parts)


def _key(block: type[BaseModel]) -> str:
    """Name of a block as it stands in the file: `datum` of `DatumConfig`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", block.__name__.removesuffix("Config")).lower()


def _doc(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").splitlines()[0]


def _table(model: type[BaseModel]) -> str:
    lines = ["| key | default | meaning |", "|---|---|---|"]
    for name, field in model.model_fields.items():
        default = "required" if field.is_required() else _value(field.get_default(call_default_factory=True))
        lines.append(f"| `{name}` | {default} | {_meaning(field)} |")
    return "\n".join(lines) + "\n"


def _meaning(field: FieldInfo) -> str:
    """Its description, and the values that it may have where it does not name them all."""
    said = " ".join((field.description or "").split())
    values = [f"`{value}`" for value in get_args(field.annotation)] if get_origin(field.annotation) is Literal else []
    return said if len(values) < 2 or all(value in said for value in values) else f"{said} One of {', '.join(values)}."


def _value(value: object) -> str:
    if isinstance(value, BaseModel):
        given = {k: v for k, v in value.model_dump().items() if k in value.model_fields_set}
        return f"`{given}`" if given else "see its block"
    return f"`{value}`" if value not in (None, {}, ()) else "none"
