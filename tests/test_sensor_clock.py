# SPDX-License-Identifier: Apache-2.0
"""Online, a sensor's clock that is set by whole seconds in mid-run, and what only looks like it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array
from graphloc.measurements import CompassHeading, GnssPosition, Measurement
from graphloc.online import OnlineSmoother
from graphloc.online._sensor_clock import SensorClock
from tests.faults import Arrivals, Fed, arrivals_of, complaints, feed, finish
from tests.slowly import slowly
from tests.test_online_faults import run_of as run_with_matches

SET_S, ENDS_S = 12.0, 21.0
HZ = 4.0


@cache
def run_of() -> SimulatedRun:
    scenario = Scenario(path="loops", duration_s=ENDS_S, noise="drift", pose_hz=0.0, imu_hz=50.0, gnss_hz=HZ, compass_hz=2.0)  # fmt: skip
    return slowly(simulate(scenario, 5), 2.5)


def with_clock_set(arrivals: Arrivals, by_s: float, from_s: float = SET_S) -> Arrivals:
    """The fixes, from a time on, with stamps of a clock that was set."""
    since_ns = arrivals[0].true_ns + from_s * 1e9
    return [
        replace(a, m=replace(a.m, stamp_ns=a.m.stamp_ns + round(by_s * 1e9)))
        if isinstance(a.m, GnssPosition) and a.true_ns >= since_ns
        else a
        for a in arrivals
    ]


def whole(arrivals: Arrivals, online: OnlineSmoother | None = None) -> Fed:
    online = online or OnlineSmoother(run_of().config, rows=SENSORS, inertial=INERTIAL)
    return finish(online, feed(online, run_of(), arrivals))


@cache
def undisturbed() -> Fed:
    return whole(arrivals_of(run_of()))


@pytest.mark.parametrize(
    ("by_s", "what"), [(18.0, "forward by 18 s"), (-18.0, "back by 18 s"), (-1.0, "back by 1 s"), (3600.0, "forward by 3600 s")]
)  # fmt: skip
def test_fixes_whose_clock_is_set_are_used_at_their_own_time(by_s: float, what: str) -> None:
    plain, arrivals = undisturbed(), with_clock_set(arrivals_of(run_of()), by_s)
    fed = whole(arrivals)
    assert complaints(arrivals, fed) == []
    assert [what in e and "GPS time" in e for e in fed.events if e.startswith("gnss: its clock")] == [abs(by_s) == 18.0]
    stamps, rows = ({row.seq: row for row in f.rows if row.sensor == "gnss"} for f in (plain, fed))
    assert {n: row.outcome for n, row in rows.items()} == {n: row.outcome for n, row in stamps.items()}
    assert {n: row.stamp_ns for n, row in rows.items()} == {n: row.stamp_ns for n, row in stamps.items()}
    off_m = [np.linalg.norm(a.p_world_m - b.p_world_m) for a, b in zip(fed.estimates, plain.estimates, strict=True)]
    assert max(off_m) < 0.5  # a second without fixes
    assert off_m[-1] < 0.01


def test_a_clock_that_was_set_is_known_after_a_kill(tmp_path: Path) -> None:
    arrivals = with_clock_set(arrivals_of(run_of()), 18.0)
    config, path = run_of().config, tmp_path / "snapshot.json"
    online = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL, snapshot=path)
    since_ns = arrivals[0].true_ns + 19e9  # a fix comes first, and waits for the IMU
    cut = next(n for n, a in enumerate(arrivals) if a.true_ns >= since_ns and isinstance(a.m, GnssPosition))
    feed(online, run_of(), arrivals[:cut])
    fed = whole(arrivals[cut:], OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL, snapshot=path))
    assert any(e.startswith("resumed from a snapshot") for e in fed.events)
    used = [row for row in fed.rows if row.sensor == "gnss"]
    assert max(row.stamp_ns for row in used) <= arrivals[-1].true_ns
    assert max(fed.errors_m[-5:]) < 3.0


def test_stamps_that_are_ahead_from_the_start_are_told() -> None:
    fed = whole(with_clock_set(arrivals_of(run_of()), 18.0, from_s=0.0))
    assert sum("gnss: its stamps are 18.0 s ahead of the IMU's" in e for e in fed.events) == 1


@pytest.mark.parametrize("by_s", [18.0, -3.0])
def test_an_estimate_that_wrong_stamps_have_misled_starts_anew(by_s: float) -> None:
    """Fixes that came before the clock became right are put right, too: those 18 s ahead would wait so long for the IMU."""
    begin_ns = arrivals_of(run_of())[0].true_ns
    arrivals = with_clock_set(with_clock_set(arrivals_of(run_of()), by_s, from_s=0.0), -by_s)
    fed = whole(arrivals)
    assert complaints(arrivals, fed) == []
    misled = by_s < 10.0  # else the IMU has yet to reach the first of them
    assert fed.events.count("gnss was used at wrong times: restarts") == misled
    assert not any("position jump" in e for e in fed.events)
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(fed.estimates))
    assert largest_m(fed, begin_ns) < largest_m(undisturbed(), begin_ns) + 0.5  # of a vessel that goes 2.5 m/s


def test_an_estimate_that_had_nothing_of_wrong_stamps_goes_on() -> None:
    """A compass that is 30 s behind at first, beside matches: all of it came too late, so nothing was misled."""
    run = run_with_matches()
    every = arrivals_of(run)
    begin_ns = every[0].true_ns
    behind = [
        replace(a, m=replace(a.m, stamp_ns=a.m.stamp_ns - 30 * 10**9))
        if isinstance(a.m, CompassHeading) and a.true_ns < begin_ns + 14e9
        else a
        for a in every
        if a.true_ns < begin_ns + 22e9
    ]
    online = OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL)
    fed = finish(online, feed(online, run, behind))
    assert complaints(behind, fed) == []
    assert any(e.startswith("compass: its stamps were 30.0 s behind") for e in fed.events)
    assert fed.estimates[0].stamp_ns < begin_ns + 12e9
    assert not any("restarts" in e for e in fed.events)


def largest_m(fed: Fed, begin_ns: int) -> float:
    """Return the largest error from two seconds after the clock was set."""
    since_ns = begin_ns + (SET_S + 2.0) * 1e9
    return max(m for e, m in zip(fed.estimates, fed.errors_m, strict=True) if e.stamp_ns >= since_ns)


def taken_of(off_s: Callable[[float], float | None], until_s: float) -> tuple[list[Measurement], list[str]]:
    """What a clock that is `off_s` makes of fixes at 4 Hz, numbered by fourths of a second; None: the receiver is silent."""
    clock, taken, events = SensorClock(), list[Measurement](), list[str]()
    fix = next(a.m for a in arrivals_of(run_of()) if isinstance(a.m, GnssPosition))
    for n in range(round(until_s * HZ)):
        if (by_s := off_s(n / HZ)) is not None:
            m = replace(fix, stamp_ns=round((n / HZ + by_s) * 1e9), seq=n)
            now = clock.take(m, round((n / HZ + 0.02) * 1e9))
            taken += now.found
            events += [now.said] if now.said else []
    return taken, events


@pytest.mark.parametrize("by_s", [18.0, -18.0, 3.0])
def test_stamps_that_become_right_are_used_as_they_come(by_s: float) -> None:
    """As of a receiver that learns of leap seconds some minutes after it was switched on."""
    taken, events = taken_of(lambda t_s: by_s if t_s < 30.0 else 0.0, 60.0)
    assert [m.seq for m in taken] == list(range(240))
    assert all(m.stamp_ns == round(m.seq / HZ * 1e9) for m in taken[120:])
    assert [f"set by {-by_s:+.0f} s" in e for e in events if "used as they come" in e] == [True]


def test_a_leap_second_of_messages_that_take_most_of_one_is_put_right() -> None:
    """Before, they were 0.6 s behind the IMU's, after it 0.4 s ahead, which is nearer, but of the future."""
    taken, events = taken_of(lambda t_s: -0.58 + (1.0 if t_s >= 30.0 else 0.0), 60.0)
    assert [m.stamp_ns for m in taken] == [round((m.seq / HZ - 0.58) * 1e9) for m in taken]
    assert ["are corrected" in e for e in events] == [True]


