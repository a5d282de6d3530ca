# SPDX-License-Identifier: Apache-2.0
"""The only list of frames, and the only place where geodetic, NED and compass angles become ENU.

`T_a_b` is the pose of b in a and takes coordinates in b to coordinates in a; in a product equal
names touch: `T_world_body * T_body_antenna`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

EARTH_M = 6_371_000.0
"""Radius of a sphere that stands for the ellipsoid where its curvature beneath the datum's tangent plane is needed: wrong by 0.3 % at most."""


class Frame(NamedTuple):
    """A frame: its name, the direction of its axes, and its origin."""

    name: str
    axes: str
    origin: str


FRAMES: tuple[Frame, ...] = (
    Frame("world", "x east, y north, z up (ENU, REP 103)", "the run's datum on the WGS 84 ellipsoid"),
    Frame("body", "x forward, y port (left), z up (FLU, REP 103)", "the vessel's reference point, `base_link`"),
    Frame("imu", "as the driver reports", "the IMU, `mount` from body"),
    Frame("antenna", "none: a point", "phase centre of the GNSS antenna, `mount` from body"),
    Frame("lidar", "x forward, y left, z up", "the scanner, `mount` from body"),
    Frame("camera", "x right, y down, z forward (optical)", "the projection centre, `mount` from body"),
    Frame("tag", "x right, y up, z out of the printed face", "the tag's centre"),
    Frame("image", "u right (column), v down (row)", "centre of the top-left pixel"),
)


class Geodetic(NamedTuple):
    """A position on WGS 84: latitude and longitude in deg, height above the ellipsoid in m."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


@lru_cache(maxsize=8)  # making a transformer takes longer than a thousand transforms
def _topocentric(latitude_deg: float, longitude_deg: float, height_m: float) -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={latitude_deg!r} +lon_0={longitude_deg!r} +h_0={height_m!r}"
    )


@dataclass(frozen=True, slots=True)
class Datum:
    """The origin of the world frame. ENU there is tangent to the ellipsoid (not a map grid)."""

    origin: Geodetic

    def _pipeline(self) -> Transformer:
        return _topocentric(*(float(v) for v in self.origin))

    def enu_from_geodetic(self, latitude_deg: Array, longitude_deg: Array, height_m: Array) -> Array:
        """Return positions (N, 3) in world, m, of N geodetic positions."""
        e, n, u = self._pipeline().transform(
            np.atleast_1d(longitude_deg), np.atleast_1d(latitude_deg), np.atleast_1d(height_m)
        )
        return np.column_stack([e, n, u])

    @property
    def gravity_mps2(self) -> float:
        """Normal gravity at the origin: Somigliana's formula on GRS 80, less 3.086e-6 /s^2 of height."""
        sin2 = float(np.sin(np.radians(self.origin.latitude_deg))) ** 2
        on_ellipsoid = 9.7803267715 * (1.0 + 0.001931851353 * sin2) / float(np.sqrt(1.0 - 0.0066943800229 * sin2))
        return on_ellipsoid - 3.086e-6 * self.origin.height_m

    def geodetic_from_enu(self, p_world_m: Array) -> Array:
        """Return (N, 3) latitude deg, longitude deg, height m of positions (N, 3) in world."""
        p = np.atleast_2d(p_world_m)
        lon, lat, h = self._pipeline().transform(p[:, 0], p[:, 1], p[:, 2], direction="INVERSE")
        return np.column_stack([lat, lon, h])

    def convergence_rad(self, p_world_m: Array) -> Array:
        """Return the meridian convergence (...) at places (..., 3) in world: by how much, counter-clockwise, true north there is off world y.

        10 km east of the origin, in latitude 60, it is 0.16 deg.
        """
        p = np.asarray(p_world_m, dtype=float)
        latitude_rad = np.radians(self.origin.latitude_deg) + p[..., 1] / EARTH_M
        return np.asarray(p[..., 0] * np.tan(latitude_rad) / EARTH_M)

    def local_axes(self, p_world_m: Array) -> Array:
        """Return R (3, 3) from the axes east, north, up of the ellipsoid at a place (3,) in world to those of world."""
        east, north = np.asarray(p_world_m, dtype=float)[:2] / EARTH_M
        turn = skew(np.array([-north, east, float(self.convergence_rad(p_world_m))]))
        return np.asarray(np.eye(3) + turn + 0.5 * turn @ turn)

    def true_heading_deg(self, yaw_rad: Array | float, p_world_m: Array) -> Array:
        """Return the headings (...), clockwise from true north, in [0, 360) deg, of yaws (...) in world at places (..., 3)."""
        return heading_deg_from_yaw(np.asarray(yaw_rad) - self.convergence_rad(p_world_m))


def skew(v: Array) -> Array:
    """Return the matrix (3, 3) that takes b to the cross product v x b."""
    x, y, z = np.asarray(v, dtype=float).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def pinhole(p_camera_m: Array) -> tuple[Array, Array]:
    """Return rays x/z, y/z (N, 2) of points (N, 3) before a camera, optical axes, and d ray / d point (N, 2, 3)."""
    z = p_camera_m[:, 2:]
    rays = p_camera_m[:, :2] / z
    J = np.zeros((len(z), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0 / z[:, 0]
    J[:, :, 2] = -rays / z
    return rays, J


def wrap_angle(angle_rad: Array | float) -> Array:
    """Return angles in (-pi, pi]."""
    a = np.asarray(angle_rad, dtype=float)
    return -((-a + np.pi) % (2.0 * np.pi) - np.pi)


def continuous_longitudes(longitude_deg: Array) -> Array:
    """Return longitudes (N,) within 180 deg of the first one, so that a run across the date line is continuous."""
    return np.asarray(longitude_deg[0] + (longitude_deg - longitude_deg[0] + 180.0) % 360.0 - 180.0)


def yaw_from_heading_deg(heading_deg: Array | float) -> Array:
    """Return yaw (rad, from east, counter-clockwise) of a compass heading (deg, from true north, clockwise)."""
    return wrap_angle(np.pi / 2.0 - np.radians(heading_deg))


def heading_deg_from_yaw(yaw_rad: Array | float) -> Array:
    """Return the compass heading in [0, 360) deg of a yaw in rad."""
    return np.asarray((90.0 - np.degrees(yaw_rad)) % 360.0)


def rotation_from_rpy_deg(rpy_deg: Array) -> Array:
    """Return R (3, 3) of roll, pitch, yaw in deg: R = Rz(yaw) Ry(pitch) Rx(roll), as in ROS."""
    return np.asarray(Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix())


def yaw_from_rotation(rotation: Array) -> Array:
    """Return the yaw (...) in rad of rotation matrices (..., 3, 3): where their x axis points in the horizontal plane."""
    return np.asarray(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]))


def rpy_from_rotation(rotation: Array) -> Array:
    """Return roll, pitch, yaw in rad, (3,) or (N, 3), of rotation matrices: the inverse of `rotation_from_rpy_deg`, but for the unit.

    Where x points straight up or down only the sum of roll and yaw is told: yaw is zero there.
    """
    R = np.moveaxis(np.asarray(rotation, dtype=float), (-2, -1), (0, 1))
    level = np.hypot(R[0, 0], R[1, 0])
    told = level > 1e-9
    yaw = np.where(told, np.arctan2(R[1, 0], R[0, 0]), 0.0)
    roll = np.where(told, np.arctan2(R[2, 1], R[2, 2]), np.arctan2(-R[1, 2], R[1, 1]))
    return np.stack([roll, np.arctan2(-R[2, 0], level), yaw], axis=-1)
