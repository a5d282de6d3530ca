# SPDX-License-Identifier: Apache-2.0
"""Which offsets must be wrong, from the dependence of a run's cost on them.

The cost is quadratic in the offsets, with curvature H and negative gradient g, summed over blocks of ten seconds. If
the offsets F are free, they are theta = H_FF^-1 g_F, with covariance H_FF^-1 if the noise is as configured. The
jackknife, which leaves out each block in turn, checks that covariance; the larger of the two sigmas counts. Slow GNSS
errors are already in H, as slow states.

Offsets are freed one by one, the most significant first, each together with those before it. Of two that affect the run
alike (a lever arm forward and a late stamp, at a steady speed) only one is ever believed, and the other is named as its
alternative.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graphloc.frames import Array
from graphloc.offsets import Offset, Offsets

Name = tuple[str, Offset]

# Length of a block, which counts as one piece of evidence: errors last for seconds, so residuals within one are
# dependent. A choice.
_BLOCK_S = 10.0
CLEAR = 4.0  # sigmas from which an offset is believed to be wrong; so many because each run checks about ten
LEAST: dict[Offset, float] = {"x": 0.05, "y": 0.05, "yaw": float(np.radians(0.5)), "time": 0.01}
# Share of the best decrease of the cost from which an offset may be taken for the cause instead, or is named as an
# alternative.
_AS_WELL, _EXPLAINS = 0.95, 0.8
_UNSEEN = 1e-9  # curvature below which it is rounding


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """An offset (m, rad or s), its 1 sigma, and the decrease of the cost if it is free."""

    value: float
    sigma: float
    drop: float

    @property
    def z(self) -> float:
        """The offset in sigmas."""
        return self.value / self.sigma


class Evidence:
    """Sums of a run in blocks that are long enough to be nearly independent.

    Args:
        order: sort key of the offsets, the most often wrong first; default: as given.
    """

    def __init__(self, offsets: Offsets, order: Callable[[Name], int] = lambda _name: 0) -> None:
        merge = max(1, round(_BLOCK_S / offsets.block_s))
        starts = np.arange(0, len(offsets.gradient), merge)
        self._g = np.add.reduceat(offsets.gradient, starts, axis=0)
        self._H = np.add.reduceat(offsets.curvature, starts, axis=0)
        seen = np.diagonal(self._H.sum(axis=0)) > _UNSEEN
        self._all = {name: k for k, name in enumerate(offsets.names)}
        found = (name for name, s in zip(offsets.names, seen, strict=True) if s)
        self.names = tuple(sorted(found, key=order))

    def estimates(self, free: tuple[Name, ...]) -> dict[Name, OffsetEstimate]:
        """Return the free offsets, with all others as configured."""
        if not free:
            return {}
        own = [self._all[name] for name in free]
        g, H = self._g[:, own], self._H[:, own][:, :, own]
        total = H.sum(axis=0)
        theta = np.linalg.solve(total, g.sum(axis=0))
        cov = np.linalg.inv(total)
        sigma = np.sqrt(np.maximum(np.diagonal(cov), _jackknife(g, H)))
        # Decrease of the cost if this offset is freed, too: theta^2 / its variance.
        return {
            name: OffsetEstimate(float(v), float(s), float(v**2 / c))
            for name, v, s, c in zip(free, theta, sigma, np.diagonal(cov), strict=True)
        }

    def wrong(self) -> tuple[Name, ...]:
        """Return the offsets that must be wrong, the most significant first."""
        free: tuple[Name, ...] = ()
        while len(free) < len(self.names):
            tried = {name: self.estimates((*free, name)) for name in self.names if name not in free}
            clear = {n: e[n] for n, e in tried.items() if self._stands(n, e[n]) and _solvable(e)}
            if not clear:
                break
            most = clear[max(clear, key=lambda n: abs(clear[n].z))].drop
            # Of the offsets that explain the run equally well, the one that is most often wrong.
            free = (*free, next(name for name in self.names if name in clear and clear[name].drop > _AS_WELL * most))
        found = self.estimates(free)
        return tuple(name for name in free if self._stands(name, found[name]))

    def alternatives(self, name: Name, free: tuple[Name, ...]) -> dict[Name, OffsetEstimate]:
        """Return the offsets that explain the run about as well as `name`, while the others of `free` stay free."""
        rest = tuple(n for n in free if n != name)
        drop = self.estimates((*rest, name))[name].drop
        tried = {n: self.estimates((*rest, n))[n] for n in self.names if n not in free}
        return {n: e for n, e in tried.items() if e.drop > _EXPLAINS * drop}

    @staticmethod
    def _stands(name: Name, e: OffsetEstimate) -> bool:
        return abs(e.z) > CLEAR and abs(e.value) > LEAST[name[1]]


def _solvable(found: dict[Name, OffsetEstimate]) -> bool:
    return all(np.isfinite([e.value, e.sigma]).all() and e.sigma > 0.0 for e in found.values())


def _jackknife(g: Array, H: Array) -> Array:
    """Return the variances (k,) of the solution by the jackknife over blocks; 0 if one block has all information."""
    n, total, whole = len(g), H.sum(axis=0), g.sum(axis=0)
    if n < 3:
        return np.zeros(g.shape[1])
    left = total - H
    strong = np.linalg.eigvalsh(left)[:, 0] > 1e-6 * np.linalg.eigvalsh(total)[0]
    if not strong.all():
        return np.full(g.shape[1], np.inf)
    theta = np.linalg.solve(left, (whole - g)[:, :, None])[:, :, 0]
    return np.asarray((n - 1) / n * ((theta - theta.mean(axis=0)) ** 2).sum(axis=0))
