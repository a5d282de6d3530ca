# SPDX-License-Identifier: Apache-2.0
"""What a solved run says of the survey of its tags: sizes that cannot be, tags that stand elsewhere."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from graphloc.frames import Array
from graphloc.ledger import LedgerRow
from graphloc.measurements import TagSighting
from graphloc.recording import Recording
from graphloc.solution import Solution

_FEWEST = 8
_DOUBTED = 0.5  # share of a tag's sightings that disagree with the rest
_OFF, _ALIKE = 0.04, 0.05  # a ratio of distances that is off by more, and does not scatter by as much, is a size
_ELSEWHERE_M = 0.3


def suspect_tags(recording: Recording, solution: Solution) -> list[str]:
    """Return a line for each tag most of whose sightings disagree with the run, and what would explain it."""
    rows = {row.seq: row for row in solution.ledger if row.seq >= 0}
    track = solution.trajectory
    by_tag: dict[tuple[str, int], list[TagSighting]] = defaultdict(list)
    for m in recording.measurements:
        if isinstance(m, TagSighting) and len(m.numbers) == 1 and track.covers(np.array([m.stamp_ns]))[0]:
            by_tag[(m.sensor, m.numbers[0])].append(m)
    lines = []
    for (sensor, number), own in sorted(by_tag.items()):
        doubted = [m for m in own if _weight(rows, m) < 0.5]
        if len(doubted) < max(_FEWEST, _DOUBTED * len(own)):
            continue
        stamps, where = np.unique([m.stamp_ns for m in doubted], return_inverse=True)  # two cameras may see it at once
        at = track.at(stamps)
        said = _explained(doubted, at.p_world_m[where], at.R_world_body[where])
        lines.append(f"{sensor}: tag {number}: {len(doubted)} of {len(own)} sightings disagree with the rest; {said}")
    return lines


def _weight(rows: Mapping[int, LedgerRow], m: TagSighting) -> float:
    row = rows.get(m.seq)
    return 1.0 if row is None or row.weight is None else row.weight


def _explained(own: list[TagSighting], p: Array, R: Array) -> str:
    middle = np.array([m.points_m.mean(axis=0) for m in own])
    camera = np.array([a + B @ m.t_body_camera_m for m, a, B in zip(own, p, R, strict=True)])
    toward = np.array([
        B @ m.R_body_camera @ m.modes[0].R_world_camera.T @ (c - m.modes[0].p_world_camera_m)
        for m, B, c in zip(own, R, middle, strict=True)
    ])  # fmt: skip
    ratio = np.linalg.norm(middle - camera, axis=1) / np.linalg.norm(toward, axis=1)
    median = float(np.median(ratio))
    if abs(median - 1.0) > _OFF and float(np.median(np.abs(ratio - median))) < _ALIKE * median:
        size_m = float(np.linalg.norm(own[0].points_m[1] - own[0].points_m[0]))
        return (
            f"by its size it is {median:.2f} times too near: size_m {size_m * median:.3f} instead of {size_m:.3f} would do "
            "(the black square without its white margin), or it stands elsewhere"
        )
    moved = np.median(camera + toward - middle, axis=0)
    if float(np.linalg.norm(moved)) > _ELSEWHERE_M:
        return f"they show it {moved[0]:.1f} m east, {moved[1]:.1f} m north, {moved[2]:.1f} m above its place in the survey"
    return "look at its attitude in the survey, and at the camera's mount"
