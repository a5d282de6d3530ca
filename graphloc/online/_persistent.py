# SPDX-License-Identifier: Apache-2.0
"""State outside the sliding window: kept in a rebuild, in a restart and, in part, in the snapshot."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

from graphloc.config import SIGMA_SCALES
from graphloc.frames import Datum
from graphloc.measurements import ImuSample
from graphloc.motion_model import MotionModel
from graphloc.online._anchor import Anchor
from graphloc.online._heading_check import HeadingCheck
from graphloc.online._live import ReceiverDetectors
from graphloc.online._noise import ImuNoise
from graphloc.online._odometry import Odometry
from graphloc.online._sensor_clock import SensorClock
from graphloc.online._sensor_noise import SensorNoise
from graphloc.online._setup import Setup
from graphloc.online._snapshot import Snapshot
from graphloc.online._unmeasured_heading import UnmeasuredHeading
from graphloc.online._unmodelled import UnmodelledError
from graphloc.signals.heading_steps import HeadingStepDetector


@dataclass(slots=True, kw_only=True, eq=False)
class PersistentState:
    """State of the online mode outside the sliding window.

    Attributes:
        datum: origin of world; None before it is known.
        noise: by how much the IMU's noise is raised. sensor_noise: factors on the sigmas of sensors that scatter more
            than they state.
        heights_m: configured heights (m, up in world), by the name of the sensor that measures them.
        heading: how far the heading may be off where no sensor measures it; None: one does, or the motion has confirmed
            it.
        agreed_ns: stamp at which each absolute sensor last agreed, as known when the last window ended.
        odometry: the `odom` frame; None before the first start.
        motion_model: for outages. heading_check: whether the heading fits the motion.
        receivers: detectors of repeated fixes and velocities, and of position jumps, by sensor.
        clocks: by sensor; they correct stamps where a sensor's clock is set in mid-run.
        frozen: names of the receivers that were last reported as frozen.
        unmodelled: effect of left-out slow errors and of the IMU's mount on the newest state; None: there is none.
    """

    datum: Datum | None
    noise: ImuNoise
    sensor_noise: SensorNoise = field(default_factory=SensorNoise)
    heights_m: Mapping[str, float] = field(default_factory=dict)
    heading: UnmeasuredHeading | None = None
    agreed_ns: dict[str, int] = field(default_factory=dict)
    odometry: Odometry | None = None
    motion_model: MotionModel = field(default_factory=MotionModel)
    heading_check: HeadingCheck = field(default_factory=HeadingCheck)
    receivers: dict[str, ReceiverDetectors] = field(default_factory=dict)
    clocks: dict[str, SensorClock] = field(default_factory=lambda: defaultdict(SensorClock))
    frozen: set[str] = field(default_factory=set)
    unmodelled: UnmodelledError | None = None

    @classmethod
    def resumed(cls, found: Snapshot, noise: ImuNoise, sensors: Mapping[str, Any]) -> PersistentState:
        """Return the state that a snapshot holds.

        Args:
            noise: of the IMU; it is raised to the snapshot's. sensors: configuration of the enabled sensors, by name.
        """
        noise.at_least(*found.noise)
        persistent = cls(
            datum=found.datum,
            noise=noise,
            sensor_noise=SensorNoise(
                {
                    name: {key: by for key, by in times.items() if key in SIGMA_SCALES and hasattr(sensors[name], key)}
                    for name, times in found.sensor_noise.items()
                    if name in sensors
                }
            ),
            heights_m={
                name: height_m if (now_m := sensors[name].height_m) is None else now_m - found.datum.origin.height_m
                for name, height_m in found.heights_m.items()
                if name in sensors
            },
            heading=found.heading,
            agreed_ns=dict(found.agreed_ns),
            odometry=Odometry(found.anchor.stamp_ns, found.p_odom_m, found.R_odom_body),
            receivers={name: ReceiverDetectors(heading=HeadingStepDetector(stepped=True)) for name in found.stepped},
        )
        for name, set_ns in found.clocks_set_ns.items():
            persistent.clocks[name].set_ns = set_ns
        return persistent

    def snapshot(self, setup: Setup, anchor: Anchor, imu: ImuSample, agreed_ns: Mapping[str, int]) -> Snapshot:
        """Return the snapshot from which a run can resume after its process was killed.

        Args:
            setup: of the online mode. anchor: the state to resume at. imu: the last sample at or before it.
            agreed_ns: stamp at which each absolute sensor last agreed with the window.
        """
        assert self.datum is not None
        assert self.odometry is not None
        return Snapshot(
            vessel=setup.config.vessel,
            settings=setup.settings,
            clocks_set_ns={name: clock.set_ns for name, clock in self.clocks.items() if clock.set_ns},
            anchor=anchor,
            imu=imu,
            datum=self.datum,
            heights_m=self.heights_m,
            agreed_ns={**self.agreed_ns, **agreed_ns},
            sensor_noise=self.sensor_noise.times,
            noise=(self.noise.scale, self.noise.gyro, self.noise.accel, *self.noise.walk.times.tolist()),
            heading=self.heading,
            p_odom_m=self.odometry.p_m,
            R_odom_body=self.odometry.R,
            unmodelled=None if self.unmodelled is None else self.unmodelled.sizes,
            stepped=frozenset(name for name, receiver in self.receivers.items() if receiver.heading.stepped),
        )

    def learns_in_trial(self, since_ns: int) -> Callable[[], None]:
        """Replace by copies what learns from each measurement; return a function that brings the originals back.

        Args:
            since_ns: stamp from which the IMU is left out: the accelerations of the heading check are wrong.
        """
        before = self.receivers, self.heading_check, self.motion_model
        self.receivers, self.motion_model = deepcopy(self.receivers), deepcopy(self.motion_model)
        self.heading_check = HeadingCheck()
        for receiver in self.receivers.values():
            receiver.jump.forget_since(since_ns)

        def back() -> None:
            self.receivers, self.heading_check, self.motion_model = before

        return back

    def forget_receivers(self) -> None:
        """Forget position jumps and repetitions of receivers: they were found with the estimate, which is given up."""
        for receiver in self.receivers.values():
            receiver.forget()

    def forget_clock(self, stamp_ns: int) -> None:
        """Forget stamps of a clock that was set back; `stamp_ns`: the stamp now, by that clock."""
        self.agreed_ns, self.receivers = {}, {}
        self.sensor_noise.forget_clock()
        if self.odometry is not None:
            self.odometry.stamp_ns = stamp_ns
