# SPDX-License-Identifier: Apache-2.0
"""Values as plain data for JSON, which knows no NaN and no infinity."""

from __future__ import annotations

import math


def plain(value: object) -> object:
    """Return mappings, sequences and numbers as JSON has them; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
