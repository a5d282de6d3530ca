# SPDX-License-Identifier: Apache-2.0
"""Attachment of a measurement to the states at the current estimate, offline and online."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build._chains import walk_between_nodes
from graphloc.config import VesselConfig
from graphloc.frames import Array, Datum
from graphloc.graph import TIME_OFFSET, Attachment, Constant, FeltMotion, Sensor, SlowProcess
from graphloc.inertial import InertialLink
from graphloc.measurements import NO_HEIGHT_M2, Measurement

_NO_HEIGHT_M2 = np.array([0.0, 0.0, NO_HEIGHT_M2])  # variance that leaves the height of a fix without weight

Carry = tuple[int, Any]
"""Number of a state, and the motion preintegrated from it to a measurement."""


class OnTimeline(Protocol):
    """What `attach` needs to know of a timeline (`Timeline`, or a live one)."""

    @property
    def slow_of(self) -> Any:
        """Slow node of each state."""

    @property
    def slow_stamps_ns(self) -> Any:
        """Stamp of each slow node."""


class Sited(Protocol):
    """What `attach` needs to know of a problem."""

    @property
    def timeline(self) -> OnTimeline:
        """Stamps of the states."""

    @property
    def R_body_imu(self) -> Array:
        """Rotation (3, 3) from the IMU's axes to the body's."""

    @property
    def datum(self) -> Datum:
        """Origin of world."""

    @property
    def links(self) -> InertialLink:
        """Preintegration of the IMU."""

    @property
    def config(self) -> VesselConfig:
        """The vessel."""


class Estimates(Protocol):
    """What `attach` needs to know of the values of states (`gtsam.Values`, or those of a window)."""

    def exists(self, j: int, /) -> bool:
        """Return whether a key has a value."""

    def atPose3(self, j: int, /) -> Any:
        """Return a pose."""

    def atVector(self, j: int, /) -> Any:
        """Return a vector."""

    def atConstantBias(self, j: int, /) -> Any:
        """Return a bias of the IMU."""


class Attaching(Protocol):
    """What `attach` needs to know of a stream (`Stream`, or a live one)."""

    @property
    def number(self) -> int:
        """Number of the sensor, for keys."""

    @property
    def mount(self) -> Any:
        """Pose of the sensor seen from the IMU, body axes (gtsam.Pose3)."""

    @property
    def slow(self) -> SlowProcess | None:
        """Slow state of the sensor."""

    @property
    def without_height(self) -> bool:
        """Whether the heights of the sensor's fixes are not used."""

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Constants that the sensor's measurements may share."""

    @property
    def shares(self) -> int | None:
        """Number of the sensor whose constants these are; None: they are the sensor's own."""

    @property
    def measurements(self) -> Any:
        """Measurements, by index."""

    @property
    def state(self) -> Any:
        """State of each measurement."""

    @property
    def carry(self) -> Any:
        """Motion from the state before each measurement to it (`Carry`), or None."""

    @property
    def gyro_radps(self) -> Any:
        """Raw angular rate at each measurement, rad/s, body axes."""

    @property
    def felt(self) -> Any:
        """Raw specific force and change of the rate about each measurement (6,), m/s^2 and rad/s^2, body axes."""

    @property
    def apart_s(self) -> Any:
        """Usual time between measurements at each of them, s (`spacing_s`)."""


class Judged(Attaching, Protocol):
    """What judging needs to know of a stream."""

    @property
    def name(self) -> str:
        """Name of the sensor."""

    @property
    def row(self) -> Sensor:
        """Row of the sensor in the table."""

    @property
    def config(self) -> Any:
        """Configuration of the sensor."""


def nav_state(values: Estimates, k: int) -> Any:
    """Return the NavState of state k."""
    return gtsam.NavState(values.atPose3(keys.pose(k)), values.atVector(keys.velocity(k)))


def state_of(m: Measurement, floor: int, nearest: int, stamps_ns: Any, holes: Sequence[tuple[int, int]]) -> int:
    """Return the state that a measurement attaches to: the nearest, or the one before where an IMU gap is in between.

    The measurement is propagated from the state before it. Across a gap the motion to the nearest state is uncertain;
    written as a factor of that state, the measurement would count as new information each time it is linearised.

    Args:
        floor, nearest: the state before the measurement, and the nearest one. stamps_ns: of the states, by number.
        holes: gaps of the IMU (start, stop), ns.
    """
    start_ns, stop_ns = int(stamps_ns[floor]), int(stamps_ns[nearest])
    in_hole = nearest != floor and m.stamp_ns > start_ns and any(a < stop_ns and b > start_ns for a, b in holes)
    return floor if in_hole else nearest


