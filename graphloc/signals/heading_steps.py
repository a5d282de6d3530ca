# SPDX-License-Identifier: Apache-2.0
"""Steps of a heading that the gyroscope does not show: iron is moved on board, or a GNSS compass is fixed wrongly.

A compass's error wanders by a degree within a minute. A step of 20 deg from one reading to the next that stays is no such wander:
taken for one, it draws the heading along, and the gyroscope, which denies it, looks like one whose bias runs away. As an error
of the gyroscope it would be a turn faster than the craft turns anywhere around. Steps that take seconds: `slow_heading_steps.py`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from graphloc.frames import Array, wrap_angle
from graphloc.signals.level_steps import BESIDE_S, GAP, Shape, beside, level_steps
from graphloc.signals.slow_heading_steps import at_least, shows_turns, slow_steps
from graphloc.time import NS_PER_S, duration_ns, utc_text

_LEAST_RAD = np.radians(5.0)  # smaller steps are noise and wander
_SIGMAS = 3.0  # least size in stated sigmas of a reading
# The largest turn within so many seconds is no step: readings may be late by as much, and the turn of a craft that lists is a
# little more than what the gyroscope across its deck shows.
_LATE_S = 0.5
_SETTLES_S = 2.0  # time after a step within which it is over, also in a compass that filters its headings
# At once; or in a compass that filters its headings, of which less than 0.46 would come within `_DAMPED_S` where a turn ends that the
# gyroscope does not show.
_SUDDEN, _DAMPED = Shape(sure=2.0, before=0.3, after=0.3), Shape(share=0.5, sure=1.0, before=0.25, after=0.65)
_DAMPED_S = 0.6
# A step is faster than all turns around it by this factor: a gyroscope that shows nothing of a turn, or less, looks like a step.
_FASTER = 2.5
_EVERY_S = 0.5  # time between two looks online
_LOOKED_FOR_S = 12.0  # time for which a step is looked for online
_HOLD_S = 3.0  # time for which a slow step that goes on is taken to go on, online
_REMEMBERED_S = 40.0  # online
_OUTLIERS = 5  # readings, of which two may be outliers
_KEPT = 1000, 128  # most readings and steps kept online, to bound memory


class HeadingStep(NamedTuple):
    """A step of the headings of a compass.

    Attributes:
        after_ns: stamp of the first reading after it, or after it began. size_rad: the headings after it less those before, or the farthest
            that they go. until_ns: stamp until which the headings may still move. at_once: whether they move at once, or nearly so.
    """

    after_ns: int
    size_rad: float
    until_ns: int
    at_once: bool = True

    @property
    def parts(self) -> tuple[float, ...]:
        """The step in the unit in which the compass's slow error is written, deg."""
        return (math.degrees(self.size_rad),)

    def beside(self, others: Sequence[HeadingStep]) -> bool:
        """Return whether another step is where this one is, so that they are one."""
        near_ns = duration_ns(BESIDE_S)
        return any(
            self.after_ns <= step.until_ns + near_ns and step.after_ns <= self.until_ns + near_ns for step in others
        )


def heading_steps(
    stamps_ns: NDArray[np.int64],
    yaw_rad: Array,
    turned_rad: Array,
    sigma_rad: Array,
    blind: NDArray[np.bool_],
    *,
    works: bool = False,
) -> list[HeadingStep]:
    """Return the steps of headings beside a gyroscope. A single outlier, or two, is none.

    Args:
        stamps_ns: (N,), increasing. yaw_rad: (N,) readings. turned_rad: (N,) by how much the gyroscope has turned about the
            vertical until each. sigma_rad: (N,) as stated. blind: (N - 1,) intervals in which the gyroscope was silent.
        works: whether the gyroscope has shown turns before; without any, a step that takes seconds may be a turn.
    """
    if len(stamps_ns) < 2:
        return []
    off, turns = _unwrapped(yaw_rad - turned_rad), np.abs(np.diff(turned_rad))
    if float(np.ptp(off)) < _LEAST_RAD:
        return []
    dt_s = np.diff(stamps_ns) / NS_PER_S
    usual_s = float(np.median(dt_s))
    around = beside(usual_s)
    # Across a silence of either the difference may have drifted.
    unknown = blind | (dt_s > GAP * usual_s)
    fastest = _around(np.where(unknown, np.inf, turns / np.maximum(dt_s, 1e-3)), around)
    least = np.maximum(_LEAST_RAD, _SIGMAS * _around(sigma_rad[1:], around))
    found: dict[int, float] = {}
    clear_ns = stamps_ns[-1] - duration_ns(BESIDE_S + _DAMPED_S)  # of a later one it is not yet clear where it begins
    several = round(_DAMPED_S / max(usual_s, 1e-3))
    swings = at_least(ndimage.median_filter(off, around, mode="nearest"), around)
    for shape, floor in ((_SUDDEN, 0.0), (_DAMPED._replace(within=several - (several + 1) % 2), swings)):
        if shape.within > 0:
            faster = np.maximum(np.maximum(least, floor), max(_LATE_S, _FASTER * shape.within * usual_s) * fastest)
            at_ns, changes = level_steps(stamps_ns, off[:, None], faster, shape=shape)
            new = (np.abs(np.subtract.outer(at_ns, [*found])) > BESIDE_S * NS_PER_S).all(axis=1)
            new &= at_ns <= clear_ns
            found |= zip(at_ns[new].tolist(), changes[new, 0].tolist(), strict=True)
    settles_ns = duration_ns(_SETTLES_S)
    steps = [HeadingStep(at_ns, size, at_ns + settles_ns) for at_ns, size in found.items()]
    for begin_ns, size, end_ns in slow_steps(stamps_ns, off, turned_rad, least, unknown, works=works):
        slow = HeadingStep(max(begin_ns - settles_ns, int(stamps_ns[1])), size, end_ns + settles_ns, at_once=False)
        if steps and not steps[-1].at_once and slow.beside(steps[-1:]):  # as back from under a bridge
            size = math.copysign(max(abs(steps[-1].size_rad), abs(size)), steps[-1].size_rad)
            steps[-1] = steps[-1]._replace(size_rad=size, until_ns=slow.until_ns)
        elif not slow.beside(steps):
            steps.append(slow)
    return sorted(steps)


