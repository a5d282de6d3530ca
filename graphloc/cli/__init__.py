# SPDX-License-Identifier: Apache-2.0
"""The command line. Known errors are one line and exit 2; heavy imports wait until a command runs."""

from __future__ import annotations

import logging
import os
import sys
from typing import Annotated

import typer

from graphloc import __version__
from graphloc.cli import _about, _estimate, _evidence, _simulate, _sweep, _whatif
from graphloc.errors import GraphlocError

app = typer.Typer(
    name="graphloc",
    help="Factor-graph localisation for vessels where GNSS lies.",
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
for _command in (
    _estimate.inspect,
    _estimate.smooth,
    _evidence.compare,
    _whatif.ablate,
    _whatif.drill,
    _estimate.replay,
    _estimate.stream,
    _estimate.match,
    _simulate.simulate,
    _simulate.demo,
    _sweep.sweep,
    _about.sensors,
):
    app.command()(_command)
app.command("config")(_about.show_config)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log more, on stderr.")] = False,
) -> None:
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, stream=sys.stderr, format="%(message)s")
    if version:
        typer.echo(f"graphloc {__version__}")
        raise typer.Exit


_INTERRUPTED = 130  # what typer makes of Ctrl-C, as shells do


def main() -> None:
    """Run the command line; known errors become one line and exit 2."""
    try:
        app()
    except GraphlocError as error:
        print(f"graphloc: {error}", file=sys.stderr)
        sys.exit(2)
    except SystemExit as end:
        if end.code != _INTERRUPTED:
            raise
        print("graphloc: interrupted; nothing was left half-written", file=sys.stderr, flush=True)
        os._exit(_INTERRUPTED)  # at once: the solver's thread may be deep in a step that cannot be stopped
