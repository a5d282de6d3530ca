# SPDX-License-Identifier: Apache-2.0
"""The online mode when things go wrong: input, the solver, the disk, the process."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc.config import GnssConfig, VesselConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.factors.imu import Links
from graphloc.frames import Geodetic
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, ImuSample, Measurement, PoseFix
from graphloc.online import OnlineSmoother
from graphloc.online._agreement import Agreement
from graphloc.online._lag import Lag
from graphloc.online._live import live_problem
from graphloc.online._repeated_fix import RepeatedFixDetector
from graphloc.online._setup import Setup
from graphloc.online._window import Window
from graphloc.solution import Health
from graphloc.time import stamps_of
from tests.faults import FAULTS, Arrival, Arrivals, Fed, arrivals_of, complaints, copied, feed, finish, flood, numbered
from tests.slowly import slowly

RATE_HZ = 1.25  # of states


def smoother(run: SimulatedRun, **options: Any) -> OnlineSmoother:
    return OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL, **options)


def setup_of(config: VesselConfig) -> Setup:
    return Setup(config=config, rows=SENSORS, inertial=INERTIAL, mounts={}, lag_s=10.0)


@cache
def run_of(seed: int = 0, length_s: float = 26.0, rate_hz: float = RATE_HZ) -> SimulatedRun:
    return _seldom(replace(bl_scenario(1, "drift"), false_fraction=0.1, duration_s=length_s), seed, rate_hz)


def _seldom(scenario: Scenario, seed: int, rate_hz: float = RATE_HZ) -> SimulatedRun:
    """A run whose sensors, and states, come at half their rates or less: a quarter of the time."""
    run = simulate(replace(scenario, imu_hz=50.0, gnss_hz=4.0, compass_hz=2.0), seed)
    return slowly(run, rate_hz)


@cache
def undisturbed() -> Fed:
    """What comes of the first 14 s."""
    base = arrivals_of(run_of())
    return whole(base[: at_s(base, 14.0)])


def whole(arrivals: Arrivals, online: OnlineSmoother | None = None) -> Fed:
    online = online or smoother(run_of())
    return finish(online, feed(online, run_of(), arrivals))


@cache
def _begun(t_s: float, rate_hz: float) -> tuple[OnlineSmoother, Fed]:
    run = run_of(rate_hz=rate_hz)
    online, arrivals = smoother(run), arrivals_of(run)
    return online, feed(online, run, arrivals[: at_s(arrivals, t_s)])


def begun(t_s: float, rate_hz: float = RATE_HZ) -> tuple[OnlineSmoother, Fed]:
    """A smoother that was fed the first seconds of the run, and what came of it: most of the time is the start's."""
    online, fed = _begun(t_s, rate_hz)
    return copied(online), fed.copied()


def at_s(arrivals: Arrivals, t_s: float) -> int:
    """Index of the first arrival from a time on."""
    return next(n for n, a in enumerate(arrivals) if a.true_ns >= arrivals[0].true_ns + t_s * 1e9)


@cache
def after_12_s() -> Lag:
    """The window after 12 s of the run; not to be changed."""
    online, _ = begun(12.0)
    assert online._tracking is not None  # noqa: SLF001
    return online._tracking.lag  # noqa: SLF001


def test_a_copy_goes_on_as_the_smoother_itself() -> None:
    """So that tests can share a beginning: to the last bit, and neither changes the other."""
    every = arrivals_of(run_of())
    base, n = every[: at_s(every, 14.0)], at_s(every, 10.0)
    first, fed = begun(10.0)
    finish(first, feed(first, run_of(), base[n:], fed))
    second, again = begun(10.0)
    finish(second, feed(second, run_of(), base[n:], again))
    for one in (fed, again):
        assert one.rows == undisturbed().rows
        assert one.events == undisturbed().events
        for a, b in zip(one.estimates, undisturbed().estimates, strict=True):
            assert a.stamp_ns == b.stamp_ns
            for name in ("p_world_m", "R_world_body", "cov", "p_odom_m"):
                assert np.array_equal(getattr(a, name), getattr(b, name))


QUICK = ["backward stamps", "jumping stamps", "zero stamps", "repeated", "clock back", "latitude and longitude swapped",
         "GNSS jump", "absurd GNSS covariance", "wrong headings", "strangers", "flood", "accelerometer in g"]  # fmt: skip


@pytest.mark.parametrize("name", QUICK)
def test_a_fault_is_survived(name: str) -> None:
    """All faults, and many of each, are in the benchmark; here one of most kinds."""
    base = arrivals_of(run_of())
    begin = base[0].true_ns + 9_000_000_000
    fault = partial(flood, times=500) if name == "flood" else FAULTS[name]
    broken, until = fault(base, begin, np.random.default_rng(5))
    n, (online, fed) = at_s(base, 9.0), begun(9.0)
    assert [a.m.stamp_ns for a in broken[:n]] == [a.m.stamp_ns for a in base[:n]]
    rest = numbered([a for a in broken[n:] if a.true_ns < until + 8_000_000_000], len(base))
    finish(online, feed(online, run_of(), rest, fed))
    arrivals = [*base[:n], *rest]
    assert complaints(arrivals, fed) == []
    # A clock that jumps costs a new start: 5 s of IMU data, and up to half a second until it is tried.
    assert fed.recovered_s(until) < 6.0
    assert fed.errors_m[-1] < 1.5


def test_wrong_units_are_reported_and_waited_out() -> None:
    base = arrivals_of(run_of())
    in_g = [
        replace(a, m=replace(a.m, accel_mps2=a.m.accel_mps2 / 9.81)) if isinstance(a.m, ImuSample) else a for a in base
    ]  # fmt: skip
    online = smoother(run_of())
    fed = feed(online, run_of(), in_g[:800])
    assert "wrong unit" in online.waiting_for
    finish(online, fed)
    assert complaints(in_g[:800], fed) == []
    assert not fed.estimates


def test_restarts_after_a_long_imu_silence() -> None:
    """20 s of silence are bridged, more are not: 21 s."""
    run = _seldom(replace(bl_scenario(2, "clean"), duration_s=38.0), 3)
    base = arrivals_of(run)
    arrivals = [*base[: at_s(base, 7.0)], *base[at_s(base, 28.5) :]]
    online = smoother(run)
    fed = finish(online, feed(online, run, arrivals))
    assert complaints(arrivals, fed) == []
    assert [e for e in fed.events if "silent for 21.5 s: restarts" in e]
    assert len([e for e in fed.events if e.startswith("started")]) == 2
    assert fed.errors_m[-1] < 1.0
    # Odometry goes on from where it was: no jump between the two pieces but the way of the new start's data.
    stamps = stamps_of(fed.estimates)
    n = int(np.argmax(np.diff(stamps)))
    step = np.linalg.norm(fed.estimates[n + 1].p_odom_m - fed.estimates[n].p_odom_m)
    assert step < 6.0 * (np.linalg.norm(fed.estimates[n].v_world_mps) + 1.0)


def test_what_comes_twice_counts_once() -> None:
    """A bridge that sends again, at once or a second later: four fixes of a stamp had made bounds half as wide."""
    base = arrivals_of(run_of())
    base = base[: at_s(base, 14.0)]
    rows = itertools.count(10**6)
    often = []
    for k, arrival in enumerate(base):
        often.append(arrival)
        if not isinstance(arrival.m, ImuSample):
            often.append(Arrival(arrival.true_ns, replace(arrival.m, seq=next(rows))))
        if k >= 50 and not isinstance(base[k - 50].m, ImuSample):
            often.append(Arrival(arrival.true_ns, replace(base[k - 50].m, seq=next(rows))))
    online = smoother(run_of())
    fed = finish(online, feed(online, run_of(), often))
    for a, b in zip(fed.estimates, undisturbed().estimates, strict=True):
        np.testing.assert_array_equal(a.cov, b.cov)
    repeated = [row for row in fed.rows if row.seq >= 10**6]
    assert len(repeated) == next(rows) - 10**6
    assert all(row.outcome is Outcome.REJECTED and row.reason.startswith("repeated message") for row in repeated)


