# SPDX-License-Identifier: Apache-2.0
"""What is seen of a moving dock says where the vessel is beside the dock, and nothing of where both are."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.config import VesselConfig
from graphloc.estimate import Estimate
from graphloc.eval.simulate import SimulatedRun, find_scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array
from graphloc.measurements import Measurement, TagSighting
from graphloc.online import OnlineSmoother
from graphloc.online._anchor import without_priors
from graphloc.online._lag import Lag
from graphloc.recording import Recording
from graphloc.replay import arrivals, replay
from graphloc.solution import Solution
from graphloc.trajectory import Trajectory
from tests import tagfactory
from tests.faults import copied
from tests.slowly import with_few_states


@cache
def docking() -> SimulatedRun:
    """Without GNSS: place by the dock's tags (which moves by 0.3 m), height by that and the tide."""
    less = {"imu_hz": "50", "gnss_hz": "2", "compass_hz": "2", "lidar_hz": "0", "camera_hz": "0"}
    true = simulate(find_scenario("dock-floating-optimal", {**less, "duration_s": "33", "route_s": "45"}), 1)
    run, _ = tagfactory.sighted(true, rate_hz=2.0)
    kept = tuple(m for m in run.recording.measurements if m.sensor != "gnss")
    config = with_few_states(run.config)
    return replace(run, recording=replace(run.recording, measurements=kept), config=config)


@cache
def recorded() -> Recording:
    """The docking with its tide."""
    run = docking()
    return app.with_synthetic(run.recording, run.config, app.choose_datum(run.recording, run.config))


@cache
def followed() -> Solution:
    """The docking as the online mode follows it."""
    run = docking()
    return replay(recorded(), run.config, datum=app.choose_datum(run.recording, run.config)).solution


def sigmas_m(track: Trajectory, k: int) -> Array:
    assert track.cov is not None
    return np.asarray(np.sqrt(np.diagonal(track.cov[k])[:3]))


def test_the_last_pose_is_known_as_well_as_to_the_batch_and_no_better() -> None:
    """At the end both know the same; on the way it is never lost, and the IMU is not blamed."""
    run = docking()
    datum, replayed = app.choose_datum(run.recording, run.config), followed()
    offline, online = app.solve(recorded(), run.config, datum).trajectory, replayed.trajectory
    k = int(np.searchsorted(offline.stamps_ns, online.stamps_ns[-1]))
    assert sigmas_m(online, -1) == pytest.approx(sigmas_m(offline, k), rel=0.05)
    assert (np.abs(online.p_world_m[-1] - offline.p_world_m[k]) < 0.5 * sigmas_m(offline, k)).all()
    assert sigmas_m(online, -1)[2] > 0.3  # a tide and a dock of 0.5 m each
    off_m = np.linalg.norm(online.p_world_m - run.truth.at(online.stamps_ns).p_world_m, axis=1)
    assert off_m.max() < 1.5
    assert not any("restarts" in line or "contradicts" in line for line in replayed.stats.events)


def test_what_is_seen_in_a_hole_of_the_imu_leads_nowhere() -> None:
    """It tells of the state before: written as news of the nearest, it was news again each time, and the track 56 m off."""
    run, recording = docking(), recorded()
    imu = recording.imu
    assert imu is not None
    since_s = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    heard = (since_s < 15.3) | (since_s >= 17.3)
    holed = replace(recording, imu=imu.where(heard))
    replayed = replay(holed, run.config, datum=app.choose_datum(recording, run.config)).solution
    track = replayed.trajectory
    off_m = np.linalg.norm(track.p_world_m - run.truth.at(track.stamps_ns).p_world_m, axis=1)
    assert off_m.max() < 1.5
    assert not any("restarts" in line or "failed" in line for line in replayed.stats.events)


def test_tags_that_come_late_are_the_place_of_a_batch() -> None:
    """The first of them 10.7 s after the begin, and nothing else that tells a place: all were rejected, and the run 800 m off."""
    run = docking()
    solved = app.smooth_recording(run.recording, run.config).solution
    assert solved.ledger.counts()["tags"].keys() == {"used"}
    off_m = np.linalg.norm(solved.trajectory.p_world_m - run.truth.at(solved.trajectory.stamps_ns).p_world_m, axis=1)
    assert off_m[-1] < 1.0


FAILS_S, UNTIL_S = 29.0, 31.0


def came(from_s: float, until_s: float) -> list[Measurement]:
    """What arrives of the docking in a span."""
    begin_ns = docking().truth.stamps_ns[0]
    return [m for m in arrivals(recorded()) if from_s <= (m.stamp_ns - begin_ns) * 1e-9 < until_s]


