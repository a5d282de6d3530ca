# SPDX-License-Identifier: Apache-2.0
"""What the report says of a run, and that its page stands by itself."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from graphloc import app
from graphloc.eval.metrics import Table
from graphloc.eval.report import ReportData, Trust, verdict, write_report
from graphloc.eval.simulate import Scenario, simulate


@pytest.fixture(scope="module")
def data() -> ReportData:
    run = app.simulated(simulate(Scenario(duration_s=20.0), 3), compare=True)
    return ReportData(
        title="a <run>",
        solution=run.solution,
        recording=run.recording,
        config=run.config,
        filters=run.filters,
        held=(),
        levers_m={},
        tables=app.tables(run),
        truth_statement="Truth: /truth",
    )


def covered(share: float) -> tuple[Table, ...]:
    columns = ("position_rmse_m", "coverage_95")
    return (Table("Against truth", columns, (("graphloc", (0.1234, share)), ("BL EKF", (1.5, None)))),)


def test_verdict_names_the_numbers(data: ReportData) -> None:
    """Bounds of 0.5 m for a tenth of the states, of 9 m for one in 25, else of 1 m: '1.00 m for 95 %' it is."""
    cov = data.solution.trajectory.cov
    assert cov is not None
    made = np.tile(np.eye(6) * (1.0 / 5.991), (len(cov), 1, 1))
    made[: len(cov) // 25] *= 81.0
    made[-len(cov) // 10 :] *= 0.25
    solution = replace(data.solution, trajectory=replace(data.solution.trajectory, cov=made))
    trust, text = verdict(replace(data, solution=solution, tables=covered(0.95)))
    assert "95 % bound of 1.00 m" in text
    assert "Horizontal RMSE 0.12 m (beside it: BL EKF 1.50 m)" in text
    assert "held the truth for 95% of the time" in text
    assert trust is Trust.YES


@pytest.mark.parametrize(
    ("change", "share", "expected"),
    [
        ({}, 0.95, Trust.YES),
        ({}, 0.7, Trust.WITH_CARE),
        ({}, 0.2, Trust.NO),
        ({"warnings": ("imu: looks like g",)}, 0.95, Trust.WITH_CARE),
        ({"converged": False}, 0.95, Trust.NO),
    ],
)
def test_trust_follows_coverage_warnings_and_convergence(
    data: ReportData, change: dict[str, Any], share: float, expected: Trust
) -> None:
    stats = replace(data.solution.stats, warnings=(), converged=True)
    solution = replace(data.solution, stats=replace(stats, **change))
    trust, text = verdict(replace(data, solution=solution, tables=covered(share)))
    assert trust is expected
    assert ("NOT CONVERGE" in text) == (change == {"converged": False})


def test_the_page_stands_by_itself(data: ReportData, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", data)
    page = (tmp_path / "report.html").read_text().replace(get_plotlyjs(), "")  # that one names its makers
    assert "a &lt;run&gt;" in page
    assert "<title>a <run>" not in page
    for link in ('src="http', 'href="http', "src='http", "@import", 'rel="stylesheet"'):
        assert link not in page
    numbers = next(t for t in data.tables if t.title == "Against truth")
    for name, values in numbers.rows:
        assert f"<th>{name}</th>" in page
        assert f"<td>{values[0]:.3f}</td>" in page
    counts = data.solution.ledger.counts()
    assert f"{sum(n for c in counts.values() for n in c.values())} messages in all" in page
