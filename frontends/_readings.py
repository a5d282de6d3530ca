# SPDX-License-Identifier: Apache-2.0
"""Readings of one sensor in order of arrival, and the checks of a whole run that drop some of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from graphloc.config import (
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    ImuConfig,
    SensorConfig,
    VelocityConfig,
    VesselConfig,
)
from graphloc.frames import Array
from graphloc.frontends import _clock, _fixes, _order, _sanity
from graphloc.frontends._references import Reference
from graphloc.frontends._rejections import Rejection, rejected
from graphloc.frontends._turns import SCATTERED, scattered
from graphloc.frontends.decode import Decoded, ImuReading
from graphloc.ledger import LedgerRow
from graphloc.measurements import (
    CompassHeading,
    GnssPosition,
    ImuSeries,
    Measurement,
    PoseFix,
)
from graphloc.signals.frozen_imu import FROZEN_IMU, frozen_imu_warning, frozen_samples
from graphloc.signals.imu_spikes import IMU_SPIKE, spike_warning, spikes
from graphloc.signals.repeats import REPEATED, Repeats
from graphloc.signals.thinning import THINNED, Thinning
from graphloc.time import NS_PER_S, utc_text

_Kind = TypeVar("_Kind")


@dataclass(slots=True)
class Readings:
    """Messages of one sensor, as columns of equal length.

    Attributes:
        sensor, config: its name and configuration.
        seqs: arrival numbers in the bag. stamps_ns: stamps. logs_ns: recording times. values: decoded messages.
        files: names of the files that hold the messages.
    """

    sensor: str
    config: SensorConfig
    seqs: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    logs_ns: list[int] = field(default_factory=list)
    values: list[Decoded] = field(default_factory=list)
    files: list[str] = field(default_factory=list)

    def add(self, seq: int, stamp_ns: int, log_ns: int, value: Decoded, file: str) -> None:
        """Append a reading."""
        self.files.append(file)
        self.seqs.append(seq)
        self.stamps_ns.append(stamp_ns)
        self.logs_ns.append(log_ns)
        self.values.append(value)

    def stamps(self) -> NDArray[np.int64]:
        """Return the stamps as an array."""
        return np.array(self.stamps_ns, dtype=np.int64)

    def logs(self) -> NDArray[np.int64]:
        """Return the recording times as an array."""
        return np.array(self.logs_ns, dtype=np.int64)

    def restamp(self, stamps_ns: NDArray[np.int64]) -> None:
        """Set other stamps (N,), in place."""
        self.stamps_ns[:] = stamps_ns.tolist()
        self.values[:] = [
            replace(v, stamp_ns=n) if isinstance(v, Measurement) else v
            for v, n in zip(self.values, self.stamps_ns, strict=True)
        ]

    def of(self, kind: type[_Kind]) -> list[_Kind]:
        """Return the values of a class, in order."""
        return [v for v in self.values if isinstance(v, kind)]

    def drop(self, bad: NDArray[np.bool_], rejection: Rejection) -> list[LedgerRow]:
        """Remove the readings marked in `bad` (N,), in place, and return their ledger rows."""
        rows = [self.row(self.seqs[i], self.stamps_ns[i], rejection) for i in np.flatnonzero(bad)]
        for column in self._columns() if rows else ():
            column[:] = list(compress(column, ~bad))
        return rows

    def sort(self) -> None:
        """Sort the readings by stamp."""
        order = np.argsort(self.stamps(), kind="stable").tolist()
        for column in self._columns():
            column[:] = [column[i] for i in order]

    def _columns(self) -> tuple[list[Any], ...]:
        return self.seqs, self.stamps_ns, self.logs_ns, self.values, self.files

    def row(self, seq: int, stamp_ns: int, rejection: Rejection) -> LedgerRow:
        """Return the ledger row of a message that gave no measurement."""
        return LedgerRow(
            seq=seq,
            stamp_ns=stamp_ns,
            sensor=self.sensor,
            topic=self.config.topic,
            outcome=rejection.outcome,
            reason=rejection.reason,
        )


def at_pace(sensors: Sequence[Readings], warnings: list[str]) -> None:
    """Take recording times, in place, to the pace of the stamps, where most topics say that it is another."""
    imu = next((r for r in sensors if r.config.kind == "imu" and r.stamps_ns), None)
    stamped = [r for r in sensors if r.stamps_ns and r.stamps_ns != r.logs_ns]
    others = ((r.stamps(), r.logs()) for r in stamped if r is not imu)
    pace = _clock.pace((imu.stamps(), imu.logs()), others) if imu and imu in stamped else None
    if pace is None:
        return
    warnings.append(pace.said)
    for r in sensors:
        logs_ns = pace.of_stamps(r.logs())
        if r not in stamped:
            r.restamp(logs_ns)
        r.logs_ns[:] = logs_ns.tolist()


def right_leaps(sensors: Sequence[Readings], warnings: list[str]) -> None:
    """Correct the stamps, in place, of sensors whose clock was set by whole seconds.

    Not if the IMU's clock was set as well: then it may be the same clock.
    """
    imu = next((r for r in sensors if r.config.kind == "imu" and r.stamps_ns), None)
    if imu is None or _clock.leaps(imu.stamps(), imu.logs()):
        return
    latency_s = _clock.usual_latency_s(imu.stamps(), _clock.steady_logs(imu.stamps(), imu.logs()))
    for r in (r for r in sensors if r.stamps_ns and r is not imu):
        logs_ns = _clock.steady_logs(r.stamps(), r.logs())
        stamps_ns, said = _clock.without_leaps(r.stamps(), logs_ns, latency_s, r.sensor)
        if said:
            warnings.append(said)
            r.restamp(stamps_ns)


def reject_jumps(sensors: Sequence[Readings], warnings: list[str]) -> list[LedgerRow]:
    """Drop readings whose stamps jump off the clock of their topic, or lie outside the busiest section of the run."""
    rows: list[LedgerRow] = []
    jump = rejected(f"clock jump: the stamp is over {_clock.JUMP_LIMIT_S:.0f} s off its topic's usual latency")
    for readings in sensors:
        rows += _drop(readings, _clock.clock_jumps(readings.stamps(), readings.logs()), jump, warnings)
    stamps = np.concatenate([r.stamps() for r in sensors]) if sensors else np.zeros(0, dtype=np.int64)
    if len(stamps) == 0:
        return rows
    first, last = _order.busiest_section(stamps)
    apart = rejected(
        f"outside the busiest part of the run ({utc_text(first)} to {utc_text(last)}): "
        f"no sensor says anything for over {_order.HOLE_LIMIT_S:.0f} s between"
    )
    for readings in sensors:
        rows += _drop(readings, (readings.stamps() < first) | (readings.stamps() > last), apart, warnings)
    return rows


def reject_set_back(sensors: Sequence[Readings], beside: Sequence[Reference], warnings: list[str]) -> list[LedgerRow]:
    """Keep the longest part of a run in which the IMU's clock was set back, and warn where it was.

    Parts with the same stamps would otherwise be merged. They are cut by the recording times.

    Args:
        sensors, beside: what was read of the bag; cut in place. warnings: gets the new lines.

    Raises:
        InputError: the parts overlap by recording times, too.
    """
    for imu in (r for r in sensors if r.config.kind == "imu"):
        stamps, logs = imu.stamps(), imu.logs()
        _order.refuse_woven(imu.config.topic, stamps, logs, imu.values, imu.files)
        cuts = _order.set_backs(stamps)
        if not cuts:
            continue
        edges = [0, *cuts, len(stamps)]
        longest = int(np.argmax(np.diff(edges)))
        first, last = int(logs[edges[longest]]), int(logs[edges[longest + 1] - 1])
        first, last = (first if longest else 0), (last if longest < len(cuts) else np.iinfo(np.int64).max)
        where = ", ".join(
            f"by {(stamps[k - 1] - stamps[k]) / NS_PER_S:.1f} s at {utc_text(int(logs[k]))}" for k in cuts
        )
        why = f"the clock of {imu.sensor} was set back {where}, recording time; only the longest part between is used (scans and images are not cut): split the bag there"
        rows = []
        for readings in sensors:
            outside = (readings.logs() < first) | (readings.logs() > last)
            rows += _drop(readings, outside, rejected(why), warnings)
        for item in beside:
            item.keep(first, last)
        return rows
    return []


def _drop(readings: Readings, bad: NDArray[np.bool_], rejection: Rejection, warnings: list[str]) -> list[LedgerRow]:
    rows = readings.drop(bad, rejection)
    if rows:
        warnings.append(f"{readings.sensor}: {len(rows)} messages {rejection.outcome}: {rejection.reason}")
    return rows


def imu_series(readings: Readings, warnings: list[str]) -> tuple[ImuSeries | None, list[LedgerRow]]:
    """Return the samples with strictly increasing stamps, late ones sorted in, and ledger rows of unused messages.

    Raises:
        InputError: rates or accelerations are missing, or cannot be in the configured unit.
    """
    assert isinstance(readings.config, ImuConfig)
    _even_out(readings, warnings)
    bad = ~_order.in_order_or_late(readings.stamps())
    rows = _drop(readings, bad, rejected("repeated or backward stamp"), warnings)
    readings.sort()
    rows += _drop_wrong(readings, warnings)
    samples = readings.of(ImuReading)
    if not samples:
        return None, rows
    series = ImuSeries(
        sensor=readings.sensor,
        stamps_ns=readings.stamps(),
        accel_mps2=np.array([s.accel_mps2 for s in samples]),
        gyro_radps=np.array([s.gyro_radps for s in samples]),
        seqs=np.array(readings.seqs, dtype=np.int64),
    )
    _sanity.refuse_half(readings.sensor, series.accel_mps2, series.gyro_radps, readings.config)
    _sanity.refuse_degrees(readings.sensor, series.stamps_ns, series.accel_mps2, series.gyro_radps, readings.config)
    _sanity.refuse_accel_unit(readings.sensor, series.accel_mps2, readings.config)
    warnings += _sanity.slow_warning(readings.sensor, series.stamps_ns, readings.config)
    warnings += _sanity.imu_warnings(readings.sensor, series.accel_mps2, series.gyro_radps, readings.config)
    return series, rows


def _imu_values(readings: Readings) -> Array:
    """Return accelerations and rates (N, 6); (0, 6) if there are none."""
    return np.array([(*v.accel_mps2, *v.gyro_radps) for v in readings.of(ImuReading)]).reshape(-1, 6)


def _even_out(readings: Readings, warnings: list[str]) -> None:
    """Correct the stamps of samples that were stamped in bursts, in place: they are laid out evenly."""
    stamps = readings.stamps()
    even = _order.evened(stamps, _imu_values(readings))
    if even is not stamps:
        readings.stamps_ns[:] = even.tolist()
        said = "they are laid out evenly between them; `graphloc stream` cannot do that: fix the driver"
        warnings.append(
            f"{readings.sensor}: its samples are stamped in bursts, as when a driver reads a buffer: {said}"
        )


def _drop_wrong(readings: Readings, warnings: list[str]) -> list[LedgerRow]:
    """Drop repetitions of a frozen IMU and spikes.

    The solver bridges a frozen stretch as a gap. A spike would turn or push the estimate for good.
    """
    stamps, values = readings.stamps(), _imu_values(readings)
    frozen = frozen_samples(stamps, values)
    warnings += frozen_imu_warning(readings.sensor, stamps, frozen)
    rows = readings.drop(frozen, rejected(FROZEN_IMU))
    stamps, values = stamps[~frozen], values[~frozen]
    spiked = spikes(stamps, values)
    warnings += spike_warning(readings.sensor, stamps, spiked)
    return rows + readings.drop(spiked, rejected(IMU_SPIKE))


def reject_repeats(readings: Readings) -> list[LedgerRow]:
    """Drop messages that repeat the value and the stamp of an earlier one: they are no new evidence."""
    repeats = Repeats()
    bad = [repeats.repeats(*pair) for pair in zip(readings.stamps_ns, readings.values, strict=True)]
    return readings.drop(np.array(bad, dtype=bool), rejected(REPEATED))


def judge_fixes(readings: Readings, warnings: list[str]) -> list[LedgerRow]:
    """Drop fixes that a driver only repeats, and warn of them.

    Warn, too, of truncated or uneven stamps, of missing heights, and of claimed noise that is far too small.
    """
    told = isinstance(readings.config, (GnssConfig, CompassConfig, VelocityConfig, BodyVelocityConfig))
    if told and not readings.config.takes_turns:  # else another sensor reads the fixes in its gaps
        warnings += _fixes.stamp_warning(readings.sensor, readings.stamps())
    if not isinstance(readings.config, GnssConfig):
        return []
    bad = _fixes.held(readings.of(GnssPosition))
    warnings += _fixes.held_warning(readings.sensor, bad)
    rows = readings.drop(bad, rejected("repeats the position of the previous fix under a new stamp: no new evidence"))
    fixes = readings.of(GnssPosition)
    warnings += _fixes.height_warning(readings.sensor, fixes)
    warnings += _fixes.scatter_warning(readings.sensor, fixes, readings.config)
    warnings += _fixes.uneven_warning(readings.sensor, fixes, readings.config)
    return rows


def thin(readings: Readings) -> list[LedgerRow]:
    """Drop measurements that come faster than their errors change: each costs time, and at 500 Hz memory.

    They are dropped evenly, and only if their stamps are in order.
    """
    if not readings.config.apart_ns:
        return []
    thinning = Thinning(readings.config.apart_ns)
    bad = np.array([thinning.drops(stamp_ns) for stamp_ns in readings.stamps_ns], dtype=bool)
    return readings.drop(bad, rejected(THINNED))


def reject_scattered(imu: ImuSeries | None, readings: Readings, warnings: list[str]) -> list[LedgerRow]:
    """Drop headings that are unrelated to their neighbours, see `scattered`."""
    if imu is None or not isinstance(readings.config, CompassConfig):
        return []
    bad = scattered(imu, readings.of(CompassHeading))
    return _drop(readings, bad, rejected(SCATTERED), warnings)


def reject_stored(readings: Readings, warnings: list[str]) -> list[LedgerRow]:
    """Drop the first fixes of a receiver that repeats, until it has a position, the one where it was switched off."""
    fixes = [(i, v) for i, v in enumerate(readings.values) if isinstance(v, GnssPosition)]
    fixes.sort(key=lambda pair: (pair[1].stamp_ns, pair[1].seq))
    lla = np.array([v.position for _, v in fixes]).reshape(-1, 3)
    found = _fixes.stored(np.array([v.stamp_ns for _, v in fixes], dtype=np.int64), lla)
    warnings += _fixes.stored_warning(readings.sensor, lla, found)
    bad = np.zeros(len(readings.values), dtype=bool)
    bad[[i for (i, _), old in zip(fixes, found, strict=True) if old]] = True
    return readings.drop(bad, rejected(_fixes.STORED))


def reject_far(readings: Readings, config: VesselConfig, warnings: list[str]) -> list[LedgerRow]:
    """Drop fixes that are far from all others; warn of positions that look wrong."""
    fixes = readings.of(GnssPosition)
    if not fixes:
        return []
    warnings += _sanity.gnss_warnings(readings.sensor, fixes, config)
    warnings += _fixes.radians_warning(readings.sensor, np.array([v.position for v in fixes]))
    far = rejected(f"over {_sanity.FAR_M / 1e3:.0f} km from the rest of the run")
    return _drop(readings, _sanity.far_fixes(fixes), far, warnings)


def reject_far_poses(sensors: Sequence[Readings], warnings: list[str]) -> list[LedgerRow]:
    """Drop poses far from the datum if the run has fixes, which are near it: the solver would take minutes and fail."""
    if not any(isinstance(v, GnssPosition) for readings in sensors for v in readings.values):
        return []
    rows = []
    far = rejected(
        f"over {_sanity.FAR_M / 1e3:.0f} km from the datum: its frame looks like a map grid (UTM); wanted are poses in east, north, "
        "up about `datum:`"
    )
    for readings in sensors:
        bad = [isinstance(v, PoseFix) and _sanity.far_pose(v) for v in readings.values]
        rows += _drop(readings, np.array(bad, dtype=bool), far, warnings) if any(bad) else []
    return rows
