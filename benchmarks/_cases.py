# SPDX-License-Identifier: Apache-2.0
"""What `make bench` runs. Each case is called in a fresh process, and gives counts, which are held to a baseline, and
ratios, which are not: they are times over those of a fixed load in the same process, or sizes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import gtsam
import numba
import numpy as np
import soak
import tag_detector
from _gate import Figure
from _kernel import kernel_s
from _scenes import samples
from batch import alone, exponent, loops, peak_mib
from matcher import _config

from graphloc import app
from graphloc.eval.simulate.bag import write_bag
from graphloc.frontends.aerial.matcher import Matcher
from graphloc.frontends.tags.detect import Detector
from graphloc.replay import replay

_SOLVER = 0.05  # of its counts, for another machine's arithmetic
_ONLINE = 0.15  # what is relinearised turns on thresholds, and threads add in any order


def _exact(key: str, value: float, unit: str = "count") -> Figure:
    return Figure(key, float(value), unit, "count")


def _work(key: str, value: float, tolerance: float = _SOLVER, unit: str = "count") -> Figure:
    return Figure(key, float(value), unit, "count", "<=", tolerance)


def _ratio(key: str, value: float, unit: str) -> Figure:
    return Figure(key, float(value), unit, "ratio", "<=")


def batch() -> list[Figure]:
    """2 min and 20 min at once; 2 h is F.3's."""
    figures, found = [], {}
    for name, length_s, times in (("2 min", 120.0, 3), ("20 min", 1200.0, 1)):
        found[name] = one = alone(length_s, times)
        figures += [
            *(_exact(f"batch {name}: {what}", one[what]) for what in ("measurements", "samples", "states", "ledger")),
            *(_work(f"batch {name}: {what}", one[what]) for what in ("factors", "iterations", "passes")),
            _exact(f"batch {name}: converged", one["converged"], "yes"),
            _ratio(f"batch {name}: time / that of the run", one["processor_s"] / length_s, "ratio"),
            _ratio(f"batch {name}: time / that of the fixed load", one["processor_s"] / one["kernel_s"], "ratio"),
            _ratio(f"batch {name}: memory that solving took", one["peak_mib"] - one["before_mib"], "MiB"),
        ]
    for what, direct in (("iterations", _work), ("processor_s", _ratio)):
        grown = exponent(found["2 min"][what], found["20 min"][what], 10.0)
        key = "batch, 2 min to 20 min: exponent of " + ("the time" if what == "processor_s" else what)
        figures.append(direct(key, grown, unit="power"))
    return figures


@contextmanager
def _counted() -> Iterator[list[int]]:
    """How many variables each update of the online mode eliminates."""
    update, found = gtsam.ISAM2.update, list[int]()

    def counting(solver: gtsam.ISAM2, *args: Any, **more: Any) -> Any:
        result = update(solver, *args, **more)
        found.append(int(result.getVariablesReeliminated()))
        return result

    with patch.object(gtsam.ISAM2, "update", counting):
        yield found


def online() -> list[Figure]:
    """A minute of the run through the online mode."""
    run = loops(60.0)
    with _counted() as eliminated:
        done = replay(run.recording, run.config)
    load_s, took = kernel_s(), done.update_s[1:]
    return [
        _exact("online 60 s: estimates", len(done.estimates)),
        _exact("online 60 s: rows of the ledger", sum(1 for _ in done.solution.ledger)),
        _work("online 60 s: updates of the tree", len(eliminated), _ONLINE),
        _work("online 60 s: variables eliminated", sum(eliminated), _ONLINE),
        _ratio("online 60 s: time / that of the run", float(took.sum()) / 60.0, "ratio"),
        *(
            _ratio(f"online 60 s: an update, {name} / the fixed load", float(np.quantile(took, q)) / load_s, "ratio")
            for name, q in (("median", 0.5), ("99 %", 0.99), ("longest", 1.0))
        ),
    ]


def soaked() -> list[Figure]:
    """Five minutes of the run in the lag: what a day shows (`soak.py`), in little."""
    minutes = list(soak.measured(5.0 / 60.0))
    first, last = minutes[1], minutes[-1]
    return [
        _exact("soak 5 min: minutes with estimates", len(minutes)),
        _work("soak 5 min: places for factors, last minute", last.factor_slots, _ONLINE),
        _ratio("soak 5 min: places for factors, last / second minute", last.factor_slots / first.factor_slots, "ratio"),
        _ratio("soak 5 min: median update, last / second minute", last.update_p50_ms / first.update_p50_ms, "ratio"),
        _ratio("soak 5 min: memory, last less second minute", last.memory_mib - first.memory_mib, "MiB"),
    ]


