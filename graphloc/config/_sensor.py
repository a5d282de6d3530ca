# SPDX-License-Identifier: Apache-2.0
"""What the block of every sensor has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from graphloc.blocks import Block, MountConfig, Positive


class KernelConfig(Block):
    """Robust loss of a sensor. Where hypotheses exist (modes, false ones) the last stage of the solver weighs by these instead."""

    kind: Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"] = "cauchy"
    """Loss. Redescending kinds (geman_mcclure, tukey) are used in the last stage only; before that, Cauchy."""
    scale: Positive = 1.5
    """Where the loss bends, in standard deviations of the residual (times sqrt(dof))."""

    def weight(self, nis: float) -> float:
        """Weight in [0, 1] that the loss gives a squared normalised residual."""
        if self.kind == "none":
            return 1.0
        u2 = nis / self.scale**2
        if self.kind == "huber":
            return 1.0 if u2 <= 1.0 else 1.0 / math.sqrt(u2)
        if self.kind == "cauchy":
            return 1.0 / (1.0 + u2)
        if self.kind == "geman_mcclure":
            return 1.0 / (1.0 + u2) ** 2
        return (1.0 - u2) ** 2 if u2 < 1.0 else 0.0

    def loss(self, nis: float, dof: int) -> float:
        """Return what a squared normalised residual of so many components costs, -log of its density but for a constant."""
        if self.kind == "none":
            return 0.5 * nis
        c2 = self.scale**2 * dof
        u2 = nis / c2
        if self.kind == "huber":
            return 0.5 * nis if u2 <= 1.0 else c2 * (math.sqrt(u2) - 0.5)
        if self.kind == "cauchy":
            return 0.5 * c2 * math.log1p(u2)
        if self.kind == "geman_mcclure":
            return 0.5 * c2 * u2 / (1.0 + u2)
        return c2 / 6.0 * (1.0 - (1.0 - min(u2, 1.0)) ** 3)


SIGMA_SCALES = {
    "sigma_scale": ("min_horizontal_sigma_m", "min_vertical_sigma_m", "min_sigma_m"),
    "angle_sigma_scale": ("min_sigma_deg",),
}
"""Keys of factors on the sigmas that a sensor's measurements come with, where it has them; and floors of these sigmas, which grow with them:
else a factor has no effect on what states less."""


class SensorConfig(Block):
    """What every sensor has."""

    apart_ns: ClassVar[int] = 0
    """Measurements that follow the one before within less tell nothing new, and are left out (`graphloc.signals.thinning`)."""

    kind: str
    """Which row of the sensor table reads this block."""
    topic: str = ""
    """Topic in the bag; empty for a sensor that needs none."""
    enabled: bool = True
    """Switch the sensor off without deleting its block."""
    mount: MountConfig = MountConfig()
    """Where the sensor sits on the vessel."""
    stamps: Literal["header", "recorded"] = "header"
    """When its messages were measured: `header`, as their headers say; `recorded`, when they were recorded, for a driver that
    leaves the headers' stamps empty. They are then late by as long as the message took, which no bound includes (but `stamp_sigma_s` of
    `gnss` and `aerial`); see `time_offset_s`."""
    time_offset_s: Annotated[float, Field(ge=-4e9, le=4e9)] = 0.0
    """Added to the sensor's stamps, s."""
    clock_drift_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    """By how much the sensor's clock runs fast, ppm: what it has gained since the bag began is taken off its stamps. Slow: negative. Not
    used by `graphloc stream`."""
    kernel: KernelConfig = KernelConfig()
    """Robust loss."""

    @property
    def tells_height(self) -> bool:
        """Whether its measurements say how high the vessel lies, in world."""
        return False

    @property
    def tells_place(self) -> bool:
        """Whether its measurements tell where the vessel is in the plane, or how it moves there; as far as their kind does."""
        return True

    @property
    def files(self) -> tuple[str, ...]:
        """The files that it names, for `VesselConfig.files`."""
        return ()

    @property
    def takes_turns(self) -> bool:
        """Whether it is one of those that read a receiver's fixes by turns (`VesselConfig.by_turns`)."""
        return False

    @property
    def synthetic_every_s(self) -> float:
        """Time between two of the measurements that the configuration makes itself (`Sensor.synthetic`), s."""
        return 1.0

    def scaled(self, times: Mapping[str, float]) -> Self:
        """Return the configuration with some of its numbers, by key, so many times as large; of a factor on sigmas, their floors too."""
        floors = {floor: by for key, by in times.items() for floor in SIGMA_SCALES.get(key, ()) if hasattr(self, floor)}
        return self.model_copy(update={key: getattr(self, key) * by for key, by in (floors | dict(times)).items()})

    def sigmas_over(self, stated: SensorConfig) -> dict[str, float]:
        """Return by key how many times its factors on sigmas are those of another configuration, where larger."""
        times = {key: getattr(self, key, 1.0) / getattr(stated, key, 1.0) for key in SIGMA_SCALES}
        return {key: by for key, by in times.items() if by > 1.0}
