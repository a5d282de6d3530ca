# SPDX-License-Identifier: Apache-2.0
"""Settings of the whole test run."""

import gc
import os
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

# As many threads of linear algebra as cores, in each of as many workers, wait for each other: 7 to 25 % of the processor's time; those of
# the matcher 5 %. Before numpy is imported; workers and programs that tests start inherit it.
for threads in ("OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")
# Where the shell has Python keep nothing of what it compiles, each worker compiles all modules and tests anew, and each program that tests
# start all modules: 5 s of the processor's time a worker, half a second a program.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
gc.set_threshold(100_000, 20, 100)  # looking again and again through runs that tests share took 3 % of the time


def _tried_after(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    from graphloc.online import _start, _waiting

    monkeypatch.setattr(_start, "_LONGEST_WAIT_S", seconds)
    monkeypatch.setattr(_waiting, "_TRY_EVERY_S", seconds + 0.2)
    monkeypatch.setattr(_waiting, "_TRY_AGAIN", 0.0)


@pytest.fixture
def few_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """An online start waits for 15 s, not for 30, and is tried at their end, not ten times: each solves all that there is."""
    _tried_after(monkeypatch, 15.0)


@pytest.fixture
def short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `few_tries`, for 10 s."""
    _tried_after(monkeypatch, 10.0)


@pytest.fixture
def coarse_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """The aerial image beside a bag has pixels of 2 m, where nothing looks at it: drawn in full, it takes as long as the bag."""
    _drawn_with(monkeypatch, 2.0)


def _drawn_with(patch: pytest.MonkeyPatch, pixel_m: float) -> None:
    """The aerial image beside a bag, drawn with pixels of this size."""
    from graphloc.eval.simulate import aerial, bag

    patch.setattr(bag, "render", lambda harbour, seed: aerial.render(harbour, seed, pixel_m=pixel_m))


@pytest.fixture
def map_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report draws its map and no other figure, where nothing looks at them: they take longer than a short run."""
    from graphloc.eval.report import _page

    every = _page.figures
    monkeypatch.setattr(_page, "figures", lambda data: {k: f for k, f in every(data).items() if k == "map"})


@pytest.fixture(scope="session")
def scanned_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated run with scans of five LiDARs, twice a second for 16 s."""
    return _made_once(tmp_path_factory, "scanned", {"duration_s": "16"})


@pytest.fixture(scope="session")
def launch_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated run with scans of one LiDAR, twice a second for 18 s."""
    return _made_once(tmp_path_factory, "launch", {"duration_s": "18", "rig": "launch"})


def _made_once(factory: pytest.TempPathFactory, name: str, changes: dict[str, str]) -> Path:
    """Write the bag of a run in a harbour, or take that of another worker; it is not to be changed."""
    from graphloc.eval.simulate import find_scenario
    from graphloc.eval.simulate.bag import write_bag
    from tests.slowly import simulate_slowly

    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"{name}-run"
    if not folder.exists():
        made = factory.mktemp(name) / "sim"
        scenario = find_scenario("bl1-drift", {"pose_hz": "0", "lidar_hz": "2", **changes})
        run = simulate_slowly(scenario, 3)
        # Layers of the map reach as far: their area, and most of the time that a matcher takes to begin, are half.
        aerial = run.config.sensors["aerial"].model_copy(update={"reach_m": 60.0})
        # Half of the columns, so half of the points: what is done with them takes half as long.
        sparse = {name: lidar.model_copy(update={"step_deg": 0.4}) for name, lidar in run.rig.lidars.items()}
        rig = run.rig.model_copy(update={"lidars": sparse})
        with pytest.MonkeyPatch.context() as patch:
            _drawn_with(patch, 0.24)  # half of the usual pixels, and of the time, which is half of the bag's
            write_bag(replace(run, config=run.config.with_sensors({"aerial": aerial}), rig=rig), made, ros=2)
        with suppress(OSError):  # another worker was quicker
            made.rename(folder)
    return folder
