# SPDX-License-Identifier: Apache-2.0
"""An estimate underway: the sliding window follows the IMU, and is rebuilt from an earlier state if it fails."""

from __future__ import annotations

import logging
from bisect import insort
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import replace

import gtsam
import numpy as np

from graphloc.errors import SolveError, in_one_line
from graphloc.estimate import Estimate, Event
from graphloc.frames import Array, yaw_from_rotation
from graphloc.judge.health import why_ahead
from graphloc.judge.wrong_imu import WRONG_IMU
from graphloc.ledger import Outcome
from graphloc.measurements import ImuSample, ImuSeries, Measurement
from graphloc.online._anchor import Anchor
from graphloc.online._estimates import estimate_of
from graphloc.online._heading_guess import HeadingGuess
from graphloc.online._imu_doubt import ImuDoubt, turns_otherwise
from graphloc.online._intake import series_of
from graphloc.online._lag import Lag
from graphloc.online._ledger import OnlineLedger
from graphloc.online._live import live_problem
from graphloc.online._odometry import Odometry
from graphloc.online._persistent import PersistentState
from graphloc.online._propagate import advance_odometry, propagate, unpropagated
from graphloc.online._receiver_checks import FROZEN_ONLINE
from graphloc.online._recent import Recent
from graphloc.online._setup import Setup
from graphloc.online._snapshot import Snapshot
from graphloc.time import duration_ns, stamps_of, utc_text
from graphloc.trajectory import Trajectory

log = logging.getLogger(__name__)
_AT_ONCE = 10  # most states that one commit makes, after a gap of the IMU
_PENDING = 10_000  # most measurements that may wait for the IMU
_TOLD_S = 60.0  # length of the data by which the motion may tell a heading that was a guess
_FROZEN = f"{FROZEN_ONLINE}; its fixes are rejected until it moves"
_NO_LONGER_FROZEN = "no longer frozen: its fixes are used again"


