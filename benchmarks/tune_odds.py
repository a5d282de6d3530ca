# SPDX-License-Identifier: Apache-2.0
"""Fit how far a match is to be believed, on runs through harbours that no item of docs/results.md uses.

The scans of each are matched alone, and together with others, around its track without matches; so with all that a run has: a
tide, boats that have moved, GNSS that bends the track. Prints what stands in `frontends/aerial/matcher.py` as `Belief`, and how
often claims come true.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from harbours import recorded, with_matches
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from graphloc import app
from graphloc.frontends.aerial import match_bag
from graphloc.frontends.aerial.matcher import BELIEF

_SEEDS = range(301, 331)
_TOGETHER_S = 15.0
_NEAR_M = 1.0  # nearer modes are right
_BANDS = (0.0, 20.0, 40.0, 60.0, 90.0, 130.0, 200.0, np.inf)

Values = NDArray[np.float64]


class _Seen(NamedTuple):
    """A match: its evidence, of the scan itself and of all turns, and the probability of each mode without `Belief`; and which are right."""

    harbour: int
    own: float
    evidence: float
    turns: int
    told: Values
    right: NDArray[np.bool_]


def _of_harbour(seed: int) -> list[_Seen]:
    with tempfile.TemporaryDirectory() as scratch_:
        folder, recording, config, shown = recorded(seed, Path(scratch_))
        track = app.smooth_recording(recording, with_matches(config)).solution.trajectory
        datum = app.choose_datum(recording, config)
        found = []
        for submap_s in (0.0, _TOGETHER_S):
            sensor = with_matches(config, submap_s).of_kind("aerial")["aerial"]
            for item in match_bag([folder / "run"], sensor, folder, config.body_frame, track, datum):
                at = np.array([item.stamp_ns])
                if item.match is None or not item.match.modes or not shown.covers(at).all():
                    continue
                if submap_s > 0.0 and item.match.found.turns == 1:
                    continue  # nothing to be matched with: it is there already
                told = np.array([m.probability for m in item.match.modes])
                odds = told ** (1.0 / BELIEF.decided)
                whole = told.sum() / BELIEF.share(item.match.found)
                off_m = np.array([m.pose[:2] for m in item.match.modes]) - shown.at(at).p_world_m[0, :2]
                seen = item.match.found
                own = seen.own.evidence if seen.own else seen.evidence
                right = np.hypot(*off_m.T) < _NEAR_M
                found.append(_Seen(seed, own, seen.evidence, seen.turns, odds * whole / odds.sum(), right))
        return found


def _weights(seen: list[_Seen]) -> Values:
    """One for each harbour, alone and together, shared by its matches."""
    group = [(s.harbour, s.turns > 1) for s in seen]
    return np.array([1.0 / group.count(g) for g in group]) / len(set(group))


def _fit_share(seen: list[_Seen]) -> tuple[Values, float, float]:
    """`enough`, `power` and `alike`; the mean negative log-likelihood with them, and without."""
    own, evidence, turns = (np.array([s[k] for s in seen], dtype=float) for k in (1, 2, 3))
    whole, some = np.array([s.told.sum() for s in seen]), np.array([s.right.any() for s in seen])
    weight = _weights(seen)

    def miss(share: Values | float) -> float:
        p = np.clip(whole * share, 1e-3, 1.0 - 1e-3)
        return -float((weight * np.log(np.where(some, p, 1.0 - p))).sum())

    def shares(z: Values) -> Values:
        return np.asarray(expit(z[1] * (np.log(np.maximum(own, evidence / turns ** z[2])) - z[0])))

    z = minimize(lambda z: miss(shares(z)), np.array([3.0, 2.0, 0.3]), method="Nelder-Mead").x
    return np.array([np.exp(z[0]), z[1], z[2]]), miss(shares(z)), miss(1.0)


def _fit_decided(seen: list[_Seen]) -> tuple[float, float, float]:
    """`decided`; the mean negative log-likelihood of the right one of several modes with it, and without."""
    several = [s for s in seen if s.right.any() and len(s.told) > 1]
    weight = _weights(several)

    def miss(decided: float) -> float:
        odds = [s.told**decided for s in several]
        return -float(weight @ [np.log(o[s.right].sum() / o.sum()) for o, s in zip(odds, several, strict=True)])

    tried = np.arange(0.0, 1.5, 0.05)
    best = float(tried[np.argmin([miss(float(d)) for d in tried])])
    return best, miss(best), miss(1.0)


def _table(seen: list[_Seen]) -> Iterator[str]:
    for low, high in pairwise(_BANDS):
        band = [s for s in seen if low <= s.own < high]
        if not band:
            continue
        told, right = np.mean([s.told.sum() for s in band]), np.mean([s.right.any() for s in band])
        harbours = len({s.harbour for s in band})
        yield f"  evidence of the scan {low:3.0f} to {high:3.0f}: {len(band):4d} matches in {harbours:2d}: claimed {told:.2f}, right {right:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--harbours", type=int, default=len(_SEEDS))
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 2)
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.jobs) as pool:
        seen = [s for found in pool.map(_of_harbour, _SEEDS[: arguments.harbours]) for s in found]
    for name, some in (("alone", [s for s in seen if s.turns == 1]), ("together", [s for s in seen if s.turns > 1])):
        print(f"scans matched {name}, without Belief:", *_table(some), sep="\n")
    (enough, power, alike), loss, without = _fit_share(seen)
    print(f"enough={enough:.1f}, power={power:.2f}, alike={alike:.2f}; loss {loss:.3f}, without {without:.3f}")
    decided, loss, without = _fit_decided(seen)
    print(f"decided={decided:.2f}; loss {loss:.3f}, without {without:.3f}")


if __name__ == "__main__":
    main()
