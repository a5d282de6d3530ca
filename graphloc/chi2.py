# SPDX-License-Identifier: Apache-2.0
"""Limits of chi-square that several rooms compare with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from graphloc.frames import Array

CHI2_95 = {dof: float(chi2.ppf(0.95, dof)) for dof in (1, 2, 3)}
"""By degrees of freedom, what 95 % lie below: 3.84, 5.99, 7.81."""
SIGMAS_95 = CHI2_95[1] ** 0.5
"""Two-sided 95 % of a normal, in its sigmas: 1.96."""


def chi2_median(dof: int | NDArray[np.int64]) -> Array:
    """Return the medians of chi-square with so many degrees of freedom, as `dof` is shaped."""
    return np.asarray(chi2.median(dof))
