# SPDX-License-Identifier: Apache-2.0
"""Limits of chi-square that several rooms compare with."""

from __future__ import annotations

from functools import cache

from scipy.stats import chi2


@cache
def chi2_95(dof: int) -> float:
    """Return what 95 % of chi-square with so many degrees of freedom lie below: 3.84, 5.99, 7.81, ..."""
    return float(chi2.ppf(0.95, dof))


@cache
def chi2_median(dof: int) -> float:
    """Return the median of chi-square with so many degrees of freedom."""
    return float(chi2.median(dof))


SIGMAS_95 = chi2_95(1) ** 0.5
"""Two-sided 95 % of a normal, in its sigmas: 1.96."""
