# SPDX-License-Identifier: Apache-2.0
"""Bags drawn by chance through the user's path: inspect, its draft as it stands, smooth, replay; against the truth (A.drawn).

`python benchmarks/drawn_bags.py 700 710` measures the bags of these seeds. The oddities of `odd.py` come one at a time there, here as they fall:
axes, units, clocks, rates, claims, drift, outages, jumps. Nothing may be tuned on the seeds of `SEEDS`.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from _odd_bags import Change, Craft, Item, Odd, stamp
from _rows import Row, row
from odd import Found, no_covariance, off, restamped, velocity_of_receiver, walked
from scipy.spatial.transform import Rotation

from graphloc.frames import Array

SEEDS = range(1300, 1348)
_HONEST = 0.8  # share of the time inside the 95 % bounds, at the least
# Fixes: white and slow error, each horizontal axis, m; what they claim, m; status of NavSatFix.
_RECEIVERS = {
    "rtk": (0.01, 0.01, 0.014, 2),
    "float": (0.1, 0.25, 0.3, 2),
    "sbas": (0.25, 0.6, 0.8, 1),
    "sps": (0.4, 1.5, 1.8, 0),
}


@dataclass(slots=True)
class _Drawn:
    """A bag as it is drawn: its settings, what else is done to its messages, in order, and all that in words."""

    odd: Odd
    words: list[str]
    changes: list[Change] = field(default_factory=list)

    def whole(self, craft: Craft, items: list[Item]) -> list[Item]:
        for change in self.changes:
            items = change(craft, items)
        return items


def drawn_bag(seed: int) -> tuple[Odd, str]:
    """Draw a bag; return it and what it is, in words."""
    rng = np.random.default_rng([seed, 43])
    receiver = str(rng.choice([*_RECEIVERS], p=[0.35, 0.15, 0.15, 0.35]))
    sigma_m, slow_m, claims, status = _RECEIVERS[receiver]
    found = _Drawn(
        odd=Odd(
            craft=str(rng.choice(["car", "robot", "boat", "ferry"])), seed=seed, seconds=float(rng.uniform(80.0, 150.0)),
            kind=str(rng.choice(["mcap", "sqlite3", "ros1"])), imu_hz=float(rng.choice([50.0, 100.0, 200.0])),
            gnss_hz=float(rng.choice([1.0, 2.0, 5.0, 10.0])), sigma_m=sigma_m, slow_m=slow_m, claims=claims, status=status,
            antenna_m=tuple(rng.uniform([-1.5, -0.6, 0.3], [1.5, 0.6, 2.0]).tolist()), tf=bool(rng.uniform() < 0.35),
            compass=bool(rng.uniform() < 0.4),
        ),
        words=[],
    )  # fmt: skip
    found.words += [found.odd.craft, f"{receiver} {found.odd.gnss_hz:g} Hz", "compass" if found.odd.compass else ""]
    if found.odd.tf:  # else body is where the IMU is
        found.odd = replace(found.odd, imu_m=tuple(rng.uniform(-0.5, 0.5, 3).tolist()))
        found.words.append("tf")
    _draw_imu(found, rng)
    _draw_clocks(found, rng)
    _draw_faults(found, rng)
    return replace(found.odd, change=found.whole), ", ".join(word for word in found.words if word)


def _draw_imu(found: _Drawn, rng: np.random.Generator) -> None:
    """Axes in quarter turns, some degrees askew at times; units."""
    if rng.uniform() < 0.5:
        quarters = rng.integers(0, 4, 3) * 90.0
        level = quarters if rng.uniform() < 0.3 else quarters * [2.0, 0.0, 1.0]
        askew = rng.normal(0.0, [2.0, 2.0, 1.0]) if rng.uniform() < 0.3 else np.zeros(3)  # in body: yaw is hardly told
        turned = Rotation.from_euler("xyz", askew, degrees=True) * Rotation.from_euler("xyz", level, degrees=True)
        angles = turned.as_euler(
            "xyz", degrees=True, suppress_warnings=True
        )  # of gimbal lock: any of the angles will do
        found.odd = replace(found.odd, imu_rpy_deg=tuple(angles.tolist()))
        found.words.append(f"IMU at {np.round(angles).astype(int).tolist()}")
    if rng.uniform() < 0.15:
        found.odd = replace(found.odd, accel=lambda a: a / 9.80665, gyro=np.degrees)
        found.words.append("g and deg/s")


def _draw_clocks(found: _Drawn, rng: np.random.Generator) -> None:
    if rng.uniform() < 0.4:
        late_s = float(rng.uniform(0.05, 0.4))
        found.odd = replace(found.odd, late_s=late_s)
        found.words.append(f"fixes {late_s:.2f} s late")
    if rng.uniform() < 0.25:
        boot_ns = int(rng.uniform(5.0, 5000.0) * 1e9) - stamp(0.0)
        found.changes.append(restamped(lambda _, ns: ns + boot_ns))
        found.words.append("IMU from boot")


def _draw_faults(found: _Drawn, rng: np.random.Generator) -> None:
    middle_s = found.odd.seconds / 2.0
    if rng.uniform() < 0.3:
        found.changes.append(velocity_of_receiver)
        found.words.append("velocity")
    if rng.uniform() < 0.25:
        found.changes.append(no_covariance)
        found.words.append("no covariance")
    if rng.uniform() < 0.25:
        lasts_s = float(rng.uniform(5.0, 25.0))
        found.changes.append(_silent(middle_s, middle_s + lasts_s))
        found.words.append(f"no fix for {lasts_s:.0f} s")
    elif rng.uniform() < 0.3:
        size_m = float(rng.uniform(2.0, 15.0))
        found.changes.append(off(size_m, middle_s, middle_s + float(rng.uniform(5.0, 20.0))))
        found.words.append(f"off by {size_m:.0f} m")


def _silent(begin_s: float, end_s: float) -> Change:
    """No fixes, nor velocities of the receiver."""

    def change(_craft: Craft, items: list[Item]) -> list[Item]:
        gone = {"/gnss/fix", "/gnss/vel"}
        return [item for item in items if item[0] not in gone or not stamp(begin_s) < item[1] < stamp(end_s)]

    return change


def measured(seed: int) -> Found:
    odd, words = drawn_bag(seed)
    return walked(Found(name=f"{seed} {words}"), odd)


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    found = list(pool.map(measured, SEEDS))
    print("\n".join(f.line() for f in found))
    label = f"{len(found)} bags drawn by chance, as drafted"
    betrayed = sum(f.trusted and f.offline is not None and (f.offline.coverage_95 or 0.0) < _HONEST for f in found)
    rows = [
        row("A.drawn", f"{label}: tracebacks", sum(f.crashed for f in found), "bags", 0, "<="),
        row("A.drawn", f"{label}: no track, offline or online", sum(f.online is None for f in found), "bags", 0, "<="),
        row("A.drawn", f"{label}: trusted, though inside the 95 % bounds less than 80 % of the time", betrayed, "bags", 0, "<="),
    ]  # fmt: skip
    for way in ("offline", "online"):
        tracks = [m for f in found if (m := getattr(f, way)) is not None]
        inside = np.array([m.coverage_95 or 0.0 for m in tracks])
        errors: Array = np.array([m.position_rmse_m for m in tracks])
        rows += [
            row("A.drawn", f"{label}, {way}: inside the 95 % bounds, mean", 100.0 * float(inside.mean()), "%", 90.0, ">="),
            row("A.drawn", f"{label}, {way}: inside less than 80 % of the time", int((inside < _HONEST).sum()), "bags"),
            row("A.drawn", f"{label}, {way}: position RMSE, median", float(np.median(errors)), "m"),
            row("A.drawn", f"{label}, {way}: position RMSE, mean", float(errors.mean()), "m"),
        ]  # fmt: skip
    return rows


def main() -> None:
    for seed in range(*map(int, sys.argv[1:3])):
        print(measured(seed).line(), flush=True)


if __name__ == "__main__":
    main()
