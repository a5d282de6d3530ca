# SPDX-License-Identifier: Apache-2.0
"""Which IMU samples are taken, and in what order.

Clocks jump or are set back, samples come late, twice or with a stamp far ahead, units are wrong.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from graphloc.measurements import ImuSample, ImuSeries, Measurement
from graphloc.signals.frozen_imu import FROZEN_IMU, FrozenImuDetector
from graphloc.signals.imu_spikes import IMU_SPIKE, SpikeDetector
from graphloc.time import NS_PER_S, stamps_of

# The clock was set back where so many samples in a row lie before the newest: by more than a gap, as they may be sent again; or in
# order, among those in use where none is missing, with other readings, by so much. A driver that stamps a batch back from the time at
# which it was read overlaps the batch before by less.
_BACK, _AMONG, _AMONG_S = 50, 10, 0.15
_LATE_S = 3.0  # how late samples may come before the start
_HOLE = 0.7  # share of the IMU's period: where no sample lies so near to either side, one is missing
_FORCE_MPS2, _RATE_RADPS = (2.0, 100.0), 10.0  # limits for a vessel; readings in g or deg/s fall outside
_BEHIND, _LOST = "its stamp does not increase", "held back as it leapt, and then the clock was set back"
# For so long, and so many messages, another sensor goes on without a sample: the IMU, or its driver, is dead; one stamp may be wrong.
_SILENT_S, _TWICE = 3.0, 2
_PERIODS = 1000  # newest steps between samples, from which the IMU's period is taken


class Taken(NamedTuple):
    """What becomes of a sample, and of one that was held back until it came.

    Attributes:
        accepted: samples that are used, in order, each after the newest. dropped: samples that are not, with the
            reason.
        late: the sample itself, if its stamp lies before the newest and it is used. hole: stamps (ns) of the samples
            before and after it; None if it lies before the first.
        absurd: why it cannot be a reading of a vessel, or empty. newly_frozen: whether it is the first repetition of a
            frozen IMU.
        newly_spiked: whether a sample that was held back turned out to be a spike, the first of this IMU.
        set_back_s: by how much the IMU's clock was set back, or 0; all earlier stamps are then of another clock.
    """

    accepted: tuple[ImuSample, ...] = ()
    dropped: tuple[tuple[ImuSample, str], ...] = ()
    late: ImuSample | None = None
    hole: tuple[int, int] | None = None
    absurd: str = ""
    newly_frozen: bool = False
    newly_spiked: bool = False
    set_back_s: float = 0.0


class _Row(NamedTuple):
    """Samples in a row before the newest.

    Attributes:
        stamp_ns: of the last. back_ns: how far the first lay before the newest at most. far: how many lay farther back than a gap.
        among: how many in order lay among samples in use, where none is missing.
    """

    stamp_ns: int = 0
    back_ns: int = 0
    far: int = 0
    among: int = 0

    def with_sample(self, stamp_ns: int, back_ns: int, *, far: bool, among: bool) -> _Row:
        """Return the row with another sample."""
        in_order = self.among if stamp_ns > self.stamp_ns else 0
        return _Row(stamp_ns, max(self.back_ns, back_ns), self.far + far, in_order + among)


def series_of(samples: Sequence[ImuSample]) -> ImuSeries:
    """Return samples of one IMU as a series."""
    return ImuSeries(
        sensor=samples[0].sensor if samples else "",
        stamps_ns=stamps_of(samples),
        accel_mps2=np.array([m.accel_mps2 for m in samples]).reshape(-1, 3),
        gyro_radps=np.array([m.gyro_radps for m in samples]).reshape(-1, 3),
        seqs=np.array([m.seq for m in samples], dtype=np.int64),
    )


class ImuIntake:
    """Sorts the samples of the IMU as they arrive.

    Args:
        gap_s: longest step that is no gap. After a longer one a sample is held back: the next one shows whether its
            stamp was wrong.
        floats: whether the accelerometer always measures gravity, so that a small force is absurd.

    Attributes:
        newest: the newest sample in use. jumped: the one that is held back because its stamp lies far ahead. None:
            there is none.
    """

    def __init__(self, gap_s: float, floats: bool) -> None:
        self._gap_ns, self._floats = gap_s * 1e9, floats
        self.newest: ImuSample | None = None
        # Held back until others follow it, so that one wrong stamp does not end the estimate.
        self.jumped: ImuSample | None = None
        self._jumped_age = 0
        self._row = _Row()
        self._frozen, self._spikes = FrozenImuDetector(), SpikeDetector()
        self._spiked = False
        self._stamps: list[int] = []  # of the samples in use, in order, as far back as a late one may lie
        self._readings: dict[int, bytes] = {}  # of these samples
        self._since: dict[str, int] = {}  # by sensor, the least stamp that came since the last sample
        self._went_on: Counter[str] = Counter()  # by sensor, its messages in a row that came so long after that
        self._told_silent = False

    def accept(self, m: ImuSample) -> float:
        """Make a sample the newest; return the time (s) since the one before it."""
        before, self.newest = self.newest, m
        self._row = _Row()
        self._stamps.append(m.stamp_ns)
        self._readings[m.stamp_ns] = m.accel_mps2.tobytes()
        return 0.0 if before is None else (m.stamp_ns - before.stamp_ns) * 1e-9

    def restart(self, stamps_ns: list[int]) -> None:
        """Replace the stamps of the samples in use."""
        self._stamps = stamps_ns
        self._readings = {ns: self._readings[ns] for ns in stamps_ns if ns in self._readings}

    def forget(self, before_ns: int) -> None:
        """Forget older stamps."""
        n = bisect_left(self._stamps, before_ns)
        for stamp_ns in self._stamps[:n]:
            self._readings.pop(stamp_ns, None)
        del self._stamps[:n]

    def silent_s(self, m: Measurement) -> float:
        """Return, once in a silence of the IMU, for how long (s) another sensor has gone on without it; else 0.

        A sensor whose clock is ahead, or that sends what it has stored, has not.
        """
        since_ns = self._since[m.sensor] = min(self._since.get(m.sensor, m.stamp_ns), m.stamp_ns)
        ahead_ns = 0 if self.newest is None else m.stamp_ns - self.newest.stamp_ns
        went_on_ns = m.stamp_ns - since_ns
        goes_on = min(went_on_ns, ahead_ns) >= _SILENT_S * NS_PER_S
        self._went_on[m.sensor] = self._went_on[m.sensor] + 1 if goes_on else 0
        if self._told_silent or self._went_on[m.sensor] < _TWICE:
            return 0.0
        self._told_silent = True
        return went_on_ns / NS_PER_S

    def take(self, m: ImuSample, *, started: bool) -> Taken:
        """Decide on a sample, and on those that are held back; `started`: whether there is an estimate."""
        self._since.clear()
        self._went_on.clear()
        self._told_silent = False
        if self.newest is not None and self.newest.stamp_ns < m.stamp_ns <= self._spikes.held_ns:
            return Taken(dropped=((m, _BEHIND),))
        taken = self._in_order(m, started)
        lost = self._spikes.let_go() if taken.set_back_s else []
        accepted, spiked = list[ImuSample](), list[ImuSample]()
        for sample in taken.accepted:
            right, wrong = self._spikes.take(sample)
            accepted += right
            spiked += wrong
        already, self._spiked = self._spiked, self._spiked or bool(spiked)
        dropped = (*taken.dropped, *((held, _LOST) for held in lost), *((held, IMU_SPIKE) for held in spiked))
        return taken._replace(accepted=tuple(accepted), dropped=dropped, newly_spiked=self._spiked and not already)

    def left(self) -> list[ImuSample]:
        """Return the samples that are still held back at the end."""
        left = self._spikes.let_go() + ([] if self.jumped is None else [self.jumped])
        self.jumped = None
        return left

    def _in_order(self, m: ImuSample, started: bool) -> Taken:
        if absurd := self._absurd(m):
            return Taken(dropped=((m, absurd),), absurd=absurd)
        already = self._frozen.frozen
        if self._frozen.repeats(m):
            return Taken(dropped=((m, FROZEN_IMU),), absurd=FROZEN_IMU, newly_frozen=not already)
        newest, jumped = self.newest, self.jumped
        if newest is None:
            return Taken(accepted=(m,))
        if m.stamp_ns <= newest.stamp_ns:
            return self._before(m, newest, started)
        if jumped is not None and 0 < abs(m.stamp_ns - jumped.stamp_ns) <= self._gap_ns:
            self.jumped = None  # the clock went on from there
            return Taken(accepted=(jumped, m) if jumped.stamp_ns < m.stamp_ns else (m, jumped))
        lost = () if jumped is None else ((jumped, "its stamp jumps ahead and the next ones do not follow"),)
        if m.stamp_ns - newest.stamp_ns > self._gap_ns:
            self.jumped, self._jumped_age = m, 0
            return Taken(dropped=lost)
        if jumped is None:
            return Taken(accepted=(m,))
        self._jumped_age += 1
        if self._jumped_age < _BACK:
            return Taken(accepted=(m,))
        self.jumped = None
        return Taken(accepted=(m,), dropped=lost)

    def _absurd(self, m: ImuSample) -> str:
        """Return why a sample cannot be a reading of a vessel; empty where it can."""
        force, rate = math.sqrt(m.accel_mps2 @ m.accel_mps2), math.sqrt(m.gyro_radps @ m.gyro_radps)
        if (self._floats and force < _FORCE_MPS2[0]) or force > _FORCE_MPS2[1]:
            return f"a specific force of {force:.3g} m/s^2, impossible for a vessel: wrong unit?"
        return f"a rate of {rate:.3g} rad/s, impossible for a vessel: wrong unit?" if rate > _RATE_RADPS else ""

    def _before(self, m: ImuSample, newest: ImuSample, started: bool) -> Taken:
        """Decide on a sample with a stamp before the newest.

        It is late if a sample is missing there. Where many come that are not, the clock was set back.
        """
        stamps = self._stamps
        n = bisect_left(stamps, m.stamp_ns)
        period_ns = float(np.quantile(np.diff(stamps[-_PERIODS:]), 0.1)) if len(stamps) > 2 else np.inf
        apart_ns = min((abs(m.stamp_ns - stamp) for stamp in stamps[max(n - 1, 0) : n + 1]), default=0)
        missing = n > 0 and apart_ns >= _HOLE * period_ns
        back_ns = newest.stamp_ns - m.stamp_ns
        again = self._readings.get(m.stamp_ns) == m.accel_mps2.tobytes()
        row = self._row = self._row.with_sample(
            m.stamp_ns, back_ns, far=not missing and back_ns > self._gap_ns, among=n > 0 and not missing and not again
        )
        if row.far >= _BACK or (row.among >= _AMONG and row.back_ns >= _AMONG_S * NS_PER_S):
            self.newest = None
            return Taken(accepted=(m,), set_back_s=row.back_ns * 1e-9)
        # Before the start no period is known.
        if missing or (not started and apart_ns > 0 and back_ns < _LATE_S * 1e9):
            hole = (stamps[n - 1], stamps[n]) if n > 0 else None
            stamps.insert(n, m.stamp_ns)
            self._readings[m.stamp_ns] = m.accel_mps2.tobytes()
            return Taken(late=m, hole=hole)
        return Taken(dropped=((m, _BEHIND),))
