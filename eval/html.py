# SPDX-License-Identifier: Apache-2.0
"""HTML of report pages: style, tables, notes, figures."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import zip_longest

import plotly.graph_objects as go

from graphloc.eval import plots

STYLE = """
*,::before{box-sizing:border-box}html{-webkit-text-size-adjust:100%}
body{font:16px/1.45 system-ui,sans-serif;color:#111;background:#fff;max-width:1150px;margin:0 auto;padding:.8rem 1rem 3rem}
h1{font-size:1.4rem;margin:.2rem 0 .6rem;overflow-wrap:anywhere}
h2{font-size:1.15rem;margin:1.8rem 0 .4rem;border-bottom:1px solid #ccc;break-after:avoid}
h3{font-size:1rem;margin:1rem 0 .2rem;break-after:avoid}h2+p{break-after:avoid;break-inside:avoid}p{margin:.4rem 0}
.verdict{border-left:8px solid var(--trust);background:#f6f6f6;padding:.5rem .8rem;font-size:1.05rem}
.verdict+.verdict{margin-top:.4rem}.verdict b{font-size:1.15rem}.reasons{list-style:none;padding:0;margin:.5rem 0}
.reasons li{padding-left:1.5rem;text-indent:-1.5rem}.reasons li::before{display:inline-block;width:1.5rem;text-indent:0;content:"\\2713";color:#009E73}
.reasons li.care::before{content:"!";color:#B06F00;font-weight:700;padding-left:.3rem}.reasons li.no::before{content:"\\2717";color:#D55E00}
nav{font-size:.9rem;margin:.8rem 0}nav a{margin-right:.9rem;white-space:nowrap}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.88rem;margin:.4rem 0}
th,td{padding:.25rem .6rem;text-align:right;border-bottom:1px solid #ddd;white-space:nowrap;font-variant-numeric:tabular-nums}
th:first-child,td:first-child{text-align:left}tr.ours td{font-weight:700}tr.print td{color:#555}th{vertical-align:bottom}.key th{white-space:normal;min-width:3.2rem}tr.part td{border-top:2px solid #999}
.reason td{white-space:normal}.reason td,.reason th{text-align:left}td.text,th.text{text-align:left;white-space:normal;min-width:9rem}
td.bad{background:#fbe3d6}td.doubt{background:#fdf3dc}.lead{font-size:1.05rem;padding:.6rem .8rem;border-left:6px solid #0072B2;background:#f5f5f5}
.note{color:#444;font-size:.9rem}pre{overflow-x:auto;background:#f6f6f6;padding:.6rem;font-size:.8rem}
img{max-width:100%}ul.warnings{padding-left:1.2rem}li.warning{color:#8a3b00;overflow-wrap:anywhere}.figure{overflow:hidden}
.shades i{display:inline-block;width:.9rem;height:.8rem;margin:0 .25rem 0 .7rem;vertical-align:-1px;border:1px solid #bbb}
@media(max-width:600px){.wide{display:none}body{padding:.5rem .6rem 2rem}th,td{padding:.25rem .4rem}table{font-size:.82rem}.verdict{font-size:1rem}}
@page{size:A4;margin:12mm}
@media print{body{font-size:10.5pt;max-width:none;padding:0}.figure,table,img,.svg-container{break-inside:avoid}.svg-container{contain:size}nav,details{display:none}
.scroll{overflow:visible}th,td{white-space:normal}td.text,td:first-child{overflow-wrap:anywhere}td:first-child{min-width:6.5rem}.figure{overflow:visible}.reason td:first-child{min-width:10rem}.reason td:last-child{min-width:17rem}*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""


def page(title: str, body: str, script: str = "") -> str:
    """Return a self-contained page.

    Args:
        title: is escaped. body, script: are not.
    """
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<title>{escape(title)}</title><style>{STYLE}</style><script>{script}</script></head><body>\n{body}\n</body></html>\n"
    )


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    classes: Sequence[str] = (),
    *,
    text: Sequence[int] = (),
    wide: Sequence[int] = (),
    kind: str = "",
) -> str:
    """Return a table in a container that scrolls horizontally where it is too wide.

    Args:
        head, rows: texts, which are escaped. classes: CSS class of each row.
        text: columns of words, which may wrap. wide: columns that are hidden on a phone. kind: CSS class of the table.
    """
    words = [" ".join(name for name, some in (("text", text), ("wide", wide)) if k in some) for k in range(len(head))]
    marks = [f' class="{word}"' if word else "" for word in words]

    def line(cells: Sequence[str], tag: str, of: str = "") -> str:
        inside = "".join(f"<{tag}{m}>{escape(cell)}</{tag}>" for cell, m in zip(cells, marks, strict=True))
        return f'<tr class="{of}">{inside}</tr>' if of else f"<tr>{inside}</tr>"

    body = "".join(line(row, "td", of) for row, of in zip_longest(rows, classes, fillvalue=""))
    return f'<div class="scroll {kind}"><table>{line(head, "th")}{body}</table></div>'


def note(text: str) -> str:
    """Return a remark as a paragraph; nothing for an empty text."""
    return f'<p class="note">{escape(text)}</p>' if text else ""


def drawing(figure: plots.Figure) -> str:
    """Return the HTML of a figure, for a page that contains plotly."""
    return figure_html(plots.interactive(figure), figure.name)


def figure_html(figure: go.Figure, name: str) -> str:
    """Return the HTML of a plotly figure, for a page that contains plotly; `name` is its id."""
    html: str = figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=name,
        config={"displaylogo": False, "responsive": True, "displayModeBar": False},
    )
    return f'<div class="figure">{html}</div>'