@pytest.mark.parametrize("by_s", [18.0, -18.0])
def test_a_clock_that_is_set_again_while_the_receiver_is_silent(by_s: float) -> None:
    """It was switched off and on; what was known of its clock is of before."""
    taken, events = taken_of(lambda t_s: None if 30.0 <= t_s < 40.0 else by_s if 20.0 <= t_s < 30.0 else 0.0, 60.0)
    assert [m.seq for m in taken] == [*range(120), *range(160, 240)]
    right = [m.stamp_ns == round(m.seq / HZ * 1e9) for m in taken]
    assert all(right[:120])
    assert all(right[130:])  # by ten it is told
    assert "set again" in events[1]


# What is none


def stalled_imu(t_s: float) -> float:
    """The IMU sends nothing for 5 s, and then what it has kept."""
    return 10.0 if 10.0 <= t_s < 15.0 else t_s


def steady_imu(t_s: float) -> float:
    return t_s


def on_time(t_s: float) -> float:
    return t_s


def delayed(t_s: float) -> float:
    """From 10 s on each message takes 1 s longer."""
    return t_s + 1.0 if t_s >= 10.0 else t_s


def drifting(t_s: float) -> float:
    """A clock that gains 1 s in 10 s."""
    return t_s - 0.1 * max(t_s - 10.0, 0.0)


