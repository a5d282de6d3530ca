# SPDX-License-Identifier: Apache-2.0
"""LiDAR scans stamped by a clock that is off: the time is estimated with the run, is in the bounds, and is said where it is far off."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.config import AerialConfig, VesselConfig, load_config
from graphloc.eval.metrics import TruthMetrics, compare_to_truth
from graphloc.eval.report import Trust, verdict
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import KINDS
from graphloc.factors.aerial import ROW, slow
from graphloc.frontends._clock import ScanClock
from graphloc.frontends.aerial.live import Matched
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.gather import _matches, with_matches
from graphloc.graph import Decision
from graphloc.linear import factors_of
from graphloc.measurements import PoseFix
from graphloc.online._snapshot import Snapshot
from graphloc.recording import Recording
from graphloc.replay import replay
from graphloc.solution import Cause, Health, Solution
from graphloc.trajectory import Trajectory
from tests.bagfactory import START_NS, Messages, S, write_bag
from tests.faults import arrivals_of, feed
from tests.slowly import sparsely, with_few_states
from tests.test_factors import attachment, values_of
from tests.test_inspect import drive
from tests.test_inspect_sources import cloud
from tests.test_online_faults import setup_of, smoother

SCENARIO = Scenario(path="loops", noise="clean", false_fraction=0.0, gnss_hz=2.0, imu_hz=50.0, compass_hz=2.0)


@cache
def late(stamp_sigma_s: float, late_s: float, duration_s: float = 45.0) -> SimulatedRun:
    """A run with matches good to 0.2 m and 0.5 deg, each stamped `late_s` after its scan was taken."""
    run = sparsely(simulate(replace(SCENARIO, duration_s=duration_s), 3), 2)
    late_ns = round(late_s * 1e9)
    moved = [
        replace(m, stamp_ns=m.stamp_ns + late_ns) if isinstance(m, PoseFix) else m for m in run.recording.measurements
    ]
    recording = replace(run.recording, measurements=tuple(sorted(moved, key=lambda m: (m.stamp_ns, m.seq))))
    (name,) = run.config.of_kind("pose")
    config = run.config.with_sensors({name: AerialConfig(image_sigma_m=0.0, stamp_sigma_s=stamp_sigma_s)})
    return replace(run, recording=recording, config=with_few_states(config, 1.25))


@cache
def solved(stamp_sigma_s: float, late_s: float) -> app.Run:
    return app.simulated(late(stamp_sigma_s, late_s))


@cache
def replayed(stamp_sigma_s: float, late_s: float) -> Solution:
    run = late(stamp_sigma_s, late_s)
    return replay(run.recording, run.config).solution


def offline(stamp_sigma_s: float, late_s: float) -> Solution:
    return solved(stamp_sigma_s, late_s).solution


def measured(solution: Solution) -> TruthMetrics:
    return compare_to_truth(solution.trajectory, late(0.0, 0.0).truth)


def test_all_of_a_sensor_share_one_delay() -> None:
    process = slow(AerialConfig())
    assert process is not None
    assert process.axes == ("east", "north", "yaw", "late")
    assert process.late == 3
    assert process.sigma[3] == 0.05
    assert process.constant.all()
    untold = slow(AerialConfig(stamp_sigma_s=0.0))
    assert untold is not None
    assert untold.late is None


@pytest.mark.parametrize("axes", [("x", "y", "yaw"), ("x", "y"), ("yaw",)])
def test_the_jacobians_are_those_of_the_residual(axes: Any) -> None:
    """By place, turn and time, against differences of the residual itself; a match of fewer axes than the sensor's, too."""
    config = AerialConfig()
    at = attachment(ROW, config, tilt=0.0)
    assert at.slow_value is not None
    at = replace(at, slow_value=np.array([0.1, -0.2, 0.01, 0.07]))
    whole = ROW.ideal(at, config)
    assert isinstance(whole, PoseFix)
    picked = [whole.axes.index(axis) for axis in axes]
    mode = replace(whole.modes[0], value=whole.modes[0].value[picked], cov=whole.modes[0].cov[np.ix_(picked, picked)])
    m = replace(whole, axes=axes, modes=(mode,))
    (factor,) = factors_of(ROW, m, config, at, Decision()).factors
    found = factor.linearize(values_of(at, ()))
    residual = ROW.residuals(m, config, at)[0]
    assert residual.raw == pytest.approx(np.zeros(len(axes)), abs=1e-6)
    later = replace(at, slow_value=at.slow_value + np.array([0.0, 0.0, 0.0, 1e-4]))
    change = (ROW.residuals(m, config, later)[0].raw - residual.raw) / 1e-4
    spin = np.append(at.sensor_velocity_mps()[:2], (at.T_world_body.rotation().matrix() @ at.gyro_radps)[2])
    np.testing.assert_allclose(change, spin[picked], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.cholesky(residual.cov) @ found.jacobian()[0][:, -1], change, rtol=1e-3)


