# SPDX-License-Identifier: Apache-2.0
"""The measurements of the window: the verdict on each, and its factors in the graph."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from graphloc.build import attach
from graphloc.frames import Array
from graphloc.graph import Attachment, Residual
from graphloc.judge.decide import NEGLIGIBLE, Verdict, residuals_at
from graphloc.judge.ledger import row_of
from graphloc.ledger import LedgerRow
from graphloc.linear import factors_of
from graphloc.measurements import Measurement
from graphloc.online._constants import Constants
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._window import Held, Window, keys_of

_CHANGED = 0.1  # change of a weight (or relative change of a variance) from which the factors are replaced
_MOVED_M, _TURNED_RAD = 0.1, 0.01  # distance and angle from the pose of linearisation, beyond which a factor is wrong
_SAME = 1e-9  # m, rad: change of a linearisation point that is only rounding


@dataclass(slots=True, eq=False)
class Entry:
    """A measurement in the window, its verdict, and its factors (`held`); None: it is not in the graph."""

    stream: LiveStream
    index: int
    verdict: Verdict
    held: Held | None = None
    written: Any = None  # the pose in whose tangent its factors are written
    linear: bool = False  # whether one of its factors is linear: GTSAM does not turn such a factor with the pose
    widened: bool = False  # whether its kernel was widened, because the prediction was uncertain
    judged: bool = False  # whether it was judged among hypotheses at least once

    @property
    def measurement(self) -> Measurement:
        return self.stream.measurements[self.index]

    @property
    def state(self) -> int:
        return self.stream.state[self.index]

    @property
    def within(self) -> tuple[int, float] | None:
        """Mode and weight with which the measurement is in the graph; None: it is not."""
        decision = self.verdict.decision
        return None if self.held is None or decision is None else (self.verdict.mode, decision.weight)

    def reaches(self, first: int) -> bool:
        """Return whether the measurement's state, and the one that the IMU carries to its stamp, are in the window."""
        carry = self.stream.carry[self.index]
        return self.state >= first and (carry is None or carry[0] >= first)

    def weighs_other(self, verdict: Verdict) -> bool:
        """Return whether another verdict differs so much in weight or variance that the factors must be replaced."""
        new, old = (
            float(np.trace(v.residual.cov)) / (v.decision.weight if v.decision else 1.0)
            for v in (verdict, self.verdict)
        )
        return abs(verdict.weight - self.verdict.weight) > _CHANGED or abs(new - old) > _CHANGED * old

    def differs(self, verdict: Verdict) -> bool:
        """Return whether the factors in the graph must be replaced: decided otherwise, or linearised elsewhere."""
        old = self.verdict
        if (self.held is None) != (verdict.decision is None):
            return True
        if verdict.decision is None or old.decision is None:
            return False
        return (
            verdict.mode != old.mode
            or abs(verdict.decision.weight - old.decision.weight) > _CHANGED
            or _moved(old.at.T_world_body, verdict.at.T_world_body)
        )


