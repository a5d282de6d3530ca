# SPDX-License-Identifier: Apache-2.0
"""The command that runs many cases: sweep."""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphloc.cli._progress import progress
from graphloc.cli._shared import HoldOutOption, JobsOption, OutOption, OverwriteOption, Stopped

if TYPE_CHECKING:
    from graphloc.job import Job


class _Mode(StrEnum):
    offline = "offline"
    online = "online"
    compare = "compare"


def seeds_of(text: str) -> list[int]:
    """Read `0:50` (the second is not among them), `7`, or `1,2,5`."""
    from graphloc.errors import ConfigError

    try:
        found: list[int] = []
        for part in text.split(","):
            first, colon, end = part.partition(":")
            found += range(int(first), int(end) if colon else int(first) + 1)
    except ValueError:
        found = []
    if not found or min(found) < 0 or len(found) > 1_000_000:
        raise ConfigError(f"--seeds {text}: write FIRST:END, as 0:50 for the seeds 0 to 49, or 1,2,5")
    return list(dict.fromkeys(found))


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseOptions:
    """Options that say which cases to run."""

    scenarios: Annotated[list[str] | None, typer.Argument(help="Scenarios of the simulator, e.g. bl1-drift.")] = None
    seeds: Annotated[str | None, typer.Option(help="0:50 for seeds 0 to 49, or 1,2,5; default: 0.")] = None
    changes: Annotated[
        list[str] | None, typer.Option("--set", help="Vary a field of the scenario: --set gnss_hz=1,10.")
    ] = None
    config_changes: Annotated[
        list[str] | None,
        typer.Option("--config-set", help="Vary a key of vessel.yaml: --config-set sensors.gnss.sigma_scale=1,2."),
    ] = None
    bag: Annotated[
        list[Path] | None, typer.Option(help="A bag instead of scenarios; repeat for more, all with one --config.")
    ] = None
    config: Annotated[Path | None, typer.Option("--config", "-c", help="The vessel.yaml of the bags.")] = None
    hold_out: HoldOutOption = None
    mode: Annotated[_Mode, typer.Option(help="offline: smooth; online: replay; compare: both, and the EKFs.")] = (
        _Mode.offline
    )

    def check(self) -> None:
        """Refuse options that do not go together.

        Raises:
            ConfigError: they do not.
        """
        from graphloc.errors import ConfigError

        if self.scenarios and self.bag:
            raise ConfigError("scenarios and --bag: give one of them, each is a sweep of its own")
        if self.bag and self.config is None:
            raise ConfigError("--bag: give its vessel.yaml, too: --config")
        if (self.changes or self.seeds) and not self.scenarios:
            raise ConfigError(
                "--set and --seeds are of a scenario, and none is named; for a configuration: --config-set"
            )
        if self.config is not None and not self.bag:
            raise ConfigError("--config goes with --bag; what a scenario's configuration says, --config-set changes")

    def jobs(self) -> list[Job]:
        """Return every combination of scenarios or bags, changes and seeds."""
        from graphloc.job import Job, variations

        plain = Job(mode=self.mode.value, hold_out=self.hold_out or "")
        config = str(self.config and self.config.absolute())
        jobs = [replace(plain, bag=str(path.absolute()), config=config) for path in self.bag or ()]
        for name, changes in itertools.product(self.scenarios or (), variations(self.changes or (), "--set")):
            jobs.append(replace(plain, scenario=name, changes=changes))
        seeds = seeds_of(self.seeds or "0") if self.scenarios else (0,)
        varied = variations(self.config_changes or (), "--config-set")
        return [replace(job, config_changes=c, seed=seed) for job in jobs for c in varied for seed in seeds]


def sweep(
    options: CaseOptions,
    out: OutOption = Path("runs/sweep"),
    jobs: JobsOption = None,
    scheduler: Annotated[str, typer.Option(help="Use a Dask scheduler instead, e.g. tcp://host:8786.")] = "",
    overwrite: OverwriteOption = False,
) -> None:
    """Run many scenarios, seeds or bags with varied parameters and write one table of results."""
    from graphloc.errors import InputError
    from graphloc.eval.sweep_table import summary
    from graphloc.sweep import sweep as run_sweep

    options.check()
    cases = options.jobs()
    try:
        workers = jobs or os.cpu_count() or 1
        table = run_sweep(cases, out, workers=workers, scheduler=scheduler, overwrite=overwrite, progress=progress())
    except KeyboardInterrupt:
        raise Stopped(f"{out} keeps the runs that are done; the same command goes on from there") from None
    typer.echo(summary(table))
    typer.echo(str(out / "table.parquet"))
    if all(row["error"] for row in table):
        raise InputError(f"{out}: every run failed: see summary.md; the same command tries them again")
