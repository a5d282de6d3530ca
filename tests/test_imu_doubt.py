# SPDX-License-Identifier: Apache-2.0
"""An IMU that goes wrong for a while: whom to believe, and what becomes of its samples."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from types import ModuleType, SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc import app
from graphloc.config import ImuConfig
from graphloc.errors import SolveError
from graphloc.eval.metrics import TrackErrors, errors
from graphloc.factors.imu import ROW
from graphloc.frames import Array
from graphloc.inertial import GapMotion
from graphloc.judge import wrong_imu
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, ImuSample, ImuSeries, Measurement
from graphloc.online import _lag
from graphloc.online._imu_doubt import Denials, ImuDoubt, turns_otherwise
from graphloc.online._lag import Lag
from graphloc.online._tracking import Tracking
from graphloc.recording import Recording, quiet
from graphloc.solution import Health, Solution
from graphloc.solve import _first_solution
from graphloc.solve._start import Begun
from tests import test_online_faults as faults
from tests.faults import Arrivals, Fed, arrivals_of, complaints, feed, finish
from tests.slowly import slowly, sparsely
from tests.test_online_faults import at_s

S = 1_000_000_000
RATE_HZ = 2.5  # of states: with fewer, what the IMU is blamed for is not told in 4 s
run_of, begun = partial(faults.run_of, rate_hz=RATE_HZ), partial(faults.begun, rate_hz=RATE_HZ)
Change = Callable[[Measurement], Measurement]


def changed(change: Change, from_s: float = 12.0, until_s: float = 16.0, length_s: float = 26.0) -> Arrivals:
    """The run with what came in a span changed."""
    arrivals = arrivals_of(run_of(length_s=length_s))
    begin = arrivals[0].true_ns
    inside = [from_s <= (a.true_ns - begin) / S < until_s for a in arrivals]
    return [replace(a, m=change(a.m)) if n else a for a, n in zip(arrivals, inside, strict=True)]


def in_degrees(m: Measurement) -> Measurement:
    return replace(m, gyro_radps=np.degrees(m.gyro_radps)) if isinstance(m, ImuSample) else m


def axes_swapped(m: Measurement) -> Measurement:
    if not isinstance(m, ImuSample):
        return m
    return replace(m, gyro_radps=m.gyro_radps[[1, 0, 2]] * [1, 1, -1], accel_mps2=m.accel_mps2[[1, 0, 2]])


def in_g(m: Measurement) -> Measurement:
    return replace(m, accel_mps2=m.accel_mps2 / 9.81) if isinstance(m, ImuSample) else m


def biased(m: Measurement) -> Measurement:
    return replace(m, gyro_radps=m.gyro_radps + np.array([0.0, 0.0, 0.3])) if isinstance(m, ImuSample) else m


def blamed(fed: Fed) -> int:
    return sum("contradicts the other sensors, which agree" in event for event in fed.events)


@pytest.mark.parametrize("change", [in_degrees, biased])
def test_an_imu_that_goes_wrong_is_left_out_until_it_is_right_again(change: Change) -> None:
    arrivals = changed(change)
    online, fed = begun(12.0)
    finish(online, feed(online, run_of(), arrivals[at_s(arrivals, 12.0) :], fed))
    assert complaints(arrivals, fed) == []
    assert blamed(fed) == 1
    assert fed.worst_m() < 4.0
    begin = arrivals[0].true_ns
    assert fed.worst_m(begin + 18 * S) < 1.0
    left_out = [r for r in fed.rows if r.sensor == "imu" and r.outcome is Outcome.REJECTED]
    assert left_out
    assert all(begin + 12 * S < r.stamp_ns < begin + 18 * S for r in left_out)
    during = [e.health for e in fed.estimates if left_out[0].stamp_ns < e.stamp_ns < left_out[-1].stamp_ns]
    assert during
    assert Health.GOOD not in during


def compass_off(m: Measurement) -> Measurement:
    return replace(m, yaw_rad=m.yaw_rad + 1.0) if isinstance(m, CompassHeading) else m


def compass_turns(m: Measurement) -> Measurement:
    """As a vessel may, by 0.8 rad in 4 s."""
    if not isinstance(m, CompassHeading):
        return m
    return replace(m, yaw_rad=m.yaw_rad + 0.2 * ((m.stamp_ns - 1_700_000_000 * S) / S - 12.0))


def fixes_off(m: Measurement) -> Measurement:
    if not isinstance(m, GnssPosition):
        return m
    return replace(m, position=m.position._replace(latitude_deg=m.position.latitude_deg + 8e-5))  # 9 m


def both_off(m: Measurement) -> Measurement:
    return fixes_off(compass_off(m))


@pytest.mark.parametrize("change", [compass_turns, fixes_off, both_off])
def test_sensors_that_no_motion_explains_are_not_believed_against_the_imu(change: Change) -> None:
    arrivals = changed(change)
    online, fed = begun(12.0)
    finish(online, feed(online, run_of(), arrivals[at_s(arrivals, 12.0) :], fed))
    assert blamed(fed) == 0
    assert not [r for r in fed.rows if r.sensor == "imu" and r.outcome is Outcome.REJECTED]


@pytest.mark.parametrize(
    ("where", "guard", "value"), [(wrong_imu, "_MOTION", 0.0), (_lag, "_EXPLAINED", 1.1)], ids=["motion", "explained"]
)
def test_it_is_left_out_only_where_a_motion_of_a_vessel_explains_the_denials(
    where: ModuleType, guard: str, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No motion is quiet enough, or no share of what denied large enough: then the estimate of the IMU stands."""
    arrivals = changed(axes_swapped)
    monkeypatch.setattr(where, guard, value)
    online, _ = begun(12.0)
    assert blamed(feed(online, run_of(), arrivals[at_s(arrivals, 12.0) : at_s(arrivals, 15.5)])) == 0


