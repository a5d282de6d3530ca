# SPDX-License-Identifier: Apache-2.0
"""Predictions of the residuals of one sensor, jointly: the measurements share the error of the predicted estimate.

This error is modelled as a smooth process of unit variance in each of m independent directions. A root (k, m) per
measurement maps it to the residual, so that a right measurement conditions the prediction of the next (Gaussian
conditioning). Without this, two measurements that contradict each other would both fit a loose prediction. And two that
agree to centimetres, with a prediction that is 20 m off, would look like a repeated false error.
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

_LASTS_S = 60.0  # largest correlation time of the error of a prediction
# Additional random walk of the offset of an estimate in the wrong place: in a second this share of a false error's size
# (0.1 m of 5 m).
_OFFSET_WALK = 0.02


class PredictedResidual(NamedTuple):
    """The residuals of a measurement, predicted conditional on the right measurements before it.

    Attributes:
        modes: residual of each mode, less the expected error.
        cov: (k, k) of the remaining error; None: the measurement took part in the estimate.
        possible: False where the measurement contradicts the chain of measurements taken for right.
    """

    modes: tuple[Residual, ...]
    cov: Array | None
    possible: bool = True


class Prediction(NamedTuple):
    """The prediction of a residual.

    Attributes:
        root: (k, m), root of its covariance.
        lasts_s: correlation time of its error, s: sigma of position over that of velocity.
    """

    root: Array
    lasts_s: float = _LASTS_S

    @property
    def cov(self) -> Array:
        """Covariance (k, k)."""
        return self.root @ self.root.T


def prediction_of(residual: Residual, at: Attachment, P: Array, velocity_cov: Array) -> Prediction:
    """Return the prediction of a residual.

    Args:
        P: (m, m) of the state's pose in the body tangent (6) and of the sensor's slow state, where it has one. The
            latter is in it also for a residual that does not depend on it (a tag on the quay beside those of a dock),
            so that all roots have the same width.
        velocity_cov: (3, 3), (m/s)^2. Where velocity is less certain than position (at a start), the error changes
            quickly.
    """
    J = residual.jacobian()
    if (others := len(P) - J.shape[1]) > 0:
        slow = np.zeros((len(J), others)) if residual.slow_jacobian is None else residual.slow_jacobian()
        J = np.hstack([J, slow])
    turn = np.eye(len(P))
    # In the axes of world: an error keeps its direction while the vessel turns.
    turn[:3, :3] = turn[3:6, 3:6] = at.T_world_body.rotation().matrix()
    # The symmetric root is continuous in P, so that the roots of two states belong together.
    values, vectors = np.linalg.eigh(turn @ P @ turn.T)
    root = J @ turn.T @ (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    if residual.velocity_jacobian is not None:  # the correlation of pose and velocity is small and left out
        values, vectors = np.linalg.eigh(velocity_cov)
        by_velocity = residual.velocity_jacobian() @ (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        root = np.hstack([root, by_velocity])
    squared = float(np.trace(P[3:6, 3:6]) / max(np.trace(velocity_cov), 1e-12))
    return Prediction(root, min(float(np.sqrt(max(squared, 0.0))), _LASTS_S))


def predict_residuals(
    stream: Judged,
    indices: Sequence[int],
    residuals: Sequence[tuple[Residual, ...]],
    predictions: Sequence[Prediction | None],
    chain: Sequence[int | None],
) -> list[PredictedResidual]:
    """Return the residuals of N measurements, each predicted conditional on the right ones before it.

    Args:
        predictions: N; None for a measurement that took part in the estimate.
        chain: N modes that are taken for right (see `best_chain`); None: the measurement is not.
    """
    assert stream.row.false is not None
    chained = any(mode is not None for mode in chain)
    seen, last = [], None
    for n, (found, prediction) in enumerate(zip(residuals, predictions, strict=True)):
        if prediction is None:
            seen.append(PredictedResidual(found, None))
            continue
        mode_now = chain[n]
        possible = mode_now is not None or not chained
        if last is None:
            seen.append(PredictedResidual(found, prediction.cov, possible))
        else:
            j, before, mode = last
            m = stream.measurements[indices[n]]
            age_s = (m.stamp_ns - stream.measurements[indices[j]].stamp_ns) * 1e-9
            kept = kept_of(np.array([before.lasts_s]), prediction.lasts_s, np.array([age_s]))
            right = residuals[j][mode]
            mean, cov = carried(right.raw[None], right.cov[None], before.root[None], prediction.root, kept)
            modes = tuple(replace(r, raw=r.raw - mean[0]) for r in found)
            seen.append(
                PredictedResidual(modes, cov[0] + walk_of(stream.row.false(m, stream.config)) * age_s, possible)
            )
        if mode_now is not None:
            last = n, prediction, mode_now
    return seen


def kept_of(before_s: Array, now_s: float, ages_s: Array) -> Array:
    """Return the correlation (J,) between the errors of two predictions: smooth, as of an integrated velocity.

    Args:
        before_s: (J,) correlation times of the earlier ones. now_s: that of the later one. ages_s: (J,) in between.
    """
    return np.asarray(np.exp(-0.5 * (ages_s / np.maximum(np.minimum(before_s, now_s), 1e-6)) ** 2))


def carried(raw: Array, cov: Array, roots: Array, root: Array, kept: Array) -> tuple[Array, Array]:
    """Return mean (J, k) and covariance (J, k, k) of a residual's error, conditional on each of J right ones before it.

    Args:
        raw: (J, k) residuals before it. cov: (J, k, k) of their measurements. roots: (J, k, m) of their predictions.
        root: (k, m) of the prediction of the residual in question. kept: (J,), see `kept_of`.
    """
    cross = kept[:, None, None] * (roots @ root.T)  # (J, k before, k now)
    gain = np.linalg.solve(cov + roots @ roots.transpose(0, 2, 1), cross).transpose(0, 2, 1)
    return (gain @ raw[:, :, None])[:, :, 0], root @ root.T - gain @ cross


def moved(before: Prediction | None, now: Prediction | None, age_s: float) -> Array | float:
    """Return the covariance (k, k) of the change of the prediction's error from one residual to the next."""
    if before is None or now is None:
        alone = before or now
        return 0.0 if alone is None else alone.cov
    if before.root.shape != now.root.shape:
        return 0.0
    (kept,) = kept_of(np.array([before.lasts_s]), now.lasts_s, np.array([age_s]))
    cross = kept * (before.root @ now.root.T)
    return np.asarray(before.cov + now.cov - cross - cross.T)


def walk_of(model: FalseModel) -> Array:
    """Return the covariance (k, k) that the offset of an estimate in the wrong place gains in addition, per second."""
    return np.asarray(_OFFSET_WALK**2 * model.cov)


def taken_of(stream: Judged, indices: Sequence[int]) -> tuple[list[Measurement], list[FalseModel]]:
    """Return measurements of a sensor with hypotheses, and the model of each one's error if it is false."""
    assert stream.row.false is not None
    taken = [stream.measurements[i] for i in indices]
    return taken, [stream.row.false(m, stream.config) for m in taken]
