# SPDX-License-Identifier: Apache-2.0
"""A heading that no sensor measures: how far it may be off, until the motion confirms it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphloc.solve.covariances import ANY_HEADING_RAD

DOUBTFUL_RAD = np.radians(15.0)
"""1 sigma: from a larger error the window does not recover soon, and the heading is a guess."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnmeasuredHeading:
    """A heading by the motion so far, or by `start.heading_deg`; from there the gyroscope carries it.

    The window's own covariance is too sure of it, and of the gyroscope's bias (see `solve._start`).

    Attributes:
        why: why it is a guess, where it is one.
        since_ns: a stamp. sigma_rad: of the heading there, 1 sigma. drift_radps: of the rate by which it goes off, 1 sigma.
    """

    why: str
    since_ns: int
    sigma_rad: float
    drift_radps: float

    def var(self, at_ns: int) -> float:
        """Return the variance (rad^2) at a stamp, at most that of any heading."""
        drifted_rad = self.drift_radps * max(at_ns - self.since_ns, 0) * 1e-9
        return float(min(self.sigma_rad**2 + drifted_rad**2, ANY_HEADING_RAD**2))

    def narrowed(self, at_ns: int, sigma_rad: float) -> UnmeasuredHeading:
        """Return it with what the motion says of the heading at a stamp, 1 sigma."""
        if sigma_rad**2 >= self.var(at_ns):
            return self
        return replace(self, since_ns=at_ns, sigma_rad=sigma_rad)

    def doubt(self, at_ns: int) -> str:
        """Return why it is a guess at a stamp; empty where it is none."""
        return self.why if self.var(at_ns) > DOUBTFUL_RAD**2 else ""
