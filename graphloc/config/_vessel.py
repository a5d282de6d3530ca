# SPDX-License-Identifier: Apache-2.0
"""A whole `vessel.yaml`, and its blocks that are no sensors."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations, product
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from graphloc.blocks import Block, Finite, MountConfig, Positive
from graphloc.config._sensor import SensorConfig
from graphloc.frames import Array, Geodetic


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


class TimelineConfig(Block):
    """The states of the graph."""

    rate_hz: Annotated[float, Field(gt=0.5, le=200.0)] = 10.0
    """States per second; a state is moved onto the stamp of a measurement close by. With fewer than 2.5 a vessel goes decimetres from a
    state to a measurement, a way that is taken as estimated: too coarse for RTK and tags."""
    slow_period_s: Annotated[float, Field(ge=0.05, le=60.0)] = 1.0
    """Time between two states of slow quantities (IMU bias, GNSS error), s. Online from some 2 s on fixes are believed much less,
    as their slow error walks unseen in between."""
    leg_s: Annotated[float, Field(ge=60.0)] = 1800.0
    """Offline, a longer run is solved in legs of about this length that overlap by two minutes; memory grows with a leg, s."""


class StartConfig(Block):
    """How the run is started."""

    window_s: Positive = 20.0
    """Longest span of data for the start alignment, s."""
    heading_deg: Finite | None = None
    """Heading at the start (from true north at the datum, clockwise) if no sensor measures it, deg."""
    heading_sigma_deg: Positive = 10.0
    """Its 1 sigma, deg."""


class OutputConfig(Block):
    """What is written to the run folder, and what is called good."""

    good_bound_m: Annotated[float, Field(gt=0.0, le=25.0)] = 2.5
    """A pose whose 95 % bound is larger is `degraded`, m. DNV asks for 2.5 m in port (Digerud); in open water more may do."""
    rate_hz: Annotated[float, Field(gt=0.0, le=1e4)] = 10.0
    """Rows per second in the solution."""
    bag: bool = True
    """Write `solution_bag/`, a bag with `nav_msgs/Odometry`."""
    map_image: str = ""
    """Georeferenced image under the report's map, path as for an aerial sensor; empty: that of the first such sensor."""


def _read_alike(a: Any, b: Any) -> bool:
    """Whether two sensors of a kind and topic read the same messages, or a sentence in common (`GGA` is that of any talker, also `GPGGA`).

    Of a velocity, one may read what is over ground, the other what is through the water; of a receiver, one its RTK, the other the rest.
    """
    if getattr(a, "through", "") != getattr(b, "through", ""):
        return False
    if {getattr(a, "fixes", "any"), getattr(b, "fixes", "any")} == {"rtk", "other"}:
        return False
    pairs = list(product(getattr(a, "nmea", ()), getattr(b, "nmea", ())))
    return not pairs or any(one.endswith(other) or other.endswith(one) for one, other in pairs)


_OF_AN_ANTENNA = ("mount", "mount_sigma_m")


