# SPDX-License-Identifier: Apache-2.0
"""How the craft turned, by its gyroscope, and whether a heading or course turns with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, wrap_angle
from graphloc.frontends._turns import without_line
from graphloc.signals.series import rms
from graphloc.time import NS_PER_S

# Times over which changes of a heading and of a course are compared with the gyroscope: so short that the gyro's bias
# is small, so long that noise averages out. Chords of slow fixes are noisier than a compass: the courses of the Husky,
# at 1 m/s, correlate by 0.60 over 6 s, by 0.7 from 10 s on.
_ANGLE_S, _COURSE_S = 2.0, 12.0
_CORRELATED = 0.5  # least correlation of changes that is believed
_STEADY_S = 120.0  # duration of a block, in which a gyro's bias and a compass's offset are steady
_FEWEST = 20  # least number of angles, or of changes, that tell anything
# A change that takes so many times its span crosses a gap; a step that differs so much from the turning, with either
# sign, is a leap.
_GAP, _LEAP_RAD = 1.5, 2.0
_CLEARLY = 0.5  # largest RMS of course minus turning, as a share of that with the turning's sign reversed
_FOLLOWS_DEG, _FOLLOWS = 8.0, 3.0  # a heading follows: largest RMS difference; least ratio of the RMS turn to it


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """How the craft turned: times (N,) s since `origin_ns`, and the integral (N,) of its rate about up, rad."""

    origin_ns: int
    t_s: Array
    turned_rad: Array


def against_turning(turning: Turning | None, at_ns: NDArray[np.int64], angle: Array) -> int:
    """Return +1 if an angle grows as the craft turns to port, -1 if it falls, 0 if that is unclear.

    Args:
        turning: the integrated gyroscope; None without an IMU. at_ns: (N,), increasing. angle: (N,) rad, unwrapped.
    """
    a, b = _changes(*_beside(turning, at_ns, angle), _ANGLE_S)
    if len(a) < _FEWEST:
        return 0
    power = float(np.sqrt((a**2).sum() * (b**2).sum()))
    together = float((a * b).sum())
    return int(np.sign(together)) if abs(together) > _CORRELATED * power else 0


def course_against_turning(turning: Turning, at_ns: NDArray[np.int64], course: Array) -> int:
    """Return +1 if a course turns as the craft does, -1 if it turns the other way, 0 if that is unclear.

    It must turn by about as much as the craft. Turns are compared modulo half a turn, which a course is off if the
    craft goes astern.

    Args:
        turning: the integrated gyroscope. at_ns: (N,), increasing. course: (N,) rad, unwrapped.
    """
    a, b = _changes(*_beside(turning, at_ns, course), _COURSE_S)
    if len(a) < _FEWEST:
        return 0
    along, against = (rms(_to_half_a_turn(a - sense * b)) for sense in (1.0, -1.0))
    return int(along < _CLEARLY * against) - int(against < _CLEARLY * along)


def left_of_turns(turning: Turning, at_ns: NDArray[np.int64], course: Array) -> float:
    """Return the share of a course's squared changes that a turning does not explain; inf if too few changes tell.

    Changes are compared modulo half a turn, see `course_against_turning`.

    Args:
        turning, at_ns, course: see `course_against_turning`.
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

    They are compared in blocks of two minutes. A straight line is removed from each block: the bias of the gyroscope,
    and a constant offset of the heading.

    Args:
        turning: the integrated gyroscope; None without an IMU. at_ns: (N,), increasing.
        yaw: (N,) rad, unwrapped, counter-clockwise.
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
    """Return by how much angles (N,) and a turning (N,) at times (N,), s, change within about `over_s`: (M,) of each.

    Changes across gaps are left out: nothing measured tells how to unwrap them. So are changes across a leap of an
    angle: a course leaps by half a turn where the craft begins to go astern.
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
    """Return the times (M,), s, of angles within the time of a turning, these angles, and the turning at these times.

    Empty without a turning.
    """
    if turning is None:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    at = (at_ns - turning.origin_ns) / NS_PER_S
    inside = (at > turning.t_s[0]) & (at < turning.t_s[-1])
    return at[inside], angle[inside], np.interp(at[inside], turning.t_s, turning.turned_rad)
