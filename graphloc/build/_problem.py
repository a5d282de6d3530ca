# SPDX-License-Identifier: Apache-2.0
"""What does not change while solving: timeline, preintegrated motion, and where each measurement attaches.

If a part of it has to change, such as the noise of the IMU, a new problem takes its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build._attach import Carry, asks_for_delay, nav_state
from graphloc.build._usual_motion import UsualMotion, usual_motion
from graphloc.config import SensorConfig, VesselConfig
from graphloc.frames import Array, Datum
from graphloc.graph import Constant, Sensor, SlowProcess
from graphloc.inertial import GapMotion, InertialLink
from graphloc.ledger import LedgerRow
from graphloc.measurements import ImuSeries, Measurement
from graphloc.signals.heading_steps import HeadingStep
from graphloc.time import NS_PER_S, stamps_of
from graphloc.timeline import Timeline

PositionJumps = tuple[NDArray[np.int64], Array]
"""Stamps (K,), ns, and sizes (K,), m, of the position jumps of a receiver."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The measurements of one sensor and where they attach.

    Attributes:
        number: of the sensor, for keys. name, row, config: name, row of the table and configuration of the sensor.
        slow: its slow state, or None. left_out: the slow state that it would have beside a second position sensor, or
            None.
        position_jumps: those of a receiver that alone measures position.
        heading_steps: those of a compass.
        constants: those that its measurements depend on.
        mount: pose of the sensor seen from the IMU, body axes (gtsam.Pose3).
        measurements: M of them by stamp. state: (M,) the state of each (`state_of`). carry: for each, the preintegrated
            motion from the state before it; None where its stamp is that of a state.
        gyro_radps: (M, 3) raw rate at each measurement, body axes.
        felt: (M, 6) raw specific force and change of the rate about each measurement, body axes; 0 where no delay is
            estimated.
        apart_s: (M,) usual time between measurements, s, at each (`spacing_s`).
        anew: slow nodes (K,) after which its slow error is drawn anew.
        usual: (N,) at which slow nodes its error is at its usual level; None: not known (see `solve/_levels.py`).
        shares: number of the sensor whose constants these are (`shared_constants`); None: they are its own.
        without_height: whether the heights of its fixes are not used (`height_told_better`).
    """

    number: int
    name: str
    row: Sensor
    config: SensorConfig
    slow: SlowProcess | None
    left_out: SlowProcess | None
    position_jumps: PositionJumps
    heading_steps: tuple[HeadingStep, ...]
    constants: tuple[Constant, ...]
    mount: Any
    measurements: tuple[Measurement, ...]
    state: NDArray[np.int64]
    carry: tuple[Carry | None, ...]
    gyro_radps: Array
    felt: Array
    apart_s: Array
    anew: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    usual: NDArray[np.bool_] | None = None
    shares: int | None = None
    without_height: bool = False

    def between(self, first: int, last: int) -> range:
        """Return the indices of the measurements that attach to states first..last (inclusive)."""
        lo, hi = np.searchsorted(self.state, [first, last + 1])
        return range(int(lo), int(hi))

    def only(self, indices: NDArray[np.int64]) -> Stream:
        """Return the stream with some of its measurements alone."""
        few = indices.tolist()
        measurements = tuple(self.measurements[i] for i in few)
        return replace(
            self,
            measurements=measurements,
            state=self.state[indices],
            carry=tuple(self.carry[i] for i in few),
            gyro_radps=self.gyro_radps[indices],
            felt=self.felt[indices],
            # Each stands for the measurements before it that are left out.
            apart_s=np.diff(stamps_of(measurements) / NS_PER_S, prepend=-np.inf),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A run, ready to be solved.

    Attributes:
        config: of the vessel. datum: origin of world. timeline: stamps of the states and slow nodes.
        imu: samples of the IMU.
        t_body_imu_m, R_body_imu: (3,), (3, 3) mount of the IMU in body.
        relink: returns the links of the IMU for its configuration, a noise scale and the rotation (3, 3) of its mount.
        links: preintegration of the IMU, with its noise scaled by `noise_scale`.
        preintegrated, inertial: motion from each state to the next, and its factor. Neither depends on the estimate, so
            all graphs share them.
        streams: measurements of each sensor, and where they attach.
        rejected: ledger rows of measurements that the graph cannot take.
        warnings: one line each, for the report.
        silent: clauses for errors, on why sensors have no measurement here.
        left_out: spans (after one stamp until another, ns) in which samples of the IMU are left out.
        imu_turn_rad: (3,) by which the IMU's mount is turned against the configured one, body axes.
        usual_motion: where the motion model is used; None before there is an estimate, and where nothing needs it.
    """

    config: VesselConfig
    datum: Datum
    timeline: Timeline
    imu: ImuSeries
    t_body_imu_m: Array
    R_body_imu: Array
    relink: Callable[[Any, float, Array], InertialLink]
    links: InertialLink
    noise_scale: float
    preintegrated: tuple[Any, ...]
    inertial: tuple[Any, ...]
    streams: tuple[Stream, ...]
    rejected: tuple[LedgerRow, ...]
    warnings: tuple[str, ...] = field(default=())
    silent: str = ""
    left_out: tuple[tuple[int, int], ...] = ()
    imu_turn_rad: Array = field(default_factory=lambda: np.zeros(3))
    usual_motion: UsualMotion | None = None


