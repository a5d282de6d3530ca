# SPDX-License-Identifier: Apache-2.0
"""Feed measurements as they arrive, get estimates.

Either there is an estimate (`_tracking`), or all that arrives is held until one can be started (`_waiting`, `_start`).
A window that fails is rebuilt from an earlier state. The estimate restarts where that fails too, where the IMU was
silent for too long, where its clock was set back, and where no absolute sensor agrees any more.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from graphloc.build import mount_of
from graphloc.config import VesselConfig
from graphloc.errors import SolveError, in_one_line
from graphloc.estimate import Estimate, Event
from graphloc.frames import Array, Datum
from graphloc.graph import Sensor
from graphloc.inertial import InertialRow
from graphloc.judge.warnings import slow_error_warning
from graphloc.ledger import NOT_ASKED_FOR, LedgerRow, Outcome
from graphloc.measurements import ImuSample, Measurement
from graphloc.online._intake import ImuIntake, series_of
from graphloc.online._ledger import OnlineLedger
from graphloc.online._noise import ImuNoise
from graphloc.online._persistent import PersistentState
from graphloc.online._setup import Setup
from graphloc.online._snapshot import SnapshotFile
from graphloc.online._start import LEAST_S, Started, try_start
from graphloc.online._tracking import Tracking, failure_text
from graphloc.online._unmeasured_heading import UnmeasuredHeading
from graphloc.online._waiting import Waiting
from graphloc.origin import refuse_world_without_datum
from graphloc.recording import Mounts
from graphloc.signals.frozen_imu import FROZEN_IMU
from graphloc.signals.imu_spikes import IMU_SPIKE
from graphloc.signals.repeats import REPEATED, Repeats
from graphloc.signals.thinning import THINNED, Thinning
from graphloc.time import duration_ns, utc_text
from graphloc.trajectory import Trajectory

log = logging.getLogger(__name__)
_AGAIN_S = 6.0  # length of the data with which a lost estimate starts anew
_AHEAD_S = 60.0  # by which a stamp may lie ahead of the IMU's: beyond, it is of another clock
_MOST_REPEATS = 1000  # messages of a sensor: what is repeated later comes too late to be used, too
_MOST_NAMES = 100  # unconfigured sensors of which it is said, once each, that they are ignored
_NOT_REACHED = "the estimate restarted before IMU data reached its stamp"


class OnlineSmoother:
    """A fixed-lag smoother that starts by itself, and recovers from failures.

    Args:
        config: the vessel, its surveys read. rows, inertial: the table of sensors (`graphloc.factors`).
        datum: origin of world; None: from the configuration, or else from the first fixes.
        mounts: body -> sensor (t (3,), R (3, 3)) of sensors whose mount is not the configuration's (`tf_frame`, of
            /tf_static).
        lag_s: how long a measurement can still be judged otherwise, and how late it may come.
        snapshot: file to write the state to every few seconds, and to resume from if it is there; None: no such file.

    Raises:
        InputError: a sensor measures in world, whose origin is not known; or a mount is given by a frame that is not in
            `mounts`.
    """

    def __init__(
        self,
        config: VesselConfig,
        *,
        rows: Sequence[Sensor],
        inertial: InertialRow,
        datum: Datum | None = None,
        mounts: Mounts = MappingProxyType({}),
        lag_s: float = 10.0,
        snapshot: Path | None = None,
    ) -> None:
        if datum is None:
            refuse_world_without_datum(config, "vessel.yaml", rows)
        for name, sensor in config.sensors.items():
            if sensor.enabled:
                mount_of(name, sensor, mounts)
        setup = Setup(config=config, rows=tuple(rows), inertial=inertial, mounts=dict(mounts), lag_s=lag_s)
        self._setup, imu = setup, setup.imu
        self._persistent = PersistentState(
            datum=datum or (Datum(config.datum.geodetic) if config.datum else None), noise=self._configured_noise()
        )
        self._ledger = OnlineLedger(config)
        self._ignored: set[str] = set()  # names of sensors, said once
        self._events: list[Event] = []
        self._repeats = {n: Repeats(_MOST_REPEATS) for n in setup.measuring}
        self._thinnings = {n: Thinning(apart_ns) for n, apart_ns in setup.apart_ns.items()}
        self._intake = ImuIntake(setup.gap_s, imu is not None and imu.gravity != "removed")
        self._snapshot = SnapshotFile(snapshot)
        self._resumable, trouble = self._snapshot.read(config.vessel, setup.imu_name, self.datum)
        self._say(trouble)
        self._waiting = Waiting(self._ledger)
        self._tracking: Tracking | None = None
        # To start over where the heading was a guess: stamp of the last try, and how often the data denied a heading
        # that the motion told.
        self._tried_ns, self._denied = 0, 0
        self.antennas_off_m: Mapping[str, Array] = {}
        """By receiver, the antenna's place less that of its mount (3,), m, body axes, if estimated; set by `finish`."""
        self._wait(
            "the first IMU sample" if imu else f"an IMU: no enabled sensor of kind {inertial.kind} is configured"
        )

    def _configured_noise(self) -> ImuNoise:
        return ImuNoise(adapt=self._setup.imu is not None and self._setup.imu.adapt_noise)

    # What is known

    @property
    def waiting_for(self) -> str:
        """What the start waits for, in plain words; empty while there is an estimate."""
        return "" if self._tracking is not None else self._waiting.why

    @property
    def datum(self) -> Datum | None:
        """Origin of world; None before it is known."""
        return self._persistent.datum

    @property
    def factor_slots(self) -> int:
        """Number of places that the solver keeps for factors; it does not grow with the length of the run."""
        return 0 if self._tracking is None else self._tracking.lag.factor_slots

    def predict(self, stamp_ns: int | None = None) -> Estimate | None:
        """Return the newest state propagated by the IMU to a stamp; by default that of the newest IMU sample.

        None before the start, and for a stamp that lies farther ahead of the IMU than its silences are bridged
        (`max_bridge_s`).
        """
        newest = self._intake.newest
        if self._tracking is None or newest is None:
            return None
        at_ns = newest.stamp_ns if stamp_ns is None else stamp_ns
        if at_ns - newest.stamp_ns > self._setup.bridge_s * 1e9:
            return None
        try:
            self._tracking.solve_late_imu()
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            self._rebuild(failure_text(error))
        return self._estimate(at_ns)

    def window(self) -> Trajectory | None:
        """Return the states of the lag, and the newest propagated to the newest IMU sample: a prior for front-ends.

        All have the covariance of the newest, because scans are searched around that (see `Tracking.trajectory`).
        """
        now = self.predict()
        return None if now is None or self._tracking is None else self._tracking.trajectory(now)

    def rows(self) -> list[LedgerRow]:
        """Return the ledger rows that became final since the last call; a measurement's does when it leaves the lag."""
        if self._tracking is not None:
            self._ledger.enter(self._tracking.lag.gone())
        return self._ledger.taken()

    def events(self) -> list[Event]:
        """Return what happened since the last call: start, restart, rebuild, resume, what is wrong with a sensor."""
        events, self._events = self._events, []
        return events

    def _say(self, text: str, *, warns: bool = True) -> None:
        """Add an event, if there is anything to say."""
        if text:
            self._events.append(Event(text, warns))

    def _estimate(self, stamp_ns: int | None = None) -> Estimate | None:
        """Return the newest state, or its propagation to a later stamp; None where there is none, or it fails."""
        if self._tracking is None:
            return None
        try:
            return self._tracking.estimate(stamp_ns)
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            log.warning("online: %s", in_one_line(error))
            return None

    # What arrives

    def feed(self, m: Measurement) -> Estimate | None:
        """Take a measurement or an `ImuSample`; return the new estimate, if it made one, else None."""
        if isinstance(m, ImuSample):
            return self._feed_imu(m)
        if m.sensor not in self._setup.measuring:
            self._ignore(m, NOT_ASKED_FOR)
            return None
        if self._repeats[m.sensor].repeats(m.stamp_ns, m):
            self._ledger.drop(m, Outcome.REJECTED, REPEATED)
            return None
        newest = self._intake.newest
        if newest is None:
            self._take(m)
            return None
        if silent_s := self._intake.silent_s(m):
            self._say(
                f"{newest.sensor}: no sample has come while {m.sensor} went on for {silent_s:.1f} s: no new pose until one comes"
            )
        taken = self._persistent.clocks[m.sensor].take(m, newest.stamp_ns, self._setup.lag_s)
        self._say(taken.said)
        if taken.earlier_off_ns:
            self._put_right(m.sensor, taken.earlier_off_ns)
        for right in taken.found:
            self._take(right)
        return None

    def _put_right(self, sensor: str, off_ns: int) -> None:
        """Take `off_ns` off the stamps of what is held of a sensor; an estimate that used these stamps starts anew."""

        def right(m: Measurement) -> Measurement:
            return replace(m, stamp_ns=m.stamp_ns - off_ns) if m.sensor == sensor else m

        tracking = self._tracking
        if tracking is None:
            for m in self._waiting.taken():
                self._waiting.hold(right(m))
        elif any(row.sensor == sensor and row.weight for row in tracking.lag.held()):
            came = [right(m) for m in tracking.since(tracking.lag.first_ns)]
            self._persistent.receivers.pop(sensor, None)
            self._start_over(tracking, tracking.lag.first_ns, f"{sensor} was used at wrong times", came=came)
        else:
            for m in tracking.taken_back(sensor):
                self._take(right(m))

    def _take(self, m: Measurement) -> None:
        """Keep a measurement whose stamp is right until the states reach it, or give it its ledger row."""
        if self._thinnings[m.sensor].drops(m.stamp_ns):
            self._ledger.drop(m, Outcome.REJECTED, THINNED)
            return
        newest, tracking = self._intake.newest, self._tracking
        if newest is not None and m.stamp_ns - newest.stamp_ns > _AHEAD_S * 1e9:
            ahead_s = (m.stamp_ns - newest.stamp_ns) * 1e-9
            self._ledger.drop(m, Outcome.REJECTED, f"its stamp lies {ahead_s:.0f} s ahead of the IMU's")
        elif tracking is None:
            self._waiting.hold(m)
        elif m.stamp_ns < tracking.lag.first_ns:
            late_s = (tracking.lag.newest.stamp_ns - m.stamp_ns) * 1e-9
            lag_s = self._setup.lag_s
            self._ledger.drop(
                m, Outcome.LATE, f"its stamp is {late_s:.1f} s before the newest state; the lag is {lag_s:g} s"
            )
        else:
            tracking.keep(m)

    def _ignore(self, m: Measurement, why: str) -> None:
        self._ledger.drop(m, Outcome.IGNORED, why)
        said = m.sensor in self._ignored or len(self._ignored) >= _MOST_NAMES
        if m.sensor not in self._setup.config.sensors and not said:  # misspelt?
            self._ignored.add(m.sensor)
            self._say(f"{m.sensor}: its messages are ignored: no sensor has this name in the configuration")

    def _feed_imu(self, m: ImuSample) -> Estimate | None:
        if m.sensor != self._setup.imu_name:
            sensor = self._setup.config.sensors.get(m.sensor)
            other = sensor is not None and sensor.enabled and self._setup.imu_name
            self._ignore(m, f"{other} is the IMU" if other else NOT_ASKED_FOR)
            return None
        taken = self._intake.take(m, started=self._tracking is not None)
        for lost, why in taken.dropped:
            self._ledger.drop(lost, Outcome.REJECTED, why)
        if taken.absurd and self._tracking is None:
            self._waiting.why = f"IMU data that a vessel can have: {taken.absurd}"
        if taken.newly_frozen:
            self._say(f"{m.sensor}: {FROZEN_IMU}; treated as an IMU gap until the samples change")
        if taken.newly_spiked:
            self._say(f"{m.sensor}: a sample is {IMU_SPIKE}; all such are rejected")
        if taken.late is not None:
            self._keep_imu(taken.late, taken.hole)
        if taken.set_back_s:
            self._restart(f"the IMU's clock was set back by {taken.set_back_s:.1f} s")
            self._persistent.forget_clock(m.stamp_ns)
            for repeats in self._repeats.values():
                repeats.forget()
        made = None
        for sample in taken.accepted:
            made = self._accept_imu(sample) or made
        return made

    def _keep_imu(self, m: ImuSample, hole: tuple[int, int] | None = None) -> None:
        if self._tracking is None:
            self._waiting.hold(m)
        else:
            self._tracking.keep_imu(m, hole)

    def _accept_imu(self, m: ImuSample) -> Estimate | None:
        """Take the newest sample: a state may be due, or a start."""
        silent_s = self._intake.accept(m)
        if silent_s > self._setup.bridge_s:
            self._restart(f"the IMU was silent for {silent_s:.1f} s")
            self._intake.restart([m.stamp_ns])
        self._keep_imu(m)
        return self._try_to_start(m) if self._tracking is None else self._advance(self._tracking, m.stamp_ns)

    # An estimate underway

    def _advance(self, tracking: Tracking, until_ns: int) -> Estimate | None:
        """Make the states due up to a stamp, judge what attaches to them, and rebuild or restart if that is needed."""
        if not tracking.due(until_ns):
            return None
        try:
            known = self._persistent.heading
            tracking.advance(until_ns)
            self._keep_anchor(tracking)
            self._events += tracking.news()
            if (doubted := tracking.doubt_imu(until_ns)) is not None:
                self._say(doubted)
                self._persistent.noise.walk.begin()
                return self._estimate()
            if lost_s := tracking.lag.lost_s:
                why = f"for {lost_s:.0f} s no absolute sensor agreed, unless its error had jumped"
                return self._start_over(tracking, until_ns - duration_ns(_AGAIN_S), why)
            if (again := self._start_with_heading(tracking, until_ns, known)) is not None:
                return self._start_over(tracking, tracking.lag.first_ns, *again)
            if jumped := tracking.lag.unmodelled_jumps:
                self._rebuild(", ".join(jumped))
                return self._estimate()
            persistent = self._persistent
            if noise := persistent.sensor_noise.changed(tracking.lag):
                self._rebuild(noise)
                return self._estimate()
            doubtful = persistent.heading_check.doubtful
            if noise := persistent.noise.changed(tracking.lag, tracking.samples, heading_doubtful=doubtful):
                self._rebuild(noise, persistent.noise.misled)
                return self._estimate()
            return tracking.estimate()
        except Exception as error:  # noqa: BLE001 - whatever went wrong in there, the vessel still needs a pose
            self._rebuild(failure_text(error))
        return self._estimate()

    def _keep_anchor(self, tracking: Tracking) -> None:
        """Remember the newest state now and then, in memory and in the snapshot."""
        if not tracking.keep_anchor():
            return
        self._intake.forget(tracking.lag.first_ns)
        if self._snapshot.due(tracking.lag.newest.stamp_ns):
            assert self._intake.newest is not None
            self._say(self._snapshot.write(tracking.snapshot(self._intake.newest)))

    def _rebuild(self, why: str, misled: float = 1.0) -> None:
        """Rebuild the window from an earlier state; where that fails, restart. `misled`: as of `Tracking.rebuild`."""
        log.warning("online: %s", why)
        assert self._tracking is not None
        assert self._intake.newest is not None
        self._persistent.noise.walk.begin()
        try:
            self._say(self._tracking.rebuild(why, self._intake.newest.stamp_ns, misled))
        except SolveError as error:
            self._restart(str(error))

    # Start, restart, resume, end

    def _wait(self, why: str) -> None:
        """Give up the estimate, and wait for a start."""
        self._tracking, self._tried_ns, self._denied = None, 0, 0
        self._persistent.forget_receivers()
        self._waiting.begin(why)
        self._ledger.close()
        self._intake.restart([])
        self._snapshot.restart()

    def _try_to_start(self, newest: ImuSample) -> Estimate | None:
        if self._resumable is not None:
            self._resume(newest)
            return None
        if not self._waiting.due(newest.stamp_ns):
            return None
        samples = self._waiting.samples()
        self._intake.restart([m.stamp_ns for m in samples])
        started = self._start_from(samples, self._waiting.others(), newest.stamp_ns)
        if isinstance(started, str):
            self._waiting.why = started
            return None
        return self._begin(started, newest.stamp_ns)

    def _begin(self, started: Started, until_ns: int) -> Estimate | None:
        """Begin with a start that was solved with what is held; where that fails, restart."""
        samples, others = self._waiting.samples(), self._waiting.others()
        try:
            self._take_over(started, samples, others, until_ns)
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            if self._tracking is None:
                for m in others:
                    self._ledger.drop(m, Outcome.REJECTED, _NOT_REACHED)
            self._restart(f"the start failed ({in_one_line(error)})")
            return None
        return self._estimate()

    def _start_from(
        self,
        samples: Sequence[ImuSample],
        others: Sequence[Measurement],
        until_ns: int,
        near_rad: float | None = None,
    ) -> Started | str:
        """Return the start, or in words what it waits for.

        Args:
            until_ns: stamp of the newest sample; later measurements are left out. near_rad: as in `try_start`.
        """
        reached = [m for m in others if m.stamp_ns <= until_ns]
        try:
            setup = self._setup.scaled(self._persistent.sensor_noise.times)
            return try_start(setup, series_of(samples), reached, self.datum, near_rad)
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            return f"data from which the start can be solved: {in_one_line(error)}"

    def _take_over(self, started: Started, samples: list[ImuSample], others: list[Measurement], until_ns: int) -> None:
        """Build the window at the start's state, and bring it up to the newest sample."""
        persistent, setup = self._persistent, self._setup.without_start_heading()
        persistent.datum, persistent.heights_m = started.datum, started.heights_m
        persistent.heading = started.heading
        persistent.noise.at_least(started.noise_scale, started.gyro_noise, started.accel_noise, *started.bias_walk)
        persistent.sensor_noise.enlarge(started.sensor_noise)
        persistent.heading_check.begin()
        for sample in samples:
            self._ledger.used(sample)
        self._waiting.taken()
        solved = (started.pose, started.velocity, started.bias)
        tracking = Tracking(setup, persistent, self._ledger, started.anchor, samples, solved)
        persistent.unmodelled = tracking.lag.unmodelled(started.before)
        self._tracking = tracking  # last of what can fail, as it has to hold the measurements then
        self._ledger.enter(started.rows)
        tracking.catch_up(started.anchor, samples, others, until_ns)
        self._setup = setup  # a start that fails needs the heading again
        self._keep_anchor(tracking)
        newest_ns = tracking.lag.newest.stamp_ns
        persistent.noise.begin(newest_ns)
        self._say(f"started at {utc_text(newest_ns)}: {'; '.join(started.notes)}", warns=False)
        for said in started.warnings:
            self._say(said)
        for stream in tracking.lag.problem.streams.values():
            for said in slow_error_warning(stream.name, stream.left_out, without_height=stream.without_height):
                self._say(said)

    def _restart(self, why: str) -> None:
        """Give up the estimate, and start from what arrives from now on."""
        self._say(f"{why}: restarts")
        if self._tracking is not None:
            self._tracking.end(_NOT_REACHED)
            self._persistent.agreed_ns.update(self._tracking.lag.agreed_ns)
        self._waiting.refuse(f"the estimate restarted while waiting for {self._waiting.why}")
        self._wait("the next IMU sample")

    def _start_with_heading(
        self, tracking: Tracking, now_ns: int, known: UnmeasuredHeading | None
    ) -> tuple[str, Started, list[Measurement]] | None:
        """Return a new start where the heading was a guess, but sensors or the motion tell it by now.

        Returns:
            Why, the start, and its data.

        None where the heading was no guess, or nothing tells it yet. If the window corrected a wrong guess instead,
        wrong biases, velocities and places of antennas would stay, and with them a wrong heading.

        Args:
            known: by how much the heading could be off before the newest state; None: it was no guess.
        """
        if known is None or not known.doubt(now_ns):
            return None
        heading, check = self._persistent.heading, self._persistent.heading_check
        told = heading is None or not heading.doubt(now_ns) or check.said != ""
        if not told and not tracking.heading_measured():
            return None
        again_s = LEAST_S * (2**self._denied if told else 1)
        if heading is None or now_ns - self._tried_ns >= duration_ns(again_s):
            self._tried_ns = now_ns
            came, near_rad = tracking.told_by(check.off_rad) if told else (tracking.since(tracking.lag.first_ns), None)
            samples = [m for m in came if isinstance(m, ImuSample)]
            started = self._start_from(samples, [m for m in came if not isinstance(m, ImuSample)], now_ns, near_rad)
            # A guess that fits the motion is better than one that does not.
            if not isinstance(started, str) and (check.said or not started.heading):
                check.put_right()
                why = "the motion tells" if told else "sensors measure"
                return f"{why} the heading, which was a guess", started, came
            self._denied += told
        if told and heading is not None:
            self._persistent.heading = known  # one check alone is less than all the data that it looked at
        return None

    def _start_over(
        self,
        tracking: Tracking,
        since_ns: int,
        why: str,
        started: Started | None = None,
        came: Sequence[Measurement] = (),
    ) -> Estimate | None:
        """Start anew with the data since a stamp (ns), or with other data.

        Args:
            why: for the event. started: the start, where it is solved; it was solved from `came`.
            came: data to start from instead, if any.
        """
        again = tracking.end_but(since_ns)
        self._persistent.agreed_ns.update(tracking.lag.agreed_ns)
        self._say(f"{why}: restarts")
        self._wait("the next IMU sample")
        # Samples have their rows already.
        for m in came or again:
            self._waiting.hold(replace(m, seq=-1) if isinstance(m, ImuSample) else m)
        newest = self._intake.newest
        assert newest is not None
        if started is None:
            return self._try_to_start(newest)
        self._intake.restart([m.stamp_ns for m in self._waiting.samples()])
        return self._begin(started, newest.stamp_ns)

    def _resume(self, newest: ImuSample) -> None:
        """Go on from the snapshot, if the first sample comes soon enough after it."""
        assert self._resumable is not None
        found, self._resumable, setup = self._resumable, None, self._setup
        age_s, bridge_s = (newest.stamp_ns - found.anchor.stamp_ns) * 1e-9, setup.bridge_s
        if age_s <= 0.0:
            self._say(f"the snapshot is {-age_s:.1f} s newer than the first IMU sample (the clock was set back, or the data are "
                      "played again): starts without it")  # fmt: skip
            return
        if age_s > bridge_s:
            self._say(f"the snapshot is {age_s:.1f} s old, more than the {bridge_s:g} s (max_bridge_s) that "
                      "can be bridged: starts without it")  # fmt: skip
            return
        found = found.for_settings(setup.settings)
        persistent = PersistentState.resumed(
            found, self._configured_noise(), {n: setup.config.sensors[n] for n in setup.measuring}
        )
        try:
            tracking = Tracking(self._setup, persistent, self._ledger, found.anchor, [found.imu, newest])
            persistent.unmodelled = tracking.lag.unmodelled(last=found.unmodelled)
        except Exception as error:  # noqa: BLE001 - as in `_advance`
            self._say(f"the snapshot cannot be used ({in_one_line(error)}): starts without it")
            return
        self._tracking, self._persistent = tracking, persistent
        self._setup = setup.without_start_heading()  # that was the heading at the first start
        waiting = [m for m in self._waiting.taken() if m is not newest]
        tracking.resume(found.anchor, found.imu, newest)
        self._say(f"resumed from a snapshot {age_s:.1f} s old", warns=False)
        for m in waiting:
            if isinstance(m, ImuSample):
                self._feed_imu(m)
            else:
                self._take(persistent.clocks[m.sensor].right(m))

    def finish(self) -> list[LedgerRow]:
        """End the run; return the ledger rows of all that has none yet."""
        for m in [m for clock in self._persistent.clocks.values() for m in clock.left()]:
            self._take(m)
        why = f"never started: waiting for {self._waiting.why}"
        if self._tracking is not None:
            why = "the run ended before there was a state at its stamp"
            self._tracking.end(why)
            self.antennas_off_m = self._tracking.lag.antennas_off_m()
        for m in self._intake.left():
            self._ledger.drop(m, Outcome.REJECTED, why)
        self._waiting.refuse(why)
        self._tracking = None
        return self._ledger.taken()
