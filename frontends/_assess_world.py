# SPDX-License-Identifier: Apache-2.0
"""Assess poses by the GNSS track: whether their frame is east-north-up, and its origin."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends._assess import ReferenceTrack, attitudes, sane, vec
from graphloc.frontends._reports import Vec
from graphloc.frontends._topic_data import TopicData
from graphloc.signals.series import interpolated
from graphloc.time import NS_PER_S

_EXTENT_M = 20.0  # a smaller extent of the track does not tell directions
_SLACK_M = 3.0  # sideways, by which an antenna that may be anywhere on the craft can turn a track
# No run goes so far from its origin, and coordinates of a map grid (hundreds of km) are larger; a choice.
_FAR_M = 50e3
_STANDS = 0.1  # share of the fixes' extent: poses that move by less are not the craft's
_APART_M, _APART = 5.0, 0.02  # largest distance from the fixes that still fits: m, and as a share of the extent


class World(NamedTuple):
    """Frame of poses.

    Attributes:
        origin: latitude, longitude (deg) and height (m) of its origin; None if it is unknown, or not east-north-up.
        why: the evidence in words.
        pose: whether they may be poses of the vessel about a datum, neither in a map grid nor of something else.
        grid: whether they are as large as in a map grid. centred: whether they are as large as from the earth's centre.
        ned: whether they look like north, east, down.
    """

    origin: Vec | None
    why: str
    pose: bool = True
    grid: bool = False
    centred: bool = False
    ned: bool = False


def in_map_grid(poses: TopicData) -> bool:
    """Return whether positions are as large as in a map grid, such as UTM."""
    middle_m = _middle_m(poses)
    return float(np.linalg.norm(middle_m)) > _FAR_M and abs(float(middle_m[2])) <= _FAR_M


def _middle_m(poses: TopicData) -> Array:
    places = poses.rows[:, :3] if len(poses) else np.zeros((0, 3))
    places = places[np.isfinite(places).all(axis=1)]
    return np.median(places, axis=0) if len(places) else np.zeros(3)


def world_of(poses: TopicData, fixes: ReferenceTrack, antenna_m: Array | None) -> World:
    """Return the frame of poses, by the GNSS track.

    Args:
        poses: odometry or poses. fixes: the track. antenna_m: (3,) its antenna in body; None if tf does not tell it.
    """
    keep = sane(poses, np.s_[:3])
    away_m = float(np.linalg.norm(_middle_m(poses)))
    if away_m > _FAR_M:
        grid = in_map_grid(poses)
        kind = "a map grid (UTM)" if grid else "earth-centred axes, which are not read"
        said = f"it is {away_m / 1e3:.0f} km from its origin: looks like {kind}"
        return World(None, said, pose=False, grid=grid, centred=not grid)
    if fixes.first is None or len(keep) < 10 or len(fixes.stamps_ns) < 10:
        return World(None, "no GNSS track to check its frame against")
    at, q = poses.stamps_ns[keep], poses.rows[keep, :3]
    if antenna_m is not None:  # the antenna by the poses' own attitude
        q = q + Rotation.from_quat(_quaternions(poses.rows[keep, 3:7])).apply(antenna_m)
    inside = (fixes.stamps_ns >= at[0]) & (fixes.stamps_ns <= at[-1])
    t, there = (at - at[0]) / NS_PER_S, (fixes.stamps_ns[inside] - at[0]) / NS_PER_S
    p, q = fixes.p_m[inside], interpolated(there, t, q)
    extent = float(np.hypot(*np.ptp(p[:, :2], axis=0))) if len(p) else 0.0
    if len(p) < 10 or extent < _EXTENT_M:
        return World(None, f"the GNSS track is too short ({extent:.0f} m) to check its frame against")
    moved = float(np.hypot(*np.ptp(q[:, :2], axis=0)))
    rises = float(np.ptp(poses.rows[keep, 2]))
    if rises > 0.0 and not np.ptp(poses.rows[keep, :2], axis=0).any():
        return World(
            None,
            f"its x and y stay the same while z ranges over {rises:.1f} m, so it measures height or depth alone: read it as kind pose with axes: [z], if its z is up and counts from the datum's height_m",
            pose=False,
        )
    if moved < _STANDS * extent:
        return World(
            None,
            f"it moves by {moved:.1f} m while the fixes move by {extent:.0f} m: not a pose of this vessel",
            pose=False,
        )
    # As complex numbers about their means, b = exp(i turned) a if the frames differ by a turn.
    a, b = (v[:, 0] - v[:, 0].mean() + 1j * (v[:, 1] - v[:, 1].mean()) for v in (q, p))
    turned = float(np.degrees(np.angle(np.vdot(a, b))))
    offset = np.median(p - q, axis=0)
    apart = float(np.median(np.hypot(*(p - q - offset)[:, :2].T)))
    # By so much, deg, scatter of the fixes and an unknown place of the antenna can turn a track of this extent.
    tolerance = np.degrees((_SLACK_M if antenna_m is None else 1.0) / extent) + 0.2
    largest = max(_APART_M, _APART * extent)
    if abs(turned) > tolerance or apart > largest:
        as_turned = float(np.median(np.abs(b - a * np.exp(1j * np.radians(turned)))))
        as_ned = float(np.median(np.abs(b - 1j * a.conj())))  # east of it is its y
        if as_ned < min(largest, 0.5 * as_turned):
            why = f"its frame looks like north, east, down ({as_ned:.1f} m apart from the fixes): convert it to east, north, up"
            return World(None, f"{why}; as it is it cannot be used", ned=True)
        return World(
            None, f"its frame is not east-north-up: turned by {turned:+.1f} deg, {apart:.1f} m apart from the fixes"
        )
    place = Datum(Geodetic(*fixes.first)).geodetic_from_enu(offset[None, :])[0]
    lever = "" if antenna_m is not None else " and the antenna's unknown lever arm"
    return World(
        vec(place),
        f"fits the fixes to {apart:.1f} m; the origin inherits their drift{lever}, and so does every latitude and longitude written out",
    )


def _quaternions(rows: Array) -> Array:
    """Return valid quaternions (N, 4); invalid ones are replaced by the identity."""
    return np.where(attitudes(rows)[:, None], rows, [0.0, 0.0, 0.0, 1.0])
