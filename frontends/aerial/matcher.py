# SPDX-License-Identifier: Apache-2.0
"""One match: layers around the prior, the scan's outline compared with them, modes of the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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

_NONE_LOG = 5.0  # log-likelihood of the best pose by pure chance, over the mean
# Log-odds that the truth is in a window: constant, and factor of the contrast; by tune_matcher.py.
_CONTRAST = (-3.46, 0.096)
_MOST_WITHIN = 0.95  # largest prior probability that the truth is in the window: priors may be wrong
_LEAST_PLACES = 30
_MODES = 5
# Times for which inertial sensors carry a position, and a heading, to an accuracy. To a worse accuracy they carry them
# for longer: errors of position grow with the square of time, those of heading linearly.
_CARRIED_S, _CARRIED_M = 5.0, 0.1
_CARRIED_YAW_S, _CARRIED_YAW_RAD = 60.0, np.radians(0.5)
_SAME_RAD = np.radians(2.0)  # headings of modes that differ by less are equal
_LEAST_NEWS = 1e-6  # least independent share of a match at the place and time of the last one: keeps it finite
NO_POSE = "no pose in the window stands out"
"""Why a scan has no match: it fits nowhere better than by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Predicted pose (3,) of the vessel, east, north, yaw, and its sigmas (3,), m and rad."""

    pose: Array
    sigma: Array


@dataclass(frozen=True, slots=True)
class Since:
    """Distance and time from the match before to a match.

    Errors of matches, and which mode looks right, are a first-order Markov process along the path, with the correlation
    r = exp(-way) between two matches: they see nearly the same walls and boats. The independent share of a match is
    (1 - r) / (1 + r).

    Attributes:
        way: distance travelled, in correlation lengths (`AerialConfig.alike_m`). waited_s: time.
    """

    way: float
    waited_s: float

    @property
    def news(self) -> float:
        """Share of the evidence for right or false modes that is independent of the match before."""
        return float(np.tanh(0.5 * self.way))

    def widened(self, cov: Array) -> Array:
        """Return the covariance (3, 3) of the part of a match that is independent of the one before.

        Where inertial sensors have lost the match before, all of the match is independent.
        """
        variances, axes = np.linalg.eigh(cov[:2, :2])
        carried_s = _CARRIED_S * np.maximum(np.sqrt(variances) / _CARRIED_M, 1.0) ** 0.5
        yaw_s = _CARRIED_YAW_S * max(float(np.sqrt(cov[2, 2])) / _CARRIED_YAW_RAD, 1.0)
        independent = np.tanh(0.5 * np.maximum(self.way, self.waited_s / np.append(carried_s, yaw_s)))
        independent = np.maximum(independent, _LEAST_NEWS)
        wider = np.zeros((3, 3))
        wider[:2, :2] = (axes / np.sqrt(independent[:2])) @ axes.T
        wider[2, 2] = 1.0 / np.sqrt(independent[2])
        return np.asarray(wider @ cov @ wider)


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Result of a match.

    Attributes:
        prior: the prediction. found: the scan's outline. layers: of the map. grid, score: candidate poses, and their
            log-likelihood (H, R, C). modes: best first. none: probability that no mode is right.
        why_not: why there is no mode; empty if there is one.
        cut_off: whether the window was too small for 2 sigma of the prior.
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

    @property
    def distance_m(self) -> float:
        """Median distance to what was matched, m; 0 if the matcher does not tell it."""
        places_m = np.vstack([self.found.faces_m, self.found.shore_m])
        return float(np.median(np.hypot(*places_m.T))) if len(places_m) else 0.0

    @property
    def of_heading(self) -> float:
        """Probability of the best mode's heading, at any position: a row of boats makes only the position ambiguous."""
        alike = (m for m in self.modes if abs(float(wrap_angle(m.pose[2] - self.modes[0].pose[2]))) < _SAME_RAD)
        return sum(m.probability for m in alike)

    def fix(
        self, stamp_ns: int, sensor: str, since: Since | None = None, axes: tuple[str, ...] = ("x", "y", "yaw")
    ) -> PoseFix:
        """Return the modes as one measurement.

        Args:
            stamp_ns, sensor: of the measurement. axes: to be used.
            since: distance and time from the match before, whose errors it shares in part; None: there is none.
        """
        news = 1.0 if since is None else since.news
        # Which mode is right is no news if the match before saw the same boats.
        told = np.array([m.probability for m in self.modes])
        share = told**news
        picked = [k for k, a in enumerate(("x", "y", "yaw")) if a in axes]
        modes = tuple(
            PoseMode(
                value=np.array([m.pose[0], m.pose[1], float(wrap_angle(m.pose[2]))])[picked],
                cov=(m.cov if since is None else since.widened(m.cov))[np.ix_(picked, picked)],
                probability=float(p),
            )
            for m, p in zip(self.modes, share * (told.sum() / share.sum()), strict=True)
        )
        return PoseFix(stamp_ns=stamp_ns, sensor=sensor, seq=0, axes=axes, modes=modes, news=news)


