# SPDX-License-Identifier: Apache-2.0
"""Fixes far off for seconds are outliers, not the IMU's noise."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from scipy.integrate import quad

from graphloc import app
from graphloc.config import KernelConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, simulate
from graphloc.frames import Geodetic, wrap_angle
from graphloc.graph import Residual
from graphloc.measurements import CompassHeading, GnssPosition, Measurement
from graphloc.solve._decide import _by_kernel
from graphloc.solve._solution import leaps


def test_bursts_of_far_fixes_leave_the_imu_its_noise() -> None:
    """Three seconds of twenty, 30 m to the north, of 10 Hz fixes good to 0.5 m."""
    run = simulate(
        Scenario(
            path="loops", duration_s=80.0, noise="clean", pose_hz=0.0, gnss_sigma_m=0.5, gnss_reported_sigma_m=0.5
        ),
        901,
    )

    def struck(m: Measurement) -> Measurement:
        t_s = (m.stamp_ns - run.recording.imu.stamps_ns[0]) / 1e9 if run.recording.imu is not None else 0.0
        if not isinstance(m, GnssPosition) or t_s % 20.0 < 17.0:
            return m
        return replace(m, position=Geodetic(m.position[0] + 30.0 / 111_200.0, *m.position[1:]))

    recording = replace(run.recording, measurements=tuple(struck(m) for m in run.recording.measurements))
    done = app.smooth_recording(recording, run.config)
    said = done.solution.stats.warnings
    assert not any("IMU noise scaled up" in w or "times its expectation" in w for w in said)
    assert compare_to_truth(done.solution.trajectory, run.truth).position_max_m < 2.0


def test_a_compass_that_is_off_for_half_of_the_run_is_not_a_wide_one() -> None:
    """90 deg off for 35 s of 70: taken for scatter, it turned the run by up to 180 deg, and 69 of 70 matches were refused."""
    run = simulate(
        Scenario(
            path="turn", duration_s=70.0, gnss_hz=5.0, compass_hz=5.0, gnss_sigma_m=0.05, gnss_reported_sigma_m=0.21
        ),
        1,
    )
    begin_ns = int(run.truth.stamps_ns[0])

    def struck(m: Measurement) -> Measurement:
        if not isinstance(m, CompassHeading) or not 15.0 <= (m.stamp_ns - begin_ns) * 1e-9 < 50.0:
            return m
        return replace(m, yaw_rad=float(wrap_angle(m.yaw_rad + np.pi / 2.0)))

    recording = replace(run.recording, measurements=tuple(struck(m) for m in run.recording.measurements))
    solved = app.smooth_recording(recording, run.config).solution
    track = solved.trajectory
    off_deg = np.degrees(np.abs(wrap_angle(track.yaw_rad - run.truth.at(track.stamps_ns).yaw_rad)))
    assert off_deg.max() < 3.0
    assert solved.ledger.counts()["aerial"]["used"] > 30


@pytest.mark.parametrize("hz", [1.0, 5.0])
@pytest.mark.parametrize(("speed_mps", "turn_radps", "noise_m"), [(2.0, 0.1, 0.05), (15.0, 0.4, 0.2), (0.0, 0.0, 0.05)])
def test_a_receiver_that_leaps_is_said(hz: float, speed_mps: float, turn_radps: float, noise_m: float) -> None:
    """Off by 8 m for 20 s; a craft that turns as a car does, or is silent for a while, leaps nowhere.

    Where noise is low, the steps beside a leap stand out as well, and are no leaps of their own.
    """
    t = np.arange(0.0, 80.0, 1.0 / hz)
    course = turn_radps * np.clip(t - 20.0, 0.0, 10.0)
    way = np.cumsum(speed_mps / hz * np.column_stack([np.cos(course), np.sin(course)]), axis=0)
    way += np.random.default_rng(2).normal(0.0, noise_m, way.shape)
    stamps_ns = np.round(t * 1e9).astype(np.int64)
    assert leaps("gnss", stamps_ns, way) == []
    heard = (t < 50.0) | (t > 58.0)
    assert leaps("gnss", stamps_ns[heard], way[heard]) == []
    (line,) = leaps("gnss", stamps_ns, way + np.outer((t >= 40.0) & (t < 60.0), [0.0, 8.0]))
    assert line.startswith(("gnss: leaps by 8 m at 1970-01-01T00:00:40", "gnss: leaps by 8 m at 1970-01-01T00:01:00"))
    assert ", and 1 times more:" in line


def test_a_receiver_alone_that_leaps_is_said_in_the_run() -> None:
    run = simulate(Scenario(path="loops", duration_s=50.0, noise="drift", pose_hz=0.0, compass_hz=5.0), 1)
    begin_ns = int(run.truth.stamps_ns[0])
    config = run.config.model_copy(
        update={"sensors": {k: v for k, v in run.config.sensors.items() if k in ("imu", "gnss", "compass")}}
    )

    def struck(m: Measurement) -> Measurement:
        if not isinstance(m, GnssPosition) or not 20.0 <= (m.stamp_ns - begin_ns) * 1e-9 < 30.0:
            return m
        return replace(m, position=Geodetic(m.position[0] + 1e-4, *m.position[1:]))  # 11 m north

    recording = replace(run.recording, measurements=tuple(struck(m) for m in run.recording.measurements))
    said = {
        name: app.smooth_recording(of, config).solution.stats.warnings
        for name, of in (("usual", run.recording), ("struck", recording))
    }
    assert not any("leaps" in line for line in said["usual"])
    assert sum(line.startswith(("gnss: leaps by 11 m", "gnss: leaps by 12 m")) for line in said["struck"]) == 1


def test_a_sensor_that_lies_by_more_than_numbers_hold_is_an_outlier() -> None:
    """Of 0.1 mm, stated, and 10^9 m off: a scale without a limit was none that a kernel takes, and the run ended in a traceback."""
    off = Residual(
        raw=np.array([1e9, 0.0]),
        cov=np.eye(2) * 1e-8,
        jacobian=lambda: np.zeros((2, 6)),
        prior=1.0,
        size_m=1e9,
        size_deg=None,
    )
    stream: Any = SimpleNamespace(
        row=SimpleNamespace(absolute=True), config=SimpleNamespace(kernel=KernelConfig(kind="cauchy"))
    )
    at: Any = None
    verdicts = _by_kernel(stream, [0, 1, 2], [at] * 3, [(off,)] * 3, "final")
    assert max(v.weight for v in verdicts) < 1e-6


@pytest.mark.parametrize("kind", ["none", "huber", "cauchy", "geman_mcclure", "tukey"])
def test_the_cost_of_a_loss_is_the_integral_of_its_weight(
    kind: Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"],
) -> None:
    """d rho / d(r^2) is the weight with which a squared residual counts."""
    kernel = KernelConfig(kind=kind, scale=1.7)
    for nis in (0.3, 2.0, 2.9, 40.0):
        cost, _ = quad(kernel.weight, 0.0, nis, points=[1.7**2])
        assert kernel.cost(nis) == pytest.approx(cost, rel=1e-6)
    assert np.all(np.diff([kernel.cost(n) for n in np.linspace(0.0, 9.0, 50)]) >= 0.0)
