# SPDX-License-Identifier: Apache-2.0
"""Scatter of an IMU's samples: its white noise, with the vibration of engine and hull."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.signals.series import robust_sigma
from graphloc.signals.white_noise import white_noise_of_thirds

_BLOCK = 1000  # samples in a block
FEWEST = 2 * _BLOCK
"""Fewest samples that give the density with a sigma: two blocks. A tenth of them gives the density alone."""


def noise_density(stamps_ns: NDArray[np.int64], columns: Array) -> tuple[float, float]:
    """Return the white-noise density of the noisiest axis, and its sigma, by how it varies along the run.

    Args:
        stamps_ns: (N,). columns: (N, 3) in some unit; the density is in that unit per sqrt(Hz).
    """
    root_dt = float(np.sqrt(np.median(np.diff(stamps_ns)) * 1e-9))
    thirds = np.diff(columns, n=3, axis=0)
    blocks = np.array_split(thirds, max(len(thirds) // _BLOCK, 2))
    scatter = np.array([white_noise_of_thirds(block) for block in blocks]) * root_dt
    axis = int(np.argmax(np.median(scatter, axis=0)))
    found = float(np.median(scatter[:, axis]))
    spread = float(robust_sigma(scatter[:, axis] - found))
    steps = np.diff(np.unique(columns[:, axis]))
    floor = float(steps.min()) / np.sqrt(12.0) * root_dt if len(steps) else 0.0  # density of the rounding error alone
    return max(found, floor), max(1.25 * spread / float(np.sqrt(len(blocks))), 0.02 * found)
