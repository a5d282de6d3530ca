# SPDX-License-Identifier: Apache-2.0
"""Feed measurements as they arrive, get estimates.

Three things can be underway: the start waits (`_start`), the lag runs (`_lag`), or, within one call, a lag that
failed is built anew from its last anchor with all that came since.
"""

from __future__ import annotations

import logging
from bisect import insort
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from graphloc.config import VesselConfig
from graphloc.errors import SolveError, in_one_line
from graphloc.estimate import Estimate
from graphloc.frames import Array, Datum
from graphloc.graph import InertialRow, Sensor
from graphloc.hangs import WHY
from graphloc.leaps import LeapWatch
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import ImuSample, ImuSeries, Measurement
from graphloc.online._ahead import ahead, carry_on, no_further
from graphloc.online._anchor import Anchor
from graphloc.online._book import Book
from graphloc.online._estimates import estimate_of
from graphloc.online._habit import Habit
from graphloc.online._intake import ImuIntake
from graphloc.online._lag import Lag
from graphloc.online._live import live_problem
from graphloc.online._noise import ImuNoise
from graphloc.online._odometry import Odometry
from graphloc.online._recent import Recent
from graphloc.online._snapshot import Snapshot, SnapshotFile
from graphloc.online._start import Started, try_start
from graphloc.online._turned import Turned
from graphloc.online._waiting import Waiting
from graphloc.origin import refuse_world_without_datum
from graphloc.solve._solution import alone
from graphloc.time import duration_ns, utc_text
from graphloc.trajectory import Trajectory

log = logging.getLogger(__name__)
_AGAIN_S = 6.0  # of data, with which a lost estimate starts anew
_AHEAD_S = 60.0  # of the IMU: a stamp of another clock
_AT_ONCE = 10  # states that are made in one commit, in a gap of the IMU
_PENDING = 10_000


