# SPDX-License-Identifier: Apache-2.0
"""Health of each pose of a solved run, by what came before and comes after."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build import Problem, Stream
from graphloc.frames import Array
from graphloc.judge.decide import AGREES, CREDIBLE, Verdict, far_sigmas
from graphloc.judge.health import FAR_OFF, health_of, late_of, why_late, why_off_mount, why_unlikely
from graphloc.judge.imu_noise import LARGEST_NOISE_SCALE
from graphloc.signals.position_jumps import LASTS_S, why_in_doubt
from graphloc.solution import CONTRADICTING_COST, Health, HealthReason, SolveStats
from graphloc.solve.batch import BatchResult
from graphloc.time import duration_ns
from graphloc.trajectory import Trajectory


def misfits(problem: Problem, result: BatchResult, stats: SolveStats, stepped: Collection[str] = ()) -> list[str]:
    """Return, by state, the reason why it cannot be called good; empty where there is none.

    Args:
        stepped: names of the compasses whose headings have stepped in an earlier part of the run.
    """
    if throughout := _misfit_of_run(problem, result, stats, stepped):
        return [throughout] * len(problem.timeline.stamps_ns)
    said = _beside_jumps(problem)
    receivers: dict[str, list[Stream]] = {}
    for stream in problem.streams:
        if stream.row.absolute:
            receivers.setdefault(problem.config.receiver_of(stream.name), []).append(stream)
    for by_turns in receivers.values():
        names = _unlikely(problem, by_turns, result.verdicts)
        said = [why_unlikely(name) if name else own for own, name in zip(said, names, strict=True)]
    return said


def _misfit_of_run(problem: Problem, result: BatchResult, stats: SolveStats, stepped: Collection[str]) -> str:
    """Return the reason why no state of the run can be called good; empty if there is none."""
    if not result.converged:
        return "the solver did not converge"
    if result.noise_scale > LARGEST_NOISE_SCALE or stats.cost > CONTRADICTING_COST * max(stats.expected_cost, 1.0):
        return "the measurements contradict each other"
    for stream in problem.streams:
        late_s = late_of(stream, result.values)
        if late_s is not None and stream.slow is not None:
            sigma_s = float(stream.slow.sigma[stream.slow.late or 0])
            if abs(late_s / sigma_s) > FAR_OFF:
                return why_late(stream.name)
        if stream.slow is not None and not stream.heading_steps and stream.name not in stepped:
            value = result.values.atVector(keys.slow(stream.number, 0))
            if why := why_off_mount(stream.name, stream.slow, value):
                return why
    return ""


def _beside_jumps(problem: Problem) -> list[str]:
    """Return, by state, the reason for doubt near a jump of fixes whose bounds allow for no slow error; else ''."""
    stamps_ns = problem.timeline.stamps_ns
    said = [""] * len(stamps_ns)
    for stream in problem.streams:
        if stream.left_out is None and stream.slow is None:
            for at_ns in stream.position_jumps[0]:
                for k in np.flatnonzero(np.abs(stamps_ns - at_ns) < LASTS_S * 1e9):
                    said[int(k)] = why_in_doubt(stream.name)
    return said


def _unlikely(problem: Problem, by_turns: Sequence[Stream], verdicts: dict[tuple[int, int], Verdict]) -> Sequence[str]:
    """Return, by state, the sensor whose newest agreeing measurement agrees only by an unlikely large slow error.

    Before the first agreeing measurement, it is that one: a smoother knows what comes. Empty where there is none.

    Args:
        by_turns: the sensors that read one receiver by turns, or a single sensor.
    """
    agrees = sorted(
        (m.stamp_ns, stream.name if far_sigmas(stream.slow, verdict.at) > FAR_OFF else "")
        for stream in by_turns
        for i, m in enumerate(stream.measurements)
        if (verdict := verdicts[stream.number, i]).weight >= AGREES
    )
    stamps_ns = problem.timeline.stamps_ns
    if not any(name for _, name in agrees):
        return [""] * len(stamps_ns)
    newest = np.searchsorted(np.array([stamp_ns for stamp_ns, _ in agrees]), stamps_ns, side="right") - 1
    return [agrees[k][1] for k in np.maximum(newest, 0)]


def since_agreed(problem: Problem, stream: Stream, verdicts: dict[tuple[int, int], Verdict]) -> Array:
    """Return (N,), by state, how long ago a sensor last agreed, s; inf before it first did."""
    agreed = np.array(
        [
            m.stamp_ns
            for i, m in enumerate(stream.measurements)
            if (verdict := verdicts[(stream.number, i)]).weight >= AGREES
            and far_sigmas(stream.slow, verdict.at) <= CREDIBLE
        ],
        dtype=np.int64,
    )
    stamps = problem.timeline.stamps_ns
    if not len(agreed):
        return np.full(len(stamps), np.inf)
    left = np.searchsorted(agreed, stamps, side="right") - 1
    return np.where(left >= 0, (stamps - agreed[np.maximum(left, 0)]) * 1e-9, np.inf)


def _or_until(since: Array, stamps_ns: NDArray[np.int64]) -> Array:
    """Return the seconds since a sensor agreed, or, before that, until it first does: a smoother knows what comes."""
    known = np.flatnonzero(np.isfinite(since))
    if not len(known):
        return since
    first = stamps_ns[known[0]] - duration_ns(since[known[0]])
    return np.where(np.isfinite(since), since, (first - stamps_ns) * 1e-9)


def health_over_time(
    trajectory: Trajectory, since: dict[str, Array], misfits: Sequence[str], good_bound_m: float
) -> tuple[tuple[Health, ...], tuple[HealthReason, ...]]:
    """Return the health of each pose of a solved track, and why it is not good: by `health_of`, knowing what comes.

    Args:
        since: by absolute sensor (N,), s since it last agreed. misfits: by state, what else speaks against it.
    """
    assert trajectory.cov is not None
    away = {name: _or_until(s, trajectory.stamps_ns) for name, s in since.items()}
    found = [
        health_of(cov, {name: float(s[k]) for name, s in away.items()}, good_bound_m, misfits[k])
        for k, cov in enumerate(trajectory.cov)
    ]
    return tuple(health for health, _ in found), tuple(why for _, why in found)
