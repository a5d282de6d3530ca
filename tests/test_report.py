# SPDX-License-Identifier: Apache-2.0
"""What the report says of a run, and that its page stands by itself."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from graphloc import app
from graphloc.eval.docking import accurate_within_m
from graphloc.eval.formatting import significant
from graphloc.eval.metrics import Table
from graphloc.eval.plots import Underlay
from graphloc.eval.report import ReportData, Trust, figures, theses_section, verdict, write_report
from graphloc.eval.report._sections import first_screen
from graphloc.eval.simulate import Scenario
from graphloc.measurements import GnssPosition
from graphloc.solution import Solution
from graphloc.survey import Survey
from graphloc.time import stamps_of
from graphloc.trajectory import Trajectory
from tests.browser import CHROMIUM, Browser
from tests.slowly import beside_filters, simulate_slowly


@pytest.fixture(scope="module")
def data() -> ReportData:
    run = beside_filters(simulate_slowly(Scenario(duration_s=20.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3))
    return ReportData(
        title="a <run>",
        solution=run.solution,
        recording=run.recording,
        config=run.config,
        filters=run.filters,
        held=(),
        antennas=app.antennas(run),
        tables=app.tables(run),
        truth_statement="Truth: /truth",
    )


def covered(share: float) -> tuple[Table, ...]:
    columns = ("position_rmse_m", "coverage_95")
    return (Table("Against truth", columns, (("graphloc", (0.1234, share)), ("BL EKF", (1.5, None)))),)


@pytest.mark.parametrize(
    ("value", "digits", "said"),
    [(9231.0, 3, "9230"), (-0.04427, 3, "-0.0443"), (390.4, 2, "390"), (0.0, 3, "0"), (1.1e-5, 2, "0.000011")],
)
def test_significant_digits_without_powers_of_ten(value: float, digits: int, said: str) -> None:
    assert significant(value, digits) == said


def test_verdict_names_the_numbers(data: ReportData) -> None:
    """Bounds of 0.5 m for a tenth of the states, of 9 m for one in 25, else of 1 m: '1.00 m for 95 %' it is."""
    cov = data.solution.trajectory.cov
    assert cov is not None
    made = np.tile(np.eye(6) * (1.0 / 5.991), (len(cov), 1, 1))
    made[: len(cov) // 25] *= 81.0
    made[-len(cov) // 10 :] *= 0.25
    solution = replace(data.solution, trajectory=replace(data.solution.trajectory, cov=made))
    said = verdict(replace(data, solution=solution, tables=covered(0.95)))
    text = " ".join(reason.text for reason in said.reasons)
    assert "95 % bound is 1.00 m" in text
    assert said.tracks[0].accuracy == "Horizontal RMSE 0.12 m; beside it: BL EKF 1.50 m (12 x)."  # 1.5 / 0.1234 = 12.2
    assert "held the truth for 95 % of the time" in text
    assert said.trust is Trust.YES


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
    said = verdict(replace(data, solution=solution, tables=covered(share)))
    assert said.trust is expected
    assert any("did not converge" in r.text for r in said.reasons) == (change == {"converged": False})


@pytest.mark.parametrize(
    ("share", "said"), [(0.99, "beside it: BL EKF 1.50 m (12 x)."), (0.88, "beside it: BL EKF 1.50 m.")]
)
def test_no_ratio_is_given_to_an_error_over_another_time(data: ReportData, share: float, said: str) -> None:
    """Online had 350 of 400 fixes, without the first gap, in which the filters were worst: 'BL EKF 4.1 x' was of all 400."""
    columns = ("position_rmse_m", "coverage_95", "matched")
    table = Table("Against truth", columns, (("graphloc", (0.1234, 0.95, share)), ("BL EKF", (1.5, None, 1.0))))
    told = replace(data, tables=(table,))
    accuracy = verdict(told).tracks[0].accuracy
    assert accuracy.endswith(said)
    assert ("<td>12 x</td>" in first_screen(told, verdict(told))) == (share > 0.9)  # nor in the table under it
    assert ("over the 88 % that it covers" in accuracy) == (share < 0.9)


@pytest.mark.parametrize("off_m", [(1.5, -0.4, 0.0), (0.0, 0.0, 0.0)])
def test_an_error_that_stays_the_same_is_named(data: ReportData, off_m: tuple[float, float, float]) -> None:
    """As of a datum that `inspect` guessed by drifting fixes: it is no noise that is wrong then."""
    track = data.solution.trajectory
    recording = replace(data.recording, truth=replace(track, p_world_m=track.p_world_m + np.array(off_m)))
    reasons = verdict(replace(data, recording=recording, tables=covered(0.2))).reasons
    text = " ".join(reason.text for reason in reasons)
    stays = "All but 0.00 m (RMS) of its error stays the same, 1.50 m west and 0.40 m north of the truth"
    assert (stays in text) == any(off_m)
    assert ("a mount, the datum, a clock or a noise is wrong" in text) != any(off_m)


def test_a_warning_on_both_tracks_is_listed_once(data: ReportData) -> None:
    def warned(*warnings: str, online: bool) -> Solution:
        return replace(data.solution, stats=replace(data.solution.stats, warnings=warnings, online=online))

    both = replace(
        data,
        recording=replace(data.recording, warnings=("imu: in g",)),
        solution=warned("gnss: jumps", online=False),
        online=warned("gnss: jumps", "gnss: frozen", online=True),
    )
    assert both.warnings == ("imu: in g", "gnss: jumps", "graphloc online: gnss: frozen")


def test_a_run_that_nothing_measures_is_not_vouched_for(data: ReportData) -> None:
    """Its own bounds are all there is, and they may be wrong."""
    recording = replace(data.recording, truth=None, warnings=())
    solution = replace(data.solution, stats=replace(data.solution.stats, warnings=()))
    said = verdict(replace(data, recording=recording, solution=solution, tables=()))
    assert said.trust is Trust.WITH_CARE
    assert said.tracks[0].accuracy == "Its accuracy was not measured."
    assert any("Its accuracy was not measured" in r.text for r in said.reasons)


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
        assert f"<td>{name}</td><td>{values[0]:.2f}</td>" in page  # the first screen
    counts = data.solution.ledger.counts()
    assert f"{sum(n for c in counts.values() for n in c.values())} messages in all" in page


def test_the_theses_tables_have_this_run_beside_the_print(data: ReportData) -> None:
    """BL 4.1: the error of the receiver, at its antenna; here by hand, from truth and fixes."""
    truth = data.recording.truth
    assert truth is not None
    fixes = data.recording.of(GnssPosition)
    at = truth.at(stamps_of(fixes))
    lever = data.config.sensors["gnss"].mount.t_body_sensor_m
    antenna = at.p_world_m + np.einsum("nij,j->ni", at.R_world_body, lever)
    fixed = data.solution.datum.enu_from_geodetic(*np.array([m.position for m in fixes]).T)
    off = np.linalg.norm((antenna - fixed)[:, :2], axis=1)
    page = theses_section(data)
    assert f"<td>this run: gnss</td><td>{np.sqrt(np.mean(off**2)):.4f}</td><td>{off.max():.4f}</td>" in page
    assert "<td>case 2, jump (4.2)</td><td>2.4428</td><td>14.5115</td>" in page
    printed = "<td>case 1, drift (4.3)</td><td>0.5893</td><td>1.6668</td><td>1.7332</td><td>4.8879</td>"
    assert f'<tr class="print">{printed}</tr>' in page
    ours = next(t for t in data.tables if t.title == "Against truth").as_dict()["graphloc"]
    columns = ("position_rmse_m", "position_max_m", "heading_rmse_deg", "heading_max_deg")
    assert "<td>this run: graphloc</td>" + "".join(f"<td>{ours[c]:.4f}</td>" for c in columns) in page
    assert "D 4.13" not in page  # there were no tags
    assert theses_section(replace(data, recording=replace(data.recording, truth=None))) == ""


def test_a_distance_within_which_an_estimate_is_good_to_a_decimetre() -> None:
    """A vessel nears a tag from 20 m at 1 m/s, 1 cm off but for the first 10 s, in which it is 1 m off."""
    stamps = np.arange(0, 19_000_000_000, 100_000_000, dtype=np.int64)
    t = stamps * 1e-9
    place = np.column_stack([20.0 - t, 0.0 * t, 0.0 * t])
    truth = Trajectory(stamps_ns=stamps, p_world_m=place, R_world_body=np.tile(np.eye(3), (len(t), 1, 1)))
    off = np.where(t < 10.0, 1.0, 0.01)
    there = replace(truth, p_world_m=place + np.column_stack([0.0 * t, off, 0.0 * t]))
    tag = {"id": 1, "xyz_m": (0.0, 0.0, 0.0), "facing_deg": 90.0, "size_m": 0.4}
    survey = Survey.model_validate({"tags": [tag]})
    within = accurate_within_m(there, truth, survey, stamps[:1])
    # Good from 10 m to 1 m: 90 samples, and 5 % bad ones beside them: 90 / 0.95 - 90 = 4 more, of 0.1 m each.
    assert within == pytest.approx(10.4, abs=0.11)
    assert (
        accurate_within_m(replace(there, p_world_m=place + np.array([0.0, 1.0, 0.0])), truth, survey, stamps[:1])
        is None
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium on PATH: what a browser makes of a report is not looked at")
    with Browser() as opened:
        yield opened


def test_in_a_browser(data: ReportData, tmp_path: Path, browser: Browser) -> None:
    """At a desk and on a phone: no complaint, nothing asked of a network, no scrolling sideways, every figure drawn."""
    picture = cv2.imencode(".jpg", np.full((40, 60, 3), 90, dtype=np.uint8))[1].tobytes()
    under = Underlay(jpeg=picture, west_m=-90.0, south_m=-60.0, east_m=90.0, north_m=60.0)
    data = replace(data, underlay=under)
    write_report(tmp_path / "report.html", data)
    for width_px in (1200, 390):
        page = browser.open(tmp_path / "report.html", width_px=width_px, phone=width_px < 600)
        assert (page.said, page.asked) == ([], [])
        assert page.widest_px == page.width_px == width_px
        drawn = browser.evaluate("[...document.querySelectorAll('.js-plotly-plot .main-svg:first-child')].length")
        assert drawn == len(figures(data))
        href = browser.evaluate("document.querySelector('#map image').getAttribute('href').slice(0, 22)")
        assert href == "data:image/jpeg;base64"
    browser.pdf(tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


def test_the_browser_would_have_seen_it(tmp_path: Path, browser: Browser) -> None:
    """A page with all the faults that the test above looks for."""
    wide, ask = '<div style="width:900px">x</div>', '<img src="http://127.0.0.1:9/x.png">'
    (tmp_path / "bad.html").write_text(
        f'<meta name="viewport" content="width=device-width">{wide}{ask}<script>console.error("e");undefined.x</script>'
    )
    page = browser.open(tmp_path / "bad.html", width_px=390, phone=True)
    assert len(page.said) >= 2
    assert page.asked == ["http://127.0.0.1:9/x.png"]
    assert page.widest_px > page.width_px
