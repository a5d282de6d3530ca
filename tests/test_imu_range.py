# SPDX-License-Identifier: Apache-2.0
"""An IMU whose range is too small for what shakes it says so: readings pile up at their largest."""

from pathlib import Path

import numpy as np
import pytest

from graphloc.frames import Array
from graphloc.frontends._sanity import saturation_warning
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import inspect_bag, render
from tests.test_bag_bad_input import vessel
from tests.test_frozen_imu import bag, readings

RANGE_MPS2, RANGE_RADPS = 2.0 * 9.80665, np.radians(250.0)


def shaken(lsb: float = 0.0) -> Array:
    """Samples (N, 6) with vibration of 6 m/s^2 along z and 4 rad/s about x (1 sigma), cut off nowhere, in steps of `lsb`."""
    samples = readings() + np.random.default_rng(0).normal(0.0, [0.0, 0.0, 6.0, 4.0, 0.0, 0.0], readings().shape)
    return np.asarray(np.round(samples / lsb) * lsb if lsb else samples)


def cut_off(samples: Array) -> Array:
    limit = np.repeat([RANGE_MPS2, RANGE_RADPS], 3)
    return np.clip(samples, -limit, limit)


@pytest.mark.parametrize("lsb", [0.0, 0.001])
def test_the_axes_that_are_cut_off_are_named(lsb: float) -> None:
    samples = cut_off(shaken(lsb))
    count = int((np.abs(shaken(lsb)) > np.repeat([RANGE_MPS2, RANGE_RADPS], 3)).any(axis=1).sum())
    (line,) = saturation_warning("imu", samples[:, :3], samples[:, 3:])
    assert f"imu: {count} of {len(samples)} samples" in line
    assert (
        "(acceleration z at 19.61 m/s^2, rate x at 4.363 rad/s, rate x at -4.363 rad/s)" in line
    )  # up, where gravity is


def test_vibration_within_the_range_is_none() -> None:
    """Of an engine, in coarse steps: many readings are alike, at the largest as well."""
    samples = readings()
    samples[:, 2] = np.round((9.8 + 15.0 * np.sin(1.7 * np.arange(len(samples)))) / 0.1) * 0.1
    assert (samples[:, 2] == samples[:, 2].max()).sum() > 20
    assert saturation_warning("imu", samples[:, :3], samples[:, 3:]) == []


def test_standstill_and_a_steady_turn_without_noise_are_none() -> None:
    still = np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 0.0], (300, 1))
    turning = np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 2.0], (300, 1))
    for samples in (still, turning):
        assert saturation_warning("imu", samples[:, :3], samples[:, 3:]) == []


def test_a_bag_and_inspect_say_so(tmp_path: Path) -> None:
    samples = readings()
    samples[100:400:20, 2] += 15.0
    path = bag(tmp_path / "run", cut_off(samples))
    said = "15 of 1000 samples are cut off at the end of the range (acceleration z at 19.61 m/s^2)"
    assert any(said in line for line in read_recording(path, vessel(gnss=None)).warnings)
    assert said in " ".join(render(inspect_bag(path)).split())
