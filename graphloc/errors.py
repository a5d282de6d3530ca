# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can act on: one base, one subclass per concern.

The text of each says what is wrong, where (file, topic, stamp) and what to do, in one line:
the CLI prints it as it is and exits with 2.
"""

import logging
import re

log = logging.getLogger(__name__)
_LONGEST = 1500
_UNDETERMINED = "Indeterminate linear system"  # all that GTSAM has to say of data, NaN among them


_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")


def printable(text: str) -> str:
    """Return a text as one line without control characters, which names in a bag may hold to drive a terminal."""
    return _CONTROL.sub(" ", text)


class GraphlocError(Exception):
    """Base of every error that graphloc raises on purpose. Its text is one line, whatever names of files or topics hold."""

    def __init__(self, text: str) -> None:
        line = printable(text)
        super().__init__(line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}")


def in_one_line(error: BaseException) -> str:
    """Return an error as one line; with its type, if it is not a `GraphlocError`."""
    text = " ".join(str(error).split())
    return text if isinstance(error, GraphlocError) else f"{type(error).__name__}: {text}"


class ConfigError(GraphlocError):
    """A `vessel.yaml` that cannot be used."""


class InputError(GraphlocError):
    """A recording that cannot be read, or that lacks what the configuration asks for."""


class SolveError(GraphlocError):
    """The graph could not be started or solved."""


def not_solved(what: str, error: Exception) -> SolveError:
    """Return the error of a solver that gave up. If data can cause it, GTSAM's own text, on keys and options, goes to the log only."""
    log.debug("%s: %s", what, error)
    if isinstance(error, MemoryError):
        return SolveError(f"{what}: no memory is left")
    if _UNDETERMINED not in str(error):
        return SolveError(f"{what}: a fault in graphloc, not in the data; please report it: {in_one_line(error)}")
    return SolveError(
        f"{what}: the measurements leave something undetermined, or contradict each other beyond all bounds; look for a wrong "
        "unit, mount, sign or clock (`graphloc inspect`)"
    )


class ExtraError(GraphlocError):
    """An optional part that is not installed."""


class OutputError(GraphlocError):
    """A result that could not be written."""
