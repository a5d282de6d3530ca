# SPDX-License-Identifier: Apache-2.0
"""Spikes of an IMU: one or two readings that leap away and back, as with a bad cable or a driver that misreads a byte.

Integrated, one rate of 2 rad/s at 100 Hz turns the estimate by 1.1 deg for good, and no noise model expects it. A real
knock lasts longer than a spike may, or the samples beside it are as restless. At 40 Hz or less a single sample already
lasts too long, so nothing is judged.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.measurements import ImuSample
from graphloc.time import NS_PER_S, utc_text

IMU_SPIKE = "a spike: the samples before and after it agree; check cable and driver"
LONGEST = 2
"""Most samples in a row that may be one spike."""
_LEAST = np.repeat([40.0, 0.5], 3)  # m/s^2, rad/s: a smaller leap does little harm
# A leap is a step of so many times this quantile of the steps before it. A spike makes two such steps, so after four
# spikes among `_RECENT` steps the quantile is a leap itself, and the next one counts as motion, as of a robot that
# walks.
_TIMES, _QUANTILE = 5.0, 0.97
# Most, and fewest, steps before it that a step is compared with; with fewer, nothing is judged.
_RECENT, _FEWEST = 200, 40
_CALM = 2  # steps before a leap that must be usual: else the IMU rings
_BACK = 0.25  # share of a leap that may be left after it has gone back; a knock that rings leaves more
# Longest time from the sample before a spike to the one after it: knocks of a hull or a wheel last longer.
_LASTS_NS = NS_PER_S // 22


def spikes(stamps_ns: NDArray[np.int64], samples: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the samples that are spikes.

    Args:
        stamps_ns: (N,), increasing. samples: (N, 6), specific force (m/s^2) and angular rate (rad/s), axes of the IMU.
    """
    bad = np.zeros(len(samples), dtype=bool)
    leaps = (np.abs(np.diff(samples, axis=0)) > _LEAST).any(axis=1)
    for n in (np.flatnonzero(leaps) + 1).tolist():
        if bad[n] or bad[n - 1]:
            continue
        limit = _limit(samples[max(n - 1 - _RECENT, 0) : n])
        for length in range(1, LONGEST + 1):
            after = n + length
            if after >= len(samples) or stamps_ns[after] - stamps_ns[n - 1] > _LASTS_NS:
                break
            if _leaps_back(samples[n - 1], samples[n:after], samples[after], limit):
                bad[n:after] = True
                break
    return bad


def spike_warning(sensor: str, stamps_ns: NDArray[np.int64], bad: NDArray[np.bool_]) -> list[str]:
    """Return a warning on the samples `bad` (N,) that `spikes` found, or none."""
    if not bad.any():
        return []
    first = utc_text(int(stamps_ns[np.flatnonzero(bad)[0]]))
    return [f"{sensor}: {int(bad.sum())} samples rejected, the first at {first}: each is {IMU_SPIKE}"]


def _limit(recent: Array) -> Array:
    """Return how far (6,) the next reading after samples (N, 6) may step without being a leap.

    Infinite where there are too few samples, or where the last of them leapt.
    """
    if len(recent) <= _FEWEST:
        return np.full(6, np.inf)
    steps = np.abs(np.diff(recent, axis=0))
    rank = int(_QUANTILE * (len(steps) - 1))
    limit = np.maximum(_LEAST, _TIMES * np.partition(steps, rank, axis=0)[rank])
    return np.asarray(np.full(6, np.inf) if (steps[-_CALM:] > limit).any() else limit)


def _leaps_back(before: Array, held: Array, after: Array, limit: Array) -> bool:
    """Return whether samples `held` (N, 6) leap away from `before`, and `after` has gone back in all axes that leap."""
    leap = np.abs(held - before)
    leaping = (leap > limit).any(axis=0)
    back = np.abs(after - before) < _BACK * leap.min(axis=0)
    return bool(leaping.any() and (leap > limit).any(axis=1).all() and back[leaping].all())


class SpikeDetector:
    """Online counterpart of `spikes`: a sample that leaps is held back until the next ones show what it is."""

    def __init__(self) -> None:
        self._recent: deque[Array] = deque(maxlen=_RECENT + 1)
        self._newest_ns = 0
        self._held: list[tuple[ImuSample, Array]] = []

    @property
    def held_ns(self) -> int:
        """Stamp of the last sample that is held back; below all stamps if none is."""
        return self._held[-1][0].stamp_ns if self._held else -(1 << 63)

    def take(self, m: ImuSample) -> tuple[list[ImuSample], list[ImuSample]]:
        """Take in the next sample; return those that are accepted, in order, and those that were spikes."""
        row = np.concatenate([m.accel_mps2, m.gyro_radps])
        before = self._recent[-1] if self._recent else row
        if not self._held and not (np.abs(row - before) > _LEAST).any():
            return self._accepted([(m, row)]), []
        if m.stamp_ns - self._newest_ns > _LASTS_NS:
            return self._accepted([*self._held, (m, row)]), []
        limit = _limit(np.array(self._recent))
        if self._held and _leaps_back(before, np.array([r for _, r in self._held]), row, limit):
            spiked = [held for held, _ in self._held]
            self._recent.extend(r for _, r in self._held)
            return self._accepted([(m, row)]), spiked
        if len(self._held) < LONGEST and (np.abs(row - before) > limit).any():
            self._held.append((m, row))
            return [], []
        return self._accepted([*self._held, (m, row)]), []

    def let_go(self) -> list[ImuSample]:
        """Return the samples that are held back, and forget all samples."""
        held = [m for m, _ in self._held]
        self._recent.clear()
        self._held.clear()
        return held

    def _accepted(self, samples: list[tuple[ImuSample, Array]]) -> list[ImuSample]:
        self._recent.extend(row for _, row in samples)
        self._newest_ns = samples[-1][0].stamp_ns
        self._held.clear()
        return [m for m, _ in samples]