def preintegrate(timeline: Timeline, links: InertialLink) -> tuple[Any, ...]:
    """Return the preintegrated motion from each state to the next, at zero bias."""
    zero = gtsam.imuBias.ConstantBias()
    stamps = [int(s) for s in timeline.stamps_ns]
    return tuple(links.integrate(a, b, zero) for a, b in pairwise(stamps))


def inertial_factors(timeline: Timeline, links: InertialLink, preintegrated: Sequence[Any]) -> tuple[Any, ...]:
    """Return the factor of each preintegrated motion."""
    return tuple(links.factor(k, int(timeline.slow_of[k]), pim) for k, pim in enumerate(preintegrated))


def with_noise_scale(problem: Problem, noise_scale: float) -> Problem:
    """Return the problem with the configured noise densities of the IMU scaled by `noise_scale`."""
    return _relinked(problem, problem.config, noise_scale)


def with_imu_noise(problem: Problem, gyro: float, accel: float) -> Problem:
    """Return the problem with the configured noise densities of its IMU multiplied by a factor per kind of sensor."""
    return with_imu_scaled(problem, _imu_noise_times(gyro, accel))


def with_imu_scaled(problem: Problem, times: Mapping[str, float]) -> Problem:
    """Return the problem with numbers in the configuration of its IMU multiplied by factors.

    Args:
        times: factors, by key of the configuration.
    """
    return _relinked(problem, problem.config.scaled({problem.imu.sensor: times}), problem.noise_scale)


def with_sensor_noise(problem: Problem, times: Mapping[str, Mapping[str, float]]) -> Problem:
    """Return the problem with sigmas of its sensors multiplied by factors.

    Args:
        times: factors, by sensor and key of its configuration.
    """
    config = problem.config.scaled(times)
    streams = tuple(replace(stream, config=config.sensors[stream.name]) for stream in problem.streams)
    return replace(problem, config=config, streams=streams)


def noisier_imu(sensor: Any, gyro: float, accel: float) -> Any:
    """Return the configuration of an IMU with its noise densities multiplied by a factor each."""
    return sensor.scaled(_imu_noise_times(gyro, accel))


def _imu_noise_times(gyro: float, accel: float) -> dict[str, float]:
    return {"gyro_noise_mdps_per_sqrt_hz": gyro, "accel_noise_ug_per_sqrt_hz": accel}


def _relinked(problem: Problem, config: VesselConfig, noise_scale: float) -> Problem:
    links = _links(problem, config, noise_scale, problem.left_out)
    relinked = replace(problem, config=config, links=links, noise_scale=noise_scale)
    return with_links(relinked, preintegrate(problem.timeline, links))


def _links(
    problem: Problem, config: VesselConfig, noise_scale: float, left_out: Sequence[tuple[int, int]]
) -> InertialLink:
    links = problem.relink(config.sensors[problem.imu.sensor], noise_scale, problem.R_body_imu)
    for span in left_out:
        links.leave_out(*span)
    return links


def without_imu(problem: Problem, values: gtsam.Values, after_ns: int, until_ns: int) -> Problem:
    """Return the problem without the IMU's samples after one stamp until another: a gap, bridged by an estimate.

    Args:
        values: estimate whose motion before the gap goes on in it.
    """
    left_out = (*problem.left_out, (after_ns, until_ns))
    links = _links(problem, problem.config, problem.noise_scale, left_out)
    streams = tuple(_carried_anew(s, problem.timeline, links, after_ns, until_ns) for s in problem.streams)
    return _bridged(replace(problem, links=links, left_out=left_out, streams=streams), values, [(after_ns, until_ns)])


