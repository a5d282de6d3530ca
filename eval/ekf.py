# SPDX-License-Identifier: Apache-2.0
"""The filters that the graph is compared with, on the same measurements.

`run_bl` is BL alg. 6 as printed, 2 m gate included; its missing Jacobian is a switch. `run_honest` is the planar
filter that one would honestly compare with: exact Jacobian, gyro bias, GNSS velocity, chi-square gates
that open as the covariance grows. State of both: x, y (m, world), surge, sway (m/s, body), heading psi
(rad); then the gyro bias.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from graphloc.build import mount_of
from graphloc.config import VesselConfig
from graphloc.errors import SolveError
from graphloc.frames import Array, Datum, skew, wrap_angle
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import (
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    Measurement,
    PoseFix,
    PoseMode,
    TagSighting,
)
from graphloc.recording import Recording
from graphloc.survey import Survey
from graphloc.time import NS_PER_S, seconds_since
from graphloc.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class BlConfig:
    """BL alg. 6. Defaults are the print, with the errata that `thesis-notes` settles (dt, rad, 3 x 5 H).

    Attributes:
        rate_hz: prediction rate. a1, a2, a3: BL's factors on Q, R_gnss, R_lidar.
        a2_in_loss: factor on R_gnss while the signal is lost, which BL set by hand. loss_ns: (start, stop)
            stamps of it; None: nobody tells.
        gate_m: a pose further than this from the prediction is dropped.
        accel_noise_mg: printed 37 mg; gyro_noise_dps: 0.008 deg/s; both over the root of the rate (eq. 3.1, 3.2).
        gnss_rmse_m: receiver's own e; 0 takes it from the fix. heading_rmse_deg: of the GNSS compass.
        exact_jacobian: d/dpsi terms in F, which the print lacks.

    R_lidar is a3 times the pose's own covariance: that of eq. 3.33 where the pose comes of BL's matcher
    (`matcher: bl` of an aerial sensor).
    """

    rate_hz: float = 20.0
    a1: float = 10.0
    a2: float = 10.0
    a2_in_loss: float = 1000.0
    loss_ns: tuple[int, int] | None = None
    a3: float = 0.5
    gate_m: float = 2.0
    accel_noise_mg: float = 37.0
    gyro_noise_dps: float = 0.008
    gnss_rmse_m: float = 0.0
    heading_rmse_deg: float = 1.5
    exact_jacobian: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterResult:
    """What a filter gives.

    Attributes:
        name: of the filter. trajectory: with covariance. ledger: of absolute measurements.
        why: what explains how far off it is, where that takes a word.
    """

    name: str
    trajectory: Trajectory
    ledger: Ledger
    why: str = ""


def run_all(
    recording: Recording, config: VesselConfig, datum: Datum, options: BlConfig | None = None
) -> tuple[FilterResult, ...]:
    """Run both filters; `options` are those of BL's."""
    return (run_bl(recording, config, datum, options), run_honest(recording, config, datum))


@dataclass(frozen=True, slots=True)
class _Interval:
    """What the IMU says between two filter steps: means in body axes, and whether it was silent."""

    stop_ns: int
    accel: Array  # (2,) surge, sway, with what tilt leaves of gravity
    leak: Array  # (2,) their mean over the last 20 s: a planar filter knows no attitude, and takes it for that
    rate: float
    silent: bool


@dataclass(frozen=True, slots=True)
class _Event:
    """A measurement with its mount."""

    m: Measurement
    lever: Array
    mount_yaw: float


def _intervals(recording: Recording, config: VesselConfig, rate_hz: float) -> list[_Interval]:
    imu = recording.imu
    if imu is None:
        raise SolveError(f"{recording.source}: no IMU data for the filter")
    imu_config = config.sensors[imu.sensor]
    _, R = mount_of(imu.sensor, imu_config, recording.mounts)
    samples = np.hstack([imu.accel_mps2 @ R.T, imu.gyro_radps @ R.T])
    t = seconds_since(int(imu.stamps_ns[0]), imu.stamps_ns)
    edges = np.arange(0.0, t[-1], 1.0 / rate_hz)
    total = np.vstack([np.zeros(6), np.cumsum(0.5 * (samples[1:] + samples[:-1]) * np.diff(t)[:, None], axis=0)])
    there = np.column_stack([np.interp(edges, t, total[:, i]) for i in range(6)])
    mean = np.diff(there, axis=0) * rate_hz
    count = np.arange(1, len(mean) + 1)
    width = np.minimum(count, round(20.0 * rate_hz))
    leak = (there[count, :2] - there[count - width, :2]) * rate_hz / width[:, None]
    right = np.clip(np.searchsorted(t, edges[1:]), 1, len(t) - 1)
    silent = t[right] - t[right - 1] > imu_config.max_gap_s
    stops = imu.stamps_ns[0] + np.rint(edges[1:] * NS_PER_S).astype(np.int64)
    return [
        _Interval(int(stop), m[:2], g, float(m[5]), bool(hole))
        for stop, m, g, hole in zip(stops, mean, leak, silent, strict=True)
    ]


