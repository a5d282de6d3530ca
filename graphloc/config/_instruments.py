# SPDX-License-Identifier: Apache-2.0
"""Sensors that say one thing at a time: inertial, GNSS, compass, velocities, height.

Data-sheet units live here only, and become SI in the properties.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from graphloc.blocks import Block, Finite, NonNegative, Positive
from graphloc.config._sensor import KernelConfig, SensorConfig
from graphloc.frames import Array
from graphloc.signals.thinning import LEAST_APART_NS

STANDARD_GRAVITY_MPS2 = 9.80665


class ImuConfig(SensorConfig):
    """An inertial measurement unit (`sensor_msgs/Imu`, `sbg_driver/SbgImuData`, `px4_msgs/SensorCombined`)."""

    kind: Literal["imu"] = "imu"
    """The sensor kind."""
    accel_unit: Literal["m/s^2", "g"] = "m/s^2"
    """Unit of `linear_acceleration` in the bag (REP 103 says m/s^2; some drivers write g)."""
    gyro_unit: Literal["rad/s", "deg/s"] = "rad/s"
    """Unit of `angular_velocity` in the bag."""
    gravity: Literal["included", "removed", "inverted"] = "included"
    """Gravity in `linear_acceleration`: `included` (+g upwards at rest, the standard), `removed` by the driver, or `inverted`:
    the driver writes accelerations with the opposite sign (-g upwards at rest), while its gyroscope is right."""
    accel_noise_ug_per_sqrt_hz: Positive = 3000.0
    """Accelerometer white noise, ug/sqrt(Hz). The default allows for hull vibration."""
    gyro_noise_mdps_per_sqrt_hz: Positive = 20.0
    """Gyroscope white noise, mdeg/s/sqrt(Hz)."""
    accel_bias_instability_ug: Positive = 100.0
    """In-run accelerometer bias instability, ug. Raised, with a warning, where the biases go farther (see `adapt_noise`)."""
    gyro_bias_instability_deg_per_h: Positive = 20.0
    """In-run gyroscope bias instability, deg/h. As above: a cheap one that warms up drifts by hundreds."""
    bias_correlation_s: Positive = 300.0
    """Time over which a bias drifts by its instability, s."""
    accel_bias_sigma_mg: Positive = 10.0
    """Turn-on accelerometer bias, 1 sigma, mg."""
    gyro_bias_sigma_dps: Positive = 2.0
    """Turn-on gyroscope bias, 1 sigma, deg/s, before the start alignment has measured it."""
    mount_sigma_deg: NonNegative | tuple[NonNegative, NonNegative, NonNegative] = 1.0
    """Unknown attitude error of its mount, 1 sigma, deg: of each axis, or [roll, pitch, yaw]. Offline its yaw is estimated with the run, and
    the bounds include what is left of it. 0: the IMU's axes are those of the vessel by definition, or were calibrated to a tenth of a degree."""
    adapt_noise: bool = True
    """Raise the noise (never lower it, and with a warning) if the run contradicts it, or the IMU's own residuals do; and the walk of
    the biases, if they go farther than they may."""
    max_gap_s: Positive = 0.5
    """A longer interval between samples is an IMU gap: bridged with noise large enough for any motion of a vessel, s."""
    max_bridge_s: Positive = 20.0
    """A longer gap is not bridged: the run is cut there and its parts are solved separately, s."""
    kernel: KernelConfig = KernelConfig(kind="none")
    """Robust loss: not used for inertial data."""

    @property
    def mount_sigma_rad(self) -> Array:
        """Attitude error (3,) of the mount about each axis of the body, 1 sigma, rad."""
        return np.asarray(np.radians(np.broadcast_to(self.mount_sigma_deg, 3)))

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


_TALKER = "^([A-Z]{2})?"
Places = Annotated[tuple[Annotated[str, Field(pattern=_TALKER + "(GGA|GNS|RMC|GLL)$")], ...], Field(min_length=1)]
Headings = Annotated[tuple[Annotated[str, Field(pattern=_TALKER + "(HDT|THS|HDG|HDM|SHR)$")], ...], Field(min_length=1)]
Velocities = Annotated[tuple[Annotated[str, Field(pattern=_TALKER + "(VTG|RMC)$")], ...], Field(min_length=1)]
Speeds = Annotated[tuple[Annotated[str, Field(pattern=_TALKER + "(VHW|VBW)$")], ...], Field(min_length=1)]
SpeedAxes = Annotated[tuple[Literal["x", "y", "z"], ...], Field(min_length=1)]


