# SPDX-License-Identifier: Apache-2.0
"""The last seconds of a run: states that grow, measurements that are taken, judged, judged again, and let go.

A sensor with a kernel is judged when it comes, and once or twice again. What of it disagrees is asked whether the
prediction is sure enough to say so: where it is not, after an outage, the kernel bends later. A sensor with
hypotheses is judged as the batch does it, as a sequence, against the prediction while it is new.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build import (
    CHAIN_END,
    CONSTANT_TAILS,
    attach,
    bias_step,
    constant_keys,
    nav_state,
    slow_begin,
    slow_end,
    slow_step,
)
from graphloc.config import KernelConfig
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, Residual
from graphloc.ledger import LedgerRow
from graphloc.measurements import Measurement
from graphloc.online._anchor import Anchor, Beside, beside, without_prior
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._window import Held, Window, keys_of
from graphloc.solve._best_chain import best_chain
from graphloc.solve._decide import NEGLIGIBLE, Verdict, by_hypotheses
from graphloc.solve._foreseen import root_of
from graphloc.solve._hypotheses import log_evidence_of
from graphloc.solve._solution import AGREES, row_of

_AGAIN_S = (1.0, 4.0)  # ages at which a kernel is asked again
_CHANGED = 0.1  # of a weight, from which a decision is made anew in the graph
_MOVED_M, _TURNED_RAD = 0.1, 0.01  # of the state a factor was linearised at
_SAME = 1e-9  # m, rad: the solver has linearised a pose anew, or not
_PAGE_S = 1.0  # states leave together by so much
_LEAF_S, _SURE = 1.0, 0.9  # how often an older chapter is judged again; a weight that needs no second look
_STEP_COST = (
    1.0  # of 9 squares: the median where the IMU agrees is below 0.2, where its noise is 3 times too small 1 to 10
)
_CHAPTER = 10  # hypotheses that are judged as one sequence
_ROUNDS = 2  # of judging what is new
_CHAIN = 2  # measurements that agree with each other, and not with the estimate
_FAR_M = 20e3  # from the estimate: no place of this run; beyond, the linear algebra fails before a kernel helps
_CREDIBLE = 6.0  # sigmas of a slow error: beyond, a sensor that agrees does so by an error that it does not have
_FEW = 8  # measurements of absolute sensors in a row that disagree: not yet a sign
_STEPS = 3  # of the solver, where other choices are tried
_STEP_M = 0.3  # a commit that moves the newest state by so much is solved on
_MOST_STEPS, _STANDS = 10, 0.1  # at most so often, until a step changes its cost by no more than such a share


@dataclass(slots=True, eq=False)
class _Entry:
    """A measurement in the window."""

    stream: LiveStream
    index: int
    verdict: Verdict
    held: Held | None = None
    written: Any = None  # the pose whose tangent its factors are written in
    opened: bool = False  # its kernel bends later than configured
    judged: bool = False  # as a hypothesis, once at least

    @property
    def measurement(self) -> Measurement:
        return self.stream.measurements[self.index]

    @property
    def state(self) -> int:
        return self.stream.state[self.index]

    def reaches(self, first: int) -> bool:
        """Whether the states that it is carried from are still there."""
        carry = self.stream.carry[self.index]
        return self.state >= first and (carry is None or carry[0] >= first)


@dataclass(frozen=True, slots=True, eq=False)
class Newest:
    """The newest state: pose (gtsam.Pose3) and velocity (3,) of the IMU's place, bias, covariances (6, 6) and (3, 3)."""

    stamp_ns: int
    pose: gtsam.Pose3
    velocity: Array
    bias: gtsam.imuBias.ConstantBias
    pose_cov: Array
    velocity_cov: Array


