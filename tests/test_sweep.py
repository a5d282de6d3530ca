"""Many runs: the same table whoever computes it, a row for what fails, and going on after a stop."""

import json
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from graphloc import app, cli, extras, sweep
from graphloc.cli._sweep import seeds_of
from graphloc.config import with_changes
from graphloc.errors import ConfigError, ExtraError, InputError, OutputError
from graphloc.eval import sweep_table
from graphloc.eval.simulate import Scenario, find_scenario, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.job import Job, Row, check, run_job, variations
from tests.commands import called

LESS = {"duration_s": "6", "imu_hz": "50", "gnss_hz": "5", "compass_hz": "2"}
SHORT = Job(scenario="bl1-drift", changes=tuple(LESS.items()))
BROKEN = replace(SHORT, config_changes=(("sensors.imu.enabled", "false"),))


def timeless(rows: Sequence[Row]) -> list[Row]:
    return [{k: v for k, v in row.items() if k not in ("took_s", "run")} for row in rows]


def killed(_job: Job) -> list[Row]:
    """What Dask says of a worker that is gone comes as an exception of the run."""
    raise MemoryError("all of it")


def in_process(ran: list[Job]) -> Any:
    """Stands in for Dask: runs here, and notes what. What ran before comes out the same, as `test_workers_give_...` shows."""
    done = cache(run_job)

    def run(jobs: Sequence[Job], _workers: int, _scheduler: str, _stack: ExitStack) -> Iterator[tuple[Job, list[Row]]]:
        for job in reversed(jobs):  # as they end, not as they were asked for
            ran.append(job)
            yield job, [dict(row) for row in done(job)]

    return run


def test_values_are_varied_in_every_combination() -> None:
    found = variations(["outage_s=[10,20],(5, 6)", "noise=jump"], "--set")
    assert found == [(("outage_s", "[10,20]"), ("noise", "jump")), (("outage_s", "(5, 6)"), ("noise", "jump"))]
    assert variations([], "--set") == [()]
    assert find_scenario("bl1-drift", dict(found[1])).outage_s == (5.0, 6.0)
    assert seeds_of("3:6,9,4") == [3, 4, 5, 9]


