# SPDX-License-Identifier: Apache-2.0
"""What does not change while solving: timeline, preintegrated motion, and where each measurement attaches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build._attach import Carry, nav_state, state_of
from graphloc.build._chains import without_drift
from graphloc.config import SensorConfig, VesselConfig
from graphloc.errors import SolveError
from graphloc.frames import Array, Datum
from graphloc.graph import Constant, Going, InertialLink, InertialRow, Sensor, SlowProcess
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import ImuSeries, Measurement
from graphloc.position_jumps import allowed_jump_m, position_jumps
from graphloc.recording import Recording
from graphloc.time import utc_text
from graphloc.timeline import Timeline, make_timeline

PositionJumps = tuple[NDArray[np.int64], Array]
_NO_JUMPS: PositionJumps = np.zeros(0, dtype=np.int64), np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The measurements of one sensor and where they attach.

    Attributes:
        number: of the sensor, for keys. name, row, config: the sensor.
        slow: its slow state, or None. left_out: the slow state that it would have beside a second position sensor.
        position_jumps: stamps (K,) and sizes (K,), m, of its position jumps, where it alone measures position.
        constants: that its measurements may share.
        mount: pose of the sensor from the IMU, body axes.
        measurements: M of them by stamp. state: (M,) the state of each (`state_of`). carry: for each, the preintegrated motion
            from the state before it; None where its stamp is that of a state.
        gyro_radps: (M, 3) raw rate at each measurement, body axes.
        apart_s: (M,) time since the measurement before; inf for the first.
    """

    number: int
    name: str
    row: Sensor
    config: SensorConfig
    slow: SlowProcess | None
    left_out: SlowProcess | None
    position_jumps: PositionJumps
    constants: tuple[Constant, ...]
    mount: Any
    measurements: tuple[Measurement, ...]
    state: NDArray[np.int64]
    carry: tuple[Carry | None, ...]
    gyro_radps: Array
    apart_s: Array

    def between(self, first: int, last: int) -> range:
        """Indices of the measurements that attach to states first..last (inclusive)."""
        lo, hi = np.searchsorted(self.state, [first, last + 1])
        return range(int(lo), int(hi))


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A run, ready to be solved.

    Attributes:
        t_body_imu_m, R_body_imu: (3,), (3, 3) mount of the IMU in body.
        relink: makes the inertial links for a configuration of the IMU and a noise scale. links: those of `noise_scale`.
        preintegrated, inertial: motion from each state to the next, and its factor; neither depends on the estimate, so all graphs
            share them.
        rejected: ledger rows of measurements that the graph cannot take.
        silent: clauses on why sensors have no measurement here.
    """

    config: VesselConfig
    datum: Datum
    timeline: Timeline
    imu: ImuSeries
    t_body_imu_m: Array
    R_body_imu: Array
    relink: Callable[[Any, float], InertialLink]
    links: InertialLink
    noise_scale: float
    preintegrated: tuple[Any, ...]
    inertial: tuple[Any, ...]
    streams: tuple[Stream, ...]
    rejected: tuple[LedgerRow, ...]
    warnings: tuple[str, ...] = field(default=())
    silent: str = ""


Mounts = Mapping[str, tuple[Array, Array]]  # by sensor, from /tf_static: t (3,), R (3, 3) in body


def mount_of(name: str, config: SensorConfig, mounts: Mounts) -> tuple[Array, Array]:
    """Return the mount of a sensor in body (t (3,), m; R (3, 3)): from /tf_static where configured so."""
    return mounts.get(name) or (config.mount.t_body_sensor_m, config.mount.R_body_sensor)


def company_of(config: VesselConfig, rows: Sequence[Sensor], seen: Container[str] | None = None) -> int:
    """Return how many sensors (of those in `seen`, if given) can separate each other's slow errors from motion."""
    able = (name for row in rows if row.company for name in config.of_kind(row.kind))
    return sum(seen is None or name in seen for name in able)


