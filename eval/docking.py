# SPDX-License-Identifier: Apache-2.0
"""Errors of a docking run: by distance to the tags, at the end, and relative to the berth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from graphloc.eval.metrics import Table
from graphloc.frames import Array
from graphloc.signals.series import rms
from graphloc.survey import Survey
from graphloc.time import NS_PER_S
from graphloc.trajectory import Trajectory

BANDS_M = (0, 5, 8, 12, 16, 20, 25)  # limits of bands of distance, as in D's figures 4.5 b and 4.6 b
# Error that DNV allows at 95 % in the docking phase, and the distance of that phase (D sec. 2.1.4.1). D meets it within
# 4.8 m (table 4.13).
DNV_M, DNV_WITHIN_M = 0.10, 5.0
END_S = 5.0  # length of the end of a run
LOST_M = 2.0  # horizontal error from which a track is lost: D's gate
_SIDE_M = 1.0

Stamps = NDArray[np.int64]
_NOTE = (
    "Position: 95 % of horizontal errors, by the true distance to the nearest tag, from the first sighting on (as sighted_rmse and "
    "matched, the share of that time that an estimate covers); berth: the last 5 s. lost: ends more than 2 m off, by the "
    "median. wrong_side: ends more than 1 m off, on the other side of the nearest tag's face or of its middle; not said of "
    "one that is lost elsewhere. dnv_met: 0.10 m at 95 % within 5 m of the tags, time that is not covered counted as missed "
    "(DNV 2018, by D sec. 2.1.4.1). All three: 1 yes, 0 no."
)


def tags_at_rest(survey: Survey) -> tuple[Array, Array]:
    """Return the middles (T, 3), m, and axes (T, 3, 3) of all tags in world, docks at rest."""
    frames = [survey.rest(tag.frame) for tag in survey.tags]
    places = [p + R @ tag.xyz_m for (p, R), tag in zip(frames, survey.tags, strict=True)]
    return np.array(places), np.array([R @ tag.R_frame_tag for (_, R), tag in zip(frames, survey.tags, strict=True)])


def tag_range_m(track: Trajectory, survey: Survey, lever_m: Array | None = None) -> Array:
    """Return the horizontal distance (N,), m, to the nearest tag, docks at rest, at the track's stamps.

    Args:
        track: of the body.
        survey: with at least one tag.
        lever_m: (3,) point in body to measure from, such as a camera; None: the body's origin.
    """
    p = track.p_world_m if lever_m is None else track.p_world_m + track.R_world_body @ lever_m
    away = p[:, None, :2] - tags_at_rest(survey)[0][None, :, :2]
    return np.asarray(np.linalg.norm(away, axis=2).min(axis=1))


def docking_table(
    estimates: Sequence[tuple[str, Trajectory]],
    truth: Trajectory,
    survey: Survey,
    sightings_ns: Stamps,
    lever_m: Array | None = None,
) -> Table:
    """Return a table with a row per estimate; a number is None where the estimate does not cover its period.

    Args:
        estimates: names and tracks of the body. truth: of the body.
        survey: with at least one tag.
        sightings_ns: stamps (S,) of the sightings; without any, only the columns of the end are filled.
        lever_m: (3,) point in body that distances to tags are measured from; None: the body's origin.
    """
    stamps, range_m = truth.stamps_ns, tag_range_m(truth, survey, lever_m)
    seen = stamps >= sightings_ns.min() if len(sightings_ns) else np.zeros(len(stamps), dtype=bool)
    end = stamps > stamps[-1] - round(END_S * NS_PER_S)
    within = seen & (range_m <= DNV_WITHIN_M)
    bands = {f"position_p95_{a}_to_{b}_m": seen & (range_m >= a) & (range_m < b) for a, b in pairwise(BANDS_M)}
    columns = (*bands, "sighted_rmse_m", "berth_p95_m", "lost", "wrong_side", "dnv_met", "matched")
    rows = []
    for name, estimate in estimates:
        off = _off(estimate, truth)
        error = np.linalg.norm(off, axis=1)
        covered = np.isfinite(error)
        of_sighted, at_end = error[seen & covered], end & covered
        lost = int(np.median(error[at_end]) > LOST_M) if at_end.any() else None
        wrong = _wrong_side(off[at_end], truth.p_world_m[at_end], survey)
        values = (
            *(_p95(error[band & covered]) for band in bands.values()),
            rms(of_sighted) if len(of_sighted) else None,
            _p95(error[at_end]),
            lost,
            wrong if wrong or not lost else None,
            int(np.mean(error[within] <= DNV_M) >= 0.95) if (within & covered).any() else None,
            float(covered[seen].mean()) if seen.any() else None,
        )
        rows.append((name, values))
    return Table("Docking", columns, tuple(rows), _NOTE)


def accurate_within_m(
    estimate: Trajectory,
    truth: Trajectory,
    survey: Survey,
    sightings_ns: Stamps,
    lever_m: Array | None = None,
) -> float | None:
    """Return the largest distance (m) to the tags within which 95 % of horizontal errors are at most `DNV_M`, or None.

    Args:
        estimate, truth: of the body. survey: with at least one tag.
        sightings_ns: (S,), at least one: only stamps from the first on count. Stamps that the estimate does not cover
            count as errors above the limit.
        lever_m: (3,) point in body that distances are measured from; None: the body's origin.
    """
    seen = truth.stamps_ns >= sightings_ns.min()
    range_m = tag_range_m(truth, survey, lever_m)[seen]
    error = np.linalg.norm(_off(estimate, truth), axis=1)[seen]
    order = np.argsort(range_m, kind="stable")
    share = np.cumsum(error[order] <= DNV_M) / np.arange(1, len(order) + 1)
    enough = np.flatnonzero(share >= 0.95)
    return float(range_m[order][enough[-1]]) if len(enough) else None


def _p95(error: Array) -> float | None:
    return float(np.percentile(error, 95)) if len(error) else None


def _off(estimate: Trajectory, truth: Trajectory) -> Array:
    """Return the horizontal error (N, 2) at the truth's stamps; NaN where the estimate does not cover them."""
    covered = estimate.covers(truth.stamps_ns)
    off = np.full((len(truth), 2), np.nan)
    if covered.any():
        off[covered] = estimate.at(truth.stamps_ns[covered]).p_world_m[:, :2] - truth.p_world_m[covered, :2]
    return off


def _wrong_side(off: Array, true: Array, survey: Survey) -> int | None:
    """Return 1 if mean estimate and truth are > 1 m apart, on different sides of the nearest tag's face or middle."""
    if not len(off):
        return None
    middles, axes = tags_at_rest(survey)
    there = true[:, :2].mean(axis=0)
    nearest = int(np.linalg.norm(middles[:, :2] - there, axis=1).argmin())
    sideways_out = axes[nearest][:2, [0, 2]]  # the print's x and the face's normal, in world's horizontal plane
    of_truth = (there - middles[nearest, :2]) @ sideways_out
    shift = off.mean(axis=0) @ sideways_out
    return int((((of_truth + shift) * of_truth < 0.0) & (np.abs(shift) > _SIDE_M)).any())