def test_keys_with_dots_change_a_configuration_and_leave_the_other_as_it_was() -> None:
    raw = {"sensors": {"gnss": {"kind": "gnss", "slow_error": {"jumps": True}}}, "start": None}
    changed = with_changes(raw, {"sensors.gnss.slow_error.jumps": False, "start.window_s": 5}, "x")
    assert changed == {
        "sensors": {"gnss": {"kind": "gnss", "slow_error": {"jumps": False}}},
        "start": {"window_s": 5},
    }
    assert raw["start"] is None
    assert raw["sensors"] == {"gnss": {"kind": "gnss", "slow_error": {"jumps": True}}}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to run"),
        (["bl1-drfit"], "did you mean bl1-drift"),
        (["bl1-drift", "--set", "gnss_hzz=1"], "did you mean gnss_hz"),
        (["bl1-drift", "--set", "gnss_hz=1,furlong"], "gnss_hz=furlong"),
        (["bl1-drift", "--set", "gnss_hz=1", "--set", "gnss_hz=2"], "each key once"),
        (["bl1-drift", "--set", "gnss_hz"], "KEY=VALUE"),
        (["bl1-drift", "--config-set", "sensors.gnss.sigma_scal=1"], "did you mean 'sigma_scale'"),
        (["bl1-drift", "--config-set", "sensors.gnsss.sigma_scale=1"], "did you mean 'gnss'"),
        (["bl1-drift", "--config-set", "sensors.gnss.kind.x=1"], "'kind' is a value"),
        (["bl1-drift", "--config-set", "sensors.gnss.sigma_scale=1,-1"], "greater than 0"),
        (["bl1-drift", "--config-set", "sensors.gnss.sigma_scale=!!python/name:os.system"], "not valid YAML"),
        (["bl1-drift", "--seeds", "5:5"], "--seeds 5:5"),
        (["bl1-drift", "--seeds", "-1"], "--seeds -1"),
        (["bl1-drift", "--seeds", "a"], "--seeds a"),
        (["bl1-drift", "--mode", "online", "--hold-out", "every:5"], "not built"),
        (["bl1-drift", "--hold-out", "x"], "every:N"),
        (["--bag", "none.bag"], "--config"),
        (["--bag", "none.bag", "-c", "none.yaml"], "none.yaml"),
        (["bl1-drift", "--bag", "none.bag"], "one of them"),
        (["--set", "gnss_hz=1"], "none is named"),
        (["--bag", "x", "-c", "y", "--seeds", "0:2"], "none is named"),
    ],
)
def test_what_cannot_run_is_one_line_before_anything_runs(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.setattr(sweep, "_on_dask", lambda *_: pytest.fail("something ran"))
    assert called(monkeypatch, "sweep", *arguments, "-o", tmp_path / "s") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert said in lines[0]
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(("given", "workers"), [([], 7), (["--jobs", "2"], 2)])
def test_as_many_processes_as_cores(
    given: list[str], workers: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of `ablate` and `drill`; it was one."""
    taken = list[int]()
    monkeypatch.setattr("os.cpu_count", lambda: 7)

    def note(jobs: Sequence[Job], number: int, *_: object) -> Iterator[tuple[Job, list[Row]]]:
        taken.append(number)
        yield from ((job, [{"case": "", "error": "not run"}]) for job in jobs)

    monkeypatch.setattr(sweep, "_on_dask", note)
    called(monkeypatch, "sweep", "bl1-drift", "--set", "duration_s=6", *given, "-o", tmp_path / "s")
    assert taken == [workers]


def test_workers_give_what_this_process_gives(tmp_path: Path) -> None:
    """Every number but the time, offline to the last bit; a run that fails is a row, and the others go on."""
    jobs = [SHORT, BROKEN, replace(SHORT, seed=1, mode="online")]
    table = sweep.sweep(jobs, tmp_path / "s", workers=1)  # one is another process as well; each takes 3 s to load all
    here = [row for job in jobs for row in run_job(job)]
    (*offline, online), (*offline_here, online_here) = timeless(table), timeless(here)
    assert offline == offline_here
    for name, value in online.items():  # iSAM2 differs by some 1e-11 from run to run, in one process, too
        assert online_here[name] == (pytest.approx(value, rel=1e-7) if isinstance(value, float) else value), name
    assert [row["run"] for row in table] == [0, 1, 2]
    assert [bool(row["error"]) for row in table] == [False, True, False]

    run = simulate(find_scenario("bl1-drift", dict(SHORT.changes)), 0)
    track = app.simulated(run).solution.trajectory
    true = run.truth.at(run.truth.stamps_ns[track.covers(run.truth.stamps_ns)])
    off = (track.at(true.stamps_ns).p_world_m - true.p_world_m)[:, :2]
    assert table[0]["position_rmse_m"] == pytest.approx(float(np.sqrt((off**2).sum(axis=1).mean())), rel=1e-12)

    read = pyarrow.parquet.read_table(tmp_path / "s/table.parquet").to_pylist()
    assert [r["position_rmse_m"] for r in read] == [r.get("position_rmse_m") for r in table]
    assert [r["set.duration_s"] for r in read] == [6.0] * 3
    assert "no IMU" in read[1]["error"] or "imu" in read[1]["error"].lower()


def test_a_scheduler_by_address_and_one_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(sweep, "_CONNECT_S", 0.5)
    with pytest.raises(InputError, match="no Dask scheduler"):
        sweep.sweep([BROKEN], tmp_path / "a", scheduler="tcp://127.0.0.1:9")
    assert not (tmp_path / "a").exists()
    with LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as cluster:
        table = sweep.sweep([BROKEN], tmp_path / "b", scheduler=cluster.scheduler_address)
        assert timeless(table) == timeless(run_job(BROKEN))
        monkeypatch.setattr(sweep, "run_job", killed)
        (row,) = sweep.sweep([SHORT], tmp_path / "d", scheduler=cluster.scheduler_address)
        assert (row["case"], row["error"]) == (
            "bl1-drift duration_s=6 imu_hz=50 gnss_hz=5 compass_hz=2",
            "its worker died: MemoryError: all of it",
        )
        monkeypatch.setattr(sweep, "_versions", lambda: {"thread": threading.current_thread().name})
        with pytest.raises(InputError, match="install the same"):
            sweep.sweep([BROKEN], tmp_path / "c", scheduler=cluster.scheduler_address)


def test_what_was_stopped_goes_on_and_ends_with_the_same_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [SHORT, BROKEN, replace(SHORT, seed=1), replace(SHORT, seed=2)]
    ran: list[Job] = []
    monkeypatch.setattr(sweep, "_on_dask", in_process(ran))
    whole = sweep.sweep(jobs, tmp_path / "whole")
    assert ran == jobs[::-1]

    folder = tmp_path / "stopped"
    sweep.sweep(jobs[2:], folder)  # some are there, and the last line was being written
    runs = folder / "runs.jsonl"
    lines = runs.read_bytes().splitlines(keepends=True)
    odd = (
        json.dumps({"job": jobs[0].key, "rows": []}).encode()
        + b"\n"
        + json.dumps({"job": "x", "rows": 3}).encode()
        + b"\n"
    )
    runs.write_bytes(b"\0\0\0\n" + odd + lines[0] + lines[1][: len(lines[1]) // 2])
    ran.clear()
    assert timeless(sweep.sweep(jobs, folder)) == timeless(whole)
    assert ran == [jobs[2], jobs[1], jobs[0]]
    tables = [
        pyarrow.parquet.read_table(f / "table.parquet").drop_columns("took_s") for f in (tmp_path / "whole", folder)
    ]
    assert tables[0].equals(tables[1])

    ran.clear()
    assert timeless(sweep.sweep(jobs, folder)) == timeless(whole)
    assert ran == [BROKEN]  # what failed is tried again
    mark = json.loads((folder / sweep.MARK).read_text())
    (folder / sweep.MARK).write_text(json.dumps({**mark, "versions": {"graphloc": "0"}}))
    with pytest.raises(OutputError, match="other versions"):
        sweep.sweep(jobs, folder)
    for broken in ("[]", "{}", json.dumps({**mark, "inputs_sha256": None})):
        (folder / sweep.MARK).write_text(broken)
        with pytest.raises(OutputError, match="cannot be read"):
            sweep.sweep(jobs, folder)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("precious")
    with pytest.raises(OutputError, match=sweep.MARK):
        sweep.sweep(jobs, tmp_path / "mine", overwrite=True)


def test_a_bag_with_its_configuration_varied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten times the noise that fixes claim: the track must feel it. Another file under the same name is refused."""
    bag, config = write_bag(
        simulate(Scenario(duration_s=8.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3), tmp_path / "bag", ros=2
    )
    (config.parent / "map.png").write_bytes(b"quay")
    config.write_text(config.read_text() + "\noutput: {map_image: map.png}\n")
    job = Job(bag=str(bag), config=str(config))
    jobs = [replace(job, config_changes=(("sensors.gnss.sigma_scale", k),)) for k in ("1", "10")]
    monkeypatch.setattr(sweep, "_on_dask", in_process([]))
    first, second = sweep.sweep(jobs, tmp_path / "s")
    assert (first["config.sensors.gnss.sigma_scale"], second["config.sensors.gnss.sigma_scale"]) == ("1", "10")
    assert first["messages"] == second["messages"]
    assert first["position_rmse_m"] != second["position_rmse_m"]
    (config.parent / "map.png").write_bytes(b"quay, rebuilt")
    with pytest.raises(OutputError, match="other versions or inputs"):
        sweep.sweep(jobs, tmp_path / "s")
    (config.parent / "map.png").write_bytes(b"quay")
    config.write_text(config.read_text() + "\n")
    with pytest.raises(OutputError, match="other versions or inputs"):
        sweep.sweep(jobs, tmp_path / "s")
    config.write_text(config.read_text().replace("truth_topic: /truth", ""))
    with pytest.raises(ConfigError, match="give --hold-out"):
        check(jobs)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no bag at all")
    with pytest.raises(InputError, match=r"broken\.mcap"):
        check([replace(job, bag=str(broken), hold_out="every:5")])
    text = config.read_text()
    config.write_text(text.replace("/gnss/fix", "/gnss/fax"))
    with pytest.raises(InputError, match="'/gnss/fax' is not in the bag"):
        check([replace(job, hold_out="every:5")])
    config.write_text(text)
    (held,) = run_job(replace(job, hold_out="every:5"))
    assert 0.0 < held["held_out_horizontal_rmse_m"] < 2.0


def test_a_scenario_that_needs_scans_is_run_from_a_bag(monkeypatch: pytest.MonkeyPatch) -> None:
    """Matches made up need none; scans to be matched, or images, do."""

    def written(*_: Any, **__: Any) -> None:
        raise OutputError("a bag was written")

    monkeypatch.setattr("graphloc.job.write_bag", written)
    assert not run_job(SHORT)[0]["error"]
    for name, changes in (("bl3-clean", (("pose_hz", "0"),)), ("dock-fixed-fog", (("lidar_hz", "0"),))):
        (row,) = run_job(Job(scenario=name, changes=changes))
        assert row["error"] == "a bag was written"


def test_the_summary_names_mean_worst_and_what_failed() -> None:
    rows = [
        {
            "run": n,
            "case": "a",
            "seed": 10 + n,
            "estimate": "graphloc",
            "error": "",
            "position_rmse_m": v,
            "coverage_95": c,
        }
        for n, (v, c) in enumerate([(1.0, 0.9), (4.0, 1.0), (1.0, 0.5)])
    ]
    rows.append({"run": 3, "case": "a", "seed": 13, "estimate": "", "error": "boom"})
    text = sweep_table.summary(rows)
    assert "| a | graphloc | 3 | 2.000, 4.000 (11) | 0.800, 0.500 (12) |" in text
    assert "4 runs, 1 failed" in text
    assert "- a, seed 13: boom" in text
    assert "| x=a\\|b | graphloc |" in sweep_table.summary([{**rows[0], "case": "x=a|b"}])


def test_a_sweep_that_was_broken_off_or_failed_throughout_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["graphloc", "sweep", "bl3-clean", "-o", str(tmp_path / "s")])
    monkeypatch.setattr(os, "_exit", sys.exit)
    failed = {"run": 0, "case": "my.bag", "seed": None, "estimate": "", "error": "my.bag: is none"}
    for rows, code, said in (([failed], 2, "every run failed"), (None, 130, "the same command goes on")):

        def run(*_: object, rows: object = rows, **__: object) -> object:
            if rows is None:
                raise KeyboardInterrupt
            return rows

        monkeypatch.setattr(sweep, "sweep", run)
        with pytest.raises(SystemExit) as end:
            cli.main()
        told = capsys.readouterr()
        assert end.value.code == code
        assert said in told.err
        assert len(told.err.strip().splitlines()) == 1
        assert rows is None or "1 run, 1 failed" in told.out
        assert rows is None or "- my.bag: is none" in told.out


def test_a_part_that_is_not_installed_is_one_line() -> None:
    with pytest.raises(ExtraError, match=r"^not_there is not installed: pip install 'graphloc\[sweep\]'$"):
        extras.need("not_there.inner", "sweep")
