# SPDX-License-Identifier: Apache-2.0
"""White noise of a signal that moves smoothly: of inertial samples, of places."""

from __future__ import annotations

import numpy as np

from graphloc.frames import Array
from graphloc.signals.series import robust_sigma


def white_noise(columns: Array) -> Array:
    """Return the white noise (k,) of the columns of a signal (N, k) at even times, 1 sigma, in their unit."""
    return white_noise_of_thirds(np.diff(columns, n=3, axis=0))


def white_noise_of_thirds(thirds: Array) -> Array:
    """Return the white noise (k,), 1 sigma, from third differences (N, k).

    They hold nothing of a constant acceleration; those of white noise have 1 + 9 + 9 + 1 times its variance. Their median is that of
    most of them, whatever jumps among the others.
    """
    return np.asarray(robust_sigma(thirds) / np.sqrt(20.0))
