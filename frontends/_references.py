# SPDX-License-Identifier: Apache-2.0
"""Topics that are read but never fused: the truth, and a speed for comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends import _order
from graphloc.frontends._standard import pose_of
from graphloc.frontends.decode import MOST_DISTANCE_M, MOST_SPEED_MPS
from graphloc.recording import SpeedSeries
from graphloc.time import NS_PER_S, seconds_since
from graphloc.trajectory import Trajectory


@dataclass(slots=True)
class Reference:
    """A topic that is read but not fused.

    Attributes:
        topic, reason: its name; why it is not fused, for the ledger.
        count, broken: number of messages; of those that cannot be decoded.
        unstamped: number of messages without a stamp, which get their recording times.
        stamps_ns, logs_ns, messages: stamps, recording times and contents, as columns.
    """

    topic: str
    reason: str
    count: int = 0
    broken: int = 0
    unstamped: int = 0
    stamps_ns: list[int] = field(default_factory=list)
    logs_ns: list[int] = field(default_factory=list)
    messages: list[Any] = field(default_factory=list)

    def keep(self, first_ns: int, last_ns: int) -> None:
        """Drop messages, in place, that were not recorded between two times."""
        kept = [first_ns <= log_ns <= last_ns for log_ns in self.logs_ns]
        columns: tuple[list[Any], ...] = (self.stamps_ns, self.logs_ns, self.messages)
        for column in columns:
            column[:] = list(compress(column, kept))


def true_trajectory(item: Reference, offset_s: float, warnings: list[str]) -> Trajectory | None:
    """Return the true trajectory, with velocity; None of fewer than two usable poses. Poses left out give a warning.

    If no quaternion is valid, or all are 0 0 0 1, it is one of positions, without a heading.

    Args:
        offset_s: added to its stamps.
    """
    poses = [(s, *pose_of(m), m) for s, m in zip(item.stamps_ns, item.messages, strict=True)]
    turned = [R for _, _, R, _ in poses if R is not None]
    headed = bool(turned) and not all(np.array_equal(R, np.eye(3)) for R in turned)
    if not headed:
        poses = [(s, p, np.eye(3), m) for s, p, _, m in poses]
    good = [(s, p, R, m) for s, p, R, m in poses if R is not None and (np.abs(p) <= MOST_DISTANCE_M).all()]
    stamps = np.array([s for s, _, _, _ in good], dtype=np.int64)
    keep = np.flatnonzero(_order.longest_increasing(stamps))
    if len(keep) < item.count:
        warnings.append(f"{item.topic}: {item.count - len(keep)} truth messages left out (stamp or pose not usable)")
    if len(keep) < 2:
        return None
    stamps = stamps[keep] + round(offset_s * NS_PER_S)
    p, R = np.array([good[i][1] for i in keep]), np.array([good[i][2] for i in keep])
    v = _true_velocity(stamps, p, R, [good[i][3] for i in keep])
    return Trajectory(stamps_ns=stamps, p_world_m=p, R_world_body=R, v_world_mps=v, headed=headed)


def _true_velocity(stamps_ns: NDArray[np.int64], p_m: Array, R: Array, messages: Sequence[Any]) -> Array:
    """Return the velocity (N, 3), m/s, in world.

    It is the twist (in the child frame, as in nav_msgs) if it agrees with the derivative of the positions, else this
    derivative: some programs write the twist in another frame, or zeros.
    """
    derivative = np.gradient(p_m, seconds_since(int(stamps_ns[0]), stamps_ns), axis=0)
    if not all(hasattr(m, "twist") for m in messages):
        return np.asarray(derivative)
    linear = (m.twist.twist.linear for m in messages)
    said = np.array([[v.x, v.y, v.z] for v in linear], dtype=float)
    if not (np.abs(said) <= MOST_DISTANCE_M).all():
        return np.asarray(derivative)
    twist = np.einsum("nij,nj->ni", R, said)
    apart = float(np.median(np.linalg.norm(twist - derivative, axis=1)))
    speed = float(np.median(np.linalg.norm(derivative, axis=1)))
    return np.asarray(twist if apart < 0.1 + 0.1 * speed else derivative)


def check_speed(item: Reference) -> SpeedSeries | None:
    """Return the forward speeds of an odometry topic, with increasing stamps; None if none is usable."""
    stamps = np.array(item.stamps_ns, dtype=np.int64)
    speed = np.array([float(m.twist.twist.linear.x) for m in item.messages])
    keep = np.flatnonzero(_order.longest_increasing(stamps))
    keep = keep[np.abs(speed[keep]) <= MOST_SPEED_MPS]
    if len(keep) == 0:
        return None
    return SpeedSeries(topic=item.topic, stamps_ns=stamps[keep], speed_mps=speed[keep])
