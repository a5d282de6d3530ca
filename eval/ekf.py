# SPDX-License-Identifier: Apache-2.0
"""The filters that the graph is compared with, on the same measurements.

`BlEkf` is BL alg. 6 as printed, 2 m gate included; each erratum is a switch. `HonestEkf` is the planar
filter that one would honestly compare with: exact Jacobian, gyro bias, chi-square gates that open as the
covariance grows. State of both: x, y (m, world), surge, sway (m/s, body), heading psi (rad), then biases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from graphloc.build import mount_of
from graphloc.config import VesselConfig
from graphloc.errors import SolveError
from graphloc.frames import Array, Datum, wrap_angle
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import CompassHeading, GnssPosition, GnssVelocity, Measurement, PoseFix
from graphloc.recording import Recording
from graphloc.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class BlConfig:
    """BL alg. 6. Defaults are the print, with the errata that `thesis-notes` settles (dt, rad, 3 x 5 H).

    Attributes:
        rate_hz: prediction rate. a1, a2, a3: BL's factors on Q, R_gnss, R_lidar.
        gate_m: a pose further than this from the prediction is dropped.
        accel_noise_mg: printed 37 mg/sqrt(Hz). gyro_noise_dps: 0.008 deg/s/sqrt(Hz).
        gnss_rmse_m: receiver's own e; 0 takes it from the fix. heading_rmse_deg: of the GNSS compass.
        exact_jacobian: d/dpsi terms in F, which the print lacks.
        pose_covariance: use the pose's own covariance instead of a3 diag((Nm / (10 Nk + 1))^2), which
            needs the point count of BL's matcher.
    """

    rate_hz: float = 20.0
    a1: float = 10.0
    a2: float = 10.0
    a3: float = 0.5
    gate_m: float = 2.0
    accel_noise_mg: float = 37.0
    gyro_noise_dps: float = 0.008
    gnss_rmse_m: float = 0.0
    heading_rmse_deg: float = 1.5
    exact_jacobian: bool = False
    pose_covariance: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterResult:
    """What a filter gives: its name, trajectory with covariance, and ledger of absolute measurements."""

    name: str
    trajectory: Trajectory
    ledger: Ledger


def run_all(recording: Recording, config: VesselConfig, datum: Datum) -> tuple[FilterResult, ...]:
    """Run both filters."""
    return (run_bl(recording, config, datum), run_honest(recording, config, datum))


@dataclass(slots=True)
class _Inputs:
    """Planar inputs at the filter's rate and events in stamp order."""

    stamps: Array
    accel: Array  # (N, 2) surge, sway, gravity taken out as far as a planar filter can
    rate: Array  # (N,) yaw rate
    events: list[tuple[int, Measurement, Array, float]]  # stamp, measurement, lever, mount yaw


def _inputs(recording: Recording, config: VesselConfig, rate_hz: float) -> _Inputs:
    imu = recording.imu
    if imu is None:
        raise SolveError(f"{recording.source}: no IMU data for the filter")
    _, R = mount_of(imu.sensor, config.sensors[imu.sensor], recording)
    accel, gyro = imu.accel_mps2 @ R.T, imu.gyro_radps @ R.T
    step = int(1e9 / rate_hz)
    edges = np.arange(imu.stamps_ns[0], imu.stamps_ns[-1], step)
    at = np.searchsorted(imu.stamps_ns, np.append(edges, edges[-1] + step))
    count = np.maximum(np.diff(at), 1)
    total = np.vstack([np.zeros(6), np.cumsum(np.hstack([accel, gyro]), axis=0)])
    mean = (total[np.minimum(at[1:], len(accel))] - total[at[:-1]]) / count[:, None]
    # A planar filter knows no attitude: it removes what tilt leaves of gravity with a slow mean (20 s).
    window = min(int(20.0 * rate_hz), len(mean))
    smooth = np.column_stack([np.convolve(mean[:, i], np.ones(window) / window, "same") for i in range(2)])
    events: list[tuple[int, Measurement, Array, float]] = []
    for m in recording.measurements:
        if isinstance(m, GnssPosition | GnssVelocity | CompassHeading | PoseFix):
            t, R_mount = mount_of(m.sensor, config.sensors[m.sensor], recording)
            events.append((m.stamp_ns, m, t, float(np.arctan2(R_mount[1, 0], R_mount[0, 0]))))
    return _Inputs(edges, mean[:, :2] - smooth, mean[:, 5], events)


