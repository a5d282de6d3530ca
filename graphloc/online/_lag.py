# SPDX-License-Identifier: Apache-2.0
"""The sliding window: states are added; measurements are taken, judged, judged again, and marginalised.

This file orders the events: a commit, what comes before and after it, and whether to iterate. States (`_states`),
measurements (`_entries`) and judging (`_judge`) have their own files. The judge changes entries by the predictions of
the states; neither states nor entries know the judge.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.frames import Array
from graphloc.graph import TIME_OFFSET, Residual, antenna_off_m, corrections
from graphloc.judge.decide import AGREES
from graphloc.judge.health import why_late, why_unlikely
from graphloc.judge.imu_noise import log_likelihood
from graphloc.judge.warnings import noisier_warning
from graphloc.judge.wrong_imu import most_motion
from graphloc.ledger import LedgerRow
from graphloc.measurements import Measurement
from graphloc.online._agreement import Agreement
from graphloc.online._anchor import Anchor
from graphloc.online._constants import Constants
from graphloc.online._entries import Entries
from graphloc.online._judge import Judge
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._states import Newest, States
from graphloc.online._unmodelled import BeforeStart, ErrorSizes, UnmodelledError, estimated_beside
from graphloc.online._window import Window
from graphloc.signals.position_jumps import why_in_doubt

# Median over IMU steps of a sum of 9 weighted squares: below 0.2 where the IMU agrees, 1 to 10 where its noise is 3
# times too small.
_STEP_COST = 1.0
_STEP_M = 0.3  # a commit that moves the newest state by more is followed by further iterations
# Share of a sensor's measurements since its denial that must agree with another estimate; the same of a sensor with
# outliers.
_EXPLAINED, _HALF = 0.8, 0.5
_EITHER = 0.5  # probability that a receiver is right which contradicts matches, where these were never confirmed
_MOST_STEPS, _STANDS = 10, 0.1  # largest number of iterations; relative change of the cost at which they end


class Lag:
    """States and measurements of the last seconds, from an anchor on.

    Args:
        problem: what the factors are built from. anchor: estimate at the first state. lag_s: length of the window.
        guess: pose, velocity (3,) and bias (6,) that the first state is first solved at; None: the anchor's.

    Raises:
        SolveError: by every method; the window cannot be used afterwards.

    Attributes:
        problem, lag_s: as given.
    """

    def __init__(
        self, problem: LiveProblem, anchor: Anchor, lag_s: float, guess: tuple[gtsam.Pose3, Array, Array] | None
    ) -> None:
        self.problem, self.lag_s, self._window = problem, lag_s, Window(lag_s)
        self._constants = Constants(problem, self._window, anchor.constants)
        begin = guess or (anchor.pose, anchor.velocity, anchor.bias)
        self._states = States(problem, self._window, self._constants, anchor, begin)
        self._entries = Entries(problem, self._window, self._constants)
        self._agreement = Agreement(problem.timeline)
        self._judge = Judge(problem, self._window, self._states, self._entries, self._agreement)
        self._page_s = 0.0
        self._followed: dict[str, int] = {}  # index of the first measurement that `follow` has not told, by sensor
        self.fresh = False
        """Whether the last commit relinearised the states that had moved."""

    # States

    @property
    def newest(self) -> Newest:
        return self._states.newest

    @property
    def first_ns(self) -> int:
        """Stamp from which on measurements can be taken."""
        return self.problem.timeline.stamps_ns[self.problem.timeline.first]

    def grow(self, stamp_ns: int) -> bool:
        """Stage the next state, predicted by the IMU; return whether slow states got a new node: commit then."""
        return self._states.grow(stamp_ns)

    def reintegrate(self, holes: Sequence[tuple[int, int]]) -> None:
        """Integrate the IMU anew where samples came late, and stage the factors that depend on it.

        Args:
            holes: stamps (ns) of the samples before and after each late one.
        """
        timeline = self.problem.timeline
        stale = {k for a, b in holes for k in range(timeline.floor(a), timeline.floor(b) + 1)}
        self._entries.reintegrate(stale)
        self._states.reintegrate(stale)

    def commit(self, *, guessed: bool = False) -> None:
        """Solve with what is staged, and forget what has been marginalised; `guessed`: whether the heading is a guess."""
        timeline, window = self.problem.timeline, self._window
        pose, now_s = keys.pose(timeline.last), timeline.page_s(timeline.stamps_ns[timeline.last])
        self.fresh = now_s > self._page_s
        if self.fresh:  # a page is marginalised: that eliminates everything again anyway
            self._page_s = now_s
            window.relinearise()
            self._entries.follow_solver()
            self._constants.revise()
            self._constants.hold_turn(guessed=guessed)
        self._constants.remember(now_s)
        before = window.values.atPose3(pose).translation()
        window.commit()
        if self._states.let_go():
            self._entries.let_go()
        if not float(np.linalg.norm(window.values.atPose3(pose).translation() - before)) < _STEP_M:
            self._settle_down()
        self._states.read()

    def _settle_down(self) -> None:
        """Iterate until the cost stands still: after one step of metres, older states are worse than the newest."""
        cost = self._window.error()
        for _ in range(_MOST_STEPS):
            self._entries.follow_estimate()
            self._window.settle()
            before, cost = cost, self._window.error()
            if abs(before - cost) <= _STANDS * cost:
                break

    def settle(self) -> None:
        """Relinearise after many states came at once."""
        self._window.settle()
        self._states.read()

    def follow(self, unmodelled: UnmodelledError) -> None:
        """Bring the effect of left-out slow errors and of the IMU's mount up to the newest state."""
        if not unmodelled.due(self.newest.stamp_ns):
            return
        told = {}
        for name, stream in self.problem.streams.items():
            told[name] = self._entries.information(stream, self._followed.get(name, 0))
            self._followed[name] = len(stream.measurements)
        unmodelled.advance(self.newest, self.problem.links, told, self.problem.motion_model)

    def unmodelled(self, begun: BeforeStart | None = None, last: ErrorSizes | None = None) -> UnmodelledError | None:
        """Return the effect of left-out slow errors and of the IMU's mount on the newest state.

        Args:
            begun, last: what is known of it from before the window (see `UnmodelledError.at`).
        """
        P = self._states.covariance([stream for stream, _ in estimated_beside(self.problem.streams)])
        return UnmodelledError.at(self.problem, self.newest, P, begun, last)

    def anchor(self) -> Anchor:
        """Return the anchor at the newest state, to rebuild or resume from."""
        return self._states.anchor()

    def track(self) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Return stamps (N,), ns; and positions (N, 3), attitudes (N, 3, 3), velocities (N, 3) of the body in world."""
        return self._states.track()

    def antennas_off_m(self) -> dict[str, Array]:
        """Return, by sensor, how far from its mount the antenna is (3,), m, body axes, where that is estimated."""
        streams = self.problem.streams.values()
        found = {s.name: antenna_off_m(corrections(self._constants.of(s), s.mount)) for s in streams}
        return {name: off_m for name, off_m in found.items() if off_m is not None}

    @property
    def factor_slots(self) -> int:
        return self._window.factor_slots

    # Measurements

    def judged(self, sensor: str, after_ns: int, until_ns: int) -> list[tuple[Measurement, Residual]]:
        """Return a sensor's measurements with `after_ns` < stamp <= `until_ns`, each with the residual of its mode."""
        own = self._entries.of(self.problem.streams[sensor])
        return [(e.measurement, e.verdict.residual) for e in own if after_ns < e.measurement.stamp_ns <= until_ns]

    def take(self, m: Measurement) -> None:
        """Stage a measurement whose stamp lies within the window."""
        self._judge.take(m)

    def judge(self) -> None:
        """Stage the decisions on measurements that are new or have changed."""
        self._judge.judge()

    def try_others(self) -> None:
        """Where measurements judged false agree with each other, try to believe them; keep what is more probable."""
        if self._judge.try_others():
            self._states.read()

    @property
    def others(self) -> tuple[Array, Array]:
        """What other choices of modes, and the other level of a receiver that jumped, add to the newest position.

        Mean (3,), m, and covariance (3, 3), m^2.
        """
        mean, cov = self._judge.others
        share = self._agreement.wrong_level(self.newest.stamp_ns)
        if share:
            cov = cov + share * sum((off for s, off in self._off_squares() if s.left_out is not None), np.zeros((3, 3)))
        return mean, cov + np.diag([0.0, 0.0, self._height_var()])

    def _height_var(self) -> float:
        """Return what is added to the variance of the height, m^2, while the only receiver is far off.

        Its height is wrong by about as much as its place, but is followed, because nothing else measures the height.
        """
        far = self._agreement.unlikely(self.problem.config.receiver_of)
        off = self._off_squares() if far else ()
        return sum(
            float(np.trace(o)) for s, o in off if s.left_out is not None and not s.without_height and s.name in far
        )

    @property
    def contradicted(self) -> Array:
        """What receivers that contradict the matches add to the covariance (3, 3) of the newest position in world, m^2.

        A receiver that is right still has a slow error of the usual size; that is added, too.
        """
        doubted = self._agreement.doubted(self.problem.config.receiver_of)
        streams = self._off_squares() if doubted else ()
        either = (
            off + np.diag(np.where(s.slow.far_axes, s.slow.sigma**2, 0.0))
            for s, off in streams
            if s.left_out is None and s.slow is not None and s.name in doubted
        )
        return np.asarray(_EITHER * sum(either, np.zeros((3, 3))))

    def _off_squares(self) -> Iterator[tuple[LiveStream, Array]]:
        """Yield each receiver whose slow error may jump, with the outer product (3, 3), m^2, of that error now."""
        timeline = self.problem.timeline
        for stream in self.problem.streams.values():
            if stream.slow is not None and stream.slow.far:
                off_m = self._window.values.atVector(keys.slow(stream.number, timeline.slow_of[timeline.last]))
                off_m = np.where(stream.slow.far_axes, off_m, 0.0)
                yield stream, np.outer(off_m, off_m)

    def inherit(self, before: Lag) -> None:
        """Take over what was noted of agreement with the window that this one replaces."""
        self._agreement.inherit(before._agreement)

    @property
    def agreed_ns(self) -> dict[str, int]:
        """Stamp of the last measurement that agreed, by absolute sensor."""
        return self._agreement.agreed_ns

    @property
    def lost_s(self) -> float:
        """For how long (s) the absolute sensors have shown the estimate to be lost; 0: not lost (`_agreement.py`)."""
        return self._agreement.lost_s(self.newest.stamp_ns)

    @property
    def frozen_receivers(self) -> set[str]:
        """Names of the receivers that are frozen (see `_frozen_receiver.py`, `_repeated_fix.py`)."""
        return {name for name, stream in self.problem.streams.items() if stream.frozen}

    def receiver_warnings(self) -> list[str]:
        """Return what `ReceiverChecks` newly found."""
        return self._judge.receivers.warnings()

    def noisier_warnings(self) -> list[str]:
        """Return a warning on each sensor that newly scatters by far more than it states."""
        lines = list[str]()
        for name, stream in self.problem.streams.items():
            if not stream.scatter.said and (line := noisier_warning(name, stream.noisier)):
                stream.scatter.said, lines = True, lines + line
        return lines

    def setting_warnings(self) -> list[str]:
        """Return a warning on each delay, and each antenna's place, that is clearly far from its setting.

        A warning is repeated when the difference has doubled. The first one may name a fifth of it, because each turn
        of the vessel tells more of an antenna.
        """
        lines = list[str]()
        for stream in self.problem.streams.values() if self.fresh else ():
            for key, by, line in (*self._constants.far_off(stream), *self._states.late_far_off(stream)):
                if abs(by) >= 2.0 * stream.receiver.far_off.get(key, 0.0):
                    stream.receiver.far_off[key] = abs(by)
                    lines.append(line)
        return lines

    @property
    def unmodelled_jumps(self) -> list[str]:
        """Which sensors have jumped since the window was built, where a window can estimate it: lines for users."""
        jumped = [s for s in self.problem.streams.values() if s.may_jump and s.receiver.jumps != s.jumps]
        return [f"{'heading step' if s.receiver.heading.steps else 'position jump'} of {s.name}" for s in jumped]

    def in_doubt(self, stamp_ns: int) -> str:
        """Return why the health cannot be good at a stamp; empty where nothing is wrong.

        It cannot be good where the only position sensor has jumped, scans are stamped far off, or a sensor agrees only
        by an unlikely large slow error.
        """
        streams = self.problem.streams.items()
        # Where a receiver's slow error is left out, and no jump is estimated, the bounds include its jumps.
        doubtful = [
            n
            for n, s in streams
            if (s.left_out is None or s.jumps) and s.receiver.jump.doubtful(stamp_ns, self._settled_ns(n))
        ]
        late = [
            n
            for n, s in streams
            if s.slow is not None and s.slow.late is not None and TIME_OFFSET in s.receiver.far_off
        ]
        unlikely = self._agreement.unlikely(self.problem.config.receiver_of)
        off = filter(None, map(self._states.why_off_mount, self.problem.streams.values()))
        return "; ".join([*map(why_in_doubt, doubtful), *map(why_late, late), *map(why_unlikely, unlikely), *off])

    def _settled_ns(self, name: str) -> int:
        """Return the stamp (ns) at which another sensor of position agreed last; 0: none has.

        Of the sensors that read the same receiver by turns, only those with a smaller slow error (RTK) count.
        """
        own, streams = self.problem.streams[name], self.problem.streams
        beside = [streams[other] for other in self.problem.config.by_turns(name)[1:] if other in streams]
        better = [s for s in beside if s.slow and own.slow and s.slow.sigma[0] < own.slow.sigma[0]]
        settling = (*better, *self.problem.others_of_place(name))
        return max((self._agreement.agreed_ns.get(s.name, 0) for s in settling), default=0)

    @property
    def denied(self) -> Mapping[str, int]:
        """Stamps (ns) of the first denials of sensors that deny the estimate together (see `_imu_doubt.Denials`)."""
        return self._judge.denials.at_once(self.newest.stamp_ns)

    def explained(self, sensors: Collection[str], since_ns: int) -> bool:
        """Return whether measurements since a stamp now agree, by a motion that a vessel may have made.

        At least two of the sensors must agree, among them all that have no hypotheses.
        """
        agreeing = 0
        for stream in map(self.problem.streams.__getitem__, sensors):
            own = [e for e in self._entries.of(stream) if e.measurement.stamp_ns >= since_ns]
            share = sum(e.verdict.weight >= AGREES for e in own) / max(len(own), 1)
            if not stream.row.has_hypotheses and share < _EXPLAINED:
                return False
            agreeing += share >= (_HALF if stream.row.has_hypotheses else _EXPLAINED)
        lasts_s = (self.newest.stamp_ns - since_ns) * 1e-9
        return agreeing >= 2 and 2.0 * self._states.steps_cost(since_ns) <= most_motion(lasts_s)

    def gone(self) -> list[LedgerRow]:
        """Return the ledger rows of measurements that have left the window since the last call."""
        return self._entries.gone()

    def held(self) -> list[LedgerRow]:
        """Return the ledger rows of the measurements in the window, as judged now."""
        return self._entries.held()

    def likelihoods(self, times: Sequence[tuple[float, float]]) -> Array:
        """Return the log-likelihood of the window for each pair of factors on gyroscope and accelerometer noise."""
        links = self._states.links()
        J, b = self._window.linear(links)
        return np.array([log_likelihood(J, b, len(links), *each) for each in times])

    def misfit(self) -> float:
        """Return the cost of the window over its expectation (see `solve._passes.expected_cost`).

        It is 1 where most IMU steps cost little.

        A GNSS jump, or a step that is not relinearised yet, may cost as much as IMU noise that is configured too small.
        But unlike that, it does not make most of the IMU's steps costly.
        """
        if 2.0 * self._states.step_cost() < _STEP_COST:
            return 1.0
        expected = self._entries.expected_cost()
        timeline = self.problem.timeline
        nodes = len(timeline.slow_stamps_ns) - timeline.slow_stamps_ns.first
        for stream in self.problem.streams.values():
            if stream.slow is not None:
                expected += nodes * int((~stream.slow.constant).sum())
        return 2.0 * self._window.error() / max(expected, 1.0)