class Lag:
    """States and measurements of the last seconds, from an anchor on.

    Raises (every method): SolveError: from then on it is of no use.
    """

    def __init__(
        self, problem: LiveProblem, anchor: Anchor, lag_s: float, guess: tuple[gtsam.Pose3, Array, Array] | None = None
    ) -> None:
        self.problem, self._window = problem, Window(lag_s)
        self._origin_ns, self._lag_s = anchor.stamp_ns, lag_s
        self._entries: dict[tuple[int, int], _Entry] = {}
        self._again: list[tuple[float, int, _Entry]] = []  # a heap: when, and in turn
        self._turn = count()
        self._rounds: dict[str, int] = {}
        self._leaves: dict[str, int] = {}  # how many chapters back was judged again
        self._leafed_s: dict[str, float] = {}  # and when
        self._refuted: set[str] = set()  # sensors of which something new was judged false
        self._tried: dict[str, frozenset[tuple[int, int | None]]] = {}
        self._ends: dict[str, Held] = {}
        self._links: dict[int, Held] = {}  # by the state that each begins at
        self._known: dict[int, Beside] = {}
        self._gone: list[LedgerRow] = []
        self.agreed_ns: dict[str, int] = {}
        self._refused: list[int] = []  # stamps of absolute measurements since the last that agreed: the first few
        self._begin(anchor, guess or (anchor.pose, anchor.velocity, anchor.bias))

    def _begin(self, anchor: Anchor, guess: tuple[gtsam.Pose3, Array, Array]) -> None:
        window = self._window
        state = (keys.pose(0), keys.velocity(0), keys.bias(0))
        pose, velocity, bias = guess
        window.guess(state[0], pose, 0.0)
        window.guess(state[1], velocity, 0.0)
        window.guess(state[2], gtsam.imuBias.ConstantBias(bias[:3], bias[3:]), 0.0)
        window.add(anchor.factors(*state))
        for stream in self.problem.streams.values():
            if stream.slow is not None:
                key, known = keys.slow(stream.number, 0), anchor.slow.get(stream.name)
                if known is not None and len(known.value) != len(stream.slow.sigma):
                    raise SolveError(f"{stream.name}: its slow error is of another size")
                window.guess(key, np.zeros(len(stream.slow.sigma)) if known is None else known.value, 0.0)
                window.add([slow_begin(stream.slow, key, np.zeros(len(stream.slow.sigma)))]
                           if known is None else [anchor.beside(known, state[0], key)])  # fmt: skip
                self._ends[stream.name] = window.add(slow_end(stream.slow, key))
            for k, key in enumerate(constant_keys(stream)):
                if (stream.name, k) in anchor.constants:
                    self._known[key] = anchor.constants[(stream.name, k)]
        window.commit()
        self._committed = 0  # the last state that the solver has
        self._page_s = 0.0
        self.fresh = False
        """The last commit linearised anew what had moved."""
        self._newest = self._read_newest()

    @property
    def newest(self) -> Newest:
        return self._newest

    @property
    def first_ns(self) -> int:
        """Stamp from which on measurements can be taken."""
        return self.problem.timeline.stamps_ns[self.problem.timeline.first]

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self._origin_ns) * 1e-9

    def _page(self, stamp_ns: int) -> float:
        """When keys of a stamp are told to be from: those of a page leave together.

        What leaves is re-eliminated together with all that is newer: once a second, and not at every state.
        """
        return float(np.ceil(self._seconds(stamp_ns) / _PAGE_S)) * _PAGE_S

    # States

    def grow(self, stamp_ns: int) -> bool:
        """Stage the next state, where the IMU says that it is; tell whether slow states got a node, which closes a commit."""
        timeline, window, links = self.problem.timeline, self._window, self.problem.links
        k, values = timeline.last, window.values
        j, before_ns = timeline.slow_of[k], timeline.stamps_ns[k]
        timeline.append(stamp_ns)
        following, t = timeline.slow_of[k + 1], self._page(stamp_ns)
        bias = values.atConstantBias(keys.bias(j))
        pim = links.integrate(before_ns, stamp_ns, gtsam.imuBias.ConstantBias())
        there = pim.predict(nav_state(values, k), bias)
        window.guess(keys.pose(k + 1), there.pose(), t)
        window.guess(keys.velocity(k + 1), np.asarray(there.velocity()), t)
        self._links[k] = window.add([links.factor(k, j, pim)])
        if following != j:
            dt_s = (timeline.slow_stamps_ns[following] - timeline.slow_stamps_ns[j]) * 1e-9
            window.guess(keys.bias(following), bias, t)
            window.add([bias_step(links, j, dt_s)])
            self._next_slow(j, dt_s, t)
        window.touch(keys.bias(following), t)
        for stream in self.problem.streams.values():
            if stream.slow is not None:
                window.touch(keys.slow(stream.number, following), t)
        return bool(following != j)

    def _next_slow(self, j: int, dt_s: float, t: float) -> None:
        window = self._window
        for stream in self.problem.streams.values():
            if stream.slow is None:
                continue
            key, following = (keys.slow(stream.number, n) for n in (j, j + 1))
            window.guess(following, np.atleast_1d(window.values.atVector(key)), t)
            window.add(slow_step(stream.slow, key, following, dt_s))
            if stream.name in self._ends:
                window.remove(self._ends[stream.name])
            ends = list(slow_end(stream.slow, following))
            if ends:
                self._ends[stream.name] = window.add(ends)

    def mend(self, holes: Sequence[tuple[int, int]]) -> None:
        """Stage anew what was integrated without IMU samples that came late; holes: the stamps (ns) that each lies between."""
        timeline, links, window = self.problem.timeline, self.problem.links, self._window
        torn = {k for a, b in holes for k in range(timeline.floor(a), timeline.floor(b) + 1)}
        for entry in self._entries.values():
            carry = entry.stream.carry[entry.index]
            if carry is not None and carry[0] in torn and entry.reaches(timeline.first):
                self.problem.carry_anew(entry.stream, entry.index)
                if entry.held is not None:
                    at = attach(self.problem, entry.stream, entry.index, window.values)
                    self._change(entry, replace(entry.verdict, at=at))
        for k in sorted(torn):
            if k in self._links and window.remove(self._links[k]):
                pim = links.integrate(timeline.stamps_ns[k], timeline.stamps_ns[k + 1], gtsam.imuBias.ConstantBias())
                self._links[k] = window.add([links.factor(k, timeline.slow_of[k], pim)])

    def commit(self) -> None:
        """Estimate anew, and let go what has left."""
        timeline, window = self.problem.timeline, self._window
        pose, now_s = keys.pose(timeline.last), self._page(timeline.stamps_ns[timeline.last])
        self.fresh = now_s > self._page_s
        if self.fresh:  # just before a page leaves, which re-eliminates everything as well
            self._page_s = now_s
            window.relinearise()
            self._write_anew(self._left_behind)
        self._keep_constants(now_s)
        before = window.values.atPose3(pose).translation()
        window.commit()
        self._let_go()
        if not float(np.linalg.norm(window.values.atPose3(pose).translation() - before)) < _STEP_M:
            self._settle_down()
        self._committed = timeline.last
        self._newest = self._read_newest()

    def _write_anew(self, stale: Callable[[_Entry], bool]) -> None:
        """Stage anew, at the estimate, the stale ones of the factors that see to centimetres: of sensors with hypotheses."""
        first = self.problem.timeline.first
        for entry in self._entries.values():
            if entry.stream.row.false is None or entry.held is None or not entry.reaches(first):
                continue
            if stale(entry):
                at = attach(self.problem, entry.stream, entry.index, self._window.values)
                self._change(entry, replace(entry.verdict, at=at))

    def _left_behind(self, entry: _Entry) -> bool:
        """Whether it is written in a tangent that the solver has left (`graphloc.linear.pose_term`), or before its next slow node came."""
        at = entry.verdict.at
        loose = at.slow_key is not None and at.slow_next is None
        return loose or not self._window.linearised_at(at.pose_key).equals(entry.written, _SAME)

    def _elsewhere(self, entry: _Entry) -> bool:
        """Whether it is linear about a place that the estimate has left: judged there, right ones look false."""
        at = entry.verdict.at
        return _moved(at.T_world_body, self._window.values.atPose3(at.pose_key))

    def _settle_down(self) -> None:
        """Solve again and again, until the cost stands: one step from metres off leaves older states further off than the newest."""
        cost = self._window.error()
        for _ in range(_MOST_STEPS):
            self._write_anew(self._elsewhere)
            self._window.settle()
            before, cost = cost, self._window.error()
            if abs(before - cost) <= _STANDS * cost:
                break

    def _read_newest(self) -> Newest:
        timeline, values = self.problem.timeline, self._window.values
        k = timeline.last
        newest = Newest(
            stamp_ns=timeline.stamps_ns[k],
            pose=values.atPose3(keys.pose(k)),
            velocity=np.asarray(values.atVector(keys.velocity(k))),
            bias=values.atConstantBias(keys.bias(timeline.slow_of[k])),
            pose_cov=self._window.covariance([keys.pose(k)]),
            velocity_cov=self._window.covariance([keys.velocity(k)]),
        )
        arrays = (newest.pose.matrix(), newest.velocity, newest.bias.vector(), newest.pose_cov, newest.velocity_cov)
        if not all(np.isfinite(a).all() for a in arrays) or min(np.diagonal(newest.pose_cov)) <= 0.0:
            raise SolveError("the solver's result is not a number")
        return newest

    def _let_go(self) -> None:
        """Forget the states that have left the window, and enter their measurements into the ledger."""
        timeline = self.problem.timeline
        gone = timeline.first
        while gone < timeline.last and not self._window.is_committed(keys.pose(gone)):
            gone += 1
        if gone == timeline.first:
            return
        for k in range(timeline.first, gone):
            self._links.pop(k, None)
        timeline.forget(gone)
        for key, entry in list(self._entries.items()):
            if entry.state < gone:
                self._gone.append(self._row(entry))
                del self._entries[key]
        for stream in self.problem.streams.values():
            kept = min((i for n, i in self._entries if n == stream.number), default=len(stream.measurements))
            for tape in (stream.measurements, stream.state, stream.carry, stream.gyro_radps):
                tape.forget(kept)
        self.problem.links.forget(timeline.stamps_ns[gone])

    def _row(self, entry: _Entry) -> LedgerRow:
        stream = entry.stream
        return row_of(stream, entry.measurement, stream.config.topic, entry.verdict)

    def settle(self) -> None:
        """Relinearise, where many states came at once."""
        self._window.settle()
        self._newest = self._read_newest()

    def gone(self) -> list[LedgerRow]:
        """Return rows of measurements that have left since this was last asked."""
        rows, self._gone = self._gone, []
        return [row for row in rows if row.seq >= 0]

    def held(self) -> list[LedgerRow]:
        """Return rows, as they stand, of what is in the window."""
        return [self._row(e) for e in self._entries.values() if e.measurement.seq >= 0]

    # Measurements

    def take(self, m: Measurement) -> None:
        """Stage a measurement whose stamp lies within the states."""
        stream, i = self.problem.take(m)
        at = attach(self.problem, stream, i, self._window.values)
        residuals = stream.row.residuals(m, stream.config, at)
        if (away_m := min(r.size_m or 0.0 for r in residuals)) > _FAR_M:
            self._note(stream, m, None)
            raise SolveError(f"it lies {away_m / 1e3:.0f} km away")
        if stream.row.false is None:
            verdict, opened = self._by_kernel(stream, i, at, residuals[0], fresh=True)
            self._note(stream, m, verdict)
            entry = _Entry(stream, i, verdict, opened=opened)
            self._put(entry)
            self._ask_at(self._seconds(m.stamp_ns) + _AGAIN_S[0], entry)
        else:
            entry = _Entry(stream, i, Verdict(None, 0.0, 1.0, residuals[0], 0, at))
            self._rounds[stream.name] = _ROUNDS
        self._entries[(stream.number, i)] = entry

    def _note(self, stream: LiveStream, m: Measurement, verdict: Verdict | None) -> None:
        """Remember when absolute sensors agreed, and how long none has."""
        if not stream.row.absolute:
            return
        if verdict is not None and verdict.weight >= AGREES and _credible(stream, verdict.at):
            self.agreed_ns[stream.name] = max(m.stamp_ns, self.agreed_ns.get(stream.name, m.stamp_ns))
            self._refused = [stamp for stamp in self._refused if stamp > m.stamp_ns]
        elif len(self._refused) < _FEW:
            self._refused.append(m.stamp_ns)

    @property
    def refused_s(self) -> float:
        """For how long absolute sensors have said, more than a few times, that it is elsewhere, and none that it is here."""
        return (
            self._seconds(self._newest.stamp_ns) - self._seconds(self._refused[0])
            if len(self._refused) == _FEW
            else 0.0
        )

    def judge(self) -> None:
        """Stage what is to be decided, anew or again."""
        now_s = self._seconds(self.problem.timeline.stamps_ns[self.problem.timeline.last])
        for name, stream in self.problem.streams.items():
            rounds = self._rounds.pop(name, 0)
            if rounds:
                unsettled = self._by_hypotheses(stream, self._judged(stream))
                if rounds > 1 and unsettled:
                    self._rounds[name] = rounds - 1
            elif stream.row.false is not None and now_s >= self._leafed_s.get(name, 0.0) + _LEAF_S:
                self._leaf_back(stream, now_s)
        due = []
        while self._again and self._again[0][0] <= now_s:
            due.append(heapq.heappop(self._again)[2])
        for entry in due:
            self._ask_again(entry, now_s)

    def _leaf_back(self, stream: LiveStream, now_s: float) -> None:
        """Judge an older chapter again, each in its turn: what came since may say otherwise."""
        self._leafed_s[stream.name] = now_s
        back = self._leaves.get(stream.name, 0) + 1
        own = self._judged(stream, back)
        self._leaves[stream.name] = back if own else 0
        self._by_hypotheses(stream, own)

    def _ask_at(self, due_s: float, entry: _Entry) -> None:
        heapq.heappush(self._again, (due_s, next(self._turn), entry))

    # Other choices: what was chosen confirms itself, for the estimate follows it (see `graphloc.solve._choices`)

    def try_others(self) -> None:
        """Where what was judged false agrees among itself, try that instead, and keep what is more probable."""
        names, self._refuted = self._refuted, set()
        moved = False
        for name in names:
            stream = self.problem.streams[name]
            own = self._judged(stream)
            if len(own) < _CHAIN:
                continue
            attached = [attach(self.problem, stream, e.index, self._window.values) for e in own]
            found = [
                stream.row.residuals(e.measurement, stream.config, at) for e, at in zip(own, attached, strict=True)
            ]
            chain = best_chain(stream, [e.index for e in own], found)
            differ = [e for e, mode in zip(own, chain, strict=True)
                      if mode is not None and (e.held is None or mode != e.verdict.mode)]  # fmt: skip
            tried = frozenset((e.index, mode) for e, mode in zip(own, chain, strict=True))
            if len(differ) < _CHAIN or tried == self._tried.get(name):
                continue
            self._tried[name] = tried
            moved = True
            self._try(stream, own, [
                Verdict(None if mode is None else Decision(mode=mode), float(mode is not None), 1.0, r[mode or 0], mode or 0, at)
                for mode, r, at in zip(chain, found, attached, strict=True)
            ])  # fmt: skip
        if moved:
            self._newest = self._read_newest()

    def _try(self, stream: LiveStream, own: list[_Entry], others: list[Verdict]) -> None:
        """Take other verdicts, settle around them, and go back if that is less probable."""
        self._window.settle()
        before, cost = [e.verdict for e in own], self._cost(stream, own)
        for verdicts in (others, None):
            if verdicts is not None:
                for entry, verdict in zip(own, verdicts, strict=True):
                    self._change(entry, verdict)
            else:
                self._by_hypotheses(stream, self._judged(stream))
            self._window.settle(_STEPS)  # a metre off, one step says nothing of the cost
        if self._cost(stream, own) < cost:
            self._rounds[stream.name] = _ROUNDS
            return
        for entry, verdict in zip(own, before, strict=True):
            self._change(entry, verdict)
        self._window.settle(_STEPS)

    def _cost(self, stream: LiveStream, own: list[_Entry]) -> float:
        """Minus the log of the probability of the window, all hypotheses of a stream summed over."""
        values = self._window.values
        found = [
            stream.row.residuals(
                e.measurement, stream.config, attach(self.problem, stream, e.index, values)
            ) for e in own
        ]  # fmt: skip
        evidence = log_evidence_of(stream, [e.index for e in own], found)
        return self._window.error([e.held for e in own if e.held is not None]) - evidence

    def _judged(self, stream: LiveStream, back: int = 0) -> list[_Entry]:
        """A chapter of a stream that can still be judged, by stamp: the newest, or so many before it."""
        first = self.problem.timeline.first
        own = [e for e in self._entries.values() if e.stream is stream and e.reaches(first)]
        end = len(own) - back * _CHAPTER
        return sorted(own, key=lambda e: (e.measurement.stamp_ns, e.index))[max(end - _CHAPTER, 0) : max(end, 0)]

    def _ask_again(self, entry: _Entry, now_s: float) -> None:
        if (entry.stream.number, entry.index) not in self._entries or not entry.reaches(self.problem.timeline.first):
            return
        at = attach(self.problem, entry.stream, entry.index, self._window.values)
        residual = entry.stream.row.residuals(entry.measurement, entry.stream.config, at)[0]
        verdict, opened = self._by_kernel(entry.stream, entry.index, at, residual, fresh=False)
        if verdict.weight >= AGREES:
            self._note(entry.stream, entry.measurement, verdict)
        if entry.opened or abs(verdict.weight - entry.verdict.weight) > _CHANGED:
            entry.opened = opened
            self._change(entry, verdict)
        else:
            entry.verdict = replace(verdict, decision=entry.verdict.decision)
        age_s = now_s - self._seconds(entry.measurement.stamp_ns)
        if age_s < _AGAIN_S[1]:
            self._ask_at(now_s + _AGAIN_S[1] - age_s, entry)

    def _by_kernel(
        self, stream: LiveStream, i: int, at: Attachment, residual: Residual, *, fresh: bool
    ) -> tuple[Verdict, bool]:
        """The sensor's kernel: as wide as its residuals scatter, and as the prediction is unsure. True: for that reason."""
        own, dof = stream.config.kernel, len(residual.raw)
        scale = own.scale * stream.spread * float(np.sqrt(dof))
        plain = nis = residual.nis()
        opened = False
        if fresh and own.kind != "none" and nis > scale**2:
            root = self._unsure(stream, at, stream.state[i], residual)
            nis = residual.nis(root @ root.T)
            opened = plain > 1.5 * nis
            scale *= float(np.sqrt(plain / max(nis, 1e-9))) if opened else 1.0
        if fresh:
            stream.scattered(nis, dof)
        kernel = KernelConfig(kind=own.kind, scale=scale)
        return Verdict(Decision(kernel=kernel), kernel.weight(plain), 1.0, residual, 0, at), opened

    def _unsure(self, stream: LiveStream, at: Attachment, k: int, residual: Residual) -> Array:
        """Root (m, n) of the covariance of what is predicted of a residual, from pose and slow state together."""
        timeline, window = self.problem.timeline, self._window
        base = min(k, self._committed)
        wanted, size = [keys.pose(base)], 6
        if residual.slow_jacobian is not None and at.slow_value is not None:
            wanted.append(keys.slow(stream.number, timeline.slow_of[base]))
            size += len(at.slow_value)
        if any(not window.is_committed(key) for key in wanted):
            return np.zeros((len(residual.raw), size))
        P = np.array(window.covariance(wanted))
        if base != k:  # what velocity and the IMU's noise add on the way: much, across a gap
            from_ns, to_ns = timeline.stamps_ns[base], timeline.stamps_ns[k]
            R = at.T_world_body.rotation().matrix()
            P[3:6, 3:6] += ((to_ns - from_ns) * 1e-9) ** 2 * R.T @ self._newest.velocity_cov @ R
            pim = self.problem.links.integrate(from_ns, to_ns, self._newest.bias)
            P[:6, :6] += np.asarray(pim.preintMeasCov())[:6, :6]
        return root_of(residual, at, P)

    def _by_hypotheses(self, stream: LiveStream, own: list[_Entry]) -> bool:
        """Judge measurements of a stream as one sequence; what is new, by the prediction. Tell whether it may change yet."""
        values, unsettled = self._window.values, False
        if not own:
            return False
        attached = [attach(self.problem, stream, e.index, values) for e in own]
        residuals = [
            stream.row.residuals(e.measurement, stream.config, at) for e, at in zip(own, attached, strict=True)
        ]
        roots = [
            self._unsure(stream, at, e.state, found[0]) if e.held is None and e.verdict.decision is None and not e.judged else None
            for e, at, found in zip(own, attached, residuals, strict=True)
        ]  # fmt: skip
        verdicts = by_hypotheses(stream, [e.index for e in own], attached, residuals, roots)
        for entry, verdict in zip(own, verdicts, strict=True):
            settled = entry.verdict.settled + (entry.judged and verdict.mode != entry.verdict.mode)
            if not entry.judged or verdict.weight >= AGREES:
                self._note(stream, entry.measurement, verdict)
            if not entry.judged and verdict.weight < AGREES:
                self._refuted.add(stream.name)
            verdict, differs = replace(verdict, settled=settled), self._differs(entry, verdict)
            unsettled |= differs if entry.judged else verdict.weight < _SURE
            entry.judged = True  # it has been judged
            if differs:
                self._change(entry, verdict)
            else:
                entry.verdict = replace(verdict, decision=entry.verdict.decision, at=entry.verdict.at)
        return unsettled

    def _differs(self, entry: _Entry, verdict: Verdict) -> bool:
        """Whether what is in the graph is not what was decided, or is linearised elsewhere."""
        old = entry.verdict
        if (entry.held is None) != (verdict.decision is None):
            return True
        if verdict.decision is None or old.decision is None:
            return False
        return (
            verdict.mode != old.mode
            or abs(verdict.decision.weight - old.decision.weight) > _CHANGED
            or _moved(old.at.T_world_body, verdict.at.T_world_body)
        )

    def _change(self, entry: _Entry, verdict: Verdict) -> None:
        """Take an entry out of the graph, and in again as it is judged now; it stays where its part has left."""
        if entry.held is not None:
            if not self._window.remove(entry.held):
                return
            entry.held = None
        entry.verdict = verdict
        self._put(entry)

    def _put(self, entry: _Entry) -> None:
        """Stage the factors of an entry."""
        stream, verdict = entry.stream, entry.verdict
        m = entry.measurement
        if verdict.decision is None or verdict.decision.weight <= NEGLIGIBLE:
            return
        window, t = self._window, self._page(self.problem.timeline.stamps_ns[entry.state])
        at = replace(verdict.at, T_solver=window.linearised_at(verdict.at.pose_key))
        update = stream.row.factors(m, stream.config, at, verdict.decision)
        for key, value in update.guesses:
            if not window.values.exists(key):
                window.guess(key, value, t)
        used = {key for factor in update.factors for key in keys_of(factor)}
        self._use_constants(stream, used)
        entry.held, entry.written = window.add(update.factors), at.T_solver

    # Constants of a sensor: in the graph while they are seen, remembered when they are not

    def _use_constants(self, stream: LiveStream, used: set[int]) -> None:
        window, timeline = self._window, self.problem.timeline
        now_s = self._page(timeline.stamps_ns[timeline.last])
        for key, constant in zip(constant_keys(stream), stream.constants, strict=True):
            if key not in used:
                continue
            if not window.values.exists(key):
                known = self._known.pop(key, None)
                if known is None:
                    value = np.zeros(len(constant.sigma))
                    tails = gtsam.noiseModel.mEstimator.Cauchy.Create(float(np.sqrt(CONSTANT_TAILS)))
                    model: Any = gtsam.noiseModel.Robust.Create(tails, gtsam.noiseModel.Diagonal.Sigmas(constant.sigma))
                else:
                    value, model = known.value, gtsam.noiseModel.Gaussian.Covariance(known.cov)
                window.guess(key, value, now_s)
                window.add([gtsam.PriorFactorVector(key, value, model)])
            window.touch(key, now_s)

    def _constants(self) -> Iterator[tuple[LiveStream, int, int]]:
        for stream in self.problem.streams.values():
            for k, key in enumerate(constant_keys(stream)):
                yield stream, k, key

    def _keep_constants(self, now_s: float) -> None:
        for key in self._window.leaving([key for _, _, key in self._constants()], now_s):
            value = np.atleast_1d(self._window.values.atVector(key))
            self._known[key] = Beside(value=value, gain=np.zeros((len(value), 6)), cov=self._window.covariance([key]))

    def misfit(self) -> float:
        """Return the cost of the window over its expectation (see `solve._passes.expected_cost`); 1 where the IMU agrees.

        A jump of GNSS, or a step that is not relinearised yet, costs as much in a window: but not in most of its steps.
        """
        steps = self._window.errors_of(held for held in self._links.values() if held.slots)
        if not steps or 2.0 * float(np.median(steps)) < _STEP_COST:
            return 1.0
        held = [e.verdict for e in self._entries.values() if e.held is not None]
        expected = sum((v.residual.rows or len(v.residual.raw)) * v.weight for v in held)
        timeline = self.problem.timeline
        nodes = len(timeline.slow_stamps_ns) - timeline.slow_stamps_ns.first
        for stream in self.problem.streams.values():
            if stream.slow is not None:
                expected += nodes * int(np.isfinite(stream.slow.time_constant_s).sum())
        return 2.0 * self._window.error() / max(expected, 1.0)

    def anchor(self) -> Anchor:
        """Return what is known at the newest state, but for what closes the slow chains: they go on from here."""
        timeline, window = self.problem.timeline, self._window
        k = timeline.last
        j = timeline.slow_of[k]
        core = [keys.pose(k), keys.velocity(k), keys.bias(j)]
        slow = {s.name: keys.slow(s.number, j) for s in self.problem.streams.values() if s.slow is not None}
        constants = {(s.name, n): key for s, n, key in self._constants() if window.is_committed(key)}
        kept = {(s.name, n): self._known[key] for s, n, key in self._constants() if key in self._known}
        every = [*core, *slow.values(), *constants.values()]
        joint = window.covariance(every)
        vectors = [np.atleast_1d(window.values.atVector(key)) for key in every[3:]]
        ends = np.cumsum([6, 3, 6, *map(len, vectors)])
        rows = {key: np.arange(a, b) for key, a, b in zip(every, [0, *ends], ends, strict=False)}
        bias = window.values.atConstantBias(core[2])
        mean = np.concatenate([np.zeros(15), *vectors])  # of the state as steps from the estimate
        for name, key in slow.items():
            process = self.problem.streams[name].slow
            assert process is not None
            closed = np.flatnonzero(np.isfinite(process.time_constant_s))
            mean, joint = without_prior(mean, joint, rows[key][closed], CHAIN_END * process.sigma[closed] ** 2)

        def known(key: int) -> Beside:
            own = rows[key]
            picked = np.concatenate([rows[core[0]], own])
            return beside(mean[own], joint[np.ix_(picked, picked)])

        def alone(key: int) -> Beside:  # not given the pose: its prior, when it is seen again, does not have that
            own = rows[key]
            return Beside(value=mean[own], gain=np.zeros((len(own), 6)), cov=joint[np.ix_(own, own)])

        return Anchor(
            stamp_ns=timeline.stamps_ns[k],
            pose=window.values.atPose3(core[0]).retract(mean[:6]),
            velocity=np.asarray(window.values.atVector(core[1])) + mean[6:9],
            bias=np.concatenate([bias.accelerometer(), bias.gyroscope()]) + mean[9:15],
            cov=joint[:15, :15],
            slow={name: known(key) for name, key in slow.items()},
            constants={**kept, **{name: alone(key) for name, key in constants.items()}},
        )

    def track(self) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Return stamps (N,), places (N, 3), attitudes (N, 3, 3) and velocities (N, 3) of the body's origin."""
        timeline, values, lever = self.problem.timeline, self._window.values, -self.problem.t_body_imu_m
        states = range(timeline.first, len(timeline))
        poses = [values.atPose3(keys.pose(k)) for k in states]
        stamps = np.array([timeline.stamps_ns[k] for k in states], dtype=np.int64)
        R = np.array([pose.rotation().matrix() for pose in poses])
        bias = [values.atConstantBias(keys.bias(timeline.slow_of[k])).gyroscope() for k in states]
        gyro = self.problem.links.gyro_at(stamps) - np.array(bias) @ self.problem.R_body_imu.T
        v = np.array([values.atVector(keys.velocity(k)) for k in states])
        p = np.array([pose.transformFrom(lever) for pose in poses])
        return stamps, p, R, v + np.einsum("nij,nj->ni", R, np.cross(gyro, lever))

    @property
    def factor_slots(self) -> int:
        return self._window.factor_slots


def _moved(a: Any, b: Any) -> bool:
    """Whether a factor that is linear about the one pose is another about the other."""
    step = a.localCoordinates(b)
    return float(np.linalg.norm(step[3:])) > _MOVED_M or float(np.linalg.norm(step[:3])) > _TURNED_RAD


def _credible(stream: LiveStream, at: Attachment) -> bool:
    """Whether a sensor agrees by an error that it may have."""
    if stream.slow is None or at.slow_value is None:
        return True
    return bool((np.abs(at.slow_value) <= _CREDIBLE * stream.slow.sigma).all())
