# SPDX-License-Identifier: Apache-2.0
"""Commands that explain the configuration: sensors, config."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated

import typer

_MARKDOWN = re.compile(r"\[([^]]+)\]\([^)]+\)|`([^`]+)`")  # links and code: docs/configuration.md has the same texts


def sensors() -> None:
    """List the kinds of sensors that a vessel.yaml can name."""
    from graphloc.factors import KINDS

    for kind, config in KINDS.items():
        said = _MARKDOWN.sub(r"\1\2", (config.__doc__ or "").splitlines()[0])
        typer.echo(f"{kind:15} {said}")


def show_config(
    config: Annotated[Path | None, typer.Option("--config", "-c", help="A vessel.yaml to check.")] = None,
    docs: Annotated[bool, typer.Option("--docs", help="Print docs/configuration.md.")] = False,
) -> None:
    """Print the effective configuration of a vessel.yaml, or the reference of all keys."""
    from graphloc._config_docs import render
    from graphloc.config import effective, load_config
    from graphloc.factors import KINDS

    if docs or config is None:
        typer.echo(render(KINDS), nl=False)
    else:
        typer.echo(json.dumps(effective(load_config(config, KINDS)), indent=2))
