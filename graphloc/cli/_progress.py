# SPDX-License-Identifier: Apache-2.0
"""What is shown on stderr while a command works."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # these load gtsam and more, which would delay --help
    from graphloc.recording import Progress


def progress() -> Progress:
    """Return a progress bar on stderr; it is silent where that is not a terminal."""
    from tqdm import tqdm

    state: dict[str, tqdm[None]] = {}

    def show(stage: str, done: int, total: int) -> None:
        for name in [n for n in state if n != stage]:
            state.pop(name).close()
        if stage not in state:
            state[stage] = tqdm(total=total, desc=stage, disable=None, file=sys.stderr, leave=False)
        state[stage].n = done
        state[stage].refresh()
        if done >= total:
            state.pop(stage).close()

    return show


def status_line() -> Callable[[float, float, object, str], None]:
    """Return a line on stderr that shows the current estimate; it is silent where that is not a terminal."""
    import time

    from graphloc.estimate import Estimate

    shown_s, live = 0.0, sys.stderr.isatty()
    begun = time.monotonic()

    def show(at_s: float, whole_s: float, estimate: object, waiting: str) -> None:
        nonlocal shown_s
        if not live or (time.monotonic() - shown_s < 0.2 and at_s < whole_s - 0.2):
            return
        shown_s = time.monotonic()
        text = f"{at_s:7.1f} of {whole_s:.0f} s, {at_s / max(shown_s - begun, 1e-3):.1f} x: "
        if isinstance(estimate, Estimate):
            since = ", ".join(f"{name} {s:.1f} s" for name, s in estimate.since_agreed_s.items())
            text += f"{estimate.health}, within {estimate.bound_95_m:.2f} m; agreed: {since}"
        else:
            text += f"waiting for {waiting}"
        sys.stderr.write(f"\r\033[K{text[:118]}")
        sys.stderr.flush()

    return show
