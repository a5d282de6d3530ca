"""Solves beside each other: whose result is whose, and that none goes on once one has failed or a worker has died."""

import os
import time
from pathlib import Path

import pytest

from graphloc.errors import SolveError
from graphloc.eval.parallel import run_jobs
from graphloc.recording import quiet


def squared(job: int) -> tuple[int, int]:
    return job * job, os.getpid()


def leaves_a_mark_or_fails(job: tuple[Path, int]) -> None:
    folder, number = job
    if number == 0:
        raise SolveError("nothing fits")
    (folder / str(number)).touch()
    time.sleep(0.2)


def dies(_job: int) -> None:
    os._exit(9)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_result_has_its_number(workers: int) -> None:
    seen: list[tuple[int, int]] = []
    found = dict(run_jobs(squared, [3, 5, 7], workers, "squares", lambda _, n, of: seen.append((n, of))))
    assert {k: value for k, (value, _) in found.items()} == {0: 9, 1: 25, 2: 49}
    assert ({pid for _, pid in found.values()} == {os.getpid()}) == (workers == 1)
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_after_an_error_the_rest_is_not_run(tmp_path: Path) -> None:
    """Of 30, those that were underway may end: two workers, and as many waiting with each."""
    with pytest.raises(SolveError, match="nothing fits"):
        list(run_jobs(leaves_a_mark_or_fails, [(tmp_path, k) for k in range(30)], 2, "marks", quiet))
    assert len(list(tmp_path.iterdir())) < 15


def test_a_worker_that_dies_is_one_line() -> None:
    with pytest.raises(SolveError, match="fewer processes"):
        list(run_jobs(dies, [1, 2, 3], 2, "deaths", quiet))
