# SPDX-License-Identifier: Apache-2.0
"""The start: wait until place and heading can be told, then solve what has come as the batch would, and go on from there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphloc import keys, origin
from graphloc.build import Problem, constant_keys, make_problem
from graphloc.config import VesselConfig
from graphloc.errors import GraphlocError, SolveError
from graphloc.frames import Array, Datum
from graphloc.graph import Hint, InertialRow, Sensor
from graphloc.ledger import LedgerRow
from graphloc.measurements import GnssPosition, ImuSeries, Measurement
from graphloc.online._anchor import Anchor, beside
from graphloc.recording import Recording
from graphloc.solve._align import MOVED_M
from graphloc.solve._batch import solve_batch
from graphloc.solve._solution import AGREES, row_of

_LEAST_S = 5.0  # of inertial data: gyro bias, roll and pitch of a vessel in waves
_FIXES = 3  # to take a datum from


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Started:
    """What the start hands over.

    Attributes:
        datum: origin of world. anchor: the newest state. rows: of the measurements that took part.
        agreed_ns: stamp of the newest of each absolute sensor that agrees.
        heights_m: of each sensor that the configuration makes itself, what it says.
        notes: what the alignment went by.
    """

    datum: Datum
    anchor: Anchor
    rows: tuple[LedgerRow, ...]
    agreed_ns: Mapping[str, int]
    heights_m: Mapping[str, float]
    notes: tuple[str, ...]


def company_of(config: VesselConfig, rows: Sequence[Sensor]) -> int:
    """Return how many sensors of a configuration can tell each other's slow errors from motion."""
    return sum(len(config.of_kind(row.kind)) for row in rows if row.company)


def try_start(
    config: VesselConfig,
    rows: Sequence[Sensor],
    inertial: InertialRow,
    mounts: Mapping[str, tuple[Array, Array]],
    imu: ImuSeries,
    measurements: Sequence[Measurement],
    datum: Datum | None,
) -> Started | str:
    """Return the start, or what it waits for."""
    span_s = float(imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9 if len(imu) else 0.0
    if span_s < _LEAST_S:
        return f"{_LEAST_S:g} s of IMU data"
    recording = Recording(
        source="(online)",
        imu=imu,
        measurements=tuple(sorted(measurements, key=lambda m: (m.stamp_ns, m.seq))),
        mounts=mounts,
        topics={name: sensor.topic for name, sensor in config.sensors.items()},
    )
    fixes = sum(isinstance(m, GnssPosition) for m in measurements)
    if datum is None and config.datum is None and fixes < _FIXES:
        return f"{_FIXES} GNSS fixes, for an origin of world: no `datum:` is configured"
    try:
        datum = datum or origin.choose_datum(recording, config, rows)
    except GraphlocError as error:
        return str(error)
    if missing := _missing(config, rows, recording, datum):
        return missing
    try:
        return _solved(config, rows, inertial, recording, datum)
    except SolveError as error:
        return f"a start that can be solved: {error}"


def _missing(config: VesselConfig, rows: Sequence[Sensor], recording: Recording, datum: Datum) -> str:
    """What place or heading still wants; empty where both can be told."""
    by_kind = {row.kind: row for row in rows}
    hints: list[Hint] = []
    for m in recording.measurements:
        sensor = config.sensors[m.sensor]
        R = recording.mounts[m.sensor][1] if m.sensor in recording.mounts else sensor.mount.R_body_sensor
        hints.append(by_kind[sensor.kind].hint(m, float(np.arctan2(R[1, 0], R[0, 0])), datum))
    places = [h for h in hints if np.isfinite(h.p_world_m[:2]).all()]
    if not places:
        return "a place: a fix, a match, a tag or a pose"
    if config.start.heading_deg is not None or any(np.isfinite(h.yaw_rad) for h in hints):
        return ""
    p = np.array([h.p_world_m[:2] for h in places])
    noise_m = 5.0 * float(np.nanmedian([h.p_sigma_m[:2] for h in places]))
    wanted_m = max(MOVED_M, noise_m)
    if np.hypot(*(p - np.median(p[:5], axis=0)).T).max() > wanted_m:
        return ""
    return f"a heading: from a sensor, from `start.heading_deg`, or from {wanted_m:.0f} m of way"


def _solved(
    config: VesselConfig, rows: Sequence[Sensor], inertial: InertialRow, recording: Recording, datum: Datum
) -> Started:
    whole = origin.with_synthetic(recording, config, datum, rows)
    problem = make_problem(whole, config, datum, rows, inertial, company_of(config, rows))
    result = solve_batch(problem)
    last = len(problem.timeline) - 1
    agreed: dict[str, int] = {}
    found = []
    for stream in problem.streams:
        for i, m in enumerate(stream.measurements):
            verdict = result.verdicts[(stream.number, i)]
            if verdict.weight >= AGREES:
                agreed[stream.name] = m.stamp_ns
            if m.seq >= 0:
                found.append(row_of(stream, m, stream.config.topic, verdict))
    heights = {
        name: origin.height_m(recording, config, sensor.height_m, datum)
        for row in rows
        if row.synthetic is not None
        for name, sensor in config.of_kind(row.kind).items()
    }
    return Started(
        datum=datum,
        anchor=_anchor(problem, result.tree, result.values, last),
        rows=(*found, *(row for row in problem.rejected if row.seq >= 0)),
        agreed_ns=agreed,
        heights_m=heights,
        notes=result.notes,
    )


def _anchor(problem: Problem, tree: Any, values: gtsam.Values, k: int) -> Anchor:
    """What a solved stretch knows of its state `k`."""
    j = int(problem.timeline.slow_of[k])
    pose, velocity, bias = keys.pose(k), keys.velocity(k), keys.bias(j)

    def joint(*names: int) -> Array:
        return np.asarray(tree.jointMarginalCovariance(list(names)).fullMatrix())

    def vector(key: int) -> Array:
        return np.atleast_1d(values.atVector(key))

    held = values.atConstantBias(bias)
    slow = {s.name: keys.slow(s.number, j) for s in problem.streams if s.slow is not None}
    constants = {
        (s.name, n): key for s in problem.streams for n, key in enumerate(constant_keys(s)) if values.exists(key)
    }
    return Anchor(
        stamp_ns=int(problem.timeline.stamps_ns[k]),
        pose=values.atPose3(pose),
        velocity=vector(velocity),
        bias=np.concatenate([held.accelerometer(), held.gyroscope()]),
        cov=joint(pose, velocity, bias),
        slow={name: beside(vector(key), joint(pose, key)) for name, key in slow.items()},
        constants={name: beside(vector(key), joint(pose, key)) for name, key in constants.items()},
    )
