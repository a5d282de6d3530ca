# SPDX-License-Identifier: Apache-2.0
"""Time offsets of headings by the gyroscope, and of positions and velocities by the accelerometer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import stdtrit

from graphloc.frames import Array
from graphloc.frontends._assess import MeasuredMotion
from graphloc.frontends._clock import (
    FARTHEST_LATE_S,
    MOST_LATE_S,
    MOST_ON_ITS_WAY_S,
    most_early_s,
    usual_latency_s,
)
from graphloc.frontends._mount_yaw import FEWEST, MOVES_M, STEP_S, Felt, bent, middles_of, unbroken, windows_of
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends._turns import without_line
from graphloc.frontends.turning import Turning
from graphloc.signals.series import integral
from graphloc.time import NS_PER_S

_BLOCK_S = 20.0  # duration of a block, in which gyro bias and deviation hardly change, see `heading_time_offset`
_CLEAR, _HINT, _LEAST_S = 4.0, 2.0, 0.02  # sigmas of a clear and of a hinted offset; least clear offset
_BY_CHANCE = 5e-3  # probability by Student's t, where few blocks may agree by chance
_APART_S, _LEAST_OF_WAY_S = 0.05, 0.1  # steps of the lags that are tried; least offset of a motion that counts
_STEPS = 3  # iterations, enough for an offset of a second in the sharpest turns
_HIGH_M = 10.0  # 1 sigma of the height of an antenna above the IMU
_CHORD_S = 2.0  # half the duration of a chord of fixes, and of a velocity's integral


def heading_time_offset(turning: Turning, stamps_ns: NDArray[np.int64], angle: Array) -> tuple[float, float] | None:
    """Return what should be added to the stamps of headings, s, and its sigma; None if the gyroscope does not show it.

    If stamps are off by dt, heading minus the integral of the rate w is w dt, as long as w hardly changes within dt.
    Hence the step is iterated. Within twenty seconds gyro bias, compass offset and magnetic deviation hardly change, so
    a straight line per block removes them.

    Args:
        turning: the integrated gyroscope. stamps_ns: (N,), increasing. angle: (N,) headings, rad, counter-clockwise,
            unwrapped.
    """
    at_s = (stamps_ns - turning.origin_ns) / NS_PER_S
    value_s, sigma_s, clear = 0.0, 0.0, _CLEAR
    for _ in range(_STEPS):
        step = _heading_step(turning, at_s + value_s, angle)
        if step is None:
            return None
        value_s, sigma_s, blocks = value_s + step[0], *step[1:]
        clear = max(_CLEAR, -float(stdtrit(blocks - 1, _BY_CHANCE / 2.0)))
        if abs(value_s) > MOST_LATE_S:
            return None
    return (value_s, sigma_s) if abs(value_s) > max(clear * sigma_s, _LEAST_S) else None


def _heading_step(turning: Turning, at: Array, angle: Array) -> tuple[float, float, int] | None:
    """Return what should be added to the times of headings, s, to first order, its sigma, and the number of blocks.

    Args:
        at: (N,) times, s since the origin of `turning`. angle: (N,), rad.
    """
    inside = (at > turning.t_s[0] + 1.0) & (at < turning.t_s[-1] - 1.0)
    at, angle = at[inside], angle[inside]
    if len(at) < 50:
        return None
    turned = np.interp(at, turning.t_s, turning.turned_rad)
    rate = (
        np.interp(at + 0.1, turning.t_s, turning.turned_rad) - np.interp(at - 0.1, turning.t_s, turning.turned_rad)
    ) / 0.2
    found = []
    for k in range(int((at[-1] - at[0]) // _BLOCK_S) + 1):
        own = (at - at[0]) // _BLOCK_S == k
        if own.sum() >= 10:
            w, ahead = (without_line(v[own], at[own], turned[own]) for v in (rate, angle - turned))
            found.append((float(w @ ahead), float(w @ w)))
    if len(found) < 3:
        return None
    up, down = np.array(found).T
    if down.sum() <= 0.0 or down.max() > 0.9 * down.sum():
        return None
    value = float(up.sum() / down.sum())
    without = (up.sum() - up) / (down.sum() - down)
    return value, float(np.sqrt((len(up) - 1) / len(up) * ((without - without.mean()) ** 2).sum())), len(up)


class _Windows(NamedTuple):
    """Windows of one duration in which a motion is compared with what is felt.

    Attributes:
        windows: number of independent windows.
        along: (N,) acceleration of the motion along its course, times the square of half the duration, m.
        begun: (B,) index of the first window of each block. second, first: matrices of `_bending`.
    """

    windows: float
    along: Array
    begun: NDArray[np.int64]
    second: Any
    first: Any


class MotionOffset(NamedTuple):
    """What should be added to the stamps of a motion, s; its 1 sigma; whether it is clearly better than no offset."""

    value_s: float
    sigma_s: float
    clear: bool

    @property
    def hinted(self) -> bool:
        """Whether it is likelier than no offset, though not clearly: over two sigmas, no more than a message's way."""
        return not self.clear and max(_HINT * self.sigma_s, _LEAST_OF_WAY_S) < abs(self.value_s) <= MOST_ON_ITS_WAY_S

    def denies(self, other: MotionOffset) -> bool:
        """Return whether another offset is so different that it cannot be of the same clock."""
        apart_s = abs(other.value_s - self.value_s)
        return apart_s > max(_CLEAR * float(np.hypot(self.sigma_s, other.sigma_s)), _LEAST_OF_WAY_S)

    def is_of(self, fixes: MeasuredMotion | None, velocity: MeasuredMotion) -> bool:
        """Return whether this offset of a receiver's velocity holds for its fixes, too.

        Else a filter delays the velocity alone. It is told by the delay between velocity and fixes; if that is unclear,
        the offset must be no more than a message's way.
        """
        beside = None if fixes is None else later_than(fixes, velocity)
        if beside is None or abs(self.value_s) < _CLEAR * beside[1]:
            return abs(self.value_s) <= MOST_ON_ITS_WAY_S
        return abs(beside[0]) < 0.5 * abs(self.value_s)


