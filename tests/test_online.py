# SPDX-License-Identifier: Apache-2.0
"""The online mode on runs that go well: start, lateness, lag, odometry, memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from graphloc import app
from graphloc.config import GnssConfig, ImuConfig, PoseConfig, SensorConfig, TimelineConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario, simulate
from graphloc.eval.simulate._scenario import harbour_scenarios
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array, wrap_angle
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, ImuSample, PoseFix, PoseMode
from graphloc.online import OnlineSmoother, _start, _waiting
from graphloc.signals.thinning import THINNED
from graphloc.time import stamps_of
from graphloc.trajectory import Trajectory
from tests.faults import Arrival, Arrivals, Fed, arrivals_of, complaints, copied, delayed, feed, finish
from tests.slowly import slowly, sparsely
from tests.tagfactory import sighted

RATE_HZ = 2.5  # of states


def smoother(run: SimulatedRun, *, lag_s: float = 10.0) -> OnlineSmoother:
    return OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL, lag_s=lag_s)


@cache
def drift() -> SimulatedRun:
    """21 s; sensors at half the rates of BL or less, states at a quarter: a fifth of the time."""
    scenario = replace(bl_scenario(1, "drift"), duration_s=30.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=2.0)
    run = slowly(simulate(scenario, 0), RATE_HZ)
    end_ns, imu = run.truth.stamps_ns[0] + 21_000_000_000, run.recording.imu
    assert imu is not None
    measurements = tuple(m for m in run.recording.measurements if m.stamp_ns < end_ns)
    return replace(
        run, recording=replace(run.recording, imu=imu.where(imu.stamps_ns < end_ns), measurements=measurements)
    )


def whole(run: SimulatedRun, arrivals: Arrivals, *, lag_s: float = 10.0) -> tuple[Fed, Trajectory]:
    """Feed all of a run; return what came of it, and the lag at the end."""
    online = smoother(run, lag_s=lag_s)
    fed = feed(online, run, arrivals)
    lag = online.window()
    assert lag is not None
    return finish(online, fed), lag


@cache
def in_order() -> tuple[Fed, Trajectory]:
    return whole(drift(), arrivals_of(drift()))


def apart_m(a: Trajectory, b: Trajectory) -> Array:
    """Horizontal distances at the stamps of `a` that `b` has, too."""
    stamps = a.stamps_ns[(a.stamps_ns >= b.stamps_ns[0]) & (a.stamps_ns <= b.stamps_ns[-1])]
    off = a.at(stamps).p_world_m - b.at(stamps).p_world_m
    return np.hypot(off[:, 0], off[:, 1])


def yaw_of(track: Trajectory, at_ns: int) -> float:
    R = track.at(np.array([at_ns])).R_world_body[0]
    return float(np.arctan2(R[1, 0], R[0, 0]))


def receiver_alone(run: SimulatedRun) -> dict[str, SensorConfig]:
    """The IMU and the receiver, whose slow error is estimated."""
    gnss = run.config.sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    slow_error = gnss.slow_error.model_copy(update={"enabled": True})
    return {"imu": run.config.sensors["imu"], "gnss": gnss.model_copy(update={"slow_error": slow_error})}


def without(arrivals: Arrivals, gone: Callable[[Arrival], bool]) -> Arrivals:
    return [a for a in arrivals if not gone(a)]


def test_a_clean_run_is_followed_and_each_message_has_its_row() -> None:
    fed, _ = in_order()
    assert complaints(arrivals_of(drift()), fed) == []
    assert np.sqrt(np.mean(np.square(fed.errors_m))) < 0.5
    off = [
        (e.p_world_m - drift().truth.at(np.array([e.stamp_ns])).p_world_m[0])[:2] for e in fed.estimates
    ]  # fmt: skip
    inside = [
        o @ np.linalg.solve(e.cov[:2, :2], o) < chi2.ppf(0.95, 2) for o, e in zip(off, fed.estimates, strict=True)
    ]
    assert np.mean(inside) > 0.8


def test_estimates_come_at_the_rate_of_states_and_stamps_increase() -> None:
    stamps = np.array([e.stamp_ns for e in in_order()[0].estimates])
    assert np.allclose(np.diff(stamps), 1e9 / RATE_HZ, atol=1)


def test_false_matches_are_rejected_with_a_reason() -> None:
    truth = drift().truth
    stamps = {a.m.seq: a.m for a in arrivals_of(drift()) if isinstance(a.m, PoseFix)}
    right = wrong = 0
    for row in in_order()[0].rows:
        if row.seq in stamps:
            m = stamps[row.seq]
            off = m.modes[0].value[:2] - truth.at(np.array([m.stamp_ns])).p_world_m[0, :2]
            if np.hypot(*off) > 1.5:  # five sigmas of a true one, both axes
                wrong += row.outcome is not Outcome.REJECTED
                assert row.outcome is Outcome.USED or row.reason
            else:
                right += row.outcome is Outcome.USED
    assert wrong == 0
    assert right >= 10  # of 13


def test_a_right_match_that_comes_alone_refutes_false_ones_that_agree() -> None:
    """After an outage two false ones of six in a row agree with each other, 1.4 m off, and are believed: GNSS may have jumped.

    The next right one agrees with those before them; alone, it was no other choice, and was judged false.
    """
    scenario = replace(Scenario(path="loops", noise="drift"), duration_s=132.0, outage_s=(60.0, 120.0))
    run = sparsely(slowly(simulate(scenario, 19), 1.25))
    begin_ns = run.truth.stamps_ns[0] + 50_000_000_000  # 10 s of fixes are enough to drift from
    fed = feed(smoother(run), run, without(arrivals_of(run), lambda a: a.true_ns < begin_ns))
    t_s, off = (np.array(fed.true_ns) - run.truth.stamps_ns[0]) * 1e-9, np.array(fed.errors_m)
    assert off[(t_s > 130.0) & (t_s < 131.4)].min() > 1.0  # else this shows nothing
    assert off[t_s > 131.55].max() < 0.6


def test_the_end_agrees_with_the_batch() -> None:
    """On the same data, in a lag that holds all of it. What differs: the batch sees at once how wide a sensor scatters."""
    _, lag = whole(drift(), arrivals_of(drift()), lag_s=60.0)
    apart = apart_m(lag, app.smooth_recording(drift().recording, drift().config).solution.trajectory)
    assert np.median(apart) < 0.02
    assert apart.max() < 0.08


# Lateness


def test_late_and_shuffled_ends_where_in_order_ends() -> None:
    """Late within the lag is as good as in time: the states of the lag come out the same to a centimetre."""
    arrivals = delayed(arrivals_of(drift()), np.random.default_rng(3), 2.0, imu=False, quiet_s=2.5)
    fed, lag = whole(drift(), arrivals)
    assert complaints(arrivals, fed) == []
    assert not [row for row in fed.rows if row.outcome is Outcome.LATE]
    assert apart_m(lag, in_order()[1]).max() < 0.01


@pytest.mark.parametrize("from_s", [9.2, 12.8])
def test_the_final_estimate_does_not_depend_on_the_start_time(from_s: float) -> None:
    """Places and headings come all at once, so late: what is judged again in the lag is what an earlier start had.

    After 9.2 s the lag begins where the data do, after 12.8 s at the state a lag ago.
    """
    arrivals, at_once_ns = arrivals_of(drift()), drift().truth.stamps_ns[0] + round(from_s * 1e9)
    late = sorted(arrivals, key=lambda a: a.true_ns if isinstance(a.m, ImuSample) else max(a.true_ns, at_once_ns))
    fed, lag = whole(drift(), late)
    assert fed.estimates[0].stamp_ns >= at_once_ns
    stamps_ns = lag.stamps_ns[-5:]
    assert np.abs(lag.at(stamps_ns).p_world_m - in_order()[1].at(stamps_ns).p_world_m).max() < 0.005


def test_the_choice_of_modes_does_not_depend_on_the_order_of_arrival() -> None:
    """Two of three matches are false here, and some repeat: what is right is told by costs, so the graph must be solved.

    With steps of the IMU left 1 mm apart (iSAM2's own threshold), the late run took false ones and was 3 m off.
    """
    scenario = replace(bl_scenario(1, "drift"), duration_s=60.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=2.0)
    run = slowly(simulate(scenario, 4))
    every = arrivals_of(run)
    until_ns = every[0].true_ns + 24_000_000_000
    every = [a for a in every if isinstance(a.m, ImuSample) or a.true_ns < until_ns]
    late = delayed(every, np.random.default_rng([4, 4]), 2.0, imu=False)
    ends = [whole(run, [a for a in some if a.true_ns < until_ns])[1] for some in (every, late)]
    assert apart_m(*ends).max() < 0.5  # another choice is metres off


def test_late_imu_samples_fill_their_holes() -> None:
    """Once it runs: at the start, attitude and biases are told from what is there."""
    every = arrivals_of(drift())
    n = next(n for n, a in enumerate(every) if a.true_ns > every[0].true_ns + 6_000_000_000)
    arrivals = [*every[:n], *delayed(every[n:], np.random.default_rng(3), 2.0, imu=True, quiet_s=2.5)]
    fed, lag = whole(drift(), arrivals)
    assert complaints(arrivals, fed) == []
    imu = [row for row in fed.rows if row.sensor == "imu"]
    assert sum(row.outcome is Outcome.USED for row in imu) > 0.98 * len(imu)
    assert apart_m(lag, in_order()[1]).max() < 0.01


def test_everything_late_from_the_first_message_on() -> None:
    arrivals = delayed(arrivals_of(drift()), np.random.default_rng(3), 2.0, imu=True, quiet_s=2.5)
    fed, lag = whole(drift(), arrivals)
    assert complaints(arrivals, fed) == []
    assert all(row.outcome is Outcome.USED for row in fed.rows if row.sensor == "imu")
    apart = apart_m(lag, in_order()[1])
    assert apart.max() < 0.01


def test_a_prediction_knows_imu_samples_that_came_late() -> None:
    """Those before the newest state, too, though no further state is made."""
    run = slowly(drift(), 5.0)
    arrivals = arrivals_of(run)
    end_ns = arrivals[0].true_ns + 9_050_000_000
    arrivals = [a for a in arrivals if a.true_ns < end_ns]
    late = [
        a for a in arrivals if isinstance(a.m, ImuSample) and end_ns - 700_000_000 < a.true_ns < end_ns - 350_000_000
    ]
    before = next(n for n, a in enumerate(arrivals) if a in late)
    online, ends = smoother(run), []
    feed(online, run, arrivals[:before])
    rest = arrivals[before:]
    for one, some in ((copied(online), rest), (online, [*(a for a in rest if a not in late), *late])):
        feed(one, run, some)
        ends.append(one.predict(arrivals[-1].true_ns))
    in_time, too_late = ends
    assert in_time is not None
    assert too_late is not None
    assert np.abs(too_late.p_world_m - in_time.p_world_m).max() < 0.001
    assert np.abs(too_late.v_world_mps - in_time.v_world_mps).max() < 0.001


def test_an_imu_step_is_reintegrated_when_its_samples_come_late() -> None:
    """One hole, filled 1.5 s later: the end is that of the run without it."""
    arrivals = arrivals_of(drift())
    begin = arrivals[0].true_ns + 15_000_000_000
    hole = [a for a in arrivals if isinstance(a.m, ImuSample) and begin <= a.true_ns < begin + 500_000_000]
    rest = [a for a in arrivals if a not in hole]
    after = next(n for n, a in enumerate(rest) if a.true_ns > begin + 1_800_000_000)
    online = smoother(drift())
    feed(online, drift(), rest[:after])
    left = copied(online)
    for one, some, lowest_m, highest_m in ((online, hole, 0.0, 0.01), (left, [], 0.02, 1.0)):  # else this shows nothing
        feed(one, drift(), [*some, *rest[after:]])
        lag = one.window()
        assert lag is not None
        assert lowest_m <= apart_m(lag, in_order()[1]).max() < highest_m


def test_the_way_to_a_measurement_is_reintegrated_when_samples_come_late() -> None:
    """Each measurement of the hole is carried from its state as one that comes after all samples would be."""
    arrivals = arrivals_of(drift())
    begin = arrivals[0].true_ns + 12_000_000_000
    end = begin + 300_000_000
    hole = [a for a in arrivals if isinstance(a.m, ImuSample) and begin <= a.true_ns < end]
    rest = [a for a in arrivals if a not in hole and a.true_ns < begin + 3_000_000_000]
    # Half of the stamps do not lie on states.
    rest = [
        replace(a, m=replace(a.m, stamp_ns=a.m.stamp_ns + 40_000_000)) if isinstance(a.m, GnssPosition) else a
        for a in rest
    ]
    after = next(n for n, a in enumerate(rest) if a.true_ns > begin + 1_800_000_000)
    online = smoother(drift())
    feed(online, drift(), [*rest[:after], *hole, *rest[after:]])
    assert online._tracking is not None  # noqa: SLF001 - the estimate shows it by millimetres only
    problem, checked = online._tracking.lag.problem, 0  # noqa: SLF001
    for stream in problem.streams.values():
        for k in range(stream.measurements.first, len(stream.measurements)):
            carry, stamp_ns = stream.carry[k], stream.measurements[k].stamp_ns
            if carry is not None and begin <= stamp_ns < end:
                expected = problem.links.integrate(
                    problem.timeline.stamps_ns[carry[0]], stamp_ns, gtsam.imuBias.ConstantBias()
                )
                np.testing.assert_allclose(carry[1].deltaVij(), expected.deltaVij(), rtol=0.0, atol=1e-12)
                np.testing.assert_allclose(
                    stream.gyro_radps[k], problem.links.gyro_at(np.array([stamp_ns]))[0], rtol=0.0, atol=1e-12
                )
                checked += 1
    assert checked > 1


def test_later_than_the_lag_is_late() -> None:
    arrivals = arrivals_of(drift())
    fixes = [a for a in arrivals if isinstance(a.m, GnssPosition)]
    old = [a for a in fixes if a.true_ns < arrivals[0].true_ns + 7_000_000_000][-10:]
    rest = [a for a in arrivals if a not in old]
    after = next(n for n, a in enumerate(rest) if a.true_ns > arrivals[0].true_ns + 18_000_000_000)
    shuffled = [*rest[:after], *old, *rest[after:]]
    fed, _ = whole(drift(), shuffled)
    assert complaints(shuffled, fed) == []
    late = [row for row in fed.rows if row.outcome is Outcome.LATE]
    assert {row.seq for row in late} == {a.m.seq for a in old}
    assert all("the lag is 10 s" in row.reason for row in late)


# Start


def said_while_waiting(run: SimulatedRun, arrivals: Arrivals) -> tuple[list[str], Fed]:
    online, fed = smoother(run), Fed()
    said: list[str] = []
    for a in arrivals:
        feed(online, run, [a], fed)
        if not said or said[-1] != online.waiting_for:
            said.append(online.waiting_for)
    return said, finish(online, fed)


def test_starts_from_fix_and_compass() -> None:
    arrivals = without(arrivals_of(drift()), lambda a: isinstance(a.m, PoseFix))
    said, fed = said_while_waiting(drift(), arrivals[: len(arrivals) // 3])
    assert said[0] != ""
    assert said[-1] == ""
    assert any("s of IMU data" in s for s in said)
    assert (fed.true_ns[0] - arrivals[0].true_ns) * 1e-9 == pytest.approx(5.0, abs=0.6)
    assert fed.errors_m[0] < 3.0


def test_starts_from_fixes_alone_once_the_vessel_has_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    # Tried after 5, 10 and 17 s, which is the end here, not every half second and more: each solves all that there is.
    monkeypatch.setattr(_start, "_LONGEST_WAIT_S", 15.0)
    monkeypatch.setattr(_waiting, "_TRY_EVERY_S", 5.1)
    monkeypatch.setattr(_waiting, "_TRY_AGAIN", 0.55)
    run = slowly(
        simulate(
            replace(
                Scenario(path="loops", noise="clean"), duration_s=22.0, gnss_hz=2.0, imu_hz=50.0, gnss_sigma_m=0.05
            ),
            0,
        )
    )
    begin = arrivals_of(run)[0].true_ns  # after 17 s it goes on with what the turns tell
    arrivals = without(
        arrivals_of(run), lambda a: isinstance(a.m, (PoseFix, CompassHeading)) or a.true_ns > begin + 21 * 10**9
    )
    said, fed = said_while_waiting(run, arrivals)
    assert any(s.startswith("a heading") and "m of travel" in s for s in said)
    first = run.truth.at(np.array([arrivals[0].true_ns, fed.true_ns[0]])).p_world_m
    assert np.hypot(*(first[1] - first[0])[:2]) > 10.0
    assert fed.errors_m[-1] < 3.0
    begun = fed.estimates[0]
    assert abs(wrap_angle(begun.yaw_rad - yaw_of(run.truth, fed.true_ns[0]))) < begun.heading_bound_95_rad


@pytest.mark.usefixtures("few_tries")
def test_a_start_that_waited_longer_than_the_lag_keeps_what_it_found() -> None:
    """Fixes alone hardly tell a heading in half a minute: told again by ten seconds of them at a time, it is another one."""
    run = slowly(
        simulate(
            replace(Scenario(path="loops", noise="clean"), duration_s=24.0, gnss_hz=5.0, imu_hz=50.0, gnss_sigma_m=0.5),
            1,
        ),
        5.0,
    )
    arrivals = without(arrivals_of(run), lambda a: isinstance(a.m, (PoseFix, CompassHeading)))
    online, fed = smoother(run, lag_s=5.0), Fed()
    n = next(n for n, a in enumerate(arrivals) if feed(online, run, [a], fed).estimates)
    assert complaints(arrivals[: n + 1], finish(online, fed)) == []
    (begun,), end_ns = fed.estimates, fed.true_ns[0]
    imu = run.recording.imu
    assert imu is not None
    assert end_ns - imu.stamps_ns[0] > 12e9
    whole = app.smooth_recording(
        replace(
            run.recording,
            imu=imu.where(imu.stamps_ns <= end_ns),
            measurements=tuple(m for m in run.recording.measurements if m.sensor == "gnss" and m.stamp_ns <= end_ns),
        ),
        run.config.model_copy(update={"sensors": receiver_alone(run)}),
    ).solution.trajectory
    assert np.degrees(abs(wrap_angle(begun.yaw_rad - yaw_of(whole, end_ns)))) < 5.0
    assert "the heading is a guess" in begun.reason.text
    assert begun.heading_bound_95_rad > np.pi  # so any heading is in its bounds


@pytest.mark.usefixtures("few_tries")
def test_a_start_that_waited_uses_what_came_just_before_its_first_state() -> None:
    """Fixes 60 ms before the states that they are tied to: of the one tied to the first state of the lag, too, the start has made use."""
    run = slowly(
        simulate(replace(Scenario(path="loops", noise="clean"), duration_s=18.0, gnss_hz=2.0, imu_hz=50.0), 1), RATE_HZ
    )
    arrivals = [
        replace(a, m=replace(a.m, stamp_ns=a.m.stamp_ns - 60_000_000)) if isinstance(a.m, GnssPosition) else a
        for a in without(arrivals_of(run), lambda a: isinstance(a.m, (PoseFix, CompassHeading)))
    ]
    fed = feed(online := smoother(run, lag_s=5.0), run, arrivals)
    assert complaints(arrivals, finish(online, fed)) == []
    refused = [row for row in fed.rows if row.sensor == "gnss" and row.outcome is Outcome.REJECTED]
    imu = run.recording.imu
    assert imu is not None
    assert [row.seq for row in refused if row.stamp_ns > imu.stamps_ns[0]] == []


@pytest.mark.usefixtures("few_tries")
def test_what_closes_a_slow_chain_counts_once_after_a_start_that_waited() -> None:
    """Slow states as far apart as the lag is long, or farther: the last of them is not the first of the lag."""
    run = simulate(replace(Scenario(path="loops", noise="clean"), duration_s=24.0, gnss_hz=2.0, imu_hz=50.0), 1)
    run = replace(run, config=run.config.model_copy(update={
        "timeline": TimelineConfig(rate_hz=RATE_HZ, slow_period_s=4.0),
        "sensors": receiver_alone(run),
    }))  # fmt: skip
    arrivals = without(arrivals_of(run), lambda a: a.m.sensor not in run.config.sensors)
    sigmas_m = []
    for lag_s in (1.0, 6.0):
        online, fed = smoother(run, lag_s=lag_s), Fed()
        next(a for a in arrivals if feed(online, run, [a], fed).estimates)
        sigmas_m.append(np.sqrt(np.diagonal(fed.estimates[0].cov)[:3]))
        finish(online, fed)
    np.testing.assert_allclose(sigmas_m[0][2], sigmas_m[1][2], rtol=0.05)


@pytest.mark.usefixtures("few_tries")
def test_a_start_whose_heading_is_a_guess_is_no_surer_of_its_place_than_the_receiver() -> None:
    """Fixes whose slow error is 2 m and no compass: a heading that goes on turning in the lag tells no place."""
    run = simulate(replace(Scenario(path="loops", noise="clean"), duration_s=25.0, gnss_hz=2.0, imu_hz=50.0), 1)
    run = slowly(replace(run, config=run.config.model_copy(update={"sensors": receiver_alone(run)})))
    fed = feed(
        online := smoother(run, lag_s=5.0),
        run,
        without(arrivals_of(run), lambda a: a.m.sensor not in run.config.sensors),
    )
    finish(online, fed)
    for estimate in (fed.estimates[0], fed.estimates[-1]):
        assert (
            np.sqrt(np.diagonal(estimate.cov)[:2]).min()
            > 0.9 * run.config.sensors["gnss"].slow_error.horizontal_sigma_m
        )
    assert fed.errors_m[-1] < 1.0


def test_starts_from_given_poses() -> None:
    """Four poses and the IMU: place and heading are known, and then dead reckoned."""
    run = drift()
    t0 = arrivals_of(run)[0].true_ns
    given = []
    for n in range(4):
        at = t0 + 1_500_000_000 + n * 1_000_000_000
        true = run.truth.at(np.array([at]))
        R = true.R_world_body[0]
        value = np.array([*true.p_world_m[0, :2], np.arctan2(R[1, 0], R[0, 0])])
        mode = PoseMode(value=value, cov=np.diag([0.01, 0.01, 1e-4]), probability=1.0)
        pose = PoseFix(stamp_ns=at, sensor="given", seq=900_000 + n, axes=("x", "y", "yaw"), modes=(mode,))
        given.append(Arrival(at, pose))
    sensors = {"imu": run.config.sensors["imu"], "height": run.config.sensors["height"], "given": PoseConfig()}
    posed = replace(run, config=run.config.model_copy(update={"sensors": sensors}))
    imu = [a for a in arrivals_of(run) if isinstance(a.m, ImuSample) and a.true_ns < t0 + 9_000_000_000]
    arrivals = sorted([*imu, *given], key=lambda a: a.true_ns)
    said, fed = said_while_waiting(posed, arrivals)
    assert complaints(arrivals, fed) == []
    assert said[-1] == ""
    assert fed.errors_m[0] < 0.5
    online = smoother(posed)
    feed(online, posed, imu)
    assert online.waiting_for == "a position: a fix, a match, a tag or a pose"


def test_starts_from_a_tag_alone() -> None:
    scenario = replace(harbour_scenarios()["dock-fixed-optimal"], duration_s=42.0, gnss_hz=0.0, compass_hz=0.0)
    run, _ = sighted(slowly(simulate(replace(scenario, imu_hz=50.0), 0)), rate_hz=2.0)
    arrivals = arrivals_of(run)
    first = next(n for n, a in enumerate(arrivals) if a.m.sensor == "tags")
    begin = arrivals[first].true_ns - 6_000_000_000
    arrivals = [a for a in arrivals if begin <= a.true_ns < begin + 18_000_000_000]
    said, fed = said_while_waiting(run, arrivals)
    assert complaints(arrivals, fed) == []
    assert "a position: a fix, a match, a tag or a pose" in said
    assert said[-1] == ""
    assert fed.errors_m[-1] < 1.0


def test_without_an_imu_it_reports_what_it_waits_for() -> None:
    run = drift()
    sensors = {n: s for n, s in run.config.sensors.items() if n != "imu"}
    bare = replace(run, config=run.config.model_copy(update={"sensors": sensors}))
    arrivals = arrivals_of(run)[:1500]
    said, fed = said_while_waiting(bare, arrivals)
    assert said == ["an IMU: no enabled sensor of kind imu is configured"]
    assert complaints(arrivals, fed) == []


def test_a_second_imu_is_left_aside() -> None:
    run = drift()
    two = replace(run, config=run.config.model_copy(update={"sensors": {**run.config.sensors, "spare": ImuConfig()}}))
    arrivals = arrivals_of(run)[:900]
    spare = [
        replace(a, m=replace(a.m, sensor="spare", seq=a.m.seq + 1_000_000))
        for a in arrivals if isinstance(a.m, ImuSample)
    ]  # fmt: skip
    arrivals = sorted([*arrivals, *spare], key=lambda a: a.true_ns)
    _, fed = said_while_waiting(two, arrivals)
    assert complaints(arrivals, fed) == []
    assert {row.reason for row in fed.rows if row.sensor == "spare"} == {"imu is the IMU"}
    assert fed.estimates


# Odometry


def test_odom_does_not_jump_where_the_map_does() -> None:
    """Fixes come back after 34 s of dead reckoning: the map jumps by metres, odometry goes on as the vessel does."""
    scenario = replace(bl_scenario(1, "drift"), duration_s=54.0, outage_s=(10.0, 44.0), gyro_bias_radps=0.01)
    run = slowly(simulate(replace(scenario, imu_hz=50.0, gnss_hz=5.0, compass_hz=2.0), 2), 1.25)
    fed, _ = whole(run, arrivals_of(run))
    e = fed.estimates
    true = run.truth.at(stamps_of(e))
    map_jumps, nis = [], []
    for n in range(1, len(e)):
        step = true.R_world_body[n - 1].T @ (true.p_world_m[n] - true.p_world_m[n - 1])
        own = e[n - 1].R_odom_body.T @ (e[n].p_odom_m - e[n - 1].p_odom_m)
        mapped = e[n - 1].R_world_body.T @ (e[n].p_world_m - e[n - 1].p_world_m)
        map_jumps.append(float(np.linalg.norm((mapped - step)[:2])))
        off = e[n - 1].R_odom_body @ (own - step)
        nis.append(float(off[:2] @ np.linalg.solve(e[n].step_cov[:2, :2], off[:2])))
    assert max(map_jumps) > 1.0
    assert nis[int(np.argmax(map_jumps))] < chi2.ppf(0.99, 2)
    # Not 99 % of all: through an outage the error of a step is that of one velocity, so they are one draw, not three hundred.
    assert np.mean(np.array(nis) < chi2.ppf(0.99, 2)) > 0.9


# Memory


def sizes(online: OnlineSmoother) -> dict[str, int]:
    """Lengths of all containers inside, followed through the objects of this package."""
    found: dict[str, int] = {}
    seen: set[int] = set()

    def look(name: str, thing: object, depth: int) -> None:
        if id(thing) in seen or depth > 7:
            return
        seen.add(id(thing))
        if isinstance(thing, (list, dict, set)) or type(thing).__name__ == "deque":
            found[name] = len(thing)  # type: ignore[arg-type]
            if isinstance(thing, dict) and len(thing) < 20:
                for key, value in thing.items():
                    look(f"{name}.{key}", value, depth + 1)
        elif type(thing).__module__.startswith("graphloc.") and "config" not in type(thing).__module__:
            names = [*getattr(thing, "__dict__", {}), *getattr(type(thing), "__slots__", ())]
            for n in names:
                look(f"{name}.{n}", getattr(thing, n, None), depth + 1)
        elif isinstance(thing, np.ndarray):
            found[name] = len(np.atleast_1d(thing))

    look("online", online, 0)
    return found | {"slots": online.factor_slots}


def test_memory_does_not_grow() -> None:
    """Sensors at low rates and a short lag, so that a minute holds many lags: nothing is larger at its end than before."""
    scenario = replace(bl_scenario(2, "drift"), duration_s=50.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0)
    run = slowly(simulate(scenario, 1), RATE_HZ)
    online, arrivals = smoother(run, lag_s=3.0), arrivals_of(run)
    early: dict[str, int] = {}
    late: dict[str, int] = {}
    for n, a in enumerate(arrivals):
        feed(online, run, [a])
        if n % 120 == 0:
            t = (a.true_ns - arrivals[0].true_ns) * 1e-9
            if 14.0 < t < 28.0 or t > 36.0:
                largest = early if t < 30.0 else late
                for name, size in sizes(online).items():
                    largest[name] = max(size, largest.get(name, 0))
    full = (
        "scatter._pairs",
        "scatter._squares",
        "scatter._bent",
        "heading_check._steps",
        "heading_check._fixes.gnss",
        "._seen",
    )
    # fill up to their limit
    remembered = {name for name in early if name.endswith(full) or ".sensor_noise._pairs" in name}
    agreed = {name: size for name, size in late.items() if ".denials._agreed." in name}
    assert 40 < max(agreed.values()) <= 50
    remembered |= set(agreed)
    # 40 s: at most six pairs in five seconds
    assert max(size for name, size in late.items() if ".sensor_noise._pairs" in name) <= 54
    # 40 s: at the 2.5 Hz of states, at the 2 Hz of fixes
    assert late["online._persistent.heading_check._steps"] <= 101
    assert late["online._persistent.heading_check._fixes.gnss"] <= 83
    grown = {n: (early.get(n, 0), s) for n, s in late.items() if n not in remembered and s > 1.15 * early.get(n, 0) + 5}
    assert len(early) > 30
    assert grown == {}


def test_headings_and_fixes_faster_than_they_err_anew_are_thinned() -> None:
    """At 50 Hz: as if every third had come alone, with a row for each of the others."""
    scenario = replace(bl_scenario(1, "drift"), duration_s=7.5, imu_hz=50.0, gnss_hz=50.0, compass_hz=50.0)
    run = slowly(simulate(scenario, 0), RATE_HZ)
    fast = {kind: run.recording.of(kind) for kind in (CompassHeading, GnssPosition)}
    many = {m.seq for said in fast.values() for n, m in enumerate(said) if n % 3}
    fed, _ = whole(run, arrivals_of(run))
    alone, _ = whole(run, [a for a in arrivals_of(run) if a.m.seq not in many])
    assert complaints(arrivals_of(run), fed) == []
    thinned = [row for row in fed.rows if row.reason == THINNED]
    assert {row.seq for row in thinned} == many
    assert {row.outcome for row in thinned} == {Outcome.REJECTED}
    np.testing.assert_allclose(fed.errors_m, alone.errors_m, atol=1e-9)


# Prediction


def test_prediction_goes_as_far_as_the_imu_can_say() -> None:
    run, online = drift(), smoother(drift())
    assert online.predict() is None
    every = arrivals_of(run)
    arrivals = [a for a in every if a.true_ns < every[0].true_ns + 12_000_000_000]
    fed = feed(online, run, arrivals)
    newest, state = max(a.true_ns for a in arrivals), fed.estimates[-1]
    now, later = online.predict(), online.predict(newest + 2_000_000_000)
    assert now is not None
    assert later is not None
    assert now.stamp_ns == max(a.true_ns for a in arrivals if isinstance(a.m, ImuSample))
    off = now.p_world_m - run.truth.at(np.array([now.stamp_ns])).p_world_m[0]
    assert np.hypot(*off[:2]) < 1.0
    assert now.bound_95_m >= 0.99 * state.bound_95_m
    # 2 s of motion that nobody measured, 1 m/s^2 correlated over a second: sqrt(2^3 / 3) = 1.6 m more, 1 sigma.
    assert later.bound_95_m > 2.45 * np.sqrt(8.0 / 3.0)
    assert online.predict(newest + 60_000_000_000) is None
    before = online.predict(newest - 5_000_000_000)
    assert before is not None
    assert before.stamp_ns == state.stamp_ns
