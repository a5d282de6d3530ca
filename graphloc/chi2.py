# SPDX-License-Identifier: Apache-2.0
"""Quantiles of chi-square.

They come of `scipy.special`, because importing `scipy.stats` takes a fifth of the time in which `graphloc stream` begins.
"""

from __future__ import annotations

from functools import cache

from scipy.special import gammaincinv


def chi2_below(share: float, dof: int) -> float:
    """Return the quantile of chi-square, with `dof` degrees of freedom, below which a share lies."""
    return float(2.0 * gammaincinv(0.5 * dof, share))


@cache
def chi2_95(dof: int) -> float:
    """Return the 95 % quantile of chi-square with `dof` degrees of freedom: 3.84, 5.99, 7.81, ..."""
    return chi2_below(0.95, dof)


@cache
def chi2_median(dof: int) -> float:
    """Return the median of chi-square with `dof` degrees of freedom."""
    return chi2_below(0.5, dof)


SIGMAS_95 = chi2_95(1) ** 0.5
"""Sigmas within which 95 % of a normal distribution lie, on both sides: 1.96."""
