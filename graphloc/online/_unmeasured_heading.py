# SPDX-License-Identifier: Apache-2.0
"""A heading that no sensor measures: how far it may be off, until the motion confirms it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphloc.judge.covariances import ANY_HEADING_RAD

DOUBTFUL_RAD = np.radians(15.0)
"""1 sigma above which the heading counts as a guess: from such an error the window does not recover soon."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnmeasuredHeading:
    """How far a heading may be off that the motion or `start.heading_deg` told, and the gyroscope has carried since.

    The window's own covariance of the heading, and of the gyroscope's bias, is too small then (see `solve._start`).

    Attributes:
        why: why the heading is a guess, for the time that it is one.
        since_ns: stamp at which it was told. sigma_rad: 1 sigma of the heading at that stamp. drift_radps: 1 sigma of
            its drift, rad/s.
    """

    why: str
    since_ns: int
    sigma_rad: float
    drift_radps: float

    def var(self, at_ns: int) -> float:
        """Return the variance (rad^2) of the heading at a stamp, at most that of an unknown heading."""
        drifted_rad = self.drift_radps * max(at_ns - self.since_ns, 0) * 1e-9
        return float(min(self.sigma_rad**2 + drifted_rad**2, ANY_HEADING_RAD**2))

    def narrowed(self, at_ns: int, sigma_rad: float) -> UnmeasuredHeading:
        """Return this, or the smaller error where the motion told the heading at a stamp with a smaller sigma (rad)."""
        if sigma_rad**2 >= self.var(at_ns):
            return self
        return replace(self, since_ns=at_ns, sigma_rad=sigma_rad)

    def doubt(self, at_ns: int) -> str:
        """Return why the heading is a guess at a stamp; empty where it is none."""
        return self.why if self.var(at_ns) > DOUBTFUL_RAD**2 else ""
