# SPDX-License-Identifier: Apache-2.0
"""How the craft turned, by its gyroscope, and whether an angle turns with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, wrap_angle
from graphloc.frontends._turns import without_line
from graphloc.signals.series import rms
from graphloc.time import NS_PER_S

# Times over which changes of an angle and of a course are compared: a gyro's bias must be small beside them, and the noise average out.
# Chords of slow fixes are noisier than a compass: the Husky, at 1 m/s, agrees to 0.60 over 6 s, to 0.7 from 10 s on.
_ANGLE_S, _COURSE_S = 2.0, 12.0
_CORRELATED = 0.5  # correlation of these changes that is believed
_STEADY_S = 120.0  # within it a gyro's bias and a compass's offset are steady
_FEWEST = 20  # angles, or changes of them, that tell anything
# Times the span that changes are compared over: more is a gap. What an angle leaps by beside the turning, of either sense.
_GAP, _LEAP_RAD = 1.5, 2.0
_CLEARLY = 0.5  # what a course and the craft's turns differ by, of what they would if it turned the other way
_FOLLOWS_DEG, _FOLLOWS = 8.0, 3.0  # most RMS of what a heading and the gyroscope differ by; turns over that


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """How the craft turned: times (N,) s since `origin_ns`, and the integral (N,) of its rate about up, rad."""

    origin_ns: int
    t_s: Array
    turned_rad: Array


def against_turning(turning: Turning | None, at_ns: NDArray[np.int64], angle: Array) -> int:
    """Return +1 where an angle grows as the craft turns to port, -1 where it falls, 0 where nothing tells.

    Args:
        at_ns: (N,), increasing. angle: (N,) rad, unwrapped.
    """
    a, b = _changes(*_beside(turning, at_ns, angle), _ANGLE_S)
    if len(a) < _FEWEST:
        return 0
    power = float(np.sqrt((a**2).sum() * (b**2).sum()))
    together = float((a * b).sum())
    return int(np.sign(together)) if abs(together) > _CORRELATED * power else 0


def course_against_turning(turning: Turning, at_ns: NDArray[np.int64], course: Array) -> int:
    """Return +1 where a course turns to port as the craft does, -1 where it turns the other way, 0 where nothing tells.

    It must turn by about as much as the craft. Turns are compared to half a turn, by which a course is off where the craft goes astern.

    Args:
        at_ns, course: as for `against_turning`.
    """
    a, b = _changes(*_beside(turning, at_ns, course), _COURSE_S)
    if len(a) < _FEWEST:
        return 0
    along, against = (rms(_to_half_a_turn(a - sense * b)) for sense in (1.0, -1.0))
    return int(along < _CLEARLY * against) - int(against < _CLEARLY * along)


def left_of_turns(turning: Turning, at_ns: NDArray[np.int64], course: Array) -> float:
    """Return the share of a course's squared changes that a turning does not explain: 0 where it turns as the craft; inf where nothing tells.

    Changes are compared to half a turn, as in `course_against_turning`.

    Args:
        at_ns, course: as for `against_turning`.
    """
    a, b = _changes(*_beside(turning, at_ns, course), _COURSE_S)
    if len(a) < _FEWEST:
        return np.inf
    power = float((_to_half_a_turn(a) ** 2).sum())
    return float((_to_half_a_turn(a - b) ** 2).sum()) / power if power > 0.0 else np.inf


def _to_half_a_turn(angle: Array) -> Array:
    return 0.5 * wrap_angle(2.0 * angle)


def follows_turning(turning: Turning | None, at_ns: NDArray[np.int64], yaw: Array) -> bool:
    """Return whether a heading turns as the gyroscope does, by far more than the two differ.

    In blocks of two minutes, a straight line removed from each: the bias of the gyroscope, and what a heading is off by throughout.

    Args:
        at_ns: (N,), increasing. yaw: (N,) rad, unwrapped, positive to port.
    """
    at, own, turned = _beside(turning, at_ns, yaw)
    off = np.unwrap(own - turned)  # across a gap the heading itself may have turned by more than half a turn
    apart, turns = [], []
    blocks = (at - at[:1]) // _STEADY_S
    for block in (blocks == k for k in np.unique(blocks)):
        if block.sum() >= _FEWEST:
            apart.append(without_line(off[block], at[block]))
            turns.append(without_line(turned[block], at[block]))
    if not apart:
        return False
    off_deg, turns_deg = (float(np.degrees(rms(np.concatenate(part)))) for part in (apart, turns))
    return off_deg < min(_FOLLOWS_DEG, turns_deg / _FOLLOWS)


def _changes(at: Array, angle: Array, turned: Array, over_s: float) -> tuple[Array, Array]:
    """Return by how much angles and a turning (N,) at times (N,), s, change within about `over_s`: (M,) of both.

    Not across gaps, over which they were not unwrapped by anything that was measured, nor where an angle leaps as no turn does: a course
    is half a turn off from where the craft goes astern.
    """
    if len(at) < 2:
        return np.zeros(0), np.zeros(0)
    usual_s = float(np.median(np.diff(at)))
    span_s = max(over_s, usual_s)
    after = np.searchsorted(at, at + span_s - 0.5 * usual_s)
    first = np.flatnonzero(after < len(at))
    after = after[first]
    steps, turns = np.diff(angle), np.diff(turned)
    leaps = np.minimum(np.abs(wrap_angle(steps - turns)), np.abs(wrap_angle(steps + turns))) > _LEAP_RAD
    leapt = np.cumsum(np.append(0, leaps))
    whole = (at[after] - at[first] < _GAP * span_s) & (leapt[after] == leapt[first])
    first, after = first[whole], after[whole]
    return angle[after] - angle[first], turned[after] - turned[first]


def _beside(turning: Turning | None, at_ns: NDArray[np.int64], angle: Array) -> tuple[Array, Array, Array]:
    """Return times (M,), s, of the angles that lie within a turning, these (M,) and the turning (M,) there; empty without one."""
    if turning is None:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    at = (at_ns - turning.origin_ns) / NS_PER_S
    inside = (at > turning.t_s[0]) & (at < turning.t_s[-1])
    return at[inside], angle[inside], np.interp(at[inside], turning.t_s, turning.turned_rad)
