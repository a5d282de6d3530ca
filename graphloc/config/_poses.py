# SPDX-License-Identifier: Apache-2.0
"""Sensors that give whole poses: messages, scans laid on a map, tags."""

from __future__ import annotations

from typing import Annotated, Literal

import shapely
from pydantic import Field, field_validator, model_validator

from graphloc.blocks import Block, Finite, MountConfig, NonNegative, Positive
from graphloc.config._sensor import KernelConfig, SensorConfig
from graphloc.measurements import AXES
from graphloc.survey import Survey


class AnyPoseConfig(SensorConfig):
    """What every sensor has that gives poses in world, with modes or false ones among them."""

    axes: tuple[Literal["x", "y", "z", "roll", "pitch", "yaw"], ...] = ("x", "y", "yaw")
    """Which axes of the pose are used."""
    false_fraction: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    """Expected share of false poses, if the message or matcher does not say."""
    false_repeats: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.5
    """Probability that a false pose repeats the error of the false pose before it (a moored boat stays)."""
    sigma_scale: Positive = 1.0
    """Factor on the position sigmas that a pose or match comes with."""
    angle_sigma_scale: Positive = 1.0
    """The same for angles."""
    min_sigma_m: Positive = 0.02
    """Floor of the position sigma, m."""
    min_sigma_deg: Positive = 0.1
    """Floor of the angle sigma, deg."""
    default_sigma_m: Positive = 0.3
    """Position sigma if the message reports no covariance, m."""
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

    @property
    def tells_place(self) -> bool:
        """Where x or y is used: no depth, and no heading alone."""
        return "x" in self.axes or "y" in self.axes

    @property
    def tells_height(self) -> bool:
        """Where z is used."""
        return "z" in self.axes


class PoseSlowErrorConfig(Block):
    """The slowly varying part of the error of poses: a first-order Gauss-Markov process per axis."""

    sigma_m: NonNegative = 0.0
    """Its stationary sigma, each axis of position, m; 0: there is none."""
    sigma_deg: NonNegative = 0.0
    """The same for yaw, deg."""
    time_constant_s: Positive = 60.0
    """Correlation time, s."""

    @model_validator(mode="after")
    def _of_some_size(self) -> PoseSlowErrorConfig:
        usual = type(self).model_fields["time_constant_s"].default  # an effective configuration states it, too
        if self.time_constant_s != usual and self.sigma_m == self.sigma_deg == 0.0:
            raise ValueError("time_constant_s is of no error: set sigma_m or sigma_deg, too, or delete it")
        return self


class PoseConfig(AnyPoseConfig):
    """Absolute pose in world (`geometry_msgs/PoseWithCovarianceStamped`, `PoseStamped`, `TransformStamped`, `PointStamped` (x, y, z), `nav_msgs/Odometry`).

    Of a point only x, y and z can be used (`axes`).
    """

    kind: Literal["pose"] = "pose"
    """The sensor kind."""
    slow_error: PoseSlowErrorConfig = PoseSlowErrorConfig()
    """An error that poses share for a while, as those of USBL, UWB or another filter's output do; estimated with the run. By default there is
    none: errors are independent from pose to pose."""


class LidarConfig(Block):
    """A LiDAR whose scans are matched."""

    topic: str
    """Its topic, of `sensor_msgs/PointCloud2` or Livox's `CustomMsg`."""
    mount: MountConfig = MountConfig()
    """Where it sits on the vessel."""