class SlowErrorConfig(Block):
    """The slowly varying part of the GNSS error: a first-order Gauss-Markov process per axis."""

    enabled: bool | None = None
    """false: the GNSS error is white noise, and a jump is followed; for RTK rather set sigmas of centimetres. Empty: on if a second
    sensor (matches, tags, GNSS velocity, a speed along the vessel, another receiver) can separate it from motion; else it is added to the bounds only."""
    horizontal_sigma_m: Positive = 2.0
    """Stationary sigma of the slow error, each horizontal axis, m."""
    vertical_sigma_m: Positive = 5.0
    """Stationary sigma of the slow error in height, m."""
    time_constant_s: Positive = 200.0
    """Correlation time, s."""
    jumps: bool = True
    """Allow the slow error to jump (a robust loss on its steps), as multipath does."""


class GnssConfig(SensorConfig):
    """GNSS position (`sensor_msgs/NavSatFix`, `gps_msgs/GPSFix`, NMEA in `nmea_msgs/Sentence` or `std_msgs/String`, poses in a `grid`, [makers' messages](makers-messages.md))."""

    apart_ns = LEAST_APART_NS

    kind: Literal["gnss"] = "gnss"
    """The sensor kind."""
    min_status: Literal["any", "fix", "sbas", "gbas"] = "fix"
    """Fixes below this `NavSatStatus` are rejected; `any`: none are, for a driver that says `STATUS_NO_FIX` of all its fixes."""
    fixes: Literal["any", "rtk", "other"] = "any"
    """Which it reads: `rtk` those of status gbas, where there is one, that state less than 0.1 m (1 sigma, horizontal); `other` the rest. A
    receiver whose RTK comes and goes is two sensors of one topic, each with a slow error of its own: centimetres, and metres. Where both have the
    same mount, stamps and unknowns (`stamp_sigma_s`, `mount_sigma_m`), these are estimated as of one antenna and one clock."""
    sigma_scale: Positive = 1.0
    """Factor on the reported standard deviations, for the white part of the error."""
    min_horizontal_sigma_m: Positive = 0.02
    """Floor of the white horizontal sigma, m."""
    min_vertical_sigma_m: Positive = 0.04
    """Floor of the white vertical sigma, m."""
    default_horizontal_sigma_m: Positive = 1.5
    """Horizontal sigma if the message reports no covariance (type unknown, zeros or NaN), m."""
    default_vertical_sigma_m: Positive = 4.0
    """The same for height, m."""
    slow_error: SlowErrorConfig = SlowErrorConfig()
    """The modelled slow error."""
    stamp_sigma_s: NonNegative = 0.0
    """Unknown delay of its stamps beyond `time_offset_s`, 1 sigma, s; it is estimated with the run, one of half a
    second only in part. Many drivers stamp a fix when it arrives, 0.05 to 0.5 s after it was measured; `inspect` drafts it. 0: stamps are right."""
    mount_sigma_m: NonNegative = 0.0
    """Unknown error of where its antenna is taken to sit (`mount.xyz_m`, or tf), 1 sigma, each axis, m; it is estimated with the run, and the
    bounds include what is not known of it. `inspect` drafts it where nothing tells the antenna's place. 0: the place was measured."""
    grid: Annotated[str, Field(pattern=r"^(EPSG:\d{4,6})?$")] = ""
    """Map grid of `nav_msgs/Odometry`, `geometry_msgs/PoseStamped` or `PoseWithCovarianceStamped`, e.g. `EPSG:32632` for UTM zone 32 north
    (32732: south), x east and y north; z is taken for the height above the ellipsoid. Leave it empty for other messages."""
    nmea: Places = ("GGA",)
    """NMEA sentences to read, from one talker (`GPGGA`) or any (`GGA`): GGA, GNS, RMC, GLL."""

    @property
    def tells_height(self) -> bool:
        """Its fixes do."""
        return True

    @property
    def takes_turns(self) -> bool:
        """It does where the other fixes are another sensor's."""
        return self.fixes != "any"


