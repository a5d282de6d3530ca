"""The command line, called in this process."""

import sys

import pytest

from graphloc import cli


def called(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Call `graphloc` with arguments; return its exit status."""
    monkeypatch.setattr(sys, "argv", ["graphloc", *map(str, arguments)])
    # Under `python -m pytest` click would call the program that.
    monkeypatch.setattr(sys.modules["__main__"], "__package__", None)
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0
