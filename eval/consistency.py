# SPDX-License-Identifier: Apache-2.0
"""Consistency of a sensor with a solution that did not use it.

For each measurement z, in the solution without its sensor:

    r = h(x) - z,    S = R + J P J^T + K Q K^T + C B C^T

- R: stated covariance of z; for poses by tags it includes the errors of the survey.
- P: covariance of the pose by the solution; J = d r / d pose.
- Q: stationary covariance of the sensor's own slow error; K = d r / d slow.
- B: configured covariance of its constants (place of an antenna, delay of stamps); C = d r / d constants.

r^T S^-1 r is chi-square with dim r degrees of freedom if these covariances are honest. The measure is

    contradiction = sqrt(median of r^T S^-1 r / median of that chi-square)

in sigmas: 1 if all is well, below 1 if slow errors are smaller than they might be. The median is robust against false
measurements; for a sensor with a share f of false ones it is replaced by the quantile 0.5 (1 - f), the median of the
right ones. No significance is stated: successive residuals share slow errors, and all share those of constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphloc.build import mount_of
from graphloc.chi2 import chi2_median
from graphloc.config import VesselConfig
from graphloc.frames import Array
from graphloc.graph import Attachment, FeltMotion, Residual, Sensor
from graphloc.ledger import Outcome
from graphloc.measurements import Measurement
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.time import stamps_of

_MOST = 400  # measurements that are evaluated, evenly spaced
_STEP = 1e-4  # step of a slow state, for its numerical Jacobian
_FEWEST = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class _There:
    """Pose and covariance of a solution at one stamp."""

    T_world_body: gtsam.Pose3
    P_tangent: Array  # (6, 6) of the pose, gtsam's body tangent
    v_world_mps: Array
    v_cov: Array
    gyro_radps: Array
    felt: FeltMotion  # by the track


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradiction:
    """Distance of a sensor from a solution without it.

    Attributes:
        sigmas: the measure. apart_m, apart_deg: median distance in m and in deg; None: the sensor measures no such.
    """

    sigmas: float
    apart_m: float | None
    apart_deg: float | None


def contradiction(
    solution: Solution, recording: Recording, config: VesselConfig, name: str, rows: Sequence[Sensor]
) -> Contradiction | None:
    """Return the distance of a sensor's measurements from a solution without it; None if there are too few."""
    sensor = config.sensors[name]
    row = next(r for r in rows if r.kind == sensor.kind)
    own = [m for m in recording.measurements if m.sensor == name]
    covered = solution.trajectory.covers(stamps_of(own))
    own = [m for m, inside in zip(own, covered, strict=True) if inside]
    own = own[:: max(1, -(-len(own) // _MOST))]
    if len(own) < _FEWEST:
        return None
    false = 0.0 if row.false is None else float(np.mean([row.false(m, sensor).probability for m in own]))
    t, R = mount_of(name, sensor, recording.mounts)
    judged = [
        _nis(m, sensor, row, _attachment(solution, there, t, R), there)
        for m, there in zip(own, _at(solution, own), strict=True)
    ]
    quantile = 0.5 * (1.0 - false)
    scaled = np.array([nis / chi2_median(len(r.raw)) for nis, r in judged])

    def typical(sizes: list[float | None]) -> float | None:
        known = [size for size in sizes if size is not None]
        return float(np.quantile(known, quantile)) if known else None

    return Contradiction(
        sigmas=float(np.sqrt(np.quantile(scaled, quantile))),
        apart_m=typical([r.size_m for _, r in judged]),
        apart_deg=typical([r.size_deg for _, r in judged]),
    )


def _at(solution: Solution, measurements: Sequence[Measurement]) -> list[_There]:
    track, stamps = solution.trajectory, stamps_of(measurements)
    moments, index = np.unique(stamps, return_inverse=True)
    there = track.at(moments)
    nearest = np.abs(track.stamps_ns[None, :] - moments[:, None]).argmin(axis=1)
    assert there.cov is not None
    assert there.v_world_mps is not None
    assert track.v_world_mps is not None
    since_s = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    a_world_mps2, spin_radps2 = (np.gradient(x, since_s, axis=0) for x in (track.v_world_mps, solution.gyro_radps))
    found = []
    for i in range(len(moments)):
        R = there.R_world_body[i]
        turn = np.zeros((6, 6))  # x, y, z, rotations about the world's axes -> rotation, translation in body axes
        turn[:3, 3:], turn[3:, :3] = R.T, R.T
        found.append(
            _There(
                T_world_body=gtsam.Pose3(gtsam.Rot3(R), there.p_world_m[i]),
                P_tangent=turn @ there.cov[i] @ turn.T,
                v_world_mps=there.v_world_mps[i],
                v_cov=solution.v_cov[nearest[i]],
                gyro_radps=solution.gyro_radps[nearest[i]],
                felt=FeltMotion(
                    R.T @ a_world_mps2[nearest[i]], spin_radps2[nearest[i]], np.zeros(3)
                ),  # acceleration of the motion only, without gravity
            )
        )
    return [found[i] for i in index]


def _attachment(solution: Solution, there: _There, t: Array, R: Array) -> Attachment:
    """Return an attachment to a made-up state at body's origin and at the measurement's stamp; it is in no graph."""
    return Attachment(
        pose_key=0,
        velocity_key=0,
        slow_key=None,
        leaf_keys=(0, 0),
        T_world_body=there.T_world_body,
        v_world_mps=there.v_world_mps,
        T_state_sensor=gtsam.Pose3(gtsam.Rot3(R), t),
        carried_m=np.zeros(3),
        dv_world_mps=np.zeros(3),
        gyro_radps=there.gyro_radps,
        lever_m=t,
        slow_value=None,
        datum=solution.datum,
        felt=there.felt,
    )


def _nis(m: Measurement, config: object, row: Sensor, at: Attachment, there: _There) -> tuple[float, Residual]:
    """Return the smallest r^T S^-1 r among the hypotheses of a measurement, and the residual of that hypothesis."""
    slow, constants = row.slow(config), row.constants(config)
    at = replace(at, constants=tuple((0, np.zeros(len(c.sigma))) for c in constants))
    if slow is not None:
        at = replace(at, slow_key=0, slow_value=np.zeros(len(slow.sigma)))
    found = row.residuals(m, config, at)
    shared = [r.jacobian() @ there.P_tangent @ r.jacobian().T for r in found]
    shared = [
        s if (V := r.velocity_jacobian) is None else s + V() @ there.v_cov @ V().T
        for s, r in zip(shared, found, strict=True)
    ]
    for k in range(0 if slow is None else len(slow.sigma)):
        assert slow is not None
        step = np.zeros(len(slow.sigma))
        step[k] = _STEP
        moved = row.residuals(m, config, replace(at, slow_value=step))
        for i, (r, other) in enumerate(zip(found, moved, strict=True)):
            column = (other.raw - r.raw) / _STEP * slow.sigma[k]
            shared[i] = shared[i] + np.outer(column, column)
    for i, r in enumerate(found):
        for constant, jacobian in zip(constants, r.constant_jacobians(), strict=True):
            shared[i] = shared[i] + (jacobian * constant.sigma**2) @ jacobian.T
    nis = [r.nis(s) for r, s in zip(found, shared, strict=True)]
    best = int(np.argmin(nis))
    return nis[best], found[best]


def fit(solution: Solution, name: str) -> float | None:
    """Return the distance of a sensor's used measurements from a solution with it, in its own sigmas; 1: as stated."""
    used = [
        (row.nis, row.dof)
        for row in solution.ledger
        if row.sensor == name and row.outcome is Outcome.USED and row.nis is not None and row.dof
    ]
    if len(used) < _FEWEST:
        return None
    return float(np.sqrt(np.median([nis / chi2_median(dof) for nis, dof in used])))
