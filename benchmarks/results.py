# SPDX-License-Identifier: Apache-2.0
"""Measure the figures of docs/results.json and render docs/results.md.

`python benchmarks/results.py` runs all; `--only A.3,A.6` runs some and keeps the other rows. A figure
that misses its bound stays in, marked.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib.metadata import version
from typing import Any

import batch
import calibration
import dead_reckoning
import docking
import drawn
import drawn_bags
import drills
import erring
import fuzz
import harbours
import matcher
import odd
import online
import online_faults
import simulator
import single_tags
import slow_filter
import smoothing
import soak
import sweep
import tag_detector
import where
from _rows import ROOT, Row

FIGURES: dict[str, Callable[[ProcessPoolExecutor], list[Row]]] = {
    "A.1": smoothing.husky,
    "A.2": smoothing.kitti,
    "A.3": smoothing.bl_cases,
    "A.4": smoothing.starts,
    "A.5": smoothing.outages,
    "A.6": smoothing.speed,
    "A.dev": erring.compass,
    "A.drawn": drawn_bags.figures,
    "A.odd": odd.figures,
    "B.1": simulator.signals,
    "B.2": simulator.overlays,
    "B.3": simulator.tags,
    "B.4": simulator.making,
    "C.1": matcher.success,
    "C.2": matcher.accuracy,
    "C.3": matcher.honesty,
    "C.4": matcher.runs,
    "C.5": matcher.speed,
    "C.drawn": harbours.figures,
    "D.0": tag_detector.steps,
    "D.1": docking.docking,
    "D.4": single_tags.figures,
    "D.6": tag_detector.cost,
    "D.7": tag_detector.agreement,
    "E.1": online.cases,
    "E.2": online.latency,
    "E.3": online.starts,
    "E.4": online.shuffled,
    "E.5": online_faults.faults,
    "E.6": online.odometry,
    "E.day": soak.day,
    "E.dark": dead_reckoning.figures,
    "E.ekf": slow_filter.figures,
    "E.imu": erring.wrong_imu,
    "E.iron": erring.compass_beside_iron,
    "E.warm": erring.warming_imu,
    "F.3": batch.figures,
    "F.3p": where.figures,
    "F.4": fuzz.figures,
    "F.5": drills.both,
    "F.6": sweep.workers,
    "F.cal": calibration.figures,
    "F.drawn": drawn.figures,
    **{item: partial(drawn.varied, item) for item in drawn.VARIED},
}


def tag_table(figures: list[Row]) -> list[str]:
    """B.3's rows as a table: range against condition."""
    values = {f["name"]: f["value"] for f in figures if f["item"] == "B.3"}
    if not values:
        return []
    bands = [f"{low:g}-{high:g} m" for low, high in itertools.pairwise(simulator.BANDS_M)]
    lines = [
        "",
        "## Tags: seen, flipped, and off, by range and condition (B.3)",
        "",
        "Share of views in which a 0.412 m tag is found / share of these whose better-fitting pose is the flipped one /",
        "95 % error of the other pose, m. Simulated approaches to a quay, each tag on its own, poses by IPPE. Detector:",
        "AprilTag 3, with its *defaults* on the image as it comes (as Digerud), or *full*: every pixel, in linear light.",
        "Digerud's columns are his table 4.13; he counts no flips.",
        "",
        "| condition | detector | " + " | ".join(bands) + " | farthest | D: farthest | D: flips |",
        "|---|---|" + "---|" * (len(bands) + 3),
    ]
    for condition, (range_said, flips_said) in simulator.DIGERUD.items():
        for way in simulator.WAYS:
            label, cells = f"tags, {condition}, {way}", []
            for band in bands:
                seen, flipped, off = (
                    values.get(f"{label}, {band}: {what}")
                    for what in ("seen", "flipped", "error of the right pose, 95 %")
                )
                cells.append(f"{seen:.2f} / {flipped:.2f} / {off:.2f}" if off is not None else "-")
            farthest = values[f"{label}: farthest sighting"]
            said = f"{farthest:.0f} m" if farthest else "none"
            lines.append(f"| {condition} | {way} | " + " | ".join([*cells, said, range_said, flips_said]) + " |")
    return lines


