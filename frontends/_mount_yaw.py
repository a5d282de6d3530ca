# SPDX-License-Identifier: Apache-2.0
"""Yaw of an IMU's mount in the vessel, from its accelerations and the vessel's motion.

Let a = ax + i ay be the horizontal acceleration in the levelled axes of the IMU, m that of the vessel, forward + i to
port, and psi the yaw of the mount. Then m = exp(i psi) a, so psi = arg sum(conj(a) m), with the coherence
|sum(conj(a) m)| / sqrt(sum |a|^2 sum |m|^2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Slerp

from graphloc.frames import Array, wrap_angle
from graphloc.frontends._assess import MeasuredMotion, one_way
from graphloc.frontends.turning import Turning
from graphloc.signals.series import integral
from graphloc.time import NS_PER_S

# Half the durations of windows for accelerations: in short ones a car's fits best; in long ones waves and the noise of
# fixes average out.
HALF_S = (0.5, 1.0, 2.0, 4.0)
_TIPS_S = 0.25  # half the duration of a window for roll and pitch
STEP_S = 0.5  # between the middles of two windows
FEWEST, MOVES_M = 20, 1.0  # least number of windows; a shorter chord has no direction
_MIN_COHERENCE, _CLEAR = 0.25, 4.0  # least coherence of a clear yaw: its value, and as a multiple of chance
_LIKELY_COHERENCE, _LIKELY = 0.5, 3.0  # the same, to choose between quarter turns: chance gives it once in 8000
_HINT = 2.0  # multiple of chance to leave a sensor unturned: chance gives it once in 200
_WAVES_S = 20.0  # period of the longest waves that tilt the vessel
_NEARLY = 0.9  # half a window is at least this share of the interval of the motion, whose stamps may be uneven
_AS_COHERENT = 0.9  # share of the best coherence from which another estimate counts: others are full of waves
_DIFFERS_DEG = 22.5  # estimates that differ by more may be nearer to different quarter turns
_ASTRAY_DEG = 30.0  # a larger yaw is astray: leeway, or an antenna far ahead, make less


@dataclass(frozen=True, slots=True)
class YawInCraft:
    """Yaw of a sensor in the craft.

    Attributes:
        source: of the motion. yaw_deg: from the craft's forward to the sensor's x, positive to port.
        coherence: how clear it is, 0 to 1. chance: the coherence that chance gives.
        one_way: whether it is by courses most of which go one way, from which leeway or a current may keep the heading.
        differs_deg: by how much the yaw differs by other motions or windows that are nearly as coherent, at most.
    """

    source: str
    yaw_deg: float
    coherence: float
    chance: float
    one_way: bool = False
    differs_deg: float = 0.0

    @property
    def agrees(self) -> bool:
        """Whether other motions and windows give nearly the same yaw.

        They do not if a craft often goes sideways: then its courses tell no quarter turn.
        """
        return self.differs_deg < _DIFFERS_DEG

    @property
    def clear(self) -> bool:
        """Whether the yaw is not by chance."""
        return self.agrees and self.coherence >= max(_MIN_COHERENCE, _CLEAR * self.chance)

    @property
    def likely(self) -> bool:
        """Whether the yaw tells which quarter turn is the likeliest."""
        return self.agrees and self.coherence >= max(_LIKELY_COHERENCE, _LIKELY * self.chance)

    @property
    def hints(self) -> bool:
        """Whether chance seldom gives the yaw: not enough to turn a sensor by it, but to leave a sensor as it is."""
        return self.coherence >= _HINT * self.chance

    @property
    def sigma_deg(self) -> float:
        """1 sigma of the yaw, deg, as the phase of independent windows."""
        return float(np.degrees(self.chance * np.sqrt(0.5 * (1.0 - self.coherence**2)) / self.coherence))

    @property
    def error_deg(self) -> float:
        """1 sigma of the yaw as a mount, deg, with the differences between windows of other durations.

        These show the effect of waves, which last for many windows, and swing the antenna as well.
        """
        return float(np.hypot(self.sigma_deg, self.differs_deg))

    @property
    def astray(self) -> bool:
        """Whether a sensor that should not be turned clearly is."""
        return self.clear and abs(self.yaw_deg) > max(_ASTRAY_DEG, _CLEAR * self.sigma_deg)

    @property
    def said(self) -> str:
        """The yaw in words, of a sensor that is astray."""
        return (
            f"what it feels fits how {self.source} moves only turned by {self.yaw_deg:+.0f} deg about the vertical, to port "
            f"(coherence {self.coherence:.2f})"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Felt:
    """Motion that a levelled IMU feels.

    Attributes:
        origin_ns, t_s: a stamp; (N,) times since then, s.
        turned: (N,) integrated yaw rate, rad.
        way_m: (N,) double integral of the acceleration, m, x + i y in the axes of the IMU at the beginning.
        swing_m: (N,) displacement, in these axes, of a point 1 m above the IMU as the craft rolls and pitches.
    """

    origin_ns: int
    t_s: Array
    turned: Array
    way_m: NDArray[np.complex128]
    swing_m: NDArray[np.complex128]

    @classmethod
    def of(cls, stamps_ns: NDArray[np.int64], accel: Array, gyro: Array, gravity_mps2: float = 0.0) -> Felt:
        """Return the motion by samples.

        Args:
            stamps_ns: (N,), increasing. accel, gyro: (N, 3), m/s^2 and rad/s, levelled.
            gravity_mps2: gravity whose part that waves tilt into the horizontal is removed; 0: nothing is removed.
        """
        t = (stamps_ns - stamps_ns[0]) / NS_PER_S
        turned = integral(t, gyro[:, 2])
        a = accel[:, 0] + 1j * accel[:, 1]
        a = a - np.median(a.real) - 1j * np.median(a.imag)
        swing = integral(t, (gyro[:, 1] - 1j * gyro[:, 0]) * np.exp(1j * turned))
        # Tilted ahead, an accelerometer feels gravity astern. Tilts that last longer than waves are lost in gyro bias.
        step_s = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
        lately = max(1, round(_WAVES_S / max(step_s, 1e-3)))
        tilt = swing - uniform_filter1d(swing, lately)
        moved = a * np.exp(1j * turned) + gravity_mps2 * tilt
        return cls(int(stamps_ns[0]), t, turned, integral(t, integral(t, moved)), swing)

    @property
    def turning(self) -> Turning:
        """The integrated yaw rate alone."""
        return Turning(self.origin_ns, self.t_s, self.turned)

    def times_of(self, motion: MeasuredMotion) -> Array:
        """Return a motion's times (M,), s since `origin_ns`."""
        return np.asarray(motion.t_s + (motion.origin_ns - self.origin_ns) / NS_PER_S)