def test_rates_in_degrees_are_waited_out() -> None:
    """To solve a start with them would take a minute, and leave nothing: it begins when the rates are right."""
    base, online = arrivals_of(run_of()), smoother(run_of())
    for a in base[: at_s(base, 7.0)]:
        m = replace(a.m, gyro_radps=40.0 * a.m.gyro_radps) if isinstance(a.m, ImuSample) else a.m
        assert online.feed(m) is None
    assert re.fullmatch(
        r"IMU data that a vessel can have: it rolls and pitches by \d+ deg within 5 s: rates in deg/s\?",
        online.waiting_for,
    )
    assert online.events() == []


def test_a_recording_that_is_played_again_is_a_new_run() -> None:
    """Its messages have come before: they were rejected as repeated, and the second round waited for a position for good."""
    base = arrivals_of(run_of())
    base = base[: at_s(base, 9.0)]
    online = smoother(run_of())
    rounds = []
    for _ in range(2):
        for a in base:
            online.feed(a.m)
        rounds.append(sum(e.text.startswith("started") for e in online.events()))
        assert online.waiting_for == ""
    assert rounds == [1, 1]


def test_fixes_in_radians_are_waited_out() -> None:
    """They lie a thousand kilometres from the matches: to solve a start with both blocked `feed` for two minutes, and failed."""
    run = run_of()
    base, online = arrivals_of(run), smoother(run)
    assert run.config.datum is not None
    for a in base[: at_s(base, 7.0)]:
        m = a.m
        if isinstance(m, GnssPosition):
            lat, lon, height = m.position
            m = replace(m, position=Geodetic(np.radians(lat), np.radians(lon), height))
        assert online.feed(m) is None
    assert re.search(r"its fixes lie \d+ km from `datum:`, near latitude 1\.0\d+", online.waiting_for)
    assert online.events() == []


def test_a_snapshot_without_a_name_does_not_keep_from_starting() -> None:
    """As of `snapshot=""`, a setting that a program has not been given: the start failed, over and over."""
    base, online = arrivals_of(run_of()), smoother(run_of(), snapshot=Path(""))
    for a in base[: at_s(base, 7.0)]:
        online.feed(a.m)
    assert online.waiting_for == ""
    texts = [e.text for e in online.events()]
    assert sum("the snapshot cannot be written (ValueError" in text for text in texts) == 1
    assert not [text for text in texts if "failed" in text]


