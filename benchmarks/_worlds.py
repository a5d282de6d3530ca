# SPDX-License-Identifier: Apache-2.0
"""Harbours drawn by chance, for fitting: the shipped ones, which the figures are measured in, are not among them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from ruamel.yaml import YAML
from shapely import affinity

Block = dict[str, Any]


def write_world(seed: int, folder: Path) -> Path:
    """Write a harbour file with a route 'way' through it.

    Water between two to four quays that meet at any angle, piers with or without fingers, pontoons with rows of boats,
    houses; all turned together, since no harbour lies along the axes.
    """
    for attempt in range(50):
        rng = np.random.default_rng([seed, attempt, 23])
        harbour = _drawn(rng)
        way = _way(harbour, rng)
        if way is not None:
            path = folder / f"world_{seed}.yaml"
            harbour["routes"] = {"way": way}
            with path.open("w") as stream:
                YAML(typ="safe", pure=True).dump(harbour, stream)
            return path
    raise RuntimeError(f"no harbour of seed {seed} has a way through it")


def _drawn(rng: np.random.Generator) -> Block:
    width, height = rng.uniform(170.0, 300.0), rng.uniform(110.0, 200.0)
    turned = float(rng.uniform(-180.0, 180.0))
    blocks: dict[str, list[Block]] = {k: [] for k in ("quays", "buildings", "pontoons", "poles", "berths")}
    sides = rng.permutation(4)[: rng.integers(2, 5)]
    crowded = rng.uniform() < 0.35
    for side in sides:
        _bank(blocks, int(side), width, height, turned, crowded, rng)
    spread = np.array([(-0.7 * width, -0.7 * height), (0.7 * width, 0.7 * height)])
    corners = np.array(affinity.rotate(shapely.box(*spread.ravel()), turned, origin=(0, 0)).exterior.coords)
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    return {
        "name": "drawn",
        "datum": {
            "latitude_deg": round(float(rng.uniform(-60.0, 65.0)), 3),
            "longitude_deg": round(float(rng.uniform(-170.0, 170.0)), 3), "height_m": 20.0,
        },
        "image_m": [round(float(v), 1) for v in (west, south, east, north)],
        **blocks,
    }  # fmt: skip


def _bank(blocks: dict[str, list[Block]], side: int, width: float, height: float, turned: float, crowded: bool, rng: np.random.Generator) -> None:  # fmt: skip
    """One bank: x runs along it, y out over the water from its wall."""
    long, deep = (width, height) if side % 2 == 0 else (height, width)
    skew = float(rng.uniform(-12.0, 12.0))

    def placed(points: Any) -> list[list[float]]:
        p = np.array(points, dtype=float) - [0.0, 0.5 * deep]
        for angle in (skew, 90.0 * side, turned):
            c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            p = p @ np.array([[c, s], [-s, c]])
        return [[round(float(x), 2), round(float(y), 2)] for x, y in p]

    def box(x0: float, y0: float, x1: float, y1: float) -> list[list[float]]:
        return placed([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])

    heading = -(skew + 90.0 * side + turned)  # of something that points out over the water
    half, surfaces = 0.62 * long, ["concrete", "asphalt", "stone", "grass"]
    # A wall with steps and notches.
    wall, x, y = [(-half, 0.0)], -half, 0.0
    while x < half - 30.0:
        x = min(half, x + rng.uniform(20.0, 90.0))
        wall.append((x, y))
        y = float(np.clip(y + rng.choice([0.0, 0.0, -1.0, 1.0]) * rng.uniform(3.0, 14.0), -15.0, 8.0))
        if wall[-1] != (x, y):
            wall.append((x, y))
    top = float(rng.uniform(1.0, 2.8))
    outline = placed([*wall, (half, -45.0), (-half, -45.0)])
    blocks["quays"].append({"outline": outline, "top_m": top, "surface": str(rng.choice(surfaces))})
    for k in range(rng.integers(0, 4)):
        x0 = -0.5 * long + (k + rng.uniform(0.1, 0.5)) * long / 4.0
        w, d = rng.uniform(10.0, 30.0), rng.uniform(8.0, 16.0)
        blocks["buildings"].append({"outline": box(x0, -18.0 - d, x0 + w, -18.0), "top_m": float(rng.uniform(4, 11)), "surface": "roof"})  # fmt: skip
    kind = "pontoons" if crowded and side % 2 == 0 else rng.choice(["bare", "piers", "piers", "pontoons"])
    if kind == "piers":
        _piers(blocks, box, placed, long, deep, heading, rng)
    elif kind == "pontoons":
        _rows(blocks, box, placed, long, heading, rng, most=3 if crowded else 2)


def _piers(blocks: dict[str, list[Block]], box: Any, placed: Any, long: float, deep: float, heading: float, rng: np.random.Generator) -> None:  # fmt: skip
    for k in range(rng.integers(1, 4)):
        x, w, out = (
            -0.4 * long + (k + rng.uniform(0.0, 0.6)) * 0.27 * long,
            rng.uniform(2.0, 7.0),
            rng.uniform(15, 0.45 * deep),
        )
        blocks["quays"].append({"outline": box(x, -1.0, x + w, out), "top_m": float(rng.uniform(1.0, 2.2)), "surface": str(rng.choice(["concrete", "wood", "stone"]))})  # fmt: skip
        if rng.uniform() < 0.6:
            step = float(rng.uniform(8.0, 13.0))
            length = float(rng.uniform(6.0, 11.0))
            for s, base in ((1.0, x + w), (-1.0, x)):
                for y in np.arange(8.0, out - 2.0, step):
                    blocks["pontoons"].append({"outline": box(*sorted((base, base + s * length))[:1], y, *sorted((base, base + s * length))[1:], y + 0.9), "top_m": 0.5, "surface": "wood"})  # fmt: skip
                    (at,) = placed([(base + s * (0.5 * length + 0.5), y + 0.9 + 0.25 * step)])
                    blocks["berths"].append(
                        {"at": at, "heading_deg": heading + 90.0 * s, "length_m": length * 0.95, "occupied": 0.7}
                    )
                    (at,) = placed([(base + s * (length + 1.5), y + 0.4)])
                    if rng.uniform() < 0.5:
                        blocks["poles"].append({"at": at, "top_m": 2.5})


def _rows(blocks: dict[str, list[Block]], box: Any, placed: Any, long: float, heading: float, rng: np.random.Generator, most: int) -> None:  # fmt: skip
    """Pontoons along the bank with boats on both sides, as in a crowded marina."""
    for k in range(rng.integers(max(1, most - 1), most + 1)):
        y, half = 16.0 + 44.0 * k + rng.uniform(0.0, 6.0), rng.uniform(0.25, 0.42) * long
        blocks["pontoons"].append({"outline": box(-half, y, half, y + 2.4), "top_m": 0.5, "surface": "wood"})
        if rng.uniform() < 0.5:
            for x in np.arange(-half + 2.0, half, rng.uniform(9.0, 15.0)):
                blocks["pontoons"].append({"outline": box(x, y + 2.4, x + 0.8, y + 11.0), "top_m": 0.45, "surface": "wood"})  # fmt: skip
        for s, base in ((1.0, y + 2.4), (-1.0, y)):
            step, length, occupied = rng.uniform(4.0, 6.5), rng.uniform(8.0, 12.0), rng.uniform(0.5, 0.95)
            if rng.uniform() < 0.2:
                continue
            for x in np.arange(-half + 3.0, half - 2.0, step):
                (at,) = placed([(x, base + s * (0.5 * length + 0.8))])
                blocks["berths"].append(
                    {"at": at, "heading_deg": heading, "length_m": float(length), "occupied": float(occupied)}
                )
            if rng.uniform() < 0.5:
                for x in np.arange(-half + 3.0 + 0.5 * step, half, 2.0 * step):
                    (at,) = placed([(x, base + s * (length + 2.0))])
                    blocks["poles"].append({"at": at, "top_m": 2.2})


def _way(harbour: Block, rng: np.random.Generator) -> list[list[float]] | None:
    """Three waypoints through water that is 10 m from everything, at least 60 m long, near to something."""
    solids = [shapely.Polygon(b["outline"]) for kind in ("quays", "pontoons") for b in harbour[kind]]
    if not all(p.is_valid for p in solids):
        return None
    solids += [shapely.Point(b["at"]).buffer(0.6 * b["length_m"]) for b in harbour["berths"]]
    land = shapely.union_all(solids)
    west, south, east, north = harbour["image_m"]
    middle = shapely.box(west, south, east, north).centroid
    for _ in range(400):
        a, b = np.array([middle.x, middle.y]) + rng.uniform(-0.4, 0.4, (2, 2)) * [east - west, north - south]
        c = 0.5 * (a + b) + rng.normal(0.0, 6.0, 2)
        away = shapely.LineString([a, c, b]).distance(land)
        if 60.0 < np.hypot(*(b - a)) < 140.0 and 10.0 < away < 40.0:
            return [[round(float(v), 2) for v in p] for p in (a, c, b)]
    return None