def _start(inputs: _Inputs, recording: Recording, datum: Datum) -> Array:
    """Start as BL does: at the true pose where there is truth, else at the first fix and heading."""
    if recording.truth is not None:
        truth = recording.truth
        v = truth.R_world_body[0].T @ truth.v_world_mps[0] if truth.v_world_mps is not None else np.zeros(3)
        return np.array([*truth.p_world_m[0, :2], v[0], v[1], truth.yaw_rad[0]])
    fix = next((e for e in inputs.events if isinstance(e[1], GnssPosition)), None)
    head = next((e for e in inputs.events if isinstance(e[1], CompassHeading)), None)
    p, psi = np.zeros(2), 0.0
    if fix is not None:
        assert isinstance(fix[1], GnssPosition)
        p = datum.enu_from_geodetic(*(np.array([v]) for v in fix[1].position))[0, :2]
    if head is not None:
        assert isinstance(head[1], CompassHeading)
        psi = head[1].yaw_rad - head[3]
    else:
        fixes = [e[1] for e in inputs.events if isinstance(e[1], GnssPosition)]
        track = datum.enu_from_geodetic(*np.array([f.position for f in fixes]).T)[:, :2] if fixes else np.zeros((1, 2))
        far = np.flatnonzero(np.hypot(*(track - track[0]).T) > 5.0)
        if len(far):
            psi = float(np.arctan2(*(track[far[0]] - track[0])[::-1]))
    return np.array([*p, 0.0, 0.0, psi])


def _measurement(
    m: Measurement, x: Array, rate: float, lever: Array, mount_yaw: float, datum: Datum
) -> tuple[Array, Array, Array]:
    """Return innovation (k,), H (k, 5) and R of a measurement, its lever arm taken off with psi."""
    c, s = np.cos(x[4]), np.sin(x[4])
    turn = np.array([[c, -s], [s, c]])
    if isinstance(m, GnssVelocity):
        swing = rate * np.array([-lever[1], lever[0]])
        H = np.zeros((2, 5))
        H[:, 2:4], H[:, 4] = turn, np.array([[-s, -c], [c, -s]]) @ (x[2:4] + swing)
        return m.v_world_mps[:2] - turn @ (x[2:4] + swing), H, np.array(m.cov_m2ps2[:2, :2])
    if isinstance(m, GnssPosition):
        z = datum.enu_from_geodetic(*(np.array([v]) for v in m.position))[0, :2]
        values, cov, index = {0: z[0], 1: z[1]}, m.cov_enu_m2[:2, :2], [0, 1]
    elif isinstance(m, CompassHeading):
        values, cov, index = {4: m.yaw_rad}, np.array([[m.sigma_rad**2]]), [4]
    else:
        assert isinstance(m, PoseFix)
        best = max(m.modes, key=lambda mode: mode.probability)
        states = {"x": 0, "y": 1, "yaw": 4}
        picked = [i for i, a in enumerate(m.axes) if a in states]
        index = [states[m.axes[i]] for i in picked]
        values = dict(zip(index, best.value[picked], strict=True))
        cov = best.cov[np.ix_(picked, picked)]
    off = {0: (turn @ lever[:2])[0], 1: (turn @ lever[:2])[1], 4: mount_yaw}
    r = np.array([values[i] - off[i] - x[i] for i in index])
    r = np.where(np.array(index) == 4, wrap_angle(r), r)
    return r, np.eye(5)[index], np.array(cov)


def _row(m: Measurement, recording: Recording, outcome: Outcome, nis: float, reason: str) -> LedgerRow:
    return LedgerRow(
        seq=m.seq,
        stamp_ns=m.stamp_ns,
        sensor=m.sensor,
        topic=recording.topics.get(m.sensor, ""),
        outcome=outcome,
        weight=1.0 if outcome is Outcome.USED else 0.0,
        nis=nis,
        reason=reason,
    )


def run_bl(recording: Recording, config: VesselConfig, datum: Datum, options: BlConfig | None = None) -> FilterResult:
    """Run BL alg. 6."""
    o = options or BlConfig()
    inputs = _inputs(recording, config, o.rate_hz)
    dt = 1.0 / o.rate_hz
    x, P = _start(inputs, recording, datum), np.diag([0.1, 0.1, 0.1, 0.1, 0.01])
    s_acc = o.accel_noise_mg * 1e-3 * 9.81 * np.sqrt(100.0) / 10.0  # eq. 3.2: variance x 1 / rate
    s_gyro = np.radians(o.gyro_noise_dps)
    Qa = np.diag([0.0, 0.0, s_acc**2, s_acc**2, s_gyro**2])
    ledger, out = Ledger(), []
    k_event = 0
    for stamp, accel, rate in zip(inputs.stamps, inputs.accel, inputs.rate, strict=True):
        F = _transition(x, dt, exact=o.exact_jacobian)
        x = _advance(x, accel, rate, dt)
        P = F @ P @ F.T + o.a1 * (F @ Qa @ F.T) * dt
        while k_event < len(inputs.events) and inputs.events[k_event][0] <= stamp:
            _, m, lever, mount_yaw = inputs.events[k_event]
            k_event += 1
            if isinstance(m, GnssVelocity):  # BL has none
                continue
            r, H, R = _measurement(m, x, rate, lever, mount_yaw, datum)
            if isinstance(m, GnssPosition):
                e2 = (o.gnss_rmse_m**2 / 2.0) if o.gnss_rmse_m else float(np.trace(R)) / 2.0
                R = o.a2 * np.eye(2) * e2
            elif isinstance(m, CompassHeading):
                R = o.a2 * np.array([[np.radians(o.heading_rmse_deg) ** 2 / 2.0]])
            else:
                R = o.a3 * R
            if isinstance(m, PoseFix) and np.hypot(*r[:2]) >= o.gate_m:
                if m.seq >= 0:
                    ledger.add(_row(m, recording, Outcome.REJECTED, 0.0, f"outside the {o.gate_m:g} m gate"))
                continue
            x, P, nis = _update(x, P, r, H, R)
            if m.seq >= 0:
                ledger.add(_row(m, recording, Outcome.USED, nis, ""))
        out.append((x.copy(), P.copy()))
    return FilterResult(name="BL EKF", trajectory=_planar(inputs, out, recording), ledger=ledger)


