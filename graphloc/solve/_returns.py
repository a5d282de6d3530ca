# SPDX-License-Identifier: Apache-2.0
"""Fixes of the only position sensor that lead astray after an outage.

Out of a tunnel, or from under a bridge, a receiver comes back tens of metres off while it states metres, and converges
within half a minute. The errors of these fixes are alike, so the loss of each finds that they agree, and the track
through the outage bends to them. So the run is solved without them, too: an error that comes back with a receiver and
leaves it again is one event, however many fixes have it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphloc.build import Problem, Stream
from graphloc.frames import Array
from graphloc.judge.decide import Verdicts, far_sigmas, met
from graphloc.ledger import LedgerRow, Outcome
from graphloc.signals.position_jumps import MEAN_S
from graphloc.solve._final_passes import RunChoice
from graphloc.solve._levels import COMES_BACK_OFF, OUTAGE_S
from graphloc.time import NS_PER_S, duration_ns, stamps_of, utc_text

_CONVERGES_S = 60.0  # length of the time after an outage in which fixes are doubted
_CONVERGED = 0.75  # share of that time in which the receiver must have converged
_STILL = 1.5  # fixes are left out for so many times as long as they are far off, as the error fades slowly
_RIGHT = 1.5  # nats that a right fix costs by what it states: half of its axes
_FEWEST_OTHERS = 30  # fixes that tell what a right one usually costs; a choice
_FAR = 2.0  # sigmas, of fix and slow error, off the track: a fix that is nearer has converged


class Return(NamedTuple):
    """The fixes of a receiver after an outage.

    Attributes:
        outage_ns: stamps of the last fix before it and of the first one after it. fixes: their indices in the stream.
        off_m: by how much they are off at most; 0: not known.
    """

    outage_ns: tuple[int, int]
    fixes: range
    off_m: float = 0.0

    def said(self, stream: Stream) -> str:
        """Return a warning on these fixes."""
        began, back = self.outage_ns
        return (
            f"{stream.name}: back from an outage of {(back - began) / NS_PER_S:.0f} s at {utc_text(back)} it was up to {self.off_m:.0f} m "
            f"off, and converged within {self.lasts_s(stream):.0f} s: its {len(self.fixes)} fixes of that time are left out"
        )

    def lasts_s(self, stream: Stream) -> float:
        return (stream.measurements[self.fixes[-1]].stamp_ns - self.outage_ns[1]) / NS_PER_S


class Returns(NamedTuple):
    """Returns of one receiver from outages.

    Attributes:
        number: of its stream. each: the returns.
        usual: cost (nats) that comes with each of its other fixes. Most receivers state their whole error, of which what
            changes from fix to fix is a part: of such a right fix costs less than `_RIGHT`.
    """

    number: int
    usual: float
    each: tuple[Return, ...]

    def price(self, problem: Problem) -> float:
        """Return the price (nats) of leaving the fixes of all returns out.

        It is that of a receiver that comes back off, of the time for which it is off, and what such fixes cost anyway.
        """
        lasts_s = sum(one.lasts_s(self._stream(problem)) for one in self.each)
        fixes = sum(len(one.fixes) for one in self.each)
        return COMES_BACK_OFF * len(self.each) + lasts_s / MEAN_S + self.usual * fixes

    def _stream(self, problem: Problem) -> Stream:
        return next(s for s in problem.streams if s.number == self.number)

    def left_out_of(self, problem: Problem) -> Problem:
        """Return the problem without the fixes of these returns."""
        stream = self._stream(problem)
        gone = np.array([i for one in self.each for i in one.fixes], dtype=np.int64)
        kept = stream.only(np.setdiff1d(np.arange(len(stream.measurements)), gone))
        lost = [stream.measurements[i] for i in gone]
        why = "after an outage the receiver was off, and converged"
        rows = [
            LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic="", outcome=Outcome.REJECTED, reason=why)
            for m in lost
        ]
        return replace(
            problem,
            streams=tuple(kept if s is stream else s for s in problem.streams),
            rejected=(*problem.rejected, *rows),
            warnings=(*problem.warnings, *(one.said(stream) for one in self.each if one.off_m)),
        )

    def still_off(self, problem: Problem, without: RunChoice, cost: float) -> Returns:
        """Return these returns with those of their fixes that are far off by a solution without them.

        Of each return, these are all fixes up to the last one that is far off, and some after it. A return that does
        not converge soon enough is dropped.

        Args:
            without: that solution. cost: of it, nats. It gives `usual`: if other fixes bend this solution as well, or
                are far off by it, it is no merit that the fixes left out do not.
        """
        stream, found = self._stream(problem), list[Return]()
        stamps_ns = stamps_of(stream.measurements)
        for one in self.each:
            _, residuals = met(problem, stream, one.fixes, without.values)
            off_m = np.array([np.linalg.norm(modes[0].raw[:2]) for modes in residuals])
            far = np.flatnonzero(off_m > _FAR * np.array([_sigma_m(stream, modes[0].cov) for modes in residuals]))
            if len(far):
                since_ns = stamps_ns[one.fixes] - one.outage_ns[1]
                count = int(np.searchsorted(since_ns, _STILL * since_ns[far[-1]], side="right"))
                # If the IMU is off instead, the track stays off nearly until the next fix that is used.
                if since_ns[far[-1]] < _CONVERGED * since_ns[-1]:
                    found.append(Return(one.outage_ns, one.fixes[:count], float(off_m[far].max())))
        others = sum(
            float(_costs(s, without.verdicts).sum()) for s in without.problem.streams if s.number != self.number
        )
        left = len(self._stream(without.problem).measurements)
        return Returns(self.number, max((cost - others) / left, self.usual), tuple(found))


def doubtful_returns(problem: Problem, solved: RunChoice, misfit: float) -> Returns | None:
    """Return the fixes after outages that bend a solution, or that are far off by it; None if there are none.

    Leaving them out can save only what the IMU, these fixes and jumps of their slow error cost: where that is little,
    it need not be tried.

    Args:
        misfit: of the solution: if it is as large everywhere, a cost after an outage tells nothing.
    """
    absolute = [s for s in problem.streams if s.row.absolute]
    if len(absolute) != 1 or absolute[0].row.has_hypotheses or len(absolute[0].position_jumps[0]):
        return None
    (stream,) = absolute
    cost, every = _costs(stream, solved.verdicts), _returns(stream)
    least = COMES_BACK_OFF * max(misfit, 1.0)
    others = np.delete(cost, [i for one in every for i in one.fixes])
    usual = min(float(others.mean()), _RIGHT) if len(others) >= _FEWEST_OTHERS else _RIGHT

    def may_be_off(one: Return) -> bool:
        end_ns = stream.measurements[one.fixes[-1]].stamp_ns
        if any(after_ns < end_ns and one.outage_ns[0] < until_ns for after_ns, until_ns in problem.left_out):
            return False  # the IMU was wrong there, and may still be
        steps = range(problem.timeline.floor(one.outage_ns[0]), int(stream.state[one.fixes[-1]]))
        bent = sum(problem.inertial[k].error(solved.values) for k in steps)
        dear = bent + float(np.sum(cost[one.fixes] - usual)) > least
        return dear or any(far_sigmas(stream.slow, solved.verdicts[stream.number, i].at) > _FAR for i in one.fixes)

    returns = tuple(filter(may_be_off, every))
    return Returns(stream.number, usual, returns) if returns else None


def _returns(stream: Stream) -> list[Return]:
    stamps_ns = stamps_of(stream.measurements)
    back = np.flatnonzero(np.diff(stamps_ns) > OUTAGE_S * NS_PER_S) + 1
    ends = np.searchsorted(stamps_ns, stamps_ns[back] + duration_ns(_CONVERGES_S))
    # At least a third of the fixes before the next outage must be left, to tell the place.
    until = np.minimum(ends, back + 2 * np.diff(back, append=len(stamps_ns)) // 3)
    pairs = zip(back.tolist(), until.tolist(), strict=True)
    return [Return((int(stamps_ns[a - 1]), int(stamps_ns[a])), range(a, b)) for a, b in pairs if b > a]


def _costs(stream: Stream, verdicts: Verdicts) -> Array:
    """Return the cost (M,) of each measurement, nats."""
    residuals = [verdicts[stream.number, i].residual for i in range(len(stream.measurements))]
    return np.array([stream.config.kernel.loss(r.nis(), len(r.raw)) for r in residuals])


def _sigma_m(stream: Stream, cov: Array) -> float:
    """Return the sigma of a fix, m, by its covariance (3, 3), m^2, and its slow error."""
    slow = stream.slow or stream.left_out
    usual = 0.0 if slow is None else float(np.abs(slow.sigma * slow.scale)[slow.far_axes].max(initial=0.0))
    return float(np.hypot(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]), usual))
