# SPDX-License-Identifier: Apache-2.0
"""A `vessel.yaml` read, changed, validated, and written out with its defaults."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from graphloc.blocks import nearest, one_line, read_mapping
from graphloc.config._sensor import SensorConfig
from graphloc.config._vessel import VesselConfig
from graphloc.errors import ConfigError


def parse_config(raw: Mapping[str, Any], kinds: Mapping[str, type[SensorConfig]], where: str) -> VesselConfig:
    """Validate a mapping. `kinds` is the sensor table's kind -> config class; `where` names the file.

    Raises:
        ConfigError: one line that names each bad key, its nearest known neighbour, and the file.
    """
    tree = dict(raw)
    sensors = tree.get("sensors") or {}
    if not isinstance(sensors, Mapping):
        raise ConfigError(f"{where}: 'sensors' must be a mapping of name to block")
    parsed: dict[str, SensorConfig] = {}
    for name, block in sensors.items():
        if not isinstance(block, Mapping):
            raise ConfigError(f"{where}: sensors.{name} must be a mapping")
        kind = str(block.get("kind", name))
        if kind not in kinds:
            raise ConfigError(f"{where}: sensors.{name}.kind: unknown kind '{kind}'{nearest(kind, list(kinds))}")
        try:
            parsed[str(name)] = kinds[kind].model_validate({**block, "kind": kind})
        except ValidationError as error:
            raise ConfigError(one_line(error, kinds[kind], where, f"sensors.{name}")) from None
    tree["sensors"] = parsed
    try:
        return VesselConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(one_line(error, VesselConfig, where, "")) from None


def load_config(
    path: Path, kinds: Mapping[str, type[SensorConfig]], changes: Mapping[str, object] = MappingProxyType({})
) -> VesselConfig:
    """Read and validate a `vessel.yaml`, some of its keys changed (see `with_changes`)."""
    raw = read_mapping(path, "; `graphloc inspect BAG` writes a first one")
    return parse_config(with_changes(raw, changes, str(path)), kinds, str(path))


def with_changes(raw: Mapping[str, Any], changes: Mapping[str, object], where: str) -> dict[str, Any]:
    """Return a configuration, not yet validated, with keys set that are written with dots (`sensors.gnss.sigma_scale`).

    Raises:
        ConfigError: it has no such sensor, or the way to a key leads through a value.
    """
    tree = copy.deepcopy(dict(raw))
    for key, value in changes.items():
        *way, last = key.split(".")
        sensors = tree.get("sensors")
        known = list(sensors) if isinstance(sensors, Mapping) else []
        if way[:1] == ["sensors"] and (name := [*way, last][1]) not in known:
            raise ConfigError(f"{where}: {key}: there is no sensor '{name}'{nearest(name, known)}")
        block: Any = tree
        for name in way:
            if block.get(name) is None:
                block[name] = {}
            block = block[name]
            if not isinstance(block, dict):
                raise ConfigError(f"{where}: {key}: '{name}' is a value, and holds no keys")
        block[last] = value
    return tree


def effective(config: VesselConfig, *, defaults: bool = True) -> dict[str, Any]:
    """Return the whole configuration as plain data for `run.json` and YAML; `defaults`: keys that have their default included."""
    tree = config.model_dump(mode="json", exclude_defaults=not defaults)
    tree["sensors"] = {
        name: {"kind": sensor.kind, **sensor.model_dump(mode="json", exclude_defaults=not defaults)}
        for name, sensor in config.sensors.items()
    }
    return tree
