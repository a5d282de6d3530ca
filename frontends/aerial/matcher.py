# SPDX-License-Identifier: Apache-2.0
"""One match: layers around the prior, the scan's outline compared with them, modes of the posterior."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import special

from graphloc.config import AerialConfig
from graphloc.frames import Array, Datum, wrap_angle
from graphloc.frontends.aerial.layers import Layer, Layers
from graphloc.frontends.aerial.maps import Map
from graphloc.frontends.aerial.match import Mode, SearchGrid, grid_around, log_likelihood_of, modes_of
from graphloc.frontends.aerial.scan import LevelCloud, Outline, outline
from graphloc.measurements import PoseFix, PoseMode

_NONE_LOG = 5.0  # the best pose of pure chance is about that much over the mean
_CONTRAST = (-3.46, 0.096)  # log-odds of windows with the truth to those without, by tune_matcher.py as well
_MOST_WITHIN = 0.95  # priors may be wrong, however sure
_LEAST_PLACES = 30
_MODES = 5
NO_POSE = "no pose in the window stands out"
"""Why a scan has no match: it fits nowhere better than by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Predicted pose (3,) of the vessel, east, north, yaw, and its sigmas (3,), m and rad."""

    pose: Array
    sigma: Array


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Result of a match.

    Attributes:
        prior: the prediction. found: the scan's outline. layers: of the map. grid, score: log-likelihood (H, R, C) over the
            grid. modes: best first. none: probability that no mode is right.
        why_not: why there is no mode; empty if there is one.
        cut_off: whether the window was too small for 3 sigma of the prior.
    """

    prior: Prior
    found: Outline
    layers: Layers | None = None
    grid: SearchGrid | None = None
    score: Layer | None = None
    modes: tuple[Mode, ...] = ()
    none: float = 1.0
    why_not: str = ""
    cut_off: bool = False

    def fix(
        self,
        stamp_ns: int,
        sensor: str,
        news: tuple[float, float, float] = (1.0, 1.0, 1.0),
        axes: tuple[str, ...] = ("x", "y", "yaw"),
    ) -> PoseFix:
        """Return the modes as one measurement.

        Args:
            news: independent shares of east, north, yaw (`live.Matched`); variances grow by their inverse.
            axes: to be used.
        """
        wider = 1.0 / np.sqrt(np.outer(news, news))
        picked = [k for k, a in enumerate(("x", "y", "yaw")) if a in axes]
        modes = tuple(
            PoseMode(
                value=np.array([m.pose[0], m.pose[1], float(wrap_angle(m.pose[2]))])[picked],
                cov=(wider * m.cov)[np.ix_(picked, picked)],
                probability=m.probability,
            )
            for m in self.modes
        )
        return PoseFix(stamp_ns=stamp_ns, sensor=sensor, seq=0, axes=axes, modes=modes)


class Matcher:
    """Matches scans to a map.

    Raises:
        InputError: the map cannot be used.
    """

    def __init__(self, config: AerialConfig, folder: Path, datum: Datum) -> None:
        self._config, self._map = config, Map(config, folder, datum)
        self._hull = np.array(config.hull_m, dtype=float) if config.hull_m else None

    def match(self, cloud: LevelCloud, prior: Prior) -> Match:
        """Match a cloud to the map around a prior.

        Raises:
            InputError: the map does not cover it.
        """
        config = self._config
        found = outline(cloud, self._hull, config.reach_m)
        if len(found.faces_m) + len(found.shore_m) < _LEAST_PLACES:
            return Match(prior, found, why_not=_too_little(found))
        layers = self._map.around(prior.pose, found)
        open_m, open_deg = 3.0 * float(prior.sigma[:2].max()), float(np.degrees(3.0 * prior.sigma[2]))
        half_m = float(np.clip(open_m + 1.0, 2.0, config.window_m))
        half_deg = float(np.clip(open_deg + 0.5, 1.0, config.window_deg))
        grid = grid_around(layers, prior.pose, half_m, half_deg)
        score = log_likelihood_of(found, layers, grid)
        trust = _trust(score, _within(prior.sigma, np.array([half_m, half_m, np.radians(half_deg)])))
        modes, none = modes_of(score, grid, _NONE_LOG, 1.0 - trust, _MODES)
        why_not = "" if modes else NO_POSE
        cut_off = half_m < open_m or half_deg < open_deg
        return Match(prior, found, layers, grid, score, tuple(modes), none, why_not, cut_off)


def _trust(score: Layer, within: float) -> float:
    """Return the probability that the truth is in the window, given the score.

    Windows without the truth have peaks too, of things that look alike; they rise less above the mean.
    """
    contrast = float(score.max()) - float(score.mean())
    return float(special.expit(_CONTRAST[0] + _CONTRAST[1] * contrast + special.logit(min(within, _MOST_WITHIN))))


def _within(sigma: Array, half: Array) -> float:
    """Return the probability that the truth is in the window, by the prior's sigmas (3,)."""
    return float(np.prod(special.erf(half / (np.sqrt(2.0) * np.maximum(sigma, 1e-9)))))


def _too_little(found: Outline) -> str:
    if not len(found.faces_m) + len(found.shore_m) + len(found.water_m):
        return "a scan without a point outside the vessel"
    if not len(found.faces_m) + len(found.shore_m):
        return "a scan of water alone"
    return f"{len(found.faces_m)} places with a vertical face, {len(found.shore_m)} first returns: too few to match"
