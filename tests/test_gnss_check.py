# SPDX-License-Identifier: Apache-2.0
"""GNSS that stands apart from poses all the while is said; a slow error that comes and goes is not."""

import re
from dataclasses import replace

import numpy as np
import pytest

from graphloc import app
from graphloc.eval.gnss_check import _mean_variance, gnss_offsets
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.frames import Array, Datum, Geodetic
from graphloc.measurements import GnssPosition, Measurement, PoseFix
from graphloc.recording import Recording
from graphloc.solution import Health
from graphloc.trajectory import Trajectory
from tests.bagfactory import S
from tests.slowly import simulate_slowly, sparsely

SIGMA_M, LASTING_S = 2.0, 200.0
DATUM = Datum(Geodetic(57.7, 11.7, 36.0))


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    scenario = Scenario(
        path="loops", duration_s=60.0, noise="clean", false_fraction=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0
    )
    return sparsely(simulate_slowly(scenario, 21, rate_hz=1.25), 2)


def said(
    run: SimulatedRun, east_north_m: Array, every_s: int = 1, up_m: float = 0.0, **antennas_off_m: Array
) -> list[str]:
    """What is said of a GNSS error (N, 2) at each fix beside a craft that lies still, with 0.3 m of white noise on it."""
    off = east_north_m + 0.3 * np.random.default_rng(1).normal(size=east_north_m.shape)
    n = len(off)
    stamps = int(run.truth.stamps_ns[0]) + np.arange(n) * every_s * S
    track = Trajectory(
        stamps_ns=stamps[0] + np.arange(n + 1) * every_s * S, p_world_m=np.zeros((n + 1, 3)), R_world_body=np.tile(np.eye(3), (n + 1, 1, 1))
    )  # fmt: skip
    lever = run.config.sensors["gnss"].mount.t_body_sensor_m
    lla = DATUM.geodetic_from_enu(lever + np.column_stack([off, np.full(n, up_m)]))
    unit = np.eye(3)
    fixes = tuple(
        GnssPosition(stamp_ns=int(t), sensor="gnss", seq=k, position=Geodetic(*map(float, lla[k])), cov_enu_m2=unit)
        for k, t in enumerate(stamps)
    )
    pose = run.recording.of(PoseFix)[0]
    recording = replace(run.recording, measurements=(pose, *fixes))
    return [str(offset) for offset in gnss_offsets(track, DATUM, recording, run.config, antennas_off_m)]


def process(rng: np.random.Generator, lasts_s: int, every_s: int) -> Array:
    """(N, 2) m: the slow error that the configuration allows for."""
    keep = np.exp(-every_s / LASTING_S)
    d = [rng.normal(0.0, SIGMA_M, 2)]
    for _ in range(lasts_s // every_s - 1):
        d.append(keep * d[-1] + rng.normal(0.0, SIGMA_M * np.sqrt(1.0 - keep**2), 2))
    return np.array(d)


@pytest.mark.parametrize(("lasts_s", "every_s"), [(60, 1), (300, 1), (1200, 6)])
def test_the_process_itself_is_seldom_blamed(lasts_s: int, every_s: int, run: SimulatedRun) -> None:
    """One run in twenty at most, but for what 200 draws scatter by; and the mean scatters as is said."""
    rng = np.random.default_rng(lasts_s)
    drawn = [process(rng, lasts_s, every_s) for _ in range(200)]
    means = np.array([d.mean(axis=0) for d in drawn])
    assert float((means**2).mean()) == pytest.approx(_mean_variance(SIGMA_M, LASTING_S, lasts_s), rel=0.2)
    assert np.mean([bool(said(run, d, every_s)) for d in drawn]) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / len(drawn))


def test_what_comes_or_jumps_is_an_error_of_the_receiver(run: SimulatedRun) -> None:
    jumped = np.zeros((300, 2))
    jumped[100:] = [9.0, 0.0]
    assert said(run, jumped) == []
    assert said(run, np.linspace([0.0, 0.0], [14.0, 0.0], 300)) == []


