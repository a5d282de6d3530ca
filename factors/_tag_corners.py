# SPDX-License-Identifier: Apache-2.0
"""Factors of the corners of a sighting: reprojection errors, linear at the estimate (equations: `apriltag`)."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from graphloc.config import AprilTagConfig
from graphloc.factors._tag_seen import Corners, TagsSeen
from graphloc.factors._tag_states import EDGE_TIME_S, dock_process
from graphloc.frames import Array, pinhole
from graphloc.graph import Attachment, Decision, GraphUpdate, Residual
from graphloc.linear import Term, linear_update, pose_term
from graphloc.measurements import TagSighting
from graphloc.survey import DockConfig

# Least sigmas that tie a leaf to a node, where the sighting is at the node's time: m and rad of a dock; rad of a mount; s; px.
_TIE_DOCK, _TIE_MOUNT, _TIE_LATE, _TIE_EDGE = (1e-4,) * 3 + (1e-5,) * 3, (1e-5,) * 3, (1e-5,), (1e-4,)


def corner_factors(
    m: TagSighting,
    config: AprilTagConfig,
    at: Attachment,
    decision: Decision,
    seen: TagsSeen,
    corners: Corners,
) -> GraphUpdate:
    """Return the factors of the corners, one for each tag, and those of the leaf of a tag on a dock."""
    flat, projected = pinhole(corners.toward_m)
    by_point = projected @ seen.R.T  # d flat / d place of the corner
    turning = _turning(by_point, corners.points_m - seen.p)
    camera = np.concatenate([-by_point, -turning], axis=2).reshape(-1, 6)
    by_own = []
    if seen.rides:
        swing = _turning(by_point, corners.arms_m) @ seen.by_turn
        by_own.append(np.concatenate([by_point, swing], axis=2).reshape(-1, 6))
    if seen.mounted:
        by_own.append(-turning.reshape(-1, 3) @ seen.by_mount)
    if seen.timed:
        by_own.append(camera @ seen.by_late[:, None])
    if seen.edges:
        outwards = m.px * _outwards(flat)  # not of the rays: their noise would tell edges from distance
        flat = flat + seen.edge_px * outwards
        by_own.append(outwards.reshape(-1, 1))
    by_slow = np.hstack(by_own) if by_own else np.zeros((m.rays.size, 0))
    raw, by_body = (flat - m.rays).ravel(), pose_term(at, camera @ seen.body)
    at_rest = by_point @ seen.turn  # d flat / d place of the corner, its dock at rest
    by_tag = np.concatenate([at_rest, _turning(at_rest, corners.within_m.reshape(-1, 3))], axis=2).reshape(-1, 6)
    dock = config.surveyed.dock(m.frame) if seen.rides else None
    tie = None if dock is None else _tie(seen, dock, config, at)
    slow_key, slow_value = (at.slow_key, at.slow_value) if tie is None else (at.leaf_keys[0], seen.slow)
    by_slow = seen.placed(by_slow) if tie is None else by_slow
    found: list[Any] = [] if tie is None else list(tie.factors)
    points = gtsam.Values()
    # GTSAM's linear factors have at most three keys: so one factor for each tag.
    for k, constant in enumerate(corners.survey_errors):
        own = slice(8 * k, 8 * k + 8)
        of_tag = Residual(raw=raw[own], cov=m.cov[own, own], jacobian=lambda: np.zeros((8, 6)))
        terms = [by_body._replace(jacobian=by_body.jacobian[own])]
        if seen.own and slow_key is not None:
            terms.append(Term(slow_key, slow_value, by_slow[own]))
        if constant is not None:
            terms.append(Term(constant[0], np.array(constant[1]), by_tag[own]))
        found += linear_update(of_tag, terms, decision, points).factors
    return GraphUpdate(factors=tuple(found), guesses=() if tie is None else tie.guesses)


def _turning(by_point: Array, arms: Array) -> Array:
    """Return d / d small rotation (n, 2, 3) from d / d points (n, 2, 3), of points at the ends of arms (n, 3)."""
    across = np.zeros((len(arms), 3, 3))  # w x a = -across w; `np.cross` takes 50 us to look at its arguments
    across[:, [2, 0, 1], [1, 2, 0]], across[:, [1, 2, 0], [2, 0, 1]] = arms, -arms
    return -by_point @ across


def _tie(seen: TagsSeen, dock: DockConfig, config: AprilTagConfig, at: Attachment) -> GraphUpdate:
    """Return the factor and guess of a leaf: the dock's state at the sighting, between two nodes of its Markov process.

    The leaf's covariance is that of the bridge between the nodes. Interpolated rigidly instead, a dock that swings by 0.3 m is off
    by 4 cm, which is 16 px at 2.6 m.
    """
    assert at.slow_key is not None
    n = len(seen.own)
    picked = seen.placed(np.eye(n))
    sigma, time_s = dock_process(dock)
    still = 3 * seen.mounted + seen.timed
    sigma = np.concatenate([sigma, np.zeros(still), [config.edge_sigma_px] * seen.edges])
    time_s = np.concatenate([time_s, np.full(still, np.inf), [EDGE_TIME_S] * seen.edges])
    tie = np.array(_TIE_DOCK + _TIE_MOUNT * seen.mounted + _TIE_LATE * seen.timed + _TIE_EDGE * seen.edges)
    if at.slow_next is None:  # no next node yet: the process goes on freely from the node before
        kept = np.exp(-at.slow_age_s / time_s)
        expected, bridge = kept * np.asarray(at.slow_value)[seen.own], sigma * np.sqrt(1.0 - kept**2)
    else:
        _, _, share, dt_s = at.slow_next
        kept = np.full(n, 1.0 - share)
        expected, bridge = seen.slow, sigma * np.sqrt(2.0 / time_s * dt_s * share * (1.0 - share))
    residual = Residual(
        raw=seen.slow - expected, cov=np.diag(np.maximum(bridge, tie) ** 2), jacobian=lambda: np.zeros((n, 6))
    )
    terms = [
        Term(at.leaf_keys[0], seen.slow, np.eye(n)),
        Term(at.slow_key, np.array(at.slow_value), -kept[:, None] * picked),
    ]
    if at.slow_next is not None:
        terms.append(Term(at.slow_next[0], np.array(at.slow_next[1]), -share * picked))
    return GraphUpdate(linear_update(residual, terms, Decision()).factors, ((at.leaf_keys[0], seen.slow),))


def _outwards(rays: Array) -> Array:
    """Return the shift (n, 2) of corners, as rays, where all edges of their tags move outwards by one."""
    tags = rays.reshape(-1, 4, 2)
    along = tags[:, [1, 2, 3, 0]] - tags
    along /= np.maximum(np.hypot(along[..., :1], along[..., 1:]), 1e-12)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)  # clockwise in an image whose y looks down: outwards
    before = normal[:, [3, 0, 1, 2]]
    opened = 1.0 + (before * normal).sum(axis=-1, keepdims=True)  # -1 where an edge turns back on the one before
    return np.asarray(((before + normal) / np.maximum(opened, 0.1)).reshape(-1, 2))