def smoothed(
    change: Change, from_s: float = 12.0, until_s: float = 16.0, rate_hz: float = 0.625, length_s: float = 20.0
) -> tuple[Solution, Recording, TrackErrors]:
    """The same offline."""
    run = sparsely(slowly(run_of(length_s=length_s), rate_hz), 2)
    samples = [a.m for a in changed(change, from_s, until_s, length_s) if isinstance(a.m, ImuSample)]
    assert run.recording.imu is not None
    imu = replace(
        run.recording.imu,
        accel_mps2=np.array([m.accel_mps2 for m in samples]),
        gyro_radps=np.array([m.gyro_radps for m in samples]),
    )
    begin = int(imu.stamps_ns[0])
    others = [change(m) if from_s * S <= m.stamp_ns - begin < until_s * S else m for m in run.recording.measurements]
    recording = replace(run.recording, imu=imu, measurements=tuple(others))
    solution = app.smooth_recording(recording, run.config).solution
    return solution, recording, errors(solution.trajectory, run.truth)


@pytest.mark.parametrize("change", [axes_swapped, in_g])
def test_offline_it_is_left_out_where_it_is_wrong(change: Change) -> None:
    solution, recording, off = smoothed(change, rate_hz=1.25, length_s=26.0)
    assert np.linalg.norm(off.position_m[:, :2], axis=1).max() < 1.0
    assert np.abs(off.heading_rad).max() < np.radians(8.0)
    (said,) = (w for w in solution.stats.warnings if "contradicts the other sensors, which agree" in w)
    assert recording.imu is not None
    stamps_ns = np.array([r.stamp_ns for r in solution.ledger if r.sensor == "imu" and r.outcome is Outcome.REJECTED])
    left_out_s = (stamps_ns - recording.imu.stamps_ns[0]) / S
    assert f"{len(left_out_s)} samples rejected" in said
    assert 10.0 < left_out_s.min() < 12.5
    assert left_out_s.max() < 18.0
    assert np.ptp(left_out_s) > 2.0  # axes that are swapped contradict nothing while little moves


def test_offline_it_is_found_in_the_first_window() -> None:
    """Aligned to rates that are wrong there, the run ended 122 m and 180 deg off, and took 15 times as long."""
    solution, _, off = smoothed(in_degrees, 6.0, 9.0, length_s=14.0)
    assert np.linalg.norm(off.position_m[:, :2], axis=1).max() < 1.0
    assert np.abs(off.heading_rad).max() < np.radians(8.0)
    assert any("contradicts the other sensors, which agree" in w for w in solution.stats.warnings)


def test_offline_it_is_not_blamed_for_a_compass_that_is_wrong_at_the_start() -> None:
    """45 deg for 9 s, as beside a crane: samples of 19 s were left out, and the heading was 47 deg off."""

    def beside_a_crane(m: Measurement) -> Measurement:
        return replace(m, yaw_rad=m.yaw_rad + np.pi / 4.0) if isinstance(m, CompassHeading) else m

    solution, _, off = smoothed(beside_a_crane, 0.0, 9.0)
    assert not any("contradicts the other sensors, which agree" in w for w in solution.stats.warnings)
    assert np.abs(off.heading_rad).max() < np.radians(1.0)
    assert np.linalg.norm(off.position_m[:, :2], axis=1).max() < 0.5


