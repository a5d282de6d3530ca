# SPDX-License-Identifier: Apache-2.0
"""Table of sensors. A sensor is a class of measurements, a configuration, a file here, and one entry in the table.

Sensors of other packages join it by entry points (docs/adding-a-sensor.md).
"""

from graphloc.config import SensorConfig
from graphloc.errors import ConfigError
from graphloc.extras import added
from graphloc.factors import aerial, apriltag, body_velocity, compass, gnss, height, imu, pose, velocity
from graphloc.graph import Sensor

GROUP = "graphloc.sensors"  # of entry points: their name is the kind
INERTIAL = imu.ROW
_OURS: tuple[Sensor, ...] = (
    gnss.ROW, compass.ROW, velocity.ROW, body_velocity.ROW, pose.ROW, aerial.ROW, apriltag.ROW, height.ROW,
)  # fmt: skip


def _theirs() -> tuple[Sensor, ...]:
    """Return the rows of installed packages.

    Raises:
        ConfigError: an entry is not a row, its configuration is none, its kind differs from the name of the entry point, or its kind is taken.
    """
    taken = {INERTIAL.kind, *(row.kind for row in _OURS)}
    for name, row in added(GROUP).items():
        is_row = isinstance(row, Sensor)
        configured = is_row and isinstance(row.config, type) and issubclass(row.config, SensorConfig)
        if not configured or row.kind != name or name in taken:
            why = (
                f"is a {type(row).__name__}, no Sensor" if not is_row
                else "the configuration of its row is no SensorConfig" if not configured
                else f"its row is of kind '{row.kind}'" if row.kind != name else "graphloc has that kind itself"
            )  # fmt: skip
            raise ConfigError(f"{GROUP}: '{name}': {why}: mend or uninstall the package that adds it")
    return tuple(added(GROUP).values())


SENSORS: tuple[Sensor, ...] = (*_OURS, *_theirs())
KINDS: dict[str, type[SensorConfig]] = {INERTIAL.kind: INERTIAL.config, **{row.kind: row.config for row in SENSORS}}

__all__ = ["INERTIAL", "KINDS", "SENSORS"]
