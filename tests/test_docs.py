"""What README and docs point to is there: links, anchors, commands and their options."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import typer

from graphloc.cli import app

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "examples/README.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS: Any = typer.main.get_command(app)  # typer brings a click of its own


def anchors(page: Path) -> set[str]:
    """As the forges make them: lower case, blanks to hyphens, nothing but letters, digits and hyphens."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w-]", "", title.lower().replace(" ", "-")) for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("https:", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


def test_the_example_of_calibration_has_the_numbers_of_its_rows() -> None:
    rows = {row["name"]: row["value"] for row in json.loads((ROOT / "docs/results.json").read_text())["figures"]}
    said = re.search(r"time_offset_s: ([\d.]+) \+- ([\d.]+) s", (ROOT / "docs/calibration.md").read_text())
    assert said is not None
    suggested, sigma = (
        rows[f"KITTI as it is: {what}"] for what in ("gnss.time_offset_s that it suggests", "its sigma")
    )
    assert (float(said[1]), float(said[2])) == (suggested, sigma)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_and_options_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = re.findall(r"^\s*(?:\$ )?graphloc ([^#\n|<]+)", text, re.MULTILINE) + re.findall(
        r"`graphloc ([^`]+)`", text
    )
    for line in lines:
        name, *rest = line.split()
        if line == "online" or not re.fullmatch(r"[a-z]+", name):  # the estimator's name
            continue
        assert name in COMMANDS.commands, line
        known = {o for p in COMMANDS.commands[name].params for o in (*p.opts, *p.secondary_opts)}
        used = {word.split("=")[0] for word in rest if re.fullmatch(r"-{1,2}[a-z][a-z-]*(=.*)?", word)}
        assert used <= known | {"-h", "--help"}, line