class OnlineSmoother:
    """A fixed-lag smoother that starts, restarts and mends itself.

    Args:
        config: the vessel, its surveys read. rows, inertial: the table of sensors (`graphloc.factors`).
        datum: origin of world; None: from the configuration, or else from the first fixes.
        mounts: body -> sensor (t (3,), R (3, 3)) of sensors whose mount is not the configuration's (/tf_static).
        lag_s: how long measurements can still be re-judged, and how late they may come.
        snapshot: file that is written every few seconds, and resumed from if it is there; None: no such file.

    Raises:
        InputError: something is given in world, and nothing says where its origin is.
    """

    def __init__(
        self,
        config: VesselConfig,
        *,
        rows: Sequence[Sensor],
        inertial: InertialRow,
        datum: Datum | None = None,
        mounts: Mapping[str, tuple[Array, Array]] | None = None,
        lag_s: float = 10.0,
        snapshot: Path | None = None,
    ) -> None:
        if datum is None:
            refuse_world_without_datum(config, "vessel.yaml", rows)
        self._config, self._rows, self._inertial = config, tuple(rows), inertial
        self._at_start = config  # a heading that is configured holds for the first start alone
        self._mounts, self._lag_s, self._snapshot = dict(mounts or {}), lag_s, SnapshotFile(snapshot)
        self._datum = datum or (Datum(config.datum.geodetic) if config.datum else None)
        imu = config.of_kind(inertial.kind)
        self._imu_name = next(iter(imu), "")
        self._bridge_s = imu[self._imu_name].max_bridge_s if imu else 0.0
        self._gap_s = imu[self._imu_name].max_gap_s if imu else 0.0
        kinds = {row.kind for row in rows}
        self._asked = {name for name, s in config.sensors.items() if s.enabled and s.kind in kinds}
        self._absolute = [n for row in rows if row.absolute for n in config.of_kind(row.kind)]
        self._book = Book(config)
        self._events: list[str] = []
        self._lag: Lag | None = None
        self._odometry: Odometry | None = None
        self._agreed_ns: dict[str, int] = {}
        self._leaping: dict[str, LeapWatch] = {}  # a start anew puts no leap right
        self._heights_m: Mapping[str, float] = {}
        self._doubt = ""
        self._noise = ImuNoise(adapt=bool(imu) and imu[self._imu_name].adapt_noise)
        self._habit = Habit()
        self._turned = Turned()
        self._parted: set[str] = set()
        self._intake = ImuIntake(self._gap_s, bool(imu) and imu[self._imu_name].gravity != "removed")
        self._resumable, trouble = self._snapshot.read(config.vessel, self._imu_name, self._datum)
        self._say(trouble)
        self._waiting = Waiting(self._book)
        self._pending: list[Measurement] = []  # ahead of the IMU
        self._unread: list[ImuSample] = []
        self._holes: list[tuple[int, int]] = []  # that late samples of these lie in
        self._recent = Recent()
        self._wait(
            "the first IMU sample" if imu else f"an IMU: no enabled sensor of kind {inertial.kind} is configured"
        )

    # What is known

    @property
    def waiting_for(self) -> str:
        """What the start waits for, in plain words; empty while there is an estimate."""
        return "" if self._lag is not None else self._waiting.why

    @property
    def datum(self) -> Datum | None:
        """Origin of world; None before it is known."""
        return self._datum

    @property
    def factor_slots(self) -> int:
        """Places that the solver keeps for factors: flat, however long it runs."""
        return 0 if self._lag is None else self._lag.factor_slots

    def rows(self) -> list[LedgerRow]:
        """Return the rows of the ledger that became final since this was last asked; measurements leave with the lag."""
        if self._lag is not None:
            self._book.enter(self._lag.gone())
        return self._book.taken()

    def events(self) -> list[str]:
        """Return what happened since this was last asked, a line each: started, restarted, rebuilt, resumed."""
        events, self._events = self._events, []
        return events

    def _say(self, what: str) -> None:
        """Have an event, if there is anything to say."""
        if what:
            self._events.append(what)

    def finish(self) -> list[LedgerRow]:
        """End: return the rows of all that is left."""
        if self._lag is not None:
            self._book.enter([*self._lag.gone(), *self._lag.held()])
        why = (
            f"never started: waiting for {self._waiting.why}"
            if self._lag is None
            else "the run ended before there was a state at its stamp"
        )
        for m in [*self._pending, *([self._intake.leap] if self._intake.leap else [])]:
            self._book.drop(m, Outcome.REJECTED, why)
        self._waiting.refuse(why)
        self._pending, self._unread, self._intake.leap = [], [], None
        self._lag = None
        return self._book.taken()

    # What comes

    def feed(self, m: Measurement) -> Estimate | None:
        """Take a measurement (an `ImuSample` too); return the newest estimate if this made a new one."""
        if isinstance(m, ImuSample):
            return self._feed_imu(m)
        if m.sensor not in self._asked:
            self._book.drop(m, Outcome.IGNORED, "its sensor is switched off or not in the configuration")
            return None
        newest = self._intake.newest
        if newest is not None and m.stamp_ns - newest.stamp_ns > _AHEAD_S * 1e9:
            ahead_s = (m.stamp_ns - newest.stamp_ns) * 1e-9
            self._book.drop(m, Outcome.REJECTED, f"its stamp lies {ahead_s:.0f} s ahead of the IMU's")
        elif self._lag is None:
            self._waiting.hold(m)
        elif m.stamp_ns < self._lag.first_ns:
            late_s = (self._lag.newest.stamp_ns - m.stamp_ns) * 1e-9
            self._book.drop(
                m, Outcome.LATE, f"its stamp is {late_s:.1f} s before the newest state; the lag is {self._lag_s:g} s"
            )
        else:
            insort(self._pending, m, key=lambda p: p.stamp_ns)
            self._recent.keep(m)
            if len(self._pending) > _PENDING:
                self._book.drop(self._pending.pop(), Outcome.REJECTED, "too many measurements wait for the IMU")
        return None

    def _feed_imu(self, m: ImuSample) -> Estimate | None:
        if m.sensor != self._imu_name:
            other = m.sensor in self._config.sensors and self._config.sensors[m.sensor].enabled and self._imu_name
            why = f"{other} is the IMU" if other else "its sensor is switched off or not in the configuration"
            self._book.drop(m, Outcome.IGNORED, why)
            return None
        taken = self._intake.take(m, started=self._lag is not None)
        for lost, why in taken.dropped:
            self._book.drop(lost, Outcome.REJECTED, why)
        if taken.absurd and self._lag is None:
            self._waiting.why = f"IMU data that a vessel can have: {taken.absurd}"
        if taken.hangs:
            self._say(f"{m.sensor}: {WHY}; treated as an IMU gap until the samples change")
        if taken.late is not None:
            self._keep_late_imu(taken.late, taken.hole)
        if taken.set_back_s:
            self._forget_clock(taken.set_back_s, m.stamp_ns)
        made = None
        for sample in taken.accepted:
            made = self._accept_imu(sample) or made
        return made

    def _keep_late_imu(self, m: ImuSample, hole: tuple[int, int] | None) -> None:
        if self._lag is None:
            self._waiting.hold(m)
            return
        assert hole is not None
        self._holes.append(hole)
        self._keep_imu(m)

    def _keep_imu(self, m: ImuSample) -> None:
        self._unread.append(m)
        self._recent.keep(m)
        self._book.used(m)

    def _forget_clock(self, back_s: float, stamp_ns: int) -> None:
        """Start anew by a clock that was set back."""
        self._restart(f"the IMU's clock was set back by {back_s:.1f} s")
        self._agreed_ns, self._leaping = {}, {}
        if self._odometry is not None:
            self._odometry.stamp_ns = stamp_ns

    def _accept_imu(self, m: ImuSample) -> Estimate | None:
        silent_s = self._intake.accept(m)
        if silent_s > self._bridge_s:
            self._restart(f"the IMU was silent for {silent_s:.1f} s")
            self._intake.restart([m.stamp_ns])
        if self._lag is None:
            self._waiting.hold(m)
            return self._try_to_start()
        self._keep_imu(m)
        return self._advance()

    def _advance(self) -> Estimate | None:
        """Make the states that are due, with all that belongs to them."""
        assert self._lag is not None
        assert self._intake.newest is not None
        assert self._odometry is not None
        if self._intake.newest.stamp_ns < self._lag.problem.timeline.due_ns:
            return None
        self._odometry.begin()
        try:
            self._step(self._lag)
            self._keep_anchor(self._lag)
            if self._turned.look(self._lag):
                self._say(self._turned.said)
            self._say_parted(self._lag.parted)
            self._events += self._lag.leapt()
            if self._lag.lost_s:
                return self._start_over(self._lag)
            if said := self._noise.contradicted(self._lag):
                self._rebuild(said)
                return self._try_estimate()
            return self._estimate(self._lag)
        except Exception as error:  # noqa: BLE001 - whatever went wrong in there, the vessel still needs a pose
            self._rebuild(error)
        return self._try_estimate()

    def _say_parted(self, parted: set[str]) -> None:
        for name in sorted(parted ^ self._parted):
            again = "no longer frozen: its fixes are used again"
            hangs = (
                "frozen receiver: it repeats one position while the vessel moves; its fixes are rejected until it moves"
            )
            self._say(f"{name}: {hangs if name in parted else again}")
        self._parted = parted

    def _try_estimate(self, stamp_ns: int | None = None) -> Estimate | None:
        """Return an estimate if there is one to be had."""
        if self._lag is None:
            return None
        try:
            return self._estimate(self._lag, stamp_ns)
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            log.warning("online: %s", in_one_line(error))
            return None

    def _step(self, lag: Lag) -> None:
        assert self._intake.newest is not None
        self._read(lag)
        timeline, until = lag.problem.timeline, self._intake.newest.stamp_ns
        while timeline.due_ns <= until:
            before, made = lag.newest, 0
            while timeline.due_ns <= until and made < _AT_ONCE:
                turned = lag.grow(timeline.due_ns)
                made += 1
                self._make_own(lag)
                if turned:
                    break
            reached = timeline.stamps_ns[timeline.last]
            while self._pending and self._pending[0].stamp_ns <= reached:
                m = self._pending.pop(0)
                if m.stamp_ns < lag.first_ns:
                    self._book.drop(m, Outcome.LATE, "left the lag while it waited")
                    continue
                try:
                    lag.take(m)
                    self._turned.note(m, lag)
                except Exception as error:  # noqa: BLE001 - as in `_advance`; nothing of it is staged yet
                    self._book.drop(m, Outcome.REJECTED, f"it could not be used: {in_one_line(error)}")
            lag.judge()
            assert self._odometry is not None
            carry_on(self._odometry, lag.problem, lag.newest, before.stamp_ns, reached)
            lag.commit()
            lag.try_others()
        self._book.enter(lag.gone())

    def _read(self, lag: Lag) -> None:
        """Hand the IMU's samples on."""
        if self._unread:
            stamps = np.array([m.stamp_ns for m in self._unread], dtype=np.int64)
            lag.problem.links.extend(stamps, np.array([np.hstack([m.accel_mps2, m.gyro_radps]) for m in self._unread]))
            self._unread = []
        if self._holes:
            holes, self._holes = self._holes, []
            lag.mend(holes)

    def _make_own(self, lag: Lag) -> None:
        """Take what the configuration itself says at the newest state."""
        timeline = lag.problem.timeline
        at_ns = timeline.stamps_ns[timeline.last]
        for name, height_m in self._heights_m.items():
            stream = lag.problem.streams[name]
            if stream.row.synthetic is None or at_ns < self._own_due_ns.get(name, at_ns):
                continue
            for m in stream.row.synthetic(name, stream.config, (at_ns, at_ns + 1), height_m):
                lag.take(m)
            self._own_due_ns[name] = at_ns + duration_ns(getattr(stream.config, "period_s", 1.0))

    # Estimates

    def predict(self, stamp_ns: int | None = None) -> Estimate | None:
        """Return the pose at a stamp (default: of the newest IMU sample) from the newest state.

        None before the start, and for a stamp farther ahead of the IMU than its silence is bridged.
        """
        lag, newest = self._lag, self._intake.newest
        if lag is None or newest is None:
            return None
        at_ns = newest.stamp_ns if stamp_ns is None else stamp_ns
        if at_ns - newest.stamp_ns > self._bridge_s * 1e9:
            return None
        return self._try_estimate(at_ns)

    def _estimate(self, lag: Lag, stamp_ns: int | None = None) -> Estimate:
        """The newest state, or what the IMU makes of it at a stamp after (a stamp before is answered with the state)."""
        assert self._odometry is not None
        newest, odometry = lag.newest, self._odometry
        now = no_further(newest, odometry)
        if stamp_ns is not None and stamp_ns > newest.stamp_ns:
            self._read(lag)
            now = ahead(lag.problem, newest, odometry, stamp_ns)
        agreed = {**self._agreed_ns, **lag.agreed_ns}
        doubt = "; ".join(why for why in (self._turned.said, self._doubt, lag.in_doubt(now.stamp_ns)) if why)
        return estimate_of(now, lag, odometry, agreed_ns=agreed, absolute=self._absolute, doubt=doubt)

    def window(self) -> Trajectory | None:
        """Return the states of the lag as they are now estimated, up to the newest IMU sample: a prior for front-ends.

        The covariance at all of them is that of the newest.
        """
        now = self.predict()
        if now is None or self._lag is None:
            return None
        stamps, p, R, v = self._lag.track()
        if now.stamp_ns > stamps[-1]:
            stamps, p = np.append(stamps, now.stamp_ns), np.vstack([p, now.p_world_m])
            R, v = np.concatenate([R, now.R_world_body[None]]), np.vstack([v, now.v_world_mps])
        cov = np.broadcast_to(now.cov, (len(stamps), 6, 6))
        return Trajectory(stamps_ns=stamps, p_world_m=p, R_world_body=R, v_world_mps=v, cov=cov)

    # Start, restart, rebuild, resume

    def _wait(self, why: str) -> None:
        """Give up what there is, and wait for a start."""
        self._lag = None
        self._waiting.begin(why)
        self._pending, self._unread, self._holes = [], [], []
        self._recent.clear()
        self._book.close()
        self._intake.restart([])
        self._own_due_ns: dict[str, int] = {}
        self._snapshot.restart()

    def _restart(self, why: str) -> None:
        self._say(f"{why}: restarts")
        if self._lag is not None:
            self._book.enter([*self._lag.gone(), *self._lag.held()])
            self._agreed_ns.update(self._lag.agreed_ns)
        for m in self._pending:
            self._book.drop(m, Outcome.REJECTED, "the estimate restarted before IMU data reached its stamp")
        self._waiting.refuse(f"the estimate restarted while waiting for {self._waiting.why}")
        self._wait("the next IMU sample")

    def _try_to_start(self) -> Estimate | None:
        newest = self._intake.newest
        assert newest is not None
        if self._resumable is not None:
            self._resume(newest)
            return None
        if not self._waiting.due(newest.stamp_ns):
            return None
        samples, others = self._waiting.samples(), self._waiting.others()
        self._intake.restart([m.stamp_ns for m in samples])
        reached = [m for m in others if m.stamp_ns <= newest.stamp_ns]
        try:
            started = try_start(
                self._at_start,
                self._rows,
                self._inertial,
                self._mounts,
                _series(samples),
                reached,
                self._datum,
                self._lag_s,
            )
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            started = f"data from which the start can be solved: {in_one_line(error)}"
        if isinstance(started, str):
            self._waiting.why = started
            return None
        try:
            self._take_over(started, samples, others)
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            self._restart(f"the start failed ({in_one_line(error)})")
            return None
        return self._try_estimate()

    def _take_over(self, started: Started, samples: list[ImuSample], others: list[Measurement]) -> None:
        """Build the lag where the start says, and bring it to now."""
        self._at_start = self._config.model_copy(
            update={"start": self._config.start.model_copy(update={"heading_deg": None})}
        )
        self._datum, self._heights_m, self._doubt = started.datum, started.heights_m, started.doubt
        self._noise.scale = max(self._noise.scale, started.noise_scale)
        for sample in samples:
            self._book.used(sample)
        self._waiting.taken()
        self._pending = others
        self._begin(started.anchor, samples, (started.pose, started.velocity, started.bias))
        assert self._lag is not None
        self._book.enter(started.rows)
        self._pending = [m for m in others if not self._book.has(m)]
        while self._pending and self._pending[0].stamp_ns < self._lag.first_ns:
            self._book.drop(self._pending.pop(0), Outcome.REJECTED, "no IMU data at this stamp")
        self._recent.begin([*samples, *self._pending])
        self._step(self._lag)
        self._keep_anchor(self._lag)
        self._noise.begin(self._lag.newest.stamp_ns)
        self._say(f"started at {utc_text(self._lag.newest.stamp_ns)}: {'; '.join(started.notes)}")
        if started.doubt:
            self._say(started.doubt)
        for stream in self._lag.problem.streams.values():
            if stream.left_out is not None:
                self._say(alone(stream.name, stream.left_out))

    def _begin(
        self, anchor: Anchor, samples: Sequence[ImuSample], guess: tuple[gtsam.Pose3, Array, Array] | None = None
    ) -> None:
        """Build the lag at an anchor; `samples` reach from there, or from before, to the newest."""
        assert self._datum is not None
        known = [m for m in samples if m.stamp_ns >= anchor.stamp_ns - 2 * duration_ns(self._gap_s)] or samples[-1:]
        problem = live_problem(
            self._config,
            self._datum,
            _series(known),
            anchor.stamp_ns,
            self._rows,
            self._inertial,
            self._mounts,
            self._noise.scale,
            self._habit,
        )
        agreed = {} if self._lag is None else self._lag.agreed_ns
        if self._lag is not None:
            for name, stream in self._lag.problem.streams.items():
                problem.streams[name].scatter = stream.scatter
        for name, stream in problem.streams.items():
            stream.leaping = self._leaping.setdefault(name, stream.leaping)
        self._lag = Lag(problem, anchor, self._lag_s, guess)
        self._lag.agreed_ns.update(agreed)
        self._book.begin()
        self._own_due_ns = {}
        if self._odometry is None:
            pose = self._lag.newest.pose
            place = np.asarray(pose.transformFrom(-problem.t_body_imu_m))
            self._odometry = Odometry(anchor.stamp_ns, place, pose.rotation().matrix())

    def _keep_anchor(self, lag: Lag) -> None:
        """Remember the newest state now and then, in memory and in the snapshot."""
        if not self._recent.keep_anchor(lag):
            return
        self._book.forget_but({m.seq for m in self._recent})
        self._intake.forget(lag.first_ns)
        if self._snapshot.due(lag.newest.stamp_ns):
            self._say(self._snapshot.write(self._taken_down(lag)))

    def _rebuild(self, error: Exception | str) -> None:
        """Build the lag anew: with all that is in it; if that fails too, from the last anchor without what came since; or start anew."""
        why = error if isinstance(error, str) else _failure(error)
        log.warning("online: %s", why)
        assert self._lag is not None
        old, recent, book = self._lag, self._recent, self._book
        anchors = [a for a in recent.anchors if a.stamp_ns >= old.first_ns]
        book.enter(old.gone())
        for anchor, without in [(anchors[0], False), (anchors[-1], True)] if anchors else []:
            again = [m for m in recent.others() if m.stamp_ns >= anchor.stamp_ns and not book.has(m)]
            again.sort(key=lambda m: m.stamp_ns)
            self._unread, self._holes, self._pending = [], [], [] if without else list(again)
            mark = book.marked()
            try:
                self._begin(anchor, recent.samples())
                fresh = self._lag
                self._step(fresh)
                fresh.settle()
            except Exception as another:  # noqa: BLE001 - as in `_advance`
                why = _failure(another)
                book.back_to(mark)
                continue
            if without:
                for m in again:
                    book.drop(m, Outcome.REJECTED, f"left out: {why}")
                recent.anchors = deque([anchor])
            self._close(old, again)
            age_s = (fresh.newest.stamp_ns - anchor.stamp_ns) * 1e-9
            self._say(f"{why}: the window was rebuilt from {age_s:.1f} s before")
            return
        held = {row.seq for row in old.held()}
        self._lag, self._pending = old, [m for m in recent.others() if not book.has(m) and m.seq not in held]
        self._restart(f"{why}, and the window could not be rebuilt from an earlier state")

    def _start_over(self, lag: Lag) -> Estimate | None:
        """Start anew, with the last seconds: what measures place agrees with itself or not, but not with the estimate."""
        assert self._intake.newest is not None
        since_ns = self._intake.newest.stamp_ns - duration_ns(_AGAIN_S)
        self._book.enter(lag.gone())
        again = [m for m in self._recent if m.stamp_ns >= since_ns and not self._book.has(m)]
        self._close(lag, again)
        self._agreed_ns.update(lag.agreed_ns)
        self._say(f"for {lag.lost_s:.0f} s no absolute sensor agreed, unless its error had jumped: restarts")
        self._wait("the next IMU sample")
        # Samples have their rows already.
        for m in again:
            self._waiting.hold(replace(m, seq=-1) if isinstance(m, ImuSample) else m)
        return self._try_to_start()

    def _close(self, old: Lag, again: Iterable[Measurement]) -> None:
        """Give the rows of a lag that was replaced, but for what was taken again."""
        taken = {m.seq for m in again}
        self._book.enter([row for row in old.held() if row.seq not in taken])
        for m in self._recent.others():
            if not self._book.has(m) and m.seq not in taken:
                self._book.drop(m, Outcome.LATE, "older than the oldest state of the rebuilt window")

    # Snapshot

    def _taken_down(self, lag: Lag) -> Snapshot:
        """What a run can go on from after a kill."""
        assert self._odometry is not None
        assert self._datum is not None
        anchor = self._recent.anchors[-1]
        sample = self._recent.sample_at(anchor) or self._intake.newest
        assert sample is not None
        return Snapshot(
            vessel=self._config.vessel,
            anchor=anchor,
            imu=sample,
            datum=self._datum,
            heights_m=self._heights_m,
            agreed_ns={**self._agreed_ns, **lag.agreed_ns},
            noise_scale=self._noise.scale,
            doubt=self._doubt,
            p_odom_m=self._odometry.p_m,
            R_odom_body=self._odometry.R,
        )

    def _resume(self, newest: ImuSample) -> None:
        """Go on from the snapshot, if the first sample is not too far from it."""
        assert self._resumable is not None
        found, self._resumable = self._resumable, None
        anchor, last = found.anchor, found.imu
        age_s = (newest.stamp_ns - anchor.stamp_ns) * 1e-9
        if not 0.0 < age_s <= self._bridge_s:
            self._say(f"the snapshot is {age_s:.1f} s old, more than the {self._bridge_s:g} s (max_bridge_s) that "
                                "can be bridged: starts without it")  # fmt: skip
            return
        before = self._datum
        self._datum, self._noise.scale = found.datum, found.noise_scale
        try:
            self._begin(anchor, [last, newest])
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            self._lag, self._datum, self._noise.scale = None, before, 1.0
            self._say(f"the snapshot cannot be used ({in_one_line(error)}): starts without it")
            return
        self._agreed_ns = dict(found.agreed_ns)
        self._heights_m = {n: h for n, h in found.heights_m.items() if n in self._asked}
        self._odometry = Odometry(anchor.stamp_ns, found.p_odom_m, found.R_odom_body)
        self._doubt = found.doubt
        waiting = [m for m in self._waiting.taken() if m is not newest]
        self._recent.resume(anchor, last, newest)
        self._book.used(newest)
        self._say(f"resumed from a snapshot {age_s:.1f} s old")
        for m in waiting:
            self.feed(m)


def _failure(error: Exception) -> str:
    said = in_one_line(error)
    return said if isinstance(error, SolveError) else f"the solver failed ({said})"


def _series(samples: Sequence[ImuSample]) -> ImuSeries:
    return ImuSeries(
        sensor=samples[0].sensor if samples else "",
        stamps_ns=np.array([m.stamp_ns for m in samples], dtype=np.int64),
        accel_mps2=np.array([m.accel_mps2 for m in samples]).reshape(-1, 3),
        gyro_radps=np.array([m.gyro_radps for m in samples]).reshape(-1, 3),
        seqs=np.array([m.seq for m in samples], dtype=np.int64),
    )
