# SPDX-License-Identifier: Apache-2.0
"""Errors that last: positions whose residuals resemble those before them, although they count as independent.

A track that other sensors carry (wheels, a Doppler log) shows such an error. As far as the track follows the positions,
their errors are in it and not in the residuals. So an error that is found is a lower limit, and none found proves
nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from graphloc.build import Stream
from graphloc.frames import Array
from graphloc.judge.decide import AGREES, Verdict
from graphloc.time import NS_PER_S, stamps_of

_FEWEST = 30  # fewest positions: of fewer, only correlations of 0.7 and more are `_SURE` (4 / sqrt(30))
_LEAST = 0.3  # least correlation from one to the next: bounds are then a third too small, or more
_SURE = 4.0  # least correlation, in sigmas of that of as many independent ones


class Lasting(NamedTuple):
    """An error that positions share: its sigma in each axis, m, and its correlation time, s."""

    sigma_m: float
    time_s: float


def lasting(stream: Stream, verdicts: Sequence[Verdict]) -> Lasting | None:
    """Return the error that a sensor's positions clearly share though no slow error is modelled; None if there is none.

    Args:
        verdicts: on each of its measurements.
    """
    used = [(m, v.residual) for m, v in zip(stream.measurements, verdicts, strict=True) if v.weight > AGREES]
    if stream.slow is not None or stream.left_out is not None or len(used) < _FEWEST:
        return None
    in_m = [stream.row.scaled(m).get("sigma_scale", []) for m, _ in used]  # of each, its axes of position
    axes = max(in_m, key=len)
    kept = [k for k, own in enumerate(in_m) if axes and own == axes]
    if len(kept) < _FEWEST:
        return None
    residuals = [used[k][1] for k in kept]
    stated = np.mean([np.diagonal(r.cov)[axes] for r in residuals])
    return lasting_error(
        stamps_of([used[k][0] for k in kept]) / NS_PER_S, np.array([r.raw[axes] for r in residuals]), np.sqrt(stated)
    )


def lasting_error(t_s: Array, residuals: Array, stated_m: float) -> Lasting | None:
    """Return the error that residuals clearly share with those before them; None if there is none.

    None also if the mean of as many independent errors as share it would be as large: then the bounds include it.

    Args:
        t_s: (N,) times. residuals: (N, k), m. stated_m: stated sigma of each, on an axis.
    """
    n = len(residuals)
    # What all residuals have in common is no error that lasts for a while, but that of a datum or a mount.
    off = residuals - residuals.mean(axis=0)
    variance = (off**2).mean(axis=0)
    if not variance.all():
        return None
    off = off / np.sqrt(variance)

    def correlation(lag: int) -> float:
        return float((off[lag:] * off[: n - lag]).mean())

    first = correlation(1)
    if first < max(_LEAST, _SURE / np.sqrt(residuals.size)):
        return None
    for lag in np.unique(np.geomspace(2, n // 3, 60).astype(int)):
        if correlation(int(lag)) < first * np.exp(-1.0):
            break
    sigma_m = float(np.sqrt(first * variance.mean()))
    if sigma_m < stated_m / np.sqrt(2.0 * lag):
        return None
    return Lasting(sigma_m, float(np.median(t_s[lag:] - t_s[: n - lag])))
