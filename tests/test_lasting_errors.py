# SPDX-License-Identifier: Apache-2.0
"""Poses that share errors for a while, as those of USBL, UWB or another filter do."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from graphloc import app
from graphloc.build import Stream
from graphloc.config import (
    AerialConfig,
    BodyVelocityConfig,
    CompassConfig,
    PoseConfig,
    SensorConfig,
    VesselConfig,
    parse_config,
)
from graphloc.errors import ConfigError
from graphloc.eval.ekf import run_honest
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.factors import KINDS, pose
from graphloc.frames import Array, Datum
from graphloc.graph import Decision
from graphloc.judge.decide import Verdict
from graphloc.measurements import Measurement, PoseFix
from graphloc.online._snapshot import Snapshot
from graphloc.replay import replay
from graphloc.solution import Graded
from graphloc.solve._lasting import lasting_error
from graphloc.solve.warnings import _lasting_error
from tests.faults import arrivals_of, feed
from tests.slowly import simulate_slowly
from tests.test_factors import attachment
from tests.test_online_faults import setup_of, smoother

SIGMA_M, TIME_S = 1.5, 40.0


def wander(t_s: Array, rng: np.random.Generator, sigma_m: float = SIGMA_M, time_s: float = TIME_S) -> Array:
    """A first-order Gauss-Markov process (N, 2), by its definition."""
    cov = sigma_m**2 * np.exp(-np.abs(t_s[:, None] - t_s) / time_s)
    return np.linalg.cholesky(cov + 1e-9 * np.eye(len(t_s))) @ rng.normal(size=(len(t_s), 2))


def with_usbl(seed: int, duration_s: float = 300.0, rate_hz: float = 1.0, **slow_error: float) -> SimulatedRun:
    """A run without GNSS; a log over ground, a compass, and a place of 0.5 m every 2 s with an error that lasts."""
    scenario = Scenario(
        path="loops", duration_s=duration_s, imu_hz=25.0, gnss_hz=0.0, compass_hz=1.0, log_hz=1.0, log_through="ground",
        pose_hz=0.5, pose_sigma_m=0.5, false_fraction=0.0,
    )  # fmt: skip
    run = simulate_slowly(scenario, seed, rate_hz)
    (name,) = run.config.of_kind("pose")
    stamps = [m.stamp_ns for m in run.recording.measurements if m.sensor == name]
    off = dict(zip(stamps, wander(1e-9 * np.array(stamps), np.random.default_rng(seed)), strict=True))

    def moved(m: Measurement) -> Measurement:
        if not isinstance(m, PoseFix):
            return m
        (mode,) = m.modes
        place = replace(mode, value=mode.value[:2] + off[m.stamp_ns], cov=mode.cov[:2, :2], probability=1.0)
        return replace(m, axes=("x", "y"), modes=(place,))

    block = PoseConfig.model_validate({
        **run.config.sensors[name].model_dump(), "axes": ["x", "y"], "false_fraction": 0.01, "slow_error": slow_error
    })  # fmt: skip
    config = run.config.model_copy(update={"sensors": {**run.config.sensors, name: block}})
    return replace(run, recording=run.recording.changed(moved), config=config)


def assert_honest(run: SimulatedRun, solution: Any) -> None:
    """Bounds that are neither too small nor far too wide: the NEES of an honest one is 2, and one run holds five to seven such errors."""
    found = compare_to_truth(solution.trajectory, run.truth)
    assert found.coverage_95 is not None
    assert found.nees is not None
    assert found.coverage_95 > 0.85
    assert 0.5 < found.nees < 4.0


def test_bounds_include_an_error_that_lasts() -> None:
    """Without its model 5 % of the truth lie inside: bounds are those of the mean of a dozen independent poses."""
    run = with_usbl(0, 200.0, rate_hz=0.6, sigma_m=SIGMA_M, time_constant_s=TIME_S)
    solution = app.simulated(run, compare=False).solution
    assert_honest(run, solution)
    slow = solution.slow["matcher"]
    assert (slow.axes, slow.units) == (("east", "north"), ("m", "m"))


def test_bounds_include_an_error_that_lasts_online() -> None:
    run = with_usbl(1, 200.0, sigma_m=SIGMA_M, time_constant_s=TIME_S)
    assert_honest(run, replay(run.recording, run.config).solution)


def test_it_goes_on_after_a_restart_but_not_on_other_axes(tmp_path: Path) -> None:
    """Of as many axes, what was the error to the north would be taken for that of the height."""
    run, path = with_usbl(2, 100.0, 1.0, sigma_m=SIGMA_M, time_constant_s=TIME_S), tmp_path / "snapshot.json"
    came = arrivals_of(run)
    came, rest = came[: len(came) // 2], came[len(came) // 2 :][:100]
    feed(smoother(run, snapshot=path), run, came)
    (name,) = run.config.of_kind("pose")
    snapshot = Snapshot.read(path, "imu")
    assert np.abs(snapshot.for_settings(setup_of(run.config).settings).anchor.slow[name].value).max() > 0.1
    resumed = feed(smoother(run, snapshot=path), run, rest)
    assert any(e.startswith("resumed from a snapshot") for e in resumed.events)
    other = run.config.sensors[name].model_copy(update={"axes": ("x", "z")})
    assert name not in snapshot.for_settings(setup_of(run.config.with_sensors({name: other})).settings).anchor.slow


@pytest.mark.parametrize(
    ("block", "was", "now"),
    [
        (BodyVelocityConfig(), {"scale_sigma": 0.05}, {"scale_sigma": 0.0, "mount_sigma_deg": 1.0}),
        (BodyVelocityConfig(scale_sigma=0.0), {"mount_sigma_m": 1.0}, {"scale_sigma": 0.05, "through": "water"}),
        (PoseConfig(axes=("z", "yaw")), {"slow_error": {"sigma_m": 1.0}}, {"slow_error": {"sigma_deg": 1.0}}),
        (AerialConfig(mount_sigma_deg=0.0, stamp_sigma_s=0.0), {"image_sigma_m": 0.3}, {"image_sigma_m": 0.0}),
        (CompassConfig(), {"wander_sigma_deg": 0.5}, {"wander_sigma_deg": 0.0}),
    ],
)
def test_a_restart_does_not_take_one_unknown_for_another(block: SensorConfig, was: Any, now: Any) -> None:
    """Of as many numbers: a scale of 2 % would be taken for a yaw of 1 deg."""
    told = block.model_dump()
    first, same, other = (
        setup_of(VesselConfig(sensors={"one": type(block).model_validate({**told, **keys})})).settings
        for keys in (was, was, now)
    )
    assert first == same
    assert first != other


def test_how_long_it_lasts_is_refused_where_it_has_no_size() -> None:
    """It did nothing, and nothing was said; an effective configuration states it, too."""
    block = {"kind": "pose", "topic": "/usbl", "slow_error": {"time_constant_s": 40.0}}
    with pytest.raises(
        ConfigError, match=r"^v: sensors\.usbl\.slow_error: time_constant_s .* set sigma_m or sigma_deg"
    ):
        parse_config({"sensors": {"usbl": block}}, KINDS, "v")
    sized = parse_config(
        {"sensors": {"usbl": {**block, "slow_error": {"time_constant_s": 40.0, "sigma_m": 1.0}}}},
        KINDS,
        "v",
    )
    assert sized.sensors["usbl"].slow_error.time_constant_s == 40.0
    stated = PoseConfig(topic="/usbl").model_dump(mode="json")
    assert parse_config({"sensors": {"usbl": stated}}, KINDS, "v").sensors["usbl"] == PoseConfig(topic="/usbl")


def test_the_honest_filter_is_told_of_it() -> None:
    """What the graph knows of an error it must know, too, or the comparison flatters the graph: untold, 35 % of the truth lie inside."""
    run = with_usbl(31, sigma_m=SIGMA_M, time_constant_s=TIME_S)
    assert run.config.datum is not None
    track = run_honest(run.recording, run.config, Datum(run.config.datum.geodetic)).trajectory
    assert float(compare_to_truth(track, run.truth).coverage_95 or 0.0) > 0.6


@pytest.mark.parametrize(("axes", "slow"), [("x y", "m m"), ("z", "m"), ("x y z roll pitch yaw", "m m m deg")])
def test_only_axes_that_are_measured_have_one(axes: str, slow: str) -> None:
    config = PoseConfig.model_validate({"axes": axes.split(), "slow_error": {"sigma_m": 2.0, "sigma_deg": 3.0}})
    process = pose.slow(config)
    assert process is not None
    assert " ".join(process.units) == slow
    np.testing.assert_allclose(process.sigma * process.scale, [3.0 if unit == "deg" else 2.0 for unit in process.units])


def test_what_it_walks_by_between_two_nodes_is_noise_of_each_pose() -> None:
    config = PoseConfig.model_validate({"axes": ["x", "y", "yaw"], "slow_error": {"sigma_m": 2.0}})
    at = attachment(pose.ROW, config)
    m = pose.ideal(at, config)
    (plain,), (walked,) = (pose.residuals(m, config, replace(at, slow_walk=w)) for w in (None, np.array([0.3, 0.7])))
    np.testing.assert_allclose(walked.cov - plain.cov, np.diag([0.3, 0.7, 0.0]), atol=1e-12)
    assert walked.white is not None
    np.testing.assert_allclose(walked.white, plain.cov)
    alone = np.diagonal(plain.cov) / np.diagonal(walked.cov)
    assert walked.expected_nis == pytest.approx(alone.sum())


def judged(residuals: Array, every_s: float, config: PoseConfig, *, share_false: float = 0.0) -> list[str]:
    """The warning on residuals (N, 2) of poses; false ones are 20 m off, and rejected."""
    rng = np.random.default_rng(9)
    at = attachment(pose.ROW, config)
    m = pose.ideal(at, config)
    (plain,) = pose.residuals(m, config, at)
    measurements = [replace(m, stamp_ns=int(k * every_s * 1e9), seq=k) for k in range(len(residuals))]
    false = rng.random(len(residuals)) < share_false
    verdicts = [
        Verdict(Decision(), 1.0, 1.0, replace(plain, raw=raw), 0, at) if not wrong
        else Verdict.false(replace(plain, raw=raw + 20.0), at)
        for raw, wrong in zip(residuals, false, strict=True)
    ]  # fmt: skip
    stream = SimpleNamespace(
        name="usbl", row=pose.ROW, config=config, measurements=measurements, slow=pose.slow(config), left_out=None
    )
    return _lasting_error(cast("Stream", stream), verdicts)


def test_errors_that_last_are_said_with_their_size_and_time() -> None:
    """Of 500 poses of 1 m beside an error of 1.5 m that lasts 40 s; a twentieth is false."""
    rng = np.random.default_rng(3)
    every_s = 3.0
    residuals = wander(np.arange(0.0, 500 * every_s, every_s), rng) + rng.normal(0.0, 1.0, (500, 2))
    config = PoseConfig(axes=("x", "y"))
    (line,) = judged(residuals, every_s, config, share_false=0.05)
    found = re.fullmatch(r"usbl: its errors last for some (\d+) s, .*\{sigma_m: ([\d.]+), time_constant_s: (\d+)\}, or more; .*", line)  # fmt: skip
    assert found
    assert isinstance(line, Graded)  # each leg of a long run has its own figures
    assert float(found[1]) == pytest.approx(TIME_S, rel=0.3)
    assert float(found[2]) == pytest.approx(SIGMA_M, rel=0.2)
    modelled = PoseConfig.model_validate({"axes": ["x", "y"], "slow_error": {"sigma_m": 1.5}})
    assert judged(residuals, every_s, modelled) == []


@pytest.mark.parametrize("number", [40, 1000])
def test_independent_errors_are_not_said_to_last(number: int) -> None:
    for seed in range(50):
        residuals = np.random.default_rng(seed).normal(0.0, 1.0, (number, 2)) + np.array(
            [3.0, 0.0]
        )  # a datum is off throughout
        assert lasting_error(np.arange(float(number)), residuals, 1.0) is None


def test_a_sensor_without_errors_is_none_that_errs() -> None:
    assert lasting_error(np.arange(100.0), np.zeros((100, 2)), 1.0) is None


def test_an_error_that_the_bounds_have_is_none_that_lasts() -> None:
    """Of 4 cm for 3 s, once a second, by poses that state 0.2 m: the mean of six such is stated to 8 cm."""
    t_s = np.arange(600.0)
    residuals = wander(t_s, np.random.default_rng(2), 0.04, 3.0)
    assert lasting_error(t_s, residuals, 0.02) is not None
    assert lasting_error(t_s, residuals, 0.2) is None
