# SPDX-License-Identifier: Apache-2.0
"""`vessel.yaml`: what may stand in it, its defaults, and its validation.

One class per block; each field carries its default, unit and meaning, and `docs/configuration.md`
is generated from them. Data-sheet units live here only, and become SI in the properties below.
Which sensor kinds exist is not known here: the caller hands in the table (`kinds`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from pydantic import Field, ValidationError, field_validator, model_validator

from graphloc.blocks import (
    Block,
    Finite,
    MountConfig,
    NonNegative,
    Positive,
    nearest,
    one_line,
    read_mapping,
)
from graphloc.errors import ConfigError
from graphloc.frames import Geodetic
from graphloc.measurements import AXES
from graphloc.survey import Survey

STANDARD_GRAVITY_MPS2 = 9.80665


class DatumConfig(Block):
    """Origin of the world frame; without this block it is the median of the first five fixes."""

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    """Latitude, deg, WGS 84."""
    longitude_deg: Annotated[float, Field(ge=-180.0, le=360.0)]
    """Longitude, deg, WGS 84."""
    height_m: Finite = 0.0
    """Height above the ellipsoid, m."""

    @property
    def geodetic(self) -> Geodetic:
        """The origin as a value."""
        return Geodetic(self.latitude_deg, self.longitude_deg, self.height_m)


class KernelConfig(Block):
    """Robust loss of a sensor. The last stage of the solver re-weighs by hypotheses where modes exist."""

    kind: Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"] = "cauchy"
    """Loss. Redescending kinds (geman_mcclure, tukey) are used in the last stage only: before, Cauchy."""
    scale: Positive = 1.5
    """Where the loss bends, in standard deviations of the residual."""

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

    def cost(self, nis: float) -> float:
        """Return what a residual costs under the loss: `nis` where that is small, less beyond the bend."""
        c2 = self.scale**2
        u2 = nis / c2
        if self.kind == "none":
            return nis
        if self.kind == "huber":
            return nis if u2 <= 1.0 else c2 * (2.0 * math.sqrt(u2) - 1.0)
        if self.kind == "cauchy":
            return c2 * math.log1p(u2)
        if self.kind == "geman_mcclure":
            return c2 * u2 / (1.0 + u2)
        return c2 / 3.0 * (1.0 - (1.0 - u2) ** 3 if u2 < 1.0 else 1.0)


class SensorConfig(Block):
    """What every sensor has."""

    kind: str
    """Which row of the sensor table reads this block."""
    topic: str = ""
    """Topic in the bag; empty for a sensor that needs none."""
    enabled: bool = True
    """Switch the sensor off without deleting its block."""
    mount: MountConfig = MountConfig()
    """Where the sensor sits on the vessel."""
    time_offset_s: Annotated[float, Field(ge=-4e9, le=4e9)] = 0.0
    """Added to the sensor's stamps, s."""
    kernel: KernelConfig = KernelConfig()
    """Robust loss."""


