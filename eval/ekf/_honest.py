# SPDX-License-Identifier: Apache-2.0
"""EKF for a fair comparison."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

from graphloc.chi2 import chi2_below
from graphloc.config import BodyVelocityConfig, PoseConfig, VesselConfig
from graphloc.eval.ekf._inputs import Interval
from graphloc.eval.ekf._planar import SILENT_Q, FilterResult, advance, run_filter, transition
from graphloc.frames import Array, Datum
from graphloc.measurements import BodyVelocity, GnssPosition, Measurement, PoseFix
from graphloc.recording import Recording
from graphloc.time import NS_PER_S

_RATE_HZ, _DT_S = 20.0, 0.05
_ACCEL, _GATE, _PATIENCE_S = 0.3, 0.9, 10.0
_MEAN_S = 20.0  # time over which the mean acceleration counts as bias and tilt, as in `Interval`


class _HonestEkf:
    """State: x, y (m), surge, sway (m/s), heading (rad), gyro bias (rad/s). See `run_honest`."""

    name, rate_hz = "honest EKF", _RATE_HZ

    def __init__(self, recording: Recording, config: VesselConfig) -> None:
        imu = recording.imu
        gyro = config.sensors[imu.sensor].gyro_noise_radps if imu is not None else 1e-3
        self._Q = np.diag([0.0, 0.0, _ACCEL**2, _ACCEL**2, gyro**2 + np.radians(0.02) ** 2, 1e-10]) * _DT_S
        self._sensors = config.sensors
        self._receivers = {name: config.receiver_of(name) for name in config.sensors}
        self._count = Counter(self._receiver_of(m) for m in recording.measurements)
        self._span_s = float(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S if imu is not None and len(imu) else 1.0
        self._agreed_ns: dict[str, int] = {}
        self._recent: deque[Array] = deque(maxlen=round(_MEAN_S * _RATE_HZ))  # accelerations, that of turning removed
        self._sum = np.zeros(2)  # of `_recent`
        self._rate = 0.0  # yaw rate in the last step, rad/s

    def start(self, x: Array) -> tuple[Array, Array]:
        return np.append(x, 0.0), np.diag([1.0, 1.0, 1.0, 1.0, np.radians(5.0) ** 2, np.radians(0.5) ** 2])

    def predict(self, x: Array, P: Array, step: Interval) -> tuple[Array, Array]:
        x, F, Q = self.moved(x, step)
        return x, F @ P @ F.T + Q

    def moved(self, x: Array, step: Interval) -> tuple[Array, Array, Array]:
        """Return the state (6,) one step later, F (6, 6) and the process noise Q (6, 6)."""
        # In a turn the body's axes rotate under its velocity: dv/dt = a - w x v. BL's printed model leaves that out.
        rate = self._rate = step.rate - x[5]
        turning = rate * np.array([x[3], -x[2]])
        bias = self._mean_with(step.accel + turning)
        F = np.eye(6)
        F[:5, :5] = transition(x[:5], _DT_S, exact=True)
        F[2, 3], F[3, 2], F[2, 5], F[3, 5] = _DT_S * rate, -_DT_S * rate, -_DT_S * x[3], _DT_S * x[2]
        F[4, 5] = -_DT_S
        Q = self._Q.copy()
        if step.silent:
            Q[:5, :5] += SILENT_Q * _DT_S
        return np.append(advance(x[:5], step.accel + turning - bias, rate, _DT_S), x[5]), F, Q

    def gate(self, m: Measurement, r: Array, H: Array, P: Array, R: Array) -> Array | str:
        R = R + self._slow(m, len(R))
        nis = float(r @ np.linalg.solve(H @ P @ H.T + R, r))
        receiver = self._receiver_of(m)
        waited_s = (m.stamp_ns - self._agreed_ns.setdefault(receiver, m.stamp_ns)) / NS_PER_S
        if nis > chi2_below(_GATE, len(r)) and waited_s < _PATIENCE_S:
            return f"outside the {100 * _GATE:g} % gate"
        self._agreed_ns[receiver] = m.stamp_ns
        return R

    def _receiver_of(self, m: Measurement) -> str:
        """Return the sensor that stands for all that read one receiver by turns: to this filter they are one sensor."""
        return self._receivers.get(m.sensor, m.sensor)

    def _mean_with(self, accel: Array) -> Array:
        """Return the mean acceleration (2,) of the last `_MEAN_S`, the given one included."""
        if len(self._recent) == self._recent.maxlen:
            self._sum -= self._recent.popleft()
        self._recent.append(accel)
        self._sum += accel
        return np.asarray(self._sum / len(self._recent))

    def _slow(self, m: Measurement, size: int) -> Array:
        """Return the covariance (size, size) to add for the slow error of a measurement.

        It is multiplied by the measurements per second, which share the error.
        """
        per_s = max(self._count[self._receiver_of(m)] / self._span_s, 1.0)
        if isinstance(m, GnssPosition):
            return np.eye(2) * per_s  # 1 m
        if isinstance(m, PoseFix) and isinstance(sensor := self._sensors[m.sensor], PoseConfig):
            error = sensor.slow_error
            sigma = {"x": error.sigma_m, "y": error.sigma_m, "yaw": np.radians(error.sigma_deg)}
            return np.diag([sigma[axis] ** 2 for axis in m.axes if axis in sigma]) * per_s
        if not isinstance(m, BodyVelocity):
            return np.zeros((size, size))
        log = self._sensors[m.sensor]
        assert isinstance(log, BodyVelocityConfig)
        slow = (log.scale_sigma * m.value[:size]) ** 2
        slow += log.current_sigma_mps**2 if log.through == "water" else 0.0
        slow += (self._rate * log.mount_sigma_m) ** 2
        along = dict(zip(m.axes, m.value, strict=True))
        turned = {"x": along.get("y", 0.0), "y": -along.get("x", 0.0)}
        by_yaw = np.radians(log.mount_sigma_deg) * np.array([turned[axis] for axis in m.axes if axis in turned])
        return (np.diag(slow) + np.outer(by_yaw, by_yaw)) * per_s


def run_honest(recording: Recording, config: VesselConfig, datum: Datum) -> FilterResult:
    """Run an EKF for a fair comparison.

    It has the exact Jacobian, rotating body axes, the gyro bias as a state, wave accelerations as process noise, GNSS
    velocity, and a 90 % chi-square gate for every sensor. The covariance of GNSS includes slow errors (1 m), that of
    poses their `slow_error`, that of a speed log its scale, current and mount. While measurements are rejected the
    covariance grows, so the gate opens again by itself. A sensor that was rejected for 10 s is accepted again, so that
    it is never locked out. The wave accelerations, the gate and the 10 s were chosen on seeds that no figure uses
    (`benchmarks/tune_filter.py`).
    """
    return run_filter(_HonestEkf(recording, config), recording, config, datum)