def _events(recording: Recording, config: VesselConfig) -> list[_Event]:
    events = []
    for m in recording.measurements:
        sensor = config.sensors.get(m.sensor)
        if isinstance(m, TagSighting) and sensor:
            m = as_pose(m, sensor.surveyed)
        if isinstance(m, GnssPosition | GnssVelocity | CompassHeading | PoseFix) and sensor and sensor.enabled:
            t, R = mount_of(m.sensor, sensor, recording.mounts)
            events.append(_Event(m, t, float(np.arctan2(R[1, 0], R[0, 0]))))
    return events


def as_pose(m: TagSighting, survey: Survey) -> PoseFix:
    """Return the planar poses of the body that a sighting of tags gives, likeliest first.

    With t from the camera to the tags' middle, the place is c - t: what its own error and that of the attitude make of
    it. A dock is as likely here as there within what it wanders.
    """
    modes, dock = [], survey.dock(m.frame)
    for mode in m.modes:
        R = mode.R_world_camera @ m.R_body_camera.T
        arm = R @ m.t_body_camera_m + m.points_m.mean(axis=0) - mode.p_world_camera_m  # from the body to the tags
        J = np.zeros((3, 6))
        J[:2, :3] = -mode.R_world_camera[:2]
        J[:2, 3:], J[2, 3:] = (skew(arm) @ mode.R_world_camera)[:2], mode.R_world_camera[2]
        cov = J @ mode.cov @ J.T + np.diag([1e-4, 1e-4, 1e-6])
        if dock is not None:
            cov += np.diag([dock.moves_m**2 / 4.0] * 2 + [np.radians(dock.moves_deg) ** 2 / 4.0])
        p = mode.p_world_camera_m - R @ m.t_body_camera_m
        yaw = float(np.arctan2(R[1, 0], R[0, 0]))
        modes.append(PoseMode(value=np.array([p[0], p[1], yaw]), cov=cov, probability=mode.probability))
    return PoseFix(stamp_ns=m.stamp_ns, sensor=m.sensor, seq=m.seq, axes=("x", "y", "yaw"), modes=tuple(modes))


def _start(events: list[_Event], recording: Recording, datum: Datum) -> Array:
    """Start as BL does: at the true pose where there is truth, else by the first fixes and heading."""
    truth, imu = recording.truth, recording.imu
    if truth is not None and imu is not None and truth.covers(imu.stamps_ns[:1]).all():
        there = truth.at(imu.stamps_ns[:1])
        v = there.R_world_body[0].T @ there.v_world_mps[0] if there.v_world_mps is not None else np.zeros(3)
        return np.array([*there.p_world_m[0, :2], v[0], v[1], there.yaw_rad[0]])
    fixes = [e.m for e in events if isinstance(e.m, GnssPosition)]
    poses = [e.m for e in events if isinstance(e.m, PoseFix) and e.m.axes[:2] == ("x", "y")]
    heading = next((e for e in events if isinstance(e.m, CompassHeading)), None)
    track = datum.enu_from_geodetic(*np.array([f.position for f in fixes]).T)[:, :2] if fixes else np.zeros((1, 2))
    p = track[0] if fixes or not poses else poses[0].modes[0].value[:2]
    psi = 0.0
    if heading is not None:
        assert isinstance(heading.m, CompassHeading)
        psi = heading.m.yaw_rad - heading.mount_yaw
    else:
        far = np.flatnonzero(np.hypot(*(track - track[0]).T) > 5.0)
        if len(far):
            psi = float(np.arctan2(*(track[far[0]] - track[0])[::-1]))
    v = _first_velocity(fixes, track)
    c, s = np.cos(psi), np.sin(psi)
    return np.array([*p, c * v[0] + s * v[1], -s * v[0] + c * v[1], psi])


