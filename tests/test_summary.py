# SPDX-License-Identifier: Apache-2.0
"""Several finished runs in one summary, from run.json files made by hand."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from graphloc.eval.summary import as_markdown, metric_tables, read_runs, write_summary
from tests.commands import called


def run_folder(parent: Path, name: str, tables: Any, *, converged: bool = True, warnings: int = 0) -> Path:
    folder = parent / name
    folder.mkdir(parents=True)
    run = {"metrics": tables, "stats": {"converged": converged}, "warnings": ["w"] * warnings}
    (folder / "run.json").write_text(json.dumps(run))
    return folder


def truth(ours: tuple[float, float], ekf: tuple[float, float] | None = None) -> dict[str, Any]:
    rows = {"graphloc": ours} | ({"BL EKF": ekf} if ekf else {})
    columns = ("position_rmse_m", "coverage_95")
    return {"Against truth": {name: dict(zip(columns, values, strict=True)) for name, values in rows.items()}}


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    return [
        run_folder(tmp_path, "a", truth((0.1, 0.9), (1.0, 0.2)), warnings=1),
        run_folder(tmp_path, "b|<c>", truth((0.3, 0.7), (1.4, 0.4)), warnings=2),
        run_folder(tmp_path, "d", truth((0.5, 1.0)), converged=False),
    ]


def test_mean_and_worst(three: list[Path]) -> None:
    """Means 0.9 / 3 and 2.4 / 2; the worst error is the largest, the worst coverage the lowest."""
    rmse, coverage = metric_tables(read_runs(three))
    assert (rmse.metric, coverage.metric) == ("position_rmse_m", "coverage_95")
    assert rmse.estimates == ("graphloc", "BL EKF")
    assert rmse.rows[2] == ("d", (0.5, None))
    assert rmse.mean == pytest.approx((0.3, 1.2))
    assert rmse.worst == (0.5, 1.4)
    assert coverage.worst == (0.7, 0.2)


def test_the_ratio_is_over_runs_that_both_have(three: list[Path]) -> None:
    """The EKF has a and b: 2.4 there, ours 0.4 there: 6 times, not 1.2 / 0.3 = 4."""
    runs = read_runs(three)
    text = as_markdown(runs, metric_tables(runs))
    assert "| times the mean of graphloc |  | 6.0 x |" in text
    assert "| b\\|<c> | 0.300 | 1.400 |" in text
    assert "- a, b|<c>: warning: w\n" in text  # a line that both have is said once
    assert text.count("warning: w") == 1
    assert "horizontal error, RMSE, m (position_rmse_m)" in text
    assert "- d: the solver did not converge" in text


def test_the_worst_of_a_number_with_a_sign_is_the_farthest_from_zero(tmp_path: Path) -> None:
    runs = [
        run_folder(tmp_path, n, {"Forward speed": {"graphloc": {"mean_mps": v}}}) for n, v in (("a", -0.5), ("b", 0.2))
    ]
    (table,) = metric_tables(read_runs(runs))
    assert table.worst == (-0.5,)


def test_counts_are_no_decimals(tmp_path: Path) -> None:
    runs = [
        run_folder(tmp_path, n, {"Other": {"graphloc": {"fixes": v, "some_m": 0.5}}})
        for n, v in (("a", 100), ("b", 101))
    ]
    text = as_markdown(read := read_runs(runs), metric_tables(read))
    assert "| a | 100 |" in text
    assert "| mean of the runs | 100.5 |" in text
    assert "| worst of the runs | 100 |" in text  # of fixes the fewest
    assert "| a | 0.500 |" in text


def test_links_lead_to_folders_of_any_name(tmp_path: Path) -> None:
    run = run_folder(tmp_path, "50% #1?", truth((0.1, 0.9)))
    page = write_summary(tmp_path / "summary", read_runs([run]), overwrite=False).read_text()
    assert 'href="../50%25%20%231%3F/report.html"' in page


def test_three_files(three: list[Path], tmp_path: Path) -> None:
    page = write_summary(tmp_path / "sum", read_runs(three), overwrite=False).read_text()
    assert '<a href="../a/report.html">a</a>' in page
    assert "b|&lt;c&gt;" in page
    assert "<c>" not in page
    with (tmp_path / "sum/summary.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    found = {(r["run"], r["estimate"]): float(r["value"]) for r in rows if r["number"] == "position_rmse_m"}
    assert found[("b|<c>", "BL EKF")] == 1.4
    assert found[("(mean)", "graphloc")] == pytest.approx(0.3)
    assert ("d", "BL EKF") not in found
    assert (tmp_path / "sum/summary.md").read_text().startswith("# 3 runs")


def test_runs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    folders = [run_folder(tmp_path / day, "run", truth((0.1, 0.9))) for day in ("monday", "tuesday")]
    assert [run.name for run in read_runs(folders)] == [str(f) for f in folders]


def test_the_command_prints_and_writes(
    three: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sum"
    assert called(monkeypatch, "summary", *three, "-o", out, "--json") == 0
    printed = capsys.readouterr().out
    told = json.loads(printed[: printed.rindex("}") + 1])
    assert told["Against truth: position_rmse_m"]["worst"] == {"graphloc": 0.5, "BL EKF": 1.4}
    assert called(monkeypatch, "summary", *three, "-o", out) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert called(monkeypatch, "summary", *three, "-o", out, "--overwrite") == 0


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("", "is not that of a run"),
        ("[]", "is not that of a run"),
        ('{"metrics": {"t": [1]}, "stats": {"converged": true}, "warnings": []}', "is not that of a run"),
        ('{"metrics": {}, "warnings": []}', "is not that of a run"),
        ("[" * 100_000, "is not that of a run"),
    ],
)
def test_a_broken_run_is_one_line(
    three: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    broken: str, said: str,
) -> None:  # fmt: skip
    (three[1] / "run.json").write_text(broken)
    assert called(monkeypatch, "summary", *three, "-o", tmp_path / "sum") == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "sum").exists()


def test_what_does_not_go_together_is_one_line(
    three: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bag").mkdir()
    for arguments, said in (
        (("summary", three[0], tmp_path / "bag"), "is not the folder of a finished run"),
        (("summary", three[0], three[0]), "given twice"),
        (("compare", three[0], "-c", "vessel.yaml"), "`graphloc summary` puts finished runs into one table"),
    ):
        assert called(monkeypatch, *arguments, "-o", tmp_path / "sum") == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
