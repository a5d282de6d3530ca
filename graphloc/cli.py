# SPDX-License-Identifier: Apache-2.0
"""The command line. Known errors are one line and exit 2; heavy imports wait until a command runs."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from graphloc import __version__
from graphloc.errors import GraphlocError

app = typer.Typer(
    name="graphloc",
    help="Factor-graph localisation for vessels where GNSS lies.",
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)

BagArgument = Annotated[list[Path], typer.Argument(help="A ROS 1 or ROS 2 bag; several for the parts of a split one.")]
ConfigOption = Annotated[Path, typer.Option("--config", "-c", help="The vessel.yaml.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")]
HoldOutOption = Annotated[
    str | None, typer.Option("--hold-out", help="Keep fixes out and predict them: every:N, or gaps:COUNTxSECONDS.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what is there already.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")]


def _progress() -> Callable[[str, int, int], None]:
    """A progress bar on stderr, on a terminal only."""
    from tqdm import tqdm

    state: dict[str, tqdm[None]] = {}

    def show(stage: str, done: int, total: int) -> None:
        for name in [n for n in state if n != stage]:
            state.pop(name).close()
        if stage not in state:
            state[stage] = tqdm(total=total, desc=stage, disable=None, file=sys.stderr, leave=False)
        state[stage].n = done
        state[stage].refresh()
        if done >= total:
            state.pop(stage).close()

    return show


@app.command()
def inspect(
    bag: BagArgument,
    config: Annotated[Path, typer.Option("--write", "-w", help="Where to write the first vessel.yaml.")] = Path(
        "vessel.yaml"
    ),
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Print what a bag holds and write a first vessel.yaml, every guess marked."""
    from graphloc.errors import OutputError
    from graphloc.frontends import inspect as inspection

    found = inspection.inspect_bag(bag)
    typer.echo(json.dumps(found.as_dict(), indent=2) if as_json else inspection.render(found))
    if config.exists() and not overwrite:
        raise OutputError(f"{config}: exists already; give --write another name, or --overwrite")
    try:
        config.write_text(inspection.draft_config(found), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{config}: cannot be written ({error.strerror})") from None
    typer.echo(f"wrote {config}: look at each line marked 'guess'", err=True)


def _smooth(
    bag: list[Path], config: Path, out: Path, hold_out: str | None, overwrite: bool, as_json: bool, compare: bool
) -> None:
    from graphloc import app as application
    from graphloc import outputs
    from graphloc.eval.holdout import HoldOut

    held = None if hold_out is None else HoldOut.parse(hold_out)
    outputs.check_folder(out, overwrite=overwrite)
    show = _progress()
    recording, vessel = application.load(bag, config, show)
    scans = application.Scans(tuple(bag), config.parent)
    run = application.smooth_recording(recording, vessel, hold_out=held, compare=compare, scans=scans, progress=show)
    report = application.write(run, out, inputs=bag, command=" ".join(sys.argv[1:]), overwrite=overwrite)
    _print_run(run, report, as_json)


def _print_run(run: object, report: Path, as_json: bool) -> None:
    from graphloc import app as application

    assert isinstance(run, application.Run)
    found = application.tables(run)
    warnings = (*run.recording.warnings, *run.solution.stats.warnings)
    if as_json:
        numbers = {t.title: t.as_dict() for t in found}
        told = {"ledger": run.solution.ledger.counts(), "converged": run.solution.stats.converged, "warnings": warnings}
        typer.echo(json.dumps({**numbers, **told}, indent=2))
    else:
        if not found:
            typer.echo(application.truth_statement(run))
        for table in found:
            typer.echo(table.as_text())
        for name, counts in run.solution.ledger.counts().items():
            typer.echo(f"  {name}: " + ", ".join(f"{n} {outcome}" for outcome, n in counts.items()))
        for warning in warnings:
            typer.echo(f"warning: {warning}", err=True)
    typer.echo(str(report))


@app.command()
def smooth(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    hold_out: HoldOutOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Smooth a whole run and write the run folder with its report."""
    _smooth(bag, config, out, hold_out, overwrite, as_json, compare=False)


@app.command()
def compare(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    hold_out: HoldOutOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Smooth a run, run the thesis EKF and an honest EKF on the same measurements, and report all."""
    _smooth(bag, config, out, hold_out, overwrite, as_json, compare=True)


def _status_line() -> Callable[[float, float, object, str], None]:
    """A live line on stderr, on a terminal only."""
    import time

    from graphloc.estimate import Estimate

    shown_s, live = 0.0, sys.stderr.isatty()
    begun = time.monotonic()

    def show(at_s: float, whole_s: float, estimate: object, waiting: str) -> None:
        nonlocal shown_s
        if not live or (time.monotonic() - shown_s < 0.2 and at_s < whole_s - 0.2):
            return
        shown_s = time.monotonic()
        text = f"{at_s:7.1f} of {whole_s:.0f} s, {at_s / max(shown_s - begun, 1e-3):.1f} x: "
        if isinstance(estimate, Estimate):
            since = ", ".join(f"{name} {s:.1f} s" for name, s in estimate.since_agreed_s.items())
            text += f"{estimate.health}, within {estimate.bound_95_m:.2f} m; agreed: {since}"
        else:
            text += f"waiting for {waiting}"
        sys.stderr.write(f"\r\033[K{text[:118]}")
        sys.stderr.flush()

    return show


@app.command()
def replay(
    bag: BagArgument,
    config: ConfigOption,
    out: OutOption,
    rate: Annotated[
        float | None, typer.Option(min=0.01, help="Times the run's own time, as 1; by default as fast as it can.")
    ] = None,
    lag: Annotated[float, typer.Option(min=1.0, help="How long measurements are re-judged, s.")] = 10.0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a bag through the online mode, as a vessel would have, and write the run folder."""
    from graphloc import app as application
    from graphloc import outputs

    outputs.check_folder(out, overwrite=overwrite)
    recording, vessel = application.load(bag, config, _progress())
    scans = application.Scans(tuple(bag), config.parent)
    run = application.replay_recording(recording, vessel, scans=scans, rate=rate, lag_s=lag, status=_status_line())
    if sys.stderr.isatty():
        sys.stderr.write("\r\033[K")
    report = application.write(run, out, inputs=bag, command=" ".join(sys.argv[1:]), overwrite=overwrite)
    _print_run(run, report, as_json)


@app.command()
def stream(
    config: ConfigOption,
    rate: Annotated[
        float | None, typer.Option("--rate", min=0.001, max=1000.0, help="Estimates a second; default: each new state.")
    ] = None,
    ledger: Annotated[bool, typer.Option("--ledger", help="Write rows of the ledger, too.")] = False,
    lag: Annotated[float, typer.Option("--lag", min=1.0, help="How long measurements are re-judged, s.")] = 10.0,
    snapshot: Annotated[Path | None, typer.Option("--snapshot", help="File to resume from after a restart.")] = None,
) -> None:
    """Read measurements from standard input, write estimates to standard output: lines of JSON (docs/online-stream.md)."""
    from graphloc.stream import serve

    serve(config, rate_hz=rate, ledger=ledger, lag_s=lag, snapshot=snapshot)


@app.command()
def match(
    bag: BagArgument,
    config: ConfigOption,
    at: Annotated[float, typer.Option("--at", help="Time since the start of the run, s.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")] = Path("match.png"),
    overwrite: OverwriteOption = False,
) -> None:
    """Match one scan to the aerial image, and draw it: scan on image, score, modes."""
    import numpy as np

    from graphloc import app as application
    from graphloc.errors import OutputError
    from graphloc.eval.match_picture import write_picture
    from graphloc.frames import heading_deg_from_yaw

    if out.exists() and not overwrite:
        raise OutputError(f"{out}: exists already; give another --out, or --overwrite")
    show = _progress()
    recording, vessel = application.load(bag, config, show)
    found, _ = application.match_at(recording, vessel, application.Scans(tuple(bag), config.parent), at, show)
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


def _pairs(changes: list[str]) -> dict[str, str]:
    from graphloc.errors import ConfigError

    pairs = [change.partition("=") for change in changes]
    for change, (key, equals, value) in zip(changes, pairs, strict=True):
        if not (key and equals and value):
            raise ConfigError(f"--set {change}: write KEY=VALUE, as in --set camera_hz=15")
    return {key: value for key, _, value in pairs}


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help="bl1-drift, dock-fixed-fog, ...: a wrong name lists them.")],
    out: OutOption,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same run.")] = 0,
    ros: Annotated[int, typer.Option(min=1, max=2, help="ROS version of the bag.")] = 2,
    storage: Annotated[str, typer.Option(help="mcap or sqlite3, of a ROS 2 bag.")] = "",
    harbour: Annotated[str, typer.Option(help="Another harbour than the scenario's: a name or a file.")] = "",
    rig: Annotated[str, typer.Option(help="Other sensors than the scenario's: a name or a file.")] = "",
    changes: Annotated[
        list[str] | None, typer.Option("--set", help="Change the scenario, as in --set camera_hz=15 --set lidar_hz=0.")
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a simulated harbour run: bag, vessel.yaml, aerial image, tag survey, and what only a simulator knows."""
    from graphloc import outputs
    from graphloc.errors import ConfigError
    from graphloc.eval.simulate import find_scenario
    from graphloc.eval.simulate import simulate as run_simulation
    from graphloc.eval.simulate.bag import TRUTH, write_bag

    if storage not in ("", "mcap", "sqlite3") or (storage and ros == 1):
        raise ConfigError(f"--storage {storage}: choose mcap or sqlite3, and ROS 2")
    outputs.check_folder(out, overwrite=overwrite, mark=TRUTH)
    named = {key: value for key, value in (("harbour", harbour), ("rig", rig)) if value}
    run = run_simulation(find_scenario(scenario, {**named, **_pairs(changes or [])}), seed)
    bag, config = write_bag(run, out, ros=ros, storage=storage or "mcap", overwrite=overwrite, progress=_progress())
    typer.echo(f"{bag}\n{config}")


@app.command()
def demo(
    out: OutOption = Path("runs/demo"), seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated run.")] = 0
) -> None:
    """Simulate a harbour run with drifting GNSS and 40 % false matches, smooth it from its bag, and compare."""
    from graphloc.eval.simulate import harbour_scenarios
    from graphloc.eval.simulate import simulate as run_simulation
    from graphloc.eval.simulate.bag import write_bag

    run = run_simulation(replace(harbour_scenarios()["bl1-drift"], lidar_hz=0.0), seed)  # its matches are made up
    bag, config = write_bag(run, out.parent / f"{out.name}-bag", ros=2, overwrite=True, progress=_progress())
    _smooth([bag], config, out, None, True, False, compare=True)


@app.command()
def sensors() -> None:
    """List the kinds of sensors that a vessel.yaml can name."""
    from graphloc.factors import KINDS

    for kind, config in KINDS.items():
        typer.echo(f"{kind:15} {(config.__doc__ or '').splitlines()[0]}")


@app.command("config")
def show_config(
    config: Annotated[Path | None, typer.Option("--config", "-c", help="A vessel.yaml to check.")] = None,
    docs: Annotated[bool, typer.Option("--docs", help="Print docs/configuration.md.")] = False,
) -> None:
    """Print the effective configuration of a vessel.yaml, or the reference of all keys."""
    from graphloc._config_docs import render
    from graphloc.config import effective, load_config
    from graphloc.factors import KINDS

    if docs or config is None:
        typer.echo(render(KINDS), nl=False)
    else:
        typer.echo(json.dumps(effective(load_config(config, KINDS)), indent=2))


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log more, on stderr.")] = False,
) -> None:
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, stream=sys.stderr, format="%(message)s")
    if version:
        typer.echo(f"graphloc {__version__}")
        raise typer.Exit


_INTERRUPTED = 130  # what typer makes of Ctrl-C, as shells do


def main() -> None:
    """Run the command line; known errors become one line and exit 2."""
    try:
        app()
    except GraphlocError as error:
        print(f"graphloc: {error}", file=sys.stderr)
        sys.exit(2)
    except SystemExit as end:
        if end.code != _INTERRUPTED:
            raise
        print("graphloc: interrupted; nothing was left half-written", file=sys.stderr, flush=True)
        os._exit(_INTERRUPTED)  # at once: the solver's thread may be deep in a step that cannot be stopped


if __name__ == "__main__":
    main()
