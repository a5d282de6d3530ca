# SPDX-License-Identifier: Apache-2.0
"""Noise of the IMU by the cost of a solved run, and by its residuals: the factor that explains them.

If engine and hull shake an IMU that is configured by its data sheet, the solution follows the IMU's noise, and is too
sure. The cost of the whole run hardly shows it, as most of it is of the other sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import diags_array
from scipy.special import chdtr, chdtrc

from graphloc.build import Problem, StartPrior, with_imu_noise
from graphloc.frames import Array
from graphloc.judge.decide import Verdicts
from graphloc.judge.linearised import linearised, normal_solver, normal_solver_and_log_det
from graphloc.measurements import ImuSeries
from graphloc.offsets import Misfit
from graphloc.signals.imu_scatter import noise_density

Solved = tuple[Any, Array, Callable[[Array], Array]]
"""J, weighted; residuals (rows,); and a function of y that solves J'J x = y."""
Parts = tuple[NDArray[np.intp], ...]
"""Row numbers of each part of a system."""

_DRAWS = 16  # random vectors for the estimate of a trace
_NOISE_ROUNDS, _LEAST_FREEDOM, _UNLIKELY = 5, 3.0, 1e-4
_UNLIKELY_IF_SCATTERED = 1e-2  # this is enough where the samples themselves say that the noise is larger
_FEWEST = 200  # fewest samples that show how much they scatter; how surely, ten times as many (`imu_scatter.FEWEST`)
_MOST_STEP = 3.0  # largest factor on the noise in a round
LEAST_TIMES = 1.5
"""Least factor by which the noise is raised: if it is smaller, the configured noise stays."""
CONTRADICTION = 2.5
"""Cost over its expectation from which the configured noise is not believed."""
LARGEST_NOISE_SCALE = 10.0
"""Largest credible factor on the noise: no IMU is so many times noisier than configured."""


def noise_step(ratio: float) -> float:
    """Return the factor by which the noise is scaled up at once where the cost is `ratio` times its expectation.

    It is 3 at most: modes and weights are chosen anew before the cost is looked at again.
    """
    return float(np.clip(np.sqrt(ratio), 1.5, 3.0))


class ImuMisfit(NamedTuple):
    """Misfit of the gyroscope, and of the accelerometer."""

    gyroscope: Misfit
    accelerometer: Misfit


def imu_misfit(
    unweighted: Any, root: Array, b: Array, solved: Solved, links: int, most: Sequence[float] = (1.0, 1.0)
) -> ImuMisfit:
    """Return the misfit of gyroscope and accelerometer, and by what factor other noise would explain it.

    Args:
        unweighted, b: J (rows, columns) and right side (rows,) before weighting. root: (rows,) roots of the weights.
        solved: the run with these weights.
        links: number of IMU factors, which come first, nine rows each: attitude (gyroscope), position, velocity.
        most: largest factor that is looked for, of each; 1: only whether the noise is smaller.
    """
    rows = np.arange(9 * links).reshape(-1, 9)
    own = rows[:, :3].ravel(), rows[:, 3:].ravel()
    squares, freedom = squares_and_freedom(solved, own)
    low = np.array([f > _LEAST_FREEDOM and chdtr(f, s) < _UNLIKELY for s, f in zip(squares, freedom, strict=True)])
    high = np.array([chdtrc(max(f, 0.1), s) < _UNLIKELY_IF_SCATTERED for s, f in zip(squares, freedom, strict=True)])
    high &= np.array(most) > 1.0
    needed, left = components((unweighted, root, b), own, (squares, freedom), low, high, most)
    sigma = needed / np.sqrt(2.0 * np.maximum(left, 1.0))
    return ImuMisfit(
        *(
            Misfit(squares=float(squares[k]), freedom=float(freedom[k]), needed=float(needed[k]), sigma=float(sigma[k]))
            for k in range(2)
        )
    )


def components(
    system: tuple[Any, Array, Array],
    parts: Parts,
    found: tuple[Array, Array],
    low: NDArray[np.bool_],
    high: NDArray[np.bool_],
    most: Sequence[float],
) -> tuple[Array, Array]:
    """Return the factors on the noise of parts of the rows that explain their residuals, and the freedom with these.

    With other noise the share of the other rows changes, so the factors are found in some rounds (variance components,
    Helmert).

    Args:
        system: J (rows, columns), roots of the weights (rows,), b (rows,), J and b before weighting.
        found: `squares_and_freedom` of this system.
        low, high: of each part, whether a factor below 1 is looked for, and one above 1, at most `most`.
    """
    (unweighted, root, b), (squares, freedom), needed = system, found, np.ones(len(parts))
    for _ in range(_NOISE_ROUNDS if (low | high).any() else 0):
        step = np.sqrt(squares / np.maximum(freedom, 1e-9))
        needed[low] *= np.clip(step, 0.3, 1.2)[low]
        needed[high] *= np.clip(step, 0.3, _MOST_STEP)[high]
        needed = np.minimum(needed, np.maximum(most, 1.0))
        scaled = root.copy()
        for part, times in zip(parts, needed, strict=True):
            scaled[part] /= times
        J = diags_array(scaled) @ unweighted
        solve = normal_solver(J)
        squares, freedom = squares_and_freedom((J, scaled * b - J @ solve(J.T @ (scaled * b)), solve), parts)
    return needed, freedom


