# SPDX-License-Identifier: Apache-2.0
"""`vessel.yaml`: what may stand in it, its defaults, and its validation.

One class per block; each field carries its default, unit and meaning, and `docs/configuration.md`
is generated from them. Which sensor kinds exist is not known here: the caller hands in the table (`kinds`).
"""

from graphloc.config._file import effective, load_config, parse_config, with_changes
from graphloc.config._instruments import (
    STANDARD_GRAVITY_MPS2,
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    HeightConfig,
    ImuConfig,
    SlowErrorConfig,
    VelocityConfig,
)
from graphloc.config._poses import (
    AerialConfig,
    AnyPoseConfig,
    AprilTagConfig,
    CameraConfig,
    LidarConfig,
    PoseConfig,
    PoseSlowErrorConfig,
)
from graphloc.config._sensor import SIGMA_SCALES, KernelConfig, SensorConfig
from graphloc.config._vessel import DatumConfig, OutputConfig, StartConfig, TimelineConfig, VesselConfig

__all__ = [
    "SIGMA_SCALES",
    "STANDARD_GRAVITY_MPS2",
    "AerialConfig",
    "AnyPoseConfig",
    "AprilTagConfig",
    "BodyVelocityConfig",
    "CameraConfig",
    "CompassConfig",
    "DatumConfig",
    "GnssConfig",
    "HeightConfig",
    "ImuConfig",
    "KernelConfig",
    "LidarConfig",
    "OutputConfig",
    "PoseConfig",
    "PoseSlowErrorConfig",
    "SensorConfig",
    "SlowErrorConfig",
    "StartConfig",
    "TimelineConfig",
    "VelocityConfig",
    "VesselConfig",
    "effective",
    "load_config",
    "parse_config",
    "with_changes",
]