@pytest.mark.parametrize(("mode", "less"), [(offline, 0.3), (replayed, 0.75)], ids=["offline", "online"])
def test_late_scans_are_found_out(mode: Any, less: float) -> None:
    """Online the time becomes known only while the vessel turns."""
    believed, estimated = measured(mode(0.0, 0.15)), measured(mode(0.05, 0.15))
    assert believed.coverage_95 is not None
    assert estimated.coverage_95 is not None
    assert believed.coverage_95 < 0.8  # not less: what the delay does looks like biases that wander, so the bounds grow
    assert estimated.coverage_95 > 0.9
    assert estimated.position_rmse_m < less * believed.position_rmse_m


@pytest.mark.parametrize("mode", [offline, replayed], ids=["offline", "online"])
def test_scans_in_time_stay_where_they_are(mode: Any) -> None:
    believed, estimated = measured(mode(0.0, 0.0)), measured(mode(0.05, 0.0))
    assert estimated.position_rmse_m < believed.position_rmse_m + 0.01
    assert estimated.coverage_95 is not None
    assert estimated.coverage_95 > 0.9


def test_calibration_shows_what_the_track_has_taken() -> None:
    found = solved(0.05, 0.15)
    assert found.calibration is not None
    (name,) = found.config.of_kind("aerial")
    taken_s = found.solution.time_offsets_s[name]
    assert taken_s == pytest.approx(-0.15, abs=0.03)
    (line,) = (s for s in found.calibration.suggestions if s.key == f"sensors.{name}.time_offset_s")
    assert line.suggested == pytest.approx(-0.15, abs=0.03)
    assert line.action == "already corrected in the track, by stamp_sigma_s"


@pytest.mark.parametrize(("share", "with_care"), [(1.0, False), (1.0 / 3.0, True), (None, False)])
def test_the_report_says_what_the_track_lacks_of_a_delay(share: float | None, with_care: bool) -> None:
    found = solved(0.05, 0.15)
    (name,) = found.config.of_kind("aerial")
    offsets = {} if share is None else {name: share * found.solution.time_offsets_s[name]}
    assert found.solution.trajectory.cov is not None
    sure = replace(found.solution.trajectory, cov=1e-2 * found.solution.trajectory.cov)
    solution = replace(found.solution, time_offsets_s=offsets, trajectory=sure)
    tracks = verdict(app.report_data(replace(found, solution=solution))).tracks
    said = [reason.trust for reason in tracks[0].reasons if f"{name} and the IMU are" in reason.text]
    assert said == ([Trust.WITH_CARE] if with_care else [])


@pytest.mark.parametrize("mode", [offline, replayed], ids=["offline", "online"])
def test_a_clock_far_beyond_its_sigma_is_said_and_no_pose_is_good(mode: Any) -> None:
    found = mode(0.02, 0.15)
    # Online it is named as soon as it is clear, and again once it is twice as far.
    *_, said = (w for w in found.stats.warnings if "sigmas from its configured value: add -0." in w)
    assert ": time_offset_s is " in said
    assert float(said.split(": add ")[1].split(" ")[0]) == pytest.approx(-0.15, abs=0.05)
    last = found.health_reason[-1]
    # Beyond 6 sigmas what agrees only by that delay does not count as agreeing.
    assert last.cause is (Cause.SENSORS if mode is replayed else Cause.CONTRADICTION)
    assert "far off what stamp_sigma_s allows for" in last.text
    assert found.health[-1] is Health.DEGRADED
    right = mode(0.05, 0.0)
    assert not any("sigmas from where it is set" in w for w in right.stats.warnings)
    assert right.health[-1] is Health.GOOD


