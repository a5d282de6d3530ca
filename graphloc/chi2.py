# SPDX-License-Identifier: Apache-2.0
"""Limits of chi-square that several rooms compare with.

By `scipy.special`: to import `scipy.stats` takes a fifth of the time that `graphloc stream` needs to begin.
"""

from __future__ import annotations

from functools import cache

from scipy.special import gammaincinv


def chi2_below(share: float, dof: int) -> float:
    """Return what a share of chi-square with so many degrees of freedom lies below."""
    return float(2.0 * gammaincinv(0.5 * dof, share))


@cache
def chi2_95(dof: int) -> float:
    """Return what 95 % of chi-square with so many degrees of freedom lie below: 3.84, 5.99, 7.81, ..."""
    return chi2_below(0.95, dof)


@cache
def chi2_median(dof: int) -> float:
    """Return the median of chi-square with so many degrees of freedom."""
    return chi2_below(0.5, dof)


SIGMAS_95 = chi2_95(1) ** 0.5
"""Two-sided 95 % of a normal, in its sigmas: 1.96."""
