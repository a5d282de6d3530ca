# SPDX-License-Identifier: Apache-2.0
"""Many runs: scenarios and seeds, or bags, with parameters varied; each in a process of its own, on Dask.

A finished run is a line of `runs.jsonl`, so a sweep that was stopped can be continued. The result of a run does not depend on the number
of workers, because each computes on one thread. (The online mode differs by some 1e-11 from run to run by itself.)
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any

from graphloc import app
from graphloc.errors import InputError, OutputError, in_one_line
from graphloc.eval import sweep_table
from graphloc.extras import need
from graphloc.folders import check_folder
from graphloc.job import Job, Row, check, run_job, values_of
from graphloc.plain import plain
from graphloc.recording import Progress, quiet

MARK = "sweep.json"  # a folder with this file is ours to go on with
_RUNS = "runs.jsonl"
_CONNECT_S = 20.0
_VERSIONS = ("graphloc", "gtsam", "numpy", "scipy")  # that decide what a run gives


def sweep(
    jobs: Sequence[Job],
    folder: Path,
    *,
    workers: int = 1,
    scheduler: str = "",
    overwrite: bool = False,
    progress: Progress = quiet,
) -> list[Row]:
    """Run what is not done yet, and write `table.parquet` and `summary.md`.

    A run that failed in an earlier start is tried again.

    Args:
        jobs: what to run. folder: of the sweep; if it was begun with other jobs, the runs of jobs in both are kept.
        workers: number of processes on this machine; if a `scheduler` (tcp://host:port) is given, its workers are used instead.
        overwrite: whether to begin anew. progress: called with the number of runs done, and of all.

    Returns:
        The table's rows, in the order of the jobs.

    Raises:
        GraphlocError: as of `check`; a folder that cannot be used; a scheduler that does not answer.
    """
    need("distributed", "sweep")
    need("pyarrow", "sweep")
    check(jobs)
    hashes = _inputs(jobs, folder, overwrite)
    wanted = {job.key: job for job in jobs}
    done = {
        key: rows
        for key, rows in ({} if overwrite else _finished(folder / _RUNS)).items()
        if key in wanted and rows and not rows[0].get("error")
    }
    todo = [job for key, job in wanted.items() if key not in done]
    with ExitStack() as stack:
        client = _remote(scheduler, stack) if todo and scheduler else None  # before there is a folder
        _begin(folder, hashes, overwrite)
        progress("runs", len(done), len(wanted))
        for job, rows in _on_dask(todo, workers, client, stack) if todo else ():
            done[job.key] = json.loads(line := json.dumps(plain({"job": job.key, "rows": rows})))["rows"]
            _append(folder / _RUNS, line)
            progress("runs", len(done), len(wanted))
    table = [{"run": number, **row} for number, key in enumerate(wanted) for row in done[key]]
    sweep_table.write(table, folder)
    return table


def _inputs(jobs: Sequence[Job], folder: Path, overwrite: bool) -> dict[str, str]:
    """Return the hashes of all inputs, with those of a sweep that is continued; refuse a folder that cannot be used."""
    kinds = {(job.bag, job.config, job.config_changes) for job in jobs if job.config}
    made_of = (app.inputs_of([Path(bag)], Path(config), values_of(changes)) for bag, config, changes in kinds)
    paths = {path for paths in made_of for path in paths}
    hashes = {str(path): app.sha256(path) for path in sorted(paths)}
    mark = folder / MARK
    if mark.exists() and not overwrite:
        try:
            before = json.loads(mark.read_text(encoding="utf-8"))
            versions, known = before["versions"], dict(before["inputs_sha256"])
        except (OSError, ValueError, KeyError, TypeError):
            raise OutputError(f"{mark}: cannot be read: give another --out, or --overwrite") from None
        if versions != _versions() or any(known.get(p, h) != h for p, h in hashes.items()):
            raise OutputError(f"{folder}: was begun with other versions or inputs: give another --out, or --overwrite")
        return known | hashes
    check_folder(folder, overwrite=overwrite, mark=MARK)
    return hashes


def _begin(folder: Path, hashes: Mapping[str, str], overwrite: bool) -> None:
    """Make the folder, or write into it what it is continued with."""
    mark = folder / MARK
    try:
        if folder.exists() and (overwrite or not mark.exists()):
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        fresh = mark.with_suffix(".new")
        fresh.write_text(
            json.dumps({"versions": _versions(), "inputs_sha256": dict(hashes)}, indent=2), encoding="utf-8"
        )
        fresh.replace(mark)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error})") from None


def _append(path: Path, line: str) -> None:
    try:
        with path.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); started again, it goes on here") from None


def _versions() -> dict[str, str]:
    return {name: version(name) for name in _VERSIONS}


def _finished(path: Path) -> dict[str, list[Row]]:
    """Return the rows of each run that is done; a line that was never finished is cut off."""
    if not path.exists():
        return {}
    whole = path.read_bytes()
    kept = whole[: whole.rfind(b"\n") + 1]
    if len(kept) < len(whole):
        os.truncate(path, len(kept))
    found: dict[str, list[Row]] = {}
    for line in kept.splitlines():
        try:
            run = json.loads(line)
            found[run["job"]] = [dict(row) for row in run["rows"]]
        except (ValueError, KeyError, TypeError):
            continue  # what a power cut leaves: that run is done again
    return found


def _on_dask(jobs: Sequence[Job], workers: int, client: Any, stack: ExitStack) -> Iterator[tuple[Job, list[Row]]]:
    """Yield the rows of each job as it ends, on a cluster of others (`client`) or one that lives as long as the stack."""
    client = client or _local(min(workers, len(jobs)), stack)
    futures = client.map(run_job, jobs, pure=False, retries=0)
    of = dict(zip(futures, jobs, strict=True))
    for future in need("distributed", "sweep").as_completed(futures):
        job, error = of.pop(future), future.exception()
        failed = (
            [] if error is None else [{**job.row, "estimate": "", "error": f"its worker died: {in_one_line(error)}"}]
        )
        yield job, failed or future.result()
        future.release()


def _local(workers: int, stack: ExitStack) -> Any:
    dask, distributed = need("dask", "sweep"), need("distributed", "sweep")
    scratch = stack.enter_context(tempfile.TemporaryDirectory())
    stack.enter_context(dask.config.set({"temporary-directory": scratch}))
    logging.getLogger("distributed").setLevel(logging.ERROR)  # else it tells of each worker that comes and goes
    cluster = distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        silence_logs=logging.ERROR,
        preload=[__name__],
    )
    return stack.enter_context(distributed.Client(stack.enter_context(cluster)))


def dask_setup(_worker: object) -> None:
    """Dask calls this in each local worker: Ctrl-C is for who started them, and ends them, too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _remote(address: str, stack: ExitStack) -> Any:
    """Connect to a scheduler whose workers have what is installed here.

    Raises:
        InputError: nobody answers, nobody works there, or a worker has something else.
    """
    try:
        client = stack.enter_context(need("distributed", "sweep").Client(address, timeout=_CONNECT_S))
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"{address}: no Dask scheduler with a worker answers there ({in_one_line(error)})") from None
    try:
        found = client.run(_versions)
    except Exception as error:  # noqa: BLE001 - whatever a worker without graphloc raises
        raise InputError(f"{address}: a worker cannot run graphloc ({in_one_line(error)})") from None
    for worker, versions in found.items():
        if versions != _versions():
            raise InputError(f"{address}: worker {worker} has {versions}, and here is {_versions()}: install the same")
    return client
