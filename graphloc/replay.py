# SPDX-License-Identifier: Apache-2.0
"""Replay of a recording through the online mode, to show what a vessel would have known at the time.

Messages come in the order in which they arrived. Sightings of tags and matches of scans, which a front-end computes, come when
the IMU has reached their stamp. A match is made around the smoother's own prediction.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphloc.config import VesselConfig
from graphloc.errors import SolveError
from graphloc.estimate import Estimate, Event
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Datum
from graphloc.frontends.source import Bag
from graphloc.gather import Gathering, LiveMatching, Scans, with_busy_warning
from graphloc.judge.warnings import disagreement_warning, joint_rejection_warning
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import ImuSample, Measurement, TagSighting
from graphloc.online import OnlineSmoother
from graphloc.origin import fixes_of, why_no_fix
from graphloc.recording import Recording
from graphloc.solution import Cause, Solution, SolveStats
from graphloc.time import NS_PER_S, stamps_of
from graphloc.trajectory import Trajectory

Status = Callable[[float, float, Estimate | None, str], None]
"""Called with the time in the run, s, its whole length, s, the newest estimate or None, and what the start waits for."""


def silent(_at_s: float, _whole_s: float, _estimate: Estimate | None, _waiting: str) -> None:
    """Ignore the status."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replayed:
    """Result of a replay.

    Attributes:
        recording: the run, with the matches that were made. solution: its poses, each as known at its time.
        estimates: N, in order. update_s: (N,) computing time of each, s.
    """

    recording: Recording
    solution: Solution
    estimates: tuple[Estimate, ...]
    update_s: np.ndarray


def arrivals(recording: Recording, late_ns: Mapping[int, int] | None = None) -> Iterator[Measurement]:
    """Yield IMU samples and measurements in the order in which they arrived.

    What a front-end computed comes when the IMU has reached its stamp. A simulation without a bag has no order of arrival, so the
    order of its stamps is used.

    Args:
        late_ns: by arrival number, delay of a measurement after its stamp, instead of its arrival.
    """
    late_ns = late_ns or {}
    imu = recording.imu
    samples = () if imu is None else zip(imu.stamps_ns, imu.accel_mps2, imu.gyro_radps, imu.seqs, strict=True)
    messages: list[Measurement] = [
        ImuSample(stamp_ns=int(s), sensor=imu.sensor if imu else "", seq=int(q), accel_mps2=a, gyro_radps=w)
        for s, a, w, q in samples
    ]
    made: list[Measurement] = []
    simulated = recording.source.startswith("(")
    for m in recording.measurements:
        if m.seq >= 0:
            gathered = isinstance(m, TagSighting) or recording.topics.get(m.sensor, "").startswith("(")
            (made if m.seq in late_ns or (gathered and not simulated) else messages).append(m)
    messages.sort(key=lambda m: (m.stamp_ns if simulated else 0, m.seq))

    def due_ns(m: Measurement) -> int:
        return m.stamp_ns + late_ns.get(m.seq, 0)

    made.sort(key=lambda m: -due_ns(m))
    for m in messages:
        yield m
        while isinstance(m, ImuSample) and made and due_ns(made[-1]) <= m.stamp_ns:
            yield made.pop()
    yield from reversed(made)


class _Session:
    """A smoother that is fed a recording, and all that it returned.

    Attributes:
        estimates: in order. update_s: computing time of each, s. rows: ledger rows.
        events: each with the IMU's stamp (ns) at that time. first_ns, last_ns: first stamp of the IMU, and the last one so far.
    """

    def __init__(self, smoother: OnlineSmoother, recording: Recording, status: Status) -> None:
        self.smoother, self._status = smoother, status
        self.estimates: list[Estimate] = []
        self.update_s: list[float] = []
        self.rows: list[LedgerRow] = []
        self.events: list[tuple[int, Event]] = []
        imu = recording.imu
        self.first_ns, self.last_ns = (
            (int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])) if imu is not None and len(imu) else (0, 0)
        )
        self._length_s, self._begun_s, self._shown_s = (self.last_ns - self.first_ns) / 1e9, time.monotonic(), -1

    def play(self, arriving: Iterator[Measurement], matchings: Sequence[LiveMatching], speed: float | None) -> None:
        """Feed measurements, and matches of the scans as the IMU reaches them."""
        for m in arriving:
            if not isinstance(m, ImuSample):
                self.feed(m)
                continue
            if speed is not None:
                self._wait_for(m.stamp_ns, speed)
            self.feed(m)
            for matching in matchings:
                for match in matching.due(self.smoother, m.stamp_ns):
                    self.feed(match)
            self._show_waiting(m.stamp_ns)

    def feed(self, m: Measurement) -> None:
        """Feed one measurement."""
        before_s = time.perf_counter()
        estimate = self.smoother.feed(m)
        if estimate is not None:
            self.update_s.append(time.perf_counter() - before_s)
            self.estimates.append(estimate)
            self._status((estimate.stamp_ns - self.first_ns) / 1e9, self._length_s, estimate, "")
        self.rows += self.smoother.rows()
        self.events += [(m.stamp_ns, event) for event in self.smoother.events()]

    def finish(self) -> None:
        """Take the last rows and events of the smoother."""
        self.rows += self.smoother.finish()
        self.events += [(self.last_ns, event) for event in self.smoother.events()]

    def _wait_for(self, stamp_ns: int, speed: float) -> None:
        ahead_s = (stamp_ns - self.first_ns) / 1e9 / speed - (time.monotonic() - self._begun_s)
        if ahead_s > 0.0:
            time.sleep(ahead_s)

    def _show_waiting(self, stamp_ns: int) -> None:
        """Report once per second of the run what the start waits for."""
        second = (stamp_ns - self.first_ns) // NS_PER_S
        if self.smoother.waiting_for and second != self._shown_s:
            self._shown_s = second
            self._status(float(second), self._length_s, None, self.smoother.waiting_for)


