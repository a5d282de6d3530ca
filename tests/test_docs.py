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
    rows = {row["name"]: row["value"] for row in _figures()}
    said = re.search(r"time_offset_s: ([\d.]+) \+- ([\d.]+) s", (ROOT / "docs/calibration.md").read_text())
    assert said is not None
    suggested, sigma = (
        rows[f"KITTI as it is: {what}"] for what in ("gnss.time_offset_s that it suggests", "its sigma")
    )
    assert (float(said[1]), float(said[2])) == (suggested, sigma)


# Figures of README, in its words, {} for each; and the rows of docs/results.json, as (item, name), that give them.
_BL, _DRAWN, _BAGS = "BL case 1, {}, 10 seeds: {}", "80 drawn vessels, {}: {}", "{}, 5 seeds, from bags: {}"
_RMSE, _LOSS, _OURS = (
    "position RMSE, mean",
    "position RMSE of the BL EKF (told of a signal loss)",
    "position RMSE of the BL EKF with our matches",
)
_SPEED, _DARK = (
    "{}, 120 s, 10 states/s on two cores: an update, {}",
    "no position for a minute, 16 outages, {}: off after {} s, RMS",
)
README_FIGURES = [
    ("| graphloc, offline | {} m | {} m | A.3 |", [("A.3", _BL.format(noise, _RMSE)) for noise in ("drift", "jump")]),
    ("| graphloc, online | {} m | {} m | E.1 |", [("E.1", "online, " + _BL.format(noise, _RMSE)) for noise in ("drift", "jump")]),
    ("| thesis EKF (signal losses flagged by hand) | {} m | {} m | A.3 |", [("A.3", _BL.format(n, _LOSS)) for n in ("drift", "jump")]),
    ("| graphloc, offline, scans on an image | {} m | {} m | C.4 |", [("C.4", _BAGS.format(n, _RMSE)) for n in ("bl1-drift", "bl1-jump")]),
    ("| thesis EKF (losses flagged), the same matches | {} m | **{} m** | C.4 |", [("C.4", _BAGS.format(n, _OURS)) for n in ("bl1-drift", "bl1-jump")]),
    ("Of the {} m, all but {} m is the shift of the image itself",
     [("C.4", _BAGS.format("bl1-drift", what)) for what in (_RMSE, "position RMSE from where the image shows it, mean")]),
    ("slightly better: {} m against {}, and {} against {}.",
     [("C.4", _BAGS.format(name, what)) for name in ("bl1-jump", "bl2-jump") for what in (_OURS, _RMSE)]),
    ("| graphloc, offline | {} m | {} m | {} % |",
     [("F.drawn", _DRAWN.format("batch", what)) for what in ("position RMSE, median", _RMSE, "95 % coverage, mean")]),
    ("| graphloc, online | {} m | {} m | {} % |",
     [("F.drawn", _DRAWN.format("online", what)) for what in ("position RMSE, median", _RMSE, "95 % coverage, mean")]),
    ("| honest EKF | {} m | {} m | |",
     [("F.drawn", _DRAWN.format("honest EKF", what)) for what in ("position RMSE, median", _RMSE)]),
    ("an update takes {} ms (median), {} ms (99 %) in the harbour entry, {} and {} ms when docking by tags",
     [("E.2", _SPEED.format(run, what)) for run in ("BL case 1", "docking by tags") for what in ("median", "99 %")]),
    ("two minutes are solved {} times faster than real time, target 50 (F.3); two hours {} times",
     [("F.3", f"batch, {length}, measurements given: times faster than real time") for length in ("2 min", "2 h")]),
    ("{} m off after 10 s, {} m after 30 s, {} m after a minute (RMS, E.dark; the honest EKF: {}, {}, {} m)",
     [("E.dark", _DARK.format(who, after_s)) for who in ("online", "honest EKF") for after_s in (10, 30, 60)]),
]  # fmt: skip


@pytest.mark.parametrize(("words", "rows"), README_FIGURES, ids=[words for words, _ in README_FIGURES])
def test_figures_of_the_readme_are_those_of_the_results(words: str, rows: list[tuple[str, str]]) -> None:
    """To the digits that it shows."""
    values = {(row["item"], row["name"]): row["value"] for row in _figures()}
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    (shown,) = re.findall(re.escape(words).replace(r"\{\}", r"([\d.]*\d)"), text)
    for figure, row in zip(shown, rows, strict=True):
        assert figure == f"{values[row]:.{len(figure.partition('.')[2])}f}", row


def test_counts_and_ratios_of_the_readme_are_those_of_the_results() -> None:
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    aimed = [row for row in _figures() if row["bound"] is not None]
    missed = [
        row
        for row in aimed
        if (row["value"] > row["bound"]) == (row["direction"] == "<=") and row["value"] != row["bound"]
    ]
    assert f"{len(missed)} of {len(aimed)} targets are missed" in text
    bags = {row["name"]: row["value"] for row in _figures() if row["item"] == "C.4"}
    runs = [name.partition(",")[0] for name in bags if name.endswith("from bags: " + _RMSE)]
    assert len(runs) == len([row for row in missed if row["item"] == "C.4" and row["name"].endswith(_RMSE)]) == 9
    ratios = sorted(bags[_BAGS.format(run, _OURS)] / bags[_BAGS.format(run, _RMSE)] for run in runs)
    assert [ratio < 1.0 for ratio in ratios] == [True] * 2 + [False] * 7
    assert f"the other seven cases its error is {ratios[2]:.1f} to {ratios[-1]:.1f} times that of graphloc" in text


def _figures() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((ROOT / "docs/results.json").read_text())["figures"]
    return found


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
