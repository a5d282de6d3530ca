# SPDX-License-Identifier: Apache-2.0
"""Standstill of the vessel, and the bias of the gyroscope.

The bias is known from standstill, or from the difference between headings and integrated rates.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graphloc.build import Problem
from graphloc.frames import Array
from graphloc.signals.series import runs
from graphloc.time import duration_ns

_STILL_GYRO_RADPS, _STILL_ACCEL_MPS2 = 0.03, 0.3  # most spread at standstill, engine running
_STILL_SPEED_MPS = 0.15  # most speed by the fixes, besides what their noise makes: a moored vessel surges; a choice
_FEWEST_HEADINGS = 4  # fewest headings of a standstill that show a turn
_BLOCK_S, _SWELL_S = 0.5, 10.0


@dataclass(frozen=True, slots=True)
class Track:
    """Positions in world, moved from antenna to body as far as that needs no attitude.

    Attributes:
        t: (M,) s. p: (M, 3) m. sigma: (M, 3) m.
    """

    t: Array
    p: Array
    sigma: Array


def samples_of(problem: Problem, start_s: float, stop_s: float) -> tuple[Array, Array, Array]:
    """Return t (M,), s, specific force and rate (M, 3), body axes, of the IMU's samples in a span."""
    origin = problem.imu.stamps_ns[0]
    lo, hi = np.searchsorted(problem.imu.stamps_ns, [origin + duration_ns(start_s), origin + duration_ns(stop_s)])
    hi = max(int(hi), int(lo) + 2)
    t = (problem.imu.stamps_ns[lo:hi] - origin) * 1e-9
    R = problem.R_body_imu
    return t, problem.imu.accel_mps2[lo:hi] @ R.T, problem.imu.gyro_radps[lo:hi] @ R.T


def standstill(problem: Problem, track: Track, yaws: dict[str, Array]) -> tuple[float, float] | None:
    """Return the longest stretch (begin, end; s) without rotation, acceleration or vibration; None if none has 3 s."""
    span = float((problem.imu.stamps_ns[-1] - problem.imu.stamps_ns[0]) * 1e-9)
    t, f, w = samples_of(problem, 0.0, span)
    block = np.floor(t).astype(np.int64)
    start = np.searchsorted(block, np.arange(block[-1] + 2))
    quiet = [
        b - a > 3
        and bool((w[a:b].std(axis=0) < _STILL_GYRO_RADPS).all() and (f[a:b].std(axis=0) < _STILL_ACCEL_MPS2).all())
        for a, b in pairwise(start)
    ]
    best: tuple[float, float] | None = None
    for first, last in runs(np.array(quiet, dtype=bool)):
        longer = best is None or last - first > best[1] - best[0]
        if last - first >= 3 and longer and _rests(track, yaws, float(first), float(last)):
            best = (float(first), float(last))
    return best


def _rests(track: Track, yaws: dict[str, Array], first: float, last: float) -> bool:
    """Return whether positions and headings confirm that a quiet stretch is standstill, no steady motion or turn."""
    inside = (track.t >= first) & (track.t <= last)
    if inside.sum() < 4 or np.ptp(track.t[inside]) < 0.5 * (last - first):
        return False
    slope = [slope_of(track.t[inside], track.p[inside, i]) for i in range(2)]
    noise = 2.0 * float(np.nanmedian(track.sigma[inside, :2])) / float(np.ptp(track.t[inside]))
    if np.hypot(slope[0], slope[1]) > _STILL_SPEED_MPS + min(noise, 0.3):
        return False
    for rows in yaws.values():
        near = _within(rows, first, last)
        if len(near) >= _FEWEST_HEADINGS:
            noise = 3.0 * float(near[:, 2].mean()) / float(np.ptp(near[:, 0])) / np.sqrt(len(near))
            if abs(slope_of(near[:, 0], np.unwrap(near[:, 1]))) > 0.01 + noise:
                return False
    return True


def _within(rows: Array, first: float, last: float) -> Array:
    """Return the headings (M, 3) of a sensor from `first` to `last`, s."""
    return rows[(rows[:, 0] >= first) & (rows[:, 0] <= last)]


