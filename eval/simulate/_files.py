# SPDX-License-Identifier: Apache-2.0
"""Text files of the simulator: shipped ones by name, a user's own by path."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from graphloc.blocks import Block, one_line, read_mapping
from graphloc.errors import ConfigError

_Block = TypeVar("_Block", bound=Block)


def shipped_names(folder: Traversable) -> tuple[str, ...]:
    """Return the names of the YAML files in a folder."""
    return tuple(sorted(e.name.removesuffix(".yaml") for e in folder.iterdir() if e.name.endswith(".yaml")))


def load_block(what: str, name_or_path: str, folder: Traversable, model: type[_Block]) -> tuple[_Block, str]:
    """Read and validate a file, by name in a folder or by path; return it, and its name for messages.

    Raises:
        ConfigError: one line that names the file, the block and the error.
    """
    shipped = shipped_names(folder)
    where, path = f"{name_or_path}.yaml", folder / f"{name_or_path}.yaml"
    if name_or_path not in shipped:
        where, path = name_or_path, Path(name_or_path)
        if not path.is_file():
            raise ConfigError(
                f"{what} '{name_or_path}': no such file, and none of the shipped ones: {', '.join(shipped)}"
            )
    raw = read_mapping(path)
    return validated(raw, where, model), where


def validated(raw: Mapping[str, object], where: str, model: type[_Block]) -> _Block:
    """Validate a mapping.

    Raises:
        ConfigError: one line that names `where`, the block and the error.
    """
    try:
        return model.model_validate(dict(raw))
    except ValidationError as error:
        raise ConfigError(one_line(error, model, where, "")) from None
