# SPDX-License-Identifier: Apache-2.0
"""Fit the matcher's weights by maximum likelihood, on harbours that no figure uses.

The true cell's share of the posterior, or that of its neighbours, is made as large as it will go; some views show
nothing that could tell, so a uniform posterior has a share, fitted too. Prints the weights that stand in
`frontends/aerial/maps.py`, for an image alone and for an image with a user's lines.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from _scenes import WINDOW_DEG, WINDOW_M, Sample, samples, scratch, together
from numpy.typing import NDArray
from scipy.optimize import minimize

from graphloc.errors import InputError
from graphloc.frontends.aerial.layers import Weights
from graphloc.frontends.aerial.maps import Map
from graphloc.frontends.aerial.match import grid_around, log_likelihood_of, modes_of
from graphloc.frontends.aerial.scan import outline

Volumes = NDArray[np.float32]
Cell = tuple[int, ...]
# Each weight alone: the log-likelihood is linear in them.
_UNITS = (Weights(1.0, 0.0, 0.0), Weights(0.0, 1.0, 0.0), Weights(0.0, 0.0, 1.0))


def volumes(sample: Sample, drawn: bool) -> tuple[Volumes, Cell] | None:
    """Log-likelihood of each weight (3, H, R, C), and the true cell; None of a view of next to nothing."""
    config = sample.config.model_copy(
        update={"image": sample.image.name, "vector": sample.vector.name if drawn else ""}
    )
    found = outline(together(sample.clouds), np.array(config.hull_m), config.reach_m)
    if len(found.faces_m) + len(found.shore_m) < 30:
        return None
    parts = []
    for unit in _UNITS:
        layers = Map(config, sample.image.parent, sample.datum, unit, unit).around(sample.prior.pose, found)
        grid = grid_around(layers, sample.prior.pose, WINDOW_M, WINDOW_DEG)
        parts.append(log_likelihood_of(found, layers, grid))
    cell = tuple(
        int(np.abs(axis - true).argmin())
        for axis, true in zip((grid.yaw_rad, grid.north_m, grid.east_m), sample.true[[2, 1, 0]], strict=True)
    )
    return np.stack(parts), cell


def contrasts(sample: Sample, drawn: bool, rng: np.random.Generator) -> list[tuple[float, bool]]:
    """How high the best pose stands over the mean, and whether it is right: the truth in the window, and twice not."""
    config = sample.config.model_copy(
        update={"image": sample.image.name, "vector": sample.vector.name if drawn else ""}
    )
    found = outline(together(sample.clouds), np.array(config.hull_m), config.reach_m)
    if len(found.faces_m) + len(found.shore_m) < 30:
        return []
    seen = []
    for far in (False, True, True):
        pose = sample.prior.pose.copy()
        if far:
            turn, away = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(10.0, 25.0)
            pose[:2] = sample.true[:2] + away * np.array([np.cos(turn), np.sin(turn)])
        try:
            layers = Map(config, sample.image.parent, sample.datum).around(pose, found)
        except InputError:  # the image ends there
            continue
        grid = grid_around(layers, pose, WINDOW_M, WINDOW_DEG)
        score = log_likelihood_of(found, layers, grid)
        modes, _ = modes_of(score, grid, -1e9, 0.0, most=1)
        if not modes:  # a slope: the top lies outside
            continue
        (mode,) = modes
        off = mode.pose - sample.true
        right = not far and bool(off @ np.linalg.solve(mode.cov, off) < 11.3)
        right |= bool(np.hypot(*off[:2]) < 1.0 and abs(np.degrees(off[2])) < 1.5)
        seen.append((float(score.max() - score.mean()), right))
    return seen


def fit_contrast(seen: list[tuple[float, bool]]) -> NDArray[np.float64]:
    """Log-odds (constant, slope) of right by contrast, wrong ones weighed as many as right ones."""
    x, y = np.array([c for c, _ in seen]), np.array([float(r) for _, r in seen])
    weight = np.where(y > 0.0, 0.5 / y.sum(), 0.5 / (1.0 - y).sum())

    def miss(b: NDArray[np.float64]) -> float:
        odds = b[0] + b[1] * x
        return float((weight * (np.logaddexp(0.0, odds) - y * odds)).sum())

    return np.asarray(minimize(miss, np.zeros(2)).x)


def _of_world(
    seed: int, folder: Path, views: int
) -> tuple[list[list[tuple[Volumes, Cell] | None]], list[tuple[float, bool]]]:
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    made = [*samples("world", seed, folder, views), *samples("world", seed, folder, views // 2, scans=8)]
    rng = np.random.default_rng([seed, 5])
    seen = [c for drawn in (False, True) for sample in made[:2] for c in contrasts(sample, drawn, rng)]
    return [[volumes(sample, drawn) for sample in made] for drawn in (False, True)], seen


def loss(z: NDArray[np.float64], views: list[tuple[Volumes, Cell]]) -> tuple[float, NDArray[np.float64]]:
    """Mean negative log-likelihood and its gradient; z: the weights, and the logit of the uniform share."""
    uniform = 1.0 / (1.0 + np.exp(-z[-1]))
    total, slope = 0.0, np.zeros_like(z)
    for volume, cell in views:
        score = np.tensordot(z[:-1], volume, 1)
        mass = np.exp(score - score.max())
        mass /= mass.sum()
        around = tuple(slice(max(k - 1, 0), k + 2) for k in cell)
        right, flat = mass[around].sum(), mass[around].size / mass.size
        here = (1.0 - uniform) * right + uniform * flat
        total -= np.log(here)
        mean = np.tensordot(volume, mass, 3)
        moved = np.tensordot(volume[(slice(None), *around)], mass[around], 3) - right * mean
        slope[:-1] -= (1.0 - uniform) * moved / here
        slope[-1] -= (flat - right) / here * uniform * (1.0 - uniform)
    return total / len(views), slope / len(views)


def fit(views: list[tuple[Volumes, Cell]]) -> Any:
    """Fit from a start where many views count as uniform, so that none is a wall to climb."""
    z = np.array([0.3, 0.3, 0.3, 0.0])
    for least in (-0.5, -4.0):
        bounds = [(0.0, None)] * 3 + [(least, 2.0)]
        found = minimize(loss, z, (views,), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 300})
        z = found.x
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--worlds", type=int, default=80)
    parser.add_argument("--views", type=int, default=4, help="of one scan of each world; half as many of eight")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 2)
    arguments = parser.parse_args()
    folder = scratch()
    job = partial(_of_world, folder=folder, views=arguments.views)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        worlds = list(pool.map(job, range(2000, 2000 + arguments.worlds)))
    for k, name in enumerate(("image", "image and lines")):
        views = [view for world, _ in worlds for view in world[k] if view is not None]
        found = fit(views)
        low, tall, shore, logit = found.x
        print(
            f"{name}: Weights(low={low:.2f}, tall={tall:.2f}, shore={shore:.2f}); uniform share "
            f"{1.0 / (1.0 + np.exp(-logit)):.3f}; loss {found.fun:.3f} over {len(views)} views; {found.message}"
        )
    seen = [c for _, contrast in worlds for c in contrast]
    print(f"contrast: log-odds (constant, slope) {np.round(fit_contrast(seen), 3)} over {len(seen)} windows")


if __name__ == "__main__":
    main()
