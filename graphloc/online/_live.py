# SPDX-License-Identifier: Apache-2.0
"""The online problem: it grows at its end, and its beginning is forgotten (offline: `graphloc.build.Problem`)."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Mapping, MutableMapping
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Any, Generic, TypeVar

import gtsam
import numpy as np

from graphloc.build import (
    SPACED_BY,
    Carry,
    asks_for_delay,
    company_of,
    height_told_better,
    mount_of,
    rows_of,
    shared_constants,
    silent_s,
    slow_or_left_out,
    spacing_s,
    state_of,
    without_drift,
)
from graphloc.config import SensorConfig, TimelineConfig, VesselConfig
from graphloc.frames import Array, Datum
from graphloc.graph import Constant, Sensor, SlowProcess
from graphloc.inertial import InertialLink
from graphloc.measurements import ImuSeries, Measurement
from graphloc.motion_model import MotionModel
from graphloc.online._frozen_receiver import FrozenReceiverDetector
from graphloc.online._repeated_fix import RepeatedFixDetector
from graphloc.online._repeated_velocity import RepeatedVelocityDetector
from graphloc.online._scatter import Scatter
from graphloc.online._setup import Setup
from graphloc.signals.heading_steps import HeadingStep, HeadingStepDetector
from graphloc.signals.position_jumps import JumpDetector, PositionJump
from graphloc.time import NS_PER_S, duration_ns

T = TypeVar("T")
_USUAL = 16  # newest measurements, which tell how far apart they usually come
_PAGE_S = 1.0  # states are marginalised in pages of this length


class Tape(Generic[T]):
    """A list whose oldest items are forgotten; the indices of the others stay the same."""

    def __init__(self) -> None:
        self._items: list[T] = []
        self.first = 0

    def __len__(self) -> int:
        return self.first + len(self._items)

    def __getitem__(self, k: int) -> T:
        if k < self.first:
            raise IndexError(f"{k} is forgotten")
        return self._items[k - self.first]

    def __setitem__(self, k: int, item: T) -> None:
        if k < self.first:
            raise IndexError(f"{k} is forgotten")
        self._items[k - self.first] = item

    def append(self, item: T) -> None:
        self._items.append(item)

    def forget(self, before: int) -> None:
        del self._items[: max(before - self.first, 0)]
        self.first = max(before, self.first)

    @property
    def kept(self) -> list[T]:
        return self._items


class LiveTimeline:
    """States on a regular grid from `start_ns` on, and the slow nodes among them.

    Args:
        config: rates of states and slow nodes. start_ns: stamp of the first state.
        jumps_ns: stamps of the first fixes (headings) after position jumps (steps). A slow node begins at the state of each, because fixes
            that share a slow node share their slow error, and fixes before and after a jump do not.
    """

    def __init__(self, config: TimelineConfig, start_ns: int, jumps_ns: Collection[int]) -> None:
        self._start_ns, self._jumps_ns = start_ns, jumps_ns
        self._period_ns, self._slow_ns = duration_ns(1.0 / config.rate_hz), duration_ns(config.slow_period_s)
        self.stamps_ns: Tape[int] = Tape()
        self.slow_of: Tape[int] = Tape()
        self.slow_stamps_ns: Tape[int] = Tape()
        self._slow_step = -1
        self.append(start_ns)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def first(self) -> int:
        """Number of the oldest state that is kept."""
        return self.stamps_ns.first

    @property
    def last(self) -> int:
        return len(self) - 1

    @property
    def due_ns(self) -> int:
        """Stamp of the next state."""
        return self.stamps_ns[self.last] + self._period_ns

    def seconds(self, stamp_ns: int) -> float:
        """Return the time (s) since the first state of all."""
        return (stamp_ns - self._start_ns) * 1e-9

    def page_s(self, stamp_ns: int) -> float:
        """Return the time (s) by which the window marginalises the keys of a stamp: it is the same for all of a page.

        Marginalising keys eliminates all newer ones again; so it is done once per page, and not at every state.
        """
        return float(np.ceil(self.seconds(stamp_ns) / _PAGE_S)) * _PAGE_S

    def append(self, stamp_ns: int) -> None:
        step = (stamp_ns - self._start_ns) // self._slow_ns
        since_ns, until_ns = self.attached_until_ns(stamp_ns - self._period_ns), self.attached_until_ns(stamp_ns)
        if step != self._slow_step or any(since_ns < at_ns <= until_ns for at_ns in self._jumps_ns):
            self.slow_stamps_ns.append(stamp_ns)
            self._slow_step = step
        self.stamps_ns.append(stamp_ns)
        self.slow_of.append(len(self.slow_stamps_ns) - 1)

    def forget(self, before: int) -> None:
        self.stamps_ns.forget(before)
        self.slow_of.forget(before)
        self.slow_stamps_ns.forget(self.slow_of[before])

    def attached_until_ns(self, stamp_ns: int) -> int:
        """Return the latest stamp that a measurement may have to attach, by `nearest`, to a state at `stamp_ns`."""
        return stamp_ns + self._period_ns // 2

    def nearest(self, stamp_ns: int) -> int:
        """Return the number of the state nearest to a stamp."""
        kept = self.stamps_ns.kept
        right = min(max(bisect_left(kept, stamp_ns), 1), len(kept) - 1)
        left = right - 1 if len(kept) > 1 else right
        return self.first + (left if stamp_ns - kept[left] <= kept[right] - stamp_ns else right)

    def floor(self, stamp_ns: int) -> int:
        """Return the number of the last state at or before a stamp; of the oldest one, if the stamp lies before it."""
        return self.first + max(bisect_right(self.stamps_ns.kept, stamp_ns) - 1, 0)


@dataclass(slots=True, eq=False)
class ReceiverDetectors:
    """Detectors of a sensor's repetitions, jumps, steps and wrong settings; they outlive the window."""

    repeated_fix: RepeatedFixDetector = field(default_factory=RepeatedFixDetector)
    repeated_velocity: RepeatedVelocityDetector = field(default_factory=RepeatedVelocityDetector)
    jump: JumpDetector = field(default_factory=JumpDetector)
    heading: HeadingStepDetector = field(default_factory=HeadingStepDetector)
    far_off: dict[str, float] = field(default_factory=dict)
    """Settings that users were warned of as far from the estimate, and by how much they were off then."""

    def forget(self) -> None:
        """Forget what was found with the estimate, which is given up; a restart does not change levels of fixes."""
        self.repeated_fix, self.repeated_velocity = RepeatedFixDetector(), RepeatedVelocityDetector()
        self.jump.forget()
        self.heading = HeadingStepDetector()

    @property
    def jumps(self) -> tuple[PositionJump | HeadingStep, ...]:
        """The jumps of positions and steps of headings found since the estimate started."""
        return (*self.jump.jumps, *self.heading.steps)


