# SPDX-License-Identifier: Apache-2.0
"""A row of docs/results.json: one figure, what it should be, and how it was measured."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
Row = dict[str, Any]


def row(item: str, name: str, value: float, unit: str, bound: float | None = None, direction: str = "info") -> Row:
    command = f"python benchmarks/results.py --only {item}"
    return {"item": item, "name": name, "value": float(f"{value:.6g}"), "unit": unit, "bound": bound,
            "direction": direction, "command": command, "commit": commit()}  # fmt: skip


def commit() -> str:
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    changed = subprocess.run(
        [*git, "status", "--porcelain", "--untracked-files=no"], capture_output=True, text=True, check=False
    )
    return head.stdout.strip() + ("+" if [n for n in changed.stdout.split("\n") if n and "docs/" not in n] else "")
