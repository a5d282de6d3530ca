# SPDX-License-Identifier: Apache-2.0
"""Fixes, poses and matches whose stated sigmas are too small: they are taken as they scatter from one to the next."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from graphloc import app, origin
from graphloc.build import make_problem
from graphloc.config import GnssConfig, PoseConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array, Geodetic
from graphloc.graph import Residual
from graphloc.judge.sensor_noise import Pair, Step, times_stated
from graphloc.measurements import GnssPosition, Measurement, PoseFix
from graphloc.online import OnlineSmoother
from graphloc.online._noise import ImuNoise
from graphloc.online._persistent import PersistentState
from graphloc.online._scatter import Scatter
from graphloc.online._sensor_noise import SensorNoise
from graphloc.online._snapshot import Snapshot
from graphloc.replay import arrivals, replay
from graphloc.solve.batch import solve_batch
from graphloc.time import stamps_of
from tests.faults import Fed, arrivals_of, feed
from tests.slowly import simulate_slowly
from tests.test_factors import attachment

SECOND = 1_000_000_000


def stating(run: SimulatedRun, kind: type[Measurement], share: float) -> SimulatedRun:
    """The run, whose fixes or matches state only a share of their sigmas."""

    def less(m: Measurement) -> Measurement:
        if not isinstance(m, kind):
            return m
        if isinstance(m, GnssPosition):
            return replace(m, cov_enu_m2=share**2 * m.cov_enu_m2)
        assert isinstance(m, PoseFix)
        return replace(m, modes=tuple(replace(mode, cov=share**2 * mode.cov) for mode in m.modes))

    recording = run.recording.changed(less)
    return replace(run, recording=recording)


def matched(seed: int, duration_s: float = 40.0, rate_hz: float = 2.5, gnss_hz: float = 5.0) -> SimulatedRun:
    """BL's case 1 with matches of 0.3 m, 40 % of them false, and GNSS that drifts."""
    scenario = replace(
        bl_scenario(1, "drift"), duration_s=duration_s, pose_hz=4.0, imu_hz=50.0, gnss_hz=gnss_hz, compass_hz=2.0
    )
    return simulate_slowly(scenario, seed, rate_hz)


@dataclass(frozen=True)
class Followed:
    """A run whose matches state a third of their noise, what the online mode made of it, and the last snapshot."""

    run: SimulatedRun
    fed: Fed
    snapshot: Snapshot


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Followed:
    run = stating(matched(2, 34.0), PoseFix, 1 / 3)
    path = tmp_path_factory.mktemp("followed") / "snapshot.json"
    fed = feed(OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL, snapshot=path), run, arrivals_of(run))
    return Followed(run, fed, Snapshot.read(path, "imu"))


def pairs_of(residuals: Array, sigma: float, false_sigma: float = 5.0, key: str = "sigma_scale") -> list[Pair]:
    """Of residuals (N, k) with a stated sigma."""
    k = residuals.shape[1]
    stated = 2.0 * sigma**2 * np.eye(k)
    error = false_sigma**2 * np.eye(k)
    return [(Step(key, step, stated, error),) for step in np.diff(residuals, axis=0)]


@pytest.mark.parametrize("times", [1.0, 3.0, 8.0])
def test_the_factor_is_that_of_the_right_ones(times: float) -> None:
    """Of 200, a third is false, in rows that repeat their error; and all share one that drifts away by metres."""
    rng = np.random.default_rng(4)
    residuals = rng.normal(0.0, 0.1 * times, (200, 2)) + np.linspace(0.0, 5.0, 200)[:, None]
    for first in range(0, 200, 15):
        residuals[first : first + 5] += rng.normal(0.0, 3.0, 2)
    found = times_stated(pairs_of(residuals, 0.1))
    assert found == ({} if times == 1.0 else {"sigma_scale": pytest.approx(times, rel=0.15)})


@pytest.mark.parametrize("turned_deg", [0.0, 5.0, 30.0])
@pytest.mark.parametrize("far_m", [(0.7, 2.0), (1.5, 5.0), (5.0, 20.0)])
def test_false_ones_of_any_size_make_no_noise_of_right_ones(far_m: tuple[float, float], turned_deg: float) -> None:
    """40 % are false, in rows; sigmas of 0.1 to 0.6 m and 1 deg, as stated: errors between two sizes that are looked for are no noise."""
    rng = np.random.default_rng(6)
    for sigma in (0.1, 0.3, 0.6):
        for _ in range(4):
            length, angle = rng.normal(0.0, sigma, (100, 2)), rng.normal(0.0, 1.0, (100, 1))
            for first in range(0, 100, 5):
                bearing = rng.uniform(0.0, 2.0 * np.pi)
                length[first : first + 2] += rng.uniform(*far_m) * np.array([np.cos(bearing), np.sin(bearing)])
                angle[first : first + 2] += rng.uniform(-turned_deg, turned_deg)
            angles = pairs_of(angle, 1.0, key="angle_sigma_scale")
            assert times_stated([a + b for a, b in zip(pairs_of(length, sigma), angles, strict=True)]) == {}