def misses(figure: Row) -> bool:
    if figure["bound"] is None:
        return False
    return bool(figure["value"] > figure["bound"] if figure["direction"] == "<=" else figure["value"] < figure["bound"])


def said_bound(figure: Row) -> str:
    return "" if figure["bound"] is None else f"{figure['direction']} {figure['bound']:g}"


def missed(figures: list[Row]) -> list[str]:
    """How many targets are met, and those that are missed."""
    bound = [f for f in figures if f["bound"] is not None]
    out = [f for f in bound if misses(f)]
    lines = ["## Missed targets", "", f"{len(bound) - len(out)} of {len(bound)} targets are met; these are missed:", ""]
    lines += ["| item | figure | value | unit | target | commit |", "|---|---|---|---|---|---|"]
    for f in out:
        lines.append(f"| {f['item']} | {f['name']} | {f['value']:g} | {f['unit']} | {said_bound(f)} | {f['commit']} |")
    return [*lines, ""]


def render(results: dict[str, Any]) -> str:
    machine = results["machine"]
    lines = [
        "# Results",
        "",
        "Made by `make results` (some twelve hours of one core; `--only A.1,B.2` takes items; D.1 makes D.2, D.3 and D.5, too; A.1 needs",
        "the Husky bag in `../shared/data/husky`). The numbers are in `results.json`. A figure that misses its target is marked **misses**.",
        "",
        "| items | about |",
        "|---|---|",
        "| A | offline smoothing: real recordings, cases of BL, bad starts, outages, speed, compass deviation, odd bags |",
        "| B | the simulator |",
        "| C | LiDAR scans matched to an aerial image ([aerial](aerial.md)) |",
        "| D | AprilTags: detector, docking ([tags](tags.md)) |",
        "| E | the online mode ([online](online.md)) |",
        "| F | speed and memory, fuzzing, drills, sweeps, calibration, randomly drawn vessels ([benchmarks](benchmarks.md)) |",
        "",
        "'BL' is the thesis of Bergman & Lindell. Its cases: 1 harbour entry, 2 sharp turn, 3 standing still. Its EKF is alg. 6 with the",
        "2 m gate; '(told)': it is informed of each signal loss, as by hand in the thesis. The honest EKF is `eval/ekf/`, tuned on other",
        "seeds. A `+` after a commit: measured with uncommitted changes.",
        "",
        f"Machine: {machine['cores']} cores, Python {machine['python']}, GTSAM {machine['gtsam']}.",
        "",
        *missed(results["figures"]),
        "## All figures",
        "",
        "| item | figure | value | unit | target | | commit |",
        "|---|---|---|---|---|---|---|",
    ]
    for f in results["figures"]:
        bound = said_bound(f)
        mark = "" if f["bound"] is None else "**misses**" if misses(f) else "ok"
        if f["item"] == "B.3" and f["bound"] is None:
            continue  # in the table below
        lines.append(f"| {f['item']} | {f['name']} | {f['value']:g} | {f['unit']} | {bound} | {mark} | {f['commit']} |")
    return "\n".join([*lines, *tag_table(results["figures"])]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--only", default=",".join(FIGURES), help="items, separated by commas")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 2)
    arguments = parser.parse_args()
    path = ROOT / "docs/results.json"
    results = json.loads(path.read_text()) if path.exists() else {"figures": []}
    results["machine"] = {"cores": os.cpu_count(), "python": platform.python_version(), "gtsam": version("gtsam")}
    for item in arguments.only.split(","):
        with ProcessPoolExecutor(arguments.jobs) as pool:
            rows = FIGURES[item](pool)
        made = {item, *(r["item"] for r in rows)}
        results["figures"] = [f for f in results["figures"] if f["item"] not in made] + rows
        results["figures"].sort(key=lambda f: f["item"])
        path.write_text(json.dumps(results, indent=1) + "\n")
        (ROOT / "docs/results.md").write_text(render(results))
        for figure in rows:
            print(figure["item"], figure["name"], figure["value"], figure["unit"], "MISSES" if misses(figure) else "")


if __name__ == "__main__":
    main()
