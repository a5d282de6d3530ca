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

_LASTS_S = 60.0  # at most: in which the error of a prediction becomes another one
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


class Prediction(NamedTuple):
    """What a prediction knows of a residual.

    Attributes:
        root: (k, m) of its covariance. lasts_s: in which the error becomes another one: sigma of place over that of velocity.
    """

    root: Array
    lasts_s: float = _LASTS_S

    @property
    def cov(self) -> Array:
        """Covariance (k, k)."""
        return self.root @ self.root.T


def prediction_of(residual: Residual, at: Attachment, P: Array, velocity_cov: Array) -> Prediction:
    """Return what a prediction knows of a residual.

    Args:
        P: (m, m) of the state's pose in the body tangent (6), and of the sensor's slow state, where it has one: also for
            a residual that has no part in that (a tag on the quay beside those of a dock), whose root is as wide.
        velocity_cov: (3, 3) in (m/s)^2. A start knows its place better than its velocity: a moment later it errs otherwise.
    """
    J = residual.jacobian()
    if (others := len(P) - J.shape[1]) > 0:
        slow = np.zeros((len(J), others)) if residual.slow_jacobian is None else residual.slow_jacobian()
        J = np.hstack([J, slow])
    turn = np.eye(len(P))
    # In world axes: an error stays where it is as the vessel turns.
    turn[:3, :3] = turn[3:6, 3:6] = at.T_world_body.rotation().matrix()
    # The symmetric root is one that changes little where P does, so that those of two states go together.
    values, vectors = np.linalg.eigh(turn @ P @ turn.T)
    root = J @ turn.T @ (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    if residual.velocity_jacobian is not None:  # what pose and velocity err together is left out: it is little
        values, vectors = np.linalg.eigh(velocity_cov)
        by_velocity = residual.velocity_jacobian() @ (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        root = np.hstack([root, by_velocity])
    squared = float(np.trace(P[3:6, 3:6]) / max(np.trace(velocity_cov), 1e-12))
    return Prediction(root, min(float(np.sqrt(max(squared, 0.0))), _LASTS_S))


def foresee(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    predictions: Sequence[Prediction | None],
    chain: Sequence[int | None],
) -> list[Foreseen]:
    """Return the residuals of N measurements as the prediction has them, given those before that are right.

    Args:
        predictions: N, or None where the measurement took part in the estimate.
        chain: N modes that are taken for right (see `best_chain`), or None.
    """
    assert stream.row.false is not None
    chained = any(mode is not None for mode in chain)
    seen, last = [], None
    for n, (found, prediction) in enumerate(zip(residuals, predictions, strict=True)):
        if prediction is None:
            seen.append(Foreseen(found, None))
            continue
        mode_now = chain[n]
        possible = mode_now is not None or not chained
        if last is None:
            seen.append(Foreseen(found, prediction.cov, possible))
        else:
            j, before, mode = last
            m = stream.measurements[indices[n]]
            age_s = (m.stamp_ns - stream.measurements[indices[j]].stamp_ns) * 1e-9
            kept = kept_of(np.array([before.lasts_s]), prediction.lasts_s, np.array([age_s]))
            right = residuals[j][mode]
            mean, cov = carried(right.raw[None], right.cov[None], before.root[None], prediction.root, kept)
            modes = tuple(replace(r, raw=r.raw - mean[0]) for r in found)
            seen.append(Foreseen(modes, cov[0] + walk_of(stream.row.false(m, stream.config)) * age_s, possible))
        if mode_now is not None:
            last = n, prediction, mode_now
    return seen


def kept_of(before_s: Array, now_s: float, ages_s: Array) -> Array:
    """Return the share (J,) of the error that is still the same, between two that last so long: it changes as a velocity does."""
    return np.asarray(np.exp(-0.5 * (ages_s / np.maximum(np.minimum(before_s, now_s), 1e-6)) ** 2))


def carried(raw: Array, cov: Array, roots: Array, root: Array, kept: Array) -> tuple[Array, Array]:
    """Return mean (J, k) and covariance (J, k, k) of the error in a residual, from one of J before it that is right.

    Args:
        raw: (J, k) residuals. cov: (J, k, k) of the measurements. roots: (J, k, m). kept: (J,), see `kept_of`.
        root: (k, m) of the residual in question.
    """
    cross = kept[:, None, None] * (roots @ root.T)  # (J, k before, k now)
    gain = np.linalg.solve(cov + roots @ roots.transpose(0, 2, 1), cross).transpose(0, 2, 1)
    return (gain @ raw[:, :, None])[:, :, 0], root @ root.T - gain @ cross


def moved(before: Prediction | None, now: Prediction | None, age_s: float) -> Array | float:
    """Return the covariance (k, k) of what the error has changed from one residual to the next."""
    if before is None or now is None:
        alone = before or now
        return 0.0 if alone is None else alone.cov
    if before.root.shape != now.root.shape:
        return 0.0
    (kept,) = kept_of(np.array([before.lasts_s]), now.lasts_s, np.array([age_s]))
    cross = kept * (before.root @ now.root.T)
    return np.asarray(before.cov + now.cov - cross - cross.T)


def walk_of(model: FalseModel) -> Array:
    """Return the covariance (k, k) that an offset gains in a second besides."""
    return np.asarray(_OFFSET_WALK**2 * model.cov)


def taken_of(stream: Judged, indices: Sequence[int]) -> tuple[list[Measurement], list[FalseModel]]:
    """Return measurements of a sensor that can be false, and what is known of each one's errors."""
    assert stream.row.false is not None
    taken = [stream.measurements[i] for i in indices]
    return taken, [stream.row.false(m, stream.config) for m in taken]