def _headed(yaws: dict[str, Array], first: float, last: float) -> bool:
    """Return whether a sensor measures the heading through a stretch, and so would show a turn."""
    found = (_within(rows, first, last) for rows in yaws.values())
    return any(len(rows) >= _FEWEST_HEADINGS and np.ptp(rows[:, 0]) > 0.5 * (last - first) for rows in found)


def slope_of(t: Array, y: Array) -> float:
    """Return the slope of y over t by Theil-Sen: the median over pairs that are far enough apart."""
    n = len(t)
    i = np.arange(n)
    j = (i + max(n // 2, 1)) % n
    dt = t[j] - t[i]
    use = np.abs(dt) > 1e-3
    return float(np.median((y[j] - y[i])[use] / dt[use])) if use.any() else 0.0


def gyro_bias(
    problem: Problem, window: float, still: tuple[float, float] | None, yaws: dict[str, Array]
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the gyroscope's bias (3,) in body axes and its sigma (3,), rad/s, and notes.

    Each axis is from standstill or from motion, whichever tells it better.

    Args:
        window: length of the first window, s. still: a standstill (begin, end), s. yaws: headings (M, 3) by sensor.
    """
    prior = problem.links.bias_sigmas()[3:]
    t, _, w = samples_of(problem, 0.0, window)
    span = float(np.ptp(t))
    mean = w.mean(axis=0)
    bias, sigma = np.zeros(3), np.array(prior)
    rate = None
    for rows in yaws.values():
        near = rows[rows[:, 0] <= window]
        if len(near) >= 8 and np.ptp(near[:, 0]) > 0.5 * window:
            rate = slope_of(near[:, 0], np.unwrap(near[:, 1]))
            # A slope from two halves of the window, with allowance for outliers and slow errors of the sensor.
            sigma[2] = min(sigma[2], 0.002 + 0.1 / np.ptp(near[:, 0]))
            bias[2] = mean[2] - rate
            break
    # Roll and pitch return to where they were (to 0.1 rad): the rest of their mean rate is bias.
    turn = abs(rate) if rate is not None else abs(mean[2])
    around = np.hypot(0.1 / span, 0.1 * turn)
    bias[:2] = np.where(around < prior[:2], mean[:2], 0.0)
    sigma[:2] = np.minimum(prior[:2], around)
    if still is not None:
        at_rest, its_sigma = _bias_at_rest(*samples_of(problem, *still)[::2], prior, turns=not _headed(yaws, *still))
        better = its_sigma < sigma
        found = np.where(better, at_rest, bias), np.where(better, its_sigma, sigma)
        return *found, (f"gyro bias from {still[1] - still[0]:.0f} s of standstill",)
    if rate is None:
        return bias, sigma, ("gyro bias about the vertical unknown at the start",)
    return bias, sigma, (f"gyro bias from {span:.0f} s of motion and heading",)


def _bias_at_rest(t: Array, w: Array, prior: Array, *, turns: bool) -> tuple[Array, Array]:
    """Return the bias (3,) and its sigma (3,), rad/s, by the rates (M, 3) of a standstill.

    Args:
        prior: (3,) sigma of the bias, rad/s.
        turns: whether the vessel may turn on the spot, because no heading says that it does not.
    """
    bias = w.mean(axis=0)
    sigma = np.minimum(w.std(axis=0) / np.sqrt(len(w)) + 3e-4 + _swell(t, w), prior)
    if turns:  # any part of the mean rate may be bias, up to what its prior allows
        half = bias[2] / 2.0
        share = prior[2] ** 2 / (prior[2] ** 2 + half**2)
        bias[2], sigma[2] = share * half, np.hypot(sigma[2], np.sqrt(share) * half)
    return bias, sigma


def _swell(t: Array, w: Array) -> Array:
    """Return how far (3,), rad/s, the mean rate of a quiet stretch may be from zero because of slow waves.

    Three quiet seconds are half a period of swell, whose rates do not average out. So the mean may be off by as much as
    means over half a second scatter, and by less only where the stretch is longer than wave periods.
    """
    block = np.floor((t - t[0]) / _BLOCK_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(block, prepend=-1))  # a gap may leave blocks empty
    means = np.add.reduceat(w, starts) / np.diff(np.append(starts, len(w)))[:, None]
    return np.asarray(means.std(axis=0) * min(1.0, float(np.sqrt(_SWELL_S / max(t[-1] - t[0], 1e-3)))))
