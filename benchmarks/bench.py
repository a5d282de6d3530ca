# SPDX-License-Identifier: Apache-2.0
"""Run small cases of everything that takes time, beside the committed baseline.

`python benchmarks/bench.py` ends with 1 where a count is worse than its tolerance allows, or is gone. Times depend on the
machine and on what else it does: they are shown as ratios, and never fail. `--update` makes what is measured the baseline.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from _cases import CASES
from _gate import Figure, finish

BASELINE = Path(__file__).parent / "baseline.json"


def measured(cases: Iterable[str]) -> list[Figure]:
    """One case after another, each in a process of its own."""
    found = []
    for name in cases:
        begin = time.perf_counter()
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
            found += alone.submit(CASES[name]).result()
        print(f"{name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    return found


def main() -> int:
    """Return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--only", help=f"cases, separated by commas: {', '.join(CASES)}")
    parser.add_argument("--update", action="store_true", help="make what is measured the baseline")
    asked = parser.parse_args()
    names = asked.only.split(",") if asked.only else list(CASES)
    if unknown := [name for name in names if name not in CASES]:
        parser.error(f"no such case: {', '.join(unknown)}; there are {', '.join(CASES)}")
    return finish(measured(names), BASELINE, whole=set(names) == set(CASES), update=asked.update)


if __name__ == "__main__":
    sys.exit(main())
