# SPDX-License-Identifier: Apache-2.0
"""One run of a sweep: its parameters, whether it can run, and its rows of the table."""

from __future__ import annotations

import itertools
import json
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from graphloc import app
from graphloc.config import VesselConfig, effective, parse_config, with_changes
from graphloc.errors import ConfigError, in_one_line
from graphloc.eval import sweep_table
from graphloc.eval.holdout import HoldOut
from graphloc.eval.simulate import SimulatedRun, find_scenario, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.factors import KINDS
from graphloc.frontends.bag import check_bag
from graphloc.recording import Recording

Mode = Literal["offline", "online", "compare"]
Row = dict[str, Any]
Changes = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One run of a sweep: plain data, which travels to a worker.

    Attributes:
        scenario, seed, changes: of the simulator, the last being fields of the scenario and their values; or
        bag, config: paths of a recording and its vessel.yaml, which the worker must be able to read.
        config_changes: keys of the configuration, written with dots, and their values as YAML.
        mode: `offline` smooths, `online` replays, `compare` does both and runs the filters.
        hold_out: fixes that are kept out and predicted (see `HoldOut.parse`), or empty.
    """

    scenario: str = ""
    seed: int = 0
    changes: Changes = ()
    bag: str = ""
    config: str = ""
    config_changes: Changes = ()
    mode: Mode = "offline"
    hold_out: str = ""

    @property
    def key(self) -> str:
        """Key of the run, different from those of all others."""
        return json.dumps(asdict(self), sort_keys=True)

    @property
    def row(self) -> Row:
        """How the table names the run."""
        case = [self.scenario or self.bag, *(f"{k}={v}" for k, v in (*self.changes, *self.config_changes))]
        named = {"scenario": self.scenario, "seed": self.seed} if self.scenario else {"bag": self.bag}
        varied = {f"set.{k}": v for k, v in self.changes} | {f"config.{k}": v for k, v in self.config_changes}
        return {"case": " ".join(case), **named, **varied, "mode": self.mode}


def variations(options: Iterable[str], option: str) -> list[Changes]:
    """Return every combination of `KEY=VALUE,VALUE,...`; brackets hold a value with commas together.

    Raises:
        ConfigError: one is written in another way.
    """
    each: list[list[tuple[str, str]]] = []
    for text in options:
        key, _, values = text.partition("=")
        found = _split(values)
        if not key or not all(found) or key in {k for pairs in each for k, _ in pairs[:1]}:
            raise ConfigError(f"{option} {text}: write each key once, KEY=VALUE or KEY=VALUE,VALUE")
        each.append([(key, value) for value in found])
    return list(itertools.product(*each))


def _split(values: str) -> list[str]:
    """Split at the commas that are not within brackets."""
    found, depth = [""], 0
    for letter in values:
        depth += (letter in "[({") - (letter in "])}")
        if letter == "," and depth == 0:
            found.append("")
        else:
            found[-1] += letter
    return [value.strip() for value in found]


def check(jobs: Sequence[Job]) -> None:
    """Check that the jobs can run, before any does.

    Raises:
        GraphlocError: a scenario, bag or key that does not exist, a value that is not valid, or nothing to measure.
    """
    if not jobs:
        raise ConfigError("nothing to run: name scenarios (as bl1-drift) and --seeds, or a --bag with its --config")
    examples: dict[str, SimulatedRun] = {}
    for job in {replace(job, seed=0): job for job in reversed(jobs)}.values():
        if job.hold_out:
            HoldOut.parse(job.hold_out)
        if job.hold_out and job.mode == "online":
            raise ConfigError("--hold-out with --mode online: not built; --mode compare has the online mode beside it")
        if job.scenario:
            scenario = find_scenario(job.scenario, dict(job.changes))
            if job.scenario not in examples:
                examples[job.scenario] = simulate(scenario, job.seed)
            _simulated_config(examples[job.scenario], job)
            continue
        config = app.configured(Path(job.config), values_of(job.config_changes))
        check_bag([Path(job.bag)], config)
        app.truth_of_file(job.config, config)
        if not (config.truth or config.check_speed_topic or job.hold_out):
            raise ConfigError(
                f"{job.config}: no truth_topic or truth_file, so nothing would be measured: give --hold-out, as gaps:8x10"
            )


def values_of(changes: Changes) -> dict[str, object]:
    """Return changes of a configuration, their values read as YAML.

    Raises:
        ConfigError: a value is none.
    """
    found: dict[str, object] = {}
    for key, text in changes:
        try:
            found[key] = YAML(typ="safe", pure=True).load(text)
        except (YAMLError, ValueError, RecursionError):
            raise ConfigError(f"--config-set {key}={text}: not valid YAML") from None
    return found


def _simulated_config(run: SimulatedRun, job: Job) -> VesselConfig:
    if not job.config_changes:
        return run.config
    return parse_config(
        with_changes(effective(run.config), values_of(job.config_changes), job.scenario), KINDS, job.scenario
    )


def run_job(job: Job) -> list[Row]:
    """Run a job on one thread; return a row for each of its estimates, or one row with the `error`."""
    import numba
    from threadpoolctl import threadpool_limits

    threads, begun = numba.get_num_threads(), time.perf_counter()
    numba.set_num_threads(1)
    try:
        with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
            run = _estimated(job, Path(folder))
        rows = sweep_table.rows_of(run.solution, app.tables(run), len(run.recording.warnings))
    except Exception as error:  # noqa: BLE001 - whatever it is, the other runs go on
        rows = [{"estimate": "", "error": in_one_line(error)}]
    finally:
        numba.set_num_threads(threads)
    took_s = time.perf_counter() - begun
    return [{**job.row, **row, "took_s": took_s} for row in rows]


def _estimated(job: Job, folder: Path) -> app.Run:
    recording, config, scans = _recorded(job, folder)
    if job.mode == "online":
        return app.replay_recording(recording, config, scans=scans)
    hold_out = HoldOut.parse(job.hold_out) if job.hold_out else None
    return app.smooth_recording(recording, config, hold_out=hold_out, compare=job.mode == "compare", scans=scans)


def _recorded(job: Job, folder: Path) -> tuple[Recording, VesselConfig, app.Scans | None]:
    """Read the bag, or simulate: in memory, unless there are scans or images, which only a bag holds."""
    bag, path = Path(job.bag), Path(job.config)
    if job.scenario:
        run = simulate(find_scenario(job.scenario, dict(job.changes)), job.seed)
        config = _simulated_config(run, job)
        if not config.of_kind("aerial") and not config.of_kind("apriltag"):
            return run.recording, config, None
        bag, path = write_bag(run, folder / "run", ros=2)
    recording, config = app.load([bag], path, changes=values_of(job.config_changes))
    return recording, config, app.Scans((bag,), path.parent)