def _first_velocity(fixes: list[GnssPosition], track: Array) -> Array:
    """Velocity (2,) of the first 5 seconds of fixes, by their slope."""
    t = np.array([(f.stamp_ns - fixes[0].stamp_ns) / NS_PER_S for f in fixes[:100]])
    soon = t < 5.0
    if soon.sum() < 3 or np.ptp(t[soon]) < 1.0:
        return np.zeros(2)
    return np.array([np.polyfit(t[soon], track[:100][soon, k], 1)[0] for k in range(2)])


def _measurement(event: _Event, x: Array, rate: float, datum: Datum) -> tuple[Array, Array, Array]:
    """Return innovation (k,), H (k, 5) and R of a measurement, its lever arm taken off with psi."""
    m, lever = event.m, event.lever
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
    off = {0: (turn @ lever[:2])[0], 1: (turn @ lever[:2])[1], 4: event.mount_yaw}
    r = np.array([values[i] - off[i] - x[i] for i in index])
    r = np.where(np.array(index) == 4, wrap_angle(r), r)
    return r, np.eye(5)[index], np.array(cov)


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


# Given x, P and an interval: x, P one step on. Given a measurement, r, H, P, R: the R to take, or why not.
_Predict = Callable[[Array, Array, _Interval], tuple[Array, Array]]
_Judge = Callable[[Measurement, Array, Array, Array, Array], "Array | str"]
_SILENT_Q = np.diag([0.0, 0.0, 1.0, 1.0, 0.2**2])  # density of unknown motion in a hole of the IMU's data


def _run(
    name: str,
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    rate_hz: float,
    start: Callable[[Array], tuple[Array, Array]],
    predict: _Predict,
    judge: _Judge,
) -> FilterResult:
    """Predict from step to step, and take each measurement at the first step after it."""
    intervals, events = _intervals(recording, config, rate_hz), _events(recording, config)
    x, P = start(_start(events, recording, datum))
    first = intervals[0].stop_ns - round(NS_PER_S / rate_hz) if intervals else 0
    ledger, out, k = Ledger(), [(first, x.copy(), P.copy())], 0
    for step in intervals:
        x, P = predict(x, P, step)
        while k < len(events) and events[k].m.stamp_ns <= step.stop_ns:
            event, k = events[k], k + 1
            r, planar, R = _measurement(event, x[:5], step.rate - (x[5] if len(x) > 5 else 0.0), datum)
            H = np.hstack([planar, np.zeros((len(r), len(x) - 5))])
            taken = judge(event.m, r, H, P, R)
            nis = float(r @ np.linalg.solve(H @ P @ H.T + R, r))
            if not isinstance(taken, str):
                x, P = _update(x, P, r, H, taken)
            if event.m.seq >= 0:
                ledger.add(filter_row(event.m, recording, nis, taken if isinstance(taken, str) else ""))
        out.append((step.stop_ns, x.copy(), P.copy()))
    return FilterResult(name=name, trajectory=_planar(out), ledger=ledger)


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
    """Return the row of a measurement that a filter took, or refused for a reason."""
    return LedgerRow(
        seq=m.seq,
        stamp_ns=m.stamp_ns,
        sensor=m.sensor,
        topic=recording.topics.get(m.sensor, ""),
        outcome=Outcome.REJECTED if refused else Outcome.USED,
        weight=0.0 if refused else 1.0,
        residual_m=away_m,
        nis=nis,
        reason=refused,
    )


def run_bl(recording: Recording, config: VesselConfig, datum: Datum, options: BlConfig | None = None) -> FilterResult:
    """Run BL alg. 6. It has no GNSS velocity: that is left out."""
    o = options or BlConfig()
    dt = 1.0 / o.rate_hz
    s_acc = o.accel_noise_mg * 1e-3 * 9.81 / np.sqrt(o.rate_hz)  # eq. 3.2
    s_gyro = np.radians(o.gyro_noise_dps) / np.sqrt(o.rate_hz)  # eq. 3.1
    Qa = np.diag([0.0, 0.0, s_acc**2, s_acc**2, s_gyro**2]) * dt  # eq. 3.28

    def start(x: Array) -> tuple[Array, Array]:
        return x, np.diag([0.1, 0.1, 0.1, 0.1, 0.01])

    def predict(x: Array, P: Array, step: _Interval) -> tuple[Array, Array]:
        F = _transition(x, dt, exact=o.exact_jacobian)
        Q = o.a1 * (F @ Qa @ F.T) + (_SILENT_Q * dt if step.silent else 0.0)  # eq. 3.29
        return _advance(x, step.accel - step.leak, step.rate, dt), F @ P @ F.T + Q

    def judge(m: Measurement, r: Array, H: Array, P: Array, R: Array) -> Array | str:
        if isinstance(m, PoseFix):
            away = float(np.linalg.norm(r[H[:, :2].any(axis=1)]))
            return o.a3 * R if away < o.gate_m else f"outside the {o.gate_m:g} m gate"
        if isinstance(m, GnssVelocity):
            return "BL's filter has no velocity"
        lost = o.loss_ns is not None and o.loss_ns[0] <= m.stamp_ns < o.loss_ns[1]
        a2 = o.a2_in_loss if lost else o.a2
        if isinstance(m, GnssPosition):
            return a2 * np.eye(2) * (o.gnss_rmse_m**2 if o.gnss_rmse_m else float(np.trace(R))) / 2.0
        return a2 * np.array([[np.radians(o.heading_rmse_deg) ** 2 / 2.0]])

    return _run("BL EKF", recording, config, datum, o.rate_hz, start, predict, judge)


