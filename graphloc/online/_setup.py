# SPDX-License-Identifier: Apache-2.0
"""The setup of the online mode, and what follows from it: none of this changes with the measurements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from graphloc.build import mount_of, rows_of
from graphloc.config import ImuConfig, VesselConfig
from graphloc.frames import Datum, yaw_from_rotation
from graphloc.graph import Hint, Sensor
from graphloc.inertial import InertialRow
from graphloc.measurements import Measurement
from graphloc.recording import Mounts

# Keys of the settings that a sensor's slow state and constants are added to.
_ADDED_TO = {"mount", "cameras", "lidars", "time_offset_s", "survey", "height_m"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """The vessel, its sensors, and the length of the window.

    Attributes:
        config: the vessel, its surveys read. rows, inertial: the table of sensors.
        mounts: body -> sensor (t (3,), m; R (3, 3)) of sensors whose mount is not the configuration's (/tf_static).
        lag_s: length of the sliding window.
    """

    config: VesselConfig
    rows: tuple[Sensor, ...]
    inertial: InertialRow
    mounts: Mounts
    lag_s: float

    @cached_property
    def imu_name(self) -> str:
        """Name of the IMU; empty where none is enabled."""
        return next(iter(self.config.of_kind(self.inertial.kind)), "")

    @cached_property
    def imu(self) -> ImuConfig | None:
        """Configuration of the IMU; None where none is enabled."""
        found = self.config.sensors.get(self.imu_name)
        return found if isinstance(found, ImuConfig) else None

    @cached_property
    def bridge_s(self) -> float:
        """Longest IMU gap (s) that is bridged; after a longer one the estimate restarts."""
        return 0.0 if self.imu is None else self.imu.max_bridge_s

    @cached_property
    def gap_s(self) -> float:
        """Longest step (s) between IMU samples that is no gap."""
        return 0.0 if self.imu is None else self.imu.max_gap_s

    @cached_property
    def measuring(self) -> frozenset[str]:
        """Names of the enabled sensors, the IMU not among them."""
        kinds = {row.kind for row in self.rows}
        return frozenset(name for name, s in self.config.sensors.items() if s.enabled and s.kind in kinds)

    @cached_property
    def apart_ns(self) -> dict[str, int]:
        """By sensor in `measuring`, the time (ns) since the last measurement within which another tells nothing new."""
        return {name: self.config.sensors[name].apart_ns for name in self.measuring}

    @cached_property
    def absolute(self) -> tuple[str, ...]:
        """Names of the enabled sensors that measure position in world."""
        return tuple(name for name, row in rows_of(self.config, self.rows).items() if row.absolute)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """By enabled sensor, as plain data: axes of its slow state, and the settings that this and constants add to."""
        found = {}
        for name, row in rows_of(self.config, self.rows).items():
            sensor = self.config.sensors[name]
            slow = row.slow(sensor)
            added_to = sensor.model_dump(mode="json", include=_ADDED_TO)
            first = self.config.antenna_of(name)
            together = [n for n in self.config.sensors if self.config.antenna_of(n) == first]
            found[name] = {**added_to, "slow_axes": [] if slow is None else list(slow.axes), "antenna": together}
        return found

    def hint(self, m: Measurement, datum: Datum) -> Hint:
        """Return what a single measurement says of the body, without an estimate."""
        sensor = self.config.sensors[m.sensor]
        R = mount_of(m.sensor, sensor, self.mounts)[1]
        row = next(row for row in self.rows if row.kind == sensor.kind)
        return row.hint(m, float(yaw_from_rotation(R)), datum)

    def scaled(self, times: Mapping[str, Mapping[str, float]]) -> Setup:
        """Return the setup with settings multiplied by factors; `times`: by sensor and key of its configuration."""
        return replace(self, config=self.config.scaled(times))

    def without_start_heading(self) -> Setup:
        """Return the setup for a later start: the configured heading is that of the first start alone."""
        return replace(self, config=self.config.with_start_heading(None))