def matching(views: int = 6) -> list[Figure]:
    """Scans on the aerial image."""
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        made = samples("case 1", 100, Path(folder), views)
        matcher = Matcher(_config(made[0], vector=False), Path(folder), made[0].datum)
        look = lambda: [matcher.match(view.clouds[0], view.prior) for view in made]
        found = look()  # Numba compiles, the map is drawn
        took_s = _timed(look) / views
    scored = sum(m.score.size for m in found if m.score is not None)
    right = sum(bool(m.modes) and _near(m.modes[0].pose, view.true) for m, view in zip(found, made, strict=True))
    return [
        _exact(f"matcher {views} views: scans with a mode", sum(bool(m.modes) for m in found)),
        Figure(f"matcher {views} views: first mode within 1 m and 1.5 deg", right, "count", "count", ">="),
        _work(f"matcher {views} views: modes", sum(len(m.modes) for m in found), 0.2),
        _work(f"matcher {views} views: poses scored", scored, 0.0),
        _ratio("matcher: a scan / the fixed load", took_s / kernel_s(), "ratio"),
        _ratio("matcher: largest memory of the process, simulator included", peak_mib(), "MiB"),
    ]


def _near(pose: Any, true: Any) -> bool:
    turn = (pose[2] - true[2] + np.pi) % (2.0 * np.pi) - np.pi
    return bool(np.hypot(*(pose[:2] - true[:2])) < 1.0 and abs(turn) < np.radians(1.5))


def _timed(work: Callable[[], object]) -> float:
    """The shortest of three, s of the processor."""
    took = []
    for _ in range(3):
        begin = time.process_time()
        work()
        took.append(time.process_time() - begin)
    return min(took)


def tags() -> list[Figure]:
    """Images of an approach to the quay, in good and in bad weather."""
    cv2.setNumThreads(1)
    figures = []
    for condition in ("optimal", "fog"):
        views = list(tag_detector.views(condition, 230, np.arange(16.0, 100.0, 12.0)))
        detector = Detector()
        found = [{d.number for d in detector.detect(view.pixels)} for view in views]
        took_s = _timed(lambda: [detector.detect(view.pixels) for view in views]) / len(views)  # noqa: B023
        label = f"tag detector {condition}, {len(views)} images"
        seen = sum(len(numbers & view.tags.keys()) for numbers, view in zip(found, views, strict=True))
        false = sum(len(numbers - view.present) for numbers, view in zip(found, views, strict=True))
        figures += [
            _exact(f"{label}: tags in view", sum(len(view.tags) for view in views)),
            Figure(f"{label}: tags found", seen, "count", "count", ">="),
            _work(f"{label}: false detections", false, 0.0),
            _ratio(f"tag detector {condition}: an image / the fixed load", took_s / kernel_s(), "ratio"),
        ]
    return figures


def bags() -> list[Figure]:
    """Two minutes written as a bag of each kind and read again; the run folder of the solved run."""
    run, figures = loops(120.0), []
    with tempfile.TemporaryDirectory() as scratch:
        for name, ros, storage in (("ROS 1", 1, "mcap"), ("MCAP", 2, "mcap"), ("sqlite3", 2, "sqlite3")):
            bag, vessel = write_bag(run, Path(scratch) / name, ros=ros, storage=storage)
            took_s = _timed(lambda: app.load([bag], vessel))  # noqa: B023
            recording, config = app.load([bag], vessel)
            assert recording.imu is not None
            figures += [
                _exact(f"bag {name}: messages read", recording.message_count),
                _exact(f"bag {name}: measurements", len(recording.measurements)),
                _exact(f"bag {name}: IMU samples", len(recording.imu)),
                _work(f"bag {name}: bytes", _bytes(bag), 0.01, "byte"),
                _ratio(f"bag {name}: reading / the fixed load", took_s / kernel_s(), "ratio"),
            ]
        solved, folder = app.smooth_recording(recording, config), Path(scratch) / "out"
        app.write(solved, folder, inputs=[bag], command="make bench", overwrite=False)
        figures += [
            _exact("run folder: rows of the ledger", sum(1 for _ in solved.solution.ledger)),
            _exact("run folder: files", sum(p.is_file() for p in folder.rglob("*"))),
            _work("run folder: bytes of report.html", (folder / "report.html").stat().st_size, 0.1, "byte"),
            _work("run folder: bytes of the rest", _bytes(folder) - (folder / "report.html").stat().st_size, 0.1, "byte"),
            _ratio("bags, solved, written: largest memory of the process", peak_mib(), "MiB"),
        ]  # fmt: skip
    return figures


def _bytes(path: Path) -> int:
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return sum(p.stat().st_size for p in files)


CASES: dict[str, Callable[[], list[Figure]]] = {
    "batch": batch, "online": online, "soak": soaked, "matcher": matching, "tags": tags, "bags": bags,
}  # fmt: skip
