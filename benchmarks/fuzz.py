# SPDX-License-Identifier: Apache-2.0
"""Ten thousand hostile inputs: bags, configurations, maps and streams, each ends in one clear line or in a result that adds up.

`python benchmarks/fuzz.py --cases 10000 --seed 1 --jobs 2` goes on where it was broken off; `--only N` runs one case and shows
what it found. Case n of a seed is the same each time. What was found: docs/hardening.md.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
from _rows import ROOT, Row, row

LIMIT_S, LIMIT_WALL_S = 60.0, 300.0  # of a case: of the processor, which others use too, and by the clock
_ROOM_GIB = 6  # of addresses; what is resident is measured
_NEW_EVERY = 1500  # cases for which a worker lives
Result = dict[str, Any]


def _quiet() -> None:
    """What C libraries print goes nowhere, as a terminal would be flooded."""
    logging.disable(logging.CRITICAL)
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.dup2(sink, 2)


def _worker(pipe: Connection, seed: int, scratch: Path) -> None:
    """Run the cases whose numbers come, until none does."""
    folder = Path(tempfile.mkdtemp(dir=scratch))
    os.environ.update(TMPDIR=str(folder), HOME=str(folder))
    tempfile.tempdir = str(folder)
    os.chdir(folder)
    from _fuzz_bases import bases, stores
    from _fuzz_cases import Case
    from _fuzz_judge import install

    runs, types = bases(scratch / "bases"), stores()
    watch = install()
    sys.dont_write_bytecode = True
    _quiet()
    for number in (0,):  # what is imported and compiled at first use is no case's doing
        _run(Case(np.random.default_rng(number), folder / "room", runs, types), watch, warm=True)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (taken + (_ROOM_GIB << 30), resource.RLIM_INFINITY))
    pipe.send(None)
    while (number := pipe.recv()) is not None:
        case = Case(np.random.default_rng([seed, number]), folder / "room", runs, types)
        began = time.monotonic()
        result = {"case": number, **_run(case, watch)}
        pipe.send({**result, "s": round(time.monotonic() - began, 2)})
    shutil.rmtree(folder, ignore_errors=True)


def _run(case: Any, watch: Any, warm: bool = False) -> Result:
    from _fuzz_cases import TABLE, warm_up
    from _fuzz_judge import judged

    shutil.rmtree(case.room, ignore_errors=True)
    case.inputs.mkdir(parents=True)
    if warm:
        warm_up(case)
        return {}
    shares = np.array([kind.share for kind in TABLE])
    kind = TABLE[int(case.rng.choice(len(TABLE), p=shares / shares.sum()))]
    try:
        with np.errstate(all="ignore"):
            go = kind.make(case)
    except Exception:  # noqa: BLE001 - ours, not graphloc's
        return {"kind": kind.name, "outcome": "fuzzer", "text": traceback.format_exc()[-1500:], "where": "fuzzer"}
    before = _names(case.room.parent)
    # Where a bag is unpacked to is a temporary folder, and that is in the room's parent.
    with judged(watch, case.room.parent, [case.inputs]) as verdicts:
        go()
    verdict = verdicts[-1]
    left = _names(case.room.parent) - before
    if left and verdict.outcome in ("ok", "refused"):
        return {
            "kind": kind.name,
            "outcome": "escape",
            "text": f"left behind: {sorted(left)[:3]}",
            "where": "escape: left",
        }
    return {"kind": kind.name, "outcome": verdict.outcome, "text": verdict.text, "where": verdict.where}


def _names(folder: Path) -> set[str]:
    return {p.name for p in folder.iterdir()}


class _Hand:
    """A worker and what it is at."""

    def __init__(self, seed: int, scratch: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_worker, args=(theirs, seed, scratch), daemon=True)
        self.process.start()
        theirs.close()
        self.number: int | None = None
        self.done, self.since, self.spent_s = -1, time.monotonic(), 0.0

    def give(self, number: int | None) -> None:
        self.number, self.since, self.spent_s = number, time.monotonic(), self._cpu_s()
        self.pipe.send(number)

    def hangs(self) -> bool:
        wall_s = time.monotonic() - self.since
        return wall_s > LIMIT_WALL_S or (wall_s > LIMIT_S and self._cpu_s() - self.spent_s > LIMIT_S)

    def _cpu_s(self) -> float:
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")

    def end(self) -> None:
        self.process.kill()
        self.process.join()


def results(cases: Iterator[int], seed: int, jobs: int, scratch: Path) -> Iterator[Result]:
    """Run cases; a worker that hangs or dies is a result, and is replaced."""
    hands = [_Hand(seed, scratch) for _ in range(jobs)]
    while hands:
        ready = wait([h.pipe for h in hands], timeout=1.0)
        for hand in list(hands):
            ended = None
            if hand.pipe in ready:
                try:
                    result = hand.pipe.recv()
                    hand.done += 1
                    if result is not None:
                        yield result
                except EOFError:
                    hand.process.join()
                    ended = "died", f"exit code {hand.process.exitcode}"
            elif hand.number is not None and hand.hangs():
                ended = "hang", f"no end after {LIMIT_S:g} s"
            else:
                continue
            if ended is not None and hand.number is not None:
                yield {"case": hand.number, "kind": "?", "outcome": ended[0], "text": ended[1], "where": ended[0],
                       "s": round(time.monotonic() - hand.since, 2)}  # fmt: skip
            elif ended is not None:
                raise SystemExit(f"a worker cannot start: {ended[1]}")
            if ended is not None or hand.done >= _NEW_EVERY:
                hands.remove(hand)
                hand.end()
                hands.append(_Hand(seed, scratch))
                continue
            number = next(cases, None)
            if number is None:
                hands.remove(hand)
                hand.end()
            else:
                hand.give(number)


def summary(found: list[Result]) -> str:
    """How many of each kind ended how, and each find once."""
    lines = []
    outcomes = Counter((r["kind"], r["outcome"]) for r in found)
    for kind in sorted({k for k, _ in outcomes}):
        lines.append(f"{kind}: " + ", ".join(f"{n} {o}" for (k, o), n in sorted(outcomes.items()) if k == kind))
    bad = [r for r in found if r["outcome"] not in ("ok", "refused")]
    for where, n in Counter(r["where"] for r in bad).most_common():
        first = next(r for r in bad if r["where"] == where)
        lines.append(
            f"  {n} x {where}: case {first['case']} ({first['kind']}): {' '.join(first['text'].split())[-220:]}"
        )
    lines.append(f"{len(found)} cases, {len(bad)} finds, {sum(r['s'] for r in found):.0f} s")
    return "\n".join(lines)


def figures(_pool: object = None, cases: int = 10_000, seed: int = 7) -> list[Row]:
    """Rows of F.4; goes on with what runs/fuzz-SEED.jsonl has."""
    found = fuzzed(cases, seed, os.cpu_count() or 2, ROOT / f"runs/fuzz-{seed}.jsonl")
    return rows_of(found)


def rows_of(found: list[Result]) -> list[Row]:
    bad = [r for r in found if r["outcome"] not in ("ok", "refused")]
    return [
        row("F.4", "fuzz: cases tried", len(found), ""),
        row("F.4", "fuzz: of them refused with one line", sum(r["outcome"] == "refused" for r in found), ""),
        row("F.4", "fuzz: of them through the command line", sum(r["kind"] == "command line" for r in found), ""),
        row("F.4", "fuzz: crash, hang, warning, wrong account, NaN, write elsewhere", len(bad), "", 0.0, "<="),
        row("F.4", "fuzz: longest case", max(r["s"] for r in found), "s"),
    ]


def fuzzed(cases: int, seed: int, jobs: int, log: Path) -> list[Result]:
    """Run what the log lacks; return all results of the seed."""
    log.parent.mkdir(parents=True, exist_ok=True)
    done = {r["case"] for r in _read(log)}
    scratch = _scratch()
    try:
        with log.open("a") as stream:
            for result in results((n for n in range(cases) if n not in done), seed, jobs, scratch):
                stream.write(json.dumps(result) + "\n")
                stream.flush()
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return _read(log)


def _read(log: Path) -> list[Result]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def _scratch() -> Path:
    from _fuzz_bases import bases

    scratch = Path(tempfile.mkdtemp(prefix="graphloc-fuzz-"))
    bases(scratch / "bases")
    return scratch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--log", type=Path, default=None, help="results as lines of JSON; default runs/fuzz-SEED.jsonl")
    parser.add_argument("--only", type=str, default="", help="numbers of cases to run again, separated by commas")
    arguments = parser.parse_args()
    if arguments.only:
        scratch = _scratch()
        try:
            numbers = [int(n) for n in arguments.only.split(",")]
            for result in results(iter(numbers), arguments.seed, arguments.jobs, scratch):
                print(json.dumps(result, indent=1).replace("\\n", "\n"))
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        return
    log = (arguments.log or Path(f"runs/fuzz-{arguments.seed}.jsonl")).resolve()
    print(summary(fuzzed(arguments.cases, arguments.seed, arguments.jobs, log)))


if __name__ == "__main__":
    main()
