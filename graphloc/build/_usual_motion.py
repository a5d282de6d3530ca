# SPDX-License-Identifier: Apache-2.0
"""The motion model, where no sensor measures position or velocity for long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc.motion_model import MotionModel, Moving
from graphloc.timeline import Timeline

_UNAIDED_S = 10.0  # shortest time without such a sensor: for less, the IMU alone is far better than the model
# Times the usual interval of such measurements, up to which the motion between two is known well enough to learn from: where
# all come more rarely than every 10 s, nothing would be learned else, and a guess would hold the craft.
_LEARNED = 3.0
Span = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class UsualMotion:
    """What the vessel usually does, and where it is assumed to do so.

    Attributes:
        model: the motion model. nodes: slow nodes from which to the next one it is used.
    """

    model: MotionModel
    nodes: frozenset[int]

    def factors(self, timeline: Timeline, values: gtsam.Values, nodes: Sequence[int], first: int) -> list[Any]:
        """Return the factors of the model on the steps between slow nodes of a stretch.

        Args:
            nodes: slow nodes of the stretch. first: its first state.
        """
        factors: list[Any] = []
        for j in nodes[:-1]:
            if j not in self.nodes:
                continue
            a, b = (int(k) for k in np.searchsorted(timeline.slow_of, [j, j + 1]))
            if a >= first:
                dt_s = float(timeline.stamps_ns[b] - timeline.stamps_ns[a]) * 1e-9
                factors += self.model.step(Moving.of(values, a), Moving.of(values, b), dt_s)
        return factors


def usual_motion(
    timeline: Timeline, values: gtsam.Values, aided_ns: NDArray[np.int64], holes: Sequence[Span]
) -> UsualMotion | None:
    """Return what the vessel usually does, learned where its motion is measured; None if it is measured all the time.

    Args:
        aided_ns: (K,) stamps of measurements of position or velocity, in order.
        holes: gaps of the IMU, across which the rotation is unknown, and with it the body axes that the model is about.
    """
    ends = np.concatenate([timeline.stamps_ns[:1], aided_ns, timeline.stamps_ns[-1:]])
    unaided = _intervals(ends, _UNAIDED_S * 1e9)
    if not unaided:
        return None
    usual_ns = float(np.median(np.diff(aided_ns))) if len(aided_ns) > 1 else 0.0
    unknown = _intervals(ends, max(_UNAIDED_S * 1e9, _LEARNED * usual_ns))
    model, nodes = MotionModel(remembered_s=np.inf), set()
    node_ns = timeline.slow_stamps_ns
    for j in range(len(node_ns) - 1):
        here_ns, next_ns = int(node_ns[j]), int(node_ns[j + 1])
        if not _within(unknown, here_ns, next_ns):
            moving = Moving.of(values, int(np.searchsorted(timeline.slow_of, j)))
            model.learn(here_ns, (moving.R.T @ moving.v_mps)[:2])
        if _within(unaided, here_ns, next_ns) and not any(a < next_ns and b > here_ns for a, b in holes):
            nodes.add(j)
    return UsualMotion(model, frozenset(nodes))


def _intervals(ends: NDArray[np.int64], longer_ns: float) -> list[Span]:
    """Return the intervals between successive stamps that are longer than some time."""
    long = np.flatnonzero(np.diff(ends) > longer_ns)
    return list(zip(ends[long].tolist(), ends[long + 1].tolist(), strict=True))


def _within(spans: Sequence[Span], begin_ns: int, end_ns: int) -> bool:
    return any(a <= begin_ns and end_ns <= b for a, b in spans)
