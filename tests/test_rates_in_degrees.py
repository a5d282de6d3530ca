# SPDX-License-Identifier: Apache-2.0
"""Rates in deg/s roll a vessel by a quarter turn all the time, and gravity stays where it is."""

import numpy as np
import pytest

from graphloc.signals.rates_in_degrees import swing_of_degrees


@pytest.mark.parametrize("seconds", [4.99, 5.01, 5.5, 9.0, 30.0])
def test_a_stub_of_a_window_does_not_hide_them(seconds: float) -> None:
    """It rolls by 1 deg to either side every 3 s. With the hundredth of a second after the first window the swing was taken as half."""
    t = np.arange(0.0, seconds, 0.01)
    stamps_ns = np.round(t * 1e9).astype(np.int64)
    accel_mps2 = np.tile([0.0, 0.0, 9.81], (len(t), 1)) + np.random.default_rng(0).normal(0.0, 0.02, (len(t), 3))
    roll_rate = np.radians(1.0) * 2.0 * np.pi / 3.0 * np.cos(2.0 * np.pi * t / 3.0)
    rates = np.column_stack([roll_rate, 0.0 * t, 0.0 * t])
    assert swing_of_degrees(stamps_ns, accel_mps2, rates) == 0.0
    assert swing_of_degrees(stamps_ns, accel_mps2, np.degrees(rates)) == pytest.approx(2.0, abs=0.05)
