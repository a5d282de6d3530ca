# SPDX-License-Identifier: Apache-2.0
"""From a recording to a problem: states are laid out in time, and each measurement attached to one."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc.build._attach import Carry, asks_for_delay, state_of
from graphloc.build._chains import allowed_jump_m, silent_s, spacing_s, without_drift
from graphloc.build._problem import PositionJumps, Problem, Stream, inertial_factors, preintegrate
from graphloc.build._usable import silent_sensors, sorted_out, usable_imu
from graphloc.config import SensorConfig, VesselConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.graph import PLACE, Constant, Sensor, SlowProcess
from graphloc.inertial import InertialLink, InertialRow
from graphloc.measurements import Measurement
from graphloc.recording import Mounts, Recording
from graphloc.signals.heading_steps import HeadingStep, heading_steps
from graphloc.signals.pauses import common_pauses, pauses_warning
from graphloc.signals.position_jumps import position_jumps
from graphloc.signals.series import integral
from graphloc.time import NS_PER_S, stamps_of, utc_text
from graphloc.timeline import Timeline, make_timeline

_NO_JUMPS: PositionJumps = np.zeros(0, dtype=np.int64), np.zeros(0)


def mount_of(name: str, config: SensorConfig, mounts: Mounts) -> tuple[Array, Array]:
    """Return the mount of a sensor in body: t (3,), m, and R (3, 3).

    Args:
        mounts: mounts read from /tf_static, by sensor.

    Raises:
        InputError: the mount is configured as a frame of /tf_static, and is not in `mounts`.
    """
    if config.mount.tf_frame and name not in mounts:
        raise InputError(
            f"sensors.{name}.mount.tf_frame: no /tf_static is read here: give xyz_m and rpy_deg, or take the vessel.effective.yaml that "
            "`graphloc smooth` writes beside its results, where mounts are in numbers; a program may give them in `mounts`"
        )
    return mounts.get(name) or (config.mount.t_body_sensor_m, config.mount.R_body_sensor)


_OF_AN_ANTENNA = {"mount", "mount_sigma_m"}
_OF_THE_RECEIVER = _OF_AN_ANTENNA | {"stamps", "time_offset_s", "clock_drift_ppm", "stamp_sigma_s"}


def shared_constants(
    name: str, config: VesselConfig, rows: Mapping[str, Sensor]
) -> tuple[tuple[Constant, ...], int | None]:
    """Return the constants of a sensor, and the number of the sensor whose constants they are; None: they are its own.

    Sensors that read one receiver by turns have one antenna and one clock. A sensor of that antenna's velocity shares
    the antenna, but has a delay of its own besides: a receiver may filter velocities, or send them later. Whatever a
    group of sensors shares is one constant, as a linear factor of more than three states takes longer to make.

    Args:
        rows: of all enabled sensors, by name.
    """
    first, own = config.antenna_of(name), rows[name].constants(config.sensors[name])
    sharing = [n for n in rows if n != first and config.antenna_of(n) == first and _alike(n, first, config)]
    if name not in (first, *sharing) or not sharing:
        return own, None
    (whole,) = rows[first].constants(config.sensors[first])
    sigma, corrects, held = [*whole.sigma], [*whole.corrects], {first: tuple(range(len(whole.sigma)))}
    for other in sharing:
        (constant,) = rows[other].constants(config.sensors[other])
        here = list[int]()
        for key, size in zip(constant.corrects, constant.sigma, strict=True):
            if config.receiver_of(other) != first and key not in PLACE:
                sigma.append(size)
                corrects.append(key)
                here.append(len(sigma) - 1)
            else:
                here.append(whole.corrects.index(key))
        held[other] = tuple(here)
    number = list(config.sensors).index(first) if name != first else None
    of_another = 0 if number is None else len(whole.sigma)
    shared = replace(whole, sigma=np.array(sigma), corrects=tuple(corrects), own=held[name], of_another=of_another)
    return (shared,), number


def _alike(name: str, first: str, config: VesselConfig) -> bool:
    """Return whether a sensor is set like the first one of its antenna, and something that they share is unknown."""
    keys = _OF_THE_RECEIVER if config.receiver_of(name) == first else _OF_AN_ANTENNA
    block, other = (config.sensors[of].model_dump(include=keys) for of in (name, first))
    unknown = config.sensors[first].mount_sigma_m > 0.0 or (
        keys is _OF_THE_RECEIVER and config.sensors[first].stamp_sigma_s > 0.0
    )
    return bool(block == other and unknown)


def rows_of(config: VesselConfig, rows: Sequence[Sensor]) -> dict[str, Sensor]:
    """Return the row of each enabled sensor as it is configured, by name."""
    return {name: row.of(block) for row in rows for name, block in config.of_kind(row.kind).items()}


def company_of(config: VesselConfig, rows: Sequence[Sensor], seen: Container[str] | None = None) -> int:
    """Return the number of sensors that can separate each other's slow errors from motion.

    Args:
        seen: names of the sensors that count; None: all that are enabled.
    """
    return sum(row.company and (seen is None or name in seen) for name, row in rows_of(config, rows).items())


def slow_or_left_out(row: Sensor, config: SensorConfig, company: int) -> tuple[SlowProcess | None, SlowProcess | None]:
    """Return a sensor's slow state, and the slow state that is left out because nothing could tell it from motion.

    One of them is None, or both.

    Args:
        company: number of sensors that can separate each other's slow errors from motion.
    """
    slow = row.slow(config)
    return (None, slow) if slow is not None and slow.needs_company and company < 2 else (slow, None)


def height_told_better(config: VesselConfig, rows: Sequence[Sensor], left_out: SlowProcess | None) -> bool:
    """Return whether a known height (a waterline) is better known than by fixes whose slow error is left out.

    Then the heights of these fixes are not used: hundreds of them would outvote the known height, as if their errors
    were white.

    Args:
        left_out: the slow error (east, north, up) of the fixes that is left out; None: none is.
    """
    known_m = [
        math.hypot(block.sigma_m, block.offset_sigma_m) for row in rows if row.synthetic is not None
        for block in config.of_kind(row.kind).values() if block.height_m is not None
    ]  # fmt: skip
    return left_out is not None and any(sigma_m < left_out.sigma[2] for sigma_m in known_m)


def _gap_warning(gaps: Sequence[tuple[int, int]]) -> list[str]:
    """Return a warning on the gaps of the IMU, (start, stop) in ns: one line, as a bad radio link makes dozens."""
    if not gaps:
        return []
    longest_s, first = max(b - a for a, b in gaps) / 1e9, utc_text(gaps[0][0])
    which = f"IMU gap of {longest_s:.1f} s at {first}"
    if len(gaps) > 1:
        which = f"{len(gaps)} IMU gaps of up to {longest_s:.1f} s, the first at {first}"
    return [f"{which}: bridged with unknown motion"]


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
        recording: what was measured. config: the vessel. datum: origin of world.
        rows, inertial: the table of sensors (`graphloc.factors`).
        company: number of sensors that can separate each other's slow errors from motion; by default as in the
            recording.

    Raises:
        SolveError: the recording has no usable IMU data.
    """
    imu = usable_imu(recording, config, inertial.kind)
    t_body_imu, R = mount_of(imu.sensor, config.sensors[imu.sensor], recording.mounts)

    inside, rejected, warnings = sorted_out(recording, config, {row.kind for row in rows}, imu)
    by_sensor: dict[str, list[Measurement]] = {}
    for m in inside:
        by_sensor.setdefault(m.sensor, []).append(m)
    came = ([m for m in own if m.seq >= 0] for own in by_sensor.values())
    pauses = common_pauses(imu.stamps_ns, (stamps_of(own) for own in came))

    def relink(imu_config: Any, noise_scale: float, R_body_imu: Array) -> InertialLink:
        links = inertial.link(imu, imu_config, R_body_imu, datum.gravity_mps2, noise_scale)
        for pause in pauses:
            links.pause(*pause)
        return links

    links = relink(config.sensors[imu.sensor], 1.0, R)
    warnings += _gap_warning([gap for gap in links.gaps() if gap not in pauses])
    warnings += [said for said in [pauses_warning(pauses)] if said]
    timeline = make_timeline(int(imu.stamps_ns[0]), int(imu.stamps_ns[-1]), inside, config.timeline)
    preintegrated = preintegrate(timeline, links)
    problem = Problem(
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
        inertial=inertial_factors(timeline, links, preintegrated),
        streams=(),
        rejected=tuple(rejected),
        warnings=tuple(warnings),
        silent=silent_sensors(recording, config, by_sensor, imu),
    )
    company = company_of(config, rows, by_sensor) if company is None else company
    return replace(problem, streams=_streams(problem, rows, by_sensor, recording.mounts, company))


