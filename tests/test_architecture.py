"""Which folder may import which, and that importing graphloc loads nothing heavy and writes nothing."""

import ast
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
VOCABULARY = {
    "errors", "time", "chi2", "gauss", "frames", "measurements", "ledger", "trajectory", "config", "recording", "offsets", "solution", "estimate", "plain", "blocks", "signals", "survey", "berths", "extras", "folders", "_config_docs",
}  # fmt: skip
DOOR = {"__main__", "app", "cli", "drills", "found_tags", "gather", "replay", "stream", "job", "sweep", "ablations"}
GRAPH = {
    "graph", "inertial", "linear", "motion_model", "keys", "timeline", "build", "judge", "solve", "online", "origin", "outputs", "row_check",
}  # fmt: skip
FORBIDDEN = {
    "facade": set[str](),  # graphloc/__init__.py imports its public names when they are first used
    "vocabulary": {"factors", "frontends", "eval", "gtsam"} | GRAPH | DOOR,
    "graph": {"factors", "frontends", "eval"} | DOOR,
    "factors": {"frontends", "eval"} | GRAPH - {"graph", "inertial", "linear", "keys"} | DOOR,
    "frontends": {"factors", "eval", "gtsam"} | GRAPH | DOOR,
    "eval": DOOR,
    "door": set[str](),
}
# Both solvers judge by `judge`, and the online mode starts as `solve` does; nothing below knows it, and building knows no solver.
ABOVE = {
    **{name: {"build", "judge", "solve", "online"} for name in ("graph", "inertial", "linear", "keys", "timeline", "motion_model")},
    "origin": {"judge", "solve", "online"}, "build": {"judge", "solve", "online"}, "judge": {"solve", "online"},
    "solve": {"online"}, "outputs": {"build", "judge", "solve", "online"},
}  # fmt: skip


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module} | {f"{node.module}.{a.name}" for a in node.names}
    return found


def kind_of(path: Path) -> str:
    first, second = path.relative_to(ROOT).parts[:2]
    if first != "graphloc":
        return first
    name = second.removesuffix(".py")
    if name == "__init__":
        return "facade"
    if name in VOCABULARY:
        return "vocabulary"
    return "graph" if name in GRAPH else "door"


MODULES = sorted(p for room in ("graphloc", "factors", "frontends", "eval") for p in (ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    above = ABOVE.get(path.relative_to(ROOT).parts[1].removesuffix(".py"), set()) if kind_of(path) == "graph" else set()
    forbidden = {name if name == "gtsam" else f"graphloc.{name}" for name in FORBIDDEN[kind_of(path)] | above}
    bad = {i for i in imports_of(path) if any(i == f or i.startswith(f + ".") for f in forbidden)}
    assert not bad


def test_each_module_of_graphloc_is_of_one_kind() -> None:
    assert VOCABULARY.isdisjoint(GRAPH)
    assert (VOCABULARY | GRAPH).isdisjoint(DOOR)
    told = {p.relative_to(ROOT).parts[1].removesuffix(".py") for p in MODULES if p.is_relative_to(ROOT / "graphloc")}
    assert told - {"__init__"} == VOCABULARY | GRAPH | DOOR


def _name_of(path: Path) -> str:
    """As it is imported."""
    dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    return dotted if dotted.startswith("graphloc") else f"graphloc.{dotted}"


def test_a_private_module_is_of_its_package_alone() -> None:
    """`_x.py` may change as its package likes: what another one imports is public, and says so by its name."""
    names = {_name_of(path) for path in MODULES}
    for path in MODULES:
        package = _name_of(path) if path.stem == "__init__" else _name_of(path).rpartition(".")[0]
        for found in imports_of(path) & names:
            home, _, name = found.rpartition(".")
            private = name.startswith("_") and not name.startswith("__")
            assert not private or f"{package}.".startswith(f"{home}."), f"{path}: {found}"


def test_only_the_door_opens_to_all() -> None:
    assert {
        p.relative_to(ROOT / "graphloc").parts[0].removesuffix(".py") for p in MODULES if kind_of(p) == "door"
    } == DOOR


def test_a_name_means_one_class() -> None:
    """But for private ones, of a module alone."""
    places: dict[str, list[str]] = {}
    for path in MODULES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_import_is_light_and_writes_nothing(tmp_path: Path) -> None:
    code = (
        "import sys, graphloc, graphloc.cli; heavy = {'gtsam', 'cv2', 'open3d', 'matplotlib', 'plotly', 'rosbags'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    env = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-B", "-c", code], env=env, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
    assert not list(tmp_path.iterdir())


def test_declared_packages_are_those_on_disk() -> None:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    found = set()
    for folder, name in ((".", "graphloc"), (".", "factors"), (".", "frontends"), (".", "eval")):
        for path in {p.parent for p in (ROOT / folder / name).rglob("*.py")}:
            assert (path / "__init__.py").exists(), path
            dotted = ".".join(path.relative_to(ROOT).parts)
            found.add(dotted if dotted.startswith("graphloc") else f"graphloc.{dotted}")
    assert found == set(config["packages"])


@pytest.mark.parametrize("folder", ["build", "judge", "solve", "online"])
def test_each_module_of_the_solvers_has_a_place_on_the_map(folder: str) -> None:
    """Three of them had none: a reader who looks for what a file is for finds nothing."""
    said = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    modules = {path.name for path in (ROOT / "graphloc" / folder).glob("*.py")} - {"__init__.py"}
    assert {name for name in modules if f"{name}`" not in said} == set()


@pytest.mark.parametrize("room", ["factors", "frontends", "eval"])
def test_links_for_type_checkers_resolve(room: str) -> None:
    link = ROOT / "typings/graphloc" / room
    if not link.is_symlink():
        pytest.skip("this checkout has no symbolic links")
    assert link.resolve() == ROOT / room


@pytest.mark.parametrize("room", ["factors", "frontends", "eval", "tests"])
def test_rooms_are_no_top_level_modules(room: str, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", f"import {room}"], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode != 0


@pytest.mark.parametrize("path", [p for p in MODULES if kind_of(p) == "graph"], ids=lambda p: p.name)
def test_graph_and_solvers_name_no_sensor(path: Path) -> None:
    """They only know the inertial sensor and the base class of measurements; the rest is in the rows of the sensors."""
    known = {"Measurement", "ImuSeries", "ImuSample", "NO_HEIGHT_M2"} | (
        {"GnssPosition"} if path.stem == "origin" else set()
    )
    named = {i for i in imports_of(path) if i.startswith("graphloc.measurements.")}
    assert named <= {f"graphloc.measurements.{name}" for name in known}
