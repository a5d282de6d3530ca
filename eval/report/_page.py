# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one self-contained page that opens offline."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path

from plotly.offline import get_plotlyjs

from graphloc import __version__
from graphloc.config import effective
from graphloc.errors import OutputError
from graphloc.eval import plots
from graphloc.eval.html import drawing, note, page
from graphloc.eval.report import _health as health
from graphloc.eval.report import _sections as sections
from graphloc.eval.report._data import ReportData, figures
from graphloc.eval.report._theses import theses_section
from graphloc.eval.report._verdict import verdict

# Touch scrolls the page, not the figure. On a narrow screen a figure is higher, for its legend, and a wide map lower.
# On paper, figures have the sheet's width and leave room for their heading.
_SCRIPT = """
addEventListener("load",()=>{const all=()=>[...document.querySelectorAll(".js-plotly-plot")];
const tall=(p,h)=>{p.style.height=h+"px";p.parentElement.style.height="auto";return h};
if(matchMedia("(pointer:coarse)").matches)all().forEach(p=>Plotly.relayout(p,{dragmode:false}));
if(innerWidth<600)all().filter(p=>p.querySelector(".legend")).forEach(p=>{const map=p.id==="map",t=map?150:110,l=p._fullLayout;
const h=map?Math.min(460,t+l._size.b+Math.max(160,l.yaxis._length)):p.layout.height+t-64;
Plotly.relayout(p,{"legend.font.size":10,"margin.t":t,height:tall(p,h)})});
const paper=(w,most)=>all().forEach(p=>{const h=p.dataset.high=+(p.dataset.high||p._fullLayout.height);
Plotly.relayout(p,{width:w,autosize:w===null,height:tall(p,Math.min(h,most))})});
addEventListener("beforeprint",()=>paper(690,880));addEventListener("afterprint",()=>paper(null,1e9))});
"""
_MAP = (
    "East and north of the datum, m. Points: where measurements put the vessel (a fix: its antenna), coloured by final weight; "
    "hover or tap for the ledger row. Drag to zoom, double-click to reset; click a name in the legend to hide or show it."
)
_NEES = (
    "Squared horizontal error over the covariance that the estimate states. Errors are correlated over time, so even an honest "
    "estimate leaves the band for a while in a run of some minutes; one that stays above the band is overconfident. "
    "Below: how often the stated region of each size held the truth; under the diagonal: overconfident."
)
_BERTHS = (
    "Across: from the quay's face to the vessel's origin; along: to the right as seen from the water; "
    "angle: of the bow from straight in. Bands: 95 %. berth_*.csv has the numbers, and the rates."
)
_RESIDUALS = (
    "Residual of each measurement in its own standard deviations, before the loss, coloured by its final weight."
)
_SLOW = (
    "Estimated slow errors (GNSS error, pose error, compass offset, image offset, docks) with 95 % bands, and IMU biases. "
    "Compass: yaw is the offset of its mount, B to E the magnetic deviation, wander what lasts about a minute."
)


def write_report(path: Path, data: ReportData) -> None:
    """Write the page.

    Raises:
        OutputError: the file cannot be written.
    """
    parts = _parts(data, figures(data))
    links = " ".join(f'<a href="#{at}">{escape(title)}</a>' for at, title, _ in parts)
    config = escape(json.dumps(effective(data.config), indent=1))
    made = f"graphloc {__version__}" + (f": graphloc {data.command}" if data.command else "")
    body = (
        f"<h1>{escape(data.title)}</h1>{sections.first_screen(data, verdict(data))}<nav>{links}</nav>",
        sections.warnings_list(data),
        *(f'<h2 id="{at}">{escape(title)}</h2>{content}' for at, title, content in parts),
        f"<details><summary>Effective configuration</summary><pre>{config}</pre></details>{note(made)}",
    )
    whole = page(data.title, "\n".join(body), get_plotlyjs() + _SCRIPT)
    try:
        path.write_text(whole, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error


def _parts(data: ReportData, drawn: Mapping[str, plots.Figure]) -> list[tuple[str, str, str]]:
    """Return anchor, title and HTML of each section that is not empty."""

    def show(name: str, said: str = "") -> str:
        return said + drawing(drawn[name]) if name in drawn else ""

    parts = (
        ("where", "Map", show("map", note(_MAP))),
        ("off", "Errors and 95 % bounds", show("errors", sections.shades())),
        ("health", "When was it less than good?", health.section(data.solutions, data.begin_ns)),
        ("honest", "Are the bounds honest?", show("nees", note(_NEES)) + show("coverage")),
        ("numbers", "All numbers", "".join(sections.numbers(t) for t in data.tables)),
        ("theses", "The tables of the theses", theses_section(data)),
        ("berth", "Seen from the berth", show("berths", note(_BERTHS))),
        ("used", "Was my measurement used?", sections.ledger(data.solution)),
        ("agree", "Residuals and weights", show("residuals", note(_RESIDUALS))),
        ("states", "Slow states and biases", show("slow", note(_SLOW))),
        ("matches", "Matches", sections.matches(data)),
        ("calibration", "Calibration", sections.calibration(data)),
        ("solver", "Solver", sections.solver(data.solution)),
    )
    return [part for part in parts if part[2]]
