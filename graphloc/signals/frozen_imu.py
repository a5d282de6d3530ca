# SPDX-License-Identifier: Apache-2.0
"""A frozen IMU: its driver repeats the last sample while the stamps advance.

Such samples claim standstill or a steady turn, whatever the vessel does. Real noise never repeats bit for bit in all
six axes for long, nor in the three rates for a second. A simulated IMU without noise does repeat at rest, but then its
rates are exactly zero, and such samples are accepted. Nor are rates judged by themselves where they come in steps that are
coarser than noise, rounded to two digits by a driver: at rest they repeat for minutes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.measurements import ImuSample
from graphloc.signals.series import runs
from graphloc.time import NS_PER_S, utc_text

LEAST_S, FEWEST = 0.2, 10
"""Duration (s) and number of repetitions from which a repeated sample counts as frozen. Drivers that publish faster
than they measure, and quantised readings at rest, repeat for less."""
RATES_LEAST_S, RATES_FEWEST = 1.0, 50
"""Duration (s) and number of repetitions from which repeated rates alone count as frozen: three axes repeat by chance
more easily than six."""
_COARSE_RADPS = float(np.radians(0.1))
"""Smallest change of a rate, above which it counts as coarse: a choice, between the steps of MEMS gyroscopes (2000 deg/s in 16 bits:
0.06 deg/s), which their noise exceeds, and those of '%.1f' deg/s or '%.2f' rad/s (0.57 deg/s)."""
FROZEN_IMU = "frozen: it repeats one sample (or its three rates) bit for bit while the stamps advance; check the sensor and its driver"


def frozen_samples(stamps_ns: NDArray[np.int64], samples: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the samples that a frozen IMU repeats.

    The first sample of each stretch is not in it, because it was measured.

    Args:
        stamps_ns: (N,), increasing. samples: (N, 6), specific force (m/s^2) and angular rate (rad/s), axes of the IMU.
    """
    rates = samples[:, 3:]
    frozen = _repeats(stamps_ns, samples, ~_at_rest(samples), LEAST_S, FEWEST)
    if _step_radps(rates) > _COARSE_RADPS:
        return frozen
    return frozen | _repeats(stamps_ns, rates, (rates != 0.0).any(axis=1), RATES_LEAST_S, RATES_FEWEST)


def _step_radps(rates: Array) -> float:
    """Return the smallest change of an axis from one of some rates (N, 3) to the next; inf if none changes."""
    changes = np.abs(np.diff(rates, axis=0))
    return float(changes[changes > 0.0].min(initial=np.inf))


def _repeats(
    stamps_ns: NDArray[np.int64], rows: Array, judged: NDArray[np.bool_], least_s: float, fewest: int
) -> NDArray[np.bool_]:
    """Return a mask (N,) of the rows (N, k) that repeat the first row of a long enough stretch of equal ones.

    Args:
        judged: (N,) rows that may count as repeated.
        least_s, fewest: duration (s) and number of repetitions from which a stretch is long enough.
    """
    if len(stamps_ns) == 0:
        return np.zeros(0, dtype=bool)
    first = np.concatenate([[0], np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1])
    count = np.diff(first, append=len(stamps_ns))
    lasts_s = (stamps_ns[first + count - 1] - stamps_ns[first]) / NS_PER_S
    bad = np.repeat((lasts_s >= least_s) & (count > fewest) & judged[first], count)
    bad[first] = False
    return bad


def frozen_imu_warning(sensor: str, stamps_ns: NDArray[np.int64], bad: NDArray[np.bool_]) -> list[str]:
    """Return a warning on the samples `bad` (N,) that `frozen_samples` found, or none."""
    if not bad.any():
        return []
    where = stretches(stamps_ns, bad)
    return [
        f"{sensor}: for {where} {FROZEN_IMU}; {int(bad.sum())} samples rejected, the motion there is bridged as in an IMU gap"
    ]


def stretches(stamps_ns: NDArray[np.int64], bad: NDArray[np.bool_]) -> str:
    """Return in words how many stretches of `bad` (N,) there are, how long they last, and when the longest begins."""
    first, end = runs(bad).T
    lasts_s = (stamps_ns[end - 1] - stamps_ns[first - 1]) / NS_PER_S
    longest = int(np.argmax(lasts_s))
    where = f"{lasts_s[longest]:.1f} s from {utc_text(int(stamps_ns[first[longest] - 1]))}"
    if len(first) > 1:
        return f"{len(first)} stretches, {lasts_s.sum():.1f} s in all, the longest {where}"
    return where


def _at_rest(samples: Array) -> NDArray[np.bool_]:
    """Return a mask (...) of samples (..., 6) as of a noise-free IMU at rest: a force, and all rates exactly zero."""
    return np.asarray((samples[..., 3:] == 0.0).all(axis=-1) & (samples[..., :3] != 0.0).any(axis=-1))


class FrozenImuDetector:
    """Online counterpart of `frozen_samples`: repetitions are accepted until the stretch is long enough.

    Rates count as coarse until they have once changed by less.
    """

    def __init__(self) -> None:
        self._all, self._rates = _Stretch(LEAST_S, FEWEST), _Stretch(RATES_LEAST_S, RATES_FEWEST)
        self._before: Array | None = None
        self._step_radps = np.inf  # smallest change of a rate so far
        self.frozen = False
        """Whether the newest sample is a repetition of a frozen IMU."""

    def repeats(self, m: ImuSample) -> bool:
        """Take in a sample; return whether it is a repetition of a frozen IMU."""
        row = np.concatenate([m.accel_mps2, m.gyro_radps])
        by_all = self._all.goes_on(m.stamp_ns, row) and not bool(_at_rest(row))
        if self._step_radps > _COARSE_RADPS and self._before is not None:
            self._step_radps = min(self._step_radps, _step_radps(np.stack([self._before, m.gyro_radps])))
        self._before = m.gyro_radps
        by_rates = self._rates.goes_on(m.stamp_ns, m.gyro_radps) and bool(m.gyro_radps.any())
        by_rates = by_rates and self._step_radps <= _COARSE_RADPS
        self.frozen = by_all or by_rates
        return self.frozen


class _Stretch:
    """A stretch of equal rows."""

    def __init__(self, least_s: float, fewest: int) -> None:
        self._least_ns, self._fewest = least_s * NS_PER_S, fewest
        self._first_ns, self._repeats = 0, 0
        self._row: Array | None = None

    def goes_on(self, stamp_ns: int, row: Array) -> bool:
        """Take in a row; return whether it repeats the first row of its stretch, and the stretch is long enough."""
        if stamp_ns < self._first_ns or self._row is None or (row != self._row).any():
            self._first_ns, self._row, self._repeats = stamp_ns, row, 0
            return False
        self._repeats += 1
        return self._repeats >= self._fewest and stamp_ns - self._first_ns >= self._least_ns
