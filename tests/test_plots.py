# SPDX-License-Identifier: Apache-2.0
"""What figures show, from numbers made by hand; both who draw them draw all of it."""

from dataclasses import replace
from itertools import permutations
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure as Sheet

from graphloc import app
from graphloc.config import OutputConfig, VesselConfig
from graphloc.eval import plots
from graphloc.eval.ekf import FilterResult
from graphloc.eval.metrics import Antennas
from graphloc.eval.plots import paper
from graphloc.eval.plots.paper import drawn as on_paper
from graphloc.eval.plots.paper import write_figures
from graphloc.eval.report import ReportData, figures
from graphloc.eval.simulate import Scenario, simulate
from graphloc.eval.underlay import underlay
from graphloc.frames import Datum
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import GnssPosition
from graphloc.solution import Health
from tests.mapfactory import SQUARE, SWEDEN, drawn, framed, write

NOWHERE = Antennas(configured={})


@pytest.fixture(scope="module")
def data() -> ReportData:
    """With an outage from 8 to 14 s."""
    run = app.simulated(simulate(Scenario(duration_s=22.0, outage_s=(8.0, 14.0), imu_hz=50.0, compass_hz=2.0), 3))
    return app.report_data(replace(run, recording=replace(run.recording, warnings=())))


def marks(figure: plots.Figure | None, kind: type[plots.Mark], panel: int = 0) -> list[plots.Mark]:
    assert figure is not None
    return [m for m in figure.panels[panel].marks if isinstance(m, kind)]


def test_nees_and_coverage_of_an_error_made_by_hand(data: ReportData) -> None:
    """0.3 m east, 0.4 m north off, variances 0.09 and 0.16 m^2: NEES 1 + 1 = 2 at each time.

    The region of p % ends at -2 ln(1 - p): 2 lies in that of 70 % (2.41), not in that of 60 % (1.83).
    """
    truth = data.recording.truth
    assert truth is not None
    cov = np.tile(np.diag([0.09, 0.16, 1.0, 1.0, 1.0, 1.0]), (len(truth), 1, 1))
    track = replace(truth, p_world_m=truth.p_world_m + np.array([0.3, 0.4, 5.0]), cov=cov)
    solution = replace(data.solution, trajectory=track, health=(Health.GOOD,) * len(track))
    (line, _) = marks(plots.consistency(data.recording, solution, ()), plots.Line)
    assert isinstance(line, plots.Line)
    np.testing.assert_allclose(line.y, 2.0, rtol=1e-9)
    (band,) = marks(plots.consistency(data.recording, solution, ()), plots.Band)
    assert isinstance(band, plots.Band)
    np.testing.assert_allclose([band.low[0], band.high[0]], [-2.0 * np.log(0.975), -2.0 * np.log(0.025)])
    (_, held) = marks(plots.coverage(data.recording, solution, ()), plots.Line)
    assert isinstance(held, plots.Line)
    assert dict(zip(held.x.round(), held.y, strict=True)) == {
        5: 0, 10: 0, 20: 0, 30: 0, 40: 0, 50: 0, 60: 0, 70: 100, 80: 100, 90: 100, 95: 100, 99: 100
    }  # fmt: skip
    (position, *_) = marks(plots.error_over_time(data.recording, solution, (), (), NOWHERE), plots.Line)
    assert isinstance(position, plots.Line)
    np.testing.assert_allclose(position.y, 0.5, rtol=1e-9)


def test_without_truth_there_is_nothing_to_hold_bounds_against(data: ReportData) -> None:
    recording = replace(data.recording, truth=None)
    assert plots.consistency(recording, data.solution, ()) is None
    assert plots.coverage(recording, data.solution, ()) is None
    made = figures(replace(data, recording=recording))
    assert set(made) == {"map", "errors", "residuals", "slow"}
    assert [panel.title for panel in made["errors"].panels] == [
        "position, 95 % bound",
        "heading, 95 % bound",
    ]  # no error is drawn


def test_an_outage_and_bad_health_are_shaded_by_both(data: ReportData) -> None:
    """Fixes come every 0.1 s but from 8 to 14 s; the last 2 s or so call themselves lost."""
    (outage,) = plots.outages(data.recording)
    start = int(data.solution.trajectory.stamps_ns[0])
    np.testing.assert_allclose([(v - start) / 1e9 for v in outage], [8.0, 14.0], atol=0.25)
    n = len(data.solution.health)
    solution = replace(data.solution, health=(Health.GOOD,) * (n - 20) + (Health.LOST,) * 20)
    figure = plots.error_over_time(data.recording, solution, (), (), NOWHERE)
    spans = marks(figure, plots.Shaded)
    assert [s.name for s in spans] == ["no GNSS fix", "lost"]
    lost = spans[1]
    assert isinstance(lost, plots.Shaded)
    assert lost.stop - lost.start == pytest.approx(1.9, abs=0.01)  # 20 states at 10 Hz
    assert len(plots.interactive(figure).layout.shapes) == 4  # two in each of two panels
    assert [len(axes.patches) for axes in on_paper(figure).axes] == [2, 2]