@pytest.mark.parametrize(
    ("imu", "arrives", "stamp"),
    [
        (stalled_imu, on_time, on_time),
        (steady_imu, delayed, on_time),
        (steady_imu, on_time, lambda t_s: t_s + (2.0 if t_s == 12.0 else 0.0)),
        (steady_imu, on_time, lambda t_s: t_s + (1.5 if t_s >= 12.0 else 0.0)),
        (steady_imu, on_time, drifting),
    ],
    ids=["imu-stalls", "slower-link", "one-outlier", "no-whole-seconds", "drifts"],
)
def test_what_only_looks_like_a_leap_passes_as_it_comes(
    imu: Callable[[float], float], arrives: Callable[[float], float], stamp: Callable[[float], float]
) -> None:
    clock, taken, sent = SensorClock(), list[Measurement](), list[Measurement]()
    fix = next(a.m for a in arrivals_of(run_of()) if isinstance(a.m, GnssPosition))
    for n in range(100):
        t_s = n / HZ
        m = replace(fix, stamp_ns=round(stamp(t_s) * 1e9), seq=n)
        newest_ns = round(50.0 * imu(arrives(t_s))) * 20_000_000
        now = clock.take(m, newest_ns)
        sent.append(m)
        taken += now.found
        assert not now.said
    assert [m.seq for m in (*taken, *clock.left())] == list(range(100))
    assert all(a.stamp_ns == b.stamp_ns for a, b in zip(taken, sent, strict=False))


def _random(t_s: Array, rng: np.random.Generator) -> Array:
    return rng.uniform(0.0, 2.0, len(t_s))


def _in_bursts(t_s: Array, rng: np.random.Generator) -> Array:
    period_s = rng.uniform(0.5, 3.0)
    return np.asarray(np.ceil(t_s / period_s) * period_s - t_s)


def _by_whole_seconds(t_s: Array, rng: np.random.Generator) -> Array:
    """Each for 50 messages."""
    return np.repeat(rng.integers(0, 4, len(t_s) // 50 + 1), 50)[: len(t_s)] + rng.uniform(0.0, 0.03, len(t_s))


def _with_stalls(t_s: Array, rng: np.random.Generator) -> Array:
    late_s = np.zeros(len(t_s))
    for begin_s, lasts_s in zip(rng.uniform(0.0, t_s[-1], 20), rng.uniform(0.5, 6.0, 20), strict=True):
        within = (t_s >= begin_s) & (t_s < begin_s + lasts_s)
        late_s[within] = begin_s + lasts_s - t_s[within]
    return late_s


def _through_a_full_queue(t_s: Array, rng: np.random.Generator) -> Array:
    """Ten times each message waits longer than the one before, up to some seconds, and then they wait less and less."""
    late_s = np.zeros(len(t_s))
    for begin_s in np.arange(15.0, 300.0, 30.0):
        within = (t_s >= begin_s) & (t_s < begin_s + 30.0)
        fills_s, most_s = rng.uniform(0.3, 6.0), rng.uniform(0.5, 4.0)
        filled = 1.0 - np.exp(-(t_s[within] - begin_s) / fills_s)
        late_s[within] = np.minimum(most_s * filled, np.clip(begin_s + 30.0 - t_s[within], 0.0, None) * 0.5)
    return late_s + rng.uniform(0.0, 0.03, len(t_s))


@pytest.mark.parametrize("late_s", [_random, _in_bursts, _by_whole_seconds, _with_stalls, _through_a_full_queue])
@pytest.mark.parametrize("hz", [1.0, 4.0, 10.0])
def test_messages_that_come_late_are_no_leap(late_s: Callable[[Array, np.random.Generator], Array], hz: float) -> None:
    """Also where they come in bursts, or overtake each other."""
    fix = next(a.m for a in arrivals_of(run_of()) if isinstance(a.m, GnssPosition))
    for seed in range(6):
        clock, rng, t_s = SensorClock(), np.random.default_rng(seed), np.arange(0.0, 300.0, 1.0 / hz)
        came_s = t_s + late_s(t_s, rng)
        for n in np.argsort(came_s, kind="stable"):
            m = replace(fix, stamp_ns=round(t_s[n] * 1e9), seq=int(n))
            assert not clock.take(m, int(came_s[n] * 100.0) * 10_000_000).said


def test_a_leap_is_told_from_messages_that_take_longer_or_shorter() -> None:
    """By up to 80 ms."""
    clock, taken, rng = SensorClock(), list[Measurement](), np.random.default_rng(1)
    fix = next(a.m for a in arrivals_of(run_of()) if isinstance(a.m, GnssPosition))
    for n in range(100):
        t_s = n / HZ
        m = replace(fix, stamp_ns=round((t_s + (2.0 if n >= 50 else 0.0)) * 1e9), seq=n)
        taken += clock.take(m, round(50.0 * (t_s + rng.uniform(0.0, 0.08))) * 20_000_000).found
    assert [m.stamp_ns for m in taken] == [round(n / HZ * 1e9) for n in range(100)]