def squares_and_freedom(solved: Solved, parts: Parts) -> tuple[Array, Array]:
    """Return the squared residuals of parts of the rows, and the parts' degrees of freedom.

    The latter are the trace of 1 - J (J'J)^-1 J' over each part (Hutchinson, random signs).
    """
    rng, (J, r, solve) = np.random.default_rng(0), solved
    signs = [rng.choice(np.array([-1.0, 1.0]), (len(part), _DRAWS)) for part in parts]
    back = np.hstack([J[part].T @ s for part, s in zip(parts, signs, strict=True)])
    explained = (back * solve(back)).sum(axis=0).reshape(len(parts), _DRAWS).mean(axis=1)
    squares = np.array([(r[part] ** 2).sum() for part in parts])
    return squares, np.maximum(np.array([len(part) for part in parts]) - explained, 0.0)


def log_likelihood(J: Any, b: Array, links: int, gyro: float, accel: float) -> float:
    """Return the restricted log-likelihood of a linear system whose IMU factors have more noise, up to a constant.

    Args:
        J, b: (rows, columns), (rows,), whitened with the noise as it is. links: as for `imu_misfit`.
        gyro, accel: factors on that noise.
    """
    weight = np.ones(len(b))
    weight[: 9 * links] = np.tile(np.repeat([1.0 / gyro, 1.0 / accel], [3, 6]), links)
    scaled, right = diags_array(weight) @ J, weight * b
    solve, log_det = normal_solver_and_log_det(scaled)
    r = right - scaled @ solve(scaled.T @ right)
    return float(-0.5 * (r @ r) - 0.5 * log_det + np.log(weight).sum())


def scattered(imu: ImuSeries, config: Any, noise_scale: float) -> Array:
    """Return (2,) by what factor the samples of gyroscope and accelerometer scatter more than their configured noise.

    1 where they are too few.
    """
    if len(imu) < _FEWEST:
        return np.ones(2)
    scatter = np.array([noise_density(imu.stamps_ns, columns)[0] for columns in (imu.gyro_radps, imu.accel_mps2)])
    return scatter / (np.array([config.gyro_noise_radps, config.accel_noise_mps2]) * noise_scale)


def with_needed_noise(problem: Problem, values: gtsam.Values, verdicts: Verdicts, prior: StartPrior) -> Problem | None:
    """Return the problem with as much IMU noise as its residuals need, if that is clearly more than it has; else None.

    The noise is raised only where the samples themselves scatter more, and only up to that: other causes of a misfit
    have other cures. Scatter alone is not enough, because vibration does not go on into the motion.
    """
    imu, config = problem.imu, problem.config.sensors[problem.imu.sensor]
    most = scattered(imu, config, problem.noise_scale)
    if (most < LEAST_TIMES).all():
        return None
    rows = linearised(problem, values, verdicts, prior)
    root, J, b = rows.weighed()
    try:
        solve = normal_solver(J)
        solved = J, b - J @ solve(J.T @ b), solve
        found = imu_misfit(rows.J, root, rows.b, solved, rows.states - 1, most.tolist())
    except RuntimeError:  # not determined by normal equations; the solution stands
        return None
    gyro, accel = (max(misfit.needed, 1.0) for misfit in found)
    return with_imu_noise(problem, gyro, accel) if max(gyro, accel) > LEAST_TIMES else None


def too_quiet(name: str, stated: Any, taken: Any) -> str:
    """Return a warning on an IMU whose noise is configured too small, and on what is taken; empty if it is not.

    Args:
        stated, taken: its configuration, and that with the noise that is taken.
    """
    changed = [
        f"{key} is {getattr(stated, key):.4g}, {getattr(taken, key):.4g} is taken"
        for key in ("accel_noise_ug_per_sqrt_hz", "gyro_noise_mdps_per_sqrt_hz")
        if getattr(taken, key) > getattr(stated, key)
    ]
    if not changed:
        return ""
    return f"{name}: its noise is configured too small for how its samples scatter: {'; '.join(changed)}"
