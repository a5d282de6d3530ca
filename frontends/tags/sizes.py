# SPDX-License-Identifier: Apache-2.0
"""Consistency of surveyed sizes of tags with their spacing.

Distances are proportional to the size. If all sizes are 25 % too large (measured with the white margin), each tag of an
image alone fits well, no two fit one pose, and a run that uses them is metres off. With one more unknown, a factor on
all sizes, they fit together again, for any track.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from graphloc.frontends.tags.bundles import CONTRADICTS, Bundle, SeenTag
from graphloc.measurements import TagSighting
from graphloc.survey import Survey, TagConfig

_FEWEST, _TRIED = 8, 12  # least number of images with several tags; number of images that are tried
_MOST = 0.5  # least share of the tried images that must agree on a factor
REFUSED = 0.1
"""Tags are not used if their factor differs from 1 by more; with a smaller difference a run is better with them."""
_OFF, _ALIKE = 0.02, 0.03  # least difference of a factor from 1 that is said; its largest relative scatter among images
_LOG_FACTORS = (-1.6, 1.6)  # factors of 0.2 to 5
# Least significance of a factor, in sigmas: of the fit, with the survey's errors; and of these alone, as large errors
# of a survey need not be normal.
_SURE = 5.0


def size_factors(sightings: Sequence[TagSighting], survey: Survey) -> dict[str, float]:
    """Return by frame the factor on its sizes with which tags fit together; frames whose sizes fit are omitted.

    Args:
        sightings: of one sensor. survey: of this sensor.
    """
    images: dict[str, dict[tuple[str, int], list[TagSighting]]] = defaultdict(lambda: defaultdict(list))
    for m in sightings:
        images[m.frame][(m.camera, m.stamp_ns)].append(m)
    found = {}
    for frame, of_frame in images.items():
        several = [own for own in of_frame.values() if sum(len(m.tags) for m in own) > 1]
        if len(several) < _FEWEST:
            continue
        tried = several[:: -(-len(several) // _TRIED)]
        fitting = np.array([f for own in tried if (f := _factor(own, survey, frame)) is not None])
        if len(fitting) <= _MOST * len(tried):
            continue
        factor = float(np.median(fitting))
        if abs(factor - 1.0) > _OFF and np.median(np.abs(fitting - factor)) < _ALIKE * factor:
            found[frame] = factor
    return found


def _factor(own: Sequence[TagSighting], survey: Survey, frame: str) -> float | None:
    """Return the factor by the tags of one image; None if none makes them fit clearly better."""
    listed = {(str(tag.family), tag.id): tag for tag in survey.tags}

    def excess(log_factor: float) -> float:
        group = [
            SeenTag(
                listed[tag].model_copy(update={"size_m": listed[tag].size_m * np.exp(log_factor)}),
                m.rays[4 * k : 4 * k + 4],
                m.cov[8 * k : 8 * k + 8, 8 * k : 8 * k + 8],
            )
            for m in own
            for k, tag in enumerate(m.tags)
        ]
        return min(Bundle(group, survey, frame).excess, 1e9)

    as_it_is, dof = excess(0.0), 8 * sum(len(m.tags) for m in own) - 7
    if dof * as_it_is <= _SURE**2:
        return None  # they fit so well that no factor can be significant
    best = minimize_scalar(excess, bounds=_LOG_FACTORS, method="bounded", options={"xatol": 1e-3})
    sure = dof * (as_it_is - best.fun) > _SURE**2 and abs(best.x) > _SURE * _unsure(own, listed)
    return float(np.exp(best.x)) if sure and best.fun < as_it_is / CONTRADICTS else None


def _unsure(own: Sequence[TagSighting], listed: Mapping[tuple[str, int], TagConfig]) -> float:
    """Return the relative uncertainty, by the survey, of the spacing of tags in an image, 1 sigma."""
    middles = np.concatenate([m.points_m.reshape(-1, 4, 3).mean(axis=1) for m in own])
    sigma_m = max(listed[tag].sigma_m for m in own for tag in m.tags)
    return float(np.sqrt(2.0) * sigma_m / max(np.linalg.norm(middles - middles[0], axis=1).max(), 1e-6))