@dataclass(slots=True, eq=False)
class LiveStream:
    """The measurements of one sensor in order of arrival (offline: `graphloc.build.Stream`), and its detectors.

    Attributes:
        number, name, row, config, constants, mount, shares, without_height: as of a `build.Stream`.
        slow: the slow error that is estimated. left_out: the slow error that is added to the bounds instead, because no
            second sensor separates it from motion. Once the receiver has jumped there are both: the window then
            estimates its jumps alone.
        measurements, state, carry, gyro_radps, felt, apart_s: as of a `build.Stream`, by order of arrival; the oldest
            are forgotten.
        by_stamp: stamps (ns) and indices of the measurements that are kept, by stamp.
        scatter: by what factor its residuals scatter more than stated.
        frozen_detector: finds that its position stays while the estimate moves; a new window begins with a new one.
        receiver: detectors that outlive the window.
        jumps: jumps of positions, or steps of headings, that the window estimates.
        told_ns: newest stamp of its measurements. anew_ns: `told_ns` when its slow error was last drawn anew; None: it
            never was.
    """

    number: int
    name: str
    row: Sensor
    config: SensorConfig
    slow: SlowProcess | None
    left_out: SlowProcess | None
    constants: tuple[Constant, ...]
    mount: Any
    measurements: Tape[Measurement] = field(default_factory=Tape)
    state: Tape[int] = field(default_factory=Tape)
    carry: Tape[Carry | None] = field(default_factory=Tape)
    gyro_radps: Tape[Array] = field(default_factory=Tape)
    felt: Tape[Array] = field(default_factory=Tape)
    apart_s: Tape[float] = field(default_factory=Tape)
    by_stamp: list[tuple[int, int]] = field(default_factory=list)
    scatter: Scatter = field(default_factory=Scatter)
    frozen_detector: FrozenReceiverDetector = field(default_factory=FrozenReceiverDetector)
    receiver: ReceiverDetectors = field(default_factory=ReceiverDetectors)
    jumps: tuple[PositionJump | HeadingStep, ...] = ()
    told_ns: int = 0
    anew_ns: int | None = None
    shares: int | None = None
    without_height: bool = False

    @property
    def frozen(self) -> bool:
        """Whether the receiver repeats one position while the vessel moves."""
        return self.frozen_detector.frozen or self.receiver.repeated_fix.frozen

    @property
    def may_jump(self) -> bool:
        """Whether jumps of its positions, or steps of its headings, can be estimated as its slow error."""
        return self.left_out is not None or (self.slow is not None and (self.slow.jumps or bool(self.slow.stepped)))

    @property
    def noisier(self) -> float:
        """Factor on the stated sigma; 1 for a sensor of position: its residuals may scatter by the estimate's error."""
        return 1.0 if self.row.absolute else self.scatter.noisier

    def space(self) -> None:
        """Note how far apart measurements come at the one taken last; also anew at those after it, if it came late.

        Where measurements come up to 2 s late and out of order, about half of the newest are still missing. If the
        distance of the others were final, each would count for more than it tells.
        """
        index = len(self.measurements) - 1
        taken = (self.measurements[index].stamp_ns, index)
        first = bisect_left(self.by_stamp, taken)
        self.by_stamp.insert(first, taken)
        self.apart_s.append(math.inf)
        since = max(first - SPACED_BY, 0)
        around = self.by_stamp[since : first + SPACED_BY + 1]
        apart_s = spacing_s(np.array([stamp_ns for stamp_ns, _ in around]))
        for n in range(first - since, len(around)):
            self.apart_s[around[n][1]] = float(apart_s[n])

    def drawn_anew(self, stamp_ns: int) -> bool:
        """Return whether the slow error is drawn anew at a stamp, after a long silence; True once per silence."""
        silent_ns = stamp_ns - self.told_ns
        if self.slow is None or self.told_ns == self.anew_ns or silent_ns <= self.slow.anew_after_s * NS_PER_S:
            return False
        usual_ns = [b - a for (a, _), (b, _) in pairwise(self.by_stamp[-_USUAL:])]
        if silent_ns <= silent_s(self.slow, median(usual_ns or [0.0]) / NS_PER_S) * NS_PER_S:
            return False
        self.anew_ns = self.told_ns
        return True

    def forget(self, before: int) -> None:
        """Forget the measurements before an index."""
        self.by_stamp = [taken for taken in self.by_stamp if taken[1] >= before]
        for tape in (self.measurements, self.state, self.carry, self.gyro_radps, self.felt, self.apart_s):
            tape.forget(before)

    def jumped(self, after_ns: int, until_ns: int) -> tuple[float, Array | None]:
        """Return the largest jump (m, rad) in `after_ns` < stamp <= `until_ns`, and the slow error (k,) that those at once add.

        0 and None where there is no jump.
        """
        found = [j for j in self.jumps if after_ns < j.until_ns and j.after_ns <= until_ns]
        if self.slow is None or not found or not self.slow.jump_axes.any():
            return 0.0, None
        moved = np.array(
            [axis in (*self.slow.far, *self.slow.stepped) for axis in self.slow.axes]
        )  # by as much as seen
        step = np.zeros(len(self.slow.axes))
        added = np.array([j.parts for j in found]) / self.slow.scale[moved]
        step[moved] = added[[j.after_ns > after_ns and j.at_once for j in found]].sum(axis=0)
        return float(np.linalg.norm(added, axis=1).max()), step