class CompassConfig(SensorConfig):
    """Heading: `geometry_msgs/QuaternionStamped`, orientation of `sensor_msgs/Imu`, `PoseStamped` or `PoseWithCovarianceStamped`, NMEA (as `gnss`), `std_msgs/Float64` or `Float32`."""

    apart_ns = LEAST_APART_NS

    kind: Literal["compass"] = "compass"
    """The sensor kind."""
    convention: Literal["enu", "ned"] = "enu"
    """Yaw in the message: `enu` from east, counter-clockwise (REP 103); `ned` from north, clockwise. Of NMEA and most makers' messages it is known."""
    unit: Literal["deg", "rad"] = "deg"
    """Unit of a plain number (`Float64`, `Float32`); other messages have a fixed one."""
    sigma_deg: Positive = 1.5
    """Heading noise, 1 sigma, deg, if the message carries no covariance."""
    use_reported_sigma: bool = True
    """Use the yaw variance of an `Imu` message, or the accuracy in a maker's message, if it is positive and finite."""
    mount_offset_sigma_deg: NonNegative = 1.0
    """Unknown constant heading offset of the mount, 1 sigma, deg. 0: it was calibrated, to 0.1 deg; iron turns the compass nevertheless (`deviation_sigma_deg`, `wander_sigma_deg`)."""
    deviation_sigma_deg: NonNegative = 1.5
    """Magnetic deviation: coefficients B and C (sine and cosine of the heading), 1 sigma, deg; D and E (twice the
    heading) get half of it. 0: none, e.g. a GNSS compass."""
    wander_sigma_deg: NonNegative = 0.5
    """Temporary heading error (a crane or quay nearby, the compass's own filter), 1 sigma, deg. A GNSS compass: 0.2. 0: none; a heading
    is trusted as it is, its noise aside, where all three are 0."""
    wander_time_constant_s: Positive = 60.0
    """Correlation time of that error, s."""
    nmea: Headings = ("HDT", "THS")
    """NMEA sentences to read, from one talker (`HEHDT`) or any (`HDT`): HDT, THS, HDG, HDM, PASHR."""


class VelocityConfig(SensorConfig):
    """GNSS velocity over ground (`geometry_msgs/TwistWithCovarianceStamped`, `TwistStamped`, `Vector3Stamped`, NMEA and GPSFix as `gnss`)."""

    apart_ns = LEAST_APART_NS

    kind: Literal["gnss_velocity"] = "gnss_velocity"
    """The sensor kind."""
    convention: Literal["enu", "ned"] = "enu"
    """Axes of the message: `enu` east, north, up; `ned` north, east, down. Of NMEA, GPSFix and most makers' messages they are known."""
    min_sigma_mps: Positive = 0.03
    """Floor of the velocity sigma, m/s."""
    default_sigma_mps: Positive = 0.3
    """Sigma if the message reports no covariance, m/s."""
    wander_sigma_mps: NonNegative = 0.03
    """Error that lasts for seconds (multipath, the receiver's own filter), 1 sigma, each axis, m/s; on top of what it reports. 0: none."""
    wander_time_constant_s: Positive = 20.0
    """Correlation time of that error, s."""
    stamp_sigma_s: NonNegative = 0.0
    """Unknown delay of its stamps beyond `time_offset_s`, 1 sigma, s; as that of `gnss`. A late velocity turns the heading where that comes
    from the motion: 0.1 s by as much as the vessel turns in 0.1 s."""
    mount_sigma_m: NonNegative = 0.0
    """Unknown error of where its antenna is taken to sit, 1 sigma, each axis, m; as that of `gnss`."""
    antenna: str = ""
    """Name of the `gnss` sensor whose antenna this is: `mount` and `mount_sigma_m` are then those of that sensor, and what is not known of the
    place is estimated once, of both. `inspect` drafts it where both have one frame, or one topic. Empty: an antenna of its own."""
    nmea: Velocities = ("VTG",)
    """NMEA sentences to read, from one talker (`GPVTG`) or any (`VTG`): VTG, RMC."""


