# SPDX-License-Identifier: Apache-2.0
"""Accuracy of an estimate against truth, held-out fixes or speed: errors, percentiles, NEES, coverage.

Errors are those of BL eq. 2.29-2.32.

The estimate is interpolated at the stamps of the truth, and not aligned to the truth. The share of stamps that it
covers (`matched`) is always reported, so that a track that covers half of a run does not look better for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from graphloc.chi2 import chi2_95
from graphloc.errors import InputError
from graphloc.eval.formatting import number
from graphloc.frames import Array, Datum, wrap_angle
from graphloc.measurements import GnssPosition, world_from_fixes
from graphloc.plain import aligned
from graphloc.recording import SpeedSeries
from graphloc.signals.series import interpolated, rms
from graphloc.solution import SlowEstimate
from graphloc.time import stamps_of, utc_text
from graphloc.trajectory import Trajectory

Levers = Mapping[str, Array]


class NoCommonTimeError(InputError):
    """An estimate and its reference have no time in common."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of numbers: title, names of columns, rows (name, values), and a note."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[float | None, ...]], ...]
    note: str = ""

    def as_dict(self) -> dict[str, dict[str, float | None]]:
        """Return the values by name of row and column."""
        return {name: dict(zip(self.columns, values, strict=True)) for name, values in self.rows}

    def told(self) -> list[tuple[str, tuple[float | None, ...]]]:
        """Return each column with its values, by row; without those that have none."""
        if not self.rows:
            return []
        values = zip(*(values for _, values in self.rows), strict=True)
        told = zip(self.columns, values, strict=True)
        return [(column, found) for column, found in told if any(value is not None for value in found)]

    def as_text(self) -> str:
        """Return the table as aligned text with a column per estimate, so that it fits a terminal."""
        cells = [["", *(name for name, _ in self.rows)]]
        cells += [[column, *map(number, values)] for column, values in self.told()]
        return "\n".join([self.title, *aligned(cells, numbers=True), *([self.note] if self.note else [])])


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthMetrics:
    """Errors against truth: horizontal position (BL eq. 2.29, 2.30) and heading (eq. 2.31, 2.32).

    `nees` is of the horizontal position: 2.0, its degrees of freedom, if the covariance is honest. `coverage_95` is the
    share of stamps at which the 95 % region holds the truth. They are None without a covariance. If the truth has no
    heading, the errors of the heading are NaN, and its coverage is None. `matched` is the share of the truth's stamps that
    the estimate covers.
    """

    position_rmse_m: float
    position_p50_m: float
    position_p95_m: float
    position_max_m: float
    error_3d_rmse_m: float | None
    heading_rmse_deg: float
    heading_max_deg: float
    nees: float | None
    coverage_95: float | None
    heading_coverage_95: float | None
    matched: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PositionErrors:
    """Errors of an estimate at the stamps of its reference that it covers.

    Attributes:
        stamps_ns: (M,). position_m: (M, 3), world. covered: share of the reference's stamps that the M are.
    """

    stamps_ns: NDArray[np.int64]
    position_m: Array
    covered: float

    @property
    def horizontal_m(self) -> Array:
        """(M,) length of the horizontal error."""
        return np.asarray(np.hypot(self.position_m[:, 0], self.position_m[:, 1]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackErrors(PositionErrors):
    """Errors against a track.

    Attributes:
        heading_rad: (M,) error of the heading; NaN if the truth has none. estimate: the estimate, interpolated at the stamps.
    """

    heading_rad: Array
    estimate: Trajectory


def common_stamps(estimate: Trajectory, truth: Trajectory) -> tuple[NDArray[np.int64], float]:
    """Return the stamps (N,) of the truth that an estimate covers, and their share of all.

    Raises:
        NoCommonTimeError: the estimate covers none.
    """
    covered = estimate.covers(truth.stamps_ns)
    if not covered.any():
        raise NoCommonTimeError(
            f"the track ({_when(estimate)}) and the truth ({_when(truth)}) share no time: check the stamps of the truth, and "
            "truth_time_offset_s"
        )
    return truth.stamps_ns[covered], float(covered.mean())


def _when(track: Trajectory) -> str:
    return " to ".join(utc_text(int(stamp)) for stamp in track.stamps_ns[[0, -1]])


def errors(estimate: Trajectory, truth: Trajectory) -> TrackErrors:
    """Return the errors of an estimate at the stamps of the truth that it covers.

    Raises:
        NoCommonTimeError: the estimate covers none.
    """
    stamps, covered = common_stamps(estimate, truth)
    there, true = estimate.at(stamps), truth.at(stamps)
    return TrackErrors(
        stamps_ns=stamps,
        position_m=there.p_world_m - true.p_world_m,
        heading_rad=wrap_angle(there.yaw_rad - true.yaw_rad) if truth.headed else np.full(len(stamps), np.nan),
        estimate=there,
        covered=covered,
    )


def squared_over_covariance(error: Array, cov: Array) -> Array:
    """Return the squared Mahalanobis norm (N,) of horizontal errors.

    Args:
        error: (N, 2 or 3) m. cov: (N, 6, 6), position first.
    """
    solved = np.linalg.solve(cov[:, :2, :2], error[:, :2, None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", error[:, :2], solved))


def compare_to_truth(estimate: Trajectory, truth: Trajectory) -> TruthMetrics:
    """Return the errors of an estimate against truth.

    Raises:
        NoCommonTimeError: the estimate covers no stamp of the truth.
    """
    off = errors(estimate, truth)
    error, heading, there, horizontal = off.position_m, off.heading_rad, off.estimate, off.horizontal_m
    nees = coverage = heading_coverage = None
    if there.cov is not None:
        squared = squared_over_covariance(error, there.cov)
        nees, coverage = float(squared.mean()), float((squared <= chi2_95(2)).mean())
        if truth.headed:
            heading_coverage = float((heading**2 <= chi2_95(1) * there.cov[:, 5, 5]).mean())
    return TruthMetrics(
        position_rmse_m=rms(horizontal),
        position_p50_m=float(np.percentile(horizontal, 50)),
        position_p95_m=float(np.percentile(horizontal, 95)),
        position_max_m=float(horizontal.max()),
        error_3d_rmse_m=None if estimate.planar else rms(np.linalg.norm(error, axis=1)),
        heading_rmse_deg=float(np.degrees(rms(heading))),
        heading_max_deg=float(np.degrees(np.abs(heading).max())),
        nees=nees,
        coverage_95=coverage,
        heading_coverage_95=heading_coverage,
        matched=off.covered,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutMetrics:
    """Errors of the predicted antenna position against held-out fixes.

    `outage_drift_m` is the RMS, over the gaps, of the largest error in each; None if the fixes do not form several
    gaps. `fix_rmse_m` is the horizontal RMSE of the fixes as predicted with the receiver's slow error; None if that is
    not estimated. `fixes` is their number, `matched` the share that the estimate covers.
    """

    horizontal_rmse_m: float
    horizontal_p95_m: float
    horizontal_max_m: float
    error_3d_rmse_m: float | None
    outage_drift_m: float | None
    fix_rmse_m: float | None
    fixes: int
    matched: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixErrors(PositionErrors):
    """Errors of a receiver's antenna at its fixes.

    Attributes:
        fixes: the M fixes that the estimate covers.
    """

    fixes: Sequence[GnssPosition]

    def predicted(self, slow: Mapping[str, SlowEstimate]) -> PositionErrors:
        """Return the errors of the fixes as predicted with the receivers' slow errors, where `slow` has them."""
        off_m, sensor = self.position_m.copy(), np.array([m.sensor for m in self.fixes])
        for name, error in slow.items():
            if not (own := sensor == name).any():  # of another kind of sensor, whose slow error has other axes
                continue
            off_m[own] += interpolated(self.stamps_ns[own], error.stamps_ns, error.value[:, :3])
        return PositionErrors(stamps_ns=self.stamps_ns, position_m=off_m, covered=self.covered)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Antennas:
    """Where the antennas of the receivers are in body, by sensor.

    Attributes:
        configured: (3,) m each, by the configuration or tf.
        off_m: by name of an estimate that estimates them: (3,) m each, from the configured place to the estimated one.
    """

    configured: Levers
    off_m: Mapping[str, Levers] = field(default_factory=dict)

    def of(self, estimate: str) -> Levers:
        """Return the antennas as an estimate has them, (3,) m each."""
        off_m = self.off_m.get(estimate, {})
        return {name: lever_m + off_m.get(name, np.zeros(3)) for name, lever_m in self.configured.items()}


def held_out_errors(estimate: Trajectory, held: Sequence[GnssPosition], datum: Datum, levers_m: Levers) -> FixErrors:
    """Return the errors of the predicted antenna position at held-out fixes.

    Args:
        levers_m: antenna of each receiver in body, (3,) m.

    Raises:
        NoCommonTimeError: the estimate covers none of the fixes.
    """
    covered = estimate.covers(stamps_of(held))
    if not covered.any():
        raise NoCommonTimeError("the track covers none of the held-out fixes")
    fixes = [m for m, there in zip(held, covered, strict=True) if there]
    stamps = stamps_of(fixes)
    p_world_m, R_world_body = estimate.poses_at(stamps)
    antenna = p_world_m + np.einsum("nij,nj->ni", R_world_body, np.array([levers_m[m.sensor] for m in fixes]))
    off_m = antenna - world_from_fixes(fixes, datum)
    return FixErrors(stamps_ns=stamps, position_m=off_m, covered=float(covered.mean()), fixes=fixes)


def receiver_errors(
    track: Trajectory, fixes: Sequence[GnssPosition], datum: Datum, levers_m: Levers
) -> PositionErrors | None:
    """Return the errors of a track at the fixes of receivers, as `held_out_errors`; None if it covers none of them."""
    return held_out_errors(track, fixes, datum, levers_m) if track.covers(stamps_of(fixes)).any() else None


def compare_to_held_out(
    estimate: Trajectory,
    held: Sequence[GnssPosition],
    datum: Datum,
    levers_m: Levers,
    slow: Mapping[str, SlowEstimate] | None = None,
) -> HeldOutMetrics:
    """Return the errors of an estimate against held-out fixes.

    Args:
        estimate, held, datum: as of `held_out_errors`. levers_m: antenna of each receiver in body, (3,) m.
        slow: slow errors that the estimate has found, by sensor; None: none.

    Raises:
        NoCommonTimeError: the estimate covers none of the fixes.
    """
    off = held_out_errors(estimate, held, datum, levers_m)
    stamps, horizontal = off.stamps_ns, off.horizontal_m
    solid = all(m.has_height for m in held)
    steps = np.diff(np.unique(stamps))
    usual = np.median(steps) if len(steps) else 1
    gap = np.cumsum(np.concatenate([[0], np.diff(stamps) > 2.5 * max(usual, 1)]))
    largest = np.array([horizontal[gap == g].max() for g in range(gap[-1] + 1)])
    predicted = None if not slow or all(m.sensor not in slow for m in held) else off.predicted(slow).horizontal_m
    return HeldOutMetrics(
        horizontal_rmse_m=rms(horizontal),
        horizontal_p95_m=float(np.percentile(horizontal, 95)),
        horizontal_max_m=float(horizontal.max()),
        error_3d_rmse_m=None if estimate.planar or not solid else rms(np.linalg.norm(off.position_m, axis=1)),
        outage_drift_m=rms(largest) if len(largest) > 1 else None,
        fix_rmse_m=None if predicted is None else rms(predicted),
        fixes=len(stamps),
        matched=off.covered,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedMetrics:
    """Forward speed of the estimate less that of a sensor that was not fused: mean, standard deviation, number."""

    mean_mps: float
    std_mps: float
    samples: int


def compare_speed(estimate: Trajectory, check: SpeedSeries) -> SpeedMetrics:
    """Compare the forward speed (along body x) with an independent one.

    Raises:
        NoCommonTimeError: the estimate covers none of its stamps. ValueError: the estimate has no velocity.
    """
    covered = estimate.covers(check.stamps_ns)
    if not covered.any():
        raise NoCommonTimeError(f"the track and {check.topic} share no time: check its stamps")
    order = np.argsort(check.stamps_ns[covered], kind="stable")
    there = estimate.at(check.stamps_ns[covered][order])
    if there.v_world_mps is None:
        raise ValueError("the estimate has no velocity")
    forward = np.einsum("ni,ni->n", there.v_world_mps, there.R_world_body[:, :, 0])
    difference = forward - check.speed_mps[covered][order]
    return SpeedMetrics(mean_mps=float(difference.mean()), std_mps=float(difference.std()), samples=len(difference))


_Named = Sequence[tuple[str, Trajectory]]


def _table(title: str, rows: Sequence[tuple[str, object]], note: str) -> Table:
    dicts = [(name, asdict(row)) for name, row in rows]  # type: ignore[call-overload]
    columns = tuple(dicts[0][1])
    return Table(title, columns, tuple((n, tuple(_measured(d[c]) for c in columns)) for n, d in dicts), note)


def _measured(value: float | None) -> float | None:
    return None if value is None or np.isnan(value) else value


def truth_table(estimates: _Named, truth: Trajectory) -> Table:
    """Return a table with a row per estimate, against truth."""
    rows = [(name, compare_to_truth(t, truth)) for name, t in estimates]
    return _table("Against truth", rows, "position: horizontal; interpolated to the truth's stamps, not aligned")


def held_out_table(
    estimates: _Named,
    held: Sequence[GnssPosition],
    datum: Datum,
    antennas: Antennas,
    slow: Mapping[str, Mapping[str, SlowEstimate]],
) -> Table:
    """Return a table with a row per estimate, against held-out fixes.

    Args:
        slow: by name of the estimate, its slow errors as for `compare_to_held_out`.
    """
    rows = [(name, compare_to_held_out(t, held, datum, antennas.of(name), slow.get(name))) for name, t in estimates]
    note = "the fixes' own noise is part of the error; gaps lack GNSS velocities, too"
    kept = {name for name, row in rows if row.fix_rmse_m is not None}
    if kept and len(kept) < len(rows):  # a row of dashes but for one
        note += f"; fix_rmse_m takes off the receiver's slow error over time, kept only by {' and '.join(sorted(kept))}"
    return _table("Against held-out fixes", rows, note)


def speed_table(estimates: _Named, check: SpeedSeries, switched_off: str) -> Table:
    """Return a table with a row per estimate, against an independent forward speed.

    Args:
        check: the speed. switched_off: name of the sensor that would have fused it, for the note; empty: there is none.
    """
    rows = [(name, compare_speed(t, check)) for name, t in estimates if t.v_world_mps is not None]
    would = (
        f"; to bridge outages by it set sensors.{switched_off}.enabled in place of check_speed_topic"
        if switched_off
        else ""
    )
    return _table("Forward speed", rows, f"estimate less {check.topic}, which was not fused{would}")