@dataclass(slots=True, eq=False)
class LiveProblem:
    """A problem that grows and forgets. It has the attributes that `build.attach` needs, as a `build.Problem` has them.

    Attributes:
        config: the vessel. datum: origin of world. timeline: states and slow nodes.
        t_body_imu_m, R_body_imu: (3,), (3, 3) mount of the IMU in body. imu_mount_sigma_rad: (3,) 1 sigma of its
            rotation about each axis of the body.
        links: preintegration of the IMU. streams: by name of the sensor. motion_model: for outages.
    """

    config: VesselConfig
    datum: Datum
    timeline: LiveTimeline
    t_body_imu_m: Array
    R_body_imu: Array
    imu_mount_sigma_rad: Array
    links: InertialLink
    streams: dict[str, LiveStream]
    motion_model: MotionModel

    def others_of_place(self, name: str) -> list[LiveStream]:
        """Return the other sensors of position, without those that read the same receiver by turns."""
        same = self.config.by_turns(name)
        return [s for s in self.streams.values() if s.row.absolute and s.name not in (name, *same)]

    def take(self, m: Measurement) -> tuple[LiveStream, int]:
        """Attach a measurement to its state; return its stream and its index there."""
        stream = self.streams[m.sensor]
        carry, gyro_radps, felt = self._motion(stream, m.stamp_ns)
        timeline = self.timeline
        floor, nearest = timeline.floor(m.stamp_ns), timeline.nearest(m.stamp_ns)
        stream.measurements.append(m)
        if stream.told_ns == stream.anew_ns:  # until now the position was by the slow error before the silence
            stream.receiver.jump.drawn_anew(m.stamp_ns)
        stream.told_ns = max(stream.told_ns, m.stamp_ns)
        stream.space()
        stream.state.append(state_of(m, floor, nearest, timeline.stamps_ns, self.links.gaps()))
        stream.carry.append(carry)
        stream.gyro_radps.append(gyro_radps)
        stream.felt.append(felt)
        return stream, len(stream.measurements) - 1

    def reintegrate(self, stream: LiveStream, index: int) -> None:
        """Integrate the IMU again from the state before a measurement to its stamp: samples in between came late."""
        stream.carry[index], stream.gyro_radps[index], stream.felt[index] = self._motion(
            stream, stream.measurements[index].stamp_ns
        )

    def _motion(self, stream: LiveStream, stamp_ns: int) -> tuple[Carry | None, Array, Array]:
        """Return the motion by the IMU at a stamp.

        Returns:
            The motion from the state before the stamp to it, None at a state; the raw angular rate (3,), rad/s; and
            `felt` (6,), as of a `build.Stream`.
        """
        floor = self.timeline.floor(stamp_ns)
        at_ns = self.timeline.stamps_ns[floor]
        carry = None
        if stamp_ns > at_ns:
            carry = (floor, self.links.integrate(at_ns, stamp_ns, gtsam.imuBias.ConstantBias()))
        stamps_ns = np.array([stamp_ns])
        felt = self.links.felt_at(stamps_ns)[0] if asks_for_delay(stream.constants) else np.zeros(6)
        return carry, self.links.gyro_at(stamps_ns)[0], felt


