# SPDX-License-Identifier: Apache-2.0
"""A delay of fixes by what the IMU feels, where waves tilt the IMU and swing an antenna on a mast whose height nobody told."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from graphloc.frontends._assess import MeasuredMotion
from graphloc.frontends._mount_yaw import Felt
from graphloc.frontends.time_offsets import MotionOffset, motion_time_offset

G = 9.81


def found(late_s: float, height_m: float, way: float = 1.0) -> MotionOffset | None:
    """A vessel that goes ahead at changing speed, pitches by 2 deg in waves and surges a quarter of a wave away from that."""
    rng, t = np.random.default_rng(3), np.arange(0.0, 180.0, 0.01)

    def pitch(t: np.ndarray) -> np.ndarray:
        return 0.03 * np.sin(1.5 * t) + 0.02 * np.sin(1.1 * t + 1.0)

    def place(t: np.ndarray) -> np.ndarray:
        surge = way * (0.3 * np.cos(1.5 * t) / 1.5 + 0.2 * np.cos(1.1 * t + 1.0) / 1.1)
        return np.asarray(5.0 * t + 30.0 * np.sin(0.12 * t) + surge)

    dt = 1e-3
    force = (place(t + dt) - 2.0 * place(t) + place(t - dt)) / dt**2
    rate = (pitch(t + dt) - pitch(t - dt)) / (2.0 * dt)
    zero, stamps = np.zeros(len(t)), (t * 1e9).astype(np.int64)
    accel = np.column_stack([force - G * np.sin(pitch(t)), zero, zero + G]) + 0.02 * rng.normal(size=(len(t), 3))
    felt = Felt.of(stamps, accel, np.column_stack([zero, rate, zero]) + 0.001 * rng.normal(size=(len(t), 3)), G)
    at = np.arange(0.0, 180.0, 0.2)
    measured = place(at) + height_m * np.sin(pitch(at)) + 0.02 * rng.normal(size=len(at))
    return motion_time_offset(felt, MeasuredMotion("fixes", 0, at + late_s, np.full(len(at), 5.0), measured + 0j))


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("height_m", [0.0, 8.0])
@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_a_delay_is_told_apart_from_waves(late_s: float, height_m: float, way: float) -> None:
    """Taken without the swing of the mast, fixes in time looked late or early, clearly."""
    offset = found(late_s, height_m, way)
    assert offset is not None
    assert offset.clear == (late_s > 0.0)
    assert offset.value_s == pytest.approx(-late_s, abs=max(3.0 * offset.sigma_s, 0.03))


@pytest.mark.parametrize("seed", [3, 5])
def test_fixes_once_a_second_are_not_asked_in_between(seed: int) -> None:
    """A robot on rough ground. Between fixes its track is a straight line; asked there, they looked late by up to ten sigmas."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 300.0, 0.01)
    speed = gaussian_filter1d(np.repeat(rng.uniform(0.3, 1.0, 60) * 1.2, 500), 60.0)
    pitch = gaussian_filter1d(rng.normal(size=len(t)), 25.0)
    pitch *= 0.014 / pitch.std()
    place, zero = np.cumsum(speed) * 0.01, np.zeros(len(t))
    accel = np.column_stack([np.gradient(speed, 0.01) - G * np.sin(pitch), zero, zero + G])
    gyro = np.column_stack([zero, np.gradient(pitch, 0.01), zero])
    noise_a, noise_w = 0.1 * rng.normal(size=(len(t), 3)), 0.003 * rng.normal(size=(len(t), 3))
    felt = Felt.of((t * 1e9).astype(np.int64), accel + noise_a, gyro + noise_w, G)
    at = np.arange(0.3, 299.0, 1.0)
    measured = np.interp(at, t, place) + 0.02 * rng.normal(size=len(at))
    offset = motion_time_offset(felt, MeasuredMotion("fixes", 0, at, np.full(len(at), 1.0), measured + 0j))
    assert offset is not None
    assert abs(offset.value_s) < 3.0 * offset.sigma_s


@pytest.mark.parametrize("seed", range(4))
def test_one_stretch_of_a_run_tells_no_delay(seed: int) -> None:
    """A car that brakes hard once, where its fixes come late by chance (a jump to and fro), and goes on gently, with fixes in time."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 240.0, 0.01)
    gently = gaussian_filter1d(np.repeat(rng.uniform(7.0, 9.0, 24), 1000), 250.0)
    braking = 6.0 * np.exp(-(((t - 110.0) / 1.5) ** 2))
    zero = np.zeros(len(t))
    accel = np.column_stack([np.gradient(gently - braking, 0.01), zero, zero + G]) + 0.1 * rng.normal(size=(len(t), 3))
    felt = Felt.of((t * 1e9).astype(np.int64), accel, 0.003 * rng.normal(size=(len(t), 3)), G)
    at = np.arange(0.3, 239.0, 0.2)
    place = np.interp(at, t, np.cumsum(gently) * 0.01) - np.interp(at - 0.4, t, np.cumsum(braking) * 0.01)
    measured = place + 0.1 * rng.normal(size=len(at))
    offset = motion_time_offset(felt, MeasuredMotion("fixes", 0, at, np.full(len(at), 8.0), measured + 0j))
    assert offset is not None
    assert offset.value_s == pytest.approx(-0.4, abs=0.1)  # as it looks
    assert not offset.clear


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_a_field_robot_that_sways_tells_its_delay_by_short_windows(late_s: float, seed: int) -> None:
    """It goes at one speed, pitches every 1.8 s, give or take a quarter, and shakes; RTK 3 m up tells its swing to a few ms.

    In windows over which the swing is averaged out, fixes in time looked 0.8 s, half of its period, late with the antenna below the IMU: these denied
    'no offset' the most, so they were taken.
    """
    rng, t = np.random.default_rng(seed), np.arange(0.0, 300.0, 0.01)
    hz = (1.0 + 0.25 * rng.uniform(-1.0, 1.0, 12)) / 1.8
    of_wave = 0.03 * np.sqrt(2.0 / 12.0) * np.sin(2.0 * np.pi * (hz * t[:, None] + rng.uniform(0.0, 1.0, 12)))
    pitch = of_wave.sum(axis=1)
    zero = np.zeros(len(t))
    accel = np.column_stack([-G * np.sin(pitch), zero, zero + G]) + 0.7 * rng.normal(size=(len(t), 3))
    gyro = np.column_stack([zero, np.gradient(pitch, 0.01), zero]) + 0.002 * rng.normal(size=(len(t), 3))
    felt = Felt.of((t * 1e9).astype(np.int64), accel, gyro, G)
    at = np.arange(0.03, 299.0, 0.1)
    measured = 1.6 * at + 3.0 * np.sin(np.interp(at, t, pitch)) + 0.012 * rng.normal(size=len(at))
    offset = motion_time_offset(felt, MeasuredMotion("fixes", 0, at + late_s, np.full(len(at), 1.6), measured + 0j))
    assert offset is not None
    assert offset.clear == (late_s > 0.0)
    assert offset.value_s == pytest.approx(-late_s, abs=0.02)