@pytest.mark.parametrize("late", [lambda ns: ns // 10**6, lambda ns: ns - 15 * 10**9], ids=["ms", "15 s late"])
def test_stamps_that_are_too_old_for_any_use_are_said_to_be_of_another_clock(late: Callable[[int], int]) -> None:
    """In ms all fixes are of 1970: none is used, and the ledger's reasons do not tell why."""
    base, online = arrivals_of(run_of()), smoother(run_of())
    for a in base[: at_s(base, 7.0)]:
        online.feed(replace(a.m, stamp_ns=late(a.m.stamp_ns)) if isinstance(a.m, GnssPosition) else a.m)
    said = [e for e in online.events() if "behind the IMU's: of another clock?" in e.text]
    assert [(e.text.split(":")[0], e.warns) for e in said] == [("gnss", True)]


@pytest.mark.parametrize(("late_s", "good"), [(-18, False), (15, True)], ids=["GPS time", "too old for any use"])
def test_no_pose_is_good_by_measurements_of_the_future(late_s: int, good: bool) -> None:
    """A compass that is 18 s ahead turns the vessel 18 s later. One that is 15 s behind is not used at all."""
    base, online = arrivals_of(run_of()), smoother(run_of())
    came = base[: at_s(base, 20.0)]
    put = [replace(a.m, stamp_ns=a.m.stamp_ns - late_s * 10**9) if a.m.sensor == "compass" else a.m for a in came]
    last = [found for m in put if (found := online.feed(m)) is not None][-1]
    assert (str(last.health) == "good") is good
    assert ("the stamps of compass are of a clock ahead of the IMU's" in str(last.reason)) is not good


def test_a_dead_imu_is_said_once_a_silence() -> None:
    """The newest pose stays as it is, good or not, so nothing else would show it."""
    online, _ = begun(10.0)
    base = arrivals_of(run_of())
    others = [a for a in base[at_s(base, 10.0) : at_s(base, 16.0)] if not isinstance(a.m, ImuSample)]
    first_ns = {sensor: next(a.m.stamp_ns for a in others if a.m.sensor == sensor) for sensor in ("gnss", "compass")}
    told = []
    for a in others:
        assert online.feed(a.m) is None
        told += [(a.m, e) for e in online.events()]
    ((m, event),) = told
    gone_on_s = (m.stamp_ns - first_ns[m.sensor]) / 1e9
    assert 3.0 <= gone_on_s < 3.5
    assert event.warns
    assert (
        event.text
        == f"imu: no sample has come while {m.sensor} went on for {gone_on_s:.1f} s: no new pose until one comes"
    )

    back = [a.m for a in base[at_s(base, 16.0) : at_s(base, 16.5)]]
    again = [a.m for a in base[at_s(base, 16.5) : at_s(base, 20.5)] if not isinstance(a.m, ImuSample)]
    for m in (*back, *again):
        online.feed(m)
    assert sum("no new pose until one comes" in e.text for e in online.events()) == 1


def test_a_single_wrong_stamp_tells_no_dead_imu() -> None:
    online, _ = begun(10.0)
    base = arrivals_of(run_of())
    samples = [a.m for a in base[at_s(base, 10.0) : at_s(base, 11.0)] if isinstance(a.m, ImuSample)]
    heading = next(a.m for a in base[at_s(base, 10.0) :] if a.m.sensor == "compass")
    for k, m in enumerate(samples):
        online.feed(m)
        if k == 20:
            online.feed(heading)
            online.feed(replace(heading, seq=10**6, stamp_ns=heading.stamp_ns + 3600 * 10**9))
    assert not [e for e in online.events() if "no new pose" in e.text]


def test_what_a_sensor_had_stored_tells_no_dead_imu() -> None:
    """Six seconds of messages that come at once, after the IMU's samples; and a clock that is 18 s ahead."""
    base = arrivals_of(run_of())
    stored = base[at_s(base, 10.0) : at_s(base, 16.0)]
    imu = [a.m for a in stored if isinstance(a.m, ImuSample)]
    others = [a.m for a in stored if not isinstance(a.m, ImuSample)]
    ahead = [replace(a.m, stamp_ns=a.m.stamp_ns + (0 if isinstance(a.m, ImuSample) else 18 * 10**9)) for a in stored]
    for messages in ((*imu, *others), ahead):
        online, _ = begun(10.0)
        for m in messages:
            online.feed(m)
        assert not [e for e in online.events() if "no new pose" in e.text]


def test_a_start_that_fails_keeps_the_ledger_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lag cannot be built: what came for it has its rows, and the next start is taken, with the heading that is configured."""
    heading_deg = float(90.0 - np.degrees(run_of().truth.yaw_rad[0]))
    base, config = arrivals_of(run_of()), run_of().config.with_start_heading(heading_deg)
    online = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL)
    base = base[: at_s(base, 13.0)]
    failures, known = [RuntimeError("planted")], list[float | None]()

    def fails_once(*arguments: Any, **named: Any) -> Any:
        known.append(online._setup.config.start.heading_deg)  # noqa: SLF001
        if failures:
            raise failures.pop()
        return live_problem(*arguments, **named)

    monkeypatch.setattr("graphloc.online._tracking.live_problem", fails_once)
    fed = whole(base, online)
    assert complaints(base, fed) == []
    assert [e for e in fed.events if e == "the start failed (RuntimeError: planted): restarts"]
    assert [e for e in fed.events if e.startswith("started")]
    assert known[:2] == [heading_deg, heading_deg]


@pytest.mark.parametrize("kept", [True, False])
def test_agreement_with_a_rejected_choice_does_not_count(kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """It put off the new start of an estimate 35 m aside by a minute: the right matches agreed, but only while they were tried."""
    online, _ = begun(12.0)
    assert online._tracking is not None  # noqa: SLF001
    judge, agreement = online._tracking.lag._judge, online._tracking.lag._agreement  # noqa: SLF001
    stream = online._tracking.lag.problem.streams["matcher"]  # noqa: SLF001
    own = judge._group(stream)  # noqa: SLF001
    agreement.back_to(Agreement(online._tracking.lag.problem.timeline).marked())  # noqa: SLF001
    for entry in own:
        agreement.note(stream, entry.measurement, None)
    refused = agreement.marked()
    costs = iter([1.0, 0.0] if kept else [0.0, 1.0])
    monkeypatch.setattr(judge, "_cost", lambda *_: next(costs))
    judge._try(stream, own, [e.verdict for e in own])  # noqa: SLF001
    assert (agreement.marked() == refused) is not kept
    assert ("matcher" in agreement.agreed_ns) is kept


@pytest.mark.parametrize(("error_m", "denies", "lost_after_s"), [(3.0, False, 90), (20.0, False, 60), (20.0, True, 15)])
def test_a_receiver_that_is_far_off_is_waited_for(error_m: float, denies: bool, lost_after_s: int) -> None:
    """It agrees by an error that it should not have: a jump, that ends. Where matches deny the estimate besides, it is lost."""
    lag = after_12_s()
    fix, match = (lag.problem.streams[name] for name in ("gnss", "matcher"))
    a_fix, a_match = (lag._judge._group(stream)[-1].measurement for stream in (fix, match))  # noqa: SLF001
    verdict = lag._judge._group(match)[-1].verdict  # noqa: SLF001
    agrees = replace(verdict, weight=1.0, at=replace(verdict.at, slow_value=np.array([error_m, 0.0, 0.0])))
    agreement, begin_ns = Agreement(lag.problem.timeline), lag.newest.stamp_ns
    for _ in range(5):  # what denied it before it agreed again is past
        agreement.note(match, replace(a_match, stamp_ns=begin_ns), None)
    agreement.note(fix, replace(a_fix, stamp_ns=begin_ns), replace(agrees, at=verdict.at))
    lost_s = []
    for t_s in range(90):
        now_ns = begin_ns + t_s * 1_000_000_000
        agreement.note(fix, replace(a_fix, stamp_ns=now_ns), agrees)
        if denies or t_s in (5, 6):
            agreement.note(match, replace(a_match, stamp_ns=now_ns), None)
        if agreement.lost_s(now_ns):
            lost_s.append(t_s)
    assert [*lost_s, 90][0] == pytest.approx(lost_after_s, abs=1)


@pytest.mark.parametrize(
    ("usual_s", "error_m", "lost_after_s"), [(20, 8.0, 60), (100, 8.0, 100), (400, 8.0, 200), (100, 5.0, 300)]
)
def test_a_jump_that_lasts_longer_than_the_level_before_it_is_the_right_level(
    usual_s: int, error_m: float, lost_after_s: int
) -> None:
    """A run that begins in a jump takes its end for one: the level that is held longer is the right one. 3 sigmas are 6 m."""
    lag = after_12_s()
    fix = lag.problem.streams["gnss"]
    entry = lag._judge._group(fix)[-1]  # noqa: SLF001
    agreement, begin_ns = Agreement(lag.problem.timeline), lag.newest.stamp_ns

    def agrees(t_s: int, off_m: float) -> None:
        at = replace(entry.verdict.at, slow_value=np.array([0.0, off_m, 40.0]))  # above another zero
        m = replace(entry.measurement, stamp_ns=begin_ns + t_s * 1_000_000_000)
        agreement.note(fix, m, replace(entry.verdict, weight=1.0, at=at))

    for t_s in range(usual_s):
        agrees(t_s, 1.0)
    lost_s = []
    for t_s in range(usual_s, usual_s + 300):
        agrees(t_s, error_m)
        if agreement.lost_s(begin_ns + t_s * 1_000_000_000):
            lost_s.append(t_s - usual_s)
    assert [*lost_s, 300][0] == pytest.approx(lost_after_s, abs=1)


@pytest.mark.parametrize(("silent_s", "held_s"), [(15, 135), (60, 20)])
def test_a_level_that_dead_reckoning_may_have_bent_to_is_held_since_the_outage(silent_s: int, held_s: int) -> None:
    """Usual for 100 s, silent, usual for 20 s, then a jump for 10 s: the longer it is held, the surer it is that this is no end of one."""
    lag = after_12_s()
    fix = lag.problem.streams["gnss"]
    entry = lag._judge._group(fix)[-1]  # noqa: SLF001
    agreement = Agreement(lag.problem.timeline)

    def agrees(from_s: int, until_s: int, off_m: float) -> int:
        at = replace(entry.verdict.at, slow_value=np.array([off_m, 0.0, 0.0]))
        stamps_ns = [lag.newest.stamp_ns + t_s * 1_000_000_000 for t_s in range(from_s, until_s + 1)]
        for stamp_ns in stamps_ns:
            agreement.note(
                fix, replace(entry.measurement, stamp_ns=stamp_ns), replace(entry.verdict, weight=1.0, at=at)
            )
        return stamps_ns[-1]

    back_s = 100 + silent_s
    agrees(0, 100, 0.5)
    agrees(back_s, back_s + 20, 0.5)
    now_ns = agrees(back_s + 21, back_s + 31, 15.0)
    assert agreement.wrong_level(now_ns) == pytest.approx(1.0 / (1.0 + np.exp((held_s - 10) / 30.0)))


def test_an_older_fix_that_is_judged_again_does_not_bring_back_a_jump_that_has_ended() -> None:
    """Each is judged again a second and four seconds later: after what has come meanwhile."""
    lag = after_12_s()
    fix = lag.problem.streams["gnss"]
    entry, agreement = lag._judge._group(fix)[-1], Agreement(lag.problem.timeline)  # noqa: SLF001
    for t_s, off_m, unlikely in ((0, 7.0, ["gnss"]), (1, 0.0, []), (0, 7.0, []), (2, 5.0, [])):
        at = replace(entry.verdict.at, slow_value=np.array([off_m, 0.0, 0.0]))
        m = replace(entry.measurement, stamp_ns=lag.newest.stamp_ns + t_s * 1_000_000_000)
        agreement.note(fix, m, replace(entry.verdict, weight=1.0, at=at))
        assert agreement.unlikely(str) == unlikely


def test_matches_that_contradict_the_receiver_from_the_start_leave_both_open() -> None:
    """An image may be out of date: the matches agree with each other, 7 m (3.5 sigmas of its slow error) from the receiver."""

    def moved(m: Measurement) -> Measurement:
        if not isinstance(m, PoseFix):
            return m
        away_m = np.eye(len(m.axes))[0] * 7.0
        return replace(m, news=0.5, modes=tuple(replace(mode, value=mode.value + away_m) for mode in m.modes))

    online = smoother(run_of())
    fed = feed(online, run_of(), [Arrival(a.true_ns, moved(a.m)) for a in arrivals_of(run_of())])
    assert online._tracking is not None  # noqa: SLF001
    told = online._tracking.estimate()  # noqa: SLF001
    sought = online._tracking.trajectory(told).cov  # noqa: SLF001
    assert sought is not None
    assert np.sqrt(np.trace(told.cov[:2, :2])) > 3.0
    # Across as well: the receiver that may be right errs by 2 m.
    assert np.linalg.eigvalsh(told.cov[:2, :2])[0] > 0.5 * 2.0**2
    # A wider search around that would find more matches that are false.
    assert np.sqrt(np.trace(sought[-1, :2, :2])) < 1.0
    off = np.array(fed.errors_m) > 3.0
    assert off[-50:].all()  # the matches are believed, as there is no saying
    held = np.array([e.bound_95_m for e in fed.estimates]) >= fed.errors_m
    assert held[off].mean() > 0.95
    assert not any(e.health is Health.GOOD for e, astray in zip(fed.estimates, off, strict=True) if astray)


@pytest.mark.parametrize(("off_m", "doubted"), [([1.0] * 17 + [7.0], False), ([1.0] * 5 + [7.0], True), ([7.0, 5.0], True),
                                                ([7.0] + [5.0] * 20, True), ([7.0] + [1.0] * 17, False)])  # fmt: skip
def test_a_receiver_that_agreed_with_matches_for_long_is_wrong_where_it_contradicts_them(off_m: list[float], doubted: bool) -> None:  # fmt: skip
    """By a second; 15 s within two sigmas of 2 m confirm that the matches are right."""
    lag = after_12_s()
    fix, match = lag.problem.streams["gnss"], lag.problem.streams["matcher"]
    seen, entry = (lag._judge._group(s)[-1] for s in (match, fix))  # noqa: SLF001
    assert isinstance(seen.measurement, PoseFix)
    agreement = Agreement(lag.problem.timeline)
    for t_s, one_m in enumerate(off_m):
        stamp_ns = lag.newest.stamp_ns + t_s * 1_000_000_000
        agreement.note(match, replace(seen.measurement, stamp_ns=stamp_ns, news=0.1), replace(seen.verdict, weight=1.0))
        at = replace(entry.verdict.at, slow_value=np.array([one_m, 0.0, 0.0]))
        agreement.note(fix, replace(entry.measurement, stamp_ns=stamp_ns), replace(entry.verdict, weight=1.0, at=at))
    assert agreement.doubted(str) == ["gnss"] * doubted


def test_matches_that_one_receiver_confirmed_are_not_in_doubt_beside_another() -> None:
    """Nor by a trial choice that is given up."""
    lag = after_12_s()
    fix, match = lag.problem.streams["gnss"], lag.problem.streams["matcher"]
    seen, entry = (lag._judge._group(s)[-1] for s in (match, fix))  # noqa: SLF001
    assert isinstance(seen.measurement, PoseFix)
    shown = replace(seen.measurement, news=0.1)

    def beside(off_m: list[tuple[str, float]], *, given_up: bool = False) -> list[str]:
        agreement = Agreement(lag.problem.timeline)
        for t_s, (name, one_m) in enumerate(off_m):
            stamp_ns = lag.newest.stamp_ns + t_s * 1_000_000_000
            mark = agreement.marked()
            agreement.note(match, replace(shown, stamp_ns=stamp_ns), replace(seen.verdict, weight=1.0))
            if given_up:
                agreement.back_to(mark)
            at = replace(entry.verdict.at, slow_value=np.array([one_m, 0.0, 0.0]))
            of = SimpleNamespace(name=name, row=fix.row, slow=fix.slow, config=fix.config)
            agreement.note(of, replace(entry.measurement, stamp_ns=stamp_ns), replace(entry.verdict, weight=1.0, at=at))  # type: ignore[arg-type]
        return agreement.doubted(str)

    assert beside([("a", 1.0)] * 17 + [("b", 7.0)]) == []
    assert beside([("b", 7.0)] + [("a", 1.0)] * 17 + [("b", 7.0)]) == []
    assert beside([("a", 1.0)] * 5 + [("b", 7.0)]) == ["b"]
    assert beside([("b", 7.0)], given_up=True) == []


def test_a_rebuild_does_not_begin_the_wait_for_the_end_of_a_jump_anew() -> None:
    """The rebuilt window notes what is in it; a level that has been held for longer would seem to begin there."""
    lag = after_12_s()
    fix = lag.problem.streams["gnss"]
    entry = lag._judge._group(fix)[-1]  # noqa: SLF001
    begin_ns = lag.first_ns
    far_off = replace(entry.verdict, weight=1.0, at=replace(entry.verdict.at, slow_value=np.array([20.0, 0.0, 0.0])))
    before, after = Agreement(lag.problem.timeline), Agreement(lag.problem.timeline)
    jumped_ns, now_ns = begin_ns - 50_000_000_000, begin_ns + 12_000_000_000
    before.note(fix, replace(entry.measurement, stamp_ns=jumped_ns), far_off)
    after.inherit(before)
    for stamp_ns in (begin_ns, now_ns):
        after.note(fix, replace(entry.measurement, stamp_ns=stamp_ns), far_off)
    assert after.lost_s(now_ns) == pytest.approx(62.0)
    again = Agreement(lag.problem.timeline)
    before.forget_refused()
    before.note(fix, replace(entry.measurement, stamp_ns=begin_ns + 1_000_000_000), far_off)
    again.inherit(before)  # that is within the window, which notes it anew
    assert not again.wrong_level(now_ns)


def test_a_sensor_found_frozen_does_not_hasten_a_restart() -> None:
    """A receiver that is far off is waited for, whatever a frozen one measured before it was detected."""
    lag = after_12_s()
    fix, match = (lag.problem.streams[name] for name in ("gnss", "matcher"))
    a_fix = lag._judge._group(fix)[-1].measurement  # noqa: SLF001
    verdict = lag._judge._group(match)[-1].verdict  # noqa: SLF001
    far_off = replace(verdict, weight=1.0, at=replace(verdict.at, slow_value=np.array([20.0, 0.0, 0.0])))
    agreement, begin_ns = Agreement(lag.problem.timeline), lag.newest.stamp_ns
    for _ in range(5):
        agreement.note(match, replace(a_fix, stamp_ns=begin_ns, sensor="matcher"), None)
    agreement.forget_refused()
    for t_s in range(50):
        agreement.note(fix, replace(a_fix, stamp_ns=begin_ns + t_s * 1_000_000_000), far_off)
    assert not agreement.lost_s(begin_ns + 50 * 1_000_000_000)


@pytest.mark.parametrize("widened", [True, False])
def test_a_measurement_let_in_by_a_wide_kernel_agrees_only_when_judged_again(
    widened: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fix 300 m off, let in once a second as the prediction was unsure, put off the new start of a lost estimate."""
    base, (online, _) = arrivals_of(run_of()), begun(12.0)
    now, soon, later = (at_s(base, t_s) for t_s in (12.0, 12.8, 14.5))
    assert online._tracking is not None  # noqa: SLF001
    judge, agreement = online._tracking.lag._judge, online._tracking.lag._agreement  # noqa: SLF001
    by_kernel = judge._by_kernel  # noqa: SLF001

    def lets_in(*arguments: Any, fresh: bool) -> Any:
        verdict, _ = by_kernel(*arguments, fresh=fresh)
        return replace(verdict, weight=1.0), widened and fresh

    monkeypatch.setattr(judge, "_by_kernel", lets_in)
    monkeypatch.setattr(judge, "_rejudge", lambda *_: None)
    agreement.back_to(Agreement(online._tracking.lag.problem.timeline).marked())  # noqa: SLF001
    feed(online, run_of(), base[now:soon])
    assert ("gnss" in agreement.agreed_ns) is not widened
    monkeypatch.undo()
    feed(online, run_of(), base[soon:later])
    assert "gnss" in agreement.agreed_ns


def test_a_lost_estimate_restarts() -> None:
    """Its state put 300 m aside, with confidence: all sensors disagree, and after some seconds they are believed."""
    run = run_of(length_s=30.0)
    base, online = arrivals_of(run), smoother(run)
    n = at_s(base, 8.0)
    fed = feed(online, run, base[:n])
    assert online._tracking is not None  # noqa: SLF001
    recent = online._tracking._recent  # noqa: SLF001
    anchor = recent.anchors[-1]
    pose = type(anchor.pose)(anchor.pose.rotation(), anchor.pose.translation() + np.array([300.0, 0.0, 0.0]))
    known = {name: replace(b, cov=b.cov * 1e-4) for name, b in anchor.slow.items()}
    since = [m for m in recent if m.stamp_ns >= anchor.stamp_ns]
    recent.begin(replace(anchor, pose=pose, cov=anchor.cov * 1e-4, slow=known), since)
    online._rebuild("planted")  # noqa: SLF001
    feed(online, run, base[n:], fed)
    assert complaints(base, finish(online, fed)) == []
    assert max(fed.errors_m) > 100.0
    assert (
        fed.recovered_s(base[n].true_ns) < 20.0
    )  # 15 s of disagreement, and a start that waits for matches at 1 Hz to agree


def test_a_receiver_alone_that_jumps_is_not_followed() -> None:
    """20 m for 12 s, and nothing to tell it from motion but the IMU: such a jump ends, and till then it is not followed.

    For an instant, two seconds into it, the newest state may go a part of the way, in its bounds.
    """
    run = _seldom(replace(bl_scenario(1, "clean"), duration_s=30.0), 1, rate_hz=2.5)
    base = [a for a in arrivals_of(run) if not isinstance(a.m, PoseFix)]
    begin, end = base[at_s(base, 12.0)].true_ns, base[at_s(base, 24.0)].true_ns
    jumped = [
        replace(a, m=replace(a.m, position=a.m.position._replace(latitude_deg=a.m.position.latitude_deg + 20.0 / 111e3)))
        if isinstance(a.m, GnssPosition) and begin < a.true_ns < end
        else a
        for a in base
    ]  # fmt: skip
    fed = finish(online := smoother(run), feed(online, run, jumped))
    assert max(fed.errors_m) < 10.0
    off_m, t_s = np.array(fed.errors_m), (np.array(fed.true_ns) - begin) * 1e-9
    sigma_m = np.sqrt([np.trace(e.cov[:2, :2]) for e in fed.estimates])
    assert (off_m < 3.5 * sigma_m).all()
    assert off_m[t_s > 3.0].max() < 3.0
    assert not [e for e in fed.events if "restarts" in e]
    assert max(np.linalg.norm(e.v_world_mps) for e in fed.estimates) < 8.0  # the vessel goes 4 m/s
    assert fed.recovered_s(end) < 5.0


@cache
def jumping(
    hz: float, sigma_m: float, slow_m: float, jump_m: float, begin_s: float, lasts_s: float = 9.0
) -> tuple[SimulatedRun, Arrivals, int, int]:
    """A receiver alone, with IMU and compass, that jumps: the run, what arrives, and when the jump begins and ends."""
    scenario = replace(bl_scenario(1, "clean"), duration_s=lasts_s + 14.0, path="loops", imu_hz=50.0, compass_hz=2.0, gnss_hz=hz, gnss_sigma_m=sigma_m)  # fmt: skip
    run = slowly(simulate(scenario, 1), max(hz, 2.5))
    gnss = run.config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    slow_error = gnss.slow_error.model_copy(update={"horizontal_sigma_m": slow_m, "vertical_sigma_m": 2.0 * slow_m})
    alone = {
        "imu": run.config.sensors["imu"],
        "gnss": gnss.model_copy(update={"slow_error": slow_error, "stamp_sigma_s": 0.05}),
        "compass": run.config.sensors["compass"],
    }
    run = replace(run, config=run.config.model_copy(update={"sensors": alone}))
    base = [a for a in arrivals_of(run) if a.m.sensor in alone]
    begin, end = base[at_s(base, begin_s)].true_ns, base[at_s(base, begin_s + lasts_s)].true_ns
    jumped = [
        replace(a, m=replace(a.m, position=a.m.position._replace(latitude_deg=a.m.position.latitude_deg + jump_m / 111e3)))
        if isinstance(a.m, GnssPosition) and begin < a.true_ns < end
        else a
        for a in base
    ]  # fmt: skip
    return run, jumped, begin, end


@pytest.mark.parametrize(
    ("hz", "sigma_m", "slow_m", "jump_m", "begin_s", "bound_m"),
    [
        (5.0, 0.02, 0.03, 10.0, 8.6, 0.5),  # early and late in the slow node of a second
        (5.0, 0.02, 0.03, 10.0, 9.1, 0.5),
        (5.0, 0.45, 2.0, 7.0, 9.1, 2.0),  # hidden in the noise of single fixes
        (0.55, 0.1, 2.0, 7.0, 9.1, 2.0),  # and in what a vessel may go between two
    ],
)
def test_a_receiver_alone_whose_jump_the_imu_shows(
    hz: float, sigma_m: float, slow_m: float, jump_m: float, begin_s: float, bound_m: float
) -> None:
    """It is followed at neither end."""
    case = (hz, sigma_m, slow_m, jump_m, begin_s)
    run, jumped, _, _ = jumping(*case)
    online, fed, n = begun_alone(jumping, case, 0.6)
    finish(online, feed(online, run, jumped[n:], fed))
    assert len([e for e in fed.events if "position jump" in e and "rebuilt" in e]) == 2
    assert max(fed.errors_m) < bound_m


@cache
def hung(hz: float, lasts_s: float) -> tuple[SimulatedRun, Arrivals, int, int]:
    """As `jumping`, but the receiver repeats one fix instead."""
    run, base, begin, end = jumping(hz, 0.45, 2.0, 0.0, 9.1, lasts_s)
    held = next(a.m.position for a in base if isinstance(a.m, GnssPosition) and a.true_ns >= begin)
    repeated = [
        replace(a, m=replace(a.m, position=held)) if isinstance(a.m, GnssPosition) and begin <= a.true_ns < end else a
        for a in base
    ]
    return run, repeated, begin, end


@cache
def _begun_alone(of: Callable[..., Any], case: tuple[float, ...], after_s: float) -> tuple[OnlineSmoother, Fed, int]:
    run, arrivals, begin, _ = of(*case)
    online, n = smoother(run), next(k for k, a in enumerate(arrivals) if a.true_ns > begin + after_s * 1e9)
    return online, feed(online, run, arrivals[:n]), n


def begun_alone(of: Callable[..., Any], case: tuple[float, ...], after_s: float) -> tuple[OnlineSmoother, Fed, int]:
    """As `begun`, of such a run until some time after the jump begins, or the fix is repeated; and how many messages that are."""
    online, fed, n = _begun_alone(of, case, after_s)
    return copied(online), fed.copied(), n


@pytest.mark.parametrize("hz", [1.0, 5.0])
def test_a_receiver_alone_that_repeats_a_fix_is_not_followed_nor_where_it_goes_on(hz: float) -> None:
    """It was followed for 33 m, and its going on then taken for a jump: 62 m off."""
    run, repeated, begin, end = hung(hz, 12.0)
    online, fed, n = begun_alone(hung, (hz, 12.0), 5.0)
    finish(online, feed(online, run, repeated[n:], fed))
    off_m, t_s = np.array(fed.errors_m), (np.array(fed.true_ns) - begin) * 1e-9
    sigma_m = np.sqrt([np.trace(e.cov[:2, :2]) for e in fed.estimates])
    assert (off_m < 2.5 * sigma_m).all()
    assert off_m[t_s < 4.0].max() < 2.0
    assert off_m[t_s > 14.0].max() < 2.0
    assert not [e for e in fed.events if "position jump" in e or "restarts" in e]
    out = [
        row
        for row in fed.rows
        if row.sensor == "gnss" and row.outcome is Outcome.REJECTED and "the run ended" not in row.reason
    ]
    assert all(begin < row.stamp_ns < end for row in out)
    assert len(out) >= 12.0 * hz - 2.0
    assert {row.reason for row in out} == {
        "it repeats the fix before it while the vessel moves", "frozen receiver: it repeats one position while the vessel moves"
    }  # fmt: skip


def test_fixes_that_turn_out_to_have_been_repeated_are_taken_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the estimate does not tell that the vessel moves, its going on does; it was taken for a jump, and the vessel 160 s behind."""
    monkeypatch.setattr(RepeatedFixDetector, "_is_old", lambda *_, **__: False)
    run, repeated, begin, end = hung(5.0, 4.0)
    fed = finish(online := smoother(run), feed(online, run, repeated))
    off_m, t_s = np.array(fed.errors_m), (np.array(fed.true_ns) - end) * 1e-9
    assert off_m.max() > 5.0
    assert off_m[t_s > 2.0].max() < 2.0
    assert [e for e in fed.events if "frozen receiver" in e and "until now" in e]
    assert not [e for e in fed.events if "position jump" in e or "restarts" in e]
    out = [row for row in fed.rows if row.sensor == "gnss" and "frozen" in row.reason]
    assert len(out) >= 4.0 * 5.0 - 2.0
    assert all(begin < row.stamp_ns < end for row in out)


@pytest.mark.parametrize("after_s", [5.0, 11.5])
def test_a_window_that_is_rebuilt_holds_repeated_fixes_out(after_s: float) -> None:
    """Also where it begins among them, and has none from before."""
    run, repeated, begin, _ = hung(5.0, 12.0)
    online, _, n = begun_alone(hung, (5.0, 12.0), 5.0)
    feed(online, run, [a for a in repeated[n:] if a.true_ns <= begin + after_s * 1e9])
    online._rebuild("planted")  # noqa: SLF001
    assert online._tracking is not None  # noqa: SLF001
    lag = online._tracking.lag  # noqa: SLF001
    own = lag._entries.of(lag.problem.streams["gnss"])  # noqa: SLF001
    assert sum(e.measurement.stamp_ns > begin + 200_000_000 for e in own) > 20
    assert all((e.verdict.decision is None) == (e.measurement.stamp_ns > begin + 200_000_000) for e in own)


def test_an_estimate_that_restarts_takes_a_receiver_that_repeats_a_fix_as_it_is() -> None:
    """That it moved said the estimate that was given up; while it is at rest, and the receiver holds its position, nothing would tell."""
    run, repeated, begin, end = hung(5.0, 12.0)
    online, _, _ = begun_alone(hung, (5.0, 12.0), 5.0)
    assert online._tracking is not None  # noqa: SLF001
    assert online._tracking.lag.frozen_receivers == {"gnss"}  # noqa: SLF001
    online._restart("planted")  # noqa: SLF001
    feed(online, run, [a for a in repeated if begin + 5_000_000_000 < a.true_ns < end])
    assert online._tracking is not None  # noqa: SLF001
    lag = online._tracking.lag  # noqa: SLF001
    assert not lag.frozen_receivers
    own = lag._entries.of(lag.problem.streams["gnss"])  # noqa: SLF001
    assert len(own) > 5
    assert all(e.verdict.decision is not None for e in own)


def test_a_jump_is_found_among_many_fixes_to_a_state() -> None:
    """Those between its detection and the rebuild were off as well: all fixes of the window were held out, and it was lost."""
    run, jumped, _, _ = jumping(20.0, 0.45, 2.0, 7.0, 9.1, lasts_s=4.0)
    run = slowly(run)
    fed = finish(online := smoother(run), feed(online, run, jumped))
    assert len([e for e in fed.events if "position jump" in e and "rebuilt" in e]) == 2
    assert max(fed.errors_m) < 2.0


def test_a_window_that_is_rebuilt_amid_a_suspicion_has_the_fixes_before_it() -> None:
    """Where it turns out to be a burst of outliers, they come in no second time."""
    case = (5.0, 0.45, 2.0, 7.0, 9.1)
    run, jumped, begin, end = jumping(*case)
    online, fed, now = begun_alone(jumping, case, 0.6)
    assert online._tracking is not None  # noqa: SLF001
    assert online._tracking.lag.problem.streams["gnss"].receiver.jump.suspects(online._tracking.lag.newest.stamp_ns)  # noqa: SLF001
    online._rebuild("planted")  # noqa: SLF001
    lag = online._tracking.lag  # noqa: SLF001
    own = lag._entries.of(lag.problem.streams["gnss"])  # noqa: SLF001
    assert len(own) > 30
    assert all((e.verdict.decision is None) == (e.measurement.stamp_ns > begin) for e in own)
    rest = [a for a in jumped[now:] if not isinstance(a.m, GnssPosition) or a.true_ns >= end]
    fed = finish(online, feed(online, run, rest, fed))
    out = [row for row in fed.rows if row.sensor == "gnss" and row.outcome is Outcome.REJECTED and row.nis is not None]
    assert [begin < row.stamp_ns < begin + 600_000_000 for row in out] == [True] * len(out)
    assert {row.reason for row in out} == {
        "off what the IMU predicts: an outlier, or a position jump too short to tell"
    }


def test_fixes_of_a_receiver_that_is_said_not_to_jump_are_used_after_a_jump() -> None:
    run, jumped, _, end = jumping(5.0, 0.02, 0.03, 10.0, 8.6, lasts_s=4.0)
    gnss = run.config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    steady = gnss.model_copy(update={"slow_error": gnss.slow_error.model_copy(update={"jumps": False})})
    run = replace(run, config=run.config.model_copy(update={"sensors": {**run.config.sensors, "gnss": steady}}))
    fed = finish(online := smoother(run), feed(online, run, jumped))
    assert [e for e in fed.events if "position jump" in e and "rebuilt" in e]
    assert not [row for row in fed.rows if "could not be used" in row.reason]
    assert [row for row in fed.rows if row.sensor == "gnss" and row.stamp_ns > end and row.outcome is Outcome.USED]


def test_no_window_begins_where_a_jump_was_not_known_yet() -> None:
    """Estimates from between a jump and its detection have the slow error of before it: a rebuild 9 s later was 8 m off."""
    case = (5.0, 0.45, 2.0, 7.0, 9.1)
    run, jumped, begin, _ = jumping(*case)
    online, fed, n = begun_alone(jumping, case, 0.6)
    feed(online, run, [a for a in jumped[n:] if a.true_ns <= begin + 1_800_000_000], fed)
    assert [e for e in fed.events if "position jump" in e and "rebuilt" in e]
    assert online._tracking is not None  # noqa: SLF001
    stamps_ns = [anchor.stamp_ns for anchor in online._tracking._recent.anchors]  # noqa: SLF001
    assert [at for at in stamps_ns if at < begin]
    assert not [at for at in stamps_ns if begin < at < begin + 1_000_000_000]


def test_odometry_continues_when_the_clock_is_set_back() -> None:
    base, (online, before) = arrivals_of(run_of()), begun(10.0)
    n = at_s(base, 10.0)
    back = [replace(a, m=replace(a.m, stamp_ns=a.m.stamp_ns - 3_600_000_000_000)) for a in base[n:]]
    after = feed(online, run_of(), back)
    assert [e for e in after.events if "set back" in e]
    walked = run_of().truth.at(np.array([after.true_ns[0], after.true_ns[-1]])).p_world_m
    way = np.linalg.norm(after.estimates[-1].p_odom_m - after.estimates[0].p_odom_m)
    assert abs(way - np.linalg.norm(walked[1] - walked[0])) < 2.0
    assert before.estimates


def test_a_configured_heading_holds_for_the_first_start_alone() -> None:
    """Half a minute of silence later the vessel lies otherwise: with no sensor to tell, it must not start by it again."""
    run = _seldom(replace(bl_scenario(1, "clean"), duration_s=26.0), 1)
    heading = run.config.start.model_copy(update={"heading_deg": 200.0})
    online = OnlineSmoother(run.config.model_copy(update={"start": heading}), rows=SENSORS, inertial=INERTIAL)
    base = [a for a in arrivals_of(run) if not isinstance(a.m, PoseFix | CompassHeading)]
    n = at_s(base, 8.0)
    feed(online, run, base[:n])
    assert online.waiting_for == ""
    later = [replace(a, m=replace(a.m, stamp_ns=a.m.stamp_ns + 60_000_000_000)) for a in base[n : at_s(base, 14.0)]]
    for a in later:
        online.feed(a.m)
    assert online.waiting_for.startswith("a heading")


# The solver


def broken_at(
    monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, calls: Callable[[int], bool], error: Exception
) -> list[int]:
    """Let a method raise at some of its calls; return the count of those that did."""
    real, count, raised = getattr(owner, name), [0], [0]

    def broken(*args: Any, **options: Any) -> Any:
        count[0] += 1
        if calls(count[0]):
            raised[0] += 1
            raise error
        return real(*args, **options)

    monkeypatch.setattr(owner, name, broken)
    return raised


@pytest.mark.parametrize("error", [RuntimeError("planted"), MemoryError(), ValueError("planted")])
def test_a_rebuild_loses_nothing(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """One failure of the solver in the middle: a second later the estimate is that of the run without it, to cm."""
    every, (online, fed) = arrivals_of(run_of()), begun(10.0)
    n, base = at_s(every, 10.0), every[: at_s(every, 13.0)]
    with monkeypatch.context() as patch:
        raised = broken_at(patch, Window, "commit", lambda k: k == 1, error)
        feed(online, run_of(), base[n : n + 30], fed)
    assert raised == [1]
    feed(online, run_of(), base[n + 30 :], fed)
    assert complaints(base, finish(online, fed)) == []
    assert len([e for e in fed.events if "rebuilt from" in e]) == 1
    plain = {e.stamp_ns: e for e in undisturbed().estimates if e.stamp_ns <= base[-1].true_ns}
    assert [e.stamp_ns for e in fed.estimates] == list(plain)  # not even one is missing
    off = [np.linalg.norm((e.p_world_m - plain[e.stamp_ns].p_world_m)[:2]) for e in fed.estimates]
    assert max(off) < 0.05
    assert off[-1] < 0.03
    odom = [np.linalg.norm(e.p_odom_m - plain[e.stamp_ns].p_odom_m) for e in fed.estimates]
    assert max(odom) < 0.15  # what was built anew is not walked twice


def test_a_solver_that_runs_away_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps from far off may lead farther, and the linear algebra does not mind: 10^20 m were once given out."""
    every, (online, fed) = arrivals_of(run_of()), begun(10.0)
    n, base = at_s(every, 10.0), every[: at_s(every, 13.0)]
    commit, lost = Window.commit, list[Window]()

    def astray(window: Window) -> None:
        """The first window goes, whatever is solved again; another that is built anew does not."""
        commit(window)
        lost.append(window)
        if window is lost[0]:
            known, far = window.values.atPose3, gtsam.Pose3(gtsam.Rot3(), np.full(3, 1e5))
            patch.setattr(window.values, "atPose3", lambda key: far * known(key))

    with monkeypatch.context() as patch:
        patch.setattr(Window, "commit", astray)
        feed(online, run_of(), base[n : n + 30], fed)
    feed(online, run_of(), base[n + 30 :], fed)
    assert complaints(base, finish(online, fed)) == []
    assert any("diverged" in e and "rebuilt from" in e for e in fed.events)
    assert max(fed.errors_m) < 5.0


@pytest.mark.parametrize(
    ("owner", "name", "share"), [(Window, "commit", 0.16), (Links, "integrate", 0.1), (Window, "add", 0.01), (Window, "covariance", 0.1)]
)  # fmt: skip
def test_exceptions_in_the_solver_are_survived(
    monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, share: float
) -> None:
    every, rng = arrivals_of(run_of()), np.random.default_rng(4)
    (online, fed), base = begun(6.0), every[: at_s(every, 23.0)]
    n = at_s(base, 6.0)
    with monkeypatch.context() as patch:
        errors = [RuntimeError("planted"), MemoryError(), ValueError("planted")]
        raised = broken_at(patch, owner, name, lambda _: bool(rng.random() < share), errors[int(rng.integers(3))])
        feed(online, run_of(), base[n : at_s(base, 16.0)], fed)
    assert raised[0] > 2
    feed(online, run_of(), base[at_s(base, 16.0) :], fed)
    assert complaints(base, finish(online, fed)) == []
    assert fed.errors_m[-1] < 1.0
    assert fed.recovered_s(base[at_s(base, 16.0)].true_ns) < 6.0


def test_a_measurement_that_cannot_be_used_is_rejected_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A row of the table that raises for one fix: that fix is rejected with the reason, nothing else happens."""
    base, online = arrivals_of(run_of()), smoother(run_of())
    n = at_s(base, 10.0)
    bad = next(a.m for a in base[n:] if isinstance(a.m, GnssPosition))
    row = next(row for row in SENSORS if row.kind == "gnss")

    def factors(m: GnssPosition, *rest: Any) -> Any:
        if m.seq == bad.seq:
            raise ZeroDivisionError("planted")
        return row.factors(m, *rest)

    rows = tuple(replace(r, factors=factors) if r is row else r for r in SENSORS)
    online = OnlineSmoother(run_of().config, rows=rows, inertial=INERTIAL)
    fed = whole(base, online)
    assert complaints(base, fed) == []
    (own,) = [r for r in fed.rows if r.seq == bad.seq]
    assert own.outcome is Outcome.REJECTED
    assert "ZeroDivisionError" in own.reason
    assert not [e for e in fed.events if "failed" in e]


# Snapshots


def test_resumes_after_a_kill(tmp_path: Path) -> None:
    run = simulate(replace(bl_scenario(1, "drift"), false_fraction=0.1, duration_s=26.0), 0)  # at full rates
    path, base = tmp_path / "snapshot.json", arrivals_of(run)
    base = base[: at_s(base, 15.0)]
    first = smoother(run, snapshot=path)
    cut = at_s(base, 8.7)
    before = feed(first, run, base[:cut])
    del first
    again = at_s(base, 11.0)  # 2.3 s until it runs again
    second = smoother(run, snapshot=path)
    fed = feed(second, run, base[again:])
    finish(second, fed)
    assert complaints(base[again:], fed) == []
    assert [e for e in fed.events if e.startswith("resumed from a snapshot")]
    assert (fed.true_ns[0] - base[again].true_ns) * 1e-9 < 0.3  # no new start, which takes 5 s
    assert max(fed.errors_m) < 3.0
    assert fed.recovered_s(base[again].true_ns, within_m=1.5) < 3.0
    walked = run.truth.at(np.array([before.true_ns[-1], fed.true_ns[0]])).p_world_m
    odom = np.linalg.norm(fed.estimates[0].p_odom_m - before.estimates[-1].p_odom_m)
    assert abs(odom - np.linalg.norm(walked[1] - walked[0])) < 2.0  # odometry goes on


def test_a_snapshot_that_is_too_old_leaves_nothing_behind(tmp_path: Path) -> None:
    """A week later, in another harbour: neither its origin of world nor its odometry is taken."""
    path, run = tmp_path / "snapshot.json", run_of()
    config = run.config.model_copy(update={"datum": None, "truth_topic": None})
    fixes = [a for a in arrivals_of(run) if isinstance(a.m, GnssPosition | ImuSample | CompassHeading)]
    no_world = {n: s for n, s in config.sensors.items() if s.kind not in ("aerial", "pose")}
    config = config.model_copy(update={"sensors": no_world})
    first = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL, snapshot=path)
    feed(first, run, fixes[: at_s(fixes, 9.0)])
    assert path.exists()
    week_ns = 7 * 86_400 * 1_000_000_000
    second = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL, snapshot=path)
    for a in fixes[: at_s(fixes, 9.0)]:
        m = replace(a.m, stamp_ns=a.m.stamp_ns + week_ns)
        if isinstance(m, GnssPosition):
            m = replace(m, position=m.position._replace(latitude_deg=m.position.latitude_deg - 5.0))
        second.feed(m)
    assert [e for e in second.events() if "old" in e.text]
    now = second.predict()
    assert now is not None
    assert first.datum is not None
    assert second.datum is not None
    assert abs(second.datum.origin.latitude_deg - first.datum.origin.latitude_deg + 5.0) < 1e-3
    assert np.linalg.norm(now.p_world_m[:2]) < 200.0


def _truncated(text: str) -> str:
    return text[: len(text) // 2]


def _nan(text: str) -> str:
    raw = json.loads(text)
    raw["anchor"]["velocity"][0] = float("nan")
    return json.dumps(raw)


def _heading(text: str) -> str:
    heading = {"why": "a guess", "since_ns": 0, "sigma_rad": float("nan"), "drift_radps": 0.01}
    return json.dumps(json.loads(text) | {"heading": heading})


def _noise(text: str) -> str:
    return json.dumps(json.loads(text) | {"noise": [1.0, 1e6, 1.0]})  # 20 kdeg/s in a second


def _sensor_noise(text: str) -> str:
    return json.dumps(json.loads(text) | {"sensor_noise": {"gnss": {"sigma_scale": 1e6}}})


def _other(text: str) -> str:
    return json.dumps(json.loads(text) | {"vessel": "another"})


def _elsewhere(text: str) -> str:
    raw = json.loads(text)
    raw["datum"][0] += 1.0
    return json.dumps(raw)


def _slow_of_other_size(text: str) -> str:
    raw = json.loads(text)
    known = raw["anchor"]["slow"]["gnss"]
    raw["anchor"]["slow"]["gnss"] = {"value": known["value"][:1], "gain": known["gain"][:1], "cov": [[1.0]]}
    return json.dumps(raw)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The snapshot of the first 8 s."""
    path, base = tmp_path_factory.mktemp("saved") / "snapshot.json", arrivals_of(run_of())
    feed(smoother(run_of(), snapshot=path), run_of(), base[: at_s(base, 8.0)])
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: "",
        lambda _: "[1, 2]",
        lambda _: "{}",
        _truncated,
        _nan,
        _heading,
        _noise,
        _sensor_noise,
        _other,
        _elsewhere,
        _slow_of_other_size,
    ],
)
def test_a_damaged_snapshot_is_reported_and_not_used(tmp_path: Path, saved: str, damage: Callable[[str], str]) -> None:
    path, base = tmp_path / "snapshot.json", arrivals_of(run_of())
    path.write_text(damage(saved), encoding="utf-8")
    online, again = smoother(run_of(), snapshot=path), base[at_s(base, 8.5) : at_s(base, 14.5)]
    fed = finish(online, feed(online, run_of(), again))
    assert complaints(again, fed) == []
    assert [e for e in fed.events if "the snapshot cannot be used" in e and e.endswith("starts without it")]
    assert [e for e in fed.events if e.startswith("started")]
    assert fed.errors_m[-1] < 2.0


