# SPDX-License-Identifier: Apache-2.0
"""Matches of scans made around the track of a solved run (during a run: `_live.py`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.config import AerialConfig, VesselConfig
from graphloc.eval.match_picture import Gallery
from graphloc.frames import Array, Datum, wrap_angle
from graphloc.frontends.aerial import match_bag
from graphloc.frontends.aerial.matcher import NO_POSE
from graphloc.frontends.part import Bags
from graphloc.frontends.time_offsets import heading_time_offset
from graphloc.frontends.turning import Turning
from graphloc.gather._gathering import Gathering
from graphloc.recording import Progress, Recording, quiet
from graphloc.solution import Solution
from graphloc.time import NS_PER_S
from graphloc.trajectory import Trajectory

_MISLED = 0.25  # matches to scans that fit nowhere, below which the former are doubted
_SURE = 0.5  # probability of a match's heading that counts for how the heading turns
# Of the heading without matches; a larger sigma than the second tells none.
_TURNED_SIGMAS, _TOLD_RAD, _FEWEST = 2.0, np.radians(10.0), 5
_ALIKE_RAD = np.radians(5.0)  # that right headings of matches differ by
_FAR_OFF = 3.0  # sigmas of the clock
_CUT_OFF = 0.1  # share of scans whose search windows were too small, above which they are matched once more


@dataclass(frozen=True, slots=True)
class Scans:
    """Where scans are matched from: the bags, and the folder that relative image paths count from."""

    bags: Bags
    folder: Path


class Matches(NamedTuple):
    """A recording with its matches.

    Attributes:
        cut_off: many of the windows were too small for what the solution left open. turned: what is said of headings (`turned_heading`).
        late: what is said of stamps by how headings turn (`late_turns`).
        beyond: `seq` of the matches whose windows were. pictures: captions and JPEGs of some.
    """

    recording: Recording
    cut_off: bool
    turned: list[str]
    late: Sequence[str] = ()
    beyond: frozenset[int] = frozenset()
    pictures: tuple[tuple[str, bytes], ...] = ()

    @property
    def within_reach(self) -> Recording:
        """The recording without the matches whose windows were too small: there the right place may lie outside."""
        return replace(
            self.recording, measurements=tuple(m for m in self.recording.measurements if m.seq not in self.beyond)
        )


def with_matches(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    solution: Solution,
    scans: Scans,
    progress: Progress = quiet,
) -> Matches:
    """Add the matches of every aerial sensor, made around a solution; a scan that gave none is a row of the ledger.

    Raises:
        InputError: an image or LiDAR that cannot be used.
    """
    gathered, track, gallery = Gathering(recording), solution.trajectory, Gallery()
    span_s = int((track.stamps_ns[-1] - track.stamps_ns[0]) / 1e9)
    tried, cut_off, turned, late, beyond = 0, 0, list[str](), list[str](), set[int]()
    for name, sensor in config.of_kind("aerial").items():
        gathered.sensor(name, dict.fromkeys((lidar.topic for lidar in sensor.lidars.values()), f"read by {name}"))
        around = _when_scanned(track, solution.time_offsets_s.get(name, 0.0))
        found = match_bag(scans.bags, sensor, scans.folder, config.body_frame, around, datum, warn=gathered.said.append)
        matched, turns, turned_ns = 0, list[tuple[float, float]](), list[int]()
        for item in found:
            if item.match is not None:
                tried, cut_off = tried + 1, cut_off + item.match.cut_off
                gallery.offer(item.match, name, (item.stamp_ns - int(track.stamps_ns[0])) / 1e9)
            if item.match is not None and item.match.modes:
                matched += 1
                best, prior = item.match.modes[0], item.match.prior
                if item.match.of_heading > _SURE:
                    turns.append((float(wrap_angle(best.pose[2] - prior.pose[2])), float(prior.sigma[2])))
                    turned_ns.append(item.stamp_ns)
                taken = gathered.take(item.match.fix(item.stamp_ns, name, item.since, sensor.axes))
                if item.match.cut_off:
                    beyond.add(taken.seq)
            else:
                gathered.refuse(name, item.stamp_ns, item.why_not)
            progress("matching", min(int((item.stamp_ns - track.stamps_ns[0]) / 1e9), span_s), span_s)
        progress("matching", span_s, span_s)
        gathered.said += few_matches(name, gathered.refused(name), matched)
        turned += turned_heading(name, turns)
        late += late_turns(
            name, sensor, around, np.array(turned_ns, dtype=np.int64), np.array([turn for turn, _ in turns])
        )
    pictures = tuple(gallery.pictures())
    return Matches(gathered.recording(), cut_off > _CUT_OFF * tried, turned, late, frozenset(beyond), pictures)


def _when_scanned(track: Trajectory, late_s: float) -> Trajectory:
    """Return a track by the stamps that scans have which are taken so much later than stamped, s."""
    return replace(track, stamps_ns=track.stamps_ns - round(late_s * NS_PER_S)) if late_s else track


def turned_heading(sensor: str, turns: Sequence[tuple[float, float]]) -> list[str]:
    """Say so where matches turn the heading by more than a sensor of it is likely to be off: one of the two may be mounted askew.

    Args:
        turns: yaw of each sure match less that of the solution without matches, and the latter's sigma, rad.
    """
    if len(turns) < _FEWEST:
        return []
    turn, sigma = np.median(np.array(turns), axis=0)
    if sigma > _TOLD_RAD or abs(turn) < _TURNED_SIGMAS * sigma:
        return []
    line = (
        f"{sensor}: its matches turn the heading by {np.degrees(turn):.1f} deg (counter-clockwise) from what the rest of the run shows to "
        f"{np.degrees(sigma):.1f} deg (1 sigma); the bounds allow for neither a LiDAR's mount nor a heading sensor that is off by that much"
    )
    return [line]


def late_turns(
    sensor: str, config: AerialConfig, track: Trajectory, stamps_ns: NDArray[np.int64], turn_rad: Array
) -> list[str]:
    """Say so where sure matches turn later or earlier than the vessel, by more than the configuration allows for: a line, or none.

    By the graph their headings, whose errors are alike for minutes, tell little of that; but such errors do not follow the vessel's turns.

    Args:
        track: without matches. stamps_ns: (N,) of the matches. turn_rad: (N,) their yaw less the track's.
    """
    order = np.argsort(stamps_ns, kind="stable")
    stamps_ns, turn_rad = stamps_ns[order], turn_rad[order]
    near = np.abs(turn_rad - np.median(turn_rad)) < _ALIKE_RAD if len(turn_rad) else np.zeros(0, dtype=bool)
    if near.sum() < _FEWEST:
        return []
    own_s = (track.stamps_ns - track.stamps_ns[0]) / NS_PER_S
    turning = Turning(int(track.stamps_ns[0]), own_s, np.unwrap(track.yaw_rad))
    at_s = (stamps_ns[near] - track.stamps_ns[0]) / NS_PER_S
    found = heading_time_offset(turning, stamps_ns[near], np.interp(at_s, own_s, turning.turned_rad) + turn_rad[near])
    if found is None or abs(found[0]) <= _FAR_OFF * config.stamp_sigma_s:
        return []
    value_s, sigma_s = found
    said = f"{sensor}: its matches turn as the vessel does {value_s:+.2f} +- {sigma_s:.2f} s from their stamps, by more than stamp_sigma_s"
    return [f"{said} allows for: set time_offset_s to {config.time_offset_s + value_s:.2f}"]


def few_matches(sensor: str, reasons: Counter[str], matched: int) -> list[str]:
    """Say so where scans of a sensor gave no match; where most fit nowhere, what hinders them may have misled the others."""
    if reasons.total() < 5:
        return []
    ((most, count),) = reasons.most_common(1)
    others = f"; the {matched} others may well be false" if 0 < matched < _MISLED * reasons[NO_POSE] else ""
    return [
        f"{sensor}: {reasons.total()} scans gave no match, {count} of them: {most}; `graphloc match` shows one{others}"
    ]
