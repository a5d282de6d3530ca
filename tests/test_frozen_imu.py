# SPDX-License-Identifier: Apache-2.0
"""An IMU that says one sample again and again is named and not believed, from a bag and as it comes; what only looks so is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphloc import app
from graphloc.config import DatumConfig
from graphloc.errors import SolveError
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import inspect_bag, render
from graphloc.ledger import Outcome
from graphloc.measurements import ImuSample
from graphloc.online import OnlineSmoother
from graphloc.replay import replay
from graphloc.signals.frozen_imu import FrozenImuDetector, frozen_samples
from tests.bagfactory import START_NS, Item, Messages, S, write_bag
from tests.faults import Arrival, Arrivals, arrivals_of, complaints, feed, finish
from tests.slowly import simulate_slowly
from tests.test_bag_bad_input import accounted, rows_of, vessel

MAKE = Messages(2)
HZ = 100
STAMPS = START_NS + np.arange(10 * HZ) * (S // HZ)


def readings(seed: int = 3) -> Array:
    """(N, 6) of a craft that turns, with noise."""
    return np.array([0.1, -0.2, 9.8, 0.01, -0.02, 0.3]) + 0.01 * np.random.default_rng(seed).normal(
        size=(len(STAMPS), 6)
    )


def frozen(samples: Array, first: int, last: int) -> Array:
    samples = samples.copy()
    samples[first + 1 : last + 1] = samples[first]
    return samples


def as_it_comes(samples: Array) -> list[bool]:
    watch = FrozenImuDetector()
    return [
        watch.repeats(ImuSample(stamp_ns=int(s), sensor="imu", seq=k, accel_mps2=row[:3], gyro_radps=row[3:]))
        for k, (s, row) in enumerate(zip(STAMPS, samples, strict=True))
    ]


def test_all_but_the_first_of_a_stretch_are_none_and_as_they_come_all_from_a_fifth_of_a_second_on() -> None:
    samples = frozen(frozen(readings(), 200, 300), 700, len(STAMPS) - 1)
    assert np.flatnonzero(frozen_samples(STAMPS, samples)).tolist() == [*range(201, 301), *range(701, len(STAMPS))]
    assert np.flatnonzero(as_it_comes(samples)).tolist() == [*range(220, 301), *range(720, len(STAMPS))]


def test_frozen_rates_alone_are_detected_after_a_second() -> None:
    samples = readings()
    samples[200:500, 3:] = samples[200, 3:]
    assert np.flatnonzero(frozen_samples(STAMPS, samples)).tolist() == [*range(201, 500)]
    assert np.flatnonzero(as_it_comes(samples)).tolist() == [*range(300, 500)]
    samples[280:500, 3:] = 0.0  # a deadband at rest
    assert not frozen_samples(STAMPS, samples).any()
    assert not any(as_it_comes(samples))


@pytest.mark.parametrize(
    "case", ["noise", "held by a driver", "one axis moves", "no noise, at rest", "coarse, at rest"]
)
def test_what_only_looks_so_is_believed(case: str) -> None:
    samples = readings()
    if case == "held by a driver":  # that publishes at 100 Hz what is measured at 10 Hz
        samples = np.repeat(samples[::10], 10, axis=0)
    elif case == "one axis moves":
        samples[:, :5] = samples[0, :5]
    elif case == "no noise, at rest":
        samples = np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 0.0], (len(samples), 1))
    elif case == "coarse, at rest":  # steps of three times the noise
        samples = np.round(samples / 0.03) * 0.03
        assert (samples[1:] == samples[:-1]).all(axis=1).any()
    assert not frozen_samples(STAMPS, samples).any()
    assert not any(as_it_comes(samples))


@pytest.mark.parametrize("step_radps", [0.01, np.radians(0.2)])
def test_a_gyroscope_that_a_driver_rounds_is_believed_when_it_stands(step_radps: float) -> None:
    """It shakes for 5 s, then stands: noise of a tenth of a step leaves one triple of rates, while the accelerometer goes on."""
    samples, rng = readings(), np.random.default_rng(5)
    shakes = np.where(np.arange(len(STAMPS)) < 5 * HZ, 2.0, 0.1)[:, None] * step_radps
    true = 0.02 * step_radps + np.array([1.0, -2.0, 3.0]) * step_radps + shakes * rng.normal(size=(len(STAMPS), 3))
    samples[:, 3:] = np.round(true / step_radps) * step_radps
    assert (samples[5 * HZ :, 3:] == samples[-1, 3:]).all(), "5 s of one triple, though nothing is frozen"
    assert not frozen_samples(STAMPS, samples).any()
    assert not any(as_it_comes(samples))
    assert not any(as_it_comes(samples[::-1])), "it stands when it is switched on, too"
    assert frozen_samples(STAMPS, frozen(samples, 700, 800)).sum() == 100, "frozen in all six axes it is found"
    assert sum(as_it_comes(frozen(samples, 700, 800))) == 81
    samples[:, 3:] = true
    samples[5 * HZ :, 3:] = true[5 * HZ]
    assert frozen_samples(STAMPS, samples).sum() == 5 * HZ - 1, "unrounded, the rates alone tell"


def test_an_imu_that_repeats_from_the_start_is_frozen() -> None:
    samples = np.zeros((len(STAMPS), 6))
    assert frozen_samples(STAMPS, samples).sum() == len(samples) - 1
    assert sum(as_it_comes(samples)) == len(samples) - 20


def bag(path: Path, samples: Array) -> Path:
    items: list[Item] = [
        ("/imu", int(s), MAKE.imu(int(s), row[:3], row[3:])) for s, row in zip(STAMPS, samples, strict=True)
    ]
    return write_bag(path, MAKE, items, "mcap")


def test_a_bag_reports_where_its_imu_was_frozen(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", frozen(readings(), 200, 500))
    recording = read_recording(path, vessel(gnss=None))
    assert recording.message_count == accounted(recording)
    rows = rows_of(recording, "imu")
    assert len(rows) == 300
    assert all(r.outcome is Outcome.REJECTED and "frozen" in r.reason for r in rows)
    (line,) = (w for w in recording.warnings if "frozen" in w)
    assert "for 3.0 s from 2023-11-14T22:13:22" in line
    assert "for 3.0 s from 2023-11-14T22:13:22" in render(inspect_bag(path))


def test_a_bag_whose_imu_is_frozen_throughout_is_refused_with_the_cause(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", frozen(readings(), 0, len(STAMPS) - 1))
    datum = DatumConfig(latitude_deg=57.7, longitude_deg=11.9, height_m=40.0)
    config = vessel(gnss=None).model_copy(update={"datum": datum})
    recording = read_recording(path, config)
    for solve in (app.smooth_recording, replay):
        with pytest.raises(SolveError, match=r"999 of its messages gave nothing.*frozen"):
            solve(recording, config)
    assert any("frozen" in w for w in inspect_bag(path).warnings)


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate_slowly(
        Scenario(path="loops", duration_s=40.0, noise="clean", false_fraction=0.0, gnss_hz=2.0, compass_hz=2.0), 12
    )


def struck(run: SimulatedRun, begin_s: float, end_s: float) -> Arrivals:
    """Its IMU is frozen between two times."""
    arrivals: Arrivals = []
    held: ImuSample | None = None
    for a in arrivals_of(run):
        m, at_s = a.m, (a.true_ns - int(run.truth.stamps_ns[0])) * 1e-9
        if isinstance(m, ImuSample) and begin_s <= at_s < end_s:
            held = held or m
            m = replace(m, accel_mps2=held.accel_mps2, gyro_radps=held.gyro_radps)
        arrivals.append(Arrival(a.true_ns, m))
    return arrivals


def test_online_it_counts_as_silent(run: SimulatedRun) -> None:
    """Believed, it would carry the craft along a circle for 4 s, metres off, and call that good."""
    arrivals = struck(run, 20.0, 24.0)
    online = OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL)
    fed = finish(online, feed(online, run, arrivals))
    assert complaints(arrivals, fed) == []
    (event,) = (e for e in fed.events if "frozen" in e)
    assert "imu" in event
    lost = [row for row in fed.rows if "frozen" in row.reason]
    assert 370 < len(lost) < 400
    assert fed.worst_m(arrivals[0].true_ns + 10 * S) < 1.0