class AerialConfig(AnyPoseConfig):
    """LiDAR scans (`sensor_msgs/PointCloud2`, Livox's `CustomMsg`) matched to an aerial image, drawn lines, or both."""

    kind: Literal["aerial"] = "aerial"
    """The sensor kind."""
    axes: tuple[Literal["x", "y", "yaw"], ...] = ("x", "y", "yaw")
    """Which axes of a match are used."""
    image: str = ""
    """A georeferenced image that GDAL reads, an MBTiles file, or a folder of tiles z/x/y.png, jpg or webp; a relative
    path starts at the folder of vessel.yaml."""
    vector: str = ""
    """GeoJSON of lines and polygons of quays, piers and shores; path as for `image`."""
    image_sigma_m: NonNegative = 0.3
    """Misregistration of the image as a whole, east and north, 1 sigma, m."""
    mount_sigma_deg: NonNegative = 1.0
    """Yaw error of all matches alike (mounts of the LiDARs, rotation of the image), 1 sigma, deg; it is estimated. A mount
    measured by hand is off by a degree or two. 0: taken as given."""
    stamp_sigma_s: NonNegative = 0.05
    """Unknown delay of its stamps beyond `time_offset_s`, 1 sigma, s; it is estimated with the run, one for all of its LiDARs. Drivers stamp a
    scan at its begin or its end, 0.1 s later, or on arrival. 0: stamps are right."""
    lidars: dict[str, LidarConfig] = Field(default_factory=dict)
    """The LiDARs by name."""
    hull_m: tuple[tuple[Finite, Finite], ...] = ()
    """Corners of the vessel's outline in body, [forward, port], in order, m: points inside are ignored as its own; none: no
    point is."""
    waterline_m: Finite = 0.0
    """Height of the waterline in body, m."""
    matcher: Literal["posterior", "bl"] = "posterior"
    """`bl`: the matcher of Bergman & Lindell as printed (one pose, by a particle swarm), for comparison; it needs an image."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Random seed of the particle swarm (`bl`)."""
    submap: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of consecutive scans combined for one match, motion-compensated: where drivers publish parts of a turn, the number of
    parts."""
    submap_s: Annotated[NonNegative, Field(le=60.0)] = 15.0
    """What was seen around a scan in so many seconds, half of them before and half after it, from places at least 0.5 m and 0.5 s apart,
    is matched with it, s; at most 60. Where boats look alike, a longer piece of a row does not. All scans are matched twice, alone at
    first; 0: once, alone. Not online, and not with `matcher: bl`."""
    every_s: Positive = 1.0
    """Minimum time between two matches, s."""
    every_m: NonNegative = 0.5
    """Minimum distance travelled between two matches, m."""
    alike_m: NonNegative = 15.0
    """Least correlation length of matches (the same walls, the same boats), m; it is the median distance to what is in view, if
    that is longer. Their errors and which mode looks right count as far as they are news; 0: independent."""
    still_s: Positive = 10.0
    """Time after which a match is made although the vessel has not moved by `every_m`, s."""
    window_m: Annotated[Positive, Field(le=50.0)] = 6.5
    """Largest half width of the search window, at most 50 m; smaller if 3 sigma of the estimate is."""
    window_deg: Annotated[Positive, Field(le=30.0)] = 30.0
    """The same for the heading, at most 30 deg."""
    reach_m: Annotated[Positive, Field(le=300.0)] = 100.0
    """Points beyond this range are not used; at most 300 m."""

    @property
    def around_s(self) -> float:
        """How far off in time scans may be that are matched together, s; BL matches single ones."""
        return 0.5 * self.submap_s if self.matcher == "posterior" else 0.0

    @property
    def files(self) -> tuple[str, ...]:
        """Image and lines."""
        return self.image, self.vector

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
    """A camera that sees tags, or a topic of detections made from its images."""

    topic: str
    """Images (`sensor_msgs/Image`, `CompressedImage`), or detections (`apriltag_msgs/AprilTagDetectionArray`, ROS 1's
    `apriltag_ros/AprilTagDetectionArray`)."""
    info_topic: str = ""
    """Its `sensor_msgs/CameraInfo`; empty: `camera_info` beside the images."""
    rectified: bool | None = None
    """Whether distortion has been removed already (`image_rect`); empty: by the topic's name for images,
    true for detections, which are made on such images."""
    mount: MountConfig = MountConfig()
    """Pose of the optical frame (x right, y down, z forward) in body: looking ahead is `rpy_deg: [-90, 0, -90]`."""
    mount_sigma_deg: NonNegative = 1.0
    """Attitude error of the mount, about each axis, 1 sigma, deg; it is estimated. A mount measured by
    hand is off by a degree or two, and 1 deg at 20 m is 0.35 m. 0: taken as given."""
    stamp_sigma_s: NonNegative = 0.03
    """Unknown delay of its stamps beyond `time_offset_s`, 1 sigma, s; it is estimated. Drivers stamp images on
    arrival, 0.02 to 0.1 s after the exposure; a vessel that rolls at 5 deg/s turns by 0.5 deg in 0.1 s."""


class AprilTagConfig(SensorConfig):
    """AprilTags seen by cameras: the two poses of each sighting are kept, and the graph chooses."""

    kind: Literal["apriltag"] = "apriltag"
    """The sensor kind."""
    survey: str | Survey = ""
    """The survey of the tags: a `tags.yaml` (docs/tags.md); a relative path starts at the folder of vessel.yaml."""
    cameras: dict[str, CameraConfig] = Field(default_factory=dict)
    """The cameras by name."""
    max_hamming: Annotated[int, Field(ge=0, le=3)] = 1
    """Largest number of misread bits accepted."""
    min_margin: NonNegative = 1.5
    """Smallest decision margin accepted (as AprilTag's: distance of the bits from the threshold, grey levels)."""
    min_corner_sigma_px: NonNegative = 0.2
    """Floor of the corner noise in the graph, each axis, 1 sigma, px, for errors of calibration and stamps (a vessel
    that turns at 5 deg/s moves corners by 0.5 px in 5 ms at a focal length of 1000 px)."""
    edge_sigma_px: NonNegative = 0.05
    """Common outward (or inward) shift of the edges of all tags, correlated over half a minute, 1 sigma, px: blur, light, print,
    focal length. 0.05 px on a tag 12 px wide makes it appear 0.8 % too near, in every image; 0: not
    modelled."""
    corner_sigma_px: Positive = 0.5
    """Corner noise of detections from the bag, each axis, 1 sigma, px; the built-in detector measures its own."""
    false_fraction: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    """Expected share of false sightings: misread, or of a tag that was moved."""
    false_repeats: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.9
    """Probability that a false sighting repeats the error of the false one before it (a moved tag stays moved)."""
    kernel: KernelConfig = KernelConfig(kind="none")
    """Robust loss: not used; false sightings are a hypothesis of their own."""

    @field_validator("topic", "mount")
    @classmethod
    def _of_the_cameras(cls, given: str | MountConfig) -> str | MountConfig:
        if given not in ("", MountConfig()):
            raise ValueError("not used here: set it for each of `cameras`")
        return given

    @property
    def files(self) -> tuple[str, ...]:
        """Its survey, while it is not read."""
        return (self.survey,) if isinstance(self.survey, str) else ()

    @property
    def surveyed(self) -> Survey:
        """The survey, once it is read; before that one without tags."""
        return self.survey if isinstance(self.survey, Survey) else Survey()

    @property
    def tells_height(self) -> bool:
        """By the survey of its tags."""
        return True
