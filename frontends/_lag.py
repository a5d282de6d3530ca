# SPDX-License-Identifier: Apache-2.0
"""Whether headings are stamped early or late, told by the gyroscope."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends._assess import Turning
from graphloc.time import NS_PER_S

_BLOCK_S = 20.0
_CLEAR, _LEAST_S = 4.0, 0.02  # sigmas, s


def lag(turning: Turning, stamps_ns: NDArray[np.int64], angle: Array) -> tuple[float, float] | None:
    """Return what should be added to the stamps of headings, s, and its sigma; None where the gyroscope does not tell.

    Read dt later than stamped, a heading is ahead of the integrated rate w by w dt. Within twenty seconds a gyro's bias,
    a compass's offset and what iron does to it change little, so they go with each block's straight line.

    Args:
        turning: how the craft turned. stamps_ns: (N,), increasing. angle: (N,) rad, counter-clockwise, unwrapped.
    """
    at = (stamps_ns - turning.origin_ns) / NS_PER_S
    inside = (at > turning.t_s[0] + 1.0) & (at < turning.t_s[-1] - 1.0)
    at, angle = at[inside], angle[inside]
    if len(at) < 50:
        return None
    turned = np.interp(at, turning.t_s, turning.turned_rad)
    rate = (
        np.interp(at + 0.1, turning.t_s, turning.turned_rad) - np.interp(at - 0.1, turning.t_s, turning.turned_rad)
    ) / 0.2
    found = []
    for k in range(int((at[-1] - at[0]) // _BLOCK_S) + 1):
        own = (at - at[0]) // _BLOCK_S == k
        if own.sum() >= 10:
            line = np.column_stack([np.ones(own.sum()), at[own] - at[own].mean(), turned[own]])
            w, ahead = (v - line @ np.linalg.lstsq(line, v, rcond=None)[0] for v in (rate[own], (angle - turned)[own]))
            found.append((float(w @ ahead), float(w @ w)))
    if len(found) < 3:
        return None
    up, down = np.array(found).T
    if down.sum() <= 0.0 or down.max() > 0.9 * down.sum():
        return None
    value = float(up.sum() / down.sum())
    without = (up.sum() - up) / (down.sum() - down)
    sigma = float(np.sqrt((len(up) - 1) / len(up) * ((without - without.mean()) ** 2).sum()))
    clear = abs(value) > max(_CLEAR * sigma, _LEAST_S)
    return (value, sigma) if clear else None
