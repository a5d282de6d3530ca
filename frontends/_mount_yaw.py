# SPDX-License-Identifier: Apache-2.0
"""Yaw of an IMU's mount in the vessel, from its accelerations and the vessel's motion.

Levelled, with unknown yaw psi, the horizontal acceleration as complex number a = ax + i ay relates to that of the vessel, m,
forward + i to port, by m = exp(i psi) a. So psi = arg sum(conj(a) m), and |sum| / sqrt(sum |a|^2 sum |m|^2) is the coherence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Slerp

from graphloc.frames import Array, wrap_angle
from graphloc.frontends._assess import MeasuredMotion
from graphloc.frontends.turning import Turning
from graphloc.signals.series import integral
from graphloc.time import NS_PER_S

# Half the time over which an acceleration is asked: short, a car's fits best; longer, waves and the noise of fixes are less.
HALF_S = (0.5, 1.0, 2.0, 4.0)
_TIPS_S = 0.25  # half the time over which a roll or pitch is asked
STEP_S = 0.5  # between two times at which it is asked
FEWEST, MOVES_M = 20, 1.0  # windows; a shorter way has no direction
_MIN_COHERENCE, _CLEAR = 0.25, 4.0  # and so many times what chance gives
_LIKELY_COHERENCE, _LIKELY = 0.5, 3.0  # the same, to choose between quarter turns: chance gives it once in 8000
_HINT = 2.0  # the same, to leave a sensor where it is: chance gives it once in 200
_WAVES_S = 20.0  # the longest that tilt it
_NEARLY = 0.9  # as long as from one measurement to the next, whose stamps may be uneven
_AS_COHERENT = 0.9  # at least as the best, nearly: others are full of waves
_DIFFERS_DEG = 22.5  # of two that are as far off to either side, one is nearer to another quarter turn
_ASTRAY_DEG = 30.0  # leeway, or an antenna far ahead, make less


@dataclass(frozen=True, slots=True)
class YawInCraft:
    """The turn from the craft's forward to the sensor's x, to port, deg; how clear it is, 0 to 1, and what chance makes.

    `differs_deg`: by how much other motions, or accelerations over other times, have it otherwise, where they are as coherent.
    """

    source: str
    yaw_deg: float
    coherence: float
    chance: float
    differs_deg: float = 0.0

    @property
    def agrees(self) -> bool:
        """Whether the others have it alike, nearly: of a craft that often goes sideways they do not, and its courses tell no quarter turn."""
        return self.differs_deg < _DIFFERS_DEG

    @property
    def clear(self) -> bool:
        """Whether chance would not have it."""
        return self.agrees and self.coherence >= max(_MIN_COHERENCE, _CLEAR * self.chance)

    @property
    def likely(self) -> bool:
        """Whether it tells which quarter turn is the likeliest."""
        return self.agrees and self.coherence >= max(_LIKELY_COHERENCE, _LIKELY * self.chance)

    @property
    def hints(self) -> bool:
        """Whether chance seldom has it: not enough to turn a sensor by, but to leave it where it is."""
        return self.coherence >= _HINT * self.chance

    @property
    def sigma_deg(self) -> float:
        """1 sigma of the turn, of a phase of so many windows."""
        return float(np.degrees(self.chance * np.sqrt(0.5 * (1.0 - self.coherence**2)) / self.coherence))

    @property
    def error_deg(self) -> float:
        """1 sigma of the turn, as a mount: waves last for many windows, and swing the antenna as well: windows of another length show it."""
        return float(np.hypot(self.sigma_deg, self.differs_deg))

    @property
    def astray(self) -> bool:
        """Whether a sensor that should not be turned is, clearly."""
        return self.clear and abs(self.yaw_deg) > max(_ASTRAY_DEG, _CLEAR * self.sigma_deg)

    @property
    def said(self) -> str:
        """What is astray, in words."""
        return (
            f"what it feels fits how {self.source} moves only turned by {self.yaw_deg:+.0f} deg about the vertical, to port "
            f"(coherence {self.coherence:.2f})"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Felt:
    """Motion by a levelled IMU: times (N,), s since `origin_ns`, angle turned, rad, and the double integral of its acceleration.

    The latter is (N,) m, x + i y, in the axes at the begin; in these, too, what a place a metre above the IMU moves by as the craft
    rolls and pitches, `swing_m` (N,).
    """

    origin_ns: int
    t_s: Array
    turned: Array
    way_m: NDArray[np.complex128]
    swing_m: NDArray[np.complex128]

    @classmethod
    def of(cls, stamps_ns: NDArray[np.int64], accel: Array, gyro: Array, gravity_mps2: float = 0.0) -> Felt:
        """Of samples: stamps (N,), increasing; accelerations (N, 3) m/s^2 and rates (N, 3) rad/s, levelled.

        Args:
            gravity_mps2: what of gravity waves tilt into the horizontal is taken out; 0: nothing.
        """
        t = (stamps_ns - stamps_ns[0]) / NS_PER_S
        turned = integral(t, gyro[:, 2])
        a = accel[:, 0] + 1j * accel[:, 1]
        a = a - np.median(a.real) - 1j * np.median(a.imag)
        swing = integral(t, (gyro[:, 1] - 1j * gyro[:, 0]) * np.exp(1j * turned))
        # Tilted ahead, an accelerometer feels gravity astern. What lasts longer than waves the gyroscope does not know.
        step_s = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
        lately = max(1, round(_WAVES_S / max(step_s, 1e-3)))
        tilt = swing - uniform_filter1d(swing, lately)
        moved = a * np.exp(1j * turned) + gravity_mps2 * tilt
        return cls(int(stamps_ns[0]), t, turned, integral(t, integral(t, moved)), swing)

    @property
    def turning(self) -> Turning:
        """How it turned, alone."""
        return Turning(self.origin_ns, self.t_s, self.turned)

    def times_of(self, motion: MeasuredMotion) -> Array:
        """A motion's times (M,) as these are counted, s."""
        return np.asarray(motion.t_s + (motion.origin_ns - self.origin_ns) / NS_PER_S)