@dataclass(frozen=True, slots=True)
class Belief:
    """How far the posterior of a scan is believed, fitted to runs through drawn harbours (`benchmarks/tune_odds.py`).

    The likelihood does not know boats at other berths than on the image, a tide, or errors of the track. So a scan with
    little evidence fits best at a false place as often as not, and the odds between modes are less clear than computed.

    Attributes:
        enough, power: the odds that one of the modes is right, if the truth is in the window, are (N / enough)^power.
            N is the evidence of the scan or, if it is more, that of all n turns divided by n^alike.
        alike: see above; turns show the same walls. decided: exponent of the odds between modes.
    """

    enough: float = 15.0
    power: float = 3.3
    alike: float = 0.4
    decided: float = 0.35

    def share(self, found: Outline) -> float:
        """Return the probability that one of the modes is right if the truth is in the window."""
        own = found.own.evidence if found.own else 0.0
        evidence = max(own, found.evidence / found.turns**self.alike, 1e-9)
        return float(special.expit(self.power * np.log(evidence / self.enough)))

    def less_decided(self, modes: Sequence[Mode], share: float = 1.0) -> list[Mode]:
        """Return the modes with odds closer to even, and the sum of their probabilities multiplied by `share`."""
        if not modes:
            return []
        told = np.array([m.probability for m in modes])
        odds = told**self.decided
        return [
            replace(m, probability=float(p))
            for m, p in zip(modes, odds * (share * told.sum() / odds.sum()), strict=True)
        ]


BELIEF = Belief()


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
        sigma_m, sigma_deg = float(prior.sigma[:2].max()), float(np.degrees(prior.sigma[2]))
        half_m = float(np.clip(3.0 * sigma_m + 1.0, 2.0, config.window_m))
        half_deg = float(np.clip(3.0 * sigma_deg + 0.5, 1.0, config.window_deg))
        grid = grid_around(layers, prior.pose, half_m, half_deg)
        score = log_likelihood_of(found, layers, grid)
        trust = _trust(score, _within(prior.sigma, np.array([half_m, half_m, np.radians(half_deg)])))
        modes, _ = modes_of(score, grid, _NONE_LOG, 1.0 - trust, _MODES, found.normals)
        modes = BELIEF.less_decided(modes, BELIEF.share(found))  # changes probabilities only, not which modes there are
        none = 1.0 - sum(m.probability for m in modes)
        why_not = "" if modes else NO_POSE
        cut_off = half_m < 2.0 * sigma_m or half_deg < 2.0 * sigma_deg
        return Match(prior, found, layers, grid, score, tuple(modes), none, why_not, cut_off)


def _trust(score: Layer, within: float) -> float:
    """Return the probability that the truth is in the window, given the score.

    Windows without the truth have peaks, too, where the map looks alike; they rise less above the mean.
    """
    contrast = float(score.max()) - float(score.mean())
    return float(special.expit(_CONTRAST[0] + _CONTRAST[1] * contrast + special.logit(min(within, _MOST_WITHIN))))


def _within(sigma: Array, half: Array) -> float:
    """Return the probability that the truth is in a window of half sizes `half` (3,), by the prior's sigmas (3,)."""
    return float(np.prod(special.erf(half / (np.sqrt(2.0) * np.maximum(sigma, 1e-9)))))


def _too_little(found: Outline) -> str:
    if not len(found.faces_m) + len(found.shore_m) + len(found.water_m):
        return "a scan without a point outside the vessel"
    if not len(found.faces_m) + len(found.shore_m):
        return "a scan of water alone"
    return f"{len(found.faces_m)} places with a vertical face, {len(found.shore_m)} first returns: too few to match"
