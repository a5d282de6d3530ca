# SPDX-License-Identifier: Apache-2.0
"""IMU preintegration between states, with bias.

    R_j = R_i Exp(int (w - b_g)),  v_j = v_i + g dt + R_i int (f - b_a),  p_j = p_i + v_i dt + ...

Forster et al., TRO 2017, as in GTSAM's `PreintegratedImuMeasurements` and `ImuFactor`. The bias is a
state of its own at the slow period, held between its nodes, with a random walk from node to node
(docs/decisions): at 1 s that walk is far below the noise of a sample. Samples are interpolated at
the interval's ends and averaged between stamps (trapezoid). A hole of the data is interpolated
across, with noise that lets a vessel do anything a vessel does. Gravity removed by the driver: the same
integral with g = 0. The states stand at the IMU (see `graphloc.build`), so there is no lever arm here:
`setBodyPSensor` would leave out the Euler term (angular acceleration x lever), 0.07 m/s^2 in harbour
waves at 1 m, which lost whole runs. Not handled: coning faster than the sample rate.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.config import ImuConfig
from graphloc.frames import Array
from graphloc.graph import UNKNOWN_MPS2, UNKNOWN_RADPS
from graphloc.measurements import ImuSeries

_INTEGRATION_SIGMA = 1e-4  # m/s/sqrt(Hz)-like floor that keeps position covariance positive


class Links:
    """Preintegration of one IMU (see `graphloc.graph.InertialLink`)."""

    def __init__(
        self, imu: ImuSeries, config: ImuConfig, R_body_imu: Array, gravity_mps2: float, noise_scale: float
    ) -> None:
        self._stamps = imu.stamps_ns
        self._samples = np.hstack([imu.accel_mps2, imu.gyro_radps])
        self._config = config
        self._R_body_imu = R_body_imu
        self._max_gap_ns = int(config.max_gap_s * 1e9)
        mount = gtsam.Pose3(gtsam.Rot3(R_body_imu), np.zeros(3))
        self._noise_scale = noise_scale
        self._gravity_mps2 = gravity_mps2 if config.gravity != "removed" else 0.0
        self._params = self._make_params(
            config.accel_noise_mps2 * noise_scale, config.gyro_noise_radps * noise_scale, mount
        )
        self._gap_params = self._make_params(UNKNOWN_MPS2, UNKNOWN_RADPS, mount)

    def extend(self, stamps_ns: NDArray[np.int64], samples: Array) -> None:
        """Add samples (N, 6) at stamps that are new: specific force, rate; late ones go where they belong."""
        stamps, rows = np.concatenate([self._stamps, stamps_ns]), np.concatenate([self._samples, samples])
        if (np.diff(stamps[-len(stamps_ns) - 1 :]) <= 0).any():
            order = np.argsort(stamps, kind="stable")
            stamps, rows = stamps[order], rows[order]
        self._stamps, self._samples = stamps, rows

    def forget(self, before_ns: int) -> None:
        """Drop the samples before a stamp, but for the last of them."""
        first = max(int(np.searchsorted(self._stamps, before_ns)) - 1, 0)
        self._stamps, self._samples = self._stamps[first:].copy(), self._samples[first:].copy()

    def _make_params(self, accel: float, gyro: float, mount: Any) -> Any:
        # Every covariance of fresh params is 1.0: set them all.
        params = gtsam.PreintegrationParams.MakeSharedU(self._gravity_mps2)
        params.setAccelerometerCovariance(np.eye(3) * accel**2)
        params.setGyroscopeCovariance(np.eye(3) * gyro**2)
        params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_SIGMA**2)
        params.setBodyPSensor(mount)
        return params

    def integrate(self, start_ns: int, stop_ns: int, bias: Any) -> Any:
        """Return the preintegrated measurement over [start_ns, stop_ns], at least two sub-steps."""
        first = int(np.searchsorted(self._stamps, start_ns, side="right"))
        last = int(np.searchsorted(self._stamps, stop_ns, side="left"))
        edges = np.concatenate([[start_ns], self._stamps[first:last], [stop_ns]])
        if len(edges) < 3:
            edges = np.array([start_ns, (start_ns + stop_ns) // 2, stop_ns])
        dts = np.diff(edges) * 1e-9
        middles = self._at((edges[:-1] + edges[1:]) // 2)
        params = self._gap_params if self._in_gap(start_ns, stop_ns) else self._params
        pim = gtsam.PreintegratedImuMeasurements(params, bias)
        for sample, dt in zip(middles, dts, strict=True):
            if dt > 0.0:
                pim.integrateMeasurement(sample[:3], sample[3:], dt)
        return pim

    def _at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Samples (M, 6) interpolated at stamps; held beyond the ends."""
        right = np.clip(np.searchsorted(self._stamps, stamps_ns), 1, len(self._stamps) - 1)
        a, b = self._stamps[right - 1], self._stamps[right]
        share = np.clip((stamps_ns - a) / np.maximum(b - a, 1), 0.0, 1.0)[:, None]
        return np.asarray(self._samples[right - 1] * (1.0 - share) + self._samples[right] * share)

    def _in_gap(self, start_ns: int, stop_ns: int) -> bool:
        left = max(int(np.searchsorted(self._stamps, start_ns, side="right")) - 1, 0)
        right = min(int(np.searchsorted(self._stamps, stop_ns, side="left")), len(self._stamps) - 1)
        return bool((np.diff(self._stamps[left : right + 1]) > self._max_gap_ns).any())

    def factor(self, k: int, j: int, preintegrated: Any) -> Any:
        """Return the factor between states k and k + 1 with the bias of slow node j."""
        return gtsam.ImuFactor(
            keys.pose(k), keys.velocity(k), keys.pose(k + 1), keys.velocity(k + 1), keys.bias(j), preintegrated
        )

    def gyro_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the raw rates (M, 3) in body axes."""
        return np.asarray(self._at(stamps_ns)[:, 3:] @ self._R_body_imu.T)

    def bias_steps(self, dt_s: float) -> Array:
        """Return sigmas (6,) of the random walk over `dt_s`."""
        c = self._config
        sigmas = np.array([c.accel_bias_walk_mps2] * 3 + [c.gyro_bias_walk_radps] * 3)
        return np.asarray(sigmas * np.sqrt(dt_s) * self._noise_scale)

    def bias_sigmas(self) -> Array:
        """Return turn-on sigmas (6,)."""
        c = self._config
        return np.array([c.accel_bias_sigma_mps2] * 3 + [c.gyro_bias_sigma_radps] * 3)

    def gaps(self) -> list[tuple[int, int]]:
        """Return the holes in the data."""
        wide = np.flatnonzero(np.diff(self._stamps) > self._max_gap_ns)
        return [(int(self._stamps[i]), int(self._stamps[i + 1])) for i in wide]


class ImuRow:
    """The row of the inertial sensor."""

    kind = "imu"
    config = ImuConfig

    def link(
        self, imu: ImuSeries, config: ImuConfig, R_body_imu: Array, gravity_mps2: float, noise_scale: float = 1.0
    ) -> Links:
        """Return the links of one IMU."""
        return Links(imu, config, R_body_imu, gravity_mps2, noise_scale)


ROW = ImuRow()