def yaw_in_craft(
    stamps_ns: NDArray[np.int64], accel: Array, gyro: Array, motions: Sequence[MeasuredMotion]
) -> YawInCraft | None:
    """Return the clearest estimate over all motions and window lengths; None if no motion is long enough.

    Args:
        stamps_ns: (N,), increasing. accel, gyro: (N, 3) m/s^2, rad/s, levelled.
    """
    felt = Felt.of(stamps_ns, accel, gyro)
    tipped = [found for motion in motions if (found := _yaw_by_tipping(felt, gyro, motion)) and found.clear]
    tried = tipped or [
        found for motion in motions for half_s in windows_of(motion) if (found := _yaw_by(felt, motion, half_s))
    ]
    if not tried:
        return None
    best = max(tried, key=lambda found: found.coherence / found.chance)
    as_coherent = [found for found in tried if found.clear and found.coherence > _AS_COHERENT * best.coherence]
    others = np.radians([found.yaw_deg - best.yaw_deg for found in as_coherent])
    return replace(best, differs_deg=float(np.degrees(np.abs(wrap_angle(others)).max(initial=0.0))))


def windows_of(motion: MeasuredMotion) -> tuple[float, ...]:
    """Return half the times, s, over which a motion is asked for its acceleration: none shorter than from one measurement to the next.

    Between these it is a straight line, which has no acceleration; asked there, few windows count as many, and what they say as clear.
    """
    apart_s = float(np.median(np.diff(motion.t_s))) if len(motion.t_s) > 1 else 0.0
    return tuple(half_s for half_s in HALF_S if half_s >= _NEARLY * apart_s) or (apart_s,)


def unbroken(times_s: Array, middle_s: Array, half_s: float) -> NDArray[np.bool_]:
    """Return of which windows (N,) no part lies in a gap of the measurements that is longer than `windows_of` would have it.

    Across a tunnel a straight line tells nothing of how the craft moved, and as it changes at both ends it fits some motion at some lag.
    """
    apart_s = np.diff(times_s)
    gap = np.flatnonzero(apart_s > max(half_s / _NEARLY, 2.0 * float(np.median(apart_s))))  # no jitter of a slow sensor
    begins, ends = np.append(times_s[gap], np.inf), np.append(times_s[gap + 1], np.inf)
    return np.asarray(begins[np.searchsorted(ends, middle_s - half_s, side="right")] >= middle_s + half_s)


