# SPDX-License-Identifier: Apache-2.0
"""Run jobs in parallel processes."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from graphloc.errors import SolveError
from graphloc.recording import Progress

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_jobs(
    work: Callable[[Job], Result], jobs: Sequence[Job], workers: int, stage: str, progress: Progress
) -> Iterator[tuple[int, Result]]:
    """Yield the index of each job and its result, in order of completion.

    If a job raises, or the caller stops, jobs that have not begun are not run.

    Args:
        work: function at the top level of a module, since it is pickled. jobs: its arguments.
        workers: number of processes; 1: this one. stage: name of the work, for `progress`.

    Raises:
        SolveError: a process died.
    """
    progress(stage, 0, len(jobs))
    if workers < 2 or len(jobs) < 2:
        for number, job in enumerate(jobs):
            yield number, work(job)
            progress(stage, number + 1, len(jobs))
        return
    # Processes are not forked: a copy of one in which the solver's threads have run may hang.
    spawn, count = multiprocessing.get_context("spawn"), min(workers, len(jobs))
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_end_on_interrupt)
    try:
        futures = {pool.submit(work, job): number for number, job in enumerate(jobs)}
        for done, future in enumerate(as_completed(futures), start=1):
            yield futures[future], future.result()
            progress(stage, done, len(jobs))
    except BrokenProcessPool:
        raise SolveError(f"{stage}: a process died, as when memory runs out: take fewer processes (--jobs)") from None
    finally:
        pool.shutdown(cancel_futures=True)


def _end_on_interrupt() -> None:
    """End a worker silently on Ctrl-C, which reaches the workers too; the parent process reports it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
