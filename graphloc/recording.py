# SPDX-License-Identifier: Apache-2.0
"""A run as it was read: measurements, truth where there is one, and an account of every message."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import ImuSeries, Measurement, TagView
from graphloc.time import utc_text
from graphloc.trajectory import Trajectory

_M = TypeVar("_M", bound=Measurement)
Mounts = Mapping[str, tuple[Array, Array]]
"""By sensor or LiDAR, its pose in body: t (3,) m, R (3, 3)."""
Progress = Callable[[str, int, int], None]
"""Called with stage, done, total."""


def quiet(_stage: str, _done: int, _total: int) -> None:
    """A `Progress` that says nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpeedSeries:
    """Forward speed from a sensor that is not fused: stamps (N,) ns and speeds (N,) m/s."""

    topic: str
    stamps_ns: NDArray[np.int64]
    speed_mps: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """The part of a bag that a recording is, by the times at which messages were recorded.

    Attributes:
        start_s, end_s: begin and end, s since the beginning of the bag. bag_s: length of the bag, s.
        start_ns, end_ns: begin and end by the clock of recording; a message at the end does not belong to it.
        messages, left_out: by topic, number of messages in this part, and outside of it; the latter are no part of the run.
    """

    start_s: float
    end_s: float
    bag_s: float
    start_ns: int
    end_ns: int
    messages: Mapping[str, int]
    left_out: Mapping[str, int]

    def of(self, topics: Container[str]) -> Span:
        """Return it with the counts of some topics."""
        inside, outside = ({t: n for t, n in c.items() if t in topics} for c in (self.messages, self.left_out))
        return replace(self, messages=inside, left_out=outside)

    def __str__(self) -> str:
        """Which part of the bag it is, and how many of the messages it takes."""
        inside = sum(self.messages.values())
        return (
            f"{self.start_s:.1f} s to {self.end_s:.1f} s of {self.bag_s:.1f} s, begun at {utc_text(self.start_ns)}: "
            f"{inside} of {inside + sum(self.left_out.values())} messages on the topics that vessel.yaml names; the "
            "others are no part of this run"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """A run as a front-end has read it.

    Attributes:
        source: the bag's path, with which part of it, or '(simulated)'.
        imu: the inertial samples, or None where the run has none.
        measurements: everything else, ordered by stamp, then arrival.
        rows: ledger rows of messages that gave no measurement (malformed, rejected, ignored). Together
            with the measurements and the IMU samples they add up to `message_count`.
        message_count: messages in the recording.
        topics: topic of each configured sensor.
        mounts: poses in body, t (3,) and R (3, 3), of sensors whose mount came from /tf_static.
        truth: true body trajectory in world, if known.
        check_speed: forward speed of a sensor that is not fused: the estimate is compared with it.
        tag_views: sightings of tags that are not in the survey.
        warnings: one line each, for the report.
        span: which part of the bag it is; None: the whole.
        clock_doubts: sentences on sensors that are not on one clock, although the bounds assume it. No pose is then called good.
    """

    source: str
    imu: ImuSeries | None
    measurements: tuple[Measurement, ...]
    rows: tuple[LedgerRow, ...] = ()
    message_count: int = 0
    topics: Mapping[str, str] = field(default_factory=dict)
    mounts: Mounts = field(default_factory=dict)
    truth: Trajectory | None = None
    check_speed: SpeedSeries | None = None
    tag_views: tuple[TagView, ...] = ()
    warnings: tuple[str, ...] = ()
    span: Span | None = None
    clock_doubts: tuple[str, ...] = ()

    def __repr__(self) -> str:
        imu = "no IMU" if self.imu is None else f"{len(self.imu)} samples of {self.imu.sensor}"
        return f"<Recording of {self.source}: {imu}, {len(self.measurements)} measurements of {self.message_count} messages>"

    def of(self, kind: type[_M], sensor: str | None = None) -> list[_M]:
        """Return its measurements of a class, in order: all, or those of one sensor."""
        return [m for m in self.measurements if isinstance(m, kind) and sensor in (None, m.sensor)]

    def where(self, keep: Callable[[Measurement], bool]) -> Recording:
        """Return it without the measurements that are not to be kept."""
        return replace(self, measurements=tuple(m for m in self.measurements if keep(m)))

    def changed(self, change: Callable[[Measurement], Measurement]) -> Recording:
        """Return it with each measurement changed."""
        return replace(self, measurements=tuple(map(change, self.measurements)))

    def row_of(self, m: Measurement, outcome: Outcome, reason: str) -> LedgerRow:
        """Return the ledger row of one of its measurements."""
        topic = self.topics.get(m.sensor, "")
        return LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic=topic, outcome=outcome, reason=reason)

    def imu_rows(self, which: NDArray[np.bool_] | slice, outcome: Outcome, reason: str) -> list[LedgerRow]:
        """Return the ledger rows of some samples of its IMU; `which`: (N,) whether of each, or a slice."""
        assert self.imu is not None
        sensor, seqs, stamps_ns = self.imu.sensor, self.imu.seqs[which].tolist(), self.imu.stamps_ns[which].tolist()
        topic = self.topics.get(sensor, "")
        return [
            LedgerRow(seq=seq, stamp_ns=stamp_ns, sensor=sensor, topic=topic, outcome=outcome, reason=reason)
            for seq, stamp_ns in zip(seqs, stamps_ns, strict=True)
        ]

    def lost(self, sensors: Container[str]) -> str:
        """Return a clause with the commonest reason why messages of these sensors gave no measurement; empty where all did."""
        reasons: Counter[str] = Counter()
        for row in self.rows:
            if row.sensor in sensors:
                reasons[row.common_reason] += row.count
        ((reason, count),) = reasons.most_common(1) or (("", 0),)
        return f"; {count} of its messages gave nothing: {reason}" if count else ""
