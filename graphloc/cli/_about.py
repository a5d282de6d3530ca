# SPDX-License-Identifier: Apache-2.0
"""Commands that explain the configuration: sensors, config."""

from __future__ import annotations

import json
import re
from io import StringIO
from pathlib import Path
from typing import Annotated, Any

import typer

_MARKDOWN = re.compile(r"\[([^]]+)\]\([^)]+\)|`([^`]+)`")  # links and code: docs/configuration.md has the same texts


def sensors() -> None:
    """List the kinds of sensors that a vessel.yaml can name."""
    from graphloc.factors import KINDS

    for kind, config in KINDS.items():
        said = _MARKDOWN.sub(r"\1\2", (config.__doc__ or "").splitlines()[0])
        typer.echo(f"{kind:15} {said}")


def show_config(
    config: Annotated[Path | None, typer.Option("--config", "-c", help="The vessel.yaml to check and print.")] = None,
    docs: Annotated[
        bool, typer.Option("--docs", help="Print the reference of all keys (docs/configuration.md).")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of YAML.")] = False,
) -> None:
    """Print the effective configuration of a vessel.yaml, all defaults filled in; without --config, the reference of all keys."""
    from ruamel.yaml import YAML

    from graphloc._config_docs import render
    from graphloc.config import effective, load_config
    from graphloc.factors import KINDS

    if docs or config is None:
        typer.echo(render(KINDS), nl=False)
        return
    told = effective(load_config(config, KINDS))
    if as_json:
        typer.echo(json.dumps(told, indent=2))
        return
    writer: Any = YAML(typ="safe", pure=True)
    writer.sort_base_mapping_type_on_output = False  # in the order of the keys' reference
    writer.default_flow_style = None  # lists on a line
    text = StringIO()
    writer.dump(told, text)
    typer.echo(text.getvalue(), nl=False)