def motion_time_offsets(
    felt: Felt, imu: TopicData, motions: Sequence[MeasuredMotion], streams: Mapping[str, TopicData]
) -> dict[str, MotionOffset | None]:
    """Return `motion_time_offset` by source, none so large that messages were recorded before they were measured.

    Args:
        felt: of the IMU. imu: its stream. motions: of the sources. streams: by topic, on one clock.
    """
    imu_s = usual_latency_s(imu.stamps_ns, imu.logs_ns)
    # Recording times that are copies of the stamps tell nothing.
    copied = not imu.recorded and np.array_equal(imu.stamps_ns, imu.logs_ns)

    def most_s(motion: MeasuredMotion) -> float:
        own = streams.get(motion.source)
        if own is None or copied:
            return FARTHEST_LATE_S
        return most_early_s(usual_latency_s(own.stamps_ns, own.logs_ns), imu_s)

    return {motion.source: motion_time_offset(felt, motion, most_s(motion)) for motion in motions}


def motion_time_offset(felt: Felt, motion: MeasuredMotion, most_s: float = FARTHEST_LATE_S) -> MotionOffset | None:
    """Return by how much the stamps of a motion are off, by the accelerometer; None if it does not show that.

    Only accelerations along the course count: across it, an antenna ahead of the IMU looks like an early stamp. The
    course is the direction of a chord of the motion. What is felt is taken along a chord, too, of the same speeds and
    the turns of the gyroscope: in a turn where the craft brakes, heading and chord differ, and what it feels across
    would look like a delay. Pitch swings a high antenna along the course, so its height (0 m, give or take ten) is
    estimated with the offset: c is the correlation with what is felt and that swing together. With c at the best offset
    and c0 at none, N (c^2 - c0^2) / (1 - c^2) is the gain in chi-square over N windows. Of the windows' durations the one
    counts whose best offset explains most, by -N log(1 - c^2) / 2: in windows that average the motion out, what is left
    fits some offset by chance, and may deny a delay of none the most.

    Args:
        felt: of an IMU, in the axes of the vessel. motion: positions, or a velocity over ground.
        most_s: largest offset that can be right. A larger one may fit better by chance, as heel is felt as
            acceleration.
    """
    if motion.way_m is None:
        return None
    at = felt.times_of(motion)
    # If the right offset lies beyond the lags that are tried, a lesser peak of the same motion seems clear instead.
    lags = np.arange(-FARTHEST_LATE_S, min(most_s, FARTHEST_LATE_S) + 0.5 * _APART_S, _APART_S)
    lengths = list[_Windows]()
    for half_s in windows_of(motion):
        middle = middles_of(felt.t_s, at, half_s + FARTHEST_LATE_S)
        moved, chord = bent(at, motion.way_m, middle, half_s)
        good = (np.abs(chord) > MOVES_M) & unbroken(at, middle, half_s)
        windows = float(good.sum() * STEP_S / half_s)
        if windows < FEWEST:
            continue
        middle = middle[good]
        along = (moved * np.conj(chord / np.maximum(np.abs(chord), MOVES_M)))[good].real
        block = (middle - middle[0]) // _BLOCK_S
        begun = np.flatnonzero(np.diff(block, prepend=-1.0))
        lengths.append(_Windows(windows, along, begun, *_bending(at, middle, half_s)))
    if not lengths:
        return None
    felt_at = (_felt_along(felt, at, motion.speed_mps, lengths, lag) for lag in lags)
    sums_of = zip(*felt_at, strict=True)
    found: list[tuple[float, MotionOffset]] = []
    for own, by_lag in zip(lengths, sums_of, strict=True):
        sums = np.stack(by_lag)
        total = sums.sum(axis=1)
        whole = _best_lag(total, lags, own.windows)
        if whole is None:
            continue
        told, better, value, sigma = whole
        # A jump of the fixes is an acceleration that some lag fits by chance: a jackknife over blocks shows that.
        blocks = len(own.begun)
        if blocks > 2:
            rest = (total - sums[:, k] for k in range(blocks))
            without = [_best_lag(r, lags, own.windows * float(r[0, 0, 0]) / len(own.along)) for r in rest]
            values = np.array([np.inf if one is None else one.value_s for one in without])
            scatter = np.sqrt((blocks - 1) * np.var(values)) if np.isfinite(values).all() else np.inf
            sigma = max(sigma, float(scatter))
        clear = better > _CLEAR**2 and abs(value) > max(_CLEAR * sigma, _LEAST_OF_WAY_S)
        found.append((told, MotionOffset(value, sigma, clear)))
    return max(found)[1] if found else None


