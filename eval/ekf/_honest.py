# SPDX-License-Identifier: Apache-2.0
"""EKF for a fair comparison."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
from scipy.stats import chi2

from graphloc.config import BodyVelocityConfig, VesselConfig
from graphloc.eval.ekf._inputs import Interval
from graphloc.eval.ekf._planar import SILENT_Q, FilterResult, advance, run_filter, transition
from graphloc.frames import Array, Datum
from graphloc.measurements import BodyVelocity, GnssPosition, Measurement
from graphloc.recording import Recording
from graphloc.time import NS_PER_S

_ACCEL, _GATE, _PATIENCE_S = 0.3, 0.9, 10.0


def run_honest(recording: Recording, config: VesselConfig, datum: Datum) -> FilterResult:
    """Run an EKF for a fair comparison.

    Exact Jacobian, rotating body axes, gyro bias as a state, wave accelerations as process noise, GNSS velocity, a 90 % chi-square
    gate for every sensor, a GNSS covariance that includes slow errors (1 m), and a speed log's that includes scale and current.
    While measurements are rejected the covariance grows, so the gate opens again by itself; a sensor that was rejected for 10 s is
    accepted again, so that nothing locks it out. The three values were chosen on seeds that no figure uses
    (`benchmarks/tune_filter.py`).
    """
    rate_hz, dt = 20.0, 0.05
    imu = recording.imu
    gyro = config.sensors[imu.sensor].gyro_noise_radps if imu is not None else 1e-3
    Q = np.diag([0.0, 0.0, _ACCEL**2, _ACCEL**2, gyro**2 + np.radians(0.02) ** 2, 1e-10]) * dt
    several = Counter(m.sensor for m in recording.measurements)
    span_s = float(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S if imu is not None and len(imu) else 1.0
    agreed_ns: dict[str, int] = {}
    leak: deque[Array] = deque(maxlen=round(20.0 * rate_hz))  # as in `Interval`, the turning taken off
    total = np.zeros(2)

    def start(x: Array) -> tuple[Array, Array]:
        return np.append(x, 0.0), np.diag([1.0, 1.0, 1.0, 1.0, np.radians(5.0) ** 2, np.radians(0.5) ** 2])

    def predict(x: Array, P: Array, step: Interval) -> tuple[Array, Array]:
        # In a turn the body's axes turn under its velocity: dv/dt = a - w x v, which the print leaves out.
        rate = step.rate - x[5]
        turning = rate * np.array([x[3], -x[2]])
        if len(leak) == leak.maxlen:
            total[:] -= leak.popleft()
        leak.append(step.accel + turning)
        total[:] += leak[-1]
        steady = total / len(leak)
        F = np.eye(6)
        F[:5, :5] = transition(x[:5], dt, exact=True)
        F[2, 3], F[3, 2], F[2, 5], F[3, 5] = dt * rate, -dt * rate, -dt * x[3], dt * x[2]
        F[4, 5] = -dt
        P = F @ P @ F.T + Q
        if step.silent:
            P[:5, :5] += SILENT_Q * dt
        return np.append(advance(x[:5], step.accel + turning - steady, rate, dt), x[5]), P

    def judge(m: Measurement, r: Array, H: Array, P: Array, R: Array) -> Array | str:
        if isinstance(m, GnssPosition):
            R = R + np.eye(2) * max(several[m.sensor] / span_s, 1.0)  # 1 m of slow error, shared by a second's fixes
        elif isinstance(m, BodyVelocity):
            log = config.sensors[m.sensor]
            assert isinstance(log, BodyVelocityConfig)
            slow = (log.scale_sigma * m.value[: len(R)]) ** 2
            slow += log.current_sigma_mps**2 if log.through == "water" else 0.0
            R = R + np.diag(slow) * max(several[m.sensor] / span_s, 1.0)  # of its scale, and of a current: as of fixes
        nis = float(r @ np.linalg.solve(H @ P @ H.T + R, r))
        waited_s = (m.stamp_ns - agreed_ns.setdefault(m.sensor, m.stamp_ns)) / NS_PER_S
        if nis > chi2.ppf(_GATE, len(r)) and waited_s < _PATIENCE_S:
            return f"outside the {100 * _GATE:g} % gate"
        agreed_ns[m.sensor] = m.stamp_ns
        return R

    return run_filter("honest EKF", recording, config, datum, rate_hz, start, predict, judge)