def slow_or_left_out(row: Sensor, config: SensorConfig, company: int) -> tuple[SlowProcess | None, SlowProcess | None]:
    """Return a sensor's slow state, and the one that is left out instead, as nothing could tell it from motion: one of them, or none.

    Args:
        company: how many sensors can separate each other's slow errors from motion.
    """
    slow = row.slow(config)
    return (None, slow) if slow is not None and slow.needs_company and company < 2 else (slow, None)


def make_problem(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    rows: Sequence[Sensor],
    inertial: InertialRow,
    company: int | None = None,
) -> Problem:
    """Lay out the timeline, preintegrate, and attach every measurement.

    Args:
        company: how many sensors can separate each other's slow errors from motion; default: counted in the recording.

    Raises:
        SolveError: the recording has no usable IMU data.
    """
    imu = _usable_imu(recording, config, inertial.kind)
    imu_config = config.sensors[imu.sensor]
    t_body_imu, R = mount_of(imu.sensor, imu_config, recording.mounts)

    def relink(imu_config: Any, noise_scale: float) -> InertialLink:
        return inertial.link(imu, imu_config, R, datum.gravity_mps2, noise_scale)

    links = relink(imu_config, 1.0)
    by_kind = {row.kind: row for row in rows}
    inside, rejected, warnings = _sorted_out(recording, config, set(by_kind), imu)
    start, stop = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    timeline = make_timeline(start, stop, inside, config.timeline)
    by_sensor: dict[str, list[Measurement]] = {}
    for m in inside:
        by_sensor.setdefault(m.sensor, []).append(m)
    if company is None:
        company = company_of(config, rows, by_sensor)
    alone = sum(by_kind[config.sensors[name].kind].absolute for name in by_sensor) == 1
    streams = []
    for number, (name, sensor) in enumerate(config.sensors.items()):
        if name not in by_sensor:
            continue
        row, own = by_kind[sensor.kind], by_sensor[name]
        t, R_mount = mount_of(name, sensor, recording.mounts)
        slow, left_out, jumps = _slow_and_jumps(row, sensor, own, datum, company, alone=alone)
        state, carry = _states_and_carries(own, timeline, links)
        streams.append(
            Stream(
                number=number,
                name=name,
                row=row,
                config=sensor,
                slow=slow,
                left_out=left_out,
                position_jumps=jumps,
                constants=row.constants(sensor),
                mount=gtsam.Pose3(gtsam.Rot3(R_mount), t - t_body_imu),
                measurements=tuple(own),
                state=state,
                carry=carry,
                gyro_radps=links.gyro_at(np.array([m.stamp_ns for m in own])),
                apart_s=apart_s_of(own),
            )
        )
    preintegrated = _preintegrate(timeline, links)
    warnings += [f"IMU gap of {(b - a) / 1e9:.1f} s: bridged with unknown motion" for a, b in links.gaps()]
    return Problem(
        config=config,
        datum=datum,
        timeline=timeline,
        imu=imu,
        t_body_imu_m=t_body_imu,
        R_body_imu=R,
        relink=relink,
        links=links,
        noise_scale=1.0,
        preintegrated=preintegrated,
        inertial=_inertial(timeline, links, preintegrated),
        streams=tuple(streams),
        rejected=tuple(rejected),
        warnings=tuple(warnings),
        silent=_silent(recording, config, by_sensor, imu),
    )


def _usable_imu(recording: Recording, config: VesselConfig, kind: str) -> ImuSeries:
    if not any(sensor.kind == kind and sensor.enabled for sensor in config.sensors.values()):
        raise SolveError(
            f"{recording.source}: no enabled sensor of kind {kind} in vessel.yaml, and accelerations and rates (50 Hz or "
            "more) are what a track is made of: name their topic, or record them"
        )
    if recording.imu is None or len(recording.imu) < 10:
        lost = recording.lost(config.of_kind(kind))
        raise SolveError(
            f"{recording.source}: no IMU data (need at least 10 samples); check its topic and stamps{lost}"
        )
    return recording.imu


