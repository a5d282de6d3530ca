# SPDX-License-Identifier: Apache-2.0
"""Figures of C: scans laid on an aerial image, one by one and in whole runs."""

from __future__ import annotations

import itertools
import os
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
from _rows import Row, row
from _scenes import Sample, as_shown, samples, scratch, together
from scipy.stats import chi2
from smoothing import loss_ns

from graphloc import app
from graphloc.config import AerialConfig
from graphloc.eval import ekf
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import find_scenario, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.frames import wrap_angle
from graphloc.frontends.aerial.bl import BLMatcher
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.matcher import Match, Matcher, Prior
from graphloc.frontends.aerial.scan import LevelCloud
from graphloc.gather import with_matches

_SEEDS, _VIEWS = range(100, 106), 8
# Routes that each figure is of, and its bound on success with one scan.
_GROUPS = {
    "case 1 (many crossing edges)": (("case 1", "case 1, turn"), 95.0),
    "case 2 (few)": (("case 2", "case 2, entry"), 92.0),
    "crowded marina": (("crowded", "crowded, turn"), 55.0),
}
_CROWDED = "crowded marina"
_SUBMAP = 8
_CHI2_3_95 = 7.815


class Outcome(NamedTuple):
    """What came of a match.

    Attributes:
        off: (modes, 2) m and deg from the truth. probability, nees: (modes,).
    """

    off: Any
    probability: Any
    nees: Any

    @property
    def success(self) -> bool:
        return bool(len(self.off) and self.off[0, 0] < 1.0 and self.off[0, 1] < 1.5)


def _outcome(found: Match, true: Any) -> Outcome:
    d = np.array([m.pose - true for m in found.modes]).reshape(-1, 3)
    d[:, 2] = wrap_angle(d[:, 2])
    nees = [float(v @ np.linalg.solve(m.cov, v)) for v, m in zip(d, found.modes, strict=True)]
    off = np.column_stack([np.hypot(d[:, 0], d[:, 1]), np.degrees(np.abs(d[:, 2]))])
    return Outcome(off, np.array([m.probability for m in found.modes]), np.array(nees))


def _config(sample: Sample, vector: bool) -> AerialConfig:
    return sample.config.model_copy(update={"image": sample.image.name, "vector": sample.vector.name if vector else ""})


def _one_scan(job: tuple[str, int, Path]) -> dict[str, list[Outcome]]:
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    scene, seed, folder = job
    found: dict[str, list[Outcome]] = {"ours": [], "bl": [], "lines": []}
    for sample in samples(scene, seed, folder, _VIEWS):
        (cloud,) = sample.clouds
        ours = Matcher(_config(sample, False), folder, sample.datum).match(cloud, sample.prior)
        lines = Matcher(_config(sample, True), folder, sample.datum).match(cloud, sample.prior)
        bl = BLMatcher(_config(sample, False), AerialImage(sample.image, sample.datum), seed).match(cloud, sample.prior)
        for name, match in (("ours", ours), ("bl", bl), ("lines", lines)):
            found[name].append(_outcome(match, sample.true))
    return found


def _submap(job: tuple[str, int, Path]) -> dict[str, list[Outcome]]:
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    scene, seed, folder = job
    found: dict[str, list[Outcome]] = {"ours": [], "lines": []}
    for sample in samples(scene, seed, folder, _VIEWS, _SUBMAP):
        for name, vector in (("ours", False), ("lines", True)):
            match = Matcher(_config(sample, vector), folder, sample.datum).match(together(sample.clouds), sample.prior)
            found[name].append(_outcome(match, sample.true))
    return found


_Found = dict[str, dict[str, list[Outcome]]]