class ImuConfig(SensorConfig):
    """An inertial measurement unit (`sensor_msgs/Imu`)."""

    kind: Literal["imu"] = "imu"
    """Which row of the sensor table reads this block."""
    accel_unit: Literal["m/s^2", "g"] = "m/s^2"
    """Unit of `linear_acceleration` in the bag (REP 103 says m/s^2; some drivers write g)."""
    gyro_unit: Literal["rad/s", "deg/s"] = "rad/s"
    """Unit of `angular_velocity` in the bag."""
    gravity: Literal["included", "removed", "inverted"] = "included"
    """Whether `linear_acceleration` holds gravity (+g upwards at rest, the standard), or the driver removed it; `inverted`:
    the driver writes accelerations with the opposite sign (-g upwards at rest), while its gyroscope is right."""
    accel_noise_ug_per_sqrt_hz: Positive = 3000.0
    """Accelerometer white noise, ug/sqrt(Hz). The default allows for hull vibration."""
    gyro_noise_mdps_per_sqrt_hz: Positive = 20.0
    """Gyroscope white noise, mdeg/s/sqrt(Hz)."""
    accel_bias_instability_ug: Positive = 100.0
    """In-run accelerometer bias instability, ug."""
    gyro_bias_instability_deg_per_h: Positive = 20.0
    """In-run gyroscope bias instability, deg/h."""
    bias_correlation_s: Positive = 300.0
    """Time over which a bias wanders by its instability, s."""
    accel_bias_sigma_mg: Positive = 10.0
    """Turn-on accelerometer bias, 1 sigma, mg."""
    gyro_bias_sigma_dps: Positive = 2.0
    """Turn-on gyroscope bias, 1 sigma, deg/s, before the start alignment has measured it."""
    adapt_noise: bool = True
    """Scale the noise up (never down, and said in the report) where the run contradicts it several times over."""
    max_gap_s: Positive = 0.5
    """A longer hole between samples is an IMU gap: bridged by a link with noise that lets a vessel do anything."""
    max_bridge_s: Positive = 20.0
    """A longer gap is not bridged: the run is cut there, and its parts are solved one by one."""
    kernel: KernelConfig = KernelConfig(kind="none")
    """Robust loss: not used for inertial data."""

    @property
    def accel_noise_mps2(self) -> float:
        """White-noise density, m/s^2/sqrt(Hz)."""
        return self.accel_noise_ug_per_sqrt_hz * 1e-6 * STANDARD_GRAVITY_MPS2

    @property
    def gyro_noise_radps(self) -> float:
        """White-noise density, rad/s/sqrt(Hz)."""
        return float(np.radians(self.gyro_noise_mdps_per_sqrt_hz * 1e-3))

    @property
    def accel_bias_walk_mps2(self) -> float:
        """Random-walk density of the accelerometer bias, m/s^2/sqrt(s)."""
        return self.accel_bias_instability_ug * 1e-6 * STANDARD_GRAVITY_MPS2 / float(np.sqrt(self.bias_correlation_s))

    @property
    def gyro_bias_walk_radps(self) -> float:
        """Random-walk density of the gyroscope bias, rad/s/sqrt(s)."""
        return float(np.radians(self.gyro_bias_instability_deg_per_h / 3600.0) / np.sqrt(self.bias_correlation_s))

    @property
    def accel_bias_sigma_mps2(self) -> float:
        """Turn-on bias, 1 sigma, m/s^2."""
        return self.accel_bias_sigma_mg * 1e-3 * STANDARD_GRAVITY_MPS2

    @property
    def gyro_bias_sigma_radps(self) -> float:
        """Turn-on bias, 1 sigma, rad/s."""
        return float(np.radians(self.gyro_bias_sigma_dps))


class SlowErrorConfig(Block):
    """The slowly varying part of the GNSS error: a first-order Gauss-Markov process per axis."""

    enabled: bool | None = None
    """Off: the GNSS error is taken as white (right for RTK in the open, wrong in a harbour). Empty: on where
    a second absolute sensor (matches, tags, another receiver) can tell it from motion, off where GNSS is alone."""
    horizontal_sigma_m: Positive = 2.0
    """Standing size of the slow error, each horizontal axis, 1 sigma, m."""
    vertical_sigma_m: Positive = 5.0
    """Standing size of the slow error in height, 1 sigma, m."""
    time_constant_s: Positive = 200.0
    """Correlation time, s."""
    jumps: bool = True
    """Let the slow error jump (a robust loss on its steps), as multipath does."""


class GnssConfig(SensorConfig):
    """GNSS position (`sensor_msgs/NavSatFix`)."""

    kind: Literal["gnss"] = "gnss"
    """Which row of the sensor table reads this block."""
    min_status: Literal["fix", "sbas", "gbas"] = "fix"
    """Fixes below this `NavSatStatus` are rejected. `STATUS_NO_FIX` never counts as a fix."""
    sigma_scale: Positive = 1.0
    """Factor on the reported standard deviations, for the white part of the error."""
    min_horizontal_sigma_m: Positive = 0.02
    """Floor of the white horizontal sigma, m."""
    min_vertical_sigma_m: Positive = 0.04
    """Floor of the white vertical sigma, m."""
    default_horizontal_sigma_m: Positive = 1.5
    """Taken where the message reports no covariance (type unknown, zeros or NaN), m."""
    default_vertical_sigma_m: Positive = 4.0
    """The same for height, m."""
    slow_error: SlowErrorConfig = SlowErrorConfig()
    """The modelled slow error."""