def _silent(recording: Recording, config: VesselConfig, heard: Container[str], imu: ImuSeries) -> str:
    """Return clauses on why the sensors that are not `heard` have no measurement within the IMU's span."""
    clauses, span = "", _span(imu)
    for name, sensor in config.sensors.items():
        if name in heard or not sensor.enabled or not sensor.topic or name == imu.sensor:
            continue
        stamps_ns = [m.stamp_ns for m in recording.measurements if m.sensor == name]
        if stamps_ns:
            clauses += (
                f"; {name} has {len(stamps_ns)} measurements from {utc_text(min(stamps_ns))} to "
                f"{utc_text(max(stamps_ns))}, all outside the IMU's span ({span})"
            )
        elif lost := recording.lost({name}):
            clauses += f"; {name}{lost.replace(';', ':', 1)}"
    return clauses


def _span(imu: ImuSeries) -> str:
    return f"{utc_text(int(imu.stamps_ns[0]))} to {utc_text(int(imu.stamps_ns[-1]))}"


def _sorted_out(
    recording: Recording, config: VesselConfig, kinds: Container[str], imu: ImuSeries
) -> tuple[list[Measurement], list[LedgerRow], list[str]]:
    """Return the measurements that the graph can take, rows for the others, and warnings."""
    start, stop = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    asked_for = {name for name, sensor in config.sensors.items() if sensor.kind in kinds and sensor.enabled}
    inside, rows = [], []
    outside, every = Counter[str](), Counter[str]()
    for m in recording.measurements:
        every[m.sensor] += 1
        outcome, reason = Outcome.REJECTED, "no IMU data at this stamp"
        if m.sensor not in asked_for:
            outcome, reason = Outcome.IGNORED, "its sensor is switched off or not in the configuration"
        elif start <= m.stamp_ns <= stop:
            inside.append(m)
            continue
        else:
            outside[m.sensor] += 1
        if m.seq < 0:  # configuration, not a message
            outside[m.sensor] = 0
            continue
        topic = recording.topics.get(m.sensor, "")
        rows.append(
            LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic=topic, outcome=outcome, reason=reason)
        )
    span = _span(imu)
    warnings = [
        f"{name}: {n} of {every[name]} measurements lie outside the IMU's time span ({span}) and are not used"
        for name, n in outside.items()
        if n > 0.02 * every[name] and n > 5
    ]
    return inside, rows, warnings


def _preintegrate(timeline: Timeline, links: InertialLink) -> tuple[Any, ...]:
    zero = gtsam.imuBias.ConstantBias()
    stamps = [int(s) for s in timeline.stamps_ns]
    return tuple(links.integrate(a, b, zero) for a, b in pairwise(stamps))