def test_a_start_after_a_resume_does_not_take_the_heading_of_the_first_one(tmp_path: Path, saved: str) -> None:
    """The vessel has turned since: restarted after a silence of the IMU, one was 86 deg off at a bound of 42."""
    path, base = tmp_path / "snapshot.json", arrivals_of(run_of())
    path.write_text(saved, encoding="utf-8")
    online = OnlineSmoother(run_of().config.with_start_heading(10.0), rows=SENSORS, inertial=INERTIAL, snapshot=path)
    fed = feed(online, run_of(), base[at_s(base, 8.5) : at_s(base, 9.0)])
    assert [e for e in fed.events if e.startswith("resumed from a snapshot")]
    assert online._setup.config.start.heading_deg is None  # noqa: SLF001


@pytest.mark.parametrize("adapt", [True, False])
def test_raised_noise_is_resumed_while_adapt_noise_is_on(tmp_path: Path, saved: str, *, adapt: bool) -> None:
    """What a snapshot says of the IMU's noise ends where `adapt_noise` has been switched off since."""
    path, base = tmp_path / "snapshot.json", arrivals_of(run_of())
    path.write_text(json.dumps(json.loads(saved) | {"noise": [2.0, 3.0, 4.0, 5.0, 6.0]}), encoding="utf-8")
    run = run_of()
    imu = run.config.sensors["imu"].model_copy(update={"adapt_noise": adapt})
    config = run.config.with_sensors({"imu": imu})
    online = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL, snapshot=path)
    fed = feed(online, run, base[at_s(base, 8.5) : at_s(base, 11.0)])
    assert [e for e in fed.events if e.startswith("resumed from a snapshot")]
    assert json.loads(path.read_text(encoding="utf-8"))["noise"] == ([2.0, 3.0, 4.0, 5.0, 6.0] if adapt else [1.0] * 5)