def test_an_outage_at_the_beginning_or_the_end_counts(data: ReportData) -> None:
    """Fixes from 5 s on, and none in the last 4 s, of a run of 30 s or so."""
    recording = replace(data.recording, rows=())
    assert recording.imu is not None
    first, last = (int(s) for s in recording.imu.stamps_ns[[0, -1]])
    kept = [
        m for m in recording.measurements if not isinstance(m, GnssPosition) or first + 5e9 <= m.stamp_ns <= last - 4e9
    ]
    found = plots.outages(replace(recording, measurements=tuple(kept)))
    assert found[0][0] == first
    assert found[0][1] == pytest.approx(first + 5e9, abs=0.25e9)
    assert found[-1][1] == last
    assert found[-1][0] == pytest.approx(last - 4e9, abs=0.25e9)


def test_a_track_has_one_colour_in_every_figure_whoever_is_beside_it(data: ReportData) -> None:
    names = ("graphloc online", "BL EKF", "honest EKF", "Digerud KF")
    track = data.solution.trajectory
    seen: dict[str, set[str]] = {}
    for beside in (*permutations(names, 2), names, ()):
        filters = [FilterResult(name=name, trajectory=track, ledger=Ledger()) for name in beside]
        found = (
            plots.run_map(data.recording, data.solution, filters),
            plots.error_over_time(data.recording, data.solution, filters, (), NOWHERE),
            plots.consistency(data.recording, data.solution, filters),
            plots.coverage(data.recording, data.solution, filters),
        )
        for figure in found:
            assert figure is not None
            lines = [mark for panel in figure.panels for mark in panel.marks if isinstance(mark, plots.Line)]
            own = [line for line in lines if line.name in ("graphloc", *beside)]
            assert {line.name for line in own} == {"graphloc", *beside}
            for line in own:
                seen.setdefault(line.name, set()).add(line.colour)
    assert seen == {name: {plots.colour_of(name)} for name in ("graphloc", *names)}
    assert len(set.union(*seen.values(), {plots.TRUTH})) == 2 + len(names)


def test_panels_beside_each_other() -> None:
    """Three in two columns: the last cell stays empty; two panels are the last of their columns. Named ticks, logarithmic x."""
    x = np.array([0.1, 1.0, 10.0])
    marks = (
        plots.Shaded(name="s", start=0.2, stop=0.5, colour="#000000"),
        plots.Points(name="p", x=x, y=x, colour="#123456", shape="circle-open"),
        plots.Points(name="q", x=x, y=x, colour="#123456", shape="x"),
    )
    panel = plots.Panel(title="t", y="m", marks=marks, ticks_y=("one", "two"))
    figure = plots.Figure(
        name="f", x="m", panels=(panel,) * 3, height=400, columns=2, log_x=True, range_x=(0.01, 100.0)
    )
    page = plots.interactive(figure).layout
    assert (page.xaxis.type, tuple(page.xaxis3.range)) == ("log", (-2.0, 2.0))
    assert "xaxis4" not in page
    assert [axis.title.text for axis in (page.xaxis, page.xaxis2, page.xaxis3)] == [None, "m", "m"]
    assert page.xaxis.domain[1] < page.xaxis2.domain[0]
    assert tuple(page.yaxis2.ticktext) == ("one", "two")
    assert [shape.xref for shape in page.shapes] == ["x", "x2", "x3"]
    axes = on_paper(figure).axes
    assert len(axes) == 3
    assert [a.get_xlabel() for a in axes] == ["", "m", "m"]
    assert axes[2].get_xscale() == "log"
    assert [t.get_text() for t in axes[1].get_yticklabels()] == ["one", "two"]


def test_of_many_points_those_not_believed_stay() -> None:
    weight = np.ones(10_000)
    weight[777] = weight[778] = 0.1
    some = plots.shown_of(weight, most=100)
    assert len(some) == 100
    assert {777, 778} <= set(some.tolist())
    assert set(plots.shown_of(np.zeros(1000), most=10).tolist()) >= {0, 999}
    assert plots.shown_of(np.zeros(0)).tolist() == []


def test_of_many_values_no_spike_is_lost() -> None:
    values = np.zeros(100_003)
    values[[5, 50_001, 100_002]] = [1.0, 3.0, 2.0]
    some = plots.peaks(values, most=100)
    assert len(some) == 100
    assert (np.diff(some) > 0).all()
    assert sorted(values[some])[-3:] == [1.0, 2.0, 3.0]
    assert plots.peaks(np.zeros(3), most=3).tolist() == [0, 1, 2]