def _streams(
    problem: Problem,
    rows: Sequence[Sensor],
    by_sensor: Mapping[str, Sequence[Measurement]],
    mounts: Mounts,
    company: int,
) -> tuple[Stream, ...]:
    """Return the streams of the sensors that have measurements, attached to the states of a problem without streams.

    Args:
        company: as of `make_problem`.
    """
    by_name = rows_of(problem.config, rows)
    absolute = [name for name in by_sensor if by_name[name].absolute]
    alone = len({problem.config.receiver_of(name) for name in absolute}) == 1
    found = []
    for number, (name, config) in enumerate(problem.config.sensors.items()):
        if name not in by_sensor:
            continue
        row, own = by_name[name], by_sensor[name]
        t, R = mount_of(name, config, mounts)
        slow, left_out = slow_or_left_out(row, config, company)
        by_waterline = height_told_better(problem.config, rows, left_out)
        slow, left_out, jumps = _with_jumps(row, config, own, problem.datum, slow, left_out, alone=alone)
        state, carry = _states_and_carries(own, problem.timeline, problem.links)
        (constants, shares), stamps_ns = shared_constants(name, problem.config, by_name), stamps_of(own)
        found.append(
            Stream(
                number=number,
                name=name,
                row=row,
                config=config,
                slow=slow,
                left_out=left_out,
                without_height=by_waterline,
                position_jumps=jumps,
                heading_steps=_heading_steps(problem, row, own, slow),
                constants=constants,
                shares=shares,
                mount=gtsam.Pose3(gtsam.Rot3(R), t - problem.t_body_imu_m),
                measurements=tuple(own),
                state=state,
                carry=carry,
                gyro_radps=problem.links.gyro_at(stamps_ns),
                felt=problem.links.felt_at(stamps_ns) if asks_for_delay(constants) else np.zeros((len(own), 6)),
                apart_s=spacing_s(stamps_ns),
                anew=_drawn_anew(slow, np.diff(stamps_ns) / NS_PER_S, problem.timeline.slow_of[state]),
            )
        )
    return tuple(found)


