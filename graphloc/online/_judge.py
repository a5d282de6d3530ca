# SPDX-License-Identifier: Apache-2.0
"""What to believe of the measurements in the window: asked when each comes, and again.

A sensor with a kernel is judged when it comes, and once or twice again. What of it disagrees is asked whether the
prediction is sure enough to say so: where it is not, after an outage, the kernel bends later. A sensor with
hypotheses is judged as the batch does it, as a sequence, against the prediction while it is new.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from graphloc.config import KernelConfig
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, Residual
from graphloc.measurements import Measurement
from graphloc.online._agreement import Agreement
from graphloc.online._alternatives import choices
from graphloc.online._entries import Entries, Entry
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._receiver_checks import ReceiverChecks
from graphloc.online._states import States
from graphloc.online._window import Window
from graphloc.solve._best_chain import best_chain
from graphloc.solve._decide import AGREES, Verdict, by_hypotheses
from graphloc.solve._hypotheses import log_evidence_of

_AGAIN_S = (1.0, 4.0)  # ages at which a kernel is asked again
_LEAF_S, _SURE = 1.0, 0.9  # how often an older chapter is judged again; a weight that needs no second look
_CERTAIN = 0.99  # a weight that leaves no doubt
_LOOSE = 25.0  # times its variance: a choice that says so little of the place does not move it
_SHOWS = 0.01  # of a covariance: what other choices must add to be worth adding
_CHAPTER = 10  # hypotheses that are judged as one sequence
_ROUNDS = 2  # of judging what is new
_CHAIN = 2  # measurements that agree with each other, and not with the estimate
_FAR_M = 20e3  # from the estimate: no place of this run; beyond, the linear algebra fails before a kernel helps
_STEPS = 3  # of the solver, where other choices are tried


class Judge:
    """Decides about the entries, by the prediction of the states.

    Args:
        agreement: told of what absolute sensors say.

    Attributes:
        receivers: checks of single receivers, before a measurement is judged.
    """

    def __init__(
        self, problem: LiveProblem, window: Window, states: States, entries: Entries, agreement: Agreement
    ) -> None:
        self._problem, self._window = problem, window
        self._states, self._entries, self._agreement = states, entries, agreement
        self.receivers = ReceiverChecks(problem, states, entries, agreement)
        self._again: list[tuple[float, int, Entry]] = []  # a heap: when, and in turn
        self._turn = count()
        self._rounds: dict[str, int] = {}
        self._leaves: dict[str, int] = {}  # how many chapters back was judged again
        self._leafed_s: dict[str, float] = {}  # and when
        self._refuted: set[str] = set()  # sensors of which something new was judged false
        self._tried: dict[str, frozenset[tuple[int, int | None]]] = {}
        self._unsure: set[str] = set()  # sensors of which all choices are to be weighed
        self._chosen: dict[str, frozenset[tuple[int, int | None]]] = {}
        self._others: dict[str, tuple[Array, Array]] = {}  # mean and covariance, of each sensor

    @property
    def others(self) -> tuple[Array, Array]:
        """What other choices of what is right, by their probability, add to the newest place in world: mean (3,) and covariance (3, 3)."""
        means, covs = zip(*self._others.values(), strict=True) if self._others else ((), ())
        return np.asarray(sum(means, start=np.zeros(3))), np.asarray(sum(covs, start=np.zeros((3, 3))))

    def take(self, m: Measurement) -> None:
        """Stage a measurement whose stamp lies within the states; one with hypotheses waits for `judge`.

        Raises:
            SolveError: it cannot be of this run; nothing of it is staged.
        """
        stream, i = self._problem.take(m)
        at, residuals = self._entries.residuals_at(stream, i)
        if (away_m := min(r.size_m or 0.0 for r in residuals)) > _FAR_M:
            self._agreement.note(stream, m, None)
            raise SolveError(f"it lies {away_m / 1e3:.0f} km away")
        if self.receivers.frozen(stream, m, at, residuals[0]):
            self._entries.add(Entry(stream, i, Verdict(None, 0.0, 1.0, residuals[0], 0, at)))
        elif stream.row.false is None:
            verdict, opened = self._by_kernel(stream, i, at, residuals[0], fresh=True)
            # Where its kernel was opened it was let in; whether it agrees is seen when it is asked again.
            if not opened or verdict.weight < AGREES:
                self._agreement.note(stream, m, verdict)
            entry = Entry(stream, i, verdict, opened=opened)
            self._entries.add(entry)
            self._ask_at(self._problem.timeline.seconds(m.stamp_ns) + _AGAIN_S[0], entry)
        else:
            self._entries.add(Entry(stream, i, Verdict(None, 0.0, 1.0, residuals[0], 0, at)))
            self._rounds[stream.name] = _ROUNDS

    def judge(self) -> None:
        """Stage what is to be decided, anew or again."""
        timeline = self._problem.timeline
        now_s = timeline.seconds(timeline.stamps_ns[timeline.last])
        for name, stream in self._problem.streams.items():
            rounds = self._rounds.pop(name, 0)
            if rounds:
                unsettled = self._by_hypotheses(stream, self._chapter(stream))
                if rounds > 1 and unsettled:
                    self._rounds[name] = rounds - 1
            elif stream.row.false is not None and now_s >= self._leafed_s.get(name, 0.0) + _LEAF_S:
                self._leaf_back(stream, now_s)
                if name in self._others:
                    self._unsure.add(name)
        due = []
        while self._again and self._again[0][0] <= now_s:
            due.append(heapq.heappop(self._again)[2])
        for entry in due:
            self._ask_again(entry, now_s)

    # By a kernel

    def _by_kernel(
        self, stream: LiveStream, i: int, at: Attachment, residual: Residual, *, fresh: bool
    ) -> tuple[Verdict, bool]:
        """The sensor's kernel: as wide as its residuals scatter, and as the prediction is unsure. True: for that reason."""
        own, dof = stream.config.kernel, len(residual.raw)
        scale = own.scale * stream.scatter.times * float(np.sqrt(dof))
        plain = nis = residual.nis()
        opened, inflation = False, None
        if fresh and own.kind != "none" and nis > scale**2:
            inflation = self._states.prediction(stream, at, stream.state[i], residual).cov
            nis = residual.nis(inflation)
            opened = plain > 1.5 * nis
            scale *= float(np.sqrt(plain / max(nis, 1e-9))) if opened else 1.0
        if fresh:
            stream.scatter.note(stream.measurements[i].stamp_ns, residual.normalised(inflation))
        kernel = KernelConfig(kind=own.kind, scale=scale)
        return Verdict(Decision(kernel=kernel), kernel.weight(plain), 1.0, residual, 0, at), opened

    def _ask_at(self, due_s: float, entry: Entry) -> None:
        heapq.heappush(self._again, (due_s, next(self._turn), entry))

    def _ask_again(self, entry: Entry, now_s: float) -> None:
        if not self._entries.reachable(entry) or entry.verdict.decision is None:
            return
        at, residuals = self._entries.residuals_at(entry.stream, entry.index)
        verdict, opened = self._by_kernel(entry.stream, entry.index, at, residuals[0], fresh=False)
        if verdict.weight >= AGREES:
            self._agreement.note(entry.stream, entry.measurement, verdict)
        if entry.opened or entry.weighs_other(verdict):
            entry.opened = opened
            self._entries.change(entry, verdict)
        else:
            entry.verdict = replace(verdict, decision=entry.verdict.decision)
        age_s = now_s - self._problem.timeline.seconds(entry.measurement.stamp_ns)
        if age_s < _AGAIN_S[1]:
            self._ask_at(now_s + _AGAIN_S[1] - age_s, entry)

    # By hypotheses

    def _by_hypotheses(self, stream: LiveStream, own: list[Entry]) -> bool:
        """Judge measurements of a stream as one sequence; what is new, by the prediction. Tell whether it may change yet."""
        unsettled = False
        if not own:
            return False
        attached, residuals = self._met(own)
        predictions = [
            self._states.prediction(stream, at, e.state, found[0])
            if e.held is None and e.verdict.decision is None and not e.judged else None
            for e, at, found in zip(own, attached, residuals, strict=True)
        ]  # fmt: skip
        verdicts = by_hypotheses(stream, [e.index for e in own], attached, residuals, predictions)
        for entry, verdict in zip(own, verdicts, strict=True):
            settled = entry.verdict.settled + (entry.judged and verdict.mode != entry.verdict.mode)
            if not entry.judged or verdict.weight >= AGREES:
                self._agreement.note(stream, entry.measurement, verdict)
            if not entry.judged and verdict.weight < AGREES:
                self._refuted.add(stream.name)
            if not entry.judged and (verdict.weight < _CERTAIN or stream.name in self._others):
                self._unsure.add(stream.name)
            verdict, differs = replace(verdict, settled=settled), entry.differs(verdict)
            unsettled |= differs if entry.judged else verdict.weight < _SURE
            entry.judged = True
            if differs:
                self._entries.change(entry, verdict)
            else:
                entry.verdict = replace(verdict, decision=entry.verdict.decision, at=entry.verdict.at)
        return unsettled

    def _chapter(self, stream: LiveStream, back: int = 0) -> list[Entry]:
        """A chapter of a stream that can still be judged, by stamp: the newest, or so many before it."""
        own = self._entries.of(stream)
        end = len(own) - back * _CHAPTER
        return own[max(end - _CHAPTER, 0) : max(end, 0)]

    def _leaf_back(self, stream: LiveStream, now_s: float) -> None:
        """Judge an older chapter again, each in its turn: what came since may say otherwise."""
        self._leafed_s[stream.name] = now_s
        back = self._leaves.get(stream.name, 0) + 1
        own = self._chapter(stream, back)
        self._leaves[stream.name] = back if own else 0
        self._by_hypotheses(stream, own)

    def _met(self, own: list[Entry]) -> tuple[list[Attachment], list[tuple[Residual, ...]]]:
        """Where each meets the graph as it is now estimated, and the residuals of its modes there."""
        met = [self._entries.residuals_at(e.stream, e.index) for e in own]
        return [at for at, _ in met], [found for _, found in met]

    # Other choices: what was chosen confirms itself, for the estimate follows it (see `graphloc.solve._choices`)

    def try_others(self) -> bool:
        """Where what was judged false agrees among itself, try that instead, and keep what is more probable. Tell whether any was tried."""
        names, self._refuted = self._refuted, set()
        moved = False
        for name in sorted(names):
            stream = self._problem.streams[name]
            own = self._chapter(stream)
            if len(own) < _CHAIN:
                continue
            attached, found = self._met(own)
            chain = best_chain(stream, [e.index for e in own], found)
            believed = [e.verdict.mode if e.held is not None and e.verdict.weight >= AGREES else None for e in own]
            others = [mode for mode, held in zip(chain, believed, strict=True) if mode != held]
            tried = frozenset((e.index, mode) for e, mode in zip(own, chain, strict=True))
            # One that comes alone may agree with some of what is believed, and refute the rest.
            if len(others) < _CHAIN or all(mode is None for mode in others) or tried == self._tried.get(name):
                continue
            self._tried[name] = tried
            moved = True
            self._try(stream, own, _along(chain, found, attached))
        unsure, self._unsure = self._unsure, set()
        for name in sorted(unsure):
            moved |= self._weigh_choices(self._problem.streams[name])
        return moved

    def _weigh_choices(self, stream: LiveStream) -> bool:
        """Try the most probable choice of the newest measurements, and remember what the others leave. Tell whether any was tried.

        Only one that believes something more: that all are false is also what a receiver says that hangs.
        """
        for tried in range(_ROUNDS):
            self._others.pop(stream.name, None)
            own = self._chapter(stream)
            if not own or stream.constants:
                return tried > 0
            attached, found = self._met(own)
            held = [e.within for e in own]
            cov = self._states.joint(attached, [modes[0] for modes in found])
            weighed = choices(stream, [e.index for e in own], found, cov, held)
            best = weighed[0].modes
            now = tuple(h[0] if h is not None and h[1] >= AGREES else None for h in held)
            share, steps = np.exp([c.log for c in weighed]), np.array([c.step[:3] for c in weighed])
            # What is not the most probable, and was refused when it was tried, does not move the place; nor does a choice
            # by which nothing tells it: its share of a step of 100 m is no place that anybody means.
            tells = np.array([np.trace(c.cov[:3, :3]) for c in weighed]) < _LOOSE * np.trace(cov[:3, :3])
            mean = (share * tells) @ steps if best == now else np.zeros(3)
            around = (share[:, None] * (steps - mean)).T @ (steps - mean)
            if np.trace(around) > _SHOWS * np.trace(cov[:3, :3]):
                self._others[stream.name] = mean, around
            chosen = frozenset((e.index, mode) for e, mode in zip(own, best, strict=True))
            gains = any(mode is not None and mode != other for mode, other in zip(best, now, strict=True))
            if not gains or chosen == self._chosen.get(stream.name):
                return tried > 0
            self._chosen[stream.name] = chosen
            self._others.pop(stream.name, None)  # was about the estimate before the trial
            self._try(stream, own, _along(best, found, attached))
        return True

    def _try(self, stream: LiveStream, own: list[Entry], others: list[Verdict]) -> None:
        """Take other verdicts, settle around them, and go back if that is less probable, or if the solver runs away.

        Back by a mark: from far off its steps do not lead back.
        """
        self._window.settle()
        cost, agreement, back = self._cost(stream, own), self._agreement.marked(), self._entries.marked(own)
        try:
            for entry, verdict in zip(own, others, strict=True):
                self._entries.change(entry, verdict)
            self._window.settle(_STEPS)  # a metre off, one step says nothing of the cost
            self._by_hypotheses(stream, self._chapter(stream))
            self._window.settle(_STEPS)
            better = self._cost(stream, own) < cost
        except (SolveError, RuntimeError, ArithmeticError, ValueError, np.linalg.LinAlgError):
            better = False
        if better:
            self._rounds[stream.name] = _ROUNDS
            return
        self._agreement.back_to(agreement)
        back()

    def _cost(self, stream: LiveStream, own: list[Entry]) -> float:
        """Minus the log of the probability of the window, all hypotheses of a stream summed over."""
        evidence = log_evidence_of(stream, [e.index for e in own], self._met(own)[1])
        return self._window.error([e.held for e in own if e.held is not None]) - evidence


def _along(modes: Sequence[int | None], found: list[tuple[Residual, ...]], attached: list[Attachment]) -> list[Verdict]:
    """Return the verdicts that believe these modes, and nothing else."""
    return [
        Verdict(
            None if mode is None else Decision(mode=mode), float(mode is not None), 1.0, r[mode or 0], mode or 0, at
        )
        for mode, r, at in zip(modes, found, attached, strict=True)
    ]
