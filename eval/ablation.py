# SPDX-License-Identifier: Apache-2.0
"""Contribution of each sensor: a run without it, its errors, and whether the sensor contradicts the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphloc.eval.consistency import Contradiction
from graphloc.eval.metrics import Levers, errors, held_out_errors
from graphloc.frames import Array
from graphloc.measurements import GnssPosition
from graphloc.signals.series import rms
from graphloc.solution import Solution
from graphloc.trajectory import Trajectory, bounds_95

CONTRADICTS = 2.0  # sigmas between a sensor and the rest, from which a contradiction is reported

Basis = str
"""'truth', 'held' (fixes kept out) or 'full' (the solution with all sensors)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Off:
    """Distances of a track from the reference over time.

    Attributes:
        stamps_ns: (N,). off_m: (N,) horizontal. off_deg: (N,) of the heading; None: the reference has none.
    """

    stamps_ns: NDArray[np.int64]
    off_m: Array
    off_deg: Array | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """Result with all sensors (`without` is '') or without one.

    Attributes:
        without: name of the sensor. measurements: number of its measurements in the recording; 0: they are made from
            the configuration.
        rmse_m, worst_m, heading_rmse_deg: distances from the reference. worst_at_s: when, since the run's begin.
        bound_m, bound_deg: median 95 % bounds of the solution. missing: share of the full track that it lacks.
        cost_ratio: cost over its expectation.
        contradiction: distance of the left-out sensor from this solution, in sigmas (`graphloc.eval.consistency`).
        apart_m, apart_deg: median of the same distance, if the sensor measures such.
        fits: by sensor, how far its used measurements are from this solution, in its own sigmas.
        why_not: why there is no solution; empty: there is one.
    """

    without: str
    measurements: int
    rmse_m: float | None = None
    worst_m: float | None = None
    worst_at_s: float | None = None
    heading_rmse_deg: float | None = None
    bound_m: float | None = None
    bound_deg: float | None = None
    missing: float | None = None
    cost_ratio: float | None = None
    contradiction: float | None = None
    apart_m: float | None = None
    apart_deg: float | None = None
    fits: Mapping[str, float | None]
    why_not: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Vote:
    """Two sensors that contradict the rest.

    Attributes:
        one, other: names. one_off, other_off: distance of each from a solution without the two, in sigmas; None: not
            known.
    """

    one: str
    other: str
    one_off: float | None
    other_off: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ablated:
    """Result of an ablation.

    Attributes:
        source, vessel: of the recording. basis: reference of the distances ('truth', 'held' or 'full').
        begin_ns: origin of times, begin of the full track.
        full, effects: with all sensors, and without each. over_time: distances, by left-out sensor.
        votes: between suspects. matched: sensors whose measurements were made around the full solution.
        warnings: on the comparison.
    """

    source: str
    vessel: str
    basis: Basis
    begin_ns: int
    full: Effect
    effects: tuple[Effect, ...]
    over_time: Mapping[str, Off]
    votes: tuple[Vote, ...] = ()
    matched: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def off(solution: Solution, full: Solution, truth: Trajectory | None, held: Sequence[GnssPosition], levers: Levers) -> Off:  # fmt: skip
    """Compare a solution with truth, else with held-out fixes, else with the solution with all sensors.

    Raises:
        NoCommonTimeError: the solution and its reference share no time.
    """
    if truth is None and held:
        fixes = held_out_errors(solution.trajectory, held, solution.datum, levers).predicted(solution.slow)
        return Off(stamps_ns=fixes.stamps_ns, off_m=fixes.horizontal_m, off_deg=None)
    reference = truth or full.trajectory
    found = errors(solution.trajectory, reference)
    off_deg = np.degrees(np.abs(found.heading_rad)) if reference.headed else None
    return Off(stamps_ns=found.stamps_ns, off_m=found.horizontal_m, off_deg=off_deg)


def effect(
    without: str, measurements: int, solution: Solution, full: Solution, away: Off,
    contradicts: Contradiction | None, fits: Mapping[str, float | None],
) -> Effect:  # fmt: skip
    """Return the effect of leaving out a sensor.

    Args:
        without, measurements: as of `Effect`. solution: without the sensor. full: with all sensors.
        away: distances of `solution` from the reference. contradicts: of the sensor; None: not known. fits: as of
            `Effect`.
    """
    track, stats = solution.trajectory, solution.stats
    assert track.cov is not None
    bounds, worst = np.median(bounds_95(track.cov), axis=0), int(np.argmax(away.off_m))
    return Effect(
        without=without,
        measurements=measurements,
        rmse_m=rms(away.off_m),
        worst_m=float(away.off_m[worst]),
        worst_at_s=float((away.stamps_ns[worst] - full.trajectory.stamps_ns[0]) * 1e-9),
        heading_rmse_deg=None if away.off_deg is None else rms(away.off_deg),
        bound_m=float(bounds[0]),
        bound_deg=float(bounds[2]),
        missing=1.0 - float(track.covers(full.trajectory.stamps_ns).mean()),
        cost_ratio=stats.cost / max(stats.expected_cost, 1.0),
        contradiction=None if contradicts is None else contradicts.sigmas,
        apart_m=None if contradicts is None else contradicts.apart_m,
        apart_deg=None if contradicts is None else contradicts.apart_deg,
        fits=fits,
    )


def suspects(effects: Sequence[Effect]) -> list[str]:
    """Return the sensors that contradict the solution without them, strongest first."""
    found = [(e.contradiction, e.without) for e in effects if (e.contradiction or 0.0) > CONTRADICTS]
    return [name for _, name in sorted(found, key=lambda pair: -(pair[0] or 0.0))]