class VesselConfig(Block):
    """A whole `vessel.yaml`."""

    vessel: str = "vessel"
    """Name of the vessel, for the report."""
    body_frame: str = "base_link"
    """Name of the body frame in `/tf_static` and in the written bag."""
    datum: DatumConfig | None = None
    """Origin of the world frame."""
    sensors: dict[str, Any] = Field(default_factory=dict)
    """Sensors by name; `kind` in each block selects the sensor kind."""
    truth_topic: str | None = None
    """Topic with the true body pose in world (`nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, `PoseWithCovarianceStamped`, `TransformStamped`), for comparisons only; never fused."""
    truth_file: str = ""
    """In place of it a file of TUM's form, as evo writes it, path as for an aerial image: lines of stamp (s since 1970), x y z (m, world),
    qx qy qz qw, of body."""
    truth_time_offset_s: Annotated[float, Field(ge=-4e9, le=4e9)] = 0.0
    """Added to the stamps of the truth, s: -18 for one in GPS time beside sensors in UTC."""
    check_speed_topic: str | None = None
    """`nav_msgs/Odometry` whose forward speed is compared with the solution's; never fused."""
    timeline: TimelineConfig = TimelineConfig()
    """The states of the graph."""
    start: StartConfig = StartConfig()
    """How the run is started."""
    output: OutputConfig = OutputConfig()
    """What is written."""

    @field_validator("sensors")
    @classmethod
    def _parsed(cls, sensors: dict[str, Any]) -> dict[str, Any]:
        raw = [name for name, sensor in sensors.items() if not isinstance(sensor, SensorConfig)]
        if raw:
            raise ValueError(f"{', '.join(raw)}: no SensorConfig: read mappings with `parse_config`")
        return sensors

    @model_validator(mode="after")
    def _one_imu(self) -> VesselConfig:
        if len(self.of_kind("imu")) > 1:
            raise ValueError(f"sensors: only one imu can be enabled, found {', '.join(self.of_kind('imu'))}")
        return self

    @model_validator(mode="after")
    def _each_source_once(self) -> VesselConfig:
        """What two sensors read of the same messages would count as two measurements with errors of their own."""
        readers = [(name, sensor) for name, sensor in self.sensors.items() if sensor.enabled and sensor.topic]
        for (one, a), (other, b) in combinations(readers, 2):
            if (a.kind, a.topic) != (b.kind, b.topic) or not _read_alike(a, b):
                continue
            axes = getattr(a, "axes", ())
            shared = [axis for axis in axes if axis in b.axes]
            if shared and a.axes != b.axes:
                what = ", ".join(shared)
                raise ValueError(
                    f"sensors: {one} and {other} both read {what} of {a.topic}, which would count twice: delete {what} from the "
                    "axes of one"
                )
            if shared or not axes:
                raise ValueError(f"sensors: {one} and {other} both read {a.topic}, which would count twice: delete one")
        return self

    @model_validator(mode="after")
    def _each_image_once(self) -> VesselConfig:
        """The errors of an image are shared by all that is matched to it; two sensors would each have their own."""
        for (one, a), (other, b) in combinations(self.of_kind("aerial").items(), 2):
            if shared := sorted({*a.files} & {*b.files} - {""}):
                raise ValueError(
                    f"sensors: {one} and {other} are both matched to {shared[0]}, whose misregistration would count as two: move the "
                    f"lidars of {other} to {one}, and delete {other}"
                )
        return self

    @model_validator(mode="after")
    def _each_antenna_has_one_place(self) -> VesselConfig:
        """What is of another sensor's antenna sits where that does."""
        for name, sensor in self.sensors.items():
            if not (of := getattr(sensor, "antenna", "")):
                continue
            first = self.sensors.get(of)
            if first is None or first.kind != "gnss":
                raise ValueError(f"sensors: {name}.antenna: there is no gnss sensor '{of}'")
            for key in _OF_AN_ANTENNA:
                if key in sensor.model_fields_set and getattr(sensor, key) != getattr(first, key):
                    raise ValueError(
                        f"sensors: {name}.{key} is not that of {of}, whose antenna it is: delete it, or `antenna`"
                    )
            self.sensors[name] = sensor.model_copy(update={key: getattr(first, key) for key in _OF_AN_ANTENNA})
        return self

    @model_validator(mode="after")
    def _references_are_not_fused(self) -> VesselConfig:
        """What the track follows cannot say how good it is."""
        if self.truth_topic and self.truth_file:
            raise ValueError("truth_topic and truth_file: there can be only one truth: delete one")
        for key in ("truth_topic", "check_speed_topic"):
            topic = getattr(self, key)
            fused = [
                name for name, sensor in self.sensors.items() if sensor.enabled and topic and sensor.topic == topic
            ]
            if fused:
                raise ValueError(
                    f"{key}: {', '.join(fused)} fuses {topic}, and a comparison with it says nothing: delete one"
                )
        return self

    @property
    def truth(self) -> str:
        """Topic or file of the truth; empty: there is none."""
        return self.truth_topic or self.truth_file

    @property
    def files(self) -> tuple[str, ...]:
        """The files that it names, once each, as written: a relative path starts at the folder of vessel.yaml."""
        named = [file for sensor in self.sensors.values() if sensor.enabled for file in sensor.files]
        return tuple(dict.fromkeys(file for file in (*named, self.output.map_image, self.truth_file) if file))

    def with_sensors(self, changed: Mapping[str, Any]) -> VesselConfig:
        """Return the configuration with some of its sensors replaced."""
        return self.model_copy(update={"sensors": {**self.sensors, **changed}})

    def with_mounts(self, mounts: Mapping[str, tuple[Array, Array]]) -> VesselConfig:
        """Return the configuration with mounts (t (3,), m; R (3, 3)) of sensors in numbers, not by the names of their frames."""
        own = {name: self.sensors[name] for name in mounts if name in self.sensors}
        numbers = {name: MountConfig.of_pose(*mounts[name]) for name in own}
        return self.with_sensors({name: s.model_copy(update={"mount": numbers[name]}) for name, s in own.items()})

    def scaled(self, times: Mapping[str, Mapping[str, float]]) -> VesselConfig:
        """Return the configuration with numbers of sensors so many times as large; `times`: by sensor and key."""
        return self.with_sensors({name: self.sensors[name].scaled(by) for name, by in times.items()})

    def with_start_heading(self, heading_deg: float | None, sigma_deg: float | None = None) -> VesselConfig:
        """Return the configuration of a run that starts with this heading, deg; None: with none that is configured.

        Args:
            sigma_deg: its 1 sigma; None: as configured.
        """
        known = {"heading_deg": heading_deg, "heading_sigma_deg": sigma_deg or self.start.heading_sigma_deg}
        return self.model_copy(update={"start": self.start.model_copy(update=known)})

    def by_turns(self, name: str) -> list[str]:
        """Return the names of the enabled sensors that read one receiver's fixes by turns (`fixes`), this one among them."""
        own = self.sensors[name]
        if not own.takes_turns:
            return [name]
        others = {n: s for n, s in self.of_kind(own.kind).items() if n != name and s.takes_turns}
        return [name, *(n for n, s in others.items() if (s.topic, s.nmea) == (own.topic, own.nmea))]

    def receiver_of(self, name: str) -> str:
        """Return the name that stands for all sensors that read one receiver's fixes by turns: that of the first.

        Where several read the same of them (of two receivers without a topic) nothing tells whose they are: each stands for itself.
        """
        turns = self.by_turns(name)
        read = [self.sensors[of].fixes for of in turns] if len(turns) > 1 else []
        return name if len(set(read)) < len(read) else min(turns, key=list(self.sensors).index)

    def antenna_of(self, name: str) -> str:
        """Return the name that stands for all enabled sensors of one antenna: those of one receiver, and its velocities (`antenna`)."""
        of = getattr(self.sensors[name], "antenna", "")
        return self.receiver_of(of if of in self.sensors and self.sensors[of].enabled else name)

    def of_kind(self, kind: str) -> dict[str, Any]:
        """Return the enabled sensors of a kind, by name."""
        return {n: s for n, s in self.sensors.items() if s.kind == kind and s.enabled}
