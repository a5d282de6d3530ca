# SPDX-License-Identifier: Apache-2.0
"""A truth on another clock is told by how the vessel moves, and what would put it right is named."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.eval.report import Trust, verdict
from graphloc.eval.simulate import Scenario
from graphloc.eval.truth_clock import clock_apart
from graphloc.frames import Array
from graphloc.frontends.bag import read_recording
from graphloc.trajectory import Trajectory
from tests.bagfactory import START_NS as BAG_NS
from tests.bagfactory import Messages, still_run, write_bag
from tests.slowly import simulate_slowly
from tests.test_bag import vessel

START_NS = 1_700_000_000_000_000_000


def moved(t: Array) -> Array:
    """(N, 2) m: a boat that turns this way and that, and never twice alike."""
    return np.column_stack(
        [2.0 * t + 9.0 * np.sin(t / 7.0) + 4.0 * np.sin(t / 3.3 + 1.0), 14.0 * np.cos(t / 9.1) + 3.0 * np.sin(t / 2.7)]
    )


def track_of(first_s: float, last_s: float, rate_hz: float, noise_mps: float = 0.0, seed: int = 0) -> Trajectory:
    t = np.arange(first_s, last_s, 1.0 / rate_hz)
    rng = np.random.default_rng(seed)
    velocity = (moved(t + 1e-4) - moved(t - 1e-4)) / 2e-4 + noise_mps * rng.normal(size=(len(t), 2))
    return Trajectory(
        stamps_ns=START_NS + np.rint(t * 1e9).astype(np.int64),
        p_world_m=np.column_stack([moved(t), np.zeros(len(t))]),
        R_world_body=np.tile(np.eye(3), (len(t), 1, 1)),
        v_world_mps=np.column_stack([velocity, np.zeros(len(t))]),
    )


def later(truth: Trajectory, by_s: float) -> Trajectory:
    return replace(truth, stamps_ns=truth.stamps_ns + round(by_s * 1e9))


@pytest.mark.parametrize("by_s", [18.0, -37.0, 1.0, 0.73, 7200.0, -1e8])
def test_what_its_stamps_lack_is_named(by_s: float) -> None:
    """Stamped late by 18 s, 18 s are to be taken off, a whole number; so also of clocks that share no time."""
    track, truth = track_of(0.0, 200.0, 10.0, 0.05), track_of(3.0, 190.0, 20.0, 0.01, 1)
    found = clock_apart(track, later(truth, by_s))
    assert found is not None
    assert found.add_s == pytest.approx(-by_s, abs=0.03)
    assert (found.stamped_mps is None) is (abs(by_s) > 200.0)
    said = found.said("/mocap", 5.0)
    lacks = re.search(r"set truth_time_offset_s: (-?[\d.]+)$", said)
    assert lacks
    assert float(lacks[1]) == pytest.approx(5.0 - by_s, abs=0.03 if by_s == 0.73 else 0.0)
    told = re.search(r"does ([\d.]+) s (earlier|later) ", said)
    assert told
    assert float(told[1]) == pytest.approx(abs(by_s), abs=0.03)
    assert (told[2] == "earlier") is (by_s > 0.0)


@pytest.mark.parametrize("by_s", [0.0, 0.3])
def test_nothing_is_said_of_one_that_fits_as_stamped(by_s: float) -> None:
    track, truth = track_of(0.0, 200.0, 10.0, 0.05), track_of(3.0, 190.0, 20.0, 0.01, 1)
    assert clock_apart(track, later(truth, by_s)) is None


@pytest.mark.parametrize(("by_s", "of_clock"), [(0.8, False), (18.0, True)])
def test_a_second_may_be_a_sensor_that_is_late(by_s: float, of_clock: bool) -> None:
    apart = clock_apart(track_of(0.0, 200.0, 10.0, 0.05), later(track_of(3.0, 190.0, 20.0, 0.01, 1), by_s))
    assert apart is not None
    assert apart.of_clock is of_clock
    assert ("time_offset_s` of gnss" in apart.said("/truth", 0.0)) is not of_clock


def test_nothing_is_said_where_the_motion_does_not_show_it() -> None:
    """At rest; on a straight course; on rounds of a minute, which are alike a minute later; of a track that goes elsewhere."""
    track = track_of(0.0, 200.0, 10.0)
    t = (track.stamps_ns - START_NS) * 1e-9
    rng = np.random.default_rng(2)
    for velocity in (
        np.zeros((len(t), 3)),
        np.tile([2.0, 1.0, 0.0], (len(t), 1)),
        2.0 * np.column_stack([np.cos(t * np.pi / 30), np.sin(t * np.pi / 30), np.zeros(len(t))]),
    ):
        one, other = (replace(track, v_world_mps=velocity + 0.05 * rng.normal(size=velocity.shape)) for _ in range(2))
        assert clock_apart(one, other) is None
    assert clock_apart(one, later(other, 18.0)) is None  # it was said to be 78 s, or any other number of rounds
    assert track.v_world_mps is not None
    turned = Rotation.from_euler("z", 70.0, degrees=True).apply(track.v_world_mps)
    assert clock_apart(track, later(replace(track, v_world_mps=turned), 18.0)) is None


def test_too_little_time_in_common_tells_nothing() -> None:
    """25 s of truth on another clock; and a span of days between two poses."""
    track = track_of(0.0, 200.0, 10.0)
    assert clock_apart(track, later(track_of(50.0, 75.0, 10.0), 18.0)) is None
    far = later(track, 18.0)
    assert clock_apart(track, replace(far, stamps_ns=np.append(far.stamps_ns[:-1], far.stamps_ns[-1] + 10**16))) is None


def test_a_run_says_so_of_its_truth() -> None:
    """The truth of a run on a clock that is off by most of the run, and the same put right."""
    by_s = 40.0
    quick = Scenario(
        path="loops", duration_s=60.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0
    )
    run = simulate_slowly(quick, 78)
    late = app.smooth_recording(replace(run.recording, truth=later(run.truth, by_s)), run.config)
    (said,) = (w for w in late.warnings if "truth_time_offset_s" in w)
    named = re.search(r"^/truth: .* set truth_time_offset_s: (-?[\d.]+)$", said)
    assert named
    assert float(named[1]) == pytest.approx(-by_s, abs=0.1)
    (track,) = verdict(app.report_data(late)).tracks
    assert any("truth is on another clock" in reason.text for reason in track.reasons)
    assert not any(reason.trust is Trust.NO for reason in track.reasons)
    assert clock_apart(late.solution.trajectory, run.truth) is None
    # Of the online track, whose velocities are too noisy to show it, 'do not rely on it' was said: the truth were an antenna 43 m astern.
    solution, data = late.solution, app.report_data(late)
    v = solution.trajectory.v_world_mps
    assert v is not None
    noisy = replace(solution.trajectory, v_world_mps=v + np.random.default_rng(0).normal(size=v.shape))
    assert clock_apart(noisy, later(run.truth, by_s)) is None
    online = replace(solution, trajectory=noisy, stats=replace(solution.stats, online=True))
    table = replace(data.tables[0], rows=(*data.tables[0].rows, ("graphloc online", data.tables[0].rows[0][1])))
    beside = verdict(replace(data, online=online, tables=(table,))).tracks[1]
    assert any("truth is on another clock" in reason.text for reason in beside.reasons)
    assert beside.trust is not Trust.NO


def test_the_stamps_of_the_truth_are_put_right(tmp_path: Path) -> None:
    make = Messages(2)
    items = [*still_run(make), *(("/truth", t, make.odometry(t)) for t in range(BAG_NS, BAG_NS + 4 * 10**9, 10**8))]
    path = write_bag(tmp_path / "run", make, sorted(items, key=lambda i: i[1]))
    truth = read_recording(path, vessel(truth_topic="/truth").model_copy(update={"truth_time_offset_s": -18.25})).truth
    assert truth is not None
    assert truth.stamps_ns[0] == BAG_NS - 18_250_000_000