_HONEST_ACCEL, _HONEST_GATE, _HONEST_PATIENCE_S = 0.3, 0.9, 10.0


def run_honest(recording: Recording, config: VesselConfig, datum: Datum) -> FilterResult:
    """Run the filter that one would honestly compare with.

    Exact Jacobian, turning body axes, gyro bias as a state, wave accelerations as process noise, GNSS velocity, a 90 %
    chi-square gate for every sensor, and a GNSS covariance that owns up to slow errors (1 m). While
    measurements are rejected the covariance grows, so the gate opens again by itself; a sensor that
    was rejected for 10 s on end is taken again, so that nothing locks it out. The three were chosen on seeds
    that no figure uses (`benchmarks/tune_filter.py`).
    """
    rate_hz, dt = 20.0, 0.05
    imu = recording.imu
    gyro = config.sensors[imu.sensor].gyro_noise_radps if imu is not None else 1e-3
    Q = np.diag([0.0, 0.0, _HONEST_ACCEL**2, _HONEST_ACCEL**2, gyro**2 + np.radians(0.02) ** 2, 1e-10]) * dt
    fixes = Counter(m.sensor for m in recording.measurements if isinstance(m, GnssPosition))
    span_s = float(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S if imu is not None and len(imu) else 1.0
    agreed_ns: dict[str, int] = {}
    leak: deque[Array] = deque(maxlen=round(20.0 * rate_hz))  # as in `_Interval`, the turning taken off
    total = np.zeros(2)

    def start(x: Array) -> tuple[Array, Array]:
        return np.append(x, 0.0), np.diag([1.0, 1.0, 1.0, 1.0, np.radians(5.0) ** 2, np.radians(0.5) ** 2])

    def predict(x: Array, P: Array, step: _Interval) -> tuple[Array, Array]:
        # In a turn the body's axes turn under its velocity: dv/dt = a - w x v, which the print leaves out.
        rate = step.rate - x[5]
        turning = rate * np.array([x[3], -x[2]])
        if len(leak) == leak.maxlen:
            total[:] -= leak.popleft()
        leak.append(step.accel + turning)
        total[:] += leak[-1]
        steady = total / len(leak)
        F = np.eye(6)
        F[:5, :5] = _transition(x[:5], dt, exact=True)
        F[2, 3], F[3, 2], F[2, 5], F[3, 5] = dt * rate, -dt * rate, -dt * x[3], dt * x[2]
        F[4, 5] = -dt
        P = F @ P @ F.T + Q
        if step.silent:
            P[:5, :5] += _SILENT_Q * dt
        return np.append(_advance(x[:5], step.accel + turning - steady, rate, dt), x[5]), P

    def judge(m: Measurement, r: Array, H: Array, P: Array, R: Array) -> Array | str:
        if isinstance(m, GnssPosition):
            R = R + np.eye(2) * max(fixes[m.sensor] / span_s, 1.0)  # 1 m of slow error, shared by a second's fixes
        nis = float(r @ np.linalg.solve(H @ P @ H.T + R, r))
        waited_s = (m.stamp_ns - agreed_ns.setdefault(m.sensor, m.stamp_ns)) / NS_PER_S
        if nis > chi2.ppf(_HONEST_GATE, len(r)) and waited_s < _HONEST_PATIENCE_S:
            return f"outside the {100 * _HONEST_GATE:g} % gate"
        agreed_ns[m.sensor] = m.stamp_ns
        return R

    return _run("honest EKF", recording, config, datum, rate_hz, start, predict, judge)


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
