# SPDX-License-Identifier: Apache-2.0
"""When the noise of an IMU is raised under way."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc.config import ImuConfig
from graphloc.measurements import ImuSeries
from graphloc.online._noise import ImuNoise

SECOND = 1_000_000_000
SENSOR = ImuConfig.model_validate({"topic": "/imu"})


def scattering() -> ImuSeries:
    """Ten seconds whose samples scatter by ten times what is configured."""
    rng, count = np.random.default_rng(0), 1000
    noise = 10.0 * np.sqrt(100.0) * np.array([SENSOR.accel_noise_mps2, SENSOR.gyro_noise_radps])
    accel, gyro = noise[:, None, None] * rng.standard_normal((2, count, 3))
    stamps_ns = SECOND + np.arange(count) * SECOND // 100
    return ImuSeries(sensor="imu", seqs=np.arange(count), stamps_ns=stamps_ns, accel_mps2=accel, gyro_radps=gyro)


def steady(stamp_ns: int) -> SimpleNamespace:
    """A newest state whose biases stay where they are."""
    bias = gtsam.imuBias.ConstantBias()
    cov = {"pose_cov": np.eye(6) * 1e-4, "bias_cov": np.eye(6) * 1e-8}
    return SimpleNamespace(stamp_ns=stamp_ns, pose=gtsam.Pose3(), bias=bias, **cov)


def said(likely: Any, *at_s: float, lag_s: float = 10.0) -> list[str]:
    """What is said at some times of windows in which the larger noises are so likely, relative to what is configured."""

    def likelihoods(_: Any) -> Any:
        if isinstance(likely, Exception):
            raise likely
        return np.array([0.0, *(next(likely) if isinstance(likely, Iterator) else likely)])

    noise = ImuNoise(adapt=True)
    noise.begin(SECOND)
    config = SimpleNamespace(sensors={"imu": SENSOR})
    links = SimpleNamespace(bias_steps=lambda a, b: np.full(6, 1e-5 * np.sqrt((b - a) / SECOND)))
    lines = []
    for at in at_s:
        lag: Any = SimpleNamespace(
            fresh=True, lag_s=lag_s, newest=steady(SECOND + round(at * SECOND)), misfit=lambda: 1.0,
            problem=SimpleNamespace(config=config, links=links), likelihoods=likelihoods,
        )  # fmt: skip
        lines.append(noise.changed(lag, scattering))
    return lines


def test_the_noise_is_raised_where_windows_bear_it_out() -> None:
    assert ["is taken" in line for line in said((6.0, 1.0, 1.0), 10.0, 20.0)] == [False, True]


def test_hours_without_hide_nothing() -> None:
    """An hour in which the larger noise was less probable, and half a minute in which it is more probable."""
    gained = iter([(-5.0, -5.0, -5.0)] * 360 + [(8.0, 8.0, 8.0)] * 3)
    assert any(said(gained, *(10.0 * k for k in range(1, 364))))


def test_what_a_long_window_holds_counts_once() -> None:
    assert said((6.0, 1.0, 1.0), 10.0, 20.0, 30.0, 40.0, lag_s=30.0) == ["", "", "", ""]


@pytest.mark.parametrize("likely", [RuntimeError("Factor is exactly singular"), (np.nan, np.nan, np.nan)])
def test_a_window_of_which_nothing_can_be_told_stands(likely: Any) -> None:
    assert said(likely, 10.0, 20.0) == ["", ""]


@pytest.mark.parametrize("doubtful", [False, True])
def test_biases_tell_no_walk_while_the_heading_is_doubtful(*, doubtful: bool) -> None:
    """A heading that may be wrong bends them as well."""
    noise, links = (
        ImuNoise(adapt=True),
        SimpleNamespace(bias_steps=lambda a, b: np.full(6, 1e-5 * np.sqrt((b - a) / SECOND))),
    )
    problem = SimpleNamespace(config=SimpleNamespace(sensors={"imu": SENSOR}), links=links)
    lines = []
    for k in range(6):
        newest = steady(SECOND + 10 * k * SECOND)
        newest.bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.full(3, 1e-3 * k))
        lag: Any = SimpleNamespace(
            fresh=True,
            lag_s=10.0,
            newest=newest,
            misfit=lambda: 1.0,
            problem=problem,
            likelihoods=lambda _: np.zeros(4),
        )
        lines.append(noise.changed(lag, scattering, heading_doubtful=doubtful))
    assert any("gyro_bias_instability" in line for line in lines) is not doubtful