def test_few_steps_and_false_ones_alone_tell_nothing() -> None:
    rng = np.random.default_rng(5)
    assert times_stated(pairs_of(rng.normal(0.0, 1.0, (15, 2)), 0.1)) == {}
    assert times_stated(pairs_of(rng.normal(0.0, 3.5, (100, 2)), 0.01)) == {}


def test_matches_that_state_a_third_of_their_noise_are_taken_as_they_scatter() -> None:
    right = matched(1, 30.0, 1.25, gnss_hz=2.0)
    run = stating(right, PoseFix, 1 / 3)
    solved, as_stated = (app.smooth_recording(r.recording, r.config).solution for r in (run, right))
    found, best = (compare_to_truth(s.trajectory, run.truth) for s in (solved, as_stated))
    (said,) = (w for w in solved.stats.warnings if "scatter more than they state" in w)
    assert said.startswith("matcher: ")
    scales = [float(scale) for scale in re.findall(r"scale: ([0-9.]+)", said)]
    assert scales == [pytest.approx(3.0, rel=0.3)] * 2
    assert found.position_rmse_m < 1.2 * best.position_rmse_m + 0.01
    assert found.nees is not None
    assert found.nees < 4.0
    assert not [w for w in as_stated.stats.warnings if "scatter" in w]
    weights = [row.weight for row in solved.ledger if row.sensor == "matcher"]
    assert np.mean([w is not None and w > 0.5 for w in weights]) == pytest.approx(
        0.6, abs=0.15
    )  # what is right of them


def test_online_matches_that_state_a_third_are_taken_as_they_scatter_from_then_on(followed: Followed) -> None:
    told = [line for line in followed.fed.events if "matcher: its measurements scatter more" in line]
    assert 1 <= len(told) <= 2
    assert not [line for line in followed.fed.events if "IMU" in line]
    truth = followed.run.truth
    late = [e for e in followed.fed.estimates if e.stamp_ns > truth.stamps_ns[0] + 25 * SECOND]
    assert len(late) > 18
    off = np.array([e.p_world_m for e in late]) - truth.at(stamps_of(late)).p_world_m
    nees = np.mean([d @ np.linalg.solve(e.cov[:2, :2], d) for d, e in zip(off[:, :2], late, strict=True)])
    assert nees < 4.0


def test_online_the_kernel_of_fixes_is_found_anew_by_their_new_sigma(monkeypatch: pytest.MonkeyPatch) -> None:
    """Handed on, the scatter by the sigma before counted beside the factor, and the kernel was 2.4 times too wide."""
    noted = set[Scatter]()

    def note(scatter: Scatter, stamp_ns: int, residual: Array) -> None:
        if len(residual) == 3:
            noted.add(scatter)
        as_ever(scatter, stamp_ns, residual)

    as_ever = Scatter.note
    monkeypatch.setattr(Scatter, "note", note)
    run = stating(matched(3), GnssPosition, 0.5)  # too little for the start to see
    events = replay(run.recording, run.config).solution.stats.events
    rebuilt = [line for line in events if "gnss: its measurements scatter" in line and "rebuilt" in line]
    assert len(rebuilt) >= 1
    assert len(noted) == 1 + len(rebuilt)


def lone_receiver(gnss_sigma_m: float) -> SimulatedRun:
    """A run with fixes of this noise and a compass, and no matches."""
    scenario = replace(
        bl_scenario(1, "clean"),
        duration_s=24.0,
        pose_hz=0.0,
        imu_hz=50.0,
        gnss_hz=5.0,
        compass_hz=1.0,
        gnss_sigma_m=gnss_sigma_m,
    )
    return simulate_slowly(scenario, 3, 1.25)


def test_fixes_that_state_a_tenth_of_their_noise_are_taken_as_they_scatter() -> None:
    """Of a lone receiver: believed, they drew the track after their noise."""
    run = stating(lone_receiver(0.5), GnssPosition, 0.1)
    solution = app.smooth_recording(run.recording, run.config).solution
    (said,) = (w for w in solution.stats.warnings if "scatter more than they state" in w)
    assert re.match(r"gnss: .* sigma_scale: ([0-9.]+)$", said)
    assert float(said.rsplit(" ", 1)[1]) == pytest.approx(10.0, rel=0.2)
    assert not [w for w in solution.stats.warnings if "IMU" in w]
    assert compare_to_truth(solution.trajectory, run.truth).position_rmse_m < 0.3