def test_the_ledger_row_on_hover() -> None:
    row = LedgerRow(
        seq=7, stamp_ns=1_700_000_000_250_000_000, sensor="aerial", topic="/x", outcome=Outcome.REJECTED, weight=0.125, mode=1,
        mode_probability=0.75, residual_m=3.5, nis=12.0, dof=3, reason="judged <false>",
    )  # fmt: skip
    assert plots.hover(row).split("<br>") == [
        "aerial: rejected, weight 0.12", "mode 1, probability 0.75", "residual 3.50 m, 2.0 sigmas",
        "22:13:20.250 UTC, arrival 7", "judged &lt;false>",
    ]  # fmt: skip


def test_points_of_the_map_are_where_the_fixes_are(data: ReportData) -> None:
    solution = replace(data.solution, ledger=Ledger(data.solution.ledger))
    found = [m for m in marks(plots.run_map(data.recording, solution, ()), plots.Points) if m.name == "gnss by weight"]
    (gnss,) = found
    assert isinstance(gnss, plots.Points)
    truth = data.recording.truth
    assert truth is not None
    assert np.hypot(gnss.x - truth.p_world_m[0, 0], gnss.y - truth.p_world_m[0, 1]).min() < 5.0
    assert gnss.weight is not None
    assert len(gnss.x) == len(gnss.y) == len(gnss.weight) == len(gnss.text)


def test_every_figure_as_png_and_svg(data: ReportData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Where there is room for all that is drawn, matplotlib works out anew for each file, which takes as long as to draw it.
    monkeypatch.setattr(paper, "Sheet", lambda **options: Sheet(**{**options, "layout": None}))
    made = figures(data)
    write_figures(tuple(made.values()), tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {f"{name}.{end}" for name in made for end in ("png", "svg")}
    for name, figure in made.items():
        pixels = cv2.imread(str(tmp_path / f"{name}.png"))
        assert pixels is not None
        assert pixels.std() > 1.0
        text = " ".join(ElementTree.parse(tmp_path / f"{name}.svg").getroot().itertext())
        assert figure.x in text
        assert all(panel.title in text for panel in figure.panels)


def test_the_image_lies_where_it_shows_things(tmp_path: Path) -> None:
    """A bright square at a known place in an image of another CRS; the track runs 20 m around it."""
    transform, width, height = framed(32633, 0.5)
    image = drawn(32633, transform, width, height)
    write(tmp_path / "map.tif", image[None], crs="EPSG:32633", transform=transform)
    config = VesselConfig(output=OutputConfig(map_image="map.tif"))
    track = np.array([[0.0, -40.0, 0.0], [40.0, 0.0, 0.0]])
    under, said = underlay(config, tmp_path, Datum(SWEDEN), track)
    assert said == ""
    assert under is not None
    pixels = cv2.imdecode(np.frombuffer(under.jpeg, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    rows, columns = np.nonzero((pixels > 120) & (pixels < 230))  # beyond the image it is white
    per_px = np.array([under.east_m - under.west_m, under.north_m - under.south_m]) / pixels.shape[::-1]
    west, east = under.west_m + per_px[0] * columns.min(), under.west_m + per_px[0] * (columns.max() + 1)
    north, south = under.north_m - per_px[1] * rows.min(), under.north_m - per_px[1] * (rows.max() + 1)
    np.testing.assert_allclose([west, south, east, north], SQUARE, atol=0.35)
    assert under.west_m < -15.0 + 1.0
    assert under.east_m > 40.0 + 14.0


def test_an_image_that_cannot_be_had_is_reported_and_the_map_is_plain(tmp_path: Path) -> None:
    config = VesselConfig(output=OutputConfig(map_image="gone.tif"))
    under, said = underlay(config, tmp_path, Datum(SWEDEN), np.zeros((2, 3)))
    assert under is None
    assert "gone.tif" in said
    assert underlay(VesselConfig(), tmp_path, Datum(SWEDEN), np.zeros((2, 3))) == (None, "")


def test_no_name_of_a_legend_leaves_the_sheet() -> None:
    """Of held-out fixes names are long: four to a row were 7.4 in wide, and 'graphloc online, held-out' was cut off."""
    names = ("lost", "no GNSS fix", "degraded", "95 % bound of graphloc", "honest EKF, held-out", "BL EKF, held-out")
    one = np.zeros(1)
    lines = [
        plots.Line(name=n, x=one, y=one, colour="#000000")
        for n in (*names, "graphloc online, held-out", "graphloc, held-out")
    ]
    for named in (lines, lines[:2]):
        sheet = on_paper(
            plots.Figure(name="errors", x="s", panels=(plots.Panel(title="", y="m", marks=tuple(named)),), height=400)
        )
        sheet.canvas.draw()
        (legend,) = sheet.legends
        assert len(legend.get_texts()) == len(named)
        assert legend.get_window_extent().x1 <= sheet.bbox.x1
