# SPDX-License-Identifier: Apache-2.0
"""A run of hours is solved in overlapping legs, so that memory does not grow with its length.

The estimate at the end of an overlap hardly depends on the data before it: biases and slow errors are known again after
some tens of seconds. Only the heading is handed on to the next leg, for where no sensor measures one; not where it is a
guess.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import heading_deg_from_yaw, wrap_angle
from graphloc.ledger import Ledger
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.solve._memory import give_back_memory
from graphloc.time import NS_PER_S
from graphloc.trajectory import bounds_95

_OVERLAP_S, _SHARE = 60.0, 0.2  # overlap on each side of a seam, s, and at most this share of a leg
_LOOK = 0.1  # share of a leg, to either side, within which a seam is placed
_HANDED_ON_DEG = 15.0  # largest 1 sigma of a heading that is handed on: the next leg takes it as known
_ENOUGH = 0.9  # a seam has at least this share of the most positions that any candidate has near it


class KnownHeading(NamedTuple):
    """Compass heading at the start of a recording, and its 1 sigma, deg."""

    deg: float
    sigma_deg: float


Solve = Callable[[Recording, KnownHeading | None], Solution]
"""Solves a recording, given the heading at its start, or None where that is not known."""


@dataclass(frozen=True, slots=True)
class Apart:
    """The largest difference between legs at a seam.

    Attributes:
        m: of the horizontal position. deg: of the heading.
        within: whether all differences are within the sum of both legs' bounds (95 %).
    """

    m: float = 0.0
    deg: float = 0.0
    within: bool = True


def seams(recording: Recording, leg_s: float, absolute: Collection[str]) -> list[int]:
    """Return the stamps at which a run is cut into legs of at most about `leg_s`; none where it is no longer.

    Args:
        absolute: sensors that measure position. A leg cannot start within an outage of them, so seams avoid outages.
    """
    imu = recording.imu
    if imu is None or len(imu) < 2:
        return []
    begin, end = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    legs = int(np.ceil((end - begin) / NS_PER_S / leg_s))
    told = np.array([m.stamp_ns for m in recording.measurements if m.sensor in absolute], dtype=np.int64)
    found = []
    for k in range(1, legs):
        long_ns = (end - begin) / legs
        near = begin + ((k + np.linspace(-_LOOK, _LOOK, 21)) * long_ns).astype(np.int64)
        beside = np.diff(np.searchsorted(told, near[:, None] + np.array([-1, 1]) * overlap_ns(leg_s))).ravel()
        good = np.flatnonzero(beside >= _ENOUGH * beside.max())
        found.append(int(near[good[np.argmin(np.abs(good - 10))]]))
    return found


def overlap_ns(leg_s: float) -> int:
    """Return how far (ns) a leg extends beyond a seam."""
    return round(min(_OVERLAP_S, _SHARE * leg_s) * NS_PER_S)


def solve_legs(
    recording: Recording, heading: KnownHeading | None, seams_ns: Collection[int], leg_s: float, solve: Solve
) -> tuple[list[Solution], Apart]:
    """Solve the legs of a run in turn.

    Args:
        heading: at its start, where known. seams_ns: stamps where the run is cut. leg_s: length of a leg, for the
            overlap. solve: solves a leg.

    Returns:
        The solution of each leg for its own time, and the largest difference between two legs where they meet.

    Raises:
        SolveError: a leg could not be solved.
    """
    assert recording.imu is not None
    over = overlap_ns(leg_s)
    edges = [np.iinfo(np.int64).min // 2, *seams_ns, np.iinfo(np.int64).max // 2]
    legs: list[Solution] = []
    before, apart = None, Apart()
    for number, (begin, end) in enumerate(pairwise(edges)):
        whole = solve(_between(recording, begin - over, end + over), heading)
        if before is not None:
            apart = _farther(apart, before, whole, begin)
            legs.append(_own(before, edges[number - 1], begin, _first_after(whole, begin), legs[-1] if legs else None))
        heading = _known_heading(whole, np.array([end - over]))
        before = whole
        give_back_memory()
    assert before is not None
    return [*legs, _own(before, edges[-2], edges[-1], edges[-1], legs[-1] if legs else None)], apart


def _first_after(leg: Solution, stamp_ns: int) -> int:
    """Return the stamp of the first state of a leg from a stamp on; that stamp if there is none."""
    stamps_ns = leg.trajectory.stamps_ns
    k = int(np.searchsorted(stamps_ns, stamp_ns))
    return int(stamps_ns[k]) if k < len(stamps_ns) else stamp_ns


def _known_heading(leg: Solution, at_ns: NDArray[np.int64]) -> KnownHeading | None:
    """Return the heading at a stamp (1,); None if the leg has no state there, or hardly knows it.

    The data of the overlap, which the next leg has as well, may be all that tells it: so its variance is doubled.
    """
    if not leg.trajectory.covers(at_ns)[0]:
        return None
    there = leg.trajectory.at(at_ns)
    if there.cov is None:
        return None
    sigma_deg = float(np.degrees(np.sqrt(2.0 * there.cov[0, 5, 5])))
    return (
        KnownHeading(float(heading_deg_from_yaw(there.yaw_rad)[0]), sigma_deg) if sigma_deg <= _HANDED_ON_DEG else None
    )


def _between(recording: Recording, begin_ns: int, end_ns: int) -> Recording:
    imu = recording.imu
    assert imu is not None
    samples = imu.where(slice(*np.searchsorted(imu.stamps_ns, [begin_ns, end_ns])))
    kept = tuple(m for m in recording.measurements if begin_ns <= m.stamp_ns < end_ns)
    return replace(recording, imu=samples, measurements=kept, rows=())


def _farther(apart: Apart, before: Solution, after: Solution, at_ns: int) -> Apart:
    at = np.array([at_ns])
    if not (before.trajectory.covers(at)[0] and after.trajectory.covers(at)[0]):
        return apart
    one, other = before.trajectory.at(at), after.trajectory.at(at)
    off_m = float(np.hypot(*(one.p_world_m - other.p_world_m)[0, :2]))
    off_deg = float(np.degrees(abs(wrap_angle(one.yaw_rad - other.yaw_rad)))[0])
    bounds = np.array([bounds_95(t.cov)[0] for t in (one, other) if t.cov is not None]).sum(axis=0)
    within = bool(off_m <= bounds[0] and off_deg <= bounds[2])
    return Apart(max(apart.m, off_m), max(apart.deg, off_deg), apart.within and within)


def _own(leg: Solution, begin_ns: int, end_ns: int, until_ns: int, before: Solution | None) -> Solution:
    """Return the solution of a leg, cut to its own time.

    Args:
        begin_ns, end_ns: of that time. until_ns: first state of the next leg. States of two legs are not in step, so between the last one
            before a seam and the first one after it there may be nearly two intervals.
        before: the leg before; None: there is none.
    """

    def mine(stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray((stamps_ns >= begin_ns) & (stamps_ns < end_ns))

    own = np.asarray((leg.trajectory.stamps_ns >= begin_ns) & (leg.trajectory.stamps_ns < until_ns))
    kept = leg.trajectory.where(own)
    since = {name: s[own] for name, s in leg.since_agreed_s.items()}
    if before is not None:
        gone_s = (kept.stamps_ns - before.trajectory.stamps_ns[-1]) / NS_PER_S
        for name, s in before.since_agreed_s.items():  # 'never' here means not in this leg
            own_s = since.get(name, np.full(len(kept), np.inf))
            since[name] = np.where(np.isinf(own_s), s[-1] + gone_s, own_s)
    slow = {
        name: replace(s, stamps_ns=s.stamps_ns[m := mine(s.stamps_ns)], value=s.value[m], sigma=s.sigma[m])
        for name, s in leg.slow.items()
    }
    berths = tuple(
        replace(
            b,
            stamps_ns=b.stamps_ns[m := mine(b.stamps_ns)],
            value=b.value[m],
            rate=b.rate[m],
            cov=None if b.cov is None else b.cov[m],
        )
        for b in leg.berths
    )
    return replace(
        leg,
        trajectory=kept,
        v_cov=leg.v_cov[own],
        accel_bias_mps2=leg.accel_bias_mps2[own],
        gyro_bias_radps=leg.gyro_bias_radps[own],
        gyro_radps=leg.gyro_radps[own],
        gyro_cov=leg.gyro_cov[own],
        health=tuple(h for h, m in zip(leg.health, own, strict=True) if m),
        health_reason=tuple(h for h, m in zip(leg.health_reason, own, strict=True) if m),
        since_agreed_s=since,
        slow=slow,
        berths=tuple(b for b in berths if len(b.stamps_ns)),
        ledger=Ledger(row for row in leg.ledger if begin_ns <= row.stamp_ns < end_ns),
        stats=replace(leg.stats, states=int(own.sum())),
    )