def test_a_fix_or_two_are_no_steady_distance(run: SimulatedRun) -> None:
    """A mean of one hardly moves, and tells nothing."""
    assert said(run, np.tile([8.0, 0.0], (1, 1))) == []
    assert said(run, np.tile([8.0, 0.0], (15, 1))) == []
    assert len(said(run, np.tile([8.0, 0.0], (60, 1)))) == 1


def test_a_height_above_the_geoid_beside_one_above_the_ellipsoid_is_reported(run: SimulatedRun) -> None:
    (line,) = said(run, np.zeros((60, 2)), up_m=-36.0)
    assert "gnss has a constant offset of 36.0 m (down) from height" in line  # matches tell none
    assert "geoid" in line
    assert said(run, np.zeros((60, 2)), up_m=12.0) == []  # its slow error in height is 5 m, 1 sigma


def test_an_antenna_that_is_found_elsewhere_is_no_offset(run: SimulatedRun) -> None:
    """A mast of 36 m was said to be the geoid, and one ahead, on a straight course, a wrong map."""
    off_m = np.array([8.0, 0.0, 36.0])
    assert len(said(run, np.tile(off_m[:2], (60, 1)), up_m=36.0)) == 2
    assert said(run, np.tile(off_m[:2], (60, 1)), up_m=36.0, gnss=off_m) == []


def with_poses_off(run: SimulatedRun, east_m: float, north_m: float) -> Recording:
    """The recording with all poses elsewhere."""
    moved: list[Measurement] = []
    for m in run.recording.measurements:
        if isinstance(m, PoseFix):
            modes = tuple(
                replace(
                    mode, value=np.asarray(mode.value) + np.array([east_m, north_m, *[0.0] * (len(mode.value) - 2)])
                )
                for mode in m.modes
            )
            moved.append(replace(m, modes=modes))
        else:
            moved.append(m)
    return replace(run.recording, measurements=tuple(moved))


def test_poses_all_off_by_five_metres_are_reported(run: SimulatedRun) -> None:
    """3 m east and 4 m north: the receiver is said to stand 5 m off the other way, west and south."""
    recording = with_poses_off(run, 3.0, 4.0)
    for solved in (app.smooth_recording(recording, run.config), app.replay_recording(recording, run.config)):
        lines = [w for w in solved.recording.warnings if "constant offset" in w]
        found = re.search(r"gnss has a constant offset of (\d\.\d) m \(towards (\d+) deg\) from matcher", lines[0])
        assert found
        assert float(found[1]) == pytest.approx(5.0, abs=0.3)
        assert float(found[2]) == pytest.approx(180.0 + np.degrees(np.arctan2(3.0, 4.0)), abs=4.0)
    assert not [w for w in app.smooth_recording(run.recording, run.config).recording.warnings if "constant offset" in w]


def test_no_pose_is_good_beside_a_receiver_that_is_far_off_all_the_while(run: SimulatedRun) -> None:
    """A tag that hangs 26 m from where its survey has it drew the track along, and half of the poses were called good."""
    solved = app.smooth_recording(with_poses_off(run, 26.0, 0.0), run.config).solution
    assert Health.GOOD not in solved.health


def test_no_pose_is_good_online_beside_a_receiver_that_agrees_only_by_an_error_that_it_hardly_has(
    run: SimulatedRun,
) -> None:
    """That it does not agree any more was said after ten seconds."""
    solved = app.replay_recording(with_poses_off(run, 26.0, 0.0), run.config).solution
    followed = solved.trajectory.p_world_m[:, 0] - run.truth.at(solved.trajectory.stamps_ns).p_world_m[:, 0] > 20.0
    assert followed.any()
    assert not any(h is Health.GOOD for h, f in zip(solved.health, followed, strict=True) if f)
