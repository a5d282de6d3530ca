# SPDX-License-Identifier: Apache-2.0
"""Pages of drills and ablations: tables and figures as HTML, the tables also as Markdown and CSV."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from plotly.offline import get_plotlyjs

from graphloc.eval import html, markdown
from graphloc.plain import aligned


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A cell of a table: its text, and a highlight: 'bad', 'doubt', or '' for none."""

    text: str
    mark: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """A table of text: title, names of columns, rows of as many cells, and a note below."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    def as_html(self) -> str:
        """Return the table with its heading; words are left-aligned, numbers right-aligned."""
        left = ["" if not k or all(_number(r[k].text) for r in self.rows) else "text" for k in range(len(self.head))]
        head = "".join(f'<th class="{c}">{escape(h)}</th>' for h, c in zip(self.head, left, strict=True))
        rows = "".join(
            "<tr>"
            + "".join(
                f'<td class="{f"{c} {cell.mark}".strip()}">{escape(cell.text)}</td>'
                for cell, c in zip(row, left, strict=True)
            )
            + "</tr>"
            for row in self.rows
        )
        table = f'<div class="scroll"><table><tr>{head}</tr>{rows}</table></div>'
        return f"<h2>{escape(self.title)}</h2>{table}{html.note(self.note)}"

    def as_markdown(self) -> str:
        """Return the table as Markdown, with its title above and its note below."""
        lines = [f"**{self.title}**", "", markdown.row(self.head), "|" + "---|" * len(self.head)]
        lines += [markdown.row([cell.text for cell in row]) for row in self.rows]
        return "\n".join([*lines, *(["", self.note] if self.note else [])]) + "\n"

    def as_text(self) -> str:
        """Return the table as aligned text."""
        cells = [self.head, *(tuple(cell.text for cell in row) for row in self.rows)]
        return "\n".join([self.title, *aligned(cells)])


def _number(text: str) -> bool:
    return text == "-" or re.fullmatch(r"[-+]?\d[\d.]*( \S+)?", text) is not None


def write_page(path: Path, title: str, said: Sequence[str], parts: Sequence[str]) -> None:
    """Write a self-contained page.

    Args:
        title: of the page. said: sentences of the summary, the main one first. parts: HTML of the rest.
    """
    lead = "".join(f'<p class="{"note" if k else "lead"}">{escape(line)}</p>' for k, line in enumerate(said))
    body = "\n".join([f"<h1>{escape(title)}</h1>{lead}", *parts])
    path.write_text(html.page(title, body, get_plotlyjs()), encoding="utf-8")


def write_markdown(path: Path, title: str, said: Sequence[str], grids: Sequence[Grid]) -> None:
    """Write title, summary (`said`) and tables as Markdown."""
    text = "\n\n".join([f"# {title}", *said, *(grid.as_markdown() for grid in grids)])
    path.write_text(text.rstrip() + "\n", encoding="utf-8")


def write_csv(path: Path, rows: Sequence[dict[str, object]]) -> None:
    """Write rows with equal keys; None becomes an empty field."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)