class Tracking:
    """The window of one start, what waits to enter it, and what it can be rebuilt from.

    Args:
        setup: of the online mode. persistent: state outside the window, updated as the window moves on.
        ledger: where measurements get their rows.
        anchor: the state that the window begins at. samples: of the IMU, from the anchor or before it to the newest.
        guess: pose, velocity (3,) and bias (6,) that the anchor's state is first solved at; default: the anchor's own.

    Attributes:
        lag: the window; another object after a rebuild.

    Raises:
        SolveError: the window cannot be built.
    """

    def __init__(
        self,
        setup: Setup,
        persistent: PersistentState,
        ledger: OnlineLedger,
        anchor: Anchor,
        samples: Sequence[ImuSample],
        guess: tuple[gtsam.Pose3, Array, Array] | None = None,
    ) -> None:
        self._setup, self._persistent, self._ledger = setup, persistent, ledger
        self._pending: list[Measurement] = []  # measurements that wait for the IMU to reach them, by stamp
        self._unread: list[ImuSample] = []  # samples not yet handed to the window
        self._holes: list[tuple[int, int]] = []  # stamps (ns) between which samples came late
        self._height_due_ns: dict[str, int] = {}  # stamp of the next configured height, by sensor
        self._recent, self._doubt = Recent(), ImuDoubt()
        self._held_out: list[ImuSample] = []  # samples left out since the last gap began, or was lengthened
        self.lag = self._built(anchor, samples, guess)
        if persistent.odometry is None:
            pose = self.lag.newest.pose
            place = np.asarray(pose.transformFrom(-self.lag.problem.t_body_imu_m))
            persistent.odometry = Odometry(anchor.stamp_ns, place, pose.rotation().matrix())
        self._odometry = persistent.odometry
        self._guess = HeadingGuess()

    def _built(
        self,
        anchor: Anchor,
        samples: Sequence[ImuSample],
        guess: tuple[gtsam.Pose3, Array, Array] | None = None,
        before: Lag | None = None,
    ) -> Lag:
        """Return a window that begins at an anchor; `before`: the window that it replaces, if it does."""
        persistent = self._persistent
        setup = self._setup.scaled(persistent.sensor_noise.times)
        since_ns = anchor.stamp_ns - 2 * duration_ns(setup.gap_s)
        since_ns = min([since_ns, *(a for a, _ in self._doubt.told_by(anchor.stamp_ns))])
        known = [m for m in samples if m.stamp_ns >= since_ns] or samples[-1:]
        assert persistent.datum is not None
        problem = live_problem(
            setup,
            persistent.datum,
            imu=series_of(known),
            start_ns=anchor.stamp_ns,
            imu_config=persistent.noise.of(setup.imu),
            noise_scale=persistent.noise.scale,
            motion_model=persistent.motion_model,
            receivers=persistent.receivers,
            slow_known=anchor.slow,
        )
        for gap in self._doubt.gaps:
            problem.links.leave_out(*gap)
        if before is not None:
            for name, stream in problem.streams.items():
                was = before.problem.streams[name]
                if stream.config == was.config:  # else its residuals were normalised to other sigmas
                    stream.scatter = deepcopy(was.scatter)
        lag = Lag(problem, anchor, setup.lag_s, guess)
        if before is not None:
            lag.inherit(before)
        self._ledger.begin()
        self._height_due_ns = {}
        return lag

    # What arrives

    def keep(self, m: Measurement) -> None:
        """Keep a measurement of the window until the IMU has reached its stamp."""
        insort(self._pending, m, key=lambda p: p.stamp_ns)
        self._recent.keep(m)
        if self._persistent.heading is not None and np.isfinite(self._setup.hint(m, self.lag.problem.datum).yaw_rad):
            self._guess.note(m.stamp_ns)
        if len(self._pending) > _PENDING:
            self._ledger.drop(self._pending.pop(), Outcome.REJECTED, "too many measurements wait for the IMU")

    def taken_back(self, sensor: str) -> list[Measurement]:
        """Return the measurements of a sensor that wait for the IMU, and keep them no more."""
        back = [m for m in self._pending if m.sensor == sensor]
        self._pending = [m for m in self._pending if m.sensor != sensor]
        self._recent.forget(back)
        return back

    def keep_imu(self, m: ImuSample, hole: tuple[int, int] | None) -> None:
        """Keep an IMU sample; `hole`: stamps (ns) of the samples before and after it, if it came late."""
        if self._held_out and self._doubt.over(m.stamp_ns):
            if (wrong := self._goes_on_wrong()) is not False:
                self._doubt.go_on()
                self.lag.problem.links.leave_out(*self._doubt.gaps[-1])
            if wrong is not None:
                self._held_out = []
        if self._doubt.leaves_out(m.stamp_ns):
            self._held_out.append(m)
            self._ledger.drop(m, Outcome.REJECTED, WRONG_IMU)
            return
        if hole is not None:
            self._holes.append(hole)
        self._unread.append(m)
        self._recent.keep(m)
        self._ledger.used(m)

    # The window moves on

    def due(self, until_ns: int) -> bool:
        """Whether the next state lies at or before a stamp."""
        return self.lag.problem.timeline.due_ns <= until_ns

    def catch_up(
        self, anchor: Anchor, samples: Sequence[ImuSample], others: Sequence[Measurement], until_ns: int
    ) -> None:
        """Bring a window that has just begun at an anchor up to a stamp, with the data of the start."""
        self._pending = [m for m in others if not self._ledger.has(m)]
        while self._pending and self._pending[0].stamp_ns < self.lag.first_ns:
            self._ledger.drop(self._pending.pop(0), Outcome.REJECTED, "no IMU data at this stamp")
        self._recent.begin(anchor, [*samples, *others])
        self._extend(until_ns)

    def resume(self, anchor: Anchor, before: ImuSample, newest: ImuSample) -> None:
        """Go on from a snapshot: its anchor, the sample at it or before, and the first sample since."""
        self._recent.begin(anchor, [newest], before)
        self._ledger.used(newest)

    def advance(self, until_ns: int) -> None:
        """Make an update: the states that are due up to a stamp, with the measurements that attach to them."""
        self._odometry.begin()
        self._extend(until_ns)

    def _extend(self, until_ns: int) -> None:
        self._read_imu()
        lag, timeline = self.lag, self.lag.problem.timeline
        while timeline.due_ns <= until_ns:
            self._grow(until_ns)
            reached_ns = timeline.stamps_ns[timeline.last]
            self._take_pending(reached_ns)
            lag.judge()
            advance_odometry(self._odometry, lag.problem, lag.newest, reached_ns)
            lag.commit(guessed=self._persistent.heading is not None)
            lag.try_others()
            self._follow_unmodelled()
        self._ledger.enter(lag.gone())

    def _follow_unmodelled(self) -> None:
        """Bring the effect of left-out slow errors and of the IMU's mount up to the newest state; on failure it stays.

        Only the bounds depend on this: a window that is right must not be given up for it.
        """
        lag, unmodelled = self.lag, self._persistent.unmodelled
        if unmodelled is None:
            return
        try:
            lag.follow(unmodelled)
        except Exception as error:  # noqa: BLE001 - whatever went wrong in there, the vessel still needs a pose
            log.warning(
                "online: what slow errors and the IMU's mount do to heading and velocity is not up to date: %s",
                in_one_line(error),
            )
            self._persistent.unmodelled = lag.unmodelled(last=unmodelled.sizes)

    def _read_imu(self) -> None:
        """Hand the samples that have arrived to the window, and integrate anew where some came late."""
        if self._unread:
            stamps = stamps_of(self._unread)
            readings = np.array([np.hstack([m.accel_mps2, m.gyro_radps]) for m in self._unread])
            self.lag.problem.links.extend(stamps, readings)
            self._unread = []
        if self._holes:
            holes, self._holes = self._holes, []
            self.lag.reintegrate(holes)

    def solve_late_imu(self) -> None:
        """Solve again if IMU samples came late since the newest state, which was predicted without them."""
        if self._holes:
            self._read_imu()
            self.lag.commit(guessed=self._persistent.heading is not None)

    def _grow(self, until_ns: int) -> None:
        """Stage the next states: until slow states get a new node, but at most `_AT_ONCE`."""
        timeline, made, closed = self.lag.problem.timeline, 0, False
        while timeline.due_ns <= until_ns and made < _AT_ONCE and not closed:
            closed = self.lag.grow(timeline.due_ns)
            made += 1
            self._take_heights()

    def _take_heights(self) -> None:
        """Take the configured heights that are due at the newest state."""
        timeline = self.lag.problem.timeline
        at_ns = timeline.stamps_ns[timeline.last]
        for name, height_m in self._persistent.heights_m.items():
            stream = self.lag.problem.streams[name]
            if stream.row.synthetic is None or at_ns < self._height_due_ns.get(name, at_ns):
                continue
            for m in stream.row.synthetic(name, stream.config, (at_ns, at_ns + 1), height_m):
                self.lag.take(m)
            self._height_due_ns[name] = at_ns + duration_ns(stream.config.synthetic_every_s)

    def _take_pending(self, reached_ns: int) -> None:
        """Take the measurements whose stamps the states have reached."""
        while self._pending and self._pending[0].stamp_ns <= reached_ns:
            m = self._pending.pop(0)
            if m.stamp_ns < self.lag.first_ns:
                self._ledger.drop(m, Outcome.LATE, "left the lag while it waited")
                continue
            try:
                self.lag.take(m)
                self._persistent.heading_check.note(m, self.lag)
            except Exception as error:  # noqa: BLE001 - the others are still good; nothing of this one is staged yet
                self._ledger.drop(m, Outcome.REJECTED, f"it could not be used: {in_one_line(error)}")
                self._recent.forget([m])

    def keep_anchor(self) -> bool:
        """Keep the newest state as an anchor if one is due, and forget what no rebuild needs; return whether it was."""
        told_ns = self._doubt.told_by(self.lag.first_ns)
        guessed = self._persistent.heading is not None
        since_ns = self.lag.newest.stamp_ns - duration_ns(_TOLD_S) if guessed else None
        if not self._recent.keep_anchor(self.lag, told_ns, since_ns):
            return False
        self._ledger.forget_but({m.seq for m in self._recent})
        return True

    # What is known

    def estimate(self, stamp_ns: int | None = None) -> Estimate:
        """Return the newest state, or its propagation by the IMU to a later stamp (ns)."""
        lag, persistent, newest = self.lag, self._persistent, self.lag.newest
        now = unpropagated(newest, self._odometry)
        if stamp_ns is not None and stamp_ns > newest.stamp_ns:
            self._read_imu()
            now = propagate(lag.problem, newest, self._odometry, stamp_ns)
        heading = persistent.heading
        guess, heading_var = (heading.doubt(now.stamp_ns), heading.var(now.stamp_ns)) if heading else ("", 0.0)
        wrong = f"{self._setup.imu_name} {WRONG_IMU}" if self._doubt.leaves_out(now.stamp_ns) else ""
        clocks = [why_ahead(name) for name, clock in persistent.clocks.items() if clock.ahead]
        doubts = (persistent.heading_check.said, guess, lag.in_doubt(now.stamp_ns), wrong, *clocks)
        return estimate_of(
            now,
            lag,
            self._odometry,
            agreed_ns={**persistent.agreed_ns, **lag.agreed_ns},
            absolute=self._setup.absolute,
            doubt="; ".join(doubt for doubt in doubts if doubt),
            heading_off_rad=persistent.heading_check.off_rad,
            heading_var=heading_var,
            guess=bool(guess),
            unmodelled=persistent.unmodelled,
        )

    def samples(self) -> ImuSeries:
        """Return the samples of the window; while the heading is a guess, older ones are kept."""
        found = self._recent.samples()
        return series_of([m for m in found if m.stamp_ns >= self.lag.first_ns] or found)

    def heading_measured(self) -> bool:
        """Return whether sensors have measured the heading in the window, for as long as a start takes."""
        return self._guess.measured(self.lag.first_ns, self.lag.newest.stamp_ns)

    def since(self, stamp_ns: int) -> list[Measurement]:
        """Return the measurements from a stamp on that can be used again, by stamp; late ones are among them."""
        again = (m for m in self._recent if m.stamp_ns >= stamp_ns and not self._ledger.has(m))
        return sorted(again, key=lambda m: m.stamp_ns)

    def told_by(self, off_rad: float = 0.0) -> tuple[list[Measurement], float]:
        """Return the data by which the motion has told a heading, by stamp, and about the yaw (rad) at their first.

        The yaw is that of the newest state, less the error that the motion tells of it (`off_rad`), carried back by the
        gyroscope, whose bias is not removed. Data whose ledger row is written, or will be with the window, get arrival
        number -1.
        """
        lag = self.lag
        since_ns = min(lag.newest.stamp_ns - duration_ns(_TOLD_S), lag.first_ns)
        came = sorted((m for m in self._recent if m.stamp_ns >= since_ns), key=lambda m: m.stamp_ns)
        first = next((n for n, m in enumerate(came) if not isinstance(m, ImuSample)), len(came))
        came = came[max(first - 1, 0) :]  # with the last sample before the first measurement
        again = {m.seq for m in self.since(lag.first_ns)}
        came = [m if m.seq in again and not isinstance(m, ImuSample) else replace(m, seq=-1) for m in came]
        R = lag.newest.pose.rotation().matrix()
        samples = [m for m in came if isinstance(m, ImuSample) and m.stamp_ns <= lag.newest.stamp_ns]
        rates = np.array([m.gyro_radps for m in samples]).reshape(-1, 3) @ lag.problem.R_body_imu.T @ R[2]
        return came, float(yaw_from_rotation(R)) - off_rad - float(np.trapezoid(rates, stamps_of(samples) * 1e-9))

    def trajectory(self, now: Estimate) -> Trajectory:
        """Return the states of the window, and `now` if it is newer; all get the covariance of `now`.

        That is without what receivers add by contradicting matches (`Lag.contradicted`): scans are matched around this
        trajectory, and a wider search finds more false matches.
        """
        stamps, p, R, v = self.lag.track()
        if now.stamp_ns > stamps[-1]:
            stamps, p = np.append(stamps, now.stamp_ns), np.vstack([p, now.p_world_m])
            R, v = np.concatenate([R, now.R_world_body[None]]), np.vstack([v, now.v_world_mps])
        own = now.cov.copy()
        own[:3, :3] -= self.lag.contradicted
        cov = np.broadcast_to(own, (len(stamps), 6, 6))
        return Trajectory(stamps_ns=stamps, p_world_m=p, R_world_body=R, v_world_mps=v, cov=cov)

    def news(self) -> list[Event]:
        """Return events on what the newest state newly shows: of heading, receivers, jumps, noise and settings."""
        check, at_ns, known = self._persistent.heading_check, self.lag.newest.stamp_ns, self._persistent.heading
        guessed = known is not None and known.doubt(at_ns) != ""
        heading = [Event(check.said)] if check.look(self.lag, guessed=guessed) else []
        if known is not None:
            self._persistent.heading, said = self._guess.follow(known, check, self.lag.first_ns, at_ns)
            heading += said
        was, now = self._persistent.frozen, self.lag.frozen_receivers
        self._persistent.frozen = now
        frozen = [Event(f"{name}: {_FROZEN}") for name in sorted(now - was)]
        thawed = [Event(f"{name}: {_NO_LONGER_FROZEN}", warns=False) for name in sorted(was - now)]
        fits = (
            [Event(f"{self._setup.imu_name}: its samples fit again", warns=False)] if self._doubt.ended(at_ns) else []
        )
        return [
            *heading,
            *frozen,
            *thawed,
            *fits,
            *map(Event, [*self.lag.receiver_warnings(), *self.lag.noisier_warnings(), *self.lag.setting_warnings()]),
        ]

    def snapshot(self, newest: ImuSample) -> Snapshot:
        """Return a snapshot of the last anchor; `newest`: the newest IMU sample."""
        anchor = self._recent.anchors[-1]
        sample = self._recent.sample_at(anchor) or newest
        return self._persistent.snapshot(self._setup, anchor, sample, self.lag.agreed_ns)

    # Rebuild, end

    def rebuild(self, why: str, until_ns: int, misled: float) -> str:
        """Build the window anew.

        It begins at its first anchor, with all its measurements; if that fails, at the last anchor, without later
        measurements.

        Args:
            why: what failed. until_ns: stamp of the newest IMU sample.
            misled: factor by which to enlarge the covariances of the anchors (`ImuNoise.misled`).

        Returns:
            What has happened, in one line.

        Raises:
            SolveError: neither could be solved; the window is still the one that failed.
        """
        failed, recent, ledger = self.lag, self._recent, self._ledger
        ledger.enter(failed.gone())
        if misled > 1.0:
            recent.anchors = deque(anchor.widened(misled) for anchor in recent.anchors)
        anchors = self._anchors()
        for anchor, without in [(anchors[0], False), (anchors[-1], True)] if anchors else []:
            again = self._again_from(anchor)
            mark = ledger.marked()
            try:
                self._rebuild_from(anchor, [] if without else again, until_ns)
            except Exception as error:  # noqa: BLE001 - whatever failed, an older state may do
                why = failure_text(error)
                ledger.back_to(mark)
                continue
            if without:
                for m in again:
                    ledger.drop(m, Outcome.REJECTED, f"left out: {why}")
                recent.forget(again)
                recent.anchors = deque([anchor])
            streams, known = self.lag.problem.streams, failed.problem.streams
            jumps = [j.after_ns for name, s in streams.items() for j in s.jumps if j not in known[name].jumps]
            if jumps:  # later anchors have the slow error from before the jump
                recent.forget_anchors(min(jumps))
            self._settle_rows(failed, again)
            age_s = (self.lag.newest.stamp_ns - anchor.stamp_ns) * 1e-9
            return f"{why}: the window was rebuilt from {age_s:.1f} s before"
        held = {row.seq for row in failed.held()}
        self.lag, self._pending = failed, [m for m in recent.others() if not ledger.has(m) and m.seq not in held]
        raise SolveError(f"{why}, and the window could not be rebuilt from an earlier state")

    def _anchors(self) -> list[Anchor]:
        """Return the anchors in the window, by stamp."""
        return [a for a in self._recent.anchors if a.stamp_ns >= self.lag.first_ns]

    def _again_from(self, anchor: Anchor) -> list[Measurement]:
        """Return the measurements, by stamp, that a window from an anchor on can use again; without IMU samples."""
        return [m for m in self.since(anchor.stamp_ns) if not isinstance(m, ImuSample)]

    def _rebuild_from(self, anchor: Anchor, measurements: Sequence[Measurement], until_ns: int) -> None:
        self._unread, self._holes, self._pending = [], [], list(measurements)
        self.lag = self._built(anchor, self._recent.samples(), before=self.lag)
        self._extend(until_ns)
        self.lag.settle()

    def doubt_imu(self, until_ns: int) -> str | None:
        """If independent sensors deny the estimate together, try the IMU samples since then as a gap.

        See `_imu_doubt`.

        Args:
            until_ns: stamp of the newest IMU sample.

        Returns:
            None: nothing has changed. Else the window was rebuilt, and this is a line for users; empty: users know it.
        """
        denied, replaced, anchors = self.lag.denied, self.lag, self._anchors()
        since_ns = self._doubt.suspected(denied, until_ns) if denied else None
        if since_ns is None or not anchors or anchors[0].stamp_ns >= since_ns:
            return None
        self._ledger.enter(replaced.gone())
        again, said_before = self._again_from(anchors[0]), self._doubt.underway
        take_back = self._begin_trial(since_ns, until_ns)
        try:
            self._rebuild_from(anchors[0], again, until_ns)
            explained = self.lag.explained(denied, min(denied.values()))
        except Exception as error:  # noqa: BLE001 - whatever failed, the window before the trial stands
            log.warning("online: the IMU could not be tried as wrong: %s", in_one_line(error))
            explained = False
        if not explained:
            take_back()
            return None
        self._held_out = []
        self._doubt.forget(self.lag.first_ns)
        self._recent.forget_anchors(since_ns)
        self._settle_rows(replaced, again)
        if said_before:
            return ""
        return (
            f"{self._setup.imu_name}: from {utc_text(since_ns)} on it {WRONG_IMU} ({', '.join(sorted(denied))}): its samples are left out, as in "
            "an IMU gap, until they fit again"
        )

    def _begin_trial(self, since_ns: int, until_ns: int) -> Callable[[], None]:
        """Leave out the IMU samples between two stamps, for a rebuild of the window; return a function to undo it."""
        mark, forget_learned = self._ledger.marked(), self._persistent.learns_in_trial(since_ns)
        lag, pending, height_due_ns, doubt = self.lag, self._pending, self._height_due_ns, deepcopy(self._doubt)
        self._doubt.leave_out(since_ns, until_ns)
        out = self._recent.leave_out(since_ns)

        def take_back() -> None:
            self._ledger.back_to(mark)
            forget_learned()
            self.lag, self._pending, self._height_due_ns, self._doubt = lag, pending, height_due_ns, doubt
            for m in out:
                self._recent.keep(m)

        return take_back

    def _goes_on_wrong(self) -> bool | None:
        """Return whether the samples left out last contradict the states made without them; None: too few to tell."""
        lag, out = self.lag, sorted(self._held_out, key=lambda m: m.stamp_ns)  # late ones are among them
        stamps_ns, _, R, _ = lag.track()
        first, end = np.searchsorted(stamps_ns, [out[0].stamp_ns, out[-1].stamp_ns + 1])
        if end <= first + 1:
            return None
        held = [m for m in out if stamps_ns[first] <= m.stamp_ns <= stamps_ns[end - 1]]
        if len(held) < 2:
            return None
        bias = lag.newest.bias.gyroscope()
        rates = np.array([m.gyro_radps - bias for m in held]) @ lag.problem.R_body_imu.T
        return turns_otherwise(stamps_of(held), rates, R[first].T @ R[end - 1])

    def end(self, reason: str) -> None:
        """Give every measurement its ledger row; `reason`: for measurements that the states have not reached."""
        self._ledger.enter([*self.lag.gone(), *self.lag.held()])
        for m in self._pending:
            self._ledger.drop(m, Outcome.REJECTED, reason)

    def end_but(self, since_ns: int) -> list[Measurement]:
        """Give every measurement its ledger row; return those since a stamp (ns) instead, to start anew from them."""
        self._ledger.enter(self.lag.gone())
        again = self.since(since_ns)
        self._settle_rows(self.lag, again)
        return again

    def _settle_rows(self, replaced: Lag, again: Iterable[Measurement]) -> None:
        """Give the measurements of a replaced window their ledger rows, but not those used again."""
        used_again = {m.seq for m in again}
        self._ledger.enter([row for row in replaced.held() if row.seq not in used_again])
        for m in self._recent.others():
            if not self._ledger.has(m) and m.seq not in used_again:
                self._ledger.drop(m, Outcome.LATE, "older than the oldest state of the rebuilt window")


def failure_text(error: Exception) -> str:
    """Return what failed, in one line."""
    said = in_one_line(error)
    return said if isinstance(error, SolveError) else f"the solver failed ({said})"