class _Lag(NamedTuple):
    """The best offset of the stamps of a motion.

    Attributes:
        told: by how much the log-likelihood of the motion is greater with what is felt than without.
        better: gain in chi-square over no offset. value_s, sigma_s: the offset and its sigma, s.
    """

    told: float
    better: float
    value_s: float
    sigma_s: float


def _best_lag(sums: Array, lags: Array, windows: float) -> _Lag | None:
    """Return the best offset; None if there is none.

    Args:
        sums: (L, 4, 4) of `_sums`, by lag. lags: (L,), s. windows: number of independent windows in the sums.
    """
    count, mean = sums[0, 0, 0], sums[:, 0, 1:] / sums[0, 0, 0]
    spread = sums[:, 1:, 1:] - count * mean[:, :, None] * mean[:, None]
    alone = float(_explained(spread[:, :2, :2], 0.0).max())
    held = (1.0 - alone**2) * float(spread[0, 0, 0]) / windows / _HIGH_M**2
    c = _explained(spread, held)
    k = int(c.argmax())
    bend = 0.0 if k in (0, len(c) - 1) else float(2.0 * c[k] - c[k - 1] - c[k + 1]) / _APART_S**2
    if bend <= 0.0 or c[k] <= 0.0:
        return None
    value = float(lags[k]) + float(c[k + 1] - c[k - 1]) / (2.0 * _APART_S * bend)
    left = max(1.0 - float(c[k]) ** 2, 1e-9)
    better = windows * (float(c[k]) ** 2 - float(np.interp(0.0, lags, c)) ** 2) / left
    return _Lag(-0.5 * windows * float(np.log(left)), better, value, float(np.sqrt(left / (windows * c[k] * bend))))


def later_than(fixes: MeasuredMotion, velocity: MeasuredMotion) -> tuple[float, float] | None:
    """Return by how much later than fixes a velocity shows the same motion, s, and its 1 sigma; None of few windows.

    Chords of the fixes and of the velocity's integral differ by this time, multiplied by the change of the velocity
    between the ends of the chord.
    """
    if fixes.way_m is None or velocity.way_m is None:
        return None
    at, there = fixes.t_s, velocity.t_s + (velocity.origin_ns - fixes.origin_ns) / NS_PER_S
    middle = middles_of(at, there, _CHORD_S + MOST_LATE_S)
    middle = middle[unbroken(at, middle, _CHORD_S) & unbroken(there, middle, _CHORD_S)]
    windows = len(middle) * STEP_S / _CHORD_S
    if windows < FEWEST:
        return None
    _, chord = bent(at, fixes.way_m, middle, _CHORD_S)
    said, ahead, behind = (bent(there, velocity.way_m, middle + k * STEP_S, _CHORD_S)[1] for k in (0, 1, -1))
    change = (ahead - behind) / (2.0 * STEP_S)
    power = float((np.abs(change) ** 2).mean())
    if power == 0.0:
        return None
    value = float((np.conj(change) * (chord - said)).real.mean()) / power
    left = float((np.abs(chord - said - value * change) ** 2).mean())
    return value, float(np.sqrt(0.5 * left / (power * windows)))


