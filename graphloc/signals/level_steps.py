# SPDX-License-Identifier: Apache-2.0
"""Steps of a quantity from one level to another: the medians of some values before and after are compared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from graphloc.frames import Array
from graphloc.time import NS_PER_S

BESIDE_S = 2.0
"""Length of either side, s."""
FEWEST_BESIDE = 3
"""Values on either side, at least, and so many of them off to that side: two outliers are no step."""
_FEWEST = 10  # values of all
_SIGMAS = 8.0  # least difference of the two medians, in its sigmas
GAP = 3.0
"""An interval that lasts so many times the usual one is a gap."""


def beside(usual_s: float, fewest: int = FEWEST_BESIDE) -> int:
    """Return the number of values on either side of a step, which come so far apart."""
    return max(fewest, round(BESIDE_S / max(usual_s, 1e-3)))


class Shape(NamedTuple):
    """How sudden a step is; for other reasons levels part little by little.

    Attributes:
        within, share: intervals, an odd number, within which more than this share of it comes.
        sure: sigmas of the noise by which it must be more.
        before, after: most change between the halves of either side, as a share of the step.
    """

    within: int = 1
    share: float = 0.5
    sure: float = 0.0
    before: float = np.inf
    after: float = np.inf


AT_ONCE = Shape()


def level_steps(
    stamps_ns: NDArray[np.int64],
    off: Array,
    least: Array | float,
    *,
    fewest: int = FEWEST_BESIDE,
    shape: Shape = AT_ONCE,
) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (K,), ns, of the first value after each step, and by how much the medians differ (K, k).

    Args:
        stamps_ns: (N,), increasing. off: (N, k) values. least: size of a step from which it counts, of each interval
            between two values (N - 1,), or of all. fewest: values on either side, at least. shape: of a step.
    """
    dt_s = np.diff(stamps_ns) / NS_PER_S
    usual_s = float(np.median(dt_s)) if len(dt_s) else np.inf
    n = beside(usual_s, fewest)
    if len(off) < max(2 * n, _FEWEST):
        return np.zeros(0, dtype=np.int64), np.zeros((0, off.shape[1]))
    steps = np.diff(off, axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(off, n, axis=0)
    medians = np.median(windows, axis=-1)
    # For each interval that has n values on either side.
    change, between = medians[n:] - medians[:-n], (medians[n:] + medians[:-n]) / 2.0
    size, inner = np.linalg.norm(change, axis=1), slice(n - 1, n - 1 + len(change))
    after, before = (
        (np.einsum("kin,ki->kn", own - between[:, :, None], change) * way > 0.0).sum(axis=1)
        for own, way in ((windows[n:], 1.0), (windows[:-n], -1.0))
    )
    # Sigma of a value on one axis, by the median length of steps; sqrt(pi / n) times it is that of the difference of
    # medians.
    usual = np.sqrt(2.0 * special.chdtri(off.shape[1], 0.5))
    sigma = float(np.median(np.linalg.norm(steps, axis=1))) / usual
    floor = np.broadcast_to(least, len(steps))[inner]
    padded = np.pad(steps, ((shape.within // 2, shape.within // 2), (0, 0)))
    at_once = np.lib.stride_tricks.sliding_window_view(padded, shape.within, axis=0).sum(axis=-1)
    along = np.einsum("ni,ni->n", at_once[inner], change) / np.maximum(size, 1e-9)
    # Across a gap the levels part without a step, too.
    found = (size > np.maximum(floor, _SIGMAS * sigma * np.sqrt(np.pi / n))) & (
        along - shape.sure * np.sqrt(2.0) * sigma > shape.share * size
    )
    found &= (dt_s[inner] < GAP * usual_s) & (np.minimum(after, before) >= fewest)
    if np.isfinite(shape.before):
        half = n // 2
        bends = np.median(windows[..., -half:], axis=-1) - np.median(windows[..., :half], axis=-1)
        bent = np.linalg.norm(bends, axis=1)
        found &= (bent[:-n] < shape.before * size) & (bent[n:] < shape.after * size)
    left, at = np.where(found, size, 0.0), list[int]()
    while left.max() > 0.0:
        at.append(int(np.argmax(left)))
        left[max(at[-1] - n + 1, 0) : at[-1] + n] = 0.0
    return stamps_ns[np.sort(at).astype(np.int64) + n], change[np.sort(at).astype(np.int64)]
