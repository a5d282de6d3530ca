# SPDX-License-Identifier: Apache-2.0
"""Figures beside a baseline: counts are held to it, ratios are shown."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

_WORSE, _NEW, _GONE = "WORSE", "not in the baseline", "GONE"


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure and how it is held.

    Attributes:
        kind: 'count' is held to the baseline, 'ratio' is only shown.
        direction: '<=': more than the baseline is worse; '>=': less is; '==': both are.
        tolerance: share of the baseline that a count may be worse by.
    """

    key: str
    value: float
    unit: str
    kind: Literal["count", "ratio"]
    direction: Literal["<=", ">=", "=="] = "=="
    tolerance: float = 0.0


def read(path: Path) -> dict[str, Figure]:
    """The baseline, by key."""
    return {block["key"]: Figure(**block) for block in json.loads(path.read_text())} if path.exists() else {}


def write(path: Path, figures: Sequence[Figure], kept: Mapping[str, Figure]) -> None:
    """Write figures as the baseline, and those of cases that were not run."""
    blocks = {**{k: asdict(f) for k, f in kept.items()}, **{f.key: asdict(f) for f in figures}}
    lines = [json.dumps({**b, "value": _short(b["value"])}) for b in blocks.values()]
    path.write_text("[\n " + ",\n ".join(lines) + "\n]\n")


def _short(value: float) -> float | int:
    return int(value) if float(value).is_integer() else float(f"{value:.4g}")


def verdict(now: Figure | None, then: Figure | None) -> str:
    """What to say of a figure: empty where it is as good as its baseline, whose tolerance and direction count."""
    if then is None:
        return _NEW if now is not None and now.kind == "count" else ""
    if then.kind == "ratio":
        return ""
    if now is None:
        return _GONE
    digits = 5e-4 * abs(then.value) if then.value % 1.0 else 0.0  # that the file does not keep
    allowed, more = then.tolerance * abs(then.value) + digits, now.value - then.value
    worse = (then.direction != ">=" and more > allowed) or (then.direction != "<=" and -more > allowed)
    if worse or math.isnan(more):
        return _WORSE
    return "better: --update" if abs(more) > allowed else ""


def compared(figures: Sequence[Figure], baseline: Mapping[str, Figure]) -> tuple[list[str], bool]:
    """The table, and whether a count fails."""
    now = {f.key: f for f in figures}
    rows = [(key, now.get(key), baseline.get(key)) for key in dict.fromkeys([*now, *baseline])]
    width = max((len(key) for key, _, _ in rows), default=0)
    lines, failed = [f"{'figure':{width}}  {'now':>10}  {'baseline':>10}  may be    unit"], False
    for key, new, old in rows:
        said = verdict(new, old)
        failed = failed or said in (_WORSE, _GONE)
        shown = old or new
        assert shown is not None
        held = f"{shown.direction} {100 * shown.tolerance:.0f} %" if shown.kind == "count" else "shown"
        cells = [f"{_short(f.value):>10}" if f else f"{'-':>10}" for f in (new, old)]
        lines.append(f"{key:{width}}  {cells[0]}  {cells[1]}  {held:8}  {shown.unit:6}  {said}".rstrip())
    return lines, failed


def finish(figures: Sequence[Figure], path: Path, *, whole: bool, update: bool) -> int:
    """Print the table; make it the baseline if asked. Return the exit status.

    Args:
        whole: every case was run, so that what is not there is gone.
    """
    baseline = read(path)
    held = baseline if whole else {f.key: baseline[f.key] for f in figures if f.key in baseline}
    lines, failed = compared(figures, held)
    print("\n".join(lines))
    if update:
        write(path, figures, {} if whole else baseline)
        return 0
    if failed:
        print("A count is worse than its tolerance allows: find out why; where it is meant, `make bench-update`.")
    return int(failed)
