# SPDX-License-Identifier: Apache-2.0
"""Feed measurements as they arrive, get estimates.

Three things can be underway: the start waits (`_start`), the lag runs (`_lag`), or, within one call, a lag that
failed is built anew from its last anchor with all that came since.
"""

from __future__ import annotations

import logging
from bisect import insort
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from graphloc.config import VesselConfig
from graphloc.errors import in_one_line
from graphloc.estimate import Estimate
from graphloc.frames import Array, Datum
from graphloc.graph import InertialRow, Sensor
from graphloc.hangs import WHY
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import ImuSample, ImuSeries, Measurement
from graphloc.online._ahead import ahead, carry_on, no_further
from graphloc.online._anchor import Anchor, sound
from graphloc.online._intake import ImuIntake
from graphloc.online._lag import Lag
from graphloc.online._live import live_problem
from graphloc.online._odometry import Odometry
from graphloc.online._snapshot import Snapshot
from graphloc.online._start import LEAST_S, Started, try_start
from graphloc.origin import refuse_world_without_datum
from graphloc.solve._batch import CONTRADICTION
from graphloc.solve._solution import NO_NOISE, alone, health_of, left_out, world_covariance
from graphloc.time import duration_ns, utc_text
from graphloc.trajectory import Trajectory

log = logging.getLogger(__name__)
_TRY_EVERY_S, _TRY_AGAIN, _LONGEST_WAIT_S = 0.5, 0.15, 120.0  # for a start; what is older is let go
_ANCHOR_S, _SNAPSHOT_S = 1.0, 2.0
_LOST_S, _AGAIN_S = 15.0, 6.0  # of disagreement, until it starts anew; with the data of so long
_AHEAD_S = 60.0  # of the IMU: a stamp of another clock
_AT_ONCE = 10  # states that are made in one commit, in a gap of the IMU
_PENDING, _BUFFERED = 10_000, 50_000
_FIT_S, _MISFITS = 5.0, 2  # how often the fit is looked at, and how often in turn it must be bad


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
        self._mounts, self._lag_s, self._snapshot = dict(mounts or {}), lag_s, snapshot
        self._datum = datum or (Datum(config.datum.geodetic) if config.datum else None)
        imu = config.of_kind(inertial.kind)
        self._imu_name = next(iter(imu), "")
        self._bridge_s = imu[self._imu_name].max_bridge_s if imu else 0.0
        self._gap_s = imu[self._imu_name].max_gap_s if imu else 0.0
        kinds = {row.kind for row in rows}
        self._asked = {name for name, s in config.sensors.items() if s.enabled and s.kind in kinds}
        self._absolute = [n for row in rows if row.absolute for n in config.of_kind(row.kind)]
        self._done: list[LedgerRow] = []
        self._events: list[str] = []
        self._lag: Lag | None = None
        self._odometry: Odometry | None = None
        self._agreed_ns: dict[str, int] = {}
        self._heights_m: Mapping[str, float] = {}
        self._doubt = ""
        self._noise_scale = 1.0  # of the IMU
        self._fit_ns, self._misfits = 0, 0
        self._intake = ImuIntake(self._gap_s, bool(imu) and imu[self._imu_name].gravity != "removed")
        self._unwritable = False
        self._resumable = self._read_snapshot()
        self._buffer: deque[Measurement] = deque()  # while it waits
        self._pending: list[Measurement] = []  # ahead of the IMU
        self._unread: list[ImuSample] = []
        self._holes: list[tuple[int, int]] = []  # that late samples of these lie in
        self._recent: list[Measurement] = []  # since the oldest anchor
        self._settled: set[int] = set()  # of these, what has its row
        self._anchors: deque[Anchor] = deque()  # of the lag, one a second
        self._wait(
            "the first IMU sample" if imu else f"an IMU: no enabled sensor of kind {inertial.kind} is configured"
        )

    # What is known

    @property
    def waiting_for(self) -> str:
        """What the start waits for, in plain words; empty while there is an estimate."""
        return "" if self._lag is not None else self._waiting

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
            self._settle(self._lag.gone())
        done, self._done = self._done, []
        return done

    def events(self) -> list[str]:
        """Return what happened since this was last asked, a line each: started, restarted, rebuilt, resumed."""
        events, self._events = self._events, []
        return events

    def finish(self) -> list[LedgerRow]:
        """End: return the rows of all that is left."""
        done = self.rows()
        if self._lag is not None:
            done += self._lag.held()
        why = (
            "the run ended before a state there"
            if self._lag is not None
            else f"never started: waiting for {self._waiting}"
        )
        left = [*self._pending, *([self._intake.leap] if self._intake.leap else [])]
        if self._lag is None:
            left += self._buffer
        done += [self._row(m, Outcome.REJECTED, why) for m in left if m.seq >= 0]
        self._pending, self._unread, self._intake.leap, self._buffer = [], [], None, deque()
        self._lag = None
        return done

    # What comes

    def feed(self, m: Measurement) -> Estimate | None:
        """Take a measurement (an `ImuSample` too); return the newest estimate if this made a new one."""
        if isinstance(m, ImuSample):
            return self._feed_imu(m)
        if m.sensor not in self._asked:
            self._drop(m, Outcome.IGNORED, "its sensor is switched off or not in the configuration")
            return None
        newest = self._intake.newest
        if newest is not None and m.stamp_ns - newest.stamp_ns > _AHEAD_S * 1e9:
            ahead_s = (m.stamp_ns - newest.stamp_ns) * 1e-9
            self._drop(m, Outcome.REJECTED, f"its stamp lies {ahead_s:.0f} s ahead of the IMU's")
        elif self._lag is None:
            self._hold(m)
        elif m.stamp_ns < self._lag.first_ns:
            late_s = (self._lag.newest.stamp_ns - m.stamp_ns) * 1e-9
            self._drop(
                m, Outcome.LATE, f"its stamp is {late_s:.1f} s before the newest state; the lag is {self._lag_s:g} s"
            )
        else:
            insort(self._pending, m, key=lambda p: p.stamp_ns)
            self._recent.append(m)
            if len(self._pending) > _PENDING:
                self._drop(self._pending.pop(), Outcome.REJECTED, "too many measurements wait for the IMU")
        return None

    def _hold(self, m: Measurement) -> None:
        """Keep a measurement while the start waits."""
        self._buffer.append(m)
        if len(self._buffer) > _BUFFERED:
            self._drop(self._buffer.popleft(), Outcome.REJECTED, f"came before the start: waiting for {self._waiting}")

    def _feed_imu(self, m: ImuSample) -> Estimate | None:
        if m.sensor != self._imu_name:
            other = m.sensor in self._config.sensors and self._config.sensors[m.sensor].enabled and self._imu_name
            why = f"{other} is the IMU" if other else "its sensor is switched off or not in the configuration"
            self._drop(m, Outcome.IGNORED, why)
            return None
        taken = self._intake.take(m, started=self._lag is not None)
        for lost, why in taken.dropped:
            self._drop(lost, Outcome.REJECTED, why)
        if taken.absurd and self._lag is None:
            self._waiting = f"IMU data that a vessel can have: {taken.absurd}"
        if taken.hangs:
            self._events.append(f"{m.sensor}: {WHY}; silent until it says another")
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
            self._hold(m)
            return
        assert hole is not None
        self._holes.append(hole)
        self._keep_imu(m)

    def _keep_imu(self, m: ImuSample) -> None:
        self._unread.append(m)
        self._recent.append(m)
        self._done.append(self._row(m, Outcome.USED, ""))

    def _forget_clock(self, back_s: float, stamp_ns: int) -> None:
        """Start anew by a clock that was set back."""
        self._restart(f"the IMU's clock was set back by {back_s:.1f} s")
        self._agreed_ns = {}
        if self._odometry is not None:
            self._odometry.stamp_ns = stamp_ns

    def _accept_imu(self, m: ImuSample) -> Estimate | None:
        silent_s = self._intake.accept(m)
        if silent_s > self._bridge_s:
            self._restart(f"the IMU was silent for {silent_s:.1f} s")
            self._intake.restart([m.stamp_ns])
        if self._lag is None:
            self._hold(m)
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
            if self._lag.refused_s > _LOST_S:
                return self._start_over(self._lag)
            if said := self._contradicted(self._lag):
                self._rebuild(said)
                return self._try_estimate()
            return self._estimate(self._lag)
        except Exception as error:  # noqa: BLE001 - whatever went wrong in there, the vessel still needs a pose
            self._rebuild(error)
        return self._try_estimate()

    def _contradicted(self, lag: Lag) -> str:
        """Take the IMU for noisier where the lag contradicts it time and again, as the batch does; what to say of it."""
        at_ns = lag.newest.stamp_ns
        if at_ns - self._fit_ns < _FIT_S * 1e9 or not self._config.sensors[self._imu_name].adapt_noise:
            return ""
        if not lag.fresh:  # steps cost what estimates have moved since they were linearised, up to a second ago
            return ""
        self._fit_ns = at_ns
        misfit = lag.misfit()
        self._misfits = self._misfits + 1 if misfit > CONTRADICTION else 0
        if self._misfits < _MISFITS or self._noise_scale >= NO_NOISE:
            return ""
        self._misfits = 0
        self._noise_scale = min(self._noise_scale * float(np.clip(np.sqrt(misfit), 1.5, 3.0)), NO_NOISE)
        return f"the IMU contradicts the other sensors: its noise is taken for {self._noise_scale:.1f} times as large"

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
                    self._drop(m, Outcome.LATE, "left the lag while it waited")
                    continue
                try:
                    lag.take(m)
                except Exception as error:  # noqa: BLE001 - as in `_advance`; nothing of it is staged yet
                    self._drop(m, Outcome.REJECTED, f"it could not be used: {in_one_line(error)}")
            lag.judge()
            assert self._odometry is not None
            carry_on(self._odometry, lag.problem, lag.newest, before.stamp_ns, reached)
            lag.commit()
            lag.try_others()
        self._settle(lag.gone())

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
        newest, problem, odometry = lag.newest, lag.problem, self._odometry
        now = no_further(newest, odometry)
        if stamp_ns is not None and stamp_ns > newest.stamp_ns:
            assert self._intake.newest is not None
            self._read(lag)
            blind_s = (stamp_ns - self._intake.newest.stamp_ns) * 1e-9
            now = ahead(problem, newest, odometry, stamp_ns, blind_s if blind_s > self._gap_s else 0.0)
        at_ns, lever = now.stamp_ns, -problem.t_body_imu_m
        R = now.pose.rotation().matrix()
        gyro = problem.links.gyro_at(np.array([at_ns]))[0] - problem.R_body_imu @ newest.bias.gyroscope()
        cov = world_covariance(sound(now.pose_cov), R, lever)
        cov[:3, :3] += left_out(list(problem.streams.values()))
        agreed = {**self._agreed_ns, **lag.agreed_ns}
        since = {n: max((at_ns - agreed[n]) * 1e-9, 0.0) if n in agreed else np.inf for n in self._absolute}
        health, reason = health_of(cov, since, self._doubt)
        if self._doubt and reason != self._doubt:
            reason = f"{reason}; {self._doubt}"
        return Estimate(
            stamp_ns=at_ns,
            p_world_m=np.asarray(now.pose.transformFrom(lever)),
            R_world_body=R,
            v_world_mps=now.velocity + R @ np.cross(gyro, lever),
            cov=cov,
            v_cov=now.velocity_cov,
            p_odom_m=np.array(now.p_odom_m),
            R_odom_body=np.array(now.R_odom_body),
            step_cov=odometry.step_cov,
            gyro_radps=gyro,
            accel_bias_mps2=np.asarray(newest.bias.accelerometer()),
            gyro_bias_radps=np.asarray(newest.bias.gyroscope()),
            health=health,
            reason=reason,
            since_agreed_s=since,
        )

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
        self._waiting = why
        self._buffer.clear()
        self._pending, self._unread, self._holes, self._recent, self._settled = [], [], [], [], set()
        self._intake.restart([])
        self._own_due_ns: dict[str, int] = {}
        self._tried_ns = 0
        self._anchors.clear()
        self._before: ImuSample | None = None  # the last sample before the oldest anchor
        self._snapshot_ns = 0

    def _restart(self, why: str) -> None:
        if self._lag is not None:
            self._settle([*self._lag.gone(), *self._lag.held()])
            self._agreed_ns.update(self._lag.agreed_ns)
            self._events.append(f"{why}: starts anew")
        for m in self._pending:
            self._drop(m, Outcome.REJECTED, "the run was cut before the IMU got there")
        for m in self._buffer:
            self._drop(m, Outcome.REJECTED, f"the run was cut while it waited for {self._waiting}")
        self._wait("the next IMU sample")

    def _try_to_start(self) -> Estimate | None:
        newest = self._intake.newest
        assert newest is not None
        if self._resumable is not None:
            self._resume(newest)
            return None
        while (newest.stamp_ns - self._buffer[0].stamp_ns) > _LONGEST_WAIT_S * 1e9:
            self._drop(self._buffer.popleft(), Outcome.REJECTED, f"came before the start: waiting for {self._waiting}")
        waited_ns = newest.stamp_ns - self._buffer[0].stamp_ns - duration_ns(LEAST_S)  # the more to solve, the rarer
        if newest.stamp_ns - self._tried_ns < max(_TRY_EVERY_S * 1e9, _TRY_AGAIN * waited_ns):
            return None
        self._tried_ns = newest.stamp_ns
        samples = sorted((m for m in self._buffer if isinstance(m, ImuSample)), key=lambda m: m.stamp_ns)
        self._intake.restart([m.stamp_ns for m in samples])
        others = [m for m in self._buffer if not isinstance(m, ImuSample) and m.stamp_ns <= newest.stamp_ns]
        try:
            started = try_start(
                self._at_start, self._rows, self._inertial, self._mounts, _series(samples), others, self._datum
            )
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            started = f"a start that can be solved: {in_one_line(error)}"
        if isinstance(started, str):
            self._waiting = started
            return None
        try:
            self._take_over(started, samples, [m for m in self._buffer if not isinstance(m, ImuSample)])
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            self._restart(f"the start failed ({in_one_line(error)})")
            return None
        return self._try_estimate()

    def _take_over(self, started: Started, samples: list[ImuSample], others: list[Measurement]) -> None:
        """Build the lag where the data begin, and bring it to now."""
        self._at_start = self._config.model_copy(
            update={"start": self._config.start.model_copy(update={"heading_deg": None})}
        )
        self._datum, self._heights_m, self._doubt = started.datum, started.heights_m, started.doubt
        self._noise_scale = max(self._noise_scale, started.noise_scale)
        self._done += [self._row(m, Outcome.USED, "") for m in samples if m.seq >= 0]
        self._buffer.clear()
        self._begin(started.anchor, samples, (started.pose, started.velocity, started.bias))
        assert self._lag is not None
        for m in others:
            if m.stamp_ns < self._lag.first_ns:
                self._drop(m, Outcome.REJECTED, "no IMU data at this stamp")
            else:
                self._pending.append(m)
        self._pending.sort(key=lambda m: m.stamp_ns)
        self._recent = [*samples, *self._pending]
        self._step(self._lag)
        self._keep_anchor(self._lag)
        self._fit_ns, self._misfits = self._lag.newest.stamp_ns, 0  # what has just begun has not settled
        self._events.append(f"started at {utc_text(self._lag.newest.stamp_ns)}: {'; '.join(started.notes)}")
        if started.doubt:
            self._events.append(started.doubt)
        for stream in self._lag.problem.streams.values():
            if stream.left_out is not None:
                self._events.append(alone(stream.name, stream.left_out))

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
            self._noise_scale,
        )
        agreed = {} if self._lag is None else self._lag.agreed_ns
        if self._lag is not None:
            for name, stream in self._lag.problem.streams.items():
                problem.streams[name].scatter.extend(stream.scatter)
                problem.streams[name].spread = stream.spread
        self._lag = Lag(problem, anchor, self._lag_s, guess)
        self._lag.agreed_ns.update(agreed)
        self._own_due_ns = {}
        if self._odometry is None:
            pose = self._lag.newest.pose
            place = np.asarray(pose.transformFrom(-problem.t_body_imu_m))
            self._odometry = Odometry(anchor.stamp_ns, place, pose.rotation().matrix())

    def _keep_anchor(self, lag: Lag) -> None:
        """Remember the newest state now and then, in memory and in the snapshot."""
        at_ns, anchors = lag.newest.stamp_ns, self._anchors
        if anchors and at_ns - anchors[-1].stamp_ns < _ANCHOR_S * 1e9:
            return
        anchors.append(lag.anchor())
        while anchors[0].stamp_ns < lag.first_ns:
            anchors.popleft()
        oldest_ns = anchors[0].stamp_ns
        kept = []
        for m in self._recent:
            if m.stamp_ns >= oldest_ns:
                kept.append(m)
            elif isinstance(m, ImuSample) and (self._before is None or m.stamp_ns > self._before.stamp_ns):
                self._before = m
        self._recent = kept
        self._settled &= {m.seq for m in kept}
        self._intake.forget(lag.first_ns)
        if self._snapshot is not None and at_ns - self._snapshot_ns >= _SNAPSHOT_S * 1e9:
            self._snapshot_ns = at_ns
            self._write_snapshot(self._snapshot)

    def _rebuild(self, error: Exception | str) -> None:
        """Build the lag anew: with all that is in it; if that fails too, from the last anchor without what came since; or start anew.

        An anchor holds what was known when its state was the newest, so what was measured since can be taken again.
        """
        why = error if isinstance(error, str) else f"the solver failed ({in_one_line(error)})"
        log.warning("online: %s", why)
        assert self._lag is not None
        old = self._lag
        anchors = [a for a in self._anchors if a.stamp_ns >= old.first_ns]
        self._settle(old.gone())
        for anchor, without in [(anchors[0], False), (anchors[-1], True)] if anchors else []:
            again = [m for m in self._recent if m.stamp_ns >= anchor.stamp_ns and m.seq not in self._settled]
            samples = [m for m in self._recent if isinstance(m, ImuSample)]
            samples = sorted([*([self._before] if self._before else []), *samples], key=lambda m: m.stamp_ns)
            others = sorted((m for m in again if not isinstance(m, ImuSample)), key=lambda m: m.stamp_ns)
            self._unread, self._holes, self._pending = [], [], [] if without else list(others)
            settled, done = set(self._settled), list(self._done)
            try:
                self._begin(anchor, samples)
                fresh = self._lag
                self._step(fresh)
                fresh.settle()
            except Exception as another:  # noqa: BLE001 - as in `_advance`
                why, self._settled, self._done = f"the solver failed ({in_one_line(another)})", settled, done
                continue
            if without:
                for m in others:
                    self._drop(m, Outcome.REJECTED, f"left out: {why}")
                self._anchors = deque([anchor])
            self._close(old, {m.seq for m in others})
            age_s = (fresh.newest.stamp_ns - anchor.stamp_ns) * 1e-9
            self._events.append(f"{why}: rebuilt from {age_s:.1f} s before")
            return
        held = {row.seq for row in old.held()}
        self._lag, self._pending = old, [
            m for m in self._recent
            if not isinstance(m, ImuSample) and m.seq not in self._settled and m.seq not in held
        ]  # fmt: skip
        self._restart(f"{why}, and again from what was known before")

    def _start_over(self, lag: Lag) -> Estimate | None:
        """Start anew, with the last seconds: what measures place agrees with itself or not, but not with the estimate."""
        assert self._intake.newest is not None
        since_ns = self._intake.newest.stamp_ns - duration_ns(_AGAIN_S)
        self._settle(lag.gone())
        again = [m for m in self._recent if m.stamp_ns >= since_ns and m.seq not in self._settled]
        self._close(lag, {m.seq for m in again})
        self._agreed_ns.update(lag.agreed_ns)
        self._events.append(f"no absolute sensor agreed for {lag.refused_s:.0f} s: starts anew")
        self._wait("the next IMU sample")
        # Samples have their rows already.
        self._buffer.extend(replace(m, seq=-1) if isinstance(m, ImuSample) else m for m in again)
        return self._try_to_start()

    def _close(self, old: Lag, again: set[int]) -> None:
        """Give the rows of a lag that was replaced, but for what was taken again."""
        rows = [row for row in old.held() if row.seq not in again]
        self._settle(rows)
        for m in self._recent:
            if not isinstance(m, ImuSample) and m.seq not in self._settled and m.seq not in again:
                self._drop(m, Outcome.LATE, "came before the oldest state of a lag that was built anew")

    def _settle(self, rows: Sequence[LedgerRow]) -> None:
        """Enter rows into the ledger."""
        self._done += rows
        if self._lag is not None:
            self._settled.update(row.seq for row in rows)

    # Snapshot

    def _write_snapshot(self, path: Path) -> None:
        assert self._odometry is not None
        assert self._datum is not None
        anchor = self._anchors[-1]
        last = max(
            (m for m in [self._before, *self._recent] if isinstance(m, ImuSample) and m.stamp_ns <= anchor.stamp_ns),
            key=lambda m: m.stamp_ns,
            default=self._intake.newest,
        )
        assert last is not None
        snapshot = Snapshot(
            vessel=self._config.vessel,
            anchor=anchor,
            imu=last,
            datum=self._datum,
            heights_m=self._heights_m,
            agreed_ns={**self._agreed_ns, **(self._lag.agreed_ns if self._lag else {})},
            noise_scale=self._noise_scale,
            doubt=self._doubt,
            p_odom_m=self._odometry.p_m,
            R_odom_body=self._odometry.R,
        )
        try:
            snapshot.write(path)
        except OSError as error:
            if not self._unwritable:
                self._events.append(f"{path}: the snapshot cannot be written ({error.strerror or error})")
            self._unwritable = True
            return
        self._unwritable = False

    def _read_snapshot(self) -> Snapshot | None:
        path = self._snapshot
        if path is None or not path.exists():
            return None
        try:
            found = Snapshot.read(path, self._imu_name)
            if found.vessel != self._config.vessel:
                raise ValueError("it is of another vessel")
            if self._datum is not None and not np.allclose(found.datum.origin, self._datum.origin, rtol=0.0, atol=1e-9):
                raise ValueError("its origin of world is another one")
        except Exception as error:  # noqa: BLE001 - a file that anything may have written
            self._events.append(f"{path}: the snapshot cannot be used ({in_one_line(error)}): starts anew")
            return None
        return found

    def _resume(self, newest: ImuSample) -> None:
        """Go on from the snapshot, if the first sample is not too far from it."""
        assert self._resumable is not None
        found, self._resumable = self._resumable, None
        anchor, last = found.anchor, found.imu
        age_s = (newest.stamp_ns - anchor.stamp_ns) * 1e-9
        if not 0.0 < age_s <= self._bridge_s:
            self._events.append(f"the snapshot is {age_s:.1f} s old, more than the {self._bridge_s:g} s that the IMU's "
                                "silence is bridged for: starts anew")  # fmt: skip
            return
        before = self._datum
        self._datum, self._noise_scale = found.datum, found.noise_scale
        try:
            self._begin(anchor, [last, newest])
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            self._lag, self._datum, self._noise_scale = None, before, 1.0
            self._events.append(f"the snapshot cannot be used ({in_one_line(error)}): starts anew")
            return
        self._agreed_ns = dict(found.agreed_ns)
        self._heights_m = {n: h for n, h in found.heights_m.items() if n in self._asked}
        self._odometry = Odometry(anchor.stamp_ns, found.p_odom_m, found.R_odom_body)
        self._doubt = found.doubt
        waiting, self._buffer = [m for m in self._buffer if m is not newest], deque()
        self._anchors, self._before, self._recent = deque([anchor]), last, [newest]
        self._done.append(self._row(newest, Outcome.USED, ""))
        self._events.append(f"resumed from a snapshot {age_s:.1f} s old")
        for m in waiting:
            self.feed(m)

    # The ledger

    def _drop(self, m: Measurement, outcome: Outcome, reason: str) -> None:
        if m.seq >= 0:
            self._settle([self._row(m, outcome, reason)])

    def _row(self, m: Measurement, outcome: Outcome, reason: str) -> LedgerRow:
        sensor = self._config.sensors.get(m.sensor)
        topic = "" if sensor is None else sensor.topic
        return LedgerRow(
            seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic=topic, outcome=outcome, reason=reason
        )  # fmt: skip


def _series(samples: Sequence[ImuSample]) -> ImuSeries:
    return ImuSeries(
        sensor=samples[0].sensor if samples else "",
        stamps_ns=np.array([m.stamp_ns for m in samples], dtype=np.int64),
        accel_mps2=np.array([m.accel_mps2 for m in samples]).reshape(-1, 3),
        gyro_radps=np.array([m.gyro_radps for m in samples]).reshape(-1, 3),
        seqs=np.array([m.seq for m in samples], dtype=np.int64),
    )
