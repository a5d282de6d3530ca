# SPDX-License-Identifier: Apache-2.0
"""Commands that make a track or a part of it: inspect, smooth, replay, stream, match."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from graphloc.cli._progress import progress, status_line
from graphloc.cli._shared import (
    BagArgument,
    BagOptions,
    ConfigOption,
    HoldOutOption,
    JsonOption,
    LagOption,
    OverwriteOption,
    RunOptions,
    smooth_bags,
)


def inspect(
    bag: BagArgument,
    config: Annotated[Path, typer.Option("--out", "-o", help="The vessel.yaml to write.")] = Path("vessel.yaml"),
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show what a bag holds and write a first vessel.yaml, with every guess marked."""
    from graphloc.errors import InputError, OutputError
    from graphloc.folders import check_writable
    from graphloc.frontends import inspect as inspection

    if config.exists() and not overwrite:
        raise OutputError(f"{config}: exists already; give another --out, or --overwrite")
    check_writable(config)
    found = inspection.inspect_bag(bag)
    typer.echo(json.dumps(found.as_dict(), indent=2) if as_json else inspection.render(found))
    if not found.usable:
        why = "; ".join(found.warnings) or "none of its topics has a supported sensor type (docs/quick-start.md)"
        raise InputError(f"{found.source}: no usable sensor in it, so {config} is not written: {why}")
    try:
        config.parent.mkdir(parents=True, exist_ok=True)
        config.write_text(inspection.draft_config(found), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{config}: cannot be written ({error.strerror})") from None
    typer.echo(f"wrote {config}: check each line marked 'guess'", err=True)


def smooth(options: RunOptions, hold_out: HoldOutOption = None) -> None:
    """Smooth a whole run, or a part of it, and write the run folder with its report."""
    smooth_bags(options, hold_out, compare=False)


def replay(
    options: RunOptions,
    speed: Annotated[
        float | None,
        typer.Option(min=0.01, help="Times real time: 1 plays as recorded; default: as fast as possible."),
    ] = None,
    lag: LagOption = 10.0,
) -> None:
    """Run a bag through the online mode, as if live on board, and write the run folder."""
    from graphloc import app as application

    inputs = options.check_outputs()
    recording, vessel, scans = options.load(progress())
    run = application.replay_recording(recording, vessel, scans=scans, speed=speed, lag_s=lag, status=status_line())
    if sys.stderr.isatty():
        sys.stderr.write("\r\033[K")
    options.write(run, inputs)


def stream(
    config: ConfigOption,
    rate: Annotated[
        float | None,
        typer.Option("--rate", min=0.001, max=1000.0, help="Estimates per second; default: one per new state."),
    ] = None,
    ledger: Annotated[bool, typer.Option("--ledger", help="Also write the rows of the ledger.")] = False,
    lag: LagOption = 10.0,
    snapshot: Annotated[Path | None, typer.Option("--snapshot", help="File to resume from after a restart.")] = None,
) -> None:
    """Read measurements from standard input, write estimates to standard output, as JSON lines (docs/online-stream.md)."""
    from graphloc.stream import serve

    serve(config, rate_hz=rate, ledger=ledger, lag_s=lag, snapshot=snapshot)


def match(
    options: BagOptions,
    at: Annotated[float, typer.Option("--at", help="Time since the start of the run, s.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")] = Path("match.png"),
    overwrite: OverwriteOption = False,
) -> None:
    """Match one LiDAR scan to the aerial image and draw it: scan on image, score, modes."""
    import numpy as np

    from graphloc import app as application
    from graphloc.errors import OutputError
    from graphloc.eval.match_picture import write_picture
    from graphloc.frames import heading_deg_from_yaw

    if out.exists() and not overwrite:
        raise OutputError(f"{out}: exists already; give another --out, or --overwrite")
    show = progress()
    recording, vessel, scans = options.load(show)
    found, _ = application.match_at(recording, vessel, scans, at, show)
    east, north, yaw = found.prior.pose
    typer.echo(
        f"prior: {east:.2f} m east, {north:.2f} m north, heading {float(heading_deg_from_yaw(yaw)):.1f} deg; 1 sigma "
        f"{found.prior.sigma[:2].max():.2f} m, {np.degrees(found.prior.sigma[2]):.1f} deg"
    )
    for mode in found.modes:
        east, north, yaw = mode.pose
        sigma = np.sqrt(np.diagonal(mode.cov))
        typer.echo(
            f"{mode.probability:.2f}: {east:.2f} m east, {north:.2f} m north, heading {float(heading_deg_from_yaw(yaw)):.1f} deg; "
            f"1 sigma {sigma[0]:.2f} m, {sigma[1]:.2f} m, {np.degrees(sigma[2]):.1f} deg"
        )
    typer.echo(f"{found.none:.2f}: none of them" + (f": {found.why_not}" if found.why_not else ""))
    if found.score is None and found.modes:
        return  # BL's matcher scores no pose but its own
    write_picture(found, out)
    typer.echo(str(out))
