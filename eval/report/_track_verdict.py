# SPDX-License-Identifier: Apache-2.0
"""Whether one track can be trusted, with reasons; the same checks for the offline and the online track."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from graphloc.chi2 import SIGMAS_95, chi2_95
from graphloc.eval.formatting import percent
from graphloc.eval.late_check import late_doubts
from graphloc.eval.metrics import Table, errors, held_out_errors, receiver_errors, squared_over_covariance
from graphloc.eval.report._data import ReportData
from graphloc.eval.report._health import said_of, shares
from graphloc.eval.report._one_cause import one_cause
from graphloc.eval.truth_clock import clock_apart
from graphloc.frames import Array, wrap_angle
from graphloc.measurements import GnssPosition
from graphloc.signals.frozen_receiver import FROZEN
from graphloc.signals.series import rms
from graphloc.solution import CONTRADICTING_COST, Health, Solution
from graphloc.time import stamps_of
from graphloc.trajectory import Trajectory, bounds_95

# Limits of shares of a run, beyond which trust is reduced; choices.
_MOSTLY = 0.5  # least share whose health is good
_LOST = 0.05  # largest share whose health is lost
_COVERED = 0.85  # least share of the truth inside the 95 % bounds: below, these are too small
_NOT_COVERED = 0.5  # least share of the truth inside them: below, no bound can be relied on
_MATCHED = 0.95  # least share of the reference that the track covers
_STARTED = 0.8  # least share that an online track covers, whose start waits for position and heading
_TOO_SURE = 4.0  # NEES from which bounds are too small: errors are 1.4 times what the covariance says
# Least share of the time in which the online 95 % bounds hold the offline position. Honest bounds do for at least 95 %,
# as the offline track is better informed.
_HOLDS_OFFLINE = 0.9
_ALONG = "body_velocity"
_BESIDE_GNSS, _FEWEST_USED = ("pose", "aerial", "apriltag"), 10
_GUESS = 0.25  # share of a bound, above which a guess (95 %) makes a part of it that matters; a choice
# A receiver contradicts the track if half of its fixes are farther away than the larger of these:
_APART_M = 20.0  # more than any lasting multipath
_APART_SIGMAS = 5.0  # sigmas of its slow error as configured
# RMS of the changing part of an error over its constant part, below which the error counts as constant; a choice
_STAYS = 0.5
# Largest difference of the shares of the reference that two tracks cover, for their errors to be compared by a ratio;
# the online track starts seconds later.
_ALIKE = 0.1
_WORSE = 1.05  # ratio of our error to a filter's from which the filter is reported as more accurate


Row = Mapping[str, float | None]
"""Of one estimate, its numbers by name."""


class Trust(enum.IntEnum):
    """Level of trust, the highest first."""

    YES = 0
    WITH_CARE = 1
    NO = 2

    @property
    def said(self) -> str:
        """The level in words."""
        return {Trust.YES: "can be trusted", Trust.WITH_CARE: "use with care", Trust.NO: "do not rely on it"}[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reason:
    """A sentence, and the level of trust that it allows."""

    trust: Trust
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackVerdict:
    """Verdict on one track.

    Attributes:
        name: of the track. accuracy: a sentence on its error, or that none was measured.
        reasons: for and against trusting it.
    """

    name: str
    accuracy: str
    reasons: tuple[Reason, ...]

    @property
    def trust(self) -> Trust:
        """The lowest level of trust among the reasons."""
        return worst(r.trust for r in self.reasons)


def worst(of: Iterator[Trust]) -> Trust:
    """Return the lowest of some levels of trust."""
    return max(of, default=Trust.YES)


def track_verdict(data: ReportData, solution: Solution) -> TrackVerdict:
    """Return the verdict on one track of a run.

    Args:
        solution: one of `data.solutions`.
    """
    reasons = (
        *_doubted(solution), *_bounds(solution), *_switched_off(data, solution), *_coverage(data, solution), *_heading_coverage(data, solution),
        *_far_from_fixes(data, solution), *_late(data, solution), *_levers(data, solution), *_origins(data, solution),
        *_beside(data, solution), *_from_offline(data, solution), *_compared(data, solution), *_solved(data, solution),
    )  # fmt: skip
    return TrackVerdict(name=solution.name, accuracy=_accuracy(data, solution.name), reasons=reasons)


def _doubted(solution: Solution) -> Iterator[Reason]:
    """Yield what is wrong with the configuration or the recording, as no bound includes it."""
    for why in solution.doubts:
        yield Reason(trust=Trust.WITH_CARE, text=f"No bound includes this: {why.rstrip('.')}.")


def _bounds(solution: Solution) -> Iterator[Reason]:
    """Yield a sentence on the size of the 95 % bounds, and on the health."""
    assert solution.trajectory.cov is not None
    bound = float(np.percentile(bounds_95(solution.trajectory.cov)[:, 0], 95))
    called = shares(solution)
    doubtful = called.get(Health.GOOD, 0.0) < _MOSTLY or called.get(Health.LOST, 0.0) > _LOST
    yield Reason(
        trust=Trust.WITH_CARE if doubtful else Trust.YES,
        text=f"Its 95 % bound is {bound:.2f} m or less for 95 % of the run. Health: {said_of(solution)}.",
    )


def _switched_off(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield the wheels or logs that the bag has but that are switched off, where no position was measured for long."""
    called = shares(solution)
    without = called.get(Health.DEAD_RECKONING, 0.0) + called.get(Health.LOST, 0.0)
    if without <= _LOST or data.config.of_kind(_ALONG):
        return
    there = {row.topic for row in solution.ledger}
    off = [name for name, s in data.config.sensors.items() if s.kind == _ALONG and not s.enabled and s.topic in there]
    if off:
        names = " or ".join(f"sensors.{name}.enabled" for name in off)
        yield Reason(
            trust=Trust.YES,
            text=f"For {percent(without)} of the run it was by dead reckoning or lost, while a speed along the vessel was recorded, which holds the track "
            f"there: set {names}.",
        )