class BodyVelocityConfig(SensorConfig):
    """Velocity along the vessel, of wheels, a Doppler log or a speed log: twist of `nav_msgs/Odometry` or of `gnss_velocity`'s types.

    Also `std_msgs/Float64` or `Float32`, VHW and VBW in NMEA as `gnss`, and Doppler logs' own messages. All along the axes of the sensor.
    """

    apart_ns = LEAST_APART_NS

    kind: Literal["body_velocity"] = "body_velocity"
    """Which row of the sensor table reads this block."""
    axes: SpeedAxes = ("x",)
    """Axes of the sensor along which it measures; of a number and of VHW x alone, of VBW x and y. Wheels: [x, y], where the mount is a place that
    does not slip sideways (the rear axle of a car); x alone tells an error of the heading by its cosine only. A Doppler log: [x, y, z]."""
    through: Literal["ground", "water"] = "ground"
    """What it moves over or through. Water has a current, which is estimated. Messages that say the other are ignored."""
    unit: Literal["m/s", "km/h", "knots"] = "m/s"
    """Of a number; of other messages it is known."""
    use_reported_sigma: bool = True
    """Take the covariance of a message where it is positive and finite."""
    sigma_mps: Positive = 0.1
    """Noise along each axis, 1 sigma, m/s. Used where the message carries no covariance."""
    min_sigma_mps: Positive = 0.1
    """Floor of the sigma, m/s: wheels slip and water eddies for longer than a message, and drivers claim too little."""
    scale_sigma: Annotated[float, Field(ge=0.0, le=0.5)] = 0.05
    """Unknown but constant error of the scale (radius of a wheel, calibration of a log), 1 sigma, as a share; 0: exact."""
    mount_sigma_m: NonNegative = 0.0
    """Unknown error of where it is taken to sit (`mount.xyz_m`, or tf), 1 sigma, each axis, m; it is estimated with the run. Of wheels, of
    the place that does not slip sideways, which turns tell. 0: the place is known."""
    mount_sigma_deg: NonNegative = 0.0
    """Unknown error of the yaw of its mount, 1 sigma, deg; it is estimated with the run. Of wheels, of the way that they roll. 0: known."""
    current_sigma_mps: Positive = 0.5
    """Standing size of the current, each of east and north, 1 sigma, m/s."""
    current_time_constant_s: Positive = 600.0
    """How long a current stays the same, s."""
    nmea: Speeds = ("VHW",)
    """Sentences that are read of a topic of NMEA, of one talker (`VWVHW`) or of any (`VHW`): VHW (through the water), VBW (ahead and to
    the side, of `through`)."""

    @field_validator("axes")
    @classmethod
    def _ordered(cls, axes: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(axis for axis in "xyz" if axis in axes)


class HeightConfig(SensorConfig):
    """Height prior: a vessel floats, so its height is known from waterline and tide."""

    kind: Literal["height"] = "height"
    """The sensor kind."""
    height_m: Finite | None = None
    """Height of the body origin above the ellipsoid, m; empty: the median of the run's fixes."""
    sigma_m: Positive = 0.3
    """Heave around that height, 1 sigma, m."""
    tide_sigma_m: NonNegative = 0.5
    """Offset by tide and load, lasting for hours, 1 sigma, m; 0: none."""
    median_sigma_m: NonNegative = 5.0
    """Error of the fixes' median, where `height_m` is empty, 1 sigma, m: their slow error lasts longer than most runs. With RTK the fixes themselves tell better."""
    period_s: Annotated[float, Field(ge=0.02, le=1e6)] = 1.0
    """Time between two priors, s."""
    kernel: KernelConfig = KernelConfig(kind="none")
    """Robust loss: not used for the height prior."""

    @property
    def offset_sigma_m(self) -> float:
        """Of all that lasts: tide and load, and the median that stands for the height, 1 sigma, m."""
        return math.hypot(self.tide_sigma_m, self.median_sigma_m if self.height_m is None else 0.0)

    @property
    def synthetic_every_s(self) -> float:
        """Its period."""
        return self.period_s
