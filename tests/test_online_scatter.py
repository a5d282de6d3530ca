# SPDX-License-Identifier: Apache-2.0
"""How wide a sensor's residuals scatter: what they have in common is no noise."""

from dataclasses import replace

import numpy as np
import pytest

from graphloc.eval.simulate import bl_scenario, simulate
from graphloc.frames import wrap_angle
from graphloc.measurements import CompassHeading
from graphloc.online._scatter import Scatter, _Median
from graphloc.replay import replay
from tests.slowly import with_few_states

SECOND = 1_000_000_000


def scatter_of(residuals: np.ndarray, rate_hz: float = 10.0, *, jumps: bool = False) -> float:
    """Of normalised residuals (N, k)."""
    scatter = Scatter(jumps=jumps)
    for k, residual in enumerate(residuals):
        scatter.note(round(k * SECOND / rate_hz), residual)
    return scatter.times


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("rate_hz", [0.2, 1.0, 10.0])
def test_it_is_how_many_times_wider_than_configured_they_are(k: int, rate_hz: float) -> None:
    white = np.random.default_rng(2).standard_normal((600, k))
    assert scatter_of(4.0 * white, rate_hz) == pytest.approx(4.0, rel=0.15)
    assert scatter_of(0.5 * white, rate_hz) == 1.0


def test_the_median_of_the_last_residuals() -> None:
    rng, median = np.random.default_rng(3), _Median()
    values = np.round(rng.normal(size=1000), 1).tolist()  # many are equal
    for k, value in enumerate(values):
        median.append(value)
        assert median.value() == pytest.approx(np.median(values[max(k - 299, 0) : k + 1]))


def test_what_they_have_in_common_does_not_make_them_wide() -> None:
    white = np.random.default_rng(2).standard_normal((300, 1))
    off = white + np.where(np.arange(300) < 100, 0.0, 15.0)[:, None]
    assert scatter_of(off) < 1.3 * scatter_of(white)  # the pairs across the step are a tenth of all


def test_a_slow_error_that_may_jump_makes_them_wide_until_it_has() -> None:
    off = np.random.default_rng(2).standard_normal((300, 3)) + 15.0
    assert scatter_of(off, jumps=True) > 5.0 * scatter_of(off)


@pytest.mark.parametrize("k", [1, 3])
def test_a_third_of_outliers_does_not_make_them_wide(k: int) -> None:
    """Half of all pairs has one of them in it."""
    rng = np.random.default_rng(2)
    white = rng.standard_normal((600, k))
    assert scatter_of(np.where(rng.uniform(size=(600, 1)) < 0.35, 30.0, white)) < 2.0


@pytest.mark.parametrize("period_s", [2.0, 2.7, 3.7])
def test_a_swell_as_long_as_pairs_are_apart_is_not_overlooked(period_s: float) -> None:
    at_s = np.arange(600) / 10.0  # its RMS is 3.5, the half of all pairs is nearer
    assert scatter_of(5.0 * np.sin(2.0 * np.pi * at_s / period_s)[:, None]) > 2.5


def test_a_compass_that_is_off_beside_a_crane_is_not_followed() -> None:
    """15 deg off for 18 s, at 20 Hz: most of what is remembered of it. Gyroscope and matches tell the heading."""
    run = simulate(replace(bl_scenario(1, "drift"), duration_s=42.0, compass_hz=20.0, imu_hz=50.0, gnss_hz=5.0), 1)
    # Without wander, which takes some of it up: here it is the kernel that has to tell.
    compass = run.config.sensors["compass"].model_copy(update={"wander_sigma_deg": 0.0})
    sensors = {**run.config.sensors, "compass": compass}
    config = with_few_states(run.config.model_copy(update={"sensors": sensors}), rate_hz=2.5)
    begin_ns = int(run.truth.stamps_ns[0]) + 20 * SECOND
    bent = tuple(
        replace(m, yaw_rad=m.yaw_rad + np.radians(15.0))
        if isinstance(m, CompassHeading) and 0 <= m.stamp_ns - begin_ns < 18 * SECOND
        else m
        for m in run.recording.measurements
    )
    track = replay(replace(run.recording, measurements=bent), config).solution.trajectory
    later = track.stamps_ns > begin_ns
    off = wrap_angle(track.yaw_rad[later] - run.truth.at(track.stamps_ns[later]).yaw_rad)
    assert np.degrees(np.abs(off)).max() < 2.0
