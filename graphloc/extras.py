# SPDX-License-Identifier: Apache-2.0
"""Optional parts of the package, and what other packages add to it."""

from __future__ import annotations

import importlib
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from graphloc.errors import ConfigError, ExtraError


def need(module: str, extra: str) -> Any:
    """Return a module of an optional part, or say how to install it.

    Raises:
        ExtraError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        raise ExtraError(f"{error.name} is not installed: pip install 'graphloc[{extra}]'") from None


@cache
def added(group: str) -> dict[str, Any]:
    """Return what installed packages add under a group of entry points, by name.

    Raises:
        ConfigError: one cannot be loaded, or two have the same name.
    """
    found: dict[str, Any] = {}
    for point in sorted(entry_points(group=group), key=lambda p: (p.name, p.value)):
        whose = f"{group}: '{point.name}' of {point.dist.name if point.dist else 'an unknown package'}"
        if point.name in found:
            raise ConfigError(f"{whose}: another package adds that name, too: uninstall one of them")
        try:
            found[point.name] = point.load()
        except Exception as error:  # noqa: BLE001 - it is somebody else's code, which may raise anything
            text = " ".join(str(error).split())
            raise ConfigError(
                f"{whose}: cannot be loaded ({type(error).__name__}: {text}): mend or uninstall it"
            ) from None
    return found