class CompassConfig(SensorConfig):
    """Heading (`geometry_msgs/QuaternionStamped`, or the orientation of a `sensor_msgs/Imu`)."""

    kind: Literal["compass"] = "compass"
    """Which row of the sensor table reads this block."""
    convention: Literal["enu", "ned"] = "enu"
    """Yaw in the message: `enu` from east, counter-clockwise (REP 103); `ned` from north, clockwise."""
    sigma_deg: Positive = 1.5
    """Heading noise, 1 sigma, deg. Used where the message carries no covariance."""
    use_reported_sigma: bool = True
    """Take the yaw variance of an `Imu` message where it is positive and finite."""
    mount_offset_sigma_deg: NonNegative = 1.0
    """Unknown but constant heading offset of the mount, 1 sigma, deg; 0 holds the mount fixed."""


class VelocityConfig(SensorConfig):
    """GNSS velocity in ENU (`geometry_msgs/TwistWithCovarianceStamped` or `TwistStamped`)."""

    kind: Literal["gnss_velocity"] = "gnss_velocity"
    """Which row of the sensor table reads this block."""
    min_sigma_mps: Positive = 0.03
    """Floor of the velocity sigma, m/s."""
    default_sigma_mps: Positive = 0.3
    """Taken where the message reports no covariance, m/s."""


class AnyPoseConfig(SensorConfig):
    """What every sensor has that gives poses in world, with modes or false ones among them."""

    axes: tuple[Literal["x", "y", "z", "roll", "pitch", "yaw"], ...] = ("x", "y", "yaw")
    """Which axes of the pose are used."""
    false_fraction: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    """Share of poses that are expected to be false where the front-end does not say."""
    false_repeats: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.5
    """Probability that a false pose after a false pose repeats its error (a moored boat stays)."""
    min_sigma_m: Positive = 0.02
    """Floor of the position sigma, m."""
    min_sigma_deg: Positive = 0.1
    """Floor of the angle sigma, deg."""
    default_sigma_m: Positive = 0.3
    """Taken where the message reports no covariance, m."""
    default_sigma_deg: Positive = 2.0
    """The same for angles, deg."""

    @field_validator("axes")
    @classmethod
    def _ordered(cls, axes: tuple[str, ...]) -> tuple[str, ...]:
        if not axes:
            raise ValueError("at least one axis is needed")
        if ("roll" in axes) != ("pitch" in axes):
            raise ValueError(
                "roll and pitch go together: which of the world's axes one of them is, the heading decides"
            )
        return tuple(a for a in AXES if a in axes)


class PoseConfig(AnyPoseConfig):
    """Absolute pose in world (`geometry_msgs/PoseWithCovarianceStamped`, `nav_msgs/Odometry`)."""

    kind: Literal["pose"] = "pose"
    """Which row of the sensor table reads this block."""


class LidarConfig(Block):
    """A LiDAR whose scans are matched."""

    topic: str
    """Its `sensor_msgs/PointCloud2` topic."""
    mount: MountConfig = MountConfig()
    """Where it sits on the vessel."""