def _unwrapped(angle_rad: Array) -> Array:
    """Return angles (N,) without turns of 360 deg: a reading, or two, that is flipped is none, and leaves the others where they are."""
    medians = [ndimage.median_filter(axis(angle_rad), _OUTLIERS, mode="nearest") for axis in (np.sin, np.cos)]
    level = np.unwrap(np.arctan2(*medians))
    return np.asarray(level + wrap_angle(angle_rad - level))


def _around(values: Array, n: int) -> Array:
    """Return the largest of the n values before each value, itself and the n after it."""
    padded = np.pad(values, n, constant_values=0.0)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * n + 1).max(axis=1))


def step_warnings(sensor: str, steps: Sequence[HeadingStep]) -> list[str]:
    """Return a warning on the steps of a compass's headings, or none."""
    if not steps:
        return []
    largest = max(steps, key=lambda step: abs(step.size_rad))
    others = f", and {len(steps) - 1} more" if len(steps) > 1 else ""
    within = "" if largest.at_once else f" within {(largest.until_ns - largest.after_ns) / NS_PER_S:.0f} s"
    size, at = f"{math.degrees(largest.size_rad):+.0f} deg{within}", utc_text(largest.after_ns)
    said = f"{sensor}: heading step of {size} at {at}{others}, which the gyroscope does not show: taken as its error"
    return [f"{said} (iron, a wrong fix of a GNSS compass); its mount counts as unknown after it"]


class HeadingStepDetector:
    """Finds the steps of one compass online, three seconds late.

    Args:
        stepped: whether headings had stepped before, as in a run that is resumed.

    Attributes:
        steps: the last of the steps found since the estimate started.
    """

    def __init__(self, *, stepped: bool = False) -> None:
        self.steps: tuple[HeadingStep, ...] = ()
        self._stepped = stepped
        self._looked_ns, self._works = 0, False
        self._seen: deque[tuple[int, float, float, float, bool]] = deque(maxlen=_KEPT[0])

    @property
    def stepped(self) -> bool:
        """Whether headings have stepped, so that their offset is no mount's."""
        return self._stepped or bool(self.steps)

    @property
    def last_ns(self) -> int | None:
        """Stamp of the newest reading; None: there is none yet."""
        return self._seen[-1][0] if self._seen else None

    def note(self, stamp_ns: int, yaw_rad: float, turned_rad: float | None, sigma_rad: float) -> list[HeadingStep]:
        """Take in a reading, unless it is late, and return new steps.

        Args:
            turned_rad: turn by the gyroscope about the vertical since the last one; None: not known.
        """
        if self._seen and stamp_ns <= self._seen[-1][0]:
            return []
        before = self._seen[-1][2] if self._seen else 0.0
        self._seen.append((stamp_ns, yaw_rad, before + (turned_rad or 0.0), sigma_rad, turned_rad is None))
        while stamp_ns - self._seen[0][0] > _REMEMBERED_S * NS_PER_S:
            self._seen.popleft()
        if stamp_ns - self._looked_ns < _EVERY_S * NS_PER_S:
            return []
        self._looked_ns = stamp_ns
        stamps, yaw, turned, sigma, blind = zip(*self._seen, strict=True)
        seen_ns, yaw_rad_then, turned_rad_then = np.array(stamps, dtype=np.int64), np.array(yaw), np.array(turned)
        if not self._works and len(stamps) > 1:
            self._works = shows_turns(seen_ns, _unwrapped(yaw_rad_then - turned_rad_then), turned_rad_then)
        found = heading_steps(
            seen_ns, yaw_rad_then, turned_rad_then, np.array(sigma), np.array(blind[1:]), works=self._works
        )
        begun_ns = self.steps[-1].until_ns if self.steps else 0
        new = [now for step in found if (now := self._new(step, stamp_ns)) is not None]
        self.steps = (*self.steps, *new)[-_KEPT[1] :]
        return [step for step in new if step.after_ns != begun_ns]  # not those that go on

    def _new(self, step: HeadingStep, now_ns: int) -> HeadingStep | None:
        """Return what is new of a step that is seen now; None: nothing.

        Its size changes a little with each reading after it, its place by one of them; a slow one may still go on.
        """
        if step.until_ns < now_ns - duration_ns(_LOOKED_FOR_S):
            return None
        goes_on = not step.at_once and step.until_ns > now_ns
        until_ns = now_ns + duration_ns(_HOLD_S) if goes_on else step.until_ns
        if not step.beside(self.steps):
            return step._replace(until_ns=until_ns)
        last = self.steps[-1]
        soon_ns = now_ns + NS_PER_S if goes_on else step.until_ns
        if step.at_once and step.after_ns > last.until_ns:
            return step
        if not step.beside([last]) or step.at_once or last.until_ns >= soon_ns:
            return None
        return step._replace(after_ns=last.until_ns, until_ns=until_ns)
