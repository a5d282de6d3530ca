# SPDX-License-Identifier: Apache-2.0
"""Columns of numbers over time: interpolation, integrals, line fits, size and scatter, and runs in a mask."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array


def interpolated(t: NDArray[Any], at: NDArray[Any], columns: Array) -> Array:
    """Return columns (N, k), known at times `at` (N,), at times `t` (M,): linear between, constant beyond the ends."""
    return np.column_stack([np.interp(t, at, column) for column in columns.T])


def integral(t_s: Array, values: NDArray[Any]) -> NDArray[Any]:
    """Return the running integral of values (N, ...) over times (N,), by trapezia; real or complex, 0 at first."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s).reshape(-1, *[1] * (values.ndim - 1))
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(steps, axis=0)])


class LineFit(NamedTuple):
    """Straight line through values (N, k) over time, by least squares.

    Attributes:
        slope: (k,) per s. left: (N, k) residuals. sigma: of a component of the slope, per unit sigma of the values.
    """

    slope: Array
    left: Array
    sigma: float


def line_fit(t_s: Array, values: Array) -> LineFit:
    """Return the straight line through values (N, k) at times (N,)."""
    dt, around = t_s - t_s.mean(), values - values.mean(axis=0)
    square = max(float(dt @ dt), 1e-9)  # if all times are equal, the slope tells nothing
    slope = dt @ around / square
    return LineFit(slope, around - np.outer(dt, slope), 1.0 / float(np.sqrt(square)))


def rms(values: Array) -> float:
    """Return the root of the mean square of values (N, ...)."""
    return float(np.sqrt(np.mean(np.square(values))))


def robust_sigma(off: NDArray[Any]) -> Array:
    """Return the sigma (...) of values (N, ...) about zero, from their median size as for a normal distribution.

    Outliers hardly change it.
    """
    return np.asarray(1.4826 * np.median(np.abs(off), axis=0))


def runs(there: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the runs (K, 2) of true values in a mask (N,): the first index of each, and the one after its last."""
    return np.flatnonzero(np.diff(there, prepend=False, append=False)).reshape(-1, 2)
