# SPDX-License-Identifier: Apache-2.0
"""Commands that simulate a run: simulate, demo."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from graphloc.cli._progress import progress
from graphloc.cli._shared import OutOption, OverwriteOption, RunOptions, SeedOption, smooth_bags


def pairs(changes: list[str]) -> dict[str, str]:
    """Split `KEY=VALUE` texts.

    Raises:
        ConfigError: one is written in another way.
    """
    from graphloc.errors import ConfigError

    pairs = [change.partition("=") for change in changes]
    for change, (key, equals, value) in zip(changes, pairs, strict=True):
        if not (key and equals and value):
            raise ConfigError(f"--set {change}: write KEY=VALUE, as in --set camera_hz=15")
    return {key: value for key, _, value in pairs}


def simulate(
    scenario: Annotated[str, typer.Argument(help="E.g. bl1-drift, dock-fixed-fog; an unknown name lists them all.")],
    out: OutOption,
    seed: SeedOption = 0,
    ros: Annotated[int, typer.Option(min=1, max=2, help="ROS version of the bag.")] = 2,
    storage: Annotated[str, typer.Option(help="Storage of a ROS 2 bag: mcap (default) or sqlite3.")] = "",
    harbour: Annotated[
        str, typer.Option(help="Use another harbour: a shipped name or a file (docs/simulator.md).")
    ] = "",
    rig: Annotated[str, typer.Option(help="Use another vessel and sensors: a shipped name or a file.")] = "",
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change a field of the scenario: --set camera_hz=15 --set lidar_hz=0."),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a simulated harbour run: bag, vessel.yaml, aerial image, tag survey and ground truth."""
    from graphloc.errors import ConfigError
    from graphloc.eval.simulate import find_scenario
    from graphloc.eval.simulate import simulate as run_simulation
    from graphloc.eval.simulate.bag import TRUTH, write_bag
    from graphloc.folders import check_folder

    if storage not in ("", "mcap", "sqlite3") or (storage and ros == 1):
        raise ConfigError(f"--storage {storage}: choose mcap or sqlite3, and ROS 2")
    check_folder(out, overwrite=overwrite, mark=TRUTH)
    named = {key: value for key, value in (("harbour", harbour), ("rig", rig)) if value}
    run = run_simulation(find_scenario(scenario, {**named, **pairs(changes or [])}), seed)
    bag, config = write_bag(run, out, ros=ros, storage=storage or "mcap", overwrite=overwrite, progress=progress())
    typer.echo(f"{bag}\n{config}")


def demo(
    out: OutOption = Path("runs/demo"),
    seed: SeedOption = 0,
    overwrite: OverwriteOption = False,
) -> None:
    """Simulate a harbour run with drifting GNSS and 40 % false matches, smooth its bag, and compare."""
    from graphloc import outputs
    from graphloc.eval.simulate import harbour_scenarios
    from graphloc.eval.simulate import simulate as run_simulation
    from graphloc.eval.simulate.bag import TRUTH, write_bag
    from graphloc.folders import check_folder

    simulated = out.parent / f"{out.name}-bag"
    check_folder(out, overwrite=overwrite, mark=outputs.MARK)
    check_folder(simulated, overwrite=overwrite, mark=TRUTH)
    run = run_simulation(replace(harbour_scenarios()["bl1-drift"], lidar_hz=0.0), seed)  # its matches are made up
    bag, config = write_bag(run, simulated, ros=2, overwrite=overwrite, progress=progress())
    smooth_bags(RunOptions(bag=[bag], config=config, out=out, overwrite=overwrite), compare=True)
