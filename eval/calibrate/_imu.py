# SPDX-License-Identifier: Apache-2.0
"""Noise of the IMU: by the scatter of its samples, and by the residuals of the solved run.

Samples show the white noise, vibration of engine and hull included: third differences remove the motion, and have 20
times the variance of white noise. A configured noise below this scatter is too small. A larger one may be intended,
since slow vibration does not scatter from sample to sample. So it is called too large only if the IMU's residuals in
the solved run are smaller, too.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from graphloc.config import STANDARD_GRAVITY_MPS2, ImuConfig
from graphloc.eval.calibrate._findings import Check, Suggestion
from graphloc.eval.formatting import significant
from graphloc.measurements import ImuSeries
from graphloc.offsets import Misfit, Offsets
from graphloc.signals.imu_scatter import FEWEST, noise_density

_TOO_SMALL, _TOO_LARGE = 1.5, 0.5  # scatter over configured noise, from which this is too small or too large
_LESS = 0.7  # noise that the run needs over configured noise, below which this is too large
_UG, _MDPS = 1e-6 * STANDARD_GRAVITY_MPS2, float(np.radians(1e-3))


def imu_noise(imu: ImuSeries, config: ImuConfig, offsets: Offsets | None) -> Iterator[Suggestion | Check]:
    """Yield a suggestion or a check for the accelerometer's and the gyroscope's noise."""
    samples = (
        (
            "accel_noise_ug_per_sqrt_hz",
            "ug/sqrt(Hz)",
            imu.accel_mps2 / _UG,
            None if offsets is None else offsets.accelerometer,
        ),
        (
            "gyro_noise_mdps_per_sqrt_hz",
            "mdeg/s/sqrt(Hz)",
            imu.gyro_radps / _MDPS,
            None if offsets is None else offsets.gyroscope,
        ),
    )
    if len(imu) < FEWEST:
        return
    scale = 1.0 if offsets is None else offsets.noise_scale
    for key, unit, columns, misfit in samples:
        yield _judge(
            imu.sensor, key, unit, float(getattr(config, key)), noise_density(imu.stamps_ns, columns), misfit, scale
        )


def _judge(
    sensor: str,
    key: str,
    unit: str,
    configured: float,
    measured: tuple[float, float],
    misfit: Misfit | None,
    scale: float,
) -> Suggestion | Check:
    scatter, sigma = measured
    path, z = f"sensors.{sensor}.{key}", (scatter - configured) / max(sigma, 1e-9)
    if scatter > _TOO_SMALL * configured:
        return Suggestion(
            sensor=sensor, key=path, unit=unit, configured=configured, suggested=scatter, sigma=sigma, z=z,
            evidence="its samples scatter by that from one to the next, engine and hull included",
            action="set it at least as large",
        )  # fmt: skip
    if scatter < _TOO_LARGE * configured and misfit is not None and scale == 1.0 and misfit.needed < _LESS:
        needed, unsure = configured * misfit.needed, configured * misfit.sigma
        value, off = (needed, unsure) if needed - scatter > 2.0 * unsure else (scatter, sigma)
        return Suggestion(
            sensor=sensor, key=path, unit=unit, configured=configured, suggested=value, sigma=off, z=(value - configured) / off,
            evidence=f"its samples scatter by {significant(scatter)}, and the run leaves a misfit of {misfit.squares:.0f} where so "
            f"much noise would leave {misfit.freedom:.0f}",
            action="set it, no smaller",
        )  # fmt: skip
    said = f"its samples scatter by {significant(scatter)} +- {significant(sigma, 2)} {unit}, engine and hull included"
    if scatter < _TOO_LARGE * configured:
        said += "; whether the larger noise is needed, a longer run with better fixes would tell"
    return Check(key=path, unit=unit, configured=configured, change=scatter - configured, sigma=sigma, said=said)