def live_problem(
    setup: Setup,
    datum: Datum,
    *,
    imu: ImuSeries,
    start_ns: int,
    imu_config: Any,
    noise_scale: float,
    motion_model: MotionModel,
    receivers: MutableMapping[str, ReceiverDetectors],
    slow_known: Collection[str],
) -> LiveProblem:
    """Return a problem whose first state is at `start_ns`.

    Args:
        setup: of the online mode. datum: origin of world.
        imu: the samples known from `start_ns` on. imu_config: configuration of the IMU, with the noise that the samples
            have but for `noise_scale`, a further factor on it.
        motion_model: for outages. receivers: detectors, by sensor; missing ones are added.
        slow_known: names of the sensors whose slow error is known at the start.
    """
    config, by_name = setup.config, rows_of(setup.config, setup.rows)
    t, R = mount_of(imu.sensor, imu_config, setup.mounts)
    company = company_of(config, setup.rows)
    streams = {
        name: _live_stream(
            setup, name, number, by_name, t, company,
            receiver=receivers.setdefault(name, ReceiverDetectors()), known=name in slow_known, start_ns=start_ns,
        )
        for number, name in enumerate(config.sensors)
        if name in by_name
    }  # fmt: skip
    jumps_ns = [jump.after_ns for stream in streams.values() if stream.may_jump for jump in stream.jumps]
    return LiveProblem(
        config=config,
        datum=datum,
        timeline=LiveTimeline(config.timeline, start_ns, jumps_ns),
        t_body_imu_m=t,
        R_body_imu=R,
        imu_mount_sigma_rad=imu_config.mount_sigma_rad,
        links=setup.inertial.link(imu, imu_config, R, datum.gravity_mps2, noise_scale),
        streams=streams,
        motion_model=motion_model,
    )


def _live_stream(
    setup: Setup,
    name: str,
    number: int,
    rows: Mapping[str, Sensor],
    t_body_imu_m: Array,
    company: int,
    *,
    receiver: ReceiverDetectors,
    known: bool,
    start_ns: int,
) -> LiveStream:
    """Return the stream of a sensor, without measurements.

    Args:
        rows: row of the table of sensors, by name of the sensor. t_body_imu_m: (3,) place of the IMU in body.
        company: how many sensors can separate each other's slow errors from motion. known: whether its slow error is
            known at the start.
    """
    config, row = setup.config.sensors[name], rows[name]
    constants, shares = shared_constants(name, setup.config, rows)
    slow, left_out = slow_or_left_out(row, config, company)
    if left_out is not None and (receiver.jump.jumps or known):
        slow = without_drift(left_out)
    t, R = mount_of(name, config, setup.mounts)
    return LiveStream(
        number=number,
        name=name,
        row=row,
        config=config,
        slow=slow,
        left_out=left_out,
        without_height=height_told_better(setup.config, setup.rows, left_out),
        constants=constants,
        shares=shares,
        mount=gtsam.Pose3(gtsam.Rot3(R), t - t_body_imu_m),
        scatter=Scatter(jumps=slow is not None and slow.jumps),
        receiver=receiver,
        jumps=receiver.jumps,
        told_ns=start_ns,
    )
