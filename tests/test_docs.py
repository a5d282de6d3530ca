"""What README and docs point to is there: links, anchors, commands and their options."""

import ast
import json
import re
from pathlib import Path
from typing import Any

import pytest
import typer

from graphloc.cli import app
from graphloc.config import load_config
from graphloc.factors import INERTIAL, SENSORS

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "examples/README.md", *sorted((ROOT / "docs").rglob("*.md"))]
ROOMS = ("graphloc", "factors", "frontends", "eval")
KINDS = {INERTIAL.kind: INERTIAL.config} | {row.kind: row.config for row in SENSORS}
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


def test_modules_that_the_architecture_names_exist() -> None:
    """Each `name.py` of the page is a module of that name, each `folder/` a folder."""
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    modules = [p.relative_to(ROOT) for room in (*ROOMS, "tests") for p in (ROOT / room).rglob("*.py")]
    paths = {f"/{p.as_posix()}" for p in modules} | {f"/{parent.as_posix()}/" for p in modules for parent in p.parents}
    named = re.findall(r"`([\w/]+(?:\.py|/))`", text)
    assert len(named) > 100
    assert [name for name in named if not any(path.endswith(f"/{name}") for path in paths)] == []


def written_texts() -> str:
    """All strings of the code, a line each; what an f-string fills in is `{}`."""
    texts = []
    for path in (p for room in ROOMS for p in (ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts.append("".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\n".join(texts)


@pytest.mark.parametrize("page", ["troubleshooting", "aerial"])
def test_quoted_messages_are_those_of_the_code(page: str) -> None:
    text = re.sub(r"```.*?```", "", (ROOT / f"docs/{page}.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    quoted = re.findall(r"(?<!\w)'([^'\n]{6,}?)'(?!\w)", text)
    parts = {part.strip() for quote in quoted for part in re.split(r"\.\.\.|\d[\d.]*", quote)}
    written = written_texts()
    assert len(quoted) > 3
    assert [part for part in sorted(parts) if part not in written] == []


def test_the_reference_of_keys_names_keys_and_begins_with_a_valid_file(tmp_path: Path) -> None:
    text = (ROOT / "docs/configuration.md").read_text(encoding="utf-8")
    keys = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    blocks = re.findall(r"^## (?:Block|Entry of) `(\w+)`$", text, re.MULTILINE)
    assert len(blocks) > 10
    assert [name for name in blocks if not {name, f"{name}s"} & keys] == []
    (tmp_path / "vessel.yaml").write_text(text.split("```yaml\n")[1].split("```")[0])
    config = load_config(tmp_path / "vessel.yaml", KINDS)
    assert [sensor.kind for sensor in config.sensors.values()] == ["imu", "gnss", "compass", "height"]


@pytest.mark.parametrize(
    ("key", "value"), [("unit", "knots"), ("gyro_unit", "deg/s"), ("through", "water"), ("gravity", "removed")]
)
def test_the_reference_of_keys_names_the_values_of_those_that_have_few(key: str, value: str) -> None:
    rows = (ROOT / "docs/configuration.md").read_text(encoding="utf-8").splitlines()
    assert any(row.startswith(f"| `{key}` |") and f"`{value}`" in row for row in rows)


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
