# SPDX-License-Identifier: Apache-2.0
"""The wheel holds all rooms, and works from a neutral folder with nothing of this checkout on the path."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent


def _not_source(folder: str, names: list[str]) -> set[str]:
    built = {"build", "runs"} if Path(folder) == ROOT else set()
    return built | shutil.ignore_patterns(".*", "*.egg-info", "__pycache__")(folder, names)


def test_the_wheel_works_elsewhere(tmp_path: Path) -> None:
    source = tmp_path / "source"  # a copy: building leaves folders behind
    shutil.copytree(ROOT, source, symlinks=True, ignore=_not_source)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(tmp_path), str(source)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("graphloc-*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    for room in ("graphloc", "factors", "frontends", "eval"):
        for path in (ROOT / room).rglob("*.py"):
            inside = path.relative_to(ROOT).as_posix()
            assert (inside if room == "graphloc" else f"graphloc/{inside}") in held
    assert "graphloc/py.typed" in held
    # Unpacked before the editable install: its dependencies come from there, graphloc from the wheel.
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    neutral = tmp_path / "neutral"
    neutral.mkdir()
    # What takes long to import and few use is not there to begin with.
    code = (
        "import sys, graphloc, graphloc.app; assert 'scipy.stats' not in sys.modules;"
        "from graphloc.eval.simulate import Scenario, simulate;"
        "print(graphloc.__file__);"
        "run = graphloc.app.simulated(simulate(Scenario(duration_s=6.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 1));"
        "print(len(run.solution.trajectory), run.solution.stats.converged)"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=neutral, env=environment, capture_output=True, text=True, check=True
    )
    where, numbers = done.stdout.strip().splitlines()
    assert where.startswith(str(tmp_path / "site"))
    assert numbers == "60 True"