def _coverage(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield how often the bounds of the position held the truth."""
    covered, nees = (of(data, solution.name, column) for column in ("coverage_95", "nees"))
    if covered is None:
        return
    trust, why = Trust.YES, ""
    if covered < _COVERED and _truth_on_another_clock(data):
        trust = Trust.WITH_CARE
        why = ". That says nothing about the track: the truth is on another clock (see the warnings)"
    elif covered < _NOT_COVERED:
        trust = Trust.NO
        why = (
            _explained(data, solution)
            or ". The bounds are far too small: a mount, the datum, a clock or a noise is wrong"
        )
    elif covered < _COVERED or (nees is not None and nees > _TOO_SURE):
        trust, why = Trust.WITH_CARE, _explained(data, solution) or "; they are too small"
    beside = "" if nees is None else f" (NEES {nees:.1f}; 2 where they are honest)"
    yield Reason(trust=trust, text=f"Its 95 % bounds held the truth for {percent(covered)} of the time{beside}{why}.")


def _explained(data: ReportData, solution: Solution) -> str:
    """Return what explains most of the position error; empty if nothing simple does."""
    if data.recording.truth is None:
        return ""
    return one_cause(errors(solution.trajectory, data.recording.truth), data.config.truth_time_offset_s)


def _heading_coverage(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield how often the bounds of the heading held the truth."""
    headed = of(data, solution.name, "heading_coverage_95")
    if headed is None:
        return
    assert solution.trajectory.cov is not None
    bound_deg = float(np.median(bounds_95(solution.trajectory.cov)[:, 2]))
    off_deg, most_deg = (of(data, solution.name, f"heading_{which}_deg") for which in ("rmse", "max"))
    off = "" if off_deg is None or most_deg is None else f"; off by {off_deg:.2f} deg (RMS), {most_deg:.2f} at most"
    trust, why = Trust.YES, ""
    if headed < _COVERED:
        trust, why = Trust.WITH_CARE, "; too small, or in a run of a minute or two chance"
        if headed < _NOT_COVERED:
            why = _constant_heading(data, solution) or "; they are far too small"
        if _truth_on_another_clock(data):
            why = "; that says nothing, either"
    text = (
        f"Its heading bounds ({bound_deg:.2f} deg, median) held the truth for {percent(headed)} of the time{off}{why}."
    )
    yield Reason(trust=trust, text=text)


def _truth_on_another_clock(data: ReportData) -> bool:
    """Return whether the truth has another clock, by the run's own track: that of the online mode is noisier, and may not show it."""
    truth = data.recording.truth
    apart = None if truth is None else clock_apart(data.solution.trajectory, truth)
    return apart is not None and apart.of_clock


def _constant_heading(data: ReportData, solution: Solution) -> str:
    """Return a clause on the heading error if most of it is constant; else empty."""
    if data.recording.truth is None:
        return ""
    off = errors(solution.trajectory, data.recording.truth).heading_rad
    mean = float(np.angle(np.exp(1j * off).mean()))
    rest = rms(wrap_angle(off - mean))
    if rest >= _STAYS * abs(mean):
        return ""
    return (
        f"; all but {np.degrees(rest):.2f} deg (RMS) of that stays the same, to {'port' if mean > 0.0 else 'starboard'}: a mount, a compass or "
        "the axes of the truth"
    )


def _far_from_fixes(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield a sentence on each receiver that is far from the track for most of the run.

    Either the receiver is wrong, or what the track follows instead, as a survey or an image in a wrong place. Single
    wrong fixes and jumps that end do not count, as the graph handles them; nor do fixes of a frozen receiver, which are
    known to be wrong. If another receiver and a sensor beside GNSS agree with the track, the far receiver is the wrong
    one.
    """
    track = solution.trajectory
    frozen = {row.seq for row in solution.ledger if row.reason.startswith(FROZEN)}
    far, near = {}, []
    for name, sensor in data.config.of_kind("gnss").items():
        fixes = [m for m in data.recording.of(GnssPosition, name) if m.seq not in frozen]
        off = receiver_errors(track, fixes, solution.datum, data.antennas.of(solution.name))
        if off is None:
            continue
        half_m = float(np.median(off.horizontal_m))
        if half_m > max(_APART_M, _APART_SIGMAS * sensor.slow_error.horizontal_sigma_m):
            far[name] = half_m
        else:
            near.append(data.config.receiver_of(name))
    near = list(dict.fromkeys(near))
    if near:
        others = [name for kind in _BESIDE_GNSS for name in data.config.of_kind(kind)]
        near += [name for name in others if solution.ledger.used(name) >= _FEWEST_USED]
    for name, half_m in far.items():
        text = f"Half of the fixes of {name} are {half_m:.0f} m or more away from it"
        if len(near) > 1:
            yield Reason(
                trust=Trust.WITH_CARE, text=f"{text}, and so from {' and '.join(near)}: that receiver is wrong."
            )
        else:
            yield Reason(
                trust=Trust.NO,
                text=f"{text}: either these are wrong, or what the track follows instead (a survey, an image, the datum); this run does not "
                "tell which.",
            )


def _late(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield the stamps that calibration doubts, where that is not said of the whole run already."""
    if data.calibration is not None:
        for why in late_doubts(solution, data.config, data.calibration):
            if why not in solution.doubts:
                yield Reason(trust=Trust.WITH_CARE, text=f"{why}.")


def _levers(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield a sentence on each antenna that calibration puts elsewhere, or whose configured position is the default.

    Neither the bounds nor held-out fixes of the same receiver show such an error.
    """
    track = solution.trajectory
    if data.recording.truth is not None or track.cov is None:
        return
    bound_m = float(np.median(bounds_95(track.cov)[:, 0]))
    for name, block in data.config.of_kind("gnss").items():
        first = data.config.receiver_of(name)
        if name != first and block.mount == data.config.sensors[first].mount:
            continue  # the same antenna
        if block.mount_sigma_m == 0.0:
            yield from _lever(data, name, bound_m)
        elif not solution.stats.online:  # it is estimated, and in the bounds as far as the guess holds
            yield from _lever_not_shown(data, name, block.mount_sigma_m, bound_m)
        else:
            yield Reason(
                trust=Trust.WITH_CARE,
                text=f"Where the antenna of {name} sits is estimated (mount_sigma_m), which the bounds of the online track include to first order "
                "only. Measured, they are narrower.",
            )


def _lever_not_shown(data: ReportData, name: str, guessed_m: float, bound_m: float) -> Iterator[Reason]:
    """Yield an antenna whose place the run tells less well than it was guessed: the bounds are as good as that guess.

    Args:
        guessed_m: 1 sigma of an axis. bound_m: of the position, 95 %, median; a guess that is small beside it does not matter.
    """
    checks = data.calibration.checks if data.calibration else ()
    known_m = [c.sigma for c in checks if c.key in _level_keys(name)]
    if known_m and max(known_m) > guessed_m and SIGMAS_95 * guessed_m > _GUESS * bound_m:
        yield Reason(
            trust=Trust.WITH_CARE,
            text=f"This run hardly shows where the antenna of {name} sits (to {SIGMAS_95 * max(known_m):.2g} m, 95 %): its bounds hold if that is "
            f"within {SIGMAS_95 * guessed_m:.2g} m of mount.xyz_m, as mount_sigma_m says; beyond, the track is off by as much. Measure it.",
        )


def _level_keys(name: str) -> list[str]:
    return [f"sensors.{name}.mount.xyz_m[{axis}]" for axis in (0, 1)]


def _lever(data: ReportData, name: str, bound_m: float) -> Iterator[Reason]:
    """Yield a sentence on an antenna whose place is not estimated, if the configured one looks wrong or is the default.

    Args:
        name: of the receiver. bound_m: median 95 % bound of the position.
    """
    suggestions, checks = (data.calibration.suggestions, data.calibration.checks) if data.calibration else ((), ())
    keys = _level_keys(name)
    off_m = math.hypot(*(s.suggested - s.configured for s in suggestions if s.key in keys))
    if off_m > 0.0:
        yield Reason(
            trust=Trust.WITH_CARE if off_m > bound_m else Trust.YES,
            text=f"The antenna of {name} looks {off_m:.2f} m away from where mount.xyz_m has it, or the IMU does (Calibration, below): "
            f"the track is off by up to as much, which its bounds of {bound_m:.2f} m (median) do not include.",
        )
    elif name not in data.recording.mounts and not any(data.config.sensors[name].mount.xyz_m[:2]):
        known = [SIGMAS_95 * c.sigma for c in checks if c.key in keys]
        known_m = math.hypot(*known) if len(known) == len(keys) else None
        said = "nothing here checks that" if known_m is None else f"this run knows it to {known_m:.2g} m (95 %)"
        yield Reason(
            trust=Trust.YES if known_m is not None and known_m < bound_m else Trust.WITH_CARE,
            text=f"The antenna of {name} is taken to be at the vessel's origin (mount.xyz_m is 0, as `inspect` drafts it); where it is "
            f"not, the track is off by as much, which no bound includes; {said}.",
        )


def _origins(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield a sentence on devices left at the vessel's origin: if they sit elsewhere, the track is off by as much."""
    if data.recording.truth is not None:
        return
    for name in (*data.config.of_kind("apriltag"), *data.config.of_kind("aerial")):
        sensor = data.config.sensors[name]
        key = "cameras" if sensor.kind == "apriltag" else "lidars"
        mounts = {device: block.mount for device, block in getattr(sensor, key).items()}
        left = [f"{key}.{device}" for device, mount in mounts.items() if not mount.tf_frame and not any(mount.xyz_m)]
        if left and solution.ledger.used(name):
            yield Reason(
                trust=Trust.WITH_CARE,
                text=f"Taken to be at the vessel's origin: {', '.join(left)} of {name} (mount.xyz_m is 0, as `inspect` drafts it). Where "
                "that is not so, the track is off by as much, which no bound includes.",
            )


def _beside(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield a sentence on each filter that is more accurate, over the time that it and the track cover."""
    for filtered in data.filters:
        if filtered.name == (data.online.name if data.online else ""):
            continue
        both = _errors_of_both(data, solution, filtered.trajectory)
        if both is not None and rms(both[0]) > _WORSE * rms(both[1]):
            ours, theirs = both
            yield Reason(
                trust=Trust.WITH_CARE,
                text=f"{filtered.name} is more accurate: RMSE {rms(theirs):.2f} m, worst {theirs.max():.2f} m, against "
                f"{rms(ours):.2f} m, worst {ours.max():.2f} m, over the time that both cover.",
            )


def _errors_of_both(data: ReportData, solution: Solution, theirs: Trajectory) -> tuple[Array, Array] | None:
    """Return the horizontal errors (M,), m, of a solution and of another track at stamps that the two cover, or None.

    Without truth they are at held-out fixes, as predicted with the slow error where a track estimates it: else a filter
    would seem better because it follows a drifting receiver.
    """
    truth, ours = data.recording.truth, solution.trajectory
    if truth is not None:
        stamps = truth.stamps_ns[ours.covers(truth.stamps_ns) & theirs.covers(truth.stamps_ns)]
        if not len(stamps):
            return None
        true = truth.at(stamps).p_world_m[:, :2]
        return _away(ours.at(stamps).p_world_m[:, :2] - true), _away(theirs.at(stamps).p_world_m[:, :2] - true)
    at = stamps_of(data.held)
    held = [m for m, both in zip(data.held, ours.covers(at) & theirs.covers(at), strict=True) if both]
    if not held:
        return None
    first = held_out_errors(ours, held, data.solution.datum, data.antennas.of(solution.name)).predicted(solution.slow)
    second = held_out_errors(theirs, held, data.solution.datum, data.antennas.configured)
    return first.horizontal_m, second.horizontal_m


def _away(error: Array) -> Array:
    return np.asarray(np.hypot(error[:, 0], error[:, 1]))


def _from_offline(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield a sentence on the distance of the online track from the offline one, if there is no truth."""
    if solution is not data.online or data.recording.truth is not None:
        return
    found = errors(solution.trajectory, data.solution.trajectory)
    off, cov = found.horizontal_m, found.estimate.cov
    assert cov is not None
    placed = float(np.mean(squared_over_covariance(found.position_m, cov) <= chi2_95(2)))
    headed = float(np.mean(found.heading_rad**2 <= chi2_95(1) * cov[:, 5, 5]))
    short = min(placed, headed) < _HOLDS_OFFLINE
    trust = Trust.NO if placed < _NOT_COVERED else Trust.WITH_CARE if short else Trust.YES
    said = "; honest bounds hold it for 95 % or more, as offline knows more: these are too small" if short else ""
    yield Reason(
        trust=trust,
        text=f"It is {rms(off):.2f} m from the offline track (RMS), {off.max():.2f} m at most; its own 95 % bounds hold the "
        f"offline position for {percent(placed)} of the time, the offline heading for {percent(headed)}{said}.",
    )


def _compared(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield a sentence if accuracy was not measured, or over a part of the run only."""
    found = main_table(data)
    if found is not None and found[0].as_dict().get(solution.name, {}).get(found[1]) is None:
        yield Reason(
            trust=Trust.WITH_CARE,
            text="Its accuracy was not measured: it shares no time with what the others are measured against.",
        )
        return
    if found is None:
        text = "Its accuracy was not measured: there is neither truth nor a held-out fix."
        if solution.stats.online and data.online is None:
            text += " `graphloc compare` compares it with the offline track, which knows more."
        yield Reason(trust=Trust.WITH_CARE, text=text)
        return
    matched = of(data, solution.name, "matched")
    if matched is None or matched >= _MATCHED:
        return
    if solution.stats.online and matched >= _STARTED:
        text = (
            f"It covers {percent(matched)} of what it is compared with: it begins once position and heading are known."
        )
        yield Reason(trust=Trust.YES, text=text)
        return
    text = f"It covers only {percent(matched)} of what it is compared with; the filters may cover more."
    yield Reason(trust=Trust.WITH_CARE, text=text)


def _solved(data: ReportData, solution: Solution) -> Iterator[Reason]:
    """Yield sentences on convergence, cost and the number of warnings."""
    stats = solution.stats
    if stats.online:
        yield Reason(trust=Trust.YES, text="Online: each pose is what was known at that time.")
    elif not stats.converged:
        yield Reason(trust=Trust.NO, text="The solver did not converge: do not rely on this run.")
    else:
        ratio = stats.cost / max(stats.expected_cost, 1.0)
        trust = Trust.WITH_CARE if ratio > CONTRADICTING_COST else Trust.YES
        text = (
            f"The solver converged; cost over its expectation {ratio:.2f} (near 1 where the noise is configured right, "
            "below where it is configured too large)."
        )
        yield Reason(trust=trust, text=text)
    about_all = len(data.recording.warnings) if solution is data.solution else 0
    warnings = about_all + len(stats.warnings)
    if warnings:
        text = f"There {'are' if warnings > 1 else 'is'} {warnings} warning{'s' if warnings > 1 else ''}, below."
        yield Reason(trust=Trust.WITH_CARE, text=text)


def of(data: ReportData, name: str, column: str) -> float | None:
    """Return a number of an estimate from the first table that has the column; None if there is none."""
    return next((t.as_dict()[name][column] for t in data.tables if column in t.columns and name in t.as_dict()), None)


def main_table(data: ReportData) -> tuple[Table, str] | None:
    """Return the first table with an RMSE, of one estimate at least, and the name of that column."""
    for table in data.tables:
        for key in ("position_rmse_m", "horizontal_rmse_m"):
            if any(row.get(key) is not None for row in table.as_dict().values()):
                return table, key
    return None


def _accuracy(data: ReportData, name: str) -> str:
    found = main_table(data)
    values = {} if found is None else found[0].as_dict()
    key = "" if found is None else found[1]
    mine = values.get(name, {}).get(key)
    if mine is None:
        return "Its accuracy was not measured."
    most = values[name].get(key.replace("rmse", "max"))
    at = " at held-out fixes" if key == "horizontal_rmse_m" else ""
    said = f"Horizontal RMSE {mine:.2f} m{at}" + ("" if most is None else f", worst {most:.2f} m")
    covered = values[name].get("matched") or 1.0
    if covered < 1.0 - _ALIKE:
        said += (
            f", over the {percent(covered)} of them that it covers"
            if at
            else f", over the {percent(covered)} that it covers"
        )
    others = {n: v for n, row in values.items() if n != name and (v := row[key]) is not None}
    alike = {n for n in others if over_one_time(values[n], values[name])}
    if name != data.solution.name:  # the online track is not compared with the offline one, which knows later data
        others.pop(data.solution.name, None)
    beside = ", ".join(
        f"{n} {value:.2f} m" + (f" ({times(value, mine)})" if mine > 0.0 and n in alike else "")
        for n, value in others.items()
    )
    return f"{said}; beside it: {beside}." if beside else f"{said}."


def over_one_time(one: Row, other: Row) -> bool:
    """Return whether two estimates cover about as much of the reference.

    There is no ratio to an error over a time that our track lacks, as the time before its start.
    """
    return abs((one.get("matched") or 1.0) - (other.get("matched") or 1.0)) <= _ALIKE


def times(value: float, mine: float) -> str:
    """Return the ratio of a number to ours as text."""
    ratio = value / mine
    return f"{ratio:.0f} x" if ratio >= 9.95 else f"{ratio:.1f} x" if ratio >= 0.095 else f"{ratio:.2f} x"