def replay(
    recording: Recording,
    config: VesselConfig,
    *,
    scans: Scans | None = None,
    speed: float | None = None,
    lag_s: float = 10.0,
    datum: Datum | None = None,
    late_ns: Mapping[int, int] | None = None,
    begin_ns: int | None = None,
    stoppable: bool = False,
    status: Status = silent,
) -> Replayed:
    """Run a recording through the online mode.

    Args:
        scans: scans to match for the aerial sensors; None: use the matches in the recording.
        speed: times real time; None: as fast as possible. datum: origin of world; None: as `OnlineSmoother` finds it.
        late_ns: as for `arrivals`. begin_ns: from when the times of events count; None: from the first pose.
        stoppable: Ctrl-C ends the replay early, and the result up to then is returned, if it had started.

    Raises:
        SolveError: it never started. InputError: a map or LiDAR that cannot be used.
    """
    smoother = OnlineSmoother(
        config, rows=SENSORS, inertial=INERTIAL, datum=datum, mounts=recording.mounts, lag_s=lag_s
    )
    if scans is not None:
        made = config.of_kind("aerial")
        recording = recording.where(lambda m: m.sensor not in made)
    gathering = Gathering(recording)
    session = _Session(smoother, recording, status)
    interrupted = False
    with ExitStack() as stack:
        pool = None if speed is None else stack.enter_context(ThreadPoolExecutor(1))
        matchings = [
            LiveMatching(name, config, scans, stack.enter_context(Bag(scans.bags)), gathering, pool)
            for name in (config.of_kind("aerial") if scans is not None else ())
            if scans is not None
        ]
        try:
            session.play(arrivals(recording, late_ns), matchings, speed)
        except KeyboardInterrupt:
            if not stoppable:
                raise
            interrupted = True
        for matching in () if interrupted else matchings:
            for match in matching.end():
                session.feed(match)
    waiting = smoother.waiting_for
    session.finish()
    if not session.estimates:
        if interrupted:
            raise KeyboardInterrupt
        lost = recording.lost(config.of_kind("imu"))
        why = f"; {why_no_fix(recording, config)}" if config.datum is None and not fixes_of(recording) else ""
        raise SolveError(
            f"{recording.source}: never started: still waiting for {waiting or 'IMU data'}{why}{_apart(recording, config)}{lost}"
        )
    recording = with_busy_warning(gathering.recording(), config)
    return _result(session, recording, config, begin_ns, interrupted=interrupted)


def _result(
    session: _Session, recording: Recording, config: VesselConfig, begin_ns: int | None, *, interrupted: bool
) -> Replayed:
    estimates, update_s = session.estimates, np.array(session.update_s)
    events = _timed(session.events, estimates, begin_ns)
    if len(update_s) > 1:
        p50, p99, most = (1e3 * float(np.quantile(update_s[1:], q)) for q in (0.5, 0.99, 1.0))
        took = f"{p50:.1f} ms (median), {p99:.0f} ms (99 %), {most:.0f} ms (largest); start {1e3 * update_s[0]:.0f} ms"
        events.append(Event(f"time per update: {took}", warns=False))
    fed = {row.seq for row in session.rows}
    rows = session.rows + [row for row in recording.rows if row.seq not in fed or row.seq < 0]
    if interrupted:
        end_s = (estimates[-1].stamp_ns - session.first_ns) / 1e9
        events.append(Event(f"interrupted at {end_s:.1f} s: the track ends there, the run does not"))
        rows += [
            recording.row_of(m, Outcome.IGNORED, "the replay was interrupted before it")
            for m in arrivals(recording)
            if m.seq >= 0 and m.seq not in fed
        ]
    ledger = Ledger(rows)
    warnings = [event.text for event in events if event.warns]
    warnings += _rejection_warnings(ledger, config, _false_of(recording, config))
    stats = SolveStats(
        passes=0, iterations=len(estimates), states=0, factors=0, cost=0.0, expected_cost=0.0, converged=True,
        warnings=tuple(warnings), events=tuple(event.text for event in events), online=True,
    )  # fmt: skip
    solution = _solution(estimates, session.smoother, ledger, stats)
    return Replayed(recording=recording, solution=solution, estimates=tuple(estimates), update_s=update_s)


