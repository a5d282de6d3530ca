# SPDX-License-Identifier: Apache-2.0
"""The command line. Known errors are one line and exit 2; heavy imports wait until a command runs."""

from __future__ import annotations

import logging
import os
import sys
from typing import Annotated, Any, NoReturn

import typer

from graphloc import __version__
from graphloc.cli import _about, _estimate, _evidence, _experiments, _simulate, _sweep
from graphloc.cli._shared import Stopped, with_options
from graphloc.errors import GraphlocError

app = typer.Typer(
    name="graphloc",
    help="Factor-graph localisation for vessels where GNSS cannot be trusted.",
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
for _command in (
    _estimate.inspect,
    _estimate.smooth,
    _evidence.compare,
    _evidence.summary,
    _experiments.ablate,
    _experiments.drill,
    _estimate.replay,
    _estimate.stream,
    _estimate.match,
    _simulate.simulate,
    _simulate.demo,
    _sweep.sweep,
    _about.sensors,
):
    app.command()(with_options(_command))
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
_USAGE: Any = typer.BadParameter.__mro__[2]  # ClickException: that of click, or of typer's own, by typer's version


def main() -> None:
    """Run the command line; known errors, wrong options among them, become one line and exit 2."""
    try:
        code = app(standalone_mode=False)
    except Stopped as error:
        _interrupted(str(error))
    except GraphlocError as error:
        _fail(str(error))
    except _USAGE as error:
        text = " ".join(error.format_message().split())
        if not text:  # nothing was asked for: the help was printed
            sys.exit(error.exit_code)
        path = error.ctx.command_path if getattr(error, "ctx", None) else "graphloc"
        _fail(f"{text.rstrip('.')}; see {path} --help")
    except typer.Abort:
        _fail("aborted: nothing was done")
    if code == _INTERRUPTED:
        _interrupted("nothing was left half-written")
    sys.exit(code or 0)


def _fail(text: str) -> NoReturn:
    print(f"graphloc: {text}", file=sys.stderr)
    sys.exit(2)


def _interrupted(said: str) -> NoReturn:
    bar = "\r\033[K" if sys.stderr.isatty() else ""  # what a progress bar left in the line
    print(f"{bar}graphloc: interrupted; {said}", file=sys.stderr, flush=True)
    os._exit(_INTERRUPTED)  # at once: the solver's thread may be deep in a step that cannot be stopped
