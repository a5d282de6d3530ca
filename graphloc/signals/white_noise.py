# SPDX-License-Identifier: Apache-2.0
"""White noise of a signal that varies smoothly, such as inertial samples or positions."""

from __future__ import annotations

import numpy as np

from graphloc.frames import Array
from graphloc.signals.series import robust_sigma


def white_noise(columns: Array) -> Array:
    """Return the white noise (k,) of the columns of a signal (N, k) at even times, 1 sigma, in their unit."""
    return white_noise_of_thirds(np.diff(columns, n=3, axis=0))


def white_noise_of_thirds(thirds: Array) -> Array:
    """Return the white noise (k,), 1 sigma, from third differences (N, k).

    A constant acceleration has no part in them; white noise gives them 1 + 9 + 9 + 1 times its variance. Their median
    is hardly changed by a few that jump.
    """
    return np.asarray(robust_sigma(thirds) / np.sqrt(20.0))