def test_a_start_by_the_motion_blames_fixes_that_scatter() -> None:
    """Fixes of 0.8 m at 1 Hz that state an eighth, no compass: so few do not tell surely, and the IMU contradicted them."""
    scenario = Scenario(
        path="loops", duration_s=25.0, noise="clean", pose_hz=0.0, compass_hz=0.0, imu_hz=50.0, gnss_hz=1.0, gnss_sigma_m=0.8
    )  # fmt: skip
    run = stating(simulate_slowly(scenario, 3, 1.0), GnssPosition, 0.125)
    datum = origin.choose_datum(run.recording, run.config, SENSORS)
    found = solve_batch(make_problem(run.recording, run.config, datum, SENSORS, INERTIAL), newest=True)
    (gnss,) = found.problem.streams
    times = found.problem.config.sensors[gnss.name].sigmas_over(run.config.sensors[gnss.name])
    assert times == {"sigma_scale": pytest.approx(8.0, rel=0.3)}
    assert found.noise_scale == 1.0


def test_a_pose_has_a_factor_on_lengths_and_one_on_angles() -> None:
    run = matched(1, 3.0)
    m = run.recording.of(PoseFix)[0]
    row = next(row for row in SENSORS if row.kind == "pose")
    config = PoseConfig(topic="/p", min_sigma_m=1e-6, min_sigma_deg=1e-6)
    scaled = config.scaled({"sigma_scale": 2.0, "angle_sigma_scale": 3.0})
    at = attachment(row, config)
    plain, wider = (row.residuals(m, c, at)[0] for c in (config, scaled))
    np.testing.assert_allclose(np.diagonal(wider.cov) / np.diagonal(plain.cov), [4.0, 4.0, 9.0])


def test_a_snapshot_knows_what_sensors_scatter(followed: Followed) -> None:
    run, found = followed.run, followed.snapshot
    assert found.sensor_noise["matcher"]["sigma_scale"] > 1.5
    sensors = {"matcher": run.config.sensors["matcher"], "gnss": run.config.sensors["gnss"]}
    strange = replace(
        found, sensor_noise={**found.sensor_noise, "gone": {"sigma_scale": 2.0}, "gnss": {"time_offset_s": 2.0}}
    )
    resumed = PersistentState.resumed(strange, ImuNoise(adapt=True), sensors)
    assert resumed.sensor_noise.times == {"matcher": found.sensor_noise["matcher"], "gnss": {}}


def test_what_a_start_finds_is_handed_on(tmp_path: Path) -> None:
    """Found anew by the window, it came 15 s later; and nothing was said of what the start took."""
    run = stating(matched(2, 8.0), GnssPosition, 0.1)
    smoother = OnlineSmoother(run.config, rows=SENSORS, inertial=INERTIAL, snapshot=tmp_path / "snapshot.json")
    said: list[str] = []
    for m in arrivals(run.recording):
        smoother.feed(m)
        said += [event.text for event in smoother.events()]
    (line,) = (text for text in said if "scatter" in text)
    assert line.startswith("gnss: ")
    found = Snapshot.read(tmp_path / "snapshot.json", "imu").sensor_noise
    assert found["gnss"] == {"sigma_scale": pytest.approx(10.0, rel=0.3)}


def test_floors_are_raised_with_the_factor() -> None:
    """Of fixes that state a micrometre, the factor alone would have to be 300 000 to be felt; all rounds were used up, and none left for the IMU."""
    run = stating(lone_receiver(0.3), GnssPosition, 1e-6 / 0.3)
    said = app.smooth_recording(run.recording, run.config).solution.stats.warnings
    (line,) = (w for w in said if "scatter more than they state" in w)
    found = {key: float(value) for key, value in re.findall(r"(\w+): ([0-9.]+)", line)}
    assert found["min_horizontal_sigma_m"] == pytest.approx(0.3, rel=0.2)
    assert found["sigma_scale"] == pytest.approx(15.0, rel=0.2)  # of the floor, 0.02 m