def _measured(pool: ProcessPoolExecutor) -> tuple[_Found, dict[str, list[Outcome]]]:
    """By group: outcomes of one scan by way; those of submaps in the crowded marina by way."""
    folder = scratch()
    jobs = {g: [(s, seed, folder / str(k)) for k, (s, seed) in enumerate(itertools.product(scenes, _SEEDS))] for g, (scenes, _) in _GROUPS.items()}  # fmt: skip
    for group in jobs.values():
        for _, _, place in group:
            place.mkdir(exist_ok=True)
    futures = {g: [pool.submit(_one_scan, job) for job in group] for g, group in jobs.items()}
    together_ = [pool.submit(_submap, job) for job in jobs[_CROWDED]]

    def joined(parts: list[dict[str, list[Outcome]]]) -> dict[str, list[Outcome]]:
        return {way: [o for part in parts for o in part[way]] for way in parts[0]}

    return {g: joined([f.result() for f in fs]) for g, fs in futures.items()}, joined([f.result() for f in together_])


_cache: dict[str, Any] = {}


def _views(pool: ProcessPoolExecutor) -> tuple[_Found, dict[str, list[Outcome]]]:
    if "views" not in _cache:
        _cache["views"] = _measured(pool)
    found: tuple[_Found, dict[str, list[Outcome]]] = _cache["views"]
    return found


def _share(outcomes: list[Outcome]) -> float:
    return 100.0 * float(np.mean([o.success for o in outcomes]))


def success(pool: ProcessPoolExecutor) -> list[Row]:
    one, submap = _views(pool)
    rows = []
    for group, (_, bound) in _GROUPS.items():
        n = len(one[group]["ours"])
        rows.append(row("C.1", f"{group}, {n} views, one scan: success", _share(one[group]["ours"]), "%", bound, ">="))
        rows.append(row("C.1", f"{group}, one scan: success of BL's matcher", _share(one[group]["bl"]), "%"))
        rows.append(row("C.1", f"{group}, one scan, image and drawn lines: success", _share(one[group]["lines"]), "%"))
    rows.append(row("C.1", f"{_CROWDED}, {_SUBMAP} scans: success", _share(submap["ours"]), "%", 70.0, ">="))
    rows.append(row("C.1", f"{_CROWDED}, {_SUBMAP} scans, image and drawn lines: success", _share(submap["lines"]), "%", 90.0, ">="))  # fmt: skip
    return rows


def accuracy(pool: ProcessPoolExecutor) -> list[Row]:
    one, _ = _views(pool)
    rows = []
    for group in [*_GROUPS, "all scenes"]:
        outcomes = one[group]["ours"] if group in one else [o for found in one.values() for o in found["ours"]]
        off = np.array([o.off[0] for o in outcomes if o.success])
        rms = np.sqrt((off**2).mean(axis=0))
        rows.append(row("C.2", f"{group}, one scan: position RMSE of successes", rms[0], "m", 0.25, "<="))
        rows.append(row("C.2", f"{group}, one scan: heading RMSE of successes", rms[1], "deg", 0.4, "<="))
    return rows


def honesty(pool: ProcessPoolExecutor) -> list[Row]:
    one, _ = _views(pool)
    rows = []
    sure = []
    for group in _GROUPS:
        outcomes = one[group]["ours"]
        claimed = [o.success for o in outcomes if len(o.off) and o.probability[0] > 0.9]
        sure += claimed
        rows.append(row("C.3", f"{group}: claims over 0.9, of {len(outcomes)}", len(claimed), "count"))
        rows.append(row("C.3", f"{group}: right where it claims over 0.9", 100.0 * float(np.mean(claimed)), "%"))
        inside = [o.nees[0] < _CHI2_3_95 for o in outcomes if o.success]
        rows.append(row("C.3", f"{group}: right modes inside their 95 % bounds", 100.0 * float(np.mean(inside)), "%"))
        nees = [o.nees[0] / 3.0 for o in outcomes if o.success]
        most = float(chi2.ppf(0.975, 3 * len(nees))) / (3 * len(nees))  # views of one run are not quite independent
        rows.append(
            row("C.3", f"{group}: mean NEES / 3 of right modes", float(np.mean(nees)), "ratio", round(most, 3), "<=")
        )
        if group != _CROWDED:
            near = [bool(((o.off[:3, 0] < 0.5) & (o.off[:3, 1] < 1.0)).any()) for o in outcomes]
            rows.append(row("C.3", f"{group}: truth within 0.5 m and 1 deg of one of three modes", 100.0 * float(np.mean(near)), "%", 90.0, ">="))  # fmt: skip
    rows.insert(0, row("C.3", "all scenes: right where it claims over 0.9", 100.0 * float(np.mean(sure)), "%", 95.0, ">="))  # fmt: skip
    return rows