def _inertial(timeline: Timeline, links: InertialLink, preintegrated: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(links.factor(k, int(timeline.slow_of[k]), pim) for k, pim in enumerate(preintegrated))


def with_noise_scale(problem: Problem, noise_scale: float) -> Problem:
    """Return the problem with the IMU's noise densities scaled."""
    return _relinked(problem, problem.config, noise_scale)


def with_imu_noise(problem: Problem, gyro: float, accel: float) -> Problem:
    """Return the problem with the configured noise densities of gyroscope and accelerometer so many times as large."""
    name = problem.imu.sensor
    noisier = noisier_imu(problem.config.sensors[name], gyro, accel)
    return _relinked(problem, problem.config.with_sensors({name: noisier}), problem.noise_scale)


def with_sensor_noise(problem: Problem, times: Mapping[str, Mapping[str, float]]) -> Problem:
    """Return the problem with sigmas of its sensors so many times as large; `times`: by sensor and key of its configuration."""
    config = problem.config.scaled(times)
    streams = tuple(replace(stream, config=config.sensors[stream.name]) for stream in problem.streams)
    return replace(problem, config=config, streams=streams)


def noisier_imu(sensor: Any, gyro: float, accel: float) -> Any:
    """Return the configuration of an IMU with noise densities so many times as large."""
    return sensor.scaled({"gyro_noise_mdps_per_sqrt_hz": gyro, "accel_noise_ug_per_sqrt_hz": accel})


def _relinked(problem: Problem, config: VesselConfig, noise_scale: float) -> Problem:
    links = problem.relink(config.sensors[problem.imu.sensor], noise_scale)
    relinked = replace(problem, config=config, links=links, noise_scale=noise_scale)
    return with_links(relinked, _preintegrate(problem.timeline, links))


def with_links(problem: Problem, preintegrated: tuple[Any, ...]) -> Problem:
    """Return the problem with other preintegrated motions from each state to the next, and their factors."""
    inertial = _inertial(problem.timeline, problem.links, preintegrated)
    return replace(problem, preintegrated=preintegrated, inertial=inertial)


def bridged(problem: Problem, values: gtsam.Values) -> Problem:
    """Return the problem with new links across IMU gaps: the vessel continues there as it moved before, by `values`."""
    timeline, zero = problem.timeline, gtsam.imuBias.ConstantBias()
    preintegrated, inertial = list(problem.preintegrated), list(problem.inertial)
    for start_ns, stop_ns in problem.links.gaps():
        first = timeline.floor(start_ns)
        bias = values.atConstantBias(keys.bias(int(timeline.slow_of[first])))
        going = Going.of(nav_state(values, first), bias)
        for k in range(first, min(timeline.floor(stop_ns - 1) + 1, len(timeline) - 1)):
            a, b = (int(stamp) for stamp in timeline.stamps_ns[k : k + 2])
            preintegrated[k] = problem.links.integrate(a, b, zero, going)
            inertial[k] = problem.links.factor(k, int(timeline.slow_of[k]), preintegrated[k])
    return replace(problem, preintegrated=tuple(preintegrated), inertial=tuple(inertial))


def _slow_and_jumps(
    row: Sensor, config: SensorConfig, measurements: Sequence[Measurement], datum: Datum, company: int, *, alone: bool
) -> tuple[SlowProcess | None, SlowProcess | None, PositionJumps]:
    """Return `slow`, `left_out` and `position_jumps` of a `Stream`; `alone`: one sensor measures position."""
    slow, left_out = slow_or_left_out(row, config, company)
    jumps = _NO_JUMPS
    if alone and slow is None and row.absolute and row.false is None:
        jumps = _position_jumps(row, measurements, datum, allowed_jump_m(left_out))
    if left_out is not None and len(jumps[0]):
        slow, left_out = without_drift(left_out), None
    return slow, left_out, jumps


def _position_jumps(row: Sensor, measurements: Sequence[Measurement], datum: Datum, allowed_m: float) -> PositionJumps:
    """Return stamps and sizes of the position jumps of the only sensor that measures position."""
    hints = [(m.stamp_ns, row.hint(m, 0.0, datum)) for m in measurements]
    told = [(n, hint) for n, hint in hints if np.isfinite(hint.p_world_m[:2]).all()]
    stamps_ns = np.array([n for n, _ in told], dtype=np.int64)
    places_m = np.array([hint.p_world_m[:2] for _, hint in told])
    sigma_m = np.array([hint.p_sigma_m[:2].max() for _, hint in told])
    return position_jumps(stamps_ns, places_m, sigma_m, allowed_m=allowed_m)


def apart_s_of(measurements: Sequence[Measurement]) -> Array:
    """Return the time since the measurement before, of M measurements (M,), s; inf for the first."""
    stamps_ns = [m.stamp_ns for m in measurements]
    return np.concatenate([[np.inf], np.diff(stamps_ns) * 1e-9])[: len(stamps_ns)]


def _states_and_carries(
    measurements: Sequence[Measurement], timeline: Timeline, links: InertialLink
) -> tuple[NDArray[np.int64], tuple[Carry | None, ...]]:
    """Return `state` and `carry` of a `Stream`."""
    zero = gtsam.imuBias.ConstantBias()
    state, carry, holes = [], [], links.gaps()
    for m in measurements:
        floor = timeline.floor(m.stamp_ns)
        state.append(state_of(m, floor, timeline.nearest(m.stamp_ns), timeline.stamps_ns, holes))
        at = int(timeline.stamps_ns[floor])
        carry.append(None if m.stamp_ns <= at else (floor, links.integrate(at, m.stamp_ns, zero)))
    return np.array(state, dtype=np.int64), tuple(carry)