class Fixes:
    """A window of fixes of 10 Hz that state 2 cm, with the residuals (N, 2) that they are given."""

    def __init__(self, residuals: Array) -> None:
        self.problem = SimpleNamespace(streams={"gnss": self})
        self.row, self.config = next(row for row in SENSORS if row.kind == "gnss"), GnssConfig(topic="/fix")
        self._residuals, self._now_ns, self._back_ns, self._scale = residuals, 0, 0, 1.0

    def seen_by(self, noise: SensorNoise, set_back_s: float = 0.0, looks: int | None = None) -> list[str]:
        """What is said while they come, or at so many looks, one each second; their stamps are of a clock that was set back by so much."""
        said, self._back_ns = [], int(set_back_s * SECOND)
        for now_ns in range(0, (looks or len(self._residuals) // 10) * SECOND, SECOND):
            self._now_ns = now_ns
            self._scale = noise.times.get("gnss", {}).get("sigma_scale", 1.0)
            self.config = GnssConfig(topic="/fix", sigma_scale=self._scale)
            if line := noise.changed(self):  # type: ignore[arg-type]
                said.append(line)
        return said

    @property
    def newest(self) -> Any:
        return SimpleNamespace(stamp_ns=1000 * SECOND + self._now_ns - self._back_ns)

    def judged(self, _sensor: str, after_ns: int, until_ns: int) -> list[tuple[Measurement, Residual]]:
        place, cov = Geodetic(59.0, 10.0, 0.0), (0.02 * self._scale) ** 2 * np.eye(3)
        found: list[tuple[Measurement, Residual]] = []
        for k, raw in enumerate(self._residuals):
            stamp_ns = 1000 * SECOND - self._back_ns + k * SECOND // 10
            if max(after_ns, self.newest.stamp_ns - 10 * SECOND) < stamp_ns <= until_ns:
                fix = GnssPosition(stamp_ns=stamp_ns, sensor="gnss", seq=k, position=place, cov_enu_m2=cov)
                error = np.append(raw, 0.0)
                residual = Residual(raw=error, cov=cov, jacobian=lambda: cov, prior=1.0, size_m=0.0, size_deg=None)
                found.append((fix, residual))
        return found


def test_online_some_seconds_of_multipath_do_not_widen_all_fixes_after_them() -> None:
    """12 s of ten times the noise are 120 fixes, more than are remembered."""
    residuals = np.random.default_rng(3).normal(0.0, 0.02, (1000, 2))
    residuals[400:520] *= 10.0
    assert Fixes(residuals).seen_by(noise := SensorNoise()) == []
    assert noise.times == {}
    residuals[520:] *= 10.0
    assert len(Fixes(residuals).seen_by(SensorNoise())) >= 1


def test_online_a_minute_of_multipath_ends() -> None:
    """A minute of five times the noise is felt, and forgotten two minutes later, with a line on each."""
    residuals = np.random.default_rng(3).normal(0.0, 0.02, (2400, 2))
    residuals[300:900] *= 5.0
    noise = SensorNoise()
    said = Fixes(residuals[:900]).seen_by(noise)
    assert noise.times == {"gnss": {"sigma_scale": pytest.approx(5.0, rel=0.25)}}
    assert all("scatter more than they state" in line for line in said)
    said = Fixes(residuals).seen_by(noise := SensorNoise())
    assert noise.times == {"gnss": {}}
    assert said[-1] == "gnss: its measurements scatter less again; taken as configured"


def test_online_a_fix_without_another_near_it_is_no_pair() -> None:
    """The first is alone; and the solver failed for it."""
    assert Fixes(np.zeros((1, 2))).seen_by(noise := SensorNoise(), looks=8) == []
    assert noise.times == {}


def test_online_noise_that_stays_keeps_its_factor() -> None:
    """Every line is a window that is rebuilt: ten minutes of the same noise change the factor a few times at most."""
    noise = SensorNoise()
    said = Fixes(np.random.default_rng(3).normal(0.0, 0.06, (6000, 2))).seen_by(noise)
    assert len(said) <= 2
    assert noise.times == {"gnss": {"sigma_scale": pytest.approx(3.0, rel=0.2)}}


def test_online_noise_of_far_more_than_stated_is_found_step_by_step() -> None:
    """Fixes of 1.5 m that state 2 cm: a look finds twenty times at most, and what was found once was all there was."""
    noise = SensorNoise()
    said = Fixes(np.random.default_rng(3).normal(0.0, 1.5, (3000, 2))).seen_by(noise)
    assert len(said) == 2
    assert noise.times == {"gnss": {"sigma_scale": pytest.approx(75.0, rel=0.2)}}


def test_online_noise_is_seen_after_the_clock_was_set_back() -> None:
    """By the stamps before, nothing was newer until the clock had caught up, and the IMU was blamed meanwhile."""
    rng = np.random.default_rng(3)
    noise = SensorNoise()
    persistent = PersistentState(datum=None, noise=ImuNoise(adapt=True), sensor_noise=noise)
    assert Fixes(rng.normal(0.0, 0.02, (100, 2))).seen_by(noise) == []
    persistent.forget_clock(900 * SECOND)
    assert len(Fixes(rng.normal(0.0, 0.2, (400, 2))).seen_by(noise, set_back_s=100.0)) >= 1
