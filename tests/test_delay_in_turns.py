# SPDX-License-Identifier: Apache-2.0
"""A delay of fixes by what the IMU feels, of a craft that slows down in its turns."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from graphloc.frontends._assess import MeasuredMotion
from graphloc.frontends._mount_yaw import Felt, yaw_in_craft
from graphloc.frontends.time_offsets import MotionOffset, _bending, motion_time_offset
from graphloc.signals.series import integral

RATE_HZ = 100.0


def found(late_s: float, turn_deg: float, seed: int) -> MotionOffset | None:
    """Legs of 16 s at 5 to 9 m/s; in turns of 5 s, left and right, it brakes to 3 m/s by 1 m/s^2; fixes of 0.15 m, 0.5 m behind the IMU."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 250.0, 1.0 / RATE_HZ)
    leg = (t // 21.0).astype(int)
    turns = t % 21.0 >= 16.0
    cruise = rng.uniform(5.0, 9.0, leg[-1] + 1)[leg]
    braked, sped = cruise - (t % 21.0 - 16.0), 3.0 + t % 21.0
    speed = np.where(turns, np.maximum(braked, 3.0), np.where(leg > 0, np.minimum(sped, cruise), cruise))
    rate = np.where(turns, np.deg2rad(turn_deg / 5.0) * rng.choice([-1.0, 1.0], leg[-1] + 1)[leg], 0.0)
    speed, rate = (gaussian_filter1d(v, s * RATE_HZ) for v, s in ((speed, 1.0), (rate, 0.4)))
    heads = np.exp(1j * integral(t, rate))
    place = integral(t, speed * heads)
    ahead, left = np.gradient(speed, t), speed * rate
    zero, stamps = np.zeros(len(t)), (t * 1e9).astype(np.int64)
    accel = np.column_stack([ahead, left, zero + 9.81]) + 0.1 * rng.normal(size=(len(t), 3))
    gyro = np.column_stack([zero, zero, rate]) + 0.003 * rng.normal(size=(len(t), 3))
    at = np.arange(0.0, 250.0, 0.2)
    fixes = np.interp(at, t, place - 0.5 * heads) + 0.15 * (rng.normal(size=(2, len(at))).T @ [1.0, 1j])
    motion = MeasuredMotion("fixes", 0, at + late_s, np.interp(at, t, speed), fixes)
    return motion_time_offset(Felt.of(stamps, accel, gyro, 9.81), motion)


@pytest.mark.parametrize("turn_deg", [45.0, 90.0, 150.0])
@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_a_delay_is_told_apart_from_turns(late_s: float, turn_deg: float) -> None:
    """By the heading instead of the chord, fixes in time looked 0.15, 0.5 and 0.9 s late, clearly."""
    for seed in range(2):
        offset = found(late_s, turn_deg, seed)
        assert offset is not None
        assert offset.clear == (late_s > 0.0)
        assert offset.value_s == pytest.approx(-late_s, abs=0.08 if offset.clear else 2.0 * offset.sigma_s + 0.05)


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_slow_fixes_tell_a_delay_as_fast_ones_do(late_s: float) -> None:
    """Fixes every 2 s, between which their motion is straight and what is felt was not: by five sigmas, 0.03 s, off."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 600.0, 1.0 / RATE_HZ)
    speed, rate = 3.0 + 1.5 * np.sin(0.4 * t), 0.15 * np.sin(0.2 * t) + 0.02
    heads, zero = np.exp(1j * integral(t, rate)), np.zeros(len(t))
    accel = np.column_stack([np.gradient(speed, t), speed * rate, zero + 9.81]) + 0.05 * rng.normal(size=(len(t), 3))
    at = np.arange(1.0, 599.0, 2.0)
    fixes = np.interp(at, t, integral(t, speed * heads)) + 0.01 * (rng.normal(size=(2, len(at))).T @ [1.0, 1j])
    motion = MeasuredMotion("fixes", 0, at + late_s, np.interp(at, t, speed), fixes)
    felt = Felt.of((t * 1e9).astype(np.int64), accel, np.column_stack([zero, zero, rate]), 9.81)
    offset = motion_time_offset(felt, motion)
    assert offset is not None
    assert offset.clear == (late_s > 0.0)
    assert offset.value_s == pytest.approx(-late_s, abs=0.015)


@pytest.mark.parametrize("late_s", [0.0, 2.2])
@pytest.mark.parametrize("seed", range(2))
def test_a_velocity_that_fails_in_a_tunnel_tells_no_delay_of_it(late_s: float, seed: int) -> None:
    """A car of 12 m/s that turns at the begin of tunnels and speeds up in them: the straight line across fitted an offset, clearly.

    An offset of 2.2 s was farther than was looked for.
    """
    rng, t = np.random.default_rng(seed), np.arange(0.0, 400.0, 1.0 / RATE_HZ)
    knots = np.arange(0.0, 401.0, 8.0)
    speed = gaussian_filter1d(np.interp(t, knots, rng.uniform(6.0, 15.0, len(knots))), RATE_HZ)
    rate = gaussian_filter1d(np.interp(t, knots, 0.1 * rng.normal(size=len(knots))), RATE_HZ)
    heads, zero = np.exp(1j * integral(t, rate)), np.zeros(len(t))
    accel = np.column_stack([np.gradient(speed, t), speed * rate, zero + 9.81]) + 0.1 * rng.normal(size=(len(t), 3))
    stamps, gyro = (t * 1e9).astype(np.int64), np.column_stack([zero, zero, rate])
    at = np.arange(0.0, 400.0, 0.1)
    at = at[~(((at > 85.0) & (at < 160.0)) | ((at > 222.0) & (at < 345.0)))]
    v = np.interp(at, t, speed * heads) + 0.08 * (rng.normal(size=(2, len(at))).T @ [1.0, 1j])
    motion = MeasuredMotion("velocity", 0, at + late_s, np.abs(v), integral(at, v))
    offset = motion_time_offset(Felt.of(stamps, accel, gyro, 9.81), motion)
    assert offset is not None
    assert offset.clear == (late_s > 0.0)
    assert offset.value_s == pytest.approx(-late_s, abs=0.05)
    if late_s == 0.0:  # nor does it blur how the IMU sits
        mount = yaw_in_craft(stamps, accel, gyro, [motion])
        assert mount is not None
        assert mount.coherence > 0.97
        assert mount.yaw_deg == pytest.approx(0.0, abs=2.0)


def test_differences_of_places_are_those_between_measurements() -> None:
    """Of uneven times, some of which come twice: by the matrices, and by the places interpolated at each of the three times."""
    rng = np.random.default_rng(2)
    at = np.sort(rng.uniform(0.0, 60.0, 150))
    at[40] = at[41]
    places = rng.normal(size=150) + 1j * rng.normal(size=150)
    middle, half_s = np.arange(at[0] + 3.0, at[-1] - 3.0, 0.5), 1.7
    middle[5], middle[6] = at[50], at[60] - half_s
    behind, here, ahead = (
        np.interp(t, at, places.real) + 1j * np.interp(t, at, places.imag)
        for t in (middle - half_s, middle, middle + half_s)
    )
    second, first = _bending(at, middle, half_s)
    np.testing.assert_allclose(second @ places, ahead - 2.0 * here + behind, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(first @ places, ahead - behind, rtol=1e-12, atol=1e-12)