@pytest.mark.parametrize(("excess", "told"), [(1.5, False), (3.0, False), (3.0, True)])
def test_offline_the_start_is_in_doubt_only_where_it_contradicts_itself(
    excess: float, *, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where no start without a sensor explains that. Without these conditions a right IMU was left out, and the run 9 m and 87 deg off."""
    none: Any = None
    begun = Begun(gtsam.Values(), none, 0, 0, 1, np.zeros(1), none, excess)
    seen = []

    def grow(*_: object, doubt_start: bool, **__: object) -> int:
        seen.append(doubt_start)
        raise SolveError("seen")

    monkeypatch.setattr(_first_solution, "align", lambda _: None)
    monkeypatch.setattr(_first_solution, "solve_start", lambda *_, **__: begun)
    monkeypatch.setattr(_first_solution, "_begun_without_a_sensor", lambda *_: begun if told else None)
    monkeypatch.setattr(_first_solution, "_doubt_at_once", lambda *_: None)
    monkeypatch.setattr(_first_solution, "grow", grow)
    few: Any = SimpleNamespace(problem=None)
    with pytest.raises(SolveError, match="seen"):
        _first_solution._begin(few, few, quiet, newest=False, doubt_imu=True)  # noqa: SLF001
    assert seen == [excess > 2.5 and not told]


def test_offline_a_gyroscope_that_warms_up_is_not_left_out_but_its_bias_walks_faster() -> None:
    """From 1.5 deg/s, by half in a minute: samples of most of the run were left out."""
    run = sparsely(slowly(run_of(length_s=75.0), 1.25))
    imu = run.recording.imu
    assert imu is not None
    t_s = (imu.stamps_ns - imu.stamps_ns[0]) / S
    off = np.radians(1.5) * 2.0 ** (-t_s / 60.0)
    warm = replace(imu, gyro_radps=imu.gyro_radps + off[:, None] * [0.4, -0.5, 0.75])
    solution = app.smooth_recording(replace(run.recording, imu=warm), run.config).solution
    assert not [r for r in solution.ledger if r.sensor == "imu" and r.outcome is Outcome.REJECTED]
    assert any("is taken" in w and "gyro_bias_instability" in w for w in solution.stats.warnings)
    found = errors(solution.trajectory, run.truth)
    assert np.linalg.norm(found.position_m[:, :2], axis=1).max() < 1.0
    assert np.abs(found.heading_rad).max() < np.radians(3.0)


@pytest.mark.parametrize("change", [compass_turns, both_off])
def test_offline_it_is_not_blamed_for_others(change: Change) -> None:
    solution, *_ = smoothed(change, until_s=18.0)
    assert not any("contradicts the other sensors, which agree" in w for w in solution.stats.warnings)


def test_a_trial_that_explains_nothing_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    arrivals = changed(in_degrees)
    arrivals = arrivals[at_s(arrivals, 12.0) : at_s(arrivals, 15.0)]

    def estimates() -> Array:
        online, fed = begun(12.0)
        finish(online, feed(online, run_of(), arrivals, fed))
        assert blamed(fed) == 0
        return np.array([e.p_world_m for e in fed.estimates])

    tried = []

    def nothing(*_: object) -> bool:
        tried.append(1)
        return False

    monkeypatch.setattr(Lag, "explained", nothing)
    after_trials = estimates()
    assert tried
    monkeypatch.setattr(Tracking, "doubt_imu", lambda *_: None)
    assert np.array_equal(after_trials, estimates())


SIZES = count()


def grown() -> float:
    """The size of a residual: each is larger than the one before."""
    return 2.0 ** next(SIZES)


def test_what_is_off_by_the_same_has_jumped() -> None:
    """Heading and place of one receiver do so together."""
    for grows in (False, True):
        denials = Denials()
        for n in range(5):
            size = 50.0 + 45.0 * n * grows
            denials.note("compass", n * S // 5, size, agrees=False, outlier=False)
            denials.note("gnss", n * S // 5, size, agrees=False, outlier=False)
        assert bool(denials.at_once(S)) == grows


def test_denials_count_in_a_row_and_at_once() -> None:
    denials = Denials()
    for n in range(5):
        denials.note("gnss", n * S // 4, grown(), agrees=False, outlier=False)
    assert not denials.at_once(S)  # a single sensor is itself in doubt
    denials.note("compass", S // 2, grown(), agrees=False, outlier=False)
    assert not denials.at_once(S)
    denials.note("compass", S, grown(), agrees=False, outlier=False)
    assert denials.at_once(S) == {"gnss": 0, "compass": S // 2}
    assert not denials.at_once(3 * S)  # a while ago
    denials.note("compass", 2 * S, grown(), agrees=True, outlier=False)
    assert not denials.at_once(2 * S)


def test_sensors_that_were_wrong_before_do_not_count() -> None:
    """A compass of the wrong sense denies a right gyroscope as often as not."""
    for wrong in (2, 4):
        denials = Denials()
        for n in range(10):
            denials.note("compass", n * S, grown(), agrees=n % 10 >= wrong, outlier=False)
        for n in range(5):
            for sensor in ("compass", "gnss"):
                denials.note(sensor, 10 * S + n * S // 5, grown(), agrees=False, outlier=False)
        assert bool(denials.at_once(11 * S)) == (wrong == 2)


def test_what_a_matcher_denied_long_ago_does_not_count_for_or_against() -> None:
    denials = Denials()
    for n in (0, 20, 21):
        denials.note("matcher", n * S, grown(), agrees=False, outlier=True)
    for n in range(5):
        denials.note("gnss", 20 * S + n * S // 5, grown(), agrees=False, outlier=False)
    assert denials.at_once(21 * S) == {"gnss": 20 * S, "matcher": 20 * S}


def test_the_longer_an_imu_is_wrong_the_longer_it_is_left_out() -> None:
    doubt, denied, lengths = ImuDoubt(), 10 * S, []
    for _ in range(6):
        now = denied + S
        since = doubt.suspected({"gnss": denied, "compass": denied}, now)
        assert since is not None
        doubt.leave_out(since, now)
        lengths.append((doubt.gaps[-1][1] - now) / S)
        assert doubt.leaves_out(now)
        assert doubt.suspected({"gnss": denied, "compass": denied}, now) is None
        denied = doubt.gaps[-1][1] + S
    assert lengths == [0.5, 1.0, 2.0, 4.0, 4.0, 4.0]
    # Each follows the one before: the samples between are as wrong.
    assert doubt.gaps == [(10 * S - 300_000_000, doubt.gaps[-1][1])]
    over = doubt.gaps[-1][1]
    assert not doubt.ended(over + 9 * S)
    assert doubt.ended(over + 11 * S)
    assert not doubt.ended(over + 12 * S)
    doubt.leave_out(over + 20 * S, over + 21 * S)
    assert doubt.gaps[-1] == (over + 20 * S, over + 21 * S + S // 2)


def test_rates_that_turn_otherwise() -> None:
    stamps = np.arange(0, S + 1, S // 50)
    rates = np.tile([0.0, 0.0, 0.2], (len(stamps), 1))
    turned = gtsam.Rot3.Expmap(np.array([0.0, 0.0, 0.2])).matrix()
    assert not turns_otherwise(stamps, rates, turned)
    assert not turns_otherwise(stamps, rates + np.array([0.0, 0.0, 0.5]), turned)  # a vessel in a gap may
    assert turns_otherwise(stamps, rates + np.array([0.0, 0.0, 0.7]), turned)
    assert turns_otherwise(stamps, rates[:, [2, 1, 0]] * 5.0, turned)


def test_samples_that_are_left_out_are_a_gap_however_short() -> None:
    stamps = np.arange(0, 10 * S, S // 100)
    samples = np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 0.1], (len(stamps), 1))
    wrong = (stamps > 5 * S) & (stamps <= 5 * S + S // 4)
    samples[wrong, 5] = 7.0
    imu = ImuSeries(
        sensor="imu",
        stamps_ns=stamps,
        accel_mps2=samples[:, :3],
        gyro_radps=samples[:, 3:],
        seqs=np.arange(len(stamps)),
    )
    links, bias = ROW.link(imu, ImuConfig(), np.eye(3), 9.81), gtsam.imuBias.ConstantBias()

    def turn(from_ns: int, to_ns: int) -> tuple[float, float]:
        pim = links.integrate(from_ns, to_ns, bias, GapMotion(bias, np.zeros(3)))
        return float(gtsam.Rot3.Logmap(pim.deltaRij())[2]), float(np.sqrt(pim.preintMeasCov()[2, 2]))

    assert turn(5 * S, 6 * S)[0] == pytest.approx(0.1 + 6.9 * 0.25, abs=0.1)
    links.leave_out(5 * S, 5 * S + S // 4)
    angle, sigma = turn(5 * S, 5 * S + S // 4)
    assert angle == pytest.approx(0.025, abs=1e-3)
    assert sigma == pytest.approx(0.2 * 0.5, rel=0.1)  # 0.2 rad/s, white, over a quarter of a second
    assert turn(4 * S, 5 * S)[1] < 0.01
    assert links.gaps() == [(5 * S, 5 * S + S // 4 + S // 100)]
    # It goes on: of the two, the longer stands; what follows is not known yet.
    links.leave_out(5 * S, 20 * S)
    assert links.gaps() == [(5 * S, 20 * S)]
    assert turn(11 * S, 12 * S)[1] == pytest.approx(0.2, rel=0.1)
    links.extend(np.array([20 * S + S // 100]), samples[:1])
    assert links.gaps() == [(5 * S, 20 * S + S // 100)]
    links.forget(21 * S)
    assert links.gaps() == []