_KINDS = ("drift", "jump", "outage")
_RUN_SEEDS = range(5)


class _Errors(NamedTuple):
    """Position RMSE (m) and heading RMSE (deg) of estimates of one run."""

    ours: tuple[float, float]
    on_image: tuple[float, float]  # from where the image has the vessel
    alone: tuple[float, float]
    filter_ours: tuple[float, float]
    filter_bl: tuple[float, float] | None
    matches: int


def _run(job: tuple[str, int]) -> _Errors:
    """One run from its bag: smoothed with and without matches; BL's filter with our matches and, of one seed, with BL's."""
    name, seed = job
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch_:
        folder = Path(scratch_) / "sim"
        simulated = simulate(find_scenario(name, {"pose_hz": "0"}), seed)
        told = ekf.BlConfig(loss_ns=loss_ns(simulated))
        write_bag(simulated, folder, ros=2)
        recording, config = app.load([folder / "run"], folder / "vessel.yaml")
        sensors = dict(config.sensors)
        sensors["aerial"] = sensors["aerial"].model_copy(update={"enabled": True})
        config = config.model_copy(update={"sensors": sensors})
        scans = app.Scans((folder / "run",), folder)
        truth = recording.truth
        assert truth is not None

        shown = as_shown(truth, folder)

        def off(track: Any, from_: Any = truth) -> tuple[float, float]:
            found = compare_to_truth(track, from_)
            return found.position_rmse_m, found.heading_rmse_deg

        alone = app.smooth_recording(recording, config)
        datum = app.choose_datum(recording, config)
        with_scans = app.smooth_recording(recording, config, scans=scans)
        matched, ours = with_scans.recording, with_scans.solution
        filter_bl = None
        if seed == 0:
            sensors["aerial"] = sensors["aerial"].model_copy(update={"matcher": "bl", "every_m": 0.0})
            theirs = config.model_copy(update={"sensors": sensors})
            by_bl = with_matches(alone.recording, theirs, datum, alone.solution, scans).recording
            filter_bl = off(ekf.run_bl(by_bl, theirs, datum, told).trajectory)
        return _Errors(
            off(ours.trajectory), off(ours.trajectory, shown), off(alone.solution.trajectory),
            off(ekf.run_bl(matched, config, datum, told).trajectory), filter_bl,
            sum(m.sensor == "aerial" for m in matched.measurements),
        )  # fmt: skip


def runs(pool: ProcessPoolExecutor) -> list[Row]:
    names = [f"bl{case}-{kind}" for case in (1, 2, 3) for kind in _KINDS]
    jobs = [(name, seed) for name in names for seed in _RUN_SEEDS]
    found = dict(zip(jobs, pool.map(_run, jobs), strict=True))
    rows = []
    worse = 0
    for name in names:
        errors = [found[name, seed] for seed in _RUN_SEEDS]
        worse += sum(e.ours[0] > e.alone[0] for e in errors)
        label = f"{name}, {len(errors)} seeds, from bags"
        mean = np.mean([e.ours for e in errors], axis=0)
        rows.append(row("C.4", f"{label}: position RMSE, mean", mean[0], "m", 0.25, "<="))
        rows.append(row("C.4", f"{label}: position RMSE, worst seed", max(e.ours[0] for e in errors), "m"))
        rows.append(row("C.4", f"{label}: position RMSE from where the image shows it, mean", np.mean([e.on_image[0] for e in errors]), "m"))  # fmt: skip
        rows.append(row("C.4", f"{label}: heading RMSE, mean", mean[1], "deg", 0.4, "<="))
        rows.append(row("C.4", f"{label}: position RMSE without matches", np.mean([e.alone[0] for e in errors]), "m"))
        rows.append(row("C.4", f"{label}: position RMSE of the BL EKF with our matches", np.mean([e.filter_ours[0] for e in errors]), "m"))  # fmt: skip
        bl = [e.filter_bl[0] for e in errors if e.filter_bl is not None]
        rows.append(row("C.4", f"{name}, seed 0: position RMSE of the BL EKF with BL's matcher", np.mean(bl), "m"))
    rows.append(row("C.4", f"runs, of {len(jobs)}, that matches made worse than GNSS alone", worse, "runs", 0, "<="))
    return rows


