# SPDX-License-Identifier: Apache-2.0
"""Is the IMU wrong for a while? Offline: a grown window in which it contradicts the other sensors is solved without it.

A wrong unit, a loose plug, a saturated axis: no noise of the IMU explains these, and with more noise the whole run is
spoiled. Nor is one sensor that is wrong a reason to doubt the IMU. So at least two sensors must agree in the solution
without the IMU that do not agree with it, and the motion there must be one that a vessel may make. The span is as short
as it can be without contradicting them again. Online: `graphloc.online._imu_doubt`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc.build import Past, Problem, StartPrior, without_imu
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.judge.decide import agrees, met
from graphloc.judge.wrong_imu import GROWS, WRONG_IMU, most_motion
from graphloc.ledger import Outcome
from graphloc.recording import Recording
from graphloc.solve._passes import cost_as_configured
from graphloc.solve.stretch import copy_states, dead_reckon
from graphloc.time import NS_PER_S, duration_ns, utc_text

# Square of an IMU factor, in sigmas, from which it is a contradiction; and how many times the usual one it must be.
_SUSPECT, _TIMES = 36.0, 30.0
_BEFORE_S = 2.5  # length of the end of what is known before a window that may be wrong already
# Log-likelihood: price of each IMU factor that is left out, and least gain of leaving out any.
_PRICE, _CLEARLY = 1.0, 30.0
_WORSE = 6.0  # log-likelihood by which a shorter span may be less probable
_IN_A_ROW = 3  # measurements in a row that disagree make their sensor one that denies
_SENSORS, _FEWEST = 2, 2  # sensors that must agree without the IMU, each with so many more measurements


class ImuWrong(Exception):
    """The IMU is wrong in some spans.

    Attributes:
        spans: each after one stamp until another, ns.
    """

    def __init__(self, spans: Sequence[tuple[int, int]]) -> None:
        super().__init__(spans)
        self.spans = tuple(spans)

    def price(self, problem: Problem) -> float:
        """Return the price (nats) of leaving out the IMU there, as of `wrong_span`."""
        stamps_ns = problem.timeline.stamps_ns
        return _PRICE * sum(
            float(np.sum((stamps_ns > after_ns) & (stamps_ns <= until_ns))) for after_ns, until_ns in self.spans
        )


def left_out(recording: Recording, spans: Sequence[tuple[int, int]]) -> tuple[Recording, str]:
    """Return a recording without the samples of its IMU in some spans, and a warning."""
    assert recording.imu is not None
    imu = recording.imu
    wrong = np.zeros(len(imu), dtype=bool)
    for after_ns, until_ns in spans:
        wrong |= (imu.stamps_ns > after_ns) & (imu.stamps_ns <= until_ns)
    where = ", ".join(f"{(b - a) / NS_PER_S:.1f} s from {utc_text(a)}" for a, b in spans)
    rows = (*recording.rows, *recording.imu_rows(wrong, Outcome.REJECTED, WRONG_IMU))
    said = f"{imu.sensor}: for {where} it {WRONG_IMU}: {int(wrong.sum())} samples rejected, the motion there is bridged as in an IMU gap"
    return replace(recording, imu=imu.where(~wrong), rows=rows), said


class GrownWindow(NamedTuple):
    """A window of a run that is grown: states first..last, of which those after `known` are new.

    Attributes:
        values: estimate of the run, changed in place. prior: what earlier data say of state `first`.
    """

    problem: Problem
    values: gtsam.Values
    first: int
    known: int
    last: int
    prior: StartPrior | Past

    def cost(self) -> float:
        """Return `cost_as_configured` of the window."""
        return cost_as_configured(self.problem, self.values, self.first, self.last, self.prior, judged=self.last)


class _Found(NamedTuple):
    """A window solved without the IMU between two of its states.

    Attributes:
        problem: without the IMU there. cost: of the window, nats. values: of its states.
    """

    problem: Problem
    cost: float
    values: gtsam.Values


def wrong_span(window: GrownWindow, before: gtsam.Values, solve: Callable[[Problem], object]) -> tuple[int, int] | None:
    """Return where the IMU is wrong in a solved window: after one stamp until another (ns); None: it is not.

    Args:
        window: its values become those without the IMU there.
        before: its states up to `known`, as solved without the new data. solve: solves the window of a problem, in
            place.
    """
    problem, values, first, known, last, _ = window
    begin = max(first + 1, problem.timeline.floor(int(problem.timeline.stamps_ns[known]) - duration_ns(_BEFORE_S)))
    agreed, squares = _agreeing(problem, values, begin, last)
    if not _contradicted(problem, values, first, begin, last) and sum(map(_denies, agreed)) < _SENSORS:
        return None
    denying = [n for n, each in enumerate(agreed) if _denies(each)]
    if denying and not any(_grows(agreed[n], squares[n]) for n in denying):
        return None
    trials = _Trials(window, before, solve, begin, agreed)
    span, kept = None, trials.as_is
    try:
        if trials.explains(begin, last, whole := trials.without(begin, last)):
            (a, b), found = _shortest(trials.without, begin, last, whole)
            if trials.explains(a, b, found):
                span = int(problem.timeline.stamps_ns[a]), int(problem.timeline.stamps_ns[b])
                kept = found.values
    except SolveError:
        pass  # the window stands as it is
    values.update(kept)
    return span


class _Trials:
    """Solutions of a window without the IMU in parts of it.

    Args:
        window, before, solve: as of `wrong_span`. begin: the first state from which the IMU may be wrong.
        agreed: of each stream, which measurements from there on agree with the window as it is.

    Attributes:
        as_is: the states of the window as it is.
    """

    def __init__(
        self,
        window: GrownWindow,
        before: gtsam.Values,
        solve: Callable[[Problem], object],
        begin: int,
        agreed: Sequence[NDArray[np.bool_]],
    ) -> None:
        self._window, self._before, self._solve, self._begin, self._agreed = window, before, solve, begin, agreed
        self.as_is = copy_states(window.problem, window.values, window.first, window.last)
        self._cost = window.cost()

    def without(self, a: int, b: int) -> _Found:
        """Solve the window without the IMU from state `a` to `b`, in place.

        It does not start from the window as solved, whose biases may be bent as far back as it reaches.
        """
        problem, values, first, known, last, _ = self._window
        values.update(self.as_is)
        values.update(self._before)
        stamps_ns = problem.timeline.stamps_ns
        dead_reckon(problem, values, known, max(a, known))
        rest = without_imu(problem, values, int(stamps_ns[a]), int(stamps_ns[b]))
        dead_reckon(rest, values, a, last)
        self._solve(rest)
        cost = self._window._replace(problem=rest).cost() + _PRICE * (b - a)
        return _Found(rest, cost, copy_states(rest, values, first, last))

    def explains(self, a: int, b: int, found: _Found) -> bool:
        """Return whether a solution without the IMU is clearly more probable, by several sensors and a possible motion.

        Args:
            a, b: states between which the IMU is left out. found: the solution.
        """
        if found.cost > self._cost - _CLEARLY:
            return False
        stamps_ns = found.problem.timeline.stamps_ns
        moved = sum(2.0 * found.problem.inertial[k].error(found.values) for k in range(a, b))
        may = most_motion(float(stamps_ns[b] - stamps_ns[a]) / NS_PER_S)
        agree, _ = _agreeing(found.problem, found.values, self._begin, self._window.last)
        pairs = zip(agree, self._agreed, strict=True)
        return bool(moved <= may and sum(now.sum() - before.sum() >= _FEWEST for now, before in pairs) >= _SENSORS)


def _contradicted(problem: Problem, values: gtsam.Values, first: int, begin: int, last: int) -> bool:
    """Return whether a factor of the IMU costs far more than usual."""
    squares = np.array([2.0 * problem.inertial[k].error(values) for k in range(first, last)])
    usual = float(np.median(squares[: max(begin - first, 1)]))
    return bool(squares[begin - first :].max(initial=0.0) > max(_SUSPECT, _TIMES * usual))


def _denies(agreed: NDArray[np.bool_]) -> bool:
    """Return whether several measurements in a row disagree."""
    in_a_row = np.convolve(~agreed, np.ones(_IN_A_ROW), "valid") if len(agreed) >= _IN_A_ROW else np.zeros(1)
    return bool(in_a_row.max() > _IN_A_ROW - 0.5)


def _grows(agreed: NDArray[np.bool_], squares: Array) -> bool:
    """Return whether the residual of a sensor grows while several measurements in a row disagree.

    A residual that stays the same is of a jump: all that one receiver gives jumps at once, and the IMU is not to blame.
    """
    begin = int(np.argmax(np.convolve(~agreed, np.ones(_IN_A_ROW), "valid")))
    ends = np.flatnonzero(agreed[begin:])
    row = squares[begin : begin + int(ends[0]) if len(ends) else len(squares)]
    return bool(row.max() > GROWS * row[0])


def _shortest(
    without: Callable[[int, int], _Found], begin: int, last: int, whole: _Found
) -> tuple[tuple[int, int], _Found]:
    """Return the shortest span that is about as probable as the whole, and its solution: both ends by bisection."""

    def good(a: int, b: int) -> bool:
        return without(a, b).cost <= whole.cost + _WORSE

    a = _farthest(lambda middle: good(middle, last), begin, last)
    b = _farthest(lambda middle: good(a, middle), last, a)
    a, b = max(a - 1, begin), min(b + 1, last)  # the IMU may be wrong in a part of the steps beside
    return (a, b), without(a, b)


def _farthest(good: Callable[[int], bool], known: int, wrong: int) -> int:
    """Return the state farthest from `known` towards `wrong` that is still good, by bisection."""
    while abs(wrong - known) > 1:
        middle = (known + wrong) // 2
        known, wrong = (middle, wrong) if good(middle) else (known, middle)
    return known


def _agreeing(
    problem: Problem, values: gtsam.Values, first: int, last: int
) -> tuple[list[NDArray[np.bool_]], list[Array]]:
    """Return which measurements of each stream agree with an estimate, and their squared residuals, in sigmas.

    They agree by the kernel as configured; of several modes the nearest counts.
    """
    found, squares = list[NDArray[np.bool_]](), list[Array]()
    for stream in problem.streams:
        modes = met(problem, stream, stream.between(first, last), values)[1]
        nearest = [min(several, key=lambda r: r.nis()) for several in modes]
        found.append(np.array([agrees(stream, residual) for residual in nearest], dtype=bool))
        squares.append(np.array([residual.nis() for residual in nearest]))
    return found, squares
