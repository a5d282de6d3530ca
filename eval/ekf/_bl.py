# SPDX-License-Identifier: Apache-2.0
"""EKF of Bergman & Lindell, as printed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphloc.config import VesselConfig
from graphloc.eval.ekf._inputs import Interval
from graphloc.eval.ekf._planar import SILENT_Q, FilterResult, advance, run_filter, transition
from graphloc.frames import Array, Datum
from graphloc.measurements import BodyVelocity, GnssPosition, GnssVelocity, Measurement, PoseFix
from graphloc.recording import Recording

_FAR_OFF_DEG = 5.0  # median, which the noise of no heading sensor makes; a choice


@dataclass(frozen=True, slots=True, kw_only=True)
class BlConfig:
    """Parameters of BL alg. 6. Defaults are the printed ones, with errata corrected (dt, rad, 3 x 5 H).

    R_lidar is a3 times the pose's own covariance; poses of BL's matcher (`matcher: bl` of an aerial sensor) have that
    of eq. 3.33.

    Attributes:
        rate_hz: prediction rate. a1, a2, a3: BL's factors on Q, R_gnss, R_lidar.
        a2_in_loss: factor on R_gnss while the signal is lost, which BL set by hand. loss_ns: (start, stop)
            stamps of the loss; None: unknown to the filter.
        gate_m: a pose farther than this from the prediction is dropped.
        accel_noise_mg, gyro_noise_dps: printed as 37 mg and 0.008 deg/s; divided by the root of the rate (eq. 3.1,
            3.2).
        gnss_rmse_m: the receiver's e; 0: from the fix. heading_rmse_deg: of the GNSS compass.
        exact_jacobian: whether F has the d/dpsi terms, which the printed one lacks.
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


class _BlEkf:
    """BL alg. 6. It does not use GNSS velocity."""

    name = "BL EKF"

    def __init__(self, options: BlConfig) -> None:
        self.heading_off_rad = list[float]()  # of each heading that it was given, from its own before
        self._options, self.rate_hz, self._dt = options, options.rate_hz, 1.0 / options.rate_hz
        s_acc = options.accel_noise_mg * 1e-3 * 9.81 / np.sqrt(options.rate_hz)  # eq. 3.2
        s_gyro = np.radians(options.gyro_noise_dps) / np.sqrt(options.rate_hz)  # eq. 3.1
        self._Qa = np.diag([0.0, 0.0, s_acc**2, s_acc**2, s_gyro**2]) * self._dt  # eq. 3.28

    def start(self, x: Array) -> tuple[Array, Array]:
        return x, np.diag([0.1, 0.1, 0.1, 0.1, 0.01])

    def predict(self, x: Array, P: Array, step: Interval) -> tuple[Array, Array]:
        F = transition(x, self._dt, exact=self._options.exact_jacobian)
        Q = self._options.a1 * (F @ self._Qa @ F.T) + (SILENT_Q * self._dt if step.silent else 0.0)  # eq. 3.29
        return advance(x, step.accel - step.leak, step.rate, self._dt), F @ P @ F.T + Q

    def gate(self, m: Measurement, r: Array, H: Array, P: Array, R: Array) -> Array | str:
        o = self._options
        if isinstance(m, PoseFix):
            away = float(np.linalg.norm(r[H[:, :2].any(axis=1)]))
            return o.a3 * R if away < o.gate_m else f"outside the {o.gate_m:g} m gate"
        if isinstance(m, GnssVelocity | BodyVelocity):
            return "BL's filter has no velocity"
        lost = o.loss_ns is not None and o.loss_ns[0] <= m.stamp_ns < o.loss_ns[1]
        a2 = o.a2_in_loss if lost else o.a2
        if isinstance(m, GnssPosition):
            return a2 * np.eye(2) * (o.gnss_rmse_m**2 if o.gnss_rmse_m else float(np.trace(R))) / 2.0
        self.heading_off_rad.append(float(r[0]))
        return a2 * np.array([[np.radians(o.heading_rmse_deg) ** 2 / 2.0]])


def run_bl(recording: Recording, config: VesselConfig, datum: Datum, options: BlConfig | None = None) -> FilterResult:
    """Run BL alg. 6. It does not use GNSS velocity."""
    filtered = _BlEkf(options := options or BlConfig())
    result = run_filter(filtered, recording, config, datum)
    # The median, as a bias turns it to one side: noise and single wrong headings do not.
    off_deg = abs(float(np.degrees(np.median(filtered.heading_off_rad or [0.0]))))
    if off_deg < _FAR_OFF_DEG:
        return result
    why = (
        f"its heading is {off_deg:.0f} deg (median) off the headings that it is given: as printed it has no state for the gyroscope's bias, and "
        f"takes the gyroscope to be good to {options.gyro_noise_dps:g} deg/s"
    )
    return replace(result, why=why)
