# SPDX-License-Identifier: Apache-2.0
"""Squares and densities of small Gaussian residuals, which every pass computes.

A direct call of LAPACK takes a quarter of the time of `np.linalg.solve` and `slogdet`.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf, dtrtri

from graphloc.frames import Array

_LOG_TAU = math.log(math.tau)


def square(raw: Array, cov: Array) -> float:
    """Return raw' cov^-1 raw of a residual (k,) and its covariance (k, k)."""
    if len(raw) == 1:
        return float(raw[0]) ** 2 / float(cov[0, 0])
    _, solved, failed = dposv(cov, raw)
    return float(raw @ (np.linalg.solve(cov, raw) if failed else solved))


def whitening(cov: Array) -> Array:
    """Return the lower triangular W (k, k) with W'W = cov^-1, which makes residuals of covariance (k, k) white.

    Raises:
        numpy.linalg.LinAlgError: the covariance is not positive definite.
    """
    root, failed = dpotrf(cov, lower=1)
    if failed:
        raise np.linalg.LinAlgError("covariance not positive definite")
    return np.asarray(dtrtri(root, lower=1)[0])


def log_density(raw: Array, cov: Array) -> float:
    """Return the log of the Gaussian density of a residual (k,) with covariance (k, k)."""
    root, solved, failed = dposv(cov, raw)
    if failed:  # not positive definite, to rounding
        nis, log_det = float(raw @ np.linalg.solve(cov, raw)), float(np.linalg.slogdet(cov)[1])
    else:
        nis, log_det = float(raw @ solved), 2.0 * sum(map(math.log, root.diagonal().tolist()))
    return -0.5 * (nis + log_det + len(raw) * _LOG_TAU)
