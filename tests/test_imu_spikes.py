# SPDX-License-Identifier: Apache-2.0
"""One or two readings of an IMU that leap away and back are rejected, from a bag and as they come; a real knock is not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphloc.eval.simulate import find_scenario
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array, wrap_angle
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import inspect_bag, render
from graphloc.ledger import Outcome
from graphloc.measurements import ImuSample
from graphloc.online import OnlineSmoother
from graphloc.online._intake import ImuIntake
from graphloc.signals.imu_spikes import SpikeDetector, spikes
from tests.bagfactory import START_NS, S
from tests.faults import arrivals_of, complaints, feed, finish, numbered
from tests.slowly import simulate_slowly
from tests.test_bag_bad_input import accounted, rows_of, vessel
from tests.test_frozen_imu import STAMPS, bag, readings


def as_they_come(samples: Array) -> list[int]:
    """Numbers of the samples that the detector of the online mode rejects; each comes out of it once, in order."""
    watch, right, wrong = SpikeDetector(), list[int](), list[int]()
    for k, (stamp, row) in enumerate(zip(STAMPS, samples, strict=True)):
        good, bad = watch.take(
            ImuSample(stamp_ns=int(stamp), sensor="imu", seq=k, accel_mps2=row[:3], gyro_radps=row[3:])
        )
        right += [m.seq for m in good]
        wrong += [m.seq for m in bad]
    right += [m.seq for m in watch.let_go()]
    assert right == sorted(right)
    assert sorted(right + wrong) == list(range(len(samples)))
    return wrong


def leaping(at: dict[int, float], axis: int = 5) -> Array:
    samples = readings()
    for k, by in at.items():
        samples[k, axis] += by
    return samples


@pytest.mark.parametrize(
    "samples",
    [leaping({300: 2.0, 500: -9.0}), leaping({300: 60.0, 500: -50.0}, axis=1), leaping({300: 2.0, 500: -1.0}) - 5.0],
    ids=["rate", "force", "about another mean"],
)
def test_a_reading_that_leaps_away_and_back_is_a_spike(samples: Array) -> None:
    assert np.flatnonzero(spikes(STAMPS, samples)).tolist() == as_they_come(samples) == [300, 500]


def test_two_in_a_row_are_and_three_are_none() -> None:
    two, three = leaping({300: 2.0, 301: 3.0}), leaping({300: 2.0, 301: 2.0, 302: 2.0})
    assert np.flatnonzero(spikes(STAMPS, two)).tolist() == as_they_come(two) == [300, 301]
    assert not spikes(STAMPS, three).any()
    assert as_they_come(three) == []


def test_what_a_vessel_does_is_none() -> None:
    """A turn that begins at once; a knock that dies away; leaps on a shaking engine that all its samples make; small ones."""
    turning = readings()
    turning[400:, 5] += 2.0
    knocked = readings()
    knocked[400:440, 5] += 3.0 * np.exp(-np.arange(40) / 5.0) * np.cos(np.arange(40))
    shaking = readings() + np.random.default_rng(1).normal(size=(len(STAMPS), 6)) * np.repeat([20.0, 1.0], 3)
    small = leaping({300: 0.4})
    for samples in (turning, knocked, shaking, small):
        assert not spikes(STAMPS, samples).any()
        assert as_they_come(samples) == []


def test_spikes_again_and_again_are_motion() -> None:
    """A robot that walks: an impact of one sample every half second. Four among 200 samples are rejected, and no more."""
    walking = leaping(dict.fromkeys(range(100, 1000, 50), 3.0))
    found = np.flatnonzero(spikes(STAMPS, walking)).tolist()
    assert found == as_they_come(walking) == [100, 150, 200, 250]


def test_a_clock_that_is_set_back_while_one_is_held_is_seen() -> None:
    """All samples were dropped until the new clock had come to the one that was held."""
    samples = leaping({100: 3.0})
    stamps = STAMPS.copy()
    stamps[101:] -= 100 * S
    intake, set_back_s, seen = ImuIntake(0.2, floats=True), 0.0, list[int]()
    for k, (stamp, row) in enumerate(zip(stamps[:300], samples, strict=False)):
        m = ImuSample(stamp_ns=int(stamp), sensor="imu", seq=k, accel_mps2=row[:3], gyro_radps=row[3:])
        taken = intake.take(m, started=True)
        set_back_s = max(set_back_s, taken.set_back_s)
        seen += [m.seq for m in taken.accepted] + [m.seq for m, _ in taken.dropped]
        for accepted in taken.accepted:
            intake.accept(accepted)
    assert set_back_s > 99.0
    assert sorted(seen) == list(range(300))


def test_of_a_slow_imu_nothing_is_judged() -> None:
    """At 25 Hz a slam of 60 ms is one sample."""
    stamps = START_NS + np.arange(len(STAMPS)) * (S // 25)
    assert not spikes(stamps, leaping({300: 2.0})).any()
    assert not spikes(stamps, leaping({300: 60.0}, axis=2)).any()


def test_beside_a_gap_nothing_is_judged() -> None:
    samples = leaping({300: 2.0})
    stamps = STAMPS + np.where(np.arange(len(STAMPS)) > 300, 10**9, 0)
    assert not spikes(stamps, samples).any()


def test_a_bag_reports_them_and_inspect_too(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", leaping({300: 2.0, 500: 4.0}))
    recording = read_recording(path, vessel(gnss=None))
    assert recording.message_count == accounted(recording)
    rows = rows_of(recording, "imu")
    assert [r.stamp_ns for r in rows if "spike" in r.reason and r.outcome is Outcome.REJECTED] == STAMPS[
        [300, 500]
    ].tolist()
    assert any("2 samples rejected" in w and "spike" in w for w in recording.warnings)
    assert "2 samples rejected" in render(inspect_bag(path))


def test_single_rates_do_not_turn_the_track() -> None:
    """Four of 2 rad/s, among 2400 samples: online the heading was up to 1.8 deg off, now 0.4."""
    run = simulate_slowly(find_scenario("bl1-drift", {"duration_s": "24"}), 3)
    imu = run.recording.imu
    assert imu is not None
    gyro = imu.gyro_radps.copy()
    gyro[[1300, 1600, 1900, 2200], 2] += 2.0
    spiked = replace(run, recording=replace(run.recording, imu=replace(imu, gyro_radps=gyro)))
    arrivals = numbered(arrivals_of(spiked))
    smoother = OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL)
    fed = finish(smoother, feed(smoother, spiked, arrivals))
    yaw = np.array([e.yaw_rad for e in fed.estimates])
    true = run.truth.at(np.array([e.stamp_ns for e in fed.estimates])).yaw_rad
    assert np.degrees(np.abs(wrap_angle(yaw - true))).max() < 1.0
    assert complaints(arrivals, fed) == []
    assert sum("spike" in row.reason for row in fed.rows) == 4
    assert sum("spike" in event for event in fed.events) == 1
