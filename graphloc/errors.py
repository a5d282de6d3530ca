# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can act on: one base, one subclass per concern.

The text of each says what is wrong, where (file, topic, stamp) and what to do, in one line:
the CLI prints it as it is and exits with 2.
"""


class GraphlocError(Exception):
    """Base of every error that graphloc raises on purpose."""


class ConfigError(GraphlocError):
    """A `vessel.yaml` that cannot be used."""


class InputError(GraphlocError):
    """A recording that cannot be read, or that lacks what the configuration asks for."""


class SolveError(GraphlocError):
    """The graph could not be started or solved."""


class OutputError(GraphlocError):
    """A result that could not be written."""
