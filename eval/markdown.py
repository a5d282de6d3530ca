# SPDX-License-Identifier: Apache-2.0
"""Markdown of tables."""

from __future__ import annotations

from collections.abc import Sequence


def row(cells: Sequence[str]) -> str:
    """Return a row of a table; what would end a cell or the row is escaped."""
    return "| " + " | ".join(" ".join(cell.split("\n")).replace("|", "\\|") for cell in cells) + " |"
