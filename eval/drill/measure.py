# SPDX-License-Identifier: Apache-2.0
"""Errors of an estimator with a failure: how large they are, how long it takes to recover, whether its bounds hold."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphloc.chi2 import chi2_95
from graphloc.eval.drill.plan import TAIL_S, Case, DrillWindow
from graphloc.eval.metrics import squared_over_covariance
from graphloc.frames import Array, wrap_angle
from graphloc.time import NS_PER_S
from graphloc.trajectory import Trajectory

RATE_HZ = 5.0
# An estimate is near if its error is below 1 m, or below 1.5 times that of the same estimator without the failure.
NEAR_M, NORMAL_TIMES = 1.0, 1.5
# It has recovered once it is near for so long (s), and the reference lies in its 95 % bound for this share of that
# time.
HOLDS_S, HELD = 5.0, 0.9


class State(enum.StrEnum):
    """Outcome of a failure for an estimator."""

    BACK = "back"
    UNSURE = "unsure"  # near again, but outside its own 95 % bounds
    LOST = "lost"  # locked out: not near again in the time that is evaluated
    NONE = "none"  # it gave no estimate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Times:
    """Errors of an estimate relative to the reference, at times (N,).

    Attributes:
        stamps_ns: a grid of `RATE_HZ`. there: whether there is an estimate.
        off_m, off_deg: horizontal distance and difference of heading; NaN without an estimate.
        held: whether the estimate's 95 % region holds the reference.
    """

    stamps_ns: NDArray[np.int64]
    there: NDArray[np.bool_]
    off_m: Array
    off_deg: Array
    held: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Errors of one estimator with one failure at one time; `normal_*` are those without the failure.

    Attributes:
        failure, family, length_s: as of `Failure`. begin_s: of the failure, since the recording begins.
        estimator: its name. state: outcome. off_m, off_deg: largest errors, until `TAIL_S` after the failure.
        coverage: share of that time in which the 95 % region of the position holds the reference; None: no estimate.
        back_s: from the failure's end until the estimator has recovered; None: it does not.
        missing: share of the time without an estimate. why: reason that there is none.
    """

    failure: str
    family: str
    length_s: float
    begin_s: float
    estimator: str
    state: State
    off_m: float | None
    normal_m: float | None
    off_deg: float | None
    normal_deg: float | None
    coverage: float | None
    normal_coverage: float | None
    back_s: float | None
    missing: float
    why: str = ""


def compared(track: Trajectory | None, reference: Trajectory, window: DrillWindow, *, sure: bool) -> Times:
    """Return the errors of an estimate over a window.

    Args:
        track: the estimate; None: there is none.
        sure: whether the reference is truth; if not, its covariance is added to the estimate's.
    """
    count = int((window.end_ns - window.begin_ns) / NS_PER_S * RATE_HZ)
    stamps = window.begin_ns + np.rint(np.arange(count) * NS_PER_S / RATE_HZ).astype(np.int64)
    stamps = stamps[reference.covers(stamps)]
    there = np.zeros(len(stamps), dtype=bool) if track is None else track.covers(stamps)
    off_m, off_deg = np.full((2, len(stamps)), np.nan)
    held = np.zeros(len(stamps), dtype=bool)
    if track is not None and there.any():
        ours, true = track.at(stamps[there]), reference.at(stamps[there])
        error = (ours.p_world_m - true.p_world_m)[:, :2]
        assert ours.cov is not None
        cov = ours.cov[:, :2, :2] + (0.0 if sure or true.cov is None else true.cov[:, :2, :2])
        off_m[there] = np.hypot(*error.T)
        if reference.headed:
            off_deg[there] = np.degrees(np.abs(wrap_angle(ours.yaw_rad - true.yaw_rad)))
        held[there] = squared_over_covariance(error, cov) <= chi2_95(2)
    return Times(stamps_ns=stamps, there=there, off_m=off_m, off_deg=off_deg, held=held)