class Entries:
    """All entries of the window; the factors of each are in the graph or staged, and `change` replaces them."""

    def __init__(self, problem: LiveProblem, window: Window, constants: Constants) -> None:
        self._problem, self._window, self._constants = problem, window, constants
        self._entries: dict[tuple[int, int], Entry] = {}
        self._gone: list[LedgerRow] = []

    def reachable(self, entry: Entry) -> bool:
        """Return whether an entry can still be judged: it and its states are in the window."""
        here = (entry.stream.number, entry.index) in self._entries
        return here and entry.reaches(self._problem.timeline.first)

    def of(self, stream: LiveStream) -> list[Entry]:
        """Return the entries of a stream that can still be judged, by stamp."""
        first = self._problem.timeline.first
        own = [e for e in self._entries.values() if e.stream is stream and e.reaches(first)]
        return sorted(own, key=lambda e: (e.measurement.stamp_ns, e.index))

    def _all_reachable(self) -> Iterator[Entry]:
        first = self._problem.timeline.first
        return (e for e in self._entries.values() if e.reaches(first))

    def information(self, stream: LiveStream, since: int) -> Array:
        """Return the information of the measurements of a stream, from index `since` on, as judged.

        It is (9, 9), on rotation, position and velocity in axes of world. If the stream's slow error is estimated, it
        is (9 + k, 9 + k), with that. Jumps of a slow error that is otherwise left out count as known.
        """
        width = 9 if stream.slow is None or stream.left_out is not None else 9 + len(stream.slow.sigma)
        total = np.zeros((width, width))
        for index in range(max(since, stream.measurements.first), len(stream.measurements)):
            entry = self._entries.get((stream.number, index))
            if entry is not None and entry.held is not None:
                found, R = entry.verdict.residual, entry.verdict.at.T_world_body.rotation().matrix()
                J, by_pose = np.zeros((len(found.raw), width)), found.jacobian()
                J[:, :3], J[:, 3:6] = by_pose[:, :3] @ R.T, by_pose[:, 3:] @ R.T
                if found.velocity_jacobian is not None:
                    J[:, 6:9] = found.velocity_jacobian()
                if width > 9 and found.slow_jacobian is not None:
                    J[:, 9:] = found.slow_jacobian()
                total += entry.verdict.weight * J.T @ np.linalg.solve(found.cov, J)
        return total

    def residuals_at(self, stream: LiveStream, index: int) -> tuple[Attachment, tuple[Residual, ...]]:
        """Return the attachment of a measurement at the present estimate, and its residuals there, one per mode."""
        return residuals_at(self._problem, stream, index, self._window.values)

    # In the graph

    def add(self, entry: Entry) -> None:
        """Add a new entry, and stage its factors."""
        self._put(entry)
        self._entries[(entry.stream.number, entry.index)] = entry

    def change(self, entry: Entry, verdict: Verdict) -> None:
        """Replace the factors of an entry by those of a new verdict; not where some have been marginalised."""
        if entry.held is not None:
            if not self._window.remove(entry.held):
                return
            entry.held = None
        entry.verdict = verdict
        self._put(entry)

    def marked(self, own: Collection[Entry]) -> Callable[[], None]:
        """Return a function that restores the window and the entries `own` as they are now; nothing may be staged."""
        window, constants_back = self._window.marked(), self._constants.marked()
        entries = [(e, e.verdict, e.held, e.written, e.judged) for e in own]
        places = [(held, tuple(held.slots)) for _, _, held, _, _ in entries if held is not None]

        def back() -> None:
            self._window.back_to(window, places)
            constants_back()
            for entry, verdict, held, written, judged in entries:
                entry.verdict, entry.held, entry.written, entry.judged = verdict, held, written, judged

        return back

    def _put(self, entry: Entry) -> None:
        """Stage the factors of an entry."""
        stream, verdict = entry.stream, entry.verdict
        m = entry.measurement
        if verdict.decision is None or verdict.decision.weight <= NEGLIGIBLE:
            return
        window, timeline = self._window, self._problem.timeline
        t = timeline.page_s(timeline.stamps_ns[entry.state])
        at = replace(verdict.at, T_solver=window.linearised_at(verdict.at.pose_key))
        if stream.constants:
            at = replace(at, R_first=self._constants.first_attitude(at.T_world_body))
        update = factors_of(stream.row, m, stream.config, at, verdict.decision)
        for key, value in update.guesses:
            if not window.values.exists(key):
                window.guess(key, value, t)
        used = {key for factor in update.factors for key in keys_of(factor)}
        self._constants.use(stream, used)
        entry.held, entry.written = window.add(update.factors), at.T_solver
        entry.linear = any(isinstance(factor, gtsam.LinearContainerFactor) for factor in update.factors)

    def reintegrate(self, stale: Collection[int]) -> None:
        """Integrate the IMU again from the states `stale` to the measurements after them: samples came late there."""
        for entry in self._all_reachable():
            carry = entry.stream.carry[entry.index]
            if carry is not None and carry[0] in stale:
                self._problem.reintegrate(entry.stream, entry.index)
                if entry.held is not None:
                    self._write(entry)

    def follow_solver(self) -> None:
        """Replace factors written in a tangent that the solver no longer uses, or before the next slow node existed."""
        self._write_anew(self._left_behind)

    def follow_estimate(self) -> None:
        """Replace factors linearised at a pose that the estimate has left: by these, right measurements look false."""
        self._write_anew(self._elsewhere)

    def _write_anew(self, stale: Callable[[Entry], bool]) -> None:
        """Relinearise the stale factors of sensors with hypotheses, and the linear ones that measure position.

        GTSAM does not relinearise these. Factors of fixes that were linearised with the heading 20 deg off would put
        the end of a step of one metre 0.3 m aside.
        """
        for entry in self._all_reachable():
            row = entry.stream.row
            bound = row.has_hypotheses or (row.absolute and entry.linear)
            if bound and entry.held is not None and stale(entry):
                self._write(entry)

    def _write(self, entry: Entry) -> None:
        at = attach(self._problem, entry.stream, entry.index, self._window.values)
        self.change(entry, replace(entry.verdict, at=at))

    def _left_behind(self, entry: Entry) -> bool:
        at = entry.verdict.at
        loose = at.slow_key is not None and at.slow_next is None
        # See `graphloc.linear.pose_term` for the tangents.
        return loose or not self._window.linearised_at(at.pose_key).equals(entry.written, _SAME)

    def _elsewhere(self, entry: Entry) -> bool:
        at = entry.verdict.at
        return _moved(at.T_world_body, self._window.values.atPose3(at.pose_key))

    def expected_cost(self) -> float:
        """Return the expected sum of weighted squares in the graph: of each measurement, its weight times its axes."""
        return sum(e.verdict.expected_cost for e in self._entries.values() if e.held is not None)

    # In the ledger

    def let_go(self) -> None:
        """Forget the measurements whose states have left the window; their ledger rows are final."""
        problem, first = self._problem, self._problem.timeline.first
        for key, entry in list(self._entries.items()):
            if entry.state < first:
                self._gone.append(_row(entry))
                del self._entries[key]
        for stream in problem.streams.values():
            kept = min((i for n, i in self._entries if n == stream.number), default=len(stream.measurements))
            stream.forget(kept)

    def gone(self) -> list[LedgerRow]:
        """Return the ledger rows of measurements that have left the window since the last call."""
        rows, self._gone = self._gone, []
        return [row for row in rows if row.seq >= 0]

    def held(self) -> list[LedgerRow]:
        """Return the ledger rows of the measurements in the window, as judged now."""
        return [_row(e) for e in self._entries.values() if e.measurement.seq >= 0]


def _row(entry: Entry) -> LedgerRow:
    stream = entry.stream
    return row_of(stream, entry.measurement, stream.config.topic, entry.verdict)


def _moved(a: Any, b: Any) -> bool:
    """Return whether two poses differ so much that a factor linearised at one is wrong at the other."""
    step = a.localCoordinates(b)
    return float(np.linalg.norm(step[3:])) > _MOVED_M or float(np.linalg.norm(step[:3])) > _TURNED_RAD