def with_imu_turned(problem: Problem, values: gtsam.Values, turn_rad: Array) -> Problem:
    """Return the problem with the mount of its IMU turned by a small rotation (3,), rad, body axes.

    Args:
        values: estimate whose motion before each IMU gap goes on in it.
    """
    R = gtsam.Rot3.Expmap(turn_rad).matrix() @ problem.R_body_imu
    turned = replace(problem, R_body_imu=R, imu_turn_rad=problem.imu_turn_rad + turn_rad)
    turned = _relinked(turned, problem.config, problem.noise_scale)
    always = np.iinfo(np.int64)
    streams = tuple(
        _carried_anew(s, problem.timeline, turned.links, int(always.min), int(always.max)) for s in problem.streams
    )
    return bridged(replace(turned, streams=streams), values)


def without_sensor(problem: Problem, stream: Stream) -> Problem:
    """Return the problem without the measurements of one of its streams."""
    none = np.empty(0, dtype=np.int64)
    return replace(
        problem, streams=tuple(replace(s.only(none), anew=none) if s is stream else s for s in problem.streams)
    )


def _carried_anew(stream: Stream, timeline: Timeline, links: InertialLink, after_ns: int, until_ns: int) -> Stream:
    """Return a stream with its measurements after one stamp until another carried from their states by other links."""
    zero, carry = gtsam.imuBias.ConstantBias(), list(stream.carry)
    gyro, felt = np.array(stream.gyro_radps), np.array(stream.felt)
    for i, (m, carried) in enumerate(zip(stream.measurements, carry, strict=True)):
        if after_ns < m.stamp_ns <= until_ns:
            stamps_ns = np.array([m.stamp_ns])
            gyro[i] = links.gyro_at(stamps_ns)[0]
            if asks_for_delay(stream.constants):
                felt[i] = links.felt_at(stamps_ns)[0]
            if carried is not None:
                at_ns = int(timeline.stamps_ns[carried[0]])
                carry[i] = carried[0], links.integrate(at_ns, m.stamp_ns, zero)
    return replace(stream, carry=tuple(carry), gyro_radps=gyro, felt=felt)


def with_links(problem: Problem, preintegrated: tuple[Any, ...]) -> Problem:
    """Return the problem with other preintegrated motions from each state to the next, and with their factors."""
    inertial = inertial_factors(problem.timeline, problem.links, preintegrated)
    return replace(problem, preintegrated=preintegrated, inertial=inertial)


def bridged(problem: Problem, values: gtsam.Values) -> Problem:
    """Return the problem with new links across IMU gaps: the vessel moves on there as before, by `values`."""
    return _bridged(problem, values, problem.links.gaps())


def _bridged(problem: Problem, values: gtsam.Values, gaps: Sequence[tuple[int, int]]) -> Problem:
    timeline, zero = problem.timeline, gtsam.imuBias.ConstantBias()
    preintegrated, inertial = list(problem.preintegrated), list(problem.inertial)
    for start_ns, stop_ns in gaps:
        first = timeline.floor(start_ns)
        bias = values.atConstantBias(keys.bias(int(timeline.slow_of[first])))
        going = GapMotion.of(nav_state(values, first), bias)
        for k in range(first, min(timeline.floor(stop_ns - 1) + 1, len(timeline) - 1)):
            a, b = (int(stamp) for stamp in timeline.stamps_ns[k : k + 2])
            preintegrated[k] = problem.links.integrate(a, b, zero, going)
            inertial[k] = problem.links.factor(k, int(timeline.slow_of[k]), preintegrated[k])
    return replace(problem, preintegrated=tuple(preintegrated), inertial=tuple(inertial))


def with_usual_motion(problem: Problem, values: gtsam.Values) -> Problem:
    """Return the problem with the motion model where no sensor measures position or velocity for long.

    The model is learned from `values`.
    """
    aided = sorted(m.stamp_ns for stream in problem.streams if stream.row.company for m in stream.measurements)
    found = usual_motion(problem.timeline, values, np.array(aided, dtype=np.int64), problem.links.gaps())
    return replace(problem, usual_motion=found)