def judge(case: Case, estimator: str, struck: Times, normal: Times, origin_ns: int, why: str = "") -> Measured:
    """Return the errors of an estimator with a failure.

    Args:
        case, estimator: which. struck, normal: errors over one window, with the failure and without it.
        origin_ns: begin of the recording. why: reason that there is no estimate.
    """
    stamps, tail_ns = struck.stamps_ns, round(TAIL_S * NS_PER_S)
    judged = (stamps >= case.begin_ns) & (stamps < case.end_ns + tail_ns)
    usual = normal.off_m[normal.there & (stamps >= case.begin_ns)]
    near_m = max(NEAR_M, NORMAL_TIMES * float(np.percentile(usual, 95))) if len(usual) else NEAR_M
    state, back_s = _back(struck, case.end_ns, near_m)
    return Measured(
        failure=case.failure.name,
        family=case.failure.family,
        length_s=case.failure.length_s,
        begin_s=(case.begin_ns - origin_ns) / NS_PER_S,
        estimator=estimator,
        state=state if struck.there[judged].any() else State.NONE,
        off_m=_largest(struck.off_m[judged]),
        normal_m=_largest(normal.off_m[judged]),
        off_deg=_largest(struck.off_deg[judged]),
        normal_deg=_largest(normal.off_deg[judged]),
        coverage=_share(struck, judged),
        normal_coverage=_share(normal, judged),
        back_s=back_s,
        missing=1.0 - float(struck.there[judged].mean()) if judged.any() else 1.0,
        why=why,
    )


def _largest(values: Array) -> float | None:
    return None if np.isnan(values).all() else float(np.nanmax(values))


def _share(times: Times, judged: NDArray[np.bool_]) -> float | None:
    there = times.there & judged
    return float(times.held[there].mean()) if there.any() else None


def _back(times: Times, end_ns: int, near_m: float) -> tuple[State, float | None]:
    """Return whether the estimate recovers after the failure, and after how many seconds."""
    after = np.flatnonzero(times.stamps_ns >= end_ns)
    near = times.there & (np.nan_to_num(times.off_m, nan=np.inf) < near_m)
    length, was_near = round(HOLDS_S * RATE_HZ), False
    for k in after[: max(len(after) - length + 1, 0)]:
        if near[k : k + length].all():
            was_near = True
            if times.held[k : k + length].mean() >= HELD:
                return State.BACK, float((times.stamps_ns[k] - end_ns) / NS_PER_S)
    return (State.UNSURE if was_near else State.LOST), None


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """All `times` injections of a failure, for one estimator: worst errors, and number of each bad outcome."""

    failure: str
    family: str
    length_s: float
    estimator: str
    times: int
    off_m: float | None
    normal_m: float | None
    off_deg: float | None
    normal_deg: float | None
    coverage: float | None
    back_s: float | None
    unsure: int
    lost: int
    none: int


def summed(measured: Sequence[Measured]) -> tuple[Row, ...]:
    """Return a row for each failure and estimator, in order of appearance."""
    groups: dict[tuple[str, str], list[Measured]] = {}
    for m in measured:
        groups.setdefault((m.failure, m.estimator), []).append(m)
    return tuple(_row(own) for own in groups.values())


def _row(own: Sequence[Measured]) -> Row:
    def worst(name: str) -> float | None:
        values = [v for m in own if (v := getattr(m, name)) is not None]
        return max(values) if values else None

    count = {state: sum(m.state is state for m in own) for state in State}
    covered = [m.coverage for m in own if m.coverage is not None]
    first = own[0]
    return Row(
        failure=first.failure,
        family=first.family,
        length_s=first.length_s,
        estimator=first.estimator,
        times=len(own),
        off_m=worst("off_m"),
        normal_m=worst("normal_m"),
        off_deg=worst("off_deg"),
        normal_deg=worst("normal_deg"),
        coverage=float(np.mean(covered)) if covered else None,
        back_s=worst("back_s"),
        unsure=count[State.UNSURE],
        lost=count[State.LOST],
        none=count[State.NONE],
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drilled:
    """Result of a drill.

    Attributes:
        source, vessel: of the recording. truth: whether the reference is truth; if not, it is the smoother without
            failures.
        bound_m: median 95 % bound of that smoother.
        measured: errors of each estimator, failure and time. shown: errors of each estimator over time, by case.
        left: failures that were not injected, with reasons. windows: parts of the recording that were used.
        warnings: on the drill.
    """

    source: str
    vessel: str
    truth: bool
    bound_m: float
    measured: tuple[Measured, ...]
    shown: tuple[tuple[Case, dict[str, Times]], ...]
    left: tuple[tuple[str, str], ...]
    windows: tuple[DrillWindow, ...]
    warnings: tuple[str, ...] = ()

    @property
    def estimators(self) -> tuple[str, ...]:
        """Names of the estimators, in order."""
        return tuple(dict.fromkeys(m.estimator for m in self.measured))
