# SPDX-License-Identifier: Apache-2.0
"""Noise models and robust kernels of all sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np

from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import Decision, Residual

_LOSSES: dict[str, Any] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
}


def with_floors(cov: Array, floors: Array | float) -> Array:
    """Return a covariance (k, k) with variances of at least `floors` (k,): sensors often claim too little noise."""
    raised = np.array(cov)
    variances = raised.ravel()[:: len(raised) + 1]
    np.maximum(variances, floors, out=variances)
    return raised


def walked(residual: Residual, by: Array | float) -> Residual:
    """Return a residual whose covariance is larger by `by` (k, k): by what its slow error walks between two nodes."""
    cov = residual.cov + by
    expected = float(np.trace(np.linalg.solve(cov, residual.cov)))
    return replace(residual, cov=cov, white=residual.cov, expected_nis=expected)


def noise_model(cov: Array, decision: Decision) -> Any:
    """Return a noise model of covariance (k, k) / weight, with the kernel of the decision."""
    scaled = np.asarray(cov, dtype=float) / decision.weight
    return _shared(scaled.tobytes(), len(scaled), decision.kernel)


@lru_cache(maxsize=256)  # a receiver often says the same of all its fixes, and factors can share what does not change
def _shared(scaled: bytes, size: int, kernel: KernelConfig | None) -> Any:
    cov = np.frombuffer(scaled).reshape(size, size)
    if np.count_nonzero(cov - np.diag(np.diagonal(cov))) == 0:
        base: Any = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(np.diagonal(cov)))
    else:
        base = gtsam.noiseModel.Gaussian.Covariance(cov)
    return robust(base, kernel)


def robust(base: Any, kernel: KernelConfig | None) -> Any:
    """Return a noise model with a kernel; unchanged for None or kind `none`."""
    if kernel is None or kernel.kind == "none":
        return base
    return gtsam.noiseModel.Robust.Create(_LOSSES[kernel.kind].Create(kernel.scale), base)
