# SPDX-License-Identifier: Apache-2.0
"""Schedule of failures, and the part of the recording that an estimator needs for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphloc.eval.drill.failures import Failure
from graphloc.recording import Recording
from graphloc.time import NS_PER_S

LEAD_S, TAIL_S = 25.0, 25.0  # time before a failure, so that estimators have settled, and after it, which is evaluated
WHOLE_S = 600.0  # length from which a recording is cut into windows
WINDOW_LEAD_S, WINDOW_TAIL_S = 60.0, 60.0
_SETTLED_S = 10.0  # time after the online mode's first pose, before a failure may begin


@dataclass(frozen=True, slots=True, kw_only=True)
class DrillWindow:
    """A part of the recording for the estimators: stamps of begin and end, and whether it is the whole."""

    begin_ns: int
    end_ns: int
    whole: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One failure that begins at one stamp, in the window of that number; `seed`: of its random choices."""

    failure: Failure
    window: int
    begin_ns: int
    seed: int

    @property
    def end_ns(self) -> int:
        """Stamp at which the failure ends."""
        return self.begin_ns + round(self.failure.length_s * NS_PER_S)


def windows(recording: Recording, longest_s: float, times: int) -> tuple[DrillWindow, ...]:
    """Return the whole recording, or `times` parts of a long one, spread evenly."""
    assert recording.imu is not None
    begin, end = int(recording.imu.stamps_ns[0]), int(recording.imu.stamps_ns[-1])
    if end - begin <= WHOLE_S * NS_PER_S:
        return (DrillWindow(begin_ns=begin, end_ns=end, whole=True),)
    size = round((WINDOW_LEAD_S + longest_s + WINDOW_TAIL_S) * NS_PER_S)
    starts = begin + (np.arange(times) + 0.5) / times * (end - begin - size)
    return tuple(DrillWindow(begin_ns=int(s), end_ns=int(s) + size, whole=False) for s in starts)


def schedule(
    failures: Sequence[Failure], parts: Sequence[DrillWindow], ready_ns: Sequence[int], times: int, seed: int
) -> tuple[tuple[Case, ...], tuple[tuple[str, str], ...]]:
    """Return the cases, and the failures that do not fit, with reasons.

    In a whole recording the times are spread evenly over those at which the failure fits. In a window of a long one it
    is injected once.

    Args:
        failures: to inject. parts: windows. ready_ns: stamp of the online mode's first pose, by window.
        times: injections of each failure. seed: of all random choices.
    """
    cases: list[Case] = []
    left: list[tuple[str, str]] = []
    for failure in failures:
        own: list[Case] = []
        short_s: list[float] = []
        for number, (part, ready) in enumerate(zip(parts, ready_ns, strict=True)):
            first = max(part.begin_ns + round(LEAD_S * NS_PER_S), ready + round(_SETTLED_S * NS_PER_S))
            last = part.end_ns - round((failure.length_s + TAIL_S) * NS_PER_S)
            if last < first:
                short_s.append((first - last) / NS_PER_S)
                continue
            shares = (np.arange(times) + 0.5) / times if part.whole else np.zeros(1)
            own += [
                Case(failure=failure, window=number, begin_ns=first + round(float(share) * (last - first)), seed=seed + k + number)
                for k, share in enumerate(shares)
            ]  # fmt: skip
        if not own:
            said = f"does not fit, with {TAIL_S:g} s after it: the recording is {np.ceil(min(short_s)):.0f} s too short"
            left.append((failure.name, said))
        cases += own
    return tuple(cases), tuple(left)


def judged_until(case: Case, window: DrillWindow) -> DrillWindow:
    """Return the window up to `WINDOW_TAIL_S` after the failure: later errors are not evaluated."""
    end_ns = min(window.end_ns, case.end_ns + round(WINDOW_TAIL_S * NS_PER_S))
    return replace(window, end_ns=end_ns, whole=window.whole and end_ns == window.end_ns)


def cut(recording: Recording, window: DrillWindow) -> Recording:
    """Return the part of a recording in a window: with the whole truth, without ledger rows of other messages."""
    if window.whole or recording.imu is None:
        return recording
    inside = (recording.imu.stamps_ns >= window.begin_ns) & (recording.imu.stamps_ns <= window.end_ns)
    kept = tuple(m for m in recording.measurements if window.begin_ns <= m.stamp_ns <= window.end_ns)
    return replace(recording, imu=recording.imu.where(inside), measurements=kept, rows=())
