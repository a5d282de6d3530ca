# SPDX-License-Identifier: Apache-2.0
"""Where the time of a batch of 2 min goes: samples of the stack, which cost nothing between them, by step of the solver."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from types import FrameType
from unittest.mock import patch

from _rows import Row, row
from batch import loops

import graphloc.solve
from graphloc import app

_PERIOD_S, _RUNS = 0.002, 5
# The innermost of these functions that is on the stack has the sample.
_STEPS = {
    "optimize": "GTSAM's steps (QR, all windows and passes)",
    "marginals": "covariances (QR, Python)",
    "full_step": "GTSAM's steps (QR, all windows and passes)",
    "build_graph": "graphs built of the measurements (Python, GTSAM's constructors)",
    "attach": "measurements attached (Python)",
    "weigh": "measurements weighed: residuals, modes (Python, numpy)",
    "offsets_of": "offsets of sensors examined (scipy)",
    "make_problem": "timeline and preintegration",
    "make_solution": "ledger, health, bounds (Python)",
    "smooth": "the rest of the solver",
}
_REST = "outside of the solver"


def _step(frame: FrameType | None) -> str:
    while frame is not None:
        code = frame.f_code
        name = next((part for part in reversed(code.co_qualname.split(".")) if part in _STEPS), "")
        if name and "graphloc" in code.co_filename:
            return _STEPS[name]
        frame = frame.f_back
    return _REST


def sampled() -> dict[str, float]:
    """Share of the time by step.

    Python tells of a signal when a call into C is done, and of many as one: so a sample counts as long as it took to come.
    """
    run, took_s, last_s = loops(120.0), Counter[str](), 0.0

    def sample(_number: int, frame: FrameType | None) -> None:
        nonlocal last_s
        now_s = time.process_time()
        took_s[_step(frame)] += now_s - last_s  # type: ignore[assignment]
        last_s = now_s

    # In this thread, which alone is told of the timer; 2 min do not need the deep stack.
    with patch.object(graphloc.solve, "_on_deep_stack", lambda work: work()):
        app.simulated(run)
        signal.signal(signal.SIGPROF, sample)
        last_s = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, _PERIOD_S, _PERIOD_S)
        for _ in range(_RUNS):
            app.simulated(run)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    whole_s = sum(took_s.values())
    return {name: s / whole_s for name, s in took_s.most_common()}


def figures(_pool: ProcessPoolExecutor) -> list[Row]:
    """In a process of its own."""
    shares = json.loads(subprocess.run([sys.executable, __file__], check=True, capture_output=True, text=True).stdout)
    return [row("F.3p", f"batch, 2 min, share of the time: {name}", 100.0 * s, "%") for name, s in shares.items()]


if __name__ == "__main__":
    print(json.dumps(sampled()))
