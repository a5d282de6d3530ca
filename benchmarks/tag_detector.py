# SPDX-License-Identifier: Apache-2.0
"""Figures of the tag detector: its cost, its agreement with AprilTag 3, and what each of its steps buys."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, TypeVar
from unittest.mock import patch

import cv2
import numpy as np
from _rows import Row, row
from scipy.stats import chi2
from simulator import BANDS_M, DIGERUD, _detector

from graphloc.eval.simulate import harbour_scenarios, simulate
from graphloc.eval.simulate.camera import Camera
from graphloc.eval.simulate.scene import scene_of
from graphloc.frontends.tags import _edges, _quads, detect
from graphloc.frontends.tags.detect import Detector

_HALF_M = 0.206
_CORNERS = _HALF_M * np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)])
_CONDITIONS = tuple(DIGERUD)
_FAR_M = (12.0, 30.0)
_Found = TypeVar("_Found")


class View(NamedTuple):
    """An image, and the true corners (4, 2), px, and range, m, of each tag that is wholly in it."""

    pixels: Any
    tags: dict[int, tuple[Any, float]]
    present: set[int]


def views(condition: str, seed: int, times: Any) -> Iterator[View]:
    run = simulate(harbour_scenarios()[f"dock-fixed-{condition}"], seed)
    config = run.rig.cameras["camera"]
    camera = Camera("camera", scene_of(run), run)
    for k, t in enumerate(times):
        tags = {}
        poses = camera.tag_poses(float(t))
        for number, (p, R) in poses.items():
            flat = (p + _CORNERS @ R.T) @ config.K.T
            at = flat[:, :2] / flat[:, 2:]
            inside = at.min() > 10 and (at < (config.width_px - 10, config.height_px - 10)).all()
            if number <= 228 and p[2] > 1.0 and inside:
                tags[number] = (at, float(np.linalg.norm(p)))
        yield View(camera.take(float(t), k).pixels, tags, set(poses))


def _on_sides(_grey: Any, about_px: Any, _cells: Any, _straight: Any) -> Any:
    return _edges.TagFit(about_px, np.eye(8), 1.0)


# A step is switched off by what stands in for it.
_OFF: dict[str, tuple[tuple[Any, str, Any], ...]] = {
    "all steps": (),
    "no tone curve": ((_quads, "_TONE", np.arange(256, dtype=np.uint8)),),
    "no threshold by the image's noise": ((_quads, "_MOST_NOISE", 4),),
    "no half resolution": ((detect, "parts_of", lambda grey: _PARTS(grey)[1:]),),
    "half resolution only": ((detect, "parts_of", lambda grey: _PARTS(grey)[:1]),),
    "no bits to spare before the fit": ((detect, "_MORE_BITS", 0),),
    "no fit of the whole tag": ((detect, "fit_tag", _on_sides),),
}
_PARTS: Callable[[Any], Any] = detect.parts_of


@contextmanager
def _without(step: str) -> Iterator[None]:
    with ExitStack() as stack:
        for module, name, instead in _OFF[step]:
            stack.enter_context(patch.object(module, name, instead))
        yield


class Gain(NamedTuple):
    """Whether each far tag is seen; rms error of the corners of each that is; false detections and time by image."""

    seen: list[bool]
    off_px: list[float]
    false: list[int]
    took_ms: list[float]


def _step_job(job: tuple[str, int]) -> dict[str, Gain]:
    condition, seed = job
    cv2.setNumThreads(1)
    found: dict[str, Gain] = {step: Gain([], [], [], []) for step in _OFF}
    for view in views(condition, seed, np.arange(16.0, 100.0, 3.0)):
        for step in _OFF:
            detector, gain = Detector(), found[step]
            with _without(step):
                begin = time.perf_counter()
                detections = detector.detect(view.pixels)
                gain.took_ms.append(1e3 * (time.perf_counter() - begin))
            by_number = {d.number: d.corners_px for d in detections}
            for number, (at, away) in view.tags.items():
                if _FAR_M[0] <= away < _FAR_M[1]:
                    gain.seen.append(number in by_number)
                if number in by_number:
                    gain.off_px.append(float(np.sqrt(np.mean((by_number[number] - at) ** 2))))
            gain.false.append(sum(d.number not in view.present for d in detections))
    return found


def steps(pool: ProcessPoolExecutor, seeds: int = 2) -> list[Row]:
    """D.0: what each step buys."""
    rows = []
    for condition, parts in _by_condition(pool, _step_job, range(200, 200 + seeds)):
        for step in _OFF:
            seen = [s for part in parts for s in part[step].seen]
            off = [o for part in parts for o in part[step].off_px]
            label = f"tag detector, {condition}, {step}"
            far = f"{_FAR_M[0]:g}-{_FAR_M[1]:g} m"
            rows.append(row("D.0", f"{label}: seen at {far}", np.mean(seen), "share"))
            rows.append(row("D.0", f"{label}: false detections", sum(sum(part[step].false) for part in parts), "count"))
            took = np.median([ms for part in parts for ms in part[step].took_ms])
            rows.append(row("D.0", f"{label}: time, with others at work", took, "ms"))
            if off:
                rows.append(row("D.0", f"{label}: corners off, median", np.median(off), "px"))
    return rows + _honesty(pool, seeds) + _strangers(pool)


def _by_condition(
    pool: ProcessPoolExecutor, job: Callable[[tuple[str, int]], _Found], seeds: range
) -> Iterator[tuple[str, list[_Found]]]:
    """What a job finds on each seed, by condition; all of them are under way at once."""
    under_way = [(condition, [pool.submit(job, (condition, seed)) for seed in seeds]) for condition in _CONDITIONS]
    for condition, futures in under_way:
        yield condition, [future.result() for future in futures]


def _honest_job(job: tuple[str, int]) -> list[tuple[float, float]]:
    condition, seed = job
    cv2.setNumThreads(1)
    found = []
    for view in views(condition, seed, np.arange(16.0, 100.0, 1.0)):
        for d in Detector().detect(view.pixels):
            if d.number in view.tags:
                at, away = view.tags[d.number]
                off = (d.corners_px - at).ravel()
                found.append((away, float(off @ np.linalg.solve(d.cov_px2, off))))
    return found


def _honesty(pool: ProcessPoolExecutor, seeds: int) -> list[Row]:
    """Squared errors of the 8 corner coordinates by their covariance, by range."""
    rows = []
    for condition, parts in _by_condition(pool, _honest_job, range(210, 210 + seeds)):
        found = np.array([pair for part in parts for pair in part]).reshape(-1, 2)
        for low, high in itertools.pairwise(BANDS_M):
            nees = found[(found[:, 0] >= low) & (found[:, 0] < high), 1]
            if len(nees) >= 5:
                label = f"tag detector, {condition}, {low:g}-{high:g} m: corner errors by their covariance"
                rows.append(row("D.0", f"{label}, mean over 8", nees.mean() / 8.0, "ratio"))
                rows.append(row("D.0", f"{label}, inside 95 %", np.mean(nees < chi2.ppf(0.95, 8)), "share"))
    return rows


_LOOKED_FOR = {"36h11": 1, "36h10": 1, "25h9": 1, "16h5": 0}  # bits that may be wrong


def _stranger_job(job: tuple[str, int]) -> tuple[int, dict[str, int]]:
    """Images, and detections of tags that are not in them, by family."""
    condition, seed = job
    cv2.setNumThreads(1)
    images, false = 0, dict.fromkeys(_LOOKED_FOR, 0)
    looking = {family: Detector((family,), max_hamming=bits) for family, bits in _LOOKED_FOR.items()}
    for view in views(condition, seed, np.arange(1.0, 100.0, 3.0)):
        images += 1
        for family, detector in looking.items():
            for d in detector.detect(view.pixels):
                false[family] += family != "36h11" or d.number not in view.present
    return images, false


def _strangers(pool: ProcessPoolExecutor) -> list[Row]:
    parts = list(pool.map(_stranger_job, [(condition, 220 + k) for condition in _CONDITIONS for k in range(2)]))
    images = sum(part[0] for part in parts)
    return [
        row("D.0", f"tag detector, {family}, {bits} bits corrected, {images} images: false detections in 1000",
            1000.0 * sum(part[1][family] for part in parts) / images, "count")
        for family, bits in _LOOKED_FOR.items()
    ]  # fmt: skip


def cost(_pool: ProcessPoolExecutor) -> list[Row]:
    """D.6: time per 2208 x 1242 image on two cores, in a process of its own; AprilTag 3 in the same run."""
    found = subprocess.run([sys.executable, __file__], check=True, capture_output=True, text=True).stdout
    rows = []
    for line in found.splitlines():
        label, middle, late, kept = line.split("\t")
        ours = label.startswith("tag detector")
        rows.append(row("D.6", f"{label}: median", float(middle), "ms", *((66.0, "<=") if ours else ())))
        rows.append(row("D.6", f"{label}: 95 %", float(late), "ms"))
        rows.append(row("D.6", f"{label}: frames kept at 15 Hz", float(kept), "share"))
    return rows


def _timed() -> None:
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:2]))
    cv2.setNumThreads(2)
    from pupil_apriltags import Detector as AprilTag3

    full, coarse = (AprilTag3(families="tag36h11", nthreads=2, quad_decimate=d) for d in (1.0, 2.0))
    ways = {"tag detector": Detector().detect, "AprilTag 3, full": full.detect, "AprilTag 3, defaults": coarse.detect}
    for condition in _CONDITIONS:
        images = [view.pixels for view in views(condition, 230, np.arange(16.0, 100.0, 2.0))]
        for way, look in ways.items():
            look(images[0])
            took = np.empty(len(images))
            for k, image in enumerate(images):
                begin = time.perf_counter()
                look(image)
                took[k] = time.perf_counter() - begin
            middle, late = 1e3 * np.quantile(took, [0.5, 0.95])
            print(f"{way}, {condition}\t{middle}\t{late}\t{_kept(took)}")
    for detector in (full, coarse):
        detector.tag_detector_ptr = None  # its destructor frees the families twice


def _kept(took_s: Any) -> float:
    """Share of the frames that are looked at: one that arrives while another is in hand waits, and is replaced by the next."""
    period = 1.0 / 15.0
    free = kept = 0.0
    for k, took in enumerate(took_s):
        arrives = k * period
        if free > arrives + period:
            continue  # the next one is there before this one's turn
        free = max(free, arrives) + took
        kept += 1
    return float(kept / len(took_s))


def _agreement_job(job: tuple[str, int]) -> tuple[int, int, int, list[float], list[int]]:
    """Tags found by both, by ours only, by theirs only; distances of corners, px; turns of the tag's frame."""
    condition, seed = job
    cv2.setNumThreads(1)
    both = ours_only = theirs_only = 0
    apart, turns = [], []
    for view in views(condition, seed, np.arange(16.0, 100.0, 1.0)):
        ours = {d.number: d.corners_px for d in Detector().detect(view.pixels)}
        theirs = {d.tag_id: d.corners[::-1] - 0.5 for d in _detector(1.0).detect(view.pixels) if d.hamming <= 1}
        both += len(ours.keys() & theirs.keys())
        ours_only += len(ours.keys() - theirs.keys())
        theirs_only += len(theirs.keys() - ours.keys())
        for number in ours.keys() & theirs.keys():
            off = [np.linalg.norm(np.roll(ours[number], k, axis=0) - theirs[number], axis=1) for k in range(4)]
            turns.append(int(np.argmin([o.sum() for o in off])))
            apart += off[0].tolist()
    return both, ours_only, theirs_only, apart, turns


def agreement(pool: ProcessPoolExecutor, seeds: int = 2) -> list[Row]:
    """D.7: beside AprilTag 3 on every pixel, on the image as it comes."""
    rows = []
    for condition, parts in _by_condition(pool, _agreement_job, range(240, 240 + seeds)):
        label = f"tag detector beside AprilTag 3, {condition}"
        for k, name in enumerate(("found by both", "by ours only", "by theirs only")):
            rows.append(row("D.7", f"{label}: {name}", sum(part[k] for part in parts), "count"))  # type: ignore[misc]
        apart = [d for part in parts for d in part[3]]
        if apart:
            rows.append(row("D.7", f"{label}: corners apart, median", np.median(apart), "px"))
            rows.append(row("D.7", f"{label}: corners apart, 95 %", np.quantile(apart, 0.95), "px"))
            turned = sum(turn != 0 for part in parts for turn in part[4])
            rows.append(row("D.7", f"{label}: tag frames turned", turned, "count", 0.0, "<="))
    return rows


if __name__ == "__main__":
    _timed()
