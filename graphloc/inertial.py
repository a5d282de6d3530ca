# SPDX-License-Identifier: Apache-2.0
"""What the inertial sensor promises to the graph builder: it links two states by the motion that it measures in between.

`graphloc.factors.imu` keeps this promise. Builder and solvers know the inertial sensor only through this module.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from graphloc.config import SensorConfig
from graphloc.frames import Array
from graphloc.measurements import ImuSeries


class InertialRow(Protocol):
    """The inertial sensor's counterpart of a `graphloc.graph.Sensor`: it links two states instead of measuring one."""

    kind: str

    @property
    def config(self) -> type[SensorConfig]:
        """The class of its configuration."""

    def link(
        self, imu: ImuSeries, config: Any, R_body_imu: Array, gravity_mps2: float, noise_scale: float = 1.0
    ) -> InertialLink:
        """Return what preintegrates one IMU.

        Args:
            imu: its samples. R_body_imu: (3, 3) mount in body. gravity_mps2: size of gravity at the datum.
            noise_scale: factor on the configured noise densities and on the walk of the biases.
        """


GAP_TOLD_S = 10.0
"""Length of the samples on either side of a gap that tell the motion in it."""
GAP_TURN_RADPS = 0.2
"""White noise of the unknown turning in a gap, rad/s per sqrt(s)."""


class GapMotion(NamedTuple):
    """What is taken to go on in a gap of the IMU's data, from the state before it.

    Attributes:
        bias: of the IMU (gtsam.imuBias.ConstantBias). v_body_mps: (3,) velocity, body axes.
    """

    bias: Any
    v_body_mps: Array

    @classmethod
    def of(cls, state: Any, bias: Any) -> GapMotion:
        """Return what goes on from a state (gtsam.NavState)."""
        return cls(bias, np.asarray(state.attitude().unrotate(state.velocity())))


class InertialLink(Protocol):
    """Preintegration of one IMU between any two stamps."""

    def integrate(self, start_ns: int, stop_ns: int, bias: Any, going: GapMotion | None = None) -> Any:
        """Return the preintegrated measurement from `start_ns` to `stop_ns` (start < stop).

        Args:
            bias: about which the preintegration is linearised, where there are data.
            going: what goes on in a gap of the data, and the bias to linearise about there; None: `bias`, and a vessel at rest.
        """

    def extend(self, stamps_ns: NDArray[np.int64], samples: Array) -> None:
        """Add samples (N, 6), in any order of time: specific force, m/s^2, and angular rate, rad/s, in IMU axes."""

    def leave_out(self, after_ns: int, until_ns: int) -> None:
        """Drop the samples after one stamp until another, which is then a gap, however short; no sample in it is added later."""

    def pause(self, after_ns: int, until_ns: int) -> None:
        """Add noise between two samples, however near in time: a clock may have been set, so that less time or none has passed."""

    def forget(self, before_ns: int) -> None:
        """Drop the samples before a stamp except the last of them, and what the bridge of a gap after it needs."""

    def factor(self, k: int, j: int, preintegrated: Any) -> Any:
        """Return the factor between states `k` and `k + 1`, with the bias of slow node `j`."""

    def gyro_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the raw angular rates (M, 3) in body axes at M stamps."""

    def gyro_variance_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the variance (M,), rad^2/s^2, of each axis of the rates that `gyro_at` returns, without that of the bias."""

    def felt_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return specific force, m/s^2, and angular acceleration, rad/s^2 (M, 6), about M stamps, body axes, biases included.

        They are means over a time that is longer than a hull's vibrations, and shorter than waves.
        """

    @property
    def gravity_mps2(self) -> Array:
        """Gravity (3,), world axes: added to a specific force it gives an acceleration. Zero where the driver has removed gravity."""

    def bias_steps(self, from_ns: int, to_ns: int) -> Array:
        """Return the sigmas (6,) of how far the bias goes from one stamp to another, accelerometer first.

        By its random walk, and by another turn-on bias where the sensor may have been off in between.
        """

    def bias_sigmas(self) -> Array:
        """Return the sigmas (6,) of the biases at switching on, accelerometer first."""

    def gaps(self) -> list[tuple[int, int]]:
        """Return the gaps in the data as (start, stop), stamps in ns."""
