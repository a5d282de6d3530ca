# SPDX-License-Identifier: Apache-2.0
"""Whether an angle turns as the gyroscope does: also one with gaps, and a course of a craft that goes ahead and astern."""

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc.frames import Array, wrap_angle
from graphloc.frontends._assess_compass import _beside_either_way
from graphloc.frontends.turning import Turning, against_turning, course_against_turning, follows_turning, left_of_turns
from graphloc.time import NS_PER_S

T_S = np.arange(0.0, 360.0, 0.02)
YAW = (
    np.cumsum(np.where(T_S % 20.0 < 4.0, np.where(T_S % 40.0 < 20.0, 1.3, -0.3), 0.0)) * 0.02
)  # 298 deg to port, 69 back
TURNING = Turning(0, T_S, YAW + 0.004 * T_S)  # with a bias of its gyroscope
NOISE = 0.02 * np.random.default_rng(0).standard_normal(len(T_S))


def at(first_s: float, every_s: float, gaps: float) -> Array:
    """Indices of samples, some seconds apart, in the first `gaps` seconds of each minute none."""
    k = np.arange(round(first_s / 0.02), len(T_S), round(every_s / 0.02))
    return np.asarray(k[T_S[k] % 60.0 >= gaps])


def stamps(k: Array) -> NDArray[np.int64]:
    return np.asarray(T_S[k] * NS_PER_S, dtype=np.int64)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("gaps_s", [0.0, 38.0])
def test_a_heading_that_is_silent_for_long_turns_as_the_craft_does(gaps_s: float, sign: int) -> None:
    """Compared across the gaps, where it turned by more than half a turn, a true heading was taken for a disturbed one."""
    k = at(1.0, 0.2, gaps_s)
    wrapped = sign * (YAW + NOISE)[k]
    angle = np.unwrap(np.angle(np.exp(1j * wrapped)))
    assert (np.ptp(angle - wrapped) > 1.0) == (gaps_s > 0.0)  # turns are lost in the gaps
    assert against_turning(TURNING, stamps(k), angle) == sign
    assert follows_turning(TURNING, stamps(k), angle) == (sign > 0)


@pytest.mark.parametrize("gaps_s", [0.0, 20.0])
def test_a_course_of_a_craft_that_goes_astern_turns_as_it_does(gaps_s: float) -> None:
    """Half a turn off from where it goes astern, the course was compared across that: the accelerations were said to be inverted."""
    k = at(1.0, 1.0, gaps_s)
    astern = np.floor(T_S[k] / 15.0) % 2.0
    course = np.unwrap(np.angle(np.exp(1j * (YAW[k] + 3.0 * NOISE[k] + np.pi * astern))))
    assert course_against_turning(TURNING, stamps(k), course) == 1
    assert course_against_turning(Turning(0, T_S, -YAW), stamps(k), course) == -1
    sideways = YAW[k] / 5.0 + NOISE[k]  # set by the wind, while the bow comes round
    assert course_against_turning(TURNING, stamps(k), sideways) == 0
    assert left_of_turns(TURNING, stamps(k), course) < 0.05
    assert left_of_turns(Turning(0, T_S, -YAW), stamps(k), course) > 1.0


@pytest.mark.parametrize(
    ("mounted_deg", "astern", "found_deg", "share"),
    [
        (0.0, 0.45, 0.0, 0.45),
        (180.0, 0.3, 180.0, 0.3),
        (-100.0, 0.3, -100.0, 0.3),
        (90.0, 0.3, 90.0, 0.3),
        (0.0, 0.0, 0.0, 0.0),
    ],
)
def test_a_heading_is_mounted_as_most_courses_say(
    mounted_deg: float, astern: float, found_deg: float, share: float
) -> None:
    """Half a turn off on some courses: of two that are alike, the one nearer to the bow."""
    legs = np.arange(1000) % 100 < 100 * astern
    apart = np.radians(mounted_deg) + np.pi * legs + 0.05 * np.random.default_rng(2).standard_normal(1000)
    offset_deg, scatter_deg, told = _beside_either_way(np.asarray(wrap_angle(apart)))
    assert abs(wrap_angle(np.radians(offset_deg - found_deg))) < np.radians(1.0)
    assert told == pytest.approx(share)
    assert scatter_deg < 5.0


def test_a_heading_that_leaps_is_none() -> None:
    """Half a turn off now and then is no craft that turns back."""
    leaps = np.random.default_rng(3).random(1000) < 0.3
    assert _beside_either_way(np.where(leaps, np.pi, 0.0))[2] == 0.0


def test_an_angle_that_has_nothing_to_do_with_the_craft_tells_nothing() -> None:
    k = at(1.0, 0.2, 0.0)
    stray = np.cumsum(0.1 * np.random.default_rng(1).standard_normal(len(k)))
    assert against_turning(TURNING, stamps(k), stray) == 0
    assert not follows_turning(TURNING, stamps(k), stray)