class AerialConfig(AnyPoseConfig):
    """LiDAR scans (`sensor_msgs/PointCloud2`) laid on an aerial image, drawn lines, or both."""

    kind: Literal["aerial"] = "aerial"
    """Which row of the sensor table reads this block."""
    axes: tuple[Literal["x", "y", "yaw"], ...] = ("x", "y", "yaw")
    """Which axes of a match are used."""
    image: str = ""
    """A georeferenced image that GDAL reads, an MBTiles file, or a folder of tiles z/x/y.png, jpg or webp; a relative
    path counts from the folder of vessel.yaml."""
    vector: str = ""
    """GeoJSON of lines and polygons of quays, piers and shores; a relative path counts as that of the image."""
    image_sigma_m: NonNegative = 0.3
    """How far the image as a whole shows things from where they are, east and north, 1 sigma, m."""
    lidars: dict[str, LidarConfig] = Field(default_factory=dict)
    """The LiDARs by name."""
    hull_m: tuple[tuple[Finite, Finite], ...] = ()
    """Corners of the vessel's outline in body, forward and port, in order, m: points within are its own; none: no
    point is."""
    waterline_m: Finite = 0.0
    """Height of the waterline in body, m."""
    matcher: Literal["posterior", "bl"] = "posterior"
    """`bl`: that of Bergman & Lindell as printed (one pose, by a particle swarm), to compare with; it needs an image."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of the particle swarm."""
    submap: Annotated[int, Field(ge=1, le=100)] = 1
    """So many scans are laid on the map together, moved by the vessel's own motion between them."""
    every_s: Positive = 1.0
    """Least time between two matches, s."""
    every_m: NonNegative = 0.5
    """Least way between two matches, m."""
    alike_m: NonNegative = 15.0
    """Matches within this way of each other err alike (the same walls, the same boats), so each tells but a part of
    news: variances grow by (1 + r) / (1 - r), r = exp(-way / alike_m), or less after a while; 0: each is news, m."""
    still_s: Positive = 10.0
    """Time after which there is a match though the vessel has not moved that far, s."""
    window_m: Annotated[Positive, Field(le=50.0)] = 6.5
    """Largest half side of the search, at most 50 m; less where the estimate is surer (3 sigma)."""
    window_deg: Annotated[Positive, Field(le=30.0)] = 5.0
    """The same for the heading, at most 30 deg."""
    reach_m: Annotated[Positive, Field(le=300.0)] = 100.0
    """Points farther off are not used; at most 300 m."""

    @field_validator("topic", "mount")
    @classmethod
    def _of_the_lidars(cls, given: str | MountConfig) -> str | MountConfig:
        if given not in ("", MountConfig()):
            raise ValueError("not used here, a match is the pose of the body: set it for each of `lidars`")
        return given

    @field_validator("lidars")
    @classmethod
    def _one_topic_each(cls, lidars: dict[str, LidarConfig]) -> dict[str, LidarConfig]:
        seen: dict[str, str] = {}
        for name, lidar in lidars.items():
            if lidar.topic in seen:
                raise ValueError(f"{seen[lidar.topic]} and {name} have the same topic, {lidar.topic}")
            seen[lidar.topic] = name
        return lidars

    @field_validator("hull_m")
    @classmethod
    def _outline(cls, corners: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        if not corners:
            return corners
        if len(corners) < 3:
            raise ValueError("an outline has three corners or more; [] for none")
        why = shapely.is_valid_reason(shapely.Polygon(corners))
        if why != "Valid Geometry":
            raise ValueError(f"the corners, in their order, make no outline: {why}")
        return corners


class CameraConfig(Block):
    """A camera that sees tags; or a detector that has listed them already."""

    topic: str
    """Images (`sensor_msgs/Image`, `CompressedImage`), or detections (`apriltag_msgs/AprilTagDetectionArray`, ROS 1's
    `apriltag_ros/AprilTagDetectionArray`)."""
    info_topic: str = ""
    """Its `sensor_msgs/CameraInfo`; empty: `camera_info` beside the images."""
    rectified: bool | None = None
    """Whether distortion is removed from the images already (`image_rect`); empty: by the topic's name for images,
    true for detections, which are made on such images."""
    mount: MountConfig = MountConfig()
    """Pose of the optical frame (x right, y down, z forward) in body: looking ahead is `rpy_deg: [-90, 0, -90]`."""


class AprilTagConfig(SensorConfig):
    """AprilTags seen by cameras: the two poses of each sighting are kept, and the graph chooses."""

    kind: Literal["apriltag"] = "apriltag"
    """Which row of the sensor table reads this block."""
    survey: str | Survey = ""
    """Where the tags are: a `tags.yaml` (docs/tags.md); a relative path counts from the folder of vessel.yaml."""
    cameras: dict[str, CameraConfig] = Field(default_factory=dict)
    """The cameras by name."""
    max_hamming: Annotated[int, Field(ge=0, le=3)] = 1
    """Most bits of a tag that may be read wrong."""
    min_margin: NonNegative = 1.5
    """Least decision margin (AprilTag's: how far bits are from the threshold, grey levels)."""
    min_corner_sigma_px: NonNegative = 0.2
    """Floor of the corners' noise in the graph, each axis, 1 sigma, px: what calibration and stamps are off (a vessel
    that turns by 5 deg/s moves corners by 0.5 px in 5 ms at a focal length of 1000 px)."""
    edge_sigma_px: NonNegative = 0.05
    """How far the edges of all tags are seen too far out (or in) for half a minute: blur, light, prints, focal length, 1 sigma,
    px. A tag 12 px wide whose edges are off by 0.05 px is 0.8 % nearer than it seems, in every image; 0: not modelled."""
    corner_sigma_px: Positive = 0.5
    """Noise of the corners of listed detections, each axis, 1 sigma, px; our own detector measures it."""
    false_fraction: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    """Share of sightings that are expected to be false: misread, or of a tag that was moved."""
    false_repeats: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.9
    """Probability that a false sighting after a false one repeats its error (a moved tag stays moved)."""
    kernel: KernelConfig = KernelConfig(kind="none")
    """Robust loss: not used; that a sighting is false is a hypothesis of its own."""

    @field_validator("topic", "mount")
    @classmethod
    def _of_the_cameras(cls, given: str | MountConfig) -> str | MountConfig:
        if given not in ("", MountConfig()):
            raise ValueError("not used here: set it for each of `cameras`")
        return given

    @property
    def surveyed(self) -> Survey:
        """The survey, once it is read; before that one without tags."""
        return self.survey if isinstance(self.survey, Survey) else Survey()


class HeightConfig(SensorConfig):
    """Height prior: a vessel floats, so its height is known from waterline and tide."""

    kind: Literal["height"] = "height"
    """Which row of the sensor table reads this block."""
    height_m: Finite | None = None
    """Height of the body origin above the ellipsoid, m; empty: the median of the run's fixes."""
    sigma_m: Positive = 0.3
    """Heave around it, 1 sigma, m."""
    tide_sigma_m: NonNegative = 0.5
    """How far tide and load may hold the vessel above or below it, for hours, 1 sigma, m; 0: not at all."""
    period_s: Annotated[float, Field(ge=0.02, le=1e6)] = 1.0
    """Time between two priors, s."""
    kernel: KernelConfig = KernelConfig(kind="none")
    """Robust loss: not used for the waterline."""


class TimelineConfig(Block):
    """The states of the graph."""

    rate_hz: Annotated[float, Field(gt=0.5, le=200.0)] = 10.0
    """States a second; a state moves onto a measurement's stamp where one is near."""
    slow_period_s: Annotated[float, Field(ge=0.05, le=1e6)] = 1.0
    """Time between two states of the slow quantities (IMU bias, GNSS error), s."""


class StartConfig(Block):
    """How the run is started."""

    window_s: Positive = 20.0
    """Span that the start alignment may look at, s."""
    heading_deg: Finite | None = None
    """Compass heading at the start (from true north, clockwise), where no sensor tells, deg."""
    heading_sigma_deg: Positive = 10.0
    """Its 1 sigma, deg."""


class OutputConfig(Block):
    """What is written to the run folder."""

    rate_hz: Annotated[float, Field(gt=0.0, le=1e4)] = 10.0
    """Rows a second in the solution."""
    bag: bool = True
    """Write `solution_bag/`, a bag with `nav_msgs/Odometry`."""
    map_image: str = ""
    """Georeferenced image under the report's map, a path as that of an aerial sensor; none: that of the first such sensor."""


class VesselConfig(Block):
    """A whole `vessel.yaml`."""

    vessel: str = "vessel"
    """Name of the vessel, for the report."""
    body_frame: str = "base_link"
    """Name of the body frame in `/tf_static` and in the written bag."""
    datum: DatumConfig | None = None
    """Origin of the world frame."""
    sensors: dict[str, Any] = Field(default_factory=dict)
    """Sensors by name; `kind` in each block picks the row of the sensor table."""
    truth_topic: str | None = None
    """Topic with the true body pose in world (`nav_msgs/Odometry`), for comparisons only; never fused."""
    check_speed_topic: str | None = None
    """`nav_msgs/Odometry` whose forward speed is compared with the solution's; never fused."""
    timeline: TimelineConfig = TimelineConfig()
    """The states of the graph."""
    start: StartConfig = StartConfig()
    """How the run is started."""
    output: OutputConfig = OutputConfig()
    """What is written."""

    @model_validator(mode="after")
    def _one_imu(self) -> VesselConfig:
        if len(self.of_kind("imu")) > 1:
            raise ValueError(f"sensors: only one imu can be enabled, found {', '.join(self.of_kind('imu'))}")
        return self

    def of_kind(self, kind: str) -> dict[str, Any]:
        """Return the enabled sensors of a kind, by name."""
        return {n: s for n, s in self.sensors.items() if getattr(s, "kind", None) == kind and s.enabled}


def parse_config(raw: Mapping[str, Any], kinds: Mapping[str, type[SensorConfig]], where: str) -> VesselConfig:
    """Validate a mapping. `kinds` is the sensor table's kind -> config class; `where` names the file.

    Raises:
        ConfigError: one line that names each bad key, its nearest known neighbour, and the file.
    """
    tree = dict(raw)
    sensors = tree.get("sensors") or {}
    if not isinstance(sensors, Mapping):
        raise ConfigError(f"{where}: 'sensors' must be a mapping of name to block")
    parsed: dict[str, SensorConfig] = {}
    for name, block in sensors.items():
        if not isinstance(block, Mapping):
            raise ConfigError(f"{where}: sensors.{name} must be a mapping")
        kind = str(block.get("kind", name))
        if kind not in kinds:
            raise ConfigError(f"{where}: sensors.{name}.kind: unknown kind '{kind}'{nearest(kind, list(kinds))}")
        try:
            parsed[str(name)] = kinds[kind].model_validate({**block, "kind": kind})
        except ValidationError as error:
            raise ConfigError(one_line(error, kinds[kind], where, f"sensors.{name}")) from None
    tree["sensors"] = parsed
    try:
        return VesselConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(one_line(error, VesselConfig, where, "")) from None


def load_config(
    path: Path, kinds: Mapping[str, type[SensorConfig]], changes: Mapping[str, object] = MappingProxyType({})
) -> VesselConfig:
    """Read and validate a `vessel.yaml`, some of its keys changed (see `with_changes`)."""
    raw = read_mapping(path, "; `graphloc inspect BAG` writes a first one")
    return parse_config(with_changes(raw, changes, str(path)), kinds, str(path))


def with_changes(raw: Mapping[str, Any], changes: Mapping[str, object], where: str) -> dict[str, Any]:
    """Return a configuration, not yet validated, with keys set that are written with dots (`sensors.gnss.sigma_scale`).

    Raises:
        ConfigError: it has no such sensor, or the way to a key leads through a value.
    """
    tree = copy.deepcopy(dict(raw))
    for key, value in changes.items():
        *way, last = key.split(".")
        sensors = tree.get("sensors")
        known = list(sensors) if isinstance(sensors, Mapping) else []
        if way[:1] == ["sensors"] and (name := [*way, last][1]) not in known:
            raise ConfigError(f"{where}: {key}: there is no sensor '{name}'{nearest(name, known)}")
        block: Any = tree
        for name in way:
            if block.get(name) is None:
                block[name] = {}
            block = block[name]
            if not isinstance(block, dict):
                raise ConfigError(f"{where}: {key}: '{name}' is a value, and holds no keys")
        block[last] = value
    return tree


def effective(config: VesselConfig) -> dict[str, Any]:
    """Return the whole configuration, defaults included, as plain data for `run.json` and YAML."""
    tree = config.model_dump(mode="json")
    tree["sensors"] = {name: sensor.model_dump(mode="json") for name, sensor in config.sensors.items()}
    return tree