def _thinned(cloud: LevelCloud, count: int, rng: np.random.Generator) -> LevelCloud:
    """So many of its points; each again, a centimetre beside, where it has fewer."""
    pick = rng.integers(len(cloud.points_m), size=count)
    return LevelCloud(cloud.points_m[pick] + rng.normal(0.0, 0.01, (count, 3)), cloud.origin_m[pick])


def _timed(matcher: Any, views: list[tuple[LevelCloud, Prior]]) -> np.ndarray[Any, Any]:
    times = []
    for cloud, prior in views:
        begin = time.perf_counter()
        matcher.match(cloud, prior)
        times.append(time.perf_counter() - begin)
    return 1e3 * np.array(times)


def speed(_: ProcessPoolExecutor) -> list[Row]:
    """In a process of its own, on two cores."""
    with ProcessPoolExecutor(1) as alone:
        return alone.submit(_speed).result()


def _speed() -> list[Row]:
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:2]))
    folder, rng = scratch(), np.random.default_rng(0)
    made = samples("case 1", 100, folder, 98)  # one a second, as in a run
    cv2.setNumThreads(2)
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    config = _config(made[0], False).model_copy(update={"window_m": 5.0, "window_deg": 5.0})

    def views(points: int) -> list[tuple[LevelCloud, Prior]]:
        return [(_thinned(together(s.clouds), points, rng), s.prior) for s in made]

    rows = []
    matcher = Matcher(config, folder, made[0].datum)
    whole = views(80_000)
    matcher.match(*whole[0])  # Numba compiles
    matcher = Matcher(config, folder, made[0].datum)
    times = _timed(matcher, whole)
    label = "80 000 points, window 5 m and 5 deg, two cores"
    rows.append(row("C.5", f"{label}: cloud to modes, median", np.median(times), "ms", 100.0, "<="))
    rows.append(row("C.5", f"{label}: cloud to modes, 95 %", np.quantile(times, 0.95), "ms", 200.0, "<="))
    rows.append(row("C.5", f"{label}: slowest, with a new part of the map", times.max(), "ms"))
    rows.append(row("C.5", f"{label}: matches of {len(times)} with a new part of the map", (times > 5.0 * np.median(times)).sum(), "count"))  # fmt: skip
    bl = BLMatcher(config, AerialImage(made[0].image, made[0].datum))
    theirs = _timed(bl, whole[:8])
    rows.append(row("C.5", f"{label}: BL's matcher, median", np.median(theirs), "ms"))
    rows.append(row("C.5", f"{label}: BL's matcher / ours", np.median(theirs) / np.median(times), "ratio"))
    for points in (20_000, 320_000):
        again = np.median(_timed(matcher, views(points)[:12]))
        rows.append(row("C.5", f"{points} points: median / that of 80 000", again / np.median(times), "ratio"))
    for change, said in (
        ({"window_m": 10.0}, "window 10 m"), ({"window_deg": 10.0}, "window 10 deg"),
        ({"reach_m": 50.0}, "map within 50 m"), ({"reach_m": 150.0}, "map within 150 m"),
    ):  # fmt: skip
        other = Matcher(config.model_copy(update=change), folder, made[0].datum)
        wide = [(c, Prior(p.pose, 2.0 * p.sigma)) for c, p in whole[:12]]
        rows.append(row("C.5", f"{said}: median / that of 5 m, 5 deg, 100 m", np.median(_timed(other, wide)) / np.median(times), "ratio"))  # fmt: skip
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    rows.append(row("C.5", "largest memory of the process, simulator included", peak, "GiB"))
    return rows