def _yaw_by(felt: Felt, motion: MeasuredMotion, half_s: float) -> YawInCraft | None:
    """Return the estimate by one motion and one window length.

    Of positions p, p(t + h) - 2 p(t) + p(t - h) gives the mean acceleration about t, and p(t + h) - p(t - h) the course; the
    sensor gives the same in its own axes at t. h: `half_s`. Poses tell where the craft heads, whatever its course.
    """
    t, at = felt.t_s, felt.times_of(motion)
    there = np.interp(at, t, felt.turned)
    way = integral(at, motion.speed_mps * np.exp(1j * there)) if motion.way_m is None else motion.way_m
    middle = np.arange(max(t[0], at[0]) + half_s, min(t[-1], at[-1]) - half_s, STEP_S)
    (moved, chord), (f, _) = bent(at, way, middle, half_s), bent(t, felt.way_m, middle, half_s)
    faced = np.exp(1j * np.interp(middle, t, felt.turned))
    good = unbroken(at, middle, half_s) & (motion.attitude is not None or np.abs(chord) > MOVES_M)
    windows = good.sum() * STEP_S / half_s
    if windows < FEWEST:
        return None
    if motion.attitude is not None:
        heads = np.exp(1j * np.interp(middle, at, np.unwrap(motion.attitude.as_euler("ZYX")[:, 0])))
    else:
        heads = faced if motion.way_m is None else chord / np.maximum(np.abs(chord), MOVES_M)
    m, f = (moved * np.conj(heads))[good], (f * np.conj(faced))[good]
    return _turn_between(motion.source, f, m, windows)


def _yaw_by_tipping(felt: Felt, gyro: Array, motion: MeasuredMotion) -> YawInCraft | None:
    """Return the estimate by how the craft rolls and pitches, by its attitude and by the gyroscope (N, 3), levelled; None of too few.

    A multirotor leans into its accelerations, so that it feels none along its deck: only its rates tell how a sensor sits.
    """
    t, at = felt.t_s, felt.times_of(motion)
    middle = np.arange(max(t[0], at[0]) + _TIPS_S, min(t[-1], at[-1]) - _TIPS_S, 2.0 * _TIPS_S)
    if motion.attitude is None or len(middle) < FEWEST:
        return None
    attitude = Slerp(at, motion.attitude)
    before, after = (attitude(np.clip(middle + h, at[0], at[-1])) for h in (-_TIPS_S, _TIPS_S))
    theirs = (before.inv() * after).as_rotvec()
    tips = integral(t, gyro[:, 0] + 1j * gyro[:, 1])
    ours = np.interp(middle + _TIPS_S, t, tips) - np.interp(middle - _TIPS_S, t, tips)
    return _turn_between(motion.source, ours, theirs[:, 0] + 1j * theirs[:, 1], float(len(middle)))


def _turn_between(source: str, f: NDArray[np.complex128], m: NDArray[np.complex128], windows: float) -> YawInCraft:
    """Return the turn from what the craft did, m, to what the sensor felt, f, in its own axes, by so many independent windows."""
    m, f = m - m.mean(), f - f.mean()
    power = float(np.sqrt((np.abs(f) ** 2).sum() * (np.abs(m) ** 2).sum()))
    product = complex((np.conj(f) * m).sum())
    coherence = abs(product) / power if power > 0.0 else 0.0
    psi = float(np.degrees(np.angle(product)))
    return YawInCraft(source, psi, max(coherence, 1e-6), 1.0 / float(np.sqrt(windows)))


def bent(
    times_s: Array, places: NDArray[np.complex128], middle_s: Array, half_s: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the second difference of positions about some times, and the first difference over twice the time."""
    behind, here, ahead = (np.interp(middle_s + k * half_s, times_s, places) for k in (-1, 0, 1))
    return ahead - 2.0 * here + behind, ahead - behind
