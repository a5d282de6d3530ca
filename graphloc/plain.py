# SPDX-License-Identifier: Apache-2.0
"""Values as plain data for JSON, which knows no NaN and no infinity; tables as plain text."""

from __future__ import annotations

import math
from collections.abc import Sequence


def plain(value: object) -> object:
    """Return mappings, sequences and numbers as JSON has them; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def aligned(rows: Sequence[Sequence[str]], *, numbers: bool = False) -> list[str]:
    """Return rows of cells as lines with aligned columns; `numbers`: all but the first column are aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if numbers and k else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