def yaw_in_craft(
    stamps_ns: NDArray[np.int64], accel: Array, gyro: Array, motions: Sequence[MeasuredMotion]
) -> YawInCraft | None:
    """Return the clearest yaw over all motions and window durations; None if no motion is long enough.

    Args:
        stamps_ns: (N,), increasing. accel, gyro: (N, 3), m/s^2 and rad/s, levelled. motions: of the craft.
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
    # Of wheels no current tells another yaw.
    best = next((found for found in as_coherent if not found.one_way), best) if best.one_way else best
    others = np.radians([found.yaw_deg - best.yaw_deg for found in as_coherent])
    return replace(best, differs_deg=float(np.degrees(np.abs(wrap_angle(others)).max(initial=0.0))))


def windows_of(motion: MeasuredMotion) -> tuple[float, ...]:
    """Return half the durations, s, of windows for a motion's acceleration, none shorter than its measurement interval.

    Between measurements the motion is interpolated linearly, without acceleration: few windows would count as many.
    """
    apart_s = float(np.median(np.diff(motion.t_s))) if len(motion.t_s) > 1 else 0.0
    return tuple(half_s for half_s in HALF_S if half_s >= _NEARLY * apart_s) or (apart_s,)


def middles_of(one_s: Array, other_s: Array, margin_s: float, step_s: float = STEP_S) -> Array:
    """Return the middles (M,) of windows that both of two series of times cover.

    Args:
        one_s, other_s: their times, increasing. margin_s: what they must cover to either side of a middle.
    """
    return np.arange(max(one_s[0], other_s[0]) + margin_s, min(one_s[-1], other_s[-1]) - margin_s, step_s)


def unbroken(times_s: Array, middle_s: Array, half_s: float) -> NDArray[np.bool_]:
    """Return (N,) which windows do not touch a gap of the measurements that is too long for them, see `windows_of`.

    Across a tunnel the interpolation tells nothing of how the craft moved, but its bends at both ends fit some motion
    at some lag.

    Args:
        times_s: of the measurements. middle_s: (N,) of the windows. half_s: half their duration.
    """
    apart_s = np.diff(times_s)
    gap = np.flatnonzero(apart_s > max(half_s / _NEARLY, 2.0 * float(np.median(apart_s))))  # jitter is no gap
    begins, ends = np.append(times_s[gap], np.inf), np.append(times_s[gap + 1], np.inf)
    return np.asarray(begins[np.searchsorted(ends, middle_s - half_s, side="right")] >= middle_s + half_s)


def _yaw_by(felt: Felt, motion: MeasuredMotion, half_s: float) -> YawInCraft | None:
    """Return the yaw by one motion and one window duration; None of too few windows.

    With h = `half_s` and positions p, p(t + h) - 2 p(t) + p(t - h) is h^2 times the mean acceleration about t, and
    p(t + h) - p(t - h) the course. The sensor tells the acceleration in its own axes at t. A motion with an attitude
    tells the heading, whatever its course.
    """
    t, at = felt.t_s, felt.times_of(motion)
    there = np.interp(at, t, felt.turned)
    way = integral(at, motion.speed_mps * np.exp(1j * there)) if motion.way_m is None else motion.way_m
    middle = middles_of(t, at, half_s)
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
    set_off = motion.attitude is None and motion.way_m is not None and one_way(np.angle(chord[good]))
    m, f = (moved * np.conj(heads))[good], (f * np.conj(faced))[good]
    return replace(_turn_between(motion.source, f, m, windows), one_way=set_off)


def _yaw_by_tipping(felt: Felt, gyro: Array, motion: MeasuredMotion) -> YawInCraft | None:
    """Return the yaw by roll and pitch: those of the motion's attitude, and those of the levelled gyroscope (N, 3).

    None without an attitude, or of too few windows. A multirotor leans into its accelerations, so it feels none along
    its deck: only its rates tell the yaw of a sensor.
    """
    t, at = felt.t_s, felt.times_of(motion)
    middle = middles_of(t, at, _TIPS_S, 2.0 * _TIPS_S)
    if motion.attitude is None or len(middle) < FEWEST:
        return None
    attitude = Slerp(at, motion.attitude)
    before, after = (attitude(np.clip(middle + h, at[0], at[-1])) for h in (-_TIPS_S, _TIPS_S))
    theirs = (before.inv() * after).as_rotvec()
    tips = integral(t, gyro[:, 0] + 1j * gyro[:, 1])
    ours = np.interp(middle + _TIPS_S, t, tips) - np.interp(middle - _TIPS_S, t, tips)
    return _turn_between(motion.source, ours, theirs[:, 0] + 1j * theirs[:, 1], float(len(middle)))


def _turn_between(source: str, f: NDArray[np.complex128], m: NDArray[np.complex128], windows: float) -> YawInCraft:
    """Return the yaw between what the craft did, m, and what the sensor felt in its own axes, f, with its coherence.

    Args:
        source: of the motion. f, m: (N,), x + i y. windows: number of independent windows.
    """
    m, f = m - m.mean(), f - f.mean()
    power = float(np.sqrt((np.abs(f) ** 2).sum() * (np.abs(m) ** 2).sum()))
    product = complex((np.conj(f) * m).sum())
    coherence = abs(product) / power if power > 0.0 else 0.0
    psi = float(np.degrees(np.angle(product)))
    return YawInCraft(source, psi, max(coherence, 1e-6), 1.0 / float(np.sqrt(windows)))


def bent(
    times_s: Array, places: NDArray[np.complex128], middle_s: Array, half_s: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return p(t + h) - 2 p(t) + p(t - h) and p(t + h) - p(t - h) of positions p.

    Args:
        times_s, places: (N,) of p, x + i y. middle_s: (M,) times t. half_s: h.
    """
    behind, here, ahead = (np.interp(middle_s + k * half_s, times_s, places) for k in (-1, 0, 1))
    return ahead - 2.0 * here + behind, ahead - behind
