# SPDX-License-Identifier: Apache-2.0
"""Where a vessel lies, seen from a berth that may float.

            quay
        ------P-------------   across  from the quay's face to the body's origin B, positive in the water
              |    :           along   from P, positive to the right for who looks at the quay from the water
              |    : across    angle   of the bow from straight in, positive to the right: 0 bow in, 90 alongside with
              v    :                   the bow to the right, 180 stern in
          facing   B
              |----|           out = (sin f, cos f), right = (-cos f, sin f) for a face that looks along heading f:
              along            across = out . (p - P), along = right . (p - P), angle = heading - (f + 180 deg)

If the berth has moved by (e, n, u) and turned by psi about c, the vessel is first carried to where it would be with the berth at rest:
p -> c + Rz(-psi) (p - c - (e, n, u)), yaw -> yaw - psi. Roll and pitch of a dock are not handled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, wrap_angle, yaw_from_heading_deg


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Berth:
    """A point of a quay's face and the direction that the face looks, with the quay at rest.

    Attributes:
        name: for outputs. point_m: (3,) P in world. facing_deg: heading f, from north, clockwise.
        pivot_m: (3,) c in world. moves: index of the first of its (e, n, u, roll, pitch, psi) in the slow state of the sensor that sees
            it; None: the quay does not move.
    """

    name: str
    point_m: Array
    facing_deg: float
    pivot_m: Array
    moves: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BerthTrack:
    """A vessel seen from a berth, at N stamps.

    Attributes:
        berth: from which it is seen. stamps_ns: (N,). value: (N, 3) across m, along m, angle rad in (-pi, pi].
        rate: (N, 3) of these, per s. cov: (N, 3, 3) of `value`, or None where it is not known.
    """

    berth: Berth
    stamps_ns: NDArray[np.int64]
    value: Array
    rate: Array
    cov: Array | None = None


def seen_from(berth: Berth, p_world_m: Array, yaw_rad: Array, moved: Array) -> tuple[Array, Array]:
    """Return across, along, angle (N, 3) and their Jacobian (N, 3, 7) by (p east, p north, yaw, e, n, u, psi).

    Args:
        berth: the berth. p_world_m: (N, 3) body origin. yaw_rad: (N,) of the body. moved: (N, 4) of the berth.
    """
    f, psi = np.radians(berth.facing_deg), moved[:, 3]
    axes = np.array([(np.sin(f), np.cos(f)), (-np.cos(f), np.sin(f))])
    c, s = np.cos(psi), np.sin(psi)
    back = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)  # Rz(-psi)
    arm = np.einsum("nij,nj->ni", back, p_world_m[:, :2] - berth.pivot_m[:2] - moved[:, :2])
    place = (berth.pivot_m[:2] + arm - berth.point_m[:2]) @ axes.T
    inward = float(yaw_from_heading_deg(berth.facing_deg + 180.0))
    value = np.column_stack([place, wrap_angle(inward - (yaw_rad - psi))])
    J = np.zeros((len(value), 3, 7))
    J[:, :2, :2] = axes @ back
    J[:, :2, 3:5] = -J[:, :2, :2]
    J[:, :2, 6] = np.column_stack([arm[:, 1], -arm[:, 0]]) @ axes.T
    J[:, 2, 2], J[:, 2, 6] = -1.0, 1.0
    return value, J


def rates(value: Array, t_s: Array) -> Array:
    """Return central differences (N, 3) of across, along, angle at times (N,), s; zero for a single one."""
    if len(t_s) < 2:
        return np.zeros_like(value)
    unwrapped = np.column_stack([value[:, :2], np.unwrap(value[:, 2])])
    return np.asarray(np.gradient(unwrapped, t_s, axis=0))