def _with_jumps(
    row: Sensor,
    config: SensorConfig,
    measurements: Sequence[Measurement],
    datum: Datum,
    slow: SlowProcess | None,
    left_out: SlowProcess | None,
    *,
    alone: bool,
) -> tuple[SlowProcess | None, SlowProcess | None, PositionJumps]:
    """Return `slow`, `left_out` and `position_jumps` of a `Stream`.

    Args:
        slow, left_out: as they are without position jumps. alone: whether a single receiver measures position.
    """
    jumps = _NO_JUMPS
    # Sensors that read one receiver by turns (with and without RTK) have slow errors that are told apart, but none of
    # these sensors holds the place while another one jumps.
    if alone and (slow is None or config.takes_turns) and row.absolute and not row.has_hypotheses:
        jumps = _position_jumps(row, measurements, datum, allowed_jump_m(left_out or slow))
    if left_out is not None and len(jumps[0]):
        slow, left_out = without_drift(left_out), None
    return slow, left_out, jumps


def _drawn_anew(slow: SlowProcess | None, apart_s: Array, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return `anew` of a `Stream`: the slow nodes of the last measurements before a long silence of the sensor.

    Args:
        apart_s: (M - 1,) between measurements. nodes: (M,) slow node of each measurement.
    """
    if slow is None or len(apart_s) == 0:
        return np.zeros(0, dtype=np.int64)
    silent = apart_s > silent_s(slow, float(np.median(apart_s)))
    return np.asarray(nodes[:-1][silent & (np.diff(nodes) > 0)])


def jumping(stream: Stream, stamps_ns: NDArray[np.int64], sizes_m: Array) -> Stream:
    """Return a stream with more position jumps (K,): stamps, ns, and sizes, m."""
    known_ns, known_m = stream.position_jumps
    at = np.searchsorted(known_ns, stamps_ns)
    jumps = np.insert(known_ns, at, stamps_ns), np.insert(known_m, at, sizes_m)
    if stream.left_out is None:
        return replace(stream, position_jumps=jumps)
    return replace(stream, position_jumps=jumps, slow=without_drift(stream.left_out), left_out=None)


def _position_jumps(row: Sensor, measurements: Sequence[Measurement], datum: Datum, allowed_m: float) -> PositionJumps:
    """Return stamps and sizes of the position jumps of the only sensor that measures position."""
    hints = [(m.stamp_ns, row.hint(m, 0.0, datum)) for m in measurements]
    told = [(n, hint) for n, hint in hints if np.isfinite(hint.p_world_m[:2]).all()]
    stamps_ns = np.array([n for n, _ in told], dtype=np.int64)
    places_m = np.array([hint.p_world_m[:2] for _, hint in told])
    sigma_m = np.array([hint.p_sigma_m[:2].max() for _, hint in told])
    return position_jumps(stamps_ns, places_m, sigma_m, allowed_m=allowed_m)


def _heading_steps(
    problem: Problem, row: Sensor, measurements: Sequence[Measurement], slow: SlowProcess | None
) -> tuple[HeadingStep, ...]:
    """Return the steps of a compass's headings."""
    imu, stamps_ns = problem.imu, stamps_of(measurements)
    if slow is None or not slow.stepped or len(imu.stamps_ns) < 2:
        return ()
    hints = [row.hint(m, 0.0, problem.datum) for m in measurements]
    yaw_rad, sigma_rad = (
        np.array(column) for column in zip(*((h.yaw_rad, h.yaw_sigma_rad) for h in hints), strict=True)
    )
    origin_ns = imu.stamps_ns[0]
    t_s, at_s = ((stamps - origin_ns) / NS_PER_S for stamps in (imu.stamps_ns, stamps_ns))
    turned_rad = np.interp(at_s, t_s, integral(t_s, imu.gyro_radps @ problem.R_body_imu[2]))
    blind = np.zeros(max(len(stamps_ns) - 1, 0), dtype=bool)
    for begin_ns, end_ns in problem.links.gaps():
        blind |= (stamps_ns[:-1] < end_ns) & (stamps_ns[1:] > begin_ns)
    return tuple(heading_steps(stamps_ns, yaw_rad, turned_rad, sigma_rad, blind))


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