def _bending(at_s: Array, middle_s: Array, half_s: float) -> tuple[Any, Any]:
    """Return sparse matrices (N, M) from positions at M times to their second and first differences about N times.

    The differences are those of `bent`. The matrices are the same for all lags: a search for neighbours at each lag
    took a tenth of the time of `inspect`.

    Args:
        at_s: (M,), s. middle_s: (N,), s. half_s: half the duration of a window.
    """
    at = middle_s[:, None] + half_s * np.array([-1.0, 0.0, 1.0])
    before = np.clip(np.searchsorted(at_s, at, side="right") - 1, 0, len(at_s) - 2)
    share = (at - at_s[before]) / (at_s[before + 1] - at_s[before])
    near, share = np.stack([before, before + 1], axis=2), np.stack([1.0 - share, share], axis=2)

    def combined(times: list[float]) -> Any:
        weight, rows = share * np.array(times)[:, None], np.arange(len(middle_s) + 1) * 2 * len(times)
        return csr_array((weight.ravel(), near.ravel(), rows), shape=(len(middle_s), len(at_s)))

    return combined([1.0, -2.0, 1.0]), combined([-1.0, 0.0, 1.0])


def _felt_along(felt: Felt, at_s: Array, speed_mps: Array, lengths: Sequence[_Windows], late_s: float) -> list[Array]:
    """Return the `_sums` of windows of each duration, with the stamps of the motion later by `late_s`.

    What is felt is the sensor's own acceleration along the course. The swing is the acceleration, by pitch alone, of a
    point a metre above it. Both are multiplied by the square of half the duration.

    Args:
        felt: of the IMU. at_s, speed_mps: (M,) of the motion. lengths: windows by duration.
    """
    course = np.exp(1j * np.interp(at_s + late_s, felt.t_s, felt.turned))
    place = integral(at_s, speed_mps * course)
    # Interpolated linearly between measurements, as the motion is.
    there = np.column_stack([np.interp(at_s + late_s, felt.t_s, way) for way in (felt.way_m, felt.swing_m)])
    sums = []
    for own in lengths:
        ahead = np.exp(-1j * np.angle(own.first @ place))
        moved, swung = ((own.second @ there) * ahead[:, None]).real.T
        sums.append(_sums(own.along, moved, swung, own.begun))
    return sums


def _sums(along: Array, felt: Array, swung: Array, begun: NDArray[np.int64]) -> Array:
    """Return the sums (B, 4, 4), by block, of products of 1, an acceleration, what is felt, and a swing (N,) each.

    Means over the run are taken off the last three. `begun` (B,) are the indices at which blocks begin.
    """
    parts = np.stack([np.ones(len(along)), *(part - part.mean() for part in (along, felt, swung))])
    return np.add.reduceat(parts[:, None] * parts, begun, axis=2).transpose(2, 0, 1)


def _explained(spread: Array, held: float) -> Array:
    """Return the multiple correlation (L,) of an acceleration with what is felt and a swing.

    Where the acceleration opposes what is felt, with the swing alone: 0 there would cut into the peak of a craft that
    keeps its speed and sways, of which what is felt tells little either way.

    Args:
        spread: (L, 3, 3) sums of products of acceleration, felt and swing about their means; (L, 2, 2) without the
            swing.
        held: weight of the prior that the height is 0, added to the swing's sum of squares.
    """
    power, by = float(spread[0, 0, 0]), spread[:, 0, 1:]
    among = spread[:, 1:, 1:] + np.diag([0.0, held])[: by.shape[1], : by.shape[1]]
    share = np.einsum("lij,lj->li", np.linalg.pinv(among, hermitian=True), by)
    if power <= 0.0:
        return np.zeros(len(spread))
    alone = (by[:, 1:] ** 2).sum(axis=1) / np.maximum(among[:, 1:, 1:].sum(axis=(1, 2)), np.finfo(float).tiny)
    explained = np.where(share[:, 0] > 0.0, (share * by).sum(axis=1), alone)
    return np.asarray(np.sqrt(np.maximum(explained, 0.0) / power))
