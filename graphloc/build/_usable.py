# SPDX-License-Identifier: Apache-2.0
"""Which measurements of a recording a graph can take, and what is said of the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container

from graphloc.config import VesselConfig
from graphloc.errors import SolveError
from graphloc.ledger import NOT_ASKED_FOR, LedgerRow, Outcome
from graphloc.measurements import ImuSeries, Measurement
from graphloc.recording import Recording
from graphloc.time import utc_text


def usable_imu(recording: Recording, config: VesselConfig, kind: str) -> ImuSeries:
    """Return the samples of the IMU.

    Args:
        kind: of the IMU, in the configuration.

    Raises:
        SolveError: no sensor of this kind is enabled, or it has too few samples.
    """
    if not any(sensor.kind == kind and sensor.enabled for sensor in config.sensors.values()):
        raise SolveError(
            f"{recording.source}: no enabled sensor of kind {kind} in vessel.yaml, and accelerations and rates (50 Hz or "
            "more) are what a track is computed from: name their topic, or record them"
        )
    if recording.imu is None or len(recording.imu) < 10:
        lost = recording.lost(config.of_kind(kind))
        raise SolveError(
            f"{recording.source}: no IMU data (need at least 10 samples); check its topic and stamps{lost}"
        )
    return recording.imu


def silent_sensors(recording: Recording, config: VesselConfig, heard: Container[str], imu: ImuSeries) -> str:
    """Return clauses for errors: why enabled sensors have no measurement within the IMU's span.

    Args:
        heard: names of the sensors that have some.
    """
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


def sorted_out(
    recording: Recording, config: VesselConfig, kinds: Container[str], imu: ImuSeries
) -> tuple[list[Measurement], list[LedgerRow], list[str]]:
    """Return the measurements that the graph can take, ledger rows of the others, and warnings.

    Args:
        kinds: of the sensors that the graph takes measurements of. imu: what is outside its span is not taken.
    """
    start, stop = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    asked_for = {name for name, sensor in config.sensors.items() if sensor.kind in kinds and sensor.enabled}
    inside, rows = [], []
    outside, every = Counter[str](), Counter[str]()
    for m in recording.measurements:
        every[m.sensor] += 1
        outcome, reason = Outcome.REJECTED, "no IMU data at this stamp"
        if m.sensor not in asked_for:
            outcome, reason = Outcome.IGNORED, NOT_ASKED_FOR
        elif start <= m.stamp_ns <= stop:
            inside.append(m)
            continue
        else:
            outside[m.sensor] += 1
        if m.seq < 0:  # made of the configuration, not a message
            outside[m.sensor] = 0
            continue
        rows.append(recording.row_of(m, outcome, reason))
    span = _span(imu)
    warnings = [
        f"{name}: {n} of {every[name]} measurements lie outside the IMU's time span ({span}) and are not used"
        for name, n in outside.items()
        if n > 0.02 * every[name] and n > 5
    ]
    return inside, rows, warnings