def attach(problem: Sited, stream: Attaching, i: int, values: Estimates) -> Attachment:
    """Return the attachment of measurement `i` of a stream at the current estimate."""
    k = int(stream.state[i])
    j = int(problem.timeline.slow_of[k])
    T = values.atPose3(keys.pose(k))
    v = values.atVector(keys.velocity(k))
    bias = values.atConstantBias(keys.bias(j))
    T_state_sensor, carried_m, dv, carried_to = stream.mount, np.zeros(3), np.zeros(3), None
    carried = stream.carry[i]
    if carried is not None:
        floor, pim = carried
        there = pim.predict(gtsam.NavState(T, v) if floor == k else nav_state(values, floor), bias)
        carried_to = T.between(there.pose())
        T_state_sensor = gtsam.Pose3(carried_to.rotation(), np.zeros(3)).compose(stream.mount)
        carried_m = np.asarray(there.position()) - T.translation()
        dv = np.asarray(there.velocity()) - v
    slow_key = None if stream.slow is None else keys.slow(stream.number, j)
    return Attachment(
        pose_key=keys.pose(k),
        velocity_key=keys.velocity(k),
        slow_key=slow_key,
        leaf_keys=keys.leaves(stream.number, i),
        T_world_body=T,
        v_world_mps=v,
        T_state_sensor=T_state_sensor,
        carried_m=carried_m,
        dv_world_mps=dv,
        gyro_radps=stream.gyro_radps[i] - problem.R_body_imu @ bias.gyroscope(),
        lever_m=np.asarray(stream.mount.translation()),
        slow_value=None if slow_key is None else values.atVector(slow_key),
        datum=problem.datum,
        slow_next=None if slow_key is None else _next_slow(problem, stream, j, stream.measurements[i].stamp_ns, values),
        slow_age_s=max(int(stream.measurements[i].stamp_ns) - int(problem.timeline.slow_stamps_ns[j]), 0) * 1e-9,
        slow_walk=_slow_walk(problem, stream, i),
        constants=constants_of(stream, values),
        own=tuple(constant.own for constant in stream.constants),
        felt=_felt(problem, stream.felt[i], carried_to, bias) if asks_for_delay(stream.constants) else None,
    )


def asks_for_delay(constants: Sequence[Constant]) -> bool:
    """Return whether the delay of a sensor's stamps is one of its constants.

    Only then is it computed what the IMU feels at its measurements (0.2 ms each).
    """
    return any(TIME_OFFSET in constant.corrects for constant in constants)


def _felt(problem: Sited, raw: Array, carried_to: Any, bias: Any) -> FeltMotion:
    """Return what the IMU feels at a measurement, in the axes of the body at its state.

    Args:
        raw: (6,) as of `Attaching.felt`.
        carried_to: the body at the measurement, seen from that at the state (gtsam.Pose3); None: it is the same.
    """
    turn = np.eye(3) if carried_to is None else carried_to.rotation().matrix()
    force = raw[:3] - problem.R_body_imu @ bias.accelerometer()
    return FeltMotion(turn @ force, turn @ raw[3:], problem.links.gravity_mps2)


def _slow_walk(problem: Sited, stream: Attaching, i: int) -> Array | None:
    walk = None
    if stream.slow is not None:
        walk = walk_between_nodes(stream.slow, problem.config.timeline.slow_period_s, stream.apart_s[i])
    if stream.without_height:
        return _NO_HEIGHT_M2 if walk is None else walk + _NO_HEIGHT_M2
    return walk


def _next_slow(
    problem: Sited, stream: Attaching, j: int, stamp_ns: int, values: Estimates
) -> tuple[int, Array, float, float] | None:
    stamps, key = problem.timeline.slow_stamps_ns, keys.slow(stream.number, j + 1)
    if j + 1 >= len(stamps) or not values.exists(key):
        return None
    apart = int(stamps[j + 1] - stamps[j])
    share = min(max((stamp_ns - int(stamps[j])) / apart, 0.0), 1.0)
    return key, values.atVector(key), share, apart * 1e-9


def constants_of(stream: Attaching, values: Estimates) -> tuple[tuple[int, Array], ...]:
    """Return keys and estimates of a sensor's constants; an estimate is zero where no factor has the constant yet."""
    if not stream.constants:
        return ()
    return tuple(
        (key, values.atVector(key) if values.exists(key) else np.zeros(len(constant.sigma)))
        for key, constant in zip(constant_keys(stream), stream.constants, strict=True)
    )


def solved_constants(stream: Attaching, values: gtsam.Values) -> Iterator[tuple[Constant, Array]]:
    """Yield those constants of a sensor that a factor has, and their values (k,)."""
    for key, constant in zip(constant_keys(stream), stream.constants, strict=True):
        if values.exists(key):
            yield constant, values.atVector(key)


def constant_keys(stream: Attaching) -> list[int]:
    """Return the keys of a sensor's constants."""
    number = stream.number if stream.shares is None else stream.shares
    return [keys.constant(number, k) for k in range(len(stream.constants))]


def every_constant(streams: Iterable[Attaching]) -> list[int]:
    """Return the keys of the constants of some sensors; a key that several share is there once."""
    return list(dict.fromkeys(key for stream in streams for key in constant_keys(stream)))
