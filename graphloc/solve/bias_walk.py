# SPDX-License-Identifier: Apache-2.0
"""Walk of the IMU's biases by a solved run: how many times the configured one explains how far they went.

A cheap IMU that warms up wanders by a hundred times what a good one does. Held to its configured walk it bends the track, its bounds
are too small, and it seems to contradict the other sensors.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy.special import chdtrc

from graphloc import keys
from graphloc.build import Problem, StartPrior, with_imu_scaled
from graphloc.frames import Array
from graphloc.solve.decide import Verdicts
from graphloc.solve.imu_noise import components, squares_and_freedom
from graphloc.solve.linearised import linearised, normal_solver
from graphloc.time import NS_PER_S

WANDERS_S = 60.0
"""Time over which it is looked at how far a bias has gone."""
KEYS = ("accel_bias_instability_ug", "gyro_bias_instability_deg_per_h")
"""What is configured of accelerometers and gyroscopes."""
_WANDERS = 3.0  # sigmas of its random walk over that: smoothed, a bias that walks so moves by less than two
_UNLIKELY, _LEAST_TIMES = 1e-4, 2.0
MOST_TIMES = 100.0
"""No bias walks so many times faster than configured."""


def wandered(problem: Problem, values: gtsam.Values) -> Array:
    """Return how far accelerometers and gyroscopes have gone (2,), the worst axis of each, in sigmas of their random walk, within a minute; 0 in a shorter run."""
    nodes, first = np.unique(problem.timeline.slow_of, return_index=True)
    t_s = (problem.timeline.stamps_ns[first] - problem.timeline.stamps_ns[0]) / NS_PER_S
    later = np.searchsorted(t_s, t_s + WANDERS_S)
    begin = np.flatnonzero(later < len(t_s))
    if not len(begin):
        return np.zeros(2)
    of = [values.atConstantBias(keys.bias(int(j))) for j in nodes]
    bias = np.array([np.concatenate([b.accelerometer(), b.gyroscope()]) for b in of])
    gone = np.abs(bias[later[begin]] - bias[begin]).max(axis=0) / problem.links.bias_steps(WANDERS_S)
    return np.asarray(gone.reshape(2, 3).max(axis=1))


def with_needed_walk(problem: Problem, values: gtsam.Values, verdicts: Verdicts, prior: StartPrior) -> Problem | None:
    """Return the problem with as much walk of the biases as the run needs, where that is clearly more than it has; else None."""
    high = wandered(problem, values) > _WANDERS
    if not high.any():
        return None
    rows = linearised(problem, values, verdicts, prior)
    root, J, b = rows.weighed()
    steps = np.arange(6 * (len(problem.timeline.slow_stamps_ns) - 1)).reshape(-1, 6) + 9 * (rows.states - 1)
    parts = steps[:, :3].ravel(), steps[:, 3:].ravel()
    try:
        solve = normal_solver(J)
        found = squares_and_freedom((J, b - J @ solve(J.T @ b), solve), parts)
        high &= chdtrc(np.maximum(found[1], 0.1), found[0]) < _UNLIKELY
        needed, _ = components((rows.J, root, rows.b), parts, found, np.zeros(2, dtype=bool), high, [MOST_TIMES] * 2)
    except RuntimeError:  # not determined by normal equations; the solution stands
        return None
    times = {key: float(t) for key, t in zip(KEYS, needed, strict=True) if t > _LEAST_TIMES}
    return with_imu_scaled(problem, times) if times else None


def walk_times(stated: Any, taken: Any) -> dict[str, float]:
    """Return by what factors the walk of the biases is larger in one configuration of an IMU than in another, by key; without those of 1."""
    every = {key: getattr(taken, key) / getattr(stated, key) for key in KEYS}
    return {key: times for key, times in every.items() if times > 1.0}


def too_steady(name: str, stated: Any, taken: Any) -> str:
    """Return a line on an IMU whose biases walk farther than configured, and what is taken instead; empty where they do not.

    Args:
        stated, taken: its configuration, and that with the walk that is taken.
    """
    changed = [
        f"{key} is {getattr(stated, key):.3g}, {getattr(taken, key):.3g} is taken" for key in walk_times(stated, taken)
    ]
    if not changed:
        return ""
    return f"{name}: its biases change more than configured (it warms up, or is a cheap one; a scale or an axis that is off looks so, too): {'; '.join(changed)}"
