# SPDX-License-Identifier: Apache-2.0
"""Parts that the two EKFs share: the planar model, the loop over steps and measurements, the resulting track."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from graphloc.config import VesselConfig
from graphloc.eval.ekf._inputs import Interval, MountedMeasurement, intervals_of, measurements_of, start_of
from graphloc.frames import Array, Datum, wrap_angle
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import (
    BodyVelocity,
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    Measurement,
    PoseFix,
    world_from_fixes,
)
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.time import NS_PER_S
from graphloc.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterResult:
    """Result of a filter.

    Attributes:
        name: of the filter. trajectory: with covariance. ledger: of absolute measurements.
        why: explanation of the filter's errors, or empty.
    """

    name: str
    trajectory: Trajectory
    ledger: Ledger
    why: str = ""


def named_tracks(solution: Solution, filters: Iterable[FilterResult]) -> list[tuple[str, Trajectory]]:
    """Return the track of a run and those of filters on the same measurements, each with its name."""
    return [(solution.name, solution.trajectory), *((f.name, f.trajectory) for f in filters)]


def _measurement(mounted: MountedMeasurement, x: Array, rate: float, datum: Datum) -> tuple[Array, Array, Array]:
    """Return innovation (k,), H (k, 5) and R of a measurement, corrected for its lever arm with psi."""
    m, lever = mounted.m, mounted.lever
    c, s = np.cos(x[4]), np.sin(x[4])
    turn = np.array([[c, -s], [s, c]])
    swing, place = rate * np.array([-lever[1], lever[0]]), np.array([x[0], x[1], 0.0])
    if isinstance(m, BodyVelocity):
        c, s = np.cos(mounted.mount_yaw), np.sin(mounted.mount_yaw)
        level = [n for n, axis in enumerate(m.axes) if axis != "z"]
        H = np.zeros((len(level), 5))
        H[:, 2:4] = np.array([[c, s], [-s, c]])[["xy".index(m.axes[n]) for n in level]]
        return m.value[level] - H[:, 2:4] @ (x[2:4] + swing), H, np.array(m.cov[np.ix_(level, level)])
    if isinstance(m, GnssVelocity):
        H = np.zeros((2, 5))
        H[:, 2:4], H[:, 4] = turn, np.array([[-s, -c], [c, -s]]) @ (x[2:4] + swing)
        v = datum.local_axes(place) @ m.v_enu_mps
        return v[:2] - turn @ (x[2:4] + swing), H, np.array(m.cov_m2ps2[:2, :2])
    if isinstance(m, GnssPosition):
        z = world_from_fixes([m], datum)[0, :2]
        values, cov, index = {0: z[0], 1: z[1]}, m.cov_enu_m2[:2, :2], [0, 1]
    elif isinstance(m, CompassHeading):
        values, cov, index = {4: m.yaw_rad + float(datum.convergence_rad(place))}, np.array([[m.sigma_rad**2]]), [4]
    else:
        assert isinstance(m, PoseFix)
        best = max(m.modes, key=lambda mode: mode.probability)
        states = {"x": 0, "y": 1, "yaw": 4}
        picked = [i for i, a in enumerate(m.axes) if a in states]
        index = [states[m.axes[i]] for i in picked]
        values = dict(zip(index, best.value[picked], strict=True))
        cov = best.cov[np.ix_(picked, picked)]
    off = {0: (turn @ lever[:2])[0], 1: (turn @ lever[:2])[1], 4: mounted.mount_yaw}
    r = np.array([values[i] - off[i] - x[i] for i in index])
    r = np.where(np.array(index) == 4, wrap_angle(r), r)
    return r, np.eye(5)[index], np.array(cov)


def transition(x: Array, dt: float, *, exact: bool) -> Array:
    c, s = np.cos(x[4]), np.sin(x[4])
    F = np.eye(5)
    F[0, 2], F[0, 3], F[1, 2], F[1, 3] = dt * c, -dt * s, dt * s, dt * c
    if exact:
        F[0, 4], F[1, 4] = dt * (-s * x[2] - c * x[3]), dt * (c * x[2] - s * x[3])
    return F


def advance(x: Array, accel: Array, rate: float, dt: float) -> Array:
    c, s = np.cos(x[4]), np.sin(x[4])
    new = x.copy()
    new[0] += dt * (c * x[2] - s * x[3])
    new[1] += dt * (s * x[2] + c * x[3])
    new[2] += dt * accel[0]
    new[3] += dt * accel[1]
    new[4] = float(wrap_angle(x[4] + dt * rate))
    return new


SILENT_Q = np.diag([0.0, 0.0, 1.0, 1.0, 0.2**2])  # density of the unknown motion in a gap of the IMU, per s


class PlanarEkf(Protocol):
    """What distinguishes one EKF from another. State x (n,), n >= 5: x, y, surge, sway, heading; covariance P (n, n).

    Attributes:
        name: for tables. rate_hz: of predictions.
    """

    name: str
    rate_hz: float

    def start(self, x: Array) -> tuple[Array, Array]:
        """Return state (n,) and covariance (n, n) at the start, from the first five states (5,)."""

    def predict(self, x: Array, P: Array, step: Interval) -> tuple[Array, Array]:
        """Return state and covariance one step later."""

    def gate(self, m: Measurement, r: Array, H: Array, P: Array, R: Array) -> Array | str:
        """Return the covariance (k, k) to use for a measurement, or the reason to reject it.

        Args:
            r: (k,) innovation. H: (k, n). R: (k, k) covariance of the measurement.
        """


Shown = Callable[[Measurement, Array, Array, Array], tuple[Array, Array]]
"""Takes measurement, state, and innovation and H by the planar model; returns these with the further states' part."""


