# SPDX-License-Identifier: Apache-2.0
"""Which measurements in the window are believed, and with what weight: decided when each arrives, and again later.

A measurement of a sensor with a robust kernel is judged on arrival, and once or twice again. If its residual is large
only because the prediction is uncertain, as after an outage, its kernel is widened. Measurements of a sensor with
hypotheses are judged as a sequence, as by the batch solver; new ones are judged against the prediction.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from graphloc import keys
from graphloc.config import KernelConfig
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, Residual
from graphloc.judge.best_chain import best_chain
from graphloc.judge.decide import AGREES, Verdict, believing, by_hypotheses
from graphloc.judge.hypotheses import log_evidence_of
from graphloc.measurements import Measurement
from graphloc.online._agreement import Agreement
from graphloc.online._alternatives import Choice, choices
from graphloc.online._entries import Entries, Entry
from graphloc.online._imu_doubt import Denials
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._receiver_checks import ReceiverChecks
from graphloc.online._states import States
from graphloc.online._window import Window

_REJUDGE_AGES_S = (1.0, 4.0)  # ages at which a measurement with a kernel is judged again
# How often an older group is judged again; weight from which a new one needs no second round
_OLDER_EVERY_S, _SURE = 1.0, 0.9
_CERTAIN = 0.99  # weight from which a measurement leaves no doubt
_LOOSE = 25.0  # times the variance of the position: a choice that leaves it more uncertain does not move the mean
_SHOWS = 0.01  # share of the position's covariance that other choices must add to be counted
_GROUP = 10  # measurements that are judged as one sequence
_ROUNDS = 2  # rounds of judging new measurements
_CHAIN = 2  # fewest measurements that agree with each other, but not with the estimate, for a trial
# From the estimate: farther measurements are not of this run; the linear algebra would fail before a kernel helps
_FAR_M = 20e3
_STEPS = 3  # iterations of the solver in a trial


class Judge:
    """Decides on the entries by the predictions of the states.

    Args:
        problem, window, states, entries: the window and its parts. agreement: notes how absolute sensors were judged.

    Attributes:
        receivers: checks of single receivers, before a measurement is judged. denials: notes which sensors deny the
            estimate.
    """

    def __init__(
        self, problem: LiveProblem, window: Window, states: States, entries: Entries, agreement: Agreement
    ) -> None:
        self._problem, self._window = problem, window
        self._states, self._entries, self._agreement = states, entries, agreement
        self.denials = Denials()
        self.receivers = ReceiverChecks(problem, states, entries, agreement)
        self._scheduled: list[tuple[float, int, Entry]] = []  # a heap: due time (s), order, entry
        self._turn = count()
        # By sensor with hypotheses:
        self._rounds: dict[str, int] = {}  # rounds of judging that are left
        self._groups_back: dict[str, int] = {}  # which older group was judged again last, counted from the newest
        self._rejudged_s: dict[str, float] = {}  # when that was, s
        self._refuted: set[str] = set()  # those with a new measurement that was judged false
        # Indices and modes of the last chain that was tried
        self._tried: dict[str, frozenset[tuple[int, int | None]]] = {}
        self._unsure: set[str] = set()  # those whose choices are to be weighed
        # Indices and modes of the last choice that was tried
        self._chosen: dict[str, frozenset[tuple[int, int | None]]] = {}
        self._others: dict[str, tuple[Array, Array]] = {}  # what `others` adds up: mean and covariance

    @property
    def others(self) -> tuple[Array, Array]:
        """What other choices of modes add, weighted by their probability, to the newest position in world.

        Mean (3,), m, and covariance (3, 3), m^2.
        """
        means, covs = zip(*self._others.values(), strict=True) if self._others else ((), ())
        return np.asarray(sum(means, start=np.zeros(3))), np.asarray(sum(covs, start=np.zeros((3, 3))))

    def take(self, m: Measurement) -> None:
        """Stage a measurement whose stamp lies within the window; if its sensor has hypotheses, `judge` decides on it.

        Raises:
            SolveError: the measurement lies impossibly far away; nothing of it is staged.
        """
        stream, i = self._problem.take(m)
        at, residuals = self._entries.residuals_at(stream, i)
        if (away_m := min(r.size_m or 0.0 for r in residuals)) > _FAR_M:
            self._agreement.note(stream, m, None)
            raise SolveError(f"{m.sensor}: it lies {away_m / 1e3:.0f} km away")
        if why := self.receivers.reject(stream, m, at, residuals[0]):
            self._entries.add(Entry(stream, i, Verdict.false(residuals[0], at, why)))
            if stream.receiver.jump.suspects(m.stamp_ns):
                self.denials.note(stream.name, m.stamp_ns, residuals[0].nis(), agrees=False, outlier=False)
        elif not stream.row.has_hypotheses:
            verdict, widened = self._by_kernel(stream, i, at, residuals[0], fresh=True)
            # With a widened kernel it is used, but whether it agrees shows only when it is judged again.
            if not widened or verdict.weight < AGREES:
                self._agreement.note(stream, m, verdict)
                agrees = verdict.weight >= AGREES
                self.denials.note(stream.name, m.stamp_ns, residuals[0].nis(), agrees=agrees, outlier=False)
            entry = Entry(stream, i, verdict, widened=widened)
            self._entries.add(entry)
            self._schedule(self._problem.timeline.seconds(m.stamp_ns) + _REJUDGE_AGES_S[0], entry)
        else:
            self._entries.add(Entry(stream, i, Verdict.false(residuals[0], at)))
            self._rounds[stream.name] = _ROUNDS

    def judge(self) -> None:
        """Stage the decisions that are due, on new and on older measurements."""
        timeline = self._problem.timeline
        now_s = timeline.seconds(timeline.stamps_ns[timeline.last])
        for name, stream in self._problem.streams.items():
            rounds = self._rounds.pop(name, 0)
            if rounds:
                unsettled = self._by_hypotheses(stream, self._group(stream))
                if rounds > 1 and unsettled:
                    self._rounds[name] = rounds - 1
            elif stream.row.has_hypotheses and now_s >= self._rejudged_s.get(name, 0.0) + _OLDER_EVERY_S:
                self._rejudge_older(stream, now_s)
                if name in self._others:
                    self._unsure.add(name)
        due = []
        while self._scheduled and self._scheduled[0][0] <= now_s:
            due.append(heapq.heappop(self._scheduled)[2])
        for entry in due:
            self._rejudge(entry, now_s)

    # By a kernel

    def _by_kernel(
        self, stream: LiveStream, i: int, at: Attachment, residual: Residual, *, fresh: bool
    ) -> tuple[Verdict, bool]:
        """Judge a measurement by its sensor's kernel, widened by the scatter of the sensor's residuals.

        Args:
            i: index of the measurement. at, residual: at the present estimate.
            fresh: whether it is new: the kernel is then also widened where the prediction is uncertain.

        Returns:
            The verdict, and whether the prediction widened the kernel.
        """
        own, dof = stream.config.kernel, len(residual.raw)
        noisier = stream.noisier
        scale = own.scale * stream.scatter.times / noisier * float(np.sqrt(dof))
        plain = nis = residual.nis() / noisier**2
        widened, inflation = False, None
        if fresh and own.kind != "none" and nis > scale**2:
            inflation = self._states.prediction(stream, at, stream.state[i], residual).cov
            nis = residual.nis(inflation) / noisier**2
            widened = plain > 1.5 * nis
            scale *= float(np.sqrt(plain / max(nis, 1e-9))) if widened else 1.0
        if fresh:
            stream.scatter.note(stream.measurements[i].stamp_ns, residual.normalised(inflation))
        kernel = KernelConfig(kind=own.kind, scale=scale)
        return Verdict(Decision(weight=noisier**-2, kernel=kernel), kernel.weight(plain), 1.0, residual, 0, at), widened

    def _schedule(self, due_s: float, entry: Entry) -> None:
        heapq.heappush(self._scheduled, (due_s, next(self._turn), entry))

    def _rejudge(self, entry: Entry, now_s: float) -> None:
        if not self._entries.reachable(entry) or entry.verdict.decision is None:
            return
        at, residuals = self._entries.residuals_at(entry.stream, entry.index)
        verdict, widened = self._by_kernel(entry.stream, entry.index, at, residuals[0], fresh=False)
        if verdict.weight >= AGREES:
            self._agreement.note(entry.stream, entry.measurement, verdict)
        if entry.widened or entry.weighs_other(verdict):
            entry.widened = widened
            self._entries.change(entry, verdict)
        else:
            entry.verdict = replace(verdict, decision=entry.verdict.decision)
        age_s = now_s - self._problem.timeline.seconds(entry.measurement.stamp_ns)
        if age_s < _REJUDGE_AGES_S[1]:
            self._schedule(now_s + _REJUDGE_AGES_S[1] - age_s, entry)

    # By hypotheses

    def _by_hypotheses(self, stream: LiveStream, own: list[Entry]) -> bool:
        """Judge measurements of a stream as one sequence, new ones against the prediction.

        Returns:
            Whether another round may change the verdicts.
        """
        unsettled = False
        if not own:
            return False
        attached, residuals = self._attach(own)
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
            if not entry.judged:
                self._note_arrival(stream, entry.measurement, verdict)
            verdict, differs = replace(verdict, settled=settled), entry.differs(verdict)
            unsettled |= differs if entry.judged else verdict.weight < _SURE
            entry.judged = True
            if differs:
                self._entries.change(entry, verdict)
            else:
                entry.verdict = replace(verdict, decision=entry.verdict.decision, at=entry.verdict.at)
        return unsettled

    def _note_arrival(self, stream: LiveStream, m: Measurement, verdict: Verdict) -> None:
        """Note what follows from the first verdict on a measurement: a denial, a trial of others, choices to weigh."""
        agrees = verdict.weight >= AGREES
        self.denials.note(stream.name, m.stamp_ns, 0.0, agrees=agrees, outlier=True)
        if not agrees:
            self._refuted.add(stream.name)
        if verdict.weight < _CERTAIN or stream.name in self._others:
            self._unsure.add(stream.name)

    def _group(self, stream: LiveStream, back: int = 0) -> list[Entry]:
        """Return a group of at most `_GROUP` measurements of a stream that can still be judged, by stamp.

        Args:
            back: 0: the newest group; n: the n-th before it.
        """
        own = self._entries.of(stream)
        end = len(own) - back * _GROUP
        return own[max(end - _GROUP, 0) : max(end, 0)]

    def _rejudge_older(self, stream: LiveStream, now_s: float) -> None:
        """Judge the next older group again, as later data may decide otherwise; after the oldest, begin again."""
        self._rejudged_s[stream.name] = now_s
        back = self._groups_back.get(stream.name, 0) + 1
        own = self._group(stream, back)
        self._groups_back[stream.name] = back if own else 0
        self._by_hypotheses(stream, own)

    def _attach(self, own: list[Entry]) -> tuple[list[Attachment], list[tuple[Residual, ...]]]:
        """Return the attachments of entries at the present estimate, and the residuals there, one per mode."""
        met = [self._entries.residuals_at(e.stream, e.index) for e in own]
        return [at for at, _ in met], [found for _, found in met]

    # Other choices: a choice confirms itself, because the estimate follows it (see `graphloc.solve._choices`)

    def try_others(self) -> bool:
        """Where measurements judged false agree with each other, try to believe them, and keep what is more probable.

        Returns:
            Whether anything was tried.
        """
        names, self._refuted = self._refuted, set()
        moved = False
        for name in sorted(names):
            stream = self._problem.streams[name]
            own = self._group(stream)
            if len(own) < _CHAIN:
                continue
            attached, found = self._attach(own)
            chain = best_chain(stream, [e.index for e in own], found)
            believed = [e.verdict.mode if e.held is not None and e.verdict.weight >= AGREES else None for e in own]
            others = [mode for mode, held in zip(chain, believed, strict=True) if mode != held]
            tried = frozenset((e.index, mode) for e, mode in zip(own, chain, strict=True))
            # A single other measurement may agree with some of the believed ones and contradict the rest: no reason for
            # a trial.
            if len(others) < _CHAIN or all(mode is None for mode in others) or tried == self._tried.get(name):
                continue
            self._tried[name] = tried
            moved = True
            self._try(stream, own, believing(chain, found, attached))
        unsure, self._unsure = self._unsure, set()
        for name in sorted(unsure):
            moved |= self._weigh_choices(self._problem.streams[name])
        return moved

    def _weigh_choices(self, stream: LiveStream) -> bool:
        """Try the most probable choice of the newest measurements, and keep the spread of the others.

        Only a choice that believes a further measurement or another mode is tried: that measurements are false explains
        a frozen sensor, too.

        Returns:
            Whether the estimate may have moved.
        """
        settled = False
        for tried in range(_ROUNDS):
            self._others.pop(stream.name, None)
            own = self._group(stream)
            if not own or stream.constants:
                return settled or tried > 0
            attached, found = self._attach(own)
            held = [e.within for e in own]
            cov = self._states.joint(attached, [modes[0] for modes in found])
            weighed, unplaced = choices(stream, [e.index for e in own], found, cov, held)
            if unplaced and (solved := self._solved_without(stream, own)):
                weighed, settled = solved, True
            best = weighed[0].modes
            now = tuple(h[0] if h is not None and h[1] >= AGREES else None for h in held)
            chosen = frozenset((e.index, mode) for e, mode in zip(own, best, strict=True))
            gains = any(mode is not None and mode != other for mode, other in zip(best, now, strict=True))
            if gains and chosen != self._chosen.get(stream.name):
                self._chosen[stream.name] = chosen
                self._try(stream, own, believing(best, found, attached))
                continue
            mean, around = _spread(weighed, cov, moves=best == now, unplaced=unplaced)
            if np.trace(around) > _SHOWS * np.trace(cov[:3, :3]):
                self._others[stream.name] = mean, around
            return settled or tried > 0
        return True

    def _solved_without(self, stream: LiveStream, own: list[Entry]) -> list[Choice]:
        """Return the choices (see `choices`) from the window solved without the measurements `own`; none if that fails.

        It is for measurements much more precise than everything else together: linear algebra alone does not tell where
        the estimate is without them.
        """
        self._window.settle()
        newest = keys.pose(self._problem.timeline.last)
        here, back = self._window.values.atPose3(newest).translation(), self._entries.marked(own)
        try:
            for entry in own:
                self._entries.change(entry, replace(entry.verdict, decision=None))
            self._window.settle(_STEPS)
            attached, found = self._attach(own)
            cov = self._states.joint(attached, [modes[0] for modes in found])
            weighed, _ = choices(stream, [e.index for e in own], found, cov, [e.within for e in own])
            step = np.zeros(len(cov))
            step[:3] = self._window.values.atPose3(newest).translation() - here
            return [replace(c, step=c.step + step) for c in weighed]
        except (SolveError, RuntimeError, ArithmeticError, ValueError, np.linalg.LinAlgError):
            return []
        finally:
            back()

    def _try(self, stream: LiveStream, own: list[Entry], others: list[Verdict]) -> None:
        """Apply other verdicts and iterate; restore the window if that is less probable, or the solver fails.

        The window is restored from a copy: the solver's own steps would not lead back from far off.
        """
        self._window.settle()
        cost, agreement, back = self._cost(stream, own), self._agreement.marked(), self._entries.marked(own)
        try:
            for entry, verdict in zip(own, others, strict=True):
                self._entries.change(entry, verdict)
            self._window.settle(_STEPS)  # a metre off, the cost after one step means nothing
            self._by_hypotheses(stream, self._group(stream))
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
        """Return minus the log probability of the window, marginalised over all hypotheses of a stream."""
        evidence = log_evidence_of(stream, [e.index for e in own], self._attach(own)[1])
        return self._window.error([e.held for e in own if e.held is not None]) - evidence


def _spread(weighed: Sequence[Choice], cov: Array, *, moves: bool, unplaced: bool) -> tuple[Array, Array]:
    """Return what choices add to the newest position, by their probability: mean (3,), m, and covariance (3, 3), m^2.

    Choices that leave the position hardly determined do not move the mean: their share of a step of 100 m is a position
    that no choice means.

    Args:
        weighed: choices, the most probable one first. cov: joint covariance of the estimate, its newest position first.
        moves: whether the present choice is the most probable one. If not, that one was tried and rejected, and the
            mean stays.
        unplaced: see `choices`.
    """
    share, steps = np.exp([c.log for c in weighed]), np.array([c.step[:3] for c in weighed])
    tells = np.array([np.trace(c.cov[:3, :3]) for c in weighed]) < _LOOSE * np.trace(cov[:3, :3])
    mean = (share * tells) @ steps if moves else np.zeros(3)
    around = (share[:, None] * (steps - mean)).T @ (steps - mean)
    if unplaced:
        around += sum((p * _more(c.cov, cov) for p, c in zip(share, weighed, strict=True)), np.zeros((3, 3)))
    return mean, around


def _more(cov: Array, than: Array) -> Array:
    """Return by how much the position's covariance (3, 3) in `cov` exceeds that in `than`, axis by axis; at least 0.

    Args:
        cov, than: joint covariances, position first.
    """
    size, axes = np.linalg.eigh(cov[:3, :3] - than[:3, :3])
    return np.asarray((axes * np.maximum(size, 0.0)) @ axes.T)