def _timed(
    happened: Sequence[tuple[int, Event]], estimates: Sequence[Estimate], begin_ns: int | None = None
) -> list[Event]:
    """Return lines on events with their times, s since `begin_ns` (None: since the first pose).

    For a guessed heading they also say until when, and what would end it.
    """
    if begin_ns is None:
        begin_ns = estimates[0].stamp_ns
    guesses_ns = [stamp_ns for stamp_ns, event in happened if event.heading_guessed]
    timed = []
    for stamp_ns, event in happened:
        line = f"at {max(stamp_ns - begin_ns, 0) / 1e9:.0f} s: {event.text}"
        if event.heading_guessed:
            next_ns = min((at for at in guesses_ns if at > stamp_ns), default=estimates[-1].stamp_ns + 1)
            guessed_ns = (e.stamp_ns for e in estimates if e.reason.cause is Cause.GUESSED_HEADING)
            last_ns = max((at for at in guessed_ns if stamp_ns <= at < next_ns), default=stamp_ns)
            until = (
                "to the end of the run"
                if last_ns >= estimates[-1].stamp_ns
                else f"until {(last_ns - begin_ns) / 1e9:.0f} s"
            )
            line += (
                f"; it stays so {until} ({(last_ns - max(stamp_ns, estimates[0].stamp_ns)) / 1e9:.0f} s) and is not rated good; use a "
                "compass, a dual antenna, wheels or a log (body_velocity), or start.heading_deg"
            )
        timed.append(event._replace(text=line))
    return timed


def _false_of(recording: Recording, config: VesselConfig) -> dict[int, float]:
    """Return the prior probability that each measurement is false, by arrival number, for sensors that have one."""
    rows = {row.kind: row for row in SENSORS}
    found = {}
    for m in recording.measurements:
        sensor = config.sensors.get(m.sensor)
        if sensor is not None and (row := rows.get(sensor.kind)) is not None and row.false is not None:
            found[m.seq] = row.false(m, sensor).probability
    return found


def _rejection_warnings(ledger: Ledger, config: VesselConfig, false_of: Mapping[int, float]) -> Iterator[str]:
    """Yield a line for each sensor whose measurements mostly disagree, or are refused together for long."""
    judged: dict[str, list[LedgerRow]] = {}
    for row in ledger:
        if row.weight is not None:
            judged.setdefault(row.sensor, []).append(row)
    for name, rows in judged.items():
        rows.sort(key=lambda row: row.stamp_ns)
        weights = np.array([row.weight for row in rows])
        yield from disagreement_warning(name, weights)
        if (usual := getattr(config.sensors.get(name), "false_fraction", None)) is not None:
            false = np.array([false_of.get(row.seq, usual) for row in rows])
            yield from joint_rejection_warning(name, stamps_of(rows), weights, false)


def _solution(estimates: Sequence[Estimate], smoother: OnlineSmoother, ledger: Ledger, stats: SolveStats) -> Solution:
    """Return the solution of each pose as known at its time; where a restart went back in time, the newer one counts."""
    kept: list[Estimate] = []
    for estimate in estimates:
        while kept and kept[-1].stamp_ns >= estimate.stamp_ns:
            kept.pop()
        kept.append(estimate)
    assert smoother.datum is not None

    def columns(*names: str) -> dict[str, Any]:
        return {name: np.array([getattr(e, name) for e in kept]) for name in names}

    return Solution(
        datum=smoother.datum,
        trajectory=Trajectory(stamps_ns=stamps_of(kept), **columns("p_world_m", "R_world_body", "v_world_mps", "cov")),
        **columns("v_cov", "accel_bias_mps2", "gyro_bias_radps", "gyro_radps", "gyro_cov"),
        health=tuple(e.health for e in kept),
        health_reason=tuple(e.reason for e in kept),
        since_agreed_s={n: np.array([e.since_agreed_s[n] for e in kept]) for n in kept[-1].since_agreed_s},
        slow={},
        berths=(),
        ledger=ledger,
        antennas_off_m=smoother.antennas_off_m,
        stats=replace(stats, states=len(kept)),
    )


def _apart(recording: Recording, config: VesselConfig) -> str:
    """Return a clause on an IMU whose samples are so far apart that each interval is a gap; empty of any other."""
    if recording.imu is None or len(recording.imu) < 2:
        return ""
    apart_s = float(np.median(np.diff(recording.imu.stamps_ns))) / NS_PER_S
    most_s = config.of_kind("imu")[recording.imu.sensor].max_gap_s
    return f", whose samples come {apart_s:.1f} s apart, more than max_gap_s ({most_s:g} s)" if apart_s > most_s else ""