def _transition(x: Array, dt: float, *, exact: bool) -> Array:
    c, s = np.cos(x[4]), np.sin(x[4])
    F = np.eye(5)
    F[0, 2], F[0, 3], F[1, 2], F[1, 3] = dt * c, -dt * s, dt * s, dt * c
    if exact:
        F[0, 4], F[1, 4] = dt * (-s * x[2] - c * x[3]), dt * (c * x[2] - s * x[3])
    return F


def _advance(x: Array, accel: Array, rate: float, dt: float) -> Array:
    c, s = np.cos(x[4]), np.sin(x[4])
    new = x.copy()
    new[0] += dt * (c * x[2] - s * x[3])
    new[1] += dt * (s * x[2] + c * x[3])
    new[2] += dt * accel[0]
    new[3] += dt * accel[1]
    new[4] = float(wrap_angle(x[4] + dt * rate))
    return new


def _update(x: Array, P: Array, r: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    x = x + K @ r
    x[4] = float(wrap_angle(x[4]))
    I_KH = np.eye(len(x)) - K @ H
    return x, I_KH @ P @ I_KH.T + K @ R @ K.T, float(r @ np.linalg.solve(S, r))


def run_honest(recording: Recording, config: VesselConfig, datum: Datum) -> FilterResult:
    """Run the filter that one would honestly compare with.

    Exact Jacobian, gyro bias as a state, wave accelerations as process noise, a 99.9 % chi-square gate for
    every sensor, and a GNSS covariance that owns up to slow errors (1 m). While measurements are
    rejected the covariance grows, so the gate opens again by itself.
    """
    inputs = _inputs(recording, config, 20.0)
    dt = 0.05
    imu_config = config.sensors[recording.imu.sensor] if recording.imu is not None else None
    gyro = getattr(imu_config, "gyro_noise_radps", 1e-3)
    x = np.append(_start(inputs, recording, datum), 0.0)
    P = np.diag([1.0, 1.0, 0.25, 0.25, np.radians(5.0) ** 2, np.radians(0.5) ** 2])
    Q = np.diag([0.0, 0.0, 0.3**2, 0.3**2, gyro**2 + np.radians(0.02) ** 2, 1e-10]) * dt
    ledger, out, k_event = Ledger(), [], 0
    for stamp, accel, rate in zip(inputs.stamps, inputs.accel, inputs.rate, strict=True):
        F = np.eye(6)
        F[:5, :5] = _transition(x[:5], dt, exact=True)
        F[4, 5] = -dt
        x[:5] = _advance(x[:5], accel, rate - x[5], dt)
        P = F @ P @ F.T + Q
        while k_event < len(inputs.events) and inputs.events[k_event][0] <= stamp:
            _, m, lever, mount_yaw = inputs.events[k_event]
            k_event += 1
            r, planar, R = _measurement(m, x[:5], rate - x[5], lever, mount_yaw, datum)
            H = np.hstack([planar, np.zeros((len(r), 1))])
            if isinstance(m, GnssPosition):
                R = R + np.eye(2) * 1.0**2 * 10.0  # a slow error of 1 m, shared by about 10 fixes
            nis = float(r @ np.linalg.solve(H @ P @ H.T + R, r))
            if nis > chi2.ppf(0.999, len(r)):
                if m.seq >= 0:
                    ledger.add(_row(m, recording, Outcome.REJECTED, nis, "outside the 99.9 % gate"))
                continue
            x, P, _ = _update(x, P, r, H, R)
            if m.seq >= 0:
                ledger.add(_row(m, recording, Outcome.USED, nis, ""))
        out.append((x.copy(), P.copy()))
    return FilterResult(name="honest EKF", trajectory=_planar(inputs, out, recording), ledger=ledger)


def _planar(inputs: _Inputs, out: list[tuple[Array, Array]], recording: Recording) -> Trajectory:
    """Return a planar track as a trajectory: z, roll and pitch are 0 with sigmas of 1 m and 0.1 rad."""
    x, P = np.array([o[0] for o in out]), np.array([o[1] for o in out])
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
        stamps_ns=np.asarray(inputs.stamps, dtype=np.int64),
        p_world_m=np.column_stack([x[:, :2], np.zeros(n)]),
        R_world_body=R,
        v_world_mps=v,
        cov=cov,
    )