@pytest.mark.parametrize(
    ("later_s", "why"), [(60, r"[\d.]+ s old, more than the 20 s"), (-60, r"[\d.]+ s newer than the first IMU sample")]
)
def test_an_old_snapshot_is_not_resumed(tmp_path: Path, later_s: int, why: str) -> None:
    path, base = tmp_path / "snapshot.json", arrivals_of(run_of())
    feed(smoother(run_of(), snapshot=path), run_of(), base[: at_s(base, 6.0)])
    later = [replace(a, m=replace(a.m, stamp_ns=a.m.stamp_ns + later_s * 10**9)) for a in base[: at_s(base, 7.0)]]
    online = smoother(run_of(), snapshot=path)
    fed = finish(online, feed(online, run_of(), later))
    assert complaints(later, fed) == []
    assert [e for e in fed.events if re.search(rf"the snapshot is {why}", e)]
    assert fed.estimates


def test_a_full_disk_is_reported_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("graphloc.online._snapshot.json.dump", full)
    base = arrivals_of(run_of())
    base = base[: at_s(base, 12.0)]
    fed = whole(base, smoother(run_of(), snapshot=tmp_path / "snapshot.json"))
    assert len([e for e in fed.events if "No space left" in e]) == 1
    plain = [e.stamp_ns for e in undisturbed().estimates]
    assert [e.stamp_ns for e in fed.estimates] == plain[: len(fed.estimates)]
    assert fed.estimates[-1].stamp_ns > base[-1].true_ns - 1e9 / RATE_HZ
