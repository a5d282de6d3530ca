# SPDX-License-Identifier: Apache-2.0
"""What sensors say: stamp, value, uncertainty - and nothing about what will be done with it.

Measurements are frozen; their arrays are copied, checked and made read-only. `seq` is the arrival
number of the message in its recording, unique, and the key of its row in the ledger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, Datum, Geodetic

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
NO_HEIGHT_M2 = 1e12
"""Variance, m^2, of the height of a fix that has none: 1000 km, 1 sigma."""


def _freeze(of: object, **shapes: tuple[int, ...]) -> None:
    """Replace arrays of a frozen dataclass, by their names, by read-only copies."""
    for name, shape in shapes.items():
        array = np.array(getattr(of, name), dtype=float)
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
        array.flags.writeable = False
        object.__setattr__(of, name, array)


def _freeze_covariance(of: object, size: int, name: str = "cov") -> None:
    _freeze(of, **{name: (size, size)})
    cov: Array = getattr(of, name)
    if np.count_nonzero(cov) == size and all(variance > 0.0 for variance in cov.diagonal().tolist()):
        return  # diagonal, as mostly
    # `np.allclose` written out: that takes longer than all else that is done here.
    if (np.abs(cov - cov.T) > 1e-12 + 1e-6 * np.abs(cov.T)).any() or np.linalg.eigvalsh(cov).min() <= 0.0:
        raise ValueError(f"{name} is not symmetric positive definite")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement:
    """Base: `stamp_ns` (sensor time), `sensor` (its name under `sensors:` in vessel.yaml), `seq`."""

    stamp_ns: int
    sensor: str
    seq: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class GnssPosition(Measurement):
    """A GNSS fix of the antenna.

    Attributes:
        position: geodetic position of the antenna phase centre (WGS 84).
        cov_enu_m2: (3, 3) covariance as reported, east-north-up, m^2. Its upward variance is `NO_HEIGHT_M2` where the receiver gives
            no height; the height in `position` then means nothing.
    """

    position: Geodetic
    cov_enu_m2: Array

    @property
    def has_height(self) -> bool:
        """Whether it says a height."""
        return bool(self.cov_enu_m2[2, 2] < NO_HEIGHT_M2)

    def __post_init__(self) -> None:
        lat, lon, height = (float(v) for v in self.position)
        if not (-90.0 <= lat <= 90.0 and -180.0 <= lon <= 360.0 and np.isfinite(height)):
            raise ValueError(f"position {lat}, {lon}, {height} is not on Earth")
        object.__setattr__(self, "position", Geodetic(lat, lon, height))
        _freeze_covariance(self, 3, "cov_enu_m2")


def world_from_fixes(fixes: Sequence[GnssPosition], datum: Datum) -> Array:
    """Return the places (N, 3) in world, m, of fixes. One without a height is put at the datum's: metres per degree grow with height."""
    level = datum.origin.height_m
    places = [m.position if m.has_height else m.position._replace(height_m=level) for m in fixes]
    return datum.enu_from_geodetic(*np.array(places).reshape(-1, 3).T)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CompassHeading(Measurement):
    """Yaw of the sensor's x axis: rad, from (true) east where the vessel is, counter-clockwise; with its sigma."""

    yaw_rad: float
    sigma_rad: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.yaw_rad) and np.isfinite(self.sigma_rad) and self.sigma_rad > 0.0):
            raise ValueError("yaw_rad and sigma_rad must be finite, sigma_rad positive")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GnssVelocity(Measurement):
    """Velocity of the antenna, (3,) m/s: east, north, up where it is; with covariance (3, 3) in m^2/s^2."""

    v_enu_mps: Array
    cov_m2ps2: Array

    def __post_init__(self) -> None:
        _freeze(self, v_enu_mps=(3,))
        _freeze_covariance(self, 3, "cov_m2ps2")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyVelocity(Measurement):
    """Velocity along axes of the sensor, in any subset of x, y, z: over ground, or through the water.

    Attributes:
        axes: which of x, y, z are measured, in this order. value: (k,) m/s. cov: (k, k) m^2/s^2.
    """

    axes: tuple[str, ...]
    value: Array
    cov: Array

    def __post_init__(self) -> None:
        if not self.axes or [a for a in "xyz" if a in self.axes] != list(self.axes):
            raise ValueError("axes must be some of x, y, z, in this order")
        _freeze(self, value=(len(self.axes),))
        _freeze_covariance(self, len(self.axes))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseMode:
    """One hypothesis of a pose measurement, over the measurement's `axes`, in their order.

    Attributes:
        value: (k,) x, y, z in m (world), roll, pitch, yaw in rad (ZYX), as `axes` select.
        cov: (k, k) covariance; angles are small rotations about the world's axes (as in ROS).
        probability: prior probability of this mode.
    """

    value: Array
    cov: Array
    probability: float = 1.0

    def __post_init__(self) -> None:
        k = len(np.atleast_1d(self.value))
        _freeze(self, value=(k,))
        _freeze_covariance(self, k)
        if not 0.0 < self.probability <= 1.0:
            raise ValueError("probability must be in (0, 1]")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseFix(Measurement):
    """An absolute pose of the sensor frame in world, in any subset of `AXES`, with several modes.

    Attributes:
        axes: which of `AXES` are measured, in the order of `AXES`.
        modes: at least one; probabilities sum to at most 1, what is missing is 'none of them'.
        news: share of its evidence, for being right or false, that is independent of the measurement before it.
    """

    axes: tuple[str, ...]
    modes: tuple[PoseMode, ...]
    news: float = 1.0

    def __post_init__(self) -> None:
        if not self.axes or tuple(a for a in AXES if a in self.axes) != tuple(self.axes):
            raise ValueError(f"axes must be a subset of {AXES} in that order, got {self.axes}")
        if not self.modes or any(len(m.value) != len(self.axes) for m in self.modes):
            raise ValueError("each mode needs one value per axis")
        if sum(m.probability for m in self.modes) > 1.0 + 1e-9:
            raise ValueError("mode probabilities sum to more than 1")
        if not 0.0 <= self.news <= 1.0:
            raise ValueError("news must be in [0, 1]")

    @property
    def none_probability(self) -> float:
        """Prior probability that no mode is right, as the front-end states it (0 if it does not)."""
        return max(0.0, 1.0 - sum(m.probability for m in self.modes))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TagMode:
    """One pose of a camera that explains the tags in an image, with their frame at rest.

    Attributes:
        p_world_camera_m: (3,). R_world_camera: (3, 3), optical axes to world.
        cov: (6, 6) of the tags' middle seen from the camera, m, and of the camera's attitude, a small rotation, rad; both in the
            camera's axes. So the bearing, known to millimetres where attitude and distance are not, keeps its weight whatever
            attitude the rest of the run gives.
        probability: prior probability of this mode, by how well it fits the image.
    """

    p_world_camera_m: Array
    R_world_camera: Array
    cov: Array
    probability: float

    def __post_init__(self) -> None:
        _freeze(self, p_world_camera_m=(3,), R_world_camera=(3, 3))
        _freeze_covariance(self, 6)
        if not 0.0 < self.probability <= 1.0:
            raise ValueError("probability must be in (0, 1]")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TagSighting(Measurement):
    """Surveyed tags of one frame, all that one image shows of them.

    Attributes:
        camera: its name. frame: `world`, or the dock that the tags ride on.
        numbers, families: K ids, and the family of each.
        points_m: (4 K, 3) corners of each tag in turn, in world, the frame at rest; of a tag: top-left, top-right,
            bottom-right, bottom-left of the print.
        pivot_m: (3,) point in world that the frame turns about: a dock's origin.
        rays: (4 K, 2) where the corners are seen: x / z, y / z in the camera's optical axes, distortion removed.
        cov: (8 K, 8 K) of the rays, in the order u0, v0, u1, ...: error of the corners in the image. The covariances of the modes
            include that of the survey as well.
        t_body_camera_m, R_body_camera: (3,), (3, 3) the camera's mount.
        modes: poses of the camera that explain the sighting, likeliest first; probabilities sum to 1.
        px: size of a pixel as a ray (1 / focal length); 0: not known.
    """

    camera: str
    frame: str
    numbers: tuple[int, ...]
    families: tuple[str, ...]
    points_m: Array
    pivot_m: Array
    rays: Array
    cov: Array
    t_body_camera_m: Array
    R_body_camera: Array
    modes: tuple[TagMode, ...]
    px: float = 0.0

    def __post_init__(self) -> None:
        n = 4 * len(self.numbers)
        _freeze(self, points_m=(n, 3), pivot_m=(3,), rays=(n, 2), t_body_camera_m=(3,), R_body_camera=(3, 3))
        _freeze_covariance(self, 2 * n)
        if not n or not self.modes:
            raise ValueError("a sighting needs a tag and a mode")

    @property
    def tags(self) -> tuple[tuple[str, int], ...]:
        """Family and id of each tag."""
        return tuple(zip(self.families, self.numbers, strict=True))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TagView:
    """A tag that is seen, but not in the survey.

    Attributes:
        camera: its name. family, number: of the tag. rays, cov: of its four corners, as in `TagSighting`.
        t_body_camera_m, R_body_camera: (3,), (3, 3) the camera's mount.
    """

    stamp_ns: int
    camera: str
    family: str
    number: int
    rays: Array
    cov: Array
    t_body_camera_m: Array
    R_body_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeightPrior(Measurement):
    """Height of the body origin above that of the datum, m (both over the ellipsoid), from waterline and tide; with its sigma."""

    height_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSample(Measurement):
    """One sample of an IMU, as it arrives: see `ImuSeries`."""

    accel_mps2: Array
    gyro_radps: Array

    def __post_init__(self) -> None:
        _freeze(self, accel_mps2=(3,), gyro_radps=(3,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSeries:
    """All samples of one IMU, as columns, in stamp order, in the sensor's own axes.

    Attributes:
        sensor: its name under `sensors:`.
        stamps_ns: (N,) int64, strictly increasing.
        accel_mps2: (N, 3) specific force: at rest +g upwards, or zero where the configuration says that gravity is removed.
        gyro_radps: (N, 3) angular rate.
        seqs: (N,) int64 arrival numbers.
    """

    sensor: str
    stamps_ns: NDArray[np.int64]
    accel_mps2: Array
    gyro_radps: Array
    seqs: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        for name, dtype in (("stamps_ns", np.int64), ("seqs", np.int64)):
            column = np.array(getattr(self, name), dtype=dtype)
            column.flags.writeable = False
            object.__setattr__(self, name, column)
        if n > 1 and (np.diff(self.stamps_ns) <= 0).any():
            raise ValueError("IMU stamps must increase strictly")
        _freeze(self, accel_mps2=(n, 3), gyro_radps=(n, 3))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def where(self, kept: slice | NDArray[np.bool_]) -> ImuSeries:
        """Return some of the samples; `kept`: (N,) whether each is kept, or a slice."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[kept],
            accel_mps2=self.accel_mps2[kept],
            gyro_radps=self.gyro_radps[kept],
            seqs=self.seqs[kept],
        )
