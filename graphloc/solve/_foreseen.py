# SPDX-License-Identifier: Apache-2.0
"""What a prediction says of the measurements of one sensor, together: its error is one error, which they share.

The error is a smooth process of unit variance in each of m independent directions. A root (k, m) for each measurement
says what these do to its residual, so what a right one before tells of the next is the mean and the
covariance of one Gaussian given another. Each by itself, two measurements that contradict each other both fit a
prediction that is loose, and two that agree to centimetres under one that is 20 m off look like a repeated error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphloc.build import Judged
from graphloc.frames import Array
from graphloc.graph import Attachment, FalseModel, Residual
from graphloc.measurements import Measurement

_PREDICTED_S = 60.0  # in which the error of a prediction becomes another one
# How fast the offset of an estimate in the wrong place may move besides: a random walk of this share of a false
# error's size in a second (0.1 m of 5 m).
_OFFSET_WALK = 0.02


class Foreseen(NamedTuple):
    """A residual, its prediction's error known as far as right ones before it tell.

    Attributes:
        modes: the residual of each mode, less the error that is expected.
        cov: (k, k) of the error that is left; None: the measurement took part in the estimate.
        possible: False where it contradicts the chain of those that are taken for right.
    """

    modes: tuple[Residual, ...]
    cov: Array | None
    possible: bool = True


def root_of(residual: Residual, at: Attachment, P: Array) -> Array:
    """Return a root (k, m) of the covariance that the prediction gives a residual.

    Args:
        P: (m, m) of the state's pose in the body tangent (6), and of the slow state, where the residual has one.
    """
    J = residual.jacobian()
    if residual.slow_jacobian is not None and len(P) > J.shape[1]:
        J = np.hstack([J, residual.slow_jacobian()])
    turn = np.eye(len(P))
    turn[:3, :3] = turn[3:6, 3:6] = (
        at.T_world_body.rotation().matrix()
    )  # an error stays where it is as the vessel turns
    # The symmetric root: the only one that changes no more than P does, so that those of two states go together.
    values, vectors = np.linalg.eigh(turn @ P @ turn.T)
    return np.asarray(J @ turn.T @ (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def foresee(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    roots: Sequence[Array | None],
    chain: Sequence[int | None],
) -> list[Foreseen]:
    """Return the residuals of N measurements as the prediction has them, given those before that are right.

    Args:
        roots: N, of the prediction (see `root_of`), or None where the measurement took part in it.
        chain: N modes that are taken for right (see `best_chain`), or None.
    """
    taken, models = taken_of(stream, indices)
    chained = any(mode is not None for mode in chain)
    seen, last = [], None
    for n, (found, root) in enumerate(zip(residuals, roots, strict=True)):
        if root is None:
            seen.append(Foreseen(found, None))
            continue
        mode_now = chain[n]
        possible = mode_now is not None or not chained
        if last is None:
            seen.append(Foreseen(found, root @ root.T, possible))
        else:
            j, before, mode = last
            age_s = np.array([(taken[n].stamp_ns - taken[j].stamp_ns) * 1e-9])
            right = residuals[j][mode]
            mean, cov = carried(right.raw[None], right.cov[None], before[None], root, age_s)
            modes = tuple(replace(r, raw=r.raw - mean[0]) for r in found)
            seen.append(Foreseen(modes, cov[0] + walk_of(models[n]) * age_s[0], possible))
        if mode_now is not None:
            last = n, root, mode_now
    return seen


def carried(raw: Array, cov: Array, roots: Array, root: Array, ages_s: Array) -> tuple[Array, Array]:
    """Return mean (J, k) and covariance (J, k, k) of the error in a residual, from one of J before it that is right.

    Args:
        raw: (J, k) residuals. cov: (J, k, k) of the measurements. roots: (J, k, m). ages_s: (J,) since each.
        root: (k, m) of the residual in question.
    """
    cross = _kept(ages_s)[:, None, None] * (roots @ root.T)  # (J, k before, k now)
    gain = np.linalg.solve(cov + roots @ roots.transpose(0, 2, 1), cross).transpose(0, 2, 1)
    return (gain @ raw[:, :, None])[:, :, 0], root @ root.T - gain @ cross


def moved(before: Array | None, now: Array | None, age_s: float) -> Array | float:
    """Return the covariance (k, k) of what the error has changed from one residual to the next."""
    if before is None or now is None:
        alone = before if now is None else now
        return 0.0 if alone is None else np.asarray(alone @ alone.T)
    if before.shape != now.shape:
        return 0.0
    cross = float(_kept(age_s)) * (before @ now.T)
    return np.asarray(before @ before.T + now @ now.T - cross - cross.T)


def walk_of(model: FalseModel) -> Array:
    """Return the covariance (k, k) that an offset gains in a second besides."""
    return np.asarray(_OFFSET_WALK**2 * model.cov)


def taken_of(stream: Judged, indices: Sequence[int]) -> tuple[list[Measurement], list[FalseModel]]:
    """Return measurements of a sensor that can be false, and what is known of each one's errors."""
    assert stream.row.false is not None
    taken = [stream.measurements[i] for i in indices]
    return taken, [stream.row.false(m, stream.config) for m in taken]


def _kept(age_s: Array | float) -> Array:
    """Share of the error that is still the same. It has a rate: 20 m move 0.3 m in a second, as a velocity does."""
    return np.asarray(np.exp(-0.5 * (np.asarray(age_s) / _PREDICTED_S) ** 2))