def test_scans_are_matched_around_the_track_of_when_they_were_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stamped 0.2 s late, a scan stamped at 10 s was taken where the vessel was at 9.8 s."""
    found = solved(0.05, 0.15)
    (name,) = found.config.of_kind("aerial")
    given: list[Any] = []

    def matched(*args: Any, **_: Any) -> list[Matched]:
        given.append(args[4])
        return []

    monkeypatch.setattr(_matches, "match_bag", matched)
    solution = replace(found.solution, time_offsets_s={name: -0.2})
    with_matches(found.recording, found.config, solution.datum, solution, app.Scans((), Path()))
    (around,) = given
    at = np.array([solution.trajectory.stamps_ns[20] + 200_000_000])
    np.testing.assert_allclose(around.at(at).p_world_m[0], solution.trajectory.p_world_m[20], atol=1e-9)


@pytest.mark.parametrize(
    ("ahead_s", "sigma_s", "said", "astray"),
    [
        (0.1, 0.05, "", False),
        (0.3, 0.05, "at least 0.30 s ahead of the IMU's: set time_offset_s (to -0.30 or less)", True),
        (0.3, 0.2, "", False),
        (-0.5, 0.05, "", False),
        (-0.8, 0.05, "0.80 s behind the IMU's, or its scans come as late", False),
    ],
)
def test_a_clock_that_recording_times_contradict_is_said(
    ahead_s: float, sigma_s: float, said: str, astray: bool
) -> None:
    config = AerialConfig(stamp_sigma_s=sigma_s)
    clock = ScanClock(ahead_s)
    assert said in clock.said("aerial", config)
    assert bool(clock.said("aerial", config)) == bool(said)
    assert clock.astray(config) == astray


def test_a_delay_that_was_found_goes_on_after_a_restart(tmp_path: Path) -> None:
    """And is given up where the configuration now has it, or none to estimate."""
    run, path = late(0.05, 0.15), tmp_path / "snapshot.json"
    came = arrivals_of(run)
    feed(smoother(run, snapshot=path), run, came[: 3 * len(came) // 4])
    (name,) = run.config.of_kind("aerial")
    snapshot = Snapshot.read(path, "imu")
    assert snapshot.anchor.slow[name].value[-1] < -0.07
    sensor = run.config.sensors[name]
    found = {}
    for key, change in (("on", {}), ("set", {"time_offset_s": -0.15}), ("exact", {"stamp_sigma_s": 0.0})):
        copy = tmp_path / f"{key}.json"
        copy.write_bytes(path.read_bytes())
        other = replace(run, config=run.config.with_sensors({name: sensor.model_copy(update=change)}))
        online = smoother(other, snapshot=copy)
        fed = feed(online, other, came[3 * len(came) // 4 :][: len(came) // 40])
        said = [e for e in fed.events if "snapshot" in e]
        found[key] = said[0], name in snapshot.for_settings(setup_of(other.config).settings).anchor.slow
    assert found["on"][0].startswith("resumed from a snapshot")
    assert found["on"][1]
    assert found["set"][0].startswith("resumed from a snapshot")
    assert not found["set"][1]
    assert found["exact"][0].startswith("resumed from a snapshot")
    assert not found["exact"][1]


MAKE = Messages(2)


def scanned(tmp_path: Path, late_s: float) -> tuple[Recording, VesselConfig, str, list[str]]:
    """A drive with a LiDAR whose scans, recorded 0.1 s after they are taken, are stamped so late; as drafted with a map, and with sigma 0.05 s."""
    items = [*drive(MAKE, seconds=20)]
    for k in range(20):
        taken_ns = START_NS + k * S
        items.append(("/points", taken_ns + S // 10, cloud(MAKE, taken_ns + round(late_s * 1e9), "mast")))
    path = write_bag(tmp_path / "run", MAKE, sorted(items, key=lambda item: item[1]), "mcap")
    text = draft_config(inspect_bag(path))
    (tmp_path / "vessel.yaml").write_text(text)
    config = load_config(tmp_path / "vessel.yaml", KINDS)
    on = config.sensors["aerial"].model_copy(update={"enabled": True})
    usual = on.model_copy(update={"stamp_sigma_s": 0.05, "time_offset_s": 0.0})
    return (
        read_recording(path, config.with_sensors({"aerial": usual})),
        config,
        text,
        [w for w in read_recording(path, config.with_sensors({"aerial": on})).warnings if "clock of its LiDARs" in w],
    )


@pytest.mark.parametrize(
    ("late_s", "drafted", "offset_s", "doubted"),
    [
        (0.0, 0.05, 0.0, False),
        (0.1, 0.05, 0.0, False),
        (0.5, 0.4, 0.0, True),
        (-0.8, 0.9, 0.0, False),
        (3.0, 0.15, -2.9, True),
    ],
)
def test_a_clock_that_is_not_the_recorders_is_drafted_and_beside_a_smaller_sigma_no_pose_is_good(
    late_s: float, drafted: float, offset_s: float, doubted: bool, tmp_path: Path
) -> None:
    recording, config, text, said = scanned(tmp_path, late_s)
    aerial = config.sensors["aerial"]
    assert isinstance(aerial, AerialConfig)
    assert aerial.stamp_sigma_s == pytest.approx(drafted, abs=0.011)
    assert aerial.time_offset_s == pytest.approx(offset_s, abs=0.011)
    assert ("by the recording times their clock is" in text) == (drafted != 0.05)
    assert not said
    assert bool(recording.clock_doubts) == doubted
    assert any("clock of its LiDARs" in w for w in recording.warnings) == (drafted != 0.05)


@pytest.mark.parametrize("mode", ["offline", "online"])
def test_no_pose_is_good_beside_a_clock_in_doubt(mode: str) -> None:
    run = late(0.05, 0.0, 15.0)
    recording = replace(run.recording, clock_doubts=("aerial: by the recording times",))
    done = app.smooth_recording if mode == "offline" else app.replay_recording
    found = done(recording, run.config).solution
    assert Health.GOOD not in found.health
    assert "aerial: by the recording times" in {reason.text for reason in found.health_reason}


@pytest.mark.parametrize(("late_s", "sigma_s", "said"), [(0.3, 0.05, True), (0.3, 0.15, False), (0.0, 0.05, False)])
def test_matches_that_turn_later_than_the_vessel_are_said(late_s: float, sigma_s: float, said: bool) -> None:
    """Headings good to 0.1 deg, one in ten false by 20 deg, beside a track that turns by 5 deg to and fro."""
    rng, t = np.random.default_rng(4), np.arange(0.0, 120.0, 0.1)
    yaw = np.radians(5.0) * np.sin(2.0 * np.pi * t / 15.0) + 0.02 * t
    track = Trajectory(
        stamps_ns=START_NS + np.rint(t * S).astype(np.int64),
        p_world_m=np.zeros((len(t), 3)),
        R_world_body=Rotation.from_euler("z", yaw[:, None]).as_matrix(),
    )
    taken_s = np.arange(2.0, 118.0)
    stamps_ns = START_NS + np.rint((taken_s + late_s) * S).astype(np.int64)
    wrong = np.where(rng.uniform(size=len(taken_s)) < 0.1, np.radians(20.0), 0.0)
    turn = (
        np.interp(taken_s, t, yaw)
        - np.interp(taken_s + late_s, t, yaw)
        + rng.normal(0.0, np.radians(0.1), len(taken_s))
    )
    lines = _matches.late_turns("aerial", AerialConfig(stamp_sigma_s=sigma_s), track, stamps_ns, turn + wrong + 0.01)
    assert bool(lines) == said
    for line in lines:
        assert line.startswith(f"aerial: its matches turn as the vessel does {-late_s:+.2f} +- 0.0")
