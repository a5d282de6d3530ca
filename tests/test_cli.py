"""The command line as its user meets it: whole runs, one clear line for bad input, nothing half-written."""

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

from graphloc import outputs
from graphloc.cli._printed import counted
from graphloc.config import load_config
from graphloc.eval import report
from graphloc.eval.simulate import Scenario, bl_scenario, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.factors import KINDS
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.signals.thinning import THINNED
from tests.commands import called
from tests.slowly import simulate_slowly

pytestmark = pytest.mark.usefixtures("map_alone")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_bag(
        simulate_slowly(Scenario(duration_s=15.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3),
        tmp_path_factory.mktemp("cli") / "bag",
        ros=2,
    )


def edited(config: Path, folder: Path, old: str, new: str) -> Path:
    text = config.read_text()
    assert old in text
    path = folder / "edited.yaml"
    path.write_text(text.replace(old, new, 1))
    return path


def test_smooth_writes_a_run_folder_and_does_not_replace_it_unasked(
    bag: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    every, out = report.figures, tmp_path / "run"
    some = ("map", "errors", "nees")  # drawn in full they take longer than the run; tests/test_plots.py draws all
    monkeypatch.setattr(report, "figures", lambda data: {k: f for k, f in every(data).items() if k in some})
    assert called(monkeypatch, "smooth", bag[0], "-c", bag[1], "-o", out, "--json", "--figures") == 0
    assert {"map.png", "map.svg", "errors.png", "nees.svg"} <= {p.name for p in (out / "figures").iterdir()}
    printed = capsys.readouterr().out
    numbers = json.loads(printed[: printed.rindex("}") + 1])
    assert numbers["Against truth"]["graphloc"]["position_rmse_m"] < 0.5
    assert printed.rstrip().endswith("report.html")
    _its_bag_holds_the_track(out)
    hashes = json.loads((out / "run.json").read_text())["inputs_sha256"]
    assert hashes[str(bag[1])] == hashlib.sha256(bag[1].read_bytes()).hexdigest()
    assert {Path(file).name for file in hashes} == {bag[0].name, bag[1].name}
    before = (out / "solution.csv").read_bytes()

    monkeypatch.setattr("graphloc.app.load", lambda *_: pytest.fail("refused only after the bag was read"))
    assert called(monkeypatch, "smooth", bag[0], "-c", bag[1], "-o", out) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (out / "solution.csv").read_bytes() == before


def _its_bag_holds_the_track(out: Path) -> None:
    """The run's own bag is read back as a recording's truth would be, and agrees with solution.csv."""
    table = np.genfromtxt(out / "solution.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    with AnyReader([out / "solution_bag"]) as reader:
        odometry = [c for c in reader.connections if c.topic == "/graphloc/odometry"]
        east = [
            reader.deserialize(raw, c.msgtype).pose.pose.position.x  # type: ignore[attr-defined]
            for c, _, raw in reader.messages(odometry)
        ]
    np.testing.assert_allclose(east, table["east_m"], atol=1e-3)


def test_a_draft_from_inspect_gives_a_track(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`inspect` then `smooth`, nothing edited.

    The antenna's place and the IMU's yaw (5 deg here) are in no bag: that much the track is off.
    """
    scenario = replace(bl_scenario(1, "clean"), duration_s=40.0, imu_hz=50.0, gnss_hz=2.5, compass_hz=2.5)
    where, _ = write_bag(simulate(scenario, 1), tmp_path / "bag", ros=1)
    draft = tmp_path / "vessel.yaml"
    assert called(monkeypatch, "inspect", where, "--out", draft) == 0
    assert "guess" in draft.read_text()
    assert called(monkeypatch, "smooth", where, "-c", draft, "-o", tmp_path / "run", "--json") == 0
    printed = capsys.readouterr().out
    assert f"<h1>{where.name}</h1>" in (tmp_path / "run" / "report.html").read_text()  # not 'run: run.bag'
    truth = json.loads(printed[printed.index('{\n  "Against') : printed.rindex("}") + 1])["Against truth"]["graphloc"]
    assert truth["position_rmse_m"] < 3.0
    assert truth["heading_rmse_deg"] < 6.0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("kind: gnss", "knid: gnss", "did you mean 'kind'"),
        ("kind: gnss", "kind: gnsss", "did you mean 'gnss'"),
        ("kind: gnss", "kind: gps", "did you mean 'gnss'"),  # as near as 'pose', which begins otherwise
        ("sensors:", "sensros:", "did you mean 'sensors'"),
        ("sensors:", "sensors:\n  b: {kind: gnss, topic: /gnss/fix}", "both read /gnss/fix, which would count twice"),
        (
            "sensors:",
            "sensors:\n  b: {kind: gnss, topic: /gnss/fix, fixes: rtk}",
            "both read /gnss/fix, which would count twice",
        ),
        (
            "topic: /matcher/pose",
            "topic: /truth",
            "truth_topic: matcher fuses /truth, and a comparison with it says nothing",
        ),
        ("topic: /gnss/fix", "topic: /gnss/fxi", "/gnss/fix"),
        ("kind: imu", "kind: imu\n    accel_unit: furlong", "accel_unit"),
        ("kind: imu", "kind: imu\n    accel_noise_ug_per_sqrt_hz: -3", "accel_noise_ug_per_sqrt_hz"),
        (
            "sensors:",
            "sensors:\n  b: {kind: compass, topic: /c, mount: {xyz_m: [0, 0]}}",
            "sensors.b.mount.xyz_m: 3 values are wanted (got [0, 0])",
        ),
        (
            "sensors:",
            "sensors:\n  b: {kind: compass, topic: /c, mount: {xyz_m: [0]}}",
            "edited.yaml: sensors.b.mount.xyz_m: 3 values are wanted (got [0])",
        ),
        (
            "sensors:",
            "sensors:\n  b: {kind: compass, topic: /c, mount: {xyz_m: [0, 1, 2, 3]}}",
            "xyz_m: 3 values are wanted (got [0, 1, 2, 3])",
        ),
        (
            "sensors:",
            "sensors:\n  b: {kind: compass, topic: /c, mount: {xyz_m: 1.5}}",
            "xyz_m: a list in brackets is wanted (got 1.5)",
        ),
        ("kind: gnss", "kind: gnss\n    kernel: 2", "kernel: a block of keys is wanted (got 2)"),
        ("sensors:", "sensors: [", "that begins in line 2)"),
        ("sensors:", "vessel: !!python/object/apply:os.system ['touch pwned']\nsensors:", "not valid YAML"),
    ],
)
def test_a_bad_vessel_yaml_is_one_line(
    bag: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    config = edited(bag[1], tmp_path, old, new)
    assert called(monkeypatch, "smooth", bag[0], "-c", config, "-o", tmp_path / "run") == 2
    line = capsys.readouterr().err.strip().splitlines()
    assert len(line) == 1
    assert line[0].startswith("graphloc: ")
    assert said in line[0]
    assert str(config) in line[0] or str(bag[0]) in line[0]
    assert not (tmp_path / "run").exists()
    assert not (tmp_path / "pwned").exists()


def test_bad_arguments_are_one_line(
    bag: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("precious")
    file = tmp_path / "file"
    file.write_text("")
    good = ["smooth", bag[0], "-c", bag[1], "-o", tmp_path / "run"]
    for arguments, said in (
        (["smooth", tmp_path / "none.bag", *good[2:]], "none.bag"),
        (["smooth", bag[0], "-c", tmp_path / "none.yaml", *good[4:]], "graphloc inspect"),
        ([*good, "--hold-out", "every:x"], "every:"),
        ([*good, "--hold-out", "gaps:500x10"], "gaps"),
        ([*good[:5], mine, "--overwrite"], "holds no run.json"),
        ([*good[:5], file], "is a file"),
        ([*good[:5], Path(os.devnull)], "is a file"),
        ([*good[:5], file / "run"], "is a file"),
        (["simulate", "bl1-pink", "-o", tmp_path / "sim"], "bl1-pink"),
        (["inspect", bag[0], "-o", bag[1] / "x.yaml"], "is a file, and a folder is wanted"),
        (["inspect", tmp_path / "none.bag", "-o", file], f"{file}: exists already"),  # before minutes of reading
        (["smoth"], "Did you mean 'smooth'"),
        (["smooth"], "see graphloc smooth --help"),
        ([*good, "--foo"], "--foo"),
        (["replay", *good[1:], "--speed", "fast"], "--speed"),
        (["sweep", "bl1-drift", "--mode", "x"], "--mode"),
    ):
        assert called(monkeypatch, *arguments) == 2, arguments
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1, lines
        assert said in lines[0]
        assert lines[0].startswith("graphloc: ")
    assert (mine / "thesis.txt").read_text() == "precious"


def test_a_place_that_may_not_be_written_to_is_refused_before_the_work(
    bag: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "shut").mkdir()
    may = os.access  # tests may run as root, who may write everywhere
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path / "shut" and may(path, mode))
    monkeypatch.setattr("graphloc.app.load", lambda *_, **__: pytest.fail("refused only after the bag was read"))
    good = ["-c", bag[1], "-o", tmp_path / "shut/new/run"]
    for arguments in (
        *([command, bag[0], *good] for command in ("smooth", "compare", "replay", "ablate", "drill")),
        ["smooth", bag[0], *good[:3], tmp_path / "run", "--rerun", tmp_path / "shut/run.rrd"],
    ):
        assert called(monkeypatch, *arguments) == 2, arguments
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert "Permission denied" in line
        assert str(tmp_path / "shut") in line


def test_a_full_disk_leaves_nothing(
    bag: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(outputs, "_tum", full)
    assert called(monkeypatch, "smooth", bag[0], "-c", bag[1], "-o", tmp_path / "run") == 2
    assert "No space left" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_interrupt_while_writing_leaves_nothing_and_keeps_the_old_run(
    bag: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / outputs.MARK).write_text("{}")

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    def end(code: int) -> None:
        raise SystemExit(code)

    monkeypatch.setattr(report, "write_report", interrupted)
    monkeypatch.setattr(os, "_exit", end)
    assert called(monkeypatch, "smooth", bag[0], "-c", bag[1], "-o", out, "--overwrite") == 130
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert (out / outputs.MARK).read_text() == "{}"


def test_ctrl_c_in_the_solver_ends_at_once(tmp_path: Path) -> None:
    scenario = replace(bl_scenario(1, "drift"), duration_s=60.0, imu_hz=20.0, gnss_hz=2.0, compass_hz=2.0)
    where, config = write_bag(simulate(scenario, 2), tmp_path / "bag", ros=2)
    command = [sys.executable, "-m", "graphloc", "smooth", where, "-c", config, "-o", tmp_path / "run"]
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a `nohup` runner ignores it
        "from graphloc import cli; from graphloc.solve import _start; grow = _start.solve_start\n"
        "def told(*a, **k): print('solving', flush=True); return grow(*a, **k)\n"
        "import graphloc.solve._first_solution as b; b.solve_start = told\n"
        f"sys.argv = {['graphloc', *map(str, command[3:])]!r}; cli.main()"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert started.stdout is not None
    assert started.stdout.readline().strip() == "solving"
    time.sleep(0.3)
    began = time.monotonic()
    started.send_signal(signal.SIGINT)
    _, err = started.communicate(timeout=20)
    assert started.returncode == 130
    assert time.monotonic() - began < 5.0
    (line,) = err.strip().splitlines()
    assert line.startswith("graphloc: interrupted")
    assert {p.name for p in tmp_path.iterdir()} == {"bag"}


@pytest.mark.parametrize(("folder", "holds"), [("demo", "run.json"), ("demo-bag", "truth.json")])
def test_demo_replaces_no_folder_unasked(
    folder: str, holds: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It did so, also with the run of another bag at --out."""
    (tmp_path / folder).mkdir()
    (tmp_path / folder / holds).write_text("mine")
    assert called(monkeypatch, "demo", "-o", tmp_path / "demo") == 2
    assert f"{folder}: exists already; give --overwrite" in capsys.readouterr().err
    assert (tmp_path / folder / holds).read_text() == "mine"


def test_sensors_and_config_are_listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(monkeypatch, "sensors") == 0
    listed = capsys.readouterr().out
    assert {"imu", "gnss", "compass", "pose"} <= {line.split()[0] for line in listed.splitlines()}
    assert "makers' messages" in listed
    assert not set("[]`") & set(listed)  # links and code of docs/configuration.md
    assert called(monkeypatch, "config", "--docs") == 0
    written = (Path(__file__).parent.parent / "docs/configuration.md").read_text()
    assert capsys.readouterr().out == written, (
        "docs/configuration.md: run `graphloc config --docs > docs/configuration.md`"
    )


def test_a_configuration_is_printed_as_one_that_says_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was printed as JSON, which is no file of the product."""
    given, printed = tmp_path / "vessel.yaml", tmp_path / "printed.yaml"
    given.write_text(
        "datum: {latitude_deg: 57.7, longitude_deg: 11.9, height_m: 40.0}\nsensors:\n  imu: {kind: imu, topic: /imu}\n"
        "  '010': {kind: gnss, topic: /fix, sigma_scale: 1.0e-5, mount: {xyz_m: [1, 2, 3]}}\n"
    )
    assert called(monkeypatch, "config", "-c", given) == 0
    printed.write_text(text := capsys.readouterr().out)
    assert load_config(printed, KINDS) == load_config(given, KINDS)
    assert "xyz_m: [1.0, 2.0, 3.0]" in text
    assert (
        text.index("kind: gnss") < text.index("topic: /fix") < text.index("sigma_scale:")
    )  # as documented, not by the alphabet
    assert called(monkeypatch, "config", "--json", "-c", given) == 0
    assert json.loads(capsys.readouterr().out) == YAML(typ="safe", pure=True).load(text)


def test_headings_that_were_only_too_close_together_are_counted_apart() -> None:
    """'24064 rejected, 6016 used' of an AHRS at 100 Hz read as a wrong mount."""
    outcomes = [Outcome.USED, Outcome.REJECTED, Outcome.REJECTED]
    reasons = ["", THINNED, "scattered"]
    rows = [
        LedgerRow(seq=k, stamp_ns=k, sensor=sensor, topic="/imu", outcome=outcome, reason=why)
        for k, (sensor, outcome, why) in enumerate(
            [*(("compass", o, w) for o, w in zip(outcomes, reasons, strict=True)), ("gnss", Outcome.REJECTED, "no fix")]
        )
    ]
    assert list(counted(Ledger(rows))) == [
        "  compass: 2 rejected (1 of them only as too close to the one before), 1 used",
        "  gnss: 1 rejected",
    ]