def until_it_fails(config: VesselConfig) -> OnlineSmoother:
    online = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL, mounts=recorded().mounts)
    for m in came(-np.inf, FAILS_S):
        online.feed(m)
    assert not any("rebuilt" in event.text for event in online.events())
    return online


def two_seconds_later(online: OnlineSmoother, monkeypatch: pytest.MonkeyPatch, *, fails: bool) -> Estimate:
    """The last estimate, of a solver that fails, or not, at their begin."""
    whole, estimates = Lag.commit, list[Estimate]()

    def once(self: Lag, **_options: bool) -> None:
        monkeypatch.setattr(Lag, "commit", whole)
        raise RuntimeError("planted")

    if fails:
        monkeypatch.setattr(Lag, "commit", once)
    for m in came(FAILS_S, UNTIL_S):
        if (estimate := online.feed(m)) is not None:
            estimates.append(estimate)
    assert any("rebuilt" in event.text for event in online.events()) == fails
    return estimates[-1]


def test_a_rebuild_does_not_make_it_surer(monkeypatch: pytest.MonkeyPatch) -> None:
    """What closes the chains of dock and tide is no news a second time."""
    estimate, track = (
        two_seconds_later(until_it_fails(docking().config), monkeypatch, fails=True),
        followed().trajectory,
    )
    k = int(np.searchsorted(track.stamps_ns, estimate.stamp_ns))
    assert track.stamps_ns[k] == estimate.stamp_ns
    assert np.sqrt(np.diagonal(estimate.cov)[:3]) == pytest.approx(sigmas_m(track, k), rel=0.1)


def test_nor_where_tags_are_surveyed_to_half_a_metre(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they are is known together with the position; taken for known apart, they made it 0.18 instead of 0.33 m."""
    config = docking().config
    tags = config.sensors["tags"]
    listed = [tag.model_copy(update={"sigma_m": 0.5}) for tag in tags.survey.tags]
    unsure = tags.model_copy(update={"survey": tags.survey.model_copy(update={"tags": listed})})
    config = config.with_sensors({"tags": unsure})
    online = until_it_fails(config)
    whole, again = (
        two_seconds_later(one, monkeypatch, fails=fails).cov for one, fails in ((copied(online), False), (online, True))
    )
    assert np.sqrt(np.diagonal(again)[:3]) == pytest.approx(np.sqrt(np.diagonal(whole)[:3]), rel=0.1)


def test_a_prior_that_is_taken_out_was_never_there() -> None:
    rng = np.random.default_rng(1)
    half = rng.normal(size=(6, 6))
    info, pull = np.asarray(half @ half.T + np.eye(6)), rng.normal(size=6)
    variance = np.array([np.inf, np.inf, 0.5, np.inf, 2.0, np.inf])
    closed = info + np.diag(1.0 / variance)
    mean, cov = without_priors(np.asarray(np.linalg.solve(closed, pull)), np.asarray(np.linalg.inv(closed)), variance)
    assert mean == pytest.approx(np.linalg.solve(info, pull))
    assert cov == pytest.approx(np.linalg.inv(info))


def test_what_cannot_be_followed_is_taken_back() -> None:
    """A camera's mount half a turn off: all sightings agree among themselves, and the solver that tries them runs away.

    It did not come back by itself: places 10^19 m off were given out.
    """
    less = {"imu_hz": "50", "gnss_hz": "2", "compass_hz": "4", "lidar_hz": "0", "camera_hz": "0"}
    true = simulate(find_scenario("dock-fixed-optimal", {**less, "duration_s": "18", "route_s": "60"}), 11)
    run, _ = tagfactory.sighted(true, rate_hz=2.0, farthest_m=60.0, noise_px=0.3)
    turn = Rotation.from_euler("z", 180.0, degrees=True).as_matrix()
    measurements = tuple(
        replace(m, R_body_camera=m.R_body_camera @ turn) if isinstance(m, TagSighting) else m
        for m in run.recording.measurements
    )
    config = with_few_states(run.config)
    replayed = app.replay_recording(replace(run.recording, measurements=measurements), config)
    track = replayed.solution.trajectory
    off_m = np.linalg.norm(track.p_world_m - run.truth.at(track.stamps_ns).p_world_m, axis=1)
    assert off_m.max() < 5.0
    assert any(line == "tags: 100 % of its measurements disagree with the rest" for line in replayed.warnings)
    (line,) = (line for line in replayed.warnings if "camera camera: by its tags its viewing direction" in line)
    assert float(line.split("direction is ")[1].split()[0]) == pytest.approx(180.0, abs=5.0)
