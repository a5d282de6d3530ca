# SPDX-License-Identifier: Apache-2.0
"""How far the IMU's biases walk by a solved run: the factor on their configured random walk that explains it.

A cheap IMU that warms up wanders by a hundred times what a good one does. Held to its configured walk it bends the
track, its bounds are too small, and it seems to contradict the other sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc

from graphloc import keys
from graphloc.build import Past, Problem, StartPrior, with_imu_scaled
from graphloc.frames import Array
from graphloc.inertial import InertialLink
from graphloc.judge.decide import Verdicts
from graphloc.judge.imu_noise import components, squares_and_freedom
from graphloc.judge.linearised import linearised, normal_solver
from graphloc.time import NS_PER_S

WANDERS_S = 60.0
"""Time, s, over which the change of a bias is looked at."""
WALK_KEYS = ("accel_bias_instability_ug", "gyro_bias_instability_deg_per_h")
"""Keys that configure the walk of the biases of accelerometers and gyroscopes."""
# Sigmas of the random walk over `WANDERS_S`, from which variance components test whether a bias needs more of it
# (`_UNLIKELY`): one that walks as configured moves, smoothed, by less than two. A warning alone, where the walk is not
# to be raised, has no such test, and a higher bound.
_LOOKED_AT = 3.0
# Probabilities of a change below which it is too large: of the whole change (with ten looks every ten seconds, chance
# gives one in about 150 h), and of each part of it.
_TOO_FAR, _A_PART = 1e-6, 0.01
# Most and least factor at once: what is known is too sure as well, so more is not believed.
_MOST_STEP, _LEAST_STEP = 10.0, 1.3
_LEAST_SHARE = 0.1  # share of the variance of the walk that is allowed though the data deny it: rounding
_UNLIKELY, _LEAST_TIMES = 1e-4, 2.0
MOST_TIMES = 100.0
"""Largest factor on the walk: online in all, offline by one round of variance components."""


class BiasWanders(Exception):
    """The biases walk farther than configured.

    Attributes:
        times: factors on their walk, by key of the IMU's configuration.
    """

    def __init__(self, times: dict[str, float]) -> None:
        super().__init__(times)
        self.times = times


class KnownBias(NamedTuple):
    """Biases (6,), accelerometers first, and their variances (6,), at a stamp."""

    stamp_ns: int
    bias: Array
    variance: Array


def known_bias(problem: Problem, values: gtsam.Values, k: int, past: Past) -> KnownBias:
    """Return the biases at state `k` by all data before it.

    Args:
        values: near those that these data were linearised at.
    """
    own, order = keys.bias(int(problem.timeline.slow_of[k])), gtsam.Ordering()
    for key in (*(key for key in past.known if key != own), own):
        order.push_back(key)
    A, b = past.factors.linearize(values).jacobian(order)
    Q, R = np.linalg.qr(A)
    root = np.linalg.solve(R[-6:, -6:], np.eye(6))
    bias = values.atConstantBias(own).vector() + root @ (Q.T @ b)[-6:]
    return KnownBias(int(problem.timeline.stamps_ns[k]), bias, np.diagonal(root @ root.T))


def wandered(problem: Problem, values: gtsam.Values) -> Array:
    """Return how far (2,) accelerometers and gyroscopes went within a minute, in sigmas of their random walk.

    Of each, it is that of the worst axis; 0 in a shorter run.
    """
    t_s = (problem.timeline.slow_stamps_ns - problem.timeline.slow_stamps_ns[0]) / NS_PER_S
    later = np.searchsorted(t_s, t_s + WANDERS_S)
    begin = np.flatnonzero(later < len(t_s))
    if not len(begin):
        return np.zeros(2)
    bias = np.array([values.atConstantBias(keys.bias(j)).vector() for j in range(len(t_s))])
    stamps = problem.timeline.slow_stamps_ns.tolist()
    steps = [problem.links.bias_steps(*step) ** 2 for step in pairwise(stamps)]
    walk = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
    by_walk = np.sqrt(walk[later[begin]] - walk[begin])
    gone = (np.abs(bias[later[begin]] - bias[begin]) / by_walk).max(axis=0)
    return np.asarray(gone.reshape(2, 3).max(axis=1))


def went_too_far(
    before: Sequence[KnownBias], now: KnownBias, links: InertialLink, *, lasting: bool = False
) -> tuple[int, float] | None:
    """Return which biases went too far (0: accelerometers, 1: gyroscopes) and the factor on the walk that explains it.

    None: none did. An estimate that is as good as it says goes from b with covariance P to b' with P' by N(0, P + Q -
    P'), Q: the walk in between.

    Args:
        before: what was known of the biases by less data, by stamp. now: what is known.
        lasting: whether they must have gone on in two parts of that time: where an estimate is corrected, they change
            once.
    """

    def likely(then: KnownBias, later: KnownBias, k: int) -> float:
        return _likely(_gone(then, later, links, k))

    def lasts(then: KnownBias, k: int) -> bool:
        between = (mid for mid in before if mid.stamp_ns > then.stamp_ns)
        return any(max(likely(then, mid, k), likely(mid, now, k)) < _A_PART for mid in between)

    pairs = [(then, k) for then in before for k in range(2) if not lasting or lasts(then, k)]
    if not pairs:
        return None
    # Biases that wander bend the others, so the least likely ones are those that wander.
    then, k = min(pairs, key=lambda pair: likely(pair[0], now, pair[1]))
    times = _needed(_gone(then, now, links, k))
    return (k, times) if likely(then, now, k) < _TOO_FAR and times > _LEAST_STEP else None


def _gone(then: KnownBias, now: KnownBias, links: InertialLink, k: int) -> Array:
    """Return (3, 3): squared change, P - P' and Q (see `went_too_far`) of each axis of one kind, `k`, of sensor."""
    walk = links.bias_steps(then.stamp_ns, now.stamp_ns) ** 2
    each = np.array([(now.bias - then.bias) ** 2, then.variance - now.variance, walk])
    return each[:, 3 * k : 3 * k + 3]


def _squares(gone: Array, times: float) -> float:
    """Return the sum of the squared changes of three biases over their variances, with their walk `times` as large.

    Args:
        gone: as of `_gone`.
    """
    squares, known, walk = gone
    return float((squares / np.maximum(known + times**2 * walk, _LEAST_SHARE * walk)).sum())


def _likely(gone: Array) -> float:
    """Return the probability that three biases change as far as they did, or farther; `gone`: as of `_gone`."""
    return float(chdtrc(gone.shape[1], _squares(gone, 1.0)))


def _needed(gone: Array) -> float:
    """Return the factor on the walk that explains the change, at most `_MOST_STEP`; `gone`: as of `_gone`."""

    def beyond(times: float) -> float:
        return _squares(gone, times) - float(gone.shape[1])

    if beyond(1.0) < 0.0:
        return 1.0
    if beyond(_MOST_STEP) > 0.0:
        return _MOST_STEP
    found: float = brentq(beyond, 1.0, _MOST_STEP)
    return found


def with_needed_walk(problem: Problem, values: gtsam.Values, verdicts: Verdicts, prior: StartPrior) -> Problem | None:
    """Return the problem with as much walk of the biases as the run needs, if that is clearly more than it has.

    Else None.
    """
    high = wandered(problem, values) > _LOOKED_AT
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
    times = {key: float(t) for key, t in zip(WALK_KEYS, needed, strict=True) if t > _LEAST_TIMES}
    return with_imu_scaled(problem, times) if times else None


def walk_times(stated: Any, taken: Any) -> dict[str, float]:
    """Return, by key, the factors by which the biases of an IMU walk farther in one configuration than in another.

    Factors of 1 are left out.
    """
    every = {key: getattr(taken, key) / getattr(stated, key) for key in WALK_KEYS}
    return {key: times for key, times in every.items() if times > 1.0}


def too_steady(name: str, stated: Any, taken: Any) -> str:
    """Return a warning on an IMU whose biases walk farther than configured, and on what is taken; empty if they do not.

    Args:
        stated, taken: its configuration, and that with the walk that is taken.
    """
    changed = [
        f"{key} is {getattr(stated, key):.3g}, {getattr(taken, key):.3g} is taken" for key in walk_times(stated, taken)
    ]
    if not changed:
        return ""
    return f"{name}: its biases change more than configured (it is warming up, or a cheap IMU; a wrong scale or a misaligned axis looks the same): {'; '.join(changed)}"