def run_filter(
    ekf: PlanarEkf,
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    shown: Shown = lambda _m, _x, r, H: (r, H),
) -> FilterResult:
    """Predict step by step, and apply each measurement at the first step after it.

    Args:
        ekf: the filter. recording, config, datum: its input. shown: for a filter whose measurements depend on states
            beyond position, velocity and heading; by default none does.
    """
    intervals, measured = intervals_of(recording, config, ekf.rate_hz), measurements_of(recording, config)
    x, P = ekf.start(start_of(measured, recording, datum))
    first = intervals[0].stop_ns - round(NS_PER_S / ekf.rate_hz) if intervals else 0
    ledger, out, k = Ledger(), [(first, x.copy(), P.copy())], 0
    for step in intervals:
        x, P = ekf.predict(x, P, step)
        while k < len(measured) and measured[k].m.stamp_ns <= step.stop_ns:
            mounted, k = measured[k], k + 1
            r, planar, R = _measurement(mounted, x[:5], step.rate - (x[5] if len(x) > 5 else 0.0), datum)
            r, H = shown(mounted.m, x, r, np.hstack([planar, np.zeros((len(r), len(x) - 5))]))
            taken = ekf.gate(mounted.m, r, H, P, R)
            nis = float(r @ np.linalg.solve(H @ P @ H.T + R, r))
            if not isinstance(taken, str):
                x, P = _update(x, P, r, H, taken)
            if mounted.m.seq >= 0:
                ledger.add(filter_row(mounted.m, recording, nis, taken if isinstance(taken, str) else ""))
        out.append((step.stop_ns, x.copy(), P.copy()))
    return FilterResult(name=ekf.name, trajectory=_planar(out), ledger=ledger)


def _update(x: Array, P: Array, r: Array, H: Array, R: Array) -> tuple[Array, Array]:
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    x = x + K @ r
    x[4] = float(wrap_angle(x[4]))
    I_KH = np.eye(len(x)) - K @ H
    return x, I_KH @ P @ I_KH.T + K @ R @ K.T


def filter_row(
    m: Measurement, recording: Recording, nis: float | None, refused: str, away_m: float | None = None
) -> LedgerRow:
    """Return the ledger row of a measurement that a filter used, or rejected for a reason (`refused`)."""
    row = recording.row_of(m, Outcome.REJECTED if refused else Outcome.USED, refused)
    return replace(row, weight=0.0 if refused else 1.0, residual_m=away_m, nis=nis)


def _planar(out: list[tuple[int, Array, Array]]) -> Trajectory:
    """Return a planar track as a trajectory: z, roll and pitch are 0 with sigmas of 1 m and 0.1 rad."""
    stamps: NDArray[np.int64] = np.array([stamp for stamp, _, _ in out], dtype=np.int64)
    x, P = np.array([x for _, x, _ in out]), np.array([P for _, _, P in out])
    c, s = np.cos(x[:, 4]), np.sin(x[:, 4])
    n = len(x)
    R = np.zeros((n, 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 1, 0], R[:, 1, 1], R[:, 2, 2] = c, -s, s, c, 1.0
    cov = np.zeros((n, 6, 6))
    index = np.array([0, 1, 4])
    every = np.arange(n)
    cov[np.ix_(every, np.array([0, 1, 5]), np.array([0, 1, 5]))] = P[np.ix_(every, index, index)]
    cov[:, 2, 2], cov[:, 3, 3], cov[:, 4, 4] = 1.0, 0.01, 0.01
    v = np.column_stack([c * x[:, 2] - s * x[:, 3], s * x[:, 2] + c * x[:, 3], np.zeros(n)])
    return Trajectory(
        stamps_ns=stamps,
        p_world_m=np.column_stack([x[:, :2], np.zeros(n)]),
        R_world_body=R,
        v_world_mps=v,
        cov=cov,
        planar=True,
    )
